"""The offset at which a beam most likely meets a drone, compared with random positions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.aim.search_offset import MissedObservation, best_offset_m

SPACING_M, HALF_M = 1.05, 0.15


def detection_rate(offset_m, spread_m):
    """Share of 20 000 random headings at which a beam passes within HALF_M."""
    across = spread_m * np.cos(np.random.default_rng(0).uniform(0, math.tau, 20_000)) - offset_m
    return float(np.mean(np.abs(across - SPACING_M * np.round(across / SPACING_M)) < HALF_M))


def missed_offsets(spread_m, heading_unknown, count):
    missed: list[MissedObservation] = []
    for _ in range(count):
        missed.append(MissedObservation(spread_m, best_offset_m(spread_m, heading_unknown, missed, SPACING_M, HALF_M)))
    return np.array([miss.offset_m for miss in missed])


@pytest.mark.parametrize("heading_unknown", [False, True])
def test_a_well_known_position_gets_no_offset(heading_unknown):
    assert best_offset_m(0.0, heading_unknown, [], SPACING_M, HALF_M) == 0.0
    assert best_offset_m(0.1, heading_unknown, [], SPACING_M, HALF_M) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("spread_m", [0.3, 0.5, 0.8, 1.4])
def test_the_offset_detects_a_fast_drone_more_often_than_no_offset(spread_m):
    best = best_offset_m(spread_m, True, [], SPACING_M, HALF_M)
    assert abs(best) <= SPACING_M / 2 + 1e-9
    assert detection_rate(best, spread_m) > detection_rate(0.0, spread_m)
    grid = np.linspace(-SPACING_M / 2, SPACING_M / 2, 43)
    assert detection_rate(best, spread_m) > 0.8 * max(detection_rate(offset, spread_m) for offset in grid)


@pytest.mark.parametrize("heading_unknown", [False, True])
def test_consecutive_offsets_differ(heading_unknown):
    offsets = missed_offsets(0.4, heading_unknown, 3)
    assert np.abs(offsets[:, np.newaxis] - offsets)[np.triu_indices(3, 1)].min() > 0.5 * HALF_M


def test_one_miss_of_a_well_known_position_does_not_change_the_offset():
    assert np.abs(missed_offsets(0.05, False, 2)).max() < 0.05
    edge = [MissedObservation(0.05, 0.2)]  # at its edge
    assert best_offset_m(0.05, False, edge, SPACING_M, HALF_M) == pytest.approx(0.0, abs=0.05)


def test_many_misses_cover_all_positions_between_two_beams():
    offsets = np.sort(missed_offsets(0.05, False, 20))
    assert np.diff(offsets, append=offsets[0] + SPACING_M).max() < 2.5 * HALF_M


def test_all_beams_count_if_the_spread_exceeds_their_spacing():
    assert abs(best_offset_m(5.0, True, [], 0.2, HALF_M)) <= 0.1 + 1e-9  # half the beam spacing
