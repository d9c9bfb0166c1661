"""The vehicle's trajectory: interpolation, short extrapolation, and a vehicle without poses."""

from __future__ import annotations

import numpy as np
import pytest

from stages.geometry.frames import rotation_from_rpy_deg, rotation_z
from stages.geometry.trajectory import FURTHEST_NS, KEPT, RECENT_NS, VehicleTrajectory
from stages.kernels.geometry.trajectory import STEP_NS
from stages.messages import VehicleMotion
from tests.stages.made import MS, START_NS


def motion(t_ns, xyz_m, R=None):
    return VehicleMotion(
        stamp_ns=START_NS + t_ns,
        xyz_map_m=np.asarray(xyz_m, dtype=np.float64),
        R_map_vehicle=np.eye(3) if R is None else R,
        covariance=None,
    )


def trail(*motions):
    made = VehicleTrajectory()
    for one in motions:
        made.add(one)
    return made


def test_without_poses_the_vehicle_is_at_the_origin():
    R, t = trail().at(START_NS)
    np.testing.assert_array_equal(R, np.eye(3))
    np.testing.assert_array_equal(t, np.zeros(3))
    assert not trail().known
    assert trail(motion(0, (1, 2, 3))).known


def test_the_motion_is_known_while_the_newest_pose_is_recent():
    made = trail(motion(0, (0, 0, 0)), motion(100 * MS, (1, 0, 0)))
    assert made.known_at(START_NS + 100 * MS + RECENT_NS - 1)
    assert not made.known_at(START_NS + 100 * MS + RECENT_NS)
    assert not trail().known_at(START_NS)


def test_positions_between_two_poses_are_linear_in_time():
    made = trail(motion(0, (0, 0, 0)), motion(10 * MS, (0.1, 0.2, 0.3)), motion(20 * MS, (0.3, 0.3, 0.5)))
    np.testing.assert_allclose(made.at(START_NS + 5 * MS)[1], (0.05, 0.1, 0.15))
    np.testing.assert_allclose(made.at(START_NS + 10 * MS)[1], (0.1, 0.2, 0.3))
    np.testing.assert_allclose(made.at(START_NS + 15 * MS)[1], (0.2, 0.25, 0.4))


def test_rotations_between_two_poses_are_half_way():
    about = rotation_from_rpy_deg((10.0, -20.0, 30.0))
    made = trail(motion(0, (0, 0, 0), about), motion(10 * MS, (0, 0, 0), about @ rotation_z(0.1)))
    R, _ = made.at(START_NS + 5 * MS)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(R, about @ rotation_z(0.05), atol=1e-9)
    quarter, _ = made.at(START_NS + int(2.5 * MS))
    np.testing.assert_allclose(quarter, about @ rotation_z(0.025), atol=2e-5)


def nearest_rotation(R):
    u, _, vt = np.linalg.svd(R)
    return u @ vt


@pytest.mark.parametrize("turned_deg", [(5.0, 0.0, 0.0), (10.0, -20.0, 30.0), (0.0, 0.0, -60.0)])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.8])
def test_between_two_poses_the_rotation_is_nearest_to_their_mean(turned_deg, share):
    first = rotation_from_rpy_deg((40.0, 20.0, -170.0))
    then = first @ rotation_from_rpy_deg(turned_deg)
    R, _ = trail(motion(0, (0, 0, 0), first), motion(600 * MS, (0, 0, 0), then)).at(START_NS + int(share * 600 * MS))
    np.testing.assert_allclose(R, nearest_rotation(first + share * (then - first)), atol=1e-6)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("rate_radps", [-1.5, -0.3, 0.6, 1.5])
def test_beyond_the_newest_pose_the_turn_rate_is_constant(rate_radps):
    made = trail(*(motion(10 * k * MS, (0, 0, 0), rotation_z(rate_radps * 0.01 * k)) for k in range(13)))
    R, _ = made.at(START_NS + 120 * MS + FURTHEST_NS)
    np.testing.assert_allclose(R, rotation_z(rate_radps * (0.12 + FURTHEST_NS * 1e-9)), atol=1e-9)


