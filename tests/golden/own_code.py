"""The user's own task files, rewards, rows and hooks, and the guard's findings: file, line, what was expected."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from attack import program

from golden.table import Table
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
FIRST = HEAD.count("\n") + 1  # the line on which a case's own text begins


def written(text: str, head: str = HEAD) -> Callable[[Path], object]:
    return lambda root: (root / "mine.py").write_bytes((head + text).encode(errors="surrogateescape"))


def loads(root: Path) -> None:
    load_task(str(root / "mine.py"))


def checks(root: Path) -> None:
    check_recordable(load_task(str(root / "mine.py")))


def method(text: str) -> str:
    """A task whose environment has one method of its own, which begins on the line FIRST + 1."""
    lines = "\n".join(f"    {line}" for line in text.splitlines())
    return f"class Mine(LeggedRobot):\n{lines}\n\n\nTASK = Task(Mine, Cfg, CfgPPO)\n"


def rows(change: str) -> str:
    return method(
        f"def observation_rows(self):\n    table = super().observation_rows()\n    mine = table['state']\n    {change}\n    return table"
    )


SECTION = "class Mine(Cfg):\n    class env{}:\n        {} = 3\n"

FILES = {
    "a colon too few": "def reward()\n    pass",
    "a bracket left open": "x = (1,",
    "a tab among spaces": "if 1:\n    x = 1\n\ty = 2",
    "a zero byte": "x = '\0'",
    "not UTF-8": "x = '\udcff'",
    "an import that is not there": "import nosuch",
    "a name that is not in there": "from legged_mw.envs import legged_robots",
    "a module that has moved": "from legged_mw.envs.sim_to_real_config import BipedCfg",
    "a class that has moved": "from legged_mw.envs.legged_robot_config import LeggedRobotCfgPPO",
    "a name that is none": "TASK = Task(Dog, Cfg, CfgPPO)",
    "an error as it is imported": "def f():\n    return 1 / 0\n\n\nf()",
    "it ends the program": "raise SystemExit(0)",
    "it calls exit": "import sys\nsys.exit('bye')",
    "it calls itself for ever": "def f():\n    f()\n\n\nf()",
    "an error of many lines": "raise ValueError('a\\n' * 9000)",
    "nothing": "",
    "a tuple": "TASK = (LeggedRobot, Cfg, CfgPPO)",
    "a name": "TASK = 'go1_flat'",
    "two too few": "TASK = Task(LeggedRobot)",
    "two too many": "TASK = Task(LeggedRobot, Cfg, CfgPPO, '', 3)",
    "an argument that is not known": "TASK = Task(LeggedRobot, Cfg, CfgPPO, exams='a')",
    "numbers": "TASK = Task(1, 2, 3)",
    "config first": "TASK = Task(Cfg, LeggedRobot, CfgPPO)",
    "learner second": "TASK = Task(LeggedRobot, CfgPPO, Cfg)",
    "the same config twice": "TASK = Task(LeggedRobot, Cfg, Cfg)",
    "an instance": "TASK = Task(LeggedRobot, Cfg(), CfgPPO)",
    "a field that is not there": SECTION.format("(Cfg.env)", "num_env"),
    "a section without its parent": SECTION.format("", "num_envs"),
}
ENVIRONMENTS = {
    "reward is nothing": method("def _reward_pose(self):\n    pass"),
    "reward is a column": method("def _reward_pose(self):\n    return self.dof_pos[:, :1]"),
    "reward is one number": method("def _reward_pose(self):\n    return self.dof_pos.sum()"),
    "reward is text": method("def _reward_pose(self):\n    return 'good'"),
    "reward divides by 0": method("def _reward_pose(self):\n    return self.rew_buf / (self.rew_buf * 0)"),
    "reward raises": method("def _reward_pose(self):\n    return self.nosuch"),
    "reward wants more": method("def _reward_pose(self, more):\n    return more"),
    "reward is static": method("@staticmethod\ndef _reward_pose():\n    return 1"),
    "reward is a number": method("_reward_pose = 5"),
    "no table": method("def observation_rows(self):\n    pass"),
    "table is a list": method("def observation_rows(self):\n    return []"),
    "a group without rows": rows("table['state'] = []"),
    "row is a number": rows("mine.append(3)"),
    "row is a tensor": rows("mine.append(self.rew_buf)"),
    "value is a number": rows("mine.append(Row('x', 3.0))"),
    "value of one axis": rows("mine.append(Row('x', self.rew_buf))"),
    "value of other worlds": rows("mine.append(Row('x', torch.zeros(5, 2)))"),
    "value without columns": rows("mine.append(Row('x', torch.zeros(4, 0)))"),
    "a group that is not there": rows("mine.append('nosuch')"),
    "scales that do not fit": rows("mine.append(Row('x', torch.zeros(4, 2), scale=(1.0, 2.0, 3.0)))"),
    "an argument that Row has not": rows("mine.append(Row('x', self.dof_pos, noises=1))"),
    "a row twice": rows("mine.append(mine[0])"),
    "a fall is nothing": method("def _fallen(self):\n    pass"),
    "a fall of two worlds": method("def _fallen(self):\n    return self.reset_buf[:2]"),
    "nothing is made": method("def __init__(self):\n    pass"),
    **{
        f"{name} raises": method(f"def {name}(self, *args):\n    raise KeyError('mine')")
        for name in (
            "_update_state",
            "check_termination",
            "_end_step",
            "reset_envs",
            "compute_observations",
            "_resample_commands",
        )
    },
}
HEAVY = {  # a reward that a CUDA graph cannot record
    "cpu": "self.dof_vel[:, 0].cpu()",
    "numpy": "torch.as_tensor(self.dof_vel[:, 0].numpy())",
    "tolist": "torch.tensor(self.dof_vel[:, 0].tolist())",
    "int": "self.rew_buf * int(self.rew_buf[0])",
    "a print": "print(self.rew_buf) or self.rew_buf",
    "a helper's mask": "self.rew_buf.masked_select(self.rew_buf > 0).sum() + self.rew_buf",
}
METHODS = {
    "an old name": method("def _observation_rows(self):\n    return {}"),
    "a row twice": rows("mine.append(Row('dof_pos', torch.zeros(4, 12)))"),
    "a group of its own noise": rows("table['mine'] = ['state', Row('y', torch.zeros(4, 1))]"),
    "torques of a sum": method(
        "def _compute_torques(self, actions):\n    return super()._compute_torques(actions).sum(-1, keepdim=True)"
    ),
    "no torques": method("def _compute_torques(self, actions):\n    return None"),
    "torques that divide": method("def _compute_torques(self, actions):\n    return actions / (actions - actions)"),
}


# ---- a task that the guard watches

MINE = """
import random
from collections import deque

