"""The safety layer: each limit at the limit and just beyond it, faults on the simulated robot, and none of it on a good walk."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drivers import Script, Watched, beyond, driven
from recorder import Recorder

from legged_mw import ROOT
from legged_mw.deploy.contract import Contract, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.exam import contract_rules
from legged_mw.deploy.robot import Health, Measurement, Remote, RobotError
from legged_mw.deploy.runner import run
from legged_mw.deploy.safety import NAMES, Limits, Safety, Trip, Tripped, parse_limits
from legged_mw.deploy.simulated import MujocoRobot
from legged_mw.deploy.stage import DeployStage
from legged_mw.eval import walking
from legged_mw.utils.commands import VELOCITY

POLICIES = ROOT / "resources/policies"
GO2 = POLICIES / "go2_flat"
ASKED = {
    "position": 0.1,
    "target": 0.3,
    "step": 0.5,
    "torque": 1.0,
    "speed": 20.0,
    "tilt": 30.0,
    "temperature": 80.0,
    "voltage": 24.0,
}


@pytest.fixture(scope="module")
def contract() -> Contract:
    return read_contract(GO2)


@pytest.fixture(scope="module")
def limits(contract: Contract) -> Limits:
    return Limits.of(GO2, contract, ASKED)


def at_rest(contract: Contract, **changed: Any) -> Measurement:
    zeros = {name: np.zeros(3) for name in ("lin_vel", "ang_vel", "acceleration")}
    joints = {"joint_pos": contract.default_pose, "joint_vel": np.zeros(12), "joint_torque": np.zeros(12)}
    return Measurement(
        **{**zeros, **joints, "gravity": np.array([0.0, 0.0, -1.0]), "foot_contact": np.zeros(4), **changed}
    )


def put(values: Any, joint: int, value: float) -> Any:
    changed = np.array(values, dtype=float)
    changed[joint] = value
    return changed


def tilted(degrees: float) -> Any:
    return np.array([math.sin(math.radians(degrees)), 0.0, -math.cos(math.radians(degrees))])


# ---- each limit, at it and beyond it. Of joint 5, FR_calf_joint: -2.7227 to -0.83776 rad, 45.43 N m

SENSED = {
    "position": (
        lambda x: {"joint_pos": x},
        -0.8378 + 0.1,
        "FR_calf_joint is at -0.69 rad, 0.15 beyond its range -2.72 to -0.84; 0.10 is",
    ),
    "speed": (lambda x: {"joint_vel": x}, 20.0, "FR_calf_joint turns at 20.1 rad/s, more than 20.0"),
    "tilt": (lambda x: {"gravity": tilted(x)}, 30.0, "the body is tilted by 30 degrees, more than 30"),
}


@pytest.mark.parametrize("name", SENSED)
def test_what_is_measured(name: str, contract: Contract, limits: Limits) -> None:
    make, limit, text = SENSED[name]

    def check(value: float) -> Trip | None:
        base = {"position": contract.default_pose, "speed": np.zeros(12)}.get(name)
        changed = make(value if base is None else put(base, 5, value))
        return Safety(contract, limits).sensed(at_rest(contract, **changed), Health(), 0.0)

    assert check(limit - 1e-3) is None
    assert (trip := check(limit + 0.05)) and trip.limit == name and trip.text.startswith(text)
    assert (trip := check(math.nan)) and trip.limit == "finite" and "a measured value is not finite: " in trip.text


HEALTH: dict[str, tuple[Health, Health, str]] = {
    "temperature": (
        Health(temperatures=np.full(12, 80.0)),
        Health(temperatures=put(np.full(12, 30.0), 2, 81.0)),
        "FL_calf_joint has a motor of 81 deg C, more than 80",
    ),
    "voltage": (Health(voltage=24.0), Health(voltage=23.9), "the battery has 23.9 V, less than 24"),
    "age": (Health(age_s=0.04), Health(age_s=0.041), "the newest measurement is 41 ms old, more than 40"),
    "motor": (
        Health(),
        Health(motor_faults={"FL_hip_joint": "error 0x4"}),
        "the motor of FL_hip_joint reports a fault: error 0x4",
    ),
}


@pytest.mark.parametrize("name", HEALTH)
def test_what_the_robot_reports(name: str, contract: Contract, limits: Limits) -> None:
    fine, wrong, text = HEALTH[name]
    assert Safety(contract, limits).sensed(at_rest(contract), fine, 0.0) is None
    assert Safety(contract, limits).sensed(at_rest(contract), wrong, 0.0) == Trip(name, text)
    if name != "motor":
        numbers = ((key, getattr(wrong, key)) for key in ("voltage", "age_s", "temperatures"))
        bad = replace(wrong, **{key: math.nan * value for key, value in numbers if value is not None})
        assert Safety(contract, limits).sensed(at_rest(contract), bad, 0.0)


def test_targets(contract: Contract, limits: Limits) -> None:
    """Beyond the range, too far at once, too strong for the motor, not finite."""
    pose, rest = contract.default_pose, at_rest(contract)

    def check(*targets: Any, measured: Measurement = rest) -> Trip | None:
        safety = Safety(contract, limits)
        found = [safety.asked(measured, each) for each in targets]
        assert not any(found[:-1])
        return found[-1]

    assert check(put(pose, 5, -0.8378 + 0.299)) is None
    assert check(put(pose, 5, -0.5)) == Trip(
        "target", "FR_calf_joint is told to go to -0.50 rad, 0.34 beyond its range -2.72 to -0.84; 0.30 is the most"
    )
    assert check(pose, put(pose, 1, 1.299)) is None
    assert check(pose, put(pose, 1, 1.301)) == Trip(
        "step", "FL_thigh_joint is told to step by 0.50 rad from one target to the next, more than 0.50"
    )
    fast = at_rest(contract, joint_vel=put(np.zeros(12), 0, -10.0))  # damping asks for 5 N m more
    assert check(put(pose, 0, 0.1 + 0.93), measured=fast) is None  # 20 * 0.93 + 5 = 23.6 of 23.7 N m
    assert check(put(pose, 0, 0.1 + 0.94), measured=fast) == Trip(
        "torque", "FL_hip_joint is asked for 23.8 N m, more than 23.7"
    )
    for value in (math.nan, math.inf):
        assert check(put(pose, 7, value)) == Trip("finite", f"the target of RL_thigh_joint is not finite: {value}")


def test_targets_are_held_within_the_servos_range(contract: Contract) -> None:
    """As MuJoCo's servos hold them in training: a robot's drives do not."""
    robot, controller = Recorder(MujocoRobot(GO2, contract)), Controller(GO2, contract)
    beyond_it = put(contract.default_pose, 5, -0.5)
    controller._network = lambda _: (beyond_it - contract.default_pose)[None].astype(np.float32) / contract.action.scale
    run(robot, controller, lambda _: np.zeros(3), 0.04, live=False)
    np.testing.assert_allclose(controller.last_targets[0], beyond_it, atol=1e-6)  # the policy's own
    np.testing.assert_allclose(robot.targets, [put(beyond_it, 5, Limits.of(GO2, contract).high[5])] * 2, atol=1e-6)


def test_gains_count_in_the_torque(contract: Contract, limits: Limits) -> None:
    target = put(contract.default_pose, 0, 0.5)
    safety, zeros = Safety(contract, limits), np.zeros(12)
    assert safety.asked(at_rest(contract), target, 2.9 * contract.stiffness, zeros) is None
    assert safety.asked(at_rest(contract), target, 3.1 * contract.stiffness, zeros) == Trip(
        "torque", "FL_hip_joint is asked for 24.8 N m, more than 23.7"
    )


def test_a_policy_of_torques(contract: Contract, limits: Limits) -> None:
    """Its targets are torques: the motor's limit holds for them, and no servo stands such a robot up."""
    torques = replace(contract, action=contract.action._replace(origin="torque"))
    safety = Safety(torques, limits)
    assert safety.asked(at_rest(contract), put(np.zeros(12), 2, -45.4)) is None
    assert safety.asked(at_rest(contract), put(np.zeros(12), 2, -45.5)) == Trip(
        "torque", "FL_calf_joint is asked for 45.5 N m, more than 45.4"
    )


