"""Runs and exports of strangers: the table of tests/campaign/test_strangers.py."""

from __future__ import annotations

import test_strangers as campaign

from golden.table import Table


def table() -> Table:
    made = Table(campaign.given_run)
    made.campaign("", campaign.CASES)
    return made
