"""The log of a run on one robot, in one compressed file: measurements, observations, actions, commands, trips.

The file is a sequence of blocks. A block is a length (8 bytes, little-endian) and an .npz of that length. The first
block is a header with the export's files. Each other block has the columns of CHUNK steps.
A process that crashes loses only the last chunk. The file holds no code and is read without pickle.
"""

from __future__ import annotations

import io
import json
import queue
import struct
import tempfile
import threading
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from legged_mw.deploy.contract import (
    CONTRACT_FILE,
    ESTIMATE,
    MOTION_FILE,
    MOTORS_FILE,
    NETWORK_FILE,
    SCENE_FILE,
    TERRAIN_FILE,
    Contract,
    read_contract,
)
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.loop import Loop
from legged_mw.deploy.robot import Floats, Health, Measurement, layout
from legged_mw.deploy.states import POLICY, STATES, Order
from legged_mw.utils.errors import UserError, shown
from legged_mw.utils.files import check_name

FORMAT = 1
CHUNK = 100  # steps per block
BACKLOG = 60  # largest number of blocks in the queue; it limits the memory if the disk is slow
LOGS, SUFFIX = Path("logs/deploy"), ".lmwlog"
# files of an export to copy into a log, if they exist
EXPORT = (CONTRACT_FILE, NETWORK_FILE, SCENE_FILE, MOTORS_FILE, MOTION_FILE, TERRAIN_FILE)
_LENGTH = struct.Struct("<Q")


class LogError(UserError, ValueError):
    """The file is not a log or cannot be written."""


def log_path(contract: Contract) -> Path:
    """The default path of a run's log."""
    task = check_name(contract.task, f"{CONTRACT_FILE}: task")
    return LOGS / f"{task}_{time.strftime('%Y-%m-%d_%H-%M-%S')}{SUFFIX}"


def _columns(contract: Contract) -> dict[str, int]:
    """Column -> values per step. ``time``, ``behind``, ``work`` and ``age`` [s]; ``state`` is an index in STATES."""
    joints = len(contract.joints)
    return {
        **dict.fromkeys(("time", "behind", "work", "age", "state", "voltage"), 1),
        **{"command": len(contract.commands), "observation": contract.size},
        **dict.fromkeys(("action", "wanted", "target", "stiffness", "damping", "temperature"), joints),
        **({ESTIMATE: sum(row.size for row in contract.estimate)} if contract.estimate else {}),
        **layout(contract),
    }


class Log:
    """Writes the log of a run. A separate thread compresses and writes; a step only copies numbers."""

    def __init__(
        self, path: Path, contract: Contract, folder: Path, robot: str, say: Callable[[str], None] = print
    ) -> None:
        """Create the file. Raises LogError if this fails. ``say`` gets one line if writing fails later."""
        self.path, self.contract, self._say = path, contract, say
        self.broken = ""  # error that stopped writing
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("xb")
        except OSError as error:
            raise LogError(f"cannot write the log {path}: {error.strerror}; say --log FILE, or --log off") from None
        about = {
            "format": FORMAT,
            "task": contract.task,
            "network": contract.digest,
            "robot": robot,
            "export": str(folder.resolve()),
        }
        self._blocks: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        header = json.dumps({**about, "began": time.strftime("%Y-%m-%d %H:%M:%S"), "contract": contract.to_dict()})
        files = {name: np.fromfile(folder / name, np.uint8) for name in EXPORT if (folder / name).is_file()}
        self._blocks.put({"header": header, **files})
        self._events: list[tuple[float, str]] = []
        self._lost = 0  # steps that were not written
        self._begin()
        self._thread = threading.Thread(target=self._write, name="log", daemon=True)
        self._thread.start()

    def add(
        self, loop: Loop, controller: Controller, measured: Measurement, health: Health, order: Order, command: Floats
    ) -> None:
        """Log one step. Missing values are NaN."""
        missing, contract = np.nan, self.contract
        targets, active = order.targets is not None, order.state == POLICY
        stiffness = contract.stiffness if order.stiffness is None else order.stiffness
        damping = contract.damping if order.damping is None else order.damping
        values = {
            **{"time": loop.now, "behind": loop.behind, "work": loop.work, "state": STATES.index(order.state)},
            **{
                "age": _or_nan(health.age_s),
                "voltage": _or_nan(health.voltage),
                "temperature": _or_nan(health.temperatures),
            },
            **{"command": command, "observation": controller.last_observation[0] if active else missing},
            **{
                "action": controller.last_actions[0] if active else missing,
                "wanted": controller.last_targets[0] if active else missing,
            },
            "target": order.targets if targets else missing,  # as sent to the servos
            **{"stiffness": stiffness if targets else missing, "damping": damping if targets else missing},
            ESTIMATE: _believed(controller) if active else missing,
        }
        for name, column in self._rows.items():
            value = values.get(name)
            column[self._count] = (
                (measured.others[name] if name in measured.others else getattr(measured, name))
                if value is None
                else value
            )
        self._count += 1
        if self._count == CHUNK:
            self._hand_over()

    def event(self, now: float, text: str) -> None:
        """Log a trip or another event at the time ``now`` [s]."""
        self._events.append((now, text))

    def close(self) -> None:
        """Write the remaining steps. Safe to call twice."""
        if self._thread.is_alive():
            self._hand_over(last=True)
            self._blocks.put(None)
            self._thread.join()

    def _begin(self) -> None:
        self._count, self._events = 0, []
        sizes = _columns(self.contract).items()
        self._rows = {
            name: np.empty((CHUNK, size), np.float64 if name == "time" else np.float32) for name, size in sizes
        }

    def backlog(self) -> int:
        """The number of blocks in the queue."""
        return self._blocks.qsize()

    def _hand_over(self, last: bool = False) -> None:
        if self.broken or (not last and self.backlog() >= BACKLOG):
            self._lost, self._count = self._lost + self._count, 0
            return
        if self._lost:
            self.event(float(self._rows["time"][0, 0]), f"{self._lost} steps were not logged: the disk is too slow")
            self._lost = 0
        if self._count or self._events:
            rows = {name: column[: self._count] for name, column in self._rows.items()}
            self._blocks.put({**rows, "events": json.dumps(self._events)})
            self._begin()

    def _write(self) -> None:
        steps = 0
        try:
            with self._file:
                while (block := self._blocks.get()) is not None:
                    buffer = io.BytesIO()
                    np.savez_compressed(buffer, **block)
                    self._file.write(_LENGTH.pack(buffer.tell()) + buffer.getvalue())
                    self._file.flush()
                    steps += len(block.get("time", ()))
        except OSError as error:  # e.g. a full disk; the run continues
            self.broken = f"the log {shown(self.path)} ends after {steps} steps: {error.strerror or error}"
            self._say(self.broken)


