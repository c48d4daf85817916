"""Read and write YAML: configs, contracts and scripts, also from strangers.

Only plain data is read: mappings with names as keys, lists, text, numbers, true, false, null. Anything else raises a
ConfigError with file and line.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from legged_mw.utils.errors import CONTROL, ConfigError, in_short

MOST_BYTES, MOST_NODES, MOST_DEPTH = 1 << 20, 50_000, 50  # a run's config has 10 kB and 700 nodes
_TAG = "tag:yaml.org,2002:"
_PLAIN = {f"{_TAG}{name}" for name in ("null", "bool", "int", "float", "str", "seq", "map")}
_EXPONENT = r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"
_INT = r"[-+]?(\d[\d_]*|0x[0-9a-fA-F_]+|0o[0-7_]+)$"
_FLOAT = rf"[-+]?(\d[\d_]*\.\d*|\.\d+|\.(inf|Inf|INF))$|\.(nan|NaN|NAN)$|{_EXPONENT}"


class _Loader(yaml.SafeLoader):
    """PyYAML's loader with the integers of YAML 1.2 (010 is ten, 1:30 is text), without dates, with size limits."""

    yaml_constructors = {tag: make for tag, make in yaml.SafeLoader.yaml_constructors.items() if tag in {None, *_PLAIN}}
    yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in resolvers if tag.rpartition(":")[2] in ("null", "bool", "merge")]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def __init__(self, stream: str | bytes) -> None:
        self._depth, self._nodes = 0, 0.0
        self._sizes: dict[int, float] = {}  # id of a node -> number of nodes in it, with aliases expanded
        super().__init__(stream)

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a node and count its values. An alias counts all its values: a few aliases could fill the memory."""
        event, before = self.peek_event(), self._nodes
        self._depth += 1
        if self._depth > MOST_DEPTH:
            raise _error(f"nested deeper than {MOST_DEPTH}", event.start_mark)
        node: Any = super().compose_node(parent, index)
        self._depth -= 1
        in_itself = isinstance(event, yaml.AliasEvent) and id(node) not in self._sizes
        self._nodes += math.inf if in_itself else self._sizes.get(id(node), 1)
        if self._nodes > MOST_NODES:
            raise _error(f"more than {MOST_NODES:,} values, aliases written out", event.start_mark)
        self._sizes[id(node)] = self._nodes - before
        return node

    def construct_scalar(self, node: Any) -> Any:
        text = super().construct_scalar(node)
        if bad := CONTROL.search(text):
            raise _error(f"the character {bad[0]!a} is not text", node.start_mark)
        return text

    def construct_yaml_int(self, node: Any) -> int:
        text = self.construct_scalar(node).lower().replace("_", "")
        return int(text, 0 if "x" in text or "o" in text else 10)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Raise for a key that is not text or is written twice, where PyYAML would use the second value."""
        seen = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if key.tag not in (f"{_TAG}str", f"{_TAG}merge"):
                raise _error("this key is no name; put it in quotes if it is one", key.start_mark)
            if key.value in seen:
                raise _error(f"'{key.value[:40]}' is written twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:
        return True  # write a list twice if it is used twice, because anchors are hard to read


def _error(problem: str, mark: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(None, None, problem, mark)


for _name, _pattern in (("float", _FLOAT), ("int", _INT)):
    _Loader.add_implicit_resolver(f"{_TAG}{_name}", re.compile(_pattern), list("-+.0123456789"))
_Loader.add_constructor(f"{_TAG}int", _Loader.construct_yaml_int)
# In YAML 1.1 1e-4 is text, for our loader a number. So the writer must quote the name of a run such as `1e4`.
_Dumper.add_implicit_resolver(f"{_TAG}float", re.compile(_EXPONENT), list("-+.0123456789"))


def parse_yaml(text: str | bytes, where: str) -> Any:
    """The data in ``text``. Raises ConfigError that starts with ``where`` and the line."""
    try:
        return _Loader(text).get_single_data()
    except yaml.YAMLError as error:
        mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None) or str(error)
    except Exception as error:  # another error of a parser or constructor, as for !!int x
        mark, problem = None, in_short(error)
    line = f":{mark.line + 1}" if mark else ""
    raise ConfigError(f"{where}{line}: not valid YAML: {' '.join(problem.split())}")


def load_yaml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The mapping in a YAML file, in which 1e-4 is a number. Raises ConfigError."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            text = file.read(MOST_BYTES + 1)
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        why = getattr(error, "strerror", None) or error
        raise ConfigError(f"{path}: cannot read this file: {why}") from None
    if len(text) > MOST_BYTES:
        raise ConfigError(f"{path}: larger than {MOST_BYTES >> 20} MiB, which no config is")
    loaded = parse_yaml(text, str(path))
    if not isinstance(loaded, dict):
        raise ConfigError(f"{path}: holds {type(loaded).__name__}, not a mapping of sections and fields")
    return loaded


def save_yaml(path: str | os.PathLike[str], mapping: Mapping[str, Any]) -> None:
    """Write `mapping` atomically: the file is never incomplete, even after a crash."""
    path = Path(path)
    text = yaml.dump(dict(mapping), Dumper=_Dumper, sort_keys=False, allow_unicode=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
