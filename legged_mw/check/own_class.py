"""Check a user's class: hooks that never call their parent's, methods of legged_gym that nothing calls here.

It also checks the signs of the scales of our reward terms.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from legged_mw.utils.errors import StepError, place_of

HOOKS = (  # the parents' methods are needed in every step, reset or iteration; hooks of commands may be replaced
    *("_init_buffers", "_episode_columns", "_update_state", "_refresh_base", "_end_step", "compute_observations"),
    *("reset_envs", "_reset_robots", "_reset_task", "_update_curricula"),
    *("on_training_progress", "training_state", "load_training_state"),
)
WITHOUT = "# without super"  # a comment in a method that intentionally does not call its parent's
# Terms of RobotTask and LeggedRobot with a positive usual scale; their other terms are costs
PAYS = (
    *("alive", "pose", "tracking_lin_vel", "tracking_ang_vel", "feet_air_time", "feet_contact_without_cmd"),
    *("single_stance", "no_fly", "feet_phase", "contact_phase"),
)
COSTS = ("power", "shock", "stand_torques")  # of skills; a skill's other terms pay
# Methods of a class ported from legged_gym that nothing here calls -> method that is called. docs/from_legged_gym.md
LEGGED_GYM_METHODS: dict[str, str] = {
    "post_physics_step": "_step()",
    "_post_physics_step_callback": "_update_state() and _end_step()",
    "_get_noise_scale_vec": "observation_rows()",
    "reset_idx": "reset_envs(mask)",
    "anneal": "on_training_progress(share)",  # ours, of an earlier version
    "_reset_dofs": "_reset_robots(mask)",
    "_reset_root_states": "_reset_robots(mask)",
    "update_command_curriculum": "_update_command_curriculum(mask)",
    "_get_heights": "_scan_heights()",
    "_push_robots": "perturbation.push of the config",
    **dict.fromkeys(("create_sim", "_create_envs"), "_load_robot()"),
    **dict.fromkeys(("_process_rigid_shape_props", "_process_dof_props", "_process_rigid_body_props"), "_load_robot()"),
}


def own_classes(env_class: type) -> list[type]:
    """The classes of an environment that are the user's, the child first."""
    return [kind for kind in env_class.__mro__ if not kind.__module__.startswith("legged_mw.") and kind is not object]


def check_class(env_class: type, scales: Mapping[str, float]) -> list[str]:
    """Warnings about unused methods and signs of ``scales``. Raises StepError for a hook without super()."""
    for kind, name, method in _own(env_class):
        source = _source(method)
        if name not in HOOKS or re.search(rf"\.{name}\b", source) or WITHOUT in source or not source:
            continue
        if _does_something(env_class.__mro__[env_class.__mro__.index(kind) + 1 :], name):
            arguments = ", ".join([*inspect.signature(method).parameters][1:])
            call = f"super().{name}({arguments})"
            what = f"never calls {call}, which every robot needs: add this call, mostly as the first line"
            raise StepError(f"{what}; to leave it out on purpose, write the comment {WITHOUT} there", place_of(method))
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
    """Warnings about our own terms with a scale of the unusual sign."""
    for name, scale in scales.items():
        method = getattr(env_class, f"_reward_{name}", None)
        if method is None or not method.__module__.startswith("legged_mw."):
            continue
        of_skill = method.__qualname__.partition(".")[0] not in ("RobotTask", "LeggedRobot")
        pays = name in PAYS or (of_skill and name not in COSTS)
        if scale and pays != (scale > 0.0):
            usual = "above 0: it is what the robot should do" if pays else "below 0: it is what the robot should avoid"
            yield f"warning: rewards.scales.{name} is {scale:g}; its usual sign is {usual} (docs/tasks.md)"


def _own(env_class: type) -> Iterator[tuple[type, str, Callable[..., Any]]]:
    """(class, name, method) of all methods in the user's classes."""
    for kind in own_classes(env_class):
        yield from ((kind, name, value) for name, value in vars(kind).items() if inspect.isfunction(value))


def _does_something(parents: tuple[type, ...], name: str) -> bool:
    """Whether the parents' method ``name`` has code, not only a docstring."""
    method = next((vars(kind)[name] for kind in parents if name in vars(kind)), None)
    return method is not None and bool(re.search(r"self\.|return", _source(method)))


def _is_called(env_class: type, name: str) -> bool:
    """Whether another method of the user calls ``name``."""
    return any(re.search(rf"\.{name}\b", _source(method)) for _, other, method in _own(env_class) if other != name)


def _source(method: Any) -> str:
    """The source of a method; '' if it was typed at a prompt."""
    try:
        return inspect.getsource(inspect.unwrap(method))
    except (OSError, TypeError):
        return ""