def test_steps_that_are_late(contract: Contract, limits: Limits) -> None:
    """Five within a second, each by more than half a period; four, or half a period, are fine."""
    off = limits.but({"frozen": "off"}, "test")
    for count, apart, behind, trips in (
        (5, 0.2, 0.0101, True),
        (5, 0.26, 0.0101, False),
        (4, 0.02, 0.02, False),
        (9, 0.02, 0.01, False),
    ):
        safety = Safety(contract, off)
        found = [safety.sensed(at_rest(contract), Health(), i * apart, behind) for i in range(count)]
        assert not any(found[:-1]) and bool(found[-1]) == trips
    assert Safety(contract, off).sensed(at_rest(contract), Health(), 0.0, 5.0) is None
    many = Safety(contract, off.but({"late": 100}, "test"))
    assert [bool(many.sensed(at_rest(contract), Health(), i * 0.002, 0.02)) for i in range(100)] == [False] * 99 + [
        True
    ]
    safety = Safety(contract, off)
    found = [safety.sensed(at_rest(contract), Health(), i * 0.02, 0.015) for i in range(5)]
    assert found[-1] == Trip("late", "5 steps within a second began late, the last by 15 ms")
    safety = Safety(contract, off)  # a program that hangs, and goes on punctually
    assert safety.sensed(at_rest(contract), Health(), 0.1, 0.0, 3) is None
    trip = safety.sensed(at_rest(contract), Health(), 0.5, 0.0, 2)
    assert trip == Trip("late", "5 steps within a second began late, or not at all: 2 before this one")


