"""rsl-rl's runner, fed from class configs. It owns the loop, so that nothing in a rollout asks the device a question."""

from __future__ import annotations

import copy
import importlib.util
import math
import time
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner
from torch import Tensor

from legged_mw import ROOT
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.legged_robot_config import LeggedRobotCfgPPO
from legged_mw.rl.runs import check_fit, load_tensors, save_whole
from legged_mw.utils.config import ConfigError


class Runner(OnPolicyRunner):
    """Trains with rsl-rl's algorithm, storage and writers.

    ``current_learning_iteration`` counts finished iterations: a checkpoint ``model_100.pt`` has done 100 of them, and a
    resumed run goes on with the 101st. Set ``stop`` to a reason, at any time, to end the run after a checkpoint.
    """

    env: LeggedRobot

    def __init__(self, env: LeggedRobot, train_cfg: dict[str, Any], log_dir: str | None = None, device: str = "cpu") -> None:
        super().__init__(env, train_cfg, log_dir, device)
        self.logger.git_status_repos = [str(ROOT)]
        self.total_steps = 0
        self.stop: str | None = None
        self._warned_overflow = False
        self._last_means: dict[str, float] = {}
        self._action_std = math.nan

    # ---- the loop -------------------------------------------------------------------------------------------------

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = True) -> None:
        """Run that many iterations: roll out, update, log, save. Ends early, after a checkpoint, once ``stop`` is set."""
        if init_at_random_ep_len:  # else every world would time out in the same step
            self.env.episode_length_buf = torch.randint_like(self.env.episode_length_buf, high=self.env.max_episode_length)
        obs = self.env.get_observations()
        self.alg.train_mode()
        if self.is_distributed:
            self.alg.broadcast_parameters()
        self.logger.init_logging_writer()
        begun, first = time.time(), self.current_learning_iteration
        last = first + num_learning_iterations
        self.env.read_statistics()
        while self.current_learning_iteration < last and self.stop is None:
            start = time.time()
            obs = self._rollout(obs)
            if self.stop is not None:
                break  # an unfinished rollout is dropped
            with torch.inference_mode():
                self.alg.compute_returns(obs)
            statistics = self.env.read_statistics()  # the one wait for the device in an iteration's rollout
            collected = time.time()
            losses = self.alg.update()
            self.current_learning_iteration += 1
            done = time.time()
            steps = self.cfg["num_steps_per_env"] * self.env.num_envs * self.gpu_world_size
            self.total_steps += steps
            iteration = self.current_learning_iteration
            left = (done - begun) / (iteration - first) * (last - iteration)
            self._log(last, statistics, losses, steps, collected - start, done - collected, done - begun, left)
            if iteration % self.cfg["save_interval"] == 0 and iteration < last:
                self._save_checkpoint()
        self._save_checkpoint()
        self.logger.stop_logging_writer()

    def _rollout(self, obs: Any) -> Any:
        with torch.inference_mode():
            for _ in range(self.cfg["num_steps_per_env"]):
                obs, rewards, dones, extras = self.env.step(self.alg.act(obs))
                self.alg.process_env_step(obs, rewards, dones, extras)
                if self.stop is not None:
                    self.alg.storage.clear()
                    break
        return obs

    # ---- what the user sees ---------------------------------------------------------------------------------------

    def _log(
        self,
        last: int,
        statistics: dict[str, float],
        losses: dict[str, float],
        steps: int,
        collect_time: float,
        learn_time: float,
        elapsed: float,
        left: float,
    ) -> None:
        """One block on the console and one point a curve in the writer."""
        iteration = self.current_learning_iteration
        self._last_means.update({name: value for name, value in statistics.items() if not math.isnan(value)})
        means = {name: self._last_means.get(name, math.nan) for name in statistics}
        self._action_std = float(self.alg.get_policy().output_std.detach().mean())
        speed = steps / (collect_time + learn_time)
        scalars = {f"Loss/{name}": value for name, value in losses.items()}
        scalars |= {"Loss/learning_rate": self.alg.learning_rate, "Policy/mean_std": self._action_std}
        scalars |= {"Perf/total_fps": speed, "Perf/collection_time": collect_time, "Perf/learning_time": learn_time}
        scalars |= {"Train/mean_reward": means["reward"], "Train/mean_episode_length": means["episode_length"]}
        scalars |= {f"Episode/{name}": value for name, value in means.items() if name.startswith("rew_")}
        scalars |= {"Episode/fell": means["fell"], "Episode/broken": means["broken"], "Train/total_steps": self.total_steps}
        if self.logger.writer is not None:
            for name, value in scalars.items():
                if not math.isnan(value):
                    self.logger.writer.add_scalar(name, value, iteration)
        print(self._block(last, means, losses, speed, collect_time, learn_time, elapsed, left), flush=True)
        self._warn_overflow()

    def _block(self, last: int, means: dict, losses: dict, speed: float, collect: float, learn: float, elapsed: float, left: float) -> str:
        rows = {
            "Computation": f"{speed:.0f} steps/s (collection {collect:.3f} s, learning {learn:.3f} s)",
            **{f"{name.capitalize()} loss": f"{value:.4f}" for name, value in losses.items()},
            "Learning rate": f"{self.alg.learning_rate:.1e}",
            "Action std": f"{self._action_std:.2f}",
            "Mean reward": f"{means['reward']:.2f}",
            "Mean episode length": f"{means['episode_length']:.1f}",
            **{name: f"{value:.4f}" for name, value in means.items() if name.startswith("rew_")},
            "Episodes ended": f"{means['episodes']:.0f} ({means['fell']:.0f} falls, {means['broken']:.0f} not finite)",
            "Total steps": f"{self.total_steps}",
            "Time elapsed, left": f"{timedelta(seconds=round(elapsed))}, {timedelta(seconds=round(left))}",
        }
        title = f" Learning iteration {self.current_learning_iteration}/{last} ".center(80, "#")
        return "\n".join([title, *(f"{name:>32}: {text}" for name, text in rows.items())])

    def _warn_overflow(self) -> None:
        if not self._warned_overflow and (report := self.env.sim.overflow_report()):
            print(f"WARNING: {report} (config section sim)", flush=True)
            self._warned_overflow = True

    # ---- checkpoints ----------------------------------------------------------------------------------------------

    def _save_checkpoint(self) -> None:
        if self.logger.writer is not None:
            assert self.logger.log_dir is not None
            self.save(str(Path(self.logger.log_dir) / f"model_{self.current_learning_iteration}.pt"))

    def save(self, path: str, infos: dict | None = None) -> None:
        """Write all that training needs to go on; whole or not at all, tensors and plain numbers only."""
        content = self.alg.save()
        content["iter"] = self.current_learning_iteration
        content["infos"] = {**(infos or {}), "total_steps": self.total_steps, "random_state": _random_state(self.device)}
        save_whole(content, Path(path))
        self.logger.save_model(path, self.current_learning_iteration)

    def load(self, path: str, load_cfg: dict | None = None, strict: bool = True, map_location: str | None = None) -> dict:
        """Go on from a checkpoint: networks, normalisers, optimizer, learning rate, counters and random state."""
        content = load_tensors(Path(path), map_location or self.device)
        check_fit(content["actor_state_dict"], self.alg.get_policy().state_dict(), Path(path), "actor")
        if "optimizer_state_dict" not in content:
            raise ConfigError(f"{path} holds an actor only; it can be played, but not resumed")
        check_fit(content["critic_state_dict"], self.alg.critic.state_dict(), Path(path), "critic")
        if self.alg.load(content, load_cfg, strict):
            self.current_learning_iteration = content["iter"]
        if self.alg.schedule == "fixed":  # the config's number, which the user may have changed; an adaptive rate goes on
            self.alg.learning_rate = self.cfg["algorithm"]["learning_rate"]
            for group in self.alg.optimizer.param_groups:
                group["lr"] = self.alg.learning_rate
        infos = content.get("infos") or {}
        self.total_steps = infos.get("total_steps", 0)
        _set_random_state(infos.get("random_state", {}), self.device)
        return infos


