"""A trained policy to take away: network files, contract, scene; compared with what was trained before anything is written.

What the files mean is in ``legged_mw.deploy.contract``; nothing here is needed to run them.
"""

from __future__ import annotations

import copy
import io
import logging
import os
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnx
import torch
from rsl_rl.models import MLPModel
from torch import Tensor, nn

from legged_mw.deploy.contract import (
    CONTRACT_FILE,
    FALL,
    NETWORK_FILE,
    ROWS,
    SCAN,
    SCENE_FILE,
    SENSORS,
    TERRAIN_FILE,
    Contract,
    HeightScan,
    Row,
    digest,
)
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.rl.export_scene import among_steps, standalone
from legged_mw.rl.policy import act, load_policy, save_policy
from legged_mw.rl.runs import CONFIG_FILE
from legged_mw.sim.model import ModelError, per_joint
from legged_mw.sim.terrain import LEVEL, make_terrain
from legged_mw.utils.cli import shown
from legged_mw.utils.config import save_yaml
from legged_mw.utils.errors import UserError
from legged_mw.utils.task import LoadedTask, load_task

MODEL_FILE, PROGRAM_FILE = "model.pt", "policy.pt"
FILES = (MODEL_FILE, CONFIG_FILE, NETWORK_FILE, PROGRAM_FILE, SCENE_FILE, CONTRACT_FILE)  # the contract last: it names the others
INPUT, OUTPUT = "obs", "actions"
WORLDS, STEPS = 8, 32  # of the roll-out that the files are tried on
TOLERANCE = 1e-4  # between actions of the same observation, relative above 1: float32 sums in another order


class ExportError(UserError, RuntimeError):
    """A policy that cannot be exported; nothing was written."""


class Exported(NamedTuple):
    """What an export made."""

    files: tuple[str, ...]
    gap: float  # largest difference of an action to the trained policy's
    observations: int  # that it was tried on
    unknown: tuple[str, ...]  # observation rows that nobody said how to measure: the export cannot be deployed
    no_terrain: str = ""  # why there is no scene among steps though training had some; else empty


class ExportedPolicy(nn.Module):
    """Observations (N, size) in their plain units -> clipped mean actions (N, A); the normaliser is inside."""

    def __init__(self, policy: MLPModel, clip_actions: float) -> None:
        super().__init__()
        self.policy, self.clip_actions = copy.deepcopy(policy).cpu().as_onnx(verbose=False), clip_actions

    def forward(self, obs: Tensor) -> Tensor:
        return self.policy(obs).clamp(-self.clip_actions, self.clip_actions)


def export(trained: dict[str, Any], checkpoint: Path, folder: Path) -> Exported:
    """Write the policy in ``checkpoint``, trained with the config ``trained``, to ``folder``: all files, or none.

    Raises ExportError, ConfigError or ModelError; an export that stands there already is then as it was.
    """
    precision = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")  # training may have left less, and some CPUs take it
    try:
        return _export(trained, checkpoint, folder)
    finally:
        torch.set_float32_matmul_precision(precision)


def _export(trained: dict[str, Any], checkpoint: Path, folder: Path) -> Exported:
    task = load_task(str(trained["task"]))
    task.update(trained, where=CONFIG_FILE)
    config, ground = task.to_dict(), task.cfg.terrain.mesh_type
    with torch.random.fork_rng(devices=[]):  # trying the policy draws numbers that are not ours to draw
        torch.default_generator.manual_seed(0)  # of the CPU alone
        env = _small_env(task)
        policy = load_policy(checkpoint, env, task.train, "cpu")
        observations, actions = _roll_out(env, policy, task)
    clip = task.cfg.normalization.clip_actions
    with _all_or_nothing(folder) as new:
        save_policy(policy, new / MODEL_FILE, {"task": task.name})
        save_yaml(new / CONFIG_FILE, config)
        _save_networks(policy, clip, new)
        gap = max(
            _compare(PROGRAM_FILE, _run_program(new / PROGRAM_FILE, observations), actions),
            _compare(NETWORK_FILE, run_onnx(new / NETWORK_FILE, observations.numpy()), actions),
        )
        contract = make_contract(env, task, new)
        no_terrain = _write_terrain(task, new) if ground != "plane" else ""
        save_yaml(new / CONTRACT_FILE, contract.to_dict())
        files = (*FILES, *([TERRAIN_FILE] if (new / TERRAIN_FILE).exists() else []))
    return Exported(files, gap, len(observations), tuple(row.name for row in contract.rows if not row.measured), no_terrain)


