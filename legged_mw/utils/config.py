"""Class-based configuration: a field is declared once, with a type, and every later value of it is checked.

This module has the rule (annotated = declares, bare = overrides) and the types of fields; utils/bounds.py has their
bounds. It has no fields of robots, simulators or learners.
"""

from __future__ import annotations

import difflib
import inspect
import keyword
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from numbers import Integral, Real
from types import NoneType, SimpleNamespace, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeGuard, Union, get_args, get_origin, get_type_hints
from weakref import WeakKeyDictionary

from legged_mw.utils.bounds import bare, bounds_of, bounds_text
from legged_mw.utils.errors import ConfigError, brief
from legged_mw.utils.files import note_file
from legged_mw.utils.yaml_file import load_yaml, parse_yaml, save_yaml

__all__ = ["Config", "ConfigError", "OutOfBounds", "field_types", "fit", "load_yaml", "save_yaml", "type_text"]

_TYPES = (int, float, bool, str, NoneType, list, dict, Any)
_PLAIN = None | bool | int | float | str | list | dict  # values of a field of type `Any`: all types of YAML
_SCHEMAS: WeakKeyDictionary[type, dict[str, Any]] = WeakKeyDictionary()


class OutOfBounds(ConfigError):
    """A value of the right type that is outside of the bounds of its field."""


def _schema(cls: type) -> dict[str, Any]:
    """Name -> type of a field or class of a section, those of the parents first. The first call checks `cls`."""
    if cls in _SCHEMAS:
        return _SCHEMAS[cls]
    known: dict[str, Any] = {}
    for base in reversed(cls.__bases__):
        known |= _schema(base)
    fields = dict(known)
    for name in dict.fromkeys([*known, *vars(cls), *inspect.get_annotations(cls)]):
        if name.startswith("_"):
            continue
        try:
            kind = _check(cls, name, known)
        except ConfigError as error:
            raise ConfigError(f"{_place(cls, name)}: {error}") from None
        if kind is not None:
            fields[name] = kind
        if _is_section(kind):
            _schema(kind)
            fields[name].__setattr__ = _guarded_setattr  # the only attribute that is added to a section's class
    if vars(cls).get("_only"):  # inherited fields that `cls` does not set are 0
        if not getattr(cls, "_open", False):
            wrong = f"{_path(cls)} is not an open table of numbers: leave `_only` out of it"
            raise ConfigError(f"{_place(cls, '_only')}: {wrong}")
        for name in known.keys() - vars(cls).keys():
            setattr(cls, name, 0.0)
    return _SCHEMAS.setdefault(note_file(cls), fields)


def _check(cls: type, name: str, known: dict[str, Any]) -> Any:
    """The type or section of `name` in `cls`; None for a method. `known`: the fields of the parents."""
    path, inherited, value = f"{_path(cls)}.{name}", known.get(name), getattr(cls, name, None)
    parent, annotated = cls.__bases__[0], name in inspect.get_annotations(cls)
    if _is_section(value) and not annotated:
        return _check_section(cls, name, value, known)
    if name not in vars(cls) and not annotated:
        return inherited
    if inherited is None and not annotated and (inspect.isroutine(value) or isinstance(value, property)):
        return None
    if _is_section(inherited):
        write = f"`class {name}({_parents(cls, name)}):` and its fields below"
        raise ConfigError(f"{path} is a section, not a field; write {write}")
    if inherited is None and any(hasattr(base, name) for base in cls.__bases__):
        raise ConfigError(f"{path} would hide the method '{name}' of {_path(parent)}; choose another name")
    if annotated:
        kind = _declared_type(cls, name, inherited)
    elif inherited is None and not getattr(cls, "_open", False):
        hint = _nearest(name, known) + (f"; {_path(parent)} has: {', '.join(known)}" if known else "")
        declaration = f"`{name}: {type(value).__name__} = {value!r}`"
        raise ConfigError(f"{path} overrides nothing{hint}; if the field is new, declare it with a type: {declaration}")
    else:
        kind = float if inherited is None else inherited
    setattr(cls, name, fit(value, kind, path))
    return kind


