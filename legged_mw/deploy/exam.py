"""Run the exams of an export in MuJoCo's C engine. ``legged_mw.eval.walking`` and ``skills`` define the exams.

A step has the order of the environment's exams, so both give equal results: sample, policy, push, physics, falls.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from legged_mw.deploy.contract import CONTRACT_FILE, OWN, SCENE_FILE, Contract, ContractError, Ends, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.hard_exam import commands_of, push_around, run_hard
from legged_mw.deploy.heat_exam import run_heat, start_skill
from legged_mw.deploy.robot import Floats, Measurement
from legged_mw.deploy.stage import DeployStage
from legged_mw.eval import heat, walking
from legged_mw.eval.hard import table
from legged_mw.eval.skills import ExamGround, ExamRobot, Recording, Skill, make_skill
from legged_mw.eval.walking import ExamRules, in_common
from legged_mw.utils.commands import VELOCITY
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import UserError, unknown


def run(
    folder: Path,
    exam: ExamRules | Skill,
    hard: bool = True,
    *,
    edited: bool = False,
    scene: str | Path = SCENE_FILE,
    contact: str | None = None,
    show: Callable[[str], None] = lambda _: None,
) -> tuple[dict[str, Any], list[Floats]]:
    """Grade the export in ``folder`` by the rules ``exam``. Returns the result and the poses of one stride, if any.

    ``hard`` adds heat and power. For a walking policy it also adds the hard exam and the poses.
    ``edited``, ``contact``, ``scene`` (``scene_file``): see DeployStage. ``show`` gets each table when it is ready.
    """
    poses: list[Floats] = []
    if isinstance(exam, Skill):
        result = run_skill(folder, exam, edited)
        show(exam.table(result))
    else:
        result = run_exam(folder, exam, contact, edited, scene)
        show(walking.table(result))
        if hard and read_contract(folder, edited).feet:
            result["hard"], poses = run_hard(folder, exam, result["walks"], edited, scene, contact=contact)
            show(f"\n{table(result['hard'])}")
    if hard:
        result["heat"] = run_heat(folder, exam, edited, scene, contact)
        show(f"\n{heat.table(result['heat'])}")
    return result, poses


def run_exam(
    folder: Path,
    exam: ExamRules | None = None,
    contact: str | None = None,
    edited: bool = False,
    scene: str | Path = SCENE_FILE,
    seed: int = 0,
) -> dict[str, Any]:
    """Grade the export in ``folder`` by ``exam``, or by its contract's rules. Raises ContractError, ConfigError.

    ``contact``, ``edited``, ``scene``: see ``run``. ``seed``: of the start, see ``scatter``.
    """
    contract = read_contract(folder, edited)
    exam = exam or contract_rules(contract)
    velocities = [*exam.held(), *[(exam.push_vx, 0.0, 0.0)] * (exam.worlds() - len(exam.held()))]
    commands = commands_of(contract, velocities)
    groups = [(len(exam.held()) + i * walking.PUSH_DIRECTIONS, speed) for i, speed in enumerate(exam.push_speeds)]
    ends = Ends(max_tilt=90.0, falls_on=contract.ends.falls_on)  # as in legged_mw.eval.rollout
    stage = DeployStage(folder, len(commands), scene_file=scene, ends=ends, contact=contact, edited=edited)
    stage.scatter(seed)
    fell_at = np.full(len(commands), math.inf)
    sampled: dict[str, list[Any]] = {"velocity": [], "position": [], "power": [], "joint_speed": [], "estimate": []}
    for step in range(round(walking.EXAM_SECONDS / stage.dt)):
        sampled["velocity"].append(stage.velocity())
        sampled["position"].append(stage.qpos()[:, :2])
        sampled["power"].append(np.abs(stage.measured.joint_torque * stage.measured.joint_vel).sum(axis=1))
        sampled["joint_speed"].append(np.abs(stage.measured.joint_vel).mean(axis=1))
        # the policy acts on the measurement from before the push
        push_around(stage, step - round(walking.PUSH_AT / stage.dt), groups, walking.PUSH_DIRECTIONS)
        stage.step(commands)
        estimate = stage.believed_velocity()  # of the same measurement
        sampled["estimate"] += [] if estimate is None else [estimate]
        fell_at[stage.fell() & np.isinf(fell_at)] = step
    signals = {name: np.stack(values) for name, values in sampled.items() if values}
    return exam.grade(
        signals, last_position=stage.qpos()[:, :2], fell_at=fell_at, mass=stage.contract.mass, dt=stage.dt
    )


def run_skill(folder: Path, skill: Skill | None = None, edited: bool = False, seed: int = 0) -> dict[str, Any]:
    """Grade the export in ``folder`` by ``skill``, or by the skill exam of its contract.

    ``edited``: see DeployStage. ``seed``: of the start, see ``scatter``.
    """
    skill = skill or contract_skill(read_contract(folder, edited))
    return skill.result(
        {name: skill.judge(*perform(folder, skill, ground, edited, seed)) for name, ground in skill.grounds.items()}
    )


def contract_skill(contract: Contract) -> Skill:
    """The skill exam of the contract's section ``exam``. Raises ContractError."""
    section = dict(contract.exam or {})
    try:
        return make_skill(str(section.pop("kind", "")), section)
    except ConfigError as error:
        raise ContractError(f"{CONTRACT_FILE}: {error}") from error


