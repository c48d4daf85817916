"""Watch the training environment: the flags of play, the config for playing, and the environment as a stage.

Also the viewer of a policy in training. In `view/` only this file imports torch and the environment.
"""

from __future__ import annotations

import argparse
import atexit
import copy
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from tensordict import TensorDict
from torch import Tensor

from legged_mw.drawing.scene import visual_spec
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.flags import require_task
from legged_mw.rl.learner_config import check_classes
from legged_mw.rl.policies import NETWORK_FILE, PolicySource, actor_in, introduce, load_policy
from legged_mw.rl.run_folder import checkpoints, load_tensors, reason_of, save_whole
from legged_mw.rl.students.estimator import believed_velocity
from legged_mw.rl.students.recurrent import forget
from legged_mw.sim.simulation import say_overflow
from legged_mw.sim.terrain import name_tile
from legged_mw.skills.motion_tracking import MotionTracking
from legged_mw.utils.cli import apply_overrides, duration, make_parser, pick_device, seed_everything
from legged_mw.utils.commands import Command, command_table
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import shown
from legged_mw.utils.files import writable
from legged_mw.utils.machine import has_display
from legged_mw.utils.task import LoadedTask
from legged_mw.view import launch
from legged_mw.view.stage import BoolArray, FloatArray

if TYPE_CHECKING:  # it imports git, which takes 0.1 s and is not needed here
    from legged_mw.rl.runner import Runner

NOMINAL = {  # overrides of the trained config for playing
    "env.num_envs": 1,
    "env.episode_length_s": 1e6,  # the watched robot walks on after the episode length of training
    "noise.level": 0.0,
    "perturbation.kick": False,
    "perturbation.push": False,
    "perturbation.curriculum": False,  # kicks that are asked for have their full strength
    "domain_rand.enable": False,
    "commands.curriculum": False,
    "gait.random_start": False,
    "motion.random_start": False,  # play a clip from start to end
    "falls.pull": 0.0,
    "falls.share": 1.0,  # in a get-up task every reset is a fall
}
ROWS, BORDER = 3, 2.0  # of the terrain: levels from the easiest to the hardest, border [m]


OF_THE_EXAM = {
    "compare": "grades two policies side by side",
    "ranges": "says what the exam asks",
    "no_hard": "leaves a part of the exam out",
}


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
        "--no_hard", action="store_true", help="--eval without the hard exam and heat, in two thirds of the time"
    )
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
    check_together(args, parser)
    launch.check_flags(args)
    if args.export is not None:
        writable(args.export, "--export", folder=True)
    torch.set_num_threads(1)  # with few worlds, more threads are slower
    return args


