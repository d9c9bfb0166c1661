"""What a user of the pose relies on: its times, frames and velocities, missing, late and invalid inputs, several drones."""

from __future__ import annotations

import dataclasses
import math
import resource
from itertools import pairwise

import numpy as np
import pytest

from stages.fuse import Fuse
from stages.messages import DroneMotion, PoseEstimate, PoseState, PositionEstimate, TrackingState
from tests.stages.fuse.fuse_inputs import clocked, fix, late, poses_of, rotation, servo, track, without
from tests.stages.fuse.imu_flights import ImuFlight, S, ns, seconds
from tests.stages.fuse.judged import CHI2_95, fly, rms

FULL, COASTING, LOST = PoseState.FULL, PoseState.COASTING, PoseState.LOST
PORTS = ("fix", "rotation", "visual_motion", "drone_motion", "motion")


@pytest.fixture(scope="module")
def flight():
    return ImuFlight(kind="fast", seed=2, until_s=11.0, vehicle_mps=3.0, rotations=True, images=True, odometry=True)


@pytest.fixture(scope="module")
def flown(flight):
    return fly(flight, fault=clocked)


def late_states(flown):
    return {p.state for p in flown.poses if 10.0 < seconds(p.stamp_ns) < 10.9}


def test_poses_are_published_every_20_ms_on_the_grid(flown):
    stamps = [pose.stamp_ns for pose in flown.poses]
    assert all(stamp % 20_000_000 == 0 for stamp in stamps)
    assert {b - a for a, b in pairwise(stamps)} == {20_000_000}


def test_headings_are_published_five_times_a_second(flown):
    assert {b.stamp_ns - a.stamp_ns for a, b in pairwise(flown.headings)} == {200_000_000}


def test_poses_in_vehicle_and_map_agree(flight, flown):
    full = [pose for pose in flown.poses if pose.state is FULL and seconds(pose.stamp_ns) < flight.until_s]
    assert len(full) > 400
    for pose in full[::20]:
        R, x = flight.vehicle(seconds(pose.stamp_ns))
        assert np.allclose(R @ pose.xyz_vehicle_m + x, pose.xyz_map_m, atol=0.03)
        assert np.allclose(R @ pose.R_vehicle_drone, pose.R_map_drone, atol=1e-2)


def test_velocities_are_over_ground_and_relative_to_the_vehicle(flight, flown):
    over_ground, relative = [], []
    for pose in flown.poses:
        t = seconds(pose.stamp_ns)
        if not 4.0 < t < 10.9:
            continue
        (R, x), (_, y) = flight.vehicle(t), flight.vehicle(t + 0.01)
        (_, xyz_m, v), (R_later, _) = flight.truth(t), flight.vehicle(t + 0.01)
        over_ground.append(np.linalg.norm(pose.estimate.velocity_map_mps - v))
        then, later = R.T @ (xyz_m - x), R_later.T @ (xyz_m + 0.01 * v - y)
        relative.append(np.linalg.norm(pose.estimate.velocity_vehicle_mps - (later - then) / 0.01))
    assert rms(np.array(over_ground)) < 0.3
    assert rms(np.array(relative)) < 0.35


@pytest.mark.parametrize("port", PORTS)
def test_each_input_may_fail_and_return(flight, port):
    failed = fly(flight, fault=without((port,), 6.0, 7.5))
    assert max(b.stamp_ns - a.stamp_ns for a, b in pairwise(failed.poses)) <= 100_000_000
    assert np.abs(failed.yaw_deg).max() < 12.0
    assert failed.wrong == 0
    assert FULL in late_states(failed)
    if port != "motion":  # the map frame ends with it: tests/stages/fuse/test_fuse_vehicle.py
        assert max(failed.error_m) < 1.0


@pytest.mark.parametrize("port", PORTS)
def test_each_input_may_be_300_ms_late(flight, port):
    behind = fly(flight, fault=late((port,), 0.3))
    states = {p.state for p in behind.poses if 6.0 < seconds(p.stamp_ns) < flight.until_s}
    assert states <= {FULL, COASTING}
    error_m = np.array(behind.error_m)[np.array(behind.at_s) > 6.0]
    assert np.percentile(error_m, 95) < 0.35
    assert rms(np.array(behind.yaw_deg)) < 3.0


def test_positions_that_arrive_late_leave_the_pose_as_uncertain_as_stated():
    """By IMU alone, with the heading unknown at first: each position has to count at its own time."""
    nees = []
    for seed in (1, 2, 3):
        behind = fly(ImuFlight(kind="square", seed=seed, until_s=12.0), fault=late(("fix",), 0.4))
        nees += behind.nees_position
        assert len(behind.nees_position) > 300
    assert np.mean(np.array(nees) < CHI2_95) > 0.93


