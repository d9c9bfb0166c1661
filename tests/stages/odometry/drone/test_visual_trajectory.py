"""Rotation of the drone between two times by its images: chained, interpolated, extrapolated."""

from __future__ import annotations

import numpy as np
import pytest

from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import VisualMotion
from stages.odometry.drone.visual_trajectory import VisualTrajectory

MS = 1_000_000
RATE = np.array([0.1, -0.3, 1.5])


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


def test_images_with_a_long_gap_give_the_whole_rotation_but_no_interpolation():
    images = VisualTrajectory()
    for one in (step(0, 200), step(200, 400), step(400, 2400), step(2400, 2600)):
        images.add(one)
    assert images.at(1400 * MS) is None
    assert images.at(400 * MS) is not None
    assert images.at(2400 * MS) is not None
    assert images.between(300 * MS, 2500 * MS) is not None


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
    assert images.between(50 * MS, 350 * MS) is None


def test_the_rotation_between_two_times_is_that_of_the_images_in_both_directions():
    images = VisualTrajectory()
    images.add(step(0, 500))
    there, back = images.between(100 * MS, 400 * MS), images.between(400 * MS, 100 * MS)
    assert there is not None
    assert back is not None
    np.testing.assert_allclose(there.R_from_to, exp_rotation(0.3 * RATE), atol=1e-9)
    np.testing.assert_allclose(back.R_from_to, exp_rotation(0.3 * RATE).T, atol=1e-9)