def check_together(args: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """Refuse flags that have no meaning together."""
    flags = [flag for flag in ("eval", "export", "video") if getattr(args, flag) not in (None, False)]
    if len(flags) > 1 or (args.eval and args.command is not None):
        parser.error("--eval, --export and --video are one thing each, and --eval brings its own commands")
    for name, why in OF_THE_EXAM.items():
        if getattr(args, name) not in (None, False) and not args.eval:
            parser.error(f"--{name} {why}: add --eval")
    if args.follow and (args.eval or args.export or args.checkpoint != -1):
        parser.error("--follow watches the newest policy: leave --eval, --export and --checkpoint out")
    if args.export and (args.set or args.override or args.command is not None):
        parser.error("--export writes the policy as it was trained: leave --set, --override and --command out")
    if args.half and not args.export:
        parser.error("--half rounds an export: add --export DIR")
    if args.commands and (args.eval or args.export or args.command is not None):
        parser.error("--commands drives a watched robot: leave out --command, --eval and --export")
    if (args.eval or args.export) and (watching := launch.asked(args)):
        parser.error(f"--eval and --export show nothing: leave {', '.join(watching)} out")


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
    if args.follow and source.checkpoint.name == NETWORK_FILE:
        raise launch.FlagError(
            f"--follow watches a run as it trains on, and {shown(source.checkpoint)} is an export: name a run, --load_run RUN"
        )
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


# ---- the environment as a stage


class EnvStage:
    """The robots of a task under `policy`; see `stage.Stage`.

    `command_table`: the commands with their trained ranges; by default those of the task.

    The environment's step may be a recorded graph, so a pilot's changes are written into its buffers between two steps.
    The policy must see a new command in the same step, so the observation rows "commands" and "gait_clock" are updated.
    Other rows keep the noise and the delays of the last step. ``newest`` reloads a policy that is being trained.
    """

    def __init__(
        self,
        env: RobotTask,
        policy: Callable[[TensorDict], Tensor],
        command_table: Sequence[Command] | None = None,
        newest: Newest | None = None,
    ) -> None:
        self.env, self.policy, self._newest = env, policy, newest
        self.spec, self.num_worlds, self.dt = visual_spec(env.robot, env.cfg.viewer.camera), env.num_envs, env.dt
        self.command_table = env.command_table if command_table is None else tuple(command_table)
        # (N, C), the environment's buffer; a task without commands has none
        self._commands: Tensor = env.commands if env.command_table else env.actions[:, :0]
        self._gait = env.gait if isinstance(env, LeggedRobot) else None
        self._command_columns, self._clock_columns = _columns_of(env, "commands"), _columns_of(env, "gait_clock")
        feet = env.foot_geoms.values() if isinstance(env, LeggedRobot) else ()
        self._foot_contacts = env.contact_count[:, : len({geom for geoms in feet for geom in geoms})]
        self._obs = env.get_observations()
        self._believed: Tensor | None = None  # estimated vx, vy (N, 2) at the last action
        self._overflowed = False  # and the user has been warned

    @torch.no_grad()
    def step(self, commands: FloatArray | None) -> None:
        env = self.env
        if self._newest:
            self._newest()
        if commands is not None:
            self._commands.copy_(torch.as_tensor(commands, dtype=torch.float, device=env.device))
            for group, columns, scales in self._command_columns:
                env.obs_buf[group][:, columns] = self._commands * scales
            if self._gait and isinstance(env, LeggedRobot):
                self._gait.observe(env.is_commanded())
                for group, columns, scales in self._clock_columns:
                    env.obs_buf[group][:, columns] = self._gait.row * scales
            self._obs = env.get_observations()
        self._believed = believed_velocity(self.policy, self._obs)
        self._obs, _, dones, _ = env.step(self.policy(self._obs))
        forget(self.policy, dones)
        self._overflowed = self._overflowed or say_overflow(env.sim, "the shown simulation")

    @property
    def news(self) -> str:
        """The loaded policy as text, for a stage that reloads it; else empty."""
        return self._newest.news if self._newest else ""

    def commands(self) -> FloatArray:
        return _array(self._commands)

    def velocity(self) -> FloatArray:
        return _array(torch.cat([self.env.base_lin_vel[:, :2], self.env.base_ang_vel[:, 2:]], dim=1))

    def believed_velocity(self) -> FloatArray | None:
        return None if self._believed is None else _array(self._believed)

    def qpos(self) -> FloatArray:
        return _array(self.env.sim.qpos)

    def ghost(self) -> FloatArray | None:
        return _array(self.env.reference.qpos) if isinstance(self.env, MotionTracking) else None

    def contacts(self) -> BoolArray:
        return (self._foot_contacts > 0.0).cpu().numpy()

    def fell(self) -> BoolArray:
        return self.env.fell.cpu().numpy().copy()

    def ground(self, world: int) -> str:
        terrain = self.env.terrain
        if terrain is None:
            return ""
        tile = terrain.tile_at(*self.env.root_pos[world, :2].tolist())
        return name_tile(terrain.kinds[tile[1]], terrain.difficulties[tile[0]]) if tile else "border"

    @torch.no_grad()
    def push(self, world: int, velocity: ArrayLike) -> None:
        self.env.root_lin_vel[world, :2] += torch.as_tensor(velocity, dtype=torch.float, device=self.env.device)

    @torch.no_grad()
    def reset(self, world: int) -> None:
        mask = torch.zeros(self.num_worlds, dtype=torch.bool, device=self.env.device)
        mask[world] = True
        self.env.restart(mask)
        forget(self.policy, mask)
        self._obs = self.env.get_observations()


def _columns_of(env: RobotTask, wanted: str) -> list[tuple[str, slice, Tensor]]:
    """The columns of a row's newest values in the observations, also in nested groups: (group, columns, scales)."""
    places: list[tuple[str, slice, Tensor]] = []
    for group, rows in env.observations.groups.items():
        for row in rows:
            newest = env.observations.newest(group, row.name)
            if row.name == wanted:
                places.append((group, newest, torch.tensor(row.column_scales(), device=env.device)))
            elif row.group:
                inside = [(columns, scales) for name, columns, scales in places if name == row.group]
                places += [
                    (group, slice(newest.start + cols.start, newest.start + cols.stop), scales)
                    for cols, scales in inside
                ]
    return places


def _array(tensor: Tensor) -> FloatArray:
    return tensor.cpu().numpy().astype(np.float64)


# ---- a policy in training: train --play writes it, play --follow reads it again

PLAYING = "playing.pt"  # the actor that train --play writes for the viewer, more often than checkpoints
_CHECK_SECONDS = 2.0  # between two checks of the folder
_SAVE_SECONDS = 15.0  # between two saves of the policy for the viewer


class Newest:
    """Reloads the newest policy of a run; call it at each step. ``load`` reads a file and returns its iteration.

    It ends the program if the parent process has ended: a viewer must not outlive a killed training run.
    """

    def __init__(self, folder: Path, load: Callable[[Path], int], shown: Path) -> None:
        """``shown``: the file of the current policy."""
        self.news = shown.stem.replace("model_", "iteration ")
        self._folder, self._load, self._parent = folder, load, os.getppid()
        self._stamp, self._next = _stamp(shown), 0.0

    def __call__(self) -> None:
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + _CHECK_SECONDS
        if os.getppid() != self._parent:
            raise KeyboardInterrupt  # ends the session as if the viewer were closed
        stamp, newest = max((_stamp(path), path) for path in (*self._folder.glob("model_*.pt"), self._folder / PLAYING))
        if stamp > self._stamp:
            self._stamp = stamp
            try:
                self.news = f"iteration {self._load(newest)}"
            except ConfigError:
                if newest.exists():  # else the training run has just deleted it
                    raise


def _stamp(path: Path) -> int:
    """The modification time of the file [ns]; 0 if it does not exist."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def watch_training(task: LoadedTask, runner: Runner, folder: Path) -> None:
    """Open the viewer of a starting run: a window, or without a screen a web page. It closes with the training."""
    if not checkpoints(folder):
        first = f"model_{runner.current_learning_iteration}.pt"  # a branch of another run does not begin at 0
        try:
            runner.save(str(folder / first))  # the viewer's first policy
        except (OSError, MemoryError) as error:
            print(f"WARNING: no viewer opens: cannot write {first} ({reason_of(error)})", flush=True)
            return
    name = task.name if task.ships else str(task.path)
    window = "native" if has_display() else "web"
    flags = ["--task", name, "--load_run", str(folder), "--follow", "--device", "cpu", "--viewer", window]
    command = [sys.executable, "-m", "legged_mw.programs", "play", *flags]
    if hasattr(os, "nice"):
        command = ["nice", "-n", "10", *command]
    # in a separate session, so that Ctrl-C reaches only the training, which then ends the viewer
    viewer = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
    atexit.register(_end_viewer, viewer, folder / PLAYING)
    shown = time.monotonic()

    def show(iteration: int) -> None:
        nonlocal shown
        if time.monotonic() - shown < _SAVE_SECONDS or viewer.poll() is not None:
            return
        shown = time.monotonic()
        try:
            save_whole({"actor_state_dict": runner.alg.get_policy().state_dict(), "iter": iteration}, folder / PLAYING)
        except (OSError, MemoryError) as error:
            print(f"WARNING: the viewer keeps its policy: cannot write {PLAYING} ({reason_of(error)})", flush=True)
            runner.console.listeners.remove(show)

    runner.console.listeners.append(show)


def _end_viewer(viewer: subprocess.Popen[bytes], file: Path) -> None:
    viewer.terminate()
    file.unlink(missing_ok=True)
