"""Makes four reference clips for the G1 by inverse kinematics: squat, wave, kick, turn. Ours, under this repository's licence.

    python examples/make_motions.py [FOLDER]         # resources/motions, if no folder is given
    python -m legged_mw.motion resources/motions/g1_kick.npz --sheet kick.png

A clip gives the poses of the feet, the zero moment point, and the poses of waist, arms and pelvis. The centre of mass
follows from the zero moment point p by the model of an inverted pendulum: z'' = g / h (z - p). Root and legs follow
from feet, centre of mass and pelvis in each frame, by damped least squares.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np

from configs.robots.g1 import G1
from legged_mw import ROOT
from legged_mw.skills.clip import (
    Clip,
    Floats,
    checked,
    conjugate,
    from_rotation_vector,
    multiply,
    rotation_vector,
    save_clip,
)
from legged_mw.utils.task import load_task

RATE, GRAVITY = 50.0, 9.81  # [1/s], [m/s^2]
SIDES = ("left", "right")
ANKLE = 0.035  # [m] height of an ankle above the ground, with a flat sole
SOLE = 0.035  # [m] from an ankle ahead to the centre of its sole
SWING = 0.07  # [m] height of a foot at mid swing
STEP, DOUBLE = 0.8, 0.35  # [s] duration of a step; share of it with both feet on the ground
ARMS = {"shoulder_pitch": 0.2, "shoulder_roll": 0.2, "elbow": 0.8}  # [rad] the default pose


@dataclass
class Plan:
    """The targets of a clip over T frames. ``keyed`` makes such arrays from a few numbers."""

    seconds: float
    # for each side (T, 4): position of the ankle [m], heading of the foot [rad]
    feet: list[Floats] = field(default_factory=list)
    push: Floats = field(default_factory=lambda: np.zeros(0))  # (T, 2) zero moment point [m]
    height: Floats = field(default_factory=lambda: np.zeros(0))  # (T,) height of the pelvis [m]
    tilt: Floats = field(default_factory=lambda: np.zeros(0))  # (T, 3) roll, pitch, heading of the pelvis [rad]
    # joints of waist and arms (T,) [rad]; the others are in the default pose
    joints: dict[str, Floats] = field(default_factory=dict)
    raised: Floats | None = None  # (T,) weight of the angles `leg` of the right leg, 0 to 1; 0: by its foot
    leg: dict[str, Floats] = field(default_factory=dict)  # joints of the right leg (T,) [rad]


def keyed(seconds: float, keys: Mapping[float, float | Sequence[float]]) -> Floats:
    """Interpolate time [s] -> value at every frame. Speed and acceleration are zero at the given times."""
    now, times = np.arange(round(seconds * RATE) + 1) / RATE, np.array(list(keys), dtype=float)
    values = np.array(list(keys.values()), dtype=float)
    part = np.clip(np.searchsorted(times, now, side="right") - 1, 0, len(times) - 2)
    share = np.clip((now - times[part]) / (times[part + 1] - times[part]), 0.0, 1.0)
    done = smooth(share)[:, None] if values.ndim > 1 else smooth(share)
    return values[part] + done * (values[part + 1] - values[part])


def smooth(share: Floats) -> Floats:
    """A polynomial from 0 to 1 for ``share`` from 0 to 1. Speed and acceleration are zero at both ends."""
    return share**3 * (10 - 15 * share + 6 * share**2)


class Body:
    """The robot's model, posed frame by frame."""

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_path(str(ROOT / G1.asset.file))
        self.data = mujoco.MjData(self.model)
        self.names = [self.model.joint(j).name for j in range(1, self.model.njnt)]
        task = load_task("g1_flat")
        task.cfg.env.num_envs = 1
        self.default = np.array(task.env_class(task.cfg, "cpu", eager=True).robot.pose)
        self.ankles = [self.model.body(f"{side}_ankle_roll_link").id for side in SIDES]
        self.pelvis = self.model.body("pelvis").id
        legs = [self.names.index(name) for name in self.names if any(part in name for part in ("hip", "knee", "ankle"))]
        self.legs = np.array(legs)  # indices of the joints; first the six of the left leg
        self.data.qpos[:] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, *self.default]
        mujoco.mj_forward(self.model, self.data)
        self.standing = ANKLE - float(self.data.xpos[self.ankles[0], 2])  # [m] height of the pelvis in the default pose
        self.data.qpos[2] = self.standing
        mujoco.mj_forward(self.model, self.data)
        self.stance = [float(self.data.xpos[ankle, 1]) for ankle in self.ankles]  # [m] of each ankle, to the left
        self.com_height = float(self.data.subtree_com[0, 2])

    def pose(self, plan: Plan) -> Clip:
        """The clip with the targets of ``plan``."""
        com = swayed(plan.push, self.com_height)
        if plan.raised is None:
            return self._solve(plan, com, None)
        grounded = self._solve(replace(plan, tilt=0.0 * plan.tilt, joints={}), com, None)
        own = grounded.joint_pos.copy()
        for name, angles in plan.leg.items():
            joint = self.names.index(name)
            own[:, joint] += plan.raised * (angles - own[:, joint])
        return self._solve(plan, com, own)

    def _solve(self, plan: Plan, com: Floats, leg: Floats | None) -> Clip:
        """Inverse kinematics of all frames. ``leg`` (T, D): angles [rad] of the right leg while it is raised."""
        frames, data = [], self.data
        data.qpos[:] = [0.0, 0.0, self.standing, 1.0, 0.0, 0.0, 0.0, *self.default]
        for t in range(len(plan.push)):
            for name, angles in plan.joints.items():
                data.qpos[7 + self.names.index(name)] = angles[t]
            free = leg is not None and plan.raised is not None and plan.raised[t] > 0.0
            if free and leg is not None:
                data.qpos[7 + self.legs[6:]] = leg[t, self.legs[6:]]
            columns = np.r_[0:6, 6 + (self.legs[:6] if free else self.legs)]
            for _ in range(40):
                error, slope = self._off(plan, com, t, 1 if free else 2)
                move = np.zeros(self.model.nv)
                part = slope[:, columns]
                move[columns] = part.T @ np.linalg.solve(part @ part.T + 1e-6 * np.eye(len(error)), error)
                mujoco.mj_integratePos(self.model, data.qpos, move, 1.0)
                low, high = self.model.jnt_range[1:].T
                data.qpos[7:] = np.clip(data.qpos[7:], low, high)
                if np.abs(error).max() < 1e-7:
                    break
            frames.append(data.qpos.copy())
        path = np.array(frames)
        return checked(Path("clip"), RATE, self.names, path[:, :3], path[:, 3:7], path[:, 7:])

    def _off(self, plan: Plan, com: Floats, t: int, feet: int) -> tuple[Floats, Floats]:
        """Error and Jacobian of the targets of frame ``t``: ankles, centre of mass, pelvis."""
        model, data = self.model, self.data
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        errors, slopes, place, turn = [], [], np.zeros((3, model.nv)), np.zeros((3, model.nv))
        for ankle, wanted in zip(self.ankles[:feet], plan.feet, strict=False):
            mujoco.mj_jacBody(model, data, place, turn, ankle)
            errors += [wanted[t, :3] - data.xpos[ankle], _between(data.xquat[ankle], (0.0, 0.0, wanted[t, 3]))]
            slopes += [place.copy(), turn.copy()]
        mujoco.mj_jacSubtreeCom(model, data, place, 0)
        errors, slopes = [*errors, com[t] - data.subtree_com[0, :2]], [*slopes, place[:2].copy()]
        mujoco.mj_jacBody(model, data, place, turn, self.pelvis)
        errors += [[plan.height[t] - data.xpos[self.pelvis, 2]], _between(data.xquat[self.pelvis], plan.tilt[t])]
        return np.concatenate(errors), np.concatenate([*slopes, place[2:], turn])


