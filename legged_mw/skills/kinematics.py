"""Poses and velocities of a robot's bodies from qpos and qvel, in batched torch.

The engine's body poses are one substep old and zero after a reset. These poses are current.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

from legged_mw.utils.errors import ModelError


class Bodies(NamedTuple):
    """B bodies of N worlds, world frame."""

    pos: Tensor  # (N, B, 3) of their origins [m]
    rot: Tensor  # (N, B, 3, 3) body to world
    lin_vel: Tensor  # (N, B, 3) of their origins [m/s]
    ang_vel: Tensor  # (N, B, 3) [rad/s]


class Kinematics:
    """Forward kinematics of a robot with a free root and at most one hinge per body."""

    def __init__(self, model: mujoco.MjModel, bodies: Sequence[int], device: str) -> None:
        """``bodies`` are indices in ``model``; the call returns them in this order."""
        jointed = [b for b in range(1, model.nbody) if model.body_jntnum[b]]
        root = next(b for b in jointed if model.jnt_type[model.body_jntadr[b]] == mujoco.mjtJoint.mjJNT_FREE)
        levels = _levels(model, root, bodies)
        order = [body for level in levels for body in level]
        joints = [_joint(model, body) for body in order[1:]]
        constant, sine, cosine = np.zeros((3, len(joints), 4, 4))
        for i, (body, joint) in enumerate(zip(order[1:], joints, strict=True)):
            constant[i], sine[i], cosine[i] = _local(model, body, joint)
        hinges = [j for j in joints if j >= 0]
        above = np.zeros((len(bodies), len(hinges)))
        for i, body in enumerate(bodies):
            while body != root:
                if (joint := _joint(model, body)) >= 0:
                    above[i, hinges.index(joint)] = 1.0
                body = int(model.body_parentid[body])

        def tensor(values: object) -> Tensor:
            return torch.tensor(np.asarray(values), dtype=torch.get_default_dtype(), device=device)

        def places(values: Sequence[int]) -> Tensor:
            return torch.tensor(list(values), dtype=torch.long, device=device)

        self._constant, self._sine, self._cosine, self._above = map(tensor, (constant, sine, cosine, above[..., None]))
        self._products, self._identity = tensor(_matrix_of_products()), tensor(np.eye(3).ravel())
        self._zero = tensor(model.qpos0[7:])
        self._axis, self._anchor = tensor(model.jnt_axis[hinges]), tensor(model.jnt_pos[hinges])
        # sine is 0 for a body without a joint
        self._angle_of = places([model.jnt_qposadr[j] - 7 if j >= 0 else 0 for j in joints])
        self._speed_of = places([model.jnt_dofadr[j] for j in hinges])
        self._carried = places([order.index(int(model.jnt_bodyid[j])) for j in hinges])
        self._wanted = places([order.index(body) for body in bodies])
        # for each level below the root: parents in the level above, and the range in ``order``
        self._levels, start = list[tuple[Tensor, slice]](), 0
        for upper, level in zip(levels, levels[1:], strict=False):
            parents = [upper.index(int(model.body_parentid[body])) for body in level]
            self._levels.append((places(parents), slice(start, start + len(level))))
            start += len(level)

    def __call__(self, qpos: Tensor, qvel: Tensor) -> Bodies:
        """The bodies in the states ``qpos`` (N, nq), ``qvel`` (N, nv)."""
        angle = (qpos[:, 7:] - self._zero).index_select(1, self._angle_of)[..., None, None]
        local = self._constant + torch.sin(angle) * self._sine + (1.0 - torch.cos(angle)) * self._cosine
        products = (qpos[:, 3:7, None] * qpos[:, None, 3:7]).flatten(1)
        turn = rotate(self._products, products).add_(self._identity).view(-1, 1, 3, 3)
        frames = [torch.nn.functional.pad(turn, (0, 1))]  # (N, 1, 3, 4): rotation, and position relative to the root
        for parents, span in self._levels:
            frames.append(product(frames[-1].index_select(1, parents), local[:, span]))
        every = torch.cat(frames, dim=1)
        carried, wanted = every.index_select(1, self._carried), every.index_select(1, self._wanted)
        axis = rotate(carried[..., :3], self._axis) * qvel.index_select(1, self._speed_of)[..., None]
        anchor = rotate(carried[..., :3], self._anchor) + carried[..., 3]
        # for each hinge: angular velocity, and linear velocity of its body at the root's origin
        twist = torch.cat([axis, torch.linalg.cross(anchor, axis)], dim=2)
        turning, moving = (self._above * twist[:, None]).sum(dim=2).split(3, dim=2)
        turning = turning + rotate(frames[0][..., :3], qvel[:, None, 3:6])
        place = wanted[..., 3]
        velocity = qvel[:, None, :3] + moving + torch.linalg.cross(turning, place)
        return Bodies(place + qpos[:, None, :3], wanted[..., :3], velocity, turning)


def rotate(turn: Tensor, vector: Tensor) -> Tensor:
    """Multiply a matrix (..., n, k) by ``vector`` (..., k) with sums: a GPU may round matrix products to ten bits."""
    return (turn * vector.unsqueeze(-2)).sum(dim=-1)


def product(a: Tensor, b: Tensor) -> Tensor:
    """Multiply (..., i, k) by (..., k, j), in the same way."""
    return (a.unsqueeze(-1) * b.unsqueeze(-3)).sum(dim=-2)


def _matrix_of_products() -> np.ndarray:
    """(9, 16) matrix from products of a unit quaternion's entries to its rotation matrix minus the identity."""
    w, x, y, z = range(4)
    terms = np.zeros((3, 3, 4, 4))
    for i, j, k in ((x, y, z), (y, z, x), (z, x, y)):
        terms[i - 1, i - 1, j, j] = terms[i - 1, i - 1, k, k] = -2.0
        terms[i - 1, j - 1, i, j], terms[i - 1, j - 1, w, k] = 2.0, -2.0
        terms[j - 1, i - 1, i, j], terms[j - 1, i - 1, w, k] = 2.0, 2.0
    return terms.reshape(9, 16)


