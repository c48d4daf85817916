"""From flags to a running session: which viewer this machine has, what drives, how long. Used by every program that shows a stage."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from legged_mw.utils.errors import UserError
from legged_mw.view import web
from legged_mw.view.drive import CAMERAS, Pilot, outside
from legged_mw.view.film import Film
from legged_mw.view.gamepad import LAYOUT, Gamepad, find_gamepad
from legged_mw.view.native import NativeViewer, has_display
from legged_mw.view.script import load_script
from legged_mw.view.session import Session, Summary
from legged_mw.view.stage import Moment, Stage, Viewer, ViewError
from legged_mw.view.video import check_format, no_encoder

VIEWERS = ("auto", "native", "web", "video", "none")
ROBOTS_SHOWN = 64  # of a stage that has more: a picture of all would take longer than a control step
SECONDS = 10.0  # how long to record or run where nobody closes anything
WIDEN = "to see what it does all the same, widen the range: --set commands.ranges.lin_vel_x=[-3,3]"
COMMAND_FORM = "write three numbers, vx,vy,yaw [m/s, m/s, rad/s], e.g. 0.8,0,0"


class FlagError(UserError, ValueError):
    """Flags that do not go together, or a value that is none."""


class Picture(NamedTuple):
    """Of a video."""

    width: int = 1280  # [pixel]
    height: int = 720  # [pixel]
    fps: float = 25.0  # [1/s]


def add_flags(parser: argparse.ArgumentParser, viewer: str = "auto") -> None:
    """The flags of watching and driving; the program adds `--command` and `--time` [s] itself."""
    best = " (auto: the best that this machine has)"
    parser.add_argument("--viewer", choices=VIEWERS, default=viewer, help=f"where to show it, by default {viewer}{best}")
    parser.add_argument("--video", metavar="FILE", help="record an .mp4 or a .gif instead")
    parser.add_argument("--sheet", metavar="FILE.png", help="write one picture of twelve moments instead, or beside the video")
    parser.add_argument("--commands", metavar="FILE", help="drive by a YAML script of timed commands")
    parser.add_argument("--camera", choices=CAMERAS, default="follow", help="follow the robot, walk behind it, or see all")
    parser.add_argument("--host", default=web.LOCAL, metavar="H", help="interface of the web page (default: this machine only)")
    parser.add_argument("--port", type=int, default=0, metavar="P", help="port of the web page (default: the first free one from 8080)")


def check_flags(args: argparse.Namespace) -> None:
    """Refuse what cannot be, before anything is loaded. Raises FlagError or ViewError."""
    files = [flag for flag in ("video", "sheet") if getattr(args, flag)]
    if files and args.viewer not in ("auto", "video"):
        raise FlagError(f"--{files[0]} records and --viewer {args.viewer} does not: leave one of them out")
    if args.video:
        check_format(Path(args.video))
    for name in filter(None, (args.video, args.sheet)):
        if (taken := next(folder for folder in Path(name).absolute().parents if folder.exists())) and not taken.is_dir():
            raise ViewError(f"Cannot write {name}: {taken} is a file, not a folder.")
    if args.sheet and Path(args.sheet).suffix.lower() != ".png":
        raise ViewError(f"Cannot write {Path(args.sheet).name!r}: a contact sheet is a .png.")
    if not 0 <= args.port < 65536:
        raise FlagError(f"--port {args.port}: a port is a number from 1 to 65535")


def check_drive(args: argparse.Namespace, limits: ArrayLike, advice: str = WIDEN) -> list[float] | None:
    """Refuse a `--command` or a `--commands` file that is wrong or that the policy was not trained for; the former as numbers."""
    limits = np.asarray(limits, dtype=np.float64)
    if args.commands:
        load_script(args.commands, limits)
    if args.command is None:
        return None
    try:
        command = [float(value) for value in args.command.split(",")]
    except ValueError:
        command = []
    if len(command) != 3 or not np.isfinite(command).all():
        raise FlagError(f"--command {args.command}: {COMMAND_FORM}")
    if (wrong := outside(command, limits)) is not None:
        raise FlagError(f"--command {args.command}: {wrong}; {advice}")
    return command


def asked(args: argparse.Namespace) -> list[str]:
    """The flags of ``add_flags`` that were given."""
    default = {"viewer": "auto", "camera": "follow", "host": web.LOCAL, "port": 0}
    names = ("viewer", "video", "sheet", "commands", "camera", "host", "port")
    return [f"--{name}" for name in names if getattr(args, name) != default.get(name)]


def choose(args: argparse.Namespace, terminal: bool, screen: bool) -> tuple[str, str]:
    """The viewer to take, and why in words. A terminal has somebody at it who can open a page; a batch job must end by itself."""
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


def watch(stage: Stage, args: argparse.Namespace, folder: Path, picture: Picture | None = None, title: str = "legged_mw") -> Summary:
    """Show `stage` as the flags say; files without a name go to `folder`. Prints what it chose, where to look, and what came of it."""
    script = load_script(args.commands, stage.limits) if args.commands else None
    kind, why = choose(args, sys.stdout.isatty(), has_display())
    pilot = Pilot(stage.limits, min(stage.num_worlds, ROBOTS_SHOWN), args.camera)
    if stage.num_worlds > ROBOTS_SHOWN and kind != "none":
        print(f"{stage.num_worlds} robots, the first {ROBOTS_SHOWN} of them are shown")
    pilot.everyone = script is not None
    viewer: Viewer | None = None
    if kind == "native" and (viewer := _window(stage, pilot, why, fall_back=args.viewer == "auto")) is None:
        kind, why = choose(args, sys.stdout.isatty(), screen=False)
    seconds = args.time or (script.seconds if script else None) or (None if kind in ("native", "web") else SECONDS)
    viewer = viewer or _open(kind, why, stage, pilot, args, folder, picture or Picture(), seconds or SECONDS, title)
    gamepad = _gamepad() if kind in ("native", "web") else None
    session = Session(stage, viewer, pilot, seconds=seconds, real_time=kind in ("native", "web"), script=script, gamepad=gamepad)
    try:
        summary = session.run()
        viewer.close()
    except BaseException:
        (viewer.abort if isinstance(viewer, Film) else viewer.close)()
        raise
    finally:
        if gamepad is not None:
            gamepad.close()
    if isinstance(viewer, Film):
        print(f"written to {', '.join(_shown(path) for path in (viewer.video, viewer.sheet) if path)}")
    print(summary.text() if script or kind == "none" else summary.text().splitlines()[0])
    return summary


def _window(stage: Stage, pilot: Pilot, why: str, fall_back: bool) -> Viewer | None:
    """MuJoCo's window; None, and why in a line, where none can be opened and something else may be taken."""
    try:
        viewer = NativeViewer(stage.model, pilot, pilot.num_worlds)
    except ViewError as error:
        if not fall_back:
            raise
        print(f"no window: {error}")
        return None
    print(f"viewer: a window ({why}); h shows the keys")
    return viewer


