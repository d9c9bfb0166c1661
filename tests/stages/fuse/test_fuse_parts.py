"""The parts of the fusion by hand: correlated errors, drift, steps, rejections, sources of the heading."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.fuse.consistency import ENOUGH, MOST, InformationInflation, Rejected, inflation
from stages.fuse.drift import Drift
from stages.fuse.estimator import Estimator
from stages.fuse.motion_model import MotionModel, Motions
from stages.fuse.positions import MeasurementCovariance, Positions
from stages.fuse.settings import FuseErrors, FuseLimits
from stages.fuse.smoother import Smoother
from stages.fuse.track_continuity import TrackContinuity
from stages.geometry.frames import heading_rad, rotation_z
from stages.geometry.se3 import is_covariance
from stages.heading.fused_heading import Heading
from stages.heading.motion_yaw import Point
from stages.heading.odometry_yaw import OdometryYaw
from stages.heading.yaw_fit import DRIFT_RAD_PER_S, Yaw
from stages.messages import DroneAttitude, DroneLocalPosition, TrackingState, TrackState
from stages.odometry.drone.trajectory import AutopilotTrajectory
from tests.stages.fuse.ekf import Ekf
from tests.stages.fuse.made_drone_flight import S, fix, gauss_markov, ns, track

ERRORS = FuseErrors()
QUARTER = math.pi / 2


# correlated errors


def test_a_measurement_within_the_correlation_time_has_little_information():
    assert inflation(None, 1.0) == 1.0
    assert inflation(0.1, 0.0) == 1.0
    assert inflation(0.1, 1.0) == pytest.approx(20.0, rel=0.01)  # 2 tau / dt
    assert inflation(10.0, 1.0) == pytest.approx(1.0, abs=1e-3)
    assert inflation(0.0, 1.0) == MOST


def test_the_mean_of_inflated_measurements_is_consistent():
    """Errors with a time constant of 1 s, sampled every 0.1 s for 20 s: the mean's variance is R factor / n."""
    rng = np.random.default_rng(2)
    means = [gauss_markov(rng, 1.0, 1.0, 0.1, 200, 1).mean() for _ in range(400)]
    assert np.var(means) == pytest.approx(inflation(0.1, 1.0) / 200, rel=0.2)


