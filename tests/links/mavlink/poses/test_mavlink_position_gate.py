"""Positions without yaw: which are sent, and in which axes."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from links.mavlink.poses.gate import PoseLimits, RejectReason
from links.mavlink.poses.position_gate import (
    COMPASS_RAD,
    LEVER_M,
    position_quality_percent,
    position_reason,
    sent_position,
)
from links.mavlink.poses.sent_frame import SentFrame
from stages.geometry.frames import rotation_z
from stages.messages import PoseState, PositionEstimate, RelativePose
from tests.links.mavlink.mavlink_poses import HOST0, MS, good_pose, position_of

LIMITS = PoseLimits()


def position(covariance_m2: Any = None, **changes: Any) -> RelativePose:
    """A pose that has no rotation."""
    estimate = position_of(good_pose())
    if covariance_m2 is not None:
        estimate = dataclasses.replace(estimate, covariance_map_m2=covariance_m2)
    return good_pose(**{"estimate": estimate, "state": PoseState.POSITION_ONLY, **changes})


@pytest.mark.parametrize("state", [s for s in PoseState if s is not PoseState.LOST])
def test_a_position_needs_no_rotation(state: PoseState):
    assert position_reason(position(state=state), HOST0, LIMITS) is None
    assert position_reason(good_pose(state=state), HOST0, LIMITS) is None


@pytest.mark.parametrize(
    ("pose", "why"),
    [
        (position(state=PoseState.LOST), RejectReason.LOST),
        (position(estimate=None), RejectReason.INCOMPLETE),
        (position(np.diag([0.01, 0.01, math.nan])), RejectReason.NOT_FINITE),
        (position(np.zeros((3, 3))), RejectReason.INVALID_COVARIANCE),
        (position(np.array([[0.01, 0.005, 0], [0, 0.01, 0], [0, 0, 0.01]])), RejectReason.INVALID_COVARIANCE),
        (position(np.diag([0.13, 0.01, 0.01])), RejectReason.POSITION_SIGMA),
        (position(odom_yaw_rad=None), RejectReason.ODOM_YAW),
        (position(odom_yaw_sigma_rad=None), RejectReason.ODOM_YAW),
        (position(odom_yaw_rad=math.nan), RejectReason.NOT_FINITE),
        (position(odom_yaw_sigma_rad=math.radians(LIMITS.rotation_sigma_deg + 0.1)), RejectReason.ODOM_YAW_SIGMA),
    ],
)
def test_an_invalid_position_is_rejected_with_its_reason(pose: RelativePose, why: RejectReason):
    assert position_reason(pose, HOST0, LIMITS) is why


@pytest.mark.parametrize(("age_ms", "why"), [(149, None), (151, RejectReason.OLD), (-51, RejectReason.FUTURE)])
def test_its_age_is_limited(age_ms: int, why: RejectReason | None):
    assert position_reason(position(), HOST0 + age_ms * MS, LIMITS) is why


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, -135.0])
def test_the_position_is_turned_into_the_autopilots_axes(yaw_deg: float):
    pose = position(odom_yaw_rad=math.radians(yaw_deg))
    assert isinstance(pose.estimate, PositionEstimate)
    given = sent_position(pose, SentFrame(math.radians(yaw_deg), np.array([10.0, 20.0, 30.0])))
    turned_m = rotation_z(math.radians(yaw_deg)) @ (given.xyz_m - [10.0, 20.0, 30.0])
    np.testing.assert_allclose(turned_m, pose.estimate.xyz_map_m)


def test_the_error_of_the_yaw_and_of_the_compass_is_in_the_level_covariance():
    covariance = np.diag([0.01, 0.04, 0.09])
    given = sent_position(position(covariance, odom_yaw_sigma_rad=0.03), SentFrame(math.pi / 2, np.zeros(3)))
    level = (0.03**2 + COMPASS_RAD**2) * LEVER_M**2
    np.testing.assert_allclose(given.covariance_m2, np.diag([0.04 + level, 0.01 + level, 0.09]), atol=1e-12)


def test_the_covariance_of_a_pose_is_turned_from_drone_axes():
    R = rotation_z(math.pi / 2)
    covariance = np.diag([1e-4, 1e-4, 1e-4, 0.01, 0.04, 0.09])
    pose = good_pose(R_map_drone=R, map_covariance=covariance, odom_yaw_sigma_rad=0.0)
    level = (COMPASS_RAD * LEVER_M) ** 2
    expected = np.diag([0.04 + level, 0.01 + level, 0.09])
    np.testing.assert_allclose(sent_position(pose, SentFrame(0.0, np.zeros(3))).covariance_m2, expected, atol=1e-12)


def test_quality_decreases_with_both_sigmas():
    assert position_quality_percent(position(1e-12 * np.eye(3), odom_yaw_sigma_rad=0.0), LIMITS) == 100
    half = np.diag([(0.5 * LIMITS.position_sigma_m) ** 2, 1e-6, 1e-6])
    assert position_quality_percent(position(half, odom_yaw_sigma_rad=0.0), LIMITS) == 50
    three_quarters = math.radians(0.75 * LIMITS.rotation_sigma_deg)
    assert position_quality_percent(position(half, odom_yaw_sigma_rad=three_quarters), LIMITS) == 25