def describe(made: Exported, folder: Path) -> str:
    """What an export made, in a line, and what stands in the way of its use."""
    line = f"written to {shown(folder)}: {', '.join(made.files)}; actions differ from the trained policy's by {made.gap:.0e} at most"
    if made.unknown:
        line += (
            f"\n  nothing says how to measure {', '.join(made.unknown)}: legged_mw.deploy will refuse it (docs/deploy.md, Rows of your own)"
        )
    if made.no_terrain:
        line += f"\n  no {TERRAIN_FILE}: {made.no_terrain}"
    return line


# ---- trying it out -------------------------------------------------------------------------------------------------


def _small_env(task: LoadedTask) -> LeggedRobot:
    """The task as trained, with noise and kicks, but small and on a CPU."""
    task.set("env.num_envs", WORLDS, where="export")
    task.set("sim.engine", "mujoco", where="export")
    task.set("terrain.mesh_type", "plane", where="export")  # the scene is the robot's; whoever takes it away has ground of his own
    return task.env_class(task.cfg, "cpu", eager=True)


def _roll_out(env: LeggedRobot, policy: MLPModel, task: LoadedTask) -> tuple[Tensor, Tensor]:
    """Observations (B, size) of the policy walking, and its clipped actions (B, A) on them."""
    groups, clip = task.train.obs_groups.actor, task.cfg.normalization.clip_actions
    seen: list[tuple[Tensor, Tensor]] = []
    obs = env.get_observations()
    for _ in range(STEPS):
        actions = act(policy, obs)
        seen.append((torch.cat([obs[group] for group in groups], dim=1), actions.clamp(-clip, clip).clone()))
        obs, *_ = env.step(actions)
    return torch.cat([pair[0] for pair in seen]), torch.cat([pair[1] for pair in seen])


def _compare(name: str, got: np.ndarray, actions: Tensor) -> float:
    """The largest difference; refuses a file that acts otherwise than the policy."""
    wanted = actions.numpy()
    gap = float((np.abs(got - wanted) / np.maximum(1.0, np.abs(wanted))).max()) if got.shape == wanted.shape else float("inf")
    if not gap <= TOLERANCE:  # NaN too
        raise ExportError(
            f"{name} acts otherwise than the trained policy: up to {gap:g} apart on {len(wanted)} recorded observations "
            f"(at most {TOLERANCE:g} is allowed); nothing was written"
        )
    return gap


def run_onnx(path: Path, observations: np.ndarray) -> np.ndarray:
    """Actions (B, A) of the network in an ONNX file, by onnxruntime, or where it is not installed by onnx's own evaluator."""
    try:
        import onnxruntime
    except ImportError:
        from onnx.reference import ReferenceEvaluator

        [actions] = ReferenceEvaluator(onnx.load(path)).run([OUTPUT], {INPUT: observations})
        return np.asarray(actions)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return np.asarray(session.run([OUTPUT], {INPUT: observations})[0])


def _run_program(path: Path, observations: Tensor) -> np.ndarray:
    with _quiet_exporter():  # some releases of torch warn of their own buffers
        program = torch.export.load(io.BytesIO(path.read_bytes()))  # made by this process; one from elsewhere would be trusted blindly
    with torch.inference_mode():
        return program.module()(observations).numpy()


