"""Presets for tasks of different robots: walking, getting up, standing on two of four legs, tracking a motion.

They are for use on real robots. A robot's names and numbers are in configs/robots/.

Sources: [I] Isaac Lab's G1, [M] mjlab's velocity task, [G] MuJoCo Playground's G1 joystick task, [P] its Go1 tasks,
[U] unitree_rl_gym's G1, [H] HoST, a G1 with 23 joints, [B] BeyondMimic; [ours] is measured: docs/lab.md.
"""

from __future__ import annotations

from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.rl.learner_config import LeggedRobotCfgPPO, RobotTaskCfgPPO
from legged_mw.skills.getup import GetupCfg, GetupCfgPPO
from legged_mw.skills.handstand import HandstandCfg
from legged_mw.skills.motion_tracking_config import MotionTrackingCfg


class SimToRealCfg(LeggedRobotCfg):
    """A robot that walks by command, without a measured velocity."""

    class env(LeggedRobotCfg.env):
        num_envs = 8192

    class observations(LeggedRobotCfg.observations):
        leave_out = {"state": ["base_lin_vel"]}  # no sensor measures it; the critic has it

    class commands(LeggedRobotCfg.commands):
        curriculum = True  # [ours: with the whole range, a Go2 only stands for minutes before it walks]
        curriculum_step = 0.2  # [ours]

    class rewards(LeggedRobotCfg.rewards):
        tracking_sigma, tracking_sigma_end = 0.3, 0.05  # [ours: wide to find a gait, narrow to track exactly]

        class scales(LeggedRobotCfg.rewards.scales):
            tracking_lin_vel = 2.0  # [ours]
            tracking_ang_vel = 1.0  # [ours]

    class domain_rand(LeggedRobotCfg.domain_rand):
        enable = True
        base_mass = [-1.0, 2.0]  # [kg] [ours]
        base_com = [-0.03, 0.03]  # [m] [ours]
        friction = [0.4, 1.2]  # [-] [M 0.3 to 1.2]
        stiffness = [0.9, 1.1]  # [ours]
        damping = [0.9, 1.1]  # [ours]
        strength = [0.9, 1.1]  # [ours]
        encoder_offset = [-0.015, 0.015]  # [rad] [M]
        observe = True  # for the critic

    class perturbation(LeggedRobotCfg.perturbation):
        kick = True
        velocity = [0.0, 9.0]  # [m/s] [ours: docs/lab.md]
        curriculum = True  # [ours: kicks increase as it learns to stand]
        curriculum_rate = 0.15  # [ours]
        push = True


class SimToRealCfgPPO(LeggedRobotCfgPPO):
    """The learner's config for SimToRealCfg."""

    class runner(LeggedRobotCfgPPO.runner):
        num_steps_per_env = 12  # [ours]
        max_iterations = 3900  # [ours: 400 s of a Go2 on an H200]

    class actor(LeggedRobotCfgPPO.actor):
        class distribution_cfg(LeggedRobotCfgPPO.actor.distribution_cfg):
            init_std = 1.0  # [ours: at 0.6 a Go2 with soft servos does not learn to step]

    class algorithm(LeggedRobotCfgPPO.algorithm):
        gamma = 0.97  # [ours]
        desired_kl = 0.012  # [ours]
        num_mini_batches = 8  # [ours]

    class anneal(LeggedRobotCfgPPO.anneal):
        entropy_coef = 0.001  # [ours]
        desired_kl = 0.003  # [ours]

    class symmetry(LeggedRobotCfgPPO.symmetry):
        use_data_augmentation = True  # [ours]


