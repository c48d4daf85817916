"""Detect on a CPU what a CUDA graph cannot record: reads to the host, copies from it, shapes that depend on data.

On a CPU all tensors are on one device. So ``Births`` notes the tensors that the user's code makes without a device.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from legged_mw.utils import math
from legged_mw.utils.errors import NotRecordable, is_library, line_of

# Found by name, because on a CPU some of them start no kernel.
_CONDITIONS = {"__bool__", "is_nonzero", "__contains__"}
_PRINTS = {"__repr__", "__str__", "__format__"}
_HOST_READS = {
    "item",
    "tolist",
    "cpu",
    "numpy",
    "__array__",
    "__dlpack__",
    "__int__",
    "__float__",
    "__complex__",
    "__index__",
}
_HOST_WRITES = {"tensor", "as_tensor", "asarray", "scalar_tensor", "new_tensor"}
_MOVES = {"cuda", "pin_memory"}
_FACTORIES = {
    "empty",
    "zeros",
    "ones",
    "full",
    "eye",
    "arange",
    "linspace",
    "rand",
    "randn",
    "randint",
    "randperm",
    "normal",
}
# Kernels that read a value to the host; below, kernels with a result of a size that depends on data.
_READING = {"_local_scalar_dense", "equal", "allclose", "histc", "bincount", "_linalg_check_errors"}
_READING |= {"_linalg_eigh", "_linalg_svd", "linalg_eig", "linalg_lstsq"}  # only on a GPU
_DATA_SHAPED = {
    "nonzero",
    "masked_select",
    "_unique",
    "_unique2",
    "unique_dim",
    "unique_consecutive",
    "unique_dim_consecutive",
}
_INDEXED = {"index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index", "_unsafe_index_put"}


class Guard:
    """The state of the watch. While ``on``, forbidden calls raise, and ``on_write`` gets every tensor that is written.

    ``on_host``: address -> (tensor that would be on the host, its fault, its line). The tensor reserves the address.
    """

    def __init__(self) -> None:
        self.on = False
        self.on_host: dict[int, tuple[Tensor, str, str]] = {}
        self.on_write: Callable[[Tensor], None] | None = None

    @contextmanager
    def set(self, **values: Any) -> Iterator[None]:
        """Set ``on`` or ``on_write`` inside of a with statement."""
        before = {name: getattr(self, name) for name in values}
        vars(self).update(values)
        try:
            yield
        finally:
            vars(self).update(before)


class Births(TorchFunctionMode):
    """Notes tensors that the user's code makes without a device, and tensors computed from these alone."""

    def __init__(self, guard: Guard) -> None:
        super().__init__()
        self._known = guard.on_host

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple = (), kwargs: dict | None = None
    ) -> Any:
        kwargs = kwargs or {}
        result, name = func(*args, **kwargs), getattr(func, "__name__", "")
        given_one = name in _HOST_WRITES and kwargs.get("device") is not None  # as_tensor(x, device=...)
        if given_one or (name == "to" and _moves(args[1:], kwargs)):  # on a CPU the same tensor
            return result.clone() if _address(result) in self._known else result
        made = [
            value for value in (result if isinstance(result, tuple | list) else [result]) if isinstance(value, Tensor)
        ]
        fresh = [value for value in made if _address(value) not in self._known] if kwargs.get("device") is None else []
        given = (
            [self._known.get(_address(value)) for value in tree_leaves((args, kwargs)) if isinstance(value, Tensor)]
            if fresh
            else []
        )
        source = given[0] if given and all(given) else None
        if (
            not given
            and name in _FACTORIES | _HOST_WRITES
            and func is getattr(torch, name, None)
            and (where := _users_line())
        ):
            source = (
                None,
                f"{name}() without a device makes a tensor on the host, which the step reads; add device=self.device",
                where,
            )
        if source:
            self._known.update({_address(value): (value, *source[1:]) for value in fresh if value.numel()})
        return result


class _FunctionGuard(TorchFunctionMode):
    """Checks the calls of torch's Python functions."""

    def __init__(self, guard: Guard) -> None:
        super().__init__()
        self.guard = guard

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple = (), kwargs: dict | None = None
    ) -> Any:
        kwargs = kwargs or {}
        if self.guard.on and (fault := _breach_of_call(func, args, kwargs)):
            raise NotRecordable(fault)
        return func(*args, **kwargs)


class _DispatchGuard(TorchDispatchMode):
    """Checks the kernels that torch runs."""

    def __init__(self, guard: Guard) -> None:
        super().__init__()
        self.guard = guard

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs = kwargs or {}
        if self.guard.on and (found := _breach_of_kernel(func, args)):
            raise NotRecordable(found)
        if self.guard.on and self.guard.on_host:
            for value in tree_leaves((args, kwargs)):
                # a kernel takes a tensor without dimensions from the host too, except to copy it or to write to it
                kernel = func.overloadpacket.__name__
                held = kernel == "copy_" or (kernel.endswith("_") and value is args[0])
                number = isinstance(value, Tensor) and value.dim() == 0 and not held
                if isinstance(value, Tensor) and not number and (known := self.guard.on_host.get(_address(value))):
                    raise NotRecordable(*known[1:])
        if self.guard.on and self.guard.on_write:
            for tensor in written(func, args, kwargs):
                self.guard.on_write(tensor)
        return func(*args, **kwargs)


