"""YAML in and out: the one reader of everything that is written by hand or comes from elsewhere, and the writer of configs.

It reads plain data alone: mappings whose keys are text, lists, text, numbers, true, false, null. Whatever else a file holds, and
whatever its parser stumbles over, is one ConfigError with file and line.
"""

from __future__ import annotations

import os
import re
import stat
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from legged_mw.utils.errors import ConfigError

MOST_BYTES, MOST_NODES, MOST_DEPTH, MOST_DIGITS = 1 << 20, 50_000, 50, 40  # a run's config has 10 kB and 700 nodes
_EXPONENT = r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"
_PLAIN = ("null", "bool", "int", "float", "str", "seq", "map")


class _Loader(yaml.SafeLoader):
    """PyYAML's, with whole numbers as YAML 1.2 has them (010 is ten, 1:30 is text), no dates, and limits."""

    yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in resolvers if tag.rpartition(":")[2] in ("null", "bool", "merge")]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def __init__(self, stream: str | bytes) -> None:
        self._depth = self._nodes = 0
        self._sizes: dict[int, int] = {}  # nodes in a node, aliases written out
        super().__init__(stream)

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Counts as it goes: an alias is as large as what it stands for, since whoever walks the data walks it again."""
        event, before = self.peek_event(), self._nodes
        self._depth += 1
        if self._depth > MOST_DEPTH:
            raise _error(f"nested deeper than {MOST_DEPTH}", event.start_mark)
        node: Any = super().compose_node(parent, index)
        if isinstance(event, yaml.AliasEvent) and id(node) not in self._sizes:
            raise _error(f"'*{event.anchor}' is a part of itself", event.start_mark)
        self._nodes += self._sizes.get(id(node), 1)
        if self._nodes > MOST_NODES:
            raise _error(f"more than {MOST_NODES:,} values, aliases written out", event.start_mark)
        self._sizes[id(node)] = self._nodes - before
        self._depth -= 1
        return node

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        if node.tag.removeprefix("tag:yaml.org,2002:") not in _PLAIN:
            raise _error(f"the tag {node.tag.replace('tag:yaml.org,2002:', '!!')} is not read here", node.start_mark)
        try:
            return super().construct_object(node, deep)
        except (ValueError, KeyError):
            raise _error(f"'{node.value[:40]}' is no {node.tag.rpartition(':')[2]}", node.start_mark) from None

    def construct_scalar(self, node: Any) -> Any:
        text = super().construct_scalar(node)
        # a terminal obeys these
        if bad := [char for char in text if unicodedata.category(char) in ("Cc", "Cs") and char not in "\t\n\r"]:
            raise _error(f"the character {bad[0]!a} is not text", node.start_mark)
        return text

    def construct_yaml_int(self, node: Any) -> int:
        text = self.construct_scalar(node).replace("_", "")
        if len(text) > MOST_DIGITS:
            raise _error(f"a whole number of more than {MOST_DIGITS} digits", node.start_mark)
        return int(text, 0 if text.lstrip("+-")[:2].lower() in ("0x", "0o") else 10)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Refuses a key that is no text, and one written twice: plain YAML would let the second silently win."""
        seen = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if key.tag not in ("tag:yaml.org,2002:str", "tag:yaml.org,2002:merge"):
                shown = f"'{key.value[:40]}'" if isinstance(key.value, str) else f"a {key.tag.rpartition(':')[2]}"
                raise _error(f"the key {shown} is no name; put it in quotes if it is one", key.start_mark)
            if key.value in seen:
                raise _error(f"'{key.value[:40]}' is written twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:
        return True  # a list used twice is written twice: anchors are not for readers


def _error(problem: str, mark: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(None, None, problem, mark)


_INT, _FLOAT = (
    r"[-+]?(\d[\d_]*|0x[0-9a-fA-F_]+|0o[0-7_]+)$",
    rf"[-+]?(\d[\d_]*\.\d*|\.\d+|\.(inf|Inf|INF))$|\.(nan|NaN|NAN)$|{_EXPONENT}",
)
for _name, _pattern in (("float", _FLOAT), ("int", _INT)):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_name}", re.compile(_pattern), list("-+.0123456789"))
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
# To plain YAML 1.1, which others read with, 1e-4 is a string: the writer learns that here it is none, so that it quotes a run called `1e4`.
_Dumper.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(_EXPONENT), list("-+.0123456789"))


def parse_yaml(text: str | bytes, where: str) -> Any:
    """The data in ``text``. Raises ConfigError, which begins with ``where`` and the line."""
    loader = None
    try:
        loader = _Loader(text)
        return loader.get_single_data()
    except yaml.YAMLError as error:
        mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None) or str(error)
    # what PyYAML lets through: escapes beyond Unicode, %YAML 1.<digits>
    except (ValueError, OverflowError, RecursionError) as error:
        mark, problem = loader.get_mark() if loader else None, str(error)
    line = f":{mark.line + 1}" if mark else ""
    raise ConfigError(f"{where}{line}: not valid YAML: {' '.join(problem.split())}")


def load_yaml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The mapping in a YAML file, its numbers read as people write them. Raises ConfigError."""
    try:
        path = Path(path)
        kind = path.stat().st_mode
        if not stat.S_ISREG(kind) and not stat.S_ISDIR(kind):
            raise ConfigError(f"{path}: cannot read this config file: it is a device or a pipe")
        with path.open("rb") as file:
            text = file.read(MOST_BYTES + 1)
    except (OSError, ValueError) as error:  # a name with a null character
        raise ConfigError(
            f"{path}: cannot read this config file: {getattr(error, 'strerror', None) or error}"
        ) from None
    if len(text) > MOST_BYTES:
        raise ConfigError(f"{path}: larger than {MOST_BYTES >> 20} MiB, which no config is")
    loaded = parse_yaml(text, str(path))
    if not isinstance(loaded, dict):
        raise ConfigError(f"{path}: holds {type(loaded).__name__}, not a mapping of sections and fields")
    return loaded


def save_yaml(path: str | os.PathLike[str], mapping: Mapping[str, Any]) -> None:
    """Writes `mapping` whole or not at all: neither a reader nor a crash ever meets half a file."""
    path = Path(path)
    text = yaml.dump(dict(mapping), Dumper=_Dumper, sort_keys=False, allow_unicode=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
