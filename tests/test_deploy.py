"""legged_mw.deploy on the shipped export: its contract, the seam, and the same walk as in the training environment."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import onnx
import pytest
import torch
import yaml
from recorder import Recorder

from legged_mw import ROOT
from legged_mw.deploy import __main__ as program
from legged_mw.deploy.contract import Contract, ContractRow, Ends, checksum, read_contract, sealed
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.exam import contract_rules
from legged_mw.deploy.robot import Floats, Measurement, RobotError
from legged_mw.deploy.runner import run
from legged_mw.deploy.safety import Limits, Safety
from legged_mw.deploy.simulated import Fleet, MujocoRobot, read_scene
from legged_mw.deploy.stage import DeployStage
from legged_mw.eval import rollout, walking
from legged_mw.rl.policies import act, load_policy
from legged_mw.rl.run_folder import update_from_run
from legged_mw.utils.cli import one_line_errors
from legged_mw.utils.config import load_yaml
from legged_mw.utils.task import load_task

SHIPPED = ROOT / "resources/policies/go1_flat"
FILES = ("policy.yaml", "policy.onnx", "scene.xml")
PER_JOINT = ("joints", "default_pose", "stiffness", "damping")
AHEAD = np.array([0.8, 0.0, 0.0])


@pytest.fixture(scope="module")
def contract() -> Contract:
    return read_contract(SHIPPED)


@pytest.fixture
def export(tmp_path: Path) -> Path:
    """A copy to be broken."""
    folder = tmp_path / "export"
    folder.mkdir()
    for name in FILES:
        shutil.copy(SHIPPED / name, folder)
    return folder


def rewrite(folder: Path, change: Callable[[Any], Any]) -> None:
    """Change what policy.yaml says."""
    said = load_yaml(folder / "policy.yaml")
    change(said)
    (folder / "policy.yaml").write_text(yaml.safe_dump(sealed(said), sort_keys=False))


def main(capsys: pytest.CaptureFixture[str], *args: str | Path) -> tuple[int, str, str]:
    """Code, output and error of ``python -m legged_mw.deploy``, in this process."""
    code = 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["deploy", *map(str, args)])
        try:
            with one_line_errors("legged_mw.deploy"):
                program.main()
        except SystemExit as end:
            assert isinstance(end.code, int)
            code = end.code
    return code, *capsys.readouterr()


# ---- a wrong contract: one clear line each


def without(path: str) -> Callable[[Any], None]:
    *outer, last = path.split(".")

    def change(said: Any) -> None:
        for key in outer:
            said = said[key]
        del said[last]

    return change


def put(path: str, value: Any) -> Callable[[Any], None]:
    *outer, last = [int(key) if key.isdigit() else key for key in path.split(".")]

    def change(said: Any) -> None:
        for key in outer:
            said = said[key]
        said[last] = value

    return change


def edit(folder: Path, change: Callable[[Any], Any]) -> None:
    """Change what policy.yaml says, as an editor does."""
    said = load_yaml(folder / "policy.yaml")
    change(said)
    (folder / "policy.yaml").write_text(yaml.safe_dump(said, sort_keys=False))


SHOWS = ("--viewer", "none", "--time", "0.1s")
UNKNOWN = "what was exported is unknown: its line `exported` is missing, or was changed too"
EDITS = [
    (put("action.scale", -0.5), "action.scale: -0.5, exported 0.5"),
    (put("observation.3.scale", 0.0), "observation[3].scale: 0.0, exported 1.0"),
    (put("default_pose.1", 0.95), "default_pose[1]: 0.95, exported 0.9"),
    (put("observation.0.measured", "ang_vel"), "observation[0].measured: 'ang_vel', exported 'lin_vel'"),
    (
        lambda said: said["observation"].insert(0, said["observation"].pop(1)),
        "observation[0].name: 'base_ang_vel', exported 'base_lin_vel'",
    ),
    (without("physics.terrain"), "physics.terrain.file: nothing, exported 'terrain.mjz'"),
    (put("format", 2), "format: 2, exported 5"),
    (without("exported"), UNKNOWN),
    (
        lambda said: (said.pop("checksum"), put("exported", "eJyrVkrKT1KyUjCoBQARPgL6")(said)),
        "bob: nothing, exported 0",
    ),
    (lambda said: (said.pop("checksum"), put("exported", "eJyrVkrKT1KyUjCo")(said)), UNKNOWN),
    (without("checksum"), ""),
]


@pytest.mark.parametrize(("change", "line"), EDITS, ids=[line for _, line in EDITS])
def test_an_edited_contract(
    change: Callable[[Any], Any], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is refused unless the user says that it was edited; then each value stands beside the exported one."""
    folder = shutil.copytree(ROOT / "resources/policies/go1_rough", tmp_path / "export")
    edit(folder, change)
    code, out, err = main(capsys, folder, *SHOWS)
    assert (code, out) == (2, "") and "checksum" in err and "--edited" in err and err.count("\n") == 1
    code, out, err = main(capsys, folder, *SHOWS, "--edited")
    assert code == 0 and (f"policy.yaml: {line}\n" in out if line else "export: no value was changed" in out), err


