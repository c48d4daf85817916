"""Left-right symmetry: partners from geometry, mirrored observations and actions, mirrored motion, and rsl-rl's learner with it on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from program import SMALL
from rsl_rl.extensions import Symmetry
from rsl_rl.runners import OnPolicyRunner
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor
from worlds import QUIET, changed, layout, make_env, snapshot

from legged_mw import ROOT
from legged_mw.check.recordable import recordable
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.observations import Row
from legged_mw.rl.learner_config import rsl_rl_config
from legged_mw.rl.ppo import mirror
from legged_mw.rl.run_folder import update_from_run
from legged_mw.sim.mirror import find_partners, opposites
from legged_mw.sim.model import Ground, ModelError, RobotModel, Solver, build_model
from legged_mw.utils.config import ConfigError, load_yaml, save_yaml
from legged_mw.utils.task import LoadedTask, load_task

FEET = ["FR", "FL", "RR", "RL"]
GO1 = (ROOT / "resources/robots/go1/go1.xml").read_text()
REACH = -2 * 0.06659  # [m] from where Go1's IMU would be in the mirror to where it is
POLAR, AXIAL = torch.tensor([1.0, -1.0, 1.0]), torch.tensor([-1.0, 1.0, -1.0])
N = 6


@pytest.fixture(scope="module")
def env() -> LeggedRobot:
    return make_env(N, QUIET)


def load_robot(path: Path, xml: str) -> RobotModel:
    path.write_text(xml)
    return build_model(
        path,
        solver=Solver(),
        ground=Ground(),
        stiffness={"": 10.0},
        damping={"": 0.1},
        colliders=["*"],
        self_collisions=False,
        contact_geoms=[],
        imu_site="",
    )


def replaced(xml: str, old: str, new: str, times: int) -> str:
    assert xml.count(old) == times, old
    return xml.replace(old, new)


# ---- partners


def test_go1_pairs_right_with_left(env: LeggedRobot) -> None:
    partners, names = find_partners(env.robot, FEET), env.robot.joint_names
    swapped = {"FR": "FL", "FL": "FR", "RR": "RL", "RL": "RR"}
    for name, partner, sign in zip(names, partners.joints, partners.signs, strict=True):
        leg, _, link = name.partition("_")
        assert names[partner] == f"{swapped[leg]}_{link}"
        assert sign == (-1 if link == "hip_joint" else 1)
    assert [FEET[i] for i in partners.sites] == ["FL", "FR", "RL", "RR"]
    assert find_partners(env.robot, ["head", "RL", "RR"]).sites == (0, 2, 1)  # the head is in the middle
    assert find_partners(env.robot).sites == ()
    # a site and a geom, a body, and the first site, in the middle
    for name, image in {"FR": "FL", "FR_calf": "FL_calf", "head": "head"}.items():
        assert opposites(env.robot, name) == [image]


# A turned root, joints in the middle, three at one place, slides, inclined axes, and a pair whose axes point opposite ways.
WAIST = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="base" pos="1 2 3" quat="0.5 0.5 -0.5 0.5">
      <freejoint/> <geom size="0.1"/>
      <body name="chest" pos="0.01 0 0.2">
        <joint name="waist_yaw" axis="0 0 1"/> <joint name="waist_roll" axis="1 0 0"/> <joint name="waist_pitch" axis="0 1 0"/>
        <joint name="lift" type="slide" axis="0.6 0 0.8"/>
        <geom size="0.1"/>
        <body name="left_arm" pos="0 0.2 0.1"><joint name="left_arm" axis="0 0.8 0.6"/> <geom size="0.1"/>
          <body name="left_hand" pos="0 0 -0.3"><joint name="left_hand" type="slide" axis="0 1 0"/> <geom size="0.05"/></body>
        </body>
        <body name="right_arm" pos="0 -0.2 0.1"><joint name="right_arm" axis="0 -0.8 0.6"/> <geom size="0.1"/>
          <body name="right_hand" pos="0 0 -0.3"><joint name="right_hand" type="slide" axis="0 1 0"/> <geom size="0.05"/></body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def test_joints_in_the_middle_are_their_own_partners(tmp_path: Path) -> None:
    robot = load_robot(tmp_path / "waist.xml", WAIST)
    partners = find_partners(robot)
    found = {
        name: (robot.joint_names[i], s)
        for name, i, s in zip(robot.joint_names, partners.joints, partners.signs, strict=True)
    }
    assert found == {
        "waist_yaw": ("waist_yaw", -1),
        "waist_roll": ("waist_roll", -1),
        "waist_pitch": ("waist_pitch", 1),
        "lift": ("lift", 1),  # it slides within the plane
        "left_arm": ("right_arm", -1),  # (0, 0.8, 0.6) becomes (0, 0.8, -0.6), the other's axis reversed
        "right_arm": ("left_arm", -1),
        "left_hand": ("right_hand", -1),  # what slides to the left on one side slides to the right on the other
        "right_hand": ("left_hand", -1),
    }


PLACE, CALF = 'pos="0.1881 0.04675 0"', '<joint name="FL_calf_joint" class="calf"'


@pytest.mark.parametrize(
    ("old", "too_far", "near"),
    [
        (PLACE, 'pos="0.1881 0.0479 0"', 'pos="0.1881 0.0476 0"'),  # [m]
        (CALF, f'{CALF} axis="0.02 1 0"', f'{CALF} axis="0.008 1 0"'),  # [rad]
    ],
    ids=["place", "axis"],
)
def test_a_joint_may_have_a_partner_within_a_tolerance(tmp_path: Path, old: str, too_far: str, near: str) -> None:
    apart, alike = (load_robot(tmp_path / "go1.xml", replaced(GO1, old, new, 1)) for new in (too_far, near))
    with pytest.raises(ModelError):
        find_partners(apart)
    assert find_partners(alike).joints[:6] == (3, 4, 5, 0, 1, 2)
    assert find_partners(alike).signs[:6] == (-1, 1, 1, -1, 1, 1)


# ---- observations and actions


Sides = tuple[list[float], list[float]]  # numbers, and those of their mirror image


def joints_by_hand() -> Sides:
    """1 to 12: right and left change places, and hips their sign."""
    joints = [f"{leg}{k}" for leg in FEET for k in range(3)]
    swapped = {"FR": "FL", "FL": "FR", "RR": "RL", "RL": "RR"}
    value = {name: float(i + 1) for i, name in enumerate(joints)}
    mirrored = [(-1.0 if name[2] == "0" else 1.0) * value[swapped[name[:2]] + name[2]] for name in joints]
    assert mirrored == [-4.0, 5.0, 6.0, -1.0, 2.0, 3.0, -10.0, 11.0, 12.0, -7.0, 8.0, 9.0]
    return [value[name] for name in joints], mirrored


def rows_by_hand() -> dict[str, dict[str, Sides]]:
    """Group -> row -> numbers."""
    joints = joints_by_hand()
    state: dict[str, Sides] = {
        "base_lin_vel": ([1.0, 2.0, 3.0], [1.0 + REACH * 3.0, -2.0, 3.0 - REACH * 1.0]),  # the IMU stays on its side
        "base_ang_vel": ([1.0, 2.0, 3.0], [-1.0, 2.0, -3.0]),
        "projected_gravity": ([0.1, 0.2, -0.9], [0.1, -0.2, -0.9]),
        "dof_pos": joints,
        "dof_vel": joints,
        "last_actions": joints,
        "commands": ([0.5, 0.3, 0.7], [0.5 + REACH * 0.7, -0.3, -0.7]),
    }
    privileged: dict[str, Sides] = {
        "state": side_by_side(state),
        "base_ang_vel": state["base_ang_vel"],
        "accelerometer": ([1.0, 2.0, 9.0], [1.0, -2.0, 9.0]),
        "projected_gravity": state["projected_gravity"],
        "base_lin_vel": state["base_lin_vel"],
        "base_ang_vel_world": ([4.0, 5.0, 6.0], [-4.0, 5.0, -6.0]),
        "dof_pos": joints,
        "dof_vel": joints,
        "torques": joints,
        "foot_contact": ([1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 1.0, 0.0]),
        "foot_lin_vel": (joints[0], [4.0, -5.0, 6.0, 1.0, -2.0, 3.0, 10.0, -11.0, 12.0, 7.0, -8.0, 9.0]),
        "feet_air_time": ([1.0, 2.0, 3.0, 4.0], [2.0, 1.0, 4.0, 3.0]),
        "kick_force": ([1.0, 2.0, 0.0], [1.0, -2.0, 0.0]),
        "kick_active": ([1.0], [1.0]),
    }
    return {"state": state, "privileged_state": privileged}


def side_by_side(rows: dict[str, Sides]) -> Sides:
    plain, mirrored = ([number for row in rows.values() for number in row[side]] for side in (0, 1))
    return plain, mirrored


def test_one_observation_by_hand(env: LeggedRobot) -> None:
    rows = rows_by_hand()
    assert {group: list(table) for group, table in layout(env).items()} == {
        group: list(table) for group, table in rows.items()
    }
    numbers = {group: side_by_side(table) for group, table in rows.items()}
    seen, image = (
        TensorDict({group: torch.tensor([both[i]]) for group, both in numbers.items()}, batch_size=[1]) for i in (0, 1)
    )
    plain, mirrored = joints_by_hand()
    obs, actions = mirror(env=env, obs=seen, actions=torch.tensor([plain]))  # by keyword, as rsl-rl calls it
    assert obs is not None and actions is not None and obs.batch_size == torch.Size([2])
    for group in numbers:
        torch.testing.assert_close(
            obs[group], torch.cat([seen[group], image[group]]), msg=lambda text, group=group: f"{group}: {text}"
        )
    assert actions.tolist() == [plain, mirrored]


def test_what_is_not_given_is_not_made(env: LeggedRobot) -> None:
    obs = env.get_observations()
    assert mirror(env, None, None) == (None, None)
    only, none = mirror(env, obs.select("privileged_state"), None)
    assert only is not None and list(only.keys()) == ["privileged_state"] and none is None
    none, actions = mirror(env, None, torch.zeros(3, 12))
    assert none is None and actions is not None and actions.shape == (6, 12)


def test_mirroring_asks_the_host_nothing_and_lets_gradients_through() -> None:
    env = make_env(2, QUIET)
    with torch.inference_mode():
        obs = env.get_observations()
        mirror(env, obs, None)  # first asked for where tensors are made that no gradient may pass
    actions = torch.randn(4, 12, requires_grad=True)
    obs = env.get_observations()
    with recordable():
        _, both = mirror(env, obs, actions)
    assert both is not None
    (both * torch.arange(8.0)[:, None]).sum().backward()
    sign = torch.tensor([-1.0, 1.0, 1.0] * 4)  # of a joint's number in the mirror
    assert actions.grad is not None and torch.equal(
        actions.grad, torch.arange(4.0)[:, None] + torch.arange(4.0, 8.0)[:, None] * sign
    )


def test_the_step_knows_nothing_of_it() -> None:
    env = make_env(2, QUIET)
    env.step(torch.zeros(2, 12))
    assert "mirror" not in vars(env)
    first = env.mirror
    before = snapshot(env)
    mirror(env, env.get_observations(), torch.randn(2, 12))
    assert env.mirror is first and changed(env, before) == []


# ---- mirrored motion


def symmetric_go1(folder: Path, imu_y: str) -> str:
    """The Go1 with what is not symmetric about it put right: the trunk's and the calves' mass, and the IMU's place as asked."""
    xml = replaced(GO1, 'name="imu" pos="-0.01592 -0.06659 -0.00617"', f'name="imu" pos="-0.01592 {imu_y} -0.00617"', 1)
    xml = replaced(xml, 'pos="0.0223 0.002 -0.0005"', 'pos="0.0223 0 -0.0005"', 1)
    xml = replaced(
        xml, 'quat="-0.00342088047 0.705204098 0.000106698015 0.708996098"', 'quat="0 0.707107 0 0.707107"', 1
    )
    xml = replaced(xml, 'pos="0.00429862 0.000976676 -0.146197"', 'pos="0.00429862 0 -0.146197"', 4)
    xml = replaced(xml, 'quat="0.6912463 0.00357467155 0.00511118221 0.722592313"', 'quat="0.707107 0 0 0.707107"', 4)
    (folder / "go1.xml").write_text(xml)
    return str(folder / "go1.xml")


