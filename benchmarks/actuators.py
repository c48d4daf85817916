"""What each motor law costs: time of the environment's step, as a ratio to servos measured in turns with it in the same run.

    python benchmarks/actuators.py --num_envs 4096
    python benchmarks/actuators.py --device cpu --num_envs 256

Laws: servo, servo with ``domain_rand.delay_ms``, dc_motor, torque, a network that is an MLP of 32 and 32 units (of weights that make
it a servo), an LSTM as large as ANYmal's (two layers of 8), and a law in code: an overridden ``_compute_torques`` in torch, which is
the servo's law. All robots get the same random actions. An episode of each begins anew before it is timed, so that robots which
stand or fall otherwise do not meet other contacts than the servo's for long.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from legged_mw.envs.domain_rand import KINDS
from legged_mw.envs.robot_task import RobotTask
from legged_mw.sim.engines import ENGINES, pick_engine
from legged_mw.utils.cli import pick_device
from legged_mw.utils.machine import usable_cores
from legged_mw.utils.motor_network import MotorNetwork
from legged_mw.utils.task import load_task

# is drawn but what is added
NOTHING: dict[str, Any] = {"domain_rand.enable": True, **{f"domain_rand.{name}": [] for name in KINDS}}
SMALL = 0.02  # what goes into a softsign that should let it through


def servo_network(kp: float, kd: float) -> MotorNetwork:
    """kp error - kd speed, nearly, by 32 and 32 softsigns from three errors and three speeds."""
    first, second, last = np.zeros((32, 6)), np.zeros((32, 32)), np.zeros((1, 32))
    first[0, 0], first[1, 3] = SMALL, SMALL / 10.0
    second[0, 0] = second[1, 1] = 1.0
    last[0, :2] = kp / SMALL, -10.0 * kd / SMALL
    layers = [(w.astype(np.float32), np.zeros(len(w), dtype=np.float32)) for w in (first, second, last)]
    return MotorNetwork([], layers, "softsign", (0, 1, 2))


def lstm_network() -> MotorNetwork:
    """Two layers of 8 units with small random weights."""
    dice = np.random.default_rng(0)
    shapes = (((32, 2), (32, 8), (32,), (32,)), ((32, 8), (32, 8), (32,), (32,)))
    layers = [tuple(0.1 * dice.standard_normal(shape).astype(np.float32) for shape in layer) for layer in shapes]
    head = (dice.standard_normal((1, 8)).astype(np.float32), np.zeros(1, dtype=np.float32))
    return MotorNetwork(layers, [head], "elu", (0,))  # type: ignore[arg-type]


def make_env(task_name: str, law: str, num_envs: int, device: str, engine: str, folder: Path, steps: int) -> RobotTask:
    """The task's environment with motors of ``law``, fused as for a training of so many ``steps``."""
    task = load_task(task_name)
    task.set("env.num_envs", num_envs)
    task.set("sim.engine", engine)
    gains = task.cfg.control.stiffness, task.cfg.control.damping
    fields: dict[str, Any] = {
        "servo": {},
        "servo, 0 to 20 ms late": {**NOTHING, "domain_rand.delay_ms": [0.0, 20.0]},
        "dc_motor": {"control.actuator": "dc_motor"},
        "torque": {"control.actuator": "torque", "control.action_scale": 5.0},
        "network, 32-32 MLP": {"control.actuator": "network", "control.network": str(folder / "mlp.npz")},
        "network, 2 x 8 LSTM": {"control.actuator": "network", "control.network": str(folder / "lstm.npz")},
        "_compute_torques": {},
    }[law]
    if law == "dc_motor" and not task.cfg.control.no_load_speed:
        fields |= {"control.stall_torque": {"": 30.0}, "control.no_load_speed": {"": 30.0}}
    for path, value in fields.items():
        task.set(path, value)
    np.savez(folder / "mlp.npz", **servo_network(max(gains[0].values()), max(gains[1].values())).to_arrays())
    np.savez(folder / "lstm.npz", **lstm_network().to_arrays())
    env_class = task.env_class
    if law == "_compute_torques":

        class Coded(task.env_class):  # type: ignore[name-defined]
            def _compute_torques(self, actions: Tensor) -> Tensor:
                return super()._compute_torques(actions)

        env_class = Coded
    torch.manual_seed(0)
    env = env_class(task.cfg, device)
    env.fuse(steps)
    return env


LAWS = (
    "servo",
    "servo, 0 to 20 ms late",
    "dc_motor",
    "torque",
    "network, 32-32 MLP",
    "network, 2 x 8 LSTM",
    "_compute_torques",
)


def timed(env: RobotTask, actions: list[Tensor]) -> float:
    """Seconds a step, from the start of episodes on."""
    env.reset()
    if env.device != "cpu":
        torch.cuda.synchronize()
    start = time.perf_counter()
    for action in actions:
        env.actions.copy_(action)
        env._graph()
    if env.device != "cpu":
        torch.cuda.synchronize()
    return (time.perf_counter() - start) / len(actions)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="go1_flat")
    parser.add_argument("--num_envs", type=int, default=None)
    parser.add_argument("--device", default=None)
    parser.add_argument("--engine", choices=ENGINES, default="auto")
    parser.add_argument("--calls", type=int, default=50, help="steps a round")
    parser.add_argument("--rounds", type=int, default=9)
    args = parser.parse_args()
    device = pick_device(args.device)
    worlds = args.num_envs or (256 if device == "cpu" else 4096)
    torch.set_num_threads(1 if device == "cpu" else torch.get_num_threads())  # as train.py does
    name = torch.cuda.get_device_name(device) if device != "cpu" else f"CPU, {usable_cores()} cores"
    print(f"{args.task}, {worlds} worlds on {name}, engine {pick_engine(args.engine, device)}")
    with tempfile.TemporaryDirectory() as folder:
        envs = {
            law: make_env(args.task, law, worlds, device, args.engine, Path(folder), args.calls * args.rounds)
            for law in LAWS
        }
    joints = next(iter(envs.values())).num_actions
    actions = [0.3 * torch.randn(worlds, joints, device=device) for _ in range(args.calls)]
    with torch.inference_mode():  # as in training
        for env in envs.values():
            timed(env, actions)  # compiles, records
        times = [{law: timed(env, actions) for law, env in envs.items()} for _ in range(args.rounds)]
    print(f"{'law':<26}{'step [ms]':>10}{'of servo':>10}")
    for law in LAWS:
        ratio = statistics.median(row[law] / row["servo"] for row in times)
        print(f"{law:<26}{1e3 * statistics.median(row[law] for row in times):>10.3f}{ratio:>10.3f}")


if __name__ == "__main__":
    main()
