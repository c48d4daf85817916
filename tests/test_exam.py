"""The walking exam: what it asks, that its figures are what they say, and that nothing in it is left to chance."""

from __future__ import annotations

import argparse
import copy
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import yaml
from program import SMALL, run, trained
from tensordict import TensorDict
from torch import Tensor

from legged_mw import ROOT, programs
from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.exam import contract_rules
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.robot_task import RobotTask
from legged_mw.eval import exams, plots, rollout, walking
from legged_mw.eval.exams import EXAMS, find_exam, make_exam, require_exam
from legged_mw.eval.rollout import holding, roll_out
from legged_mw.eval.walking import PEERS, ExamRules, best_of, in_common
from legged_mw.rl.policies import PolicySource
from legged_mw.utils.commands import Command
from legged_mw.utils.config import ConfigError
from legged_mw.utils.task import load_task

SHIPPED = ROOT / "resources/policies/go1_flat"
TRACKED, PUSHED = 22, 6 * 16  # worlds
WORLDS = TRACKED + PUSHED
GO1 = ExamRules.from_config(load_task("go1_flat").cfg)
RANGES = {"lin_vel_x": [-0.5, 1.0], "lin_vel_y": [-0.3, 0.4], "ang_vel_yaw": [-1.0, 0.8]}  # of no robot


def test_commands_are_the_22() -> None:
    assert GO1.commands() == [
        (0, 0, 0),
        *((0.5, 0, 0), (1.0, 0, 0), (1.5, 0, 0), (-0.5, 0, 0), (-1.0, 0, 0)),
        *((0, 0.4, 0), (0, 0.8, 0), (0, -0.4, 0), (0, -0.8, 0)),
        *((0, 0, 0.6), (0, 0, 1.2), (0, 0, -0.6), (0, 0, -1.2)),
        *((1.0, 0.4, 0.6), (1.0, 0.4, -0.6), (1.0, -0.4, 0.6), (1.0, -0.4, -0.6)),
        *((-1.0, 0.4, 0.6), (-1.0, 0.4, -0.6), (-1.0, -0.4, 0.6), (-1.0, -0.4, -0.6)),
    ]


def test_commands_of_another_range() -> None:
    """Thirds of vx, halves of vy and yaw rate, worked out by hand; a range that is not given is the trained one."""
    rules = ExamRules.from_mapping(
        {"ranges": {"lin_vel_x": [-0.5, 1.0]}}, {**RANGES, "lin_vel_x": [-9.0, 9.0], "base_height": [0.2, 0.3]}
    )
    assert rules.commands() == [
        (0, 0, 0),
        *((0.3333, 0, 0), (0.6667, 0, 0), (1.0, 0, 0), (-0.1667, 0, 0), (-0.3333, 0, 0)),
        *((0, 0.2, 0), (0, 0.4, 0), (0, -0.15, 0), (0, -0.3, 0)),
        *((0, 0, 0.4), (0, 0, 0.8), (0, 0, -0.5), (0, 0, -1.0)),
        *((0.6667, 0.2, 0.4), (0.6667, 0.2, -0.5), (0.6667, -0.15, 0.4), (0.6667, -0.15, -0.5)),
        *((-0.3333, 0.2, 0.4), (-0.3333, 0.2, -0.5), (-0.3333, -0.15, 0.4), (-0.3333, -0.15, -0.5)),
    ]
    assert (rules.push_vx, rules.transport_vx) == (0.5, 0.5) and rules.held() == [*rules.commands(), (0.5, 0, 0)]
    assert rules.push_speeds == (0.5, 1, 1.5, 2, 3, 4, 5, 6) and rules.worlds() == 23 + 8 * 16
    assert (rules.marks, rules.marks_of, rules.push_mark, rules.peers) == ((0.06, 0.06, 0.08), "error", 2.0, [])


def test_a_biped_is_asked_what_a_biped_can_do() -> None:
    """Two feet, and a config that is silent: fewer pushes, and marks of the offset; what the config says goes first."""
    biped, quadruped = (ExamRules.from_mapping({}, RANGES, feet) for feet in (2, 4))
    assert biped.push_speeds == (0.5, 1, 1.5, 2, 3) and biped.worlds() == 23 + 5 * 16
    assert (biped.marks, biped.marks_of, biped.push_mark) == ((0.06, 0.06, 0.12), "offset", 1.0)
    assert quadruped == ExamRules.from_mapping({}, RANGES) and quadruped.push_mark == 2.0
    silent = {"push_speeds": [], "push_mark": 0.0, "marks_of": "", "marks": []}
    assert (
        ExamRules.from_mapping(silent, RANGES, 2) == biped
        and ExamRules.from_mapping(biped.to_mapping(), feet=4) == biped
    )
    stated = ExamRules.from_mapping({"push_speeds": [2.0, 4.0], "push_mark": 4.0, "marks_of": "error"}, RANGES, 2)
    assert (stated.push_speeds, stated.push_mark, stated.marks, stated.marks_of) == (
        (2.0, 4.0),
        4.0,
        (0.06, 0.06, 0.08),
        "error",
    )


