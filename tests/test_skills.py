"""Tasks without commands and their exams: falls, get up, handstand; the same exam in the environment and on an export."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from program import refused, run

from legged_mw import ROOT as REPOSITORY
from legged_mw.deploy import __main__ as program
from legged_mw.deploy.contract import ContractError, read_contract
from legged_mw.deploy.exam import SwitchStage, contract_skill, put_on, run_skill
from legged_mw.deploy.simulated import Fleet
from legged_mw.eval import perform, skills
from legged_mw.eval.perform import machine, on_ground
from legged_mw.eval.skills import ExamGround, ExamRobot, Recording
from legged_mw.sim.model import RobotModel
from legged_mw.skills.drop_states import fallen
from legged_mw.skills.getup import Getup
from legged_mw.skills.handstand import Handstand
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import UserError
from legged_mw.utils.task import load_task

POLICIES, HALF = REPOSITORY / "resources/policies", math.sqrt(0.5)
UPSIDE_DOWN, NOSE_DOWN, NOSE_UP = [0.0, 1.0, 0.0, 0.0], [HALF, 0.0, HALF, 0.0], [HALF, 0.0, -HALF, 0.0]


def make(name: str, **changes: Any) -> Any:
    task = load_task(name)
    for path, value in {"env.num_envs": 4, "domain_rand.enable": False, **changes}.items():
        task.set(path.replace("__", "."), value)
    return task.env_class(task.cfg, "cpu")


@pytest.fixture(scope="module")
def go1() -> Getup:
    return make("go1_getup", falls__states=6)


@pytest.fixture(scope="module")
def robot(go1: Getup) -> ExamRobot:
    return machine(go1)


# ---- falls


def test_falls_are_settled_and_made_again(robot: ExamRobot) -> None:
    """They lie: low, slow, nothing far below the ground; the same seed makes the same, and fewer are the first of more."""
    qpos, qvel = fallen(robot.model, 12, seed=3, seconds=1.0)
    again, _ = fallen(robot.model, 5, seed=3, seconds=1.0)
    np.testing.assert_array_equal(again, qpos[:5])
    assert np.abs(fallen(robot.model, 1, seed=4, seconds=0.1)[0] - qpos[:1]).max() > 0.1
    assert (qpos[:, 2] < 0.24).all() and (qpos[:, 2] > 0.03).all() and np.median(np.abs(qvel)) < 0.1
    np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:7], axis=1), 1.0, atol=1e-9)
    low, high = robot.model.jnt_range[1:].T
    assert (qpos[:, 7:] > low - 0.1).all() and (qpos[:, 7:] < high + 0.1).all()


def test_no_fall_begins_with_an_arm_through_the_body() -> None:
    """Parts that overlap at the drop are pushed out on the wrong side: of these 64 falls 7 were, by 0.35 rad."""
    folder = POLICIES / "g1_getup"
    model = Fleet(folder, read_contract(folder)).model
    qpos, _ = fallen(model, 64, seed=20_000, seconds=1.5)
    low, high = model.jnt_range[1:].T
    assert (qpos[:, 7:] > low - 0.1).all() and (qpos[:, 7:] < high + 0.1).all()


def test_episodes_begin_in_falls(go1: Getup) -> None:
    """Masked worlds only; with the share 0 all stand."""
    before = go1.sim.qpos.clone()
    mask = torch.tensor([True, False, True, True])
    go1.cfg.falls.share = 1.0
    go1.reset_envs(mask)
    known = (go1.sim.qpos[:, None] - go1.fallen_qpos).abs().amax(dim=2).amin(dim=1) == 0.0
    assert known[mask].all() and torch.equal(go1.sim.qpos[1], before[1])
    assert torch.equal(go1.last_dof_vel[mask], go1.dof_vel[mask])  # type: ignore[index]
    go1.cfg.falls.share = 0.0
    go1.reset_envs(mask)
    torch.testing.assert_close(go1.dof_pos[mask], go1.default_dof_pos.expand(3, -1))


def test_a_fall_begins_again_until_the_robot_is_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the end of an episode. World 0 fell and is down, 1 fell and is up, 2 began standing, 3 fell and is broken."""
    env = make("go1_getup", falls__states=8, falls__again=1.0, falls__share=1.0)
    first = env.begun_in.clone()
    assert (first > 0).all()
    env.cfg.falls.share = 0.0
    env.begun_in[2] = 0
    refresh = env.check_termination

    def end() -> None:
        refresh()
        env.up.copy_(torch.tensor([False, True, False, False]))
        env.broken.copy_(torch.tensor([False, False, False, True]))
        env.reset_buf.fill_(True)

    monkeypatch.setattr(env, "check_termination", end)
    env.step(torch.zeros(4, env.num_actions))
    assert env.begun_in.tolist() == [first[0], 0, 0, 0] and not env.fell.any()
    torch.testing.assert_close(env.sim.qpos[0], env.fallen_qpos[first[0] - 1])
    torch.testing.assert_close(env.dof_pos[1:], env.default_dof_pos.expand(3, -1))


