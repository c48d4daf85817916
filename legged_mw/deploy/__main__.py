"""Run an exported policy without torch: python -m legged_mw.deploy DIR"""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path

import numpy as np

from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.exam import run_exam
from legged_mw.deploy.policy import Controller
from legged_mw.deploy.robot import Floats, Measurement, Robot
from legged_mw.deploy.runner import run
from legged_mw.deploy.simulated import MujocoRobot
from legged_mw.deploy.stage import STROLL, DeployStage
from legged_mw.deploy.udp import UdpRobot, UdpServer, parse_address
from legged_mw.eval import rules
from legged_mw.utils.cli import Parser, duration, one_line_errors, shown
from legged_mw.utils.errors import UserError

RESULT_FILE = "exam.json"


def parse() -> argparse.Namespace:
    parser = Parser(prog="python -m legged_mw.deploy", description=__doc__, allow_abbrev=False)
    parser.add_argument("folder", metavar="DIR", help="an export: play.py --export DIR, or export/ in the folder of a finished run")
    parser.add_argument("--eval", action="store_true", help=f"the walking exam; prints its table and writes DIR/{RESULT_FILE}")
    parser.add_argument("--out", metavar="FILE", help=f"where --eval writes (default: DIR/{RESULT_FILE})")
    parser.add_argument("--viewer", choices=("auto", "native", "web", "video", "none"), default="none", help="watch and drive it")
    parser.add_argument(
        "--command", metavar="VX,VY,YAW", help="fixed command [m/s, m/s, rad/s]; --command=-0.5,0,0 if it starts with a minus"
    )
    parser.add_argument("--time", type=duration, metavar="T", help="how long (default: 10s without a viewer, else until closed)")
    parser.add_argument("--udp", metavar="HOST:PORT", help="drive the robot that listens there")
    parser.add_argument("--serve", metavar="HOST:PORT", help="be a simulated robot that listens there")
    args = parser.parse_args()
    if sum(map(bool, (args.eval, args.udp, args.serve, args.viewer != "none"))) > 1:
        parser.error("--eval, --viewer, --udp and --serve are one thing each")
    if args.command is not None and (args.eval or args.serve):
        parser.error("--eval brings its own commands, and --serve takes them from its client")
    return args


def main() -> None:
    args = parse()
    folder = Path(args.folder)
    contract = read_contract(folder)
    command = read_command(args.command, contract.command_ranges)
    if args.eval:
        result = run_exam(folder)
        path = Path(args.out) if args.out else folder / RESULT_FILE
        print(rules.table(result))
        try:
            rules.save({"policy": shown(folder / "policy.onnx"), "engine": "mujoco (deploy)", **result}, path)
        except OSError as error:
            raise UserError(f"cannot write {path}: {error.strerror}; say --out FILE") from None
        print(f"written to {shown(path)}")
    elif args.serve:
        server = UdpServer(MujocoRobot(folder, contract), contract, parse_address(args.serve))
        print(f"a simulated robot for {contract.task} at {server.address[0]}:{server.address[1]}; Ctrl-C ends it", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            server.serve(lambda line: print(line, flush=True))
    elif args.viewer != "none":
        watch(DeployStage(folder, command=None if args.command is None else tuple(command)), args.viewer, args.time)
    else:
        controller = Controller(folder, contract)
        robot: Robot = UdpRobot(contract, parse_address(args.udp)) if args.udp else MujocoRobot(folder, contract)
        walk(robot, controller, command, args.time or 10.0, live=bool(args.udp))


def walk(robot: Robot, controller: Controller, command: Floats, seconds: float, live: bool) -> None:
    """Walk and say how it went, a line a second and one at the end."""
    period = controller.contract.period

    def tell(now: float, measured: Measurement) -> None:
        if round(now / period) % round(1.0 / period) == 0:
            said = f"vx {measured.lin_vel[0]:6.2f} m/s  vy {measured.lin_vel[1]:6.2f} m/s  yaw rate {measured.ang_vel[2]:6.2f} rad/s"
            print(f"{now:6.1f} s  {said}  tilt {np.degrees(np.arccos(np.clip(-measured.gravity[2], -1, 1))):4.0f} deg", flush=True)

    done = run(robot, controller, lambda _: command, seconds, live=live, watch=tell)
    if done.fell is not None:
        print(f"it fell after {done.fell:.1f} s; its joints were let go")
    if done.velocity is not None:
        wanted, got = (", ".join(f"{v:.2f}" for v in vector) for vector in (command, done.velocity))
        late = f"; {done.late} steps late" if done.late else ""
        print(f"{done.steps} steps of {period:g} s{late}; commanded {wanted}; over the second half {got} (vx, vy [m/s], yaw rate [rad/s])")


def watch(stage: DeployStage, viewer: str, seconds: float | None) -> None:
    """Show it and let it be driven."""
    raise UserError("no viewers here yet")


def read_command(text: str | None, ranges: Floats) -> Floats:
    """The command (3,), or a stroll; refused outside of what was trained."""
    if text is None:
        return np.clip(STROLL, *ranges)
    try:
        command = np.array([float(part) for part in text.split(",")])
        if command.shape != (3,) or not np.isfinite(command).all():
            raise ValueError
    except ValueError:
        raise UserError(f"--command {text}: write three numbers, vx,vy,yaw [m/s, m/s, rad/s], e.g. 0.8,0,0") from None
    for name, value, low, high in zip(("vx", "vy", "yaw rate"), command, *ranges, strict=True):
        if not low <= value <= high:
            raise UserError(f"--command {text}: {name} was trained from {low:g} to {high:g}, and {value:g} is outside")
    return command


if __name__ == "__main__":
    with one_line_errors("legged_mw.deploy"):
        main()
