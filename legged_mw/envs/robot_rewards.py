"""The reward terms of every task: ``RobotTask`` inherits them. Each returns (N,) what it measures; its scale gives the sign.

A term is switched on by the number of its name in ``cfg.rewards.scales``, and only reads. What a term has to remember is
made and kept here too, only where it is on. Nothing of feet or commands: those are in ``legged_rewards``.

Sources: [P] MuJoCo Playground; [L] legged_gym; [U] unitree_rl_gym, which is legged_gym for Unitree's robots.
"""

from __future__ import annotations

from fnmatch import fnmatchcase

import torch
from torch import Tensor

from legged_mw.envs.contacts import GroundContacts
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.sim.model import RobotModel
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown
from legged_mw.utils.math import assign


class RobotRewards:
    """Terms about the base, the joints and what must not touch the ground."""

    # what the terms read: RobotTask makes it
    cfg: RobotTaskCfg
    device: str
    dt: float  # [s]
    robot: RobotModel
    contacts: GroundContacts
    rew_buf: Tensor  # (N,)
    base_lin_vel: Tensor  # (N, 3) body frame [m/s]
    base_ang_vel_world: Tensor  # (N, 3) [rad/s]
    base_height: Tensor  # (N,) [m]
    projected_gravity: Tensor  # (N, 3) body frame
    dof_pos: Tensor  # (N, D) [rad]
    dof_vel: Tensor  # (N, D) [rad/s]
    dof_offset: Tensor  # (N, D) from the default pose [rad]
    torques: Tensor  # (N, D) [N m]
    soft_lower: Tensor  # (D,) [rad]
    soft_upper: Tensor  # (D,) [rad]
    pose_weights: Tensor  # (D,)
    actions: Tensor  # (N, D)
    last_actions: Tensor  # (N, D)
    contact_count: Tensor  # (N, C)
    fell: Tensor  # (N,)

    last_dof_vel: Tensor | None = None  # (N, D) of the step before [rad/s]; only with `dof_acc`
    hips: Tensor  # indices of the joints that rewards.hip_joints means; only with `hip_pos`

    def _active_scales(self) -> dict[str, float]:
        """Terms that are on, and their scales."""
        return {name: float(scale) for name, scale in self.cfg.to_dict()["rewards"]["scales"].items() if scale}

    def _init_robot_rewards(self) -> None:
        """What terms need beside the state, where they are on."""
        on = self._active_scales()
        if "dof_acc" in on:
            self.last_dof_vel = torch.zeros_like(self.dof_vel)
        if "hip_pos" in on:
            self.hips = torch.tensor(self._joints_called(self.cfg.rewards.hip_joints), dtype=torch.long, device=self.device)

    def _joints_called(self, wanted: list[str]) -> list[int]:
        """Joints whose name fits one of ``wanted``, patterns or parts of names. One may fit held joints alone, which are not punished."""
        names, held = self.robot.joint_names, self.robot.held
        fits = {word: [name for name in (*names, *held) if fnmatchcase(name, word) or word in name] for word in wanted}
        for word, found in fits.items():
            if not found:
                raise ConfigError(f"rewards.hip_joints: {unknown('joint', word, names, 'the robot')}")
            if {*found} <= {*held}:
                self.robot.overrides.append(f"rewards.hip_joints: '{word}' left out, as {', '.join(found)} are held")
        return [i for i, name in enumerate(names) if any(name in found for found in fits.values())]

    def _remember_for_rewards(self) -> None:
        """The end of a step: what the next one compares with."""
        if self.last_dof_vel is not None:
            self.last_dof_vel.copy_(self.dof_vel)

    def _forget_for_rewards(self, mask: Tensor) -> None:
        """A new episode begins where ``mask`` (N,) is true: its first step compares with its start."""
        if self.last_dof_vel is not None:
            assign(self.last_dof_vel, mask, self.dof_vel)

    # ---- the base

    def _reward_alive(self) -> Tensor:
        """1 in every step. [U 0.15, P]"""
        return torch.ones_like(self.rew_buf)

    def _reward_lin_vel_z(self) -> Tensor:
        """Square of the vertical velocity at the IMU, world frame (gravity points down, hence the same square). [P]"""
        return (self.base_lin_vel * self.projected_gravity).sum(dim=1).square()

    def _reward_ang_vel_xy(self) -> Tensor:
        """Roll and pitch rates, world frame. [P]"""
        return self.base_ang_vel_world[:, :2].square().sum(dim=1)

    def _reward_orientation(self) -> Tensor:
        """Tilt: gravity's share in the body's plane, equal to the xy share of the body's z axis in the world. [L, P]"""
        return self.projected_gravity[:, :2].square().sum(dim=1)

    def _reward_base_height(self) -> Tensor:
        """Squared distance of the root's height above the ground under it from ``rewards.base_height_target`` [m^2]. [L; U -10]"""
        target = self.cfg.rewards.base_height_target
        need(target > 0.0, "base_height", "rewards.base_height_target is 0; write the wanted height of the root above the ground [m]")
        return (self.base_height - target).square()

    def _reward_termination(self) -> Tensor:
        """A fall. [L, P]"""
        return self.fell.float()

    # ---- the joints

    def _reward_dof_pos_limits(self) -> Tensor:
        """What joints exceed the soft limits by [rad]. [L]"""
        return (self.dof_pos - self.dof_pos.clamp(self.soft_lower, self.soft_upper)).abs().sum(dim=1)

    def _reward_pose(self) -> Tensor:
        """Staying near the default pose, each joint with its weight. [P]"""
        return torch.exp(-(self.dof_offset.square() * self.pose_weights).sum(dim=1))

    def _reward_hip_pos(self) -> Tensor:
        """Squared distance of the joints that ``rewards.hip_joints`` means from the default pose [rad^2]. [U -1]"""
        need(bool(self.cfg.rewards.hip_joints), "hip_pos", "rewards.hip_joints is empty; write names of joints, parts of them or patterns")
        return self.dof_offset.index_select(1, self.hips).square().sum(dim=1)

    def _reward_dof_vel(self) -> Tensor:
        """Squared joint velocities [rad^2/s^2]. [L; U -1e-3]"""
        return self.dof_vel.square().sum(dim=1)

    def _reward_dof_acc(self) -> Tensor:
        """Squared joint accelerations: what the velocity changed by in a control step [rad^2/s^4]. [L, U -2.5e-7]"""
        assert self.last_dof_vel is not None
        return ((self.dof_vel - self.last_dof_vel) / self.dt).square().sum(dim=1)

    def _reward_torques(self) -> Tensor:
        """2-norm plus 1-norm of the joint torques [N m] [P]; or the sum of their squares: ``rewards.torques_as`` [L]."""
        if self.cfg.rewards.torques_as == "squares":
            return self.torques.square().sum(dim=1)
        return self.torques.square().sum(dim=1).sqrt() + self.torques.abs().sum(dim=1)

    def _reward_action_rate(self) -> Tensor:
        """Change of the clipped action. [L]"""
        return (self.actions - self.last_actions).square().sum(dim=1)

    def _reward_energy(self) -> Tensor:
        """Sum of |joint velocity * torque| [W]. [P]"""
        return (self.dof_vel * self.torques).abs().sum(dim=1)

    # ---- the ground

    def _reward_collision(self) -> Tensor:
        """How many bodies touch the ground that should not: ``asset.penalize_contacts_on``. [L]"""
        return ((self.contact_count @ self.contacts.penalized) > 0.0).sum(dim=1).float()


def need(given: bool, term: str, what: str) -> None:
    """Refuse a term that is on without what it needs; terms are tried once before training."""
    if not given:
        raise ConfigError(f"rewards.scales.{term} is on, but {what}")
