"""What is sensed on a robot: the sensors that are added to its file, and where their values lie in ``sensordata``."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Collection, Sequence

import mujoco
import numpy as np

from legged_mw.sim.errors import ModelError
from legged_mw.sim.ground import GROUND
from legged_mw.utils.errors import unknown

# What is sensed only where it is asked for, each as the span of its name. The first widens the sensors of "contact".
CONTACT_FORCE = "contact_force"  # of each contact geom: the net force on the ground, world frame [N]
SELF_CONTACT = "self_contact"  # how many contacts the robot has with itself
ANGULAR_MOMENTUM = "angular_momentum"  # of the whole robot about its centre of mass, world frame [kg m^2/s]
_FOUND, _FORCE = (1 << int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{name}")) for name in ("FOUND", "FORCE"))
_NET = 3  # the contact sensor's reduction: all contacts as one, in the world's frame


def add_sensors(
    spec: mujoco.MjSpec, contact_geoms: Sequence[str], velocity_sites: Sequence[str], imu: str, where: str
) -> None:
    """In an order that makes each group one span of sensordata."""
    sites = [s.name for s in spec.sites if s.name]
    for name in contact_geoms:
        spec.add_sensor(
            name=f"contact/{name}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_GEOM,
            objname=name,
            reftype=mujoco.mjtObj.mjOBJ_GEOM,
            refname=GROUND,
            intprm=[_FOUND, 0, 1],  # data, no reduction, one slot
        )
    for name in [*velocity_sites, *([imu] if imu else [])]:
        if name not in sites:
            raise ModelError(unknown("site", name, sites, where))
    site = mujoco.mjtObj.mjOBJ_SITE
    for name in velocity_sites:
        spec.add_sensor(name=f"linvel/{name}", type=mujoco.mjtSensor.mjSENS_FRAMELINVEL, objtype=site, objname=name)
    if imu:
        spec.add_sensor(
            name=f"accelerometer/{imu}", type=mujoco.mjtSensor.mjSENS_ACCELEROMETER, objtype=site, objname=imu
        )


def add_more_sensors(spec: mujoco.MjSpec, root: str, contact_geoms: Sequence[str], more: Collection[str]) -> None:
    """What of ``more`` is asked for, behind what ``add_sensors`` added. Both engines compute it, once a step."""
    if CONTACT_FORCE in more:
        for name in contact_geoms:  # one sensor senses both, so that contacts are searched once
            spec.sensor(f"contact/{name}").intprm[:3] = [_FOUND | _FORCE, _NET, 1]
    tree = mujoco.mjtObj.mjOBJ_XBODY
    if SELF_CONTACT in more:
        itself = {"objtype": tree, "objname": root, "reftype": tree, "refname": root, "intprm": [_FOUND, 0, 1]}
        spec.add_sensor(name=SELF_CONTACT, type=mujoco.mjtSensor.mjSENS_CONTACT, **itself)
    if ANGULAR_MOMENTUM in more:
        momentum = mujoco.mjtSensor.mjSENS_SUBTREEANGMOM
        spec.add_sensor(name=ANGULAR_MOMENTUM, type=momentum, objtype=mujoco.mjtObj.mjOBJ_BODY, objname=root)


def sensor_spans(
    mj: mujoco.MjModel, contacts: int, velocities: int, imu: bool, more: Collection[str]
) -> dict[str, slice]:
    """Columns of sensordata, by group. The sensors that were added last lie last."""
    wide = 4 if CONTACT_FORCE in more else 1  # columns a contact geom: contacts found, and their force
    sizes = {"contact": wide * contacts, "linvel": 3 * velocities, "accelerometer": 3 if imu else 0}
    sizes |= {name: size for name, size in ((SELF_CONTACT, 1), (ANGULAR_MOMENTUM, 3)) if name in more}
    ends = mj.nsensordata - sum(sizes.values()) + np.cumsum(list(sizes.values()))
    spans = {name: slice(int(end) - size, int(end)) for (name, size), end in zip(sizes.items(), ends, strict=True)}
    if CONTACT_FORCE in more:
        spans[CONTACT_FORCE] = spans["contact"]  # (contacts, 4), whose first column is the count
        spans["contact"] = slice(spans["contact"].start, spans["contact"].stop, wide)
    return spans
