"""The reward terms of every task: ``RobotTask`` inherits them. Each returns (N,) what it measures; its scale gives the sign.

A term is switched on by the number of its name in ``cfg.rewards.scales``, and only reads. What a term has to remember is
made and kept here too, only where it is on; so is what is sensed for it. Nothing of feet or commands: those are in ``legged_rewards``.

Sources: [P] MuJoCo Playground; [L] legged_gym; [U] unitree_rl_gym, which is legged_gym for Unitree's robots; [UL] unitree_rl_lab;
[I] Isaac Lab; [M] mjlab; [HIM] HIMLoco.
"""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from legged_mw.envs.contacts import GroundContacts
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.sim.model import RobotModel
from legged_mw.sim.sensors import ANGULAR_MOMENTUM, SELF_CONTACT, SENSORS
from legged_mw.sim.simulation import Simulation
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
    sim: Simulation
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

    # term -> what is sensed for it where it is on; `asset.sense` names more
    SENSED_FOR: ClassVar[Mapping[str, str]] = {"self_collision": SELF_CONTACT, "angular_momentum": ANGULAR_MOMENTUM}

    last_dof_vel: Tensor | None = None  # (N, D) of the step before [rad/s]; only with `dof_acc`
    last_last_actions: Tensor  # (N, D) a_(t-2); only with `action_smoothness`
    hips: Tensor  # indices of the joints that rewards.hip_joints means; only with `hip_pos`
    mirror_pairs: Tensor  # (2, pairs) indices of the joints that rewards.mirror_joints means; only with `joint_mirror`
    deviation_weights: Tensor  # (D,); only with `joint_deviation`
    soft_effort: Tensor  # (2, D) lowest and highest torque [N m]; only with `torque_limits`
    soft_speed: Tensor  # (D,) [rad/s]; only with `dof_vel_limits`

    def _active_scales(self) -> dict[str, float]:
        """Terms that are on, and their scales."""
        return {name: float(scale) for name, scale in self.cfg.to_dict()["rewards"]["scales"].items() if scale}

    def _sensed_on_demand(self) -> list[str]:
        """Sensors that terms that are on need, and those that ``asset.sense`` names: of ``SENSORS``, or of the robot's file."""
        needed = [sensor for term, sensor in self.SENSED_FOR.items() if term in self._active_scales()]
        return [*needed, *self.cfg.asset.sense]

    def sensor(self, name: str) -> Tensor:
        """(N, size) What a sensor of ``SENSORS`` or of the robot's file measured in the last substep: a view, whose place is fixed."""
        if name in SENSORS:
            if name not in self.robot.sensors:
                raise not_sensed(name)
            return self.sim.sensordata[:, self.robot.sensors[name]]
        if name in self.robot.file_sensors and not self.robot.spec.sensor(name):
            raise ConfigError(
                f"sensor '{name}' of the robot's file was dropped; write asset.sense = ['{name}'] in the config"
            )
        return self.sim.sensordata[:, self.robot.columns(name)]

    @property
    def self_contacts(self) -> Tensor:
        """(N, 1) How many contacts the robot has with itself."""
        return self.sensor(SELF_CONTACT)

    @property
    def angular_momentum(self) -> Tensor:
        """(N, 3) Of the whole robot about its centre of mass, world frame [kg m^2/s]."""
        return self.sensor(ANGULAR_MOMENTUM)

    def _init_robot_rewards(self) -> None:
        """What terms need beside the state, where they are on."""
        on, rewards, robot = self._active_scales(), self.cfg.rewards, self.robot
        known = [*SENSORS, *robot.file_sensors]
        for name in self.cfg.asset.sense:
            if name not in known:
                raise ConfigError(
                    f"asset.sense: {unknown('value or sensor', name, known, f'{type(self).__name__} and its file')}"
                )
        if "dof_acc" in on:
            self.last_dof_vel = torch.zeros_like(self.dof_vel)
        if "hip_pos" in on:
            self.hips = self._joints_called(rewards.hip_joints, "hip_joints")
        if "joint_mirror" in on:
            pairs = [[self._joints_called([word], "mirror_joints") for word in pair] for pair in rewards.mirror_joints]
            for words, pair in zip(rewards.mirror_joints, pairs, strict=True):
                if [len(joints) for joints in pair] != [len(pair[0])] * 2:
                    raise ConfigError(
                        f"rewards.mirror_joints: {words} must be two names or patterns that mean as many joints"
                    )
            self.mirror_pairs = torch.cat([torch.stack(pair) for pair in pairs], dim=1) if pairs else torch.empty(0)
        if "joint_deviation" in on:
            self.deviation_weights = self._row(robot.tables["rewards.deviation_weights"])
        if "torque_limits" in on:
            need(
                bool(np.isfinite(robot.effort_range).any()),
                "torque_limits",
                "no joint has a force limit; write asset.effort",
            )
            self.soft_effort = self._row(robot.effort_range.T * rewards.soft_torque_limit)
        if "dof_vel_limits" in on:
            needed = "no joint has a highest speed; write asset.joint_speed_limits"
            need(bool(np.isfinite(robot.speed_limits).any()), "dof_vel_limits", needed)
            self.soft_speed = self._row(robot.speed_limits) * rewards.soft_dof_vel_limit

    def _row(self, values: object) -> Tensor:
        return torch.as_tensor(values, dtype=torch.float, device=self.device)

    def _columns_for_rewards(self) -> dict[str, int]:
        """What an episode remembers for terms that are on: name -> width."""
        return (
            {"last_last_actions": len(self.robot.joint_names)} if "action_smoothness" in self._active_scales() else {}
        )

    def _joints_called(self, wanted: list[str], field: str) -> Tensor:
        """Indices of the joints whose name fits one of ``wanted``, patterns or parts of names. Held joints are left out."""
        names, held = self.robot.joint_names, self.robot.held
        fits = {word: [name for name in (*names, *held) if fnmatchcase(name, word) or word in name] for word in wanted}
        for word, found in fits.items():
            if not found:
                raise ConfigError(f"rewards.{field}: {unknown('joint', word, names, 'the robot')}")
            if {*found} <= {*held}:
                self.robot.overrides.append(f"rewards.{field}: '{word}' left out, as {', '.join(found)} are held")
        indices = [i for i, name in enumerate(names) if any(name in found for found in fits.values())]
        return torch.tensor(indices, dtype=torch.long, device=self.device)

    def anneal(self, done: float) -> None:
        """A training is ``done`` so far, from 0 to 1: what terms change with it."""

    def _remember_for_rewards(self) -> None:
        """The end of a step: what the next one compares with. ``last_actions`` are still those of the step before."""
        if "last_last_actions" in vars(self):
            self.last_last_actions.copy_(self.last_actions)
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
        """Square of the vertical velocity at the IMU, world frame [m^2/s^2] (gravity points down: the same square). [P]"""
        return (self.base_lin_vel * self.projected_gravity).sum(dim=1).square()

    def _reward_ang_vel_xy(self) -> Tensor:
        """Squared roll and pitch rates, world frame [rad^2/s^2]. [P]"""
        return self.base_ang_vel_world[:, :2].square().sum(dim=1)

    def _reward_orientation(self) -> Tensor:
        """Tilt: gravity's share in the body's plane, equal to the xy share of the body's z axis in the world. [L, P]"""
        return self.projected_gravity[:, :2].square().sum(dim=1)

    def _reward_base_height(self) -> Tensor:
        """Squared distance of the root's height above the ground under it from ``rewards.base_height_target`` [m^2]. [L; U -10]"""
        target = self.cfg.rewards.base_height_target
        need(
            target > 0.0,
            "base_height",
            "rewards.base_height_target is 0; write the wanted height of the root above the ground [m]",
        )
        return (self.base_height - target).square()

    def _reward_angular_momentum(self) -> Tensor:
        """Squared angular momentum of the whole robot about its centre of mass [kg^2 m^4/s^2]. [M; its G1 -0.02]"""
        return self.angular_momentum.square().sum(dim=1)

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
        need(
            bool(self.cfg.rewards.hip_joints),
            "hip_pos",
            "rewards.hip_joints is empty; write names of joints, parts of them or patterns",
        )
        return self.dof_offset.index_select(1, self.hips).square().sum(dim=1)

    def _reward_joint_deviation(self) -> Tensor:
        """Distance of the joints from the default pose [rad], each times its ``rewards.deviation_weights``. [I; its G1 -0.1 for hips]"""
        return (self.dof_offset.abs() * self.deviation_weights).sum(dim=1)

    def _reward_joint_mirror(self) -> Tensor:
        """Squared difference of the angles of two legs' joints, mean over the pairs of ``rewards.mirror_joints`` [rad^2]. [UL]"""
        pairs = self.cfg.rewards.mirror_joints
        need(
            bool(pairs),
            "joint_mirror",
            "rewards.mirror_joints is empty; write pairs of names or patterns, [['FR_*', 'RL_*'], ...]",
        )
        first, second = self.mirror_pairs
        return (self.dof_pos.index_select(1, first) - self.dof_pos.index_select(1, second)).square().sum(dim=1) / len(
            pairs
        )

    def _reward_dof_vel(self) -> Tensor:
        """Squared joint velocities [rad^2/s^2]. [L; U -1e-3]"""
        return self.dof_vel.square().sum(dim=1)

    def _reward_dof_acc(self) -> Tensor:
        """Squared joint accelerations: what the velocity changed by in a control step [rad^2/s^4]. [L, U -2.5e-7]"""
        assert self.last_dof_vel is not None
        return ((self.dof_vel - self.last_dof_vel) / self.dt).square().sum(dim=1)

    def _reward_dof_vel_limits(self) -> Tensor:
        """What joints exceed ``rewards.soft_dof_vel_limit`` of their highest speed by, at most 1 each [rad/s]. [L]"""
        return (self.dof_vel.abs() - self.soft_speed).clamp(0.0, 1.0).sum(dim=1)

    def _reward_fast_joints(self) -> Tensor:
        """What joints are faster than a turn a second, squared [rad^2/s^2]. [P]"""
        return (self.dof_vel.abs() - 2.0 * torch.pi).clamp(min=0.0).square().sum(dim=1)

    def _reward_torque_limits(self) -> Tensor:
        """What torques exceed ``rewards.soft_torque_limit`` of the servo's limit by [N m]. [L]"""
        return (self.torques - self.torques.clamp(*self.soft_effort)).abs().sum(dim=1)

    def _reward_torques(self) -> Tensor:
        """2-norm plus 1-norm of the joint torques [N m] [P]; or the sum of their squares: ``rewards.torques_as`` [L]."""
        if self.cfg.rewards.torques_as == "squares":
            return self.torques.square().sum(dim=1)
        return self.torques.square().sum(dim=1).sqrt() + self.torques.abs().sum(dim=1)

    def _reward_action_rate(self) -> Tensor:
        """Change of the clipped action, squared. [L]"""
        return (self.actions - self.last_actions).square().sum(dim=1)

    def _reward_action_smoothness(self) -> Tensor:
        """Change of the change of the clipped action, squared. [HIM -0.01]"""
        return (self.actions - 2.0 * self.last_actions + self.last_last_actions).square().sum(dim=1)

    def _reward_energy(self) -> Tensor:
        """Sum of |joint velocity * torque| [W]. [P]"""
        return (self.dof_vel * self.torques).abs().sum(dim=1)

    # ---- contacts

    def _reward_collision(self) -> Tensor:
        """How many bodies touch the ground that should not: ``asset.penalize_contacts_on``. [L]"""
        return ((self.contact_count @ self.contacts.penalized) > 0.0).sum(dim=1).float()

    def _reward_self_collision(self) -> Tensor:
        """How many contacts the robot has with itself. [M; its G1 -1]"""
        need(
            self.cfg.asset.self_collisions,
            "self_collision",
            "asset.self_collisions is False, so that parts pass through one another",
        )
        return self.self_contacts[:, 0].clone()


def need(given: bool, term: str, what: str) -> None:
    """Refuse a term that is on without what it needs; terms are tried once before training."""
    if not given:
        raise ConfigError(f"rewards.scales.{term} is on, but {what}")


def not_sensed(name: str) -> ConfigError:
    """What reads ``name``, which nothing asked for."""
    return ConfigError(f"{name} is not sensed; write asset.sense = ['{name}'] in the config")
