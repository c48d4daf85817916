"""The log of a run, and its replay beside the simulation of the same commands."""

from __future__ import annotations

import resource
import shutil
import sys
import threading
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drivers import Script, Watched

from legged_mw import ROOT
from legged_mw.deploy import __main__ as program
from legged_mw.deploy.contract import Contract, ContractError, Estimated, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.log import CHUNK, Log, LogError, _columns, log_path, read_log
from legged_mw.deploy.loop import Loop
from legged_mw.deploy.replay import draw, figures, latency, replay, table
from legged_mw.deploy.robot import Health
from legged_mw.deploy.runner import run
from legged_mw.deploy.safety import Limits
from legged_mw.deploy.states import States
from legged_mw.utils.cli import one_line_errors

GO2 = ROOT / "resources/policies/go2_flat"


@pytest.fixture(scope="module")
def contract() -> Contract:
    return read_contract(GO2)


def walk(path: Path, contract: Contract, seconds: float = 5.0) -> Watched:
    """Hang, stand, walk ahead from 2.2 s on, and trip at 4.8 s."""
    robot, controller = Watched(GO2, contract, hoisted=True), Controller(GO2, contract)
    robot.health_at = lambda step: Health(age_s=0.004, temperatures=np.full(12, 90.0 if step == 240 else 30.0))
    states = States(
        controller, [Script({5: "start", 110: "A"}, [0.8, 0.0, 0.0])], lambda _: np.zeros(3), lambda _: None
    )
    log = Log(path, contract, GO2, "the test's")
    run(robot, controller, lambda _: np.zeros(0), seconds, live=False, states=states, log=log)
    return robot


@pytest.fixture(scope="module")
def logged(contract: Contract, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Watched]]:
    path = tmp_path_factory.mktemp("log") / "walk.lmwlog"
    yield path, walk(path, contract)


def test_a_log_holds_the_run(logged: tuple[Path, Watched], contract: Contract) -> None:
    path, robot = logged
    log = read_log(path)
    rows, states = log.rows, log.rows["state"][:, 0]
    assert len(states) == 250 and list(dict.fromkeys(states)) == [0, 1, 2, 3] and log.header["robot"] == "the test's"
    assert log.header["task"] == "go2_flat" and log.header["contract"]["joints"] == list(contract.joints)
    np.testing.assert_allclose(rows["time"][:, 0], 0.02 * np.arange(250), atol=1e-9)
    np.testing.assert_allclose(rows["joint_pos"][1:], np.array(robot.joints)[:-1], atol=1e-6)
    assert rows["observation"].shape == (250, 265) and np.isfinite(rows["observation"][states == 2]).all()
    limits = Limits.of(GO2, contract)
    wanted = np.clip(contract.default_pose + 0.25 * rows["action"][states == 2], limits.low, limits.high)
    np.testing.assert_allclose(rows["target"][states == 2], wanted, atol=1e-6)
    np.testing.assert_allclose(
        rows["wanted"][states == 2], contract.default_pose + 0.25 * rows["action"][states == 2], atol=1e-6
    )
    assert np.isnan(rows["target"][(states == 0) | (states == 3)]).all() and np.isnan(rows["action"][states == 1]).all()
    assert (rows["stiffness"][states == 2] == 20.0).all() and rows["stiffness"][6, 0] < 3.0
    assert (
        np.isnan(rows["voltage"]).all()
        and rows["age"][0, 0] == np.float32(0.004)
        and rows["temperature"][240, 3] == 90.0
    )
    assert log.events == [(4.8, "temperature: FL_hip_joint has a motor of 90 deg C, more than 85")]


def test_a_log_is_small(logged: tuple[Path, Watched]) -> None:
    """Compressed: a minute of a walking Go2 has at most 1.5 MB, beside the export at its start."""
    whole = logged[0].read_bytes()
    first = int.from_bytes(whole[:8], "little")
    assert (len(whole) - first) / 250 * 3000 < 1.5e6 and first < 1.3e6


def test_a_log_that_was_cut_off(logged: tuple[Path, Watched], tmp_path: Path) -> None:
    """Whole blocks are read, whatever comes after them."""
    whole, cut = logged[0].read_bytes(), tmp_path / "cut.lmwlog"
    cut.write_bytes(whole[:-10])
    assert len(read_log(cut).rows["time"]) == 2 * CHUNK
    cut.write_bytes(whole[: 8 + int.from_bytes(whole[:8], "little") + 100])
    with pytest.raises(LogError, match="has no step: its run ended within the first 100 steps, or was interrupted"):
        read_log(cut)


def test_what_is_no_log(tmp_path: Path, contract: Contract) -> None:
    wrong, short = tmp_path / "wrong.lmwlog", b"\x05" + b"\0" * 7
    for content in (b"", b"no log", b"x" * 100, short + b"hello", b"\0" * 8, short + b"PK\x03\x04-"):
        wrong.write_bytes(content)
        with pytest.raises(LogError, match=r"wrong.lmwlog is not a log of legged_mw.deploy"):
            read_log(wrong)
    assert log_path(contract).parent == Path("logs/deploy") and log_path(contract).name.startswith("go2_flat_")


