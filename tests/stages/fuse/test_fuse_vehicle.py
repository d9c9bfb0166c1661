"""The vehicle's odometry missing, late or false: every position is transformed by it."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import pytest

from stages.fuse import Fuse
from stages.fuse.fix_covariance import fix_covariance
from stages.fuse.map_frame import MapChange, MapFrame
from stages.fuse.settings import FuseErrors
from stages.geometry.frames import Array64, heading_rad, rotation_z
from stages.geometry.trajectory import VehicleTrajectory
from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import DroneFix, HeadingPrior, MotionStatus, PoseEstimate, PoseState, VehicleMotion
from tests.stages.fuse.fuse_inputs import late, outliers, poses_of, without
from tests.stages.fuse.imu_flights import ImuFlight, ns, seconds
from tests.stages.fuse.judged import CHI2_95, VEHICLE, Flown, fly, rms

FULL, COASTING = PoseState.FULL, PoseState.COASTING
END_S = 11.9


@pytest.fixture(scope="module")
def driving():
    """With cameras, so that the heading is known within 3 s."""
    return ImuFlight(kind="fast", seed=3, until_s=12.0, vehicle_mps=6.0, rotations=True, images=True)


@pytest.fixture(scope="module")
def unharmed(driving):
    return fly(driving, frame=VEHICLE)


def drive(t, x=0.0, yaw=0.0):
    return VehicleMotion(
        stamp_ns=ns(t), xyz_map_m=np.array([6.0 * t + x, 0.0, 0.0]), R_map_vehicle=rotation_z(yaw), covariance=None
    )


def after(flown: Flown, from_s: float, until_s: float = math.inf):
    """States of the poses between two times, and rows of their errors."""
    states = {p.state for p in flown.poses if from_s < seconds(p.stamp_ns) < min(until_s, END_S)}
    return states, np.array([from_s < t < until_s for t in flown.at_s])


def test_a_drone_over_a_driving_vehicle_is_full(unharmed):
    states, rows = after(unharmed, 4.0)
    assert states <= {FULL, COASTING}
    assert rms(np.array(unharmed.error_m)[rows]) < 0.15
    assert unharmed.wrong == 0


def test_20_percent_of_false_vehicle_poses_have_no_effect(driving, unharmed):
    flown = fly(driving, fault=outliers(("motion",), 0.2), frame=VEHICLE)
    states, rows = after(flown, 4.0)
    assert states <= {FULL, COASTING}
    assert rms(np.array(flown.error_m)[rows]) < rms(np.array(unharmed.error_m)[rows]) + 0.05
    assert np.abs(flown.yaw_deg).max() < 5.0


def test_late_vehicle_motion_increases_the_covariance_but_hardly_the_error(driving, unharmed):
    flown = fly(driving, fault=late(("motion",), 0.3), frame=VEHICLE)
    states, rows = after(flown, 4.0)
    assert states <= {FULL, COASTING}
    assert np.mean(np.array(flown.nees_position)[rows] < CHI2_95) > 0.9
    assert rms(np.array(flown.sigma_m)[rows]) > 1.3 * rms(np.array(unharmed.sigma_m)[after(unharmed, 4.0)[1]])
    assert rms(np.array(flown.error_m)[rows]) < 0.3


def test_missing_vehicle_motion_ends_full_until_it_returns(driving):
    flown = fly(driving, fault=without(("motion",), 5.0, 7.0), frame=VEHICLE)
    silent, rows = after(flown, 6.1, 6.9)
    assert silent <= {PoseState.POSITION_ONLY, PoseState.AMBIGUOUS}
    assert np.array(flown.error_m)[rows].max() < 1.0  # relative to the vehicle the position is still measured
    assert FULL in after(flown, 11.0)[0]
    assert flown.wrong == 0


def jumped(from_s, deg=115.0, xyz_m=(200.0, 0.0, 0.0)):
    """Events with another map frame from a time on, turned about the vehicle's next place and displaced."""
    R = rotation_z(math.radians(deg))

    def fault(events):
        about_m = None
        for at_ns, port, message in events:
            if port == "motion" and message.stamp_ns >= ns(from_s):
                about_m = message.xyz_map_m if about_m is None else about_m
                moved_m = R @ (message.xyz_map_m - about_m) + about_m + np.array(xyz_m)
                message = dataclasses.replace(message, xyz_map_m=moved_m, R_map_vehicle=R @ message.R_map_vehicle)
            yield at_ns, port, message

    return fault


