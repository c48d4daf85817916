"""Leg odometry: what a leg says of the body's velocity, against MuJoCo; a walk on the estimate; who may ask for it."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from legged_mw import ROOT
from legged_mw.deploy import __main__ as program
from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.exam import contract_rules, run_exam
from legged_mw.deploy.odometry import CONTACTS, Legs, Odometry
from legged_mw.deploy.robot import QUANTITIES, Measurement
from legged_mw.deploy.runner import run
from legged_mw.deploy.simulated import MujocoRobot, read_scene
from legged_mw.deploy.stage import DeployStage
from legged_mw.unitree.client import check_rows
from legged_mw.unitree.robots import G1, GO2

POLICIES = ROOT / "resources/policies"
GO1 = POLICIES / "go1_flat"


@pytest.mark.parametrize("name", ["go1_flat", "g1_flat"])
def test_the_velocity_that_a_leg_tells_is_that_of_a_foot_which_stands(name: str) -> None:
    """Any pose, any speed: the IMU's velocity is what a leg tells plus the velocity of the foot's lowest point, in the IMU's frame."""
    contract, rng = read_contract(POLICIES / name), np.random.default_rng(1)
    scene = read_scene(POLICIES / name, contract)
    model, data = scene.model, mujoco.MjData(scene.model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[3:7] = rng.normal(size=4)
    data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    data.qpos[7:] += rng.uniform(-0.2, 0.2, len(contract.joints))
    data.qvel[:] = rng.normal(size=model.nv)
    data.ctrl[:] = data.qpos[[int(model.joint(each).qposadr[0]) for each in contract.joints]]
    mujoco.mj_forward(model, data)
    sensed = {quantity: data.sensordata[places] for quantity, places in scene.sensordata.items()}
    sensed |= {"gravity": -sensed["up"], "foot_contact": np.zeros(len(contract.feet))}
    measured = Measurement(**{name: sensed[name] for name in QUANTITIES})
    legs = Odometry(POLICIES / name, contract).legs(measured)
    turn = data.site(contract.imu).xmat.reshape(3, 3)
    for i, sensors in enumerate(contract.feet.values()):
        geoms, jacobian = [int(model.sensor(each).objid[0]) for each in sensors], np.zeros((3, model.nv))
        point = data.site(contract.imu).xpos + turn @ legs.place[0, i]
        mujoco.mj_jac(model, data, jacobian, None, point, model.geom_bodyid[geoms[0]])
        told = measured.lin_vel - turn.T @ jacobian @ data.qvel
        assert np.allclose(legs.velocity[0, i], told, atol=1e-9)
        bottom = min(data.geom_xpos[geom, 2] - model.geom_size[geom, 0] for geom in geoms)
        assert bottom - 0.09 <= point[2] <= bottom + 1e-9  # a capsule of a G1's foot is 0.0835 m long each way


def test_the_force_of_a_leg_is_its_share_of_the_weight() -> None:
    """A Go1 that stands presses down with what it weighs."""
    contract = read_contract(GO1)
    robot = MujocoRobot(GO1, contract)
    for _ in range(60):
        robot.write(contract.default_pose)
    legs = Odometry(GO1, contract).legs(robot.read())
    assert legs.force.sum() == pytest.approx(9.81 * contract.mass, rel=0.1) and legs.force.min() > 15.0


@pytest.mark.parametrize(
    ("contact", "stand"),
    [("measured", [1, 0, 0, 1]), ("torque", [1, 0, 1, 0]), ("height", [1, 1, 0, 0])],
)
def test_which_feet_stand(contact: str, stand: list[int]) -> None:
    """By the sensor; from a tenth of the weight on; within 1 cm of the lowest."""
    contract = read_contract(GO1)
    force, depth = 9.81 * contract.mass * np.array([[0.2, 0.09, 0.11, 0.0]]), [0.30, 0.295, 0.285, 0.2]
    legs = Legs(np.outer(depth, [0.0, 0.0, -1.0])[None], np.zeros((1, 4, 3)), force)
    measured = replace(
        MujocoRobot(GO1, contract).read(), gravity=np.array([0.0, 0.0, -1.0]), foot_contact=np.array([1.0, 0, 0, 1])
    )
    assert Odometry(GO1, contract, contact=contact).stands(measured, legs).astype(int).tolist() == [stand]


def test_two_steps_of_the_filter_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two feet stand, of which one disagrees by 0.48 m/s and counts less; then none stands, and the body turns."""
    odometry = Odometry(GO1, read_contract(GO1))
    told = np.zeros((1, 4, 3))
    told[0, :, 0] = [0.5, 0.02, 9.0, 9.0]
    monkeypatch.setattr(odometry, "legs", lambda _: Legs(np.zeros((1, 4, 3)), told, np.zeros((1, 4))))
    still = MujocoRobot(GO1, odometry.contract).read()
    rest = {"ang_vel": np.array([0.0, 0.0, 1.0]), "gravity": np.array([0.0, 0.0, -1.0])}
    felt, then = np.array([1.0, 0.0, 9.81]), np.array([3.0, 0.0, 9.81])
    first = odometry(replace(still, **rest, acceleration=felt, foot_contact=np.array([1.0, 1.0, 0.0, 0.0])))
    # prediction 0.02 m/s of variance 0.5^2 + 0.08^2; noises 0.04 (1 + 0.48^2 / 0.5064) and 0.04
    assert first.lin_vel == pytest.approx([0.198974, 0.0, 0.0], abs=1e-6)
    second = odometry(replace(still, **rest, acceleration=then, foot_contact=np.zeros(4)))
    # (1 + 3) / 2 m/s^2 for 0.02 s, and the turn of the frame
    assert second.lin_vel == pytest.approx([0.198974 + 0.04, -0.02 * 0.198974, 0.0], abs=1e-6)
    assert odometry._variance == pytest.approx([1 / 46.0826 + 0.08**2], rel=1e-5)


@pytest.mark.parametrize("contact", CONTACTS)
def test_a_walk_on_the_estimate(contact: str) -> None:
    """Six commands at once, three seconds: nobody falls, the estimate is right, and what is asked is what is done."""
    wanted = np.array([[0.8, 0, 0], [-0.8, 0, 0], [0, 0.5, 0], [0, 0, 1.0], [1.2, 0, 0.5], [0, 0, 0]])
    stage = DeployStage(GO1, len(wanted), contact=contact)
    missed, done = [], []
    for step in range(150):
        truth = stage.velocity()
        stage.step(wanted)
        assert not stage.fell().any()
        estimate = stage.believed_velocity()
        assert estimate is not None
        if step >= 75:
            missed.append(estimate - truth[:, :2])
            done.append(truth)
    assert 0.005 < np.sqrt(np.mean(np.square(missed))) < 0.06
    assert np.abs(np.mean(done, axis=0) - wanted).max() < 0.12
    stage.reset(2)
    assert stage.odometry and (stage.odometry.velocity[2] == 0).all() and stage.odometry.velocity[0, 0] > 0.5


def test_a_run_sees_the_estimate_and_one_robot_is_as_many() -> None:
    contract = read_contract(GO1)
    robot, other, seen = MujocoRobot(GO1, contract), Odometry(GO1, contract, 3, "torque"), []

    def watch(_now: float, measured: Measurement) -> None:
        three: dict[str, Any] = {name: np.tile(getattr(measured, name), (3, 1)) for name in QUANTITIES}
        seen.append((measured.lin_vel, robot.fleet.read().lin_vel[0], other(Measurement(**three)).lin_vel))

    policy = Controller(GO1, contract)
    run(
        robot,
        policy,
        lambda _: np.array([0.8, 0, 0]),
        1.5,
        live=False,
        watch=watch,
        odometry=Odometry(GO1, contract, 1, "torque"),
    )
    estimates, _, threefold = (np.array(each) for each in zip(*seen, strict=True))
    assert np.allclose(threefold, estimates[:, None]) and estimates[-20:, 0].mean() == pytest.approx(0.8, abs=0.1)
    assert np.allclose(policy.last_observation[0, :3], estimates[-1], atol=1e-6)


def test_what_is_not_finite_is_handed_on_and_forgotten() -> None:
    contract = read_contract(GO1)
    robot, odometry = MujocoRobot(GO1, contract), Odometry(GO1, contract)
    measured = robot.read()
    assert not np.isfinite(odometry(replace(measured, acceleration=np.array([np.nan, 0.0, 9.81]))).lin_vel).any()
    assert np.abs(odometry(measured).lin_vel).max() < 0.2


def test_the_exam_says_how_far_the_estimate_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rules = replace(contract_rules(read_contract(GO1)), push_speeds=(2.0,))
    monkeypatch.setattr("legged_mw.eval.walking.EXAM_SECONDS", 3.0)
    monkeypatch.setattr(
        "legged_mw.deploy.exam.run_exam", lambda folder, _, contact, *__: run_exam(folder, rules, contact)
    )
    monkeypatch.setattr(
        sys,
        "argv",
        ["deploy", str(GO1), "--eval", "--no_hard", "--velocity", "odometry", "--out", str(tmp_path / "exam.json")],
    )
    program.main()
    assert "estimate of vx, rms [m/s]            0.0" in capsys.readouterr().out
    assert '"velocity": "odometry, contact by measured"' in (tmp_path / "exam.json").read_text()


def test_a_robot_that_gives_no_velocity_has_odometry() -> None:
    for machine in (GO2, G1):
        check_rows(read_contract(GO1), machine, odometry=True)