def test_rules_know_how_many_feet_a_robot_has() -> None:
    """In training by the config, in an export by its contract."""
    biped = load_task(str(ROOT / "examples" / "toy_biped.py"))
    assert ExamRules.from_config(biped.cfg).marks_of == "offset" and GO1.marks_of == "error"
    contract = read_contract(SHIPPED)
    feet = {name: contract.feet[name] for name in list(contract.feet)[:2]}
    assert contract_rules(replace(contract, exam=None, feet=feet)).push_speeds == (0.5, 1, 1.5, 2, 3)


def test_marks_follow_from_the_ranges() -> None:
    def marks(vx: float, yaw: float, **given: Any) -> tuple[float, ...]:
        return ExamRules.from_mapping(given, {**RANGES, "lin_vel_x": [0.0, vx], "ang_vel_yaw": [-yaw, yaw]}).marks

    # vx 0.04 at least; no turning at all
    assert marks(2.0, 2.0) == (0.12, 0.06, 0.2) and marks(0.5, 0.0) == (0.04, 0.06, 0.12)
    assert marks(2.0, 2.0, marks_of="offset") == (0.06, 0.06, 0.12) and marks(2.0, 2.0, marks=[0.1, 0.2, 0.3]) == (
        0.1,
        0.2,
        0.3,
    )


def test_rules_survive_being_written() -> None:
    """In a contract, and in a result; Go1's are what its peer was asked."""
    for asked in (GO1, ExamRules.from_mapping({"marks_of": "offset", "push_mark": 1.0}, RANGES)):
        for text in (json.dumps(asked.to_mapping()), yaml.safe_dump(asked.to_mapping())):
            assert ExamRules.from_mapping(yaml.safe_load(text)) == asked
    assert GO1.peers == PEERS["go1"] and GO1.worlds() == WORLDS


def test_a_peer_that_was_asked_something_else_is_left_out() -> None:
    for given in ({"ranges": RANGES}, {"push_vx": 0.5}, {"transport_vx": 0.5}, {"push_speeds": [1.0, 2.0]}):
        assert ExamRules.from_mapping({**GO1.to_mapping(), **given}).peers == []


def go2(**given: Any) -> ExamRules:
    ranges = {"lin_vel_x": [-2.0, 2.0], "lin_vel_y": [-1.0, 1.0], "ang_vel_yaw": [-2.0, 2.0]}
    return ExamRules.from_mapping({"peer": "go2", **given}, ranges, 4)


def test_peers_are_of_the_robot_and_its_range() -> None:
    """Those that were trained for the same range, or all of them in the range that all were asked; a robot has no other's peer."""
    assert [peer.name for peer in go2().peers] == [
        "go2_rl_gym, CTS (rough)",
        "CTS (rough), later",
        "MoE-CTS (rough, days of training)",
    ]
    assert ExamRules.from_mapping({**GO1.to_mapping(), "peer": "go2"}).peers == []
    g1 = {"lin_vel_x": [-1.0, 1.0], "lin_vel_y": [-0.5, 0.5], "ang_vel_yaw": [-1.0, 1.0]}
    names = [peer.name for peer in ExamRules.from_mapping({"peer": "g1"}, g1, 2).peers]
    assert names == ["MuJoCo Playground", "unitree_rl_mjlab, Jan 2026", "unitree_rl_mjlab, Mar 2026"]
    assert ExamRules.from_mapping({"peer": "g1"}, g1, 4).peers == []  # asked other pushes
    assert [len(PEERS[robot]) for robot in ("go1", "go2", "g1")] == [1, 20, 24]
    for robot, feet in (("go2", 4), ("g1", 2)):
        common = ExamRules.from_mapping({"peer": robot, **in_common(robot)}, g1, feet)
        assert 2 * len(common.peers) == len(PEERS[robot]) and common.push_vx == common.transport_vx == 0.5


