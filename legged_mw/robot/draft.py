"""Draft a first task for a new robot: guess its feet, compute its pose, gains and height, and return config values."""

from __future__ import annotations

import copy
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw import ROOT
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.envs.robot_task import RobotTask
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.rl.learner_config import LeggedRobotCfgPPO
from legged_mw.robot.makers import Maker, find_maker
from legged_mw.robot.measure import (
    GRAVITY,
    Gains,
    Joint,
    beyond_euler,
    mass_matrices,
    stand_as_statue,
    stand_on_servos,
    suggest,
    what_joints_bear,
)
from legged_mw.robot.pose import SIDEWAYS, Judged, find_wheels, joints_to, judge_poses, walking_joints
from legged_mw.robot.vendor import read_robot
from legged_mw.sim.joints import family, per_joint, posed
from legged_mw.sim.mirror import find_partners
from legged_mw.sim.model import RobotModel, standing_height
from legged_mw.sim.surface_points import surfaces
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import ModelError
from legged_mw.utils.task import import_task

LOW = 0.33  # [m] a robot with a lower root gets a lower swing height
# factors on the suggested gains; published gains are at most twice the suggested gains [ours]
FIRMNESS = (1.0, 1.25, 1.5, 2.0)
# solver options with implicitfast [ours: the engines agree to 1e-5 rad/s with 10; with 3 a T1 is off by 7 rad/s a step]
IMPLICIT: dict[str, Any] = {"integrator": "implicitfast", "iterations": 10, "ls_iterations": 20}
# reward scales for a smooth walk of a quadruped: small joint accelerations and foot impacts; those of a biped are in
# UprightBipedCfg [ours, from terms of legged_gym, walk-these-ways and Playground]
LOOKS = {"dof_acc": -1e-7, "feet_impact_vel": -0.25, "target_limits": -1.0}
# reward scale of `termination` for a quadruped: a fall costs what 29 of the best control steps pay; bipeds have -200
# [ours: docs/archive/drafts.md]
FALL = -100.0
# number of feet -> scale of `energy` x robot's mass [kg]: -0.001 for a G1 of 35 kg (docs/archive/go2_and_g1.md), -0.001
# for a Go1 of 13 kg [Playground]
ENERGY = {2: -0.035, 4: -0.013}
SLIPPERY = [0.25, 1.2]  # friction of a quadruped's ground [-] [ours: an ANYmal C trained with 0.4 or more fell at 0.3]
# [s], [m/s] per axis, [rad/s] per axis [go2_rl_gym: 4, 0.4, 0.6; ours: docs/archive/drafts.md]
PUSHES = {"push_interval_s": 4.0, "max_push_vel_xy": 1.0, "max_push_ang_vel": 0.6}
# share of each command's values at the ends of its range, for a quadruped [go2_rl_gym]
ENDS = 0.2
BY_CLOCK = {"contact_phase": 1.0, "no_fly": 0.5}  # reward scales of a biped that follows a gait clock
EVEN = 0.01  # [rad] largest difference between a joint's angle and its partner's that is averaged out [ours]
CLEARANCE = 0.003  # [m] height of the feet above the ground at reset, so that no geom penetrates it


class Draft(NamedTuple):
    """The numbers of a first task."""

    robot: RobotModel
    pose: list[float]  # (D,) [rad]
    place: list[float]  # (3,) [m] position of the root
    joints: tuple[Joint, ...]
    gains: list[Gains]
    feet: list[Foot]
    guessed: list[str]  # guessed values, one line each
    pose_from: str  # source of the default pose, as text
    notes: list[str]  # dropped, added, changed and fused parts of the file, one line each
    maker: Maker | None  # values that the maker publishes, if known
    gains_from: str  # source of the gains, as text
    judged: list[Judged]  # the judged poses, the chosen one first
    simple: bool  # True: equal worlds and an observed base velocity; False: a task for a real robot
    angles: dict[str, float]  # joint -> default angle [rad], held joints included
    wheels: list[str]  # joints of wheels; a draft has no motor law for them

    @property
    def held(self) -> list[str]:
        """The joints that the policy does not control."""
        return [name for name in self.angles if name not in self.robot.joint_names]

    def stands(self, judged: Judged) -> NDArray[np.float64]:
        """qpos (7 + D,) of the robot standing in a judged pose, without the held joints."""
        angles = dict(zip(self.angles, judged.candidate.angles, strict=True))
        return np.array(
            [0.0, 0.0, judged.height, 1.0, 0.0, 0.0, 0.0, *(angles[name] for name in self.robot.joint_names)]
        )