def test_poses_that_arrive_together_give_no_speed():
    """A parked vehicle whose odometry is noisy by 2 mm, and whose poses were delayed and then arrived within 20 us."""
    poses = [motion(20 * k * MS, (0.002 * (k % 2), 0, 0), rotation_z(0.001 * (k % 2))) for k in range(10)]
    made = trail(*poses, motion(180 * MS + 20_000, (0, 0, 0)))
    for R, t in (made.at(START_NS + 180 * MS + FURTHEST_NS), made.constant_velocity(START_NS + 480 * MS)):
        np.testing.assert_allclose(t, np.zeros(3), atol=0.01)
        np.testing.assert_allclose(R, np.eye(3), atol=0.005)


def test_two_poses_give_a_speed_unless_they_arrive_together():
    for apart_ms, beyond_m in ((8, 0.0), (20, 0.4)):
        made = trail(motion(0, (0, 0, 0)), motion(apart_ms * MS, (0.2, 0, 0)))
        np.testing.assert_allclose(made.at(START_NS + (apart_ms + 40) * MS)[1], (0.2 + beyond_m, 0, 0))


def test_a_speed_is_taken_in_one_frame_only():
    made = VehicleTrajectory(joined=False)
    new = [made.add(motion(20 * k * MS, (0.1 * k + (3 if k >= 6 else 0), 0, 0))) for k in range(9)]  # 5 m/s
    assert [k for k, another in enumerate(new) if another] == [0, 8]
    np.testing.assert_allclose(made.at(START_NS + 200 * MS)[1], (4, 0, 0))


JUMP = rotation_from_rpy_deg((2.0, -3.0, 140.0)), np.array([-30.0, 12.0, 1.0])  # of the start frame


def driving(k, jumped=False):
    """10 m/s and 0.5 rad/s to the left, 20 ms a step."""
    R, t = rotation_z(0.01 * k), np.array([0.2 * k, 0.001 * k * k, 0.0])
    return motion(20 * k * MS, JUMP[0] @ t + JUMP[1], JUMP[0] @ R) if jumped else motion(20 * k * MS, t, R)


def test_a_start_frame_that_jumps_is_aligned_with_the_old_one_and_gives_no_speed():
    made = VehicleTrajectory()
    assert not any(made.add(driving(k, jumped=k >= 30)) for k in range(60))
    for k in range(60):
        R, t = made.at(driving(k).stamp_ns)
        np.testing.assert_allclose(t, driving(k).xyz_map_m, atol=0.08)
        np.testing.assert_allclose(R, driving(k).R_map_vehicle, atol=0.002)
        speed_mps = np.linalg.norm(made.velocity_mps(driving(k).stamp_ns - STEP_NS))
        assert k == 0 or speed_mps < np.hypot(10, 0.1 * k) + 0.3


def test_until_a_jump_of_the_start_frame_is_confirmed_the_pose_is_extrapolated():
    made = trail(*(driving(k) for k in range(30)))
    for k in (30, 31):
        made.add(driving(k, jumped=True))
        np.testing.assert_allclose(made.at(driving(k).stamp_ns)[1], driving(k).xyz_map_m, atol=0.05)


def test_an_outlier_is_rejected():
    made = trail(*(driving(k, jumped=k in (7, 20, 21, 40)) for k in range(50)))
    for k in range(50):
        np.testing.assert_allclose(made.at(driving(k).stamp_ns)[1], driving(k).xyz_map_m, atol=0.01)


@pytest.mark.parametrize("seed", range(5))
def test_continuing_outliers_are_never_accepted_and_true_poses_after_them_are(seed):
    made, rng = trail(*(driving(k) for k in range(30))), np.random.default_rng(seed)
    for k in range(30, 430):
        assert not made.add(motion(20 * k * MS, rng.uniform(-40, 40, 3)))
    assert made.newest_ns == driving(29).stamp_ns
    for k in range(430, 460):
        made.add(driving(k))
    np.testing.assert_allclose(made.at(driving(459).stamp_ns)[1], driving(459).xyz_map_m, atol=1e-9)


def test_a_fast_vehicles_second_pose_is_no_jump_and_the_first_real_one_after_zeros_is():
    fast = trail(*(motion(50 * k * MS, (1.5 * k, 0, 0)) for k in range(3)))
    np.testing.assert_allclose(fast.at(START_NS + 50 * MS)[1], (1.5, 0, 0))
    zeros = trail(motion(0, (0, 0, 0)), *(motion(50 * k * MS, (500 + 1.5 * k, 0, 0)) for k in range(1, 9)))
    assert max(abs(zeros.velocity_mps(START_NS + 10 * k * MS)[0]) for k in range(40)) == pytest.approx(30)


