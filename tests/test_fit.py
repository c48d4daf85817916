"""The fit: what it finds of a simulated robot whose numbers were changed, what it writes, and the logs that it refuses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from drivers import Script

from benchmarks.fit import Change, ChangedUnitree
from legged_mw.deploy import chirp, fit
from legged_mw.deploy.chirp import Chirp, at_rate
from legged_mw.deploy.contract import Contract, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.joint_check import LIFT, Moves
from legged_mw.deploy.log import DriveLog, Log, LogError, read_log
from legged_mw.deploy.other_root import between, motion_of, with_root
from legged_mw.deploy.robot import Floats, Measurement, RobotError
from legged_mw.deploy.runner import run
from legged_mw.deploy.safety import Limits, Safety
from legged_mw.deploy.simulated import MujocoRobot, read_scene
from legged_mw.deploy.states import CHIRP
from legged_mw.unitree.client import STEP, UnitreeRobot
from legged_mw.unitree.link import Received
from legged_mw.utils.errors import UserError
from legged_mw.utils.task import load_task
from tests.wires import POLICIES

GO2 = POLICIES / "go2_flat"
CONTRACT = read_contract(GO2)
CALF, OTHER = "FL_calf_joint", "FR_calf_joint"
JOINT = CONTRACT.joints.index(CALF)
SWEEP = 3.0  # [s]
EVEN = np.ones(12)
CHANGE = Change(0.006 * EVEN, 0.052 * EVEN, 0.6 * EVEN, 0.35 * EVEN, 0.9 * EVEN, 0.01 * EVEN)


class Lockstep:
    """Both ends of a wire in memory: each command lets the robot make one step."""

    def __init__(self, folder: Path, contract: Contract, change: Change) -> None:
        self.state, self.command = b"", b""
        self.sim: ChangedUnitree = ChangedUnitree(folder, contract, self._end(), change, hoist=True, lift=LIFT)
        self.sim.step()

    def _end(self) -> Any:
        owner = self

        class End:
            def send(self, body: bytes) -> None:
                owner.state = bytes(body)

            def receive(self) -> bytes | None:
                return owner.command or None

            def answer(self) -> None: ...

        return End()

    def receive(self) -> Received:
        return Received(self.state, self.sim.time)

    def arm(self, damping: bytes) -> None: ...

    def send(self, body: bytes, stamp: float, safe: bool) -> None:
        self.command = bytes(body)
        self.sim.step()

    def close(self, last: bytes) -> str:
        return ""


class OneSlot(Chirp):
    """The sweeps of one slot: that of the joint ``swept``."""

    swept, together = CALF, {CALF, OTHER, "RL_calf_joint", "RR_calf_joint"}

    def _check(self, measured: Measurement) -> Moves:
        self.state = CHIRP
        for _ in range(100):
            yield self._order(self.plan.pose)
        names = self.controller.contract.joints
        (slot,) = (slot for slot in self.plan.slots if names.index(self.swept) in slot)
        assert {names[joint] for joint in slot} == self.together
        yield from self._sweep(slot)


class WaistSlot(OneSlot):
    swept = "waist_yaw_joint"
    together = {
        *("left_hip_pitch_joint", "right_hip_pitch_joint", "waist_yaw_joint"),
        *("left_shoulder_pitch_joint", "right_shoulder_pitch_joint"),
    }


def record(path: Path, folder: Path, change: Change, slots: int, chirps: type[OneSlot]) -> Path:
    """The log of one of ``slots`` slots, of SWEEP s."""
    own = read_contract(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chirp, "SECONDS", slots * (SWEEP + 2 * chirp.REST))
        wire = Lockstep(folder, own, change)
        robot = UnitreeRobot(own, wire, wire.receive(), simulated=True, clock=lambda: wire.sim.time)
        contract, limits = at_rate(own, Limits.of(folder, own, robot.limits), robot)
        controller = Controller(folder, contract)
        states = chirps(controller, [Script({1: "start"})], lambda _: None, robot, limits)
        safety, written = Safety(contract, limits), Log(path, contract, folder, "simulated")
        done = run(robot, controller, lambda _: np.zeros(0), 9.0, live=False, safety=safety, states=states, log=written)
        assert not done.trips and states.over
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a Go2's calves, one of three slots."""
    return record(tmp_path_factory.mktemp("fit") / "one.lmwlog", GO2, CHANGE, 3, OneSlot)


