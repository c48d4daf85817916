"""The files of a checkpoint: written whole, and read without running code or trusting a number in them.

``model_N.pt`` holds networks, optimizer and counters. ``worlds_N.pt`` beside the newest one holds worlds, generators
and memories, with which a resumed training goes on exactly.
"""

from __future__ import annotations

import hashlib
import io
import math
import os
import re
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from legged_mw.envs.robot_task import RobotTask
from legged_mw.envs.snapshot import memory, put_snapshot, take_snapshot
from legged_mw.rl.ranks import Rank
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import brief

_SEAL = b"sha256:"
EARLIER = "an earlier one is named by --checkpoint"


def save_whole(content: dict[str, Any], path: Path, sync: bool = True) -> None:
    """Write a checkpoint with its checksum: whole, or not at all after a kill (``sync``: or a power cut)."""
    temporary, archive = path.with_name(f".{path.name}.{os.getpid()}.tmp"), io.BytesIO()
    torch.save(content, archive)
    try:
        with open(temporary, "wb") as file:
            file.write(sealed(archive.getvalue()))
            file.flush()
            if sync:
                os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def load_tensors(path: Path, device: str) -> dict[str, Any]:
    """Read a checkpoint and check its content (``check_content``); runs no code from it. Raises ConfigError."""
    try:
        written = path.read_bytes()
    except FileNotFoundError:
        raise ConfigError(f"no checkpoint at {path}") from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from None
    why = damage(written)
    try:
        content = None if why else torch.load(io.BytesIO(written), map_location=device, weights_only=True)
    except Exception:  # a zip, pickle or tensor error; torch's own text advises to load the file unsafely
        why = "it is damaged, or holds more than tensors and numbers"
    if why:
        raise ConfigError(f"{path} cannot be read as a checkpoint: {why}; {EARLIER}")
    return check_content(content, path)


def sealed(archive: bytes) -> bytes:
    """The zip ``archive`` of torch with its SHA-256 as the zip's comment, which torch ignores."""
    head = archive[:-2]  # without the length of the comment, which is 0
    note = _SEAL + hashlib.sha256(head).hexdigest().encode()
    return head + struct.pack("<H", len(note)) + note


def damage(content: bytes) -> str:
    """Why the file is corrupt, or ''. Sealed files are checked by SHA-256, older ones by the zip's CRCs."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if note := archive.comment:
                if sealed(content[: -len(note) - 2] + b"\0\0") == content:
                    return ""
                return "it is damaged: its SHA-256 is another than the one in it"
            if any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist()):
                return "it is damaged: parts of it are compressed"
            part = archive.testzip()
            return f"it is damaged: the checksum of its part {part} is wrong" if part else ""
    except Exception as error:  # zipfile raises many kinds
        return f"it is damaged: {error}"


# ---- what a checkpoint may hold -------------------------------------------------------------------------------------

_KINDS = {int: "a whole number from 0", dict: "a mapping"}
_ADAM = ("step", "exp_avg", "exp_avg_sq")  # Adam's state of a parameter
_CHOSEN = ("amsgrad", "maximize", "differentiable")  # settings of Adam that the config decides
# of a task, never below 0
_LEVELS = ("kick_level", "pull_level", "terrain_levels", "command_curriculum", "num_envs", "motion_failures")


def check_content(content: Any, path: Path) -> dict[str, Any]:
    """Raise ConfigError unless ``content`` has networks, and each part is finite and of its kind; returns it."""
    networks = ("actor_state_dict", "student_state_dict")
    if not isinstance(content, dict) or not {*networks} & content.keys():
        raise ConfigError(f"{path} is not a checkpoint of this project: it has no actor_state_dict")
    check = Checker(path)
    for name in content:
        if name in (*networks, "critic_state_dict", "teacher_state_dict"):
            check.weights(content, name)
    if "iter" in content:
        check.take(content, "iter", int)
    if content.get("infos") is not None:
        infos = check.take(content, "infos", dict)
        if "total_steps" in infos:
            check.take(infos, "total_steps", int, "infos: ")
        if not _is_number(seconds := infos.get("seconds", 0.0)):
            raise check.fail(f"infos: seconds is {_short(seconds)}, it must be a number from 0")
        check.random_state(infos)
    return content


def check_resume(
    content: Mapping[str, Any], path: Path, optimizer: torch.optim.Optimizer, task: Mapping[str, Tensor]
) -> None:
    """Raise ConfigError unless training can go on: the file's name, state of ``optimizer``, state of the ``task``."""
    check = Checker(path)
    done = check.take(content, "iter", int)
    if (named := re.fullmatch(r"model_(\d+)\.pt", path.name)) and int(named[1]) != done:
        raise check.fail(f"its name says {int(named[1])} iterations, and it has done {done}: call it model_{done}.pt")
    check.adam(content, "optimizer_state_dict", optimizer, done)
    check.task(content.get("infos") or {}, task)