def test_measurements_that_are_frozen(contract: Contract, limits: Limits) -> None:
    safety, health = Safety(contract, limits), Health()
    for bit in (0.0, 0.0, 0.0, 1e-15, 1e-15, 1e-15):
        assert safety.sensed(at_rest(contract, joint_vel=put(np.zeros(12), 0, bit)), health, 0.0) is None
    trip = safety.sensed(at_rest(contract, joint_vel=put(np.zeros(12), 0, 1e-15)), health, 0.0)
    assert trip == Trip("frozen", "4 measurements in a row are the same")
    safety.reset()
    assert safety.sensed(at_rest(contract), health, 0.0) is None


def walk(contract: Contract, step: int, stuck: Sequence[str] = (), quantum: float = 0.0) -> Measurement:
    """A measurement of joints that swing by 0.3 rad and of a body that rolls by 0.05, twice a second; parts and joints that are stuck."""
    phase, ones = 4.0 * math.pi * step * contract.period, np.ones(12)
    quick, roll = 4.0 * math.pi, 0.05 * math.sin(phase)
    parts = {
        "joint_pos": contract.default_pose + 0.3 * math.sin(phase) * ones,
        "joint_vel": 0.3 * quick * math.cos(phase) * ones,
        "ang_vel": np.array([0.05 * quick * math.cos(phase), 0.0, 0.0]),
        "gravity": np.array([0.0, -math.sin(roll), -math.cos(roll)]),
    }
    if step and stuck:
        before = walk(contract, 0)
        parts |= {name: getattr(before, name) for name in stuck if name in parts}
        for joint in (contract.joints.index(name) for name in stuck if name not in parts):
            parts["joint_pos"][joint], parts["joint_vel"][joint] = before.joint_pos[joint], 0.0
    return at_rest(
        contract,
        **{name: np.round(values / quantum) * quantum if quantum else values for name, values in parts.items()},
    )


@pytest.mark.parametrize(
    ("stuck", "named"),
    [
        (["joint_pos"], "joint_pos"),
        (["joint_vel"], "joint_vel"),
        (["joint_pos", "joint_vel"], "joint_pos"),
        (["ang_vel"], "ang_vel"),
        (["gravity"], "gravity"),
        (["ang_vel", "gravity"], "ang_vel"),
        (["RL_calf_joint"], "RL_calf_joint"),
    ],
)
def test_a_part_that_is_frozen(stuck: list[str], named: str, contract: Contract, limits: Limits) -> None:
    """It is named, soon; without it nothing trips."""
    for parts in ([], stuck):
        safety, trips = Safety(contract, limits.but({"remote": "off"}, "test")), list[tuple[int, Trip]]()
        for step in range(-25, 25):
            measured = walk(contract, step, parts) if step >= 0 else walk(contract, step)
            if trip := safety.sensed(measured, Health(), step * contract.period):
                trips.append((step, trip))
            safety.asked(measured, walk(contract, step + 1).joint_pos)
        assert bool(trips) == bool(parts)
    (step, trip), *_ = trips
    assert trip.limit == "frozen" and named in trip.text and 11 <= step <= 20


