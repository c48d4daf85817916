"""Left and right: which joint and which site takes whose place when a model is mirrored about its root's x-z plane.

Geometry of a compiled model only; nothing is stepped. Inertia is not compared: a model that pairs up here may still
carry a little more mass on one side.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from legged_mw.sim.model import ModelError, RobotModel

POLAR = np.array([1.0, -1.0, 1.0])  # a place, a velocity, a force; what turns (an axis, an angular velocity) is axial: -POLAR
TOLERANCE = 0.001  # [m] between a mirrored place and its partner's
AXIS_TOLERANCE = 0.01  # [rad] between a mirrored axis and its partner's


@dataclass(frozen=True)
class Partners:
    """A mirrored state is ``q[..., joints] * signs`` and ``site[..., sites]``; doing it twice gives the state back."""

    joints: tuple[int, ...]  # D, in order of RobotModel.joint_names; a joint in the middle is its own partner
    signs: tuple[int, ...]  # D, +1 or -1: the direction of the mirrored joint seen along its partner's axis
    sites: tuple[int, ...]  # in order of the names asked for


def find_partners(robot: RobotModel, sites: Sequence[str] = (), tolerance: float = TOLERANCE) -> Partners:
    """Pair the joints, and the ``sites`` named, by their places and axes with all joints at zero; ``tolerance`` in [m].

    Raises ModelError for a joint or site without a partner.
    """
    model = robot.physics
    data = mujoco.MjData(model)
    data.qpos[7:] = 0.0  # the pose about which q -> sign * q is the mirror image
    mujoco.mj_kinematics(model, data)
    root = robot.id("body", robot.root)
    origin, rotation = data.xpos[root], data.xmat[root].reshape(3, 3)
    joint_ids, site_ids = [model.joint(name).id for name in robot.joint_names], [robot.id("site", name) for name in sites]
    anchors, axes = (data.xanchor[joint_ids] - origin) @ rotation, data.xaxis[joint_ids] @ rotation  # (D, 3) in the root's frame
    places = (data.site_xpos[site_ids] - origin) @ rotation  # (S, 3) in the root's frame
    slides = model.jnt_type[joint_ids] == mujoco.mjtJoint.mjJNT_SLIDE
    images = np.where(slides[:, None], axes * POLAR, axes * -POLAR)  # mirrored axes
    signs = np.where(images @ axes.T < 0.0, -1, 1)  # (D, D) of the mirrored joint i along joint j
    bend = np.linalg.norm(signs[..., None] * axes[None] - images[:, None], axis=-1)  # (D, D), about the angle [rad]
    alike = (bend <= AXIS_TOLERANCE) & (slides[:, None] == slides[None])
    partners = _pair("joint", robot, robot.joint_names, anchors, alike, tolerance, axes, images)
    return Partners(
        joints=partners,
        signs=tuple(int(signs[i, j]) for i, j in enumerate(partners)),
        sites=_pair("site", robot, sites, places, np.ones((len(sites), len(sites)), dtype=bool), tolerance),
    )


def _pair(
    kind: str,
    robot: RobotModel,
    names: Sequence[str],
    places: np.ndarray,  # (n, 3) [m], root frame
    alike: np.ndarray,  # (n, n): may i and j be partners, but for their places
    tolerance: float,  # [m]
    axes: np.ndarray | None = None,  # (n, 3), for the error's text
    images: np.ndarray | None = None,  # (n, 3), mirrored axes
) -> tuple[int, ...]:
    """For each place the index of the nearest one to its mirror image."""
    gaps = np.linalg.norm(places[None] - (places * POLAR)[:, None], axis=-1)  # (n, n) [m]
    fits = alike & (gaps <= tolerance)
    for i, name in enumerate(names):
        if not fits[i].any():
            near = int(gaps[i].argmin())
            wanted = _at(places[i] * POLAR, None if images is None else images[i])
            found = _at(places[near], None if axes is None else axes[near])
            limit = f"{1000 * tolerance:g} mm" + ("" if axes is None else f" and {AXIS_TOLERANCE:g} rad, whichever way the axis points")
            raise ModelError(
                f"{kind} '{name}' has no partner on the other side: mirrored about the x-z plane of '{robot.root}' it is {wanted}; "
                f"nearest is '{names[near]}', {found} (in the frame of '{robot.root}', all joints at zero). They must agree to "
                f"{limit}: make the MJCF symmetric, or do without what mirrors the robot"
            )
    partners = np.where(fits, gaps, np.inf).argmin(axis=1) if names else np.zeros(0, dtype=int)
    pairs: list[int] = partners.tolist()
    for i, j in enumerate(pairs):
        if pairs[j] != i:
            raise ModelError(
                f"{kind}s '{names[i]}' and '{names[pairs[j]]}' have the same mirror partner '{names[j]}': they lie closer together "
                f"than {1000 * tolerance:g} mm and cannot be told apart; do without one of them, or without what mirrors the robot"
            )
    return tuple(pairs)


def _at(place: np.ndarray, axis: np.ndarray | None) -> str:
    def numbers(v: np.ndarray) -> str:
        return "(" + ", ".join(f"{x + 0.0:g}" for x in v.round(5)) + ")"  # no -0

    return f"at {numbers(place)} m" + ("" if axis is None else f" with axis {numbers(axis)}")
