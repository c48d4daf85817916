"""Convert a user's scene, such as a vendor's MJCF, so that an export can run in it.

Joints are found by name. Position servos with the contract's gains replace the actuators; their torque limits are the
file's, else the export's. The contract's sensors are added. The integrator implicitfast replaces Euler: Euler
integrates a servo's damping explicitly, which is unstable for a joint without armature.
Masses, contacts, joint friction, solver and time step stay. The file is not trusted:
``legged_mw.robot.mjcf`` refuses elements that no robot needs, and nothing in the file is run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from legged_mw.deploy.contract import SCENE_FILE, Contract, compile_scene, part
from legged_mw.deploy.robot import Floats
from legged_mw.robot.mjcf import XmlSource, add_rotors, check_model
from legged_mw.utils.errors import UserError, unknown
from legged_mw.view.posed_robot import lowest_point

HOME = "home"  # keyframe with the start pose
_LOW = 0.01  # [m] a geom of the foot's body belongs to the foot if it ends this close to the lowest point
_OBJECT, _SENSOR = mujoco.mjtObj, mujoco.mjtSensor


def fit(file: Path, folder: Path, contract: Contract) -> tuple[mujoco.MjSpec, Contract]:
    """The scene in ``file`` for the export in ``folder``, and the contract with its time step, mass, sensors and feet.

    Raises UserError.
    """
    if not file.is_file():
        raise UserError(f"--scene: no file {file}")
    if contract.motors.law != "servo":
        raise UserError(
            f"--scene: in a scene every joint gets a servo, but the policy drives motors of the law '{contract.motors.law}': leave it out"
        )
    try:
        source = XmlSource(file)
        if source.root.tag != "mujoco":
            raise ValueError(f"its first element is <{source.root.tag}>; a scene is an MJCF with the element <mujoco>")
        spec = source.spec()
        file_limits = _drop_motors(spec)
        _find_joints(spec, file, contract)
        own = compile_scene(part(folder, SCENE_FILE))
        _make_ready(spec, contract, _missing_limits(spec, own, contract, file_limits) | file_limits)
        imu = _find_imu(spec, own, contract)
        _stand(spec, contract)
        feet = _find_feet(spec, own, contract)
        sensors = _add_sensors(spec, contract, imu)
        model = spec.compile()
        check_model(model)
    except (ValueError, RecursionError) as error:
        if isinstance(error, UserError):
            raise
        reason = str(error).partition("The visual elements of the spec")[0]
        raise UserError(f"--scene: {file.name} is not a valid MJCF: {' '.join(reason.split())}") from None
    return spec, _in_scene(model, file, contract, sensors, feet)


def _in_scene(
    model: mujoco.MjModel,
    file: Path,
    contract: Contract,
    sensors: dict[str, tuple[str, ...]],
    feet: dict[str, tuple[str, ...]],
) -> Contract:
    """The contract with the scene's time step, mass, sensors and feet."""
    steps = contract.period / model.opt.timestep
    if steps < 0.999 or abs(steps - round(steps)) > 1e-3:
        raise UserError(
            f"--scene: {file.name} has a time step of {model.opt.timestep:g} s, of which no whole number is the policy's period of "
            f'{contract.period:g} s; write one in it: <option timestep="{contract.timestep:g}"/>'
        )
    return replace(
        contract,
        timestep=float(model.opt.timestep),
        decimation=round(steps),
        mass=float(model.body_subtreemass[0]),
        sensors=sensors,
        feet=feet,
        ends=contract.ends._replace(falls_on=()),  # the names are geoms of another file
    )


# ---- robot ----------------------------------------------------------------------------------------------------------


def _drop_motors(spec: mujoco.MjSpec) -> dict[str, float]:
    """Remove the file's actuators and keyframes. Returns joint -> largest torque [N m], where an actuator states it."""
    limits: dict[str, float] = {}
    add_rotors(spec)
    for actuator in list(spec.actuators):
        gear = abs(float(actuator.gear[0]))
        force, control = actuator.forcerange, actuator.ctrlrange
        if force[1] > force[0]:
            limits[actuator.target] = gear * float(np.abs(force).max())
        elif actuator.biastype == mujoco.mjtBias.mjBIAS_NONE and control[1] > control[0]:
            limits[actuator.target] = gear * abs(float(actuator.gainprm[0])) * float(np.abs(control).max())
        spec.delete(actuator)
    for key in list(spec.keys):  # a keyframe has a control for each actuator
        spec.delete(key)
    spec.nkey = 0
    return limits


