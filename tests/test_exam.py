"""The walking exam: what it asks, that its figures are what they say, and that nothing in it is left to chance."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from program import SMALL, refused, run, trained
from tensordict import TensorDict
from torch import Tensor

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval import exam, rules
from legged_mw.utils.task import load_task

TRACKED, KICKED = 22, 6 * 16  # worlds
WORLDS = TRACKED + KICKED


def test_commands_are_the_22() -> None:
    assert rules.commands() == [
        (0, 0, 0),
        *((0.5, 0, 0), (1.0, 0, 0), (1.5, 0, 0), (-0.5, 0, 0), (-1.0, 0, 0)),
        *((0, 0.4, 0), (0, 0.8, 0), (0, -0.4, 0), (0, -0.8, 0)),
        *((0, 0, 0.6), (0, 0, 1.2), (0, 0, -0.6), (0, 0, -1.2)),
        *((1.0, 0.4, 0.6), (1.0, 0.4, -0.6), (1.0, -0.4, 0.6), (1.0, -0.4, -0.6)),
        *((-1.0, 0.4, 0.6), (-1.0, 0.4, -0.6), (-1.0, -0.4, 0.6), (-1.0, -0.4, -0.6)),
    ]


def test_prepare_leaves_nothing_to_chance() -> None:
    """Whatever a task trains with is switched off."""
    task = load_task("go1_flat")
    for path in ("init_state.pos_xy_range", "init_state.yaw_range", "init_state.lin_vel_range", "init_state.ang_vel_range", "noise.level"):
        task.set(path, 3.0)
    task.set("perturbation.enable", True)
    task.set("env.episode_length_s", 1.0)
    exam.prepare(task)
    cfg = task.cfg
    init = cfg.init_state
    assert (init.pos_xy_range, init.yaw_range, init.lin_vel_range, init.ang_vel_range, cfg.noise.level) == (0, 0, 0, 0, 0)
    assert cfg.perturbation.enable is False and cfg.commands.resampling_time == 0
    assert cfg.env.episode_length_s > rules.SECONDS and cfg.env.num_envs == WORLDS


# ---- the arithmetic, with a made-up environment whose figures are known


class Puppet:
    """Stands in for LeggedRobot: every world does exactly what the script says."""

    def __init__(self, script: Callable[[Puppet, int], None], falls: dict[int, list[int]] | None = None) -> None:
        self.num_envs, self.device, self.dt, self.total_mass = WORLDS, "cpu", 0.02, 10.0
        self.script, self.falls, self.time = script, falls or {}, 0
        self.sim = SimpleNamespace(qpos=torch.zeros(WORLDS, 19), qvel=torch.zeros(WORLDS, 18))
        self.commands = torch.full((WORLDS, 3), math.nan)  # the exam must set all
        self.base_lin_vel, self.base_ang_vel = torch.zeros(WORLDS, 3), torch.zeros(WORLDS, 3)
        self.torques, self.dof_vel = torch.zeros(WORLDS, 12), torch.zeros(WORLDS, 12)
        self.shown: Tensor | None = None
        self.jumps: list[Tensor] = []
        self.actions: list[Tensor] = []
        script(self, 0)

    def reset(self) -> TensorDict:
        return self.get_observations()

    def compute_observations(self) -> None:
        self.shown = self.commands.clone()

    def get_observations(self) -> TensorDict:
        shown = torch.zeros(WORLDS, 3) if self.shown is None else self.shown
        return TensorDict({"state": shown.clone()}, batch_size=[WORLDS])

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        self.actions.append(actions.clone())
        self.jumps.append(self.sim.qvel[:, :2].clone())
        self.sim.qvel.zero_()
        dones = torch.zeros(WORLDS, dtype=torch.bool)
        dones[self.falls.get(self.time, [])] = True
        self.time += 1
        self.script(self, self.time)
        return self.get_observations(), torch.zeros(WORLDS), dones, {}


def follow(env: Puppet, step: int) -> None:
    """Every world does as commanded."""
    commands = torch.nan_to_num(env.commands)
    env.base_lin_vel[:, :2], env.base_ang_vel[:, 2] = commands[:, :2], commands[:, 2]


def grade(env: Any, policy: Callable[[TensorDict], Tensor] | None = None) -> dict[str, Any]:
    return exam.run_exam(env, policy or (lambda obs: torch.zeros(WORLDS, 12)))


def test_worlds_are_commanded_and_the_policy_sees_it() -> None:
    seen = []

    def policy(obs: TensorDict) -> Tensor:
        seen.append(obs["state"].clone())
        return torch.full((WORLDS, 12), float(len(seen)))

    env = Puppet(follow)
    grade(env, policy)
    wanted = torch.tensor([*rules.commands(), *[(0.8, 0.0, 0.0)] * KICKED])
    assert torch.equal(env.commands, wanted) and len(seen) == 500
    assert all(torch.equal(obs, wanted) for obs in seen)
    assert [float(action[0, 0]) for action in env.actions] == [float(i) for i in range(1, 501)]  # each acted upon once, in order


def test_kicks() -> None:
    """World 16 s + k after the tracked ones jumps by s + 1 m/s at 22.5 k degrees, at step 150 + k, after that step's action."""
    env = Puppet(follow)

    def policy(obs: TensorDict) -> Tensor:
        assert not env.sim.qvel.any()  # it does not see the kick coming
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

    def script(env: Puppet, step: int) -> None:
        follow(env, step)
        if step < 100:
            env.base_lin_vel += 5.0
        else:
            off = 0.001 * torch.arange(WORLDS) * (-1) ** step
            env.base_lin_vel[:, 0] += off
            env.base_lin_vel[:, 1] += 2 * off
            env.base_ang_vel[:, 2] += 3 * off

    result = grade(Puppet(script))
    assert result["error"] == pytest.approx([0.0105, 0.021, 0.0315], abs=2e-5)  # the mean of 0 .. 21 is 10.5
    assert result["worst"] == pytest.approx([0.021, 0.042, 0.063], abs=2e-5)
    for i, (row, command) in enumerate(zip(result["commands"], rules.commands(), strict=True)):
        assert row["command"] == list(command) and row["fell"] is False
        assert row["error"] == pytest.approx([0.001 * i, 0.002 * i, 0.003 * i], abs=2e-5)


