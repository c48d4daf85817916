"""Compare a log with a simulation of the same commands: torques, joint errors, velocity and latency, as table and plot.

The simulation starts in the state in which the policy began: the same joint angles, tilt and velocity, on level ground.
Its targets are clipped like the robot's.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from legged_mw.deploy.contract import ESTIMATE, Contract, columns_of
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.log import DriveLog, LogError, logged_export
from legged_mw.deploy.loop import Spread
from legged_mw.deploy.robot import QUANTITIES, Floats
from legged_mw.deploy.simulated import MujocoRobot, place
from legged_mw.deploy.states import POLICY, STATES
from legged_mw.utils.commands import VELOCITY
from legged_mw.utils.errors import UserError, shown

LAGS = 12  # [periods] largest latency
MOVES = 0.02  # [rad] smallest standard deviation of a target that gives a latency
EXPLAINED = 0.5  # [share] smallest part of the torque's variance that the servo's law must explain
SHORTEST = 50  # smallest number of policy steps for a comparison
AXES = ("vx [m/s]", "vy [m/s]", "yaw rate [rad/s]")
Rows = dict[str, Floats]  # name -> (T, values)


class Replay(NamedTuple):
    """The longest walk in a log and its simulation. Both have T rows; the simulation has fewer after a fall."""

    contract: Contract
    recording: DriveLog
    robot: Rows
    simulated: Rows


def replay(path: Path, folder: Path | None = None, edited: bool = False) -> Replay:
    """Simulate the longest walk in a log with the export in ``folder`` (None: the export in the log).

    ``edited``: see read_contract. Raises LogError or ContractError.
    """
    with logged_export(path, folder, edited) as (recording, export, contract):
        walk = _longest(recording.rows["state"][:, 0] == STATES.index(POLICY))
        if walk.stop - walk.start < SHORTEST:
            raise LogError(f"{shown(path)} has no walk of {SHORTEST} steps: the policy ran for less time")
        rows = {name: values[walk].astype(float) for name, values in recording.rows.items()}
        return Replay(contract, recording, rows, _simulate(export, contract, rows))


def _longest(on: Any) -> slice:
    """The longest run of true values."""
    edges = np.flatnonzero(np.diff(np.r_[False, on, False].astype(int))).reshape(-1, 2)
    start, stop = max(edges, key=lambda edge: edge[1] - edge[0], default=(0, 0))
    return slice(int(start), int(stop))


def _simulate(folder: Path, contract: Contract, rows: Rows) -> Rows:
    """Simulate the same commands until the robot falls."""
    robot, controller = MujocoRobot(folder, contract), Controller(folder, contract)
    _pose(robot, {name: rows[name][0] for name in ("joint_pos", "joint_vel", "gravity", "lin_vel", "ang_vel")})
    simulated: dict[str, list[Floats]] = {name: [] for name in (*QUANTITIES, "target")}
    for command in rows["command"]:
        measured = robot.read()
        if robot.fell():
            break
        targets = controller.act(measured, contract.held(command))[0]
        for name in QUANTITIES:
            simulated[name].append(getattr(measured, name))
        simulated["target"].append(targets)
        robot.write(targets)
    return {name: np.array(values) for name, values in simulated.items()}


def _pose(robot: MujocoRobot, start: Rows) -> None:
    """Set the simulated robot to the real robot's pose and velocity, with its lowest point on the ground."""
    fleet, contract = robot.fleet, robot.fleet.contract
    data = mujoco.MjData(fleet.model)
    data.qpos[:] = fleet.qpos[0]
    place(fleet.model, data, contract.joints, start["joint_pos"], start["gravity"])
    fleet.qpos[0], fleet.qvel[0, 3:6] = data.qpos, start["ang_vel"]
    rotation = data.xmat[fleet.model.jnt_bodyid[0]].reshape(3, 3)
    fleet.qvel[0, :3] = rotation @ np.nan_to_num(start["lin_vel"])
    fleet.qvel[0, [fleet.model.joint(name).dofadr[0] for name in contract.joints]] = start["joint_vel"]
    fleet.refresh()


