"""Sums of floats that have the same bits in every version of Python.

Source: ours; Python 3.12, "What's New": the built-in `sum` compensates rounding errors of floats from this version on.
"""

from __future__ import annotations

from collections.abc import Iterable


def sum_in_order(values: Iterable[float]) -> float:
    """Sum from left to right, each addition rounded."""
    total = 0.0
    for value in values:
        total += value
    return total
