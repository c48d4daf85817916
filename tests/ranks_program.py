"""What one rank of tests/test_ranks.py does: learn a little together with the others, and write what it ended with."""

# ruff: noqa: E402
from __future__ import annotations

from legged_mw.programs import start_quickly
from legged_mw.utils.machine import settle

start_quickly()  # before torch, as train.py does

import os
import sys
import time
from pathlib import Path

import torch
from learner import parameters

from legged_mw.rl.ppo import GraphedPPO
from legged_mw.rl.ranks import leave_together, this_rank
from legged_mw.rl.runner import TrainingSchedule, make_runner
from legged_mw.utils.cli import seed_everything
from legged_mw.utils.task import load_task

settle()
folder, dies_in, on_gpus = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:] == ["gpus"]
rank = this_rank()
device = f"cuda:{rank.local}" if on_gpus else "cpu"
if on_gpus:
    torch.cuda.set_device(device)
torch.set_num_threads(1)
task = load_task("go1_flat")
task.cfg.env.num_envs = 8
task.cfg.env.episode_length_s = 0.2
task.train.actor.hidden_dims = task.train.critic.hidden_dims = [16]
task.train.runner.save_interval = 1
task.train.runner.num_steps_per_env = 12
seed_everything(10 + rank.index)
env = task.env_class(task.cfg, device)
if dies_in < 0:
    task.train.actor.estimator.targets = ["base_lin_vel"]
runner = make_runner(env, task.train, folder if rank.leads else None, device)
assert isinstance(runner.alg, GraphedPPO)
act, steps, done = runner.alg.act, 0, []
# the first rank's clock counts: by the other's own the training is nearly over
runner.deadline, runner.schedule = (
    time.time() + (1e6 if rank.leads else 1.0),
    TrainingSchedule(used=0.0 if rank.leads else 9.0),
)


def mortal_act(obs: object) -> torch.Tensor:
    global steps
    steps += 1
    done.append(runner.schedule.done)
    if rank.index == 1 and steps > 12 * dies_in > 0:
        os._exit(3)
    return act(obs)  # type: ignore[arg-type]


runner.alg.act = mortal_act  # type: ignore[method-assign]
if dies_in < 0 and not rank.leads:
    runner.stop = "asked"  # one rank alone is asked to stop
runner.learn(3 if not on_gpus else 8)  # on GPUs long enough to be recorded
end = {
    "parameters": {k: v.cpu() for k, v in parameters(runner.alg).items()},
    "obs": env.get_observations()["state"].cpu(),
    "means": runner._last_means,
}
end |= {
    "iteration": runner.current_learning_iteration,
    "steps": runner.total_steps,
    "stop": runner.stop,
    "rate": runner.alg.learning_rate,
}
end["done"] = done[::12]
runner.alg.release()
torch.save(end, folder / f"rank{rank.index}.pt")
leave_together(rank)
