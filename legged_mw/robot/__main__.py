"""A robot's health page: python -m legged_mw.robot FILE, an MJCF or URDF, or a task by its name or config file"""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

import torch

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.robot_task import RobotTask
from legged_mw.robot import new, picture
from legged_mw.robot.draft import Draft, as_env, draft, has_mirror
from legged_mw.robot.measure import measure
from legged_mw.robot.page import few_robots, page
from legged_mw.robot.pose import as_lines, why
from legged_mw.utils.cli import Parser, command, one_line_errors
from legged_mw.utils.errors import UserError, shown
from legged_mw.utils.files import writable
from legged_mw.utils.task import ROBOT_FILES, LoadedTask, load_task


def parse() -> argparse.Namespace:
    parser = Parser(prog="python -m legged_mw.robot", description=__doc__, allow_abbrev=False)
    parser.add_argument("file", metavar="FILE", help="the robot: .xml or .urdf; or a task")
    parser.add_argument("--picture", metavar="PNG", help="draw it from two sides: feet, IMU, colliders, joint axes")
    parser.add_argument("--new", metavar="NAME", help="write NAME.xml and NAME_flat.py, a first task for the robot")
    parser.add_argument("--out", metavar="DIR", default=".", help="where --new writes (default: here)")
    parser.add_argument(
        "--sim", action="store_true", help="--new writes a task for simulation only: observed velocity, equal worlds"
    )
    parser.add_argument("--force", action="store_true", help="--new may overwrite")
    parser.add_argument(
        "--pack",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="--new copies meshes and pictures into NAME_parts, looks with fewer triangles, so that the folder can be moved",
    )
    args = parser.parse_args()
    if args.picture is not None:
        writable(args.picture, "--picture", suffix=".png")
    if args.new and Path(args.file).suffix not in ROBOT_FILES:
        parser.error(f"--new makes a task for a robot's file ({', '.join(ROBOT_FILES)}); {args.file} is a task already")
    return args


def main() -> None:
    args = parse()
    torch.set_num_threads(1)
    file, image = Path(args.file), Path(args.picture) if args.picture else None
    if file.suffix not in ROBOT_FILES:
        show_task(load_task(args.file, say=True), image)
        return
    if args.new:
        # raise before the page is printed
        new.targets(args.new, writable(args.out, "--out", folder=True), file, args.force, args.pack)
    proposal = draft(file, args.sim)
    if args.new:
        new.refuse_wheels(proposal, file)
    env = as_env(proposal, file)
    show(env, file.name, image, proposal)
    if args.new:
        out, mirrors = Path(args.out), has_mirror(env)
        written = new.write(proposal, file, args.new, out, force=args.force, mirrors=mirrors, pack=args.pack)
        flags = shlex.join(["--task", shown(written[1]), "--check"])
        print(f"written: {' and '.join(map(shown, written))}; next:\n  {command('train')} {flags}")


def show_task(task: LoadedTask, image: Path | None) -> None:
    """Print the page of a task's robot on a plane, and draw it to ``image``."""
    env, rough = few_robots(task)
    show(env, task.name, image, rough=rough)


def show(env: RobotTask, title: str, image: Path | None, found: Draft | None = None, rough: bool = False) -> None:
    """Print the page and draw the picture. ``found``: a draft, to list its guesses. ``rough``: on rough terrain."""
    robot, feet = env.robot, env.foot_geoms if isinstance(env, LeggedRobot) else {}
    health = measure(robot, robot.pose, env.start_place, env.cfg.control.decimation, rough)
    print(
        page(health, title, found.guessed, found.notes, as_lines(found.judged)) if found else page(health, title),
        flush=True,
    )
    if image is None:
        return
    poses = None
    try:
        picture.draw(image, robot, health.rest.qpos, feet, title)
        if found and len(found.judged) > 1:
            poses = image.with_stem(f"{image.stem}_poses")
            picture.draw_poses(
                poses,
                robot,
                [(found.stands(each), f"{each.candidate.name}: {why(found.judged[0], each)}") for each in found.judged],
            )
    except OSError as error:
        raise UserError(f"cannot write {image}: {error.strerror}; say --picture FILE.png") from None
    print(f"picture: {shown(image)}" + (f"; the judged poses: {shown(poses)}" if poses else ""))


if __name__ == "__main__":
    with one_line_errors("legged_mw.robot"):
        main()
