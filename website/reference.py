"""Tables of all reward terms, observation rows and config fields, made from the code: formulas, comments, defaults, environments."""

from __future__ import annotations

import ast
import importlib
import inspect
import io
import pkgutil
import re
import textwrap
import tokenize
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from configs import base
from legged_mw import envs, skills
from legged_mw.deploy.contract import ROWS
from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.envs.robot_task import RobotTask
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.rl import learner_config
from legged_mw.utils.bounds import bounds_text
from legged_mw.utils.config import Config, field_types, type_text
from legged_mw.utils.task import load_task

UNITS = {*["m", "rad", "s", "ms", "N", "kg", "W", "deg", "mm", "Hz", "pixel", "iterations"], "-", ""}
TERMS: dict[str, str] = {  # a class with terms of its own -> heading; others come after these, by their names
    "RobotTask": "Of every task",
    "LeggedRobot": "Of walking by command",
    "Getup": "Of getting up",
    "Handstand": "Of handstand and footstand",
    "MotionTracking": "Of following a motion",
}
TASKS = ["go1_flat", "go1_rough", "go2_flat", "go2_rough", "g1_flat", "g1_rough"]
EVERYTHING = {  # of a walking task: all rows that a flag switches on
    **{"env.num_envs": 1, "observations.foot_height": True, "observations.contact_forces": True, "gait.period": 0.8},
    **{
        "gait.offsets": [0.0, 0.5, 0.5, 0.0],
        "domain_rand.enable": True,
        "domain_rand.observe": True,
        "observations.leave_out": {},
    },
    **{"terrain.num_rows": 1, "terrain.num_cols": 8, "terrain.height_scan": ["state", "privileged_state"]},
}
ENVS: list[tuple[str, str, dict[str, Any]]] = [
    ("Walking by command, everything switched on (`go1_rough_scan`: 12 joints, 4 feet)", "go1_rough_scan", EVERYTHING),
    ("Getting up, handstand (`go1_getup`)", "go1_getup", {"env.num_envs": 1, "falls.states": 4}),
    ("Following a motion (`g1_track`: 29 joints, 14 bodies)", "g1_track", {"env.num_envs": 1}),
]
CONFIGS: dict[str, str] = {  # likewise
    "RobotTaskCfg": "The environment of every task",
    "LeggedRobotCfg": "Walking by command adds",
    "SimToRealCfg": "For a real robot on four legs",
    "SimToRealRoughCfg": "On rough ground",
    "BipedCfg": "On two legs",
    "BipedRoughCfg": "On two legs and rough ground",
    "GetupCfg": "Getting up",
    "HandstandCfg": "Handstand and footstand",
    "MotionTrackingCfg": "Following a motion",
    "RobotTaskCfgPPO": "The learner of every task",
    "LeggedRobotCfgPPO": "The learner of a walking task",
}


class Said(NamedTuple):
    """What a docstring or comment says: words, units, sources."""

    words: str
    unit: str
    source: str


def read_comment(text: str) -> Said:
    """Square brackets hold a unit, `[m/s]`, or a source, `[P]`, `[ours: why]`; what is left are the words."""
    inside = re.findall(r"\[([^\[\]]*)\]", text)
    units = [each for each in inside if is_unit(each)]
    sources = [each for each in inside if not is_unit(each) and re.match(r"[A-Z]|ours|unitree|genesis|go2_rl", each)]
    words = text
    for each in [*units, *sources]:
        words = words.replace(f"[{each}]", "")
    return Said(
        re.sub(r"\s+([.,:;)])(?=\s|$)", r"\1", " ".join(words.replace("``", "`").split())).strip(" ;,."),
        ", ".join(dict.fromkeys(units)),
        "; ".join(sources),
    )


def is_unit(text: str) -> bool:
    """Whether ``text`` is `m/s`, `kg m^2`, `rad or rad/s`, `m, world`, and not a source."""
    words = re.split(r"[ ,/]+|\bor\b|\^-?[\d.]+", re.sub(r",? (world|body)( frame)?$", "", text))
    return all(word in UNITS or word == "1" for word in words)


def cell(text: Any) -> str:
    return str(text).replace("|", "\\|").replace("\n", " ")


def code(text: Any) -> str:
    return f"`{text}`".replace("|", "\\|") if str(text) else ""


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(head)
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([f"| {' | '.join(head)} |", "| " + " | ".join("---" for _ in head) + " |", *lines])


