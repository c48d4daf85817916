"""Drive one robot from a terminal, with states, safety limits and a log. A separate thread prints."""

from __future__ import annotations

import argparse
import math
import queue
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

import numpy as np

from legged_mw.deploy.chirp import Chirp, at_rate
from legged_mw.deploy.contract import Contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.first_walk import FirstWalk, rehearse
from legged_mw.deploy.inputs import Gamepad, InputSource, Keys, RobotRemote, StopFile
from legged_mw.deploy.joint_check import LIFT, JointCheck
from legged_mw.deploy.log import Log, log_path
from legged_mw.deploy.mirror import FLAGS, LIVE, RobotMonitor
from legged_mw.deploy.odometry import Odometry
from legged_mw.deploy.robot import Floats, Measurement, Robot, RobotError
from legged_mw.deploy.runner import run
from legged_mw.deploy.safety import Limits, Safety, parse_limits
from legged_mw.deploy.states import States
from legged_mw.utils.commands import with_units
from legged_mw.utils.errors import shown
from legged_mw.utils.files import writable
from legged_mw.view import launch
from legged_mw.view.drive import load_script
from legged_mw.view.launch import FlagError

CHECK_KEYS = "keys: s start, x damping, Esc emergency stop"
KEYS = "keys: s start, a policy, x damping, Esc emergency stop, Ctrl-C end; arrows, q, e drive, space stops walking"
GAMEPADS = Path("/dev/input")  # folder of Linux's gamepads
STATUS = 0.2  # [s] between two status lines


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of driving and logging."""
    parser.add_argument(
        "--drive",
        action="store_true",
        help="drive from the terminal as on a robot: states, safety limits, a log; in real time",
    )
    check_help = "instead of the policy, move each joint by 0.1 rad and back with a tenth of the stiffness, and compare the motion"
    parser.add_argument("--check_joints", action="store_true", help=check_help)
    chirp_help = "run the joint check, then sweep each joint of a hanging robot, for legged-mw fit (docs/fit.md)"
    parser.add_argument("--chirp", action="store_true", help=chirp_help)
    walk_help = "run a robot's first walk: joint check, stand, stop, ten steps, a metre; compare with the exam's robot"
    parser.add_argument("--first_walk", action="store_true", help=walk_help)
    hoist_help = (
        "a simulated robot hangs until the policy starts (default: if it has two feet), "
        "high: with its feet in the air, as for --check_joints"
    )
    parser.add_argument("--hoist", choices=("yes", "no", "high"), help=hoist_help)
    limit_help = "change a safety limit, e.g. tilt=45 or frozen=off (list: docs/on_the_robot.md)"
    parser.add_argument("--limit", action="append", default=[], metavar="NAME=VALUE", help=limit_help)
    parser.add_argument("--gamepad", metavar="FILE", help="a gamepad (default: the first one found), or off")
    parser.add_argument(
        "--stop_fd", type=int, metavar="N", help="damp the robot when this file descriptor can be read or is closed"
    )
    parser.add_argument("--log", metavar="FILE", help="file of the log (default: a new file in logs/deploy), or off")
    parser.add_argument(
        "--replay", type=Path, metavar="LOG", help="draw a log beside the simulation of the same commands"
    )


def _checks_joints(args: argparse.Namespace) -> bool:
    return args.check_joints or args.first_walk or args.chirp


def check_flags(args: argparse.Namespace) -> None:
    """Check the combination of flags. Raises FlagError or LimitError."""
    others = [name for name in ("serve", "eval", "replay", "command", "commands") if getattr(args, name)]
    if args.check_joints and others:
        raise FlagError(f"--check_joints moves one joint of a robot at a time: leave --{others[0]} out")
    if args.chirp and (others := others + ["check_joints"] * args.check_joints):
        raise FlagError(f"--chirp moves one joint of a robot at a time, after a joint check: leave --{others[0]} out")
    if args.first_walk and (others := others + [n for n in ("check_joints", "chirp") if getattr(args, n)]):
        raise FlagError(f"--first_walk has its own commands and joint check: leave --{others[0]} out")
    args.drive |= _checks_joints(args)
    other_modes = {"eval": args.eval, "num_envs": args.num_envs != 1, "replay": args.replay}
    allowed = ("--commands", *([f"--{name}" for name in FLAGS] if args.viewer in LIVE else []))
    viewer_flags = [flag.removeprefix("--") for flag in launch.asked(args) if flag not in allowed]
    driving_flag = "--drive" if args.drive else f"--robot {args.robot}" if args.robot != "simulated" else ""
    if driving_flag and (refused := [name for name, value in other_modes.items() if value] + viewer_flags):
        raise FlagError(f"{driving_flag} drives one robot in real time: leave --{refused[0]} out")
    drive_flags = {
        "hoist": args.hoist and not args.serve,
        "limit": args.limit,
        "gamepad": args.gamepad,
        "stop_fd": args.stop_fd is not None,
        "log": args.log,
    }
    if not driving_flag and (refused := [name for name, value in drive_flags.items() if value]):
        raise FlagError(f"--{refused[0]} needs a driven robot: add --drive")
    parse_limits(args.limit)


def hoisted(args: argparse.Namespace, contract: Contract) -> bool:
    """True if a simulated robot starts on a hoist."""
    checks_joints = _checks_joints(args)
    return args.hoist in ("yes", "high") or (args.hoist is None and (len(contract.feet) == 2 or checks_joints))


def lift(args: argparse.Namespace) -> float:
    """Height [m] of a hoisted robot above its start position."""
    return LIFT * (args.hoist == "high" or (args.hoist is None and _checks_joints(args)))


def drive(
    connect: Callable[[], Robot],
    folder: Path,
    contract: Contract,
    args: argparse.Namespace,
    fixed: Sequence[float] | None,
    kind: str,
    contact: str | None = None,
) -> Robot:
    """Drive the robot of ``connect`` until Ctrl-C or for ``args.time`` [s], or run its joint check, chirp or first walk.

    If one of these three finds a fault, the exit code is 1. ``connect`` may end the robot's own program, which lets
    the robot fall, so whatever can be refused is refused before it is called. Returns the robot, closed.
    ``fixed`` (C,) is the command while no input source drives; None: the defaults. ``kind`` of robot, for the log.
    ``contact``: the source of foot contact for Odometry; None: no odometry.
    """
    with ExitStack() as stack:
        path = _check(folder, contract, args)
        controller, exam = Controller(folder, contract), rehearse(folder, contract) if args.first_walk else None
        mirror = stack.enter_context(closing(RobotMonitor(folder, contract, args))) if args.viewer in LIVE else None
        robot = connect()
        stack.callback(robot.close)
        limits = Limits.of(folder, contract, robot.limits, parse_limits(args.limit))
        if args.chirp:
            contract, limits = at_rate(contract, limits, robot)
            controller = Controller(folder, contract)
        safety = Safety(contract, limits)
        console = stack.enter_context(DriveConsole(contract))
        command = _commands(contract, args, fixed, console.say)
        sources = [*_sources(contract, args, console.say), *([mirror] if mirror else [])]
        if args.first_walk:
            states = FirstWalk(controller, sources, console.say, robot, safety.limits, exam)
        elif args.chirp:
            states = Chirp(controller, sources, console.say, robot, safety.limits)
        elif args.check_joints:
            states = JointCheck(controller, sources, console.say, robot, safety.limits)
        else:
            states = States(controller, sources, command, console.say)
        stack.callback(states.close)
        seconds = args.time or math.inf
        odometry = Odometry(folder, contract, 1, contact) if contact else None
        # opened last, so that an error before leaves no log
        log = Log(path, contract, folder, kind, console.say) if path else None
        console.say(f"{CHECK_KEYS if args.check_joints or args.chirp else KEYS}\n{states.state}: {states.note}")
        # set directly before the run, which damps the robot at a signal
        stack.enter_context(_ended_by_signals())

        def show(now: float, measured: Measurement | None) -> None:
            console.show(now, states)
            if mirror:
                mirror.show(now, measured, states)

        summary = run(
            robot, controller, command, seconds, watch=show, safety=safety, states=states, log=log, odometry=odometry
        )
        log_note = f"; {log.broken or f'logged to {shown(log.path)}'}" if log else ""
        console.say(f"{summary.timing}\nthe joints are damped{log_note}{states.report}")
    if not states.right:
        raise SystemExit(1)
    return robot


def _check(folder: Path, contract: Contract, args: argparse.Namespace) -> Path | None:
    """Raise for flags that cannot be followed, before the robot is touched. Returns the path of the log, if any."""
    Limits.of(folder, contract, asked=parse_limits(args.limit))
    if args.stop_fd is not None:
        StopFile(args.stop_fd)
    if pad := _gamepad(contract, args.gamepad):
        pad.close()  # opened again later: what is pressed until then must not count
    return None if args.log == "off" else writable(str(log_path(contract)) if args.log is None else args.log, "--log")


def _sources(contract: Contract, args: argparse.Namespace, say: Callable[[str], None]) -> list[InputSource]:
    """The input sources in the order of priority. The first source with a command drives."""
    sources: list[InputSource] = [RobotRemote(contract.commands)]
    if args.stop_fd is not None:
        sources.append(StopFile(args.stop_fd))
    if pad := _gamepad(contract, args.gamepad):
        say(f"{pad.path} can drive; unplugging it damps the robot")
        sources.append(pad)
    if sys.stdin.isatty():
        sources.append(Keys(contract.commands))
    return sources


def _gamepad(contract: Contract, asked: str | None) -> Gamepad | None:
    """The gamepad at the path ``asked``; None: the first gamepad that opens, if any. Raises RobotError."""
    if asked:
        return None if asked == "off" else Gamepad(Path(asked), contract.commands)
    for path in sorted(GAMEPADS.glob("js*")):
        with suppress(RobotError):
            return Gamepad(path, contract.commands)
    return None


def _commands(
    contract: Contract, args: argparse.Namespace, fixed: Sequence[float] | None, say: Callable[[str], None]
) -> Callable[[float], Floats]:
    """The command (C,) at a time [s] since the policy began: of the script, else ``fixed``, else the defaults."""
    default = np.array([each.default for each in contract.commands]) if fixed is None else np.array(fixed)
    if not args.commands:
        return lambda _: default
    script = load_script(args.commands, contract.commands).entries
    if others := sum((entry.push is not None) + entry.reset for entry in script):
        say(
            f"--commands {args.commands}: {others} of its pushes and resets are left out; a driven robot gets only commands"
        )
    entries = [(entry.time, np.array(entry.command)) for entry in script if entry.command]
    return lambda time: next((command for start, command in reversed(entries) if start <= time + 1e-9), default)


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Context manager: SIGTERM and a closed terminal damp the robot like Ctrl-C."""
    signals = (signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(each, signal.default_int_handler) for each in signals]
    try:
        yield
    finally:
        for each, handler in zip(signals, before, strict=True):
            signal.signal(each, handler)


