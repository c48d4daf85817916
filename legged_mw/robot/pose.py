"""Choose the default pose of a draft: make candidates, find the faults of each, and sort them.

Candidates are the file's keyframe, the maker's published pose, computed crouches, and all joints at 0. The first of
them without a fault is chosen; of the crouches, the best one. If all have faults, the pose with the fewest is chosen.

A leg is the chain of joints from the root to a foot. Its pitch joints (axis along y) move the foot in a plane. The
first is the hip. If the sole is flat, the last one levels it. Of the others, the knee changes the leg's length most.
Angles of the sole are rotations about y (left) [rad]; lengths are in metres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.robot.makers import Maker
from legged_mw.robot.measure import SAG, inside_by
from legged_mw.sim.joints import posed
from legged_mw.sim.model import RobotModel
from legged_mw.sim.surface_points import SPACING, spheres_on, surfaces

FloatArray = NDArray[np.float64]

# Ours: bend of a knee that can be straight, by number of feet. Published: G1 and H1 0.3, T1 0.4, ANYmal 1.1.
FOLD, FOLD_ELSE = {2: 0.35}, 0.95  # [rad] from the straight leg
# Bend of a knee that cannot be straight: the leg's length is at this share of its range, from shortest to longest. It
# bends the knees of A1, Go2 and B2 by 1.43 to 1.55 rad; their makers publish 1.5.
STROKE = 0.73
DEPTHS = (0.5, 1.0, 1.5)  # factors on this bend, one candidate each
_STRAIGHT = 0.995  # a knee can be straight if it allows this share of the leg's largest length
SIDEWAYS = 0.9  # smallest |y| of the axis of a pitch joint
_BEHIND = 0.03  # [m] if the foot is more than this behind the knee, the knee bends the other way (ANYmal's hind legs)
_MARGIN = 0.05  # [rad] distance of a computed angle to the limits of a joint
_FLAT = 0.04  # [m] a flat sole is longer than this
_THIN = 0.004  # [m] points of a sole up to this far above its lowest point are in its plane
_PRESSED = 0.015  # [m] points of a sole up to this far above its lowest point touch the ground under the robot's weight

# Limits of the faults; ours. Go2's keyframe has a reach of 0.62 and a height error of 2 cm; B2's has 0.22 and 35 cm.
AT_LIMIT = 0.02  # [rad] distance to a joint's limit
FOLDED, UPRIGHT = 0.45, 0.1  # smallest reach: share of the straight leg's length; smallest bend of a knee [rad]
TILTED = 0.15  # [rad] tilt of a flat sole
AWAY = 0.35  # share of the leg's length: distance of the foot from below the hip, along x
HEIGHT = 0.2  # share of the leg's length: error of the keyframe's height
UNEVEN = 0.1  # share of the leg's length: difference in height between the feet
BEND = 0.4  # [rad] error of a knee's bend that counts as much as a sag of SAG


Sole = tuple[str, ...]  # the geoms of a foot


class Leg(NamedTuple):
    """A leg in its plane, in the neutral pose. P points of the sole."""

    joints: tuple[int, ...]  # pitch joints from hip to foot, indices in the model
    knee: int  # index in ``joints``
    rest: FloatArray  # (joints,) [rad] neutral angles
    spare: FloatArray  # (joints,) [rad] offsets of the other joints: the middle of a range without 0, else 0
    signs: FloatArray  # (joints,) signs of the axes along y
    places: FloatArray  # (joints, 2) [m] x and z
    sole: FloatArray  # (P, 2) [m] x and z
    level: float  # [rad] rotation of the foot that levels its sole
    flat: bool  # whether the sole is flat; then the last joint levels it
    straight: float  # [rad] angle of the knee at which the leg is longest
    folds: tuple[float, ...]  # [rad] bends of the knee from ``straight``, with sign; the better direction first
    length: float  # [m] of the straight leg


class Candidate(NamedTuple):
    """A pose to be judged."""

    name: str
    angles: FloatArray  # (D,) [rad]
    rank: int  # 0 the file's, 1 the maker's, 2 computed, 3 zero
    height: float | None = None  # [m] height of the root that belongs to the pose, if any
    source: str = ""


class Judged(NamedTuple):
    """A candidate with its faults. ``off`` is its error as a crouch: smaller is better."""

    candidate: Candidate
    faults: tuple[str, ...]
    off: float
    height: float  # [m] of the root, with the lowest foot on the ground
    reach: float  # share of the straight leg's length; smallest of the legs
    margin: float  # [m] from the centre of mass to the edge of the support polygon; negative: outside
    sag: float  # [rad] largest position error of the legs' servos at rest

    @property
    def verdict(self) -> str:
        return "; ".join(self.faults) or "no fault"


def judge_poses(robot: RobotModel, feet: Sequence[Sole], maker: Maker | None, keyframe: bool) -> list[Judged]:
    """All candidates, the chosen one first. ``keyframe``: whether ``robot.pose`` is the pose of the file's keyframe."""
    zero = np.clip(np.zeros(len(robot.joint_names)), *robot.joint_range.T)
    neutral = hang_arms(robot, zero, feet)
    feet = [_whole(robot, neutral, foot) for foot in feet]
    legs = find_legs(robot, neutral, feet)
    candidates = []
    if keyframe and robot.keyframe is not None:
        candidates.append(Candidate("the file's keyframe", np.array(robot.pose), 0, robot.keyframe.height))
    if maker and maker.pose:
        published = maker.of("pose", robot.joint_names)
        angles = [published.get(name, angle) for name, angle in zip(robot.joint_names, neutral, strict=True)]
        candidates.append(Candidate("its maker's", np.array(angles), 1, source=maker.source))
    candidates += crouches(robot, neutral, legs)
    candidates.append(Candidate("all joints at 0, or at the nearest end of their range", zero, 3))
    judged = [judge(robot, candidate, legs, feet, maker) for candidate in candidates]
    return sorted(judged, key=lambda each: (bool(each.faults), *_order(each)))


