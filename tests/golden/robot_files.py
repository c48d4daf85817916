"""MJCF and URDF: the tables of tests/campaign/test_mjcf.py, and what a robot's names must fit."""

from __future__ import annotations

import test_mjcf as campaign
from test_mjcf import given, reads
from worlds import make_env

from golden.table import Table

TOY = """<mujoco model="toy"><worldbody><body name="base" pos="0 0 1"><freejoint/><geom name="trunk" size="0.1" mass="3"/>
<body name="leg"><joint name="hip" axis="0 1 0"/>{}
<geom name="shin" size="0.05" pos="0 0 -0.2" mass="1"/></body></body>{}</worldbody>{}</mujoco>"""
TEXTS = {
    "an empty world": "<mujoco><worldbody/></mujoco>",
    "two robots": TOY.format("", '<body name="other"><freejoint/><geom size="1"/></body>', ""),
    "no free root": TOY.replace("<freejoint/>", '<joint name="slider" type="slide"/>').format("", "", ""),
    "no joint": '<mujoco><worldbody><body name="rock"><freejoint/><geom size="1"/></body></worldbody></mujoco>',
    "a joint without a name": TOY.replace('<joint name="hip"', "<joint").format("", "", ""),
    "a ball": TOY.format('</body><body name="arm"><joint name="ball" type="ball"/><geom size="0.1"/>', "", ""),
    "a mesh of mass": TOY.format(
        '<geom type="mesh" mesh="hull"/>', "", '<asset><mesh name="hull" file="hull.stl"/></asset>'
    ),
    "a mesh that touches": TOY.format(
        '<geom type="mesh" mesh="hull" mass="0"/>', "", '<asset><mesh name="hull" file="hull.stl"/></asset>'
    ),
}
URDF = """<robot name="mini"><link name="base">{}<inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
URDFS = {
    "xacro": '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="a"><xacro:macro name="x"/></robot>',
    "not closed": '<robot name="mini"><link name="base"></robot>',
    "a shape of no size": URDF.format('<collision><geometry><sphere radius="0"/></geometry></collision>'),
    "a mesh that is not there": URDF.format(
        '<collision><geometry><mesh filename="package://a/b.dae"/></geometry></collision>'
    ),
}
FIELDS = {  # of go1_flat
    "no joint": {"asset.armature": {"kneee": 0.1}},
    "two keys": {"control.stiffness": {"FR_hip": 1.0, "hip_jo": 2.0, "": 3.0}},
    "no value": {"control.damping": {"hip": 1.0}},
    "a foot": {"asset.foot_names": ["left_foot", "FL", "RR", "RL"]},
    "an IMU": {"asset.imu_site": "nose"},
    "an IMU on a leg": {"asset.imu_site": "FR_calf"},
    "a held joint": {"asset.held_joints": {"neck": 0.0}},
    "a body without a geom": {"asset.foot_names": ["FR", "FL", "RR", "imu"]},
    "a collider": {"asset.colliders": ["nosuch"]},
    "friction loss": {"asset.frictionloss": {"kneee": 0.1}},
}


def table() -> Table:
    made = Table()
    for name, text, *_ in campaign.TEXTS:
        made.add(f"MJCF, {name}", reads(), given(text))
    for name, text, *_ in campaign.URDFS:
        made.add(f"URDF, {name}", reads("robot.urdf"), given(text, "robot.urdf"))
    made.campaign("", campaign.OTHERS)
    for name, text in TEXTS.items():
        made.add(f"toy, {name}", reads(), given(text))
    for name, text in URDFS.items():
        made.add(f"mini, {name}", reads("robot.urdf"), given(text, "robot.urdf"))
    made.add("no URDF", reads("none.urdf"))
    for name, fields in FIELDS.items():
        made.add(f"go1_flat, {name}", lambda root, fields=fields: make_env(1, fields))
    return made
