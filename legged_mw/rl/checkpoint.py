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
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

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
    """Read a checkpoint, whose networks and counters are finite; runs no code from it. Raises ConfigError."""
    try:
        content = unpack(path.read_bytes(), device)
    except FileNotFoundError:
        raise ConfigError(f"no checkpoint at {path}") from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ConfigError(f"{path} cannot be read as a checkpoint: {error}; {EARLIER}") from None
    if not isinstance(content, dict) or not {"actor_state_dict", "student_state_dict"} & content.keys():
        raise ConfigError(f"{path} is not a checkpoint of this project: it has no actor_state_dict")
    for name in ("actor_state_dict", "student_state_dict", "critic_state_dict", "teacher_state_dict"):
        with _part(path, name):
            _check_values(content.get(name, {}), path, name)
    with _part(path, "iter or infos"):
        infos = {} if content.get("infos") is None else content["infos"]
        for count in (content.get("iter", 0), infos.get("total_steps", 0)):
            if type(count) is not int or count < 0:
                raise ValueError(f"{brief(count, 60)} is no whole number from 0")
        _check_number(infos.get("seconds", 0.0))
        state = {name: value.cpu() for name, value in infos.get("random_state", {}).items()}
        torch.Generator().set_state(state.get("cpu", torch.get_rng_state()))
    return content


def unpack(written: bytes, device: str) -> Any:
    """The content of a file; runs no code from it. Raises ValueError that says why the file is corrupt."""
    if why := damage(written):
        raise ValueError(why)
    try:
        return torch.load(io.BytesIO(written), map_location=device, weights_only=True)
    except Exception:  # a zip, pickle or tensor error; torch's own text advises to load the file unsafely
        raise ValueError("it is damaged, or holds more than tensors and numbers") from None


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


# ---- what a checkpoint must be like ---------------------------------------------------------------------------------

# Tensors that are never below 0, by the last part of a name: of normalisers, of Adam, of a task.
_FROM_ZERO = {"_var", "_std", "count", "step", "exp_avg_sq", "square_avg", "num_envs", "motion_failures"}
_FROM_ZERO |= {"kick_level", "pull_level", "terrain_levels", "command_curriculum"}


def check_fit(saved: Mapping[str, Tensor], own: Mapping[str, Tensor], path: Path, what: str) -> None:
    """Raise ConfigError unless ``saved`` in ``path`` has the names, shapes and types of ``own``, and finite values."""
    for name in sorted({**own, **saved}, key=lambda name: name in own and name in saved):  # a missing one says most
        there, here = _shape(saved.get(name)), _shape(own.get(name))
        if there != here:
            raise ConfigError(f"{path} does not fit this task: {what} {name} is {there} there and {here} here")
    _check_values(saved, path, what)


def check_resume(
    content: Mapping[str, Any], path: Path, own: Mapping[str, Any], optimizer: torch.optim.Optimizer
) -> None:
    """Raise ConfigError unless a run, which would now write ``own``, can go on from ``content``."""
    done, named = content["iter"], re.fullmatch(r"model_(\d+)\.pt", path.name)
    if named and int(named[1]) != done:
        raise ConfigError(
            f"{path}: its name says {int(named[1])} iterations, and it has done {done}: call it model_{done}.pt"
        )
    adam = "betas" in optimizer.defaults
    parameters = dict(enumerate(each for group in optimizer.param_groups for each in group["params"]))
    with _part(path, "optimizer_state_dict"):
        saved = {**content["optimizer_state_dict"]}
        for group, mine in zip(saved["param_groups"], own["optimizer_state_dict"]["param_groups"], strict=True):
            # a newer torch may have more switches
            switches = {name: value for name, value in mine.items() if value is None or isinstance(value, bool)}
            theirs = {**switches, **group}
            _check_number(theirs["lr"])
            same = repr({name: theirs[name] for name in mine} | {"lr": mine["lr"]}) == repr(mine)
            if not same or not theirs["lr"]:
                raise ValueError("other parameters or settings")
        if adam and done and not saved["state"]:
            raise ValueError(f"no state after {done} iterations")
        moments, wanted = dict[str, Tensor](), dict[str, Tensor]()
        for i, held in saved["state"].items():
            moments |= {f"{i}.{name}": value for name, value in held.items()}
            for name in ("step", "exp_avg", "exp_avg_sq") if adam else held:
                wanted[f"{i}.{name}"] = torch.zeros(()) if name == "step" else parameters[i]
        check_fit(moments, wanted, path, "optimizer_state_dict")
    with _part(path, "infos.env"):
        levels = {**(content.get("infos") or {}).get("env", {})}
        wanted = {name: _resized(value, levels[name]) for name, value in own["infos"]["env"].items() if name in levels}
        check_fit({name: levels[name] for name in wanted}, wanted, path, "infos.env")


@contextmanager
def _part(path: Path, name: str) -> Iterator[None]:
    """Any error in the body means that the part ``name`` of the file is none of this version."""
    try:
        yield
    except ConfigError:
        raise
    except Exception as error:
        reason = " ".join(f"{error}".split())[:100]
        raise ConfigError(f"{path} is of another version: its {name} is not as here ({reason}); {EARLIER}") from None


def _check_number(value: Any) -> None:
    if type(value) not in (int, float) or not 0.0 <= float(value) < math.inf:
        raise ValueError(f"{brief(value, 60)} is no number from 0")


def _check_values(saved: Mapping[str, Tensor], path: Path, what: str) -> None:
    """Raise ConfigError unless all are plain tensors of finite numbers, and from 0 where nothing else can be."""
    for name, value in saved.items():
        if value.layout != torch.strided or value.is_meta or value.is_quantized or value.is_complex():
            raise ValueError(f"{name} is no plain tensor")
        if value.numel() * value.element_size() > value.untyped_storage().nbytes():
            raise ValueError(f"{name} shows {value.numel()} numbers and has fewer")
        if not bool(value.isfinite().all()):
            raise ConfigError(f"{path}: {what} {name} has values that are not finite; {EARLIER}")
        if name.rpartition(".")[2] in _FROM_ZERO and bool((value < 0).any()):
            raise ConfigError(f"{path}: {what} {name} has values below 0; {EARLIER}")


def _shape(value: Any) -> str:
    """What must be equal in a file and here."""
    if not isinstance(value, Tensor):
        return "missing" if value is None else f"a {type(value).__name__}"
    return f"{tuple(value.shape)} {value.dtype}".removesuffix(" torch.float32").replace("torch.", "")


def _resized(own: Tensor, saved: Tensor) -> Tensor:
    """``own`` for as many worlds as ``saved`` has."""
    if not own.dim() or saved.dim() != own.dim() or not len(saved):
        return own
    return own[:1].expand(len(saved), *own.shape[1:])
