"""legged-mw doctor: show what this machine has, what is missing with the command that fixes it, and how fast it trains.

With --benchmark it prints one line instead, a row of the table in docs/your_gpu.md, to paste into an issue.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import platform
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from packaging.requirements import Requirement

from legged_mw import ROOT
from legged_mw.utils.cli import Parser, pick_device, seed_everything
from legged_mw.utils.machine import gl_fault, has_display, usable_cores
from legged_mw.utils.task import load_task, task_names

if TYPE_CHECKING:
    from legged_mw.envs.robot_task import RobotTask

SPEED_TASKS = ("go1_flat", "g1_flat", "go1_rough")
FEW = 1024  # worlds of a second measurement on a GPU: the difference gives the memory per world
GIB = 2**30
# for a legged_mw that is on the path but not installed
_LIBRARIES = ("mujoco", "mujoco-warp", "warp-lang", "torch", "rsl-rl-lib", "tensordict")
_CUDA_WHEELS = "pip install --force-reinstall torch --index-url https://download.pytorch.org/whl/cu130"
_DRAW = "import mujoco\nc = mujoco.GLContext(64, 64)\nc.make_current()\nmujoco.MjrContext(mujoco.MjModel.from_xml_string('<mujoco/>'), 100)"


class Finding(NamedTuple):
    """One line of the output. ``mend``: the command or advice that fixes it; empty if nothing is missing."""

    what: str
    said: str
    mend: str = ""
    needed: bool = False  # required for training


class Peak:
    """Measures the peak memory of a GPU [byte], used by all processes, as the driver reports it."""

    def __init__(self, device: str) -> None:
        self.device, self.most = device, 0

    def read(self) -> int:
        import torch

        free, total = torch.cuda.mem_get_info(self.device)
        self.most = max(self.most, total - free)
        return total - free

    @contextlib.contextmanager
    def watched(self) -> Iterator[None]:
        done = threading.Event()

        def watch() -> None:
            while not done.wait(0.005):
                self.read()

        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()
            self.read()


class Speed(NamedTuple):
    """The measured speed of a task."""

    worlds: int
    ready: float  # [s] until all graphs are recorded
    step: float  # [steps/s] of all worlds, env.step only
    training: float  # [steps/s] of all worlds, with policy and update
    iterations: int  # of a whole training
    minutes: float  # estimated, of a whole training
    memory: float  # [GiB] peak: on a GPU of all processes, on a CPU of this process


def parse() -> tuple[str | None, float, bool]:
    """Parse the flags. Returns the device, the duration of the speed test [s], and whether to print one line only."""
    parser = Parser(prog="legged-mw doctor", description=__doc__, allow_abbrev=False)
    parser.add_argument(
        "--device", metavar="D", help="what to measure on: cuda:0, cpu (default: the GPU if there is one)"
    )
    parser.add_argument(
        "--seconds",
        type=float,
        metavar="S",
        help="how long to train for the speed (default: 30, with --benchmark 60); 0 leaves it out",
    )
    parser.add_argument("--benchmark", action="store_true", help="measure go1_flat and print one line to paste")
    args = parser.parse_args()
    seconds = (60.0 if args.benchmark else 30.0) if args.seconds is None else args.seconds
    return args.device, seconds, args.benchmark


def main() -> None:
    device_flag, seconds, one_line = parse()
    if one_line:
        print(
            f"go1_flat trains for about {seconds:g} s; paste the next line into an issue", file=sys.stderr, flush=True
        )
        print(benchmark(pick_device(device_flag), seconds))
        return
    missing: list[Finding] = []
    sections: tuple[tuple[str, Callable[[], Iterator[Finding]]], ...] = (
        ("This machine", machine),
        ("Training", training),
        ("GPUs", gpus),
        ("Pictures", pictures),
        ("Extras", extras),
    )
    for title, find in sections:
        print(f"\n{title}")
        try:
            for finding in find():
                print(f"  {'!' if finding.mend else ' '} {finding.what:<14} {finding.said}", flush=True)
                missing += [finding] * bool(finding.mend)
        except ImportError as error:  # of a library that Training has named
            print(f"    not known: {error}", flush=True)
    if seconds > 0 and not any(finding.needed for finding in missing):
        device = pick_device(device_flag)
        print(f"\nSpeed on {device}, {seconds:g} s", flush=True)
        for name in SPEED_TASKS:
            print(f"    {name:<14} {speed(name, device, seconds / len(SPEED_TASKS))}", flush=True)
    print("\nNothing is missing." if not missing else "\nTo mend:")
    for finding in missing:
        print(f"  {finding.what}: {finding.mend}")
    if any(finding.needed for finding in missing):
        raise SystemExit(1)


# ---- the findings


def machine() -> Iterator[Finding]:
    """Python, cores, memory, disk and location of the package."""
    version = platform.python_version()
    fits = (3, 11) <= sys.version_info[:2] <= (3, 13)
    mend = "" if fits else "legged_mw runs on Python 3.11, 3.12 and 3.13"
    yield Finding("Python", f"{version}, {sys.executable}", mend, needed=not fits)
    yield Finding("system", f"{platform.system()} {platform.release()}, {platform.machine()}")
    memory = ""
    if hasattr(os, "sysconf"):
        memory = f", {os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB of memory"
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    others = "other programs use this machine: the measured speed is too low"
    busy = others if load > usable_cores() + 0.5 else ""
    yield Finding("cores", f"{usable_cores()} for this process, of {os.cpu_count()}{memory}; load {load:.1f}", busy)
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    mend = "" if free > 1.0 else "a run writes up to a few hundred MB: free some disk, or start elsewhere"
    yield Finding("disk", f"{free:.1f} GiB free in {Path.cwd()}", mend)
    policies = len(list((ROOT / "resources/policies").glob("*/policy.onnx")))
    kind = "a clone" if (ROOT / "pyproject.toml").exists() else "installed"
    yield Finding(
        "legged_mw",
        f"{_version('legged_mw') or 'not installed'}, {kind} at {ROOT}: {len(task_names())} tasks, {policies} policies",
    )


def training() -> Iterator[Finding]:
    """The libraries for simulation and learning, and whether their versions are in the tested range."""
    for text in metadata.requires("legged_mw") or [] if _version("legged_mw") else _LIBRARIES:
        needs = Requirement(text)
        if needs.marker is None:
            version = _version(needs.name)
            fits = bool(version) and needs.specifier.contains(version, prereleases=True)
            note = "" if fits or not version else f", which is not {needs.specifier}"
            mend = "" if fits else f"pip install '{needs}'"
            yield Finding(needs.name, f"{version or 'missing'}{note}", mend, needed=not version)


def gpus() -> Iterator[Finding]:
    """Driver, memory pool, graphs, kernels and other processes of each GPU."""
    import torch

    from legged_mw.sim.device import device_facts

    if not torch.cuda.is_available():
        has_one = Path("/proc/driver/nvidia/version").exists() or shutil.which("nvidia-smi") is not None
        if has_one and torch.version.cuda is None:
            yield Finding(
                "none", f"there is an NVIDIA driver, but torch {torch.__version__} is built for CPUs", _CUDA_WHEELS
            )
        elif has_one:
            mend = "update the driver, or take an older torch; nvidia-smi shows what the driver supports"
            yield Finding("none", f"torch {torch.__version__} for CUDA {torch.version.cuda} finds no usable GPU", mend)
        else:
            yield Finding("none", "trains on the CPU, with MuJoCo's own engine, which compiles nothing")
        return
    for index in range(torch.cuda.device_count()):
        facts = device_facts(device := f"cuda:{index}")
        driver = ".".join(map(str, facts.cuda or ()))
        text = f"{facts.name}, {facts.memory:.0f} GiB, driver for CUDA {driver}, torch {torch.__version__}"
        yield Finding(device, text)
        yield Finding("memory pool", "yes" if facts.pool else "no")
        yield Finding("graphs", _records(device))
        yield Finding("kernels", f"{facts.compiled} modules of mujoco-warp are compiled for it in {facts.cache}")
        for line in facts.slow():
            yield Finding("note", line, "legged-mw warm" if "kernels" in line else "see the note")


def pictures() -> Iterator[Finding]:
    """MuJoCo's OpenGL backends, viewers and video encoders."""
    chosen = os.environ.get("MUJOCO_GL", "")
    works = []
    for name in ("egl", "osmesa", "glfw"):
        fault = gl_fault(name) or (draws(name) if name != "glfw" or has_display() else "no screen")
        works += [name] * (not fault)
        yield Finding(name, fault or "draws")
    mend = (
        "apt install libegl1 libegl-mesa0 (or libosmesa6): without one no video, picture or window; training needs none"
    )
    yield Finding("MUJOCO_GL", chosen or "not set", "" if works else mend)
    from legged_mw.view import recorder, web

    yield Finding("window", "yes" if has_display() else "no screen: play shows a web page instead")
    reason = web.missing()
    yield Finding("web page", reason or "yes", "pip install --force-reinstall mujoco mujoco-studio" if reason else "")
    reason = recorder.no_encoder()
    yield Finding("video", reason or "yes", "pip install av" if reason else "")


