"""Left and right: the partner of each joint and site when a model is mirrored about its root's x-z plane.

Geometry of a compiled model only; nothing is stepped. Masses are not compared: one side may be a little heavier.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from legged_mw.sim.joints import posed
from legged_mw.sim.model import RobotModel
from legged_mw.utils.errors import ModelError

# mirrors a place, a velocity or a force; axes and angular velocities are axial: -POLAR
POLAR = np.array([1.0, -1.0, 1.0])
TOLERANCE = 0.001  # [m] between a mirrored place and its partner's
AXIS_TOLERANCE = 0.01  # [rad] between a mirrored axis and its partner's


@dataclass(frozen=True)
class Partners:
    """A mirrored state is ``q[..., joints] * signs`` and ``site[..., sites]``; mirroring twice gives the state back."""

    joints: tuple[int, ...]  # D, in order of RobotModel.joint_names; a joint in the middle is its own partner
    signs: tuple[int, ...]  # D, +1 or -1: the direction of the mirrored joint seen along its partner's axis
    sites: tuple[int, ...]  # in order of the names asked for


def find_partners(robot: RobotModel, sites: Sequence[str] = (), tolerance: float = TOLERANCE) -> Partners:
    """Pair the joints, and the ``sites`` named, by their places and axes with all joints at zero; ``tolerance`` in [m].

    Raises ModelError for a joint or site without a partner.
    """
    model = robot.physics
    data = posed(model, np.zeros(len(robot.joint_names)))  # the pose about which q -> sign * q is the mirror image
    joint_ids, site_ids = (
        [model.joint(name).id for name in robot.joint_names],
        [robot.id("site", name) for name in sites],
    )
    # (., 3) in the root's frame
    anchors, axes, places = data.xanchor[joint_ids], data.xaxis[joint_ids], data.site_xpos[site_ids]
    slides = model.jnt_type[joint_ids] == mujoco.mjtJoint.mjJNT_SLIDE
    images = np.where(slides[:, None], axes * POLAR, axes * -POLAR)  # mirrored axes
    signs = np.where(images @ axes.T < 0.0, -1, 1)  # (D, D) of the mirrored joint i along joint j
    bends = np.linalg.norm(signs[..., None] * axes[None] - images[:, None], axis=-1)  # (D, D), about the angle [rad]
    bends[slides[:, None] != slides[None]] = np.pi  # a hinge is no slide's partner
    kinds = np.where(slides, "slide", "hinge")
    partners = _pair(
        "joint",
        robot,
        robot.joint_names,
        anchors,
        bends,
        tolerance,
        found=[f" with {kind} axis {_numbers(axis)}" for kind, axis in zip(kinds, axes, strict=True)],
        wanted=[f" with {kind} axis {_numbers(axis)}" for kind, axis in zip(kinds, images, strict=True)],
        limit=f" and {AXIS_TOLERANCE:g} rad, whichever way the axis points",
    )
    return Partners(
        joints=partners,
        signs=tuple(int(signs[i, j]) for i, j in enumerate(partners)),
        sites=_pair("site", robot, sites, places, np.zeros((len(sites), len(sites))), tolerance),
    )


def opposites(robot: RobotModel, name: str, tolerance: float = TOLERANCE) -> list[str]:
    """Names of the sites, geoms and bodies at the mirror image of the one called ``name``; ``tolerance`` in [m]."""
    model, found = robot.physics, []
    data = posed(model, np.zeros(len(robot.joint_names)))
    for kind, places in (("site", data.site_xpos), ("geom", data.geom_xpos), ("body", data.xpos)):
        if (own := mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)) >= 0:
            gaps = np.linalg.norm(places - places[own] * POLAR, axis=1)
            found += [getattr(model, kind)(int(i)).name for i in np.flatnonzero(gaps <= tolerance)]
    return list(dict.fromkeys(filter(None, found)))


def _pair(
    what: str,
    robot: RobotModel,
    names: Sequence[str],
    places: np.ndarray,  # (n, 3) [m], root frame
    bends: np.ndarray,  # (n, n) [rad] between the mirrored axis of i and that of j
    tolerance: float,  # [m]
    found: Sequence[str] = (),  # for the error's text: more about each, about each one's mirror image, about tolerances
    wanted: Sequence[str] = (),
    limit: str = "",
) -> tuple[int, ...]:
    """For each place the index of the nearest one to its mirror image."""
    gaps = np.linalg.norm(places[None] - (places * POLAR)[:, None], axis=-1)  # (n, n) [m]
    fits = (bends <= AXIS_TOLERANCE) & (gaps <= tolerance)
    for i, name in enumerate(names):
        if not fits[i].any():
            near = np.lexsort((bends[i], gaps[i].round(6)))[0]  # of those at one place, the one most alike
            raise ModelError(
                f"{what} '{name}' has no partner on the other side: mirrored about the x-z plane of '{robot.root}' it is at "
                f"{_numbers(places[i] * POLAR)} m{wanted[i] if wanted else ''}; nearest is '{names[near]}', at {_numbers(places[near])} m"
                f"{found[near] if found else ''} (in the frame of '{robot.root}', all joints at zero). They must agree to "
                f"{1000 * tolerance:g} mm{limit}: make the MJCF symmetric, or do without what mirrors the robot"
            )
    pairs: list[int] = np.where(fits, gaps, np.inf).argmin(axis=1).tolist() if names else []
    for i, j in enumerate(pairs):
        if pairs[j] != i:
            raise ModelError(
                f"{what}s '{names[i]}' and '{names[pairs[j]]}' have the same mirror partner '{names[j]}': they lie closer together "
                f"than {1000 * tolerance:g} mm and cannot be told apart; do without one of them, or without what mirrors the robot"
            )
    return tuple(pairs)


def _numbers(vector: np.ndarray) -> str:
    return "(" + ", ".join(f"{x + 0.0:g}" for x in vector.round(5)) + ")"  # no -0
