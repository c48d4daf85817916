"""The text about a task that ``train.py --check`` prints."""

from __future__ import annotations

from legged_mw.check.own_class import own_classes
from legged_mw.envs.domain_rand import active
from legged_mw.envs.motors import OWN, round_delay
from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.students.estimator import find_targets
from legged_mw.sim.capacity import count_capacity
from legged_mw.utils.task import LoadedTask


def describe(env: RobotTask, task: LoadedTask) -> str:
    """Observation rows, reward terms, joints, changes to the model and overridden fields, as text."""
    lines: list[str] = []
    for group, rows in env.observations.groups.items():
        lines.append(f"observation {group} ({sum(row.size for row in rows)})")
        for row in rows:
            noise, start = row.noise * env.cfg.noise.level, env.observations.span(group, row.name).start
            line = f"  {start:>4}  {row.name:<20} {row.size:>3}" + (f"   noise +-{noise:g}" if noise else "")
            line += f"   scale {row.scale}" if row.scale != 1.0 else ""
            lines.append(line + (f"   {row.history} frames" if row.history > 1 else ""))
    if targets := find_targets(task.train.to_dict(), env):
        lines.append(
            f"the actor estimates {', '.join(f'{target.name} ({len(target.scale)})' for target, _ in targets)}"
        )
    if (taught := task.train.actor.concurrent).groups:
        latent = f"a teacher's latent ({taught.latent_dim}) of {', '.join(taught.groups)}"
        lines.append(f"{taught.teacher_share:.0%} of the worlds act by {latent}")
    lines += _memories(task)
    for command in env.command_table:
        lines.append(f"command {command.label:<14} [{command.low:g}, {command.high:g}] {command.unit}")
    lines.append(
        f"actions ({env.num_actions}), clipped at +-{task.cfg.normalization.clip_actions:g}, {1 / env.dt:g} Hz"
    )
    lines.append("reward terms (scale)")
    scales = task.cfg.to_dict()["rewards"]["scales"]
    lines += [f"  {name:<20} {scales[name]:g}" for name in env.reward_names]
    off = [name for name in _own_terms(env) if not scales.get(name)]
    lines += [f"  {name:<20} off: rewards.scales.{name} is {scales.get(name, 'missing')}" for name in off]
    lines += _joints(env)
    lines += [_motors(env), _randomized(env), _room(env)]
    lines.append(f"what was dropped, added or changed in {task.cfg.asset.file}")
    lines += [f"  {line}" for line in env.robot.overrides]
    return "\n".join(lines)


def _own_terms(env: RobotTask) -> list[str]:
    """Reward terms of the user's classes."""
    own = own_classes(type(env))
    return sorted({name.removeprefix("_reward_") for kind in own for name in vars(kind) if name.startswith("_reward_")})


def _memories(task: LoadedTask) -> list[str]:
    """A line for each recurrent network."""
    networks = {"actor": task.train.actor, "critic": task.train.critic}
    return [
        f"the {name} remembers: {part.rnn_type}, {part.rnn_hidden_dim} units, layers: {part.rnn_num_layers}"
        for name, part in networks.items()
        if part.class_name.endswith("RNNModel")
    ]


def _joints(env: RobotTask) -> list[str]:
    """A line for each joint, with the most that its action can ask of the motor."""
    names, law = env.robot.joint_names, env.actuators.law
    by_angle = "rad/s" if env.cfg.control.action_origin == "speed" else "rad"
    unit, width = {"torque": "N m", OWN: "as its law takes it"}.get(law, by_angle), max(map(len, names))
    reach = (env.cfg.normalization.clip_actions * env.actuators.scale).tolist()
    table = zip(
        *(names, env.default_dof_pos.tolist(), env.robot.joint_range, env.robot.effort_range, reach), strict=True
    )
    return [
        f"joints: default, range [rad], force limit [N m], its action's reach, clip_actions times action_scale [{unit}]",
        *(
            f"  {name:<{width}} {default:>7.3f}  [{low:.3f}, {high:.3f}]  {limit:g}  +-{most:.3g}"
            for name, default, (low, high), (_, limit), most in table
        ),
    ]


def _motors(env: RobotTask) -> str:
    """The law of the motors, and the range of their delays."""
    text = f"motors: {env.actuators.law}"
    if "delay_ms" not in env.domain_rand.values:
        return text
    span, step = env.cfg.domain_rand.delay_ms, 1e3 * env.cfg.sim.dt
    low, high = (round_delay(end, step) for end in span)
    given = ", ".join(f"{end:g}" for end in span)
    rounded = f"domain_rand.delay_ms [{given}] to the nearest simulation step, of {step:g} ms"
    return f"{text}, delayed by {low:g} to {high:g} ms: {rounded}"


def _randomized(env: RobotTask) -> str:
    """The ranges of domain randomization, or that there are none."""
    if not env.cfg.domain_rand.enable:
        return "domain_rand.enable is False: none of its ranges is drawn"
    spans = (f"{name} [{low:g}, {high:g}]" for name, (_, low, high) in active(env.cfg, env.motor_law).items())
    return f"domain_rand draws: {', '.join(spans) or 'nothing, no range is given'}"


def _room(env: RobotTask) -> str:
    """The contacts and constraints for which mujoco-warp has room in a world, and the source of these numbers."""
    room, sim = count_capacity(env.robot.physics, env.terrain is not None), env.cfg.sim
    taken, counted = (sim.nconmax or room.contacts, sim.njmax or room.rows), (room.contacts, room.rows)
    source = f"the model: {room.why}"
    if taken != counted:
        source = f"the config; the model makes {counted[0]} and {counted[1]}: {room.why}"
    return f"room of a world on mujoco_warp: sim.nconmax {taken[0]}, sim.njmax {taken[1]}, from {source}"
