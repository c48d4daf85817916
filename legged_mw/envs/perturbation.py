"""Kicks and pushes: a kick is a force over time, a push changes the velocity at once."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.sim.simulation import Simulation
from legged_mw.utils.math import assign, maybe_any


class Perturbation:
    """Kicks and pushes of the root in N worlds, by the config section ``perturbation``."""

    written = ("_kick", "_clock", "kick_force", "kick_active", "kick_level", "growth", "_push_clock")

    def __init__(
        self, cfg: type[RobotTaskCfg.perturbation], sim: Simulation, root_body: int, mass: float, dt: float
    ) -> None:
        """``mass``: of the robot [kg]; ``dt``: control step [s]."""
        self.cfg, self._sim, self._root, self._mass, self._dt = cfg, sim, root_body, mass, dt
        n, device = sim.num_envs, sim.device
        lasts = [max(each, 2.0 * dt) for each in cfg.duration]  # of one sample, a half sine has no force
        spans = [cfg.interval, lasts, [-math.pi, math.pi], cfg.velocity]
        self._ranges = torch.tensor(spans, dtype=torch.float, device=device).T.contiguous()  # (2, 4)
        self._kick = torch.zeros(n, 4, device=device)  # pause, duration [control steps], direction [rad], dv [m/s]
        self._clock = torch.zeros(n, device=device)  # time since the draw [control steps]
        self.kick_force = torch.zeros(n, 3, device=device)  # (N, 3) on the root, world frame [N]
        self.kick_active = torch.zeros(n, dtype=torch.bool, device=device)  # (N,)
        # (N,) factor on drawn values of dv
        self.kick_level = torch.full((n,), 0.0 if cfg.curriculum else 1.0, device=device)
        # () factor on dv by ``perturbation.growth``
        self.growth: Tensor | float = torch.ones((), device=device) if cfg.growth else 1.0
        self._push_clock = torch.zeros(n, device=device)  # time to the next push [control steps]
        if cfg.push:
            self._push_clock.uniform_(0.0, cfg.push_interval_s / dt).round_()

    def apply(self) -> None:
        """Apply the kicks and pushes of this step."""
        if self.cfg.kick:
            self._kick_robots()
        if self.cfg.push:
            self._push_robots()

    def anneal(self, done: float) -> None:
        """Increase kicks from 0 to full strength while the progress ``done`` is in ``perturbation.growth`` (0 to 1)."""
        if isinstance(self.growth, Tensor):
            self.growth.fill_(float(np.interp(done, self.cfg.growth, [0.0, 1.0])))

    def update_level(self, mask: Tensor, survived: Tensor) -> None:
        """Move levels towards ``survived`` (N,), a share of the episode, where ``mask`` (N,) is true."""
        assign(self.kick_level, mask, torch.lerp(self.kick_level, survived, self.cfg.curriculum_rate))

    def statistics(self) -> dict[str, Tensor]:
        """The mean kick level if there is a curriculum, as (2,) sum and count."""
        level = self.kick_level
        mean = torch.stack([level.sum(), torch.full_like(level[0], len(level))])
        return {"kick_level": mean} if self.cfg.curriculum else {}

    def reset(self, mask: Tensor) -> None:
        """Start an episode where ``mask`` (N,) is true."""
        if self.cfg.kick:
            self._redraw(mask)
            self.kick_active.masked_fill_(mask, False)
            self.kick_force.masked_fill_(mask[:, None], 0.0)

    def _kick_robots(self) -> None:
        """Apply a horizontal half-sine force after a pause, then draw the next kick."""
        wait, steps, angle, speed = self._kick.unbind(dim=1)
        elapsed = self._clock - wait
        self.kick_active.copy_((elapsed >= 0.0) & (elapsed < steps))
        peak = 0.5 * self._mass * speed * self.growth / (steps * self._dt)
        force = torch.where(self.kick_active, torch.sin(math.pi * elapsed / steps) * peak, 0.0)
        self.kick_force[:, 0] = force * torch.cos(angle)
        self.kick_force[:, 1] = force * torch.sin(angle)
        self._sim.xfrc_applied[:, self._root, :3] = self.kick_force
        self._clock.add_(1.0)
        over = elapsed + 1.0 >= steps
        if maybe_any(over):
            self._redraw(over)

    def _redraw(self, mask: Tensor) -> None:
        low, high = self._ranges
        draw = torch.lerp(low, high, torch.rand(self._sim.num_envs, 4, device=self._sim.device))
        draw[:, :2] = (draw[:, :2] / self._dt).round_().clamp_(min=1.0)  # [control steps]
        draw[:, 3] *= self.kick_level
        assign(self._kick, mask, draw)
        self._clock.masked_fill_(mask, 0.0)

    def _push_robots(self) -> None:
        """Set random horizontal and angular velocities of the root where the clock has reached 0. [L]"""
        self._push_clock.sub_(1.0)
        due = self._push_clock <= 0.0
        if maybe_any(due):
            speed = self.cfg.max_push_vel_xy
            draw = torch.rand(self._sim.num_envs, 2, device=self._sim.device).mul_(2.0 * speed).sub_(speed)
            assign(self._sim.qvel[:, :2], due, draw)
            if turn := self.cfg.max_push_ang_vel:
                draw = torch.rand(self._sim.num_envs, 3, device=self._sim.device).mul_(2.0 * turn).sub_(turn)
                assign(self._sim.qvel[:, 3:6], due, draw)
            self._push_clock.masked_fill_(due, round(self.cfg.push_interval_s / self._dt))
