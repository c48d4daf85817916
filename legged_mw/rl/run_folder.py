"""Run folders: making and finding them, their config, the lock of a training, and their checkpoints.

Files of a checkpoint are written whole, and read without running code or trusting a number in them. ``model_N.pt``
holds networks, optimizer and counters. ``worlds_N.pt`` beside the newest one holds worlds, generators and memories,
with which a resumed training goes on exactly.
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
except ImportError:  # Windows: no locks
    fcntl = None

import torch
from torch import Tensor

from legged_mw import ROOT
from legged_mw.rl.ranks import Rank
from legged_mw.utils.config import Config, ConfigError, load_yaml
from legged_mw.utils.errors import brief, shown, unknown
from legged_mw.utils.files import check_folder, check_name, find_file, typed
from legged_mw.utils.renamed import MOVED
from legged_mw.utils.task import LoadedTask

CONFIG_FILE = "config.yaml"
LOCK_FILE = ".lock"


def logs_folder() -> Path:
    """The folder of all runs of all tasks: ``logs`` in the current folder."""
    return Path.cwd() / "logs"


def experiment_folder(task: LoadedTask, name: str | None = None) -> Path:
    """The folder of a task's runs, or of the experiment ``name``. Raises UserError for a name that is not allowed."""
    return logs_folder() / check_name(
        name or task.train.runner.experiment_name or task.name, "the name of the experiment"
    )


def new_run(experiment: Path, run_name: str) -> Path:
    """Make and return a run folder below ``experiment``, named by the time."""
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
    """Readable run folders with a checkpoint, oldest first by the time of their newest checkpoint."""
    found: dict[Path, int] = {}
    for folder in experiment.glob("*"):
        # a link to itself, a folder of another user, a checkpoint that is pruned at this moment
        with contextlib.suppress(OSError):
            if there := checkpoints(folder):
                found[folder] = max(path.stat().st_mtime_ns for path in there.values())
    return sorted(found, key=lambda folder: found[folder])


def checkpoints(run: Path) -> dict[int, Path]:
    """Iteration -> checkpoint of a run, in rising order."""
    named = {path: re.fullmatch(r"model_(\d{1,18})\.pt", path.name) for path in run.glob("model_*.pt")}
    return dict(sorted((int(match[1]), path) for path, match in named.items() if match and path.is_file()))


def find_run(experiment: Path, name: str) -> Path:
    """The run called ``name`` below ``experiment``, or at the path ``name``, or for "-1" the run last trained."""
    found, given = runs(experiment), typed(name)
    if name == "-1":
        if not found:
            raise ConfigError(
                f"no run with a checkpoint in {experiment}; train first, or name another --experiment_name"
            )
        return check_folder(found[-1])
    for folder in (experiment / name, given):
        if folder.is_dir() and checkpoints(folder):
            return check_folder(folder)
    raise ConfigError(unknown("run with a checkpoint", name, [folder.name for folder in found], str(experiment)))


def find_checkpoint(run: Path, iteration: int) -> Path:
    """The checkpoint of ``run`` after ``iteration`` iterations, or for -1 the newest."""
    found = checkpoints(run)
    if not found:
        raise ConfigError(f"no checkpoint model_<iteration>.pt in {run}")
    if iteration == -1:
        return list(found.values())[-1]
    if iteration not in found:
        raise ConfigError(f"no checkpoint {iteration} in {run}; there are: {', '.join(map(str, found))}")
    return found[iteration]


def task_of(run: Path, named: LoadedTask | None = None) -> str:
    """The ``--task`` of a run: a task of the project, or a file that the task ``named`` is or extends.

    No other file: a file is code, and the run may be a stranger's. Raises ConfigError that says what to type.
    """
    stored = load_yaml(run / CONFIG_FILE).get("task", "")
    if not isinstance(stored, str) or not stored:
        raise ConfigError(f"{shown(run / CONFIG_FILE)} does not say of which task it is; say --task")
    if found := of_project(stored) or (named and named.file_called(Path(stored).name)):
        return str(found)
    extending = ", or a task that extends its config" if named else ""
    raise ConfigError(f"{shown(run)} is of task {stored[:200]!r}, {somebodys(stored)}{extending}")


