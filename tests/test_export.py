"""An export: what is in it, that it is the policy as trained, and that a failure leaves nothing behind."""

from __future__ import annotations

import dataclasses
import re
import shutil
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from program import SMALL, files, run
from rsl_rl.utils import resolve_class
from worlds import make_env

from legged_mw import ROOT
from legged_mw.deploy.contract import ROWS, ContractError, Ends, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.robot import Measurement
from legged_mw.deploy.simulated import read_scene
from legged_mw.deploy.stage import DeployStage
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.observations import Row
from legged_mw.envs.robot_task import RobotTask
from legged_mw.export import exporter as exporting
from legged_mw.export.contract import contract_rows
from legged_mw.export.exporter import FILES, Exported, ExportError, export
from legged_mw.export.replay import overridden, own_ends
from legged_mw.export.scene import differences, standalone
from legged_mw.rl.learner_config import actor_settings, network_section
from legged_mw.rl.run_folder import update_from_run
from legged_mw.sim.model import ModelError
from legged_mw.utils.config import load_yaml
from legged_mw.utils.task import LoadedTask, load_task

TASK = ["--task", "go1_flat", "--device", "cpu"]


def arguments(made: Path) -> tuple[LoadedTask, Path]:
    task = load_task("go1_flat")
    update_from_run(task, load_yaml(made / "config.yaml"), "config.yaml")
    return task, made / "policy.onnx"


def test_a_finished_training_exports(made: Path) -> None:
    assert sorted(path.name for path in made.iterdir()) == sorted(FILES)
    assert load_yaml(made / "config.yaml") == load_yaml(made.parent / "config.yaml")
    stage = DeployStage(made, 2)
    stage.step(None)
    assert stage.contract.task == "go1_flat" and np.isfinite(stage.qpos()).all()


def test_no_file_says_where_it_was_made(made: Path) -> None:
    for name in FILES:
        content = (made / name).read_bytes()
        for word in (str(ROOT), str(made.parent), "site-packages", "stack_trace", ".py"):
            assert word.encode() not in content, (name, word)
    scene = (made / "scene.xml").read_text()
    assert "file=" not in scene and "meshdir" not in scene


def test_contract_states_what_was_trained(made: Path) -> None:
    contract, env = read_contract(made), make_env(1)
    assert (
        contract.joints == env.robot.joint_names
        and contract.imu == "imu"
        and list(contract.feet) == ["FR", "FL", "RR", "RL"]
    )
    np.testing.assert_allclose(contract.default_pose, env.default_dof_pos, atol=1e-7)
    assert (contract.action.origin, set(contract.action.scale), contract.action.clip) == ("default", {0.5}, 2.0)
    assert (contract.period, contract.decimation, contract.ends) == (0.02, 5, Ends(max_tilt=90.0))
    assert (
        contract.mass == pytest.approx(env.total_mass, abs=1e-5)
        and set(contract.stiffness) == {35.0}
        and set(contract.damping) == {0.5}
    )
    np.testing.assert_allclose(
        [[c.low for c in contract.commands], [c.high for c in contract.commands]], env.command_ranges
    )
    assert [(c.name, c.unit) for c in contract.commands] == [
        ("lin_vel_x", "m/s"),
        ("lin_vel_y", "m/s"),
        ("ang_vel_yaw", "rad/s"),
    ]
    trained_rows = [(row.name, row.size, row.noise) for row in env.observations.groups["state"]]
    assert [(row.name, row.size, row.noise) for row in contract.rows] == trained_rows
    assert all(row.unit and row.frame and row.measured for row in contract.rows) and contract.size == 48