def classes(headings: Mapping[str, str], wanted: Callable[[type], object]) -> list[tuple[str, Any]]:
    """Heading and class of those that are ``wanted``, of environments, skills, presets and the learner's config."""
    modules = [
        *(
            importlib.import_module(f"{package.__name__}.{module.name}")
            for package in (envs, skills)
            for module in pkgutil.iter_modules(package.__path__)
        ),
        *(base, learner_config),
    ]
    mine = {module.__name__ for module in modules}
    classes_there = [each for module in modules for each in vars(module).values() if isinstance(each, type)]
    found = {each.__name__: each for each in classes_there if each.__module__ in mine and wanted(each)}
    order = [*(name for name in headings if name in found), *sorted(found.keys() - headings.keys())]
    return [(headings.get(name, f"`{name}`"), found[name]) for name in order]


# ---- reward terms


def terms_of(owner: type) -> dict[str, Any]:
    return {name.removeprefix("_reward_"): term for name, term in vars(owner).items() if name.startswith("_reward_")}


def body(term: Any) -> str:
    """What ``term`` does, statement by statement, without its docstring."""
    [function] = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(term)))).body
    assert isinstance(function, ast.FunctionDef)
    return re.sub(r"\s+", " ", "; ".join(map(ast.unparse, function.body[1:]))).replace("self.", "")


def rewards() -> str:
    """All terms by the class that has them, then their scales in the tasks that ship."""
    parts = []
    for heading, owner in classes(TERMS, terms_of):
        rows = []
        for name, term in terms_of(owner).items():
            said = read_comment(inspect.getdoc(term) or "")
            rows.append(
                [
                    code(name),
                    cell(said.words),
                    code(body(term)),
                    cell(said.unit) or "1",
                    cell(said.source),
                    default_scale(owner, name),
                ]
            )
        parts += [
            f"### {heading}",
            table(["term", "what it measures", "code", "unit", "source", "default scale"], rows),
        ]
    return "\n\n".join([*parts, "### Scales in the tasks", _scales()])


def default_scale(owner: type, name: str) -> str:
    """Of the config that stands with a class: a walking task's for terms that all tasks have."""
    named = {config.__name__: config for _, config in classes(CONFIGS, is_config)}
    config = LeggedRobotCfg if owner is RobotTask else named.get(f"{owner.__name__}Cfg", LeggedRobotCfg)
    scales = config().to_dict()["rewards"]["scales"]
    return f"{scales[name]:g}" if scales.get(name) else "off"


def _scales() -> str:
    configs = [load_task(task).cfg.to_dict()["rewards"]["scales"] for task in TASKS]
    names = sorted({name for scales in configs for name, scale in scales.items() if scale})
    return table(
        ["term", *map(code, TASKS)],
        [[code(name), *(f"{s[name]:g}" if s.get(name) else "" for s in configs)] for name in names],
    )


# ---- observation rows


def row_comments() -> dict[str, Said]:
    """What stands behind a row where the code makes it, or in a line above."""
    said: dict[str, Said] = {}
    for _, owner in classes({}, lambda each: "observation_rows" in dir(each)):
        for name, comment in re.findall(r'Row\("(\w+)",[^\n]*?\)?,?  # ([^\n]*)', inspect.getsource(owner)):
            said.setdefault(name, read_comment(comment))
        for comment, name in re.findall(r'\n *# ([^\n]*)\n[^\n#]*Row\("(\w+)"', inspect.getsource(owner)):
            said.setdefault(name, read_comment(comment))
    for path, field in fields(RobotTaskCfg).items():
        if path.startswith("domain_rand."):
            said.setdefault(path.removeprefix("domain_rand."), field.said)
    return said


def observations() -> str:
    """The rows of each group of three environments, built with all that a flag switches on."""
    comments, parts = row_comments(), []
    for heading, name, overrides in ENVS:
        task = load_task(name)
        for path, value in overrides.items():
            task.set(path, value)
        env = task.env_class(task.cfg, "cpu")
        for group, rows in env.observations.groups.items():
            lines = []
            for row in rows:
                known, said = ROWS.get(row.name), comments.get(row.name, Said("", "", ""))
                unit = row.unit or (known.unit if known else "") or said.unit
                words = known.frame if known else " · ".join(filter(None, [said.words, row.frame]))
                words = f"the group `{row.name}`, the same noisy sample" if row.group else words
                noise = f"±{row.noise * env.cfg.noise.level:g}" if row.noise else ""
                lines.append([code(row.name), str(row.size), cell(words), cell(unit), noise, cell(row.mirror or "")])
            size = sum(row.size for row in rows)
            parts.append(
                f"**`{group}`**, {size} columns\n\n"
                + table(["row", "columns", "what", "unit", "noise", "mirror"], lines)
            )
        parts.insert(len(parts) - len(env.observations.groups), f"### {heading}")
    return "\n\n".join(parts)


