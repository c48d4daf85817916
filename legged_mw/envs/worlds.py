"""The step of an environment, fused where that can be and pays."""

from __future__ import annotations

from collections.abc import Callable

import torch

from legged_mw.check.held import everything
from legged_mw.envs.robot_task import RobotTask
from legged_mw.fast.fusion import fused

_WORTH_FUSING = 5_000  # control steps: kernels take a CPU seconds to compile, once a machine


def fused_step(env: RobotTask) -> Callable[[], None]:
    """The step of ``env`` fused, if that can be; no world moves and no number is drawn."""
    state = env.sim.memory()
    fields = [value for name, value in state.items() if name.startswith("model.")] if env.sim.engine == "mujoco" else []
    return fused(env._step, env.num_envs, everything(env), fields)


def fuse_for(env: RobotTask, steps: int) -> None:
    """Fuse the step of ``env``, which is to make so many ``steps``: on a CPU now, if that pays; on a GPU before it is recorded."""
    if not env.cfg.sim.fuse or env.eager:
        return
    if str(env.device) != "cpu":
        env._graph.better = lambda: fused_step(env)
    elif steps >= _WORTH_FUSING:
        with torch.inference_mode():
            env._graph.improve(fused_step(env))
