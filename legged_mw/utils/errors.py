"""The errors that are the user's to mend: one class, so that a program can print them as one line and exit."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class UserError(Exception):
    """A mistake in what was asked, or something that the machine lacks; the text says what exists and what to do."""


def unknown(what: str, name: str, known: Iterable[str], where: str) -> str:
    """One line: ``name`` does not exist, the nearest name that does, and all that do."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean '{close[0]}'? " if close else ""
    return f"no {what} '{name}' in {where}; {hint}there are: {', '.join(known) or 'none'}"