def test_scene_is_the_machine_that_was_trained(made: Path) -> None:
    """Field by field, and in motion: dropped and thrown, it lands where the trained one does."""
    trained_model = make_env(1).robot.physics
    scene = mujoco.MjModel.from_xml_path(str(made / "scene.xml"))
    assert differences(trained_model, scene) == []
    assert (made / "scene.xml").stat().st_size < 60_000, "meshes that MuJoCo builds are a line each"
    ends = []
    for model in (trained_model, scene):
        data = mujoco.MjData(model)
        data.qpos[:], data.ctrl[:] = scene.key(0).qpos, scene.key(0).ctrl
        data.qvel[:] = np.linspace(-1, 1, 18)
        for _ in range(100):
            mujoco.mj_step(model, data)
        ends.append(data.qpos.copy())
    np.testing.assert_allclose(*ends, atol=1e-6)
    for name, value in (("actuator_gainprm", 36.0), ("body_mass", 3.0), ("dof_damping", 0.6)):
        other = mujoco.MjModel.from_xml_path(str(made / "scene.xml"))
        getattr(other, name)[-1] = value
        assert differences(trained_model, other) == [name]
    other.geom_friction[:, 0] = 0.9
    assert "geom_friction" in differences(trained_model, other)
    other.opt.impratio, other.body_iquat[1], other.actuator_forcelimited[0] = 2.0, [0.6, 0.8, 0.0, 0.0], 0
    assert {"option impratio", "body_iquat", "actuator_forcelimited"} <= {*differences(trained_model, other)}


def test_meshes_from_files_are_written_out(tmp_path: Path) -> None:
    """A robot whose trunk is an STL file: the scene needs no file, and the mesh lies where it lay."""
    corners = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.2, 0], [0, 0, 0.1]], dtype="<f4")
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    triangles = b"".join(bytes(12) + corners[list(face)].tobytes() + bytes(2) for face in faces)
    (tmp_path / "wedge.stl").write_bytes(bytes(80) + len(faces).to_bytes(4, "little") + triangles)
    mjcf = (ROOT / "resources/robots/go1/go1.xml").read_text()
    mjcf = mjcf.replace("<asset>", '<asset><mesh name="wedge" file="wedge.stl" scale="1 2 1"/>', 1)
    mjcf = mjcf.replace(
        '<geom name="trunk_box" class="collision" type="box" size="0.125 0.04 0.057"/>',
        '<geom name="trunk_box" type="mesh" mesh="wedge"/>',
        1,
    )
    (tmp_path / "robot.xml").write_text(mjcf)
    env = make_env(
        1, {"asset.file": str(tmp_path / "robot.xml"), "asset.colliders": ["FR", "FL", "RR", "RL", "trunk_box"]}
    )
    pose = env.default_dof_pos.tolist()
    scene = standalone(env.robot, imu="imu", qpos=[0, 0, 0.3, 1, 0, 0, 0, *pose], ctrl=pose)
    assert "stl" not in scene.xml
    model = mujoco.MjModel.from_xml_string(scene.xml)
    whole = env.robot.spec.copy().compile()
    for name in ("geom_pos", "geom_quat", "geom_size"):
        index = model.geom("trunk_box").id, whole.geom("trunk_box").id
        np.testing.assert_allclose(getattr(model, name)[index[0]], getattr(whole, name)[index[1]], atol=1e-5)


