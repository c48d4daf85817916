"""The walking exam: one set of commands and kicks that every joystick policy can be graded by.

Nominal model, no noise, no kicks but the exam's own, mean actions, start at rest in the default pose. It is a set of
config overrides and a roll-out, not a second environment: all tests run side by side as worlds of one environment.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import LoadedTask

OVERRIDES: dict[str, Any] = {
    "env.episode_length_s": 1000.0,  # no time outs
    "noise.level": 0.0,
    "perturbation.enable": False,
    "commands.resampling_time": 0.0,
    "init_state.pos_xy_range": 0.0,
    "init_state.yaw_range": 0.0,
    "init_state.lin_vel_range": 0.0,
    "init_state.ang_vel_range": 0.0,
    "termination.max_tilt": 90.0,  # [deg], a fall
}
SETS = {*OVERRIDES, "env.num_envs"}  # what the exam decides
SECONDS, SETTLING = 10.0, 2.0  # [s] of a tracking command, and of its start that is not counted
KICK_COMMAND, KICK_AT, KICK_UNTIL = 0.8, 3.0, 6.0  # vx [m/s]; [s]
KICK_SPEEDS, KICK_DIRECTIONS = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), 16  # [m/s]
GRAVITY = 9.81  # [m/s^2]

# What the policy that ships with MuJoCo Playground for this robot scores in MuJoCo's C engine under these rules.
PEER: dict[str, Any] = {
    "falls": 0,
    "error": [0.024, 0.031, 0.084],
    "worst": [0.042, 0.063, 0.357],
    "drift": 0.0007,
    "kicks": {"1": 1.0, "2": 1.0, "3": 1.0, "4": 0.81, "5": 0.38, "6": 0.13},
    "cost_of_transport": 0.86,
}
EQUAL_DRIFT = 0.005  # [m], below which drifts count as equal


def commands() -> list[tuple[float, float, float]]:
    """The 22 commands (vx, vy [m/s], yaw rate [rad/s]); the first is to stand."""
    along = [(v, 0.0, 0.0) for v in (0.5, 1.0, 1.5, -0.5, -1.0)]
    across = [(0.0, v, 0.0) for v in (0.4, 0.8, -0.4, -0.8)]
    turning = [(0.0, 0.0, w) for w in (0.6, 1.2, -0.6, -1.2)]
    return [(0.0, 0.0, 0.0), *along, *across, *turning, *product((1.0, -1.0), (0.4, -0.4), (0.6, -0.6))]


def prepare(task: LoadedTask) -> None:
    """Turn ``task`` into the exam: one world a command and one a kick."""
    for path, value in OVERRIDES.items():
        task.set(path, value, where="exam")
    task.cfg.env.num_envs = len(commands()) + len(KICK_SPEEDS) * KICK_DIRECTIONS


def run_exam(env: LeggedRobot, policy: Callable[[TensorDict], Tensor]) -> dict[str, Any]:
    """Grade ``policy`` in an environment made from a prepared task."""
    asked = torch.tensor(commands(), device=env.device)
    kicked = torch.arange(len(asked), env.num_envs, device=env.device)
    env.reset()
    env.commands[: len(asked)] = asked
    env.commands[kicked] = torch.tensor([KICK_COMMAND, 0.0, 0.0], device=env.device)
    env.compute_observations()
    obs = env.get_observations()
    wanted = env.commands.clone()
    fell_at = torch.full((env.num_envs,), math.inf, device=env.device)
    velocity, position, power, joint_speed = [], [], [], []
    steps = round(SECONDS / env.dt)
    for step in range(steps):
        velocity.append(torch.cat([env.base_lin_vel[:, :2], env.base_ang_vel[:, 2:]], dim=1))
        position.append(env.sim.qpos[:, :2].clone())
        power.append((env.torques * env.dof_vel).abs().sum(dim=1))
        joint_speed.append(env.dof_vel.abs().mean(dim=1))
        with torch.inference_mode():
            actions = policy(obs)
        _kick(env, kicked, step)
        obs, _, dones, _ = env.step(actions)
        fell_at = torch.where(dones & (fell_at == math.inf), torch.full_like(fell_at, step), fell_at)
    counted = slice(round(SETTLING / env.dt), None)
    error = (torch.stack(velocity)[counted] - wanted).abs().mean(dim=0)[: len(asked)]  # (22, 3)
    distance = (env.sim.qpos[:, :2] - torch.stack(position)[counted][0]).norm(dim=1)
    energy = torch.stack(power)[counted].sum(dim=0) * env.dt
    stood = torch.isinf(fell_at[: len(asked)])
    ahead = commands().index((1.0, 0.0, 0.0))
    survived = (fell_at[kicked] > round(KICK_UNTIL / env.dt)).view(len(KICK_SPEEDS), KICK_DIRECTIONS).float().mean(dim=1)
    result = {
        "falls": int((~stood).sum()),
        "error": _figures(error[stood].mean(dim=0)) if stood.any() else None,  # None: nothing left to measure, all fell
        "worst": _figures(error[stood].amax(dim=0)) if stood.any() else None,
        "drift": float(distance[0]) if stood[0] else None,
        "joint_speed": float(torch.stack(joint_speed[-50:])[:, 0].mean()) if stood[0] else None,
        "kicks": {f"{speed:g}": round(float(share), 4) for speed, share in zip(KICK_SPEEDS, survived, strict=True)},
        "cost_of_transport": float(energy[ahead] / (env.total_mass * GRAVITY * distance[ahead])) if stood[ahead] else None,
        "commands": [
            {"command": list(c), "error": _figures(e) if ok else None, "fell": not bool(ok)}
            for c, e, ok in zip(commands(), error, stood, strict=True)
        ],
    }
    return {"walks": walks(result), "beats_peer": beats_peer(result), **result}


def _kick(env: LeggedRobot, worlds: Tensor, step: int) -> None:
    """At its step, direction k of every kick speed: the base's horizontal velocity jumps, world frame."""
    k = step - round(KICK_AT / env.dt)
    if 0 <= k < KICK_DIRECTIONS:
        angle = 2 * math.pi * k / KICK_DIRECTIONS
        speed = torch.tensor(KICK_SPEEDS, device=env.device)
        jump = speed[:, None] * torch.tensor([math.cos(angle), math.sin(angle)], device=env.device)
        env.sim.qvel[worlds[k::KICK_DIRECTIONS], :2] += jump