def check_fit(saved: dict[str, Tensor], wanted: dict[str, Tensor], path: Path, what: str) -> None:
    """Raise ConfigError unless the parameters ``saved`` in ``path`` fit those ``wanted`` by the network."""
    has, wants = (any(name.startswith("rnn.") for name in names) for names in (saved, wanted))
    if saved and has != wants:
        where, not_where = ("there", "here") if has else ("here", "there")
        raise ConfigError(
            f"{path} does not fit this task: the {what} has a memory (RNNModel) {where} and none {not_where}"
        )
    for name in [*wanted, *saved]:
        here, there = wanted.get(name), saved.get(name)
        if here is None or there is None or here.shape != there.shape:
            shapes = ["missing" if t is None else str(tuple(t.shape)) for t in (there, here)]
        elif here.is_floating_point() != there.is_floating_point():
            shapes = [str(t.dtype).removeprefix("torch.") for t in (there, here)]
        elif not bool(there.isfinite().all()):
            raise ConfigError(f"{path}: {what} {name} has values that are not finite")
        else:
            continue
        raise ConfigError(f"{path} does not fit this task: {what} {name} is {shapes[0]} there and {shapes[1]} here")


class Checker:
    """Checks the parts of one checkpoint. An error is one line that names the file and the part."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def fail(self, what: str) -> ConfigError:
        return ConfigError(f"{self.path}: {what}; {EARLIER}")

    def take(self, holder: Mapping[Any, Any], name: str, kind: type, where: str = "") -> Any:
        """``holder[name]``, of ``kind`` dict, or int for a whole number from 0."""
        value = holder.get(name)
        below = isinstance(value, int) and value < 0
        if below or isinstance(value, bool) or not isinstance(value, Mapping if kind is dict else kind):
            raise self.fail(f"{where}{name} is {_short(value)}, it must be {_KINDS[kind]}")
        return value

    def tensor(self, value: Any, what: str, shape: torch.Size | None = None) -> Tensor:
        """``value``, a plain tensor of finite real numbers, all of them stored."""
        if not isinstance(value, Tensor) or value.layout != torch.strided or value.is_meta or value.is_quantized:
            raise self.fail(f"{what} is {_short(value)}, it must be a tensor")
        if shape is not None and value.shape != shape:
            raise self.fail(f"{what} is {tuple(value.shape)}, it must be {tuple(shape)}")
        if value.numel() * value.element_size() > value.untyped_storage().nbytes():
            raise self.fail(f"{what} shows {value.numel()} numbers and has fewer")
        if value.is_complex():
            raise self.fail(f"{what} is {_short(value)}")
        if not bool(value.isfinite().all()):
            raise self.fail(f"{what} has values that are not finite")
        return value

    def weights(self, content: Mapping[str, Any], name: str) -> None:
        """The parameters of a network; variances, deviations and counts must not be negative."""
        for key, value in self.take(content, name, dict).items():
            if not isinstance(key, str):
                raise self.fail(f"{name} has a parameter called {_short(key)}, which is no text")
            self.tensor(value, f"{name}: {key}")
            if re.search(r"(\._var|\._std|\.count)$", key) and bool((value < 0).any()):
                raise self.fail(f"{name}: {key} is negative")

    def adam(self, content: Mapping[str, Any], name: str, optimizer: torch.optim.Optimizer, done: int) -> None:
        """The state of ``optimizer`` after ``done`` iterations. It counts parameters group by group."""
        saved, parameters = self.take(content, name, dict), list[Tensor]()
        groups, own = saved.get("param_groups"), optimizer.param_groups
        if not isinstance(groups, list) or len(groups) != len(own):
            raise self.fail(f"{name}: param_groups must be a list of {len(own)}")
        for group, mine in zip(groups, own, strict=True):
            count = range(len(parameters), len(parameters) + len(mine["params"]))
            self._group(group, mine, f"{name}: ")
            if not isinstance(group.get("params"), list) or [*map(_short, group["params"])] != [*map(_short, count)]:
                raise self.fail(f"{name}: params must count the parameters, from {count.start} to {count.stop - 1}")
            parameters += mine["params"]
        if not (state := self.take(saved, "state", dict, f"{name}: ")) and done:
            raise self.fail(f"{name}: state is empty after {done} iterations")
        for index, held in state.items():
            if type(index) is not int or not 0 <= index < len(parameters) or not isinstance(held, Mapping):
                raise self.fail(f"{name}: state {_short(index)} is of no parameter")
            if "betas" in own[0] and not {*_ADAM} <= held.keys():
                raise self.fail(f"{name}: state of parameter {index} must have {', '.join(_ADAM)}")
            for key, value in held.items():
                what = f"{name}: {key} of parameter {index}"
                value = self.tensor(value, what, torch.Size([]) if key == "step" else parameters[index].shape)
                if not value.is_floating_point():
                    raise self.fail(f"{what} is {_short(value)}")
                if key != "exp_avg" and bool((value < 0).any()):
                    raise self.fail(f"{what} is negative")

    def _group(self, group: Any, own: Mapping[str, Any], where: str) -> None:
        """The settings of a group of parameters, of the kinds of those in ``own``."""
        if not isinstance(group, Mapping):
            raise self.fail(f"{where}a group is {_short(group)}")
        for key in group.keys() & own.keys() - {"params"}:
            if not _is_setting(key, group[key], own[key]):
                raise self.fail(f"{where}{key} is {_short(group[key])}; that is none")
        if missing := [key for key in ("lr", "betas", "eps", "weight_decay") if key in own and key not in group]:
            raise self.fail(f"{where}{missing[0]} is missing")

    def random_state(self, infos: Mapping[str, Any]) -> None:
        """States of torch's generators."""
        for name, value in self.take(infos, "random_state", dict, "infos: ").items() if "random_state" in infos else ():
            self.tensor(value, f"infos: random_state: {name}")
            if name == "cpu":
                try:
                    torch.Generator().set_state(value.cpu())
                except (RuntimeError, TypeError):
                    raise self.fail("infos: random_state: cpu is no state of torch's generator") from None

    def task(self, infos: Mapping[str, Any], own: Mapping[str, Tensor]) -> None:
        """Levels and counts of a task, shaped as in ``own``; the number of worlds may differ."""
        saved = self.take(infos, "env", dict, "infos: ") if "env" in infos else {}
        for name in saved.keys() & own.keys():
            value, mine, what = self.tensor(saved[name], f"infos: env: {name}"), own[name], f"infos: env: {name}"
            alike = value.dtype == mine.dtype and value.shape[1:] == mine.shape[1:] and value.dim() == mine.dim()
            if not alike or not value.numel():
                raise self.fail(f"{what} is {_short(value)}, it must be as {_short(mine)}")
            if name in _LEVELS and bool((value < 0).any()):
                raise self.fail(f"{what} is negative")


