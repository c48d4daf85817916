"""What a robot model does not fit, by MuJoCo's names: gains, names, sites, mirror images, engines."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mujoco
from test_robot_page import WHEEL
from test_sim import SOLES, build_toy, go1, toy
from test_symmetry import GO1, WAIST, load_robot, replaced

from golden.table import Table
from legged_mw.robot.draft import draft
from legged_mw.sim.engines import make_simulation, pick_engine
from legged_mw.sim.joints import match_joints, per_joint
from legged_mw.sim.mirror import find_partners
from legged_mw.sim.model import RobotModel
from legged_mw.sim.surface_points import spheres_on
from legged_mw.skills.kinematics import Kinematics

CHOICES: dict[str, dict[str, Any]] = {  # of the Go1
    "gains of two keys": {"stiffness": {"joint": 35.0, "thigh": 2.0, "FR_hi": 20.0}},
    "gains of hips alone": {"stiffness": {"hip": 1.0, "thigh": 2.0}},
    "no gains": {"damping": {}},
    "gains of another joint": {"damping": {"joint": 35.0, "FR_hip_joitn": 20.0}},
    "gains of another joint and none of a third": {"damping": {"hip": 1.0, "tihgh": 2.0}},
    "another collider": {"colliders": ["FR", "FL", "RR", "RLL"]},
    "another pattern": {"colliders": ["foot_*"]},
    "another foot": {"contact_geoms": ["FR", "FL", "RR", "RLL"]},
    "another IMU": {"imu_site": "imuu"},
    "no file": {"file": Path("dog.xml")},
    "no URDF": {"file": Path("dog.urdf")},
}
TOYS: dict[str, tuple[dict[str, str], dict[str, Any]]] = {
    "a rail for a root": ({"root": '<joint name="rail" type="slide"/>'}, {}),
    "a ball for a neck": ({"inside": '<body><joint name="neck" type="ball"/><geom size="0.1"/></body>'}, {}),
    "a joint without a name": ({"inside": '<body><joint axis="0 0 1"/><geom size="0.1"/></body>'}, {}),
    "a cart beside it": ({"world": '<body name="cart"><joint name="rail" type="slide"/><geom size="0.1"/></body>'}, {}),
    "a name twice": ({"inside": '<site name="imu"/>'}, {}),
    "a mesh that is not there": (
        {"inside": '<geom type="mesh" mesh="hull"/>', "extra": '<asset><mesh name="hull" file="hull.stl"/></asset>'},
        {},
    ),
    "a body without a geom": (
        {
            "inside": '<body name="tail"><joint name="tail_hip"/><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/></body>'
        },
        {"contact_geoms": ["tail"]},
    ),
    "a site of another geom": (
        {"inside": SOLES},
        {"sites": {"left_sole": ["left_heal"]}},
    ),
    "a site of no geom": (
        {"inside": SOLES},
        {"sites": {"left_sole": []}, "damping": {"": 0.2}, "stiffness": {"": 1.0}},
    ),
    "two joints of a body, one held": (
        {"inside": '<body name="arm"><joint name="a"/><joint name="b" axis="1 0 0"/><geom size="0.1"/></body>'},
        {"held_joints": ["b"], "stiffness": {"": 1.0}, "damping": {"": 1.0}},
    ),
}
BARE = """<mujoco><worldbody><body name="base" pos="0 0 1"><freejoint/><geom size="0.1" mass="3" contype="0" conaffinity="0"/>
<body name="leg"><joint name="hip" axis="0 1 0"/>{}</body></body></worldbody></mujoco>"""
SHAPES = {
    "a robot that touches nothing": '<geom size="0.05" pos="0 0 -0.2" mass="1" contype="0" conaffinity="0"/>',
    "a robot whose legs point up": '<geom size="0.05" pos="0 0 0.3" mass="1"/>',
}
HILLS = """<mujoco><asset><hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/></asset>
<worldbody><geom name="hills" type="hfield" hfield="h"/></worldbody></mujoco>"""
MIRRORS: dict[str, tuple[str, str]] = {
    "an axis": ('name="waist_roll" axis="1 0 0"', 'name="waist_roll" axis="1 0.1 0"'),
    "a kind": ('name="left_hand" type="slide"', 'name="left_hand"'),
    "a zero": ('name="left_arm" axis', 'name="left_arm" ref="0.3" axis'),
}


@cache
def dog() -> RobotModel:
    return go1()


def partners(robot: str, old: str, new: str) -> None:
    with TemporaryDirectory() as folder:
        find_partners(load_robot(Path(folder) / "robot.xml", replaced(robot, old, new, 1)))


def simulated() -> Any:
    return make_simulation(dog().physics, 1, "cpu", engine="mujoco", nconmax=8, njmax=40, world_fields=["body_mass"])


def table() -> Table:
    made = Table()
    for name, choice in CHOICES.items():
        made.add(f"Go1, {name}", lambda root, choice=choice: go1(**choice))
    for name, (parts, choice) in TOYS.items():
        made.add(
            f"toy, {name}",
            lambda root, choice=choice: build_toy(Path("toy.xml"), **choice),
            lambda root, parts=parts: toy(root, **parts),
        )
    for name, (old, new) in MIRRORS.items():
        made.add(f"mirror, {name}", lambda root, old=old, new=new: partners(WAIST, old, new))
    two = " ".join(f'<joint name="{name}" axis="0 1 0" armature="1"/>' for name in "ab")
    made.add(
        "mirror, two joints in one place", lambda root: partners(WAIST, '<joint name="waist_pitch" axis="0 1 0"/>', two)
    )
    made.add("mirror, a joint", lambda root: partners(GO1, 'pos="0.1881 0.04675 0"', 'pos="0.1881 0.05175 0"'))
    made.add("mirror, a site", lambda root: find_partners(dog(), ["imu"]))
    made.calls(
        {
            "two keys fit": lambda: per_joint({"": 0.0, "hip": 1.0, "yaw": 2.0}, ["hip_yaw"], "gains"),
            "no value": lambda: per_joint({"hip": 0.0}, ["hip", "knee"], "gains"),
            "a body by name": lambda: dog().id("body", "FR_hipp"),
            "engine: on a GPU": lambda: pick_engine("mujoco", "cuda:0"),
            "fields: not declared": lambda: simulated().field("geom_fricton"),
            "kinematics: of the world": lambda: Kinematics(dog().physics, [0], "cpu"),
        }
    )
    for field in ("body_mas", "body_parentid"):
        made.add(
            f"fields: {field}",
            lambda root, field=field: make_simulation(
                dog().physics, 1, "cpu", engine="mujoco", nconmax=8, njmax=40, world_fields=[field]
            ),
        )
    wheel = WHEEL.format(half=0.2, offset=0.0, more="")
    made.add(
        "draft of a robot without feet",
        lambda root: draft(Path("a.xml")),
        lambda root: (root / "a.xml").write_text(wheel),
    )
    for name, leg in SHAPES.items():
        made.add(
            f"draft of {name}",
            lambda root: draft(Path("a.xml")),
            lambda root, leg=leg: (root / "a.xml").write_text(BARE.format(leg)),
        )
    made.add("shapes: a height field", lambda root: spheres_on(mujoco.MjModel.from_xml_string(HILLS), 0, 0.1))
    made.add("joints: a pattern of none", lambda root: match_joints(["hip"], ["neck"], "held"))
    return made
