"""The user's own task files, rewards, rows and hooks: the tables of tests/campaign/test_own_code.py, and the guard's findings."""

from __future__ import annotations

import test_own_code as campaign
from test_own_code import loads, method, rows, written

from golden.table import Table
from legged_mw.check.guard import check_recordable
from legged_mw.utils.task import load_task

HEAVY = {  # a reward that a CUDA graph cannot record
    "item": "self.dof_vel[:, 0] * self.dof_vel.max().item()",
    "cpu": "self.dof_vel[:, 0].cpu()",
    "numpy": "torch.as_tensor(self.dof_vel[:, 0].numpy())",
    "tolist": "torch.tensor(self.dof_vel[:, 0].tolist())",
    "a new tensor": "self.rew_buf + torch.tensor(3.0)",
    "nonzero": "self.rew_buf * len(self.dof_vel.nonzero())",
    "a mask": "self.rew_buf + self.dof_vel[self.dof_vel > 0].sum()",
    "an if": "self.rew_buf if self.rew_buf.sum() > 0 else self.rew_buf * 2",
    "a write": "self.dof_vel.zero_()[:, 0]",
    "int": "self.rew_buf * int(self.rew_buf[0])",
    "a print": "print(self.rew_buf) or self.rew_buf",
    "a helper's mask": "self.rew_buf.masked_select(self.rew_buf > 0).sum() + self.rew_buf",
}
METHODS = {
    "a buffer bound anew": method(
        "def _update_state(self):\n    super()._update_state()\n    self.rew_buf = self.rew_buf * 1"
    ),
    "a number that changes": method(
        "def _update_state(self):\n    super()._update_state()\n    self.count = getattr(self, 'count', 0) + 1"
    ),
    "a row that is made anew": rows("mine.append(Row('x', self.dof_pos * 1.0))"),
    "a row beyond": rows("mine.append(Row('x', self.dof_pos * 1e30))"),
    "an old name": method("def _observation_rows(self):\n    return {}"),
    "a row twice": rows("mine.append(Row('dof_pos', torch.zeros(4, 12)))"),
    "a group of its own noise": rows("table['mine'] = ['state', Row('y', torch.zeros(4, 1))]"),
    "torques of a sum": method(
        "def _compute_torques(self, actions):\n    return super()._compute_torques(actions).sum(-1, keepdim=True)"
    ),
    "no torques": method("def _compute_torques(self, actions):\n    return None"),
    "torques that divide": method("def _compute_torques(self, actions):\n    return actions / (actions - actions)"),
    "a row that must not move": rows("mine.append(Row('x', self.dof_pos.clone()))"),
}


def checked(root: object) -> None:
    task = load_task("mine.py")
    task.cfg.env.num_envs = 4
    check_recordable(task)


def table() -> Table:
    made = Table()
    for name, text, *_ in campaign.FILES:
        made.add(f"file, {name}", loads, written(text))
    made.campaign("file", campaign.OTHERS)
    for name, text, *_ in campaign.ENVIRONMENTS:
        made.add(f"environment, {name}", lambda root: check_recordable(load_task(str(root / "mine.py"))), written(text))
    for name, text in HEAVY.items():
        made.add(f"reward with {name}", checked, written(method(f"def _reward_pose(self):\n    return {text}")))
    for name, text in METHODS.items():
        made.add(f"step with {name}", checked, written(text))
    return made
