"""The left-right mirror image of the robot: a signed permutation of the columns of observations and actions.

It is made from the field ``mirror`` of the observation rows when ``RobotTask.mirror`` is first read. The step does not
use it. The mirror plane is x-z, of the root for values in the body frame and of the world for values in the world
frame. The formula is the same.

If the IMU is not in the plane (Go1: 67 mm beside it), the mirrored robot has its IMU on the other side. The mirrored
velocity therefore has a second term: angular velocity times twice the distance (kinds "imu_velocity" and "command").
For the accelerometer this term would need the angular acceleration, so it is left out. Joints and feet are checked for
symmetry, masses are not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from legged_mw.envs.observations import Row
from legged_mw.sim.mirror import Partners
from legged_mw.sim.model import RobotModel
from legged_mw.utils.commands import VELOCITY, Command
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown

NO_MIRROR = "learn without mirror images: symmetry.use_data_augmentation = False (and use_mirror_loss, if you set it)"


class Block(NamedTuple):
    """Columns whose mirror images are in the same columns. A row consists of one or more blocks."""

    index: list[int]  # source column of each column
    sign: list[float]  # +1 or -1, times the ratio of the two columns' scales
    shifts: list[tuple[int, int, float]] = []  # (to, from, factor): mirrored column += factor * unmirrored column


class Columns(NamedTuple):
    """``x[:, index] * sign``, plus ``x[:, source] * factor`` in columns ``target``. Applied twice it gives ``x``."""

    index: Tensor  # (size,) int64, source column of each column
    sign: Tensor  # (size,) +1 or -1 if both columns of a pair have the same scale
    target: Tensor  # (S,) int64
    source: Tensor  # (S,) int64
    factor: Tensor  # (S,)

    def __call__(self, x: Tensor) -> Tensor:
        """The mirror image of ``x`` (B, size)."""
        image = x.index_select(1, self.index) * self.sign
        if len(self.target):
            image = image.index_add(1, self.target, x.index_select(1, self.source) * self.factor)
        return image


class Mirror(NamedTuple):
    """The mirror image of a policy's observations and actions."""

    observations: dict[str, Columns]  # by group
    actions: Columns


def make_mirror(groups: Mapping[str, Sequence[Row]], blocks: dict[str, Block], reach: float, device: str) -> Mirror:
    """The mirror of the groups. ``blocks``: name of a kind -> block; ``reach`` [m]: from the mirrored IMU to the IMU.

    Raises ConfigError for a row without a mirror image.
    """
    blocks = dict(blocks)
    for group, rows in groups.items():
        blocks[group] = _group_block(group, rows, blocks, reach)  # later groups may contain this one
    return Mirror({group: _columns(blocks[group], device) for group in groups}, _columns(blocks["action"], device))


def _columns(block: Block, device: str) -> Columns:
    with torch.inference_mode(False):  # the mirror loss needs gradients, also if this call is in inference mode
        index = torch.tensor(block.index, dtype=torch.long, device=device)
        sign = torch.tensor(block.sign, dtype=torch.float, device=device)
        target, source, factor = torch.tensor(block.shifts, dtype=torch.float, device=device).view(-1, 3).T.contiguous()
        return Columns(index, sign, target.long(), source.long(), factor)


def robot_blocks(partners: Partners, action_scale: Sequence[float]) -> dict[str, Block]:
    """Kinds of mirror image for all robots. ``action_scale`` (D,): what a joint does with an action of 1."""
    joints = Block(list(partners.joints), [float(sign) for sign in partners.signs])
    ratios = [action_scale[j] / scale for j, scale in zip(joints.index, action_scale, strict=True)]
    return {
        "scalar": Block([0], [1.0]),  # the same on both sides
        "polar": Block([0, 1, 2], [1.0, -1.0, 1.0]),  # x, -y, z: a velocity, a force, a direction
        "axial": Block([0, 1, 2], [-1.0, 1.0, -1.0]),  # -x, y, -z: an angular velocity
        "imu_velocity": Block([0, 1, 2], [1.0, -1.0, 1.0]),  # body frame; with shifts from the row "base_ang_vel"
        "joint": joints,  # one value per joint
        "action": Block(joints.index, [sign * ratio for sign, ratio in zip(joints.sign, ratios, strict=True)]),
        "joint_factor": Block(joints.index, [1.0] * len(joints.index)),  # one value per joint, without a sign
        "link": Block([0, *(1 + j for j in joints.index)], [1.0] * (1 + len(joints.index))),  # root's, then joints'
    }


def foot_blocks(partners: Partners) -> dict[str, Block]:
    """Kinds of mirror image for rows with one value, or one polar vector, per foot."""
    feet = list(partners.sites)
    polar = Block([3 * f + k for f in feet for k in range(3)], [1.0, -1.0, 1.0] * len(feet))
    return {"foot": Block(feet, [1.0] * len(feet)), "foot_polar": polar}


def body_blocks(robot: RobotModel, partners: Partners, names: Sequence[str]) -> dict[str, Block]:
    """Kinds of mirror image for rows with a vector or a turn for each of the bodies ``names``.

    A turn is the first two columns of a rotation matrix, row by row. Raises ConfigError if a body's partner is missing.
    """
    model = robot.physics
    carried = [int(model.joint(name).bodyid[0]) for name in robot.joint_names]  # the body that each joint moves
    bodies = [robot.id("body", name) for name in names]
    images = [carried[partners.joints[carried.index(body)]] if body in carried else body for body in bodies]
    for name, image in zip(names, images, strict=True):
        if image not in bodies:
            what = f"body '{name}' is compared and its mirror image '{model.body(image).name}' is not"
            raise ConfigError(f"{what}: name both, or {NO_MIRROR}")
    places, turn = [bodies.index(image) for image in images], [1.0, -1.0, -1.0, 1.0, 1.0, -1.0]
    return {
        "turn": Block([*range(6)], turn),
        "body_polar": Block([3 * b + k for b in places for k in range(3)], [1.0, -1.0, 1.0] * len(places)),
        "body_turn": Block([6 * b + k for b in places for k in range(6)], turn * len(places)),
    }


