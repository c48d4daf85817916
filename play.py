"""Watch, grade or export a policy: python play.py --task go1_flat"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import torch
from rsl_rl.models import MLPModel

from legged_mw import ROOT
from legged_mw.envs.domain_rand import active
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval import crossing, exam, report, rules
from legged_mw.rl.policy import act, load_policy
from legged_mw.rl.runs import CONFIG_FILE, find_checkpoint, find_run, runs
from legged_mw.utils.cli import apply_overrides, duration, make_parser, one_line_errors, pick_device, seed_everything, shown
from legged_mw.utils.config import ConfigError, load_yaml
from legged_mw.utils.errors import UserError
from legged_mw.utils.task import LoadedTask, load_task, task_names
from legged_mw.view import launch
from legged_mw.view.env_stage import EnvStage

NOMINAL = {  # what playing changes in the trained config
    "env.num_envs": 1,
    "env.episode_length_s": 1e6,  # who is watched or driven walks on where training would begin a new episode
    "noise.level": 0.0,
    "perturbation.enable": False,
    "perturbation.push": False,
    "domain_rand.enable": False,
    "commands.curriculum": False,
}

ROWS, BORDER = 3, 2.0  # of the ground to watch: levels, from the easiest to the hardest, and [m]


class Source(NamedTuple):
    """Where a policy comes from."""

    folder: Path  # holds its config
    checkpoint: Path
    shipped: bool


class Run(NamedTuple):
    """A policy with its config, prepared for what was asked: to watch, to grade, to export."""

    source: Source
    trained: dict[str, Any]  # the config as it was trained
    task: LoadedTask  # with what playing or the exam changes, and the user's overrides
    limits: list[list[float]]  # (2, 3) of the command, as trained
    crossing: LoadedTask | None  # for the exam's rough part, if there is one

    def changes(self) -> dict[str, tuple[Any, Any]]:
        """Path -> (as trained, now)."""
        return changes_since(self.task, self.trained)


def parse() -> argparse.Namespace:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--command", metavar="VX,VY,YAW", help="fixed command [m/s, m/s, rad/s]; write --command=-0.5,0,0 if it starts with a minus"
    )
    parser.add_argument(
        "--time", type=duration, default=None, metavar="T", help="how long to play (default: 10s of video, a window until closed)"
    )
    launch.add_flags(parser)
    parser.add_argument("--eval", action="store_true", help="run the walking exam (on rough ground too), print its tables, write a report")
    parser.add_argument("--compare", metavar="RUN", help="with --eval: grade this run beside it; its name or path, or 'shipped'")
    parser.add_argument(
        "--export", metavar="DIR", help="write the policy as networks, contract and scene there, to deploy (docs/deploy.md)"
    )
    args = parser.parse_args()
    if not args.task:
        parser.error(f"--task is missing; tasks: {', '.join(task_names())}")
    asked = [flag for flag in ("eval", "export", "video") if getattr(args, flag)]
    if len(asked) > 1 or (args.eval and args.command is not None):
        parser.error("--eval, --export and --video are one thing each, and --eval brings its own commands")
    if args.compare is not None and not args.eval:
        parser.error("--compare grades two policies side by side: add --eval")
    if args.commands and (args.eval or args.export or args.command is not None):
        parser.error("--commands drives what is watched: it goes with neither --command nor --eval nor --export")
    if (args.eval or args.export) and (watching := launch.asked(args)):
        parser.error(f"--eval and --export show nothing: leave {', '.join(watching)} out")
    launch.check_flags(args)
    return args


def main() -> None:
    args = parse()
    run = read_run(args, find_policy(load_task(args.task), args))
    print(f"{'shipped policy' if run.source.shipped else 'policy'}: {shown(run.source.checkpoint)}")
    for path, (before, now) in sorted(run.changes().items()):
        print(f"  {path}: {before} -> {now}")
    if args.export:
        export(run, Path(args.export))
        return
    rival = read_run(args, find_rival(load_task(args.task), args)) if args.compare is not None else None
    device = pick_device(args.device)
    out = ROOT / "logs" / run.task.name / "shipped" if run.source.shipped else run.source.folder  # where results go
    if args.eval:
        rows = [(each, *build(each, args, device)) for each in (run, rival) if each]  # all, before one is graded for nothing
        columns = [grade(*row) for row in rows]
        report.write(out / "eval", run.task.name, columns, elsewhere(run))
        print(f"written to {shown(out / 'eval' / 'report.html')}, with report.json and pictures beside it")
    else:
        policy, env, _ = build(run, args, device)
        stage, viewer = EnvStage(env, lambda obs: act(policy, obs), run.limits), run.task.cfg.viewer
        launch.watch(stage, args, out, launch.Picture(viewer.width, viewer.height, viewer.fps), title=run.task.name)


def read_run(args: argparse.Namespace, source: Source) -> Run:
    """The policy's own config, with the user's overrides: two policies are graded each by its own, overridden alike."""
    task = load_task(args.task)
    config = source.folder / CONFIG_FILE
    task.update_from_run(load_yaml(config), where=shown(config))
    trained = task.to_dict()
    return Run(source, trained, task, prepare(task, args), prepare_crossing(trained, args))


def find_policy(task: LoadedTask, args: argparse.Namespace) -> Source:
    """The run asked for, else the last run, else the policy that ships with the task."""
    experiment = experiment_of(task, args)
    if args.load_run == "shipped":
        if not shipped(task).checkpoint.is_file():
            raise ConfigError(f"--load_run shipped: no policy ships with {task.name}")
        return shipped(task)
    if args.load_run is not None or args.checkpoint != -1 or runs(experiment):
        run = find_run(experiment, args.load_run or "-1")
        return Source(run, find_checkpoint(run, args.checkpoint), shipped=False)
    if not (shipped(task).checkpoint).is_file():
        raise ConfigError(f"nothing to play: no run in {shown(experiment)} and no policy shipped for {task.name}; train first")
    return shipped(task)


def shipped(task: LoadedTask) -> Source:
    """Where the policy that ships with the task would be."""
    folder = ROOT / "resources" / "policies" / task.name
    return Source(folder, folder / "model.pt", shipped=True)


def find_rival(task: LoadedTask, args: argparse.Namespace) -> Source:
    """What ``--compare`` names; of the same task."""
    if args.compare == "shipped":
        if not shipped(task).checkpoint.is_file():
            raise ConfigError(f"--compare shipped: no policy ships with {task.name}")
        return shipped(task)
    run = find_run(experiment_of(task, args), args.compare)
    saved = load_yaml(run / CONFIG_FILE)
    if Path(str(saved.get("task", task.name))).stem != task.name:
        raise ConfigError(f"--compare {args.compare} is of task '{saved['task']}', not '{task.name}': two policies are graded on one task")
    return Source(run, find_checkpoint(run, -1), shipped=False)


def experiment_of(task: LoadedTask, args: argparse.Namespace) -> Path:
    """The folder of the task's runs."""
    return ROOT / "logs" / (args.experiment_name or task.train.runner.experiment_name or task.name)