def make_runner(env: LeggedRobot, cfg: LeggedRobotCfgPPO, log_dir: Path | None, device: str) -> Runner:
    """A runner over ``env`` from the learner's config; it writes below ``log_dir``, or nothing if that is None."""
    torch.set_float32_matmul_precision(cfg.runner.matmul_precision)
    try:
        return Runner(env, rsl_rl_config(cfg), str(log_dir) if log_dir else None, device)
    except ValueError as error:  # a class, activation, optimizer or observation group that does not exist
        raise ConfigError(f"the learner's config does not fit rsl-rl: {error}") from None


def rsl_rl_config(cfg: LeggedRobotCfgPPO) -> dict[str, Any]:
    """The learner's config as rsl-rl's flat dict; a deep copy, since rsl-rl writes into it."""
    sections = copy.deepcopy(cfg.to_dict())
    runner = sections.pop("runner")
    logger = runner["logger"]
    if logger == "wandb":
        if importlib.util.find_spec("wandb") is None:
            raise ConfigError("runner.logger is wandb, but wandb is not installed: pip install wandb")
        logger = {"class_name": "WandbLogWriter", "project_name": runner["wandb_project"]}
    keys = ("num_steps_per_env", "save_interval", "experiment_name", "run_name")
    algorithm = {"rnd_cfg": None, "symmetry_cfg": None, **sections.pop("algorithm")}
    return {**sections, **{key: runner[key] for key in keys}, "algorithm": algorithm, "logger": logger, "check_for_nan": False}


def _random_state(device: str) -> dict[str, Tensor]:
    state = {"cpu": torch.get_rng_state()}
    if device.startswith("cuda"):
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


def _set_random_state(state: dict[str, Tensor], device: str) -> None:
    if "cpu" in state:
        torch.set_rng_state(state["cpu"].cpu())
    if "cuda" in state and device.startswith("cuda"):
        torch.cuda.set_rng_state(state["cuda"].cpu(), device)