def walks(result: dict[str, Any]) -> bool:
    """No falls, small errors, every kick of 2 m/s survived."""
    if result["falls"]:
        return False
    small = all(error <= most for error, most in zip(result["error"], (0.06, 0.06, 0.12), strict=True))
    return small and result["kicks"]["2"] == 1.0


def beats_peer(result: dict[str, Any]) -> bool:
    """At least as good on each of the peer's figures, better on the errors and the cost of transport."""
    if result["falls"] > PEER["falls"]:
        return False
    better = all(a < b for a, b in zip(result["error"], PEER["error"], strict=True))
    better = better and result["cost_of_transport"] < PEER["cost_of_transport"]
    worst = all(a <= b for a, b in zip(result["worst"], PEER["worst"], strict=True))
    kicks = all(result["kicks"][speed] >= share for speed, share in PEER["kicks"].items())
    return better and worst and kicks and result["drift"] <= max(EQUAL_DRIFT, PEER["drift"])


def table(result: dict[str, Any]) -> str:
    """The result beside the peer's, as text."""
    rows = [("", "this policy", "walks at", "peer")]
    rows.append(("falls in 22 commands", f"{result['falls']}", "0", f"{PEER['falls']}"))
    error, worst = result["error"] or [None] * 3, result["worst"] or [None] * 3
    for i, (name, most) in enumerate((("vx [m/s]", 0.06), ("vy [m/s]", 0.06), ("yaw rate [rad/s]", 0.12))):
        rows.append((f"error {name}", _shown(error[i], 3), f"{most:.2f}", f"{PEER['error'][i]:.3f}"))
        rows.append(("  worst command", _shown(worst[i], 3), "", f"{PEER['worst'][i]:.3f}"))
    rows.append(("drift standing 8 s [m]", _shown(result["drift"], 4), "", f"{PEER['drift']:.4f}"))
    rows.append(("joint speed standing [rad/s]", _shown(result["joint_speed"], 3), "", ""))
    for speed, share in result["kicks"].items():
        rows.append((f"survives kicks of {speed} m/s", f"{share:.2f}", "1.00" if speed == "2" else "", f"{PEER['kicks'][speed]:.2f}"))
    rows.append(("cost of transport at 1 m/s", _shown(result["cost_of_transport"], 2), "", f"{PEER['cost_of_transport']:.2f}"))
    lines = [f"{a:<30}{b:>12}{c:>10}{d:>8}" for a, b, c, d in rows]
    verdict = f"walks: {'yes' if result['walks'] else 'no'}; beats the peer: {'yes' if result['beats_peer'] else 'no'}"
    return "\n".join([*lines, verdict])


def save(result: dict[str, Any], path: Path) -> None:
    """Write the result as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def _shown(value: float | None, digits: int) -> str:
    return "fell" if value is None else f"{value:.{digits}f}"


def _figures(row: Tensor) -> list[float]:
    return [round(value, 5) for value in row.tolist()]
