"""A legged robot that follows a joystick: the whole MDP, read top to bottom. No simulator import, no address arithmetic.

Everything under ``_step`` is recorded as one CUDA graph: fixed buffers, masks instead of index lists, no question to
the host. Shapes: N environments, D joints, F feet, K reward terms. A reward is a method ``_reward_<name>``, switched on
by a number of that name in ``cfg.rewards.scales``; it returns (N,) and only reads.

Freshness: ``qpos`` and ``qvel`` and all that is computed from them are current. What comes from sensors (foot contact,
foot position and velocity, accelerometer, joint torque) is one simulation step old and zero in a world just reset.
"""

from __future__ import annotations

import math
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from legged_mw import ROOT
from legged_mw.envs.base_task import BaseTask
from legged_mw.envs.checks import check_values
from legged_mw.envs.domain_rand import DomainRand, world_fields
from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.envs.mirror import Mirror, make_mirror
from legged_mw.envs.terrain import Tiles, build_terrain
from legged_mw.envs.wording import in_config_words
from legged_mw.sim.engines import make_simulation, pick_engine
from legged_mw.sim.height_map import make_height_map
from legged_mw.sim.model import Ground, ModelError, RobotModel, Solver, build_model, per_joint, unknown
from legged_mw.sim.terrain import PLATFORM
from legged_mw.utils.config import ConfigError
from legged_mw.utils.math import assign, columns, may_hold, quat_rotate, quat_rotate_inverse


class Row(NamedTuple):
    """One row of the observation table."""

    name: str
    value: Tensor  # (N, size)
    noise: float = 0.0  # half width of the uniform noise added to it, in the value's unit
    mirror: str | None = None  # its mirror image, left for right: a kind of envs/mirror.py, or the group that it is; None: not said
    scale: float | tuple[float, ...] = 1.0  # a number, or one a column; the policy sees scale * (value + noise)
    measured: bool = False  # comes from a sensor, so that domain_rand.observation_delay applies to it
    # how a robot measures it, for the exported policy; the rows below are known to legged_mw/deploy/contract.py by their names
    sensors: tuple[str, ...] = ()  # sensors of the MJCF, whose values side by side are the row
    unit: str = ""
    frame: str = ""

    def column_scales(self) -> list[float]:
        """The scale of each column; raises ConfigError where there is not one for each."""
        size = self.value.shape[1]
        if isinstance(self.scale, tuple) and len(self.scale) != size:
            raise ConfigError(f"observation row '{self.name}' has {size} columns and {len(self.scale)} scales; give one, or one a column")
        return list(self.scale) if isinstance(self.scale, tuple) else [float(self.scale)] * size