@pytest.mark.parametrize(
    ("first", "jump_m", "displaced"),
    [
        (140, 0, True),
        (140, 8, True),
        (140, 500, True),
        (90, 0, False),
        (90, 500, True),
        (60, 0, False),
        (60, 500, False),
    ],
)
def test_after_a_silence_remembered_positions_may_be_displaced(first, jump_m, displaced):
    """2.2 s: a restarted odometry may begin anywhere near. 1.2 s: it jumps. 0.6 s: the frames are joined."""
    made = trail(*(driving(k) for k in range(30)))
    far = [motion(20 * k * MS, (0.2 * k + jump_m, 0, 0)) for k in range(first, first + 10)]
    assert any([made.add(one) for one in far]) == displaced


def test_a_late_stamp_at_speed_is_no_jump():
    fast = [motion(50 * k * MS + (30 * MS if k == 20 else 0), (0.05 * 20 * k, 0, 0)) for k in range(40)]
    made = trail(*fast[:20])
    made.add(fast[20])
    assert made.newest_ns == fast[20].stamp_ns


def test_a_cached_result_is_the_same_until_a_newer_pose_arrives():
    made = trail(motion(0, (0, 0, 0)), motion(100 * MS, (1, 0, 0)))
    soon = START_NS + 150 * MS
    np.testing.assert_allclose(made.at(soon)[1], (1.5, 0, 0))
    np.testing.assert_array_equal(made.at(soon)[1], made.at(soon)[1])
    made.add(motion(50 * MS, (9, 9, 9)))  # older: nothing new
    np.testing.assert_allclose(made.at(soon)[1], (1.5, 0, 0))
    made.add(motion(200 * MS, (2, 0.2, 0)))
    np.testing.assert_allclose(made.at(soon)[1], (1.5, 0.1, 0))


@pytest.mark.parametrize("poses", [0, 1, 2, 30])
def test_the_poses_of_many_times_are_those_of_each_time(poses):
    path = trail(*(driving(k) for k in range(poses)))
    newest_ns = START_NS if path.newest_ns is None else path.newest_ns
    spans_ns = (60 * MS, 5_000 * MS)  # within the newest poses, and before the oldest
    for span_ns in spans_ns:
        stamps_ns = newest_ns + np.linspace(-span_ns, 2 * FURTHEST_NS, 41).astype(np.int64)
        stamps_ns = np.append(stamps_ns, newest_ns)
        R, t = path.at_each(stamps_ns)
        assert R.shape == (len(stamps_ns), 3, 3)
        assert t.shape == (len(stamps_ns), 3)
        for k, stamp_ns in enumerate(stamps_ns.tolist()):
            R_one, t_one = path.at(stamp_ns)
            np.testing.assert_array_equal(R[k], R_one)
            np.testing.assert_array_equal(t[k], t_one)


def test_the_poses_of_many_times_follow_a_newer_pose():
    path = trail(*(driving(k) for k in range(10)))
    stamps_ns = np.array([path.newest_ns + 5 * MS, path.newest_ns + 10 * MS])
    before = path.at_each(stamps_ns)
    path.add(motion(path.newest_ns + 20 * MS, path.at(path.newest_ns)[1] + [0.0, 0.1, 0.0], path.at(path.newest_ns)[0]))
    R, t = path.at_each(stamps_ns)
    assert not np.array_equal(t, before[1])
    np.testing.assert_array_equal(t, [path.at(stamp_ns)[1] for stamp_ns in stamps_ns.tolist()])
    np.testing.assert_array_equal(R, [path.at(stamp_ns)[0] for stamp_ns in stamps_ns.tolist()])


def test_extrapolation_ends_at_its_horizon():
    made = trail(motion(0, (0, 0, 0)), motion(100 * MS, (1, 0, 0)))  # 10 m/s
    np.testing.assert_allclose(made.at(START_NS + 150 * MS)[1], (1.5, 0, 0))
    furthest = 1 + 10 * FURTHEST_NS / 1e9
    np.testing.assert_allclose(made.at(START_NS + 100 * MS + 10 * FURTHEST_NS)[1], (furthest, 0, 0))


