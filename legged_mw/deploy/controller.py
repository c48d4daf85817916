"""The controller of an exported policy. It computes servo targets from a measurement and a command."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.deploy.contract import (
    ATTITUDE,
    CLOCK,
    CONTRACT_FILE,
    ESTIMATE,
    JOINT_POS,
    JOINT_VEL,
    MOTION_FILE,
    NETWORK_FILE,
    OWN,
    PLACE,
    POSITION,
    SCENE_FILE,
    TURN,
    Contract,
    ContractError,
    columns_of,
    compile_scene,
    digest,
    part,
)
from legged_mw.deploy.robot import Measurement
from legged_mw.skills.clip import Clip, conjugate, heading, multiply, read_clip
from legged_mw.utils.commands import VELOCITY
from legged_mw.utils.errors import UserError

Floats = NDArray[np.floating[Any]]
Doubles = NDArray[np.float64]

# ---- gait clock -----------------------------------------------------------------------------------------------------


class GaitPhase:
    """Gait clocks of ``count`` robots with F feet. ``keep`` advances them by the contract's period."""

    def __init__(self, contract: Contract, count: int) -> None:
        """``contract`` must have a section ``gait``."""
        assert contract.gait
        self._gait, self._share = contract.gait, contract.period / contract.gait.period
        names = [command.name for command in contract.commands]
        self._velocity = [names.index(name) for name in VELOCITY]
        self.phase: Floats = np.zeros(count)  # (N,) phase in the last step, share of the gait period
        self.running: NDArray[np.bool_] = np.zeros(count, dtype=bool)  # (N,) true if the last command was to move
        self.start: Floats = np.zeros(count)  # (N,) phase at a robot's first step, if its command is to move

    def row(self, commands: Floats, fresh: NDArray[np.bool_]) -> Floats:
        """(N, 2F) sine of each foot's phase, then cosine; zero at rest. ``fresh`` (N,): robots at their first step."""
        phase, running = self._next(commands, fresh)
        angle = 2.0 * math.pi * (phase[:, None] + np.array(self._gait.offsets))
        return np.concatenate([np.sin(angle), np.cos(angle)], axis=1) * running[:, None]

    def keep(self, commands: Floats, fresh: NDArray[np.bool_]) -> None:
        """Advance by one step with these ``commands`` (N, C)."""
        self.phase, self.running = self._next(commands, fresh)

    def _next(self, commands: Floats, fresh: NDArray[np.bool_]) -> tuple[Floats, NDArray[np.bool_]]:
        """The phase (N,) in the next step, and whether the clock runs (N,)."""
        velocity = np.atleast_2d(commands)[:, self._velocity]
        running = np.broadcast_to((velocity**2).sum(axis=1) > self._gait.min_command**2, self.running.shape)
        phase = np.where(fresh, self.start, np.where(self.running, (self.phase + self._share) % 1.0, 0.0))
        return np.where(running, phase, 0.0), running.copy()


# ---- reference motion -----------------------------------------------------------------------------------------------


