"""Features of candidates: values by hand, what is missing, symmetries."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from stages.detect.flight import lamp_sway_m
from stages.detect.motion_log_ratios import MotionLogRatios
from stages.detect.trained.features import (
    FEATURES,
    NAMES,
    NOT_DISPLACED_NATS,
    features_of,
)
from stages.geometry.frames import rotation_z
from stages.kernels.detect.existence import birth_nats
from stages.kernels.detect.first_observations import PULSE_RAD, first_features
from stages.kernels.detect.isolation import FREE_0, SECTORS, TALLY
from tests.stages.detect.test_candidate import PLACE_M, candidate, observation, path

TELEMETRY = tuple(NAMES[NAMES.index("over_static_nats") : NAMES.index("imu_over_static_nats")])
IMU = tuple(NAMES[NAMES.index("imu_over_static_nats") :])
MOTION = ("relative_speed_mps", "acceleration_mps2", "top_mps", "straight_mps", "straight_sigmas")


def named(c, span_m=0.5, motion_known=True):
    return dict(zip(NAMES, features_of(c, span_m, motion_known).tolist(), strict=True))


def test_the_names_are_distinct_and_each_has_a_text():
    assert len(set(NAMES)) == len(NAMES)
    assert all(feature.text for feature in FEATURES)


def test_only_the_range_makes_a_drone_both_more_and_less_probable():
    assert {feature.name: feature.monotone for feature in FEATURES if feature.monotone not in (-1, 1)} == {"range_m": 0}


def test_after_one_observation_no_motion_is_known():
    features = named(candidate(observation(0.0)))
    unknown = {*MOTION, *TELEMETRY, *IMU, "passes_since_reacquired"}
    assert all(math.isnan(features[name]) for name in unknown)
    assert all(math.isfinite(features[name]) for name in set(NAMES) - unknown)


@pytest.mark.parametrize("seed", range(20))
def test_the_features_of_a_first_observation_need_no_candidate(seed):
    rng = np.random.default_rng(seed)
    first = replace(
        observation(0.0, returns=int(rng.integers(1, 9)), range_m=float(rng.uniform(2.0, 60.0))),
        too_long=bool(rng.integers(2)),
        round_chords=int(rng.integers(3)),
        rough_chords=int(rng.integers(3)),
        isolation=rng.integers(0, 4, TALLY).astype(np.int64) * rng.integers(0, 2, TALLY),
        large_object_m=float(rng.choice([1.2, 3.9, math.inf])),
    )
    near_rejected, revisited, false_per_s = bool(rng.integers(2)), bool(rng.integers(2)), float(rng.uniform(0.1, 50.0))
    c = candidate(first)
    c.false_per_s, c.existence_nats = false_per_s, birth_nats(false_per_s)
    c.near_rejected, c.revisited = near_rejected, revisited
    returned = (first.range_m, first.large_object_m, first.returns, first.too_long)
    row = np.array([*first.xyz_map_m, *returned, first.round_chords, first.rough_chords, *first.isolation], dtype=float)
    alone = np.empty(len(FEATURES))
    first_features(row, 0.5, false_per_s, near_rejected, revisited, alone)
    np.testing.assert_array_equal(alone, features_of(c, 0.5, True))


def test_returns_are_relative_to_those_of_a_beam_across_the_drone():
    features = named(candidate(observation(0.0, returns=4, range_m=20.0)), span_m=0.5)
    assert features["return_ratio"] == pytest.approx(4 * 20.0 * PULSE_RAD / 0.5)
    one, two = observation(0.0, returns=1, range_m=20.0), observation(0.1, returns=3, range_m=20.0)
    assert named(candidate(one, two))["return_ratio"] == pytest.approx(2 * 20.0 * PULSE_RAD / 0.5)


def test_shares_of_chords_and_of_long_passes_do_not_grow_with_the_length_of_a_flight():
    chords = [{"round_chords": 1}, {"rough_chords": 3}, {"rough_chords": 2, "too_long": True}, {}]
    short, long = (
        named(candidate(*(replace(observation(0.1 * k), **chords[k % 4]) for k in range(count)))) for count in (40, 400)
    )
    for name, limit in (("rough_share", 5 / 6), ("too_long_share", 1 / 4)):
        assert short[name] == pytest.approx(limit, abs=0.04)
        assert long[name] == pytest.approx(limit, abs=0.01)


def test_a_straight_flight_has_its_speed_in_any_direction():
    velocity = np.array([2.0, -1.0, 0.5])
    for turn in (0.0, 1.2):
        c = candidate(*path(rotation_z(turn) @ velocity, count=15))
        features = named(c)
        assert features["straight_mps"] == pytest.approx(np.linalg.norm(velocity))
        assert features["relative_speed_mps"] == pytest.approx(np.linalg.norm(velocity), rel=0.05)
        assert features["straight_sigmas"] > 10


def test_a_static_object_has_no_significant_speed():
    rng = np.random.default_rng(1)
    c = candidate(*(observation(0.1 * k, PLACE_M + rng.normal(0, 0.06, 3)) for k in range(20)))
    assert named(c)["straight_sigmas"] < 4


def test_free_sectors_and_the_least_observed_one():
    seen = [observation(0.1 * k) for k in range(3)]
    for one in seen:
        one.isolation[FREE_0 : FREE_0 + 5] = 4
    features = named(candidate(*seen))
    assert (features["free_sectors"], features["least_free"]) == (5.0, 0.0)
    for one in seen:
        one.isolation[FREE_0 : FREE_0 + SECTORS] = 4
    assert named(candidate(*seen))["least_free"] == 3.0


def test_telemetry_is_a_part_of_the_same_features():
    c = candidate(*path((1.0, 0.0, 0.0)))
    c.add_log_ratios(MotionLogRatios(5.0, 4.0, 3.0, 2.0, 1.1, 0.9))
    features = named(c)
    assert [features[name] for name in TELEMETRY] == [5.0, 4.0, 3.0, 5.0]
    c.add_log_ratios(None)  # it ends
    assert [named(c)[name] for name in TELEMETRY] == [5.0, 4.0, 3.0, 5.0]


def test_the_imu_is_a_part_of_the_same_features():
    c = candidate(*path((1.0, 0.0, 0.0)))
    c.imu_log_ratios = MotionLogRatios(5.0, 4.0, 3.0, 2.0, 1.1, 0.9)
    features = named(c)
    assert [features[name] for name in IMU] == [5.0, 4.0, 3.0]
    assert all(math.isnan(features[name]) for name in TELEMETRY)


def test_repeated_observations_raise_the_existence_and_distant_ones_do_not():
    repeated = candidate(*path((0.0, 0.0, 0.0), count=4))
    scattered = candidate(*(observation(0.1 * k, PLACE_M + np.array([2.0 * (-1) ** k, 0.0, 0.0])) for k in range(4)))
    assert named(repeated)["existence_nats"] > 10
    assert named(repeated)["existence_nats"] > named(scattered)["existence_nats"] + 5


@pytest.mark.parametrize(
    ("range_m", "returns", "nats"), [(11.0, 12, 7.0), (25.0, 12, 9.0), (25.0, 1, 7.0), (45.0, 1, 9.0)]
)
def test_where_a_wire_returns_pulses_a_path_along_one_is_no_flight(range_m, returns, nats):
    """Several in a scan pass to 20 m, single ones to 30 m; beyond, telemetry is compared with a static object."""
    c = candidate(*(observation(0.1 * k, returns=returns, range_m=range_m) for k in range(12)))
    c.log_ratios = MotionLogRatios(9.0, 4.0, 3.0, 7.0, misfit=1.1, displacement_m=9.0)
    assert named(c)["displaced_nats"] == nats


def test_far_away_a_lamp_may_seem_to_move_as_far_as_a_drone():
    near, far = (candidate(observation(0.0, range_m=r), observation(0.1, range_m=r)) for r in (15.0, 32.0))
    for c in (near, far):
        c.add_log_ratios(MotionLogRatios(9.0, 4.0, 3.0, 7.0, 1.1, 1.2))
    far.flight_log_ratio = 0.0
    assert named(near)["displaced_nats"] == 7.0
    assert named(far)["displaced_nats"] == NOT_DISPLACED_NATS
    assert lamp_sway_m(32.0) > 1.2
