"""The network of an export and the controller around it: measurement and command in, servo targets out. No robot, no clock."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legged_mw.deploy.contract import CLOCK, CONTRACT_FILE, NETWORK_FILE, OWN, Contract, ContractError
from legged_mw.deploy.estimate import ESTIMATE, columns_of
from legged_mw.deploy.follow import Follower
from legged_mw.deploy.gait import GaitPhase
from legged_mw.deploy.robot import Measurement
from legged_mw.utils.errors import UserError

Floats = NDArray[np.floating[Any]]
_FIRST_SECONDS, _FIRST_ROOM = 10.0, 2 << 30  # of the first call: networks of robots take a thousandth of either


class Network:
    """``policy.onnx`` on one thread: observations (N, size) -> actions (N, D), float32. ``estimate`` (N, E) is of the last call.

    A recurrent one also takes what it remembers, and returns it after the actions: (N, *shape) of ``contract.memory``.
    """

    def __init__(self, folder: Path, contract: Contract) -> None:
        """Load it; raises ContractError if its inputs and outputs are not the contract's."""
        try:
            import onnxruntime
        except ImportError:
            raise UserError("running an exported policy needs onnxruntime: pip install onnxruntime") from None
        options, self._run = onnxruntime.SessionOptions(), onnxruntime.RunOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # a network this small loses by a second
        options.log_severity_level = self._run.log_severity_level = 4
        network = (folder / NETWORK_FILE).read_bytes()
        self._session = self._first(
            lambda: onnxruntime.InferenceSession(network, options, providers=["CPUExecutionProvider"]), "read"
        )
        memory, guessed = contract.memory, sum(row.size for row in contract.estimate)
        # name -> shape
        self._inputs = {contract.input: [contract.size]} | ({memory.input: [*memory.shape]} if memory else {})
        self._outputs = {contract.output: [len(contract.joints)]} | ({memory.output: [*memory.shape]} if memory else {})
        self._outputs |= {ESTIMATE: [guessed]} if guessed else {}
        self._one_by_one = self._check(contract)
        self.estimate: NDArray[np.float32] | None = None
        self._try()

    def _first(self, work: Callable[[], Any], what: str) -> Any:
        """The first time that the file decides what happens here. Raises ContractError for what takes no end or no measure."""
        try:
            return contained(work, _FIRST_SECONDS, _FIRST_ROOM, stop=lambda: setattr(self._run, "terminate", True))
        except TimeoutError:
            raise ContractError(
                f"{NETWORK_FILE} cannot be {what}: its first call takes longer than {_FIRST_SECONDS:g} s"
            ) from None
        except Exception as error:  # onnxruntime raises a type of its own for each way that a file is broken
            if isinstance(error, MemoryError) or "alloc" in str(error):
                raise ContractError(
                    f"{NETWORK_FILE} cannot be {what}: it asks for more than {_FIRST_ROOM >> 30} GiB"
                ) from None
            text = "cannot be read as an ONNX network" if what == "read" else "cannot be run"
            raise ContractError(f"{NETWORK_FILE} {text}: it is damaged; export the policy again") from None

    def _try(self) -> None:
        """One call with zeros."""
        zeros = {name: np.zeros((1, *shape), dtype=np.float32) for name, shape in self._inputs.items()}
        found = self._first(lambda: self._session.run([*self._outputs], zeros, self._run), "run")
        for (name, shape), value in zip(self._outputs.items(), found, strict=True):
            if np.shape(value) != (1, *shape) or not np.isfinite(value).all():
                got = np.shape(value) if np.shape(value) != (1, *shape) else "what is not finite"
                raise ContractError(
                    f"{NETWORK_FILE}: its output '{name}' for an observation of zeros is {got}; export the policy again"
                )

    def _check(self, contract: Contract) -> bool:
        """Inputs and outputs of the contract's names and sizes; returns whether the batch is fixed to 1."""
        names = ", ".join(f"{row.name} {row.size * row.history}" for row in contract.rows)
        guessed = "".join(f", {row.name} {row.size}" for row in contract.estimate)
        for what, ports, shapes, why in (
            ("input", self._session.get_inputs(), self._inputs, f"the rows of `observation`: {names}"),
            ("output", self._session.get_outputs(), self._outputs, f"one action a joint{guessed}"),
        ):
            if {port.name: port.shape[1:] for port in ports} != shapes:
                found = ", ".join(f"'{port.name}' {port.shape}" for port in ports)
                stated = ", ".join(f"'{name}' {[1, *shape]}" for name, shape in shapes.items())
                raise ContractError(
                    f"{NETWORK_FILE} does not fit {CONTRACT_FILE}: its {what} is {found}, the contract's is {stated} ({why})"
                )
        return self._session.get_inputs()[0].shape[0] == 1

    def __call__(self, *inputs: Floats) -> Any:
        whole = {
            name: np.ascontiguousarray(value, dtype=np.float32)
            for name, value in zip(self._inputs, inputs, strict=True)
        }
        count = len(inputs[0])
        batches = (
            [{name: value[i : i + 1] for name, value in whole.items()} for i in range(count)]
            if self._one_by_one
            else [whole]
        )
        found = [self._session.run([*self._outputs], batch) for batch in batches]
        outputs = dict(zip(self._outputs, (np.concatenate(parts) for parts in zip(*found, strict=True)), strict=True))
        self.estimate = outputs.pop(ESTIMATE, None)
        return list(outputs.values()) if len(outputs) > 1 else outputs.popitem()[1]


