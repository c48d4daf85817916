"""What any physics engine promises to those above it, and which of them steps: the seam, written once.

Nothing above ``sim/`` knows which engine it talks to. ``mujoco_warp`` steps on a GPU, or on a CPU through warp; ``mujoco``
is MuJoCo's own engine on a thread pool of the CPU.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import mujoco
from torch import Tensor

from legged_mw.sim.model import unknown
from legged_mw.utils.errors import UserError

if TYPE_CHECKING:
    from legged_mw.sim.terrain import Terrain

ENGINES = ("auto", "mujoco_warp", "mujoco")


# Model fields that others are derived from, and those others: they need a value per world as soon as one of the former has.
CONSTANTS_READ = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "dof_armature", "qpos0")
CONSTANTS = ("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0")


class EngineError(UserError, ValueError):
    """An engine that does not exist, or cannot step where it was asked to."""


class Simulation(Protocol):
    """``num_envs`` worlds of one model, stepped together.

    Every tensor below is fixed for the life of the object: read it, write it in place, never rebind it. After ``step``,
    ``qpos`` and ``qvel`` are current; the rest was computed at the start of the last substep, so it is one ``timestep``
    old. After ``reset(mask)`` it is zero in the masked worlds. What is written is in force from the next ``step``.
    """

    engine: str  # "mujoco_warp" or "mujoco"
    num_envs: int
    device: str

    qpos: Tensor  # (N, nq) root position [m, world], quaternion wxyz, joint angles [rad]
    qvel: Tensor  # (N, nv) root linear [m/s, world], root angular [rad/s, body], joints [rad/s]
    ctrl: Tensor  # (N, nu) servo targets [rad]
    sensordata: Tensor  # (N, nsensordata) of the last substep
    actuator_force: Tensor  # (N, nu) [N m], clamped, of the last substep
    site_xpos: Tensor  # (N, nsite, 3) [m, world], of the last substep
    xfrc_applied: Tensor  # (N, nbody, 6) force [N] and torque [N m], world frame, at the body's centre of mass; persists

    def step(self, substeps: int = 1) -> None:
        """Advance every world by ``substeps`` time steps, with ``ctrl`` and ``xfrc_applied`` as they stand."""
        ...

    def reset(self, mask: Tensor) -> None:
        """Clear the worlds where ``mask`` (N,) bool is true; what is not state is zero until the next ``step``.

        State goes to the model's own ``qpos0``: write the wanted ``qpos``, ``qvel`` and ``ctrl`` after it.
        """
        ...

    def field(self, name: str) -> Tensor:
        """View (N, ...) of a model field that was declared in ``world_fields``; write it in place."""
        ...

    def set_constants(self) -> None:
        """Bring what the model derives from masses, inertias, armatures and zero angles up to date with what was written
        into their fields, in every world. Slow, and not for inside a recorded step.
        """
        ...

    def overflowed_worlds(self) -> Tensor:
        """How many worlds did not fit into the engine's buffers since construction, float (), on the device."""
        ...

    def overflow_report(self) -> str:
        """What did not fit since construction, a line, or '' if all did. Reads the device: not for inside a step."""
        ...


def pick_engine(asked: str, device: str) -> str:
    """The engine that ``asked`` means on ``device``: "auto" is MuJoCo's own on a CPU and mujoco-warp on a GPU."""
    if asked not in ENGINES:
        raise EngineError(unknown("engine", asked, ENGINES, "sim.engine"))
    if asked == "auto":
        return "mujoco" if device == "cpu" else "mujoco_warp"
    if asked == "mujoco" and device != "cpu":
        raise EngineError(f"sim.engine = mujoco steps on a CPU, and the device is {device}; say --device cpu, or --engine mujoco_warp")
    return asked


def make_simulation(
    model: mujoco.MjModel,
    num_envs: int,
    device: str,
    *,
    engine: str = "auto",
    nconmax: int,
    njmax: int,
    threads: int = 0,
    world_fields: Sequence[str] = (),
    terrain: Terrain | None = None,
    eager: bool = False,
) -> Simulation:
    """Allocate ``num_envs`` worlds of ``model`` on ``device``.

    ``terrain`` is what the model's height field was made from: mujoco-warp gets contacts of our own with it
    (``sim/ground_contact.py``), MuJoCo's own engine those of the model.

    ``nconmax`` and ``njmax`` are the contacts and constraint rows a world has room for; MuJoCo's own engine allocates as it
    needs and leaves them aside. ``threads`` are those of MuJoCo's own engine, 0: one a core. ``world_fields`` names model
    fields that get a value per world (see ``field``). ``eager`` switches mujoco-warp's replay on a CPU off.
    """
    if pick_engine(engine, device) == "mujoco":
        from legged_mw.sim.mujoco_engine import MujocoSimulation

        return MujocoSimulation(model, num_envs, threads=threads, world_fields=world_fields)
    from legged_mw.sim.warp_engine import WarpSimulation  # importing warp takes a second: only where it steps

    return WarpSimulation(model, num_envs, device, nconmax=nconmax, njmax=njmax, world_fields=world_fields, terrain=terrain, eager=eager)
