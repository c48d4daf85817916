"""The health page as text: numbers from ``measure``, gains from ``suggest``, and a list of faults and doubts."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import torch

from legged_mw.check.guard import nothing_changed, tiny_cfg
from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.ranks import this_rank
from legged_mw.robot.measure import (
    STAND_SECONDS,
    STAND_TILT,
    Gains,
    Joint,
    RobotNumbers,
    Stand,
    beyond_euler,
    measure,
    suggest,
)
from legged_mw.utils.errors import in_short, place_of
from legged_mw.utils.task import LoadedTask

_GROWS = 1e-6  # a mode is unstable if its factor exceeds 1 by more; less is rounding error in the root's modes
_TIP = 0.3  # [rad] with a larger sag, a joint stands away from the default pose
_HEAD = (
    "joint",
    "inertia",
    "pose",
    "dt kd/I",
    "dt sqrt(kp/I)",
    "ratio",
    "sag",
    "range [rad]",
    "effort",
    "speed",
    "kp",
    "kd",
    "suggested",
)


def page(
    health: RobotNumbers,
    title: str,
    guessed: Sequence[str] = (),
    changed: Sequence[str] = (),
    poses: Sequence[str] = (),
) -> str:
    """The whole page, with lines about guessed values, changes to the robot's file, and poses that were judged."""
    gains = suggest(health.joints, health.moment)
    lines = [f"health of {title}", *(f"  guessed: {line}" for line in guessed), *_summary(health)]
    lines += ["joints", *_table(health, gains), *_LEGEND]
    if poses:
        lines += ["poses that were judged", *(f"  {line}" for line in poses)]
    if changed:
        lines += ["what was dropped, added or changed in the file", *(f"  {line}" for line in changed)]
    remarks = [*faults(health), *doubtful(health, gains)]
    return "\n".join(
        [*lines, "what to look at", *(f"  - {line}" for line in remarks or ["nothing: all numbers are within bounds"])]
    )


_LEGEND = (
    "  inertia [kg m^2] that a motor turns while all else is free: the smallest of the poses default, low, middle, high (of all ranges), "
    "and in which;",
    "  dt kd/I: from 1 on it rings, from 2 on it is unstable; dt sqrt(kp/I): unstable from 2 on; ratio: kd / (2 sqrt(kp I));",
    "  sag [rad] under gravity at rest; effort [N m]; speed [rad/s]; kp [N m/rad]; kd [N m s/rad]; suggested: kp and kd",
)


def _summary(health: RobotNumbers) -> list[str]:
    rest, integrator = health.rest, "implicitfast" if health.implicit else "euler"
    upright = " (it topples; these are with its root held upright)" if rest.toppled else ""
    over = (
        f"{1e3 * health.margin:.0f} mm inside of what its contacts span"
        if health.margin >= 0
        else f"{-1e3 * health.margin:.0f} mm OUTSIDE of what its contacts span"
        if math.isfinite(health.margin)
        else "over nothing: no contact with the ground"
    )
    return [
        f"  mass                 {health.mass:.2f} kg",
        f"  standing height      {health.height:.3f} m of the root, {health.top:.3f} m of its highest point{upright}",
        f"  centre of mass       {over}",
        f"  at rest              {rest.contacts} contacts, {rest.rows} constraint rows; room for more (sim.nconmax, sim.njmax): "
        f"{health.room.contacts}, {health.room.rows}",
        f"  action zero          {standing(health.stand)}",
        f"  substep              {1e3 * health.dt:g} ms, {integrator}; servos in the air: {_mode(health)}",
    ]


def standing(stand: Stand) -> str:
    """The result of the standing test as text."""
    if stand.end == "stands":
        return f"stands on its servos for {STAND_SECONDS:g} s"
    what = {"falls": f"tilts beyond {STAND_TILT:g} degrees", "sinks": "sinks below half of its height"}
    if stand.end == "diverges":
        return f"diverges after {stand.seconds:.2f} s, fastest: {', '.join(stand.joints)}"
    return f"{what[stand.end]} after {stand.seconds:.2f} s"


def _mode(health: RobotNumbers) -> str:
    if health.mode.growth <= 1.0 + _GROWS:
        return "stable"
    return f"UNSTABLE, a mode of {', '.join(health.mode.joints)} grows {health.mode.growth:.2f}-fold a substep"