def mirrored_halves(env: LeggedRobot, worlds: int, reach: float) -> None:
    """Random states, commands and kicks in the first ``worlds``, their mirror images in the others."""
    env.reset()
    here, there = slice(0, worlds), slice(worlds, None)
    q, v = env.sim.qpos, env.sim.qvel
    q[here, 2] += 0.05 * torch.rand(worlds)
    q[here, 3:7] = torch.nn.functional.normalize(torch.tensor([1.0, 0.0, 0.0, 0.0]) + 0.1 * torch.randn(worlds, 4))
    q[here, 7:] += 0.1 * torch.randn(worlds, 12)
    v[here] = 0.5 * torch.randn(worlds, 18)
    env.commands[here] = torch.randn(worlds, 3)
    # pause, duration [control steps], direction [rad], dv [m/s]
    env.perturbation._kick[here] = torch.tensor([2.0, 30.0, 0.0, 3.0])
    env.perturbation._kick[here, 2] = torch.randn(worlds)
    # written out here, joints too, so that nothing is checked against itself
    swap, sign = torch.tensor([3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]), torch.tensor([-1.0, 1.0, 1.0] * 4)
    q[there, :3] = q[here, :3] * POLAR
    q[there, 3:7] = q[here, 3:7] * torch.tensor([1.0, -1.0, 1.0, -1.0])
    q[there, 7:] = q[here, 7:][:, swap] * sign
    v[there, :3] = v[here, :3] * POLAR
    v[there, 3:6] = v[here, 3:6] * AXIAL
    v[there, 6:] = v[here, 6:][:, swap] * sign
    env.commands[there] = env.commands[here] * torch.tensor([1.0, -1.0, -1.0])
    env.commands[there, 0] += reach * env.commands[here, 2]
    env.perturbation._kick[there] = env.perturbation._kick[here] * torch.tensor([1.0, 1.0, -1.0, 1.0])


