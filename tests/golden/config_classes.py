"""Class statements of a config, and values that its fields do not take."""

from __future__ import annotations

from test_config import Base, Go1

from golden.table import Table
from legged_mw.utils.task import load_task

HEAD = """from pathlib import Path
from test_config import Base, Go1
from legged_mw.utils.config import Config
"""
CLASSES = {
    "a misspelt field": "class A(Base):\n    class env(Base.env):\n        num_env = 3",
    "a new field without its type": "class A(Base):\n    class env(Base.env):\n        zzz = 0.5",
    "a field in the wrong section": "class A(Base):\n    num_envs = 3",
    "a bare name in a new section": "class A(Config):\n    class sim:\n        dt = 0.1",
    "a section without its parent": "class A(Go1):\n    class env:\n        num_envs: int = 3",
    "an inner section without its parent": (
        "class A(Base):\n    class rewards(Base.rewards):\n        class scales:\n            torques: float = 1.0"
    ),
    "a section of another parent": "class A(Base):\n    class env(Base.control):\n        pass",
    "a misspelt section": "class A(Base):\n    class controll(Base.control):\n        pass",
    "a misspelt inner section": (
        "class A(Base):\n    class rewards(Base.rewards):\n        class scale(Base.rewards.scales):\n            pass"
    ),
    "a misspelt section of a grandparent": "class A(Go1):\n    class envs(Base.env):\n        pass",
    "a section that skips a generation": "class A(Go1):\n    class env(Base.env):\n        pass",
    "a section of one parent of two": (
        "class W(Base):\n    class env(Base.env):\n        pass\nclass A(Go1, W):\n    class env(Go1.env):\n        pass"
    ),
    "a value for a section": "class A(Base):\n    env = 3",
    "a typed value for a section": "class A(Base):\n    env: int = 3",
    "a section for a field": "class A(Base):\n    class env(Base.env):\n        class num_envs:\n            pass",
    "another type": "class A(Go1):\n    class env(Go1.env):\n        num_envs: float = 3.0",
    "a type without a value": "class A(Config):\n    gravity: list[float]",
    "a path": "class A(Config):\n    path: Path = Path()",
    "a list of complex numbers": "class A(Config):\n    path: list[complex] = []",
    "a tuple": "class A(Config):\n    path: tuple[int, int] = (0, 0)",
    "keys of numbers": "class A(Config):\n    path: dict[int, str] = {}",
    "a type that is not there": "class A(Config):\n    path: 'Tensor' = 3",
    "a method's name": "class A(Config):\n    update: int = 3",
    "_only in a section of fields": "class A(Base):\n    class env(Base.env):\n        _only = True",
    "a value of another type": "class A(Base):\n    class env(Base.env):\n        num_envs = 3.0",
}
VALUES = {  # path -> values of a wrong type
    "env.num_envs": [3.0, True, "3.5", "many", {"a": 1}],
    "env.episode_length_s": [True],
    "env.is_flat": [1, "1"],
    "env.run_name": [None],
    "env.note": [3],
    "control.control_type": ["v"],
    "control.stiffness": [{"hip": None}, {3: 1.0}, 35, [1.0]],
    "control.limits": [0.5],
    "control.anything": [{1, 2}],
    "commands.ranges.lin_vel_x": [[0.0, "1"], "[1, a]", "[1, 2"],
    "commands.ranges.path": [[1, 2.5]],
    "rewards.scales.torques": ["big"],
    "rewards.scales.brand_new": [True, None, "abc", "1x"],
}
PATHS = [
    "env.num_env",
    "rewards.scale.torques",
    "num_envs",
    "env",
    "env.num_envs.x",
    "control.stiffness.hip",
    "rewards.scales._open",
]
PATHS += ["rewards.scales.a-b", "rewards.total", "", "env."]
UPDATES = {
    "a field": {"env": {"num_env": 3}},
    "a section": {"rewords": {}},
    "a number": {"rewards": 3},
    "nothing": {"rewards": {"scales": None}},
    "a key of a number": {"env": {3: 1}},
    "a key of truth": {"rewards": {"scales": {True: 1}}},
    "a list": [1],
}


def table() -> Table:
    made = Table()
    for name, text in CLASSES.items():
        made.add(
            f"class with {name}",
            lambda root: load_task("mine.py"),
            lambda root, text=text: (root / "mine.py").write_text(f"{HEAD}\n\n{text}\n"),
        )
    for path, values in VALUES.items():
        for value in values:
            made.add(f"{path} = {value!r}", lambda root, path=path, value=value: Base().set(path, value))
    for path in PATHS:
        made.add(f"set {path!r}", lambda root, path=path: Base().set(path, "3"))
    for name, values in UPDATES.items():
        made.add(f"update by {name}", lambda root, values=values: Base().update(values, "over.yaml"))
    made.add("assigned: another field", lambda root: setattr(Go1().env, "num_env", 3))
    made.add("assigned: a section", lambda root: setattr(Go1(), "env", 3))
    made.add("assigned: another type", lambda root: setattr(Go1().env, "num_envs", "3"))
    return made
