"""Contacts with the ground that are a fall or are penalised, as columns of what the simulator counts."""

from __future__ import annotations

import torch
from torch import Tensor

from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.sim.model import RobotModel
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
            raise ConfigError("rewards.scales.collision is on, but asset.penalize_contacts_on names nothing; name what should not touch")
        body = {column: int(model.geom_bodyid[robot.id("geom", robot.contact_geoms[column])]) for column in columns}
        bodies = sorted(set(body.values()))
        table = torch.zeros(count.shape[1], len(bodies))
        for column in columns:
            table[column, bodies.index(body[column])] = 1.0
        self.penalized = table.to(count.device)  # (C, B) 1 where a geom is of a body
        self.terminating = torch.tensor(fall, dtype=torch.long, device=count.device)  # columns of geoms whose contact is a fall

    def _columns(self, patterns: list[str], field: str) -> list[int]:
        meant, model = self._robot.names.find(patterns, f"asset.{field}"), self._robot.physics
        for name in meant:
            if not model.geom_conaffinity[self._robot.id("geom", name)]:
                raise ConfigError(f"asset.{field}: '{name}' never touches the ground; add it to asset.colliders: {self._asset.colliders}")
        return [i for i, name in enumerate(self._robot.contact_geoms) if name in meant]
