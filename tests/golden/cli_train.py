"""The command lines of train.py and play.py: tasks, flags, overrides, runs to load."""

from __future__ import annotations

from pathlib import Path

import torch
from attack import program as started

from golden.table import Run, Table, given_run, without

BOTH = [
    ["--task", ""],
    *(["--task", name] for name in ("go1_falt", "dog.urdf", "dog/dog.py", "empty.py", "wrong.py", "bare.py")),
    *(
        line.split()
        for line in (
            "--num_env 4",
            "--num_envs 0",
            "--num_envs many",
            "--seed x",
            "--checkpoint last",
            "--engine physx",
        )
    ),
    *(["--device", name] for name in ("gpu", "cuda:99")),
    *(["--override", f"{name}.yaml"] for name in ("none", "field", "section", "value", "flat")),
    *(
        ["--set", item]
        for item in (
            *(
                "env.num_envs",
                "env.num_env=4",
                "env.num_envs=many",
                "reward.scales.pose=1",
                "env=4",
                "env.num_envs.x=4",
                "=3",
            ),
            *("terrain.mesh_type=plain", "perturbation.enable=true", "control.stiffness=35", "control.stiffness.hip=3"),
        )
    ),
]
FILES = {
    "field": "env: {num_env: 4}",
    "section": "envs: {num_envs: 4}",
    "value": "runner: {max_iterations: soon}",
    "flat": "env: 4",
}
TASKS = {
    "empty": "TASKS = 1\n",
    "wrong": "from configs.go1_flat import Go1FlatCfg\n\nclass C(Go1FlatCfg):\n    class asset(Go1FlatCfg.asset):\n        fiel = 'x'\n",
    "bare": "def f(:\n",
}
SMALL = [*("--num_envs", "16", "--set", "actor.hidden_dims=[16, 16]", "--set", "critic.hidden_dims=[16, 16]")]
CHECKED = [  # what shows only when robot, environment or learner is built
    *("asset.file=dog.xml", "asset.file=", "asset.file=/far/dog.xml"),
    *("asset.foot_names=[FR, FL, RR, RLL]", "asset.foot_names=[FR, FL, RR]", "asset.foot_names=[F*]"),
    *(
        "control.stiffness={hip: 30}",
        "init_state.default_joint_angles={joint: 0, wheel: 1}",
        "rewards.scales.torqes=-1",
    ),
    *("algorithm.optimizer=adom", "obs_groups.actor=[stat]", "actor.class_name=os:system", "asset.imu_site=nose"),
    *("commands.keep_probability=[1]", "commands.units={hight: m}", "commands.default={lin_vel_z: 1}"),
    *("commands.default={lin_vel_x: 9}", "observations.leave_out={nosuch: [a]}", "observations.leave_out={state: [a]}"),
    *("observations.history={nosuch: 2}", "observations.history={state.nosuch: 2}"),
    *("asset.penalize_contacts_on=[nose]", "asset.colliders=[]", "asset.sense=[nosuch]"),
    *("symmetry.use_mirror_loss=true", "actor.concurrent.groups=[privileged]", "actor.concurrent.groups=[state]"),
    *(
        "actor.estimator.targets=[nosuch]",
        "actor.estimator.targets=[state]",
        "actor.estimator.targets=[commands]",
        "actor.estimator.targets=[foot_height]",
        "actor.estimator.targets=[base_lin_vel, base_lin_vel]",
        "asset.foot_geoms={FX: [FR]}",
    ),
    *("asset.foot_geoms={FR: []}", "domain_rand.redraw_at_reset=[nosuch]", "domain_rand.redraw_at_reset=[armature]"),
    *("falls.pull_on=nose", "sim.integrator=rk4", "asset.held_joints={neck: 0}", "distillation.teacher=x"),
    *("warm_start.policy=x", "rewards.scales.torques=.nan", "perturbation.body=nose", "control.actuator=network"),
]
TWO = [
    ["actor.class_name=RNNModel", "algorithm.num_mini_batches=64"],
    [
        "actor.class_name=RNNModel",
        "critic.class_name=RNNModel",
        "symmetry.use_data_augmentation=false",
        "symmetry.use_mirror_loss=true",
    ],
    ["actor.estimator.targets=[base_lin_vel]", "actor.class_name=RNNModel"],
    ["actor.concurrent.groups=[privileged_state]", "actor.class_name=RNNModel"],
    ["actor.concurrent.groups=[privileged_state]", "algorithm.class_name=PPO"],
    ["actor.estimator.targets=[base_lin_vel]", "actor.class_name=CNNModel"],
    ["actor.estimator.targets=[base_lin_vel]", "algorithm.optimizer=sgd"],
    ["actor.estimator.targets=[base_lin_vel]", "actor.concurrent.groups=[privileged_state]"],
    ["control.actuator=network", "control.network=none.npz"],
    ["control.actuator=dc_motor", "control.stall_torque={}"],
    ["control.actuator=torque", "control.action_origin=joints"],
    ["control.actuator=torque", "control.action_origin=speed"],
    ["commands.curriculum=true", "rewards.scales.tracking_lin_vel=0"],
    ["domain_rand.enable=true", "domain_rand.base_mass=[-9, 0]"],
    ["domain_rand.enable=true", "domain_rand.stall_torque=[0.9, 1.1]"],
    ["domain_rand.enable=true", "domain_rand.friction=[0.5, 1]", "domain_rand.model_factors={geom_friction: [0.5, 1]}"],
    ["domain_rand.enable=true", "domain_rand.model_factors={geom_sise: [0.5, 1]}"],
    ["symmetry.use_mirror_loss=true", "symmetry.mirror_loss_coeff=0"],
    ["algorithm.schedule=fixed", "algorithm.max_learning_rate=0.1"],
    ["algorithm.class_name=PPO", "algorithm.max_learning_rate=0.1"],
    ["algorithm.max_learning_rate=0.0001", "algorithm.learning_rate=0.001"],
    ["actor.distribution_cfg.class_name=BetaDistribution"],
    ["terrain.mesh_type=heightfield", "terrain.terrain_proportions={lava: 1}"],
    ["terrain.mesh_type=heightfield", "terrain.terrain_proportions={flat: 0}"],
    ["terrain.mesh_type=heightfield", "terrain.border_size=0.5"],
    ["terrain.mesh_type=heightfield", "terrain.horizontal_scale=0.3"],
    ["terrain.mesh_type=heightfield", "terrain.num_cols=1"],
    ["runner.num_steps_per_env=1", "algorithm.num_mini_batches=64"],
    ["warm_start.policy=go1_rough", "algorithm.class_name=PPO", "warm_start.critic_warmup=20"],
    ["cpu.overrides={commands.keep_probabilty: [1.0]}"],
    ["cpu.overrides={comands.resampling_time: 3}"],
    ["cpu.overrides={commands.resampling_time: [3.0]}"],
]
TRAIN = [
    *(f"--max_time={text}".split("|") for text in ("soon", "0", "-5", "1h30", "nan", "")),
    ["--picture", "a.png"],
    *(
        line.split()
        for line in ("--load_run x", "--checkpoint 1", "--resume --init x", "--resume --teacher x", "--resume")
    ),
    *(
        line.split()
        for line in (
            "--max_iterations 0",
            "--check --picture a.gif",
            "--experiment_name ../a",
            "--run_name a/b --check",
        )
    ),
    *(line.split() for line in ("--teacher nosuch", "--init nosuch", "--init go2_flat", "--load_run nosuch --resume")),
    *(line.split() for line in ("--resume --checkpoint 7 --load_run run", "--resume --load_run run")),
    *(
        line.split()
        for line in ("--check --teacher go2_flat", "--check --init go1_rough", "--check --teacher go1_handstand")
    ),
]
PLAY = [
    *([f"--command={text}"] for text in ("", "fast", "nan,0,0", "1,0,0,0", "ang_vel_jaw=1", "9,0,0")),
    *(
        line.split()
        for line in ("--time soon", "--commands none.yaml", "--commands a.yaml --command=0,0,0", "--viewer wbe")
    ),
    *(
        line.split()
        for line in ("--viewer web --video a.mp4", "--video a.avi", "--sheet a.jpg", "--port 99999", "--viewer window")
    ),
    *(
        line.split()
        for line in (
            "--eval --export out",
            "--compare x",
            "--ranges common",
            "--no_hard",
            "--follow --eval",
            "--export out --set env.num_envs=3",
        )
    ),
    *(
        line.split()
        for line in (
            "--viewer none --sheet a.png",
            "--half",
            "--eval --viewer web",
            "--export",
            "--load_run nosuch",
            "--load_run shipped",
        )
    ),
    *(line.split() for line in ("--experiment_name elsewhere --load_run -1", "--load_run run --checkpoint 7")),
    ["--video", ""],
    ["--load_run", "run", "--set", "actor.hidden_dims=[8, 16]"],
    ["--load_run", "run", "--set", "actor.class_name=RNNModel"],
    ["--task", "go2_flat", "--load_run", "run"],
    ["--task", "g1_track", "--load_run", "run"],
    ["--eval", "--load_run", "run", "--set", "env.num_envs=3"],
    ["--eval", "--load_run", "run", "--compare", "nosuch"],
]


