"""legged-mw sweep --task NAME --seeds 1,2,3 --set a.b=1,2,3: train each combination, then print a table of the runs.

Commas separate the values of a field. Every combination of the values is trained. Commas inside brackets belong to a
list: --set actor.hidden_dims=[64,64],[128,128]. All other flags are those of train.

--halve stops bad settings early (successive halving). All settings train for --max_time, and the exam at the end ranks
them. The best third trains for three times as long, and so on, until one setting is left, which trains a last round.
"""

from __future__ import annotations

import argparse
import ctypes
import hashlib
import math
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import count, product
from pathlib import Path
from statistics import mean, stdev
from tempfile import TemporaryDirectory
from typing import NamedTuple

from legged_mw.rl import flags
from legged_mw.tools.compare import Run, curves_of, figures, find_runs, rows, text_table
from legged_mw.utils.cli import FIELDS, Parser, apply_overrides, command, positive
from legged_mw.utils.errors import UserError, shown
from legged_mw.utils.files import MOST_LETTERS, check_name, writable, wrong_name
from legged_mw.utils.task import LoadedTask, load_task

STOPPED = 3  # exit code of a training that a signal stopped (rl/training.py)
TRAIN = [sys.executable, "-m", "legged_mw.programs", "train"]
THIRD = 3  # eta: 1/eta of the settings continue, eta times as long [Li et al. 2018, Hyperband: eta 3 or 4]
NO_END = ["--max_iterations", "1000000"]  # with --halve, --max_time ends a training
# figure of the walking exam during training -> whether more is better (eval/rollout.py)
WALKING = {"error_vx": False, "error_vy": False, "error_yaw": False, "falls": False, "pushes_survived": True}
_PDEATHSIG = 1  # PR_SET_PDEATHSIG of Linux's prctl
_POLL = 0.1  # [s] polling interval


class Cell(NamedTuple):
    """One combination of values."""

    varied: dict[str, str]  # varied config field -> value
    flags: list[str]

    @property
    def name(self) -> str:
        return _named(self.varied)

    @property
    def setting(self) -> str:
        """The name without the seed."""
        return _named({path: value for path, value in self.varied.items() if path != "seed"})

    @property
    def label(self) -> str:
        """The name as a valid name of a run. One that is too long is cut, and a digest of the whole is added."""
        label = re.sub(r"[^\w.=-]+", "_", self.name).strip("_")
        if wrong_name(label):
            cut = label.encode()[: MOST_LETTERS - 10].decode(errors="ignore")
            label = f"{cut}_{hashlib.sha256(label.encode()).hexdigest()[:8]}"
        return label


def _named(varied: Mapping[str, str]) -> str:
    return " ".join(f"{path.rpartition('.')[2]}={value}" for path, value in varied.items())


class Training(NamedTuple):
    """One call of ``legged-mw train`` and the file for its output."""

    name: str
    flags: list[str]
    log: Path


class Printed(NamedTuple):
    """The parsed output of a training."""

    folder: str  # run folder, or ""
    last: str  # line about the end of the training
    done: bool
    left: str  # remaining --max_time after a signal, or ""
    exam: dict[str, float]  # figures of the exam at the end
    failed: bool  # the shell command of ``Halving.line`` reported a failure


class Stop:
    """A signal handler that records the request to end the sweep."""

    def __init__(self) -> None:
        self.asked = False

    def listen(self) -> None:
        """Handle Ctrl-C, SIGTERM and SIGHUP, except ignored signals, as under nohup."""
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            if number and signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self)

    def __call__(self, *_: object) -> None:
        self.asked = True


# ---- the flags


def parse() -> tuple[argparse.Namespace, list[str]]:
    about, _, more = (__doc__ or "").partition("\n\n")
    parser = Parser(prog="legged-mw sweep", description=f"{about} {more}", allow_abbrev=False)
    parser.add_argument("--task", metavar="NAME", required=True, help="a task, or the path of a config file")
    parser.add_argument("--seeds", metavar="N,N,...", default="", help="seeds, one training each")
    parser.add_argument(
        "--set", action="append", default=[], metavar="PATH=V,V,...", help="a config field and its values"
    )
    parser.add_argument("--jobs", type=positive, default=1, metavar="N", help="trainings at a time (default: 1)")
    parser.add_argument("--halve", action="store_true", help="stop bad settings early; --max_time is for round 1")
    rounds = "with --halve: number of rounds (default: until one setting is left and has trained alone)"
    parser.add_argument("--rounds", type=positive, metavar="N", help=rounds)
    lines = "print the command lines, as for a cluster, and start nothing; with --halve those of the next round"
    parser.add_argument("--print", action="store_true", help=lines)
    args, rest = parser.parse_known_args()
    for flag in ("--run_name", "--resume", "--load_run", "--list", "--check", "--play"):
        if _given(flag, rest):
            parser.error(f"{flag} is for a single training: leave it out")
    if not all(re.fullmatch(r"\d+", seed) for seed in values(args.seeds)):
        parser.error(f"--seeds {args.seeds}: write whole numbers apart by commas: --seeds 1,2,3")
    if args.rounds and not args.halve:
        parser.error("--rounds needs --halve: add --halve, or leave --rounds out")
    for flag, field in (("--init", "warm_start.policy"), ("--teacher", "distillation.teacher")):
        if args.halve and _given(flag, rest):
            parser.error(f"--halve resumes its trainings, which {flag} does not: write it as --set {field}=RUN")
    return args, rest


