"""The programs around training: doctor, compare, sweep, warm, completion, and the viewer beside a training."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from program import SMALL, run
from torch.utils.tensorboard import SummaryWriter

from legged_mw import ROOT, programs
from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl import training
from legged_mw.rl.run_folder import load_tensors, save_whole
from legged_mw.rl.runner import Runner
from legged_mw.sim.device import DeviceFacts, device_facts
from legged_mw.tools import completion, doctor, sweep, warm
from legged_mw.tools.compare import find_runs, read_run
from legged_mw.utils import machine
from legged_mw.utils.cli import one_line_errors
from legged_mw.utils.files import wrong_name
from legged_mw.utils.machine import usable_cores
from legged_mw.utils.task import LoadedTask, load_task
from legged_mw.view import playing
from legged_mw.view.playing import PLAYING, Newest


def program(name: str, *args: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """``legged-mw name args`` in this process."""
    monkeypatch.setattr(sys, "argv", ["legged-mw", name, *args])
    programs.main()


# ---- what the machine draws through


@pytest.mark.parametrize(
    ("asked", "present", "chosen", "line"),
    [
        (None, ["libEGL.so.1"], "egl", ""),
        (None, ["libOSMesa.so.8"], "osmesa", ""),
        (None, [], None, ""),
        ("disable", [], "disable", ""),
        ("glfw", [], "glfw", ""),
        ("egl", ["libEGL.so.1"], "egl", ""),
        (
            *("osmesa", ["libEGL.so.1"], "egl"),
            "MUJOCO_GL=osmesa does not work here: libOSMesa.so.8 is missing (apt install libosmesa6); going on with MUJOCO_GL=egl",
        ),
        (
            *("egl", [], "disable"),
            "MUJOCO_GL=egl does not work here: libEGL.so.1 is missing (apt install libegl1); going on with MUJOCO_GL=disable",
        ),
        (
            *("vulkan", [], "disable"),
            "MUJOCO_GL=vulkan does not work here: there are egl, osmesa, glfw and disable; going on with MUJOCO_GL=disable",
        ),
    ],
)
def test_a_renderer_that_does_not_work_is_replaced_in_one_line(
    asked: str | None, present: list[str], chosen: str | None, line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(name: str) -> None:
        if name not in present:
            raise OSError(name)

    monkeypatch.setattr(machine.ctypes, "CDLL", load)
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    if asked is not None:
        monkeypatch.setenv("MUJOCO_GL", asked)
    assert machine.choose_renderer() == line
    assert os.environ.get("MUJOCO_GL") == chosen


def test_a_wrong_renderer_is_no_traceback() -> None:
    code = "import legged_mw, mujoco"
    environment = {key: value for key, value in os.environ.items() if "DISPLAY" not in key} | {
        "MUJOCO_GL": "none of these"
    }
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("legged_mw: MUJOCO_GL=none of these does not work here: there are ")


# ---- doctor and warm


def test_a_slow_start_has_its_reasons() -> None:
    ready = DeviceFacts("H100", (13, 0), True, Path("cache"), 9, memory=80.0, taken=0.6)
    assert ready.slow() == []
    compiles, shared = ready._replace(compiled=0).slow() + ready._replace(taken=12.3).slow()
    assert compiles.startswith(
        "some 50 modules of kernels are compiled at this first start, a minute or two; `legged-mw warm`"
    )
    assert shared == "another process holds 12 of 80 GiB of this GPU: both run slower (nvidia-smi shows which)"
    pool, driver = ready._replace(pool=False, cuda=(12, 2)).slow()
    assert pool.startswith("this GPU has no memory pool: nothing can be recorded")
    assert driver == "the driver supports CUDA 12.2, and recording is reliable from 12.4 on: update it"
    cpu = device_facts("cpu")
    assert cpu.cuda is None and cpu.memory == cpu.taken == 0.0 and len(cpu.slow()) == (not cpu.compiled)


def test_compiling_says_so(tmp_path: Path) -> None:
    """Kernels of a task that are missing in a cache which holds others; of the GPU, not of the CPU."""
    said = list[str]()
    facts = DeviceFacts("H100", (13, 0), True, tmp_path, 9, binaries="*.sm90*")
    for name, ending in (("old", "sm90.cubin"), ("new", "sm90.cubin"), ("other", "cpu1.o")):
        (tmp_path / f"wp_{name}").mkdir()
        (tmp_path / f"wp_{name}" / f"wp_{name}.{ending}").touch()
    os.utime(tmp_path / "wp_old/wp_old.sm90.cubin", (0, 0))
    assert facts.compiled_since(1.0) == 1

    def listen(facts: DeviceFacts) -> list[str]:
        with facts.say_compiling(said.append, waits=[0.0, 0.0]) as thread:
            thread.join()
        return said

    assert listen(facts) == []  # compiled before this start
    os.utime(tmp_path / "wp_new/wp_new.sm90.cubin", (4e9, 4e9))
    assert listen(facts._replace(compiled=0)) == []
    assert listen(facts) == [
        "kernels that this task needs are being compiled, 1 modules so far; the next start has them"
    ]
    with facts.say_compiling(said.append, waits=[60.0]) as thread:
        pass
    thread.join()
    assert len(said) == 1


def small_task(name: str, **_: Any) -> LoadedTask:
    task = load_task(name)
    few = {"envs_per_core": 4, "num_steps_per_env": 4, "hidden_dims": [16]}
    task.update({"cpu": few, "terrain": {"mesh_type": "plane"}} if name != "go1_rough" else {"cpu": few}, where="test")
    return task


def test_doctor_says_what_is_there_and_what_mends(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "draws", lambda name: "EGLError: no device" if name == "egl" else "")
    monkeypatch.setattr(doctor, "gl_fault", lambda name: "")
    monkeypatch.setattr(doctor, "has_display", lambda: False)
    monkeypatch.setattr(doctor, "load_task", small_task)
    monkeypatch.setattr(doctor, "SPEED_TASKS", ("go1_flat",))
    monkeypatch.setattr(os, "getloadavg", lambda: (99.0, 0.0, 0.0))
    found = doctor.importlib.util.find_spec
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None if name == "onnxruntime" else found(name))
    program("doctor", "--device", "cpu", "--seconds", "0.1", monkeypatch=monkeypatch)
    said = capsys.readouterr().out
    for line in (
        "    egl            EGLError: no device\n",
        "    osmesa         draws\n",
        "    glfw           no screen\n",
        "    onnxruntime    not installed; it runs an export: pip install 'legged_mw[deploy]'\n",
        "load 99.0\n",
        "  cores: other programs use this machine: the measured speed is too low\n",
    ):
        assert line in said
    assert f"torch          {torch.__version__}\n" in said and "tasks, " in said
    [speed] = [line for line in said.splitlines() if "steps/s" in line]
    assert speed.startswith("    go1_flat ") and "iterations in " in speed and "worlds, ready after" in speed


def cells(row: str) -> list[str]:
    return [cell.strip() for cell in row.strip().strip("|").split("|")]


def test_doctor_prints_a_row_of_the_table(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """One line on stdout, with a cell for each column of docs/your_gpu.md."""
    monkeypatch.setattr(doctor, "load_task", small_task)
    program("doctor", "--benchmark", "--device", "cpu", "--seconds", "0.1", monkeypatch=monkeypatch)
    [row] = capsys.readouterr().out.splitlines()
    heads = [line for line in (ROOT / "docs/your_gpu.md").read_text().splitlines() if line.startswith("| machine")]
    found = dict(zip(cells(heads[0]), cells(row), strict=True))
    assert found["worlds"] == str(4 * usable_cores()) and f"torch {torch.__version__}" in found["versions"]
    assert min(float(found[name].replace(",", "")) for name in ("`env.step`", "training", "memory")) > 0


@pytest.mark.parametrize(("fits", "said"), [(True, ["8192", "4.0", "0.37; 27,716"]), (False, ["1024", "1.4", "-"])])
def test_what_fits_a_gpu_follows_from_two_numbers_of_worlds(
    fits: bool, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def measure(name: str, device: str, seconds: float, worlds: int) -> doctor.Speed:
        if not worlds and not fits:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")
        return doctor.Speed(worlds or 8192, 1.0, 2e6, 1e6, 10, 5.0, 1.375 if worlds else 4.0)

    monkeypatch.setattr(doctor, "measure", measure)
    monkeypatch.setattr(doctor, "_processor", lambda device: ("H100", "580"))
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (0, int(11.15 * 2**30)))
    row = cells(doctor.benchmark("cuda:0", 60.0))
    assert [row[4], row[7], row[8]] == said


def test_doctor_fails_where_nothing_can_train(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    version = doctor._version
    others = {"mujoco-warp": "", "onnxscript": "0.5.4"}
    monkeypatch.setattr(doctor, "_version", lambda name: others.get(name, version(name)))
    monkeypatch.setattr(
        doctor.metadata,
        "requires",
        lambda _: ["mujoco-warp<4.1,>=4.0", "onnxscript>=0.6", "torch", 'av; extra == "video"'],
    )
    monkeypatch.setattr(doctor, "draws", lambda name: "")
    with pytest.raises(SystemExit, match="1"):
        program("doctor", monkeypatch=monkeypatch)
    said = capsys.readouterr().out
    assert "  mujoco-warp: pip install 'mujoco-warp<4.1,>=4.0'\n" in said and "Speed" not in said
    assert (
        "  ! onnxscript     0.5.4, which is not >=0.6\n" in said
        and "  onnxscript: pip install 'onnxscript>=0.6'\n" in said
    )


def test_doctor_goes_on_without_torch(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    version = doctor._version
    monkeypatch.setattr(doctor, "_version", lambda name: "" if name == "torch" else version(name))
    monkeypatch.setattr(doctor, "draws", lambda name: "")
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(SystemExit, match="1"):
        program("doctor", monkeypatch=monkeypatch)
    said = capsys.readouterr().out
    assert "\nExtras\n" in said and "  torch: pip install" in said


def test_drawing_is_tried_in_another_process() -> None:
    assert (
        doctor.draws("no such thing") == "RuntimeError: invalid value for environment variable MUJOCO_GL: no such thing"
    )


def test_warm_steps_each_task(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    warmed: list[tuple[str, str]] = []
    monkeypatch.setattr(warm, "warm", lambda *args: warmed.append(args))
    monkeypatch.setattr(warm, "warm_engine", lambda *args: warmed.append(args))
    program("warm", "go1_flat", "--device", "cpu", monkeypatch=monkeypatch)
    assert warmed == [("go1_flat", "cpu"), ("go1_flat",)]
    assert "on a CPU MuJoCo's own engine trains: few kernels" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        program("warm", "go1_flat", "nosuch", "--device", "cpu", monkeypatch=monkeypatch)
    assert len(warmed) == 2  # a wrong name is refused before the first task compiles


def test_warm_trains_an_iteration(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """So that the learner's own kernels are compiled too; and the fused step's, of as many worlds as will train."""
    learned, fused = list[int](), list[int]()
    learn = Runner.learn
    monkeypatch.setattr(Runner, "learn", lambda self, count: (learned.append(self.env.num_envs), learn(self, count)))
    monkeypatch.setattr(RobotTask, "fuse", lambda env, steps: fused.append(env.num_envs))
    monkeypatch.setattr(warm, "load_task", small_task)
    warm.warm("go1_flat", "cpu")
    assert learned == fused == [4 * usable_cores()] and capsys.readouterr().out == ""


# ---- compare and sweep


def write_run(folder: Path, seed: int = 1, gamma: float = 0.99, reward: float = 1.0) -> Path:
    """A run of ten iterations, and its curves."""
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(f"task: go1_flat\nalgorithm:\n  gamma: {gamma}\nseed: {seed}\n")
    with SummaryWriter(folder) as writer:
        for i in range(1, 11):
            curves = {
                "Train/mean_reward": reward * i,
                "Train/total_steps": 1e6 * i,
                "Perf/total_fps": 5000.0,
                "Loss/value": float("nan"),
            }
            curves |= {"Exam/falls": 1.0} if i == 10 else {}
            for name, value in curves.items():
                # resumed after a pause
                writer.add_scalar(name, value, i, walltime=1000.0 + 2.0 * i + (500.0 if i > 5 else 0.0))
    return folder


def test_compare_prints_figures_exams_and_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    one, two = (
        write_run(tmp_path / "logs/go1_flat/one"),
        write_run(tmp_path / "logs/go1_flat/two", gamma=0.97, reward=3.0),
    )
    (two / "eval").mkdir()
    exam = {"falls": 2, "error": [0.01, 0.02, 0.03], "walks": True, "rules": {"x": 1}}
    (two / "eval/report.json").write_text(json.dumps({"columns": [{"exam": exam}]}))
    os.utime(next(two.glob("events*")), (2e9, 2e9))  # the last run of the task
    program("compare", str(one), "go1_flat", monkeypatch=monkeypatch)
    figures, graded, settings, curves = [
        [line.split() for line in part.splitlines()] for part in capsys.readouterr().out.split("\n\n")
    ]
    head, first, second = figures
    assert head == ["run", "iterations", "M", "steps", "minutes", "steps/s", "reward", "falls"]
    assert (
        first == ["one", "10", "10.0", "0.3", "5,000", "10.00", "1.000"] and second[0] == "two" and second[5] == "30.00"
    )
    assert graded[1] == settings[1] == ["one", "two"] and ["error", "yaw", "rate", "-", "0.03"] in graded
    assert settings[2:] == [["algorithm.gamma", "0.99", "0.97"]]
    assert curves == [["curves:", "tensorboard", "--logdir", "logs/go1_flat"]]


def test_a_run_without_an_exam_is_compared(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    (run / "eval").mkdir()
    (run / "eval/report.json").write_text(json.dumps({"columns": [{"exam": None}]}))
    [found] = find_runs([str(run)])
    assert (found.iterations, found.graded) == (10, {})


def said(folder: Path, exam: str = "", end: str = "done: x; watch it with\n") -> str:
    """What a training prints."""
    exam = f"exam after 10 iterations: {exam}\n" if exam else ""
    return f"writing to {folder}\nLearning iteration 1/2: ...\n{exam}{end}"


def test_a_sweep_trains_every_combination_and_ends_with_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[list[str]] = []

    def run(trainings: list[sweep.Training], at_once: int, _: sweep.Stop) -> Iterator[tuple[int, int]]:
        for i in (1, 0, 3, 2):  # two at a time end in any order
            asked.append(trainings[i].flags)
            folder = write_run(tmp_path / f"{i}", reward=i + 1) if i < 3 else ""
            trainings[i].log.write_text(said(folder) if folder else "train.py: wrong\n")
            yield i, 0 if folder else 2

    monkeypatch.setattr(sweep, "run", run)
    flags = ["--seeds", "1,2", "--set", "algorithm.gamma=0.9,0.97", "--set", "actor.hidden_dims=[64, 32]"]
    with pytest.raises(SystemExit, match="1"):
        program("sweep", "--task", "go1_flat", *flags, monkeypatch=monkeypatch)
    assert asked[1] == [
        *["--task", "go1_flat", "--set", "algorithm.gamma=0.9", "--set", "actor.hidden_dims=[64, 32]"],
        *["--set", "seed=1", "--run_name", "gamma=0.9_seed=1"],
    ]
    out = capsys.readouterr().out
    assert "3/4 gamma=0.97 seed=2: train.py: wrong\n" in out
    lines = [line.split() for line in out.split("\n\n")[1].splitlines()]
    assert lines[0] == ["gamma", "seed", "iterations", "M", "steps", "minutes", "steps/s", "reward", "falls"]
    assert [(line[0], line[1], line[6]) for line in lines[1:4]] == [
        ("0.9", "1", "10.00"),
        ("0.9", "2", "20.00"),
        ("0.97", "1", "30.00"),
    ]
    assert lines[4][:4] == ["0.9", "mean", "of", "2"] and "15.00 ± 7.07" in " ".join(lines[4])


def test_a_sweep_ends_where_a_signal_stops_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert sweep.STOPPED == training.STOPPED
    code = "import sys; print('writing to x'); sys.exit(int(sys.argv[1]))"
    monkeypatch.setattr(sweep, "TRAIN", [sys.executable, "-Sc", code])
    trainings = [sweep.Training(f"{i}", [f"{end}"], tmp_path / f"{i}") for i, end in enumerate((0, sweep.STOPPED, 0))]
    stop = sweep.Stop()
    assert [*sweep.train_all(trainings, 1, stop)] == [0, 1] and stop.asked
    assert sweep.train_all(trainings, 1, stop) == {}  # a signal before the first


FAKE = """
import os, signal, sys
told = os.open(sys.argv[1], os.O_WRONLY)
def ask(number, _):
    os.write(told, signal.Signals(number).name.encode())
    sys.exit(3)
