"""What a step counts: means over episodes, values that are not finite, worlds that broke. Recorded in the step: fixed buffers and masks.

Everything is added up on the device and read once an iteration. A reward or an observation that is NaN, infinite or absurdly
large becomes 0 and is counted; what is as it should be keeps its bits. A state that is not finite ends an episode as "broken".
One such world is an accident; many, step after step, are physics that cannot be stepped as the config has it, and a training in
it must end. ``DivergenceStop`` decides that, on the host, once an iteration.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from legged_mw.sim.simulation import Simulation

# name -> () a sum, or (2,) a sum and what to divide it by, as they stand when they are taken
Live = Mapping[str, Tensor]
# [ours: rewards are about 1 and rows, in their units, below 1e5; a mean or variance over 1e5 samples survives it]
BOUND = 1e6
# of an iteration's finished episodes: more that are not finite, in two iterations one after the other, end a training [ours]
SHARE = 0.01
JOINT, ACTION = "broken_by/", "broken_by_action"  # statistics: worlds so far that a joint broke, and that an action did


class Statistics:
    """Means over ended episodes, counts of episodes, and values as they stand. All travel as one vector, so that ranks can add theirs."""

    written = ("_sums",)

    def __init__(self, means: Sequence[str], counts: Sequence[str], device: str) -> None:
        """``means`` are divided by the first of ``counts``, the number of episodes that ended."""
        self.means, self.counts, self.live = list(means), list(counts), dict[str, int]()
        self._sums = torch.zeros(len(self.means) + len(self.counts), device=device)

    def add(self, ended: Tensor, means: Tensor, counts: Tensor) -> None:
        """Add the worlds where ``ended`` (N,) is true: their ``means`` (N, M); and all worlds' ``counts`` (N, C)."""
        self._sums.add_(torch.cat([torch.where(ended[:, None], means, 0.0), counts], dim=1).sum(dim=0))

    def take(self, live: Live) -> Tensor:
        """All sums as one vector (S,) on the device; the sums of episodes start from zero again."""
        self.live = {name: value.numel() for name, value in live.items()}
        taken = torch.cat([self._sums, *(value.reshape(-1) for value in live.values())])
        self._sums.zero_()
        return taken

    def name(self, taken: Sequence[float]) -> dict[str, float]:
        """Means, counts and live values by name, from what ``take`` returned. Means are NaN where no episode ended."""
        values = iter(taken)
        sums = {name: next(values) for name in [*self.means, *self.counts]}
        episodes = sums[self.counts[0]]
        named = {name: sums[name] / episodes if episodes else math.nan for name in self.means}
        named |= {name: sums[name] for name in self.counts}
        for name, size in self.live.items():
            total = next(values)
            if size == 1:
                named[name] = total
            elif count := next(values):  # a kind of ground that no world is on has no mean level
                named[name] = total / count
        return named


class NonFinite:
    """Looks at K values of N worlds, each of something that has a name."""

    written = ("counts",)

    def __init__(self, names: Sequence[str], device: str) -> None:
        """``names`` of the K columns, in words that a user knows."""
        self.names = list(names)
        self.counts = torch.zeros(len(self.names), device=device)  # (K,) worlds and steps, since they were taken

    def clear(self, values: Tensor) -> None:
        """Put 0 in place of each of ``values`` (N, K) that is not finite or beyond BOUND, and count it."""
        wrong = ~(values.abs() <= BOUND)  # NaN too
        self.counts.add_(wrong.sum(dim=0))
        values.masked_fill_(wrong, 0.0)

    def take(self) -> Tensor:
        """The counts (K,), which begin from zero again."""
        counts = self.counts.clone()
        self.counts.zero_()
        return counts


class BrokenWorlds:
    """Finds broken worlds and counts, since the start, the fastest joint of each."""

    written = ("counts",)

    def __init__(self, sim: Simulation, actions: Tensor, joints: Sequence[str], max_speed: float) -> None:
        """``actions`` (N, A) as the step has them; ``max_speed`` of any degree of freedom that still counts as finite."""
        self._sim, self._actions, self._joints, self._max_speed = sim, actions, joints, max_speed
        self.counts = torch.zeros(len(joints) + 1, device=sim.qvel.device)  # worlds by joint, and last by action

    def find(self, broken: Tensor) -> None:
        """Write the worlds that broke in this step into ``broken`` (N,), and count what broke them: no joint where a speed is NaN."""
        speed = self._sim.qvel.abs()
        joints, position = speed[:, 6:], self._sim.qpos.abs().amax(dim=1)
        action = self._actions.abs().amax(dim=1) < math.inf  # a servo swallows NaN, the reward does not
        # NaN compares false
        torch.logical_not((speed.amax(dim=1) <= self._max_speed) & (position < math.inf) & action, out=broken)
        fastest = (joints == joints.amax(dim=1, keepdim=True)) & (broken & action)[:, None]
        self.counts.add_(torch.cat([fastest, (broken & ~action)[:, None]], dim=1).sum(dim=0))

    def statistics(self) -> dict[str, Tensor]:
        """Worlds so far, () each, by what broke them."""
        return {name: self.counts[i] for i, name in enumerate([*(f"{JOINT}{joint}" for joint in self._joints), ACTION])}


class DivergenceStop:
    """Says when an iteration's statistics mean that a training must end."""

    def __init__(self) -> None:
        self._good: Mapping[str, float] = {}  # statistics of the last iteration that was as it should be
        self._before: Mapping[str, float] = {}  # of the last one, if too many were not finite

    def verdict(self, numbers: Mapping[str, float]) -> str:
        """Why training must end, in words; '' to go on. ``numbers`` are an iteration's statistics."""
        if not numbers["broken"] > SHARE * numbers["episodes"]:
            self._good, self._before = numbers, {}
            return ""
        before, self._before = self._before, numbers
        if not before:
            return ""
        shares = " and ".join(f"{each['broken']:.0f} of {each['episodes']:.0f}" for each in (before, numbers))
        counts = {
            name: numbers[name] - self._good.get(name, 0.0) for name in numbers if name.startswith((JOINT, ACTION))
        }
        return f"in the last two iterations {shares} episodes ended with a state that is not finite: {_because(counts)}"


def _because(counts: dict[str, float]) -> str:
    """The cause and what to change, from the worlds that each joint and the actions broke."""
    action, total = counts.pop(ACTION, 0.0), sum(counts.values())
    if action > total:
        return "the policy's actions are not finite; lower algorithm.learning_rate, and look for a reward term without a bound"
    worst = sorted((name for name in counts if counts[name]), key=lambda name: -counts[name])[:4]
    joints = (
        ", ".join(f"{name.removeprefix(JOINT)} ({counts[name] / total:.0%})" for name in worst)
        or "none, all was lost at once"
    )
    return (
        f"physics diverges; fastest joint at the break: {joints}. Lower control.damping or control.stiffness of these joints, or give them "
        "armature (asset.armature), or lower sim.dt and raise control.decimation, or set sim.integrator to implicitfast; "
        "train.py --check --picture robot.png shows what each joint bears"
    )
