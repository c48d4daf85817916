"""The makers' published values of their robots: entries of ``resources/makers.yaml``, found by name and joints."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path

import yaml

from legged_mw import ROOT
from legged_mw.sim.joints import some_joints

FILE = "resources/makers.yaml"


@dataclass(frozen=True)
class Maker:
    """The published values of a robot. Tables have the form of ``some_joints``. An empty table is unknown."""

    name: str
    joints: tuple[str, ...]  # patterns; each must match a joint of the robot
    source: str  # repository and file
    pose: dict[str, float] = field(default_factory=dict)  # [rad]
    kp: dict[str, float] = field(default_factory=dict)  # [N m/rad]
    kd: dict[str, float] = field(default_factory=dict)  # [N m s/rad]
    armature: dict[str, float] = field(default_factory=dict)  # [kg m^2]
    effort: dict[str, float] = field(default_factory=dict)  # [N m]

    def of(self, table: str, joints: Sequence[str]) -> dict[str, float]:
        """Joint -> value of ``table`` (a field of this class), for those of ``joints`` that a key matches."""
        values: dict[str, float] = getattr(self, table)
        fitting = {key: value for key, value in values.items() if any(key in joint for joint in joints)}
        return some_joints(fitting, joints, f"{FILE}: {self.name}: {table}")


def find_maker(file: Path, model: str, joints: Sequence[str]) -> Maker | None:
    """The entry of the robot in ``file`` with the model name ``model``; None without an entry.

    The file's name is searched first, because some makers give the models of two robots the same name. If several names
    match, the longest is used. All patterns of the entry must match ``joints``.
    """
    known = [
        maker
        for maker in read_makers()
        if all(any(fnmatchcase(joint, pattern) for joint in joints) for pattern in maker.joints)
    ]
    for text in (file.stem, model):
        named = [maker for maker in known if _names(maker.name, text)]
        if named:
            return max(named, key=lambda maker: len(maker.name))
    return None


def read_makers() -> list[Maker]:
    """All entries of the file, in order."""
    entries = yaml.safe_load((ROOT / FILE).read_text(encoding="utf-8"))
    return [Maker(**{**entry, "joints": tuple(entry["joints"])}) for entry in entries]


def _names(name: str, text: str) -> bool:
    """Whether ``name`` is a whole part of ``text``: "h1" is one of "h1_2", but not of "h12"."""
    return bool(re.search(rf"(?<![a-z0-9]){re.escape(name)}(?![a-z0-9])", text.lower()))