def _order(judged: Judged) -> tuple[float, float]:
    """The sort key: source and error of a pose without faults; number of faults and error of a pose with faults."""
    if not judged.faults:
        return judged.candidate.rank, judged.off
    return len(judged.faults), judged.off


# ---- legs ----


def find_legs(robot: RobotModel, neutral: FloatArray, feet: Sequence[Sole]) -> list[Leg]:
    """The legs, one per foot. Empty if a leg has fewer than two pitch joints."""
    model = robot.physics
    data = posed(model, neutral)
    points = surfaces(model, data, [geom for foot in feet for geom in foot])
    legs = []
    for foot in feet:
        joints = _pitch_joints(robot, neutral, foot)
        if len(joints) < 2:
            return []
        sole = np.concatenate([points[geom] for geom in foot])[:, [0, 2]]
        legs.append(_leg(model, data, neutral, joints, sole, len(feet)))
    return legs


def _whole(robot: RobotModel, neutral: FloatArray, foot: Sole) -> Sole:
    """The foot, with all colliding geoms of its body if the leg has an ankle; the shank may belong to it without one.

    Without them, a tilted sole would have only its lowest geoms.
    """
    model = robot.physics
    if len(_pitch_joints(robot, neutral, foot)) < 3:
        return foot
    body = model.body(int(model.geom(foot[0]).bodyid[0]))
    geoms = range(int(body.geomadr[0]), int(body.geomadr[0] + body.geomnum[0]))
    return tuple(model.geom(geom).name for geom in geoms if model.geom_conaffinity[geom])


def joints_to(model: mujoco.MjModel, foot: Sole) -> list[int]:
    """The joints from the root to the foot, without the root joint."""
    body, joints = int(model.geom(foot[0]).bodyid[0]), []
    while body:
        first = int(model.body_jntadr[body])
        joints += [joint for joint in range(first, first + int(model.body_jntnum[body])) if joint > 0]
        body = int(model.body_parentid[body])
    return sorted(joints)