class TrotCfg(SimToRealCfg):
    """A quadruped that trots, on robots whose motors differ much. A clock tells left from right.

    Numbers without a source: [ours: docs/fit.md].
    """

    class gait(SimToRealCfg.gait):
        period = 0.5  # [s]
        offsets = [0.0, 0.5, 0.5, 0.0]  # [-] of front right, front left, rear right, rear left

    class observations(SimToRealCfg.observations):
        history = {"state": 5}  # with one frame it follows the common range less exactly on each robot that was tried

    class commands(SimToRealCfg.commands):
        end_probability = 0.1

    class rewards(SimToRealCfg.rewards):
        tracking_sigma_end = 0.03

        class scales(SimToRealCfg.rewards.scales):
            contact_phase = 0.3  # for the clock's pace; a delay still changes it on the spot
            feet_impact_vel = -0.4
            target_limits = -1.0
            stand_still = -1.5
            energy = -0.0008
            termination = -100.0

    class domain_rand(SimToRealCfg.domain_rand):
        friction = [0.3, 1.2]  # [-]
        base_mass = [-1.0, 3.0]  # [kg] of a robot of a Go2's size
        delay_ms = [0.0, 20.0]  # [ms]


class SimToRealRoughCfg(SimToRealCfg):
    """A quadruped of a Go2's size on rough ground, without a height scan. [L] legged_gym; [ours] docs/terrain.md."""

    class commands(SimToRealCfg.commands):
        curriculum = False  # [ours: that of the terrain is enough]

    class terrain(SimToRealCfg.terrain):
        mesh_type = "heightfield"
        height_scan = ["privileged_state"]  # for the critic only
        terrain_proportions = {  # [ours: stairs up are learned last]
            **{"flat": 0.05, "smooth_slope": 0.1, "rough_slope": 0.1, "stairs_up": 0.35, "stairs_down": 0.15},
            **{"obstacles": 0.15, "waves": 0.05, "low_random": 0.05},
        }

    class termination(SimToRealCfg.termination):
        min_base_height = 0.12  # [m] [ours: only feet collide, so the trunk could sink into a step without a penalty]

    class rewards(SimToRealCfg.rewards):
        tracking_sigma, tracking_sigma_end = 0.25, 0.0  # [P]
        swing_height = 0.15  # [m] [ours: over a step of 12 cm; P 0.1]

        class scales(SimToRealCfg.rewards.scales):
            orientation = -1.0  # [P -5] [ours: on a slope the trunk tilts with the ground]
            lin_vel_z = -0.2  # [P -0.5] [ours: stairs go up]
            feet_clearance = -1.0  # [P -2.0] [ours]

    class perturbation(SimToRealCfg.perturbation):
        velocity, curriculum_rate = [0.0, 8.0], 0.1  # [m/s], [-] [ours]


class TrotRoughCfg(SimToRealRoughCfg):
    """A quadruped of a Go2's size that trots on rough ground by a clock, on robots that differ.

    Numbers without a source: [ours: docs/archive/go2_and_g1.md, from "stairs that are seen" on].
    """

    class gait(TrotCfg.gait):
        pass

    class observations(SimToRealRoughCfg.observations):
        history = {"state": 5}  # frames: a step is felt, not seen

    class terrain(SimToRealRoughCfg.terrain):
        num_rows, difficulty = 12, [0.0, 1.2]  # stairs up to 22 cm

    class rewards(SimToRealRoughCfg.rewards):
        tracking_sigma_end = 0.1
        swing_height = 0.16  # [m]

        class scales(SimToRealRoughCfg.rewards.scales):
            contact_phase = 0.3  # for the clock's pace
            feet_impact_vel = -0.15
            target_limits = -1.0
            stand_still = -1.5

    class domain_rand(SimToRealRoughCfg.domain_rand):
        friction, stiffness, damping = [0.3, 1.25], [0.85, 1.15], [0.85, 1.3]  # [-]
        base_mass = [-1.0, 3.0]  # [kg] of a robot of a Go2's size
        delay_ms = [0.0, 15.0]  # [ms]


