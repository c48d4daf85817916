"""The interface of both physics engines. Code outside of ``sim/`` does not depend on the engine."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

from torch import Tensor

from legged_mw.utils.errors import ModelError, unknown

# MuJoCo computes CONSTANTS from CONSTANTS_READ: if one of the latter has a value per world, the former need one too.
CONSTANTS_READ = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "dof_armature", "qpos0")
CONSTANTS = ("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0")
GRAVITY = "opt.gravity"  # (N, 3) [m/s^2], the one option that may differ between worlds


class Simulation(ABC):
    """``num_envs`` worlds of one model, stepped together.

    Every tensor below stays the same object: read it, write it in place, never rebind it. After ``step``,
    ``qpos`` and ``qvel`` are current; the rest was computed at the start of the last substep, so it is one ``timestep``
    old. After ``reset(mask)`` it is zero in the masked worlds. Writes take effect in the next ``step``.
    """

    engine: str  # "mujoco_warp" or "mujoco"
    num_envs: int
    device: str

    qpos: Tensor  # (N, nq) root position [m, world], quaternion wxyz, joint angles [rad]
    qvel: Tensor  # (N, nv) root linear [m/s, world], root angular [rad/s, body], joints [rad/s]
    ctrl: Tensor  # (N, nu) servo targets [rad], target speeds [rad/s], or torques [N m]
    sensordata: Tensor  # (N, nsensordata) of the last substep
    actuator_force: Tensor  # (N, nu) [N m], clamped, of the last substep
    site_xpos: Tensor  # (N, nsite, 3) [m, world], of the last substep
    xquat: Tensor  # (N, nbody, 4) attitude of each body, (w, x, y, z), body to world, of the last substep
    xfrc_applied: Tensor  # (N, nbody, 6) force [N] and torque [N m], world frame, at the centre of mass; not cleared

    _fields: dict[str, Tensor]  # name of ``world_fields`` -> view

    @abstractmethod
    def step(self, substeps: int = 1, before: Callable[[int], None] | None = None) -> None:
        """Advance all worlds by ``substeps`` time steps, with the current ``ctrl`` and ``xfrc_applied``.

        ``before(k)`` is called before substep k, with the current state; it may write ``ctrl``. A GPU records it.
        """

    @abstractmethod
    def actuator_velocity(self) -> Tensor:
        """(N, nu) speed [rad/s] at the time of ``actuator_force``. Do not call it in a recorded step.

        MuJoCo's own engine fills it only after the first call, so call it once before the first needed step.
        """

    @abstractmethod
    def reset(self, mask: Tensor) -> None:
        """Reset the worlds of ``mask`` (N,) to ``qpos0`` at rest. Derived quantities are zero until the next ``step``.

        Write ``qpos``, ``qvel`` and ``ctrl`` after this call.
        """

    def field(self, name: str) -> Tensor:
        """View (N, ...) of a model field in ``world_fields``; write it in place. Raises ModelError for other fields."""
        if name not in self._fields:
            where = "this simulation (declare it in world_fields)"
            raise ModelError(unknown("per-world model field", name, self._fields, where))
        return self._fields[name]

    @abstractmethod
    def memory(self) -> dict[str, Tensor]:
        """Name -> tensor, for the state, the last sensor values and model fields (``model.<field>``).

        Copy them, or write them into worlds of the same model. If fields changed, then call ``set_constants``.
        """

    @abstractmethod
    def set_constants(self) -> None:
        """Recompute the constants that depend on masses, inertias, armatures and zero angles, in all worlds.

        It is slow. Do not call it in a recorded step.
        """

    @abstractmethod
    def overflowed_worlds(self) -> Tensor:
        """Number of worlds that overflowed the engine's buffers since construction, float (), on the device."""

    @abstractmethod
    def overflow_report(self) -> str:
        """A message on the overflows since construction, or ''. It waits for the device: do not call it in a step."""


def overflow_note(sim: Simulation, what: str) -> str:
    """A warning on ``what`` if contacts or constraints of ``sim`` overflowed, else ''. Waits for the device."""
    report = sim.overflow_report()
    return f"WARNING: {what} is not to be trusted: {report}" if report else ""


def say_overflow(sim: Simulation, what: str) -> bool:
    """Print ``overflow_note``. Returns whether there was one."""
    if note := overflow_note(sim, what):
        print(note, flush=True)
    return bool(note)