class Follower:
    """The reference frames of ``count`` robots: the frame to reach in the next step. The last frame is held.

    A real robot does not know its world position. The motion is moved and turned to the robot at its first step.
    """

    def __init__(self, folder: Path, contract: Contract, count: int) -> None:
        """Load the reference motion. Raises ContractError if it is not the file of ``contract.motion``."""
        assert contract.motion
        file = folder / MOTION_FILE
        if not file.is_file() or digest(file) != contract.motion.digest:
            raise ContractError(
                f"{file} is missing, or not the motion that the policy was exported with; export the policy again"
            )
        self.clip: Clip = read_clip(file).at(1.0 / contract.period).of(contract.joints, MOTION_FILE)
        self._model = compile_scene(part(folder, SCENE_FILE))
        self._data, self._anchor = mujoco.MjData(self._model), self._model.body(contract.motion.anchor).id
        self._angles = [int(self._model.joint(name).qposadr[0]) for name in contract.joints]
        # the last frame is held, with joint speeds of zero
        speed = np.concatenate([self.clip.qvel()[:, 6:], np.zeros((1, len(contract.joints)))])
        self._joints = np.concatenate([self.clip.joint_pos, self.clip.joint_pos[-1:]]), speed
        place, turn = self._anchors(self.clip.root_pos, self.clip.root_quat, self.clip.joint_pos)
        self._place, self._turn = np.concatenate([place, place[-1:]]), np.concatenate([turn, turn[-1:]])
        self.frame = np.ones(count, dtype=int)
        # (N,) frames that replace ``frame``, in the world frame, as in training
        self.start: NDArray[np.int64] | None = None
        self._shift, self._heading = np.zeros((count, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))

    def rows(self, measured: Measurement, fresh: NDArray[np.bool_]) -> dict[str, Doubles]:
        """Observation rows of the motion, (N, ...) each. ``fresh`` (N,): robots at their first step."""
        place, turn = self._measured(measured)
        shift, rotation = self._moved(place, turn, fresh)
        frame = self._now()
        target_place, target_turn = _rotate(rotation, self._place[frame]) + shift, multiply(rotation, self._turn[frame])
        error = _matrix(multiply(conjugate(turn), target_turn))
        rows = {JOINT_POS: self._joints[0][frame], JOINT_VEL: self._joints[1][frame]}
        return rows | {
            PLACE: _rotate(conjugate(turn), target_place - place),
            TURN: error[:, :, :2].reshape(len(error), 6),
        }

    def keep(self, measured: Measurement, fresh: NDArray[np.bool_]) -> None:
        """Advance by one step."""
        self._shift, self._heading = self._moved(*self._measured(measured), fresh)
        self.frame = np.minimum(self._now() + 1, len(self._place) - 1)

    def reset(self, which: Any) -> None:
        """Set the robots ``which`` to the first frame."""
        self.frame[which] = 1

    def ghost(self) -> Doubles:
        """The next reference frames (N, nq) in the scene, moved and turned to the robots."""
        frame = np.minimum(self._now(), len(self.clip.root_pos) - 1)
        states = np.zeros((len(frame), self._model.nq))
        states[:, :3] = _rotate(self._heading, self.clip.root_pos[frame]) + self._shift
        states[:, 3:7], states[:, self._angles] = (
            multiply(self._heading, self.clip.root_quat[frame]),
            self.clip.joint_pos[frame],
        )
        return states

    def _now(self) -> NDArray[np.int64]:
        return np.minimum(self.frame if self.start is None else self.start, len(self._place) - 1)

    def _measured(self, measured: Measurement) -> tuple[Doubles, Doubles]:
        """Position (N, 3) and attitude (N, 4) of the anchor, from the measured root and joint angles."""
        attitude = np.atleast_2d(measured.others[ATTITUDE])
        root = np.atleast_2d(measured.others.get(POSITION, np.zeros((len(attitude), 3))))
        return self._anchors(root, attitude, np.atleast_2d(measured.joint_pos))

    def _anchors(self, root: Doubles, attitude: Doubles, joints: Doubles) -> tuple[Doubles, Doubles]:
        place, turn = np.zeros((len(root), 3)), np.zeros((len(root), 4))
        for i in range(len(root)):
            self._data.qpos[:3], self._data.qpos[3:7], self._data.qpos[self._angles] = root[i], attitude[i], joints[i]
            mujoco.mj_kinematics(self._model, self._data)
            place[i], turn[i] = self._data.xpos[self._anchor], self._data.xquat[self._anchor]
        return place, turn

    def _moved(self, place: Doubles, turn: Doubles, fresh: NDArray[np.bool_]) -> tuple[Doubles, Doubles]:
        """Shift (N, 3) and rotation (N, 4) of the motion. They move it to ``fresh`` robots' position and heading."""
        if self.start is not None:
            return self._shift, self._heading
        previous = self._now() - 1
        rotation = np.where(fresh[:, None], heading(multiply(turn, conjugate(self._turn[previous]))), self._heading)
        shift = (place - _rotate(rotation, self._place[previous])) * [1.0, 1.0, 0.0]
        return np.where(fresh[:, None], shift, self._shift), rotation


def _rotate(q: Doubles, v: Doubles) -> Doubles:
    """Rotate vectors (N, 3) by quaternions (N, 4)."""
    return (_matrix(q) @ v[..., None])[..., 0]


