"""A robot with another body as its root: for the joints between the body with the IMU and the body that hangs.

A G1 hangs by its torso, and its IMU is in the pelvis: the rope pulls beyond its waist. With the torso as the root, its
waist carries pelvis and legs, on which nothing pulls.
"""

from __future__ import annotations

import mujoco
import numpy as np

from legged_mw.deploy.robot import Floats


def between(model: mujoco.MjModel, body: int) -> list[str]:
    """Names of the joints between the root and ``body`` (id)."""
    names = list[str]()
    while model.body_parentid[body] > 0:
        names += [model.joint(i).name for i in _joints(model, body)]
        body = model.body_parentid[body]
    return names


def with_root(model: mujoco.MjModel, root: int) -> mujoco.MjSpec:
    """The robot of ``model`` without its shapes, and with the body ``root`` (id) as its root.

    Joints, motors, masses and force limits are the same; angles keep their signs. The joints between the old root and
    the new one have axes that point the other way.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    spec = mujoco.MjSpec()
    _add(spec.worldbody, model, data, root)
    for i in range(model.nu):
        joint = model.joint(model.actuator_trnid[i, 0]).id
        motor = spec.add_actuator(name=model.actuator(i).name, target=model.joint(joint).name)
        motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        motor.forcelimited, motor.forcerange = int(model.actuator_forcelimited[i]), model.actuator_forcerange[i]
    return spec


def _joints(model: mujoco.MjModel, body: int) -> range:
    first = int(model.body_jntadr[body])
    return range(first, first + int(model.body_jntnum[body]))


def _add(parent: mujoco.MjsBody, model: mujoco.MjModel, data: mujoco.MjData, body: int, carrier: int = 0) -> None:
    """Add ``body`` (id), and all that it carries, to ``parent``. ``carrier``: the body that it hangs on; 0: none."""
    rotation, carried_by = data.xmat[body].reshape(3, 3), data.xmat[carrier].reshape(3, 3)
    quaternion = np.array([1.0, 0.0, 0.0, 0.0])
    if carrier:
        mujoco.mju_mat2Quat(quaternion, (carried_by.T @ rotation).ravel())
    new = parent.add_body(name=model.body(body).name, quat=quaternion, explicitinertial=True)
    new.mass, new.inertia = model.body_mass[body], model.body_inertia[body]
    new.ipos, new.iquat = model.body_ipos[body], model.body_iquat[body]
    if carrier:
        new.pos = carried_by.T @ (data.xpos[body] - data.xpos[carrier])
        turned = model.body_parentid[body] != carrier  # it carried ``carrier``, by the joints of that
        for i in _joints(model, carrier if turned else body):
            joint, dof = model.joint(i), model.jnt_dofadr[i]
            axis, anchor = rotation.T @ data.xaxis[i], rotation.T @ (data.xanchor[i] - data.xpos[body])
            added = new.add_joint(name=joint.name, pos=anchor, axis=-axis if turned else axis)
            added.armature, added.frictionloss = model.dof_armature[dof], model.dof_frictionloss[dof]
            added.damping = np.array([model.dof_damping[dof], 0.0, 0.0])
            added.actfrclimited, added.actfrcrange = int(model.jnt_actfrclimited[i]), model.jnt_actfrcrange[i]
    else:
        new.add_freejoint(name="root")
    around = [*np.flatnonzero(model.body_parentid == body), model.body_parentid[body]]
    for other in around:
        if other not in (0, carrier):
            _add(new, model, data, int(other), body)


def motion_of(model: mujoco.MjModel, body: int, qpos: Floats, qvel: Floats, qacc: Floats) -> tuple[Floats, Floats]:
    """(T, 6) acceleration of ``body`` (id), and (3,) its angular velocity at the start, from (T, nq), (T, nv), (T, nv).

    Linear: in a world that is turned like the body at the start. Angular: body frame.
    """
    data, kind = mujoco.MjData(model), mujoco.mjtObj.mjOBJ_XBODY
    velocity, acceleration = np.zeros((2, 6))
    motion, start, spin = np.empty((len(qpos), 6)), np.eye(3), np.zeros(3)
    for i, (data.qpos[:], data.qvel[:], data.qacc[:]) in enumerate(zip(qpos, qvel, qacc, strict=True)):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_rnePostConstraint(model, data)
        mujoco.mj_objectAcceleration(model, data, kind, body, acceleration, 0)  # as an accelerometer: less gravity
        rotation = data.xmat[body].reshape(3, 3)
        if i == 0:
            mujoco.mj_objectVelocity(model, data, kind, body, velocity, 0)
            start, spin = rotation.copy(), rotation.T @ velocity[:3]
        motion[i, :3] = start.T @ (acceleration[3:] + model.opt.gravity)
        motion[i, 3:] = rotation.T @ acceleration[:3]
    return motion, spin
