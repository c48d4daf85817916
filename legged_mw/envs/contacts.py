"""Contacts with the ground, from what the simulator senses: of the feet, and those that are a fall or are penalised."""

from __future__ import annotations

from collections.abc import Collection

import torch
from torch import Tensor

from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.sim.model import RobotModel
from legged_mw.sim.sensors import CONTACT_FORCE
from legged_mw.utils.config import ConfigError


class GroundContacts:
    """What ``asset.terminate_after_contacts_on`` and ``asset.penalize_contacts_on`` mean, in C sensed geoms of B penalised bodies."""

    def __init__(self, robot: RobotModel, asset: type[RobotTaskCfg.asset], count: Tensor, penalty: bool) -> None:
        """``count`` (N, C) of contacts, in the order of ``robot.contact_geoms``; ``penalty`` says whether a reward term needs some.

        Raises ConfigError for a geom that never touches the ground.
        """
        self._robot, self._asset, model = robot, asset, robot.physics
        fall = self._columns(asset.terminate_after_contacts_on, "terminate_after_contacts_on")
        columns = self._columns(asset.penalize_contacts_on, "penalize_contacts_on")
        if penalty and not columns:
            raise ConfigError(
                "rewards.scales.collision is on, but asset.penalize_contacts_on names nothing; name what should not touch"
            )
        body = {column: int(model.geom_bodyid[robot.id("geom", robot.contact_geoms[column])]) for column in columns}
        bodies = sorted(set(body.values()))
        table = torch.zeros(count.shape[1], len(bodies))
        for column in columns:
            table[column, bodies.index(body[column])] = 1.0
        self.penalized = table.to(count.device)  # (C, B) 1 where a geom is of a body
        # columns of geoms whose contact is a fall
        self.terminating = torch.tensor(fall, dtype=torch.long, device=count.device)

    def _columns(self, patterns: list[str], field: str) -> list[int]:
        meant, model = self._robot.names.find(patterns, f"asset.{field}"), self._robot.physics
        for name in meant:
            if not model.geom_conaffinity[self._robot.id("geom", name)]:
                raise ConfigError(
                    f"asset.{field}: '{name}' never touches the ground; add it to asset.colliders: {self._asset.colliders}"
                )
        return [i for i, name in enumerate(self._robot.contact_geoms) if name in meant]


class FootContacts:
    """How many contacts each of F feet has with the ground, and the force on it where that is sensed; a foot may have several geoms."""

    written = ("count", "forces")
    forces: Tensor | None = None  # (N, F, 3) of the ground on the foot, world frame [N]; only where something reads it

    def __init__(self, robot: RobotModel, feet: Collection[tuple[str, ...]], sensed: Tensor, count: Tensor) -> None:
        """``feet`` are the geoms of each, the first columns of ``count`` (N, C); ``sensed`` are all sensors."""
        geoms = list(dict.fromkeys(geom for each in feet for geom in each))  # G
        table = torch.tensor([[float(geom in each) for each in feet] for geom in geoms], device=count.device)  # (G, F)
        self._foot_of_geom = table if [(geom,) for geom in geoms] != [*feet] else None
        self._counts = count[:, : len(geoms)]
        self.count = self._counts if self._foot_of_geom is None else count.new_zeros(len(count), len(feet))  # (N, F)
        if CONTACT_FORCE in robot.sensors:
            # (N, C, 4): count, force on the ground
            columns = sensed[:, robot.sensors[CONTACT_FORCE]].unflatten(1, (-1, 4))
            # (N, 1, G, 3), (F, G, 1)
            self._geom_forces, self._against = columns[:, None, : len(geoms), 1:], -table.T[..., None]
            self.forces = count.new_zeros(len(count), len(feet), 3)

    def update(self) -> None:
        """After a step: what its last substep sensed."""
        if self._foot_of_geom is not None:
            torch.mm(self._counts, self._foot_of_geom, out=self.count)
        if self.forces is not None:
            torch.sum(self._geom_forces * self._against, dim=2, out=self.forces)