if sys.argv[2] == "trains":
    signal.signal(signal.SIGTERM, ask)
signal.signal(signal.SIGALRM, lambda *_: os.write(told, b"nobody asked") and sys.exit(1))
signal.alarm(120)
os.write(told, b"begins\\n")
while True:
    signal.pause()
"""  # what a training is to a sweep


@pytest.mark.parametrize(
    ("name", "state"),
    [("SIGTERM", "starts"), ("SIGINT", "trains"), ("SIGTERM", "trains"), ("SIGHUP", "trains"), ("SIGKILL", "trains")],
)
def test_no_training_outlives_its_sweep(name: str, state: str, tmp_path: Path) -> None:
    """And no other begins; one that has not yet begun to train is not there to save.

    The signal goes to the whole group, twice, as from ``timeout`` or a terminal that closes: a training takes a second
    SIGTERM as: at once, without saving.
    """
    (tmp_path / "fake.py").write_text(FAKE)
    os.mkfifo(tmp_path / "told")
    fake = [sys.executable, "fake.py", "told", state]
    code = f"from legged_mw.tools import sweep\nsweep.TRAIN, sweep.check = {fake}, lambda *_: None\nsweep.main()\n"
    command = [sys.executable, "-c", code, "--task", "go1_flat", "--seeds", "1,2,3", "--jobs", "2"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=-1, text=True, start_new_session=True) as ours:
        with open(tmp_path / "told") as told:
            assert told.readline() == told.readline() == "begins\n"
            for _ in range(2):
                os.killpg(ours.pid, signal.Signals[name])
            assert told.read() == ("SIGTERM" * 2 if state == "trains" else "")  # to its end, when nobody holds it open
        assert ours.stdout and "3/3" not in ours.stdout.read()
    assert ours.returncode == (-signal.SIGKILL if name == "SIGKILL" else 1)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--set", "algorithm.gamma=0.9,5"], "algorithm.gamma"),
        (["--set", "algorithm.gama=0.9"], "gama"),
        (["--num_envs", "none"], "--num_envs"),
        (["--nonsense"], "--nonsense"),
        (["--seed", "3"], "--seed"),  # of all trainings, whatever their names say
        (["--set", "seed=3"], "seed"),
        (["--num_envs", "8", "--set", "env.num_envs=16,32"], "--num_envs"),
    ],
)
def test_a_wrong_value_is_found_before_the_first_training(
    flags: list[str], said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sweep, "run", lambda *_: pytest.fail("it began"))
    with pytest.raises(SystemExit, match="2"):
        program("sweep", "--task", "go1_flat", "--seeds", "1,2", *flags, monkeypatch=monkeypatch)
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1


def test_means_are_of_numbers_not_of_what_is_printed(tmp_path: Path) -> None:
    cells = sweep.make_cells([], ["1", "2", "3"])
    found = [
        (cell, read_run(write_run(tmp_path / cell.name, reward=0.0023 + 5e-5 * i), "")) for i, cell in enumerate(cells)
    ]
    assert "0.02350 ± 0.00050" in sweep.table(found).splitlines()[-1]


def test_values_stand_apart_by_commas() -> None:
    assert (
        sweep.values("1,2") == ["1", "2"] and sweep.values("[1,2],[3]") == ["[1,2]", "[3]"] and sweep.values("") == []
    )
    assert sweep.values("{a: [1,2]},'x,y'") == ["{a: [1,2]}", "'x,y'"]


def test_many_values_make_a_name_that_a_folder_can_have() -> None:
    settings = [f"{section}.hidden_dims=[512,256,128,64,64,64,64],[256,128,64]" for section in ("actor", "critic")]
    cells = sweep.make_cells([*settings, "rewards.scales.tracking_lin_vel=1,2", "rewards.scales.torques=1,2"], [])
    labels = [cell.label for cell in cells]
    assert len(cells[0].name) > 100 and len({*labels}) == 16 and not any(map(wrong_name, labels))


def test_a_log_says_where_a_training_writes_and_how_it_ended(tmp_path: Path) -> None:
    (file := tmp_path / "log").write_text(said(tmp_path, "falls 3.000, error_vx 0.125"))
    log = sweep.read_printed(file)
    assert log.folder == str(tmp_path) and log.done and log.exam == {"falls": 3.0, "error_vx": 0.125}
    file.write_text(said(tmp_path, "falls 3.000", "stopped: SIGTERM; go on with\n  train --resume --max_time 37s\n"))
    assert sweep.read_printed(file) == sweep.Printed(
        str(tmp_path), "stopped: SIGTERM; go on with", False, "37s", {}, False
    )
    file.write_text(file.read_text() + "killed as it began again\n")
    assert sweep.read_printed(file)[1:4] == ("killed as it began again", False, "37s")
    file.write_text("bad\nlast\nfailed: code 2\n")
    assert sweep.read_printed(file)[:3] == ("", "failed: code 2", False) and sweep.read_printed(file).failed
    file.write_text("failed: code 3\n")
    assert not sweep.read_printed(file).failed  # a signal


def test_trainings_at_a_time_share_the_cores() -> None:
    assert sweep.shares_of([0, 1, 4, 5, 6], 2) == [[0, 1], [4, 5]] and sweep.shares_of([2, 3], 1) == [[2, 3]]
    assert sweep.shares_of([2, 3], 3) == [[2], [3], [2]]


def test_settings_are_ranked_by_their_places_in_each_figure() -> None:
    """Not by the figures themselves, whose units differ; and those that lack an exam come after all that do not."""
    better = {"error": False, "pushes": True}
    exams = {
        "a": [{"error": 0.5, "pushes": 0.2}, {"error": 0.1, "pushes": 0.2}],  # means 0.3, 0.2: places 2 and 3
        "b": [{"error": 0.2, "pushes": 0.9}, {"error": 0.2, "pushes": 0.7}],  # 1 and 1
        "best, in one of two": [{"error": 0.0, "pushes": 1.0}, {}],
        "none": [{}, {}],
        "c": [{"error": 9.0, "pushes": 0.5}, {"error": 9.0, "pushes": 0.5}],  # 3 and 2, before a only by "error"
    }
    assert sweep.rank(exams, better) == ["b", "a", "c", "best, in one of two", "none"]
    assert sweep.rank(exams, {"pushes": True})[:3] == ["b", "c", "a"]
    assert sweep.rank(exams, {"pushes": True, "unknown": False})[:3] == ["b", "c", "a"]
    assert sweep.ranked_figures("getup") == {"stands": True, "stays": True}


class Cluster:
    """Trains nothing: the exam is the worse the farther gamma is from 0.97, and seed 2 falls once more."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.asked, self.breaks, self.stops = folder, list[str](), "", ""

    def run(self, trainings: list[sweep.Training], at_once: int, stop: sweep.Stop) -> Iterator[tuple[int, int]]:
        for i, each in enumerate(trainings):
            words = dict(zip(each.flags, each.flags[1:], strict=False))
            gamma, seed = (next(w.rpartition("=")[2] for w in each.flags if name in w) for name in ("gamma=", "seed="))
            new = f"{gamma} {seed} {words['--max_time']}"
            self.asked.append(f"{new} resumed" if "--resume" in words else new)
            run = Path(words.get("--load_run", self.folder / f"{gamma}_{seed}"))
            if gamma + seed == self.breaks:
                each.log.write_text("train.py: broken\n")
                yield i, 2
                continue
            if not run.exists():
                write_run(run)
            if gamma + seed == self.stops:
                each.log.write_text(said(run, "", "stopped: SIGTERM; go on with\n  train --max_time 37s\n"))
                yield i, sweep.STOPPED
                return
            each.log.write_text(said(run, f"error_vx {abs(float(gamma) - 0.97):.3f}, falls {seed}.000"))
            yield i, 0


