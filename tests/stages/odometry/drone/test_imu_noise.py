"""Noise density of IMU samples: that of the simulated vibration, also in manoeuvres; one gust is not vibration."""

from __future__ import annotations

import math

import numpy as np
import pytest

from links.simulated.autopilot.flight_stack.quadrotor import butterworth
from links.simulated.world.flight import Flight, FlightSettings
from links.simulated.world.path import Path, Waypoint
from stages.odometry.drone.imu_noise import NoiseDensity, residual_variance

SECONDS = 16.0
SQUARE = Path(
    waypoints=tuple(
        Waypoint(t_s=4.0 * i, xyz_m=(x, y, 15.0), yaw_deg=90.0 * i)
        for i, (x, y) in enumerate([(0, 0), (8, 0), (8, 8), (0, 8), (0, 0)])
    )
)


def estimated(
    force: np.ndarray, rate: np.ndarray, hz: float, after_s: float = 4.0, window_s: float = 0.4
) -> np.ndarray:
    """Estimates (n, 2) after `after_s`, as white noise of a sample."""
    noise, found = NoiseDensity(0.05, window_s, 2.0), []
    for i, (f, w) in enumerate(zip(force, rate, strict=True)):
        noise.add(round(1e9 * i / hz), f, w)
        if i > after_s * hz:
            found.append(np.sqrt(np.mean(noise.density**2, axis=1) * hz))
    return np.array(found)


@pytest.mark.parametrize("hz", [100, 50, 25, 10])
@pytest.mark.parametrize("vibration_mps2", [0.1, 0.3, 1.0, 2.0])
def test_the_estimate_is_the_simulated_vibration_while_the_drone_flies_corners(hz: float, vibration_mps2: float):
    time_s = np.arange(0.0, SECONDS, 1 / hz)
    rate, force = Flight(SQUARE, FlightSettings(), SECONDS, 1).imu(time_s)
    rng = np.random.default_rng(3)
    force = force + rng.normal(0.0, vibration_mps2, force.shape)
    rate = rate + rng.normal(0.0, 0.05 * vibration_mps2, rate.shape)
    found = estimated(force, rate, hz) / vibration_mps2
    np.testing.assert_allclose(np.median(found[:, 0]), 1.0, atol=0.06 + 0.008 / vibration_mps2)  # manoeuvres add to it
    assert found[:, 0].min() > 0.7
    assert found[:, 0].max() < 1.3
    assert 0.9 * 0.05 < np.median(found[:, 1]) < 1.3 * 0.05 + 0.0015 / vibration_mps2


def test_the_estimate_follows_a_change_of_vibration_within_two_time_constants():
    rng = np.random.default_rng(4)
    sigma = np.where(np.arange(1000) < 500, 0.1, 1.0)[:, None]
    found = estimated(sigma * rng.standard_normal((1000, 3)), np.zeros((1000, 3)), 50.0, after_s=1.0)[:, 0]
    at_change = len(found) - 500
    assert found[at_change - 2] < 0.12
    assert found[at_change + 200] > 0.8


def test_one_hard_knock_does_not_become_vibration():
    rng = np.random.default_rng(5)
    force = 0.1 * rng.standard_normal((500, 3))
    force[300] += 30.0
    assert estimated(force, np.zeros((500, 3)), 50.0)[:, 0].max() < 0.3


def test_smooth_motion_alone_is_no_noise():
    time_s = np.arange(0.0, 10.0, 0.02)
    force = np.column_stack((3 * np.sin(np.pi * time_s), time_s**2, np.full(len(time_s), 9.81)))
    assert estimated(force, 0.1 * force, 50.0)[:, 0].max() < 0.02


def test_the_density_is_that_of_low_frequencies_when_an_autopilot_filters_its_samples():
    """White noise of 1 m/s^2 at 400 Hz through a low-pass of 20 Hz: 0.05 m/s^2/sqrt(Hz) pass, single samples state less."""
    rng = np.random.default_rng(7)
    b0, b1, b2, a1, a2 = butterworth(20.0, 400.0)
    white, passed = rng.standard_normal((20_000, 3)), np.zeros((20_000, 3))
    for i in range(2, len(white)):
        passed[i] = b0 * white[i] + b1 * white[i - 1] + b2 * white[i - 2] - a1 * passed[i - 1] - a2 * passed[i - 2]
    found = estimated(passed[::8], np.zeros((2500, 3)), 50.0)[:, 0] / math.sqrt(50.0)
    assert 0.9 * 0.05 < np.median(found) < 1.1 * 0.05


def test_a_tone_that_averages_out_is_no_noise():
    """Rotors at 83 Hz, sampled at 50 Hz: 17 Hz."""
    time_s = np.arange(0.0, 10.0, 0.02)
    force = np.sin(2 * np.pi * 83.0 * time_s)[:, None] + np.zeros(3)
    assert np.median(estimated(force, np.zeros((500, 3)), 50.0)[:, 0]) < 0.3  # an RMS of 0.7


def test_nothing_is_known_before_a_complete_window_and_a_gap_keeps_what_is_known():
    noise, rng = NoiseDensity(0.05, 0.4, 2.0), np.random.default_rng(6)
    for i in range(21):  # a sample to begin with, then blocks of three
        noise.add(i * 20_000_000, rng.standard_normal(3), rng.standard_normal(3))
        assert noise.density is None
    for i in range(21, 60):
        noise.add(i * 20_000_000, rng.standard_normal(3), rng.standard_normal(3))
    before = noise.density
    noise.new_segment()
    noise.add(90_000_000_000, np.full(3, 50.0), np.zeros(3))
    np.testing.assert_array_equal(noise.density, before)


def test_a_parabola_with_unequal_intervals_has_no_residual():
    stamp_ns = np.array([0, 20, 39, 61, 80, 99, 122]) * 1_000_000
    t = stamp_ns * 1e-9
    values = np.column_stack((1 + 2 * t + 3 * t**2, t))
    np.testing.assert_allclose(residual_variance(stamp_ns, values), 0.0, atol=1e-25)
