"""legged_mw.deploy on a policy that sees the ground: its contract, and the same scan as in the environment."""

from __future__ import annotations

import shutil
import zipfile
from contextlib import suppress
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from worlds import QUIET, make_env

from legged_mw import ROOT
from legged_mw.deploy.contract import TERRAIN_FILE, Contract, ContractError, read_contract, sealed
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.simulated import Fleet, MujocoRobot
from legged_mw.deploy.stage import DeployStage
from legged_mw.robot.mjcf import XmlSource, write_archive
from legged_mw.utils.config import load_yaml, save_yaml
from legged_mw.utils.files import digest

SHIPPED = ROOT / "resources/policies/go1_rough_scan"


@pytest.fixture
def export(tmp_path: Path) -> Path:
    """A copy to be changed."""
    for name in ("policy.yaml", "policy.onnx", "scene.xml", TERRAIN_FILE):
        shutil.copy(SHIPPED / name, tmp_path)
    return tmp_path


def seal(folder: Path) -> Contract:
    """The contract of a copy whose scenes were changed, as an export of those."""
    said = load_yaml(folder / "policy.yaml")
    said["physics"] |= {"sha256": digest(folder / "scene.xml")}
    said["physics"]["terrain"]["sha256"] = digest(folder / TERRAIN_FILE)
    save_yaml(folder / "policy.yaml", sealed(said))
    return read_contract(folder)


def test_the_contract_says_where_the_scan_looks() -> None:
    contract = read_contract(SHIPPED)
    row = contract.rows[-1]
    assert (row.name, row.size, row.measured, row.noise) == ("height_scan", 187, "height_scan", 0.1)
    assert contract.scan and (len(contract.scan.x), len(contract.scan.y), contract.scan.standing) == (17, 11, 0.278)
    assert contract.to_dict()["height_scan"] == load_yaml(SHIPPED / "policy.yaml")["height_scan"]
    assert read_contract(ROOT / "resources/policies/go1_rough").scan is None


def test_the_scan_is_the_environments(export: Path) -> None:
    """Turned and tilted robots at other heights than standing, over a block that only one of them is near."""
    env = make_env(4, {**QUIET, "terrain.mesh_type": "plane", "domain_rand.enable": False}, task="go1_rough_scan")
    fleet = Fleet(export, read_contract(export), 4)
    fleet.qpos[:, :3] = [[0.0, 0.0, 0.3], [5.0, -3.0, 0.2], [1.0, 1.0, 2.0], [-2.0, 0.0, 0.278]]
    fleet.qpos[:, 3:7] = [[1, 0, 0, 0], [0.9, 0.1, 0.1, 0.4], [0.5, 0.5, 0.5, 0.5], [0, 0, 0, 1]]
    fleet.qpos[:, 3:7] /= np.linalg.norm(fleet.qpos[:, 3:7], axis=1, keepdims=True)
    env.sim.qpos.copy_(torch.tensor(fleet.qpos, dtype=torch.float))
    env.compute_observations()
    np.testing.assert_allclose(fleet.read().others["height_scan"], env.obs_buf["state"][:, -187:], atol=1e-5)
    spec = mujoco.MjSpec.from_file(str(export / "scene.xml"))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.5, 0.25, 0.05], pos=[0.6, 0.25, 0.05])
    (export / "scene.xml").write_text(spec.to_xml())
    block = Fleet(export, seal(export), 1)
    block.qpos[0, :3] = [0.0, 0.0, 0.278]
    scan = block.read().others["height_scan"].reshape(17, 11)
    assert np.allclose(scan[9:, 6:], -0.1) and np.allclose(scan[:9], 0.0) and np.allclose(scan[:, :5], 0.0), (
        "ahead and to the left"
    )


def test_where_there_is_no_ground_it_is_deep(export: Path) -> None:
    spec = mujoco.MjSpec.from_file(str(export / "scene.xml"))
    spec.geom("floor").size = [0.3, 0.3, 0.05]
    (export / "scene.xml").write_text(spec.to_xml())
    scan = Fleet(export, seal(export), 1).read().others["height_scan"].reshape(17, 11)
    assert np.allclose(scan[8, 5], 0.0, atol=1e-6) and np.allclose(scan[0], 1.0) and np.allclose(scan[:, 0], 1.0)


