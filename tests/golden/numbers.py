"""Numbers that no field may have, and sizes that no machine has."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import pytest
from attack import program

from golden.table import Run, Table
from legged_mw import ROOT
from legged_mw.utils import machine
from legged_mw.utils.config import load_yaml, save_yaml

SETS = [
    "algorithm.gamma=5",
    "algorithm.gamma=.nan",
    "algorithm.lam=-0.5",
    "algorithm.clip_param=-1",
    "algorithm.learning_rate=0",
    "algorithm.learning_rate=1e9",
    "algorithm.max_grad_norm=-.inf",
    "algorithm.entropy_coef=-1",
    "algorithm.desired_kl=0",
    "algorithm.num_learning_epochs=1000000000",
    "algorithm.num_mini_batches=0",
    "actor.distribution_cfg.init_std=.nan",
    "actor.distribution_cfg.init_std=-0.1",
    "actor.distribution_cfg.std_range=[1, 0.1]",
    "actor.hidden_dims=[0]",
    "actor.hidden_dims=[128, -3]",
    "critic.hidden_dims=[1.5]",
    "runner.max_iterations=-5",
    "runner.save_interval=0",
    "seed=9223372036854775808",
    "control.stiffness={hip: -35, thigh: 35, calf: 35}",
    "control.damping={'': .inf}",
    "control.action_scale=0",
    "control.action_scale={'': .nan}",
    "control.decimation=1000000000",
    "sim.dt=1e-300",
    "sim.dt=.inf",
    "sim.dt=1e30",
    "sim.iterations=100000000",
    "sim.threads=100000",
    "init_state.pos=[.nan, 0, 0]",
    "init_state.pos=[0, 0, 1e9]",
    "init_state.pos=[0, 0]",
    "init_state.yaw_range=.nan",
    "init_state.lin_vel_range=-1",
    "init_state.default_joint_angles={'': .nan}",
    "commands.ranges.lin_vel_x=[1, -1]",
    "commands.ranges.ang_vel_yaw=[.nan, 1]",
    "commands.change_probability=1.5",
    "commands.resampling_time=-1",
    "rewards.tracking_sigma=0",
    "rewards.scales.torques=1e39",
    "rewards.scales.orientation=.nan",
    "rewards.soft_dof_pos_limit=7",
    "rewards.pose_weights={'': -1}",
    "ratings.continuous_torque={'': 0}",
    "noise.level=-1",
    "noise.scales.dof_vel=.nan",
    "normalization.clip_actions=-2",
    "domain_rand.friction=[-1, 1]",
    "domain_rand.friction=[1e-30, 1]",
    "domain_rand.link_mass=[1e30, 1e38]",
    "perturbation.velocity=[0, 1e38]",
    "terrain.measured_points_x=[1e38]",
    "domain_rand.action_delay=[-1, 2]",
    "domain_rand.base_mass=[.nan, 1]",
    "perturbation.interval=[3, 1]",
    "perturbation.push_interval_s=1e30",
    "termination.max_tilt=360",
    "terrain.friction=-0.6",
    "terrain.slope=89",
    "terrain.condim=5",
    "terrain.difficulty=[0, 2.5]",
    "observations.history={state: 0}",
    "observations.history={state: -7}",
    "viewer.width=100000",
    "gait.stance=1",
    "exam.push_speeds=[-1]",
    "cpu.overrides={sim.dt: .nan}",
    "anneal.entropy_coef=.nan",
    "env.episode_length_s=0",
    "runner.run_name=a:b",
    "env.num_envs=0",
    "env.episode_length_s=3e38",
    "env.episode_length_s=1e-9",
    "control.decimation=0",
    "control.action_scale=1e5",
    "control.action_scale={'': 0}",
    "terrain.seed=-1",
    "terrain.terrain_proportions={stairs_up: .inf}",
    "terrain.measured_points_y=[.nan]",
    "commands.ranges.lin_vel_y=[0.5]",
    "commands.mirror={lin_vel_x: 0.5}",
    "perturbation.duration=[0.2, 0.1]",
    "domain_rand.link_mass=[0.9]",
    "domain_rand.friction=[0, 1]",
    "domain_rand.friction=[1, 0.4]",
    "domain_rand.link_mass=[0, 1]",
    "domain_rand.model_factors={geom_size: [1]}",
    "gait.offsets=[0, 1.5]",
    "init_state.dof_pos_range=[1.5, 0.5]",
    "init_state.dof_pos_offset=[0.1]",
    "init_state.dof_vel_range=-1",
    "rewards.max_contact_force=-1",
    "domain_rand.base_com=[100, 100]",
    "domain_rand.contact_time=[1e-9, 1e-9]",
    "domain_rand.model_factors={dof_armature: [2, 1]}",
    "rewards.mirror_joints=[[FR_, RL_], [FL_]]",
    "rewards.tracking_sigma=3e38",
    "rewards.base_height_target=27",
    "rewards.swing_height=27",
    "termination.max_tilt=0",
    "termination.min_base_height=30",
    "init_state.default_joint_angles={thigh: 51}",
    "viewer.camera=[0, 0, 1]",
    "actor.hidden_dims=[]",
    "algorithm.clip_param=3e38",
    "warm_start.critic_warmup=1000000000000000000",
    "asset.foot_names=[]",
    "asset.foot_names=[FR, FR]",
    "asset.effort={hip: 0}",
    "asset.armature={hip: -1}",
    "asset.frictionloss={hip: -1}",
    "asset.joint_speed_limits={hip: 0}",
    "actor.rnn_type=grru",
    "critic.rnn_hidden_dim=0",
    "actor.rnn_num_layers=0",
]
DRAWN = ["--set", "domain_rand.enable=true", "--set"]
RECURRENT = ["--set", "actor.class_name=RNNModel", "--set", "critic.class_name=RNNModel", "--set"]
SIZES = [
    ["--num_envs", "1000000"],
    ["--num_envs", "1000000000"],
    ["--set", "env.num_envs=100000000000000000000"],
    ["--set", "env.num_envs=1000000000000000000000000"],
    ["--set", "actor.hidden_dims=[100000000]"],
    ["--set", "critic.hidden_dims=[1000000, 1000000]"],
    ["--set", "actor.hidden_dims=[100000000000000000000]"],
    [*DRAWN, "domain_rand.action_delay=[0, 1000000000]"],
    [*DRAWN, "domain_rand.observation_delay=[0, 100000000000000000000]"],
    [*DRAWN, "domain_rand.delay_ms=[0, 1e12]"],
    ["--set", "observations.history={state: 1000000000}"],
    ["--set", "runner.num_steps_per_env=1000000000"],
    [*RECURRENT, "critic.rnn_hidden_dim=10000000"],
    ["--set", "terrain.mesh_type=heightfield", "--set", "terrain.num_rows=100000000"],
    ["--max_time", "9999999999h"],
    ["--num_envs", "9" * 5000],
]
STRANGERS: list[tuple[str, dict[str, Any]]] = [  # in the config.yaml of a stranger's policy
    ("actor", {"hidden_dims": [100000000]}),
    ("env", {"num_envs": 0}),
    ("control", {"stiffness": {"": -1.0}}),
    ("observations", {"history": {"state": 1000000000}}),
    ("sim", {"dt": math.nan}),
]


def with_4_gb(run: Run) -> Run:
    def narrow(root: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(machine, "free_memory", lambda device="cpu": 4e9)
            run(root)

    return narrow


def theirs(section: str, fields: dict[str, Any]) -> Run:
    def given(root: Path) -> None:
        config = load_yaml(ROOT / "resources/policies/go1_flat/config.yaml")
        shutil.copytree(ROOT / "resources/policies/go1_flat", root / "theirs")
        save_yaml(root / "theirs/config.yaml", {**config, section: {**config.get(section, {}), **fields}})

    return given


def table() -> Table:
    made = Table()
    for change in SETS:
        made.add(change, program("train", "--check", "--set", change))
    for flags in SIZES:
        small = [] if "env.num_envs" in flags[-1] or "--num_envs" in flags else ["--set", "env.num_envs=16"]
        made.add(" ".join(flags)[:80], with_4_gb(program("train", "--check", *small, *flags)))
    for section, fields in STRANGERS:
        made.add(
            f"a stranger's {section}",
            with_4_gb(program("play", "--load_run", "ROOT/theirs", "--viewer", "none")),
            theirs(section, fields),
        )
    return made
