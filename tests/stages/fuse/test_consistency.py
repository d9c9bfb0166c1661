"""Variance inflation of correlated errors, and mutually consistent rejections, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from stages.fuse.consistency import ENOUGH, MOST, InformationInflation, Rejected, inflation
from tests.stages.fuse.imu_flights import S, gauss_markov


def test_a_measurement_within_the_correlation_time_has_little_information():
    assert inflation(None, 1.0) == 1.0
    assert inflation(0.1, 0.0) == 1.0
    assert inflation(0.1, 1.0) == pytest.approx(20.0, rel=0.01)  # 2 tau / dt
    assert inflation(10.0, 1.0) == pytest.approx(1.0, abs=1e-3)
    assert inflation(0.0, 1.0) == MOST


def test_the_mean_of_inflated_measurements_is_consistent():
    """Errors with a time constant of 1 s, sampled every 0.1 s for 20 s: the mean's variance is R factor / n."""
    rng = np.random.default_rng(2)
    means = [gauss_markov(rng, 1.0, 1.0, 0.1, 200, 1).mean() for _ in range(400)]
    assert np.var(means) == pytest.approx(inflation(0.1, 1.0) / 200, rel=0.2)


def test_each_measurement_is_counted_from_the_one_before():
    information = InformationInflation(1.0)
    assert information.factor(0) == 1.0
    assert information.factor(S // 10) == pytest.approx(20.0, rel=0.01)
    assert information.factor(20 * S) == pytest.approx(1.0)
    assert information.factor(20 * S - S // 10) == pytest.approx(20.0, rel=0.01)  # a late one


# rejections


def reject(offs, sigma=0.1):
    rejected = Rejected()
    return [rejected.add(i * S // 10, np.asarray(off, dtype=float), sigma**2 * np.eye(3)) for i, off in enumerate(offs)]


def test_consistent_rejections_reset_the_estimate():
    assert reject([[5.0, 1.0, 0.0]] * ENOUGH) == [False] * (ENOUGH - 1) + [True]
    assert reject([[0.2 * i, 1.0, 0.0] for i in range(ENOUGH)])[-1]  # on a line


def test_scattered_rejections_do_not():
    rng = np.random.default_rng(0)
    assert not any(reject(rng.normal(0, 3.0, (40, 3))))


def test_a_repeated_measurement_counts_once():
    rejected = Rejected()
    assert not any(rejected.add(S, np.ones(3), 0.01 * np.eye(3)) for _ in range(3 * ENOUGH))
    assert not any(rejected.add(i * S // 10, np.ones(3), 0.01 * np.eye(3)) for i in range(11, 9 + ENOUGH))
    assert rejected.add(2 * S, np.ones(3), 0.01 * np.eye(3))


def test_an_accepted_measurement_resets_the_count():
    rejected = Rejected()
    for i in range(ENOUGH - 1):
        rejected.add(i * S // 10, np.ones(3), np.eye(3))
    rejected.clear()
    assert not rejected.add(S, np.ones(3), np.eye(3))
