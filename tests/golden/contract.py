"""policy.yaml, scene.xml and what lies beside them, taken at their word."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Callable
from functools import reduce
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from golden.table import Run, Table, patched
from legged_mw import ROOT
from legged_mw.deploy.contract import CHECKSUM, CLOCK, JOINT_POS, Motors, checksum, make_network, read_contract
from legged_mw.deploy.controller import Controller, Follower, Network
from legged_mw.deploy.exam import contract_rules, contract_skill
from legged_mw.deploy.odometry import Odometry
from legged_mw.deploy.robot import QUANTITIES, Measurement
from legged_mw.deploy.safety import Limits, Safety
from legged_mw.deploy.simulated import read_scene
from legged_mw.robot import mjcf
from legged_mw.robot.mjcf import write_archive
from legged_mw.utils.config import load_yaml, save_yaml

POLICIES = ROOT / "resources/policies"


def pops(*names: str) -> Any:
    return lambda said: [said[name].pop() for name in names]


Change = Callable[[Any], Any]


def set_at(path: str, value: Any) -> Change:
    """Put ``value``, or what it makes of what is there, at a dotted path of the content; numbers are keys too."""

    def change(content: Any) -> None:
        *places, last = (int(part) if part.isdecimal() else part for part in path.split("|"))
        for place in places:
            content = content[place]
        content[last] = value(content[last]) if callable(value) else value

    return change


def drop(path: str) -> Change:
    """Remove what is at a dotted path."""
    *places, last = path.split("|")
    return lambda content: reduce(
        lambda at, place: at[int(place) if place.isdecimal() else place], places, content
    ).pop(last)


def swap(*path: str) -> Change:
    """Exchange the first two of a list."""

    def change(said: Any) -> None:
        for place in path:
            said = said[place]
        said[0], said[1] = said[1], said[0]

    return change


CHANGES: dict[str, Any] = {
    "default pose of 10^9": set_at("default_pose|0", 1e9),
    "default pose is NaN": set_at("default_pose|0", float("nan")),
    "default pose of 38 digits": set_at("default_pose|0", 10**38),
    "clip of 10^9": set_at("action|clip", 1e9),
    "clip of 0": set_at("action|clip", 0),
    "scale of 0": set_at("action|scale", 0.0),
    "scale of 10^12": set_at("action|scale", 1e12),
    "scale of a row": set_at("observation|0|scale", 1e30),
    "highest below lowest": set_at("commands|0|highest", -9.0),
    "stiffness below 0": set_at("stiffness|3", -35.0),
    "damping of 10^9": set_at("damping|3", 1e9),
    "period of a day": lambda said: said.update(period=86400.0, physics={"timestep": 8640.0, "decimation": 10}),
    "decimation of 10^9": set_at("physics|decimation", 10**9),
    "timestep of 0": set_at("physics|timestep", 0),
    "a scene elsewhere": set_at("physics|file", "../../etc/passwd"),
    "a network elsewhere": set_at("network|file", "/tmp/policy.onnx"),
    "a row of 10^12 values": set_at("observation|0|size", 10**12),
    "a history of 10^9": set_at("observation|0|history", 10**9),
    "mass of 10^300": set_at("robot|mass", 1e300),
    "noise below 0": set_at("observation|0|noise", -1.0),
    "no joints": set_at("joints", []),
    "joints are numbers": set_at("joints", [1, 2]),
    "a joint twice": set_at("joints|0", "FL_hip_joint"),
    "no rows": set_at("observation", []),
    "a mapping of rows": set_at("observation", {"a": 1}),
    "of another format": set_at("format", 99),
    "memory of 10^18": set_at("network|memory", {"input": "a", "output": "b", "shape": [10**9, 10**9]}),
    "a row of another size": set_at("observation|0|size", 4),
    "targets without an end": set_at("action|highest|0", 1e9),
    "targets that end before they begin": set_at("action|highest|0", -9.0),
    "a terrain elsewhere": set_at("physics|terrain", {"file": "../x.mjz", "sha256": ""}),
    "another quantity": set_at("observation|3|measured", "joint_ofset"),
    "nothing measures it": set_at("observation|0|measured", ""),
    "of a motion": lambda said: said["observation"][0].update(measured=JOINT_POS),
    "a joint less": pops("joints", "default_pose", "stiffness", "damping"),
    "scales of a row": set_at("observation|4|scale", [1.0, 2.0]),
    "a pose less": set_at("default_pose", [0.0] * 11),
    "a pose of words": set_at("default_pose|2", "bent"),
    "another format": set_at("format", 1),
    "no format": drop("format"),
    "memory of no size": set_at("network|memory", {"input": "a", "output": "b", "shape": [1, 0]}),
    "no scale": drop("action|scale"),
    "another origin": set_at("action|origin", "pose"),
    "no commands": drop("commands"),
    "a default beyond": set_at("commands|1|default", 0.9),
    "a history of none": set_at("observation|3|history", 0),
    "no ends": drop("ends"),
    "another rule": set_at("ends", {"max_tlit": 3}),
    "a tilt of 200": set_at("ends", {"max_tilt": 200}),
    "a clock without its commands": lambda said: (
        said["commands"].pop(),
        said.update(gait={}),
        said["observation"][0].update(measured=CLOCK),
    ),
    "no network section": drop("network"),
    "a section of text": set_at("robot", "go1"),
    "another rating": set_at("ratings", {"continous_torque": 5.0}),
    "a rating of 0": set_at("ratings", {"thermal_time": 0.0}),
    "a rating less": set_at("ratings", {"thermal_time": [300.0] * 11}),
    "a battery of nothing": set_at("ratings", {"battery_power": 0.0}),
    "another law": set_at("motors", {"law": "magic"}),
    "a task of numbers": set_at("task", 3),
    "a joint for another": set_at("joints|4", "FL_hip_joint"),
    "a joint less everywhere": lambda said: (
        said.pop("ratings"),
        pops("joints", "default_pose", "stiffness", "damping")(said),
        [said["action"][end].pop() for end in ("lowest", "highest")],
    ),
    "no lowest target": drop("action|lowest"),
    "a highest target below": set_at("action|highest|0", -1.0),
    "no digest of the scene": drop("physics|sha256"),
    "a scale less": set_at("action|scale", [0.5] * 11),
    "no origin": drop("action|origin"),
    "a command less": pops("commands"),
    "a clip of NaN": set_at("action|clip", float("nan")),
    "a period of its own": set_at("period", 0.03),
    "an exam of a number": set_at("exam", 3),
}
UNSIGNED: dict[str, Any] = {  # of what the network was trained with
    "joints in another order": swap("joints"),
    "rows in another order": swap("observation"),
    "another default pose": swap("default_pose"),
    "another scale": set_at("action|scale", 0.25),
    "another scale of a row": set_at("observation|0|scale", 2.0),
    "another clip": set_at("action|clip", 3.0),
    "commands in another order": swap("commands"),
    "a checksum of text": set_at("checksum", "none"),
    "no checksum": lambda said: said.pop("checksum"),
    "today's format as an older one": set_at("format", 4),
}
SCENES: dict[str, Any] = {  # what the contract says, that scene.xml does not
    "another joint": set_at("joints|4", "FL_thihg_joint"),
    "another stiffness": set_at("stiffness|0", 20.0),
    "another mass": set_at("robot|mass", 20.0),
    "no sensor of falls": set_at("ends|falls_on", ["trunk_box"]),
    "another sensor": lambda said: said["sensors"]["joint_pos"].__setitem__(0, "FR_hip_jont"),
    "a sensor less": lambda said: said["sensors"]["joint_pos"].pop(),
    "another highest target": set_at("action|highest|0", 0.5),
    "another gyro": set_at("sensors|ang_vel", ["gyro/imuu"]),
    "two sensors for one": set_at("sensors|ang_vel", ["gyro/imu", "up/imu"]),
    "no sensors of speeds": drop("sensors|joint_vel"),
    "sensors in another order": lambda said: said["sensors"]["joint_pos"].reverse(),
}
SCANS: dict[str, Any] = {  # of go1_rough_scan
    "no section of it": drop("height_scan"),
    "no points ahead": drop("height_scan|x"),
    "a point less": lambda said: said["height_scan"]["y"].pop(),
}
NETWORKS: dict[str, Any] = {
    "a row less": pops("observation"),
    "a history more": set_at("observation|3|history", 3),
    "another input": set_at("network|input", "observations"),
    "a memory more": set_at("network|memory", {"input": "state_in", "output": "state_out", "shape": [1, 8]}),
}
EXAMS: dict[str, Any] = {
    "a number": set_at("exam", {"ranges": 3}),
    "a mark that is no speed": set_at("exam", {"push_mark": 9.0}),
    "a range of a command that is not there": set_at("exam", {"ranges": {"height": [0, 1]}}),
    "a range backwards": set_at("exam", {"ranges": {"lin_vel_x": [1, 0]}}),
    "two marks": set_at("exam", {"marks": [1.0, 2.0]}),
    "another robot": set_at("exam", {"peer": "dog"}),
    "no such field": set_at("exam", {"pushes": 3}),
    "speeds of a number": set_at("exam", {"push_speeds": 3}),
}
FAR = '<asset><mesh name="z" file="..&#47;x.obj"/></asset>'
KEY = 'qpos="0 0 0.278'
IN_SCENE = {
    "NaN gravity": ("<option", '<option gravity="0 0 nan"'),
    "gravity of 10^9": ("<option", '<option gravity="0 0 -1e9"'),
    "infinite gravity": ("<option", '<option gravity="0 0 inf"'),
    "no gravity": ("<option", '<option gravity="0 0 0"'),
    "keyframe under the ground": (KEY, 'qpos="0 0 -3'),
    "keyframe is NaN": (KEY, 'qpos="nan 0 0.278'),
    "keyframe is infinite": (KEY, 'qpos="inf 0 0.278'),
    "keyframe far away": (KEY, 'qpos="1e9 0 0.278'),
    "negative timestep": ('timestep="0.004"', 'timestep="-0.004"'),
    "entities": ("<mujoco", '<!DOCTYPE m [<!ENTITY a "b">]><mujoco'),
    "include": ("</worldbody>", '</worldbody><include file="../../etc/passwd"/>'),
    "a mesh": ("</worldbody>", '</worldbody><asset><mesh file="../x.stl"/></asset>'),
    "folder of meshes": ("<compiler", '<compiler meshdir="/home"'),
    "mass of 10^30": ('mass="5.204"', 'mass="1e30"'),
    "a range that ends before it begins": (' range="-0.863 0.863"', ' range="0.863 -0.863"'),
    "no keyframe": ("<key name", "<!-- <key name"),
    "another name of a joint": ('name="FR_hip_joint"', 'name="FR_hip"'),
    "a file elsewhere": ("</worldbody>", f"</worldbody>{FAR}"),
    "a file between comments": (
        "</worldbody>",
        f'</worldbody><custom><text name="<!--" data="a"/></custom>{FAR}<custom><text name="-->" data="a"/></custom>',
    ),
}


def theirs(name: str, change: Change = lambda said: None, folder: str = "out", signed: bool = True) -> Run:
    """A published export whose contract was changed; ``signed`` with a checksum of the whole: the value alone is refused."""

    def given(root: Path) -> None:
        shutil.copytree(POLICIES / name, root / folder)
        said = load_yaml(root / folder / "policy.yaml")
        change(said)
        save_yaml(root / folder / "policy.yaml", said | ({CHECKSUM: checksum(said)} if signed else {}))

    return given


def in_scene(old: str, new: str) -> Run:
    def given(root: Path) -> None:
        file = shutil.copytree(POLICIES / "go1_flat", root / "out") / "scene.xml"
        assert old in file.read_text()
        file.write_text(file.read_text().replace(old, new, 1))

    return given


def damaged(root: Path, content: bytes | None) -> None:
    """A network that was broken before its contract was signed; by half if nothing is said."""
    file = POLICIES / "go1_flat/policy.onnx"
    whole = file.read_bytes()
    content = whole[: len(whole) // 2] if content is None else content
    theirs("go1_flat", set_at("network|sha256", sha256(content).hexdigest()))(root)
    (root / "out/policy.onnx").write_bytes(content)


def zipped(*names: str, method: int = zipfile.ZIP_DEFLATED, text: str = "<mujoco/>") -> Run:
    def write(file: Path) -> None:
        with zipfile.ZipFile(file, "w", method) as archive:
            for name in names:
                archive.writestr(name, text)

    return write


def reads(root: Path) -> None:
    read_contract(root / "out")


def in_scene_too(root: Path) -> None:
    """As by --edited: the scene's checksum would answer first."""
    read_scene(root / "out", read_contract(root / "out", edited=True))


