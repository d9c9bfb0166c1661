"""The fused pose over whole flights: accuracy, states and faults."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest

from stages.fuse import Fuse
from stages.messages import PoseState, PositionEstimate, ServoState, TrackingState
from tests.stages.fuse.ekf import EkfFuse
from tests.stages.fuse.made_drone_flight import START_NS, Made, S, fix, ns, rms, rotation, track

FULL, COASTING, LOST = PoseState.FULL, PoseState.COASTING, PoseState.LOST
POSITION_ONLY, AMBIGUOUS = PoseState.POSITION_ONLY, PoseState.AMBIGUOUS


def wrong(made, poses, deg=45.0):
    """Number of poses with a rotation on a wrong branch."""
    return sum(angle > deg for angle in made.judge(poses).angle_deg)


@pytest.mark.parametrize("stage_type", [Fuse, EkfFuse])
def test_fixes_rotations_and_odometry_make_one_full_pose(stage_type):
    made = Made(until_s=8, vehicle_mps=3.0, vehicle_dps=10.0)
    seen = made.judge(made.run(stage_type()), after_s=4)
    assert set(seen.states) == {FULL}
    assert seen.rmse_m() < 0.12
    assert rms(seen.angle_deg) < 0.6


def test_poses_are_published_every_20_ms_on_the_grid():
    made = Made(until_s=5, clock_hz=100)
    stamps = [pose.stamp_ns for pose in made.run(Fuse())]
    assert all(stamp % 20_000_000 == 0 for stamp in stamps)
    assert {b - a for a, b in pairwise(stamps)} == {20_000_000}


def test_two_runs_give_the_same_to_the_last_bit():
    a, b = (Made(until_s=5).run(Fuse()) for _ in range(2))
    for p, q in zip(a, b, strict=True):
        assert p.state is q.state
        assert np.array_equal(p.xyz_vehicle_m, q.xyz_vehicle_m) or p.xyz_vehicle_m is None
        assert type(p.estimate) is type(q.estimate)
        if p.estimate is not None:
            for field in dataclasses.fields(p.estimate):
                assert np.array_equal(getattr(p.estimate, field.name), getattr(q.estimate, field.name))


def test_poses_in_vehicle_and_map_agree():
    made = Made(until_s=5, vehicle_mps=3.0, vehicle_dps=20.0)
    poses = [pose for pose in made.run(Fuse()) if pose.state is FULL]
    for pose in poses[::20]:
        R, x = made.T_world_vehicle((pose.stamp_ns - START_NS) / S)
        assert np.allclose(R @ pose.xyz_vehicle_m + x, pose.xyz_map_m, atol=0.03)
        assert np.allclose(R @ pose.R_vehicle_drone, pose.R_map_drone, atol=1e-2)
        assert np.allclose(pose.estimate.covariance, pose.estimate.map_covariance)


def test_velocities_are_over_ground_and_relative_to_the_vehicle():
    made = Made(until_s=8, vehicle_mps=3.0)
    poses = [pose for pose in made.run(Fuse()) if pose.stamp_ns > ns(4)]
    over_ground = [
        np.linalg.norm(p.estimate.velocity_map_mps - made.velocity_mps((p.stamp_ns - START_NS) / S)) for p in poses
    ]
    relative = [
        np.linalg.norm(
            p.estimate.velocity_vehicle_mps + np.array([3, 0, 0]) - made.velocity_mps((p.stamp_ns - START_NS) / S)
        )
        for p in poses
    ]
    assert rms(over_ground) < 0.3
    assert rms(relative) < 0.35


# sources of the rotation


def test_without_images_the_drones_motion_gives_its_heading():
    made = Made(rotations=False)
    poses = made.run(Fuse())
    first = next(pose for pose in poses if pose.state is FULL)
    assert 2.0 < (first.stamp_ns - START_NS) / S < 6.0
    assert "motion" in first.reason
    assert max(made.judge(poses).angle_deg) < 10


def test_a_hovering_drone_has_no_heading():
    poses = Made(rotations=False, radius_m=0.0).run(Fuse())
    assert {pose.state for pose in poses} == {LOST, POSITION_ONLY}
    assert poses[-1].R_vehicle_drone is None
    assert isinstance(poses[-1].estimate, PositionEstimate)
    assert "too little" in poses[-1].reason


def test_an_unresolved_rotation_is_not_published():
    poses = Made(until_s=6, radius_m=0.0, resolved_after_s=99).run(Fuse())
    assert poses[-1].state is AMBIGUOUS
    assert all(pose.R_vehicle_drone is None for pose in poses)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_vanishing_points_on_another_branch_than_the_motion_are_rejected(quarter, seed):
    made = Made(until_s=9, quarters=((0.0, quarter),), seed=seed)
    poses = made.run(Fuse())
    assert wrong(made, poses) == 0
    assert poses[-1].state is AMBIGUOUS


@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_later_vanishing_points_on_another_branch_end_full(quarter):
    made = Made(until_s=14, quarters=((0.0, quarter),), gaps_s={"rotation": (0.0, 9.0)})
    poses = made.run(Fuse())
    before = [pose.state for pose in poses if ns(8) < pose.stamp_ns < ns(9)]
    assert set(before) == {FULL}  # by motion alone
    assert {pose.state for pose in poses if pose.stamp_ns > ns(10.5)} == {AMBIGUOUS}
    assert "heading" in poses[-1].reason
    assert wrong(made, poses) == 0


@pytest.mark.parametrize("reported", [True, False])
def test_a_branch_that_changes_in_flight_ends_full(reported):
    made = Made(until_s=9, quarters=((5.0, 1),), switches=reported)
    poses = made.run(Fuse())
    assert wrong(made, poses) == 0
    assert poses[-1].state is AMBIGUOUS
    assert poses[-1].resets > 0


def test_a_rotation_by_vanishing_points_alone_is_dropped_when_they_are_no_longer_resolved():
    made, stage = Made(until_s=5, autopilot="none", images=True), Fuse()
    poses = made.run(stage)
    assert poses[-1].state is FULL
    poses += list(stage.on_rotation(rotation(5.05, made.truth(5.05)[0], resolved=False)))
    assert poses[-1].state is AMBIGUOUS


def test_a_yaw_reset_of_odom_during_a_silence_gives_no_wrong_pose():
    made = Made(rotations=False, false_north=(6.0, 90.0), gaps_s={"odometry": (5.8, 7.0)})
    assert wrong(made, made.run(Fuse())) == 0


def test_a_measured_yaw_reset_of_odom_is_removed():
    made = Made(rotations=False, false_north=(8.0, 90.0))
    poses = made.run(Fuse())
    assert poses[-1].state is FULL
    assert max(made.judge(poses).angle_deg) < 10


# missing inputs


def test_odometry_propagates_the_pose_through_three_seconds_without_lidar():
    made = Made(until_s=14, speed_mps=5.0, gaps_s={"fix": (9.0, 12.0)}, clock_hz=100)
    poses = made.run(Fuse())
    in_gap = [pose for pose in poses if ns(9.4) < pose.stamp_ns < ns(12.0)]
    assert {pose.state for pose in in_gap} == {COASTING}
    assert "no LiDAR position for" in in_gap[0].reason
    assert max(b.stamp_ns - a.stamp_ns for a, b in pairwise(poses)) == 20_000_000
    seen = made.judge(in_gap)
    assert max(seen.error_m) < 0.7
    assert np.mean(seen.nees3) < 7.8
    assert seen.sigma_m[-1] > 2 * seen.sigma_m[0]
    assert poses[-1].state is FULL


def test_the_pose_is_lost_after_a_long_time_without_lidar():
    made = Made(until_s=16, gaps_s={"fix": (5.0, 99.0)})
    poses = made.run(Fuse())
    assert poses[-1].state is LOST
    assert poses[-1].xyz_vehicle_m is None
    assert "no LiDAR position" in poses[-1].reason
    assert poses[-1].measured_ns < ns(5.1)


def test_a_reacquired_drone_has_its_heading_at_once():
    made = Made(until_s=20, rotations=False, gaps_s={"fix": (8.0, 18.0)})
    poses = made.run(Fuse())
    found = next(pose for pose in poses if pose.stamp_ns > ns(18) and pose.state is FULL)
    assert (found.stamp_ns - ns(18)) / S < 0.5
    assert found.resets == next(pose for pose in poses if pose.state is FULL).resets + 1
    assert max(made.judge(poses).angle_deg) < 10


def test_without_an_autopilot_rotations_and_drone_images_make_it_full():
    made = Made(autopilot="none", images=True)
    seen = made.judge(made.run(Fuse()), after_s=3)
    assert set(seen.states) == {FULL}
    assert rms(seen.angle_deg) < 1.0


def test_directions_without_scale_improve_the_velocity_without_an_autopilot():
    """Rotations too, so that directions can be turned into the map frame; fixes each 0.1 s, rough."""
    errors = []
    for images in (False, True):
        made = Made(autopilot="none", images=images, turn_dps=0.0, fix_sigma_m=0.15, seed=4)
        poses = [pose for pose in made.run(Fuse()) if pose.stamp_ns > ns(4)]
        errors.append(
            rms(
                [
                    np.linalg.norm(p.estimate.velocity_map_mps - made.velocity_mps((p.stamp_ns - START_NS) / S))
                    for p in poses
                ]
            )
        )
    assert errors[1] < 0.9 * errors[0]


def test_without_an_autopilot_or_images_the_position_is_tracked():
    made = Made(until_s=6, autopilot="none", rotations=False)
    seen = made.judge(made.run(Fuse()), after_s=2)
    assert set(seen.states) == {POSITION_ONLY}
    assert seen.rmse_m() < 0.25


@pytest.mark.parametrize("parked", [False, True])
def test_without_vehicle_motion_the_vehicle_frame_is_the_map_frame(parked):
    """Only for a parked vehicle can the drone's motion confirm the vanishing points."""
    made = Made(until_s=8, vehicle=False)
    poses = made.run(Fuse(parked=parked))
    seen = made.judge(poses, after_s=4)
    assert set(seen.states) == {FULL if parked else AMBIGUOUS}
    assert parked or "without the vehicle's motion" in poses[-1].reason
    assert np.allclose(poses[-1].xyz_map_m, poses[-1].xyz_vehicle_m)
    assert seen.rmse_m() < (0.12 if parked else 0.2)


