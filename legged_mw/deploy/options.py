"""Which robot a policy drives, and which one is simulated for another program to drive: their flags, and what they start."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path
from typing import Any

from legged_mw.deploy.contract import Contract
from legged_mw.deploy.drive import lift
from legged_mw.deploy.odometry import CONTACTS
from legged_mw.deploy.robot import Robot
from legged_mw.utils.errors import UserError

ROBOTS = ("simulated", "unitree")
TRUTH, ODOMETRY = "truth", "odometry"
NO_TRUTH = f"no sensor of a real robot gives it; there is --velocity {ODOMETRY}"
_OF_A_ROBOT, _OF_SERVING = ("interface", "domain"), ("remote", "fault", "watchdog")


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add --robot, --serve and what goes with them."""
    parser.add_argument("--robot", choices=ROBOTS, default="simulated", help="unitree: a Go2 or G1 at --interface")
    parser.add_argument(
        "--serve", choices=ROBOTS[1:], help="simulate such a robot at --interface, for --robot to drive"
    )
    parser.add_argument(
        "--interface", metavar="IF", help="network interface of the robot: eth0, or lo for one that is served here"
    )
    parser.add_argument("--domain", type=int, metavar="N", help="DDS domain (default: 0, as robots have it; on lo 1)")
    velocity = (
        "where a policy's base_lin_vel is from: truth of a simulated robot (its default), or odometry of legs and IMU"
    )
    parser.add_argument("--velocity", choices=(TRUTH, ODOMETRY), help=velocity)
    contact = "how odometry finds feet on the ground (default: measured where the robot does, else torque)"
    parser.add_argument("--contact", choices=CONTACTS, help=contact)
    served = parser.add_argument_group("with --serve")
    served.add_argument(
        "--remote", metavar="FILE", help="a YAML script of its remote (default: the keys of this terminal)"
    )
    fault = "what goes wrong, and when: delay=10,loss=5 or low_battery@8, again for more (docs/faults.md has them all)"
    served.add_argument("--fault", action="append", metavar="NAME[=VALUE][@S]", help=fault)
    served.add_argument(
        "--watchdog", type=float, metavar="S", help="it damps after S seconds without a command (default: never)"
    )


def check_flags(args: argparse.Namespace) -> None:
    """Refuse what does not go together. Raises UserError."""
    wire = args.robot == "unitree" or args.serve
    for name in _OF_A_ROBOT:
        if not wire and getattr(args, name) is not None:
            raise UserError(f"--{name} is of a robot on a network: add --robot unitree or --serve unitree")
    for name in _OF_SERVING:
        if not args.serve and getattr(args, name) is not None:
            raise UserError(f"--{name} is of a robot that is simulated for others: add --serve unitree")
    if args.watchdog is not None and not args.watchdog > 0.0:
        raise UserError(
            f"--watchdog {args.watchdog:g}: a time of more than 0 s; without the flag it never damps by itself"
        )
    if args.contact and args.velocity != ODOMETRY:
        raise UserError(f"--contact is of leg odometry: add --velocity {ODOMETRY}")
    if args.velocity and (args.serve or (args.velocity == TRUTH and wire)):
        raise UserError(
            f"--velocity {args.velocity}: " + ("it is of the program that drives" if args.serve else NO_TRUTH)
        )
    if not wire:
        return
    if args.serve and args.robot != "simulated":
        raise UserError("--serve is the robot and --robot drives one: start them as two programs")
    if args.interface is None:
        raise UserError(
            "say on which network the robot is: --interface eth0, or --interface lo for one that --serve simulates here"
        )
    given = {name: getattr(args, name) for name in ("eval", "terrain", "video", "sheet")}
    given |= {"num_envs": args.num_envs != 1, "viewer": args.serve and args.viewer != "auto"}
    others = [name for name, value in given.items() if value]
    if others:
        raise UserError(f"--{others[0]} is of simulated robots in this program: leave it out")


def driver(name: str) -> Any:
    """The module that speaks with robots of that kind; its package is imported only here."""
    return import_module(f"legged_mw.{name}.driver")


def serve(folder: Path, contract: Contract, args: argparse.Namespace) -> None:
    """A simulated robot on the wire."""
    print(driver(args.serve).serve(folder, contract, args, lift(args)))


def contact(args: argparse.Namespace, contract: Contract) -> str | None:
    """How leg odometry finds feet on the ground; None without odometry. Raises RobotError."""
    if args.velocity != ODOMETRY:
        return None
    feels = args.robot == "simulated" or driver(args.robot).senses_feet(contract)
    if args.contact == CONTACTS[0] and not feels:
        raise UserError(
            f"--contact {args.contact}: this robot does not measure it; there are: {', '.join(CONTACTS[1:])}"
        )
    return args.contact or CONTACTS[not feels]


def connect(folder: Path, contract: Contract, args: argparse.Namespace) -> Robot:
    """The robot on the wire."""
    return driver(args.robot).connect(folder, contract, args, odometry=args.velocity == ODOMETRY)
