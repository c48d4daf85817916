"""Contact forces, self-contacts and angular momentum: sensed only where something reads them, the same on both engines; and their terms."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
import pytest
import torch
from program import run
from test_export import untrained
from torch import Tensor
from worlds import QUIET, make_env, only_scales

from legged_mw import ROOT
from legged_mw.check.guard import check_recordable
from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.simulated import read_scene
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.export.exporter import export
from legged_mw.sim.engines import make_simulation
from legged_mw.sim.model import Ground, RobotModel, Solver, build_model
from legged_mw.sim.sensors import ANGULAR_MOMENTUM, COM_VELOCITY, CONTACT_FORCE, SELF_CONTACT
from legged_mw.utils.config import ConfigError
from legged_mw.utils.task import load_task

FEET = ["FR", "FL", "RR", "RL"]
HOME = [0.1, 0.9, -1.8, -0.1, 0.9, -1.8] * 2
ENGINES = ["mujoco", "mujoco_warp"]
ROUGH = {
    "terrain.num_rows": 1,
    "terrain.num_cols": 1,
    "terrain.terrain_proportions": {"flat": 1.0},
    "terrain.border_size": 1.0,
    "domain_rand.enable": False,
    "perturbation.push": False,
}
WHOLE_G1 = {
    "asset.colliders": ["*"],
    "asset.self_collisions": True,
    "asset.foot_geoms": {foot: [f"{foot}?_collision"] for foot in ("left_foot", "right_foot")},
}
SCALES = {
    **dict.fromkeys(
        ("feet_contact_forces", "stumble", "soft_landing", "torque_limits", "dof_vel_limits", "joint_deviation"), -1.0
    ),
    **dict.fromkeys(
        ("angular_momentum", "self_collision", "joint_mirror", "air_time_variance", "feet_impact_vel"), -1.0
    ),
    **{"action_smoothness": -1.0, "feet_contact_without_cmd": 1.0},
}
SETTINGS = {
    **{"asset.self_collisions": True, "rewards.mirror_joints": [["FR_", "RL_"], ["FL_*", "RR_*"]]},
    **{
        "rewards.soft_torque_limit": 0.5,
        "rewards.soft_dof_vel_limit": 0.5,
        "rewards.deviation_weights": {"": 1.0, "calf": 0.5},
    },
}


def all_on(worlds: int = 2, more: Mapping[str, Any] | None = None) -> LeggedRobot:
    return make_env(worlds, {**QUIET, **only_scales(**SCALES), **SETTINGS, **(more or {})})


def term(env: LeggedRobot, name: str) -> Any:
    return pytest.approx(getattr(env, f"_reward_{name}")().tolist(), rel=1e-4, abs=1e-6)


# ---- what the simulator senses


def go1(more: list[str], **choices: Any) -> RobotModel:
    sensed: dict[str, Any] = {"contact_geoms": FEET, "imu_site": "", "more_sensors": more}
    gains: dict[str, Any] = {"stiffness": {"": 35.0}, "damping": {"": 0.5}, "colliders": FEET, "self_collisions": False}
    gains["pose"] = dict(zip((f"{leg}_{part}" for leg in FEET for part in ("hip", "thigh", "calf")), HOME, strict=True))
    file = ROOT / "resources/robots/go1/go1.xml"
    return build_model(
        file, **{"solver": Solver(iterations=50, ls_iterations=50), "ground": Ground(), **gains, **sensed, **choices}
    )


def one_by_one(model: mujoco.MjModel, data: mujoco.MjData, geom: str) -> np.ndarray:
    """Force of the ground on ``geom``, world frame (3,) [N], from ``mj_contactForce``."""
    total, wrench = np.zeros(3), np.zeros(6)
    for number, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, number, wrench)
        # it is the first's force on the second
        sign = {contact.geom[0]: -1.0, contact.geom[1]: 1.0}.get(model.geom(geom).id, 0.0)
        total += sign * contact.frame.reshape(3, 3).T @ wrench[:3]
    return total


@pytest.mark.parametrize("cone", ["PYRAMIDAL", "ELLIPTIC"])
@pytest.mark.parametrize("engine", ENGINES)
def test_forces_are_those_of_mj_contact_force(engine: str, cone: str) -> None:
    robot = go1([CONTACT_FORCE, ANGULAR_MOMENTUM, COM_VELOCITY])
    model = robot.physics
    model.opt.cone = getattr(mujoco.mjtCone, f"mjCONE_{cone}")
    sim = make_simulation(model, 2, "cpu", engine=engine)
    sim.qpos[:] = torch.tensor([0.0, 0.0, 0.28, 1.0, 0.0, 0.0, 0.0, *HOME])
    sim.qvel[:, 0] = torch.tensor([0.2, 0.6])  # it slides, so that forces have all components
    sim.ctrl[:] = torch.tensor(HOME)
    sim.step(8)
    before = sim.qpos.clone(), sim.qvel.clone()
    sim.step()
    got = -sim.sensordata[:, robot.sensors[CONTACT_FORCE]].unflatten(1, (4, 4))[..., 1:]
    momentum = sim.sensordata[:, robot.sensors[ANGULAR_MOMENTUM]]
    com = sim.sensordata[:, robot.sensors[COM_VELOCITY]]
    for world in range(2):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = before[0][world], before[1][world], HOME
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        want = np.stack([one_by_one(model, data, foot) for foot in FEET])
        assert (want[:, 2] > 10.0).all() and np.abs(want[:, 0]).max() > 5.0
        np.testing.assert_allclose(got[world], want, atol=0.02)  # of some 50 N
        np.testing.assert_allclose(momentum[world], data.subtree_angmom[1], atol=1e-4)
        np.testing.assert_allclose(com[world], data.subtree_linvel[1], atol=1e-4)
        assert sim.sensordata[world, robot.sensors["contact"]].tolist() == [1.0] * 4


def test_nothing_more_is_sensed_unless_asked_for() -> None:
    plain, more = go1([]), go1([CONTACT_FORCE, SELF_CONTACT, ANGULAR_MOMENTUM])
    assert plain.physics.nsensordata == 4 + 3 and [*plain.sensors] == ["contact", "linvel", "accelerometer"]
    assert more.physics.nsensordata == 16 + 3 + 1 + 3 and more.sensors["contact"] == slice(0, 16, 4)
    # what is exported
    assert [sensor.name for sensor in more.spec.sensors] == [sensor.name for sensor in plain.spec.sensors]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("task", "more"), [("go1_flat", {}), ("go1_rough", ROUGH)], ids=["plane", "terrain"])
def test_feet_carry_the_weight(task: str, more: dict[str, Any], engine: str) -> None:
    still = {f"init_state.{name}": 0.0 for name in ("pos_xy_range", "yaw_range", "lin_vel_range", "ang_vel_range")}
    env = make_env(2, {**QUIET, **still, **more, "asset.sense": ["contact_forces"], "sim.engine": engine}, task=task)
    env.reset()
    for _ in range(100):
        env.step(torch.zeros(2, env.num_actions))
    down = env.contact_forces.sum(dim=1)
    assert env.contact_forces.shape == (2, 4, 3) and (env.contact_forces[..., 2] > 5.0).all()
    assert down[:, 2].tolist() == pytest.approx([9.81 * env.total_mass] * 2, rel=0.02)
    assert down[:, :2].abs().max() < 0.02 * 9.81 * env.total_mass


def test_a_foot_of_several_geoms_is_their_sum() -> None:
    env = make_env(2, {**QUIET, "asset.sense": ["contact_forces"]}, task="g1_flat")
    columns = env.sim.sensordata[:, env.robot.sensors[CONTACT_FORCE]]  # two geoms a foot: count, force on the ground
    columns[0] = torch.tensor([1.0, 1.0, 2.0, -30.0, 1.0, 3.0, 4.0, -40.0, 2.0, 0.0, 0.0, -5.0, 0.0, 0.0, 0.0, 0.0])
    env._update_state()
    assert env.contact_forces[0].tolist() == [[-4.0, -6.0, 70.0], [0.0, 0.0, 5.0]]
    assert env.feet.count[0].tolist() == [2.0, 2.0] and env.contact_count[0].tolist() == [1.0, 1.0, 2.0, 0.0]
    env.reset_envs(torch.tensor([True, False]))
    assert not env.contact_forces[0].any()


# ---- on demand


def test_a_term_that_is_on_has_what_it_needs_sensed() -> None:
    class Mine(LeggedRobot):
        SENSED_FOR: ClassVar[Mapping[str, str]] = {**LeggedRobot.SENSED_FOR, "mine": CONTACT_FORCE}

        def _reward_mine(self) -> Tensor:
            return self.contact_forces[..., 2].sum(dim=1)

        def _reward_stumble(self) -> Tensor:
            return super()._reward_stumble().clone()

    for name in ("mine", "stumble"):
        env = make_env(1, {**QUIET, f"rewards.scales.{name}": 1.0}, env_class=Mine)
        assert env.robot.sensors.keys() == {"contact", "linvel", "accelerometer", CONTACT_FORCE}
        assert env.contact_forces.shape == (1, 4, 3)
    off = make_env(1, QUIET, env_class=Mine)
    assert CONTACT_FORCE not in off.robot.sensors and off.feet.forces is None


@pytest.mark.parametrize("engine", ENGINES)
def test_a_sensor_of_the_file_is_kept_where_it_is_asked_for(engine: str, tmp_path: Path) -> None:
    class Mine(LeggedRobot):
        def _init_buffers(self) -> None:
            super()._init_buffers()
            self.shank = self.sensor("shank_gyro")

    sensors = '<sensor><gyro name="shank_gyro" site="FR"/><velocimeter name="unused" site="FR"/></sensor></mujoco>'
    text = (ROOT / "resources/robots/go1/go1.xml").read_text().replace("</mujoco>", sensors)
    (tmp_path / "go1.xml").write_text(text)
    more = {**QUIET, "asset.file": str(tmp_path / "go1.xml"), "sim.engine": engine}
    env = make_env(2, {**more, "asset.sense": ["shank_gyro"]}, env_class=Mine)
    env.step(torch.ones(2, 12))
    assert env.shank.shape == (2, 3) and env.shank.abs().amax() > 0.1
    assert env.robot.spec.sensor("shank_gyro") and not env.robot.spec.sensor("unused")
    with pytest.raises(ConfigError, match="sensor 'unused' of the robot's file was dropped; write asset.sense"):
        env.sensor("unused")
    with pytest.raises(ConfigError, match="'shank_gyro' .* asset.sense"):
        make_env(1, more, env_class=Mine)
    with pytest.raises(ConfigError, match="asset.sense: no value or sensor 'shank' .* did you mean 'shank_gyro'"):
        make_env(1, {**more, "asset.sense": ["shank"]})


@pytest.mark.parametrize("name", ["contact_forces", "self_contacts", "angular_momentum", "com_velocity"])
def test_what_is_asked_for_is_sensed(name: str) -> None:
    """tests/golden/tasks.py has what is said where it is not."""

    class Fallen(LeggedRobot):
        def _fallen(self) -> Tensor:
            return super()._fallen() | (getattr(self, name).flatten(1).abs().amax(dim=1) > 1e6)

    make_env(1, {**QUIET, "asset.sense": [name]}, env_class=Fallen).step(torch.zeros(1, 12))


def test_the_critic_may_see_forces() -> None:
    """In hundreds of newtons; mirrored as a vector of the world, left foot for right."""
    env = make_env(1, {**QUIET, "observations.contact_forces": True})
    columns = env.sim.sensordata[:, env.robot.sensors[CONTACT_FORCE]].unflatten(1, (4, 4))
    columns[0, :, 1:] = -torch.arange(12.0).view(4, 3)
    env._update_state()
    env.compute_observations()
    span = env.observations.span("privileged_state", "contact_forces")
    seen = env.obs_buf["privileged_state"]
    assert seen[0, span].tolist() == pytest.approx([value / 100 for value in range(12)])
    image = env.mirror.observations["privileged_state"](seen)[0, span]  # of FL, FR, RL, RR
    assert image.tolist() == pytest.approx([v / 100 for v in (3, -4, 5, 0, -1, 2, 9, -10, 11, 6, -7, 8)])


def test_the_step_can_be_recorded_with_all_of_it_on() -> None:
    task = load_task("go1_flat")
    for path, value in {**only_scales(**SCALES), **SETTINGS, "observations.contact_forces": True}.items():
        task.set(path, value)
    check_recordable(task)


# ---- terms


def test_forces_on_feet() -> None:
    env = all_on()
    columns = env.sim.sensordata[:, env.robot.sensors[CONTACT_FORCE]].unflatten(1, (4, 4))
    columns[0] = -torch.tensor([[-1.0, 0.0, 30.0, 40.0], [-1.0, 120.0, 0.0, 20.0], [0.0] * 4, [-1.0, 0.0, 0.0, 160.0]])
    columns[1] = -torch.tensor([[-1.0, 40.0, 0.0, 8.0], [0.0] * 4, [-1.0, 0.0, 9.0, -1.9], [-1.0, 3.0, 0.0, 4.0]])
    env.feet_air_time[:] = torch.tensor([0.1, 0.0, 0.2, 0.3])
    env.commands[:] = torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])
    env.foot_contact.zero_()
    env._update_state()
    # 50; 121.66; 0; 160: beyond 100 N
    assert term(env, "feet_contact_forces") == [21.6553 + 60.0, 0.0]
    # 120 > 5 * 20; 40 is not more than 5 * 8, 9 not more than 5 * 1.9
    assert term(env, "stumble") == [1.0, 0.0]
    # FR and RL touch down; told to stand: nothing
    assert term(env, "soft_landing") == [50.0 + 160.0, 0.0]
    columns[1, 2, 2] = -9.6
    env._update_state()
    assert term(env, "stumble") == [1.0, 1.0]


def test_limits_of_joints() -> None:
    env = all_on()
    env.sim.actuator_force[:] = torch.tensor([[20.0, 0.0, -20.0] + [0.0] * 9, [11.0] * 12])
    env.sim.qvel[:, 6:] = torch.tensor([[16.0, -15.3, 0.0, -30.0] + [0.0] * 8, [10.0] * 12])
    # half of 23.7, 23.7 and 35.55 N m: hip 20 - 11.85, calf 20 - 17.775
    assert term(env, "torque_limits") == [8.15 + 2.225, 0.0]
    # half of 30.1, 30.1 and 20.06 rad/s: 16 - 15.05, 15.3 - 15.05, 1 at most
    assert term(env, "dof_vel_limits") == [0.95 + 0.25 + 1.0, 0.0]


def test_pose_of_joints() -> None:
    env = all_on()
    offset = torch.zeros(2, 12)
    offset[0, [0, 4, 8]] = torch.tensor([0.1, -0.2, 0.4])  # FR hip, FL thigh, RR calf
    env.sim.qpos[:, 7:] = env.default_dof_pos + offset
    env._update_state()
    assert term(env, "joint_deviation") == [0.1 + 0.2 + 0.5 * 0.4, 0.0]
    # FR hip 0.2, RL hip -0.1; FL hip -0.1, RR hip 0.1, FL thigh -0.2, RR calf 0.4: over two pairs; at home hips are 0.2 apart
    assert term(env, "joint_mirror") == [(0.09 + 0.04 + 0.04 + 0.16) / 2, (0.04 + 0.04) / 2]


def test_smooth_actions() -> None:
    env = all_on(1)
    env.reset()
    for action, wanted in ((0.1, 0.1), (0.3, 0.1), (0.4, -0.1), (0.4, -0.1)):  # a_t - 2 a_(t-1) + a_(t-2)
        env.actions.fill_(action)
        assert [12 * wanted**2] == term(env, "action_smoothness")
        env._end_step()
    env.reset_envs(torch.tensor([True]))
    assert not env.last_last_actions.any()


def test_times_and_speeds_of_feet() -> None:
    env = all_on(1)
    env.reset()
    spans = env.robot.sensors
    touch, speed = env.sim.sensordata[:, spans["contact"]], env.sim.sensordata[:, spans["linvel"]].unflatten(1, (4, 3))

    def step(*feet: float, down: tuple[float, ...] = (0.0,) * 4) -> None:
        touch[0], speed[0, :, 2] = torch.tensor(feet), -torch.tensor(down)
        env._update_state()
        env._end_step()

    env.commands.zero_()
    step(1, 1, 1, 0)
    assert term(env, "feet_contact_without_cmd") == [3.0]
    step(0, 1, 1, 1, down=(-2.0, 0.0, 0.0, 5.0))  # FR lifts after 0.02 s; RL lands after 0.04 s
    step(0, 1, 1, 0, down=(0.5, 0.3, 0.0, 0.0))  # RL lifts after 0.02 s
    touch[0], speed[0, :, 2] = torch.tensor([1.0, 1.0, 1.0, 0.0]), 0.0
    env._update_state()  # FR is back after 0.06 s; it sank by 0.5 m/s a step before, FL stands all the time
    assert env.last_air_time[0].tolist() == pytest.approx([0.06, 0.0, 0.0, 0.04])
    assert env.last_contact_time[0].tolist() == pytest.approx([0.02, 0.0, 0.0, 0.02])
    assert term(env, "air_time_variance") == [(0.035**2 + 2 * 0.025**2 + 0.015**2 + 4 * 0.01**2) / 3]
    assert term(env, "feet_impact_vel") == [0.25]
    env.commands[:, 0] = 1.0
    env._update_state()
    assert term(env, "feet_contact_without_cmd") == [0.0]


def test_sensed_motion_and_self_contacts() -> None:
    env = all_on()
    spans = env.robot.sensors
    env.sim.sensordata[:, spans[ANGULAR_MOMENTUM]] = torch.tensor([[1.0, -2.0, 3.0], [0.0, 0.5, 0.0]])
    env.sim.sensordata[:, spans[SELF_CONTACT]] = torch.tensor([[2.0], [0.0]])
    assert term(env, "angular_momentum") == [14.0, 0.25]
    assert term(env, "self_collision") == [2.0, 0.0]


# ---- the whole body, against the ground and itself


def whole_g1(engine: str, worlds: int) -> LeggedRobot:
    still = {
        "perturbation.push": False,
        "termination.max_tilt": 180.0,
        "domain_rand.enable": False,
        "asset.sense": ["self_contacts"],
    }
    return make_env(worlds, {**QUIET, **WHOLE_G1, **still, "sim.engine": engine}, task="g1_flat")


@pytest.mark.parametrize(("engine", "worlds"), [("mujoco", 64), ("mujoco_warp", 4)])
def test_a_fallen_g1_lies_on_the_ground(engine: str, worlds: int) -> None:
    """Dropped in any attitude with any joint angles: nothing sinks in, no contact is dropped, and self-contacts are counted."""
    env = whole_g1(engine, worlds)
    sim, model, draw = env.sim, env.robot.physics, np.random.default_rng(0)
    quat = draw.normal(size=(worlds, 4))
    sim.qpos[:, 2], sim.qpos[:, 3:7] = 1.0, torch.tensor(quat / np.linalg.norm(quat, axis=1)[:, None])
    sim.qpos[:, 7:] = torch.tensor(draw.uniform(*env.robot.joint_range.T, size=(worlds, 29)))
    for _ in range(60):
        sim.step(5)
    before = sim.qpos.clone(), sim.qvel.clone()
    sim.step()
    assert sim.overflow_report() == "" and sim.qpos.isfinite().all()
    deepest, own = 0.0, []
    for world in range(worlds):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = before[0][world], before[1][world]
        mujoco.mj_forward(model, data)
        on_ground = [contact.dist for contact in data.contact if 0 in contact.geom]
        deepest = min(deepest, *on_ground)  # each touches the ground
        own.append(data.ncon - len(on_ground))
    assert deepest > -0.03  # [m]
    assert float(sim.qpos[:, 2].min()) > 0.05 and sum(own) >= worlds / 2
    assert env.self_contacts[:, 0].tolist() == (own if engine == "mujoco" else pytest.approx(own, abs=1.0))


def test_links_that_overlap_in_the_pose_do_not_collide() -> None:
    robot = whole_g1("mujoco", 1).robot
    pairs = "'pelvis' and 'left_hip_roll_link', 'pelvis' and 'right_hip_roll_link', 'left_elbow_link' and 'left_wrist_pitch_link', "
    pairs += "'right_elbow_link' and 'right_wrist_pitch_link'"
    assert f"self-collisions left out, as they overlap in the pose: {pairs}" in robot.overrides
    assert "self-collisions: bodies that a joint joins pass through one another" in robot.overrides
    assert robot.physics.nexclude == 4 == whole_g1("mujoco_warp", 1).robot.spec.compile().nexclude
    data = mujoco.MjData(robot.physics)
    data.qpos[:] = [0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, *robot.pose]
    mujoco.mj_forward(robot.physics, data)
    assert data.ncon == 0
    data.qpos[7 + robot.joint_names.index("left_shoulder_roll_joint")] = -1.5  # the arm through the chest
    mujoco.mj_forward(robot.physics, data)
    assert data.ncon > 0
    assert not any("self-coll" in line for line in make_env(1, task="g1_flat").robot.overrides)


def test_the_command_of_the_page(tmp_path: Path) -> None:
    (command,) = re.findall(r"```sh\n(.*?)\n```", (ROOT / "docs/your_own_robot.md").read_text(), re.DOTALL)
    said = run("train", tmp_path, *shlex.split(command)[2:], "--device", "cpu").out
    assert (
        "sim.nconmax 72, sim.njmax 282, from the model" in said
        and "self-collisions left out, as they overlap in the pose: 'pel" in said
    )


def test_what_is_exported_senses_what_deploy_reads(tmp_path: Path) -> None:
    more = {"asset.sense": ["self_contacts"], "rewards.scales.stumble": -1.0, "observations.contact_forces": True}
    export(*untrained(ROOT / "configs/go1_flat.py", tmp_path, more), tmp_path / "out")
    scene = read_scene(tmp_path / "out", read_contract(tmp_path / "out"))
    assert [len(columns) for columns in scene.contacts] == [1] * 4 and SELF_CONTACT not in [
        sensor.name for sensor in scene.spec.sensors
    ]