def test_memory_is_flat_while_it_logs(contract: Contract, tmp_path: Path) -> None:
    robot, controller, sizes = Watched(GO2, contract, hoisted=True), Controller(GO2, contract), []
    log = Log(tmp_path / "long.lmwlog", contract, GO2, "")
    measured, health = robot.read(), Health()
    states = States(controller, [], lambda _: np.zeros(3), lambda _: None)
    loop = Loop(0.02, live=False)
    tracemalloc.start()
    try:
        for step, _ in enumerate(loop.ticks(60.0)):
            log.add(loop, controller, measured, health, states.step(measured, loop.now), states.command)
            if step in (1050, 2950):
                while log.backlog():
                    time.sleep(0.01)
                sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
        log.close()
        log.close()
    assert sizes[1] - sizes[0] < 500_000 and len(read_log(log.path).rows["time"]) == 3000


def test_a_disk_that_hangs_costs_steps_of_the_log_alone(
    contract: Contract, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("legged_mw.deploy.log.BACKLOG", 2)
    hangs = threading.Event()
    monkeypatch.setattr(np, "savez_compressed", lambda file, **block: (hangs.wait(), np.savez(file, **block)))
    robot, controller = Watched(GO2, contract), Controller(GO2, contract)
    log = Log(tmp_path / "hangs.lmwlog", contract, GO2, "")
    states = States(controller, [], lambda _: np.zeros(3), lambda _: None)
    loop, measured = Loop(0.02, live=False), robot.read()
    for _ in loop.ticks(20.0):
        log.add(loop, controller, measured, Health(), states.step(measured, loop.now), states.command)
    hangs.set()
    log.close()
    found = read_log(log.path)
    assert len(found.rows["time"]) in (200, 300) and found.events[-1][1].endswith(
        " steps were not logged: the disk is too slow"
    )
    assert found.events[-1][0] == pytest.approx(18.0)  # [s] the first step of the last block of 100 that was lost


@contextmanager
def disk_of(size: int) -> Iterator[None]:
    """No file gets longer: a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_ends_the_log_and_not_the_walk(
    logged: tuple[Path, Watched], contract: Contract, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is said once, when it happens; what was written before is read."""
    whole = logged[0].read_bytes()
    first = 8 + int.from_bytes(whole[:8], "little")
    # the export, a block, and a bit
    with disk_of(first + 8 + int.from_bytes(whole[first : first + 8], "little") + 1000):
        robot = walk(tmp_path / "full.lmwlog", contract)
    assert len(robot.joints) == 250
    assert capsys.readouterr().out == f"the log {tmp_path}/full.lmwlog ends after 100 steps: File too large\n"
    assert len(read_log(tmp_path / "full.lmwlog").rows["time"]) == 100


def test_the_program_does_not_say_that_it_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "full.lmwlog"
    monkeypatch.setattr(sys, "argv", ["deploy", str(GO2), "--drive", "--time", "0.2", "--log", str(path)])
    with disk_of(1000):
        program.main()
    out = capsys.readouterr().out
    why = f"the log {path} ends after 0 steps: File too large"
    # once by the log's thread, perhaps within another line, and once at the end
    assert out.count(why) == 2 and f"the joints are damped; {why}\n" in out and "logged to" not in out


# ---- replay


def test_the_simulation_of_a_simulated_walk_is_like_it(
    logged: tuple[Path, Watched], contract: Contract, tmp_path: Path
) -> None:
    found = replay(logged[0])
    assert len(found.robot["time"]) == 130 == len(found.simulated["target"])
    robot, simulated = figures(found.robot, contract), figures(found.simulated, contract)
    # it began 2 cm above the ground
    np.testing.assert_allclose(robot["torque"].sum(), simulated["torque"].sum(), rtol=0.25)
    np.testing.assert_allclose(robot["velocity"], simulated["velocity"], atol=0.08)
    action = contract.action
    assert (found.simulated["target"] <= action.highest).all() and (found.simulated["target"] >= action.lowest).all()
    # a period, at whose end is measured
    np.testing.assert_allclose([robot["latency"], simulated["latency"]], 20.0, atol=1.0)
    text = table(found)
    assert text.startswith(f"go2_flat, the test's, {found.recording.header['began']}: 2.6 s of the policy\n")
    assert "age of a measurement" in text and "vx [m/s], mean" in text
    assert "    4.80 s  temperature: FL_hip_joint has a motor of 90 deg C, more than 85" in text
    draw(found, tmp_path / "walk.png")
    assert (tmp_path / "walk.png").read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(LogError, match=r"cannot write .*/no/walk.png: No such file"):
        draw(found, tmp_path / "no/walk.png")


def test_latency_is_from_a_target_to_its_torque(contract: Contract) -> None:
    """Of servos that obey a target 1, 2 and 4 periods later, in half of the steps 3 or 4; damped or not. Others have none."""
    rng = np.random.default_rng(0)
    steps = np.cumsum(rng.normal(0.0, 0.05, (12, 400)), axis=1)
    angle, speed = 0.5 * rng.normal(0.0, 0.1, (12, 400)), rng.normal(0.0, 2.0, (12, 400))
    lags = [np.full(400, lag) for lag in (1, 2, 4)] + [3 + rng.integers(0, 2, 400)] * 2
    wanted = np.stack(
        [steps[i, np.maximum(np.arange(400) - lag, 0)] for i, lag in enumerate(lags)] + [steps[i] for i in range(5, 12)]
    )
    torque = 20.0 * (wanted - angle) - np.array([0.5, 0.0] * 6)[:, None] * speed
    steps[5] = 0.3  # it rests
    torque[6], torque[7:] = 0.0, rng.normal(0.0, 10.0, (5, 400))  # none is measured; it has another reason
    rows = {"target": steps, "joint_pos": angle, "joint_vel": speed, "joint_torque": torque}
    found = 1e3 * latency({name: values.T for name, values in rows.items()}, contract)
    np.testing.assert_allclose(found, [20.0, 40.0, 80.0, 70.0, 70.0, *[np.nan] * 7], atol=3.0)


def test_a_log_needs_nothing_beside_it(
    logged: tuple[Path, Watched], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It holds the export. A log from before that names where it was."""
    recording = read_log(logged[0])
    assert recording.files["scene.xml"] == (GO2 / "scene.xml").read_bytes() and len(recording.files) == 3
    elsewhere = replace(recording, header=recording.header | {"export": str(tmp_path)})
    monkeypatch.setattr("legged_mw.deploy.log.read_log", lambda _: elsewhere)
    assert len(replay(logged[0]).simulated["target"]) == 130
    elsewhere = replace(elsewhere, files={})
    with pytest.raises(ContractError, match=f"no policy.yaml in {tmp_path}"):
        replay(logged[0])


def test_the_log_of_a_motion_needs_nothing_beside_it(tmp_path: Path) -> None:
    folder = ROOT / "resources/policies/g1_track"
    contract = read_contract(folder)
    log = Log(tmp_path / "dance.lmwlog", contract, folder, "the test's")
    run(Watched(folder, contract), Controller(folder, contract), lambda _: np.zeros(0), 2.0, live=False, log=log)
    assert read_log(log.path).files["motion.npz"] == (folder / "motion.npz").read_bytes()
    assert len(replay(log.path).simulated["target"]) == 100


def test_the_program_draws_a_log(
    logged: tuple[Path, Watched], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(logged[0], tmp_path / "run.lmwlog")
    monkeypatch.setattr(sys, "argv", ["deploy", "--replay", str(tmp_path / "run.lmwlog")])
    program.main()
    assert (tmp_path / "run.png").is_file() and f"written to {tmp_path / 'run.png'}" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["deploy"])
    with pytest.raises(SystemExit, match="2"), one_line_errors("legged_mw.deploy"):
        program.main()
    assert "the following arguments are required: DIR" in capsys.readouterr().err


class Believes:
    """A network that stands still and has an estimate."""

    estimate = np.array([[0.1, 0.2, 0.3]], dtype=np.float32)

    def __call__(self, _: np.ndarray) -> np.ndarray:
        return np.zeros((1, 12), dtype=np.float32)


def test_an_estimate_is_logged_and_drawn_where_velocity_is_not_measured(contract: Contract, tmp_path: Path) -> None:
    blind = replace(contract, estimate=(Estimated("base_lin_vel", 3, "m/s", "body"),))
    robot, controller = Watched(GO2, contract, hoisted=True), Controller(GO2, blind, network=Believes())
    robot.changed = lambda _, measured: replace(measured, lin_vel=np.zeros(3))
    states = States(controller, [Script({5: "start", 110: "A"})], lambda _: np.zeros(3), lambda _: None)
    log = Log(tmp_path / "blind.lmwlog", blind, GO2, "")
    run(robot, controller, lambda _: np.zeros(0), 2.5, live=False, states=states, log=log)
    rows = read_log(log.path).rows
    acts = rows["state"][:, 0] == 2
    assert acts.sum() == 15 and np.isnan(rows["estimate"][~acts]).all()
    np.testing.assert_allclose(rows["estimate"][acts], np.tile(Believes.estimate, (15, 1)))
    walked = {name: values[acts] for name, values in rows.items()}
    np.testing.assert_allclose(figures(walked, blind)["velocity"][:2], [0.1, 0.2], atol=1e-6)
    assert np.isnan(figures(walked, contract)["velocity"][:2]).all()


def test_a_log_names_rows_of_its_own(contract: Contract) -> None:
    """What a measurement holds beside the usual is logged under its name."""
    row = replace(contract.rows[0], name="belly", measured="sensors", sensors=("touch/belly",), size=1, scale=(1.0,))
    assert _columns(replace(contract, rows=(*contract.rows, row)))["belly"] == 1
