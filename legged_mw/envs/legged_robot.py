"""A legged robot that walks by command: commands, feet, ground and their curricula, read top to bottom.

Actions, base and joint state, resets and the reward machinery are in ``robot_task``. Its rules also hold here.
The reward terms are at the end. Shapes: N environments, C commands, F feet.

Sources of the terms: [P] MuJoCo Playground; [L] legged_gym; [U] unitree_rl_gym; [UL] unitree_rl_lab; [I] Isaac Lab's
velocity tasks; [M] mjlab; [H] holosoma; [W] walk-these-ways.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from legged_mw.envs.feet import FootContacts, GaitClock
from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.envs.mirror import NO_MIRROR, Block, command_block, foot_blocks, scan_block
from legged_mw.envs.observations import Row
from legged_mw.envs.robot_task import RobotTask, not_sensed, require
from legged_mw.envs.terrain import Tiles, build_terrain
from legged_mw.sim.engines import make_height_map
from legged_mw.sim.mirror import Partners, find_partners, opposites
from legged_mw.sim.model import upright
from legged_mw.sim.sensors import CONTACT_FORCE
from legged_mw.sim.terrain import PLATFORM, Terrain
from legged_mw.utils.commands import VELOCITY, command_table
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import ModelError
from legged_mw.utils.math import assign, maybe_any, quat_rotate, spread, wrap_to_pi, yaw_of

PHASE_SIGMA = 0.01  # [m^2] of feet_phase: an error of 0.1 m in height gives 1/e [P]


class LeggedRobot(RobotTask):
    """N legged robots that follow commands (N, C): vx, vy, yaw rate, and those that a task adds to its ranges."""

    cfg: LeggedRobotCfg
    exam = "walking"
    SENSED_FOR: ClassVar[Mapping[str, str]] = {
        **RobotTask.SENSED_FOR,
        **dict.fromkeys(("feet_contact_forces", "soft_landing", "stumble"), CONTACT_FORCE),
    }

    # ---- the step -------------------------------------------------------------------------------------------------

    def _update_state(self) -> None:
        super()._update_state()
        self.feet.update()
        torch.gt(self.feet.count, 0.0, out=self.foot_contact)
        torch.logical_and(self.foot_contact, self.feet_air_time > 0.0, out=self.first_contact)
        self.feet_air_time.add_(self.dt)
        self._time_contacts()
        self._measure_ground()
        torch.maximum(self.swing_peak, self.foot_height, out=self.swing_peak)
        torch.hypot(self.foot_vel[..., 0], self.foot_vel[..., 1], out=self.foot_speed)
        self.is_commanded(out=self.moving)

    def is_commanded(self, out: Tensor | None = None) -> Tensor:
        """(N,) True if the velocity command is to move, not to stand; written into ``out`` if given."""
        return torch.gt(self.velocity_command.square().sum(dim=1), self.cfg.rewards.min_command**2, out=out)

    def _end_step(self) -> None:
        super()._end_step()
        if "feet_impact_vel" in self.reward_names:
            self.last_foot_vel_z.copy_(self.foot_vel[..., 2])
        self.feet_air_time.masked_fill_(self.foot_contact, 0.0)
        self.swing_peak.masked_fill_(self.foot_contact, 0.0)
        if self.gait:
            self.gait.tick()
        if self.cfg.commands.resampling_time > 0:
            self.command_timer.sub_(1.0)
            over = self.command_timer[:, 0] <= 0.0
            if maybe_any(over):
                self._resample_commands(over)
            if self.cfg.commands.heading_command:
                self._steer_to_heading()

    def _timed_out(self) -> Tensor:
        """(N,) True at the time limit, or off the terrain, which is not a fall."""
        over = super()._timed_out()
        if self.tiles:
            torch.gt((self.root_pos[:, :2].abs() - self.tiles.edge).amax(dim=1), 0.0, out=self.walked_off)
            over |= self.walked_off
        return over

    def _reset_task(self, mask: Tensor) -> None:
        """Draw new commands, and clear the feet's contacts and heights."""
        self._reset_commands(mask)
        self.foot_contact.masked_fill_(mask[:, None], False)
        if self.tiles:
            assign(self.base_height, mask, self.init_pos[2])
        if self.tiles or self.cfg.observations.foot_height:
            self.foot_height.masked_fill_(mask[:, None], 0.0)  # remove the last episode's values
        if self.feet.forces is not None:
            self.feet.forces.masked_fill_(mask[:, None, None], 0.0)
        if self.gait:
            self.gait.restart(mask)

    # ---- ground -----------------------------------------------------------------------------------------------------

    def _measure_ground(self) -> None:
        """Measure the heights of feet and root above the ground, and the walked distance."""
        torch.index_select(self.sim.site_xpos, 1, self.foot_sites, out=self.foot_pos)
        if not (self.tiles and self._height_at):
            return  # on a plane foot_height is the z of foot_pos
        points = torch.cat([self.foot_pos, self.root_pos[:, None]], dim=1)
        above = points[..., 2] - self._height_at(points[..., :2])
        self.foot_height.copy_(above[:, :-1])
        self.base_height.copy_(above[:, -1])
        speed = self.commands[:, :2].square().sum(dim=1, keepdim=True).sqrt()
        self.commanded_speed.copy_(torch.where(speed > self.cfg.rewards.min_command, speed, 0.0))
        along = (self.base_lin_vel[:, :2] * self.commands[:, :2]).sum(dim=1, keepdim=True) / speed.clamp(min=1e-6)
        self.progress.addcmul_(along, (self.commanded_speed > 0.0).float(), value=self.dt)
        self.commanded_distance.add_(self.commanded_speed, alpha=self.dt)
        away = (self.root_pos[:, :2] - self.tiles.origins[:, :2]).abs().amax(dim=1, keepdim=True)
        torch.maximum(self.max_distance, away, out=self.max_distance)

    def _scan_heights(self) -> None:
        """Measure the height scan [m]: 0 for standing on level ground, positive for lower ground, clipped to 1 m."""
        root, yaw = self.root_pos, yaw_of(self.root_quat)
        cos, sin = torch.cos(yaw)[:, None], torch.sin(yaw)[:, None]
        px, py = self.scan_points
        level = root[:, 2:] - self.init_pos[2]
        if self._height_at:
            points = torch.stack([cos * px - sin * py + root[:, :1], sin * px + cos * py + root[:, 1:2]], dim=2)
            level = level - self._height_at(points)
        self.height_scan.copy_(level.clamp(-1.0, 1.0).expand_as(self.height_scan))

    def _start_places(self, offset: Tensor) -> Tensor:
        """Root position at reset (N, 3) [m, world], on the world's tile."""
        if not self.tiles:
            return super()._start_places(offset)
        place = self.init_pos + self.tiles.origins
        at, height = place[:, :2] + offset, place[:, 2:]
        if self._height_at and self.cfg.init_state.pos_xy_range > PLATFORM / 2:  # beyond the flat middle of a tile
            height = self.init_pos[2] + self._height_at(at)[:, None]
        return torch.cat([at, height], dim=1)

    def _update_curricula(self, mask: Tensor) -> None:
        """Update the curricula of kicks, terrain levels and command ranges."""
        super()._update_curricula(mask)
        if self.tiles:
            self._update_terrain_curriculum(mask)
        if self.cfg.commands.curriculum:
            self._update_command_curriculum(mask)

    def _share_survived(self) -> Tensor:
        """(N,) Length of the episode, as a share of the longest, also if the robot left the terrain."""
        share = self.episode_steps[:, 0] / self.max_episode_length
        return torch.where(self.walked_off, share, super()._share_survived())

    def _update_terrain_curriculum(self, mask: Tensor) -> None:
        """Go up one level if the robot left its tile; down if it walked less than half the commanded distance. [L]

        After a fall, the commanded distance includes the rest of the episode at the last command.
        """
        assert self.tiles
        left = (self.max_episode_length - self.episode_steps[:, 0]).clamp(min=0.0) * self.dt
        owed = self.commanded_distance[:, 0] + torch.where(self.fell, self.commanded_speed[:, 0] * left, 0.0)
        up = self.max_distance[:, 0] > self.tiles.size / 2
        down = ~up & (self.progress[:, 0] < 0.5 * owed)
        self.tiles.promote(mask, up, down)

    # ---- commands ---------------------------------------------------------------------------------------------------

    def _reset_commands(self, mask: Tensor) -> None:
        """Draw the command of a new episode from the ranges, never the command to stand."""
        assign(self.commands, mask, self._new_commands())
        assign(self.command_timer, mask, self._draw_timers())
        self._draw_heading(mask)

    def _resample_commands(self, mask: Tensor) -> None:
        """At the end of a timer, keep each value, set it to its default (velocities 0), or draw a new one."""
        count = len(self.command_table)
        chance = torch.rand(self.num_envs, 2 * count, device=self.device)
        fresh = torch.where(chance[:, :count] < self.keep_probability, self._new_commands(), self.rest_command)
        change = (chance[:, count:] < self.cfg.commands.change_probability) & mask[:, None]
        self.commands.copy_(torch.where(change, fresh, self.commands))
        assign(self.command_timer, mask, self._draw_timers())
        self._draw_heading(mask)

    def _draw_heading(self, mask: Tensor) -> None:
        """Draw a heading, and compute its yaw rate, where ``mask`` (N,) is true; not for a caller's commands. [L]"""
        commands = self.cfg.commands
        if commands.heading_command and commands.resampling_time > 0:
            low, high = commands.ranges.heading
            assign(self.heading, mask, torch.empty_like(self.heading).uniform_(low, high))
            self._steer_to_heading()

    def _steer_to_heading(self) -> None:
        """Set the yaw rate proportional to the heading error, within its range. [L]"""
        error = wrap_to_pi(self.heading - yaw_of(self.root_quat))
        low, high = self.command_ranges[:, 2]
        self.commands[:, 2] = (self.cfg.commands.heading_gain * error).clamp(low, high)

    def _new_commands(self) -> Tensor:
        """(N, C) Commands, uniform in the ranges, or at an end of the range with ``commands.end_probability``."""
        (low, high), place = self.command_ranges, torch.rand_like(self.commands)
        if self.cfg.commands.end_probability:
            at_end = torch.rand_like(self.commands) < self.cfg.commands.end_probability
            place = torch.where(at_end, place.round(), place)
        return torch.lerp(low, high, place)

    def _draw_timers(self) -> Tensor:
        """(N, 1) Timers from an exponential distribution, rounded to control steps."""
        mean = self.cfg.commands.resampling_time / self.dt
        return torch.empty(self.num_envs, 1, device=self.device).exponential_().mul_(mean).round_()

    def _update_command_curriculum(self, mask: Tensor) -> None:
        """After every N episodes, widen the ranges if the velocity was tracked well. [L]"""
        share, total, count = self.command_curriculum  # each ()
        term = self.reward_names.index("tracking_lin_vel")
        best = self.reward_scales[term] * self.episode_steps[:, 0]
        tracked = self.episode_sums[:, term] / best.clamp(min=1e-9)
        total.add_(torch.where(mask, tracked, 0.0).sum())
        count.add_(mask.sum())
        full = count >= self.num_envs
        grown = full & (total > 0.8 * count)
        share.copy_(torch.where(grown, share + self.cfg.commands.curriculum_step, share).clamp(max=1.0))
        total.masked_fill_(full, 0.0)
        count.masked_fill_(full, 0.0)
        self._set_command_ranges()

    def _set_command_ranges(self) -> None:
        """Set the command ranges to the curriculum's share, around the defaults."""
        torch.lerp(self._narrowest, self.full_command_ranges, self.command_curriculum[0], out=self.command_ranges)

    # ---- observations -----------------------------------------------------------------------------------------------

    def observation_rows(self) -> dict[str, list[Row | str]]:
        return {
            "state": [
                *self._measured_rows(),
                *self._gait_rows(),
                Row("commands", self.commands, mirror="command"),  # vx, vy [m/s], yaw rate [rad/s], body frame; others
                *self._height_rows("state", self.cfg.noise.scales.height_scan),
            ],
            "privileged_state": [
                "state",  # with the same noise sample
                *self._body_rows(),
                Row("foot_contact", self.foot_contact, mirror="foot"),  # 0 or 1
                Row("foot_lin_vel", self.foot_vel.flatten(1), mirror="foot_polar", unit="m/s", frame="world"),
                Row("feet_air_time", self.feet_air_time, mirror="foot", unit="s"),  # since lift-off; 0 in contact
                *self._more_foot_rows(),
                *self._disturbance_rows(),
                *self._height_rows("privileged_state"),
            ],
        }

    def _gait_rows(self) -> list[Row]:
        """With a gait clock: sines of the feet's phases, then cosines; zeros with a command to stand."""
        return [Row("gait_clock", self.gait.row, mirror="foot")] if self.gait else []

    def _more_foot_rows(self) -> list[Row]:
        """Optional rows of ``observations``: heights of the feet above the ground; ground forces in 100 N."""
        rows = []
        if self.cfg.observations.foot_height:
            frame = "site above the ground under it"
            rows.append(Row("foot_height", self.foot_height, mirror="foot", unit="m", frame=frame))
        if self.cfg.observations.contact_forces:
            forces = self.contact_forces.flatten(1)
            row = Row("contact_forces", forces, mirror="foot_polar", scale=0.01, unit="N", frame="world")
            rows.append(row)
        return rows

    def _height_rows(self, group: str, noise: float = 0.0) -> list[Row]:
        """The height scan [m] if ``terrain.height_scan`` names the group; by x from behind, each from right to left."""
        row = Row("height_scan", self.height_scan, noise, mirror="height_scan", measured=group == "state")
        return [row] if group in self.cfg.terrain.height_scan else []

    def compute_observations(self) -> None:
        if self.gait:
            self.gait.observe(self.is_commanded())
        if self.cfg.terrain.height_scan:
            self._scan_heights()
        super().compute_observations()

    def _prepare_observations(self) -> None:
        super()._prepare_observations()
        for group in self.cfg.terrain.height_scan:
            left_out = "height_scan" in self.cfg.observations.leave_out.get(group, [])
            if not left_out and not any(row.name == "height_scan" for row in self.observations.groups.get(group, [])):
                here = f"{type(self).__name__}.observation_rows has no row height_scan in '{group}'"
                mend = f"add *self._height_rows('{group}', noise) to it"
                raise ConfigError(f"terrain.height_scan names '{group}', but {here}; {mend}")

    def _mirror_blocks(self) -> dict[str, Block]:
        terrain, blocks = self.cfg.terrain, super()._mirror_blocks()
        blocks |= {**foot_blocks(self._partners()), "command": command_block(self.command_table, self.mirror_reach)}
        if terrain.height_scan:
            blocks["height_scan"] = scan_block(terrain.measured_points_x, terrain.measured_points_y)
        return blocks

    def _partners(self) -> Partners:
        feet = self.foot_names
        try:
            return find_partners(self.robot, feet)
        except ModelError:
            for foot in feet:
                if (others := opposites(self.robot, foot)) and not {*others} & {*feet}:
                    what = f"asset.foot_names has {len(feet)} feet; {others[0]} is missing, on the other side of {foot}"
                    raise ConfigError(f"{what}: name it too, or {NO_MIRROR}") from None
            raise

    # ---- statistics, checkpoint -------------------------------------------------------------------------------------

    def _live_statistics(self) -> dict[str, Tensor]:
        """Share of the commanded speed; mean terrain levels of all worlds and by kind; the curriculum's share."""
        live = {**super()._live_statistics(), "walked": self._walked()}
        if self.tiles:
            live |= self.tiles.statistics()
        if self.cfg.commands.curriculum:
            share = self.command_curriculum[0]
            live["command_share"] = torch.stack([share, torch.ones_like(share)])
        return live

    def _walked(self) -> Tensor:
        """(2,) The speed along the commanded direction, and the commanded speed [m/s], each summed over worlds.

        Their quotient is the walked share of the commanded distance.
        """
        commanded, measured = self.commands[:, :2], self.base_lin_vel[:, :2]
        speed = commanded.square().sum(dim=1).sqrt()
        along = (measured * commanded).sum(dim=1) / speed.clamp(min=1e-6)
        moving = speed > self.cfg.rewards.min_command
        return torch.stack([torch.where(moving, each, 0.0).sum() for each in (along, speed)])

    def training_state(self) -> dict[str, Tensor]:
        state = super().training_state()
        if self.tiles:
            state["terrain_levels"] = self.tiles.levels.clone()
        if self.cfg.commands.curriculum:
            state |= {"command_curriculum": self.command_curriculum.clone(), "num_envs": torch.tensor(self.num_envs)}
        return state

    def load_training_state(self, state: dict[str, Tensor]) -> None:
        """Load ``training_state``. On terrain, new episodes start."""
        super().load_training_state(state)
        if "command_curriculum" in state and self.cfg.commands.curriculum:
            self.command_curriculum.copy_(state["command_curriculum"])
            if int(state["num_envs"]) != self.num_envs:
                self.command_curriculum[1:] = 0.0  # these counts are of other worlds
            self._set_command_ranges()
        if "terrain_levels" in state and self.tiles:
            self._episode.zero_()  # unfinished episodes do not count
            levels, last = spread(state["terrain_levels"], self.num_envs), self.tiles.num_levels - 1
            if beyond := int((levels > last).sum()):
                where = f"on level {last}, the last one here; the checkpoint has them higher"
                print(f"terrain: {beyond} worlds go on {where}", flush=True)
            self.tiles.put(levels.clamp(max=last))
            self._reset_all()

    # ---- robot and buffers: made here, never rebound ----------------------------------------------------------------

    @property
    def foot_names(self) -> tuple[str, ...]:
        """``asset.foot_names``: the order of the feet in every tensor."""
        return tuple(self.cfg.asset.foot_names)

    @property
    def foot_geoms(self) -> dict[str, tuple[str, ...]]:
        """Names of the geoms of each foot."""
        return {foot: self.robot.site_geoms[foot] for foot in self.foot_names}

    def _make_terrain(self) -> Terrain | None:
        if not isinstance(self.cfg, LeggedRobotCfg):
            what = f"it needs a LeggedRobotCfg, not a {type(self.cfg).__name__}"
            raise ConfigError(f"{type(self).__name__} walks by command: {what}")
        return build_terrain(self.cfg)

    def _sensed_geoms(self) -> list[str]:
        """The geoms of the feet, then the others."""
        return [*(geom for geoms in self._sensed_sites().values() for geom in geoms), *super()._sensed_geoms()]

    def _sensed_sites(self) -> dict[str, list[str]]:
        return {foot: self.cfg.asset.foot_geoms.get(foot, [foot]) for foot in self.foot_names}

    def _init_buffers(self) -> None:
        super()._init_buffers()
        self.num_feet = feet = len(self.foot_names)
        linvel = self.sim.sensordata[:, self.robot.sensors["linvel"]]
        self.foot_vel = linvel.unflatten(1, (feet, 3))  # view, world frame [m/s]
        self.foot_sites = torch.tensor([self.robot.id("site", name) for name in self.foot_names], device=self.device)
        self.foot_pos = self.buffer(feet, 3)  # [m, world]
        contacts = FootContacts(self.robot, self.foot_geoms.values(), self.sim.sensordata, self.contact_count)
        self.feet = self.remember(contacts)
        self.foot_contact, self.first_contact = (self.buffer(feet, dtype=torch.bool) for _ in range(2))
        self.foot_speed = self.buffer(feet)  # horizontal [m/s]
        self._init_terrain()
        self.walked_off, self.moving = (self.buffer(dtype=torch.bool) for _ in range(2))
        self._init_commands()
        clock, names = self.cfg.gait, self.foot_names
        gait = GaitClock(clock, names, self.num_envs, self.dt, self.device) if clock.period > 0.0 else None
        self.gait = self.remember(gait)
        self._init_foot_rewards()

    def _episode_columns(self) -> dict[str, int]:
        times = ["feet_contact_time", "last_air_time", "last_contact_time"]
        optional = {"single_stance": times[:1], "air_time_variance": times, "feet_impact_vel": ["last_foot_vel_z"]}
        of_feet = [name for term in self._active_scales() for name in optional.get(term, [])]
        of_feet += ["feet_air_time", "swing_peak"]
        ground = ["progress", "commanded_distance", "commanded_speed", "max_distance"] if self.terrain else []
        feet, walk = dict.fromkeys(of_feet, len(self.foot_names)), dict.fromkeys(ground, 1)
        return {**super()._episode_columns(), **feet, **walk}

    feet_air_time: Tensor  # (N, F) since the last contact [s]
    swing_peak: Tensor  # (N, F) highest foot position since the last contact [m]
    progress: Tensor  # (N, 1) along the commands [m]; only on terrain, as the three below
    commanded_distance: Tensor  # (N, 1) [m]
    commanded_speed: Tensor  # (N, 1) of the last command [m/s]
    max_distance: Tensor  # (N, 1) from the middle of the tile, along x or y [m]
    feet_contact_time: Tensor  # (N, F) since touch-down [s]; only with `single_stance` or `air_time_variance`
    last_air_time: Tensor  # (N, F) of the last swing that ended [s]; only with `air_time_variance`
    last_contact_time: Tensor  # (N, F) of the last stance that ended [s]; likewise
    last_foot_vel_z: Tensor  # (N, F) of the step before [m/s]; only with `feet_impact_vel`

    def _init_terrain(self) -> None:
        """Make tiles and heights, if there is terrain, and the points of the height scan, (P,) x and y [m]."""
        cfg, terrain = self.cfg.terrain, self.terrain
        self.tiles = self.remember(Tiles(self.cfg, terrain, self.num_envs, self.device)) if terrain else None
        self._height_at = make_height_map(terrain, self.device) if terrain else None
        self.foot_height = self.buffer(self.num_feet) if terrain else self.foot_pos[..., 2]  # above the ground [m]
        self.base_height = self.buffer() if terrain else self.base_height  # likewise
        xs, ys = torch.tensor(cfg.measured_points_x), torch.tensor(cfg.measured_points_y)
        grid = torch.cartesian_prod(xs, ys).view(-1, 2)
        self.scan_points = grid.to(self.device, torch.float).unbind(dim=1)
        self.height_scan = self.buffer(len(grid) if cfg.height_scan else 0)  # (N, P) [m]

    def _init_commands(self) -> None:
        cfg, table = self.cfg.commands, command_table(self.cfg)
        self.command_table, count = table, len(table)
        self.commands, self.command_timer = self.buffer(count), self.buffer(1)  # [unit of each]; [control steps]
        self.velocity_command = self.commands[:, :3]  # view: vx, vy [m/s], yaw rate [rad/s]
        self.heading = self.buffer()  # target heading of the root's x axis, world frame [rad]
        ranges = self._tensor([[command.low, command.high] for command in table])
        self.full_command_ranges = ranges.T.contiguous()  # (2, C)
        self.command_ranges = self.remember(self.full_command_ranges.clone())  # the ranges in use
        self._narrowest = self._tensor([command.default for command in table]).expand(2, count)
        rest = [0.0 if command.name in VELOCITY else command.default for command in table]
        self.rest_command = self._tensor(rest)
        self.keep_probability = self._tensor([*cfg.keep_probability, *[1.0] * (count - len(cfg.keep_probability))])
        # share of the ranges; sum and number of the episodes since its last increase
        curriculum = self._tensor([cfg.curriculum_start if cfg.curriculum else 1.0, 0.0, 0.0])
        self.command_curriculum = self.remember(curriculum)
        if cfg.curriculum:
            self._set_command_ranges()

    # ---- reward terms, and what the active ones need besides the state ----------------------------------------------

    def on_training_progress(self, share: float) -> None:
        """Move ``tracking_sigma`` to ``rewards.tracking_sigma_end``. ``share``: progress of the training, 0 to 1."""
        super().on_training_progress(share)
        begin, end = self.cfg.rewards.tracking_sigma, self.cfg.rewards.tracking_sigma_end
        if isinstance(self._sigma, Tensor):
            self._sigma.fill_(begin + (end - begin) * share)

    @property
    def tracking_sigma(self) -> Tensor | float:
        """Sigma of the tracking terms [m^2/s^2, rad^2/s^2]: a number, () if it changes, (N,) if levels change it."""
        if self.sigma_growth is None or not self.tiles:
            return self._sigma
        return self._sigma * (1.0 + self.sigma_growth * self.tiles.levels)

    @tracking_sigma.setter
    def tracking_sigma(self, sigma: Tensor | float) -> None:
        self._sigma = sigma

    def _init_foot_rewards(self) -> None:
        """Make the buffers that only active terms need."""
        on, rewards = self._active_scales(), self.cfg.rewards
        self.tracking_sigma = rewards.tracking_sigma
        if rewards.tracking_sigma_end > 0.0:
            self.tracking_sigma = self.remember(torch.tensor(rewards.tracking_sigma, device=self.device))
        # (N,) increase per level, by each world's kind of ground
        self.sigma_growth = self.tiles.of_kinds(rewards.tracking_sigma_growth) if self.tiles else None
        if not {"feet_orientation", "feet_distance"} & on.keys():
            return
        stands = upright(self.robot, self.default_dof_pos.tolist(), self.foot_names)
        # (N, F, 3) vertical axis in each foot's frame, in the default pose
        self.foot_up = self._tensor(stands.up).expand(self.num_envs, -1, -1)
        self.foot_bodies = torch.tensor(stands.bodies, dtype=torch.long, device=self.device)  # (F,) each foot's body
        if "feet_distance" in on and self.num_feet > 1:
            other = [1, 0] if self.num_feet == 2 else self._partners().sites
            pairs = [(i, j) for i, j in enumerate(other) if stands.places[i, 1] > stands.places[j, 1]]
            # (2, pairs) the left foot and the right foot of each pair
            self.neighbours = torch.tensor(pairs, dtype=torch.long, device=self.device).view(-1, 2).T.contiguous()

    def _sensed_on_demand(self) -> list[str]:
        row = [CONTACT_FORCE] if self.cfg.observations.contact_forces else []
        return [*super()._sensed_on_demand(), *row]

    @property
    def contact_forces(self) -> Tensor:
        """(N, F, 3) Force of the ground on each foot in the last substep, world frame [N]; 0 in a world just reset."""
        if self.feet.forces is None:
            raise not_sensed("contact_forces")
        return self.feet.forces

    def _time_contacts(self) -> None:
        """Time stances and swings if an active term needs them, after ``feet_air_time`` was updated in this step."""
        own = vars(self)
        if "last_air_time" in own:
            lifted = ~self.foot_contact & (self.feet_contact_time > 0.0)
            self.last_air_time.copy_(torch.where(self.first_contact, self.feet_air_time, self.last_air_time))
            self.last_contact_time.copy_(torch.where(lifted, self.feet_contact_time, self.last_contact_time))
        if "feet_contact_time" in own:
            self.feet_contact_time.add_(self.dt).masked_fill_(~self.foot_contact, 0.0)

    def _reward_tracking_lin_vel(self) -> Tensor:
        """Velocity in the plane at the IMU, body frame, as commanded. [L]"""
        error = (self.commands[:, :2] - self.base_lin_vel[:, :2]).square().sum(dim=1)
        return torch.exp(error / -self.tracking_sigma)

    def _reward_tracking_ang_vel(self) -> Tensor:
        """Yaw rate as commanded. [L]"""
        error = (self.commands[:, 2] - self.base_ang_vel[:, 2]).square()
        return torch.exp(error / -self.tracking_sigma)

    def _reward_stand_still(self) -> Tensor:
        """Joints away from the default pose while the command is to stand [rad]. [L]"""
        return self.dof_offset.abs().sum(dim=1).masked_fill_(self.moving, 0.0)

    def _reward_stand_drift(self) -> Tensor:
        """Horizontal speed at the IMU while the command is to stand [m/s]. [ours]"""
        return self.base_lin_vel[:, :2].norm(dim=1).masked_fill_(self.moving, 0.0)

    def _reward_feet_clearance(self) -> Tensor:
        """Feet that move fast away from the swing height [m^1.5/s^0.5]. [P]"""
        return ((self.foot_height - self.cfg.rewards.swing_height).abs() * self.foot_speed.sqrt()).sum(dim=1)

    def _reward_feet_height(self) -> Tensor:
        """At touch-down, the squared error of the swing's peak, as a share of the swing height. [P]"""
        error = (self.swing_peak / self.cfg.rewards.swing_height - 1.0).square()
        return (error * (self.first_contact & self.moving[:, None])).sum(dim=1)

    def _reward_feet_slip(self) -> Tensor:
        """Squared horizontal speed of feet in contact, while moving [m^2/s^2]. [P]"""
        return (self.foot_speed.square() * (self.foot_contact & self.moving[:, None])).sum(dim=1)

    def _reward_feet_air_time(self) -> Tensor:
        """At touch-down, the foot's time in the air beyond ``rewards.min_air_time`` [s], while moving. [L, P]"""
        excess = self.feet_air_time - self.cfg.rewards.min_air_time
        return (excess * (self.first_contact & self.moving[:, None])).sum(dim=1)

    def _reward_feet_distance(self) -> Tensor:
        """Lack of sideways distance between left and right feet, of ``rewards.min_feet_distance`` [m]. [P, H]

        Sideways is across the base's heading; feet that cross have a negative distance. Of more than two feet it is the
        sum over mirrored pairs.
        """
        require(self.num_feet > 1, "feet_distance", "asset.foot_names has one foot, which has no neighbour")
        yaw, (left, right) = yaw_of(self.root_quat)[:, None], self.neighbours
        apart = self.foot_pos.index_select(1, left) - self.foot_pos.index_select(1, right)
        sideways = torch.cos(yaw) * apart[..., 1] - torch.sin(yaw) * apart[..., 0]
        return (self.cfg.rewards.min_feet_distance - sideways).clamp(min=0.0).sum(dim=1)

    def _reward_feet_orientation(self) -> Tensor:
        """Sum over feet of the squared sine of their tilt; a foot is flat in the default pose. [H -5]"""
        up = quat_rotate(self.sim.xquat.index_select(1, self.foot_bodies), self.foot_up)
        return up[..., :2].square().sum(dim=(1, 2))

    def _reward_air_time_variance(self) -> Tensor:
        """Variances over feet of the last swing's and the last stance's time, at most 0.5 s each [s^2]. [I, UL -1]"""
        require(self.num_feet > 1, "air_time_variance", "asset.foot_names has one foot")
        swings, stances = (time.clamp(max=0.5).var(dim=1) for time in (self.last_air_time, self.last_contact_time))
        return swings + stances

    def _reward_feet_contact_without_cmd(self) -> Tensor:
        """Number of feet on the ground while the command is to stand. [UL]"""
        return self.foot_contact.sum(dim=1).float().masked_fill_(self.moving, 0.0)

    def _reward_feet_impact_vel(self) -> Tensor:
        """At touch-down, the foot's squared downward speed a step before [m^2/s^2]. [W, also for standing feet]"""
        return (self.last_foot_vel_z.clamp(max=0.0).square() * self.first_contact).sum(dim=1)

    def _reward_feet_contact_forces(self) -> Tensor:
        """The ground's forces on feet beyond ``rewards.max_contact_force`` [N]. [L]"""
        return (self.contact_forces.norm(dim=2) - self.cfg.rewards.max_contact_force).clamp(min=0.0).sum(dim=1)

    def _reward_soft_landing(self) -> Tensor:
        """At touch-down, the ground's force on the foot [N], while moving. [M -1e-5]"""
        return (self.contact_forces.norm(dim=2) * (self.first_contact & self.moving[:, None])).sum(dim=1)

    def _reward_stumble(self) -> Tensor:
        """1 where a foot hits something upright: a horizontal force of more than five times the vertical one. [L]"""
        forces = self.contact_forces
        return (forces[..., :2].norm(dim=2) > 5.0 * forces[..., 2].abs()).any(dim=1).float()

    def _reward_single_stance(self) -> Tensor:
        """Biped: time on exactly one foot [s] while moving, up to ``rewards.max_single_stance`` and down again. [I, M]

        It is the smaller of one foot's contact time and the other's air time, so that short steps earn little.
        Beyond ``max_single_stance`` it falls off, to 0 at twice that time.
        """
        self._need_two_feet("single_stance")
        since = torch.where(self.foot_contact, self.feet_contact_time, self.feet_air_time).amin(dim=1)
        most = self.cfg.rewards.max_single_stance
        return torch.where(self._on_one_foot() & self.moving, (most - (since - most).abs()).clamp(min=0.0), 0.0)

    def _reward_no_fly(self) -> Tensor:
        """Biped: 1 on exactly one foot while moving, and on both while standing; else 0. [L: Cassie; standing ours]"""
        self._need_two_feet("no_fly")
        return torch.where(self.moving, self._on_one_foot(), self.foot_contact.all(dim=1)).float()

    def _on_one_foot(self) -> Tensor:
        return self.foot_contact.sum(dim=1) == 1

    def _need_two_feet(self, term: str) -> None:
        require(self.num_feet == 2, term, f"it is for robots with two feet; asset.foot_names has {self.num_feet}")

    def _clock(self, term: str) -> GaitClock:
        require(self.gait is not None, term, "there is no gait clock; set gait.period [s]")
        assert self.gait
        return self.gait

    def _reward_feet_phase(self) -> Tensor:
        """1 where feet have the clock's heights: ``rewards.swing_height`` in mid swing, 0 in stance. [P, H 5]"""
        swing = self._clock("feet_phase").swing()
        rise = 1.0 - (2.0 * swing - 1.0).abs()  # rises to 1 at mid swing, then falls
        target = self.cfg.rewards.swing_height * rise.square() * (3.0 - 2.0 * rise)  # a cubic, level at both ends [P]
        return torch.exp((self.foot_height - target).square().sum(dim=1) / -PHASE_SIGMA)

    def _reward_contact_phase(self) -> Tensor:
        """Share of the feet that stand or swing by the clock. [U 0.18]"""
        return (self.foot_contact == self._clock("contact_phase").wants_contact()).float().mean(dim=1)
