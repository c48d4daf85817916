"""What an action of an exported policy means, and the range that its joint targets are held within."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from legged_mw.deploy.reader import MOST, ContractError, Reader, compile_scene
from legged_mw.utils.errors import unknown

ORIGINS = ("default", "joints", "targets", "torque", "speed")
_LARGEST = 1000.0  # [L] clips at 100
_BEYOND = 1e-3  # [rad] that a pose may be beyond its range by rounding


class Action(NamedTuple):
    """What an action means: joint target = origin + scale * action [rad], or torque [N m] or speed [rad/s] = scale * action.

    The policy's own target is what limits judge, and what the origin "targets" goes on from; a servo gets it `held`.
    """

    origin: str  # "default": the default pose; "joints": the measured angles; "targets": the last targets; "torque", "speed": none
    scale: np.ndarray  # (D,) [rad], [N m] or [rad/s]
    clip: float  # |action| at most [-]
    lowest: np.ndarray  # (D,) what a servo is told at least, as in training; MOST either way: anything
    highest: np.ndarray  # (D,) and at most

    def held(self, targets: np.ndarray) -> np.ndarray:
        """``targets`` (..., D) within the range; NaN stays."""
        return np.clip(targets, self.lowest, self.highest)

    def to_dict(self) -> dict[str, Any]:
        values = {
            name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in self._asdict().items()
        }
        return values | {"scale": short(values["scale"])}


def short(values: Sequence[float]) -> float | list[float]:
    """One number where all are the same."""
    return values[0] if len(set(values)) == 1 else list(values)


def read_action(action: Reader, joints: Sequence[str], scene: Path | None) -> Action:
    """From the contract's reader of the section; ``scene``: where a contract is too old to state the range."""
    origin, count = action.take("origin", f"one of {', '.join(ORIGINS)}", lambda v: v in ORIGINS), len(joints)
    scale = action.scale(count, "joint")
    action.take("scale", "other than 0, which moves nothing", lambda _: bool(scale.any()))
    clip = action.above_zero("clip", _LARGEST)
    if scene:
        return Action(origin, scale, clip, *_range_of_scene(scene, joints))
    lowest, highest = (action.numbers(key, count, "joint") for key in ("lowest", "highest"))
    action.take("highest", "at least `lowest`", lambda _: bool((lowest <= highest).all()))
    return Action(origin, scale, clip, lowest, highest)


def target_range(model: mujoco.MjModel, actuators: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest target (D,) that these motors obey; MOST either way where they obey any."""
    held, ranges = model.actuator_ctrllimited[list(actuators), None] > 0, model.actuator_ctrlrange[list(actuators)]
    lowest, highest = np.where(held, ranges, [-MOST, MOST]).T
    return lowest, highest


def _range_of_scene(scene: Path, joints: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    if not scene.is_file():
        raise ContractError(
            f"policy.yaml is of a format that leaves the range of the targets to {scene.name}, which is not beside it: put it there, "
            "or export the policy again"
        )
    model = compile_scene(scene)
    names = [model.actuator(i).name for i in range(model.nu)]
    if missing := [name for name in joints if name not in names]:
        raise ContractError(f"policy.yaml: joints: {unknown('servo', missing[0], names, scene.name)}")
    return target_range(model, [names.index(name) for name in joints])


def check_pose(action: Action, joints: Sequence[str], pose: np.ndarray) -> None:
    """Raises ContractError where ``pose`` (D,) [rad] is beyond the range."""
    for joint in np.flatnonzero((pose < action.lowest - _BEYOND) | (pose > action.highest + _BEYOND)).tolist():
        raise ContractError(
            f"policy.yaml: default_pose of {joints[joint]} is {pose[joint]:g} rad, beyond the range of its targets, "
            f"{action.lowest[joint]:g} to {action.highest[joint]:g} rad (action: lowest, highest)"
        )
