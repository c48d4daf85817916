"""Config values that no type can refuse: each rule names the field, the value and what it must be."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from legged_mw.envs.domain_rand import KINDS, ONLY_AT_START, active
from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.envs.motion_tracking_config import MotionTrackingCfg
from legged_mw.envs.robot_task_config import RobotTaskCfg, RobotTaskCfgPPO
from legged_mw.utils.commands import HEADING
from legged_mw.utils.config import Config, ConfigError
from legged_mw.utils.errors import unknown

Rule = tuple[str, Callable[[Any], bool]]

POSITIVE: Rule = ("positive", lambda v: 0 < v < math.inf)
NOT_NEGATIVE: Rule = ("zero or more", lambda v: 0 <= v < math.inf)
PART: Rule = ("above 0 and at most 1", lambda v: 0 < v <= 1)
RANGE: Rule = ("two numbers, the lower first", lambda v: len(v) == 2 and v[0] <= v[1])
SPAN: Rule = ("two numbers above zero, the lower first", lambda v: len(v) == 2 and 0 < v[0] <= v[1])
STEPS: Rule = ("two whole numbers from zero, the lower first", lambda v: len(v) == 2 and 0 <= v[0] <= v[1])
TIMES: Rule = ("two numbers from zero, the lower first", lambda v: len(v) == 2 and 0 <= v[0] <= v[1] < math.inf)
NAMES: Rule = ("a list with at least one name", lambda v: len(v) > 0)
POINTS: Rule = ("at least one number, all finite", lambda v: len(v) > 0 and all(map(math.isfinite, v)))
NUMBERS: Rule = ("a table of numbers from 0", lambda v: all(0 <= number < math.inf for number in v.values()))
LIMITS: Rule = ("a table of numbers above 0", lambda v: all(0 < number < math.inf for number in v.values()))
PROBABILITIES: Rule = (
    "three numbers from 0 to 1, and more for further commands",
    lambda v: len(v) >= 3 and all(0 <= p <= 1 for p in v),
)


def or_empty(rule: Rule) -> Rule:
    """The same rule, or an empty list."""
    return f"{rule[0]}, or an empty list", lambda v: not v or rule[1](v)


ENVIRONMENT: dict[str, Rule] = {
    **dict.fromkeys(("env.num_envs", "env.episode_length_s", "control.decimation", "normalization.clip_actions"), POSITIVE),
    **dict.fromkeys(("sim.dt", "sim.iterations", "sim.ls_iterations"), POSITIVE),
    **dict.fromkeys(("rewards.max_reward", "termination.max_speed"), POSITIVE),
    **dict.fromkeys(("rewards.soft_torque_limit", "rewards.soft_dof_vel_limit"), POSITIVE),
    "rewards.deviation_weights": NUMBERS,
    "rewards.mirror_joints": ("pairs: lists of two names or patterns each", lambda v: all(len(pair) == 2 for pair in v)),
    **dict.fromkeys(("viewer.width", "viewer.height", "viewer.fps"), POSITIVE),
    **dict.fromkeys(("terrain.friction", "noise.level", "termination.min_base_height"), NOT_NEGATIVE),
    **dict.fromkeys(("sim.threads", "sim.nconmax", "sim.njmax"), NOT_NEGATIVE),
    **dict.fromkeys(("perturbation.interval", "perturbation.duration"), SPAN),
    "perturbation.velocity": RANGE,
    "perturbation.curriculum_rate": PART,
    **dict.fromkeys(("init_state.dof_pos_range", "init_state.dof_pos_offset"), RANGE),
    **dict.fromkeys(("init_state.dof_vel_range", "rewards.base_height_target"), NOT_NEGATIVE),
    "perturbation.push_interval_s": POSITIVE,
    "perturbation.max_push_vel_xy": NOT_NEGATIVE,
    **{f"domain_rand.{name}": or_empty(STEPS if kind.whole else RANGE if kind.neutral == 0.0 else SPAN) for name, kind in KINDS.items()},
    "domain_rand.redraw_iterations": NOT_NEGATIVE,
    "domain_rand.delay_ms": or_empty(TIMES),
    **dict.fromkeys(("control.stall_torque", "control.no_load_speed", "control.gear"), LIMITS),
    "asset.colliders": NAMES,
    "init_state.pos": or_empty(("three numbers, x, y, z", lambda v: len(v) == 3)),
    **dict.fromkeys(("asset.armature", "asset.frictionloss"), NUMBERS),
    **dict.fromkeys(("asset.effort", "asset.joint_speed_limits"), LIMITS),
    "viewer.camera": or_empty(("three numbers, not straight above or below", lambda v: len(v) == 3 and (v[0] != 0 or v[1] != 0))),
    "termination.max_tilt": ("above 0 and at most 180 degrees", lambda v: 0 < v <= 180),
    "terrain.slope": ("from -60 to 60 degrees", lambda v: -60 <= v <= 60),
    "terrain.condim": ("1, 3, 4 or 6", lambda v: v in (1, 3, 4, 6)),
}
SOMETIMES: dict[str, Rule] = {  # of sections that only some tasks have
    "falls.share": ("from 0 to 1", lambda v: 0 <= v <= 1),
    **dict.fromkeys(("falls.states", "falls.seconds", "exam.within", "exam.height"), POSITIVE),
    "falls.pull": ("from 0 to 1, a share of the weight", lambda v: 0 <= v <= 1),
    "falls.pull_fades": PART,
    "exam.nose": ("-1, down, or 1, up", lambda v: v in (-1, 1)),
    "exam.hands": NAMES,
}
WALKING: dict[str, Rule] = {
    "asset.foot_names": (
        "a list with at least one name, one for each foot (patterns are for foot_geoms)",
        lambda v: len(v) > 0 and "*" not in "".join(v),
    ),
    "commands.resampling_time": NOT_NEGATIVE,
    "commands.keep_probability": PROBABILITIES,
    "commands.mirror": ("1 or -1 for each command", lambda v: all(sign in (1, -1) for sign in v.values())),
    **dict.fromkeys(("rewards.tracking_sigma", "rewards.swing_height", "commands.heading_gain"), POSITIVE),
    **dict.fromkeys(("gait.period", "rewards.min_feet_distance", "rewards.tracking_sigma_end"), NOT_NEGATIVE),
    "rewards.max_contact_force": NOT_NEGATIVE,
    "rewards.max_single_stance": POSITIVE,
    "gait.stance": ("above 0 and below 1", lambda v: 0 < v < 1),
    "gait.offsets": ("shares of the period, from 0 to 1", lambda v: all(0 <= share <= 1 for share in v)),
    **dict.fromkeys(("terrain.num_rows", "terrain.num_cols", "terrain.tile_size"), POSITIVE),
    **dict.fromkeys(("terrain.max_init_terrain_level", "terrain.seed"), NOT_NEGATIVE),
    "terrain.horizontal_scale": ("above 0 and at most 0.25 m, or a cell would be wider than a step of stairs", lambda v: 0 < v <= 0.25),
    "terrain.border_size": ("1 m at least, for a robot that leaves the tiles to turn back", lambda v: 1 <= v < math.inf),
    "terrain.terrain_proportions": ("kinds with shares from 0", lambda v: all(0 <= share < math.inf for share in v.values())),
    "terrain.difficulty": ("two numbers from 0 to 1, the lower first", lambda v: len(v) == 2 and 0 <= v[0] <= v[1] <= 1),
    "terrain.height_scan": ("a list of groups: state, privileged_state", lambda v: {*v} <= {"state", "privileged_state"}),
    **dict.fromkeys(("terrain.measured_points_x", "terrain.measured_points_y"), POINTS),
    **dict.fromkeys(("commands.curriculum_start", "commands.curriculum_step"), PART),
}
TRACKING: dict[str, Rule] = {
    **dict.fromkeys(("motion.bin_s",), POSITIVE),
    **dict.fromkeys((f"motion.{name}" for name in ("hold_s", "start_joints")), NOT_NEGATIVE),
    **dict.fromkeys(("motion.failure_rate", "motion.uniform"), PART),
    **dict.fromkeys(
        (f"motion.start_{name}" for name in ("pos", "turn", "lin_vel", "ang_vel")),
        ("three numbers from 0", lambda v: len(v) == 3 and all(0 <= number < math.inf for number in v)),
    ),
    **dict.fromkeys((f"termination.max_{name}" for name in ("anchor_height", "anchor_tilt", "end_height")), POSITIVE),
    **dict.fromkeys((f"rewards.{part}_sigma" for part in ("anchor_pos", "anchor_ori", "body_pos", "body_ori")), POSITIVE),
    **dict.fromkeys(("rewards.body_lin_vel_sigma", "rewards.body_ang_vel_sigma"), POSITIVE),
}
LEARNER: dict[str, Rule] = {
    **dict.fromkeys(("runner.num_steps_per_env", "runner.max_iterations", "runner.save_interval"), POSITIVE),
    **dict.fromkeys(("algorithm.learning_rate", "algorithm.num_learning_epochs", "algorithm.num_mini_batches"), POSITIVE),
    **dict.fromkeys((f"{network}.rnn_{size}" for network in ("actor", "critic") for size in ("hidden_dim", "num_layers")), POSITIVE),
    **dict.fromkeys(("cpu.envs_per_core", "cpu.num_steps_per_env", "cpu.max_iterations", "cpu.rnn_hidden_dim"), POSITIVE),
    **dict.fromkeys(("cpu.num_learning_epochs", "cpu.num_mini_batches", "cpu.desired_kl"), POSITIVE),
    **dict.fromkeys(("symmetry.mirror_loss_coeff", "anneal.entropy_coef", "anneal.desired_kl", "cpu.update_threads"), NOT_NEGATIVE),
    **dict.fromkeys(("actor.estimator.learning_rate", "actor.concurrent.learning_rate", "actor.concurrent.latent_dim"), POSITIVE),
    **dict.fromkeys(
        ("actor.estimator.hidden_dims", "actor.concurrent.hidden_dims"),
        ("whole numbers from 1, at least one", lambda v: len(v) > 0 and min(v) >= 1),
    ),
    "actor.concurrent.teacher_share": ("above 0 and at most 1", lambda v: 0 < v <= 1),
    **dict.fromkeys(("distillation.learning_rate", "distillation.num_learning_epochs", "distillation.gradient_length"), POSITIVE),
    **dict.fromkeys(("distillation.init_std", "warm_start.init_std"), POSITIVE),
    **dict.fromkeys((f"runner.{name}" for name in ("exam_interval", "keep_checkpoints")), NOT_NEGATIVE),
    **dict.fromkeys(("distillation.max_grad_norm", "warm_start.critic_warmup"), NOT_NEGATIVE),
    "runner.run_name": ("part of a folder's name, without / or \\", lambda v: "/" not in v and "\\" not in v),
}


def check_values(cfg: RobotTaskCfg, train: RobotTaskCfgPPO | None = None, law: str = "") -> None:
    """Raise ConfigError at the first value that cannot work; ``law`` of the motors is ``control.actuator``, unless said otherwise."""
    _check(cfg, ENVIRONMENT)
    sections = cfg.to_dict()
    _check(cfg, {path: rule for path, rule in SOMETIMES.items() if path.split(".")[1] in sections.get(path.split(".")[0], {})})
    _check_redraws(cfg, law)
    _check_motors(cfg)
    if isinstance(cfg, LeggedRobotCfg):
        _check_walking(cfg)
    if isinstance(cfg, MotionTrackingCfg):
        _check_tracking(cfg)
    if train is not None:
        _check(train, LEARNER)
        samples = cfg.env.num_envs * train.runner.num_steps_per_env
        if samples < train.algorithm.num_mini_batches:
            raise ConfigError(
                f"an iteration has {samples} samples ({cfg.env.num_envs} worlds x {train.runner.num_steps_per_env} steps), fewer than "
                f"algorithm.num_mini_batches = {train.algorithm.num_mini_batches}; raise one of the former or lower the latter"
            )
        steps, length = train.runner.num_steps_per_env, train.distillation.gradient_length
        if train.distillation.teacher and steps % length:
            divisors = ", ".join(str(i) for i in range(1, steps + 1) if steps % i == 0)
            raise ConfigError(
                f"distillation.gradient_length is {length}, which leaves {steps % length} of runner.num_steps_per_env = {steps} steps "
                f"unused; take one of {divisors}"
            )
        if train.symmetry.use_mirror_loss and not train.symmetry.mirror_loss_coeff:
            raise ConfigError(
                "symmetry.use_mirror_loss is on, but symmetry.mirror_loss_coeff is 0: set the loss's weight, or switch it off"
            )


def _check_walking(cfg: LeggedRobotCfg) -> None:
    _check(cfg, {**WALKING, **dict.fromkeys((f"commands.ranges.{name}" for name in vars(cfg.commands.ranges)), RANGE)})
    names = [name for name in vars(cfg.commands.ranges) if name != HEADING]
    if len(keep := cfg.commands.keep_probability) > len(names):
        raise ConfigError(f"commands.keep_probability has {len(keep)} numbers, but there are {len(names)} commands: {', '.join(names)}")
    for foot in cfg.asset.foot_geoms:
        if foot not in cfg.asset.foot_names:
            raise ConfigError(f"asset.foot_geoms: {unknown('foot', foot, cfg.asset.foot_names, 'asset.foot_names')}")
        if not cfg.asset.foot_geoms[foot]:
            raise ConfigError(f"asset.foot_geoms: foot '{foot}' has no geom; name the geoms that touch the ground")
    if cfg.commands.curriculum and not cfg.to_dict()["rewards"]["scales"].get("tracking_lin_vel", 0.0) > 0:
        raise ConfigError(
            "commands.curriculum goes by how well tracking_lin_vel is met: give rewards.scales.tracking_lin_vel a number above 0"
        )


def _check_tracking(cfg: MotionTrackingCfg) -> None:
    _check(cfg, TRACKING)
    motion = cfg.motion
    for field, names in (("anchor", [motion.anchor]), ("end_bodies", motion.end_bodies)):
        for name in names:
            if name not in motion.bodies:
                raise ConfigError(f"motion.{field}: {unknown('body', name, motion.bodies, 'motion.bodies')}")
    if not motion.clips:
        raise ConfigError("motion.clips is empty; name a clip, as python -m legged_mw.motion FILE --out CLIP.npz writes it")


def _check_motors(cfg: RobotTaskCfg) -> None:
    control, curve = cfg.control, cfg.control.stall_torque or cfg.control.no_load_speed
    if control.actuator == "network" and not control.network:
        raise ConfigError("control.actuator is 'network', but control.network names no file of weights (docs/motors.md)")
    if control.actuator != "dc_motor" and control.action_origin == "speed":
        raise ConfigError(
            f"control.action_origin is 'speed', but control.actuator is {control.actuator!r}: only a 'dc_motor' is driven by a "
            "speed: name that one, or leave action_origin out"
        )
    if control.actuator == "torque" and control.action_origin != "default":
        raise ConfigError(
            f"control.action_origin is {control.action_origin!r}, an origin of angles, but under control.actuator 'torque' an action is a "
            "torque: leave action_origin out"
        )
    for name, unit in (("stall_torque", "N m"), ("no_load_speed", "rad/s")):
        if not getattr(control, name) and (control.actuator == "dc_motor" or (control.actuator != "servo" and curve)):
            raise ConfigError(
                f"control.actuator is {control.actuator!r} with a torque-speed curve, but control.{name} is empty: fill the table [{unit}] "
                "a joint, '' for all (docs/motors.md)"
            )
        if cfg.domain_rand.enable and getattr(cfg.domain_rand, name) not in ([], [1.0, 1.0]) and not curve:
            raise ConfigError(f"domain_rand.{name} is a factor on control.{name}, which is empty: fill it, or leave the range out ([])")


def _check_redraws(cfg: RobotTaskCfg, law: str) -> None:
    for name in cfg.domain_rand.redraw_at_reset:
        if name in ONLY_AT_START:
            raise ConfigError(
                f"domain_rand.redraw_at_reset has '{name}', which constants of the model depend on: it can be drawn at the start, "
                "and every domain_rand.redraw_iterations"
            )
        if name not in KINDS:
            raise ConfigError(f"domain_rand.redraw_at_reset: {unknown('range', name, KINDS, 'domain_rand')}")
    for name, span in cfg.domain_rand.model_factors.items():
        wanted, holds = or_empty(SPAN)
        if not holds(span):
            raise ConfigError(f"domain_rand.model_factors.{name} is {span!r}; it must be {wanted}")
        writers = [kind for kind, (what, *_) in active(cfg, law).items() if kind != name and name in what.fields]
        if writers:
            raise ConfigError(f"domain_rand.model_factors.{name}: domain_rand.{writers[0]} writes that field; leave one of them out ([])")


def _check(cfg: Config, rules: dict[str, Rule]) -> None:
    for path, (wanted, holds) in rules.items():
        value: Any = cfg
        for name in path.split("."):
            value = getattr(value, name)
        if not holds(value):
            raise ConfigError(f"{path} is {value!r}; it must be {wanted}")