def _given(flag: str, words: Sequence[str]) -> bool:
    return any(text.partition("=")[0] == flag for text in words)


def main() -> None:
    args, rest = parse()
    cells, common, stop = make_cells(args.set, values(args.seeds)), ["--task", args.task, *rest], Stop()
    if args.halve:
        halve(Halving(args, cells, common), args, stop)
        return
    check(cells, common)
    with TemporaryDirectory() as temp:
        trainings = []
        for i, cell in enumerate(cells):
            extra = ["--run_name", cell.label] if cell.label else []
            trainings.append(Training(cell.name or "as it is", [*common, *cell.flags, *extra], Path(temp, f"{i}.txt")))
        if args.print:
            print("\n".join(f"{command('train')} {shlex.join(training.flags)}" for training in trainings))
            return
        print(f"{len(cells)} trainings of {args.task}: {'; '.join(each.name for each in trainings)}", flush=True)
        stop.listen()
        logs = train_all(trainings, args.jobs, stop)
    finished = [(cells[i], find_runs([log.folder])[0]) for i, log in sorted(logs.items())]
    if finished:
        print(f"\n{table(finished)}\n\n{curves_of([run for _, run in finished])}")
    if len(finished) < len(cells):
        raise SystemExit(1)


def values(text: str) -> list[str]:
    """Split at commas outside brackets and quotes."""
    parts, depth, quote = [""] if text else [], 0, ""
    for letter in text:
        quote = "" if letter == quote else letter if letter in "\"'" and not quote else quote
        depth += 0 if quote else (letter in "[{(") - (letter in "]})")
        if letter == "," and depth == 0 and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts]


def make_cells(settings: Sequence[str], seeds: Sequence[str]) -> list[Cell]:
    """All combinations of the values. The seed varies fastest."""
    axes = [
        [(path, value) for value in values(text) or [""]]
        for path, _, text in (item.partition("=") for item in settings)
    ]
    axes += [[("seed", seed) for seed in seeds]] if seeds else []
    cells = []
    for choice in product(*axes):
        varied = {
            path: value for (path, value), axis in zip(choice, axes, strict=True) if len(axis) > 1 or path == "seed"
        }
        flags = [text for path, value in choice for text in ("--set", f"{path}={value}")]
        cells.append(Cell(varied, flags))
    return cells


def check(cells: Sequence[Cell], common: list[str]) -> tuple[argparse.Namespace, LoadedTask]:
    """Parse all flags and values once, as train does. An invalid one raises UserError or ends the program."""
    args = flags.parse(None, common)
    fields = [text.partition("=")[0].strip() for text in cells[0].flags if text != "--set"]
    if twice := [field for field in fields if fields.count(field) > 1]:
        raise UserError(f"{twice[0]} has two lists of values, and only one can count: give it once")
    for flag, field in FIELDS.items():
        if field in fields and getattr(args, flag, None) is not None:
            raise UserError(f"--{flag} would replace the values of {field}: leave one of them out")
    args.set += dict.fromkeys(text for cell in cells for text in cell.flags if text != "--set")
    apply_overrides(task := load_task(args.task, say=True), args)
    return args, task


# ---- trainings in child processes


def train_all(trainings: Sequence[Training], at_once: int, stop: Stop) -> dict[int, Printed]:
    """Run the trainings and print a line when one ends. Returns the logs of those that saved a checkpoint, by number.

    A training that a signal stopped also stops the sweep.
    """
    logs: dict[int, Printed] = {}
    for done, (i, code) in enumerate(run(trainings, at_once, stop), 1):
        log = read_printed(trainings[i].log)
        saved = bool(log.folder) and code in (0, STOPPED)
        print(f"{done}/{len(trainings)} {trainings[i].name}: {log.folder if saved else log.last}", flush=True)
        if saved:
            logs[i] = log
        stop.asked |= code == STOPPED
    return logs


