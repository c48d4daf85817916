"""Judging a policy: the walking exam."""
