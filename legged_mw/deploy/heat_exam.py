"""Record motor torques and speeds, and the switch to the policy, of an export for ``legged_mw.eval.heat``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from legged_mw.deploy.contract import SCENE_FILE, Ends, make_ratings, read_contract
from legged_mw.deploy.hard_exam import commands_of
from legged_mw.deploy.robot import Floats
from legged_mw.deploy.simulated import Fleet
from legged_mw.deploy.stage import DeployStage
from legged_mw.deploy.user_scene import torque_limits
from legged_mw.eval import heat
from legged_mw.eval.hard import half_speed
from legged_mw.eval.heat import Motion, Switch
from legged_mw.eval.skills import ExamRobot, ReferenceMotion, Skill
from legged_mw.eval.walking import ExamRules

STAND = 2.0  # [s] in the default pose before the policy starts [RISE of deploy/states.py]
AFTER = 0.5  # [s] of recorded power after the switch
SETTLING, SECONDS = 2.0, 10.0  # [s] of standing and of walking: settling time, not recorded; total time
TRIES = 8  # number of robots in a skill exam


def run_heat(
    folder: Path,
    exam: ExamRules | Skill,
    edited: bool = False,
    scene: str | Path = SCENE_FILE,
    contact: str | None = None,
) -> dict[str, Any]:
    """The result of ``heat.finish``, for standing and walking, or for the motion of a skill.

    ``edited``: see read_contract. ``scene``: see Fleet. ``contact``: see DeployStage. Raises ContractError, UserError.
    """
    contract, walks = read_contract(folder, edited), isinstance(exam, ExamRules)
    ends = Ends(max_tilt=90.0, falls_on=contract.ends.falls_on) if walks else None  # as in run_exam
    log: list[MotorLog] = []
    stage = DeployStage(
        folder,
        1 if walks else TRIES,
        threads=1,
        scene_file=scene,
        ends=ends,
        contact=contact,
        edited=edited,
        each=lambda: log[0].sample(),
    )
    log.append(MotorLog(stage.fleet))
    holds = walks and contract.action.of_angles
    if isinstance(exam, ExamRules):
        motions, switch = walk(stage, log[0], half_speed(exam), holds)
    else:
        motions, switch = {exam.kind: perform(stage, log[0], exam)}, None
    joints = [stage.fleet.model.joint(name).id for name in contract.joints]
    ratings = contract.ratings or make_ratings({}, None, len(joints))
    return heat.finish(contract.joints, ratings, torque_limits(stage.fleet.model, joints), motions, switch, holds)


class MotorLog:
    """A recorder of the motors' torques and speeds at each physics step."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._torque: list[Floats] = []
        self._speed: list[Floats] = []

    def sample(self) -> None:
        """Record this physics step."""
        self._torque.append(self._fleet.motor_torque())
        self._speed.append(self._fleet.motor_speed())

    def take(self) -> Motion:
        """Return the record and clear it."""
        motion = Motion(np.stack(self._torque), np.stack(self._speed))
        self._torque, self._speed = [], []
        return motion


def walk(stage: DeployStage, log: MotorLog, vx: float, holds: bool) -> tuple[dict[str, Motion | None], Switch | None]:
    """Let the servos hold the default pose (if ``holds``), then let the policy stand, then walk at ``vx`` [m/s]."""
    stand, forward = (commands_of(stage.contract, [(speed, 0.0, 0.0)]) for speed in (0.0, vx))
    switch = switch_over(stage, log, stand) if holds else None
    motions: dict[str, Motion | None] = {}
    for name, command in (("standing", stand), ("walking", forward)):
        fell = _run(stage, SETTLING, command)
        log.take()
        motions[name] = None if _run(stage, SECONDS - SETTLING, command) or fell else log.take()
    return motions, switch


def switch_over(stage: DeployStage, log: MotorLog, stand: Floats) -> Switch | None:
    """Hold the default pose for STAND, then start the policy. None if the robot falls after that.

    Before the policy starts, the root can only move vertically, as if a person held it. Otherwise a biped falls.
    """
    fleet, contract, start = stage.fleet, stage.contract, stage.qpos()[0]
    for _ in range(round(STAND / stage.dt)):
        fleet.write(contract.default_pose[None])
        fleet.qpos[0, [0, 1, 3, 4, 5, 6]] = start[[0, 1, 3, 4, 5, 6]]
        fleet.qvel[0, [0, 1, 3, 4, 5]] = 0.0
        fleet.refresh()
    stage.measured = fleet.read()
    before = log.take().torque[-1, 0]
    stage.step(stand)
    jump = stage.controller.last_targets[0] - contract.default_pose
    if _run(stage, AFTER - stage.dt, stand):
        return None
    return Switch(fleet.model.opt.timestep, jump, before, log.take(), contract.period)


def _run(stage: DeployStage, seconds: float, command: Floats) -> bool:
    """Run the policy for ``seconds``. True if the robot fell."""
    fell = False
    for _ in range(round(seconds / stage.dt)):
        stage.step(command)
        fell |= bool(stage.fell()[0])
    return fell


def perform(stage: DeployStage, log: MotorLog, skill: Skill) -> Motion | None:
    """Run TRIES robots on the first ground of the skill exam. Returns the record of those that do not fall, or None."""
    robot = start_skill(stage, skill)
    standing = np.ones(stage.num_worlds, dtype=bool)
    for _ in range(skill.steps(robot)):
        stage.step()
        standing &= ~stage.fell()
    torque, speed = log.take()
    return Motion(torque[:, standing], speed[:, standing]) if standing.any() else None


def start_skill(stage: DeployStage, skill: Skill) -> ExamRobot:
    """Put the robots in the start states of a skill exam. Returns the robot as the exam knows it."""
    source, follower = stage.contract.motion, stage.controller.follower
    motion = ReferenceMotion(follower.clip.qpos(), source.bodies, source.anchor) if source and follower else None
    robot = ExamRobot(stage.fleet.model, stage.qpos()[0], stage.dt, motion)
    if starts := skill.starts(robot, stage.num_worlds):
        stage.put(*starts)
    return robot
