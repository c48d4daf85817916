"""Run the walking exam in the training environment and record signals.

A case is a sequence of commands and an optional push. Each case runs once, in its own world. The exam, the report and
the exam during training differ only in their cases and signals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.envs.robot_task import RobotTask
from legged_mw.eval import figures
from legged_mw.eval.figures import Record
from legged_mw.eval.walking import EXAM_SECONDS, PUSH_AT, PUSH_DIRECTIONS, PUSH_UNTIL, SETTLING, ExamRules, Velocity
from legged_mw.rl.students.estimator import believed_velocity
from legged_mw.rl.students.recurrent import forget, with_own_state
from legged_mw.sim.joints import family
from legged_mw.sim.servos import CURVE
from legged_mw.sim.simulation import say_overflow
from legged_mw.utils.task import LoadedTask, load_task

Policy = Callable[[TensorDict], Tensor]  # a recurrent policy is an rsl-rl network
Signal = Callable[[Any], Tensor]  # environment -> one value per world, (N, ...)


class Push(NamedTuple):
    """An instant change of the base's horizontal velocity, after the policy acts in control step ``step``."""

    step: int  # [control steps]
    speed: float  # [m/s]
    angle: float  # [rad] world frame, from the x axis


class Case(NamedTuple):
    """The commands and the push of one world."""

    # (first control step, values of the first commands in the task's table); other commands keep their defaults
    commands: tuple[tuple[int, tuple[float, ...]], ...]
    push: Push | None = None


def holding(command: tuple[float, ...], push: Push | None = None) -> Case:
    """A case with one constant command."""
    return Case(((0, command),), push)


def roll_out(
    env: RobotTask,
    policy: Policy,
    cases: Sequence[Case],
    steps: int,
    signals: Mapping[str, Signal],
    alone: int | None = None,
) -> Record:
    """Run each case in its own world for ``steps`` control steps.

    The first ``alone`` worlds are a separate batch, so their actions do not depend on the other worlds.
    """
    env.reset()
    timeline = _timeline(cases, steps, [command.default for command in env.command_table])
    requested, pushes = torch.tensor(timeline, dtype=torch.float, device=env.device), _pushes_by_step(cases, env.device)
    commands = getattr(env, "commands", requested[0])  # a task without commands has no buffer
    commands.copy_(requested[0])
    obs, actor = env.first_observations(), _Actor(policy, env.num_envs, alone)
    fell_at, recorded = torch.full((env.num_envs,), math.inf, device=env.device), dict[str, Tensor]()
    for step in range(steps):
        sampled = {name: signal(env) for name, signal in signals.items()} | actor.believed(obs)
        for name, value in sampled.items():
            if name not in recorded:
                recorded[name] = torch.empty(steps, *value.shape, dtype=value.dtype, device=value.device)
            recorded[name][step] = value
        actions = actor.act(obs)
        if step in pushes:
            worlds, jumps = pushes[step]
            env.root_lin_vel[worlds, :2] += jumps
        # set the next command before the step, because the observation at the end of the step contains it
        if step + 1 < steps:
            commands.copy_(requested[step + 1])
        obs, _, dones, _ = env.step(actions)
        actor.forget(dones)
        fell_at = torch.where(dones & (fell_at == math.inf), torch.full_like(fell_at, step), fell_at)
    say_overflow(env.sim, "this exam")
    return Record(
        dt=env.dt,
        mass=env.total_mass,
        commands=timeline,
        fell_at=fell_at.cpu().numpy(),
        last_position=env.root_pos[:, :2].cpu().numpy().copy(),
        signals={name: values.cpu().numpy() for name, values in recorded.items()},
    )


def keep_random_state(device: str) -> AbstractContextManager[None]:
    """Restore the state of the random generators at the end of the ``with`` block."""
    return torch.random.fork_rng([device] if device.startswith("cuda") else [])


