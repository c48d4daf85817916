"""Sixteen recordings: a task each, changed so that all that may happen happens often, and what its environment then does.

Only public names of the environment are used, so that the recordings run on older and newer checkouts alike.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ENGINES = ("mujoco", "mujoco_warp")
WORLDS, STEPS = 8, 20
NETWORK = "the motors' network"  # a value of control.network: the path of a file that is written for the recording
Change = Callable[[Any], None]  # of a loaded task


class Recording(NamedTuple):
    """A task, what of its config is changed, and what of its class."""

    task: str
    changes: dict[str | tuple[str, ...], Any]  # path -> value; of several paths the first that a checkout has
    own_law: bool = False  # the motors' law is a _compute_torques of its own


# Episodes end, commands change, and robots are kicked and pushed many times within a recording.
OFTEN: dict[str | tuple[str, ...], Any] = {
    "env.episode_length_s": 0.5,
    "rewards.only_positive_rewards": False,  # random actions earn less than 0: the clip would hide most of it
    ("perturbation.kick", "perturbation.enable"): True,
    "perturbation.interval": [0.05, 0.2],
    "perturbation.push": True,
    "perturbation.push_interval_s": 0.3,
    "sim.threads": 1,
}
WALKING: dict[str, Any] = {
    **{
        "commands.resampling_time": 0.2,
        "commands.change_probability": 0.8,
        "commands.keep_probability": [0.5, 0.4, 0.4],
    },
    **{"init_state.ang_vel_range": 3.0, "termination.max_tilt": 35.0, "rewards.soft_dof_pos_limit": 0.5},
}
DRAWN: dict[str, Any] = {
    **{"domain_rand.enable": True, "domain_rand.observe": True, "domain_rand.strength": [0.5, 1.1]},
    **{
        "domain_rand.stiffness": [0.8, 1.2],
        "domain_rand.damping": [0.8, 1.2],
        "domain_rand.encoder_offset": [-0.05, 0.05],
    },
}
CURVE: dict[str, Any] = {
    **{
        "control.stall_torque": {"": 10.0},
        "control.no_load_speed": {"": 20.0, "calf": 15.0},
        "control.gear": {"": 2.0},
    },
    **{"domain_rand.stall_torque": [0.8, 1.2], "domain_rand.no_load_speed": [0.8, 1.2]},
}
TERRAIN: dict[str, Any] = {
    **{"terrain.num_rows": 3, "terrain.num_cols": 8, "terrain.tile_size": 4.0},
    **{"terrain.border_size": 1.0, "terrain.horizontal_scale": 0.1},
    "init_state.pos_xy_range": 2.2,  # some begin beyond half a tile, go up a level, or leave the terrain
}
# Robots that begin in a heap: what must not touch the ground, or itself, does.
HEAP: dict[str, Any] = {
    **{"asset.colliders": ["*"], "asset.self_collisions": True, "asset.penalize_contacts_on": ["*_thigh*", "*_calf*"]},
    **{"asset.terminate_after_contacts_on": ["trunk*"], "sim.nconmax": 48, "sim.njmax": 240},
    **{
        "init_state.dof_pos_range": [0.8, 1.2],
        "init_state.dof_pos_offset": [-0.9, 0.9],
        "init_state.dof_vel_range": 10.0,
    },
    **{"init_state.ang_vel_range": 4.0, "termination.min_base_height": 0.1, "termination.max_tilt": 70.0},
}
# Terms that no task has, or none whose robot does what they count.
TERMS = {
    **{
        "alive": 0.2,
        "base_height": -2.0,
        "angular_momentum": -0.1,
        "hip_pos": -0.1,
        "joint_deviation": -0.1,
        "joint_mirror": -0.1,
    },
    **{"dof_vel": -1e-3, "dof_acc": -2.5e-7, "dof_vel_limits": -0.1, "fast_joints": -0.01, "torque_limits": -0.05},
    **{
        "action_smoothness": -0.01,
        "collision": -0.5,
        "self_collision": -0.5,
        "feet_distance": -1.0,
        "feet_orientation": -0.5,
    },
    **{
        "air_time_variance": -1.0,
        "feet_contact_without_cmd": -0.2,
        "feet_impact_vel": -0.1,
        "feet_contact_forces": -0.01,
    },
    **{"soft_landing": -1e-3, "feet_phase": 1.0, "contact_phase": 0.5},
}
ALL_TERMS: dict[str, Any] = {
    **{f"rewards.scales.{name}": scale for name, scale in TERMS.items()},
    **{"rewards.base_height_target": 0.28, "rewards.hip_joints": ["*_hip*"], "rewards.max_contact_force": 20.0},
    **{
        "rewards.mirror_joints": [["FR_", "RL_"], ["FL_", "RR_"]],
        "rewards.min_air_time": 0.05,
        "rewards.tracking_sigma_end": 0.1,
    },
    **{"gait.period": 0.5, "gait.offsets": [0.0, 0.5, 0.5, 0.0], "rewards.min_command": 0.3},
}
TWO_FEET = {"rewards.scales.single_stance": 0.5, "rewards.scales.no_fly": 0.5, "rewards.min_feet_distance": 0.3}

RECORDINGS: dict[str, Recording] = {
    "go1_flat": Recording(  # all terms; rows that may be asked for; kicks that grow
        "go1_flat",
        WALKING
        | HEAP
        | ALL_TERMS
        | {"observations.foot_height": True, "observations.contact_forces": True, "perturbation.growth": [0.0, 0.4]},
    ),
    "go1_flat_dr": Recording(  # delays in control steps; commands that grow; the clip of the reward
        "go1_flat_dr",
        WALKING
        | DRAWN
        | {
            "domain_rand.observation_delay": [0, 2],
            "domain_rand.action_delay": [0, 2],
            "domain_rand.contact_time": [0.01, 0.03],
        }
        | {
            "commands.curriculum": True,
            "rewards.only_positive_rewards": True,
            "rewards.scales.alive": 1.0,
            "asset.effort": {"calf": 12.0},
        },
    ),
    # ground by what a robot can do, felt
    "go1_rough": Recording("go1_rough", WALKING | TERRAIN | {"rewards.scales.stumble": -0.5}),
    "go2_rough_scan": Recording(  # ground by chance, seen
        "go2_rough_scan", WALKING | TERRAIN | {"terrain.curriculum": False, "init_state.pos_xy_range": 0.5}
    ),
    "go2_flat": Recording(  # history, old by a delay
        "go2_flat",
        WALKING
        | {"observations.history": {"state": 3, "privileged_state.torques": 2}, "domain_rand.observation_delay": [1, 3]}
        | {"domain_rand.action_delay": [0, 1], "commands.heading_command": True},
    ),
    "go1_legged_gym": Recording("examples/go1_legged_gym.py", WALKING | {"init_state.yaw_range": 1.0}),
    "go1_getup": Recording("go1_getup", {"env.episode_length_s": 0.3}),  # from the measured joints, on slopes
    "g1_getup": Recording("g1_getup", {"env.episode_length_s": 0.3}),  # pulled; 29 joints that all collide
    "go2_footstand": Recording("go2_footstand", {"control.action_origin": "targets", "control.action_scale": 0.3}),
    "g1_track": Recording(
        "g1_track", {"observations.leave_out": {}, "domain_rand.observe": True, "motion.hold_s": 0.1}
    ),
    "g1_flat": Recording(
        "g1_flat", WALKING | {"domain_rand.delay_ms": [0.0, 30.0]} | TWO_FEET
    ),  # 29 joints; a gait clock; delays in milliseconds
    "g1_12dof_flat": Recording(  # a clock that begins at 0; a plane that leans
        "g1_12dof_flat",
        WALKING | {"gait.random_start": False, "terrain.slope": 6.0, "observations.history": {"state": 2}},
    ),
    "dc_motor": Recording(
        "go1_flat_dr", WALKING | DRAWN | CURVE | {"control.actuator": "dc_motor", "domain_rand.delay_ms": [3.0, 25.0]}
    ),
    "torque": Recording(
        "go2_flat",
        WALKING
        | CURVE
        | {"rewards.scales.target_limits": 0.0}
        | {"control.actuator": "torque", "control.action_scale": {"": 8.0, "calf": 25.0}, "asset.effort": {"": 12.0}}
        | {"domain_rand.slope": [-10.0, 10.0], "domain_rand.action_delay": [0, 1]},
    ),
    "network": Recording(
        "go1_flat_dr",
        WALKING
        | DRAWN
        | {"control.actuator": "network", "control.network": NETWORK, "domain_rand.delay_ms": [0.0, 8.0]}
        | {"control.action_origin": "joints"},
    ),
    "own_law": Recording("go1_flat_dr", WALKING | DRAWN | {"domain_rand.delay_ms": [0.0, 12.0]}, own_law=True),
}


def make_env(name: str, engine: str, folder: Path, change: Change | None = None, worlds: int = WORLDS) -> Any:
    """The environment of a recording, on a CPU. ``folder`` takes the files that it needs; ``change`` is done to the task at last."""
    import torch

    from legged_mw import ROOT
    from legged_mw.utils.config import ConfigError
    from legged_mw.utils.task import load_task

    recording = RECORDINGS[name]
    loaded = load_task(str(ROOT / recording.task) if recording.task.endswith(".py") else recording.task)
    for paths, value in {**OFTEN, **recording.changes, "sim.engine": engine, "env.num_envs": worlds}.items():
        paths = (paths,) if isinstance(paths, str) else paths
        for path in paths:
            try:
                loaded.set(path, _write_network(folder) if value == NETWORK else value)
                break
            except ConfigError:
                if path == paths[-1]:
                    raise
    if recording.own_law:
        loaded.env_class = _with_own_law(loaded.env_class)
    if change:
        change(loaded)
    torch.manual_seed(1)
    return loaded.env_class(loaded.cfg, "cpu")


def _with_own_law(env_class: Any) -> Any:
    """Motors that are springs with the gains of the config, a dead zone and an end."""

    class OwnLaw(env_class):
        def _compute_torques(self, actions: Any) -> Any:
            torques = super()._compute_torques(actions) - 0.1 * self.dof_vel * self.dof_vel.abs()
            return (torques.abs() - 0.5).clamp(0.0, 20.0) * torques.sign()

    return OwnLaw


def _write_network(folder: Path) -> str:
    """A memory and two layers of numbers: errors and speeds of two frames to a torque.

    A sum has at most two products, all with powers of two: they are exact, and no CPU's order of a sum changes a torque.
    """
    drawn, units = np.random.default_rng(3), 4
    sparse = {"weight_ih_l0": (4 * units, 4), "weight_hh_l0": (4 * units, units), "weight0": (6, units)}
    arrays: dict[str, Any] = {name: np.zeros(shape, np.float32) for name, shape in sparse.items()}
    for values in arrays.values():
        rows = np.arange(len(values))
        values[rows, drawn.permutation(rows) % values.shape[1]] = drawn.choice([-0.5, 0.25, 0.5, 1.0], len(values))
    arrays["weight1"] = np.array([[0.0, 0.5, 0.0, 0.0, -1.0, 0.0]], np.float32)
    biases = {"bias_ih_l0": 4 * units, "bias_hh_l0": 4 * units, "bias0": 6}
    arrays |= {name: drawn.normal(0.0, 0.6, size).astype(np.float32) for name, size in biases.items()}
    arrays["bias1"] = np.zeros(1, np.float32)
    scales = {"error_scale": 1.5, "speed_scale": -0.1, "torque_scale": 20.0}
    np.savez(folder / "network.npz", **arrays, activation="softsign", frames=np.array([0, 2]), in_turns=False, **scales)
    return str(folder / "network.npz")


def rollout(
    name: str, engine: str, change: Change | None = None, worlds: int = WORLDS, steps: int = STEPS
) -> dict[str, np.ndarray]:
    """Seeded random actions: ``obs/<group>`` (steps + 2, N, C): as built, after a reset, after each step; and all else by name.

    ``steps/<quantity>`` says of which step each value is, ``columns/<quantity>`` names its last axis, where the environment does.
    """
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the order of a sum depends on it
    with tempfile.TemporaryDirectory() as folder:
        env = make_env(name, engine, Path(folder), change, worlds)
    own = torch.Generator().manual_seed(2)
    observed, stepped = [env.get_observations(), env.reset()], []
    env.episode_length_buf = torch.randint(0, int(env.max_episode_length), (worlds,), generator=own)
    for step in range(steps):
        if step == steps // 2:
            (env.on_training_progress if hasattr(env, "on_training_progress") else env.anneal)(0.3)  # its name before
        obs, reward, done, extras = env.step(torch.randn(worlds, env.num_actions, generator=own))
        observed.append(obs)
        stepped.append((reward, done, extras["time_outs"], env.episode_length_buf.clone()))
    taken = {
        f"obs/{group}": torch.stack([obs[group] for obs in observed]).numpy() for group in list(observed[0].keys())
    }
    taken |= {f"steps/{quantity}": np.arange(-2, steps) for quantity in taken}
    for quantity, values in zip(
        ("reward", "done", "time_out", "episode_length"), zip(*stepped, strict=True), strict=True
    ):
        taken[quantity], taken[f"steps/{quantity}"] = torch.stack(values).numpy(), np.arange(steps)
    said = env.name_statistics(env.take_statistics().tolist())
    taken |= {"statistics": np.array(list(said.values()), dtype=np.float32), "columns/statistics": np.array(list(said))}
    taken |= {
        f"training_state/{quantity}": torch.as_tensor(value).numpy() for quantity, value in env.training_state().items()
    }
    torch.set_num_threads(threads)
    return taken | _columns(env)


def _columns(env: Any) -> dict[str, np.ndarray]:
    """``columns/obs/<group>``: the row that each column is of, where the environment says so."""
    groups = getattr(getattr(env, "observations", None), "groups", {})
    table = {group: [(row.name, row.size) for row in rows] for group, rows in groups.items()}
    return {
        f"columns/obs/{group}": np.array([f"{name}[{i}]" for name, size in rows for i in range(size)])
        for group, rows in table.items()
    }


KEPT_STEPS = {"state": [0, 2, 9, 21], "privileged_state": [1, 20]}  # as built, after a reset, after each step


def first_steps(name: str, engine: str, change: Change | None = None) -> dict[str, np.ndarray]:
    """What ``tests/test_net.py`` compares, small enough to keep: of observations a few steps, and a sum over worlds.

    A difference lasts, and worlds weigh differently.
    """
    taken = rollout(name, engine, change)
    kept = {
        quantity: value
        for quantity, value in taken.items()
        if not quantity.startswith(("training_state/", "episode_length"))
    }
    kept["ended"] = kept.pop("done").astype(np.uint8) + kept.pop("time_out")  # 1: failed, 2: timed out
    weights = np.cos(np.arange(1.0, WORLDS + 1.0))
    for group, steps in KEPT_STEPS.items():
        if (name := f"obs/{group}") in kept:
            kept[name] = np.einsum("tnc,n->tc", kept[name][steps].astype(np.float64), weights).astype(np.float32)
            kept[f"steps/{name}"] = kept[f"steps/{name}"][steps]
    return kept
