"""Unitree G1 with 29 joints gets up from any fall and stays standing; randomized worlds.

Sources: [M] mjlab: gains and action scales; [H] HoST, a G1 with 23 joints.
"""

from configs.g1_flat import G1FlatCfg
from legged_mw.skills.getup import Getup, GetupCfg, GetupCfgPPO
from legged_mw.utils.task import Task


class G1GetupCfg(GetupCfg):
    class env(GetupCfg.env):
        num_envs = 4096
        episode_length_s = 10.0  # [s] [H]

    class asset(GetupCfg.asset):
        file, imu_site = G1FlatCfg.asset.file, G1FlatCfg.asset.imu_site

    class falls(GetupCfg.falls):
        seconds = 1.5  # [s] [ours: it falls from higher]
        pull, pull_on = 0.8, "torso_link"  # of its weight [H 0.6], [ours: lifted by the pelvis it hangs head down]

    class init_state(GetupCfg.init_state):
        default_joint_angles = G1FlatCfg.init_state.default_joint_angles

    class control(GetupCfg.control):
        stiffness, damping = G1FlatCfg.control.stiffness, G1FlatCfg.control.damping
        action_origin = "default"  # [ours: its servos alone stand it up in the pull; docs/skills.md]
        # 4 of it: the motors' whole torque [M]
        action_scale, decimation = G1FlatCfg.control.action_scale, G1FlatCfg.control.decimation

    class normalization(GetupCfg.normalization):
        clip_actions = 8.0  # [ours: folded knees are 2.6 rad away]

    class rewards(GetupCfg.rewards):
        pose_weights = {"": 0.3, "hip": 1.0, "knee": 1.0, "waist": 1.0}  # [ours]

        class scales(GetupCfg.rewards.scales):
            action_rate, action_smoothness = -0.002, -0.0004  # [ours: sums over 29 joints; a Go1 has 12]

    class sim(GetupCfg.sim):
        dt = G1FlatCfg.sim.dt

    class exam(GetupCfg.exam):
        within = 6.0  # [s]


class G1GetupCfgPPO(GetupCfgPPO):
    class runner(GetupCfgPPO.runner):
        max_iterations = 4000

    class algorithm(GetupCfgPPO.algorithm):
        gamma = 0.99  # [ours: it takes seconds]
        desired_kl, entropy_coef = 0.02, 0.005  # [ours: of 29 joints together], [M]


TASK = Task(Getup, G1GetupCfg, G1GetupCfgPPO)
