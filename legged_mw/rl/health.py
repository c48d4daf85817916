"""Is learning still alive? Says what an iteration brought that is not finite, and when a training must end for it. On the host."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from legged_mw.envs.statistics import BOUND, SHARE

IN_A_ROW = 3  # ours: iterations; one bad value is an accident, and the next rollout is another


class Health:
    """What the last iterations were like."""

    def __init__(self, names: Sequence[str], stored: Sequence[str]) -> None:
        """``names`` of the values that the step looks at, and of the ``stored`` columns that an update learns from; in words."""
        self._names, self._stored = names, stored
        self.undone = 0  # updates, in all
        self._row = 0  # updates undone, one after the other
        self._sick = 0  # iterations with too many values that are not finite, one after the other
        self._heard = 0  # iterations of this process
        self._said: dict[str, float] = {}  # name -> count when it was said last

    def judge(self, counts: Sequence[float], steps: int, undone: bool, wrong: Sequence[float]) -> tuple[list[str], str]:
        """Warnings, and why training must end, '' to go on; ``counts`` of bad values in ``steps`` steps of a world, ``wrong`` columns."""
        found = self._by_name(counts)
        warnings = [line for name, count in found.items() if (line := self._warning(name, count, steps))]
        worst = max(found, key=lambda name: found[name], default="")
        self._sick = self._sick + 1 if worst and found[worst] > SHARE * steps else 0
        self._row = self._row + 1 if undone else 0
        if undone:
            self.undone += 1
            brought = list(dict.fromkeys(name for name, bad in zip(self._stored, wrong, strict=True) if bad))
            cause = (
                f"{' and '.join(brought[:4])} held what is not finite or beyond {BOUND:g}"
                if brought
                else "loss or weights"
            )
            warnings.append(
                f"the update was not finite ({cause}) and is undone: {self._row} in a row, {self.undone} so far"
            )
            if self._row >= IN_A_ROW:
                advice = (
                    "look at how that is computed"
                    if brought
                    else "lower algorithm.learning_rate; look for rewards without a bound"
                )
                kept = "the networks are those of the last good one"
                return warnings, f"{IN_A_ROW} updates in a row were not finite ({cause}); {kept}; {advice}"
        if self._sick >= IN_A_ROW:
            share = f"{found[worst]:.0f} of {steps} steps of a world, for {IN_A_ROW} iterations"
            return warnings, f"{worst} is not finite, or beyond {BOUND:g}, in {share}; look at how it is computed"
        return warnings, ""

    def lengths(self, numbers: Mapping[str, float]) -> list[str]:
        """A line after the second iteration of this process, if episodes lasted a step: how they end."""
        self._heard += 1
        if self._heard != 2 or not numbers["episodes"] or numbers["episode_length"] > 1.5:
            return []
        fell, broken = numbers["fell"], numbers["broken"]
        ends = {
            "fell": fell,
            "had a state that is not finite": broken,
            "timed out": numbers["episodes"] - fell - broken,
        }
        said = ", ".join(f"{count:.0f} {end}" for end, count in ends.items() if count)
        lasted = f"episodes last {numbers['episode_length']:.1f} steps ({said})"
        return [f"{lasted}: unless that is meant, nothing can be learned; --check names the rule that ends them"]

    def _by_name(self, counts: Sequence[float]) -> dict[str, float]:
        """Those that were found: of a row with several columns the worst one's count."""
        found: dict[str, float] = {}
        for name, count in zip(self._names, counts, strict=True):
            if count:
                found[name] = max(found.get(name, 0.0), count)
        return found

    def _warning(self, name: str, count: float, steps: int) -> str:
        """A line when it is first found, and each time that ten times as much has been."""
        before = self._said.get(name, 0.0)
        total = self._said[name] = before + count
        if before and len(str(int(before))) == len(str(int(total))):
            return ""
        share = f"{count:.0f} of {steps} steps of a world"
        return f"{name} was not finite, or beyond {BOUND:g}, in {share}; 0 took its place ({total:.0f} so far)"
