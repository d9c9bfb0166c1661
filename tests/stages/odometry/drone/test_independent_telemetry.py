"""Telemetry that may contain poses of grd: only roll and pitch pass."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from flow.message import check_arrays
from stages.geometry.frames import rotation_z
from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import (
    DroneAttitude,
    DroneGlobalPosition,
    DroneImu,
    DroneLocalPosition,
    DroneOdometry,
    DroneTilt,
    EarlierOdomFrame,
    HeadingPrior,
)
from stages.odometry.drone import IndependentTelemetry

MS = 1_000_000
RATE = np.array([0.1, 0.2, 0.3])
GYRO = np.array([0.4, 0.5, 0.6])


def attitude(independent: bool, yaw_rad: float = 0.0) -> DroneAttitude:
    R = rotation_z(yaw_rad) @ exp_rotation(np.array([0.2, -0.1, 0.0]))
    return DroneAttitude(stamp_ns=500 * MS, R_odom_drone=R, angular_velocity_drone_radps=RATE, independent=independent)


def position(independent: bool) -> DroneLocalPosition:
    return DroneLocalPosition(stamp_ns=5, xyz_odom_m=np.ones(3), velocity_odom_mps=np.zeros(3), independent=independent)


def odometry(independent: bool) -> DroneOdometry:
    return DroneOdometry(
        stamp_ns=5,
        xyz_odom_m=np.ones(3),
        R_odom_drone=np.eye(3),
        velocity_drone_mps=np.zeros(3),
        angular_velocity_drone_radps=np.zeros(3),
        pose_covariance=None,
        velocity_covariance=None,
        reset_counter=0,
        quality_percent=None,
        independent=independent,
    )


def imu(stamp_ns: int) -> DroneImu:
    return DroneImu(stamp_ns=stamp_ns, acceleration_drone_mps2=np.array([0, 0, 9.8]), angular_velocity_drone_radps=GYRO)


def global_position(independent: bool) -> DroneGlobalPosition:
    return DroneGlobalPosition(
        stamp_ns=5,
        latitude_rad=0.6,
        longitude_rad=2.4,
        altitude_m=9.0,
        altitude_above_home_m=5.0,
        independent=independent,
    )


def test_a_geographic_position_passes_only_while_it_is_independent():
    stage = IndependentTelemetry()
    assert stage.on_global_position(own := global_position(True)) is own
    assert stage.on_global_position(global_position(False)) is None
    assert stage.counters == {"not independent": 1}


def test_an_independent_estimate_passes_unchanged():
    stage = IndependentTelemetry()
    assert stage.on_position(own := position(True)) is own
    assert stage.on_odometry(own := odometry(True)) is own
    given = attitude(True)
    tilt, passed = stage.on_attitude(given)
    assert passed is given
    assert isinstance(tilt, DroneTilt)
    np.testing.assert_array_equal(tilt.angular_velocity_drone_radps, RATE)
    assert math.degrees(tilt.sigma_rad) == 1.0
    assert stage.counters == {}


def test_of_any_other_estimate_only_roll_and_pitch_pass():
    stage = IndependentTelemetry()
    assert stage.on_position(position(False)) is None
    assert stage.on_odometry(odometry(False)) is None
    (tilt,) = stage.on_attitude(attitude(False))
    assert isinstance(tilt, DroneTilt)
    check_arrays(tilt)
    np.testing.assert_allclose(tilt.up_drone, attitude(False).R_odom_drone.T @ [0, 0, 1])
    assert math.degrees(tilt.sigma_rad) == 2.0
    assert tilt.angular_velocity_drone_radps is None
    assert stage.counters == {"not independent": 3}


def test_the_tilt_does_not_depend_on_yaw():
    ups = [next(iter(IndependentTelemetry().on_attitude(attitude(False, yaw)))).up_drone for yaw in (0.0, 1.0, 3.0)]
    np.testing.assert_allclose(ups, [ups[0]] * 3, atol=1e-12)


def test_a_recent_gyro_sample_replaces_the_rate_of_an_estimate_that_is_not_independent():
    stage = IndependentTelemetry()
    stage.on_imu(imu(450 * MS))
    (tilt,) = stage.on_attitude(attitude(False))
    np.testing.assert_array_equal(tilt.angular_velocity_drone_radps, GYRO)
    stage.on_imu(imu(300 * MS))
    (tilt,) = stage.on_attitude(attitude(False))
    assert tilt.angular_velocity_drone_radps is None


EARLIER = EarlierOdomFrame(
    stamp_ns=-1_500 * MS, yaw_map_odom_rad=0.5, sigma_rad=math.radians(2.0), xyz_map_m=np.array([1.0, 2.0, 3.0])
)


def prior(stage: IndependentTelemetry, given: DroneAttitude) -> HeadingPrior | None:
    found = [message for message in stage.on_attitude(given) if isinstance(message, HeadingPrior)]
    return found[0] if found else None


def own_position(stamp_ns: int) -> DroneLocalPosition:
    return DroneLocalPosition(
        stamp_ns=stamp_ns,
        xyz_odom_m=np.array([4.0, 0.0, 10.0]),
        velocity_odom_mps=np.array([0.0, 1.0, 0.0]),
        independent=False,
    )


def test_after_a_restart_the_frame_of_the_earlier_run_gives_yaw_and_position():
    stage = IndependentTelemetry()
    stage.on_earlier(EARLIER)
    assert stage.on_position(own_position(400 * MS)) is None
    made = prior(stage, attitude(False, yaw_rad=0.3))
    assert made is not None
    assert made.yaw_map_rad == pytest.approx(0.8, abs=0.01)  # by a tilted drone
    assert made.yaw_map_odom_rad == 0.5
    c, s = math.cos(0.5), math.sin(0.5)
    np.testing.assert_allclose(made.xyz_map_m, [1 + 4 * c - 0.1 * s, 2 + 4 * s + 0.1 * c, 13.0])
    assert made.sigma_rad > EARLIER.sigma_rad
    np.testing.assert_allclose(made.velocity_map_mps, [-s, c, 0.0])
    assert made.position_sigma_m == pytest.approx(math.hypot(0.5, 0.12, 0.22), abs=0.01)  # 2 s at 1 m/s
    assert made.velocity_sigma_mps == pytest.approx(math.hypot(0.06, 0.22), abs=0.01)


def test_the_position_of_a_fast_drone_drifts_faster():
    def sigma_m(speed_mps: float) -> float:
        stage = IndependentTelemetry()
        stage.on_earlier(EARLIER)
        velocity = np.array([0.6 * speed_mps, 0.8 * speed_mps, 0.0])
        stage.on_position(dataclasses.replace(own_position(400 * MS), velocity_odom_mps=velocity))
        made = prior(stage, attitude(False))
        assert made is not None
        return made.position_sigma_m

    assert sigma_m(0.0) == pytest.approx(math.hypot(0.5, 0.22), abs=0.01)
    assert sigma_m(5.0) == pytest.approx(math.hypot(0.5, 0.6, 0.22), abs=0.01)


def test_there_is_no_prior_without_an_earlier_run_or_a_recent_position():
    stage = IndependentTelemetry()
    stage.on_position(own_position(400 * MS))
    assert prior(stage, attitude(False)) is None
    stage.on_earlier(EARLIER)
    stage.on_position(own_position(200 * MS))
    assert prior(stage, attitude(False)) is None


def test_a_prior_ends_with_its_age():
    stage = IndependentTelemetry()
    stage.on_earlier(dataclasses.replace(EARLIER, stamp_ns=-29_600 * MS))
    stage.on_position(own_position(400 * MS))
    assert prior(stage, attitude(False)) is None


def test_after_a_reboot_of_the_autopilot_there_is_no_prior():
    """Its estimate is independent then; a later pose of this run makes it dependent, but not of the earlier frame."""
    stage = IndependentTelemetry()
    stage.on_earlier(EARLIER)
    stage.on_position(own_position(400 * MS))
    assert prior(stage, attitude(True)) is None
    assert prior(stage, attitude(False)) is None