def test_the_best_is_figure_by_figure() -> None:
    """Of three Go2 policies, worked out by hand from their lines."""
    best = best_of(go2().peers)
    assert (
        best["error"] == [0.059, 0.057, 0.042]
        and best["worst"] == [0.14, 0.13, 0.07]
        and best["offset"] == [0.054, 0.050, 0.023]
    )
    assert best["drift"] == 0.002 and best["cost_of_transport"] == 0.43
    assert (
        list(best["pushes"].values()) == [1, 1, 1, 1, 1, 15 / 16, 13 / 16, 7 / 16]
        and next(iter(best["pushes"])) == "0.5"
    )
    assert best_of([]) == {}


def test_beating_several_peers_is_beating_each() -> None:
    rules, best = go2(), best_of(go2().peers)
    just = {**best, "error": [0.0589, 0.0569, 0.0419], "cost_of_transport": 0.42, "joint_speed": 0.0}
    assert rules.beats_peer(just) and rules.reached(just) == (1 + 9 + 1 + 8 + 1, 20)
    worse = changed(changed(changed(just, "offset.1", 0.051), "drift", 0.0049), "pushes.6", 0.375)
    assert not rules.beats_peer(worse) and rules.reached(worse) == (18, 20)
    text = walking.table({**worse, "walks": True, "beats_peer": False, "rules": rules.to_mapping()})
    assert (
        text.startswith("asked: vx -2 to 2 m/s, vy -1 to 1 m/s, yaw rate -2 to 2 rad/s\n")
        and "best of 3\n" in text.splitlines()[1] + "\n"
    )
    assert "walks: yes; beats all 3 published policies (at or beyond their best in 18 of 20 figures): no" in text
    assert "half of each policy's highest vx" not in text and "no policy has all best values" in text


def test_the_common_range_in_training_and_in_deploy() -> None:
    """It goes before what the config says of the ranges and speeds; the rest of the section stays."""
    flags = argparse.Namespace(override=[], set=["exam.peer=go2", "exam.push_speeds=[2, 3]"])
    graded = exams.prepare(
        PolicySource(SHIPPED, SHIPPED / "policy.onnx", True), load_task("go1_flat"), flags, common=True
    )
    asked = ExamRules.from_config(graded.task.cfg)
    assert asked.ranges == ((-0.5, 1.0), (-0.4, 0.4), (-1.0, 1.0)) and asked.push_vx == asked.transport_vx == 0.5
    assert asked.push_speeds == (2.0, 3.0) and asked.marks == (0.06, 0.06, 0.12)
    contract = replace(read_contract(SHIPPED), exam={"peer": "go2", "push_vx": 0.8})
    assert contract_rules(contract, common=True) == go2(**in_common("go2")) and contract_rules(contract).push_vx == 0.8
    flags.set = []
    rival = exams.prepare(PolicySource(SHIPPED, SHIPPED / "policy.onnx", True), load_task("go1_flat"), flags)
    rollout.ask_alike([graded.task, rival.task])  # a rival is asked what the first one is, whatever it knows of peers
    assert (
        ExamRules.from_config(rival.task.cfg) == asked and rival.task.cfg.env.num_envs == graded.task.cfg.env.num_envs
    )


def test_an_older_name_of_the_peer_is_read() -> None:
    assert ExamRules.from_mapping({**GO1.to_mapping(), "peer": "playground_go1"}) == GO1


@pytest.mark.parametrize(
    ("given", "line"),
    [
        (
            {"ranges": {"base_height": [0.2, 0.3]}},
            "exam.ranges: no command 'base_height' in the walking exam; there are: lin_vel_x, ",
        ),
        (
            {"ranges": {"lin_vel_x": [1.0, 0.0]}},
            "exam.ranges: lin_vel_x is [1.0, 0.0]; it must be two numbers, the lower first",
        ),
        ({"push_speeds": [0.0, 2.0]}, "exam.push_speeds is [0.0, 2.0]; it must be one or more numbers above zero"),
        ({"push_speeds": [1.0]}, "exam.push_mark is 2; it must be one of exam.push_speeds, [1.0]"),
        ({"marks": [0.1]}, "exam.marks is [0.1]; it must be three numbers, or an empty list"),
        ({"peer": "go11"}, "exam.peer: no robot 'go11' in resources/peers.yaml; did you mean 'go1'?"),
    ],
)
def test_rules_that_cannot_be_applied(given: dict[str, Any], line: str) -> None:
    with pytest.raises(ConfigError) as error:
        ExamRules.from_mapping(given, RANGES)
    assert line in str(error.value)