def test_a_driving_vehicle_without_vehicle_motion_gives_no_wrong_heading():
    made = Made(vehicle=False, vehicle_mps=5.0, rotations=False)
    poses = made.run(Fuse())
    assert {pose.state for pose in poses} == {LOST, POSITION_ONLY}
    assert made.judge(poses, after_s=3).rmse_m() < 0.3


@pytest.mark.parametrize("port", ["fix", "rotation", "odometry", "motion"])
def test_each_input_may_fail_and_return(port):
    made = Made(until_s=11, gaps_s={port: (4.0, 6.0)}, vehicle_mps=3.0, clock_hz=100)
    poses = made.run(Fuse())
    seen = made.judge(poses, after_s=2)
    assert max(b.stamp_ns - a.stamp_ns for a, b in pairwise(poses)) == 20_000_000
    assert max(seen.error_m) < (1.3 if port == "motion" else 0.8)  # fixes wait for vehicle motion that may only be late
    assert wrong(made, poses, deg=12) == 0
    assert poses[-1].state is FULL


@pytest.mark.parametrize("port", ["fix", "rotation", "odometry", "motion"])
def test_each_input_may_be_300_ms_late(port):
    made = Made(until_s=9, delays_s={port: 0.3}, vehicle_mps=3.0, clock_hz=100)
    seen = made.judge(made.run(Fuse()), after_s=4)
    assert set(seen.states) <= {FULL, COASTING}
    assert seen.rmse_m() < 0.15
    assert max(seen.angle_deg) < 2.0


