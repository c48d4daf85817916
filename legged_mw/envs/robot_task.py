"""The base class of all tasks: actions, state, termination, reset, observations, rewards. Read it top to bottom.

``_step`` and all that it calls is recorded as one CUDA graph: fixed buffers, masks instead of index lists, no host
reads. Shapes: N environments, D joints, K reward terms. A reward is a method ``_reward_<name>`` with a number of the
same name in ``cfg.rewards.scales``. It returns (N,) and only reads. The terms are at the end of the file.
``observation_rows`` is the table of the policy's observations, and the only definition of their layout.

Freshness: ``qpos``, ``qvel`` and values computed from them are current. Sensor values (contacts, positions and
velocities of sites, accelerometer, joint torque) are one simulation step old, and zero in a world that was just reset.

Sources of the terms: [P] MuJoCo Playground; [L] legged_gym; [U] unitree_rl_gym, legged_gym for Unitree's robots;
[UL] unitree_rl_lab; [I] Isaac Lab; [M] mjlab; [HIM] HIMLoco.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from fnmatch import fnmatchcase
from functools import cached_property, partial, reduce
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from legged_mw.envs.base_task import BaseTask
from legged_mw.envs.domain_rand import DomainRand, check_draws, world_fields
from legged_mw.envs.mirror import Block, Mirror, check_pose, make_mirror, robot_blocks
from legged_mw.envs.motors import Actuators, Delay, motor_curves, motor_drive, motor_gains, own_law
from legged_mw.envs.observations import Observations, Row, checked_rows
from legged_mw.envs.perturbation import Perturbation
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.envs.statistics import BrokenWorlds, NonFinite, Statistics
from legged_mw.sim.engines import make_simulation, pick_engine
from legged_mw.sim.joints import PARTIAL, posed, some_joints
from legged_mw.sim.mirror import Partners, find_partners
from legged_mw.sim.model import Ground, RobotModel, Solver, build_model, standing_height
from legged_mw.sim.sensors import ANGULAR_MOMENTUM, COM_VELOCITY, SELF_CONTACT, SENSORS
from legged_mw.sim.terrain import Terrain
from legged_mw.utils.commands import Command
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import ModelError, StepError, place_of, unknown
from legged_mw.utils.files import find_file
from legged_mw.utils.math import assign, columns, maybe_any, quat_rotate, quat_rotate_inverse, spread

FIELDS = {  # parameter or table of build_model -> its config field
    **{name: f"control.{name}" for name in ("stiffness", "damping", "stall_torque", "no_load_speed", "gear")},
    **{name: f"asset.{name}" for name in ("imu_site", "colliders", "held_joints", *PARTIAL)},
    "pose": "init_state.default_joint_angles",
    "sites": "asset.foot_names or foot_geoms",  # of those that walk; others have no sites
    "contact_geoms": "asset.penalize_contacts_on or terminate_after_contacts_on",
}


class RobotTask(BaseTask):
    """N robots in N worlds, as one vectorized environment. A task is a subclass with its rewards and rows."""

    cfg: RobotTaskCfg
    exam = ""  # kind of exam of a policy (legged_mw/eval/exams.py); "": none
    command_table: tuple[Command, ...] = ()  # commands of a user to the robot
    commands: Tensor  # (N, C), in the order of command_table; only if that is not empty
    # reward term -> sensor that it needs; `asset.sense` adds others
    SENSED_FOR: ClassVar[Mapping[str, str]] = {"self_collision": SELF_CONTACT, "angular_momentum": ANGULAR_MOMENTUM}

    def __init__(self, cfg: RobotTaskCfg, device: str, eager: bool = False) -> None:
        """Make the environment. The order of the lines matters.

        The robot needs its ground and the sensors of the reward terms. Domain randomization needs the simulation's
        fields. Buffers are views of the simulation, and rows are buffers. Each reward term is called once, so all that
        it reads must exist.
        """
        self.cfg = cfg
        law = self.motor_law
        cfg.check()
        check_draws(cfg, law)
        self.terrain = self._make_terrain()
        self.robot = self._load_robot(pick_engine(cfg.sim.engine, device))
        self.sim = make_simulation(
            self.robot.physics,
            cfg.env.num_envs,
            device,
            engine=cfg.sim.engine,
            nconmax=cfg.sim.nconmax,
            njmax=cfg.sim.njmax,
            threads=cfg.sim.threads,
            world_fields=world_fields(cfg, law),
            terrain=self.terrain,
            eager=eager,
        )
        super().__init__(cfg.env.num_envs, len(self.robot.joint_names), device, eager)
        self.domain_rand = self.remember(DomainRand(cfg, self.robot, self.sim, law))
        self.dt = cfg.sim.dt * cfg.control.decimation  # control step [s]
        self.max_episode_length = math.ceil(cfg.env.episode_length_s / self.dt)
        self._init_ranges()
        self._init_buffers()
        perturbation = Perturbation(cfg.perturbation, self.sim, self.root_body, self.total_mass, self.dt)
        self.perturbation = self.remember(perturbation)
        self._prepare_observations()
        self._prepare_reward_function()
        self.domain_rand.redraw()
        self._reset_all()

    # ---- the step -------------------------------------------------------------------------------------------------

    def _step(self) -> None:
        clip = self.cfg.normalization.clip_actions
        self.actions.clamp_(-clip, clip)
        self.perturbation.apply()
        self._apply_actions()
        self.sim.step(self.cfg.control.decimation, self.actuators.before)
        self._update_state()
        self.check_termination()
        self.compute_reward()
        self._end_step()
        if maybe_any(self.reset_buf):
            self._sum_statistics()
            self.reset_envs(self.reset_buf)
        self.compute_observations()

    def _apply_actions(self) -> None:
        """Compute motor commands from the actions."""
        self.actuators.apply(self.actions)

    def _compute_torques(self, actions: Tensor) -> Tensor:
        """Torques (N, D) [N m] from clipped, delayed ``actions`` (N, D). Force limits and curves apply afterwards.

        If a class overrides this method, it is the motor law and is called before every simulation step. Otherwise the
        law is ``control.actuator``, by default MuJoCo's servo (envs/motors.py), and this method is not called. The body
        is legged_gym's position law, for ``super()._compute_torques(actions)``.
        """
        target = self.default_dof_pos + self.actuators.scale * actions
        return self.p_gains * (target - self.dof_pos) - self.d_gains * self.dof_vel

    @property
    def motor_law(self) -> str:
        """``control.actuator``; "own" for a class that overrides ``_compute_torques``."""
        overridden = type(self)._compute_torques is not RobotTask._compute_torques
        return own_law(self.cfg, type(self).__name__) if overridden else self.cfg.control.actuator

    @property
    def p_gains(self) -> Tensor:
        """``control.stiffness``, (D,), or (N, D) if it is randomized [N m/rad]."""
        return self.actuators.gain("stiffness")

    @property
    def d_gains(self) -> Tensor:
        """``control.damping``, (D,), or (N, D) if it is randomized [N m s/rad]."""
        return self.actuators.gain("damping")

    def _update_state(self) -> None:
        """Compute the values that termination and rewards share."""
        self._episode_length_buf.add_(1)
        self._refresh_base()

    def _refresh_base(self) -> None:
        """Compute joint offsets, and velocity and gravity at the IMU, from qpos and qvel: v_imu = R^T v + w x r."""
        torch.sub(self.dof_pos, self.default_dof_pos, out=self.dof_offset)
        if self.actuators.encoder_offset is not None:
            torch.add(self.dof_offset, self.actuators.encoder_offset, out=self.joint_reading)
        quat, lever = self.root_quat[:, None], torch.linalg.cross(self.base_ang_vel, self.imu_pos)
        in_body = quat_rotate_inverse(quat, torch.stack([self.gravity_dir, self.root_lin_vel], dim=1))
        self.projected_gravity.copy_(in_body[:, 0])
        torch.add(in_body[:, 1], lever, out=self.base_lin_vel)
        self.base_ang_vel_world.copy_(quat_rotate(quat[:, 0], self.base_ang_vel))

    def _end_step(self) -> None:
        """Store this step's values for the next step, after the reward has read the previous ones."""
        if "action_smoothness" in self.reward_names:
            self.last_last_actions.copy_(self.last_actions)
        if self.last_dof_vel is not None:
            self.last_dof_vel.copy_(self.dof_vel)
        self.last_actions.copy_(self.actions)

    # ---- termination ----------------------------------------------------------------------------------------------

    def check_termination(self) -> None:
        """Find episodes that end: by a fall, by a time out, or broken (a state or an action is not finite)."""
        self.broken_worlds.find(self.broken)
        torch.logical_and(self._fallen(), ~self.broken, out=self.fell)
        ended = torch.logical_or(self.fell, self.broken)
        torch.logical_and(self._timed_out(), ~ended, out=self.time_out_buf)
        torch.logical_or(ended, self.time_out_buf, out=self.reset_buf)

    def _fallen(self) -> Tensor:
        """(N,) Falls: too much tilt, too low, or ground contact of a part that must not touch the ground."""
        return reduce(torch.logical_or, self.fall_rules().values())

    def fall_rules(self) -> dict[str, Tensor]:
        """Config field of a cause of a fall -> (N,) worlds with this cause."""
        tilt, low = math.cos(math.radians(self.cfg.termination.max_tilt)), self.cfg.termination.min_base_height
        rules = {"termination.max_tilt": self.projected_gravity[:, 2] > 1e-5 - tilt}  # never true for 180 degrees
        if len(self.terminating_contacts):
            touching = self.contact_count[:, self.terminating_contacts]
            rules["asset.terminate_after_contacts_on"] = touching.amax(dim=1) > 0.0
        return {**rules, "termination.min_base_height": self.base_height < low} if low else rules

    def _timed_out(self) -> Tensor:
        """(N,) Episodes that end without a failure."""
        return self._episode_length_buf >= self.max_episode_length

    # ---- resets: masks, never index lists ---------------------------------------------------------------------------

    def _reset_all(self) -> None:
        self.reset_envs(torch.ones_like(self.reset_buf))
        self.compute_observations()

    def reset_envs(self, mask: Tensor) -> None:
        """Start a new episode where ``mask`` (N,) is true. Other worlds do not change, bit for bit."""
        self._update_curricula(mask & (self.episode_steps[:, 0] > 0.0))
        self.sim.reset(mask)
        self.domain_rand.reset(mask)
        self._reset_robots(mask)
        if self.last_dof_vel is not None:
            assign(self.last_dof_vel, mask, self.dof_vel)  # for the acceleration of the first step
        self._reset_task(mask)
        self.perturbation.reset(mask)
        self._episode.masked_fill_(mask[:, None], 0.0)
        self._episode_length_buf.masked_fill_(mask, 0)
        self._refresh_base()

    def restart(self, mask: Tensor) -> None:
        """Reset the worlds of ``mask`` (N,) between two steps and update their observations only."""
        before = self.observations.remember()
        self.reset_envs(mask)
        self.fell.masked_fill_(mask, False)
        self.compute_observations()
        self.observations.recall(before, ~mask)

    def first_observations(self) -> TensorDict:
        """Observe with empty delays and histories, after a change of state or commands from outside."""
        self.observations.restart(torch.ones_like(self.reset_buf))
        self.compute_observations()
        return self.get_observations()

    def _update_curricula(self, mask: Tensor) -> None:
        """Change the difficulty where ``mask`` (N,) is true: an episode of at least one step ended there."""
        if self.cfg.perturbation.curriculum:
            self.perturbation.update_level(mask, self._share_survived())

    def on_training_progress(self, share: float) -> None:
        """Set what depends on the training's progress ``share`` (0 to 1): the kicks, and what a subclass adds."""
        self.perturbation.anneal(share)

    def _reset_robots(self, mask: Tensor) -> None:
        """Draw root pose and velocity, and joint angles near the default pose. Reset actuators and observations."""
        n = self.num_envs
        draw = torch.rand(n, 9, device=self.device).mul_(2.0).sub_(1.0).mul_(self.reset_range)  # x, y, yaw, velocities
        half = 0.5 * draw[:, 2:3]
        zero = torch.zeros_like(half)
        pose = [self._start_places(draw[:, :2]), torch.cos(half), zero, zero, torch.sin(half)]
        assign(self.sim.qpos, mask, torch.cat([*pose, self._start_angles()], dim=1))
        assign(self.sim.qvel[:, :6], mask, draw[:, 3:])  # ``sim.reset`` has set joint velocities to zero
        if speed := self.cfg.init_state.dof_vel_range:
            assign(self.dof_vel, mask, torch.empty_like(self.dof_offset).uniform_(-speed, speed))
        self.actuators.reset(mask)
        self.observations.restart(mask)

    def _start_angles(self) -> Tensor:
        """Joint angles at the start of an episode (N, D) [rad]: the default pose, or random angles near it."""
        joints, init = self.default_dof_pos.expand(self.num_envs, -1), self.cfg.init_state
        if init.dof_pos_range != [1.0, 1.0]:
            joints = joints * torch.empty_like(self.dof_offset).uniform_(*init.dof_pos_range)
        if init.dof_pos_offset != [0.0, 0.0]:
            joints = joints + torch.empty_like(self.dof_offset).uniform_(*init.dof_pos_offset)
            joints = joints.clamp(self.joint_lower, self.joint_upper)
        return joints

    def _start_places(self, offset: Tensor) -> Tensor:
        """Root position at the start of an episode (N, 3) [m, world]. ``offset`` (N, 2) [m] is added in x and y."""
        place = self.init_pos.expand(self.num_envs, 3)
        return torch.cat([place[:, :2] + offset, place[:, 2:]], dim=1)

    def _reset_task(self, mask: Tensor) -> None:
        """For subclasses: reset other state of the task where ``mask`` (N,) is true."""

    def _share_survived(self) -> Tensor:
        """(N,) Length of the episode, as a share of the longest, from 0 to 1."""
        return torch.where(self.time_out_buf, 1.0, self.episode_steps[:, 0] / self.max_episode_length)

    # ---- observations -----------------------------------------------------------------------------------------------

    def compute_observations(self) -> None:
        """Compute ``obs_buf`` from the table."""
        self.observations.compute()

    def _prepare_observations(self) -> None:
        if hasattr(self, "_observation_rows"):
            raise ConfigError(f"{type(self).__name__}._observation_rows: the method is now called observation_rows")
        rows, cfg = checked_rows(self.observation_rows, self.num_envs), self.cfg
        late = self.domain_rand.values.get("observation_delay")
        delay = None if late is None else partial(Delay, cfg, "observation_delay", late)
        made = Observations(rows, cfg.observations, cfg.noise.level, self.num_envs, self.device, delay)
        self.observations = self.remember(made)
        self.obs_buf = self.observations.buffers

    def observation_rows(self) -> dict[str, list[Row | str]]:
        """Group -> its rows, in order. A string includes an earlier group.

        It is called once, so each value must be a buffer that the step writes in place.
        """
        return {
            "state": [*self._measured_rows()],
            "privileged_state": ["state", *self._body_rows(), *self._disturbance_rows()],  # "state" with the same noise
        }

    def _measured_rows(self) -> list[Row]:
        """Values that a robot measures or estimates, with noise, and its last action."""
        noise = self.cfg.noise.scales
        return [  # velocity, angular velocity and direction of gravity in the body frame, at the IMU
            Row("base_lin_vel", self.base_lin_vel, noise.lin_vel, mirror="imu_velocity", measured=True),  # [m/s]
            Row("base_ang_vel", self.base_ang_vel, noise.ang_vel, mirror="axial", measured=True),  # gyro [rad/s]
            Row("projected_gravity", self.projected_gravity, noise.gravity, mirror="polar", measured=True),
            # minus the default pose [rad]
            Row("dof_pos", self.joint_reading, noise.dof_pos, mirror="joint", measured=True),
            Row("dof_vel", self.dof_vel, noise.dof_vel, mirror="joint", measured=True),  # [rad/s]
            Row("last_actions", self.last_actions, mirror="action"),  # a_t, clipped
        ]

    def _body_rows(self) -> list[Row]:
        """The same values without noise, and others that only a simulator has."""
        return [
            Row("base_ang_vel", self.base_ang_vel, mirror="axial"),
            Row("accelerometer", self.accelerometer, mirror="polar"),  # proper acceleration at the IMU [m/s^2]
            Row("projected_gravity", self.projected_gravity, mirror="polar"),
            Row("base_lin_vel", self.base_lin_vel, mirror="imu_velocity"),
            Row("base_ang_vel_world", self.base_ang_vel_world, mirror="axial"),  # [rad/s]; mirrored in the world's x-z
            Row("dof_pos", self.dof_offset, mirror="joint"),
            Row("dof_vel", self.dof_vel, mirror="joint"),
            Row("torques", self.torques, mirror="joint"),  # [N m]
        ]

    def _disturbance_rows(self) -> list[Row]:
        """Kicks, and with ``domain_rand.observe`` the randomized values, in the units of the config."""
        rand, kick = self.domain_rand, self.perturbation
        drawn = rand.values.items() if self.cfg.domain_rand.observe else ()
        return [
            Row("kick_force", kick.kick_force, mirror="polar"),  # on the root, world frame [N]
            Row("kick_active", kick.kick_active[:, None], mirror="scalar"),  # 0 or 1
            *(Row(name, value, mirror=rand.mirrors[name]) for name, value in drawn),
        ]

    @cached_property
    def mirror(self) -> Mirror:
        """The mirror image of observations and actions, made from the table. The step does not use it."""
        return make_mirror(self.observations.groups, self._mirror_blocks(), self.mirror_reach, self.device)

    def _mirror_blocks(self) -> dict[str, Block]:
        """Name -> kind of mirror image, for rows."""
        partners = self._partners()
        check_pose(self.robot.joint_names, self.default_dof_pos.tolist(), partners)
        return robot_blocks(partners, self.robot.tables["control.action_scale"])

    def _partners(self) -> Partners:
        return find_partners(self.robot)

    # ---- reward -----------------------------------------------------------------------------------------------------

    def compute_reward(self) -> None:
        """Sum scale * term * dt over the terms, and clip; ``termination`` is added after that. Broken worlds get 0."""
        rewards = self.cfg.rewards
        total = torch.zeros_like(self.rew_buf)
        if self._reward_terms:
            terms = torch.stack([term() for term in self._reward_terms], dim=1).mul_(self.reward_scales)
            terms.masked_fill_(self.broken[:, None], 0.0)
            self.nonfinite[0].clear(terms)
            total = terms[:, : self._num_clipped].sum(dim=1)
            total.clamp_(0.0 if rewards.only_positive_rewards else None, rewards.max_reward)
            if self._num_clipped < len(self.reward_names):
                total += terms[:, self._num_clipped]
            self.episode_sums.add_(terms)
        self.rew_buf.copy_(total)
        self.episode_return.add_(total[:, None])
        self.episode_steps.add_(1.0)

    def _prepare_reward_function(self) -> None:
        """Find the method of each scale and call it once, so that errors appear before training. Raises ConfigError."""
        scales = self._active_scales()
        methods = [name for name in dir(self) if name.startswith("_reward_")]
        terms = {name.removeprefix("_reward_"): getattr(self, name) for name in methods}
        after_clip = [] if self.cfg.rewards.clip_termination else ["termination"]
        self.reward_names = [n for n in scales if n not in after_clip] + [n for n in after_clip if n in scales]
        self._num_clipped = len([n for n in scales if n not in after_clip])
        for name in self.reward_names:
            if name not in terms:
                where = f"{type(self).__name__} (a method _reward_<name>)"
                what = unknown("reward term", name, terms, where)
                raise ConfigError(f"rewards.scales.{name} = {scales[name]:g}: {what}")
            check_term(terms[name], self.num_envs)
        self._reward_terms = [terms[name] for name in self.reward_names]
        bad_terms = self.remember(NonFinite([f"reward term '{name}'" for name in self.reward_names], self.device))
        self.nonfinite = [bad_terms, *self.observations.nonfinite()]
        # (K,) ``rewards.scales`` times dt, as in legged_gym: the reward of a step is this times the term
        self.reward_scales = self._tensor([scales[name] for name in self.reward_names]) * self.dt
        means = [*(f"rew_{name}" for name in self.reward_names), "reward", "episode_length"]
        self.statistics = self.remember(Statistics(means, ["episodes", "fell", "broken"], self.device))

    # ---- statistics: summed on the device, read once per iteration --------------------------------------------------

    def _sum_statistics(self) -> None:
        """Add the episodes that end in this step. Call it before the reset."""
        means = torch.cat([self.episode_sums, self.episode_return, self.episode_steps], dim=1)
        self.statistics.add(self.reset_buf, means, torch.stack([self.reset_buf, self.fell, self.broken], dim=1))

    def _live_statistics(self) -> dict[str, Tensor]:
        """Name -> current value: () a sum, or (2,) sum and count, so that ranks can be summed."""
        worlds = {"overflowed": self.sim.overflowed_worlds(), **self.broken_worlds.statistics()}  # totals
        return worlds | self.perturbation.statistics()

    def take_statistics(self) -> Tensor:
        """Sums since the last call and current values (S,), on the device."""
        return self.statistics.take(self._live_statistics())

    def name_statistics(self, taken: list[float]) -> dict[str, float]:
        """Name -> statistic, from the vector of ``take_statistics``. Means are NaN if no episode ended.

        ``rew_<name>``: mean over episodes of the sum of scale * term * dt, before the clip, divided by
        ``env.episode_length_s``. ``reward``: mean return. ``episode_length``: mean length [control steps].
        """
        seconds = self.cfg.env.episode_length_s
        named = self.statistics.name(taken)
        return {name: value / seconds if name.startswith("rew_") else value for name, value in named.items()}

    def read_statistics(self) -> dict[str, float]:
        """Name -> statistic since the last call. Waits for the device."""
        return self.name_statistics(self.take_statistics().tolist())

    # ---- curricula in a checkpoint ----------------------------------------------------------------------------------

    def training_state(self) -> dict[str, Tensor]:
        """Name -> tensor of the curricula's state."""
        return {"kick_level": self.perturbation.kick_level.clone()} if self.cfg.perturbation.curriculum else {}

    def load_training_state(self, state: dict[str, Tensor]) -> None:
        """Load the ``training_state`` of rank 0. For another number of worlds it is spread over them."""
        if "kick_level" in state and self.cfg.perturbation.curriculum:
            self.perturbation.kick_level.copy_(spread(state["kick_level"], self.num_envs))

    # ---- robot and buffers: made here, never rebound ----------------------------------------------------------------

    def _make_terrain(self) -> Terrain | None:
        """The terrain; None: a plane."""
        return None

    def _load_robot(self, engine: str) -> RobotModel:
        sensed = self._sensed_geoms(), self._sensed_sites(), self._sensed_on_demand()
        return load_robot(self.cfg, self.motor_law, engine, self.terrain, *sensed)

    def _sensed_geoms(self) -> list[str]:
        """Names or patterns of geoms whose ground contacts are counted."""
        return [*self.cfg.asset.penalize_contacts_on, *self.cfg.asset.terminate_after_contacts_on]

    def _sensed_sites(self) -> dict[str, list[str]]:
        """Site with a velocity sensor -> geoms. A site that is not in the MJCF is made at their lowest point."""
        return {}

    def _init_buffers(self) -> None:
        n, device, sim, spans = self.num_envs, self.device, self.sim, self.robot.sensors
        self.root_pos, self.root_quat = sim.qpos[:, :3], sim.qpos[:, 3:7]  # views [m, world], wxyz
        self.root_lin_vel, self.base_ang_vel = sim.qvel[:, :3], sim.qvel[:, 3:6]  # views [m/s, world], [rad/s, body]
        self.dof_pos, self.dof_vel = sim.qpos[:, 7:], sim.qvel[:, 6:]  # views (N, D) [rad], [rad/s]
        self.torques = sim.actuator_force  # view (N, D) [N m]
        self.contact_count = sim.sensordata[:, spans["contact"]]  # view (N, C), of robot.contact_geoms with the ground
        self.accelerometer = sim.sensordata[:, spans["accelerometer"]]  # view (N, 3) [m/s^2]
        self.base_lin_vel, self.projected_gravity, self.base_ang_vel_world = (self.buffer(3) for _ in range(3))
        self.dof_offset = self.buffer(self.num_actions)  # joint position minus default [rad]
        law, drawn, default = self.motor_law, self.domain_rand.values, self.default_dof_pos
        actuators = Actuators(self.cfg, law, self.robot, sim, drawn, default, self._compute_torques)
        self.actuators = self.remember(actuators)
        exact = actuators.encoder_offset is None
        self.joint_reading = self.dof_offset if exact else self.buffer(self.num_actions)  # measured dof_offset
        self.base_height = self.root_pos[:, 2]  # height of the root above the ground [m]
        self.fell, self.broken = self.buffer(dtype=torch.bool), self.buffer(dtype=torch.bool)
        broken_worlds = BrokenWorlds(sim, self.actions, self.robot.joint_names, self.cfg.termination.max_speed)
        self.broken_worlds = self.remember(broken_worlds)
        self._episode, views = columns(n, device, **self._episode_columns())  # one matrix, cleared in one operation
        self.remember(self._episode)
        for name, view in views.items():
            setattr(self, name, view)
        model = self.robot.physics
        self.gravity_dir = self.domain_rand.gravity_dir  # (N, 3) world frame
        self.total_mass = float(model.body_subtreemass[0])  # [kg]
        self.root_body = self.robot.id("body", self.robot.root)
        imu = self.robot.id("site", self.robot.imu)
        self.imu_pos = self._tensor(model.site_pos[imu]).expand(n, 3)  # body frame [m]
        self.mirror_reach = 2.0 * float(self.imu_pos[0, 1])  # [m] from the mirrored IMU to the IMU
        self._init_contacts()
        self._init_robot_rewards()

    def _init_contacts(self) -> None:
        """Find the columns of contact_count for ``asset.terminate_after_contacts_on`` and ``penalize_contacts_on``."""
        asset, robot = self.cfg.asset, self.robot
        fall = self._contact_columns(asset.terminate_after_contacts_on, "terminate_after_contacts_on")
        self.terminating_contacts = torch.tensor(fall, dtype=torch.long, device=self.device)
        columns = self._contact_columns(asset.penalize_contacts_on, "penalize_contacts_on")
        if "collision" in self._active_scales():
            require(bool(columns), "collision", "asset.penalize_contacts_on names nothing; name what should not touch")
        geoms = [robot.id("geom", robot.contact_geoms[column]) for column in columns]
        body_of = [int(robot.physics.geom_bodyid[geom]) for geom in geoms]
        bodies = sorted(set(body_of))
        table = torch.zeros(self.contact_count.shape[1], len(bodies))
        for column, body in zip(columns, body_of, strict=True):
            table[column, bodies.index(body)] = 1.0
        self.penalized_contacts = table.to(self.device)  # (C, bodies) 1 where a sensed geom belongs to a penalised body

    def _contact_columns(self, patterns: list[str], field: str) -> list[int]:
        """Columns of contact_count for the geoms of ``patterns``. Raises ConfigError for a geom that cannot collide."""
        asset, robot = self.cfg.asset, self.robot
        meant = robot.names.find(patterns, f"asset.{field}")
        for name in meant:
            if not robot.physics.geom_conaffinity[robot.id("geom", name)]:
                what = f"'{name}' never touches the ground; add it to asset.colliders: {asset.colliders}"
                raise ConfigError(f"asset.{field}: {what}")
        return [i for i, name in enumerate(robot.contact_geoms) if name in meant]

    def _episode_columns(self) -> dict[str, int]:
        """Name -> width of the attributes (N, width) that a reset sets to 0. Subclasses add theirs."""
        on, joints = self._active_scales(), self.num_actions
        sums = {"episode_sums": len(on), "episode_return": 1, "episode_steps": 1}
        before = {"last_last_actions": joints} if "action_smoothness" in on else {}
        return {"last_actions": joints, **sums, **before}

    last_actions: Tensor  # (N, D)
    last_last_actions: Tensor  # (N, D) a_(t-2); only with `action_smoothness`
    last_dof_vel: Tensor | None = None  # (N, D) of the previous step [rad/s]; only with `dof_acc`
    episode_sums: Tensor  # (N, K) scale * term * dt summed over the episode
    episode_return: Tensor  # (N, 1)
    episode_steps: Tensor  # (N, 1) steps since the reset; episode_length_buf may start at another value

    def _init_ranges(self) -> None:
        """Make tensors of the config's tables per joint and of the ranges of a reset."""
        cfg, init = self.cfg, self.cfg.init_state
        self.default_dof_pos = self._tensor(self.robot.pose)
        self.pose_weights = self._tensor(self.robot.tables["rewards.pose_weights"])  # (D,)
        self.deviation_weights = self._tensor(self.robot.tables["rewards.deviation_weights"])  # (D,)
        self.ratings = motor_ratings(cfg, self.robot)
        rated = self.ratings["continuous_torque"]
        share = 1.0 / max(sum(torque is not None for torque in rated), 1)  # weight of a rated joint in their mean
        self.heat_weights = self._tensor([share / torque**2 if torque else 0.0 for torque in rated])  # (D,) [1/(N m)^2]
        self.joint_lower, self.joint_upper = self._tensor(self.robot.joint_range).unbind(dim=1)
        # `soft_dof_pos_limit` x range of each joint, about its middle; infinite without limits
        middle = (self.joint_lower + self.joint_upper) / 2
        half = (self.joint_upper - self.joint_lower) / 2 * cfg.rewards.soft_dof_pos_limit
        self.soft_lower = torch.where(half.isfinite(), middle - half, self.joint_lower)
        self.soft_upper = torch.where(half.isfinite(), middle + half, self.joint_upper)
        self.start_place = start_place(cfg, self.robot, cfg.asset.colliders)  # root position at reset [m]
        self.init_pos = self._tensor(self.start_place)
        spans = [init.pos_xy_range] * 2 + [init.yaw_range] + [init.lin_vel_range] * 3 + [init.ang_vel_range] * 3
        self.reset_range = self._tensor(spans)  # (9,)

    def _tensor(self, values: object) -> Tensor:
        return torch.tensor(values, dtype=torch.float, device=self.device)

    # ---- reward terms, and buffers that only some terms need --------------------------------------------------------

    def _active_scales(self) -> dict[str, float]:
        """Active reward term -> its ``rewards.scales``, without dt."""
        return {name: float(scale) for name, scale in self.cfg.to_dict()["rewards"]["scales"].items() if scale}

    def _sensed_on_demand(self) -> list[str]:
        """Sensors that active terms or ``asset.sense`` need: names of ``SENSORS``, or of the robot's file."""
        needed = [sensor for term, sensor in self.SENSED_FOR.items() if term in self._active_scales()]
        return [*needed, *self.cfg.asset.sense]

    def sensor(self, name: str) -> Tensor:
        """View (N, size) of the sensor ``name``, in ``SENSORS`` or the robot's file. Raises ConfigError without it."""
        if name in SENSORS:
            if name not in self.robot.sensors:
                raise not_sensed(name)
            return self.sim.sensordata[:, self.robot.sensors[name]]
        if name in self.robot.file_sensors and not self.robot.spec.sensor(name):
            what = f"sensor '{name}' of the robot's file was dropped"
            raise ConfigError(f"{what}; write asset.sense = ['{name}'] in the config")
        return self.sim.sensordata[:, self.robot.columns(name)]

    @property
    def self_contacts(self) -> Tensor:
        """(N, 1) Number of contacts of the robot with itself."""
        return self.sensor(SELF_CONTACT)

    @property
    def angular_momentum(self) -> Tensor:
        """(N, 3) Angular momentum of the whole robot about its centre of mass, world frame [kg m^2/s]."""
        return self.sensor(ANGULAR_MOMENTUM)

    @property
    def com_velocity(self) -> Tensor:
        """(N, 3) Velocity of the whole robot's centre of mass, world frame [m/s]."""
        return self.sensor(COM_VELOCITY)

    def _init_robot_rewards(self) -> None:
        """Make the buffers that only active reward terms need. Raises ConfigError if a term lacks something."""
        on, rewards, robot = self._active_scales(), self.cfg.rewards, self.robot
        known = [*SENSORS, *robot.file_sensors]
        for name in self.cfg.asset.sense:
            if name not in known:
                where = f"{type(self).__name__} and its file"
                raise ConfigError(f"asset.sense: {unknown('value or sensor', name, known, where)}")
        if "dof_acc" in on:
            self.last_dof_vel = self.buffer(self.num_actions)
        if "hip_pos" in on:
            self.hips = self._joints_called(rewards.hip_joints, "hip_joints")  # indices
        if "joint_mirror" in on:
            pairs = [[self._joints_called([word], "mirror_joints") for word in pair] for pair in rewards.mirror_joints]
            for words, (first, second) in zip(rewards.mirror_joints, pairs, strict=True):
                if len(first) != len(second):
                    what = f"{words} must be two names or patterns that mean as many joints"
                    raise ConfigError(f"rewards.mirror_joints: {what}")
            # (2, pairs) indices of joints
            self.mirror_pairs = torch.cat([torch.stack(pair) for pair in pairs], dim=1) if pairs else torch.empty(0)
        if "trunk_orientation" in on:
            self.trunk = int(np.argmax(robot.physics.body_mass))  # the heaviest body
            level = posed(robot.physics, robot.pose).xmat[self.trunk].reshape(3, 3)
            self.trunk_up = self._tensor(level[2]).expand(self.num_envs, 3)  # vertical in its frame, default pose
        if "torque_limits" in on:
            self._need_force_limits("torque_limits")
            self.soft_effort = self._tensor(robot.effort_range.T * rewards.soft_torque_limit)  # (2, D) low, high [N m]
        if "dof_vel_limits" in on:
            limited = bool(np.isfinite(robot.speed_limits).any())
            require(limited, "dof_vel_limits", "no joint has a highest speed; write asset.joint_speed_limits")
            self.soft_speed = self._tensor(robot.speed_limits) * rewards.soft_dof_vel_limit  # (D,) [rad/s]

    def _need_force_limits(self, term: str) -> None:
        """Raise ConfigError if no joint has a force limit, of which ``term`` takes shares."""
        limited = bool(np.isfinite(self.robot.effort_range).any())
        require(limited, term, "no joint has a force limit; write asset.effort")

    def _joints_called(self, wanted: list[str], field: str) -> Tensor:
        """Indices of the joints that match ``wanted`` (patterns or parts of names), without held joints."""
        names, held = self.robot.joint_names, self.robot.held
        fits = {word: [name for name in (*names, *held) if fnmatchcase(name, word) or word in name] for word in wanted}
        for word, joints in fits.items():
            if not joints:
                raise ConfigError(f"rewards.{field}: {unknown('joint', word, names, 'the robot')}")
            if {*joints} <= {*held}:
                self.robot.overrides.append(f"rewards.{field}: '{word}' left out, as {', '.join(joints)} are held")
        indices = [i for i, name in enumerate(names) if any(name in joints for joints in fits.values())]
        return torch.tensor(indices, dtype=torch.long, device=self.device)

    def _reward_alive(self) -> Tensor:
        """1 in every step. [U 0.15, P]"""
        return torch.ones_like(self.rew_buf)

    def _reward_lin_vel_z(self) -> Tensor:
        """Squared vertical velocity at the IMU, world frame [m^2/s^2] (gravity points down: the same square). [P]"""
        return (self.base_lin_vel * self.projected_gravity).sum(dim=1).square()

    def _reward_ang_vel_xy(self) -> Tensor:
        """Squared roll and pitch rates, world frame [rad^2/s^2]. [P]"""
        return self.base_ang_vel_world[:, :2].square().sum(dim=1)

    def _reward_orientation(self) -> Tensor:
        """Tilt: gravity's share in the body's plane, equal to the xy share of the body's z axis in the world. [L, P]"""
        return self.projected_gravity[:, :2].square().sum(dim=1)

    def _reward_trunk_orientation(self) -> Tensor:
        """Squared sine of the tilt of the heaviest body, such as a humanoid's torso; level in the default pose. [ours]"""
        return quat_rotate(self.sim.xquat[:, self.trunk], self.trunk_up)[:, :2].square().sum(dim=1)

    def _reward_base_height(self) -> Tensor:
        """Squared error of the root's height above the ground from ``rewards.base_height_target`` [m^2]. [L; U -10]"""
        target = self.cfg.rewards.base_height_target
        require(target > 0.0, "base_height", "rewards.base_height_target is 0; write the wanted height of the root [m]")
        return (self.base_height - target).square()

    def _reward_angular_momentum(self) -> Tensor:
        """Squared angular momentum of the whole robot about its centre of mass [kg^2 m^4/s^2]. [M; its G1 -0.02]"""
        return self.angular_momentum.square().sum(dim=1)

    def _reward_termination(self) -> Tensor:
        """A fall. [L, P]"""
        return self.fell.float()

    def _reward_dof_pos_limits(self) -> Tensor:
        """Angles beyond the joints' soft limits [rad]. [L]"""
        return (self.dof_pos - self.dof_pos.clamp(self.soft_lower, self.soft_upper)).abs().sum(dim=1)

    def _reward_target_limits(self) -> Tensor:
        """Targets of the servos beyond the joints' soft limits [rad]; a servo turns to its range at most. [ours]"""
        by_angle = self.motor_law in ("servo", "dc_motor", "network") and self.cfg.control.action_origin != "speed"
        require(by_angle, "target_limits", "actions are no angles under this motor law (docs/motors.md)")
        targets = self.actuators.targets
        return (targets - targets.clamp(self.soft_lower, self.soft_upper)).abs().sum(dim=1)

    def _reward_pose(self) -> Tensor:
        """Staying near the default pose, each joint with its weight. [P]"""
        return torch.exp(-(self.dof_offset.square() * self.pose_weights).sum(dim=1))

    def _reward_hip_pos(self) -> Tensor:
        """Squared distance of the joints ``rewards.hip_joints`` from the default pose [rad^2]. [U -1]"""
        needed = "rewards.hip_joints is empty; write names of joints, parts of them or patterns"
        require(bool(self.cfg.rewards.hip_joints), "hip_pos", needed)
        return self.dof_offset.index_select(1, self.hips).square().sum(dim=1)

    def _reward_joint_deviation(self) -> Tensor:
        """Distance of joints from the default pose [rad], times ``rewards.deviation_weights``. [I; G1's hips -0.1]"""
        return (self.dof_offset.abs() * self.deviation_weights).sum(dim=1)

    def _reward_joint_mirror(self) -> Tensor:
        """Squared difference of two legs' joint angles, mean over the pairs ``rewards.mirror_joints`` [rad^2]. [UL]"""
        pairs = self.cfg.rewards.mirror_joints
        needed = "rewards.mirror_joints is empty; write pairs of names or patterns, [['FR_*', 'RL_*'], ...]"
        require(bool(pairs), "joint_mirror", needed)
        first, second = self.mirror_pairs
        apart = self.dof_pos.index_select(1, first) - self.dof_pos.index_select(1, second)
        return apart.square().sum(dim=1) / len(pairs)

    def _reward_dof_vel(self) -> Tensor:
        """Squared joint velocities [rad^2/s^2]. [L; U -1e-3]"""
        return self.dof_vel.square().sum(dim=1)

    def _reward_dof_acc(self) -> Tensor:
        """Squared joint accelerations, from the change of velocity in a control step [rad^2/s^4]. [L, U -2.5e-7]"""
        assert self.last_dof_vel is not None
        return ((self.dof_vel - self.last_dof_vel) / self.dt).square().sum(dim=1)

    def _reward_dof_vel_limits(self) -> Tensor:
        """Joint speeds beyond ``rewards.soft_dof_vel_limit`` of the highest, at most 1 each [rad/s]. [L]"""
        return (self.dof_vel.abs() - self.soft_speed).clamp(0.0, 1.0).sum(dim=1)

    def _reward_fast_joints(self) -> Tensor:
        """Squared joint speeds beyond one turn per second [rad^2/s^2]. [P]"""
        return (self.dof_vel.abs() - 2.0 * torch.pi).clamp(min=0.0).square().sum(dim=1)

    def _reward_torque_limits(self) -> Tensor:
        """Torques beyond ``rewards.soft_torque_limit`` of the servo's force limit [N m]. [L]"""
        return (self.torques - self.torques.clamp(*self.soft_effort)).abs().sum(dim=1)

    def _reward_torques(self) -> Tensor:
        """2-norm plus 1-norm of the joint torques [N m] [P]; or their squares' sum: ``rewards.torques_as`` [L]."""
        if self.cfg.rewards.torques_as == "squares":
            return self.torques.square().sum(dim=1)
        return self.torques.square().sum(dim=1).sqrt() + self.torques.abs().sum(dim=1)

    def _reward_motor_heat(self) -> Tensor:
        """Mean square of torque over ``ratings.continuous_torque``, of the joints that have one. [ours]"""
        needed = "ratings.continuous_torque is empty; write what the motors bear for ever [N m] (docs/heat.md)"
        require(bool(self.cfg.ratings.continuous_torque), "motor_heat", needed)
        return (self.torques.square() * self.heat_weights).sum(dim=1)

    def _reward_action_rate(self) -> Tensor:
        """Change of the clipped action, squared. [L]"""
        return (self.actions - self.last_actions).square().sum(dim=1)

    def _reward_action_smoothness(self) -> Tensor:
        """Change of the change of the clipped action, squared. [HIM -0.01]"""
        return (self.actions - 2.0 * self.last_actions + self.last_last_actions).square().sum(dim=1)

    def _reward_energy(self) -> Tensor:
        """Sum of |joint velocity * torque| [W]. [P]"""
        return (self.dof_vel * self.torques).abs().sum(dim=1)

    def _reward_collision(self) -> Tensor:
        """Number of bodies of ``asset.penalize_contacts_on`` on the ground. [L]"""
        return ((self.contact_count @ self.penalized_contacts) > 0.0).sum(dim=1).float()

    def _reward_self_collision(self) -> Tensor:
        """Number of contacts of the robot with itself. [M; its G1 -1]"""
        needed = "asset.self_collisions is False, so that parts pass through one another"
        require(self.cfg.asset.self_collisions, "self_collision", needed)
        return self.self_contacts[:, 0].clone()


