"""Run folders: creation, search, config, the lock of a training, and checkpoints.

Checkpoint files are written atomically. Reading one runs no code from it and checks its numbers. ``model_N.pt`` holds
networks, optimizer and counters. ``worlds_N.pt``, of the newest checkpoint only, holds worlds, random states and hidden
states, so that a resumed training is exact.
"""

from __future__ import annotations

import contextlib
import copy
import hashlib
import io
import math
import os
import re
import shlex
import shutil
import struct
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Self

try:
    import fcntl
except ImportError:  # Windows has no fcntl, so there are no locks
    fcntl = None

import torch
from torch import Tensor

from legged_mw import ROOT
from legged_mw.rl.ranks import Rank
from legged_mw.utils.config import Config, ConfigError, load_yaml
from legged_mw.utils.errors import MOVED, brief, shown, unknown
from legged_mw.utils.files import check_folder, check_name, find_file, typed
from legged_mw.utils.task import LoadedTask

CONFIG_FILE = "config.yaml"
LOCK_FILE = ".lock"


def logs_folder() -> Path:
    """The folder of all runs of all tasks: ``logs`` in the current folder."""
    return Path.cwd() / "logs"


def experiment_folder(task: LoadedTask, name: str | None = None) -> Path:
    """The folder of a task's runs, or of the experiment ``name``. Raises UserError for an invalid name."""
    return logs_folder() / check_name(
        name or task.train.runner.experiment_name or task.name, "the name of the experiment"
    )


def new_run(experiment: Path, run_name: str) -> Path:
    """Make a run folder in ``experiment``, named by the time, and return it."""
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S") + (f"_{run_name}" if run_name else "")
    for suffix in ["", *(f"_{i}" for i in range(2, 1000))]:
        folder = experiment / (stamp + suffix)
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            continue
    raise ConfigError(f"cannot make a run folder {experiment / stamp}: a thousand of that name exist")


def runs(experiment: Path) -> list[Path]:
    """Readable run folders with a checkpoint, sorted by the time of their newest checkpoint, oldest first."""
    newest: dict[Path, int] = {}
    for folder in experiment.glob("*"):
        # a link to itself, a folder of another user, a checkpoint that another process deletes now
        with contextlib.suppress(OSError):
            if saved := checkpoints(folder):
                newest[folder] = max(path.stat().st_mtime_ns for path in saved.values())
    return sorted(newest, key=lambda folder: newest[folder])


def checkpoints(run: Path) -> dict[int, Path]:
    """Iteration -> checkpoint of a run, sorted by iteration."""
    named = {path: re.fullmatch(r"model_(\d{1,18})\.pt", path.name) for path in run.glob("model_*.pt")}
    return dict(sorted((int(match[1]), path) for path, match in named.items() if match and path.is_file()))


def find_run(experiment: Path, name: str) -> Path:
    """The run ``name`` in ``experiment`` or at the path ``name``; for "-1" the latest run. Raises ConfigError."""
    existing, given = runs(experiment), typed(name)
    if name == "-1":
        if not existing:
            raise ConfigError(
                f"no run with a checkpoint in {experiment}; train first, or name another --experiment_name"
            )
        return check_folder(existing[-1])
    for folder in (experiment / name, given):
        if folder.is_dir() and checkpoints(folder):
            return check_folder(folder)
    raise ConfigError(unknown("run with a checkpoint", name, [folder.name for folder in existing], str(experiment)))


def find_checkpoint(run: Path, iteration: int) -> Path:
    """The checkpoint of ``run`` after ``iteration`` iterations; for -1 the newest. Raises ConfigError."""
    existing = checkpoints(run)
    if not existing:
        raise ConfigError(f"no checkpoint model_<iteration>.pt in {run}")
    if iteration == -1:
        return list(existing.values())[-1]
    if iteration not in existing:
        raise ConfigError(f"no checkpoint {iteration} in {run}; there are: {', '.join(map(str, existing))}")
    return existing[iteration]