def draft(file: Path, simple: bool = False) -> Draft:
    """Guess the numbers of a first task for the robot in ``file`` (MJCF or URDF). Raises ModelError."""
    read = read_robot(file)
    from_file = read.keyframe is not None
    env = _bare(file, from_file)
    robot, place = env.robot, np.array(env.start_place)
    rest = stand_as_statue(robot, np.clip(robot.pose, *robot.joint_range.T), place)
    feet = guess_feet(robot, rest.qpos)
    _refuse_lost_feet(robot, rest.qpos, feet)
    maker = find_maker(file, robot.spec.modelname, robot.joint_names)
    judged = judge_poses(robot, [foot.geoms for foot in feet], maker, from_file)
    pose = np.clip(judged[0].candidate.angles, *robot.joint_range.T).round(4) + 0.0  # no -0.0
    feet = guess_feet(robot, stand_as_statue(robot, pose, place).qpos)
    angles = dict(zip(robot.joint_names, pose.tolist(), strict=True))
    walking = walking_joints(robot.physics, [foot.geoms for foot in feet])
    held = [name for i, name in enumerate(robot.joint_names) if i not in walking]
    if held:
        robot = _bare(file, False, held, angles).robot
        pose = np.array(robot.pose)
    pose = _even(robot, pose)
    angles |= zip(robot.joint_names, pose.tolist(), strict=True)
    rest = stand_as_statue(robot, pose, place)
    joints = what_joints_bear(robot, mass_matrices(robot, pose), rest.torque)
    how = ", ".join(filter(None, (judged[0].candidate.name, judged[0].candidate.source)))
    pose = pose.tolist()
    height = standing_height(robot, [geom for foot in feet for geom in foot.geoms], pose)
    place = [0.0, 0.0, round(height + CLEARANCE, 3)]
    if height <= 0.0:
        names = ", ".join(foot.name for foot in feet)
        raise ModelError(
            f"'{robot.root}', the root, is not above the lowest ends of limbs, {names}; the health page needs a robot that stands on them"
        )
    gains, gains_from = _servos(robot, pose, place, joints, feet, maker)
    guessed = [
        f"pose: {how}{', though: ' * bool(judged[0].faults)}{'; '.join(judged[0].faults)}",
        f"feet: {', '.join(foot.name for foot in feet)}, the lowest ends of limbs",
        f"gains: {gains_from}",
    ]
    if held:
        guessed.append(f"held: {', '.join(patterns(held, robot.joint_names))}: {len(held)} joints that do not walk")
    wheels = find_wheels(robot, np.array(pose))
    if wheels:
        guessed.append(f"wheels: {', '.join(wheels)}: without a range, and round about their axis")
    # the only site of a robot without a task is its IMU
    fused = [line for line in robot.overrides if line.startswith(("fused into ", "site "))]
    notes = [*read.notes, *fused]
    return Draft(
        robot, pose, place, joints, gains, feet, guessed, how, notes, maker, gains_from, judged, simple, angles, wheels
    )


