"""The bank of four by formula: Bayes over windows, drift shared by windows, outliers, leak, slips."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.geometry.frames import rotation_z
from stages.heading.hypothesis_bank import DIRECTIONS, NONE, BranchSettings, Displacement, HypothesisBank, turns

S = 1_000_000_000
NOISE = 0.1**2 * np.eye(2)


def quarter_turned(v, k):
    """Rz(k 90 deg) v."""
    return turns(DIRECTIONS)[k % 4 * DIRECTIONS // 4] @ v


def moved(odometry_m, lidar_m, start_s=0.0, seconds=0.5, metric=True, bearing_rad=0.03) -> Displacement:
    lidar = np.tile(np.asarray(lidar_m, dtype=float), (DIRECTIONS, 1))
    return Displacement(
        round(start_s * S) + S,
        round((start_s + seconds) * S) + S,
        lidar,
        NOISE,
        np.asarray(odometry_m, dtype=float),
        bearing_rad,
        metric,
    )


def bank(**settings) -> HypothesisBank:
    return HypothesisBank(BranchSettings(**settings))


def decided(k, **settings) -> HypothesisBank:
    b = bank(**settings)
    for i in range(4):
        way = np.array([0.8, 0.1 * i])
        b.see(moved(way, quarter_turned(way, k), start_s=i))
    assert b.resolved(k, 0.999)
    return b


def test_the_prior_is_equal_for_all_four_with_a_probability_of_none():
    np.testing.assert_allclose(bank(none_right=0.08).probability, [0.23, 0.23, 0.23, 0.23, 0.08])


@pytest.mark.parametrize("k", range(4))
@pytest.mark.parametrize("metric", [True, False])
def test_windows_resolve_the_branch_that_turns_the_odometry_onto_the_lidar(k, metric):
    b = bank()
    for i in range(6):
        way = np.array([0.8, 0.3])
        b.see(moved(way, quarter_turned(way, k), start_s=i, metric=metric))
    assert b.best(0) == k
    assert b.probability[k] > 0.999
    assert b.windows == 6
    assert b.probability.sum() == pytest.approx(1.0)


def test_one_window_by_hand():
    """Bayes with (1 - o) N(e; 0, S) + o / area, S of fixes, drift, direction and scale, along and across the displacement."""
    b = bank()
    b.see(moved([1.0, 0.0], [1.0, 0.0], seconds=0.5))
    fresh = 0.12**2 * (1 - math.exp(-0.05)) / 3
    drift = 0.25 * (0.12**2 + fresh)
    along, across = 0.01 + drift + 0.05**2, 0.01 + drift + 0.03**2
    area = math.pi * 3.0**2
    likelihood = []
    for i in range(16):
        R = rotation_z(i * math.pi / 8)[:2, :2]
        e = np.array([1.0, 0.0]) - R[:, 0]
        S_ = R @ np.diag([along, across]) @ R.T
        normal = math.exp(-0.5 * e @ np.linalg.solve(S_, e)) / (2 * math.pi * math.sqrt(along * across))
        likelihood.append(0.9 * normal + 0.1 / area)
    radial = 0.01 + 0.05**2 + (0.5 * 0.12) ** 2
    likelihood.append(0.5 / area + 0.5 / math.sqrt(2 * math.pi * radial) / (2 * math.pi))
    check_bayes(b, likelihood)


def check_bayes(b: HypothesisBank, likelihood) -> None:
    """Priors: 0.95 / 4 each branch, 0.049 for none, 0.001 for the twelve angles between."""
    prior = np.array(([0.2375] + [0.001 / 12] * 3) * 4 + [0.049])
    weighed = prior * likelihood
    weighed /= weighed.sum()
    branches = weighed[[0, 4, 8, 12]]
    np.testing.assert_allclose(b.probability, [*branches, 1 - branches.sum()], rtol=1e-9)


def test_one_bearing_by_hand():
    b = bank()
    b.see(moved([1.0, 0.0], [0.0, 2.0], metric=False, seconds=0.5, bearing_rad=0.2))
    sigma = math.sqrt(0.2**2 + math.radians(9) ** 2 + 0.01 / 4 + (0.12 * 0.5 / 2) ** 2)
    peak = 1 / math.sqrt(2 * math.pi) / sigma
    likelihood = []
    for i in range(16):
        off = math.remainder(math.pi / 2 - i * math.pi / 8, 2 * math.pi)
        near = 0.6 * math.exp(-0.5 * (off / sigma) ** 2)
        behind = 0.1 * math.exp(-0.5 * ((abs(off) - math.pi) / sigma) ** 2)
        likelihood.append(peak * (near + behind) + 0.3 / 2 / math.pi)
    check_bayes(b, [*likelihood, 1 / 2 / math.pi])


def test_slow_straight_flight_never_resolves_as_a_drift_explains_it():
    """At 0.15 m/s a drift of 0.21 m/s would make any branch right: the same drift, however many windows."""
    b = bank()
    for i in range(20):
        b.see(moved([0.45, 0.0], [0.45, 0.0], start_s=3 * i, seconds=3.0))
    assert b.best(0) == 0
    assert b.probability[0] < 0.999


def test_the_same_path_at_higher_speed_resolves():
    b = bank()
    for i in range(3):
        b.see(moved([0.45, 0.0], [0.45, 0.0], start_s=0.5 * i))
    assert b.probability[0] > 0.999


def test_drift_is_estimated_and_fast_flight_with_drift_resolves_the_correct_branch():
    b = bank()
    for i in range(6):
        way = quarter_turned(np.array([0.5, 0.0]), i)
        b.see(moved(way, way + np.array([0.1, -0.06]), start_s=0.5 * i))  # 0.23 m/s: two sigmas
    assert b.probability[0] > 0.999


def test_one_false_window_changes_little():
    b = bank()
    for i in range(3):
        b.see(moved([0.6, 0.0], [0.6, 0.0], start_s=i))
    b.see(moved([0.6, 0.0], [-2.0, 1.0], start_s=4))
    assert b.probability[0] > 0.99


@pytest.mark.parametrize("metric", [True, False])
def test_displacements_in_unrelated_directions_favour_none_of_them(metric):
    """Two in a row sometimes agree by chance, three hardly; finally none is right."""
    rng = np.random.default_rng(5)
    wrong = 0
    for _ in range(50):
        b, ever = bank(), False
        for i in range(50):
            odometry, seen = (np.array([math.cos(a), math.sin(a)]) for a in rng.uniform(0, 2 * math.pi, 2))
            b.see(moved(odometry, seen, start_s=i, metric=metric))
            ever |= b.resolved(b.best(0), 0.999)
        wrong += ever
        assert b.probability[NONE] > 0.9
    assert wrong <= 1  # flight of 50


@pytest.mark.parametrize("error_deg", [18, 27, 35, 45, 60])
@pytest.mark.parametrize("bends", [1.0, 0.1])
def test_streets_matched_at_a_wrong_angle_favour_none_of_them(error_deg, bends):
    """Also on a nearly straight path, where a steady drift would explain it."""
    b, turn = bank(), rotation_z(math.radians(error_deg))[:2, :2]
    for i in range(15):
        odometry = rotation_z(bends * i)[:2, 0]
        b.see(moved(odometry, turn @ odometry, start_s=i, seconds=0.7))
        assert not b.resolved(b.best(0), 0.999)
    assert b.probability[NONE] > 0.95


def test_a_late_branch_flip_is_detected():
    """The tracked yaw slips unnoticed: from then on another branch is correct."""
    b = bank()
    for i in range(20):
        b.see(moved([0.7, 0.0], [0.7, 0.0], start_s=i))
        b.pass_time(i * S)
    assert b.best(0) == 0
    for i in range(20, 28):
        b.see(moved([0.7, 0.0], [0.0, 0.7], start_s=i))
        b.pass_time(i * S)
        if b.probability[1] > 0.999:
            break
    assert i < 26
    assert b.best(0) == 1


def test_a_slip_shifts_the_probabilities():
    b = decided(0)
    before = b.probability
    b.slip(np.array([0.7, 0.3, 0.0, 0.0]))
    np.testing.assert_allclose(b.probability[:4], 0.7 * before[:4] + 0.3 * np.roll(before[:4], 1))
    assert b.probability[NONE] == pytest.approx(before[NONE])


def test_leak_and_mix_return_to_the_prior():
    b = decided(2, leak_per_s=0.01)
    before = b.probability
    b.pass_time(5 * S)
    np.testing.assert_array_equal(b.probability, before)  # the first call starts the clock
    b.pass_time(105 * S)
    left = math.exp(-1.0)
    np.testing.assert_allclose(b.probability, left * before + (1 - left) * np.array([0.2375] * 4 + [0.05]))
    b.pass_time(50 * S)  # an earlier time has no effect
    np.testing.assert_allclose(b.probability, left * before + (1 - left) * np.array([0.2375] * 4 + [0.05]))


def test_a_prior_alone_never_resolves_but_less_motion_is_needed():
    b = bank()
    b.expect_yaw(0.1, math.radians(20), 0.95)
    assert b.best(1) == 0
    assert 0.9 < b.probability[0] < 0.999
    b.see(moved([0.6, 0.0], [0.6, 0.0]))
    assert b.probability[0] > 0.998
    assert not b.resolved(0, 0.9)


def test_a_wrong_prior_is_overruled_by_motion():
    b = bank()
    b.expect_yaw(math.pi / 2, math.radians(20), 0.95)
    assert b.best(0) == 3
    for i in range(5):
        b.see(moved([0.6, 0.0], [0.6, 0.0], start_s=i))
    assert b.probability[0] > 0.999


def test_the_published_branch_stays_while_others_are_equally_probable():
    b = bank()
    assert b.best(2) == 2


@pytest.mark.parametrize("wrong", [{"baseline_m": 0}, {"metric_outliers": 1.0}, {"none_right": 0}, {"unknown": 1}])
def test_impossible_settings_are_rejected(wrong):
    with pytest.raises(ValueError):
        BranchSettings(**wrong)