def test_drift_joint_speed_and_cost_of_transport() -> None:
    """Standing at sqrt(0.3^2 + 0.4^2) m from where it stood at 2 s; 72 W for 8 s at 0.9 m/s and 10 kg."""

    def script(env: Puppet, step: int) -> None:
        follow(env, step)
        env.sim.qpos[0, :2] = (
            torch.tensor([7.0, 7.0]) if step < 100 else torch.tensor([1.0, 2.0]) + (step - 100) / 400 * torch.tensor([0.3, 0.4])
        )
        env.sim.qpos[2, 0] = 0.9 * 0.02 * step
        env.torques[2], env.dof_vel[2] = 2.0, 3.0 if step % 2 else -3.0  # braking costs too
        if step < 100:
            env.torques[2] = 50.0
        env.dof_vel[0] = 9.0 if step < 450 else torch.tensor([0.2, -0.4] * 6)

    result = grade(Puppet(script))
    assert result["drift"] == pytest.approx(0.5, abs=1e-5)
    assert result["joint_speed"] == pytest.approx(0.3, abs=1e-5)
    assert result["cost_of_transport"] == pytest.approx(72 * 8 / (10 * 9.81 * 0.9 * 8), rel=1e-4)


def test_falls() -> None:
    """A fallen command leaves the means; what falls again counts once."""

    def script(env: Puppet, step: int) -> None:
        follow(env, step)
        env.base_lin_vel[3] += 1.0

    result = grade(Puppet(script, {120: [3, 7], 300: [3]}))
    assert result["falls"] == 2 and [i for i, row in enumerate(result["commands"]) if row["fell"]] == [3, 7]
    assert result["error"] == result["worst"] == [0, 0, 0] and result["walks"] is False
    assert grade(Puppet(script))["worst"] == pytest.approx([1, 1, 0])