def test_rewards_of_getup(go1: Getup) -> None:
    """Standing; upside down; level and low; one joint off by 0.2 rad; and a joint at 3 turns a second."""
    home = torch.tensor([*go1.start_place, 1.0, 0.0, 0.0, 0.0, *go1.robot.pose])
    go1.sim.qpos.copy_(home.expand(4, -1))
    go1.sim.qvel.zero_()
    go1.sim.qpos[1, 3:7] = torch.tensor(UPSIDE_DOWN)
    go1.sim.qpos[2, 2] = 0.1
    go1.sim.qpos[3, 7] += 0.2
    go1.dof_vel[3, 0] = 6.0 * math.pi
    go1._refresh_base()
    still = math.exp(-0.5 * (6.0 * math.pi) ** 2 / 12)
    expected = {
        "upright": [1.0, 0.5 * math.exp(-8.0), 1.0, 1.0],
        "height": [1.0, 0.0, 0.1 / (0.99 * 0.278), 1.0],
        "posture": [1.0, math.exp(-8.0), 1.0, math.exp(-2.0 * 0.04 / 12)],
        "stand_still": [1.0, math.exp(-8.0), 0.0, still],
        "fast_joints": [0.0, 0.0, 0.0, (4.0 * math.pi) ** 2],
    }
    for name, values in expected.items():
        torch.testing.assert_close(
            getattr(go1, f"_reward_{name}")(), torch.tensor(values), atol=1e-5, rtol=1e-5, msg=name
        )
    assert not go1._fallen().any()


def test_power_of_getup(go1: Getup) -> None:
    """At the soft value: nothing. One joint drives with 750 W and one brakes with 300 W. Far beyond: 64."""
    go1.dof_vel.zero_(), go1.torques.zero_()
    go1.dof_vel[0, 0], go1.torques[0, 0] = 10.0, 70.0
    go1.dof_vel[1, :2], go1.torques[1, :2] = torch.tensor([10.0, -6.0]), torch.tensor([75.0, 50.0])
    go1.dof_vel[2, 5], go1.torques[2, 5] = -20.0, 1000.0
    torch.testing.assert_close(go1._reward_power(), torch.tensor([0.0, 0.5**2, 64.0, 0.0]), atol=1e-5, rtol=1e-5)


def test_shock_of_getup_is_the_ground_force() -> None:
    """At rest the weight, in free fall nothing; a stop from 1 m/s within a control step is 1 + 1 / (9.81 dt) weights."""
    env = make("go1_getup", falls__states=4, domain_rand__slope=[], rewards__scales__shock=-1.0)
    env.reset()
    env.com_velocity.zero_(), env.last_com_velocity.zero_()
    env.last_com_velocity[1, 2], env.last_com_velocity[3, 2] = -1.0, -100.0
    env.com_velocity[2, 2] = -9.81 * env.dt
    soft = env.cfg.rewards.soft_acceleration
    stop = 1.0 + 1.0 / (9.81 * env.dt) - soft
    torch.testing.assert_close(env._reward_shock(), torch.tensor([0.0, stop**2, 0.0, 64.0]))
    env._end_step()
    torch.testing.assert_close(env.last_com_velocity, env.com_velocity)
    env.reset_envs(torch.tensor([True, False, True, True]))
    assert not env.last_com_velocity.any()


