"""The gate: each invalid pose is rejected with its reason, and no random change passes unnoticed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from links.mavlink.poses.gate import PoseLimits, RejectReason, pose_sigmas, reject_reason
from links.mavlink.poses.pose_sender import PoseSender
from stages.geometry.frames import rotation_z
from stages.messages import PoseState
from tests.links.mavlink.mavlink_poses import HOST0, MS, good_pose, position_of

LIMITS = PoseLimits()


def covariance(rotation_deg: float = 1.0, position_m: float = 0.1) -> Any:
    return np.diag([math.radians(rotation_deg) ** 2] * 3 + [position_m**2] * 3)


def nan_at(array: Any, value: float = math.nan) -> Any:
    changed = np.array(array, dtype=np.float64)
    changed.flat[-1] = value
    return changed


@pytest.mark.parametrize("state", [PoseState.FULL, PoseState.COASTING])
def test_a_good_pose_passes_in_both_states_that_have_a_rotation(state: PoseState):
    assert reject_reason(good_pose(state=state), HOST0, LIMITS) is None


@pytest.mark.parametrize("state", [PoseState.LOST, PoseState.POSITION_ONLY, PoseState.AMBIGUOUS])
def test_no_other_state_passes_even_if_the_pose_is_complete(state: PoseState):
    why = reject_reason(good_pose(state=state), HOST0, LIMITS)
    assert why is not None
    assert why.name == state.name


INVALID = [
    ({"estimate": None}, RejectReason.INCOMPLETE),
    ({"estimate": position_of(good_pose())}, RejectReason.INCOMPLETE),
    ({"xyz_map_m": nan_at(np.ones(3))}, RejectReason.NOT_FINITE),
    ({"xyz_vehicle_m": nan_at(np.ones(3), math.inf)}, RejectReason.NOT_FINITE),
    ({"R_map_drone": nan_at(np.eye(3))}, RejectReason.NOT_FINITE),
    ({"map_covariance": nan_at(covariance())}, RejectReason.NOT_FINITE),
    ({"covariance": np.diag([math.inf] * 3 + [0.01] * 3)}, RejectReason.NOT_FINITE),  # an unknown rotation
    ({"R_map_drone": np.diag([1.0, 1.0, -1.0])}, RejectReason.INVALID_ROTATION),  # a reflection
    ({"R_vehicle_drone": 1.01 * np.eye(3)}, RejectReason.INVALID_ROTATION),
    ({"R_map_drone": np.zeros((3, 3))}, RejectReason.INVALID_ROTATION),
    ({"map_covariance": np.zeros((6, 6))}, RejectReason.INVALID_COVARIANCE),
    ({"covariance": -covariance()}, RejectReason.INVALID_COVARIANCE),
    (
        {"covariance": covariance() + 0.1 * np.triu(np.ones((6, 6)), 1)},
        RejectReason.INVALID_COVARIANCE,
    ),  # not symmetric
    ({"map_covariance": covariance(position_m=0.51)}, RejectReason.POSITION_SIGMA),
    ({"covariance": covariance(position_m=0.51)}, RejectReason.POSITION_SIGMA),
    ({"map_covariance": covariance(rotation_deg=5.1)}, RejectReason.ROTATION_SIGMA),
    ({"covariance": covariance(rotation_deg=60.0)}, RejectReason.ROTATION_SIGMA),
]


@pytest.mark.parametrize(("change", "why"), INVALID)
def test_an_invalid_pose_is_rejected_with_its_reason_and_nothing_is_sent(change: Any, why: RejectReason):
    pose = good_pose(**change)
    assert reject_reason(pose, HOST0, LIMITS) is why
    pose_sender = PoseSender(("odometry", "landing_target"), LIMITS, yaw="measured")
    assert pose_sender.messages(pose, HOST0) == []
    assert pose_sender.rejected == {why: 1}


def test_sigmas_are_of_the_worst_direction_not_the_worst_axis():
    turned = np.kron(np.eye(2), rotation_z(math.pi / 4))
    flat = np.diag([1e-4, 4e-4, 1e-4, 0.01, 0.36, 0.01])
    sigmas = pose_sigmas(turned @ flat @ turned.T)
    assert sigmas is not None
    np.testing.assert_allclose(sigmas, [0.02, 0.6])
    assert (
        reject_reason(good_pose(map_covariance=turned @ flat @ turned.T), HOST0, LIMITS) is RejectReason.POSITION_SIGMA
    )


@pytest.mark.parametrize(
    ("age_ms", "why"), [(0, None), (149, None), (151, RejectReason.OLD), (-49, None), (-51, RejectReason.FUTURE)]
)
def test_an_old_pose_and_one_from_the_future_are_rejected(age_ms: int, why: RejectReason | None):
    assert reject_reason(good_pose(), HOST0 + age_ms * MS, LIMITS) is why


def test_an_unresolved_yaw_branch_is_never_sent_whatever_its_covariance():
    """100 poses per state, each with a yaw error of 90 deg and a small covariance."""
    pose_sender = PoseSender(("odometry",), LIMITS, yaw="measured")
    wrong = rotation_z(math.pi / 2)
    sent = 0
    for i in range(300):
        state = (PoseState.AMBIGUOUS, PoseState.POSITION_ONLY, PoseState.LOST)[i % 3]
        at_ns = HOST0 + 20 * i * MS
        pose = good_pose(at_ns, state=state, R_vehicle_drone=wrong, R_map_drone=wrong, covariance=covariance(0.1, 0.01))
        sent += len(pose_sender.messages(pose, at_ns))
    assert sent == 0
    assert sum(pose_sender.rejected.values()) == 300


NUMBERS = st.floats(allow_nan=True, allow_infinity=True, width=64)


@given(
    state=st.sampled_from(PoseState),
    field=st.sampled_from(
        ["xyz_vehicle_m", "xyz_map_m", "R_vehicle_drone", "R_map_drone", "covariance", "map_covariance"]
    ),
    at=st.integers(0, 35),
    value=NUMBERS,
    age_ms=st.integers(-500, 500),
)
@settings(max_examples=200, deadline=None)
def test_whatever_one_number_becomes_sent_poses_are_finite_certain_and_recent(
    state: PoseState, field: str, at: int, value: float, age_ms: int
):
    changed = np.array(getattr(good_pose().estimate, field))
    changed.flat[at % changed.size] = value
    pose = good_pose(state=state, **{field: changed})
    messages = PoseSender(("odometry",), LIMITS, yaw="measured").messages(pose, HOST0 + age_ms * MS)
    for message in messages:
        assert state in (PoseState.FULL, PoseState.COASTING)
        assert -50 <= age_ms <= 150
        assert np.isfinite([message.x, message.y, message.z, *message.q, *message.pose_covariance]).all()
        position = [message.pose_covariance[i] for i in (0, 6, 11)]
        angles = [message.pose_covariance[i] for i in (15, 18, 20)]
        assert 0 < min(position) <= max(position) <= 0.25 * (1 + 1e-6)
        assert 0 < min(angles) <= max(angles) <= math.radians(5.0) ** 2 * (1 + 1e-6)
        assert 1 <= message.quality <= 100


@pytest.mark.parametrize(
    "wrong", [{"age_s": 0.0}, {"age_s": 1.0}, {"rotation_sigma_deg": 45.0}, {"position_sigma_m": 0.0}]
)
def test_limits_that_accept_everything_cannot_be_set(wrong: Any):
    with pytest.raises(ValidationError):
        PoseLimits(**wrong)
