"""The rules of ArduPilot and PX4, each as in its source, on messages made by hand."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega

from links.simulated.autopilot.ardupilot_rules import ArduPilotRules, JitterCorrection
from links.simulated.autopilot.px4_rules import Px4Rules
from links.simulated.autopilot.rules import PoseResult, Rules

mavlink: Any = ardupilotmega
MS = 1_000_000
NAN21 = [math.nan] * 21


def upper(position: float = 0.01, angle: float = 0.001) -> list[float]:
    numbers = [0.0] * 21
    for i in (0, 6, 11):
        numbers[i] = position
    for i in (15, 18, 20):
        numbers[i] = angle
    return numbers


def odometry(at_ms: float, x: float = 0.0, yaw_deg: float = 0.0, vx: float = math.nan, **fields: Any) -> Any:
    half = math.radians(yaw_deg) / 2
    given = {
        "frame_id": 20,
        "child_frame_id": 12,
        "pose_covariance": upper(),
        "reset_counter": 0,
        "estimator_type": 3,
        "quality": 80,
    } | fields
    return mavlink.MAVLink_odometry_message(
        round(1000 * at_ms),
        given["frame_id"],
        given["child_frame_id"],
        x,
        0.0,
        -10.0,
        [math.cos(half), 0.0, 0.0, math.sin(half)],
        vx,
        0.0 if math.isfinite(vx) else math.nan,
        0.0 if math.isfinite(vx) else math.nan,
        *[math.nan] * 3,
        given["pose_covariance"],
        NAN21,
        given["reset_counter"],
        given["estimator_type"],
        given["quality"],
    )


def estimate(at_ms: float, **fields: Any) -> Any:
    return mavlink.MAVLink_vision_position_estimate_message(
        round(1000 * at_ms), 1.0, 2.0, 3.0, 0.0, 0.0, math.radians(30), fields.get("covariance", upper()), 0
    )


def receive(rules: Rules, at_ms: float, x: float = 0.0, **fields: Any) -> PoseResult:
    return rules.receive(odometry(at_ms, x, **fields), round(at_ms * MS))


def fly(rules: Rules, from_ms: int, to_ms: int, every_ms: int = 25, **fields: Any) -> PoseResult:
    result = PoseResult.NOT_A_POSE
    for at_ms in range(from_ms, to_ms, every_ms):
        result = receive(rules, at_ms, **fields)
    return result


@pytest.mark.parametrize("frames", [(1, 12), (20, 1), (20, 8), (0, 0), (12, 20)])
def test_ardupilot_drops_other_frames_without_counting_them_for_health(frames: tuple[int, int]):
    rules = ArduPilotRules()
    assert receive(rules, 100, frame_id=frames[0], child_frame_id=frames[1]) is PoseResult.WRONG_FRAME
    assert not rules.healthy(100 * MS)


def test_ardupilot_is_healthy_for_300_ms_after_a_message_and_not_one_longer():
    rules = ArduPilotRules()
    receive(rules, 100)
    assert rules.healthy(399 * MS)
    assert not rules.healthy(400 * MS)


def test_ardupilot_arms_on_a_pose_with_a_yaw_error_of_90_deg():
    """The reason why an unresolved yaw branch is never sent: the autopilot does not reject it."""
    rules = ArduPilotRules()
    assert fly(rules, 0, 1000, yaw_deg=90.0) is PoseResult.FUSED
    assert rules.healthy(1000 * MS)
    assert rules.fusing(1000 * MS)


def test_ardupilot_uses_a_velocity_of_zero_and_skips_nan():
    believing, skipping = ArduPilotRules(), ArduPilotRules()
    fly(believing, 0, 100, vx=2.0)
    fly(skipping, 0, 100, vx=2.0)
    receive(believing, 100, vx=0.0)
    receive(skipping, 100, vx=math.nan)
    assert believing.estimate is not None
    assert skipping.estimate is not None
    assert believing.estimate.velocity_mps[0] == 0.0
    assert skipping.estimate.velocity_mps[0] == 2.0


def test_ardupilot_rotates_body_velocity_into_its_local_frame():
    rules = ArduPilotRules()
    receive(rules, 0, yaw_deg=90.0, vx=3.0)
    assert rules.estimate is not None
    np.testing.assert_allclose(rules.estimate.velocity_mps, [0, 3, 0], atol=1e-6)


def test_ardupilot_fuses_at_most_one_each_20_ms():
    rules = ArduPilotRules()
    results = [receive(rules, at_ms) for at_ms in (0, 10, 20, 39, 40)]
    assert [f is PoseResult.TOO_SOON for f in results] == [False, True, False, True, False]
    assert rules.healthy(100 * MS)


def test_ardupilot_reads_the_covariance_as_a_cube_root_and_not_below_its_floors():
    rules = ArduPilotRules(viso_pos_m_nse=0.05)
    receive(rules, 0, pose_covariance=upper(position=0.25))
    assert rules.estimate is not None
    assert math.sqrt(rules.estimate.position_var) == pytest.approx(math.cbrt(3 * 0.25**2))
    rules = ArduPilotRules()
    receive(rules, 0, pose_covariance=NAN21)
    assert rules.estimate is not None
    assert math.sqrt(rules.estimate.position_var) == pytest.approx(0.2)
    assert math.sqrt(rules.estimate.yaw_var) == pytest.approx(0.2)


def test_ardupilot_rejects_a_partly_nan_covariance():
    partly = upper()
    partly[6] = math.nan
    assert receive(ArduPilotRules(), 0, pose_covariance=partly) is PoseResult.NOT_FINITE


@pytest.mark.parametrize(
    ("quality", "result"), [(-1, PoseResult.LOW_QUALITY), (0, PoseResult.RESET), (1, PoseResult.RESET)]
)
def test_rejected_poses_count_for_the_health_of_ardupilot(quality: int, result: PoseResult):
    rules = ArduPilotRules()
    assert receive(rules, 0, quality=quality) is result
    assert rules.healthy(0)


@pytest.mark.parametrize("rules", [ArduPilotRules, Px4Rules])
def test_a_jump_is_gated_unless_the_reset_counter_changes(rules: Any):
    announced, unannounced = rules(), rules()
    for r in (announced, unannounced):
        assert fly(r, 0, 1000) is PoseResult.FUSED
    assert receive(unannounced, 1000, x=8.0) is PoseResult.GATED
    assert receive(announced, 1000, x=8.0, reset_counter=1) is PoseResult.RESET
    assert receive(announced, 1025, x=8.0, reset_counter=1) is PoseResult.FUSED
    assert announced.estimate is not None
    assert announced.estimate.xyz_m[0] == pytest.approx(8.0)


@pytest.mark.parametrize("rules", [ArduPilotRules, Px4Rules])
def test_a_yaw_error_of_90_deg_in_flight_is_gated(rules: Any):
    r = rules()
    fly(r, 0, 1000)
    assert receive(r, 1000, yaw_deg=90.0) is PoseResult.GATED


def test_ardupilot_is_in_constant_position_mode_after_7_s_without_a_fused_pose():
    rules = ArduPilotRules()
    fly(rules, 0, 1000)
    assert rules.fusing(7900 * MS)
    assert not rules.fusing(8000 * MS)
    flags = rules.report(8000 * MS).flags
    assert flags & mavlink.EKF_CONST_POS_MODE
    assert not flags & mavlink.EKF_POS_HORIZ_REL


def test_ardupilots_clock_is_that_of_the_message_with_the_least_lag():
    jitter = JitterCorrection()
    lags = [5000, 12000, 3000, 40000]
    local = [jitter.local_us(1_000_000 * i, 7_000_000 + 1_000_000 * i + lag) for i, lag in enumerate(lags)]
    assert [t - 7_000_000 - 1_000_000 * i for i, t in enumerate(local)] == [5000, 5000, 3000, 3000]
    assert jitter.local_us(0, 20_000_000) == 20_000_000 - 500_000  # no message is older than half a second


def test_px4_starts_with_two_messages_less_than_200_ms_apart_and_stops_after_400_ms_of_none():
    rules = Px4Rules()
    assert [receive(rules, at) for at in (0, 250, 500)] == [PoseResult.NOT_STARTED] * 3
    assert receive(rules, 690) is PoseResult.RESET
    assert rules.fusing(1090 * MS)
    assert not rules.fusing(1091 * MS)
    assert receive(rules, 1100) is PoseResult.NOT_STARTED  # 410 ms after the previous one
    assert receive(rules, 1200) is PoseResult.RESET


@pytest.mark.parametrize(("kind", "taken"), [(0, True), (2, True), (3, True), (6, False), (7, False), (8, False)])
def test_px4_accepts_vision_and_not_lidar_or_mocap_estimators(kind: int, taken: bool):
    result = receive(Px4Rules(), 0, estimator_type=kind)
    assert (result is not PoseResult.WRONG_ESTIMATOR) == taken


def test_only_ardupilot_accepts_a_north_oriented_estimate_without_a_compass():
    assert Px4Rules().receive(estimate(0), 0) is PoseResult.WRONG_FRAME
    rules = ArduPilotRules()
    assert rules.receive(estimate(0), 0) is PoseResult.RESET
    assert rules.estimate is not None
    np.testing.assert_allclose(rules.estimate.xyz_m, [1, 2, 3])
    assert math.degrees(rules.estimate.yaw_rad) == pytest.approx(30.0, abs=1e-4)


def test_px4_requires_its_quality_before_it_starts_and_while_it_fuses():
    rules = Px4Rules(ekf2_ev_qmin=50)
    assert fly(rules, 0, 500, quality=49) is PoseResult.LOW_QUALITY
    assert not rules.fusing(500 * MS)
    assert fly(rules, 500, 1000, quality=50) is PoseResult.FUSED


def test_px4_resets_after_a_second_of_gated_poses_five_times_and_then_stops():
    rules = Px4Rules()
    fly(rules, 0, 1000)
    resets_at: list[int] = []
    at_ms = 1000
    while at_ms < 12_000 and rules.fusing(at_ms * MS):
        result = receive(rules, at_ms, x=0.4 * at_ms)  # moves at 400 m/s: nothing passes the gate
        resets_at += [at_ms] if result is PoseResult.RESET else []
        at_ms += 25
    assert len(resets_at) == 5
    assert all(b - a > 1000 for a, b in itertools.pairwise([975, *resets_at]))
    assert at_ms < 12_000


@pytest.mark.parametrize("rules", [ArduPilotRules, Px4Rules])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_no_rule_accepts_a_position_that_is_not_finite(rules: Any, bad: float):
    assert receive(rules(), 0, x=bad) is PoseResult.NOT_FINITE


@pytest.mark.parametrize("rules", [ArduPilotRules, Px4Rules])
def test_the_report_states_what_is_fused(rules: Any):
    r = rules()
    assert r.report(0).flags & 128
    fly(r, 0, 500)
    flags = r.report(500 * MS).flags
    assert flags & 8
    assert not flags & 128
    assert r.receive(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 3, 3), 0) is PoseResult.NOT_A_POSE
