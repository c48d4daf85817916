"""Which engine steps: ``mujoco_warp`` on a GPU, or on a CPU through warp; ``mujoco``, MuJoCo's own, on a thread pool of the CPU."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco

from legged_mw.sim.capacity import count_capacity
from legged_mw.sim.simulation import Simulation
from legged_mw.sim.terrain import Terrain
from legged_mw.utils.errors import EngineError, unknown
from legged_mw.utils.machine import in_bytes, require_memory

ENGINES = ("auto", "mujoco_warp", "mujoco")
# Bytes of a world, of those of an MjData, at the least: measured 0.21 (a Go1), 0.52 (a G1) and 1.3 (rough ground) on MuJoCo's own
# engine, 1.1 and 1.3 on mujoco-warp, which has its room for contacts and rows besides.
_SHARE = {"mujoco": 0.2, "mujoco_warp": 1.0}


def pick_engine(asked: str, device: str) -> str:
    """The engine that ``asked`` means on ``device``: "auto" is MuJoCo's own on a CPU and mujoco-warp on a GPU."""
    if asked not in ENGINES:
        raise EngineError(unknown("engine", asked, ENGINES, "the list of engines"))
    if asked == "auto":
        return "mujoco" if device == "cpu" else "mujoco_warp"
    if asked == "mujoco" and device != "cpu":
        raise EngineError(
            f"the engine mujoco steps on a CPU, and the device is {device}; take the device cpu, or the engine mujoco_warp"
        )
    return asked


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

    ``terrain`` is what the model's height field was made from: mujoco-warp has our own contacts with it
    (``sim/ground_contact.py``), MuJoCo's own engine those of the model. ``nconmax`` and ``njmax`` are the contacts and
    constraint rows of a world on mujoco-warp, 0: counted (``sim/capacity.py``). ``threads`` are those of MuJoCo's own engine,
    0: one a core. ``world_fields`` names model fields that get a value per world (see ``field``). ``eager`` switches
    mujoco-warp's replay on a CPU off.
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
    # each engine is imported where it steps: importing warp takes a second
    if kind == "mujoco":
        from legged_mw.sim.mujoco_engine import MujocoSimulation

        return MujocoSimulation(model, num_envs, threads=threads, world_fields=world_fields)
    from legged_mw.sim.warp_engine import WarpSimulation

    return WarpSimulation(
        model, num_envs, device, nconmax=nconmax, njmax=njmax, world_fields=world_fields, terrain=terrain, eager=eager
    )
