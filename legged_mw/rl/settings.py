"""The learner's config as rsl-rl takes it."""

from __future__ import annotations

import copy
import importlib.util
from typing import Any

from rsl_rl.algorithms import PPO

from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.classes import actor_settings, check_classes, network_section, spellings
from legged_mw.rl.learner_config import RobotTaskCfgPPO
from legged_mw.rl.ppo import MAX_RATE
from legged_mw.utils.config import ConfigError


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
    symmetry_cfg = {"data_augmentation_func": "legged_mw.rl.symmetry:mirror", **symmetry} if mirrors else None
    algorithm = {"rnd_cfg": None, "symmetry_cfg": symmetry_cfg, **sections.pop("algorithm")}
    _check_bound(algorithm)
    anneal = {name: (algorithm[name], end) for name, end in sections.pop("anneal").items()}
    flat = {key: runner[key] for key in keys} | {name: network_section(sections[name]) for name in ("actor", "critic")}
    return {**sections, **flat, "algorithm": algorithm, "anneal": anneal, "logger": logger, "check_for_nan": False}


def _check_bound(algorithm: dict[str, Any]) -> None:
    """Take ``max_learning_rate`` out where it is rsl-rl's own, so that any class may be named; refuse one that nothing would read."""
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
            f"the rate is algorithm.learning_rate throughout. Leave the bound at {MAX_RATE:g}, or take the schedule 'adaptive'"
        )
    if rate > bound:
        raise ConfigError(
            f"algorithm.learning_rate is {rate:g}, above algorithm.max_learning_rate, {bound:g}; begin at or below it"
        )
