"""A candidate: number of returns, prediction as a drone, static or moving, and reactivation."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.detect.candidate import FADING, Candidate, Observation
from stages.detect.motion_log_ratios import DENIED, MotionLogRatios
from stages.kernels.detect.candidate import (
    FEW_RETURNS_M,
    OPEN_PASSES,
    SINGLE_RETURN_PER_M,
    SOME_RETURNS_M,
    WIRE_SINGLE_RETURN,
)
from stages.kernels.detect.first_observations import STATIC_M
from stages.kernels.detect.isolation import FARTHER_0, FREE_0, OCCUPIED_0, TALLY
from tests.stages.made import START_NS

PLACE_M = np.array([3.0, 15.0, 12.0])


def observation(t_s, xyz_m=PLACE_M, returns=3, range_m=20.0):
    return Observation(
        stamp_ns=START_NS + round(t_s * 1e9),
        xyz_map_m=np.asarray(xyz_m, dtype=np.float64),
        vehicle_map_m=np.zeros(3),
        range_m=range_m,
        returns=returns,
        too_long=False,
        round_chords=0,
        rough_chords=0,
        isolation=np.zeros(TALLY, dtype=np.int64),
        large_object_m=math.inf,
    )


def candidate(*observations):
    first = observations[0]
    made = Candidate(
        number=1,
        stamp_ns=first.stamp_ns,
        seen_ns=first.stamp_ns,
        xyz_m=first.xyz_map_m,
        velocity_mps=np.zeros(3),
        range_m=first.range_m,
        p=(0.15**2, 0.0, 6.0**2),
        first_returns=first.returns,
    )
    made.add_observation(first)
    for one in observations[1:]:
        made.update(one)
    return made


def path(velocity_mps, count=10, step_s=0.1):
    return [observation(k * step_s, PLACE_M + k * step_s * np.asarray(velocity_mps)) for k in range(count)]


# few returns


@pytest.mark.parametrize("range_m", [20.0, 30.0, 40.0])
def test_from_20_m_a_single_return_counts_as_few(range_m):
    share = SINGLE_RETURN_PER_M * range_m
    one, three = (candidate(observation(0.0, returns=n, range_m=range_m)).return_count_nats for n in (1, 3))
    assert one == pytest.approx(math.log(share / WIRE_SINGLE_RETURN))
    assert three == pytest.approx(math.log((1 - share) / (1 - WIRE_SINGLE_RETURN)))


@pytest.mark.parametrize("range_m", [3.0, 5.0, 9.0])
def test_at_close_range_few_is_a_sixth_of_a_beams_returns_across_the_drone(range_m):
    limit = int(FEW_RETURNS_M / range_m)
    assert candidate(observation(0.0, returns=limit, range_m=range_m)).return_count_nats < 0
    assert candidate(observation(0.0, returns=limit + 1, range_m=range_m)).return_count_nats == 0.0
    assert candidate(observation(0.0, returns=int(SOME_RETURNS_M / range_m) + 1, range_m=range_m)).return_count_nats > 0


def test_the_share_of_few_is_bounded_at_close_and_long_range():
    for range_m, share in ((2.0, 0.1), (5.0, 0.1), (43.0, 0.7), (60.0, 0.7)):
        assert candidate(observation(0.0, returns=1, range_m=range_m)).return_count_nats == pytest.approx(
            math.log(share / WIRE_SINGLE_RETURN)
        )


# prediction as a drone


def test_the_predicted_velocity_is_weighted_between_measured_and_expected_by_variance():
    c = candidate(*path((4.0, 0.0, 0.0), count=2))
    usual, spread = np.array([0.0, 1.0, -1.0]), 2.0
    share = spread**2 / (spread**2 + c.p[2])
    position_m, velocity = c.predict_as_drone(c.stamp_ns + 500_000_000, usual, spread)
    np.testing.assert_allclose(velocity, share * c.velocity_mps + (1 - share) * usual)
    np.testing.assert_allclose(position_m, c.xyz_m + 0.5 * velocity)
    assert 0.1 < share < 0.9


def test_a_large_variance_of_the_expected_velocity_keeps_the_measured_one():
    c = candidate(*path((4.0, -2.0, 1.0), count=3))
    usual = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(c.predict_as_drone(c.stamp_ns, usual, 1e4)[1], c.velocity_mps, atol=1e-4)
    np.testing.assert_allclose(c.predict_as_drone(c.stamp_ns, usual, 1e-4)[1], usual, atol=1e-4)
    np.testing.assert_allclose(
        c.predict_as_drone(c.stamp_ns + 10**9, usual, 1e4)[0], c.xyz_m + c.velocity_mps, atol=1e-3
    )


def test_a_long_path_outweighs_the_expected_velocity():
    few, many = candidate(*path((4.0, 0.0, 0.0), count=2)), candidate(*path((4.0, 0.0, 0.0), count=30))
    (_, early), (_, late) = (c.predict_as_drone(c.stamp_ns, np.zeros(3), 3.0) for c in (few, many))
    assert early[0] < late[0]
    assert late[0] == pytest.approx(4.0, rel=0.15)


# flight in open air that agrees with the drone's odometry


def agreeing(displacement_m, over_static=20.0):
    """Log ratios of a path that agrees with the odometry of a drone of this displacement."""
    return MotionLogRatios(over_static, 20.0, 20.0, 15.0, misfit=0.0, displacement_m=displacement_m)


def hovering(returns=3, range_m=20.0):
    return candidate(*(observation(0.1 * k, returns=returns, range_m=range_m) for k in range(12)))


@pytest.mark.parametrize(
    ("range_m", "displacement_m", "flew"),
    [(20.0, 0.3, True), (26.5, 0.6, False), (26.5, 0.9, True), (31.0, 1.2, False), (31.0, 2.0, True)],
)
def test_a_displacement_smaller_than_a_lamp_is_no_flight(range_m, displacement_m, flew):
    """A lamp at 31 m, whose scattered observations match the motion of a drone that hovers at another position."""
    c = hovering(range_m=range_m)
    c.add_log_ratios(agreeing(displacement_m))
    assert c.flight_log_ratio == (15.0 if flew else 0.0)


@pytest.mark.parametrize(
    ("range_m", "returns", "displacement_m", "flew"),
    [(12.0, 1, 0.6, False), (12.0, 1, 2.0, True), (12.0, 5, 0.6, True), (20.0, 1, 0.6, True)],
)
def test_single_returns_along_a_wire_are_no_flight(range_m, returns, displacement_m, flew):
    """Wires at 12 to 14 m, whose observations match the motion of a drone that hovers 40 m away."""
    c = hovering(returns, range_m)
    c.add_log_ratios(agreeing(displacement_m))
    assert c.flight_log_ratio == (15.0 if flew else 0.0)


def test_a_flight_in_open_air_counts_after_the_candidate_comes_near_an_object_unless_telemetry_contradicts_it():
    c, beside = hovering(), hovering()
    beside.neighbour_score = 1.0
    beside.add_log_ratios(agreeing(9.0))
    assert beside.flight_log_ratio == 0.0
    c.add_log_ratios(agreeing(9.0))
    c.neighbour_score = 10.0
    for now in (agreeing(0.0, over_static=0.0), None):
        c.add_log_ratios(now)
        assert c.flight_log_ratio == 15.0
    c.add_log_ratios(agreeing(9.0, over_static=DENIED - 1.0))
    assert c.flight_log_ratio == 0.0


# static, and reactivated


def test_three_observations_at_one_position_are_static():
    assert candidate(*path((0.0, 0.0, 0.0), count=3)).is_static
    assert not candidate(*path((0.0, 0.0, 0.0), count=2)).is_static
    assert not candidate(*path((0.0, 0.0, 0.0), count=20, step_s=0.001)).is_static  # one scan pass


@pytest.mark.parametrize("axis", range(3))
def test_a_displacement_larger_than_a_lamp_along_any_axis_is_not_static(axis):
    velocity = np.zeros(3)
    velocity[axis] = 1.0
    assert not candidate(*path(velocity, count=8)).is_static  # 0.7 m
    assert candidate(*path(0.7 * velocity, count=8)).is_static  # 0.49 m
    assert 0.49 < STATIC_M < 0.7


def test_only_the_last_observations_decide_whether_it_is_static():
    arrived = path((3.0, 0.0, 0.0), count=6)
    stayed = [observation(0.6 + 0.1 * k, arrived[-1].xyz_map_m) for k in range(8)]
    assert not candidate(*arrived, *stayed[:4]).is_static
    assert candidate(*arrived, *stayed).is_static


def test_a_reactivated_candidate_starts_at_the_mean_of_its_observations_and_keeps_its_count():
    positions = PLACE_M + np.random.default_rng(0).normal(0.0, 0.1, (8, 3))
    c = candidate(*(observation(0.1 * k, position_m) for k, position_m in enumerate(positions)))
    later_ns = c.stamp_ns + 30 * 10**9
    c.reactivate(later_ns)
    np.testing.assert_allclose(c.xyz_m, positions.mean(axis=0))
    np.testing.assert_array_equal(c.velocity_mps, np.zeros(3))
    assert c.stamp_ns == later_ns
    assert c.p[0] < 0.5**2
    c.update(observation(31.0, PLACE_M))
    assert (c.scan_passes, len(c.path_ns)) == (9, 9)
    assert np.linalg.norm(c.velocity_mps) < 0.5  # a pause of half a minute does not spoil it


def test_an_object_behind_a_repeatedly_free_sector_is_no_support():
    def observe(t_s, farther):
        seen = observation(t_s)
        seen.isolation[FREE_0] = 3
        seen.isolation[FARTHER_0] = farther
        return seen

    known_free = [observe(0.1 * k, 0) for k in range(OPEN_PASSES)]
    assert candidate(observe(0.0, 2)).neighbour_score > 0.0
    assert candidate(*known_free, observe(1.0, 2)).neighbour_score == 0.0


def test_a_neighbour_does_not_count_after_the_candidate_has_moved_away():
    """A drone that has passed a wire has no neighbour; a lamp, or observations along a wire, have one."""

    def passing(mps, until_s):
        positions = [PLACE_M + np.array([mps * 0.1 * k, 0.0, 0.0]) for k in range(20)]
        observations = [observation(0.1 * k, position_m) for k, position_m in enumerate(positions)]
        for k, one in enumerate(observations):
            one.isolation[OCCUPIED_0] = 0.1 * k <= until_s
        return candidate(*observations).neighbour_score

    assert passing(0.1, 0.55) > 2.0  # it hovers near its neighbour
    assert passing(4.0, 0.55) == 0.0  # it is 4 m away
    assert passing(4.0, 2.0) == pytest.approx(sum(FADING**k for k in range(5)), abs=1e-9)  # along a wire
