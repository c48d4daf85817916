"""Find the mirror partner of each joint and site: the one on the other side of the root's x-z plane.

Only geometry is compared; masses may differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from legged_mw.sim.joints import posed
from legged_mw.sim.model import RobotModel
from legged_mw.utils.errors import ModelError

_POLAR = np.array([1.0, -1.0, 1.0])  # factor for polar vectors, such as positions; for axial ones (joint axes): -_POLAR
_TOLERANCE = 0.001  # [m] allowed distance between a mirrored position and that of its partner
_AXIS_TOLERANCE = 0.01  # [rad] allowed angle between a mirrored axis and that of its partner


@dataclass(frozen=True)
class Partners:
    """The mirrored state is ``q[..., joints] * signs`` and ``site[..., sites]``. Applied twice it gives the state."""

    joints: tuple[int, ...]  # (D,) in order of RobotModel.joint_names; a joint in the middle is its own partner
    signs: tuple[int, ...]  # (D,) +1 or -1: direction of the mirrored joint along its partner's axis
    sites: tuple[int, ...]  # in the order of ``sites``


def find_partners(robot: RobotModel, sites: Sequence[str] = ()) -> Partners:
    """Find partners of joints and ``sites`` by positions [m] and axes with all joints at zero.

    Raises ModelError for a joint or site without a partner.
    """
    model, names = robot.physics, robot.joint_names
    data = posed(model, np.zeros(len(names)))  # with symmetric zero angles the mirror image is q -> sign * q
    joint_ids, site_ids = [model.joint(name).id for name in names], [robot.id("site", name) for name in sites]
    axes = data.xaxis[joint_ids]  # (D, 3), root frame
    slides = model.jnt_type[joint_ids] == mujoco.mjtJoint.mjJNT_SLIDE
    images = np.where(slides[:, None], axes * _POLAR, axes * -_POLAR)  # mirrored axes
    signs = np.where(images @ axes.T < 0.0, -1, 1)  # (D, D) sign of the mirrored joint i along joint j
    bends = np.linalg.norm(signs[..., None] * axes[None] - images[:, None], axis=-1)  # (D, D) approximate angle [rad]
    bends[slides[:, None] != slides[None]] = np.pi  # a hinge and a slide are never partners
    kinds = np.where(slides, "slide", "hinge")
    found, wanted = (
        [f" with {kind} axis {_numbers(axis)}" for kind, axis in zip(kinds, of, strict=True)] for of in (axes, images)
    )
    joints = _pair("joint", robot, names, data.xanchor[joint_ids], bends, found, wanted)
    alike, blank = np.zeros((len(sites), len(sites))), [""] * len(sites)
    return Partners(
        joints=joints,
        signs=tuple(int(signs[i, j]) for i, j in enumerate(joints)),
        sites=_pair("site", robot, sites, data.site_xpos[site_ids], alike, blank, blank),
    )


def opposites(robot: RobotModel, name: str) -> list[str]:
    """Names of the sites, geoms and bodies at the mirror image of ``name``."""
    model, names = robot.physics, []
    data = posed(model, np.zeros(len(robot.joint_names)))
    for kind, places in (("site", data.site_xpos), ("geom", data.geom_xpos), ("body", data.xpos)):
        if (own := mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)) >= 0:
            gaps = np.linalg.norm(places - places[own] * _POLAR, axis=1)
            names += [getattr(model, kind)(int(i)).name for i in np.flatnonzero(gaps <= _TOLERANCE)]
    return list(dict.fromkeys(filter(None, names)))


def _pair(
    what: str,
    robot: RobotModel,
    names: Sequence[str],
    places: np.ndarray,  # (n, 3) [m], root frame
    bends: np.ndarray,  # (n, n) [rad] between the mirrored axis of i and that of j
    found: Sequence[str],  # texts for the error: on each one, and (``wanted``) on its mirror image
    wanted: Sequence[str],
) -> tuple[int, ...]:
    """For each position the index of the one nearest to its mirror image. Raises ModelError."""
    gaps = np.linalg.norm(places[None] - (places * _POLAR)[:, None], axis=-1)  # (n, n) [m]
    fits = (bends <= _AXIS_TOLERANCE) & (gaps <= _TOLERANCE)
    root, within = robot.root, f"{1000 * _TOLERANCE:g} mm"
    for i, name in enumerate(names):
        if not fits[i].any():
            near = np.lexsort((bends[i], gaps[i].round(6)))[0]  # nearest position, then nearest axis
            limit = f" and {_AXIS_TOLERANCE:g} rad, whichever way the axis points" if what == "joint" else ""
            mirrored, nearest = _numbers(places[i] * _POLAR), _numbers(places[near])
            raise ModelError(
                f"{what} '{name}' has no partner on the other side: mirrored about the x-z plane of '{root}' it is at "
                f"{mirrored} m{wanted[i]}; nearest is '{names[near]}', at {nearest} m"
                f"{found[near]} (in the frame of '{root}', all joints at zero). They must agree to {within}{limit}: "
                "make the MJCF symmetric, or do without what mirrors the robot"
            )
    pairs: list[int] = np.where(fits, gaps, np.inf).argmin(axis=1).tolist() if names else []
    for i, j in enumerate(pairs):
        if pairs[j] != i:
            raise ModelError(
                f"{what}s '{names[i]}' and '{names[pairs[j]]}' have the same mirror partner '{names[j]}': they lie "
                f"closer together than {within} and cannot be told apart; do without one of them, or without what "
                "mirrors the robot"
            )
    return tuple(pairs)


def _numbers(vector: np.ndarray) -> str:
    return "(" + ", ".join(f"{x + 0.0:g}" for x in vector.round(5)) + ")"  # no -0