def _pitch_joints(robot: RobotModel, neutral: FloatArray, foot: Sole) -> list[int]:
    """The joints to the foot with an axis along y, without those of wheels."""
    model, wheels = robot.physics, find_wheels(robot, neutral)
    data = posed(model, neutral)
    hinges = [joint for joint in joints_to(model, foot) if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE]
    return [j for j in hinges if abs(data.xaxis[j][1]) > SIDEWAYS and model.joint(j).name not in wheels]


def _leg(
    model: mujoco.MjModel, data: mujoco.MjData, neutral: FloatArray, joints: list[int], sole: FloatArray, feet: int
) -> Leg:
    places, signs = data.xanchor[joints][:, [0, 2]].copy(), np.sign(data.xaxis[joints, 1])
    rest, spans = neutral[np.array(joints) - 1], np.array([_range(model, joint) for joint in joints])
    level, length = _level(signs, spans - rest[:, None], sole)
    flat = length > _FLAT and len(joints) > 2
    if flat:
        up = _rotate(level, sole)[:, 1]
        sole = sole[up <= up.min() + _PRESSED]
    leg = Leg(tuple(joints), 1, rest, np.zeros(len(joints)), signs, places, sole, level, flat, 0.0, (), 0.0)
    middle = range(1, len(joints) - (1 if flat else 0))
    leg = leg._replace(knee=max(middle, key=lambda place: _stroke(leg, place, spans[place])))
    for place in middle:
        low, high = spans[place]
        if place != leg.knee and not low + _MARGIN < 0.0 < high - _MARGIN:
            leg.spare[place] = 0.5 * (low + high) - rest[place]
    low, high = spans[leg.knee]
    angles, lengths = _lengths(leg, leg.knee)
    straight, inside = float(angles[lengths.argmax()]), (angles >= low) & (angles <= high)
    if lengths[inside].max() >= _STRAIGHT * lengths.max():
        bend = FOLD.get(feet, FOLD_ELSE)
        # a quadruped's thighs lean back (Go1 0.9 and -1.8), a biped's forwards
        better = signs[leg.knee] * (1.0 if feet == 2 or not _foot_ahead(leg) else -1.0)
        folds = [way * bend for way in (better, -better) if low <= straight + way * bend <= high] or [0.0]
    else:
        target = lengths[inside].min() + STROKE * float(np.ptp(lengths[inside]))
        folds = [angles[inside][np.abs(lengths[inside] - target).argmin()] - straight]
    return leg._replace(straight=straight, length=float(lengths.max()), folds=tuple(float(fold) for fold in folds))


def _lengths(leg: Leg, place: int) -> tuple[FloatArray, FloatArray]:
    """Angles of the joint at index ``place`` over a full turn [rad], and the leg's length at each [m]."""
    angles, lengths = np.linspace(-math.pi, math.pi, 721), []
    for angle in angles:
        turns = leg.spare.copy()
        turns[place] = angle - leg.rest[place]
        lengths.append(float(np.linalg.norm(_end(leg, turns) - leg.places[0])))
    return angles, np.array(lengths)


def _stroke(leg: Leg, place: int, span: FloatArray) -> float:
    """The range [m] of the leg's length while the joint at index ``place`` moves over its ``span`` (2,) [rad]."""
    angles, lengths = _lengths(leg, place)
    inside = lengths[(angles >= span[0]) & (angles <= span[1])]
    return float(np.ptp(inside)) if len(inside) else 0.0


def _foot_ahead(leg: Leg) -> bool:
    """Whether the foot is below or ahead of the knee in the neutral pose."""
    return float(leg.sole[:, 0].mean() - leg.places[leg.knee, 0]) >= -_BEHIND


def _rotate(angle: float, vector: FloatArray) -> FloatArray:
    """``vector`` (..., 2) of x and z, rotated about y by ``angle`` [rad]."""
    cos, sin = math.cos(angle), math.sin(angle)
    return vector @ np.array([[cos, -sin], [sin, cos]])


