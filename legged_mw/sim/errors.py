"""What the simulator refuses. Messages put the called function's parameters in `backticks`, for a caller to write its own words there."""

from __future__ import annotations

from legged_mw.utils.errors import UserError


class ModelError(UserError, ValueError):
    """A name or number asked of a model that does not fit its MJCF; the message lists what exists."""


class EngineError(UserError, ValueError):
    """An engine that does not exist, or cannot step where it was asked to."""
