"""Terms for bipeds and the gait clock, against figures worked out by hand; on a biped that the framework did not know."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import test_forces
import test_rewards
import torch
from test_export import untrained
from torch import Tensor
from worlds import QUIET, make_env

from legged_mw import ROOT
from legged_mw.check.guard import check_recordable
from legged_mw.deploy.contract import ContractError, Gait, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.robot import QUANTITIES, Measurement
from legged_mw.envs.feet import GaitClock
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.export import exporter as exporting
from legged_mw.export.exporter import ExportError, export
from legged_mw.rl.run_folder import update_from_run
from legged_mw.utils.config import load_yaml, save_yaml
from legged_mw.utils.task import load_task

BIPED, DT = "examples/toy_biped.py", 0.02
LEFT, RIGHT = 0, 1
TERMS = ("alive", "base_height", "dof_acc", "dof_vel", "fast_joints", "hip_pos", "trunk_orientation")
FEET = ("feet_distance", "single_stance", "feet_phase", "contact_phase", "no_fly", "feet_orientation")
ON = {f"rewards.scales.{name}": 1.0 for name in (*TERMS, *FEET)} | {
    "rewards.base_height_target": 0.5,
    "rewards.hip_joints": ["hip"],
    "gait.period": 0.8,
    "init_state.yaw_range": 0.0,
}


def biped(overrides: Mapping[str, Any] | None = None, worlds: int = 2) -> LeggedRobot:
    return make_env(worlds, {**QUIET, **ON, **(overrides or {})}, task=BIPED)


def term(env: LeggedRobot, name: str) -> list[float]:
    return getattr(env, f"_reward_{name}")().tolist()


def touch(env: LeggedRobot, *feet: tuple[float, float]) -> None:
    """Contacts of the left and the right foot in each world, on one of each foot's two boxes."""
    env.sim.sensordata[:, env.robot.sensors["contact"]] = torch.tensor(
        [[left, 0.0, 0.0, right] for left, right in feet]
    )


def test_every_term_has_a_figure() -> None:
    methods = {name.removeprefix("_reward_") for name in dir(LeggedRobot) if name.startswith("_reward_")}
    assert methods == {
        *test_rewards.EXPECTED,
        "stand_drift",
        "target_limits",
        "motor_heat",
        *TERMS,
        *FEET,
        *test_forces.SCALES,
    }


# ---- base and joints


def test_base_and_joints() -> None:
    env = biped()
    env.sim.qpos[:, 2] = torch.tensor([0.6, 0.47])
    env.sim.qvel[:, 6:] = torch.tensor([[1.0, -2.0, 0.0, 0.0, 0.0, 3.0], [0.5] * 6])
    env.sim.qpos[:, 7:] = env.default_dof_pos + torch.tensor(
        [[0.3, 9.0, 9.0, -0.4, 9.0, 9.0], [0.0, 9.0, 9.0, 0.1, 9.0, 9.0]]
    )
    env._update_state()
    assert env.robot.joint_names[0] == "left_hip" and env.robot.joint_names[3] == "right_hip"
    assert term(env, "alive") == [1.0, 1.0]
    assert term(env, "base_height") == pytest.approx([0.01, 0.0009], rel=1e-4)
    assert term(env, "dof_vel") == pytest.approx([1.0 + 4.0 + 9.0, 6 * 0.25])
    assert term(env, "hip_pos") == pytest.approx([0.09 + 0.16, 0.01], rel=1e-4)
    # from rest in 0.02 s; then by another 1 rad/s each
    assert term(env, "dof_acc") == pytest.approx([14.0 / DT**2, 1.5 / DT**2])
    env._end_step()
    assert term(env, "dof_acc") == [0.0, 0.0]
    env.sim.qvel[:, 6:] += 1.0
    assert term(env, "dof_acc") == pytest.approx([6.0 / DT**2] * 2, rel=1e-4)
    env.sim.qvel[:, 6] = torch.tensor([8.0, -7.0])  # the others are slower than a turn a second
    assert term(env, "fast_joints") == pytest.approx([(8.0 - 2 * math.pi) ** 2, (7.0 - 2 * math.pi) ** 2], rel=1e-4)


