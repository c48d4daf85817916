"""A reference motion: root and joints over time, its file, and its velocities. It uses no simulator and no torch.

Quaternions are (w, x, y, z), unit, body to world.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from legged_mw.utils.errors import UserError, unknown
from legged_mw.utils.files import read_arrays

Floats = NDArray[np.float64]
LARGEST = 1e4  # [m] or [rad], largest position or angle in a clip
KEYS = ("fps", "joint_names", "root_pos", "root_quat", "joint_pos")  # arrays of a clip's .npz


class ClipError(UserError, ValueError):
    """A clip that cannot be used. The text gives the reason and the remedy."""


class Clip(NamedTuple):
    """T frames of a robot with D joints."""

    fps: float  # frames a second
    joint_names: tuple[str, ...]
    root_pos: Floats  # (T, 3) [m, world]
    root_quat: Floats  # (T, 4)
    joint_pos: Floats  # (T, D) [rad]

    @property
    def seconds(self) -> float:
        """[s] from the first frame to the last."""
        return (len(self.root_pos) - 1) / self.fps

    def qpos(self) -> Floats:
        """(T, 7 + D) states in MuJoCo's order."""
        return np.concatenate([self.root_pos, self.root_quat, self.joint_pos], axis=1)

    def qvel(self) -> Floats:
        """(T, 6 + D) root [m/s, world], angular velocity [rad/s, body], joints [rad/s], by central differences."""
        # between neighbouring frames
        turn = rotation_vector(multiply(conjugate(self.root_quat[:-1]), self.root_quat[1:])) * self.fps
        turning = np.concatenate([turn[:1], (turn[:-1] + turn[1:]) / 2, turn[-1:]])
        root, joints = (np.gradient(values, 1.0 / self.fps, axis=0) for values in (self.root_pos, self.joint_pos))
        return np.concatenate([root, turning, joints], axis=1)

    def at(self, rate: float) -> Clip:
        """The motion at ``rate`` frames per second: linear interpolation, and slerp for the quaternions."""
        if abs(rate - self.fps) < 1e-6:
            return self
        if not self.seconds * rate + 1e-6 >= 1:
            what = f"{self.seconds:g} s have no two frames at {rate:g} frames a second"
            raise ClipError(f"{what}; take a higher rate or a longer clip")
        places = np.arange(int(self.seconds * rate + 1e-6) + 1) / rate * self.fps
        first = np.minimum(places.astype(int), len(self.root_pos) - 2)
        share = (places - first)[:, None]
        here, there = self.root_quat[first], self.root_quat[first + 1]
        turned = multiply(here, from_rotation_vector(share * rotation_vector(multiply(conjugate(here), there))))
        root = (1 - share) * self.root_pos[first] + share * self.root_pos[first + 1]
        joints = (1 - share) * self.joint_pos[first] + share * self.joint_pos[first + 1]
        return Clip(rate, self.joint_names, root, turned, joints)

    def of(self, joints: Sequence[str], where: str) -> Clip:
        """The motion of ``joints`` only, in their order. Raises ClipError for a joint that the clip lacks."""
        for name in joints:
            if name not in self.joint_names:
                raise ClipError(f"{where}: {unknown('joint', name, self.joint_names, 'the clip')}")
        columns = [self.joint_names.index(name) for name in joints]
        return self._replace(joint_names=tuple(joints), joint_pos=self.joint_pos[:, columns])


def read_clip(path: Path) -> Clip:
    """Read the clip in an .npz of ``save_clip``. Raises ClipError."""
    try:
        held = read_arrays(path)
    except ValueError as error:
        raise ClipError(f"{path} cannot be read as a clip: {error}") from None
    return clip_of(path, held)


def clip_of(path: Path, held: Mapping[str, Any]) -> Clip:
    """The clip with the arrays ``held`` of the file ``path``. Raises ClipError."""
    if missing := [key for key in KEYS if key not in held]:
        hint = f"convert it with: python -m legged_mw.motion {path.name} --task TASK --out CLIP.npz"
        raise ClipError(f"{path} is no clip of legged_mw, for it has no '{missing[0]}'; {hint}")
    arrays = {key: np.asarray(held[key]) for key in KEYS}
    for key, array in arrays.items():
        kinds, axes = ("US" if key == "joint_names" else "fiu"), {"fps": 0, "joint_names": 1}.get(key, 2)
        if array.dtype.kind not in kinds or array.ndim != axes:
            expected = f"{'text' if kinds == 'US' else 'numbers'} along {axes} axes"
            raise ClipError(f"{path}: {key} is {array.dtype} along {array.ndim} axes; it must be {expected}")
    names = tuple(map(str, arrays["joint_names"]))
    return checked(path, float(arrays["fps"]), names, *(arrays[key] for key in KEYS[2:]))


