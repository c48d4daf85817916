"""A Unitree robot behind the seam ``Robot``, against a simulated one at the other end of the wire: one process, no waiting."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from legged_mw.deploy.contract import ContractError, ContractRow, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.robot import RobotError, damped
from legged_mw.deploy.simulated import read_scene
from legged_mw.unitree.client import UnitreeRobot, check_rows
from legged_mw.unitree.codec import LAYOUTS, WireMessage
from legged_mw.unitree.driver import senses_feet
from legged_mw.unitree.link import CHECK_MODE, RELEASE_MODE, STAND_DOWN, Received, RobotEnd, Wire
from legged_mw.unitree.robots import G1, GO2, H1
from legged_mw.unitree.serve import STEP, Faults, SimulatedUnitree
from tests.wires import POLICIES, Owner, pair
from tests.wires import domain as domain


def test_go2_stands_walks_and_is_damped(domain: int) -> None:
    """With a wire that is late and loses messages; then its joints are only damped, and it sinks to the ground."""
    both = pair("go2_flat", domain, faults=Faults(delay_ms=10.0, jitter_ms=2.0, loss=0.05))
    sim, robot = both.sim, both.robot
    assert sim.end.program == "" and sim.data.qpos[2] < 0.12 and not np.any(sim.acted["kp"])
    both.rise()
    assert sim.data.qpos[2] > 0.25 and sim.upright > 0.97
    far = both.walk(Controller(POLICIES / "go2_flat", both.contract), np.array([0.8, 0.0, 0.0]), 3.0)
    assert 1.6 < far[0] < 2.7 and abs(far[1]) < 0.4 and sim.upright > 0.97
    robot.close()
    both.steps(1.5)
    assert sim.data.qpos[2] < 0.12 and not sim.acted["kp"].any() and np.abs(sim.joint_vel).max() < 1.0
    assert np.allclose(sim.acted["kd"], damped(both.contract)) and sim.record.refused == 0


def test_g1_walks_off_its_hoist(domain: int) -> None:
    both = pair("g1_flat", domain)
    sim = both.sim
    assert sim.hoist and 0.7 < sim.data.qpos[2] < 0.85
    both.rise()
    assert np.abs(sim.joint_pos - both.contract.default_pose).max() < 0.1
    controller = Controller(POLICIES / "g1_flat", both.contract)
    both.walk(controller, np.zeros(3), 0.5)
    sim.hoist = False
    both.walk(controller, np.zeros(3), 1.0)
    far = both.walk(controller, np.array([0.6, 0.0, 0.0]), 2.0)
    assert far[0] > 0.7 and sim.upright > 0.95 and not sim.data.xfrc_applied.any()
    assert sim.command is not None and sim.command["mode_machine"] == 5 and sim.command["mode_pr"] == 0


# ---- what is measured


def test_measurements_are_the_truth_by_name(domain: int) -> None:
    both = pair("go2_flat", domain)
    sim, robot = both.sim, both.robot
    sim.data.qpos[3:7] = [math.cos(0.2), math.sin(0.2), 0.0, 0.0]  # rolled to the right by 0.4 rad
    for i, name in enumerate(both.contract.joints):
        sim.data.joint(name).qpos[0] = 0.01 * i
    sim.data.qvel[:] = 0.0
    sim.data.qvel[6:] = np.arange(12)
    mujoco.mj_step1(sim.model, sim.data)
    sim._fill()
    robot._owner = Owner(sim._state.body, stamp=sim.time)
    measured = robot.read()
    assert np.allclose(measured.joint_pos, 0.01 * np.arange(12), atol=1e-6)
    assert np.allclose(measured.joint_vel, sim.joint_vel, atol=1e-6)
    assert measured.gravity[1] == pytest.approx(-math.sin(0.4), abs=1e-5)
    assert measured.gravity[2] == pytest.approx(-math.cos(0.4), abs=1e-5)
    message = WireMessage(LAYOUTS["unitree_go", "LowState_"], sim._state.body)
    assert message["motor_state.q"][GO2.motors["FL_calf_joint"]] == pytest.approx(0.02)
    assert message["motor_state.q"][12:].tolist() == [0.0] * 8


def test_health_and_faults(domain: int) -> None:
    both = pair("go2_flat", domain)
    sim, robot = both.sim, both.robot
    both.steps(0.02)
    health = robot.health()
    assert health.age_s == 0.0 and health.voltage == pytest.approx(32.8) and not health.motor_faults
    assert (
        health.remote
        and not health.remote.buttons
        and health.temperatures is not None
        and (health.temperatures == 35).all()
    )
    sim.faults.temperature, sim.faults.voltage, sim.faults.no_remote, sim.faults.dead_motors = (
        91.0,
        21.5,
        True,
        {"RL_calf_joint"},
    )
    both.steps(0.02)
    health = robot.health()
    assert (
        health.temperatures is not None and (health.temperatures == 91).all() and health.voltage == pytest.approx(21.5)
    )
    assert health.remote is None and health.motor_faults == {"RL_calf_joint": "it lost 10 messages in a period"}
    assert robot.limits == {"voltage": 24.0}


def test_a_g1_names_its_motors_error(domain: int) -> None:
    both = pair("g1_flat", domain, faults=Faults(dead_motors={"left_knee_joint"}))
    both.robot.write(both.contract.default_pose)
    both.steps(0.1)
    assert both.robot.health().motor_faults == {"left_knee_joint": "error 0x1"}
    assert both.sim.torque[both.contract.joints.index("left_knee_joint")] == 0.0 and np.abs(both.sim.torque).max() > 0.0


def test_a_bias_is_measured_and_not_there(domain: int) -> None:
    both = pair("go2_flat", domain, faults=Faults(joint_bias=0.03, gyro_bias=0.5))
    both.steps(2.0)  # its legs hang still by then
    measured = both.robot.read()
    assert np.allclose(measured.joint_pos - both.sim.joint_pos, 0.03, atol=1e-3)
    assert np.allclose(measured.ang_vel - both.sim.data.qvel[3:6], 0.5, atol=0.05)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("silent", "the newest measurement is 1[0-9]{2} ms old: the robot is silent, or the link is down"),
        ("bad_crc", "3 states in a row have a wrong checksum: the newest good one is 11[0-9] ms old"),
    ],
)
def test_a_robot_without_good_states_is_none(fault: str, said: str, domain: int) -> None:
    both = pair("go2_flat", domain)
    both.steps(0.05)
    both.robot.read()
    setattr(both.sim.faults, fault, True)
    for seconds in (0.02, 0.018):
        both.steps(seconds)
        both.robot.read()
    both.steps(0.08)
    with pytest.raises(RobotError, match=said):
        both.robot.read()


@pytest.mark.parametrize("simulated", [True, False])
def test_states_without_a_checksum(simulated: bool) -> None:
    """unitree_mujoco's simulator in Python sends none, and no voltage. No robot may, nor a simulator that sent one."""
    contract, state = read_contract(POLICIES / "go2_flat"), WireMessage(LAYOUTS["unitree_go", "LowState_"])
    state["power_v"], state["imu_state.quaternion"] = 30.0, [1.0, 0.0, 0.0, 0.0]
    sealed, state["crc"] = state.seal(), 0
    later = WireMessage(state.layout, state.body)
    later["motor_state.q"], later["tick"], later["power_v"] = 0.7, 1, 0.0
    robot = UnitreeRobot(contract, Owner(later.body), Received(sealed, 0.0), simulated=simulated, clock=lambda: 0.0)
    assert not robot.read().joint_pos.any() and robot.dropped == {"with a wrong checksum": 1}
    robot._owner = Owner(later.seal())
    assert np.allclose(robot.read().joint_pos, 0.7) and robot.health().voltage == 0.0
    bare, later["crc"], later["tick"] = WireMessage(state.layout), 0, 2
    bare["imu_state.quaternion"] = state["imu_state.quaternion"]
    if simulated:
        robot = UnitreeRobot(contract, Owner(later.body), Received(bare.body, 0.0), simulated=True, clock=lambda: 0.0)
        assert np.allclose(robot.read().joint_pos, 0.7) and robot.health().voltage is None
    else:
        with pytest.raises(RobotError, match=r"the robot's states have a wrong checksum \(0x0\)"):
            UnitreeRobot(contract, Owner(), Received(bare.body, 0.0), clock=lambda: 0.0)


