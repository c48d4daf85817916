"""What every robot does in every task: act, sense, end, reset, observe, be rewarded. Read top to bottom; no simulator import.

Everything under ``_step`` is recorded as one CUDA graph: fixed buffers, masks instead of index lists, no question to
the host. Shapes: N environments, D joints, K reward terms. A reward is a method ``_reward_<name>``, switched on
by a number of that name in ``cfg.rewards.scales``; it returns (N,) and only reads. The terms are in ``robot_rewards``.
What the policy sees is a table of rows: ``robot_observations``.

Freshness: ``qpos`` and ``qvel`` and all that is computed from them are current. What comes from sensors (contacts,
places and velocities of sites, accelerometer, joint torque) is one simulation step old and zero in a world just reset.
"""

from __future__ import annotations

import math
from functools import reduce

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_mw.envs.actuators import Actuators, TorqueLaw
from legged_mw.envs.base_task import BaseTask
from legged_mw.envs.checks import check_values
from legged_mw.envs.contacts import GroundContacts
from legged_mw.envs.divergence import Divergence
from legged_mw.envs.domain_rand import DomainRand, world_fields
from legged_mw.envs.loading import load_robot, soft_limits, start_place
from legged_mw.envs.observations import Observations
from legged_mw.envs.own_code import check_term, checked_rows
from legged_mw.envs.perturbation import Perturbation
from legged_mw.envs.robot_observations import RobotObservations
from legged_mw.envs.robot_rewards import RobotRewards
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.envs.statistics import Statistics
from legged_mw.envs.suspects import Suspects
from legged_mw.envs.wording import in_config_words
from legged_mw.sim.engines import make_simulation, pick_engine
from legged_mw.sim.model import RobotModel
from legged_mw.sim.terrain import Terrain
from legged_mw.utils.commands import Command
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown
from legged_mw.utils.math import assign, columns, maybe_any, quat_rotate, quat_rotate_inverse, spread


