"""Driving: commands and their ranges, keys, scripts, the loop of a session, the web panel without a browser."""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import legged_mw

# isort: split
import mujoco
import numpy as np
import pytest

from legged_mw.deploy.__main__ import parse as parse_deploy
from legged_mw.envs.robot_task import RobotTask
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.utils.commands import Command
from legged_mw.utils.task import load_task
from legged_mw.view import launch, web
from legged_mw.view.drive import (
    ACTIONS,
    AFTER,
    BINDINGS,
    CAMERAS,
    KEY_ACTION,
    NO_COMMANDS,
    SPEEDS,
    STEPS,
    Pilot,
    load_script,
    outside,
    tour,
)
from legged_mw.view.native import window_texts
from legged_mw.view.panel import BUTTONS, CURVE_SECONDS, KEY_NAMES, Curves, Panel
from legged_mw.view.playing import EnvStage
from legged_mw.view.session import Session, signed
from legged_mw.view.stage import Moment, Stage, ViewError, target_velocity
from tests.worlds import QUIET, make_env

THREE = (
    Command("lin_vel_x", -1.0, 1.5, "m/s", 1.0),
    Command("lin_vel_y", -0.4, 0.8, "m/s", -1.0),
    Command("ang_vel_yaw", -2.0, 2.0, "rad/s", -1.0),
)
HEIGHT = Command("base_height", 0.2, 0.3, "m", 1.0, 0.28)
FOUR = (*THREE, HEIGHT)
SPEC = mujoco.MjSpec.from_string('<mujoco><worldbody><body><freejoint/><geom size=".1"/></body></worldbody></mujoco>')


def done(pilot: Pilot, *actions: str) -> Pilot:
    for action in actions:
        pilot.ask(action)
    pilot.listen()
    return pilot


# ---- the pilot


def test_arrows_step_to_the_limits_and_no_further() -> None:
    pilot = done(Pilot(THREE), "forward")
    assert pilot.driving and np.allclose(pilot.command, [1.5 / STEPS, 0, 0])
    assert np.allclose(done(pilot, *["forward"] * 9).command, [1.5, 0, 0])
    assert np.allclose(done(pilot, *["back"] * 20, *["right"] * 20, *["turn_left"] * 20).command, [-1.0, -0.4, 2.0])
    assert np.array_equal(done(pilot, "stop").command, np.zeros(3))
    assert np.array_equal(done(pilot, *["left"] * 3, *["right"] * 3).command, np.zeros(3))  # exactly


@pytest.mark.parametrize(("asked", "held"), [((9, -9, 9), (1.5, -0.4, 2.0)), ((0.3, 0.1, -0.2), (0.3, 0.1, -0.2))])
def test_sliders_are_held_to_the_limits(asked: tuple[float, ...], held: tuple[float, ...]) -> None:
    pilot = Pilot(THREE)
    pilot.steer(asked)
    assert not pilot.driving  # until the session's next turn
    pilot.listen()
    assert pilot.driving and np.allclose(pilot.command, held)


def test_who_drives_whom() -> None:
    pilot, own = Pilot(THREE, 3), np.full((3, 3), 0.1)
    assert pilot.commands(own) is None
    pilot.follow(own[0])
    done(pilot, "next", "forward")
    commands = pilot.commands(own)
    # took over where the robot was
    assert commands is not None and np.allclose(commands, [[0.1] * 3, [0.4, 0.1, 0.1], [0.1] * 3])
    assert np.allclose(own, 0.1)
    commands = done(pilot, "everyone").commands(own)
    assert commands is not None and np.allclose(commands, [[0.4, 0.1, 0.1]] * 3)
    assert done(pilot, "own").commands(own) is None
    assert done(pilot, "next", "next").world == 0


def test_a_further_command_has_keys_of_its_own_and_stops_at_its_default() -> None:
    pilot = done(Pilot(FOUR), "raise")
    assert np.allclose(pilot.command, [0, 0, 0, 0.28 + 0.08 / STEPS])  # a fifth of the way to the farther end
    assert pilot.command[3] != 0.28 and done(pilot, "lower").command[3] == 0.28  # exactly
    assert np.allclose(done(pilot, *["lower"] * 9, "forward").command, [0.3, 0, 0, 0.2])
    assert done(pilot, "stop").command.tolist() == [0, 0, 0, 0.28] and not pilot.message
    pilot = done(Pilot([HEIGHT]), "raise")
    assert pilot.driving and np.allclose(pilot.command, [0.28 + 0.08 / STEPS])


