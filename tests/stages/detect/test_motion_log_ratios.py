"""Log ratios of a path against the odometry: likelihoods by hand, invariance to frames, birds, lamps, silence."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.detect import motion_log_ratios
from stages.detect.motion_log_ratios import MAX_MISFIT, MAX_POINTS, MotionLogRatios, compare_motion
from stages.geometry.frames import rotation_z
from stages.kernels.detect.motion_log_ratios import (
    BALLOON,
    BIRD,
    CRUISE_MPS,
    CRUISE_SIGMA_MPS,
    CRUISING,
    DRIFT_MPS,
    DRIFT_UP_MPS,
    FOLLOWED_MPS,
    LOOSE,
    LOOSE_MPS,
    LOOSE_MPS2,
    SCATTERED_M,
    SLIDING_MPS,
    SWAY_M,
    YAWS,
    weigh,
)
from stages.kernels.geometry.smooth_motion import ANYWHERE_M
from stages.messages import DroneOdometry
from stages.odometry.drone.telemetry import AHEAD_NS, JUMP_M, KEPT_NS, DroneTelemetry
from tests.stages.made import MS, START_NS

SIGMA_M = 0.15
T_S = np.linspace(-2.0, 0.0, 14)
STRAIGHT_M = np.outer(T_S, (3.0, 1.0, 0.5))
HANGING_M = np.zeros((14, 3))


def turning(radius_m=5.0, speed_mps=4.0, t_s=T_S):
    w = speed_mps / radius_m
    return np.column_stack([radius_m * np.cos(w * t_s), radius_m * np.sin(w * t_s), 0.3 * t_s])


def noise(seed=0, sigma_m=0.1, n=14):
    return np.random.default_rng(seed).normal(0.0, sigma_m, (n, 3))


def against(path_m, odometry_m, level_known=True, t_s=T_S, sigma_m=SIGMA_M):
    return MotionLogRatios(
        *weigh(t_s, np.asarray(path_m), np.asarray(odometry_m), sigma_m, level_known), displacement_m=math.inf
    )


# formula by hand


def log_normal(t, e, sigma, speed=0.0, acceleration=0.0):
    """ln N(e; 0, sigma^2 I + B Q B') with the whole covariance (n, n), but for n ln(2 pi) / 2."""
    B = np.column_stack([np.ones(len(t)), t, t * t / 2])
    covariance = sigma**2 * np.eye(len(t)) + B @ np.diag([ANYWHERE_M**2, speed**2, acceleration**2]) @ B.T
    return -0.5 * (e @ np.linalg.solve(covariance, e) + np.linalg.slogdet(covariance)[1])


def log_mean(values):
    return float(np.log(np.mean(np.exp(np.subtract(values, max(values))))) + max(values))


def by_hand(t, x, d, sigma, axes):
    x, d = x - x.mean(axis=0), d - d.mean(axis=0)

    def all_axes(e, *model):
        return sum(log_normal(t, e[:, axis], *model) for axis in axes)

    def flier(level, up):
        return all_axes(x[:, :2], sigma, *level) if axes == (0, 1) else log_normal(t, x[:, 2], sigma, *up)

    yaws = math.tau * np.arange(YAWS) / YAWS
    drift = DRIFT_MPS if axes == (0, 1) else DRIFT_UP_MPS
    drone = log_mean([all_axes(x - d @ rotation_z(yaw).T, sigma, drift) for yaw in yaws])
    still, long = all_axes(x, sigma, drift), all_axes(x, SCATTERED_M)
    sliding = all_axes(x, sigma, SLIDING_MPS) if axes == (0, 1) else still  # horizontal only
    followed = all_axes(x, sigma, FOLLOWED_MPS) if axes == (0, 1) else still
    sway_mps = SWAY_M / np.ptp(t)  # on its string
    balloon = flier((min(BALLOON[0], sway_mps), BALLOON[1]), (min(BALLOON[2], sway_mps), BALLOON[3]))
    loose = flier((LOOSE_MPS, LOOSE_MPS2), (LOOSE_MPS, LOOSE_MPS2))
    bird = flier(BIRD[:2], BIRD[2:])
    if axes == (0, 1):
        headings = [CRUISE_MPS * np.array([math.cos(yaw), math.sin(yaw), 0.0]) for yaw in yaws]
        cruising = log_mean([all_axes(x - np.outer(t, v), sigma, CRUISE_SIGMA_MPS, BIRD[1]) for v in headings])
        bird = np.logaddexp(math.log(CRUISING) + cruising, math.log(1 - CRUISING) + bird)
    return drone, still, long, sliding, bird, balloon, loose, followed


def log_ratios_by_hand(t, x, d, sigma, level_known):
    parts = np.array(by_hand(t, x, d, sigma, (2,)))
    if level_known:
        parts = parts + np.array(by_hand(t, x, d, sigma, (0, 1)))
    drone, still, long, sliding, bird, balloon, loose, followed = parts
    balloon = np.logaddexp(math.log(1 - LOOSE) + balloon, math.log(LOOSE) + loose)
    over_static = drone - log_mean([still, long, sliding])
    return over_static, drone - bird, drone - balloon, min(over_static, drone - followed)


@pytest.mark.parametrize("level_known", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_the_evidence_is_the_ratio_of_the_dense_marginal_likelihoods(seed, level_known):
    rng = np.random.default_rng(seed)
    n = (2, 3, 8, 14)[seed]
    t = np.sort(rng.uniform(-3.0, 0.0, n))
    d = rng.normal(0.0, 2.0, (n, 3)) + np.outer(t, rng.normal(0.0, 4.0, 3))
    x = d @ rotation_z(0.3 * seed).T + rng.normal(0.0, 0.3, (n, 3)) + rng.normal(0.0, 30.0, 3)
    for sigma_m in (0.1, 0.4):
        expected = log_ratios_by_hand(t, x, d, sigma_m, level_known)
        found = weigh(t, x, d, sigma_m, level_known)
        np.testing.assert_allclose(found[:4], expected, rtol=1e-7, atol=1e-5)
        assert found[4] == pytest.approx(misfit_by_hand(t, x, d, sigma_m, level_known), rel=1e-6)


def misfit_by_hand(t, x, d, sigma, level_known):
    """e' C^-1 e with the drone's covariances, per coordinate."""
    x, d = x - x.mean(axis=0), d - d.mean(axis=0)

    def off2(e, drift):
        C = sigma**2 * np.eye(len(t)) + ANYWHERE_M**2 + drift**2 * np.outer(t, t)
        return e @ np.linalg.solve(C, e)

    up = off2(x[:, 2] - d[:, 2], DRIFT_UP_MPS)
    if not level_known:
        return up / len(t)
    level = [sum(off2(e, DRIFT_MPS) for e in (x - d @ rotation_z(math.tau * k / YAWS).T)[:, :2].T) for k in range(YAWS)]
    return (up + min(level)) / (3 * len(t))


def test_the_given_paths_are_not_changed():
    x, d = STRAIGHT_M + 5.0, turning()
    x_before, d_before = x.copy(), d.copy()
    weigh(T_S, x, d, SIGMA_M, True)
    np.testing.assert_array_equal(x, x_before)
    np.testing.assert_array_equal(d, d_before)


# symmetries

FLIGHTS = {"straight": STRAIGHT_M, "turning": turning(), "hanging": HANGING_M}


@pytest.mark.parametrize("flight", FLIGHTS)
def test_the_yaw_of_the_odometrys_frame_does_not_matter(flight):
    """Exact for the yaws of the grid, and within two nats between them."""
    odometry = FLIGHTS[flight]
    path = odometry + noise()
    straight = against(path, odometry)
    for k in (1, 5, 12, 23):
        turned = odometry @ rotation_z(math.tau * k / YAWS).T
        np.testing.assert_allclose(against(path, turned), straight, atol=1e-6)
    for yaw in np.linspace(0.0, math.tau / YAWS, 7):
        np.testing.assert_allclose(against(path, odometry @ rotation_z(yaw + 1.0).T), straight, atol=6.0)


def test_the_result_is_invariant_to_a_rotation_of_the_path():
    odometry, path = turning(), turning() + noise()
    for k in (3, 7, 20):
        turned = path @ rotation_z(math.tau * k / YAWS).T
        np.testing.assert_allclose(against(turned, odometry), against(path, odometry), atol=1e-6)


def test_the_origins_of_the_two_frames_do_not_matter():
    odometry, path = turning(), turning() + noise()
    moved = against(path + np.array([300.0, -20.0, 7.0]), odometry - np.array([4.0, 900.0, 50.0]))
    np.testing.assert_allclose(moved, against(path, odometry), atol=1e-6)


def test_swapping_or_mirroring_the_axes_of_both_changes_nothing():
    odometry, path = turning(), turning() + noise()
    expected = against(path, odometry)
    np.testing.assert_allclose(against(path[:, [1, 0, 2]], odometry[:, [1, 0, 2]]), expected, atol=1e-6)
    np.testing.assert_allclose(against(path * [1, -1, 1], odometry * [1, -1, 1]), expected, atol=1e-6)
    np.testing.assert_allclose(against(path * [1, 1, -1], odometry * [1, 1, -1]), expected, atol=1e-6)


def test_a_climbing_path_does_not_match():
    odometry = turning(3.0, 6.0)
    path = odometry + noise()
    assert (
        against(path * [1, -1, 1], odometry).over_bird < against(path, odometry).over_bird - 50.0
    )  # no yaw mirrors a path
    rising = np.outer(T_S, (0.0, 0.0, 3.0))
    assert against(rising, rising[:, [2, 0, 1]]).over_bird < 0 < against(rising, rising).over_bird


def test_the_order_of_the_observations_does_not_matter():
    odometry, path = turning(), turning() + noise()
    order = np.random.default_rng(1).permutation(14)
    shuffled = against(path[order], odometry[order], t_s=T_S[order])
    np.testing.assert_allclose(shuffled, against(path, odometry), atol=1e-6)


# paths of drones, birds, lamps, wires and balloons


@pytest.mark.parametrize("flight", ["straight", "turning"])
@pytest.mark.parametrize("seed", range(3))
def test_a_path_that_follows_the_odometry_is_the_drones(flight, seed):
    path = FLIGHTS[flight] @ rotation_z(0.4 + seed).T + noise(seed)
    log_ratios = against(path, FLIGHTS[flight])
    assert log_ratios.over_static > 15.0
    assert log_ratios.over_bird > 4.0
    assert log_ratios.over_balloon > 4.0


def test_a_slow_velocity_drift_of_the_odometry_is_tolerated_and_a_fast_one_is_not():
    path = STRAIGHT_M + noise()
    clean = against(path, STRAIGHT_M).over_bird
    assert against(path + np.outer(T_S, (0.0, 0.3, 0.0)), STRAIGHT_M).over_bird > clean - 3.0
    assert against(path + np.outer(T_S, (0.0, 0.0, 2.0)), STRAIGHT_M).over_bird < 0.0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("velocity", [(11.0, 0.0, 0.0), (-5.0, 8.0, 0.5), (0.0, -4.0, 0.5)])
def test_a_bird_does_not_match_a_hovering_or_differently_flying_drone(velocity, seed):
    path = np.outer(T_S, velocity) + noise(seed)
    assert against(path, HANGING_M).over_bird < -10.0
    assert against(path, np.outer(T_S, (1.0, 1.0, 0.0))).over_bird < -5.0


@pytest.mark.parametrize("seed", range(3))
def test_a_lamp_does_not_match_a_flying_drone(seed):
    path = noise(seed)
    assert against(path, STRAIGHT_M).over_static < -30.0
    assert against(path, np.outer(T_S, (0.0, 0.0, 1.0))).over_static < -3.0
    scattered = noise(seed, sigma_m=0.4)  # observations of a wire scatter
    assert against(scattered, STRAIGHT_M).over_static < -10.0


def test_observations_along_a_wire_do_not_match_a_flying_or_hovering_drone():
    slides = np.outer(T_S, (0.6, -0.5, 0.0)) + noise()
    assert against(slides, STRAIGHT_M).over_static < -10.0
    assert against(slides, HANGING_M).over_static < 1.0
    rises = np.outer(T_S, (0.0, 0.0, 0.8)) + noise()  # no wire is followed upwards
    assert against(rises, np.outer(T_S, (0.0, 0.0, 0.8))).over_static > 10.0


@pytest.mark.parametrize("seed", range(3))
def test_a_wire_followed_at_the_drones_speed_differs_only_in_a_turn(seed):
    slides = np.outer(T_S, (2.0, -1.5, 0.0)) + noise(seed)
    straight = against(slides, np.outer(T_S, (2.5, 0.0, 0.0)))
    assert straight.over_static > 8.0  # a wire that the aim does not follow is not so long
    assert straight.over_wire < 4.0
    turned = turning()
    assert against(turned + noise(seed), turned).over_wire > 10.0


@pytest.mark.parametrize("seed", range(5))
def test_a_hovering_drone_does_not_discriminate_against_a_lamp(seed):
    log_ratios = against(noise(seed), HANGING_M)
    assert -1.5 < log_ratios.over_static < 1.5
    assert log_ratios.over_bird > 5.0  # and much against birds


@pytest.mark.parametrize("seed", range(3))
def test_a_balloon_does_not_match_a_fast_drone_and_nearly_matches_a_slow_one(seed):
    path = np.outer(T_S, (0.8, 0.2, 0.2)) + noise(seed)
    assert against(path, STRAIGHT_M).over_balloon < -10.0
    assert -2.0 < against(path, np.outer(T_S, (0.8, 0.2, 0.2))).over_balloon < 12.0


@pytest.mark.parametrize("seed", range(3))
def test_a_straight_flight_of_metres_is_hardly_a_balloon_on_a_string(seed):
    """A balloon may drift slowly and straight for a second, so that a drone needs six seconds of observation."""

    def over_balloon(seconds):
        t_s = np.linspace(0.0, seconds, 14)
        path = np.outer(t_s, (0.8, 0.3, 0.1))
        return against(path + noise(seed), path, t_s=t_s).over_balloon

    assert over_balloon(6.0) > over_balloon(1.0) + 3.0
    swaying = 0.5 * np.sin(np.outer(np.linspace(0.0, 3.0, len(T_S)), (1.2, 1.9, 0.0)))
    assert against(swaying + noise(seed), np.outer(T_S, (0.8, 0.3, 0.1))).over_balloon < -4.0


def test_without_vehicle_motion_only_heights_are_compared():
    odometry = turning()
    passing = odometry + noise() + np.outer(T_S, (-12.0, 4.0, 0.0))  # observed from a driving vehicle without odometry
    level, heights = against(passing, odometry), against(passing, odometry, level_known=False)
    assert level.over_bird < -50.0
    assert heights.over_bird > 0.0
    displaced = passing * [0.0, 3.0, 1.0] + np.outer(T_S**2, (5.0, 1.0, 0.0))
    np.testing.assert_allclose(against(displaced, odometry, level_known=False), heights, atol=1e-9)
    assert against(passing * [1, 1, -8], odometry, level_known=False).over_bird < heights.over_bird - 5.0


def test_the_log_ratio_grows_with_the_observations():
    odometry = turning()
    path = odometry + noise(3)
    log_ratios = [against(path[-n:], odometry[-n:], t_s=T_S[-n:]).over_static for n in (2, 4, 8, 14)]
    assert log_ratios == sorted(log_ratios)
    assert log_ratios[-1] > log_ratios[0] + 20.0


# telemetry


def telemetry_of(trajectory, seconds=4.0, step_s=0.1, start_ns=START_NS, into=None):
    """DroneTelemetry with positions and velocities of a flight p(t)."""
    made = DroneTelemetry() if into is None else into
    for k in range(round(seconds / step_s) + 1):
        t = k * step_s
        velocity = (np.asarray(trajectory(t + 1e-4)) - trajectory(t - 1e-4)) / 2e-4
        made.add(start_ns + round(t * 1e9), np.asarray(trajectory(t), dtype=np.float64), velocity)
    return made


def circle(t):
    return np.array([5 * math.cos(t), 5 * math.sin(t), 10 + 0.5 * t])


def shifted(after_s, by_m):
    """The circle from a time on, at another position."""
    return lambda t: circle(after_s + t) + by_m * np.array([0.6, 0.0, 0.8])


def ns(*times_s):
    return [START_NS + round(t * 1e9) for t in times_s]


def positions(odometry, stamps_ns):
    """Positions (n, 3) at these times; None: no telemetry at one of them."""
    states = [odometry.state(stamp_ns) for stamp_ns in stamps_ns]
    return None if any(state is None for state in states) else np.array([state[0] for state in states])


def test_telemetry_is_interpolated_and_briefly_extrapolated():
    odometry = telemetry_of(circle)
    times = (0.0, 1.04, 2.5, 3.96, 4.05)
    expected = np.array([circle(t) for t in times])
    np.testing.assert_allclose(positions(odometry, ns(*times)), expected, atol=0.01)
    assert positions(odometry, ns(1.04)).shape == (1, 3)


def test_the_position_is_predicted_from_the_nearer_of_two_messages():
    odometry = DroneTelemetry()
    odometry.add(START_NS, np.array([0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    odometry.add(START_NS + 400 * MS, np.array([0.0, 0.0, 0.0]), np.array([0.0, 2.0, 0.0]))
    np.testing.assert_allclose(positions(odometry, ns(0.1)), [[0.1, 0.0, 0.0]])
    np.testing.assert_allclose(positions(odometry, ns(0.3)), [[0.0, -0.2, 0.0]])


@pytest.mark.parametrize(
    "times", [(-0.1, 1.0), (1.0, 4.6), (3.0, 60.0)], ids=["before the first message", "long after the last", "later"]
)
def test_outside_the_telemetry_there_is_no_state(times):
    assert positions(telemetry_of(circle), ns(*times)) is None


def test_in_a_gap_of_the_telemetry_there_is_no_state():
    odometry = telemetry_of(lambda t: np.zeros(3), seconds=1.0)
    telemetry_of(lambda t: np.zeros(3), seconds=1.0, start_ns=START_NS + 4_000 * MS, into=odometry)
    assert positions(odometry, ns(0.5, 4.5)) is not None
    assert positions(odometry, ns(0.5, 2.5, 4.5)) is None


def test_one_message_is_not_enough():
    odometry = DroneTelemetry()
    assert positions(odometry, ns(0.0)) is None
    assert odometry.speed_mps(START_NS) is None
    odometry.add(START_NS, np.zeros(3), np.zeros(3))
    assert positions(odometry, ns(0.0)) is None


def test_the_speed_is_horizontal_and_vertical_while_telemetry_is_recent():
    odometry = DroneTelemetry()
    odometry.add(START_NS, np.zeros(3), np.array([3.0, -4.0, -1.5]))
    assert odometry.speed_mps(START_NS + AHEAD_NS) == pytest.approx((5.0, -1.5))
    assert odometry.speed_mps(START_NS + AHEAD_NS + MS) is None


def test_odometry_of_failed_quality_is_ignored():
    odometry = DroneTelemetry()
    for k, quality in enumerate((80, None, 0)):
        odometry.add_odometry(
            DroneOdometry(
                stamp_ns=START_NS + k * 100 * MS,
                xyz_odom_m=np.full(3, 0.1 * k),
                R_odom_drone=np.eye(3),
                velocity_drone_mps=np.ones(3),
                angular_velocity_drone_radps=np.zeros(3),
                pose_covariance=None,
                velocity_covariance=None,
                reset_counter=0,
                quality_percent=quality,
            )
        )
    assert odometry.span_ns == (START_NS, START_NS + 100 * MS)


def test_a_message_that_is_not_newer_is_ignored():
    odometry = telemetry_of(circle)
    odometry.add(START_NS + 2_000 * MS, np.full(3, 99.0), np.zeros(3))
    odometry.add(START_NS + 4_000 * MS, np.full(3, 99.0), np.zeros(3))
    np.testing.assert_allclose(positions(odometry, ns(2.0, 4.0)), [circle(2.0), circle(4.0)], atol=1e-6)


def test_a_jump_that_the_velocity_does_not_explain_is_a_reset():
    odometry = telemetry_of(circle)
    telemetry_of(shifted(4.1, JUMP_M + 0.2), 1.0, start_ns=START_NS + 4_100 * MS, into=odometry)
    assert positions(odometry, ns(3.0, 4.5)) is None
    assert positions(odometry, ns(4.2, 4.5)) is not None


def test_a_small_correction_and_a_fast_flight_are_no_resets():
    odometry = telemetry_of(circle)
    telemetry_of(shifted(4.1, JUMP_M - 0.2), 1.0, start_ns=START_NS + 4_100 * MS, into=odometry)
    assert positions(odometry, ns(3.0, 4.5)) is not None
    assert positions(telemetry_of(lambda t: np.array([15.0 * t, 0.0, 0.0]), step_s=0.4), ns(0.5, 3.5)) is not None


def test_the_memory_is_bounded():
    odometry = telemetry_of(lambda t: np.zeros(3), seconds=60.0)
    assert len(odometry._ns) == len(odometry._xyz_m) == len(odometry._v_mps) == round(KEPT_NS * 1e-8) + 1
    assert positions(odometry, ns(39.0, 60.0)) is None
    assert positions(odometry, ns(40.0, 60.0)) is not None


# a path and telemetry together


def path_of(trajectory, times):
    return ns(*times), [np.asarray(trajectory(t)) for t in times]


def test_a_path_is_compared_with_the_telemetry_at_its_times():
    times = np.linspace(1.0, 3.0, 9)
    yaw = rotation_z(math.tau * 3 / YAWS)
    stamps, path = path_of(lambda t: yaw @ circle(t) + [0.0, 40.0, -3.0], times)
    log_ratios = compare_motion(telemetry_of(circle), stamps, path, SIGMA_M, True)
    expected = weigh(times - times[-1], np.array(path), np.array([circle(t) for t in times]), SIGMA_M, True)
    np.testing.assert_allclose(log_ratios[:5], expected, atol=0.2)
    assert log_ratios.over_static > 30.0 < log_ratios.over_balloon


def test_a_path_far_from_the_drones_has_no_positive_log_ratio():
    """An object that swings by 2 m while the drone swings by 3 m is no lamp, no bird, and not the drone."""

    def swinging(t, by_m=3.0):
        return np.array([2.0 * t, by_m * math.sin(3.0 * t), 10.0])

    times = np.linspace(1.0, 3.0, 9)
    stamps, path = path_of(lambda t: swinging(t, 2.0), times)
    odometry = np.array([swinging(t) for t in times])
    assert min(weigh(times - times[-1], np.array(path), odometry, SIGMA_M, True)[:4]) > 5.0
    log_ratios = compare_motion(telemetry_of(swinging), stamps, path, SIGMA_M, True)
    assert log_ratios.misfit > MAX_MISFIT
    assert max(log_ratios[:4]) == 0.0
    stamps, path = path_of(swinging, times)
    log_ratios = compare_motion(telemetry_of(swinging), stamps, path, SIGMA_M, True)
    assert log_ratios.misfit < 1.0
    assert min(log_ratios[:4]) > 5.0


def test_without_vehicle_motion_only_heights_are_compared_with_telemetry():
    stamps, path = path_of(lambda t: [20.0 * t, 0.0, circle(t)[2]], np.linspace(1.0, 3.0, 9))
    assert compare_motion(telemetry_of(circle), stamps, path, SIGMA_M, True).over_bird < -50.0
    assert compare_motion(telemetry_of(circle), stamps, path, SIGMA_M, False).over_bird > -1.0


def test_the_displacement_is_the_largest_distance_from_the_first_position():
    def out_and_back(t):
        return np.array([4.0 * math.sin(math.pi * (t - 1.0) / 2.0), 0.0, 10.0 + 0.7 * math.sin(math.pi * (t - 1.0))])

    stamps, path = path_of(out_and_back, np.linspace(1.0, 3.0, 9))
    assert compare_motion(telemetry_of(out_and_back), stamps, path, SIGMA_M, True).displacement_m == pytest.approx(
        4.0, abs=0.1
    )
    assert compare_motion(telemetry_of(out_and_back), stamps, path, SIGMA_M, False).displacement_m == pytest.approx(
        0.7, abs=0.1
    )
    hanging = compare_motion(telemetry_of(lambda t: [3.0, 4.0, 10.0]), stamps, path, SIGMA_M, True)
    assert hanging.displacement_m == pytest.approx(0.0, abs=1e-6)


def test_no_telemetry_or_a_single_observation_gives_none():
    stamps, path = path_of(circle, np.linspace(1.0, 3.0, 9))
    assert compare_motion(DroneTelemetry(), stamps, path, SIGMA_M, True) is None
    assert (
        compare_motion(telemetry_of(circle, seconds=0.9), stamps, path, SIGMA_M, True) is None
    )  # the telemetry ended long before
    assert compare_motion(telemetry_of(circle), stamps[:1], path[:1], SIGMA_M, True) is None


def test_observations_without_telemetry_are_omitted():
    times = np.linspace(0.5, 3.5, 13)
    late, early = telemetry_of(circle, start_ns=START_NS), telemetry_of(circle, seconds=1.5)
    between = DroneTelemetry()
    telemetry_of(lambda t: circle(1.4 + t), seconds=1.2, start_ns=START_NS + 1_400 * MS, into=between)
    for odometry, log_ratios in ((late, times >= 0.0), (early, times <= 2.0), (between, (times > 1.4) & (times < 3.1))):
        expected = compare_motion(odometry, *path_of(circle, times[log_ratios]), SIGMA_M, True)
        if log_ratios[-1]:
            np.testing.assert_allclose(compare_motion(odometry, *path_of(circle, times), SIGMA_M, True), expected)
        else:  # the same path, compared at a later time
            np.testing.assert_allclose(
                compare_motion(odometry, *path_of(circle, times), SIGMA_M, True), expected, rtol=1e-6
            )


def test_after_a_reset_a_path_from_before_it_is_not_compared():
    odometry = telemetry_of(circle, seconds=2.0)
    telemetry_of(shifted(2.1, 5.0), 2.0, start_ns=START_NS + 2_100 * MS, into=odometry)
    assert compare_motion(odometry, *path_of(circle, np.linspace(0.5, 2.0, 9)), SIGMA_M, True) is None
    after = compare_motion(odometry, *path_of(circle, np.linspace(2.25, 4.0, 8)), SIGMA_M, True)
    np.testing.assert_allclose(
        compare_motion(odometry, *path_of(circle, np.linspace(1.0, 4.0, 13)), SIGMA_M, True), after
    )


def test_only_the_latest_ten_seconds_and_so_many_points_of_them_are_compared(monkeypatch):
    asked = []
    monkeypatch.setattr(motion_log_ratios, "weigh", lambda t, x, *_: asked.append((t, x)) or (0.0, 0.0, 0.0, 0.0, 0.0))
    odometry = telemetry_of(circle, seconds=20.0)
    stamps, path = path_of(circle, np.linspace(1.0, 19.0, 181))
    compare_motion(odometry, stamps, path, SIGMA_M, True)
    ((t, x),) = asked
    assert len(t) == len(x) == MAX_POINTS
    assert (t[0], t[-1]) == pytest.approx((-KEPT_NS / 2e9, 0.0))
    np.testing.assert_allclose(x[[0, -1]], [circle(9.0), circle(19.0)])
    assert np.diff(t) == pytest.approx(np.diff(t).mean(), abs=0.11)


# by the IMU alone


def by_imu(path_m, imu_m, duration_s=3.0, **changed):
    """The comparison of a path with an integrated IMU whose velocity is 7 m/s wrong, in a frame with another yaw."""
    telemetry, t_s = DroneTelemetry(), np.arange(0.0, duration_s + 0.1, 0.02)
    for t in t_s:
        position_m, soon = (rotation_z(2.0) @ (imu_m(x) + x * np.array([7.0, -2.0, 1.0])) for x in (t, t + 1e-3))
        telemetry.add(START_NS + round(t * 1e9), position_m, (soon - position_m) / 1e-3)
    times = np.arange(0.1, duration_s, 0.1)
    rng = np.random.default_rng(4)
    path = [path_m(t) + rng.normal(0, 0.06, 3) for t in times]
    stamps = [START_NS + round(t * 1e9) for t in times]
    return compare_motion(telemetry, stamps, path, 0.08, True, by_imu=True, **changed)


def weaving(t):
    """1.6 m/s^2 on both sides while it flies straight on."""
    return np.array([2.0 * t, 0.8 * math.sin(1.4 * t), 0.0])


def test_the_imu_alone_tells_the_drone_from_everything_that_accelerates_otherwise():
    own = by_imu(weaving, weaving)
    assert min(own[:3]) > 3.0
    assert own.misfit < 1.5
    climbing = by_imu(lambda t: weaving(t) + np.array([0.0, 0.0, 0.8 * math.sin(1.4 * t)]), weaving)
    assert climbing.over_bird < min(own.over_bird, 3.0)
    assert by_imu(lambda t: np.zeros(3), weaving).over_static < -3.0
    assert by_imu(lambda t: np.array([8.0 * t, 0.0, 0.0]), weaving).over_bird < 0.0


def test_the_imu_of_a_drone_without_acceleration_tells_it_from_nothing_that_flies_straight():
    straight = by_imu(lambda t: np.array([3.0 * t, 0.0, 0.0]), lambda t: np.zeros(3))
    assert straight.over_static > 5.0
    still = by_imu(lambda t: np.zeros(3), lambda t: np.zeros(3))
    assert abs(still.over_static) < 1.0


def test_two_observations_at_one_time_have_no_acceleration():
    telemetry = telemetry_of(circle, seconds=2.0)
    stamps, path = path_of(circle, np.array([1.0, 1.0]))
    assert compare_motion(telemetry, stamps, path, SIGMA_M, True, by_imu=True) is None


def test_an_old_part_of_the_path_is_not_compared_with_the_imu(monkeypatch):
    monkeypatch.setattr(motion_log_ratios, "IMU_NS", 1_000_000_000)
    late = lambda t: weaving(t) if t > 1.0 else np.array([50.0, 0.0, 0.0])  # noqa: E731
    assert by_imu(late, weaving).misfit < 1.5
    monkeypatch.setattr(motion_log_ratios, "IMU_NS", 3_000_000_000)
    assert by_imu(late, weaving).misfit > MAX_MISFIT
