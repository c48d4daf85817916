"""The rules of the house that a reader cannot see from one file: who may import whom, and how long things may get."""

from __future__ import annotations

import ast
import sys
from fnmatch import fnmatch

import pytest

from legged_mw import ROOT

FILES = sorted(
    str(p.relative_to(ROOT)) for pattern in ("legged_mw/**/*.py", "configs/*.py", "examples/*.py", "*.py") for p in ROOT.glob(pattern)
)
MAX_LINES, MAX_LINES_OF_THE_MDP, MAX_FUNCTION = 520, 800, 60
# Imports run one way: train, play -> rl -> envs -> sim -> utils; configs -> envs, utils.
ONLY_IN = {
    "warp": ["legged_mw/sim/*"],
    "mujoco_warp": ["legged_mw/sim/*"],
    "rsl_rl": ["legged_mw/rl/*"],
    "rsl_rl.env": ["legged_mw/rl/*", "legged_mw/envs/base_task.py"],
    "matplotlib": ["legged_mw/eval/plots.py"],  # a second to import, and only for a report
    "legged_mw.view": ["legged_mw/view/*", "legged_mw/deploy/*", "legged_mw/programs.py"],
    "mujoco.studio": ["legged_mw/view/web.py", "legged_mw/view/studio.py"],  # young, and not on every platform
    "legged_mw.eval": ["legged_mw/eval/*", "legged_mw/deploy/*", "legged_mw/programs.py"],
    "legged_mw.deploy": ["legged_mw/deploy/*", "legged_mw/rl/export.py", "legged_mw/eval/*", "legged_mw/programs.py"],
    "legged_mw.rl.export": ["legged_mw/rl/export.py", "legged_mw/eval/*", "legged_mw/programs.py"],
    "legged_mw.programs": ["train.py", "play.py"],
    "onnxruntime": ["legged_mw/deploy/*", "legged_mw/rl/export.py"],
    "configs": ["configs/*"],
    "train": [],
    "play": [],
}
NEVER_IN = {
    "legged_mw/envs/*": ["legged_mw.rl", "mujoco"],
    "legged_mw/sim/*": ["legged_mw.envs", "legged_mw.rl", "legged_mw.utils.config", "legged_mw.utils.task"],
    "legged_mw/eval/rules.py": ["torch", "mujoco"],  # numbers in, numbers out: of use to whoever drives the robot otherwise
    "legged_mw/eval/figures.py": ["torch", "mujoco"],
    "legged_mw/view/*": [
        "torch",
        "rsl_rl",
        "legged_mw.envs",
        "legged_mw.sim",
        "legged_mw.rl",
        "legged_mw.utils.cli",
        "legged_mw.utils.math",
    ],
    "legged_mw/utils/*": ["legged_mw.envs", "legged_mw.sim", "legged_mw.rl"],
}
# The environment as a stage, and what play.py prepares of it; the rest of view/ runs where there is no torch.
MAY_ALL_THE_SAME = ["legged_mw/view/env_stage.py", "legged_mw/view/playing.py"]
CONFIGS_MAY = ["legged_mw.envs", "legged_mw.utils", "configs", "math", "__future__"]  # numbers and names only
# What runs on a robot's computer: neither torch nor warp, nor anything of ours that needs them.
DEPLOY_MAY = [
    *("numpy", "mujoco", "onnxruntime", "yaml", "legged_mw.deploy", "legged_mw.view", "legged_mw.eval.rules"),
    *("legged_mw.utils.cli", "legged_mw.utils.config", "legged_mw.utils.errors", "legged_mw.utils.machine", *sys.stdlib_module_names),
]


