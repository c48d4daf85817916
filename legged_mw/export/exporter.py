"""Export a trained policy as network, contract and scene, after a comparison with the training environment.

``legged_mw.deploy.contract`` defines the files. Running an export does not need this module.
"""

from __future__ import annotations

import copy
import dataclasses
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from rsl_rl.models import MLPModel, RNNModel

from legged_mw.deploy.contract import (
    CONTRACT_FILE,
    MOTION_FILE,
    MOTORS_FILE,
    NETWORK_FILE,
    SCENE_FILE,
    TERRAIN_FILE,
    NetworkMemory,
    read_contract,
)
from legged_mw.envs.robot_task import RobotTask
from legged_mw.export.contract import make_contract, write_terrain
from legged_mw.export.network import ExportedPolicy, halve, round_weights, run_onnx, save_onnx
from legged_mw.export.replay import ExportError, record, replay
from legged_mw.rl.policies import ESTIMATE, MEMORY_INPUT, MEMORY_OUTPUT, load_policy
from legged_mw.rl.run_folder import CONFIG_FILE, sweep
from legged_mw.rl.students.estimator import EstimatingModel
from legged_mw.rl.students.recurrent import states_of
from legged_mw.utils.config import save_yaml
from legged_mw.utils.errors import shown
from legged_mw.utils.files import STAGED, digest, finish_moving
from legged_mw.utils.task import LoadedTask

FILES = (CONFIG_FILE, NETWORK_FILE, SCENE_FILE, CONTRACT_FILE)  # the contract last, because it names the other files
SOMETIMES = (TERRAIN_FILE, MOTORS_FILE, MOTION_FILE)
ONCE = ("terrain.xml",)  # files of older exports
WORLDS = 8  # number of worlds in the comparison
NETWORK_TOLERANCE = 1e-4  # of actions, relative if above 1; float32 sums depend on their order


class Exported(NamedTuple):
    """The result of an export."""

    files: tuple[str, ...]
    gap: float  # largest difference between exported and trained actions
    observations: int  # number of compared observations
    # observation rows without known sensors; such an export cannot be deployed
    unknown: tuple[str, ...]
    no_terrain: str = ""  # why there is no scene with steps, or ''
    not_covered: tuple[str, ...] = ()  # methods of the task that ended episodes in training and do not end a walk
    half: bool = False  # the weights are rounded to float16

    def text(self, folder: Path) -> str:
        """One line about the files, and one line for each reason why they cannot be used."""
        rounded = ", its weights rounded to half precision" if self.half else ""
        lines = [f"written to {shown(folder)}: {', '.join(self.files)}{rounded}"]
        lines[0] += f"; actions differ from the trained policy's by {self.gap:.0e} at most"
        if self.unknown:
            names = ", ".join(self.unknown)
            lines.append(
                f"nothing says how to measure {names}: "
                "legged_mw.deploy will refuse it (docs/deploy.md, Rows of your own)"
            )
        if self.not_covered:
            names = ", ".join(self.not_covered)
            lines.append(
                f"{names} ended episodes in training; a deployed robot walks on ({CONTRACT_FILE}: ends: not_covered)"
            )
        if self.no_terrain:
            lines.append(f"no {TERRAIN_FILE}: {self.no_terrain}")
        return "\n  ".join(lines)


def export(trained: LoadedTask, checkpoint: Path, folder: Path, half: bool = False) -> Exported:
    """Write the policy in ``checkpoint`` to ``folder``: all files, or none. ``trained``: the task with that config.

    ``half``: round the weights to float16 and store them so. The comparison uses these weights. Raises ExportError,
    ContractError, ConfigError or ModelError. Then an earlier export in the folder is not changed.
    """
    precision = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")  # training may have set a lower precision, which some CPUs use
    try:
        with torch.random.fork_rng(devices=[]):  # the rollout must not change the caller's random state
            torch.default_generator.manual_seed(0)
            return _export(trained, checkpoint, folder, half)
    finally:
        torch.set_float32_matmul_precision(precision)