class SimToRealRoughCfgPPO(SimToRealCfgPPO):
    """The learner's config on rough ground: longer rollouts and a longer horizon."""

    class runner(SimToRealCfgPPO.runner):
        num_steps_per_env = 24  # [legged_gym]
        max_iterations = 5850  # 1150 M steps: 25 minutes of a Go2 as one of three trainings on an H200
        matmul_precision = "bf16"  # [ours: faster]

    class algorithm(SimToRealCfgPPO.algorithm):
        gamma = 0.99  # [legged_gym]
        desired_kl = 0.01  # [legged_gym]


class BipedCfg(SimToRealCfg):
    """A biped that walks by command, without a measured velocity."""

    class gait(SimToRealCfg.gait):
        period = 0.8  # [s] [U]

    class commands(SimToRealCfg.commands):
        curriculum = False  # [ours: no gain, docs/lab.md]

        class ranges(SimToRealCfg.commands.ranges):
            lin_vel_x, lin_vel_y, ang_vel_yaw = [-1.0, 1.0], [-0.5, 0.5], [-1.0, 1.0]  # [m/s], [m/s], [rad/s] [G, M]

    class rewards(SimToRealCfg.rewards):
        tracking_sigma, tracking_sigma_end = 0.2, 0.0  # [ours]
        swing_height = 0.08  # [m] [G 0.08 to 0.12]
        min_feet_distance = 0.16  # [m] [ours: the feet of a G1 are 6 cm wide]

        class scales(SimToRealCfg.rewards.scales):
            _only = True
            tracking_lin_vel = 2.0  # [M]
            tracking_ang_vel = 1.5  # [ours]
            alive = 0.2  # [U 0.15]
            lin_vel_z = -0.2  # [I]
            ang_vel_xy = -0.05  # [I, M]
            orientation = -2.0  # [G]
            dof_pos_limits = -1.0  # [I, M]
            pose = 0.5  # [ours]
            termination = -100.0  # [G; I -200]
            stand_still = -0.5  # [ours]
            energy = -0.002  # [ours]
            dof_acc = -1e-7  # [I]
            action_rate = -0.01  # [I -0.005, M -0.1]
            feet_slip = -0.25  # [G]
            feet_distance = -5.0  # [ours]
            feet_orientation = -0.5  # [ours]
            feet_phase = 1.0  # [G]

    class perturbation(SimToRealCfg.perturbation):
        velocity, curriculum_rate = [0.0, 8.0], 0.1  # [m/s], [-] [ours]

    class sim(SimToRealCfg.sim):
        iterations = 3  # [ours: soles slip and robots fall with 1; docs/lab.md]


class BipedCfgPPO(SimToRealCfgPPO):
    """The learner's config of a biped."""

    class runner(SimToRealCfgPPO.runner):
        num_steps_per_env, max_iterations = 16, 3000  # [ours]

    class algorithm(SimToRealCfgPPO.algorithm):
        desired_kl = 0.02  # [ours: over 29 joints; at 0.01 the learning rate falls to 1e-5]