def test_a_kick_is_survived_if_it_stands_until_step_300() -> None:
    def world(speed: int, k: int) -> int:
        return TRACKED + 16 * (speed - 1) + k

    falls = {
        160: [world(6, k) for k in range(16)],
        299: [world(5, 0), world(5, 1)],
        300: [world(4, 3)],
        301: [world(3, 3), world(2, 15)],  # too late to count
        20: [world(1, 9)],  # before its kick: it did not survive either
    }
    result = grade(Puppet(follow, falls))
    assert result["kicks"] == {"1": 0.9375, "2": 1.0, "3": 1.0, "4": 0.9375, "5": 0.875, "6": 0.0}
    assert result["falls"] == 0 and result["walks"] is True


# ---- verdicts

WALKS: dict[str, Any] = {"falls": 0, "error": [0.06, 0.06, 0.12], "kicks": {"1": 0.5, "2": 1.0, "3": 0.0, "4": 0.0, "5": 0.0, "6": 0.0}}
BEATS: dict[str, Any] = {
    "falls": 0,
    "error": [0.0239, 0.0309, 0.0839],
    "worst": [0.042, 0.063, 0.357],
    "drift": 0.005,
    "kicks": {"1": 1.0, "2": 1.0, "3": 1.0, "4": 0.81, "5": 0.38, "6": 0.13},
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
    assert rules.walks(WALKS)


@pytest.mark.parametrize(
    ("path", "value"),
    [("falls", 1), ("error.0", 0.0601), ("error.1", 0.0601), ("error.2", 0.1201), ("kicks.2", 0.9375), ("error.0", math.inf)],
)
def test_does_not_walk_past_it(path: str, value: float) -> None:
    assert not rules.walks(changed(WALKS, path, value))


def test_beats_the_peer_by_a_little() -> None:
    assert rules.beats_peer(BEATS)
    assert rules.beats_peer(changed(BEATS, "kicks.6", 1.0)) and rules.beats_peer(changed(BEATS, "drift", 0.0))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        *(("error.0", 0.024), ("error.1", 0.031), ("error.2", 0.084), ("cost_of_transport", 0.86)),  # as good is not better
        *(("worst.0", 0.0421), ("worst.1", 0.0631), ("worst.2", 0.3571), ("drift", 0.0051), ("falls", 1)),
        *(("kicks.1", 0.9375), ("kicks.2", 0.9375), ("kicks.3", 0.9375), ("kicks.4", 0.75), ("kicks.5", 0.375), ("kicks.6", 0.125)),
    ],
)
def test_does_not_beat_the_peer(path: str, value: float) -> None:
    assert not rules.beats_peer(changed(BEATS, path, value))


def test_table_names_every_figure() -> None:
    result = grade(Puppet(follow))
    text = rules.table({**result, "drift": 0.1234, "cost_of_transport": 4.56, "joint_speed": 0.789})
    for part in ("0.1234", "4.56", "0.789", "survives kicks of 6 m/s", "worst command", "0.0007", "walks: yes; beats the peer: no"):
        assert part in text


# ---- the real environment


@pytest.fixture(scope="module")
def standing() -> tuple[dict[str, Any], Tensor]:
    """Zero action, which stands in the default pose: the result, and qvel (500, N, 18) as the policy saw it."""
    task = load_task("go1_flat")
    exam.prepare(task)
    env = LeggedRobot(task.cfg, "cpu")
    seen = []

    def policy(obs: TensorDict) -> Tensor:
        seen.append(env.sim.qvel.clone())
        return torch.zeros(WORLDS, 12)

    return exam.run_exam(env, policy), torch.stack(seen)


def test_standing_still(standing: tuple[dict[str, Any], Tensor]) -> None:
    result, _ = standing
    assert result["falls"] == 0 and result["walks"] is False and result["beats_peer"] is False
    assert all(error < 0.01 for error in result["commands"][0]["error"])  # of the command to stand
    for row in result["commands"]:  # of any other it is the command itself
        assert row["error"] == pytest.approx([abs(v) for v in row["command"]], abs=0.01)
    assert result["worst"] == pytest.approx([1.5, 0.8, 1.2], abs=0.01)
    assert result["drift"] < 0.05 and result["joint_speed"] < 0.05


