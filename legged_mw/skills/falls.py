"""A task whose episodes begin in falls, and whose robots are lifted while they learn to stand. Sources: as ``getup``."""

from __future__ import annotations

from typing import Annotated

import torch
from torch import Tensor

from legged_mw.envs.robot_task import RobotTask
from legged_mw.skills.pull import Pull
from legged_mw.skills.settle import fallen
from legged_mw.skills.skill_config import SkillCfg
from legged_mw.utils.bounds import Count, Part, Share, Whole, above
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown
from legged_mw.utils.math import assign

Settling = Annotated[float, above(0, 60, "s")]


class FallsCfg(SkillCfg):
    class falls:
        share: Share = 0.75  # of episodes that begin in a fall; the others stand [P 0.6]
        states: Count = 2048  # settled falls to begin from; at most four a world are made [ours]
        seconds: Settling = 1.0  # from the drop to the state [P 0.5; ours: a roll takes longer]
        seed: Whole = 1  # the same seed makes the same falls; the exam has its own
        pull: Share = 0.0  # share of the weight that lifts a robot; it fades as they learn [H 0.6]
        pull_on: str = ""  # body that it lifts; empty: the root, from which a robot whose trunk is heavier than its legs hangs head down
        pull_fades: Part = 0.2  # of it, when every world has ended an episode up [ours]


class Falls(RobotTask):
    """The child says in ``_refresh_base`` who is ``up``."""

    cfg: FallsCfg

    def _init_buffers(self) -> None:
        super()._init_buffers()
        falls = self.cfg.falls
        states = fallen(self.robot.physics, min(falls.states, 4 * self.num_envs), falls.seed, falls.seconds)
        self.fallen_qpos, self.fallen_qvel = (self._tensor(values) for values in states)  # (P, nq), (P, nv)
        self.up = self.buffer(dtype=torch.bool)  # (N,) as high and upright as one that stands
        self.pull = self.remember(
            Pull(self.sim, self._lifted(), self.gravity_dir, falls.pull * 9.81 * self.total_mass, falls.pull_fades)
        )

    def _lifted(self) -> int:
        """The body that ``falls.pull`` lifts."""
        falls, model = self.cfg.falls, self.robot.physics
        names = [model.body(i).name for i in range(1, model.nbody)]
        if falls.pull_on and falls.pull_on not in names:
            raise ConfigError(f"falls.pull_on: {unknown('body', falls.pull_on, names, self.cfg.asset.file)}")
        lifted = model.body(falls.pull_on).id if falls.pull_on else self.root_body
        if falls.pull and lifted == self.root_body and self.cfg.perturbation.kick:
            raise ConfigError(
                "falls.pull lifts the root, which perturbation.kick pushes: name another body in falls.pull_on"
            )
        return lifted

    def _reset_robots(self, mask: Tensor) -> None:
        """Standing as any task begins, or, by chance, in one of the settled falls."""
        super()._reset_robots(mask)
        fall = mask & (torch.rand_like(self.rew_buf) < self.cfg.falls.share)
        pick = torch.randint(len(self.fallen_qpos), (self.num_envs,), device=self.device)
        assign(self.sim.qpos, fall, self.fallen_qpos.index_select(0, pick))
        assign(self.sim.qvel, fall, self.fallen_qvel.index_select(0, pick))

    def _apply_actions(self) -> None:
        super()._apply_actions()
        self.pull.apply()

    def _update_curricula(self, mask: Tensor) -> None:
        super()._update_curricula(mask)
        self.pull.update(mask & (self.episode_steps[:, 0] > 0.0), self.up)

    def _live_statistics(self) -> dict[str, Tensor]:
        return super()._live_statistics() | self.pull.statistics()

    def training_state(self) -> dict[str, Tensor]:
        return super().training_state() | {"pull_level": self.pull.level.clone()}

    def load_training_state(self, state: dict[str, Tensor]) -> None:
        super().load_training_state(state)
        self.pull.level.copy_(state.get("pull_level", self.pull.level))