def _check_section(cls: type, name: str, section: type, known: dict[str, Any]) -> type:
    """The section `name` of `cls`. Raises ConfigError unless it extends those of all parents of `cls`.

    Also for a new one that extends a section of nearly the same name, which is a name written wrong.
    """
    path, inherited = f"{_path(cls)}.{name}", known.get(name)
    if inherited is None and (near := difflib.get_close_matches(name, known, n=1)):
        others = [vars(base).get(near[0]) for base in cls.__mro__[1:]]
        if any(_is_section(other) and issubclass(section, other) for other in others):
            write = f"write `class {near[0]}({_parents(cls, near[0])}):`"
            raise ConfigError(f"{path} overrides nothing: it extends section '{near[0]}'; {write}")
    if inherited is not None and not _is_section(inherited):
        raise ConfigError(f"{path} is a field ({type_text(inherited)}), not a section; write `{name} = ...`")
    inherited_sections = [_schema(base)[name] for base in cls.__bases__ if name in _schema(base)]
    if name not in vars(cls):
        return _joined(cls, name, inherited_sections)
    for dropped in inherited_sections:
        if not issubclass(section, dropped):
            extends = ", ".join(_path(base) for base in section.__bases__ if base is not object) or "no section"
            fields = f"{_path(dropped)} ({', '.join(_schema(dropped))})"
            write = f"`class {name}({_parents(cls, name)}):`"
            raise ConfigError(f"{path} extends {extends} and so drops the fields of {fields}; write {write}")
    return section


def _joined(cls: type, name: str, sections: list[type]) -> type:
    """The section of a class that does not write it: the fields of all parents' `sections`. The first parent wins."""
    last = _last(sections)
    joined = last[0]
    if len(last) > 1:
        names = {"__module__": cls.__module__, "__qualname__": f"{cls.__qualname__}.{name}"}
        joined = type(name, tuple(last), names)
    if joined is not getattr(cls, name):
        setattr(cls, name, joined)
    return joined


def _last(sections: list[type]) -> list[type]:
    """The `sections` that no other one extends, each once."""
    return [
        section
        for section in dict.fromkeys(sections)
        if not any(other is not section and issubclass(other, section) for other in sections)
    ]


def _declared_type(cls: type, name: str, inherited: Any) -> Any:
    """The annotation of `name` in `cls`. Raises ConfigError if it is not supported, has no value, or differs from the
    parents'.
    """
    path, written = f"{_path(cls)}.{name}", inspect.get_annotations(cls)[name]
    names = vars(sys.modules[cls.__module__]) if cls.__module__ in sys.modules else {}
    try:
        kind = get_type_hints(SimpleNamespace(__annotations__={name: written}), names, include_extras=True)[name]
    except (NameError, AttributeError, SyntaxError, TypeError) as error:
        hint = f"import its names at the top level of module {cls.__module__}"
        raise ConfigError(f"{path}: its type {written!r} cannot be resolved ({error}); {hint}") from None
    if not _is_supported(kind):
        choice = "int, float, bool, str, None, list[T], dict[str, T], Literal[...], Any, T | U; `class` makes a section"
        raise ConfigError(f"{path}: type {type_text(kind)} is not supported; there are {choice}")
    if name not in vars(cls):
        raise ConfigError(f"{path} has a type but no value; write `{name}: {type_text(kind)} = ...`")
    if inherited is None:
        return kind
    if bare(inherited) == bare(kind) and bounds_text(kind) in ("", bounds_text(inherited)):
        return inherited
    first = _path(next(base for base in cls.__mro__[1:] if name in _schema(base)))
    declared, here = (
        type_text(each) + (f" ({bounds_text(each)})" if bounds_text(each) else "") for each in (inherited, kind)
    )
    raise ConfigError(f"{path} is a {declared} in {first}, not a {here}; to override it write `{name} = ...`")


def _is_supported(kind: Any) -> bool:
    origin, args = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _is_supported(args[0])
    if origin is Literal:
        return all(type(choice) in _TYPES for choice in args)
    if origin is dict:
        return args[0] is str and _is_supported(args[1])
    if origin in (list, Union, UnionType):
        return all(map(_is_supported, args))
    return kind in _TYPES


def _is_section(kind: Any) -> TypeGuard[type]:
    return isinstance(kind, type) and kind not in _TYPES


def _path(cls: type) -> str:
    """The dotted path of a section, as `Go1.rewards.scales`: Python's qualified name of the nested class."""
    return cls.__qualname__.rpartition("<locals>.")[2]


def _parents(cls: type, name: str) -> str:
    """The section `name` of the parents as a class statement lists it: without those that another one extends."""
    owners: dict[type, str] = {}  # section -> its name in the first parent that has it
    for base in cls.__bases__:
        if name in _schema(base):
            owners.setdefault(_schema(base)[name], f"{_path(base)}.{name}")
    return ", ".join(owners[section] for section in _last([*owners]))


def type_text(kind: Any) -> str:
    """The type in Python's notation, without its bounds."""
    kind = bare(kind)
    if get_origin(kind) is Union:  # a union with a Literal
        return " | ".join("None" if arm is NoneType else type_text(arm) for arm in get_args(kind))
    return kind.__name__ if isinstance(kind, type) else str(kind).replace("typing.", "")


