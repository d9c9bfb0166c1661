"""Frozen odometry is detected by physics; braking, bends, noise and a parked vehicle are not."""

from __future__ import annotations

import numpy as np
import pytest

from stages.odometry.vehicle.impossible_stop import ImpossibleStop, least_path_m

S = 1_000_000_000


def detected_s(path, hz: float = 50.0, seconds: float = 6.0, noise_m: float = 0.0, late_s: float = 0.0, seed: int = 1):
    """(time of detection, last credible time); None: not detected. path(t): (3,) [m]."""
    stop, rng = ImpossibleStop(), np.random.default_rng(seed)
    for t in np.arange(0.0, seconds, 1 / hz):
        xyz_m = path(t - late_s * rng.uniform()) + rng.normal(0.0, noise_m, 3)
        credible_ns = stop.add(round(t * S), xyz_m)
        if credible_ns is not None:
            return t, credible_ns / S
    return None


def straight(speed_mps: float, frozen_s: float = np.inf):
    return lambda t: np.array([speed_mps * min(t, frozen_s), 0.0, 0.0])


def braking(speed_mps: float, from_s: float, mps2: float):
    def path(t: float) -> np.ndarray:
        braked_s = min(max(t - from_s, 0.0), speed_mps / mps2)
        return np.array([speed_mps * (min(t, from_s) + braked_s) - 0.5 * mps2 * braked_s**2, 0.0, 0.0])

    return path


def test_the_least_path_is_that_of_the_hardest_braking():
    assert least_path_m(9.0, 0.5) == pytest.approx(9.0 * 0.5 - 0.5 * 9 * 0.25)
    assert least_path_m(9.0, 1.0) == least_path_m(9.0, 5.0) == pytest.approx(4.5)
    assert least_path_m(0.0, 1.0) == 0.0


@pytest.mark.parametrize("hz", [20, 50, 100])
@pytest.mark.parametrize("speed_mps", [3.0, 5.0, 15.0, 30.0])
@pytest.mark.parametrize("noise_m", [0.0, 0.005])
def test_a_frozen_source_is_detected_within_0_3_s_and_its_last_credible_pose_is_before(
    speed_mps: float, hz: float, noise_m: float
):
    found = detected_s(straight(speed_mps, 5.0), hz, noise_m=noise_m)
    assert found is not None
    assert 5.0 < found[0] <= 5.3
    assert 4.85 <= found[1] <= 5.0 + 1.5 / hz


@pytest.mark.parametrize("hz", [10, 20, 50, 100])
@pytest.mark.parametrize("noise_m", [0.0, 0.02])
@pytest.mark.parametrize("mps2", [3.0, 6.0, 8.5])
@pytest.mark.parametrize("speed_mps", [1.0, 5.0, 15.0])
def test_braking_to_a_stop_is_not_detected(speed_mps: float, mps2: float, noise_m: float, hz: float):
    for seed in range(3):
        assert detected_s(braking(speed_mps, 3.0, mps2), hz, noise_m=noise_m, late_s=0.01, seed=seed) is None


def test_a_parked_vehicle_with_noise_and_a_tight_bend_are_not_detected():
    def bend(t: float) -> np.ndarray:
        return 3.0 * np.array([np.sin(1.7 * t), 1 - np.cos(1.7 * t), 0.0])  # 5 m/s, 8.7 m/s^2

    for seed in range(5):
        assert detected_s(straight(0.0), seconds=30, noise_m=0.03, seed=seed) is None
        assert detected_s(bend, noise_m=0.02, seed=seed) is None


def test_a_slow_vehicle_may_stop_at_once():
    """It is not detectable: it brakes within the tolerance."""
    assert detected_s(straight(1.0, 5.0)) is None


def test_what_is_frozen_stays_frozen_until_it_moves():
    stop = ImpossibleStop()
    for t in np.arange(0.0, 6.0, 0.02):
        at_m = straight(5.0, 5.0)(t)
        if not stop.is_frozen_at(at_m):
            stop.add(round(t * S), at_m)
    assert stop.is_frozen_at(np.array([25.0, 0, 0]))
    assert not stop.is_frozen_at(np.array([25.2, 0, 0]))
    stop.add(7 * S, np.array([40.0, 0, 0]))
    assert not stop.is_frozen_at(np.array([40.0, 0, 0]))
