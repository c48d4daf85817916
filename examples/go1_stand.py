"""Go1 holds its default pose against kicks: a task without commands, and without feet."""

from configs.go1_flat import Go1FlatCfg
from legged_mw.envs.robot_task import RobotTask
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.rl.learner_config import RobotTaskCfgPPO
from legged_mw.utils.task import Task


class Go1StandCfg(RobotTaskCfg):
    class asset(RobotTaskCfg.asset):
        file = Go1FlatCfg.asset.file
        colliders = ["FR", "FL", "RR", "RL"]

    class init_state(RobotTaskCfg.init_state):
        pos, default_joint_angles = Go1FlatCfg.init_state.pos, Go1FlatCfg.init_state.default_joint_angles
        lin_vel_range = ang_vel_range = 0.2  # [m/s], [rad/s]

    class control(RobotTaskCfg.control):
        stiffness, damping = Go1FlatCfg.control.stiffness, Go1FlatCfg.control.damping

    class perturbation(RobotTaskCfg.perturbation):
        kick, velocity = True, [0.0, 4.0]  # [m/s]

    class rewards(RobotTaskCfg.rewards):
        class scales(RobotTaskCfg.rewards.scales):
            pose, orientation, termination, torques, action_rate = 1.0, -5.0, -1.0, -2e-4, -0.01


TASK = Task(RobotTask, Go1StandCfg, RobotTaskCfgPPO)
