"""The learner's config as rsl-rl takes it."""

from __future__ import annotations

import copy
import importlib.util
from typing import Any

from rsl_rl.algorithms import PPO

from legged_mw.envs.robot_task import RobotTask
from legged_mw.envs.robot_task_config import RobotTaskCfgPPO
from legged_mw.rl.classes import actor_settings, check_classes, network_section, spellings
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
    if algorithm.get("max_learning_rate") == 1e-2:  # rsl-rl's, which knows no other
        del algorithm["max_learning_rate"]
    elif algorithm["class_name"] in spellings(PPO):
        raise ConfigError(f"algorithm.max_learning_rate: rsl-rl's own {algorithm['class_name']} goes up to 0.01; GraphedPPO takes another")
    elif algorithm.get("schedule") == "adaptive" and algorithm["learning_rate"] > algorithm["max_learning_rate"]:
        rate, bound = algorithm["learning_rate"], algorithm["max_learning_rate"]
        raise ConfigError(f"algorithm.learning_rate is {rate:g}, above algorithm.max_learning_rate, {bound:g}; begin at or below it")
    anneal = {name: (algorithm[name], end) for name, end in sections.pop("anneal").items()}
    flat = {key: runner[key] for key in keys} | {name: network_section(sections[name]) for name in ("actor", "critic")}
    return {**sections, **flat, "algorithm": algorithm, "anneal": anneal, "logger": logger, "check_for_nan": False}
