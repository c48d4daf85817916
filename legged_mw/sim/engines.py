"""Choose the engine: ``mujoco_warp`` on a GPU (slow on a CPU), or ``mujoco``, MuJoCo's own engine on CPU threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
from torch import Tensor

from legged_mw.sim.capacity import count_capacity
from legged_mw.sim.simulation import Simulation
from legged_mw.sim.terrain import HeightMap, Terrain
from legged_mw.utils.errors import UserError
from legged_mw.utils.machine import in_bytes, require_memory

ENGINES = ("auto", "mujoco_warp", "mujoco")
# Memory of a world / memory of an MjData, at least. Measured on MuJoCo's own engine: 0.21 (Go1), 0.52 (G1), 1.3 (rough
# ground); on mujoco-warp: 1.1 and 1.3, without its buffers for contacts and rows.
_SHARE = {"mujoco": 0.2, "mujoco_warp": 1.0}


def pick_engine(name: str, device: str) -> str:
    """The engine for ``name``; "auto": MuJoCo's own on a CPU, mujoco-warp on a GPU. Raises UserError."""
    if name == "auto":
        return "mujoco" if device == "cpu" else "mujoco_warp"
    if name == "mujoco" and device != "cpu":
        text = f"the engine mujoco steps on a CPU, and the device is {device}"
        raise UserError(f"{text}; take the device cpu, or the engine mujoco_warp")
    return name


def make_simulation(
    model: mujoco.MjModel,
    num_envs: int,
    device: str,
    *,
    engine: str = "auto",
    nconmax: int = 0,
    njmax: int = 0,
    threads: int = 0,
    world_fields: Sequence[str] = (),
    terrain: Terrain | None = None,
    eager: bool = False,
) -> Simulation:
    """Allocate ``num_envs`` worlds of ``model`` on ``device``.

    ``terrain``: source of the model's height field; on mujoco-warp our own contacts replace those of the field.
    ``nconmax``, ``njmax``: contacts and constraint rows of a world on mujoco-warp; 0: counted (``sim/capacity.py``).
    ``threads``: of MuJoCo's own engine; 0: one per core. ``world_fields``: model fields with a value per world (see
    ``field``). ``eager``: do not record mujoco-warp's kernels on a CPU. Raises UserError if the memory is too small.
    """
    kind = pick_engine(engine, device)
    world, room = _SHARE[kind] * mujoco.MjData(model).nbuffer, ""
    if kind == "mujoco_warp":
        counted = count_capacity(model, terrain is not None)
        nconmax, njmax = nconmax or counted.contacts, njmax or counted.rows
        world += 4 * (njmax * (model.nv + 10) + nconmax * 30)
        room = f" with nconmax = {nconmax}, njmax = {njmax}"
    require_memory(
        num_envs * world, device, f"num_envs = {num_envs}", f"a world takes {in_bytes(world)}{room}; take fewer"
    )
    # imported here, because importing warp takes about 1 s
    if kind == "mujoco":
        from legged_mw.sim.mujoco_engine import MujocoSimulation

        return MujocoSimulation(model, num_envs, threads=threads, world_fields=world_fields)
    from legged_mw.sim.warp_engine import WarpSimulation

    return WarpSimulation(
        model, num_envs, device, nconmax=nconmax, njmax=njmax, world_fields=world_fields, terrain=terrain, eager=eager
    )


def make_height_map(terrain: Terrain, device: str) -> Callable[[Tensor], Tensor]:
    """The faster lookup for ``device``. Both lookups give the same heights."""
    if device == "cpu":
        return HeightMap(terrain, device)
    from legged_mw.sim.ground_contact import HeightLookup  # here, because importing warp takes about 1 s

    return HeightLookup(terrain, device)
