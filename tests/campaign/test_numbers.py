"""Numbers that no field may have, and sizes that no machine has: refused by name, before anything is built or allocated."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import pytest
from attack import Case, attack, program

from legged_mw import ROOT
from legged_mw.utils import machine
from legged_mw.utils.config import load_yaml, save_yaml

SETS = [  # (what --set, --override or a flag says, what the line says)
    ("algorithm.gamma=5", "algorithm.gamma is 5.0; it must be from 0 to 1"),
    ("algorithm.gamma=.nan", "algorithm.gamma is nan; it must be finite"),
    ("algorithm.lam=-0.5", "algorithm.lam is -0.5; it must be from 0 to 1"),
    ("algorithm.clip_param=-1", "algorithm.clip_param is -1.0; it must be above 0"),
    ("algorithm.learning_rate=0", "algorithm.learning_rate is 0.0; it must be above 0 and at most 1"),
    ("algorithm.learning_rate=1e9", "algorithm.learning_rate is 1000000000.0; it must be above 0 and at most 1"),
    ("algorithm.max_grad_norm=-.inf", "algorithm.max_grad_norm is -inf; it must be finite"),
    ("algorithm.entropy_coef=-1", "algorithm.entropy_coef is -1.0; it must be 0 or more"),
    ("algorithm.desired_kl=0", "algorithm.desired_kl is 0.0; it must be above 0"),
    ("algorithm.num_learning_epochs=1000000000", "algorithm.num_learning_epochs is 1000000000; it must be from 1 to 1000"),
    ("algorithm.num_mini_batches=0", "algorithm.num_mini_batches is 0; it must be 1 or more"),
    ("actor.distribution_cfg.init_std=.nan", "actor.distribution_cfg.init_std is nan; it must be finite"),
    ("actor.distribution_cfg.init_std=-0.1", "actor.distribution_cfg.init_std is -0.1; it must be above 0"),
    (
        "actor.distribution_cfg.std_range=[1, 0.1]",
        "actor.distribution_cfg.std_range is [1.0, 0.1]; it must be two numbers, the lower first",
    ),
    ("actor.hidden_dims=[0]", "actor.hidden_dims[0] is 0; it must be 1 or more"),
    ("actor.hidden_dims=[128, -3]", "actor.hidden_dims[1] is -3; it must be 1 or more"),
    ("critic.hidden_dims=[1.5]", "critic.hidden_dims[0] must be int, not 1.5"),
    ("runner.max_iterations=-5", "runner.max_iterations is -5; it must be 1 or more"),
    ("runner.save_interval=0", "runner.save_interval is 0; it must be 1 or more"),
    ("seed=9223372036854775808", "seed is 9223372036854775808; it must be a whole number below 2^63"),
    ("control.stiffness={hip: -35, thigh: 35, calf: 35}", "control.stiffness['hip'] is -35.0; it must be from 0 to 1,000,000"),
    ("control.damping={'': .inf}", "control.damping[''] is inf; it must be finite"),
    ("control.action_scale=0", "control.action_scale is 0.0; it must be another number than 0"),
    ("control.action_scale={'': .nan}", "control.action_scale[''] is nan; it must be finite"),
    ("control.decimation=1000000000", "control.decimation is 1000000000; it must be from 1 to 1000"),
    ("sim.dt=1e-300", "sim.dt is 1e-300; it must be from 0.0001 to 0.1 s"),
    ("sim.dt=.inf", "sim.dt is inf; it must be finite"),
    ("sim.iterations=100000000", "sim.iterations is 100000000; it must be from 1 to 1000"),
    ("sim.threads=100000", "sim.threads is 100000; it must be from 0 to 1024"),
    ("init_state.pos=[.nan, 0, 0]", "init_state.pos[0] is nan; it must be finite"),
    ("init_state.pos=[0, 0, 1e9]", "init_state.pos[2] is 1000000000.0; it must be from -1000 to 1000 m"),
    ("init_state.pos=[0, 0]", "init_state.pos is [0.0, 0.0]; it must be three numbers"),
    ("init_state.yaw_range=.nan", "init_state.yaw_range is nan; it must be finite"),
    ("init_state.lin_vel_range=-1", "init_state.lin_vel_range is -1.0; it must be from 0 to 1000"),
    ("init_state.default_joint_angles={'': .nan}", "init_state.default_joint_angles[''] is nan; it must be finite"),
    ("commands.ranges.lin_vel_x=[1, -1]", "commands.ranges.lin_vel_x is [1.0, -1.0]; it must be two numbers, the lower first"),
    ("commands.ranges.ang_vel_yaw=[.nan, 1]", "commands.ranges.ang_vel_yaw[0] is nan; it must be finite"),
    ("commands.change_probability=1.5", "commands.change_probability is 1.5; it must be from 0 to 1"),
    ("commands.resampling_time=-1", "commands.resampling_time is -1.0; it must be from 0 to 1,000,000 s"),
    ("rewards.tracking_sigma=0", "rewards.tracking_sigma is 0.0; it must be above 0"),
    ("rewards.scales.torques=1e39", "rewards.scales.torques is 1e+39; it must be finite"),
    ("rewards.scales.orientation=.nan", "rewards.scales.orientation is nan; it must be finite"),
    ("rewards.soft_dof_pos_limit=7", "rewards.soft_dof_pos_limit is 7.0; it must be above 0 and at most 1"),
    ("rewards.pose_weights={'': -1}", "rewards.pose_weights[''] is -1.0; it must be 0 or more"),
    ("noise.level=-1", "noise.level is -1.0; it must be 0 or more"),
    ("noise.scales.dof_vel=.nan", "noise.scales.dof_vel is nan; it must be finite"),
    ("normalization.clip_actions=-2", "normalization.clip_actions is -2.0; it must be above 0"),
    ("domain_rand.friction=[-1, 1]", "domain_rand.friction[0] is -1.0; it must be above 0"),
    ("domain_rand.link_mass=[1e8, 1e8]", "domain_rand.link_mass[0] is 100000000.0; it must be above 0 and at most 1000"),
    ("perturbation.velocity=[0, 1e8]", "perturbation.velocity[1] is 100000000.0; it must be from -1000 to 1000 m/s"),
    ("terrain.measured_points_x=[1e8]", "terrain.measured_points_x[0] is 100000000.0; it must be from -100 to 100 m"),
    ("domain_rand.action_delay=[-1, 2]", "domain_rand.action_delay[0] is -1; it must be 0 or more"),
    ("domain_rand.base_mass=[.nan, 1]", "domain_rand.base_mass[0] is nan; it must be finite"),
    ("perturbation.interval=[3, 1]", "perturbation.interval is [3.0, 1.0]; it must be two numbers, the lower first"),
    ("perturbation.push_interval_s=1e8", "perturbation.push_interval_s is 100000000.0; it must be above 0 and at most 1,000,000 s"),
    ("termination.max_tilt=360", "termination.max_tilt is 360.0; it must be above 0 and at most 180 degrees"),
    ("terrain.friction=-0.6", "terrain.friction is -0.6; it must be 0 or more"),
    ("terrain.slope=89", "terrain.slope is 89.0; it must be from -60 to 60 degrees"),
    ("terrain.condim=5", "terrain.condim must be Literal[1, 3, 4, 6], not 5"),
    ("terrain.difficulty=[0, 2]", "terrain.difficulty[1] is 2.0; it must be from 0 to 1"),
    ("observations.history={state: 0}", "observations.history['state'] is 0; it must be 1 or more"),
    ("observations.history={state: -7}", "observations.history['state'] is -7; it must be 1 or more"),
    ("viewer.width=100000", "viewer.width is 100000; it must be from 1 to 8192"),
    ("gait.stance=1", "gait.stance is 1.0; it must be above 0 and below 1"),
    ("exam.push_speeds=[-1]", "exam.push_speeds[0] is -1.0; it must be above 0"),
    ("cpu.overrides={sim.dt: .nan}", "cpu.overrides['sim.dt'] is nan; it must be finite"),
    ("anneal.entropy_coef=.nan", "anneal.entropy_coef is nan; it must be finite"),
    ("env.episode_length_s=0", "env.episode_length_s is 0.0; it must be above 0 and at most 1,000,000 s"),
    ("runner.run_name=a:b", "runner.run_name is 'a:b'; it must be a plain name such as wide_net, of 100 bytes at most"),
]
DRAWN = ["--set", "domain_rand.enable=true", "--set"]
RECURRENT = ["--set", "actor.class_name=RNNModel", "--set", "critic.class_name=RNNModel", "--set"]
SIZES = [  # (flags, what the line says)
    (["--num_envs", "1000000"], "env.num_envs = 1000000 needs 5."),
    (["--num_envs", "1000000000"], "env.num_envs = 1000000000 needs 5."),
    (["--set", "env.num_envs=100000000000000000000"], "env.num_envs = 100000000000000000000 needs 5"),
    (["--set", "env.num_envs=1000000000000000000000000"], "env.num_envs is 1000000000000000000000000; it must be below 10^24"),
    (["--set", "actor.hidden_dims=[100000000]"], "[100000000] needs 78.4 GB of memory at least, and this machine has 4 GB free"),
    (["--set", "critic.hidden_dims=[1000000, 1000000]"], "critic.hidden_dims = [1000000, 1000000] needs 16 TB of memory at least"),
    (["--set", "actor.hidden_dims=[100000000000000000000]"], "actor.hidden_dims = [100000000000000000000] needs 78.4 ZB"),
    ([*DRAWN, "domain_rand.action_delay=[0, 1000000000]"], "domain_rand.action_delay = [0, 1000000000] needs "),
    (
        [*DRAWN, "domain_rand.observation_delay=[0, 100000000000000000000]"],
        "observation_delay = [0, 100000000000000000000] needs ",
    ),
    ([*DRAWN, "domain_rand.delay_ms=[0, 1e9]"], "domain_rand.delay_ms = [0.0, 1000000000.0] needs "),
    (["--set", "observations.history={state: 1000000000}"], "observations.history of 'dof_pos' = 1000000000 needs "),
    (["--set", "runner.num_steps_per_env=1000000000"], "runner.num_steps_per_env = 1000000000 with env.num_envs = "),
    ([*RECURRENT, "critic.rnn_hidden_dim=10000000"], "critic.rnn_hidden_dim = 10000000 needs "),
    (["--set", "terrain.mesh_type=heightfield", "--set", "terrain.num_rows=100000000"], "terrain: 100000000 x 20 tiles of 8 m"),
    (["--max_time", "9999999999h"], "'9999999999h' is no duration; write 90s, 5m or 1.5h"),
    (["--num_envs", "9" * 5000], "invalid positive value: '9999"),
]


@pytest.mark.parametrize(("change", "says"), SETS, ids=lambda value: value.partition(" is ")[0])
def test_numbers(change: str, says: str, tmp_path: Path) -> None:
    attack(Case("", program("train", "--check", "--set", change), (f"--set {change}: ", says)), tmp_path)


@pytest.mark.parametrize(("flags", "says"), SIZES, ids=lambda value: value[-1][:40] if isinstance(value, list) else "")
def test_sizes(flags: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a machine that has 4 GB left."""
    monkeypatch.setattr(machine, "free_memory", lambda device="cpu": 4e9)
    small = [] if "env.num_envs" in says or "--num_envs" in flags else ["--set", "env.num_envs=16"]
    attack(Case("", program("train", "--check", *small, *flags), says), tmp_path)