def test_a_reported_bias_of_the_fixes_does_not_average_out():
    """It stays in the covariance; where it is not reported, the assumed share of a fourth is too little."""
    made = ImuFlight(kind="hover", seed=4, until_s=6.0, wind_mps=0.0, imu_hz=0.0)
    off_m = np.array([0.3, -0.2, 0.1])
    sigma = {}
    for reported in (True, False):

        def biased(events, reported=reported):
            for at_ns, port, m in events:
                if port == "fix":
                    bias = 0.3**2 * np.eye(3)
                    covariance_m2 = m.covariance_m2 + bias if reported else m.covariance_m2
                    xyz_m = m.xyz_vehicle_m + off_m
                    m = dataclasses.replace(
                        m,
                        xyz_vehicle_m=xyz_m,
                        covariance_m2=covariance_m2,
                        bias_covariance_m2=bias if reported else None,
                    )
                yield at_ns, port, m

        sigma[reported] = np.median(fly(made, fault=biased).sigma_m[-100:])
    assert 0.3 < sigma[True] < 0.4
    assert sigma[False] < 0.2


def test_a_gap_of_an_hour_is_not_propagated_step_by_step(flight, monkeypatch):
    stage = Fuse()
    assert poses_of(stage, flight.events())[-1].state is COASTING
    monkeypatch.setattr(stage._estimator.graph, "_extend", lambda *_: pytest.fail("step by step"))
    ahead = [(0, "servo", servo(3600.0 + 0.1 * k)) for k in range(6)]  # the sixth stamp far ahead is accepted
    assert poses_of(stage, ahead)[-1].state is LOST


# several drones


def test_the_lowest_track_is_followed_until_it_is_lost():
    stage, near, far = Fuse(), np.array([5.0, 0, 10]), np.array([-8.0, 0, 12])
    poses = []
    for i in range(20):
        for number in (3, 2):
            poses += stage.on_track(track(0.1 * i, TrackingState.TRACKING, number))
        for number, at in ((3, far), (2, near)):
            poses += stage.on_fix(fix(0.1 * i + 0.01, at, track_id=number))
    poses = [p for p in poses if hasattr(p, "state")]
    assert {pose.track_id for pose in poses[5:]} == {2}
    assert np.allclose(poses[-1].xyz_vehicle_m, near, atol=0.1)
    resets = poses[-1].resets
    events = [(0, "track", track(2.0, TrackingState.LOST, 2))]
    events += [(0, "fix", fix(2.05 + 0.1 * i, far, track_id=3)) for i in range(5)]
    poses += poses_of(stage, events)
    assert poses[-1].track_id == 3
    assert np.allclose(poses[-1].xyz_vehicle_m, far, atol=0.1)
    assert poses[-1].resets == resets + 1


def test_the_wanted_track_is_the_only_one_followed():
    stage = Fuse(track_id=4)
    assert poses_of(stage, [(0, "fix", fix(0.0, [1, 2, 10], track_id=1))])[-1].state is LOST
    assert poses_of(stage, [(0, "fix", fix(0.1, [1, 2, 10], track_id=4))])[-1].state is PoseState.POSITION_ONLY


def test_positions_of_the_track_before_that_wait_for_their_time_are_not_used(flight):
    stage = Fuse()
    poses_of(stage, [event for event in flight.events() if event[0] < ns(8.0)])
    near, far = (flight.truth(t)[1] + [off, 0, 0] for t, off in ((7.98, 0.0), (8.0, 40.0)))
    events = [(0, "fix", fix(7.98, near, track_id=1)), (0, "track", track(8.0, TrackingState.LOST, 1))]
    events += [(0, "fix", fix(8.0, far, track_id=2))]
    poses = poses_of(
        stage, [*events, *(event for event in flight.events() if event[1] != "fix" and event[0] > ns(8.0))]
    )
    first = next(pose for pose in poses if pose.track_id == 2 and pose.state is not LOST)
    assert np.linalg.norm(first.xyz_vehicle_m - far) < 3.0


