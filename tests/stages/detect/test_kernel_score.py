"""Equations 1-5 of P III.B: by hand, against the plain double loop, and under turns and shifts."""

from __future__ import annotations

import numpy as np
import pytest

from stages.detect.paper.kernel_candidates import inner_half_px, score_image
from stages.kernels.detect.kernel_score import kernel_terms
from stages.sweep.depth_image import focal_length_px
from tests.stages.made import street_depth

FOCAL = focal_length_px(512, 120.0)  # h / res = 147.80


def plain(depth, focal=FOCAL, span=0.5, outer=20, eps=0.1, nearest=1.0):
    """Equations 1-5 as a reader would write them, in float64."""
    half_o = outer // 2
    score = np.full(depth.shape, np.nan)
    for v, u in np.argwhere(depth >= nearest):
        d_c = float(depth[v, u])
        k = int(np.float32(span * focal) / depth[v, u] * np.float32(0.5))
        e = 0.0
        for dv in range(-max(k, half_o), max(k, half_o) + 1):
            for du in range(-max(k, half_o), max(k, half_o) + 1):
                inside = 0 <= v + dv < depth.shape[0] and 0 <= u + du < depth.shape[1]
                d = float(depth[v + dv, u + du]) if inside else 0.0
                if max(abs(dv), abs(du)) <= k:
                    e += abs(d - d_c)
                elif max(abs(dv), abs(du)) <= half_o and d > 0:
                    e += 1 / eps if abs(d - d_c) <= eps else 1 / abs(d - d_c)
        score[v, u] = e
    return score


@pytest.mark.parametrize(
    ("depth_m", "half_px"),
    [(5.0, 7), (10.0, 3), (20.0, 1), (36.9, 1), (37.0, 0), (80.0, 0)],
)
def test_the_inner_side_follows_equation_3(depth_m, half_px):
    # s h / Z / (2 res) = 0.5 * 147.80 / Z / 2 = 36.95 / Z
    assert inner_half_px(depth_m, FOCAL, 0.5) == half_px == int(36.95 / depth_m)


def test_a_single_pixel_scores_its_empty_inner_box():
    depth = np.zeros((64, 64), dtype=np.float32)
    depth[30, 40] = 20.0
    score = score_image(depth, FOCAL, 0.5, 20, 0.1, 1.0)
    assert score[30, 40] == 8 * 20.0  # 3 x 3 inner box, eight empty pixels count d_c each; nothing outside
    assert np.isnan(np.delete(score.ravel(), 30 * 64 + 40)).all()


def test_inner_and_outer_terms_by_hand():
    depth = np.zeros((64, 64), dtype=np.float32)
    depth[30, 30] = 20.0  # c, inner box 3 x 3
    depth[30, 31] = 20.5  # inner: |20.5 - 20| = 0.5, seven stay empty: 140
    depth[32, 30] = 20.05  # outer, within eps: 1 / 0.1 = 10
    depth[20, 40] = 22.0  # outer corner of 21 x 21: 1 / 2 = 0.5
    depth[19, 30] = 20.0  # 11 px away: beyond the outer box
    e_inner, e_outer = kernel_terms(depth, 30, 30, 1, 10, 0.1)
    assert e_inner == pytest.approx(140.5)
    assert e_outer == pytest.approx(10.5)
    assert score_image(depth, FOCAL, 0.5, 20, 0.1, 1.0)[30, 30] == pytest.approx(151.0)