def extras() -> Iterator[Finding]:
    """Optional libraries of single programs."""
    for package, extra, what in (
        ("onnxruntime", "deploy", "runs an export"),
        ("cyclonedds", "unitree", "drives a Go2 or G1"),
    ):
        version = _version(package) if importlib.util.find_spec(package) else ""
        yield Finding(package, version or f"not installed; it {what}: pip install 'legged_mw[{extra}]'")
    git = shutil.which("git")
    yield Finding("git", git or "not installed (a run of a clone then does not keep its diff)")


# ---- tests and measurements


def draws(name: str) -> str:
    """Why MuJoCo cannot draw with this MUJOCO_GL; "" if it can. The test runs in another process, as it may crash."""
    environment = {**os.environ, "MUJOCO_GL": name}
    environment.pop("PYOPENGL_PLATFORM", None)
    try:
        done = subprocess.run(
            [sys.executable, "-c", _DRAW], env=environment, capture_output=True, text=True, timeout=60
        )
    except subprocess.TimeoutExpired:
        return "does not answer"
    lines = [line for line in done.stderr.strip().splitlines() if "Error" in line] or ["it crashed"]
    return "" if done.returncode == 0 else lines[-1].strip()[:100]


def _records(device: str) -> str:
    """Text on whether torch and warp can record a common CUDA graph."""
    import torch

    from legged_mw.sim.graph import StepGraph

    counter = torch.zeros((), device=device)

    def count() -> None:
        counter.add_(1.0)

    graph = StepGraph(count, device)
    try:
        for _ in range(5):
            graph()
    except Exception as error:  # a driver may raise any type
        return f"cannot be recorded: {' '.join(str(error).split())[:100]}"
    return "recorded and replayed" if graph.recorded and int(counter) == 5 else "not replayed"


