"""The whole fast suite runs on two cores, each file on one of them; whatever is named runs on one, and shows its prints."""

from __future__ import annotations

import pytest
from hypothesis import settings

WORKERS = 2

settings.register_profile("busy host", deadline=None)  # what compiles, or waits for a core, is no failure
settings.load_profile("busy host")


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Processes for `-n auto`, of the project's own options; 0: in this one, as `slow` tests and benchmarks have to be."""
    all_of_it = config.args_source is not pytest.Config.ArgsSource.ARGS
    fast = "not slow" in config.option.markexpr
    return WORKERS if all_of_it and fast and config.option.capture != "no" else 0