def _between(q: Floats, wanted: Sequence[float] | Floats) -> Floats:
    """Rotation vector (3,) [rad, world] from the attitude ``q`` to roll, pitch, heading ``wanted``."""
    roll, pitch, heading = (from_rotation_vector(np.eye(3)[i] * float(wanted[i])) for i in range(3))
    return rotation_vector(multiply(multiply(heading, multiply(pitch, roll)), conjugate(q)))


def swayed(push: Floats, height: float) -> Floats:
    """Positions (T, 2) [m] of the centre of mass with the zero moment point ``push``, at rest at both ends."""
    count, stiff = len(push), height / GRAVITY * RATE**2
    matrix = (
        np.diag(np.full(count, 1.0 + 2.0 * stiff))
        + np.diag(np.full(count - 1, -stiff), 1)
        + np.diag(np.full(count - 1, -stiff), -1)
    )
    matrix[0, 0] = matrix[-1, -1] = 1.0 + stiff
    return np.asarray(np.linalg.solve(matrix, push), dtype=np.float64)


def stand(body: Body, seconds: float) -> Plan:
    """Both feet are side by side, and the weight is between them."""
    count = round(seconds * RATE) + 1
    feet = [np.tile([0.0, y, ANKLE, 0.0], (count, 1)) for y in body.stance]
    middle = np.tile([SOLE, 0.0], (count, 1))
    return Plan(seconds, feet, middle, np.full(count, body.standing), np.zeros((count, 3)))


