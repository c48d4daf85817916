"""Teacher, student, and going on from an actor, as a user meets them: train.py --teacher RUN, train.py --init RUN."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import pytest
import torch
from onnx import numpy_helper
from program import SMALL, run, trained
from rsl_rl.utils import resolve_class
from test_train import Start, assert_equal, load, starts  # noqa: F401  (a fixture)
from worlds import layout, make_env

from legged_mw.check.recordable import recordable
from legged_mw.deploy import __main__ as deploy
from legged_mw.deploy.contract import read_contract
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.policies import (
    TEACHER,
    PolicySource,
    Trained,
    acting,
    attach_teacher_observations,
    begin_with,
    check_start,
    find_trained,
    keep_teacher,
    load_policy,
    load_teacher,
)
from legged_mw.rl.run_folder import update_from_run
from legged_mw.rl.runner import make_runner
from legged_mw.utils.config import ConfigError, load_yaml
from legged_mw.utils.task import LoadedTask, load_task

# go2_rough_scan and its student, small: one level of one kind of ground.
ROUGH = [
    *("--num_envs", "16", "--set", "terrain.num_rows=1", "--set", "terrain.num_cols=1", "--set", "terrain.tile_size=4"),
    *shlex.split("--set terrain.border_size=1 --set terrain.max_init_terrain_level=0"),
    *shlex.split("--set 'terrain.terrain_proportions={waves: 1}'"),
]
WIDE = ["--set", "actor.hidden_dims=[24, 16]"]  # the student's own network: the teacher's is of 16 and 16


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("teacher")


@pytest.fixture(scope="module")
def teacher(root: Path) -> Path:
    """A run that sees the ground and its velocity; read-only for the tests, as those below."""
    return trained(root, "--task", "go2_rough_scan", *ROUGH, "--max_iterations", "2")


@pytest.fixture(scope="module")
def student(root: Path, teacher: Path) -> Path:
    """Distilled from the last run of go2_rough_scan, with an export."""
    asked = [
        *shlex.split("--teacher go2_rough_scan --max_iterations 3 --set runner.save_interval=2"),
        *shlex.split("--set runner.export=true"),
    ]
    return trained(root, "--task", "go2_rough", *ROUGH, *WIDE, *asked)


@pytest.fixture(scope="module")
def tuned(root: Path, student: Path) -> Path:
    """PPO from that student; the critic learns alone in the first of two iterations. Nothing says how large the actor is."""
    small = [
        *SMALL[: SMALL.index("actor.hidden_dims=[16, 16]") - 1],
        *SMALL[SMALL.index("actor.hidden_dims=[16, 16]") + 1 :],
    ]
    warm = ["--init", student.name, "--set", "warm_start.critic_warmup=1", "--set", "warm_start.init_std=0.3"]
    begun = [
        *small,
        "--task",
        "go2_rough",
        *ROUGH,
        *warm,
        *shlex.split("--max_iterations 2 --set runner.save_interval=1"),
    ]
    result = run("train", root, *begun, "--run_name", "tuned")
    assert result.code == 0, result.err
    assert "only the critic learns for 1 iterations (warm_start.critic_warmup)" in result.out
    return next(root.glob("logs/go2_rough/*_tuned"))


def parts(state: dict[str, torch.Tensor], noise: bool) -> dict[str, torch.Tensor]:
    """The noise of exploration, or all else of an actor."""
    return {name: value for name, value in state.items() if name.startswith("distribution.") == noise}


# ---- the chain


def test_a_students_run(student: Path, teacher: Path) -> None:
    """It holds its teacher, and the teacher's parameters are those of its run."""
    content, config = load(student / "model_3.pt"), load_yaml(student / "config.yaml")
    assert {"student_state_dict", "teacher_state_dict", "optimizer_state_dict", "iter", "infos"} == content.keys()
    assert_equal(dict(content["teacher_state_dict"]), dict(load(teacher / "model_2.pt")["actor_state_dict"]))
    assert config["distillation"]["teacher"].endswith(f"{teacher.name}/model_2.pt") and config["actor"][
        "hidden_dims"
    ] == [24, 16]
    assert sorted(path.name for path in (student / TEACHER).iterdir()) == ["config.yaml", "model_2.pt"]
    assert load_yaml(student / TEACHER / "config.yaml") == load_yaml(teacher / "config.yaml")
    first, last = load(student / "model_2.pt")["student_state_dict"], content["student_state_dict"]
    assert last["mlp.0.weight"].shape == (24, 265) and not torch.equal(last["mlp.0.weight"], first["mlp.0.weight"])
    assert last["distribution.std_param"].unique().tolist() == [pytest.approx(0.1)]
    assert last["obs_normalizer.count"] == 3 * 8 * 16


