"""Threads of an update, with times made up: an idle machine, a busy one, and one that changes."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from legged_mw.rl import runner
from legged_mw.rl.runner import ThreadChoice, UpdateThreads, better

IDLE, BUSY = {1: 0.09, 2: 0.06}, {1: 0.16, 2: 5.0}  # [s] an update


def line(times: str, threads: int) -> str:
    return f"threads of an update: {times}; going on with {threads} (cpu.update_threads = 0)"


def updates(choice: ThreadChoice, times: dict[int, float], count: int) -> tuple[list[int], list[str]]:
    """Threads that each update took, and what was said."""
    taken, said = [], []
    for _ in range(count):
        taken.append(choice.threads)
        said.append(choice.took(times[choice.threads]))
    return taken, [text for text in said if text]


def test_an_idle_machine_uses_all_cores() -> None:
    """After the first update, which counts for nothing, each number is tried once."""
    taken, said = updates(ThreadChoice(1, 2), IDLE, 100)
    assert taken == [1, 1] + [2] * 98 and not said


def test_a_busy_machine_uses_one_and_tries_again_ever_more_seldom() -> None:
    taken, said = updates(ThreadChoice(1, 2), BUSY, 1000)
    assert taken[:5] == [1, 1, 2, 1, 1] and said == [
        "threads of an update: 5 s on 2 and 0.16 s on 1; going on with 1 (cpu.update_threads = 0)"
    ]
    tries = [update for update, count in enumerate(taken) if count == 2]
    waits = [after - before - 1 for before, after in zip(tries, tries[1:], strict=False)]
    assert waits == [50, 100, 200, 400]


def test_a_machine_that_becomes_busy_and_free_again() -> None:
    choice = ThreadChoice(1, 8)
    assert updates(choice, {1: 0.3, 8: 0.06}, 50)[0][-1] == 8
    taken, said = updates(choice, {1: 0.4, 8: 3.6}, 20)
    assert taken == [8, 1] + [1] * 18 and said == [
        "threads of an update: 3.6 s on 8 and 0.4 s on 1; going on with 1 (cpu.update_threads = 0)"
    ]
    taken, said = updates(choice, {1: 0.3, 8: 0.06}, 40)
    assert taken[-1] == 8 and said == [line("0.3 s on 1 and 0.06 s on 8", 8)]


def test_noise_changes_nothing() -> None:
    choice = ThreadChoice(1, 2)
    taken = [
        updates(choice, {1: 0.1 * noise, 2: 0.09 * noise}, 1)[0][0] for noise in (1.0, 1.1, 1.0, 1.9, 0.8, 1.5) * 20
    ]
    assert set(taken[2:]) == {2}
    choice = ThreadChoice(1, 2)  # one slow update is looked into, and forgotten
    updates(choice, IDLE, 10)
    assert choice.took(0.5) == "" and choice.threads == 1
    assert choice.took(0.45) == "" and choice.threads == 2


@pytest.mark.parametrize(
    ("times", "settled", "expected"),
    [({1: 1.0, 2: 1.1}, 2, 2), ({1: 1.0, 2: 1.3}, 2, 1), ({1: 1.0, 2: 0.9}, 1, 1), ({1: 1.0, 2: 0.5}, 1, 2)],
)
def test_a_change_must_gain(times: dict[int, float], settled: int, expected: int) -> None:
    assert better(times, settled) == expected


def test_torch_gets_the_threads_and_the_user_the_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A number that is asked for is never tried; what fails is no measurement; torch has its own number back in any case."""
    clock, before = [0.0], torch.get_num_threads()
    monkeypatch.setattr(runner.time, "perf_counter", lambda: clock[0])

    def spend(around: UpdateThreads, seconds: Callable[[int], float]) -> int:
        with around:
            count = torch.get_num_threads()
            clock[0] += seconds(count)
        assert torch.get_num_threads() == before
        return count

    around = UpdateThreads(0, 2)
    assert [spend(around, BUSY.__getitem__) for _ in range(5)] == [1, 1, 2, 1, 1]
    assert capsys.readouterr().out == line("5 s on 2 and 0.16 s on 1", 1) + "\n"
    assert [spend(UpdateThreads(3, 2), lambda _: 9.0) for _ in range(5)] == [3] * 5
    assert [spend(UpdateThreads(0, 1), lambda _: 9.0) for _ in range(5)] == [1] * 5
    again = UpdateThreads(0, 2)
    with pytest.raises(ZeroDivisionError), again:
        _ = 1 / 0
    assert torch.get_num_threads() == before and [spend(again, IDLE.__getitem__) for _ in range(4)] == [1, 1, 2, 2]
