"""What a stranger's files and names may do: nothing but be read. A run or an export leads nowhere, and paints no terminal."""

from __future__ import annotations

import os
import pickle
import shutil
import socket
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path

from attack import Case, program

from golden.table import Table
from legged_mw import ROOT

RUN = "gift/logs/go1_flat/run"  # what was given to us
CLEAR = "\x1b[2J\x1b]0;owned\x07"  # what a terminal would obey
play, resume, check = (
    (lambda *flags: program("play", *flags)),
    (lambda *f: program("train", "--resume", *f)),
    ("train", "--check"),
)
Given = Callable[[Path], object]


def config(**lines: str) -> Given:
    """Lines of the run's config.yaml, instead of those that it has."""

    def given(root: Path) -> None:
        file = root / RUN / "config.yaml"
        kept = [line for line in file.read_text().splitlines() if line.partition(":")[0] not in lines]
        file.write_text("\n".join([*(f"{name}: {value}" for name, value in lines.items()), *kept]))

    return given


def field(path: str, value: str) -> Given:
    """Another value of ``section.field`` in the run's config.yaml."""
    section, name = path.split(".")

    def given(root: Path) -> None:
        file = root / RUN / "config.yaml"
        before, _, after = file.read_text().partition(f"\n{section}:\n")
        lines = after.splitlines()
        place = next(i for i, line in enumerate(lines) if line.startswith(f"  {name}:"))
        file.write_text("\n".join([before, f"{section}:", *lines[:place], f"  {name}: {value}", *lines[place + 1 :]]))

    return given


def text(path: str, content: str | bytes) -> Given:
    return lambda root: (root / path).write_bytes(content if isinstance(content, bytes) else content.encode())


def link(path: str, to: str) -> Given:
    """``path`` as a link; ROOT stands for the test's folder."""

    def given(root: Path) -> None:
        file = root / path
        file.unlink(missing_ok=True)
        file.symlink_to(to.replace("ROOT", str(root)))

    return given


def rename(file: Path, before: str, after: str) -> None:
    file.write_text(file.read_text().replace(before, after, 1))


def both(*all_given: Given) -> Given:
    return lambda root: [given(root) for given in all_given]


def pipe(path: str) -> Given:
    def given(root: Path) -> None:
        (root / path).unlink(missing_ok=True)
        os.mkfifo(root / path)

    return given


def listener(path: str) -> Given:
    def given(root: Path) -> None:
        with chdir((root / path).parent), socket.socket(socket.AF_UNIX) as there:  # its name may have 108 bytes
            there.bind(Path(path).name)

    return given


class _Code:
    def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
        return os.system, ("touch pwned",)


