"""Rerun raises instead of warning in these tests: nothing is drawn half."""

import pytest
import rerun as rr


@pytest.fixture(autouse=True)
def _strict():
    rr.set_strict_mode(True)