class _Actor:
    """A policy for all worlds. The first ``alone`` worlds are a separate batch: rounding depends on the batch size."""

    def __init__(self, policy: Policy, worlds: int, alone: int | None) -> None:
        forget(policy)
        self._parts = [(policy, slice(alone or worlds))]
        if alone not in (None, worlds):
            self._parts.append((with_own_state(policy), slice(alone, worlds)))

    def act(self, obs: TensorDict) -> Tensor:
        """The actions (N, A)."""
        with torch.inference_mode():
            return torch.cat([policy(obs[worlds]) for policy, worlds in self._parts])

    def believed(self, obs: TensorDict) -> dict[str, Tensor]:
        """The signal "estimate" (N, 2): estimated vx, vy [m/s]. Empty if the policy has no velocity estimator."""
        with torch.inference_mode():
            estimates = [
                value for policy, worlds in self._parts if (value := believed_velocity(policy, obs[worlds])) is not None
            ]
        return {"estimate": torch.cat(estimates)} if estimates else {}

    def forget(self, ended: Tensor) -> None:
        """Reset the memory of a recurrent policy in the worlds of the mask ``ended`` (N,)."""
        for policy, worlds in self._parts:
            forget(policy, ended[worlds])


def _timeline(cases: Sequence[Case], steps: int, default: Sequence[float]) -> NDArray[Any]:
    """The command of each world at each step, (T, N, C)."""
    timeline = np.tile(np.array(default, dtype=float), (steps, len(cases), 1))
    for world, case in enumerate(cases):
        for step, command in case.commands:
            timeline[step:, world, : len(command)] = command
    return timeline


def _pushes_by_step(cases: Sequence[Case], device: str) -> dict[int, tuple[Tensor, Tensor]]:
    """Control step -> pushed worlds (M,) and the changes of their velocity (M, 2) [m/s], horizontal, world frame."""
    pushed, by_step = [(world, case.push) for world, case in enumerate(cases) if case.push], {}
    for step in {push.step for _, push in pushed}:
        at_step = [(world, push) for world, push in pushed if push.step == step]
        speeds = torch.tensor([[push.speed] for _, push in at_step], device=device)
        directions = torch.tensor([[math.cos(push.angle), math.sin(push.angle)] for _, push in at_step], device=device)
        by_step[step] = torch.tensor([world for world, _ in at_step], device=device), speeds * directions
    return by_step


# ---- the exam: nominal robot, no noise, mean actions; each world starts at rest in the default pose


OVERRIDES: dict[str, Any] = {
    "env.episode_length_s": 1000.0,  # no time outs
    "noise.level": 0.0,
    "perturbation.kick": False,
    "perturbation.push": False,
    "domain_rand.enable": False,
    "terrain.mesh_type": "plane",
    "commands.curriculum": False,
    "commands.resampling_time": 0.0,
    "init_state.dof_pos_range": [1.0, 1.0],
    "init_state.dof_pos_offset": [0.0, 0.0],
    "init_state.dof_vel_range": 0.0,
    "gait.random_start": False,
    "init_state.pos_xy_range": 0.0,
    "init_state.yaw_range": 0.0,
    "init_state.lin_vel_range": 0.0,
    "init_state.ang_vel_range": 0.0,
    "termination.max_tilt": 90.0,  # [deg]; only a larger tilt is a fall
    "termination.min_base_height": 0.0,
}
# Config fields that a user may not override. A user may enable domain randomization, to grade other robots.
SETS = {*OVERRIDES, "env.num_envs"} - {"domain_rand.enable"}

SIGNALS: dict[str, Signal] = {
    # at the IMU, body frame
    "velocity": lambda env: torch.cat([env.base_lin_vel[:, :2], env.base_ang_vel[:, 2:]], dim=1),
    "position": lambda env: env.root_pos[:, :2],  # [m, world]
    "power": lambda env: (env.torques * env.dof_vel).abs().sum(dim=1),  # [W]
    "joint_speed": lambda env: env.dof_vel.abs().mean(dim=1),  # [rad/s]
}


def prepare(task: LoadedTask, worlds: int | None = None) -> None:
    """Set the exam's overrides and number of worlds in ``task``. Default: one world per command and per push."""
    for path, value in OVERRIDES.items():
        task.set(path, value, where="exam")
    task.cfg.env.num_envs = worlds or ExamRules.from_config(task.cfg).worlds()


def cases(rules: ExamRules, dt: float, push_at: float | None = None) -> list[Case]:
    """The cases of the exam in the order of ``ExamRules.grade``. The first pushes are at ``push_at`` [s]."""
    at = PUSH_AT if push_at is None else push_at
    return [*map(holding, rules.held()), *pushes(rules, (rules.push_vx, 0.0, 0.0), round(at / dt))]


