"""deploy --scene: an export in an MJCF of another's, with other motors, other names and no sensors."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from legged_mw import ROOT
from legged_mw.deploy import __main__ as program
from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.exam import contract_rules, run_exam
from legged_mw.deploy.hard_exam import apply_conditions, look
from legged_mw.deploy.stage import DeployStage
from legged_mw.deploy.user_scene import fit, torque_limits
from legged_mw.eval import hard, walking
from legged_mw.utils.errors import UserError
from legged_mw.view.posed_robot import lowest_point

GO2 = ROOT / "resources/policies/go2_flat"
NAMES = [condition.name for condition in hard.CONDITIONS]
Change = Callable[[ElementTree.Element], None]


def vendors(folder: Path, change: Change = lambda _: None) -> Path:
    """A Go2 as a vendor's: torque motors by other names, joints in another order, its own frictions, no sensor."""
    root = ElementTree.parse(GO2 / "scene.xml").getroot()
    for name in ("actuator", "sensor", "keyframe", "size"):
        for element in root.findall(name):
            root.remove(element)
    root.find("option").attrib = {"timestep": "0.002"}  # type: ignore[union-attr]
    for joint in root.iter("joint"):
        if "damping" in joint.attrib:
            joint.attrib |= {"damping": "0.1"}
            joint.attrib.pop("actuatorfrcrange", None)
    base = next(body for body in root.iter("body") if body.get("name") == "base")
    for site in [site for site in base if site.tag == "site"]:
        base.remove(site)
    legs = [body for body in base if body.tag == "body"]
    for leg in legs:
        base.remove(leg)
    base.extend(legs[2:] + legs[:2])
    motors = ElementTree.SubElement(root, "actuator")
    for joint in read_contract(GO2).joints:
        high = "45" if "calf" in joint else "23"
        ElementTree.SubElement(
            motors,
            "motor",
            {"name": f"m_{joint}", "joint": joint, "ctrlrange": f"-{high} {high}", "ctrllimited": "true"},
        )
    poses = ElementTree.SubElement(root, "keyframe")
    ElementTree.SubElement(poses, "key", {"name": "home", "ctrl": " ".join(["0"] * 12)})
    change(root)
    file = folder / "vendor.xml"
    ElementTree.ElementTree(root).write(file)
    return file


def test_it_walks_there_as_at_home(tmp_path: Path) -> None:
    stage = DeployStage(GO2, 4, scene_file=vendors(tmp_path))
    model, contract = stage.fleet.model, stage.contract
    assert contract.timestep == 0.002 and contract.decimation == 10 and contract.period == 0.02
    servo = model.actuator("RL_calf_joint").id
    gain = contract.stiffness[contract.joints.index("RL_calf_joint")]
    assert model.actuator_gainprm[servo, 0] == gain and model.actuator_biasprm[servo, 1] == -gain
    assert model.actuator_forcerange[servo].tolist() == [-45.0, 45.0] and model.nu == 12
    assert model.actuator_biasprm[servo, 2] == -contract.damping[0] and not stage.fleet.damps_by_joint
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert model.dof_damping[stage.fleet._dofs].ravel() == pytest.approx(0.1)
    assert all(len(sensors) == 1 for sensors in contract.feet.values())
    command = np.tile([1.0, 0.0, 0.0], (4, 1))
    speeds = []
    for step in range(150):
        stage.step(command)
        assert not stage.fell().any()
        speeds += [stage.velocity()[:, 0]] if step >= 75 else []
    assert np.mean(speeds) == pytest.approx(1.0, abs=0.06)


def test_its_conditions_and_its_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, contract = vendors(tmp_path), read_contract(GO2)
    stage = DeployStage(GO2, len(NAMES), scene_file=file)
    apply_conditions(stage, np.arange(len(NAMES)), 3.0)
    soft, servo = stage.fleet._batch.get_model(NAMES.index("gains x 0.8")), stage.fleet._actuators[0]
    assert soft.actuator_biasprm[servo, 1:3] == pytest.approx(
        -0.8 * np.array([contract.stiffness[0], contract.damping[0]])
    )
    assert soft.dof_damping[stage.fleet._dofs].ravel() == pytest.approx(0.1)  # the joints' own
    monkeypatch.setattr("legged_mw.deploy.hard_exam.LOOK_SECONDS", 4.0)
    walk, _ = look(partial(DeployStage, GO2, scene_file=file), contract, contract_rules(contract, common=True))
    assert walk and walk.limit.tolist() == [23.0, 23.0, 45.0] * 4
    found = hard.looks(walk)
    assert walk.force.sum(axis=1).mean() / walk.weight == pytest.approx(1.0, abs=0.06)
    assert 1.9 < found["strides"] < 3.0 and found["sole_tilt"] is None


def test_joints_without_a_limit_get_the_exports(tmp_path: Path) -> None:
    """Neither a motor nor the joint states one, but for a calf whose joint does."""

    def without_motors(root: ElementTree.Element) -> None:
        for name in ("actuator", "keyframe"):
            for element in root.findall(name):
                root.remove(element)
        calf = next(joint for joint in root.iter("joint") if joint.get("name") == "FL_calf_joint")
        calf.attrib |= {"actuatorfrcrange": "-90 90", "actuatorfrclimited": "true"}

    contract = read_contract(GO2)
    model = fit(vendors(tmp_path, without_motors), GO2, contract)[0].compile()
    own = mujoco.MjModel.from_xml_path(str(GO2 / "scene.xml"))
    found, exported = (torque_limits(each, [each.joint(name).id for name in contract.joints]) for each in (model, own))
    calf = contract.joints.index("FL_calf_joint")
    assert found[calf] == 90.0 and np.isfinite(exported).all()
    assert np.delete(found, calf).tolist() == np.delete(exported, calf).tolist()