def _matrix(q: Doubles) -> Doubles:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4)."""
    matrices = np.zeros((len(q), 9))
    for matrix, each in zip(matrices, q, strict=True):
        mujoco.mju_quat2Mat(matrix, each)
    return matrices.reshape(-1, 3, 3)


_FIRST_SECONDS, _FIRST_ROOM = 10.0, 2 << 30  # [s], [byte] limits of the first call; robot networks need 0.1 % of them


class Network:
    """Runs ``policy.onnx`` on one thread: observations (N, size) -> actions (N, D), float32.

    A recurrent network also takes its memory, (N, *shape) of ``contract.memory``, and returns it after the actions.
    ``estimate`` (N, E) is the estimate of the last call.
    """

    def __init__(self, folder: Path, contract: Contract) -> None:
        """Load the network. Raises ContractError if its inputs or outputs differ from the contract's."""
        try:
            import onnxruntime
        except ImportError:
            raise UserError("running an exported policy needs onnxruntime: pip install onnxruntime") from None
        options, self._run = onnxruntime.SessionOptions(), onnxruntime.RunOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # a second thread slows a small network
        options.log_severity_level = self._run.log_severity_level = 4
        network = (folder / NETWORK_FILE).read_bytes()
        self._session = self._first(
            lambda: onnxruntime.InferenceSession(network, options, providers=["CPUExecutionProvider"]), "read"
        )
        memory, estimate_size = contract.memory, sum(row.size for row in contract.estimate)
        # name -> shape
        self._inputs = {contract.input: [contract.size]} | ({memory.input: [*memory.shape]} if memory else {})
        self._outputs = {contract.output: [len(contract.joints)]} | ({memory.output: [*memory.shape]} if memory else {})
        self._outputs |= {ESTIMATE: [estimate_size]} if estimate_size else {}
        self._one_by_one = self._check(contract)
        self.estimate: NDArray[np.float32] | None = None
        self._try()

    def _first(self, work: Callable[[], Any], what: str) -> Any:
        """Load or run the file for the first time. Raises ContractError if it takes too much time or memory."""
        try:
            return contained(work, _FIRST_SECONDS, _FIRST_ROOM, stop=lambda: setattr(self._run, "terminate", True))
        except TimeoutError:
            raise ContractError(
                f"{NETWORK_FILE} cannot be {what}: its first call takes longer than {_FIRST_SECONDS:g} s"
            ) from None
        except Exception as error:  # onnxruntime has one exception type per kind of damage
            if isinstance(error, MemoryError) or "alloc" in str(error):
                raise ContractError(
                    f"{NETWORK_FILE} cannot be {what}: it asks for more than {_FIRST_ROOM >> 30} GiB"
                ) from None
            text = "cannot be read as an ONNX network" if what == "read" else "cannot be run"
            raise ContractError(f"{NETWORK_FILE} {text}: it is damaged; export the policy again") from None

    def _try(self) -> None:
        """Call the network once with zeros."""
        zeros = {name: np.zeros((1, *shape), dtype=np.float32) for name, shape in self._inputs.items()}
        outputs = self._first(lambda: self._session.run([*self._outputs], zeros, self._run), "run")
        for (name, shape), value in zip(self._outputs.items(), outputs, strict=True):
            if np.shape(value) != (1, *shape) or not np.isfinite(value).all():
                problem = np.shape(value) if np.shape(value) != (1, *shape) else "not finite"
                raise ContractError(
                    f"{NETWORK_FILE}: its output '{name}' for an observation of zeros is {problem}; export the policy again"
                )

    def _check(self, contract: Contract) -> bool:
        """Compare inputs and outputs with the contract. Returns True if the batch size is fixed to 1."""
        names = ", ".join(f"{row.name} {row.size * row.history}" for row in contract.rows)
        estimate = "".join(f", {row.name} {row.size}" for row in contract.estimate)
        for what, ports, shapes, meaning in (
            ("input", self._session.get_inputs(), self._inputs, f"the rows of `observation`: {names}"),
            ("output", self._session.get_outputs(), self._outputs, f"one action a joint{estimate}"),
        ):
            if {port.name: port.shape[1:] for port in ports} != shapes:
                actual = ", ".join(f"'{port.name}' {port.shape}" for port in ports)
                expected = ", ".join(f"'{name}' {[1, *shape]}" for name, shape in shapes.items())
                raise ContractError(
                    f"{NETWORK_FILE} does not fit {CONTRACT_FILE}: its {what} is {actual}, the contract's is {expected} ({meaning})"
                )
        return self._session.get_inputs()[0].shape[0] == 1

    def __call__(self, *inputs: Floats) -> Any:
        arrays = {
            name: np.ascontiguousarray(value, dtype=np.float32)
            for name, value in zip(self._inputs, inputs, strict=True)
        }
        count = len(inputs[0])
        batches = (
            [{name: value[i : i + 1] for name, value in arrays.items()} for i in range(count)]
            if self._one_by_one
            else [arrays]
        )
        results = [self._session.run([*self._outputs], batch) for batch in batches]
        outputs = dict(zip(self._outputs, (np.concatenate(parts) for parts in zip(*results, strict=True)), strict=True))
        self.estimate = outputs.pop(ESTIMATE, None)
        return list(outputs.values()) if len(outputs) > 1 else outputs.popitem()[1]