def _save_networks(policy: MLPModel, clip_actions: float, folder: Path) -> None:
    try:
        program = trace(policy, clip_actions)
        save_program(program, folder / PROGRAM_FILE)
        save_onnx(program, folder / NETWORK_FILE)
    except Exception as error:  # the exporters' own, one for each thing that a network may do and they may not
        first = next(iter(str(error).strip().splitlines()), type(error).__name__)
        raise ExportError(f"the network ({type(policy).__name__}) cannot be exported: {first}") from error


# ---- files ---------------------------------------------------------------------------------------------------------


def trace(policy: MLPModel, clip_actions: float) -> torch.export.ExportedProgram:
    """The policy as a graph that takes any number of observations, without notes of where its code lies."""
    example = torch.zeros(2, policy.obs_dim)
    batch = torch.export.Dim("batch", min=1)
    program = torch.export.export(ExportedPolicy(policy, clip_actions).eval(), (example,), dynamic_shapes={INPUT: {0: batch}})
    for node in program.graph.nodes:
        for note in ("stack_trace", "nn_module_stack", "source_fn_stack", "from_node", "custom"):
            node.meta.pop(note, None)
    return program


def save_program(program: torch.export.ExportedProgram, path: Path) -> None:
    """Write for ``torch.export.load``."""
    file = io.BytesIO()  # for a path it would want the ending .pt2
    with _quiet_exporter():
        torch.export.save(program, file)
    path.write_bytes(file.getvalue())


def save_onnx(program: torch.export.ExportedProgram, path: Path) -> None:
    """Write one self-contained ONNX file: input ``obs`` (batch, size), output ``actions`` (batch, A)."""
    with _quiet_exporter():
        torch.onnx.export(
            program,
            (),
            path,
            input_names=[INPUT],
            output_names=[OUTPUT],
            opset_version=18,
            external_data=False,
            dynamo=True,
            verbose=False,
        )
    _strip(path)


@contextmanager
def _quiet_exporter() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter warns of its own internals, and logs that torchvision is missing
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        yield


