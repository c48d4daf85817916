"""Start a program faster: no garbage collection, a CUDA context in parallel with imports, torch's compiler on demand.

tensordict (on import) and torch's optimizers (on the first call) mark functions for torch's compiler. Both import
``torch._dynamo``, about 900 modules, although no training compiles. A stand-in for the module records the marks. Any
other use of the stand-in imports the compiler and applies the marks.

``Tensor.backward(gradient)`` compares shapes as symbolic shapes, which imports sympy, about 470 modules. A second
stand-in compares shapes of plain numbers.

In a training of two iterations on a CPU, the stand-ins reduce 6.7 s of CPU time to 3.7 s. No garbage collection saves
another 1.0 s (medians of six).
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
# the first and last tested version of torch; others get no stand-ins
_KNOWN = (2, 11), (2, 13)
_DISABLED = "__dynamo_disable"  # attribute in which torch/_compile.py caches the result of `disable`

Marked = Callable[..., Any]


def begin(gpu: str | None = "cpu") -> None:
    """Call this before the import of torch. Garbage collection stays off until ``settle`` of utils/machine.

    ``gpu``: the requested device "cpu" or "cuda:0"; None: the GPU of this process, if it has one.
    """
    if "torch" in sys.modules:
        return  # torch is already imported, because another program calls this one
    gc.disable()  # a start makes a million permanent objects; scanning them takes a third of the time
    index = os.environ.get("LOCAL_RANK", "0") if gpu is None else gpu.removeprefix("cuda").removeprefix(":") or "0"
    if index.isdecimal():  # other names are not GPUs
        Thread(target=open_gpu, args=(int(index),), daemon=True).start()
    put_off_compiler()


def open_gpu(index: int) -> bool:
    """Create the primary context of a GPU, which torch and warp share; False without a GPU. Other threads continue."""
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
    return all(call(*args) == 0 for call, *args in calls)  # torch makes the same calls later and reports a failure


def put_off_compiler() -> bool:
    """Install stand-ins for torch's compiler; False if it is already imported, or if torch's version is unknown."""
    import torch

    version = tuple(int(part) for part in torch.__version__.split(".")[:2])
    if {_COMPILER, _SHAPES} & sys.modules.keys() or not _KNOWN[0] <= version <= _KNOWN[1]:
        return False
    shapes = _Shapes(_SHAPES, "fx/experimental/symbolic_shapes.py")
    sys.modules[_COMPILER], sys.modules[_SHAPES] = _Compiler(_COMPILER, "_dynamo/__init__.py"), shapes
    package, _, name = _SHAPES.rpartition(".")
    # as an import does; torch looks up its compiler in sys.modules
    setattr(importlib.import_module(package), name, shapes)
    sys.meta_path.insert(0, _Found())
    return True


class _StandIn(ModuleType):
    """A stand-in for a module. It imports the module when an attribute is read that the stand-in lacks."""

    _lock = RLock()  # one lock, because the modules import each other

    def __init__(self, name: str, file: str) -> None:
        super().__init__(name)
        self.__file__ = str(Path(sys.modules["torch"].__file__ or "").parent / file)  # inspect reads it
        self.__spec__ = ModuleSpec(name, None, origin=self.__file__)  # for importlib.util.find_spec

    def __getattr__(self, name: str) -> Any:  # also `__path__`, read before a submodule is imported
        return getattr(self._real(), name)

    def _real(self) -> ModuleType:
        with self._lock:
            if sys.modules.get(self.__name__) is self:
                del sys.modules[self.__name__]
                self._hand_over(importlib.import_module(self.__name__))
        return sys.modules[self.__name__]

    def _hand_over(self, module: ModuleType) -> None: ...


class _Shapes(_StandIn):
    """Two functions of torch's symbolic shapes for plain numbers."""

    def __getattr__(self, name: str) -> Any:
        if name == "__path__":  # `from` reads it: there is no submodule
            raise AttributeError(name)
        return super().__getattr__(name)

    def sym_eq(self, x: Any, y: Any) -> Any:
        plain = isinstance(x, tuple) and isinstance(y, tuple) and all(type(n) is int for n in (*x, *y))
        return x == y if plain else self._real().sym_eq(x, y)

    def expect_true(self, a: Any, skip: int = 0) -> bool:
        return a if type(a) is bool else self._real().expect_true(a, skip + 1)


class _Rules(_StandIn):
    """The compiler's rules; a process group clears their cache."""

    def clear_lru_cache(self) -> None:
        """No effect: there is no cache yet."""

    def _real(self) -> ModuleType:
        return importlib.import_module(self.__name__)


class _Compiler(_StandIn):
    """Records marks, which have no effect until a function is compiled. Any other use imports the compiler."""

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
        """Called by torch/_compile.py, which calls again after its cached result is deleted."""
        if fn is None or more != {"wrapping": False}:
            return self._real().disable(fn, recursive, **more)
        self._marks.append((_DISABLED, fn))
        return fn

    def graph_break(self, msg: str = "") -> None:
        """No effect: nothing is compiled."""

    def _hand_over(self, module: ModuleType) -> None:
        for name, fn in self._marks:
            if name != _DISABLED:
                getattr(module, name)(fn)
            elif getattr(fn, _DISABLED, None) is fn:
                delattr(fn, _DISABLED)
        self._marks.clear()


class _Found:
    """Finds and loads modules that the compiler's import already ran, so that they do not run again."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        there = name.startswith(f"{_COMPILER}.") and target is None and name in sys.modules
        return ModuleSpec(name, self, origin=sys.modules[name].__file__) if there else None  # type: ignore[arg-type]

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return sys.modules[spec.name]

    def exec_module(self, module: ModuleType) -> None:
        """The module has run already."""