def build(run: Run, args: argparse.Namespace, device: str) -> tuple[MLPModel, LeggedRobot, LeggedRobot | None]:
    """The policy, the environment to watch or grade it in, and the one of the exam's rough part."""
    seed_everything(run.task.train.seed)
    env = run.task.env_class(run.task.cfg, device, eager=args.eager)
    rough = run.crossing.env_class(run.crossing.cfg, device, eager=args.eager) if run.crossing else None
    return load_policy(run.source.checkpoint, env, run.task.train, device), env, rough


def prepare(task: LoadedTask, args: argparse.Namespace) -> list[list[float]]:
    """What playing changes in the trained config, the user's own overrides last; returns the command's limits (2, 3), as trained."""
    if args.eval:
        report.prepare(task)
    else:
        for path, value in NOMINAL.items():
            task.set(path, value, where="play")
        apply_overrides(task, args)  # they say on what ground
        for path, value in ground_to_watch(task).items():
            task.set(path, value, where="play")
    override(task, args, exam.SETS if args.eval else set())
    if args.eval:
        report.make_room(task)  # the ranges are known by now
    ranges = task.cfg.commands.ranges
    limits = [list(side) for side in zip(ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw, strict=True)]
    if (command := launch.check_drive(args, limits)) is not None:
        for name, value in zip(("lin_vel_x", "lin_vel_y", "ang_vel_yaw"), command, strict=True):
            task.set(f"commands.ranges.{name}", [value, value], where="--command")
        task.set("commands.resampling_time", 0.0, where="--command")
    return limits