def _is_setting(key: str, value: Any, own: Any) -> bool:
    """Whether Adam's setting ``key`` may be ``value``; ``own`` is the present one."""
    if own is None or isinstance(own, bool):
        return (value is None or isinstance(value, bool)) and (key not in _CHOSEN or value == own)
    if key == "betas":
        pair = isinstance(value, list | tuple) and len(value) == 2
        return pair and all(_is_number(beta) and beta < 1.0 for beta in value)
    return _is_number(value) and (key != "lr" or value > 0.0)


def _is_number(value: object) -> bool:
    """Whether it is a finite number from 0."""
    return isinstance(value, int | float) and not isinstance(value, bool) and 0.0 <= value < math.inf


def _short(value: object) -> str:
    """A value in an error line, however long it is."""
    if isinstance(value, Tensor):
        return f"{tuple(value.shape)} {str(value.dtype).removeprefix('torch.')}"
    if isinstance(value, tuple | list) and len(value) < 5:
        opens, closes = "[]" if isinstance(value, list) else "()"
        return f"{opens}{', '.join(map(_short, value))}{closes}"
    return brief(value, 60) if isinstance(value, int | float | str | None) else f"a {type(value).__name__}"


# ---- the worlds beside a checkpoint ---------------------------------------------------------------------------------
# A file of their own, as it is large and not needed to play a policy. It is written before its checkpoint, and the file
# of the checkpoint before is deleted after, so that a kill at any moment leaves the newest checkpoint with its worlds.

_MOST = 1e10  # a state beyond it has blown up for MuJoCo: mjMAXVAL
_FREE = ("rewards", "noise", "viewer", "exam", "termination")  # sections of the config that a resumed run may change


