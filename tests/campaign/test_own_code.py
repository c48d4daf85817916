"""The user's code: task files, Task(...), rewards, rows and hooks that are not what they must be: file, line, what was expected."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from attack import Case, attack, program

from legged_mw import programs
from legged_mw.check.guard import check_recordable
from legged_mw.utils.task import load_task

HEAD = '''"""Mine."""
import torch
import configs.go1_flat as shipped
from configs.go1_flat import LeggedRobot
from legged_mw.envs.observations import Row
from legged_mw.utils.task import Task
Cfg, CfgPPO = shipped.TASK.cfg, shipped.TASK.train
'''
FIT = f"this does not fit: mine.py:{HEAD.count(chr(10)) + 2}, Mine."
FIRST = HEAD.count("\n") + 1  # the line on which a case's own text begins
WANTED = "mine.py must end with TASK = Task(Env, Cfg, CfgPPO)"


def written(text: str, head: str = HEAD) -> Callable[[Path], object]:
    return lambda root: (root / "mine.py").write_bytes((head + text).encode(errors="surrogateescape"))


def loads(root: Path) -> None:
    load_task(str(root / "mine.py"))


# ---- files that are no task

SECTION = "class Mine(Cfg):\n    class env{}:\n        {} = 3\n"

FILES: list[tuple[str, str, tuple[str, ...]]] = [
    ("a colon too few", "def reward()\n    pass", (f"mine.py:{FIRST}: expected ':': def reward()",)),
    ("a bracket left open", "x = (1,", ("mine.py:", "was never closed")),
    ("a tab among spaces", "if 1:\n    x = 1\n\ty = 2", (f"mine.py:{FIRST + 2}: ",)),
    ("a zero byte", "x = '\0'", ("mine.py", "null bytes")),
    ("not UTF-8", "x = '\udcff'", ("mine.py", "utf-8")),
    (
        "an import that is not there",
        "import nosuch",
        (f"mine.py:{FIRST}: ModuleNotFoundError: No module named 'nosuch'",),
    ),
    ("a name that is not in there", "from legged_mw.envs import legged_robots", (f"mine.py:{FIRST}: ImportError: ",)),
    (
        "a module that has moved",
        "from legged_mw.envs.sim_to_real_config import BipedCfg",
        (f"mine.py:{FIRST}: ModuleNotFoundError: ", "; it is in configs.base now"),
    ),
    (
        "a class that has moved",
        "from legged_mw.envs.legged_robot_config import LeggedRobotCfgPPO",
        (f"mine.py:{FIRST}: ImportError: ", "; it is in legged_mw.rl.learner_config now"),
    ),
    (
        "a name that is none",
        "TASK = Task(Dog, Cfg, CfgPPO)",
        (f"mine.py:{FIRST}: NameError: name 'Dog' is not defined",),
    ),
    (
        "an error as it is imported",
        "def f():\n    return 1 / 0\n\n\nf()",
        (f"mine.py:{FIRST + 1}, f, called from mine.py:",),
    ),
    ("it ends the program", "raise SystemExit(0)", (f"mine.py:{FIRST}: SystemExit: 0", WANTED)),
    ("it calls exit", "import sys\nsys.exit('bye')", (f"mine.py:{FIRST + 1}: SystemExit: bye",)),
    ("it calls itself for ever", "def f():\n    f()\n\n\nf()", (f"mine.py:{FIRST + 1}, f", "RecursionError")),
    ("an error of many lines", "raise ValueError('a\\n' * 9000)", (f"mine.py:{FIRST}: ValueError: a a a",)),
    ("nothing", "", (WANTED, "its TASK is None")),
    ("a tuple", "TASK = (LeggedRobot, Cfg, CfgPPO)", (WANTED, "its TASK is (<class")),
    ("a name", "TASK = 'go1_flat'", (WANTED, "its TASK is 'go1_flat'")),
    (
        "two too few",
        "TASK = Task(LeggedRobot)",
        (f"mine.py:{FIRST}: TypeError: ", "missing 2 required positional arguments", WANTED),
    ),
    ("two too many", "TASK = Task(LeggedRobot, Cfg, CfgPPO, '', 3)", (f"mine.py:{FIRST}: TypeError: ", WANTED)),
    (
        "an argument that is not known",
        "TASK = Task(LeggedRobot, Cfg, CfgPPO, exams='a')",
        (f"mine.py:{FIRST}: TypeError: ", "'exams'"),
    ),
    ("numbers", "TASK = Task(1, 2, 3)", ("TASK: env is 1; it must be a class: an environment, as LeggedRobot is",)),
    (
        "config first",
        "TASK = Task(Cfg, LeggedRobot, CfgPPO)",
        ("TASK: env is <class ", "it must be a class: an environment"),
    ),
    (
        "learner second",
        "TASK = Task(LeggedRobot, CfgPPO, Cfg)",
        ("TASK: cfg is <class ", "an environment's config, as LeggedRobotCfg is"),
    ),
    (
        "the same config twice",
        "TASK = Task(LeggedRobot, Cfg, Cfg)",
        ("TASK: train is <class ", "a learner's, as LeggedRobotCfgPPO is"),
    ),
    ("an instance", "TASK = Task(LeggedRobot, Cfg(), CfgPPO)", ("TASK: cfg is <", "it must be a class")),
    (
        "an exam that is a number",
        "TASK = Task(LeggedRobot, Cfg, CfgPPO, 3)",
        ("TASK: exam is 3; it must be the name of an exam, or None",),
    ),
    (
        "a field that is not there",
        SECTION.format("(Cfg.env)", "num_env"),
        (f"mine.py:{FIRST + 2}: ", "num_envs"),
    ),
    (
        "a section without its parent",
        SECTION.format("", "num_envs"),
        (f"mine.py:{FIRST + 1}: ", "extends no section"),
    ),
]


@pytest.mark.parametrize(("text", "says"), [entry[1:] for entry in FILES], ids=[entry[0] for entry in FILES])
def test_task_files(text: str, says: tuple[str, ...], tmp_path: Path) -> None:
    attack(Case("", loads, says, given=written(text)), tmp_path)


OTHERS = [
    Case("a folder", loads, "no config file at ", given=lambda root: (root / "mine.py").mkdir()),
    Case("a link to itself", loads, "", given=lambda root: (root / "mine.py").symlink_to("mine.py")),
    Case(
        "no exam of that name",
        program("train", "--check", "--task", "ROOT/mine.py"),
        "mine.py: no exam 'nosuch' in ",
        given=written("TASK = Task(LeggedRobot, Cfg, CfgPPO, 'nosuch')"),
    ),
]


@pytest.mark.parametrize("case", OTHERS, ids=lambda case: case.id)
def test_no_file(case: Case, tmp_path: Path) -> None:
    attack(case, tmp_path)


# ---- environments


def method(text: str) -> str:
    """A task whose environment has one method of its own, which begins on the line FIRST + 1."""
    lines = "\n".join(f"    {line}" for line in text.splitlines())
    return f"class Mine(LeggedRobot):\n{lines}\n\n\nTASK = Task(Mine, Cfg, CfgPPO)\n"


def rows(change: str) -> str:
    return method(
        f"def observation_rows(self):\n    table = super().observation_rows()\n    mine = table['state']\n    {change}\n    return table"
    )


def hook(name: str) -> str:
    return method(f"def {name}(self, *args):\n    raise KeyError('mine')")


HERE, ROWS = f"mine: mine.py:{FIRST + 1}, Mine.", f"mine: mine.py:{FIRST + 1}, Mine.observation_rows: "
ENVIRONMENTS: list[tuple[str, str, str]] = [
    (
        "reward is nothing",
        method("def _reward_pose(self):\n    pass"),
        HERE + "_reward_pose: must return a tensor (4,), one value an env",
    ),
    (
        "reward is a column",
        method("def _reward_pose(self):\n    return self.dof_pos[:, :1]"),
        "_reward_pose: must return a tensor (4,)",
    ),
    (
        "reward is one number",
        method("def _reward_pose(self):\n    return self.dof_pos.sum()"),
        "one value an environment; it returned ()",
    ),
    (
        "reward is text",
        method("def _reward_pose(self):\n    return 'good'"),
        "_reward_pose: must return a tensor (4,), one value an env",
    ),
    (
        "reward divides by 0",
        method("def _reward_pose(self):\n    return self.rew_buf / (self.rew_buf * 0)"),
        "a value that is not finite",
    ),
    (
        "reward raises",
        method("def _reward_pose(self):\n    return self.nosuch"),
        "Mine._reward_pose: AttributeError: 'Mine' object has no",
    ),
    (
        "reward wants more",
        method("def _reward_pose(self, more):\n    return more"),
        FIT + "_reward_pose",
    ),
    ("reward is static", method("@staticmethod\ndef _reward_pose():\n    return 1"), "this does not fit: mine.py:"),
    ("reward is a number", method("_reward_pose = 5"), "this does not fit: Mine._reward_pose = 5"),
    (
        "no table",
        method("def observation_rows(self):\n    pass"),
        ROWS + "must return group -> list of rows; it returned NoneType",
    ),
    (
        "table is a list",
        method("def observation_rows(self):\n    return []"),
        ROWS + "must return group -> list of rows; it returned list",
    ),
    ("a group without rows", rows("table['state'] = []"), ROWS + "must return group -> list of rows"),
    (
        "row is a number",
        rows("mine.append(3)"),
        ROWS + "group 'state' holds int; write Row(name, value, ...), or the name of a group",
    ),
    (
        "row is a tensor",
        rows("mine.append(self.rew_buf)"),
        ROWS + "group 'state' holds Tensor; write Row(name, value, ...)",
    ),
    (
        "value is a number",
        rows("mine.append(Row('x', 3.0))"),
        ROWS + "row 'x' of 'state' is float; it must be a tensor (4, size)",
    ),
    (
        "value of one axis",
        rows("mine.append(Row('x', self.rew_buf))"),
        ROWS + "row 'x' of 'state' is (4,); it must be a tensor (4, size)",
    ),
    (
        "value of other worlds",
        rows("mine.append(Row('x', torch.zeros(5, 2)))"),
        ROWS + "row 'x' of 'state' is (5, 2); it must be a",
    ),
    (
        "value without columns",
        rows("mine.append(Row('x', torch.zeros(4, 0)))"),
        ROWS + "row 'x' of 'state' is (4, 0); it must be a",
    ),
    ("a group that is not there", rows("mine.append('nosuch')"), "group 'state': no group 'nosuch' in the groups"),
    (
        "scales that do not fit",
        rows("mine.append(Row('x', torch.zeros(4, 2), scale=(1.0, 2.0, 3.0)))"),
        "'x' has 2 columns and 3 scales",
    ),
    (
        "an argument that Row has not",
        rows("mine.append(Row('x', self.dof_pos, noises=1))"),
        f"mine.py:{FIRST + 4}, Mine.observation_rows: Type",
    ),
    ("a row twice", rows("mine.append(mine[0])"), "state"),
    ("a fall is nothing", method("def _fallen(self):\n    pass"), FIT + "_fallen"),
    (
        "a fall of two worlds",
        method("def _fallen(self):\n    return self.reset_buf[:2]"),
        FIT + "_fallen",
    ),
    ("nothing is made", method("def __init__(self):\n    pass"), FIT + "__init__"),
    *(
        (f"{name} raises", hook(name), f"mine: mine.py:{FIRST + 2}, Mine.{name}: KeyError: 'mine'")
        for name in (
            "_update_state",
            "check_termination",
            "_end_step",
            "reset_envs",
            "compute_observations",
            "_resample_commands",
        )
    ),
]


@pytest.mark.parametrize(
    ("text", "says"), [entry[1:] for entry in ENVIRONMENTS], ids=[entry[0] for entry in ENVIRONMENTS]
)
def test_environments(text: str, says: str, tmp_path: Path) -> None:
    attack(
        Case("", lambda root: check_recordable(load_task(str(root / "mine.py"))), says, given=written(text)), tmp_path
    )


# ---- where nobody checked before


def test_a_hook_that_raises_later(tmp_path: Path) -> None:
    """In a training under way, or in play: the user's lines alone, of all that led there."""
    text = method("def give(self):\n    raise KeyError('mine')\n\ndef training_state(self):\n    return self.give()")

    def run(root: Path) -> None:
        task = load_task(str(root / "mine.py"))
        task.cfg.env.num_envs = 2
        from legged_mw.rl.runner import make_runner

        make_runner(task.env_class(task.cfg, "cpu"), task.train, None, "cpu").save(str(root / "model_0.pt"))

    said = f"mine.py:{FIRST + 2}, Mine.give, called from mine.py:{FIRST + 5}, Mine.training_state: KeyError: 'mine'; --verbose shows"
    attack(Case("", run, said, given=written(text)), tmp_path)


def test_verbose_shows_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    written("import nosuch")(tmp_path)
    monkeypatch.setattr(sys, "argv", ["train.py", "--task", str(tmp_path / "mine.py"), "--verbose"])
    with pytest.raises(SystemExit):
        programs.train()
    said = capsys.readouterr().err
    assert (
        said.startswith("Traceback")
        and "import_task" in said
        and said.rstrip().splitlines()[-1].startswith("train.py: ")
    )
