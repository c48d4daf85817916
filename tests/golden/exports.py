"""What an export refuses: policies, tasks and scenes that no contract can state."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from test_export import OtherAngles, OtherMemory, OtherScale, OtherTargets, OtherVelocity
from test_motors import Springs
from worlds import make_env

from golden.table import Run, Table, given_run, made_run, patched
from legged_mw import ROOT
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.observations import Row
from legged_mw.export import exporter as exporting
from legged_mw.export.exporter import export
from legged_mw.export.scene import among_steps, standalone
from legged_mw.rl.policies import begin_with
from legged_mw.rl.run_folder import RunLock, update_from_run
from legged_mw.sim.terrain import make_terrain
from legged_mw.utils.config import load_yaml
from legged_mw.utils.task import load_task


class Grouped(LeggedRobot):
    def observation_rows(self) -> dict[str, list[Row | str]]:
        return {
            "state": super().observation_rows()["state"],
            "policy": [Row("state", self.obs_buf["state"], noise=0.1)],
        }  # type: ignore[dict-item]


def exports(env_class: Any = None, **patches: Any) -> Run:
    """The export of a run's policy as one of another class; the exporter, which takes seconds, is not what is tried."""

    def run(root: Path) -> None:
        task = load_task("go1_flat")
        folder = root / "logs/go1_flat/run"
        update_from_run(task, load_yaml(folder / "config.yaml"), where="config.yaml")
        task.env_class = env_class or task.env_class
        export(task, folder / "model_2.pt", root / "out")

    fake = {"save_onnx": lambda _policy, _clip, path: shutil.copy(made_run[0] / "export/policy.onnx", path)}
    return patched(run, exporting, **(fake | patches))


def cannot(*_: object) -> None:
    raise RuntimeError("Could not guard on data-dependent expression\nmore")


def scene(**changes: Any) -> None:
    made = make_env(1)
    spec = made.robot.spec.copy()
    if "hfield" in changes:
        spec.add_hfield(name="hills", file="hills.png")
    pose = made.default_dof_pos.tolist()
    imu = changes.get("imu", "imu")
    standalone(
        type(made.robot)(**{**vars(made.robot), "spec": spec}), imu=imu, qpos=[0, 0, 0.3, 1, 0, 0, 0, *pose], ctrl=pose
    )


def slopes() -> None:
    many: Any = {
        "levels": 1,
        "columns": 1,
        "tile": 24.0,
        "cell": 0.05,
        "border": 1.0,
        "difficulty": (1.0, 1.0),
        "seed": 1,
    }
    xml = (ROOT / "resources/policies/go1_flat/scene.xml").read_text()
    among_steps(xml, make_terrain(proportions={"stepping_stones": 1.0}, **many), [0.0, 0.0, 0.3])


def locked(root: Path) -> None:
    with RunLock(root / "there"):
        RunLock(root / "there")


def lock(root: Path) -> None:
    (root / "there").mkdir()
    (root / "there/.lock").write_text("process 1")


def table() -> Table:
    made = Table(lambda root: given_run(root))
    made.add("to a file", exports(), lambda root: (root / "out").touch())
    made.add("another network", exports(run_onnx=lambda path, obs, **_: np.ones((len(obs), 12))))
    made.add("a network that cannot be traced", exports(save_onnx=cannot))
    made.add("a law in code", exports(Springs))
    for kind in (OtherAngles, OtherMemory, OtherScale, OtherTargets, OtherVelocity):
        made.add(f"{kind.__name__}", exports(kind))
    made.calls(
        {"a picture of heights": lambda: scene(hfield=True), "slopes": slopes, "another IMU": lambda: scene(imu="nose")}
    )
    made.add("a run that is trained", locked, lock)
    alone: Any = SimpleNamespace(source=SimpleNamespace(checkpoint=Path("policy.onnx")))
    student: Any = torch.nn.ModuleDict({"teacher": torch.nn.Linear(1, 1)})
    made.add("a student alone", lambda root: begin_with(student, alone))
    return made
