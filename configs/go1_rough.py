"""Unitree Go1 follows a joystick over slopes, stairs and blocks, without height scan; random worlds, kicks, pushes.

Sources: [P] MuJoCo Playground's rough task for Go1; [L] legged_gym's terrain and curriculum; [ours] docs/terrain.md.
"""

from configs.base import SimToRealRoughCfg
from configs.go1_flat import Go1FlatCfgPPO
from configs.go1_flat_dr import Go1FlatDrCfg
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Go1RoughCfg(Go1FlatDrCfg):
    class terrain(SimToRealRoughCfg.terrain):
        pass

    class termination(SimToRealRoughCfg.termination):
        pass

    class sim(Go1FlatDrCfg.sim):
        njmax = 56  # 12 friction, 12 limits, 4 per contact, two contacts per foot

    class rewards(Go1FlatDrCfg.rewards):
        tracking_sigma = 0.25  # [P]
        pose_weights = {"hip": 1.0, "thigh": 0.5, "calf": 0.1}  # [P 1, 1, 0.1] [ours: a high step lifts the thigh]
        swing_height = 0.15  # [m] [ours: over a step of 12 cm; P 0.1]

        class scales(Go1FlatDrCfg.rewards.scales):
            orientation = -1.0  # [P -5] [ours: on a slope the trunk tilts with the ground]
            lin_vel_z = -0.2  # [P -0.5] [ours: stairs go up]
            feet_clearance = -1.0  # [P -2.0] [ours]

    class perturbation(Go1FlatDrCfg.perturbation):
        curriculum = True  # [ours: kicks are weak at first, because the ground is difficult]


class Go1RoughCfgPPO(Go1FlatCfgPPO):
    class runner(Go1FlatCfgPPO.runner):
        num_steps_per_env = 24  # [P, L]
        max_iterations = 2000  # 393 M steps [L 1500 of 98 k]

    class algorithm(Go1FlatCfgPPO.algorithm):
        gamma = 0.99  # [L, P]


TASK = Task(LeggedRobot, Go1RoughCfg, Go1RoughCfgPPO)
