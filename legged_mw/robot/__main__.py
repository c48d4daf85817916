"""A robot's health page: python -m legged_mw.robot FILE, an MJCF or URDF, or a task by its name or config file"""

from __future__ import annotations

import argparse
import copy
import shlex
from pathlib import Path

import torch

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.own_code import place_of
from legged_mw.envs.robot_task import RobotTask
from legged_mw.robot import new, picture
from legged_mw.robot.draft import Draft, as_env, draft, has_mirror
from legged_mw.robot.measure import measure
from legged_mw.robot.page import doubtful, faults, page
from legged_mw.robot.suggest import suggest
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
    parser.add_argument("--force", action="store_true", help="--new may overwrite")
    args = parser.parse_args()
    if args.picture is not None:
        writable(args.picture, "--picture")
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
        new.targets(args.new, writable(args.out, "--out", folder=True), args.force)  # refused before the page, not after it
    found = draft(file)
    env = as_env(found, file)
    show(env, file.name, image, found)
    if args.new:
        written = new.write(found, file, args.new, Path(args.out), args.force, has_mirror(env))
        flags = shlex.join(["--task", shown(written[1]), "--check"])
        print(f"written: {' and '.join(map(shown, written))}; next:\n  {command('train')} {flags}")


def show_task(task: LoadedTask, image: Path | None) -> None:
    """Print the page of a task's robot, one on a plane; draw it to ``image``."""
    env, rough = _few(task)
    show(env, task.name, image, rough=rough)


def doubts(task: LoadedTask) -> tuple[list[str], list[str]]:
    """What keeps robots of a task from learning: a rule that ends every episode at once, gains that no training makes up for; and what may.

    Random numbers go on as if it had not been called.
    """
    control = task.cfg.control
    gains = control.actuator in ("servo", "dc_motor") and control.action_origin != "speed"
    with torch.random.fork_rng(devices=[]):
        env, _ = _few(task, 4, gains)
        ends, wrong, odd = first_step(env), list[str](), list[str]()
        if gains:
            health = measure(env.robot, env.robot.pose, env.start_place, control.decimation)
            wrong, odd = faults(health), doubtful(health, suggest(health.joints, health.dt))
    return [*([ends] if ends else []), *wrong], odd


@torch.inference_mode()
def first_step(env: RobotTask) -> str:
    """Which rule ends every episode of ``env`` within a step of action zero, in words; '' if none does. Its worlds move on."""
    for _ in range(3):  # of worlds that begin anywhere, all may end by chance
        env._reset_all()
        env.actions.zero_()
        env._apply_actions()
        env.sim.step(env.cfg.control.decimation, env.actuators.before)
        env._update_state()
        env.check_termination()
        if not bool(env.reset_buf.all()):
            return ""
    rules = [f"{field} = {_field(env, field)}" for field, down in env.fall_rules().items() if bool(down.any())]
    if bool(env.fell.any()) and type(env)._fallen is not RobotTask._fallen:
        rules.append(place_of(type(env)._fallen))
    if bool(env.time_out_buf.any()):
        rules.append(f"env.episode_length_s = {env.cfg.env.episode_length_s:g}, with control steps of {env.dt:g} s")
    if bool(env.broken.any()):
        rules.append("a state that is not finite, or faster than termination.max_speed")
    return f"every episode ends at its first step: by {' and '.join(rules) or type(env).__name__}"


def _field(env: RobotTask, path: str) -> object:
    section, _, field = path.partition(".")
    return getattr(getattr(env.cfg, section), field)


def _few(task: LoadedTask, worlds: int = 1, servos: bool = True) -> tuple[RobotTask, bool]:
    """Robots of the task on a plane, on a CPU, on ``servos`` or on their own motors; and whether the task's own ground is another."""
    few, kind = copy.deepcopy(task), task.env_class
    few.set("env.num_envs", worlds)
    few.set("sim.engine", "mujoco")
    if servos:
        few.set("control.actuator", "servo")  # what the page is about: gains, and what a simulation step makes of them
        kind = type(kind.__name__, (kind,), {"_compute_torques": RobotTask._compute_torques})
    if rough := few.cfg.to_dict()["terrain"].get("mesh_type", "plane") != "plane":
        few.set("terrain.mesh_type", "plane")
    return kind(few.cfg, "cpu"), rough


def show(env: RobotTask, title: str, image: Path | None, found: Draft | None = None, rough: bool = False) -> None:
    """Print the page, with what was guessed if the task is a draft; then draw the picture. Room is that of ``rough`` ground."""
    robot, feet = env.robot, env.foot_geoms if isinstance(env, LeggedRobot) else {}
    health = measure(robot, robot.pose, env.start_place, env.cfg.control.decimation, rough)
    print(page(health, title, found.guessed, found.notes) if found else page(health, title), flush=True)
    if image is None:
        return
    try:
        picture.draw(image, robot, health.rest.qpos, feet, title)
    except OSError as error:
        raise UserError(f"cannot write {image}: {error.strerror}; say --picture FILE.png") from None
    print(f"picture: {shown(image)}")


if __name__ == "__main__":
    with one_line_errors("legged_mw.robot"):
        main()
