"""Classes that a learner's config may name: in a file or a flag those listed here, in the task's own Python file any.

rsl-rl imports and calls what ``class_name`` says. A run folder may come from a stranger, so its config.yaml must not choose code.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

from rsl_rl.algorithms import PPO, Distillation
from rsl_rl.models import CNNModel, MLPModel, RNNModel
from rsl_rl.modules import BetaDistribution, GaussianDistribution, HeteroscedasticGaussianDistribution
from rsl_rl.utils import resolve_callable, resolve_class

from legged_mw.envs.robot_task import RobotTask
from legged_mw.utils.config import Config, ConfigError

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
_RECURRENT = "legged_mw.rl.students.recurrent:RecurrentModel"  # what an RNNModel is here
# the field of the actor's section that asks for it -> the network, imported then
_ESTIMATOR, _CONCURRENT = "actor.estimator.targets", "actor.concurrent.groups"
_STUDENTS = {
    _ESTIMATOR: "legged_mw.rl.students.estimator:EstimatingModel",
    _CONCURRENT: "legged_mw.rl.students.concurrent:ConcurrentModel",
}
_IMPORTED = ("class_name", "data_augmentation_func")  # rsl-rl imports and calls what these keys name


def check_classes(cfg: Config) -> None:
    """Refuse a class that neither the task's own Python file nor ``ALLOWED`` names. Imports nothing. Raises ConfigError."""
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
    """Section ``actor`` of the learner's ``sections`` as rsl-rl takes it, with the class that its parts ask for. Raises ConfigError.

    ``learns``: False for an actor that only acts, in worlds that may be without what the learner knew.
    """
    actor = {name: value for name, value in sections["actor"].items() if name not in ("estimator", "concurrent")}
    parts = sections["actor"]
    named = {_ESTIMATOR: parts["estimator"]["targets"], _CONCURRENT: parts["concurrent"]["groups"]}
    asked = [field for field, names in named.items() if names]
    if not asked:
        return actor
    if len(asked) > 1:
        raise ConfigError(f"{' and '.join(asked)} are both set: the actor reads an estimate or a latent; empty one")
    if actor["class_name"] != "MLPModel":
        raise ConfigError(f"{asked[0]}: that goes with actor.class_name 'MLPModel', not '{actor['class_name']}'")
    assert env is not None
    name = _STUDENTS[asked[0]]
    return {**actor, **resolve_callable(name).settings(sections, env, learns), "class_name": name}  # type: ignore[attr-defined]


def network_section(section: dict[str, Any]) -> dict[str, Any]:
    """The section of a network as rsl-rl takes it, without the fields of a memory if its class has none.

    Imports the class: check it first.
    """
    if section["class_name"] in spellings(RNNModel):
        section = {**section, "class_name": _RECURRENT}
    taken = inspect.signature(resolve_class(section)[0]).parameters
    return {name: value for name, value in section.items() if name in taken or not name.startswith("rnn_")}


def _check_distribution(section: dict[str, Any] | None, path: str) -> None:
    """rsl-rl makes a distribution of its own from all fields of the section, so it must take them."""
    name = (section or {}).get("class_name")
    for kind in (*_DISTRIBUTIONS, BetaDistribution):
        surplus = sorted((section or {}).keys() - inspect.signature(kind).parameters.keys() - {"class_name"})
        if surplus and name in spellings(kind):
            fit = ", ".join(other.__name__ for other in _DISTRIBUTIONS)
            raise ConfigError(
                f"{path}.class_name is {name!r}, which takes no {', '.join(surplus)}, fields of {path}; there fit: {fit}"
            )


def spellings(kind: type | str) -> list[str]:
    """All names under which rsl-rl finds a class, which may be written as ``module:name``, the shortest first."""
    module, name = kind.split(":") if isinstance(kind, str) else (kind.__module__, kind.__qualname__)
    long = [f"{module}:{name}", f"{module}.{name}"]
    if not module.startswith("rsl_rl."):
        return long
    package = module.rpartition(".")[0]
    return [name, f"{package}:{name}", f"{package}.{name}", *long]


def _class_names(values: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted path, value) of everything in nested mappings and lists that rsl-rl would import."""
    items = values.items() if isinstance(values, dict) else enumerate(values) if isinstance(values, list) else ()
    for key, value in items:
        here = f"{path}.{key}" if path else str(key)
        if key in _IMPORTED:
            yield here, value
        yield from _class_names(value, here)
