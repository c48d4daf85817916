"""Entry points of ``legged_mw.deploy --robot unitree`` and ``--serve unitree``.

Deploy imports this module by the flag's value.
"""

from __future__ import annotations

import argparse
import math
import sys
from contextlib import closing
from pathlib import Path

from legged_mw.deploy.contract import Contract
from legged_mw.deploy.robot import Robot
from legged_mw.unitree import client, need_dds
from legged_mw.unitree.robots import machine_of


def senses_feet(contract: Contract) -> bool:
    """True if the contract's robot measures foot contacts."""
    return bool(machine_of(contract.joints).feet_of(contract.feet))


def connect(folder: Path, contract: Contract, args: argparse.Namespace, odometry: bool) -> Robot:
    """Connect to the robot on the wire. Raises RobotError."""
    robot = client.connect(folder, contract, args.interface, args.domain, odometry=odometry)
    print(
        f"{robot.machine.name} at {args.interface}: {len(contract.joints)} joints, {robot.health().voltage or 0:.1f} V",
        flush=True,
    )
    return robot


def serve(folder: Path, contract: Contract, args: argparse.Namespace, lift: float) -> str:
    """Serve a simulated robot on the wire. ``lift`` [m]: height above its start. Returns a report as text."""
    need_dds()
    from legged_mw.unitree import handset, program
    from legged_mw.unitree.faults import parse_faults

    faults = parse_faults(args.fault or [], contract.joints)
    script = handset.load_remote(Path(args.remote)) if args.remote else []
    keys = args.remote is None and sys.stdin.isatty()
    if keys:
        print(handset.KEYS_HELP)
    with closing(handset.Handset(script, keys)) as hand:
        served = program.serve(
            *(folder, contract, args.interface, args.domain),
            seconds=args.time or math.inf,
            handset=hand,
            faults=faults,
            watchdog=args.watchdog or math.inf,
            hoist=None if args.hoist is None else args.hoist != "no",
            lift=lift,
        )
    return served.text()
