"""Config values that fit their fields, but not each other, and methods of a user's class that do not fit ours.

What a field alone may hold stands in its annotation.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from legged_mw.envs.domain_rand import KINDS, ONLY_AT_START, active
from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.envs.motors import check_motors
from legged_mw.envs.own_code import own_classes, place_of
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.skills.motion_tracking_config import MotionTrackingCfg
from legged_mw.utils.bounds import Range
from legged_mw.utils.commands import HEADING
from legged_mw.utils.config import ConfigError, fit
from legged_mw.utils.errors import StepError, unknown
from legged_mw.utils.renamed import LEGGED_GYM_METHODS

HOOKS = (  # every step or reset needs what their parents do; hooks of commands may be replaced
    *("_init_buffers", "_episode_columns", "_update_state", "_end_step", "compute_observations"),
    *("reset_envs", "_reset_robots", "_reset_task", "_update_curricula"),
)
WITHOUT = "# without super"  # a comment in the method: it is so on purpose
# terms of RobotTask and LeggedRobot with a usual scale above 0, as all of a skill's own have; others cost
PAYS = (
    *("alive", "pose", "tracking_lin_vel", "tracking_ang_vel", "feet_air_time", "feet_contact_without_cmd"),
    *("single_stance", "no_fly", "feet_phase", "contact_phase"),
)


def check_values(cfg: RobotTaskCfg, train: Any = None, law: str = "") -> None:
    """Raise ConfigError at the first value that cannot work; ``law`` of the motors is ``control.actuator``, unless said otherwise."""
    _check_redraws(cfg, law)
    check_motors(cfg)
    step = cfg.sim.dt * cfg.control.decimation
    if cfg.env.episode_length_s < step:
        raise ConfigError(
            f"env.episode_length_s is {cfg.env.episode_length_s:g}, shorter than a control step of {step:g} s"
        )
    if isinstance(cfg, LeggedRobotCfg):
        _check_walking(cfg)
    if isinstance(cfg, MotionTrackingCfg):
        _check_tracking(cfg)
    if train is not None:
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
    feet = cfg.asset.foot_names
    if not feet or "*" in "".join(feet) or len({*feet}) < len(feet):
        wanted = "a list of at least one name, one for each foot and each once (patterns are for foot_geoms)"
        raise ConfigError(f"asset.foot_names is {feet!r}; it must be {wanted}")
    for name, span in vars(cfg.commands.ranges).items():  # a task may have declared its own
        fit(span, Range, f"commands.ranges.{name}")
    names = [name for name in vars(cfg.commands.ranges) if name != HEADING]
    if len(keep := cfg.commands.keep_probability) > len(names):
        raise ConfigError(
            f"commands.keep_probability has {len(keep)} numbers, but there are {len(names)} commands: {', '.join(names)}"
        )
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
    motion = cfg.motion
    for field, names in (("anchor", [motion.anchor]), ("end_bodies", motion.end_bodies)):
        for name in names:
            if name not in motion.bodies:
                raise ConfigError(f"motion.{field}: {unknown('body', name, motion.bodies, 'motion.bodies')}")
    if not motion.clips:
        raise ConfigError(
            "motion.clips is empty; name a clip, as python -m legged_mw.motion FILE --out CLIP.npz writes it"
        )


def _check_redraws(cfg: RobotTaskCfg, law: str) -> None:
    for name in cfg.domain_rand.redraw_at_reset:
        if name in ONLY_AT_START:
            raise ConfigError(
                f"domain_rand.redraw_at_reset has '{name}', which constants of the model depend on: it can be drawn at the start, "
                "and every domain_rand.redraw_iterations"
            )
        if name not in KINDS:
            raise ConfigError(f"domain_rand.redraw_at_reset: {unknown('range', name, KINDS, 'domain_rand')}")
    for name in cfg.domain_rand.model_factors:
        writers = [kind for kind, (what, *_) in active(cfg, law).items() if kind != name and name in what.fields]
        if writers:
            raise ConfigError(
                f"domain_rand.model_factors.{name}: domain_rand.{writers[0]} writes that field; leave one of them out ([])"
            )


# ---- methods of a user's class ----


def check_class(env_class: type, scales: Mapping[str, float]) -> list[str]:
    """Warnings on methods that nothing calls, and on ``scales`` of our terms. Raises StepError at a hook that never calls its parent's."""
    for kind, name, method in _own(env_class):
        source = _source(method)
        if name not in HOOKS or re.search(rf"\.{name}\b", source) or WITHOUT in source or not source:
            continue
        if _does_something(env_class.__mro__[env_class.__mro__.index(kind) + 1 :], name):
            arguments = ", ".join([*inspect.signature(method).parameters][1:])
            call = f"super().{name}({arguments})"
            what = f"never calls {call}, which every robot needs: call it first; if it is so on purpose, say {WITHOUT} in a comment there"
            raise StepError(what, place_of(method))
    lines = []
    for kind, name, method in _own(env_class):
        misspelt = re.fullmatch(r"_?rewards?_\w+", name) and not name.startswith("_reward_")
        if (
            hasattr(kind.__mro__[1], name)
            or not (misspelt or name in LEGGED_GYM_METHODS)
            or _is_called(env_class, name)
        ):
            continue
        instead = "a reward's name begins with _reward_" if misspelt else f"{LEGGED_GYM_METHODS[name]} is what there is"
        lines.append(f"warning: {place_of(method)}: nothing calls {name}; {instead}")
    return [*lines, *_unusual_signs(env_class, scales)]


def _unusual_signs(env_class: type, scales: Mapping[str, float]) -> Iterator[str]:
    """Of terms that are ours."""
    for name, scale in scales.items():
        method = getattr(env_class, f"_reward_{name}", None)
        if method is None or not method.__module__.startswith("legged_mw."):
            continue
        pays = name in PAYS or method.__qualname__.partition(".")[0] not in ("RobotTask", "LeggedRobot")
        if scale and pays != (scale > 0.0):
            usual = "above 0: it is what the robot should do" if pays else "below 0: it is what the robot should avoid"
            yield f"warning: rewards.scales.{name} is {scale:g}; its usual sign is {usual} (docs/tasks.md)"


def _own(env_class: type) -> Iterator[tuple[type, str, Callable[..., Any]]]:
    """(class, name, method) of all methods that the user's classes write."""
    for kind in own_classes(env_class):
        yield from ((kind, name, value) for name, value in vars(kind).items() if inspect.isfunction(value))


def _does_something(parents: tuple[type, ...], name: str) -> bool:
    """Whether what the parents have under ``name`` is more than a docstring."""
    method = next((vars(kind)[name] for kind in parents if name in vars(kind)), None)
    return method is not None and bool(re.search(r"self\.|return", _source(method)))


def _is_called(env_class: type, name: str) -> bool:
    """Whether another method of the user's names it."""
    return any(re.search(rf"\.{name}\b", _source(method)) for _, other, method in _own(env_class) if other != name)


def _source(method: Any) -> str:
    """What is written there; '' of what was typed at a prompt."""
    try:
        return inspect.getsource(inspect.unwrap(method))
    except (OSError, TypeError):
        return ""