def squat(body: Body) -> Plan:
    """The robot squats twice, with its arms ahead."""
    plan = stand(body, 6.0)
    down = keyed(6.0, {0.5: 0.0, 1.7: 1.0, 2.1: 1.0, 3.2: 0.0, 3.4: 0.0, 4.3: 1.0, 4.5: 1.0, 5.4: 0.0, 6.0: 0.0})
    plan.height = body.standing - 0.27 * down
    plan.tilt[:, 1] = 0.35 * down
    for side in SIDES:
        plan.joints[f"{side}_shoulder_pitch_joint"] = ARMS["shoulder_pitch"] - 1.5 * down
        plan.joints[f"{side}_elbow_joint"] = ARMS["elbow"] + 0.5 * down
    return plan


def step(plan: Plan, body: Body, start: float, headings: Sequence[float], first: int) -> None:
    """Add a step from ``start`` [s] on for each of ``headings`` [rad], alternating sides; the feet stay on a circle."""
    now, heading = np.arange(len(plan.push)) / RATE, [0.0, 0.0]
    pushes: dict[float, Sequence[float]] = {0.0: (SOLE, 0.0), start: (SOLE, 0.0)}
    for number, wanted in enumerate(headings):
        side, begin = (first + number) % 2, start + number * STEP
        stays = 1 - side
        pushes[begin + DOUBLE * STEP] = pushes[begin + STEP] = _sole(body, stays, heading[stays])
        share = np.clip((now - begin - DOUBLE * STEP) / ((1 - DOUBLE) * STEP), 0.0, 1.0)
        turned = heading[side] + (wanted - heading[side]) * smooth(share)
        from_here, foot = share > 0, plan.feet[side]
        foot[from_here, 3] = turned[from_here]
        foot[from_here, 0] = (-body.stance[side] * np.sin(turned))[from_here]
        foot[from_here, 1] = (body.stance[side] * np.cos(turned))[from_here]
        foot[from_here, 2] = ANKLE + SWING * (64 * share**3 * (1 - share) ** 3)[from_here]
        heading[side] = wanted
    end = start + len(headings) * STEP
    middle = np.mean([_sole(body, side, heading[side]) for side in (0, 1)], axis=0)
    pushes[end + DOUBLE * STEP] = pushes[plan.seconds] = middle
    plan.push = keyed(plan.seconds, pushes)
    # otherwise a leg is too short
    plan.height = body.standing - keyed(plan.seconds, {0.0: 0.0, start: 0.03, end: 0.03, plan.seconds: 0.0})
    plan.tilt[:, 2] = keyed(plan.seconds, {0.0: 0.0, start: 0.0, end: heading[0], plan.seconds: heading[0]})


def _sole(body: Body, side: int, heading: float) -> tuple[float, float]:
    """The centre of a sole (2,) [m]."""
    y = body.stance[side]
    return SOLE * np.cos(heading) - y * np.sin(heading), SOLE * np.sin(heading) + y * np.cos(heading)