def perform(
    folder: Path, skill: Skill, ground: ExamGround, edited: bool = False, seed: int = 0
) -> tuple[ExamRobot, Recording]:
    """Put the robots in their start states on ``ground`` and run the policy."""
    stage = DeployStage(folder, skill.robots, change=lambda model: put_on(model, ground), edited=edited)
    robot = start_skill(stage, skill)
    stage.scatter(seed)
    steps = []
    ended_at = np.full(skill.robots, math.inf)
    for step in range(skill.steps(robot)):
        steps.append((stage.qpos(), stage.fleet.qvel.copy(), stage.measured.joint_torque))
        if (jumps := ground.pushes(step, skill.robots, stage.dt)) is not None:
            for world, jump in enumerate(jumps):
                stage.push(world, jump)
        stage.step()
        ended_at[stage.fell() & np.isinf(ended_at)] = step
    qpos, qvel, torque = (np.stack(values) for values in zip(*steps, strict=True))
    return robot, Recording(qpos, qvel, torque, ended_at)


def put_on(model: mujoco.MjModel, ground: ExamGround) -> None:
    """Edit a scene: slope (by tilting gravity), ground friction, mass of the root (its inertia scales with it)."""
    if ground.slope:
        size, angle = np.linalg.norm(model.opt.gravity), math.radians(ground.slope)
        model.opt.gravity[:] = size * math.sin(angle), 0.0, -size * math.cos(angle)
    if ground.friction is not None:
        model.geom_friction[model.geom_bodyid == 0, 0] = ground.friction
    if ground.load:
        root = int(model.jnt_bodyid[0])
        model.body_inertia[root] *= 1.0 + ground.load / model.body_mass[root]
        model.body_mass[root] += ground.load
        mujoco.mj_setConst(model, mujoco.MjData(model))


def contract_rules(contract: Contract, common: bool = False) -> ExamRules:
    """The rules from a contract's section ``exam``, trained ranges and number of feet. Raises ContractError."""
    trained = {command.name: (command.low, command.high) for command in contract.commands}
    if missing := [name for name in VELOCITY if name not in trained]:
        raise ContractError(
            f"{CONTRACT_FILE}: the walking exam needs the commands {', '.join(VELOCITY)}; missing: {', '.join(missing)}"
        )
    section, known = dict(contract.exam or {}), [field.name for field in fields(ExamRules)]
    for name in section:
        if name not in known:
            raise ContractError(f"{CONTRACT_FILE}: exam: {unknown('field', name, known, 'the walking exam')}")
    try:
        return ExamRules.from_mapping(
            section | (in_common(section.get("peer", "")) if common else {}), trained, len(contract.feet)
        )
    except (AttributeError, TypeError, ValueError) as error:
        raise ContractError(f"{CONTRACT_FILE}: exam: {error}") from error


# ---- two policies on one robot: after a fall the second runs until the robot stands ---------------------------------


