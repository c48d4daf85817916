"""How many Newton and line-search iterations a task's physics needs: what each setting costs, and what it gets wrong.

    python benchmarks/solver.py --task g1_flat --load_run shipped
    python benchmarks/solver.py --task g1_flat --load_run shipped --settings 3/5 3/10 3/20 50/50
    python benchmarks/solver.py --task go1_flat --device cpu --num_envs 64

For each setting, unless told else 1 / 5 to 50 / 50 Newton / line-search iterations, the policy walks in an environment stepped with
that setting (without ``--load_run``: random actions). Then:

- penetration: depth of the contacts with the ground [mm], mean and worst, over the worlds as the walk left them;
- slip: speed along the ground [mm/s], mean, of geoms that touch it both before and after the last control step;
- joint error [mrad], rms: joint angles one control step ahead, against the last setting's from the same states. The states
  are those of the last setting's walk, in the model as the file has it, without randomization, servos at their last targets;
- falls: robots that fell, in the walk, a world and minute;
- ms: the environment's step, median of rounds.

Penetration and slip are computed by C MuJoCo from positions and velocities alone, for both engines alike.
"""

from __future__ import annotations

import argparse
import copy
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.policies import act, find_policy, load_policy, load_trained
from legged_mw.sim.engines import make_simulation
from legged_mw.sim.ground import GROUND
from legged_mw.sim.simulation import Simulation
from legged_mw.utils.cli import apply_overrides, make_parser, one_line_errors, pick_device, seed_everything
from legged_mw.utils.machine import usable_cores
from legged_mw.utils.task import LoadedTask, load_task

# Newton, line search; the last is what the others are held against
SETTINGS = ((1, 5), (3, 10), (5, 10), (10, 20), (50, 50))
ROUNDS, CALLS = 5, 20  # of timing
SETTLED = 0.5  # [s] since a reset; a robot that was just put down says nothing of the solver

Actions = Callable[[RobotTask], Tensor]


class State(NamedTuple):
    """What a world is stepped from; tensors on the device."""

    qpos: Tensor
    qvel: Tensor
    ctrl: Tensor
    guess: Tensor  # of the solver: the engine's own, as it lies in it


class Walk(NamedTuple):
    """What a walk with one setting leaves."""

    state: State
    depth: np.ndarray  # (contacts,) [m]
    slip: np.ndarray  # (geoms that stand,) [m/s]
    falls: float  # a world and minute
    seconds: float  # a step
    used: tuple[int, int]  # MuJoCo's own engine raises a low setting where the ground is a height field
    note: str  # what did not fit


def guess_of(sim: Simulation) -> Tensor:
    """The solver's first guess for the next substep, and MuJoCo's own rows of state around it: the engine's memory."""
    if sim.engine == "mujoco":
        return torch.from_numpy(sim._batch.state)  # type: ignore[attr-defined]
    import warp as wp

    return wp.to_torch(sim._data.qacc_warmstart)  # type: ignore[attr-defined]


def state_of(sim: Simulation) -> State:
    """A copy."""
    return State(sim.qpos.clone(), sim.qvel.clone(), sim.ctrl.clone(), guess_of(sim).clone())


class Ground:
    """Contacts with the ground at given positions and velocities, by C MuJoCo, a world after the other."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.ground = {i for i in range(model.ngeom) if model.geom_bodyid[i] == 0}
        assert model.geom(GROUND).id in self.ground

    def touching(self, qpos: np.ndarray, qvel: np.ndarray) -> dict[int, list[tuple[float, float]]]:
        """Depth [m] and speed along the ground [m/s] of each contact, by the geom of the robot that touches the ground."""
        model, data, found = self.model, self.data, {}
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        jacobian = np.zeros((3, model.nv))
        for contact in data.contact[: data.ncon]:
            pair = {int(contact.geom1), int(contact.geom2)}
            if contact.dist > 0 or len(pair & self.ground) != 1:
                continue
            (geom,) = pair - self.ground
            mujoco.mj_jac(model, data, jacobian, None, contact.pos, model.geom_bodyid[geom])
            along = np.array(contact.frame).reshape(3, 3)[1:] @ jacobian @ qvel
            found.setdefault(geom, []).append((-float(contact.dist), float(np.linalg.norm(along))))
        return found

    def compare(self, before: State, after: State, worlds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depths of all contacts ``after``, and speeds of the geoms that touch the ground in both."""
        depth, slip = [], []
        rows = [x.double().cpu().numpy() for x in (before.qpos, before.qvel, after.qpos, after.qvel)]
        for world in worlds:
            first, then = self.touching(*(x[world] for x in rows[:2])), self.touching(*(x[world] for x in rows[2:]))
            depth += [d for contacts in then.values() for d, _ in contacts]
            slip += [min(speed for _, speed in contacts) for geom, contacts in then.items() if geom in first]
        return np.array(depth or [0.0]), np.array(slip or [0.0])


def make_env(task: LoadedTask, setting: tuple[int, int], device: str) -> RobotTask:
    task.set("sim.iterations", setting[0])
    task.set("sim.ls_iterations", setting[1])
    seed_everything(task.train.seed)
    return task.env_class(task.cfg, device)