def test_keys_for_what_a_task_does_not_have_say_so() -> None:
    for table, action, message in (
        ([HEIGHT], "forward", "this task has no command vx"),
        ([HEIGHT], "turn_left", "this task has no command yaw rate"),
        (THREE, "raise", "this task has no command beyond vx, vy, yaw rate"),
        ((), "forward", NO_COMMANDS),
        ((), "raise", NO_COMMANDS),
        ((), "stop", NO_COMMANDS),
    ):
        pilot = done(Pilot(table), action)
        assert pilot.message == message and not pilot.driving
        assert done(pilot, "push").message == "" and len(pilot.take_pushes()) == 1


def test_pushes_and_resets_are_handed_out_once() -> None:
    pilot = done(Pilot(THREE, 2), "push", "reset", "reset", "everyone", "push")
    pilot.push((0.5, -0.5))
    pilot.listen()
    pushes = pilot.take_pushes()
    assert [world for world, _ in pushes] == [0, 0, 1, 0, 1] and pilot.take_resets() == [0]
    assert np.allclose([np.linalg.norm(velocity) for _, velocity in pushes[:3]], pilot.push_speed)
    assert np.allclose(pushes[3][1], (0.5, -0.5))
    assert pilot.take_pushes() == [] and pilot.take_resets() == []


def test_speed_camera_pause_and_help_go_round() -> None:
    pilot = Pilot(THREE)
    assert [done(pilot, "slower").speed for _ in range(4)] == [*SPEEDS[1:], SPEEDS[-1]]
    assert [done(pilot, "faster").speed for _ in range(4)] == [*SPEEDS[-2::-1], 1.0]
    assert [done(pilot, "camera").camera for _ in CAMERAS] == [*CAMERAS[1:], CAMERAS[0]]
    assert done(pilot, "pause").paused and not done(pilot, "pause").paused and done(pilot, "help").help


def test_the_table_of_keys_is_whole() -> None:
    keys = [key for binding in BINDINGS for key in binding.keys]
    assert len(keys) == len(set(keys)) == len(KEY_ACTION)
    pilot = Pilot(THREE, 2)
    for action in ACTIONS:  # each has something that does it
        done(pilot, action)
    pilot.press("z")  # no key of ours


def test_keys_in_the_documentation_are_those_of_the_table() -> None:
    text = (legged_mw.ROOT / "docs" / "playing.md").read_text()
    for binding in BINDINGS:
        row = next((line for line in text.splitlines() if line.startswith("|") and binding.text in line), "")
        assert all(f"`{key}`" in row for key in binding.keys), f"docs/playing.md: {binding}"


# ---- scripts


def script(folder: Path, text: str) -> Path:
    path = folder / "drive.yaml"
    path.write_text(text)
    return path


def test_a_script_drives_in_its_time(tmp_path: Path) -> None:
    text = (
        "commands:\n  - {time: 0, command: [5e-1, 0, 0]}\n  - {time: 2, push: [0, 1.5]}\n  - {time: 2.0, reset: true}\n"
    )
    drive, pilot = load_script(script(tmp_path, text), THREE), Pilot(THREE)
    assert drive.seconds == 2 + AFTER
    drive.play(0.0, pilot)
    pilot.listen()
    assert np.allclose(pilot.command, [0.5, 0, 0]) and pilot.take_pushes() == []
    drive.play(1.98, pilot)
    drive.play(2.0, pilot)
    drive.play(2.02, pilot)
    pilot.listen()
    assert [push.tolist() for _, push in pilot.take_pushes()] == [[0, 1.5]] and pilot.take_resets() == [0]


def test_a_script_gives_commands_by_order_or_by_name(tmp_path: Path) -> None:
    text = "commands: [{time: 0, command: [0.5, 0, 0]}, {time: 1, command: {base_height: 0.25, lin_vel_x: -1}}, "
    text += "{time: 2, command: [1, 0, 0, 0.2]}]"
    drive = load_script(script(tmp_path, text), FOUR)
    assert [entry.command for entry in drive.entries] == [[0.5, 0, 0, 0.28], [-1, 0, 0, 0.25], [1, 0, 0, 0.2]]
    assert load_script(script(tmp_path, "commands: [{time: 0, push: [1, 0]}]"), ()).seconds == AFTER


# ---- the session