def _even(robot: RobotModel, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean of ``pose`` (D,) and its mirror image, if both are alike within EVEN. Then left and right may learn alike.

    The sides of many files differ by fractions of a millimetre, and so do angles that are computed from them.
    """
    try:
        partners = find_partners(robot)
    except ModelError:
        return pose
    image = pose[[*partners.joints]] * partners.signs
    alike = bool(np.abs(pose - image).max() <= EVEN)
    return (0.5 * (pose + image)).round(4) + 0.0 if alike else pose  # no -0.0


def _servos(
    robot: RobotModel,
    pose: list[float],
    place: list[float],
    joints: Sequence[Joint],
    feet: Sequence[Foot],
    maker: Maker | None,
) -> tuple[list[Gains], str]:
    """The gains of each joint and their source: the maker's gains, or the suggested gains times a factor of FIRMNESS.

    A robot with more than two feet must stand with its gains. If it sinks with the maker's, they are not used. The
    factor is the smallest with which it stands. A biped falls with any gains.
    """
    names = robot.joint_names
    kp, kd = (maker.of(table, names) if maker else {} for table in ("kp", "kd"))
    known = {name: Gains(kp[name], kd[name]) for name in names if name in kp and name in kd}
    moment = GRAVITY * float(robot.physics.body_subtreemass[0]) * place[2]

    def chosen(firmness: float) -> list[Gains]:
        suggested = zip(names, suggest(joints, moment, firmness), strict=True)
        return [known.get(name, gains) for name, gains in suggested]

    note = f"; of {len(known)} joints its maker's, {maker.source}" if maker and known else ""
    if maker and len(known) == len(names):
        if len(feet) <= 2 or _stands(robot, pose, place, joints, feet, chosen(1.0)):
            return chosen(1.0), f"its maker's, {maker.source}"
        known, note = {}, f"; with its maker's, {maker.source}, it sinks"
    for firmness in FIRMNESS if len(feet) > 2 else ():
        if _stands(robot, pose, place, joints, feet, chosen(firmness)):
            text = f"{firmness:g} times what is suggested below, to stand on its servos"
            return chosen(firmness), ("as suggested below" if firmness == 1.0 else text) + note
    tried = f", though with up to {FIRMNESS[-1]:g} times them it does not stand either" if len(feet) > 2 else ""
    return chosen(1.0), f"as suggested below{tried}{note}"


def _stands(
    robot: RobotModel,
    pose: list[float],
    place: list[float],
    joints: Sequence[Joint],
    feet: Sequence[Foot],
    gains: Sequence[Gains],
) -> bool:
    """Whether the robot stands with these ``gains``; only its feet collide."""
    model, touching = copy.copy(robot.physics), {geom for foot in feet for geom in foot.geoms}
    for geom in range(robot.ground_geoms().stop, model.ngeom):
        model.geom_conaffinity[geom] *= model.geom(geom).name in touching
    model.actuator_gainprm[:, 0], model.dof_damping[6:] = [gain.kp for gain in gains], [gain.kd for gain in gains]
    model.actuator_biasprm[:, 1] = -model.actuator_gainprm[:, 0]
    if beyond_euler(joints, gains, float(model.opt.timestep)):
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model.opt.iterations, model.opt.ls_iterations = IMPLICIT["iterations"], IMPLICIT["ls_iterations"]
    firm = replace(robot, physics=model)
    return stand_on_servos(firm, np.array(pose), place, RobotTaskCfg.control.decimation).end == "stands"


def _bare(file: Path, keyframe: bool, held: Sequence[str] = (), angles: Mapping[str, float] | None = None) -> RobotTask:
    """One world of the robot without a task, in the file's ``keyframe``, at ``angles``, or with all joints at 0."""
    cfg = RobotTaskCfg()
    fields = {
        **{
            "env": {"num_envs": 1},
            "asset": {"file": str(file.resolve()), "held_joints": [*held]},
            "sim": {"engine": "mujoco"},
        },
        "control": {"stiffness": {"": 1.0}, "damping": {"": 0.0}, "action_scale": 1.0},
        "init_state": {"default_joint_angles": {} if keyframe else {**(angles or {"": 0.0})}},
    }
    cfg.update(fields, where="the health page")
    return RobotTask(cfg, "cpu")


def as_env(found: Draft, file: Path) -> LeggedRobot:
    """One world of the draft's task."""
    cfg = parents(found)[0]()
    cfg.update({"env": {"num_envs": 1}, **values(found)}, where="the health page")
    cfg.asset.file, cfg.sim.engine = str(file.resolve()), "mujoco"
    return LeggedRobot(cfg, "cpu")


def parents(found: Draft) -> tuple[type[LeggedRobotCfg], type[LeggedRobotCfgPPO]]:
    """The base classes of the task's configs."""
    if len(found.feet) != 2 and found.simple:
        return LeggedRobotCfg, LeggedRobotCfgPPO
    presets = import_task(ROOT / "configs/base.py")
    if len(found.feet) == 2:
        followed = (presets.BipedCfg, presets.BipedCfgPPO)  # a gait clock
        return followed if found.simple else (presets.UprightBipedCfg, presets.UprightBipedCfgPPO)
    return presets.SimToRealCfg, presets.SimToRealCfgPPO


def has_mirror(env: LeggedRobot) -> bool:
    """Whether the robot and its pose are symmetric, so that the learner can use the symmetry."""
    try:
        return env.mirror is not None
    except (ModelError, ConfigError):
        return False


def values(found: Draft) -> dict[str, dict[str, Any]]:
    """The config values: section -> field -> value."""
    names, height = found.robot.joint_names, found.place[2]
    asset: dict[str, Any] = {"foot_names": [foot.name for foot in found.feet]}
    if parts := {foot.name: list(foot.geoms) for foot in found.feet if not foot.known}:
        asset["foot_geoms"] = parts
    if speeds := {
        name: speed for name, speed in zip(names, found.robot.speed_limits, strict=True) if math.isfinite(speed)
    }:
        asset["joint_speed_limits"] = short_table(speeds, names)
    if found.held:
        asset["held_joints"] = patterns(found.held, names)
    asset |= _motors(found)
    asset["colliders"] = [name for foot in found.feet for name in ([foot.name] if foot.known else foot.geoms)]
    chosen: dict[str, dict[str, Any]] = {
        "asset": asset,
        "init_state": {"pos": found.place, "default_joint_angles": table([*found.angles.values()], [*found.angles])},
        "control": {
            "stiffness": table([gain.kp for gain in found.gains], names),
            "damping": table([gain.kd for gain in found.gains], names),
            "action_scale": 0.5 if found.simple else 0.25,
        },
        "commands": {"ranges": {"lin_vel_x": [-1.0, 1.0], "lin_vel_y": [-0.5, 0.5], "ang_vel_yaw": [-1.0, 1.0]}},
        "termination": {"min_base_height": round(0.5 * height, 2)},
    }
    if beyond_euler(found.joints, found.gains, float(found.robot.physics.opt.timestep)):
        chosen["sim"] = dict(IMPLICIT)
    low = {"swing_height": round(0.3 * height, 2)} if height < LOW else {}
    if not found.simple:
        chosen["normalization"] = {"clip_actions": 4.0}
    if len(found.feet) == 2:
        return {**chosen, **_of_a_biped(found, low)}
    if found.simple:
        return {**chosen, "perturbation": {"kick": True, "velocity": [0.0, 8.0]}, **({"rewards": low} if low else {})}
    weights = table(pose_weights(found.robot, found.pose, found.feet), names)
    rewards = {**low, "pose_weights": weights, "scales": {**LOOKS, "termination": FALL, **_energy(found)}}
    worlds = {"friction": SLIPPERY, **_worlds(found, (-0.07, 0.2))}
    commands = {"end_probability": ENDS, **chosen["commands"]}
    return {
        **chosen,
        **_clock(found),
        "commands": commands,
        "domain_rand": worlds,
        "perturbation": dict(PUSHES),
        "rewards": rewards,
    }


def _clock(found: Draft) -> dict[str, dict[str, Any]]:
    """A clock of a trot for four feet, without a reward: with mirrored data, nothing else tells left from right."""
    if len(found.feet) != 4:
        return {}
    places = _places(found)
    front, left = (places > places.mean(axis=0)).T
    return {"gait": {"period": 0.5, "offsets": (0.5 * (front == left)).tolist()}}


def _places(found: Draft) -> NDArray[np.float64]:
    """(F, 2) Middle of each foot's geoms in the default pose: ahead, to the left [m]."""
    data = posed(found.robot.physics, found.pose)
    geoms = [[found.robot.id("geom", name) for name in foot.geoms] for foot in found.feet]
    return np.array([data.geom_xpos[each].mean(axis=0)[:2] for each in geoms])


def _energy(found: Draft) -> dict[str, float]:
    """The scale of `energy`. It is smaller for a heavier robot, which needs more power at the same speed."""
    mass = float(found.robot.physics.body_subtreemass[0])
    return {"energy": float(f"{ENERGY.get(len(found.feet), ENERGY[4]) / mass:.2g}")}


def _worlds(found: Draft, shares: tuple[float, float]) -> dict[str, Any]:
    """Domain randomization: delays, and the load on the root, ``shares`` (low, high) of the robot's mass."""
    mass = float(found.robot.physics.body_subtreemass[0])
    return {"base_mass": [round(share * mass, 2) for share in shares], "delay_ms": [0.0, 20.0]}


def _motors(found: Draft) -> dict[str, dict[str, float]]:
    """The maker's armature [kg m^2] and effort [N m] of joints for which the robot's file has none."""
    if not found.maker:
        return {}
    no_armature = [joint.name for joint in found.joints if not joint.armature]
    no_effort = [joint.name for joint in found.joints if not math.isfinite(joint.effort)]
    published = {"armature": found.maker.of("armature", no_armature), "effort": found.maker.of("effort", no_effort)}
    return {name: short_table(known, found.robot.joint_names) for name, known in published.items() if known}


def _of_a_biped(found: Draft, low: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The config values of a biped, in place of BipedCfg's values for a G1. A simple task has fewer difficulties."""
    robot = found.robot
    left, right = _places(found)
    weights = (WALKS, ANKLE, HELD, QUIET) if found.simple else UPRIGHT
    rewards: dict[str, Any] = {
        **low,
        "min_feet_distance": round(0.67 * abs(float(left[1] - right[1])), 2),
        "pose_weights": table(pose_weights(robot, found.pose, found.feet, weights), robot.joint_names),
        "scales": dict(BY_CLOCK) if found.simple else _energy(found),
    }
    worlds = _worlds(found, (-0.03, 0.2))
    if not found.simple:
        ranges = {"lin_vel_x": [-0.5, 1.0], "lin_vel_y": [-0.4, 0.4], "ang_vel_yaw": [-1.0, 1.0]}
        return {"commands": {"ranges": ranges}, "domain_rand": worlds, "rewards": rewards}
    return {
        "commands": {"ranges": {"lin_vel_x": [-0.5, 0.8], "lin_vel_y": [-0.3, 0.3], "ang_vel_yaw": [-0.5, 0.5]}},
        "observations": {"leave_out": {}},
        "domain_rand": {"enable": False, "base_mass": worlds["base_mass"]},
        "perturbation": {"push": False, "velocity": [0.0, 4.0]},
        "rewards": rewards,
    }


def patterns(held: Sequence[str], moving: Sequence[str]) -> list[str]:
    """Short patterns that match all ``held`` joints and no ``moving`` joint, from the first words of their names."""
    result = list[str]()
    for name in held:
        words = family(name)
        options = (f"*{words.partition('_')[0]}*", f"*{words}*", name)
        pattern = next(each for each in options if not any(fnmatchcase(joint, each) for joint in moving))
        if not any(fnmatchcase(name, each) for each in result):
            result.append(pattern)
    return result


def table(numbers: Sequence[float], names: Sequence[str]) -> dict[str, float]:
    """``numbers`` (D,) as a short table: "" has the most frequent value; a joint's family or name has another value."""
    common = Counter(numbers).most_common(1)[0][0]
    short, exact = {"": common}, dict(zip(names, numbers, strict=True))
    for name, number in exact.items():
        different = {other for other, value in exact.items() if family(other) == family(name) and value != number}
        key = name if different else family(name)
        if number != common:
            short[key] = number
    return short if _reads(short, names, numbers) else exact


def short_table(known: dict[str, float], names: Sequence[str]) -> dict[str, float]:
    """``table`` of ``said`` if it has a value for each of ``names``; else ``said`` itself."""
    return table([known[name] for name in names], names) if len(known) == len(names) else known


def _reads(short: Mapping[str, float], names: Sequence[str], numbers: Sequence[float]) -> bool:
    try:
        return per_joint(short, names, "") == list(numbers)
    except ModelError:
        return False


# ---- the feet: the lowest bodies without children, and bodies of the same family on other legs

# [m], share of the robot's height: the end of a limb is a foot if it is at most this much higher than the lowest one
_SAME, _SAME_SHARE = 0.03, 0.08
_SOLE = 0.015  # [m] geoms up to this much higher than the lowest geom of a foot belong to its sole


class Foot(NamedTuple):
    """A foot with a name for the task's config."""

    name: str  # of its only geom, of a body with exactly these geoms, or of a body with more geoms
    geoms: tuple[str, ...]
    known: bool  # whether the name selects exactly these geoms


def guess_feet(robot: RobotModel, qpos: NDArray[np.float64]) -> list[Foot]:
    """The feet in the order of the file, for the robot at ``qpos`` (7 + D,).

    Raises ModelError if no end of a limb collides.
    """
    model, parents = robot.physics, {*robot.physics.body_parentid[1:]}
    colliding = [g for g in range(robot.ground_geoms().stop, model.ngeom) if model.geom_conaffinity[g]]
    names = [model.geom(g).name for g in colliding if model.geom_bodyid[g] not in parents]
    of_body: dict[int, dict[int, float]] = {}
    for name, points in surfaces(model, posed(model, qpos[7:], qpos[:7]), names).items():
        geom = model.geom(name)
        of_body.setdefault(int(geom.bodyid[0]), {})[geom.id] = float(points[:, 2].min())
    if not of_body:
        raise ModelError(
            "no part that ends a limb collides, so that no feet can be guessed; give the feet colliding geoms"
        )
    lowest = min(min(heights.values()) for heights in of_body.values())
    near = lowest + max(_SAME, _SAME_SHARE * (float(qpos[2]) - lowest))
    soles = {body: _sole(model, heights) for body, heights in of_body.items() if min(heights.values()) <= near}
    for body, heights in of_body.items():  # the foot of a lifted leg is not low
        same = [
            other for other in soles if family(model.body(other).name) == family(model.body(body).name or str(body))
        ]
        if body not in soles and same and len(of_body[same[0]]) == len(heights):
            soles[body] = [geom for geom, twin in zip(heights, of_body[same[0]], strict=True) if twin in soles[same[0]]]
    return _renamed(robot, [_foot(robot, body, soles[body]) for body in sorted(soles)])


def _refuse_lost_feet(robot: RobotModel, qpos: NDArray[np.float64], feet: Sequence[Foot]) -> None:
    """Raise ModelError if a mesh at the low end of a limb cannot be read, because it may be a foot."""
    model, data = robot.physics, posed(robot.physics, qpos[7:], qpos[:7])
    low = min(float(data.geom_xpos[robot.id("geom", geom), 2]) for foot in feet for geom in foot.geoms)
    for body in {*range(1, model.nbody)} - {*model.body_parentid}:
        name = model.body(body).name
        is_low = data.xpos[body, 2] < 0.5 * (low + float(qpos[2]))
        if name in robot.names.lost and not robot.names.bodies[name] and is_low:
            raise ModelError(robot.names.lost[name])


def _sole(model: mujoco.MjModel, low: dict[int, float]) -> list[int]:
    """The sole of a body: its lowest geom, and geoms of the same type at about the same height.

    ``low``: geom -> z of its lowest point [m, world frame].
    """
    lowest = min(low, key=lambda geom: low[geom])
    return [g for g, z in low.items() if z <= low[lowest] + _SOLE and model.geom_type[g] == model.geom_type[lowest]]


def _foot(robot: RobotModel, body: int, geoms: list[int]) -> Foot:
    """The foot with these geoms of ``body``, named by its geom or body."""
    names = tuple(robot.physics.geom(geom).name for geom in geoms)
    # includes bodies that are fused in the simulated model
    parts = [part for part, geoms in robot.names.bodies.items() if {*geoms} == {*names}]
    if parts:
        return Foot(parts[-1], names, True)
    owner = robot.physics.body(body).name
    return Foot(names[0], names, True) if len(names) == 1 else Foot(owner, names, False)


def _renamed(robot: RobotModel, feet: Sequence[Foot]) -> list[Foot]:
    """Rename feet with a generated geom name by their side: FL_calf_4 becomes FL_foot, if that name is free."""
    new = list[Foot]()
    for foot in feet:
        owner = robot.physics.body(int(robot.physics.geom(foot.geoms[0]).bodyid[0])).name
        side = [part for part in owner.split("_") if part not in (*family(owner).split("_"), "joint")]
        generated = re.fullmatch(rf"{re.escape(owner)}_\d+", foot.name) and side
        new.append(Foot("_".join([*side, "foot"]), foot.geoms, False) if generated else foot)
    used = {*robot.names.geoms, *robot.names.bodies, *(foot.name for foot in feet)}
    clash = len({foot.name for foot in new}) < len(new) or any(
        foot.name in used for foot, old in zip(new, feet, strict=True) if foot is not old
    )
    return list(feet) if clash else new


# ---- weights of the pose reward

# a biped with a gait clock: weights of configs/robots/g1.py; arms have the waist's weight, so that they move little
WALKS, ANKLE, HELD, QUIET = 0.02, 0.05, 0.5, 1.0
# a biped without: 1 / (29 std^2), with mjlab's standard deviations of a walking G1: 0.5, 0.15, 0.15 and 0.1 rad
UPRIGHT = (0.14, 1.5, 1.5, 3.4)
KNEE_WALKS = 0.1  # with more feet; all other joints have 1 [MuJoCo Playground]


def pose_weights(
    robot: RobotModel,
    pose: Sequence[float],
    feet: Sequence[Foot],
    biped: tuple[float, float, float, float] = (WALKS, ANKLE, HELD, QUIET),
) -> list[float]:
    """Weights (D,) of the pose reward. Hip and knee have the smallest weights; with more than two feet only the knee.

    ``biped``: the weights with two feet: hip and knee, ankle, other leg joints, arms and waist.
    """
    walks, ankle, held, quiet = biped
    model, data = robot.physics, posed(robot.physics, pose)
    weights = [quiet if len(feet) == 2 else 1.0] * len(robot.joint_names)
    for foot in feet:
        legs = joints_to(model, foot.geoms)
        sideways = [joint for joint in legs if abs(data.xaxis[joint][1]) > SIDEWAYS]
        if len(feet) != 2:
            for joint in sideways[1:2]:
                weights[joint - 1] = KNEE_WALKS
            continue
        for joint in legs:
            weights[joint - 1] = held
        for joint in sideways[:2]:
            weights[joint - 1] = walks
        for joint in legs[legs.index(sideways[1]) + 1 :] if len(sideways) > 1 else ():
            weights[joint - 1] = ankle
    return weights