def _levels(model: mujoco.MjModel, root: int, bodies: Sequence[int]) -> list[list[int]]:
    """The bodies and their ancestors, sorted by their depth below the root."""
    depth = {root: 0}
    for body in bodies:
        chain = [body]
        while chain[-1] not in depth:
            if chain[-1] == 0:
                name, top = model.body(body).name, model.body(root).name
                raise ModelError(f"body '{name}' is not carried by the robot's root '{top}'")
            chain.append(int(model.body_parentid[chain[-1]]))
        for each in reversed(chain[:-1]):
            depth[each] = depth[int(model.body_parentid[each])] + 1
    return [sorted(body for body, far in depth.items() if far == level) for level in range(max(depth.values()) + 1)]


def _joint(model: mujoco.MjModel, body: int) -> int:
    """The hinge between ``body`` and its parent; -1 without a hinge."""
    count, first = int(model.body_jntnum[body]), int(model.body_jntadr[body])
    if count > 1 or (count and model.jnt_type[first] != mujoco.mjtJoint.mjJNT_HINGE):
        what = f"body '{model.body(body).name}' moves by more than one hinge"
        raise ModelError(f"{what}; kinematics in torch know one hinge a body")
    return first if count else -1


def _local(model: mujoco.MjModel, body: int, joint: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The body's pose in its parent, as three (4, 4): constant + sin(angle) * second + (1 - cos(angle)) * third."""
    turn, here, away, back = np.zeros(9), *(np.eye(4) for _ in range(3))
    mujoco.mju_quat2Mat(turn, model.body_quat[body])
    here[:3, :3], here[:3, 3] = turn.reshape(3, 3), model.body_pos[body]
    if joint < 0:
        return here, np.zeros((4, 4)), np.zeros((4, 4))
    x, y, z = model.jnt_axis[joint]
    cross = np.zeros((4, 4))
    cross[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    away[:3, 3], back[:3, 3] = model.jnt_pos[joint], -model.jnt_pos[joint]
    return here, here @ away @ cross @ back, here @ away @ cross @ cross @ back