# Float32 over 20 control steps with contacts grew to 4e-5 rad/s in a joint; an acceleration and a torque are larger numbers.
TOLERANCE = {"accelerometer": 5e-3, "dof_vel": 5e-4, "torques": 5e-4}


@pytest.mark.parametrize(
    ("imu_y", "reach"), [("0", 0.0), ("-0.06659", REACH)], ids=["IMU in the plane", "IMU beside it, as it is"]
)
def test_mirrored_states_and_actions_give_mirrored_observations_and_equal_rewards(
    imu_y: str, reach: float, tmp_path: Path
) -> None:
    """A world and its mirror image, stepped with an action and its mirror image, stay mirror images of each other: every row says so.

    Beside the plane, an IMU has an acceleration that no formula knows, and rewards read its velocity.
    """
    worlds = 16
    converged = {"sim.iterations": 100, "sim.ls_iterations": 50}
    kicks = {"perturbation.kick": True, "perturbation.interval": [5.0, 5.0], "perturbation.duration": [1.0, 1.0]}
    own = {"asset.file": symmetric_go1(tmp_path, imu_y), "rewards.only_positive_rewards": False}
    env = make_env(2 * worlds, {**QUIET, **converged, **kicks, **own})
    torch.manual_seed(3)
    mirrored_halves(env, worlds, reach)
    alive, seen = torch.ones(worlds, dtype=torch.bool), dict.fromkeys(layout(env)["privileged_state"], 0.0)
    for step in range(20):
        actions = mirror(env, None, 0.5 * torch.randn(worlds, 12))[1]
        assert actions is not None
        obs, reward, done, _ = env.step(actions)
        alive &= ~(done[:worlds] | done[worlds:])  # a fallen robot begins anew, each its own way
        expected = mirror(env, obs[:worlds], None)[0]
        assert expected is not None
        for group, table in layout(env).items():
            sizes = list(table.values())
            rows = zip(
                table,
                obs[group][worlds:].split(sizes, dim=1),
                expected[group][worlds:].split(sizes, dim=1),
                strict=True,
            )
            for name, got, wanted in rows:
                if name == "accelerometer" and reach:
                    continue
                error = float((got - wanted)[alive].abs().max())
                assert error <= TOLERANCE.get(name, 5e-4 if name == "state" else 1e-4), (
                    f"step {step}, {group}.{name}: {error:.1e}"
                )
                if group == "privileged_state":
                    seen[name] += float(got[alive].abs().sum())
        assert reach or torch.allclose(reward[:worlds][alive], reward[worlds:][alive], rtol=0.0, atol=1e-5), (
            f"step {step}"
        )
    assert alive.sum() >= worlds // 2 and reward[alive.repeat(2)].abs().max() > 0.01
    assert [name for name, total in seen.items() if total == 0.0] == (
        ["accelerometer"] if reach else []
    )  # nothing was compared while zero only
    assert env.sim.overflow_report() == ""