def checked(
    path: Path, fps: float, names: Sequence[str], root_pos: ArrayLike, root_quat: ArrayLike, joint_pos: ArrayLike
) -> Clip:
    """A clip with these arrays, with unit quaternions without sign jumps. Raises ClipError."""
    pos, quat, joints = (np.array(values, dtype=np.float64) for values in (root_pos, root_quat, joint_pos))
    frames = len(pos)
    if frames < 2 or (pos.shape, quat.shape, joints.shape) != ((frames, 3), (frames, 4), (frames, len(names))):
        actual = f"root_pos {pos.shape}, root_quat {quat.shape}, joint_pos {joints.shape} for {len(names)} joints"
        expected = f"there must be two frames or more: (T, 3), (T, 4), (T, {len(names)})"
        raise ClipError(f"{path}: {actual}; {expected}")
    length = np.linalg.norm(quat, axis=1, keepdims=True)
    finite = all(np.isfinite(values).all() for values in (pos, quat, joints))
    if not finite or not fps > 0 or (np.abs(length - 1.0) > 0.01).any():
        wrong = "a value that is not finite, a quaternion that is not of unit length, or no frame rate"
        raise ClipError(f"{path}: the clip has {wrong}")
    if not 0.1 <= fps <= 1e5:
        raise ClipError(f"{path}: {fps:g} frames a second; there must be from 0.1 to 1e+05")
    if max(np.abs(pos).max(), np.abs(joints).max(initial=0.0)) > LARGEST or len({*names}) < len(names):
        raise ClipError(f"{path}: the clip has a place or an angle beyond {LARGEST:g} m or rad, or a joint twice")
    flips = np.where((quat[1:] * quat[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    sign = np.cumprod(np.r_[1.0, flips])[:, None]
    return Clip(fps, tuple(names), pos, quat / length * sign, joints)


def save_clip(path: Path, clip: Clip) -> None:
    """Write the clip to ``path`` (.npz) as float32."""
    arrays = {key: np.asarray(getattr(clip, key), dtype=np.float32) for key in KEYS if key != "joint_names"}
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, joint_names=np.array(clip.joint_names), **arrays)  # type: ignore[arg-type]


# ---- rotations -----------------------------------------------------------------------------------------------------


def multiply(a: Floats, b: Floats) -> Floats:
    """The product of quaternions (..., 4): rotation ``b``, then ``a``."""
    w, u, s, v = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    return np.concatenate([w * s - (u * v).sum(axis=-1, keepdims=True), w * v + s * u + np.cross(u, v)], axis=-1)


def conjugate(q: Floats) -> Floats:
    """The inverse rotation."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(q: Floats, v: Floats) -> Floats:
    """Rotate vectors (..., 3) by ``q`` (..., 4)."""
    u = q[..., 1:]
    t = 2.0 * np.cross(u, v)
    return v + q[..., :1] * t + np.cross(u, t)


def heading(q: Floats) -> Floats:
    """The rotation about the vertical in ``q``, (..., 4)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    half = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)) / 2.0
    return np.stack([np.cos(half), 0.0 * half, 0.0 * half, np.sin(half)], axis=-1)


def rotation_vector(q: Floats) -> Floats:
    """Axis times angle (..., 3) [rad], with an angle up to pi."""
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    return q[..., 1:] * np.where(sine > 1e-9, 2 * np.arctan2(sine, q[..., :1]) / np.maximum(sine, 1e-9), 2.0)


def from_rotation_vector(v: Floats) -> Floats:
    """The quaternion (..., 4) of axis times angle [rad]."""
    half = np.linalg.norm(v, axis=-1, keepdims=True) / 2
    return np.concatenate([np.cos(half), v / 2 * np.sinc(half / np.pi)], axis=-1)
