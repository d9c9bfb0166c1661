"""Chords: a ball, a wall in parts, ends that are free or hidden, holes, several lasers, the bulge by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from stages.detect.chords import ChordFinder
from stages.geometry.lidar_models import lidar_profile
from stages.kernels.detect import chords as chord
from stages.messages import SweptPulses
from tests.stages.caster import Ball, Box, Wire, cast, dithering, flying, pulses_seen, still, sweeping
from tests.stages.made import START_NS

STEP_RAD = math.radians(0.2)  # between two pulses of a laser
STEP_NS = 55_296
ORIGIN_M = (0.1, -0.2, 0.35)


def pulses(ranges_m, first=0, lasers=None, origin_m=ORIGIN_M, reflectivity=30) -> SweptPulses:
    """A level fan of one laser that steps by 0.2 deg about z, or of several in turn."""
    ranges_m = np.asarray(ranges_m, dtype=np.float32)
    steps = first + np.arange(len(ranges_m))
    lasers = np.zeros(len(ranges_m)) if lasers is None else np.asarray(lasers)
    if lasers.any():
        steps = first + np.array([np.count_nonzero(lasers[:i] == lasers[i]) for i in range(len(lasers))])
    a = steps * STEP_RAD
    return SweptPulses(
        stamp_ns=START_NS + int(steps[0]) * STEP_NS,
        point_stamp_ns=START_NS + steps * STEP_NS,
        direction_vehicle=np.stack([np.cos(a), np.sin(a), np.zeros(len(a))], axis=1).astype(np.float32),
        range_m=ranges_m,
        laser=lasers.astype(np.uint8),
        reflectivity=np.broadcast_to(np.uint8(reflectivity), (len(a),)).copy(),
        turntable_rad=0.0,
        origin_vehicle_m=origin_m,
    )


def finder(longest_m=0.8, jump_m=0.35, hole_m=0.3) -> ChordFinder:
    return ChordFinder(longest_m, jump_m, hole_m, lidar_profile("VLP-16"))


def feed(*slices, **settings):
    """All chords of some slices: rows, first and last time."""
    find = finder(**settings)
    parts = [find.feed(part) for part in slices]
    return (
        np.concatenate([part.rows for part in parts]),
        np.concatenate([part.first_ns for part in parts]),
        np.concatenate([part.last_ns for part in parts]),
    )


def position(step, range_m):
    return np.array(ORIGIN_M) + range_m * np.array([math.cos(step * STEP_RAD), math.sin(step * STEP_RAD), 0.0])


def test_five_returns_in_free_space_are_one_short_chord_free_at_both_ends():
    r = 20.0
    rows, first_ns, last_ns = feed(pulses([0] * 10 + [r] * 5 + [0] * 20, reflectivity=40))
    assert len(rows) == 1
    (row,) = rows
    np.testing.assert_allclose(row[: chord.Z + 1], np.mean([position(k, r) for k in range(10, 15)], axis=0), atol=1e-4)
    assert row[chord.LENGTH] == pytest.approx(2 * r * math.sin(2 * STEP_RAD), abs=1e-4)
    assert (row[chord.RANGE], row[chord.DEPTH], row[chord.SHADE]) == (20.0, 0.0, 40.0)
    assert (row[chord.COUNT], row[chord.GAPS], row[chord.FREE], row[chord.LONG]) == (5, 0, 2, 0)
    assert (first_ns[0] - START_NS, last_ns[0] - START_NS) == (10 * STEP_NS, 14 * STEP_NS)


def test_a_chord_is_reported_as_soon_as_the_beam_is_a_holes_width_past_it():
    r = 20.0  # 7 cm per pulse: the fifth is 0.3 m past it
    find = finder()
    parts = [len(find.feed(pulses([value], first=k)).rows) for k, value in enumerate([0, r, r, 0, 0, 0, 0, 0, 0])]
    assert parts == [0, 0, 0, 0, 0, 0, 0, 1, 0]


@pytest.mark.parametrize("lost", [0, 24, 96])
def test_a_packet_loss_ends_a_chord_without_a_free_end(lost):
    """Two objects at the same range, with a packet loss between them."""
    r = 20.0
    before, after = pulses([0] * 10 + [r] * 4), pulses([r] * 4 + [0] * 20, first=14 + lost)
    rows, *_ = feed(before, after)
    assert rows[:, chord.COUNT].tolist() == ([8] if lost == 0 else [4, 4])
    assert rows[:, chord.FREE].tolist() == ([2] if lost == 0 else [1, 1])
    assert not rows[:, chord.LONG].any()


def test_pulses_before_a_packet_loss_do_not_make_an_end_free():
    wall = pulses([20.0] * 3 + [0] * 10, first=200)
    assert feed(pulses([0] * 10), wall)[0][:, chord.FREE].tolist() == [1]


def test_the_chords_do_not_depend_on_the_slices():
    rng = np.random.default_rng(5)
    ranges = np.where(rng.random(400) < 0.6, 15.0 + rng.normal(0, 0.15, 400) + 3 * (rng.random(400) < 0.1), 0.0)
    whole = feed(pulses(ranges))
    cut = feed(*(pulses(ranges[k : k + 7], first=k) for k in range(0, 400, 7)))
    assert len(whole[0]) > 20
    for a, b in zip(whole, cut, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5, equal_nan=True)


def test_a_wall_is_reported_in_parts_and_each_part_is_long():
    r = 10.0  # 3.5 cm a pulse
    rows, _, _ = feed(pulses([0] * 3 + [r] * 100 + [0] * 30))
    assert len(rows) == 5  # 3.46 m in parts of a little over 0.8 m, and the remainder
    assert rows[:4, chord.LONG].tolist() == [1, 1, 1, 1]
    assert rows[-1, chord.LONG] == 1  # the end of a wall is long, too
    assert np.all((rows[:4, chord.LENGTH] > 0.8) & (rows[:4, chord.LENGTH] < 0.84))
    along = np.arctan2(rows[:, chord.Y] - ORIGIN_M[1], rows[:, chord.X] - ORIGIN_M[0]) / STEP_RAD
    assert np.all(np.diff(along) > 0)
    assert 3 <= along[0] <= along[-1] <= 103


@pytest.mark.parametrize(
    ("before", "after", "free"),
    [
        (0.0, 0.0, True),  # nothing on either side
        (40.0, 40.0, True),  # a wall far behind
        (19.8, 0.0, False),  # it continues an object at its own range
        (0.0, 19.8, False),
        (5.0, 0.0, False),  # a nearer object hides its start
        (0.0, 5.0, False),  # and its end
    ],
)
def test_an_end_is_free_only_if_the_adjacent_pulses_went_farther(before, after, free):
    rows, _, _ = feed(pulses([before] * 10 + [20.0] * 3 + [after] * 10 + [0.0] * 30))
    of_it = rows[(np.abs(rows[:, chord.RANGE] - 20.0) < 0.25) & (rows[:, chord.LONG] == 0)]
    assert np.any(of_it[:, chord.FREE] == 2) == free


def test_the_first_pulse_has_no_free_end():
    rows, _, _ = feed(pulses([20.0] * 3 + [0] * 10))
    assert rows[0, chord.FREE] == 1


def test_a_hole_smaller_than_allowed_is_bridged_and_counted():
    r = 20.0
    rows, _, _ = feed(pulses([0, r, r, 0, 0, r, 0, r, *[0] * 10]))
    assert len(rows) == 1
    assert (rows[0, chord.COUNT], rows[0, chord.GAPS]) == (4, 3)
    assert rows[0, chord.LENGTH] == pytest.approx(2 * r * math.sin(3 * STEP_RAD), abs=1e-4)
    separate, _, _ = feed(pulses([0, r, r, *[0] * 5, r, r, *[0] * 10]))  # 0.42 m: two objects
    assert separate[:, chord.COUNT].tolist() == [2, 2]
    assert separate[:, chord.FREE].tolist() == [2, 2]


def test_a_step_in_range_separates_two_chords():
    rows, _, _ = feed(pulses([0] * 2 + [20.0] * 3 + [20.3] * 3 + [22.0] * 2 + [0] * 10))
    assert rows[:, chord.COUNT].tolist() == [6, 2]  # 0.3 m is within
    assert rows[:, chord.FREE].tolist() == [2, 1]  # what is farther behind is no end that hides, and is hidden itself
    assert rows[0, chord.DEPTH] == pytest.approx(0.3, abs=1e-3)
    nearer, _, _ = feed(pulses([0] * 2 + [20.0] * 3 + [18.0] * 3 + [0] * 10))
    assert nearer[:, chord.COUNT].tolist() == [3, 3]
    assert nearer[:, chord.FREE].tolist() == [1, 2]  # the nearer one hides the end of the farther
    later, _, _ = feed(pulses([0] * 2 + [20.0] * 3 + [26.0] * 2 + [18.0] * 3 + [0] * 10))
    assert later[:, chord.FREE].tolist()[0] == 2  # two pulses had gone past its end before


@pytest.mark.parametrize("after", [3, 30])
def test_a_rain_drop_leaves_a_farther_object_as_it_is(after):
    """A drop at 1 m and another at 2 m, then a drone, before the beam is a hole's width past the drops."""
    drone = [20.0] * 5 + [0.0] * 90
    alone, first_ns, last_ns = feed(pulses([0.0] * (2 + 2 * after) + drone))
    rows, *times = feed(pulses([1.0] + [0.0] * after + [2.0] + [0.0] * after + drone))
    of_drone = rows[:, chord.RANGE] > 3.0
    assert sorted(rows[:, chord.RANGE].tolist()) == [1, 2, 20]
    assert rows[of_drone, chord.FREE] == 2
    np.testing.assert_array_equal(rows[of_drone], alone)
    np.testing.assert_array_equal([t[of_drone] for t in times], [first_ns, last_ns])