class FakeStage:
    """Robots that do at once what they are told, and fall when `falls` says so."""

    spec, dt = SPEC, 0.02

    def __init__(
        self, num_worlds: int = 2, falls: dict[int, int] | None = None, table: tuple[Command, ...] = THREE
    ) -> None:
        self.num_worlds, self.falls, self.command_table = num_worlds, falls or {}, table  # falls: step -> world
        self.steps, self.own = 0, np.full((num_worlds, len(table)), 0.1)
        self.now, self.events = self.own.copy(), []
        self.given: list[Any] = []
        self.believed: Any = None

    def step(self, commands: Any) -> None:
        self.given.append(commands)
        self.now = self.own.copy() if commands is None else np.array(commands)
        self.steps += 1

    def commands(self) -> Any:
        return self.now.copy()

    def velocity(self) -> Any:
        return (
            np.resize(self.now, (self.num_worlds, 3)) + 0.01
            if len(self.command_table) == 3
            else np.full((self.num_worlds, 3), 0.11)
        )

    def ghost(self) -> None:
        return None

    def believed_velocity(self) -> Any:
        return self.believed

    def qpos(self) -> Any:
        return np.tile([self.steps * 1.0, 0, 1, 1, 0, 0, 0], (self.num_worlds, 1))

    def contacts(self) -> Any:
        return np.ones((self.num_worlds, 4), dtype=bool)

    def fell(self) -> Any:
        return np.arange(self.num_worlds) == self.falls.get(self.steps, -1)

    def ground(self, world: int) -> str:
        return "" if world == 0 else "stairs_up, step 12 cm"

    def push(self, world: int, velocity: Any) -> None:
        self.events.append((self.steps, "push", world))

    def reset(self, world: int) -> None:
        self.events.append((self.steps, "reset", world))


class FakeViewer:
    """Keeps what it is shown; `keys` are pressed when that many moments were."""

    def __init__(self, pilot: Pilot, keys: dict[int, str] | None = None, until: int = 10**6) -> None:
        self.pilot, self.keys, self.until = pilot, keys or {}, until
        self.moments: list[Moment] = []

    def show(self, moment: Moment) -> None:
        self.moments.append(moment)
        if key := self.keys.get(len(self.moments)):
            self.pilot.press(key)

    def is_running(self) -> bool:
        return len(self.moments) < self.until

    def close(self) -> None: ...


def test_a_session_does_what_the_keys_say() -> None:
    stage: Stage = FakeStage()
    pilot = Pilot(stage.command_table, 2)
    viewer = FakeViewer(pilot, {2: "space", 4: "up", 5: "p", 6: "n", 7: "r", 8: "o"}, until=10)
    outcome = Session(stage, viewer, pilot, real_time=False).run()
    assert isinstance(stage, FakeStage) and stage.steps == 10 and outcome.seconds == pytest.approx(0.2)
    assert stage.given[:2] == [None, None] and stage.given[8:] == [None, None]
    # the other robot goes on as it was
    assert np.allclose(stage.given[2][0], 0) and np.allclose(stage.given[2][1], 0.1)
    assert np.allclose(stage.given[4][0], [0.3, 0, 0])
    assert stage.events == [(5, "push", 0), (7, "reset", 1)]
    assert [moment.world for moment in viewer.moments] == [0] * 6 + [1] * 4
    # shown as it will be followed
    assert [np.allclose(moment.commands[0], 0) for moment in viewer.moments[1:4]] == [False, True, True]


def test_a_stage_without_commands_is_watched_pushed_and_reset() -> None:
    stage = FakeStage(2, table=())
    viewer = FakeViewer(Pilot((), 2), {2: "up", 4: "p", 5: "r"}, until=8)
    outcome = Session(stage, viewer, viewer.pilot, real_time=False).run()
    assert stage.given == [None] * 8 and stage.events == [(4, "push", 0), (5, "reset", 0)]
    assert [dict(moment.lines).get("note", "") for moment in viewer.moments[1:5]] == ["", NO_COMMANDS, NO_COMMANDS, ""]
    assert [name for name, _ in viewer.moments[0].lines] == ["measured", "robot", "falls, all", "time"]
    assert np.isnan(viewer.moments[0].target_velocity).all() and "commanded: nothing" in outcome.text()


def test_what_a_policy_believes_of_its_velocity_stands_below_the_measured_one() -> None:
    stage = FakeStage(2)
    stage.believed = np.array([[0.5, -0.25], [0.0, 0.0]])
    viewer = FakeViewer(Pilot(stage.command_table, 2), until=1)
    Session(stage, viewer, viewer.pilot, real_time=False).run()
    assert viewer.moments[0].lines[1:3] == (("measured", "+0.11 +0.11 +0.11"), ("estimated", "+0.50 -0.25"))


def test_velocities_are_found_among_the_commands_by_name() -> None:
    table = (HEIGHT, THREE[2], THREE[0])
    target = target_velocity(table, np.array([[0.25, -2.0, 0.5]]))
    assert np.array_equal(target, [[0.5, np.nan, -2.0]], equal_nan=True)
    viewer = FakeViewer(Pilot(table), until=1)
    Session(FakeStage(1, table=table), viewer, viewer.pilot, real_time=False).run()
    assert np.array_equal(viewer.moments[0].target_velocity, [[0.1, np.nan, 0.1]], equal_nan=True)


