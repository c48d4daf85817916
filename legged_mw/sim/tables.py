"""Tables of numbers a joint: key -> number. The exact name wins, then the longest key that is part of the name, then the key ""."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from legged_mw.utils.errors import ModelError, unknown

_NO_KIND = {"joint", "l", "r", "left", "right", "fl", "fr", "rl", "rr", "lf", "rf", "lh", "rh", "hl", "hr", "bl", "br"}
_NO_KIND |= {"front", "rear", "hind", "back"}


def some_joints(
    table: Mapping[str, float], joints: Sequence[str], what: str, spare: Sequence[str] = ()
) -> dict[str, float]:
    """Joint -> value, of those ``joints`` that a key fits: a key fits if it is the joint's name or a part of it.

    Raises ModelError for a key without a joint, and for two keys that fit a joint equally well. A key may fit one in ``spare`` instead.
    """
    for key in table:
        if key and not any(key in joint for joint in (*joints, *spare)):
            raise ModelError(
                f"{what}: {unknown('joint', key, joints, 'the MJCF')} (a key may be a part of a joint's name)"
            )
    found = {}
    for joint in joints:
        fitting = sorted((key for key in table if key in joint), key=len)
        if not fitting:
            continue
        *others, best = fitting
        if others and len(others[-1]) == len(best):
            raise ModelError(
                f"{what}: '{others[-1]}' and '{best}' fit joint '{joint}' equally well; add the key '{joint}'"
            )
        found[joint] = float(table[best])
    return found


def per_joint(table: Mapping[str, float], joints: Sequence[str], what: str, spare: Sequence[str] = ()) -> list[float]:
    """Values (D,) for ``joints``. Raises ModelError for joints without a key, and as ``some_joints`` does."""
    found = some_joints(table, joints, what, spare)
    if without := [joint for joint in joints if joint not in found]:
        raise ModelError(
            f"{what}: no value for {', '.join(without)}: none of {list(table)} is a part of these names; add keys, or '' for all others"
        )
    return list(found.values())


def per_joint_all(
    tables: Mapping[str, Mapping[str, float]], joints: Sequence[str], spare: Sequence[str] = ()
) -> dict[str, list[float]]:
    """``per_joint`` of several tables, by what they are; the error is about all of them at once."""
    values, wrong = dict[str, list[float]](), []
    for what, table in tables.items():
        try:
            values[what] = per_joint(table, joints, what, spare)
        except ModelError as error:
            wrong.append(str(error))
    if wrong:
        raise ModelError("; ".join(wrong))
    return values


def family(name: str) -> str:
    """A joint's name without its side and the word joint: "hip" of "FR_hip_joint"; the whole name, if nothing is left."""
    return "_".join(part for part in name.split("_") if part.lower() not in _NO_KIND) or name