def test_constant_velocity_has_no_horizon():
    made = trail(*(motion(10 * k * MS, (0.1 * k, 0, 0), rotation_z(0.005 * k)) for k in range(13)))  # 10 m/s, 0.5 rad/s
    R, t = made.constant_velocity(START_NS + 120 * MS + 4 * FURTHEST_NS)
    far_s = 0.12 + 4 * FURTHEST_NS / 1e9
    np.testing.assert_allclose(t, (10 * far_s, 0, 0), atol=1e-9)
    np.testing.assert_allclose(R, rotation_z(0.5 * far_s), atol=1e-9)


def test_extrapolation_sigma_grows_by_maneuvers_and_by_the_motion_beyond_the_horizon():
    made = trail(*(motion(10 * k * MS, (0.1 * k, 0, 0), rotation_z(0.005 * k)) for k in range(13)))
    newest_ns = START_NS + 120 * MS
    assert trail().extrapolation_sigma(START_NS) == (0.0, 0.0)
    assert made.extrapolation_sigma(newest_ns) == (0.0, 0.0)
    assert made.extrapolation_sigma(newest_ns + 200 * MS) == pytest.approx((0.5 * 2.0 * 0.2**2, 0.5 * 0.2 * 0.2**2))
    place_m, yaw_rad = made.extrapolation_sigma(newest_ns + FURTHEST_NS + 100 * MS)
    assert place_m == pytest.approx(0.5 * 2.0 * 0.4**2 + 10 * 0.1)
    assert yaw_rad == pytest.approx(0.5 * 0.2 * 0.4**2 + 0.5 * 0.1, rel=1e-3)


def test_before_the_oldest_pose_the_pose_is_constant():
    made = trail(motion(0, (1, 1, 1)), motion(100 * MS, (2, 1, 1)))
    np.testing.assert_allclose(made.at(START_NS - 50 * MS)[1], (1, 1, 1))
    np.testing.assert_allclose(trail(motion(0, (4, 5, 6))).at(START_NS + 999 * MS)[1], (4, 5, 6))


def test_a_pose_that_is_not_newer_is_ignored():
    made = trail(
        motion(0, (0, 0, 0)), motion(10 * MS, (0.1, 0, 0)), motion(10 * MS, (0.2, 0, 0)), motion(5 * MS, (0.2, 0, 0))
    )
    np.testing.assert_allclose(made.at(START_NS + 10 * MS)[1], (0.1, 0, 0))


def test_memory_is_bounded():
    made = trail(*(motion(i * MS, (0.01 * i, 0, 0)) for i in range(3 * KEPT)))
    assert len(made._poses) == KEPT
    np.testing.assert_allclose(made.at(START_NS + (3 * KEPT - 2) * MS)[1], (0.01 * (3 * KEPT - 2), 0, 0))
    for k in range(2 * KEPT):  # and of the moments that were asked for
        made.at(START_NS + 2 * KEPT * MS + k)
        assert len(made._cache) <= KEPT
    np.testing.assert_allclose(made.at(START_NS + 2 * KEPT * MS)[1], (0.01 * 2 * KEPT, 0, 0))


def test_the_vehicles_velocity_is_the_derivative_of_its_position():
    made = trail(motion(0, (0, 0, 0)), motion(100 * MS, (0.5, 0, 0)), motion(200 * MS, (1.0, 0.2, 0)))
    np.testing.assert_allclose(made.velocity_mps(START_NS + 40 * MS), (5, 0, 0), atol=1e-6)
    np.testing.assert_allclose(made.velocity_mps(START_NS + 140 * MS), (5, 2, 0), atol=1e-6)
    np.testing.assert_array_equal(trail().velocity_mps(START_NS), np.zeros(3))


def braking(rate_hz: float, noise_m: float = 0.0, until_s: float = 1.2, seed: int = 0) -> VehicleTrajectory:
    """It drives towards -y of map at 8 m/s, brakes by 2 m/s2 and is pushed to its left by 1 m/s2."""
    made, R, rng = VehicleTrajectory(joined=False), rotation_z(-np.pi / 2), np.random.default_rng(seed)
    for t in np.arange(0.0, until_s, 1.0 / rate_hz):
        at = R @ [8.0 * t - t**2, 0.5 * t**2, 0.0] + rng.normal(0.0, noise_m, 3)
        made.add(motion(round(1e9 * t), at, R))
    return made


@pytest.mark.parametrize("rate_hz", [5, 50, 200, 1000])
def test_the_vehicles_acceleration_is_in_its_own_axes(rate_hz: float):
    found = braking(rate_hz).newest_acceleration()
    assert found is not None
    np.testing.assert_allclose(found[0], (-2.0, 1.0, 0.0), atol=1e-6)
    np.testing.assert_allclose(found[1], np.zeros(3), atol=1e-6)


