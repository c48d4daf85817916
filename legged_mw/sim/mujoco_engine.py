"""MuJoCo's own engine on a thread pool of the CPU, with fixed torch tensors.

The engine's rows are float64, the tensors float32. Only ``step`` copies between them.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Sequence

import mujoco
import numpy as np
import torch
from mujoco.batch import MODEL_FIELDS, Batch, SimulationError
from torch import Tensor

from legged_mw.sim.simulation import GRAVITY, Simulation
from legged_mw.utils.errors import ModelError, unknown
from legged_mw.utils.machine import usable_cores
from legged_mw.utils.opaque import not_traced

_STATE, _WRITTEN = ("qpos", "qvel"), ("ctrl", "xfrc_applied")  # a step reads both and writes the state
_READ = ("sensordata", "actuator_force", "site_xpos", "xquat")  # computed by a step
_FULL = [int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_CNSTRFULL)]


class MujocoSimulation(Simulation):
    """``Simulation`` with MuJoCo's own engine.

    The same calls give the same bits for any number of threads. If MuJoCo cannot step a world, its ``qpos`` is NaN.
    """

    engine, device = "mujoco", "cpu"

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, *, threads: int = 0, world_fields: Sequence[str] = ()
    ) -> None:
        """Allocate ``num_envs`` worlds. ``threads``: 0 for one per core."""
        self.num_envs = num_envs
        model = copy.copy(model)
        # without this flag MuJoCo resets a broken world by itself
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        _keep_quiet()
        self._batch = Batch(model, num_envs, threads or usable_cores())
        self._start = self._batch.state[0].copy()  # the model's initial state
        pairs = {name: self._adopt(name) for name in (*_STATE, *_WRITTEN, *_READ)}  # (tensor, the engine's rows)
        self._into = [pairs[name] for name in (*_STATE, *_WRITTEN)]  # copied before a step
        self._out = [pairs[name] for name in (*_STATE, *_READ)]  # copied after a step
        self._cleared = [tensor for name, (tensor, _) in pairs.items() if name != "qpos"]
        self._field_rows = {name: self._expand(name) for name in world_fields}
        self._fields = {name: rows.float() for name, rows in self._field_rows.items()}
        self._written = {name: tensor._version for name, tensor in self._fields.items()}
        self._failed, self._reason = np.zeros(num_envs, dtype=bool), ""  # worlds that MuJoCo could not step
        self._qpos0 = torch.tensor(model.qpos0, dtype=torch.float)

    @not_traced
    def step(self, substeps: int = 1, before: Callable[[int], None] | None = None) -> None:
        if before is not None:  # then the state is also rounded to float32 between substeps
            for i in range(substeps):
                before(i)
                self.step()
            return
        for tensor, rows in self._into:
            rows.copy_(tensor)
        self._write_fields()
        refused = None
        try:
            self._batch.step(nstep=substeps)
        except SimulationError as error:  # all other worlds are stepped
            refused, self._failed[error.ids], self._reason = error.ids, True, " ".join(str(error).split())
        for tensor, rows in self._out:
            tensor.copy_(rows)
        if refused is not None:
            self.qpos[torch.from_numpy(refused).long()] = torch.nan

    @not_traced
    def reset(self, mask: Tensor) -> None:
        which = mask.numpy()
        if not which.any():
            return
        self._batch.state[which] = self._start  # includes the solver's warm start and the time
        worlds = mask.nonzero()[:, 0]
        self.qpos[worlds] = self._qpos0
        for tensor in self._cleared:
            tensor[worlds] = 0.0

    def memory(self) -> dict[str, Tensor]:
        own = {name: getattr(self, name) for name in (*_STATE, *_WRITTEN, *_READ)}
        rows = {"rows": torch.from_numpy(self._batch.state), "failed": torch.from_numpy(self._failed)}
        return {**own, **rows, **{f"model.{name}": value for name, value in self._fields.items()}}

    def set_constants(self) -> None:
        self._write_fields()
        self._batch.set_const()

    def actuator_velocity(self) -> Tensor:
        return _tensor(self._batch.bind("actuator_velocity"))

    def overflowed_worlds(self) -> Tensor:
        return torch.tensor(float((self._failed | self._full()).sum()))

    def overflow_report(self) -> str:
        of = f"of {self.num_envs} worlds"
        if self._failed.any():
            return f"MuJoCo could not step {self._failed.sum()} {of}: {self._reason}"
        if (full := self._full()).any():
            advice = "contacts or constraints do not fit; raise <size memory=...> in the MJCF"
            return f"simulator overflow in {full.sum()} {of}: {advice}"
        return ""

    def _write_fields(self) -> None:
        """Copy the fields that were written since the last call. The others keep their float64 values."""
        for name, tensor in self._fields.items():
            if tensor._version != self._written[name]:
                self._field_rows[name].copy_(tensor)
                self._written[name] = tensor._version

    def _full(self) -> np.ndarray:
        """(N,) True for worlds that dropped a contact or constraint since construction."""
        return (self._batch.warning[:, _FULL, 1] > 0).any(axis=1)

    def _adopt(self, name: str) -> tuple[Tensor, Tensor]:
        """Make the tensor of a field of MjData; returns it and the engine's rows."""
        rows = _tensor(self._batch.bind(name))
        tensor = rows.float()
        setattr(self, name, tensor)
        return tensor, rows

    def _expand(self, name: str) -> Tensor:
        """The engine's rows (N, ...) of a model field. Raises ModelError for an unknown field."""
        arrays = {field: getattr(self._batch.model, field, None) for field in sorted(MODEL_FIELDS)}
        known = [field for field, array in arrays.items() if getattr(array, "dtype", None) == np.float64]
        if name not in (*known, GRAVITY):
            raise ModelError(unknown("per-world model field", name, known, "MuJoCo's Model"))
        return _tensor(self._batch.expand(name))


def _keep_quiet() -> None:
    """Stop MuJoCo's messages and log file on broken worlds: the caller counts and resets such worlds."""
    config = mujoco.MjLogConfig.get()
    config.logto_console = config.logto_file = False
    config.set()


def _tensor(rows: np.ndarray) -> Tensor:
    """A tensor that shares the memory of ``rows``."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns of read-only rows
        return torch.from_numpy(rows)
