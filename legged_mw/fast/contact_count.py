"""Count the contacts of sensed geoms with one kernel, instead of mujoco-warp's search, sort and output."""

# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportAssignmentType=false
# pyright: reportArgumentType=false, reportIndexIssue=false, reportAttributeAccessIssue=false
# (mujoco ships no type stubs, and warp compiles this file as its own language)
from __future__ import annotations

from collections.abc import Callable

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from mujoco_warp._src.types import ContactType

wp.set_module_options({"enable_backward": False})

_CONSTRAINT = wp.constant(int(ContactType.CONSTRAINT))  # a contact with a force; others are for sensors only
_FOUND = 1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND)


def countable(model: mujoco.MjModel) -> dict[int, tuple[int, int, int]]:
    """Sensors that only count the contacts of two geoms -> the geoms, and the column in ``sensordata``."""
    sensors, geom = {}, int(mujoco.mjtObj.mjOBJ_GEOM)
    for i in np.flatnonzero(model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT):
        between_geoms = model.sensor_objtype[i] == geom and model.sensor_reftype[i] == geom
        counts = model.sensor_intprm[i, 0] == _FOUND and model.sensor_dim[i] == 1 and not model.sensor_history[i].any()
        if between_geoms and counts:
            sensors[int(i)] = int(model.sensor_objid[i]), int(model.sensor_refid[i]), int(model.sensor_adr[i])
    return sensors


def count_contacts(model: mujoco.MjModel, put: mjw.Model) -> Callable[[mjw.Data], None]:
    """Remove the countable sensors from ``put``, a model on the current device.

    Returns a function that fills them after a step.
    """
    sensors = countable(model)
    left = [int(i) for i in put.sensor_contact_pos_adr.numpy() if int(i) not in sensors]
    put.sensor_contact_pos_adr = wp.array(left, dtype=int)
    table = wp.array([*sensors.values()], dtype=wp.vec3i)

    def count(d: mjw.Data) -> None:
        contact = d.contact
        inputs = [table, contact.geom, contact.worldid, contact.type, d.nacon]
        wp.launch(_count, dim=(contact.geom.shape[0], len(sensors)), inputs=inputs, outputs=[d.sensordata])

    return count


@wp.kernel
def _count(
    wanted: wp.array[wp.vec3i],
    geoms: wp.array[wp.vec2i],
    world: wp.array[int],
    kind: wp.array[int],
    found: wp.array[int],
    sensordata: wp.array2d[float],
):
    contact, sensor = wp.tid()
    if contact >= wp.min(found[0], geoms.shape[0]) or (kind[contact] & _CONSTRAINT) == 0:
        return
    pair, sensed = geoms[contact], wanted[sensor]
    straight = pair[0] == sensed[0] and pair[1] == sensed[1]
    reverse = pair[0] == sensed[1] and pair[1] == sensed[0]
    if straight or reverse:
        wp.atomic_add(sensordata, world[contact], sensed[2], 1.0)