def _open(
    kind: str,
    why: str,
    stage: Stage,
    pilot: Pilot,
    args: argparse.Namespace,
    folder: Path,
    picture: Picture,
    seconds: float,
    title: str,
) -> Viewer:
    count = pilot.num_worlds
    if kind == "web":
        page = web.WebViewer(stage.model, pilot, count, host=args.host, port=args.port, title=title)
        print(f"viewer: a web page ({why}): {page.url}  Ctrl-C ends it")
        if args.host == web.LOCAL and not has_display():
            print(f"  on another machine paste this into a terminal there, then open the page: {web.tunnel_line(page.port)}")
        elif args.host != web.LOCAL:
            print("  it has no password: whoever reaches this port can drive")
        sys.stdout.flush()
        return page
    if kind == "none":
        print(f"viewer: none ({why})")
        return Nobody()
    video, sheet = (Path(name) if name else None for name in (args.video, args.sheet))
    if video is None and sheet is None:
        video, sheet = folder / "play.mp4", folder / "play.png"
        if (reason := no_encoder()) is not None:  # nobody asked for a video by name
            print(f"no video: {reason}")
            video = None
    names = " and ".join(_shown(path) for path in (video, sheet) if path)
    print(f"viewer: {seconds:g} s of {names} ({why}); without a GPU for drawing it takes a while", flush=True)
    return Film(stage.model, count, stage.dt, seconds, video=video, sheet=sheet, **picture._asdict())


class Nobody:
    """The viewer that shows nothing."""

    def show(self, moment: Moment) -> None: ...

    def is_running(self) -> bool:
        return True

    def close(self) -> None: ...


def _gamepad() -> Gamepad | None:
    path = find_gamepad()
    if path is None:
        return None
    try:
        pad = Gamepad(path)
    except OSError as error:
        print(f"gamepad: {path} cannot be opened: {error.strerror}")
        return None
    print(f"gamepad: {path}: {LAYOUT}")
    return pad


def _shown(path: Path) -> str:
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except ValueError:
        return str(path)