def task_of(run: Path, named: LoadedTask | None = None) -> str:
    """The ``--task`` of a run: a task of the project, or the file of the task ``named`` or of one that it extends.

    Any other file raises ConfigError: a file is code, and the run may come from a stranger.
    """
    stored = load_yaml(run / CONFIG_FILE).get("task", "")
    if not isinstance(stored, str) or not stored:
        raise ConfigError(f"{shown(run / CONFIG_FILE)} does not say of which task it is; say --task")
    if name := of_project(stored) or (named and named.file_called(Path(stored).name)):
        return str(name)
    extending = ", or a task that extends its config" if named else ""
    raise ConfigError(f"{shown(run)} is of task {stored[:200]!r}, {somebodys(stored)}{extending}")


def task_at(path: str) -> str:
    """``task_of`` for the run at a path that the user typed, or '' if there is no run."""
    run = typed(path)
    return task_of(check_folder(run)) if (run / CONFIG_FILE).is_file() else ""


class RunLock:
    """The lock of the process that trains in a folder. The system releases it when the process ends in any way."""

    def __init__(self, folder: Path) -> None:
        """Raises ConfigError if another process has the lock, OSError if the folder cannot be written."""
        self._folder, self._file = folder, open(folder / LOCK_FILE, "a+")  # noqa: SIM115 (open until it is released)
        try:
            if fcntl:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.seek(0)
            owner = self._file.read().strip() or "another process"
            self._file.close()
            raise ConfigError(
                f"{shown(folder)} is being trained by {owner}; wait for its end, stop it, or name another run"
            ) from None
        except OSError as error:  # a file system without locks
            print(
                f"WARNING: {shown(folder)} cannot be locked ({error.strerror}): do not resume it while it trains",
                flush=True,
            )

    def begin(self) -> None:
        """Write the owner into the lock, and delete incomplete files of killed processes."""
        self._file.truncate(0)
        self._file.write(f"process {os.getpid()} since {time.strftime('%Y-%m-%d %H:%M:%S')}\n")
        self._file.flush()
        sweep(self._folder)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.release()

    def release(self) -> None:
        self._file.close()

    def lost(self) -> bool:
        """Whether the lock file was deleted, with its folder."""
        return os.fstat(self._file.fileno()).st_nlink == 0


class CheckpointWriter:
    """Writes checkpoints and deletes old ones. If one cannot be written, it warns and the training continues."""

    def __init__(self, folder: Path, keep: int, rank: Rank, prepare: Callable[[], bool] = lambda: False) -> None:
        """``keep``: number of checkpoints to keep, 0: all. ``prepare``: restore a deleted folder, return whether."""
        self.folder, self._keep, self._rank, self._prepare = folder, keep, rank, prepare
        self.failed = ""  # why the last checkpoint could not be written, or ''
        self.written: Path | None = None  # the newest written checkpoint
        self.moved = False  # the last ``prepare`` made the folder again

    def write(
        self, iteration: int, checkpoint: Callable[[], dict[str, Any]], worlds: Callable[[], dict[str, Any]]
    ) -> bool:
        """Write worlds and checkpoint, then delete old files. Returns whether the checkpoint is written."""
        path = self.folder / f"model_{iteration}.pt"
        try:
            self.moved = self._prepare()
            self._write_worlds(worlds, worlds_file(path, self._rank), path)
            if self._rank.leads:
                save_whole(checkpoint(), path)
        except (OSError, MemoryError) as error:  # the file is first made in memory
            self.failed = reason_of(error)
            newest = f"the newest is {shown(self.written)}" if self.written else "none of this training is written"
            print(
                f"WARNING: checkpoint {path.name} cannot be written: {self.failed}; {newest}; going on in memory",
                flush=True,
            )
            if not path.exists():
                with contextlib.suppress(OSError):
                    worlds_file(path, self._rank).unlink(missing_ok=True)  # useless without its checkpoint
            return False
        self.failed, self.written = "", path
        with contextlib.suppress(OSError):
            self._prune()
        return True

    def _write_worlds(self, worlds: Callable[[], dict[str, Any]], file: Path, checkpoint: Path) -> None:
        """Write the worlds, or warn: they are many times larger than the checkpoint, which may still fit the disk."""
        try:
            save_whole(worlds(), file, sync=False)  # the reader detects a file damaged by a power cut
        except (OSError, MemoryError) as error:
            print(
                f"WARNING: {file.name} cannot be written: {reason_of(error)}; from {checkpoint.name} worlds begin anew",
                flush=True,
            )

    def _prune(self) -> None:
        """Delete the worlds of all checkpoints but the newest, and the oldest checkpoints.

        If the first rank has not yet written the newest checkpoint, the other ranks keep the worlds of the previous
        one. The first rank also deletes worlds of an earlier training with another number of processes.
        """
        there = checkpoints(self.folder)
        newest, rank = max(there, default=0), self._rank
        for old in self.folder.glob("worlds_*.pt"):
            named = re.fullmatch(r"worlds_(\d+)((?:_\d+of(\d+))?)\.pt", old.name)
            mine = named and (named[2] == suffix_of(rank) or (rank.leads and int(named[3] or 1) != rank.count))
            if named and mine and int(named[1]) < newest:
                old.unlink(missing_ok=True)
        if self._keep and self._rank.leads:
            for old in list(there.values())[: -self._keep]:
                old.unlink(missing_ok=True)


