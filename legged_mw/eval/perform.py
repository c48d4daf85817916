"""Skill exams in the training environment, for ``--eval`` and during training."""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from legged_mw.envs.domain_rand import KINDS
from legged_mw.envs.robot_task import RobotTask
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.eval import rollout
from legged_mw.eval.report import Column, skill_page
from legged_mw.eval.rollout import Policy
from legged_mw.eval.skills import ExamGround, ExamRobot, Floats, Recording, ReferenceMotion, Skill, Starts, make_skill
from legged_mw.rl.students.recurrent import forget
from legged_mw.sim.simulation import say_overflow
from legged_mw.skills.motion_tracking import MotionTracking
from legged_mw.skills.motion_tracking_config import MotionTrackingCfg
from legged_mw.utils.errors import UserError
from legged_mw.utils.task import LoadedTask

NOMINAL: dict[str, Any] = {
    **{f"domain_rand.{name}": [] for name in KINDS},
    "domain_rand.delay_ms": [],
    "domain_rand.model_factors": {},
}


def skill_of(cfg: RobotTaskCfg, kind: str) -> Skill:
    """The exam ``kind`` with the values of the task's config section ``exam``."""
    return make_skill(kind, cfg.to_dict().get("exam", {}))


def overrides(task: LoadedTask) -> dict[str, Any]:
    """The exam's changes to the config. Fields that the task lacks are left out."""
    # the task keeps its termination rules; one that tracks a motion keeps its init_state too
    kept = ("termination.", "init_state.") if isinstance(task.cfg, MotionTrackingCfg) else ("termination.",)
    common = {path: value for path, value in rollout.OVERRIDES.items() if not path.startswith(kept)}
    changes, config = {**common, **skill_of(task.cfg, task.exam).overrides}, task.to_dict()
    return {path: value for path, value in changes.items() if path.split(".")[1] in config.get(path.split(".")[0], {})}


def prepare(task: LoadedTask) -> None:
    """Change the config of ``task`` to that of the first part of its exam."""
    for path, value in overrides(task).items():
        task.set(path, value, where="exam")
    make_room(task)


def make_room(task: LoadedTask) -> None:
    """Set one world per robot."""
    task.cfg.env.num_envs = skill_of(task.cfg, task.exam).robots


def ask_alike(tasks: Sequence[LoadedTask]) -> None:
    """Give all prepared tasks the config section ``exam`` of the first."""
    for task in tasks[1:]:
        task.update({"exam": tasks[0].to_dict()["exam"]} if "exam" in tasks[0].to_dict() else {}, where="--compare")


def examine(kind: str, env: RobotTask, policy: Policy) -> tuple[dict[str, Any], dict[str, Any]]:
    """The result and the pictures of the exam.

    ``env`` is of a prepared task and has the first ground. For each other ground another environment is built.
    """
    skill, parts, strips = skill_of(env.cfg, kind), {}, {}
    for number, (name, ground) in enumerate(skill.grounds.items()):
        part_env = env if number == 0 else on_ground(env, ground)
        recording = perform(part_env, policy, skill, ground)
        parts[name] = skill.judge(machine(part_env), recording)
        if "worst" in parts[name]:
            strips[name] = recording.qpos[:, parts[name]["worst"]]
    return skill.result(parts), {"strips": _draw(env, strips)}


def _draw(env: RobotTask, strips: Mapping[str, np.ndarray]) -> dict[str, bytes]:
    """One picture strip per robot; none if the machine cannot draw."""
    try:
        return {name: strip(env, qpos) for name, qpos in strips.items()}
    except UserError as error:
        print(f"no strips of pictures: {error}")
        return {}


def on_ground(env: RobotTask, ground: ExamGround) -> RobotTask:
    """Another environment of the same task, on ``ground``."""
    changes = {"terrain.slope": ground.slope} if ground.slope else {}
    changes |= {"terrain.friction": ground.friction} if ground.friction is not None else {}
    changes |= (
        {**NOMINAL, "domain_rand.enable": True, "domain_rand.base_mass": [ground.load, ground.load]}
        if ground.load
        else {}
    )
    cfg = copy.deepcopy(env.cfg)
    for path, value in changes.items():
        cfg.set(path, value, where="exam")
    return type(env)(cfg, env.device, eager=env.eager)


def machine(env: RobotTask) -> ExamRobot:
    """The robot's model, home state and time step for the exam."""
    home = np.array([*env.start_place, 1.0, 0.0, 0.0, 0.0, *env.robot.pose])
    return ExamRobot(env.robot.physics, home, env.dt, motion_of(env) if isinstance(env, MotionTracking) else None)


def motion_of(env: MotionTracking) -> ReferenceMotion:
    """The first clip of the task."""
    return ReferenceMotion(env.clips[0].qpos(), tuple(env.cfg.motion.bodies), env.cfg.motion.anchor)


