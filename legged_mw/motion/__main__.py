"""A reference motion: python -m legged_mw.motion FILE, a CSV or .npz; checks it, converts it, plays it"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Annotated

import numpy as np

from legged_mw.envs.robot_task import load_robot
from legged_mw.motion.foreign import CSV_FPS, read_motion
from legged_mw.motion.look import ClipStage, page
from legged_mw.sim.model import RobotModel
from legged_mw.skills.clip import Clip, ClipError, save_clip
from legged_mw.utils.bounds import above
from legged_mw.utils.cli import Parser, duration, number, one_line_errors
from legged_mw.utils.errors import shown
from legged_mw.utils.files import writable
from legged_mw.utils.task import load_task
from legged_mw.view import launch

Rate = Annotated[float, above(0, 1000)]  # frames a second


def parse() -> argparse.Namespace:
    parser = Parser(prog="python -m legged_mw.motion", description=__doc__, allow_abbrev=False)
    parser.add_argument("file", metavar="FILE", help="Unitree-style CSV, or an .npz of BeyondMimic, mjlab or legged_mw")
    parser.add_argument("--task", default="g1_track", metavar="NAME", help="whose robot moves so (default: g1_track)")
    parser.add_argument(
        "--fps",
        type=number(Rate),
        metavar="F",
        help=f"frames a second, if the file does not say (a CSV: {CSV_FPS:g})",
    )
    parser.add_argument(
        "--rate", type=number(Rate), default=50.0, metavar="F", help="frames a second to resample to (default: 50)"
    )
    parser.add_argument("--cut", type=number(float), nargs=2, metavar=("FROM", "TO"), help="keep only these seconds")
    parser.add_argument("--lift", type=number(float), default=0.0, metavar="M", help="raise it by so many metres")
    parser.add_argument("--out", metavar="CLIP.npz", help="write the clip that a task can follow")
    parser.add_argument("--play", action="store_true", help="show it")
    parser.add_argument("--time", type=duration, metavar="T", help="how long to show it (default: the whole clip)")
    launch.add_flags(parser)
    args = parser.parse_args()
    args.command = None
    launch.check_flags(args)
    if args.out is not None and writable(args.out, "--out").suffix != ".npz":
        parser.error(f"--out {args.out}: a clip is an .npz")
    return args


def main() -> None:
    args = parse()
    cfg, file = load_task(args.task, say=True).cfg, Path(args.file)
    robot = load_robot(cfg, "servo", "mujoco")
    clip = convert(read_motion(file, robot, args.fps), args)
    print(page(robot, clip, feet_of(robot)))
    if args.out:
        save_clip(Path(args.out), clip)
        print(f"written: {shown(Path(args.out))}")
    if args.play or args.video or args.sheet:
        args.time = args.time or clip.seconds
        launch.watch(ClipStage(robot, clip), args, Path(), title=file.stem)


def convert(clip: Clip, args: argparse.Namespace) -> Clip:
    """``clip`` after the changes of the flags."""
    clip = clip.at(args.rate)
    if args.cut:
        first, last = (round(seconds * clip.fps) for seconds in args.cut)
        if not 0 <= first < last < len(clip.root_pos):
            raise ClipError(f"--cut {args.cut[0]:g} {args.cut[1]:g}: the clip goes from 0 to {clip.seconds:g} s")
        clip = Clip(clip.fps, clip.joint_names, *(values[first : last + 1] for values in clip[2:]))
    return clip._replace(root_pos=clip.root_pos + np.array([0.0, 0.0, args.lift]))


def feet_of(robot: RobotModel) -> list[str]:
    """The geoms of the robot's feet."""
    model = robot.physics
    return [model.geom(g).name for g in range(model.ngeom) if model.geom_bodyid[g] and model.geom_conaffinity[g]]


if __name__ == "__main__":
    with one_line_errors("legged_mw.motion"):
        main()
