"""The robot's mirror image as columns: what swapping left and right does to observations and actions.

Assembled from the column ``mirror`` of the observation table, once, by who asks for ``LeggedRobot.mirror``; the step
never does. The mirror is the x-z plane: of the root for what is in the body's frame, of the world for what is in the
world's. Both are one operation, so both follow the same formula.

An IMU beside the plane (Go1: 67 mm) does not change sides in the mirror. Its velocity in the mirrored motion is the
mirrored velocity plus what the turning adds over twice that distance, which is linear in the rates: kind "imu_velocity",
and in the same way kind "command". The accelerometer has no such formula, for want of the angular acceleration, and is
mirrored as if it were in the plane. Joints and feet are checked; masses are not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from legged_mw.sim.mirror import Partners, find_partners
from legged_mw.sim.model import unknown
from legged_mw.utils.config import ConfigError

if TYPE_CHECKING:
    from legged_mw.envs.legged_robot import LeggedRobot, Row

NO_MIRROR = "learn without mirror images: symmetry.use_data_augmentation = False (and use_mirror_loss, if you set it)"


class _Block(NamedTuple):
    """Columns that mirror among themselves. A row holds any number of blocks, one after another."""

    index: list[int]  # column that each is taken from
    sign: list[float]  # +1 or -1, times the ratio of the two columns' scales
    shifts: list[tuple[int, int, float]] = []  # (to, from, factor): to the mirrored column, add factor * column, not mirrored


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


def make_mirror(env: LeggedRobot) -> Mirror:
    """Look up joints and feet, read the table. Raises ModelError or ConfigError for what has no mirror image."""
    partners = find_partners(env.robot, env.cfg.asset.foot_names)
    _check_pose(env, partners)
    feet = list(partners.sites)
    reach = 2.0 * float(env.imu_pos[0, 1])  # [m] from the mirrored IMU to the IMU
    joints = _Block(list(partners.joints), [float(sign) for sign in partners.signs])
    blocks: dict[str, _Block] = {
        "scalar": _Block([0], [1.0]),  # the same on both sides
        "polar": _Block([0, 1, 2], [1.0, -1.0, 1.0]),  # x, -y, z: a velocity, a force, a direction
        "axial": _Block([0, 1, 2], [-1.0, 1.0, -1.0]),  # -x, y, -z: an angular velocity
        "imu_velocity": _Block([0, 1, 2], [1.0, -1.0, 1.0]),  # of the IMU, body frame; shifted by the row "base_ang_vel" beside it
        "command": _Block([0, 1, 2], [1.0, -1.0, -1.0], [(0, 2, reach)]),  # vx, -vy of the IMU, -yaw rate
        "joint": joints,  # a number a joint
        "joint_factor": _Block(joints.index, [1.0] * len(joints.index)),  # one that does not turn with the joint's axis
        "link": _Block([0, *(1 + j for j in joints.index)], [1.0] * (1 + len(joints.index))),  # the root's, then one a joint
        "foot": _Block(feet, [1.0] * len(feet)),  # a number a foot
        "height_scan": _height_scan(env),
        "foot_polar": _Block([3 * f + k for f in feet for k in range(3)], [1.0, -1.0, 1.0] * len(feet)),  # a polar vector a foot
    }

    def columns(block: _Block) -> Columns:
        with torch.inference_mode(False):  # whoever asks first: the mirrored actions of a loss carry gradients
            target, source, factor = zip(*block.shifts, strict=True) if block.shifts else ((), (), ())
            places = (torch.tensor(list(where), dtype=torch.long, device=env.device) for where in (block.index, target, source))
            numbers = (torch.tensor(list(values), dtype=torch.float, device=env.device) for values in (block.sign, factor))
            (index, to, origin), (sign, by) = places, numbers
            return Columns(index, sign, to, origin, by)

    groups: dict[str, Columns] = {}
    for group, rows in env._observation_rows().items():
        blocks[group] = _side_by_side(group, rows, blocks, reach)  # known from here on, to rows that contain this group
        groups[group] = columns(blocks[group])
    return Mirror(groups, columns(joints))


def _height_scan(env: LeggedRobot) -> _Block:
    """Points (x, y) in the order of the scan: x stays, y changes its sign."""
    xs, ys = env.cfg.terrain.measured_points_x, env.cfg.terrain.measured_points_y
    if env.cfg.terrain.height_scan and any(
        abs(left + right) > 1e-6 for left, right in zip(sorted(ys), sorted(ys, reverse=True), strict=True)
    ):
        raise ConfigError(f"terrain.measured_points_y {ys} is not its own mirror image; make it so, or {NO_MIRROR}")
    partner = [min(range(len(ys)), key=lambda j: abs(ys[j] + y)) for y in ys]
    return _Block([i * len(ys) + j for i in range(len(xs)) for j in partner], [1.0] * (len(xs) * len(ys)))


def _side_by_side(group: str, rows: Sequence[Row], blocks: dict[str, _Block], reach: float) -> _Block:
    """The block of a whole group."""
    whole = _Block([], [], [])
    starts: dict[str, int] = {}
    for row in rows:
        where = f"observation row '{row.name}' of '{group}'"
        if row.mirror is None:
            raise ConfigError(f"{where} does not say what a mirror does to it: give its Row a mirror=...; there are: {', '.join(blocks)}")
        if row.mirror not in blocks:
            raise ConfigError(f"{where}: {unknown('mirror', row.mirror, blocks, 'its Row (a group must come before what contains it)')}")
        block = blocks[row.mirror]
        times, rest = divmod(row.value.shape[1], len(block.index))
        if rest:
            raise ConfigError(f"{where} has {row.value.shape[1]} columns; mirror='{row.mirror}' takes a multiple of {len(block.index)}")
        starts[row.name] = len(whole.index)
        for _ in range(times):
            start = len(whole.index)
            whole.index.extend(start + i for i in block.index)
            whole.sign.extend(block.sign)
            whole.shifts.extend((start + to, start + source, factor) for to, source, factor in block.shifts)
    for row in rows if reach else ():
        if row.mirror == "imu_velocity":
            if "base_ang_vel" not in starts:
                raise ConfigError(f"observation row '{row.name}' of '{group}' needs the row 'base_ang_vel' beside it, to be mirrored")
            velocity, rate = starts[row.name], starts["base_ang_vel"]
            whole.shifts.extend([(velocity, rate + 2, reach), (velocity + 2, rate, -reach)])  # 2y wz in x, -2y wx in z
    return _scaled(whole, [scale for row in rows for scale in row.column_scales()])


def _scaled(block: _Block, scale: list[float]) -> _Block:
    """The same mirror for columns that carry a scale each."""
    sign = [s * scale[i] / scale[j] for i, (j, s) in enumerate(zip(block.index, block.sign, strict=True))]
    shifts = [(to, source, factor * scale[to] / scale[source]) for to, source, factor in block.shifts]
    return _Block(block.index, sign, shifts)


def _check_pose(env: LeggedRobot, partners: Partners) -> None:
    """Action 0 is the default pose on both sides, so the pose must be its own mirror image."""
    pose, names = env.default_dof_pos.tolist(), env.robot.joint_names
    for i, (j, sign) in enumerate(zip(partners.joints, partners.signs, strict=True)):
        if abs(pose[i] - sign * pose[j]) > 1e-6:
            image = "its own mirror image" if i == j else f"the mirror image of {pose[j]:g} rad at '{names[j]}'"
            raise ConfigError(
                f"init_state.default_joint_angles: joint '{names[i]}' is at {pose[i]:g} rad, {image} is {sign * pose[j] + 0.0:g}; "
                f"make the default pose symmetric, or {NO_MIRROR}"
            )
