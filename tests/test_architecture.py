"""The rules of the house that a reader cannot see from one file: who may import whom, and how long things may get."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterable, Mapping
from fnmatch import fnmatch
from functools import cache

from configs.go1_handstand import Go1HandstandCfg
from configs.robots.go2 import Go2
from legged_mw import ROOT
from legged_mw.skills.handstand import HandstandCfg
from legged_mw.utils.task import load_task, task_names

FILES = sorted(
    str(p.relative_to(ROOT))
    for pattern in ("legged_mw/**/*.py", "configs/**/*.py", "examples/*.py", "*.py")
    for p in ROOT.glob(pattern)
)
SOURCES = {path: (ROOT / path).read_text() for path in FILES}
MAX_FUNCTION = 60  # lines of one that reads as one story; a file is as long as its concept

MAX_ROBOT, MAX_TASK = 85, 20  # lines of a file in configs/robots/ and in configs/
# tasks of more lines: each number, and where it is from
SPELL_OUT = ("go1_flat", "go1_flat_fast", "go1_rough", "go1_rough_student")

# Imports run one way: train, play -> rl -> envs -> sim -> utils; configs -> envs, utils.
LAYERS = ("utils", "sim", "envs", "rl")
TOOLS = (
    "legged_mw.check",
    "legged_mw.view",
    "legged_mw.eval",
    "legged_mw.deploy",
    "legged_mw.export",
    "legged_mw.robot",
    "legged_mw.drawing",
    "legged_mw.motion",
    "legged_mw.skills",
    "legged_mw.tools",
    "legged_mw.unitree",
)
ONLY_IN = {
    "warp": ["legged_mw/sim/*", "legged_mw/fast/*"],
    "mujoco_warp": ["legged_mw/sim/*", "legged_mw/fast/*"],
    "legged_mw.fast": ["legged_mw/fast/*"],
    "legged_mw.rl.students": [
        "legged_mw/rl/students/*",
        "legged_mw/export/*",
        "legged_mw/eval/*",
        "legged_mw/view/*",
        "legged_mw/check/*",
    ],
    "rsl_rl": ["legged_mw/rl/*", "legged_mw/export/*"],
    "rsl_rl.env": ["legged_mw/rl/*", "legged_mw/envs/base_task.py"],
    # a second to import, and only for a report
    "matplotlib": ["legged_mw/eval/plots.py", "legged_mw/deploy/replay.py", "legged_mw/deploy/fit.py"],
    "legged_mw.view": [
        *(
            "legged_mw/view/*",
            "legged_mw/deploy/*",
            "legged_mw/robot/*",
            "legged_mw/motion/*",
            "legged_mw/eval/perform.py",
        ),
        "legged_mw/tools/*",
        "legged_mw/programs.py",
        "examples/udp_robot.py",
    ],
    "mujoco.studio": ["legged_mw/view/web.py", "legged_mw/view/studio.py"],  # young, and not on every platform
    "legged_mw.check": ["legged_mw/check/*", "legged_mw/fast/*", "legged_mw/robot/page.py", "legged_mw/programs.py"],
    "legged_mw.robot": ["legged_mw/robot/*", "legged_mw/programs.py"],
    # the reader of strangers' XML: an export's scene is one, and deploy runs without torch
    "legged_mw.robot.mjcf": ["legged_mw/robot/*", "legged_mw/deploy/*", "legged_mw/export/*"],
    "legged_mw.drawing": [
        "legged_mw/drawing/*",
        "legged_mw/view/playing.py",
        "legged_mw/export/scene.py",
        "legged_mw/eval/perform.py",
        "legged_mw/robot/picture.py",
        "legged_mw/motion/look.py",
    ],
    "legged_mw.motion": ["legged_mw/motion/*"],
    "legged_mw.unitree": ["legged_mw/unitree/*", "examples/unitree_rl_lab.py"],  # deploy finds it by name
    "legged_mw.eval": ["legged_mw/eval/*", "legged_mw/deploy/*", "legged_mw/tools/*", "legged_mw/programs.py"],
    "legged_mw.tools": ["legged_mw/tools/*", "legged_mw/programs.py"],
    "legged_mw.deploy": [
        *("legged_mw/deploy/*", "legged_mw/unitree/*", "legged_mw/export/*", "legged_mw/programs.py"),
        "examples/udp_robot.py",
        "examples/unitree_rl_lab.py",
    ],
    "legged_mw.export": ["legged_mw/export/*", "legged_mw/programs.py"],
    "legged_mw.programs": ["train.py", "play.py"],
    "onnxruntime": ["legged_mw/deploy/*", "legged_mw/unitree/deploy_yaml.py", "legged_mw/export/network.py"],
    "cyclonedds": ["legged_mw/unitree/idl.py", "legged_mw/unitree/link.py"],
    "configs": ["configs/*", "examples/*"],
    "train": [],
    "play": [],
}
NEVER_IN = {
    "legged_mw/envs/*": ["mujoco"],
    "legged_mw/sim/*": ["legged_mw.utils.config", "legged_mw.utils.task"],
    "legged_mw/rl/flags.py": ["torch"],
    # what a task names: a task that is only loaded waits for no algorithm
    "legged_mw/rl/learner_config.py": ["torch", "legged_mw.rl", "rsl_rl.algorithms", "rsl_rl.models", "rsl_rl.modules"],
    # numbers in, numbers out: of use to whoever drives the robot otherwise
    "legged_mw/eval/walking.py": ["torch", "mujoco"],
    "legged_mw/eval/figures.py": ["torch", "mujoco"],
    "legged_mw/eval/hard.py": ["torch", "mujoco"],
    "legged_mw/eval/heat.py": ["torch", "mujoco"],
    "legged_mw/eval/skill*.py": ["torch", "legged_mw.envs", "legged_mw.rl", "legged_mw.eval.perform"],
    "legged_mw/view/*": [
        "torch",
        "rsl_rl",
        "legged_mw.envs",
        "legged_mw.sim",
        "legged_mw.rl",
        "legged_mw.utils.cli",
        "legged_mw.utils.math",
    ],
}
# The environment as a stage, and what play.py prepares of it; the rest of view/ runs where there is no torch.
MAY_ALL_THE_SAME = ["legged_mw/view/playing.py"]
# The one door of the core to a package around it: "this file is not plain".
HOOKS = {"legged_mw/sim/model.py": ["legged_mw.robot.vendor"]}
CONFIGS_MAY = [
    "legged_mw.envs",
    "legged_mw.rl.learner_config",
    "legged_mw.skills",
    "legged_mw.utils",
    "configs",
    "math",
    "__future__",
]  # numbers and names only
# What runs on a robot's computer: neither torch nor warp, nor anything of ours that needs them.
DEPLOY_MAY = [
    *(
        "numpy",
        "mujoco",
        "onnxruntime",
        "yaml",
        "cyclonedds",
        "matplotlib",
        "legged_mw.ROOT",
        "legged_mw.deploy",
        "legged_mw.unitree",
        "legged_mw.view",
        "legged_mw.eval.walking",
        "legged_mw.eval.hard",
        "legged_mw.eval.heat",
        "legged_mw.eval.skills",
    ),
    *(
        "legged_mw.utils.cli",
        "legged_mw.utils.config",
        "legged_mw.utils.errors",
        "legged_mw.utils.machine",
        "legged_mw.utils.commands",
    ),
    *(
        "legged_mw.utils.motor_heat",
        "legged_mw.utils.motor_network",
        "legged_mw.utils.files",
        "legged_mw.skills.clip",
        "legged_mw.robot.mjcf",
    ),
    *sys.stdlib_module_names,
]


# A factory arm could be stepped with sim/: it names no field of a config, no flag, nothing of walking or learning.
FIELD_OR_FLAG = (
    r"--[a-z]|(?<![\w./])(?:asset|terrain|sim|control|rewards|commands|init_state|domain_rand|env|viewer|cfg)\.[a-z]"
)
OF_A_CONFIG = r"\b(?:config\w*|section)\b"
OF_A_TASK = r"\b(?:foot|feet|command\w*|reward\w*|policy|policies|observation\w*|episode\w*)\b"


@cache
def imports(source: str) -> set[str]:
    """Dotted names that a file imports, anywhere in it: also in functions and for type checkers only."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, f"relative import in line {node.lineno}"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def within(name: str, package: str) -> bool:
    return f"{name}.".startswith(f"{package}.")


