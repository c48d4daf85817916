"""Which robot a policy drives, and which one is simulated for another program to drive: their flags, and what they start."""

from __future__ import annotations

import argparse
import math
import sys
from contextlib import closing
from pathlib import Path

from legged_mw.deploy.contract import Contract
from legged_mw.deploy.unitree import client
from legged_mw.deploy.unitree.client import UnitreeRobot
from legged_mw.utils.errors import UserError

ROBOTS = ("simulated", "unitree")
_OF_A_ROBOT, _OF_SERVING = ("interface", "domain"), ("remote", "fault", "watchdog")


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add --robot, --serve and what goes with them."""
    parser.add_argument("--robot", choices=ROBOTS, default="simulated", help="unitree: a Go2 or G1 at --interface")
    parser.add_argument("--serve", choices=ROBOTS[1:], help="simulate such a robot at --interface, for --robot to drive")
    parser.add_argument("--interface", metavar="IF", help="network interface of the robot: eth0, or lo for one that is served here")
    parser.add_argument("--domain", type=int, metavar="N", help="DDS domain (default: 0, as robots have it; on lo 1)")
    served = parser.add_argument_group("with --serve")
    served.add_argument("--remote", metavar="FILE", help="a YAML script of its remote (default: the keys of this terminal)")
    fault = "what goes wrong, and when: delay=10,loss=5 or low_battery@8, again for more (docs/faults.md has them all)"
    served.add_argument("--fault", action="append", metavar="NAME[=VALUE][@S]", help=fault)
    served.add_argument("--watchdog", type=float, metavar="S", help="it damps after S seconds without a command (default: never)")


def check_flags(args: argparse.Namespace) -> None:
    """Refuse what does not go together. Raises UserError."""
    wire = args.robot == "unitree" or args.serve
    for name in _OF_A_ROBOT:
        if not wire and getattr(args, name) is not None:
            raise UserError(f"--{name} is of a robot on a network: add --robot unitree or --serve unitree")
    for name in _OF_SERVING:
        if not args.serve and getattr(args, name) is not None:
            raise UserError(f"--{name} is of a robot that is simulated for others: add --serve unitree")
    if not wire:
        return
    if args.serve and args.robot != "simulated":
        raise UserError("--serve is the robot and --robot drives one: start them as two programs")
    if args.interface is None:
        raise UserError("say on which network the robot is: --interface eth0, or --interface lo for one that --serve simulates here")
    others = [name for name in ("eval", "terrain", "video", "sheet") if getattr(args, name)] + ["num_envs"] * (args.num_envs != 1)
    if others:
        raise UserError(f"--{others[0]} is of simulated robots in this program: leave it out")


def serve(folder: Path, contract: Contract, args: argparse.Namespace) -> None:
    """A simulated robot on the wire."""
    from legged_mw.deploy.unitree import handset, need_dds, program
    from legged_mw.deploy.unitree.faults import parse_faults

    need_dds()
    faults = parse_faults(args.fault or [], contract.joints)
    script, keys = handset.load_remote(Path(args.remote)) if args.remote else [], args.remote is None and sys.stdin.isatty()
    if keys:
        print(handset.KEYS_HELP)
    with closing(handset.Handset(script, keys)) as hand:
        served = program.serve(
            *(folder, contract, args.interface, args.domain),
            seconds=args.time or math.inf,
            handset=hand,
            faults=faults,
            watchdog=args.watchdog or math.inf,
        )
    print(served.text())


def connect(folder: Path, contract: Contract, args: argparse.Namespace) -> UnitreeRobot:
    """The robot on the wire."""
    robot = client.connect(folder, contract, args.interface, args.domain)
    print(f"{robot.machine.name} at {args.interface}: {len(contract.joints)} joints, {robot.health().voltage or 0:.1f} V", flush=True)
    return robot