# ---- what is commanded


def test_commands(domain: int) -> None:
    both = pair("go2_flat", domain)
    robot, owner = both.robot, Owner()
    robot._owner, targets = owner, both.contract.default_pose + np.linspace(-0.5, 0.5, 12)
    robot.write(targets)
    robot.write(targets, stiffness=np.full(12, 7.0), damping=np.full(12, 0.7))
    robot.damp()
    robot.limp()
    slots = [GO2.motors[name] for name in both.contract.joints]
    sent = [WireMessage(LAYOUTS["unitree_go", "LowCmd_"], body) for body in owner.sent]
    for message in sent:
        assert message.intact() and message["head"].tolist() == [0xFE, 0xEF] and message["level_flag"] == 0xFF
        assert message["motor_cmd.mode"].tolist() == [1] * 12 + [0] * 8 and not message["motor_cmd.dq"].any()
    assert np.allclose(sent[0]["motor_cmd.q"][slots], targets) and np.allclose(
        sent[0]["motor_cmd.kp"][slots], both.contract.stiffness
    )
    assert np.allclose(sent[1]["motor_cmd.kp"][:12], 7.0) and np.allclose(sent[1]["motor_cmd.kd"][:12], 0.7)
    assert not sent[2]["motor_cmd.kp"].any() and np.allclose(sent[2]["motor_cmd.kd"][slots], damped(both.contract))
    assert not any(sent[3][f"motor_cmd.{part}"].any() for part in ("q", "kp", "kd", "tau"))
    with pytest.raises(RobotError, match="targets that are not finite are not sent: q"):
        robot.write(np.full(12, math.nan))
    assert len(owner.sent) == 4


