"""The report: its exam is the plain exam, its page needs nothing but itself, and two policies are graded alike."""

from __future__ import annotations

import copy
import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from program import SMALL, refused, run, trained
from tensordict import TensorDict

from legged_mw import ROOT, programs
from legged_mw import eval as eval_package
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval import exams, plots, report, rollout
from legged_mw.eval.report import Column
from legged_mw.eval.rollout import Case, Push, make_plan, roll_out
from legged_mw.eval.walking import PEERS, ExamRules, in_common
from legged_mw.rl.policies import act, load_policy
from legged_mw.rl.run_folder import update_from_run
from legged_mw.utils.config import load_yaml
from legged_mw.utils.task import LoadedTask, load_task

SHIPPED = ROOT / "resources/policies/go1_flat"
GO1 = ExamRules.from_config(load_task("go1_flat").cfg)


def shipped() -> LoadedTask:
    task = load_task("go1_flat")
    update_from_run(task, load_yaml(SHIPPED / "config.yaml"), where="config.yaml")
    return task


@pytest.fixture(scope="module")
def both() -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """The shipped policy, 2.4 s: the plain exam's result, the report's, and the report's figures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollout, "EXAM_SECONDS", 2.4)
        patch.setattr(rollout, "PUSH_AT", 0.6)
        patch.setattr(rollout, "GRID", (7, 3, 3))
        task = shipped()
        rollout.prepare(task)
        env = task.env_class(task.cfg, "cpu")
        policy = load_policy(SHIPPED / "policy.onnx", env, task.train, "cpu")
        plain = rollout.run_exam(env, lambda obs: act(policy, obs))
        rollout.make_room(task)
        return plain, *rollout.examine(task.env_class(task.cfg, "cpu"), lambda obs: act(policy, obs))


def test_the_reports_exam_is_the_plain_exam(both: tuple[dict[str, Any], ...]) -> None:
    """However many worlds stand beside, to the last digit, though the robots walk and are pushed."""
    plain, result, _ = both
    for row in [*plain["commands"], *result["commands"]]:
        assert row["fell"] is False
    assert plain == result and min(plain["pushes"].values()) < 1.0


def test_figures_of_a_policy_that_walks(both: tuple[dict[str, Any], ...]) -> None:
    """What every part of the report must say of it, roughly: a mix-up of worlds or columns would show."""
    _, result, figures = both
    ahead = figures["tracking"]["axes"]["vx"].index(1.0)
    straight, row = figures["tracking"]["axes"]["vy"].index(0.0), figures["tracking"]["vx_vy"][0]
    walk = next(i for i, c in enumerate(GO1.commands()) if c == (1.0, 0.0, 0.0))
    assert row[straight][ahead] == pytest.approx(result["commands"][walk]["error"][0], abs=1e-5)
    assert figures["transport"]["cost_of_transport"][ahead] == pytest.approx(result["cost_of_transport"], rel=1e-3)
    assert all(max(max(r) for r in error) < 0.5 for error in figures["tracking"]["vx_yaw"])
    [stand, *_], trot = figures["gait"], figures["gait"][walk]
    assert stand["duty_factor"] == [1.0] * 4 and stand["stride_frequency"] == 0.0
    assert all(0.1 < share < 0.95 for share in trot["duty_factor"])
    assert figures["reward"]["tracking_lin_vel"] == pytest.approx(2.0, abs=0.2) and figures["reward"]["torques"] < 0
    assert figures["joints"]["torque"]["high"][2] == pytest.approx(35.55)
    [shares] = {len(figures["joints"][key]["saturated"]) for key in ("dof_pos", "dof_vel", "torque")}
    assert shares == 12
    assert [motor["kind"] for motor in figures["motors"]] == ["hip", "thigh", "calf"]
    assert all(motor["at_limit"] < 0.01 and np.sum(motor["counts"]) == 4 * 22 * 20 for motor in figures["motors"])
    assert [sum(row) / 16 for row in figures["pushes"]["walking"]] == pytest.approx(
        list(result["pushes"].values()), abs=1e-4
    )
    assert figures["steps"]["vx"]["commanded"] == [1.0] * 20 and figures["steps"]["vx"]["fell"] == 0
    assert figures["steps"]["vx"]["mean"] == pytest.approx([1.0] * 20, abs=0.15)


def test_the_plan() -> None:
    """Exam first; grids over the trained ranges; the same steps in each world, later and later."""
    plan = make_plan(shipped().cfg, 0.02)
    assert plan.cases[: GO1.worlds()] == rollout.cases(GO1, 0.02)
    assert [plan.parts[name] for name in ("commands", "transport", "pushes")] == [
        slice(0, 22),
        slice(22, 22),
        slice(22, 118),
    ]
    corner = plan.cases[plan.parts["vx_yaw"]][-1]
    assert corner == Case(((0, (1.5, 0.0, 1.2)),)) and plan.cases[plan.parts["vx_vy"]][0] == Case(
        ((0, (-1.5, -0.8, 0.0)),)
    )
    first, second, *_ = plan.cases[plan.parts["step_vy"]]
    assert first.commands == (
        (0, (0, 0, 0)),
        (10, (0, 0.53, 0)),
        (125, (0, -0.53, 0)),
        (250, (0, 0, 0)),
        (375, (0, 0.53, 0)),
    )
    assert [step for step, _ in second.commands] == [0, 13, 125, 250, 375]
    assert sum(part.stop - part.start for part in plan.parts.values()) == len(plan.cases)
    narrow = shipped().cfg
    narrow.commands.ranges.lin_vel_y, narrow.commands.ranges.lin_vel_x = [0.0, 0.0], [0.5, 1.0]
    plan = make_plan(narrow, 0.02)
    assert plan.axes["vy"] == [0.0] and plan.cases[plan.parts["vx_yaw"]][0].commands[0][1] == (0.5, 0.0, -1.2)


def test_a_roll_out_begins_with_a_history_of_its_own_command() -> None:
    task = load_task("go1_flat")
    rollout.prepare(task, 2)
    task.cfg.observations.history = {"state": 3}
    env, seen = LeggedRobot(task.cfg, "cpu"), []

    def policy(obs: TensorDict) -> torch.Tensor:
        seen.append(obs["state"][0, env.observations.span("state", "commands")].tolist())
        return torch.zeros(len(obs), 12)

    roll_out(env, policy, [Case(((0, (0.5, 0.0, 0.25)),))] * 2, 2, {"command": lambda env: env.commands})
    assert seen == [[0.5, 0.0, 0.25] * 3] * 2


def test_commands_change_and_pushes_come_when_they_should() -> None:
    task = load_task("go1_flat")
    rollout.prepare(task, 2)
    env = LeggedRobot(task.cfg, "cpu")
    cases = [Case(((0, (0.5, 0.0, 0.0)), (3, (0.0, 0.4, 0.0)))), Case(((0, (0.0, 0.0, 0.0)),), Push(2, 1.0, 0.0))]
    seen, speed = [], []

    def policy(obs: TensorDict) -> torch.Tensor:
        seen.append(obs["state"][0, -3:].tolist())
        speed.append(float(env.root_lin_vel[1, 0]))
        return torch.zeros(len(obs), 12)

    record = roll_out(env, policy, cases, 5, {"command": lambda env: env.commands})
    assert seen == [[0.5, 0.0, 0.0]] * 3 + [pytest.approx([0.0, 0.4, 0.0])] * 2
    assert record.commands[:, 0] == pytest.approx(record.signals["command"][:, 0])
    assert abs(speed[2]) < 0.2 < 0.5 < speed[3] - speed[2]


# ---- the page


@pytest.fixture(scope="module")
def pages(both: tuple[dict[str, Any], ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report with a rival who fell at everything, and with the exam in another physics."""
    _, result, figures = both
    fallen, nothing = copy.deepcopy(result), copy.deepcopy(figures)
    fallen |= {"falls": 22, "error": [0.568, 0.255, 0.382], "worst": [1.5, 0.8, 1.2], "walks": False}
    fallen |= {"drift": None, "joint_speed": None, "cost_of_transport": None}
    for gait in nothing["gait"]:
        gait |= {"duty_factor": None, "stride_frequency": None, "contact": None}
    for grid in ("vx_yaw", "vx_vy"):
        nothing["tracking"][grid] = [[[None] * len(row) for row in error] for error in nothing["tracking"][grid]]
    for key in ("speed", "power", "cost_of_transport"):
        nothing["transport"][key] = [None] * len(nothing["transport"]["vx"])
    for shown in nothing["joints"].values():
        shown |= {"edges": [], "density": [], "saturated": []}
    nothing["reward"] = dict.fromkeys(nothing["reward"])
    folder = tmp_path_factory.mktemp("eval")
    about = {
        "policy": "go1_flat/a & b/model_7.pt",
        "engine": "mujoco",
        "device": "cpu",
        "overrides": {"noise.level": 0.0},
    }
    other = {**result, "error": [value + 0.004 for value in result["error"]]}
    columns = [
        Column("<first>", about, result, figures),
        Column("by numpy", {}, other),
        Column("rival", about, fallen, nothing),
    ]
    report.write(folder, "go1_flat", columns)
    return folder


