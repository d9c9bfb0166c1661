"""Where a beam most likely meets a drone: against places drawn at random."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.aim.search_offset import Look, best_offset_m

SPACING_M, HALF_M = 1.05, 0.15


def met(offset_m, reach_m):
    """Share of 20 000 flights to any side that a beam within HALF_M meets."""
    across = reach_m * np.cos(np.random.default_rng(0).uniform(0, math.tau, 20_000)) - offset_m
    return float(np.mean(np.abs(across - SPACING_M * np.round(across / SPACING_M)) < HALF_M))


def looks(reach_m, headed, count):
    tried: list[Look] = []
    for _ in range(count):
        tried.append(Look(reach_m, best_offset_m(reach_m, headed, tried, SPACING_M, HALF_M)))
    return np.array([look.offset_m for look in tried])


@pytest.mark.parametrize("headed", [False, True])
def test_what_is_known_well_is_looked_for_where_it_is(headed):
    assert best_offset_m(0.0, headed, [], SPACING_M, HALF_M) == 0.0
    assert best_offset_m(0.1, headed, [], SPACING_M, HALF_M) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("reach_m", [0.3, 0.5, 0.8, 1.4])
def test_what_flies_fast_is_met_more_often_than_where_it_was(reach_m):
    best = best_offset_m(reach_m, True, [], SPACING_M, HALF_M)
    assert abs(best) <= SPACING_M / 2 + 1e-9
    assert met(best, reach_m) > met(0.0, reach_m)
    grid = np.linspace(-SPACING_M / 2, SPACING_M / 2, 43)
    assert met(best, reach_m) > 0.8 * max(met(offset, reach_m) for offset in grid)


@pytest.mark.parametrize("headed", [False, True])
def test_each_look_goes_where_the_ones_before_were_not(headed):
    offsets = looks(0.4, headed, 3)
    assert np.abs(offsets[:, np.newaxis] - offsets)[np.triu_indices(3, 1)].min() > 0.5 * HALF_M


def test_one_miss_of_a_place_that_is_known_well_is_no_reason_to_look_elsewhere():
    assert np.abs(looks(0.05, False, 2)).max() < 0.05
    edge = [Look(0.05, 0.2)]  # a look at its edge missed
    assert best_offset_m(0.05, False, edge, SPACING_M, HALF_M) == pytest.approx(0.0, abs=0.05)


def test_in_the_end_every_place_between_two_beams_is_looked_at_however_sure_one_was():
    offsets = np.sort(looks(0.05, False, 20))
    assert np.diff(offsets, append=offsets[0] + SPACING_M).max() < 2.5 * HALF_M


def test_as_many_beams_as_are_side_by_side_are_counted():
    assert abs(best_offset_m(5.0, True, [], 0.2, HALF_M)) <= 0.1 + 1e-9  # beams every 0.2 m leave nothing between them