@pytest.mark.parametrize("quantum", [1e-4, 1e-3])
def test_a_robot_that_stands_still_is_not_frozen(quantum: float, contract: Contract, limits: Limits) -> None:
    """Its encoders have steps; its gyro has noise. A gyro and speeds that are not measured stay zero, also while it walks."""
    noise, safety = np.random.default_rng(0), Safety(contract, limits)
    for step in range(200):
        measured = at_rest(
            contract,
            ang_vel=0.02 * noise.standard_normal(3),
            joint_pos=np.round(contract.default_pose / quantum) * quantum,
        )
        assert safety.sensed(measured, Health(), step * contract.period) is None
        assert safety.asked(measured, contract.default_pose + 0.02 * noise.standard_normal(12)) is None
    safety.reset()
    for step in range(200):
        measured = replace(walk(contract, step, quantum=quantum), ang_vel=np.zeros(3), joint_vel=np.zeros(12))
        assert safety.sensed(measured, Health(), step * contract.period) is None


@pytest.mark.parametrize(("part", "steps"), [("joint_pos", 12), ("gravity", 11), ("ang_vel", 11)])
def test_a_part_with_coarse_steps_is_not_frozen(part: str, steps: int, contract: Contract, limits: Limits) -> None:
    """A body that is carried keeps the angles of its joints; a gyro's dead band or an orientation's step lasts a while."""
    safety, noise = Safety(contract, limits), np.random.default_rng(0)
    begin, carried = 6, part == "joint_pos"
    for step in range(200 if carried else begin + steps):
        phase = 0.7 * step * contract.period
        roll = 0.3 * math.sin(phase / 0.3)
        parts = {
            "ang_vel": np.array([0.7 * math.cos(phase / 0.3), 0.0, 0.0]),
            "gravity": np.array([0.0, -math.sin(roll), -math.cos(roll)]),
        }
        measured = at_rest(contract, **parts) if carried else walk(contract, step)
        if step >= begin and not carried:
            measured = replace(measured, **{part: getattr(walk(contract, begin), part)})
        assert safety.sensed(measured, Health(), step * contract.period) is None
        told = (
            contract.default_pose + 0.002 * noise.standard_normal(12) if carried else walk(contract, step + 1).joint_pos
        )
        assert safety.asked(measured, told) is None


def test_a_clock_that_went_back(contract: Contract, limits: Limits) -> None:
    """Else a measurement would be fresh until that clock has caught up."""
    trip = Safety(contract, limits).sensed(at_rest(contract), Health(age_s=-5.0), 0.0)
    assert trip == Trip("age", "the newest measurement comes from 5000 ms ahead: a clock went back")


def test_a_remote_that_is_lost(contract: Contract, limits: Limits) -> None:
    safety = Safety(contract, limits.but({"frozen": "off"}, "test"))
    assert safety.sensed(at_rest(contract), Health(), 100.0) is None  # there was no remote to lose
    assert safety.sensed(at_rest(contract), Health(remote=Remote()), 100.0) is None
    assert safety.sensed(at_rest(contract), Health(), 102.98) is None
    assert safety.sensed(at_rest(contract), Health(), 103.0) == Trip("remote", "the remote was not heard for 3.0 s")


# ---- where limits come from


