"""One iteration's numbers on their way from the device to the user: nothing here makes the device wait."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

_KNOWN = ("reward", "episode_length", "episodes", "fell", "broken", "overflowed", "learning_rate", "action_std")
_APART = ("rew_", "broken_by")  # shown by other lines, or where a training ends

Mark = torch.cuda.Event | float


class Clock:
    """Marks points in the device's queue of work; the seconds between two marks are known once both are reached."""

    def __init__(self, device: str) -> None:
        self._device = device if device.startswith("cuda") else None

    def mark(self) -> Mark:
        if self._device is None:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self._device))
        return event

    @staticmethod
    def seconds(start: Mark, end: Mark) -> float:
        if isinstance(start, torch.cuda.Event) and isinstance(end, torch.cuda.Event):
            end.synchronize()
            return start.elapsed_time(end) / 1e3
        assert isinstance(start, float) and isinstance(end, float)
        return end - start


class Message:
    """A vector that travels from the device to the host while both go on."""

    def __init__(self, values: Tensor, sizes: Sequence[int]) -> None:
        """``sizes`` of the parts of ``values``."""
        self._host, self._event, self._sizes = values, None, list(sizes)
        if values.is_cuda:
            self._host = torch.empty(values.shape, dtype=values.dtype, pin_memory=True).copy_(values, non_blocking=True)
            self._event = torch.cuda.Event()
            self._event.record(torch.cuda.current_stream(values.device))

    def read(self) -> list[list[float]]:
        """The numbers of each part; waits until the device has computed them."""
        if self._event is not None:
            self._event.synchronize()
        return [part.tolist() for part in self._host.split(self._sizes)]


class Report(NamedTuple):
    """An iteration: what the host knows at once, and what is on its way."""

    iteration: int
    total_steps: int  # since the beginning of training, over all ranks
    steps: int  # of this iteration, over all ranks
    losses: list[str]
    message: Message  # statistics of the episodes, nonfinite, stop, room; losses, learning rate, std of the actions, undone, wrong columns
    marks: tuple[Mark, Mark, Mark]  # begin, end of the rollout, end of the update

    def seconds(self) -> tuple[float, float]:
        """The rollout's and the update's."""
        begin, collected, end = self.marks
        return Clock.seconds(begin, collected), Clock.seconds(collected, end)


def quiet_writers() -> None:
    """TensorBoard's own thread hands its error to who writes the next curve: it need not print a traceback as well."""
    hook = threading.excepthook

    def show(died: threading.ExceptHookArgs) -> None:
        if type(died.thread).__name__ != "_AsyncWriterThread":
            hook(died)

    if hook.__module__ != __name__:
        threading.excepthook = show


def console_block(title: str, rows: dict[str, str]) -> str:
    """A headline and a line a row, as the console shows an iteration."""
    return "\n".join([f" {title} ".center(80, "#"), *(f"{name:>32}: {text}" for name, text in rows.items())])


def console_rows(
    numbers: dict[str, float], losses: dict[str, float], speed: float, collect: float, learn: float
) -> dict[str, str]:
    """What an iteration shows of its numbers: name -> text. A mean over episodes is "-" until one has ended."""

    def mean(name: str, digits: int) -> str:
        return "-" if math.isnan(numbers[name]) else f"{numbers[name]:.{digits}f}"

    return {
        "Computation": f"{speed:.0f} steps/s (collection {collect:.3f} s, learning {learn:.3f} s)",
        **{f"{name.capitalize()} loss": f"{value:.4f}" for name, value in losses.items()},
        "Learning rate": f"{numbers['learning_rate']:.1e}",
        "Action std": f"{numbers['action_std']:.2f}",
        "Mean reward": mean("reward", 2),
        "Mean episode length": mean("episode_length", 1),
        **{name: mean(name, 4) for name in numbers if name.startswith("rew_")},
        **{name.replace("_", " ").replace("/", ", ").capitalize(): mean(name, 2) for name in _of_the_task(numbers)},
        "Episodes ended": f"{numbers['episodes']:.0f} ({numbers['fell']:.0f} falls, {numbers['broken']:.0f} not finite)",
    }


def curves(
    numbers: dict[str, float], losses: dict[str, float], speed: float, collect: float, learn: float, total_steps: int
) -> dict[str, float]:
    """Curve -> value, under rsl-rl's names where it has them."""
    return {
        **{f"Loss/{name}": value for name, value in losses.items()},
        **{"Loss/learning_rate": numbers["learning_rate"], "Policy/mean_std": numbers["action_std"]},
        **{"Perf/total_fps": speed, "Perf/collection_time": collect, "Perf/learning_time": learn},
        **{"Train/mean_reward": numbers["reward"], "Train/mean_episode_length": numbers["episode_length"]},
        **{f"Episode/{name}": value for name, value in numbers.items() if name.startswith("rew_")},
        **{"Episode/fell": numbers["fell"], "Episode/broken": numbers["broken"], "Train/total_steps": total_steps},
        "Sim/overflowed_worlds": numbers["overflowed"],  # so far
        **{f"Curriculum/{name}": numbers[name] for name in _of_the_task(numbers)},
    }


def _of_the_task(numbers: dict[str, float]) -> list[str]:
    """Names of the task's own statistics of the moment: levels of curricula, and whatever its ``_live_statistics`` adds."""
    return [name for name in numbers if name not in _KNOWN and not name.startswith(_APART)]
