"""Corners and their templates: detection, sub-pixel tracking, and images without corners."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from stages.kernels.geometry.so3 import exp_rotation
from stages.kernels.visual.features import best_per_cell
from stages.kernels.visual.patches import RADIUS_PX, SIDE_PX, at, find, sample, take
from stages.odometry.visual.features import FeatureSettings, FeatureTracker, at_middle_row, usable_pixels
from tests.stages.seen import LENS, PIXEL_RAD, SIZE_PX, grey_image


def tracked(poses, settings=None, expected=None):
    tracker = FeatureTracker(LENS, settings or FeatureSettings())
    seen = []
    for i, (R, p) in enumerate(poses):
        turn = np.eye(3) if i == 0 or expected is None else expected
        tracker.follow(i + 1, grey_image(R, np.asarray(p, float), i), turn)
        seen.append(tracker.complete(np.eye(3)))
    return seen


def test_a_shifted_template_is_found():
    grey = grey_image(np.eye(3), np.zeros(3))
    at = tracked([(np.eye(3), np.zeros(3))])[0].pixel
    shifted = np.roll(grey, (2, 1), axis=(0, 1))  # two rows down, one column right
    place, likeness = find(shifted, take(grey, at), np.stack([np.eye(2)] * len(at)), at)
    found = likeness > 0.98
    assert found.mean() > 0.8
    np.testing.assert_allclose(place[found], at[found] + [1.0, 2.0], atol=0.05)


def test_a_flat_template_and_an_edge_are_not_found():
    flat = np.full((60, 60), 90, dtype=np.uint8)
    edge = flat.copy()
    edge[:, 30:] = 200
    at = np.array([[30.0, 30.0]])
    for grey in (flat, edge):
        assert find(grey, take(grey, at), np.eye(2)[None], at)[1][0] == -1.0


def test_a_rotated_template_is_found_better_with_its_warp():
    angle = math.radians(25.0)
    one = grey_image(np.eye(3), np.zeros(3))
    c, s = math.cos(angle), math.sin(angle)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])  # about the optical axis
    other = grey_image(R.T, np.zeros(3))  # the scene rotates by R in the image
    corners = tracked([(np.eye(3), np.zeros(3))])[0].pixel
    centre = np.array(LENS.centre_px)
    there = (corners - centre) @ R[:2, :2].T + centre
    place, likeness = find(other, take(one, corners), np.broadcast_to(R[:2, :2], (len(there), 2, 2)).copy(), there)
    good = likeness > 0.8
    assert good.mean() > 0.7
    assert np.median(np.linalg.norm((place - there)[good], axis=1)) < 0.08
    plain = find(other, take(one, corners), np.stack([np.eye(2)] * len(there)), there)[1]
    assert np.median(plain) < np.median(likeness) - 0.1


def test_corners_are_spread_over_the_circle():
    seen = tracked([(np.eye(3), np.zeros(3))])[0]
    assert len(seen.number) > 180
    assert (np.bincount((np.arctan2(*(seen.pixel - SIZE_PX / 2).T) // (math.pi / 2)).astype(int) + 2) > 30).all()
    off_axis = np.degrees(np.arctan2(np.hypot(*seen.ray[:, :2].T), seen.ray[:, 2]))
    assert off_axis.max() <= 100.5
    assert np.count_nonzero(off_axis > 90) > 5
    distance = np.linalg.norm(seen.pixel[:, None] - seen.pixel, axis=2) + 1e9 * np.eye(len(seen.pixel))
    assert distance.min() > 5.0


def test_tracks_keep_their_number_and_follow_the_rotation():
    turn = exp_rotation(np.array([0.03, -0.02, 0.1]))
    poses = [(np.linalg.matrix_power(turn, k), np.zeros(3)) for k in range(6)]
    seen = tracked(poses, expected=turn.T)
    mine, theirs = seen[0].common(seen[5])
    assert len(mine) > 0.4 * len(seen[0].number)
    expected = seen[0].ray[mine] @ poses[5][0]
    error_px = np.linalg.norm(expected - seen[5].ray[theirs], axis=1) / PIXEL_RAD
    assert np.median(error_px) < 0.1  # no drift over five images and 30 deg
    assert (np.diff(seen[5].number) > 0).all()


def test_a_mask_and_the_off_axis_limit_keep_corners_out():
    mask = ((0.0, 0.0), (399.0, 0.0), (399.0, 200.0), (0.0, 200.0))
    seen = tracked([(np.eye(3), np.zeros(3))], FeatureSettings(masked_px=(mask,), max_off_axis_deg=60.0))[0]
    assert len(seen.number) > 50
    assert seen.pixel[:, 1].min() > 199
    assert np.degrees(np.arctan2(np.hypot(*seen.ray[:, :2].T), seen.ray[:, 2])).max() < 61.0


def test_a_blank_image_has_no_corners_and_loses_all_tracks():
    tracker = FeatureTracker(LENS, FeatureSettings())
    assert len(tracker.follow(1, grey_image(np.eye(3), np.zeros(3)), np.eye(3)).number) == 0
    assert len(tracker.complete(np.eye(3)).number) > 100
    blank = np.full((SIZE_PX, SIZE_PX), 80, dtype=np.uint8)
    assert len(tracker.follow(2, blank, np.eye(3)).number) == 0
    assert len(tracker.complete(np.eye(3)).number) == 0


def test_a_number_is_never_reused_and_dropped_tracks_are_gone():
    tracker = FeatureTracker(LENS, FeatureSettings())
    grey = grey_image(np.eye(3), np.zeros(3))
    tracker.follow(1, grey, np.eye(3))
    first = tracker.complete(np.eye(3)).number
    tracker.drop(first[::2])
    tracker.follow(2, grey, np.eye(3))
    after = tracker.complete(np.eye(3)).number
    assert not np.isin(first[::2], after).any()
    assert np.isin(first[1::2], after).mean() > 0.9
    assert after.max() > first.max()


def test_another_image_size_restarts_and_a_tiny_one_is_rejected():
    tracker = FeatureTracker(LENS, FeatureSettings())
    tracker.follow(1, grey_image(np.eye(3), np.zeros(3)), np.eye(3))
    tracker.complete(np.eye(3))
    assert len(tracker.follow(2, np.zeros((300, 300), np.uint8), np.eye(3)).number) == 0
    with pytest.raises(ValueError, match="16 x 20 pixels is too small"):
        tracker.follow(3, np.zeros((20, 16), np.uint8), np.eye(3))


def test_the_best_corner_of_each_empty_cell_is_selected():
    strength = np.zeros((40, 40), dtype=np.float32)
    strength[5, 6], strength[7, 3], strength[30, 31], strength[31, 12] = 3.0, 2.0, 5.0, 4.0
    usable = np.full((40, 40), 255, np.uint8)
    usable[31, 12] = 0
    found = best_per_cell(strength, usable, np.zeros((0, 2)), 20.0, 1.0)
    assert found.tolist() == [[6, 5], [31, 30]]
    assert best_per_cell(strength, usable, np.array([[29.0, 33.0]]), 20.0, 1.0).tolist() == [[6, 5]]


def test_the_usable_area_is_symmetric_about_the_lens():
    usable = usable_pixels(LENS, FeatureSettings(), (SIZE_PX, SIZE_PX))
    assert (usable == usable[::-1]).all()
    assert (usable == usable.T).all()


@pytest.mark.parametrize(
    "wrong", [{"count": 3}, {"window_px": 0}, {"likeness": 1.0}, {"masked_px": (((0, 0), (1, 1)),)}]
)
def test_impossible_settings_are_rejected(wrong):
    with pytest.raises(ValidationError):
        FeatureSettings(**wrong)


def test_a_template_is_matched_at_sub_pixel_positions_inside_the_image_only():
    rng = np.random.default_rng(7)
    grey = rng.integers(0, 256, (40, 50)).astype(np.uint8)
    seen, patch, beyond = np.empty(SIDE_PX**2), np.arange(SIDE_PX) - RADIUS_PX, 0
    for _ in range(500):
        column, row = rng.uniform(0.0, 50.0), rng.uniform(0.0, 40.0)
        warp = np.eye(2) + rng.normal(0.0, 0.2, (2, 2))
        wanted = np.array(
            [
                at(grey, column + warp[0, 0] * du + warp[0, 1] * dv, row + warp[1, 0] * du + warp[1, 1] * dv)
                for dv in patch
                for du in patch
            ]
        )
        if sample(grey, column, row, warp, seen):
            np.testing.assert_array_equal(seen, wanted)
        else:
            beyond += 1
            assert np.isnan(wanted).any()
    assert 100 < beyond < 400
    assert not sample(grey, np.nan, 20.0, np.eye(2), seen)


def test_rays_of_a_turning_camera_are_corrected_to_the_exposure_of_the_middle_row():
    rng = np.random.default_rng(0)
    still = rng.normal(size=(50, 3))  # directions of the scene in the camera axes of the middle row
    still /= np.linalg.norm(still, axis=1)[:, None]
    rows_after, turn = rng.uniform(-300.0, 300.0, 50), np.radians([0.02, -0.03, 0.05])  # 18 deg at the last row
    seen = np.array([exp_rotation(k * turn).T @ ray for k, ray in zip(rows_after, still, strict=True)])
    assert np.linalg.norm(seen - still, axis=1).max() > 0.1
    np.testing.assert_allclose(at_middle_row(seen, rows_after, turn), still, atol=1e-12)