def pushes(rules: ExamRules, command: Velocity, step: int) -> list[Case]:
    """One case per push speed and direction. The push in direction k is at control step ``step`` + k."""
    angles = [2 * math.pi * k / PUSH_DIRECTIONS for k in range(PUSH_DIRECTIONS)]
    return [
        holding(command, Push(step + k, speed, angle)) for speed in rules.push_speeds for k, angle in enumerate(angles)
    ]


def run_exam(env: LeggedRobot, policy: Policy) -> dict[str, Any]:
    """Grade ``policy`` in the environment of a prepared task."""
    rules = ExamRules.from_config(env.cfg)
    return grade(rules, roll_out(env, policy, cases(rules, env.dt), round(EXAM_SECONDS / env.dt), SIGNALS))


def grade(rules: ExamRules, record: Record) -> dict[str, Any]:
    """Grade a record of the exam's worlds by ``rules``."""
    return rules.grade(
        record.signals, last_position=record.last_position, fell_at=record.fell_at, mass=record.mass, dt=record.dt
    )


# ---- the report's cases: the exam's cases, then others. All commands are in the trained ranges


GRID = (13, 9, 9)  # number of values of vx, vy, yaw rate
STEP_SHARE = 2 / 3  # command of a step response, as a share of the range's limit
STEPS_AT = (2.5, 5.0, 7.5)  # [s]: reverse, stop, start again
# [s] The first of 8 worlds starts to walk at STEP_BEGINS, each next world STEP_SHIFT later.
# So the command changes at a different gait phase in each world.
STEP_BEGINS, STEP_REPEATS, STEP_SHIFT = 0.2, 8, 0.06
NAMES = ("vx", "vy", "yaw")


class Plan(NamedTuple):
    """All cases, the slice of each part, and the grid values."""

    cases: list[Case]
    parts: dict[str, slice]  # "commands", "transport" and "pushes" belong to the exam
    axes: dict[str, list[float]]  # grid values of vx, vy [m/s], yaw [rad/s]


def make_plan(cfg: LeggedRobotCfg, dt: float) -> Plan:
    """All cases of a report on a policy that was trained with ``cfg``.

    The exam's worlds come first, so their result equals that of the exam alone.
    """
    ranges = cfg.commands.ranges
    limits = (ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw)
    axes = [np.unique(np.linspace(low, high, n).round(3)).tolist() for (low, high), n in zip(limits, GRID, strict=True)]
    nearest = [min(max(0.0, low), high) for low, high in limits]  # zero, or the nearest value in the range
    rules = ExamRules.from_config(cfg)
    exams, commands, held = cases(rules, dt), len(rules.commands()), len(rules.held())
    groups = {
        "commands": exams[:commands],
        "transport": exams[commands:held],  # empty if the command is one of the 22
        "pushes": exams[held:],
        "vx_yaw": [holding((vx, nearest[1], yaw)) for yaw in axes[2] for vx in axes[0]],
        "vx_vy": [holding((vx, vy, nearest[2])) for vy in axes[1] for vx in axes[0]],
        **{f"step_{name}": _stepping(i, limits[i], dt) for i, name in enumerate(NAMES)},
        "standing_pushes": pushes(rules, (0.0, 0.0, 0.0), round(PUSH_AT / dt)),
    }
    parts, start = {}, 0
    for name, group in groups.items():
        parts[name] = slice(start, start := start + len(group))
    return Plan([case for group in groups.values() for case in group], parts, dict(zip(NAMES, axes, strict=True)))


def _stepping(axis: int, limits: list[float], dt: float) -> list[Case]:
    """Cases of a step response on one axis: stand, walk, reverse, stand, walk. Each next world starts to walk later."""
    stand: Velocity = (0.0, 0.0, 0.0)
    low, high = ((*stand[:axis], round(STEP_SHARE * limit, 2), *stand[axis + 1 :]) for limit in limits)
    begins = [round((STEP_BEGINS + i * STEP_SHIFT) / dt) for i in range(STEP_REPEATS)]
    reverse, stop, again = (round(at / dt) for at in STEPS_AT)
    return [Case(((0, stand), (begin, high), (reverse, low), (stop, stand), (again, high))) for begin in begins]  # type: ignore[arg-type]


