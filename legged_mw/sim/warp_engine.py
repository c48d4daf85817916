"""mujoco-warp with fixed torch tensors, which are views of the simulator's memory."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from operator import attrgetter

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from mujoco_warp import OverflowType
from torch import Tensor

from legged_mw.sim.ground import GROUND
from legged_mw.sim.ground_contact import touch_ground
from legged_mw.sim.simulation import CONSTANTS, CONSTANTS_READ, GRAVITY, Simulation
from legged_mw.sim.terrain import Terrain
from legged_mw.utils.errors import ModelError, unknown
from legged_mw.utils.opaque import fast, not_traced

wp.config.log_level = wp.LOG_WARNING  # otherwise warp prints a line for each kernel module

_STATE = ("qpos", "qvel", "ctrl", "sensordata", "actuator_force", "site_xpos", "xquat", "xfrc_applied", "overflow")
# Other fields that the next step reads.
_CARRIED = ("time", "act", "qacc_warmstart", "qfrc_applied", "eq_active")
_CARRIED += ("mocap_pos", "mocap_quat", "history", "plastic", "userdata")
# Both bits mean "not converged". With 1 Newton and 5 line-search iterations they are always set, as intended.
_EXPECTED = OverflowType.ITERATIONS | OverflowType.LS_ITERATIONS
# With more Newton iterations a conditional loop in the graph saves more time than it costs.
_UNROLLED_ITERATIONS = 10


class WarpSimulation(Simulation):
    """``Simulation`` with mujoco-warp."""

    engine = "mujoco_warp"
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
        terrain: Terrain | None = None,
        eager: bool = False,
    ) -> None:
        """Allocate ``num_envs`` worlds. Physics is bit-exact on a CPU but not on a GPU: mujoco-warp 4.0.0 orders
        constraint rows by an atomic counter, even in its deterministic mode, so sums differ in the last bit.
        """
        self.num_envs, self.device = num_envs, device
        self.nconmax, self.njmax = nconmax, njmax
        self._device = wp.get_device(device)
        self._eager = eager or not self._device.is_cpu
        _check_fields(world_fields)
        with wp.ScopedDevice(self._device):
            # without a value per world all worlds use the constants of the first world, without an error
            derived = CONSTANTS if {*CONSTANTS_READ} & {*world_fields} else ()
            batched = [name for name in (*world_fields, *derived) if name != GRAVITY]
            self._model = make_model(model, terrain, dict.fromkeys(batched, num_envs))
            option = self._model.opt
            if GRAVITY in world_fields:
                option.gravity = wp.array(np.tile(model.opt.gravity, (num_envs, 1)), dtype=wp.vec3)
            option.warn_overflow = 0  # ``overflow_report`` reads the bits; printing in a kernel is slow
            option.graph_conditional = option.iterations > _UNROLLED_ITERATIONS
            self._data = mjw.make_data(model, nworld=num_envs, nconmax=nconmax, njmax=njmax)
            shortcuts = fast("skip_kernels")
            self._shorter = shortcuts.ShortStep(model, self._model, self._data, world_fields) if shortcuts else None
        for name in _STATE:
            setattr(self, name, wp.to_torch(getattr(self._data, name)))
        self._fields = {name: wp.to_torch(attrgetter(name)(self._model)) for name in world_fields}
        self._overflow_seen = torch.zeros_like(self.overflow)
        self._reset_mask = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._reset_mask_wp = wp.from_torch(self._reset_mask)
        self._recorded: dict[str, object] = {}

    @not_traced
    def step(self, substeps: int = 1, before: Callable[[int], None] | None = None) -> None:
        if before is None:
            self._run(f"step{substeps}", lambda: self._substeps(range(substeps), substeps))
        else:
            for i in range(substeps):
                before(i)
                name = "last substep" if i == substeps - 1 else "substep"
                self._run(name, partial(self._substeps, [i], substeps))
        torch.bitwise_or(self._overflow_seen, self.overflow, out=self._overflow_seen)

    @not_traced
    def reset(self, mask: Tensor) -> None:
        self._reset_mask.copy_(mask)
        self._run("reset", lambda: mjw.reset_data(self._model, self._data, reset=self._reset_mask_wp))
        # reset_data keeps the old values of these, even NaN
        for stale in (self.actuator_force, self.site_xpos, self.xquat):
            stale.masked_fill_(mask.view(-1, *[1] * (stale.dim() - 1)), 0.0)

    def memory(self) -> dict[str, Tensor]:
        arrays = {name: getattr(self._data, name) for name in (*_STATE, *_CARRIED)}
        own = {name: wp.to_torch(array) for name, array in arrays.items() if array.size}
        fields = {f"model.{name}": value for name, value in self._fields.items()}
        return {**own, "overflow_seen": self._overflow_seen, **fields}

    def set_constants(self) -> None:
        with wp.ScopedDevice(self._device):
            mjw.set_const(self._model, self._data, groups=int(mjw.SetConstGroup.FIXED | mjw.SetConstGroup.INERT0))

    def overflowed_worlds(self) -> Tensor:
        return ((self._overflow_seen & ~int(_EXPECTED)) != 0).sum(dtype=torch.float)

    def overflow_report(self) -> str:
        worlds = int(self.overflowed_worlds())
        if not worlds:
            return ""
        seen = self._overflow_seen & ~int(_EXPECTED)
        bits = [bit for bit in OverflowType if bit != OverflowType.ALL and bool((seen & int(bit)).any())]
        raise_ = []
        if {OverflowType.NEFC, OverflowType.NJMAX_NNZ} & set(bits):
            raise_.append(f"njmax (now {self.njmax})")
        if {OverflowType.NARROWPHASE, OverflowType.BROADPHASE} & set(bits):
            raise_.append(f"nconmax (now {self.nconmax})")
        if OverflowType.CONTACT_MATCH in bits:  # more contacts than a sensor stores
            most = self._model.opt.contact_sensor_maxmatch
            raise_.append(f'<numeric name="contact_sensor_maxmatch" data="{2 * most}"/> in the MJCF (now {most})')
        advice = f"raise {' and '.join(raise_)}" if raise_ else "simpler geoms or fewer contacts may help"
        names = ", ".join(str(bit.name) for bit in bits)
        return f"simulator overflow ({names}) in {worlds} of {self.num_envs} worlds; {advice}"

    def actuator_velocity(self) -> Tensor:
        return wp.to_torch(self._data.actuator_velocity)

    def _substeps(self, which: Sequence[int], count: int) -> None:
        """Run the substeps ``which`` of a step with ``count`` substeps. Only the last one computes sensors."""
        option = self._model.opt
        flags = option.disableflags
        for i in which:
            last = i == count - 1
            option.disableflags = flags if last else flags | mjw.DisableBit.SENSOR
            if self._shorter:
                self._shorter(sensed=last, later=i != which[0])
            else:
                mjw.step(self._model, self._data)
        option.disableflags = flags

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
        if name not in (*known, GRAVITY):
            raise ModelError(unknown("per-world model field", name, known, "mujoco-warp's Model"))


def make_model(
    model: mujoco.MjModel, terrain: Terrain | None = None, batch_sizes: dict[str, int] | None = None
) -> mjw.Model:
    """The model on the current device. With a ``terrain`` our own contacts replace those of its height field."""
    if terrain is None:
        return mjw.put_model(model, batch_sizes=batch_sizes)
    touch, model = touch_ground(model, model.geom(GROUND).id, terrain), copy.copy(model)
    model.geom(GROUND).contype, model.geom(GROUND).conaffinity = 0, 0
    put = mjw.put_model(model, batch_sizes=batch_sizes)
    put.callback.contactfilter = touch
    return put


def record_warp(fn: Callable[[], None], device: wp.Device) -> Callable[[], None]:
    """Record ``fn``, which only launches warp kernels. On a CPU a replay takes a tenth of the time of the launches."""
    with wp.ScopedDevice(device), wp.ScopedCapture(device=device) as capture:
        fn()
    graph = capture.graph
    assert graph is not None
    return lambda: wp.capture_launch(graph)
