"""Go1 holds its default pose against kicks: a task without commands and feet."""

from configs.robots.go1 import Go1
from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.learner_config import RobotTaskCfgPPO
from legged_mw.utils.task import Task


class Go1StandCfg(Go1):
    class asset(Go1.asset):
        colliders = ["FR", "FL", "RR", "RL"]

    class init_state(Go1.init_state):
        lin_vel_range = ang_vel_range = 0.2  # [m/s], [rad/s]

    class perturbation(Go1.perturbation):
        kick, velocity = True, [0.0, 4.0]  # [m/s]

    class rewards(Go1.rewards):
        class scales(Go1.rewards.scales):
            pose, orientation, termination, torques, action_rate = 1.0, -5.0, -1.0, -2e-4, -0.01


TASK = Task(RobotTask, Go1StandCfg, RobotTaskCfgPPO)
