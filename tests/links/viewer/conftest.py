"""Rerun raises errors instead of warnings in these tests."""

import pytest
import rerun as rr


@pytest.fixture(autouse=True)
def _strict():
    rr.set_strict_mode(True)