def test_a_student_is_exported_and_deployed(
    student: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    contract = read_contract(student / "export")
    names = ("base_ang_vel", "projected_gravity", "dof_pos", "dof_vel", "last_actions", "gait_clock", "commands")
    assert [(row.name, row.history) for row in contract.rows] == [(name, 5) for name in names]
    weights = {
        each.name: numpy_helper.to_array(each)
        for each in onnx.load(str(student / "export/policy.onnx")).graph.initializer
    }
    saved = load(student / "model_3.pt")["student_state_dict"]
    assert (weights["policy.mlp.0.weight"] == saved["mlp.0.weight"].numpy()).all()
    monkeypatch.setattr("sys.argv", ["deploy", str(student / "export"), "--viewer", "none", "--time", "1s"])
    deploy.main()
    assert "Traceback" not in capsys.readouterr().err


def test_a_student_resumes_without_its_teachers_run(student: Path, tmp_path: Path, starts: list[Start]) -> None:  # noqa: F811
    """All that it learned goes on, and the teacher comes from the student's own folder."""
    folder = Path(shutil.copytree(student, tmp_path / "logs/go2_rough/run"))
    shutil.rmtree(folder / "export")
    result = run(
        "train",
        tmp_path,
        *shlex.split("--device cpu --task go2_rough --resume --max_iterations 4"),
        *shlex.split("--set runner.export=false"),
    )
    assert result.code == 0, result.err
    assert f"resuming {folder}/model_3.pt" in result.out and "Learning iteration 4/4" in result.out
    saved, [start] = load(folder / "model_3.pt"), starts
    for name in ("student_state_dict", "teacher_state_dict", "optimizer_state_dict"):
        assert_equal(dict(start.alg[name]), dict(saved[name]), name)
    assert torch.equal(start.random_state, saved["infos"]["random_state"]["cpu"]) and (
        start.iteration,
        start.total_steps,
    ) == (3, 3 * 128)
    assert load(folder / "model_4.pt")["student_state_dict"]["obs_normalizer.count"] == 4 * 128


def test_ppo_goes_on_from_the_student(tuned: Path, student: Path) -> None:
    """The critic alone at first, to the bit; then both. The network is the student's, its noise the config's."""
    begun, first, last = (
        load(student / "model_3.pt")["student_state_dict"],
        load(tuned / "model_1.pt"),
        load(tuned / "model_2.pt"),
    )
    assert_equal(parts(first["actor_state_dict"], noise=False), parts(begun, noise=False))
    assert first["actor_state_dict"]["distribution.std_param"].unique().tolist() == [pytest.approx(0.3)]
    assert not torch.equal(last["actor_state_dict"]["mlp.0.weight"], begun["mlp.0.weight"])
    assert not torch.equal(last["critic_state_dict"]["mlp.0.weight"], first["critic_state_dict"]["mlp.0.weight"])
    assert first["critic_state_dict"]["obs_normalizer.count"] == 128
    config = load_yaml(tuned / "config.yaml")
    assert config["actor"]["hidden_dims"] == [24, 16] and config["critic"]["hidden_dims"] == [16, 16]
    assert (
        config["warm_start"]["policy"].endswith(f"{student.name}/model_3.pt") and not config["distillation"]["teacher"]
    )


def test_the_limits_of_exploration_are_the_new_tasks(root: Path, student: Path) -> None:
    (root / "quiet.py").write_text(
        "from configs.go1_rough import Go1RoughCfgPPO\n"
        "from configs.go2_rough import Go2RoughCfg\n"
        "from legged_mw.envs.legged_robot import LeggedRobot\n"
        "from legged_mw.utils.task import Task\n\n\n"
        "class QuietCfgPPO(Go1RoughCfgPPO):\n"
        "    class actor(Go1RoughCfgPPO.actor):\n"
        "        class distribution_cfg(Go1RoughCfgPPO.actor.distribution_cfg):\n"
        "            std_range = [0.05, 0.2]\n\n\n"
        "TASK = Task(LeggedRobot, Go2RoughCfg, QuietCfgPPO)\n"
    )
    begun = ["--task", str(root / "quiet.py"), "--init", str(student), *ROUGH, *WIDE, "--max_iterations", "1"]
    quiet = trained(root, *begun)
    assert load_yaml(quiet / "config.yaml")["actor"]["distribution_cfg"]["std_range"] == [0.05, 0.2]
    noise = load(quiet / "model_1.pt")["actor_state_dict"]["distribution.std_param"]
    assert noise.unique().tolist() == [pytest.approx(0.198)]  # of 0.2: at the bound it would have no gradient


def test_a_warm_up_goes_on_when_it_is_resumed(tuned: Path, tmp_path: Path) -> None:
    """Stopped after one of two iterations of warm-up, the next one is the second: the actor still stands."""
    folder = tmp_path / "logs/go2_rough/run"
    folder.mkdir(parents=True)
    shutil.copy(tuned / "config.yaml", folder)
    shutil.copy(tuned / "model_1.pt", folder)
    more = ["--max_iterations", "3", "--set", "warm_start.critic_warmup=2", "--set", "runner.save_interval=1"]
    result = run("train", tmp_path, "--device", "cpu", "--task", "go2_rough", "--resume", *more)
    assert result.code == 0, result.err
    first, second, third = (load(folder / f"model_{i}.pt") for i in (1, 2, 3))
    assert_equal(dict(second["actor_state_dict"]), dict(first["actor_state_dict"]))
    assert not torch.equal(second["critic_state_dict"]["mlp.0.weight"], first["critic_state_dict"]["mlp.0.weight"])
    assert not torch.equal(third["actor_state_dict"]["mlp.0.weight"], first["actor_state_dict"]["mlp.0.weight"])


def test_a_resumed_run_keeps_what_it_began_with(tuned: Path, tmp_path: Path) -> None:
    folder = tmp_path / "logs/go2_rough/run"
    folder.mkdir(parents=True)
    shutil.copy(tuned / "config.yaml", folder)
    shutil.copy(tuned / "model_1.pt", folder)
    before = load_yaml(folder / "config.yaml")
    more = ["--max_iterations", "2", "--set", "warm_start.policy=go1_flat", "--set", "distillation.teacher=go1_rough"]
    more += ["--seed", "7", "--set", "algorithm.learning_rate=0.5"]
    result = run("train", tmp_path, "--device", "cpu", "--task", "go2_rough", "--resume", *more)
    assert result.code == 0, result.err
    assert (
        "keeps its seed: 1, not 7" in result.out and "keeps its algorithm.learning_rate: 0.001, not 0.5" in result.out
    )
    assert "keeps its warm_start.policy: " in result.out and "keeps its distillation.teacher: '', not" in result.out
    after = load_yaml(folder / "config.yaml")
    assert all(after[name] == before[name] for name in ("warm_start", "distillation", "seed", "algorithm"))


def test_the_end_of_a_warm_up_is_not_lost_when_it_is_resumed(tuned: Path, env: LeggedRobot) -> None:
    """A checkpoint of the last iteration of the warm-up: what follows begins at the lowest learning rate, as it would have."""
    task = load_task("go2_rough")
    update_from_run(task, load_yaml(tuned / "config.yaml"), where="config.yaml")
    task.set("env.num_envs", 16)
    runner = make_runner(task.env_class(task.cfg, "cpu"), task.train, None, "cpu")
    runner.load(str(tuned / "model_1.pt"))
    assert runner.alg.critic_only and runner.alg.learning_rate == pytest.approx(1e-3)
    rates: list[float] = []

    def look(obs: object) -> None:
        rates.append(runner.alg.learning_rate)
        raise InterruptedError

    runner._rollout = look  # type: ignore[method-assign]
    with pytest.raises(InterruptedError):
        runner.learn(1)
    assert rates == [pytest.approx(1e-5)] and not runner.alg.critic_only


@pytest.mark.parametrize(
    ("name", "kept"), [("best.pt", "model_0.pt"), ("walks.onnx", "policy.onnx"), ("model_2.pt", "model_2.pt")]
)
def test_a_resumed_student_finds_a_teacher_of_any_name(name: str, kept: str, teacher: Path, tmp_path: Path) -> None:
    shutil.copy(teacher / "config.yaml", tmp_path)
    shutil.copy(teacher / "model_2.pt", tmp_path / name)
    (tmp_path / "run").mkdir()
    keep_teacher(find_trained(str(tmp_path / name), tmp_path, "--teacher"), tmp_path / "run")
    assert find_trained(str(tmp_path / "run" / TEACHER), tmp_path, "--teacher").source.checkpoint.name == kept


def test_an_exported_actor_has_a_normalizer_that_has_seen_much(student: Path) -> None:
    """The file holds no count and no variance: an update must not forget the mean that it holds."""
    task = load_task("go2_rough")
    update_from_run(task, load_yaml(student / "config.yaml"), where="config.yaml")
    task.set("env.num_envs", 2)
    task.set("terrain.mesh_type", "plane")
    env = task.env_class(task.cfg, "cpu")
    model = load_policy(student / "model_3.pt", env, task.train, "cpu")
    for value in model.state_dict().values():
        value.zero_()
    begin_with(model, find_trained(str(student / "export"), student.parent, "--init"))
    saved, got = load(student / "model_3.pt")["student_state_dict"], model.state_dict()
    assert torch.equal(got["mlp.2.weight"], saved["mlp.2.weight"]) and torch.equal(
        got["obs_normalizer._mean"], saved["obs_normalizer._mean"]
    )
    torch.testing.assert_close(got["obs_normalizer._var"], saved["obs_normalizer._var"])
    assert got["obs_normalizer.count"] == 10**8 and not got["distribution.std_param"].any()


def test_a_policy_of_one_frame_begins_one_with_a_history(tmp_path: Path, device: str) -> None:
    """It acts as before, whatever the older frames are."""
    shipped = find_trained("go1_flat", tmp_path, "--init")
    narrow, wide = load_task("go1_flat"), load_task("go1_flat")
    for task in narrow, wide:
        update_from_run(task, load_yaml(shipped.source.folder / "config.yaml"), where="config.yaml")
        task.set("env.num_envs", 4)
    wide.set("observations.history", {"state": 3, "state.dof_vel": 1})
    before, after = (task.env_class(task.cfg, device) for task in (narrow, wide))
    check_start(after, wide, shipped)
    kind, options = resolve_class(acting(wide.train, after))
    model = kind(after.get_observations(), wide.train.to_dict()["obs_groups"], "actor", after.num_actions, **options)
    begin_with(model.to(device), shipped, after)
    obs, seen, start, newest = after.get_observations(), before.get_observations(), 0, []
    obs["state"].normal_()
    for row in after.observations.rows("state"):
        start += row.size
        newest.append(obs["state"][:, start - row.value.shape[1] : start])
    seen["state"] = torch.cat(newest, dim=1)
    policy = load_policy(shipped.source.checkpoint, before, narrow.train, device)
    torch.testing.assert_close(model(obs), policy(seen), rtol=1e-4, atol=1e-5)


# ---- what the teacher sees


def seated(env: RobotTask, task: LoadedTask) -> torch.Tensor:
    """The observations that a policy of ``task`` is shown in ``env``, (N, size): a buffer of the step."""
    attach_teacher_observations(env, Trained(PolicySource(Path("run"), Path("run/model_1.pt"), False), task))
    return env.obs_buf[TEACHER]


SCAN = {"terrain.height_scan": ["state"], "terrain.measured_points_x": [-0.1, 0.1], "terrain.measured_points_y": [0.0]}


def test_a_teacher_of_a_task_of_ones_own_is_named_by_its_task(
    teacher: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also while another task trains, whose runs are in another folder."""
    (tmp_path / "own_scan.py").write_text("from configs.go2_rough_scan import TASK\n")
    run = tmp_path / "logs" / "own_scan" / "first"
    shutil.copytree(teacher, run)
    monkeypatch.chdir(tmp_path)
    for name in ("own_scan", "own_scan/first", "own_scan.py", str(tmp_path / "own_scan.py")):
        assert find_trained(name, tmp_path / "logs" / "student", "--teacher").source.folder == run
    with pytest.raises(ConfigError, match="second"):
        find_trained("own_scan/second", tmp_path / "logs" / "student", "--teacher")


def test_the_teacher_sees_its_own_rows_exactly() -> None:
    """In its order, with its history, without noise and delay, whatever the student's are; the student sees what it did before."""
    delayed = {"domain_rand.enable": True, "domain_rand.observation_delay": [1, 2], "domain_rand.encoder_offset": []}
    blind = {"observations.leave_out": {"state": ["base_lin_vel"]}, **SCAN, "terrain.height_scan": ["privileged_state"]}
    env, task = make_env(4, {**delayed, **blind}), load_task("go1_flat")
    for path, value in {**SCAN, "observations.history": {"state.dof_pos": 3}}.items():
        task.set(path, value)
    before = layout(env)
    seen = seated(env, task)
    order = [
        "base_lin_vel",
        "base_ang_vel",
        "projected_gravity",
        "dof_pos",
        "dof_vel",
        "last_actions",
        "commands",
        "height_scan",
    ]
    assert {row.name: row.size for row in env.observations.groups[TEACHER]} == dict(
        zip(order, (3, 3, 3, 36, 12, 12, 3, 2), strict=True)
    )
    assert {group: rows for group, rows in layout(env).items() if group != TEACHER} == before
    offsets = []
    for _ in range(4):
        offsets.append(env.dof_offset.clone())
        env.step(torch.rand(4, 12) - 0.5)
    offsets.append(env.dof_offset.clone())
    env.first_observations() if env.reset_buf.any() else None
    now = [env.base_lin_vel, env.base_ang_vel, env.projected_gravity]
    later = [env.dof_vel, env.last_actions, env.commands, env.height_scan]
    torch.testing.assert_close(seen, torch.cat([*now, *offsets[-3:], *later], dim=1))
    assert env.get_observations()[TEACHER].shape == (4, 74)


def test_a_teacher_may_read_the_privileged_group() -> None:
    env, task = make_env(2, {"observations.leave_out": {"state": ["base_lin_vel"]}}), load_task("go1_flat")
    task.set("obs_groups.actor", ["state", "privileged_state"])
    seen = seated(env, task)
    assert seen.shape == (2, 48 + 123)
    torch.testing.assert_close(seen[:, :48], seen[:, 48:96])  # the privileged group begins with the same sample
    torch.testing.assert_close(seen[:, :3], env.base_lin_vel)


OWN = """
import torch
from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.observations import Row
from legged_mw.utils.task import Task

class Mine(LeggedRobot):
    def observation_rows(self):
        rows = super().observation_rows()
        rows["state"].append(Row("mine", self.buffer(2) + 7.0))
        return rows

TASK = Task(Mine, Go1FlatCfg, Go1FlatCfgPPO)
"""
CHILD = """
from own import Mine, TASK as OWN
from legged_mw.utils.task import Task

class Child(Mine):
    def observation_rows(self):
        return {"state": [row for row in super().observation_rows()["state"] if row.name != "mine"], "privileged_state": ["state"]}

TASK = Task(Child, OWN.cfg, OWN.train)
"""


def test_a_teacher_of_a_class_of_ones_own(tmp_path: Path) -> None:
    """The student's task may add to it or take from it: the teacher sees its own rows. Its file was imported twice by then."""
    (tmp_path / "own.py").write_text(OWN)
    (tmp_path / "child.py").write_text(CHILD)
    student, task = load_task(str(tmp_path / "child.py")), load_task(str(tmp_path / "own.py"))
    student.set("env.num_envs", 2)
    env = student.env_class(student.cfg, "cpu")
    assert not isinstance(env, task.env_class) and env.obs_buf["state"].shape == (2, 48)
    seen = seated(env, task)
    assert seen.shape == (2, 50) and (seen[:, 48:] == 7.0).all()
    with pytest.raises(ConfigError, match="Child"):
        seated(make_env(2), student)


def test_a_new_episode_forgets_what_the_teacher_saw() -> None:
    env, task = make_env(2), load_task("go1_flat")
    task.set("observations.history", {"state.dof_pos": 2})
    seen = seated(env, task)
    env.step(torch.ones(2, 12))
    assert not torch.equal(seen[:, 9:21], seen[:, 21:33])
    env.restart(torch.tensor([True, False]))
    assert torch.equal(seen[0, 9:21], seen[0, 21:33]) and not torch.equal(seen[1, 9:21], seen[1, 21:33])


def test_what_a_teacher_sees_can_be_recorded() -> None:
    env, task = make_env(2), load_task("go1_flat")
    task.set("observations.history", {"state": 2})
    seated(env, task)
    with recordable():
        env.compute_observations()
    # it reads no more
    assert "teacher/state" in env.observations._parts and "teacher/privileged_state" not in env.observations._parts


# ---- bad input: one line each


@pytest.fixture(scope="module")
def env() -> LeggedRobot:
    return make_env(2)


def no_rows(task: LoadedTask) -> None:
    class Hopper(LeggedRobot):
        pass

    task.env_class = Hopper


def one_command_more(task: LoadedTask) -> None:
    base: Any = type(task.cfg)

    class More(base):
        class commands(base.commands):
            class ranges(base.commands.ranges):
                base_height: list[float] = [0.2, 0.3]

    task.cfg = More()


CHANGES: dict[str, tuple[str | Callable[[LoadedTask], None], Any]] = {
    "pose": (
        "init_state.default_joint_angles",
        {"FR_hip": 0.1, "FL_hip": -0.1, "RR_hip": 0.1, "RL_hip": -0.1, "thigh": 0.8, "calf": -1.8},
    ),
    "scale": ("control.action_scale", {"": 0.5, "RL_calf": 0.25}),
    "rate": ("control.decimation", 10),
    "origin": ("control.action_origin", "joints"),
    "torque": ("control.actuator", "torque"),
    "clip": ("normalization.clip_actions", 5.0),
    "clock": ("gait.period", 0.8),
    "scan": ("terrain.height_scan", ["state"]),
    "commands": (one_command_more, None),
    "forces": ("observations.contact_forces", True),
    "class": (no_rows, None),
}


@pytest.mark.parametrize(("change", "value"), CHANGES.values(), ids=CHANGES.keys())
def test_a_policy_that_would_mean_something_else_is_refused(change: Any, value: Any, env: LeggedRobot) -> None:
    task = load_task("go1_flat")
    change(task) if callable(change) else task.set(change, value)
    policy, groups = Trained(PolicySource(Path("run"), Path("run/model_1.pt"), False), task), {*env.observations.groups}
    with pytest.raises(ConfigError, match="^run/model_1.pt "):
        attach_teacher_observations(env, policy)
    with pytest.raises(ConfigError, match="^run/model_1.pt "):
        check_start(env, load_task("go1_flat"), policy)
    assert {*env.observations.groups} == groups


def test_a_network_of_other_rows_is_refused(student: Path, teacher: Path) -> None:
    """A run's config may be changed by hand, or its task's class: the sizes tell."""
    env, found = make_env(2, task="go2_flat"), find_trained(str(teacher), student.parent, "--teacher")
    found.task.set("terrain.height_scan", [])
    attach_teacher_observations(env, found)
    task = load_task("go2_flat")
    runner = make_runner(env, task.train, None, "cpu", found.task.train)
    with pytest.raises(ConfigError, match="53 values"):
        load_teacher(runner.alg.teacher, found, env)  # type: ignore[attr-defined]


def test_without_a_warm_up_rsl_rls_own_learner_begins_with_a_policy(env: LeggedRobot) -> None:
    task = load_task("go1_flat")
    for path, value in {"policy": "run", "critic_warmup": 0}.items():
        task.set(f"warm_start.{path}", value)
    task.set("algorithm.class_name", "PPO")
    std = make_runner(env, task.train, None, "cpu").alg.actor.distribution.std_param
    assert std.mean().item() == pytest.approx(0.2)


def test_rsl_rls_own_distillation_trains_too(tmp_path: Path, root: Path, teacher: Path) -> None:
    small = [
        *shlex.split("--task go1_flat --teacher go1_flat/first --set distillation.class_name=Distillation"),
        *shlex.split("--max_iterations 1"),
    ]
    shutil.copytree(trained(root, "--max_iterations", "1"), root / "logs/go1_flat/first")
    assert "student_state_dict" in load(trained(root, *small) / "model_1.pt")
