"""What one rank of tests/test_ranks.py does: parts, each of which learns a little together with the others and writes its end.

A part is a word: ``learns``; ``asked``, where one rank is asked to stop; ``dies-N``, where one dies in iteration N;
``updates``, of rsl-rl's own learner and the recorded one from equal states and experience. Its folder is of its name.
"""

# ruff: noqa: E402
from __future__ import annotations

from legged_mw.programs import start_quickly
from legged_mw.utils.machine import settle

start_quickly()  # before torch, as train.py does

import os
import sys
import time
from pathlib import Path
from typing import Any

import torch
from learner import collect, difference, make, parameters, share_experience, take_over
from rsl_rl.algorithms import PPO

from legged_mw.rl.ppo import GraphedPPO
from legged_mw.rl.ranks import leave_together, this_rank
from legged_mw.rl.runner import TrainingSchedule, make_runner
from legged_mw.utils.cli import seed_everything
from legged_mw.utils.task import load_task

settle()
place, on_gpus = Path(sys.argv[1]), sys.argv[2] == "gpus"
rank = this_rank()
device = f"cuda:{rank.local}" if on_gpus else "cpu"
if on_gpus:
    torch.cuda.set_device(device)
torch.set_num_threads(1)


def learn(folder: Path, asked: bool, dies_in: int) -> dict[str, Any]:
    task = load_task("go1_flat")
    task.cfg.env.num_envs = 8
    task.cfg.env.episode_length_s = 0.2
    task.train.actor.hidden_dims = task.train.critic.hidden_dims = [16]
    task.train.runner.save_interval = 1
    task.train.runner.num_steps_per_env = 12
    seed_everything(10 + rank.index)
    env = task.env_class(task.cfg, device)
    if asked:
        task.train.actor.estimator.targets = ["base_lin_vel"]
    runner = make_runner(env, task.train, folder if rank.leads else None, device)
    assert isinstance(runner.alg, GraphedPPO)
    act, done = runner.alg.act, []
    # the first rank's clock counts: by the other's own the training is nearly over
    runner.deadline, runner.schedule = (
        time.time() + (1e6 if rank.leads else 1.0),
        TrainingSchedule(used=0.0 if rank.leads else 9.0),
    )

    def mortal_act(obs: object) -> torch.Tensor:
        done.append(runner.schedule.done)
        if rank.index == 1 and len(done) > 12 * dies_in > 0:
            os._exit(3)
        return act(obs)  # type: ignore[arg-type]

    runner.alg.act = mortal_act  # type: ignore[method-assign]
    if asked and not rank.leads:
        runner.stop = "asked"  # one rank alone is asked to stop
    runner.learn(3 if not on_gpus else 8)  # on GPUs long enough to be recorded
    end = {
        "parameters": {k: v.cpu() for k, v in parameters(runner.alg).items()},
        "obs": env.get_observations()["state"].cpu(),
        "means": runner._last_means,
        "iteration": runner.current_learning_iteration,
        "steps": runner.total_steps,
        "stop": runner.stop,
        "rate": runner.alg.learning_rate,
        "done": done[::12],
    }
    runner.alg.release()
    return end


def update() -> dict[str, Any]:
    if not torch.distributed.is_initialized():
        torch.distributed.init_process_group("nccl" if on_gpus else "gloo", rank=rank.index, world_size=rank.count)
    ranks = {"global_rank": rank.index, "local_rank": rank.local, "world_size": rank.count}
    stock, ours = (make(kind, device, multi_gpu=ranks) for kind in (PPO, GraphedPPO))
    assert isinstance(ours, GraphedPPO) and ours.is_multi_gpu
    found = []
    for number in range(6 if on_gpus else 2):  # on GPUs the last three are replayed
        collect(stock, device, seed=100 * rank.index + number)
        share_experience(stock, ours)
        take_over(ours, stock)
        for alg in (stock, ours):
            torch.manual_seed(rank.index)  # each draws the order of its samples first
            alg.update()
        off, rates = difference(parameters(stock), parameters(ours)), (stock.learning_rate, ours.learning_rate)
        found.append({"difference": off, "rates": rates})
    assert ours._update_graph.recorded == on_gpus
    end = {
        "updates": found,
        "parameters": {k: v.cpu() for k, v in parameters(ours).items()},
        "obs": ours.storage.observations["state"].cpu(),
    }
    ours.release()
    return end


for part in sys.argv[3:]:
    word, _, number = part.partition("-")
    end = update() if word == "updates" else learn(place / part, word == "asked", int(number or 0))
    torch.save(end, place / part / f"rank{rank.index}.pt")
    torch.distributed.init_process_group = lambda *_, **__: None  # one connection for all parts
leave_together(rank)