def test_a_contract_in_another_order_sends_the_same(domain: int) -> None:
    """Motors are found by the names of their joints. Names that were only swapped are refused: the sensors of the scene tell."""
    both = pair("go2_flat", domain)
    named = ("joints", "default_pose", "stiffness", "damping")
    backwards = replace(both.contract, **{name: getattr(both.contract, name)[::-1] for name in named})
    owners, first = [Owner(both.sim._state.body) for _ in range(2)], Received(both.sim._state.body, 0.0)
    robots = [
        UnitreeRobot(*each, first, clock=lambda: 0.0) for each in zip((both.contract, backwards), owners, strict=True)
    ]
    robots[0].write(both.contract.default_pose + 0.01 * np.arange(12))
    robots[1].write((both.contract.default_pose + 0.01 * np.arange(12))[::-1])
    assert owners[0].sent == owners[1].sent and np.array_equal(
        robots[0].read().joint_pos, robots[1].read().joint_pos[::-1]
    )
    said = "joints are in another order than sensors: joint_pos, where jointpos/FL_hip_joint measures FL_hip_joint in the place of RR_calf"
    with pytest.raises(ContractError, match=said):
        read_scene(POLICIES / "go2_flat", backwards)


def test_targets_are_held_within_what_was_trained(domain: int) -> None:
    """The scene's servos hold targets within the joints' ranges, so the policy may ask for more than a joint can do; drives would obey."""
    both = pair("g1_flat", domain)
    low, high = both.contract.action.lowest, both.contract.action.highest
    knee = both.contract.joints.index("left_knee_joint")
    assert (low[knee], high[knee]) == (pytest.approx(-0.087267), pytest.approx(2.8798))
    owner = both.robot._owner = Owner()
    both.robot.write(both.contract.action.held(np.full(29, -9.0)))
    sent = WireMessage(LAYOUTS["unitree_hg", "LowCmd_"], owner.sent[0])
    assert np.allclose(sent["motor_cmd.q"][[G1.motors[name] for name in both.contract.joints]], low)


