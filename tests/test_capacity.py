"""Room for contacts and constraint rows, counted from the model, against counts by hand and against what robots that fall need."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from program import SMALL, run
from worlds import make_env

from legged_mw import ROOT
from legged_mw.check.describe import describe
from legged_mw.sim.capacity import count_capacity
from legged_mw.sim.engines import make_simulation
from legged_mw.sim.model import Ground, Solver, build_model
from legged_mw.utils.task import load_task

GO1, G1 = (ROOT / f"resources/robots/{name}/{name}.xml" for name in ("go1", "g1"))


def walker(foot: str, *, shin: str = "", condim: int = 3, own: bool = False, more: str = "") -> mujoco.MjModel:
    """A trunk that is a box, and two legs of a joint with limits and dry friction and one without, with ``foot`` on the last link."""
    touch = f'contype="{2 if own else 0}" conaffinity="{3 if own else 1}"'
    leg = f"""
    <body pos="{{x}} 0 0">
      <joint name="{{n}}_a" axis="0 1 0" range="-1 1" limited="true" frictionloss="0.1"/><geom size="0.01" contype="0" conaffinity="0"/>
      {shin.replace("<geom", f"<geom {touch}")}
      <body pos="0 0 -0.2"><joint name="{{n}}_b" axis="0 1 0"/>{foot.replace("<geom", f"<geom {touch}")}</body>
    </body>"""
    xml = f"""<mujoco><worldbody>
      <geom name="floor" type="plane" size="0 0 1" contype="1" conaffinity="0" condim="{condim}"/>
      <body name="trunk" pos="0 0 1"><freejoint/><geom type="box" size="0.1 0.1 0.1" {touch}/>
      {leg.format(x=0.1, n="left")}{leg.format(x=-0.1, n="right")}</body></worldbody>{more}</mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


BALL, STICK, BRICK = (
    '<geom size="0.02"/>',
    '<geom type="capsule" size="0.02 0.1"/>',
    '<geom type="box" size="0.1 0.04 0.02"/>',
)


@pytest.mark.parametrize(
    ("model", "contacts", "rows"),
    [  # 2 rows of dry friction, 2 of limits; a quarter of the trunk's four contacts
        (walker(BALL), 3, 4 + 4 * 3),
        (walker(STICK), 5, 4 + 4 * 5),
        (walker(BRICK), 9, 4 + 4 * 9),
        (walker(BALL * 3), 7, 4 + 4 * 7),
        (walker('<geom type="cylinder" size="0.02 0.02"/>'), 9, 4 + 4 * 9),
        (walker('<geom type="ellipsoid" size="0.02 0.03 0.04"/>'), 3, 4 + 4 * 3),
        (walker(BALL, shin=STICK), 4, 4 + 4 * 4),  # a quarter of a shin's, too
        (walker(BALL, condim=1), 3, 4 + 3),
        (walker(BALL, condim=6), 3, 4 + 10 * 3),
        (walker(BALL, more='<equality><joint joint1="left_a"/><weld body1="trunk"/></equality>'), 3, 4 + 7 + 4 * 3),
    ],
)
def test_rows_by_hand(model: mujoco.MjModel, contacts: int, rows: int) -> None:
    room = count_capacity(model, terrain=False)
    assert room[:2] == (max(contacts, 8), rows) and f" a contact with the ground ({contacts})" in room.why


def test_parts_that_may_touch_one_another_want_more() -> None:
    room, alone = (
        count_capacity(walker(BRICK * 4, own=True), terrain=False),
        count_capacity(walker(BRICK * 4), terrain=False),
    )
    assert (room.contacts, room.rows) == (alone.contacts + 2 * 4, alone.rows + 4 * 4)  # nine geoms
    assert room.why == "2 dry friction, 2 limits, 4 a contact with the ground (33), 4 a contact of its own (4)"


