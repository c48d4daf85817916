"""The exam's rough part: on every kind and level of ground, does the robot get from the middle of a tile to its edge?

The command is to walk ahead at 0.6 m/s, from a random place near the middle and in a random direction; the ground is the task's
own kinds, built with another seed. Nominal robot, no noise, no pushes: the same overrides as the walking exam's.
"""

from __future__ import annotations

import math
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval import exam
from legged_mw.eval.rollout import Policy
from legged_mw.eval.rules import LEVELS
from legged_mw.rl.students.recurrent import forget
from legged_mw.sim.terrain import KINDS, MEASURES, measure
from legged_mw.utils.config import ConfigError
from legged_mw.utils.task import LoadedTask

# [m/s] commanded; [s] in which the edge must be reached: 9 m at that speed, and the corner is 5.7 m away
SPEED, SECONDS = 0.6, 15.0
TILES, REPEATS = 2, 5  # tiles of each level, of a slope one goes up and one down; robots on each tile

OVERRIDES: dict[str, Any] = {
    # a trunk in a step is a fall
    **{path: value for path, value in exam.OVERRIDES.items() if path != "termination.min_base_height"},
    "terrain.mesh_type": "heightfield",
    "terrain.curriculum": False,
    "terrain.num_rows": LEVELS,
    "terrain.tile_size": 8.0,  # [m]; what is to be crossed is the same for every task, and so is how steep a step can be:
    "terrain.horizontal_scale": 0.05,  # [m]
    "terrain.difficulty": [0.0, 1.0],
    "terrain.border_size": 4.0,
    "terrain.seed": 1000,
    "init_state.pos_xy_range": 0.3,
    "init_state.yaw_range": math.pi,
}
SETS = {*OVERRIDES, "env.num_envs", "terrain.num_cols"} - {"domain_rand.enable"}  # config fields that it decides itself


def prepare(task: LoadedTask, repeats: int = REPEATS) -> None:
    """Turn ``task`` into the rough part."""
    for path, value in OVERRIDES.items():
        task.set(path, value, where="exam")
    make_room(task, repeats)


def make_room(task: LoadedTask, repeats: int = REPEATS) -> None:
    """Tiles of each kind of ground that has a share in ``terrain.terrain_proportions``, and ``repeats`` robots for each tile."""
    ground = task.cfg.terrain
    kinds = [kind for kind, share in ground.terrain_proportions.items() if share > 0]
    if not kinds:
        raise ConfigError(
            f"terrain.terrain_proportions: no kind of ground has a share above 0; there are: {', '.join(KINDS)}"
        )
    ground.terrain_proportions, ground.num_cols = dict.fromkeys(kinds, 1.0), len(kinds) * TILES
    task.cfg.env.num_envs = ground.num_cols * LEVELS * repeats


def run_crossing(env: LeggedRobot, policy: Policy) -> dict[str, Any]:
    """Grade ``policy`` in an environment made from a prepared task: by kind and level the shares that crossed and that fell."""
    assert env.tiles
    kinds = env.tiles.kinds
    repeats = env.num_envs // (len(kinds) * TILES * LEVELS)  # worlds go kind by kind, column by column, level by level
    with torch.random.fork_rng([env.device] if env.device.startswith("cuda") else []):
        torch.manual_seed(0)
        env.load_training_state({"terrain_levels": torch.arange(env.num_envs) // repeats % LEVELS})
        outcomes = _walk(env, policy, env.tiles.size / 2)
    by_tile = [worlds.view(len(kinds), TILES, LEVELS, repeats).double() for worlds in outcomes]
    crossed, fell = (worlds.mean(dim=(1, 3)).cpu().numpy().round(3).tolist() for worlds in by_tile)
    shares = {kind: {**_measure(kind), "crossed": crossed[i], "fell": fell[i]} for i, kind in enumerate(kinds)}
    return {"speed": SPEED, "seconds": SECONDS, "robots": TILES * repeats, "kinds": shares}


def _walk(env: LeggedRobot, policy: Policy, edge: float) -> tuple[Tensor, Tensor]:
    """Which worlds came ``edge`` [m] away from the middle along x or y, and which fell before that, each (N,)."""
    command = torch.tensor(
        [SPEED, 0.0, 0.0, *(further.default for further in env.command_table[3:])], device=env.device
    )
    crossed, fell, over = (torch.zeros(env.num_envs, dtype=torch.bool, device=env.device) for _ in range(3))
    env.commands.copy_(command)
    obs = env.first_observations()
    forget(policy)
    for _ in range(round(SECONDS / env.dt)):
        with torch.inference_mode():
            actions = policy(obs)
        obs, _, dones, extras = env.step(actions)
        forget(policy, dones)
        fell |= dones & ~extras["time_outs"] & ~over
        over |= dones
        crossed |= (env.max_distance[:, 0] > edge) & ~over
        over |= crossed
        env.commands.copy_(command)  # in a world that was reset too; it no longer counts
    return crossed, fell


def _measure(kind: str) -> dict[str, Any]:
    """What makes a kind hard and its value at each level; None where nothing does."""
    if kind not in MEASURES:
        return {"measure": None, "values": None}
    return {
        "measure": MEASURES[kind][0],
        "values": [round(measure(kind, i / (LEVELS - 1))[1], 2) for i in range(LEVELS)],
    }


def table(result: dict[str, Any]) -> str:
    """Shares that crossed, a line a kind, a column a level; at the end the means over all levels, of those that fell too."""
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