def command_block(table: Sequence[Command], reach: float) -> Block:
    """The mirrored commands: vx, -vy, -yaw rate at the IMU; others by ``commands.mirror``. Raises ConfigError."""
    names = [command.name for command in table]
    for command in table:
        if command.mirror is None:
            what = f"commands.ranges.{command.name}: nothing says what a mirror does to it"
            write = f"write commands.mirror = {{'{command.name}': 1.0}}, or -1.0 if left and right change its sign"
            raise ConfigError(f"{what}; {write}, or {NO_MIRROR}")
    shifts = [(names.index("lin_vel_x"), names.index("ang_vel_yaw"), reach)] if {*VELOCITY} <= {*names} else []
    return Block(list(range(len(names))), [float(command.mirror or 1.0) for command in table], shifts)


def scan_block(xs: Sequence[float], ys: Sequence[float]) -> Block:
    """The mirrored points (x, -y) of the height scan. Raises ConfigError for a grid that is not symmetric."""
    if any(abs(left + right) > 1e-6 for left, right in zip(sorted(ys), sorted(ys, reverse=True), strict=True)):
        what = f"terrain.measured_points_y {list(ys)} is not its own mirror image"
        raise ConfigError(f"{what}; make it so, or {NO_MIRROR}")
    partner = [min(range(len(ys)), key=lambda j: abs(ys[j] + y)) for y in ys]
    return Block([i * len(ys) + j for i in range(len(xs)) for j in partner], [1.0] * (len(xs) * len(ys)))


def check_pose(names: Sequence[str], pose: Sequence[float], partners: Partners) -> None:
    """Raise ConfigError unless the default pose (D,) is symmetric, because action 0 is that pose on both sides."""
    for i, (j, sign) in enumerate(zip(partners.joints, partners.signs, strict=True)):
        if abs(pose[i] - sign * pose[j]) > 1e-6:
            image = "its own mirror image" if i == j else f"the mirror image of {pose[j]:g} rad at '{names[j]}'"
            what = f"joint '{names[i]}' is at {pose[i]:g} rad, {image} is {sign * pose[j] + 0.0:g}"
            mend = f"make the default pose symmetric, or {NO_MIRROR}"
            raise ConfigError(f"init_state.default_joint_angles: {what}; {mend}")


def _group_block(group: str, rows: Sequence[Row], blocks: Mapping[str, Block], reach: float) -> Block:
    """The block of a group: the blocks of its rows in order, with their scales."""
    whole, starts = Block([], [], []), dict[str, int]()
    for row in rows:
        where = f"observation row '{row.name}' of '{group}'"
        if row.mirror is None:
            what = "does not say what a mirror does to it: give its Row a mirror=..."
            raise ConfigError(f"{where} {what}; there are: {', '.join(blocks)}")
        if row.mirror not in blocks:
            place = "its Row (a group must come before what contains it)"
            raise ConfigError(f"{where}: {unknown('mirror', row.mirror, blocks, place)}")
        block, size = blocks[row.mirror], row.value.shape[1]
        if size % len(block.index):
            what = f"mirror='{row.mirror}' takes a multiple of {len(block.index)}"
            raise ConfigError(f"{where} has {size} columns; {what}")
        starts[row.name] = len(whole.index)
        for _ in range(row.size // len(block.index)):
            start = len(whole.index)
            whole.index.extend(start + i for i in block.index)
            whole.sign.extend(block.sign)
            whole.shifts.extend((start + to, start + source, factor) for to, source, factor in block.shifts)
    for row in rows if reach else ():
        if row.mirror == "imu_velocity":
            whole.shifts.extend(_imu_shifts(group, row, rows, starts, reach))
    scale = [scale for row in rows for scale in row.column_scales() * row.history]
    sign = [s * scale[i] / scale[j] for i, (j, s) in enumerate(zip(whole.index, whole.sign, strict=True))]
    shifts = [(to, source, factor * scale[to] / scale[source]) for to, source, factor in whole.shifts]
    return Block(whole.index, sign, shifts)


def _imu_shifts(
    group: str, row: Row, rows: Sequence[Row], starts: Mapping[str, int], reach: float
) -> list[tuple[int, int, float]]:
    """The second term of the IMU's velocity ``row``. Each frame uses the same frame of the row "base_ang_vel"."""
    rates = next((each for each in rows if each.name == "base_ang_vel"), None)
    if rates is None:
        where = f"observation row '{row.name}' of '{group}'"
        raise ConfigError(f"{where} needs the row 'base_ang_vel' beside it, to be mirrored")
    if rates.history < row.history:
        what = f"'{group}.{row.name}' has {row.history} frames, so 'base_ang_vel' needs as many"
        raise ConfigError(f"observations.history: {what}")
    shifts = []
    for back in range(1, row.history + 1):  # count from the newest frame, as the oldest is first
        velocity = starts[row.name] + 3 * (row.history - back)
        rate = starts["base_ang_vel"] + 3 * (rates.history - back)
        shifts += [(velocity, rate + 2, reach), (velocity + 2, rate, -reach)]  # 2y wz in x, -2y wx in z
    return shifts