def test_terrain_wants_more() -> None:
    """A sphere in a corner touches twice; a capsule of 20 cm along its probes."""
    assert count_capacity(walker(BALL), terrain=True).rows > 4 + 4 * 2 * 2
    stick = count_capacity(walker(STICK), terrain=True)
    assert 4 + 4 * 2 * 3 < stick.rows < 4 + 4 * 2 * 8
    assert count_capacity(walker(STICK.replace("capsule", "cylinder")), terrain=True).rows == stick.rows


@pytest.mark.parametrize(("task", "counted"), [("go1_flat", (8, 40)), ("go1_rough", (8, 56))])
def test_the_go1_gets_what_was_found_by_hand(task: str, counted: tuple[int, int]) -> None:
    env = make_env(1, {"terrain.num_rows": 1, "terrain.num_cols": 8} if task == "go1_rough" else None, task=task)
    assert count_capacity(env.robot.physics, env.terrain is not None)[:2] == counted
    assert (env.cfg.sim.nconmax, env.cfg.sim.njmax) == counted  # and still says so


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize(
    "file", [GO1, G1, *sorted((ROOT / "tests/data").glob("*_style.*"))], ids=lambda file: file.stem
)
def test_robots_that_thrash_find_room(file: Path, own: bool) -> None:
    """All that collides may touch, and the robot is thrown about: MuJoCo makes no more contacts and rows than were counted."""
    gains: dict[str, Any] = {"stiffness": {"": 30.0}, "damping": {"": 1.0}, "pose": {"": 0.0}}
    nothing: dict[str, Any] = {"contact_geoms": [], "imu_site": ""}
    robot = build_model(
        file, solver=Solver(), ground=Ground(), colliders=["*"], self_collisions=own, **gains, **nothing
    )
    model, draw = robot.physics, np.random.default_rng(0)
    data, room, most = mujoco.MjData(model), count_capacity(model, terrain=False), np.zeros(2)
    ends = np.where(model.jnt_limited[1:, None], model.jnt_range[1:], [-1.0, 1.0]).T
    for step in range(1500):
        if step % 300 == 0:
            mujoco.mj_resetData(model, data)
            data.qpos[2:7] = [0.6, *draw.normal(size=4)]
        if step % 10 == 0:
            data.ctrl = draw.uniform(*ends)
        mujoco.mj_step(model, data)
        most = np.maximum(most, [data.ncon, data.nefc])
    assert (most <= room[:2]).all() and most[1] > 0.2 * room.rows, (most, room)


def test_an_engine_takes_what_was_counted() -> None:
    model = make_env(1).robot.physics
    cases: list[tuple[dict[str, Any], tuple[int, int]]] = [
        ({}, (8, 40)),
        ({"nconmax": 5}, (5, 40)),
        ({"njmax": 50}, (8, 50)),
    ]
    for asked, got in cases:
        sim: Any = make_simulation(model, 1, "cpu", engine="mujoco_warp", eager=True, **asked)
        assert (sim.nconmax, sim.njmax) == got


def test_check_says_what_room_there_is(tmp_path: Path) -> None:
    """And where the numbers come from."""
    result = run("train", tmp_path, *SMALL, "--eager", "--check", "--set", "sim.nconmax=0", "--set", "sim.njmax=0")
    why = "12 dry friction, 12 limits, 4 a contact with the ground (4)"
    assert f"\nroom of a world on mujoco_warp: sim.nconmax 8, sim.njmax 40, from the model: {why}\n" in result.out
    env, task = make_env(1, {"sim.njmax": 30}), load_task("go1_flat")
    assert f"sim.nconmax 8, sim.njmax 30, from the config; the model makes 8 and 40: {why}\n" in describe(env, task)


def test_an_overflow_names_the_fields(tmp_path: Path) -> None:
    too_little = ["--engine", "mujoco_warp", "--set", "sim.njmax=12", "--max_iterations", "1"]
    result = run("train", tmp_path, *SMALL, *too_little)
    assert "WARNING: simulator overflow (NEFC) in 16 of 16 worlds; raise njmax (now 12)\n" in result.out
