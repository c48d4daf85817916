"""The sensors that are added to a robot, and their columns in ``sensordata``."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import mujoco

from legged_mw.sim.ground import GROUND
from legged_mw.utils.errors import ModelError, unknown

SELF_CONTACT = "self_contacts"  # number of contacts of the robot with itself
ANGULAR_MOMENTUM = "angular_momentum"  # of the whole robot about its centre of mass, world frame [kg m^2/s]
CONTACT_FORCE = "contact_forces"  # net force of each contact geom on the ground, world frame [N]
_SENS, _OBJ = mujoco.mjtSensor, mujoco.mjtObj
_FOUND, _FORCE = (1 << int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{name}")) for name in ("FOUND", "FORCE"))
_NET = 3  # reduction of the contact sensor: net force of all contacts, world frame


def _sense_self_contacts(spec: mujoco.MjSpec, root: str, contact_geoms: Sequence[str]) -> None:
    tree = _OBJ.mjOBJ_XBODY
    itself = {"objtype": tree, "objname": root, "reftype": tree, "refname": root, "intprm": [_FOUND, 0, 1]}
    spec.add_sensor(name=SELF_CONTACT, type=_SENS.mjSENS_CONTACT, **itself)


def _sense_angular_momentum(spec: mujoco.MjSpec, root: str, contact_geoms: Sequence[str]) -> None:
    body = {"objtype": _OBJ.mjOBJ_BODY, "objname": root}
    spec.add_sensor(name=ANGULAR_MOMENTUM, type=_SENS.mjSENS_SUBTREEANGMOM, **body)


def _sense_contact_forces(spec: mujoco.MjSpec, root: str, contact_geoms: Sequence[str]) -> None:
    """Let the sensors "contact/..." also measure the force, so that contacts are searched only once."""
    for name in contact_geoms:
        spec.sensor(f"contact/{name}").intprm[:3] = [_FOUND | _FORCE, _NET, 1]


# Sensors on demand: name -> function that adds the sensor, with arguments spec, root and contact geoms.
SENSORS: dict[str, Callable[[mujoco.MjSpec, str, Sequence[str]], None]] = {
    SELF_CONTACT: _sense_self_contacts,
    ANGULAR_MOMENTUM: _sense_angular_momentum,
    CONTACT_FORCE: _sense_contact_forces,
}


def add_sensors(
    spec: mujoco.MjSpec, contact_geoms: Sequence[str], velocity_sites: Sequence[str], imu: str, where: str
) -> None:
    """Add contact sensors of geoms, velocity sensors of sites and the accelerometer. Raises ModelError."""
    sites = [site.name for site in spec.sites if site.name]
    for name in (*velocity_sites, *([imu] if imu else [])):
        if name not in sites:
            raise ModelError(unknown("site", name, sites, where))
    geom, site = _OBJ.mjOBJ_GEOM, _OBJ.mjOBJ_SITE
    with_ground = {"type": _SENS.mjSENS_CONTACT, "reftype": geom, "refname": GROUND}
    for name in contact_geoms:
        data = [_FOUND, 0, 1]  # data, no reduction, one slot
        spec.add_sensor(name=f"contact/{name}", objtype=geom, objname=name, intprm=data, **with_ground)
    for name in velocity_sites:
        spec.add_sensor(name=f"linvel/{name}", type=_SENS.mjSENS_FRAMELINVEL, objtype=site, objname=name)
    if imu:
        spec.add_sensor(name=f"accelerometer/{imu}", type=_SENS.mjSENS_ACCELEROMETER, objtype=site, objname=imu)


def add_more_sensors(spec: mujoco.MjSpec, root: str, contact_geoms: Sequence[str], more: Collection[str]) -> None:
    """Add the sensors of ``SENSORS`` in ``more``, after ``add_sensors``. Both engines compute them once per step."""
    for name, add in SENSORS.items():
        if name in more:
            add(spec, root, contact_geoms)


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
