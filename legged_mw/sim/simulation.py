"""mujoco-warp behind fixed torch tensors. It steps any model: nothing here knows a robot, a reward or a config."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp
from mujoco_warp import OverflowType
from torch import Tensor

from legged_mw.sim.graph import record_warp
from legged_mw.sim.model import ModelError, unknown

_STATE = ("qpos", "qvel", "ctrl", "sensordata", "actuator_force", "site_xpos", "xfrc_applied", "overflow")
# With 1 Newton and 5 line-search iterations these two are always set: they say "not converged", which is the plan.
_EXPECTED = OverflowType.ITERATIONS | OverflowType.LS_ITERATIONS
# From this many Newton iterations on, a conditional loop in the graph is worth its launch.
_UNROLLED_ITERATIONS = 10


class Simulation:
    """``num_envs`` worlds of one model, stepped together.

    Every tensor below is a view of the simulator's own memory, fixed for the life of the object: read it, write it in
    place, never rebind it. After ``step``, ``qpos`` and ``qvel`` are current; the rest was computed at the start of
    the last substep, so it is one ``timestep`` old. After ``reset(mask)`` it is zero in the masked worlds.
    """

    qpos: Tensor  # (N, nq) root position [m, world], quaternion wxyz, joint angles [rad]
    qvel: Tensor  # (N, nv) root linear [m/s, world], root angular [rad/s, body], joints [rad/s]
    ctrl: Tensor  # (N, nu) servo targets [rad]
    sensordata: Tensor  # (N, nsensordata) of the last substep
    actuator_force: Tensor  # (N, nu) [N m], clamped, of the last substep
    site_xpos: Tensor  # (N, nsite, 3) [m, world], of the last substep
    xfrc_applied: Tensor  # (N, nbody, 6) force [N] and torque [N m], world frame, at the body's centre of mass; persists
    overflow: Tensor  # (N,) int32, bits of mujoco_warp.OverflowType since the world's last reset

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        device: str,
        *,
        nconmax: int,
        njmax: int,
        world_fields: Sequence[str] = (),
        eager: bool = False,
    ) -> None:
        """Allocate ``num_envs`` worlds with room for ``nconmax`` contacts and ``njmax`` constraint rows each.

        ``world_fields`` names model fields that get a value per world (see ``field``). ``eager`` switches the CPU's
        replay off. On a CPU physics repeats bit for bit; on a GPU it does not: mujoco-warp 4.0.0 takes constraint rows
        from an atomic counter, also in its deterministic mode, so sums differ in the last bit.
        """
        self.num_envs, self.device = num_envs, device
        self.nconmax, self.njmax = nconmax, njmax
        self._device = wp.get_device(device)
        self._eager = eager or not self._device.is_cpu
        _check_fields(world_fields)
        with wp.ScopedDevice(self._device):
            self._model = mjw.put_model(model, batch_sizes=dict.fromkeys(world_fields, num_envs))
            option = self._model.opt
            option.warn_overflow = 0  # the bits are read, printing from a kernel is not free
            option.graph_conditional = option.iterations > _UNROLLED_ITERATIONS
            self._data = mjw.make_data(model, nworld=num_envs, nconmax=nconmax, njmax=njmax)
        for name in _STATE:
            setattr(self, name, wp.to_torch(getattr(self._data, name)))
        self._fields = {name: wp.to_torch(getattr(self._model, name)) for name in world_fields}
        self._overflow_seen = torch.zeros_like(self.overflow)
        self._reset_mask = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._reset_mask_wp = wp.from_torch(self._reset_mask)
        self._recorded: dict[str, object] = {}

    def step(self, substeps: int = 1) -> None:
        """Advance every world by ``substeps`` time steps, with ``ctrl`` and ``xfrc_applied`` as they stand."""
        self._run(f"step{substeps}", lambda: self._substeps(substeps))
        torch.bitwise_or(self._overflow_seen, self.overflow, out=self._overflow_seen)

    def reset(self, mask: Tensor) -> None:
        """Clear the worlds where ``mask`` (N,) bool is true; what is not state is zero until the next ``step``.

        State goes to the model's own ``qpos0``: write the wanted ``qpos``, ``qvel`` and ``ctrl`` after it.
        """
        self._reset_mask.copy_(mask)
        self._run("reset", lambda: mjw.reset_data(self._model, self._data, reset=self._reset_mask_wp))
        for stale in (self.actuator_force, self.site_xpos):  # reset_data leaves the dead episode's values, even NaN
            stale.masked_fill_(mask.view(-1, *[1] * (stale.dim() - 1)), 0.0)

    def field(self, name: str) -> Tensor:
        """View (N, ...) of a model field that was declared in ``world_fields``; write it in place."""
        if name not in self._fields:
            raise ModelError(unknown("per-world model field", name, self._fields, "this simulation (declare it in world_fields)"))
        return self._fields[name]

    def overflowed_worlds(self) -> Tensor:
        """How many worlds did not fit since construction, float (), on the device."""
        return ((self._overflow_seen & ~int(_EXPECTED)) != 0).sum(dtype=torch.float)

    def overflow_report(self) -> str:
        """What did not fit since construction, a line, or '' if all did. Reads the device: not for inside a step."""
        worlds = int(self.overflowed_worlds())
        if not worlds:
            return ""
        seen = self._overflow_seen & ~int(_EXPECTED)
        bits = [bit for bit in OverflowType if bit != OverflowType.ALL and bool((seen & int(bit)).any())]
        raise_ = []
        if OverflowType.NEFC in bits:
            raise_.append(f"njmax (now {self.njmax})")
        if {OverflowType.NARROWPHASE, OverflowType.BROADPHASE} & set(bits):
            raise_.append(f"nconmax (now {self.nconmax})")
        names = ", ".join(str(bit.name) for bit in bits)
        return f"simulator overflow ({names}) in {worlds} of {self.num_envs} worlds; raise {' and '.join(raise_) or 'nconmax and njmax'}"

    def _substeps(self, count: int) -> None:
        """Sensors feed nothing back, so only the last substep computes them: same state, a tenth less work."""
        option = self._model.opt
        flags = option.disableflags
        for i in range(count):
            option.disableflags = flags if i == count - 1 else flags | mjw.DisableBit.SENSOR
            mjw.step(self._model, self._data)

    def _run(self, name: str, fn) -> None:
        with wp.ScopedDevice(self._device):
            if self._eager:
                fn()
                return
            if name not in self._recorded:
                self._recorded[name] = record_warp(fn, self._device)
            self._recorded[name]()  # type: ignore[operator]


def _check_fields(names: Sequence[str]) -> None:
    known = [f.name for f in dataclasses.fields(mjw.Model) if getattr(f.type, "shape", ("",))[:1] == ("*",)]
    for name in names:
        if name not in known:
            raise ModelError(unknown("per-world model field", name, known, "mujoco-warp's Model"))