def written(func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Iterator[Tensor]:
    """The tensor arguments that the kernel ``func`` writes."""
    for i, argument in enumerate(func._schema.arguments):
        if argument.alias_info is not None and argument.alias_info.is_write:
            given = args[i] if i < len(args) else kwargs.get(argument.name)
            yield from (value for value in tree_leaves(given) if isinstance(value, Tensor))


def _breach_of_call(func: Callable[..., Any], args: tuple, kwargs: dict[str, Any]) -> str:
    """The fault of a call, and what to write instead; "" if there is none."""
    name = getattr(func, "__name__", "")
    call = f"{name.strip('_')}()"
    if name in ("__getitem__", "__setitem__") and any(
        map(_is_scalar_index, args[1] if isinstance(args[1], tuple) else args[1:2])
    ):
        write = "write x.index_select(dim, index.view(1)), or use a Python int"
        return f"a tensor without dimensions as an index is read to the host; {write}"
    if name in _CONDITIONS:
        return "a tensor as a condition (if, and, not, in) is read to the host; write torch.where(condition, a, b)"
    if name in _PRINTS:
        return "a tensor as text is read to the host; print it between steps"
    if name in _HOST_READS:
        return f"{call} reads a tensor to the host; keep it a tensor and compute with that"
    if name in _HOST_WRITES:
        return f"{call} copies data from the host; make the tensor once, in _init_buffers()"
    if name in _MOVES or (name == "to" and _moves(args[1:], kwargs)):
        return f"{call} copies between host and device; make the tensor on self.device, in _init_buffers()"
    tensors = any(isinstance(arg, Tensor) for arg in args)  # normal(mean, std) takes the device from these tensors
    if name in _FACTORIES and func is getattr(torch, name) and not tensors and not {"device", "out"} & kwargs.keys():
        return f"{call} without a device makes a tensor on the host; add device=self.device"
    return ""


def _breach_of_kernel(func: Any, args: tuple) -> str:
    """The fault of a kernel, and what to write instead; "" if there is none."""
    name, overload = func.overloadpacket.__name__, func._overloadname
    if name in _READING:
        return f"{name.strip('_')} reads a tensor to the host; keep it a tensor and compute with that"
    # a number that is assigned through an index is lifted too, but without a copy
    if name == "lift_fresh" and args[0].dim() > 0:
        return "a list or an array, as data or as an index, copies from the host; make it a tensor once, in _init_buffers()"
    if name == "multinomial":
        write = "write (weights / torch.empty_like(weights).exponential_()).argmax(dim=1)"
        return f"multinomial reads a tensor to the host; {write}"
    if name in _DATA_SHAPED or (name, overload) == ("repeat_interleave", "Tensor"):
        return f"{name.strip('_')} has a shape that depends on data; keep every row, and write torch.where(mask, a, b)"
    if name in ("masked_fill", "masked_fill_") and overload.startswith("Tensor"):
        return f"{name.strip('_')} reads its value to the host; write assign(x, mask, value), or a Python number"
    if name == "normal" and overload in ("Tensor_Tensor", "float_Tensor"):
        return "normal reads the sign of a tensor of deviations to the host; write mean + std * torch.randn_like(std)"
    if name in _INDEXED and any(index is not None and index.dtype in (torch.bool, torch.uint8) for index in args[1]):
        write = "write torch.where(mask, a, b), or assign(x, mask, value)"
        return f"a mask as an index has a shape that depends on data; {write}"
    return ""


def _address(tensor: Tensor) -> int:
    return tensor.untyped_storage().data_ptr()


def _users_line() -> str:
    """The running line of the user's code; "" if our code runs, even if the user's code called it."""
    frame: FrameType | None = sys._getframe()
    while frame and is_library(frame.f_globals.get("__name__", ""), frame.f_code.co_filename):
        frame = frame.f_back
    if not frame or frame.f_globals.get("__name__", "").startswith("legged_mw."):
        return ""
    return line_of(frame.f_code, frame.f_lineno)


def _is_scalar_index(index: object) -> bool:
    return (
        isinstance(index, Tensor)
        and index.dim() == 0
        and not index.is_floating_point()
        and index.dtype not in (torch.bool, torch.uint8)
    )


def _moves(args: tuple, kwargs: dict[str, Any]) -> bool:
    """Whether the arguments of ``Tensor.to`` name a device, itself or by another tensor, and not only a dtype."""
    return any(
        isinstance(value, str | int | torch.device | Tensor) and not isinstance(value, bool)
        for value in [*args, *kwargs.values()]
    )


@contextmanager
def recordable(guard: Guard | None = None) -> Iterator[None]:
    """Inside, calls that a CUDA graph cannot record raise NotRecordable, and ``maybe_any`` answers as on a GPU."""
    guard = guard or Guard()
    # modules of ours that imported the function; read by __dict__, since getattr would load lazy modules
    held = [(module, getattr(module, "__dict__", {})) for module in list(sys.modules.values())]
    users = [module for module, names in held if names.get("maybe_any") is math.maybe_any]
    original = math.maybe_any
    try:
        for module in users:
            vars(module)["maybe_any"] = lambda mask: True
        with guard.set(on=True), _FunctionGuard(guard), _DispatchGuard(guard):
            yield
    finally:
        for module in users:
            vars(module)["maybe_any"] = original