def test_a_nearer_object_that_continues_hides_the_end_of_one_behind_its_hole():
    near, behind = [2.0] * 2, [20.0] * 2
    rows, _, _ = feed(pulses([0.0] * 3 + near + behind + near + [0.0] * 90))
    assert {(row[chord.RANGE], row[chord.COUNT], row[chord.FREE]) for row in rows} == {(2, 4, 2), (20, 2, 0)}
    through, _, _ = feed(pulses([0.0] * 3 + near + [0.0] + behind + [0.0] * 2 + near + [0.0] * 90))
    assert {(row[chord.RANGE], row[chord.COUNT], row[chord.FREE]) for row in through} == {(2, 4, 2), (20, 2, 2)}


def test_lasers_are_independent():
    a, b = [0, 0, 20.0, 20.0, 20.0, *[0] * 20], [7.0] * 4 + [0] * 21
    mixed = pulses(np.stack([a, b], axis=1).ravel(), lasers=np.tile([3, 9], len(a)))
    rows, _, _ = feed(mixed)
    assert {int(row[chord.LASER]): (row[chord.COUNT], row[chord.RANGE]) for row in rows} == {3: (3, 20), 9: (4, 7)}
    alone, _, _ = feed(pulses(a))
    (same,) = rows[rows[:, chord.LASER] == 3]
    np.testing.assert_allclose(np.delete(same, chord.LASER), np.delete(alone[0], chord.LASER), equal_nan=True)