def test_h1_on_the_wire() -> None:
    """Its table alone: there is no policy for it here."""
    contract = replace(
        read_contract(POLICIES / "g1_flat"),
        joints=tuple(H1.motors),
        **{name: np.arange(19.0) for name in ("default_pose", "stiffness", "damping")},
    )
    owner = Owner(WireMessage(LAYOUTS["unitree_go", "LowState_"]).seal())
    robot = UnitreeRobot(contract, owner, owner.receive(), clock=lambda: 0.0)
    robot.write(np.arange(19.0))
    message = WireMessage(LAYOUTS["unitree_go", "LowCmd_"], owner.sent[-1])
    assert message["motor_cmd.mode"].tolist() == [10] * 9 + [0] + [1] * 10
    assert message["motor_cmd.q"][[9, 6, 19]].tolist() == [0.0, 6.0, contract.joints.index("left_elbow_joint")]


def test_the_simulated_robot_obeys_as_a_motor_does(domain: int) -> None:
    """Wrong messages move nothing; a motor's mode 0 and Unitree's stop values give no torque; the last command holds for ever."""
    both = pair("go2_flat", domain)
    sim, robot = both.sim, both.robot
    command = WireMessage(
        LAYOUTS["unitree_go", "LowCmd_"], robot._command(q=both.contract.default_pose, kp=both.contract.stiffness)
    )
    wrong = WireMessage(command.layout, command.body)
    wrong["motor_cmd.kp"] = 99.0
    low = WireMessage(command.layout, command.body)
    low["level_flag"] = 0xEE
    for bad in (wrong.body, low.seal()):
        sim._take(WireMessage(command.layout, bad))
    assert sim.record.refused == 2 and not sim.acted["kp"].any()
    sim._take(command)
    both.steps(1.0)
    assert np.allclose(sim.acted["kp"], both.contract.stiffness)
    command["motor_cmd.mode"] = 0
    command.seal()
    sim._take(command)
    sim.step()
    assert not sim.torque.any()
    command["motor_cmd.mode"], command["motor_cmd.q"], command["motor_cmd.dq"], command["motor_cmd.kd"] = (
        1,
        2.146e9,
        16000.0,
        5.0,
    )
    command.seal()
    sim._take(command)
    sim.step()
    assert sim.record.refused == 2 and not sim.torque.any()


def test_a_watchdog_if_asked_for(domain: int) -> None:
    both = pair("go2_flat", domain, watchdog=0.1)
    both.robot.write(both.contract.default_pose)
    both.steps(0.09)
    assert both.sim.acted["kp"].any()
    both.steps(0.03)
    assert (
        not both.sim.acted["kp"].any()
        and np.allclose(both.sim.acted["kd"], damped(both.contract))
        and both.sim.record.watchdog == 1
    )


# ---- before the first command


def test_no_robot(domain: int) -> None:
    wire = Wire("unitree_go", "lo", domain)
    with pytest.raises(
        RobotError, match="no robot: no rt/lowstate of unitree_go in domain .* on lo within 0.1 s; is it on, is this"
    ):
        wire.prepare(seconds=0.1)