# ---- the report's figures


GAIT_SECONDS = ESTIMATE_SECONDS = 2.0  # [s] plotted of each command in the gait diagram and the estimator's plot
BEFORE_STEP = 0.5  # [s] plotted before a step of the command

REPORT_SIGNALS: dict[str, Signal] = {
    **SIGNALS,
    "contact": lambda env: env.foot_contact,  # (N, F)
    "dof_pos": lambda env: env.dof_pos,  # (N, D) [rad]
    "dof_vel": lambda env: env.dof_vel,  # (N, D) [rad/s]
    "torque": lambda env: env.torques,  # (N, D) [N m], one simulation step old
    "motor_speed": lambda env: env.sim.actuator_velocity(),  # (N, D) [rad/s], at the time of the torque
    "reward": lambda env: env.episode_sums,  # (N, K), sum of scale * term * dt since the start
}


def make_room(task: LoadedTask) -> None:
    """Set the report's number of worlds. It depends on the command ranges."""
    task.cfg.env.num_envs = len(make_plan(task.cfg, task.cfg.sim.dt * task.cfg.control.decimation).cases)


def ask_alike(tasks: Sequence[LoadedTask]) -> None:
    """Set the exam rules of the first prepared task in the others, even if their trained ranges differ."""
    first, *others = (ExamRules.from_config(task.cfg) for task in tasks)
    for task, own in zip(tasks[1:], others, strict=True):
        if own != first:
            task.update({"exam": first.to_mapping()}, where="--compare")
            make_room(task)


def examine(env: LeggedRobot, policy: Policy) -> tuple[dict[str, Any], dict[str, Any]]:
    """The exam's result and the report's figures, from one rollout in the environment of a prepared task."""
    plan, rules = make_plan(env.cfg, env.dt), ExamRules.from_config(env.cfg)
    record = roll_out(env, policy, plan.cases, round(EXAM_SECONDS / env.dt), REPORT_SIGNALS, alone=rules.worlds())
    report = gather(env, rules, plan, record)
    return grade(rules, record.part(slice(rules.worlds()))), report


def gather(env: LeggedRobot, rules: ExamRules, plan: Plan, record: Record) -> dict[str, Any]:
    """All figures of the report except the exam's result, as plain numbers."""
    parts = {name: record.part(worlds) for name, worlds in plan.parts.items()}
    settled, until = round(SETTLING / env.dt), round(PUSH_UNTIL / env.dt)
    held, axes, first = parts["commands"], plan.axes, round((STEPS_AT[0] - BEFORE_STEP) / env.dt)
    # first index of the grid's row with vy nearest to 0
    straight = int(np.argmin(np.abs(axes["vy"]))) * len(axes["vx"])
    forward = parts["vx_vy"].part(slice(straight, straight + len(axes["vx"])))
    return {
        "joint_names": list(env.robot.joint_names),
        "foot_names": list(env.foot_names),
        "dt": env.dt,
        "tracking": {
            "axes": axes,
            "vx_yaw": figures.tracking_errors(parts["vx_yaw"], settled, len(axes["yaw"])),
            "vx_vy": figures.tracking_errors(parts["vx_vy"], settled, len(axes["vy"])),
        },
        "steps": {name: figures.responses(parts[f"step_{name}"], i, first) for i, name in enumerate(NAMES)},
        "gait": figures.gaits(held, settled, rules.commands(), GAIT_SECONDS),
        **(
            {"estimate": figures.estimates(held, rules.commands(), ESTIMATE_SECONDS)}
            if "estimate" in held.signals
            else {}
        ),
        "joints": figures.joints(held, settled, joint_limits(env)),
        "motors": figures.envelopes(held, settled, [family(name) for name in env.robot.joint_names], motor_limits(env)),
        "pushes": {
            "speeds": list(rules.push_speeds),
            "walking": figures.survival(parts["pushes"].fell_at, until),
            "standing": figures.survival(parts["standing_pushes"].fell_at, until),
        },
        "transport": {"vx": axes["vx"], **figures.transport(forward, settled)},
        "reward": figures.reward_shares(held, settled, env.reward_names),
    }


