"""Fails, on a CPU, on what a recorded step may not do on a GPU: ask the host, copy from it, or depend on data for a shape."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from legged_mw.utils.math import maybe_any

# Seen by name, because on a CPU some of them reach no kernel at all.
_HOST_READS = {"item", "tolist", "cpu", "numpy", "__array__", "__dlpack__", "__repr__", "__str__", "__format__", "__contains__"}
_HOST_READS |= {"__bool__", "__int__", "__float__", "__complex__", "__index__", "is_nonzero"}
_HOST_WRITES = {"tensor", "as_tensor", "asarray", "scalar_tensor", "new_tensor", "cuda", "pin_memory"}
_FACTORIES = {"empty", "zeros", "ones", "full", "eye", "arange", "linspace", "rand", "randn", "randint", "randperm", "normal"}
# Kernels that read a value to the host, or whose result has as many elements as the data say.
_READING = {"_local_scalar_dense", "equal", "allclose", "histc", "bincount", "_linalg_check_errors"}
_DATA_SHAPED = {"nonzero", "masked_select", "_unique", "_unique2", "unique_dim", "unique_consecutive", "unique_dim_consecutive"}
_INDEXED = {"index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index", "_unsafe_index_put"}


class NotRecordable(AssertionError):
    """A call that a recorded step may not make; raised where it is made, so that the traceback names the line."""


class _FunctionGuard(TorchFunctionMode):
    """What Python calls torch by."""

    def __torch_function__(self, func: Callable[..., Any], types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        name, kwargs = getattr(func, "__name__", ""), kwargs or {}
        if name in _HOST_READS:
            raise NotRecordable(f"host read: {name}")
        if name in _HOST_WRITES or (name == "to" and _moves(args[1:], kwargs)):
            raise NotRecordable(f"copy between host and device: {name}")
        tensors = any(isinstance(arg, Tensor) for arg in args)  # normal(mean, std) takes its device from them
        if name in _FACTORIES and func is getattr(torch, name) and not tensors and not {"device", "out"} & kwargs.keys():
            raise NotRecordable(f"created on the host: {name} without a device")
        return func(*args, **kwargs)


class _DispatchGuard(TorchDispatchMode):
    """What torch itself runs, however it was called."""

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        name, overload = func.overloadpacket.__name__, func._overloadname
        if name in _READING:
            raise NotRecordable(f"host read: aten.{name}")
        # a number assigned through an index is lifted too, without a copy: it has no dimension
        if name == "lift_fresh" and args[0].dim() > 0:
            raise NotRecordable("host data made a tensor: a list or array as data or as an index")
        if name in _DATA_SHAPED or (name, overload) == ("repeat_interleave", "Tensor"):
            raise NotRecordable(f"data-dependent shape: aten.{name}")
        if name == "normal" and overload in ("Tensor_Tensor", "float_Tensor"):
            raise NotRecordable("host read: normal checks the sign of a tensor of deviations")
        if name in _INDEXED and any(index is not None and index.dtype in (torch.bool, torch.uint8) for index in args[1]):
            raise NotRecordable(f"boolean mask as an index: aten.{name}")
        return func(*args, **(kwargs or {}))


def _moves(args: tuple, kwargs: dict[str, Any]) -> bool:
    """Whether arguments of ``Tensor.to`` name a device, not only a dtype; another tensor names its device."""
    return any(isinstance(value, str | int | torch.device | Tensor) and not isinstance(value, bool) for value in [*args, *kwargs.values()])


@contextmanager
def recordable() -> Iterator[None]:
    """Inside, torch calls that a CUDA graph could not record raise NotRecordable; what only a CPU would ask is not asked."""
    with pytest.MonkeyPatch.context() as patch, _FunctionGuard(), _DispatchGuard():
        for module in [m for m in sys.modules.values() if getattr(m, "maybe_any", None) is maybe_any]:
            patch.setattr(module, "maybe_any", lambda mask: True)
        yield
