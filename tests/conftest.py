"""Shared by all tests: one torch thread; tests that need a GPU or a screen are left out where there is none."""

import pytest
import torch

from legged_mw.view.native import has_display


def pytest_configure(config: pytest.Config) -> None:
    torch.set_num_threads(1)  # hundreds of small operations a step stall on a second thread


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect, not skip: `pytest -m gpu` on a machine without a GPU then says that nothing ran."""
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    for mark, present in (("gpu", gpus > 0), ("two_gpus", gpus > 1), ("display", has_display())):
        if not present:
            without = [item for item in items if item.get_closest_marker(mark)]
            config.hook.pytest_deselected(items=without)
            items[:] = [item for item in items if item not in without]