HALVE = ["sweep", "--task", "go1_flat", "--halve", "--seeds", "1,2", "--set", "algorithm.gamma=0.9,0.97,0.99,0.8"]
FIRST = [f"{gamma} {seed} 60s" for gamma in ("0.9", "0.97", "0.99", "0.8") for seed in (1, 2)]


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cluster:
    made = Cluster(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sweep, "run", made.run)
    return made


def halve(monkeypatch: pytest.MonkeyPatch, *more: str, code: int = 0, time: str = "60s") -> None:
    if code:
        with pytest.raises(SystemExit, match=str(code)):
            program(*HALVE, "--max_time", time, *more, monkeypatch=monkeypatch)
    else:
        program(*HALVE, "--max_time", time, *more, monkeypatch=monkeypatch)


def test_halving_trains_the_best_third_three_times_as_long(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    halve(monkeypatch, "--rounds", "2")
    second = [f"{gamma} {seed} 180s resumed" for gamma in ("0.97", "0.99") for seed in (1, 2)]
    assert cluster.asked == [*FIRST, *second]
    cluster.asked.clear()
    halve(monkeypatch)  # the third round was left out: one setting goes on alone
    assert cluster.asked == ["0.97 1 540s resumed", "0.97 2 540s resumed"]
    cluster.asked.clear()
    capsys.readouterr()
    halve(monkeypatch)
    out = capsys.readouterr().out
    lines = [line.split()[:3] for line in out.split("\n\n")[0].strip().splitlines()]
    assert lines[0] == ["gamma", "seed", "rounds"] and not cluster.asked
    assert lines[1:5] == [["0.97", "1", "3"], ["0.97", "2", "3"], ["0.99", "1", "2"], ["0.99", "2", "2"]]
    assert out.endswith(
        "best: gamma=0.97; watch it with\n  legged-mw play --task go1_flat --load_run 0.97_1\n".replace(
            "0.97_1", str(cluster.folder / "0.97_1")
        )
    )
    halve(monkeypatch, code=2, time="61s")
    assert "logs/go1_flat_halving holds another sweep, --task go1_flat " in capsys.readouterr().err


def test_halving_goes_on_after_a_signal_and_a_failure(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster.stops = "0.971"
    halve(monkeypatch, code=sweep.STOPPED)
    assert "stopped in round 1; go on with\n  legged-mw sweep --task go1_flat --halve" in capsys.readouterr().out
    assert cluster.asked == FIRST[:3]
    cluster.asked, cluster.stops, cluster.breaks = [], "", "0.971"
    halve(monkeypatch, "--rounds", "2", code=1)
    assert cluster.asked[0] == "0.97 1 37s resumed" and cluster.asked[6:] == [
        f"{gamma} {seed} 180s resumed" for gamma in ("0.9", "0.99") for seed in (1, 2)
    ]  # 0.97 lacks an exam
    assert "best: gamma=0.99; " in (out := capsys.readouterr().out) and "some failed: " in out
    for file in (cluster.folder / "logs/go1_flat_halving").glob("round_1_*"):
        file.write_text("x")
    cluster.breaks, cluster.run = "", lambda trainings, *_: iter((i, 2) for i in range(len(trainings)))  # type: ignore[method-assign]
    monkeypatch.setattr(sweep, "run", cluster.run)
    halve(monkeypatch, code=2)
    assert "round 1: no training has an exam" in capsys.readouterr().err


def test_a_cluster_gets_the_lines_of_a_round(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Eight, of which one fails and notes it; then, of those ranked, the next round's."""
    halve(monkeypatch, "--print")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 8 and not cluster.asked
    for line in lines:
        flags = shlex.split(line.partition(" >> ")[0])[2:]
        log = cluster.folder / shlex.split(line)[-1]
        next(cluster.run([sweep.Training("", flags, log)], 1, sweep.Stop()))
    log.write_text("killed\nfailed: code 137\n")  # 0.8, seed 2
    halve(monkeypatch, "--print")
    second = capsys.readouterr().out.splitlines()
    assert len(second) == 4 and all("--max_time 180s --resume --load_run" in line for line in second)
    halve(monkeypatch, "--print", "--rounds", "1", code=1)
    out, err = capsys.readouterr()
    assert out == "" and "best: gamma=0.97; " in err and "some failed: " in err


# ---- completion


@pytest.fixture(scope="module")
def bash() -> str:
    return completion.script("bash", programs.PROGRAMS)


def completed(script: str, line: str, folder: Path) -> set[str]:
    """What bash offers at the end of ``line``; words are apart by spaces."""
    words = line.split(" ")
    array = " ".join(f"'{word}'" for word in words)
    code = (
        f"{script}\nCOMP_WORDS=({array}); COMP_CWORD={len(words) - 1}\n_legged_mw\n"
        + 'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(["bash", "--norc", "-c", code], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


def test_completion_knows_programs_flags_tasks_fields_and_runs(bash: str, tmp_path: Path) -> None:
    (tmp_path / "logs/go1_flat/a_run").mkdir(parents=True)
    (tmp_path / "mine.py").touch()
    for line, offered in (
        ("legged-mw d", {"deploy", "doctor"}),
        ("legged-mw train --max", {"--max_iterations", "--max_time"}),
        ("legged-mw train --task g1_t", {"g1_track"}),
        ("legged-mw play --task m", {"mine.py"}),
        ("legged-mw train --set rewards.scales.tracking_l", {"rewards.scales.tracking_lin_vel="}),
        ("legged-mw train --set control.damp", {"control.damping="}),
        ("legged-mw play --viewer n", {"native", "none"}),
        ("legged-mw play --load_run logs", {"logs/go1_flat/a_run"}),
        ("legged-mw compare l", {"logs/go1_flat/a_run"}),
        ("legged-mw deploy go1_r", {"go1_rough", "go1_rough_scan", "go1_rough_student"}),
        ("legged-mw train --set env.num_envs = 6", set()),
    ):
        assert completed(bash, line, tmp_path) == offered, line


def test_zsh_reads_the_same_functions(bash: str) -> None:
    zsh = completion.script("zsh", {"warm": programs.PROGRAMS["warm"]})
    assert (
        zsh.splitlines()[1] == "autoload -U +X bashcompinit && bashcompinit"
        and "complete -F _legged_mw legged-mw" in zsh
    )


# ---- a viewer beside a training


def test_play_follows_the_newest_policy(made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "logs/go1_flat/run"
    folder.mkdir(parents=True)
    for file in (*made.parent.glob("model_*.pt"), made.parent / "config.yaml"):
        shutil.copy2(file, folder)
    newest = max(folder.glob("model_*.pt"))
    content = torch.load(newest, weights_only=True)
    save_whole({"actor_state_dict": content["actor_state_dict"], "iter": 7}, folder / PLAYING)
    said: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        step = Newest.__call__

        def note(self: Newest) -> None:
            step(self)
            said.append(self.news)

        patch.setattr(Newest, "__call__", note)
        flags = ["--task", "go1_flat", "--device", "cpu", "--follow", "--viewer", "none", "--time", "0.1s"]
        result = run("play", tmp_path, *flags)
    assert result.code == 0 and set(said) == {"iteration 7"}, result.err
    refused = run("play", tmp_path, "--task", "go1_flat", "--follow", "--eval")
    assert (
        refused.code == 2
        and "--follow watches the newest policy: leave --eval, --export and --checkpoint out" in refused.err
    )


def test_a_viewer_outlives_a_thinned_checkpoint(tmp_path: Path) -> None:
    (gone := tmp_path / "model_4.pt").touch()
    newest = Newest(tmp_path, lambda path: gone.unlink() or load_tensors(path, "cpu")["iter"], tmp_path / "model_3.pt")
    newest()
    assert newest.news == "iteration 3"


def test_a_training_goes_on_without_a_viewer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runner: Any = SimpleNamespace(save=lambda path: Path(path).write_bytes(b""), current_learning_iteration=7)
    playing.watch_training(load_task("go1_flat"), runner, tmp_path / "gone")
    assert capsys.readouterr().out == "WARNING: no viewer opens: cannot write model_7.pt (No such file or directory)\n"


def test_a_viewer_ends_with_its_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "model_3.pt").touch()
    newest = Newest(tmp_path, lambda path: 3, tmp_path / "model_3.pt")
    newest()
    assert newest.news == "iteration 3"
    monkeypatch.setattr(os, "getppid", lambda: 1)
    newest._next = 0.0
    with pytest.raises(KeyboardInterrupt):
        newest()


def test_training_with_play_starts_a_viewer_and_feeds_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[list[str]] = []
    ended: list[Any] = []

    def popen(command: list[str], **_: Any) -> Any:
        started.append(command)
        return SimpleNamespace(poll=lambda: None, terminate=lambda: ended.append(True))

    monkeypatch.setattr(playing.subprocess, "Popen", popen)
    monkeypatch.setattr(playing, "_SAVE_SECONDS", 0.0)
    monkeypatch.setattr(playing, "has_display", lambda: False)
    kept: list[tuple[Any, ...]] = []
    monkeypatch.setattr(playing.atexit, "register", lambda *args: kept.append(args))
    result = run("train", tmp_path, *SMALL, "--max_iterations", "2", "--play")
    assert result.code == 0, result.err
    [folder] = (tmp_path / "logs/go1_flat").iterdir()
    [command] = started
    assert command[command.index("play") :] == [
        *("play", "--task", "go1_flat", "--load_run", str(folder), "--follow", "--device", "cpu", "--viewer", "web")
    ]
    assert torch.load(folder / PLAYING, weights_only=True)["iter"] == 2 and (folder / "model_0.pt").exists()
    [(end, viewer, file)] = kept
    end(viewer, file)
    assert ended and not file.exists()


# ---- what a start imports


NOT_TO_TRAIN = [
    *(
        "matplotlib",
        "onnxscript",
        "onnxruntime",
        "warp",
        "mujoco_warp",
        "PIL",
        "mujoco.studio",
        "mujoco.viewer",
        "av",
        "cyclonedds",
    ),
    *("wandb", "scipy", "pandas", "sympy", "onnx", "torch._dynamo.eval_frame", "torch._inductor", "legged_mw.motion"),
    *(
        "legged_mw.view",
        "legged_mw.deploy",
        "legged_mw.robot.picture",
        "legged_mw.drawing",
        "legged_mw.export",
        "legged_mw.tools",
    ),
]
WHAT_IS_THERE = """
import os, sys
from legged_mw import programs
programs.start_quickly()  # as programs.train does, which is called too late for it here
from legged_mw.rl.runner import Runner
learn = Runner.learn
def learn_once(self, *_):
    learn(self, 1)
    print("there:", *[name for name in os.environ["NAMES"].split() if name in sys.modules])
    raise SystemExit
Runner.learn = learn_once
programs.train()
"""


def test_a_training_on_a_cpu_imports_what_it_needs(tmp_path: Path) -> None:
    """What costs time to import, and only some programs need; a whole iteration, checkpoint included."""
    command = [
        sys.executable,
        "-c",
        WHAT_IS_THERE,
        *["--task", "go1_flat", "--device", "cpu", "--num_envs", "8", "--eager"],
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NAMES": " ".join([*NOT_TO_TRAIN, "torch"])}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "there: torch"


@pytest.mark.parametrize(
    ("program", "without"),
    [("train --help", "torch"), ("train --no_such_flag", "torch"), ("--help", "numpy")],
)
def test_what_asks_for_words_imports_no(program: str, without: str) -> None:
    code = f"import sys; sys.modules[{without!r}] = None; from legged_mw.programs import main; main()"
    done = subprocess.run([sys.executable, "-c", code, *program.split()], cwd=ROOT, capture_output=True, text=True)
    said = "legged-mw train: unrecognized arguments: --no_such_flag" if "no_such" in program else ""
    assert done.stderr.startswith(said) and done.returncode == (2 if said else 0), done.stderr


def test_comparing_runs_needs_no_torch() -> None:
    subprocess.run(
        [sys.executable, "-c", "import sys, legged_mw.tools.sweep; sys.exit('torch' in sys.modules)"],
        cwd=ROOT,
        check=True,
    )


def test_errors_of_tools_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit), one_line_errors("legged-mw completion"):
        completion.parser_of("nothing", lambda: None)
    assert capsys.readouterr().err == "legged-mw completion: legged-mw nothing reads no flags\n"