def _anchors(leg: Leg, turns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Joint positions (joints, 2) [m] and child link rotations (joints,) [rad] at ``turns`` [rad] from neutral."""
    pitch = np.cumsum(leg.signs * turns)
    places = [leg.places[0]]
    for i in range(1, len(leg.joints)):
        places.append(places[-1] + _rotate(pitch[i - 1], leg.places[i] - leg.places[i - 1]))
    return np.array(places), pitch


def _end(leg: Leg, turns: FloatArray) -> FloatArray:
    """The end of the leg (2,) [m]: the last joint if the sole is flat, else the middle of the foot."""
    places, pitch = _anchors(leg, turns)
    if leg.flat:
        return places[-1]
    return places[-1] + _rotate(pitch[-1], leg.sole.mean(axis=0) - leg.places[-1])


def _level(signs: FloatArray, spans: FloatArray, sole: FloatArray) -> tuple[float, float]:
    """The rotation [rad] of the foot at which the longest part of its sole touches the ground, and its length [m].

    Of equal rotations, the smallest is returned. ``spans`` (joints, 2) [rad]: ranges of the joints relative to neutral.
    They limit the rotation, and so does 90 degrees.
    """
    ends = np.sort(signs[:, None] * spans, axis=1).sum(axis=0)
    low, high = max(float(ends[0]), -0.5 * math.pi), min(float(ends[1]), 0.5 * math.pi)
    best = (0.0, 0.0)
    for angle in sorted(np.linspace(low, high, 181), key=abs):
        turned = _rotate(float(angle), sole)
        touching = turned[turned[:, 1] <= turned[:, 1].min() + _THIN, 0]
        if (length := float(np.ptp(touching))) > best[1] + 0.002:
            best = (float(angle), length)
    return best


def _range(model: mujoco.MjModel, joint: int) -> tuple[float, float]:
    if not model.jnt_limited[joint]:
        return -math.pi, math.pi
    low, high = model.jnt_range[joint]
    return float(low), float(high)


# ---- arms ----

_BESIDE = 0.03  # [m] a joint farther from the middle plane belongs to an arm, not to waist or head
_LIGHT = 0.005  # share of the robot's mass; a joint that carries less belongs to a finger
_STAY = 0.01  # [m/rad] cost of an angle away from 0, so that joints without an effect on the height stay at 0


def walking_joints(model: mujoco.MjModel, feet: Sequence[Sole]) -> set[int]:
    """Indices in (D,) of the joints between the root and a foot, without those that carry all feet, as a waist does."""
    legs = [{joint - 1 for joint in joints_to(model, foot)} for foot in feet]
    return set.union(*legs) - (set.intersection(*legs) if len(legs) > 1 else set())


def hang_arms(robot: RobotModel, zero: FloatArray, feet: Sequence[Sole]) -> FloatArray:
    """``zero`` (D,) with hanging arms: their centre of mass is lowest. Waist, head and fingers stay."""
    model, angles, total = robot.physics, zero.copy(), float(robot.physics.body_subtreemass[0])
    data, walking = posed(model, zero), walking_joints(model, feet)
    arms = [
        joint
        for joint in range(1, model.njnt)
        if joint - 1 not in walking
        and abs(data.xanchor[joint][1] - data.qpos[1]) > _BESIDE
        and model.body_subtreemass[model.jnt_bodyid[joint]] > _LIGHT * total
    ]
    for _ in range(2):  # twice, because an elbow moves the centre of mass that a shoulder carries
        for joint in arms:
            low, high = _range(model, joint)
            options = np.unique([zero[joint - 1], *np.linspace(low + _MARGIN, high - _MARGIN, 61)])
            costs = [
                _height_of(model, angles, joint, option) + _STAY * abs(option - zero[joint - 1]) for option in options
            ]
            angles[joint - 1] = options[int(np.argmin(costs))]
    return angles.round(2)


def _height_of(model: mujoco.MjModel, angles: FloatArray, joint: int, angle: float) -> float:
    """The height [m] of the centre of mass of the links that the joint carries, with the joint at ``angle`` [rad]."""
    trial = angles.copy()
    trial[joint - 1] = angle
    data = posed(model, trial)
    mujoco.mj_comPos(model, data)
    return float(data.subtree_com[model.jnt_bodyid[joint], 2])


# ---- wheels ----

_ROUND = 0.05  # share of the radius: largest deviation of a wheel from a circle


def find_wheels(robot: RobotModel, pose: FloatArray) -> list[str]:
    """The names of joints at the end of a limb that have no range and whose collider is round about the axis."""
    model = robot.physics
    data = posed(model, pose)
    wheels = []
    for joint in range(1, model.njnt):
        body = int(model.jnt_bodyid[joint])
        first, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
        geoms = [geom for geom in range(first, first + count) if model.geom_conaffinity[geom]]
        turns = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE and not model.jnt_limited[joint]
        if turns and geoms and body not in model.body_parentid and _is_round(model, data, joint, geoms):
            wheels.append(model.joint(joint).name)
    return wheels


def _is_round(model: mujoco.MjModel, data: mujoco.MjData, joint: int, geoms: Sequence[int]) -> bool:
    """Whether the outline of ``geoms``, seen along the axis of ``joint``, is a circle about it."""
    axis = data.xaxis[joint]
    normal = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    normal /= np.linalg.norm(normal)
    angles = np.linspace(0.0, 2.0 * math.pi, 32, endpoint=False)[:, None]
    directions = np.cos(angles) * normal + np.sin(angles) * np.cross(axis, normal)  # (32, 3)
    reach = np.zeros(len(directions))  # [m] radius of the outline in each direction
    for geom in geoms:
        centers, radius = spheres_on(model, geom, SPACING)
        points = data.geom_xpos[geom] + centers @ data.geom_xmat[geom].reshape(3, 3).T - data.xanchor[joint]
        reach = np.maximum(reach, (directions @ points.T).max(axis=1) + radius)
    return bool(reach.min() > (1.0 - _ROUND) * reach.max())


# ---- crouches ----


def crouches(robot: RobotModel, neutral: FloatArray, legs: Sequence[Leg]) -> list[Candidate]:
    """Crouches of several depths and both knee directions, if possible. The feet are flat and under the hips."""
    if not legs:
        return []
    by_angles = {}
    for side in range(max(len(leg.folds) for leg in legs)):
        for depth in DEPTHS:
            angles = neutral.copy()
            for leg in legs:
                bend = depth * leg.folds[min(side, len(leg.folds) - 1)]
                angles[np.array(leg.joints) - 1] = _bend(robot.physics, leg, leg.straight + bend)
            mean_bend = round(float(np.mean([abs(leg.folds[0]) for leg in legs])) * depth, 2)
            name = f"knees bent by {mean_bend:g} rad{', the other way' if side else ''}"
            by_angles[angles.round(2).tobytes()] = Candidate(name, angles, 2)
    return list(by_angles.values())


def _bend(model: mujoco.MjModel, leg: Leg, knee: float) -> FloatArray:
    """The angles (joints,) [rad] of the leg with its knee at ``knee`` [rad]."""
    turns = leg.spare.copy()
    turns[leg.knee] = _within(model, leg.joints[leg.knee], knee) - leg.rest[leg.knee]
    # rotate the hip until the foot is under it
    along = float(_rotate(leg.level, leg.sole - leg.places[-1])[:, 0].mean()) if leg.flat else 0.0
    end = _end(leg, turns) - leg.places[0]
    below = math.sqrt(max(float(end @ end) - along**2, 0.0))
    turn = math.remainder(math.atan2(end[1], end[0]) - math.atan2(-below, -along), 2.0 * math.pi)
    turns[0] = _within(model, leg.joints[0], leg.signs[0] * turn + leg.rest[0]) - leg.rest[0]
    if leg.flat:
        carried = float((leg.signs * turns)[:-1].sum())
        turn = leg.signs[-1] * math.remainder(leg.level - carried, 2.0 * math.pi)
        turns[-1] = _within(model, leg.joints[-1], turn + leg.rest[-1]) - leg.rest[-1]
    return leg.rest + turns


def _within(model: mujoco.MjModel, joint: int, angle: float) -> float:
    """The nearest angle [rad] within the joint's limits, with a margin."""
    if not model.jnt_limited[joint]:
        return float(angle)
    low, high = model.jnt_range[joint]
    margin = min(_MARGIN, 0.25 * (high - low))
    return float(np.clip(angle, low + margin, high - margin))


# ---- faults ----


def judge(
    robot: RobotModel, candidate: Candidate, legs: Sequence[Leg], feet: Sequence[Sole], maker: Maker | None
) -> Judged:
    """The faults and figures of a pose."""
    model = robot.physics
    angles = np.clip(candidate.angles, *robot.joint_range.T)
    data = posed(model, angles)
    mujoco.mj_comPos(model, data)
    points = surfaces(model, data, [geom for foot in feet for geom in foot])
    soles = [np.concatenate([points[geom] for geom in foot]) for foot in feet]
    lows = np.array([sole[:, 2].min() for sole in soles])
    size = max((leg.length for leg in legs), default=max(-float(lows.min()), 0.1))
    standing = [sole for sole, low in zip(soles, lows, strict=True) if low <= lows.min() + UNEVEN * size]
    touching = np.concatenate([sole[sole[:, 2] <= sole[:, 2].min() + _PRESSED] for sole in standing])
    margin = inside_by(touching[:, :2], data.subtree_com[0, :2])
    faults = [*_limits(robot, candidate.angles, legs)]
    reach, off = 1.0, 0.0
    for leg in legs:
        fault, reached, error = _posture(angles, leg)
        faults, reach, off = [*faults, *fault], min(reach, reached), off + error / len(legs)
    if candidate.height is not None and abs(candidate.height + lows.min()) > HEIGHT * size:
        faults.append(f"says the root is {candidate.height:.2f} m high, but stands at {-lows.min():.2f} m")
    if (uneven := float(np.ptp(lows))) > UNEVEN * size:
        faults.append(f"lifts a foot by {100 * uneven:.0f} cm")
    if margin < 0.0:
        faults.append(f"centre of mass {-1e3 * margin:.0f} mm outside of the feet")
    flat = bool(legs) and all(leg.flat for leg in legs)
    sag, worst = _sag(robot, data, feet, soles, maker, flat)
    if sag > SAG:
        faults.append(f"{worst} sags by {sag:.2f} rad")
    unique = tuple(dict.fromkeys(faults))
    return Judged(candidate, unique, off + sag / SAG, -float(lows.min()), reach, margin, sag)


def _limits(robot: RobotModel, angles: FloatArray, legs: Sequence[Leg]) -> list[str]:
    """A fault if a leg joint is at its limit or another joint is beyond it."""
    walking = {joint - 1 for leg in legs for joint in leg.joints}
    low, high = robot.joint_range.T
    distance = np.minimum(angles - low, high - angles)
    bad = [i for i in range(len(angles)) if distance[i] < (AT_LIMIT if i in walking else -AT_LIMIT)]
    if not bad:
        return []
    text = ", ".join(robot.joint_names[i] for i in bad[:2]) + (f" and {len(bad) - 2} more" if bad[2:] else "")
    return [f"{text} at the end of the range"]


def _posture(angles: FloatArray, leg: Leg) -> tuple[list[str], float, float]:
    """The faults of one leg, its reach (share of the straight leg's length), and its error as a crouch."""
    faults, turns = [], angles[np.array(leg.joints) - 1] - leg.rest
    places, pitch = _anchors(leg, turns)
    reach = float(np.linalg.norm(_end(leg, turns) - leg.places[0])) / leg.length
    bend = angles[leg.joints[leg.knee] - 1] - leg.straight
    if reach < FOLDED:
        faults.append(f"folded: legs at {100 * reach:.0f} % of their length")
    if abs(bend) < UPRIGHT:
        faults.append("straight knees")
    middle = places[-1] + _rotate(float(pitch[-1]), leg.sole.mean(axis=0) - leg.places[-1])
    offset = abs(float(middle[0] - leg.places[0, 0])) / leg.length
    if offset > AWAY:
        faults.append("feet not under the hips")
    tilt = abs(math.remainder(float(pitch[-1]) - leg.level, 2.0 * math.pi)) if leg.flat else 0.0
    if tilt > TILTED:
        faults.append(f"soles tilted by {tilt:.2f} rad")
    return faults, reach, abs(bend - leg.folds[0]) / BEND + offset / AWAY + tilt / TILTED


def _sag(
    robot: RobotModel,
    data: mujoco.MjData,
    feet: Sequence[Sole],
    soles: Sequence[FloatArray],
    maker: Maker | None,
    flat: bool,
) -> tuple[float, str]:
    """The largest sag [rad] of a leg's servo (position error at rest), and its joint.

    The stiffness is the maker's, else full effort at 1 rad, as in ``measure.suggest``. ``flat``: the soles are flat.
    """
    model, names = robot.physics, robot.joint_names
    mujoco.mj_forward(model, data)
    torque, com = data.qfrc_bias.copy(), data.subtree_com[0, :2]
    places = np.array([sole.mean(axis=0) for sole in soles])
    weight = float(model.body_subtreemass[0]) * float(np.linalg.norm(model.opt.gravity))
    # forces at the middles of the feet balance the weight; flat soles shift these points to balance the rest
    balance = np.vstack([np.ones(len(feet)), places[:, :2].T - com[:, None]])
    forces = np.clip(np.linalg.lstsq(balance, np.array([weight, 0.0, 0.0]), rcond=None)[0], 0.0, None)
    forces *= weight / max(float(forces.sum()), 1e-9)
    if flat:
        places[:, :2] += com - forces @ places[:, :2] / weight
    for foot, place, force in zip(feet, places, forces, strict=True):
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, place, int(model.geom(foot[0]).bodyid[0]))
        torque -= jacobian[2] * force
    known = maker.of("kp", names) if maker else {}
    walking = sorted(walking_joints(model, feet))
    stiffness = {i: known.get(names[i]) or float(robot.effort_range[i, 1]) for i in walking}
    sags = {i: abs(float(torque[6 + i])) / stiffness[i] for i in walking if stiffness[i] > 0.0}
    if not sags:
        return 0.0, ""
    worst = max(sags, key=lambda i: sags[i])
    return sags[worst], names[worst]