def run(trainings: Sequence[Training], at_once: int, stop: Stop) -> Iterator[tuple[int, int]]:
    """Run ``at_once`` trainings at a time. Yields the number and exit code of each training that ends.

    After a signal no training starts, and each running one gets one SIGTERM, so that it saves a checkpoint. A second
    signal would end it at once. So each training has its own process group, because a terminal or ``timeout`` sends a
    signal to a whole group. Each has its own cores, because trainings on the same cores are many times slower
    (rl/runner.py, UpdateThreads).
    """
    waiting, running, signalled = list(enumerate(trainings)), dict[int, subprocess.Popen[bytes]](), False
    shares, slots = shares_of(cores(), at_once), dict[int, int]()
    try:
        while running or (waiting and not stop.asked):
            while waiting and len(running) < at_once and not stop.asked:
                i, training = waiting.pop(0)
                slots[i] = min({*range(at_once)} - {slots[other] for other in running})
                running[i] = _start(training, shares[slots[i]])
            if stop.asked and not signalled:
                signalled = True
                for process in running.values():
                    process.terminate()
            time.sleep(_POLL)
            for i, process in list(running.items()):
                _show(_last_iteration(trainings[i].log))
                if (code := process.poll()) is not None:
                    del running[i]
                    _show("")
                    yield i, code
    finally:
        for process in running.values():  # only after an exception
            process.terminate()


def cores() -> list[int]:
    """The cores that this process may use; empty if unknown."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def shares_of(cores: Sequence[int], count: int) -> list[Sequence[int]]:
    """``count`` equal shares of ``cores``, each of at least one core unless ``cores`` is empty."""
    size = max(1, len(cores) // count)
    whole = max(1, len(cores) // size)
    return [cores[i % whole * size :][:size] for i in range(count)]


def _start(training: Training, share: Sequence[int]) -> subprocess.Popen[bytes]:
    """Start a child process that ends when this one ends. Call it in the main thread, as ``preexec_fn`` needs."""
    with open(training.log, "ab") as log:  # append: the log may hold the output of earlier starts
        return subprocess.Popen(
            [*TRAIN, *training.flags],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            process_group=0,
            preexec_fn=_first(os.getpid(), share),
        )


def _first(parent: int, share: Sequence[int]) -> Callable[[], object] | None:
    """A ``preexec_fn`` that sets the child's cores and sends it SIGTERM when ``parent`` ends. None if not on Linux."""
    if sys.platform != "linux":
        return None
    prctl = ctypes.CDLL(None).prctl

    def first() -> None:
        prctl(_PDEATHSIG, int(signal.SIGTERM))
        os.sched_setaffinity(0, share)
        if os.getppid() != parent:  # the parent has already ended
            os._exit(1)

    return first


def _show(line: str) -> None:
    """Replace the last line of a terminal."""
    if sys.stdout.isatty():
        print(f"\r\x1b[K{line[:100]}", end="", flush=True)


def _last_iteration(log: Path) -> str:
    with open(log, "rb") as file:
        file.seek(max(0, log.stat().st_size - 1000))
        lines = re.findall(r"^Learning iteration .*$", file.read().decode(errors="replace"), re.M)
    return lines[-1] if lines else ""


def read_printed(file: Path) -> Printed:
    """Parse the output of all starts of a training. Without the file all fields are empty."""
    text = file.read_text(errors="replace").strip() if file.is_file() else ""

    def last(pattern: str) -> str:
        matches = re.findall(pattern, text, re.M)
        return matches[-1] if matches else ""

    done = bool(last(r"^done: "))
    exam = re.findall(r"(\w+) (-?\d+\.\d+)", last(r"^exam after \d+ iterations: (.*)$"))
    return Printed(
        folder=last(r"^writing to (.*)$"),
        last=last(r"^(stopped: .*)\n.*\Z") or text.rpartition("\n")[2],
        done=done,
        left=last(r"^stopped: .*\n.* --max_time (\S+)$"),
        exam={name: float(value) for name, value in exam if done},
        failed=bool(last(r"^failed: code (?!3$)")),
    )


# ---- successive halving


