"""What only a GPU can show: a replayed step is the eager step, and it asks the host nothing."""

from __future__ import annotations

import pytest
import torch

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import load_task

pytestmark = pytest.mark.gpu
DEVICE = "cuda:0"


def make_env(eager: bool, **overrides: object) -> LeggedRobot:
    task = load_task("go1_flat")
    task.set("env.num_envs", 64)
    for path, value in overrides.items():
        task.set(path.replace("__", "."), value)
    torch.manual_seed(3)
    return task.env_class(task.cfg, DEVICE, eager=eager)


def roll_out(env: LeggedRobot, actions: torch.Tensor) -> list[torch.Tensor]:
    torch.manual_seed(5)
    out = []
    for action in actions:
        obs, reward, done, extras = env.step(action)
        out += [obs["state"], obs["privileged_state"], reward, done, extras["time_outs"]]
    return out


def test_replay_equals_eager_over_100_steps() -> None:
    """Bit for bit, with noise, kicks, falls, time outs and resets: the same random numbers are drawn in both."""
    actions = torch.randn(100, 64, 12, generator=torch.Generator().manual_seed(0)).to(DEVICE)
    overrides = {"sim__deterministic": True, "perturbation__enable": True, "env__episode_length_s": 1.0}
    eager, recorded = make_env(True, **overrides), make_env(False, **overrides)
    expected, got = roll_out(eager, actions), roll_out(recorded, actions)
    assert recorded._graph.recorded and not eager._graph.recorded
    assert any(done.any() for done in expected[3::5])
    for i, (a, b) in enumerate(zip(expected, got, strict=True)):
        assert torch.equal(a, b), f"step {i // 5}, output {i % 5}: largest difference {(a.float() - b.float()).abs().max():g}"


def test_step_never_waits_for_the_host() -> None:
    env = make_env(eager=False)
    actions = torch.randn(64, 12, device=DEVICE)
    for _ in range(5):
        env.step(actions)
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(5):
            env.step(actions)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_eager_step_asks_the_host_nothing_either() -> None:
    """Catches a host read that a capture would have refused with a poorer message."""
    env = make_env(eager=True)
    actions = torch.randn(64, 12, device=DEVICE)
    for _ in range(3):
        env.step(actions)
    torch.cuda.set_sync_debug_mode("error")
    try:
        env.step(actions)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_more_iterations_are_recorded_too() -> None:
    """4 iterations are unrolled, 20 are a conditional loop inside the graph."""
    for iterations in (4, 20):
        env = make_env(eager=False, sim__iterations=iterations)
        for _ in range(6):
            _, reward, _, _ = env.step(torch.zeros(64, 12, device=DEVICE))
        assert env._graph.recorded and torch.isfinite(reward).all()
