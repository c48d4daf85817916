"""The sensors that are added to a robot, with the site of its IMU, and their columns in ``sensordata``."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import mujoco
import numpy as np

from legged_mw.sim.ground import GROUND
from legged_mw.sim.robot_file import RobotFile
from legged_mw.utils.errors import ModelError, unknown

SELF_CONTACT = "self_contacts"  # number of contacts of the robot with itself
ANGULAR_MOMENTUM = "angular_momentum"  # of the whole robot about its centre of mass, world frame [kg m^2/s]
COM_VELOCITY = "com_velocity"  # of the whole robot's centre of mass, world frame [m/s]
CONTACT_FORCE = "contact_forces"  # net force of each contact geom on the ground, world frame [N]
_SENS, _OBJ = mujoco.mjtSensor, mujoco.mjtObj
_FOUND, _FORCE = (1 << int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{name}")) for name in ("FOUND", "FORCE"))
_NET = 3  # reduction of the contact sensor: net force of all contacts, world frame
_IMU = "imu"  # default name of the IMU site
_ALIGNED = 1e-4  # [rad] axes that differ by less are parallel
SENSORS = (SELF_CONTACT, ANGULAR_MOMENTUM, COM_VELOCITY, CONTACT_FORCE)  # on demand


def add_sensors(spec: mujoco.MjSpec, contact_geoms: Sequence[str], velocity_sites: Sequence[str], imu: str) -> None:
    """Add contact sensors of geoms, velocity sensors of sites, and the accelerometer at the site ``imu``."""
    geom, site = _OBJ.mjOBJ_GEOM, _OBJ.mjOBJ_SITE
    with_ground = {"type": _SENS.mjSENS_CONTACT, "reftype": geom, "refname": GROUND}
    for name in contact_geoms:
        data = [_FOUND, 0, 1]  # data, no reduction, one slot
        spec.add_sensor(name=f"contact/{name}", objtype=geom, objname=name, intprm=data, **with_ground)
    for name in velocity_sites:
        spec.add_sensor(name=f"linvel/{name}", type=_SENS.mjSENS_FRAMELINVEL, objtype=site, objname=name)
    spec.add_sensor(name=f"accelerometer/{imu}", type=_SENS.mjSENS_ACCELEROMETER, objtype=site, objname=imu)


def add_more_sensors(spec: mujoco.MjSpec, root: str, contact_geoms: Sequence[str], more: Collection[str]) -> None:
    """Add the sensors of ``SENSORS`` in ``more``, after ``add_sensors``. Both engines compute them once per step."""
    if SELF_CONTACT in more:
        tree = _OBJ.mjOBJ_XBODY
        itself = {"objtype": tree, "objname": root, "reftype": tree, "refname": root, "intprm": [_FOUND, 0, 1]}
        spec.add_sensor(name=SELF_CONTACT, type=_SENS.mjSENS_CONTACT, **itself)
    whole = {"objtype": _OBJ.mjOBJ_BODY, "objname": root}
    if ANGULAR_MOMENTUM in more:
        spec.add_sensor(name=ANGULAR_MOMENTUM, type=_SENS.mjSENS_SUBTREEANGMOM, **whole)
    if COM_VELOCITY in more:
        spec.add_sensor(name=COM_VELOCITY, type=_SENS.mjSENS_SUBTREELINVEL, **whole)
    if CONTACT_FORCE in more:  # the sensors "contact/..." also measure the force, so that contacts are searched once
        for name in contact_geoms:
            spec.sensor(f"contact/{name}").intprm[:3] = [_FOUND | _FORCE, _NET, 1]


def sensor_spans(model: mujoco.MjModel, more: Collection[str]) -> dict[str, slice]:
    """Group -> columns of sensordata, for the groups of ``add_sensors`` and the sensors of ``SENSORS`` in ``more``."""
    groups = ["".join(model.sensor(i).name.partition("/")[:2]) for i in range(model.nsensor)]
    spans = {}
    for group in ("contact/", "linvel/", "accelerometer/", *(name for name in SENSORS if name in more)):
        members = [i for i, of in enumerate(groups) if of == group]
        starts, sizes = model.sensor_adr[members], model.sensor_dim[members]
        spans[group.rstrip("/")] = slice(int(starts[0]), int(starts[0] + sizes.sum())) if members else slice(0, 0)
    if CONTACT_FORCE in more:
        spans[CONTACT_FORCE] = spans["contact"]  # (contacts, 4): count, force
        spans["contact"] = slice(spans["contact"].start, spans["contact"].stop, 4)
    return spans


# ---- the IMU's site


def sensed_site(robot: RobotFile, model: mujoco.MjModel, wanted: str) -> str:
    """Name of a site on the root with the root's axes: ``wanted`` if it is one, else a new site at its position.

    ``wanted``: a site, or a body (its origin), that is fixed to the root. Empty: the site "imu", or the root's origin
    if that site is missing or not fixed to the root. ``model``: the compiled robot.
    Raises ModelError if ``wanted`` does not exist or is not fixed to the root.
    """
    spec, root, name = robot.spec, robot.root, wanted or _IMU
    is_site = spec.site(name) is not None
    if not wanted and not is_site:
        return _add_site(robot, name, np.zeros(3), f"at the origin of '{root}'")
    if not is_site and spec.body(name) is None:
        known = [thing.name for thing in (*spec.sites, *spec.bodies) if thing.name and thing.name != "world"]
        raise ModelError.of(("imu_site", unknown("site or body", name, known, robot.where)))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    base, there = data.body(root), data.site(name) if is_site else data.body(name)
    body = model.body(model.site_bodyid[there.id] if is_site else there.id)
    welded = int(model.body_weldid[body.id])
    if welded != model.body_weldid[base.id]:
        joint = model.joint(int(model.body_jntadr[welded])).name
        beyond = f"'{name}' is on body '{body.name}', which moves against the root '{root}' by joint '{joint}'"
        if wanted:
            instead = "take a site or body that is fixed to the root, or hold that joint by held_joints"
            raise ModelError.of(("imu_site", f"{beyond}, so what it senses is not the root's; {instead}"))
        why = f"at the origin of '{root}': {beyond}; imu_site may name another"
        return _add_site(robot, f"{name}_root", np.zeros(3), why)
    axes = base.xmat.reshape(3, 3).T
    turn = axes @ there.xmat.reshape(3, 3)
    if is_site and body.name == root and np.allclose(turn, np.eye(3), rtol=0.0, atol=_ALIGNED):
        return name
    why = f"at the place of '{name}' on '{body.name}', with the axes of the root '{root}'"
    return _add_site(robot, f"{name}_aligned" if is_site else name, axes @ (there.xpos - base.xpos), why)


def _add_site(robot: RobotFile, name: str, place: np.ndarray, why: str) -> str:
    """Add a site to the root at ``place`` [m, root frame], and return its name."""
    while robot.spec.site(name):
        name += "_"
    robot.spec.body(robot.root).add_site(name=name, pos=place, group=3)
    robot.notes.append(f"site '{name}' made {why}")
    return name