class Halving:
    """The rounds of a sweep. Their state is read from the trainings' output files in ``folder``."""

    def __init__(self, args: argparse.Namespace, cells: Sequence[Cell], common: list[str]) -> None:
        """Raises UserError if --halve is not possible or ``folder`` holds another sweep."""
        train_args, self.task = check(cells, common)
        if len({cell.setting for cell in cells}) < 2:
            raise UserError("--halve chooses between settings, and there is one: give several values, --set PATH=V,V,V")
        if not train_args.max_time:
            raise UserError("--halve needs the time of the first round: --max_time 60s")
        if not self.task.exam or self.task.train.runner.exam_interval <= 0:
            reason = (
                f"task '{self.task.name}' has none" if not self.task.exam else "runner.exam_interval = 0 leaves it out"
            )
            raise UserError(f"--halve ranks by the exam at the end of a training, and {reason}")
        self.cells, self.seconds = {cell.label: cell for cell in cells}.values(), train_args.max_time
        name = check_name(train_args.experiment_name or f"{self.task.name}_halving", "--experiment_name")
        self.folder = writable(str(Path.cwd() / "logs" / name), "--experiment_name", folder=True)
        self.common = [*NO_END, *common, "--experiment_name", name]
        settings = [text for item in args.set for text in ("--set", item)]
        self._claim(shlex.join([*common, *settings, "--seeds", args.seeds]))

    def _claim(self, sweep: str) -> None:
        file = self.folder / "sweep.txt"
        stored = file.read_text(encoding="utf-8") if file.is_file() else sweep
        if stored != sweep:
            raise UserError(f"{shown(self.folder)} holds another sweep, {stored}; name yours with --experiment_name")
        self.folder.mkdir(parents=True, exist_ok=True)
        file.write_text(sweep, encoding="utf-8")

    def file(self, cell: Cell, number: int) -> Path:
        return self.folder / f"round_{number}_{cell.label}.txt"

    def log(self, cell: Cell, number: int) -> Printed:
        return read_printed(self.file(cell, number))

    def training(self, cell: Cell, number: int) -> Training:
        """The training of round ``number``. Round 1 starts a new run. A stopped run gets its remaining time."""
        current, previous = self.log(cell, number), self.log(cell, number - 1)
        run = current.folder if current.left else previous.folder
        more = ["--max_time", current.left or f"{self.seconds * THIRD ** (number - 1):g}s"]
        more += ["--resume", "--load_run", run] if run else ["--run_name", cell.label]
        return Training(cell.name, [*self.common, *cell.flags, *more], self.file(cell, number))

    def line(self, cell: Cell, number: int) -> str:
        """A shell command of ``training``. It writes a failure to the log file, and then it is not printed again."""
        training = self.training(cell, number)
        file = shlex.quote(shown(training.log))
        return f"{command('train')} {shlex.join(training.flags)} >> {file} 2>&1 || echo failed: code $? >> {file}"

    def rounds(self, cell: Cell) -> int:
        """The number of completed rounds."""
        return next(number for number in count() if not self.log(cell, number + 1).done)

    def last(self, cell: Cell) -> Printed:
        """The log of the last completed round."""
        return self.log(cell, self.rounds(cell))

    def found(self, ranking: Sequence[str]) -> list[tuple[Cell, Run]]:
        """The runs with a completed round and their number of rounds, in the order of the settings in ``ranking``."""
        cells = sorted(self.cells, key=lambda cell: ranking.index(cell.setting))
        return [
            (cell._replace(varied={**cell.varied, "rounds": str(self.rounds(cell))}), find_runs([log.folder])[0])
            for cell in cells
            if (log := self.last(cell)).done
        ]


