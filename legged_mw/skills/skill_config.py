"""Config shared by getting up and standing on two legs: worlds, observations and the learner.

Source [P]: MuJoCo Playground's Go1 getup, handstand and footstand (commit d5e6b47); [ours] with the reason.
"""

from __future__ import annotations

from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.rl.learner_config import RobotTaskCfgPPO


class SkillCfg(RobotTaskCfg):
    class env(RobotTaskCfg.env):
        num_envs = 8192

    class observations(RobotTaskCfg.observations):
        leave_out = {"state": ["base_lin_vel"]}  # [P getup; ours: no sensor of the robot gives it]

    class domain_rand(RobotTaskCfg.domain_rand):
        enable, observe = True, True  # [ours, P none]
        encoder_offset = [-0.015, 0.015]  # [rad]

    class sim(RobotTaskCfg.sim):
        iterations, ls_iterations = 3, 10  # [ours: a lying robot has many contacts]


class SkillCfgPPO(RobotTaskCfgPPO):
    class runner(RobotTaskCfgPPO.runner):
        num_steps_per_env, max_iterations = 20, 900  # [P], [ours: 170 s of a handstand, 200 s of getting up on an H200]

    class actor(RobotTaskCfgPPO.actor):
        hidden_dims = [256, 128, 64]  # [ours]

    class algorithm(RobotTaskCfgPPO.algorithm):
        num_mini_batches, entropy_coef = 8, 0.01  # [ours], [P]

    class anneal(RobotTaskCfgPPO.anneal):
        entropy_coef, desired_kl = 0.001, 0.003  # [ours]

    class symmetry(RobotTaskCfgPPO.symmetry):
        use_data_augmentation = True  # [ours]