# ---- figures


def latency(rows: Rows, contract: Contract) -> Floats:
    """Latency (D,) [s] from a target to the measured torque: the lag at which the servo's law fits best.

    torque = stiffness * (target - angle) - damping * speed. Stiffness is the contract's. Damping is fitted, because
    the measured torque of some robots excludes it. NaN if no lag explains the torque or the target moves too little.
    """
    columns = zip(
        *(rows[name].T for name in ("target", "joint_pos", "joint_vel", "joint_torque")),
        contract.stiffness,
        strict=True,
    )
    return contract.period * np.array([_lag(*each) for each in columns])


def _lag(target: Floats, angle: Floats, speed: Floats, torque: Floats, stiffness: float) -> float:
    """The lag [periods] of one joint.

    The fraction of a lag is about the share of steps in which the older target was still active.
    """
    if len(target) <= 2 * LAGS or target.std() < MOVES or not torque.any():
        return math.nan
    lagged = [target[LAGS - lag : len(target) - lag] for lag in range(LAGS + 1)]
    angle, speed, torque = angle[LAGS:], speed[LAGS:], torque[LAGS:]
    best, least = math.nan, (1.0 - EXPLAINED) * float(torque.var())
    for lag, (newer, older) in enumerate(pairwise(lagged)):
        residual, regressors = (
            torque - stiffness * (newer - angle),
            np.stack([stiffness * (older - newer), -speed], axis=1),
        )
        share = float(np.clip(np.linalg.lstsq(regressors, residual, rcond=None)[0][0], 0.0, 1.0))
        residual = residual - share * regressors[:, 0]
        remainder = residual - speed * (residual @ speed) / max(float(speed @ speed), 1e-12)
        if (error := float((remainder**2).mean())) < least:
            best, least = lag + share, error
    return best


def _rms(values: Floats) -> Floats:
    return np.sqrt((values**2).mean(axis=0))


def _lin_vel(rows: Rows, contract: Contract) -> Floats:
    """(T, 3) [m/s] measured velocity, else the policy's estimate, else NaN."""
    columns = columns_of(contract.estimate, "base_lin_vel")
    if rows["lin_vel"].any():
        return rows["lin_vel"]
    return rows[ESTIMATE][:, columns] if columns and ESTIMATE in rows else np.full((len(rows["lin_vel"]), 3), np.nan)


