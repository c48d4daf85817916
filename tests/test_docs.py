"""The site and the README: links lead somewhere, two languages say the same, every command runs or is listed with why not."""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from legged_mw import ROOT, programs
from legged_mw.check import guard
from legged_mw.deploy.__main__ import main as deploy
from legged_mw.deploy.__main__ import parse as parse_deploy
from legged_mw.motion.__main__ import main as motion
from legged_mw.rl import flags, run_folder
from legged_mw.sim import terrain
from legged_mw.view import playing
from website import reference

PAGES = [
    *sorted(ROOT.glob("README*.md")),
    ROOT / "examples/cpp/README.md",
    *sorted(page for page in (ROOT / "docs").rglob("*.md") if page.parent.name != "archive"),  # frozen, word for word
    *sorted((ROOT / "resources").rglob("*.md")),
]
ELSEWHERE = {
    "gate.md": "exams of half a minute, a file of others: test_gate.py",
    "your_own_robot.md": "tests/test_your_own_robot.py runs its commands, one after the other",
}
# pattern of a command -> why no test runs it as it stands; those of our programs have their flags read all the same
WHY_NOT = {
    r"^(pip|pipx|uvx|docker|eval|apt|source|make|tensorboard|git|sudo)\b": "sets up a machine; CI itself is make lint and make test",
    r"^sbatch |nvidia-cuda-mps-control": "another program's: of a cluster, of a GPU",
    r"^legged-mw ": "test_tools.py and test_wheel.py start the programs",
    r"^torchrun ": "several GPUs: test_ranks.py on a CPU, test_gpu.py",
    r"examples/cpp": "test_cpp_example.py compiles and runs it",
    r"udp_robot": "two programs: test_udp_example.py",
    r"--(robot|serve) |--interface": "a robot on a network: test_unitree_wire.py, test_unitree_robot.py",
    r"--(drive|check_joints|first_walk|replay)\b": "real time: test_deploy_loop, test_joint_check, test_first_walk, test_deploy_log",
    r"--override logs/deploy|benchmarks\.fit": "from the log of a chirp: test_fit.py",
    r"--eval\b": "an exam takes half a minute: test_exam.py, test_report.py, test_deploy.py, test_skills.py",
    r"--(video|sheet|picture)\b|--play\b": "draws: test_view.py, test_robot_page.py, test_terrain_look.py",
    r"--(teacher|init|resume|load_run|checkpoint|export)\b|deploy (my_policy|out/)": "goes on from a run: test_teacher.py, test_train.py",
    r"actuator_net|my_anymal|dance\.": "a file of others: test_motors.py, test_motion.py",
    r"legged_mw\.robot |mine_flat": "test_your_own_robot.py runs the same",
    r"^python benchmarks/curve": "draws the curve of a whole training",
    r"^python benchmarks/mean_policy": "of two trainings: test_benchmarks.py",
    r"--num_envs 40": "a grid of all levels takes seconds to build; the same with fewer runs",
}
SMALL = "--num_envs 8 --max_iterations 2 --device cpu --set runner.num_steps_per_env=4 --set runner.exam_interval=0"
SMALL += (
    " --set runner.export=false --set cpu.hidden_dims=[16] --set cpu.num_steps_per_env=4 --set cpu.num_mini_batches=2"
)
GROUND = "--set terrain.num_rows=1 --set terrain.num_cols=8 --set terrain.border_size=1"
OF_TASKS = {"rough": GROUND, "craters": GROUND, "getup": "--set falls.states=8"}
# that pages say to save
FILES = {"go1_gentle.py": "index.md", "go1_estimator.py": "observations.md", "go1_craters.py": "terrain.md"}


@pytest.fixture(autouse=True, scope="module")
def _kinds_of_ground() -> Iterator[None]:
    """Pages add kinds of their own; other tests list those of the package."""
    tables = (terrain.KINDS, terrain.MEASURES)
    kept = [dict(table) for table in tables]
    yield
    for table, before in zip(tables, kept, strict=True):
        table.clear()
        table.update(before)  # type: ignore[arg-type]


