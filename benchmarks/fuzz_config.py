"""Fuzz the readers of configs and YAML, by hand: python benchmarks/fuzz_config.py --minutes 10 (pip install hypothesis).

Whatever is read either becomes data or is a ConfigError of one line. What a task takes over is written, read again the same, and passes
or is refused by the rules between fields. A file outside of the temporary folder, another error or ten seconds for one input end it.
"""

# pyright: reportMissingImports=false, reportCallIssue=false
from __future__ import annotations

import argparse
import copy
import os
import random
import re
import signal
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from legged_mw.utils.config import ConfigError, field_types, load_yaml, save_yaml
from legged_mw.utils.task import LoadedTask, load_task, task_names

MOST_SECONDS = 10
TASKS = [load_task(name) for name in task_names()]
PATHS = sorted({path for task in TASKS for cfg in (task.cfg, task.train) for path, _ in field_types(type(cfg))})
FOLDER = Path(tempfile.mkdtemp())
SEEDS = ["a: &a [*a]", "seed: 1:30", "env: {num_envs: 0x_}", "? [a]\n: 1", "!!int x", "%YAML 1.99\n---\na: 1"]
SEEDS += ['"\\ud800"', "<<: *a", "- - - -"]
PIECES = [
    "&a ",
    "*a",
    "!!int ",
    "{",
    "[",
    "]",
    "}",
    ": ",
    "- ",
    "\n",
    "\t",
    "'",
    '"',
    "#",
    "|",
    "?",
    "\x00",
    "\ud7ff",
    "0x",
    "1:30",
]
counts: Counter[str] = Counter()


def written(task: LoadedTask) -> str:
    save_yaml(FOLDER / "again.yaml", task.to_dict())
    return (FOLDER / "again.yaml").read_text()


SECTIONS = [section for task in TASKS for section in re.split(r"\n(?=\w)", written(task))]

numbers = st.one_of(st.integers(), st.floats(), st.sampled_from([10**20, 10**400, -1, 0, 1e39, 5e-324]))
values = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        numbers,
        st.text(),
        st.sampled_from(["mujoco", "*", "state", "hip", ".nan", "1e400", "elu"]),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=8), inner, max_size=4)),
    max_leaves=8,
)


@st.composite
def mutated(draw: Any) -> str:
    """The YAML of a task, or a nasty piece, with pieces cut, doubled, swapped and typed over."""
    text = draw(st.sampled_from(SEEDS + SECTIONS))
    generator = random.Random(draw(st.integers(0, 2**32)))
    for _ in range(draw(st.integers(0, 4))):
        at, kind = generator.randrange(len(text) + 1), generator.randrange(4)
        piece = generator.choice(PIECES)
        end = min(len(text), at + generator.randrange(1, 12))
        text = (
            text[:at] + piece + text[at:],
            text[:at] + text[end:],
            text[:end] + text[at:],
            text[:at] + piece + text[end:],
        )[kind]
    return text


def one_line(error: ConfigError) -> None:
    assert str(error).strip() and len(" ".join(str(error).split())) < 3000, error


def take_over(loaded: dict[str, Any]) -> None:
    task = copy.deepcopy(random.choice(TASKS))
    try:
        task.update(loaded, "x.yaml")
        counts["taken over"] += 1
        save_yaml(FOLDER / "again.yaml", task.to_dict())
        again = load_task(task.name)
        again.update(load_yaml(FOLDER / "again.yaml"), "again.yaml")
        assert again.to_dict() == task.to_dict()
        task.cfg.check()
        task.train.check(task.cfg.env.num_envs)
        counts["passed"] += 1
    except ConfigError as error:
        one_line(error)


def watched(work: Any) -> None:
    signal.alarm(MOST_SECONDS)
    try:
        work()
    finally:
        signal.alarm(0)
    assert set(os.listdir(FOLDER)) <= {"x.yaml", "again.yaml"}


PHASES = (Phase.generate, Phase.shrink)
ENDLESS = settings(
    max_examples=500, deadline=None, database=None, suppress_health_check=list(HealthCheck), phases=PHASES
)


@ENDLESS
@given(st.one_of(mutated(), mutated(), mutated(), st.text(), st.binary(max_size=400)))
def fuzz_yaml(text: str | bytes) -> None:
    def work() -> None:
        (FOLDER / "x.yaml").write_bytes(text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass"))
        counts["files"] += 1
        try:
            loaded = load_yaml(FOLDER / "x.yaml")
        except ConfigError as error:
            return one_line(error)
        counts["read"] += 1
        return take_over(loaded)

    watched(work)


@ENDLESS
@given(st.sampled_from(PATHS), values, st.booleans())
def fuzz_fields(path: str, value: Any, as_text: bool) -> None:
    def work() -> None:
        counts["fields"] += 1
        task = copy.deepcopy(random.choice(TASKS))
        try:
            if as_text:
                task.set(path, value if isinstance(value, str) else repr(value)[:200])
            else:
                nested = value
                for part in reversed(path.split(".")):
                    nested = {part: nested}
                return take_over(nested)
            counts["set"] += 1
            task.cfg.check()
            task.train.check(task.cfg.env.num_envs)
        except (ConfigError, ValueError) as error:
            if isinstance(error, ConfigError):
                one_line(error)
            elif "4300 digits" not in str(error):  # of repr above
                raise

    watched(work)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    end = time.time() + 60 * parser.parse_args().minutes
    while time.time() < end:
        fuzz_yaml()
        fuzz_fields()
        print(dict(counts), flush=True)