def test_20_percent_of_false_fixes_and_rotations_have_little_effect():
    made = Made(until_s=9, outliers={"fix": 0.2, "rotation": 0.2})
    seen = made.judge(made.run(Fuse()), after_s=4)
    assert seen.rmse_m() < 0.15
    assert max(seen.angle_deg) < 3.0


# several drones


def test_the_lowest_track_is_followed_until_it_is_lost():
    stage, near = Fuse(), [5.0, 0, 10]
    poses = []
    for i in range(20):
        for number in (3, 2):
            poses += stage.on_track(track(0.1 * i, TrackingState.TRACKING, number))
        for number, at in ((3, [-8.0, 0, 12]), (2, near)):
            poses += stage.on_fix(fix(0.1 * i + 0.01, at, track_id=number))
    assert {pose.track_id for pose in poses[5:]} == {2}
    assert np.allclose(poses[-1].xyz_vehicle_m, near, atol=0.1)
    resets = poses[-1].resets
    poses += stage.on_track(track(2.0, TrackingState.LOST, 2))
    poses += [pose for i in range(5) for pose in stage.on_fix(fix(2.05 + 0.1 * i, [-8.0, 0, 12], track_id=3))]
    assert poses[-1].track_id == 3
    assert np.allclose(poses[-1].xyz_vehicle_m, [-8.0, 0, 12], atol=0.1)
    assert poses[-1].resets == resets + 1


