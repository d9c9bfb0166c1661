"""The bank: which candidate a sighting fits, and what a slice says of each."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.detect.candidate_table import ROWS, CandidateTable
from stages.detect.observations import Slice
from stages.kernels.detect.candidate_table import first_within
from stages.messages import SweptPulses
from tests.stages.detect.test_candidate import PLACE_M, candidate, observation, way
from tests.stages.made import START_NS

NOW_NS = START_NS + 100_000_000


def beside(x_m, y_m, z_m):
    return PLACE_M + np.array([x_m, y_m, z_m])


def table(*places_m, told=True):
    made = CandidateTable()
    for number, place_m in enumerate(places_m):
        c = candidate(*way((0.0, 0.0, 0.0), looks=2))
        c.number, c.xyz_m, c.is_promising = number, np.asarray(place_m, dtype=np.float64), told
        made.put(c)
    return made


def looking_at(*places_m, range_m):
    directions = np.array(places_m) / np.linalg.norm(places_m, axis=1)[:, None]
    n = len(directions)
    pulses = SweptPulses(
        stamp_ns=NOW_NS,
        point_stamp_ns=np.full(n, NOW_NS, dtype=np.int64),
        direction_vehicle=directions.astype(np.float32),
        range_m=np.full(n, range_m, dtype=np.float32),
        laser=np.zeros(n, dtype=np.uint8),
        reflectivity=np.zeros(n, dtype=np.uint8),
        turntable_rad=0.0,
        origin_vehicle_m=(0.0, 0.0, 0.0),
    )
    mean = directions.mean(axis=0)
    return Slice(pulses, np.eye(3), np.zeros(3), mean / np.linalg.norm(mean))


def test_a_sighting_fits_the_nearest_candidate_in_sigmas():
    found = table(PLACE_M, beside(0.0, 0.0, 1.0), beside(0.0, 0.6, 0.0)).best_fit(observation(0.1))
    assert found is not None
    assert found.number == 0


def test_it_fits_none_that_is_far_or_that_was_seen_later():
    assert table(beside(3.0, 0.0, 0.0)).best_fit(observation(0.1)) is None
    assert table(PLACE_M).best_fit(observation(0.05)) is None
    assert CandidateTable().best_fit(observation(0.1)) is None


def test_a_candidate_is_expected_where_it_flies():
    made = table(PLACE_M)
    (c,) = made
    c.velocity_mps = np.array([10.0, 0.0, 0.0])
    made.put(c)
    assert made.best_fit(observation(0.2, beside(1.0, 0.0, 0.0))) is c
    assert made.best_fit(observation(0.2, beside(-1.0, 0.0, 0.0))) is None


def test_more_candidates_than_rows_are_kept_and_forgotten():
    made = table(*(beside(0.0, 10.0 * k, 0.0) for k in range(2 * ROWS + 1)))
    assert len(made) == 2 * ROWS + 1
    for k in (0, ROWS, 2 * ROWS):
        found = made.best_fit(observation(0.1, beside(0.0, 10.0 * k, 0.0)))
        assert found is not None
        assert found.number == k
    made.keep([c for c in made if c.number == ROWS])
    assert [c.number for c in made] == [ROWS]
    assert made.best_fit(observation(0.1)) is None


@pytest.mark.parametrize(("range_m", "returns", "pass_throughs"), [(0.0, 0, 2), (math.sqrt(378.0), 2, 0)])
def test_pulses_through_the_middle_hit_or_pass_it(range_m, returns, pass_throughs):
    part = looking_at(PLACE_M, beside(0.0, 0.0, 0.05), beside(0.0, 0.0, 0.3), range_m=range_m)
    ((_, *found),) = table(PLACE_M).pass_throughs_of(part, np.zeros(3), NOW_NS, 0.11, 1.0)
    assert found == [returns, pass_throughs, False]


def test_of_one_beside_the_fan_it_is_said_that_the_fan_is_elsewhere():
    ((_, *found),) = table(PLACE_M).pass_throughs_of(
        looking_at([0.0, -1.0, 0.0], range_m=0.0), np.zeros(3), NOW_NS, 0.11, 1.0
    )
    assert found == [0, 0, True]


def test_nothing_is_said_of_what_nobody_was_told_of_or_was_long_unseen_or_is_not_known_well():
    part = looking_at(PLACE_M, range_m=0.0)
    assert list(table(PLACE_M, told=False).pass_throughs_of(part, np.zeros(3), NOW_NS, 0.11, 1.0)) == []
    assert list(table(PLACE_M).pass_throughs_of(part, np.zeros(3), NOW_NS + 2 * 10**9, 0.11, 1e9)) == []
    assert list(table(PLACE_M).pass_throughs_of(part, np.zeros(3), NOW_NS, 0.11, 1e-4)) == []


def test_the_first_place_within_reach_is_told():
    places_m = np.array([[5.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.5]])
    assert first_within(places_m, np.zeros(3), 1.1) == 1
    assert first_within(places_m, np.zeros(3), 0.4) == -1
    assert first_within(np.empty((0, 3)), np.zeros(3), 9.0) == -1
