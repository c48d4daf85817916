"""Go1 on flat ground with the height of its base as a command: an example of your own command."""

import torch

from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class CrouchingRobot(LeggedRobot):
    def _reward_tracking_base_height(self) -> torch.Tensor:
        """Tracks the commanded height of the root above the ground, within about 2 cm."""
        return torch.exp(-((self.base_height - self.commands[:, 3]) / 0.02).square())


class Go1BaseHeightCfg(Go1FlatCfg):
    class commands(Go1FlatCfg.commands):
        units, mirror, default = {"base_height": "m"}, {"base_height": 1.0}, {"base_height": 0.27}

        class ranges(Go1FlatCfg.commands.ranges):
            base_height: list[float] = [0.18, 0.30]  # [m]

    class rewards(Go1FlatCfg.rewards):
        class scales(Go1FlatCfg.rewards.scales):
            tracking_base_height = 1.0
            pose, stand_still = 0.1, -0.1  # the default pose has only one of the heights


TASK = Task(CrouchingRobot, Go1BaseHeightCfg, Go1FlatCfgPPO)