def test_the_motion_of_another_track_gives_no_heading_of_the_new_one():
    made, stage = Made(until_s=16.0, rotations=False, gaps_s={"fix": (3.0, 99.0)}), Fuse()
    assert made.run(stage)[-1].state is LOST
    seen = stage._estimator.odometry_yaw.by_motion
    assert "moved" in seen.reason
    list(stage.on_track(track(16.0, TrackingState.LOST, 1)))
    list(stage.on_fix(fix(15.9, made.truth(15.9)[1], track_id=2)))
    list(stage.on_servo(servo(16.5)))
    assert stage._estimator.track_id == 2
    assert seen.reason == "collecting its motion"


def found_again(elsewhere_m, silent_s, moves=True):
    """States since another track was found, at 12 s, after a gap of `silent_s`, with their times."""
    made, stage = Made(until_s=16.0 + silent_s, rotations=False, speed_mps=3.0), Fuse()
    at_s, poses = 12.0 + silent_s, []
    for _, port, message in made.events():
        t = (message.stamp_ns - START_NS) / S
        if port == "fix" and t > 12.0:
            if t < at_s:
                continue
            if stage._estimator.track_id == 1:
                poses += stage.on_track(track(t, TrackingState.LOST, 1))
            there = made.truth(t if moves else at_s)[1] + elsewhere_m
            message = fix(t, there, track_id=2)
        poses += getattr(stage, f"on_{port}")(message)
    assert any(p.state is FULL for p in poses if p.stamp_ns < ns(12.0))
    return [(p.state, (p.stamp_ns - ns(at_s)) / S) for p in poses if p.stamp_ns > ns(at_s + 0.3)]


def test_another_track_at_the_propagated_pose_is_full_at_once():
    poses = found_again(0.0, silent_s=1.0)
    assert all(state is FULL for state, _ in poses)


def test_a_track_at_another_position_is_not_full_until_its_motion_matches_the_odometry():
    """Otherwise the remembered yaw would give a full pose for any lamp or bird that is tracked instead."""
    still = found_again(np.array([16.0, 12.0, -8.0]), silent_s=2.0, moves=False)
    assert all(state is not FULL for state, _ in still)
    moving = found_again(np.array([16.0, 12.0, -8.0]), silent_s=2.0)  # the drone; the propagated pose was wrong
    assert all(state is POSITION_ONLY for state, t in moving if t < 1.0)
    assert moving[-1][0] is FULL


