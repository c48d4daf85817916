"""A force that lifts robots while they learn to stand, and fades as they do. [HoST: 200 N on a G1]"""

from __future__ import annotations

import torch
from torch import Tensor

from legged_mw.sim.simulation import Simulation

# times: an episode that ends down raises the level by this much more than one that ends up lowers it [ours]
GIVEN_BACK = 3.0


class Pull:
    """A force against gravity on a body of each robot: ``level`` (), from 1 to 0, times ``force`` [N].

    One that is up keeps it: else robots learn to lean in it rather than to stand without, and it never fades.
    """

    written = ("level",)

    def __init__(self, sim: Simulation, body: int, gravity_dir: Tensor, force: float, fades: float) -> None:
        """``gravity_dir``: (N, 3) in the world, which leans where a slope was drawn. ``fades``: by how much the level falls when
        every world has ended an episode up."""
        self._force, self._down, self._fades = sim.xfrc_applied[:, body, :3], gravity_dir, fades  # a view (N, 3)
        self._highest, self.level = force, torch.ones((), device=sim.device)

    def apply(self) -> None:
        """Before a step."""
        if self._highest:
            torch.mul(self._down, -self._highest * self.level, out=self._force)

    def update(self, ended: Tensor, up: Tensor) -> None:
        """Episodes have ended, (N,) each."""
        if self._highest:
            change = torch.where(up, -1.0, GIVEN_BACK).masked_fill(~ended, 0.0).mean()
            self.level.add_(change, alpha=self._fades).clamp_(0.0, 1.0)

    def statistics(self) -> dict[str, Tensor]:
        """The level, a sum and what to divide it by."""
        return {"pull": torch.stack([self.level, torch.ones_like(self.level)])} if self._highest else {}