def reason_of(error: BaseException) -> str:
    """Why a file could not be written: the system's reason if the error has one as its cause."""
    first: BaseException | None = error
    while first is not None and not isinstance(first, OSError):
        first = first.__cause__ or first.__context__
    if isinstance(first, OSError) and first.strerror:
        return first.strerror
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__


def sweep(folder: Path) -> None:
    """Delete incomplete files of killed programs in ``folder``: ``.NAME.PID.tmp`` whose process has ended."""
    for path in folder.glob(".*.tmp"):
        name = re.fullmatch(r"\.(export|.+\.(?:pt|yaml))\.(\d{1,9})\.tmp", path.name)
        if not name or _lives(int(name[2])):
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # the process belongs to another user
        return True
    return True


def worlds_file(checkpoint: Path, rank: Rank) -> Path:
    """The file with the worlds of ``rank`` for ``checkpoint``."""
    return checkpoint.with_name(f"worlds_{checkpoint.stem.removeprefix('model_')}{suffix_of(rank)}.pt")


def suffix_of(rank: Rank) -> str:
    """The part of a file name that identifies the rank; '' for a single process."""
    return f"_{rank.index}of{rank.count}" if rank.count > 1 else ""


# ---- config.yaml, old names included ----------------------------------------------------------------------------------

# Field in runs of version 0.1 -> keys of its new place.
RENAMED: dict[str, tuple[str, ...]] = {
    "perturbation.enable": ("perturbation", "kick"),
    "cpu.keep_probability": ("cpu", "overrides", "commands.keep_probability"),
    "cpu.kick_curriculum": ("cpu", "overrides", "perturbation.curriculum"),
}


def of_project(stored: str) -> str:
    """``--task`` for the task in a run's config; "" if the task is not of this project: a run must not start its file.

    Tasks of this project are names in configs/, and files in configs/ or examples/ of the package or the clone.
    """
    if Path(stored).suffix != ".py":
        return stored  # a name: names exist only in configs/
    folders = [(ROOT / name).resolve() for name in ("configs", "examples")]
    with contextlib.suppress(OSError, ValueError, RuntimeError):  # an invalid file name, a link to itself
        for file in ((place / stored).resolve() for place in (Path.cwd(), ROOT)):
            if file.is_file() and file.parent in folders:
                return str(file)
    return ""


def somebodys(stored: str) -> str:
    """Message text on a task's file that is not ``of_project``, with the flag that runs it."""
    name, found = shlex.quote(stored[:200]), False
    with contextlib.suppress(OSError, ValueError):
        found = Path(stored).is_file()
    folder = "" if found or "/" in stored else ", with its folder before the name"  # a config has none
    return f"somebody's code, which no run starts by itself: read it, then say --task {name}{folder}"