class RobotTask(TorqueLaw, RobotObservations, RobotRewards, BaseTask):
    """N robots in N worlds of their own, as one vectorized environment. A task is a subclass with its rewards and its rows."""

    cfg: RobotTaskCfg
    exam = ""  # kind of exam that grades a policy (legged_mw/eval/exams.py); none
    command_table: tuple[Command, ...] = ()  # what a person can ask of the robot; nothing
    commands: Tensor  # (N, C), in the order of command_table; only where that is not empty

    @in_config_words()
    def __init__(self, cfg: RobotTaskCfg, device: str, eager: bool = False) -> None:
        self.cfg = cfg
        check_values(cfg, law=self.motor_law)
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
            world_fields=world_fields(cfg, self.motor_law),
            terrain=self.terrain,
            eager=eager,
        )
        super().__init__(cfg.env.num_envs, len(self.robot.joint_names), device, eager)
        self.domain_rand = self.remember(DomainRand(cfg, self.robot, self.sim, self.motor_law))
        self.dt = cfg.sim.dt * cfg.control.decimation  # [s] a control step
        self.max_episode_length = math.ceil(cfg.env.episode_length_s / self.dt)
        self._init_ranges()
        self._init_buffers()
        self.perturbation = self.remember(
            Perturbation(cfg.perturbation, self.sim, self.root_body, self.total_mass, self.dt)
        )
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
        """Motor commands from the actions."""
        self.actuators.apply(self.actions)

    def _update_state(self) -> None:
        """All that termination and rewards read, computed once."""
        self._episode_length_buf.add_(1)
        self._refresh_base()

    def _refresh_base(self) -> None:
        """Joint offsets, and velocity and gravity at the IMU, from qpos and qvel: v_imu = R^T v + w x r."""
        torch.sub(self.dof_pos, self.default_dof_pos, out=self.dof_offset)
        if self.actuators.encoder_offset is not None:
            torch.add(self.dof_offset, self.actuators.encoder_offset, out=self.joint_reading)
        quat, lever = self.root_quat[:, None], torch.linalg.cross(self.base_ang_vel, self.imu_pos)
        in_body = quat_rotate_inverse(quat, torch.stack([self.gravity_dir, self.root_lin_vel], dim=1))
        self.projected_gravity.copy_(in_body[:, 0])
        torch.add(in_body[:, 1], lever, out=self.base_lin_vel)
        self.base_ang_vel_world.copy_(quat_rotate(quat[:, 0], self.base_ang_vel))

    def _end_step(self) -> None:
        """What the next step remembers; the reward has seen this step's values."""
        self._remember_for_rewards()
        self.last_actions.copy_(self.actions)

    # ---- termination ----------------------------------------------------------------------------------------------

    def check_termination(self) -> None:
        """Ends episodes: fallen, out of time, or broken (a state or an action that is not finite)."""
        self.divergence.find(self.broken)
        torch.logical_and(self._fallen(), ~self.broken, out=self.fell)
        ended = torch.logical_or(self.fell, self.broken)
        torch.logical_and(self._timed_out(), ~ended, out=self.time_out_buf)
        torch.logical_or(ended, self.time_out_buf, out=self.reset_buf)

    def _fallen(self) -> Tensor:
        """(N,) The robot failed: too tilted, too low, or on the ground with what must not touch it."""
        return reduce(torch.logical_or, self.fall_rules().values())

    def fall_rules(self) -> dict[str, Tensor]:
        """(N,) each, by the field that it comes from."""
        tilt, low = math.cos(math.radians(self.cfg.termination.max_tilt)), self.cfg.termination.min_base_height
        rules = {"termination.max_tilt": self.projected_gravity[:, 2] > 1e-5 - tilt}  # at 180 degrees never
        if len(self.contacts.terminating):
            rules["asset.terminate_after_contacts_on"] = (
                self.contact_count[:, self.contacts.terminating].amax(dim=1) > 0.0
            )
        return {**rules, "termination.min_base_height": self.base_height < low} if low else rules

    def _timed_out(self) -> Tensor:
        """(N,) The episode ends, but not by a failure."""
        return self._episode_length_buf >= self.max_episode_length

    # ---- resets: masks, never index lists ---------------------------------------------------------------------------

    def _reset_all(self) -> None:
        self.reset_envs(torch.ones_like(self.reset_buf))
        self.compute_observations()

    def reset_envs(self, mask: Tensor) -> None:
        """Begin a new episode in the worlds where ``mask`` (N,) is true; the others stay as they are, bit for bit."""
        self._update_curricula(mask)
        self.sim.reset(mask)
        self.domain_rand.reset(mask)
        self._reset_robots(mask)
        self._forget_for_rewards(mask)
        self._reset_task(mask)
        self.perturbation.reset(mask)
        self._episode.masked_fill_(mask[:, None], 0.0)
        self._episode_length_buf.masked_fill_(mask, 0)
        self._refresh_base()

    def restart(self, mask: Tensor) -> None:
        """Reset the masked worlds between two steps and refresh their observations. Other worlds keep theirs."""
        before = self.observations.remember()
        self.reset_envs(mask)
        self.fell.masked_fill_(mask, False)
        self.compute_observations()
        self.observations.recall(before, ~mask)

    def first_observations(self) -> TensorDict:
        """Observe as an episode begins, after a caller changed state or commands: no delay or history shows what was before."""
        self.observations.restart(torch.ones_like(self.reset_buf))
        self.compute_observations()
        return self.get_observations()

    def _update_curricula(self, mask: Tensor) -> None:
        """Where ``mask`` (N,) is true an episode has ended: what becomes harder or easier."""
        if self.cfg.perturbation.curriculum:
            self.perturbation.update_level(mask, self._share_survived())

    def anneal(self, done: float) -> None:
        """A training is ``done`` so far, from 0 to 1: kicks, and what the terms change with it."""
        self.perturbation.anneal(done)
        super().anneal(done)

    def _reset_robots(self, mask: Tensor) -> None:
        """Root near its start with any heading and a small velocity, joints and servo targets at (or near) the default pose."""
        n = self.num_envs
        draw = torch.rand(n, 9, device=self.device).mul_(2.0).sub_(1.0).mul_(self.reset_range)  # x, y, yaw, velocities
        half = 0.5 * draw[:, 2:3]
        zero = torch.zeros_like(half)
        pose = [self._start_places(draw[:, :2]), torch.cos(half), zero, zero, torch.sin(half)]
        assign(self.sim.qpos, mask, torch.cat([*pose, self._start_angles()], dim=1))
        assign(self.sim.qvel[:, :6], mask, draw[:, 3:])  # the joints' velocity is zero from the reset
        if speed := self.cfg.init_state.dof_vel_range:
            assign(self.dof_vel, mask, torch.empty_like(self.dof_offset).uniform_(-speed, speed))
        self.actuators.reset(mask)
        self.observations.restart(mask)

    def _start_angles(self) -> Tensor:
        """Joint angles of a new episode (N, D) [rad]: the default pose, or drawn around it and within the joints' ranges."""
        joints, init = self.default_dof_pos.expand(self.num_envs, -1), self.cfg.init_state
        if init.dof_pos_range != [1.0, 1.0]:
            joints = joints * torch.empty_like(self.dof_offset).uniform_(*init.dof_pos_range)
        if init.dof_pos_offset != [0.0, 0.0]:
            joints = joints + torch.empty_like(self.dof_offset).uniform_(*init.dof_pos_offset)
            joints = joints.clamp(self.joint_lower, self.joint_upper)
        return joints

    def _start_places(self, offset: Tensor) -> Tensor:
        """Where an episode begins, (N, 3) [m, world], ``offset`` (N, 2) [m] away from the middle."""
        place = self.init_pos.expand(self.num_envs, 3)
        return torch.cat([place[:, :2] + offset, place[:, 2:]], dim=1)

    def _reset_task(self, mask: Tensor) -> None:
        """What else of the task begins where ``mask`` (N,) is true. Here nothing."""

    def _share_survived(self) -> Tensor:
        """(N,) How much of its episode a robot survived, from 0 to 1; negative before its first step."""
        share = torch.where(self.time_out_buf, 1.0, self.episode_steps[:, 0] / self.max_episode_length)
        return torch.where(self.episode_steps[:, 0] > 0.0, share, -1.0)

    # ---- observations -------------------------------------------------------------------------------------------------

    def compute_observations(self) -> None:
        """Fill ``obs_buf`` as the table says."""
        self.observations.compute()

    def _prepare_observations(self) -> None:
        if hasattr(self, "_observation_rows"):
            raise ConfigError(f"{type(self).__name__}._observation_rows: the method is now called observation_rows")
        self.observations = self.remember(
            Observations(
                checked_rows(self),
                self.cfg.observations,
                self.cfg.noise.level,
                self.num_envs,
                self.device,
                lambda width: self.domain_rand.delay("observation_delay", width),
            )
        )
        self.obs_buf = self.observations.buffers

    # ---- reward -------------------------------------------------------------------------------------------------------

    def compute_reward(self) -> None:
        """Sum of scale * term * dt, clipped; ``termination`` is added after the clip. Broken worlds get 0."""
        rewards = self.cfg.rewards
        total = torch.zeros_like(self.rew_buf)
        if self._reward_terms:
            terms = torch.stack([term() for term in self._reward_terms], dim=1).mul_(self.reward_scales)
            terms.masked_fill_(self.broken[:, None], 0.0)
            self.suspects[0].clear(terms)
            total = terms[:, : self._num_clipped].sum(dim=1)
            if rewards.only_positive_rewards:
                total.clamp_(0.0, rewards.max_reward)
            if self._num_clipped < len(self.reward_names):
                total += terms[:, self._num_clipped]
            self.episode_sums.add_(terms)
        self.rew_buf.copy_(total)
        self.episode_return.add_(total[:, None])
        self.episode_steps.add_(1.0)

    def _prepare_reward_function(self) -> None:
        """Match scales to methods by name; every term is tried once, so that a mistake shows before training."""
        scales = self._active_scales()
        terms = {
            name.removeprefix("_reward_"): getattr(self, name) for name in dir(self) if name.startswith("_reward_")
        }
        after_clip = [] if self.cfg.rewards.clip_termination else ["termination"]
        self.reward_names = [n for n in scales if n not in after_clip] + [n for n in after_clip if n in scales]
        self._num_clipped = len([n for n in scales if n not in after_clip])
        for name in self.reward_names:
            where = f"{type(self).__name__} (a method _reward_<name>)"
            if name not in terms:
                raise ConfigError(
                    f"rewards.scales.{name} = {scales[name]:g}: {unknown('reward term', name, terms, where)}"
                )
            check_term(terms[name], self.num_envs)
        self._reward_terms = [terms[name] for name in self.reward_names]
        self.suspects = [
            self.remember(Suspects([f"reward term '{n}'" for n in self.reward_names], self.device)),
            *self.observations.suspects(),
        ]
        self.reward_scales = torch.tensor([scales[name] for name in self.reward_names], device=self.device) * self.dt
        means = [*(f"rew_{name}" for name in self.reward_names), "reward", "episode_length"]
        self.statistics = self.remember(Statistics(means, ["episodes", "fell", "broken"], self.device))

    # ---- statistics: summed on the device, read once an iteration ------------------------------------------------------------

    def _sum_statistics(self) -> None:
        """Add the episodes that end in this step. Runs before the reset."""
        means = torch.cat([self.episode_sums, self.episode_return, self.episode_steps], dim=1)
        self.statistics.add(self.reset_buf, means, torch.stack([self.reset_buf, self.fell, self.broken], dim=1))

    def _live_statistics(self) -> dict[str, Tensor]:
        """Values as they stand: () a sum, or (2,) a sum and what to divide it by, so that ranks can add theirs."""
        worlds = {"overflowed": self.sim.overflowed_worlds(), **self.divergence.statistics()}  # so far
        return worlds | self.perturbation.statistics()

    def take_statistics(self) -> Tensor:
        """Sums since the last call and values as they stand (S,), on the device."""
        return self.statistics.take(self._live_statistics())

    def name_statistics(self, taken: list[float]) -> dict[str, float]:
        """Statistics by name, from what ``take_statistics`` returned. Means are NaN if no episode ended.

        ``rew_<name>``: mean over episodes of the sum of scale * term * dt, before the clip, divided by ``env.episode_length_s``.
        ``reward``: the episode's return. ``episode_length`` [control steps].
        """
        seconds = self.cfg.env.episode_length_s
        named = self.statistics.name(taken)
        return {name: value / seconds if name.startswith("rew_") else value for name, value in named.items()}

    def read_statistics(self) -> dict[str, float]:
        """Statistics since the last call, by name. Reads the device."""
        return self.name_statistics(self.take_statistics().tolist())

    # ---- what training learned about its worlds, for a checkpoint --------------------------------------------------------------

    def training_state(self) -> dict[str, Tensor]:
        """Curricula as they stand: tensors, by name."""
        return {"kick_level": self.perturbation.kick_level.clone()} if self.cfg.perturbation.curriculum else {}

    def load_training_state(self, state: dict[str, Tensor]) -> None:
        """Go on from ``training_state``, of several processes from the first one's. Worlds take what the nearest ones had."""
        if "kick_level" in state and self.cfg.perturbation.curriculum:
            self.perturbation.kick_level.copy_(spread(state["kick_level"], self.num_envs))

    # ---- robot and buffers: born here, never rebound --------------------------------------------------------------------------

    def _make_terrain(self) -> Terrain | None:
        """The ground; None: a plane."""
        return None

    def _load_robot(self, engine: str) -> RobotModel:
        sensed = self._sensed_geoms(), self._sensed_sites(), self._sensed_on_demand()
        return load_robot(self.cfg, self.motor_law, engine, self.terrain, *sensed)

    def _sensed_geoms(self) -> list[str]:
        """Geoms whose contacts with the ground are counted: names or patterns."""
        return [*self.cfg.asset.penalize_contacts_on, *self.cfg.asset.terminate_after_contacts_on]

    def _sensed_sites(self) -> dict[str, list[str]]:
        """Sites whose velocity is sensed -> geoms: where the MJCF lacks one, it is made at the lowest point of them."""
        return {}

    def _init_buffers(self) -> None:
        n, device, sim, spans = self.num_envs, self.device, self.sim, self.robot.sensors
        self.root_pos, self.root_quat = sim.qpos[:, :3], sim.qpos[:, 3:7]  # views [m, world], wxyz
        self.root_lin_vel, self.base_ang_vel = sim.qvel[:, :3], sim.qvel[:, 3:6]  # views [m/s, world], [rad/s, body]
        self.dof_pos, self.dof_vel = sim.qpos[:, 7:], sim.qvel[:, 6:]  # views (N, D) [rad], [rad/s]
        self.torques = sim.actuator_force  # view (N, D) [N m]
        self.contact_count = sim.sensordata[:, spans["contact"]]  # view (N, C), of robot.contact_geoms with the ground
        self.accelerometer = sim.sensordata[:, spans["accelerometer"]]  # view (N, 3) [m/s^2]
        self.base_lin_vel, self.projected_gravity, self.base_ang_vel_world = (self._zeros(3) for _ in range(3))
        self.dof_offset = self._zeros(self.num_actions)  # joint position minus default [rad]
        self.actuators = self.remember(Actuators(self, self.robot, sim, self.domain_rand))
        exact = self.actuators.encoder_offset is None
        self.joint_reading = self.dof_offset if exact else self._zeros(self.num_actions)  # the same, as measured
        self.base_height = self.root_pos[:, 2]  # of the root above the ground under it [m]
        self.fell, self.broken = self._zeros(dtype=torch.bool), self._zeros(dtype=torch.bool)
        self.divergence = self.remember(
            Divergence(sim, self.actions, self.robot.joint_names, self.cfg.termination.max_speed)
        )
        # one matrix, so that a reset clears it in one go
        self._episode, views = columns(n, device, **self._episode_columns())
        self.remember(self._episode)
        for name, view in views.items():
            setattr(self, name, view)
        model = self.robot.physics
        self.gravity_dir = self.domain_rand.gravity_dir  # (N, 3) world frame
        self.total_mass = float(model.body_subtreemass[0])  # [kg]
        self.root_body = self.robot.id("body", self.robot.root)
        # body frame [m]
        self.imu_pos = self._tensor(model.site_pos[self.robot.id("site", self.robot.imu)]).expand(n, 3)
        self.contacts = GroundContacts(
            self.robot, self.cfg.asset, self.contact_count, "collision" in self._active_scales()
        )
        self._init_robot_rewards()
        self.remember(self.last_dof_vel)

    def _zeros(self, *shape: int, dtype: torch.dtype = torch.float) -> Tensor:
        return self.buffer(*shape, dtype=dtype)

    def _episode_columns(self) -> dict[str, int]:
        """What an episode remembers, as name -> width: attributes (N, width) that a reset clears."""
        sums = {"episode_sums": len(self._active_scales()), "episode_return": 1, "episode_steps": 1}
        return {"last_actions": self.num_actions, **sums, **self._columns_for_rewards()}

    def _init_ranges(self) -> None:
        """Config numbers as tensors: joints' tables and ranges of a reset."""
        cfg, init = self.cfg, self.cfg.init_state
        self.default_dof_pos = self._tensor(self.robot.pose)
        self.pose_weights = self._tensor(self.robot.tables["rewards.pose_weights"])
        self.joint_lower, self.joint_upper = self._tensor(self.robot.joint_range).unbind(dim=1)
        self.soft_lower, self.soft_upper = soft_limits(self.robot, cfg.rewards.soft_dof_pos_limit, self.device)
        self.start_place = start_place(cfg, self.robot, cfg.asset.colliders)  # of the root at reset [m]
        self.init_pos = self._tensor(self.start_place)
        self.reset_range = self._tensor(
            [init.pos_xy_range] * 2 + [init.yaw_range] + [init.lin_vel_range] * 3 + [init.ang_vel_range] * 3
        )

    def _tensor(self, values: object) -> Tensor:
        return torch.tensor(values, dtype=torch.float, device=self.device)

    # declared for readers and type checkers; columns of self._episode, (N, width)
    last_actions: Tensor  # D
    episode_sums: Tensor  # K, scale * term * dt summed over the episode
    episode_return: Tensor  # 1
    episode_steps: Tensor  # 1, since the reset; episode_length_buf may start elsewhere
