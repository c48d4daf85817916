"""Which parts of a robot may touch one another: all that collide, but for those that do wherever it moves."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Sequence

import mujoco

from legged_mw.sim.ground import GROUND


def leave_out_neighbours(spec: mujoco.MjSpec, joints: Sequence[str], angles: Sequence[float], notes: list[str]) -> None:
    """Exclude the pairs of bodies that overlap with ``joints`` at ``angles`` [rad]: they would push against each other for good.

    Bodies that a joint joins are left out by MuJoCo itself.
    """
    for geom in [geom for geom in spec.geoms if geom.contype]:  # an exclusion needs names
        geom.parent.name = geom.parent.name or f"body_of_{geom.name}"
    copy = spec.copy()
    copy.delete(copy.geom(GROUND))
    model = copy.compile()
    data = mujoco.MjData(model)
    for name, angle in zip(joints, angles, strict=True):
        data.qpos[model.joint(name).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    touching = {tuple(sorted(int(model.geom_bodyid[geom]) for geom in contact.geom)) for contact in data.contact}
    pairs = [tuple(model.body(body).name for body in pair) for pair in sorted(touching)]
    for first, second in pairs:
        spec.add_exclude(bodyname1=first, bodyname2=second)
    notes.append("self-collisions: bodies that a joint joins pass through one another")
    if pairs:
        overlapping = ", ".join(f"'{first}' and '{second}'" for first, second in pairs)
        notes.append(f"self-collisions left out, as they overlap in the pose: {overlapping}")