def update_from_run(task: LoadedTask, saved: Mapping[str, Any], where: str) -> list[str]:
    """Set the fields of ``task`` to the ``config.yaml`` of one of its runs, which may use old names.

    If the file lacks a learner's section, the run is older than the section. The section then gets the values of the
    base class, as the run had them, not those of the task. Returns the names of these sections.
    A reward that the file lacks is newer than the run, too, and stays off; a field of ``gait`` or ``observations`` gets
    the value of the base class, because the policy reads what these say.
    """
    saved = _with_new_names(saved)
    run_task = str(saved.get("task", task.name))
    if Path(run_task).stem != task.name:
        what = f"say --task {run_task}" if of_project(run_task) else f"that is {somebodys(run_task)}"
        raise ConfigError(f"{where} is of task {run_task[:200]!r}, not '{task.name}'; {what}")
    asset = saved.get("asset")
    if isinstance(asset, dict) and _is_own_file(task, Path(str(asset.get("file", "")))):
        asset["file"] = task.cfg.asset.file
    parents = [kind for kind in type(task.train).__mro__ if issubclass(kind, Config) and kind is not Config]
    defaults = parents[-1]().to_dict()
    newer = {name: value for name, value in defaults.items() if name not in saved and isinstance(value, dict)}
    if isinstance(rewards := saved.get("rewards"), dict) and isinstance(scales := rewards.get("scales"), dict):
        rewards["scales"] = dict.fromkeys(task.to_dict()["rewards"]["scales"], 0.0) | scales
    for name in ("gait", "observations"):
        if (base := _of_base(task, name)) and isinstance(given := saved.get(name, {}), dict):
            saved[name] = {**base, **given}
    task.update({**saved, **newer}, where)
    return list(newer)


def _of_base(task: LoadedTask, section: str) -> dict[str, Any]:
    """A section of the task's config as the class that declares it has it; empty if there is none."""
    kinds = [kind for kind in type(task.cfg).__mro__ if issubclass(kind, Config) and hasattr(kind, section)]
    return kinds[-1]().to_dict()[section] if kinds else {}


def _with_new_names(saved: Mapping[str, Any]) -> dict[str, Any]:
    """A copy with the new names of renamed fields and of renamed modules of classes."""
    config: dict[str, Any] = copy.deepcopy(dict(saved))
    for old, (*sections, name) in RENAMED.items():
        section, _, field = old.partition(".")
        if not isinstance(config.get(section), dict) or field not in config[section]:
            continue
        value, node = config[section].pop(field), config
        for key in sections:
            node = node.setdefault(key, {}) if isinstance(node, dict) else None
        if isinstance(node, dict):  # otherwise the file is invalid, and loading it raises
            node[name] = value
    for section in config.values():
        name = section.get("class_name") if isinstance(section, dict) else None
        for old, new in MOVED.items():
            if isinstance(name, str) and name.startswith((f"{old}:", f"{old}.")):
                section["class_name"] = new + name[len(old) :]
    return config


def _is_own_file(task: LoadedTask, file: Path) -> bool:
    """Whether an absolute path is the task's robot file: old runs stored the path on their machine."""
    if not file.is_absolute() or file.name != Path(task.cfg.asset.file).name:
        return False
    return not file.exists() or file.samefile(find_file(task.cfg, "asset.file"))


# ---- the files of a checkpoint --------------------------------------------------------------------------------------


_SEAL = b"sha256:"
EARLIER = "an earlier one is named by --checkpoint"


def save_whole(content: dict[str, Any], path: Path, sync: bool = True) -> None:
    """Write a checkpoint with its checksum, atomically if the process is killed; with ``sync`` also at a power cut."""
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
    """Read a checkpoint without running code from it, and check its networks and counters. Raises ConfigError."""
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
    """The content of a file, without running code from it. Raises ValueError with the reason if it is corrupt."""
    if why := damage(written):
        raise ValueError(why)
    try:
        return torch.load(io.BytesIO(written), map_location=device, weights_only=True)
    except Exception:  # a zip, pickle or tensor error; torch's message advises unsafe loading
        raise ValueError("it is damaged, or holds more than tensors and numbers") from None


def sealed(archive: bytes) -> bytes:
    """torch's zip ``archive`` with its SHA-256 as the zip comment, which torch ignores."""
    head = archive[:-2]  # without the length of the empty comment
    note = _SEAL + hashlib.sha256(head).hexdigest().encode()
    return head + struct.pack("<H", len(note)) + note


