"""Compare ``legged_mw.deploy`` with the environment: run recorded steps through deploy's controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from rsl_rl.models import MLPModel

from legged_mw.deploy.contract import CONTRACT_FILE, NETWORK_FILE, Contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.robot import Measurement
from legged_mw.deploy.simulated import Fleet
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.robot_task import RobotTask
from legged_mw.export.network import run_onnx
from legged_mw.rl.policies import MEMORY_OUTPUT, act
from legged_mw.rl.students.recurrent import forget, memory_of
from legged_mw.sim.simulation import say_overflow
from legged_mw.skills.motion_tracking import MotionTracking
from legged_mw.utils.errors import UserError

STEPS = 32
CONTRACT_TOLERANCE = 1e-4  # relative if above 1; MJCF has six digits, and the environment computes in float32


class ExportError(UserError, RuntimeError):
    """The policy cannot be exported; nothing was written."""


class Step(NamedTuple):
    """One control step of N worlds in the environment."""

    observation: np.ndarray  # (N, size) of the actor's group
    measured: Measurement
    commands: np.ndarray  # (N, C)
    actions: np.ndarray  # (N, D) from the policy, before clipping
    taken: np.ndarray  # (N, D) applied actions
    targets: np.ndarray  # (N, D) motor targets [rad], including encoder offsets; or torques [N m]
    ended: np.ndarray  # (N,) true if the episode ended: the reset replaced the targets
    clock: np.ndarray  # (N,) phase of the gait clock, share of its period; 0 without a clock
    frame: np.ndarray  # (N,) frame of the motion; 0 without a motion
    memory: np.ndarray  # (N, states, H) the policy's state before it acted; (N, 0, 0) without a memory


def record(env: RobotTask, policy: MLPModel, groups: Sequence[str], contract: Contract, folder: Path) -> list[Step]:
    """Record the policy in ``env``. The measurements are those of a robot that runs the export in ``folder``.

    In the last two worlds large random actions are added, so that some actions are clipped and some robots fall.
    """
    fleet, steps = Fleet(folder, contract, env.num_envs, threads=1), []
    seen = env.get_observations()
    for _ in range(STEPS):
        memory = memory_of(policy, env.num_envs).numpy().copy()
        actions = act(policy, seen)
        observation = torch.cat([seen[group] for group in groups], dim=1).numpy()
        measured, commands = _measure(env, fleet), np.zeros((env.num_envs, 0))
        gait = getattr(env, "gait", None)
        clock = gait.phase.numpy().copy() if gait else np.zeros(env.num_envs)
        frame = (
            env.reference.frame.numpy().copy() if isinstance(env, MotionTracking) else np.zeros(env.num_envs, dtype=int)
        )
        if contract.commands:
            commands = env.commands.numpy().copy()  # type: ignore[attr-defined]
        taken = actions.clone()
        taken[-2:] += contract.action.clip * torch.randn_like(taken[-2:])
        seen, _, dones, _ = env.step(taken)
        forget(policy, dones)
        arrays = (tensor.numpy().copy() for tensor in (actions, taken, env.actuators.sent(), dones.bool()))
        steps.append(Step(observation, measured, commands, *arrays, clock=clock, frame=frame, memory=memory))
    say_overflow(env.sim, "the comparison with deploy")
    return steps


def _measure(env: RobotTask, fleet: Fleet) -> Measurement:
    """The current measurements of the environment's robots.

    Deploy's scene measures positions and velocities in the environment's state. Forces and contacts are from the
    environment, whose sensors are one physics step old and zero after a reset.
    """
    fleet.qpos[:], fleet.qvel[:] = env.sim.qpos.numpy(), env.sim.qvel.numpy()
    fleet.refresh()
    now, contract = fleet.read(), fleet.contract

    def sensed(names: Sequence[str]) -> np.ndarray:
        parts = [env.sim.sensordata[:, env.robot.columns(name)] for name in names]
        return torch.cat(parts, dim=1).numpy().copy()

    own = {row.name: sensed(row.sensors) for row in contract.rows if row.sensors}
    values = {row.name: row.value for rows in env.observations.groups.values() for row in rows}
    unknown = {row.name: values[row.name].float().numpy().copy() for row in contract.rows if not row.measured}
    contact = [(sensed(names) > 0.0).any(axis=1) for names in contract.feet.values()]
    offset = env.actuators.encoder_offset
    return replace(
        now,
        joint_pos=now.joint_pos if offset is None else now.joint_pos + offset.numpy(),
        joint_torque=env.torques.numpy().copy(),
        acceleration=sensed(contract.sensors["acceleration"]),
        foot_contact=np.stack(contact, axis=1).astype(float) if contact else now.foot_contact,
        others={**now.others, **own, **unknown},
    )


def replay(env: RobotTask, contract: Contract, steps: list[Step], folder: Path) -> None:
    """Run ``steps`` through deploy's controller. Raises ExportError if an observation, memory or target differs."""
    recorded = iter(steps)

    def network(_: Any, memory: np.ndarray | None = None) -> Any:
        step = next(recorded)
        if memory is None:
            return step.taken
        return step.taken, run_onnx(folder / NETWORK_FILE, step.observation, MEMORY_OUTPUT, memory)

    controller = Controller(folder, contract, env.num_envs, network)
    for number, step in enumerate(steps):
        if controller.clock:
            controller.clock.start[:] = step.clock  # in training an episode may start at any phase
        if controller.follower:
            controller.follower.start = step.frame  # and at any frame
        observed, start = controller.observe(step.measured, step.commands), 0
        for row in contract.rows:
            columns = slice(start, start := start + row.size * row.history)
            what = f"observation row '{row.name}'"
            _check_equal(
                env, number, what, range(row.size * row.history), step.observation[:, columns], observed[:, columns]
            )
        if controller.memory is not None:
            flat = step.memory.reshape(env.num_envs, -1)
            _check_equal(env, number, "memory", range(flat.shape[1]), flat, controller.memory.reshape(flat.shape))
        controller.act(step.measured, step.commands)
        _check_equal(
            env,
            number,
            "joint target",
            contract.joints,
            step.targets[~step.ended],
            controller.last_targets[~step.ended],
        )
        controller.reset(step.ended)


