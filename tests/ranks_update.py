"""What one rank of tests/test_ranks.py does: update rsl-rl's own learner and the recorded one from equal states and experience."""

# ruff: noqa: E402
from __future__ import annotations

from legged_mw.programs import start_quickly
from legged_mw.utils.machine import settle

start_quickly()  # before torch, as train.py does

import sys
from pathlib import Path

import torch
from learner import collect, difference, make, parameters, share_experience, take_over
from rsl_rl.algorithms import PPO

from legged_mw.rl.ppo import GraphedPPO
from legged_mw.rl.ranks import leave_together, this_rank

settle()
folder, rank, on_gpus = Path(sys.argv[1]), this_rank(), sys.argv[2:] == ["gpus"]
device = f"cuda:{rank.local}" if on_gpus else "cpu"
if on_gpus:
    torch.cuda.set_device(device)
torch.set_num_threads(1)
torch.distributed.init_process_group("nccl" if on_gpus else "gloo", rank=rank.index, world_size=rank.count)
ranks = {"global_rank": rank.index, "local_rank": rank.local, "world_size": rank.count}
stock, ours = (make(kind, device, multi_gpu=ranks) for kind in (PPO, GraphedPPO))
assert ours.graphed and ours.is_multi_gpu
found = []
for number in range(6 if on_gpus else 2):  # on GPUs the last three are replayed
    collect(stock, device, seed=100 * rank.index + number)
    share_experience(stock, ours)
    take_over(ours, stock)
    for alg in (stock, ours):
        torch.manual_seed(rank.index)  # each draws the order of its samples first
        alg.update()
    found.append(
        {
            "difference": difference(parameters(stock), parameters(ours)),
            "rates": (stock.learning_rate, ours.learning_rate),
        }
    )
assert ours._update_graph.recorded == on_gpus
end = {
    "updates": found,
    "parameters": {k: v.cpu() for k, v in parameters(ours).items()},
    "obs": ours.storage.observations["state"].cpu(),
}
torch.save(end, folder / f"rank{rank.index}.pt")
ours.release()
leave_together(rank)
