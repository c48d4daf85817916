"""The environment on rough ground: heights, tiles, what ends an episode, levels by the rule, what a checkpoint keeps."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor
from worlds import QUIET, make_env

from legged_mw.check.recordable import recordable
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.observations import Row
from legged_mw.rl.runner import make_runner
from legged_mw.utils.config import ConfigError
from legged_mw.utils.task import load_task

ENGINES = ("mujoco", "mujoco_warp")
SMALL: dict[str, Any] = {
    "terrain.num_rows": 4,
    "terrain.num_cols": 4,
    "terrain.terrain_proportions": {"stairs_up": 1.0, "obstacles": 1.0, "rough_slope": 1.0, "flat": 1.0},
    "terrain.max_init_terrain_level": 3,
    "terrain.border_size": 2.0,
    "perturbation.push": False,
    "domain_rand.enable": False,
}
STAND = torch.zeros(12)


def rough(num_envs: int = 16, task: str = "go1_rough", **changes: Any) -> LeggedRobot:
    return make_env(
        num_envs, {**SMALL, **QUIET, **{path.replace("__", "."): value for path, value in changes.items()}}, task=task
    )


def ground_under(env: LeggedRobot, places: Tensor) -> np.ndarray:
    """Height [m] of the compiled height field under places (M, 2), by MuJoCo's own rays."""
    model = env.robot.spec.copy().compile()
    data, hit = mujoco.MjData(model), np.zeros(1, dtype=np.int32)
    data.qpos[2] = 100.0  # the robot out of the way
    mujoco.mj_forward(model, data)
    down = np.array([0.0, 0.0, -1.0])
    return np.array(
        [10.0 - mujoco.mj_ray(model, data, np.array([x, y, 10.0]), down, None, 1, -1, hit) for x, y in places.tolist()]
    )


@pytest.mark.parametrize("engine", ENGINES)
def test_heights_are_above_the_ground_of_the_compiled_model(engine: str) -> None:
    env = rough(sim__engine=engine, init_state__pos_xy_range=1.5)
    for _ in range(3):
        env.step(STAND.expand(16, -1))
    assert env.reset_buf.sum() == 0
    feet = env.sim.site_xpos[:, env.foot_sites]
    below = ground_under(env, feet[..., :2].reshape(-1, 2)).reshape(16, 4)
    np.testing.assert_allclose(env.foot_height, feet[..., 2].numpy() - below, atol=1e-4)
    np.testing.assert_allclose(
        env.base_height, env.sim.qpos[:, 2].numpy() - ground_under(env, env.sim.qpos[:, :2]), atol=1e-4
    )
    assert np.ptp(below) > 0.05, "the feet stand at different heights"


def test_the_height_scan_is_what_rays_around_the_robot_hit() -> None:
    env = rough(8, "go1_rough_scan", noise__level=0.0)
    yaw = torch.linspace(-3.0, 3.0, 8)
    env.sim.qpos[:, 3], env.sim.qpos[:, 6] = torch.cos(yaw / 2), torch.sin(yaw / 2)
    env.sim.qpos[:, 2] += 0.1
    env.compute_observations()
    x, y = env.scan_points
    assert (x[:11].tolist(), y[:2].tolist()) == ([pytest.approx(-0.8)] * 11, [pytest.approx(-0.5), pytest.approx(-0.4)])
    scan = env.obs_buf["state"][:, -187:]
    for world in range(8):
        root, a = env.sim.qpos[world, :3], yaw[world]
        places = torch.stack([root[0] + a.cos() * x - a.sin() * y, root[1] + a.sin() * x + a.cos() * y], dim=1)
        expected = float(root[2]) - 0.278 - ground_under(env, places)
        np.testing.assert_allclose(scan[world], expected.clip(-1.0, 1.0), atol=1e-4)
    assert torch.equal(env.obs_buf["privileged_state"][:, -187:], scan)


def test_the_scan_is_noisy_for_the_policy_and_true_for_the_critic() -> None:
    env = rough(8, "go1_rough_scan", noise__level=1.0)
    seen, true = env.obs_buf["state"][:, -187:], env.obs_buf["privileged_state"][:, -187:]
    error = (seen - true).abs()
    assert 0.08 < error.max() <= 0.1 + 1e-6 and torch.equal(true, env.height_scan)
    blind = rough(8)
    assert blind.obs_buf["state"].shape[1] == 56 and blind.obs_buf["privileged_state"].shape[1] == 131 + 187


