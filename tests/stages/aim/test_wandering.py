"""Where a beam most likely meets what flies on, nobody knows whither: against flights drawn at random."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.aim.wandering import best_offset_m

SPACING_M, HALF_M = 1.05, 0.15


def met(offset_m, reach_m):
    """Share of 20 000 flights to any side that a beam within HALF_M meets."""
    across = reach_m * np.cos(np.random.default_rng(0).uniform(0, math.tau, 20_000)) - offset_m
    return float(np.mean(np.abs(across - SPACING_M * np.round(across / SPACING_M)) < HALF_M))


def test_what_hangs_is_looked_for_where_it_was():
    assert best_offset_m(0.0, [], SPACING_M, HALF_M) == 0.0
    assert best_offset_m(0.1, [], SPACING_M, HALF_M) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("reach_m", [0.3, 0.5, 0.8, 1.4])
def test_what_flies_fast_is_met_more_often_than_where_it_was(reach_m):
    best = best_offset_m(reach_m, [], SPACING_M, HALF_M)
    assert abs(best) <= SPACING_M / 2 + 1e-9
    assert met(best, reach_m) > met(0.0, reach_m)
    grid = np.linspace(-SPACING_M / 2, SPACING_M / 2, 43)
    assert met(best, reach_m) > 0.8 * max(met(offset, reach_m) for offset in grid)


def test_a_second_look_goes_where_the_first_was_not():
    first = best_offset_m(0.4, [], SPACING_M, HALF_M)
    second = best_offset_m(0.4, [(0.4, first)], SPACING_M, HALF_M)
    assert abs(second - first) > HALF_M
    third = best_offset_m(0.4, [(0.4, first), (0.4, second)], SPACING_M, HALF_M)
    assert min(abs(third - first), abs(third - second)) > 0.5 * HALF_M


def test_as_many_beams_as_are_side_by_side_are_counted():
    close = best_offset_m(5.0, [], 0.2, HALF_M)  # beams every 0.2 m leave nothing between them
    assert abs(close) <= 0.1 + 1e-9
