"""What play.py prepares to watch: the flags, the config as it is played, the ground to walk on."""

from __future__ import annotations

import argparse
import copy
from pathlib import Path
from typing import Any

import torch

from legged_mw.rl.checkpoint import load_tensors
from legged_mw.rl.flags import require_task
from legged_mw.rl.policies import PolicySource, actor_in, introduce, load_policy
from legged_mw.rl.rsl_rl_settings import check_classes
from legged_mw.utils.cli import apply_overrides, duration, make_parser, pick_device, seed_everything
from legged_mw.utils.commands import Command, command_table
from legged_mw.utils.files import writable
from legged_mw.utils.task import LoadedTask
from legged_mw.view import launch
from legged_mw.view.env_stage import EnvStage
from legged_mw.view.follow import Newest

NOMINAL = {  # overrides of the trained config for playing
    "env.num_envs": 1,
    "env.episode_length_s": 1e6,  # the watched robot walks on after the episode length of training
    "noise.level": 0.0,
    "perturbation.kick": False,
    "perturbation.push": False,
    "domain_rand.enable": False,
    "commands.curriculum": False,
    "gait.random_start": False,
    "motion.random_start": False,  # play a clip from start to end
    "falls.pull": 0.0,
    "falls.share": 1.0,  # in a get-up task every reset is a fall
}
ROWS, BORDER = 3, 2.0  # of the terrain: levels from the easiest to the hardest, border [m]


def parse(description: str | None) -> argparse.Namespace:
    """Parse the flags of play."""
    parser = make_parser(description)
    parser.add_argument(
        "--command",
        metavar="VX,VY,YAW",
        help="fixed command [m/s, m/s, rad/s]; --command=-0.5,0,0; others by name: base_height=0.25",
    )
    parser.add_argument(
        "--time", type=duration, metavar="T", help="how long to play (default: 10s of video, a window until closed)"
    )
    launch.add_flags(parser)
    parser.add_argument("--follow", action="store_true", help="read the policy again as its run trains on")
    parser.add_argument(
        "--eval",
        action="store_true",
        help="run the task's exam (on rough ground too), print its tables, write a report",
    )
    parser.add_argument(
        "--compare", metavar="RUN", help="with --eval: grade this run beside it; its name or path, or 'shipped'"
    )
    common = (
        "--eval asks the ranges that were trained, or the one range that all published policies of the robot were asked"
    )
    parser.add_argument("--ranges", choices=("trained", "common"), help=common)
    parser.add_argument(
        "--export",
        metavar="DIR",
        help="write the policy as network, contract and scene there, to deploy (docs/deploy.md)",
    )
    parser.add_argument(
        "--half",
        action="store_true",
        help="with --export: round the weights to float16; the network takes half the space",
    )
    args = parser.parse_args()
    require_task(args, parser)
    asked = [flag for flag in ("eval", "export", "video") if getattr(args, flag) not in (None, False)]
    if len(asked) > 1 or (args.eval and args.command is not None):
        parser.error("--eval, --export and --video are one thing each, and --eval brings its own commands")
    if args.compare is not None and not args.eval:
        parser.error("--compare grades two policies side by side: add --eval")
    if args.ranges and not args.eval:
        parser.error("--ranges says what the exam asks: add --eval")
    if args.follow and (args.eval or args.export or args.checkpoint != -1):
        parser.error("--follow watches the newest policy: leave --eval, --export and --checkpoint out")
    if args.export and (args.set or args.override or args.command is not None):
        parser.error("--export writes the policy as it was trained: leave --set, --override and --command out")
    if args.half and not args.export:
        parser.error("--half rounds what is exported: add --export DIR")
    if args.commands and (args.eval or args.export or args.command is not None):
        parser.error("--commands drives what is watched: it goes with neither --command nor --eval nor --export")
    if (args.eval or args.export) and (watching := launch.asked(args)):
        parser.error(f"--eval and --export show nothing: leave {', '.join(watching)} out")
    launch.check_flags(args)
    if args.export is not None:
        writable(args.export, "--export", folder=True)
    torch.set_num_threads(1)  # with few worlds, more threads are slower
    return args


def prepare(
    source: PolicySource, trained: LoadedTask, args: argparse.Namespace
) -> tuple[LoadedTask, tuple[Command, ...]]:
    """Prepare a task for playing: apply the overrides of playing, then those of the user. Print the changes.

    Returns the task, and the commands with their trained ranges.
    """
    task = copy.deepcopy(trained)
    config = task.to_dict()
    for path, value in NOMINAL.items():
        section, _, field = path.partition(".")
        if field in config.get(section, {}):
            task.set(path, value, where="play")
    apply_overrides(task, args)  # the overrides choose the terrain
    for path, value in ground_to_watch(task).items():
        task.set(path, value, where="play")
    apply_overrides(task, args)
    check_classes(task.train)
    commands = command_table(task.cfg)
    if (values := launch.check_drive(args, commands)) is not None:
        fixed = {each.name: value for each, value in zip(commands, values, strict=True)}
        for name, value in fixed.items():
            task.set(f"commands.ranges.{name}", [value, value], where="--command")
        defaults = {name: fixed[name] for name in task.cfg.commands.default}
        task.set("commands.default", defaults, where="--command")
        task.set("commands.resampling_time", 0.0, where="--command")
    introduce(source, task.changes_since(trained))
    return task, commands


def ground_to_watch(task: LoadedTask) -> dict[str, Any]:
    """Overrides for a terrain that draws fast: few levels, one column and one robot per kind, frequent kinds first."""
    terrain = task.to_dict()["terrain"]
    shares = terrain.get("terrain_proportions", {})
    kinds = sorted((kind for kind in shares if shares[kind] > 0), key=lambda kind: -shares[kind])
    if terrain.get("mesh_type", "plane") == "plane" or not kinds:
        return {}
    return {
        "env.num_envs": len(kinds),
        "terrain.num_rows": ROWS,
        "terrain.num_cols": len(kinds),
        "terrain.border_size": BORDER,
        "terrain.terrain_proportions": dict.fromkeys(kinds, 1.0),
        "terrain.curriculum": False,  # each reset draws a random level; with the curriculum on, from the first level up
        "terrain.max_init_terrain_level": 0,
    }


def watch(source: PolicySource, task: LoadedTask, commands: tuple[Command, ...], args: argparse.Namespace) -> None:
    """Show the policy in the environment of the prepared task. ``commands`` have their trained ranges."""
    device = pick_device(args.device)
    seed_everything(task.train.seed)
    env = task.env_class(task.cfg, device, eager=args.eager)
    policy = load_policy(source.checkpoint, env, task.train, device)
    sizes = {name: getattr(task.cfg.viewer, name) for name in ("width", "height", "fps")}

    def renew(path: Path) -> int:
        content = load_tensors(path, device)
        policy.load_state_dict(actor_in(content, path, policy))
        return int(content["iter"])

    stage = EnvStage(env, policy, commands, Newest(source.folder, renew, source.checkpoint) if args.follow else None)
    launch.watch(stage, args, source.results(task), title=task.name, **sizes)