class Controller:
    """A policy at work on ``count`` robots: observations and joint targets as the contract states them, and the memory they need."""

    def __init__(
        self, folder: Path, contract: Contract, count: int = 1, network: Callable[..., Any] | None = None
    ) -> None:
        """``network``: what stands for the one in ``folder``; see ``Network``."""
        self.folder, self.contract, self._network = folder, contract, network or Network(folder, contract)
        self.last_observation = np.zeros((count, contract.size), dtype=np.float32)
        self.last_actions = np.zeros((count, len(contract.joints)), dtype=np.float32)
        self.last_targets = np.tile(contract.default_pose, (count, 1))  # (N, D) [rad] the policy's own
        # as last observed
        self._frames = [np.zeros((count, row.history, row.size), dtype=np.float32) for row in contract.rows]
        self._fresh = np.ones(count, dtype=bool)  # robots that have observed nothing since their reset
        self.clock = GaitPhase(contract, count) if contract.gait else None
        self.follower = Follower(folder, contract, count) if contract.motion else None
        self.memory = contract.memory.start(count) if contract.memory else None  # (N, *shape)

    def observe(self, measurement: Measurement, commands: Floats) -> NDArray[np.float32]:
        """The network's input (N, size) from a measurement of N robots (or of one, without the leading axis)."""
        return _side_by_side(self._look(measurement, commands))

    def act(self, measurement: Measurement, commands: Floats) -> NDArray[np.float64]:
        """Joint targets (N, D) [rad], or torques [N m], for the next period; ``commands`` (N, C) in the contract's order.

        They are within the range that servos obey; what the policy asked for itself is in ``last_targets``.
        """
        action = self.contract.action
        self._frames = self._look(measurement, commands)
        if self.clock:
            self.clock.keep(commands, self._fresh)
        if self.follower:
            self.follower.keep(measurement, self._fresh)
        self._fresh[:] = False
        seen = self.last_observation = _side_by_side(self._frames)
        if self.memory is None:
            actions = self._network(seen)
        else:
            actions, self.memory = self._network(seen, self.memory)
        actions = np.where(np.isfinite(actions), actions, np.nan)  # a clipped infinity would look like a wish
        self.last_actions = np.clip(actions, -action.clip, action.clip)
        origins = {
            "default": self.contract.default_pose,
            "joints": np.atleast_2d(measurement.joint_pos),
            "targets": self.last_targets,
        }
        self.last_targets = origins.get(action.origin, 0.0) + action.scale * self.last_actions.astype(np.float64)
        return action.held(self.last_targets)

    def estimate(self, row: str) -> NDArray[np.float64] | None:
        """What the policy believed of ``row`` when it acted last (N, size), in the contract's unit; None if it does not estimate that."""
        columns, believed = columns_of(self.contract.estimate, row), getattr(self._network, "estimate", None)
        return None if columns is None or believed is None else believed[:, columns].astype(np.float64)

    def reset(self, which: Any = slice(None)) -> None:
        """The robots ``which`` (indices or a mask) begin again: nothing of theirs is remembered."""
        self.last_actions[which], self.last_targets[which], self._fresh[which] = 0.0, self.contract.default_pose, True
        if self.memory is not None:
            self.memory[which] = 0.0
        if self.follower:
            self.follower.reset(which)

    def _look(self, measurement: Measurement, commands: Floats) -> list[NDArray[np.float32]]:
        """Frames (N, history, size) of each row, the newest last."""
        computed = {
            "command": commands,
            "last_action": self.last_actions,
            "joint_offset": measurement.joint_pos - self.contract.default_pose,
        }
        if self.clock:
            computed[CLOCK] = self.clock.row(commands, self._fresh)
        if self.follower:
            computed |= self.follower.rows(measurement, self._fresh)
        frames = []
        for row, before in zip(self.contract.rows, self._frames, strict=True):
            if row.measured in OWN and row.name not in measurement.others:
                raise ContractError(
                    f"the robot does not measure row '{row.name}': it must be in Measurement.others ({row.size} values)"
                )
            value = measurement.others[row.name] if row.measured in OWN else computed.get(row.measured)
            value = np.atleast_2d(getattr(measurement, row.measured) if value is None else value)
            newest = (value * np.array(row.scale)).astype(np.float32)[:, None]
            older = np.where(self._fresh[:, None, None], newest, before[:, 1:])
            frames.append(np.concatenate([older, newest], axis=1))
        return frames


def _side_by_side(frames: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    return np.concatenate([frame.reshape(len(frame), -1) for frame in frames], axis=1)


def contained(work: Callable[[], Any], seconds: float, room: int, stop: Callable[[], None] = lambda: None) -> Any:
    """What ``work`` returns, or raises, within that time and ``room`` [byte] of new memory; for a call that a stranger's file decides.

    Past its time it is asked to ``stop``, and a TimeoutError raised; if it does not, it is left behind. Memory is limited on Linux.
    """
    ended: Future[Any] = Future()

    def run() -> None:
        try:
            ended.set_result(work())
        except BaseException as error:
            ended.set_exception(error)

    thread = threading.Thread(target=run, daemon=True)
    with limited_memory(room):
        thread.start()
        thread.join(seconds)
        if late := thread.is_alive():
            stop()
            thread.join(1.0)
    if late:
        raise TimeoutError(f"it has not ended within {seconds:g} s")
    return ended.result()


@contextmanager
def limited_memory(size: int) -> Iterator[None]:
    """Meanwhile the process may take ``size`` [byte] more than it has."""
    if not Path("/proc/self/statm").exists():
        yield
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + size
    resource.setrlimit(resource.RLIMIT_AS, (most if soft == resource.RLIM_INFINITY else min(most, soft), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