def damage(content: bytes) -> str:
    """Why the file is corrupt, or ''. ``sealed`` files are checked by SHA-256, older ones by the zip's CRCs."""
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
    except Exception as error:  # zipfile raises many types
        return f"it is damaged: {error}"


# ---- checks of a checkpoint -----------------------------------------------------------------------------------------

# Tensors that are never negative, by the last part of their name: of normalisers, Adam and tasks.
_FROM_ZERO = {"_var", "_std", "count", "step", "exp_avg_sq", "square_avg", "num_envs", "motion_failures"}
_FROM_ZERO |= {"kick_level", "pull_level", "terrain_levels", "command_curriculum"}


def check_fit(saved: Mapping[str, Tensor], own: Mapping[str, Tensor], path: Path, what: str) -> None:
    """Raise ConfigError unless ``saved`` in ``path`` has the names, shapes and types of ``own``, and finite values."""
    for name in sorted({**own, **saved}, key=lambda name: name in own and name in saved):  # missing names first
        there, here = _shape(saved.get(name)), _shape(own.get(name))
        if there != here:
            raise ConfigError(f"{path} does not fit this task: {what} {name} is {there} there and {here} here")
    _check_values(saved, path, what)


def check_resume(
    content: Mapping[str, Any], path: Path, own: Mapping[str, Any], optimizer: torch.optim.Optimizer
) -> None:
    """Raise ConfigError unless a run can resume from ``content``. ``own``: the checkpoint that it would write now."""
    done, named = content["iter"], re.fullmatch(r"model_(\d+)\.pt", path.name)
    if named and int(named[1]) != done:
        raise ConfigError(
            f"{path}: its name says {int(named[1])} iterations, and it has done {done}: call it model_{done}.pt"
        )
    adam = "betas" in optimizer.defaults
    parameters = dict(enumerate(each for group in optimizer.param_groups for each in group["params"]))
    with _part(path, "optimizer_state_dict"):
        saved = {**content["optimizer_state_dict"]}
        for group, own_group in zip(saved["param_groups"], own["optimizer_state_dict"]["param_groups"], strict=True):
            # a newer torch may have more options
            switches = {name: value for name, value in own_group.items() if value is None or isinstance(value, bool)}
            settings = {**switches, **group}
            _check_number(settings["lr"])
            same = repr({name: settings[name] for name in own_group} | {"lr": own_group["lr"]}) == repr(own_group)
            if not same or not settings["lr"]:
                raise ValueError("other parameters or settings")
        if adam and done and not saved["state"]:
            raise ValueError(f"no state after {done} iterations")
        moments, expected = dict[str, Tensor](), dict[str, Tensor]()
        for i, held in saved["state"].items():
            moments |= {f"{i}.{name}": value for name, value in held.items()}
            for name in ("step", "exp_avg", "exp_avg_sq") if adam else held:
                expected[f"{i}.{name}"] = torch.zeros(()) if name == "step" else parameters[i]
        check_fit(moments, expected, path, "optimizer_state_dict")
    with _part(path, "infos.env"):
        levels = {**(content.get("infos") or {}).get("env", {})}
        expected = {
            name: _resized(value, levels[name]) for name, value in own["infos"]["env"].items() if name in levels
        }
        check_fit({name: levels[name] for name in expected}, expected, path, "infos.env")


@contextlib.contextmanager
def _part(path: Path, name: str) -> Iterator[None]:
    """Raise any error of the body as a ConfigError: the part ``name`` of the file is of another version."""
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
    """Raise unless all values are plain tensors of finite numbers, and those of ``_FROM_ZERO`` not negative."""
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
    """Shape and dtype as text: they must be equal in a file and here."""
    if not isinstance(value, Tensor):
        return "missing" if value is None else f"a {type(value).__name__}"
    return f"{tuple(value.shape)} {value.dtype}".removesuffix(" torch.float32").replace("torch.", "")


def _resized(own: Tensor, saved: Tensor) -> Tensor:
    """``own`` resized to the number of worlds in ``saved``."""
    if not own.dim() or saved.dim() != own.dim() or not len(saved):
        return own
    return own[:1].expand(len(saved), *own.shape[1:])
