"""Drift of a device's clock: estimated within its sigma, although the link delays some round trips."""

from __future__ import annotations

import numpy as np
import pytest

from links.clock.clock_drift import MAX_SIGMA_PPM, MIN_WINDOWS, WINDOW_NS, ClockDrift
from links.clock.device_clock import DeviceClock

S = 1_000_000_000


def round_trips(ppm: float, seconds: float, seed: int, delays_ms=(2.0, 2.0), jitter_ms=3.0, hz=4.0):
    """(ts1, tc1, arrival): one-way delays plus exponential jitter; one reply in ten is delayed by up to 0.3 s."""
    rng = np.random.default_rng(seed)
    for k in range(int(seconds * hz)):
        out, back = (1e6 * (delay + rng.exponential(jitter_ms)) for delay in delays_ms)
        if rng.random() < 0.1:
            back += 1e6 * rng.uniform(0, 300)
        ts1 = 1_700_000_000 * S + round(k * S / hz)
        at = ts1 + out
        yield ts1, round((at - 1_700_000_000 * S) / (1 + 1e-6 * ppm)) + 5 * S, round(at + back)


def drift_of(trips) -> ClockDrift:
    drift = ClockDrift()
    for trip in trips:
        drift.add(*trip)
    return drift


@pytest.mark.parametrize("ppm", [0.0, 40.0, -85.0])
def test_the_drift_is_estimated_within_its_sigma(ppm):
    errors, sigmas = [], []
    for seed in range(12):
        estimate = drift_of(round_trips(ppm, 120.0, seed)).ppm
        assert estimate is not None
        errors.append(estimate[0] - ppm)
        sigmas.append(estimate[1])
    assert max(abs(np.array(errors)) / sigmas) < 3.0
    assert np.median(sigmas) < 10.0
    assert np.median(np.abs(errors)) < 5.0


def test_an_asymmetric_delay_is_no_drift():
    estimate = drift_of(round_trips(20.0, 280.0, 1, delays_ms=(1.0, 25.0))).ppm
    assert estimate is not None
    assert abs(estimate[0] - 20.0) < 3 * estimate[1]


def test_no_estimate_before_enough_windows_nor_on_a_link_with_large_delays():
    early = drift_of(round_trips(40.0, 1e-9 * WINDOW_NS * MIN_WINDOWS - 1, 1))
    assert early.ppm is None
    assert drift_of(round_trips(40.0, 60.0, 1, delays_ms=(300.0, 300.0), jitter_ms=100.0)).ppm is None
    assert drift_of([]).ppm is None


def test_sigma_decreases_with_time():
    sigma = [drift_of(round_trips(40.0, seconds, 3)).ppm[1] for seconds in (60.0, 280.0)]
    assert sigma[1] < 0.3 * sigma[0] < 0.3 * MAX_SIGMA_PPM


def test_foreign_replies_clear_the_estimate():
    clock = DeviceClock()
    trips = list(round_trips(40.0, 60.0, 2))
    for ts1, tc1, arrival in trips:
        assert clock.round_trip(ts1, tc1, arrival) or clock.read(tc1, arrival) is not None
    assert clock.drift.ppm is not None
    clock.forget_replies()
    assert clock.drift.ppm is None


def test_the_same_round_trips_give_the_same_estimate():
    first, second = (drift_of(round_trips(12.0, 100.0, 5)).ppm for _ in range(2))
    assert first == second
