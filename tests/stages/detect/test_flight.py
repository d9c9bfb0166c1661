"""Whether a candidate has moved, or the observations lie along a static object."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.detect.flight import moves, straight_flight

TENTH_NS = 100_000_000
PLACE_M = np.array([-16.0, -22.9, 8.3])


def moved(displacement_m: float, range_m: float, count: int = 14) -> bool:
    """Observations at 10 Hz, without a pause, along y."""
    path_ns = [k * TENTH_NS for k in range(count)]
    path_m = [PLACE_M - np.array([0.0, displacement_m * k / (count - 1), 0.0]) for k in range(count)]
    return moves(path_ns, path_m, range_m, True)


@pytest.mark.parametrize(("displacement_m", "range_m"), [(1.0, 29.5), (1.4, 40.0), (0.2, 10.0)])
def test_observations_along_a_lamps_arm_are_no_motion(displacement_m, range_m):
    """A lamp at 29.5 m with an arm of 1 m appears to fly at 0.9 m/s."""
    assert not moved(displacement_m, range_m)


@pytest.mark.parametrize(("displacement_m", "range_m"), [(2.0, 29.5), (2.0, 40.0), (0.8, 10.0), (1.2, 19.0)])
def test_a_larger_displacement_is_motion(displacement_m, range_m):
    assert moved(displacement_m, range_m)


def flown(velocity_mps, count=14, noise_m=0.0):
    """Observations at 10 Hz: times and positions."""
    t = 0.1 * np.arange(count)
    noise = np.random.default_rng(0).normal(0, noise_m, (count, 3))
    return [k * TENTH_NS for k in range(count)], list(PLACE_M + np.outer(t, velocity_mps) + noise)


def test_a_line_has_its_velocity():
    speed, sigmas = straight_flight(*flown((3.0, -4.0, 1.2)), 20.0)
    assert speed == pytest.approx(math.sqrt(9 + 16 + 1.44))
    assert sigmas > 20


def test_the_significance_falls_with_the_scatter_of_the_path():
    clean, noisy = (straight_flight(*flown((1.0, 0.0, 0.0), noise_m=noise), 20.0)[1] for noise in (0.0, 2.0))
    assert noisy < 0.5 * clean


def test_two_observations_are_no_line():
    assert all(math.isnan(value) for value in straight_flight(*flown((1.0, 0.0, 0.0), count=2), 20.0))