def test_rules_of_an_export() -> None:
    """The shipped policy's contract says what its task's config says; one of an older export follows from its ranges."""
    contract = read_contract(SHIPPED)
    assert contract_rules(contract) == GO1
    trained = {each.name: (each.low, each.high) for each in contract.commands}
    assert contract_rules(replace(contract, exam=None)) == ExamRules.from_mapping({}, trained)
    assert list(trained) == list(RANGES)


# ---- which exam grades a task


class Pose(RobotTask):
    """Has no commands, and nothing that grades it."""


def test_a_task_without_an_exam() -> None:
    task = load_task("go1_flat")
    assert find_exam(task) is require_exam(task) is EXAMS["walking"]
    task.env_class = Pose
    task.exam = Pose.exam  # as the loader does
    assert find_exam(task) is None and make_exam(task, None) is None
    with pytest.raises(ConfigError):
        require_exam(task)
    task.exam = "walkin"
    with pytest.raises(ConfigError):
        find_exam(task)


def test_prepare_leaves_nothing_to_chance() -> None:
    """Whatever a task trains with is switched off."""
    task = load_task("go1_flat")
    for path in (
        "init_state.pos_xy_range",
        "init_state.yaw_range",
        "init_state.lin_vel_range",
        "init_state.ang_vel_range",
        "noise.level",
    ):
        task.set(path, 3.0)
    task.set("perturbation.kick", True)
    task.set("env.episode_length_s", 1.0)
    rollout.prepare(task)
    cfg = task.cfg
    init = cfg.init_state
    assert (init.pos_xy_range, init.yaw_range, init.lin_vel_range, init.ang_vel_range, cfg.noise.level) == (
        0,
        0,
        0,
        0,
        0,
    )
    assert cfg.perturbation.kick is False and cfg.commands.resampling_time == 0
    assert cfg.env.episode_length_s > walking.EXAM_SECONDS and cfg.env.num_envs == WORLDS


# ---- the arithmetic, with a made-up environment whose figures are known


class FakeRobot:
    """Stands in for LeggedRobot: every world does exactly what the script says."""

    def __init__(
        self, script: Callable[[FakeRobot, int], None], falls: dict[int, list[int]] | None = None, **asked: Any
    ) -> None:
        task = load_task("go1_flat")
        for name, value in asked.items():
            task.set(f"exam.{name}", value)
        self.cfg = task.cfg
        self.num_envs = worlds = ExamRules.from_config(task.cfg).worlds()
        self.device, self.dt, self.total_mass = "cpu", 0.02, 10.0
        self.sim = SimpleNamespace(overflow_report=lambda: "")
        self.script, self.falls, self.time = script, falls or {}, 0
        self.command_table = tuple(Command(name, -1.5, 1.5) for name in RANGES)
        self.root_pos, self.root_lin_vel = torch.zeros(worlds, 3), torch.zeros(worlds, 3)
        self.commands = torch.full((worlds, 3), math.nan)  # the exam must set all
        self.base_lin_vel, self.base_ang_vel = torch.zeros(worlds, 3), torch.zeros(worlds, 3)
        self.torques, self.dof_vel = torch.zeros(worlds, 12), torch.zeros(worlds, 12)
        self.shown: Tensor | None = None
        self.jumps: list[Tensor] = []
        self.actions: list[Tensor] = []
        script(self, 0)

    def reset(self) -> TensorDict:
        return self.get_observations()

    def first_observations(self) -> TensorDict:
        self.shown = self.commands.clone()
        return self.get_observations()

    def get_observations(self) -> TensorDict:
        shown = torch.zeros(self.num_envs, 3) if self.shown is None else self.shown
        return TensorDict({"state": shown.clone()}, batch_size=[self.num_envs])

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        self.actions.append(actions.clone())
        self.jumps.append(self.root_lin_vel[:, :2].clone())
        self.root_lin_vel.zero_()
        dones = torch.zeros(self.num_envs, dtype=torch.bool)
        dones[self.falls.get(self.time, [])] = True
        self.time += 1
        self.script(self, self.time)
        return self.get_observations(), torch.zeros(self.num_envs), dones, {}


def follow(env: FakeRobot, step: int) -> None:
    """Every world does as commanded."""
    commands = torch.nan_to_num(env.commands)
    env.base_lin_vel[:, :2], env.base_ang_vel[:, 2] = commands[:, :2], commands[:, 2]


def grade(env: Any, policy: Callable[[TensorDict], Tensor] | None = None) -> dict[str, Any]:
    return rollout.run_exam(env, policy or (lambda obs: torch.zeros(len(obs), 12)))


