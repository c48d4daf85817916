"""How far a training is: by iterations, by the clock, or by both; nobody waits here, the clock is the test's."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.rl import runner as planning
from legged_mw.rl.runner import Runner, TrainingSchedule, make_runner
from legged_mw.utils.task import LoadedTask, load_task


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time, to be set [s]."""
    now = [1000.0]
    monkeypatch.setattr(planning.time, "time", lambda: now[0])
    return now


def follow(
    plan: TrainingSchedule, clock: list[float], seconds: dict[int, float], pace: float, begin: int = 0, late: int = 0
) -> list[float]:
    """What is done in each iteration, of ``pace`` seconds or what ``seconds`` says of the n-th; heard of so many iterations ``late``."""
    done, iteration, estimates = [], begin, []
    while iteration < plan.last:
        done.append(plan.begin(iteration))
        iteration += 1
        clock[0] += seconds.get(len(done), pace)
        estimates.append((iteration, plan.iterations_left()))
        if len(estimates) > late:
            plan.end_after(*estimates[-1 - late])
    return done


def test_without_a_deadline_iterations_count(clock: list[float]) -> None:
    plan = TrainingSchedule(5)
    assert follow(plan, clock, {}, 3.0) == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert plan.last == 5 and plan.saved() == {}
    assert follow(TrainingSchedule(5), clock, {}, 3.0, begin=3) == [0.75, 1.0], (
        "a resumed one is where it would have been"
    )
    assert follow(TrainingSchedule(1), clock, {}, 3.0) == [0.0]


@pytest.mark.parametrize("late", [0, 1])
@pytest.mark.parametrize(
    "seconds",
    [
        {},
        {1: 40.0},
        {1: 2.0, 4: 0.3},
        {100: 3.0, 200: 3.0, 300: 3.0},
        dict.fromkeys(range(150, 999), 0.2),
        dict.fromkeys(range(99, 2000), 0.05),
    ],
    ids=["even", "kernels compile", "recorded", "exams", "slower", "faster"],
)
def test_the_last_iteration_that_the_time_has_room_for_is_annealed(
    clock: list[float], seconds: dict[int, float], late: int
) -> None:
    plan = TrainingSchedule(10**6, clock[0] + 60.0)
    done = follow(plan, clock, seconds, 0.1, late=late)
    assert done[0] == 0.0 and done[-1] == 1.0
    assert all(a <= b for a, b in pairwise(done)), "it never falls"
    assert abs(clock[0] - 1060.0) <= 0.2 * (1 + late), "to the iteration"
    assert plan.saved() == {"seconds": clock[0] - 1000.0}


def test_even_iterations_are_even_steps(clock: list[float]) -> None:
    done = follow(TrainingSchedule(10**6, clock[0] + 10.0), clock, {}, 0.1)
    steps = [after - before for before, after in pairwise(done[1:])]
    assert len(done) == 100 and steps == pytest.approx([1 / 98] * 98, rel=1e-3), (
        "after the first, whose time says nothing yet"
    )


def test_a_stall_before_the_end_is_no_jump_back(clock: list[float]) -> None:
    """The time is over before the next iteration: it stays where it was, nearly at the end."""
    done = follow(TrainingSchedule(10**6, clock[0] + 10.0), clock, {98: 5.0}, 0.1)
    assert len(done) == 98 and 0.97 < done[-1] <= 1.0


def test_iterations_may_end_first(clock: list[float]) -> None:
    plan = TrainingSchedule(11, clock[0] + 1000.0)
    assert follow(plan, clock, {}, 1.0) == pytest.approx([i / 10 for i in range(11)]) and plan.last == 11


def test_a_deadline_that_is_over_lets_one_iteration_be(clock: list[float]) -> None:
    assert follow(TrainingSchedule(100, clock[0] - 5.0), clock, {}, 1.0) == [0.0]


def test_time_before_counts(clock: list[float]) -> None:
    """Stopped half way and resumed with what was left, or asked for as much again after its end: it is half done."""
    done = follow(TrainingSchedule(10**6, clock[0] + 30.0, used=30.0), clock, {}, 0.1, begin=300)
    assert done[0] == 0.5 and done[-1] == 1.0 and all(a <= b for a, b in pairwise(done))
    late = TrainingSchedule(10**6, clock[0] - 1.0, used=30.0)
    assert late.done == 1.0, "resumed for less time than a start takes: it stays annealed"
    untimed = TrainingSchedule(1000, used=30.0)
    assert untimed.begin(300) == pytest.approx(300 / 999) and untimed.seconds >= 30.0, (
        "its iterations are its plan, its time is kept"
    )


# ---- in a runner


def small() -> LoadedTask:
    task = load_task("go1_flat")
    for path, value in {"env.num_envs": 4, "runner.num_steps_per_env": 8, "algorithm.desired_kl": 0.01}.items():
        task.set(path, value)
    task.train.actor.hidden_dims = task.train.critic.hidden_dims = [8]
    task.set("rewards.tracking_sigma_end", 0.05)
    return task


def timed(
    task: LoadedTask, clock: list[float], seconds: float, checkpoint: Path | None = None
) -> tuple[Runner, list[tuple[float, float, float]]]:
    """A runner that has learned for so long, each iteration 1 s, and the numbers of each iteration."""
    env = LeggedRobot(task.cfg, "cpu")
    runner = make_runner(env, task.train, None, "cpu")
    if checkpoint:
        runner.load(str(checkpoint))
    alg, update, seen = runner.alg, runner.alg.update, list[tuple[float, float, float]]()

    def one_second() -> dict:
        clock[0] += 1.0
        seen.append((alg.desired_kl, alg.entropy_coef, float(env.tracking_sigma)))
        return update()

    alg.update, runner.deadline = one_second, clock[0] + seconds  # type: ignore[method-assign]
    runner.learn(1000)
    return runner, seen


def test_a_training_of_a_given_time_ends_annealed_and_goes_on(clock: list[float], tmp_path: Path) -> None:
    runner, seen = timed(small(), clock, 5.0)
    kl, entropy, sigma = zip(*seen, strict=True)
    assert (kl[0], entropy[0], sigma[0]) == pytest.approx((0.01, 0.005, 0.2))
    assert (kl[-1], entropy[-1], sigma[-1]) == pytest.approx((0.003, 0.001, 0.05)) and len(
        kl
    ) == runner.schedule.last == 5
    assert list(kl) == sorted(kl, reverse=True) and runner.stop is None
    runner.save(str(tmp_path / "model_5.pt"))
    again, seen = timed(small(), clock, 5.0, tmp_path / "model_5.pt")
    assert seen[0][0] == pytest.approx(0.0065) and seen[-1][0] == pytest.approx(0.003), "five of ten seconds were over"
    assert again.schedule.saved() == {"seconds": 10.0} and again.current_learning_iteration == 10
