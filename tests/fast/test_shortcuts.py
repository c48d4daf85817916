"""What is left out of mujoco-warp's step changes nothing: the same state and sensors, bit for bit, as the library's whole step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import mujoco_warp as mjw
import pytest
import torch
import warp as wp
from torch import Tensor
from worlds import make_env

from legged_mw.fast import skip_kernels as shortcuts
from legged_mw.sim.warp_engine import WarpSimulation

WORLDS = 6
SMALL_TERRAIN = {"terrain.num_rows": 1, "terrain.num_cols": 8, "terrain.tile_size": 4.0, "terrain.border_size": 1.0}
# Conditions that solve, sense or integrate differently.
CASES: dict[str, tuple[str, Mapping[str, Any]]] = {
    "one iteration": ("go1_flat", {}),
    "three iterations, sparse rows": ("g1_flat", {}),
    "contacts of our own": ("go1_rough", SMALL_TERRAIN),
    "contact forces": ("go1_flat", {"rewards.scales.feet_contact_forces": -0.01, "sim.iterations": 2}),
}


@pytest.fixture
def whole(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Leaves nothing out from then on."""

    def switch() -> None:
        monkeypatch.setattr(shortcuts, "KNOWN", ())
        monkeypatch.setattr(shortcuts, "countable", lambda model: {})

    return switch


def walk(task: str, settings: Mapping[str, Any], steps: int = 12) -> tuple[list[dict[str, Tensor]], Any]:
    """All that the simulation holds after each step of random actions; half of the worlds are dropped from the air."""
    env = make_env(WORLDS, {**settings, "sim.engine": "mujoco_warp"}, task=task)
    dice, held = torch.Generator().manual_seed(3), []
    env.sim.qpos[::2, 2] += 0.5
    for _ in range(steps):
        env.step(0.7 * torch.randn(WORLDS, env.num_actions, generator=dice))
        held.append(
            {name: value.clone() for name, value in env.sim.memory().items()} | {"contacts": env.contact_count.clone()}
        )
    return held, env


@pytest.mark.parametrize("case", CASES)
def test_a_step_equals_the_whole_one(case: str, whole: Callable[[], None]) -> None:
    short, env = walk(*CASES[case])
    whole()
    long, _ = walk(*CASES[case])
    expected = int(mjw.OverflowType.ITERATIONS)  # nobody asks any more whether the last iteration converged
    for i, (a, b) in enumerate(zip(short, long, strict=True)):
        for name in b:
            left, right = (x[name] & ~expected if name.startswith("overflow") else x[name] for x in (a, b))
            assert torch.equal(left, right), f"{name} after step {i}"
    assert env.sim._shorter._iterations == env.sim._model.opt.iterations
    assert max(int(a["contacts"].max()) for a in short) and min(float(a["contacts"].min()) for a in short) == 0.0


def warp_simulation() -> WarpSimulation:
    sim = make_env(2, {"sim.engine": "mujoco_warp"}).sim
    assert isinstance(sim, WarpSimulation)
    return sim


def launched(sim: WarpSimulation, substeps: int = 2) -> list[str]:
    """Names of the kernels of a control step, those left out too."""
    names, launch, tiled = [], wp.launch, wp.launch_tiled

    def note(real: Callable[..., Any]) -> Callable[..., Any]:
        return lambda kernel, *args, **kwargs: (
            names.append(kernel.key.partition("__locals__")[0]),
            real(kernel, *args, **kwargs),
        )[1]

    wp.launch, wp.launch_tiled = note(launch), note(tiled)
    try:
        sim._substeps(range(substeps), substeps)
    finally:
        wp.launch, wp.launch_tiled = launch, tiled
    return names


def test_what_is_left_out_is_what_the_library_launches(whole: Callable[[], None]) -> None:
    """A kernel that the library calls otherwise in a new version would be launched again, unseen."""
    sim = warp_simulation()
    short, names = sim._shorter, launched(sim)
    idle = {"_gravity_force", "_qfrc_actuator_gravcomp_limits", "_next_activation", "_cfrc_world", "_contact_sort"}
    idle.add("_update_gradient_zero_grad_dot")
    assert short._idle == idle and not idle & {*names}
    once = {"_subtree_com_world", "_site_local_to_global", "_cacc_world"}
    assert short._idle_unsensed | short._idle_later == once and [names.count(name) for name in once] == [1, 1, 1]
    assert names.count("_update_gradient_cholesky") == names.count("_linesearch_iterative_kernel") == 2
    assert names.count("_update_constraint_efc") == 3  # the last substep's forces are sensed
    assert not {
        "_qfrc_constraint_from_grad",
        "_solve_done",
        "_tile_cholesky_factorize_solve_block",
        "_contact_match",
    } & {*names}
    assert wp.launch.__module__.startswith("warp")
    whole()
    names = launched(warp_simulation())
    assert {*names} >= idle | once | {
        shortcuts._SEARCH,
        shortcuts._SOLVED,
        *shortcuts._FORCES,
        "_tile_cholesky_factorize_solve_block",
    }
    assert names.count("_update_gradient_cholesky") == names.count("_update_constraint_efc") == 4


def test_a_world_without_constraint_rows_falls_as_before(whole: Callable[[], None]) -> None:
    """Then the acceleration comes from one Newton step instead of a factorization: equal to rounding."""

    def fall() -> Tensor:
        env = make_env(2, {"sim.engine": "mujoco_warp"})
        model = env.robot.physics
        model.dof_frictionloss[:] = 0.0
        sim = WarpSimulation(model, 2, "cpu", nconmax=8, njmax=40)
        sim.qpos.copy_(env.sim.qpos)
        sim.qpos[:, 2] += 2.0
        sim.qvel[:, 3:] = 0.5
        for _ in range(5):
            sim.step(5)
        assert not int(sim._data.nefc.numpy().max())
        return torch.cat([sim.qpos, sim.qvel], 1)

    short = fall()
    whole()
    torch.testing.assert_close(short, fall(), rtol=1e-5, atol=1e-5)


def test_conditions_that_need_a_launch_keep_it() -> None:
    model, sim = make_env(1).robot.physics, warp_simulation()
    put, data = sim._model, sim._data
    assert "_gravity_force" not in shortcuts.ShortStep(model, put, data, ["body_gravcomp"])._idle
    put.opt.graph_conditional = True  # as many iterations as are needed: nobody knows the last
    assert not shortcuts.ShortStep(model, put, data)._iterations