def wave(body: Body) -> Plan:
    """The robot steps in place, and its raised right arm waves."""
    plan = stand(body, 6.6)
    step(plan, body, 0.6, [0.0] * 6, first=0)
    up = keyed(6.6, {0.4: 0.0, 1.4: 1.0, 5.0: 1.0, 6.0: 0.0, 6.6: 0.0})
    waving = up * np.sin(2 * np.pi * 1.1 * np.arange(len(up)) / RATE)
    plan.joints = {
        "right_shoulder_pitch_joint": ARMS["shoulder_pitch"] * (1 - up),
        "right_shoulder_roll_joint": -ARMS["shoulder_roll"] - 1.0 * up,
        "right_shoulder_yaw_joint": -1.45 * up,
        "right_elbow_joint": ARMS["elbow"] * (1 - up) - 0.1 * up + 0.45 * waving,
    }
    return plan


def kick(body: Body) -> Plan:
    """The weight moves to the left foot. The right leg is raised, kicks to the side, is held there, and comes down."""
    plan, left = stand(body, 7.0), body.stance[0]
    plan.push = keyed(
        7.0,
        {0.0: (SOLE, 0.0), 0.5: (SOLE, 0.0), 1.4: (SOLE, left), 5.4: (SOLE, left), 6.3: (SOLE, 0.0), 7.0: (SOLE, 0.0)},
    )
    out = keyed(7.0, {2.4: 0.0, 3.0: 1.0, 4.0: 1.0, 4.6: 0.0, 7.0: 0.0})
    plan.raised = keyed(7.0, {1.5: 0.0, 2.3: 1.0, 4.6: 1.0, 5.4: 0.0, 7.0: 0.0})
    plan.height = body.standing - keyed(7.0, {0.4: 0.0, 1.4: 0.02, 5.4: 0.02, 6.4: 0.0, 7.0: 0.0})
    plan.tilt[:, 0] = -0.1 * plan.raised - 0.25 * out
    plan.leg = {
        "right_hip_pitch_joint": -0.7 + 0.55 * out,
        "right_hip_roll_joint": -0.18 - 0.62 * out,
        "right_hip_yaw_joint": 0.0 * out,
        "right_knee_joint": 1.4 - 1.15 * out,
        "right_ankle_pitch_joint": -0.3 + 0.1 * out,
        "right_ankle_roll_joint": 0.0 * out,
    }
    plan.joints = {"waist_roll_joint": -0.15 * out}
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        plan.joints[f"{side}_shoulder_roll_joint"] = sign * (ARMS["shoulder_roll"] + 0.5 * plan.raised)
        plan.joints[f"{side}_shoulder_pitch_joint"] = ARMS["shoulder_pitch"] - 0.5 * plan.raised
        plan.joints[f"{side}_elbow_joint"] = ARMS["elbow"] - 0.5 * plan.raised
    return plan


def turn(body: Body) -> Plan:
    """The robot turns left by half a turn in eight steps, with a small arm swing."""
    plan = stand(body, 8.0)
    quarter = np.pi / 4
    step(plan, body, 0.6, [quarter * (number // 2 + 1) for number in range(8)], first=0)
    going = keyed(8.0, {0.6: 0.0, 1.4: 1.0, 6.6: 1.0, 7.4: 0.0, 8.0: 0.0})
    swing = going * np.sin(np.pi / STEP * (np.arange(len(plan.push)) / RATE - 0.6))
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        plan.joints[f"{side}_shoulder_pitch_joint"] = ARMS["shoulder_pitch"] + sign * 0.2 * swing
        # keeps the hands away from the thighs
        plan.joints[f"{side}_shoulder_roll_joint"] = sign * (ARMS["shoulder_roll"] + 0.15 * going)
    return plan


MOTIONS = {"squat": squat, "wave": wave, "kick": kick, "turn": turn}


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "resources" / "motions"
    folder.mkdir(parents=True, exist_ok=True)
    body = Body()
    for name, make in MOTIONS.items():
        clip = body.pose(make(body))
        save_clip(folder / f"g1_{name}.npz", clip)
        print(f"{folder / f'g1_{name}.npz'}: {clip.seconds:g} s")


if __name__ == "__main__":
    main()