def speed(name: str, device: str, seconds: float) -> str:
    """Train a task for ``seconds``. Returns its speed and the estimated time of a whole training as text."""
    measured = measure(name, device, seconds)
    whole = f"all {measured.iterations} iterations in {measured.minutes:.0f} min"
    return (
        f"{measured.training:>10,.0f} steps/s, {whole} ({measured.worlds} worlds, ready after {measured.ready:.0f} s)"
    )


def measure(name: str, device: str, seconds: float, worlds: int = 0) -> Speed:
    """Train a task, then step it without a policy, for ``seconds`` in total. ``worlds``: 0 for the task's number."""
    import torch

    from legged_mw.rl.learner_config import fit_cpu
    from legged_mw.rl.runner import make_runner

    task, threads = load_task(name), torch.get_num_threads()
    task.cfg.env.num_envs = worlds or task.cfg.env.num_envs
    if device == "cpu":
        fit_cpu(task, usable_cores())
        torch.set_num_threads(1)  # as train.py does
    seed_everything(1)
    begun, peak = time.perf_counter(), Peak(device)
    with contextlib.redirect_stdout(io.StringIO()), peak.watched() if device != "cpu" else contextlib.nullcontext():
        env = task.env_class(task.cfg, device)
        runner = make_runner(env, task.train, None, device)
        runner.learn(5 if device != "cpu" else 3)  # warm-up: recording, and on a CPU the trial of thread numbers
    start, done = time.perf_counter(), 0
    with contextlib.redirect_stdout(io.StringIO()):
        while done == 0 or time.perf_counter() < begun + 0.8 * seconds:
            runner.learn(4 if device != "cpu" else 1, init_at_random_ep_len=False)
            done += 4 if device != "cpu" else 1
    took = time.perf_counter() - start
    step = env.num_envs / _seconds_of_a_step(env, device, 0.2 * seconds)
    torch.set_num_threads(threads)
    steps, iterations = env.num_envs * task.train.runner.num_steps_per_env, task.train.runner.max_iterations
    memory = _memory() if device == "cpu" else peak.most / GIB
    return Speed(
        env.num_envs, start - begun, step, steps * done / took, iterations, iterations * took / done / 60, memory
    )


