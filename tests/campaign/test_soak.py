"""A world that breaks is counted once, ends one episode, and changes nothing in any other world: benchmarks/soak.py, for two seconds."""

from __future__ import annotations

import argparse
import math

import pytest

from benchmarks.soak import KINDS, Soak, who_ask


def test_other_worlds_do_not_notice_a_break(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in who_ask():
        monkeypatch.setattr(module, "maybe_any", lambda _: True)
    args, ends = argparse.Namespace(task="go1_flat", num_envs=12, engine="auto", device="cpu", seed=1), []
    for breaks in (True, False):
        soak = Soak(args, breaks)
        soak.every = 20
        _, end, _ = soak.run(steps=20 * len(KINDS) + 10, seconds=math.inf)
        assert not soak.faults(end, end)
        ends.append(soak)
    broken, whole = ends
    assert broken.broke == broken.totals[1] == len(KINDS) and whole.totals[1] == 0
    differ = (broken.digest != whole.digest).tolist()
    assert differ == [True] * len(KINDS) + [False] * (12 - len(KINDS))