def _check_equal(
    env: RobotTask, step: int, what: str, names: Sequence[Any], theirs: np.ndarray, ours: np.ndarray
) -> None:
    """Raise ExportError for the first value (world, column) that differs."""
    wrong = np.argwhere(~(np.abs(ours - theirs) <= CONTRACT_TOLERANCE * np.maximum(1.0, np.abs(theirs))))  # or NaN
    if not len(wrong):
        return
    world, column = wrong[0]
    own = ", ".join(overridden(type(env))) or "no method"
    raise ExportError(
        f"legged_mw.deploy would act differently from the environment: {what} {names[column]} is "
        f"{theirs[world, column]:.6g} in the environment and {ours[world, column]:.6g} by {CONTRACT_FILE}, "
        f"at step {step}. {type(env).__name__} overrides {own}. State it where the contract can take it from: "
        "an action's scale and origin in section control, a row's scale in its Row, a value of your own as a row of "
        "another name with sensors=; nothing was written"
    )


def own_ends(task: type[RobotTask]) -> tuple[str, ...]:
    """Methods of the task's classes that may end an episode. A contract cannot express them."""
    own = [kind for kind in task.__mro__ if kind not in LeggedRobot.__mro__]
    return tuple(
        f"{kind.__name__}.{name}"
        for kind in own
        for name in ("_fallen", "_timed_out", "check_termination")
        if name in vars(kind)
    )


def overridden(task: type[RobotTask]) -> list[str]:
    """Methods of RobotTask or LeggedRobot that the task overrides, except rewards."""
    own = [kind for kind in task.__mro__ if kind not in LeggedRobot.__mro__]
    names = [
        name for kind in own for name, value in vars(kind).items() if callable(value) and hasattr(LeggedRobot, name)
    ]
    return [
        name
        for name in dict.fromkeys(names)
        if not name.startswith("_reward_") and name not in ("__module__", "__doc__")
    ]