def test_the_page_needs_nothing_but_itself(pages: Path) -> None:
    html = (pages / "report.html").read_text(encoding="utf-8")
    assert "http" not in html and "@import" not in html and "<script" not in html and "<link" not in html
    assert re.findall(r'\b(?:src|href)="(?!#)[^"]*"', html) == [] and set(re.findall(r"url\((.)", html)) <= {"#"}
    for path in (str(ROOT), str(Path.home()), str(pages), "site-packages"):
        assert path not in html
    assert html.count("<svg") == html.count("</svg>") == 38
    assert len(html) < 4e6


def test_the_page_shows_columns_gaps_and_verdicts(pages: Path) -> None:
    html = (pages / "report.html").read_text(encoding="utf-8")
    assert "&lt;first&gt;" in html and "<first>" not in html and "a &amp; b" in html
    heads = re.findall(r"<th>(.*?)</th>", html[html.index('<table class="exam">') :])[1:6]
    assert heads == ["&lt;first&gt;", "by numpy", "rival", "walks at", "peer"]
    row = re.search(r"<tr><th>error vx \[m/s\]</th>.*?</tr>", html)
    assert row is not None
    assert row[0].count('class="value pass"') == 2 and row[0].count('class="value fail"') == 1
    assert "<small>+0.004</small>" in row[0] and ">0.568<" in row[0] and ">fell<" in html
    assert html.count(">fell</text>") == len(plots.GAITS)  # the rival's line in each gait panel
    assert (
        "asked: vx -1.5 to 1.5 m/s, vy -0.8 to 0.8 m/s, yaw rate -1.2 to 1.2 rad/s. If the robot falls, the error of this command"
        in html
    )
    assert "Published policies" not in html
    assert "does not walk<" in html and "does not beat the peer" in html