def test_worlds_are_commanded_and_the_policy_sees_it() -> None:
    seen = []

    def policy(obs: TensorDict) -> Tensor:
        seen.append(obs["state"].clone())
        return torch.full((WORLDS, 12), float(len(seen)))

    env = FakeRobot(follow)
    grade(env, policy)
    wanted = torch.tensor([*GO1.commands(), *[(0.8, 0.0, 0.0)] * PUSHED])
    assert torch.equal(env.commands, wanted) and len(seen) == 500
    assert all(torch.equal(obs, wanted) for obs in seen)
    # each acted upon once, in order
    assert [float(action[0, 0]) for action in env.actions] == [float(i) for i in range(1, 501)]


def test_pushes() -> None:
    """World 16 s + k after the tracked ones jumps by s + 1 m/s at 22.5 k degrees, at step 150 + k, after that step's action."""
    env = FakeRobot(follow)

    def policy(obs: TensorDict) -> Tensor:
        assert not env.root_lin_vel.any()  # it does not see the push coming
        return torch.zeros(WORLDS, 12)

    grade(env, policy)
    expected = torch.zeros(500, WORLDS, 2)
    for size in range(6):
        for k in range(16):
            angle = math.radians(22.5 * k)
            expected[150 + k, TRACKED + 16 * size + k] = (size + 1) * torch.tensor([math.cos(angle), math.sin(angle)])
    torch.testing.assert_close(torch.stack(env.jumps), expected, atol=1e-5, rtol=0)


def test_errors_are_means_over_the_counted_time() -> None:
    """The first 2 s are dropped; then world i is off by 0.001 i, to either side in turn."""

    def script(env: FakeRobot, step: int) -> None:
        follow(env, step)
        if step < 100:
            env.base_lin_vel += 5.0
        else:
            off = 0.001 * torch.arange(WORLDS) * (-1) ** step
            env.base_lin_vel[:, 0] += off
            env.base_lin_vel[:, 1] += 2 * off
            env.base_ang_vel[:, 2] += 3 * off

    result = grade(FakeRobot(script))
    assert result["error"] == pytest.approx([0.0105, 0.021, 0.0315], abs=2e-5)  # the mean of 0 .. 21 is 10.5
    assert result["worst"] == pytest.approx([0.021, 0.042, 0.063], abs=2e-5)
    for i, (row, command) in enumerate(zip(result["commands"], GO1.commands(), strict=True)):
        assert row["command"] == list(command) and row["fell"] is False
        assert row["error"] == pytest.approx([0.001 * i, 0.002 * i, 0.003 * i], abs=2e-5)


def test_drift_joint_speed_and_cost_of_transport() -> None:
    """Standing at sqrt(0.3^2 + 0.4^2) m from where it stood at 2 s; 72 W for 8 s at 0.9 m/s and 10 kg."""

    def script(env: FakeRobot, step: int) -> None:
        follow(env, step)
        env.root_pos[0, :2] = (
            torch.tensor([7.0, 7.0])
            if step < 100
            else torch.tensor([1.0, 2.0]) + (step - 100) / 400 * torch.tensor([0.3, 0.4])
        )
        env.root_pos[2, 0] = 0.9 * 0.02 * step
        env.torques[2], env.dof_vel[2] = 2.0, 3.0 if step % 2 else -3.0  # braking costs too
        if step < 100:
            env.torques[2] = 50.0
        env.dof_vel[0] = 9.0 if step < 450 else torch.tensor([0.2, -0.4] * 6)

    result = grade(FakeRobot(script))
    assert result["drift"] == pytest.approx(0.5, abs=1e-5)
    assert result["joint_speed"] == pytest.approx(0.3, abs=1e-5)
    assert result["cost_of_transport"] == pytest.approx(72 * 8 / (10 * 9.81 * 0.9 * 8), rel=1e-4)


def test_cost_of_transport_at_a_command_of_its_own() -> None:
    """At 0.75 m/s, which is none of the 22: a world more, whose fall is none of theirs. Fewer pushes, so that the worlds suffice."""

    def script(env: FakeRobot, step: int) -> None:
        follow(env, step)
        env.root_pos[22, 0], env.torques[22], env.dof_vel[22] = 0.75 * 0.02 * step, 1.0, 2.0

    asked = {"transport_vx": 0.75, "push_speeds": [1.0, 2.0]}
    result = grade(FakeRobot(script, {5: [3]}, **asked))
    assert (
        result["cost_of_transport"] == pytest.approx(12 * 2.0 / (10 * 9.81 * 0.75), rel=1e-4)
        and "beats_peer" not in result
    )
    assert result["falls"] == 1 and len(result["commands"]) == 22 and result["pushes"] == {"1": 1.0, "2": 1.0}
    text = walking.table(result)
    assert "cost of transport at 0.75 m/s" in text and "peer" not in text and text.endswith("walks: no")
    fallen = grade(FakeRobot(script, {5: [22]}, **asked))
    assert (
        fallen["falls"] == 0
        and fallen["cost_of_transport"] is None
        and "cost of transport at 0.75 m/s         none" in walking.table(fallen)
    )


