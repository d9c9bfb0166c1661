"""The fast suite runs on two cores, one file per core; named files run on one core and show their output."""

from __future__ import annotations

import pytest
from hypothesis import settings

WORKERS = 2

settings.register_profile("busy host", deadline=None)  # compilation and a busy host take time
settings.load_profile("busy host")


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Processes for `-n auto`, of the project's own options; 0: in this process, for `slow` tests and benchmarks."""
    all_of_it = config.args_source is not pytest.Config.ArgsSource.ARGS
    fast = "not slow" in config.option.markexpr
    return WORKERS if all_of_it and fast and config.option.capture != "no" else 0