class LeggedRobot(BaseTask):
    """N robots in N worlds of their own, as one vectorized environment."""

    cfg: LeggedRobotCfg

    @in_config_words()
    def __init__(self, cfg: LeggedRobotCfg, device: str, eager: bool = False) -> None:
        check_values(cfg)
        self.cfg = cfg
        self.terrain = build_terrain(cfg)
        self.robot = self._load_robot(pick_engine(cfg.sim.engine, device))
        self.obs_buf = {}
        super().__init__(cfg.env.num_envs, len(self.robot.joint_names), device, eager)
        self.sim = make_simulation(
            self.robot.physics,
            cfg.env.num_envs,
            device,
            engine=cfg.sim.engine,
            nconmax=cfg.sim.nconmax,
            njmax=cfg.sim.njmax,
            threads=cfg.sim.threads,
            world_fields=world_fields(cfg),
            terrain=self.terrain,
            eager=eager,
        )
        self.domain_rand = DomainRand(cfg, self.robot, self.sim)
        self.dt = cfg.sim.dt * cfg.control.decimation  # [s] a control step
        self.max_episode_length = math.ceil(cfg.env.episode_length_s / self.dt)
        self._init_buffers()
        self._init_ranges()
        self._prepare_observations()
        self._prepare_reward_function()
        self.domain_rand.redraw()
        self._reset_all()

    # ---- the step -------------------------------------------------------------------------------------------------

    def _step(self) -> None:
        clip = self.cfg.normalization.clip_actions
        self.actions.clamp_(-clip, clip)
        if self.cfg.perturbation.enable:
            self._kick_robots()
        if self.cfg.perturbation.push:
            self._push_robots()
        self._apply_actions()
        self.sim.step(self.cfg.control.decimation)
        self._update_state()
        self.check_termination()
        self.compute_reward()
        self._end_step()
        if may_hold(self.reset_buf):
            self._sum_statistics()
            self.reset_envs(self.reset_buf)
        self.compute_observations()

    def _apply_actions(self) -> None:
        """Servo targets from the actions, as late and as far off as ``domain_rand`` makes them."""
        actions = self._action_delay(self.actions) if self._action_delay else self.actions
        torch.add(self.default_dof_pos, actions, alpha=self.cfg.control.action_scale, out=self.sim.ctrl)
        if self._encoder_offset is not None:
            self.sim.ctrl.sub_(self._encoder_offset)

    def _update_state(self) -> None:
        """All that termination and rewards read, computed once."""
        self._episode_length_buf.add_(1)
        self._refresh_base()
        torch.gt(self.foot_contact_count, 0.0, out=self.foot_contact)
        torch.logical_and(self.foot_contact, self.feet_air_time > 0.0, out=self.first_contact)
        self.feet_air_time.add_(self.dt)
        self._measure_ground()
        torch.maximum(self.swing_peak, self.foot_height, out=self.swing_peak)
        torch.hypot(self.foot_vel[..., 0], self.foot_vel[..., 1], out=self.foot_speed)
        torch.gt(self.commands.square().sum(dim=1), self.cfg.rewards.min_command**2, out=self.moving)

    def _measure_ground(self) -> None:
        """Heights of feet and root above the ground under each of them, and how far the robot came."""
        if not (self.tiles and self._height_at):
            self.foot_height.copy_(self.sim.site_xpos[:, self.foot_sites, 2])
            return
        feet, root = self.sim.site_xpos[:, self.foot_sites], self.sim.qpos[:, :3]
        points = torch.cat([feet, root[:, None]], dim=1)
        above = points[..., 2] - self._height_at(points[..., :2])
        self.foot_height.copy_(above[:, :-1])
        self.base_height.copy_(above[:, -1])
        speed = self.commands[:, :2].square().sum(dim=1, keepdim=True).sqrt()
        self.asked_speed.copy_(torch.where(speed > self.cfg.rewards.min_command, speed, 0.0))
        along = (self.base_lin_vel[:, :2] * self.commands[:, :2]).sum(dim=1, keepdim=True) / speed.clamp(min=1e-6)
        self.progress.addcmul_(along, (self.asked_speed > 0.0).float(), value=self.dt)
        self.asked.add_(self.asked_speed, alpha=self.dt)
        away = (root[:, :2] - self.tiles.origins[:, :2]).abs().amax(dim=1, keepdim=True)
        torch.maximum(self.farthest, away, out=self.farthest)

    def _scan_heights(self) -> None:
        """The height scan: how far the ground lies below where it is when the robot stands on level ground, within 1 m."""
        root, (w, x, y, z) = self.sim.qpos[:, :3], self.sim.qpos[:, 3:7].unbind(dim=1)
        yaw = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        cos, sin = torch.cos(yaw)[:, None], torch.sin(yaw)[:, None]
        px, py = self.scan_points
        level = root[:, 2:] - self.init_pos[2]
        if self._height_at:
            points = torch.stack([cos * px - sin * py + root[:, :1], sin * px + cos * py + root[:, 1:2]], dim=2)
            level = level - self._height_at(points)
        self.height_scan.copy_(level.clamp(-1.0, 1.0).expand_as(self.height_scan))

    def _refresh_base(self) -> None:
        """Joint offsets, and velocity and gravity at the IMU, from qpos and qvel: v_imu = R^T v + w x r."""
        torch.sub(self.dof_pos, self.default_dof_pos, out=self.dof_offset)
        if self._encoder_offset is not None:
            torch.add(self.dof_offset, self._encoder_offset, out=self.joint_reading)
        quat, lever = self.sim.qpos[:, None, 3:7], torch.linalg.cross(self.base_ang_vel, self.imu_pos)
        in_body = quat_rotate_inverse(quat, torch.stack([self.gravity_dir, self.sim.qvel[:, :3]], dim=1))
        self.projected_gravity.copy_(in_body[:, 0])
        torch.add(in_body[:, 1], lever, out=self.base_lin_vel)
        self.base_ang_vel_world.copy_(quat_rotate(quat[:, 0], self.base_ang_vel))

    def _end_step(self) -> None:
        """What the next step remembers; the reward has seen this step's values."""
        self.feet_air_time.masked_fill_(self.foot_contact, 0.0)
        self.swing_peak.masked_fill_(self.foot_contact, 0.0)
        self.last_actions.copy_(self.actions)
        if self.cfg.commands.resampling_time > 0:
            self.command_timer.sub_(1.0)
            over = self.command_timer[:, 0] <= 0.0
            if may_hold(over):
                self._resample_commands(over)

    # ---- termination ----------------------------------------------------------------------------------------------

    def check_termination(self) -> None:
        """Ends episodes: fallen, out of time, or broken (a state or an action that is not finite)."""
        speed = self.sim.qvel.abs().amax(dim=1)
        position = self.sim.qpos.abs().amax(dim=1)
        action = self.actions.abs().amax(dim=1)  # a servo swallows NaN, the reward does not
        finite = (speed <= self.cfg.termination.max_speed) & (position < math.inf) & (action < math.inf)  # NaN compares false
        torch.logical_not(finite, out=self.broken)
        max_tilt = math.radians(self.cfg.termination.max_tilt)
        down = self.projected_gravity[:, 2] > -math.cos(max_tilt)
        if len(self.terminating_contacts):
            down |= self.contact_count[:, self.terminating_contacts].amax(dim=1) > 0.0
        if self.cfg.termination.min_base_height:
            down |= self.base_height < self.cfg.termination.min_base_height
        torch.logical_and(down, finite, out=self.fell)
        ended = torch.logical_or(self.fell, self.broken)
        over = self._episode_length_buf >= self.max_episode_length
        if self.tiles:  # who walks off the terrain did nothing wrong
            torch.gt((self.sim.qpos[:, :2].abs() - self.tiles.edge).amax(dim=1), 0.0, out=self.walked_off)
            over |= self.walked_off
        torch.logical_and(over, ~ended, out=self.time_out_buf)
        torch.logical_or(ended, self.time_out_buf, out=self.reset_buf)

    # ---- resets: masks, never index lists ---------------------------------------------------------------------------

    def _reset_all(self) -> None:
        self.reset_envs(torch.ones_like(self.reset_buf))
        self.compute_observations()

    def reset_envs(self, mask: Tensor) -> None:
        """Begin a new episode in the worlds where ``mask`` (N,) is true; the others stay as they are, bit for bit."""
        if self.tiles:
            self._update_terrain_curriculum(mask)
        if self.cfg.commands.curriculum:
            self._update_command_curriculum(mask)
        self.sim.reset(mask)
        self.domain_rand.reset(mask)
        self._reset_robots(mask)
        self._reset_commands(mask)
        if self.cfg.perturbation.enable:
            self._update_kick_level(mask)
            self._redraw_kicks(mask)
        self._episode.masked_fill_(mask[:, None], 0.0)
        self.foot_contact.masked_fill_(mask[:, None], False)
        self._episode_length_buf.masked_fill_(mask, 0)
        self._refresh_base()

    def restart(self, mask: Tensor) -> None:
        """A reset from outside of a step: also the first observation; what the other worlds observe stays, delays included."""
        before = {group: obs.clone() for group, obs in self.obs_buf.items()}
        past = self._observation_delay.past.clone() if self._observation_delay else None
        self.reset_envs(mask)
        self.fell.masked_fill_(mask, False)
        self.compute_observations()
        for group, obs in before.items():
            assign(self.obs_buf[group], ~mask, obs)
        if self._observation_delay and past is not None:
            assign(self._observation_delay.past, ~mask, past)

    def _reset_robots(self, mask: Tensor) -> None:
        """Root near the origin with any heading and a small velocity, joints and servo targets at (or near) the default pose."""
        n = self.num_envs
        draw = torch.rand(n, 9, device=self.device).mul_(2.0).sub_(1.0).mul_(self.reset_range)  # x, y, yaw, velocities
        half = 0.5 * draw[:, 2:3]
        zero = torch.zeros_like(half)
        place = self.init_pos + self.tiles.origins if self.tiles else self.init_pos.expand(n, 3)
        at, height = place[:, :2] + draw[:, :2], place[:, 2:]
        if self._height_at and self.cfg.init_state.pos_xy_range > PLATFORM / 2:  # beyond the flat middle of a tile
            height = self.init_pos[2] + self._height_at(at)[:, None]
        pose = [at, height, torch.cos(half), zero, zero, torch.sin(half)]
        joints, (low, high) = self.default_dof_pos.expand(n, -1), self.cfg.init_state.dof_pos_range
        if (low, high) != (1.0, 1.0):
            joints = joints * torch.empty_like(self.dof_offset).uniform_(low, high)
        assign(self.sim.qpos, mask, torch.cat([*pose, joints], dim=1))
        assign(self.sim.qvel[:, :6], mask, draw[:, 3:])  # the joints' velocity is zero from the reset
        assign(self.sim.ctrl, mask, self.default_dof_pos if self._encoder_offset is None else self.default_dof_pos - self._encoder_offset)
        for delay in (self._action_delay, self._observation_delay):
            if delay:
                delay.restart(mask)

    def _update_terrain_curriculum(self, mask: Tensor) -> None:
        """One level up where the robot left its tile; one down where it covered less than half of what it was told. [L]

        A robot that fell still owes what its last command would have asked until the end of the episode.
        """
        assert self.tiles
        left = (self.max_episode_length - self.episode_steps[:, 0]).clamp(min=0.0) * self.dt
        asked = self.asked[:, 0] + torch.where(self.fell, self.asked_speed[:, 0] * left, 0.0)
        up = self.farthest[:, 0] > self.tiles.size / 2
        down = ~up & (self.progress[:, 0] < 0.5 * asked)
        self.tiles.promote(mask & (self.episode_steps[:, 0] > 0.0), up, down)

    # ---- commands -----------------------------------------------------------------------------------------------------

    def _reset_commands(self, mask: Tensor) -> None:
        """A new episode's command is uniform over the ranges."""
        assign(self.commands, mask, self._uniform_commands())
        assign(self.command_timer, mask, self._draw_timers())

    def _update_command_curriculum(self, mask: Tensor) -> None:
        """When as many episodes have ended as there are worlds: wider ranges, if they tracked the velocity well. [L]"""
        share, total, count = self.command_curriculum  # each ()
        best = self.reward_scales[self.reward_names.index("tracking_lin_vel")] * self.episode_steps[:, 0]
        ended = mask & (self.episode_steps[:, 0] > 0.0)
        tracked = self.episode_sums[:, self.reward_names.index("tracking_lin_vel")] / best.clamp(min=1e-9)
        total.add_(torch.where(ended, tracked, 0.0).sum())
        count.add_(ended.sum())
        full = count >= self.num_envs
        grown = full & (total > 0.8 * count)
        share.copy_(torch.where(grown, share + self.cfg.commands.curriculum_step, share).clamp(max=1.0))
        for memory in (total, count):
            memory.masked_fill_(full, 0.0)
        self._set_command_ranges()

    def _set_command_ranges(self) -> None:
        """The share of the ranges that commands come from, around their points that are nearest to 0."""
        torch.lerp(self.still_command, self.full_command_ranges, self.command_curriculum[0], out=self.command_ranges)

    def _resample_commands(self, mask: Tensor) -> None:
        """Where a timer ended, each component keeps its value, or goes to zero, or to a new uniform value."""
        chance = torch.rand(self.num_envs, 6, device=self.device)
        fresh = self._uniform_commands() * (chance[:, :3] < self.keep_probability)
        change = (chance[:, 3:] < self.cfg.commands.change_probability) & mask[:, None]
        self.commands.copy_(torch.where(change, fresh, self.commands))
        assign(self.command_timer, mask, self._draw_timers())

    def _uniform_commands(self) -> Tensor:
        low, high = self.command_ranges
        return torch.lerp(low, high, torch.rand(self.num_envs, 3, device=self.device))

    def _draw_timers(self) -> Tensor:
        """Exponential, (N, 1), rounded to control steps."""
        mean = self.cfg.commands.resampling_time / self.dt
        return torch.empty(self.num_envs, 1, device=self.device).exponential_().mul_(mean).round_()

    # ---- perturbation: kicks and pushes ------------------------------------------------------------------------------

    def _kick_robots(self) -> None:
        """Kick the root: after a pause, a half sine of force in a horizontal direction; then all is drawn anew."""
        wait, steps, angle, speed = self.kick.unbind(dim=1)
        elapsed = self.kick_clock - wait
        self.kick_active.copy_((elapsed >= 0.0) & (elapsed < steps))
        peak = 0.5 * self.total_mass * speed / (steps * self.dt)
        force = torch.where(self.kick_active, torch.sin(math.pi * elapsed / steps) * peak, 0.0)
        self.kick_force[:, 0] = force * torch.cos(angle)
        self.kick_force[:, 1] = force * torch.sin(angle)
        self.sim.xfrc_applied[:, self.root_body, :3] = self.kick_force
        self.kick_clock.add_(1.0)
        over = elapsed + 1.0 >= steps
        if may_hold(over):
            self._redraw_kicks(over, keep_force=True)

    def _redraw_kicks(self, mask: Tensor, keep_force: bool = False) -> None:
        low, high = self.kick_ranges
        draw = torch.lerp(low, high, torch.rand(self.num_envs, 4, device=self.device))
        draw[:, :2] = (draw[:, :2] / self.dt).round_().clamp_(min=1.0)  # [control steps]
        draw[:, 3] *= self.kick_level
        assign(self.kick, mask, draw)
        self.kick_clock.masked_fill_(mask, 0.0)
        if not keep_force:
            self.kick_active.masked_fill_(mask, False)
            self.kick_force.masked_fill_(mask[:, None], 0.0)

    def _push_robots(self) -> None:
        """Push: where a clock has run down the root's horizontal velocity becomes a random one. [L]"""
        self.push_clock.sub_(1.0)
        due = self.push_clock <= 0.0
        if may_hold(due):
            speed = self.cfg.perturbation.max_push_vel_xy
            assign(self.sim.qvel[:, :2], due, torch.rand(self.num_envs, 2, device=self.device).mul_(2.0 * speed).sub_(speed))
            self.push_clock.masked_fill_(due, round(self.cfg.perturbation.push_interval_s / self.dt))

    def _update_kick_level(self, mask: Tensor) -> None:
        """With the curriculum: halfway from the level so far to the share of an episode that was survived."""
        if self.cfg.perturbation.curriculum:
            survived = torch.where(self.time_out_buf & ~self.walked_off, 1.0, self.episode_steps[:, 0] / self.max_episode_length)
            began = self.episode_steps[:, 0] > 0.0  # a reset before the first step says nothing
            assign(self.kick_level, mask & began, 0.5 * (self.kick_level + survived))

    # ---- observations: this table is the only place that states the layout ------------------------------------------------

    def _observation_rows(self) -> dict[str, list[Row]]:
        """Rows of each group, in order. ``state`` is what the real robot can measure or estimate."""
        noise = self.cfg.noise.scales
        return {
            "state": [
                Row("base_lin_vel", self.base_lin_vel, noise.lin_vel, mirror="imu_velocity", measured=True),  # at the IMU, body frame [m/s]
                Row("base_ang_vel", self.base_ang_vel, noise.ang_vel, mirror="axial", measured=True),  # gyro, body frame [rad/s]
                Row("projected_gravity", self.projected_gravity, noise.gravity, mirror="polar", measured=True),  # direction, body frame
                Row("dof_pos", self.joint_reading, noise.dof_pos, mirror="joint", measured=True),  # minus the default pose [rad]
                Row("dof_vel", self.dof_vel, noise.dof_vel, mirror="joint", measured=True),  # [rad/s]
                Row("last_actions", self.last_actions, mirror="joint"),  # a_t, clipped
                Row("commands", self.commands, mirror="command"),  # vx, vy [m/s], yaw rate [rad/s], body frame
                *self._height_rows("state", noise.height_scan),
            ],
            "privileged_state": [
                Row("state", self.obs_buf.get("state", self.actions[:, :0]), mirror="state"),  # the same noisy sample
                Row("base_ang_vel", self.base_ang_vel, mirror="axial"),
                Row("accelerometer", self.accelerometer, mirror="polar"),  # proper acceleration at the IMU [m/s^2]
                Row("projected_gravity", self.projected_gravity, mirror="polar"),
                Row("base_lin_vel", self.base_lin_vel, mirror="imu_velocity"),
                Row("base_ang_vel_world", self.base_ang_vel_world, mirror="axial"),  # the world mirrors about its own x-z plane
                Row("dof_pos", self.dof_offset, mirror="joint"),
                Row("dof_vel", self.dof_vel, mirror="joint"),
                Row("torques", self.torques, mirror="joint"),  # [N m]
                Row("foot_contact", self.foot_contact, mirror="foot"),  # 0 or 1
                Row("foot_lin_vel", self.foot_vel.flatten(1), mirror="foot_polar"),  # world frame [m/s]
                Row("feet_air_time", self.feet_air_time, mirror="foot"),  # [s]
                Row("kick_force", self.kick_force, mirror="polar"),  # on the root, world frame [N]
                Row("kick_active", self.kick_active[:, None], mirror="scalar"),  # 0 or 1
                *self._randomization_rows(),
                *self._height_rows("privileged_state"),
            ],
        }

    def _height_rows(self, group: str, noise: float = 0.0) -> list[Row]:
        """The height scan [m], x by x from behind, in each from right to left; where ``terrain.height_scan`` names the group."""
        row = Row("height_scan", self.height_scan, noise, mirror="height_scan", measured=True)
        return [row] if group in self.cfg.terrain.height_scan else []

    def _randomization_rows(self) -> list[Row]:
        """What was drawn, as the critic may see it: in the config's units."""
        rand = self.domain_rand
        return [Row(name, value, mirror=rand.mirrors[name]) for name, value in rand.values.items() if self.cfg.domain_rand.observe]

    def compute_observations(self) -> None:
        """Fill ``obs_buf``: each group's rows side by side, plus noise where a row has any, times scale."""
        if self.cfg.terrain.height_scan:
            self._scan_heights()
        for group, rows in self._observation_rows().items():
            obs = self.obs_buf[group]
            torch.cat([row.value for row in rows], dim=1, out=obs)
            if group in self.noise_vec:
                obs.addcmul_(torch.empty_like(obs).uniform_(-1.0, 1.0), self.noise_vec[group])
            if group in self.obs_scales:
                obs.mul_(self.obs_scales[group])
            if group == "state" and self._observation_delay:
                obs.copy_(torch.where(self._measured, self._observation_delay(obs), obs))

    def _prepare_observations(self) -> None:
        """Sizes, noise and scale vectors from the table itself."""
        self.noise_vec: dict[str, Tensor] = {}
        self.obs_scales: dict[str, Tensor] = {}
        self.observation_table: dict[str, list[tuple[str, int, float]]] = {}  # group -> (name, size, noise)
        for group in self._observation_rows():
            rows = self._observation_rows()[group]  # again: a group may contain an earlier one
            table = [(row.name, row.value.shape[1], row.noise * self.cfg.noise.level) for row in rows]
            noise = [level for _, size, level in table for _ in range(size)]
            self.observation_table[group] = table
            self.obs_buf[group] = torch.zeros(self.num_envs, len(noise), device=self.device)
            if any(noise):
                self.noise_vec[group] = torch.tensor(noise, device=self.device)
            scales = [scale for row in rows for scale in row.column_scales()]
            if any(scale != 1.0 for scale in scales):
                self.obs_scales[group] = torch.tensor(scales, device=self.device)
        for group in self.cfg.terrain.height_scan:
            if not any(name == "height_scan" for name, *_ in self.observation_table.get(group, [])):
                here = f"{type(self).__name__}._observation_rows has no row height_scan in '{group}'"
                raise ConfigError(f"terrain.height_scan names '{group}', but {here}; add *self._height_rows('{group}', noise) to it")
        measured = [row.measured for row in self._observation_rows().get("state", []) for _ in range(row.value.shape[1])]
        self._measured = torch.tensor(measured, device=self.device)
        self._observation_delay = self.domain_rand.delay("observation_delay", len(measured))

    @cached_property
    def mirror(self) -> Mirror:
        """Observations and actions left for right, from the table; made when first asked for, and not for the step."""
        return make_mirror(self)

    # ---- reward -------------------------------------------------------------------------------------------------------

    def compute_reward(self) -> None:
        """Sum of scale * term * dt, clipped; ``termination`` is added after the clip. Broken worlds get 0."""
        rewards = self.cfg.rewards
        terms = torch.stack([term() for term in self._reward_terms], dim=1).mul_(self.reward_scales)
        terms.masked_fill_(self.broken[:, None], 0.0)
        total = terms[:, : self._num_clipped].sum(dim=1)
        if rewards.only_positive_rewards:
            total.clamp_(0.0, rewards.max_reward)
        if self._num_clipped < len(self.reward_names):
            total += terms[:, self._num_clipped]
        self.rew_buf.copy_(total)
        self.episode_sums.add_(terms)
        self.episode_return.add_(total[:, None])
        self.episode_steps.add_(1.0)

    def _active_scales(self) -> dict[str, float]:
        return {name: float(scale) for name, scale in self.cfg.to_dict()["rewards"]["scales"].items() if scale}

    def _prepare_reward_function(self) -> None:
        """Match scales to methods by name; every term is tried once, so that a mistake shows before training."""
        scales = self._active_scales()
        terms = {name.removeprefix("_reward_"): getattr(self, name) for name in dir(self) if name.startswith("_reward_")}
        after_clip = [] if self.cfg.rewards.clip_termination else ["termination"]
        self.reward_names = [n for n in scales if n not in after_clip] + [n for n in after_clip if n in scales]
        self._num_clipped = len([n for n in scales if n not in after_clip])
        for name in self.reward_names:
            where = f"{type(self).__name__} (a method _reward_<name>)"
            if name not in terms:
                raise ConfigError(f"rewards.scales.{name} = {scales[name]:g}: {unknown('reward term', name, terms, where)}")
            value = terms[name]()
            if not isinstance(value, Tensor) or value.shape != (self.num_envs,):
                got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
                raise ConfigError(f"_reward_{name} must return a tensor ({self.num_envs},), one value an environment; it returned {got}")
        self._reward_terms = [terms[name] for name in self.reward_names]
        self.reward_scales = torch.tensor([scales[name] for name in self.reward_names], device=self.device) * self.dt

    def _reward_tracking_lin_vel(self) -> Tensor:
        """Velocity in the plane at the IMU, body frame, as commanded. [L]"""
        error = (self.commands[:, :2] - self.base_lin_vel[:, :2]).square().sum(dim=1)
        return torch.exp(error / -self.cfg.rewards.tracking_sigma)

    def _reward_tracking_ang_vel(self) -> Tensor:
        """Yaw rate as commanded. [L]"""
        error = (self.commands[:, 2] - self.base_ang_vel[:, 2]).square()
        return torch.exp(error / -self.cfg.rewards.tracking_sigma)

    def _reward_lin_vel_z(self) -> Tensor:
        """Square of the vertical velocity at the IMU, world frame (gravity points down, hence the same square). [P]"""
        return (self.base_lin_vel * self.projected_gravity).sum(dim=1).square()

    def _reward_ang_vel_xy(self) -> Tensor:
        """Roll and pitch rates, world frame. [P]"""
        return self.base_ang_vel_world[:, :2].square().sum(dim=1)

    def _reward_orientation(self) -> Tensor:
        """Tilt: gravity's share in the body's plane, equal to the xy share of the body's z axis in the world. [L, P]"""
        return self.projected_gravity[:, :2].square().sum(dim=1)

    def _reward_dof_pos_limits(self) -> Tensor:
        """What joints exceed the soft limits by [rad]. [L]"""
        return (self.dof_pos - self.dof_pos.clamp(self.soft_lower, self.soft_upper)).abs().sum(dim=1)

    def _reward_pose(self) -> Tensor:
        """Staying near the default pose, most at the hips. [P]"""
        return torch.exp(-(self.dof_offset.square() * self.pose_weights).sum(dim=1))

    def _reward_termination(self) -> Tensor:
        """A fall. [L, P]"""
        return self.fell.float()

    def _reward_stand_still(self) -> Tensor:
        """Joints away from the default pose while the command is to stand. [L]"""
        return self.dof_offset.abs().sum(dim=1).masked_fill_(self.moving, 0.0)

    def _reward_torques(self) -> Tensor:
        """2-norm plus 1-norm of the joint torques [N m]. [P]"""
        return self.torques.square().sum(dim=1).sqrt() + self.torques.abs().sum(dim=1)

    def _reward_action_rate(self) -> Tensor:
        """Change of the clipped action. [L]"""
        return (self.actions - self.last_actions).square().sum(dim=1)

    def _reward_energy(self) -> Tensor:
        """Sum of |joint velocity * torque| [W]. [P]"""
        return (self.dof_vel * self.torques).abs().sum(dim=1)

    def _reward_feet_clearance(self) -> Tensor:
        """Feet that move fast away from the swing height. [P]"""
        return ((self.foot_height - self.cfg.rewards.swing_height).abs() * self.foot_speed.sqrt()).sum(dim=1)

    def _reward_feet_height(self) -> Tensor:
        """At touch-down, how far the swing's peak was from the swing height, as a share of it. [P]"""
        error = (self.swing_peak / self.cfg.rewards.swing_height - 1.0).square()
        return (error * (self.first_contact & self.moving[:, None])).sum(dim=1)

    def _reward_feet_slip(self) -> Tensor:
        """Squared horizontal speed of feet in contact, while moving. [P]"""
        return (self.foot_speed.square() * (self.foot_contact & self.moving[:, None])).sum(dim=1)

    def _reward_feet_air_time(self) -> Tensor:
        """At touch-down, how much longer than the minimum the foot was in the air [s], while moving. [L, P]"""
        excess = self.feet_air_time - self.cfg.rewards.min_air_time
        return (excess * (self.first_contact & self.moving[:, None])).sum(dim=1)

    def _reward_collision(self) -> Tensor:
        """How many bodies touch the ground that should not: ``asset.penalize_contacts_on``. [L]"""
        return ((self.contact_count @ self.penalized_contacts) > 0.0).sum(dim=1).float()

    # ---- statistics: summed on the device, read once an iteration ------------------------------------------------------------

    def _sum_statistics(self) -> None:
        """Add the episodes that end in this step to the running sums. Runs before the reset."""
        ended = torch.cat([self.episode_sums, self.episode_return, self.episode_steps], dim=1)
        counts = torch.stack([self.reset_buf, self.fell, self.broken], dim=1)
        self._statistics.add_(torch.cat([torch.where(self.reset_buf[:, None], ended, 0.0), counts], dim=1).sum(dim=0))

    def take_statistics(self) -> Tensor:
        """The running sums, which then start anew, worlds whose simulator overflowed so far, curricula (S,); on the device."""
        curricula = [self.tiles.statistics()] if self.tiles else []
        if self.cfg.commands.curriculum:
            curricula.append(torch.stack([self.command_curriculum[0], torch.ones_like(self.command_curriculum[0])]))  # a sum over ranks
        taken = torch.cat([self._statistics, self.sim.overflowed_worlds()[None], *curricula])
        self._statistics.zero_()
        return taken

    def name_statistics(self, taken: list[float]) -> dict[str, float]:
        """Means over the episodes that ended, and counts, from what ``take_statistics`` gave.

        ``rew_<name>``: sum of scale * term * dt over the episode, before the clip, divided by
        ``env.episode_length_s``. ``reward``: the episode's return. ``episode_length`` [control steps]. Means are NaN if none ended.
        ``terrain_level``, and by kind of terrain: mean over the worlds. ``command_share``: of the ranges that commands come from.
        """
        curricula, taken = taken[len(self._statistics) + 1 :], taken[: len(self._statistics) + 1]
        *sums, episodes, fell, broken, overflowed = taken
        *terms, total, length = [value / episodes if episodes else math.nan for value in sums]
        per_second = self.cfg.env.episode_length_s
        named = {f"rew_{name}": value / per_second for name, value in zip(self.reward_names, terms, strict=True)}
        counts = {"episodes": episodes, "fell": fell, "broken": broken, "overflowed": overflowed}
        levels = {}
        if self.tiles:
            levels = self.tiles.name_statistics(curricula[: 2 * len(self.tiles.kinds)])
        if self.cfg.commands.curriculum:
            levels["command_share"] = curricula[-2] / curricula[-1]
        return {"reward": total, "episode_length": length, **named, **counts, **levels}

    def read_statistics(self) -> dict[str, float]:
        """Statistics since the last call, by name. Reads the device."""
        return self.name_statistics(self.take_statistics().tolist())

    # ---- what training learned about its worlds, for a checkpoint --------------------------------------------------------------

    def training_state(self) -> dict[str, Tensor]:
        """Curricula as they stand: tensors, by name."""
        state = {"kick_level": self.kick_level} if self.cfg.perturbation.curriculum else {}
        if self.tiles:
            state["terrain_levels"] = self.tiles.levels
        if self.cfg.commands.curriculum:
            state["command_curriculum"] = self.command_curriculum
            state["num_envs"] = torch.tensor(self.num_envs)
        return {name: value.clone() for name, value in state.items()}

    def load_training_state(self, state: dict[str, Tensor]) -> None:
        """Go on from ``training_state``, of several processes from the first one's; on terrain with new episodes.

        For another number of worlds: what the nearest ones had.
        """

        def spread(values: Tensor) -> Tensor:
            values = values.to(self.device)
            return values[torch.arange(self.num_envs, device=self.device) * len(values) // self.num_envs]

        if "kick_level" in state and self.cfg.perturbation.curriculum:
            self.kick_level.copy_(spread(state["kick_level"]))
        if "command_curriculum" in state and self.cfg.commands.curriculum:
            self.command_curriculum.copy_(state["command_curriculum"])
            if int(state["num_envs"]) != self.num_envs:
                self.command_curriculum[1:] = 0.0  # what was counted was of other worlds
            self._set_command_ranges()
        if "terrain_levels" in state and self.tiles:
            self._episode.zero_()  # what was under way counts for nothing
            levels, last = spread(state["terrain_levels"]), self.tiles.num_levels - 1
            if beyond := int((levels > last).sum()):
                print(f"terrain: {beyond} worlds go on on level {last}, the last one here; the checkpoint has them higher", flush=True)
            self.tiles.put(levels.clamp(max=last))
            self._reset_all()

    # ---- robot and buffers: born here, never rebound --------------------------------------------------------------------------

    def _load_robot(self, engine: str) -> RobotModel:
        cfg = self.cfg
        if not cfg.asset.file:
            raise ConfigError("asset.file is empty; name the robot's MJCF, e.g. 'resources/robots/go1/go1.xml'")
        return build_model(
            ROOT / Path(cfg.asset.file).expanduser(),  # an absolute path stays itself
            solver=Solver(cfg.sim.dt, cfg.sim.iterations, cfg.sim.ls_iterations),
            ground=Ground(cfg.terrain.friction, cfg.terrain.condim, self.terrain, boxes=engine == "mujoco"),
            stiffness=cfg.control.stiffness,
            damping=cfg.control.damping,
            colliders=cfg.asset.colliders,
            self_collisions=cfg.asset.self_collisions,
            contact_geoms=[*cfg.asset.foot_names, *cfg.asset.penalize_contacts_on, *cfg.asset.terminate_after_contacts_on],
            velocity_sites=cfg.asset.foot_names,
            accelerometer_site=cfg.asset.imu_site,
        )

    def _init_buffers(self) -> None:
        n, device, sim, robot = self.num_envs, self.device, self.sim, self.robot
        spans = robot.sensors
        self.num_feet = feet = len(self.cfg.asset.foot_names)
        self.dof_pos, self.dof_vel = sim.qpos[:, 7:], sim.qvel[:, 6:]  # views (N, D) [rad], [rad/s]
        self.base_ang_vel = sim.qvel[:, 3:6]  # view, body frame [rad/s]
        self.torques = sim.actuator_force  # view (N, D) [N m]
        self.contact_count = sim.sensordata[:, spans["contact"]]  # view (N, C), of robot.contact_geoms with the ground; feet first
        self.foot_contact_count = self.contact_count[:, :feet]  # view (N, F)
        self.foot_vel = sim.sensordata[:, spans["linvel"]].unflatten(1, (feet, 3))  # view, world frame [m/s]
        self.accelerometer = sim.sensordata[:, spans["accelerometer"]]  # view (N, 3) [m/s^2]

        def zeros(*shape: int, dtype: torch.dtype = torch.float) -> Tensor:
            return torch.zeros(n, *shape, dtype=dtype, device=device)

        self.base_lin_vel, self.projected_gravity, self.base_ang_vel_world = zeros(3), zeros(3), zeros(3)
        self.dof_offset = zeros(self.num_actions)  # joint position minus default [rad]
        self._encoder_offset = self.domain_rand.values.get("encoder_offset")
        self.joint_reading = self.dof_offset if self._encoder_offset is None else zeros(self.num_actions)  # the same, as measured
        self._action_delay = self.domain_rand.delay("action_delay", self.num_actions, start=0.0)
        self.foot_height, self.foot_speed = zeros(feet), zeros(feet)  # above the ground under the foot [m], horizontal [m/s]
        self.base_height = zeros() if self.terrain else sim.qpos[:, 2]  # of the root above the ground under it [m]
        self._init_terrain()
        self.foot_contact, self.first_contact = zeros(feet, dtype=torch.bool), zeros(feet, dtype=torch.bool)
        self.fell, self.broken, self.walked_off, self.moving = (zeros(dtype=torch.bool) for _ in range(4))
        self.commands, self.command_timer = zeros(3), zeros(1)  # vx, vy [m/s], yaw rate [rad/s]; [control steps]
        self.kick, self.kick_clock = zeros(4), zeros()  # pause, duration [control steps], direction [rad], dv [m/s]
        self.kick_force, self.kick_active = zeros(3), zeros(dtype=torch.bool)
        self.kick_level = zeros().fill_(0.0 if self.cfg.perturbation.curriculum else 1.0)  # share of the range of dv that is drawn from
        interval = self.cfg.perturbation.push_interval_s / self.dt
        self.push_clock = zeros().uniform_(0.0, interval).round_() if self.cfg.perturbation.push else zeros()  # [control steps] to go
        self._init_episode_memory()
        self._init_imu()
        self._init_contacts()
        self.foot_sites = torch.tensor([robot.id("site", name) for name in self.cfg.asset.foot_names], device=device)
        self.gravity_dir = torch.tensor([0.0, 0.0, -1.0], device=device).expand(n, 3)
        self.total_mass = float(robot.physics.body_subtreemass[0])  # [kg]

    def _init_episode_memory(self) -> None:
        """Per-episode memory as columns of one matrix, so that a reset clears it in one go."""
        joints, feet, terms = self.num_actions, self.num_feet, len(self._active_scales())
        widths = {"last_actions": joints, "feet_air_time": feet, "swing_peak": feet}
        if self.tiles:
            widths |= {"progress": 1, "asked": 1, "asked_speed": 1, "farthest": 1}
        self._episode, views = columns(self.num_envs, self.device, **widths, episode_sums=terms, episode_return=1, episode_steps=1)
        for name, view in views.items():
            setattr(self, name, view)
        self._statistics = torch.zeros(terms + 5, device=self.device)

    def _init_terrain(self) -> None:
        """Tiles and heights, where there is terrain, and the height scan's points (P,) each [m]."""
        cfg, n = self.cfg.terrain, self.num_envs
        self.tiles = Tiles(self.cfg, self.terrain, n, self.device) if self.terrain else None
        self._height_at = make_height_map(self.terrain, self.device) if self.terrain else None
        grid = torch.cartesian_prod(torch.tensor(cfg.measured_points_x), torch.tensor(cfg.measured_points_y)).view(-1, 2)
        self.scan_points = grid.to(self.device, torch.float).unbind(dim=1)
        self.height_scan = torch.zeros(n, len(grid) if cfg.height_scan else 0, device=self.device)  # (N, P) [m]

    def _init_imu(self) -> None:
        robot, model = self.robot, self.robot.physics
        imu = robot.id("site", self.cfg.asset.imu_site)
        self.root_body = robot.id("body", robot.root)
        if model.site_bodyid[imu] != self.root_body or abs(model.site_quat[imu][0]) < 1.0 - 1e-9:
            raise ModelError(f"asset.imu_site '{self.cfg.asset.imu_site}' must be on the root body '{robot.root}' and aligned with it")
        self.imu_pos = torch.tensor(model.site_pos[imu], dtype=torch.float, device=self.device).expand(self.num_envs, 3)  # body frame [m]

    def _init_contacts(self) -> None:
        """Which columns of ``contact_count`` are a fall, and (C, B) which are of which penalised body."""
        asset, geoms, model = self.cfg.asset, self.robot.contact_geoms, self.robot.physics
        terminating = self._contact_columns(asset.terminate_after_contacts_on, "terminate_after_contacts_on")
        penalized = self._contact_columns(asset.penalize_contacts_on, "penalize_contacts_on")
        if self._active_scales().get("collision") and not penalized:
            raise ConfigError("rewards.scales.collision is on, but asset.penalize_contacts_on names nothing; name what should not touch")
        body = {column: int(model.geom_bodyid[self.robot.id("geom", geoms[column])]) for column in penalized}
        bodies = sorted(set(body.values()))
        table = torch.zeros(len(geoms), len(bodies))
        for column in penalized:
            table[column, bodies.index(body[column])] = 1.0
        self.penalized_contacts = table.to(self.device)
        self.terminating_contacts = torch.tensor(terminating, dtype=torch.long, device=self.device)

    def _contact_columns(self, patterns: list[str], field: str) -> list[int]:
        """Columns of ``contact_count`` that ``patterns`` mean; each of the geoms must be one that can touch the ground."""
        hits = [i for i, name in enumerate(self.robot.contact_geoms) if any(fnmatchcase(name, pattern) for pattern in patterns)]
        for name in (self.robot.contact_geoms[i] for i in hits):
            if not self.robot.physics.geom_conaffinity[self.robot.id("geom", name)]:
                raise ConfigError(
                    f"asset.{field}: '{name}' never touches the ground; add it to asset.colliders: {self.cfg.asset.colliders}"
                )
        return hits

    def _init_ranges(self) -> None:
        """Config numbers as tensors: joints' tables, reset and command ranges."""
        cfg, names = self.cfg, self.robot.joint_names

        def tensor(values: object) -> Tensor:
            return torch.tensor(values, dtype=torch.float, device=self.device)

        self.default_dof_pos = tensor(per_joint(cfg.init_state.default_joint_angles, names, "init_state.default_joint_angles"))
        self.pose_weights = tensor(per_joint(cfg.rewards.pose_weights, names, "rewards.pose_weights"))
        low, high = tensor(self.robot.joint_range).unbind(dim=1)
        middle, half = (low + high) / 2, (high - low) / 2 * cfg.rewards.soft_dof_pos_limit
        self.soft_lower, self.soft_upper = middle - half, middle + half
        init, ranges, kick = cfg.init_state, cfg.commands.ranges, cfg.perturbation
        self.init_pos = tensor(init.pos)
        self.reset_range = tensor([init.pos_xy_range] * 2 + [init.yaw_range] + [init.lin_vel_range] * 3 + [init.ang_vel_range] * 3)
        self.full_command_ranges = tensor([ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw]).T.contiguous()  # (2, 3)
        self.command_curriculum = tensor([cfg.commands.curriculum_start if cfg.commands.curriculum else 1.0, 0.0, 0.0])
        self.still_command = torch.zeros(3, device=self.device).clamp(*self.full_command_ranges).expand(2, 3)
        self.command_ranges = self.full_command_ranges.clone()
        if cfg.commands.curriculum:
            self._set_command_ranges()
        self.keep_probability = tensor(cfg.commands.keep_probability)
        self.kick_ranges = tensor([kick.interval, kick.duration, [-math.pi, math.pi], kick.velocity]).T.contiguous()  # (2, 4)

    # declared for readers and type checkers; columns of self._episode, (N, width)
    last_actions: Tensor  # D
    feet_air_time: Tensor  # F, since the last contact [s]
    swing_peak: Tensor  # F, highest foot position since the last contact [m]
    episode_sums: Tensor  # K, scale * term * dt summed over the episode
    episode_return: Tensor  # 1
    progress: Tensor  # 1, along the commands [m]; only on terrain, as the three below
    asked: Tensor  # 1, what the commands asked [m]
    asked_speed: Tensor  # 1, what the last one asked [m/s]
    farthest: Tensor  # 1, from the middle of the tile, along x or y [m]
    episode_steps: Tensor  # 1, since the reset; episode_length_buf may start elsewhere
