"""Resets of the autopilot's estimator begin a new segment; ordinary flight does not."""

from __future__ import annotations

import numpy as np
import pytest

from stages.geometry.frames import rotation_z
from stages.odometry.drone.autopilot_estimate import AutopilotEstimate
from tests.stages.odometry.drone.made_imu import R_odom_drone, attitude, imu, local_position, odometry, stamp


def fly(estimate: AutopilotEstimate, from_ms: float, to_ms: float, period_ms: float = 40, **position: float) -> None:
    for at_ms in np.arange(from_ms, to_ms, period_ms):
        sample = imu(at_ms)
        estimate.on_imu(sample.acceleration_drone_mps2, sample.angular_velocity_drone_radps)
        estimate.on_attitude(attitude(at_ms))
        estimate.on_position(local_position(at_ms, **position))


@pytest.mark.parametrize("period_ms", [20, 40, 100, 250, 480])
def test_ordinary_flight_is_one_segment_at_any_rate(period_ms: float):
    estimate = AutopilotEstimate(0.25)
    fly(estimate, 0, 20_000, period_ms)
    assert estimate.segment == 0


@pytest.mark.parametrize("jump", [{"jump_m": 0.5}, {"jump_m": -0.5}, {"jump_mps": 1.0}])
def test_a_jump_of_position_or_velocity_begins_a_segment_once(jump: dict[str, float]):
    estimate = AutopilotEstimate(0.25)
    fly(estimate, 0, 2000)
    fly(estimate, 2000, 4000, **jump)
    assert estimate.segment == 1
    motion = estimate.at(stamp(3980))
    assert motion is not None
    assert motion.odom_segment == 1


def test_a_yaw_reset_begins_a_segment_and_a_fast_turn_does_not():
    estimate = AutopilotEstimate(0.25)
    fly(estimate, 0, 2000)
    assert estimate.segment == 0
    for at_ms in (2000, 2040, 2080):
        estimate.on_attitude(attitude(at_ms, R=rotation_z(0.1) @ R_odom_drone(at_ms)))
    assert estimate.segment == 1


def test_a_gap_of_the_estimate_and_a_changed_reset_counter_begin_a_segment():
    estimate = AutopilotEstimate(0.25)
    fly(estimate, 0, 1000)
    fly(estimate, 1600, 2000)
    assert estimate.segment == 2, "of the attitude and of the position"
    counted = AutopilotEstimate(0.25)
    for at_ms, counter in ((0, 3), (40, 3), (80, 4), (120, 4)):
        counted.on_odometry(odometry(at_ms, counter=counter))
    assert counted.segment == 1


def test_odometry_replaces_the_other_messages_and_a_failed_one_is_not_used():
    estimate = AutopilotEstimate(0.25)
    estimate.on_odometry(odometry(0))
    estimate.on_position(local_position(20, jump_m=50.0))
    estimate.on_attitude(attitude(20, R=np.eye(3)))
    motion = estimate.at(stamp(20))
    assert motion is not None
    assert motion.xyz_odom_m[0] < 30
    failed = AutopilotEstimate(0.25)
    failed.on_odometry(odometry(0, quality=0))
    assert failed.at(stamp(0)) is None


def test_an_old_estimate_is_not_propagated():
    estimate = AutopilotEstimate(0.25)
    fly(estimate, 0, 40)
    assert estimate.at(stamp(250)) is not None
    assert estimate.at(stamp(251)) is None