def test_a_waist_that_carries_what_the_imu_is_on_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A G1 that hangs by its torso: the yaw's gain within 3 %, friction within 20 %, the delay within 2 ms of 6 and 2."""
    monkeypatch.setattr(fit, "TRIES", 8)
    even = np.ones(29)
    change = Change(0.006 * even, 0.03 * even, 0.6 * even, 0.3 * even, 0.9 * even, 0.01 * even)
    (waist,) = fit.fit_log(
        record(tmp_path / "g1.lmwlog", POLICIES / "g1_flat", change, 7, WaistSlot), ["waist_yaw_joint"]
    ).joints
    assert waist.after < 0.002 < 0.01 < waist.before and waist.values[fit.DELAY] == pytest.approx(8.0, abs=2.0)
    assert waist.values[fit.GAIN] == pytest.approx(0.9, rel=0.03)
    assert waist.values[fit.FRICTION] == pytest.approx(0.6, rel=0.2)


def test_the_numbers_of_a_changed_robot_are_found(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Armature, friction, damping and gain within 10 %, the delay within 2 ms of its 6 and the wire's 2, of two limbs."""
    monkeypatch.setattr(fit, "TRIES", 16)
    found = fit.fit_log(log, [CALF, OTHER])
    for calf in found.joints:
        true = CHANGE.table()[calf.joint]
        assert calf.after < 0.0015 < 0.02 < calf.before
        assert np.abs(calf.values / true - 1.0)[fit.ARMATURE : fit.OFFSET].max() < 0.1
        assert abs(calf.values[fit.DELAY] - 8.0) < 2.0
        assert (calf.deviation < 0.1 * np.maximum(true, 0.1))[: fit.OFFSET].all()
        assert calf.deviation[fit.OFFSET] < 1.05 * fit.EXPECTED[1]  # a motion shows little more than what is expected
    assert {CONTRACT.joints[calf.joint] for calf in found.joints} == {CALF, OTHER}
    assert CALF in fit.table(found)
    fields, task = fit.overrides(found), load_task("go2_flat")
    task.update(fields, where="the fit")
    (armature,) = {*task.cfg.asset.armature.values()}
    assert armature == pytest.approx(0.052, rel=0.1)
    assert task.cfg.domain_rand.stiffness[0] < 0.92 and task.cfg.domain_rand.delay_ms[0] > 5.0
    fit.draw(found, log.with_suffix(".png"))
    assert log.with_suffix(".png").stat().st_size > 10_000


def changed(column: str, change: Callable[[Floats], Floats]) -> Callable[[DriveLog], DriveLog]:
    return lambda log: replace(log, rows={**log.rows, column: change(log.rows[column].copy())})


def own(values: Floats, new: Floats) -> Floats:
    values[:, JOINT] = new
    return values


def kept(rows: Callable[[int], slice]) -> Callable[[DriveLog], DriveLog]:
    return lambda log: replace(log, rows={name: each[rows(len(each))] for name, each in log.rows.items()})


def test_a_robot_with_another_root_moves_as_before() -> None:
    """A G1 from its torso: with the same motor torques, gravity and speeds its joints accelerate alike."""
    folder = POLICIES / "g1_flat"
    model = read_scene(folder, read_contract(folder)).model
    torso = model.body("torso_link").id
    assert between(model, torso) == ["waist_pitch_joint", "waist_roll_joint", "waist_yaw_joint"]
    other, random = with_root(model, torso).compile(), np.random.default_rng(0)
    for each in (model, other):
        for off in ("ACTUATION", "CONTACT", "LIMIT"):
            each.opt.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{off}")
        each.opt.gravity[:], each.dof_frictionloss[:] = model.opt.gravity, 0.0
    data, seen, velocity = mujoco.MjData(model), mujoco.MjData(other), np.zeros(6)
    data.qpos[:7], data.qpos[7:] = [0.3, -0.2, 1.0, 0.5, 0.5, -0.5, 0.5], random.uniform(-0.4, 0.4, model.nq - 7)
    data.qvel[:], data.qfrc_applied[6:] = random.uniform(-1.0, 1.0, model.nv), random.uniform(-9.0, 9.0, model.nu)
    mujoco.mj_forward(model, data)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, torso, velocity, 0)
    seen.qpos[:7] = [*data.xpos[torso], *data.xquat[torso]]
    seen.qvel[:6] = [*velocity[3:], *data.xmat[torso].reshape(3, 3).T @ velocity[:3]]
    for i in range(1, model.njnt):
        mine, theirs = model.joint(i), other.joint(model.joint(i).name)
        seen.qpos[theirs.qposadr], seen.qvel[theirs.dofadr] = data.qpos[mine.qposadr], data.qvel[mine.dofadr]
        seen.qfrc_applied[theirs.dofadr] = data.qfrc_applied[mine.dofadr]
    mujoco.mj_forward(other, seen)
    assert other.body_mass.sum() == pytest.approx(model.body_mass.sum())
    for i in range(1, model.njnt):
        mine, theirs = model.joint(i), other.joint(model.joint(i).name)
        assert seen.qacc[theirs.dofadr] == pytest.approx(data.qacc[mine.dofadr], rel=1e-6, abs=1e-6)


