"""The report's figures, each from a record made by hand whose answer is known."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from legged_mw.eval import figures
from legged_mw.eval.figures import Record

DT = 0.02


def make(worlds: int = 1, steps: int = 500, fell: dict[int, int] | None = None, **signals: Any) -> Record:
    """A record of ``worlds`` whose commands are zero; each signal is broadcast to (T, N, ...)."""
    fell_at = np.full(worlds, math.inf)
    for world, step in (fell or {}).items():
        fell_at[world] = step
    return Record(
        DT,
        10.0,
        np.zeros((steps, worlds, 3)),
        fell_at,
        np.zeros((worlds, 2)),
        {k: np.asarray(v) for k, v in signals.items()},
    )


# ---- following the command


def test_tracking_errors_over_a_grid() -> None:
    """World i is off by i, 2 i and 3 i to either side in turn once it settled, and by more before."""
    off = np.arange(6)[None, :, None] * np.array([1.0, 2.0, 3.0]) * (-1.0) ** np.arange(500)[:, None, None]
    off[:100] = 99.0
    record = make(6, velocity=off + 0.5, fell={4: 7})._replace(commands=np.full((500, 6, 3), 0.5))
    vx, vy, yaw = figures.tracking_errors(record, 100, rows=2)
    assert vx == [[0, 1, 2], [3, None, 5]] and vy == [[0, 2, 4], [6, None, 10]]
    assert yaw[1] == pytest.approx([9, None, 15])


def test_rise_time_of_an_exponential() -> None:
    """1 - exp(-t / T) rises from 10 to 90 % in T ln 9, and does not overshoot."""
    time = np.arange(0.0, 3.0, DT)
    found = figures.step_response(time, 0.2 + 0.6 * (1.0 - np.exp(-time / 0.3)), 0.2, 0.8)
    assert found["rise_time"] == pytest.approx(0.3 * math.log(9.0), abs=0.003)
    assert found["overshoot"] == 0.0 and found["left"] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("target", [1.0, -0.5])
def test_overshoot_is_a_share_of_the_way(target: float) -> None:
    """From 0.5: up to 120 % of the way at half a second, then 90 % of it."""
    time = np.arange(0.0, 2.0, DT)
    way = np.where(time < 0.5, 2.4 * time, np.where(time < 1.0, 1.2, 0.9))
    found = figures.step_response(time, 0.5 + way * (target - 0.5), 0.5, target)
    assert found["overshoot"] == pytest.approx(0.2) and found["rise_time"] == pytest.approx(0.8 / 2.4)
    assert found["left"] == pytest.approx(-0.1 * (target - 0.5))


def test_a_target_that_is_not_reached_has_no_rise_time() -> None:
    time = np.arange(0.0, 1.0, DT)
    found = figures.step_response(time, np.full(len(time), 0.5), 0.0, 1.0)
    assert found == {"rise_time": None, "overshoot": None, "left": pytest.approx(-0.5)}


def test_a_twitch_is_no_response() -> None:
    """One that passes the target and comes back, and one that was not where it should begin."""
    time = np.arange(0.0, 2.0, DT)
    twitch = np.where((time > 0.2) & (time < 0.4), 1.2, 0.0)
    assert figures.step_response(time, twitch, 0.0, 1.0) == {
        "rise_time": None,
        "overshoot": None,
        "left": pytest.approx(-1.0),
    }
    assert figures.step_response(time, np.zeros(len(time)), -1.0, 0.0)["rise_time"] is None


def test_responses_to_each_step() -> None:
    """Three worlds asked for 1, 0, 1 at 2 s and 4 s, which they follow after 0.1 s; one falls and is left out."""
    asked, moved = np.zeros((300, 3, 3)), np.zeros((300, 3, 3))
    asked[:100, :, 1] = asked[200:, :, 1] = 1.0
    for world in range(3):
        moved[:105, world, 1] = moved[205:, world, 1] = 1.0 + 0.1 * (world - 1)
    found = figures.responses(make(3, 300, {2: 50}, velocity=moved)._replace(commands=asked), axis=1, begin=75)
    assert found["fell"] == 1 and found["time"][:2] == [0.0, DT] and len(found["mean"]) == 225
    assert found["commanded"][24:26] == [1.0, 0.0] and found["commanded"][124:126] == [0.0, 1.0]
    assert found["mean"][29:31] == [pytest.approx(0.95), 0.0]
    assert (found["low"][0], found["high"][0]) == (pytest.approx(0.9), 1.0)
    stop, start = found["numbers"]
    assert (stop["from"], stop["to"], start["from"], start["to"]) == (1.0, 0.0, 0.0, 1.0)
    assert start["rise_time"] == pytest.approx(0.8 * DT / 0.95) and start["left"] == pytest.approx(-0.05)
    assert (
        figures.responses(make(3, 300, {0: 1, 1: 1, 2: 1}, velocity=moved)._replace(commands=asked), 1, 75)["numbers"][
            0
        ]["rise_time"]
        is None
    )


def test_estimates_beside_the_truth_in_the_last_seconds() -> None:
    """Three worlds of five steps, of which two count; the second world fell."""
    time, world = np.arange(5.0)[:, None], np.array([0.0, 10.0, 20.0])
    truth = np.stack([time + world, -time - world, np.full((5, 3), 9.0)], axis=2)
    record = make(3, 5, fell={1: 3}, velocity=truth, estimate=truth[..., :2] + 0.5)
    found = figures.estimates(record, [(0.8, 0.0), (0.0, 0.5), (0.0, 0.0)], seconds=2 * DT)
    assert found["commands"] == [[0.8, 0.0], [0.0, 0.5], [0.0, 0.0]] and found["seconds"] == 2 * DT
    assert found["truth"] == [[3, 4, None, None, 23, 24], [-3, -4, None, None, -23, -24]]
    assert found["estimate"][0] == [3.5, 4.5, None, None, 23.5, 24.5]


# ---- gait


def trot(period: int, down: int, steps: int = 400) -> np.ndarray:
    """Two feet, half a period apart, each down for ``down`` of ``period`` samples."""
    phase = np.arange(steps)[:, None] + np.array([0, period // 2])
    return phase % period < down


def test_duty_factor_and_stride_frequency() -> None:
    contact = trot(period=20, down=12)
    assert figures.duty_factor(contact) == pytest.approx([0.6, 0.6])
    assert figures.stride_frequency(contact, DT) == pytest.approx(1 / (20 * DT))


def test_a_foot_that_chatters_does_not_stride() -> None:
    """One sample without contact in the middle of a stance is no swing; feet that stay down have no frequency."""
    contact = trot(period=20, down=12)
    contact[6::20, 0] = False
    assert figures.stride_frequency(contact, DT) == pytest.approx(1 / (20 * DT))
    assert figures.stride_frequency(np.ones((100, 4), dtype=bool), DT) == 0.0


def test_gaits_command_by_command() -> None:
    contact = np.stack([trot(20, 12), trot(25, 10)], axis=1)
    first, second = figures.gaits(
        make(2, 400, {1: 30}, contact=contact), 0, [(1.0, 0.0, 0.0), (0.0, 0.8, 0.0)], seconds=0.4
    )
    assert first["command"] == [1.0, 0.0, 0.0] and first["contact"] == contact[-20:, 0].T.astype(int).tolist()
    assert second == {"command": [0.0, 0.8, 0.0], "duty_factor": None, "stride_frequency": None, "contact": None}


# ---- joints


def test_share_of_saturation() -> None:
    """Of 100 samples: torque at its limit in 30, at 97 % of it in the others; position beyond its soft limits in 10, once each way."""
    torque = np.where(np.arange(100) < 30, -20.0, 19.4)[:, None, None].repeat(2, axis=2)
    position = np.where(np.arange(100) < 90, 0.1, 0.51)[:, None, None].repeat(2, axis=2)
    torque[:, :, 1] = 0.5
    limits = {
        "torque": (np.array([-20.0, -20.0]), np.array([20.0, 20.0])),
        "dof_pos": (np.array([-0.5, -9.0]), np.array([0.5, 9.0])),
        "dof_vel": (np.array([-np.inf, -3.0]), np.array([np.inf, 3.0])),
    }
    found = figures.joints(make(1, 100, torque=torque, dof_pos=position, dof_vel=np.full((100, 1, 2), 4.0)), 0, limits)
    assert found["torque"]["saturated"] == pytest.approx([0.3, 0.0]) and found["dof_pos"]["saturated"] == pytest.approx(
        [0.1, 0.0]
    )
    assert found["dof_vel"]["saturated"] == [None, 1.0] and found["dof_vel"]["low"] == [None, -3.0]
    edges, density = np.array(found["torque"]["edges"][0]), np.array(found["torque"]["density"][0])
    assert (np.diff(edges) * density).sum() == pytest.approx(1.0, abs=1e-3)


def test_what_fell_is_not_counted() -> None:
    torque = np.zeros((100, 2, 1))
    torque[:, 1] = 20.0
    limits = {"torque": (np.array([-20.0]), np.array([20.0]))}
    assert figures.joints(make(2, 100, {1: 5}, torque=torque), 0, limits)["torque"]["saturated"] == [0.0]
    assert figures.joints(make(2, 100, {0: 5, 1: 5}, torque=torque), 0, limits)["torque"]["saturated"] == []


def test_share_of_time_at_a_motors_envelope() -> None:
    """20 N m at rest, none at 25 rad/s, at most 15 N m: of 100 samples 20 are at its force limit, 30 on its curve, 50 within."""
    speed = np.repeat([0.0, 15.0, 15.0], [20, 30, 50])[:, None, None].repeat(3, axis=2)
    torque = np.repeat([-15.0, 8.0, 7.0], [20, 30, 50])[:, None, None].repeat(3, axis=2)
    torque[:, :, 1] = 0.0
    limits = figures.MotorLimits(
        *(np.array([sign * 15.0, sign * 15.0, sign * np.inf]) for sign in (-1.0, 1.0)),
        *(np.array([value, value, np.inf]) for value in (20.0, 25.0)),
    )
    knee, ankle = figures.envelopes(
        make(1, 100, torque=torque, motor_speed=speed), 0, ["knee", "knee", "ankle"], limits
    )
    assert knee["kind"] == "knee" and knee["at_limit"] == pytest.approx(0.25), "one of two joints in half of the time"
    assert np.sum(knee["counts"]) == 200 and np.sum(ankle["counts"]) == 100
    assert (ankle["at_limit"], ankle["envelope"]) == (None, None)
    line = knee["envelope"]
    at = np.interp([0.0, 12.5], line["speed"], line["high"])
    assert at == pytest.approx([15.0, 10.0], abs=0.01) and min(line["high"]) < 0.0


# ---- pushes, energy, reward


def test_survival_by_strength_and_direction() -> None:
    fell_at = np.full(32, math.inf)
    fell_at[[3, 16, 17]] = 300, 299, 301
    weak, strong = figures.survival(fell_at, 300)
    assert [k for k, stood in enumerate(weak) if not stood] == [3] and [
        k for k, stood in enumerate(strong) if not stood
    ] == [0]


def test_cost_of_transport() -> None:
    """10 kg at 0.5 m/s with 49.05 W costs 1; what creeps has no cost, what fell has no figure."""
    position, power = np.zeros((500, 3, 2)), np.full((500, 3), 49.05)
    power[:100] = 1000.0
    position[100] = [[1.0, 2.0], [0.0, 0.0], [0.0, 0.0]]
    end = np.array([[1.0 + 0.5 * 8 * 0.6, 2.0 + 0.5 * 8 * 0.8], [0.1, 0.0], [4.0, 0.0]])
    found = figures.transport(make(3, power=power, position=position, fell={2: 9})._replace(last_position=end), 100)
    assert found["speed"] == [pytest.approx(0.5), pytest.approx(0.0125), None]
    assert found["cost_of_transport"] == [pytest.approx(1.0), None, None]
    assert found["power"] == [pytest.approx(49.05), pytest.approx(49.05), None]


def test_reward_a_second() -> None:
    """Two worlds that gain 0.3 and 0.5 a second from a term, after a start that does not count; a third fell."""
    time = (np.arange(500) * DT)[:, None, None]
    gained = np.concatenate([0.3 * time, 0.5 * time, -7.0 * time], axis=1).repeat(2, axis=2)
    gained[:50] -= 3.0
    gained[:, :, 1] = 0.0
    found = figures.reward_shares(make(3, reward=gained, fell={2: 20}), 100, ["tracking", "nothing"])
    assert found == {"tracking": pytest.approx(0.4), "nothing": 0.0}