def test_torques_cost_only_while_it_is_up(go1: Getup) -> None:
    """One joint of twelve at half of its limit; lying it costs next to nothing."""
    go1.reset()
    go1.torques.zero_()
    go1.torques[:, 3] = 0.5 * float(go1.robot.effort_range[3, 1])
    go1.sim.qpos[:, 2], go1.sim.qpos[:, 3:7] = go1.up_height, torch.tensor([1.0, 0.0, 0.0, 0.0])
    go1.sim.qpos[1, 2] = 0.1
    go1.sim.qpos[2, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    go1._refresh_base()
    cost = go1._reward_stand_torques()
    assert cost[0] == pytest.approx(0.25 / 12) and cost[1] == 0.0 and cost[2] < 1e-4


def test_a_cost_of_torques_needs_a_force_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without one a share of it would be 0, and the term silent."""
    free = np.full((12, 2), np.inf) * [-1.0, 1.0]
    monkeypatch.setattr(RobotModel, "effort_range", property(lambda self: free))
    env = make("go1_getup", falls__states=4)
    with pytest.raises(ConfigError, match="rewards.scales.stand_torques is on, but no joint has a force limit"):
        env._reward_stand_torques()
    with pytest.raises(ConfigError, match="rewards.scales.torque_limits is on, but no joint has a force limit"):
        make("go1_getup", falls__states=4, rewards__scales__torque_limits=-1.0)


def test_pull_lifts_and_fades() -> None:
    """On the body that was asked for; a quarter of episodes that end down undo three that end up; it is in a checkpoint."""
    env = make("go1_getup", falls__states=4, falls__pull=0.5, falls__pull_on="FR_hip")
    env._apply_actions()
    lifted = env.sim.xfrc_applied[:, env.robot.id("body", "FR_hip"), :3]
    torch.testing.assert_close(lifted, -0.5 * 9.81 * env.total_mass * env.gravity_dir)  # also on a slope
    assert not env.sim.xfrc_applied[:, env.root_body].any()
    env.pull.level.fill_(0.5)
    everyone, up = torch.ones(4, dtype=torch.bool), torch.tensor([True, True, True, False])
    env.pull.update(everyone, up)
    assert env.training_state()["pull_level"] == 0.5
    env.pull.update(everyone, up | True)
    env.pull.update(~everyone, up)
    assert env.pull.level == pytest.approx(0.5 - env.cfg.falls.pull_fades)
    other = make("go1_getup", falls__states=4, falls__pull=0.5)
    other.load_training_state(env.training_state())
    assert other.pull.level == env.pull.level
    with pytest.raises(
        ConfigError,
        match="falls.pull lifts the root, which perturbation.kick pushes: name another body in falls.pull_on",
    ):
        make("go1_getup", falls__states=4, falls__pull=0.5, perturbation__kick=True)
    with pytest.raises(ConfigError, match="falls.pull_on: no body 'trunck' in .*; did you mean 'trunk'"):
        make("go1_getup", falls__states=4, falls__pull=0.5, falls__pull_on="trunck")


# ---- what an exam makes of a recording


def recording(robot: ExamRobot, steps: int, count: int) -> Recording:
    """Robots that stand."""
    joints = robot.model.nv - 6
    qpos = np.tile(robot.home, (steps, count, 1))
    return Recording(
        qpos, np.zeros((steps, count, 6 + joints)), np.zeros((steps, count, joints)), np.full(count, np.inf)
    )


def test_what_getup_judges(robot: ExamRobot) -> None:
    """Up at once; up after 2 s; too late; down again after 3 s; never; up, but an episode ended."""
    skill = skills.GetupExam(within=3.0)
    seen = recording(robot, skill.steps(robot), 6)
    at = {seconds: round(seconds / robot.dt) for seconds in (2.0, 3.0, 3.1)}
    seen.qpos[: at[2.0], 1, 2] = 0.1
    seen.qpos[: at[3.1], 2, 3:7] = UPSIDE_DOWN
    seen.qpos[at[3.0] :, 3, 2] = 0.1
    seen.qvel[:, 4, 6:] = 1.0
    seen.ended_at[5] = at[2.0]
    seen.torque[: at[2.0] + 1, 1], seen.qvel[: at[2.0], 1, 6] = 23.7, 2.0
    found = skill.judge(robot, seen)
    assert found["stands"] == pytest.approx(4 / 6) and found["stays"] == pytest.approx(2 / 6)
    assert found["median"] == 0.0 and found["slowest"] == 2.0 and found["worst"] == 2
    assert found["energy"] == pytest.approx(2.0 * 2.0 * 23.7 / 4)  # of four that stood, one spent 2 s at 47 W
    result = skill.result(dict.fromkeys(skill.grounds, found))
    assert not result["passed"] and "share that stands in time              0.667" in skill.table(result)
    # 0.99 on the plane
    assert skill.result({name: {**found, "stands": 0.98, "stays": 1.0} for name in skill.grounds})["passed"] is False
    assert skill.result(
        {name: {**found, "stands": 1.0 if name == "plane" else 0.98, "stays": 1.0} for name in skill.grounds}
    )["passed"]


def test_upright_is_by_gravity() -> None:
    """On a slope of 10 degrees a robot that stands along the slope is 10 degrees off, and still up; one that leans 25 is not."""
    env = on_ground(make("go1_getup", falls__states=4), ExamGround(slope=10.0, friction=0.4))
    assert env.robot.physics.geom("floor").friction[0] == 0.4
    expected = torch.tensor([math.sin(math.radians(10.0)), 0.0, -math.cos(math.radians(10.0))])
    torch.testing.assert_close(env.gravity_dir[0], expected, atol=1e-6, rtol=0.0)
    seen = recording(machine(env), 50, 2)
    lean = math.radians(25.0) / 2
    seen.qpos[:, 1, 3:7] = [math.cos(lean), 0.0, math.sin(lean), 0.0]  # nose down, downhill: 35 degrees
    assert skills.standing(machine(env), seen).mean(axis=0).tolist() == [1.0, 0.0]


def test_handstand_rewards_and_judge() -> None:
    """On all fours, nose down, nose up."""
    env: Any = make("go1_handstand", env__num_envs=3)
    env.sim.qpos.copy_(torch.tensor([*env.start_place, 1.0, 0.0, 0.0, 0.0, *env.robot.pose]).expand(3, -1))
    env.sim.qpos[1:, 3:7], env.sim.qpos[1:, 2] = torch.tensor([NOSE_DOWN, NOSE_UP]), 0.6
    env._refresh_base()
    torch.testing.assert_close(env._reward_stand_attitude(), torch.tensor([0.25, 1.0, 0.0]), atol=1e-6, rtol=0.0)
    torch.testing.assert_close(env._reward_stand_height(), torch.tensor([math.exp(0.278 - 0.55), 1.0, 1.0]))
    skill, here = skills.HandstandExam(nose=-1.0, height=0.55, hands=["FR", "FL"]), machine(env)
    seen = recording(here, skill.steps(here), 4)
    seen.qpos[:, :3, 2], seen.qpos[:, :3, 3:7] = 0.6, NOSE_DOWN
    seen.qpos[round(4.0 / here.dt), 1, 3:7] = [1.0, 0.0, 0.0, 0.0]  # at 4 s: 4 s before, 4 s after
    seen.qpos[:, 2, 2] = 0.2  # low: its head is in the ground
    seen.qpos[:, 0, 0] += np.linspace(0.0, 0.8, len(seen.qpos))  # 0.1 m/s
    found = skill.judge(here, seen)
    assert found["holds"] == 0.25 and found["up"] == 0.5 and found["drift"] == pytest.approx(0.5, abs=0.01)
    ends = {env.robot.contact_geoms[i] for i in env.terminating_contacts.tolist()}
    parts = ("hip_1", "hip_2", "thigh_1", "thigh_2", "thigh_3", "calf_1", "calf_2")
    assert ends == {"trunk_box", "trunk_left", "trunk_right"} | {
        f"{leg}_{part}" for leg in ("FR", "FL") for part in parts
    }
    assert isinstance(env, Handstand)


# ---- a task from training to deploy


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Exams of a few robots and of a second."""
    monkeypatch.setattr(skills.GetupExam, "robots", 3)
    monkeypatch.setattr(
        skills.GetupExam, "grounds", {"plane": ExamGround(), "changed": ExamGround(slope=10.0, friction=0.3, load=2.0)}
    )
    monkeypatch.setattr(skills, "GETUP_SETTLING", 0.4)
    monkeypatch.setattr(skills, "GETUP_STAY", 0.2)
    monkeypatch.setattr(perform, "PICTURES", 2)


def test_getup_from_training_to_deploy(tmp_path: Path, small: None) -> None:
    """Training with its exam, the report of --eval with an export's column, and the export alone give one result."""
    flags = ["--task", "go1_getup", "--num_envs", "8", "--device", "cpu", "--max_iterations", "1"]
    sizes = [f"{part}.hidden_dims=[16]" for part in ("actor", "critic")]
    more = [*sizes, "falls.states=4", "runner.exam_interval=1", "runner.num_steps_per_env=8", "exam.within=0.4"]
    result = run("train", tmp_path, *flags, *(word for change in more for word in ("--set", change)))
    assert result.code == 0, result.err
    assert re.search(r"exam after 1 iterations: stands 0\.\d{3}, stays 0\.\d{3}", result.out)
    [folder] = tmp_path.glob("logs/*/*")
    result = run("play", tmp_path, "--task", "go1_getup", "--device", "cpu", "--eval")
    assert result.code == 0, result.err
    assert "falls.share" not in result.out and "share that stands in time" in result.out and "passes: no" in result.out
    here, there = json.loads((folder / "eval/report.json").read_text())["columns"]
    assert there["name"] == "the same, deployed in MuJoCo" and here["exam"]["asked"] == {"kind": "getup", "within": 0.4}
    for name, part in here["exam"]["parts"].items():
        assert part["at_limit"] == pytest.approx(there["exam"]["parts"][name]["at_limit"], abs=5e-3)
    assert (folder / "eval/plane.png").is_file() and "data:image/png" in (folder / "eval/report.html").read_text()
    contract = read_contract(folder / "export")
    assert contract.exam == {"kind": "getup", "within": 0.4} and contract.action.origin == "joints"
    heat = there["exam"].pop("heat")
    assert heat["joints"] == list(contract.joints) and run_skill(folder / "export") == there["exam"]
    line = refused(tmp_path, "play", "--task", "go1_getup", "--device", "cpu", "--eval", "--set", "falls.pull=0.1")
    assert "--eval sets falls.pull itself" in line
    leaning = Fleet(
        folder / "export", contract, 1, threads=1, change=lambda model: put_on(model, ExamGround(slope=10.0))
    )
    np.testing.assert_allclose(
        leaning.read().gravity[0], [math.sin(math.radians(10.0)), 0.0, -math.cos(math.radians(10.0))], atol=1e-9
    )
    check_switch(folder / "export")
    for section, words in (
        ({"kind": "getpu"}, "policy.yaml: no exam 'getpu' in legged_mw/eval/skills.py; did you mean 'getup'?"),
        (
            {"kind": "getup", "wihtin": 3},
            "policy.yaml: exam: no field 'wihtin' in the exam getup; did you mean 'within'?",
        ),
    ):
        with pytest.raises(ContractError, match=re.escape(words)):
            contract_skill(contract.__class__(**{**vars(contract), "exam": section}))


def check_switch(rescuer: Path) -> None:
    """A walker that falls is handed over, and back when it stands; nobody is put back."""
    stage = SwitchStage(POLICIES / "go1_flat", rescuer, 2, command=(0.5, 0.0, 0.0))
    stage.step()
    assert not stage.rescued.any() and not stage.fell().any()
    stage.fleet.qpos[1, 2:7] = [0.1, *UPSIDE_DOWN]
    stage.fleet.refresh()
    stage.measured = stage.fleet.read()
    stage.step()
    assert stage.fell().tolist() == stage.rescued.tolist() == [False, True]
    stage.step()
    assert stage.rescued[1] and not stage.fell().any() and stage.qpos()[1, 2] < 0.2
    assert stage.rescuer.last_actions[1].any() and not stage.controller.last_actions[1].any()
    stage.put(np.tile(stage.fleet.model.key_qpos[0], (2, 1)), np.zeros_like(stage.fleet.qvel))  # as if it got up
    stood = [bool(stage._stood(stage.measured)[1]) for _ in range(25)]
    assert stood == [False] * 24 + [True]  # half a second
    for joints, stands in ((slice(7, 10), True), (slice(7, 19), False)):  # one leg aside; all of them
        qpos = np.tile(stage.fleet.model.key_qpos[0], (2, 1))
        qpos[:, joints] += 0.4
        stage.put(qpos, np.zeros_like(stage.fleet.qvel))
        assert [bool(stage._stood(stage.measured)[1]) for _ in range(25)][-1] is stands
    stage.put(np.tile(stage.fleet.model.key_qpos[0], (2, 1)), np.zeros_like(stage.fleet.qvel))
    stage._stood = lambda measured: np.array([False, True])  # type: ignore[method-assign]
    stage.step()
    assert not stage.rescued[1]
    stage.rescued[1] = True
    for world in (0, 1):  # the walker's, and one that is getting up
        stage.fleet.qvel[world] = math.nan
        stage.step()
        assert stage.fell().tolist() == [world == 0, world == 1] and not stage.rescued[world]
        assert np.isfinite(stage.qpos()).all() and stage.qpos()[world, 2] == stage.fleet.model.key_qpos[0, 2]
    stage.step()
    assert not stage.fell().any() and stage.controller.last_actions.any(axis=1).all()
    with pytest.raises(
        UserError, match="--switch: joints of go1_flat and g1_flat differ, so they cannot drive one robot"
    ):
        SwitchStage(POLICIES / "go1_flat", POLICIES / "g1_flat")
    line = "--switch: rows with sensors of their own of go1_flat and go1_rough_scan differ, .* one robot: \\[\\] and \\['height_scan'\\]"
    with pytest.raises(UserError, match=line):
        SwitchStage(POLICIES / "go1_flat", POLICIES / "go1_rough_scan")


def test_a_g1_that_is_pushed_over_gets_up_and_walks_on() -> None:
    """Its two policies have different gains; each robot has those of the policy that runs."""
    stage = SwitchStage(POLICIES / "g1_flat", POLICIES / "g1_getup", 2, command=(0.5, 0.0, 0.0))
    fell = False
    for step in range(round(6.0 / stage.dt)):
        if step == 50:
            stage.push(1, np.array([0.0, 8.0]))
        stage.step()
        if stage.rescued[1] and not fell:
            fell = True
            stage.step()
            gains = stage.fleet._batch.expand("actuator_gainprm")[:, stage.fleet._actuators, 0]
            np.testing.assert_allclose(gains, [stage.contract.stiffness, stage.rescuer.contract.stiffness])
    assert fell and not stage.rescued.any() and (stage.velocity()[:, 0] > 0.3).all()


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (
            ["go1_flat", "go2_flat"],
            "--switch fall needs two policies: python -m legged_mw.deploy DIR DIR2 --switch fall",
        ),
        (["go1_flat", "--switch", "fall"], "--switch fall needs two policies"),
        (
            ["go1_flat", "go2_flat", "--switch", "fall", "--eval"],
            "--switch is for simulation on flat ground: leave --eval out",
        ),
    ],
)
def test_switch_flags(
    args: list[str], line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["deploy", *args])
    with pytest.raises(SystemExit):
        program.parse()
    assert line in capsys.readouterr().err


@pytest.mark.parametrize("name", ["go2_getup", "go1_footstand", "go2_handstand", "go2_footstand"])
def test_variants_step(name: str) -> None:
    """Those that the suite leaves out, since they are others with other numbers."""
    env = make(name, falls__states=2) if "getup" in name else make(name)
    for _ in range(3):
        obs, rewards, *_ = env.step(torch.randn(4, 12))
        assert obs["state"].shape == (4, 42) and obs["state"].isfinite().all() and rewards.isfinite().all()
    assert env.mirror is not None