def layer(name: str) -> int:
    """Place of a module of the core in ``LAYERS``; -1 for all others."""
    head = name.removeprefix("legged_mw.").partition(".")[0]
    return LAYERS.index(head) if name.startswith("legged_mw.") and head in LAYERS else -1


def against_the_layers(path: str, name: str) -> bool:
    """Whether ``path`` is of the core and imports a tool, or what stands above it."""
    here = layer(path.removesuffix(".py").replace("/", "."))
    tool = any(within(name, package) for package in TOOLS)
    return here >= 0 and (tool or layer(name) > here)


def violations(path: str, source: str) -> list[str]:
    """Imports that ``path`` may not make."""
    wrong = []
    for name in sorted(imports(source)):
        # the most specific
        rule = max((package for package in ONLY_IN if within(name, package)), key=len, default=None)
        outside = rule is not None and not any(fnmatch(path, where) for where in ONLY_IN[rule])
        never = any(
            fnmatch(path, where) and within(name, package)
            for where, packages in NEVER_IN.items()
            for package in packages
        )
        if path in MAY_ALL_THE_SAME:
            never = False
        if path.startswith("configs/"):
            never = not any(within(name, package) for package in CONFIGS_MAY)
        if path.startswith(("legged_mw/deploy/", "legged_mw/unitree/")):
            never = not any(within(name, package) for package in DEPLOY_MAY)
        hook = any(within(name, package) for package in HOOKS.get(path, ()))
        if not hook and (outside or never or against_the_layers(path, name)):
            wrong.append(name)
    return wrong