def test_what_a_container_keeps_of_files_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    files = {"/proc/meminfo": "MemTotal: 64000000 kB\nMemAvailable: 32000000 kB"}
    monkeypatch.setattr(machine, "_read", lambda path: files.get(path, ""))
    assert machine.free_memory() == 32e6 * 1024
    files |= {f"/sys/fs/cgroup/memory.{name}": text for name, text in {"max": "8000", "current": "7900"}.items()}
    assert machine.free_memory() == 100.0
    files["/sys/fs/cgroup/memory.stat"] = "file 6000\ninactive_file 5000\nactive_file 1000"
    assert machine.free_memory() == 5100.0


STRANGERS = [  # (section, fields in the config.yaml of a stranger's policy, what play says)
    (
        "actor",
        {"hidden_dims": [100000000]},
        "actor.hidden_dims = [100000000] needs 19.6 GB of memory at least, and this machine has 4 GB free",
    ),
    ("env", {"num_envs": 0}, "config.yaml: env.num_envs is 0; it must be 1 or more"),
    ("control", {"stiffness": {"": -1.0}}, "config.yaml: control.stiffness[''] is -1.0; it must be from 0 to 1,000,000"),
    ("observations", {"history": {"state": 1000000000}}, "observations.history of 'dof_pos' = 1000000000 needs "),
    ("sim", {"dt": math.nan}, "config.yaml: sim.dt is nan; it must be finite"),
]


@pytest.mark.parametrize(("section", "fields", "says"), STRANGERS, ids=lambda value: value if isinstance(value, str) else "")
def test_numbers_of_a_stranger(section: str, fields: dict[str, Any], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "free_memory", lambda device="cpu": 4e9)
    folder = tmp_path / "theirs"
    shutil.copytree(ROOT / "resources/policies/go1_flat", folder)
    config = load_yaml(folder / "config.yaml")
    save_yaml(folder / "config.yaml", {**config, section: {**config.get(section, {}), **fields}})
    attack(Case("", program("play", "--load_run", str(folder), "--viewer", "none"), says), tmp_path)