def _export(trained: LoadedTask, checkpoint: Path, folder: Path, half: bool) -> Exported:
    task = copy.deepcopy(trained)
    config, noise = task.to_dict(), task.cfg.noise.level
    ground = getattr(task.cfg.terrain, "mesh_type", "plane")
    env = _small_env(task)
    policy = load_policy(checkpoint, env, task.train, "cpu")
    groups, clip, exact = task.train.obs_groups.actor, task.cfg.normalization.clip_actions, copy.deepcopy(policy)
    if half:
        round_weights(policy)
    with _all_or_nothing(folder) as new:
        save_yaml(new / CONFIG_FILE, config)
        _write_network(policy, clip, new / NETWORK_FILE, half)
        memory = NetworkMemory(MEMORY_INPUT, MEMORY_OUTPUT, states_of(policy)) if isinstance(policy, RNNModel) else None
        contract = dataclasses.replace(make_contract(env, task, new, noise), memory=memory)
        no_terrain = write_terrain(env, task, new) if ground != "plane" else ""
        contract = dataclasses.replace(
            contract, terrain=digest(new / TERRAIN_FILE) if (new / TERRAIN_FILE).is_file() else ""
        )
        save_yaml(new / CONTRACT_FILE, contract.to_dict())
        steps = record(env, policy, groups, contract, new)
        observations, actions = (
            np.concatenate([getattr(step, name) for step in steps]) for name in ("observation", "actions")
        )
        remembered = np.concatenate([step.memory for step in steps]) if memory else None
        acted = run_onnx(new / NETWORK_FILE, observations, memory=remembered)
        gap = _check_network(acted, np.clip(actions, -clip, clip))
        if isinstance(policy, EstimatingModel):
            _check_network(
                run_onnx(new / NETWORK_FILE, observations, ESTIMATE),
                _run(policy, clip, observations)[1],
                does="estimates",
            )
        if half:
            gap = _gap(acted, _run(exact, clip, observations, remembered)[0])
        replay(env, contract, steps, new)
        if all(row.measured for row in contract.rows):
            read_contract(new)  # raises for an export that cannot be read
        files = (*FILES, *(name for name in SOMETIMES if (new / name).exists()))
    unknown_rows = tuple(row.name for row in contract.rows if not row.measured)
    return Exported(files, gap, len(observations), unknown_rows, no_terrain, contract.ends.not_covered, half)


def _small_env(task: LoadedTask) -> RobotTask:
    """A small environment of the trained task on a CPU, with full kicks and pushes, without slopes, noise and delays."""
    settings = {"env.num_envs": WORLDS, "sim.engine": "mujoco", "noise.level": 0.0, "perturbation.curriculum": False}
    settings |= {f"domain_rand.{name}": [] for name in ("action_delay", "delay_ms", "observation_delay", "slope")}
    if hasattr(task.cfg, "motion"):
        settings["motion.clips"] = task.cfg.motion.clips[:1]  # a deployed robot follows only this clip
    if hasattr(task.cfg.terrain, "mesh_type"):
        settings["terrain.mesh_type"] = "plane"  # the scene contains only the robot
    for path, value in settings.items():
        task.set(path, value, where="export")
    return task.env_class(task.cfg, "cpu", eager=True)


def _write_network(policy: MLPModel, clip: float, path: Path, half: bool) -> None:
    try:
        save_onnx(policy, clip, path)
    except Exception as error:  # torch's exporter raises many types
        first = next(iter(str(error).strip().splitlines()), type(error).__name__)
        raise ExportError(f"the network ({type(policy).__name__}) cannot be exported: {first}") from error
    if half:
        halve(policy, path)


def _run(policy: MLPModel, clip: float, *inputs: np.ndarray | None) -> list[np.ndarray]:
    """The expected outputs of an exported network: actions, and memory or estimate if there is one."""
    with torch.inference_mode():
        outputs = ExportedPolicy(policy, clip)(*(torch.from_numpy(values) for values in inputs if values is not None))
    return [output.numpy() for output in (outputs if isinstance(outputs, tuple) else (outputs,))]


def _gap(got: np.ndarray, wanted: np.ndarray) -> float:
    """The largest difference, relative if above 1."""
    return (
        float((np.abs(got - wanted) / np.maximum(1.0, np.abs(wanted))).max())
        if got.shape == wanted.shape
        else float("inf")
    )


def _check_network(got: np.ndarray, wanted: np.ndarray, does: str = "acts") -> float:
    """Return the largest difference. Raises ExportError if the network's output differs from the policy's."""
    gap = _gap(got, wanted)
    if not gap <= NETWORK_TOLERANCE:  # also for NaN
        raise ExportError(
            f"{NETWORK_FILE} {does} differently from the trained policy: up to {gap:g} apart on "
            f"{len(wanted)} recorded observations (at most {NETWORK_TOLERANCE:g} is allowed); nothing was written"
        )
    return gap


# ---- files ---------------------------------------------------------------------------------------------------------


@contextmanager
def _all_or_nothing(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder. One rename publishes its files; a later program completes an interrupted move."""
    if folder.exists() and not folder.is_dir():
        raise ExportError(f"{folder} is a file; name a folder to export to")
    new, mine = folder / f".export.{os.getpid()}.tmp", [part for part in (folder, *folder.parents) if not part.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(new, ignore_errors=True)  # left by an earlier process with the same number
        new.mkdir()
        finish_moving(folder)  # of an interrupted export
        sweep(folder)
        yield new
        for name in (*FILES, *SOMETIMES, *ONCE):
            (new / name).touch()  # an empty file deletes that file of an earlier export
            _flush(new / name)
        _flush(new)
        os.replace(new, folder / STAGED)
        finish_moving(folder)
    except OSError as error:
        raise ExportError(f"cannot write an export to {folder}: {error.strerror or error}") from None
    finally:
        shutil.rmtree(new, ignore_errors=True)
        with suppress(OSError):
            for part in mine:  # folders are empty if nothing was written
                part.rmdir()


def _flush(path: Path) -> None:
    """Write a file, or a folder's entries, from the cache to the disk, to survive a power cut."""
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
