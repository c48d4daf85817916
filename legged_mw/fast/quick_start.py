"""What makes a program start quickly: garbage is left alone, the GPU opens beside the imports, torch's compiler waits until it is used.

tensordict marks three functions for torch's compiler as it is imported, and torch's optimizers mark their methods at the first
call. Either imports ``torch._dynamo``, some 900 modules, and nothing in a training compiles. So a stand-in notes the marks. Whoever
asks it for anything else gets the compiler itself, with the marks made.

``Tensor.backward(gradient)`` compares two shapes by way of symbolic ones, which imports sympy, some 470 modules. A second stand-in
compares shapes of plain numbers.

Of a training of two iterations on a CPU the stand-ins take 6.7 s of CPU time to 3.7, garbage left alone another 1.0 (medians of six).
"""

from __future__ import annotations

import ctypes
import gc
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from threading import RLock, Thread
from types import ModuleType
from typing import Any

_COMPILER = "torch._dynamo"
_SHAPES = "torch.fx.experimental.symbolic_shapes"
# the first and last version of torch that this was tried with; others import as they always did
_KNOWN = (2, 11), (2, 13)
_DISABLED = "__dynamo_disable"  # where torch/_compile.py keeps what `disable` gave it

Marked = Callable[..., Any]


def begin(gpu: str | None = "cpu") -> None:
    """To be called first, before torch is imported. From here until ``settle`` of utils/machine no garbage is collected.

    ``gpu`` is the device that was asked for: "cpu", "cuda:0", or None for the GPU of this process, if there is one.
    """
    if "torch" in sys.modules:
        return  # too late to gain from it: another program calls this one
    gc.disable()  # a start makes a million objects that stay; to look through them again and again takes a third of it
    index = os.environ.get("LOCAL_RANK", "0") if gpu is None else gpu.removeprefix("cuda").removeprefix(":") or "0"
    if index.isdecimal():  # no other name is one of a GPU
        Thread(target=open_gpu, args=(int(index),), daemon=True).start()
    put_off_compiler()


def open_gpu(index: int) -> bool:
    """Make the context of a GPU, which torch and warp share and then find; False where there is none. Python runs on meanwhile."""
    try:
        cuda = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    device, context = ctypes.c_int(), ctypes.c_void_p()
    calls = (
        (cuda.cuInit, 0),
        (cuda.cuDeviceGet, ctypes.byref(device), index),
        (cuda.cuDevicePrimaryCtxRetain, ctypes.byref(context), device),
    )
    return all(call(*args) == 0 for call, *args in calls)  # what fails is told by torch, which asks the same again


def put_off_compiler() -> bool:
    """Put stand-ins where torch's compiler would be; False if that is there already, or torch is of an unknown version."""
    import torch

    version = tuple(int(part) for part in torch.__version__.split(".")[:2])
    if {_COMPILER, _SHAPES} & sys.modules.keys() or not _KNOWN[0] <= version <= _KNOWN[1]:
        return False
    shapes = _Shapes(_SHAPES, "fx/experimental/symbolic_shapes.py")
    sys.modules[_COMPILER], sys.modules[_SHAPES] = _Compiler(_COMPILER, "_dynamo/__init__.py"), shapes
    package, _, name = _SHAPES.rpartition(".")
    # as an import does; torch itself looks for its compiler in sys.modules
    setattr(importlib.import_module(package), name, shapes)
    sys.meta_path.insert(0, _Found())
    return True


class _StandIn(ModuleType):
    """Stands for a module, which is imported when something is asked for that this has not."""

    _lock = RLock()  # one for all: each of the modules imports the other

    def __init__(self, name: str, file: str) -> None:
        super().__init__(name)
        self.__file__ = str(Path(sys.modules["torch"].__file__ or "").parent / file)  # inspect walks over all files
        self.__spec__ = ModuleSpec(name, None, origin=self.__file__)  # for importlib.util.find_spec

    def __getattr__(self, name: str) -> Any:  # also `__path__`, which is asked for before a module inside is imported
        return getattr(self._real(), name)

    def _real(self) -> ModuleType:
        with self._lock:
            if sys.modules.get(self.__name__) is self:
                del sys.modules[self.__name__]
                self._hand_over(importlib.import_module(self.__name__))
        return sys.modules[self.__name__]

    def _hand_over(self, module: ModuleType) -> None: ...


class _Shapes(_StandIn):
    """Two functions of torch's symbolic shapes, for shapes of plain numbers."""

    def __getattr__(self, name: str) -> Any:
        if name == "__path__":  # is asked for by `from`: no module is inside of this one
            raise AttributeError(name)
        return super().__getattr__(name)

    def sym_eq(self, x: Any, y: Any) -> Any:
        plain = isinstance(x, tuple) and isinstance(y, tuple) and all(type(n) is int for n in (*x, *y))
        return x == y if plain else self._real().sym_eq(x, y)

    def expect_true(self, a: Any, skip: int = 0) -> bool:
        return a if type(a) is bool else self._real().expect_true(a, skip + 1)


class _Rules(_StandIn):
    """The compiler's rules, of which a process group clears what was looked up."""

    def clear_lru_cache(self) -> None:
        """Nothing was."""

    def _real(self) -> ModuleType:
        return importlib.import_module(self.__name__)


class _Compiler(_StandIn):
    """Notes marks, which mean nothing until something is compiled; asked for anything else it imports the compiler."""

    def __init__(self, name: str, file: str) -> None:
        super().__init__(name, file)
        self._marks = list[tuple[str, Marked]]()
        self.trace_rules: ModuleType = _Rules(f"{name}.trace_rules", "_dynamo/trace_rules.py")

    def allow_in_graph(self, fn: Marked) -> Marked:
        self._marks.append(("allow_in_graph", fn))
        return fn

    def assume_constant_result(self, fn: Marked) -> Marked:
        self._marks.append(("assume_constant_result", fn))
        return fn

    def disable(self, fn: Any = None, recursive: bool = True, **more: Any) -> Any:
        """As torch/_compile.py calls it, which asks again once what it was given is deleted."""
        if fn is None or more != {"wrapping": False}:
            return self._real().disable(fn, recursive, **more)
        self._marks.append((_DISABLED, fn))
        return fn

    def graph_break(self, msg: str = "") -> None:
        """Nothing is compiled, and so nothing is broken off."""

    def _hand_over(self, module: ModuleType) -> None:
        for name, fn in self._marks:
            if name != _DISABLED:
                getattr(module, name)(fn)
            elif getattr(fn, _DISABLED, None) is fn:
                delattr(fn, _DISABLED)
        self._marks.clear()


class _Found:
    """A finder, and loader, of modules that came with the compiler while one of them was looked for: they are not run twice."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        there = name.startswith(f"{_COMPILER}.") and target is None and name in sys.modules
        return ModuleSpec(name, self, origin=sys.modules[name].__file__) if there else None  # type: ignore[arg-type]

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return sys.modules[spec.name]

    def exec_module(self, module: ModuleType) -> None:
        """It has run."""