@pytest.mark.parametrize("silent_s", [0.0, 1.5])
def test_a_jump_of_the_map_frame_resets_the_estimate(driving, silent_s):
    """Relative to the vehicle no pose is wrong, in the new frame either."""
    gap, jump = without(("motion",), 6.0, 6.0 + silent_s), jumped(6.0)
    flown = fly(driving, fault=lambda events: jump(gap(events)), frame=VEHICLE)
    off, sigma = np.array(flown.error_m), np.array(flown.sigma_m)
    rows = after(flown, 1.0)[1]
    assert np.mean((off > 0.5 + 3.0 * sigma)[rows]) < 0.01
    assert np.abs(flown.yaw_deg).max() < 20.0
    assert FULL in after(flown, 11.0)[0]
    assert flown.poses[-1].resets > next(p.resets for p in flown.poses if p.state is FULL)
    assert not any(p.state is FULL for p in flown.poses if 6.4 + silent_s < seconds(p.stamp_ns) < 6.6 + silent_s)


# an outage of the vehicle's motion, by IMU alone

OUTAGE_S = 20.0, 23.0


def by_imu(seed, mps=5.0):
    return ImuFlight(kind="manoeuvre", seed=seed, until_s=27.0, vehicle_mps=mps)


def full_again_s(flown: Flown) -> float:
    """From the end of the outage to the first pose with a rotation; infinite: none."""
    stamps = [seconds(p.stamp_ns) for p in flown.poses if p.state is FULL and seconds(p.stamp_ns) > OUTAGE_S[1]]
    return min(stamps, default=math.inf) - OUTAGE_S[1]


def yaws_after(flown: Flown, from_s: float):
    """Errors of the yaw [deg]."""
    at_s = np.array(flown.at_s)[np.array(flown.full)]
    return np.array(flown.yaw_deg)[at_s > from_s]


@dataclass
class Following(ImuFlight):
    """The drone flies about a place beside the vehicle; its LiDAR positions have a tracker's velocity."""

    beside_m: float = 5.0

    def _goal(self, t):
        flown = super()._goal(t)
        at = np.array([x + R @ [self.beside_m, 0.0, 0.0] for R, x in map(self.vehicle, t)])
        at[:, :2] += 0.5 * (flown - flown[0])[:, :2]
        at[:, 2] = flown[:, 2]
        return at

    def _fixes(self):
        rng = np.random.default_rng([self.seed, 5])
        for at, port, fix in super()._fixes():
            if port == "fix":
                t = seconds(fix.stamp_ns)
                relative_m = [R.T @ (self.truth(s)[1] - x) for s in (t, t + 0.01) for R, x in [self.vehicle(s)]]
                velocity = (relative_m[1] - relative_m[0]) / 0.01 + rng.normal(0, 0.4, 3)
                fix = dataclasses.replace(fix, velocity_vehicle_mps=velocity)
            yield at, port, fix


@pytest.mark.parametrize(("mps", "late_s"), [(0.0, 0.0), (5.0, 0.0), (5.0, 0.2)])
@pytest.mark.parametrize("seed", [1, 2, *(pytest.param(k, marks=pytest.mark.slow) for k in range(3, 7))])
def test_after_an_outage_in_the_same_frame_the_heading_is_known_again_soon(seed, mps, late_s):
    """LiDAR positions that arrive during the outage are not compared, however late they are."""
    gap, delay = without(("motion",), *OUTAGE_S), late(("fix",), late_s)
    flown = fly(by_imu(seed, mps), fault=lambda events: delay(gap(events)), frame=VEHICLE)
    assert flown.wrong == 0
    assert np.abs(yaws_after(flown, OUTAGE_S[1])).max() < 8.0
    assert full_again_s(flown) < 3.2