def test_the_motion_of_another_body_is_found() -> None:
    """Of a G1's torso, from random angles, speeds and accelerations, beside the differences of its speeds."""
    folder = POLICIES / "g1_flat"
    model = read_scene(folder, read_contract(folder)).model
    torso, random, step = model.body("torso_link").id, np.random.default_rng(0), 1e-5
    start, speed = random.uniform(-0.5, 0.5, model.nq), random.uniform(-1.0, 1.0, model.nv)
    start[:7], slope, data = (
        [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
        random.uniform(-5.0, 5.0, model.nv),
        mujoco.MjData(model),
    )
    speeds, spins, turned = list[Floats](), list[Floats](), np.eye(3)
    for time in (-step, step, 0.0):
        data.qpos[:], data.qvel[:] = start, speed + time * slope
        mujoco.mj_integratePos(model, data.qpos, time * speed + 0.5 * time**2 * slope, 1.0)
        motion, spin = motion_of(model, torso, data.qpos[None], data.qvel[None], slope[None])
        mujoco.mj_forward(model, data)
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, torso, velocity, 0)
        turned = data.xmat[torso].reshape(3, 3).copy()
        speeds.append(velocity[3:])
        spins.append(spin)
        assert spin == pytest.approx(turned.T @ velocity[:3])
    assert turned @ motion[0, :3] == pytest.approx((speeds[1] - speeds[0]) / (2.0 * step), abs=1e-3)
    assert motion[0, 3:] == pytest.approx((spins[1] - spins[0]) / (2.0 * step), abs=1e-3)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (changed("joint_pos", lambda q: own(q, q[0, JOINT])), "its encoder is dead"),
        (changed("joint_pos", lambda q: own(q, q[:, JOINT] + 0.3 * (np.arange(len(q)) > 900))), "encoder jumps by 0.3"),
        (changed("joint_pos", lambda q: own(q, -1.5 + 0.05 * (q[:, JOINT] + 1.5))), "its motor is loose"),
        (kept(lambda count: slice(0, count - 800)), "ends before the sweep of FL_calf_joint ends"),
        (kept(lambda count: slice(0, count, 10)), "has a measurement each 20 ms"),
        (changed("state", lambda state: 0.0 * state), "has no chirp"),
        (changed("joint_pos", lambda q: q[:, :10]), "has 10 joints, and its export has 12"),
    ],
)
def test_a_log_that_cannot_be_fitted_is_refused(log: Path, change: Callable[[DriveLog], DriveLog], why: str) -> None:
    recording, model = read_log(log), read_scene(GO2, CONTRACT).model
    assert [sweep.joint for sweep in fit.read_sweeps(log, recording, CONTRACT, model, [CALF])] == [JOINT]
    with pytest.raises(LogError, match=why):
        fit.read_sweeps(log, change(recording), CONTRACT, model, [CALF])