def _nearest(name: str, fields: Mapping[str, Any] | Iterable[str]) -> str:
    """`; did you mean ...?` with the nearest name, else with the same name in a nested section; else ''."""
    near = difflib.get_close_matches(name, fields, n=1)
    if not near and isinstance(fields, Mapping):
        near = [path for path, _ in _walk(fields) if path.rpartition(".")[2] == name]
    return f"; did you mean '{near[0]}'?" if near else ""


def field_types(cls: type) -> Iterator[tuple[str, Any]]:
    """(dotted path, type) of every field of a config class, in the order of declaration."""
    yield from _walk(_schema(cls))


def _walk(fields: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, kind in fields.items():
        yield from _walk(_schema(kind), f"{prefix}{name}.") if _is_section(kind) else [(prefix + name, kind)]


def _place(cls: type, name: str) -> str:
    """`file:line` where `cls` sets `name`. It reads the source, which is slow, so only errors use it."""
    try:
        lines, first = inspect.getsourcelines(cls)
    except (OSError, TypeError):  # no source file: made at a prompt or by code
        return f"module {cls.__module__}"
    written = [i for i, line in enumerate(lines) if re.match(rf"\s+(class\s+)?{name}\s*[:=(]", line)]
    outermost = min(written, key=lambda i: len(lines[i]) - len(lines[i].lstrip()), default=0)
    return f"{inspect.getsourcefile(cls)}:{first + outermost}"


def fit(value: Any, kind: Any, path: str) -> Any:
    """`value` as the type `kind`: an int may become a float, containers are copied. Raises ConfigError with `path`."""
    origin: Any = get_origin(kind) or kind
    args = get_args(kind)
    if _is_section(kind):
        raise ConfigError(f"{path} is a section, not a field; set one of its fields: {', '.join(_schema(kind))}")
    if origin is Annotated:
        try:
            fitted = fit(value, args[0], path)
        except OutOfBounds:
            if args[0] in (int, float):
                _within(value, kind, path)  # the bounds of the field are more specific than those of all numbers
            raise
        return _within(fitted, kind, path)
    if kind is Any or origin in (Union, UnionType):
        return _fit_one_of(value, _PLAIN if kind is Any else kind, path)
    if origin is Literal and any(type(value) is type(choice) and value == choice for choice in args):
        return value
    if origin is list and isinstance(value, list | tuple):
        of = args[0] if args else Any
        return [fit(item, of, f"{path}[{i}]") for i, item in enumerate(value)]
    if origin is dict and isinstance(value, Mapping):
        of = args[1] if args else Any
        return {fit(key, str, f"{path}: key"): fit(item, of, f"{path}[{key!r}]") for key, item in value.items()}
    if isinstance(value, {float: Real, int: Integral}.get(origin, ())) and not isinstance(value, bool):
        return (float if origin is float else int)(_within(value, kind, path))
    if origin in (bool, str, NoneType) and type(value) is origin:
        return _within(value, kind, path)
    hint = _nearest(value, map(str, args)) if origin is Literal and isinstance(value, str) else ""
    if origin is dict and args and bare(args[1]) is float and type(value) in (int, float):
        hint = f"; write {{NAME: {value:g}}}, or in a table a joint {{'': {value:g}}} for all"
    raise ConfigError(f"{path} must be {type_text(kind)}, not {brief(value)} ({type(value).__name__}){hint}")


def _fit_one_of(value: Any, kind: Any, path: str) -> Any:
    """`value` as one of the types of a union. The type of `value` is tried first: 3 stays an int in `float | int`."""
    outside: list[OutOfBounds] = []
    for arm in sorted(get_args(kind), key=lambda arm: (get_origin(bare(arm)) or bare(arm)) is not type(value)):
        try:
            return fit(value, arm, path)
        except OutOfBounds as error:
            outside.append(error)
        except ConfigError:
            continue
    if outside:
        raise outside[0]
    raise ConfigError(f"{path} must be {type_text(kind)}, not {brief(value)} ({type(value).__name__})")


def _within(value: Any, kind: Any, path: str) -> Any:
    for bound in bounds_of(kind):
        if not bound.holds(value):
            raise OutOfBounds(f"{path} is {brief(value)}; it must be {bounds_text(kind) or bound.text}")
    return value


def _parse(text: str, kind: Any, path: str) -> Any:
    """`text` converted to `kind`: unchanged for a str, else as YAML, else unchanged (`run_7` for a `str | int`)."""
    try:
        value = text if bare(kind) is str else parse_yaml(text, path)
        if isinstance(value, dict) and any(":" in str(key) and item is None for key, item in value.items()):
            value = parse_yaml(re.sub(r":(?=\S)", ": ", text), path)  # {a:1} is a key without a value in YAML
    except ConfigError:
        value = text
    try:
        return fit(value, kind, path)
    except ConfigError as error:
        try:
            return fit(text, kind, path)
        except ConfigError:
            raise error from None


def _kind(cls: type, name: str, path: str) -> Any:
    """The type or section of `name` in `cls`. Raises ConfigError if there is none. `path`: of `name`, for the error."""
    fields = _schema(cls)
    if name in fields:
        return fields[name]
    is_free = name.isidentifier() and not (name.startswith("_") or keyword.iskeyword(name) or hasattr(cls, name))
    if is_free and getattr(cls, "_open", False):
        return float
    owner = path.rpartition(".")[0] or _path(cls)
    raise ConfigError(f"{path} does not exist{_nearest(name, fields)}; {owner} has: {', '.join(fields)}")


def _guarded_setattr(self: Any, name: str, value: Any) -> None:
    if not name.startswith("_"):
        path = f"{_path(type(self))}.{name}"
        value = fit(value, _kind(type(self), name, path), path)
    object.__setattr__(self, name, value)


def _fill(node: Any) -> Any:
    """Copy every default into `node`, in the order of declaration."""
    cls = type(node)
    for name, kind in _schema(cls).items():
        if _is_section(kind):
            vars(node)[name] = _fill(object.__new__(kind))
        else:
            vars(node)[name] = fit(getattr(cls, name), kind, f"{_path(cls)}.{name}")
    return node


def _plain(value: Any) -> Any:
    if _is_section(type(value)):
        return {name: _plain(item) for name, item in vars(value).items() if not name.startswith("_")}
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list) else value