@pytest.mark.parametrize(
    ("mps", "deg", "beside_m"),
    [(0.0, 8.0, 0.5), (0.0, 115.0, 5.0), (5.0, 60.0, 0.5), (5.0, 30.0, 5.0), (5.0, 60.0, 5.0)],
)
@pytest.mark.parametrize("seed", [1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3))])
def test_after_an_outage_another_frame_is_not_taken_for_the_same(seed, mps, deg, beside_m):
    """It is turned about the vehicle, as when an odometry restarts there with another yaw."""
    gap, jump = without(("motion",), *OUTAGE_S), jumped(OUTAGE_S[1], deg, xyz_m=(0.0, 0.0, 0.0))
    flown = fly(
        Following(seed=seed, until_s=27.0, vehicle_mps=mps, beside_m=beside_m),
        fault=lambda events: jump(gap(events)),
        frame=VEHICLE,
    )
    assert flown.wrong == 0
    assert math.isinf(full_again_s(flown))


def test_a_second_outage_soon_after_the_first_has_the_same_prior():
    twice = without(("motion",), 23.6, 27.0)(without(("motion",), *OUTAGE_S)(by_imu(1).events()))
    assert prior_of(stage_after(twice), 25.5) is not None


def with_priors(events, flight, turned_rad=0.0):
    """Events with the drone by the autopilot since an earlier run of grd."""
    made = []
    for t in np.arange(0.3, flight.until_s, 0.1):
        R, xyz_m, velocity = flight.truth(t)
        prior = HeadingPrior(
            stamp_ns=ns(t),
            yaw_map_rad=heading_rad(R) + turned_rad,
            yaw_map_odom_rad=0.3,
            sigma_rad=0.03,
            xyz_map_m=xyz_m,
            position_sigma_m=math.hypot(0.5, 0.05 * (t + 2.0) ** 2),
            velocity_map_mps=velocity,
            velocity_sigma_mps=0.3,
        )
        made.append((ns(t) + 1, "prior", prior))
    return sorted([*events, *made], key=lambda event: event[0])


@pytest.mark.parametrize(("from_s", "silent_s", "mps"), [(6.0, 0.0, 0.0), (6.0, 1.5, 0.0), (0.7, 2.5, 1.0)])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_heading_of_an_earlier_run_does_not_hold_in_another_map_frame(from_s, silent_s, mps, seed):
    """The drone is near the vehicle, about which the frame has turned: without a gap, or in one."""
    flight = Following(seed=seed, until_s=14.0, vehicle_mps=mps, beside_m=1.0)
    gap, jump = without(("motion",), from_s, from_s + silent_s), jumped(from_s + silent_s, 25.0, xyz_m=(0.0, 0.0, 0.0))
    flown = fly(flight, fault=lambda events: with_priors(jump(gap(events)), flight), frame=VEHICLE)
    assert any(full and t < from_s for t, full in zip(flown.at_s, flown.full, strict=True)) is (from_s > 2.0)
    assert np.abs(yaws_after(flown, from_s)).max(initial=0.0) < 10.0


def test_axes_of_an_earlier_run_end_with_a_contradiction():
    """Its heading is wrong, as after a reset of the autopilot's yaw while grd was down; its position is right."""
    flight = ImuFlight(kind="fast", seed=2, until_s=12.0)
    poses = poses_of(Fuse(), with_priors(flight.events(), flight, turned_rad=math.pi / 2))
    axes = [pose.odom_yaw_rad for pose in poses]
    known = [k for k, yaw in enumerate(axes) if yaw is not None]
    assert known
    assert len(known) == known[-1] - known[0] + 1
    assert axes[-1] is None


