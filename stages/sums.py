"""Sums of floats that have the same bits in every version of Python.

From 3.12 on the built-in `sum` compensates the rounding error of each addition; that of 3.11 does not:

    sum([0.1] * 10)           0.9999999999999999 in 3.11, 1.0 from 3.12 on
    sum_in_order([0.1] * 10)  0.9999999999999999

Stages add floats with `sum_in_order`, so that a recording has one output hash. Sums of NumPy arrays, of NumPy scalars
and in compiled code do not depend on the version of Python, and neither do sums of integers: these keep the built-in
`sum`.

Source: Python documentation, "What's New In Python 3.12", built-in functions.
"""

from __future__ import annotations

from collections.abc import Iterable


def sum_in_order(values: Iterable[float]) -> float:
    """Sum from left to right, each addition rounded; 0.0 of no values."""
    total = 0.0
    for value in values:
        total += value
    return total
