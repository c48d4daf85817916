"""Fields that had another name once: what an error suggests for the old name, and how an old run's config.yaml still loads."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

# Old dotted path -> the keys that lead to its value now.
RENAMED: dict[str, tuple[str, ...]] = {
    "perturbation.enable": ("perturbation", "kick"),
    "cpu.keep_probability": ("cpu", "overrides", "commands.keep_probability"),
    "cpu.kick_curriculum": ("cpu", "overrides", "perturbation.curriculum"),
}


def new_name(path: str) -> str:
    """What the field at ``path`` (``Dog.cpu.kick_curriculum``, or without the class) is called now; "" if that is no old name."""
    for old, keys in RENAMED.items():
        if path == old or path.endswith(f".{old}"):
            *sections, name = keys
            return f"{'.'.join(sections)}['{name}']" if "." in name else ".".join(keys)
    return ""


def with_new_names(saved: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a run's saved config in which every old name is replaced by the new one."""
    config: dict[str, Any] = copy.deepcopy(dict(saved))
    for old, (*sections, name) in RENAMED.items():
        section, _, field = old.partition(".")
        if not isinstance(config.get(section), dict) or field not in config[section]:
            continue
        value, node = config[section].pop(field), config
        for key in sections:
            node = node.setdefault(key, {}) if isinstance(node, dict) else None
        if isinstance(node, dict):  # else the file is wrong there, and loading it says so
            node[name] = value
    return config