def test_acceleration_starts_from_the_velocity_of_the_reset() -> None:
    env = biped({"init_state.dof_vel_range": 0.7})
    env.last_dof_vel = torch.full_like(env.dof_vel, 99.0)
    env.reset_envs(torch.tensor([True, False]))
    assert term(env, "dof_acc")[0] == 0.0 and term(env, "dof_acc")[1] > 1e6
    assert 0.0 < float(env.dof_vel[0].abs().max()) <= 0.7


def test_what_a_term_remembers_is_made_where_it_is_on() -> None:
    env = biped({f"rewards.scales.{name}": 0.0 for name in (*TERMS, *FEET)} | {"gait.period": 0.0})
    assert env.last_dof_vel is None and env.gait is None
    assert not any(hasattr(env, name) for name in ("hips", "feet_contact_time", "foot_up", "neighbours"))


def test_torques_as_squares() -> None:
    env = biped({"rewards.torques_as": "squares"})
    env.sim.actuator_force[:] = torch.tensor([[3.0, -4.0, 0.0, 0.0, 0.0, 0.0], [1.0] * 6])
    assert term(env, "torques") == [25.0, 6.0]
    env.cfg.rewards.torques_as = "norms"
    assert term(env, "torques") == pytest.approx([5.0 + 7.0, 6**0.5 + 6.0])


def test_motor_heat() -> None:
    """Two hips of 4 N m; the other joints have no rating and do not count."""
    env = biped({"rewards.scales.motor_heat": -1.0, "ratings.continuous_torque": {"hip": 4.0}})
    env.sim.actuator_force[:] = torch.tensor([[3.0, 9.0, 9.0, -8.0, 9.0, 9.0], [0.0, 1.0, 1.0, 4.0, 1.0, 1.0]])
    assert term(env, "motor_heat") == pytest.approx([(0.75**2 + 4.0) / 2, 0.5])


@pytest.mark.parametrize("wanted", [["hip"], ["*_hip"], ["left_hip", "right_hip"]])
def test_hips_by_name(wanted: list[str]) -> None:
    assert biped({"rewards.hip_joints": wanted}).hips.tolist() == [0, 3]


# ---- feet


