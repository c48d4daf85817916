"""Run an exported policy without torch: python -m legged_mw.deploy DIR"""

from __future__ import annotations

import argparse
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from legged_mw import ROOT
from legged_mw.deploy import drive, replay
from legged_mw.deploy.contract import CONTRACT_FILE, SCENE_FILE, TERRAIN_FILE, Contract, edits, read_contract
from legged_mw.deploy.exam import SwitchStage, contract_rules, contract_skill, run
from legged_mw.deploy.odometry import CONTACTS
from legged_mw.deploy.simulated import MujocoRobot
from legged_mw.deploy.stage import DeployStage
from legged_mw.eval import walking
from legged_mw.eval.skills import Skill
from legged_mw.utils.cli import FEWER_WORLDS, Parser, duration, one_line_errors, positive
from legged_mw.utils.errors import UserError, shown, unknown
from legged_mw.utils.files import check_folder, typed, writable
from legged_mw.view import launch

# ---- the robot: its flags, and what they start ----------------------------------------------------------------------


ROBOTS = ("simulated", "unitree")
TRUTH, ODOMETRY = "truth", "odometry"
NO_TRUTH = f"no sensor of a real robot gives it; there is --velocity {ODOMETRY}"
_OF_A_ROBOT, _OF_SERVING = ("interface", "domain"), ("remote", "fault", "watchdog")


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add --robot, --serve and their flags."""
    parser.add_argument("--robot", choices=ROBOTS, default="simulated", help="unitree: a Go2 or G1 at --interface")
    parser.add_argument(
        "--serve", choices=ROBOTS[1:], help="simulate such a robot at --interface, for --robot to drive"
    )
    parser.add_argument(
        "--interface", metavar="IF", help="network interface of the robot: eth0, or lo for a robot of --serve"
    )
    parser.add_argument("--domain", type=int, metavar="N", help="DDS domain (default: 0, as robots have it; on lo 1)")
    velocity = "source of a policy's base_lin_vel: truth in simulation (its default), or odometry from legs and IMU"
    parser.add_argument("--velocity", choices=(TRUTH, ODOMETRY), help=velocity)
    contact = "odometry's source of foot contact (default: measured if the robot measures it, else torque)"
    parser.add_argument("--contact", choices=CONTACTS, help=contact)
    served = parser.add_argument_group("with --serve")
    served.add_argument(
        "--remote", metavar="FILE", help="a YAML script of its remote (default: the keys of this terminal)"
    )
    fault = "faults and their times: delay=10,loss=5 or low_battery@8; may be repeated (list: docs/faults.md)"
    served.add_argument("--fault", action="append", metavar="NAME[=VALUE][@S]", help=fault)
    served.add_argument(
        "--watchdog", type=float, metavar="S", help="damp after S seconds without a command (default: never)"
    )


def check_flags(args: argparse.Namespace) -> None:
    """Refuse flags that do not go together. Raises UserError."""
    wire = args.robot == "unitree" or args.serve
    for name in _OF_A_ROBOT:
        if not wire and getattr(args, name) is not None:
            raise UserError(f"--{name} needs a robot on a network: add --robot unitree or --serve unitree")
    for name in _OF_SERVING:
        if not args.serve and getattr(args, name) is not None:
            raise UserError(f"--{name} needs a served simulated robot: add --serve unitree")
    if args.watchdog is not None and not args.watchdog > 0.0:
        raise UserError(
            f"--watchdog {args.watchdog:g}: the time must be above 0 s; without the flag it never damps by itself"
        )
    if args.contact and args.velocity != ODOMETRY:
        raise UserError(f"--contact needs leg odometry: add --velocity {ODOMETRY}")
    if args.velocity and (args.serve or (args.velocity == TRUTH and wire)):
        raise UserError(
            f"--velocity {args.velocity}: " + ("only the program that drives has it" if args.serve else NO_TRUTH)
        )
    if not wire:
        return
    if args.serve and args.robot != "simulated":
        raise UserError("--serve is a robot and --robot drives one: start two programs")
    if args.interface is None:
        raise UserError(
            "name the robot's network interface: --interface eth0, or --interface lo for a robot of --serve on this machine"
        )
    given = {name: getattr(args, name) for name in ("eval", "terrain", "video", "sheet")}
    given |= {"num_envs": args.num_envs != 1, "viewer": args.serve and args.viewer not in launch.UNSEEN}
    others = [name for name, value in given.items() if value]
    if others:
        raise UserError(f"--{others[0]} needs simulated robots in this program: leave it out")


def driver(name: str) -> Any:
    """The module for this kind of robot. Only here is its package imported."""
    return import_module(f"legged_mw.{name}.driver")


def contact_source(args: argparse.Namespace, contract: Contract) -> str | None:
    """The source of foot contact for leg odometry; None without odometry. Raises RobotError."""
    if args.velocity != ODOMETRY:
        return None
    feels = args.robot == "simulated" or driver(args.robot).senses_feet(contract)
    if args.contact == CONTACTS[0] and not feels:
        raise UserError(
            f"--contact {args.contact}: this robot does not measure it; there are: {', '.join(CONTACTS[1:])}"
        )
    return args.contact or CONTACTS[not feels]


RESULT_FILE = "exam.json"
SHIPPED = ROOT / "resources" / "policies"


def parse() -> argparse.Namespace:
    parser = Parser(prog="python -m legged_mw.deploy", description=__doc__, allow_abbrev=False)
    made = "play.py --export DIR makes one, a finished training too, in its run folder; or the name of a shipped policy"
    parser.add_argument("folder", metavar="DIR", nargs="?", help=f"an export: {made}")
    parser.add_argument(
        "second", metavar="DIR2", nargs="?", help="with --switch: the policy that takes over, of the same robot"
    )
    parser.add_argument(
        "--switch", choices=("fall",), help="fall: DIR until the robot falls, then DIR2 until it stands (simulated)"
    )
    parser.add_argument(
        "--eval", action="store_true", help=f"the task's exam; prints its table and writes {RESULT_FILE}"
    )
    parser.add_argument(
        "--out", metavar="FILE", help=f"file of --eval (default: DIR/{RESULT_FILE}; for a shipped policy in logs)"
    )
    common = (
        "--eval asks the ranges that were trained, or the one range that all published policies of the robot were asked"
    )
    parser.add_argument("--ranges", choices=("trained", "common"), help=common)
    parser.add_argument(
        "--no_hard", action="store_true", help="--eval without the hard exam and heat, in a third of the time"
    )
    parser.add_argument(
        "--command", metavar="VALUES", help="fixed command: 0.5,0,0 in the contract's order, or base_height=0.3 by name"
    )
    parser.add_argument("--num_envs", type=positive, default=1, metavar="N", help="robots side by side")
    parser.add_argument(
        "--time", type=duration, metavar="T", help="how long (default: until closed; 10s of a recording)"
    )
    parser.add_argument(
        "--terrain", action="store_true", help=f"run on the steps and blocks of {TERRAIN_FILE}, if the export has it"
    )
    scene = "run and grade in your own MJCF, such as a vendor's: joints by name, servos with the policy's gains"
    parser.add_argument("--scene", metavar="FILE", help=scene)
    parser.add_argument(
        "--edited",
        action="store_true",
        help="accept changes of an export: each changed value is printed with the exported one",
    )
    unitree = "write the policy for unitree_rl_lab's program: OUT/params/deploy.yaml and OUT/exported/policy.onnx"
    parser.add_argument("--deploy_yaml", metavar="OUT", help=unitree)
    launch.add_flags(parser)
    add_flags(parser)
    drive.add_flags(parser)
    args = parser.parse_args()
    if args.folder is None and args.replay is None:
        parser.error("the following arguments are required: DIR")
    _refuse(parser, args)
    if args.out is not None:
        writable(args.out, "--out")
    launch.check_flags(args)
    check_flags(args)
    drive.check_flags(args)
    return args


def _refuse(parser: Parser, args: argparse.Namespace) -> None:
    """Refuse flags of the exam, of a scene and of two policies that do not go together."""
    if args.eval and (
        flags := [f"--{name}" for name in ("command", "terrain") if getattr(args, name)] + launch.asked(args)
    ):
        parser.error(f"--eval has its own commands, flat ground and no viewer: leave {flags[0]} out")
    if (args.second is None) != (args.switch is None):
        parser.error("--switch fall needs two policies: python -m legged_mw.deploy DIR DIR2 --switch fall")
    others = [f"--{name}" for name in ("eval", "drive", "serve", "terrain", "velocity", "scene") if getattr(args, name)]
    if args.switch and (others := others + ["--robot"] * (args.robot != "simulated")):
        parser.error(f"--switch is for simulation on flat ground: leave {others[0]} out")
    apart = [f"--{name}" for name in ("drive", "serve", "terrain", "velocity", "replay") if getattr(args, name)]
    if args.scene and (apart := apart + ["--robot"] * (args.robot != "simulated")):
        parser.error(f"--scene simulates a robot in your own scene: leave {apart[0]} out")
    for name in ("ranges", "no_hard"):
        if getattr(args, name) and not args.eval:
            parser.error(f"--{name} is for the exam: add --eval")
    if args.command is not None and args.commands:
        parser.error("--commands has its own commands: leave --command out")


def main() -> None:
    args = parse()
    for each in map(find, filter(None, (args.folder, args.second))) if args.edited else ():
        print("\n".join(edits(each)) or f"{shown(each)}: no value was changed that training used")
    if args.replay:
        show_log(args.replay, find(args.folder) if args.folder else None, args.edited)
        return
    folder = find(args.folder)
    contract, inside = read_contract(folder, args.edited), TERRAIN_FILE if args.terrain else SCENE_FILE
    scene_file = typed(args.scene) if args.scene else inside
    command = launch.check_drive(args, contract.commands, advice=f"the ranges are in {folder / CONTRACT_FILE}")
    if contract.ends.not_covered:
        print(f"not judged here: {', '.join(contract.ends.not_covered)}, which ended episodes in training")
    contact = contact_source(args, contract)
    if args.deploy_yaml:
        print(import_module("legged_mw.unitree.deploy_yaml").write(folder, contract, typed(args.deploy_yaml)))
    elif args.switch:
        stage = SwitchStage(folder, find(args.second), args.num_envs, command, args.edited)
        launch.watch(stage, args, results(folder), title=f"{contract.task}, {args.second}")
    elif args.serve:
        print(driver(args.serve).serve(folder, contract, args, drive.lift(args)))
    elif args.robot != "simulated":
        join = partial(driver(args.robot).connect, folder, contract, args, odometry=args.velocity == ODOMETRY)
        print(drive.drive(join, folder, contract, args, command, args.robot, contact).report)
    elif args.drive:
        hoisted, raised = drive.hoisted(args, contract), drive.lift(args)
        robot = partial(MujocoRobot, folder, contract, inside, whole=True, hoisted=hoisted, lift=raised)
        drive.drive(robot, folder, contract, args, command, args.robot, contact)
    elif args.eval:
        examine(folder, contract, args, contact, scene_file)
    else:
        stage = DeployStage(folder, args.num_envs, command, scene_file=scene_file, contact=contact, edited=args.edited)
        launch.watch(stage, args, results(folder), title=contract.task)


def find(name: str) -> Path:
    """The folder of an export, or of the shipped policy of this name. Raises UserError if there is neither."""
    if (folder := typed(name)).is_dir():
        return check_folder(folder)
    if not (SHIPPED / name).is_dir():
        there = sorted(path.parent.name for path in SHIPPED.glob(f"*/{CONTRACT_FILE}"))
        raise UserError(f"no folder {name}, and {unknown('policy', name, there, 'resources/policies')}")
    return SHIPPED / name


def results(folder: Path) -> Path:
    """The folder for results of an export: beside it. Results of a shipped policy go to logs, as in play.py."""
    return Path("logs", folder.name, "shipped") if folder.resolve().parent == SHIPPED.resolve() else folder


def show_log(path: Path, folder: Path | None, edited: bool = False) -> None:
    """Compare a log with its simulation: print the table and write a plot beside the log."""
    replayed = replay.replay(path, folder, edited)
    print(replay.table(replayed))
    replay.draw(replayed, path.with_suffix(".png"))
    print(f"written to {shown(path.with_suffix('.png'))}")


def examine(folder: Path, contract: Contract, args: argparse.Namespace, contact: str | None, scene: str | Path) -> None:
    """Run the exam: print its tables and write a JSON file. ``contact``, ``scene`` (``scene_file``): see DeployStage."""
    name = f"exam_{Path(args.scene).stem}.json" if args.scene else RESULT_FILE
    path = Path(args.out) if args.out else results(folder) / name
    writable(str(path), "--out")
    if contract.exam and "kind" in contract.exam:
        given = {"--ranges": args.ranges == "common", "--velocity odometry": contact, "--scene": args.scene}
        for flag in (flag for flag, value in given.items() if value):
            raise UserError(f"{flag} needs the walking exam, and this policy has another: leave it out")
        rules: walking.ExamRules | Skill = contract_skill(contract)
    else:
        rules = contract_rules(contract, args.ranges == "common")
    result, _ = run(folder, rules, not args.no_hard, edited=args.edited, scene=scene, contact=contact, show=print)
    said = {"policy": shown(folder / "policy.onnx"), "engine": "mujoco (deploy)"}
    said |= {"scene": shown(scene)} if isinstance(scene, Path) else {}
    said |= {"velocity": f"odometry, contact by {contact}"} if contact else {}
    try:
        walking.save({**said, **result}, path)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}; say --out FILE") from None
    print(f"written to {shown(path)}")


if __name__ == "__main__":
    with one_line_errors("legged_mw.deploy", FEWER_WORLDS):
        main()
