"""Watch, grade or export a policy: python play.py --task go1_flat"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any, NamedTuple

import torch
from rsl_rl.models import MLPModel

from legged_mw import ROOT
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval import exam
from legged_mw.rl.policy import act, export_onnx, load_policy, save_policy
from legged_mw.rl.runs import CONFIG_FILE, find_checkpoint, find_run, runs
from legged_mw.utils.cli import apply_overrides, duration, make_parser, one_line_errors, pick_device, seed_everything, shown
from legged_mw.utils.config import ConfigError, load_yaml, save_yaml
from legged_mw.utils.task import LoadedTask, load_task, task_names
from legged_mw.view.native import NativeViewer, Pace, has_display
from legged_mw.view.video import RobotRenderer, VideoWriter


class Source(NamedTuple):
    """Where a policy comes from."""

    folder: Path  # holds its config
    checkpoint: Path
    shipped: bool


def parse() -> argparse.Namespace:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--command", metavar="VX,VY,YAW", help="fixed command [m/s, m/s, rad/s]; write --command=-0.5,0,0 if it starts with a minus"
    )
    parser.add_argument("--video", metavar="FILE", help="record an MP4 instead of opening a window")
    parser.add_argument(
        "--time", type=duration, default=None, metavar="T", help="how long to play (default: 10s of video, a window until closed)"
    )
    parser.add_argument("--eval", action="store_true", help="run the walking exam, print its table, write a JSON file")
    parser.add_argument("--export", metavar="DIR", help="write model.pt, policy.onnx and config.yaml there")
    args = parser.parse_args()
    if not args.task:
        parser.error(f"--task is missing; tasks: {', '.join(task_names())}")
    return args


def main() -> None:
    args = parse()
    task = load_task(args.task)
    source = find_policy(task, args)
    print(f"{'shipped policy' if source.shipped else 'policy'}: {shown(source.checkpoint)}")
    task.update(load_yaml(source.folder / CONFIG_FILE), where=shown(source.folder / CONFIG_FILE))
    trained = task.cfg.to_dict()
    prepare(task, args)
    for path, now, before in sorted(set_of_changes(task, trained)):
        print(f"  {path}: {before} -> {now}")
    seed_everything(task.train.seed)
    device = pick_device(args.device)
    env = task.env_class(task.cfg, device, eager=args.eager)
    policy = load_policy(source.checkpoint, env, task.train, device)
    if args.export:
        export(task, policy, trained, Path(args.export))
    elif args.eval:
        grade(env, policy, source, Path.cwd() / f"{task.name}_exam.json" if source.shipped else source.folder / "exam.json")
    elif args.video or not has_display():
        if not args.video:
            print("no screen here (DISPLAY and WAYLAND_DISPLAY are not set): recording instead of opening a window")
        default = Path(f"{task.name}.mp4") if source.shipped else source.folder / "play.mp4"
        record(env, policy, Path(args.video) if args.video else default, args.time or 10.0)
    else:
        watch(env, policy, args.time)


def find_policy(task: LoadedTask, args: argparse.Namespace) -> Source:
    """The run asked for, else the last run, else the policy that ships with the task."""
    experiment = ROOT / "logs" / (args.experiment_name or task.train.runner.experiment_name or task.name)
    if args.load_run is not None or args.checkpoint != -1 or runs(experiment):
        run = find_run(experiment, args.load_run or "-1")
        return Source(run, find_checkpoint(run, args.checkpoint), shipped=False)
    folder = ROOT / "resources" / "policies" / task.name
    if not (folder / "model.pt").is_file():
        raise ConfigError(f"nothing to play: no run in {shown(experiment)} and no policy shipped for {task.name}; train first")
    return Source(folder, folder / "model.pt", shipped=True)


def prepare(task: LoadedTask, args: argparse.Namespace) -> None:
    """What playing changes in the trained config; the user's own overrides come last."""
    if args.eval:
        exam.prepare(task)
    else:
        for path, value in {"env.num_envs": 1, "noise.level": 0.0, "perturbation.enable": False}.items():
            task.set(path, value, where="play")
    if args.command is not None:
        try:
            command = [float(v) for v in args.command.split(",")]
            ranges = dict(zip(("lin_vel_x", "lin_vel_y", "ang_vel_yaw"), command, strict=True))
            if not all(map(math.isfinite, command)):
                raise ValueError
        except ValueError:
            raise ConfigError(f"--command {args.command}: write three numbers, vx,vy,yaw [m/s, m/s, rad/s], e.g. 0.8,0,0") from None
        for name, value in ranges.items():
            task.set(f"commands.ranges.{name}", [value, value], where="--command")
        task.set("commands.resampling_time", 0.0, where="--command")
    worlds = task.cfg.env.num_envs
    apply_overrides(task, args)
    if args.eval and task.cfg.env.num_envs != worlds:
        raise ConfigError(f"--eval needs its {worlds} worlds, one a command and one a kick; leave env.num_envs to it")