# ---- as text ----


def as_lines(judged: Sequence[Judged]) -> list[str]:
    """A text table of all candidates, the chosen one first, with the reasons against the others."""
    rows = [("pose", "root [m]", "legs", "com [mm]", "sag [rad]", "")]
    for each in judged:
        numbers = f"{each.height:.3f}", f"{100 * each.reach:.0f} %", f"{1e3 * each.margin:+.0f}", f"{each.sag:.2f}"
        rows.append((each.candidate.name, *numbers, why(judged[0], each)))
    widths = [max(len(row[column]) for row in rows) for column in range(5)]
    lines = []
    for name, *numbers, reason in rows:
        cells = [name.ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(numbers, widths[1:], strict=True))]
        lines.append("  ".join([*cells, reason]).rstrip())
    return lines


def why(chosen: Judged, other: Judged) -> str:
    """The reason why ``other`` is or is not the chosen pose."""
    if other is chosen:
        return "; ".join(["chosen", *chosen.faults])
    if other.faults:
        return other.verdict
    if other.candidate.rank > chosen.candidate.rank:
        return f"no fault, but {'nobody stated it' if other.candidate.rank > 1 else 'the keyframe comes first'}"
    return f"no fault, but further from a good crouch ({other.off:.1f} against {chosen.off:.1f})"