def test_the_scan_of_the_policy_is_late_also_in_a_table_of_its_own() -> None:
    class Own(LeggedRobot):
        def observation_rows(self) -> dict[str, list[Row | str]]:
            return {
                "state": self._height_rows("state", 0.1),
                "privileged_state": ["state", *self._height_rows("privileged_state")],
            }

    overrides = {**SMALL, **QUIET, "terrain.height_scan": ["state", "privileged_state"]}
    rows = make_env(2, overrides, task="go1_rough_scan", env_class=Own).observations.groups
    assert [row.measured for row in (rows["state"][0], rows["privileged_state"][1])] == [True, False]


def test_on_a_plane_the_scan_is_flat() -> None:
    env = rough(4, "go1_rough_scan", terrain__mesh_type="plane", noise__level=0.0)
    env.sim.qpos[:, 2] = 0.378
    env.compute_observations()
    np.testing.assert_allclose(env.obs_buf["state"][:, -187:], 0.1, atol=1e-6)
    assert env.tiles is None and env.training_state().keys() <= {"kick_level"}


def test_the_mirror_image_of_a_scan_is_the_scan_of_the_mirrored_ground() -> None:
    env = rough(2, "go1_rough_scan", noise__level=0.0)
    # grows to the left; same on both sides
    scan = torch.stack([env.scan_points[1], env.scan_points[0] + 0.1 * env.scan_points[1] ** 2])
    state = torch.cat([env.obs_buf["state"][:, :-187], scan], dim=1)
    image = env.mirror.observations["state"](state)[:, -187:]
    torch.testing.assert_close(image[0], -scan[0])
    torch.testing.assert_close(image[1], scan[1])
    with pytest.raises(ConfigError, match=r"terrain.measured_points_y .* is not its own mirror image"):
        _ = rough(2, "go1_rough_scan", terrain__measured_points_y=[0.0, 0.5]).mirror


