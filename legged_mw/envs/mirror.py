"""The robot's mirror image as columns: what swapping left and right does to observations and actions.

Assembled from the column ``mirror`` of the observation table, once, by who asks for ``LeggedRobot.mirror``; the step
never does. The mirror is the x-z plane: of the root for what is in the body's frame, of the world for what is in the
world's. Both are one operation, so both follow the same formula.

How exact it is depends on the robot. Joints and feet are checked. An IMU beside the plane is not: its velocity in a
mirrored motion is that of an IMU on the other side, off by 2 y times the yaw and roll rates (Go1: 0.13 m/s at 1 rad/s).
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

# Of one block of columns: where each comes from, and its sign. A row holds any number of blocks, one after another.
_Block = tuple[list[int], list[float]]


class Columns(NamedTuple):
    """A signed permutation: ``mirrored = x[:, index] * sign``. Done twice it gives ``x`` back."""

    index: Tensor  # (size,) int64, column that this one is taken from
    sign: Tensor  # (size,) +1 or -1

    def __call__(self, x: Tensor) -> Tensor:
        """The mirror image of ``x`` (B, size)."""
        return x.index_select(1, self.index) * self.sign


class Mirror(NamedTuple):
    """The mirror image of all that a policy sees and does."""

    observations: dict[str, Columns]  # by group
    actions: Columns


def make_mirror(env: LeggedRobot) -> Mirror:
    """Look up joints and feet, read the table. Raises ModelError or ConfigError for what has no mirror image."""
    partners = find_partners(env.robot, env.cfg.asset.foot_names)
    _check_pose(env, partners)
    feet = list(partners.sites)
    joints: _Block = list(partners.joints), [float(sign) for sign in partners.signs]
    blocks: dict[str, _Block] = {
        "scalar": ([0], [1.0]),  # the same on both sides
        "polar": ([0, 1, 2], [1.0, -1.0, 1.0]),  # x, -y, z: a velocity, a force, a direction
        "axial": ([0, 1, 2], [-1.0, 1.0, -1.0]),  # -x, y, -z: an angular velocity
        "command": ([0, 1, 2], [1.0, -1.0, -1.0]),  # vx, -vy, -yaw rate
        "joint": joints,  # a number a joint
        "foot": (feet, [1.0] * len(feet)),  # a number a foot
        "foot_polar": ([3 * foot + k for foot in feet for k in range(3)], [1.0, -1.0, 1.0] * len(feet)),  # a polar vector a foot
    }

    def columns(block: _Block) -> Columns:
        with torch.inference_mode(False):  # whoever asks first: the mirrored actions of a loss carry gradients
            return Columns(torch.tensor(block[0], device=env.device), torch.tensor(block[1], device=env.device))

    groups: dict[str, Columns] = {}
    for group, rows in env._observation_rows().items():
        blocks[group] = _side_by_side(group, rows, blocks)  # known from here on, to rows that contain this group
        groups[group] = columns(blocks[group])
    return Mirror(groups, columns(joints))


def _side_by_side(group: str, rows: Sequence[Row], blocks: dict[str, _Block]) -> _Block:
    """The block of a whole group."""
    index: list[int] = []
    sign: list[float] = []
    for row in rows:
        where = f"observation row '{row.name}' of '{group}'"
        if row.mirror is None:
            raise ConfigError(f"{where} does not say what a mirror does to it: give its Row a mirror=...; there are: {', '.join(blocks)}")
        if row.mirror not in blocks:
            raise ConfigError(f"{where}: {unknown('mirror', row.mirror, blocks, 'its Row (a group must come before what contains it)')}")
        block_index, block_sign = blocks[row.mirror]
        times, rest = divmod(row.value.shape[1], len(block_index))
        if rest:
            raise ConfigError(f"{where} has {row.value.shape[1]} columns; mirror='{row.mirror}' takes a multiple of {len(block_index)}")
        for _ in range(times):
            start = len(index)
            index += [start + i for i in block_index]
            sign += block_sign
    return index, sign


def _check_pose(env: LeggedRobot, partners: Partners) -> None:
    """Action 0 is the default pose on both sides, so the pose must be its own mirror image."""
    pose, names = env.default_dof_pos.tolist(), env.robot.joint_names
    for i, (j, sign) in enumerate(zip(partners.joints, partners.signs, strict=True)):
        if abs(pose[i] - sign * pose[j]) > 1e-6:
            image = "its own mirror image" if i == j else f"the mirror image of {pose[j]:g} rad at '{names[j]}'"
            raise ConfigError(
                f"init_state.default_joint_angles: joint '{names[i]}' is at {pose[i]:g} rad, {image} is {sign * pose[j] + 0.0:g}; "
                "make the default pose symmetric, or switch off what mirrors the robot (section symmetry)"
            )
