"""What a stranger's files and names may do: nothing but be read. A run or an export runs no code, leads nowhere, and paints no terminal."""

from __future__ import annotations

import os
import pickle
import shlex
import shutil
import socket
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path

import pytest
from attack import Case, attack, program
from program import run

from legged_mw import ROOT
from legged_mw.utils.files import check_folder

RUN = "gift/logs/go1_flat/run"  # what was given to us
PLAIN = "it must be a plain name such as wide_net, of 100 bytes at most"
NAME = "cannot be the name of a folder below logs: "
CODE = "import pathlib\npathlib.Path('pwned').touch()\nfrom configs.go1_flat import TASK\nTASK = TASK\n"
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


NAMES = [
    *((f"experiment {name!r}", ("--experiment_name", name), why) for name, why in (
        ("../out", "'/' is in it"), ("/tmp/out", "'/' is in it"), ("a/b", "'/' is in it"), ("a\\b", r"is in it; write a plain name"),
        ("..", "is made of dots"), (".", "is made of dots"), (". .", "is made of dots"), ("~root", "it begins with - or ~"),
        ("C:evil", "':' is in it"), ("x" * 300, "it has 300 bytes, more than 100"), ("\N{PILE OF POO}" * 60, "it has 240 bytes"),
        ("gpj\u202e.exe", r"'\u202e' is in it"),
    )),
    ("experiment by a field", ("--set", "runner.experiment_name=../out"), "'/' is in it"),
]  # fmt: skip
LOAD = [
    ("a name of 5000", "x" * 5000, "is no path here: File name too long"),
    ("a user that is not there", "~nobody_here/run", "is no path here: "),
    ("above everything", "../../../../../../etc", "no run with a checkpoint"),
    ("a file", "/etc/passwd", "no run with a checkpoint"),
    ("a device", "/dev/zero", "no run with a checkpoint"),
    ("an escape", CLEAR, r"\x1b[2J\x1b]0;owned\x07"),
    ("a null", "a\0b", "is no path here: embedded null"),
]
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
    *(Case(f"name: {name}", program(*check, *flags), (NAME, why)) for name, flags, why in NAMES),
    *(Case(f"name: {name!r}", program(*check, flag, name), "it must be text without control characters")
      for flag in ("--experiment_name", "--run_name") for name in (CLEAR, "a\0b")),
    *(Case(f"name: run {name!r}", program(*check, "--set", f"runner.run_name={name}"), PLAIN)
      for name in ("../out", "a/../../b", "a\\b", "a:b", "x" * 5000)),
    Case("name: two lines", program(*check, "--run_name", "a\nb"), PLAIN),
    Case("name: experiment by a file", program(*check, "--override", "ROOT/o.yaml"), (NAME, "'/' is in it"),
         given=text("o.yaml", "runner: {experiment_name: ../out}")),
    Case("name: experiment of play", play("--experiment_name", "../../out"), (NAME, "'/' is in it")),
    Case("name: experiment to go on with", resume("--experiment_name", "/"), (NAME, "'/' is in it")),
    Case("name: a run's own", resume("--load_run", RUN, "--max_iterations", "9"), "runner.run_name",
         given=field("runner.run_name", "../out")),
    *(Case(f"load: {name}", play("--load_run", run), says) for name, run, says in LOAD),
    Case("load: a link to itself", play("--load_run", "ROOT/loop"), "is no path here: Too many levels of symbolic links",
         given=link("loop", "loop")),
    # links, pipes
    Case("link: config out", play("--load_run", RUN), "config.yaml is a link that leads out of it, to /etc/passwd",
         given=link(f"{RUN}/config.yaml", "/etc/passwd")),
    Case("link: checkpoint out", play("--load_run", RUN), "model_9.pt is a link that leads out",
         given=link(f"{RUN}/model_9.pt", "/etc/hostname")),
    Case("link: where a video goes", play("--load_run", RUN), "play.mp4 is a link that leads out of it, to ROOT/precious",
         given=both(text("precious", "mine"), link(f"{RUN}/play.mp4", "ROOT/precious"))),
    Case("link: where a report goes", play("--load_run", RUN, "--eval"), "eval is a link that leads out of it",
         given=link(f"{RUN}/eval", "ROOT")),
    Case("link: upwards", play("--load_run", RUN), "up is a link that leads out of it, to ../..", given=link(f"{RUN}/up", "../..")),
    Case("link: dangling, out", play("--load_run", RUN), "is a link that leads out of it", given=link(f"{RUN}/play.png", "ROOT/not_yet")),
    Case("link: by a link inside", play("--load_run", RUN), "b is a link that leads out of it",
         given=both(link(f"{RUN}/b", "c/../../../x"), lambda root: (root / RUN / "c").mkdir())),
    Case("link: in an export", play("--load_run", f"{RUN}/export"), "policy.onnx is a link that leads out",
         given=link(f"{RUN}/export/policy.onnx", "/bin/ls")),
    Case("link: an export that is deployed", program("deploy", f"{RUN}/export", "--eval"), "exam.json is a link that leads out",
         given=link(f"{RUN}/export/exam.json", "ROOT/precious")),
    Case("link: a resumed run", resume("--load_run", RUN), "is a link that leads out",
         given=link(f"{RUN}/.config.yaml.1.tmp", "ROOT/precious")),
    Case("link: a teacher", program(*check, "--teacher", RUN), "is a link that leads out", given=link(f"{RUN}/x", "/")),
    Case("link: a start", program(*check, "--init", RUN), "is a link that leads out", given=link(f"{RUN}/x", "/")),
    Case("link: a rival", play("--load_run", "shipped_copy", "--eval", "--compare", RUN), "is a link that leads out",
         given=both(lambda root: shutil.copytree(root / RUN, root / "logs/go1_flat/shipped_copy"), link(f"{RUN}/x", "/"))),
    Case("pipe: config", play("--load_run", RUN), "a pipe, a socket or a device", given=pipe(f"{RUN}/config.yaml")),
    Case("pipe: checkpoint", play("--load_run", RUN), "model_9.pt is a pipe, a socket or a device", given=pipe(f"{RUN}/model_9.pt")),
    Case("pipe: contract", program("deploy", f"{RUN}/export"), "policy.yaml is a pipe", given=pipe(f"{RUN}/export/policy.yaml")),
    Case("socket", play("--load_run", RUN), "s is a pipe, a socket or a device", given=listener(f"{RUN}/s")),
    # code
    *(Case(f"tag: {name} in a run", play("--load_run", RUN), "config.yaml", given=config(seed=tag)) for name, tag in TAGS),
    *(Case(f"tag: {name} in an override", program(*check, "--override", "ROOT/o.yaml"), "o.yaml",
         given=text("o.yaml", f"seed: {tag}")) for name, tag in TAGS),
    Case("tag: in a contract", program("deploy", f"{RUN}/export"), "policy.yaml",
         given=text(f"{RUN}/export/policy.yaml", f"format: {TAGS[0][1]}")),
    Case("tag: in a drive script", play("--commands", "ROOT/d.yaml"), "d.yaml",
         given=both(text("d.yaml", f"commands: {TAGS[0][1]}"), lambda root: shutil.copytree(root / RUN, root / "logs/go1_flat/run"))),
    Case("tag: in a remote's script",
         program("deploy", f"{RUN}/export", "--serve", "unitree", "--interface", "lo", "--remote", "ROOT/r.yaml"), "",
         given=text("r.yaml", f"remote: {TAGS[0][1]}")),
    *(Case(f"class: {name}", play("--load_run", RUN), f"actor.class_name is '{name}'",
         given=field("actor.class_name", name)) for name in CLASSES),
    Case("class: of the critic", resume("--load_run", RUN, "--max_iterations", "9"), "critic.class_name is 'os:system'",
         given=field("critic.class_name", "os:system")),
    Case("class: of the learner", resume("--load_run", RUN, "--max_iterations", "9"), "algorithm.class_name is 'os:system'",
         given=field("algorithm.class_name", "os:system")),
    Case("class: by a flag", program(*check, "--set", "actor.class_name=os:system"), "actor.class_name is 'os:system'"),
    Case("pickle: checkpoint", play("--load_run", RUN), "cannot be read as a checkpoint",
         given=text(f"{RUN}/model_9.pt", pickle.dumps(_Code()))),
    Case("pickle: an older checkpoint", program("play", "--load_run", RUN, "--checkpoint", "2"), "cannot be read as a checkpoint",
         given=text(f"{RUN}/model_2.pt", pickle.dumps({"actor_state_dict": _Code()}))),
    Case("task: an escape", BARE, "", given=config(task=r'"\e[2J\e]0;x\a.py"')),
    Case("task: a name of 5000", BARE, "somebody's code", given=config(task="x" * 5000 + ".py")),
    Case("task: another user's home", BARE, "", given=config(task="~nobody_here/x.py")),
    # names that are printed
    Case("escape: the folder of a run", play("--load_run", "no_such"), r"there are: \x1b[2J\x1b]0;owned\x07",
         given=lambda root: shutil.copytree(root / RUN, root / "logs/go1_flat" / CLEAR)),
    Case("escape: a field of a run", play("--load_run", RUN), "", given=config(**{r'"\e[2J"': "1"})),
    Case("escape: a value of a run", play("--load_run", RUN), "", given=field("algorithm.desired_kl", r'"\e[2J"')),
    Case("escape: a joint of a contract", program("deploy", f"{RUN}/export"), "",
         given=lambda root: rename(root / RUN / "export/policy.yaml", "FR_hip_joint", r'"\e[2JFR"')),
    Case("escape: the flag itself", program(*check, "--set", f"sim.{CLEAR}=1"), r"\x1b[2J"),
    Case("escape: the task", program("train", "--check", "--task", CLEAR), r"\x1b[2J"),
]  # fmt: skip


