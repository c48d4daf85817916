"""legged-mw exam POLICY ...: grade policies with several seeds and compare with an earlier result of the same exam.

It runs exports in MuJoCo's C engine, without torch and without a GPU. Exit code 1: a mark fell.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
from collections.abc import Callable, Mapping, Sequence
from html import escape
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from legged_mw.deploy.__main__ import SHIPPED, find
from legged_mw.deploy.contract import CONTRACT_FILE, SCENE_FILE, read_contract
from legged_mw.deploy.exam import contract_rules, contract_skill, run_exam, run_skill
from legged_mw.deploy.hard_exam import run_hard
from legged_mw.eval import hard, walking
from legged_mw.eval.walking import ExamRules, Figure
from legged_mw.utils.cli import Parser, positive
from legged_mw.utils.errors import UserError, shown
from legged_mw.utils.files import typed, writable
from legged_mw.utils.machine import usable_cores

VERSION = 1  # of the exams. Raise it when the meaning of a figure changes; only equal versions are compared
SEEDS = 3
# A mark falls if the new mean is worse than the stored mean by more than the tolerance, which is the largest of:
# SPREAD x range of the stored repeats, range of the new repeats, SHARE x stored mean, LEAST x pass mark.
# 110 comparisons of a policy with itself, three repeats a side, gave 3 false alarms for go2_flat and 1 for g1_flat,
# as they shipped before 2026-11-29.
SPREAD, SHARE, LEAST = 2.0, 0.1, 0.02
FELL = 1  # exit code

Export = Callable[[str, int, Path], None]  # run's name, checkpoint's iteration or -1, folder of the new export


def parse() -> argparse.Namespace:
    parser = Parser(prog="legged-mw exam", description=__doc__, allow_abbrev=False)
    what = "an export, a run, TASK/RUN, or a task (its last run); several policies count as repeats"
    parser.add_argument("policies", metavar="POLICY", nargs="+", help=what)
    parser.add_argument("--against", metavar="FILE", help="a result to compare with; exit code 1 if a mark fell")
    parser.add_argument("--json", metavar="FILE", help="write the result to this file")
    parser.add_argument("--badge", metavar="FILE", help="write the verdict as an SVG badge to this file")
    seeds = f"number of repeats, each with its own start states and noise (default: {SEEDS})"
    parser.add_argument("--seeds", type=positive, default=SEEDS, metavar="N", help=seeds)
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="the first seed; 0: no random start states")
    parser.add_argument(
        "--checkpoint",
        type=int,
        default=-1,
        metavar="N",
        help="a run's checkpoint (default: its export, made when it was trained; without one, the newest)",
    )
    common = "walking exam: the trained command ranges, or the common range of the robot's published policies"
    parser.add_argument("--ranges", choices=("trained", "common"), help=common)
    parser.add_argument("--scene", metavar="FILE", help="walking exam: an MJCF of the robot, such as the vendor's")
    parser.add_argument("--no_hard", action="store_true", help="skip the hard exam, which takes half of the time")
    parser.add_argument("--edited", action="store_true", help="accept a contract that was changed or written by hand")
    args = parser.parse_args()
    if args.seed < 0:
        parser.error(f"--seed {args.seed}: a seed is 0 or more")
    for flag in ("json", "badge"):
        if getattr(args, flag) is not None:
            writable(getattr(args, flag), f"--{flag}")
    return args


def main(export: Export) -> None:
    """Run the program. ``export`` exports a run that has no export; it needs torch."""
    args = parse()
    before = read_result(typed(args.against)) if args.against else None
    with TemporaryDirectory() as scratch:
        folders = [
            find_export(name, args.checkpoint, export, Path(scratch, str(i))) for i, name in enumerate(args.policies)
        ]
        requests = [asked_of(folder, args) for folder in folders]
        for name, other in zip(args.policies[1:], requests[1:], strict=True):
            check_alike(other, requests[0], name, args.policies[0])
        if before:
            check_alike(requests[0], before, args.policies[0], args.against)
        result = examine(folders, requests[0], args)
    marks = fallen(result, before) if before else []
    print(table(result, before))
    if args.json:
        walking.save(result, typed(args.json))
        print(f"written to {shown(typed(args.json))}")
    if args.badge:
        typed(args.badge).write_text(badge(result), encoding="utf-8")
    for line in marks:
        print(f"fell: {line}")
    if marks:
        raise SystemExit(FELL)
    if before:
        print("no mark fell")


def find_export(name: str, checkpoint: int, export: Export, scratch: Path) -> Path:
    """The export folder of ``name``: an export, a run or a shipped policy. A run without one is exported to ``scratch``."""
    folder, of_task = typed(name), Path("logs", name)  # a path, or TASK/RUN
    made = [folder / "export", of_task / "export"] if checkpoint == -1 else []  # an export has no checkpoints
    for path in (folder, *made):
        if (path / CONTRACT_FILE).is_file():
            return find(str(path))
    is_run = folder.exists() or of_task.exists() or checkpoint != -1
    if not is_run and (SHIPPED / name).is_dir():
        return SHIPPED / name
    export(name, checkpoint, scratch)
    return scratch


# ---- exam and robot ---------------------------------------------------------------------------------------------------


def asked_of(folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    """The exam and the robot of a result. Two results can be compared only if both are equal."""
    contract = read_contract(folder, args.edited)
    section = dict(contract.exam or {})
    if "kind" in section:
        if flag := "--ranges" if args.ranges else "--scene" if args.scene else "":
            raise UserError(f"{flag} is for the walking exam, but {folder} has another exam: leave it out")
        exam = {"kind": section["kind"], "rules": vars(contract_skill(contract))}
    else:
        rules = contract_rules(contract, args.ranges == "common")
        exam = {"kind": "walking", "hard": bool(contract.feet) and not args.no_hard, "rules": rules.to_mapping()}
        exam |= {"scene": typed(args.scene).name} if args.scene else {}
    request = {"exam": {**exam, "version": VERSION}, "robot": {"joints": list(contract.joints)}}
    return json.loads(json.dumps(request))  # tuples become lists, as in a result file


def check_alike(request: Mapping[str, Any], other: Mapping[str, Any], name: str, against: str) -> None:
    """Raise UserError if the exam or the robot of two results differ."""
    for path in (("robot", "joints"), *(("exam", key) for key in ("kind", "version", "scene", "hard", "rules"))):
        value, other_value = (each[path[0]].get(path[1]) for each in (request, other))
        if value != other_value:
            if isinstance(value, dict) and isinstance(other_value, dict):
                key = next(key for key in {**value, **other_value} if value.get(key) != other_value.get(key))
                path, value, other_value = (*path, key), value.get(key), other_value.get(key)
            difference = f"{': '.join(path)} is {_short(value)} of {name} and {_short(other_value)} of {against}"
            raise UserError(f"{difference}: exam and robot must be the same; write a new result with --json FILE")


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


# ---- grading ----------------------------------------------------------------------------------------------------------


class Repeat(NamedTuple):
    """The result of one repeat of the exam."""

    verdicts: dict[str, bool]
    figures: list[Figure]  # figures with a mark


def examine(folders: Sequence[Path], request: Mapping[str, Any], args: argparse.Namespace) -> dict[str, Any]:
    """Grade all exports with all seeds. Returns the result as plain values for JSON."""
    repeats, seeds = [], range(args.seed, args.seed + args.seeds)
    for name, folder in zip(args.policies, folders, strict=True):
        for seed in seeds:
            repeats.append(graded := grade(folder, request["exam"], seed, args))
            words = ", ".join(f"{word}: {'yes' if yes else 'no'}" for word, yes in graded.verdicts.items())
            print(f"{name}, seed {seed}: {words}", flush=True)
    contracts = [read_contract(folder, args.edited) for folder in folders]
    return {
        **request,
        "task": contracts[0].task,
        "policies": [
            {"policy": name, "sha256": contract.digest} for name, contract in zip(args.policies, contracts, strict=True)
        ],
        "seeds": list(seeds),
        "engine": f"MuJoCo {_version('mujoco')}, C engine",
        "legged_mw": _version("legged_mw"),
        "commit": commit(),
        "machine": machine(),
        "verdicts": {word: [each.verdicts[word] for each in repeats] for word in repeats[0].verdicts},
        "marks": marks_of([each.figures for each in repeats]),
    }


def grade(folder: Path, exam: Mapping[str, Any], seed: int, args: argparse.Namespace) -> Repeat:
    """Grade an export with one seed."""
    if exam["kind"] != "walking":
        skill = contract_skill(read_contract(folder, args.edited))
        result = run_skill(folder, skill, edited=args.edited, seed=seed)
        parts = result["parts"]
        each = [
            figure._replace(name=f"{part}: {figure.name}") for part in parts for figure in skill.figures(parts, part)
        ]
        return Repeat({"passes": result["passed"]}, named(each))
    rules, scene = ExamRules.from_mapping(exam["rules"]), typed(args.scene) if args.scene else SCENE_FILE
    result = run_exam(folder, rules, edited=args.edited, scene=scene, seed=seed)
    verdicts, figures = {"walks": result["walks"]}, rules.figures(result)
    if exam["hard"]:
        hard_result, _ = run_hard(folder, rules, result["walks"], args.edited, scene, seed)
        verdicts["ready for a robot"] = hard_result["ready"]
        figures += [*condition_figures(hard_result), *hard.figures(hard_result)]
    return Repeat(verdicts, named(figures))


def condition_figures(result: Mapping[str, Any]) -> list[Figure]:
    """The figures with a mark of the hard exam's conditions."""
    falls = sum(each["falls"] for each in result["conditions"].values())
    return [
        Figure("falls in commands under conditions", falls, 0, 0),
        Figure("pushes under all survived", result["conditions"][hard.ALL]["pushes"], 2, hard.PUSHES, None, True),
        Figure("falls in the gait measurement", float(result["looks"] is None), 0, 0),
    ]


