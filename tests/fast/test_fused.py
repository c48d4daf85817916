"""A fused step is the step as it is written: operation by operation, and whole tasks."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from legged_mw.check.held import everything
from legged_mw.envs.robot_task import RobotTask
from legged_mw.fast.fused import Fused, Kernel, Region
from legged_mw.fast.fused_code import ASSIGN
from legged_mw.fast.step_compiler import fused as fuse
from legged_mw.fast.step_compiler import fused_step, remember
from legged_mw.fast.trace import Trace
from legged_mw.utils.math import assign
from legged_mw.utils.opaque import not_traced, traces
from legged_mw.utils.task import load_task

N = 16


class Memory:
    """Fixed tensors, as a step has them."""

    def __init__(self) -> None:
        draw = torch.Generator().manual_seed(7)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=draw)

        self.a, self.b, self.row, self.quat = normal(N, 5), normal(N, 5), normal(5), normal(N, 2, 4)
        self.out, self.one, self.wide = torch.zeros(N, 5), torch.zeros(N), torch.zeros(N, 3, 4)
        self.flags, self.count = normal(N, 5) > 0.0, torch.zeros(N, dtype=torch.long)
        self.table, self.places = normal(9, 3), torch.randint(9, (N, 4), generator=draw)
        self.sums, self.history = torch.zeros(5), normal(N, 4, 3)
        self.a[0, 0], self.b[1, 1] = math.nan, math.inf

    def all(self) -> list[Tensor]:
        return list(vars(self).values())


def fused(fn: Callable[[], None]) -> Fused:
    with Trace() as trace:
        fn()
    return Fused(trace, N, "cpu")


def left_to_torch(program: Fused) -> list[str]:
    return [
        step.name
        for part in program.parts
        if isinstance(part, Region)
        for step in part.steps
        if not isinstance(step, Kernel)
    ]


def arithmetic(m: Memory) -> None:
    m.out.copy_((m.a * 2.0 - m.b / 3.0 + m.row).clamp(-2.0, 2.0))
    m.out.addcmul_(m.a, m.row, value=0.5).sub_(1.0, alpha=2).mul_(m.b.abs())
    m.out.masked_fill_(m.flags, 0.25)
    torch.lerp(m.a, m.b, torch.sigmoid(m.row), out=m.b)
    m.a.copy_(torch.where(m.flags & (m.a > m.row), m.a.square().sqrt(), torch.exp(-m.a) + torch.atan2(m.a, m.b)))
    m.a.add_(torch.sin(m.b) * torch.cos(m.b)).remainder_(math.pi)


def reductions(m: Memory) -> None:
    m.one.copy_(m.a.amax(dim=1) + m.b.clamp(-9.0, 9.0).sum(dim=1) + m.quat.norm(dim=2).mean(dim=1))
    m.count.add_(m.flags.sum(dim=1))
    m.count.add_((~m.flags.all(dim=1) | m.flags.any(dim=1)).long())
    m.out.copy_((m.a == m.a.amax(dim=1, keepdim=True)).float())


def places(m: Memory) -> None:
    m.wide.copy_(m.table[m.places].mT)
    m.out[:, 1:3] = m.a.index_select(1, torch.tensor([4, 0]))
    m.out[:, 3:].copy_(torch.gather(m.b, 1, m.places[:, :2] % 5))
    m.a.copy_(torch.cat([m.b[:, 2:], m.out[:, :2]], dim=1))
    m.history[:, 1:] = m.history[:, :-1].clone()
    m.history[:, 0] = torch.linalg.cross(m.history[:, 1], m.quat[:, 0, 1:])
    m.one.copy_(torch.stack([m.one, m.a[:, 0]], dim=1) @ m.table[:2, 0])
    m.history[:, :-1] = m.history[:, 1:]  # of memory that overlaps


def shared(m: Memory) -> None:
    """What all worlds share is computed by each; a sum over them is read by a later kernel."""
    low, high = torch.stack([m.row, m.row + 2.0]).unbind()
    m.out.copy_(m.a.clamp(low, high))
    m.sums.add_(m.out.sum(dim=0))
    m.one.copy_(m.out[:, 0] - m.sums[0])


def masked(m: Memory) -> None:
    assign(m.wide[:, 1], m.flags[:, 0], m.quat[:, 0])
    m.a.copy_(torch.where(m.flags, m.row, m.a))
    m.b[:, 1:].copy_(torch.where(m.flags[:, :1], m.b[:, :-1], m.b[:, 1:]))  # a value of the same memory
    m.count.masked_fill_(m.flags[:, 1], 3)
    m.quat[:, 0].copy_(torch.where(m.flags[:, :1], m.quat[:, 0], m.quat[:, 1]))  # no assignment: all is written
    chosen = torch.where(m.flags[:, 2:3], 1.0, m.history[:, 0])
    m.history[:, 0].copy_(chosen)
    m.one.copy_(chosen.sum(dim=1))  # what was chosen is read twice


STEPS = {"arithmetic": arithmetic, "reductions": reductions, "places": places, "shared": shared, "masked": masked}


@pytest.mark.parametrize("name", STEPS)
def test_operations_give_what_torch_gives(name: str) -> None:
    step = STEPS[name]
    torch_s, ours = Memory(), Memory()
    program = fused(lambda: step(ours))
    for own, other in zip(ours.all(), torch_s.all(), strict=True):
        own.copy_(other)
    program.compile()
    assert program.verify() == 0
    step(torch_s)
    for _ in range(2):
        step(torch_s)
        program()
    for i, (own, other) in enumerate(zip(ours.all(), torch_s.all(), strict=True)):
        torch.testing.assert_close(
            own, other, rtol=1e-5, atol=1e-5, equal_nan=True, msg=lambda text, i=i: f"{[*vars(ours)][i]}: {text}"
        )


def test_what_does_not_fit_is_left_to_torch() -> None:
    memory = Memory()

    def step() -> None:
        memory.one.copy_(memory.a.cumsum(dim=1)[:, 2] + torch.rand(N))
        memory.sums.add_(memory.a.sum(dim=0))
        memory.out.copy_(memory.a.roll(1, dims=0))  # another world's values

    assert sorted(left_to_torch(fused(step))) == ["cumsum", "rand", "roll"]


def test_a_value_of_another_world_is_not_read_in_the_kernel_that_writes_it() -> None:
    memory = Memory()

    def step() -> None:
        memory.a.mul_(2.0)
        memory.out.copy_(memory.a[:1].expand(N, 5))  # every world reads the first one's
        memory.a.mul_(3.0)

    program = fused(step)
    assert [len(kernel.nodes) for kernel in program.kernels] == [1, 1, 1]


def test_random_numbers_are_those_of_the_step_as_it_is() -> None:
    kept = [Memory(), Memory()]

    def step(m: Memory) -> None:
        m.out.copy_(torch.rand(N, 5) + torch.rand_like(m.a) * 2.0)
        m.one.copy_(torch.empty(N).exponential_())
        m.b.uniform_(-1.0, 1.0)

    program = fused(lambda: step(kept[0]))
    program.compile()
    program.verify()
    for run in (program, lambda: step(kept[1])):
        torch.manual_seed(3)
        run()
    for name in ("out", "one", "b"):
        torch.testing.assert_close(getattr(kept[0], name), getattr(kept[1], name))


def test_an_assignment_is_one_operation() -> None:
    """What it leaves alone is neither read nor written."""
    m = Memory()
    program = fused(lambda: assign(m.out, m.flags[:, 0], m.a))
    assert [node.func for kernel in program.kernels for node in kernel.nodes] == [ASSIGN]
    watched = Trace([m.out])
    with watched:
        assign(m.out, m.flags[:, 0], m.a)
    assert left_to_torch(Fused(watched, N, "cpu")) == ["copy"]  # of a value that a kernel chose


def test_a_sum_that_is_read_twice_is_a_sum() -> None:
    memory = Memory()

    def step() -> None:
        ended = memory.flags[:, 0].float().sum(dim=0)
        memory.sums[0].add_(ended)
        memory.sums[1].copy_(ended / N)

    program = fuse(step, N, {"sums": memory.sums})
    memory.flags.fill_(True)
    program()
    assert memory.sums[1] == 1.0


def test_a_sum_of_what_is_not_of_worlds_is_torchs() -> None:
    memory = Memory()
    program = fuse(lambda: [memory.row[:3].add_(memory.table.sum(dim=0))].clear(), N, {"row": memory.row})
    before = memory.row.clone()
    program()
    torch.testing.assert_close(memory.row[:3], before[:3] + memory.table.sum(dim=0))
    assert left_to_torch(program) == ["sum", "add"] or not program.kernels  # type: ignore[arg-type, union-attr]


def test_a_value_that_all_share_is_changed_once() -> None:
    memory = Memory()

    def step() -> None:
        half = memory.table.sum(dim=0)
        half.mul_(0.5)
        memory.out[:, :3].copy_(torch.where(memory.flags[:, :1], half, memory.b[:, :3]))

    memory.flags.fill_(False)  # rare at the check
    program = fuse(step, N, {"out": memory.out})
    memory.flags.fill_(True)
    program()
    torch.testing.assert_close(memory.out[:, :3], (memory.table.sum(dim=0) * 0.5).expand(N, 3))


def test_calls_of_the_simulator_stay_where_they_are() -> None:
    memory, calls = Memory(), list[float]()

    class Engine:
        @not_traced
        def step(self, given: Tensor) -> None:
            calls.append(float(given[0]))
            memory.a.add_(1.0)

    engine = Engine()

    def step() -> None:
        target = memory.b[:, 1:2] * 2.0  # for the engine alone
        engine.step(target[:, 0])
        memory.out.copy_(memory.a * 2.0)

    program = fused(step)
    program.compile()
    assert program.verify() == 0 and len(program.kernels) == 2 and not traces
    memory.b[0, 1] = 4.0
    before = memory.a[2, 2].item()
    program()
    assert calls[-1] == 8.0 and memory.out[2, 2].item() == pytest.approx(2.0 * (before + 1.0))


def test_a_part_that_gives_other_values_stays_as_it_is(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = Memory()
    monkeypatch.setattr(Kernel, "__call__", lambda self: memory.out.zero_())
    step = fuse(lambda: [memory.out.copy_(memory.row * 2.0 + memory.b)].clear(), N, {"out": memory.out})
    step()
    assert capsys.readouterr().out == "1 of 1 parts of the step are not fused: they gave other values\n"
    torch.testing.assert_close(memory.out, memory.row * 2.0 + memory.b)


def test_what_torch_does_not_see_leaves_the_step_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    memory = Memory()
    numbers = memory.one.numpy()

    def step() -> None:
        memory.out.copy_(memory.b * 2.0)
        numbers[:] += 1.0

    assert fuse(step, N, {"out": memory.out, "one": memory.one}) is step and not numbers.any()
    said = "the step is not fused: one is another than by the step as it is written; does it do something that torch does not see?\n"
    assert capsys.readouterr().out == said


def test_a_compiler_that_fails_leaves_the_step_as_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    memory = Memory()
    monkeypatch.setattr(Fused, "compile", lambda self: 1 / 0)

    def step() -> None:
        memory.out.add_(1.0)

    assert fuse(step, N, {"out": memory.out}) is step and not memory.out.any()
    assert capsys.readouterr().out == "the step is not fused: division by zero\n"


def test_what_a_call_returns_is_there_when_it_is_called_again() -> None:
    """As of the lookup of the ground's height, which is a kernel of warp."""
    memory = Memory()

    class Lookup:
        @not_traced
        def __call__(self, places: Tensor) -> Tensor:
            return places * 3.0

    lookup = Lookup()
    step = fuse(lambda: [memory.out.copy_(lookup(memory.b + 1.0) - 1.0)].clear(), N, {"out": memory.out})
    assert isinstance(step, Fused)
    memory.b.fill_(2.0)
    step()
    assert (memory.out == 8.0).all()


