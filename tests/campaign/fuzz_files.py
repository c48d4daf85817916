"""Fuzz the readers of contracts, checkpoints, motions and motor networks, by hand: python tests/campaign/fuzz_files.py MINUTES [READER]

Needs hypothesis (pip install hypothesis). Each example is a good file of which some values, or some bytes, are others. It is read, or
refused by a UserError of one line; nothing else may be raised, take two seconds, or be written outside of the folder. What a contract says
is also walked for a few steps in simulation, if it was read.
"""

# pyright: reportCallIssue=false, reportArgumentType=false, reportMissingImports=false
# (hypothesis hands a composite's first argument over by itself)
from __future__ import annotations

import copy
import io
import os
import shutil
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from legged_mw import ROOT
from legged_mw.deploy.contract import NetworkMotors, checksum, edits, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.simulated import Fleet
from legged_mw.rl.run_folder import save_whole
from legged_mw.rl.runner import Runner, make_runner
from legged_mw.skills.clip import read_clip
from legged_mw.utils.config import load_yaml
from legged_mw.utils.errors import UserError
from legged_mw.utils.motor_network import read_network
from legged_mw.utils.task import load_task

EXAMPLES, SLOW = 50, 2.0  # of a round; [s]
SHIPPED = ROOT / "resources/policies"
NUMBERS = st.one_of(
    st.floats(),
    st.integers(-(10**40), 10**40),
    st.integers(-3, 60),
    st.sampled_from([0, -0.0, 1e9, 1e308, 2**31, 2**63]),
)
VALUES = st.recursive(
    st.one_of(
        NUMBERS,
        st.text(max_size=20),
        st.booleans(),
        st.none(),
        st.sampled_from(["../x", "/etc/passwd", "nan", "FR_hip_joint"]),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=14), st.dictionaries(st.text(max_size=8), inner, max_size=4)),
    max_leaves=8,
)


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of every value inside."""
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in entries:
        yield (*path, key)
        yield from places(item, (*path, key))


@st.composite
def changed(draw: Callable[[Any], Any], good: Any, values: Any = VALUES) -> Any:
    """``good`` with up to three values replaced, dropped, doubled or exchanged."""
    content = copy.deepcopy(good)
    for _ in range(draw(st.integers(1, 3))):
        there = list(places(content))
        if not there:
            break
        *path, last = draw(st.sampled_from(there))
        holder = content
        for key in path:
            holder = holder[key]
        what = draw(st.sampled_from(("put", "put", "put", "drop", "more", "swap")))
        if what == "drop":
            del holder[last]
        elif what == "more" and isinstance(holder, list):
            holder.append(copy.deepcopy(holder[last]))
        elif what == "swap" and isinstance(holder, list):
            holder.reverse()
        else:
            holder[last] = draw(values)
    return content


@st.composite
def damaged(draw: Callable[[Any], Any], good: bytes) -> bytes:
    """``good`` with bytes replaced, cut or repeated."""
    content = bytearray(good)
    for _ in range(draw(st.integers(1, 4))):
        at, length = draw(st.integers(0, len(content))), draw(st.integers(0, 40))
        content[at : at + length] = draw(st.binary(max_size=40))
    return bytes(content)


class Found(Exception):
    """What must not happen."""


def watched(what: str, read: Callable[[], Any]) -> bool:
    """Whether it was read; a refusal is one line. Raises Found for everything else."""
    begun = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            read()
        good = True
    except UserError as error:
        good = False
        if len(f"{error}") > 5000:
            raise Found(f"{what}: a message of {len(f'{error}')} characters") from error
    except Exception as error:
        raise Found(f"{what}: {type(error).__name__}: {error}") from error
    if (took := time.perf_counter() - begun) > SLOW:
        raise Found(f"{what}: {took:.1f} s")
    return good


# ---- the readers: each gives a test that hypothesis calls


def contracts(root: Path, policy: str) -> Callable[[], None]:
    shutil.copytree(SHIPPED / policy, folder := root / policy)
    good = load_yaml(folder / "policy.yaml")
    good.pop("checksum", None)

    def walk() -> None:
        contract = read_contract(folder, edited=True)
        edits(folder)
        fleet, controller = Fleet(folder, contract, 1, threads=1), Controller(folder, contract, 1)
        for _ in range(3):
            fleet.write(controller.act(fleet.read(), np.array([[command.default for command in contract.commands]])))
            fleet.fell()

    @_round
    @given(changed(good), st.booleans())
    def test(said: Any, stamped: bool) -> None:
        if stamped and isinstance(said, dict):
            said = said | {"checksum": checksum(said)}
        (folder / "policy.yaml").write_text(yaml.safe_dump(said, sort_keys=False, allow_unicode=True))
        COUNTS[f"contract {policy}"][watched("contract", walk)] += 1

    return test


def contract_bytes(root: Path) -> Callable[[], None]:
    shutil.copytree(SHIPPED / "go1_flat", folder := root / "bytes")
    good = (folder / "policy.yaml").read_bytes()

    @_round
    @given(damaged(good))
    def test(content: bytes) -> None:
        (folder / "policy.yaml").write_bytes(content)
        COUNTS["contract, bytes"][watched("contract", lambda: read_contract(folder))] += 1

    return test


def small_runner() -> Runner:
    task = load_task("go1_flat")
    for path, value in {
        "env.num_envs": 2,
        "actor.hidden_dims": [4],
        "critic.hidden_dims": [4],
        "perturbation.curriculum": True,
    }.items():
        task.set(path, value)
    runner = make_runner(task.env_class(task.cfg, "cpu"), task.train, None, "cpu")
    for parameter in [p for group in runner.alg.optimizer.param_groups for p in group["params"]]:
        parameter.grad = torch.zeros_like(parameter)
    runner.alg.optimizer.step()
    return runner


TENSORS = st.one_of(
    VALUES,
    st.builds(
        lambda shape, value, dtype: torch.full(shape, value).to(dtype),
        st.lists(st.integers(0, 6), max_size=3),
        st.sampled_from([0.0, 1.0, -1.0, float("nan"), float("inf"), 1e30]),
        st.sampled_from(
            [torch.float32, torch.float64, torch.int64, torch.uint8, torch.bool, torch.float16, torch.complex64]
        ),
    ),
    st.builds(lambda size: torch.zeros(1).expand(size), st.sampled_from([1, 10**6, 10**12])),
)


def saved_checkpoints(root: Path) -> Callable[[], None]:
    runner, file = small_runner(), root / "model_0.pt"
    runner.save(str(file))
    good = torch.load(file, weights_only=True)
    good = {name: dict(value) if isinstance(value, dict) else value for name, value in good.items()}

    @_round
    @given(changed(good, TENSORS))
    def test(content: Any) -> None:
        save_whole(content, file)
        if watched("checkpoint", lambda: runner.load(str(file))):
            weights = [*runner.alg.get_policy().parameters()]
            if not all(bool(weight.isfinite().all()) for weight in weights):
                raise Found("checkpoint: weights that are not finite were loaded")
            watched("optimizer", runner.alg.optimizer.step)
            COUNTS["checkpoint"][True] += 1
            save_whole(good, file)
            runner.load(str(file))
        else:
            COUNTS["checkpoint"][False] += 1

    return test


def checkpoint_bytes(root: Path) -> Callable[[], None]:
    runner, file, old = small_runner(), root / "model_0.pt", io.BytesIO()
    runner.save(str(file))
    sealed = file.read_bytes()
    torch.save(torch.load(file, weights_only=True), old)

    @_round
    @given(st.one_of(damaged(sealed), damaged(old.getvalue())))
    def test(content: bytes) -> None:
        file.write_bytes(content)
        COUNTS["checkpoint, bytes"][watched("checkpoint", lambda: runner.load(str(file)))] += 1

    return test


ARRAYS = st.builds(
    lambda shape, value, dtype: np.full(shape, np.nan_to_num(value) if dtype in ("i8", "u1") else value).astype(dtype),
    st.lists(st.integers(0, 6), max_size=3),
    st.sampled_from([0.0, 1.0, -1.0, 50.0, float("nan"), float("inf"), 1e30]),
    st.sampled_from(["f4", "f8", "i8", "u1", "?", "c8", "U5", "S3"]),
)


def arrays(root: Path, name: str, good: dict[str, Any], read: Callable[[Path], Any]) -> Callable[[], None]:
    file, packed = root / f"{name}.npz", io.BytesIO()
    np.savez_compressed(packed, **good)

    @_round
    @given(st.one_of(changed(good, ARRAYS), damaged(packed.getvalue())))
    def test(content: Any) -> None:
        if isinstance(content, bytes):
            file.write_bytes(content)
        else:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                np.savez(file, **content)
        COUNTS[name][watched(name, lambda: read(file))] += 1

    return test


def motions(root: Path) -> Callable[[], None]:
    whole = dict(np.load(ROOT / "resources/motions/g1_wave.npz"))
    short = {key: value[:20] if value.ndim == 2 else value for key, value in whole.items()}
    return arrays(root, "motion", short, lambda file: read_clip(file).at(50.0).qvel())


def motors(root: Path) -> Callable[[], None]:
    good = {"weight0": np.zeros((8, 6)), "bias0": np.zeros(8), "weight1": np.zeros((1, 8)), "bias1": np.zeros(1)}
    good |= {"activation": np.array("elu"), "frames": np.array([0, 1, 2]), "torque_scale": np.array(2.0)}

    def read(file: Path) -> None:
        NetworkMotors(read_network(file), 2, 12).torque(np.zeros((2, 12)), np.zeros((2, 12)))

    return arrays(root, "motor network", good, read)


def _round(test: Callable[..., None]) -> Callable[[], None]:
    quick = [Phase.explicit, Phase.generate]  # to shrink what is found takes longer than to find it
    relaxed = settings(
        max_examples=EXAMPLES, deadline=None, database=None, phases=quick, suppress_health_check=[*HealthCheck]
    )
    return relaxed(test)  # type: ignore[return-value]


READERS: dict[str, list[Callable[[Path], Callable[[], None]]]] = {
    "contract": [*(lambda root, name=name: contracts(root, name) for name in ("go1_flat", "g1_flat")), contract_bytes],
    "checkpoint": [saved_checkpoints, checkpoint_bytes],
    "motion": [motions, motors],
}
COUNTS: dict[str, dict[bool, int]] = {}


class _Counts(dict[str, dict[bool, int]]):
    def __missing__(self, name: str) -> dict[bool, int]:
        return self.setdefault(name, {True: 0, False: 0})


def main() -> None:
    global COUNTS
    COUNTS, minutes, wanted = _Counts(), float(sys.argv[1]), sys.argv[2:] or [*READERS]
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    found: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for reader in wanted:
            tests, end = [make(Path(folder)) for make in READERS[reader]], time.time() + 60 * minutes
            while time.time() < end:
                for test in tests:
                    try:
                        test()
                    except (Found, BaseExceptionGroup) as error:
                        for each in error.exceptions if isinstance(error, BaseExceptionGroup) else [error]:
                            text = f"{each}"[:300]
                            found[text] = found.get(text, 0) + 1
                            print(f"FOUND {text}", flush=True)
    for name, counts in COUNTS.items():
        print(f"{name}: {counts[True]} read, {counts[False]} refused")
    print("\n".join(f"found {count} times: {text}" for text, count in found.items()) or "nothing found")


if __name__ == "__main__":
    main()