def given_run(root: Path, run: str = RUN) -> None:
    """A run as it may be given to us; its checkpoint is none, since nobody comes to read it."""
    export = root / run / "export"
    shutil.copytree(ROOT / "resources/policies/go1_flat", export)
    shutil.copy(export / "config.yaml", root / run)
    (root / run / "model_2.pt").touch()


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.id.encode("unicode_escape").decode()[:60])
def test_strangers(case: Case, tmp_path: Path) -> None:
    given_run(tmp_path)
    says = tuple(
        each.replace("ROOT", str(tmp_path)) for each in ([case.says] if isinstance(case.says, str) else case.says)
    )
    line = attack(case._replace(says=says), tmp_path)
    assert line[:-1].isprintable() and not list(tmp_path.rglob("pwned"))


# an archive without logs; one that lies in our own logs
BEST, UNPACKED = "walker/best", "logs/walker/logs/go1_flat/run"
# what a run's config may name -> (the run, where the code lies, what the config says; the program, if not play)
WAYS = {
    "beside the run": (BEST, "walker/code.py", "code.py"),
    "exported": (BEST, "walker/code.py", "code.py", "play", "--export", "ROOT/out", "--load_run"),
    "graded": (BEST, "walker/code.py", "code.py", "play", "--eval", "--load_run"),
    "resumed": (BEST, "walker/code.py", "code.py", "train", "--resume", "--load_run"),
    "a start of a task that is named": (BEST, "walker/code.py", "code.py", "train", "--check", "--task", "go1_flat", "--init"),
    "a teacher of a task that is named": (BEST, "walker/code.py", "code.py", "train", "--check", "--task", "go1_flat", "--teacher"),
    "an absolute path": (BEST, "walker/code.py", "ROOT/walker/code.py"),
    "upwards": (BEST, "walker/code.py", "../../../../../../../../../../../..ROOT/walker/code.py"),
    "beside the logs": (RUN, "gift/code.py", "code.py"),
    "in a sister folder": (RUN, "gift/tasks/code.py", "tasks/code.py"),
    "below our own logs": (UNPACKED, "logs/walker/code.py", "code.py"),
    "in the current folder": (RUN, "code.py", "code.py"),
    "in the run": (RUN, f"{RUN}/code.py", "run/code.py"),
    "in its logs": (RUN, "gift/logs/code.py", "code.py"),
    "in an export": (f"{RUN}/export", f"{RUN}/export/code.py", "export/code.py"),
    "a link": (RUN, f"{RUN}/code.txt", "code.py"),
    "a link that is called examples": (RUN, f"{RUN}/code.py", "examples/code.py"),
    "a module": (BEST, "walker/code.py", "walker.code"),
    "a path without .py": (BEST, "walker/code.py", "../walker/code"),
    "a shell's command": (BEST, "walker/code.py; touch pwned #.py", "code.py; touch pwned #.py"),
}  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
def test_a_run_decides_no_code(way: str, tmp_path: Path) -> None:
    """Which Python is run is what --task names, or the project's own; the line to type is as a shell may be given it."""
    folder, place, stored, *flags = (each.replace("ROOT", str(tmp_path)) for each in WAYS[way])
    given_run(tmp_path, folder.removesuffix("/export"))
    (tmp_path / place).parent.mkdir(exist_ok=True)
    (tmp_path / place).write_text(CODE)
    (tmp_path / "examples").symlink_to(tmp_path / RUN)
    if way == "a link":
        (tmp_path / "gift/code.py").symlink_to(tmp_path / place)
    file = tmp_path / folder / "config.yaml"
    file.write_text(file.read_text().replace("task: go1_flat\n", f"task: '{stored}'\n"))
    name, *flags = flags or ["play", "--load_run"]
    task = [] if "--task" in flags else ["--task", ""]
    is_file = stored.endswith(".py")
    line = attack(
        Case(way, program(name, *task, *flags, folder), "somebody's code" if is_file else "no task"), tmp_path
    )
    assert not is_file or f"--task {shlex.quote(stored)}" in line
    assert not list(tmp_path.rglob("pwned"))


def test_a_file_that_is_named_runs_and_is_printed_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The trap works: by --task the same file runs."""
    (tmp_path / "code.py").write_text("print('runs')\n" + CODE)
    monkeypatch.chdir(tmp_path)
    done = run("train", tmp_path, "--task", "code.py", "--check", "--eager", "--num_envs", "1", "--device", "cpu")
    assert (
        done.code == 0 and done.out.splitlines()[:2] == ["task: code.py", "runs"] and (tmp_path / "pwned").exists()
    ), done
    assert done.out.count("task: ") == 1


def test_links_that_stay_in_a_run_are_its_own(tmp_path: Path) -> None:
    """A run may hold links to its own files, be one itself, and lie behind one."""
    given_run(tmp_path)
    (tmp_path / RUN / "best.pt").symlink_to("model_2.pt")
    (tmp_path / RUN / "loop").symlink_to("loop")
    (tmp_path / "behind").symlink_to(RUN)
    assert check_folder(tmp_path / "behind") == tmp_path / "behind"
