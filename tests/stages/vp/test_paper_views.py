"""Rectified views: orientation, pinhole geometry through the lens, lines and the rim."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from stages.vp.paper_views import RectifiedView, ViewDirection, great_circles, segment_length_px
from tests.stages.vp.synthetic_courtyard import LENS, SIZE_PX


def view(azimuth_deg=0.0, off_axis_deg=60.0, size_px=200, fov_deg=90.0, R=None):
    direction = ViewDirection(azimuth_deg=azimuth_deg, off_axis_deg=off_axis_deg)
    return RectifiedView(direction, LENS, np.eye(3) if R is None else R, size_px, fov_deg)


def black():
    return np.zeros((SIZE_PX, SIZE_PX), dtype=np.uint8)


@pytest.mark.parametrize("azimuth_deg", [0, 35, 90, -120])
@pytest.mark.parametrize("off_axis_deg", [0, 60])
def test_a_view_is_a_right_handed_frame_along_its_direction(azimuth_deg, off_axis_deg):
    R = ViewDirection(azimuth_deg=azimuth_deg, off_axis_deg=off_axis_deg).rotation()
    a, o = math.radians(azimuth_deg), math.radians(off_axis_deg)
    np.testing.assert_allclose(R[:, 2], [math.sin(o) * math.cos(a), math.sin(o) * math.sin(a), math.cos(o)], atol=1e-12)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert R[2, 1] <= 1e-12, "the lens's axis is up in the view: v falls towards it"


def test_a_pixels_ray_is_the_pinholes():
    """N = 200, 90 deg: f = 100 px, c = 99.5. Pixel (199.5, 99.5) is 45 deg off the view's axis, towards its x."""
    v = view(off_axis_deg=0)
    R = ViewDirection(azimuth_deg=0, off_axis_deg=0).rotation()
    ends = v.ends(np.array([[99.5, 99.5, 199.5, 99.5]]))
    np.testing.assert_allclose(ends[0, 0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(ends[0, 1], (R[:, 0] + R[:, 2]) / math.sqrt(2), atol=1e-12)


def test_rays_are_in_mount_axes():
    R = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    segment = np.array([[20.0, 50, 120, 70]])
    np.testing.assert_allclose(view(R=R).ends(segment), view().ends(segment) @ R.T, atol=1e-12)


def test_a_spot_in_the_fisheye_appears_where_its_ray_meets_the_view():
    v = view(azimuth_deg=40, off_axis_deg=70)
    target = np.array([[120.0, 60.0, 0, 0]])
    pixel = LENS.project(v.ends(target)[0, :1])[0]
    fisheye = black()
    cv2.circle(fisheye, (round(pixel[0]), round(pixel[1])), 3, 255, -1)
    seen = v.rectify(fisheye).astype(np.float64)
    rows, columns = np.mgrid[0:200, 0:200]
    at = np.array([(columns * seen).sum(), (rows * seen).sum()]) / seen.sum()
    np.testing.assert_allclose(at, target[0, :2], atol=1.5)


def test_a_straight_edge_in_space_is_one_segment():
    """The edge of the half space x > 0.3 z is a great circle, bent in the fisheye, straight in the view."""
    column, row = np.meshgrid(np.arange(SIZE_PX, dtype=np.float64), np.arange(SIZE_PX, dtype=np.float64))
    rays = LENS.unproject(np.stack([column.ravel(), row.ravel()], axis=1))
    fisheye = np.where(rays @ [1.0, 0.0, -1.2] > 0, 200, 50).reshape(SIZE_PX, SIZE_PX).astype(np.uint8)
    v = view(azimuth_deg=0, off_axis_deg=45)
    found = v.segments(v.rectify(fisheye), 100.0, 10)
    assert len(found) == 1
    normal = great_circles(v.ends(found))[0]
    assert abs(normal @ np.array([1.0, 0.0, -1.2]) / math.hypot(1, 1.2)) > math.cos(math.radians(0.3))


def test_the_edge_of_the_image_circle_is_no_line():
    fisheye = black()
    cv2.circle(fisheye, (240, 240), round(LENS.circle_px), 220, -1)
    v = view(off_axis_deg=90)
    assert 0.5 < v.visible_share < 0.9
    assert len(v.segments(v.rectify(fisheye), 5.0, 100)) == 0


def test_segments_are_the_longest_and_longest_first():
    image = np.full((200, 200), 60, dtype=np.uint8)
    cv2.rectangle(image, (40, 40), (160, 100), 200, -1)
    v = view(off_axis_deg=30)
    lengths = segment_length_px(v.segments(image, 20.0, 100))
    assert len(lengths) == 4
    np.testing.assert_allclose(lengths, [120, 120, 60, 60], atol=4)
    assert len(v.segments(image, 20.0, 2)) == 2
    assert len(v.segments(image, 100.0, 100)) == 2
    assert v.segments(np.full((200, 200), 9, dtype=np.uint8), 5.0, 9).shape == (0, 4)


def test_a_great_circles_normal_is_orthogonal_to_both_rays_and_better_for_longer_lines():
    ends = np.array([[[1.0, 0, 0], [0, 1.0, 0]], [[0, 0, 1.0], [0.6, 0, 0.8]]])
    np.testing.assert_allclose(great_circles(ends), [[0, 0, 1], [0, 1, 0]], atol=1e-12)
    sigma = view().normal_sigma_rad(np.array([[0.0, 0, 100, 0], [0.0, 0, 0, 50]]))
    np.testing.assert_allclose(sigma, [math.sqrt(2) * 0.5 / 100, math.sqrt(2) * 0.5 / 50])