def _seconds_of_a_step(env: RobotTask, device: str, seconds: float) -> float:
    """Mean duration [s] of env.step with random actions, measured for ``seconds``."""
    import torch

    actions, calls, start = 0.3 * torch.randn(env.num_envs, env.num_actions, device=device), 0, time.perf_counter()
    with torch.inference_mode():  # as in training
        while calls == 0 or time.perf_counter() < start + seconds:
            for _ in range(20):
                env.step(actions)
            if device != "cpu":
                torch.cuda.synchronize(device)
            calls += 20
    return (time.perf_counter() - start) / calls


def _memory() -> float:
    """Peak memory of this process [GiB]; 0 if unknown."""
    if not sys.platform.startswith("linux"):
        return 0.0
    import resource

    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / GIB


def benchmark(device: str, seconds: float) -> str:
    """Measure ``go1_flat``. Returns a row of the table in docs/your_gpu.md."""
    import torch

    from legged_mw.utils.errors import out_of_memory

    what, driver = _processor(device)
    counts = [FEW, 0] if device != "cpu" else [0]
    speeds: list[Speed] = []
    for worlds in counts:
        try:
            speeds.append(measure("go1_flat", device, seconds / len(counts), worlds))
        except Exception as error:
            if not speeds or not out_of_memory(error):
                raise
    last, most = speeds[-1], "-"  # GiB per 1000 worlds; estimated number of worlds that fit
    if len(speeds) > 1:
        of_one = (last.memory - speeds[0].memory) / (last.worlds - speeds[0].worlds)
        free = torch.cuda.mem_get_info(device)[1] / GIB - last.memory
        most = f"{of_one * 1000:.2f}; {last.worlds + free / of_one:,.0f}" if of_one > 0 else "-"
    names = ("torch", "warp-lang", "mujoco", "mujoco-warp", "rsl-rl-lib")
    versions = ", ".join(f"{name} {_version(name) or '-'}" for name in ("legged_mw", *names))
    cells = (
        what,
        driver,
        f"{platform.system()}, Python {platform.python_version()}, {versions}",
        f"{time.strftime('%Y-%m-%d')}",
        f"{last.worlds}",
        f"{last.step:,.0f}",
        f"{last.training:,.0f}",
        f"{last.memory:.1f}",
        most,
    )
    return f"| {' | '.join(cells)} |"


def _processor(device: str) -> tuple[str, str]:
    """Texts on ``device`` with its use by others, and on its driver."""
    if device == "cpu":
        lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
        models = [line.partition(": ")[2] for line in lines if line.startswith("model name")]
        load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
        return f"{(models or [platform.machine()])[0]}, {usable_cores()} cores{load}", "-"
    import torch

    from legged_mw.sim.device import device_facts

    facts = device_facts(device)
    of_cuda = f"CUDA {'.'.join(map(str, facts.cuda or ()))}"
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    version = ""
    if shutil.which(command[0]):
        version = subprocess.run(command, capture_output=True, text=True).stdout.partition("\n")[0].strip()
    taken = f"{facts.memory:.0f} GiB, {facts.taken:.1f} taken before"
    return f"{torch.cuda.get_device_name(device)}, {taken}", f"{version} {of_cuda}".strip()


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""
