"""The training loop: rsl-rl's runner with another ``learn``, whose rollouts never wait for the device."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from statistics import median
from typing import Any, Self

import torch
from rsl_rl.algorithms import Distillation
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.runners import OnPolicyRunner
from torch import Tensor, nn

from legged_mw import ROOT
from legged_mw.envs.robot_task import RobotTask
from legged_mw.envs.snapshot import (
    MOST,
    beyond,
    first_difference,
    memory,
    put_snapshot,
    random_state,
    same_worlds,
    set_random_state,
    take_snapshot,
)
from legged_mw.envs.statistics import DivergenceStop
from legged_mw.rl.iteration_log import (
    Clock,
    Console,
    FiniteCheck,
    Mark,
    Message,
    Report,
    console_rows,
    curves,
    quiet_writers,
)
from legged_mw.rl.learner_config import RobotTaskCfgPPO, rsl_rl_config
from legged_mw.rl.networks import RegressingModel
from legged_mw.rl.policies import TEACHER, acting, adapt
from legged_mw.rl.ppo import GraphedPPO, Recorded, UpdateRollback
from legged_mw.rl.ranks import first_ranks, first_word, this_rank
from legged_mw.rl.run_folder import (
    CheckpointWriter,
    check_fit,
    check_resume,
    load_tensors,
    reason_of,
    save_whole,
    unpack,
    worlds_file,
)
from legged_mw.utils.config import ConfigError
from legged_mw.utils.machine import usable_cores


class Runner(OnPolicyRunner):
    """Trains with rsl-rl's algorithm, storage and writers.

    ``current_learning_iteration`` counts finished iterations: ``model_100.pt`` is saved after 100 of them, and a
    resumed run starts with the 101st. Set ``stop`` to a reason to end the run after the current iteration, with a
    checkpoint.
    """

    env: RobotTask

    def __init__(
        self, env: RobotTask, train_cfg: dict[str, Any], log_dir: str | None = None, device: str = "cpu"
    ) -> None:
        super().__init__(env, train_cfg, log_dir, device)
        self.logger.git_status_repos = [str(ROOT)] if (ROOT / ".git").exists() else []
        self.total_steps = 0
        self.stop: str | None = None
        self.deadline: float | None = None  # time at which `learn` and its annealing end [s, time.time()]
        self.schedule = TrainingSchedule()
        self.diverged = ""  # why the runner itself set `stop`
        self.why_not_exact = "it is a new run"  # why `load` did not restore the worlds of a checkpoint
        self.writer: CheckpointWriter | None = None  # made in `learn` if the run has a folder
        self._divergence = DivergenceStop()
        self._rolls_back = not isinstance(self.alg, Recorded)  # the recorded update rolls itself back
        learner: Any = self.alg
        self._rollback = UpdateRollback(learner, self._networks().values()) if self._rolls_back else learner.rollback
        self._finite_check = FiniteCheck([name for each in env.nonfinite for name in each.names], self._stored_names())
        # policy -> figures for the log; called every `exam_interval` iterations and after the last one
        self.examine: Callable[[Any], dict[str, float]] | None = None
        self.last_exam: tuple[int, dict[str, float]] | None = None  # iteration, figures
        self.update_threads = nullcontext()
        if device == "cpu":
            self.update_threads = UpdateThreads(self.cfg["cpu"]["update_threads"], usable_cores())
        self.console = Console()
        self._warned_overflow = self._curves_lost = False
        self._last_means: dict[str, float] = {}

    def _configure_multi_gpu(self) -> None:
        """Connect the ranks: by rsl-rl's method (NCCL) on GPUs, by gloo on a CPU."""
        rank = this_rank()
        if rank.count == 1 or self.device != "cpu":
            super()._configure_multi_gpu()
            return
        self.is_distributed = True
        self.gpu_global_rank, self.gpu_local_rank, self.gpu_world_size = rank
        self.cfg["multi_gpu"] = {"global_rank": rank.index, "local_rank": rank.local, "world_size": rank.count}
        torch.distributed.init_process_group("gloo", rank=rank.index, world_size=rank.count)

    # ---- the loop -------------------------------------------------------------------------------------------------

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = True) -> None:
        """Run iterations of rollout, update, log and checkpoint. If ``stop`` is set, save a checkpoint and end early.

        On a GPU an iteration is logged while the next one runs, so the device never waits for the host.
        """
        if init_at_random_ep_len:  # otherwise all worlds time out in the same step
            self.env.episode_length_buf = torch.randint_like(
                self.env.episode_length_buf, high=self.env.max_episode_length
            )
        obs = self.env.get_observations()
        self.alg.train_mode()
        if self.is_distributed:
            self.alg.broadcast_parameters()
        if self.logger.log_dir and not self.writer:
            self.writer = CheckpointWriter(Path(self.logger.log_dir), self.cfg["keep_checkpoints"], this_rank())
        self._open_curves()
        self.env.take_statistics()
        clock, waiting = Clock(self.device), None
        self._make_schedule(self.current_learning_iteration + num_learning_iterations)
        self._all_stop = False
        start = clock.mark()
        while self.current_learning_iteration < self.schedule.last and not self._must_stop():
            self._anneal()  # before the rollout, so that a resumed rollout is equal to an uninterrupted one
            if self._rolls_back:
                self._rollback.begin()
            obs = self._rollout(obs)
            with torch.inference_mode():
                self.alg.compute_returns(obs)
            collected = clock.mark()
            losses = self._update()
            report = self._report(losses, (start, collected, start := clock.mark()))
            if waiting:
                self._log(waiting)
            waiting = report if self.device != "cpu" else self._log(report)
            redraw = self.env.cfg.domain_rand.redraw_iterations
            if redraw and self.current_learning_iteration % redraw == 0:
                self.env.domain_rand.redraw()
            if (
                self.current_learning_iteration % self.cfg["save_interval"] == 0
                and self.current_learning_iteration < self.schedule.last
            ):
                self._save_checkpoint()
            # the waiting report is not logged before an exam: all ranks must read a stop in the same iteration
            if self._exam_is_due():
                self._examine()
                start = clock.mark()
        if waiting:
            self._log(waiting)
        self._save_checkpoint()
        if self.examine and self.stop is None:
            self._examine()
        self._end_curves()

    def _make_schedule(self, last: int) -> None:
        """Make the schedule up to iteration ``last`` or the deadline, by the clock of the first rank."""
        self.schedule = TrainingSchedule(last, self.deadline, self.schedule.seconds)
        self.schedule.done, self.console.deadline = first_ranks(self.schedule.done, self.device), self.deadline

    def _anneal(self) -> None:
        """Interpolate the annealed settings linearly over the training, and end the critic's warm-up."""
        if isinstance(self.alg, GraphedPPO):
            self.alg.learn_critic_only(self.current_learning_iteration < self.cfg["critic_warmup"])
        done = self.schedule.begin(self.current_learning_iteration)
        for name, (begin, end) in self.cfg["anneal"].items():
            if end and begin is not None:
                setattr(self.alg, name, begin + (end - begin) * done)
        self.env.on_training_progress(done)

    def _must_stop(self) -> bool:
        """Whether to stop. An update needs all ranks, so all of them stop one iteration after the first signal."""
        if not self.is_distributed:
            return self.stop is not None
        if self._all_stop:
            self.stop = self.stop or "another rank was asked to"
        return self._all_stop

    def _rollout(self, obs: Any) -> Any:
        with torch.inference_mode():
            for _ in range(self.cfg["num_steps_per_env"]):
                obs, rewards, dones, extras = self.env.step(self.alg.act(obs))
                self.alg.process_env_step(obs, rewards, dones, extras)
        return obs

    def _update(self) -> dict[str, Any]:
        with self.update_threads:
            if not self._rolls_back:
                return self.alg.update()
            try:
                losses = self.alg.update()
            except (RuntimeError, ValueError):  # rsl-rl's own update raises if a distribution is not finite
                self._rollback.finish()
                if not self._rollback.undone:
                    raise
                self.alg.storage.clear()
                return {}
            self._rollback.finish()
            return losses

    def _exam_is_due(self) -> bool:
        """True every ``exam_interval`` iterations, except the last: its exam runs after the last checkpoint."""
        interval, done = self.cfg["exam_interval"], self.current_learning_iteration
        return self.examine is not None and interval > 0 and done % interval == 0 and done < self.schedule.last

    def _next_exam(self, done: int) -> int | None:
        """The iteration after which the next exam runs, or None."""
        interval = self.cfg["exam_interval"]
        if self.examine is None or interval <= 0:
            return None
        return min((done // interval + 1) * interval, self.schedule.last)

    def _examine(self) -> None:
        """Run the exam on the current policy. Only the first rank has one; the others wait in the next update."""
        assert self.examine is not None
        if self.device != "cpu":
            torch.cuda.synchronize(self.device)  # so that the measured time is that of the exam only
        policy, begun = self.alg.get_policy(), time.time()
        training, memory = policy.training, policy.get_hidden_state()
        try:
            figures = self.examine(policy.eval())
        except Exception as error:  # a failed exam must not end a training
            print(
                f"WARNING: the exam failed, training continues without it: {type(error).__name__}: {error}", flush=True
            )
            self.examine = None
            return
        finally:
            policy.train(training)
            policy.reset(hidden_state=memory)  # hidden state of the training worlds
        self.last_exam = self.current_learning_iteration, figures
        values = {**{f"Exam/{name}": value for name, value in figures.items()}, "Perf/exam_time": time.time() - begun}
        self._draw_curves(values, self.current_learning_iteration)
        self.console.exam(self.current_learning_iteration, self.schedule.last, figures)

    # ---- the log --------------------------------------------------------------------------------------------------

    def _report(self, losses: dict[str, Any], marks: tuple[Mark, Mark, Mark]) -> Report:
        """Count the iteration and start the copy of its numbers to the host."""
        self.current_learning_iteration += 1
        steps = self.cfg["num_steps_per_env"] * self.env.num_envs * self.gpu_world_size
        self.total_steps += steps

        def vector(*values: Any) -> Tensor:
            each = [
                value.to(self.device, torch.float)
                if isinstance(value, Tensor)
                else torch.full((), float(value), device=self.device)  # a copy from the host would wait for the device
                for value in values
            ]
            return torch.stack(each) if each else torch.zeros(0, device=self.device)

        summed = {
            "statistics": self.env.take_statistics(),
            "nonfinite": torch.cat([each.take() for each in self.env.nonfinite]),
            "stop": vector(self.stop is not None),
            "iterations_left": vector(self.schedule.iterations_left() if self.gpu_global_rank == 0 else 0.0),
        }
        if self.is_distributed:
            together = torch.cat([*summed.values()])
            torch.distributed.all_reduce(together)
            parts = together.split([len(part) for part in summed.values()])
            summed = dict(zip(summed, parts, strict=True))
        message = Message(
            **summed,
            losses=vector(*losses.values()),
            learning_rate=vector(self.alg.rate if isinstance(self.alg, GraphedPPO) else self.alg.learning_rate),
            action_std=vector(self._action_std()),
            undone=vector(self._rollback.undone),
            wrong=self._rollback.wrong,
        )
        return Report(self.current_learning_iteration, self.total_steps, steps, list(losses), message, marks)

    def _action_std(self) -> Tensor:
        """Mean standard deviation () of the actions: over the last rollout for a Gaussian, else the current one."""
        policy, params = self.alg.get_policy(), getattr(self.alg.storage, "distribution_params", None)
        if isinstance(policy.distribution, GaussianDistribution) and params is not None:
            return params[1].mean()
        return policy.output_std.detach().mean()

    def _log(self, report: Report) -> None:
        """Write an iteration to the console and the curves, and set ``stop`` if the training diverged."""
        read = report.message.read()
        numbers = self.env.name_statistics(read.statistics)
        self._all_stop = read.stop[0] > 0
        self.schedule.end_after(report.iteration, read.iterations_left[0])
        if verdict := self._divergence.verdict(numbers):
            self.diverged, self.stop = verdict, self.stop or "the simulated state is not finite"
        losses = dict(zip(report.losses, read.losses, strict=True))
        self._last_means.update({name: value for name, value in numbers.items() if not math.isnan(value)})
        numbers = {name: self._last_means.get(name, math.nan) for name in numbers}
        [numbers["learning_rate"]], [numbers["action_std"]] = read.learning_rate, read.action_std
        numbers["falls_a_minute"] = 60.0 * numbers["fell"] / (report.steps * self.env.dt)
        collect, learn = report.seconds()
        speed = report.steps / (collect + learn)
        rows = {**console_rows(numbers, losses, speed, collect, learn), "Total steps": f"{report.total_steps}"}
        self.console.iteration(
            report.iteration, self.schedule.last, self._next_exam(report.iteration), numbers, rows, speed
        )
        warnings, verdict = self._finite_check.judge(read.nonfinite, report.steps, read.undone[0] > 0, read.wrong)
        warnings += self._finite_check.lengths(numbers) + self._finite_check.walking(numbers, self.schedule.done)
        print("".join(f"WARNING: iteration {report.iteration}: {line}\n" for line in warnings), end="", flush=True)
        if verdict:
            self.diverged, self.stop = self.diverged or verdict, self.stop or "learning has died"
        drawn = curves(numbers, losses, speed, collect, learn, report.total_steps)
        self._draw_curves({**drawn, "Train/undone_updates": float(self._finite_check.undone)}, report.iteration)
        if numbers["overflowed"] and not self._warned_overflow:
            message = (
                f"simulator overflow in {numbers['overflowed']:.0f} worlds of other ranks; raise nconmax and njmax"
            )
            print(f"WARNING: {self.env.sim.overflow_report() or message}", flush=True)
            self._warned_overflow = True

    def _stored_names(self) -> list[str]:
        """Names of the columns that an update reads: the observation columns by group, then the rewards."""
        table, names = self.env.observations, []
        rows = {group: [row.name for row in table.rows(group) for _ in range(row.size)] for group in table.groups}
        for group, i in self._rollback.columns:
            names.append(
                f"observation row '{rows[group][i]}' of '{group}'" if group in rows else f"observation group '{group}'"
            )
        return [*names, "the rewards"]

    # ---- curves: if they cannot be written, training continues ----------------------------------------------------

    def _open_curves(self) -> None:
        quiet_writers()
        try:
            self.logger.init_logging_writer()
        except Exception as error:  # a logging service may raise any exception
            self._lose_curves(error)

    def _draw_curves(self, values: dict[str, float], iteration: int) -> None:
        try:
            for name, value in values.items():
                if self.logger.writer is not None and not math.isnan(value):
                    self.logger.writer.add_scalar(name, value, iteration)
        except Exception as error:
            self._lose_curves(error)

    def _end_curves(self) -> None:
        """Write all curves before the training ends: a writer's thread must not write into a finished run."""
        try:
            self.logger.stop_logging_writer()
            if flush := getattr(self.logger.writer, "flush", None):
                flush()
        except Exception as error:  # a logging service may raise any exception
            self._lose_curves(error)

    def _lose_curves(self, error: Exception) -> None:
        """Stop writing curves until the next checkpoint."""
        print(f"WARNING: no curves until the next checkpoint, they cannot be written: {reason_of(error)}", flush=True)
        self.logger.writer, self._curves_lost = None, True

    # ---- checkpoints ----------------------------------------------------------------------------------------------

    def _networks(self) -> dict[str, nn.Module]:
        """rsl-rl's name -> network, for the networks in a checkpoint. The first is the policy."""
        names = ("student", "teacher") if isinstance(self.alg, Distillation) else ("actor", "critic")
        return {name: getattr(self.alg, name) for name in names}

    def _save_checkpoint(self) -> None:
        """Write a checkpoint if the networks are finite: the newest checkpoint must be one to resume from."""
        done = self.current_learning_iteration
        weights = [weight for network in self._networks().values() for weight in network.parameters()]
        if not all(bool(weight.isfinite().all()) for weight in weights):
            print(f"WARNING: after iteration {done} the networks are not finite; not saved", flush=True)
            return
        if not self.writer:
            return
        if self.writer.write(done, self._content, self._worlds):
            self.logger.save_model(str(self.writer.written), done)
        if self._curves_lost or self.writer.moved:
            self._curves_lost = False
            self._open_curves()

    def save(self, path: str, infos: dict | None = None) -> None:
        """rsl-rl's method: write one checkpoint atomically. ``learn`` calls ``_save_checkpoint`` instead."""
        save_whole(self._content(infos), Path(path))
        self.logger.save_model(path, self.current_learning_iteration)

    def _content(self, infos: dict | None = None) -> dict[str, Any]:
        """The content of a checkpoint: tensors and Python numbers only."""
        infos = {
            **(infos or {}),
            "total_steps": self.total_steps,
            "random_state": random_state(self.device),
            **self.schedule.saved(),
            "env": self.env.training_state(),
        }
        return {**self.alg.save(), "iter": self.current_learning_iteration, "infos": infos}

    def load(
        self, path: str, load_cfg: dict | None = None, strict: bool = True, map_location: str | None = None
    ) -> dict:
        """Load a checkpoint, and its worlds file if it fits. Raises ConfigError."""
        content = load_tensors(Path(path), map_location or self.device)
        (first, actor), (second, other) = self._networks().items()
        check_fit(content.get(f"{first}_state_dict", {}), actor.state_dict(), Path(path), first)
        for name in (f"{second}_state_dict", "optimizer_state_dict", "iter"):
            if name not in content:
                raise ConfigError(f"{path} holds no {name}; it can be played, but not resumed")
        check_fit(content[f"{second}_state_dict"], other.state_dict(), Path(path), second)
        check_resume(content, Path(path), self._content(), self.alg.optimizer)
        if self.alg.load(content, load_cfg, strict):
            self.current_learning_iteration = content["iter"]
        if isinstance(self.alg, GraphedPPO):  # the value of the last update, so that `_anneal` ends a warm-up
            self.alg.critic_only = 0 < self.current_learning_iteration <= self.cfg["critic_warmup"]
        # a fixed rate comes from the config, which the user may have changed; an adaptive one from the checkpoint
        if getattr(self.alg, "schedule", "fixed") == "fixed":
            self.alg.learning_rate = self.cfg["algorithm"]["learning_rate"]
            for group in self.alg.optimizer.param_groups:
                if not isinstance(group["lr"], Tensor):  # a tensor is set by `alg.learning_rate`
                    group["lr"] = self.alg.learning_rate
        infos = content.get("infos") or {}
        self.total_steps, self.schedule = infos.get("total_steps", 0), TrainingSchedule(used=infos.get("seconds", 0.0))
        self.env.load_training_state(infos.get("env", {}))  # before the random state, because it resets worlds
        random = infos.get("random_state", {})
        self.why_not_exact = first_word(self._restore_worlds(Path(path), random))
        if self.why_not_exact and self.env.cfg.domain_rand.redraw_iterations:
            self.env.domain_rand.redraw()  # the values drawn at the start belong to the first iterations
        if self.gpu_global_rank == 0:
            set_random_state(random, self.device)
        elif self.why_not_exact:  # the checkpoint holds only the first rank's state; other ranks need other numbers
            torch.manual_seed(hash((self.gpu_global_rank, self.total_steps, torch.initial_seed())) % 2**63)
        return infos

    # The worlds are in a separate file, because it is large and not needed to play a policy. It is written before its
    # checkpoint, and the previous worlds file is deleted after, so the newest checkpoint always has its worlds, even
    # if the process is killed.

    def _worlds(self) -> dict[str, Any]:
        """The content of the worlds file: tensors and Python numbers only."""
        return {
            **same_worlds(self.env),
            "random_state": random_state(self.device),
            "worlds": take_snapshot(self.env),
            "memories": {name: state.cpu().clone() for name, state in self._memories().items()},
        }

    def _restore_worlds(self, checkpoint: Path, random: dict[str, Tensor]) -> str:
        """Restore the worlds and hidden states of ``checkpoint``. Returns why this is not possible, or ''.

        ``random``: the random state in the checkpoint.
        """
        rank, here, own = this_rank(), same_worlds(self.env), self._memories()
        file = worlds_file(checkpoint, rank)
        if not file.is_file():
            return f"there is no {file.name} beside it"
        try:
            content = unpack(file.read_bytes(), "cpu")
            there = {key: content[key] for key in here}
            state, worlds, memories = (dict(content[key]) for key in ("random_state", "worlds", "memories"))
        except Exception as error:  # any kind, because the file may hold anything
            return f"{file.name} cannot be read: {' '.join(f'{error}'.split())}"
        same = state.keys() == random.keys() and all(torch.equal(state[key], random[key].cpu()) for key in state)
        if rank.leads and not same:
            return f"{file.name} belongs to another checkpoint"
        if different := first_difference(there, here):
            return different
        if own.keys() != memories.keys() or any(own[key].shape != memories[key].shape for key in own):
            return "the networks' hidden states have another shape"
        if name := beyond(worlds, memory(self.env)) or beyond(memories, own):
            return f"{file.name}: {name} is not finite, or beyond {MOST:.0e}"
        if reason := put_snapshot(self.env, worlds):
            return reason
        with torch.inference_mode():
            for key, value in memories.items():
                own[key].copy_(value)
        if not rank.leads:
            set_random_state(state, self.device)
        return ""

    def _memories(self) -> dict[str, Tensor]:
        """Index -> hidden state of the recurrent networks."""
        states: dict[Any, Any] = getattr(self.alg, "_memories", {})
        return {str(i): state.now for i, state in enumerate(states.values())}


def make_runner(
    env: RobotTask, cfg: RobotTaskCfgPPO, log_dir: Path | None, device: str, teacher: RobotTaskCfgPPO | None = None
) -> Runner:
    """Make a runner. With a ``teacher``'s config it runs distillation. Without ``log_dir`` it writes no files.

    Raises ConfigError for settings that do not fit the environment or rsl-rl.
    """
    half = cfg.runner.matmul_precision == "bf16"
    torch.set_float32_matmul_precision("high" if half else cfg.runner.matmul_precision)
    if (cfg.symmetry.use_data_augmentation or cfg.symmetry.use_mirror_loss) and not cfg.distillation.teacher:
        _ = env.mirror  # raises ConfigError for a row without a mirror image
    try:
        teacher_network = acting(teacher, env, [TEACHER]) if teacher else None
    except ConfigError as error:
        raise ConfigError(f"the teacher's {error}") from None
    try:
        settings = adapt(rsl_rl_config(cfg, env), cfg, teacher_network)
        runner = Runner(env, settings, str(log_dir) if log_dir else None, device)
    except ValueError as error:  # a class, activation, optimizer or observation group that does not exist
        raise ConfigError(f"the learner's config does not fit rsl-rl: {error}") from None
    recorded = isinstance(runner.alg, GraphedPPO)
    if half and isinstance(runner.alg, GraphedPPO):
        runner.alg.learn_in_half()
    if settings["critic_warmup"] and not recorded:
        raise ConfigError(
            f"warm_start.critic_warmup is {settings['critic_warmup']}, but only the recorded PPO knows it; set it to 0"
        )
    if isinstance(policy := runner.alg.get_policy(), RegressingModel) and not recorded:
        who = "a student learns nothing but to act like its teacher" if teacher else "rsl-rl's own is used here"
        raise ConfigError(f"{policy.field}: only GraphedPPO's recorded update trains that, and {who}: set it to []")
    return runner


# ---- the progress of a training -------------------------------------------------------------------------------------


_WINDOW = 50  # iterations; their median duration gives the number of iterations left


class TrainingSchedule:
    """The last iteration of a training and its progress ``done``: 0 in the first iteration, 1 in the last.

    With a ``deadline`` the last iteration is estimated again after each iteration, and ``done`` rises linearly to 1
    over the iterations left. So compilation, exams and checkpoints change the slope, not the end.
    """

    def __init__(self, last: int = 0, deadline: float | None = None, used: float = 0.0) -> None:
        """``last`` iteration, ``deadline`` [s, time.time()]; ``used`` [s]: duration before a resume."""
        self.last = self._wanted = last  # with a deadline ``last`` is an estimate
        self.deadline, self._used, self._begun = deadline, used, time.time()
        room = max(deadline - self._begun, 0.0) if deadline else 0.0
        self.done = used / (used + room) if deadline and used else 0.0
        self._first, self._before, self._times = True, self._begun, deque[float](maxlen=_WINDOW)

    @property
    def seconds(self) -> float:
        """Duration of the training [s], including the time before a resume; 0 if it never had a deadline."""
        return self._used + time.time() - self._begun if self.deadline or self._used else 0.0

    def saved(self) -> dict[str, float]:
        """The entry in a checkpoint. Empty without a deadline: repeated runs then write the same bits."""
        return {"seconds": seconds} if (seconds := self.seconds) else {}

    def begin(self, iteration: int) -> float:
        """Begin an iteration, after ``iteration`` finished ones. Returns ``done``."""
        share = iteration / max(self._wanted - 1, 1)
        if self.deadline:
            step = 0.0 if self._first else (1.0 - self.done) / max(self.last - iteration, 1)
            share = max(self.done + step, share)
        self._first, self.done = False, min(share, 1.0)
        return self.done

    def iterations_left(self) -> float:
        """End an iteration. Returns the number left before the deadline, by the median duration; inf if unknown."""
        now = time.time()
        self._times.append(now - self._before)
        self._before = now
        if self.deadline is None or (len(self._times) == 1 and now < self.deadline):
            return math.inf  # the first iteration may have compiled kernels
        pace = median(self._times if len(self._times) in (1, _WINDOW) else list(self._times)[1:])
        return float(max(0, round((self.deadline - now) / max(pace, 1e-9))))

    def end_after(self, iteration: int, room: float) -> None:
        """Set the last iteration: ``room`` iterations after ``iteration``, at most the requested one."""
        self.last = int(min(self._wanted, iteration + room))


# ---- threads of an update on a CPU ----------------------------------------------------------------------------------


# An update has about a thousand small parallel regions, and each waits for its slowest thread. If another process uses
# one of the cores, all threads wait for it in each region: measured up to 60 times slower than one thread.
_SLOW = 3.0  # ours: an update this many times slower than the previous one starts a trial; noise stays below 2
_GAIN = 1.2  # ours: another number of threads is chosen if it is this many times faster
_PATIENCE = 50  # ours: updates on one thread before a trial of all cores; doubled after a trial without gain


class ThreadChoice:
    """Chooses the number of threads of the next update by the durations of earlier ones. It reads no clock."""

    def __init__(self, few: int, many: int) -> None:
        self.few, self.many = few, many
        self.settled = many  # the chosen number
        self.threads = few  # number for the next update; first ``few``, which is never very slow
        self._times: dict[int, float] = {}  # threads -> duration of the last update [s]
        self._warm, self._since, self._patience = False, 0, _PATIENCE

    def took(self, seconds: float) -> str:
        """Record the duration of an update. Returns a message if the choice changed, else ''."""
        if not self._warm:  # the first update also allocates
            self._warm = True
            return ""
        before, self._times[self.threads] = self._times.get(self.threads), seconds
        if len(self._times) < 2:
            self.threads = self.many
            return ""
        if before is None or self.threads != self.settled:  # it was a trial
            return self._settle()
        self._since += 1
        if self.settled == self.many and seconds > _SLOW * before:
            self.threads = self.few
        elif self.settled == self.few and self._since >= self._patience:
            self.threads = self.many
        return ""

    def _settle(self) -> str:
        before, self.settled = self.settled, better(self._times, self.settled)
        self._patience = 2 * self._patience if self.settled == before == self.few else _PATIENCE
        self.threads, self._since = self.settled, 0
        if self.settled == before:
            return ""
        took = " and ".join(f"{self._times[threads]:.2g} s on {threads}" for threads in (before, self.settled))
        return f"threads of an update: {took}; going on with {self.settled} (cpu.update_threads = 0)"


def better(times: dict[int, float], settled: int) -> int:
    """The fastest number of threads if it is ``_GAIN`` times faster than ``settled``, else ``settled``."""
    quickest = min(times, key=lambda threads: times[threads])
    return quickest if _GAIN * times[quickest] < times[settled] else settled


class UpdateThreads:
    """A context that sets torch's number of threads for an update and restores it: steps are fastest on one thread.

    With ``count`` 0 the number is 1 or ``cores``, whichever is faster. A much slower update starts a new trial.
    """

    def __init__(self, count: int, cores: int) -> None:
        self._fixed = count or cores
        self._choice = ThreadChoice(1, cores) if not count and cores > 1 else None

    def __enter__(self) -> Self:
        self._before = torch.get_num_threads()
        torch.set_num_threads(self._choice.threads if self._choice else self._fixed)
        self._begun = time.perf_counter()
        return self

    def __exit__(self, *error: object) -> None:
        seconds = time.perf_counter() - self._begun
        torch.set_num_threads(self._before)
        if self._choice and error[0] is None and (text := self._choice.took(seconds)):
            print(text, flush=True)