def test_a_copy_that_was_changed_with_the_contract(export: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The checksum is of the copy, too."""
    said = load_yaml(export / "policy.yaml")
    other = said | {"exported": sealed(said | {"action": said["action"] | {"scale": 0.4}})["exported"], "imu": "b"}
    (export / "policy.yaml").write_text(yaml.safe_dump(other, sort_keys=False))
    code, out, _ = main(capsys, export, *SHOWS, "--edited")
    assert code == 0 and UNKNOWN in out


@pytest.mark.parametrize("file", ["scene.xml", "terrain.mjz"])
def test_a_scene_is_bound_to_the_contract(file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = shutil.copytree(ROOT / "resources/policies/go1_rough", tmp_path / "export")
    if file == "scene.xml":
        (folder / file).write_text((folder / file).read_text().replace("0.213", "0.214", 1))
    else:
        shutil.copy(ROOT / "resources/policies/go2_rough/terrain.mjz", folder)
    code, out, err = main(capsys, folder, *SHOWS)
    assert (code, out) == (2, "") and f"{file} is not the exported file" in err and "--edited" in err
    code, out, err = main(capsys, folder, *SHOWS, "--edited")
    assert code == 0 and f"{file}: another file than the exported one" in out, err


def test_a_terrain_that_the_contract_does_not_name(export: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copy(ROOT / "resources/policies/go1_rough/terrain.mjz", export)
    code, _, err = main(capsys, export, "--terrain", "--viewer", "none")
    assert code == 2 and "no terrain.mjz in " in err


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            put("default_pose.0", 10.0),
            "default_pose of FR_hip_joint is 10 rad, beyond the range of its targets, -0.863 to 0.863 rad",
        ),
        (put("ends.falls_on.0", "x"), "ends: falls_on: no geom 'x' in sensors: fall_contact; there are: "),
        (put("action.scale", 0.0), "'scale' is 0.0; it must be other than 0"),
    ],
)
def test_nonsense_stays_refused(
    change: Callable[[Any], Any], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(ROOT / "resources/policies/go1_footstand", tmp_path / "export")
    edit(folder, change)
    code, _, err = main(capsys, folder, *SHOWS, "--edited")
    assert code == 2 and said in err and err.count("\n") == 1


KEYFRAME = '<key name="home"'


@pytest.mark.parametrize("key", ["", f"{KEYFRAME}/>"])
def test_a_scene_without_its_keyframe(key: str, export: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """MuJoCo makes one of straight legs where only `size nkey` is left, or no pose."""
    file = export / "scene.xml"
    file.write_text(re.sub(KEYFRAME + "[^>]*/>", key, file.read_text()))
    code, _, err = main(capsys, export, *SHOWS, "--edited")
    assert code == 2 and "it has no keyframe" in err


def older(folder: Path, version: int = 2) -> None:
    """As an earlier version wrote it."""
    said = load_yaml(folder / "policy.yaml") | {"format": version}
    for path in ("action.lowest", "action.highest", "physics.sha256", "exported"):
        without(path)(said)
    (folder / "policy.yaml").write_text(yaml.safe_dump(said | {"checksum": checksum(said)}, sort_keys=False))


def test_an_older_format(export: Path, contract: Contract, capsys: pytest.CaptureFixture[str]) -> None:
    """Its targets are held within the range that the scene has; without the scene it is refused."""
    older(export)
    read = read_contract(export)
    np.testing.assert_array_equal(
        [read.action.lowest, read.action.highest], [contract.action.lowest, contract.action.highest]
    )
    assert main(capsys, export, *SHOWS)[0] == 0
    code, out, _ = main(capsys, export, *SHOWS, "--edited")
    assert code == 0 and UNKNOWN not in out
    (export / "scene.xml").unlink()
    code, _, err = main(capsys, export)
    assert code == 2 and "scene.xml, which has it, is missing" in err and "export the policy again" in err


def test_another_network_of_the_same_shapes_is_refused(export: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The contract knows its network by digest; tests/golden/contract.py has those that are damaged."""
    model = onnx.load(export / "policy.onnx")
    model.graph.initializer[0].raw_data = bytes(len(model.graph.initializer[0].raw_data))
    onnx.save(model, export / "policy.onnx")
    code, _, err = main(capsys, export)
    assert code == 2 and "SHA-256" in err


def test_numbers_as_people_write_them(export: Path) -> None:
    text = (export / "policy.yaml").read_text()
    assert "scale: 0.5" in text
    (export / "policy.yaml").write_text(text.replace("scale: 0.5", "scale: 5e-1"))
    np.testing.assert_array_equal(read_contract(export).action.scale, [0.5] * 12)


# ---- the same walk as in the training environment


def test_walks_as_in_the_environment(contract: Contract) -> None:
    """Observations agree to float32's rounding at first; then errors grow, as they do in a walk, but the walk is the same."""
    task = load_task("go1_flat")
    update_from_run(task, load_yaml(SHIPPED / "config.yaml"), where="config.yaml")
    rollout.prepare(task)
    commands = np.array(walking.ExamRules.from_config(task.cfg).commands())
    task.cfg.env.num_envs = len(commands)
    env = task.env_class(task.cfg, "cpu")
    policy = load_policy(SHIPPED / "policy.onnx", env, task.train, "cpu")
    stage = DeployStage(SHIPPED, len(commands))
    env.reset()
    env.commands[:] = torch.tensor(commands)
    env.compute_observations()
    obs = env.get_observations()
    errors: list[Floats] = []
    for step in range(150):
        seen = stage.controller.observe(stage.measured, commands)
        if step < 10:
            # joint speeds are the largest, up to 20 rad/s
            np.testing.assert_allclose(seen, obs["state"].numpy(), atol=1e-3)
            np.testing.assert_allclose(stage.qpos(), env.sim.qpos.numpy(), atol=1e-5)
            if step:  # before the first step the environment has sensed nothing
                np.testing.assert_allclose(stage.measured.joint_torque, env.torques.numpy(), atol=1e-2)
                np.testing.assert_allclose(stage.measured.acceleration, env.accelerometer.numpy(), atol=5e-2)
        theirs = np.concatenate([env.base_lin_vel[:, :2].numpy(), env.base_ang_vel[:, 2:].numpy()], axis=1)
        errors.append(np.stack([np.abs(v - commands) for v in (theirs, stage.velocity())]))
        obs, *_ = env.step(act(policy, obs))
        stage.step(commands)
    assert not stage.fell().any()
    env_error, deploy_error = np.stack(errors)[50:].mean(axis=(0, 2))
    np.testing.assert_allclose(env_error, deploy_error, atol=0.003)  # as docs/deploy.md says
    assert (deploy_error < 0.06).all()


def test_a_moved_row_is_noticed(export: Path) -> None:
    """What the test above relies on: the order of rows matters, and the contract states it."""
    right = DeployStage(SHIPPED)
    rewrite(export, lambda said: said["observation"].reverse())
    wrong = DeployStage(export)
    errors = [], []
    for stage, error in zip((right, wrong), errors, strict=True):
        for _ in range(100):
            stage.step(AHEAD[None])
            error.append(abs(stage.velocity()[0, 0] - 0.8))
    assert np.mean(errors[0][50:]) < 0.1 < 0.3 < np.mean(errors[1][50:])


def test_measurements_are_of_the_new_state(contract: Contract) -> None:
    """Sensors of position and velocity, after a step, of a robot that is thrown about."""
    fleet = Fleet(SHIPPED, contract, 3)
    fleet.qpos[:, 3:7] = np.array([0.9, 0.3, 0.2, 0.1]) / np.linalg.norm([0.9, 0.3, 0.2, 0.1])
    fleet.qpos[:, 2], fleet.qvel[:] = 1.0, np.linspace(-2, 2, 18)
    fleet.write(np.tile(contract.default_pose, (3, 1)))
    measured, model = fleet.read(), fleet.model
    data = mujoco.MjData(model)
    data.qpos, data.qvel = fleet.qpos[1], fleet.qvel[1]
    mujoco.mj_forward(model, data)
    rotation = data.xmat[1].reshape(3, 3)
    np.testing.assert_allclose(measured.gravity[1], rotation.T @ [0, 0, -1], atol=1e-9)
    np.testing.assert_allclose(measured.ang_vel[1], fleet.qvel[1, 3:6], atol=1e-9)
    lever = np.cross(fleet.qvel[1, 3:6], model.site("imu").pos)
    np.testing.assert_allclose(measured.lin_vel[1], rotation.T @ fleet.qvel[1, :3] + lever, atol=1e-9)
    np.testing.assert_allclose(measured.joint_pos[1], fleet.qpos[1, 7:], atol=1e-12)
    np.testing.assert_allclose(measured.joint_vel[1], fleet.qvel[1, 6:], atol=1e-12)


def test_joints_may_stand_in_another_order(export: Path, contract: Contract) -> None:
    """Names, not places: a contract with legs in another order commands and reads the right joints."""
    order = np.roll(np.arange(12), 3)

    def reorder(said: Any) -> None:
        for part, name in (
            (said["action"], "lowest"),
            (said["action"], "highest"),
            *((said, name) for name in PER_JOINT),
        ):
            part[name] = [part[name][i] for i in order]
        for name in ("joint_pos", "joint_vel", "joint_torque"):
            said["sensors"][name] = [said["sensors"][name][i] for i in order]

    rewrite(export, reorder)
    fleets = [Fleet(SHIPPED, contract), Fleet(export, read_contract(export))]
    targets = contract.default_pose + 0.1 * np.arange(12)
    fleets[0].write(targets[None])
    fleets[1].write(targets[None, order])
    np.testing.assert_array_equal(fleets[0].qpos, fleets[1].qpos)
    np.testing.assert_array_equal(fleets[0].read().joint_pos[:, order], fleets[1].read().joint_pos)


def test_threads_change_no_bit(contract: Contract) -> None:
    fleets = [Fleet(SHIPPED, contract, 6, threads) for threads in (1, 3)]
    for fleet in fleets:
        for step in range(5):
            fleet.write(contract.default_pose + 0.1 * np.sin(np.arange(72).reshape(6, 12) + step))
    np.testing.assert_array_equal(fleets[0].qpos, fleets[1].qpos)
    assert (fleets[0].qpos[0] != fleets[0].qpos[1]).any()


# ---- the stage, for viewers and the exam


def test_a_refresh_keeps_every_robots_torque(contract: Contract) -> None:
    fleet, random = Fleet(SHIPPED, contract, 4, 2), np.random.default_rng(0)
    for _ in range(3):
        fleet.write(contract.default_pose + 0.3 * random.standard_normal((4, len(contract.joints))))
    torque = fleet.motor_torque()
    fleet.refresh()
    np.testing.assert_array_equal(fleet.motor_torque(), torque)


def test_stage() -> None:
    stage = DeployStage(SHIPPED, 3, command=(0.5, 0.0, 0.0))
    assert stage.num_worlds == 3 and stage.dt == 0.02 and stage.qpos().shape == (3, 19)
    assert [(c.name, c.low, c.high) for c in stage.command_table] == [
        ("lin_vel_x", -1.5, 1.5),
        ("lin_vel_y", -0.8, 0.8),
        ("ang_vel_yaw", -1.2, 1.2),
    ]
    stage.step(None)
    np.testing.assert_array_equal(stage.commands(), [[0.5, 0, 0]] * 3)
    stage.step(np.array([[1.0, 0, 0], [0, 0.4, 0], [0, 0, 0.6]]))
    assert stage.commands()[1, 1] == 0.4 and stage.contacts().shape == (3, 4) and stage.contacts().dtype == bool
    before = stage.fleet.qvel[:, :2].copy()
    stage.push(1, np.array([0.5, -1.0]))
    np.testing.assert_allclose(stage.fleet.qvel[:, :2] - before, [[0, 0], [0.5, -1.0], [0, 0]])
    stage.fleet.qpos[2, 3:7] = [0, 1, 0, 0]  # on its back
    stage.step(None)
    assert stage.fell().tolist() == [False, False, True]
    assert stage.qpos()[2, 2] == 0.278 and not stage.controller.last_actions[2].any()  # it starts again
    stage.step(None)
    assert not stage.fell().any()
    stage.reset(1)
    np.testing.assert_allclose(stage.velocity()[1], 0.0)
    assert stage.qpos()[1, 0] == 0.0 != stage.qpos()[0, 0]


def test_it_is_driven(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By the viewers' own loop with nobody watching: it obeys a fixed command, and a script."""
    code, out, err = main(capsys, SHIPPED, "--viewer", "none", "--time", "3", "--command", "0.8,0,0", "--num_envs", "2")
    assert code == 0, err
    [leg] = [line.split() for line in out.splitlines() if "+0.80 +0.00 +0.00" in line]
    # from, s, for, s, three commanded, three measured
    assert "3.0 s, 0 falls" in out and abs(float(leg[7]) - 0.8) < 0.08
    (tmp_path / "script.yaml").write_text(
        "commands: [{time: 0, command: [0.5, 0, 0]}, {time: 0.5, command: [0, 0.4, 0]}, {time: 1, reset: true}]"
    )
    code, out, err = main(capsys, SHIPPED, "--commands", tmp_path / "script.yaml", "--viewer", "none")
    assert code == 0, err
    assert "+0.50 +0.00 +0.00" in out and "+0.00 +0.40 +0.00" in out and "4.0 s, 0 falls" in out


def test_an_end_that_nobody_judges_is_said(export: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rewrite(export, lambda said: said["ends"].update(not_covered=["Dog._fallen"]))
    assert read_contract(export).ends == Ends(max_tilt=90.0, not_covered=("Dog._fallen",))
    code, out, err = main(capsys, export, "--viewer", "none", "--time", "0.1")
    assert code == 0 and out.startswith("not judged here: Dog._fallen, which ended episodes in training\n"), out + err


def test_exam(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The first seconds of it, with every push: written and printed."""
    monkeypatch.setattr(walking, "EXAM_SECONDS", 2.6)
    monkeypatch.setattr(walking, "PUSH_AT", 1.0)
    monkeypatch.setattr(walking, "PUSH_UNTIL", 2.2)
    code, out, err = main(capsys, SHIPPED, "--eval", "--no_hard", "--out", tmp_path / "exam.json")
    assert code == 0, err
    saved = json.loads((tmp_path / "exam.json").read_text())
    assert (
        "falls in 22 commands                     0" in out
        and saved["falls"] == 0
        and saved["engine"] == "mujoco (deploy)"
    )
    assert saved["pushes"]["1"] == saved["pushes"]["2"] == 1.0 and saved["pushes"]["6"] < 1.0
    assert list(saved["pushes"]) == ["1", "2", "3", "4", "5", "6"] and "beats the peer: " in out
    assert all(error < 0.12 for error in saved["error"]) and 0.5 < saved["cost_of_transport"] < 1.2


@pytest.mark.parametrize("of", ["a name", "a path", "a folder of mine"])
def test_results_of_a_shipped_policy_go_to_the_logs(
    of: str, export: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The package may be another user's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("legged_mw.deploy.exam.run_exam", lambda *_, **__: {})
    monkeypatch.setattr(walking, "table", lambda _: "the table")
    shown = []
    monkeypatch.setattr(program.launch, "watch", lambda stage, args, folder, **_: shown.append(folder.absolute()))
    before = sorted(path.name for path in SHIPPED.iterdir())
    name = {"a name": "go1_flat", "a path": SHIPPED, "a folder of mine": export}[of]
    where = export if of == "a folder of mine" else tmp_path / "logs/go1_flat/shipped"
    assert main(capsys, name, "--eval", "--no_hard")[0] == main(capsys, name)[0] == 0
    assert (where / "exam.json").is_file() and shown == [where]
    assert sorted(path.name for path in SHIPPED.iterdir()) == before


def test_the_contract_brings_the_rules_of_the_exam(export: Path) -> None:
    shipped = contract_rules(read_contract(export))
    assert shipped.peer == "go1" and shipped.push_vx == 0.8 and shipped.push_speeds == (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    rewrite(export, put("exam", {"push_speeds": [1.5], "push_mark": 1.5}))
    assert contract_rules(read_contract(export)).push_speeds == (1.5,)


def test_a_result_that_cannot_be_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Refused before the exam; or after it, where the disk changed meanwhile: the table is out by then."""
    monkeypatch.setattr("legged_mw.deploy.exam.run_exam", lambda *_, **__: {})
    monkeypatch.setattr(walking, "table", lambda _: "the table")
    (tmp_path / "file").write_text("")
    code, out, err = main(capsys, SHIPPED, "--eval", "--no_hard", "--out", tmp_path / "file/exam.json")
    assert (
        code == 2 and out == "" and f"--out {tmp_path}/file/exam.json: {tmp_path}/file is a file, not a folder" in err
    )
    monkeypatch.setattr(program, "writable", lambda *_, **__: None)
    code, out, err = main(capsys, SHIPPED, "--eval", "--no_hard", "--out", tmp_path / "file/exam.json")
    assert (
        code == 2
        and out == "the table\n"
        and f"cannot write {tmp_path}/file/exam.json: " in err
        and "say --out FILE" in err
    )


# ---- the seam


def test_a_robot_walks_behind_the_seam(contract: Contract) -> None:
    robot = Recorder(MujocoRobot(SHIPPED, contract))
    done = run(
        robot, Controller(SHIPPED, contract), lambda t: AHEAD if t < 3.0 else np.array([9.0, 0, 0]), 3.0, live=False
    )
    assert done.steps == 150 == len(robot.targets) and done.fell is None and robot.closed == 1
    assert done.velocity is not None
    np.testing.assert_allclose(done.velocity, AHEAD, atol=0.08)
    robot.robot.fleet.write(np.tile(contract.default_pose, (1, 1)))  # type: ignore[attr-defined]  # closed: targets move nothing
    assert not robot.robot.read().joint_torque.any()


def test_commands_are_held_within_the_trained_ranges(contract: Contract, monkeypatch: pytest.MonkeyPatch) -> None:
    controller, asked = Controller(SHIPPED, contract), []
    monkeypatch.setattr(
        controller, "act", lambda measured, command: (asked.append(command), contract.default_pose[None])[1]
    )
    run(MujocoRobot(SHIPPED, contract), controller, lambda _: np.array([9.0, -9.0, 0.3]), 0.04, live=False)
    np.testing.assert_array_equal(asked, [[1.5, -0.8, 0.3]] * 2)


def test_a_fall_ends_the_walk(contract: Contract) -> None:
    robot = MujocoRobot(SHIPPED, contract)
    robot.fleet.qpos[0, 3:7] = [0, 1, 0, 0]
    robot.fleet.write(contract.default_pose[None])
    done = run(robot, Controller(SHIPPED, contract), lambda _: AHEAD, 1.0, live=False)
    assert done.fell == 0.0 and done.steps == 0


@pytest.mark.parametrize(
    ("ends", "turned", "down", "falls"),
    [
        ({}, [0, 1, 0, 0], 0.2, False),  # a handstand, or lying: nothing ends it
        ({"max_tilt": 90.0}, [0, 1, 0, 0], 0.2, True),
        ({"max_tilt": 170.0}, [0.17, 0.98, 0, 0], 0.2, False),
        ({"max_tilt": 20.0}, [0.97, 0.24, 0, 0], 0.278, True),
        ({"min_base_height": 0.18}, [1, 0, 0, 0], 0.278, False),
        ({"min_base_height": 0.18}, [1, 0, 0, 0], 0.15, True),
    ],
)
def test_the_contract_states_what_ends_a_walk(
    ends: dict[str, float], turned: list[float], down: float, falls: bool, export: Path
) -> None:
    """For one robot behind the seam, and for the robots of a stage."""
    rewrite(export, put("ends", ends))
    contract = read_contract(export)
    assert contract.to_dict()["ends"] == ends
    robot, stage = MujocoRobot(export, contract), DeployStage(export, 2)
    for fleet in (robot.fleet, stage.fleet):
        fleet.qpos[0, 2], fleet.qpos[0, 3:7] = down, np.array(turned) / np.linalg.norm(turned)
    robot.fleet.refresh()
    assert robot.fleet.fell().tolist() == [falls]
    done = run(robot, Controller(export, contract), lambda _: AHEAD, 0.02, live=False)
    assert done.steps == (0 if falls else 1) and (done.fell == 0.0 if falls else done.fell is None)
    stage.step()
    assert stage.fell().tolist() == [falls, False]


def test_a_state_that_is_not_finite_always_ends(export: Path) -> None:
    rewrite(export, put("ends", {}))
    fleet = Fleet(export, read_contract(export), 2)
    fleet.qvel[1, 0] = np.nan
    fleet.write(np.tile(fleet.contract.default_pose, (2, 1)))
    assert fleet.fell().tolist() == [False, True]


# ---- the controller: what an action means, what it remembers


def controller_of(contract: Contract, **changes: Any) -> tuple[Controller, list[Floats]]:
    """A controller of two robots whose network answers 0.1, 0.2, 0.3 ..., and all that this network saw."""
    saw: list[Floats] = []

    def network(obs: Floats) -> Floats:
        saw.append(np.array(obs))
        return np.full((2, 12), 0.1 * len(saw), dtype=np.float32)

    return Controller(SHIPPED, replace(contract, **changes), 2, network), saw


def measured_at(angles: float, contract: Contract) -> Measurement:
    """Two robots at rest, all joints at one angle [rad]."""
    values = dict.fromkeys(("lin_vel", "ang_vel", "gravity", "acceleration"), np.zeros((2, 3)))
    joints = dict.fromkeys(("joint_pos", "joint_vel", "joint_torque"), np.full((2, 12), angles))
    return Measurement(**values, **joints, foot_contact=np.zeros((2, 4)))


@pytest.mark.parametrize("origin", ["default", "joints", "targets"])
def test_where_a_target_starts_from(origin: str, contract: Contract) -> None:
    scale = np.linspace(0.1, 1.2, 12)
    controller, _ = controller_of(contract, action=contract.action._replace(origin=origin, scale=scale, clip=0.25))
    pose, commands = contract.default_pose, np.zeros((2, 3))
    acts = lambda angle: (controller.act(measured_at(angle, contract), commands), controller.last_targets.copy())[1]  # noqa: E731
    targets = [acts(angle)[0] for angle in (0.5, 0.6, 0.7)]
    starts = {
        "default": [pose] * 3,
        "joints": [0.5, 0.6, 0.7],
        "targets": [pose, pose + 0.1 * scale, pose + 0.3 * scale],
    }[origin]
    for got, start, action in zip(targets, starts, (0.1, 0.2, 0.25), strict=True):  # the third is clipped
        np.testing.assert_allclose(got, start + action * scale, atol=1e-7)
    controller.reset([1])
    after = acts(0.5)
    start = {"default": pose, "joints": 0.5, "targets": pose}[origin]
    np.testing.assert_allclose(after[1], start + 0.25 * scale, atol=1e-7)
    before = {"default": pose, "joints": 0.5, "targets": pose + 0.55 * scale}[origin]
    np.testing.assert_allclose(after[0], before + 0.25 * scale, atol=1e-7)


def test_history_is_oldest_first_and_filled_after_a_reset(contract: Contract) -> None:
    rows = (
        ContractRow("dof_vel", 12, "rad/s", "", 0.0, "joint_vel", scale=(0.5,) * 12, history=3),
        ContractRow("commands", 3, "", "", 0.0, "command"),
        ContractRow("last_actions", 12, "1", "", 0.0, "last_action", history=2),
    )
    controller, saw = controller_of(contract, rows=rows)
    assert controller.contract.size == 36 + 3 + 24
    for angle in (1.0, 2.0, 3.0, 4.0):
        if angle == 4.0:
            controller.reset(np.array([False, True]))
        commands = np.full((2, 3), angle)
        before = controller.observe(measured_at(angle, contract), commands)  # looking changes nothing
        controller.act(measured_at(angle, contract), commands)
        np.testing.assert_array_equal(before, saw[-1])
    frames = [[*obs[0, [0, 12, 24]], obs[0, 36], *obs[0, [39, 51]]] for obs in saw]
    expected = [
        [0.5, 0.5, 0.5, 1, 0, 0],
        [0.5, 0.5, 1, 2, 0, 0.1],
        [0.5, 1, 1.5, 3, 0.1, 0.2],
        [1, 1.5, 2, 4, 0.2, 0.3],
    ]
    np.testing.assert_allclose(frames, expected, atol=1e-7)
    # the robot that was reset
    np.testing.assert_allclose(saw[3][1, [0, 12, 24, 36, 39, 51]], [2, 2, 2, 4, 0, 0], atol=1e-7)


def test_a_robot_without_feet_and_a_task_without_commands(export: Path) -> None:
    def change(entries: Any) -> None:
        entries["robot"]["feet"], entries["commands"] = {}, []
        entries["observation"].pop()
        entries["ends"] = {}
        model = onnx.load(export / "policy.onnx")  # the network takes no commands: it pads them with zeros
        [old] = model.graph.input
        model.graph.initializer.append(onnx.helper.make_tensor("pads", onnx.TensorProto.INT64, [4], [0, 0, 0, 3]))
        model.graph.node.insert(0, onnx.helper.make_node("Pad", ["short", "pads"], [old.name]))
        model.graph.input.insert(0, onnx.helper.make_tensor_value_info("short", onnx.TensorProto.FLOAT, ["batch", 45]))
        model.graph.input.remove(old)
        onnx.save(model, export / "policy.onnx")
        entries["network"] |= {
            "input": "short",
            "sha256": hashlib.sha256((export / "policy.onnx").read_bytes()).hexdigest(),
        }

    rewrite(export, change)
    contract = read_contract(export)
    assert contract.commands == () and contract.feet == {} and contract.ends == Ends()
    assert read_contract(export).to_dict() == contract.to_dict() == load_yaml(export / "policy.yaml")
    stage = DeployStage(export, 2)
    for _ in range(20):
        stage.step()
    assert stage.commands().shape == (2, 0) and stage.contacts().shape == (2, 0) and np.isfinite(stage.qpos()).all()
    np.testing.assert_allclose(stage.velocity()[:, :2], 0.0, atol=0.1)  # it stands
    done = run(MujocoRobot(export, contract), Controller(export, contract), lambda _: np.zeros(0), 0.1, live=False)
    assert done.steps == 5 and done.velocity is not None


def test_targets_that_are_not_finite_close_the_robot(contract: Contract, monkeypatch: pytest.MonkeyPatch) -> None:
    robot, controller = Recorder(MujocoRobot(SHIPPED, contract)), Controller(SHIPPED, contract)
    monkeypatch.setattr(controller, "_network", lambda obs: np.full((1, 12), np.nan, dtype=np.float32))
    with pytest.raises(RobotError, match="the target of FR_hip_joint is not finite: nan; the joints are damped"):
        run(robot, controller, lambda _: AHEAD, 1.0, live=False)
    assert robot.closed == 1 and not robot.targets


def test_live_keeps_time(contract: Contract, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a made-up clock: it sleeps until each deadline, and counts a step that begins late."""
    clock, written = [0.0], []

    def sleep(seconds: float) -> None:
        clock[0] += seconds

    class Slow(MujocoRobot):
        def write(self, targets: Floats, **_: Any) -> None:
            written.append(clock[0])
            clock[0] += 0.055 if len(written) == 3 else 0.005

    monkeypatch.setattr("time.perf_counter", lambda: clock[0])
    monkeypatch.setattr("time.sleep", sleep)
    safety = Safety(contract, Limits.of(SHIPPED, contract, {"frozen": "off"}))  # nothing moves this robot
    done = run(Slow(SHIPPED, contract), Controller(SHIPPED, contract), lambda _: AHEAD, 0.2, safety=safety)
    # what was lost is not made up for
    assert done.steps == 9 and done.late == 1 and done.timing and done.timing.lost == 1
    # and the deadlines stay where they were
    np.testing.assert_allclose(written[:6], [0, 0.02, 0.04, 0.095, 0.1, 0.12], atol=1e-9)


# ---- where torch is not installed

BLOCKED = """
import sys

class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in {'torch', 'warp', 'mujoco_warp', 'rsl_rl', 'tensordict', 'onnx', 'onnxscript', 'tensorboard'}:
            raise ModuleNotFoundError(f'{name} is blocked', name=name)

sys.meta_path.insert(0, Block())
from legged_mw.eval import walking
walking.EXAM_SECONDS, walking.PUSH_AT, walking.PUSH_UNTIL = 2.1, 0.5, 1.5
import runpy
sys.argv = ['deploy', *sys.argv[1:]]
runpy.run_module('legged_mw.deploy', run_name='__main__')
"""


def test_needs_neither_torch_nor_warp(tmp_path: Path) -> None:
    args = [sys.executable, "-c", BLOCKED, str(SHIPPED), "--eval", "--no_hard", "--out", str(tmp_path / "exam.json")]
    done = subprocess.run(args, cwd=ROOT, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stderr
    assert "falls in 22 commands                     0" in done.stdout and (tmp_path / "exam.json").is_file()


def test_the_scene_is_read_by_plain_mujoco(contract: Contract) -> None:
    """One file, no other; and it is where the contract's sensors and start are."""
    model = mujoco.MjModel.from_xml_path(str(SHIPPED / "scene.xml"))
    assert model.key(0).name == "home" and model.key(0).qpos[2] == 0.278
    scene = read_scene(SHIPPED, contract)
    assert sorted(np.concatenate([*scene.sensordata.values(), *scene.contacts]).tolist()) == sorted(
        i
        for i in range(model.nsensordata)
        if not 4 <= i < 16  # the feet's velocities, which no contract names
    )