def task_at(path: str) -> str:
    """``task_of`` the run at the path that the user typed, or '' if there is no run."""
    run = typed(path)
    return task_of(check_folder(run)) if (run / CONFIG_FILE).is_file() else ""


class RunLock:
    """The lock of the process that trains in a folder. The system releases it however the process ends."""

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
        """Write the owner into the lock, and delete half-written files of a killed process."""
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
        """Whether somebody has deleted the folder and the lock in it."""
        return os.fstat(self._file.fileno()).st_nlink == 0


class CheckpointWriter:
    """Writes checkpoints and prunes old ones. If one cannot be written, it warns and the training goes on."""

    def __init__(self, folder: Path, keep: int, rank: Rank, prepare: Callable[[], bool] = lambda: False) -> None:
        """``keep``: number of newest checkpoints that stay, 0: all. ``prepare``: make a lost folder, return whether."""
        self.folder, self._keep, self._rank, self._prepare = folder, keep, rank, prepare
        self.failed = ""  # why the newest checkpoint could not be written, or ''
        self.written: Path | None = None  # the newest one that was written
        self.moved = False  # the folder was made again

    def write(
        self, iteration: int, checkpoint: Callable[[], dict[str, Any]], worlds: Callable[[], dict[str, Any]]
    ) -> bool:
        """Write worlds, then the checkpoint, then prune; returns whether the checkpoint is written."""
        path = self.folder / f"model_{iteration}.pt"
        try:
            self.moved = self._prepare()
            self._write_worlds(worlds, worlds_file(path, self._rank), path)
            if self._rank.leads:
                save_whole(checkpoint(), path)
        except (OSError, MemoryError) as error:  # the file is composed in memory
            self.failed = reason_of(error)
            newest = f"the newest is {shown(self.written)}" if self.written else "none of this training is written"
            print(
                f"WARNING: checkpoint {path.name} cannot be written: {self.failed}; {newest}; going on in memory",
                flush=True,
            )
            if not path.exists():
                with contextlib.suppress(OSError):
                    worlds_file(path, self._rank).unlink(missing_ok=True)  # useless, and the disk is full
            return False
        self.failed, self.written = "", path
        with contextlib.suppress(OSError):
            self._prune()
        return True

    def _write_worlds(self, worlds: Callable[[], dict[str, Any]], file: Path, checkpoint: Path) -> None:
        """Write the worlds if there is room: they are many times as large as the checkpoint, which may fit without."""
        try:
            save_whole(worlds(), file, sync=False)  # its reader detects a file torn by a power cut
        except (OSError, MemoryError) as error:
            print(
                f"WARNING: {file.name} cannot be written: {reason_of(error)}; from {checkpoint.name} worlds begin anew",
                flush=True,
            )

    def _prune(self) -> None:
        """Delete worlds of checkpoints before the newest, and the oldest checkpoints.

        A rank that comes here before the first one has written the newest checkpoint leaves the worlds of the one
        before. The first rank also deletes worlds of an earlier training with another number of processes.
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
    """Why a file could not be written: the system's reason, if a library's error hides one."""
    first: BaseException | None = error
    while first is not None and not isinstance(first, OSError):
        first = first.__cause__ or first.__context__
    if isinstance(first, OSError) and first.strerror:
        return first.strerror
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__


def sweep(folder: Path) -> None:
    """Remove what killed programs left half written in ``folder``: ``.NAME.PID.tmp`` of a process that is gone."""
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
    except OSError:  # it is another user's
        return True
    return True


def worlds_file(checkpoint: Path, rank: Rank) -> Path:
    """The file of the worlds of ``rank`` beside ``checkpoint``."""
    return checkpoint.with_name(f"worlds_{checkpoint.stem.removeprefix('model_')}{suffix_of(rank)}.pt")


def suffix_of(rank: Rank) -> str:
    """The part of a file's name that is the rank's own; '' for a single process."""
    return f"_{rank.index}of{rank.count}" if rank.count > 1 else ""


# ---- config.yaml, old names included ----------------------------------------------------------------------------------

# A field of runs of 0.1 -> the keys that lead to its value now.
RENAMED: dict[str, tuple[str, ...]] = {
    "perturbation.enable": ("perturbation", "kick"),
    "cpu.keep_probability": ("cpu", "overrides", "commands.keep_probability"),
    "cpu.kick_curriculum": ("cpu", "overrides", "perturbation.curriculum"),
}


def of_project(stored: str) -> str:
    """``--task`` for the task that a run's config names; "" if it is not this project's: no run may start such a file.

    This project's are the names in configs/, and files that really lie in configs/ or examples/ of package or clone.
    """
    if Path(stored).suffix != ".py":
        return stored  # a name; there is none outside of configs/
    folders = [(ROOT / name).resolve() for name in ("configs", "examples")]
    with contextlib.suppress(OSError, ValueError, RuntimeError):  # a name that no file can have, a link to itself
        for file in ((place / stored).resolve() for place in (Path.cwd(), ROOT)):
            if file.is_file() and file.parent in folders:
                return str(file)
    return ""


def somebodys(stored: str) -> str:
    """What a task's file is that is not ``of_project``, and the flag that runs it."""
    return f"somebody's code, which no run starts by itself: read it, then say --task {shlex.quote(stored[:200])}"


