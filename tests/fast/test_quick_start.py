"""legged_mw/fast/quick_start.py: torch's compiler waits until somebody asks for it, and is then what it always was."""

from __future__ import annotations

import gc
import subprocess
import sys
from collections.abc import Callable
from types import SimpleNamespace

import pytest
import torch

from legged_mw import ROOT
from legged_mw.fast import quick_start
from legged_mw.utils.machine import settle

ASKED_LATER = """
import os, sys, gc
from legged_mw.utils.machine import settle
from legged_mw.fast import quick_start
quick_start.begin()
assert not gc.isenabled()
import inspect, torch, tensordict
network = torch.nn.Linear(2, 1)
optimizer = torch.optim.Adam(network.parameters())
network(torch.ones(3, 2)).sum().backward()
optimizer.step()
optimizer.zero_grad()
output, of_output = network(torch.ones(3, 2)), torch.full((3, 1), 2.0)
output.backward(of_output)
assert network.bias.grad == 6.0
output = network(torch.ones(3, 2))
torch.autograd.backward([output, network.weight.sum()], [of_output, None])
try:
    network(torch.ones(3, 2)).backward(torch.ones(3, 2))
except RuntimeError as error:
    assert "grad_output[0] has a shape of torch.Size([3, 2]) and output[0] has a shape of torch.Size([3, 1])" in str(error)
else:
    raise AssertionError
inspect.getmodule(inspect.currentframe())  # walks over all modules
import tempfile
group = dict(rank=0, world_size=1, init_method="file://" + tempfile.mktemp())
torch.distributed.init_process_group("gloo", **group)
torch.distributed.destroy_process_group()
later = sys.modules["torch._dynamo"]
assert later is torch._dynamo and "torch._dynamo.eval_frame" not in sys.modules and "sympy" not in sys.modules
assert os.path.isfile(later.__file__) and os.path.isfile(later.trace_rules.__file__)
settle()
assert gc.isenabled() and gc.get_freeze_count() > 10_000

marked = torch.optim.Optimizer.zero_grad.__wrapped__
assert getattr(marked, "__dynamo_disable") is marked
import torch._dynamo.config as config  # as `import` meets it, and as torch.compile does
real = sys.modules["torch._dynamo"]
assert later.trace_rules.lookup is real.trace_rules.lookup and real.trace_rules is sys.modules["torch._dynamo.trace_rules"]
assert real is torch._dynamo is not later and real.config is config is sys.modules["torch._dynamo.config"]
assert config.__spec__.loader is not None and later.config is config
assert real.eval_frame.config is config  # it has run once
assert not hasattr(marked, "__dynamo_disable")
from tensordict.base import _foreach_copy_compiled as first
assert id(first) in real.trace_rules._allowed_callable_ids
from torch.fx.experimental import symbolic_shapes as shapes
assert shapes is sys.modules[shapes.__name__] and shapes.ShapeEnv and shapes.__spec__.origin and "sympy" in sys.modules
network(torch.ones(3, 2)).backward(of_output)
compiled = torch.compile(lambda x: x.sin() + 1, backend="eager")
assert torch.equal(compiled(torch.ones(2)), torch.ones(2).sin() + 1)
optimizer.zero_grad()
assert getattr(marked, "__dynamo_disable") is not marked
print("as ever")
"""


def test_the_compiler_is_there_when_it_is_asked_for() -> None:
    done = subprocess.run([sys.executable, "-c", ASKED_LATER], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout == "as ever\n", done.stderr


SHAPES = """
import sys
from legged_mw.fast import quick_start
quick_start.begin()
import torch
from torch.fx.experimental.symbolic_shapes import expect_true, sym_eq
assert sym_eq(torch.Size([2, 3]), torch.Size([2, 3])) is True and sym_eq((2, 3), (2,)) is False and expect_true(False) is False
import importlib.util
import torch.fx.experimental.symbolic_shapes
shapes = torch.fx.experimental.symbolic_shapes
assert not hasattr(shapes, "__path__") and all(importlib.util.find_spec(name) for name in ("torch._dynamo", shapes.__name__))
assert "sympy" not in sys.modules and shapes.guard_or_false(True) is True and "sympy" in sys.modules
assert torch.fx.experimental.symbolic_shapes is sys.modules[shapes.__name__] is not shapes
from torch.fx.experimental.symbolic_shapes import ShapeEnv
assert "sympy" in sys.modules
symbol = ShapeEnv().create_unbacked_symint()
assert type(sym_eq((symbol, 2), (3, 2))) is torch.SymBool and sym_eq([symbol], [3, 2]) is False
assert expect_true(symbol == 3) is True
print("as ever")
"""


def test_symbolic_shapes_are_there_when_they_are_asked_for() -> None:
    """What has compared numbers until then compares symbols, too."""
    done = subprocess.run([sys.executable, "-c", SHAPES], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout == "as ever\n", done.stderr


def test_torch_is_one_that_this_was_tried_with() -> None:
    """A later torch than that imports its compiler at every start: look at torch/_compile.py, torch/optim, and raise ``_KNOWN``."""
    version = tuple(int(part) for part in torch.__version__.split(".")[:2])
    assert quick_start._KNOWN[0] <= version <= quick_start._KNOWN[1]


def test_a_program_that_others_call_changes_nothing() -> None:
    before = sys.modules.get("torch._dynamo"), list(sys.meta_path), gc.get_freeze_count()
    quick_start.begin("cuda:0")
    assert gc.isenabled()
    settle()
    assert (sys.modules.get("torch._dynamo"), list(sys.meta_path), gc.get_freeze_count()) == before


@pytest.mark.parametrize(
    ("asked", "opened"), [(None, [3]), ("cuda", [0]), ("cuda:2", [2]), ("cpu", []), ("cuda:x", []), ("tpu", [])]
)
def test_the_gpu_that_was_asked_for_is_opened(
    asked: str | None, opened: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = list[int]()
    monkeypatch.setenv("LOCAL_RANK", "3")
    monkeypatch.delitem(sys.modules, "torch")
    monkeypatch.setattr(quick_start, "open_gpu", found.append)
    monkeypatch.setattr(quick_start, "put_off_compiler", lambda: True)
    monkeypatch.setattr(quick_start.gc, "disable", lambda: None)
    quick_start.begin(asked)
    assert found == opened


def test_a_gpu_that_is_not_there_is_not_opened() -> None:
    assert quick_start.open_gpu(99) is False


@pytest.mark.parametrize("gpus", [3, 2])
def test_a_gpu_is_opened_by_three_calls_of_the_driver(gpus: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """0 is success. A call that fails, here of the third GPU of two, is the last."""
    asked = list[tuple[str, object]]()

    def call(name: str, result: int = 0) -> Callable[..., int]:
        return lambda *args: asked.append((name, args[-1])) or result

    driver = SimpleNamespace(
        cuInit=call("init"), cuDeviceGet=call("get", 0 if gpus > 2 else 101), cuDevicePrimaryCtxRetain=call("retain")
    )
    monkeypatch.setattr(quick_start.ctypes, "CDLL", lambda _: driver)
    assert quick_start.open_gpu(2) is (gpus > 2)
    assert asked[:2] == [("init", 0), ("get", 2)] and len(asked) == gpus
