"""Rotations and displacements of the drone: interpolation, extrapolation, jumps, and images alone."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.geometry.frames import rotation_z
from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import VisualMotion
from stages.odometry.drone.trajectory import AutopilotTrajectory, VisualTrajectory, rotation_between

MS = 1_000_000
RATE = np.array([0.1, -0.3, 1.5])


def turning(count=40, step_ms=20, rate=RATE) -> AutopilotTrajectory:
    trail = AutopilotTrajectory()
    for i in range(count):
        trail.add_attitude(i * step_ms * MS, exp_rotation(i * step_ms * 1e-3 * rate), rate)
    return trail


def step(from_ms, to_ms, R=None, sigma=0.001) -> VisualMotion:
    return VisualMotion(
        stamp_ns=to_ms * MS,
        from_ns=from_ms * MS,
        R_from_to=exp_rotation((to_ms - from_ms) * 1e-3 * RATE) if R is None else R,
        covariance_rad2=sigma**2 * np.eye(3),
        direction_from=None,
        direction_sigma_rad=None,
        matches=50,
        reason="",
    )


def test_attitude_between_and_a_little_beyond_the_samples():
    trail = turning()
    for ms in (0, 7, 333, 780, 900):
        R = trail.R_odom_drone(ms * MS)
        assert R is not None
        np.testing.assert_allclose(R, exp_rotation(ms * 1e-3 * RATE), atol=1e-9)


def test_attitude_before_the_first_and_long_after_the_last_is_not_known():
    trail = turning()
    assert trail.R_odom_drone(-1) is None
    assert trail.R_odom_drone(2000 * MS) is None
    assert AutopilotTrajectory().R_odom_drone(0) is None


def test_a_late_or_repeated_sample_is_ignored():
    trail = turning()
    trail.add_attitude(100 * MS, np.eye(3), np.zeros(3))
    np.testing.assert_allclose(trail.R_odom_drone(100 * MS), exp_rotation(0.1 * RATE), atol=1e-9)


def test_a_yaw_reset_is_removed_by_the_rates():
    """From 400 ms on the yaw of frame odom is off by 50 deg; the drone continues to turn at its rate."""
    trail = AutopilotTrajectory()
    for i in range(40):
        R = exp_rotation(i * 0.02 * RATE)
        trail.add_attitude(i * 20 * MS, rotation_z(math.radians(50)) @ R if i >= 20 else R, RATE)
    assert trail.jumps == 1
    np.testing.assert_allclose(trail.R_odom_drone(700 * MS), exp_rotation(0.7 * RATE), atol=1e-6)


def test_a_fast_turn_is_no_jump():
    assert turning(rate=np.array([0, 0, math.radians(120)]), step_ms=100).jumps == 0


def test_a_gap_in_which_a_jump_cannot_be_detected_is_counted():
    trail = turning(5)
    trail.add_attitude(3000 * MS, rotation_z(2.0), RATE)
    assert (trail.jumps, trail.gaps) == (0, 1)


def test_in_a_gap_only_a_short_extrapolation_is_known():
    """It turned 1.5 rad/s all the time: 6 rad in 4 s of silence, which interpolation along the shorter angle would reverse."""
    trail = AutopilotTrajectory()
    for ms in [*range(0, 400, 20), *range(4400, 4800, 20)]:
        trail.add_attitude(ms * MS, exp_rotation(ms * 1e-3 * RATE), RATE)
        trail.add_position(ms * MS, np.array([ms * 1e-3, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(trail.R_odom_drone(600 * MS), exp_rotation(0.6 * RATE), atol=1e-9)
    for ms in (700, 2400, 4399):
        assert trail.R_odom_drone(ms * MS) is None
        assert trail.position(ms * MS) is None
        assert trail.velocity_odom_mps(ms * MS) is None
        assert not rotation_between(trail, VisualTrajectory(), 200 * MS, ms * MS).measured
    np.testing.assert_allclose(trail.R_odom_drone(4400 * MS), exp_rotation(4.4 * RATE), atol=1e-9)
    assert rotation_between(
        trail, VisualTrajectory(), 200 * MS, 4500 * MS
    ).measured  # across it, both ends are measured


def test_samples_with_a_gap_of_half_a_second_are_interpolated():
    trail = AutopilotTrajectory()
    for ms in range(0, 2000, 500):
        trail.add_attitude(ms * MS, exp_rotation(ms * 1e-3 * RATE), RATE)
    np.testing.assert_allclose(trail.R_odom_drone(950 * MS), exp_rotation(0.95 * RATE), atol=1e-9)


def test_images_with_a_long_gap_give_the_whole_rotation_but_no_interpolation():
    images = VisualTrajectory()
    for one in (step(0, 200), step(200, 400), step(400, 2400), step(2400, 2600)):
        images.add(one)
    assert images.at(1400 * MS) is None
    assert images.at(400 * MS) is not None
    assert images.at(2400 * MS) is not None
    assert rotation_between(AutopilotTrajectory(), images, 300 * MS, 2500 * MS).measured


def flown(jump_at=None, jump_m=(5.0, 0, 0)) -> AutopilotTrajectory:
    trail = AutopilotTrajectory()
    for i in range(30):
        xyz = np.array([2.0, 1.0, 0.0]) * i * 0.05
        if jump_at is not None and i >= jump_at:
            xyz = xyz + jump_m
        trail.add_position(i * 50 * MS, xyz, np.array([2.0, 1.0, 0.0]))
    return trail


def test_positions_between_and_a_little_beyond_the_samples():
    for ms in (0, 60, 1500):
        place = flown().position(ms * MS)
        assert place is not None
        np.testing.assert_allclose(place[0], np.array([2.0, 1.0, 0.0]) * ms * 1e-3, atol=1e-9)
        assert place[1] == 0
    assert flown().position(5000 * MS) is None
    assert flown().position(-1) is None


def test_a_step_that_the_velocity_does_not_confirm_is_removed():
    trail = flown(jump_at=12)
    place = trail.position(1200 * MS)
    assert place is not None
    np.testing.assert_allclose(place[0], [2.4, 1.2, 0.0], atol=1e-9)
    assert trail.jumps == 1


def test_a_counted_reset_ends_the_segment():
    trail = flown()
    trail.reset(3)
    trail.add_position(1500 * MS, np.array([3.0, 1.5, 0.0]), np.array([2.0, 1.0, 0.0]))
    trail.reset(4)
    trail.add_position(1550 * MS, np.array([3.1, 1.55, 0.0]), np.array([2.0, 1.0, 0.0]))
    trail.add_position(1600 * MS, np.array([3.2, 1.6, 0.0]), np.array([2.0, 1.0, 0.0]))
    before, after = trail.position(1400 * MS), trail.position(1580 * MS)
    assert before is not None
    assert after is not None
    assert before[1] != after[1]


def test_a_gap_ends_the_segment():
    trail = flown()
    trail.add_position(9000 * MS, np.array([90.0, 0, 0]), np.zeros(3))
    place = trail.position(9000 * MS)
    assert place is not None
    assert place[1] == 1
    assert trail.position(5000 * MS) is None  # in the silence: of neither stretch


def test_consecutive_visual_motions_are_chained():
    images = VisualTrajectory()
    for i in range(10):
        images.add(step(100 * i, 100 * (i + 1)))
    at = images.at(650 * MS)
    assert at is not None
    np.testing.assert_allclose(at[0], exp_rotation(0.65 * RATE), atol=1e-9)
    assert at[1] == pytest.approx(6.5e-6)


def test_a_motion_that_skips_an_image_is_chained_at_its_from_stamp():
    images = VisualTrajectory()
    images.add(step(0, 100))
    images.add(step(0, 200))
    at = images.at(200 * MS)
    assert at is not None
    np.testing.assert_allclose(at[0], exp_rotation(0.2 * RATE), atol=1e-9)


def test_a_gap_between_steps_begins_a_new_chain():
    images = VisualTrajectory()
    images.add(step(0, 100))
    images.add(step(300, 400))
    turn = rotation_between(AutopilotTrajectory(), images, 50 * MS, 350 * MS)
    assert not turn.measured
    np.testing.assert_array_equal(turn.R_from_to, np.eye(3))
    assert math.degrees(math.sqrt(turn.variance_rad2)) == pytest.approx(12.0)  # 40 deg/s for 0.3 s


def test_the_autopilot_takes_precedence_over_images_and_both_agree():
    images = VisualTrajectory()
    images.add(step(0, 500))
    expected = exp_rotation(0.3 * RATE)
    for trail in (turning(), AutopilotTrajectory()):
        turn = rotation_between(trail, images, 100 * MS, 400 * MS)
        assert turn.measured
        np.testing.assert_allclose(turn.R_from_to, expected, atol=1e-9)
        back = rotation_between(trail, images, 400 * MS, 100 * MS)
        np.testing.assert_allclose(back.R_from_to, expected.T, atol=1e-9)
