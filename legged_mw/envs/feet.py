"""Feet: their contacts with the ground, and the gait clock.

The clock gives the policy and the rewards the phase of each foot. The phase of a world rises from 0 to 1 in
``gait.period``; the phase of a foot is that plus its offset. In the first part of its phase (``gait.stance``) a foot is
in stance, then in swing. With the command to stand, the clock stays at 0; it starts when the command is to move.
``legged_mw.deploy.controller`` has the same clock.
"""

from __future__ import annotations

import math
from collections.abc import Collection

import torch
from torch import Tensor

from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.sim.model import RobotModel
from legged_mw.sim.sensors import CONTACT_FORCE
from legged_mw.utils.config import ConfigError


class FootContacts:
    """The number of ground contacts of each of F feet, and the contact force if it is sensed.

    A foot may have several geoms.
    """

    written = ("count", "forces")
    forces: Tensor | None = None  # (N, F, 3) force of the ground on the foot, world frame [N]; only if it is sensed

    def __init__(self, robot: RobotModel, feet: Collection[tuple[str, ...]], sensed: Tensor, count: Tensor) -> None:
        """``feet``: geoms of each foot, the first columns of ``count`` (N, C). ``sensed``: values of all sensors."""
        geoms = list(dict.fromkeys(geom for each in feet for geom in each))  # G
        table = torch.tensor([[float(geom in each) for each in feet] for geom in geoms], device=count.device)  # (G, F)
        self._foot_of_geom = table if [(geom,) for geom in geoms] != [*feet] else None
        self._counts = count[:, : len(geoms)]
        self.count = self._counts if self._foot_of_geom is None else count.new_zeros(len(count), len(feet))  # (N, F)
        if CONTACT_FORCE in robot.sensors:
            columns = sensed[:, robot.sensors[CONTACT_FORCE]].unflatten(1, (-1, 4))  # (N, C, count and force on ground)
            self._geom_forces, self._against = columns[:, None, : len(geoms), 1:], -table.T[..., None]  # (N, 1, G, 3)
            self.forces = count.new_zeros(len(count), len(feet), 3)

    def update(self) -> None:
        """Update from the contacts of the last substep."""
        if self._foot_of_geom is not None:
            torch.mm(self._counts, self._foot_of_geom, out=self.count)
        if self.forces is not None:
            torch.sum(self._geom_forces * self._against, dim=2, out=self.forces)


class GaitClock:
    """The gait clocks of N worlds with F feet, in fixed tensors."""

    written = ("phase", "running", "foot_phase", "row")

    def __init__(
        self, cfg: type[LeggedRobotCfg.gait], feet: tuple[str, ...], num_envs: int, dt: float, device: str
    ) -> None:
        """``dt``: control step [s]. Raises ConfigError unless there is one offset per foot."""
        self.offsets = _offsets(cfg, feet)
        self.stance, self._random_start = cfg.stance, cfg.random_start
        self._share = dt / cfg.period  # phase per control step
        self._shift = torch.tensor(self.offsets, device=device)  # (F,)
        self.phase = torch.zeros(num_envs, device=device)  # (N,) 0 to 1, as last observed
        self.running = torch.zeros(num_envs, dtype=torch.bool, device=device)  # (N,) command to move, as last observed
        self.foot_phase = torch.zeros(num_envs, len(feet), device=device)  # (N, F) from 0 to 1
        self.row = torch.zeros(num_envs, 2 * len(feet), device=device)  # sines of the phases, then cosines; 0 at rest

    def tick(self) -> None:
        """Advance the running clocks by one control step."""
        self.phase.add_(self.running, alpha=self._share).remainder_(1.0)

    def restart(self, mask: Tensor) -> None:
        """Start at a random phase where ``mask`` (N,) is true, so that each leg learns to make the first step."""
        start = torch.rand_like(self.phase) if self._random_start else torch.zeros_like(self.phase)
        self.phase.copy_(torch.where(mask, start, self.phase))
        self.running.logical_or_(mask)  # ``observe`` stops the clock if the command is to stand

    def observe(self, moving: Tensor) -> None:
        """Fill ``row`` for the next observation. ``moving`` (N,): command to move. A second call changes nothing."""
        self.phase.masked_fill_(~moving, 0.0)
        self.running.copy_(moving)
        torch.add(self.phase[:, None], self._shift, out=self.foot_phase).remainder_(1.0)
        angle = 2.0 * math.pi * self.foot_phase
        self.row.copy_(torch.cat([torch.sin(angle), torch.cos(angle)], dim=1)).masked_fill_(~moving[:, None], 0.0)

    def swing(self) -> Tensor:
        """Progress of each foot's swing (N, F), from 0 to 1; 0 in stance and at rest."""
        share = (self.foot_phase - self.stance).clamp(min=0.0) / (1.0 - self.stance)
        return share.masked_fill(~self.running[:, None], 0.0)

    def wants_contact(self) -> Tensor:
        """True for feet that should be in contact (N, F); all of them at rest."""
        return (self.foot_phase < self.stance) | ~self.running[:, None]


def _offsets(cfg: type[LeggedRobotCfg.gait], feet: tuple[str, ...]) -> list[float]:
    """The offsets of the config, one per foot. The default for two feet is half a period."""
    if cfg.offsets and len(cfg.offsets) == len(feet):
        return list(cfg.offsets)
    if not cfg.offsets and len(feet) == 2:
        return [0.0, 0.5]
    few = f"has {len(cfg.offsets)} numbers" if cfg.offsets else "is empty"
    hint = ""
    if len(feet) == 4:
        hint = ", e.g. [0.0, 0.5, 0.5, 0.0]: a trot, where they are front right, front left, rear right, rear left"
    raise ConfigError(f"gait.offsets {few}; write one share of the period a foot ({', '.join(feet)}){hint}")