def test_a_mirrored_action_moves_its_joint_as_far_as_the_action_its_own() -> None:
    """Also where an action of 1 turns the right hips the other way, or one joint twice as far as its partner."""
    scales = {"": 0.25, "FR_hip": -0.25, "RR_hip": -0.25, "FL_calf": 0.5}
    env, plain = make_env(2, {**QUIET, "control.action_scale": scales}), make_env(2, QUIET)
    scale, turns = env.actuators.scale, torch.randn(5, 12)  # [rad] that the joints are asked to turn
    actions = mirror(env, None, turns / scale)[1]
    wanted = mirror(plain, None, turns)[1]
    assert actions is not None and wanted is not None
    torch.testing.assert_close(actions * scale, wanted)
    env.step(turns[:2] / scale)
    image = mirror(env, env.get_observations(), None)[0]
    assert image is not None
    span = env.observations.span("state", "last_actions")
    torch.testing.assert_close(image["state"][2:, span], mirror(env, None, env.last_actions)[1][2:])  # type: ignore[index]


# ---- rows of one's own


class _Extra(LeggedRobot):
    """A robot that also sees ``feet_air_time``, mirrored as ``kind`` says."""

    kind: str | None = None

    def observation_rows(self) -> dict[str, list[Row]]:
        rows = super().observation_rows()
        rows["state"].append(Row("extra", self.feet_air_time, mirror=self.kind))
        return rows