class UprightBipedCfg(BipedCfg):
    """A biped that walks upright: penalties are not clipped, and tracking has a larger weight.

    Numbers without a source: [ours: docs/archive/go2_and_g1.md, drafts on two feet].
    """

    class rewards(BipedCfg.rewards):
        only_positive_rewards = False  # [ours: clipped at 0, these penalties outweigh all else and nothing is learned]
        tracking_sigma, tracking_sigma_end = 0.25, 0.15  # with a wide one it steps on the spot; at 0.1 it turns badly
        swing_height = 0.12  # [m] at 0.08 a foot that stays on the ground loses a sixth of feet_phase, and stays

        class scales(BipedCfg.rewards.scales):
            tracking_lin_vel = 4.0  # with 2.0 it walks three quarters of the command
            tracking_ang_vel = 2.0
            alive = 2.0
            orientation = -5.0  # [M]
            dof_pos_limits = -10.0
            target_limits = -1.0
            pose = 1.0  # [M]
            feet_phase = 3.0  # with 1.0 the feet chatter: 2 to 5 steps/s, and the clock has 1.25
            contact_phase = 1.0  # with it an H1 keeps the clock and lifts its feet by 57 mm, not 10 to 30
            feet_impact_vel = -0.25  # no stamping
            feet_orientation = -1.0  # soles level
            dof_acc = -2e-7  # no jerks
            action_rate = -0.02
            energy = -0.001  # of a G1; less for a heavier robot
            termination = -200.0  # [M, I]

    class domain_rand(BipedCfg.domain_rand):
        friction, stiffness, damping = [0.3, 1.2], [0.75, 1.25], [0.75, 1.25]  # [-]
        base_mass, delay_ms = [-1.0, 5.0], [0.0, 20.0]  # [kg] of a G1, [ms]

    class perturbation(BipedCfg.perturbation):
        velocity, interval = [0.0, 6.0], [4.0, 8.0]  # [m/s], [s] kicks to 8 m/s every 1 to 3 s teach it to stand still
        push_interval_s, max_push_vel_xy, max_push_ang_vel = 3.0, 0.5, 0.6  # [s], [m/s], [rad/s] [M: each 1 to 3 s]


class UprightBipedCfgPPO(BipedCfgPPO):
    """The learner's config of an upright biped."""

    class anneal(BipedCfgPPO.anneal):
        desired_kl = 0.0  # [ours: not annealed; if it shrinks, the learning rate falls to 1e-5]


class LevelBipedCfg(UprightBipedCfg):
    """A biped of a G1's size that walks upright with a level trunk and feet under its hips.

    Numbers without a source: [ours: docs/archive/go2_and_g1.md, a level trunk].
    """

    class normalization(UprightBipedCfg.normalization):
        clip_actions = 10.0  # with 2 a G1's knee is bent by 0.5 rad at most: a foot lifts by 8 cm, and catches on steps

    class gait(UprightBipedCfg.gait):
        period = 0.7  # [s]

    class rewards(UprightBipedCfg.rewards):
        tracking_sigma_end = 0.04  # five seeds of five walk
        swing_height = 0.1  # [m]

        class scales(UprightBipedCfg.rewards.scales):
            tracking_lin_vel = 6.0
            tracking_ang_vel = 3.0
            orientation = -15.0  # with -5, a sway of 13 degrees costs a sixteenth of what feet_phase pays at most
            trunk_orientation = -25.0  # of a G1's torso, which can roll more than its pelvis
            ang_vel_xy = -0.2
            joint_deviation = -3.0  # of waist and hips
            feet_phase = 4.0
            contact_phase = 1.3
            feet_impact_vel = -1.5
            energy = -0.002  # of a G1

    class perturbation(UprightBipedCfg.perturbation):
        # with 6 m/s, and 0.5 m/s each 3 s, it survives 0.62 of the pushes of 2 m/s; with 0.8 m/s each 2.5 s all
        velocity = [0.0, 8.0]  # [m/s]
        push_interval_s, max_push_vel_xy = 2.5, 1.2  # [s], [m/s]


class LevelBipedCfgPPO(UprightBipedCfgPPO):
    """The learner's config of a level biped."""

    class runner(UprightBipedCfgPPO.runner):
        max_iterations = 4000  # [ours: 524 M steps; yaw rate is learned last]

    class algorithm(UprightBipedCfgPPO.algorithm):
        entropy_coef = 0.002  # as BipedRoughCfgPPO

    class anneal(UprightBipedCfgPPO.anneal):
        entropy_coef = 0.0001


