"""Existence of an object behind observations: birth, survival, observations and pass-throughs."""

from __future__ import annotations

import math

import pytest

from stages.detect.trained.existence import (
    LIFETIME_S,
    FalseReturns,
    observed_nats,
    passed_nats,
    survived_nats,
)
from stages.kernels.detect.existence import LEAST_FALSE_PER_S, MEMORY_S, SHELL_M, birth_nats

START_NS = 1_000_000_000


def test_a_clear_sky_has_the_least_rate_of_false_returns():
    assert FalseReturns().per_s(20.0, START_NS) == LEAST_FALSE_PER_S


def test_false_returns_count_at_their_range_and_are_forgotten():
    false = FalseReturns()
    for k in range(12):
        false.add(5.0, START_NS + k * 10**8)
    now_ns = START_NS + 11 * 10**8
    assert false.per_s(5.0, now_ns) > 20 * LEAST_FALSE_PER_S
    assert false.per_s(5.0 + 2 * SHELL_M, now_ns) == LEAST_FALSE_PER_S
    later = false.per_s(5.0, now_ns + round(MEMORY_S * 1e9)) - LEAST_FALSE_PER_S
    assert later == pytest.approx((false.per_s(5.0, now_ns) - LEAST_FALSE_PER_S) / math.e)


def test_a_first_return_in_rain_is_less_probably_an_object():
    assert birth_nats(10.0) == pytest.approx(birth_nats(0.1) - math.log(100.0))


def test_without_observations_existence_fades_to_the_share_that_survives():
    log_odds = survived_nats(20.0, LIFETIME_S)
    assert 1.0 / (1.0 + math.exp(-log_odds)) == pytest.approx(math.exp(-1.0), abs=1e-6)
    assert survived_nats(1.3, 0.0) == pytest.approx(1.3)
    assert survived_nats(1e9, 0.1) < 10.0  # certainty does not survive


def test_an_observation_counts_more_the_nearer_it_is_and_the_fewer_false_returns_there_are():
    near, far = (observed_nats(d2, 0.1, 20.0, 4, 0.05) for d2 in (0.0, 1.0))
    assert near - far == pytest.approx(5.0)  # half of 1.0 / 0.1
    assert observed_nats(0.0, 0.1, 20.0, 4, 5.0) == pytest.approx(near - math.log(100.0))


def test_pass_throughs_count_less_far_away_where_a_drone_does_not_always_return():
    assert passed_nats(20.0, 3) == pytest.approx(3.0 * math.log(0.4))  # three of 60 %
    assert passed_nats(20.0, 3) < passed_nats(50.0, 3) < passed_nats(50.0, 1) < 0.0
    assert math.isfinite(passed_nats(5.0, 500))
