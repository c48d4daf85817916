"""A world that breaks is counted once, ends one episode, and changes nothing in any other world, whatever else happens."""

from __future__ import annotations

import math
import sys

import pytest
import torch
from torch import Tensor

from legged_mw.utils.task import load_task

BUSY = {
    "env.num_envs": 12,
    "perturbation.kick": True,
    "perturbation.push": True,
    "perturbation.push_interval_s": 1.0,
    "domain_rand.enable": True,
    "commands.resampling_time": 0.5,
    "env.episode_length_s": 4.0,
}
# (attribute of the simulator, column, value) of each world that breaks, 20 steps apart; the last is an action
BREAKS = [("qpos", 2, math.nan), ("qvel", -1, math.nan), ("qvel", -1, 1e20), ("action", 0, math.nan)]


def soak(breaks: bool) -> tuple[list[Tensor], int]:
    """Run 90 steps from one seed. What each step handed out, a row a world, and how many worlds were counted as broken."""
    task = load_task("go1_flat")
    for path, value in BUSY.items():
        task.set(path, value)
    torch.manual_seed(1)
    env, handed_out, broken = task.env_class(task.cfg, "cpu"), [], 0
    draws = torch.Generator().manual_seed(1)
    for step in range(90):
        actions = 0.3 * torch.randn(env.num_envs, env.num_actions, generator=draws)
        again = torch.rand(env.num_envs, generator=draws) < 0.1
        if step == 60:
            env.restart(again)
        if breaks and step % 20 == 19:
            world = step // 20
            name, column, value = BREAKS[world]
            (actions if name == "action" else getattr(env.sim, name))[world, column] = value
        seen, reward, ended, _ = env.step(actions)
        handed_out.append(torch.cat([*seen.values(), reward[:, None], ended[:, None].float()], dim=1))
        broken += int(env.broken.sum())
        assert handed_out[-1].isfinite().all()
        assert torch.equal(ended, env.broken | env.fell | env.time_out_buf)
    return handed_out, broken


def test_other_worlds_do_not_notice_a_break(monkeypatch: pytest.MonkeyPatch) -> None:
    """A CPU's step leaves the draws of a reset out where no world ends; here it does not, as a recorded step never does."""
    load_task("go1_flat")
    for name, module in sys.modules.items():
        if name.startswith("legged_mw.envs") and hasattr(module, "maybe_any"):
            monkeypatch.setattr(module, "maybe_any", lambda _: True)
    (whole, none), (hurt, broken) = soak(breaks=False), soak(breaks=True)
    assert (none, broken) == (0, len(BREAKS))
    differ = torch.stack([(one != other).any(dim=1) for one, other in zip(whole, hurt, strict=True)]).any(dim=0)
    assert differ.tolist() == [True] * len(BREAKS) + [False] * (12 - len(BREAKS))