@pytest.mark.parametrize("late_s", [0.0, 0.6])
def test_axes_of_an_earlier_run_hold_while_the_drone_turns(late_s: float):
    """By 170 deg/s: a LiDAR position that is used late is compared with the yaw of its own time."""
    flight = ImuFlight(kind="fast", seed=2, until_s=12.0, turn_radps=3.0)
    poses = poses_of(Fuse(), late(("fix",), late_s)(with_priors(flight.events(), flight)))
    assert any(isinstance(pose.estimate, PoseEstimate) for pose in poses)
    assert poses[-1].odom_yaw_rad == 0.3


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_axes_that_independent_telemetry_shows_in_another_frame_are_kept(seed: int):
    """The heading from before the outage is contradicted; the axes are measured after it."""
    flight = ImuFlight(kind="fast", seed=seed, until_s=20.0, odometry=True, vehicle_mps=5.0)
    gap, jump = without(("motion",), 8.0, 10.0), jumped(10.0, 90.0, xyz_m=(0.0, 0.0, 0.0))
    axes = [pose.odom_yaw_rad for pose in poses_of(Fuse(), jump(gap(flight.events()))) if pose.stamp_ns > ns(10.1)]
    known = [k for k, yaw in enumerate(axes) if yaw is not None]
    assert len(known) == len(axes) - known[0]


def test_poses_of_the_vehicle_that_arrive_too_late_do_not_end_an_outage():
    silent = [e for e in by_imu(1).events() if e[1] != "motion" or e[2].stamp_ns < ns(20.0)]
    backlog = [(ns(21.6) + k, "motion", e[2]) for k, e in enumerate(by_imu(1).events()) if e[1] == "motion"]
    backlog = [e for e in backlog if ns(20.7) <= e[2].stamp_ns < ns(20.9)]
    stage = stage_after(sorted([*silent, *backlog], key=lambda e: e[0]))
    assert len(backlog) >= 3
    assert not stage._estimator.map_fixed
    assert not stage._estimator.earlier._same_frame._first


def test_the_heading_before_an_outage_waits_for_the_imu():
    """Poses of the vehicle are withdrawn: positions since then are used before the IMU is."""
    flight = Following(seed=1, until_s=23.5, beside_m=1.0)
    withdrawn = next(m for _, port, m in flight.events() if port == "motion" and m.stamp_ns >= ns(19.05))
    denied = dataclasses.replace(withdrawn, status=MotionStatus.DENIED)
    events = sorted([*flight.events(), (ns(20.0) + 5, "motion", denied)], key=lambda event: event[0])
    flown = fly(flight, fault=lambda _: events, frame=VEHICLE)
    assert min(t for t, full in zip(flown.at_s, flown.full, strict=True) if full and t > 20.3) < 22.0


def stage_after(events) -> Fuse:
    """The stage after these events."""
    stage = Fuse()
    poses_of(stage, events)
    return stage


def prior_of(stage: Fuse, t: float):
    return stage._estimator.earlier._outage.prior(ns(t))


def test_during_an_outage_nothing_is_compared_with_the_state_before():
    """`map` moves with the vehicle then."""
    stage = stage_after(without(("motion",), 20.0, 27.0)([e for e in by_imu(1).events() if e[0] < ns(20.95)]))
    assert not stage._map_frame.is_fixed(ns(20.95))
    assert prior_of(stage, 20.9) is not None
    assert not stage._estimator.earlier._same_frame._first


