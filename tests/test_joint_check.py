"""The joint check: what it finds on a right robot, on wrong ones, and how it ends."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from drivers import Script, Watched, beyond

from legged_mw.deploy import __main__ as program
from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.drive import LIFT
from legged_mw.deploy.joint_check import STEP, JointCheck
from legged_mw.deploy.robot import Floats, Robot
from legged_mw.deploy.runner import Summary, run
from legged_mw.deploy.safety import Limits, Safety
from legged_mw.deploy.states import SOFT
from legged_mw.unitree.faults import parse_faults
from tests.wires import POLICIES, pair
from tests.wires import domain as domain

GO2 = POLICIES / "go2_flat"
CONTRACT = read_contract(GO2)
LIMITS = Limits.of(GO2, CONTRACT)
FL_HIP, FL_THIGH, _, FR_HIP, FR_THIGH, _, _, RL_THIGH, _, _, _, RR_CALF = range(12)


class Wired(Watched):
    """A hanging Go2 whose motors get other targets than they should, by ``wrong(targets, pose)``; keeps what was written."""

    def __init__(self, wrong: Callable[[Floats, Floats], Floats] | None = None) -> None:
        super().__init__(GO2, CONTRACT, whole=True, hoisted=True, lift=LIFT)
        self.wrong, self.pose, self.written = wrong, np.zeros(0), list[tuple[Floats, Floats]]()

    def write(self, targets: Floats, *, stiffness: Floats | None = None, damping: Floats | None = None) -> None:
        assert stiffness is not None
        self.pose = self.pose if self.written else targets.copy()
        self.written.append((targets.copy(), stiffness.copy()))
        super().write(
            self.wrong(targets.copy(), self.pose) if self.wrong else targets, stiffness=stiffness, damping=damping
        )


def checked(robot: Robot, source: Script | None = None, safety: Safety | None = None) -> tuple[JointCheck, Summary]:
    """The check of a robot that has hung for 2 s, as fast as it goes."""
    controller, safety = Controller(GO2, CONTRACT), safety or Safety(CONTRACT, LIMITS)
    check = JointCheck(controller, [source or Script({100: "start"})], lambda _: None, robot, safety.limits)
    return check, run(robot, controller, lambda _: np.zeros(0), 120.0, live=False, safety=safety, states=check)


def verdicts(check: JointCheck) -> dict[str, str]:
    """Those that are not right, by joint."""
    return {check.joints[row.joint]: row.verdict for row in check.rows if row.verdict != "right"}


def test_a_right_robot_is_right() -> None:
    """Each joint moves by about what is asked and comes back, from a tenth of its stiffness, the others held; then all are damped."""
    robot = Wired()
    check, done = checked(robot)
    assert check.right and check.over and not done.trips and [row.joint for row in check.rows] == list(range(12))
    assert check.report.endswith("12 of 12 joints checked; none is wrong")
    assert all(0.07 < row.moved[row.joint] < 0.13 and row.asked == STEP for row in check.rows)
    targets, gains = (np.array(each) for each in zip(*robot.written, strict=True))
    assert np.abs(targets - targets[0]).max() < STEP + 1e-9 and np.abs(np.diff(targets, axis=0)).max() < 0.01
    assert ((np.abs(targets - targets[0]) > 1e-9).sum(axis=1) <= 1).all()  # one joint at a time
    begins = [int(np.argmax(targets[:, joint] != targets[0, joint])) for joint in range(12)]
    assert all(
        gains[begin, joint] == pytest.approx(SOFT * CONTRACT.stiffness[joint]) for joint, begin in enumerate(begins)
    )
    assert all(
        (np.delete(gains[begin] / CONTRACT.stiffness, joint) > 0.999).all() for joint, begin in enumerate(begins)
    )
    assert beyond(robot, LIMITS) < 0.02 and robot.done[-1] == "damp"
    assert np.abs(robot.joints[-1] - robot.joints[105]).max() < 0.05


def test_wrong_joints_are_named() -> None:
    """Two that are swapped, one turned, one stuck, one that goes too far; each is said in its line of the table."""

    def wrong(targets: Floats, pose: Floats) -> Floats:
        moved = targets - pose
        moved[[FL_HIP, FR_HIP]] = moved[[FR_HIP, FL_HIP]]
        return pose + moved * np.select(
            [np.arange(12) == each for each in (RL_THIGH, RR_CALF, FR_THIGH)], [-1.0, 0.0, 2.5], 1.0
        )

    check, _ = checked(Wired(wrong))
    assert verdicts(check) == {
        "FL_hip_joint": "WRONG JOINT: FR_hip_joint moved in its place",
        "FR_hip_joint": "WRONG JOINT: FL_hip_joint moved in its place",
        "FR_thigh_joint": "TOO FAR",
        "RL_thigh_joint": "WRONG SIGN: it turned the other way",
        "RR_calf_joint": "STUCK: it did not move",
    }
    lines = check.report.strip().splitlines()
    assert lines[4].startswith("FR_hip_joint       -  +0.10 ") and lines[4].endswith(
        "  WRONG JOINT: FL_hip_joint moved in its place"
    )
    assert (
        lines[-1].endswith("wrong: FL_hip_joint, FR_hip_joint, FR_thigh_joint, RL_thigh_joint, RR_calf_joint")
        and not check.right
    )


def test_joints_in_another_order_end_it() -> None:
    """Targets by place, not by name: holding moves joints, and the check ends before the first one is asked."""
    check, _ = checked(Wired(lambda targets, _: np.roll(targets, 1)))
    assert check.over and not check.rows and not check.right
    assert "joint was held where it was and went " in check.note and "rad: WRONG JOINT or WRONG SIGN" in check.note


@pytest.mark.parametrize(
    ("source", "why"),
    [
        (Script({50: "select", 60: "start", 100: "start", 280: "select"}), "select was pressed"),
        (Script({100: "start"}, stop=280), "the test"),
    ],
)
def test_a_person_ends_it(source: Script, why: str) -> None:
    """Before it has begun, select only damps."""
    robot = Wired()
    check, _ = checked(robot, source)
    assert check.over and robot.done[-1] == "damp" and "write" not in robot.done[280:]
    assert check.report.endswith(f"0 of 12 joints checked; ended early: {why}, while FL_hip_joint goes +0.10 rad")


@pytest.mark.parametrize(
    ("fault", "found"),
    [
        (
            "joint_sign=FL_thigh_joint",
            {"FL_thigh_joint": "WRONG SIGN OR JOINT: the body did not tilt as this joint tilts it"},
        ),
        ("joint_order=1", {}),
    ],
)
def test_over_the_wire(fault: str, found: dict[str, str], domain: int) -> None:
    """A motor that turns the other way with its encoder shows by the tilt; another order by angles that no such joint can have."""
    both = pair("go2_flat", domain, hoist=True, lift=LIFT)
    sim, robot = both.sim, both.robot
    parse_faults([fault], CONTRACT.joints)[0].begin(sim.faults)
    send = robot._send

    def sent(*given: Any, **parts: Any) -> None:
        send(*given, **parts)
        both.period()

    robot._send = sent  # type: ignore[method-assign]
    check, done = checked(robot, Script({100: "start"}, stop=720), both.safety)
    assert verdicts(check) == found and not check.right and not sim.acted["kp"].any() and sim.acted["kd"].all()
    if found:
        assert len(check.rows) == 3 and sim.record.beyond < 0.1
        # it hangs at its end: the other way
        assert check.report.strip().splitlines()[3].split()[:3] == ["FL_calf_joint", "5", "-0.10"]
    else:
        assert done.trips[0].limit == "position" and "beyond its range" in check.report.strip().splitlines()[-1]


def test_the_program_ends_with_code_1(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody started it."""
    monkeypatch.setattr(
        "sys.argv", ["deploy", str(GO2), "--check_joints", "--log", "off", "--time", "0.2s", "--limit", "late=off"]
    )
    with pytest.raises(SystemExit) as ended:
        program.main()
    assert ended.value.code == 1 and "0 of 12 joints checked; ended early: start: joint check" in capfd.readouterr().out