def circles(sources: Mapping[str, str]) -> list[tuple[str, ...]]:
    """Modules (dotted name -> source) that import each other, directly or not: each group once."""
    return rounds({name: _imported(source, sources) - {name} for name, source in sources.items()})


def rounds(graph: Mapping[str, set[str]]) -> list[tuple[str, ...]]:
    """Nodes of a graph that reach each other: each group once."""
    reach = {name: _reached(graph, name) for name in graph}
    return sorted(
        {tuple(sorted(other for other in reach[name] if name in reach[other])) for name in graph if name in reach[name]}
    )


def _imported(source: str, modules: Iterable[str]) -> set[str]:
    """Those of ``modules`` that a source imports: by name, or for something in them."""
    modules = set(modules)
    return {name if name in modules else name.rpartition(".")[0] for name in imports(source)} & modules


def _reached(graph: Mapping[str, set[str]], start: str) -> set[str]:
    found, left = set(), [start]
    while left:
        new = graph[left.pop()] - found
        found |= new
        left += new
    return found


def too_long(source: str) -> list[str]:
    """Functions of more lines than one can survey."""
    functions = [
        node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    lines = [(f.name, (f.end_lineno or 0) - f.lineno + 1) for f in functions]
    return [f"{name}: {length} lines" for name, length in lines if length > MAX_FUNCTION]


def robots_of(cfg: type) -> set[str]:
    """The files of robots that a task's config extends."""
    return {parent.__module__ for parent in cfg.__mro__ if within(parent.__module__, "configs.robots")}


def words_of_others(source: str) -> list[str]:
    """What a source of sim/ says, in strings and names, that is not its to know."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            found += re.findall(f"{FIELD_OR_FLAG}|{OF_A_CONFIG}|{OF_A_TASK}", node.value, re.IGNORECASE)
        for kind in ("id", "attr", "arg", "name"):
            if isinstance(name := getattr(node, kind, None), str):
                found += re.findall(OF_A_TASK, name.replace("_", " "), re.IGNORECASE)
    return found


def test_imports_run_one_way() -> None:
    assert [f"{path}: {name}" for path, source in SOURCES.items() for name in violations(path, source)] == []


def test_the_import_rules_themselves() -> None:
    for path, source, caught in [
        ("legged_mw/envs/legged_robot.py", "import warp as wp", True),
        ("legged_mw/envs/legged_robot.py", "def f():\n    from mujoco_warp import step", True),
        ("legged_mw/envs/legged_robot.py", "import mujoco", True),
        ("legged_mw/envs/legged_robot.py", "from legged_mw import rl", True),
        ("legged_mw/envs/legged_robot.py", "from legged_mw.eval import exams", True),
        ("legged_mw/envs/legged_robot.py", "from rsl_rl.env import VecEnv", True),
        ("legged_mw/envs/base_task.py", "from rsl_rl.env import VecEnv", False),
        ("legged_mw/envs/base_task.py", "from rsl_rl.models import MLPModel", True),
        ("legged_mw/sim/graph.py", "import warp", False),
        ("legged_mw/sim/warp_engine.py", "from legged_mw.fast.skip_kernels import ShortStep", True),
        ("legged_mw/rl/networks.py", "def f():\n    from legged_mw.fast import kernels", True),
        ("legged_mw/tools/warm.py", "from legged_mw.fast.step_compiler import fuse", True),
        ("legged_mw/rl/networks.py", "from legged_mw.utils.opaque import fast", False),
        ("legged_mw/fast/step_compiler.py", "from legged_mw.envs.robot_task import RobotTask", False),
        ("legged_mw/sim/graph.py", "import legged_mw.utils.config", True),
        ("legged_mw/sim/graph.py", "from legged_mw.utils.math import assign", False),
        ("legged_mw/utils/task.py", "from legged_mw.envs.legged_robot import LeggedRobot", True),
        ("legged_mw/utils/task.py", "if TYPE_CHECKING:\n    from legged_mw.envs.legged_robot import LeggedRobot", True),
        ("legged_mw/utils/task.py", "def f():\n    from legged_mw.sim.model import per_joint", True),
        ("legged_mw/sim/model.py", "from legged_mw.envs.mirror import Mirror", True),
        ("legged_mw/sim/model.py", "def f():\n    from legged_mw.robot.vendor import read_robot", False),
        ("legged_mw/sim/joints.py", "from legged_mw.robot.vendor import read_robot", True),
        ("legged_mw/envs/mirror.py", "from legged_mw.rl.ppo import mirror", True),
        ("legged_mw/envs/legged_robot_config.py", "from legged_mw.rl.learner_config import RobotTaskCfgPPO", True),
        ("legged_mw/rl/ppo.py", "from legged_mw.envs.mirror import Mirror", False),
        ("legged_mw/rl/runner.py", "from legged_mw.export.exporter import export", True),
        ("legged_mw/rl/runner.py", "from legged_mw.export.scene import standalone", True),
        ("legged_mw/export/exporter.py", "from legged_mw.export.scene import standalone", False),
        ("legged_mw/rl/runner.py", "def f():\n    from legged_mw.view.stage import Stage", True),
        ("legged_mw/rl/training.py", "from legged_mw.robot.measure import measure", True),
        ("legged_mw/check/describe.py", "from legged_mw.robot.measure import measure", True),
        ("legged_mw/robot/picture.py", "from legged_mw.view.recorder import save_png", False),
        ("legged_mw/sim/ground.py", "from legged_mw.drawing.terrain_look import relief", True),
        ("legged_mw/view/recorder.py", "from legged_mw.drawing.scene import visual_spec", True),
        ("legged_mw/envs/robot_task.py", "from legged_mw.deploy import contract", True),
        ("legged_mw/utils/cli.py", "import legged_mw.eval.report", True),
        ("legged_mw/view/playing.py", "from legged_mw.envs.legged_robot import LeggedRobot", False),
        ("legged_mw/utils/task.py", "if TYPE_CHECKING:\n    pass\nelse:\n    import legged_mw.envs", True),
        ("legged_mw/sim/graph.py", "if TYPE_CHECKING:\n    import legged_mw.envs", True),
        ("legged_mw/rl/ppo.py", "from legged_mw.rl.students.recurrent import HiddenState", True),
        ("legged_mw/rl/runner.py", "def f():\n    from legged_mw.rl.students import estimator", True),
        ("legged_mw/rl/students/recurrent.py", "from legged_mw.rl.networks import RememberingModel", False),
        ("legged_mw/eval/rollout.py", "from legged_mw.rl.students.recurrent import forget", False),
        ("legged_mw/export/exporter.py", "from legged_mw.rl.students.recurrent import states_of", False),
        ("legged_mw/rl/runner.py", "import rsl_rl.runners", False),
        ("legged_mw/rl/runner.py", "from configs.go1_flat import TASK", True),
        ("configs/go1_rough.py", "from configs.go1_flat import Go1FlatCfg", False),
        ("configs/go1_rough.py", "from legged_mw.utils.task import Task", False),
        ("configs/go1_rough.py", "from legged_mw.sim.model import Ground", True),
        ("configs/go1_rough.py", "from legged_mw.rl.learner_config import RobotTaskCfgPPO", False),
        ("configs/go1_rough.py", "from legged_mw.rl.ppo import GraphedPPO", True),
        ("legged_mw/rl/learner_config.py", "from legged_mw.rl.ppo import MAX_RATE", True),
        ("legged_mw/rl/learner_config.py", "def f():\n    from rsl_rl.utils import resolve_class", False),
        ("legged_mw/robot/draft.py", "from configs.base import BipedCfg", True),
        ("configs/go1_rough.py", "import torch", True),
        ("legged_mw/view/session.py", "import torch", True),
        ("legged_mw/view/playing.py", "import torch", False),
        ("legged_mw/view/playing.py", "from mujoco.studio import plugin", True),
        ("legged_mw/view/panel.py", "from mujoco.studio import plugin", True),
        ("legged_mw/deploy/runner.py", "import torch", True),
        ("legged_mw/deploy/runner.py", "from legged_mw.eval import exams", True),
        ("legged_mw/deploy/runner.py", "from legged_mw.eval import walking", False),
        ("legged_mw/deploy/runner.py", "from legged_mw.sim.model import unknown", True),
        ("legged_mw/deploy/runner.py", "import cyclonedds", True),
        ("legged_mw/unitree/client.py", "def f():\n    from cyclonedds.domain import Domain", True),
        ("legged_mw/unitree/link.py", "from cyclonedds.domain import Domain", False),
        ("legged_mw/deploy/runner.py", "import socket\nimport numpy as np\nimport mujoco", False),
        ("legged_mw/export/exporter.py", "from legged_mw.deploy.contract import Contract", False),
        ("legged_mw/rl/runner.py", "from legged_mw.deploy.contract import Contract", True),
        ("train.py", "from rsl_rl.runners import OnPolicyRunner", True),
        ("play.py", "from rsl_rl.models import MLPModel", True),
        ("legged_mw/rl/training.py", "from legged_mw.eval.exams import make_exam", True),
        ("legged_mw/rl/training.py", "from legged_mw.export.exporter import export", True),
        ("legged_mw/rl/training.py", "from legged_mw.check.guard import check_recordable", True),
        ("legged_mw/programs.py", "from legged_mw.check.guard import check_recordable", False),
        ("legged_mw/programs.py", "from legged_mw.export.exporter import export", False),
    ]:
        assert bool(violations(path, source)) == caught, f"{path}: {source}"


def test_few_files_of_the_core_name_what_they_do_not_import() -> None:
    """As a string, to be imported where it is asked for."""
    core = [path for path in FILES if layer(path.removesuffix(".py").replace("/", ".")) >= 0]
    for package, files in [
        ("legged_mw.fast", ["legged_mw/utils/opaque.py"]),
        # the config's default and the classes that a config may name, and where an old run's class is now
        (
            "legged_mw.rl.students",
            ["legged_mw/rl/learner_config.py", "legged_mw/utils/errors.py"],
        ),
    ]:
        others = [path for path in core if not path.startswith(f"{package.replace('.', '/')}/")]
        assert [path for path in others if package in SOURCES[path]] == files


def test_no_two_modules_import_each_other() -> None:
    modules = {path.removesuffix(".py").replace("/", ".").removesuffix(".__init__"): path for path in FILES}
    assert circles({name: SOURCES[path] for name, path in modules.items()}) == []
    straight = {
        "a": "",
        "a.one": "import a.two\nimport numpy",
        "a.two": "from a.three import x",
        "a.three": "",
        "b": "import a.one",
    }
    assert circles(straight) == []
    for back in (
        "import a.one",
        "from a import one",
        "from a.one import x",
        "def f():\n    from a.one import x",
        "if TYPE_CHECKING:\n    import a.one",
    ):
        assert circles({**straight, "a.three": back}) == [("a.one", "a.three", "a.two")]
        assert circles({**straight, "a.two": back}) == [("a.one", "a.two")]


def package_of(name: str) -> str:
    """The package of legged_mw that a module belongs to; "" for those beside the packages."""
    parts = name.split(".")
    if parts[0] != "legged_mw" or len(parts) < 3 or not (ROOT / "legged_mw" / parts[1]).is_dir():
        return ""
    return parts[1]


def package_graph(sources: Mapping[str, str]) -> dict[str, set[str]]:
    """Package -> packages that it imports; paths -> sources. The core's one door to a package around it is left out."""
    graph: dict[str, set[str]] = {}
    for path, source in sources.items():
        here = package_of(path.removesuffix(".py").replace("/", "."))
        names = [name for name in imports(source) if not any(within(name, hook) for hook in HOOKS.get(path, ()))]
        graph.setdefault(here, set()).update({package_of(f"{name}.") for name in names} - {here, ""})
    return {here: {other for other in found if other in graph} for here, found in graph.items() if here}


def test_no_two_packages_import_each_other() -> None:
    """Neither directly nor round about."""
    sources = {path: source for path, source in SOURCES.items() if path.startswith("legged_mw/")}
    assert rounds(package_graph(sources)) == []
    back = {**sources, "legged_mw/deploy/exam.py": "from legged_mw.unitree.client import UnitreeRobot"}
    assert rounds(package_graph(back)) == [("deploy", "unitree")]


def test_no_two_modules_name_a_class_alike() -> None:
    """Who looks for a class by its name finds one; private ones are of their module."""
    where: dict[str, list[str]] = {}
    for path in (path for path in FILES if path.startswith(("legged_mw/", "configs/"))):
        for node in ast.parse(SOURCES[path]).body:
            if isinstance(node, ast.ClassDef):
                where.setdefault(node.name, []).append(path)
    assert len(where) > 100 and {name: paths for name, paths in where.items() if len(paths) > 1} == {}


def test_functions_stay_readable() -> None:
    assert {path: long for path, source in SOURCES.items() if (long := too_long(source))} == {}
    silent = [path for path, source in SOURCES.items() if not ast.get_docstring(ast.parse(source))]
    assert silent == [], "a module docstring says what lives here"
    body = "".join(f"    x = {i}\n" for i in range(MAX_FUNCTION - 1))
    assert too_long(f"def f():\n{body}") == []
    assert too_long(f"class A:\n    pass\nasync def g():\n{body}    y = 1\n") == [f"g: {MAX_FUNCTION + 1} lines"]


def test_a_robot_and_a_task_are_short_configs() -> None:
    """A task is of one robot."""
    lines = {path: len(source.splitlines()) for path, source in SOURCES.items()}
    robots = [path for path in FILES if path.startswith("configs/robots/")]
    assert robots and [path for path in robots if lines[path] > MAX_ROBOT] == []
    tasks = [task for task in task_names() if task not in SPELL_OUT]
    assert tasks and [task for task in tasks if lines[f"configs/{task}.py"] > MAX_TASK] == []
    assert [task for task in task_names() if len(robots_of(type(load_task(task).cfg))) != 1] == []

    class Heir(Go2, Go1HandstandCfg):
        pass

    class Own(Go2, HandstandCfg):
        pass

    assert robots_of(Heir) == {"configs.robots.go1", "configs.robots.go2"}
    assert robots_of(Own) == {"configs.robots.go2"}


def test_sim_knows_numbers_alone() -> None:
    sim = [path for path in FILES if path.startswith("legged_mw/sim/")]
    assert {path: words for path in sim if (words := words_of_others(SOURCES[path]))} == {}
    for source, found in [
        ('raise ModelError("leave it out of asset.colliders")', ["asset.c"]),
        ('f"{x}; say --device cpu"', ["--d"]),
        ('"terrain.tile_size must"', ["terrain.t"]),
        ('"the section of the config"', ["section", "config"]),
        ('def f():\n    """The reward of an episode."""', ["reward", "episode"]),
        ("foot_height = 1.0", ["foot"]),
        ("def f(commands): ...", ["commands"]),
        ("x.max_reward = 1", ["reward"]),
        ('"see legged_mw.sim.simulation and docs/terrain.md"', []),
        ("terrain.heights", []),
    ]:
        assert words_of_others(source) == found


def test_all_files_were_looked_at() -> None:
    assert {
        "legged_mw/envs/legged_robot.py",
        "legged_mw/sim/simulation.py",
        "configs/go1_flat.py",
        "train.py",
        "play.py",
    } <= set(FILES)
    vague = {"helpers", "managers", "core", "common", "wrappers", "helper", "misc"}
    assert [path for path in FILES if vague & set(path.removesuffix(".py").split("/"))] == []