def test_pause_stands_still_and_slow_motion_takes_longer() -> None:
    stage = FakeStage(1)
    pilot = Pilot(THREE)
    viewer = FakeViewer(pilot, {3: "enter", 6: "enter"}, until=10)
    Session(stage, viewer, pilot, real_time=False).run()
    assert stage.steps == 7 and [moment.time for moment in viewer.moments[3:6]] == [viewer.moments[3].time] * 3
    assert ", paused" in dict(viewer.moments[4].lines)["time"]
    done(pilot, "slower", "slower")
    session = Session(FakeStage(1), FakeViewer(pilot, until=2), pilot)
    session.run()
    assert session._pace.dt == pytest.approx(0.02 / 0.25)  # of real time a step


def test_pace_and_mean_velocity_of_a_segment_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    pilot = Pilot(THREE)
    session = Session(FakeStage(1), FakeViewer(pilot), pilot)
    # 100 steps of 0.02 s within 4 s
    session.steps, session._measured = 150, (10.0, 50, 0.0)
    monkeypatch.setattr("legged_mw.view.session.time.perf_counter", lambda: 14.0)
    assert session._tempo() == ", x 0.50"
    # a segment of more than 2 s leaves out its first second
    session._since, session._followed = 0.0, np.zeros(3)
    for steps in (100, 101):
        session._velocities = [np.zeros(3)] * 50 + [np.ones(3)] * (steps - 50)
        session._end_segment()
    assert [segment.velocity[0] for segment in session._segments] == [0.5, 1.0]


def test_falls_are_counted_once_and_shown_for_a_while() -> None:
    stage, pilot = FakeStage(2, falls={3: 1, 4: 1, 50: 0}), Pilot(THREE, 2)
    viewer = FakeViewer(pilot)
    outcome = Session(stage, viewer, pilot, seconds=2.5, real_time=False).run()
    assert outcome.falls == 2 and dict(viewer.moments[10].lines)["falls, all"] == "1"
    [fall] = viewer.moments[3].falls
    assert fall.world == 1 and fall.place[0] == 2.0  # where it was the step before, for it may be elsewhere since
    assert len(viewer.moments[60].falls) == 2 and len(viewer.moments[120].falls) == 1


def test_ctrl_c_ends_a_session_in_order(capsys: pytest.CaptureFixture[str]) -> None:
    class Interrupted(FakeStage):
        def step(self, commands: Any) -> None:
            super().step(commands)
            if self.steps == 3:
                raise KeyboardInterrupt

    pilot = Pilot(THREE, 2)
    outcome = Session(Interrupted(), FakeViewer(pilot), pilot, seconds=10, real_time=False).run()
    assert outcome.seconds == pytest.approx(0.04) and "stopped" in capsys.readouterr().out


def test_the_summary_of_a_script_has_a_row_a_command(tmp_path: Path) -> None:
    text = "commands: [{time: 0, command: [0.5, 0, 0]}, {time: 3, command: [0, 0, 1]}]"
    pilot = Pilot(THREE)
    pilot.everyone = True
    drive = load_script(script(tmp_path, text), THREE)
    outcome = Session(
        FakeStage(2), FakeViewer(pilot), pilot, seconds=drive.seconds, real_time=False, script=drive
    ).run()
    assert [(round(each.start, 2), round(each.seconds, 2)) for each in outcome.segments] == [(0, 3), (3, 3)]
    said, title, row = outcome.text().splitlines()[:3]
    assert said == "6.0 s, 0 falls of 2 robots"
    assert title == "    from     for   commanded: vx [m/s], vy [m/s], yaw rate [rad/s]   measured: vx, vy, yaw rate"
    assert row.split() == ["0.0", "s", "3.0", "s", "+0.50", "+0.00", "+0.00", "+0.51", "+0.01", "+0.01"]
    assert row.index("+0.51") == title.index("measured")
    assert signed(np.array([-0.001, 0.004, -1.5])) == "+0.00 +0.00 -1.50"


# ---- which viewer