def test_json_holds_every_figure(pages: Path, both: tuple[dict[str, Any], ...]) -> None:
    _, result, figures = both
    saved = json.loads((pages / "report.json").read_text())
    first, numpy, rival = saved["columns"]
    assert first["exam"] == json.loads(json.dumps(result)) and first["figures"] == json.loads(json.dumps(figures))
    assert numpy["name"] == "by numpy" and numpy["figures"] is None and rival["exam"]["falls"] == 22
    assert saved["task"] == "go1_flat" and saved["peer"] == PEERS["go1"][0].figures and len(saved["peers"]) == 1


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the page's chapters those that show peers, since drawing takes seconds."""
    draw = plots.sections
    chosen = ("pushes", "energy")
    monkeypatch.setattr(plots, "sections", lambda *args: [each for each in draw(*args) if each.name in chosen])


def test_the_figures_are_kept_where_nothing_can_draw_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An exam took minutes; that matplotlib is missing must not lose it."""
    monkeypatch.delattr(eval_package, "plots")
    monkeypatch.setitem(sys.modules, plots.__name__, None)
    with pytest.raises(ImportError):
        report.write(tmp_path, "go1_flat", [Column("mine", {}, {"rules": GO1.to_mapping(), "falls": 3})])
    assert json.loads((tmp_path / "report.json").read_text())["columns"][0]["exam"]["falls"] == 3


def test_a_task_without_a_peer(few: None, both: tuple[dict[str, Any], ...], tmp_path: Path) -> None:
    """Neither page nor JSON speaks of one; pushes and cost of transport are drawn all the same."""
    _, result, figures = both
    rules = {**result["rules"], "peer": ""}
    alone = {name: value for name, value in result.items() if name != "beats_peer"} | {"rules": rules}
    report.write(tmp_path, "pose", [Column("mine", {}, alone, figures)])
    html, saved = (tmp_path / "report.html").read_text(encoding="utf-8"), (tmp_path / "report.json").read_text()
    body = html[html.index("<body>") :]
    assert "peer" not in body and "peer" not in json.loads(saved) and "beats" not in saved
    assert "survives pushes of 2 m/s" in body and body.count("<svg") == 3 + 2


def test_several_peers_are_their_best_and_a_table(few: None, both: tuple[dict[str, Any], ...], tmp_path: Path) -> None:
    """The best of each figure beside the policy's, all of them below; what was not asked alike is said."""
    _, result, figures = both
    asked = ExamRules.from_mapping({"peer": "go2", **in_common("go2")})
    pushes = dict(zip(("0.5", "1", "1.5", "2", "3", "4", "5", "6"), [1.0] * 8, strict=True))
    figures = copy.deepcopy(figures)
    figures["pushes"] = {"speeds": list(asked.push_speeds), **dict.fromkeys(("walking", "standing"), [[True] * 16] * 8)}
    graded = {**result, "pushes": pushes, "beats_peer": False, "rules": asked.to_mapping()}
    report.write(tmp_path, "go2", [Column("mine", {}, graded, figures)])
    html, saved = (
        (tmp_path / "report.html").read_text(encoding="utf-8"),
        json.loads((tmp_path / "report.json").read_text()),
    )
    assert (
        "<td>0.30*</td>" in html
        and "<td>0.034</td>" in html
        and "<th>best of 10</th>" in html
        and "does not beat all 10 published policies (at or beyond their best in " in html
    )
    assert "half of each policy&#x27;s highest vx, not at 0.5 m/s" in html
    table = html[html.index("<h2>Published policies</h2>") :]
    row = "<tr><th>DLS basic-locomotion</th><td>0</td><td>0.046, 0.037, 0.058</td><td>0.16, 0.06, 0.12</td><td>0.032, 0.019, 0.015</td>"
    assert row + "<td>0.002</td><td>0.63</td><td>100, 69, 12, 6, 0, 0, 0, 0</td><td>0.25</td></tr>" in table
    assert table.count("<tr>") == 1 + 1 + 10 and "<tr><th>mine</th><td>0</td>" in table
    assert len(saved["peers"]) == 10 and saved["peer"]["cost_of_transport"] == 0.3
    assert html.count("best of 10") == 1 + 2


