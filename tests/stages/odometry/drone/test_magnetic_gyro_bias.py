"""The gyroscope's bias about the vertical by the magnetic field: right, blind to a constant error, and as certain as it says."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.geometry.frames import rotation_z
from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import GyroBias
from stages.odometry.drone.magnetic_gyro_bias import LEAST_WALK, MagneticGyroBias

HZ = 50.0
FIELD = np.array([24.0, 0.0, -41.6])
UP = np.array([0.0, 0.0, 1.0])


def measured(
    bias: np.ndarray,
    seconds: float = 20.0,
    *,
    compass_error_rad=lambda t: 0.0,
    turn_rate=lambda t: 0.0,
    tilt_rad: float = 0.1,
    field_hz: float = HZ,
    white_ut: float = 0.0,
) -> list[GyroBias]:
    """Measurements of a drone that wobbles by `tilt_rad` about its place, with a biased gyroscope."""
    stage, rng, found = MagneticGyroBias(), np.random.default_rng(3), []
    yaw, R_before = 0.7, None
    for k in range(round(seconds * HZ)):
        t = k / HZ
        yaw += turn_rate(t) / HZ
        wobble = tilt_rad * np.array([math.sin(2.0 * t), math.cos(1.3 * t), 0.0])
        R = rotation_z(yaw) @ exp_rotation(wobble)
        field = R.T @ rotation_z(-compass_error_rad(t)) @ FIELD + white_ut * rng.standard_normal(3)
        if R_before is not None:
            rate = log_of(R_before.T @ R) * HZ + bias
            has_field = k % round(HZ / field_hz) == 0
            one = stage.add(1.0 / HZ, rate, field if has_field else None, R[2].copy())
            found += [one] if one is not None else []
        R_before = R
    return found


def log_of(R: np.ndarray) -> np.ndarray:
    """Rotation vector of a small rotation."""
    return 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])


@pytest.mark.parametrize("compass_error_deg", [0.0, 30.0, 180.0])
def test_the_bias_is_right_however_wrong_the_compass_is(compass_error_deg: float):
    bias = np.array([0.004, -0.003, 0.005])
    found = measured(bias, compass_error_rad=lambda t: math.radians(compass_error_deg))
    assert len(found) == 9
    for one in found:
        assert one.bias_radps == pytest.approx(one.up_drone @ bias, abs=3e-4)


def test_a_calm_compass_becomes_certain_and_never_more_than_its_least_walk():
    found = measured(np.zeros(3), 120.0)
    assert found[0].sigma_radps > 3 * found[-1].sigma_radps
    assert found[-1].sigma_radps >= LEAST_WALK * math.sqrt(6 / 5 / 2.1)


def test_a_walking_compass_is_as_wrong_as_it_says():
    rng, walk = np.random.default_rng(4), math.radians(1.0)
    errors = np.cumsum(walk / math.sqrt(HZ) * rng.standard_normal(round(400 * HZ)))
    found = measured(np.zeros(3), 400.0, compass_error_rad=lambda t: errors[round(t * HZ)], white_ut=0.4)
    late = found[10:]
    nees = np.mean([(one.bias_radps / one.sigma_radps) ** 2 for one in late])
    assert 0.4 < nees < 1.3  # the larger of two estimates


def test_a_compass_that_drifts_for_seconds_is_not_taken_for_a_bias():
    """+-3 deg within 32 s: slopes of neighbouring windows agree, those of long windows do not."""
    error = lambda t: math.radians(3.0) * math.sin(2 * math.pi * t / 32.0)  # noqa: E731
    late = measured(np.zeros(3), 300.0, compass_error_rad=error)[40:]
    off = np.array([one.bias_radps for one in late])
    weight = np.array([one.sigma_radps**-2 for one in late])
    assert math.radians(0.4) < np.abs(off).max() < 2.5 * late[-1].sigma_radps
    assert abs(off @ weight / weight.sum()) < 2.0 / math.sqrt(weight.sum())


def test_in_a_slow_turn_an_error_that_depends_on_the_heading_is_in_the_sigma():
    """10 deg of compass error per radian turned, as in the log of a flight; each window turns by 5.7 deg."""
    found = measured(
        np.zeros(3), 60.0, turn_rate=lambda t: 0.05, compass_error_rad=lambda t: math.radians(10.0) * 0.05 * t
    )
    assert len(found) == 29
    for one in found:
        assert abs(one.bias_radps) > 0.008
        assert abs(one.bias_radps) < 1.1 * one.sigma_radps


def test_a_turn_is_not_used():
    """The error of a compass depends on its heading: 10 deg for each radian."""
    turning = lambda t: 0.5 if 8.0 <= t < 12.0 else 0.0  # noqa: E731
    found = measured(np.zeros(3), 20.0, turn_rate=turning)
    assert len(found) in (6, 7)
    assert all(abs(one.bias_radps) < 3e-4 for one in found)


def test_without_a_field_or_with_few_samples_of_it_nothing_is_measured():
    assert not measured(np.zeros(3), field_hz=1.0)
    stage = MagneticGyroBias()
    assert not any(stage.add(0.02, np.zeros(3), None, UP) for _ in range(500))
    assert not any(stage.add(0.02, np.zeros(3), FIELD, None) for _ in range(500))
    assert not any(
        stage.add(0.02, np.zeros(3), np.array([0.0, 0.0, 40.0]), UP) for _ in range(500)
    )  # no horizontal field


def test_at_a_low_rate_of_the_field_the_bias_is_the_same():
    bias = np.array([0.0, 0.0, 0.005])
    found = measured(bias, field_hz=5.0)
    assert len(found) >= 7
    assert np.mean([one.bias_radps for one in found]) == pytest.approx(0.005, abs=2e-4)