# ---- config fields


class Field(NamedTuple):
    """A field where a class declares or overrides it."""

    kind: str  # its annotation, "" where it is overridden
    value: Any
    said: Said


def fields(config: type) -> dict[str, Field]:
    """Fields that ``config`` writes itself, by their dotted path."""
    source = textwrap.dedent(inspect.getsource(config))
    comments = {
        token.start[0]: (token.string.lstrip("# "), token.line.strip().startswith("#"))
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT and token.string != "# fmt: skip"
    }
    [tree] = ast.parse(source).body
    assert isinstance(tree, ast.ClassDef)
    return dict(_fields(tree, config, "", comments))


def _fields(
    tree: ast.ClassDef, owner: Any, prefix: str, comments: dict[int, tuple[str, bool]]
) -> Iterator[tuple[str, Field]]:
    for line in tree.body:
        if isinstance(line, ast.ClassDef):
            yield from _fields(line, getattr(owner, line.name), f"{prefix}{line.name}.", comments)
        if not isinstance(line, ast.Assign | ast.AnnAssign):
            continue
        above, number = [], line.lineno - 1
        while number in comments and comments[number][1]:
            above.insert(0, comments[number][0])
            number -= 1
        behind = [comments[n][0] for n in range(line.lineno, (line.end_lineno or line.lineno) + 1) if n in comments]
        said = read_comment(" ".join([*above, *behind]).replace("fmt: skip", ""))
        kind = ast.unparse(line.annotation) if isinstance(line, ast.AnnAssign) else ""
        targets = [line.target] if isinstance(line, ast.AnnAssign) else line.targets
        for target in targets:
            for name in target.elts if isinstance(target, ast.Tuple) else [target]:
                if isinstance(name, ast.Name) and not name.id.startswith("_"):
                    yield f"{prefix}{name.id}", Field(kind, getattr(owner, name.id), said)


def bounds(kind: Any) -> str:
    """The type, and what a value of it must be, in the words that errors use."""
    choices, words = re.fullmatch(r"Literal\[(.*)\]", text := type_text(kind)), bounds_text(kind)
    return (
        choices.group(1).replace("'", "`").replace('"', "`")
        if choices
        else code(text) + (f": {cell(words)}" if words else "")
    )


def is_config(each: type) -> bool:
    return issubclass(each, Config)


def config_fields() -> str:
    """Every field of every config class, in sections as they are written."""
    parts = []
    for heading, config in classes(CONFIGS, is_config):
        written = fields(config)
        if not written:
            continue
        changes = not any(field.kind for field in written.values())
        parent = config.__mro__[1].__name__
        whose = (
            f"`{config.__name__}`"
            if parent == "Config"
            else f"`{config.__name__}({parent})`{' changes:' if changes else ''}"
        )
        parts.append(f"## {heading}\n\n{whose}")
        sections: dict[str, list[list[str]]] = {}
        kinds = dict(field_types(config))
        for path, field in written.items():
            section, _, name = path.rpartition(".")
            text = f"{field.value:g}" if isinstance(field.value, float) else repr(field.value)
            text = text if len(text) < 70 else text[:60] + " ..."
            limits = bounds(kinds[path]) if field.kind else "overridden"
            line = [code(name), code(text), limits, cell(field.said.unit), cell(field.said.words)]
            sections.setdefault(section, []).append([*line, cell(field.said.source)])
        head = ["field", "default", "type, bounds", "unit", "what", "source"]
        if changes:
            whole = [
                [code(f"{section}.{row[0].strip('`')}"), row[1], *row[3:]]
                for section, rows in sections.items()
                for row in rows
            ]
            parts.append(table(["field", "default", "unit", "what", "source"], whole))
            continue
        parts += [(f"### `{section}`\n\n" if section else "") + table(head, rows) for section, rows in sections.items()]
    return "\n\n".join(parts)


MADE = {"rewards": rewards, "observations": observations, "config": config_fields}  # what `<!-- made: NAME -->` heads
DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGES = ("rewards.md", "config.md")  # of DOCS, which hold such tables
_TABLES = re.compile(r"(<!-- made: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def renew(page: str) -> str:
    """The text of a page with its tables made again from the code."""
    return _TABLES.sub(lambda found: f"{found[1]}\n{MADE[found[2]]()}\n\n{found[3]}", page)


def main() -> None:
    """Write the tables of ``PAGES`` again: ``python -m website.reference``, after a term, a row or a field changed."""
    for name in PAGES:
        page = DOCS / name
        page.write_text(renew(page.read_text()))


if __name__ == "__main__":
    main()