def imports(source: str) -> set[tuple[str, bool]]:
    """Dotted names that a file imports, anywhere in it, and whether for type checkers only."""
    tree, found = ast.parse(source), set()
    guarded = [n for n in ast.walk(tree) if isinstance(n, ast.If) and ast.unparse(n.test).endswith("TYPE_CHECKING")]
    for_types = {inner for branch in guarded for statement in branch.body for inner in ast.walk(statement)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {(alias.name, node in for_types) for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, f"relative import in line {node.lineno}"
            found |= {(f"{node.module}.{alias.name}", node in for_types) for alias in node.names}
    return found


def violations(path: str, source: str) -> list[str]:
    """Imports that ``path`` may not make."""

    def within(name: str, package: str) -> bool:
        return f"{name}.".startswith(f"{package}.")

    wrong = []
    for name, for_types in sorted(imports(source)):
        rule = max((package for package in ONLY_IN if within(name, package)), key=len, default=None)  # the most specific
        outside = rule is not None and not any(fnmatch(path, where) for where in ONLY_IN[rule])
        never = any(fnmatch(path, where) and within(name, package) for where, packages in NEVER_IN.items() for package in packages)
        if path in MAY_ALL_THE_SAME or (path.startswith("legged_mw/utils/") and for_types):
            never = False
        if path.startswith("configs/"):
            never = not any(within(name, package) for package in CONFIGS_MAY)
        if path.startswith("legged_mw/deploy/"):
            never = not any(within(name, package) for package in DEPLOY_MAY)
        if outside or never:
            wrong.append(f"{path} imports {name}")
    return wrong


@pytest.mark.parametrize("path", FILES)
def test_imports_run_one_way(path: str) -> None:
    assert violations(path, (ROOT / path).read_text()) == []


@pytest.mark.parametrize(
    ("path", "source", "caught"),
    [
        ("legged_mw/envs/legged_robot.py", "import warp as wp", True),
        ("legged_mw/envs/legged_robot.py", "def f():\n    from mujoco_warp import step", True),
        ("legged_mw/envs/legged_robot.py", "import mujoco", True),
        ("legged_mw/envs/legged_robot.py", "from legged_mw import rl", True),
        ("legged_mw/envs/legged_robot.py", "from legged_mw.eval import exam", True),
        ("legged_mw/envs/legged_robot.py", "from rsl_rl.env import VecEnv", True),
        ("legged_mw/envs/base_task.py", "from rsl_rl.env import VecEnv", False),
        ("legged_mw/envs/base_task.py", "from rsl_rl.models import MLPModel", True),
        ("legged_mw/sim/graph.py", "import warp", False),
        ("legged_mw/sim/graph.py", "import legged_mw.utils.config", True),
        ("legged_mw/sim/graph.py", "from legged_mw.utils.math import assign", False),
        ("legged_mw/utils/task.py", "from legged_mw.envs.legged_robot import LeggedRobot", True),
        ("legged_mw/utils/task.py", "if TYPE_CHECKING:\n    from legged_mw.envs.legged_robot import LeggedRobot", False),
        ("legged_mw/utils/task.py", "if TYPE_CHECKING:\n    pass\nelse:\n    import legged_mw.envs", True),
        ("legged_mw/sim/graph.py", "if TYPE_CHECKING:\n    import legged_mw.envs", True),
        ("legged_mw/rl/runner.py", "import rsl_rl.runners", False),
        ("legged_mw/rl/runner.py", "from configs.go1_flat import TASK", True),
        ("configs/go1_rough.py", "from configs.go1_flat import Go1FlatCfg", False),
        ("configs/go1_rough.py", "from legged_mw.utils.task import Task", False),
        ("configs/go1_rough.py", "from legged_mw.sim.model import Ground", True),
        ("configs/go1_rough.py", "import torch", True),
        ("legged_mw/view/session.py", "import torch", True),
        ("legged_mw/view/env_stage.py", "import torch", False),
        ("legged_mw/view/env_stage.py", "from mujoco.studio import plugin", True),
        ("legged_mw/view/panel.py", "from mujoco.studio import plugin", True),
        ("legged_mw/deploy/runner.py", "import torch", True),
        ("legged_mw/deploy/runner.py", "from legged_mw.eval import exam", True),
        ("legged_mw/deploy/runner.py", "from legged_mw.eval import rules", False),
        ("legged_mw/deploy/runner.py", "from legged_mw.sim.model import unknown", True),
        ("legged_mw/deploy/runner.py", "import socket\nimport numpy as np\nimport mujoco", False),
        ("legged_mw/rl/export.py", "from legged_mw.deploy.contract import Contract", False),
        ("legged_mw/rl/runner.py", "from legged_mw.deploy.contract import Contract", True),
        ("train.py", "from rsl_rl.runners import OnPolicyRunner", True),
        ("play.py", "from rsl_rl.models import MLPModel", True),
        ("legged_mw/rl/training.py", "from legged_mw.eval.training import make_exam", True),
        ("legged_mw/rl/training.py", "from legged_mw.rl.export import export", True),
        ("legged_mw/programs.py", "from legged_mw.rl.export import export", False),
    ],
)
def test_the_import_rules_themselves(path: str, source: str, caught: bool) -> None:
    assert bool(violations(path, source)) == caught


@pytest.mark.parametrize("path", FILES)
def test_files_and_functions_stay_readable(path: str) -> None:
    source = (ROOT / path).read_text()
    limit = MAX_LINES_OF_THE_MDP if path == "legged_mw/envs/legged_robot.py" else MAX_LINES
    assert len(source.splitlines()) < limit
    functions = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    assert [f"{f.name}, line {f.lineno}" for f in functions if (f.end_lineno or 0) - f.lineno >= MAX_FUNCTION] == []
    assert ast.get_docstring(ast.parse(source)), "a module docstring says what lives here"


def test_all_files_were_looked_at() -> None:
    assert {"legged_mw/envs/legged_robot.py", "legged_mw/sim/simulation.py", "configs/go1_flat.py", "train.py", "play.py"} <= set(FILES)
    vague = {"helpers", "managers", "core", "common", "wrappers", "helper", "misc"}
    assert [path for path in FILES if vague & set(path.removesuffix(".py").split("/"))] == []
