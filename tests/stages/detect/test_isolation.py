"""Isolation: sectors by hand, depth tolerance, and the map of large objects."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.detect.isolation import LargeObjectMap
from stages.geometry.frames import rotation_from_rpy_deg
from stages.kernels.detect.isolation import (
    FARTHER_0,
    FREE_0,
    INNER_HITS,
    INNER_PASSES,
    MAP_SIZE,
    NEARER,
    OCCUPIED_0,
    SECTORS,
    TALLY,
    count_sectors,
)

ORIGIN_M = np.array([0.5, -0.3, 0.35])
CLOSE_M, OUTER_M = 1.2, 2.0
AHEAD_M = np.add(ORIGIN_M, [20.0, 0.0, 0.0])  # a = +y, b = +z across the line of sight


def isolation(offsets_m, ranges_m, centre_m=AHEAD_M, R=None):
    """The tally of pulses that pass the position at offsets (a, b) [m]; range 0 is a pulse without return."""
    R = np.eye(3) if R is None else R
    line = np.array([20.0, 0.0, 0.0])
    direction = np.array([np.add(line, [0.0, a, b]) for a, b in np.reshape(offsets_m, (-1, 2))])
    direction = (direction / np.linalg.norm(direction, axis=1, keepdims=True)) @ R.T
    tally = np.zeros(TALLY, dtype=np.int64)
    ranges = np.asarray(ranges_m, dtype=np.float32).reshape(-1)
    centre = ORIGIN_M + R @ (centre_m - ORIGIN_M)
    count_sectors(direction.astype(np.float32), ranges, ORIGIN_M, centre, 0.15, 0.55, CLOSE_M, OUTER_M, 0.5, tally)
    return tally


def sector_of(tally):
    return np.nonzero(tally[FREE_0:])[0].tolist()


@pytest.mark.parametrize("sector", range(SECTORS))
def test_a_pulse_in_the_ring_makes_its_sector_free_or_occupied(sector):
    angle = -math.pi + (sector + 0.5) * math.tau / SECTORS  # counted from -a, over -b
    offset = 1.0 * np.array([math.cos(angle), math.sin(angle)])
    assert sector_of(isolation(offset, 0.0)) == [sector]
    assert sector_of(isolation(offset, 35.0)) == [sector]  # it went on to a wall far behind
    assert sector_of(isolation(offset, 20.0)) == [OCCUPIED_0 - FREE_0 + sector]


@pytest.mark.parametrize("sector", range(SECTORS))
def test_beyond_the_ring_only_returns_count(sector):
    angle = -math.pi + (sector + 0.5) * math.tau / SECTORS
    offset = 1.6 * np.array([math.cos(angle), math.sin(angle)])
    assert sector_of(isolation(offset, 20.0)) == [FARTHER_0 - FREE_0 + sector]
    assert sector_of(isolation(offset, 0.0)) == []


def test_pulses_through_the_inner_disc_are_returns_and_pass_throughs():
    tally = isolation([[0, 0], [0.1, 0], [0, -0.1], [0.1, 0.1]], [20.1, 0.0, 33.0, 19.8])
    assert (tally[INNER_HITS], tally[INNER_PASSES]) == (2, 2)
    assert tally[FREE_0:].sum() == 0


def test_between_disc_and_ring_and_beyond_the_ring_nothing_counts():
    assert isolation([[0.3, 0], [0, 0.5], [2.1, 0], [0, -9]], [20.0, 0.0, 20.0, 0.0]).sum() == 0


def test_a_nearer_return_gives_no_information():
    tally = isolation([[1, 0], [0, 0]], [12.0, 12.0])
    assert tally[NEARER] == 2
    assert tally[INNER_HITS] + tally[INNER_PASSES] + tally[FREE_0:].sum() == 0


def test_the_depth_tolerance_grows_with_the_distance_across():
    """Within 0.5 m + 1.2 times the offset of R: a wire towards the sensor is a neighbour, a far house is not."""
    for away, r, expected in [
        (0.6, 18.9, "hit"),
        (0.6, 18.6, "nearer"),
        (1.8, 17.4, "hit"),
        (1.8, 22.5, "hit"),
        (1.8, 22.8, "past"),
    ]:
        tally = isolation([away, 0.0], r)
        got = "nearer" if tally[NEARER] else ("hit" if tally[OCCUPIED_0:].sum() else "past")
        assert got == expected, (away, r)


def test_pulses_in_the_opposite_direction_do_not_count():
    tally = np.zeros(TALLY, dtype=np.int64)
    back = np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=np.float32)
    count_sectors(back, np.zeros(2, dtype=np.float32), ORIGIN_M, AHEAD_M, 0.15, 0.55, CLOSE_M, OUTER_M, 0.5, tally)
    assert tally.sum() == 0


@pytest.mark.parametrize("yaw_deg", [30.0, -100.0, 179.0])
def test_the_sectors_are_invariant_to_yaw(yaw_deg):
    rng = np.random.default_rng(1)
    offsets, ranges = rng.uniform(-1.8, 1.8, (900, 2)), rng.choice([0.0, 20.0, 35.0, 10.0], 900)
    plain = isolation(offsets, ranges)
    turned = isolation(offsets, ranges, R=rotation_from_rpy_deg((0.0, 0.0, yaw_deg)))
    np.testing.assert_array_equal(plain, turned)
    assert plain[INNER_PASSES:].all()


def test_at_the_zenith_all_counts_are_defined():
    R = rotation_from_rpy_deg((0.0, -90.0, 0.0))
    rng = np.random.default_rng(2)
    tally = isolation(rng.uniform(-1.5, 1.5, (500, 2)), np.zeros(500), R=R)
    assert np.all(tally[FREE_0:OCCUPIED_0] > 5)


def test_the_map_gives_the_distance_to_the_nearest_large_object():
    big = LargeObjectMap(cell_m=0.5)
    big.add(np.array([[10.1, 0.1, 5.1], [12.1, 0.1, 5.1]]), 1_000)
    middle = np.array([10.25, 0.25, 5.25])
    assert big.nearest_m(np.add(middle, [1.0, 0, 0]), 0.3, 2.0, 0) == pytest.approx(1.0)  # the other one is as near
    assert big.nearest_m(middle - [1.5, 0, 0], 0.3, 2.0, 0) == pytest.approx(1.5)
    assert big.nearest_m(middle - [2.5, 0, 0], 0.3, 2.0, 0) == math.inf


def test_the_object_itself_and_old_observations_are_ignored():
    big = LargeObjectMap(cell_m=0.5)
    position = np.array([[3.25, 3.25, 3.25]])
    big.add(position, 1_000)
    assert big.nearest_m(np.add(position[0], [0.2, 0, 0]), 0.3, 2.0, 0) == math.inf
    assert big.nearest_m(np.add(position[0], [0.5, 0, 0]), 0.3, 2.0, 1_001) == math.inf
    assert big.nearest_m(np.add(position[0], [0.5, 0, 0]), 0.3, 2.0, 1_000) == pytest.approx(0.5)
    big.add(position, 2_000)  # observed again
    assert big.nearest_m(np.add(position[0], [0.5, 0, 0]), 0.3, 2.0, 1_001) == pytest.approx(0.5)


def test_cells_on_either_side_of_zero_and_far_away_are_distinct():
    big = LargeObjectMap(cell_m=0.5)
    rng = np.random.default_rng(3)
    points = rng.uniform(-200, 200, (500, 3))
    big.add(points, 5)
    for point in points[-50:]:  # the newest keep their cells in the table
        cell_middle = (np.floor(point / 0.5) + 0.5) * 0.5
        assert big.nearest_m(np.add(cell_middle, [0.0, 0.0, 1.0]), 0.9, 1.1, 0) == pytest.approx(1.0, abs=0.11)
    empty = np.array([1000.0, 1000.0, 1000.0])
    assert big.nearest_m(empty, 0.0, 2.0, 0) == math.inf


def test_the_map_is_bounded():
    big = LargeObjectMap()
    big.add(np.random.default_rng(0).uniform(-500, 500, (2 * MAP_SIZE, 3)), 1)
    assert big._key.size == big._when.size == MAP_SIZE