def test_feet_distance() -> None:
    """Left at y = +, right at -; the base turned by 90 degrees: its left is the world's -x."""
    env = biped({"rewards.min_feet_distance": 0.2}, worlds=4)
    sites = [env.robot.id("site", name) for name in ("left", "right")]
    turned = [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
    env.sim.qpos[:, 3:7] = torch.tensor([[1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], turned, turned])
    env.sim.site_xpos[:, sites] = torch.tensor(
        [
            [[0.3, 0.1, 0.0], [0.0, -0.05, 0.0]],  # 0.15 apart, however far one is ahead
            [[0.0, -0.02, 0.0], [0.0, 0.03, 0.0]],  # crossed by 0.05
            [[-0.07, 5.0, 0.0], [0.0, 0.0, 0.0]],
            [[-0.3, 0.0, 0.0], [0.0, 0.0, 0.0]],  # far enough
        ]
    )
    env._update_state()
    assert term(env, "feet_distance") == pytest.approx([0.05, 0.25, 0.13, 0.0], abs=1e-6)


def test_feet_distance_of_four_feet_is_of_mirrored_pairs() -> None:
    env = make_env(
        1,
        {**QUIET, "rewards.scales.feet_distance": -1.0, "rewards.min_feet_distance": 0.3, "init_state.yaw_range": 0.0},
    )
    sites = [env.robot.id("site", name) for name in ("FR", "FL", "RR", "RL")]
    assert env.neighbours.tolist() == [[1, 3], [0, 2]]  # left, right
    env.sim.site_xpos[0, sites] = torch.tensor(
        [[0.2, -0.1, 0.0], [0.2, 0.1, 0.0], [-0.2, -0.1, 0.0], [-0.2, 0.14, 0.0]]
    )
    env._update_state()
    assert term(env, "feet_distance") == pytest.approx([0.1 + 0.06], rel=1e-4)


def test_feet_orientation() -> None:
    """A foot rolled by 30 degrees: sin^2 = 0.25; turned about the vertical: nothing."""
    env = biped(worlds=3)
    bodies = [env.robot.id("body", name) for name in ("left_foot", "right_foot")]
    flat, rolled, turned = (
        [1.0, 0.0, 0.0, 0.0],
        [math.cos(math.pi / 12), math.sin(math.pi / 12), 0.0, 0.0],
        [0.6, 0.0, 0.0, 0.8],
    )
    env.sim.xquat[:, bodies] = torch.tensor([[flat, flat], [rolled, turned], [rolled, rolled]])
    assert term(env, "feet_orientation") == pytest.approx([0.0, 0.25, 0.5], abs=1e-6)


def test_trunk_orientation() -> None:
    """Of the heaviest body, which is a torso above the waist: tilted by 30 degrees 0.25; turned about the vertical 0."""
    env = make_env(3, {**QUIET, "rewards.scales.trunk_orientation": -1.0}, task="g1_flat")
    torso = env.robot.id("body", "torso_link")
    half = math.pi / 12
    tilted, turned = [math.cos(half), 0.0, math.sin(half), 0.0], [0.6, 0.0, 0.0, 0.8]
    env.sim.xquat[:, env.root_body] = torch.tensor(
        [math.cos(0.4), math.sin(0.4), 0.0, 0.0]
    )  # the pelvis does not count
    env.sim.xquat[:, torso] = torch.tensor([[1.0, 0.0, 0.0, 0.0], tilted, turned])
    assert term(env, "trunk_orientation") == pytest.approx([0.0, 0.25, 0.0], abs=1e-6)
    pose = {**load_task("g1_flat").cfg.init_state.default_joint_angles, "waist_pitch": 0.3}
    env = make_env(
        1, {**QUIET, "rewards.scales.trunk_orientation": -1.0, "init_state.default_joint_angles": pose}, task="g1_flat"
    )
    env.sim.xquat[:, torso] = torch.tensor([math.cos(0.15), 0.0, math.sin(0.15), 0.0])
    assert term(env, "trunk_orientation") == pytest.approx([0.0], abs=1e-6), "level in the default pose"


def test_flat_is_how_feet_stand_in_the_default_pose() -> None:
    """Ankles bent by 0.2 rad in the default pose: a foot that is level with the ground then is tilted."""
    env = biped({"init_state.default_joint_angles": {"hip": -0.3, "knee": 0.6, "ankle": -0.1}})
    bodies = [env.robot.id("body", name) for name in ("left_foot", "right_foot")]
    env.sim.xquat[:, bodies] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    assert term(env, "feet_orientation") == pytest.approx([2 * math.sin(0.2) ** 2] * 2, rel=1e-4)
    env.sim.xquat[:, bodies] = torch.tensor([math.cos(0.1), 0.0, math.sin(0.1), 0.0])
    assert term(env, "feet_orientation") == pytest.approx([0.0, 0.0], abs=1e-6)


@pytest.mark.parametrize("engine", ["mujoco", "mujoco_warp"])
def test_attitudes_of_bodies_come_from_the_engine(engine: str) -> None:
    """One simulation step old, and zero in a world just reset."""
    env = biped({"sim.engine": engine, "sim.dt": 0.001, "control.decimation": 1, "init_state.ang_vel_range": 0.0})
    before = env.root_quat.clone()
    env.sim.step(1)
    assert torch.allclose(env.sim.xquat[:, env.root_body], before, atol=1e-6)
    env.sim.reset(torch.tensor([True, False]))
    assert not env.sim.xquat[0].any() and env.sim.xquat[1].any()


def test_target_limits() -> None:
    """Soft limits of a Go1's thigh: 1.9075 -+ 0.95 * 2.5935. Targets before the range: 0.9 + 0.5 * 8, 0.9 - 0.5 * 4."""
    env = make_env(2, {**QUIET, "normalization.clip_actions": 10.0})
    actions = torch.zeros(2, 12)
    actions[1, [4, 7]] = torch.tensor([8.0, -4.0])
    env.actuators.apply(actions)
    above, below = 4.9 - (1.9075 + 2.463825), (1.9075 - 2.463825) - (0.9 - 2.0)
    assert term(env, "target_limits") == pytest.approx([0.0, above + below], abs=1e-5)


# ---- two legs


def test_single_stance() -> None:
    """The standing foot's contact time, or the other one's air time, whichever is less."""
    env = biped({"rewards.max_single_stance": 0.03})
    env.reset()
    env.commands[:] = torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])
    left_down, both, none, right_down = (1.0, 0.0), (1.0, 1.0), (0.0, 0.0), (0.0, 1.0)
    story = [both, both, left_down, left_down, left_down, both, right_down, none]
    # both in steps 0 and 1: in step 2 the left foot has stood 0.06 s and the right one been in the air for 0.02 s
    wanted = [0.0, 0.0, 0.02, 0.02, 0.0, 0.0, 0.02, 0.0]  # 0.03 pays most, 0.04 as 0.02, 0.06 nothing
    got = []
    for feet in story:
        touch(env, feet, feet)
        env._update_state()
        got.append(term(env, "single_stance"))
        env._end_step()
    assert [moving for moving, _ in got] == pytest.approx(wanted) and [stands for _, stands in got] == [0.0] * len(
        story
    )
    assert env.feet_contact_time.tolist() == [[0.0, 0.0]] * 2


