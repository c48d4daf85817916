"""What is sensed on a robot: the sensors that are added to its file, and where their values lie in ``sensordata``."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import mujoco

from legged_mw.sim.ground import GROUND
from legged_mw.utils.errors import ModelError, unknown

SELF_CONTACT = "self_contacts"  # how many contacts the robot has with itself
ANGULAR_MOMENTUM = "angular_momentum"  # of the whole robot about its centre of mass, world frame [kg m^2/s]
CONTACT_FORCE = "contact_forces"  # of each contact geom: the net force on the ground, world frame [N]
_FOUND, _FORCE = (1 << int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{name}")) for name in ("FOUND", "FORCE"))
_NET = 3  # the contact sensor's reduction: all contacts as one, in the world's frame


def _sense_self_contacts(spec: mujoco.MjSpec, root: str, contact_geoms: Sequence[str]) -> None:
    tree = mujoco.mjtObj.mjOBJ_XBODY
    itself = {"objtype": tree, "objname": root, "reftype": tree, "refname": root, "intprm": [_FOUND, 0, 1]}
    spec.add_sensor(name=SELF_CONTACT, type=mujoco.mjtSensor.mjSENS_CONTACT, **itself)


def _sense_angular_momentum(spec: mujoco.MjSpec, root: str, contact_geoms: Sequence[str]) -> None:
    momentum, body = mujoco.mjtSensor.mjSENS_SUBTREEANGMOM, mujoco.mjtObj.mjOBJ_BODY
    spec.add_sensor(name=ANGULAR_MOMENTUM, type=momentum, objtype=body, objname=root)


def _sense_contact_forces(spec: mujoco.MjSpec, root: str, contact_geoms: Sequence[str]) -> None:
    """The sensors of "contact" sense the force too, so that contacts are searched once."""
    for name in contact_geoms:
        spec.sensor(f"contact/{name}").intprm[:3] = [_FOUND | _FORCE, _NET, 1]


# What is sensed only where it is asked for: name -> what adds a sensor of that name, given the root and the contact geoms.
SENSORS: dict[str, Callable[[mujoco.MjSpec, str, Sequence[str]], None]] = {
    SELF_CONTACT: _sense_self_contacts,
    ANGULAR_MOMENTUM: _sense_angular_momentum,
    CONTACT_FORCE: _sense_contact_forces,
}


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
    """Those of ``SENSORS`` that ``more`` names, behind what ``add_sensors`` added. Both engines compute them once a step."""
    for name, add in SENSORS.items():
        if name in more:
            add(spec, root, contact_geoms)


def sensor_spans(
    model: mujoco.MjModel,
    contact_geoms: Sequence[str],
    velocity_sites: Sequence[str],
    imu: str,
    more: Collection[str],
) -> dict[str, slice]:
    """Columns of sensordata, by group."""
    spans = {
        "contact": _columns(model, [f"contact/{name}" for name in contact_geoms]),
        "linvel": _columns(model, [f"linvel/{name}" for name in velocity_sites]),
        "accelerometer": _columns(model, [f"accelerometer/{imu}"] if imu else []),
    }
    spans |= {name: _columns(model, [name]) for name in SENSORS if name in more and name != CONTACT_FORCE}
    if CONTACT_FORCE in more:
        spans[CONTACT_FORCE] = spans["contact"]  # (contacts, 4), whose first column is the count
        spans["contact"] = slice(spans["contact"].start, spans["contact"].stop, 4)
    return spans


def _columns(model: mujoco.MjModel, sensors: Sequence[str]) -> slice:
    """Those of ``sensors``, which lie one behind the other."""
    if not sensors:
        return slice(0, 0)
    first, last = (model.sensor(name).id for name in (sensors[0], sensors[-1]))
    return slice(int(model.sensor_adr[first]), int(model.sensor_adr[last] + model.sensor_dim[last]))
