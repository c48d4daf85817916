"""Names that were others once: fields of ours, whose old runs still load; what tasks import; what legged_gym calls differently."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

# Old dotted path -> the keys that lead to its value now.
RENAMED: dict[str, tuple[str, ...]] = {
    "perturbation.enable": ("perturbation", "kick"),
    "cpu.keep_probability": ("cpu", "overrides", "commands.keep_probability"),
    "cpu.kick_curriculum": ("cpu", "overrides", "perturbation.curriculum"),
}

# A module that a task or a run's config may name, or a class of one -> the module where it is now.
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

# What a class ported from legged_gym may define, which nothing here calls, or read, which is not here -> what is. docs/from_legged_gym.md
LEGGED_GYM_METHODS: dict[str, str] = {
    "post_physics_step": "_step()",
    "_post_physics_step_callback": "_update_state() and _end_step()",
    "_get_noise_scale_vec": "observation_rows()",
    "reset_idx": "reset_envs(mask)",
    "anneal": "on_training_progress(share)",  # not legged_gym's: ours, before
    "_reset_dofs": "_reset_robots(mask)",
    "_reset_root_states": "_reset_robots(mask)",
    "update_command_curriculum": "_update_command_curriculum(mask)",
    "_get_heights": "_scan_heights()",
    "_push_robots": "perturbation.push of the config",
    **dict.fromkeys(("create_sim", "_create_envs"), "_load_robot()"),
    **dict.fromkeys(("_process_rigid_shape_props", "_process_dof_props", "_process_rigid_body_props"), "_load_robot()"),
}
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


def new_name(path: str) -> str:
    """What the field at ``path`` (``Dog.cpu.kick_curriculum``, or without the class) is called now; "" if that is no old name."""
    for old, keys in RENAMED.items():
        if path == old or path.endswith(f".{old}"):
            *sections, name = keys
            return f"{'.'.join(sections)}['{name}']" if "." in name else ".".join(keys)
    return ""


def with_new_names(saved: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a run's saved config in which every old name of a field or a class's module is replaced by the new one."""
    config: dict[str, Any] = copy.deepcopy(dict(saved))
    for old, (*sections, name) in RENAMED.items():
        section, _, field = old.partition(".")
        if not isinstance(config.get(section), dict) or field not in config[section]:
            continue
        value, node = config[section].pop(field), config
        for key in sections:
            node = node.setdefault(key, {}) if isinstance(node, dict) else None
        if isinstance(node, dict):  # else the file is wrong there, and loading it says so
            node[name] = value
    for section in config.values():
        name = section.get("class_name") if isinstance(section, dict) else None
        for old, new in MOVED.items():
            if isinstance(name, str) and name.startswith((f"{old}:", f"{old}.")):
                section["class_name"] = new + name[len(old) :]
    return config