def joint_limits(env: LeggedRobot) -> dict[str, tuple[NDArray[Any], NDArray[Any]]]:
    """Signal -> (low, high), each (D,): soft position limits, speed limits (infinite if unknown), torque limits."""
    speeds = np.array(env.robot.speed_limits)
    position = torch.stack([env.soft_lower, env.soft_upper]).cpu().numpy().astype(float)
    effort = env.robot.effort_range.T
    return {"dof_pos": (position[0], position[1]), "dof_vel": (-speeds, speeds), "torque": (effort[0], effort[1])}


def motor_limits(env: LeggedRobot) -> figures.MotorLimits:
    """Force limits and torque-speed curves; infinite if unknown."""
    curve = (np.array(env.robot.tables.get(name, [np.inf] * env.num_actions)) for name in CURVE)
    return figures.MotorLimits(*env.robot.effort_range.T, *curve)


# ---- the short exam during training, in a separate environment


TRAINING_SECONDS = 4.0  # [s] duration of the roll-out
TRAINING_SETTLING = 2.0  # [s] settling time at its start, not measured
ERRORS = ("error_vx", "error_vy", "error_yaw")
TRAINING_PUSH_AT = 1.0  # [s] time of the first of 16 pushes; a push is survived if the robot stands at the end


def copy_of(task: LoadedTask) -> LoadedTask:
    """A copy of the task with its overrides. Changes to the copy do not change ``task``."""
    copy = load_task(str(task.path))
    copy.update(task.to_dict(), where="training")
    copy.exam = task.exam
    return copy


class TrainingExam:
    """22 commands and 16 pushes at ``push_mark``, 4 s each. A call with a policy returns figures by name.

    The environment is made from a copy of the task, with the overrides of the training run. The random generators are
    restored after each exam, so training continues unchanged.
    """

    def __init__(self, task: LoadedTask, device: str, eager: bool = False) -> None:
        copy = copy_of(task)
        rules = ExamRules.from_config(copy.cfg)
        self.rules = replace(rules, push_speeds=(rules.push_mark,), transport_vx=rules.ranges[0][1])  # one of the 22
        self.advice: list[str] = []
        prepare(copy, self.rules.worlds())
        with keep_random_state(device):
            self.env = copy.env_class(copy.cfg, device, eager=eager)

    def __call__(self, policy: Policy) -> dict[str, float]:
        """``error_vx``, ``error_vy`` [m/s], ``error_yaw`` [rad/s]; ``falls`` of 22; ``pushes_survived`` (0 to 1).

        A policy with a velocity estimator also has its RMS errors ``estimate_vx``, ``estimate_vy`` [m/s].
        """
        dt = self.env.dt
        with keep_random_state(self.env.device):
            exam = cases(self.rules, dt, TRAINING_PUSH_AT)
            record = roll_out(self.env, policy, exam, round(TRAINING_SECONDS / dt), {"velocity": SIGNALS["velocity"]})
        result = training_figures(record, len(self.rules.commands()))
        errors = [result[name] for name in ERRORS]
        self.advice = self.rules.advise(errors, result["falls"], result["pushes_survived"])
        return result


def training_figures(record: Record, count: int) -> dict[str, float]:
    """The figures of a record. The first ``count`` worlds have constant commands; the others are pushed.

    The error of a world that fell is its command, as if the robot stood still.
    """
    settled, stood = round(TRAINING_SETTLING / record.dt), np.isinf(record.fell_at)
    commands = record.commands[settled:, :count, :3]
    velocity = record.signals["velocity"][settled:, :count]
    error = np.where(stood[:count, None], velocity - commands, commands)
    estimate = record.signals["estimate"][settled:, :count] if "estimate" in record.signals else velocity[..., :0]
    rms = np.sqrt(((estimate - velocity[..., : estimate.shape[-1]]) ** 2).mean(axis=(0, 1)))
    return {
        **dict(zip(ERRORS, np.abs(error).mean(axis=(0, 1)).tolist(), strict=True)),
        "falls": float((~stood[:count]).sum()),
        "pushes_survived": float(stood[count:].mean()),
        **dict(zip(("estimate_vx", "estimate_vy"), rms.tolist(), strict=False)),
    }
