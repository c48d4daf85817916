"""The learner's config as rsl-rl takes it: settings, the classes that a config may name, their memory.

Not in learner_config.py: tasks import that, and it holds numbers and names only.
"""

from __future__ import annotations

import copy
import importlib.util
import inspect
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

from rsl_rl.algorithms import PPO, Distillation
from rsl_rl.models import CNNModel, MLPModel, RNNModel
from rsl_rl.modules import BetaDistribution, GaussianDistribution, HeteroscedasticGaussianDistribution
from rsl_rl.utils import resolve_callable, resolve_class

from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.learner_config import RobotTaskCfgPPO
from legged_mw.rl.ppo import MAX_RATE
from legged_mw.utils.config import Config, ConfigError
from legged_mw.utils.machine import require_memory


def rsl_rl_config(cfg: RobotTaskCfgPPO, env: RobotTask | None = None) -> dict[str, Any]:
    """The learner's config as rsl-rl's flat dict; a deep copy, since rsl-rl writes into it. Raises ConfigError.

    ``env`` has the rows that ``actor.estimator`` names; without one there is no estimator.
    """
    check_classes(cfg)
    sections = copy.deepcopy(cfg.to_dict())
    sections["actor"] = actor_settings(sections, env)
    runner = sections.pop("runner")
    logger = runner["logger"]
    if logger == "wandb":
        if importlib.util.find_spec("wandb") is None:
            raise ConfigError("runner.logger is wandb, but wandb is not installed: pip install wandb")
        logger = {"class_name": "WandbLogWriter", "project_name": runner["wandb_project"]}
    keys = ("num_steps_per_env", "save_interval", "keep_checkpoints", "exam_interval", "experiment_name", "run_name")
    symmetry = sections.pop("symmetry")
    mirrors = symmetry["use_data_augmentation"] or symmetry["use_mirror_loss"]
    symmetry_cfg = {"data_augmentation_func": "legged_mw.rl.ppo:mirror", **symmetry} if mirrors else None
    algorithm = {"rnd_cfg": None, "symmetry_cfg": symmetry_cfg, **sections.pop("algorithm")}
    _check_bound(algorithm)
    anneal = {name: (algorithm[name], end) for name, end in sections.pop("anneal").items()}
    flat = {key: runner[key] for key in keys} | {name: network_section(sections[name]) for name in ("actor", "critic")}
    return {**sections, **flat, "algorithm": algorithm, "anneal": anneal, "logger": logger, "check_for_nan": False}


def _check_bound(algorithm: dict[str, Any]) -> None:
    """Drop ``max_learning_rate`` if it is rsl-rl's own; raise ConfigError if no class would read it."""
    if algorithm["max_learning_rate"] == MAX_RATE:
        del algorithm["max_learning_rate"]
        return
    name, rate, bound = (algorithm[key] for key in ("class_name", "learning_rate", "max_learning_rate"))
    if name in spellings(PPO):
        raise ConfigError(
            f"algorithm.max_learning_rate: rsl-rl's own {name} goes up to {MAX_RATE:g}; GraphedPPO takes another"
        )
    if algorithm["schedule"] == "fixed":
        raise ConfigError(
            f"algorithm.max_learning_rate is {bound:g}, but algorithm.schedule is 'fixed', which has no bound: "
            f"the rate is algorithm.learning_rate throughout. Leave the bound at {MAX_RATE:g}, "
            "or take the schedule 'adaptive'"
        )
    if rate > bound:
        raise ConfigError(
            f"algorithm.learning_rate is {rate:g}, above algorithm.max_learning_rate, {bound:g}; begin at or below it"
        )


# ---- classes --------------------------------------------------------------------------------------------------------


