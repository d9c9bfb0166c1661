"""Minima, neighbours and gates, with the reasons for rejections."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from stages.detect.paper import kernel_candidates
from stages.detect.paper.kernel_candidates import Gates, Pixel, local_minima, reject_reason, score_image, width_px
from stages.kernels.detect.kernel_candidates import middle_m, neighbour_pixels, own_pixels
from stages.sweep.depth_image import focal_length_px
from tests.stages.made import depth_image, point_of, street_depth


def scores(values, shape=(40, 40)):
    score = np.full(shape, np.nan, dtype=np.float32)
    for (row, column), value in values.items():
        score[row, column] = value
    return score


def reason_of(depth, row, column, **gates):
    return reject_reason(depth_image(depth), Pixel(row, column), 0.5, 20, Gates(**gates))


def drone_depth(row=256, column=256, depth_m=20.0, size=3):
    """A size x size square of pixels around (row, column)."""
    depth = np.zeros((512, 512), dtype=np.float32)
    half = size // 2
    depth[row - half : row + half + 1, column - half : column + half + 1] = depth_m
    return depth


def test_minima_are_ordered_by_score_and_one_per_object():
    score = scores({(10, 10): 3.0, (10, 12): 1.0, (30, 30): 2.0, (12, 12): 1.5})
    depth = np.where(np.isnan(score), 0, 20.0).astype(np.float32)
    assert local_minima(score, depth, 5, 0.5, 10) == [Pixel(10, 12), Pixel(30, 30)]


def test_a_minimum_does_not_suppress_an_object_at_another_depth():
    score = scores({(10, 10): 1.0, (10, 12): 2.0, (10, 14): 3.0})
    depth = np.zeros((40, 40), dtype=np.float32)
    depth[10, [10, 12, 14]] = 50.0, 20.0, 50.2
    assert local_minima(score, depth, 5, 0.5, 10) == [Pixel(10, 10), Pixel(10, 12)]


def test_equal_scores_are_ordered_by_position_and_the_count_is_bounded():
    score = scores({(5, 30): 0.0, (5, 3): 0.0, (30, 5): 0.0})
    depth = np.where(np.isnan(score), 0, 20.0).astype(np.float32)
    assert local_minima(score, depth, 5, 0.5, 10) == [Pixel(5, 3), Pixel(5, 30), Pixel(30, 5)]
    assert local_minima(score, depth, 5, 0.5, 2) == [Pixel(5, 3), Pixel(5, 30)]
    assert local_minima(scores({}), depth, 5, 0.5, 2) == []


def test_searching_the_lowest_scores_first_finds_the_same_minima(monkeypatch):
    depth = street_depth()
    score = score_image(depth, focal_length_px(512, 120.0), 0.5, 20, 0.1, 1.0)
    monkeypatch.setattr(kernel_candidates, "FIRST_SORTED", 10**9)
    every = local_minima(score, depth, 10, 0.5, 500)
    monkeypatch.setattr(kernel_candidates, "FIRST_SORTED", 50)
    assert local_minima(score, depth, 10, 0.5, 500) == every
    assert len(every) > 100


def test_own_pixels_and_neighbours_are_counted_by_distance_in_space():
    rng = np.random.default_rng(0)
    depth = np.where(rng.random((512, 512)) < 0.3, rng.uniform(4, 20, (512, 512)), 0).astype(np.float32)
    for row, column, depth_m in [(100, 400, 9.0), (256, 256, 12.0), (20, 30, 15.0), (300, 500, 5.0)]:
        depth[row, column] = depth_m
        image = depth_image(depth, origin=(1.0, 2.0, 3.0))
        filled = np.argwhere(depth)
        points = np.array([point_of(image, r, c) for r, c in filled])
        centre = point_of(image, row, column) + np.array([0.1, -0.1, 0.2])
        distance = np.linalg.norm(points - centre, axis=1)
        far_enough = depth[depth > 0] >= 0.5 * depth_m
        pixels = own_pixels(depth, image.focal_px, centre - image.origin_vehicle_m, 1.0)
        assert pixels.tolist() == filled[distance <= 1.0].tolist()
        assert len(pixels) > 1
        neighbours = int(((distance > 1.0) & (distance <= 2.0) & far_enough).sum())
        assert neighbours > 10
        np.testing.assert_allclose(
            middle_m(depth, image.focal_px, pixels) + image.origin_vehicle_m, points[distance <= 1.0].mean(axis=0)
        )
        assert neighbour_pixels(depth, image.focal_px, centre - image.origin_vehicle_m, 1.0, 2.0, 10**9) == neighbours
        assert neighbour_pixels(depth, image.focal_px, centre - image.origin_vehicle_m, 1.0, 2.0, 5) == 5


def test_width_is_the_extent_across_the_longest_direction():
    assert width_px(np.array([[0, 0], [0, 1], [0, 5]])) == pytest.approx(0.0)
    assert width_px(np.array([[0, 0], [1, 1], [2, 2], [3, 3]])) == pytest.approx(0.0)
    square = np.argwhere(np.ones((3, 6)))
    assert width_px(square) == pytest.approx(2.0)
    assert width_px(square[:, ::-1]) == pytest.approx(2.0)
    stairs = np.array([[0, 0], [0, 1], [1, 2], [1, 3], [2, 4], [2, 5]])
    assert width_px(stairs) < 1.0


def test_a_small_isolated_object_passes_every_gate():
    assert reason_of(drone_depth(), 256, 256) is None
    assert reason_of(drone_depth(100, 420, 12.0, 5), 100, 420) is None


def test_beyond_37_m_the_kernel_cannot_discriminate():
    assert (
        reason_of(drone_depth(depth_m=38.0), 256, 256)
        == "the inner box is 1 px at 38 m: beyond 37 m it cannot detect a drone"
    )
    assert reason_of(drone_depth(depth_m=36.0), 256, 256) is None
    assert reason_of(drone_depth(depth_m=38.0), 256, 256, min_inner_px=None) is None


def test_near_the_border_the_outer_box_is_incomplete():
    for row, column in [(9, 256), (256, 9), (502, 256), (256, 502)]:
        assert "px from the image's border" in reason_of(drone_depth(row, column), row, column)
        assert reason_of(drone_depth(row, column), row, column, whole_box=False) is None
    assert reason_of(drone_depth(10, 501), 10, 501) is None


def test_a_pixel_or_two_may_be_rain():
    depth = drone_depth(size=1)
    assert "1 px filled within 0.5 m, at least 3 needed" in reason_of(depth, 256, 256)
    assert reason_of(depth, 256, 256, min_pixels=1, min_width_px=None) is None


def test_a_part_of_a_larger_object_is_rejected():
    wall, edge, line = (np.zeros((512, 512), dtype=np.float32) for _ in range(3))
    wall[200:300, 200:300] = 20.0
    edge[200:300, 256:300] = 20.0
    line[240:300, 255:258] = 20.0
    for depth in (wall, edge, line):
        assert reason_of(depth, 256, 256).startswith("part of a larger object")
        assert reason_of(depth, 256, 256, max_neighbour_ratio=None) is None
    assert reason_of(line, 240, 256).startswith("part of a larger object")  # also its end


def test_neighbours_are_counted_from_the_middle_of_the_object():
    depth = drone_depth(size=1)
    depth[255:258, 252:260] = 15.0  # 0.8 m wide at 15 m: more than a quarter lies beyond 0.5 m from its edge
    for column in (252, 256, 259):
        assert reason_of(depth, 256, column) is None


def test_a_drone_in_front_of_a_wall_at_another_depth_is_isolated():
    depth = np.full((512, 512), 35.0, dtype=np.float32)
    depth[252:261, 252:261] = 0
    depth[255:258, 255:258] = 20.0
    assert reason_of(depth, 256, 256) is None


def test_a_single_chord_is_rejected():
    depth = np.zeros((512, 512), dtype=np.float32)
    depth[256, 254:259] = 20.0
    assert "5 px in one line" in reason_of(depth, 256, 256)
    depth[258, 254:259] = 20.0  # a second chord next to it
    assert reason_of(depth, 256, 256) is None


@pytest.mark.parametrize(
    "settings", [{"min_inner_px": 0}, {"neighbour_m": 0.0}, {"max_neighbour_ratio": -1.0}, {"border": True}]
)
def test_impossible_gates_are_rejected(settings):
    with pytest.raises(ValidationError):
        Gates(**settings)
