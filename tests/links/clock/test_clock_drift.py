"""How fast a device's clock runs away: found within its sigma, whatever the line does to some exchanges."""

from __future__ import annotations

import numpy as np
import pytest

from links.clock.clock_drift import FEWEST_WINDOWS, SIGMA_PPM, WINDOW_NS, ClockDrift
from links.clock.device_clock import DeviceClock

S = 1_000_000_000


def exchanges(ppm: float, seconds: float, seed: int, ways_ms=(2.0, 2.0), jitter_ms=3.0, hz=4.0):
    """(ts1, tc1, arrival): ways there and back with exponential waits, one in ten stuck for up to .3 s."""
    rng = np.random.default_rng(seed)
    for k in range(int(seconds * hz)):
        there, back = (1e6 * (way + rng.exponential(jitter_ms)) for way in ways_ms)
        if rng.random() < 0.1:
            back += 1e6 * rng.uniform(0, 300)
        ts1 = 1_700_000_000 * S + round(k * S / hz)
        at = ts1 + there
        yield ts1, round((at - 1_700_000_000 * S) / (1 + 1e-6 * ppm)) + 5 * S, round(at + back)


def drift_of(found) -> ClockDrift:
    drift = ClockDrift()
    for exchange in found:
        drift.add(*exchange)
    return drift


@pytest.mark.parametrize("ppm", [0.0, 40.0, -85.0])
def test_it_is_found_within_what_is_said_of_it(ppm):
    off, sigmas = [], []
    for seed in range(12):
        told = drift_of(exchanges(ppm, 120.0, seed)).ppm
        assert told is not None
        off.append(told[0] - ppm)
        sigmas.append(told[1])
    assert max(abs(np.array(off)) / sigmas) < 3.0
    assert np.median(sigmas) < 10.0
    assert np.median(np.abs(off)) < 5.0


def test_a_way_that_is_always_longer_is_no_drift():
    told = drift_of(exchanges(20.0, 280.0, 1, ways_ms=(1.0, 25.0))).ppm
    assert told is not None
    assert abs(told[0] - 20.0) < 3 * told[1]


def test_it_is_not_told_before_it_is_known_nor_on_a_line_that_is_too_bad():
    early = drift_of(exchanges(40.0, 1e-9 * WINDOW_NS * FEWEST_WINDOWS - 1, 1))
    assert early.ppm is None
    assert drift_of(exchanges(40.0, 60.0, 1, ways_ms=(300.0, 300.0), jitter_ms=100.0)).ppm is None
    assert drift_of([]).ppm is None


def test_a_line_that_gets_better_is_believed_more():
    sigma = [drift_of(exchanges(40.0, seconds, 3)).ppm[1] for seconds in (60.0, 280.0)]
    assert sigma[1] < 0.3 * sigma[0] < 0.3 * SIGMA_PPM


def test_a_clock_that_begins_anew_or_answers_of_another_are_forgotten():
    clock = DeviceClock()
    flown = list(exchanges(40.0, 60.0, 2))
    for ts1, tc1, arrival in flown:
        assert clock.round_trip(ts1, tc1, arrival) or clock.read(tc1, arrival) is not None
    assert clock.drift.ppm is not None
    clock.forget_answers()
    assert clock.drift.ppm is None


def test_two_that_hear_the_same_say_the_same():
    one, other = (drift_of(exchanges(12.0, 100.0, 5)).ppm for _ in range(2))
    assert one == other