class BipedRoughCfg(BipedCfg):
    """A biped of a G1's size on rough ground, without a height scan."""

    class terrain(BipedCfg.terrain):
        mesh_type = "heightfield"
        height_scan = ["privileged_state"]  # for the critic only
        difficulty = [0.0, 0.6]  # [ours: stairs up to 14 cm]

    class rewards(BipedCfg.rewards):
        swing_height = 0.12  # [m]

        class scales(BipedCfg.rewards.scales):
            alive = 1.0  # [ours: penalties never exceed it]

    class perturbation(BipedCfg.perturbation):
        interval = [4.0, 8.0]  # [s] [P 1 to 3; ours: time to walk between kicks]


class BipedRoughCfgPPO(BipedCfgPPO):
    """The learner's config of a biped on rough ground."""

    class runner(BipedCfgPPO.runner):
        num_steps_per_env, max_iterations = 24, 1320  # [legged_gym], [ours: 420 s of a G1 on an H200]

    class algorithm(BipedCfgPPO.algorithm):
        entropy_coef = 0.002  # [ours: the std falls to 0.3]

    class anneal(BipedCfgPPO.anneal):
        entropy_coef = 0.0001  # [ours]
        desired_kl = 0.0  # [ours: not annealed; if it shrinks, the learning rate falls to 1e-5]


class LevelBipedRoughCfg(LevelBipedCfg):
    """A level biped of a G1's size on rough ground, trained from a policy of the flat: train.py --init g1_flat.

    Numbers without a source: [ours: docs/archive/go2_and_g1.md, free knees].
    """

    class observations(LevelBipedCfg.observations):
        history = {"state": 5}  # frames: a step is felt, not seen

    class terrain(BipedRoughCfg.terrain):
        num_rows, difficulty = 12, [0.0, 0.7]  # stairs up to 15 cm
        contact_time = 0.01  # [s] with 0.02 a sole 2 cm thick sinks into an edge, and MuJoCo's boxes catch it
        terrain_proportions = {
            **{"flat": 0.1, "smooth_slope": 0.08, "rough_slope": 0.04, "stairs_up": 0.45, "stairs_down": 0.08},
            **{"obstacles": 0.15, "waves": 0.05, "low_random": 0.05},
        }

    class rewards(LevelBipedCfg.rewards):
        tracking_sigma, tracking_sigma_end = 0.12, 0.05
        swing_height = 0.16  # [m]

        class scales(LevelBipedCfg.rewards.scales):
            tracking_lin_vel = 5.0
            tracking_ang_vel = 4.0
            orientation = -10.0
            trunk_orientation = -30.0
            feet_impact_vel = -0.5
            feet_phase = 2.5
            contact_phase = 0.5
            pose = 0.7
            action_rate = -0.015

    class perturbation(LevelBipedCfg.perturbation):
        velocity = [0.0, 6.0]  # [m/s]
        push_interval_s, max_push_vel_xy, max_push_ang_vel = 3.0, 1.2, 0.8  # [s], [m/s], [rad/s]


class LevelBipedRoughCfgPPO(LevelBipedCfgPPO):
    """The learner's config of a level biped on rough ground: longer rollouts and a longer horizon."""

    class runner(LevelBipedCfgPPO.runner):
        num_steps_per_env = 24  # [legged_gym]
        max_iterations = 3200  # [ours: 630 M steps; what ships has 603 M in two trainings, and its level still rose]
        matmul_precision = "bf16"  # [ours: faster]

    class algorithm(LevelBipedCfgPPO.algorithm):
        gamma = 0.99  # [legged_gym]
        entropy_coef = 0.001  # [ours]

    class anneal(LevelBipedCfgPPO.anneal):
        entropy_coef = 0.00005  # [ours]

    class warm_start(LevelBipedCfgPPO.warm_start):
        init_std = 0.35  # [ours: to find steps]