def halve(halving: Halving, args: argparse.Namespace, stop: Stop) -> None:
    """Train all rounds. Rounds that an earlier call or a cluster has completed are not trained again."""
    ranking, failed = list(dict.fromkeys(cell.setting for cell in halving.cells)), False
    left, better = ranking, ranked_figures(halving.task.exam)
    out = sys.stderr if args.print else sys.stdout  # with --print, stdout has only shell commands
    stop.listen()
    for number in count(1):
        ready = [cell for cell in halving.cells if cell.setting in left and halving.rounds(cell) >= number - 1]
        todo = [cell for cell in ready if halving.rounds(cell) < number]
        if args.print and (
            lines := [halving.line(cell, number) for cell in todo if not halving.log(cell, number).failed]
        ):
            print("\n".join(lines))
            print(f"round {number}; when these have ended, the same command prints the next", file=out)
            return
        if todo and not args.print:
            print(f"round {number}: {', '.join(left)}; to train: {len(todo)}", flush=True)
            train_all([halving.training(cell, number) for cell in todo], args.jobs, stop)
        if stop.asked:
            break
        exams = {name: [halving.log(cell, number).exam for cell in ready if cell.setting == name] for name in left}
        failed |= any(halving.rounds(cell) < number for cell in ready)
        if not any(exam for each in exams.values() for exam in each):
            raise UserError(f"round {number}: no training has an exam; their output is in {shown(halving.folder)}")
        ranked = rank(exams, better)
        ranking = [*ranked, *(name for name in ranking if name not in ranked)]
        if len(left) == 1 or number == args.rounds:
            break
        left = ranked[: math.ceil(len(ranked) / THIRD)]
    if finished := halving.found(ranking):
        print(f"\n{table(finished)}\n\n{curves_of([run for _, run in finished])}", file=out)
    if stop.asked:
        print(f"stopped in round {number}; go on with\n  {command('sweep')} {shlex.join(sys.argv[1:])}")
        raise SystemExit(STOPPED)
    runs = {
        log.folder: [log.exam]
        for cell in halving.cells
        if cell.setting == ranking[0] and (log := halving.last(cell)).done
    }
    play_flags = shlex.join(["--task", args.task, "--load_run", rank(runs, better)[0]])
    print(f"best: {ranking[0]}; watch it with\n  {command('play')} {play_flags}", file=out)
    if failed:
        print(f"some failed: their output is in {shown(halving.folder)}; without --print they train again", file=out)
        raise SystemExit(1)


def ranked_figures(exam: str) -> dict[str, bool]:
    """Figure of the exam during training that has a mark -> whether more is better."""
    from legged_mw.eval.skills import SKILLS  # imports MuJoCo

    if exam not in SKILLS:
        return WALKING
    return {measure.key: measure.more_is_better for measure in SKILLS[exam].measures if measure.marks}


def rank(exams: Mapping[str, Sequence[Mapping[str, float]]], better: Mapping[str, bool]) -> list[str]:
    """Names by their mean rank over all figures, best first. Names with a missing exam are last.

    ``exams``: name -> figures of each of its trainings, empty without an exam. Each figure is averaged over them.
    """
    largest = max(len(each) for each in exams.values())
    scores: dict[str, list[float]] = {}  # name -> score per figure: more is better, -inf if unknown
    for name, each in exams.items():
        means = [
            mean(exam.get(figure, math.nan) for exam in each if exam) if any(each) else math.nan for figure in better
        ]
        signed = [value if more else -value for value, more in zip(means, better.values(), strict=True)]
        scores[name] = [-math.inf if math.isnan(value) else value for value in signed]

    def sort_key(name: str) -> tuple[int, float]:
        ahead = [
            sum((other > own) + 0.5 * (other == own) for other in column)
            for own, column in zip(scores[name], zip(*scores.values(), strict=True), strict=True)
        ]
        return largest - sum(map(bool, exams[name])), mean(ahead)

    return sorted(exams, key=sort_key)


# ---- the table


def table(finished: Sequence[tuple[Cell, Run]]) -> str:
    """One line per run. Several seeds add the mean and standard deviation of each setting."""
    fields = list(dict.fromkeys(path for cell, _ in finished for path in cell.varied))
    (_, *heads), *lines = rows(runs := [run for _, run in finished])
    names = [path.rpartition(".")[2] for path in fields]
    settings = [{path: cell.varied.get(path, "") for path in fields} for cell, _ in finished]
    cells = [[*setting.values(), *line] for setting, (_, *line) in zip(settings, lines, strict=True)]
    means = []
    if "seed" in fields:
        groups: dict[tuple[str, ...], list[int]] = {}
        for i, setting in enumerate(settings):
            groups.setdefault(tuple({**setting, "seed": ""}.values()), []).append(i)
        columns = figures(runs).values()
        for members in groups.values():
            if len(members) > 1:
                summary = [_mean(digits, [values[i] for i in members]) for digits, values in columns]
                means.append([*{**settings[members[0]], "seed": f"mean of {len(members)}"}.values(), *summary])
    return text_table([[*names, *heads], *cells, *means])


def _mean(digits: str, values: Sequence[float | None]) -> str:
    """Mean and standard deviation as text; "-" if a value is missing.

    The text has the figure's ``digits``, or more to show two digits of the deviation.
    """
    numbers = [value for value in values if value is not None and math.isfinite(value)]
    if len(numbers) < len(values):
        return "-"
    spread = stdev(numbers)
    needed = 1 - math.floor(math.log10(spread)) if spread > 0 else 0
    decimals = max(int(digits.strip(",.df") or 0), min(needed, 6))
    return f"{mean(numbers):.{decimals}f} ± {spread:.{decimals}f}"
