"""What an environment or a learner refuses of a task: rows, mirror images, terms, motions, teachers, learners."""

from __future__ import annotations

import copy
from functools import cache
from pathlib import Path
from typing import Any

import test_biped
import test_teacher
import torch
from test_biped import ON
from test_estimator import BLIND
from test_symmetry import _Extra
from test_teacher import CHANGES, SCAN
from test_tracking import make as tracking
from worlds import QUIET, make_env, only_scales

from golden.table import Table
from legged_mw import ROOT
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.mirror import Mirror
from legged_mw.eval.exams import find_exam, require_exam
from legged_mw.eval.rough import make_room
from legged_mw.eval.walking import ExamRules, in_common
from legged_mw.rl.policies import PolicySource, Trained, check_start, find_rival
from legged_mw.rl.ppo import mirror
from legged_mw.rl.ranks import Rank, rank_device
from legged_mw.rl.runner import make_runner
from legged_mw.utils.commands import Command
from legged_mw.utils.task import LoadedTask, Task, load_task
from legged_mw.view.drive import parse_command

BIPED = str(ROOT / test_biped.BIPED)
FIELDS: dict[str, dict[str, Any]] = {
    "no row of a group left": {
        "observations.leave_out": {
            "state": [
                *("base_lin_vel", "base_ang_vel", "projected_gravity", "dof_pos"),
                *("dof_vel", "last_actions", "commands"),
            ]
        }
    },
    "a gait of three feet": {"gait.period": 0.5, "gait.offsets": [0.0, 0.5, 0.5]},
    "a gait of none": {"gait.period": 0.5, "gait.offsets": []},
    "a pull at the root": {"falls.pull": [1.0, 2.0], "falls.pull_on": ""},
    "a range of falls": {"domain_rand.enable": True, "domain_rand.redraw_at_reset": ["base_mass"]},
    "pushes of none": {"asset.penalize_contacts_on": [], **only_scales(collision=-1.0)},
    "pushes on what never touches": {
        "asset.penalize_contacts_on": ["trunk_box"],
        "asset.colliders": ["FR"],
        **only_scales(collision=-1.0),
    },
    "a mirror of joints that are not there": {
        "rewards.mirror_joints": [["FR", "XX"]],
        **only_scales(joint_mirror=-1.0),
    },
    "a mirror of unequal joints": {"rewards.mirror_joints": [["FR", "FL_hip"]], **only_scales(joint_mirror=-1.0)},
    "no mirror": {"rewards.mirror_joints": [], **only_scales(joint_mirror=-1.0)},
    "no highest speed": {"asset.joint_speed_limits": {}, **only_scales(dof_vel_limits=-1.0)},
    "no gait for a term": only_scales(feet_gait=1.0),
    "another value to sense": {"asset.sense": ["forces"]},
    "a flight of four feet": only_scales(no_fly=1.0),
    "a stance of four feet": only_scales(single_stance=1.0),
    "heat without a rating": only_scales(motor_heat=-1.0),
    "a rating of no joint": {"ratings.thermal_time": {"knee": 300.0}},
    "limits of targets that are torques": {**only_scales(target_limits=-1.0), "control.actuator": "torque"},
    "pushes of itself that cannot be": only_scales(self_collision=-1.0),
    "an end by what never touches": {
        "asset.terminate_after_contacts_on": ["trunk_box"],
        "asset.colliders": ["FR", "FL", "RR", "RL"],
    },
    "tiles of half a cell": {"terrain.mesh_type": "heightfield", "terrain.tile_size": 7.77},
    **{
        f"a factor of {factor} on {field}": {
            "domain_rand.enable": True,
            "domain_rand.model_factors": {field: [factor, factor]},
        }
        for field in ("nosuch", "opt")
        for factor in (1.0, 2.0)
    },
}
BIPEDS: dict[str, dict[str, Any]] = {
    "no clock for phases": {"gait.period": 0.0, "rewards.scales.contact_phase": 0.0},
    "no clock for contacts": {"gait.period": 0.0, "rewards.scales.feet_phase": 0.0},
    "no height": {"rewards.base_height_target": 0.0},
    "no hips": {"rewards.hip_joints": []},
    "other hips": {"rewards.hip_joints": ["hipp"]},
    "one offset": {"gait.offsets": [0.0]},
}
ONE_FOOT = {"asset.foot_names": ["left"], "asset.foot_geoms": {"left": ["left_heel"]}}
TRACKING: dict[str, dict[str, Any]] = {
    "no clip": {"motion.clips": []},
    "another clip": {"motion.clips": ["g1_kik.npz"]},
    "another anchor": {"motion.anchor": "torso"},
    "another end": {"motion.end_bodies": ["head"]},
    "a start that a clip does not read": {"init_state.yaw_range": 0.0, "init_state.dof_vel_range": 0.1},
}
LEARNERS: dict[str, dict[str, Any]] = {
    "symmetry.mirror_loss_coeff": {"symmetry.mirror_loss_coeff": 0.0, "symmetry.use_mirror_loss": True},
    "distillation.gradient_length": {"distillation.teacher": "go1_flat", "distillation.gradient_length": 15},
    "commands.keep_probability": {"commands.keep_probability": [0.9, 0.25, 0.5, 0.5]},
    "rewards.tracking_sigma_growth": {"rewards.tracking_sigma_growth": {"stairs": 0.1}},
    "asset.foot_names": {"asset.foot_names": ["F*"]},
}