@pytest.fixture(scope="module")
def robot() -> RobotTask:
    task = load_task("go1_flat_dr")  # kicks, pushes, delays, drawn worlds
    for field, value in {"env.num_envs": 32, "env.episode_length_s": 0.4, "domain_rand.action_delay": [0, 2]}.items():
        task.set(field, value)
    torch.manual_seed(1)
    return task.env_class(task.cfg, "cpu")


def test_a_task_is_fused_into_few_kernels_and_does_what_it_did(
    robot: RobotTask, capsys: pytest.CaptureFixture[str]
) -> None:
    """From the same worlds and draws, over episodes that end: each step as it is, then fused."""
    program = fused_step(robot)
    assert isinstance(program, Fused) and "not fused" not in capsys.readouterr().out
    torch_s = {"rand", "rand_like", "exponential", "uniform"} | {"copy"}  # the last into what the engine watches
    assert len(program.kernels) <= 6 and {*left_to_torch(program)} <= torch_s

    def as_it_is() -> None:
        with Trace():  # so that it draws whether or not a world needs it
            robot._step()

    ended = 0
    for action in torch.randn(30, 32, 12):
        put_back = remember(everything(robot))
        robot._graph._fn = as_it_is
        obs, reward, done, extras = robot.step(action)
        put_back()
        robot._graph._fn = program
        obs_, reward_, done_, extras_ = robot.step(action)
        assert torch.equal(done, done_) and torch.equal(extras["time_outs"], extras_["time_outs"])
        torch.testing.assert_close(reward, reward_, rtol=1e-4, atol=1e-5)
        for group, value in obs.items():
            torch.testing.assert_close(value, obs_[group], rtol=1e-4, atol=1e-4)
        ended += int(done.sum())
    assert ended >= 32