import numpy as np
import torch
from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.observations import Row
from legged_mw.utils.task import Task

RNG, AT_IMPORT = np.random.default_rng(1), torch.ones(4)


class Slots:
    __slots__ = ("one",)

    def __init__(self, like):
        self.one = torch.zeros_like(like)


class Buffers:
    def __init__(self, like):
        self.kept = {"past": torch.zeros_like(like)}


class Mine(LeggedRobot):
    def _init_buffers(self):
        super()._init_buffers()
        self.foot, self.rows = (torch.tensor(i, device=self.device) for i in (1, [0, 2]))
        self.past, self.list, self.count = self.buffer(), [self.buffer()], 0
        self.parts, self.slots, self.view = Buffers(self.past), Slots(self.past), self.dof_pos[:, :3]
        self.frames = deque([self.past, self.parts.kept["past"]])
        self.moved, self.net = torch.zeros(self.num_envs).to(self.device), torch.nn.Linear(1, 1).to(self.device).requires_grad_(False)

"""
REWARD = """
    def _reward_pose(self):
        {}  # here
        return self.past * 0.0
"""
END_STEP = """
    def _end_step(self):
        super()._end_step()
        {}  # here
"""
ANNEAL = """
    def on_training_progress(self, share):
        super().on_training_progress(share)
        {}  # here
"""
LOAD = """
    def load_training_state(self, state):
        super().load_training_state(state)
        {}  # here
"""
REDRAW = """
    def _init_ranges(self):
        super()._init_ranges()
        redraw = self.domain_rand.redraw

        def drawn():
            redraw()
            {}  # here

        self.domain_rand.redraw = drawn
"""
INIT = """
    def _init_ranges(self):
        super()._init_ranges()
        {}  # here

    def _end_step(self):
        super()._end_step()
        self.past.add_(self.own.sum())
"""
TABLE = """
    def observation_rows(self):  # here
        rows = super().observation_rows()
        rows["state"].append({})
        return rows
"""
TAIL = """

