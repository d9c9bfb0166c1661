"""Windows of motion: baseline, no overlap, displacement of each hypothesis, robustness to a false fix."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from stages.geometry.frames import rotation_z
from stages.heading.hypothesis_bank import DIRECTIONS, turns
from stages.heading.windows import Windows
from stages.messages import DroneFix, VisualMotion
from stages.odometry.drone.trajectory import AutopilotTrajectory

MS = 1_000_000
SAME = np.eye(3)
V = np.array([0.8, 0.6, 0.1])  # m/s


def fix(ms, xyz, track=1, sigma=0.03) -> DroneFix:
    return DroneFix(
        stamp_ns=ms * MS,
        xyz_vehicle_m=np.asarray(xyz, dtype=float),
        covariance_m2=sigma**2 * np.eye(3),
        hits=3,
        track_id=track,
    )


def autopilot(turned_rad=0.0, until_ms=6000, v=V) -> AutopilotTrajectory:
    trail = AutopilotTrajectory()
    R = rotation_z(turned_rad)
    for ms in range(0, until_ms, 50):
        trail.add_position(ms * MS, R @ (v * ms * 1e-3) + [7.0, 8.0, 9.0], R @ v)
    return trail


def metric(windows, own, until_ms, at=lambda ms: V * ms * 1e-3, R_map_odom=SAME, from_ms=100, **kwargs):
    """Displacements closed by fixes each 100 ms."""
    out = []
    for ms in range(from_ms, until_ms, 100):
        windows.add_fix(fix(ms, at(ms), **kwargs), np.eye(3), np.zeros(3), own)
        moved = windows.close_metric(R_map_odom, 0.03)
        out += [moved] if moved else []
    return out


def test_windows_do_not_overlap_and_have_the_baseline():
    moved = metric(Windows(0.4), autopilot(), 4000)
    assert len(moved) >= 5
    for a, b in pairwise(moved):
        assert a.end_ns == b.start_ns
    for one in moved:
        assert 0.4 <= np.linalg.norm(one.odometry_m) < 0.55
        np.testing.assert_allclose(one.odometry_m, V[:2] * one.seconds, atol=1e-9)
        np.testing.assert_allclose(one.lidar_m[0], V[:2] * one.seconds, atol=1e-9)


def test_the_odometry_is_in_the_map_frame_by_branch_0():
    moved = metric(Windows(0.4), autopilot(turned_rad=1.1), 2000, R_map_odom=rotation_z(-1.1))
    np.testing.assert_allclose(moved[0].odometry_m, V[:2] * moved[0].seconds, atol=1e-9)


def test_each_hypothesis_moves_the_fixes_by_its_own_displacement():
    """Where hypothesis i is true, its residual is zero though the drone moves within a group."""
    for i in (0, 3, 4, 9):
        R = np.eye(3)
        R[:2, :2] = turns(DIRECTIONS)[i]
        moved = metric(Windows(0.4), autopilot(), 2000, at=lambda ms, R=R: R @ V * ms * 1e-3)[0]
        np.testing.assert_allclose(moved.lidar_m[i], turns(DIRECTIONS)[i] @ moved.odometry_m, atol=1e-9)
        assert moved.lidar_m.shape == (DIRECTIONS, 2)


def test_one_false_fix_of_a_group_has_no_effect():
    def at(ms):
        return V * ms * 1e-3 + ([5.0, -5.0, 0.0] if ms == 200 else 0.0)

    moved = metric(Windows(0.4), autopilot(), 900, at=at)
    np.testing.assert_allclose(moved[0].lidar_m[0], moved[0].odometry_m, atol=0.02)


def test_no_window_before_the_displacement_exceeds_the_noise():
    near = metric(Windows(0.4), autopilot(), 4000, sigma=0.03)
    noisy = metric(Windows(0.4), autopilot(), 4000, sigma=0.4)
    assert noisy[0].seconds > 2 * near[0].seconds


def test_a_hovering_drone_gives_no_windows():
    assert metric(Windows(0.4), autopilot(v=np.zeros(3)), 5000, at=lambda ms: np.zeros(3)) == []


def test_moving_fixes_with_a_hovering_odometry_give_a_window():
    """The LiDAR follows another object: evidence for none of the branches."""
    moved = metric(Windows(0.4), autopilot(v=np.zeros(3)), 5000)
    assert moved
    assert np.linalg.norm(moved[0].odometry_m) < 0.01
    assert np.linalg.norm(moved[0].lidar_m[0]) > 1.0


def test_a_new_segment_of_the_odometry_ends_a_window_without_evidence():
    own = autopilot(until_ms=800)
    for ms in range(2000, 5000, 50):
        own.add_position(ms * MS, V * ms * 1e-3 + [50.0, 0, 0], V)
    windows = Windows(1.0)
    assert metric(windows, own, 2400) == []
    after = metric(windows, own, 4900, from_ms=2400)
    assert after
    np.testing.assert_allclose(after[0].odometry_m, V[:2] * after[0].seconds, atol=1e-9)


def test_another_track_restarts_the_window():
    windows, own = Windows(0.4), autopilot()
    for i, ms in enumerate(range(100, 4000, 100)):
        windows.add_fix(fix(ms, V * ms * 1e-3, track=1 + i // 4), np.eye(3), np.zeros(3), own)
        assert windows.close_metric(np.eye(3), 0.03) is None


def test_the_displacement_of_the_vehicle_is_added():
    windows, own, moved = Windows(0.4), autopilot(), None
    R = rotation_z(0.7)
    for ms in range(100, 1500, 100):
        t_m = np.array([3.0, 0, 0]) * ms * 1e-3
        windows.add_fix(fix(ms, R.T @ (V * ms * 1e-3 - t_m)), R, t_m, own)
        moved = moved or windows.close_metric(np.eye(3), 0.03)
    assert moved is not None
    np.testing.assert_allclose(moved.lidar_m[0], moved.odometry_m, atol=1e-9)


def by_images(directions, reach_s=3.0, hole=None, of_key=1, late_ms=0, lost_ms=10**9):
    """Bearing windows of fixes along V with a step of images each 100 ms; direction None: no motion.

    So many steps share a key; images come so late, and none of after `lost_ms`.
    """
    windows = Windows(0.4)
    R_map_drone = rotation_z(0.9)
    out = []
    for ms in range(100, round(1000 * reach_s), 100):
        seen_ms = ms - late_ms
        i = seen_ms // 100 - 1
        direction = directions(i)
        if 0 < seen_ms < lost_ms and (hole is None or not hole[0] <= seen_ms < hole[1]):
            windows.add_step(
                VisualMotion(
                    stamp_ns=seen_ms * MS,
                    from_ns=(seen_ms - 100 - 100 * (i % of_key)) * MS,
                    R_from_to=np.eye(3),
                    covariance_rad2=1e-6 * np.eye(3),
                    direction_from=None if direction is None else R_map_drone.T @ direction,
                    direction_sigma_rad=None if direction is None else 0.1,
                    matches=9,
                    reason="",
                )
            )
        windows.add_fix(fix(ms, V * ms * 1e-3), np.eye(3), np.zeros(3), AutopilotTrajectory())
        stamps = windows.steps_since_start()
        moved = windows.close_bearing(dict.fromkeys(stamps, R_map_drone), 0.03)
        out += [moved] if moved else []
    return out


def test_directions_of_images_are_summed_over_a_window():
    ahead = V / np.linalg.norm(V)
    moved = by_images(lambda i: rotation_z(0.3 if i % 2 else -0.3) @ ahead)
    assert len(moved) >= 3
    for one in moved:
        assert not one.metric
        assert np.linalg.norm(one.odometry_m) == pytest.approx(1.0)
        off = math.atan2(one.odometry_m[1], one.odometry_m[0]) - math.atan2(V[1], V[0])
        assert abs(off) < 0.15
        assert one.bearing_rad == pytest.approx(math.hypot(0.1, 0.03))


def test_a_return_flight_gives_no_direction():
    ahead = V / np.linalg.norm(V)
    assert by_images(lambda i: ahead if i % 2 else -ahead) == []


def test_no_motion_gives_no_direction():
    assert by_images(lambda i: None) == []


def test_a_window_with_few_images_is_not_used():
    ahead = V / np.linalg.norm(V)
    moved = by_images(lambda i: ahead, reach_s=4.0, hole=(800, 1600))
    assert moved
    assert all(one.end_ns <= 900 * MS or one.start_ns >= 1400 * MS for one in moved)


def test_images_of_one_key_count_once():
    ahead = V / np.linalg.norm(V)
    assert by_images(lambda i: ahead, of_key=8)
    assert by_images(lambda i: ahead, of_key=8, hole=(600, 1200), reach_s=1.2) == []  # 0.3 of 0.4 s, by three images


def test_a_window_waits_for_the_images_of_its_end():
    ahead = V / np.linalg.norm(V)
    in_time = by_images(lambda i: ahead)
    late = by_images(lambda i: ahead, late_ms=300, reach_s=3.3)
    assert len(late) == len(in_time)
    assert [one.end_ns for one in late] == [one.end_ns for one in in_time]


def test_a_window_waits_a_limited_time_for_images():
    ahead = V / np.linalg.norm(V)
    moved = by_images(lambda i: ahead, hole=(1500, 3000), reach_s=4.5)
    assert any(one.end_ns <= 1500 * MS for one in moved)
    after = [one for one in moved if one.start_ns > 1500 * MS]
    assert len(after) >= 2  # the waiting window was dropped, and its time is not in the next one
    assert all(one.seconds < 1.0 for one in after)