def crowded(monkeypatch: pytest.MonkeyPatch) -> RobotTask:
    """More contacts than there is room for; as on a GPU, chance decides which worlds lose theirs."""
    task, chance = load_task("go1_flat"), torch.Generator().manual_seed(1)
    for field, value in {"env.num_envs": 32, "sim.engine": "mujoco_warp", "sim.nconmax": 1}.items():
        task.set(field, value)
    env = task.env_class(task.cfg, "cpu")
    for action in torch.randn(20, 32, 12):
        env.step(action)
    assert env.sim.overflowed_worlds() == 32
    step = env.sim.step

    @not_traced
    def by_chance(*args: object) -> None:
        step(*args)  # type: ignore[arg-type]
        lost = torch.rand(32, generator=chance) < 0.5
        env.sim.memory()["overflow"].bitwise_xor_(lost.int() * 4)
        env.sim.qvel[:, 6:].add_(lost[:, None] * 0.1)

    monkeypatch.setattr(env.sim, "step", by_chance)
    return env


def test_which_contacts_do_not_fit_does_not_decide_whether_a_step_is_fused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert isinstance(fused_step(crowded(monkeypatch)), Fused)
    assert "not fused" not in capsys.readouterr().out


def test_the_users_own_values_that_differ_are_named_first(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What torch does not see is found before and after the simulator's calls, whatever is different by chance."""
    env = crowded(monkeypatch)
    as_it_is, mine = env.actuators.apply, torch.zeros(32)
    numbers, speeds = mine.numpy(), env.sim.qvel.numpy()
    vars(env)["mine"] = mine

    def apply(actions: Tensor) -> None:
        as_it_is(actions)
        numbers[:] += 1.0
        speeds[:, 0] += 1.0

    monkeypatch.setattr(env.actuators, "apply", apply)
    fused_step(env)
    assert "not fused: mine, sim.qvel " in capsys.readouterr().out


def test_fusing_moves_no_world_and_no_draw(robot: RobotTask) -> None:
    before, draws = {name: value.clone() for name, value in everything(robot).items()}, torch.get_rng_state()
    assert isinstance(fused_step(robot), Fused)
    assert torch.equal(torch.get_rng_state(), draws)
    for name, value in everything(robot).items():
        assert torch.equal(value, before[name]), name
