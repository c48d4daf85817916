"""The port of legged_gym's A1 task: what it adds to the environment, its rewards against figures by hand, and that its step records."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from program import run
from torch import Tensor
from worlds import QUIET, changed, layout, make_env, same, snapshot

from legged_mw import ROOT, programs
from legged_mw.check.recordable import recordable
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval import plots, rollout
from legged_mw.sim.model import Ground, Solver, build_model
from legged_mw.utils import math as math_of_steps
from legged_mw.utils.task import load_task

TASK = str(ROOT / "examples/go1_legged_gym.py")
PAGE = ROOT / "docs/from_legged_gym.md"
BEFORE_AND_AFTER = ROOT / "docs/legged_gym_config.md"
DT = 0.02  # [s] a control step
# legged_gym's, where they are not 0: envs/base/legged_robot_config.py and envs/a1/a1_config.py
SCALES = {
    "tracking_lin_vel": 1.0,
    "tracking_ang_vel": 0.5,
    "lin_vel_z": -2.0,
    "ang_vel_xy": -0.05,
    "torques": -0.0002,
    "dof_acc": -2.5e-7,
    "feet_air_time": 1.0,
    "collision": -1.0,
    "action_rate": -0.01,
    "dof_pos_limits": -10.0,
}
# In the two worlds of `paint`, both upright: 0 walks ahead, 1 is told to turn on the spot.
EXPECTED = {
    # v_imu = (1, 0, 0.5) + w x r, r = (-0.01592, -0.06659, -0.00617), w = (0.3, 0.4, 0): z + 0.3 * -0.06659 - 0.4 * -0.01592
    "lin_vel_z": (0.486391**2, 0.0),
    "ang_vel_xy": (0.09 + 0.16, 0.0),
    # height 0.35 and 0.2, target 0.25
    "base_height": (0.01, 0.0025),
    # (4, 3, -12); twelve of 1
    "torques": (169.0, 12.0),
    "dof_vel": (4.0 + 9.0, 12 * 0.25),
    # from (1, 0, ...) to (2, 0, ..., -3): (1^2 + 3^2) / 0.02^2; from 0 to -0.5 twelve times
    "dof_acc": (10.0 / 4e-4, 3.0 / 4e-4),
    # FR lands after 0.6, RL after 0.3 (the step adds 0.02): 0.1 - 0.2; told to turn: nothing
    "feet_air_time": (-0.1, 0.0),
    # two capsules of one thigh, one of a calf: two bodies; a foot and the trunk are not counted
    "collision": (2.0, 0.0),
    # 0.5^2 + 2^2; twelve of 0.1^2
    "action_rate": (4.25, 0.12),
}


def ported(
    num_envs: int = 4, overrides: dict[str, Any] | None = None, env_class: type[LeggedRobot] | None = None
) -> Any:
    return make_env(num_envs, {**QUIET, **(overrides or {})}, task=TASK, env_class=env_class)


def touch(env: LeggedRobot, world: int, *geoms: str) -> None:
    """These geoms and no others touch the ground."""
    env.contact_count[world] = 0.0
    for name in geoms:
        env.contact_count[world, env.robot.contact_geoms.index(name)] = 1.0


def yaw(angle: float) -> Tensor:
    return torch.tensor([math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)])


def paint(env: Any) -> None:
    """Made-up numbers in worlds 0 and 1 and in what they remember; then what a step derives."""
    sim = env.sim
    env.reset()
    sim.qpos[:2, 2], sim.qpos[:2, 3:7] = torch.tensor([0.35, 0.2]), yaw(0.0)
    sim.qvel[:2, :6] = torch.tensor([[1.0, 0.0, 0.5, 0.3, 0.4, 0.0], [0.0] * 6])
    sim.qvel[:2, 6:] = torch.tensor([[2.0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, -3.0], [-0.5] * 12])
    env.last_dof_vel[:2] = torch.tensor([[1.0] + [0.0] * 11, [0.0] * 12])
    sim.actuator_force[:2] = torch.tensor([[4.0, 0, 0, 0, 3.0, 0, 0, 0, 0, 0, 0, -12.0], [1.0] * 12])
    env.actions[:2] = torch.tensor([[0.5, -1.0] + [0.3] * 10, [0.2] * 12])
    env.last_actions[:2] = torch.tensor([[1.0, 1.0] + [0.3] * 10, [0.1] * 12])
    env.commands[:2] = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.05, 1.0]])
    env.feet_air_time[:2] = torch.tensor([0.58, 0.0, 0.5, 0.28])
    touch(env, 0, "FR", "FL", "RL", "FR_thigh_1", "FR_thigh_3", "RL_calf_2")
    touch(env, 1, "FR", "FL", "RR", "RL", "trunk_left")
    env._update_state()
    env.check_termination()


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    env = ported()
    paint(env)
    yield env
    for name, values in EXPECTED.items():  # no test may have disturbed the picture
        assert getattr(env, f"_reward_{name}")()[:2].tolist() == pytest.approx(values, rel=2e-5, abs=1e-6)


# ---- rewards and termination


def test_scales_are_legged_gyms(env: Any) -> None:
    assert env._active_scales() == SCALES


@pytest.mark.parametrize("name", EXPECTED)
def test_reward_term(env: Any, name: str) -> None:
    before = snapshot(env)
    value = getattr(env, f"_reward_{name}")()
    assert value[:2].tolist() == pytest.approx(EXPECTED[name], rel=2e-5, abs=1e-6)
    assert value.dtype == torch.float and changed(env, before) == []


def test_on_rough_ground_heights_are_above_the_ground() -> None:
    stairs = {
        "mesh_type": "heightfield",
        "num_rows": 1,
        "num_cols": 1,
        "difficulty": [1.0, 1.0],
        "terrain_proportions": {"stairs_up": 1},
    }
    env = ported(
        2,
        {
            **{f"terrain.{name}": value for name, value in stairs.items()},
            "terrain.height_scan": ["state"],
            "noise.level": 0,
        },
    )
    env.reset()
    deep = -float(env.terrain.origins[0, 0, 2])  # [m] of the pit where episodes begin
    env.sim.qpos[:, :3] = torch.tensor([[0.0, 0.0, 0.35 - deep], [5.0, 0.0, 0.35]])  # in the pit, and beside all tiles
    env._update_state()
    env.compute_observations()
    assert deep > 1.0 and env._reward_base_height().tolist() == pytest.approx([0.01, 0.01], rel=1e-4)
    scan = env.obs_buf["state"][:, 48:]
    assert scan.shape == (2, 187) and scan[:, 93].tolist() == pytest.approx([5.0 * (0.35 - 0.42)] * 2, abs=1e-5)


def test_torque_beyond_its_share_of_the_limit() -> None:
    env = ported(1, {"rewards.soft_torque_limit": 0.5, "rewards.scales.torque_limits": -1.0})
    env.sim.actuator_force[0] = torch.tensor([20.0, 0.0, -20.0] + [0.0] * 9)  # hip 20 - 11.85, calf 20 - 17.775
    assert env._reward_torque_limits().tolist() == pytest.approx([8.15 + 2.225])


def test_trunk_on_the_ground_is_a_fall_and_tilt_is_not(env: Any) -> None:
    assert env.fell[:2].tolist() == [False, True] and not env.broken[:2].any()
    other = ported(2)
    other.sim.qpos[:, 2] = torch.tensor([0.05, 1.0])  # lying; in the air
    other.sim.qpos[:, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])  # and upside down, legs away from the ground
    other.step(torch.zeros(2, 12))
    assert other.fell.tolist() == [True, False] == other.reset_buf.tolist()


def test_calf_on_the_ground_costs_and_does_not_end() -> None:
    env = ported(1)
    env.default_dof_pos[:] = torch.tensor([0.0, 1.2, -2.7] * 4)  # kneeling: feet lifted, calves along the ground
    env.sim.qpos[0, 2], env.sim.qvel[0] = 0.13, 0.0
    env.sim.qpos[0, 7:] = env.default_dof_pos
    counts = []
    for _ in range(10):
        env.step(torch.zeros(1, 12))
        counts.append(int(env._reward_collision()))
    assert max(counts) >= 2 and not env.fell.any()


# ---- observations


def test_observation_is_legged_gyms_row_for_row(env: Any) -> None:
    assert list(layout(env)["state"].items()) == [
        ("base_lin_vel", 3),
        ("base_ang_vel", 3),
        ("projected_gravity", 3),
        ("commands", 3),
        ("dof_pos", 12),
        ("dof_vel", 12),
        ("last_actions", 12),
    ]
    env.compute_observations()
    obs = env.get_observations()["state"][1]
    assert obs[:3].tolist() == pytest.approx([0.0] * 3)
    assert obs[6:12].tolist() == pytest.approx([0.0, 0.0, -1.0, 0.0, 2 * 0.05, 0.25])
    assert obs[24:36].tolist() == pytest.approx([-0.5 * 0.05] * 12)
    assert obs[36:].tolist() == pytest.approx([0.1] * 12)


def test_noise_is_in_the_value_s_unit_and_scaled_with_it() -> None:
    env = ported(512, {"noise.level": 1.0})
    env.compute_observations()
    clean = (
        torch.cat([row.value for row in env.observation_rows()["state"]], dim=1)
        * env.observations._parts["state"]._scales
    )
    error = (env.get_observations()["state"] - clean).abs().amax(dim=0)
    most = [(3, 0.1 * 2.0), (3, 0.2 * 0.25), (3, 0.05), (3, 0.0), (12, 0.01), (12, 1.5 * 0.05), (12, 0.0)]
    wanted = torch.tensor([level for size, level in most for _ in range(size)])
    assert (error <= wanted * 1.0001 + 1e-6).all() and (error >= wanted * 0.95).all()


def test_a_mirror_follows_the_scales(env: Any) -> None:
    plain = ported(1, {f"normalization.obs_scales.{name}": 1.0 for name in ("lin_vel", "ang_vel", "dof_vel")})
    assert plain.observations._parts["state"]._scales is None
    x, scale = torch.randn(5, 48), env.observations._parts["state"]._scales
    image = env.mirror.observations["state"](x * scale)
    torch.testing.assert_close(image, plain.mirror.observations["state"](x) * scale)
    torch.testing.assert_close(env.mirror.observations["state"](image), x * scale)


# ---- commands, pushes, resets


def test_yaw_rate_steers_to_the_heading() -> None:
    env = ported(4, {"commands.resampling_time": 10.0})
    env.sim.qpos[:, 3:7] = torch.stack([yaw(0.0), yaw(3.0), yaw(0.0), yaw(-3.0)])
    env.heading.copy_(torch.tensor([1.0, -3.0, 3.0, 2.5]))
    env._end_step()
    around = 0.5 * (2 * math.pi - 6.0)  # the short way past pi
    assert env.commands[:, 2].tolist() == pytest.approx([0.5, around, 1.0, 0.5 * (5.5 - 2 * math.pi)], abs=1e-5)
    env.cfg.commands.heading_command = False
    env.commands[:, 2] = 0.7
    env._end_step()
    assert env.commands[:, 2].tolist() == pytest.approx([0.7] * 4)


def test_commands_are_redrawn_every_ten_seconds_and_never_too_small_to_walk_at() -> None:
    env = ported(2000, {"commands.resampling_time": 10.0})
    assert torch.equal(env.command_timer, torch.full((2000, 1), 500.0))
    speed = env.commands[:, :2].norm(dim=1)
    assert ((speed == 0.0) | (speed > 0.2)).all()
    # a circle of radius 0.2 in a square of side 2
    assert (speed == 0.0).float().mean().item() == pytest.approx(math.pi * 0.04 / 4, abs=0.015)
    before, heading = env.commands.clone(), env.heading.clone()
    mask = torch.arange(2000) < 1000
    env._resample_commands(mask)
    assert torch.equal(env.commands[1000:], before[1000:]) and torch.equal(env.heading[1000:], heading[1000:])
    assert not torch.equal(env.commands[:1000], before[:1000]) and not torch.equal(env.heading[:1000], heading[:1000])


def test_a_push_replaces_the_horizontal_velocity_every_fifteen_seconds() -> None:
    env = ported(3, {"perturbation.push": True})
    env.sim.qvel[:] = 5.0
    env.perturbation._push_clock.copy_(torch.tensor([750.0, 2.0, 1.0]))
    env.perturbation._push_robots()
    assert (env.sim.qvel[:2] == 5.0).all() and (env.sim.qvel[2, 2:] == 5.0).all()
    assert env.sim.qvel[2, :2].abs().max() <= 1.0 and env.perturbation._push_clock.tolist() == [749.0, 1.0, 750.0]


def test_joints_are_scattered_at_reset_and_the_exam_starts_without() -> None:
    env = ported(500)
    ratio = env.dof_pos / env.default_dof_pos
    assert ratio.min() >= 0.5 and ratio.max() <= 1.5 and ratio.std(dim=0).min() > 0.25
    env.last_dof_vel.fill_(1.0)
    kept = env.dof_pos[1:].clone()
    env.reset_envs(torch.arange(500) < 1)
    assert same(env.dof_pos[1:], kept) and not env.last_dof_vel[0].any() and env.last_dof_vel[1:].all()
    task = load_task(TASK)
    rollout.prepare(task)
    assert task.cfg.init_state.dof_pos_range == [1.0, 1.0] and not task.cfg.perturbation.kick
    graded = make_env(
        2, {path: value for path, value in rollout.OVERRIDES.items() if path != "env.num_envs"}, task=TASK
    )
    assert torch.equal(graded.dof_pos, graded.default_dof_pos.expand(2, -1))
    graded.commands[:] = torch.tensor([0.1, 0.0, 1.2])  # the exam's commands are its own: no steering, no limit
    graded.compute_observations()
    graded.step(torch.zeros(2, 12))
    assert graded.commands.tolist() == [pytest.approx([0.1, 0.0, 1.2])] * 2


# ---- the step, and the programs


def test_trains_and_is_graded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollout, "EXAM_SECONDS", 2.1)
    small = [
        *shlex.split("--set 'actor.hidden_dims=[16]' --set 'critic.hidden_dims=[16]'"),
        *shlex.split("--set runner.num_steps_per_env=8"),
    ]
    result = run(
        "train", tmp_path, "--task", TASK, "--num_envs", "16", "--device", "cpu", "--max_iterations", "2", *small
    )
    assert result.code == 0, result.err
    assert list((tmp_path / "logs/go1_legged_gym").glob("*/model_2.pt"))
    monkeypatch.setattr(programs, "grade_export", lambda *_: [])  # the same once more, through an export
    monkeypatch.setattr(plots, "sections", lambda *_: [])  # drawn in test_report
    result = run("play", tmp_path, "--task", TASK, "--device", "cpu", "--eval")
    assert result.code == 0 and "survives pushes of 6 m/s" in result.out, result.err


# ---- the page


def blocks() -> list[str]:
    """The page's Python blocks that are whole config files."""
    found = re.findall(r"```python\n(.*?)```", BEFORE_AND_AFTER.read_text(encoding="utf-8"), flags=re.DOTALL)
    return [block for block in found if "TASK = Task(" in block]


