"""A reward term's formula, from its code: the return statement in the signs that people use, and where its names come from."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Callable

from legged_mw.envs.legged_robot import PHASE_SIGMA

SIGNS: dict[type, str] = {
    **{ast.Add: " + ", ast.Sub: " - ", ast.Mult: " · ", ast.Div: " / ", ast.MatMult: " @ "},
    **{ast.Lt: " < ", ast.Gt: " > ", ast.LtE: " ≤ ", ast.GtE: " ≥ ", ast.Eq: " = "},
    **{ast.BitAnd: " and ", ast.BitOr: " or ", ast.BitXor: " xor ", ast.USub: "-", ast.Invert: "not ", ast.Pow: "^"},
}
_SUM, _LOGIC = (ast.Add, ast.Sub), (ast.BitAnd, ast.BitOr)
# what stands in brackets to the left, and to the right
LOOSE: dict[type, tuple[tuple[type, ...], tuple[type, ...]]] = {
    **{ast.Add: (_LOGIC, _LOGIC), ast.Sub: (_LOGIC, (*_SUM, *_LOGIC)), ast.Mult: ((*_SUM, *_LOGIC), (*_SUM, *_LOGIC))},
    **{ast.Div: ((*_SUM, *_LOGIC), (ast.operator,)), ast.BitAnd: ((), ()), ast.BitOr: ((), ())},
}
PREFIXES = ("self.", "cfg.rewards.", "cfg.", "torch.")
SAME = {"float", "clone", "flatten", "unsqueeze", "masked_fill_"}  # what changes a shape or a type, not a value
WORDS = {  # names that say less than words do
    **{"_on_one_foot()": "on exactly one foot", "_clock('contact_phase').wants_contact()": "the clock's wish"},
    **{
        "_clock('feet_phase').swing()": "share of the swing by the clock",
        "self_contacts_x": "self_contacts",
        "contacts.penalized": "penalized",
    },
    **{"_is_upright()": "upright", "_is_up()": "up", "PHASE_SIGMA": f"{PHASE_SIGMA:g}", "2 · pi": "2π"},
    **{
        "(error / -tracking_sigma)": "(-error / tracking_sigma)",
        "exp(Σ (foot_height - wanted)² / -": "exp(-Σ (foot_height - wanted)² / ",
    },
    "quat_rotate(sim.xquat[foot_bodies], foot_up)": "the foot's own vertical in the world's frame",
}
WRAPPED = {"abs": "|{}|", "norm": "‖{}‖", "sqrt": "√({})", "square": "({})²"}
REDUCED = {"sum": "Σ", "mean": "mean", "amax": "max", "amin": "min", "any": "any", "all": "all", "var": "var"}


def formula(term: Callable[..., object]) -> str:
    """One line: what ``term`` returns; `where` names what it works out first."""
    [function] = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(term)))).body
    assert isinstance(function, ast.FunctionDef)
    names, results = [], []
    _read(function.body, names, results, "")
    text = "; ".join(results)
    wanted = [f"{name} = {value}" for name, value in names if name in text or any(name in other for _, other in names)]
    whole = f"{text}, where {', '.join(wanted)}" if wanted else text
    whole = re.sub(r"(?<=\d)\.0\b", "", whole).replace("[:,self.anchor,None]", "[anchor]")
    for name, words in WORDS.items():
        whole = whole.replace(name, words)
    return whole


def _read(body: list[ast.stmt], names: list[tuple[str, str]], results: list[str], condition: str) -> None:
    for line in body:
        if isinstance(line, ast.Assign) and not isinstance(line.value, ast.Constant):
            names.append((_tidy(ast.unparse(line.targets[0])).strip("()"), _write(line.value)))
        elif isinstance(line, ast.Return) and line.value is not None:
            results.append(_write(line.value) + condition)
        elif isinstance(line, ast.If):
            _read(line.body, names, results, f" if {_write(line.test)}")
            condition = ", else" if condition else ""


def _tidy(text: str) -> str:
    for prefix in PREFIXES:
        text = text.replace(prefix, "")
    return text


def _simple(text: str) -> bool:
    return text.replace("_", "").replace(".", "").isalnum() or (
        text[-1] in "|‖]²)" and not any(sign in text for sign in (" + ", " - ", " · ", " / ", " = "))
    )


def _write(node: ast.expr) -> str:
    """``node`` in signs; what has none stays Python."""
    if isinstance(node, ast.Call):
        return _call(node)
    if isinstance(node, ast.BinOp):
        left, right = LOOSE.get(type(node.op), ((ast.operator,), (ast.operator,)))
        return f"{_side(node.left, left)}{SIGNS.get(type(node.op), ' ? ')}{_side(node.right, right)}"
    if isinstance(node, ast.UnaryOp):
        return f"{SIGNS[type(node.op)]}{_side(node.operand)}"
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        return f"{_write(node.left)}{SIGNS.get(type(node.ops[0]), ' ? ')}{_write(node.comparators[0])}"
    if isinstance(node, ast.Subscript):
        inside = ast.unparse(node.slice).strip("()").replace("...", ":").replace(" ", "")
        only = {":,:2": "_xy", ":,0": "_x", ":,1": "_y", ":,2": "_z", ":,:,2": "_z", ":,None": "", ":,None,:": ""}
        parts = inside.split(",")
        return f"{_write(node.value)}{only.get(inside, '[' + inside + ']' if len(parts) > 1 else '')}"
    return _tidy(ast.unparse(node))


def _side(node: ast.expr, loose: tuple[type, ...] = (*_SUM, *_LOGIC)) -> str:
    """An operand, in brackets where it needs them."""
    inner = isinstance(node, ast.BinOp) and isinstance(node.op, loose)
    return f"({_write(node)})" if inner or isinstance(node, ast.Compare) else _write(node)


def _call(node: ast.Call) -> str:
    function, given = node.func, {word.arg: word.value for word in node.keywords}
    if not isinstance(function, ast.Attribute):
        return f"{_tidy(ast.unparse(function))}({', '.join(map(_write, node.args))})"
    name, of_torch = function.attr, isinstance(function.value, ast.Name) and function.value.id == "torch"
    args = list(node.args) if of_torch else [function.value, *node.args]
    if name == "where" and len(args) == 3:
        return f"{_write(args[1])} if {_write(args[0])} else {_write(args[2])}"
    if name == "ones_like":
        return "1"
    if name == "masked_fill_":
        return f"0 if {_write(args[1])} else {_write(args[0])}"
    if not args:
        return _tidy(ast.unparse(node))
    first = _write(args[0])
    if name in SAME:
        return first
    if name == "index_select":
        return f"{first}[{_tidy(ast.unparse(args[2]))}]"
    if name == "square":
        return f"{first if _simple(first) else f'({first})'}²"
    if name in WRAPPED:
        return WRAPPED[name].format(first)
    if name in REDUCED:
        return f"{REDUCED[name]} {first if _simple(first) or first.startswith('(') else f'({first})'}"
    if name == "clamp":
        return _clamp(first, args[1:], given)
    if name == "_near":  # MotionTracking's
        return f"exp(-mean {_write(args[1])} / {_write(args[2])}²)"
    if of_torch or isinstance(function.value, ast.Name):
        return f"{name}({', '.join(map(_write, args if of_torch else args[1:]))})"
    return _tidy(ast.unparse(node))


def _clamp(first: str, args: list[ast.expr], given: dict[str | None, ast.expr]) -> str:
    bounds = [*args, given.get("min"), given.get("max")] if not args else [*args, None]
    low, high = bounds[:2] if len(args) != 1 else (args[0], given.get("max"))
    if isinstance(low, ast.Starred):
        return f"clip({first}, {_tidy(ast.unparse(low.value))})"
    if low is not None and high is not None:
        return f"clip({first}, {_write(low)}, {_write(high)})"
    return (
        f"max({first}, {_write(low)})"
        if low is not None
        else f"min({first}, {_write(high)})"
        if high is not None
        else first
    )