def figures(rows: Rows, contract: Contract) -> dict[str, Floats]:
    """The compared figures, (D,) or (3,) each."""
    velocity = np.concatenate([_lin_vel(rows, contract)[:, :2], rows["ang_vel"][:, 2:]], axis=1)
    return {
        "torque": _rms(rows["joint_torque"]),
        "error": _rms(rows["target"] - rows["joint_pos"]),
        "latency": 1e3 * latency(rows, contract),
        "velocity": velocity[len(velocity) // 4 :].mean(axis=0),
    }


def _title(replayed: Replay) -> str:
    header, period = replayed.recording.header, replayed.contract.period
    steps, simulated_steps = len(replayed.robot["command"]), len(replayed.simulated["target"])
    fell = "" if simulated_steps == steps else f"; the simulated robot fell after {simulated_steps * period:.1f} s"
    return f"{header['task']}, {header['robot']}, {header['began']}: {steps * period:.1f} s of the policy{fell}"


def table(replayed: Replay) -> str:
    """A table that compares robot and simulation, with one line per joint."""
    contract, rows = replayed.contract, replayed.robot
    robot, simulated = figures(rows, contract), figures(replayed.simulated, contract)

    def pair(key: str, i: int, digits: int) -> str:
        texts = [f"{each[key][i]:.{digits}f}" if math.isfinite(each[key][i]) else "-" for each in (robot, simulated)]
        return f"{texts[0]:>10}{texts[1]:>8}"

    lines = [
        _title(replayed),
        f"{'robot / simulated':<28}{'torque [N m]':>18}{'error [rad]':>18}{'latency [ms]':>18}",
    ]
    for i, name in enumerate(contract.joints):
        lines.append(
            f"{name:<28}" + "".join(pair(key, i, n) for key, n in (("torque", 2), ("error", 3), ("latency", 0)))
        )
    lines += [f"{axis + ', mean':<28}{pair('velocity', i, 3)}" for i, axis in enumerate(AXES)]
    age = rows["age"][np.isfinite(rows["age"])]
    for name, values in (
        ("age of a measurement", age),
        ("work of a step", rows["work"]),
        ("step began late by", rows["behind"]),
    ):
        if len(values):
            lines.append(f"{name:<28}{Spread.of(values)}")
    return "\n".join([*lines, *(f"{now:8.2f} s  {text}" for now, text in replayed.recording.events)])


# ---- plot


def draw(replayed: Replay, path: Path) -> None:
    """Write the plot to ``path``. Raises UserError without matplotlib, and LogError if writing fails."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise UserError("drawing a log needs matplotlib: pip install matplotlib") from None
    contract, rows, simulated = replayed.contract, replayed.robot, replayed.simulated
    figure = Figure((13, 11), layout="constrained")
    grid = figure.add_gridspec(4, 3)
    figure.suptitle(
        "\n".join([_title(replayed), *(f"{now:.2f} s  {text}" for now, text in replayed.recording.events[:4])]),
        fontsize=9,
    )
    time, simulated_steps = rows["time"][:, 0], len(simulated["target"])
    _velocities([figure.add_subplot(grid[0, i]) for i in range(3)], contract, rows, simulated, time)
    both_figures, places = (figures(rows, contract), figures(simulated, contract)), np.arange(len(contract.joints))
    for i, (key, title) in enumerate(
        (("torque", "torque, rms [N m]"), ("error", "target - angle, rms [rad]"), ("latency", "latency [ms]"))
    ):
        axes = figure.add_subplot(grid[1, i], title=title)
        for shift, values, label in zip((-0.2, 0.2), both_figures, ("robot", "simulated"), strict=True):
            axes.bar(places + shift, np.nan_to_num(values[key]), 0.4, label=label)
        axes.set_xticks(places, contract.joints, rotation=90, fontsize=5)
        axes.legend(fontsize=6)
    joint = int(np.argmax(np.abs(both_figures[0]["torque"] - both_figures[1]["torque"])))
    for i, (key, unit) in enumerate((("joint_pos", "rad"), ("joint_torque", "N m"))):
        axes = figure.add_subplot(
            grid[2 + i, :2], title=f"{contract.joints[joint]} [{unit}]: the joint whose torque differs most"
        )
        if key == "joint_pos":
            axes.plot(time, rows["target"][:, joint], color="0.6", linewidth=0.8, label="target")
        axes.plot(time, rows[key][:, joint], label="robot")
        axes.plot(time[:simulated_steps], simulated[key][:, joint], label="simulated")
        axes.legend(fontsize=6)
    axes = figure.add_subplot(grid[2:, 2], title="timing [ms]", xlabel="[s]")
    for name in ("behind", "work", "age"):
        axes.plot(time, 1e3 * rows[name][:, 0], linewidth=0.8, label=name)
    axes.legend(fontsize=6)
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise LogError(f"cannot write {path}: {error.strerror}") from None


def _velocities(many: list[Any], contract: Contract, rows: Rows, simulated: Rows, time: Floats) -> None:
    """Plot vx, vy and yaw rate: command, robot, simulation."""
    names, simulated_steps = [each.name for each in contract.commands], len(simulated["target"])
    for i, (axes, title) in enumerate(zip(many, AXES, strict=True)):
        axes.set_title(title)
        if VELOCITY[i] in names:
            axes.plot(time, rows["command"][:, names.index(VELOCITY[i])], color="0.6", label="command")
        for each, label in ((rows, "robot"), (simulated, "simulated")):
            values = each["ang_vel"][:, 2] if i == 2 else _lin_vel(each, contract)[:, i]
            axes.plot(time[:simulated_steps] if each is simulated else time, values, linewidth=0.8, label=label)
        axes.legend(fontsize=6)