# [deg] tilt of the robot's z axis above which the second policy starts [ours: a walking policy cannot recover from it]
FELL = 60.0
# The robot stands, and the first policy starts, if all three values are below these limits for HOLD [ours]:
# [deg] tilt; [rad] mean distance of the joints from the first policy's default pose; [rad/s] mean joint speed
UP, NEAR, SLOW = 10.0, 0.3, 1.0
HOLD = 0.5  # [s]


class SwitchStage(DeployStage):
    """Robots with the policy in ``first``. After a fall the policy in ``second`` runs until the robot stands.

    A fall resets no robot; a robot that MuJoCo cannot step is reset. Servos have the gains of the policy that runs.
    """

    def __init__(
        self, first: Path, second: Path, num_worlds: int = 1, command: Any = None, edited: bool = False
    ) -> None:
        """``edited``: see read_contract. Raises UserError if the policies' robots differ, ContractError."""
        # ``whole``: the whole body collides with the ground
        super().__init__(first, num_worlds, command, ends=Ends(max_tilt=FELL), whole=True, edited=edited)
        other = read_contract(second, edited)
        check_same(self.contract, other)
        self.rescuer = Controller(second, other, num_worlds)
        self.rescued = np.zeros(num_worlds, dtype=bool)  # (N,) True while the second policy runs
        self._standing = np.zeros(num_worlds, dtype=int)  # (N,) control periods since the robot stands
        self._none = np.array([[each.default for each in other.commands]] * num_worlds).reshape(num_worlds, -1)

    def step(self, commands: Floats | None = None) -> None:
        self._take(commands)
        self._seen, rescued = self.measured, self.rescued[:, None]
        targets = self.controller.act(self._seen, self._commands), self.rescuer.act(self._seen, self._none)
        first, second = self.contract, self.rescuer.contract
        if first.motors.law == "servo":  # else the gains are equal
            gains = (second.stiffness, first.stiffness), (second.damping, first.damping)
            self.fleet.set_gains(*(np.where(rescued, *pair) for pair in gains))
        self.fleet.write(np.where(rescued, targets[1], targets[0]))
        self.measured = self.fleet.read()
        broken = self.fleet.broken | ~np.isfinite(self.fleet.qvel).all(axis=1)
        for world in np.flatnonzero(broken):  # no policy can act on such a state
            self.reset(int(world))
        tilted = self.contract.ends.tilted(self.measured.gravity)
        self._fell, stood = tilted & ~self.rescued, self._stood(self.measured)
        recovered = self.rescued & stood
        self.rescued = (self.rescued | self._fell) & ~recovered
        # reset the memory of the policy that does not run
        self.controller.reset(self.rescued | recovered)
        self.rescuer.reset(~self.rescued | self._fell)
        self._fell |= broken

    def _stood(self, measured: Measurement) -> np.ndarray:
        """(N,) True if the robot was upright, near the first policy's default pose and slow for HOLD."""
        upright = ~Ends(max_tilt=UP).tilted(measured.gravity)
        near = np.abs(measured.joint_pos - self.contract.default_pose).mean(axis=1) < NEAR
        slow = np.abs(measured.joint_vel).mean(axis=1) < SLOW
        self._standing = np.where(upright & near & slow, self._standing + 1, 0)
        return self._standing >= round(HOLD / self.dt)

    def reset(self, world: int) -> None:
        """Reset the robot to its start state, with the first policy."""
        super().reset(world)
        self.rescuer.reset([world])
        self.rescued[world], self._standing[world] = False, 0


def check_same(first: Contract, second: Contract) -> None:
    """Raise UserError if two policies cannot control the same robot."""
    unshared = sorted({row.name for row in second.rows if row.measured in OWN} - {row.name for row in first.rows})
    gains = [[each.stiffness.tolist(), each.damping.tolist()] for each in (first, second)]
    for name, value, other_value in (
        ("joints", first.joints, second.joints),
        ("period", first.period, second.period),
        ("motors", first.motors, second.motors),
        *([] if first.motors.law == "servo" else [("gains", *gains)]),
        ("rows with sensors of their own", [], unshared),
    ):
        if value != other_value:
            raise UserError(
                f"--switch: {name} of {first.task} and {second.task} differ, so they cannot drive one robot: {value} and {other_value}"
            )