def test_no_fly() -> None:
    env = biped(worlds=6)
    env.commands[:3] = torch.tensor([0.3, 0.0, 0.0])
    env.commands[3:] = 0.0
    feet = [(1.0, 0.0), (1.0, 1.0), (0.0, 0.0)]
    touch(env, *feet, *feet)
    env._update_state()
    assert term(env, "no_fly") == [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]


# ---- the gait clock


def walk(env: LeggedRobot, command: float, steps: int) -> list[list[float]]:
    """Row "gait_clock" of world 0 after each step, without physics."""
    seen = []
    for _ in range(steps):
        env.commands[:] = torch.tensor([command, 0.0, 0.0])
        env._end_step()
        env.compute_observations()
        seen.append(env.obs_buf["state"][0, env.observations.span("state", "gait_clock")].tolist())
    return seen


def row(phase: float) -> list[float]:
    """Two feet, half a period apart."""
    angle = 2 * math.pi * phase
    return [math.sin(angle), -math.sin(angle), math.cos(angle), -math.cos(angle)]


def test_the_clock_rests_while_standing_and_runs_from_zero() -> None:
    env = biped()  # a step of 0.02 s is 0.025 of the period
    walk(env, 0.0, 1)
    story = [*walk(env, 0.0, 2), *walk(env, 0.5, 34), *walk(env, 0.0, 2), *walk(env, 0.5, 2)]
    running = [row(0.025 * k) for k in range(34)]  # through the period's end, where step 40 would be
    wanted = [[0.0] * 4] * 2 + running + [[0.0] * 4] * 2 + [row(0.0), row(0.025)]
    assert torch.allclose(torch.tensor(story), torch.tensor(wanted), atol=1e-5)
    more = walk(env, 0.5, 41)
    assert more[-1] == pytest.approx(row(0.05), abs=1e-4)  # 1.075 periods


def test_the_clock_starts_anywhere_where_an_episode_begins_walking() -> None:
    env = biped({"commands.ranges.lin_vel_x": [0.5, 0.8], "commands.ranges.ang_vel_yaw": [0.0, 0.0]}, worlds=64)
    assert env.gait and env.gait.running.all()
    assert 0.3 < float(env.gait.phase.mean()) < 0.7 and float(env.gait.phase.std()) > 0.2
    standing = biped({f"commands.ranges.{name}": [0.0, 0.0] for name in ("lin_vel_x", "ang_vel_yaw")}, worlds=8)
    assert standing.gait and not standing.gait.phase.any() and not standing.gait.row.any()
    fixed = biped({"commands.ranges.lin_vel_x": [0.5, 0.8], "gait.random_start": False})
    assert fixed.gait and fixed.gait.running.all() and not fixed.gait.phase.any()


def test_a_command_from_outside_reaches_the_clock_of_the_first_observation() -> None:
    env = biped({"commands.ranges.lin_vel_x": [0.5, 0.8]})
    columns = env.observations.span("state", "gait_clock")
    env.commands[:] = torch.tensor([[0.0, 0.0, 0.0], [0.7, 0.0, 0.0]])
    seen = env.first_observations()["state"][:, columns]
    assert not seen[0].any() and seen[1].any()


def test_restarting_some_worlds_leaves_the_clocks_of_others() -> None:
    env = biped({"commands.ranges.lin_vel_x": [0.5, 0.8]})
    before, clock = env.get_observations()["state"][1].clone(), env.gait
    assert clock
    phase = clock.phase[1].item()
    env.restart(torch.tensor([True, False]))
    assert torch.equal(env.get_observations()["state"][1], before) and clock.phase[1].item() == phase


