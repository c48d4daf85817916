"""A task in words: what ``train.py --check`` prints."""

from __future__ import annotations

from typing import TYPE_CHECKING

from legged_mw.utils.task import LoadedTask

if TYPE_CHECKING:
    from legged_mw.envs.legged_robot import LeggedRobot


def describe(env: LeggedRobot, task: LoadedTask) -> str:
    """Observation rows, reward terms, joints, what the config changed in the model and what was overridden, as text."""
    lines: list[str] = []
    for group, rows in env.observation_table.items():
        scales = [row.scale for row in env._observation_rows()[group]]
        lines.append(f"observation {group} ({sum(size for _, size, _ in rows)})")
        start = 0
        for (name, size, noise), scale in zip(rows, scales, strict=True):
            line = f"  {start:>4}  {name:<20} {size:>3}" + (f"   noise +-{noise:g}" if noise else "")
            lines.append(line + (f"   scale {scale}" if scale != 1.0 else ""))
            start += size
    lines.append(f"actions ({env.num_actions}), clipped at +-{task.cfg.normalization.clip_actions:g}, {1 / env.dt:g} Hz")
    lines.append("reward terms (scale)")
    scales = task.cfg.to_dict()["rewards"]["scales"]
    lines += [f"  {name:<20} {scales[name]:g}" for name in env.reward_names]
    lines.append("joints: default, range [rad], force limit [N m]")
    for name, default, (low, high), (_, limit) in zip(
        env.robot.joint_names, env.default_dof_pos.tolist(), env.robot.joint_range, env.robot.effort_range, strict=True
    ):
        lines.append(f"  {name:<20} {default:>7.3f}  [{low:.3f}, {high:.3f}]  {limit:g}")
    lines.append(f"what the config changed in {task.cfg.asset.file}")
    lines += [f"  {line}" for line in env.robot.overrides]
    return "\n".join(lines)
