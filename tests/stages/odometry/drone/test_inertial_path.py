"""Path by the IMU alone: the curvature of the true path, whatever yaw and velocity; tilt errors; segments."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.geometry.frames import rotation_z
from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import DroneMotion
from stages.odometry.drone.autopilot_estimate import GRAVITY_MPS2
from stages.odometry.drone.inertial_path import InertialPath
from tests.stages.made import START_NS

STEP_NS = 20_000_000
RADIUS_M, RATE_RADPS = 4.0, 0.7


def circling(t_s):
    """Position, acceleration (3,) and attitude (3, 3) of a drone that circles, banked, with its nose along the path."""
    c, s = math.cos(RATE_RADPS * t_s), math.sin(RATE_RADPS * t_s)
    position_m = RADIUS_M * np.array([c, s, 0.0])
    acceleration_mps2 = -(RATE_RADPS**2) * position_m
    bank = math.atan2(RADIUS_M * RATE_RADPS**2, GRAVITY_MPS2)
    R = rotation_z(RATE_RADPS * t_s + math.pi / 2) @ exp_rotation(np.array([-bank, 0.0, 0.0]))
    return position_m, acceleration_mps2, R


def interval(t_s, segment=0, up=True, tilt_rad=0.0, gyro_bias_radps=0.0):
    _, acceleration_mps2, R = circling(t_s - 0.5e-9 * STEP_NS)
    return DroneMotion(
        stamp_ns=START_NS + round(1e9 * t_s),
        start_ns=START_NS + round(1e9 * t_s) - STEP_NS,
        segment=segment,
        specific_force_drone_mps2=R.T @ (acceleration_mps2 + np.array([0.0, 0.0, GRAVITY_MPS2])),
        angular_velocity_drone_radps=R.T @ np.array([0.0, 0.0, RATE_RADPS]) + gyro_bias_radps,
        specific_force_noise=np.full(3, 0.01),
        angular_velocity_noise=np.full(3, 0.001),
        up_drone=circling(t_s)[2].T @ exp_rotation(np.array([tilt_rad, 0.0, 0.0]))[:, 2] if up else None,
        autopilot=None,
    )


def flown(seconds=4.0, corrected=True, **given):
    """A path with the vertical at its start, and then twice a second."""
    path = InertialPath()
    for k in range(1, round(seconds * 1e9 / STEP_NS) + 1):
        path.add(interval(1e-9 * STEP_NS * k, up=k == 1 or (corrected and k % 25 == 0), **given))
    return path


def curvature_error_m(path, seconds=4.0):
    """Largest error of the path once yaw, mean velocity and position are fitted."""
    t = np.arange(0.1, seconds, 0.1)
    states = [path.path.state(START_NS + round(1e9 * each)) for each in t]
    found, true = np.array([state[0] for state in states]), np.array([circling(each)[0] for each in t])
    A = np.column_stack([np.ones(len(t)), t])
    found, true = (x - A @ np.linalg.lstsq(A, x, rcond=None)[0] for x in (found, true))
    U, _, Vt = np.linalg.svd(true[:, :2].T @ found[:, :2])
    assert np.linalg.det(U @ Vt) > 0  # a rotation: the sense of the turn is right
    found[:, :2] = found[:, :2] @ (U @ Vt).T
    return np.abs(found - true).max()


def test_the_path_has_the_curvature_of_the_flight():
    assert curvature_error_m(flown()) < 0.01


def test_a_wrong_vertical_adds_a_nearly_constant_acceleration():
    tilt_rad = math.radians(2.0)
    bent_m = tilt_rad * GRAVITY_MPS2 * 4.0**2 / 8.0  # the sagitta of a parabola of that acceleration
    assert 0.3 * bent_m < curvature_error_m(flown(tilt_rad=tilt_rad)) < 1.5 * bent_m


def test_the_vertical_of_the_autopilot_corrects_a_biased_gyro():
    path, free = (flown(20.0, corrected, gyro_bias_radps=0.02) for corrected in (True, False))

    def level_error_rad(one):
        return float(np.arccos((circling(20.0)[2] @ one._R_level_drone.T)[2, 2]))

    assert level_error_rad(path) < 0.6 * level_error_rad(free), (level_error_rad(path), level_error_rad(free))


def test_without_a_vertical_and_in_a_new_segment_there_is_no_path():
    path = InertialPath()
    path.add(interval(0.02, up=False))
    path.add(interval(0.04, up=False))
    assert path.path.span_ns is None
    path.add(interval(0.06))
    path.add(interval(0.08))
    assert path.path.span_ns == (START_NS + 80_000_000, START_NS + 80_000_000)
    path.add(interval(0.5, segment=1))
    assert path.path.span_ns is None
    path.add(interval(0.52, segment=1))
    assert path.path.span_ns == (START_NS + 520_000_000, START_NS + 520_000_000)


@pytest.mark.parametrize("up_drone", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)])
def test_any_attitude_is_a_start(up_drone):
    path, first = InertialPath(), interval(0.02)
    object.__setattr__(first, "up_drone", np.array(up_drone))
    path.add(first)
    assert path._R_level_drone is not None
    np.testing.assert_allclose(path._R_level_drone @ up_drone, (0.0, 0.0, 1.0), atol=1e-12)
