"""From flags to a running session: the viewer, the pilot, the duration. Used by every program that shows a stage."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from legged_mw.utils.commands import Command
from legged_mw.utils.errors import UserError, shown
from legged_mw.utils.files import writable
from legged_mw.utils.machine import has_display
from legged_mw.view import web
from legged_mw.view.drive import CAMERAS, NO_COMMANDS, Pilot, load_script, outside, parse_command, tour
from legged_mw.view.native import NativeViewer
from legged_mw.view.recorder import Recorder, check_format, no_encoder
from legged_mw.view.session import Outcome, Session
from legged_mw.view.stage import Moment, Stage, Viewer, ViewError

VIEWERS = ("auto", "native", "web", "video", "none")
UNSEEN = ("auto", "none")  # values of --viewer that are equal where a program shows nothing by default
ROBOTS_SHOWN = 64  # largest number of drawn robots: more take longer than a control step
SECONDS = 10.0  # ours: duration of a recording, or of a run without a viewer


class FlagError(UserError, ValueError):
    """Flags that exclude each other, or an invalid value."""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of watching and driving. The program adds `--command` and `--time` [s] itself."""
    where = "where to show it, by default auto (auto: the best that this machine has)"
    parser.add_argument("--viewer", choices=VIEWERS, default="auto", help=where)
    parser.add_argument("--video", metavar="FILE", help="record an .mp4 or a .gif instead")
    parser.add_argument(
        "--sheet", metavar="FILE.png", help="write one picture of twelve moments instead, or beside the video"
    )
    parser.add_argument("--commands", metavar="FILE", help="drive by a YAML script of timed commands")
    parser.add_argument(
        "--camera", choices=CAMERAS, default="follow", help="follow the robot, walk behind it, or see all"
    )
    parser.add_argument(
        "--host", default=web.LOCAL, metavar="H", help="interface of the web page (default: this machine only)"
    )
    parser.add_argument(
        "--port", type=int, default=0, metavar="P", help="port of the web page (default: the first free one from 8080)"
    )


def check_flags(args: argparse.Namespace) -> None:
    """Refuse invalid flags before anything is loaded. Raises FlagError, UserError or ViewError."""
    files = [flag for flag in ("video", "sheet") if getattr(args, flag) is not None]
    if files and args.viewer not in ("auto", "video"):
        raise FlagError(f"--{files[0]} records and --viewer {args.viewer} does not: leave one of them out")
    for flag in files:
        writable(getattr(args, flag), f"--{flag}", suffix=".png" if flag == "sheet" else "")
    if args.video:
        check_format(Path(args.video))
    if not 0 <= args.port < 65536:
        raise FlagError(f"--port {args.port}: a port is a number from 1 to 65535")


def check_drive(args: argparse.Namespace, table: Sequence[Command], advice: str = "") -> list[float] | None:
    """Check `--commands` and `--command` against the trained ranges. Return the values (C,) of `--command`, or None.

    `advice`: hint for a value outside its range (empty: widen the range). Raises ConfigError or FlagError.
    """
    if args.commands:
        load_script(args.commands, table)
    if args.command is None:
        return None
    if not table:
        raise FlagError(f"--command {args.command}: {NO_COMMANDS}")
    values = parse_command(args.command, [each._replace(low=-math.inf, high=math.inf) for each in table])
    if wrong := outside(values, table):
        raise FlagError(f"--command {args.command}: {wrong}; {advice or _widen(values, table)}")
    return values


def _widen(values: Sequence[float], table: Sequence[Command]) -> str:
    """The hint to widen a range, for a command outside the trained ranges."""
    value, command = next(pair for pair in zip(values, table, strict=True) if outside(pair[:1], pair[1:]))
    low, high = min(command.low, value), max(command.high, value)
    return f"to see what it does there, widen the range: --set commands.ranges.{command.name}=[{low:g},{high:g}]"


def asked(args: argparse.Namespace) -> list[str]:
    """The flags of ``add_flags`` that the user set. ``--viewer none`` asks for nothing."""
    default = {"viewer": UNSEEN, "camera": ("follow",), "host": (web.LOCAL,), "port": (0,)}
    names = ("viewer", "video", "sheet", "commands", "camera", "host", "port")
    return [f"--{name}" for name in names if getattr(args, name) not in default.get(name, (None,))]


def choose(args: argparse.Namespace, terminal: bool, screen: bool) -> tuple[str, str]:
    """The viewer and the reason for it. A user at a terminal can open a web page; a batch job must end by itself."""
    if args.viewer != "auto":
        return args.viewer, "as asked"
    if args.video or args.sheet:
        return "video", "a file was asked for"
    if screen:
        return "native", "there is a screen"
    if not terminal:
        return "video", "no screen here, and no terminal with somebody who could open a web page"
    if (reason := web.missing()) is not None:
        return "video", f"no screen here, and {reason}"
    return "web", "no screen here"