def _missing_limits(
    spec: mujoco.MjSpec, own: mujoco.MjModel, contract: Contract, stated: dict[str, float]
) -> dict[str, float]:
    """Joint -> the export's torque limit [N m], for joints without a limit in the file."""
    file_values, export_values = (
        torque_limits(model, [model.joint(name).id for name in contract.joints]) for model in (spec.compile(), own)
    )
    values = zip(contract.joints, file_values, export_values, strict=True)
    return {
        name: float(export_limit)
        for name, file_limit, export_limit in values
        if name not in stated and np.isinf(file_limit) and np.isfinite(export_limit)
    }


def torque_limits(model: mujoco.MjModel, joints: Sequence[int]) -> Floats:
    """(D,) [N m] the smaller torque limit of each joint and its actuator; inf without a limit."""
    limits = np.where(model.jnt_actfrclimited[joints] > 0, np.abs(model.jnt_actfrcrange[joints]).max(axis=1), np.inf)
    for i, joint in enumerate(joints):
        for actuator in np.flatnonzero(model.actuator_trnid[:, 0] == joint):
            gear = abs(model.actuator_gear[actuator, 0])
            if model.actuator_forcelimited[actuator]:
                limits[i] = min(limits[i], gear * np.abs(model.actuator_forcerange[actuator]).max())
    return limits


def _find_joints(spec: mujoco.MjSpec, file: Path, contract: Contract) -> None:
    """Raise UserError unless the file has one robot with a free root and exactly the contract's joints."""
    names = [joint.name for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE]
    for name in contract.joints:
        if name not in names:
            raise UserError(f"--scene: {unknown('joint', name, names, file.name)}")
    if others := [name or "one without a name" for name in names if name not in contract.joints]:
        raise UserError(
            f"--scene: {file.name} has joints that the policy does not move: {', '.join(others)}; take them out of a copy of it"
        )
    free = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    root = _root(spec, contract)
    if [joint.parent.name for joint in free] != [root.name] or root.parent.name != "world":
        raise UserError(
            f"--scene: {file.name} must have one free joint, of the robot's root; it has {len(free)}: "
            f"{', '.join(joint.parent.name or 'of a body without a name' for joint in free) or 'none'}"
        )


def _root(spec: mujoco.MjSpec, contract: Contract) -> mujoco.MjsBody:
    """The robot's root: the child of the world that carries the joints."""
    body = spec.joint(contract.joints[0]).parent
    while body.parent.name != "world":
        body = body.parent
    return body


def _make_ready(spec: mujoco.MjSpec, contract: Contract, limits: dict[str, float]) -> None:
    """Add servos with the contract's gains, add a ground if there is none, and set geom groups for a height scan."""
    if spec.option.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for i, name in enumerate(contract.joints):
        stiffness, damping = float(contract.stiffness[i]), float(contract.damping[i])
        limit = {"forcelimited": True, "forcerange": [-limits[name], limits[name]]} if name in limits else {}
        spec.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            dyntype=mujoco.mjtDyn.mjDYN_NONE,
            gainprm=[stiffness, *[0.0] * 9],
            biasprm=[0.0, -stiffness, -damping, *[0.0] * 7],
            gear=[1.0, *[0.0] * 5],
            armature=0.0,  # the file's defaults may have others
            damping=[0.0] * 3,
            delay=0.0,
            nsample=0,
            ctrllimited=False,
            **limit,
        )
    world = [geom for geom in spec.worldbody.geoms if geom.contype or geom.conaffinity]
    if not world:
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(name="floor_of_deploy", type=plane, size=[0.0, 0.0, 0.05], contype=1, conaffinity=1)
    for geom in spec.geoms:  # a height scan detects group 0 only
        ground = geom.parent.name == "world"
        geom.group = 0 if ground else geom.group or 1


def _find_imu(spec: mujoco.MjSpec, own: mujoco.MjModel, contract: Contract) -> str:
    """The IMU's site in the file. If it is missing, add it to the body of the export's name, else to the root."""
    if spec.site(contract.imu) is not None:
        return contract.imu
    site = own.site(contract.imu)
    body = spec.body(own.body(int(site.bodyid[0])).name) or _root(spec, contract)
    body.add_site(name=contract.imu, pos=site.pos, quat=site.quat, group=3)
    return contract.imu


