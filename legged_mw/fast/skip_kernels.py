"""Skip mujoco_warp kernels whose results are not used. The state stays bit-identical.

mujoco_warp launches its kernels through ``warp.launch`` and ``warp.launch_tiled``. While a substep runs or is recorded,
these functions skip the kernels named here, and ``array.zero_`` skips arrays that are already zero. The library is not
changed, and a kernel with an unknown name is launched. ``KNOWN`` lists the tested versions; with another version
nothing is skipped. tests/fast/test_shortcuts.py compares the steps.

Stale after a step: ``qacc_smooth``, the factorized inertia, ``qfrc_constraint``, ``solver_niter``, the overflow bit
ITERATIONS, states of constraint rows. After a substep without sensors also: forces of constraint rows, positions of
sites, the world's centre of mass, ``sensordata``.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import mujoco_warp as mjw
import warp as wp

from legged_mw.fast.contact_count import count_contacts

KNOWN = ("4.0.0",)  # of mujoco-warp
_ALONE = threading.RLock()  # all threads share warp.launch
# the line search of an iteration; the last kernel of a solve
_SEARCH, _SOLVED = "_linesearch_iterative_kernel", "_qfrc_constraint_from_grad"
# kernels after the line search with results that sensors read: forces of constraint rows
_FORCES = ("_zero_change_counters", "_update_constraint_efc")


class Shortcuts:
    """The kernels to skip in steps of one model: ``with shortcuts(sensed): mujoco_warp.step(...)``.

    The line search of the last Newton iteration gives the final acceleration. The library then still computes gradient,
    Hessian and factors for a next iteration; these are skipped.
    """

    def __init__(
        self, mj: mujoco.MjModel, model: mjw.Model, data: mjw.Data, world_fields: Collection[str] = ()
    ) -> None:
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

    @contextmanager
    def __call__(self, sensed: bool, later: bool = False) -> Iterator[None]:
        """``sensed``: this substep computes sensors. ``later``: it directly follows another substep."""
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
                wp.array.zero_ = clear  # pyright: ignore[reportAttributeAccessIssue]
                yield
            finally:
                wp.array.zero_ = zero
                for name, launch in whole.items():
                    setattr(wp, name, launch)


class ShortStep:
    """``mujoco_warp.step`` of one model without the skipped kernels, and with our own kernel that counts contacts."""

    def __init__(
        self, mj: mujoco.MjModel, model: mjw.Model, data: mjw.Data, world_fields: Collection[str] = ()
    ) -> None:
        self._model, self._data = model, data
        self.shortcuts = Shortcuts(mj, model, data, world_fields)
        self._count = count_contacts(mj, model)

    def __call__(self, sensed: bool, later: bool = False) -> None:
        """One substep; see ``Shortcuts.__call__``."""
        with self.shortcuts(sensed, later):
            mjw.step(self._model, self._data)
        if sensed:
            self._count(self._data)


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