def test_marks_of_offsets_are_no_marks_of_errors(both: tuple[dict[str, Any], ...]) -> None:
    """No stroke on the scale of an error, and no word of one; how many fell stands above the steps."""
    _, result, figures = both
    asked = ExamRules.from_mapping({**result["rules"], "marks_of": "offset", "peer": ""})
    figures = copy.deepcopy(figures)
    figures["steps"]["vx"]["fell"] = 2
    graded = {**{name: value for name, value in result.items() if name != "beats_peer"}, "rules": asked.to_mapping()}
    drawn = []
    for rules in (asked, GO1):
        sections = {section.name: section for section in plots.sections([("mine", figures)], rules)}
        drawn.append("".join(plots.svgs(sections["tracking"]._replace(panels=sections["tracking"].panels[:1]))))
    assert ">0.06</text>" in drawn[1] and ">0.06</text>" not in drawn[0]
    html = report.walking_page("biped", asked, [Column("mine", {}, graded, figures)], [(sections["tracking"], [])])
    assert "The mark on each scale" not in html and "vx offset" in html and "of the mean velocity" in html
    assert "The mark on each scale" in report.walking_page(
        "go1", GO1, [Column("mine", {}, result, figures)], [(sections["tracking"], [])]
    )
    assert ">2 fell</text>" in "".join(plots.svgs(sections["steps"]._replace(panels=sections["steps"].panels[:1])))


# ---- --compare


@pytest.fixture(scope="module")
def two_runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """A root with two runs, of which one has other networks."""
    root = tmp_path_factory.mktemp("compare")
    first = trained(root, "--max_iterations", "1")
    return root, first, trained(root, "--max_iterations", "1", "--set", "actor.hidden_dims=[8]", "--run_name", "other")


