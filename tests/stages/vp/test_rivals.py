"""Rival structures: their probability by formula, symmetries, and what they do to the answer of the search."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from stages.geometry.frames import rotation_from_rpy_deg, rotation_z
from stages.kernels.vp.directions import PARTS
from stages.kernels.vp.rivals import agreement_of_parts, equal_parts
from stages.vp import search
from stages.vp.directions import Lines, refine
from stages.vp.rivals import Rivals, compare, probability_better, turn_between
from stages.vp.search import VerticalPrior, find_structure
from tests.stages.vp.test_directions import LIMITS, SIGMA, UP, lines_along

CONE = VerticalPrior(UP, math.radians(20.0), math.radians(45.0))
ONE_FRAME = dataclasses.replace(LIMITS, max_frames=1)


def together(*some: Lines) -> Lines:
    return Lines(*(np.concatenate([getattr(a, f.name) for a in some]) for f in dataclasses.fields(Lines)))


def frame(R, **values):
    """Lines along the three axes of a Manhattan frame."""
    return lines_along(R.T, **values)


def test_the_probability_that_a_rival_is_better_is_that_of_the_difference_s_sampling_error():
    difference = np.array([1.0, 2.0, 3.0, -1.0])  # sum 5, sigma = sqrt(4 * 2.9167)
    assert probability_better(difference) == pytest.approx(0.5 * math.erfc(5.0 / math.sqrt(2 * 4 * 2.916667)), abs=1e-6)
    assert probability_better(-difference) == 0.5
    assert probability_better(np.full(8, 0.3)) < 1e-9  # each part prefers the best


def test_the_turn_between_two_frames_is_modulo_90_deg_of_yaw():
    R = rotation_from_rpy_deg((3.0, -5.0, 40.0))
    small = rotation_from_rpy_deg((1.0, -0.5, 2.0))
    for k in range(4):
        turn = turn_between(R, R @ small @ rotation_z(k * math.pi / 2))
        np.testing.assert_allclose(np.degrees(turn), [1.0, -0.5, 2.0], atol=0.05)
    other_pair = R @ rotation_from_rpy_deg((1.0, 0.0, 0.0)) @ rotation_z(math.radians(30.0))
    np.testing.assert_allclose(np.degrees(turn_between(R, other_pair)), [1.0, 0.0, 0.0], atol=1e-3)  # the vertical's


def test_a_rival_widens_a_direction_by_its_turn_and_share():
    rivals = Rivals((), np.array([[0.0, 0.0, 0.02]]), np.array([0.25]))
    np.testing.assert_allclose(rivals.variance_rad2(np.eye(3)), [1e-4, 1e-4, 0.0], atol=1e-12)


@pytest.mark.parametrize("width_deg", [40.0, 360.0])
def test_parts_have_equal_weight_whatever_the_width_of_the_image(width_deg):
    rng = np.random.default_rng(1)
    azimuth = np.radians(170.0 + rng.uniform(0, width_deg, 400))  # across the jump of the azimuth
    middle = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(400)])
    normal = np.tile(UP, (400, 1))
    weight = rng.uniform(0.2, 1.0, 400)
    part = equal_parts(normal, np.cross(normal, middle), weight, np.eye(3))
    of_part = np.bincount(part, weight, minlength=PARTS)
    assert of_part == pytest.approx(weight.sum() / PARTS, abs=1.1)
    for k in range(PARTS):  # of neighbouring azimuths
        assert np.degrees(np.ptp(np.unwrap(np.sort(azimuth[part == k])))) < 1.5 * width_deg / PARTS


def test_the_agreement_of_the_parts_sums_to_that_of_the_refinement():
    lines = frame(np.eye(3), loose=20)
    s = refine(lines, np.eye(3), np.zeros(1), UP, math.radians(20.0), SIGMA)
    part = equal_parts(lines.normal, lines.tangent, lines.weight, s.axes)
    parts = agreement_of_parts(lines.normal, lines.tangent, lines.sigma_rad, lines.weight, s.axes, SIGMA, part)
    assert parts.sum() == pytest.approx(s.agreement)
    assert np.count_nonzero(parts) == PARTS


def test_two_structures_some_degrees_apart_have_a_sigma_that_covers_both(monkeypatch):
    turned = rotation_from_rpy_deg((1.6, -1.2, 1.8))
    options = {"each": 30, "turn_sigma_deg": 0.2, "noise_deg": 0.05}
    lines = together(frame(np.eye(3), seed=3, **options), frame(turned, seed=4, **options))
    found = find_structure(lines, CONE, ONE_FRAME)

    def within(found, R):
        off = np.degrees(np.arccos(np.clip(np.abs(found.direction @ R).max(axis=1), 0, 1)))
        return (off < 3.0 * np.degrees(found.sigma_rad)).all()

    assert within(found, np.eye(3))
    assert within(found, turned)
    monkeypatch.setattr(search, "compare", lambda *_: Rivals((), np.empty((0, 3)), np.empty(0)))
    without = find_structure(lines, CONE, ONE_FRAME)
    assert not (within(without, np.eye(3)) and within(without, turned))


def test_two_structures_with_other_verticals_are_ambiguous_unless_one_is_better_in_every_part():
    turned = rotation_from_rpy_deg((9.0, 4.0, 5.0))
    equal = together(frame(np.eye(3), seed=3), frame(turned, seed=4))
    found = find_structure(equal, CONE, ONE_FRAME)
    assert len(found.direction) == 0
    assert "ambiguous" in found.reason
    assert found.answers is not None
    assert found.answers.probability.sum() == pytest.approx(1.0)
    assert np.all(np.abs(found.answers.probability - 0.5) < 0.45)
    for up, truth in zip(found.answers.up[np.argsort(found.answers.up[:, 0])], (UP, turned[:, 2]), strict=True):
        assert np.degrees(np.arccos(up @ truth)) < 0.5
    along_pair = (found.answers.line_direction > 0).sum(axis=1)
    assert np.all(along_pair >= 30)
    weaker = together(frame(np.eye(3), seed=3, each=40), frame(turned, seed=4, each=8))
    assert len(find_structure(weaker, CONE, ONE_FRAME).direction) == 3


def test_a_clear_structure_has_no_rival():
    lines = frame(np.eye(3), seed=5, each=30, loose=10)
    rivals = compare(lines, np.eye(3), [np.eye(3), rotation_from_rpy_deg((2.5, 0.0, 0.0))], SIGMA)
    assert not rivals.answers
    assert np.degrees(np.sqrt(rivals.variance_rad2(np.eye(3)))).max() < 0.02
