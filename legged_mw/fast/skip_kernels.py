"""Skip mujoco_warp kernels whose results are not used. The state stays bit-identical.

mujoco_warp launches its kernels through ``warp.launch`` and ``warp.launch_tiled``. While a substep runs or is recorded,
these functions skip the kernels named here, and ``array.zero_`` skips arrays that are already zero. The library is not
changed, and a kernel with an unknown name is launched. ``KNOWN`` lists the tested versions; with another version
nothing is skipped. tests/fast/test_shortcuts.py compares the steps.

Stale after a step: ``qacc_smooth``, the factorized inertia, ``qfrc_constraint``, ``solver_niter``, the overflow bit
ITERATIONS, states of constraint rows. After a substep without sensors also: forces of constraint rows, positions of
sites, the world's centre of mass, ``sensordata``.
"""

# pyright: reportGeneralTypeIssues=false, reportCallIssue=false, reportAssignmentType=false
# pyright: reportArgumentType=false, reportIndexIssue=false, reportAttributeAccessIssue=false
# (mujoco ships no type stubs, and warp compiles this file as its own language)
from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from mujoco_warp._src.types import ContactType

wp.set_module_options({"enable_backward": False})

KNOWN = ("4.0.0",)  # of mujoco-warp
_ALONE = threading.RLock()  # all threads share warp.launch
# the line search of an iteration; the last kernel of a solve
_SEARCH, _SOLVED = "_linesearch_iterative_kernel", "_qfrc_constraint_from_grad"
# kernels after the line search with results that sensors read: forces of constraint rows
_FORCES = ("_zero_change_counters", "_update_constraint_efc")
_CONSTRAINT = wp.constant(int(ContactType.CONSTRAINT))  # a contact with a force; others are for sensors only
_FOUND = 1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND)


class ShortStep:
    """``mujoco_warp.step`` of one model without the skipped kernels, and with our own kernel that counts contacts.

    The line search of the last Newton iteration gives the final acceleration. The library then still computes gradient,
    Hessian and factors for a next iteration; these are skipped.
    """

    def __init__(
        self, mj: mujoco.MjModel, model: mjw.Model, data: mjw.Data, world_fields: Collection[str] = ()
    ) -> None:
        self._model, self._data, self._count = model, data, count_contacts(mj, model)
        option, kinds = model.opt, mujoco.mjtSensor
        known = mjw.__version__ in KNOWN
        # a world without constraint rows gets the same acceleration from its first iteration, up to float32 rounding
        if known:
            option.run_qacc_smooth = False
        plain = (
            option.solver == mjw.SolverType.NEWTON
            and option.cone == mjw.ConeType.PYRAMIDAL
            and not option.noslip_iterations
        )
        plain = (
            plain and not option.enableflags & mjw.EnableBit.SLEEP and option.integrator != mjw.IntegratorType.DISCRETE
        )
        self._iterations = option.iterations if known and plain and not option.graph_conditional else 0
        self._idle, self._idle_unsensed, self._idle_later = set(), set(), set()
        self._zero: set[int] = set()  # addresses of arrays that stay zero but are cleared in every substep
        self._sensordata = data.sensordata.ptr
        if not known:
            return
        sensors, joints_alone = set(mj.sensor_type), set(mj.actuator_trntype) <= {int(mujoco.mjtTrn.mjTRN_JOINT)}
        self._idle_later.add("_cacc_world")  # gravity, which does not change
        self._idle_unsensed.add("_subtree_com_world")
        if not mj.body_gravcomp.any() and "body_gravcomp" not in world_fields:
            self._idle.add("_gravity_force")
            self._zero.add(data.qfrc_gravcomp.ptr)
            if not mj.jnt_actfrclimited.any():
                self._idle.add("_qfrc_actuator_gravcomp_limits")
        if not mj.na:
            self._idle.add("_next_activation")
        if not {int(kinds.mjSENS_FORCE), int(kinds.mjSENS_TORQUE)} & sensors:
            self._idle.add("_cfrc_world")
        if (
            not {int(kinds.mjSENS_E_POTENTIAL), int(kinds.mjSENS_E_KINETIC)} & sensors
            and not option.enableflags & mjw.EnableBit.ENERGY
        ):
            self._zero.add(data.energy.ptr)
        # contact sensors without reduction, or with the net force
        if set(mj.sensor_intprm[mj.sensor_type == kinds.mjSENS_CONTACT, 1]) <= {0, 3}:
            self._idle.add("_contact_sort")
        if not mj.ntendon and not mj.neq and joints_alone:
            self._idle_unsensed.add("_site_local_to_global")
        if self._iterations == 1:  # only the convergence test and later iterations use its result
            self._idle.add("_update_gradient_zero_grad_dot")

    def __call__(self, sensed: bool, later: bool = False) -> None:
        """One substep. ``sensed``: it computes sensors. ``later``: it directly follows another substep."""
        with self._skipping(sensed, later):
            mjw.step(self._model, self._data)
        if sensed:
            self._count(self._data)

    @contextmanager
    def _skipping(self, sensed: bool, later: bool) -> Iterator[None]:
        """A context in which warp launches only the kernels that this substep needs."""
        idle = self._idle | (set() if sensed else self._idle_unsensed) | (self._idle_later if later else set())
        skip = _Skip(idle, self._iterations, _FORCES if sensed else ())
        zero = wp.array.zero_
        kept = self._zero if sensed or not self._zero else self._zero | {self._sensordata}
        with _ALONE:
            whole = {name: getattr(wp, name) for name in ("launch", "launch_tiled")}

            def clear(array: wp.array) -> None:
                if array.ptr not in kept:
                    zero(array)

            try:
                for name, launch in whole.items():
                    setattr(wp, name, skip.around(launch))
                wp.array.zero_ = clear
                yield
            finally:
                wp.array.zero_ = zero
                for name, launch in whole.items():
                    setattr(wp, name, launch)


class _Skip:
    """Decides which launches of one step are skipped."""

    def __init__(self, idle: Collection[str], iterations: int, keep: Collection[str]) -> None:
        self._idle, self._iterations, self._keep = idle, iterations, keep
        self._searches = 0  # number of line searches in the current solve

    def __contains__(self, kernel: str) -> bool:
        if kernel in self._idle:
            return True
        after = self._iterations and self._searches == self._iterations
        if kernel == _SEARCH:
            self._searches += 1
        elif kernel == _SOLVED:
            self._searches = 0
        return bool(after) and kernel not in self._keep

    def around(self, launch: Callable[..., Any]) -> Callable[..., Any]:
        def launch_unless_skipped(kernel: wp.Kernel, *args: Any, **kwargs: Any) -> Any:
            name = kernel.key.partition("__locals__")[0]  # name of the function that makes the kernel
            return None if name in self else launch(kernel, *args, **kwargs)

        return launch_unless_skipped


# ---- contacts of sensed geoms: one kernel instead of the library's search, sort and output -------------------------


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