def test_offsets_are_what_remains_of_the_mean_velocity() -> None:
    """A robot sways by 0.2 m/s about 0.05 m/s too much: too far off step by step, near enough on average."""

    def script(env: FakeRobot, step: int) -> None:
        follow(env, step)
        env.base_lin_vel[:, 0] += 0.05 + 0.2 * (-1) ** step

    strict, mild = grade(FakeRobot(script)), grade(FakeRobot(script, marks_of="offset"))
    assert strict["error"] == mild["error"] == pytest.approx([0.2, 0, 0], abs=1e-4)
    assert strict["offset"] == mild["offset"] == pytest.approx([0.05, 0, 0], abs=1e-4)
    assert mild["commands"][4]["offset"] == pytest.approx([0.05, 0, 0], abs=1e-4)
    assert (strict["walks"], mild["walks"]) == (False, True)
    assert "of the mean velocity" not in walking.table(strict)
    assert walking.table(mild).count("  of the mean velocity               0.0") == 3


def test_further_commands_stay_at_their_default() -> None:
    seen = []

    def policy(obs: TensorDict) -> Tensor:
        seen.append(obs["state"].clone())
        return torch.zeros(WORLDS, 12)

    env = FakeRobot(follow)
    env.command_table = (*env.command_table, Command("base_height", 0.2, 0.3, default=0.28))
    env.commands = torch.full((WORLDS, 4), math.nan)
    assert grade(env, policy)["error"] == [0, 0, 0]
    assert (
        all(torch.equal(obs[:, :3], seen[0][:, :3]) and (obs[:, 3] == 0.28).all() for obs in seen) and len(seen) == 500
    )


def test_a_task_without_commands_can_be_rolled_out() -> None:
    env = FakeRobot(lambda env, step: None)
    env.command_table = ()
    del env.commands
    env.first_observations = env.get_observations
    record = roll_out(
        env, lambda obs: torch.zeros(WORLDS, 12), [holding(())] * WORLDS, 5, {"position": lambda env: env.root_pos}
    )
    assert record.commands.shape == (5, WORLDS, 0) and record.signals["position"].shape == (5, WORLDS, 3)


def test_falls() -> None:
    """A command at which it fell has the error of standing still, in the means and as the worst; what falls again counts once."""

    def script(env: FakeRobot, step: int) -> None:
        follow(env, step)
        env.base_lin_vel[3] += 1.0

    result = grade(FakeRobot(script, {120: [3, 7], 300: [3]}))
    assert result["falls"] == 2 and [i for i, row in enumerate(result["commands"]) if row["fell"]] == [3, 7]
    assert GO1.commands()[3] == (1.5, 0, 0) and GO1.commands()[7] == (0, 0.8, 0)
    assert (
        result["error"] == result["offset"] == pytest.approx([1.5 / 22, 0.8 / 22, 0], abs=1e-5)
        and result["walks"] is False
    )
    assert result["worst"] == [1.5, 0.8, 0] and result["commands"][7]["error"] == [0, 0.8, 0]
    assert grade(FakeRobot(script))["worst"] == pytest.approx([1, 1, 0])
    lying = grade(FakeRobot(follow, {9: list(range(TRACKED))}))
    assert lying["falls"] == 22 and lying["worst"] == [1.5, 0.8, 1.2] and lying["drift"] is None
    assert "error vx [m/s]                       0.568" in walking.table(
        lying
    )  # (0.5 + 1 + 1.5 + 0.5 + 1 + 8 x 1) / 22


def test_a_push_is_survived_if_it_stands_until_step_300() -> None:
    def world(speed: int, k: int) -> int:
        return TRACKED + 16 * (speed - 1) + k

    falls = {
        160: [world(6, k) for k in range(16)],
        299: [world(5, 0), world(5, 1)],
        300: [world(4, 3)],
        301: [world(3, 3), world(2, 15)],  # too late to count
        20: [world(1, 9)],  # before its push: it did not survive either
    }
    result = grade(FakeRobot(follow, falls))
    assert result["pushes"] == {"1": 0.9375, "2": 1.0, "3": 1.0, "4": 0.9375, "5": 0.875, "6": 0.0}
    assert result["falls"] == 0 and result["walks"] is True


