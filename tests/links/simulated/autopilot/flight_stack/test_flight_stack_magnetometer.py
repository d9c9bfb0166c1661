"""The simulated magnetometer: the Earth's field in drone axes, and errors as those of a compass on a multicopter."""

from __future__ import annotations

import math

import numpy as np
import pytest

from links.simulated.autopilot.flight_stack.magnetometer import FIELD_UT, Magnetometer
from links.simulated.autopilot.flight_stack.settings import CompassSettings
from stages.geometry.frames import rotation_z
from stages.kernels.geometry.so3 import exp_rotation

EXACT = {"hard_iron_ut": 0.0, "motor_ut": 0.0, "slow_ut": 0.0, "white_ut": 0.0}


def heading_error_deg(magnetometer: Magnetometer, time_s: float, R: np.ndarray, thrust_g: float = 1.0) -> float:
    magnetometer.sample(time_s, R, thrust_g)
    off = magnetometer.heading_rad(R) - math.atan2(R[1, 0], R[0, 0])
    return math.degrees(math.remainder(off, math.tau))


@pytest.mark.parametrize("yaw_deg", [-170.0, 0.0, 60.0])
def test_without_errors_the_field_is_the_earths_and_the_heading_is_right_when_tilted(yaw_deg: float):
    R = rotation_z(math.radians(yaw_deg)) @ exp_rotation(np.array([0.2, -0.3, 0.0]))
    magnetometer = Magnetometer(CompassSettings(**EXACT), 1)
    assert heading_error_deg(magnetometer, 0.0, R) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(R @ magnetometer.field_ut, FIELD_UT, atol=1e-12)


def test_the_offset_is_that_of_the_heading():
    magnetometer = Magnetometer(CompassSettings(offset_deg=30.0, **EXACT), 1)
    assert heading_error_deg(magnetometer, 0.0, rotation_z(1.0)) == pytest.approx(30.0)


def test_the_errors_are_those_of_a_compass_on_a_multicopter():
    """Over many compasses: some 7 deg, which depends on the heading and changes with thrust; calm in hovering."""
    constant, turned, thrust, calm = [], [], [], []
    for seed in range(60):
        magnetometer = Magnetometer(CompassSettings(), seed)
        level = [np.mean([heading_error_deg(magnetometer, t / 50, np.eye(3)) for t in range(100)])]
        level.append(np.mean([heading_error_deg(magnetometer, 2 + t / 50, np.eye(3)) for t in range(100)]))
        east = np.mean([heading_error_deg(magnetometer, 4 + t / 50, rotation_z(-math.pi / 2)) for t in range(100)])
        off = np.mean([heading_error_deg(magnetometer, 6 + t / 50, np.eye(3), 0.0) for t in range(100)])
        constant.append(level[0])
        turned.append(east - level[1])
        thrust.append(off - level[1])
        calm.append(level[1] - level[0])
    assert 4.0 < np.std(constant) < 10.0
    assert 5.0 < np.std(turned) < 14.0
    assert 2.5 < np.std(thrust) < 8.0
    assert np.std(calm) < 0.8


def test_the_reported_field_is_the_mean_since_the_last_reading():
    """The drone turns by 1 rad/s: the mean of 0.1 s is 50 ms old when it is read, and stays until the next."""
    magnetometer, reported = Magnetometer(CompassSettings(**EXACT), 1), list[float]()
    for tick in range(400):
        magnetometer.sample(tick / 400, rotation_z(tick / 400), 1.0)
        reported.append(-math.atan2(magnetometer.field_ut[1], magnetometer.field_ut[0]))
    assert len(set(reported)) == 10
    behind = np.arange(400) / 400 - reported
    assert 0.03 < behind[200:].min() < 0.06
    assert 0.13 < behind[200:].max() < 0.16
