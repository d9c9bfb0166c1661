"""Edge chains: sub-pixel position, brighter side, and rejected edges."""

from __future__ import annotations

import cv2
import numpy as np

from stages.kernels.vp.edges import BINS, LEVELS, SLOPE, slopes_and_seeds, thresholds
from stages.vp.edges import EdgeFinder


def half_plane(angle_deg, offset_px, size=120, dark=60.0, light=140.0, noise=0.0, seed=0):
    """Light where x cos + y sin > offset about the middle; pixels are averaged over 8 x 8 places."""
    angle = np.radians(angle_deg)
    fine = (np.arange(8 * size) - 3.5) / 8
    x, y = np.meshgrid(fine - (size - 1) / 2, fine - (size - 1) / 2)
    lit = (x * np.cos(angle) + y * np.sin(angle) > offset_px).astype(float)
    grey = dark + (light - dark) * lit.reshape(size, 8, size, 8).mean(axis=(1, 3))
    grey += np.random.default_rng(seed).normal(0, noise, grey.shape)
    return np.clip(np.round(grey), 0, 255).astype(np.uint8)


def chains_of(grey, usable=None, min_contrast=8.0, min_points=6):
    usable = np.ones(grey.shape, dtype=np.uint8) if usable is None else usable
    return EdgeFinder(usable, min_contrast, min_points).find(grey)


def test_an_edge_is_found_to_a_tenth_of_a_pixel_at_any_angle():
    for angle_deg in range(0, 360, 15):
        offset = 3.3
        chains = chains_of(half_plane(angle_deg, offset))
        assert len(chains.start) == 2, angle_deg
        angle = np.radians(angle_deg)  # arcs omit the end points as well
        away = (chains.points_px[1:-1] - 59.5) @ [np.cos(angle), np.sin(angle)] - offset
        assert abs(away.mean()) < 0.06
        assert np.abs(away).max() < 0.25
        assert len(away) > 50


def test_the_brighter_side_is_on_the_left_of_a_chain():
    for angle_deg in (0, 50, 100, 200, 290):
        points = chains_of(half_plane(angle_deg, 0.0)).points_px
        along = points[-1] - points[0]
        light = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
        assert along[0] * light[1] - along[1] * light[0] < 0  # y is down


def test_noise_has_no_chains_and_sets_its_own_threshold():
    rng = np.random.default_rng(3)
    noisy = np.clip(np.round(rng.normal(120, 8, (200, 200))), 0, 255).astype(np.uint8)
    assert len(chains_of(noisy).start) == 1
    assert len(chains_of(half_plane(20, 0.0, noise=4.0)).start) >= 2  # and a strong edge in it is still one


def test_the_threshold_is_the_contrast_setting_without_noise():
    counts = np.zeros((LEVELS, BINS), dtype=np.int64)
    counts[6, 0] = 1000
    limit = thresholds(counts, 8.0)
    assert limit.shape == (LEVELS,)
    np.testing.assert_allclose(np.sqrt(limit), 8.0 * SLOPE, rtol=1e-6)


def test_the_gradient_is_that_of_a_5_x_5_sobel_inside_the_spans():
    grey = np.random.default_rng(5).integers(0, 256, (40, 50)).astype(np.uint8)
    span = np.zeros((40, 2), dtype=np.int64)
    span[5:30] = 7, 41
    slopes, seeds = np.zeros(grey.shape, dtype=np.int32), np.empty(400, dtype=np.int64)
    rows = (np.empty(50, dtype=np.int16), np.empty(50, dtype=np.int16))
    slopes_and_seeds(grey, np.ones_like(grey), span, 0.0, slopes, *rows, seeds)
    for found, order in ((slopes.astype(np.int16) & ~1, (1, 0)), (slopes >> 16, (0, 1))):
        sobel = cv2.Sobel(grey, cv2.CV_16S, *order, ksize=5)[5:30, 7:41]
        np.testing.assert_allclose(found[5:30, 7:41], sobel, atol=order[0])  # its last bit says whether it is free
        assert not found[:5].any()
        assert not found[:, 41:].any()


def test_a_seed_lies_on_each_straight_run_of_seven_pixels():
    for angle_deg in (0, 45, 90, 135):
        grey = half_plane(angle_deg, 0.0)
        for along in range(-30, 30):
            x, y = np.round(59.5 + along * np.array([-np.sin(np.radians(angle_deg)), np.cos(np.radians(angle_deg))]))
            usable = np.zeros(grey.shape, dtype=np.uint8)
            usable[int(y) - 4 : int(y) + 4, int(x) - 4 : int(x) + 4] = 1
            assert len(chains_of(grey, usable, min_points=1).points_px) >= 2, (angle_deg, along)


def test_weak_edges_and_masked_pixels_give_no_chain():
    assert len(chains_of(half_plane(30, 0.0, dark=100, light=104)).start) == 1
    usable = np.ones((120, 120), dtype=np.uint8)
    usable[:, 40:80] = 0
    points = chains_of(half_plane(90, 0.0), usable).points_px
    assert len(points) > 30
    assert not ((points[:, 0] > 39.5) & (points[:, 0] < 79.5)).any()


def test_a_second_image_is_independent_of_the_first():
    finder = EdgeFinder(np.ones((120, 120), dtype=np.uint8), 8.0, 6)
    first = finder.find(half_plane(30, 0.0)).points_px.copy()
    finder.find(half_plane(75, 5.0))
    np.testing.assert_array_equal(finder.find(half_plane(30, 0.0)).points_px, first)