class Fallen(LeggedRobot):
    sensed = "contact_forces"

    def _fallen(self) -> torch.Tensor:
        return super()._fallen() | (getattr(self, self.sensed).flatten(1).abs().amax(dim=1) > 1e6)


@cache
def env() -> LeggedRobot:
    return make_env(2)


def set_all(task: Any, fields: dict[str, Any]) -> Any:
    for path, value in fields.items():
        task.set(path, value)
    return task


def mirrored(kind: str | None) -> None:
    made = make_env(2, QUIET, env_class=type("_Robot", (_Extra,), {"kind": kind}))
    mirror(made, made.get_observations(), None)


def leaning(**angles: float) -> Mirror:
    pose = load_task("go1_flat").cfg.init_state.default_joint_angles
    return make_env(1, {**QUIET, "init_state.default_joint_angles": {**pose, **angles}}).mirror


def other(change: Any, value: Any, seat: Any) -> None:
    task = load_task("go1_flat")
    change(task) if callable(change) else task.set(change, value)
    seat(env(), Trained(PolicySource(Path("run"), Path("run/model_1.pt"), False), task))


def begins(env: LeggedRobot, policy: Trained) -> None:
    check_start(env, load_task("go1_flat"), policy)


def learner(fields: dict[str, Any], theirs: dict[str, Any] | None = None) -> None:
    task = set_all(load_task("go1_flat"), {"actor.hidden_dims": [4], "critic.hidden_dims": [4], **fields})
    task.set("env.num_envs", 2)
    teacher = None if theirs is None else set_all(copy.deepcopy(load_task("go1_flat")), theirs).train
    made = task.env_class(task.cfg, "cpu")
    make_runner(made, task.train, None, "cpu", teacher)


def more_commands(**ranges: list[float]) -> Any:
    base: Any = load_task("go1_flat")
    for name, ends in ranges.items():
        vars(base.cfg.commands.ranges)[name] = ends
    return base


def one_height(**fields: Any) -> None:
    task = set_all(more_commands(base_height=[0.2, 0.3]), {"env.num_envs": 1, **fields})
    task.env_class(task.cfg, "cpu").mirror  # noqa: B018


def exam(name: str) -> LoadedTask:
    task = load_task("go1_flat")
    return LoadedTask(task.name, task.path, Task(task.env_class, type(task.cfg), type(task.train), name))