def update_from_run(task: LoadedTask, saved: Mapping[str, Any], where: str) -> list[str]:
    """Give ``task`` the fields in the ``config.yaml`` of one of its runs, which may use old names.

    A learner's section that the file lacks is newer than the run. It takes the base class's values, as the run did, not
    those of today's task. Returns the names of these sections.
    """
    saved = _with_new_names(saved)
    theirs = str(saved.get("task", task.name))
    if Path(theirs).stem != task.name:
        what = f"say --task {theirs}" if of_project(theirs) else f"that is {somebodys(theirs)}"
        raise ConfigError(f"{where} is of task {theirs[:200]!r}, not '{task.name}'; {what}")
    asset = saved.get("asset")
    if isinstance(asset, dict) and _is_own_file(task, Path(str(asset.get("file", "")))):
        asset["file"] = task.cfg.asset.file
    parents = [kind for kind in type(task.train).__mro__ if issubclass(kind, Config) and kind is not Config]
    defaults = parents[-1]().to_dict()
    newer = {name: value for name, value in defaults.items() if name not in saved and isinstance(value, dict)}
    task.update({**saved, **newer}, where)
    return list(newer)


def _with_new_names(saved: Mapping[str, Any]) -> dict[str, Any]:
    """A copy in which every old name of a field, or of a class's module, is replaced by the new one."""
    config: dict[str, Any] = copy.deepcopy(dict(saved))
    for old, (*sections, name) in RENAMED.items():
        section, _, field = old.partition(".")
        if not isinstance(config.get(section), dict) or field not in config[section]:
            continue
        value, node = config[section].pop(field), config
        for key in sections:
            node = node.setdefault(key, {}) if isinstance(node, dict) else None
        if isinstance(node, dict):  # else the file is wrong there, and loading it says so
            node[name] = value
    for section in config.values():
        name = section.get("class_name") if isinstance(section, dict) else None
        for old, new in MOVED.items():
            if isinstance(name, str) and name.startswith((f"{old}:", f"{old}.")):
                section["class_name"] = new + name[len(old) :]
    return config


def _is_own_file(task: LoadedTask, file: Path) -> bool:
    """Whether an absolute path is the task's own robot: runs once stored the path of their machine."""
    if not file.is_absolute() or file.name != Path(task.cfg.asset.file).name:
        return False
    return not file.exists() or file.samefile(find_file(task.cfg, "asset.file"))


# ---- the files of a checkpoint --------------------------------------------------------------------------------------


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


@contextlib.contextmanager
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