def load_robot(
    cfg: RobotTaskCfg,
    law: str,
    engine: str,
    terrain: Terrain | None = None,
    contact_geoms: Sequence[str] = (),
    sites: Mapping[str, Sequence[str]] = {},
    more_sensors: Collection[str] = (),
) -> RobotModel:
    """Load the robot of ``asset.file`` with the config's joints, contacts and sensors, and motors of ``law``."""
    asset, on, scale = cfg.asset, cfg.terrain, cfg.control.action_scale
    if not asset.file:
        raise ConfigError("asset.file is empty; name the robot's MJCF or URDF, e.g. 'resources/robots/go1/go1.xml'")
    try:
        return build_model(
            find_file(cfg, "asset.file"),
            solver=Solver(cfg.sim.dt, cfg.sim.iterations, cfg.sim.ls_iterations, cfg.sim.integrator),
            ground=Ground(on.friction, on.condim, on.contact_time, terrain, boxes=engine == "mujoco", slope=on.slope),
            **motor_gains(cfg, law),
            colliders=asset.colliders,
            self_collisions=asset.self_collisions,
            contact_geoms=contact_geoms,
            imu_site=asset.imu_site,
            sites=sites,
            pose=cfg.init_state.default_joint_angles,
            tables={
                "control.action_scale": scale if isinstance(scale, Mapping) else {"": scale},
                "rewards.pose_weights": cfg.rewards.pose_weights,
                **motor_curves(cfg, law),
                "rewards.deviation_weights": cfg.rewards.deviation_weights,
            },
            held_joints=asset.held_joints,
            partial={name: getattr(asset, name) for name in PARTIAL},
            more_sensors=more_sensors,
            drive=motor_drive(cfg, law),
        )
    except ModelError as error:
        raise error.renamed(FIELDS) from None