# ---- start pose, feet, sensors --------------------------------------------------------------------------------------


def _stand(spec: mujoco.MjSpec, contract: Contract) -> None:
    """Add a keyframe: upright, in the default pose, with the lowest point at height 0."""
    model = spec.compile()
    data = _posed(model, contract)
    touching = np.flatnonzero((model.geom_conaffinity | model.geom_contype > 0) & (model.geom_bodyid > 0)).tolist()
    data.qpos[2] -= min((lowest_point(model, data, geom) for geom in touching), default=0.0)
    spec.add_key(name=HOME, qpos=data.qpos.tolist(), ctrl=contract.default_pose.tolist())


def _posed(model: mujoco.MjModel, contract: Contract) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:7] = [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    data.qpos[[model.joint(name).qposadr[0] for name in contract.joints]] = contract.default_pose
    mujoco.mj_kinematics(model, data)
    return data


def _find_feet(spec: mujoco.MjSpec, own: mujoco.MjModel, contract: Contract) -> dict[str, tuple[str, ...]]:
    """Foot -> its contact sensors. A foot is the lowest geoms of the bodies that the foot's joint moves."""
    model, feet = spec.compile(), {}
    data = _posed(model, contract)
    for foot, sensors in contract.feet.items():
        geom = int(own.sensor(sensors[0]).objid[0])
        moved = int(own.body_weldid[own.geom_bodyid[geom]])
        joint = own.joint(int(own.body_jntadr[moved])).name
        body = int(model.joint(joint).bodyid[0])
        colliding = (model.geom_contype | model.geom_conaffinity) > 0
        geoms = np.flatnonzero((model.body_weldid[model.geom_bodyid] == model.body_weldid[body]) & colliding).tolist()
        if not geoms:
            raise UserError(f"--scene: nothing that '{joint}' moves can touch the ground, so there is no foot {foot}")
        heights = [lowest_point(model, data, each) for each in geoms]
        low = [each for each, height in zip(geoms, heights, strict=True) if height < min(heights) + _LOW]
        feet[foot] = tuple(_feel(spec, each, f"contact/{foot}/{i}") for i, each in enumerate(low))
    return feet


def _feel(spec: mujoco.MjSpec, geom: int, name: str) -> str:
    """Add a sensor for contacts of a geom with the ground. Returns its name."""
    target: Any = spec.geoms[geom]
    target.name = target.name or name
    spec.add_sensor(
        name=name,
        type=_SENSOR.mjSENS_CONTACT,
        objtype=_OBJECT.mjOBJ_GEOM,
        objname=target.name,
        reftype=_OBJECT.mjOBJ_BODY,
        refname="world",
        intprm=[1, 0, 1],  # it measures the number of contacts
    )
    return name


def _add_sensors(spec: mujoco.MjSpec, contract: Contract, imu: str) -> dict[str, tuple[str, ...]]:
    """Add the contract's sensors with new names. Returns quantity -> sensors."""
    site, joint, added = _OBJECT.mjOBJ_SITE, _OBJECT.mjOBJ_JOINT, {}

    def add(quantity: str, kind: Any, of: Any, *names: str, **more: Any) -> None:
        added[quantity] = tuple(f"deploy/{quantity}/{name}" for name in names)
        for full, name in zip(added[quantity], names, strict=True):
            spec.add_sensor(name=full, type=kind, **{"objtype": of, "objname": name, **more})

    add("lin_vel", _SENSOR.mjSENS_VELOCIMETER, site, imu)
    add("ang_vel", _SENSOR.mjSENS_GYRO, site, imu)
    up = {"objtype": _OBJECT.mjOBJ_BODY, "objname": "world", "reftype": site, "refname": imu}
    add("up", _SENSOR.mjSENS_FRAMEZAXIS, site, imu, **up)
    add("acceleration", _SENSOR.mjSENS_ACCELEROMETER, site, imu)
    add("joint_pos", _SENSOR.mjSENS_JOINTPOS, joint, *contract.joints)
    add("joint_vel", _SENSOR.mjSENS_JOINTVEL, joint, *contract.joints)
    add("joint_torque", _SENSOR.mjSENS_ACTUATORFRC, _OBJECT.mjOBJ_ACTUATOR, *contract.joints)
    return added