class Controller:
    """Runs a policy on ``count`` robots. It computes observations and joint targets as the contract states."""

    def __init__(
        self, folder: Path, contract: Contract, count: int = 1, network: Callable[..., Any] | None = None
    ) -> None:
        """``network`` replaces the network in ``folder``; see ``Network``."""
        self.folder, self.contract, self._network = folder, contract, network or Network(folder, contract)
        self.last_observation = np.zeros((count, contract.size), dtype=np.float32)
        self.last_actions = np.zeros((count, len(contract.joints)), dtype=np.float32)
        # (N, D) [rad] before clipping to the servos' range
        self.last_targets = np.tile(contract.default_pose, (count, 1))
        # per row: (N, history, size) frames of the last observation
        self._frames = [np.zeros((count, row.history, row.size), dtype=np.float32) for row in contract.rows]
        self._fresh = np.ones(count, dtype=bool)  # (N,) robots without an observation since their reset
        self.clock = GaitPhase(contract, count) if contract.gait else None
        self.follower = Follower(folder, contract, count) if contract.motion else None
        self.memory = contract.memory.start(count) if contract.memory else None  # (N, *shape)

    def observe(self, measurement: Measurement, commands: Floats) -> NDArray[np.float32]:
        """The network's input (N, size) from the measurement of N robots. One robot needs no leading axis."""
        return _side_by_side(self._look(measurement, commands))

    def act(self, measurement: Measurement, commands: Floats) -> NDArray[np.float64]:
        """Joint targets (N, D) [rad], or torques [N m], for the next period.

        ``commands`` (N, C) in the contract's order. The result is clipped to the servos' range; ``last_targets`` holds
        the targets before clipping.
        """
        action = self.contract.action
        self._frames = self._look(measurement, commands)
        if self.clock:
            self.clock.keep(commands, self._fresh)
        if self.follower:
            self.follower.keep(measurement, self._fresh)
        self._fresh[:] = False
        observation = self.last_observation = _side_by_side(self._frames)
        if self.memory is None:
            actions = self._network(observation)
        else:
            actions, self.memory = self._network(observation, self.memory)
        actions = np.where(np.isfinite(actions), actions, np.nan)  # clipping would turn infinity into a valid action
        self.last_actions = np.clip(actions, -action.clip, action.clip)
        origins = {
            "default": self.contract.default_pose,
            "joints": np.atleast_2d(measurement.joint_pos),
            "targets": self.last_targets,
        }
        self.last_targets = origins.get(action.origin, 0.0) + action.scale * self.last_actions.astype(np.float64)
        return action.held(self.last_targets)

    def estimate(self, row: str) -> NDArray[np.float64] | None:
        """The policy's last estimate of ``row`` (N, size), in the contract's unit; None if there is none."""
        columns, estimate = columns_of(self.contract.estimate, row), getattr(self._network, "estimate", None)
        return None if columns is None or estimate is None else estimate[:, columns].astype(np.float64)

    def reset(self, which: Any = slice(None)) -> None:
        """Reset the robots ``which`` (indices or a mask): history, last actions, memory and reference frame."""
        self.last_actions[which], self.last_targets[which], self._fresh[which] = 0.0, self.contract.default_pose, True
        if self.memory is not None:
            self.memory[which] = 0.0
        if self.follower:
            self.follower.reset(which)

    def _look(self, measurement: Measurement, commands: Floats) -> list[NDArray[np.float32]]:
        """The frames (N, history, size) of each row. The newest frame is last."""
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
    """Run ``work`` in a thread with at most ``room`` [byte] of new memory. Returns its result or raises its error.

    It runs untrusted files. After ``seconds`` it calls ``stop`` and raises TimeoutError; a thread that does not stop
    is abandoned. Memory is limited on Linux only.
    """
    future: Future[Any] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    thread = threading.Thread(target=run, daemon=True)
    with limited_memory(room):
        thread.start()
        thread.join(seconds)
        if timed_out := thread.is_alive():
            stop()
            thread.join(1.0)
    if timed_out:
        raise TimeoutError(f"it has not ended within {seconds:g} s")
    return future.result()


@contextmanager
def limited_memory(size: int) -> Iterator[None]:
    """Context manager: the process can allocate at most ``size`` [byte] of new memory. No effect outside Linux."""
    if not Path("/proc/self/statm").exists():
        yield
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    limit = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + size
    resource.setrlimit(resource.RLIMIT_AS, (limit if soft == resource.RLIM_INFINITY else min(limit, soft), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