def test_the_bulge_of_a_ball_is_half_over_its_radius_and_that_of_a_board_zero():
    """A ball of radius rho, its centre at R: r = R cos a - sqrt(rho^2 - R^2 sin^2 a), u = (R - rho) a.

    By the second derivative at a = 0, r = r_0 + u^2 R / (2 rho (R - rho)), which is 1 / (2 rho) far away.
    """
    origin = np.array([0.0, 0.0, 0.0])
    a = np.arange(-40, 41) * math.radians(0.01)  # fine pulses: many on the cap
    direction = np.stack([np.cos(a), np.sin(a), np.zeros(81)], axis=1)
    for radius_m in (0.25, 0.5):
        ball = Ball(still(10.0, 0.0, 0.0), radius_m)
        ranges = cast([ball], np.broadcast_to(origin, direction.shape), direction, np.zeros(81))
        ranges[np.abs(10 * a) > 0.25 * radius_m] = 0.0  # the cap, where the formula holds
        (row,) = fine(ranges, direction)
        assert row[chord.BULGE] == pytest.approx(10.0 / (2 * radius_m * (10.0 - radius_m)), rel=0.02)
        assert row[chord.ROUGH] < 1e-3
    board = Box((10.0, -0.1, -1.0), (10.2, 0.1, 1.0))
    (row,) = fine(cast([board], np.broadcast_to(origin, direction.shape), direction, np.zeros(81)), direction)
    assert abs(row[chord.BULGE]) < 0.1


