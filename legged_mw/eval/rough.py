"""The rough part of the walking exam: walk from the middle of a tile to its edge, on each kind and level of terrain.

The robot starts near the middle of a tile with a random heading. The command is to walk ahead at 0.6 m/s.
The terrain has the task's kinds, but another seed. The robot is nominal, without noise and pushes: the overrides are
those of the walking exam.
"""

from __future__ import annotations

import math
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval import rollout
from legged_mw.eval.rollout import Policy
from legged_mw.eval.walking import LEVELS
from legged_mw.rl.students.recurrent import forget
from legged_mw.sim.terrain import KINDS, MEASURES, measure
from legged_mw.utils.config import ConfigError
from legged_mw.utils.task import LoadedTask

# Commanded speed [m/s] and time limit [s]. The robot can walk 9 m in that time; a corner is 5.7 m away.
SPEED, SECONDS = 0.6, 15.0
# tiles per kind and level (one slope goes up, one goes down); robots per tile
TILES, REPEATS = 2, 5

OVERRIDES: dict[str, Any] = {
    # the task's limit on the base height stays: a robot whose trunk is inside a step has fallen
    **{path: value for path, value in rollout.OVERRIDES.items() if path != "termination.min_base_height"},
    "terrain.mesh_type": "heightfield",
    "terrain.curriculum": False,
    "terrain.num_rows": LEVELS,
    # the distance and the steepest step are the same for every task
    "terrain.tile_size": 8.0,  # [m]
    "terrain.horizontal_scale": 0.05,  # [m]
    "terrain.difficulty": [0.0, 1.0],
    "terrain.border_size": 4.0,
    "terrain.seed": 1000,
    "init_state.pos_xy_range": 0.3,
    "init_state.yaw_range": math.pi,
}
# config fields that a user may not override
SETS = {*OVERRIDES, "env.num_envs", "terrain.num_cols"} - {"domain_rand.enable"}


def prepare(task: LoadedTask, repeats: int = REPEATS) -> None:
    """Set the exam's overrides, tiles and number of worlds in ``task``."""
    for path, value in OVERRIDES.items():
        task.set(path, value, where="exam")
    make_room(task, repeats)


def make_room(task: LoadedTask, repeats: int = REPEATS) -> None:
    """Set the tiles: all kinds with a share in ``terrain.terrain_proportions``, and ``repeats`` robots per tile."""
    ground = task.cfg.terrain
    kinds = [kind for kind, share in ground.terrain_proportions.items() if share > 0]
    if not kinds:
        raise ConfigError(
            f"terrain.terrain_proportions: no kind of ground has a share above 0; there are: {', '.join(KINDS)}"
        )
    ground.terrain_proportions, ground.num_cols = dict.fromkeys(kinds, 1.0), len(kinds) * TILES
    task.cfg.env.num_envs = ground.num_cols * ground.num_rows * repeats


def run_crossing(env: LeggedRobot, policy: Policy, speed: float = SPEED) -> dict[str, Any]:
    """Grade ``policy`` in the environment of a prepared task: the shares of crossings and falls by kind and level.

    The command is ``speed`` ahead [m/s]; backwards below 0.
    """
    assert env.tiles
    kinds, levels = env.tiles.kinds, env.tiles.num_levels
    repeats = env.num_envs // (len(kinds) * TILES * levels)  # worlds are sorted by kind, column, level
    with rollout.keep_random_state(env.device):
        torch.manual_seed(0)
        env.load_training_state({"terrain_levels": torch.arange(env.num_envs) // repeats % levels})
        outcomes = _walk(env, policy, env.tiles.size / 2, speed)
    by_tile = [worlds.view(len(kinds), TILES, levels, repeats).double() for worlds in outcomes]
    crossed, fell = (worlds.mean(dim=(1, 3)).cpu().numpy().round(3).tolist() for worlds in by_tile)
    shares = {kind: {**_measure(kind), "crossed": crossed[i], "fell": fell[i]} for i, kind in enumerate(kinds)}
    return {"speed": speed, "seconds": SECONDS, "robots": TILES * repeats, "kinds": shares}


def _walk(env: LeggedRobot, policy: Policy, edge: float, speed: float) -> tuple[Tensor, Tensor]:
    """Two masks (N,): worlds that moved ``edge`` [m] from the middle in x or y, and worlds that fell before."""
    command = torch.tensor([speed, 0.0, 0.0, *(other.default for other in env.command_table[3:])], device=env.device)
    crossed, fell, done = (torch.zeros(env.num_envs, dtype=torch.bool, device=env.device) for _ in range(3))
    env.commands.copy_(command)
    obs = env.first_observations()
    forget(policy)
    for _ in range(round(SECONDS / env.dt)):
        with torch.inference_mode():
            actions = policy(obs)
        obs, _, dones, extras = env.step(actions)
        forget(policy, dones)
        fell |= dones & ~extras["time_outs"] & ~done
        done |= dones
        crossed |= (env.max_distance[:, 0] > edge) & ~done
        done |= crossed
        env.commands.copy_(command)  # a reset draws new commands; worlds that were reset do not count
    return crossed, fell


def _measure(kind: str) -> dict[str, Any]:
    """The measure of difficulty of a kind and its value at each level; None if there is none."""
    if kind not in MEASURES:
        return {"measure": None, "values": None}
    return {
        "measure": MEASURES[kind][0],
        "values": [round(measure(kind, i / (LEVELS - 1))[1], 2) for i in range(LEVELS)],
    }


def table(result: dict[str, Any]) -> str:
    """A text table of the shares of crossings: a line per kind, a column per level, then the mean shares and falls."""
    kinds = result["kinds"]
    lines = [
        f"share of {result['robots']} robots that crossed a tile at {result['speed']:g} m/s within {result['seconds']:g} s"
    ]
    lines.append(f"{'level':<16}" + "".join(f"{level:>7}" for level in range(LEVELS)) + f"{'mean':>9}{'fell':>7}")
    for name, kind in kinds.items():
        crossed = "".join(f"{share:>7.2f}" for share in kind["crossed"])
        lines.append(f"{name:<16}{crossed}{fmean(kind['crossed']):>9.2f}{fmean(kind['fell']):>7.2f}")
        if kind["measure"]:
            lines.append(f"  {kind['measure']:<14}" + "".join(f"{value:>7.3g}" for value in kind["values"]))
    crossed, fell = (fmean(share for kind in kinds.values() for share in kind[which]) for which in ("crossed", "fell"))
    lines.append(f"{'all':<16}{'':{7 * LEVELS}}{crossed:>9.2f}{fell:>7.2f}")
    return "\n".join(lines)