def test_each_measurement_is_counted_from_the_one_before():
    information = InformationInflation(1.0)
    assert information.factor(0) == 1.0
    assert information.factor(S // 10) == pytest.approx(20.0, rel=0.01)
    assert information.factor(20 * S) == pytest.approx(1.0)
    assert information.factor(20 * S - S // 10) == pytest.approx(20.0, rel=0.01)  # a late one


# drift


def drifting(odometry, velocity, until=60, moved=0.2, seed=0):
    """Fixes each 0.1 s of a drone that moves by `moved` per step of its odometry, plus `velocity` m/s."""
    rng = np.random.default_rng([seed, 3])
    drift = Drift(ERRORS, odometry)
    way = np.array([moved, 0.0, 0.0])
    for i in range(until):
        z = i * way + 0.1 * i * np.asarray(velocity) + rng.normal(0, 0.05, 3)
        if i == 0:
            drift.start(0, z, 0.05**2 * np.eye(3), None)
        drift.see(i * S // 10, z, 0.05**2 * np.eye(3), way if odometry else None, 0.0)
    return drift


def test_the_drift_of_odometry_is_estimated():
    drift = drifting(True, [0.1, -0.15, 0.0])
    assert np.allclose(drift.velocity_mps, [0.1, -0.15, 0.0], atol=0.06)
    assert math.sqrt(drift.velocity_covariance[0, 0]) < 0.06


def test_without_odometry_the_whole_velocity_is_estimated():
    drift = drifting(False, [0.0, 1.5, 0.0])
    sigma = np.sqrt(np.diag(drift.velocity_covariance))
    assert (np.abs(drift.velocity_mps - [2.0, 1.5, 0.0]) < 3 * sigma).all()
    x, P = drift.ahead(6 * S)
    assert np.allclose(x, [12.0, 9.0, 0.0], atol=0.3)
    assert P[0, 0] > 0


def test_the_variance_of_a_gap_grows_with_its_square_and_cube():
    drift = drifting(True, [0, 0, 0])
    V = [drift.growth_covariance_m2(t)[0, 0] for t in (0.0, 1.0, 2.0)]
    P_b = drift.velocity_covariance[0, 0]
    assert V[0] == 0
    assert V[1] == pytest.approx(P_b + drift.q / 3)
    assert V[2] == pytest.approx(4 * P_b + 8 * drift.q / 3)


def test_a_fix_older_than_the_newest_is_ignored():
    drift = drifting(True, [0, 0, 0])
    x = drift.xyz_map_m.copy()
    drift.see(S, np.array([99.0, 0, 0]), np.eye(3), np.zeros(3), 0.0)
    assert np.array_equal(drift.xyz_map_m, x)


def test_a_direction_of_flight_turns_the_velocity_and_keeps_its_length():
    drift = drifting(False, [0.0, 0.0, 0.0], until=5)
    before = drift.velocity_mps.copy()
    along = rotation_z(0.3) @ before / np.linalg.norm(before)
    drift.add_direction(along, 0.02)
    off = math.acos(drift.velocity_mps @ along / np.linalg.norm(drift.velocity_mps))
    assert off < 0.1
    assert drift.velocity_mps @ along == pytest.approx(before @ along, rel=0.1)


def flown_askew(yaw_rad, until=12, mps=11.0):
    """The same fixes of a fast drone, its displacements turned too far by an angle; first with the error, then without."""
    rng = np.random.default_rng(5)
    drift = Drift(ERRORS, odometry=True)
    drift.start(0, np.zeros(3), 0.05**2 * np.eye(3), None)
    for i in range(1, until):
        z = np.array([0.1 * mps * i, 0.3 * i, 0.0]) + rng.normal(0, 0.05, 3)
        drift.see(i * S // 10, z, 0.05**2 * np.eye(3), rotation_z(yaw_rad) @ [0.1 * mps, 0.3, 0.0], 0.0)
    return drift


@pytest.mark.parametrize("parts_rad", [(0.04,), (0.5,), (math.pi / 2,), (0.3, -1.0, 0.4)])
def test_a_corrected_yaw_error_does_not_stay_as_drift(parts_rad):
    """For any error, corrected in any number of steps."""
    right, askew = flown_askew(0.0), flown_askew(sum(parts_rad))
    assert np.linalg.norm(askew.velocity_mps - right.velocity_mps) > 0.3
    for part_rad in parts_rad:
        askew.correct_yaw(-part_rad)
    assert np.allclose(askew.velocity_mps, right.velocity_mps, atol=1e-9)
    assert np.allclose(askew.xyz_map_m, right.xyz_map_m, atol=1e-9)
    free = drifting(False, [0.0, 0.0, 0.0])
    before = free.velocity_mps.copy()
    free.correct_yaw(0.1)  # without odometry
    assert np.array_equal(free.velocity_mps, before)


def test_a_new_map_frame_transforms_position_and_velocity():
    drift = drifting(False, [0, 0, 0])
    x, v = drift.xyz_map_m.copy(), drift.velocity_mps.copy()
    drift.turn(rotation_z(1.0), np.array([1.0, 2.0, 3.0]))
    assert np.allclose(drift.xyz_map_m, rotation_z(1.0) @ x + [1, 2, 3])
    assert np.allclose(drift.velocity_mps, rotation_z(1.0) @ v)


# steps


def model_of(until_s=2.0, v=(1.0, 0.5, 0.0), rate=0.4, silent_after=math.inf):
    motion_model = MotionModel(ERRORS)
    for t in np.arange(0, until_s, 0.05):
        if t < silent_after:
            ns, R = round(t * S), rotation_z(0.3 + rate * t)
            motion_model.autopilot.add_attitude(ns, R, np.array([0, 0, rate]))
            motion_model.autopilot.add_position(ns, t * np.asarray(v) + [5.0, 6.0, 7.0], np.asarray(v))
    return motion_model


def test_a_step_is_the_displacement_by_odometry_and_the_drift_in_drone_axes():
    motion_model, left, free = model_of(), Drift(ERRORS, True), Drift(ERRORS, False)
    left.start(0, np.zeros(3), np.eye(3), None)
    R_map_odom = rotation_z(-1.1)
    R0 = R_map_odom @ rotation_z(0.3 + 0.4 * 0.5)
    step = motion_model.step(S // 2, 3 * S // 2, R0, left, free, True, S // 2)
    assert step.by_odometry
    assert step.turn_measured
    assert np.allclose(step.R, rotation_z(0.4), atol=1e-6)
    assert np.allclose(R0 @ step.t_m, R_map_odom @ [1.0, 0.5, 0.0], atol=1e-6)
    assert is_covariance(step.covariance)
    back = motion_model.step(3 * S // 2, S // 2, R0 @ step.R, left, free, True, S // 2)
    assert np.allclose(step.R @ back.R, np.eye(3), atol=1e-9)
    assert np.allclose(step.t_m + step.R @ back.t_m, 0, atol=1e-9)


def test_with_a_moving_map_frame_the_displacement_over_ground_is_not_used():
    left, free = Drift(ERRORS, True), Drift(ERRORS, False)
    left.start(0, np.zeros(3), np.eye(3), None)
    free.start(0, np.zeros(3), np.eye(3), np.array([0.0, 0.0, 2.0]))
    step = model_of().step(S // 2, S, np.eye(3), left, free, False, S // 2)
    assert not step.by_odometry
    assert np.allclose(step.t_m, [0, 0, 1.0])
    assert step.covariance[2, 2] > math.radians(9) ** 2


def test_the_covariance_grows_beyond_the_newest_odometry():
    left, free = Drift(ERRORS, True), Drift(ERRORS, False)
    left.start(0, np.zeros(3), np.eye(3), None)
    free.start(0, np.zeros(3), np.eye(3), None)
    motion_model = model_of(silent_after=1.0)
    spread = [
        np.trace(motion_model.step(9 * S // 10, round(t * S), np.eye(3), left, free, True, S).covariance)
        for t in (1.0, 1.2, 1.4, 1.8)
    ]
    assert spread[0] < spread[1] < spread[2] < spread[3]
    assert not motion_model.step(9 * S // 10, 2 * S, np.eye(3), left, free, True, S).turn_measured


@pytest.mark.parametrize("back", [Smoother, lambda lag_s: Ekf()])
def test_a_yaw_error_corrected_by_fixes_does_not_count_as_drift(back):
    """At 11 m/s with the yaw 4 deg off, three fixes, 1.5 s none, three: they determine the yaw, hardly the drift."""
    estimator, yaw_rad = Estimator(back(3.0), ERRORS, FuseLimits(), parked=True), math.radians(4.0)
    rng = np.random.default_rng(2)
    for i in range(21):
        at_ns, xyz_m = ns(0.1 * i), np.array([10.0 + 1.1 * i, 2.0, 12.0])
        estimator.motions.motion_model.autopilot.add_attitude(at_ns, np.eye(3), np.zeros(3))
        estimator.motions.motion_model.autopilot.add_position(at_ns, xyz_m, np.array([11.0, 0.0, 0.0]))
        estimator.advance(at_ns)
        if i < 3 or i > 17:
            seen = fix(0.1 * i, xyz_m + rng.normal(0, 0.05, 3), sigma=0.05)
            estimator.follow(seen)
            estimator.add_fix(seen)
        if i == 0:
            estimator.chain.start(at_ns, rotation_z(yaw_rad), np.diag([0.01, 0.01, 0.05]) ** 2)
    R, _, _ = estimator.at(ns(2.0))
    assert abs(heading_rad(R)) < 0.1 * yaw_rad
    assert np.linalg.norm(estimator.positions.left.velocity_mps) < 0.15


# rejections


def reject(offs, sigma=0.1):
    rejected = Rejected()
    return [rejected.add(i * S // 10, np.asarray(off, dtype=float), sigma**2 * np.eye(3)) for i, off in enumerate(offs)]


def test_consistent_rejections_reset_the_estimate():
    assert reject([[5.0, 1.0, 0.0]] * ENOUGH) == [False] * (ENOUGH - 1) + [True]
    assert reject([[0.2 * i, 1.0, 0.0] for i in range(ENOUGH)])[-1]  # on a line


def test_scattered_rejections_do_not():
    rng = np.random.default_rng(0)
    assert not any(reject(rng.normal(0, 3.0, (40, 3))))


def test_a_repeated_measurement_counts_once():
    rejected = Rejected()
    assert not any(rejected.add(S, np.ones(3), 0.01 * np.eye(3)) for _ in range(3 * ENOUGH))
    assert not any(rejected.add(i * S // 10, np.ones(3), 0.01 * np.eye(3)) for i in range(11, 9 + ENOUGH))
    assert rejected.add(2 * S, np.ones(3), 0.01 * np.eye(3))


def test_an_accepted_measurement_resets_the_count():
    rejected = Rejected()
    for i in range(ENOUGH - 1):
        rejected.add(i * S // 10, np.ones(3), np.eye(3))
    rejected.clear()
    assert not rejected.add(S, np.ones(3), np.eye(3))


# sources of the heading


def by_motion(at_s, yaw, sigma_deg=2.0):
    return Yaw(round(at_s * S), yaw, math.radians(sigma_deg) ** 2)


def test_contradicting_sources_are_not_used_until_they_agree():
    heading = Heading()
    assert heading.add_vp_rotation(S, 0, 0.3, 0.01)
    heading.add_motion_yaw(by_motion(1.2, 0.3 + QUARTER))
    assert "differ by 90 deg" in heading.contradiction
    assert not heading.add_vp_rotation(2 * S, 0, 0.3, 0.01)
    heading.add_motion_yaw(by_motion(2.5, 0.32))
    assert heading.add_vp_rotation(3 * S, 0, 0.3, 0.01)
    assert heading.contradiction == ""


def test_a_contradiction_lasts_without_motion_but_not_without_vanishing_points():
    heading = Heading()
    heading.add_motion_yaw(by_motion(1.0, 0.3 + QUARTER))
    assert not heading.add_vp_rotation(S, 0, 0.3, 0.01)
    for t in range(2, 60):
        heading.pass_time(t * S)
        assert not heading.add_vp_rotation(t * S, 0, 0.3, 0.01)
    heading.pass_time(80 * S)
    assert heading.contradiction
    heading.pass_time(95 * S)
    assert heading.contradiction == ""


def test_small_differences_are_no_contradiction():
    heading = Heading()
    heading.add_motion_yaw(by_motion(1.0, 0.3 + math.radians(8)))
    assert heading.add_vp_rotation(S, 0, 0.3, 0.01)


def test_another_branch_is_accepted_after_two_seconds_or_with_confirmation():
    heading = Heading()
    assert heading.add_vp_rotation(S, 0, 0.3, 0.01)
    assert not heading.add_vp_rotation(2 * S, 1, 0.3 + QUARTER, 0.01)
    assert not heading.add_vp_rotation(3 * S, 1, 0.3 + QUARTER, 0.01)
    assert heading.add_vp_rotation(4 * S, 1, 0.3 + QUARTER, 0.01)
    heading.add_motion_yaw(by_motion(4.5, 0.3))
    assert heading.contradiction
    confirmed = Heading()
    confirmed.add_vp_rotation(S, 0, 0.3, 0.01)
    confirmed.add_motion_yaw(by_motion(3.5, 0.3 + QUARTER))  # the rotation by vanishing points is old
    assert confirmed.add_vp_rotation(4 * S, 1, 0.3 + QUARTER, 0.01)


def test_the_sigma_of_a_remembered_yaw_grows():
    own = Yaw(0, 1.0, math.radians(1) ** 2)
    assert own.sigma_at(0) == pytest.approx(math.radians(1))
    assert own.sigma_at(60 * S) > 60 * DRIFT_RAD_PER_S


def flown(odometry_yaw, at_s, yaw):
    """Twelve fixes with autopilot positions over six metres; returns whether motion contradicts the yaw."""
    way = np.outer(np.arange(12) * 0.5, [1.0, 0.3, 0.0])
    points = [
        Point(round((at_s + 0.5 * k) * S), rotation_z(yaw) @ own, 0.05**2, own, 0) for k, own in enumerate(way * 2.0)
    ]
    return [odometry_yaw.add_point(point) for point in points]


@pytest.mark.parametrize("age_s", [20.0, 600.0])
def test_a_yaw_too_old_to_be_used_is_replaced_by_that_of_motion(age_s):
    """After minutes without the drone it is neither contradicted nor usable."""
    odometry_yaw = OdometryYaw(ERRORS, math.radians(8.0))
    odometry_yaw.yaw = Yaw(0, 0.5, math.radians(3.0) ** 2)
    assert all(flown(odometry_yaw, age_s, 0.55))
    own = odometry_yaw.known(round((age_s + 6.0) * S))
    assert own is not None
    assert own.yaw_rad == pytest.approx(0.55 if age_s > 60 else 0.5, abs=0.01)


def test_a_usable_yaw_is_contradicted_by_motion():
    odometry_yaw = OdometryYaw(ERRORS, math.radians(8.0))
    odometry_yaw.yaw = Yaw(0, 0.5, math.radians(2.0) ** 2)
    assert False in flown(odometry_yaw, 5.0, 0.5 + QUARTER)


def attitude(t_s, yaw=0.0):
    return DroneAttitude(
        stamp_ns=round(t_s * S), R_odom_drone=rotation_z(yaw), angular_velocity_drone_radps=np.zeros(3)
    )


@pytest.mark.parametrize(
    ("silent_s", "turned_rad", "sigma_rad"),
    [(0.1, 0.0, 0.01), (2.0, 0.0, 0.02), (2.0, 0.3, 0.3), (2.0, QUARTER, None), (4.0, 0.0, None)],
)
def test_a_telemetry_gap_inflates_the_yaw_and_a_long_one_drops_it(silent_s, turned_rad, sigma_rad):
    odometry_yaw, trail = OdometryYaw(ERRORS, 0.14), AutopilotTrajectory()
    for t in (0.0, 0.02, 0.04):
        odometry_yaw.add(trail, attitude(t))
    odometry_yaw.yaw = Yaw(0, 0.5, 0.01**2)
    odometry_yaw.add(trail, attitude(0.04 + silent_s, turned_rad))
    if sigma_rad is None:
        assert odometry_yaw.yaw is None
    else:
        assert odometry_yaw.yaw.sigma_at(0) == pytest.approx(sigma_rad, rel=0.05)


# track continuity


def test_without_track_states_the_first_drone_is_kept_until_it_is_silent():
    following = TrackContinuity(None)
    assert following.accepts(5, 0)
    assert not following.accepts(2, S)
    assert following.accepts(5, S)
    assert following.accepts(2, 4 * S)


def test_a_candidate_is_no_track():
    following = TrackContinuity(None)
    following.add(track(0.0, TrackingState.CANDIDATE, 1))
    following.add(track(0.0, TrackingState.TRACKING, 2))
    assert following.accepts(2, 0)
    assert following.number == 2


def searching(at_s):
    return TrackState(
        stamp_ns=ns(at_s), state=TrackingState.SEARCHING, reason="afresh", hits=0, frame_s=0.5, track_id=0
    )


def test_a_restarted_tracker_that_searches_ends_the_track():
    following = TrackContinuity(None)
    following.add(track(0.0, TrackingState.TRACKING, 3))
    assert following.accepts(3, ns(0.0))
    following.add(searching(0.1))
    assert (following.number, following.reason) == (0, "the tracker lost it: afresh")
    following.add(track(0.3, TrackingState.TRACKING, 1))
    assert following.accepts(1, ns(0.3))


@pytest.mark.parametrize("pause_s", [0.0, 5.0])
def test_a_track_that_is_no_longer_reported_has_ended(pause_s):
    """A pause of all reports, as without LiDAR data, ends no track."""
    following = TrackContinuity(None)
    for number in (3, 4):
        following.add(track(0.0, TrackingState.TRACKING, number))
    assert following.accepts(3, ns(0.0))
    following.add(track(pause_s + 0.1, TrackingState.TRACKING, 4))
    assert following.number == 3
    for k in range(1, 25):
        following.add(track(pause_s + 0.1 * k, TrackingState.TRACKING, 4))
    assert following.number == 0
    assert following.accepts(4, ns(pause_s + 2.5))


def test_a_reported_velocity_bounds_an_unmeasured_maneuver():
    """Half a second after the last fix: q dt^3 / 3 without telemetry, less with a constant velocity."""
    sigmas, told_m2 = [], MeasurementCovariance(0.05**2 * np.eye(3), None)
    for reported in (False, True):
        motions = Motions(FuseErrors(), parked=True)
        positions = Positions(FuseErrors(), motions)
        for i in range(30):
            t = 0.1 * i
            if reported:
                motions.motion_model.autopilot.add(
                    DroneLocalPosition(
                        stamp_ns=ns(t), xyz_odom_m=np.array([2 * t, 0, 9]), velocity_odom_mps=np.array([2.0, 0, 0])
                    )
                )
            z = np.array([2 * t, 0.0, 9.0])
            if i == 0:
                positions.find(fix(t, z, 0.05), z, told_m2)
            else:
                positions.accepts(ns(t), np.zeros(3), np.eye(3), told_m2)
                positions.follow(ns(t), z, 1.0, None)
        sigmas.append(math.sqrt(positions.at(ns(2.99))[1][4, 4]))
    assert sigmas[1] < 0.8 * sigmas[0]
