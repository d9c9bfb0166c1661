"""Nothing goes out as good that is not: each spoiled pose by its reason, and any spoiling at all."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mavlink_poses import HOST0, MS, good_pose, position_of
from pydantic import ValidationError

from links.mavlink.gate import Limits, Refusal, pose_sigmas, refusal
from links.mavlink.speaker import PoseSpeaker
from stages.geometry.frames import rotation_z
from stages.messages import PoseState

LIMITS = Limits()


def covariance(rotation_deg: float = 1.0, position_m: float = 0.1) -> Any:
    return np.diag([math.radians(rotation_deg) ** 2] * 3 + [position_m**2] * 3)


def nan_at(array: Any, value: float = math.nan) -> Any:
    spoiled = np.array(array, dtype=np.float64)
    spoiled.flat[-1] = value
    return spoiled


@pytest.mark.parametrize("state", [PoseState.FULL, PoseState.COASTING])
def test_a_good_pose_passes_in_both_states_that_have_a_rotation(state: PoseState):
    assert refusal(good_pose(state=state), HOST0, LIMITS) is None


@pytest.mark.parametrize("state", [PoseState.LOST, PoseState.POSITION_ONLY, PoseState.AMBIGUOUS])
def test_no_other_state_passes_even_if_the_pose_looks_whole(state: PoseState):
    why = refusal(good_pose(state=state), HOST0, LIMITS)
    assert why is not None
    assert why.name == state.name


SPOILED = [
    ({"estimate": None}, Refusal.INCOMPLETE),
    ({"estimate": position_of(good_pose())}, Refusal.INCOMPLETE),
    ({"xyz_map_m": nan_at(np.ones(3))}, Refusal.NOT_FINITE),
    ({"xyz_vehicle_m": nan_at(np.ones(3), math.inf)}, Refusal.NOT_FINITE),
    ({"R_map_drone": nan_at(np.eye(3))}, Refusal.NOT_FINITE),
    ({"map_covariance": nan_at(covariance())}, Refusal.NOT_FINITE),
    ({"covariance": np.diag([math.inf] * 3 + [0.01] * 3)}, Refusal.NOT_FINITE),  # a rotation that is not known
    ({"R_map_drone": np.diag([1.0, 1.0, -1.0])}, Refusal.NO_ROTATION),  # a mirror
    ({"R_vehicle_drone": 1.01 * np.eye(3)}, Refusal.NO_ROTATION),
    ({"R_map_drone": np.zeros((3, 3))}, Refusal.NO_ROTATION),
    ({"map_covariance": np.zeros((6, 6))}, Refusal.COVARIANCE),
    ({"covariance": -covariance()}, Refusal.COVARIANCE),
    ({"covariance": covariance() + 0.1 * np.triu(np.ones((6, 6)), 1)}, Refusal.COVARIANCE),  # not symmetric
    ({"map_covariance": covariance(position_m=0.51)}, Refusal.POSITION_SIGMA),
    ({"covariance": covariance(position_m=0.51)}, Refusal.POSITION_SIGMA),
    ({"map_covariance": covariance(rotation_deg=5.1)}, Refusal.ROTATION_SIGMA),
    ({"covariance": covariance(rotation_deg=60.0)}, Refusal.ROTATION_SIGMA),
]


@pytest.mark.parametrize(("spoiling", "why"), SPOILED)
def test_a_spoiled_pose_is_refused_by_its_reason_and_nothing_goes_out(spoiling: Any, why: Refusal):
    pose = good_pose(**spoiling)
    assert refusal(pose, HOST0, LIMITS) is why
    speaker = PoseSpeaker(("odometry", "landing_target"), LIMITS)
    assert speaker.speak(pose, HOST0) == []
    assert speaker.refused == {why: 1}


def test_sigmas_are_the_worst_direction_not_the_worst_axis():
    turned = np.kron(np.eye(2), rotation_z(math.pi / 4))
    flat = np.diag([1e-4, 4e-4, 1e-4, 0.01, 0.36, 0.01])
    sigmas = pose_sigmas(turned @ flat @ turned.T)
    assert sigmas is not None
    np.testing.assert_allclose(sigmas, [0.02, 0.6])
    assert refusal(good_pose(map_covariance=turned @ flat @ turned.T), HOST0, LIMITS) is Refusal.POSITION_SIGMA


@pytest.mark.parametrize(
    ("age_ms", "why"), [(0, None), (149, None), (151, Refusal.OLD), (-49, None), (-51, Refusal.AHEAD)]
)
def test_an_old_pose_and_one_from_the_future_are_refused(age_ms: int, why: Refusal | None):
    assert refusal(good_pose(), HOST0 + age_ms * MS, LIMITS) is why


def test_a_quarter_turn_that_is_not_resolved_never_goes_out_whatever_its_covariance_says():
    """Fusion in any of its states, 100 poses a state, each a quarter turn wrong and very sure of it."""
    speaker = PoseSpeaker(("odometry",), LIMITS)
    wrong = rotation_z(math.pi / 2)
    sent = 0
    for i in range(300):
        state = (PoseState.AMBIGUOUS, PoseState.POSITION_ONLY, PoseState.LOST)[i % 3]
        at_ns = HOST0 + 20 * i * MS
        pose = good_pose(at_ns, state=state, R_vehicle_drone=wrong, R_map_drone=wrong, covariance=covariance(0.1, 0.01))
        sent += len(speaker.speak(pose, at_ns))
    assert sent == 0
    assert sum(speaker.refused.values()) == 300


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
def test_whatever_one_number_becomes_what_goes_out_is_finite_sure_and_fresh(
    state: PoseState, field: str, at: int, value: float, age_ms: int
):
    spoiled = np.array(getattr(good_pose().estimate, field))
    spoiled.flat[at % spoiled.size] = value
    pose = good_pose(state=state, **{field: spoiled})
    messages = PoseSpeaker(("odometry",), LIMITS).speak(pose, HOST0 + age_ms * MS)
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
def test_limits_that_let_everything_pass_cannot_be_set(wrong: Any):
    with pytest.raises(ValidationError):
        Limits(**wrong)
