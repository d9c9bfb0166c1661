"""Directions of synthetic lines: formulas, symmetries, several frames, consistent sigmas."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from stages.geometry.frames import rotation_from_rpy_deg, rotation_z
from stages.kernels.vp.directions import GATE, NONE, PARTS, all_directions, parts_of, upright
from stages.vp.directions import Lines, assign, jackknife, refine, residual_sigma
from stages.vp.search import SearchLimits, VerticalPrior, find_structure
from stages.vp.spectrum import peaks, yaw_spectrum
from stages.vp.verticals import propose_verticals, refine_vertical

SIGMA = np.radians(0.25)
LIMITS = SearchLimits(SIGMA, np.radians(0.05), 0.3, 3, 4, 7.0, 2.0, 4.0, 3.0, 6.0, np.radians(15))
UP = np.array([0.0, 0.0, 1.0])


def lines_along(directions, each=20, turn_sigma_deg=0.5, noise_deg=0.2, seed=0, loose=0):
    """Lines at random positions along directions (k, 3), and lines of random direction."""
    rng = np.random.default_rng(seed)
    normals, middles, sigmas = [], [], []
    for d in np.vstack([np.repeat(directions, each, axis=0), rng.normal(size=(loose, 3))]):
        middle = rng.normal(size=3)
        middle /= np.linalg.norm(middle)
        n = np.cross(d, middle)
        n /= np.linalg.norm(n)
        sigma = np.radians(turn_sigma_deg) * rng.uniform(0.5, 1.5)
        n = n + rng.normal(0, sigma) * np.cross(n, middle)  # turned about its middle ray
        n = n + rng.normal(0, np.radians(noise_deg)) * d / np.linalg.norm(d)  # the world is not quite parallel
        normals.append(n / np.linalg.norm(n))
        middles.append(middle - normals[-1] * (normals[-1] @ middle))
        sigmas.append(sigma)
    normal = np.array(normals)
    middle = np.array(middles) / np.linalg.norm(middles, axis=1, keepdims=True)
    return Lines(normal, np.cross(normal, middle), np.array(sigmas), np.ones(len(normal)))


def off_deg(a, b):
    return np.degrees(np.arccos(np.clip(np.abs(a @ b), 0, 1)))


def test_the_residual_sigma_combines_line_and_model():
    lines = Lines(np.array([[0.0, 0, 1]]), np.array([[1.0, 0, 0]]), np.array([3e-3]), np.ones(1))
    assert residual_sigma(lines, np.array([1.0, 0, 0]), 4e-3)[0] == pytest.approx(5e-3)
    assert residual_sigma(lines, np.array([0.0, 1, 0]), 4e-3)[0] == pytest.approx(4e-3)


def test_axes_stand_upright_on_any_vertical():
    for v in (UP, np.array([0, 1.0, 0]), np.array([0.6, 0, -0.8])):
        axes = upright(v)
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1)
        np.testing.assert_allclose(axes[:, 2], v)
        directions = all_directions(axes, np.array([0.0, 0.3]))
        np.testing.assert_allclose(directions[1:] @ v, 0, atol=1e-12)
        assert directions[1] @ directions[2] == pytest.approx(0, abs=1e-12)
        assert directions[1] @ directions[3] == pytest.approx(np.cos(0.3))


def test_the_spectrum_peaks_at_the_street_s_yaw_modulo_90_deg():
    R = rotation_z(np.radians(20.0))
    for turned in (R, R @ rotation_z(np.pi / 2)):
        lines = lines_along(turned[:, :2].T, each=30)
        spectrum = yaw_spectrum(lines, np.eye(3), np.ones(len(lines.normal), dtype=bool), SIGMA, 180)
        assert np.degrees(peaks(spectrum, 1)[0]) == pytest.approx(20, abs=0.6)
        assert spectrum.score.max() > 15
    none = lines_along(np.empty((0, 3)), loose=60)
    assert yaw_spectrum(none, np.eye(3), np.ones(60, dtype=bool), SIGMA, 180).score.max() < LIMITS.min_score


def test_the_score_is_in_standard_deviations_of_yaws_drawn_at_random():
    sigma = 0.05
    lines = Lines(np.array([[0.0, 1, 0]]), np.array([[0.0, 0, 1]]), np.array([0.0]), np.array([0.5]))
    spectrum = yaw_spectrum(lines, np.eye(3), np.ones(1, dtype=bool), sigma / 2, 900)  # it runs along x
    share = math.sqrt(2 * math.pi) * sigma / (math.pi / 2)  # the kernel's mean over a 90 deg
    assert spectrum.lines.max() == pytest.approx(0.5, abs=1e-3)
    assert spectrum.lines.mean() == pytest.approx(0.5 * share, rel=0.01)
    deviation = 0.5 * math.sqrt(share / math.sqrt(2) - share**2)
    assert spectrum.score.max() == pytest.approx((0.5 - 0.5 * share) / deviation, rel=0.01)
    assert spectrum.lines.std() == pytest.approx(deviation, rel=0.02)


def test_the_vertical_is_found_from_a_start_some_degrees_off():
    truth = rotation_from_rpy_deg((3.0, -2.0, 0.0))
    lines = lines_along(truth[:, 2][None], each=30, loose=20)
    v = refine_vertical(lines, UP, UP, np.radians(5), SIGMA, np.radians(6))
    assert off_deg(v, truth[:, 2]) < 0.2


def test_proposals_hold_the_vertical_with_and_without_upright_lines():
    truth = rotation_from_rpy_deg((20.0, -10.0, 40.0))
    for rows in (truth.T, truth[:, :2].T):
        found = propose_verticals(lines_along(rows, loose=10), UP, np.radians(35), SIGMA, 45, 8)
        assert off_deg(found, truth[:, 2]).min() < 1.0


def test_refining_recovers_the_rotation_and_is_equivariant():
    truth = rotation_from_rpy_deg((4.0, -3.0, 25.0))
    lines = lines_along(truth.T)
    start = truth @ rotation_from_rpy_deg((1.0, -1.0, 1.5))
    s = refine(lines, start, np.zeros(1), truth[:, 2], np.radians(1), SIGMA)
    assert off_deg(s.axes.T, truth).diagonal().max() < 0.3
    R = rotation_from_rpy_deg((70.0, 20.0, -130.0))
    turned = Lines(lines.normal @ R.T, lines.tangent @ R.T, lines.sigma_rad, lines.weight)
    t = refine(turned, R @ start, np.zeros(1), R @ truth[:, 2], np.radians(1), SIGMA)
    np.testing.assert_allclose(t.axes, R @ s.axes, atol=1e-9)
    np.testing.assert_array_equal(t.assigned, s.assigned)
    np.testing.assert_allclose(t.information, s.information, rtol=1e-6, atol=1e-3)


def test_gravity_holds_the_vertical_where_lines_do_not():
    up = rotation_from_rpy_deg((2.0, -1.0, 0.0))[:, 2]
    towards_x = Lines(np.array([[0.0, 1, 0]]), np.array([[0.0, 0, 1]]), np.array([1e-3]), np.ones(1))
    s = refine(towards_x, np.eye(3), np.zeros(1), up, np.radians(1), SIGMA)
    assert off_deg(s.axes[:, 2], up) < 0.01


def test_lines_that_fit_no_direction_have_none():
    lines = lines_along(np.vstack([np.eye(3), [[0.6, 0.0, 0.8]]]), each=5)
    assigned, r, sigma = assign(lines, np.eye(3), SIGMA)
    assert (assigned[:15] == np.repeat([0, 1, 2], 5)).mean() > 0.8
    assert (assigned[15:] == NONE).mean() > 0.7
    np.testing.assert_allclose(np.abs(r[0]), np.abs(lines.normal[0] @ np.eye(3)[assigned[0]]))
    assert (sigma >= SIGMA).all()


def test_each_line_has_the_direction_that_it_is_fewest_sigmas_off():
    rng = np.random.default_rng(4)
    spread = lines_along(rng.normal(size=(60, 3)), each=5)
    near = lines_along(np.eye(3), each=30, seed=1)
    lines = Lines(*(np.concatenate([getattr(near, name), getattr(spread, name)]) for name in vars(near)))
    assigned, r, sigma = assign(lines, np.eye(3), SIGMA)
    off = np.abs(lines.normal) / np.array([residual_sigma(lines, d, SIGMA) for d in np.eye(3)]).T
    np.testing.assert_array_equal(assigned, np.where(off.min(axis=1) > GATE, NONE, off.argmin(axis=1)))
    own = assigned != NONE
    assert 90 < own.sum() < len(own)
    np.testing.assert_allclose(np.abs(r / sigma)[own], off.min(axis=1)[own])


def test_sigmas_are_consistent_with_the_errors():
    squares, places = [], []
    for seed in range(150):
        truth = rotation_from_rpy_deg((2.0, 1.0, 30.0 + seed))
        lines = lines_along(truth.T, each=6, seed=seed, loose=4)
        found = find_structure(lines, VerticalPrior(truth[:, 2], np.radians(3), 0.0), LIMITS)
        for d, sigma in zip(found.direction, found.sigma_rad, strict=True):
            off = np.radians(off_deg(truth.T, d).min())
            squares.append(off**2 / 2 / sigma**2)
            places.append(off < 2.45 * sigma)
    assert len(squares) > 400
    assert 0.4 < np.mean(squares) < 1.6
    assert np.mean(places) > 0.9


def test_two_horizontal_frames_are_separated_and_numbered_by_strength():
    other = rotation_z(np.radians(30.0))
    rows = np.vstack([np.eye(3), np.eye(3)[:2], other[:, :2].T])
    found = find_structure(lines_along(rows, each=12), VerticalPrior(UP, np.radians(3), 0.0), LIMITS)
    assert list(found.frame) == [-1, 0, 0, 1, 1]
    for k, d in enumerate(found.direction[1:]):
        assert off_deg(other.T if k >= 2 else np.eye(3), d).min() < 0.5
    assert found.sigma_rad[3] > found.sigma_rad[1]
    one = find_structure(
        lines_along(rows, each=12), VerticalPrior(UP, np.radians(3), 0.0), dataclasses.replace(LIMITS, max_frames=1)
    )
    assert list(one.frame) == [-1, 0, 0]


def test_a_further_pair_that_stands_out_less_is_stated_as_weak():
    other = rotation_z(np.radians(30.0))
    rows = np.vstack([np.eye(3), np.eye(3)[:2], other[:, :2].T])
    limits = dataclasses.replace(LIMITS, confident_elsewhere_score=100.0)
    found = find_structure(lines_along(rows, each=12), VerticalPrior(UP, np.radians(3), 0.0), limits)
    assert list(found.frame) == [-1, 0, 0, 1, 1]
    assert (np.degrees(found.sigma_rad[:3]) < 0.5).all()
    np.testing.assert_allclose(np.degrees(found.sigma_rad[3:]), 15.0, atol=0.1)
    assert found.reason.startswith("2 horizontal frames (1 weak)")


def test_a_board_with_more_lines_than_the_building_is_stated_as_weak_and_alone_it_is_not():
    turned = rotation_z(np.radians(30.0))
    on_all_sides = lines_along(turned[:, :2].T, each=300, seed=5)
    middle = np.cross(on_all_sides.tangent, on_all_sides.normal)
    near = np.abs(np.arctan2(middle[:, 1], middle[:, 0])) < np.radians(35.0)
    board = Lines(*(getattr(on_all_sides, name)[near] for name in vars(on_all_sides)))
    building = lines_along(np.vstack([np.eye(3), np.eye(3)[:2]]), each=12)
    both = Lines(*(np.concatenate([getattr(building, name), getattr(board, name)]) for name in vars(board)))
    found = find_structure(both, VerticalPrior(UP, np.radians(3), 0.0), LIMITS)
    assert list(found.frame) == [-1, 0, 0, 1, 1]
    for f, truth, sigma_deg in ((0, turned, 15.0), (1, np.eye(3), 0.0)):
        assert (off_deg(truth.T, found.direction[found.frame == f].T).min(axis=0) < 0.5).all()
        np.testing.assert_allclose(np.degrees(found.sigma_rad[found.frame == f]), sigma_deg, atol=0.5)
    alone = find_structure(board, VerticalPrior(UP, np.radians(3), 0.0), LIMITS)
    assert (np.degrees(alone.sigma_rad[alone.frame == 0]) < 1.0).all()


@pytest.mark.parametrize(("apart_deg", "frames"), [(3.0, {-1, 0}), (7.0, {-1, 0, 1})])
def test_pairs_are_separated_from_some_degrees_on(apart_deg, frames):
    nearby = rotation_z(np.radians(apart_deg))
    rows = np.vstack([np.eye(3), np.eye(3)[:2], nearby[:, :2].T])
    found = find_structure(lines_along(rows, each=12), VerticalPrior(UP, np.radians(3), 0.0), LIMITS)
    assert set(found.frame) == frames
    for f, truth in ((0, np.eye(3)), (1, nearby)):
        assert (off_deg(truth.T, found.direction[found.frame == f].T).min(axis=0) < 0.5).all()


def test_random_lines_are_no_structure_and_have_a_reason():
    found = find_structure(lines_along(np.empty((0, 3)), loose=80), VerticalPrior(UP, np.radians(3), 0.0), LIMITS)
    assert not (found.frame >= 0).any()
    assert "best score" in found.reason
    few = find_structure(lines_along(np.eye(3)[:1], each=2), VerticalPrior(UP, np.radians(3), 0.0), LIMITS)
    assert len(few.direction) == 0
    assert "too few" in few.reason
    assert list(few.line_direction) == [-1, -1]


def without_lines(lines, drop):
    return Lines(*(getattr(lines, field.name)[~drop] for field in dataclasses.fields(lines)))


def test_the_jackknife_is_the_spread_of_estimates_without_one_part_of_azimuth():
    lines = lines_along(np.eye(3), each=40, noise_deg=0.4, seed=3)
    whole = refine(lines, np.eye(3), np.zeros(1), UP, np.radians(3), SIGMA, 30)
    part = parts_of(lines.normal, lines.tangent, whole.axes)
    assert set(part) == set(range(PARTS))
    expected = np.zeros((3, 3))
    for k in range(PARTS):
        other = refine(without_lines(lines, part == k), whole.axes, np.zeros(1), UP, np.radians(3), SIGMA, 30)
        turn = whole.axes.T @ other.axes
        step = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        expected += (PARTS - 1) / PARTS * np.outer(step, step)
    found = jackknife(lines, whole, SIGMA)
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.sqrt(np.diag(expected)), rtol=0.3)


def leaning(azimuth_deg, lean_deg, each, seed):
    """Lines along a direction `lean_deg` off the vertical, all in the image of one object at an azimuth."""
    rng = np.random.default_rng(seed)
    azimuth, lean = np.radians(azimuth_deg), np.radians(lean_deg)
    d = np.array([-np.sin(lean) * np.sin(azimuth), np.sin(lean) * np.cos(azimuth), np.cos(lean)])
    normals, tangents = [], []
    for at in azimuth + rng.normal(0, 0.05, each):
        middle = np.array([np.cos(at), np.sin(at), rng.uniform(0.2, 1.0)])
        middle /= np.linalg.norm(middle)
        n = np.cross(d, middle) / np.linalg.norm(np.cross(d, middle))
        normals.append(n)
        tangents.append(np.cross(n, middle))
    return Lines(np.array(normals), np.array(tangents), np.full(each, np.radians(0.1)), np.ones(each))


def test_a_vertical_on_which_parts_of_the_image_disagree_has_a_larger_sigma_or_is_not_stated():
    poles = lines_along(np.eye(3)[2:], each=6, noise_deg=0.1, seed=2)
    prior = VerticalPrior(UP, np.radians(3), 0.0)
    alone = find_structure(poles, prior, LIMITS)
    assert list(alone.frame) == [-1]
    assert np.degrees(alone.sigma_rad[0]) < 0.6
    for lean_deg, each in ((1.2, 8), (2.0, 8), (0.9, 3)):
        streaks = leaning(70.0, lean_deg, each, seed=4)
        fields = [field.name for field in dataclasses.fields(Lines)]
        both = Lines(*(np.concatenate([getattr(poles, name), getattr(streaks, name)]) for name in fields))
        found = find_structure(both, prior, LIMITS)
        assert not len(found.direction) or off_deg(UP, found.direction[0]) < 3 * np.degrees(found.sigma_rad[0])
    assert "parts" in found.reason or found.sigma_rad[0] > 1.5 * alone.sigma_rad[0]
    apart = find_structure(leaning(70.0, 0.0, 20, seed=4), prior, LIMITS)
    assert "one part of the image" in apart.reason