def test_the_wrong_robot(domain: int) -> None:
    """A Go2's policy where a G1 is."""
    folder = POLICIES / "g1_flat"
    sim = SimulatedUnitree(folder, read_contract(folder), RobotEnd("unitree_hg", "lo", domain))
    wire = Wire("unitree_go", "lo", domain, wait=sim.step, clock=lambda: sim.time)
    with pytest.raises(RobotError) as error:
        wire.prepare(seconds=0.5)
    assert "the robot there speaks unitree_hg: it is not the contract's. There: g1 has left_hip_pitch_joint, " in str(
        error.value
    )
    assert ". Here: go2 has FR_hip_joint, FR_thigh_joint, " in str(
        error.value
    ) and "; h1 has right_hip_roll_joint, " in str(error.value)
    assert sim.record.commands == 0


def test_another_robot(domain: int) -> None:
    """Publishers are counted: one that was killed is waited for, two that send are refused at once."""
    both = pair("go2_flat", domain)
    second = RobotEnd("unitree_go", "lo", domain)
    with pytest.raises(RobotError, match="two robots answer: 2 programs publish rt/lowstate in domain .* on lo"):
        both.robot.read()
    both.steps(0.3)  # without a look at it, as while it is silent
    with pytest.raises(RobotError, match="the robot was started again: another program publishes its rt/lowstate"):
        both.robot.read()
    begun, wire = both.sim.time, Wire("unitree_go", "lo", domain, wait=both.sim.step, clock=lambda: both.sim.time)
    with pytest.raises(RobotError, match="2 programs publish rt/lowstate in domain .* end all but one robot"):
        wire.prepare(listen=0.1)
    assert both.sim.time - begun > 10.0
    begun = both.sim.time

    turns = itertools.cycle([both.sim.step, lambda: second.send(both.sim._state.body)])

    wire._wait = lambda: next(turns)()
    with pytest.raises(RobotError, match="2 programs publish rt/lowstate in domain .* end all but one robot"):
        wire.prepare(listen=0.1)
    assert both.sim.time - begun < 1.0


def test_another_commander(domain: int) -> None:
    both = pair("go2_flat", domain)

    def wait() -> None:
        both.robot.limp()
        both.sim.step()

    second = Wire("unitree_go", "lo", domain, wait=wait, clock=lambda: both.sim.time)
    with pytest.raises(RobotError, match="another program sends rt/lowcmd in domain .* end it first; nothing was sent"):
        second.prepare(listen=0.2)
    second.send(both.robot._command())
    with pytest.raises(RobotError, match="another program sends commands to this robot, too"):
        both.robot.read()


def test_it_is_laid_down_before_its_own_program_lets_go(domain: int) -> None:
    folder = POLICIES / "go2_flat"
    sim = SimulatedUnitree(folder, read_contract(folder), RobotEnd("unitree_go", "lo", domain))
    Wire("unitree_go", "lo", domain, wait=sim.step, clock=lambda: sim.time).prepare(lies_down=GO2.lies_down)
    assert sim.end.calls == [CHECK_MODE, STAND_DOWN, RELEASE_MODE, CHECK_MODE] and sim.end.program == ""


ASKED = "no motor command was sent, but its own program may have let go: hold the robot"


@pytest.mark.parametrize(
    ("lost", "program", "error"),
    [
        (range(2), "", ""),
        (range(5), "normal", "nothing was sent"),
        (range(1, 6), "normal", ASKED),
        (range(2, 7), "", ASKED),  # the release was heard; whether it did is asked then
    ],
)
def test_a_motion_service_whose_answers_are_lost_is_asked_again(
    domain: int, lost: range, program: str, error: str
) -> None:
    """Of its calls, those that are lost: a robot may answer before it has discovered who listens. It is asked five times."""
    folder = POLICIES / "go2_flat"

    class Lossy(RobotEnd):
        heard = 0

        def answer(self) -> None:
            if self._requests.read(10):
                self._requests.take(10) if self.heard in lost else super().answer()
                self.heard += 1

    sim = SimulatedUnitree(folder, read_contract(folder), end := Lossy("unitree_go", "lo", domain))
    wire = Wire("unitree_go", "lo", domain, wait=sim.step, clock=lambda: sim.time)
    if error:
        with pytest.raises(RobotError, match=f"does not answer: {error}; restart the robot"):
            wire.prepare()
        assert end.heard == lost.stop
    else:
        wire.prepare()
        assert end.calls == [CHECK_MODE, RELEASE_MODE, CHECK_MODE]
    assert end.program == program