def worlds_file(checkpoint: Path, rank: Rank) -> Path:
    """The file of the worlds of ``rank`` beside ``checkpoint``."""
    return checkpoint.with_name(f"worlds_{checkpoint.stem.removeprefix('model_')}{suffix_of(rank)}.pt")


def suffix_of(rank: Rank) -> str:
    """The part of a file's name that is the rank's own; '' for a single process."""
    return f"_{rank.index}of{rank.count}" if rank.count > 1 else ""


def worlds_content(runner: Any) -> dict[str, Any]:
    """The content of the file of worlds: tensors and plain numbers only."""
    return {
        **_same_worlds(runner.env),
        "random_state": random_state(runner.device),
        "worlds": take_snapshot(runner.env),
        "memories": {name: state.cpu().clone() for name, state in _memories(runner).items()},
    }


def take_worlds(runner: Any, checkpoint: Path, rank: Rank, random: dict[str, Tensor]) -> str:
    """Restore worlds and memories of ``checkpoint``, whose generators are ``random``; returns why not, or ''."""
    file = worlds_file(checkpoint, rank)
    if not file.is_file():
        return f"there is no {file.name} beside it"
    try:
        if why := damage(written := file.read_bytes()):
            return f"{file.name} cannot be read: {why}"
        content = torch.load(io.BytesIO(written), map_location="cpu", weights_only=True)
        here = _same_worlds(runner.env)
        there = {key: content[key] for key in here}
        state, worlds, memories = (dict(content[key]) for key in ("random_state", "worlds", "memories"))
    except Exception:  # a zip, pickle or tensor error
        return f"{file.name} cannot be read"
    if rank.leads and not _equal(state, random):
        return f"{file.name} is of another checkpoint"
    if different := _first_difference(there, here):
        return different
    own = _memories(runner)
    if own.keys() != memories.keys() or any(own[key].shape != memories[key].shape for key in own):
        return "the networks' memories are of another shape"
    if name := beyond(worlds, memory(runner.env)) or beyond(memories, own):
        return f"{file.name}: {name} is not finite, or beyond {_MOST:.0e}"
    if reason := put_snapshot(runner.env, worlds):
        return reason
    with torch.inference_mode():
        for key, value in memories.items():
            own[key].copy_(value)
    if not rank.leads:
        set_random_state(state, runner.device)
    return ""


def beyond(saved: dict[str, Tensor], own: dict[str, Tensor]) -> str:
    """The first name with a number that is not finite or above ``_MOST`` in ``saved``, but not in ``own``; or ''."""
    return next((name for name, value in saved.items() if name in own and _sane(own[name]) and not _sane(value)), "")


def _equal(state: dict[str, Tensor], random: dict[str, Tensor]) -> bool:
    return state.keys() == random.keys() and all(torch.equal(state[key], random[key].cpu()) for key in state)


def _sane(value: Tensor) -> bool:
    return not value.is_floating_point() or bool((value.abs() <= _MOST).all())


def random_state(device: str) -> dict[str, Tensor]:
    """States of torch's generators of host and device."""
    state = {"cpu": torch.get_rng_state()}
    if device.startswith("cuda"):
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


def set_random_state(state: dict[str, Tensor], device: str) -> None:
    """Restore the generators that ``random_state`` saved."""
    if "cpu" in state:
        torch.set_rng_state(state["cpu"].cpu())
    if "cuda" in state and device.startswith("cuda"):
        torch.cuda.set_rng_state(state["cuda"].cpu(), device)


def _same_worlds(env: RobotTask) -> dict[str, Any]:
    """Engine, device and config that must be equal for worlds to go on exactly."""
    config = {name: section for name, section in env.cfg.to_dict().items() if name not in _FREE}
    return {"engine": env.sim.engine, "device": str(env.device).partition(":")[0], "config": config}


def _memories(runner: Any) -> dict[str, Tensor]:
    """Hidden states of the recurrent networks, by number."""
    states: dict[Any, Any] = getattr(runner.alg, "_memories", {})
    return {str(i): state.now for i, state in enumerate(states.values())}


def _first_difference(there: Any, here: Any, path: str = "") -> str:
    """``path was A and is B`` of the first value that differs; or ''."""
    if isinstance(there, dict) and isinstance(here, dict):
        for name in [*here, *(name for name in there if name not in here)]:
            inner = f"{path}.{name}" if path else str(name)
            if text := _first_difference(there.get(name), here.get(name), inner):
                return text
        return ""
    return "" if there == here else f"{path.removeprefix('config.')} was {there} and is {here}"