def motor_ratings(cfg: RobotTaskCfg, robot: RobotModel) -> dict[str, list[float | None]]:
    """Table of ``cfg.ratings`` -> values (D,), None if unknown. Raises ModelError for a key that fits no joint."""
    tables = {name: table for name, table in cfg.to_dict()["ratings"].items() if isinstance(table, Mapping)}
    known = {name: some_joints(tables[name], robot.joint_names, f"ratings.{name}", robot.held) for name in tables}
    return {name: [found.get(joint) for joint in robot.joint_names] for name, found in known.items()}


def start_place(cfg: RobotTaskCfg, robot: RobotModel, colliders: Sequence[str]) -> list[float]:
    """Root position at reset [m]: ``init_state.pos`` if the config sets it.

    Otherwise x = y = 0, and z is such that the feet are as high as in the keyframe, or without a keyframe the lowest
    foot is on the ground. For a robot without feet, ``colliders`` take their place.
    """
    if cfg.init_state.pos:
        return list(cfg.init_state.pos)
    feet = [geom for geoms in robot.site_geoms.values() for geom in geoms]
    feet = feet or robot.names.find(colliders, "asset.colliders", colliding=True)
    if robot.keyframe is None or robot.keyframe.height is None:
        return [0.0, 0.0, standing_height(robot, feet, robot.pose)]
    read = tuple(robot.keyframe.angles[name] for name in robot.joint_names)
    lower = 0.0 if read == robot.pose else standing_height(robot, feet, read) - standing_height(robot, feet, robot.pose)
    return [0.0, 0.0, robot.keyframe.height - lower]


def check_term(method: Callable[[], Any], count: int) -> Tensor:
    """The value of a reward method. Raises StepError, with the method's file and line, unless its shape is (count,)."""
    value = method()
    if not isinstance(value, Tensor) or value.shape != (count,):
        actual = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        expected = f"must return a tensor ({count},), one value an environment"
        raise StepError(f"{expected}; it returned {actual}", place_of(method))
    return value


def require(given: bool, term: str, what: str) -> None:
    """Raise ConfigError for an active term unless ``given``. A term may call it: each is called before training."""
    if not given:
        raise ConfigError(f"rewards.scales.{term} is on, but {what}")


def not_sensed(name: str) -> ConfigError:
    """The error for reading the sensor ``name`` if neither a term nor ``asset.sense`` needs it."""
    return ConfigError(f"{name} is not sensed; write asset.sense = ['{name}'] in the config")
