"""A task for each robot of this folder: what a user has to say of a vendor's file, and no more."""

from __future__ import annotations

from pathlib import Path

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.rl.learner_config import LeggedRobotCfgPPO
from legged_mw.utils.task import LoadedTask, Task

HERE = Path(__file__).parent
ROOM = {"nconmax": 32, "njmax": 160}  # for feet of four spheres or of boxes


class Go2StyleCfg(LeggedRobotCfg):
    """Pose and place come from the file's keyframe, force limits from its motors."""

    class asset(LeggedRobotCfg.asset):
        file = str(HERE / "go2_style.xml")
        foot_names = ["FR", "FL", "RR", "RL"]
        colliders = ["*_calf", "base_link"]
        terminate_after_contacts_on = ["base_link"]

    class control(LeggedRobotCfg.control):
        stiffness = {"": 20.0}
        damping = {"": 0.5}

    class sim(LeggedRobotCfg.sim):
        nconmax, njmax = ROOM["nconmax"], ROOM["njmax"]


class G1StyleCfg(LeggedRobotCfg):
    """Feet are bodies with four spheres each; there is no keyframe, so the height is that of the feet in this pose."""

    class asset(LeggedRobotCfg.asset):
        file = str(HERE / "g1_29dof_style.xml")
        foot_names = ["left_ankle_roll_link", "right_ankle_roll_link"]
        imu_site = "imu_in_pelvis"
        colliders = ["*_ankle_roll_link"]

    class init_state(LeggedRobotCfg.init_state):
        default_joint_angles = {"": 0.0, "hip_pitch": -0.1, "knee": 0.3, "ankle_pitch": -0.2, "elbow": 1.2}

    class control(LeggedRobotCfg.control):
        stiffness = {"": 40.0, "hip": 100.0, "knee": 150.0, "waist": 100.0}
        damping = {"": 2.0, "wrist": 1.0}
        action_scale = {"": 0.25}

    class sim(LeggedRobotCfg.sim):
        nconmax, njmax = ROOM["nconmax"], ROOM["njmax"]


class G1HeldStyleCfg(G1StyleCfg):
    """The same file under a policy of twelve joints."""

    class asset(G1StyleCfg.asset):
        held_joints = ["waist_*", "*_shoulder_*", "*_elbow_*", "*_wrist_*"]
        imu_site = "imu_in_torso"


class G1LegsStyleCfg(G1StyleCfg):
    """The IMU's site is turned, and on a body that is fixed to the root."""

    class asset(G1StyleCfg.asset):
        file = str(HERE / "g1_12dof_style.xml")
        imu_site = ""
        terminate_after_contacts_on = ["torso_link", "*_arm_link"]
        colliders = ["*_ankle_roll_link", "torso_link", "*_arm_link"]

    class init_state(G1StyleCfg.init_state):
        default_joint_angles = {"": 0.0, "hip_pitch": -0.1, "knee": 0.3, "ankle_pitch": -0.2}

    class control(G1StyleCfg.control):
        stiffness = {"": 40.0, "hip": 100.0, "knee": 150.0}
        damping = {"": 2.0}


class T1StyleCfg(LeggedRobotCfg):
    """Feet are boxes; the pose is the file's."""

    class asset(LeggedRobotCfg.asset):
        file = str(HERE / "t1_style.xml")
        foot_names = ["left_foot_link", "right_foot_link"]
        colliders = ["*_foot_link"]

    class control(LeggedRobotCfg.control):
        stiffness = {"": 100.0, "Ankle": 50.0}
        damping = {"": 3.0, "Ankle": 1.0}

    class sim(LeggedRobotCfg.sim):
        nconmax, njmax = ROOM["nconmax"], ROOM["njmax"]


class AnymalStyleCfg(LeggedRobotCfg):
    """Names as in legged_gym: feet are fixed links of the URDF, the base is fused with what is fixed to it."""

    class asset(LeggedRobotCfg.asset):
        file = str(HERE / "anymal_c_style.urdf")
        foot_names = ["LF_FOOT", "LH_FOOT", "RF_FOOT", "RH_FOOT"]
        penalize_contacts_on = ["*_SHANK", "*_THIGH"]
        terminate_after_contacts_on = ["base"]

    class init_state(LeggedRobotCfg.init_state):
        default_joint_angles = {"HAA": 0.0, "LF_HFE": 0.4, "RF_HFE": 0.4, "LH_HFE": -0.4, "RH_HFE": -0.4} | {
            "LF_KFE": -0.8,
            "RF_KFE": -0.8,
            "LH_KFE": 0.8,
            "RH_KFE": 0.8,
        }

    class control(LeggedRobotCfg.control):
        stiffness = {"": 80.0}
        damping = {"": 2.0}

    class sim(LeggedRobotCfg.sim):
        nconmax, njmax = 64, 320


class A1StyleCfg(LeggedRobotCfg):
    """Names as in legged_gym: base is the root link without mass, which the trunk is fixed to."""

    class asset(LeggedRobotCfg.asset):
        file = str(HERE / "a1_style.urdf")
        foot_names = ["FL_foot", "RL_foot", "FR_foot", "RR_foot"]
        imu_site = "imu_link"
        penalize_contacts_on = ["*_thigh", "*_calf"]
        terminate_after_contacts_on = ["base"]
        armature = {"": 0.01}

    class init_state(LeggedRobotCfg.init_state):
        default_joint_angles = {
            "FL_hip": 0.1,
            "RL_hip": 0.1,
            "FR_hip": -0.1,
            "RR_hip": -0.1,
            "thigh": 0.8,
            "calf": -1.5,
        }

    class control(LeggedRobotCfg.control):
        stiffness = {"": 20.0}
        damping = {"": 0.5}
        action_scale = 0.25

    class sim(LeggedRobotCfg.sim):
        nconmax, njmax = 64, 320


TASKS = {
    name: Task(LeggedRobot, cfg, LeggedRobotCfgPPO)
    for name, cfg in {
        "go2_style": Go2StyleCfg,
        "g1_29dof_style": G1StyleCfg,
        "g1_held_style": G1HeldStyleCfg,
        "g1_12dof_style": G1LegsStyleCfg,
        "t1_style": T1StyleCfg,
        "anymal_c_style": AnymalStyleCfg,
        "a1_style": A1StyleCfg,
    }.items()
}


def vendor_task(name: str) -> LoadedTask:
    """One of ``TASKS``, loaded as ``load_task`` would."""
    return LoadedTask(name, HERE / f"{name}.py", TASKS[name])
