"""Rows left out, histories, groups within groups: sizes, order, what the policy sees after a reset, and the mirror image of it."""

from __future__ import annotations

import torch
from torch import Tensor
from worlds import QUIET, STATE, layout, make_env

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.observations import Row


def test_rows_left_out_are_gone_from_the_group_and_from_what_contains_it() -> None:
    env = make_env(3, {**QUIET, "observations.leave_out": {"state": ["base_lin_vel", "commands"]}})
    left = {name: size for name, size in STATE.items() if name not in ("base_lin_vel", "commands")}
    assert layout(env)["state"] == left and env.obs_buf["state"].shape == (3, 42)
    assert layout(env)["privileged_state"]["state"] == 42 and "base_lin_vel" in layout(env)["privileged_state"]
    env.step(torch.randn(3, 12))
    assert torch.equal(env.obs_buf["state"][:, :3], env.base_ang_vel)
    assert env.observations.span("state", "dof_pos") == slice(6, 18)


def test_history_is_oldest_first_within_each_row_and_begins_filled() -> None:
    env = make_env(4, {**QUIET, "observations.history": {"state": 3}})
    assert layout(env)["state"] == {name: 3 * size for name, size in STATE.items()}
    seen: list[Tensor] = []
    for step in range(5):
        if step == 3:
            env.episode_length_buf = torch.tensor([0, env.max_episode_length, 0, 0])  # the second world begins again
        obs = env.step(torch.randn(4, 12))[0]["state"]
        seen.append(env.dof_vel.clone())
        frames = obs[:, env.observations.span("state", "dof_vel")].unflatten(1, (3, 12))
        for back in range(3):
            # at rest before the first step
            expected = seen[max(step - back, 0)] if step - back >= 0 else torch.zeros_like(seen[0])
            assert torch.equal(frames[[0, 2, 3], 2 - back], expected[[0, 2, 3]]), (step, back)
        if step == 3:
            assert torch.equal(frames[1], seen[-1][1].expand(3, 12)), "after a reset every frame is the first one"
    newest = env.observations.newest("state", "dof_vel")
    assert newest == slice(
        env.observations.span("state", "dof_vel").stop - 12, env.observations.span("state", "dof_vel").stop
    )


def test_history_of_one_row_holds_what_the_policy_saw_noise_and_delay_included() -> None:
    env = make_env(
        2,
        {
            "observations.history": {"state.base_ang_vel": 2},
            "domain_rand.enable": True,
            "domain_rand.observation_delay": [1, 1],
        },
    )
    assert layout(env)["state"] == {**STATE, "base_ang_vel": 6}
    span, last = env.observations.span("state", "base_ang_vel"), None
    for _ in range(4):
        frames = env.step(torch.randn(2, 12))[0]["state"][:, span].unflatten(1, (2, 3))
        assert last is None or torch.equal(frames[:, 0], last), (
            "the older frame is the sample of the step before, not a fresh one"
        )
        last = frames[:, 1].clone()


def test_mirrored_history_is_the_history_of_the_mirrored() -> None:
    plain, env = make_env(2, QUIET), make_env(2, {**QUIET, "observations.history": {"state": 2}})
    frames = [torch.randn(2, 48) for _ in range(2)]
    rows = [
        torch.cat([frame.split(list(STATE.values()), dim=1)[i] for frame in frames], dim=1) for i in range(len(STATE))
    ]
    images = [plain.mirror.observations["state"](frame) for frame in frames]
    expected = [
        torch.cat([image.split(list(STATE.values()), dim=1)[i] for image in images], dim=1) for i in range(len(STATE))
    ]
    x = torch.cat(rows, dim=1)
    image = env.mirror.observations["state"](x)
    assert torch.allclose(image, torch.cat(expected, dim=1), atol=1e-6)
    assert torch.allclose(env.mirror.observations["state"](image), x, atol=1e-5)


def test_a_row_has_one_scale_or_one_a_column() -> None:
    class Scaled(LeggedRobot):
        def observation_rows(self) -> dict[str, list[Row | str]]:
            rows = super().observation_rows()
            for name, scale in {"list": [2.0] * 11 + [3], "tuple": (2.0,) * 11 + (3,), "one": 2}.items():
                rows["state"].append(Row(name, self.dof_vel, scale=scale))
            return rows

    env = make_env(2, QUIET, env_class=Scaled)
    env.step(torch.randn(2, 12))
    state, three = env.obs_buf["state"], torch.tensor([2.0] * 11 + [3.0])
    for name, scale in {"list": three, "tuple": three, "one": 2.0}.items():
        assert torch.equal(state[:, env.observations.span("state", name)], env.dof_vel * scale)


def test_a_restart_between_steps_leaves_histories_of_other_worlds() -> None:
    env = make_env(
        3, {"observations.history": {"state": 4}, "domain_rand.enable": True, "domain_rand.observation_delay": [0, 2]}
    )
    for _ in range(5):
        env.step(torch.randn(3, 12))
    before = env.get_observations()
    env.restart(torch.tensor([False, True, False]))
    now = env.get_observations()
    for group in ("state", "privileged_state"):
        assert torch.equal(now[group][[0, 2]], before[group][[0, 2]]) and not torch.equal(
            now[group][1], before[group][1]
        )
    frames = now["state"][1, env.observations.span("state", "dof_vel")].unflatten(0, (4, 12))
    assert torch.equal(frames, frames[-1:].expand(4, 12))