@pytest.mark.parametrize(
    ("share", "left", "right", "stands"),
    [
        (0.0, 0.0, 0.0, (True, True)),  # 0 and 0.5, both below 0.6
        (0.2, 0.0, 0.25, (True, False)),  # right: 0.7, a quarter of 0.6 to 1
        (0.3, 0.0, 0.5, (True, False)),
        (0.8, 0.5, 0.0, (False, True)),
    ],
)
def test_what_the_clock_wants_of_feet(share: float, left: float, right: float, stands: tuple[bool, bool]) -> None:
    env = biped({"gait.stance": 0.6, "rewards.swing_height": 0.08})
    clock = env.gait
    assert clock
    clock.running[:] = True
    clock.phase[:] = share
    clock.observe(torch.tensor([True, False]))
    assert clock.swing()[0].tolist() == pytest.approx([left, right], abs=1e-6) and clock.swing()[1].tolist() == [
        0.0,
        0.0,
    ]
    assert clock.wants_contact().tolist() == [[*stands], [True, True]]
    rise = {0.0: 0.0, 0.25: 0.5, 0.5: 1.0}  # 3 r^2 - 2 r^3 with r = 1 - |2 s - 1|
    wanted = [0.08 * rise[left], 0.08 * rise[right]]
    sites = [env.robot.id("site", name) for name in ("left", "right")]
    env.sim.site_xpos[:, sites, 2] = torch.tensor([[wanted[0] + 0.03, wanted[1] - 0.02], [0.0, 0.04]])
    touch(env, (1.0, 0.0), (1.0, 0.0))
    env._update_state()
    error = [0.03**2 + 0.02**2, 0.04**2]
    assert term(env, "feet_phase") == pytest.approx([math.exp(-100 * e) for e in error], rel=1e-4)
    assert term(env, "contact_phase") == [(float(stands[0]) + float(not stands[1])) / 2, 0.5]


def test_the_mirror_swaps_the_feet_of_the_clock() -> None:
    """Mirrored, the left leg is where the right one was; of each frame."""
    env = biped({"observations.history": {"state": 2}, "gait.offsets": [0.1, 0.3]})
    columns = env.observations.span("state", "gait_clock")
    frame = [0.1, 0.2, 0.8, 0.9]  # sines left, right; cosines left, right
    seen = torch.zeros(1, env.obs_buf["state"].shape[1])
    seen[0, columns] = torch.tensor([*frame, *(10 * x for x in frame)])
    image = env.mirror.observations["state"](seen)[0, columns]
    assert image.tolist() == pytest.approx([0.2, 0.1, 0.9, 0.8, 2.0, 1.0, 9.0, 8.0])


def test_no_row_without_a_clock() -> None:
    rows = [each.name for each in biped().observations.groups["state"]]
    assert rows.index("gait_clock") == rows.index("commands") - 1
    off = {"rewards.scales.feet_phase": 0.0, "rewards.scales.contact_phase": 0.0, "gait.period": 0.0}
    assert "gait_clock" not in [each.name for each in biped(off).observations.groups["state"]]


def test_the_step_can_be_recorded() -> None:
    task = load_task(BIPED)
    for path, value in ON.items():
        task.set(path, value)
    check_recordable(task)


# ---- how an episode begins


def test_joints_may_begin_anywhere_near_the_default_pose() -> None:
    env = biped({"init_state.dof_pos_offset": [-0.2, 0.4], "init_state.dof_vel_range": 0.5}, worlds=64)
    offset: Tensor = env.dof_pos - env.default_dof_pos
    assert -0.2 <= offset.min() < -0.15 and 0.35 < offset.max() <= 0.4
    assert -0.5 <= env.dof_vel.min() < -0.45 and 0.45 < env.dof_vel.max() <= 0.5
    ankles = biped({"init_state.dof_pos_offset": [-2.0, 2.0]}, worlds=64).dof_pos[:, [2, 5]]
    assert ankles.min() == -0.9 and ankles.max() == 0.9  # the ends of their range
    still = biped()
    assert torch.equal(still.dof_pos, still.default_dof_pos.expand(2, -1)) and not still.dof_vel.any()


