"""One candidate: few returns or many, where it is if it is a drone, whether it stands, and meeting it again."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.detect.candidate import (
    FADING,
    FEW_RETURNS_M,
    SINGLE_RETURN_PER_M,
    SOME_RETURNS_M,
    STATIC_M,
    WIRE_SINGLE_RETURN,
    Candidate,
    Observation,
)
from stages.kernels.detect.candidate import OPEN_PASSES
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


def way(velocity_mps, looks=10, step_s=0.1):
    return [observation(k * step_s, PLACE_M + k * step_s * np.asarray(velocity_mps)) for k in range(looks)]


# few returns


@pytest.mark.parametrize("range_m", [20.0, 30.0, 40.0])
def test_from_20_m_on_one_return_alone_is_few(range_m):
    share = SINGLE_RETURN_PER_M * range_m
    one, three = (candidate(observation(0.0, returns=n, range_m=range_m)).return_count_nats for n in (1, 3))
    assert one == pytest.approx(math.log(share / WIRE_SINGLE_RETURN))
    assert three == pytest.approx(math.log((1 - share) / (1 - WIRE_SINGLE_RETURN)))


@pytest.mark.parametrize("range_m", [3.0, 5.0, 9.0])
def test_nearby_as_many_are_few_as_a_sixth_of_a_beam_across_the_drone(range_m):
    limit = int(FEW_RETURNS_M / range_m)
    assert candidate(observation(0.0, returns=limit, range_m=range_m)).return_count_nats < 0
    assert candidate(observation(0.0, returns=limit + 1, range_m=range_m)).return_count_nats == 0.0
    assert candidate(observation(0.0, returns=int(SOME_RETURNS_M / range_m) + 1, range_m=range_m)).return_count_nats > 0


def test_the_share_of_few_is_bounded_nearby_and_far_off():
    for range_m, share in ((2.0, 0.1), (5.0, 0.1), (43.0, 0.7), (60.0, 0.7)):
        assert candidate(observation(0.0, returns=1, range_m=range_m)).return_count_nats == pytest.approx(
            math.log(share / WIRE_SINGLE_RETURN)
        )


# where it is if it is a drone


def test_a_drone_is_expected_between_its_measured_and_its_usual_velocity_by_their_variances():
    c = candidate(*way((4.0, 0.0, 0.0), looks=2))
    usual, spread = np.array([0.0, 1.0, -1.0]), 2.0
    share = spread**2 / (spread**2 + c.p[2])
    place, velocity = c.predict_as_drone(c.stamp_ns + 500_000_000, usual, spread)
    np.testing.assert_allclose(velocity, share * c.velocity_mps + (1 - share) * usual)
    np.testing.assert_allclose(place, c.xyz_m + 0.5 * velocity)
    assert 0.1 < share < 0.9


def test_a_wide_usual_velocity_leaves_the_measured_one_and_a_narrow_one_replaces_it():
    c = candidate(*way((4.0, -2.0, 1.0), looks=3))
    usual = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(c.predict_as_drone(c.stamp_ns, usual, 1e4)[1], c.velocity_mps, atol=1e-4)
    np.testing.assert_allclose(c.predict_as_drone(c.stamp_ns, usual, 1e-4)[1], usual, atol=1e-4)
    np.testing.assert_allclose(
        c.predict_as_drone(c.stamp_ns + 10**9, usual, 1e4)[0], c.xyz_m + c.velocity_mps, atol=1e-3
    )


def test_a_long_path_counts_more_than_what_is_usual():
    few, many = candidate(*way((4.0, 0.0, 0.0), looks=2)), candidate(*way((4.0, 0.0, 0.0), looks=30))
    (_, early), (_, late) = (c.predict_as_drone(c.stamp_ns, np.zeros(3), 3.0) for c in (few, many))
    assert early[0] < late[0]
    assert late[0] == pytest.approx(4.0, rel=0.15)


# standing, and being met again


def test_what_is_met_three_times_in_one_place_stands():
    assert candidate(*way((0.0, 0.0, 0.0), looks=3)).is_static
    assert not candidate(*way((0.0, 0.0, 0.0), looks=2)).is_static
    assert not candidate(*way((0.0, 0.0, 0.0), looks=20, step_s=0.001)).is_static  # one look


@pytest.mark.parametrize("axis", range(3))
def test_what_goes_farther_than_a_lamp_is_long_along_any_axis_does_not_stand(axis):
    velocity = np.zeros(3)
    velocity[axis] = 1.0
    assert not candidate(*way(velocity, looks=8)).is_static  # 0.7 m
    assert candidate(*way(0.7 * velocity, looks=8)).is_static  # 0.49 m
    assert 0.49 < STATIC_M < 0.7


def test_only_its_last_sightings_tell_whether_it_stands():
    arrived = way((3.0, 0.0, 0.0), looks=6)
    stayed = [observation(0.6 + 0.1 * k, arrived[-1].xyz_map_m) for k in range(8)]
    assert not candidate(*arrived, *stayed[:4]).is_static
    assert candidate(*arrived, *stayed).is_static


def test_it_is_met_again_in_the_middle_of_its_sightings_at_rest_and_goes_on_counting():
    places = PLACE_M + np.random.default_rng(0).normal(0.0, 0.1, (8, 3))
    c = candidate(*(observation(0.1 * k, place) for k, place in enumerate(places)))
    later_ns = c.stamp_ns + 30 * 10**9
    c.reactivate(later_ns)
    np.testing.assert_allclose(c.xyz_m, places.mean(axis=0))
    np.testing.assert_array_equal(c.velocity_mps, np.zeros(3))
    assert c.stamp_ns == later_ns
    assert c.p[0] < 0.5**2
    c.update(observation(31.0, PLACE_M))
    assert (c.scan_passes, len(c.path_ns)) == (9, 9)
    assert np.linalg.norm(c.velocity_mps) < 0.5  # not thrown far off by half a minute


def test_what_stands_behind_a_sector_that_is_free_again_and_again_is_not_what_holds_it():
    def look(t_s, farther):
        seen = observation(t_s)
        seen.isolation[FREE_0] = 3
        seen.isolation[FARTHER_0] = farther
        return seen

    known_free = [look(0.1 * k, 0) for k in range(OPEN_PASSES)]
    assert candidate(look(0.0, 2)).neighbour_score > 0.0
    assert candidate(*known_free, look(1.0, 2)).neighbour_score == 0.0


def test_what_stood_beside_it_holds_it_no_more_when_it_has_flown_away_from_there():
    """A drone that had passed a wire was refused for seconds; a lamp, or what is met along a wire, has it beside it."""

    def passing(mps, until_s):
        places = [PLACE_M + np.array([mps * 0.1 * k, 0.0, 0.0]) for k in range(20)]
        looks = [observation(0.1 * k, place) for k, place in enumerate(places)]
        for k, one in enumerate(looks):
            one.isolation[OCCUPIED_0] = 0.1 * k <= until_s
        return candidate(*looks).neighbour_score

    assert passing(0.1, 0.55) > 2.0  # it hangs near what was seen beside it
    assert passing(4.0, 0.55) == 0.0  # it is 4 m away
    assert passing(4.0, 2.0) == pytest.approx(sum(FADING**k for k in range(5)), abs=1e-9)  # along a wire