def test_a_motion_program_that_does_not_let_go(domain: int) -> None:
    folder = POLICIES / "go2_flat"

    class Stubborn(RobotEnd):
        program = property(lambda self: "ai", lambda self, name: None)  # type: ignore[assignment]

    sim = SimulatedUnitree(folder, read_contract(folder), Stubborn("unitree_go", "lo", domain))
    wire = Wire("unitree_go", "lo", domain, wait=sim.step, clock=lambda: sim.time)
    with pytest.raises(RobotError, match="the robot's own program 'ai' does not release the motors"):
        wire.prepare()
    assert sim.record.commands == 0


def test_a_go2_measures_what_its_feet_touch() -> None:
    contract = read_contract(POLICIES / "go2_flat")
    touch = replace(contract, rows=(*contract.rows, ContractRow("touch", 4, "", "", 0.0, "foot_contact")))
    check_rows(touch, GO2)
    nameless = replace(touch, feet=dict(zip("abcd", contract.feet.values(), strict=True)))
    with pytest.raises(RobotError, match="the policy observes touch, which a go2 does not measure"):
        check_rows(nameless, GO2)
    assert senses_feet(contract) and not senses_feet(nameless)


def test_a_foot_is_that_of_the_leg_that_begins_its_name() -> None:
    """As a draft names feet: FL_foot. In the contract's order, not the wire's."""
    state = WireMessage(LAYOUTS["unitree_go", "LowState_"])
    state["imu_state.quaternion"], state["foot_force"], state["motor_state.mode"] = [1, 0, 0, 0], [60, 0, 0, 0], 1
    state["tick"], state["power_v"] = 5, 30
    state.seal()
    contract = read_contract(POLICIES / "go2_flat")
    for names in (("FL", "FR", "RL", "RR"), ("FL_foot", "FR_foot", "RL_foot", "RR_foot"), ("fl", "fr", "rl", "rr")):
        own = replace(contract, feet=dict(zip(names, contract.feet.values(), strict=True)))
        robot = UnitreeRobot(own, Owner(), Received(state.body, 0.0), clock=lambda: 0.0)
        assert robot.read().foot_contact.tolist() == [0, 1, 0, 0]


def test_a_served_go2_feels_its_feet_whatever_their_names(domain: int) -> None:
    """In the order of the wire: FR, FL, RR, RL."""
    both = pair("go2_flat", domain, hoist=False)
    for names in (("FL", "FR", "RL", "RR"), ("FL_foot", "FR_foot", "RL_foot", "RR_foot")):
        both.sim.contract = replace(both.contract, feet=dict(zip(names, both.contract.feet.values(), strict=True)))
        both.sim.data.sensordata[:] = 0.0
        both.sim.data.sensordata[both.sim._scene.contacts[0]] = 1.0  # of the first of the names
        both.sim._fill_own()
        assert np.flatnonzero(both.sim._state["foot_force"]).tolist() == [1]


def test_the_exam_over_a_slow_wire_begins(domain: int) -> None:
    """A reset moves the clock by a second, and the first state since must have arrived."""
    both = pair("go2_flat", domain, faults=Faults(delay_ms=10.0, jitter_ms=2.0), hoist=False)
    both.sim.reset(after=1.0)
    both.sim.step()
    both.robot.write(both.contract.default_pose)
    for _ in range(round(both.contract.period / STEP)):
        both.sim.step()
    np.testing.assert_allclose(both.robot.read().joint_pos, both.contract.default_pose, atol=0.1)