def commands(page: Path) -> list[str]:
    """Of the page's bash blocks, continued lines joined, comments gone."""
    blocks = re.findall(r"^```(?:bash|sh|console)\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in re.sub(r"\\\n\s*", " ", block).splitlines()]
    return [shlex.join(words) for line in lines if (words := shlex.split(line, comments=True))]


def why_not(page: Path, command: str) -> str:
    if page.name in ELSEWHERE:
        return ELSEWHERE[page.name]
    return next((reason for pattern, reason in WHY_NOT.items() if re.search(pattern, command)), "")


def same_when_small(command: str) -> str:
    """Without what SMALL overrides: two commands that differ in it alone run once."""
    return re.sub(r" --(seed|max_iterations|max_time) \S+| --set runner\.save_interval=\S+", "", command)


ALL = [(page, command) for page in PAGES for command in commands(page)]
READ = sorted({command for page, command in ALL if why_not(page, command)})
_ONCE = {same_when_small(command): command for page, command in reversed(ALL) if not why_not(page, command)}
# a run is there when it is played
RUN = sorted(_ONCE.values(), key=lambda command: ("train.py" not in command, command))


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder to work in that is also ~, with the files that the pages say to save."""
    folder = tmp_path_factory.mktemp("home")
    (folder / "robots").mkdir()
    for name, page in FILES.items():
        code = re.findall(rf"`~/robots/{name}`.*?```python\n(.*?)```", (ROOT / "docs" / page).read_text(), re.DOTALL)
        (folder / "robots" / name).write_text(code[0])
    (folder / "robots/mine.py").write_text((folder / "robots/go1_gentle.py").read_text())
    (folder / "mine.yaml").write_text("rewards: {scales: {torques: -5e-4}}\n")
    for name in ("configs", "examples", "resources"):
        (folder / name).symlink_to(ROOT / name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(folder))
        patch.chdir(folder)
        patch.setattr(run_folder, "logs_folder", lambda: folder / "logs")
        yield folder


def start(words: list[str]) -> str:
    """Run a command of ours in this process, made small; what it prints."""
    program, *flags = words[1:]
    entry = {"train.py": programs.train, "play.py": programs.play, "-m": None}[program]
    if entry is None:
        entry, flags = {"legged_mw.deploy": deploy, "legged_mw.motion": motion}[flags[0]], flags[1:]
    if program == "train.py" and "--list" not in flags:
        flags += shlex.split(SMALL) + [
            flag for name, more in OF_TASKS.items() if name in " ".join(flags) for flag in shlex.split(more)
        ]
    elif program != "train.py":
        flags += ["--viewer", "none", "--time", "0.1s"]
    out, handlers = io.StringIO(), {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
        patch.setattr(sys, "argv", [program, *map(os.path.expanduser, flags)])
        if "--check" not in flags:
            # half a second; other tests try the classes
            patch.setattr(guard, "check_recordable", lambda *_, **__: None)
        try:
            entry()
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
    return out.getvalue()


@pytest.mark.parametrize("command", RUN)
def test_every_command_runs(command: str, home: Path) -> None:
    words = shlex.split(command)
    assert words[0] == "python", f"{command}: what is it? Run it here, or say in WHY_NOT why not"
    said = start(words)
    if words[1] == "train.py" and not {"--check", "--list"} & {*words}:
        assert "Learning iteration 2/2" in said or "2/2" in said, said
    else:
        assert said


@pytest.mark.parametrize(
    "command",
    [command for command in READ if re.match(r"python (train|play)\.py|python -m legged_mw\.deploy", command)],
)
def test_flags_of_the_others_are_read(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a flag is called may change; a page that is not run would not notice."""
    words = shlex.split(command)
    programs_of = {"train.py": flags.parse, "play.py": playing.parse, "-m": lambda _: parse_deploy()}
    monkeypatch.setattr(sys, "argv", words[1:] if words[1] != "-m" else words[2:])
    programs_of[words[1]]("")


def test_every_reason_is_needed() -> None:
    assert [pattern for pattern in WHY_NOT if not any(re.search(pattern, command) for command in READ)] == []


# ---- links, as GitHub shows the pages


def anchors(page: Path) -> set[str]:
    """Of its headlines, as GitHub makes them, and those that it names."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    heads = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads} | {
        *re.findall(r'<a id="([^"]+)">', text)
    }


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    lost = []
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if link.startswith(("http", "mailto")):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name) if name else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            lost.append(link)
    assert lost == []


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda page: page.name)
def test_a_page_is_short(page: Path) -> None:
    """The tutorial is a course, two are tables to look up in; of all others a reader in a hurry finds what is asked for."""
    assert page.name in ("tutorial.md", *reference.PAGES) or len(page.read_text().splitlines()) <= 250


@pytest.mark.parametrize("name", reference.PAGES)
def test_tables_are_what_the_code_makes(name: str) -> None:
    """If not: `python -m website.reference`."""
    page = (ROOT / "docs" / name).read_text()
    assert reference.renew(page) == page and page.count("\n| `") > 100
