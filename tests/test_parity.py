"""Both engines against MuJoCo one world at a time, and against each other: the same model, states and targets, the same motion."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from worlds import QUIET, make_env

from legged_mw import ROOT
from legged_mw.sim.engines import make_simulation
from legged_mw.sim.model import Ground, RobotModel, Solver, build_model

FEET = ["FR", "FL", "RR", "RL"]
HOME = np.array([0, 0, 0.278, 1, 0, 0, 0, *[0.1, 0.9, -1.8, -0.1, 0.9, -1.8] * 2])
STEPS, SUBSTEPS = 50, 5
CONVERGED = Solver(iterations=100, ls_iterations=50)
WORLDS = 3  # each trots with its own stride, so that a mixed-up world shows


def trot(step: int, world: int) -> np.ndarray:
    """Servo targets (12,) [rad]: diagonal pairs swing and lift in turn, at 2 Hz."""
    phase = 2 * np.pi * 2.0 * step * SUBSTEPS * 0.004
    targets = HOME[7:].copy()
    for leg, offset in enumerate((0, np.pi, np.pi, 0)):
        targets[3 * leg + 1] += (0.15 + 0.05 * world) * np.sin(phase + offset)
        targets[3 * leg + 2] -= 0.35 * max(0.0, np.cos(phase + offset))
    return targets


class Pair:
    """The same worlds in an engine and in C MuJoCo, one MjData each, standing in the home pose."""

    def __init__(self, engine: str, solver: Solver) -> None:
        self.robot: RobotModel = build_model(
            ROOT / "resources/robots/go1/go1.xml",
            solver=solver,
            ground=Ground(),
            stiffness={"joint": 35.0},
            damping={"joint": 0.5},
            colliders=FEET,
            self_collisions=False,
            contact_geoms=FEET,
            imu_site="imu",
            sites={foot: [foot] for foot in FEET},
        )
        model = self.robot.physics
        self.sim: Any = make_simulation(model, WORLDS, "cpu", engine=engine, nconmax=8, njmax=40)
        # after put_model, which refuses it: else C resets a broken world
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.c = [mujoco.MjData(model) for _ in range(WORLDS)]
        for data in self.c:
            data.qpos[:] = HOME
        self.copy_state()

    def copy_state(self, warm_start: bool = True) -> None:
        """C's state into the engine; the solver's first guess is a part of it."""
        for world, data in enumerate(self.c):
            self.sim.qpos[world], self.sim.qvel[world] = torch.tensor(data.qpos), torch.tensor(data.qvel)
            if warm_start:
                self.first_guess[world] = torch.tensor(data.qacc_warmstart)

    @property
    def first_guess(self) -> torch.Tensor:
        if self.sim.engine == "mujoco":
            return torch.from_numpy(self.sim._batch.bind("qacc_warmstart"))
        import warp as wp

        return wp.to_torch(self.sim._data.qacc_warmstart)

    def step(self, step: int) -> None:
        """One control step in both."""
        for world, data in enumerate(self.c):
            data.ctrl[:] = trot(step, world)
            self.sim.ctrl[world] = torch.tensor(data.ctrl)
            mujoco.mj_step(self.robot.physics, data, SUBSTEPS)
        self.sim.step(SUBSTEPS)

    def both(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """A field of all worlds: the engine's copied, C's stacked."""
        return getattr(self.sim, name).numpy().copy(), np.stack([getattr(data, name) for data in self.c])


Rollout = dict[str, tuple[np.ndarray, np.ndarray]]


@cache
def roll(engine: str) -> Rollout:
    """Field -> (the engine's, C's), each (step, world, ...), at a converged solver."""
    pair = Pair(engine, CONVERGED)
    frames: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for step in range(STEPS):
        pair.step(step)
        for name in ("qpos", "qvel", "actuator_force", "site_xpos"):
            frames.setdefault(name, []).append(pair.both(name))
        sensed = pair.both("sensordata")
        for name, span in pair.robot.sensors.items():
            frames.setdefault(name, []).append((sensed[0][:, span], sensed[1][:, span]))
    assert pair.sim.overflow_report() == ""
    return {name: (np.stack([f[0] for f in pairs]), np.stack([f[1] for f in pairs])) for name, pairs in frames.items()}


@pytest.fixture(params=["mujoco_warp", "mujoco"])
def engine(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def rollout(engine: str) -> Rollout:
    return roll(engine)


Report = Callable[[str, object], None]

# Absolute tolerances. mujoco-warp computes in float32, whose spacing at 1 is 1.2e-7, and MuJoCo's own engine is handed float32 every
# control step; over 250 substeps with contacts that grew to at most 4e-6 in qpos on any machine tried, and to 5e-4 in an acceleration.
# Each bound leaves ten to fifty times what was seen.
TOLERANCE = {
    "qpos": 4e-5,  # [m], [rad]
    "qvel": 2e-3,  # [m/s], [rad/s]
    "actuator_force": 2e-3,  # [N m]: 35 N m/rad on top of an angle
    "site_xpos": 4e-5,  # [m]
    "linvel": 5e-4,  # [m/s]
    "accelerometer": 1e-2,  # [m/s^2], of a body that knocks on the ground
}


@pytest.mark.parametrize("name", TOLERANCE)
def test_a_converged_engine_agrees_with_c(rollout: Rollout, name: str, record_property: Report) -> None:
    ours, theirs = rollout[name]
    difference = float(np.abs(ours - theirs).max())
    record_property("largest difference", difference)
    print(f"{name}: largest difference {difference:.1e} over {STEPS} control steps")
    assert difference < TOLERANCE[name]


# qpos after so many control steps. Both round to float32, mujoco-warp in every operation and MuJoCo's own engine once a control
# step; contacts amplify what is left, and friction damps it again: seen were 1e-7, 1e-6 and 4e-6.
@pytest.mark.parametrize(("steps", "tolerance"), [(1, 2e-6), (10, 1e-5), (STEPS, 4e-5)])
def test_the_engines_agree_with_each_other(steps: int, tolerance: float, record_property: Report) -> None:
    warp, own = (roll(name)["qpos"][0][steps - 1] for name in ("mujoco_warp", "mujoco"))
    record_property("largest difference", float(np.abs(warp - own).max()))
    assert 0.0 < np.abs(warp - own).max() < tolerance


def test_a_whole_step_of_the_task_agrees() -> None:
    """Observations, rewards and ends of go1_flat, step by step from equal states; what a joystick robot meets in a second."""
    converged = {**QUIET, "sim.iterations": 100, "sim.ls_iterations": 50}
    warp, own = (make_env(8, {**converged, "sim.engine": name}) for name in ("mujoco_warp", "mujoco"))
    dice, landed = torch.Generator().manual_seed(3), 0
    for step in range(25):
        for name in ("qpos", "qvel", "ctrl"):
            getattr(own.sim, name).copy_(getattr(warp.sim, name))
        for name in (
            "commands",
            "_episode",
            "foot_contact",
            "base_ang_vel_world",
            "base_lin_vel",
            "projected_gravity",
            "dof_offset",
        ):
            getattr(own, name).copy_(getattr(warp, name))
        actions = 0.5 * torch.randn(8, 12, generator=dice)
        (obs, reward, done, _), (own_obs, own_reward, own_done, _) = warp.step(actions), own.step(actions)
        assert torch.equal(done, own_done), step
        going = ~done  # a new episode is drawn at random
        landed += int(warp.first_contact.sum())
        torch.testing.assert_close(
            own_reward, reward, rtol=1e-4, atol=1e-6, msg=lambda text, step=step: f"reward, step {step}: {text}"
        )
        for group, width in (("state", 48), ("privileged_state", 123)):
            assert obs[group].shape == (8, width) and torch.isfinite(obs[group]).all()
            torch.testing.assert_close(own_obs[group][going], obs[group][going], rtol=1e-3, atol=2e-3)
    assert landed > 10


def test_feet_touch_the_ground_at_the_same_time(rollout: Rollout) -> None:
    ours, theirs = (found > 0 for found in rollout["contact"])
    assert 0.2 < theirs.mean() < 0.95 and (theirs.any(axis=0) & ~theirs.all(axis=0)).all()  # every foot lifts and lands
    assert (ours != theirs).mean() < 0.01  # one of 600 may graze


def test_it_moves_and_each_world_in_its_own_way(rollout: Rollout) -> None:
    """Else the agreement above would say nothing."""
    qpos = rollout["qpos"][0]
    assert np.abs(qpos[-1, :, 7:] - HOME[7:]).max() > 0.1 and (qpos[..., 3] > 0.9).all()
    for a, b in ((0, 1), (1, 2), (0, 2)):
        assert np.abs(qpos[-1, a] - qpos[-1, b]).max() > 0.01


@pytest.mark.parametrize("warm_start", [True, False], ids=["same first guess", "own first guess"])
def test_spread_of_an_unconverged_solver(warm_start: bool, engine: str, record_property: Report) -> None:
    """At 1 and 5 iterations the engines need not agree: how far apart is one control step from equal states?

    Most steps agree to float32; where a contact comes or goes, the engines stop at different points on the way to the solution.
    The bounds only say that neither engine is broken there.
    """
    pair = Pair(engine, Solver(iterations=1, ls_iterations=5))
    spread = []
    for step in range(STEPS):
        pair.copy_state(warm_start)
        pair.step(step)
        ours, theirs = pair.both("qpos")
        spread.append(np.abs(ours - theirs).max(axis=1))
    figures = {"median": float(np.median(spread)), "largest": float(np.max(spread))}
    for name, value in figures.items():
        record_property(name, value)
    print(
        f"one control step at 1 and 5 iterations, qpos: median {figures['median']:.1e}, largest {figures['largest']:.1e}"
    )
    assert np.isfinite(spread).all() and figures["median"] < 0.02 and figures["largest"] < 0.5
