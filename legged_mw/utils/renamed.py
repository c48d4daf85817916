"""Old names: modules that moved, and tensors with another name in legged_gym."""

from __future__ import annotations

# Old module, or class, in a task or the config of an old run -> its module now.
MOVED: dict[str, str] = {
    "legged_mw.rl.distillation": "legged_mw.rl.students.distillation",
    "RobotTaskCfgPPO": "legged_mw.rl.learner_config",
    "LeggedRobotCfgPPO": "legged_mw.rl.learner_config",
    "legged_mw.envs.sim_to_real_config": "configs.base",
    "legged_mw.envs.getup": "legged_mw.skills.getup",
    "legged_mw.envs.handstand": "legged_mw.skills.handstand",
    "legged_mw.envs.motion_tracking": "legged_mw.skills.motion_tracking",
    "legged_mw.envs.motion_tracking_config": "legged_mw.skills.motion_tracking_config",
    "legged_mw.envs.skill_config": "legged_mw.skills.skill_config",
}

# Tensor of legged_gym -> its name here (docs/from_legged_gym.md).
LEGGED_GYM_TENSORS: dict[str, str] = {
    "root_states": "root_pos, root_quat (w, x, y, z), root_lin_vel, base_ang_vel",
    "base_quat": "root_quat (w, x, y, z)",
    "measured_heights": "height_scan",
    "rigid_body_states": "foot_pos, foot_height, foot_vel",
    **dict.fromkeys(("foot_force", "foot_forces"), "contact_forces"),
    "feet_indices": "foot_contact, contact_forces, foot_vel: of the feet alone",
    "dof_pos_limits": "soft_lower, soft_upper",
    "torque_limits": "robot.effort_range",
    "last_contacts": "first_contact",
    "extras": "take_statistics()",
}