def test_two_policies_are_asked_the_same() -> None:
    """The second was trained with other ranges: it is asked for the first one's commands, on a grid of its own."""
    first, second = shipped(), shipped()
    second.cfg.commands.ranges.lin_vel_x = [0.5, 0.5]
    for task in (first, second):
        rollout.prepare(task)
        rollout.make_room(task)
    worlds = second.cfg.env.num_envs
    assert ExamRules.from_config(second.cfg) != GO1
    rollout.ask_alike([first, second])
    assert ExamRules.from_config(first.cfg) == ExamRules.from_config(second.cfg) == GO1
    # no world more for the cost of transport
    assert first.cfg.exam.ranges == {} and second.cfg.env.num_envs == worlds - 1


def test_compare_grades_each_by_its_own_config(
    two_runs: tuple[Path, Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    root, first, second = two_runs
    monkeypatch.setattr(rollout, "EXAM_SECONDS", 2.1)
    monkeypatch.setattr(rollout, "GRID", (3, 3, 3))
    written: list[Any] = []
    kind = exams.EXAMS["walking"]._replace(write=lambda folder, task, columns: written.extend([folder, task, *columns]))
    monkeypatch.setitem(exams.EXAMS, "walking", kind)
    monkeypatch.setattr(programs, "grade_export", lambda *_: [])
    small = ["--load_run", first.name, "--compare", second.name, "--set", "terrain.friction=0.4"]
    small += ["--set", "exam.push_speeds=[2]"]
    result = run("play", root, *SMALL[:2], "--device", "cpu", "--eval", "--no_hard", *small)
    assert result.code == 0, result.err
    folder, task, one, other = written
    assert folder == first / "eval" and task == "go1_flat"
    assert one.about["policy"].endswith(f"{first.name}/model_1.pt") and other.about["policy"].endswith(
        f"{second.name}/model_1.pt"
    )
    assert one.about["overrides"]["terrain.friction"] == other.about["overrides"]["terrain.friction"] == 0.4
    assert one.exam != other.exam and one.figures.keys() == other.figures.keys()
    assert result.out.count("falls in 22 commands") == 2
    assert one.exam["rules"] == other.exam["rules"]


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            {"task": "go1_flat_fast"},
            "is of task 'go1_flat_fast', not 'go1_flat': both policies must have the same task",
        ),
        (
            {"actor": {"hidden_dims": [9]}},
            "does not fit this task: actor mlp.0.weight is (8, 48) there and (9, 48) here",
        ),
        (
            {"obs_groups": {"actor": ["privileged_state"]}},
            "does not fit this task: actor obs_normalizer._mean is (1, 48) there and (1, 12",
        ),
    ],
)
def test_a_rival_that_does_not_fit_is_refused(
    two_runs: tuple[Path, Path, Path], change: dict[str, Any], line: str
) -> None:
    root, first, second = two_runs
    config = second / "config.yaml"
    kept = config.read_text()
    saved = load_yaml(config)
    for section, value in change.items():
        saved[section] = saved[section] | value if isinstance(value, dict) else value
    config.write_text(json.dumps(saved))
    asked = f"--device cpu --eval --no_hard --load_run {first.name} --compare {second.name}"
    try:
        text = refused(root, "play", *SMALL[:2], *asked.split())
    finally:
        config.write_text(kept)
    assert line in text


def test_compare_mistakes(two_runs: tuple[Path, Path, Path]) -> None:
    root, *_ = two_runs
    start = [*SMALL[:2], "--device", "cpu"]
    assert "add --eval" in refused(root, "play", *start, "--compare", "shipped")
    assert "no run with a checkpoint 'nobody' in " in refused(root, "play", *start, "--eval", "--compare", "nobody")
    assert "--compare shipped: no policy ships with go1_flat" in refused(
        root, "play", *start, "--eval", "--compare", "shipped"
    )


def test_tables_of_two_policies_with_other_ranges() -> None:
    """One that never goes backwards has fewer steps of the command; nothing of either is lost."""

    def column(name: str, changes: int) -> Column:
        number = {"from": 0.0, "to": 1.0, "rise_time": 0.2, "overshoot": 0.1, "left": 0.0}
        steps = {axis: {"numbers": [number] * changes} for axis in ("vx", "vy", "yaw")}
        return Column(name, {}, {}, {"steps": steps, "foot_names": []})

    table = report._extra("steps", [column("first", 2), column("second", 3)])
    assert table.count(", first") == 6 and table.count(", second") == 9
