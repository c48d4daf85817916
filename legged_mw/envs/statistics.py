"""Statistics of the step: means over episodes, values that are not finite, and broken worlds.

They are summed on the device, in fixed buffers, and read once per iteration. A reward or an observation that is NaN,
infinite or very large is replaced by 0 and counted; all other values keep their bits. A state that is not finite ends
the episode as "broken". A few broken worlds are normal. Many in each iteration mean that the physics of the config
diverges, and the training must end: ``DivergenceStop`` decides this on the host, once per iteration.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from legged_mw.sim.simulation import Simulation

Live = Mapping[str, Tensor]  # name -> current value: () sum, or (2,) sum and count
# largest valid value [ours: rewards are about 1 and rows below 1e5; means and variances of 1e5 samples stay finite]
BOUND = 1e6
SHARE = 0.01  # of the episodes: if more are broken in two successive iterations, the training ends [ours]
JOINT, ACTION = "broken_by/", "broken_by_action"  # statistics: total of worlds broken by a joint, by an action


class Statistics:
    """Means over ended episodes, counts of episodes, and current values, in one vector that ranks can sum."""

    written = ("_sums",)

    def __init__(self, means: Sequence[str], counts: Sequence[str], device: str) -> None:
        """``means`` are divided by the first of ``counts``, the number of ended episodes."""
        self.means, self.counts, self.live = list(means), list(counts), dict[str, int]()
        self._sums = torch.zeros(len(self.means) + len(self.counts), device=device)

    def add(self, ended: Tensor, means: Tensor, counts: Tensor) -> None:
        """Add ``means`` (N, M) where ``ended`` (N,) is true, and ``counts`` (N, C) of all worlds."""
        self._sums.add_(torch.cat([torch.where(ended[:, None], means, 0.0), counts], dim=1).sum(dim=0))

    def take(self, live: Live) -> Tensor:
        """All sums as one vector (S,) on the device. Sets the sums over episodes to zero."""
        self.live = {name: value.numel() for name, value in live.items()}
        taken = torch.cat([self._sums, *(value.reshape(-1) for value in live.values())])
        self._sums.zero_()
        return taken

    def name(self, taken: Sequence[float]) -> dict[str, float]:
        """Name -> mean, count or current value, from the vector of ``take``. Means are NaN if no episode ended."""
        values = iter(taken)
        sums = {name: next(values) for name in [*self.means, *self.counts]}
        episodes = sums[self.counts[0]]
        named = {name: sums[name] / episodes if episodes else math.nan for name in self.means}
        named |= {name: sums[name] for name in self.counts}
        for name, size in self.live.items():
            total = next(values)
            if size == 1:
                named[name] = total
            elif count := next(values):  # no mean if the count is 0, as for a kind of ground without a world
                named[name] = total / count
        return named


class NonFinite:
    """Clears and counts invalid values among K named values of N worlds."""

    written = ("counts",)

    def __init__(self, names: Sequence[str], device: str) -> None:
        """``names``: of the K columns, for messages."""
        self.names = list(names)
        self.counts = torch.zeros(len(self.names), device=device)  # (K,) invalid values since ``take``

    def clear(self, values: Tensor) -> None:
        """Replace ``values`` (N, K) that are not finite or exceed BOUND by 0, and count them."""
        wrong = ~(values.abs() <= BOUND)  # also True for NaN
        self.counts.add_(wrong.sum(dim=0))
        values.masked_fill_(wrong, 0.0)

    def take(self) -> Tensor:
        """The counts (K,). Sets them to zero."""
        counts = self.counts.clone()
        self.counts.zero_()
        return counts


class BrokenWorlds:
    """Finds worlds with a state or an action that is not finite, and counts the fastest joints of these worlds."""

    written = ("counts",)

    def __init__(self, sim: Simulation, actions: Tensor, joints: Sequence[str], max_speed: float) -> None:
        """``actions`` (N, A): buffer of the step. Speeds above ``max_speed`` count as not finite."""
        self._sim, self._actions, self._max_speed = sim, actions, max_speed
        self._names = [*(f"{JOINT}{joint}" for joint in joints), ACTION]
        self.counts = torch.zeros(len(joints) + 1, device=sim.qvel.device)  # worlds broken by each joint, by an action

    def find(self, broken: Tensor) -> None:
        """Set ``broken`` (N,) for worlds that broke in this step, and count the causes (no joint for a NaN speed)."""
        speed = self._sim.qvel.abs()
        joints, position = speed[:, 6:], self._sim.qpos.abs().amax(dim=1)
        action = self._actions.abs().amax(dim=1) < math.inf  # a NaN action may reach the reward but not the state
        # comparisons with NaN are false
        torch.logical_not((speed.amax(dim=1) <= self._max_speed) & (position < math.inf) & action, out=broken)
        fastest = (joints == joints.amax(dim=1, keepdim=True)) & (broken & action)[:, None]
        self.counts.add_(torch.cat([fastest, (broken & ~action)[:, None]], dim=1).sum(dim=0))

    def statistics(self) -> dict[str, Tensor]:
        """Cause -> total of broken worlds ()."""
        return dict(zip(self._names, self.counts, strict=True))


class DivergenceStop:
    """Decides from the statistics of the iterations whether the training must end."""

    def __init__(self) -> None:
        self._good: Mapping[str, float] = {}  # statistics of the last iteration with few broken worlds
        self._before: Mapping[str, float] = {}  # statistics of the last iteration if it had many

    def verdict(self, numbers: Mapping[str, float]) -> str:
        """Why the training must end, or ''. ``numbers``: statistics of an iteration."""
        if not numbers["broken"] > SHARE * numbers["episodes"]:
            self._good, self._before = numbers, {}
            return ""
        before, self._before = self._before, numbers
        if not before:
            return ""
        shares = " and ".join(f"{each['broken']:.0f} of {each['episodes']:.0f}" for each in (before, numbers))
        causes = [name for name in numbers if name.startswith((JOINT, ACTION))]
        counts = {name: numbers[name] - self._good.get(name, 0.0) for name in causes}
        return f"in the last two iterations {shares} episodes ended with a state that is not finite: {_because(counts)}"


def _because(counts: dict[str, float]) -> str:
    """Text on the cause and the remedy. ``counts``: cause -> number of broken worlds."""
    action, total = counts.pop(ACTION, 0.0), sum(counts.values())
    if action > total:
        mend = "lower algorithm.learning_rate, and look for a reward term without a bound"
        return f"the policy's actions are not finite; {mend}"
    worst = sorted((name for name in counts if counts[name]), key=lambda name: -counts[name])[:4]
    joints = ", ".join(f"{name.removeprefix(JOINT)} ({counts[name] / total:.0%})" for name in worst)
    return (
        f"physics diverges; fastest joint at the break: {joints or 'none, all was lost at once'}. "
        "Lower control.damping or control.stiffness of these joints, or give them armature (asset.armature), "
        "or lower sim.dt and raise control.decimation, or set sim.integrator to implicitfast; "
        "train.py --check --picture robot.png shows what each joint bears"
    )
