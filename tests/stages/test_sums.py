"""The sum of floats does not depend on the version of Python."""

from __future__ import annotations

from stages.sums import sum_in_order


def test_each_addition_is_rounded():
    assert sum_in_order([0.1] * 10) == 0.9999999999999999  # the compensated sum is 1.0
    assert sum_in_order([1e16, 1.0, -1e16]) == 0.0
    assert sum_in_order([]) == 0.0