# ---- deployed


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained biped's export; commands changed and episodes ended while it was tried."""
    folder, often = (
        tmp_path_factory.mktemp("biped"),
        {"commands.resampling_time": 0.2, "env.episode_length_s": 0.4, "gait.period": 0.5},
    )
    task, checkpoint = untrained(ROOT / BIPED, folder, {**ON, **often})
    export(task, checkpoint, folder / "out")
    return folder


def test_the_contract_states_the_clock(exported: Path) -> None:
    contract = read_contract(exported / "out")
    assert contract.gait == Gait(0.5, (0.0, 0.5), 0.01)
    [clock] = [row for row in contract.rows if row.name == "gait_clock"]
    assert (clock.size, clock.unit, clock.measured) == (4, "1", "gait_clock") and clock.frame.startswith(
        "sine of each foot's phase"
    )


def test_deploy_keeps_the_clock_of_the_environment(exported: Path) -> None:
    """Standing, walking, standing, walking, each robot at other times; one starts again while it walks."""
    env = biped({"gait.period": 0.5, "gait.random_start": False}, worlds=3)
    contract = read_contract(exported / "out")
    controller = Controller(exported / "out", contract, 3, network=lambda seen: np.zeros((len(seen), 6)))
    sizes = {"joint_pos": 6, "joint_vel": 6, "joint_torque": 6, "foot_contact": 2}
    nothing = {name: np.zeros((3, sizes.get(name, 3))) for name in QUANTITIES}
    columns, rests, commands = env.observations.span("state", "gait_clock"), 0, env.commands
    commands.zero_()
    env.first_observations()
    for step in range(70):
        seen = env.obs_buf["state"][:, columns]
        own = controller.observe(Measurement(**nothing), commands.numpy())[:, columns]
        np.testing.assert_allclose(own, seen, atol=1e-5, err_msg=f"step {step}")
        rests += int((seen == 0.0).all(dim=1).sum())
        controller.act(Measurement(**nothing), commands.numpy())
        commands[:, 0] = torch.tensor([float(5 <= step < 40 or step > 60) * 0.5, float(step > 20) * -0.2, 0.0])
        commands[:, 2] = torch.tensor([0.0, 0.0, float(step % 30 > 10) * 0.3])
        env._end_step()
        if step == 50:
            env.reset_envs(torch.tensor([False, True, False]))
            controller.reset([1])
            commands[1] = torch.tensor([0.3, 0.0, 0.0])
        env.compute_observations()
    assert 60 < rests < 90


def test_a_clock_that_runs_otherwise_is_not_exported(exported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def late(self: GaitClock) -> None:
        self.phase.add_(self.running, alpha=0.01).remainder_(1.0)

    monkeypatch.setattr(GaitClock, "tick", late)
    monkeypatch.setattr(
        exporting, "save_onnx", lambda _policy, _clip, path: shutil.copy(exported / "out/policy.onnx", path)
    )
    text = "^legged_mw.deploy would act differently from the environment: observation row 'gait_clock' "
    trained = load_task(str(ROOT / BIPED))
    update_from_run(trained, load_yaml(exported / "out/config.yaml"), where="config.yaml")
    with pytest.raises(ExportError, match=text):
        export(trained, exported / "model.pt", exported / "late")


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda said: said.pop("gait"), "^policy.yaml: 'gait' is missing; it must be a mapping$"),
        (lambda said: said["gait"].update(period=0.0), "^policy.yaml: gait: 'period' is 0.0; it must be above zero$"),
        (
            lambda said: said["gait"].update(offsets=[0.0]),
            r"^policy.yaml: gait: 'offsets' is \[0.0\]; it must be 2 numbers, one a foot$",
        ),
        (
            lambda said: said["commands"].pop(0),
            "^policy.yaml: gait_clock rests by the commands lin_vel_x, lin_vel_y, ang_vel_yaw; missing: lin_vel_x$",
        ),
    ],
)
def test_a_contract_whose_clock_is_not_whole(
    exported: Path, tmp_path: Path, change: Callable[[Any], Any], text: str
) -> None:
    shutil.copytree(exported / "out", tmp_path / "out")
    said = load_yaml(tmp_path / "out/policy.yaml")
    change(said)
    save_yaml(tmp_path / "out/policy.yaml", said)
    with pytest.raises(ContractError, match=text):
        read_contract(tmp_path / "out")
