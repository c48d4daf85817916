"""Unitree Go1 trots by command over slopes, stairs and blocks, without height scan; random worlds, kicks, pushes.

Sources: [P] MuJoCo Playground's rough task for Go1; [L] legged_gym's terrain and curriculum; [ours] docs/terrain.md.
"""

from configs.base import TrotRoughCfg
from configs.go1_flat import Go1FlatCfgPPO
from configs.go1_flat_dr import Go1FlatDrCfg
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Go1RoughCfg(Go1FlatDrCfg):
    class gait(TrotRoughCfg.gait):
        period = 0.45  # [s] [ours]

    class terrain(TrotRoughCfg.terrain):
        pass

    class termination(TrotRoughCfg.termination):
        pass

    class sim(Go1FlatDrCfg.sim):
        njmax = 56  # 12 friction, 12 limits, 4 per contact, two contacts per foot

    class rewards(Go1FlatDrCfg.rewards):
        tracking_sigma, tracking_sigma_end = 0.25, 0.1  # [P], [ours]
        pose_weights = {"hip": 1.0, "thigh": 0.5, "calf": 0.1}  # [P 1, 1, 0.1] [ours: a high step lifts the thigh]
        swing_height = 0.16  # [m] [ours: P 0.1]

        class scales(Go1FlatDrCfg.rewards.scales):
            orientation = -1.0  # [P -5] [ours: on a slope the trunk tilts with the ground]
            lin_vel_z = -0.2  # [P -0.5] [ours: stairs go up]
            feet_clearance = -1.0  # [P -2.0] [ours]
            contact_phase = 0.3  # [ours: for the clock's pace]
            feet_impact_vel = -0.15  # [ours]
            target_limits = -1.0  # [ours]
            stand_still = -1.5  # [P -1] [ours]

    class domain_rand(Go1FlatDrCfg.domain_rand):
        friction = [0.3, 1.25]  # [-] [ours]

    class perturbation(Go1FlatDrCfg.perturbation):
        curriculum = True  # [ours: kicks are weak at first, because the ground is difficult]


class Go1RoughCfgPPO(Go1FlatCfgPPO):
    class runner(Go1FlatCfgPPO.runner):
        num_steps_per_env = 24  # [P, L]
        max_iterations = 3100  # 609 M steps [L 1500 of 98 k]
        matmul_precision = "bf16"  # [ours: faster]

    class algorithm(Go1FlatCfgPPO.algorithm):
        gamma = 0.99  # [L, P]


TASK = Task(LeggedRobot, Go1RoughCfg, Go1RoughCfgPPO)