_NETWORKS = (MLPModel, CNNModel, RNNModel)
_DISTRIBUTIONS = (GaussianDistribution, HeteroscedasticGaussianDistribution)
ALLOWED: dict[str, tuple[type | str, ...]] = {
    "actor.class_name": _NETWORKS,
    "critic.class_name": _NETWORKS,
    "actor.distribution_cfg.class_name": _DISTRIBUTIONS,
    "critic.distribution_cfg.class_name": _DISTRIBUTIONS,
    "algorithm.class_name": ("legged_mw.rl.ppo:GraphedPPO", PPO),
    "distillation.class_name": ("legged_mw.rl.students.distillation:GraphedDistillation", Distillation),
}
_RECURRENT = "legged_mw.rl.students.recurrent:RecurrentModel"  # takes the place of rsl-rl's RNNModel
# the field of section `actor` that selects it -> the network, imported when it is selected
_ESTIMATOR, _CONCURRENT = "actor.estimator.targets", "actor.concurrent.groups"
_STUDENTS = {
    _ESTIMATOR: "legged_mw.rl.students.estimator:EstimatingModel",
    _CONCURRENT: "legged_mw.rl.students.concurrent:ConcurrentModel",
}
_IMPORTED = ("class_name", "data_augmentation_func")  # rsl-rl imports and calls what these keys name


def check_classes(cfg: Config) -> None:
    """Raise ConfigError for a class that neither the task's own Python file nor ``ALLOWED`` names. Imports nothing.

    rsl-rl imports and calls the value of ``class_name``, and a run folder may be a stranger's: its config.yaml must not
    choose code.
    """
    for network in ("actor", "critic"):
        _check_distribution(cfg.to_dict().get(network, {}).get("distribution_cfg"), f"{network}.distribution_cfg")
    own = dict(_class_names(type(cfg)().to_dict()))
    for path, name in _class_names(cfg.to_dict()):
        if path in own and name == own[path]:
            continue
        allowed = [spelling for kind in ALLOWED.get(path, ()) for spelling in spellings(kind)]
        if name not in allowed:
            shortest = [spellings(kind)[0] for kind in ALLOWED.get(path, ())]
            raise ConfigError(
                f"{path} is {name!r}: only the task's own Python file, which --task names, may choose that; "
                f"a run's config.yaml, --set and --override may name {', '.join(shortest) or 'nothing else there'}"
            )


def actor_settings(sections: dict[str, Any], env: RobotTask | None, learns: bool = True) -> dict[str, Any]:
    """Section ``actor`` as rsl-rl takes it, with the class that its subsections select. Raises ConfigError.

    ``sections``: the learner's config. ``learns``: False for an actor that only acts, in worlds that may lack the rows
    it learned from.
    """
    actor = {name: value for name, value in sections["actor"].items() if name not in ("estimator", "concurrent")}
    parts = sections["actor"]
    named = {_ESTIMATOR: parts["estimator"]["targets"], _CONCURRENT: parts["concurrent"]["groups"]}
    fields = [field for field, names in named.items() if names]
    if not fields:
        return actor
    if len(fields) > 1:
        raise ConfigError(f"{' and '.join(fields)} are both set: the actor reads an estimate or a latent; empty one")
    if actor["class_name"] != "MLPModel":
        raise ConfigError(f"{fields[0]}: that goes with actor.class_name 'MLPModel', not '{actor['class_name']}'")
    assert env is not None
    name = _STUDENTS[fields[0]]
    model: Any = resolve_callable(name)
    return {**actor, **model.settings(sections, env, learns), "class_name": name}


def network_section(section: dict[str, Any]) -> dict[str, Any]:
    """The section of a network as rsl-rl takes it; without the fields ``rnn_...`` if its class has none.

    Imports the class: check it first.
    """
    if section["class_name"] in spellings(RNNModel):
        section = {**section, "class_name": _RECURRENT}
    taken = inspect.signature(resolve_class(section)[0]).parameters
    return {name: value for name, value in section.items() if name in taken or not name.startswith("rnn_")}