def test_limits_of_an_export(contract: Contract) -> None:
    """The scene's machine, the contract's section, then the machine's class and the command line."""
    limits = Limits.of(GO2, contract)
    np.testing.assert_allclose((limits.low[5], limits.high[5], limits.motor[5]), (-2.7227, -0.83776, 45.43), atol=1e-4)
    assert limits.tilt == 60.0 and limits.voltage == -math.inf
    narrow = replace(contract, safety={"speed": 25, "tilt": False})
    limits = Limits.of(GO2, narrow, {"voltage": 24.0}, parse_limits(["speed=30", "late = off"]))
    assert (limits.speed, limits.tilt, limits.voltage, limits.late) == (30.0, math.inf, 24.0, math.inf)
    assert [Limits.of(GO2, contract, {"target": zero}).target for zero in (0, 0.0, "0", False)] == [0, 0, 0, math.inf]
    for falls, tilt in ((None, math.inf), (45.0, 45.0), (170.0, 170.0)):
        assert Limits.of(GO2, replace(contract, ends=contract.ends._replace(max_tilt=falls))).tilt == tilt
    assert narrow.to_dict()["safety"] == {"speed": 25, "tilt": False} and "safety" not in contract.to_dict()
    assert set(NAMES) == {*ASKED, "age", "frozen", "late", "remote"}


# ---- a good walk passes none of them


@pytest.mark.parametrize("name", ["go1_flat", "go2_flat", "g1_flat"])
def test_shipped_policies_trip_nothing(name: str) -> None:
    """All commands of the walking exam, and after 1.5 s the pushes that a walk survives: as shipped, default limits."""
    folder = POLICIES / name
    contract = read_contract(folder)
    exam, names = contract_rules(contract), [command.name for command in contract.commands]
    directions = np.arange(walking.PUSH_DIRECTIONS) * 2 * math.pi / walking.PUSH_DIRECTIONS
    kicks = [
        speed * np.array([math.cos(a), math.sin(a)])
        for speed in exam.push_speeds
        if speed <= exam.push_mark
        for a in directions
    ]
    held = exam.held()
    wanted = np.tile([command.default for command in contract.commands], (len(held) + len(kicks), 1))
    wanted[:, [names.index(each) for each in VELOCITY]] = [*held, *[(exam.push_vx, 0.0, 0.0)] * len(kicks)]
    stage, limits = DeployStage(folder, len(wanted)), Limits.of(folder, contract)
    layers = [Safety(contract, limits) for _ in wanted]
    for step in range(125):
        measured = stage.measured
        if step == 75:
            for i, kick in enumerate(kicks):
                stage.push(len(held) + i, kick)
        stage.step(wanted)
        for i, layer in enumerate(layers):
            one = measured.of(i)
            trip = layer.sensed(one, Health(), step * stage.dt) or layer.asked(one, stage.controller.last_targets[i])
            assert trip is None, f"robot {i} at step {step}: {trip}"


# ---- faults of a walking robot: damped at once, reported in one line, no joint beyond its limits

AT = 170  # the step of a fault: the policy walks since step 110
Fault = Callable[[Watched, Controller, Script], None]


def policy_of(change: Callable[[Any], Any]) -> Fault:
    """A network that goes wrong."""

    def fault(robot: Watched, controller: Controller, _: Script) -> None:
        right = controller._network
        controller._network = lambda obs: change(right(obs)) if robot.step >= AT else right(obs)

    return fault


def measured_as(change: Callable[[Watched, Measurement], Measurement]) -> Fault:
    def fault(robot: Watched, _: Controller, __: Script) -> None:
        robot.changed = lambda step, measured: change(robot, measured) if step >= AT else measured

    return fault


def reports(health: Health) -> Fault:
    def fault(robot: Watched, _: Controller, __: Script) -> None:
        robot.health_at = lambda step: health if step >= AT else Health(age_s=0.0, remote=Remote())

    return fault


def frozen(robot: Watched, measured: Measurement) -> Measurement:
    if not hasattr(robot, "still"):
        robot.still = measured  # type: ignore[attr-defined]
    return robot.still  # type: ignore[attr-defined]


def silent(robot: Watched, measured: Measurement) -> Measurement:
    raise RobotError("the newest measurement is 100 ms old: the link is down")


def stopped(robot: Watched, controller: Controller, script: Script) -> None:
    script.stop = AT


def fell(robot: Watched, controller: Controller, script: Script) -> None:
    """By a rule that only the robot can judge."""
    robot.fell = lambda: robot.step >= AT  # type: ignore[method-assign]


def ended(robot: Watched, controller: Controller, script: Script) -> None:
    script.presses[AT] = "select"