TASK = Task(Mine, Go1FlatCfg, Go1FlatCfgPPO)
"""
RETURNS = "\n    def _reward_pose(self):  # here\n        return {}\n"
NOT_RECORDED = {
    "column by a scalar tensor": (REWARD, "self.foot_height[:, self.foot].clone()"),
    "item": (REWARD, "self.dt * self.foot.item()"),
    "if": (REWARD, "1 if self.commands.sum() > 0 else 2"),
    "boolean index": (END_STEP, "self.past[self.fell] = 0.0"),
    "torch.tensor": (REWARD, "torch.tensor([1.0])"),
    "no device": (REWARD, "torch.zeros(2)"),
    "nonzero": (END_STEP, "self.fell.nonzero()"),
    "rebound": (END_STEP, "self.past = self.past + 1.0"),
    "rebound view": (END_STEP, "self.view = self.dof_vel[:, :3]"),
    "rebound in a part": (END_STEP, "self.parts.kept['past'] = self.past.abs()"),
    "rebound in the simulation": (END_STEP, "self.sim.qpos = self.sim.qpos.abs()"),
    "list that grows": (END_STEP, "self.list.append(self.past.clone())"),
    "number": (END_STEP, "self.count += 1"),
    "number that a training changes": (ANNEAL, "self.count = 2.0 * share"),
    "number of the config that a training changes": (ANNEAL, "self.cfg.rewards.base_height_target = 0.3 * share"),
    "rebound by a training": (ANNEAL, "self.past = self.past + share"),
    "number that a redraw changes": (REDRAW, "self.count += 1"),
    "rebound by a checkpoint": (LOAD, "self.past = self.past.clone()"),
    "rebound in a deque": (END_STEP, "self.frames.rotate()"),
    "rebound in slots": (END_STEP, "self.slots.one = self.past * 2"),
    "Python's random numbers": (REWARD, "self.dt * random.random()"),
    "numpy's random numbers": (END_STEP, "self.past += np.random.rand()"),
    "a generator of numpy's": (END_STEP, "self.past += RNG.normal()"),
    "a buffer without a device": (INIT, "self.own = torch.zeros(self.num_envs)"),
    "computed from a number without a device": (INIT, "self.own = torch.tensor(0.5).expand(4)"),
    "computed without a device": (INIT, "self.own = {'a': torch.arange(3)[None] / 2.0 + 1.0}['a']"),
    "a network without a device": (INIT, "self.own = torch.nn.Linear(1, 1).weight.detach()"),
    "writes": (REWARD, "self.past += 1.0"),
    "writes to a view": (REWARD, "self.last_actions[:, 0].mul_(2.0)"),
    "computed row": (TABLE, "Row('speed', self.base_lin_vel * 2.0)"),
}
MISTAKES = {
    "raises": (END_STEP, "self.past.add_(self.dof_pos)"),
    "unknown name": (REWARD, "self.speed"),
    "shape": (RETURNS, "self.dof_pos.square()"),
    "NaN": (RETURNS, "(self.base_height - 100.0).sqrt()"),
    "row of NaN": (TABLE, "Row('past', self.past.fill_(torch.nan)[:, None])"),
}


def watched_task(body: str, line: str) -> str:
    """A task with one of the parts above, which has ``line`` in it."""
    return MINE + body.format(line) + TAIL


def checked(root: object) -> None:
    task = load_task("mine.py")
    task.cfg.env.num_envs = 4
    check_recordable(task)


def table() -> Table:
    made = Table()
    for name, text in FILES.items():
        made.add(f"file, {name}", loads, written(text))
    made.add("file: a folder", loads, lambda root: (root / "mine.py").mkdir())
    made.add("file: a link to itself", loads, lambda root: (root / "mine.py").symlink_to("mine.py"))
    made.add(
        "file: no exam of that name",
        program("train", "--check", "--task", "ROOT/mine.py"),
        written("TASK = Task(LeggedRobot, Cfg, CfgPPO, 'nosuch')"),
    )
    for name, text in ENVIRONMENTS.items():
        made.add(f"environment, {name}", checks, written(text))
    for name, text in HEAVY.items():
        made.add(f"reward with {name}", checked, written(method(f"def _reward_pose(self):\n    return {text}")))
    for name, text in METHODS.items():
        made.add(f"step with {name}", checked, written(text))
    for name, (body, line) in {**NOT_RECORDED, **MISTAKES}.items():
        made.add(f"guard, {name}", checks, written(watched_task(body, line), head=""))
    return made