def in_limits_too(root: Path) -> None:
    """Whoever reads the scene refuses it, also for the limits of a real robot."""
    Limits.of(root / "out", read_contract(root / "out", edited=True))


def rules(root: Path) -> None:
    contract_rules(read_contract(root / "out"))


def acts(root: Path) -> None:
    zeros = Measurement(*(np.zeros(12 if name.startswith("joint") else 3) for name in QUANTITIES))
    Controller(root / "out", read_contract(root / "out"), 1).act(zeros, np.zeros((1, 3)))


def limits(root: Path, **asked: Any) -> Limits:
    return Limits.of(root / "out", read_contract(root / "out"), asked)


def table() -> Table:
    made = Table()
    for name, change in CHANGES.items():
        made.add(f"contract: {name}", reads, theirs("go1_flat", change))
    for name, change in UNSIGNED.items():
        made.add(f"contract, not signed: {name}", reads, theirs("go1_flat", change, signed=False))
    for name, change in SCANS.items():
        made.add(f"scan: {name}", reads, theirs("go1_rough_scan", change))
    for name, change in SCENES.items():
        made.add(f"scene: {name}", in_scene_too, theirs("go1_flat", change))
    for name, (old, new) in IN_SCENE.items():
        made.add(f"scene: {name}", in_scene_too, in_scene(old, new))
    made.add("limits by a scene", in_limits_too, in_scene(*IN_SCENE["a file elsewhere"]))
    for name, change in NETWORKS.items():
        made.add(
            f"network: {name}",
            lambda root: Network(root / "out", read_contract(root / "out")),
            theirs("go1_flat", change),
        )
    for name, change in EXAMS.items():
        made.add(f"exam: {name}", rules, theirs("go1_flat", change))
    made.add("exam: no velocity", rules, theirs("go1_handstand"))
    made.add(
        "exam: common, of another robot",
        lambda root: contract_rules(read_contract(root / "out"), common=True),
        theirs("go2_flat", set_at("exam", {"peer": ""})),
    )
    for name, section in {"no such exam": {"kind": "jump"}, "no such field": {"kind": "handstand", "x": 3}}.items():
        made.add(
            f"skill: {name}",
            lambda root: contract_skill(read_contract(root / "out")),
            theirs("go1_handstand", set_at("exam", section)),
        )
    made.add("no export", reads)
    for file in ("policy.onnx", "scene.xml"):
        made.programs(
            "deploy",
            ["out"],
            lambda root, file=file: (theirs("go1_flat")(root), (root / "out" / file).unlink()),
            name=f"no {file}",
        )
    for name, content in {"empty": b"", "of text": b"not a network\n", "half": None}.items():
        made.add(
            f"network {name}",
            lambda root: Network(root / "out", read_contract(root / "out")),
            lambda root, content=content: damaged(root, content),
        )
    made.add("another scene", reads, in_scene("<mujoco", "<!-- mine --><mujoco"))
    made.add(
        "another network", reads, lambda root: (theirs("go1_flat")(root), (root / "out/policy.onnx").write_bytes(b"no"))
    )
    made.add(
        "another motion",
        lambda root: Follower(root / "out", read_contract(root / "out"), 1),
        lambda root: (theirs("g1_track")(root), [file.write_bytes(b"no") for file in (root / "out").glob("*.npz")]),
    )
    for name, given in {
        "no motors": lambda root: None,
        "other motors": lambda root: (root / "motors.npz").write_bytes(b"no"),
    }.items():
        made.add(name, lambda root: make_network(root, Motors("network", digest="x"), 1, 12), given)
    made.add(
        "no terrain",
        lambda root: read_scene(root / "out", read_contract(root / "out"), "terrain.mjz"),
        theirs("go1_flat"),
    )
    made.add(
        "a terrain that is gone",
        lambda root: read_scene(root / "out", read_contract(root / "out"), "terrain.mjz"),
        lambda root: (theirs("go1_rough")(root), (root / "out/terrain.mjz").unlink()),
    )
    made.add(
        "no feet for odometry",
        lambda root: Odometry(root / "out", read_contract(root / "out")),
        theirs("go1_flat", set_at("robot|feet", {})),
    )
    made.add("a limit that is none", lambda root: limits(root), theirs("go1_flat", set_at("safety", {"tlit": 3})))
    made.add(
        "a machine's limit that is none",
        lambda root: Limits.of(root / "out", read_contract(root / "out"), {"tlit": 3}),
        theirs("go1_flat"),
    )
    made.add("a limit of words", lambda root: limits(root, tilt="x"), theirs("go1_flat"))
    made.add(
        "a policy of speeds",
        lambda root: Safety(read_contract(root / "out"), limits(root)),
        theirs("go1_flat", set_at("action|origin", "speed")),
    )
    made.add(
        "a row of others",
        acts,
        theirs("go1_flat", lambda said: said["observation"][0].update(measured="sensors", sensors=["x"])),
    )
    for name, write in {
        "of text": lambda file: file.write_bytes(b"PK"),
        "of two files": zipped("model.xml", "terrain.xml"),
        "of another file": zipped("terrain.xml"),
        "of no file": zipped(),
        "packed by LZMA": zipped("model.xml", method=zipfile.ZIP_LZMA),
        "packed by bzip2": zipped("model.xml", method=zipfile.ZIP_BZIP2),
        "that unpacks to more than there may be": zipped("model.xml", text=" " * (mjcf.MOST_BYTES + 1)),
        "that names another": lambda file: write_archive(file, '<mujoco><include file="other.xml"/></mujoco>'),
        "that names a mesh": lambda file: write_archive(file, '<mujoco><asset><mesh file="m.obj"/></asset></mujoco>'),
    }.items():
        made.add(
            f"terrain {name}",
            lambda root: read_scene(root / "out", read_contract(root / "out", edited=True), "terrain.mjz"),
            lambda root, write=write: (
                theirs("go1_rough")(root),
                write(root / "out/terrain.mjz"),
                (root / "other.xml").write_text("<mujoco/>"),  # where a model of a text would look for it
            ),
        )
    small = patched(in_scene_too, mjcf, MOST_BYTES=1000)
    made.add("scene: large", small, theirs("go1_flat"))
    made.add(
        "scene: a joint more",
        in_scene_too,
        in_scene("</worldbody>", '<body><joint name="tail"/><geom size="1"/></body></worldbody>'),
    )
    return made
