"""States of a robot after a drop with its motors off, simulated with MuJoCo's own engine on the host.

The same seed gives the same states on any machine, with any number of threads, for any engine.
"""

from __future__ import annotations

import copy

import mujoco
import numpy as np
from mujoco.batch import Batch

from legged_mw.utils.machine import usable_cores

DAMPING = (0.0, 5.0)  # [N m s/rad] least joint damping: half of the states limp, half braked
VELOCITY = 0.5  # [m/s, rad/s] root velocity at the drop: each axis U(-0.5, 0.5) [MuJoCo Playground's getup]
DEPTH = 0.01  # [m] joints are redrawn where parts overlap by more, since one would be pushed through the other [ours]
_TRIES = 100  # draws of a state's joints; the last one stays
CLEAR = 0.02  # [m] between the lowest point and the ground at the drop
_HIGH = 100.0  # [m] where joints are drawn, away from the ground
_CHUNK = 256  # worlds stepped together; it limits the memory


def fallen(model: mujoco.MjModel, count: int, seed: int, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """qpos (count, nq) and qvel (count, nv), ``seconds`` after a drop with random attitude and joint angles.

    ``model`` has a free joint, then hinges, and the ground z = 0. A smaller ``count`` gives the first of these states.
    """
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_AUTORESET
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.iterations, model.opt.ls_iterations = 50, 50
    starts = _drops(model, count, np.random.default_rng(seed))
    batch = Batch(model, min(_CHUNK, -(-count // 2)), usable_cores())
    result = [np.empty((count, size)) for size in (model.nq, model.nv)]
    for half, damping in enumerate(DAMPING):  # every other state
        batch.expand("dof_damping")[:, 6:] = np.maximum(model.dof_damping[6:], damping)
        for first in range(half, count, 2 * len(batch.state)):
            which = np.arange(first, count, 2)[: len(batch.state)]
            batch.reset(np.arange(len(batch.state)))
            for name, start in zip(("qpos", "qvel"), starts, strict=True):
                batch.bind(name)[: len(which)] = start[which]
            batch.step(nstep=round(seconds / model.opt.timestep))
            for name, states in zip(("qpos", "qvel"), result, strict=True):
                states[which] = batch.bind(name)[: len(which)]
    return result[0], result[1]


def _drops(model: mujoco.MjModel, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Random attitudes, and joint angles within the ranges (+-pi without a range), just above the ground."""
    data, joints = mujoco.MjData(model), slice(1, model.njnt)
    draw = rng.random((count, 9))  # all at once, so that a state does not depend on ``count``
    seeds = rng.spawn(count)
    # [Shoemake 1992: uniform attitudes]
    size, turn = np.sqrt([1.0 - draw[:, 6], draw[:, 6]]), 2.0 * np.pi * draw[:, 7:9].T
    low, high = np.where(model.jnt_limited[joints, None] > 0, model.jnt_range[joints], [-np.pi, np.pi]).T
    qpos, qvel = np.zeros((count, model.nq)), np.zeros((count, model.nv))
    qpos[:, 2], qvel[:, :6] = _HIGH, VELOCITY * (2.0 * draw[:, :6] - 1.0)
    qpos[:, 3:7] = np.concatenate([size * np.sin(turn), size * np.cos(turn)]).T
    touching = (model.geom_bodyid > 0) & (model.geom_conaffinity > 0)
    for state, own in zip(qpos, seeds, strict=True):
        for _ in range(_TRIES):
            state[7:] = own.uniform(low, high)
            data.qpos = state
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)  # in the air: it touches itself alone
            if data.contact.dist[: data.ncon].min(initial=0.0) > -DEPTH:
                break
        state[2] += CLEAR - (data.geom_xpos[touching, 2] - model.geom_rbound[touching]).min()
    return qpos, qvel
