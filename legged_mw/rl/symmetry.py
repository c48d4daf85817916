"""Left-right symmetry for rsl-rl: every sample also as its mirror image. What mirrors how is the environment's to say.

Mittal et al., "Symmetry Considerations for Learning Task Symmetric Robot Policies", ICRA 2024.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_mw.envs.mirror import Columns
from legged_mw.envs.robot_task import RobotTask


def mirror(env: RobotTask, obs: TensorDict | None, actions: Tensor | None) -> tuple[TensorDict | None, Tensor | None]:
    """rsl-rl's ``data_augmentation_func``: observations (2B,) by group and actions (2B, A), the B given first, then their mirror images.

    ``obs`` may hold any of the environment's groups. It asks the host nothing, so that a CUDA graph can record it; look at
    ``env.mirror`` before recording, as its first use makes tensors.
    """
    table = env.mirror
    if obs is not None:
        groups = {name: _with_image(value, table.observations[name]) for name, value in obs.to_dict().items()}
        obs = TensorDict(groups, batch_size=[2 * obs.batch_size[0]], device=obs.device)
    return obs, None if actions is None else _with_image(actions, table.actions)


def _with_image(x: Tensor, columns: Columns) -> Tensor:
    return torch.cat([x, columns(x)])