def test_a_motors_rotor_stays_and_its_defaults_go(tmp_path: Path) -> None:
    def geared(root: ElementTree.Element) -> None:
        default = ElementTree.SubElement(root, "default")
        ElementTree.SubElement(default, "motor", {"damping": "0.5", "delay": "0.01", "nsample": "3"})
        for motor in root.iter("motor"):
            motor.attrib |= {"armature": "0.001", "gear": "2"}

    plain, changed = (
        DeployStage(GO2, 1, scene_file=vendors(tmp_path, each)).fleet for each in (lambda _: None, geared)
    )
    more = changed.model.dof_armature[changed._dofs] - plain.model.dof_armature[plain._dofs]
    assert more.ravel() == pytest.approx(0.004)
    for name in ("armature", "damping", "delay"):
        assert not getattr(changed.model, f"actuator_{name}").any()


def test_a_scene_without_a_ground_gets_one(tmp_path: Path) -> None:
    def bare(root: ElementTree.Element) -> None:
        for world in root.findall("worldbody"):
            for geom in world.findall("geom"):
                world.remove(geom)

    spec, _ = fit(vendors(tmp_path, bare), GO2, read_contract(GO2))
    model = spec.compile()
    assert [model.geom(i).type[0] for i in np.flatnonzero(model.geom_bodyid == 0)] == [mujoco.mjtGeom.mjGEOM_PLANE]
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_kinematics(model, data)
    feet = [i for i in range(model.ngeom) if model.geom_conaffinity[i] and model.geom_bodyid[i]]
    assert min(lowest_point(model, data, geom) for geom in feet) == pytest.approx(0.0, abs=1e-6)


def renamed(root: ElementTree.Element) -> None:
    for element in root.iter():
        for key, value in element.attrib.items():
            element.set(key, value.replace("FL_calf_joint", "FL_knee_joint"))


def with_a_tail(root: ElementTree.Element) -> None:
    base = next(body for body in root.iter("body") if body.get("name") == "base")
    tail = ElementTree.SubElement(base, "body", {"name": "tail"})
    ElementTree.SubElement(tail, "joint", {"name": "tail_joint"})
    ElementTree.SubElement(tail, "geom", {"size": "0.02"})


def with_a_ball(root: ElementTree.Element) -> None:
    ball = ElementTree.SubElement(root.findall("worldbody")[0], "body", {"name": "ball", "pos": "2 0 1"})
    ElementTree.SubElement(ball, "freejoint", {})
    ElementTree.SubElement(ball, "geom", {"size": "0.1"})


def with_time(step: str) -> Change:
    return lambda root: root.find("option").set("timestep", step)  # type: ignore[union-attr]


def with_include(name: str) -> Change:
    def change(root: ElementTree.Element) -> None:
        ElementTree.SubElement(root, "include", {"file": name})

    return change


def without_feet(root: ElementTree.Element) -> None:
    for calf in [body for body in root.iter("body") if body.get("name") == "FL_calf"]:
        for body in calf.iter("body"):
            for geom in body.findall("geom"):
                body.remove(geom)


# each is refused in the line that tests/golden/errors.txt has
WRONG: dict[str, Change] = {
    "a joint of another name": renamed,
    "a joint more": with_a_tail,
    "a second free body": with_a_ball,
    "a time step that is no share of the period": with_time("0.003"),
    "a time step above the period": with_time("0.05"),
    "a file above": with_include("../secret.xml"),
    "a file elsewhere": with_include("/etc/passwd"),
    "a size of NaN": lambda root: root.iter("geom").__next__().set("size", "nan"),
    "no foot": without_feet,
}
NO_SCENES = {
    "an empty file": "",
    "no XML": "no xml",
    "a URDF": "<robot name='a'/>",
    "a DOCTYPE": "<!DOCTYPE a><mujoco/>",
    "nothing in it": "<mujoco/>",
}


@pytest.mark.parametrize("change", WRONG.values(), ids=WRONG)
def test_a_scene_that_does_not_fit(change: Change, tmp_path: Path) -> None:
    with pytest.raises(UserError):
        fit(vendors(tmp_path, change), GO2, read_contract(GO2))


def test_what_is_no_scene(tmp_path: Path) -> None:
    for file in (tmp_path, tmp_path / "none.xml"):
        with pytest.raises(UserError):
            fit(file, GO2, read_contract(GO2))
    os.mkfifo(tmp_path / "pipe.xml")
    with pytest.raises(UserError):
        fit(tmp_path / "pipe.xml", GO2, read_contract(GO2))


def test_from_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(walking, "EXAM_SECONDS", 2.6)
    monkeypatch.setattr(walking, "PUSH_AT", 1.0)
    monkeypatch.setattr(walking, "PUSH_UNTIL", 2.2)
    monkeypatch.chdir(tmp_path)
    vendors(tmp_path)
    monkeypatch.setattr(sys, "argv", ["deploy", "go2_flat", "--scene", "vendor.xml", "--eval", "--no_hard"])
    program.main()
    saved = json.loads((tmp_path / "logs/go2_flat/shipped/exam_vendor.json").read_text())
    assert saved["scene"] == "vendor.xml" and saved["falls"] == 0 and saved["pushes"]["2"] > 0.8
    assert saved["error"] != run_exam(GO2)["error"] and "falls in 22 commands" in capsys.readouterr().out
