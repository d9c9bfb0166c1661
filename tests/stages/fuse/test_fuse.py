"""The stage Fuse over short flights: decisions, states, absence, faults."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from stages.fuse import Fuse
from stages.geometry.frames import rotation_z
from stages.messages import DroneMotion, PoseEstimate, PoseState, PositionEstimate, TrackState
from tests.stages.fuse.imu_flights import ImuFlight, seconds
from tests.stages.fuse.judged import CHI2_95, fly, rms


def test_manoeuvres_decide_the_heading_by_imu_alone():
    flown = fly(ImuFlight(kind="fast", seed=2, until_s=14.0))
    assert flown.decided_s < 6.0
    assert flown.wrong == 0
    late = np.array(flown.yaw_deg[-200:])
    assert rms(late) < 4.0
    assert np.percentile(flown.error_m, 95) < 0.25


def test_a_hovering_drone_gets_a_position_and_no_heading():
    flown = fly(ImuFlight(kind="hover", seed=1, until_s=12.0, wind_mps=0.0))
    assert math.isinf(flown.decided_s)
    assert not any(flown.full)
    assert all(isinstance(p.estimate, PositionEstimate) for p in flown.poses if p.estimate is not None)
    assert np.percentile(flown.error_m, 95) < 0.25


def test_cameras_decide_a_hovering_drone_s_branch_only_when_it_moves():
    still = fly(ImuFlight(kind="hover", seed=1, until_s=8.0, wind_mps=0.0, rotations=True, images=True))
    moving = fly(ImuFlight(kind="manoeuvre", seed=1, until_s=8.0, rotations=True, images=True))
    assert math.isinf(still.decided_s)
    assert {p.state for p in still.poses[-50:]} == {PoseState.AMBIGUOUS}
    assert moving.decided_s < 3.0
    assert rms(np.array(moving.yaw_deg)) < 1.0


def test_a_wrong_compass_does_not_reach_the_output():
    right = fly(ImuFlight(kind="fast", seed=4, until_s=14.0, odometry=True))
    wrong = fly(ImuFlight(kind="fast", seed=4, until_s=14.0, odometry=True, compass_deg=30.0))
    assert wrong.wrong == 0
    assert wrong.decided_s < 10.0
    assert abs(float(np.mean(wrong.yaw_deg[-100:])) - float(np.mean(right.yaw_deg[-100:]))) < 2.0


def test_without_imu_and_cameras_there_are_positions_only():
    flown = fly(ImuFlight(kind="manoeuvre", seed=3, until_s=10.0, imu_hz=0))
    assert not any(flown.full)
    assert {p.state for p in flown.poses[-100:]} == {PoseState.POSITION_ONLY}
    assert np.mean(np.array(flown.nees_position) < CHI2_95) > 0.9


def test_without_imu_cameras_give_the_rotation():
    flown = fly(ImuFlight(kind="orbit", seed=3, until_s=10.0, imu_hz=0, rotations=True, images=True))
    assert flown.wrong == 0
    assert flown.full[-1]
    assert rms(np.array(flown.yaw_deg)) < 1.5


def test_without_the_vehicle_s_motion_the_imu_is_not_used():
    flight = ImuFlight(kind="manoeuvre", seed=3, until_s=8.0)
    stage, poses = Fuse(), []
    for _, port, message in flight.events():
        if port != "motion":
            poses += [m for m in getattr(stage, f"on_{port}")(message) if hasattr(m, "state")]
    assert {p.state for p in poses[100:]} == {PoseState.POSITION_ONLY}


def test_a_gap_without_lidar_positions_is_propagated_with_a_growing_sigma_until_it_is_lost():
    flown = fly(ImuFlight(kind="fast", seed=2, until_s=30.0, gaps_s=((12.0, 26.0),)))
    at = {round(seconds(p.stamp_ns), 2): p for p in flown.poses}
    assert at[11.0].state is PoseState.FULL
    assert at[13.0].state is PoseState.COASTING
    sigma = dict(zip(np.round(flown.at_s, 2), flown.sigma_m, strict=True))
    assert sigma[12.1] < sigma[13.0] < sigma[14.0]
    assert at[25.0].state is PoseState.LOST
    assert at[29.0].state is PoseState.FULL  # the heading was propagated by the gyroscope


def test_a_drone_that_is_found_again_far_away_needs_evidence_for_its_heading():
    stage = Fuse()
    memory = ImuFlight(kind="fast", seed=6, until_s=10.0)
    for _, port, message in memory.events():
        list(getattr(stage, f"on_{port}")(message))
    estimator = stage._estimator
    assert estimator.decided
    at_ns, last_m = estimator.stamp_ns, estimator.graph.state.xyz_m[0]
    estimator.lose()
    near, far = (estimator._memory.yaw(at_ns + 10, xyz_m, 0.01 * np.eye(3)) for xyz_m in (last_m, last_m + 500.0))
    assert near is not None
    assert far is not None
    assert near[2] > 0.999 > far[2]


@pytest.mark.parametrize("off_deg", [15.0, 25.0, 44.0])
def test_a_street_that_both_cameras_always_match_wrongly_does_not_reach_the_output(off_deg):
    """Every image has one match, stated as 96 % probable, that is off by the same angle."""
    made = ImuFlight(kind="fast", seed=6, until_s=16.0, rotations=True, images=True)

    def skewed(events):
        for at_ns, port, m in events:
            if port == "rotation":
                m = dataclasses.replace(m, rotations=rotation_z(math.radians(off_deg)) @ m.rotations)
            yield at_ns, port, m

    flown = fly(made, fault=skewed)
    assert flown.wrong == 0
    assert np.abs(flown.yaw_deg).max() < 10.0
    assert PoseState.FULL in {pose.state for pose in flown.poses[-100:]}


def test_false_lidar_positions_do_not_move_the_pose():
    clean = fly(ImuFlight(kind="fast", seed=5, until_s=12.0, fix_outliers=0.0))
    spoilt = fly(ImuFlight(kind="fast", seed=5, until_s=12.0, fix_outliers=0.15))
    assert spoilt.wrong == 0
    assert np.percentile(spoilt.error_m, 95) < np.percentile(clean.error_m, 95) + 0.1


def test_lidar_positions_of_another_object_end_in_a_state_that_sends_nothing():
    """What the LiDAR follows does not move as the IMU measures: another drone."""
    own, other = ImuFlight(kind="fast", seed=7, until_s=20.0), ImuFlight(kind="fast", seed=8, until_s=20.0)
    stage, states = Fuse(), {}
    theirs = [e for e in other.events() if e[1] == "fix" and seconds(e[2].stamp_ns) >= 8.0]
    ours = [e for e in own.events() if e[1] != "fix" or seconds(e[2].stamp_ns) < 8.0]
    for _, port, message in sorted(ours + theirs, key=lambda e: e[0]):
        for made in getattr(stage, f"on_{port}")(message):
            if hasattr(made, "state"):
                states[round(seconds(made.stamp_ns), 2)] = made
    assert states[7.5].state is PoseState.FULL
    late = [p for t, p in states.items() if t > 12.5]
    assert not any(isinstance(p.estimate, PoseEstimate) for p in late)
    assert {p.state for p in late} == {PoseState.LOST}


def test_the_time_of_the_measured_rotation_stands_still_in_a_gap_of_the_lidar():
    """The autopilot's gate compares it with now: it must not be renewed by the IMU alone."""
    poses = fly(ImuFlight(kind="fast", seed=2, until_s=12.0, gaps_s=((9.0, 11.0),))).poses
    coasting = [p for p in poses if 9.5 < seconds(p.stamp_ns) < 10.9 and isinstance(p.estimate, PoseEstimate)]
    assert len(coasting) > 10
    assert all(p.rotation_ns is not None and seconds(p.rotation_ns) < 9.1 for p in coasting)
    before = [p for p in poses if 8.0 < seconds(p.stamp_ns) < 9.0]
    assert all(p.rotation_ns is not None and p.stamp_ns - p.rotation_ns < 400_000_000 for p in before)


