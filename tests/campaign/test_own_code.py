"""The user's code that fails when nobody checks any more; tests/golden/own_code.py has what is refused before."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from attack import Case, attack
from golden.own_code import FIRST, method, written

from legged_mw import programs
from legged_mw.utils.task import load_task


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