def test_the_export_is_replaced_whole_or_not_at_all(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Foreign files in the folder stay; a failure, early or late, leaves the export that was there."""
    out = tmp_path / "out"
    shutil.copytree(made, out)
    # the exporter takes seconds and is not what is tried
    monkeypatch.setattr(exporting, "save_onnx", lambda _policy, _clip, path: shutil.copy(made / "policy.onnx", path))
    (out / "README.md").write_text("mine")
    before = files(tmp_path)
    for name, fails in (
        ("run_onnx", lambda path, obs, **_: np.ones((len(obs), 12))),
        ("make_contract", lambda *_: 1 / 0),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(exporting, name, fails)
            with pytest.raises((ExportError, ZeroDivisionError)) as error:
                export(*arguments(made), out)
        assert files(tmp_path) == before
        if name == "run_onnx":
            assert "policy.onnx acts differently from the trained policy: up to " in str(
                error.value
            ) and "nothing was written" in str(error.value)
    (out / "policy.yaml").write_text("stale")
    export(*arguments(made), out)
    assert files(tmp_path)["out/policy.yaml"] == before["out/policy.yaml"] and (out / "README.md").read_text() == "mine"
    (tmp_path / "file").write_text("")
    with pytest.raises(ExportError, match="file is a file; name a folder to export to"):
        export(*arguments(made), tmp_path / "file")


def test_a_network_that_cannot_be_traced(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that asks what its input is, and does one thing or the other."""

    def forward(self: exporting.ExportedPolicy, obs: torch.Tensor) -> torch.Tensor:
        return self.policy(obs) if obs.sum() > 0 else -self.policy(obs)

    monkeypatch.setattr(exporting.ExportedPolicy, "forward", forward)
    with pytest.raises(ExportError, match=r"the network \(MLPModel\) cannot be exported: "):
        export(*arguments(made), tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_an_export_is_compared_under_full_kicks() -> None:
    env = exporting._small_env(load_task("go2_flat"))  # whose kicks grow in training
    assert env.cfg.perturbation.kick and env.perturbation.kick_level.eq(1.0).all()


def test_a_nan_is_a_mismatch() -> None:
    actions = np.zeros((3, 2))
    with pytest.raises(ExportError, match="acts differently"):
        exporting._check_network(np.full((3, 2), np.nan), actions)
    with pytest.raises(ExportError, match="acts differently"):
        exporting._check_network(np.zeros((1, 2)), actions)


def test_without_onnxruntime(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """onnx's own evaluator gives the same actions."""
    obs = torch.randn(4, 48, generator=torch.Generator().manual_seed(0)).numpy()
    with_it = exporting.run_onnx(made / "policy.onnx", obs)
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
    np.testing.assert_allclose(exporting.run_onnx(made / "policy.onnx", obs), with_it, atol=1e-5)


def test_an_export_that_fails_does_not_end_a_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise RuntimeError("the exporter\nhas a bad day")

    monkeypatch.setattr(exporting, "export", fails)
    result = run("train", tmp_path, *SMALL, "--max_iterations", "1", "--set", "runner.export=true")
    assert result.code == 0, result.err
    assert (
        "done: " in result.out
        and "not exported: the exporter has a bad day\n  to try again: python play.py --task go1_flat" in result.out
    )
    [folder] = tmp_path.glob("logs/*/*")
    assert (folder / "model_1.pt").is_file() and not (folder / "export").exists()


# ---- rows of one's own


class OwnRows(LeggedRobot):
    def observation_rows(self) -> dict[str, list[Row | str]]:
        rows = super().observation_rows()
        sensed = self.sim.sensordata[:, self.robot.sensors["accelerometer"]]
        rows["state"] += [Row("shake", sensed, 0.5, sensors=("accelerometer/imu",), unit="m/s^2", frame="body")]
        rows["state"] += [Row("guess", self.feet_air_time)]
        return rows


def test_rows_of_ones_own() -> None:
    """One that names its sensors can be deployed; one of an unknown name says that nobody knows."""
    *_, shake, guess = contract_rows(make_env(1, env_class=OwnRows), "state", 1.0)
    assert (shake.measured, shake.sensors, shake.unit, shake.size, shake.noise, shake.scale) == (
        "sensors",
        ("accelerometer/imu",),
        "m/s^2",
        3,
        0.5,
        (1.0, 1.0, 1.0),
    )
    assert (guess.measured, guess.unit, guess.size) == ("", "", 4)


def test_a_group_within_a_group_is_written_out() -> None:
    names = [row.name for row in contract_rows(make_env(1), "privileged_state", 1.0)]
    assert names[:7] == [
        "base_lin_vel",
        "base_ang_vel",
        "projected_gravity",
        "dof_pos",
        "dof_vel",
        "last_actions",
        "commands",
    ]
    assert names[7:9] == ["base_ang_vel", "accelerometer"] and {"torques", "foot_contact"} <= set(names) & set(ROWS)


DOG = '''"""A dog that feels its shakes."""
from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.observations import Row
from legged_mw.utils.task import Task
class Dog(LeggedRobot):
    def observation_rows(self):
        rows = super().observation_rows()
        sensed = self.sim.sensordata[:, self.robot.sensors["accelerometer"]]
        rows["state"] += [Row("shake", sensed, mirror="polar", sensors=("accelerometer/imu",), unit="m/s^2", scale=(0.5, 0.5, 0.1))]
        return rows
class DogCfg(Go1FlatCfg):
    class asset(Go1FlatCfg.asset):
        colliders = ["FR", "FL", "RR", "RL", "trunk_*"]
        terminate_after_contacts_on = ["trunk_*"]
TASK = Task(Dog, DogCfg, Go1FlatCfgPPO)
'''


def test_a_task_with_a_row_of_its_own_is_deployed(tmp_path: Path) -> None:
    (tmp_path / "dog.py").write_text(DOG)
    result = run(
        "train",
        tmp_path,
        "--task",
        str(tmp_path / "dog.py"),
        *SMALL[2:],
        "--max_iterations",
        "1",
        "--set",
        "runner.export=true",
    )
    assert result.code == 0, result.err
    [folder] = tmp_path.glob("logs/*/*/export")
    stage = DeployStage(folder, 2)
    assert read_scene(folder, stage.contract).sensordata["shake"].shape == (3,)
    stage.step(None)
    np.testing.assert_array_equal(stage.measured.others["shake"], stage.measured.acceleration)
    obs = stage.controller.observe(stage.measured, stage.commands())
    assert obs.shape == (2, 51)
    np.testing.assert_allclose(obs[:, -3:], stage.measured.acceleration * [0.5, 0.5, 0.1], rtol=1e-6)
    assert stage.contract.ends.falls_on == ("trunk_box", "trunk_right", "trunk_left") and not stage.fell().any()
    stage.fleet.qpos[1, 2] = 0.04  # with its trunk in the ground
    stage.fleet.write(stage.contract.default_pose + np.zeros((2, 1)))
    assert stage.fleet.fell().tolist() == [False, True]
    with pytest.raises(
        ContractError, match=r"the robot does not measure row 'shake': it must be in Measurement.others \(3 values\)"
    ):
        stage.controller.observe(dataclasses.replace(stage.measured, others={}), stage.commands())


CROUCHER = '''"""A Go1 that also takes a base height and remembers its joint velocities."""
from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task
class Croucher(LeggedRobot):
    def _reward_crouch(self):
        return (self.base_height - self.commands[:, 3]).abs()
class CroucherCfg(Go1FlatCfg):
    class commands(Go1FlatCfg.commands):
        units = {"base_height": "m"}
        mirror = {"base_height": 1.0}
        class ranges(Go1FlatCfg.commands.ranges):
            base_height: list[float] = [0.2, 0.3]
    class observations(Go1FlatCfg.observations):
        leave_out = {"state": ["base_lin_vel"]}
        history = {"state.dof_vel": 3, "state.last_actions": 2}
    class rewards(Go1FlatCfg.rewards):
        class scales(Go1FlatCfg.rewards.scales):
            crouch = -1.0
TASK = Task(Croucher, CroucherCfg, Go1FlatCfgPPO)
'''


def test_a_further_command_and_history_are_deployed(tmp_path: Path) -> None:
    (tmp_path / "croucher.py").write_text(CROUCHER)
    args = [*SMALL[2:], "--max_iterations", "1", "--set", "runner.export=true", "--set", "env.episode_length_s=20"]
    result = run("train", tmp_path, "--task", str(tmp_path / "croucher.py"), *args)
    assert result.code == 0 and "not exported" not in result.out, result.out + result.err
    [folder] = tmp_path.glob("logs/*/*/export")
    contract = read_contract(folder)
    assert [(c.name, c.unit, c.low, c.high, c.default) for c in contract.commands][3] == (
        "base_height",
        "m",
        0.2,
        0.3,
        0.2,
    )
    assert [(row.name, row.size, row.history) for row in contract.rows] == [
        ("base_ang_vel", 3, 1),
        ("projected_gravity", 3, 1),
        ("dof_pos", 12, 1),
        ("dof_vel", 12, 3),
        ("last_actions", 12, 2),
        ("commands", 4, 1),
    ]
    assert contract.size == 18 + 36 + 24 + 4 and contract.rows[-1].unit == "m/s, m/s, rad/s, m"
    stage = DeployStage(folder, 2, command=(0.0, 0.0, 0.0, 0.25))
    stage.step()
    np.testing.assert_array_equal(stage.commands(), [[0, 0, 0, 0.25]] * 2)
    np.testing.assert_allclose(stage.controller.observe(stage.measured, stage.commands())[:, -1], 0.25)


def test_where_history_stands_in_the_network(tmp_path: Path) -> None:
    """By hand: in the exported network action i is column COLUMNS[i] of the observation, which the contract lays out so:

    base_ang_vel 0-2, projected_gravity 3-5, dof_pos 6-17, then dof_vel of two steps ago 18-29, of the last 30-41 and of now
    42-53, then last_actions of the step before 54-65 and of now 66-77, then commands 78-80.
    """
    columns = [0, 5, 6, 18, 29, 30, 42, 53, 54, 66, 78, 80]
    history = {"state.dof_vel": 3, "state.last_actions": 2}
    settings = {
        "observations.history": history,
        "observations.leave_out": {"state": ["base_lin_vel"]},
        "actor.activation": "identity",
    }
    task, checkpoint = untrained(ROOT / "configs/go1_flat.py", tmp_path, settings | {"actor.obs_normalization": False})
    saved = torch.load(checkpoint, weights_only=True)
    for layer in (0, 2, 4):
        for part in ("weight", "bias"):
            saved["actor_state_dict"][f"mlp.{layer}.{part}"].zero_()
        saved["actor_state_dict"][f"mlp.{layer}.weight"].fill_diagonal_(1.0)
    saved["actor_state_dict"]["mlp.0.weight"].zero_()
    saved["actor_state_dict"]["mlp.0.weight"][range(12), columns] = 1.0
    torch.save(saved, checkpoint)
    export(task, checkpoint, tmp_path / "out")
    contract = read_contract(tmp_path / "out")
    controller, acted = Controller(tmp_path / "out", contract), []
    for step in (0.1, 0.2, 0.3):
        speeds = step + 0.001 * np.arange(12)
        vectors = {
            "lin_vel": np.zeros(3),
            "ang_vel": np.full(3, step),
            "gravity": np.array([0.0, 0.0, -1.0]),
            "acceleration": np.zeros(3),
        }
        measured = Measurement(
            **vectors,
            joint_pos=contract.default_pose + step,
            joint_vel=speeds,
            joint_torque=speeds,
            foot_contact=np.zeros(4),
        )
        controller.act(measured, np.array([[step, 0.0, -step]]))
        acted.append(controller.last_actions[0].copy())
    first = [0.1, -1.0, 0.1, 0.1, 0.111, 0.1, 0.1, 0.111, 0.0, 0.0, 0.1, -0.1]  # all frames are the first one
    second = [0.2, -1.0, 0.2, 0.1, 0.111, 0.1, 0.2, 0.211, 0.0, 0.1, 0.2, -0.2]
    third = [0.3, -1.0, 0.3, 0.1, 0.111, 0.2, 0.3, 0.311, 0.1, 0.2, 0.3, -0.3]
    np.testing.assert_allclose(acted, [first, second, third], atol=1e-6)


def test_a_row_that_nobody_can_measure_is_said(tmp_path: Path) -> None:
    text = Exported(FILES, 2e-7, 256, ("guess",)).text(tmp_path)
    assert "policy.onnx" in text and "differ from the trained policy's by 2e-07 at most" in text
    assert (
        "nothing says how to measure guess: legged_mw.deploy will refuse it (docs/deploy.md, Rows of your own)" in text
    )


def test_ends_of_the_tasks_own_are_said(tmp_path: Path) -> None:
    class Own(OtherRewards):
        def _fallen(self) -> torch.Tensor:
            return super()._fallen()

        def _timed_out(self) -> torch.Tensor:
            return super()._timed_out()

    assert own_ends(LeggedRobot) == own_ends(RobotTask) == own_ends(OtherPose) == ()
    assert own_ends(Own) == ("Own._fallen", "Own._timed_out", "OtherRewards.check_termination")
    text = Exported(FILES, 0.0, 256, (), not_covered=own_ends(Own)[:2]).text(tmp_path)
    assert (
        "Own._fallen, Own._timed_out ended episodes in training; a deployed robot walks on (policy.yaml: ends: not_covered)"
        in text
    )


def test_a_picture_is_left_out_and_a_height_field_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_env(1)
    robot = env.robot
    spec = robot.spec.copy()
    spec.add_hfield(name="hills", file="hills.png")
    pose = env.default_dof_pos.tolist()
    with pytest.raises(ModelError, match="height field 'hills' comes from a file; an export must need no other file"):
        standalone(
            type(robot)(**{**vars(robot), "spec": spec}), imu="imu", qpos=[0, 0, 0.3, 1, 0, 0, 0, *pose], ctrl=pose
        )


def untrained(path: Path, folder: Path, settings: dict[str, Any] | None = None) -> tuple[LoadedTask, Path]:
    """A task and a checkpoint whose small networks have seen no training."""
    task = load_task(str(path))
    for field, value in {"env.num_envs": 1, "sim.engine": "mujoco", **(settings or {})}.items():
        task.set(field, value)
    for part in ("actor", "critic"):
        task.set(f"{part}.hidden_dims", [16, 16])
    torch.manual_seed(0)
    env = task.env_class(task.cfg, "cpu")
    sections = task.train.to_dict()
    actor_class, settings = resolve_class(network_section(actor_settings(sections, env)))
    actor = actor_class(env.get_observations(), sections["obs_groups"], "actor", env.num_actions, **settings)
    torch.save({"actor_state_dict": actor.state_dict()}, folder / "model.pt")
    return task, folder / "model.pt"


@pytest.mark.parametrize(
    ("name", "commands", "feet", "rows"),
    [
        (
            "go1_stand",
            0,
            {},
            {"base_lin_vel", "base_ang_vel", "projected_gravity", "dof_pos", "dof_vel", "last_actions"},
        ),
        (
            "toy_biped",
            3,
            {"left": ("contact/left_heel", "contact/left_toe"), "right": ("contact/right_heel", "contact/right_toe")},
            {"base_lin_vel", "base_ang_vel", "projected_gravity", "dof_vel", "last_actions", "commands"},
        ),
        ("go1_base_height", 4, {name: (f"contact/{name}",) for name in ("FR", "FL", "RR", "RL")}, None),
    ],
)
def test_other_robots_and_tasks_are_deployed(
    name: str, commands: int, feet: dict[str, Any], rows: set[str] | None, tmp_path: Path
) -> None:
    """No commands and no feet; feet of two boxes, a scale a joint and no joint angles; a further command."""
    export(*untrained(ROOT / f"examples/{name}.py", tmp_path), tmp_path / "out")
    stage = DeployStage(tmp_path / "out", 2)
    assert len(stage.command_table) == commands and stage.contract.feet == feet
    assert rows is None or {row.name for row in stage.contract.rows} == rows
    for _ in range(3):
        stage.step()
    geoms = sum(map(len, feet.values()))
    assert (
        stage.commands().shape == (2, commands)
        and stage.contacts().shape == (2, geoms)
        and np.isfinite(stage.qpos()).all()
    )
    if name == "toy_biped":
        assert stage.contract.action.scale.tolist() == [0.4, 0.4, 0.25] * 2
        np.testing.assert_array_equal(stage.contacts().reshape(2, 2, 2).any(axis=2), stage.measured.foot_contact > 0.0)


# ---- an export that would act otherwise is refused


class OtherTargets(LeggedRobot):
    def _apply_actions(self) -> None:
        torch.add(self.dof_pos, self.actions, alpha=0.25, out=self.sim.ctrl)


class OtherAngles(LeggedRobot):
    def observation_rows(self) -> dict[str, list[Row | str]]:
        rows = super().observation_rows()
        rows["state"] = [
            row._replace(value=self.dof_pos) if isinstance(row, Row) and row.name == "dof_pos" else row
            for row in rows["state"]
        ]
        return rows


class OtherScale(LeggedRobot):
    def compute_observations(self) -> None:
        super().compute_observations()
        self.obs_buf["state"][:, self.observations.span("state", "base_ang_vel")] *= 0.25


class OtherVelocity(LeggedRobot):
    """What rows read is changed, not the rows."""

    def _update_state(self) -> None:
        super()._update_state()
        self.base_lin_vel.mul_(2.0)


class OtherMemory(LeggedRobot):
    def _end_step(self) -> None:
        super()._end_step()
        self.last_actions.mul_(0.5)


class OtherPose(LeggedRobot):
    def _init_buffers(self) -> None:
        self.default_dof_pos += 0.1
        super()._init_buffers()


class NoClip(LeggedRobot):
    def _step(self) -> None:
        raw = self.actions.clone()
        super()._step()
        self.obs_buf["state"][:, self.observations.span("state", "last_actions")] = raw.masked_fill_(
            self.reset_buf[:, None], 0.0
        )


class OtherRewards(LeggedRobot):
    """Nothing of this is an export's business."""

    def _reward_torques(self) -> torch.Tensor:
        return super()._reward_torques() * 2.0

    def check_termination(self) -> None:
        super().check_termination()


def export_of(
    env_class: type[LeggedRobot], made: Path, out: Path, monkeypatch: pytest.MonkeyPatch, **changes: Any
) -> Exported:
    """Export the trained policy as one of another class and other settings, by their dotted paths."""
    monkeypatch.setattr(exporting, "save_onnx", lambda _policy, _clip, path: shutil.copy(made / "policy.onnx", path))
    task, checkpoint = arguments(made)
    task.env_class = env_class
    for path, value in changes.items():
        task.set(path.replace("__", "."), value)
    return export(task, checkpoint, out)


@pytest.mark.parametrize(
    ("env_class", "what", "method"),
    [
        (OtherTargets, "joint target FR_hip_joint is ", "OtherTargets overrides _apply_actions"),
        (OtherAngles, "observation row 'dof_pos' 0 is ", "OtherAngles overrides observation_rows"),
        (OtherScale, "observation row 'base_ang_vel' ", "OtherScale overrides compute_observations"),
        (OtherVelocity, "observation row 'base_lin_vel' ", "OtherVelocity overrides _update_state"),
        (OtherMemory, "observation row 'last_actions' ", "OtherMemory overrides _end_step"),
        (NoClip, "observation row 'last_actions' ", "NoClip overrides _step"),
        (OtherPose, "observation row 'dof_pos' ", "OtherPose overrides _init_buffers"),
    ],
)
def test_an_export_that_would_act_otherwise_is_refused(
    env_class: type[LeggedRobot], what: str, method: str, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ExportError, match="legged_mw.deploy would act differently from the environment: ") as error:
        export_of(env_class, made, tmp_path / "out", monkeypatch)
    assert what in str(error.value) and f"{method}. State it where the contract can take it from" in str(error.value)
    assert not list(tmp_path.iterdir())
    if env_class is OtherAngles:
        found = re.search(
            r"row 'dof_pos' 0 is (\S+) in the environment and (\S+) by policy.yaml, at step 0\.", str(error.value)
        )
        # the default angle of the first joint
        assert found and float(found[1]) - float(found[2]) == pytest.approx(0.1, abs=1e-4)


def test_what_the_contract_states_is_exported(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Actions from another origin with a scale a joint, encoders that are off, delays, noise: deploy acts as the environment."""
    changes = {
        "control__action_origin": "targets",
        "control__action_scale": {"hip": 0.1, "thigh": 0.1, "calf": 0.05},
        "domain_rand__enable": True,
        "domain_rand__encoder_offset": [-0.05, 0.05],
        "domain_rand__action_delay": [0, 2],
        "domain_rand__observation_delay": [1, 2],
        "termination__max_tilt": 180.0,
        "termination__min_base_height": 0.1,
    }
    export_of(OtherRewards, made, tmp_path / "out", monkeypatch, **changes)
    contract = read_contract(tmp_path / "out")
    assert contract.action.origin == "targets" and contract.action.scale.tolist() == [0.1, 0.1, 0.05] * 4
    assert contract.ends == Ends(min_base_height=0.1, not_covered=("OtherRewards.check_termination",))
    assert load_yaml(tmp_path / "out/config.yaml")["domain_rand"]["action_delay"] == [0, 2]  # as trained
    assert [row.noise for row in contract.rows][:2] == [0.1, 0.2]
    export_of(LeggedRobot, made, tmp_path / "joints", monkeypatch, control__action_origin="joints")
    assert read_contract(tmp_path / "joints").action.origin == "joints"


class Unmeasured(LeggedRobot):
    """The speed of the feet instead of the commands: nobody can measure it."""

    def observation_rows(self) -> dict[str, list[Row | str]]:
        rows = super().observation_rows()
        rows["state"][-1] = Row("speeds", self.foot_speed[:, :3])
        return rows


class UnmeasuredAndOther(Unmeasured, OtherScale):
    pass


def test_a_row_that_cannot_be_measured_is_exported_and_the_others_compared(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exported = export_of(Unmeasured, made, tmp_path / "out", monkeypatch)
    assert exported.unknown == ("speeds",) and "nothing says how to measure speeds" in exported.text(tmp_path)
    with pytest.raises(ContractError, match="observation row 'speeds': nothing says how it is measured"):
        read_contract(tmp_path / "out")
    with pytest.raises(
        ExportError, match="row 'base_ang_vel' .*UnmeasuredAndOther overrides observation_rows, compute_observations"
    ):
        export_of(UnmeasuredAndOther, made, tmp_path / "out", monkeypatch)


def test_only_methods_of_the_framework_count_as_overridden() -> None:
    assert overridden(LeggedRobot) == [] and overridden(OtherRewards) == ["check_termination"]
    assert overridden(UnmeasuredAndOther) == ["observation_rows", "compute_observations"]