def _believed(controller: Controller) -> Any:
    """The values of all rows of the last estimate; NaN without an estimate."""
    rows = [controller.estimate(row.name) for row in controller.contract.estimate]
    known = [row[0] for row in rows if row is not None]
    return np.concatenate(known) if known else np.nan


def _or_nan(value: Any) -> Any:
    return np.nan if value is None else value


@dataclass(frozen=True)
class DriveLog:
    """The content of a log."""

    header: dict[str, Any]
    files: dict[str, bytes]  # of the export: name -> content
    rows: dict[str, Floats]  # name -> (T, values)
    events: list[tuple[float, str]]


def read_log(path: Path) -> DriveLog:
    """Read the log. A truncated last block is ignored. Raises LogError."""
    try:
        first, *blocks = _blocks(path)
        header = json.loads(str(first["header"]))
        files = {name: first[name].tobytes() for name in EXPORT if name in first}
        rows = (
            {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0] if name != "events"}
            if blocks
            else {}
        )
        events = [(float(now), str(text)) for block in blocks for now, text in json.loads(str(block["events"]))]
        readable = header["format"] == FORMAT
    except OSError as error:
        raise LogError(f"cannot read {path}: {error.strerror}; a driven robot writes its logs to {LOGS}") from None
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error):
        raise LogError(f"{path} is not a log of legged_mw.deploy") from None
    if not readable:
        raise LogError(f"{path} is a log of format {header['format']}; this version reads {FORMAT}")
    if not rows:
        raise LogError(f"{path} has no step: its run ended within the first {CHUNK} steps, or was interrupted")
    return DriveLog(header, files, rows, events)


def _blocks(path: Path) -> Iterator[dict[str, Any]]:
    with path.open("rb") as file:
        while len(start := file.read(_LENGTH.size)) == _LENGTH.size:
            (length,) = _LENGTH.unpack(start)
            if length > 1 << 28:
                raise ValueError("not a block")
            data = file.read(length)
            if len(data) < length:
                return
            with np.load(io.BytesIO(data), allow_pickle=False) as block:
                yield {name: block[name] for name in block.files}


@contextmanager
def logged_export(
    path: Path, folder: Path | None = None, edited: bool = False
) -> Iterator[tuple[DriveLog, Path, Contract]]:
    """The log, and the export in ``folder`` (None: the one in the log) with its contract.

    ``edited``: see read_contract. Raises LogError, ContractError.
    """
    recording = read_log(path)
    with tempfile.TemporaryDirectory() as own:
        for name, content in recording.files.items():
            (Path(own) / name).write_bytes(content)
        folder = folder or (Path(own) if recording.files else Path(recording.header["export"]))
        contract = read_contract(folder, edited)
        if contract.digest != recording.header["network"]:
            raise LogError(
                f"{shown(path)} was recorded with another network than the one in {shown(folder)} "
                f"({recording.header['task']}); name its export"
            )
        yield recording, folder, contract