def flags(*args: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    launch.add_flags(parser)
    parser.add_argument("--time", type=float)
    parser.add_argument("--command")
    return parser.parse_args(args)


@pytest.mark.parametrize(
    ("args", "screen", "terminal", "studio", "kind", "why"),
    [
        ([], True, True, True, "native", "there is a screen"),
        ([], False, True, True, "web", "no screen here"),
        ([], False, False, True, "video", "no terminal with somebody who could open a web page"),
        ([], False, True, False, "video", "no studio"),
        (["--video", "a.gif"], True, True, True, "video", "a file was asked for"),
        (["--viewer", "web"], True, True, True, "web", "as asked"),
        (["--viewer", "none"], True, True, True, "none", "as asked"),
    ],
)
def test_auto_takes_the_best_there_is_and_says_why(
    args: list[str], screen: bool, terminal: bool, studio: bool, kind: str, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web, "missing", lambda: None if studio else "no studio")
    chosen, reason = launch.choose(flags(*args), terminal, screen)
    assert chosen == kind and why in reason


@pytest.mark.parametrize("what", ["--serve unitree --interface lo", "--robot unitree --interface lo", "--eval"])
def test_no_viewer_is_no_flag_too_many_where_nothing_is_shown(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["deploy", "go2_flat", *what.split(), "--viewer", "none"])
    assert parse_deploy().viewer == "none"


def test_watching_without_a_viewer_ends_by_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive = script(tmp_path, "commands: [{time: 0, command: [0.5, 0, 0]}]")
    outcome = launch.watch(FakeStage(), flags("--viewer", "none", "--commands", str(drive)), tmp_path)
    out = capsys.readouterr().out
    assert outcome.seconds == pytest.approx(AFTER)
    assert "viewer: none (as asked)" in out and "3.0 s, 0 falls" in out and "+0.50 +0.00 +0.00" in out


def test_a_batch_job_gets_a_video_and_a_sheet(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launch, "has_display", lambda: False)
    picture: Any = {"width": 64, "height": 48, "fps": 25.0}
    launch.watch(FakeStage(), flags("--time", "0.2"), tmp_path, **picture)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["play.mp4", "play.png"]
    assert "(no screen here, and no terminal" in capsys.readouterr().out


def test_a_recording_shows_what_a_robot_can() -> None:
    """Ahead, in a curve, sideways, back, stand; further commands keep their defaults. A task without has no tour."""
    shown = tour(FOUR, 10.0)
    assert shown and [entry.time for entry in shown.entries] == [0.0, 3.0, 5.0, 7.0, 9.0]
    asked = np.array([entry.command for entry in shown.entries])
    assert (asked[:, 3] == HEIGHT.default).all() and asked[0, 0] > 0.0 > asked[3, 0] and not asked[4, :3].any()
    assert asked[1, 2] > 0.0 and asked[2, 1] > 0.0 and not any(outside(row, FOUR) for row in asked.tolist())
    assert tour([HEIGHT], 10.0) is None


def test_a_slow_recording_says_how_long_it_takes(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for second, said in [(4.0, "about 12 s to go"), (0.4, "")]:  # that the first second of four takes
        stage = FakeStage()
        clock = SimpleNamespace(perf_counter=lambda stage=stage, second=second: stage.steps * stage.dt * second)
        monkeypatch.setattr("legged_mw.view.session.time", clock)
        Session(stage, launch.NoViewer(), Pilot(THREE, 2), seconds=4.0, real_time=False).run()
        assert capsys.readouterr().out.strip() == said


def test_a_window_that_cannot_open_does_not_leave_a_batch_job_waiting(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise ViewError("no OpenGL on :99")

    monkeypatch.setattr(launch, "has_display", lambda: True)
    monkeypatch.setattr(launch, "NativeViewer", refuse)
    monkeypatch.setattr("sys.stdout.isatty", lambda: False, raising=False)
    monkeypatch.setattr(launch, "SECONDS", 0.1)  # nobody said how long
    outcome = launch.watch(FakeStage(), flags(), tmp_path, width=64, height=48)
    assert (
        outcome.seconds == pytest.approx(0.1)
        and (tmp_path / "play.mp4").exists()
        and "no window: no OpenGL on :99" in capsys.readouterr().out
    )
    with pytest.raises(ViewError, match="no OpenGL on :99"):
        launch.watch(FakeStage(), flags("--viewer", "native"), tmp_path)


# ---- the web page


def test_the_tunnel_line_names_the_machine_as_its_user_knows_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web.getpass, "getuser", lambda: "ann")
    monkeypatch.setenv("SSH_CONNECTION", "10.0.0.7 51000 10.0.0.9 2222")
    assert web.tunnel_line(8081) == "ssh -p 2222 -L 8081:127.0.0.1:8081 ann@10.0.0.9"
    monkeypatch.setenv("SSH_CONNECTION", "10.0.0.7 51000 10.0.0.9 22")
    assert web.tunnel_line(8080) == "ssh -L 8080:127.0.0.1:8080 ann@10.0.0.9"
    monkeypatch.delenv("SSH_CONNECTION")
    monkeypatch.setattr(web.socket, "gethostname", lambda: "server")
    assert web.tunnel_line(8080) == "ssh -L 8080:127.0.0.1:8080 ann@server"


class FakeUi:
    """ImGui as far as a panel goes: `clicked` buttons and `dragged` sliders; blocks must be closed."""

    def __init__(self) -> None:
        self.clicked: set[str] = set()
        self.dragged: dict[str, float] = {}
        self.typing, self.depth, self.seen = False, 0, []
        self.width, self.folded = 1280.0, False
        self.ranges: dict[str, tuple[float, float]] = {}
        self.WindowFlags = SimpleNamespace(NoFocusOnAppearing=1)
        self.Cond = SimpleNamespace(FirstUseEver=4)

    def GetIO(self) -> Any:
        return SimpleNamespace(WantCaptureKeyboard=self.typing, DisplaySize=SimpleNamespace(x=self.width))

    def SetNextWindowCollapsed(self, folded: bool) -> None:
        self.folded = folded

    def Begin(self, title: str, *_: Any) -> tuple[bool, bool]:
        self.depth += 1
        return True, True

    def End(self) -> None:
        self.depth -= 1

    def SliderFloat(self, label: str, value: float, low: float, high: float, form: str) -> tuple[bool, float]:
        self.ranges[label] = (low, high)
        return label in self.dragged, self.dragged.get(label, value)

    def Button(self, label: str, size: Any) -> bool:
        self.seen.append(label)
        return label.split("###")[-1] in self.clicked

    def Checkbox(self, label: str, value: bool) -> tuple[bool, bool]:
        return label in self.clicked, value

    def CollapsingHeader(self, label: str) -> bool:
        return True

    def Text(self, text: str) -> None:
        self.seen.append(text)

    TextWrapped = Text

    def __getattr__(self, name: str) -> Any:
        return lambda *_: None


class FakePlot:
    def __init__(self) -> None:
        self.depth, self.lines = 0, []
        self.Flags = SimpleNamespace(CanvasOnly=1, NoInputs=2)
        self.AxisFlags = SimpleNamespace(NoTickLabels=1, NoGridLines=2)
        self.Cond = SimpleNamespace(Always=1)

    def BeginPlot(self, *_: Any) -> bool:
        self.depth += 1
        return True

    def EndPlot(self) -> None:
        self.depth -= 1

    def PlotLine(self, label: str, xs: list[float], ys: list[float]) -> None:
        self.lines.append((label, xs, ys))

    def __getattr__(self, name: str) -> Any:
        return lambda *_: None


def panel(worlds: int = 2, table: tuple[Command, ...] = THREE) -> tuple[Panel, FakeUi, FakePlot, Pilot]:
    pilot, ui, plot = Pilot(table, worlds), FakeUi(), FakePlot()
    page = Panel(pilot, "go1", ui, plot)
    page.build()  # nothing to show yet
    now, commands = np.full((worlds, 3), 0.25), np.full((worlds, len(table)), 0.25)
    page.show(
        Moment(
            0.0, np.zeros((worlds, 7)), commands, now, now, np.ones((worlds, 4), dtype=bool), lines=(("falls", "3"),)
        )
    )
    return page, ui, plot, pilot


@pytest.mark.parametrize("action", [action for row in BUTTONS for action, _ in row])
def test_each_button_asks_for_its_action(action: str) -> None:
    page, ui, _, pilot = panel()
    asked: list[str] = []
    pilot.ask = asked.append  # pyright: ignore[reportAttributeAccessIssue]
    page.build()
    assert asked == []
    ui.clicked = {action}
    page.build()
    assert asked == [action] and ui.depth == 0


def test_sliders_have_the_trained_limits_and_drive() -> None:
    page, ui, _, pilot = panel()
    page.build()
    assert [ui.ranges[name] for name in ("vx [m/s]", "vy [m/s]", "yaw rate [rad/s]")] == [
        (each.low, each.high) for each in THREE
    ]
    ui.dragged = {"vy [m/s]": -0.3}
    page.build()
    pilot.listen()
    assert np.allclose(pilot.command, [0.25, -0.3, 0.25])  # the others stay as the robot follows them
    page.steer(0, 0.5)
    page.steer(2, -0.1)  # two fingers, before the session's next turn
    pilot.listen()
    assert np.allclose(pilot.command, [0.5, -0.3, -0.1])
    ui.dragged = {"push [m/s]": 2.5}
    page.build()
    assert pilot.push_speed == 2.5
    ui.clicked = {"drive all robots"}
    page.build()
    pilot.listen()
    assert pilot.everyone


def test_a_panel_has_a_slider_and_a_curve_for_each_command_of_the_table() -> None:
    page, ui, plot, pilot = panel(1, (HEIGHT, *THREE[:2], Command("gait", 0.0, 3.0)))
    page.build()
    assert {name: ui.ranges[name] for name in ("base height [m]", "gait")} == {
        "base height [m]": (0.2, 0.3),
        "gait": (0.0, 3.0),
    }
    assert [(label, len(ys)) for label, _, ys in plot.lines[:4]] == [
        *(("measured##base_height", 0), ("command##base_height", 1)),  # the first colour is for what is measured
        *(("measured##lin_vel_x", 1), ("command##lin_vel_x", 1)),
    ]
    ui.dragged = {"base height [m]": 0.22}
    page.build()
    pilot.listen()
    assert np.allclose(pilot.command, [0.22, 0.25, 0.25, 0.25])
    page, ui, plot, pilot = panel(1, ())
    page.build()
    assert NO_COMMANDS in ui.seen and list(ui.ranges) == ["push [m/s]"] and not plot.lines and ui.depth == 0


def test_keys_of_the_page_are_those_of_the_window_unless_somebody_types() -> None:
    assert set(KEY_NAMES.values()) < set(KEY_ACTION)
    page, ui, _, pilot = panel()
    for ui.typing, studio, world in ((True, True, 0), (True, False, 1), (False, True, 0)):
        page.build()
        for key in ("ArrowUp", "N", "Unidentified"):
            page.press(key, studio)
        pilot.listen()
        assert pilot.world == world and pilot.driving == (not (ui.typing and studio))


def test_a_panel_offers_what_its_pilot_can_and_no_more() -> None:
    """As of a real robot: in other words, without sliders, and other keys do nothing."""
    page, ui, _, _ = panel(1)
    page.pilot = pilot = Pilot(THREE, 1, only={"reset": "Damp", "camera": ""})
    ui.clicked = {"reset"}
    page.build()
    for key in ("ArrowUp", "P", "Enter"):
        page.press(key, studio=True)
    page.steer(0, 1.0)
    pilot.listen()
    assert [text for text in ui.seen if "###" in text] == ["Damp###reset", "View: follow###camera"] and not ui.ranges
    assert pilot.take_resets() == [0] and not (pilot.driving or pilot.paused or pilot.take_pushes())
    assert "Damp" in ui.seen and "slow motion" not in ui.seen and ui.depth == 0
    assert page.moment and window_texts(page.moment._replace(help=True), pilot.bindings)[1][2] == "r backspace\nc"


def test_the_panel_is_folded_once_when_the_screen_is_narrow() -> None:
    page, ui, _, _ = panel()
    for ui.width, folded in ((1280.0, False), (390.0, True), (390.0, False), (0.0, False)):
        ui.folded = False
        page.build()
        assert ui.folded == folded


def test_one_robot_has_no_next_one_and_speed_goes_round() -> None:
    page, ui, _, pilot = panel(1)
    ui.clicked = {"slower"}
    for speed in (*SPEEDS[1:], SPEEDS[0]):
        page.build()
        pilot.listen()
        assert pilot.speed == speed
    assert not any("###next" in label for label in ui.seen) and "falls" in ui.seen and "3" in ui.seen


def test_curves_are_of_the_last_seconds_and_the_panel_closes_what_it_opens() -> None:
    page, ui, plot, _ = panel(1)
    page.curves = Curves(3)
    for step in range(2000):
        now = np.full((1, 3), 0.001 * step)
        page.show(Moment(step * 0.02, np.zeros((1, 7)), now, now, -now, np.ones((1, 4), dtype=bool)))
    page.build()
    assert len(plot.lines) == 6 and plot.depth == 0
    label, times, values = plot.lines[0]
    assert (
        label.startswith("measured")
        and len(times) == 100
        and -CURVE_SECONDS < times[0] < -0.95 * CURVE_SECONDS
        and times[-1] == 0
    )
    assert values[-1] == pytest.approx(-1.995, abs=0.01)

    def broken(*_: Any) -> None:
        raise RuntimeError("no plot today")

    plot.SetupAxes = broken  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(RuntimeError):
        page.build()
    assert ui.depth == 0 and plot.depth == 0


# ---- the environment as a stage


def test_the_environment_follows_the_pilot() -> None:
    env = make_env(2, {"env.episode_length_s": 100.0, "observations.history": {"state.commands": 2}})
    seen: list[Any] = []

    def policy(obs: Any) -> Any:
        seen.append(obs["state"][:, -3:].clone())
        return env.actions * 0.0

    stage: Stage = EnvStage(env, policy)
    assert stage.command_table == env.command_table and EnvStage(env, policy, THREE).command_table == THREE
    stage.step(None)
    commands = stage.commands()
    commands[1] = (0.5, -0.2, 0.3)
    stage.step(commands)
    # in the same step, in that world alone
    assert np.allclose(seen[-1][1], (0.5, -0.2, 0.3)) and np.allclose(seen[-1][0], commands[0])
    assert np.allclose(stage.commands(), commands)
    before = stage.velocity()
    stage.push(0, np.array([0.0, 2.0]))
    stage.step(None)
    after = stage.velocity()
    assert np.linalg.norm(after[0, :2] - before[0, :2]) > 1 and np.linalg.norm(after[1, :2] - before[1, :2]) < 1
    stage.reset(1)
    qpos = stage.qpos()
    assert (
        qpos.shape == (2, stage.spec.compile().nq)
        and qpos.dtype == np.float64
        and np.allclose(qpos[1, 2], env.init_pos[2])
    )
    assert stage.contacts().shape == (2, 4) and not stage.fell().any()
    kept = stage._obs["state"].clone()  # pyright: ignore[reportAttributeAccessIssue]
    stage.step(commands * 0.5)
    assert np.array_equal(seen[-1], commands.astype(np.float32) * 0.5) and not np.array_equal(kept[:, -3:], seen[-1])
    env.fell.fill_(True)
    assert stage.fell().all()


def test_a_command_is_written_where_the_policy_sees_it_also_in_a_group_of_a_group() -> None:
    env = make_env(2, {**QUIET, "observations.history": {"state.commands": 2}})
    stage = EnvStage(env, lambda obs: env.actions * 0.0)
    wanted = np.array([[0.5, -0.2, 0.3], [0.1, 0.2, -0.3]])
    seen: list[Any] = []
    stage.policy = lambda obs: seen.append({name: value.clone() for name, value in obs.items()}) or env.actions * 0.0
    before = {name: value.clone() for name, value in env.obs_buf.items()}
    stage.step(wanted)
    columns = env.observations.newest("state", "commands")
    for group in ("state", "privileged_state"):  # the second begins with the first
        assert np.allclose(seen[0][group][:, columns], wanted)
        rest = np.delete(np.arange(seen[0][group].shape[1]), np.arange(columns.start, columns.stop))
        assert np.array_equal(seen[0][group][:, rest], before[group][:, rest])
    stage.step(None)
    older = slice(columns.start - 3, columns.start)
    assert np.allclose(seen[1]["state"][:, older], wanted)  # its history is of what the policy saw


def test_a_gait_clock_runs_or_rests_by_the_command_that_is_seen_with_it() -> None:
    settings = {**QUIET, "gait.period": 0.8, "gait.offsets": [0.0, 0.5, 0.5, 0.0], "gait.random_start": False}
    env = make_env(2, settings)
    seen: list[Any] = []
    stage = EnvStage(env, lambda obs: seen.append(obs["state"].clone()) or env.actions * 0.0)
    clock = env.observations.newest("state", "gait_clock")
    walk_and_stand = np.array([[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])
    for commands in (0.0 * walk_and_stand, walk_and_stand, 0.0 * walk_and_stand):
        stage.step(commands)
    starts = [0.0] * 4 + [1.0, -1.0, -1.0, 1.0]  # sines, then cosines, of phases 0, 0.5, 0.5, 0
    for at, wanted in enumerate([[0.0] * 8, starts, [0.0] * 8]):
        assert np.allclose(seen[at][0, clock], wanted, atol=1e-6) and not seen[at][1, clock].any()


def test_a_task_without_commands_and_feet_is_a_stage_too() -> None:
    go1 = load_task("go1_flat").cfg

    class Cfg(RobotTaskCfg):
        class env(RobotTaskCfg.env):
            num_envs = 2

        class asset(RobotTaskCfg.asset):
            file = go1.asset.file
            colliders = go1.asset.colliders

        class init_state(RobotTaskCfg.init_state):
            pos = go1.init_state.pos
            default_joint_angles = go1.init_state.default_joint_angles

        class control(RobotTaskCfg.control):
            stiffness = go1.control.stiffness
            damping = go1.control.damping

    env = RobotTask(Cfg(), "cpu")
    stage: Stage = EnvStage(env, lambda obs: env.actions * 0.0)
    assert stage.command_table == () and stage.commands().shape == (2, 0) and stage.contacts().shape == (2, 0)
    viewer = FakeViewer(Pilot(stage.command_table, 2), {1: "up", 2: "p", 3: "r"}, until=4)
    outcome = Session(stage, viewer, viewer.pilot, real_time=False).run()
    assert outcome.seconds == pytest.approx(4 * env.dt) and stage.velocity().shape == (2, 3) and stage.ground(0) == ""


def test_watching_needs_no_torch() -> None:
    """What a robot's computer has is enough: all of view/ but playing.py."""
    modules = [
        path.stem
        for path in (legged_mw.ROOT / "legged_mw/view").glob("*.py")
        if path.stem not in ("playing", "__init__", "studio")
    ]
    code = "import sys\nfor name in ('torch', 'warp', 'rsl_rl', 'mujoco_warp'): sys.modules[name] = None\nimport "
    code += ", ".join(f"legged_mw.view.{name}" for name in modules)
    subprocess.run([sys.executable, "-c", code], check=True, cwd=legged_mw.ROOT)