def test_the_motion_of_another_track_is_no_evidence_for_the_new_one(flight):
    """What the ownership, the odometry and the bank have collected ends with the track."""
    stage = Fuse()
    poses_of(stage, without(("fix", "track", "rotation", "visual_motion"), 8.0)(flight.events()))
    estimator = stage._estimator
    assert estimator.decided
    assert estimator.odometry.confirmed
    far = fix(11.4, flight.truth(11.4)[1] + [40.0, 0, 0], track_id=2)
    poses = poses_of(
        stage, [(0, "track", track(11.35, TrackingState.LOST, 1)), (0, "fix", far), (0, "servo", servo(11.7))]
    )
    assert poses[-1].track_id == 2
    assert not isinstance(poses[-1].estimate, PoseEstimate)
    assert not estimator.decided
    assert not estimator.odometry.confirmed
    assert not estimator.ownership.certain


# single and invalid messages


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
        (rotation(0.5, np.full((3, 3), math.nan)), "rotation: not finite"),
        (rotation(0.5, np.eye(3), sigma_rad=0.0), "rotation: its covariance is not positive definite"),
    ],
)
def test_an_invalid_message_is_rejected_and_counted(spoilt, why):
    stage = Fuse()
    poses = poses_of(stage, [(0, "fix", fix(0.1 * i, [0, 0, 10])) for i in range(5)])
    poses += poses_of(stage, [(0, why.split(":")[0], spoilt), (0, "fix", fix(0.6, [0, 0, 10]))])
    assert stage.counters.rejected == {why: 1}
    assert poses[-1].stamp_ns == ns(0.6)
    assert np.allclose(poses[-1].xyz_vehicle_m, [0, 0, 10], atol=1e-6)


def test_a_position_only_covariance_is_in_the_axes_of_its_frame():
    long = dataclasses.replace(fix(0.0, [0, 0, 10]), covariance_m2=np.diag([0.04, 0.0004, 0.01]))
    pose = poses_of(Fuse(), [(0, "fix", long)])[-1]
    assert isinstance(pose.estimate, PositionEstimate)
    variances = np.diag(pose.estimate.covariance_vehicle_m2)
    assert variances[0] > variances[2] > variances[1]


@pytest.mark.parametrize("rotations", [True, False])
def test_the_published_position_covariance_is_in_the_axes_of_its_frame(flight, rotations):
    """Fixes are ten times worse along x of the vehicle; the drone's yaw is any. In drone axes where it is known."""
    made = dataclasses.replace(flight, vehicle_mps=0.0, rotations=rotations, images=rotations, until_s=6.0)

    def worse(events):
        for at_ns, port, m in events:
            if port == "fix":
                m = dataclasses.replace(m, covariance_m2=np.diag([0.7, 0.07, 0.07]) ** 2)
            if port != "drone_motion" or rotations:
                yield at_ns, port, m

    pose = [p for p in fly(made, fault=worse).poses if seconds(p.stamp_ns) < 6.0][-1]
    estimate = pose.estimate
    P = estimate.covariance_vehicle_m2 if isinstance(estimate, PositionEstimate) else None
    if P is None:
        assert rotations
        R = estimate.R_vehicle_drone
        assert abs(R[0, 0]) < 0.95  # the drone's x is not the vehicle's
        P = R @ estimate.covariance[3:, 3:] @ R.T
        assert np.allclose(estimate.map_covariance[3:, 3:], estimate.covariance[3:, 3:], rtol=0.2)
    sigma = np.sqrt(np.diag(P))
    assert sigma[0] > 2.0 * sigma[1]
    assert abs(P[0, 1]) < 0.5 * sigma[0] * sigma[1]


def test_before_any_fix_the_drone_is_lost_with_a_reason(flight):
    poses = poses_of(Fuse(), without(("fix", "track"))(flight.events())[:200])
    assert {pose.state for pose in poses} == {LOST}
    assert poses[-1].reason == "no drone is tracked"
    assert poses[-1].measured_ns is None


@pytest.mark.slow
def test_memory_is_constant_over_an_hour(flight):
    stage, events, peaks_mb = Fuse(), [e for e in flight.events() if e[1] not in ("rotation", "visual_motion")], []
    for lap in range(330):  # of 11 s
        for _, port, message in events:
            moved = {"stamp_ns": message.stamp_ns + lap * 11 * S}
            if isinstance(message, DroneMotion):
                moved["start_ns"] = message.start_ns + lap * 11 * S
            list(getattr(stage, f"on_{port}")(dataclasses.replace(message, **moved)))
        peaks_mb.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)  # GTSAM's included
    print(f"\npeak after 10 min {peaks_mb[54]:.1f} MB, after 60 min {peaks_mb[-1]:.1f} MB")  # noqa: T201
    assert peaks_mb[-1] < peaks_mb[54] + 5.0