def test_an_irregular_object_is_rough_and_three_returns_have_no_profile():
    rugged, _, _ = feed(pulses([0, 20.0, 20.2, 19.9, 20.2, 20.0, *[0] * 10]))
    assert rugged[0, chord.ROUGH] > 0.1
    few, _, _ = feed(pulses([0, 20.0, 20.1, 20.0, *[0] * 10]))
    assert math.isnan(few[0, chord.BULGE])
    assert math.isnan(few[0, chord.ROUGH])


def fine(ranges, direction):
    part = pulses(ranges, origin_m=(0.0, 0.0, 0.0))
    object.__setattr__(part, "direction_vehicle", direction.astype(np.float32))
    after = pulses([0.0] * 3, first=81, origin_m=(0.0, 0.0, 0.0))  # far enough to the side that it has ended
    rows, _, _ = feed(part, after)
    return rows


def test_a_ball_gives_short_free_chords_and_a_house_long_ones():
    ball, house, wire = (
        Ball(flying((1.0, 8.0, 9.0), (0.3, 0.0, 0.0)), 0.25),
        Box((-6, -9, 0), (-3, -6, 12)),
        Wire((-9, 4, 8), (9, 4, 8), 0.02),
    )
    find = finder()
    rows = np.concatenate([find.feed(part).rows for part in pulses_seen([ball, house, wire], sweeping(), 1.5)])
    of_ball = rows[np.linalg.norm(rows[:, :3] - (1.2, 8.0, 9.0), axis=1) < 0.6]
    assert len(of_ball) >= 3
    assert np.all((of_ball[:, chord.LONG] == 0) & (of_ball[:, chord.FREE] == 2) & (of_ball[:, chord.LENGTH] < 0.5))
    of_house = rows[(rows[:, chord.X] < -2.9) & (rows[:, chord.Y] < -5.9)]
    assert of_house[:, chord.LONG].mean() > 0.7
    assert len(of_ball) + len(of_house) < len(rows)  # the others are the wire's


def test_in_rain_most_scan_passes_over_a_drone_give_a_free_chord():
    """Drops at 1 to 3 m in 1.5 % of the pulses, as in rain of 5 mm/h."""
    rng = np.random.default_rng(7)
    dry = list(pulses_seen([Ball(still(0.0, 14.0, 14.0), 0.25)], dithering(), 3.0))
    free = {}
    for rain in (False, True):
        find, passes = finder(), set()
        for part in dry:
            drops = rng.uniform(1.0, 3.0, part.range_m.size).astype(np.float32)
            fall = rain & (rng.random(part.range_m.size) < 0.015)
            found = find.feed(replace(part, range_m=np.where(fall, drops, part.range_m)))
            of_drone = (found.rows[:, chord.RANGE] > 10.0) & (found.rows[:, chord.FREE] == 2)
            passes |= {int(t) // 100_000_000 for t in found.first_ns[of_drone] - START_NS}
        free[rain] = len(passes)
    assert free[False] > 20
    assert free[True] > 0.75 * free[False]


def test_an_empty_slice_has_no_chords():
    find = finder()
    assert len(find.feed(pulses([0.0] * 5)).rows) == 0
    empty = pulses([0.0] * 5)
    for name in ("point_stamp_ns", "direction_vehicle", "range_m", "laser", "reflectivity"):
        object.__setattr__(empty, name, getattr(empty, name)[:0])
    assert len(find.feed(empty).rows) == 0
