"""The gyroscope's bias about the vertical by the magnetic field: right, blind to a constant error, and as certain as it says."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.geometry.frames import rotation_z
from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import GyroBias
from stages.odometry.drone.magnetic_gyro_bias import FIRST_SLOPE, LEAST_WALK, WINDOW_S, MagneticGyroBias

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
    assert len(found) == 2
    for one in found:
        assert one.bias_radps == pytest.approx(one.up_drone @ bias, abs=3e-4)


def test_a_calm_compass_becomes_certain_and_never_more_than_its_least_walk():
    found = measured(np.zeros(3), 120.0)
    assert found[0].sigma_radps >= FIRST_SLOPE
    assert found[-1].sigma_radps < 0.6 * found[0].sigma_radps
    assert found[-1].sigma_radps >= LEAST_WALK * math.sqrt(6 / 5 / (WINDOW_S + 1 / HZ))


def test_a_walking_compass_is_as_wrong_as_it_says_from_the_first_window_on():
    walk, first, all_of_it = math.radians(2.0), list[float](), list[float]()
    for seed in range(12):
        steps = np.random.default_rng(seed).standard_normal(round(100 * HZ))
        errors = np.cumsum(walk / math.sqrt(HZ) * steps)
        found = measured(np.zeros(3), 100.0, compass_error_rad=lambda t, e=errors: e[round(t * HZ)], white_ut=0.4)
        all_of_it += [(one.bias_radps / one.sigma_radps) ** 2 for one in found]
        first.append(weighted_error(found[:4]) ** 2)
    assert 0.3 < np.mean(all_of_it) < 1.2  # the larger of several estimates
    assert np.mean(first) < 2.0
    assert max(first) < 9.0


@pytest.mark.parametrize("phase_s", [0.0, 4.0, 8.0, 14.0, 20.0, 28.0])
def test_a_compass_that_drifts_for_seconds_is_not_taken_for_a_bias(phase_s: float):
    """+-3 deg within 32 s: nearly a straight line in each window, 0.55 deg/s in the steepest."""
    error = lambda t: math.radians(3.0) * math.sin(2 * math.pi * (t + phase_s) / 32.0)  # noqa: E731
    found = measured(np.zeros(3), 200.0, compass_error_rad=error)
    assert max(abs(one.bias_radps) for one in found) > math.radians(0.37)
    for n in range(1, len(found) + 1):
        assert abs(weighted_error(found[:n])) < 2.9


def test_a_drift_after_calm_windows_is_in_the_sigma():
    """0.15 deg/s for 24 s."""
    error = lambda t: math.radians(0.15) * min(max(t - 40.0, 0.0), 24.0)  # noqa: E731
    found = measured(np.zeros(3), 72.0, compass_error_rad=error)
    assert max(abs(one.bias_radps) for one in found) == pytest.approx(math.radians(0.15), rel=0.1)
    for n in range(1, len(found) + 1):
        assert abs(weighted_error(found[:n])) < 2.0


@pytest.mark.parametrize("turn_rate", [0.01, 0.02])
def test_in_a_slow_turn_an_error_that_depends_on_the_heading_is_in_the_sigma(turn_rate: float):
    """10 deg of compass error per radian turned, as in the log of a flight."""
    error = lambda t: math.radians(10.0) * turn_rate * t  # noqa: E731
    found = measured(np.zeros(3), 66.0, turn_rate=lambda t: turn_rate, compass_error_rad=error)
    assert len(found) == 8
    assert all(abs(one.bias_radps) > 0.0015 for one in found)
    assert abs(weighted_error(found)) < 1.5


def weighted_error(found: list[GyroBias]) -> float:
    """Mean of measurements of a bias of zero, as independent ones, over its sigma."""
    weight = np.array([one.sigma_radps**-2 for one in found])
    return float(weight @ np.array([one.bias_radps for one in found]) / math.sqrt(weight.sum()))


def test_a_turn_is_not_used():
    """The error of a compass depends on its heading: 10 deg for each radian."""
    turning = lambda t: 0.5 if 12.0 <= t < 14.0 else 0.0  # noqa: E731
    error = lambda t: math.radians(10.0) * 0.5 * min(max(t - 12.0, 0.0), 2.0)  # noqa: E731
    found = measured(np.zeros(3), 36.0, turn_rate=turning, compass_error_rad=error)
    assert len(found) == 3
    assert all(abs(one.bias_radps) < 3e-4 for one in found)


def test_without_a_field_or_with_few_samples_of_it_nothing_is_measured():
    assert not measured(np.zeros(3), field_hz=0.5)
    stage = MagneticGyroBias()
    assert not any(stage.add(0.02, np.zeros(3), None, UP) for _ in range(500))
    assert not any(stage.add(0.02, np.zeros(3), FIELD, None) for _ in range(500))
    assert not any(
        stage.add(0.02, np.zeros(3), np.array([0.0, 0.0, 40.0 + 0.01 * k]), UP) for k in range(500)
    )  # no horizontal field


def test_a_turn_without_field_counts():
    """46 deg in a window, field at 2 Hz; and a turn while the vertical is not known."""
    error = lambda t: math.radians(10.0) * 0.1 * t  # noqa: E731
    assert not measured(np.zeros(3), 30.0, turn_rate=lambda t: 0.1, compass_error_rad=error, field_hz=2.0)
    stage, yaw = MagneticGyroBias(), 0.0
    for k in range(round(7.9 * HZ)):
        turns = 2.0 <= k / HZ < 2.8
        yaw += 0.7 / HZ if turns else 0.0
        field = rotation_z(yaw).T @ FIELD + 0.01 * math.sin(k)
        assert stage.add(1 / HZ, np.array([0, 0, 0.7 if turns else 0.0]), field, None if turns else UP) is None
    assert stage.add(0.2, np.zeros(3), FIELD, UP) is None


def test_a_magnetometer_that_has_stopped_measures_nothing():
    """Else the drone's own turn would be the bias."""
    stage = MagneticGyroBias()
    assert not any(stage.add(0.02, np.array([0.0, 0.0, 0.01]), FIELD.copy(), UP) for _ in range(2000))


@pytest.mark.parametrize("bad", [np.full(3, np.nan), np.zeros(3), np.array([1.0, 0.0, 50.0])])
def test_a_bad_sample_of_the_field_is_left_out(bad: np.ndarray):
    stage, found = MagneticGyroBias(), list[GyroBias]()
    for k in range(round(20 * HZ)):
        one = stage.add(1 / HZ, np.zeros(3), bad if k % 7 == 3 else FIELD + 0.01 * math.sin(k), UP)
        found += [] if one is None else [one]
    assert len(found) == 2
    assert all(abs(one.bias_radps) < 1e-4 for one in found)


def test_at_a_low_rate_of_the_field_the_bias_is_the_same():
    bias = np.array([0.0, 0.0, 0.005])
    found = measured(bias, field_hz=2.0)
    assert len(found) == 2
    assert np.mean([one.bias_radps for one in found]) == pytest.approx(0.005, abs=2e-4)
