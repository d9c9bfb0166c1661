"""The depth image: projection, nearest return, and unprojection."""

from __future__ import annotations

import numpy as np
import pytest

from flow.message import check_arrays
from stages.kernels.sweep.depth_image import keep_nearest
from stages.sweep.depth_image import DepthCanvas, focal_length_px, unproject
from tests.stages.made import START_NS, depth_image


def draw(points, origin=(0.0, 0.0, 0.0), size=512, focal=100.0):
    depth = np.zeros((size, size), dtype=np.float32)
    inside = keep_nearest(np.asarray(points, dtype=np.float32).reshape(-1, 3), np.asarray(origin, float), focal, depth)
    return depth, inside


def test_focal_length_is_plane_height_over_pixel_size():
    # a plane at height h seen under 120 deg is 2 h tan(60 deg) wide; in 512 px: res = 2 h tan(60) / 512
    height = 7.0
    res = 2 * height * np.tan(np.radians(60)) / 512
    assert focal_length_px(512, 120.0) == pytest.approx(height / res)
    assert focal_length_px(512, 120.0) == pytest.approx(147.802, abs=1e-3)


def test_a_point_falls_into_the_pixel_computed_by_hand():
    # u = floor(100 * 1.0 / 10 + 256) = 266, v = floor(100 * -2.03 / 10 + 256) = floor(235.7) = 235
    depth, inside = draw([1.0, -2.03, 10.0])
    assert inside == 1
    assert np.argwhere(depth).tolist() == [[235, 266]]
    assert depth[235, 266] == 10.0


def test_depth_is_height_over_the_origin_not_distance():
    depth, _ = draw([4.0, 2.0, 10.25], origin=(1.0, 2.0, 0.25))
    assert np.argwhere(depth).tolist() == [[256, 286]]
    assert depth[256, 286] == 10.0


def test_the_nearest_return_in_a_pixel_stays_in_either_order():
    near, far = [0.01, 0.01, 5.0], [0.02, 0.02, 10.0]
    for points in ([near, far], [far, near]):
        depth, inside = draw(points)
        assert inside == 2
        assert depth[256, 256] == 5.0


def test_points_below_and_outside_are_left_out():
    edge = 256 / 128 * 10.0
    depth, inside = draw([[0, 0, -5.0], [0, 0, 0.0], [edge, 0, 10.0], [0, -edge - 0.1, 10.0]], focal=128.0)
    assert inside == 0
    assert not depth.any()
    assert draw([-edge, -edge, 10.0], focal=128.0)[0][0, 0] == 10.0  # the border itself is in


def test_turning_the_world_a_quarter_turns_the_image():
    rng = np.random.default_rng(1)
    points = np.c_[rng.uniform(-20, 20, (500, 2)), rng.uniform(3, 20, 500)]
    turned = points[:, [1, 0, 2]] * [-1, 1, 1]  # (x, y) -> (-y, x)
    there = np.rot90(draw(turned)[0])  # row follows y, column x: a counter-clockwise world turn is clockwise on rows
    here = draw(points)[0]
    assert (here > 0).sum() > 300
    np.testing.assert_array_equal(here, there)


def test_unproject_is_the_middle_of_the_pixel_in_the_vehicle_frame():
    depth = np.zeros((512, 512))
    depth[100, 300] = 12.0
    image = depth_image(depth, origin=(0.5, -0.25, 0.75))
    x, y = (300.5 - 256) / image.focal_px * 12.0, (100.5 - 256) / image.focal_px * 12.0
    np.testing.assert_allclose(unproject(image, 100, 300), [x + 0.5, y - 0.25, 12.75])


def test_drawing_then_unprojecting_returns_within_half_a_pixel():
    point = np.array([3.3, -4.4, 15.0])
    depth, _ = draw(point, origin=(0.1, 0.2, 0.3), focal=focal_length_px(512, 120.0))
    (row, column) = np.argwhere(depth)[0]
    image = depth_image(depth, origin=(0.1, 0.2, 0.3))
    half_px_m = 0.5 * 14.7 / image.focal_px
    assert np.abs(unproject(image, row, column) - point).max() <= half_px_m + 1e-5


def test_a_canvas_gives_its_image_away_and_begins_empty():
    canvas = DepthCanvas(64, 90.0, np.array([0.0, 0.0, 0.25]))
    canvas.draw(START_NS, np.array([[0, 0, 10], [0, 0, -1]], dtype=np.float32), lost_packets=7)
    canvas.draw(START_NS + 10, np.array([[1, 0, 10]], dtype=np.float32), lost_packets=2)
    image = canvas.take(START_NS + 20, turned_rad=3.0)
    check_arrays(image)
    assert (image.start_ns, image.stamp_ns) == (START_NS, START_NS + 20)
    assert (image.points, image.returns, image.lost_packets, image.turned_rad) == (2, 3, 2, 3.0)
    assert (image.depth_m > 0).sum() == 2
    empty = canvas.take(START_NS + 30, turned_rad=0.0)
    assert (empty.points, empty.returns, empty.lost_packets) == (0, 0, 0)
    assert not empty.depth_m.any()
    assert image.depth_m.any()