def test_robots_begin_near_the_middle_of_their_tile() -> None:
    env = rough(64)
    assert env.terrain and env.tiles
    assert env.tiles.columns.tolist() == [i // 16 for i in range(64)] and set(env.tiles.levels.tolist()) == {0, 1, 2, 3}
    expected = env.terrain.origins[env.tiles.levels, env.tiles.columns]
    away = env.sim.qpos[:, :3].numpy() - expected
    assert (np.abs(away[:, :2]) <= 0.5).all() and np.ptp(away[:, 0]) > 0.5
    np.testing.assert_allclose(away[:, 2], 0.278, atol=1e-5)


def test_who_walks_off_the_grid_is_timed_out_and_has_not_fallen() -> None:
    env = rough(4)
    assert env.tiles and env.tiles.edge.tolist() == [17.0, 17.0]  # two tiles of 8 m and half of the border
    env.sim.qpos[0, 0], env.sim.qpos[1, 1], env.sim.qpos[2, 0] = 17.1, -17.1, 16.9
    env.sim.qpos[:3, 2] = 0.3
    _, _, done, extras = env.step(STAND.expand(4, -1))
    assert done.tolist() == extras["time_outs"].tolist() == [True, True, False, False] and not env.fell.any()
    assert (env.sim.qpos[:2, :2].abs() < 17.0).all(), "they begin anew on their tiles"


def test_who_walks_off_has_not_survived_the_episode() -> None:
    env = rough(2, perturbation__kick=True, perturbation__curriculum=True)
    env.sim.qpos[0, 0] = 17.1
    env._episode_length_buf[1] = env.max_episode_length
    env.step(STAND.expand(2, -1))
    assert env.time_out_buf.tolist() == [True, True]
    assert env.perturbation.kick_level[0] < 0.01 and env.perturbation.kick_level[1] == 0.5


def test_few_worlds_take_kinds_from_all_over() -> None:
    assert rough(1).tiles.columns.tolist() == [2] and rough(2).tiles.columns.tolist() == [1, 3]  # type: ignore[union-attr]


def test_beyond_the_flat_middle_robots_begin_on_the_ground() -> None:
    env = rough(64, init_state__pos_xy_range=3.0)
    np.testing.assert_allclose(env.sim.qpos[:, 2].numpy() - ground_under(env, env.sim.qpos[:, :2]), 0.278, atol=1e-4)


def test_a_command_below_the_smallest_asks_nothing() -> None:
    env = rough(2, rewards__min_command=0.2)
    env.commands[:] = torch.tensor([[0.15, 0.0, 0.0], [0.3, 0.0, 0.0]])
    env.step(STAND.expand(2, -1))
    assert env.commanded_distance[:, 0].tolist() == [0.0, pytest.approx(0.006)] and env.progress[0] == 0.0


def test_a_trunk_near_the_ground_is_a_fall() -> None:
    env = rough(4, termination__min_base_height=0.12)
    env.sim.qpos[0, 2] -= 0.178  # to 0.1 m, and the feet are far below the ground
    env.sim.qpos[1, 2] -= 0.05
    env.step(STAND.expand(4, -1))
    assert env.fell.tolist() == [True, False, False, False]
    free = rough(4, termination__min_base_height=0.0)
    free.sim.qpos[0, 2] -= 0.178
    free.step(STAND.expand(4, -1))
    assert not free.fell.any()


def test_a_new_episode_keeps_no_height_of_the_last_one() -> None:
    """A row of one's own may read them: where the robot begins, and feet on the ground."""
    env = rough(4)
    env.step(STAND.expand(4, -1))
    env.sim.qpos[0, 2] += 1.0
    env.sim.qpos[0, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    env.step(STAND.expand(4, -1))
    assert env.reset_buf.tolist() == [True, False, False, False]
    assert env._height_at and not env.foot_height[0].any() and env.foot_height[1].any()
    torch.testing.assert_close(env.base_height[0], (env.root_pos[:, 2] - env._height_at(env.root_pos[:, :2]))[0])


# ---- levels ---------------------------------------------------------------------------------------------------------


def episode(
    env: LeggedRobot,
    world: int,
    *,
    asked: float,
    progress: float,
    farthest: float,
    seconds: float = 20.0,
    fell: bool = False,
) -> None:
    """Write into the books that ``world`` had such an episode."""
    env.commanded_distance[world], env.progress[world], env.max_distance[world], env.commanded_speed[world] = (
        asked,
        progress,
        farthest,
        1.0,
    )
    env.episode_steps[world], env.fell[world] = round(seconds / env.dt), fell


def test_levels_move_by_the_rule() -> None:
    env = rough(8)
    assert env.tiles
    env.tiles.put(torch.full((8,), 1))
    env.commands[:] = torch.tensor([1.0, 0.0, 0.0])
    episode(env, 0, asked=10.0, progress=9.0, farthest=4.1)  # left its tile
    episode(env, 1, asked=10.0, progress=9.0, farthest=3.9)  # walked well, in circles
    episode(env, 2, asked=10.0, progress=4.9, farthest=3.0)  # covered less than half
    episode(env, 3, asked=0.0, progress=0.0, farthest=0.2)  # was told to stand, or to turn
    episode(env, 4, asked=2.0, progress=2.0, farthest=2.0, seconds=2.0, fell=True)  # fell early: owes the other 18 m
    episode(env, 5, asked=12.0, progress=12.0, farthest=3.0, seconds=12.0, fell=True)  # fell late
    episode(env, 6, asked=10.0, progress=1.0, farthest=4.1)  # was pushed off: up goes before down
    mask = torch.ones(8, dtype=torch.bool)
    mask[6] = False
    env._update_terrain_curriculum(mask)
    assert env.tiles.levels.tolist() == [2, 1, 0, 1, 0, 1, 1, 1]
    env._update_terrain_curriculum(~mask)
    assert env.tiles.levels[6] == 2
    torch.testing.assert_close(
        env.tiles.origins, torch.tensor(env.terrain.origins[env.tiles.levels, env.tiles.columns], dtype=torch.float)
    )


def test_the_lowest_level_holds_and_from_the_last_it_goes_anywhere() -> None:
    env = rough(400)
    assert env.tiles
    env.tiles.put(torch.arange(400) % 2 * 3)
    for world in range(400):
        far = world % 2 == 1
        episode(env, world, asked=10.0, progress=9.0 if far else 0.0, farthest=5.0 if far else 0.0)
    env._update_terrain_curriculum(torch.ones(400, dtype=torch.bool))
    assert set(env.tiles.levels[::2].tolist()) == {0}
    counts = torch.bincount(env.tiles.levels[1::2], minlength=4)
    assert len(counts) == 4 and (counts > 25).all()


def test_books_are_kept_along_the_command() -> None:
    env = rough(3, commands__resampling_time=0.0)
    env.commands[:] = torch.tensor([[1.0, 0.0, 0.0], [0.0, -0.5, 0.0], [0.0, 0.0, 1.0]])
    env.sim.qvel[:, 0] = 0.0
    env.step(STAND.expand(3, -1))
    torch.testing.assert_close(env.commanded_distance[:, 0], torch.tensor([0.02, 0.01, 0.0]))
    along = torch.stack([env.base_lin_vel[0, 0], -env.base_lin_vel[1, 1], torch.tensor(0.0)]) * 0.02
    torch.testing.assert_close(env.progress[:, 0], along)
    away = (env.sim.qpos[:, :2] - env.tiles.origins[:, :2]).abs().amax(dim=1)  # type: ignore[union-attr]
    torch.testing.assert_close(env.max_distance[:, 0], away)
    env.sim.qpos[0, 0] = env.tiles.origins[0, 0]  # type: ignore[union-attr]
    env.step(STAND.expand(3, -1))
    assert env.max_distance[0, 0] >= away[0], "it remembers"


def test_without_the_curriculum_any_level_comes_at_each_reset() -> None:
    env = rough(200, terrain__curriculum=False)
    assert env.tiles
    before = env.tiles.levels.clone()
    env.episode_steps.fill_(1.0)
    env.reset_envs(torch.arange(200) < 100)
    assert torch.equal(env.tiles.levels[100:], before[100:]) and not torch.equal(env.tiles.levels[:100], before[:100])
    assert set(env.tiles.levels.tolist()) == {0, 1, 2, 3}


def test_a_reset_before_any_step_moves_nobody() -> None:
    env = rough(32)
    before = env.tiles.levels.clone()  # type: ignore[union-attr]
    env.reset()
    env.reset()
    assert torch.equal(env.tiles.levels, before)  # type: ignore[union-attr]


def test_levels_are_reported_by_kind() -> None:
    env = rough(16)
    assert env.tiles
    env.tiles.put(torch.tensor([0, 1, 2, 3] * 2 + [3] * 4 + [0] * 4))
    numbers = env.read_statistics()
    expected = {"stairs_up": 1.5, "obstacles": 1.5, "rough_slope": 3.0, "flat": 0.0}
    assert {kind: numbers[f"terrain_level/{kind}"] for kind in expected} == expected and numbers["terrain_level"] == 1.5


# ---- commands -------------------------------------------------------------------------------------------------------


def test_ranges_of_commands_grow_when_they_are_tracked() -> None:
    env = rough(10, commands__curriculum=True, commands__curriculum_start=0.5)
    assert (
        env.command_ranges[1].tolist() == pytest.approx([0.75, 0.4, 0.6])
        and (env.commands.abs() <= env.command_ranges[1] + 1e-6).all()
    )
    column, best = (
        env.reward_names.index("tracking_lin_vel"),
        float(env.reward_scales[env.reward_names.index("tracking_lin_vel")]) * 100,
    )

    def ended(worlds: int, share: float) -> float:
        env.episode_steps.fill_(100.0)
        env.episode_sums[:, column] = share * best
        env._update_command_curriculum(torch.arange(10) < worlds)
        return float(env.command_curriculum[0])

    assert ended(5, 0.9) == 0.5, "as many episodes as there are worlds must have ended"
    assert ended(5, 0.75) == pytest.approx(0.6)
    assert ended(10, 0.79) == pytest.approx(0.6), "not tracked well enough"
    for _ in range(6):
        ended(10, 0.95)
    assert env.command_curriculum[0] == 1.0 and env.command_ranges[1].tolist() == pytest.approx([1.5, 0.8, 1.2])
    assert env.read_statistics()["command_share"] == 1.0


def test_a_range_without_zero_grows_from_its_end_that_is_nearest() -> None:
    env = rough(2, commands__curriculum=True, commands__curriculum_start=0.5, commands__ranges__lin_vel_x=[0.5, 1.5])
    assert env.command_ranges[:, 0].tolist() == pytest.approx([0.5, 1.0]) and env.command_ranges[
        :, 1
    ].tolist() == pytest.approx([-0.4, 0.4])
    with pytest.raises(ConfigError, match=r"commands.curriculum goes by how well tracking_lin_vel is met: give"):
        rough(2, commands__curriculum=True, rewards__scales__tracking_lin_vel=0.0)


def test_the_whole_step_asks_the_host_nothing_with_every_curriculum() -> None:
    env = rough(
        8, sim__engine="mujoco_warp", commands__curriculum=True, perturbation__kick=True, termination__max_tilt=10.0
    )
    env._episode_length_buf[:4] = env.max_episode_length
    with recordable():
        env._step()


# ---- resume ---------------------------------------------------------------------------------------------------------


def trained(num_envs: int, **changes: Any) -> tuple[LeggedRobot, Any]:
    env = rough(num_envs, commands__curriculum=True, perturbation__kick=True, perturbation__curriculum=True, **changes)
    task = load_task("go1_rough")
    for path, value in {
        "runner.num_steps_per_env": 4,
        "actor.hidden_dims": [8],
        "critic.hidden_dims": [8],
        "cpu.update_threads": 1,
    }.items():
        task.set(path, value)
    return env, make_runner(env, task.train, None, "cpu")


def test_curricula_survive_a_resume(tmp_path: Path) -> None:
    env, runner = trained(16)
    assert env.tiles
    env.tiles.put(torch.arange(16) % 4)
    env.perturbation.kick_level.copy_(torch.linspace(0.0, 1.0, 16))
    env.command_curriculum.copy_(torch.tensor([0.7, 3.5, 5.0]))
    runner.save(str(tmp_path / "model_0.pt"))
    other, again = trained(16)
    again.load(str(tmp_path / "model_0.pt"))
    assert (
        other.tiles
        and torch.equal(other.tiles.levels, env.tiles.levels)
        and torch.equal(other.tiles.origins, env.tiles.origins)
    )
    assert torch.equal(other.perturbation.kick_level, env.perturbation.kick_level) and torch.equal(
        other.command_curriculum, env.command_curriculum
    )
    assert other.command_ranges[1, 0] == pytest.approx(0.7 * 1.5)
    away = (other.sim.qpos[:, :2] - other.tiles.origins[:, :2]).abs()
    assert (away <= 0.5).all(), "the worlds stand on the levels that they have"
    again.learn(1)


def test_a_resume_with_other_numbers_of_worlds_and_levels_keeps_what_fits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    env, runner = trained(16)
    assert env.tiles
    env.tiles.put(torch.tensor([0] * 4 + [1] * 4 + [2] * 4 + [3] * 4))  # a level a kind
    env.command_curriculum.copy_(torch.tensor([0.7, 11.0, 12.0]))
    runner.save(str(tmp_path / "model_0.pt"))
    more, again = trained(32)
    again.load(str(tmp_path / "model_0.pt"))
    assert more.command_curriculum[1:].tolist() == [0.0, 0.0], "what was counted was of other worlds"
    assert more.tiles and more.tiles.levels.tolist() == [0] * 8 + [1] * 8 + [2] * 8 + [3] * 8
    fewer, again = trained(16, terrain__num_rows=2, terrain__max_init_terrain_level=1)
    assert "the last one here" not in capsys.readouterr().out
    again.load(str(tmp_path / "model_0.pt"))
    assert fewer.tiles and fewer.tiles.levels.tolist() == [0] * 4 + [1] * 12
    assert "8 worlds go on on level 1, the last one here" in capsys.readouterr().out


def test_a_mistake_is_named() -> None:
    with pytest.raises(ConfigError, match=r"terrain.border_size is 0.5; it must be 1 m or more"):
        rough(2, terrain__border_size=0.5)
    assert max(rough(64, terrain__max_init_terrain_level=50).tiles.levels.tolist()) == 3  # type: ignore[union-attr]
    with pytest.raises(
        ConfigError, match=r"terrain.height_scan\[0\] must be Literal\['state', 'privileged_state'\], not 'actor'"
    ):
        rough(2, terrain__height_scan=["actor"])
    assert math.isfinite(rough(2).base_height.sum())


def test_a_table_without_the_scan_that_was_asked_for_is_named() -> None:
    class Own(LeggedRobot):
        def observation_rows(self) -> dict[str, list[Row]]:
            return {
                group: [row for row in rows if getattr(row, "name", row) != "height_scan"]
                for group, rows in super().observation_rows().items()
            }

    task = load_task("go1_rough_scan")
    task.set("env.num_envs", 2)
    task.set("terrain.mesh_type", "plane")
    with pytest.raises(
        ConfigError,
        match=r"terrain.height_scan names 'state', but Own.observation_rows has no row height_scan in 'state'",
    ):
        Own(task.cfg, "cpu")


# ---- MuJoCo's own engine: level pieces as boxes ------------------------------------------------------------------------


def test_level_pieces_are_boxes_and_slopes_are_not() -> None:
    env = rough(4, terrain__terrain_proportions={"stairs_up": 1.0, "gap": 1.0, "waves": 1.0, "low_random": 1.0})
    model, ground = env.robot.physics, env.robot.ground_geoms()
    boxes = [i for i in range(model.ngeom)[ground] if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_BOX]
    assert 150 < len(boxes) < 200 and ground == slice(0, 1 + len(boxes))
    tops = model.geom_pos[boxes, 2] + model.geom_size[boxes, 2]
    middles = torch.tensor(model.geom_pos[boxes, :2], dtype=torch.float)
    np.testing.assert_allclose(tops, ground_under(env, middles), atol=1e-4)
    area = 4.0 * model.geom_size[boxes, 0] * model.geom_size[boxes, 1]
    levels_of_noise = 1  # the first level of waves and of low_random is flat: a box too
    assert area.sum() == pytest.approx(64.0 * (4 + 4 + 2 * levels_of_noise), rel=1e-4), "each tile is covered once"
    plain = rough(4, sim__engine="mujoco_warp")
    assert plain.robot.ground_geoms() == slice(0, 1)


def test_feet_on_boxes_are_felt_and_their_friction_is_the_worlds_own() -> None:
    env = rough(
        8,
        terrain__terrain_proportions={"stairs_down": 1.0},
        terrain__num_cols=1,
        domain_rand__enable=True,
        domain_rand__friction=[0.3, 0.9],
        domain_rand__action_delay=[],
    )
    for _ in range(10):
        env.step(STAND.expand(8, -1))
    assert env.foot_contact.float().mean() > 0.7
    friction = env.sim.field("geom_friction")[:, env.robot.ground_geoms(), 0]
    torch.testing.assert_close(friction, env.domain_rand.values["friction"].expand_as(friction))


def test_a_robot_stands_alike_on_both_engines() -> None:
    """On tops of stairs: boxes in one, our contacts in the other."""
    heights = []
    for engine in ENGINES:
        env = rough(
            4,
            sim__engine=engine,
            terrain__terrain_proportions={"stairs_down": 1.0},
            terrain__num_cols=1,
            sim__iterations=30,
        )
        env.sim.qvel.zero_()
        env.tiles.put(torch.tensor([0, 1, 2, 3]))  # type: ignore[union-attr]
        env.sim.qpos[:, :3] = env.tiles.origins + torch.tensor([0.0, 0.0, 0.28])  # type: ignore[union-attr]
        for _ in range(25):
            env.step(STAND.expand(4, -1))
        heights.append(env.sim.qpos[:, 2].clone())
    torch.testing.assert_close(heights[0], heights[1], atol=1e-3, rtol=0.0)
    assert heights[0][3] > heights[0][0] + 0.9, "a pyramid of 8 steps, 19.5 cm instead of 6"