def named(figures: Sequence[Figure]) -> list[Figure]:
    """The figures with a mark. The name of the row above is added to an indented row, so that names are unique."""
    result, parent = [], ""
    for figure in figures:
        parent = parent if figure.name.startswith(" ") else figure.name
        name = f"{parent}, {figure.name.strip()}" if figure.name.startswith(" ") else figure.name
        result += [figure._replace(name=name)] if figure.mark is not None else []
    return result


def marks_of(repeats: Sequence[Sequence[Figure]]) -> list[dict[str, Any]]:
    """Each mark with its values in all repeats, their mean, their worst value and the tolerance."""
    marks = []
    for name, figure in {figure.name: figure for each in repeats for figure in each}.items():
        values = [each.value for figures in repeats for each in figures if each.name == name]
        known = [float(value) for value in values if value is not None]
        mean, spread = fmean(known or [0.0]), max(known, default=0.0) - min(known, default=0.0)
        worst = min if figure.more_is_better else max
        marks.append(
            {
                "name": name,
                "mark": figure.mark,
                "more_is_better": figure.more_is_better,
                "mean": round(mean, 5) if known else None,
                "worst": worst(known) if known else None,
                "passes": bool(known) and figure._replace(value=worst(known)).passes(),
                "range": round(spread, 5),
                "tolerance": round(max(SPREAD * spread, SHARE * abs(mean), LEAST * abs(figure.mark or 0.0)), 5),
                "digits": figure.digits,
                "values": values,
            }
        )
    return marks


