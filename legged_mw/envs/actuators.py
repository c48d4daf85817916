"""From actions to servo targets, with what stands between a policy and its motors: scale, delay, encoders that are off."""

from __future__ import annotations

import torch
from torch import Tensor

from legged_mw.envs.domain_rand import DomainRand
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.sim.model import RobotModel
from legged_mw.sim.simulation import Simulation
from legged_mw.utils.math import assign


class Actuators:
    """Position servos of N robots with D joints: target = origin + scale * action.

    ``control.action_origin`` is the origin: "default" the default pose, "joints" the measured joint angles, "targets" the last targets.
    """

    def __init__(
        self, cfg: type[RobotTaskCfg.control], robot: RobotModel, default: Tensor, dof_pos: Tensor, sim: Simulation, rand: DomainRand
    ) -> None:
        """``default`` (D,) and ``dof_pos`` (N, D) [rad]."""
        self._origin, self._default, self._dof_pos, self._sim = cfg.action_origin, default, dof_pos, sim
        scale = robot.tables["control.action_scale"]
        self.scale = torch.tensor(scale, device=sim.device)  # (D,) [rad]
        self._same_scale = scale[0] if len(set(scale)) == 1 else None  # one number takes one operation less
        self.encoder_offset = rand.values.get("encoder_offset")  # (N, D) [rad], measured minus true angle
        self._delay = rand.delay("action_delay", len(robot.joint_names), start=0.0)
        # (N, D) [rad] as the policy means them; what a servo gets is off by as much as its encoder is
        self.targets = sim.ctrl if self.encoder_offset is None else torch.zeros_like(sim.ctrl)

    def apply(self, actions: Tensor) -> None:
        """Write the servo targets for ``actions`` (N, D)."""
        late = self._delay(actions) if self._delay else actions
        origin = self._default
        if self._origin == "targets":
            origin = self.targets
        elif self._origin == "joints":
            origin = self._dof_pos if self.encoder_offset is None else self._dof_pos + self.encoder_offset
        if self._same_scale is None:
            torch.addcmul(origin, late, self.scale, out=self.targets)
        else:
            torch.add(origin, late, alpha=self._same_scale, out=self.targets)
        if self.encoder_offset is not None:
            torch.sub(self.targets, self.encoder_offset, out=self._sim.ctrl)

    def reset(self, mask: Tensor) -> None:
        """Targets at the default pose where ``mask`` (N,) is true."""
        assign(self.targets, mask, self._default)
        if self.encoder_offset is not None:
            assign(self._sim.ctrl, mask, self._default - self.encoder_offset)
        if self._delay:
            self._delay.restart(mask)