def ground_to_watch(task: LoadedTask) -> dict[str, Any]:
    """A grid that is soon drawn, in place of the whole one: few levels, a column and a robot a kind, the most frequent first."""
    terrain = task.cfg.terrain
    shares = terrain.terrain_proportions
    kinds = sorted((kind for kind in shares if shares[kind] > 0), key=lambda kind: -shares[kind])
    if terrain.mesh_type == "plane" or not kinds:
        return {}
    return {
        "env.num_envs": len(kinds),
        "terrain.num_rows": ROWS,
        "terrain.num_cols": len(kinds),
        "terrain.border_size": BORDER,
        "terrain.terrain_proportions": dict.fromkeys(kinds, 1.0),
        "terrain.curriculum": False,  # any level, anew at each reset; else, where that is asked for, from the first one on
        "terrain.max_init_terrain_level": 0,
    }


def prepare_crossing(trained: dict[str, Any], args: argparse.Namespace) -> LoadedTask | None:
    """The exam's rough part with the user's overrides; None where it is not asked for, or training was on a plane."""
    if not args.eval or trained["terrain"]["mesh_type"] == "plane":
        return None
    task = load_task(str(trained["task"]))
    task.update(trained, where=CONFIG_FILE)
    crossing.prepare(task)
    override(task, args, crossing.SETS)
    crossing.make_room(task)  # the kinds of ground are known by now
    return task


def override(task: LoadedTask, args: argparse.Namespace, sets: set[str]) -> None:
    """Apply the user's overrides, unless one of them changes what the exam ``sets`` itself."""
    before = task.to_dict()
    apply_overrides(task, args)
    if sets and (touched := sets & changes_since(task, before).keys()):
        raise ConfigError(f"--eval sets {', '.join(sorted(touched))} itself; an exam with other values would be another exam")


def changes_since(task: LoadedTask, trained: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Path -> (as trained, now) of every field of both configs that differs."""
    original = load_task(str(task.path))
    original.update(trained, where=CONFIG_FILE)
    differences = [*original.cfg.diff(task.cfg), *original.train.diff(task.train)]
    return {path: (before, now) for path, before, now in differences}


def grade(run: Run, policy: MLPModel, env: LeggedRobot, rough: LeggedRobot | None) -> report.Column:
    """The exam and all else of a report, from one roll-out and, if there is a rough part, another; prints their tables."""
    source = run.source
    result, figures = report.examine(env, lambda obs: act(policy, obs), rough)
    name = "shipped" if source.shipped else f"{source.folder.name}, {source.checkpoint.stem.removeprefix('model_')}"
    print(f"\n{name}, {env.sim.engine} on {env.device}\n{rules.table(result)}\n")
    if rough:
        print(f"{crossing.table(figures['crossing'])}\n")
    overrides = {path: now for path, (_, now) in run.changes().items()}
    about = {"policy": "/".join(source.checkpoint.parts[-3:]), "engine": env.sim.engine, "device": env.device, "overrides": overrides}
    return report.Column(name, about, result, figures)


def elsewhere(run: Run) -> list[tuple[str, dict[str, Any]]]:
    """The exam of the same policy on another physics: MuJoCo's C engine, through an export, as ``legged_mw.deploy`` runs it."""
    from legged_mw.deploy.exam import run_exam
    from legged_mw.rl.export import export

    if active(run.task.cfg):
        print("not graded through an export: that is the nominal robot, and domain_rand makes this one another")
        return []
    with TemporaryDirectory() as folder:
        try:
            export(run.task.to_dict(), run.source.checkpoint, Path(folder) / "export")
            return [("the same, deployed in MuJoCo", run_exam(Path(folder) / "export"))]
        except UserError as error:  # a row that nobody can measure, no onnxruntime
            print(f"not graded through an export: {error}")
            return []


def export(run: Run, folder: Path) -> None:
    """Write the policy as it was trained, whatever this call overrode for playing."""
    from legged_mw.rl.export import export  # onnx takes a while to import

    print(export(run.trained, run.source.checkpoint, folder).text(folder))


if __name__ == "__main__":
    torch.set_num_threads(1)
    with one_line_errors("play.py"):
        main()