def commit() -> str:
    """The commit of the repository in the current folder, with -dirty if files are changed; "" without git."""
    try:
        words = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
        return subprocess.run(words, capture_output=True, text=True, timeout=10).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        return ""


def machine() -> str:
    """System, processor, and number of cores that this process may use."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{platform.system()}, {(models or [platform.machine()])[0]}, {usable_cores()} cores"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:  # imported from a folder, not installed
        return ""


# ---- comparison -------------------------------------------------------------------------------------------------------


def read_result(file: Path) -> dict[str, Any]:
    """Read a result that ``--json`` wrote. Raises UserError if the file is not such a result or is incomplete."""
    advice = "name a file that legged-mw exam POLICY --json FILE wrote"
    try:
        result = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"--against {shown(file)}: {error.strerror}; {advice}") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"--against {shown(file)}: it is incomplete or not JSON ({error}); {advice}") from None
    try:
        names = [each["name"] for each in result["marks"]]
        numbers = [each[key] for each in result["marks"] for key in ("mean", "tolerance", "digits")]
        valid = bool(names) and all(isinstance(number, int | float | None) for number in numbers)
        valid = valid and isinstance(result["robot"], dict) and isinstance(result["exam"], dict)
    except (LookupError, TypeError):
        valid = False
    if not valid:
        raise UserError(f"--against {shown(file)}: it is not a result of this program; {advice}")
    return result


def fallen(result: Mapping[str, Any], before: Mapping[str, Any]) -> list[str]:
    """One line for each mark that is worse than in ``before`` by more than its tolerance.

    Also for one that passed in all repeats and now fails in most: a mean over repeats that differ much hides it.
    """
    now, lines = {each["name"]: each for each in result["marks"]}, []
    for was in before["marks"]:
        new, digits = now.get(was["name"], {"mean": None}), was["digits"]
        if was["mean"] is None:
            continue
        if new["mean"] is None:
            lines.append(f"{was['name']}: not measured, was {was['mean']:.{digits}f}")
            continue
        tolerance = max(was["tolerance"], new["range"])
        worse = was["mean"] - new["mean"] if was["more_is_better"] else new["mean"] - was["mean"]
        if worse > tolerance:
            details = f"tolerance {tolerance:.{max(digits, 3)}f}, mark {was['mark']:g}"
            lines.append(f"{was['name']}: {new['mean']:.{digits}f}, was {was['mean']:.{digits}f} ({details})")
        elif was.get("passes") and 2 * (failed := _failures(new, was)) > len(new["values"]):
            lines.append(f"{was['name']}: fails in {failed} of {len(new['values'])} repeats, passed in all before")
    return lines


def _failures(new: Mapping[str, Any], was: Mapping[str, Any]) -> int:
    """The number of repeats that fail a mark, each worse than its old mean by more than its old tolerance."""
    figure = Figure(new["name"], None, new["digits"], new["mark"], more_is_better=new["more_is_better"])
    sign = -1.0 if new["more_is_better"] else 1.0
    known = [value for value in new["values"] if value is not None]
    failed = [value for value in known if not figure._replace(value=value).passes()]
    return sum(sign * (value - was["mean"]) > was["tolerance"] for value in failed)


def table(result: Mapping[str, Any], before: Mapping[str, Any] | None) -> str:
    """The marks as a text table. The marks of ``before`` have their own column."""
    heads = ["mean", "worst", "mark", "passes", *(["was", "tolerance"] if before else ["tolerance"])]
    old = {each["name"]: each for each in before["marks"]} if before else {}
    lines = [
        f"{result['exam']['kind']} exam, {result['engine']}, {len(next(iter(result['verdicts'].values())))} repeats"
    ]
    lines.append(f"{'':<44}{''.join(f'{head:>11}' for head in heads)}")
    for each in result["marks"]:
        was, digits = old.get(each["name"], {}), each["digits"]
        numbers = [each["mean"], each["worst"], each["mark"]]
        cells = [_cell(number, digits) for number in numbers] + ["yes" if each["passes"] else "no"]
        cells += [_cell(was.get("mean"), digits)] if before else []
        cells += [_cell((was if before else each).get("tolerance"), max(digits, 3))]
        lines.append(f"{each['name']:<44}{''.join(f'{cell:>11}' for cell in cells)}")
    return "\n".join(lines)


def _cell(number: float | None, digits: int) -> str:
    return "-" if number is None else f"{number:.{digits}f}"


# ---- the badge --------------------------------------------------------------------------------------------------------


GOOD, BAD, PLAIN = "#2e7d32", "#c62828", "#444"
LETTER, PAD, HEIGHT = 7.0, 8.0, 20  # [px]


def badge(result: Mapping[str, Any]) -> str:
    """An SVG with the task's name and the last verdict that is true in all repeats."""
    held = [word for word, repeats in result["verdicts"].items() if all(repeats)]
    word = (
        held[-1] if held else {"walks": "does not walk"}.get(first := next(iter(result["verdicts"])), f"not: {first}")
    )
    left, right = (LETTER * len(text) + 2 * PAD for text in (result["task"], word))
    texts = [(PAD, result["task"]), (left + PAD, word)]
    drawn = "".join(
        f'<text x="{x:g}" y="14" textLength="{LETTER * len(text):g}" fill="#fff">{escape(text)}</text>'
        for x, text in texts
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{left + right:g}" height="{HEIGHT}" font-family="sans-serif" font-size="12">'
        f'<rect width="{left + right:g}" height="{HEIGHT}" rx="3" fill="{PLAIN}"/>'
        f'<rect x="{left:g}" width="{right:g}" height="{HEIGHT}" rx="3" fill="{GOOD if held else BAD}"/>{drawn}</svg>\n'
    )