def test_an_object_that_is_not_the_drone_stays_lost_when_the_imu_ends():
    own, other = ImuFlight(kind="fast", seed=7, until_s=18.0), ImuFlight(kind="fast", seed=8, until_s=18.0)
    stage, states = Fuse(), {}
    theirs = [e for e in other.events() if e[1] == "fix" and seconds(e[2].stamp_ns) >= 8.0]
    ours = [e for e in own.events() if e[1] != "fix" or seconds(e[2].stamp_ns) < 8.0]
    for _, port, message in sorted(ours + theirs, key=lambda e: e[0]):
        if isinstance(message, DroneMotion) and seconds(message.stamp_ns) > 14.0:
            continue
        for made in getattr(stage, f"on_{port}")(message):
            if hasattr(made, "state"):
                states[round(seconds(made.stamp_ns), 2)] = made
    assert {p.state for t, p in states.items() if t > 12.5} == {PoseState.LOST}


def test_messages_that_are_not_finite_are_rejected_and_counted():
    stage = Fuse()
    for _, port, message in ImuFlight(kind="fast", seed=2, until_s=2.0).events():
        if isinstance(message, DroneMotion):
            bad = np.array([np.nan, 0.0, 0.0])
            message = _replaced(message, specific_force_drone_mps2=bad)
        list(getattr(stage, f"on_{port}")(message))
    assert stage.counters["rejected: drone motion: not finite"] > 50


def _replaced(message, **values):
    return dataclasses.replace(message, **values)


@pytest.mark.parametrize("gap_s", [0.4, 3.0])
def test_a_gap_in_the_imu_ends_in_a_correct_pose(gap_s):
    stage, poses = Fuse(), []
    flight = ImuFlight(kind="fast", seed=2, until_s=22.0)
    for _, port, message in flight.events():
        if isinstance(message, DroneMotion) and 10.0 <= seconds(message.stamp_ns) < 10.0 + gap_s:
            continue
        poses += [m for m in getattr(stage, f"on_{port}")(message) if hasattr(m, "state")]
    for pose in poses:
        t = seconds(pose.stamp_ns)
        if t > 1.0 and t < 22.0 and isinstance(pose.estimate, PoseEstimate):
            R = flight.truth(t)[0]
            off = pose.estimate.R_map_drone @ R.T
            assert abs(math.degrees(math.atan2(off[1, 0], off[0, 0]))) < 20.0
    assert poses[-30].state is PoseState.FULL


def test_two_runs_are_equal():
    events = ImuFlight(kind="fast", seed=2, until_s=6.0, rotations=True, images=True).events()

    def run():
        stage = Fuse()
        return [m for _, port, message in events for m in getattr(stage, f"on_{port}")(message) if hasattr(m, "state")]

    a, b = run(), run()
    assert all(np.array_equal(x.xyz_map_m, y.xyz_map_m) for x, y in zip(a, b, strict=True) if x.estimate is not None)


def test_no_track_means_lost():
    stage = Fuse()
    made = []
    for _, port, message in ImuFlight(kind="hover", until_s=1.0).events():
        if port != "fix" and not isinstance(message, TrackState):
            made += [m for m in getattr(stage, f"on_{port}")(message) if hasattr(m, "state")]
    assert {p.state for p in made} == {PoseState.LOST}
