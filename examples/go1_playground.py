"""MuJoCo Playground's Go1JoystickFlatTerrain to the letter: go1_flat without what this project changed, and Playground's rsl-rl settings.

[P] is MuJoCo Playground: locomotion/go1/joystick.py at 43d180a. Tables both ways: docs/coming_from.md.
Run it with: python train.py --task examples/go1_playground.py
"""

from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Go1PlaygroundCfg(Go1FlatCfg):
    class env(Go1FlatCfg.env):
        num_envs = 4096

    class rewards(Go1FlatCfg.rewards):
        tracking_sigma = 0.25
        clip_termination = True  # a fall is inside the clip at 0

        class scales(Go1FlatCfg.rewards.scales):
            tracking_lin_vel = 1.0
            tracking_ang_vel = 0.5

    class normalization(Go1FlatCfg.normalization):
        clip_actions = 100.0  # [P] has no bound

    class perturbation(Go1FlatCfg.perturbation):
        kick = False  # pert_config.enable
        velocity = [0.0, 3.0]  # [m/s]


class Go1PlaygroundCfgPPO(Go1FlatCfgPPO):
    class runner(Go1FlatCfgPPO.runner):
        num_steps_per_env = 24
        max_iterations = 1000

    class actor(Go1FlatCfgPPO.actor):
        class distribution_cfg(Go1FlatCfgPPO.actor.distribution_cfg):
            init_std = 1.0

    class algorithm(Go1FlatCfgPPO.algorithm):
        gamma = 0.99
        entropy_coef = 0.001
        learning_rate = 3e-4
        schedule = "fixed"

    class anneal(Go1FlatCfgPPO.anneal):
        entropy_coef = 0.0  # it stays
        desired_kl = 0.0

    class symmetry(Go1FlatCfgPPO.symmetry):
        use_data_augmentation = False


TASK = Task(LeggedRobot, Go1PlaygroundCfg, Go1PlaygroundCfgPPO)