def test_code_on_the_page_runs(tmp_path: Path) -> None:
    assert len(blocks()) == 1
    file = tmp_path / "ported.py"
    file.write_text(blocks()[0])
    env: Any = make_env(3, task=str(file))
    env.step(torch.randn(3, 12))
    with recordable():
        terms = {name: getattr(env, f"_reward_{name}")() for name in ("hip_pos", "action_smoothness")}
    assert set(terms) <= set(env.reward_names) and all(
        term.shape == (3,) and bool((term > 0).all()) for term in terms.values()
    )


def test_the_page_names_fields_and_methods_that_exist() -> None:
    """What stands in the right column of its tables."""
    task = load_task(TASK)
    both = {**task.cfg.to_dict(), **task.train.to_dict()}
    sections = {name for name, value in both.items() if isinstance(value, dict)}
    rows = [line.split("|")[2] for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    paths = [
        path
        for cell in rows
        for path in re.findall(r"`([a-z_]+(?:\.[a-z_]+)+)`", cell)
        if path.split(".")[0] in sections
    ]
    methods = [name for cell in rows for name in re.findall(r"`(_?[a-z_]+)\(", cell)]
    assert len(paths) > 40 and len(methods) > 10
    for path in paths:
        value: Any = both
        for name in path.split("."):
            assert name in value, path
            value = value[name]
    assert [name for name in methods if not (hasattr(LeggedRobot, name) or hasattr(math_of_steps, name))] == []


URDF = """<robot name="mini">
  <link name="base"><inertial><mass value="5"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>
    <collision><geometry><box size="0.3 0.2 0.1"/></geometry></collision></link>
  <link name="thigh"><inertial><mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>
    <collision><origin xyz="0 0 -0.1"/><geometry><cylinder radius="0.02" length="0.2"/></geometry></collision></link>
  <joint name="thigh_joint" type="revolute"><parent link="base"/><child link="thigh"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="2" effort="33.5" velocity="21"/></joint>
  <link name="FR_foot"><inertial><mass value="0.06"/><inertia ixx="1e-5" ixy="0" ixz="0" iyy="1e-5" iyz="0" izz="1e-5"/></inertial>
    <collision><geometry><sphere radius="0.02"/></geometry></collision></link>
  <joint name="foot_fixed" type="fixed"><parent link="thigh"/><child link="FR_foot"/><origin xyz="0 0 -0.2"/></joint>
</robot>"""


def test_a_urdf_is_a_robot(tmp_path: Path) -> None:
    """As the page says: no script converts it; a free joint, fixed links fused but known by name, effort and velocity read."""
    page = PAGE.read_text(encoding="utf-8")
    assert '`asset.file = "robot.urdf"` works, as the vendor wrote it' in page and "MjSpec" not in page
    (tmp_path / "robot.urdf").write_text(URDF)
    robot = build_model(
        tmp_path / "robot.urdf",
        solver=Solver(),
        ground=Ground(),
        stiffness={"": 20.0},
        damping={"": 0.5},
        colliders=["*"],
        self_collisions=False,
        contact_geoms=["FR_foot", "thigh"],
        imu_site="",
        sites={"FR_foot": ["FR_foot"]},
    )
    assert (
        robot.root == "base"
        and robot.joint_names == ("thigh_joint",)
        and robot.contact_geoms == ("FR_foot_0", "thigh_0")
    )
    assert robot.joint_range.tolist() == [[-1.0, 2.0]] and robot.effort_range.tolist() == [[-33.5, 33.5]]
    assert robot.speed_limits == (21.0,) and "fused into 'thigh', to which they are fixed: FR_foot" in robot.overrides