NAMES = ["../out", "/tmp/out", "a/b", "a\\b", "..", ".", ". .", "~root", "C:evil", "x" * 300]
NAMES += ["\N{PILE OF POO}" * 60, "gpj\u202e.exe"]
LOAD = {
    "a name of 5000": "x" * 5000,
    "a user that is not there": "~nobody_here/run",
    "above everything": "../../../../../../etc",
    "a file": "/etc/passwd",
    "a device": "/dev/zero",
    "an escape": CLEAR,
    "a null": "a\0b",
}
CLASSES = ["os:system", "os.system", "subprocess:Popen", "builtins:exec", "../evil:Run"]
TAGS = [
    ("python/object/apply:os.system", '!!python/object/apply:os.system ["touch pwned"]'),
    ("python/name", "!!python/name:os.system"),
    ("python/module", "!!python/module:subprocess"),
    ("python/object/new", '!!python/object/new:os.system ["touch pwned"]'),
    ("a tag of its own", "!evil 1"),
]
BARE = program("play", "--load_run", RUN, "--task", "")  # the run names its task
CASES = [
    *(Case(f"name: experiment {name!r}", program(*check, "--experiment_name", name)) for name in NAMES),
    Case("name: experiment by a field", program(*check, "--set", "runner.experiment_name=../out")),
    *(Case(f"name: {name!r}", program(*check, flag, name))
      for flag in ("--experiment_name", "--run_name") for name in (CLEAR, "a\0b")),
    *(Case(f"name: run {name!r}", program(*check, "--set", f"runner.run_name={name}"))
      for name in ("../out", "a/../../b", "a\\b", "a:b", "x" * 5000)),
    Case("name: two lines", program(*check, "--run_name", "a\nb")),
    Case("name: experiment by a file", program(*check, "--override", "ROOT/o.yaml"),
         given=text("o.yaml", "runner: {experiment_name: ../out}")),
    Case("name: experiment of play", play("--experiment_name", "../../out")),
    Case("name: experiment to go on with", resume("--experiment_name", "/")),
    Case("name: a run's own", resume("--load_run", RUN, "--max_iterations", "9"),
         given=field("runner.run_name", "../out")),
    *(Case(f"load: {name}", play("--load_run", run)) for name, run in LOAD.items()),
    Case("load: a link to itself", play("--load_run", "ROOT/loop"),
         given=link("loop", "loop")),
    # links, pipes
    Case("link: config out", play("--load_run", RUN),
         given=link(f"{RUN}/config.yaml", "/etc/passwd")),
    Case("link: checkpoint out", play("--load_run", RUN),
         given=link(f"{RUN}/model_9.pt", "/etc/hostname")),
    Case("link: where a video goes", play("--load_run", RUN),
         given=both(text("precious", "mine"), link(f"{RUN}/play.mp4", "ROOT/precious"))),
    Case("link: where a report goes", play("--load_run", RUN, "--eval"),
         given=link(f"{RUN}/eval", "ROOT")),
    Case("link: upwards", play("--load_run", RUN), given=link(f"{RUN}/up", "../..")),
    Case("link: dangling, out", play("--load_run", RUN), given=link(f"{RUN}/play.png", "ROOT/not_yet")),
    Case("link: by a link inside", play("--load_run", RUN),
         given=both(link(f"{RUN}/b", "c/../../../x"), lambda root: (root / RUN / "c").mkdir())),
    Case("link: in an export", play("--load_run", f"{RUN}/export"),
         given=link(f"{RUN}/export/policy.onnx", "/bin/ls")),
    Case("link: an export that is deployed", program("deploy", f"{RUN}/export", "--eval"),
         given=link(f"{RUN}/export/exam.json", "ROOT/precious")),
    Case("link: a resumed run", resume("--load_run", RUN),
         given=link(f"{RUN}/.config.yaml.1.tmp", "ROOT/precious")),
    Case("link: a teacher", program(*check, "--teacher", RUN), given=link(f"{RUN}/x", "/")),
    Case("link: a start", program(*check, "--init", RUN), given=link(f"{RUN}/x", "/")),
    Case("link: a rival", play("--load_run", "shipped_copy", "--eval", "--compare", RUN),
         given=both(lambda root: shutil.copytree(root / RUN, root / "logs/go1_flat/shipped_copy"), link(f"{RUN}/x", "/"))),
    Case("pipe: config", play("--load_run", RUN), given=pipe(f"{RUN}/config.yaml")),
    Case("pipe: checkpoint", play("--load_run", RUN), given=pipe(f"{RUN}/model_9.pt")),
    Case("pipe: contract", program("deploy", f"{RUN}/export"), given=pipe(f"{RUN}/export/policy.yaml")),
    Case("socket", play("--load_run", RUN), given=listener(f"{RUN}/s")),
    # code
    *(Case(f"tag: {name} in a run", play("--load_run", RUN), given=config(seed=tag)) for name, tag in TAGS),
    *(Case(f"tag: {name} in an override", program(*check, "--override", "ROOT/o.yaml"),
         given=text("o.yaml", f"seed: {tag}")) for name, tag in TAGS),
    Case("tag: in a contract", program("deploy", f"{RUN}/export"),
         given=text(f"{RUN}/export/policy.yaml", f"format: {TAGS[0][1]}")),
    Case("tag: in a drive script", play("--commands", "ROOT/d.yaml"),
         given=both(text("d.yaml", f"commands: {TAGS[0][1]}"), lambda root: shutil.copytree(root / RUN, root / "logs/go1_flat/run"))),
    Case("tag: in a remote's script",
         program("deploy", f"{RUN}/export", "--serve", "unitree", "--interface", "lo", "--remote", "ROOT/r.yaml"),
         given=text("r.yaml", f"remote: {TAGS[0][1]}")),
    *(Case(f"class: {name}", play("--load_run", RUN),
         given=field("actor.class_name", name)) for name in CLASSES),
    Case("class: of the critic", resume("--load_run", RUN, "--max_iterations", "9"),
         given=field("critic.class_name", "os:system")),
    Case("class: of the learner", resume("--load_run", RUN, "--max_iterations", "9"),
         given=field("algorithm.class_name", "os:system")),
    Case("class: by a flag", program(*check, "--set", "actor.class_name=os:system")),
    Case("pickle: checkpoint", play("--load_run", RUN),
         given=text(f"{RUN}/model_9.pt", pickle.dumps(_Code()))),
    Case("pickle: an older checkpoint", program("play", "--load_run", RUN, "--checkpoint", "2"),
         given=text(f"{RUN}/model_2.pt", pickle.dumps({"actor_state_dict": _Code()}))),
    Case("task: an escape", BARE, given=config(task=r'"\e[2J\e]0;x\a.py"')),
    Case("task: a name of 5000", BARE, given=config(task="x" * 5000 + ".py")),
    Case("task: another user's home", BARE, given=config(task="~nobody_here/x.py")),
    # names that are printed
    Case("escape: the folder of a run", play("--load_run", "no_such"),
         given=lambda root: shutil.copytree(root / RUN, root / "logs/go1_flat" / CLEAR)),
    Case("escape: a field of a run", play("--load_run", RUN), given=config(**{r'"\e[2J"': "1"})),
    Case("escape: a value of a run", play("--load_run", RUN), given=field("algorithm.desired_kl", r'"\e[2J"')),
    Case("escape: a joint of a contract", program("deploy", f"{RUN}/export"),
         given=lambda root: rename(root / RUN / "export/policy.yaml", "FR_hip_joint", r'"\e[2JFR"')),
    Case("escape: the flag itself", program(*check, "--set", f"sim.{CLEAR}=1")),
    Case("escape: the task", program("train", "--check", "--task", CLEAR)),
]  # fmt: skip


def given_run(root: Path, run: str = RUN) -> None:
    """A run as it may be given to us; its checkpoint is none, since nobody comes to read it."""
    export = root / run / "export"
    shutil.copytree(ROOT / "resources/policies/go1_flat", export)
    shutil.copy(export / "config.yaml", root / run)
    (root / run / "model_2.pt").touch()


def table() -> Table:
    made = Table(given_run)
    made.campaign("", CASES)
    return made
