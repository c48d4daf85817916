"""An invented biped with three joints per leg and feet of two boxes, as an example. It observes no joint angles."""

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.rl.learner_config import LeggedRobotCfgPPO
from legged_mw.utils.task import Task


class ToyBipedCfg(LeggedRobotCfg):
    class asset(LeggedRobotCfg.asset):
        file = "toy_biped.xml"
        foot_names = ["left", "right"]
        foot_geoms = {"left": ["left_heel", "left_toe"], "right": ["right_heel", "right_toe"]}
        colliders = ["*_heel", "*_toe"]

    class init_state(LeggedRobotCfg.init_state):
        pos = [0.0, 0.0, 0.59]  # [m]
        default_joint_angles = {"hip": -0.3, "knee": 0.6, "ankle": -0.3}  # [rad]

    class control(LeggedRobotCfg.control):
        stiffness = {"": 80.0, "ankle": 40.0}  # [N m/rad]
        damping = {"": 2.0}  # [N m s/rad]
        action_scale = {"": 0.4, "ankle": 0.25}  # [rad]

    class observations(LeggedRobotCfg.observations):
        leave_out = {"state": ["dof_pos"]}

    class commands(LeggedRobotCfg.commands):
        class ranges(LeggedRobotCfg.commands.ranges):
            lin_vel_x = [-0.4, 0.8]  # [m/s]
            lin_vel_y = [0.0, 0.0]  # no joint moves a foot sideways
            ang_vel_yaw = [-0.3, 0.3]  # [rad/s]

    class sim(LeggedRobotCfg.sim):
        nconmax = 16  # four boxes with four corners each
        njmax = 90


TASK = Task(LeggedRobot, ToyBipedCfg, LeggedRobotCfgPPO)