def table() -> Table:
    made = Table()
    for name, fields in FIELDS.items():
        made.add(f"go1_flat with {name}", lambda root, fields=fields: make_env(1, fields))
    for name, fields in BIPEDS.items():
        made.add(
            f"toy_biped with {name}", lambda root, fields=fields: make_env(1, {**QUIET, **ON, **fields}, task=BIPED)
        )
    made.add(
        "toy_biped with one foot",
        lambda root: make_env(1, {**QUIET, "rewards.scales.feet_distance": 1.0, **ONE_FOOT}, task=BIPED),
    )
    for name, fields in TRACKING.items():
        made.add(f"g1_track with {name}", lambda root, fields=fields: tracking(worlds=1, **fields))
    for name in ("contact_forces", "self_contacts", "angular_momentum"):
        made.add(
            f"not sensed: {name}",
            lambda root, name=name: make_env(1, QUIET, env_class=type("Fallen", (Fallen,), {"sensed": name})).step(
                torch.zeros(1, 12)
            ),
        )
    for kind in (None, "fot", "privileged_state", "polar"):
        made.add(f"mirror of a row: {kind}", lambda root, kind=kind: mirrored(kind))
    for name, (change, value) in CHANGES.items():
        made.add(
            f"teacher of another {name}",
            lambda root, change=change, value=value: other(change, value, test_teacher.attach_teacher_observations),
        )
    made.add("beginning of another pose", lambda root: other(*CHANGES["pose"], begins))
    made.add("beginning of another history", lambda root: other("observations.history", {"state.dof_pos": 2}, begins))
    for path, fields in LEARNERS.items():
        made.add(
            f"learner with {path}",
            lambda root, fields=fields: (lambda task: (task.cfg.check(), task.train.check(task.cfg.env.num_envs)))(
                set_all(load_task("go1_flat"), fields)
            ),
        )
    made.calls(
        {
            "mirror of a pose: left": lambda: leaning(FL_hip=0.1),
            "mirror of a pose: right": lambda: leaning(FR_hip=0.0),
            "mirror of a scan": lambda: (
                make_env(1, {**QUIET, "terrain.height_scan": ["state"], "terrain.measured_points_y": [0.1, 0.3]}).mirror
            ),
            "mirror of a command": one_height,
            "mirror of an IMU without its gyro": lambda: mirror(
                *(lambda e: (e, e.get_observations(), None))(
                    make_env(2, {**QUIET, "observations.leave_out": {"state": ["base_ang_vel"]}})
                )
            ),
            "mirror of histories": lambda: mirror(
                *(lambda e: (e, e.get_observations(), None))(
                    make_env(2, {**QUIET, "observations.history": {"state.base_lin_vel": 3}})
                )
            ),
            "mirror of a body of one side": lambda: (
                tracking(
                    worlds=1,
                    **{
                        "motion.bodies": ["pelvis", "torso_link", "left_knee_link"],
                        "motion.end_bodies": [],
                        "motion.anchor": "torso_link",
                    },
                ).mirror
            ),
            "a warm-up of rsl-rl's own": lambda: learner({"warm_start.policy": "run", "algorithm.class_name": "PPO"}),
            "an estimator of rsl-rl's own": lambda: learner(
                {"actor.estimator.targets": ["base_lin_vel"], "algorithm.class_name": "PPO"}
            ),
            "a teacher's class": lambda: learner({}, {"actor.class_name": "os:system"}),
            "a teacher's estimate": lambda: learner(
                {"distillation.teacher": "x"}, {"actor.estimator.targets": ["foot_height"]}
            ),
            "a bound without a record": lambda: learner(
                {"algorithm.max_learning_rate": 0.02, "algorithm.optimizer": "sgd"}
            ),
            "an estimate of what the actor reads": lambda: learner({**BLIND, "obs_groups.actor": ["privileged_state"]}),
            "a memory and an optimizer that is not recorded": lambda: learner(
                {"actor.class_name": "RNNModel", "algorithm.optimizer": "sgd", "algorithm.num_mini_batches": 1}
            ),
            "a memory and a loss of mirrors": lambda: learner(
                {
                    "actor.class_name": "RNNModel",
                    "symmetry.use_data_augmentation": False,
                    "symmetry.use_mirror_loss": True,
                    "symmetry.mirror_loss_coeff": 0.5,
                    "algorithm.num_mini_batches": 1,
                }
            ),
            "another exam": lambda: find_exam(exam("tracing")),
            "an exam of no commands": lambda: ExamRules.from_config(object()),
            "a range in common": lambda: in_common(""),
            "a rank's device": lambda: rank_device(Rank(1, 1, 2), "cuda:0"),
            "a rank without a GPU": lambda: rank_device(Rank(1, 1, 2), None),
            "a config that is no walker's": lambda: LeggedRobot(load_task("go1_handstand").cfg, "cpu"),  # type: ignore[arg-type]
            "no exam": lambda: require_exam(exam("")),
            "a command's range backwards": lambda: more_commands(height=[0.3, 0.2]).cfg.check(),
            "another robot's teacher": lambda: test_teacher.seated(env(), load_task("g1_flat")),
            "a teacher of another rate and scale": lambda: test_teacher.seated(
                env(), set_all(load_task("go1_flat"), {"control.action_scale": 0.3, "sim.dt": 0.005})
            ),
            "a teacher's scan of other points": lambda: test_teacher.seated(
                make_env(2, {**SCAN, "terrain.height_scan": ["privileged_state"]}),
                set_all(load_task("go1_flat"), {**SCAN, "terrain.measured_points_x": [0.0, 0.2]}),
            ),
        }
    )
    for name, (task, fields) in {
        "a pull on another body": ("go1_getup", {"falls.pull_on": "nose"}),
        "a pull at the root": ("go1_getup", {"falls.pull": 0.5, "falls.pull_on": "", "perturbation.kick": True}),
        "a share above 1": ("go1_getup", {"falls.share": 1.5}),
        "no states": ("go1_getup", {"falls.states": 0}),
        "a pull down": ("go1_getup", {"falls.pull": -1.0}),
        "a nose to no side": ("go1_handstand", {"exam.nose": 0.0}),
        "no hands": ("go1_handstand", {"exam.hands": []}),
        "hands that are not there": ("go1_handstand", {"exam.hands": ["nose"]}),
        "a command outside": ("go1_flat", {"commands.default": {"lin_vel_x": 9.0}}),
    }.items():
        made.add(f"{task} with {name}", lambda root, task=task, fields=fields: make_env(1, fields, task=task))
    made.add(
        "rooms of no ground",
        lambda root: make_room(set_all(load_task("go1_rough"), {"terrain.terrain_proportions": {"flat": 0.0}})),
    )
    made.add(
        "a rival of another task",
        lambda root: find_rival(load_task("go1_flat"), str(ROOT / "resources/policies/go2_flat")),
    )
    made.add("speeds of none", lambda root: ExamRules.from_mapping({"push_speeds": [], "ranges": {}}))
    made.add(
        "a command outside of its range", lambda root: parse_command("9", [Command("lin_vel_x", -1.0, 1.0, "m/s")])
    )
    return made