class BipedGetupCfg(GetupCfg):
    """Getting up, for a biped of a G1's size."""

    class env(GetupCfg.env):
        num_envs = 4096
        episode_length_s = 10.0  # [s] [H]

    class falls(GetupCfg.falls):
        seconds = 1.5  # [s] [ours: it falls from a greater height]
        pull = 0.8  # of its weight [H 0.6]

    class control(GetupCfg.control):
        action_origin = "default"  # [ours: with the pull, its servos alone lift it; docs/skills.md]

    class rewards(GetupCfg.rewards):
        class scales(GetupCfg.rewards.scales):
            action_rate, action_smoothness = -0.002, -0.0004  # [ours: sums over 29 joints; a Go1 has 12]

    class exam(GetupCfg.exam):
        within = 6.0  # [s]


class BipedGetupCfgPPO(GetupCfgPPO):
    """The learner's config of a biped that gets up."""

    class runner(GetupCfgPPO.runner):
        max_iterations = 4000

    class algorithm(GetupCfgPPO.algorithm):
        gamma = 0.99  # [ours: getting up takes seconds]
        desired_kl, entropy_coef = 0.02, 0.005  # [ours: over 29 joints], [M]


class UnitreeHandstandCfg(HandstandCfg):
    """A handstand of a quadruped with legs FR, FL, RR, RL, on the front legs."""

    class asset(HandstandCfg.asset):
        penalize_contacts_on = ["RR*", "RL*"]

    class exam(HandstandCfg.exam):
        hands = ["FR", "FL"]

    class rewards(HandstandCfg.rewards):
        deviation_weights = {"": 0.0, "RR_": 1.0, "RL_": 1.0}  # the legs in the air [P]


class UnitreeFootstandCfg(HandstandCfg):
    """A footstand of such a quadruped, on the rear legs.

    In [P] a contact of the front legs ends an episode. Here, as in a handstand, those of the standing legs do, except
    of the feet.
    """

    class asset(HandstandCfg.asset):
        penalize_contacts_on = ["FR*", "FL*"]

    class exam(HandstandCfg.exam):
        nose, hands = 1.0, ["RR", "RL"]  # [-] [P]

    class rewards(HandstandCfg.rewards):
        deviation_weights = {"": 0.0, "FR_": 1.0, "FL_": 1.0}  # the legs in the air [P]


class TrackingCfg(MotionTrackingCfg):
    """Tracking a motion without measured position and velocity, in randomized worlds."""

    class env(MotionTrackingCfg.env):
        num_envs = 8192

    class observations(MotionTrackingCfg.observations):
        leave_out = {"state": ["anchor_pos", "base_lin_vel"]}  # no sensor measures them [B, without state estimation]

    class normalization(MotionTrackingCfg.normalization):
        clip_actions = 10.0  # [ours: B has no bound; in a squat the knees are 4 action scales from the default pose]

    class domain_rand(MotionTrackingCfg.domain_rand):
        enable = True
        friction = [0.3, 1.2]  # [M]
        base_com = [-0.05, 0.05]  # [m] [B: of the torso]
        encoder_offset = [-0.01, 0.01]  # [rad] [B: of the default pose]
        link_mass, base_mass, armature, frictionloss = [], [], [], []  # [B]

    class perturbation(MotionTrackingCfg.perturbation):
        push, push_interval_s, max_push_vel_xy = True, 2.0, 0.5  # [s], [m/s] [B: each 1 to 3 s]


class TrackingCfgPPO(RobotTaskCfgPPO):
    """The learner's config for one clip of a humanoid."""

    class algorithm(RobotTaskCfgPPO.algorithm):
        desired_kl = 0.02  # [ours: over 29 joints, as a walking G1's]

    class runner(RobotTaskCfgPPO.runner):
        max_iterations = 1400  # seven minutes on an H200

    class actor(RobotTaskCfgPPO.actor):
        hidden_dims = [224, 128, 64]  # [ours: one clip needs less than B's 512, 256, 128]

        class distribution_cfg(RobotTaskCfgPPO.actor.distribution_cfg):
            init_std = 0.4  # [ours: with B's 1.0, action_rate first exceeds tracking, and it learns to fall early]