# ---- verdicts

WALKS: dict[str, Any] = {
    "falls": 0,
    "error": [0.06, 0.06, 0.12],
    "offset": [9.0] * 3,
    "pushes": {"1": 0.5, "2": 1.0, "3": 0.0, "4": 0.0, "5": 0.0, "6": 0.0},
}
BEATS: dict[str, Any] = {
    "falls": 0,
    "error": [0.0239, 0.0309, 0.0839],
    "worst": [0.042, 0.063, 0.357],
    "drift": 0.005,
    "pushes": {"1": 1.0, "2": 1.0, "3": 1.0, "4": 0.81, "5": 0.38, "6": 0.13},
    "cost_of_transport": 0.859,
}


def changed(result: dict[str, Any], path: str, value: float) -> dict[str, Any]:
    result = copy.deepcopy(result)
    name, _, key = path.partition(".")
    if key:
        result[name][int(key) if isinstance(result[name], list) else key] = value
    else:
        result[name] = value
    return result


def test_walks_at_the_threshold() -> None:
    assert GO1.walks(WALKS)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("falls", 1),
        ("error.0", 0.0601),
        ("error.1", 0.0601),
        ("error.2", 0.1201),
        ("pushes.2", 0.9375),
        ("error.0", math.inf),
    ],
)
def test_does_not_walk_past_it(path: str, value: float) -> None:
    assert not GO1.walks(changed(WALKS, path, value))


def test_beats_the_peer_by_a_little() -> None:
    assert GO1.beats_peer(BEATS)
    assert GO1.beats_peer(changed(BEATS, "pushes.6", 1.0)) and GO1.beats_peer(changed(BEATS, "drift", 0.0))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        # as good is not better
        *(("error.0", 0.024), ("error.1", 0.031), ("error.2", 0.084), ("cost_of_transport", 0.86)),
        *(("worst.0", 0.0421), ("worst.1", 0.0631), ("worst.2", 0.3571), ("drift", 0.0051), ("falls", 1)),
        *(
            ("pushes.1", 0.9375),
            ("pushes.2", 0.9375),
            ("pushes.3", 0.9375),
            ("pushes.4", 0.75),
            ("pushes.5", 0.375),
            ("pushes.6", 0.125),
        ),
    ],
)
def test_does_not_beat_the_peer(path: str, value: float) -> None:
    assert not GO1.beats_peer(changed(BEATS, path, value))


def test_table_names_every_figure() -> None:
    result = grade(FakeRobot(follow))
    text = walking.table({**result, "drift": 0.1234, "cost_of_transport": 4.56, "joint_speed": 0.789})
    assert all(
        part in text for part in ("0.1234", "4.56", "0.789", "6 m/s", "0.0007", "walks: yes; beats the peer: no")
    )


# ---- the real environment


@pytest.fixture(scope="module")
def standing() -> tuple[dict[str, Any], Tensor]:
    """Zero action, which stands in the default pose: the result, and qvel (200, N, 18) as the policy saw it."""
    task = load_task("go1_flat")
    rollout.prepare(task)
    env = LeggedRobot(task.cfg, "cpu")
    seen = []

    def policy(obs: TensorDict) -> Tensor:
        seen.append(env.sim.qvel.clone())
        return torch.zeros(WORLDS, 12)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollout, "EXAM_SECONDS", 4.0)
        patch.setattr(rollout, "PUSH_AT", 0.6)
        return rollout.run_exam(env, policy), torch.stack(seen)


def test_standing_still(standing: tuple[dict[str, Any], Tensor]) -> None:
    result, _ = standing
    assert result["falls"] == 0 and result["walks"] is False and result["beats_peer"] is False
    assert all(error < 0.01 for error in result["commands"][0]["error"])  # of the command to stand
    for row in result["commands"]:  # of any other it is the command itself
        assert row["error"] == pytest.approx([abs(v) for v in row["command"]], abs=0.01)
    assert result["worst"] == pytest.approx([1.5, 0.8, 1.2], abs=0.01)
    assert result["drift"] < 0.05 and result["joint_speed"] < 0.05