def test_a_row_needs_no_mirror_until_it_is_mirrored() -> None:
    env = make_env(2, QUIET, env_class=_Extra)
    env.step(torch.zeros(2, 12))  # symmetry is off: it works
    with pytest.raises(ConfigError):
        mirror(env, env.get_observations(), None)


def test_a_row_of_ones_own_mirrors_as_it_says() -> None:
    env = make_env(2, QUIET, env_class=type("_Robot", (_Extra,), {"kind": "foot"}))
    obs, _ = mirror(env, TensorDict({"state": torch.arange(52.0).expand(1, 52)}, batch_size=[1]), None)
    assert obs is not None and obs["state"][1, 48:].tolist() == [49.0, 48.0, 51.0, 50.0]
    assert env.mirror.observations["privileged_state"].index.shape == (127,)  # it contains the longer state


def test_a_loss_of_mirrors_with_a_weight_passes() -> None:
    task = load_task("go1_flat")
    task.set("symmetry.mirror_loss_coeff", 0.5)
    task.set("symmetry.use_mirror_loss", True)
    task.cfg.check()
    task.train.check(task.cfg.env.num_envs)


# ---- the learner


def small_task(**symmetry: Any) -> LoadedTask:
    task = load_task("go1_flat")
    for item in SMALL[SMALL.index("--set") + 1 :: 2]:
        task.set(*item.split("=", 1))
    task.set("env.num_envs", 4)
    task.set("algorithm.class_name", "PPO")
    for name, value in {"use_data_augmentation": False, **symmetry}.items():
        task.set(f"symmetry.{name}", value)
    return task


def test_switched_off_rsl_rl_hears_nothing_of_it() -> None:
    assert rsl_rl_config(small_task(mirror_loss_coeff=0.5).train)["algorithm"]["symmetry_cfg"] is None
    assert "symmetry" not in rsl_rl_config(small_task().train)