def watch(stage: Stage, args: argparse.Namespace, folder: Path, title: str = "legged_mw", **picture: Any) -> Outcome:
    """Show `stage` in the viewer of the flags. Files without a given name go to `folder`.

    `picture`: size and rate of a video, see Recorder. Prints the chosen viewer, its address or file, and the outcome.
    """
    script = load_script(args.commands, stage.command_table) if args.commands else None
    kind, why = choose(args, sys.stdout.isatty(), has_display())
    pilot, viewer = _pilot(stage, args, kind), None
    if kind == "native" and (viewer := window(stage, pilot, why, fall_back=args.viewer == "auto")) is None:
        kind, why = choose(args, sys.stdout.isatty(), screen=False)
        pilot = _pilot(stage, args, kind)
    live = kind in ("native", "web")
    seconds = args.time or (script.seconds if script else None) or (None if live else SECONDS)
    if kind == "video" and script is None and args.command is None:  # nobody drives, and drawn commands may ask little
        script = tour(stage.command_table, seconds or SECONDS)
    pilot.everyone = script is not None
    if kind == "web":
        viewer = web_page(stage, pilot, why, args, title)
    elif kind == "video":
        viewer = _recorder(stage, pilot, why, args, folder, seconds or SECONDS, picture)
    elif kind == "none":
        print(f"viewer: none ({why})")
    viewer = viewer or NoViewer()
    try:
        outcome = Session(stage, viewer, pilot, seconds=seconds, real_time=live, script=script).run()
        viewer.close()
    except BaseException:
        (viewer.abort if isinstance(viewer, Recorder) else viewer.close)()
        raise
    if isinstance(viewer, Recorder):
        print(f"written to {', '.join(_names(viewer.video, viewer.sheet))}")
    print(outcome.text() if script or kind == "none" else outcome.text().splitlines()[0])
    return outcome


def _pilot(stage: Stage, args: argparse.Namespace, kind: str) -> Pilot:
    """The pilot of the shown robots."""
    count = min(stage.num_worlds, ROBOTS_SHOWN)
    if count < stage.num_worlds and kind != "none":
        print(f"{stage.num_worlds} robots, the first {count} of them are shown")
    return Pilot(stage.command_table, count, args.camera)


def window(stage: Stage, pilot: Pilot, why: str, fall_back: bool) -> Viewer | None:
    """MuJoCo's window. If it cannot open and `fall_back` is set: print the reason and return None."""
    try:
        viewer = NativeViewer(stage.spec, pilot, pilot.num_worlds)
    except ViewError as error:
        if not fall_back:
            raise
        print(f"no window: {error}")
        return None
    print(f"viewer: a window ({why}); h shows the keys")
    return viewer


def web_page(stage: Stage, pilot: Pilot, why: str, args: argparse.Namespace, title: str) -> Viewer:
    """Open the web page and print its address."""
    page = web.WebViewer(stage.spec, pilot, pilot.num_worlds, host=args.host, port=args.port, title=title)
    print(f"viewer: a web page ({why}): {page.url}  Ctrl-C ends it")
    if args.host == web.LOCAL and not has_display():
        print(
            f"  on another machine paste this into a terminal there, then open the page: {web.tunnel_line(page.port)}"
        )
    elif "?token=" in page.url:
        print(
            f"  whoever has this address can {'drive' if 'own' in pilot.can else 'damp the robot'}; nothing is encrypted"
        )
    sys.stdout.flush()
    return page


def _recorder(
    stage: Stage, pilot: Pilot, why: str, args: argparse.Namespace, folder: Path, seconds: float, size: Any
) -> Viewer:
    video, sheet = (Path(name) if name else None for name in (args.video, args.sheet))
    if video is None and sheet is None:
        video, sheet = folder / "play.mp4", folder / "play.png"
        if (reason := no_encoder()) is not None:  # the user did not name a video
            print(f"no video: {reason}")
            video = None
    print(f"viewer: recording {seconds:g} s to {' and '.join(_names(video, sheet))} ({why})", flush=True)
    return Recorder(stage.spec, pilot.num_worlds, stage.dt, seconds, video=video, sheet=sheet, **size)


class NoViewer:
    """A viewer that shows nothing."""

    def show(self, moment: Moment) -> None: ...

    def is_running(self) -> bool:
        return True

    def close(self) -> None: ...


def _names(*paths: Path | None) -> list[str]:
    return [shown(path) for path in paths if path]