def test_it_walks_behind_the_seam() -> None:
    stage = DeployStage(SHIPPED, 2, command=(0.6, 0.0, 0.0))
    for _ in range(150):
        stage.step()
    np.testing.assert_allclose(stage.velocity(), [[0.6, 0.0, 0.0]] * 2, atol=0.12)
    contract = read_contract(SHIPPED)
    robot, controller = MujocoRobot(SHIPPED, contract), Controller(SHIPPED, contract)
    measured = robot.read()
    assert measured.others["height_scan"].shape == (187,) and controller.act(measured, np.zeros((1, 3))).shape == (
        1,
        12,
    )


def test_among_steps_it_stands_on_boxes_and_sees_them() -> None:
    contract = read_contract(SHIPPED)
    fleet = Fleet(SHIPPED, contract, 1, scene_file=TERRAIN_FILE)
    start = fleet.qpos[0].copy()
    scan = fleet.read().others["height_scan"].reshape(17, 11)
    assert np.abs(scan).max() < 1e-6 and start[2] < 0.0, "the middle of a pit, flat for 1 m"
    controller = Controller(SHIPPED, contract)
    for _ in range(300):
        fleet.write(controller.act(fleet.read(), np.array([[0.6, 0.0, 0.0]])))
    measured = fleet.read()
    assert not fleet.fell()[0] and fleet.qpos[0, 2] > start[2] + 0.15, "it climbs"
    assert measured.others["height_scan"].min() < -0.03


@pytest.mark.parametrize("task", ["go1_rough", "go1_rough_scan"])
def test_around_the_steps_the_ground_goes_on(task: str) -> None:
    # an MJZ, as MuJoCo reads it
    model = mujoco.MjSpec.from_file(str(ROOT / "resources/policies" / task / TERRAIN_FILE)).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for x, y in ((15.9, 0.0), (16.1, 3.0), (-500.0, 0.0), (0.0, 900.0), (300.0, -300.0)):
        hit = mujoco.mj_ray(
            model,
            data,
            np.array([x, y, 5.0]),
            np.array([0.0, 0.0, -1.0]),
            None,
            1,
            -1,
            np.zeros(1, dtype=np.int32),
            None,
        )
        assert hit == pytest.approx(5.0), (x, y)


@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        (
            'gainprm="35"',
            'gainprm="36"',
            r"policy.yaml: stiffness is \[35\..*, but terrain.mjz has \[36\..*; change both, or export the policy again",
        ),
        ('name="gyro/imu"', 'name="gyro"', "no sensor 'gyro/imu' in terrain.mjz; "),
        (
            '<gyro site="imu" ',
            '<framequat objtype="site" objname="imu" ',
            r"terrain.mjz: the sensors of 'ang_vel' .* have 4 values, not 3",
        ),
    ],
)
def test_what_is_wrong_with_terrain_is_not_said_of_the_scene(
    right: str, wrong: str, message: str, export: Path
) -> None:
    text = XmlSource(SHIPPED / TERRAIN_FILE).text
    assert right in text
    write_archive(export / TERRAIN_FILE, text.replace(right, wrong))
    seal(export)
    with pytest.raises(ContractError, match=message) as raised:
        DeployStage(export, 1, scene_file=TERRAIN_FILE)
    assert "scene.xml" not in str(raised.value)
    DeployStage(export, 1)


def test_an_archive_holds_one_model(tmp_path: Path) -> None:
    file = tmp_path / "terrain.mjz"
    write_archive(file, "<mujoco/>")
    first = file.read_bytes()
    write_archive(file, "<mujoco/>")
    assert file.read_bytes() == first and XmlSource(file, alone=True).text == "<mujoco />"


def test_a_broken_archive_is_one_line(tmp_path: Path) -> None:
    file = tmp_path / "terrain.mjz"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("model.xml", "<mujoco/>")
    whole = file.read_bytes()
    encrypted = bytearray(whole)
    encrypted[6] |= 1
    encrypted[whole.index(b"PK\x01\x02") + 8] |= 1
    broken = [b"", b"PK", whole[:-30], whole[:60] + bytes(len(whole) - 60), bytes(encrypted)]
    broken += [whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :] for at in range(len(whole))]
    for content in broken:
        file.write_bytes(content)
        with suppress(ValueError):  # a byte of a date is no harm
            assert XmlSource(file).text == "<mujoco />"
    for content in broken[:5]:
        file.write_bytes(content)
        with pytest.raises(ValueError, match="no zip file that can be read: "):
            XmlSource(file)