class DriveConsole:
    """Prints lines on a thread, and in a terminal also a status line. A blocked terminal delays no step."""

    def __init__(self, contract: Contract) -> None:
        self._units = with_units(contract.commands)
        self._lines: queue.SimpleQueue[tuple[str, bool] | None] = queue.SimpleQueue()
        self._terminal, self._next = sys.stdout.isatty(), 0.0
        self._thread = threading.Thread(target=self._print, name="console", daemon=True)

    def __enter__(self) -> DriveConsole:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._lines.put(None)
        self._thread.join(timeout=1.0)

    def say(self, line: str) -> None:
        """Print a line."""
        self._lines.put((line, False))

    def show(self, now: float, states: States) -> None:
        """Overwrite the status line with the state and the command."""
        if self._terminal and now >= self._next and self._lines.qsize() < 10:
            self._next = now + STATUS
            command = " ".join(f"{value:+.2f}" for value in states.command)
            self._lines.put((f"{now:7.1f} s  {states.state:<11}  command {command} ({self._units})", True))

    def _print(self) -> None:
        with suppress(OSError, ValueError):  # the terminal is closed; the run continues
            while (entry := self._lines.get()) is not None:
                line, fleeting = entry
                clear = "\r\x1b[K" if self._terminal else ""
                print(f"{clear}{line}", end="" if fleeting else "\n", flush=True)
