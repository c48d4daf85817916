"""Clips, and motions of others."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from golden.table import Run, Table
from legged_mw import ROOT
from legged_mw.envs.robot_task import load_robot
from legged_mw.motion.foreign import read_motion
from legged_mw.sim.joints import posed
from legged_mw.sim.model import RobotModel
from legged_mw.skills.clip import Clip, read_clip, save_clip
from legged_mw.utils.task import load_task

WAVE = ROOT / "resources/motions/g1_wave.npz"


@cache
def g1() -> RobotModel:
    return load_robot(load_task("g1_track").cfg, "servo", "mujoco")


def clip() -> Clip:
    rest = np.tile([1.0, 0.0, 0.0, 0.0], (31, 1))
    return Clip(30.0, ("knee",), np.zeros((31, 3)), rest, np.zeros((31, 1)))


def cut(root: Path) -> None:
    save_clip(root / "a.npz", clip())
    (root / "a.npz").write_bytes((root / "a.npz").read_bytes()[:500])


CLIPS: dict[str, Any] = {
    "another joint": lambda: clip()._replace(joint_names=("ankle",)),
    "a long quaternion": lambda: clip()._replace(root_quat=2 * clip().root_quat),
    "places less": lambda: clip()._replace(root_pos=clip().root_pos[:5]),
}


def bodies(**change: Any) -> Run:
    """A motion as BeyondMimic writes it."""

    def given(root: Path) -> None:
        whole = read_clip(WAVE).of(g1().joint_names, "clip")
        poses = [posed(g1().physics, row[7:], row[:7]) for row in whole.qpos()[::100]]
        held = {"fps": [50], "joint_pos": whole.joint_pos[::100], "body_pos_w": [data.xpos[1:] for data in poses]}
        held |= {"body_quat_w": [data.xquat[1:] for data in poses]}
        held |= {key: change_it(held[key]) for key, change_it in change.items() if callable(change_it)}
        np.savez(
            root / "a.npz", **{key: np.array(value) for key, value in held.items() if change.get(key, 1) is not None}
        )

    return given


def table() -> Table:
    made = Table()
    for name, make in CLIPS.items():
        made.add(
            f"clip, {name}",
            lambda root: read_clip(Path("a.npz")).of(["knee"], "a.npz"),
            lambda root, make=make: save_clip(root / "a.npz", make()),
        )
    for name, given in {
        "no keys": lambda root: np.savez(root / "a.npz", joint_pos=[1.0]),
        "nothing": lambda root: (root / "a.npz").touch(),
        "one array": lambda root: (np.save(root / "a.npy", np.zeros(3)), (root / "a.npy").rename(root / "a.npz")),
        "no file": lambda root: None,
        "half": cut,
    }.items():
        made.add(f"clip, {name}", lambda root: read_clip(Path("a.npz")), given)
        made.add(f"motion, {name}", lambda root: read_motion(Path("a.npz"), g1()), given)
    for name, given in {
        "no bodies": bodies(body_pos_w=None),
        "no rate": bodies(fps=None),
        "another robot": bodies(joint_pos=lambda values: values[:, ::-1]),
    }.items():
        made.add(f"motion, {name}", lambda root: read_motion(Path("a.npz"), g1()), given)
    made.add(
        "motion of no rate",
        lambda root: read_motion(Path("a.csv"), g1(), 0.0),
        lambda root: np.savetxt(root / "a.csv", np.ones((3, 36)), delimiter=","),
    )
    for rate in (0.9, 0.0, -50.0):
        made.add(f"clip at {rate:g} Hz", lambda root, rate=rate: clip().at(rate))
    return made