@pytest.mark.parametrize(
    "symmetry",
    [{"use_data_augmentation": True}, {"use_mirror_loss": True, "mirror_loss_coeff": 0.5}],
    ids=["augmentation", "mirror loss"],
)
def test_stock_ppo_learns_with_it(symmetry: dict[str, Any], tmp_path: Path) -> None:
    """One iteration of rsl-rl's own runner from a config that went through config.yaml."""
    task = small_task(**symmetry)
    save_yaml(tmp_path / "config.yaml", task.to_dict())
    again = load_task("go1_flat")
    update_from_run(again, load_yaml(tmp_path / "config.yaml"), where="config.yaml")
    assert again.train.to_dict() == task.train.to_dict()
    assert again.train.to_dict()["symmetry"] == {
        **{"use_data_augmentation": False, "use_mirror_loss": False, "mirror_loss_coeff": 0.0},
        **symmetry,
    }
    env = LeggedRobot(again.cfg, "cpu")
    runner = OnPolicyRunner(env, rsl_rl_config(again.train), None, "cpu")
    assert runner.alg.symmetry is not None and runner.alg.symmetry.data_augmentation_func is mirror
    before = {name: value.clone() for name, value in runner.alg.actor.state_dict().items()}
    losses: list[dict[str, float]] = []
    update = runner.alg.update
    runner.alg.update = lambda: losses.append(update()) or losses[-1]  # type: ignore[func-returns-value]
    runner.learn(1)
    assert losses[0]["symmetry"] > 0.0
    assert any(not torch.equal(before[name], value) for name, value in runner.alg.actor.state_dict().items())
    assert all(bool(value.isfinite().all()) for value in runner.alg.actor.state_dict().values())


def test_rsl_rl_reads_what_mirror_returns_as_it_is_meant(env: LeggedRobot) -> None:
    """Twice the batch, originals first; and the mirror loss is zero for a policy that does on the left what it does on the right."""
    symmetry = Symmetry(env, "legged_mw.rl.ppo:mirror", use_data_augmentation=True)
    obs = TensorDict({group: torch.randn(5, value.shape[1]) for group, value in env.obs_buf.items()}, batch_size=[5])
    numbers = torch.randn(5, 1)
    batch = RolloutStorage.Batch(
        observations=obs,
        actions=torch.randn(5, 12),
        values=numbers,
        advantages=numbers,
        returns=numbers,
        old_actions_log_prob=numbers,
    )
    symmetry.augment_batch(batch, 5)
    assert batch.observations is not None and batch.observations.batch_size == torch.Size([10])
    assert batch.actions is not None and batch.actions.shape == (10, 12)
    assert torch.equal(batch.observations["state"][:5], obs["state"])
    assert batch.advantages is not None and torch.equal(batch.advantages, torch.cat([numbers, numbers]))

    def servo(obs: TensorDict) -> Tensor:
        return -0.5 * obs["state"][:, 9:21] - 0.1 * obs["state"][:, 21:33]

    def limp(obs: TensorDict) -> Tensor:
        return servo(obs) * torch.linspace(0.0, 1.0, 12)

    assert float(symmetry.compute_loss(servo, batch, 5)) < 1e-12  # type: ignore[arg-type]
    assert float(symmetry.compute_loss(limp, batch, 5)) > 1e-3  # type: ignore[arg-type]


@pytest.mark.gpu
def test_a_cuda_graph_records_it() -> None:
    """With other observations in the same place, the replay mirrors those."""
    task = small_task()
    env = LeggedRobot(task.cfg, "cuda:0")
    assert env.mirror.actions.sign.device.type == "cuda"
    obs = TensorDict(
        {group: torch.randn(5, v.shape[1], device="cuda:0") for group, v in env.obs_buf.items()},
        batch_size=[5],
        device="cuda:0",
    )
    actions = torch.randn(5, 12, device="cuda:0")
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        both, both_actions = mirror(env, obs, actions)
    assert both is not None and both_actions is not None
    for value in (*obs.values(), actions):
        value.normal_()
    graph.replay()
    expected, expected_actions = mirror(env, obs, actions)
    assert expected is not None and expected_actions is not None
    assert torch.equal(both_actions, expected_actions)
    assert all(torch.equal(both[group], expected[group]) for group in ("state", "privileged_state"))