def test_an_outer_side_of_20_is_21_pixels_centred():
    depth = np.zeros((64, 64), dtype=np.float32)
    depth[30, 30] = 20.0
    alone = score_image(depth, FOCAL, 0.5, 20, 0.1, 1.0)[30, 30]
    for dv, du in [(10, 0), (-10, 0), (0, 10), (0, -10), (10, 10), (-10, -10)]:
        changed = depth.copy()
        changed[30 + dv, 30 + du] = 20.0
        assert score_image(changed, FOCAL, 0.5, 20, 0.1, 1.0)[30, 30] == pytest.approx(alone + 10.0)
        changed[30 + dv, 30 + du] = 0.0
        changed[30 + dv * 11 // 10, 30 + du * 11 // 10] = 20.0
        assert score_image(changed, FOCAL, 0.5, 20, 0.1, 1.0)[30, 30] == alone


def test_beyond_37_m_the_inner_box_is_one_pixel_and_costs_nothing():
    depth = np.zeros((64, 64), dtype=np.float32)
    depth[30, 30] = 40.0
    assert score_image(depth, FOCAL, 0.5, 20, 0.1, 1.0)[30, 30] < 1e-12  # the paper's argmin takes any such pixel


def test_outside_the_image_is_empty():
    depth = np.zeros((64, 64), dtype=np.float32)
    depth[0, 0] = 20.0
    assert score_image(depth, FOCAL, 0.5, 20, 0.1, 1.0)[0, 0] == 8 * 20.0


def test_an_inner_box_larger_than_the_outer_leaves_nothing_of_it():
    depth = np.full((64, 64), 3.0, dtype=np.float32)  # inner half 12 px > 10 px
    e_inner, e_outer = kernel_terms(depth, 32, 32, inner_half_px(3.0, FOCAL, 0.5), 10, 0.1)
    assert (e_inner, e_outer) == (0.0, 0.0)
    assert score_image(depth, FOCAL, 0.5, 20, 0.1, 1.0)[32, 32] == 0.0  # 25 x 25 px, all filled at this depth


@pytest.mark.parametrize("fill", [0.02, 0.3, 1.0])
@pytest.mark.parametrize(("low", "high"), [(1.0, 6.0), (8.0, 20.0), (5.0, 60.0)])
def test_the_fast_score_is_the_plain_double_loop(fill, low, high):
    rng = np.random.default_rng(int(fill * 100))
    depth = rng.uniform(low, high, (40, 150)).astype(np.float32)
    depth[rng.random(depth.shape) > fill] = 0.0
    fast, expected = score_image(depth, FOCAL, 0.5, 20, 0.1, 1.0), plain_some(depth, 60, rng)
    known = ~np.isnan(expected)
    assert known.any()
    np.testing.assert_allclose(fast[known], expected[known], rtol=2e-5, atol=1e-4)
    np.testing.assert_array_equal(np.isnan(fast), depth < 1.0)


def plain_some(depth, count, rng):
    """The plain loop at a few of the candidates (it is slow), border ones among them."""
    score = np.full(depth.shape, np.nan)
    candidates = np.argwhere(depth >= 1.0)
    chosen = candidates[rng.permutation(len(candidates))[:count]]
    for v, u in [*chosen, candidates[0], candidates[-1]]:
        k = inner_half_px(float(depth[v, u]), FOCAL, 0.5)
        score[v, u] = sum(kernel_terms(depth, v, u, k, 10, 0.1))
    return score


def test_the_plain_loop_is_the_equations_as_a_reader_writes_them():
    rng = np.random.default_rng(5)
    depth = rng.uniform(1.0, 50.0, (24, 30)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.5] = 0.0
    expected = plain(depth)
    for v, u in np.argwhere(depth > 0):
        k = inner_half_px(float(depth[v, u]), FOCAL, 0.5)
        assert sum(kernel_terms(depth, v, u, k, 10, 0.1)) == pytest.approx(expected[v, u])
    np.testing.assert_allclose(score_image(depth, FOCAL, 0.5, 20, 0.1, 1.0), expected, rtol=2e-5)


@pytest.mark.parametrize("settings", [(0.3, 20, 0.1), (0.8, 8, 0.05), (0.5, 31, 0.5)])
def test_every_setting_matters_as_in_the_plain_loop(settings):
    span, outer, eps = settings
    depth = street_depth()[230:262, 240:290].copy()
    depth[depth > 40] = 0
    depth[16, 20:24] = 20.0
    np.testing.assert_allclose(
        score_image(depth, FOCAL, span, outer, eps, 1.0),
        plain(depth, span=span, outer=outer, eps=eps),
        rtol=2e-5,
    )


def test_turning_or_mirroring_the_image_turns_the_score():
    depth = street_depth()
    score = score_image(depth, FOCAL, 0.5, 20, 0.1, 1.0)
    for change in (np.rot90, np.flipud, np.fliplr, np.transpose):
        changed = score_image(np.ascontiguousarray(change(depth)), FOCAL, 0.5, 20, 0.1, 1.0)
        np.testing.assert_allclose(changed, change(score), rtol=1e-5)


def test_shifting_the_image_shifts_the_score():
    depth = np.zeros((200, 200), dtype=np.float32)
    depth[60:140, 60:140] = np.random.default_rng(2).uniform(5, 30, (80, 80))
    score = score_image(depth, FOCAL, 0.5, 20, 0.1, 1.0)
    shifted = score_image(np.roll(depth, (17, -23), axis=(0, 1)), FOCAL, 0.5, 20, 0.1, 1.0)
    np.testing.assert_allclose(shifted, np.roll(score, (17, -23), axis=(0, 1)), rtol=1e-5)


def test_an_empty_image_scores_nothing():
    assert np.isnan(score_image(np.zeros((512, 512), dtype=np.float32), FOCAL, 0.5, 20, 0.1, 1.0)).all()
