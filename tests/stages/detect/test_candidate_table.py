"""The candidate table: association of observations, and pass-throughs of a slice."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.detect.candidate_table import ROWS, CandidateTable
from stages.detect.observations import Slice
from stages.kernels.detect.candidate_table import first_within
from stages.kernels.sweep.pulses import cone_of
from stages.messages import SweptPulses
from tests.stages.detect.test_candidate import PLACE_M, candidate, observation, path
from tests.stages.made import START_NS

NOW_NS = START_NS + 100_000_000


def offset_by(x_m, y_m, z_m):
    return PLACE_M + np.array([x_m, y_m, z_m])


def table(*positions_m, promising=True):
    made = CandidateTable()
    for number, place_m in enumerate(positions_m):
        c = candidate(*path((0.0, 0.0, 0.0), count=2))
        c.number, c.xyz_m, c.is_promising = number, np.asarray(place_m, dtype=np.float64), promising
        made.put(c)
    return made


def slice_towards(*positions_m, range_m, stamp_ns=NOW_NS):
    directions = np.array(positions_m) / np.linalg.norm(positions_m, axis=1)[:, None]
    n = len(directions)
    pulses = SweptPulses(
        stamp_ns=stamp_ns,
        point_stamp_ns=np.full(n, stamp_ns, dtype=np.int64),
        direction_vehicle=directions.astype(np.float32),
        range_m=np.full(n, range_m, dtype=np.float32),
        laser=np.zeros(n, dtype=np.uint8),
        reflectivity=np.zeros(n, dtype=np.uint8),
        turntable_rad=0.0,
        origin_vehicle_m=(0.0, 0.0, 0.0),
    )
    pose = np.eye(3), np.zeros(3)
    return Slice(pulses, *cone_of(pulses.direction_vehicle), pose, pose)


def test_an_observation_fits_the_nearest_candidate_in_sigmas():
    found = table(PLACE_M, offset_by(0.0, 0.0, 1.0), offset_by(0.0, 0.6, 0.0)).best_fits(observation(0.1))[1]
    assert found is not None
    assert found.number == 0


def test_a_reacquired_candidate_and_another_are_found_each_on_its_own():
    made = table(PLACE_M, offset_by(0.0, 0.2, 0.0), offset_by(0.0, 0.1, 0.0))
    nearest, _, middle = made
    assert made.best_fits(observation(0.1)) == (None, nearest)
    for c in (nearest, middle):
        c.reacquired_at = 1
        made.put(c)
    assert made.best_fits(observation(0.1)) == (nearest, list(made)[1])


def test_it_fits_no_distant_or_later_candidate():
    assert table(offset_by(3.0, 0.0, 0.0)).best_fits(observation(0.1))[1] is None
    assert table(PLACE_M).best_fits(observation(0.05))[1] is None
    assert CandidateTable().best_fits(observation(0.1))[1] is None


def test_a_candidate_is_predicted_with_its_velocity():
    made = table(PLACE_M)
    (c,) = made
    c.velocity_mps = np.array([10.0, 0.0, 0.0])
    made.put(c)
    assert made.best_fits(observation(0.2, offset_by(1.0, 0.0, 0.0)))[1] is c
    assert made.best_fits(observation(0.2, offset_by(-1.0, 0.0, 0.0)))[1] is None


def test_the_table_grows_and_removes_candidates():
    made = table(*(offset_by(0.0, 10.0 * k, 0.0) for k in range(2 * ROWS + 1)))
    assert len(made) == 2 * ROWS + 1
    for k in (0, ROWS, 2 * ROWS):
        found = made.best_fits(observation(0.1, offset_by(0.0, 10.0 * k, 0.0)))[1]
        assert found is not None
        assert found.number == k
    made.keep([c for c in made if c.number == ROWS])
    assert [c.number for c in made] == [ROWS]
    assert made.best_fits(observation(0.1))[1] is None


@pytest.mark.parametrize(("range_m", "returns", "pass_throughs"), [(0.0, 0, 2), (math.sqrt(378.0), 2, 0)])
def test_pulses_through_the_middle_are_returns_or_pass_throughs(range_m, returns, pass_throughs):
    part = slice_towards(PLACE_M, offset_by(0.0, 0.0, 0.05), offset_by(0.0, 0.0, 0.3), range_m=range_m)
    ((_, *found),) = table(PLACE_M).pass_throughs_of(part, np.zeros(3), 0.11, 1.0)
    assert found == [returns, pass_throughs, False]


def test_a_candidate_outside_the_fan_is_reported_as_outside():
    ((_, *found),) = table(PLACE_M).pass_throughs_of(
        slice_towards([0.0, -1.0, 0.0], range_m=0.0), np.zeros(3), 0.11, 1.0
    )
    assert found == [0, 0, True]


def test_unpromising_old_and_uncertain_candidates_are_ignored():
    part = slice_towards(PLACE_M, range_m=0.0)
    assert list(table(PLACE_M, promising=False).pass_throughs_of(part, np.zeros(3), 0.11, 1.0)) == []
    later = slice_towards(PLACE_M, range_m=0.0, stamp_ns=NOW_NS + 2 * 10**9)
    assert list(table(PLACE_M).pass_throughs_of(later, np.zeros(3), 0.11, 1e9)) == []
    assert list(table(PLACE_M).pass_throughs_of(part, np.zeros(3), 0.11, 1e-4)) == []


def test_first_within_returns_the_first_position_within_the_distance():
    positions_m = np.array([[5.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.5]])
    assert first_within(positions_m, np.zeros(3), 1.1) == 1
    assert first_within(positions_m, np.zeros(3), 0.4) == -1
    assert first_within(np.empty((0, 3)), np.zeros(3), 9.0) == -1


def test_rivals_are_other_objects_observed_in_alternation():
    made = table(PLACE_M, offset_by(0.0, 1.0, 0.0), offset_by(3.0, 0.0, 0.0), offset_by(0.0, 0.0, 4.0))
    own, near, rival, before = made
    own.first_ns = before.seen_ns + 1  # may be the same object, which moved
    rival.seen_ns = own.seen_ns = own.first_ns + 50_000_000
    made.put(rival)
    made.put(own)
    assert made.has_promising_since(own.seen_ns)
    assert not made.has_promising_since(own.seen_ns + 1)
    assert [c.number for c in made.rivals_of(own, 2.0)] == [rival.number]
    assert [c.number for c in made.rivals_of(before, 2.0)] == [near.number, rival.number]  # not with `own`
    own.first_ns = 0
    assert [c.number for c in made.rivals_of(own, 2.0)] == [rival.number, before.number]
    rival.velocity_mps = np.array([-30.0, 0.0, 0.0])
    own.stamp_ns += 100_000_000
    assert [c.number for c in made.rivals_of(own, 2.0)] == [before.number]
    assert list(table(PLACE_M, offset_by(3.0, 0.0, 0.0), promising=False).rivals_of(own, 2.0)) == []
