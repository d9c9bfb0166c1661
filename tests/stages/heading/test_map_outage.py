"""The drone's state over an outage of the vehicle's motion."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.heading.heading_memory import SAME_NS
from stages.heading.inertial_state import SIZE, InertialState
from stages.heading.map_outage import KnownState, MapOutage
from stages.heading.odometry_heading import OdomYaw
from stages.messages import DroneMotion

S = 1_000_000_000
STEP_NS = S // 50
LIFT_MPS2 = np.array([0.0, 0.0, 9.80665])


def state(x_m=0.0):
    velocity = np.array([[1.0, 0.0, 0.0]])
    covariance = 1e-4 * np.eye(SIZE)[None]
    return InertialState(np.eye(3)[None], np.array([[x_m, 2.0, 10.0]]), velocity, np.zeros((1, 6)), covariance)


def motion(k):
    return DroneMotion(
        stamp_ns=(k + 1) * STEP_NS,
        start_ns=k * STEP_NS,
        segment=0,
        specific_force_drone_mps2=LIFT_MPS2,
        angular_velocity_drone_radps=np.array([0.0, 0.0, 0.1]),
        specific_force_noise=np.full(3, 0.05),
        angular_velocity_noise=np.full(3, 0.002),
        up_drone=None,
        autopilot=None,
    )


def outage(axes=None, known_until_s=1.05, motions=500, yaw_bias_rad2=0.0):
    """States at each 0.1 s until 1.5 s; an IMU that turns."""
    it = MapOutage()
    for k in range(motions):
        it.add_motion(motion(k))
    for k in range(16):
        it.add_state(KnownState(k * S // 10, state(0.1 * k), yaw_bias_rad2, axes))
    it.begin(round(known_until_s * S))
    return it


def test_the_newest_state_before_the_outage_is_propagated_by_the_imu():
    prior = outage().prior(4 * S)
    assert prior.stamp_ns == 4 * S
    np.testing.assert_allclose(prior.xyz_map_m, [4.0, 2.0, 10.0], atol=0.02)
    np.testing.assert_allclose(prior.velocity_map_mps, [1.0, 0.0, 0.0], atol=0.02)
    assert prior.yaw_map_rad == pytest.approx(0.3, abs=1e-3)
    assert 0.0 < prior.sigma_rad < 0.1
    assert math.isnan(prior.yaw_map_odom_rad)


def test_its_sigmas_grow():
    it = outage()
    early, late = it.prior(2 * S), it.prior(6 * S)
    assert late.position_sigma_m > 2.0 * early.position_sigma_m
    assert late.velocity_sigma_mps > early.velocity_sigma_mps
    assert late.sigma_rad > early.sigma_rad


def test_the_yaw_of_the_autopilots_axes_is_kept_with_its_sigma():
    prior = outage(OdomYaw(S, 0.7, 0.06)).prior(3 * S)
    assert prior.yaw_map_odom_rad == 0.7
    assert prior.sigma_rad >= 0.06


def test_there_is_none_without_a_state_before_the_outage_or_when_it_is_old():
    assert MapOutage().prior(S) is None
    assert outage(known_until_s=-1.0).prior(2 * S) is None
    assert outage().prior(S + SAME_NS) is None
    it = outage()
    it.forget()
    assert it.prior(2 * S) is None


def test_a_state_after_the_outage_replaces_the_one_before():
    it = outage()
    it.add_state(KnownState(3 * S, state(3.0), 0.0, None))
    assert it.prior(4 * S) is None
    it.begin(4 * S)
    assert it.prior(5 * S).xyz_map_m[0] == pytest.approx(3.0 + 2.0, abs=0.1)


def test_what_was_contradicted_is_no_state_before_the_next_outage():
    it = outage()
    it.add_state(KnownState(3 * S, state(3.0), 0.0, None))
    it.forget()
    it.begin(4 * S)
    assert it.prior(5 * S) is None


def test_the_variance_of_the_yaw_includes_its_bias():
    sigma_rad = outage().prior(3 * S).sigma_rad
    assert outage(yaw_bias_rad2=0.01).prior(3 * S).sigma_rad == pytest.approx(math.hypot(sigma_rad, 0.1))


def test_a_second_outage_without_a_state_in_between_keeps_that_of_the_first():
    it = outage()
    first = it.prior(3 * S)
    it.begin(2 * S)
    assert it.prior(3 * S).xyz_map_m == pytest.approx(first.xyz_map_m)


def test_without_an_imu_the_position_is_hardly_known():
    assert outage(motions=0).prior(4 * S).position_sigma_m > 3.0 * outage().prior(4 * S).position_sigma_m