def test_real_kicks_move_the_robot_and_throw_it(standing: tuple[dict[str, Any], Tensor]) -> None:
    result, qvel = standing
    shares = list(result["kicks"].values())
    assert shares[-1] == 0.0 and shares[0] <= 1.0 and shares == sorted(shares, reverse=True)
    before, after = qvel[150, TRACKED:, :2].view(6, 16, 2), qvel[151, TRACKED:, :2].view(6, 16, 2)
    jump = (after - before)[:, 0, 0]  # k = 0: forward in the world; a foot on the ground takes a part within the step
    assert (jump > 0.5 * torch.arange(1, 7)).all() and (jump < 1.1 * torch.arange(1, 7)).all()
    assert ((after - before)[:, 1:].norm(dim=2) < 0.1).all()  # the others wait for their step
    assert torch.equal(qvel[:150, 0], qvel[:150, 1])  # until then all worlds are the same: nothing is drawn


def test_two_exams_are_the_same_exam(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the seed, with a policy that answers to every observation."""
    monkeypatch.setattr(exam, "SECONDS", 2.4)
    monkeypatch.setattr(exam, "KICK_AT", 30)
    mix = torch.randn(48, 12, generator=torch.Generator().manual_seed(0))
    results = []
    for seed in (1, 2):
        task = load_task("go1_flat")
        task.set("perturbation.enable", True)  # a task that kicks while it trains
        exam.prepare(task)
        torch.manual_seed(seed)
        env = LeggedRobot(task.cfg, "cpu")
        results.append(exam.run_exam(env, lambda obs: 0.3 * torch.sin(obs["state"] @ mix)))
        for row in results[-1]["commands"]:
            if row["fell"]:
                row["error"] = "not graded"  # from the fall on, the world follows a new command, and that one is drawn
    assert results[0] == results[1]
    assert results[0]["commands"][0]["error"][0] > 0.01  # it did move


def test_eval_from_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The table is printed, the figures go into the run folder; a user's own override still counts, the exam's worlds do not move."""
    for place in (exam, rules):  # by the environment, and by the export
        monkeypatch.setattr(place, "SECONDS", 2.1)
    folder = trained(tmp_path, "--max_iterations", "1")
    result = run("play", tmp_path, *SMALL[:2], "--device", "cpu", "--eval", "--set", "terrain.friction=0.4")
    assert result.code == 0, result.err
    assert "terrain.friction: 0.6 -> 0.4" in result.out and "noise.level: 1.0 -> 0.0" in result.out
    assert "falls in 22 commands" in result.out and "walks: no; beats the peer: no" in result.out
    saved, deployed = json.loads((folder / "eval/report.json").read_text())["columns"]
    assert deployed["name"] == "the same, deployed in MuJoCo" and deployed["exam"]["error"] == pytest.approx(
        saved["exam"]["error"], abs=0.01
    )
    about, graded = saved["about"], saved["exam"]
    assert about["policy"].endswith(f"{folder.name}/model_1.pt") and about["engine"] == "mujoco" and about["device"] == "cpu"
    assert len(graded["commands"]) == TRACKED and graded["walks"] is False
    assert about["overrides"]["noise.level"] == 0.0 and about["overrides"]["terrain.friction"] == 0.4
    assert folder.name in (folder / "eval/report.html").read_text(encoding="utf-8")
    for more, field in (
        (["--num_envs", "4"], "env.num_envs"),
        (["--set", "noise.level=1"], "noise.level"),
        (["--set", "commands.resampling_time=5"], "commands.resampling_time"),
    ):
        line = refused(tmp_path, "play", *SMALL[:2], "--device", "cpu", "--eval", *more)
        assert f"--eval sets {field} itself; an exam with other values would be another exam" in line
    for more in (["--command", "1,0,0"], ["--video", "x.mp4"], ["--export", "x"]):
        assert "one thing each" in refused(tmp_path, "play", *SMALL[:2], "--device", "cpu", "--eval", *more)