def set_of_changes(task: LoadedTask, trained: dict[str, Any]) -> list[tuple[str, object, object]]:
    """(path, now, as trained) of every field that differs from the trained config."""
    original = load_task(task.to_dict()["task"])
    original.cfg.update(trained, where=CONFIG_FILE)
    return [(path, now, before) for path, now, before in task.cfg.diff(original.cfg)]


def grade(env: LeggedRobot, policy: MLPModel, source: Source, path: Path) -> None:
    result = exam.run_exam(env, lambda obs: act(policy, obs))
    exam.save({"policy": shown(source.checkpoint), "engine": "mujoco_warp", "device": env.device, **result}, path)
    print(exam.table(result))
    print(f"written to {shown(path)}")


def record(env: LeggedRobot, policy: MLPModel, path: Path, seconds: float) -> None:
    viewer = env.cfg.viewer
    every = max(1, round(1 / (viewer.fps * env.dt)))  # [control steps] a frame
    obs = env.get_observations()
    print(f"recording {seconds:g} s of video to {shown(path)}; without a GPU for drawing it takes a while", flush=True)
    size = viewer.width, viewer.height
    with VideoWriter(path, *size, fps=1 / (every * env.dt)) as video, RobotRenderer(env.robot.visual, *size) as renderer:
        for step in range(round(seconds / env.dt)):
            if step % every == 0:
                video.add(renderer.frame(*seen(env)))
            obs, *_ = env.step(act(policy, obs))
    print(f"written to {shown(path)}")


def watch(env: LeggedRobot, policy: MLPModel, seconds: float | None) -> None:
    obs = env.get_observations()
    with NativeViewer(env.robot.visual) as viewer:
        pace, steps = Pace(env.dt), 0
        while viewer.is_running() and (seconds is None or steps * env.dt < seconds):
            viewer.show(*seen(env))
            obs, *_ = env.step(act(policy, obs))
            steps += 1
            pace.wait()


def seen(env: LeggedRobot) -> tuple:
    """Pose, command and velocity of the first world, for a viewer."""
    velocity = torch.cat([env.base_lin_vel[0, :2], env.base_ang_vel[0, 2:]])
    return tuple(t.cpu().numpy() for t in (env.sim.qpos[0], env.commands[0], velocity))


def export(task: LoadedTask, policy: MLPModel, trained: dict, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    save_policy(policy, folder / "model.pt", {"task": task.name})
    export_onnx(policy, task.cfg.normalization.clip_actions, folder / "policy.onnx")
    task.cfg.update(trained, where=CONFIG_FILE)
    save_yaml(folder / CONFIG_FILE, task.to_dict())
    print(f"written to {shown(folder)}: model.pt, policy.onnx, {CONFIG_FILE}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    with one_line_errors("play.py"):
        main()
