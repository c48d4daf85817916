"""What makers publish about their robots: the entries of ``resources/makers.yaml``, found by name and joints."""

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
    """The published numbers of a robot. Tables are of the form of ``some_joints``; an empty table is not known."""

    name: str
    joints: tuple[str, ...]  # patterns; each fits a joint of the robot
    source: str  # repository and file
    pose: dict[str, float] = field(default_factory=dict)  # [rad]
    kp: dict[str, float] = field(default_factory=dict)  # [N m/rad]
    kd: dict[str, float] = field(default_factory=dict)  # [N m s/rad]
    armature: dict[str, float] = field(default_factory=dict)  # [kg m^2]
    effort: dict[str, float] = field(default_factory=dict)  # [N m]

    def of(self, table: str, joints: Sequence[str]) -> dict[str, float]:
        """Joint -> number of ``table``, a name of a field here, for those of ``joints`` that a key fits."""
        said: dict[str, float] = getattr(self, table)
        fitting = {key: value for key, value in said.items() if any(key in joint for joint in joints)}
        return some_joints(fitting, joints, f"{FILE}: {self.name}: {table}")


def find_maker(file: Path, model: str, joints: Sequence[str]) -> Maker | None:
    """The entry of the robot in ``file``, whose model is called ``model``; None if there is none.

    The name of the file comes first: some makers call the models of two robots alike. Of several names that are part
    of it the longest wins. All patterns of the entry must fit ``joints``.
    """
    known = [maker for maker in read_makers() if all(_fits(pattern, joints) for pattern in maker.joints)]
    for text in (file.stem, model):
        named = [maker for maker in known if _names(maker.name, text)]
        if named:
            return max(named, key=lambda maker: len(maker.name))
    return None


def read_makers() -> list[Maker]:
    """All entries of the file, in its order."""
    entries = yaml.safe_load((ROOT / FILE).read_text(encoding="utf-8"))
    return [Maker(**{**entry, "joints": tuple(entry["joints"])}) for entry in entries]


def _names(name: str, text: str) -> bool:
    """Whether ``name`` is a part of ``text``, between its ends or signs: "h1" of "h1_2", but not of "h12"."""
    return bool(re.search(rf"(?<![a-z0-9]){re.escape(name)}(?![a-z0-9])", text.lower()))


def _fits(pattern: str, joints: Sequence[str]) -> bool:
    return any(fnmatchcase(joint, pattern) for joint in joints)
