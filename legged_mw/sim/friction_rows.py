"""Constraint rows of dry friction in the joints, each at its own place, where mujoco-warp takes places from a counter.

The library's kernel asks two counters a world for every row, so that its threads wait for one another. These rows are the
first, as there are no equality constraints: row k belongs to the k-th degree of freedom with friction. Same rows, same values.
"""

# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportGeneralTypeIssues=false, reportInvalidTypeForm=false
# pyright: reportArgumentType=false, reportCallIssue=false, reportAssignmentType=false, reportOperatorIssue=false, reportReturnType=false
# ruff: noqa: UP018, RUF046
# (warp compiles what it finds written here as its own language: int() makes a variable)
from __future__ import annotations

from functools import cache

import warp as wp
from mujoco_warp._src.constraint import _efc_row
from mujoco_warp._src.types import ConstraintType, vec5

wp.set_module_options({"enable_backward": False})

_FRICTION = wp.constant(int(ConstraintType.FRICTION_DOF))


@wp.func
def _place(frictionloss: wp.array2d[float], world: int, dof: int, nv: int) -> wp.vec2i:
    """How many degrees of freedom with friction come before this one, and how many there are."""
    row, rows = int(0), int(0)
    for i in range(nv):
        if frictionloss[world, i] > 0.0:
            rows += 1
            if i < dof:
                row += 1
    return wp.vec2i(row, rows)


# fmt: off
@cache
def friction_rows(sparse: bool) -> wp.Kernel:
    """In place of ``_friction_dof``, with its arguments. There must be room for a row a degree of freedom, and no equality."""

    @wp.kernel(module="unique", enable_backward=False)
    def _friction_rows(
        nv: int, timestep: wp.array[float], disableflags: int, solref: wp.array2d[wp.vec2], solimp: wp.array2d[vec5],
        frictionloss: wp.array2d[float], invweight: wp.array2d[float], qvel: wp.array2d[float], njmax: int, njmax_nnz: int,
        nf: wp.array[int], nefc: wp.array[int], kind: wp.array2d[int], id: wp.array2d[int],
        J_rownnz: wp.array2d[int], J_rowadr: wp.array2d[int], J_colind: wp.array3d[int], J: wp.array3d[float],
        pos: wp.array2d[float], margin: wp.array2d[float], D: wp.array2d[float], vel: wp.array2d[float], aref: wp.array2d[float],
        loss: wp.array2d[float], frictionadr: wp.array2d[int], nnz: wp.array[int],
    ):
        world, dof = wp.tid()
        losses = world % frictionloss.shape[0]
        place = _place(frictionloss, losses, dof, nv)
        row = place[0]
        if dof == 0:
            nf[world] = place[1]
            nefc[world] = place[1]
            nnz[world] = wp.static(1 if sparse else 0) * place[1]
        frictionadr[world, dof] = wp.where(frictionloss[losses, dof] > 0.0, row, -1)
        if frictionloss[losses, dof] <= 0.0:
            return
        if wp.static(sparse):
            J_rownnz[world, row] = 1
            J_rowadr[world, row] = row
            J_colind[world, 0, row] = dof
            J[world, 0, row] = 1.0
        else:
            for i in range(nv):
                J[world, row, i] = wp.where(i == dof, 1.0, 0.0)
        _efc_row(
            disableflags, world, timestep[world % timestep.shape[0]], row, 0.0, 0.0,
            invweight[world % invweight.shape[0], dof], solref[world % solref.shape[0], dof], solimp[world % solimp.shape[0], dof],
            0.0, qvel[world, dof], frictionloss[losses, dof], _FRICTION, dof, False, 0.0,
            kind, id, pos, margin, D, vel, aref, loss,
        )

    return _friction_rows
# fmt: on