def _strip(path: Path) -> None:
    """Drop what the exporter notes for debugging: stack traces, with the folders of the machine that it ran on."""
    model = onnx.load(path)
    graph = model.graph
    for part in (model, graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        part.doc_string = ""
        if hasattr(part, "metadata_props"):
            del part.metadata_props[:]
    for value in (*graph.input, *graph.output, *graph.value_info):
        for dim in value.type.tensor_type.shape.dim:
            if dim.dim_param:
                dim.dim_param = "batch"  # the one free dimension, which the exporter names as it likes
    onnx.save(model, path)


@contextmanager
def _all_or_nothing(folder: Path) -> Iterator[Path]:
    """A temporary folder beside ``folder``, whose files move into place once all of them are there."""
    if folder.exists() and not folder.is_dir():
        raise ExportError(f"{folder} is a file; name a folder to export to")
    new = folder.with_name(f".{folder.name}.{os.getpid()}.tmp") if folder.name else folder / f".export.{os.getpid()}.tmp"
    try:
        new.mkdir(parents=True)
        yield new
        if folder.exists():
            if not (new / TERRAIN_FILE).exists():  # one of an earlier export would be another policy's
                (folder / TERRAIN_FILE).unlink(missing_ok=True)
            for name in [name for name in (TERRAIN_FILE, *FILES) if (new / name).exists()]:
                os.replace(new / name, folder / name)
        else:
            os.replace(new, folder)
    except OSError as error:
        raise ExportError(f"cannot write an export to {folder}: {error.strerror or error}") from None
    finally:
        shutil.rmtree(new, ignore_errors=True)


# ---- the contract --------------------------------------------------------------------------------------------------


def make_contract(env: LeggedRobot, task: LoadedTask, folder: Path) -> Contract:
    """The contract of the network that lies in ``folder``; writes the scene there."""
    cfg, robot = task.cfg, env.robot
    pose = per_joint(cfg.init_state.default_joint_angles, robot.joint_names, "init_state.default_joint_angles")
    scene = standalone(
        robot,
        imu=cfg.asset.imu_site,
        feet=cfg.asset.foot_names,
        qpos=[*cfg.init_state.pos, 1.0, 0.0, 0.0, 0.0, *pose],
        ctrl=pose,
        camera=cfg.viewer.camera,
    )
    falls_on = tuple(robot.contact_geoms[i] for i in env.contacts.terminating.tolist())
    sensed = {FALL: tuple(f"contact/{name}" for name in falls_on)} if falls_on else {}
    (folder / SCENE_FILE).write_text(scene.xml, encoding="utf-8")
    rows = tuple(row for group in task.train.obs_groups.actor for row in contract_rows(env, group))
    points = HeightScan(tuple(cfg.terrain.measured_points_x), tuple(cfg.terrain.measured_points_y), cfg.init_state.pos[2])
    return Contract(
        task=task.name,
        joints=robot.joint_names,
        default_pose=np.array(pose),
        action_scale=cfg.control.action_scale,
        action_clip=cfg.normalization.clip_actions,
        stiffness=np.array(per_joint(cfg.control.stiffness, robot.joint_names, "control.stiffness")),
        damping=np.array(per_joint(cfg.control.damping, robot.joint_names, "control.damping")),
        period=round(env.dt, 9),
        timestep=cfg.sim.dt,
        decimation=cfg.control.decimation,
        command_ranges=np.array([cfg.commands.ranges.lin_vel_x, cfg.commands.ranges.lin_vel_y, cfg.commands.ranges.ang_vel_yaw]).T,
        rows=rows,
        scan=points if any(row.measured == SCAN for row in rows) else None,
        sensors={**{name: tuple(names) for name, names in scene.sensors.items()}, **sensed},
        feet=tuple(cfg.asset.foot_names),
        falls_on=falls_on,
        imu=cfg.asset.imu_site,
        mass=round(env.total_mass, 6),
        input=INPUT,
        output=OUTPUT,
        digest=digest(folder / NETWORK_FILE),
    )


def _write_terrain(task: LoadedTask, folder: Path) -> str:
    """The scene among steps and blocks of the kinds that were trained, at three levels; or why there is none."""
    cfg, ground = task.cfg.init_state, task.cfg.terrain
    kinds = [kind for kind, share in ground.terrain_proportions.items() if share > 0 and kind in LEVEL - {"flat"}]
    if not kinds:
        return ""
    terrain = make_terrain(
        levels=3,
        difficulty=(0.1, 0.7),
        proportions=dict.fromkeys(kinds, 1.0),
        columns=len(kinds),
        tile=ground.tile_size,
        cell=ground.horizontal_scale,
        border=4.0,
        seed=ground.seed,
    )
    start = terrain.origins[0, kinds.index("stairs_up") if "stairs_up" in kinds else 0] + np.array(cfg.pos)
    try:
        xml = among_steps((folder / SCENE_FILE).read_text(encoding="utf-8"), terrain, start.tolist())
    except ModelError as error:
        return str(error)
    (folder / TERRAIN_FILE).write_text(xml, encoding="utf-8")
    return ""


def contract_rows(env: LeggedRobot, group: str) -> list[Row]:
    """A group's rows with what is known of how they are measured; a row that is a group itself is written out."""
    table, rows = env._observation_rows(), []
    for row in table[group]:
        if row.name in table and row.name != group:
            if row.noise or any(scale != 1.0 for scale in row.column_scales()):
                raise ExportError(
                    f"observation row '{row.name}' of '{group}' is a group with a noise or scale of its own: give those to its rows"
                )
            rows += contract_rows(env, row.name)
            continue
        kind = ROWS.get(row.name)
        measured = SENSORS if row.sensors else kind.measured if kind else ""
        rows.append(
            Row(
                name=row.name,
                size=int(row.value.shape[1]),
                unit=row.unit or (kind.unit if kind else ""),
                frame=row.frame or (kind.frame if kind else ""),
                noise=row.noise * env.cfg.noise.level,
                measured=measured,
                sensors=tuple(row.sensors),
                scale=tuple(row.column_scales()) if isinstance(row.scale, tuple) else (float(row.scale),),
            )
        )
    return rows