def _leaves(node: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in vars(node).items():
        if _is_section(type(value)):
            yield from _leaves(value, f"{prefix}{name}.")
        elif not name.startswith("_"):
            yield prefix + name, _plain(value)


def _edits(node: Any, values: Any, path: str = "") -> Iterator[tuple[Any, str, Any]]:
    """(section, name, checked value) of every field in the nested `values`. Raises ConfigError."""
    if not isinstance(values, Mapping):
        where = path or _path(type(node))
        raise ConfigError(f"{where} is a section and needs a mapping of its fields, not {brief(values)}")
    for name, value in values.items():
        here = f"{path}.{name}" if path else str(name)
        kind = _kind(type(node), str(name), here)
        if _is_section(kind):
            yield from _edits(getattr(node, name), value, here)
        else:
            yield node, name, fit(value, kind, here)


class Config:
    """Base class of all configurations. Nested plain classes are its sections, their attributes its fields.

    `name: type = value` declares a field. In a subclass `name = value` overrides it, and `class env(Parent.env):` a
    section. A class with several parents has the fields of all their sections; the first parent that sets a field wins.
    In a section with `_open = True`, a bare `name = number` also declares a new field. In its subclass `_only = True`
    sets all other fields to 0. The checks run in the class statement and when a field is set. Each instance has its own
    copy of every default.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        _schema(cls)

    def __init__(self) -> None:
        _fill(self)

    if not TYPE_CHECKING:  # with __setattr__ type checkers would allow any name
        __setattr__ = _guarded_setattr

    def to_dict(self) -> dict[str, Any]:
        """The fields as nested dicts with values that YAML can hold, in the order of declaration."""
        return _plain(self)

    def set(self, path: str, value: Any, where: str = "--set") -> None:
        """Override the field at a dotted `path`. Text is parsed by the field's type. Raises ConfigError."""
        owner, node, kind, here = self, self, type(self), ""
        try:
            for name in path.split("."):
                if not _is_section(kind):
                    whole = f": {here}={{{path.removeprefix(f'{here}.')}: ...}}" if get_origin(kind) is dict else ""
                    why = f"{here} is a field ({type_text(kind)}), not a section; set it whole{whole}"
                    raise ConfigError(f"{path} does not exist: {why}")
                here = f"{here}.{name}" if here else name
                owner, kind = node, _kind(type(node), name, here)
                node = getattr(owner, name, None)
            vars(owner)[name] = _parse(value, kind, path) if isinstance(value, str) else fit(value, kind, path)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from None

    def update(self, values: Mapping[str, Any], where: str = "update") -> None:
        """Override all fields in the nested `values`. If one is wrong, change nothing and raise ConfigError.

        A field of type dict is replaced, not merged. `where`: start of the error.
        """
        try:
            edits = list(_edits(self, values))
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from None
        for node, name, value in edits:
            vars(node)[name] = value

    def diff(self, other: Config) -> list[tuple[str, Any, Any]]:
        """(dotted path, own value, value in `other`) of all fields that differ; None if a side does not have it."""
        own, others = dict(_leaves(self)), dict(_leaves(other))
        both = own.keys() & others.keys()
        return [
            (path, own.get(path), others.get(path))
            for path in own | others
            if path not in both or own[path] != others[path]
        ]
