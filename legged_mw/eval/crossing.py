"""The exam's rough part: on every kind and level of ground, does the robot get from the middle of a tile to its edge?

Told to walk ahead at 0.6 m/s, from a random place near the middle and in a random direction; the ground is the task's own
kinds, built anew with another seed. Nominal robot, no noise, no pushes: the same overrides as the walking exam's.
"""

from __future__ import annotations

from typing import Any

import torch

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval import exam
from legged_mw.eval.rollout import Policy
from legged_mw.sim.terrain import MEASURES
from legged_mw.utils.task import LoadedTask

SPEED, SECONDS = 0.6, 15.0  # [m/s] told; [s] in which the edge must be reached: 9 m at that speed, and the corner is 5.7 m away
LEVELS, REPEATS = 10, 10  # robots on each level of each kind

OVERRIDES: dict[str, Any] = {
    **exam.OVERRIDES,
    "terrain.mesh_type": "heightfield",
    "terrain.curriculum": False,
    "terrain.num_rows": LEVELS,
    "terrain.difficulty": [0.0, 1.0],
    "terrain.border_size": 4.0,
    "terrain.seed": 1000,
    "init_state.pos_xy_range": 0.3,
    "init_state.yaw_range": 3.141592653589793,
}


def prepare(task: LoadedTask, repeats: int = REPEATS) -> None:
    """Turn ``task`` into the rough part; its kinds of ground are those with a share in ``terrain.terrain_proportions``."""
    for path, value in OVERRIDES.items():
        task.set(path, value, where="exam")
    kinds = [kind for kind, share in task.cfg.terrain.terrain_proportions.items() if share > 0]
    task.cfg.terrain.terrain_proportions = dict.fromkeys(kinds, 1.0)
    task.cfg.terrain.num_cols = len(kinds)
    task.cfg.env.num_envs = len(kinds) * LEVELS * repeats


def run_crossing(env: LeggedRobot, policy: Policy) -> dict[str, Any]:
    """Grade ``policy`` in an environment made from a prepared task: shares by kind and level of who crossed, and who fell."""
    assert env.tiles
    kinds, device = env.tiles.kinds, env.device
    repeats = env.num_envs // (len(kinds) * LEVELS)
    levels = torch.arange(env.num_envs, device=device) // repeats % LEVELS
    with torch.random.fork_rng([device] if device.startswith("cuda") else []):
        torch.manual_seed(0)
        env.load_training_state({"terrain_levels": levels})
        env.commands.copy_(torch.tensor([SPEED, 0.0, 0.0], device=device))
        env.compute_observations()
        crossed, fell = (torch.zeros(env.num_envs, dtype=torch.bool, device=device) for _ in range(2))
        over = torch.zeros_like(crossed)
        obs = env.get_observations()
        for _ in range(round(SECONDS / env.dt)):
            with torch.inference_mode():
                actions = policy(obs)
            obs, _, dones, extras = env.step(actions)
            fell |= dones & ~extras["time_outs"] & ~over
            over |= dones
            crossed |= (env.farthest[:, 0] > env.tiles.size / 2) & ~over
            over |= crossed
            env.commands.copy_(torch.tensor([SPEED, 0.0, 0.0], device=device))  # who began anew is told the same, and no longer counts
    shares = {
        name: values.view(len(kinds), LEVELS, repeats).float().mean(dim=2).cpu().numpy().round(3).tolist()
        for name, values in (("crossed", crossed), ("fell", fell))
    }
    return {
        "speed": SPEED,
        "seconds": SECONDS,
        "repeats": repeats,
        "kinds": {
            kind: {
                "measure": MEASURES[kind][0] if kind in MEASURES else None,
                "values": [round(low + (high - low) * i / (LEVELS - 1), 2) for i in range(LEVELS)] if kind in MEASURES else None,
                **{name: share[i] for name, share in shares.items()},
            }
            for i, kind in enumerate(kinds)
            for low, high in [MEASURES[kind][1:] if kind in MEASURES else (0.0, 0.0)]
        },
    }


def table(result: dict[str, Any]) -> str:
    """Shares that crossed, a line a kind, a column a level."""
    lines = [f"crossed a tile at {result['speed']:g} m/s within {result['seconds']:g} s, by level"]
    for name, kind in result["kinds"].items():
        lines.append(f"{name:<16}" + "".join(f"{share:>7.2f}" for share in kind["crossed"]))
        if kind["measure"]:
            lines.append(f"  {kind['measure']:<14}" + "".join(f"{value:>7.4g}" for value in kind["values"]))
    return "\n".join(lines)
