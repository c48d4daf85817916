"""legged-mw completion bash | zsh: a script that completes programs, flags, tasks, fields, policies and runs.

The script does not start Python at a key press. Make it again after an update, or in the folder of your own tasks.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NoReturn

from legged_mw import ROOT
from legged_mw.utils.cli import Parser
from legged_mw.utils.config import field_types
from legged_mw.utils.errors import UserError
from legged_mw.utils.task import load_task, task_names

_SCRIPT = """# legged-mw {shell}; put into your ~/.{shell}rc:  eval "$(legged-mw completion {shell})"
{before}_legged_mw() {{
    local word=${{COMP_WORDS[COMP_CWORD]}} before=${{COMP_WORDS[COMP_CWORD-1]}} program=${{COMP_WORDS[1]}} words=""
    # bash takes "=" for a word of its own: --set env.num_envs=64 has five
    if [[ $word == "=" || $before == "=" ]]; then COMPREPLY=(); return; fi
    case $COMP_CWORD:$program:$before in
        1:*) words="{programs}" ;;
{cases}
    esac
    COMPREPLY=($(compgen -W "$words" -- "$word"))
    case $before in --set) compopt -o nospace 2>/dev/null ;; esac
    if [[ -z $words || ${{#COMPREPLY[@]}} -eq 0 ]] && [[ $COMP_CWORD -gt 1 && $word != -* ]]; then compopt -o default 2>/dev/null; fi
}}
complete -F _legged_mw legged-mw
"""
_RUNS = "$(ls -d logs/*/*/ 2>/dev/null | sed 's:/$::')"
_FILES = "$(ls *.py 2>/dev/null)"


class _Caught(BaseException):
    """Carries a program's parser out of the program when it starts to parse the flags."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self.parser = parser


def main(programs: Mapping[str, Callable[[], None]]) -> None:
    """Print the completion script for ``programs``."""
    parser = Parser(prog="legged-mw completion", description=__doc__, allow_abbrev=False)
    parser.add_argument("shell", choices=("bash", "zsh"))
    print(script(parser.parse_args().shell, programs))


def script(shell: str, programs: Mapping[str, Callable[[], None]]) -> str:
    """The completion script for the shell."""
    tasks = " ".join(task_names())
    policies = " ".join(sorted(path.parent.name for path in (ROOT / "resources/policies").glob("*/policy.onnx")))
    cases = [
        f'        *:--task) words="{tasks} {_FILES}" ;;',
        f'        *:--load_run|*:--compare|*:--teacher|*:--init) words="shipped {_RUNS}" ;;',
        f'        *:--set) words="{" ".join(f"{path}=" for path in fields())}" ;;',
        '        *:--device) words="cpu cuda:0" ;;',
        '        *:--engine) words="auto mujoco mujoco_warp" ;;',
    ]
    places = {"deploy": policies, "compare": _RUNS, "robot": tasks, "warm": tasks, "completion": "bash zsh"}
    for name, start in programs.items():
        parser = parser_of(name, start)
        for action in parser._actions:
            if action.choices and action.option_strings:
                cases.append(f'        *:{name}:{action.option_strings[-1]}) words="{_join(action.choices)}" ;;')
        cases.append(f'        *:{name}:*) words="{places.get(name, "")} {_flags(parser)}" ;;')
    before = (
        "autoload -U +X bashcompinit && bashcompinit\nautoload -U +X compinit && compinit\n" if shell == "zsh" else ""
    )
    return _SCRIPT.format(shell=shell, before=before, programs=" ".join(programs), cases="\n".join(cases))


def fields() -> list[str]:
    """The dotted paths of the config fields of all tasks."""
    tasks = map(load_task, task_names())
    return sorted({path for task in tasks for cfg in (task.cfg, task.train) for path, _ in field_types(type(cfg))})


def parser_of(name: str, start: Callable[[], None]) -> argparse.ArgumentParser:
    """The parser of a program's flags, caught at the call of ``parse_args``."""

    def caught(self: argparse.ArgumentParser, *_: Any, **__: Any) -> NoReturn:
        raise _Caught(self)

    saved = argparse.ArgumentParser.parse_args, argparse.ArgumentParser.parse_known_args, sys.argv
    argparse.ArgumentParser.parse_args = argparse.ArgumentParser.parse_known_args = caught  # type: ignore[method-assign]
    sys.argv = [f"legged-mw {name}"]
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            start()
    except _Caught as found:
        return found.parser
    finally:
        argparse.ArgumentParser.parse_args, argparse.ArgumentParser.parse_known_args, sys.argv = saved
    raise UserError(f"legged-mw {name} reads no flags")


def _flags(parser: argparse.ArgumentParser) -> str:
    return _join(flag for action in parser._actions for flag in action.option_strings if flag.startswith("--"))


def _join(words: Iterable[object]) -> str:
    return " ".join(map(str, words))
