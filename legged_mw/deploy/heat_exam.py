"""Record what ``legged_mw.eval.heat`` judges, on an export: motors' torques and speeds, and the switch to the policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from legged_mw.deploy.contract import SCENE_FILE, Contract, Ends, make_ratings, read_contract
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

STAND = 2.0  # [s] that the robot is held in its default pose before the policy [as deploy/states.py's RISE]
AFTER = 0.5  # [s] after the switch in which its power is looked at
SETTLING, SECONDS = 2.0, 10.0  # [s] of standing and of walking: at the start without a measure; in all
TRIES = 8  # robots of a skill


def run_heat(
    folder: Path, exam: ExamRules | Skill, edited: bool = False, scene: str | Path = SCENE_FILE
) -> dict[str, Any]:
    """The result of ``heat.finish``: of a walker standing and walking, of a skill while it does what it is for.

    ``edited``: see read_contract. ``scene``: see Fleet. Raises ContractError, UserError.
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
        edited=edited,
        each=lambda: log[0].sample(),
    )
    log.append(MotorLog(stage.fleet))
    holds = walks and contract.action.origin not in ("torque", "speed")
    if isinstance(exam, ExamRules):
        motions, switch = walk(stage, log[0], half_speed(exam), holds)
    else:
        motions, switch = {exam.kind: perform(stage, log[0], exam)}, None
    joints = [stage.fleet.model.joint(name).id for name in contract.joints]
    ratings = contract.ratings or make_ratings({}, None, len(joints))
    return heat.finish(contract.joints, ratings, torque_limits(stage.fleet.model, joints), motions, switch, holds)


class MotorLog:
    """Torque and speed of every motor at each physics step."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._torque: list[Floats] = []
        self._speed: list[Floats] = []

    def sample(self) -> None:
        """Keep this physics step."""
        self._torque.append(self._fleet.motor_torque())
        self._speed.append(self._fleet.motor_speed())

    def take(self) -> Motion:
        """What was kept, and begin anew."""
        motion = Motion(np.stack(self._torque), np.stack(self._speed))
        self._torque, self._speed = [], []
        return motion


def walk(stage: DeployStage, log: MotorLog, vx: float, holds: bool) -> tuple[dict[str, Motion | None], Switch | None]:
    """A robot that its servos hold in the default pose (``holds``), then stands by its policy, then walks at ``vx``."""
    stand, ahead = (commands_of(stage.contract, [(speed, 0.0, 0.0)]) for speed in (0.0, vx))
    switch = switch_over(stage, log, stage.contract, stand) if holds else None
    motions: dict[str, Motion | None] = {}
    for name, command in (("standing", stand), ("walking", ahead)):
        fell = _run(stage, SETTLING, command)
        log.take()
        motions[name] = None if _run(stage, SECONDS - SETTLING, command) or fell else log.take()
    return motions, switch


def switch_over(stage: DeployStage, log: MotorLog, contract: Contract, stand: Floats) -> Switch | None:
    """Hold the default pose for STAND, then start the policy; None if the robot falls then.

    Meanwhile the root can sink but neither tilt nor slide, as if a person kept it upright: else a biped topples.
    """
    fleet, start = stage.fleet, stage.qpos()[0]
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
    """Run the policy for ``seconds``; whether the robot fell."""
    fell = False
    for _ in range(round(seconds / stage.dt)):
        stage.step(command)
        fell |= bool(stage.fell()[0])
    return fell


def perform(stage: DeployStage, log: MotorLog, skill: Skill) -> Motion | None:
    """Those of TRIES robots that do not fall, in the first of the exam's starts on its first ground, the task's own."""
    said, follower = stage.contract.motion, stage.controller.follower
    motion = ReferenceMotion(follower.clip.qpos(), said.bodies, said.anchor) if said and follower else None
    robot = ExamRobot(stage.fleet.model, stage.qpos()[0], stage.dt, motion)
    if starts := skill.starts(robot, stage.num_worlds):
        stage.put(*starts)
    stands = np.ones(stage.num_worlds, dtype=bool)
    for _ in range(skill.steps(robot)):
        stage.step()
        stands &= ~stage.fell()
    torque, speed = log.take()
    return Motion(torque[:, stands], speed[:, stands]) if stands.any() else None
