"""The robot's mirror image as columns: what swapping left and right does to observations and actions.

Made from the column ``mirror`` of the observation table, when ``RobotTask.mirror`` is first asked for; the step never
asks. The mirror is the x-z plane: of the root for what is in the body's frame, of the world for what is in the
world's. Both are one operation, so both follow the same formula.

An IMU beside the plane (Go1: 67 mm) does not change sides in the mirror. Its velocity in the mirrored motion is the
mirrored velocity plus what turning adds over twice that distance, which is linear in the rates: kind "imu_velocity",
and in the same way kind "command". The accelerometer would need the angular acceleration; it is mirrored as if it
were in the plane. Joints and feet are checked; masses are not.
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
    """Columns that mirror among themselves. A row holds any number of blocks, one after another."""

    index: list[int]  # column that each is taken from
    sign: list[float]  # +1 or -1, times the ratio of the two columns' scales
    # (to, from, factor): to the mirrored column, add factor * column, not mirrored
    shifts: list[tuple[int, int, float]] = []


class Columns(NamedTuple):
    """A signed permutation and shifts: ``x[:, index] * sign``, plus ``x[:, source] * factor`` in columns ``target``.

    Done twice it gives ``x`` back.
    """

    index: Tensor  # (size,) int64, column that this one is taken from
    sign: Tensor  # (size,) +1 or -1, where the columns of a pair have the same scale
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
    """The mirror image of all that a policy sees and does."""

    observations: dict[str, Columns]  # by group
    actions: Columns


def make_mirror(groups: Mapping[str, Sequence[Row]], blocks: dict[str, Block], reach: float, device: str) -> Mirror:
    """Read the table. ``blocks`` are the kinds of mirror image by name, ``reach`` [m] is from the mirrored IMU to the IMU.

    Raises ConfigError for a row that has no mirror image.
    """

    def columns(block: Block) -> Columns:
        # whatever mode the first caller is in: mirrored actions of a loss carry gradients
        with torch.inference_mode(False):
            target, source, factor = zip(*block.shifts, strict=True) if block.shifts else ((), (), ())
            places = (
                torch.tensor(list(where), dtype=torch.long, device=device) for where in (block.index, target, source)
            )
            numbers = (torch.tensor(list(values), dtype=torch.float, device=device) for values in (block.sign, factor))
            (index, to, origin), (sign, by) = places, numbers
            return Columns(index, sign, to, origin, by)

    blocks = dict(blocks)
    for group, rows in groups.items():
        blocks[group] = _side_by_side(group, rows, blocks, reach)  # rows of later groups may contain this one
    return Mirror({group: columns(blocks[group]) for group in groups}, columns(blocks["joint"]))


def robot_blocks(partners: Partners) -> dict[str, Block]:
    """Kinds of mirror image that every robot has."""
    joints = Block(list(partners.joints), [float(sign) for sign in partners.signs])
    return {
        "scalar": Block([0], [1.0]),  # the same on both sides
        "polar": Block([0, 1, 2], [1.0, -1.0, 1.0]),  # x, -y, z: a velocity, a force, a direction
        "axial": Block([0, 1, 2], [-1.0, 1.0, -1.0]),  # -x, y, -z: an angular velocity
        # of the IMU, body frame; shifted by the row "base_ang_vel" beside it
        "imu_velocity": Block([0, 1, 2], [1.0, -1.0, 1.0]),
        "joint": joints,  # a number a joint
        "joint_factor": Block(joints.index, [1.0] * len(joints.index)),  # one that does not turn with the joint's axis
        # the root's, then one a joint
        "link": Block([0, *(1 + j for j in joints.index)], [1.0] * (1 + len(joints.index))),
    }


def foot_blocks(partners: Partners) -> dict[str, Block]:
    """Kinds of mirror image of what each foot has."""
    feet = list(partners.sites)
    return {
        "foot": Block(feet, [1.0] * len(feet)),  # a number a foot
        # a polar vector a foot
        "foot_polar": Block([3 * f + k for f in feet for k in range(3)], [1.0, -1.0, 1.0] * len(feet)),
    }


def body_blocks(robot: RobotModel, partners: Partners, names: Sequence[str]) -> dict[str, Block]:
    """Kinds of mirror image of what each of the bodies ``names`` has. Raises ConfigError for one without its partner.

    A turn is the first two columns of a rotation matrix, row by row.
    """
    carried = [int(robot.physics.joint(name).bodyid[0]) for name in robot.joint_names]  # the body that each joint moves
    bodies = [robot.id("body", name) for name in names]
    images = [carried[partners.joints[carried.index(body)]] if body in carried else body for body in bodies]
    for name, image in zip(names, images, strict=True):
        if image not in bodies:
            other = robot.physics.body(image).name
            raise ConfigError(
                f"body '{name}' is compared and its mirror image '{other}' is not: name both, or {NO_MIRROR}"
            )
    places, polar, turn = [bodies.index(image) for image in images], [1.0, -1.0, 1.0], [1.0, -1.0, -1.0, 1.0, 1.0, -1.0]
    return {
        "turn": Block([*range(6)], turn),
        "body_polar": Block([3 * b + k for b in places for k in range(3)], polar * len(places)),
        "body_turn": Block([6 * b + k for b in places for k in range(6)], turn * len(places)),
    }


def command_block(table: Sequence[Command], reach: float) -> Block:
    """The commands left for right: of the velocity at the IMU vx, -vy and -yaw rate, of others what ``commands.mirror`` says."""
    names = [command.name for command in table]
    for command in table:
        if command.mirror is None:
            raise ConfigError(
                f"commands.ranges.{command.name}: nothing says what a mirror does to it; "
                f"write commands.mirror = {{'{command.name}': 1.0}}, or -1.0 if left and right change its sign, or {NO_MIRROR}"
            )
    shifts = [(names.index("lin_vel_x"), names.index("ang_vel_yaw"), reach)] if {*VELOCITY} <= {*names} else []
    return Block(list(range(len(names))), [float(command.mirror or 1.0) for command in table], shifts)


def scan_block(xs: Sequence[float], ys: Sequence[float]) -> Block:
    """Points (x, y) in the order of the height scan: x stays, y changes its sign. Raises ConfigError for a lopsided grid."""
    if any(abs(left + right) > 1e-6 for left, right in zip(sorted(ys), sorted(ys, reverse=True), strict=True)):
        raise ConfigError(
            f"terrain.measured_points_y {list(ys)} is not its own mirror image; make it so, or {NO_MIRROR}"
        )
    partner = [min(range(len(ys)), key=lambda j: abs(ys[j] + y)) for y in ys]
    return Block([i * len(ys) + j for i in range(len(xs)) for j in partner], [1.0] * (len(xs) * len(ys)))


def check_pose(names: Sequence[str], pose: Sequence[float], partners: Partners) -> None:
    """Action 0 is the default pose (D,) on both sides, so the pose must be its own mirror image. Raises ConfigError."""
    for i, (j, sign) in enumerate(zip(partners.joints, partners.signs, strict=True)):
        if abs(pose[i] - sign * pose[j]) > 1e-6:
            image = "its own mirror image" if i == j else f"the mirror image of {pose[j]:g} rad at '{names[j]}'"
            raise ConfigError(
                f"init_state.default_joint_angles: joint '{names[i]}' is at {pose[i]:g} rad, {image} is {sign * pose[j] + 0.0:g}; "
                f"make the default pose symmetric, or {NO_MIRROR}"
            )


def _side_by_side(group: str, rows: Sequence[Row], blocks: Mapping[str, Block], reach: float) -> Block:
    """The block of a whole group."""
    whole = Block([], [], [])
    starts: dict[str, int] = {}
    for row in rows:
        where = f"observation row '{row.name}' of '{group}'"
        if row.mirror is None:
            raise ConfigError(
                f"{where} does not say what a mirror does to it: give its Row a mirror=...; there are: {', '.join(blocks)}"
            )
        if row.mirror not in blocks:
            raise ConfigError(
                f"{where}: {unknown('mirror', row.mirror, blocks, 'its Row (a group must come before what contains it)')}"
            )
        block = blocks[row.mirror]
        times, rest = divmod(row.size, len(block.index))
        if row.value.shape[1] % len(block.index) or rest:
            raise ConfigError(
                f"{where} has {row.value.shape[1]} columns; mirror='{row.mirror}' takes a multiple of {len(block.index)}"
            )
        starts[row.name] = len(whole.index)
        for _ in range(times):
            start = len(whole.index)
            whole.index.extend(start + i for i in block.index)
            whole.sign.extend(block.sign)
            whole.shifts.extend((start + to, start + source, factor) for to, source, factor in block.shifts)
    for row in rows if reach else ():
        if row.mirror == "imu_velocity":
            whole.shifts.extend(_imu_shifts(group, row, rows, starts, reach))
    return _scaled(whole, [scale for row in rows for scale in row.column_scales() * row.history])


def _imu_shifts(
    group: str, row: Row, rows: Sequence[Row], starts: Mapping[str, int], reach: float
) -> list[tuple[int, int, float]]:
    """What turning adds to each frame of the IMU's velocity ``row``, from the same frame of the row "base_ang_vel"."""
    rates = next((each for each in rows if each.name == "base_ang_vel"), None)
    if rates is None:
        raise ConfigError(
            f"observation row '{row.name}' of '{group}' needs the row 'base_ang_vel' beside it, to be mirrored"
        )
    if rates.history < row.history:
        raise ConfigError(
            f"observations.history: '{group}.{row.name}' has {row.history} frames, so 'base_ang_vel' needs as many"
        )
    shifts = []
    for back in range(1, row.history + 1):  # frames are oldest first, so both are counted from the newest
        velocity = starts[row.name] + 3 * (row.history - back)
        rate = starts["base_ang_vel"] + 3 * (rates.history - back)
        shifts += [(velocity, rate + 2, reach), (velocity + 2, rate, -reach)]  # 2y wz in x, -2y wx in z
    return shifts


def _scaled(block: Block, scale: list[float]) -> Block:
    """The same mirror for columns that carry a scale each."""
    sign = [s * scale[i] / scale[j] for i, (j, s) in enumerate(zip(block.index, block.sign, strict=True))]
    shifts = [(to, source, factor * scale[to] / scale[source]) for to, source, factor in block.shifts]
    return Block(block.index, sign, shifts)
