"""Yaw of the autopilot's frame `odom` in `map`, as the pose reports it; nothing of it for another object."""

from __future__ import annotations

import dataclasses
import math

import pytest

from stages.fuse import Fuse
from stages.geometry.frames import heading_rad
from stages.messages import DroneMotion, PoseEstimate
from tests.stages.fuse.fuse_inputs import poses_of
from tests.stages.fuse.imu_flights import ImuFlight, seconds

CHANGED_S = 9.0


@pytest.fixture(scope="module")
def flight():
    """A compass that is wrong by 90 deg; no cameras."""
    return ImuFlight(kind="fast", seed=4, until_s=12.0, odometry=True, compass_deg=90.0)


def true_yaw_rad(events, flight):
    """By the velocities over ground in both frames."""
    pairs = [(m.autopilot.velocity_odom_mps, flight.truth(seconds(m.stamp_ns))[2]) for _, _, m in motions(events)]
    total = sum(complex(*v[:2]) * complex(*own[:2]).conjugate() for own, v in pairs)
    return math.atan2(total.imag, total.real)


def motions(events):
    return [e for e in events if isinstance(e[2], DroneMotion)]


def changed(events, change):
    """The autopilot's estimate is another one from a time on."""
    for at_ns, port, m in events:
        if isinstance(m, DroneMotion) and seconds(m.stamp_ns) > CHANGED_S:
            m = dataclasses.replace(m, autopilot=change(m.autopilot))
        yield at_ns, port, m


def of_the_attitude_rad(events, flight):
    """(stamp, yaw of the axes of the autopilot's attitude in `map`) of each motion."""
    return [
        (m.stamp_ns, heading_rad(flight.truth(seconds(m.stamp_ns))[0]) - heading_rad(m.autopilot.R_odom_drone))
        for _, _, m in motions(events)
    ]


def off_deg(pose, yaw_rad):
    return math.degrees(abs(math.remainder(pose.odom_yaw_rad - yaw_rad, 2 * math.pi)))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_with_cameras_the_axes_are_those_of_the_attitude_until_the_motion_shows_them(seed):
    """A compass that is wrong by several degrees; the drone turns."""
    turning = ImuFlight(kind="manoeuvre", seed=seed, until_s=12.0, odometry=True, compass_deg=4.0, rotations=True)
    events = turning.events()
    of_attitude = of_the_attitude_rad(events, turning)
    known = [p for p in poses_of(Fuse(), events) if p.odom_yaw_rad is not None]
    by_attitude = [p for p in known if p.odom_yaw_sigma_rad < math.radians(1.0)]
    assert len(by_attitude) > 50
    for pose in by_attitude[::5]:
        off = off_deg(pose, at_time(of_attitude, pose.stamp_ns))
        assert off < 3.0 * math.degrees(pose.odom_yaw_sigma_rad)
        assert off < 2.0


def at_time(rows, stamp_ns):
    return min(rows, key=lambda row: abs(row[0] - stamp_ns))[1]


def at(poses, t_s):
    return next(p for p in poses if seconds(p.stamp_ns) >= t_s)


def test_it_is_right_within_its_sigma_with_a_wrong_compass(flight):
    events = flight.events()
    poses, true_rad = poses_of(Fuse(), events), true_yaw_rad(events, flight)
    known = [p for p in poses if p.odom_yaw_rad is not None]
    assert seconds(known[0].stamp_ns) < 6.0
    for pose in known[::10]:
        off_rad = abs(math.remainder(pose.odom_yaw_rad - true_rad, 2 * math.pi))
        assert off_rad < 3.0 * pose.odom_yaw_sigma_rad + math.radians(1.0)
    assert known[-1].odom_yaw_sigma_rad < math.radians(4.0)


def test_it_stays_when_the_telemetry_is_no_longer_independent(flight):
    poses = poses_of(Fuse(), changed(flight.events(), lambda _: None))
    before, end = at(poses, CHANGED_S - 0.2), at(poses, 11.8)
    assert before.odom_yaw_rad is not None
    assert end.odom_yaw_rad == pytest.approx(before.odom_yaw_rad, abs=0.02)


def test_a_new_segment_of_the_odometry_drops_it(flight):
    poses = poses_of(Fuse(), changed(flight.events(), lambda own: dataclasses.replace(own, odom_segment=1)))
    assert at(poses, CHANGED_S - 0.2).odom_yaw_rad is not None
    assert at(poses, CHANGED_S + 0.6).odom_yaw_rad is None


def test_it_is_not_known_for_a_drone_that_does_not_move():
    hover = ImuFlight(kind="hover", seed=1, until_s=6.0, wind_mps=0.0, odometry=True)
    assert {p.odom_yaw_rad for p in poses_of(Fuse(), hover.events())} == {None}


# another drone from the start: its LiDAR positions with the IMU of this one


def other_object(own, theirs):
    drone, other = (ImuFlight(kind="fast", seed=seed, until_s=8.0, odometry=True) for seed in (own, theirs))
    events = [e for e in drone.events() if e[1] != "fix"] + [e for e in other.events() if e[1] == "fix"]
    return sorted(events, key=lambda e: e[0])


@pytest.mark.parametrize(("own", "theirs"), [(5, 8), (6, 3), (4, 9)])
def test_it_is_not_known_for_an_object_that_moves_otherwise_than_the_drone(own, theirs):
    assert all(p.odom_yaw_rad is None for p in poses_of(Fuse(), other_object(own, theirs)))


@pytest.mark.parametrize(("own", "theirs"), [(7, 8), (6, 3), (4, 9)])
def test_an_object_that_was_never_the_drone_gets_no_rotation(own, theirs):
    """Its heading may be decided by chance: whether it is the drone is decided separately."""
    events = [
        (at_ns, port, dataclasses.replace(m, autopilot=None) if isinstance(m, DroneMotion) else m)
        for at_ns, port, m in other_object(own, theirs)
    ]
    assert not any(isinstance(p.estimate, PoseEstimate) for p in poses_of(Fuse(), events))
