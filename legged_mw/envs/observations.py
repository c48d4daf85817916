"""Observations computed from a task's table of rows, which has their sizes, noise, scale, delay, history and order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from legged_mw.envs.motors import Delay
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.envs.statistics import NonFinite
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import StepError, place_of, unknown
from legged_mw.utils.machine import require_memory
from legged_mw.utils.math import assign


class Row(NamedTuple):
    """One row of the observation table."""

    name: str
    value: Tensor  # (N, size), a buffer that the step writes in place
    noise: float = 0.0  # half width of the added uniform noise, in the unit of the value
    # mirror image: a kind of envs/mirror.py, or a group; None: unknown, so symmetry must be off
    mirror: str | None = None
    scale: float | Sequence[float] = 1.0  # one number, or one per column; the policy reads scale * (value + noise)
    measured: bool = False  # a sensor of the robot measures it, so domain_rand.observation_delay applies
    # How a robot with an exported policy measures it (legged_mw/deploy/contract.py knows RobotTask's rows by name):
    sensors: tuple[str, ...] = ()  # names of sensors in the MJCF; the row is their values in order
    unit: str = ""
    frame: str = ""
    history: int = 1  # number of frames, oldest first; from `observations.history`
    group: str = ""  # the group that this row contains, or ""

    @property
    def size(self) -> int:
        """Number of columns of the row in its group."""
        return self.value.shape[1] * self.history

    def column_scales(self) -> list[float]:
        """The scale of each column of ``value``. Raises ConfigError unless there is one scale, or one per column."""
        size = self.value.shape[1]
        if not isinstance(self.scale, Sequence):
            return [float(self.scale)] * size
        if len(self.scale) != size:
            what = f"observation row '{self.name}' has {size} columns and {len(self.scale)} scales"
            raise ConfigError(f"{what}; give one, or one a column")
        return [float(scale) for scale in self.scale]


def checked_rows(make_rows: Callable[[], Any], count: int) -> Mapping[str, Any]:
    """The table that the method ``make_rows`` returns for ``count`` worlds. Raises StepError if its form is wrong."""
    table, where = make_rows(), place_of(make_rows)
    if not isinstance(table, Mapping) or not all(isinstance(rows, list | tuple) and rows for rows in table.values()):
        raise StepError(f"must return group -> list of rows; it returned {type(table).__name__}", where)
    for group, row in [(group, row) for group, rows in table.items() for row in rows if not isinstance(row, str)]:
        if not isinstance(row, Row):
            what = f"group '{group}' holds {type(row).__name__}"
            raise StepError(f"{what}; write Row(name, value, ...), or the name of a group", where)
        value = row.value
        if not isinstance(value, Tensor) or value.dim() != 2 or len(value) != count or not value.numel():
            actual = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
            expected = f"a tensor ({count}, size), a row a world"
            raise StepError(f"row '{row.name}' of '{group}' is {actual}; it must be {expected}", where)
    return table


class Observations:
    """The observation groups of N worlds. ``groups[group]``: its rows; ``buffers[group]`` (N, size): its values."""

    written = ("_parts",)

    def __init__(
        self,
        table: Mapping[str, Sequence[Row | str]],
        cfg: type[RobotTaskCfg.observations],
        noise_level: float,
        num_envs: int,
        device: str,
        make_delay: Callable[[int], Delay] | None = None,
    ) -> None:
        """``table``: from ``observation_rows``; ``make_delay(width)``: makes the delay of measured rows."""
        self.groups: dict[str, list[Row]] = {}
        self.buffers: dict[str, Tensor] = {}
        self._parts: dict[str, _Group] = {}
        _check_names(table, cfg)
        for group, entries in table.items():
            rows = [self._group_row(group, entry) if isinstance(entry, str) else entry for entry in entries]
            rows = [row for row in rows if row.name not in cfg.leave_out.get(group, [])]
            frames = {row.name: cfg.history.get(f"{group}.{row.name}", cfg.history.get(group, 1)) for row in rows}
            self.groups[group] = [row._replace(history=frames[row.name]) for row in rows]
            part = _Group(group, self.groups[group], noise_level, num_envs, device)
            if make_delay and any(row.measured for row in rows):
                part.delay = make_delay(part.frame.shape[1])
            self._parts[group], self.buffers[group] = part, part.buffer

    def attach(self, other: Observations, group: str, name: str) -> None:
        """Add ``group`` of ``other``, observations of the same worlds, as ``name``. ``compute`` then updates it too."""
        needed = {group}
        for each in reversed(other.groups):  # a group is after the groups that it contains
            needed |= {row.group for row in other.groups[each] if each in needed}
        self._parts |= {f"{name}/{each}": part for each, part in other._parts.items() if each in needed}
        self.groups[name], self.buffers[name] = other.rows(group), other.buffers[group]

    def rows(self, group: str) -> list[Row]:
        """The rows of ``group`` in order; a group that it contains is replaced by its rows."""
        plain = [[row] if not row.group or row.history > 1 else self.rows(row.group) for row in self.groups[group]]
        return [row for rows in plain for row in rows]

    def compute(self) -> None:
        """Fill the buffers: concatenate rows, add noise, multiply by the scale, delay, append to the history."""
        for part in self._parts.values():
            part.compute()

    def restart(self, mask: Tensor) -> None:
        """Start an episode where ``mask`` (N,) is true: clear delayed values and the history."""
        for part in self._parts.values():
            if part.delay:
                part.delay.restart(mask)
            if part.histories:
                part.fresh.logical_or_(mask)

    def nonfinite(self) -> list[NonFinite]:
        """The counters of invalid values, one per group."""
        return [part.nonfinite for part in self._parts.values()]

    def remember(self) -> list[tuple[Tensor, Tensor]]:
        """(tensor, copy) of all tensors that ``compute`` writes."""
        return [(tensor, tensor.clone()) for part in self._parts.values() for tensor in part.memory()]

    def recall(self, before: list[tuple[Tensor, Tensor]], mask: Tensor) -> None:
        """Restore the copies of ``remember`` where ``mask`` (N,) is true."""
        for tensor, copy in before:
            assign(tensor, mask, copy)

    def span(self, group: str, row: str) -> slice:
        """Columns of all frames of ``row`` in ``group``. Raises ConfigError if the group has no such row."""
        start = 0
        for each in self.groups[group]:
            if each.name == row:
                return slice(start, start + each.size)
            start += each.size
        raise ConfigError(unknown("observation row", row, [each.name for each in self.groups[group]], f"'{group}'"))

    def newest(self, group: str, row: str) -> slice:
        """Columns of the newest frame of ``row`` in ``group``. Raises ConfigError as ``span``."""
        whole = self.span(group, row)
        size = next(each.value.shape[1] for each in self.groups[group] if each.name == row)
        return slice(whole.stop - size, whole.stop)

    def _group_row(self, group: str, name: str) -> Row:
        """The group ``name`` as a row of ``group``, with the same noise. Raises ConfigError for an unknown group."""
        if name not in self.buffers:
            place = "the groups that come before it"
            raise ConfigError(f"observation group '{group}': {unknown('group', name, self.buffers, place)}")
        return Row(name, self.buffers[name], mirror=name, group=name)


class _Group:
    """One group: computes its buffer from its rows."""

    written = ("fresh", "frame", "buffer", "delay", "nonfinite")

    def __init__(self, name: str, rows: list[Row], noise_level: float, num_envs: int, device: str) -> None:
        sizes, spans = [row.value.shape[1] for row in rows], [row.size for row in rows]
        each = [row for row, size in zip(rows, sizes, strict=True) for _ in range(size)]  # the row of each column
        noise = [row.noise * noise_level for row in each]
        scales = [scale for row in rows for scale in row.column_scales()]
        self._values = [row.value for row in rows]
        self._noise = torch.tensor(noise, device=device) if any(noise) else None
        self._scales = torch.tensor(scales, device=device) if any(scale != 1.0 for scale in scales) else None
        self._measured = torch.tensor([row.measured for row in each], device=device)
        self.delay: Delay | None = None
        self.nonfinite = NonFinite([f"observation row '{row.name}' of '{name}'" for row in each], device)
        self.fresh = torch.ones(num_envs, dtype=torch.bool, device=device)  # the history has no frame of this episode
        self.frame = torch.zeros(num_envs, len(each), device=device)  # the newest frame of each row
        self.buffer = self.frame
        self.histories: list[tuple[Tensor, Tensor]] = []  # views: (N, F, size) of the buffer, (N, size) of the frame
        if any(row.history > 1 for row in rows):
            long = max(rows, key=lambda row: row.size)
            what = f"observations.history of '{long.name}' = {long.history}"
            require_memory(4 * num_envs * sum(spans), device, what, "each frame is kept in each world")
            self.buffer = torch.zeros(num_envs, sum(spans), device=device)
            views = zip(rows, self.buffer.split(spans, dim=1), self.frame.split(sizes, dim=1), strict=True)
            self.histories = [(frames.unflatten(1, (row.history, -1)), new) for row, frames, new in views]

    def compute(self) -> None:
        torch.cat(self._values, dim=1, out=self.frame)
        self.nonfinite.clear(self.frame)
        if self._noise is not None:
            self.frame.addcmul_(torch.empty_like(self.frame).uniform_(-1.0, 1.0), self._noise)
        if self._scales is not None:
            self.frame.mul_(self._scales)
        if self.delay:
            self.frame.copy_(torch.where(self._measured, self.delay(self.frame), self.frame))
        for frames, newest in self.histories:
            older = torch.where(self.fresh[:, None, None], newest[:, None], frames[:, 1:])
            frames[:, :-1] = older
            frames[:, -1] = newest
        if self.histories:
            self.fresh.fill_(False)

    def memory(self) -> Iterator[Tensor]:
        """All tensors that ``compute`` writes."""
        yield self.frame
        if self.histories:
            yield self.buffer
        if self.delay:
            yield self.delay.past


def _check_names(table: Mapping[str, Sequence[Row | str]], cfg: type[RobotTaskCfg.observations]) -> None:
    """Raise ConfigError for two rows with the same name, and for a group or row in the config that does not exist."""
    names = {group: [row if isinstance(row, str) else row.name for row in rows] for group, rows in table.items()}
    for group, rows in names.items():
        if twice := [name for name in rows if rows.count(name) > 1]:
            raise ConfigError(f"observation group '{group}' has two rows '{twice[0]}': give each a name of its own")
    for group, left in cfg.leave_out.items():
        if group not in names:
            raise ConfigError(f"observations.leave_out: {unknown('group', group, names, 'the observation table')}")
        for row in left:
            if row not in names[group]:
                raise ConfigError(f"observations.leave_out: {unknown('row', row, names[group], repr(group))}")
        if {*left} == {*names[group]}:
            raise ConfigError(f"observations.leave_out: '{group}' has no row left; leave one in")
    for where in cfg.history:
        group, _, row = where.partition(".")
        if group not in names:
            raise ConfigError(f"observations.history: {unknown('group', group, names, 'the observation table')}")
        if row and (row not in names[group] or row in cfg.leave_out.get(group, [])):
            raise ConfigError(f"observations.history: {unknown('row', row, names[group], repr(group))}")
