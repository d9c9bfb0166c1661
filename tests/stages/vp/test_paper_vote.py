"""Grid vote: cells, the weight by hand, where most lines meet; the best two and their cross product."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.kernels.vp.paper_vote import cell_of, fullest, fullest_in_image, vote, vote_in_image
from stages.vp.paper_vote import complete, most_orthogonal

RNG = np.random.default_rng(4)
NONE, APART = np.empty((0, 3)), math.radians(20.0)


def unit(*v):
    return np.array(v, dtype=np.float64) / np.linalg.norm(v)


def lines_through(v, n, noise_rad=0.0, rng=RNG):
    """Normals of great circles through v, each turned by a little."""
    normals = np.cross(v, rng.normal(size=(n, 3)))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals += noise_rad * rng.normal(size=(n, 3))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1))
@settings(max_examples=100, deadline=None)
def test_a_direction_and_its_opposite_share_a_cell(v):
    v = unit(*v)
    assert cell_of(v, 90) == cell_of(-v, 90)
    face, row, column = cell_of(v, 90)
    assert face == int(np.argmax(np.abs(v)))
    assert 0 <= row < 90
    assert 0 <= column < 90


def test_cells_are_evenly_spaced_by_angle():
    """On the x face, 90 cells for 90 deg: a = y / x = tan(10.5 deg) lies in the middle of cell 45 + 10."""
    t = math.tan(math.radians(10.5))
    assert cell_of(unit(1, t, 0), 90) == (0, 55, 45)
    assert cell_of(unit(1, 0, -t), 90) == (0, 45, 34)
    assert cell_of(unit(0, 1, t), 90) == (1, 55, 45), "y face: rows by z, columns by x"
    assert cell_of(unit(t, 0, 1), 90) == (2, 55, 45), "z face: rows by x, columns by y"


def test_two_lines_vote_where_they_meet_with_the_weight_of_the_formula():
    """n_1 = y, n_2 = (0, 1, 1)/sqrt 2: they meet in x. w = 30 * 50 * |sin(2 * 20 deg)|."""
    normals = np.stack([unit(0, 1, 0), unit(0, 1, 1)])
    votes, sums = vote(normals, np.array([30.0, 50.0]), np.radians([25.0, 5.0]), 90, NONE, APART)
    w = 30 * 50 * math.sin(math.radians(40))
    assert votes.sum() == pytest.approx(w)
    assert votes[cell_of(np.array([1.0, 0, 0]), 90)] == pytest.approx(w)
    np.testing.assert_allclose(sums.sum(axis=(0, 1, 2)), [w, 0, 0], atol=1e-9)


def test_lines_that_are_parallel_or_at_right_angles_in_the_view_have_no_vote():
    normals = np.stack([unit(0, 1, 0), unit(0, 1, 1)])
    for angle_deg in (0.0, 90.0, 180.0):
        votes, _ = vote(normals, np.ones(2), np.radians([angle_deg, 0.0]), 90, NONE, APART)
        assert votes.sum() == pytest.approx(0.0, abs=1e-12)


def test_the_same_line_twice_has_no_vote():
    normals = np.stack([unit(0, 1, 0)] * 2)
    assert vote(normals, np.ones(2), np.radians([45.0, 0.0]), 90, NONE, APART)[0].sum() == 0.0


@pytest.mark.parametrize("v", [(1, 0, 0), (0, 0, 1), (1, 1, 0), (1, -2, 3), (0.2, 0.9, -0.9)])
def test_the_fullest_cell_is_where_most_lines_meet(v):
    rng = np.random.default_rng(1)
    normals = np.concatenate([lines_through(unit(*v), 40, 0.002, rng), lines_through(unit(3, 1, -1), 12, 0.002, rng)])
    normals = np.concatenate([normals, lines_through(unit(-1, 1, 4), 20, 1.0, rng)])
    found, share = fullest(
        *vote(normals, np.ones(len(normals)), rng.uniform(0, math.pi, len(normals)), 90, NONE, APART)
    )
    assert np.linalg.norm(found) == pytest.approx(1.0)
    assert abs(found @ unit(*v)) > math.cos(math.radians(0.5))
    assert 0.1 < share < 1.0


def test_votes_near_a_taken_direction_do_not_count_on_either_side_of_the_sphere():
    rng = np.random.default_rng(2)
    first, second = unit(1, 0.2, 0), unit(0, 0.3, 1)
    normals = np.concatenate([lines_through(first, 40, 0.002, rng), lines_through(second, 15, 0.002, rng)])
    lines = normals, np.ones(len(normals)), rng.uniform(0, math.pi, len(normals)), 90
    assert abs(fullest(*vote(*lines, NONE, APART))[0] @ first) > 0.999
    assert abs(fullest(*vote(*lines, -first[None], APART))[0] @ second) > 0.999
    assert abs(fullest(*vote(*lines, first[None], 0.0))[0] @ first) > 0.999, "separation 0: counts"


def test_without_lines_there_is_no_vote():
    empty = np.empty((0, 3)), np.empty(0), np.empty(0)
    assert fullest(*vote(*empty, 90, NONE, APART))[1] == 0.0


def test_the_two_nearest_to_a_right_angle_are_taken():
    directions = np.stack([unit(1, 0, 0), unit(1, 0.1, 0), unit(0.05, 1, 0), unit(0, 0.7, 0.7)])
    i, j, angle = most_orthogonal(directions)
    assert (i, j) == (0, 3)
    assert angle == pytest.approx(math.pi / 2)


def test_the_sign_of_a_direction_does_not_matter_for_its_angle():
    i, j, angle = most_orthogonal(np.stack([unit(1, 0, 0), unit(-1, 1, 0)]))
    assert (i, j) == (0, 1)
    assert angle == pytest.approx(math.pi / 4)


def test_the_third_is_the_cross_product_of_length_one():
    three = complete(unit(1, 0, 0), unit(1, 1, 0))
    np.testing.assert_allclose(three, [[1, 0, 0], [math.sqrt(0.5), math.sqrt(0.5), 0], [0, 0, 1]], atol=1e-12)


def test_two_segments_vote_for_the_pixel_where_their_lines_meet():
    """v = 10 and v = u - 20 meet at (30, 10): lengths 20 and 10 sqrt 2, 45 deg apart; 10 px cells."""
    segments = np.array([[0.0, 10, 20, 10], [60, 40, 70, 50]])
    votes, sums = vote_in_image(segments, 100, 10)
    w = 20 * 10 * math.sqrt(2)
    assert votes[1, 3] == pytest.approx(w)
    assert votes.sum() == pytest.approx(w)
    np.testing.assert_allclose(sums[1, 3], [30 * w, 10 * w])
    assert fullest_in_image(votes, sums) == pytest.approx((30, 10, 1))


def test_lines_that_meet_outside_the_view_or_are_parallel_have_no_vote():
    for other in ([60, 65, 70, 70], [0, 20, 20, 20], [60, 50, 60, 90]):  # at u = -50, parallel, at right angles
        votes, _ = vote_in_image(np.array([[0.0, 10, 20, 10], other]), 100, 10)
        assert votes.sum() == pytest.approx(0.0, abs=1e-9)


def test_the_image_begins_half_a_pixel_before_the_centre_of_its_first_pixel():
    """Lines that meet at u = 29.6: 30.1 px from the edge, in the fourth cell of 10 px."""
    segments = np.array([[0.0, 10, 20, 10], [59.6, 40, 69.6, 50]])
    votes, _ = vote_in_image(segments, 100, 10)
    assert votes[1, 3] == pytest.approx(votes.sum())


def test_the_fullest_place_counts_the_neighbours_of_a_cell():
    votes, sums = np.zeros((6, 6)), np.zeros((6, 6, 2))
    votes[0, 0] = 3.0  # the fullest cell
    votes[3:5, 3:5] = 2.0  # the fullest block
    sums[0, 0] = 3.0 * np.array([5.0, 5.0])
    sums[3:5, 3:5] = 2.0 * np.array([40.0, 42.0])
    assert fullest_in_image(votes, sums) == pytest.approx((40.0, 42.0, 8 / 11))


def test_the_fullest_cell_of_the_image_is_where_most_lines_meet():
    rng = np.random.default_rng(3)
    towards = np.repeat([[71.2, 33.7], [20.0, 80.0]], [30, 12], axis=0) + rng.normal(0, 0.3, (42, 2))
    start = rng.uniform(0, 100, (42, 2))
    segments = np.hstack([start, start + 0.3 * (towards - start)])
    u, v, share = fullest_in_image(*vote_in_image(segments, 100, 20))
    assert math.hypot(u - 71.2, v - 33.7) < 1.0
    assert 0.1 < share < 1.0