def _table(health: RobotNumbers, gains: Sequence[Gains]) -> list[str]:
    rows = [_HEAD, *(_row(joint, gain, health) for joint, gain in zip(health.joints, gains, strict=True))]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEAD))]
    return [
        "  "
        + "  ".join(
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]


def _row(joint: Joint, gain: Gains, health: RobotNumbers) -> tuple[str, ...]:
    verdict = joint.verdict(health.dt, health.implicit)
    mark = {"": "", "rings": "!", "unstable": "!!"}[verdict]
    return (
        *(joint.name, f"{joint.inertia:.4f}", joint.pose),
        *(f"{mark}{joint.damping_step(health.dt):.2f}", f"{joint.stiffness_step(health.dt):.2f}"),
        *(f"{joint.damping_ratio():.2f}", f"{joint.sag():.3f}"),
        f"{joint.low:.2f} {joint.high:.2f}" if math.isfinite(joint.low) else "none",
        *(
            f"{joint.effort:g}" if math.isfinite(joint.effort) else "none",
            f"{joint.speed:g}" if math.isfinite(joint.speed) else "?",
        ),
        *(f"{joint.kp:g}", f"{joint.kd:g}", f"{gain.kp:g} {gain.kd:g}"),
    )


def _those(which: Sequence[Joint]) -> str:
    return ", ".join(joint.name for joint in which)


def faults(health: RobotNumbers) -> list[str]:
    """Faults that prevent training, one line each: the fault, its place, and the config field that fixes it."""
    dt, joints, lines = health.dt, health.joints, []
    if bad := [joint for joint in joints if joint.verdict(dt, health.implicit) == "unstable"]:
        lines.append(
            f"unstable servos: {_those(bad)}: lower control.damping or control.stiffness, or give them armature (asset.armature), "
            "or lower sim.dt, or set sim.integrator to implicitfast"
        )
    elif health.mode.growth > 1.0 + _GROWS:
        lines.append(
            f"each servo is stable alone, but all together are unstable ({', '.join(health.mode.joints)}): lower sim.dt or the gains"
        )
    if weak := [joint for joint in joints if abs(joint.torque) > joint.effort]:
        lines.append(
            f"to rest in this pose takes more than the effort of {_those(weak)}: choose another init_state.default_joint_angles"
        )
    if soft := [joint for joint in joints if joint.sag() > _TIP]:
        lines.append(
            f"sags by more than {_TIP:g} rad at rest: {_those(soft)}: raise control.stiffness, or choose another pose"
        )
    return lines


def doubtful(health: RobotNumbers, gains: Sequence[Gains]) -> list[str]:
    """Doubtful values, in the same form. Some robots train well with them."""
    dt, joints, lines = health.dt, health.joints, []
    if rings := [joint for joint in joints if joint.verdict(dt, health.implicit) == "rings"]:
        lines.append(
            f"damping turns the velocity's sign in every substep: {_those(rings)}: lower control.damping or sim.dt, or give them armature"
        )
    bare = [joint for joint in beyond_euler(joints, gains, dt) if not joint.armature]
    if bare and not health.implicit:
        lines.append(
            f"no armature, and the suggested gains are more than a substep bears: {_those(bare)}: set sim.integrator to implicitfast; "
            "a geared motor adds its rotor's inertia times the gear ratio squared, which asset.armature takes"
        )
    if endless := [joint for joint in joints if not math.isfinite(joint.effort)]:
        lines.append(
            f"no force limit: {_those(endless)}: say asset.effort, or they are trained with torques that no motor has"
        )
    if health.rest.toppled or health.margin < 0.0:
        lines.append("the centre of mass is not over the feet: choose another init_state.default_joint_angles")
    if health.stand.end != "stands":
        lines.append(
            f"with action zero it {standing(health.stand)}: a biped may, others should stand: raise control.stiffness, "
            "or choose another init_state.default_joint_angles"
        )
    return lines


def doubts(task: LoadedTask) -> tuple[list[str], list[str]]:
    """Faults that prevent a task from learning, and doubtful numbers.

    A fault is a rule that ends every episode at once, or gains that no training can compensate.
    The random generators are restored. A failure of this check is not an error.
    """
    if not this_rank().leads:
        return [], []  # one process reports for all
    control = task.cfg.control
    gains = control.actuator in ("servo", "dc_motor") and control.action_origin != "speed"
    with nothing_changed():
        try:
            env, _ = few_robots(task, gains, plane=False)
            ends, wrong, odd = first_step(env), list[str](), list[str]()
            if gains:
                health = measure(env.robot, env.robot.pose, env.start_place, control.decimation)
                wrong, odd = faults(health), doubtful(health, suggest(health.joints, health.moment))
        except Exception as error:  # a failed check is not a fault of the task
            return [], [f"the task could not be checked: {in_short(error)}"]
    return [*([ends] if ends else []), *wrong], odd


@torch.inference_mode()
def first_step(env: RobotTask) -> str:
    """The rule that ends every episode of ``env`` in one step with action zero, as text; '' if there is none.

    It steps the worlds of ``env``.
    """
    for _ in range(3):  # repeat: with random starts, all worlds may end by chance
        env._reset_all()
        env.actions.zero_()
        env._apply_actions()
        env.sim.step(env.cfg.control.decimation, env.actuators.before)
        env._update_state()
        env.check_termination()
        if not bool(env.reset_buf.all()):
            return ""
    rules = [f"{field} = {_field(env, field)}" for field, down in env.fall_rules().items() if bool(down.any())]
    if bool(env.fell.any()) and type(env)._fallen is not RobotTask._fallen:
        rules.append(place_of(type(env)._fallen))
    if bool(env.time_out_buf.any()):
        rules.append(f"env.episode_length_s = {env.cfg.env.episode_length_s:g}, with control steps of {env.dt:g} s")
    if bool(env.broken.any()):
        rules.append("a state that is not finite, or faster than termination.max_speed")
    return f"every episode ends at its first step: by {' and '.join(rules) or type(env).__name__}"


def _field(env: RobotTask, path: str) -> object:
    section, _, field = path.partition(".")
    return getattr(getattr(env.cfg, section), field)


def few_robots(task: LoadedTask, servos: bool = True, plane: bool = True) -> tuple[RobotTask, bool]:
    """An environment with few robots of the task on a CPU, and whether the task's terrain is rough.

    ``servos``: replace the task's motors by servos. ``plane``: replace its terrain by a plane.
    """
    few = copy.deepcopy(task)
    few.cfg = tiny_cfg(task.cfg)
    kind: type[RobotTask] = task.env_class
    if servos:
        few.set("control.actuator", "servo")  # the page checks gains and their stability
        kind = type(kind.__name__, (kind,), {"_compute_torques": RobotTask._compute_torques})
    rough = few.cfg.to_dict()["terrain"].get("mesh_type", "plane") != "plane"
    if rough and plane:
        few.set("terrain.mesh_type", "plane")
    return kind(few.cfg, "cpu"), rough
