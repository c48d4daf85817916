"""Run an exported policy without torch: python -m legged_mw.deploy DIR"""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path

import numpy as np

from legged_mw import ROOT
from legged_mw.deploy.contract import CONTRACT_FILE, SCENE_FILE, TERRAIN_FILE, Contract, read_contract
from legged_mw.deploy.exam import run_exam
from legged_mw.deploy.policy import Controller
from legged_mw.deploy.robot import Floats, Measurement
from legged_mw.deploy.runner import run
from legged_mw.deploy.simulated import MujocoRobot
from legged_mw.deploy.stage import STROLL, DeployStage
from legged_mw.deploy.udp import UdpRobot, UdpServer, parse_address
from legged_mw.eval import rules
from legged_mw.utils.cli import Parser, duration, one_line_errors, positive, shown
from legged_mw.utils.errors import UserError
from legged_mw.view import launch

RESULT_FILE = "exam.json"
WALK_SECONDS = 10.0  # of a robot behind a link, where nobody says how long


def parse() -> argparse.Namespace:
    parser = Parser(prog="python -m legged_mw.deploy", description=__doc__, allow_abbrev=False)
    made = "play.py --export DIR makes one, a finished training too, in its run folder; or the name of a shipped policy"
    parser.add_argument("folder", metavar="DIR", help=f"an export: {made}")
    parser.add_argument("--eval", action="store_true", help=f"the walking exam; prints its table and writes DIR/{RESULT_FILE}")
    parser.add_argument("--out", metavar="FILE", help=f"where --eval writes (default: DIR/{RESULT_FILE})")
    parser.add_argument(
        "--command", metavar="VX,VY,YAW", help="fixed command [m/s, m/s, rad/s]; --command=-0.5,0,0 if it starts with a minus"
    )
    parser.add_argument("--num_envs", type=positive, default=1, metavar="N", help="robots side by side")
    parser.add_argument("--time", type=duration, metavar="T", help="how long (default: until closed; 10s of a recording or a link)")
    parser.add_argument("--terrain", action="store_true", help=f"among the steps and blocks of {TERRAIN_FILE}, if the export has it")
    launch.add_flags(parser)
    parser.add_argument("--udp", metavar="HOST:PORT", help="drive the robot that listens there")
    parser.add_argument("--serve", metavar="HOST:PORT", help="be a simulated robot that listens there")
    args = parser.parse_args()
    watched = args.viewer != "auto" or args.video or args.sheet or args.commands
    if sum(map(bool, (args.eval, args.udp, args.serve, watched))) > 1:
        parser.error("--eval, --udp, --serve and what shows or records (--viewer, --video, --sheet, --commands) are one thing each")
    if args.terrain and (args.eval or args.udp):
        parser.error("--eval is on flat ground and --udp has no ground of its own: leave --terrain out")
    if args.command is not None and (args.eval or args.serve or args.commands):
        parser.error("--eval and --commands bring their own commands, and --serve takes them from its client: leave --command out")
    launch.check_flags(args)
    return args


def main() -> None:
    args = parse()
    shipped = ROOT / "resources" / "policies" / args.folder
    folder = shipped if shipped.is_dir() and not Path(args.folder).exists() else Path(args.folder)
    contract, scene_file = read_contract(folder), TERRAIN_FILE if args.terrain else SCENE_FILE
    command = launch.check_drive(args, contract.command_ranges, advice=f"the ranges are in {folder / CONTRACT_FILE}")
    if args.eval:
        examine(folder, Path(args.out) if args.out else folder / RESULT_FILE)
    elif args.serve:
        server = UdpServer(MujocoRobot(folder, contract, scene_file), contract, parse_address(args.serve))
        print(f"a simulated robot for {contract.task} at {server.address[0]}:{server.address[1]}; Ctrl-C ends it", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            server.serve(lambda line: print(line, flush=True))
    elif args.udp:
        wanted = np.clip(STROLL, *contract.command_ranges) if command is None else np.array(command)
        walk(folder, contract, parse_address(args.udp), wanted, args.time or WALK_SECONDS)
    else:
        launch.watch(DeployStage(folder, args.num_envs, command, scene_file=scene_file), args, folder, title=contract.task)


def examine(folder: Path, path: Path) -> None:
    """The exam: its table, and a JSON file at ``path``."""
    result = run_exam(folder)
    print(rules.table(result))
    try:
        rules.save({"policy": shown(folder / "policy.onnx"), "engine": "mujoco (deploy)", **result}, path)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}; say --out FILE") from None
    print(f"written to {shown(path)}")


def walk(folder: Path, contract: Contract, address: tuple[str, int], command: Floats, seconds: float) -> None:
    """Drive the robot at ``address`` and say how it goes, a line a second and one at the end."""
    period, controller = contract.period, Controller(folder, contract)

    def tell(now: float, measured: Measurement) -> None:
        if round(now / period) % round(1.0 / period) == 0:
            said = f"vx {measured.lin_vel[0]:6.2f} m/s  vy {measured.lin_vel[1]:6.2f} m/s  yaw rate {measured.ang_vel[2]:6.2f} rad/s"
            print(f"{now:6.1f} s  {said}  tilt {np.degrees(np.arccos(np.clip(-measured.gravity[2], -1, 1))):4.0f} deg", flush=True)

    done = run(UdpRobot(contract, address), controller, lambda _: command, seconds, watch=tell)
    if done.fell is not None:
        print(f"it fell after {done.fell:.1f} s; its joints were let go")
    if done.velocity is not None:
        wanted, got = (", ".join(f"{v:.2f}" for v in vector) for vector in (command, done.velocity))
        late = f"; {done.late} steps late" if done.late else ""
        print(f"{done.steps} steps of {period:g} s{late}; commanded {wanted}; over the second half {got} (vx, vy [m/s], yaw rate [rad/s])")


if __name__ == "__main__":
    with one_line_errors("legged_mw.deploy"):
        main()
