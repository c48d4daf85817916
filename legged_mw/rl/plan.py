"""How far a training is: of its iterations, or of the time that was asked for, whichever ends first. No device and no file."""

from __future__ import annotations

import math
import time
from collections import deque
from statistics import median

_WINDOW = 50  # iterations whose median duration says how many more the time has room for


class Plan:
    """What a training was asked for, and how much of it is ``done``: 0 in its first iteration, 1 in its last, never less than before.

    With a ``deadline`` the number of the last iteration is not known at first: it is estimated anew after each iteration, and ``done``
    goes to 1 in even steps over those that are left. So kernels that compile, exams and checkpoints change the steps and not the end.
    """

    def __init__(self, last: int = 0, deadline: float | None = None, used: float = 0.0) -> None:
        """Until the iteration ``last``, or until ``deadline`` [s, time.time()], after ``used`` seconds of an earlier training."""
        self.last = self._wanted = last  # the last iteration: with a deadline an estimate
        self.deadline, self._used, self._begun = deadline, used, time.time()
        room = max(deadline - self._begun, 0.0) if deadline else 0.0
        self.done = used / (used + room) if room else 0.0
        self._first, self._before, self._times = True, self._begun, deque[float](maxlen=_WINDOW)

    @property
    def seconds(self) -> float:
        """Time that training has taken, resumed or not, for a later one with a deadline [s]; 0: nobody has asked for time."""
        return self._used + time.time() - self._begun if self.deadline or self._used else 0.0

    def saved(self) -> dict[str, float]:
        """What a checkpoint holds of it; nothing, where nobody has asked for time: such trainings are equal to the bit."""
        return {"seconds": seconds} if (seconds := self.seconds) else {}

    def begin(self, iteration: int) -> float:
        """The iteration after so many begins: how much is done by then."""
        share = iteration / max(self._wanted - 1, 1)
        if self.deadline:
            step = 0.0 if self._first else (1.0 - self.done) / max(self.last - iteration, 1)
            share = max(self.done + step, share)
        self._first, self.done = False, min(share, 1.0)
        return self.done

    def room(self) -> float:
        """An iteration has ended: how many more there is time for, by the median of the last ones; inf until one can say."""
        now = time.time()
        self._times.append(now - self._before)
        self._before = now
        if self.deadline is None or (len(self._times) == 1 and now < self.deadline):
            return math.inf  # the first one may have compiled kernels
        pace = median(self._times if len(self._times) in (1, _WINDOW) else list(self._times)[1:])
        return float(max(0, round((self.deadline - now) / max(pace, 1e-9))))

    def hear(self, iteration: int, room: float) -> None:
        """After ``iteration`` there was time for ``room`` more."""
        self.last = int(min(self._wanted, iteration + room))