def test_a_joint_without_friction_does_not_widen_the_others() -> None:
    """Calves of 0.005 +- 0.02 N m would have a factor of 9; hips of 0.5 +- 0.02 have 0.92 to 1.08."""

    def joint(name: str, friction: float) -> fit.FittedJoint:
        values, deviation = np.ones(6), np.full(6, 1e-3)
        values[fit.FRICTION], deviation[fit.FRICTION] = friction, 0.02
        nothing = np.zeros(2)
        return fit.FittedJoint(CONTRACT.joints.index(name), values, deviation, 0.1, 0.0, nothing, np.zeros((3, 2)))

    hips, calves = [joint(f"{leg}_hip_joint", 0.5) for leg in ("FL", "FR")], [joint("FL_calf_joint", 0.005)]
    no_log: Any = None
    found = fit.overrides(fit.Fit(CONTRACT, no_log, hips + calves, 0.0))["domain_rand"]
    assert found["frictionloss"] == pytest.approx([0.92, 1.08])
    assert "frictionloss" not in fit.overrides(fit.Fit(CONTRACT, no_log, calves, 0.0))["domain_rand"]


def test_a_log_of_which_no_joint_is_left_is_refused(log: Path) -> None:
    with pytest.raises(UserError, match="--leave_out: joint leaves no joint of .* to fit"):
        fit.fit_log(log, leave_out=["joint"])


def test_a_joint_whose_motion_is_not_explained_is_refused() -> None:
    swing = np.sin(np.arange(1000.0))
    joint = fit.FittedJoint(JOINT, np.zeros(6), np.zeros(6), 0.5, 0.36, np.arange(1000.0), np.stack([swing] * 3))
    with pytest.raises(LogError, match=r"cannot be fitted: FL_calf_joint \(74.1%\): the fitted parameters explain"):
        fit._check_explained(Path("log"), CONTRACT.joints, [joint])
    fit._check_explained(Path("log"), CONTRACT.joints, [joint._replace(after=0.05)])


@pytest.mark.parametrize(("name", "slots"), [("go2_flat", 3), ("g1_flat", 7)])
def test_a_slot_has_one_joint_of_a_limb(name: str, slots: int) -> None:
    folder = POLICIES / name
    contract = read_contract(folder)
    plan = chirp.plan(contract, read_scene(folder, contract), Limits.of(folder, contract))
    assert sorted(joint for slot in plan.slots for joint in slot) == list(range(len(contract.joints)))
    assert len(plan.slots) == slots
    for slot in plan.slots:  # two joints of a leg, or two of the waist, never sweep together
        legs = [
            contract.joints[joint].split("_")[0]
            for joint in slot
            if "knee" in contract.joints[joint] or "hip" in contract.joints[joint]
        ]
        assert len(legs) == len({*legs}) and sum("waist" in contract.joints[joint] for joint in slot) < 2


def test_sweeps_keep_the_contracts_limits() -> None:
    """Within ranges and torques of all joints, also where the contract has no ratings."""
    limits, robot = Limits.of(GO2, CONTRACT), MujocoRobot(GO2, CONTRACT, hoisted=True)
    for contract in (CONTRACT, replace(CONTRACT, ratings=None)):
        fast = replace(contract, period=STEP, decimation=1)
        sweeps = Chirp(Controller(GO2, fast), [], lambda _: None, robot, limits)
        for joint in range(12):
            targets = CONTRACT.default_pose[joint] + sweeps.targets(joint)
            assert contract.action.lowest[joint] < targets.min() < targets.max() < contract.action.highest[joint]
            assert CONTRACT.stiffness[joint] * np.abs(sweeps.targets(joint)).max() < 0.5 * limits.motor[joint]
            assert np.abs(np.diff(targets)).max() < STEP * chirp.FASTEST * 1.5
    with pytest.raises(RobotError, match="a measurement every few ms"):
        at_rate(CONTRACT, limits, robot)