def walk(env: RobotTask, actions: Actions, steps: int) -> Walk:
    """Walk for ``steps`` control steps, then look at the contacts, then time the step."""
    fell, settled = torch.zeros((), device=env.device), torch.zeros(env.num_envs, device=env.device)
    before = state_of(env.sim)
    for i in range(steps):
        if i == steps - 1:
            before = state_of(env.sim)
        _, _, done, _ = env.step(actions(env))
        fell += env.fell.sum()
        settled = torch.where(done, 0.0, settled + env.dt)
    after = state_of(env.sim)
    worlds = ((settled > SETTLED) & after.qpos.isfinite().all(1)).nonzero()[:, 0].cpu().numpy()
    depth, slip = Ground(env.robot.physics).compare(before, after, worlds)
    seconds = statistics.median(timed(env, actions(env)) for _ in range(ROUNDS))
    falls = float(fell) / env.num_envs / (steps * env.dt / 60)
    option = env.robot.physics.opt
    return Walk(
        after, depth, slip, falls, seconds, (option.iterations, option.ls_iterations), env.sim.overflow_report()
    )


def timed(env: RobotTask, actions: Tensor) -> float:
    """Seconds a recorded step, ``actions`` held."""
    env.actions.copy_(actions)
    torch.cuda.synchronize() if env.device != "cpu" else None
    start = time.perf_counter()
    with torch.inference_mode():
        for _ in range(CALLS):
            env._graph()
    torch.cuda.synchronize() if env.device != "cpu" else None
    return (time.perf_counter() - start) / CALLS


def step_ahead(env: RobotTask, setting: tuple[int, int], state: State) -> Tensor:
    """Joint angles (N, D) a control step after ``state``, stepped with ``setting``."""
    model = copy.copy(env.robot.physics)
    model.opt.iterations, model.opt.ls_iterations = setting
    cfg = env.cfg.sim
    sim = make_simulation(
        model,
        env.num_envs,
        env.device,
        engine=cfg.engine,
        nconmax=cfg.nconmax,
        njmax=cfg.njmax,
        threads=cfg.threads,
        terrain=env.terrain,
    )
    guess_of(sim).copy_(state.guess)
    for name in ("qpos", "qvel", "ctrl"):
        getattr(sim, name).copy_(getattr(state, name))
    sim.step(env.cfg.control.decimation)
    return sim.qpos[:, 7:].clone()


def random_actions(env: RobotTask) -> Tensor:
    return 0.3 * torch.randn(env.num_envs, env.num_actions, device=env.device)


def chosen(args: argparse.Namespace, device: str) -> tuple[LoadedTask, Callable[[RobotTask], Actions], str]:
    """The task, what makes the actions for an environment of it, and whose they are, in words."""
    task = load_task(args.task)
    if args.load_run is None:
        apply_overrides(task, args)
        return task, lambda _: random_actions, "random actions"
    source = find_policy(task, args.load_run, args.checkpoint, args.experiment_name)
    task = load_trained(args.task, source)
    apply_overrides(task, args)

    def policy(env: RobotTask) -> Actions:
        network = load_policy(source.checkpoint, env, task.train, device)
        return lambda env: act(network, env.get_observations())

    return task, policy, f"policy {source.checkpoint}"


def setting(text: str) -> tuple[int, int]:
    """ "3/10": Newton and line-search iterations."""
    newton, _, search = text.partition("/")
    return int(newton), int(search)


def main() -> None:
    parser = make_parser(__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "--settings", type=setting, nargs="+", default=SETTINGS, metavar="N/L", help="Newton / line search, best last"
    )
    parser.add_argument("--steps", type=int, default=200, help="control steps of a walk")
    args = parser.parse_args()
    args.task, device = args.task or "go1_flat", pick_device(args.device)
    args.num_envs = args.num_envs or (64 if device == "cpu" else 4096)
    torch.set_num_threads(1 if device == "cpu" else torch.get_num_threads())  # as train.py does
    task, make_actions, whose = chosen(args, device)
    name = torch.cuda.get_device_name(device) if device != "cpu" else f"CPU, {usable_cores()} cores"
    walks = {}
    for pair in args.settings:
        env = make_env(task, pair, device)
        walks[pair] = walk(env, make_actions(env), args.steps)
    print(
        f"{args.task} on {name}, engine {env.sim.engine}, {args.num_envs} worlds, {args.steps} steps, {whose}; mujoco {mujoco.__version__}"
    )
    state = walks[args.settings[-1]].state
    best = step_ahead(env, args.settings[-1], state)
    print(
        "| Newton | line search | penetration mean, worst [mm] | slip [mm/s] | joint error [mrad] | falls [1/min] | step [ms] |"
    )
    print("| ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for pair, result in walks.items():
        error = (step_ahead(env, result.used, state) - best).double()
        rms = float(error[error.isfinite().all(1)].square().mean().sqrt())
        print(
            f"| {pair[0]} | {pair[1]} | {1e3 * result.depth.mean():.2f}, {1e3 * result.depth.max():.1f} | {1e3 * result.slip.mean():.1f} "
            f"| {1e3 * rms:.3f} | {result.falls:.2f} | {1e3 * result.seconds:.2f} |",
            flush=True,
        )
    for pair, result in walks.items():
        if result.used != pair:
            print(
                f"{pair[0]} / {pair[1]}: stepped with {result.used[0]} / {result.used[1]}, which this engine needs on this ground"
            )
        if result.note:
            print(f"{pair[0]} / {pair[1]}: {result.note}")


if __name__ == "__main__":
    with one_line_errors():
        main()