def fill(root: Path) -> None:
    for name, text in FILES.items():
        (root / f"{name}.yaml").write_text(text)
    for name, text in TASKS.items():
        (root / f"{name}.py").write_text(text)


def with_run(change: Run = lambda run: None) -> Run:
    def given(root: Path) -> None:
        change(given_run(root))

    return given


def edited(old: str, new: str) -> Run:
    def change(run: Path) -> None:
        text = (run / "config.yaml").read_text()
        assert old in text
        (run / "config.yaml").write_text(text.replace(old, new))

    return with_run(change)


def sets(items: list[str]) -> list[str]:
    return [word for item in items for word in ("--set", item)]


def actor_alone(run: Path) -> None:
    content = torch.load(run / "model_2.pt", weights_only=True)
    torch.save({"actor_state_dict": content["actor_state_dict"], "infos": {}}, run / "model_2.pt")


def table() -> Table:
    made = Table(fill)
    for program in ("train", "play"):
        made.programs(program, BOTH)
    for items in [*([item] for item in CHECKED), *TWO]:
        made.programs("train", [["--check", *SMALL, *sets(items)]], name=f"check {' '.join(items)}")
    made.add(
        "check runner.logger=wandb",
        without("wandb", started("train", "--check", *SMALL, "--set", "runner.logger=wandb")),
    )
    made.programs("train", TRAIN, with_run())
    made.programs("play", PLAY, with_run())
    more = ["--resume", "--load_run", "run", "--max_iterations", "3"]
    for item in ("actor.hidden_dims=[8, 16]", "critic.hidden_dims=[16]"):
        made.programs("train", [[*more, *sets([item])]], with_run(), name=f"resume {item}")
    for name, change in {
        "an actor alone": with_run(actor_alone),
        "no config": with_run(lambda run: (run / "config.yaml").unlink()),
        "another task": edited("task: go1_flat", "task: go2_flat"),
        "a task elsewhere": edited("task: go1_flat", "task: /far/away/dog.py"),
        "no checkpoint": with_run(lambda run: (run / "model_2.pt").unlink()),
        "a checkpoint cut": with_run(
            lambda run: (run / "model_2.pt").write_bytes((run / "model_2.pt").read_bytes()[:-100])
        ),
        "a checkpoint of text": with_run(lambda run: (run / "model_2.pt").write_bytes(b"no")),
        "a checkpoint of others": with_run(lambda run: torch.save({"weights": 3}, run / "model_2.pt")),
        "a checkpoint without weights": with_run(lambda run: torch.save({"actor_state_dict": {}}, run / "model_2.pt")),
    }.items():
        made.programs("train", [more], change, name=f"resume {name}")
        if name not in ("an actor alone", "another task"):
            made.programs("play", [["--load_run", "logs/go1_flat/run", "--task", ""]], change, name=f"play {name}")
    return made
