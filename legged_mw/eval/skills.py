"""The exams of tasks without commands, by name. Needs neither torch nor warp."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from legged_mw.eval.getup import GetupExam
from legged_mw.eval.handstand import HandstandExam
from legged_mw.eval.skill import Skill
from legged_mw.eval.tracking import TrackingExam
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown

SKILLS: dict[str, type[Skill]] = {kind.kind: kind for kind in (GetupExam, HandstandExam, TrackingExam)}


def make_skill(kind: str, section: Mapping[str, Any]) -> Skill:
    """The exam ``kind`` with the values of a task's config section ``exam``. Raises ConfigError."""
    if kind not in SKILLS:
        raise ConfigError(unknown("exam", kind, SKILLS, "legged_mw/eval/skills.py"))
    known = [field.name for field in fields(SKILLS[kind])]
    for name in section:
        if name not in known:
            raise ConfigError(f"exam: {unknown('field', name, known, f'the exam {kind}')}")
    return SKILLS[kind](**section)