def test_real_pushes_move_the_robot_and_throw_it(standing: tuple[dict[str, Any], Tensor]) -> None:
    result, qvel = standing
    shares = list(result["pushes"].values())
    assert shares[-1] == 0.0 and shares[0] <= 1.0 and shares == sorted(shares, reverse=True)
    before, after = qvel[30, TRACKED:, :2].view(6, 16, 2), qvel[31, TRACKED:, :2].view(6, 16, 2)
    jump = (after - before)[:, 0, 0]  # k = 0: forward in the world; a foot on the ground takes a part within the step
    assert (jump > 0.5 * torch.arange(1, 7)).all() and (jump < 1.1 * torch.arange(1, 7)).all()
    assert ((after - before)[:, 1:].norm(dim=2) < 0.1).all()  # the others wait for their step
    assert torch.equal(qvel[:30, 0], qvel[:30, 1])  # until then all worlds are the same: nothing is drawn


def test_two_exams_are_the_same_exam(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the seed, with a policy that answers to every observation."""
    monkeypatch.setattr(rollout, "EXAM_SECONDS", 2.4)
    monkeypatch.setattr(rollout, "PUSH_AT", 0.6)
    mix = torch.randn(48, 12, generator=torch.Generator().manual_seed(0))
    results = []
    for seed in (1, 2):
        task = load_task("go1_flat")
        task.set("perturbation.kick", True)  # a task that kicks while it trains
        rollout.prepare(task)
        torch.manual_seed(seed)
        env = LeggedRobot(task.cfg, "cpu")
        results.append(rollout.run_exam(env, lambda obs: 0.3 * torch.sin(obs["state"] @ mix)))
        for row in results[-1]["commands"]:
            if row["fell"]:
                row["error"] = "not graded"  # from the fall on, the world follows a new command, and that one is drawn
    assert results[0] == results[1]
    assert results[0]["commands"][0]["error"][0] > 0.01  # it did move


def test_eval_from_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The table is printed, the figures go into the run folder; a user's own override still counts, the exam's worlds do not move."""
    for place in (rollout, walking):  # by the environment, and by the export
        monkeypatch.setattr(place, "EXAM_SECONDS", 2.1)
    monkeypatch.setattr(rollout, "GRID", (3, 3, 3))
    monkeypatch.setattr(plots, "sections", lambda *_: [])  # drawn in test_report
    folder = trained(tmp_path, "--max_iterations", "1")
    result = run(
        "play", tmp_path, *SMALL[:2], "--device", "cpu", "--eval", "--no_hard", "--set", "terrain.friction=0.4"
    )
    assert result.code == 0, result.err
    assert "terrain.friction: 0.6 -> 0.4" in result.out and "noise.level: 1.0 -> 0.0" in result.out
    assert "falls in 22 commands" in result.out and "walks: no; beats the peer: no" in result.out
    saved, deployed = json.loads((folder / "eval/report.json").read_text())["columns"]
    assert deployed["name"] == "the same, deployed in MuJoCo" and deployed["exam"]["error"] == pytest.approx(
        saved["exam"]["error"], abs=0.01
    )
    about, graded = saved["about"], saved["exam"]
    assert (
        about["policy"].endswith(f"{folder.name}/model_1.pt")
        and about["engine"] == "mujoco"
        and about["device"] == "cpu"
    )
    assert len(graded["commands"]) == TRACKED and graded["walks"] is False
    assert about["overrides"]["noise.level"] == 0.0 and about["overrides"]["terrain.friction"] == 0.4
    assert folder.name in (folder / "eval/report.html").read_text(encoding="utf-8")


def test_ranges_from_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They scale the commands; the peer was asked others and is not spoken of."""
    monkeypatch.setattr(rollout, "EXAM_SECONDS", 2.1)
    monkeypatch.setattr(rollout, "GRID", (3, 3, 3))
    monkeypatch.setattr(programs, "grade_export", lambda *_: [])
    monkeypatch.setattr(plots, "sections", lambda *_: [])
    folder = trained(tmp_path, "--max_iterations", "1")
    start = [*SMALL[:2], "--device", "cpu", "--eval", "--no_hard"]
    result = run("play", tmp_path, *start, "--set", "exam.ranges={lin_vel_x: [0, 0.9]}")
    assert result.code == 0, result.err
    assert result.out.count("walks: no\n") == 1 and "peer" not in result.out
    [column] = json.loads((folder / "eval/report.json").read_text())["columns"]
    assert [row["command"] for row in column["exam"]["commands"]][:6] == [[v, 0, 0] for v in (0, 0.3, 0.6, 0.9, 0, 0)]
    assert column["exam"]["commands"][-1]["command"] == [0, -0.4, -0.6] and "beats_peer" not in column["exam"]