def perform(
    env: RobotTask,
    policy: Policy,
    skill: Skill,
    ground: ExamGround = ExamGround(),  # noqa: B008
    starts: Starts | None = None,
) -> Recording:
    """Set each robot to its start state and run ``policy``. ``starts``: precomputed start states."""
    env.reset()
    if starts := starts or skill.starts(machine(env), env.num_envs):
        for state, values in zip((env.sim.qpos, env.sim.qvel), starts, strict=True):
            state.copy_(torch.as_tensor(values, dtype=torch.float))
        env._refresh_base()
    obs = env.first_observations()
    forget(policy)
    steps, n = skill.steps(machine(env)), env.num_envs
    states = {"qpos": env.sim.qpos, "qvel": env.sim.qvel, "torque": env.torques}
    record = {name: torch.empty(steps, *state.shape, device=env.device) for name, state in states.items()}
    ended_at = torch.full((n,), float("inf"), device=env.device)
    for step in range(steps):
        for name, state in states.items():
            record[name][step] = state
        with torch.inference_mode():
            actions = policy(obs)
        if (jumps := ground.pushes(step, n, env.dt)) is not None:
            env.root_lin_vel[:, :2] += torch.as_tensor(jumps, dtype=torch.float, device=env.device)
        obs, _, dones, _ = env.step(actions)
        forget(policy, dones)
        ended_at = torch.where(dones & ended_at.isinf(), torch.full_like(ended_at, step), ended_at)
    say_overflow(env.sim, "this exam")
    arrays = {name: values.cpu().numpy().astype(float) for name, values in record.items()}
    return Recording(**arrays, ended_at=ended_at.cpu().numpy())


class InTraining:
    """The first part of the exam during training. ``rollout.TrainingExam`` is its counterpart for the walking exam."""

    def __init__(self, task: LoadedTask, device: str, eager: bool = False) -> None:
        copied = rollout.copy_of(task)
        prepare(copied)
        self.skill = skill_of(copied.cfg, copied.exam)
        with rollout.keep_random_state(device):
            self.env = copied.env_class(copied.cfg, device, eager=eager)
        self._starts = self.skill.starts(machine(self.env), self.env.num_envs)
        self.advice: list[str] = []  # always empty

    def __call__(self, policy: Policy) -> dict[str, float]:
        """The figures of ``first_part``."""
        with rollout.keep_random_state(self.env.device):
            return first_part(self.env, policy, self.skill, self._starts)


def first_part(env: RobotTask, policy: Policy, skill: Skill, starts: Starts | None = None) -> dict[str, float]:
    """The figures, by name, of the exam's part in ``env``. Figures without a value are left out."""
    figures = skill.judge(machine(env), perform(env, policy, skill, starts=starts))
    return {measure.key: float(value) for measure in skill.measures if (value := figures[measure.key]) is not None}


def table(result: Mapping[str, Any]) -> str:
    """The result as text."""
    return of_result(result).table(result)


def of_result(result: Mapping[str, Any]) -> Skill:
    """The exam of a result."""
    return make_skill(
        result["asked"]["kind"], {name: value for name, value in result["asked"].items() if name != "kind"}
    )


def write(folder: Path, task: str, columns: Sequence[Column]) -> None:
    """Write ``report.json`` and ``report.html``; see ``report.write``."""
    folder.mkdir(parents=True, exist_ok=True)
    content = {"task": task, "columns": [{**column.plain(), "figures": None} for column in columns]}
    (folder / "report.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    strips = (columns[0].figures or {}).get("strips", {})
    for name, picture in strips.items():
        (folder / f"{name}.png").write_bytes(picture)
    page = skill_page(task, of_result(columns[0].exam), columns, strips)
    (folder / "report.html").write_text(page, encoding="utf-8")


# ---- picture strip of one robot over time


PICTURES, COLUMNS, WIDTH, HEIGHT = 12, 6, 320, 240  # pictures, pictures per row, [px] of each


def strip(env: RobotTask, qpos: Floats) -> bytes:
    """A PNG of the robot at PICTURES times, evenly spaced over ``qpos`` (T, nq). Raises ViewError if drawing fails."""
    from legged_mw.drawing.scene import visual_spec
    from legged_mw.view.recorder import RobotRenderer, contact_sheet, save_png  # imports OpenGL
    from legged_mw.view.stage import Moment

    renderer, none = RobotRenderer(visual_spec(env.robot, env.cfg.viewer.camera), WIDTH, HEIGHT), np.zeros((1, 3))
    frames = []
    for step in np.linspace(0, len(qpos) - 1, PICTURES).round().astype(int):
        lines = ((f"{step * env.dt:.1f} s", ""),)
        pose = np.concatenate([qpos[0, :2], qpos[step, 2:]])  # keep x and y at the start, in view of the camera
        moment = Moment(
            step * env.dt, pose[None], none[:, :0], np.nan * none, none, np.zeros((1, 0), dtype=bool), lines=lines
        )
        frames.append(renderer.frame(moment))
    renderer.close()
    with TemporaryDirectory() as folder:
        save_png(path := Path(folder) / "strip.png", contact_sheet(frames, COLUMNS))
        return path.read_bytes()