def test_after_a_loss_the_drone_is_full_again_once_its_motion_matches_the_odometry():
    poses = found_again(0.0, silent_s=12.0)
    assert all(state is POSITION_ONLY for state, t in poses if t < 1.0)
    assert poses[-1][0] is FULL


def test_a_gap_of_an_hour_is_not_propagated_step_by_step(monkeypatch):
    made, stage = Made(until_s=6), Fuse(parked=True)
    assert made.run(stage)[-1].state is FULL
    monkeypatch.setattr(stage._estimator.chain, "extend", lambda *_: pytest.fail("step by step"))
    for t in (3600.0, 3600.1, 3600.2, 3600.3, 3600.4, 3600.5):  # the sixth stamp far ahead is accepted
        poses = list(stage.on_servo(servo(t)))
    assert poses[-1].state is LOST


def servo(t):
    return ServoState(stamp_ns=ns(t), position_rad=0.0, velocity_radps=0.0, goal_rad=0.0, error=0)


def test_the_wanted_track_is_the_only_one_followed():
    stage = Fuse(track_id=4)
    assert list(stage.on_fix(fix(0.0, [1, 2, 10], track_id=1)))[-1].state is LOST
    assert list(stage.on_fix(fix(0.1, [1, 2, 10], track_id=4)))[-1].state is POSITION_ONLY


# invalid messages


@pytest.mark.parametrize(
    ("spoilt", "why"),
    [
        (fix(0.5, [math.nan, 0, 10]), "fix: not finite"),
        (fix(0.5, [0, 0, 10], sigma=0.0), "fix: its covariance is not positive definite"),
        (fix(0.5, [0, 0, 10], sigma=math.nan), "fix: not finite"),
        (fix(0.5, [0, 0, 10], velocity=np.array([0, math.inf, 0])), "fix: not finite"),
        (fix(0.5, [0, 0, 10], bias_covariance_m2=np.full((3, 3), math.nan)), "fix: not finite"),
        (fix(0.5, [0, 0, 10], bias_covariance_m2=np.eye(3)), "fix: its covariance is not positive definite"),
        (fix(3000.0, [0, 0, 10]), "fix: from the future"),
        (fix(-30.0, [0, 0, 10]), "fix: older than the lag"),
    ],
)
def test_an_invalid_message_is_rejected_and_counted(spoilt, why):
    stage = Fuse()
    poses = [pose for i in range(5) for pose in stage.on_fix(fix(0.1 * i, [0, 0, 10]))]
    poses += stage.on_fix(spoilt)
    poses += stage.on_fix(fix(0.6, [0, 0, 10]))
    assert stage.rejected == {why: 1}
    assert poses[-1].stamp_ns == ns(0.6)
    assert np.allclose(poses[-1].xyz_vehicle_m, [0, 0, 10], atol=1e-6)


def test_a_rotation_that_is_not_finite_is_rejected():
    stage = Fuse()
    list(stage.on_fix(fix(0.0, [0, 0, 10])))
    list(stage.on_rotation(rotation(0.1, np.full((3, 3), math.nan))))
    assert stage.rejected == {"rotation: not finite": 1}


def test_a_position_only_covariance_is_in_the_frames_own_axes():
    stage = Fuse()
    long = fix(0.0, [0, 0, 10])
    object.__setattr__(long, "covariance_m2", np.diag([0.04, 0.0004, 0.01]))
    poses = list(stage.on_fix(long))
    assert poses[-1].state is POSITION_ONLY
    variances = np.diag(poses[-1].estimate.covariance_vehicle_m2)
    assert variances[0] > variances[2] > variances[1]


def test_before_any_fix_the_drone_is_lost_with_a_reason():
    poses = Made(until_s=1, gaps_s={"fix": (0, 99)}).run(Fuse())
    assert {pose.state for pose in poses} == {LOST}
    assert poses[-1].reason == "no drone is tracked"
    assert poses[-1].measured_ns is None
