"""The remembered heading of a lost drone, as one hypothesis when a drone is found."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.geometry.frames import rotation_z
from stages.heading.heading_memory import MAYBE_ANOTHER, SAME_DRONE, HeadingMemory
from stages.heading.imu_buffer import ImuBuffer
from stages.heading.inertial_state import GRAVITY_MPS2, InertialState
from stages.messages import DroneMotion

S = 1_000_000_000
STEP_NS = 40_000_000
COVARIANCE_M2 = 0.01 * np.eye(3)
XYZ_M = np.array([1.0, 2.0, 20.0])


def remembered(rate_radps=0.0, until_s=12.0, yaw_rad=0.5, sigma_rad=0.02):
    """A memory of time 0, and the IMU of a drone that turns on the spot afterwards."""
    imu = ImuBuffer()
    for k in range(round(until_s * S / STEP_NS)):
        imu.add(
            DroneMotion(
                stamp_ns=(k + 1) * STEP_NS,
                start_ns=k * STEP_NS,
                segment=0,
                specific_force_drone_mps2=-GRAVITY_MPS2,
                angular_velocity_drone_radps=np.array([0.0, 0.0, rate_radps]),
                specific_force_noise=np.full(3, 0.02),
                angular_velocity_noise=np.full(3, 0.002),
                up_drone=None,
                autopilot=None,
            )
        )
    P = np.diag(np.array([sigma_rad] * 3 + [0.05] * 3 + [0.05] * 3 + [0.01] * 3 + [0.001] * 3) ** 2)
    memory = HeadingMemory(imu)
    memory.remember(
        0, InertialState(rotation_z(yaw_rad)[None], XYZ_M[None], np.zeros((1, 3)), np.zeros((1, 6)), P[None])
    )
    return memory


def test_nothing_remembered_is_no_hypothesis():
    memory = HeadingMemory(ImuBuffer())
    assert memory.yaw(S, XYZ_M, COVARIANCE_M2) is None
    memory = remembered()
    memory.forget()
    assert memory.yaw(S, XYZ_M, COVARIANCE_M2) is None


@pytest.mark.parametrize("rate_radps", [-0.6, 0.0, 0.3])
def test_the_yaw_is_propagated_by_the_gyroscope_with_a_growing_sigma(rate_radps):
    memory = remembered(rate_radps)
    early, late = memory.yaw(S, XYZ_M, COVARIANCE_M2), memory.yaw(10 * S, XYZ_M, COVARIANCE_M2)
    for (yaw_rad, _, _), t in ((early, 1.0), (late, 10.0)):
        assert abs(math.remainder(yaw_rad - 0.5 - t * rate_radps, 2 * math.pi)) < 1e-6
    assert early[1] == pytest.approx(0.02, abs=0.003)
    assert late[1] > math.hypot(0.02, 0.001 * 10)  # the bias


def test_the_propagated_position_identifies_the_drone():
    memory = remembered()
    at = [memory.yaw(2 * S, XYZ_M + np.array([off_m, 0.0, 0.0]), COVARIANCE_M2)[2] for off_m in (0.0, 0.3, 5.0, 500.0)]
    assert at == [SAME_DRONE, SAME_DRONE, MAYBE_ANOTHER, MAYBE_ANOTHER]


def test_after_long_it_may_be_another_drone_also_at_the_same_position():
    memory = remembered(until_s=18.0)
    assert memory.yaw(14 * S, XYZ_M, COVARIANCE_M2)[2] == SAME_DRONE
    assert memory.yaw(16 * S, XYZ_M, COVARIANCE_M2)[2] == MAYBE_ANOTHER


def test_no_remembered_heading_decides_alone():
    """The decision needs P > 0.999 of all yaws together, at three positions; a memory of another drone has less."""
    assert MAYBE_ANOTHER < 0.999


def test_a_yaw_that_has_become_uncertain_or_old_is_none():
    assert remembered(sigma_rad=0.4).yaw(S, XYZ_M, COVARIANCE_M2) is None
    assert remembered().yaw(121 * S, XYZ_M, COVARIANCE_M2) is None
    assert remembered(until_s=2.0).yaw(20 * S, XYZ_M, COVARIANCE_M2) is None  # a gap of the gyroscope