def test_the_variance_of_the_vehicles_acceleration_is_by_the_noise_of_its_poses():
    found = [braking(50, 0.02, seed=seed).newest_acceleration() for seed in range(200)]
    off = np.array([one[0] - [-2.0, 1.0, 0.0] for one in found if one is not None])
    variance = np.array([one[1] for one in found if one is not None])
    np.testing.assert_allclose((off**2).mean(axis=0) / variance.mean(axis=0), np.ones(3), atol=0.3)
    assert 0.1 < off.std() < 0.4


def test_no_acceleration_is_taken_from_few_poses_or_across_a_jump_of_the_start_frame():
    assert braking(50, until_s=0.07).newest_acceleration() is None
    made = VehicleTrajectory(joined=False)
    for k in range(60):
        made.add(motion(20 * k * MS, (0.1 * k + (3 if k >= 30 else 0), 0, 0)))  # 5 m/s
        found = made.newest_acceleration()
        assert (found is None) == (k < 4 or 32 <= k < 34)
        if found is not None:
            np.testing.assert_allclose(found[0], np.zeros(3), atol=1e-9)


@pytest.mark.parametrize("before", [0, 1, 4, 5])
def test_poses_that_arrive_together_give_no_acceleration(before: int):
    """A parked vehicle, noisy by 2 mm, with poses each 0.2 s and then ten within 0.2 ms."""
    noise = np.random.default_rng(before).normal(0.0, 0.002, (before + 10, 3))
    times_ns = [*(200 * k * MS for k in range(before)), *(200 * before * MS + 20_000 * k for k in range(10))]
    found = trail(*map(motion, times_ns, noise)).newest_acceleration()
    assert (found is None) == (before < 4)
    assert found is None or np.abs(found[0]).max() < 0.1


TILTED = rotation_from_rpy_deg((1.0, 2.0, 0.0))


@pytest.mark.parametrize(
    ("turned", "measures"),
    [
        (lambda yaw: rotation_z(yaw), False),
        (lambda yaw: TILTED @ rotation_z(yaw), False),  # a tilted frame
        (lambda yaw: rotation_z(yaw) @ TILTED, False),  # a tilted mount
        (lambda yaw: rotation_z(yaw) @ rotation_from_rpy_deg((0.1 * yaw, 0.0, 0.0)), True),
    ],
)
def test_an_odometry_whose_vertical_never_changes_does_not_measure_the_tilt(turned, measures: bool):
    assert not VehicleTrajectory().measures_tilt
    made = trail(*(motion(20 * k * MS, (0.1 * k, 0, 0), turned(0.01 * k)) for k in range(20)))
    assert made.measures_tilt == measures


def test_relative_velocity_contains_the_vehicles_translation_and_rotation():
    """Relative velocity: R^T (v - v_vehicle) - w x p, here w about z and p ahead."""
    rate_radps, drives = 0.5, np.array([4.0, 0.0, 0.0])
    made = trail(*(motion(k * 10 * MS, k * 0.01 * drives, rotation_z(rate_radps * k * 0.01)) for k in range(100)))
    now_s, half_step_s = 0.5, STEP_NS / 2e9
    place, velocity = np.array([12.0, 3.0, 8.0]), np.array([1.0, -2.0, 0.5])
    seen_m, seen_mps = made.to_vehicle(START_NS + round(now_s * 1e9), place, velocity)
    np.testing.assert_allclose(seen_m, rotation_z(rate_radps * now_s).T @ (place - now_s * drives), atol=1e-6)
    middle_s = now_s + half_step_s  # of the step over which the velocity is taken
    R = rotation_z(rate_radps * middle_s)
    middle_m = R.T @ (place + half_step_s * velocity - middle_s * drives)
    expected_mps = R.T @ (velocity - drives) - np.cross([0, 0, rate_radps], middle_m)
    np.testing.assert_allclose(seen_mps, expected_mps, atol=1e-3)
    back_m, back_mps = made.to_map(START_NS + round(now_s * 1e9), seen_m, seen_mps)
    np.testing.assert_allclose(back_m, place, atol=1e-6)
    np.testing.assert_allclose(back_mps, velocity, atol=1e-6)