def _check_distribution(section: dict[str, Any] | None, path: str) -> None:
    """Raise ConfigError if a distribution of rsl-rl does not take all fields of its section."""
    name = (section or {}).get("class_name")
    for kind in (*_DISTRIBUTIONS, BetaDistribution):
        surplus = sorted((section or {}).keys() - inspect.signature(kind).parameters.keys() - {"class_name"})
        if surplus and name in spellings(kind):
            fit = ", ".join(other.__name__ for other in _DISTRIBUTIONS)
            raise ConfigError(
                f"{path}.class_name is {name!r}, which takes no {', '.join(surplus)}, fields of {path}; "
                f"there fit: {fit}"
            )


def spellings(kind: type | str) -> list[str]:
    """All names by which rsl-rl finds a class, the shortest first. A string is ``module:name``."""
    module, name = kind.split(":") if isinstance(kind, str) else (kind.__module__, kind.__qualname__)
    long = [f"{module}:{name}", f"{module}.{name}"]
    if not module.startswith("rsl_rl."):
        return long
    package = module.rpartition(".")[0]
    return [name, f"{package}:{name}", f"{package}.{name}", *long]


def _class_names(values: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted path, value) of each class that nested mappings and lists name."""
    items = values.items() if isinstance(values, dict) else enumerate(values) if isinstance(values, list) else ()
    for key, value in items:
        here = f"{path}.{key}" if path else str(key)
        if key in _IMPORTED:
            yield here, value
        yield from _class_names(value, here)


# ---- memory ---------------------------------------------------------------------------------------------------------


_FLOAT = 4  # [byte]


def check_room(sections: dict[str, Any], env: RobotTask, learns: bool = True) -> None:
    """Raise UserError if networks and rollout do not fit the memory; it names the largest field.

    ``sections``: the learner's config. ``learns``: False for an actor that only acts.
    """
    device, sizes = str(env.device), {group: buffer.shape[1] for group, buffer in env.obs_buf.items()}
    counts = {
        field: count
        for name in (("actor", "critic") if learns else ("actor",))
        for field, count in _weights(
            sections, name, sum(sizes.get(group, 0) for group in sections["obs_groups"][name])
        ).items()
    }
    field = max(counts, key=lambda field: counts[field])
    value = sections
    for part in field.split("."):
        value = value[part]
    copies = 4 if learns else 1  # weights, gradients, and Adam's two moments
    require_memory(
        _FLOAT * copies * sum(counts.values()), device, f"{field} = {value}", "fewer values a layer need less"
    )
    if learns:
        steps, worlds = sections["runner"]["num_steps_per_env"], env.num_envs
        # action, mean, deviation; reward, done, value, return, advantage
        sample = sum(sizes.values()) + 3 * env.num_actions + 5
        what = f"runner.num_steps_per_env = {steps} with env.num_envs = {worlds}"
        require_memory(_FLOAT * steps * worlds * sample, device, what, "fewer steps or worlds need less")


def _weights(sections: dict[str, Any], name: str, seen: int) -> dict[str, int]:
    """Field -> number of weights, of the network ``name`` with ``seen`` inputs."""
    section, counts = sections[name], {}
    if "RNN" in section["class_name"]:
        hidden = section["rnn_hidden_dim"]
        counts[f"{name}.rnn_hidden_dim"] = 3 * hidden * (seen + hidden * (2 * section["rnn_num_layers"] - 1))
        seen = hidden
    counts[f"{name}.hidden_dims"] = _chain([seen, *section["hidden_dims"], 1])
    if name == "actor" and section["estimator"]["targets"]:
        counts["actor.estimator.hidden_dims"] = _chain([seen, *section["estimator"]["hidden_dims"], 1])
    if name == "actor" and section["concurrent"]["groups"]:
        counts["actor.concurrent.hidden_dims"] = _chain([seen, *section["concurrent"]["hidden_dims"]])
        counts["actor.concurrent.latent_dim"] = (
            section["concurrent"]["latent_dim"] * section["concurrent"]["hidden_dims"][-1]
        )
    return counts


def _chain(sizes: list[int]) -> int:
    return sum(before * after for before, after in pairwise(sizes))
