"""The command line of legged_mw.deploy: what does not go together, scripts of commands and remotes, faults, limits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from test_user_scene import GO2, NO_SCENES, WRONG, vendors

from golden.table import Run, Table
from legged_mw.deploy import safety
from legged_mw.deploy.contract import Contract, read_contract
from legged_mw.deploy.user_scene import fit
from legged_mw.unitree import handset
from legged_mw.unitree.faults import parse_faults
from legged_mw.utils.commands import command_table
from legged_mw.utils.task import load_task
from legged_mw.view.drive import load_script

FLAGS = """
nosuch
go1_falt
go1_flat --eval --command=0,0,0
go1_flat --eval --terrain
go1_flat --eval --viewer web
go1_flat --eval --ranges common
go1_flat --switch fall
go1_flat go2_flat
go1_flat go1_flat --switch fall --eval
go1_flat go1_flat --switch fall --robot unitree
go1_flat --ranges common
go1_flat --no_hard
go1_flat --scene nosuch.xml
go1_flat --scene nosuch.xml --drive
go1_getup --scene nosuch.xml --eval
go1_flat --command=0,0,0 --commands a.yaml
go1_flat --eval --out folder
go1_flat --check_joints --command=0,0,0
go1_flat --first_walk --check_joints
go1_flat --chirp --check_joints
go1_flat --chirp --log off
go1_flat --drive --eval
go1_flat --drive --num_envs 2
go1_flat --log a
go1_flat --robot unitree --eval --interface lo
go1_flat --hoist yes
go1_flat --limit tilt=4
go1_flat --limit tilt --drive
go1_flat --limit tlit=4 --drive
go1_flat --limit tilt=x --drive
go1_flat --limit tilt=-1 --drive
go1_flat --limit tilt=nan --drive
go1_flat --drive --gamepad none
go1_flat --drive --stop_fd 9999
go1_flat --domain 1
go1_flat --interface lo
go1_flat --remote a
go1_flat --fault a
go1_flat --watchdog 1
go1_flat --serve unitree --watchdog 0
go1_flat --contact torque
go1_flat --velocity truth --robot unitree
go1_flat --serve unitree --velocity odometry
go2_flat --serve unitree --robot unitree
go2_flat --robot unitree
go2_flat --serve unitree --interface lo --viewer web
go2_flat --serve unitree --interface lo --num_envs 3
go2_flat --robot unitree --interface lo --viewer video
go2_flat --robot unitree --interface lo --fault loss=5
go2_flat --robot unitree --interface lo --terrain
go1_flat --robot unitree --interface lo
go1_flat --command=9,0,0
go1_flat --command=x
go1_handstand --command=1
go1_handstand --eval --ranges common
go1_flat --terrain --viewer none
go1_handstand --eval --velocity odometry
go1_flat go2_flat --switch fall --viewer none
go1_flat --viewer web --video a.mp4
go2_flat --serve unitree --interface nosuch0 --remote none.yaml
go2_flat --serve unitree --interface lo --fault nosuch
go2_flat --serve unitree --interface nosuch0
go2_flat --robot unitree --interface nosuch0
go2_flat --serve unitree --interface lo --domain 233
g1_flat --velocity odometry --contact measured --robot unitree --interface lo
--replay none.lmwlog
--replay there.lmwlog
go1_handstand --velocity odometry --viewer none
go1_flat --commands empty.yaml
go1_flat --time x
go1_flat --num_envs 0
""".splitlines()
SCRIPTS = {
    "nothing": "commands: []",
    "another list": "comands: [{time: 0, reset: true}]",
    "no time": "commands: [{reset: true}]",
    "a number": "commands: [3]",
    "another field": "commands: [{time: 0, jump: 1}]",
    "nothing happens": "commands: [{time: 0}]",
    "before the start": "commands: [{time: -1, reset: true}]",
    "backwards": "commands: [{time: 2, reset: true}, {time: 1, reset: true}]",
    "time of words": "commands: [{time: soon, reset: true}]",
    "a large push": "commands: [{time: 0, push: [9, 9]}]",
    "a push of three": "commands: [{time: 0, push: [1, 0, 0]}]",
    "reset of words": "commands: [{time: 0, reset: 1}]",
    "another command": "commands: [{time: 0, command: {lin_vel_z: 1}}]",
    "too fast": "commands: [{time: 0, command: [9, 0, 0]}]",
    "too many": "commands: [{time: 0, command: [0, 0, 0, 0]}]",
    "words": "commands: [{time: 0, command: fast}]",
    "too few": "commands: [{time: 0, command: [0, 0]}]",
    "no values": "commands: [{time: 0, command: []}]",
    "a value of NaN": "commands: [{time: 0, command: [1, 0, .nan]}]",
    "a value of words": "commands: [{time: 0, command: {lin_vel_x: fast}}]",
    "too slow a turn": "commands: [{time: 0, command: {ang_vel_yaw: -3}}]",
    "a push of a number": "commands: [{time: 0, push: 3}]",
    "half a list": "commands: [",
}
REMOTES = {
    "nothing": "remote: []",
    "no time": "remote: [{press: start}]",
    "another field": "remote: [{time: 0, pres: start}]",
    "another button": "remote: [{time: 0, press: strat}]",
    "a stick beyond": "remote: [{time: 0, lx: 2}]",
    "hoist of words": "remote: [{time: 0, hoist: up}]",
}
FAULTS = [
    "dealy=3",
    "clock_jump=1e9",
    "joint_bias=inf",
    "low_battery=-1",
    "frozen@soon",
    "motor_fault",
    "motor_fault=FL_hip",
    "nan=z",
    "nosuch",
    "delay=10@x",
    "joint_sign",
    "motor_fault=x",
    "bad_crc=1",
    "encoder",
    "low_battery=x",
    "nan=x",
    "loss=200",
    "delay=x",
    "loss=5@-1",
    "stuck",
    "motor=x",
]


def table() -> Table:
    made = Table(
        lambda root: [
            (root / "folder").mkdir(),
            (root / "there.lmwlog").write_bytes(b"no"),
            (root / "empty.yaml").touch(),
        ]
    )
    made.programs("deploy", FLAGS)
    commands, joints = command_table(load_task("go1_flat").cfg), ["FR_hip_joint", "FL_hip_joint"]
    for name, text in SCRIPTS.items():
        made.add(
            f"script: {name}",
            lambda root: load_script("a.yaml", commands),
            lambda root, text=text: (root / "a.yaml").write_text(text),
        )
    made.add(
        "script: no commands",
        lambda root: load_script("a.yaml", ()),
        lambda root: (root / "a.yaml").write_text(SCRIPTS["too fast"]),
    )
    for name, text in REMOTES.items():
        made.add(
            f"remote: {name}",
            lambda root: handset.load_remote(Path("a.yaml")),
            lambda root, text=text: (root / "a.yaml").write_text(text),
        )
    of_scenes(made)
    made.calls({f"fault: {text}": lambda text=text: parse_faults([text], joints) for text in FAULTS})
    made.calls(
        {
            f"limit: {name} {value}": lambda name=name, value=value: safety._value(name, value, "here")
            for name, value in LIMITS
        }
    )
    return made


def of_scenes(made: Table) -> None:
    """--scene: files that do not fit go2_flat, and policies that fit no scene."""
    contract = read_contract(GO2)

    def fits(of: Contract = contract) -> Run:
        return lambda root: fit(root / "vendor.xml", GO2, of)

    for name, change in WRONG.items():
        made.add(f"scene: {name}", fits(), lambda root, change=change: vendors(root, change))
    for name, text in NO_SCENES.items():
        made.add(f"scene: {name}", fits(), lambda root, text=text: (root / "vendor.xml").write_text(text))
    with_law = replace(contract, motors=contract.motors._replace(law="torque"))
    made.add("scene: motors with a law", fits(with_law), vendors)


LIMITS = [("tlit", 3), ("tilt", "x"), ("tilt", -1), ("tilt", True)]