def slow(events):
    """Poses of the vehicle at 5 Hz, 0.2 s late."""
    return late(("motion",), 0.2)([e for e in events if e[1] != "motion" or e[2].stamp_ns // 10**7 % 20 == 0])


@pytest.mark.parametrize("change", [slow, list])
def test_after_a_jump_without_a_gap_the_frame_is_another_one_also_of_a_slow_odometry(change):
    """It is turned about the vehicle; the prior would hold for a drone that is above it."""
    events = by_imu(3, 0.0).events()
    before = [e for e in change(events) if e[0] < ns(22.0)]
    assert prior_of(stage_after(change(without(("motion",), 20.0, 27.0)(events))), 22.0) is not None
    assert prior_of(stage_after(change(jumped(20.0, 25.0, xyz_m=(0.0, 0.0, 0.0))(before))), 22.0) is None


def test_what_was_contradicted_is_no_prior_after_an_outage():
    """The LiDAR's positions are those of another object from a time on."""

    def moved(events):
        for at_ns, port, m in events:
            if port == "fix" and m.stamp_ns >= ns(19.0):
                m = dataclasses.replace(m, xyz_vehicle_m=m.xyz_vehicle_m + np.array([4.0, 0.0, 0.0]))
            yield at_ns, port, m

    silent = without(("motion",), 20.4, 27.0)
    events = by_imu(1, 0.0).events()
    assert prior_of(stage_after(silent(events)), 22.0) is not None
    assert prior_of(stage_after(moved(silent(events))), 22.0) is None


@pytest.mark.parametrize(("deg", "same"), [(0.0, True), (25.0, False)])
def test_the_axes_of_the_autopilot_are_known_again_in_the_same_frame_only(deg, same):
    """Its odometry contains poses of grd from 15 s on, and is not used any more."""

    def dependent(events):
        for at_ns, port, m in events:
            if port == "drone_motion" and m.stamp_ns >= ns(15.0):
                m = dataclasses.replace(m, autopilot=None)
            yield at_ns, port, m

    flight = Following(seed=1, until_s=27.0, vehicle_mps=5.0, odometry=True)
    turned = jumped(OUTAGE_S[1], deg, xyz_m=(0.0, 0.0, 0.0))
    poses = poses_of(Fuse(), dependent(turned(without(("motion",), *OUTAGE_S)(flight.events()))))
    before = next(p for p in poses if seconds(p.stamp_ns) > 19.5).odom_yaw_rad
    after_ = poses[-1].odom_yaw_rad
    assert before is not None
    assert after_ == (pytest.approx(before) if same else None)


def test_odometry_in_large_map_coordinates_works(driving, unharmed):
    far_m, stage = np.array([2e4, -5e4, 100.0]), Fuse()

    def moved(events):
        for at_ns, port, message in events:
            if port == "motion":
                message = dataclasses.replace(message, xyz_map_m=message.xyz_map_m + far_m)
            yield at_ns, port, message

    far = fly(driving, stage, moved, frame=VEHICLE)
    assert stage.counters.totals == {}
    assert rms(np.array(far.error_m)) == pytest.approx(rms(np.array(unharmed.error_m)), rel=0.05)


# the map frame by itself


def filled(*motions):
    frame = MapFrame(parked=False)
    return frame, [frame.add(motion) for motion in motions]


def test_one_jumping_pose_is_rejected_and_three_consistent_ones_are_a_new_map_frame():
    frame, new = filled(*(drive(0.02 * i) for i in range(20)))
    assert new == [MapChange.START, *[None] * 19]  # before the first pose the map frame was the vehicle's
    assert not frame.add(drive(0.40, x=3.0))
    assert not frame.add(drive(0.42))
    assert frame.vehicle.at(ns(0.42))[1][0] == pytest.approx(6.0 * 0.42)
    assert [frame.add(drive(t, x=3.0, yaw=0.5)) for t in (0.44, 0.46, 0.47, 0.48)] == [None, None, MapChange.JUMP, None]
    R, t = frame.vehicle.at(ns(0.48))
    assert t[0] == pytest.approx(6.0 * 0.48 + 3.0)
    assert math.atan2(R[1, 0], R[0, 0]) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("x", "yaw", "change"),
    [
        (0.0, 0.03, MapChange.GAP),
        (0.0, 0.1, MapChange.JUMP),
        (0.0, -0.1, MapChange.JUMP),
        (2.0, 0.5, MapChange.GAP),
        (4.0 * math.sqrt(2.0), math.pi / 2, MapChange.GAP),  # a quarter of a circle
        (8.1, math.pi, MapChange.GAP),
        (2.0, 0.7, MapChange.JUMP),
    ],
)
def test_a_vehicle_that_was_silent_has_turned_no_more_than_along_an_arc(x, yaw, change):
    def parked(t, x=0.0, yaw=0.0):
        return dataclasses.replace(drive(t, yaw=yaw), xyz_map_m=np.array([x, 0.0, 0.0]))

    frame, _ = filled(*(parked(0.02 * i) for i in range(5)))
    assert [frame.add(parked(3.0 + 0.02 * i, x, yaw)) for i in range(3)] == [None, None, change]


@pytest.mark.parametrize("off", [{"x": 2.0}, {"yaw": 0.7}])
def test_after_missing_poses_a_false_one_is_still_rejected(off):
    """Visual odometry has five poses per second: the gaps are long, but the possible motion in them is bounded."""
    frame, _ = filled(*(drive(t) for t in (0.2, 0.4, 0.6, 0.8, 1.0)), drive(1.6, **off))
    np.testing.assert_allclose(frame.vehicle.at(ns(1.2))[1], (7.2, 0.0, 0.0), atol=1e-6)
    frame.add(drive(1.65))
    np.testing.assert_allclose(frame.vehicle.at(ns(1.65))[1], (9.9, 0.0, 0.0), atol=1e-6)


def test_the_map_frame_is_fixed_while_the_vehicle_s_motion_is_known_or_it_is_parked():
    frame, _ = filled(drive(0.0))
    assert frame.is_fixed(ns(0.6))
    assert not frame.is_fixed(ns(0.8))
    assert not MapFrame(parked=False).is_fixed(ns(0.0))
    assert MapFrame(parked=True).is_fixed(ns(0.0))


def test_beyond_its_newest_pose_a_vehicle_may_have_braked_and_turned():
    """a dt^2 / 2 each way, alpha dt^2 / 2 across; from 0.3 s on, where the trajectory ends, its whole displacement."""
    frame, _ = filled(*(drive(0.02 * i) for i in range(5)))
    place = np.array([3.0, 4.0, 12.0])
    assert not frame.vehicle_covariance_m2(ns(0.06), place)[0].any()
    shift_m, yaw_rad = 0.5 * 2.0 * 0.2**2, 0.5 * 0.2 * 0.2**2
    across = np.array([-4.0, 3.0, 0.0])
    covariance, yaw_rad2, lever = frame.vehicle_covariance_m2(ns(0.28), place)
    assert np.allclose(lever, across)
    assert yaw_rad2 == pytest.approx(yaw_rad**2)
    assert np.allclose(covariance, shift_m**2 * np.eye(3) + yaw_rad**2 * np.outer(across, across))
    later, _, _ = frame.vehicle_covariance_m2(ns(0.48), place)
    assert math.sqrt(later[2, 2]) == pytest.approx(0.5 * 2.0 * 0.4**2 + 6.0 * 0.1)


def braking(roll_rad: float) -> VehicleTrajectory:
    """A vehicle, in its odometry rolling by so much in 1 s, brakes by 4 m/s2 to 4 m/s, pushed to its left by 2 m/s2."""
    vehicle = VehicleTrajectory(joined=False)
    for t in np.arange(0.0, 1.01, 0.02):
        place = np.array([8.0 * t - 2.0 * t**2, t**2, 0.0])
        R = exp_rotation(np.array([roll_rad * t, 0.0, 0.0]))
        vehicle.add(VehicleMotion(stamp_ns=ns(t), xyz_map_m=place, R_map_vehicle=R, covariance=None))
    return vehicle


@pytest.mark.parametrize("xyz_m", np.array([(0.0, 0.0, 10.0), (7.0, -2.0, 10.0), (12.0, 0.0, 0.0)]))
def test_the_tilt_of_a_vehicle_that_its_odometry_does_not_measure_is_in_the_error_of_a_position(xyz_m: Array64):
    """Against a position that is turned by many random tilts: 1 deg about x, 2 deg about y, and 0.4 deg about both."""
    rng, sigmas_rad = np.random.default_rng(1), np.radians([math.hypot(1.0, 0.4), math.hypot(2.0, 0.4), 0.0])
    fix = DroneFix(stamp_ns=ns(1.0), xyz_vehicle_m=xyz_m, covariance_m2=1e-6 * np.eye(3), hits=9)
    turned = [exp_rotation(sigmas_rad * rng.standard_normal(3)) @ xyz_m for _ in range(4000)]
    level, measured = braking(0.0), braking(1e-3)
    errors, none = (FuseErrors(vehicle_tilt_deg=0.4 * k, vehicle_tilt_deg_per_mps2=0.5 * k) for k in (1, 0))
    tilted = fix_covariance(fix, level, errors)
    np.testing.assert_allclose(tilted.whole, np.cov(np.array(turned).T), atol=0.06 * (sigmas_rad[1] * 12.0) ** 2)
    for vehicle, assumed in ((level, none), (measured, errors), (level_at(0.0, count=40), errors)):
        without = fix_covariance(fix, vehicle, assumed)
        np.testing.assert_allclose(without.white, 0.75 * 0.7e-6 * np.eye(3), atol=1e-12)
        np.testing.assert_allclose(tilted.bias, without.bias, atol=1e-12)


def level_at(speed_mps: float, count: int) -> VehicleTrajectory:
    """A level vehicle with a constant speed; its newest pose is at 1.0 s."""
    vehicle = VehicleTrajectory(joined=False)
    for t in 1.0 - 0.02 * np.arange(count)[::-1]:
        place = np.array([speed_mps * t, 0.0, 0.0])
        vehicle.add(VehicleMotion(stamp_ns=ns(t), xyz_map_m=place, R_map_vehicle=np.eye(3), covariance=None))
    return vehicle


@pytest.mark.parametrize(
    ("speed_mps", "count", "late_s", "sigma_deg"),
    [
        (0.0, 3, 0.0, 0.0),
        (8.0, 3, 0.0, math.hypot(0.4, 1.0)),
        (8.0, 40, 0.0, 0.4),
        (8.0, 40, 0.6, 0.4),
        (0.4, 40, 0, 0.16),
    ],
)
def test_the_assumed_tilt_by_the_road_and_before_the_acceleration_is_measured(speed_mps, count, late_s, sigma_deg):
    """0.4 deg by the road from 1 m/s on; 2 m/s2 in traffic. Late, as extrapolated, it has not braked."""
    fix = DroneFix(
        stamp_ns=ns(1.0 + late_s), xyz_vehicle_m=np.array([0, 0, 10.0]), covariance_m2=1e-9 * np.eye(3), hits=9
    )
    vehicle, errors = level_at(speed_mps, count), FuseErrors(vehicle_tilt_deg=0.4, vehicle_tilt_deg_per_mps2=0.5)
    level = fix_covariance(fix, vehicle, FuseErrors(vehicle_tilt_deg=0.0, vehicle_tilt_deg_per_mps2=0.0))
    by_tilt_m2 = fix_covariance(fix, vehicle, errors).white - level.white
    np.testing.assert_allclose(by_tilt_m2, (10.0 * math.radians(sigma_deg)) ** 2 * np.diag([1.0, 1.0, 0.0]), atol=1e-9)


@pytest.mark.parametrize("noise_m", [0.002, 0.1])
def test_the_assumed_tilt_by_acceleration_is_right_on_average_however_noisy_the_odometry(noise_m: float):
    """Accelerations are drawn as in traffic, by 2 m/s2; poses noisy by 0.1 m measure one to 1.4 m/s2."""
    fix = DroneFix(stamp_ns=ns(1.0), xyz_vehicle_m=np.array([0, 0, 10.0]), covariance_m2=1e-9 * np.eye(3), hits=9)
    rng, by_tilt_m2 = np.random.default_rng(4), []
    times_s = np.arange(0.0, 1.01, 0.02)
    for forward, left in rng.normal(0.0, 2.0, (400, 2)):
        vehicle = VehicleTrajectory(joined=False)
        for t, noise in zip(times_s, rng.normal(0.0, noise_m, (len(times_s), 3)), strict=True):
            place = np.array([12.0 * t + 0.5 * forward * t**2, 0.5 * left * t**2, 0.0]) + noise
            vehicle.add(VehicleMotion(stamp_ns=ns(t), xyz_map_m=place, R_map_vehicle=np.eye(3), covariance=None))
        assumed = [FuseErrors(vehicle_tilt_deg=0.0, vehicle_tilt_deg_per_mps2=k) for k in (0.5, 0.0)]
        tilted, level = (fix_covariance(fix, vehicle, errors).white for errors in assumed)
        by_tilt_m2.append(np.diag(tilted - level)[:2])
    np.testing.assert_allclose(np.mean(by_tilt_m2, axis=0), (10.0 * math.radians(1.0)) ** 2, rtol=0.12)