FAULTS: dict[str, tuple[Fault, int, str]] = {  # fault, periods until it can be known, the line
    "NaN from the policy": (
        policy_of(lambda actions: np.nan * actions),
        0,
        "the target of FL_hip_joint is not finite: nan",
    ),
    "inf from the policy": (
        policy_of(lambda actions: np.inf * actions),
        0,
        "the target of FL_hip_joint is not finite: nan",
    ),
    # clipped, so that the torque trips: when depends on where the legs are
    "actions a hundred times too large": (policy_of(lambda actions: 100 * actions), 9, "damping: "),
    "NaN from a sensor": (
        measured_as(lambda _, m: replace(m, joint_vel=np.nan * m.joint_vel)),
        0,
        "a measured value is not finite: joint_vel",
    ),
    "an angle that jumps": (
        measured_as(lambda _, m: replace(m, joint_pos=m.joint_pos + 2.0)),
        0,
        "FL_hip_joint is at 2.",
    ),
    "a speed that jumps": (
        measured_as(lambda _, m: replace(m, joint_vel=m.joint_vel + 100.0)),
        0,
        "FL_hip_joint turns at ",
    ),
    "joints in another order": (
        measured_as(lambda _, m: replace(m, joint_pos=np.roll(m.joint_pos, 1))),
        0,
        " beyond its range ",
    ),
    "a frozen state": (measured_as(frozen), 3, "4 measurements in a row are the same"),
    "a silent robot": (measured_as(silent), 0, "the newest measurement is 100 ms old: the link is down"),
    "a stale measurement": (reports(Health(age_s=0.05)), 0, "the newest measurement is 50 ms old, more than 40"),
    "a hot motor": (
        reports(Health(temperatures=np.full(12, 90.0))),
        0,
        "FL_hip_joint has a motor of 90 deg C, more than 85",
    ),
    "an empty battery": (reports(Health(voltage=20.0)), 0, "the battery has 20.0 V, less than 24"),
    "a motor's fault": (
        reports(Health(motor_faults={"FR_calf_joint": "error 0x1"})),
        0,
        "the motor of FR_calf_joint reports a fault",
    ),
    "the remote lost": (reports(Health()), 149, "the remote was not heard for 3.0 s"),
    "an emergency stop": (stopped, 0, "the test"),
    "select": (ended, 0, "select was pressed"),
    "on its back": (measured_as(lambda _, m: replace(m, gravity=-m.gravity)), 0, " degrees, more than 60"),
    "a fall": (fell, 0, "the robot fell"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_damps(name: str, contract: Contract) -> None:
    """In the period in which it can be known; and nothing moves again by itself."""
    fault, periods, text = FAULTS[name]
    robot, controller, said = Watched(GO2, contract, whole=True, hoisted=True), Controller(GO2, contract), []
    source = Script({5: "start", 110: "A"}, command=[0.8, 0.0, 0.0])
    fault(robot, controller, source)
    done, passed = driven(robot, controller, source, (AT + periods + 30) * contract.period, said, voltage=24.0)
    assert passed == ["zero torque", "stand", "policy", "damping"]
    assert robot.done.index("damp") in range(AT, AT + periods + 1)
    first = robot.done.index("damp")
    assert set(robot.done[first:]) == {"damp"}  # nothing resumes by itself
    assert text in said[-1] and said[-1].startswith("damping: ") and "\n" not in said[-1]
    assert len(done.trips) == (0 if name == "select" else 1)
    limits = Limits.of(GO2, contract)
    assert beyond(robot, limits) < limits.position


def test_a_plain_run_raises_what_tripped(contract: Contract) -> None:
    robot = Watched(GO2, contract)
    robot.changed = lambda step, measured: replace(
        measured, joint_vel=measured.joint_vel + (99.0 if step == 20 else 0.0)
    )
    with pytest.raises(
        Tripped, match=r"FL_hip_joint turns at .* rad/s, more than 60.0; the joints are damped"
    ) as error:
        run(robot, Controller(GO2, contract), lambda _: np.zeros(3), 1.0, live=False)
    assert error.value.trip.limit == "speed" and len(robot.done) == 20
    before = robot.fleet.qpos[0, 2]
    for _ in range(50):
        robot.write(contract.default_pose)  # closed: it sinks, whatever is written
    assert robot.fleet.qpos[0, 2] < before - 0.05
