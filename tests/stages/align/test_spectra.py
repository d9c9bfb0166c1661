"""Yaw spectra by formula, their symmetries, and streets that only one camera sees."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from stages.align.spectra import (
    LEAST_NONE,
    QUARTER,
    LevelLines,
    Peak,
    level_lines,
    match_probabilities,
    nearby,
    overlap,
    peaks,
    quarter_difference,
    spectrum,
)
from stages.geometry.frames import level_axes
from stages.kernels.align.spectra import BIN_RAD, BINS
from stages.messages import CameraMount
from tests.stages.align.made_lines import ATLANTA, CAMPUS, MANHATTAN, nothing, seen, turned

STRAIGHT = math.radians(0.25)


def lines_at(azimuth_deg, sigma_deg=0.5, weight=0.2) -> LevelLines:
    """Lines overhead, so that their normals are level."""
    azimuth = np.radians(np.atleast_1d(np.asarray(azimuth_deg, dtype=float)))
    normal = np.column_stack([np.sin(azimuth), -np.cos(azimuth), 0 * azimuth])
    sigma = np.full(len(azimuth), math.radians(sigma_deg))
    return LevelLines(np.eye(3), 0.01, normal, sigma, azimuth % math.pi, sigma, np.full(len(azimuth), weight))


def spectrum_at(azimuth_deg, **kwargs):
    return spectrum(lines_at(azimuth_deg, **kwargs))


def yaw_between(vehicle, drone):
    """Degrees, of the best match."""
    return math.degrees(peaks(overlap(vehicle, drone), math.radians(4))[0].yaw_rad)


def test_a_line_has_the_azimuth_of_its_direction_and_its_turn_as_sigma():
    """h = z x n / |z x n|, sigma |t . h| / |z x n| with t = n x m, and the straightness of streets."""
    image = seen(CameraMount.VEHICLE, np.eye(3), (30.0,), per_direction=6, verticals=0, sigma_rad=0.006)
    lines = level_lines(image, STRAIGHT)
    assert lines is not None
    np.testing.assert_allclose(np.degrees(lines.azimuth_rad), 30.0, atol=3.0)
    for i, (n, ends) in enumerate(zip(image.line_normal, image.line_end, strict=True)):
        middle = ends.sum(axis=0) / np.linalg.norm(ends.sum(axis=0))
        level = np.cross([0, 0, 1], n)
        flat = np.linalg.norm(level)
        h = level / flat
        assert lines.azimuth_rad[i] == pytest.approx(math.atan2(h[1], h[0]) % math.pi)
        sigma = 0.006 * abs(np.cross(n, middle) @ h)
        assert lines.sigma_rad[i] == pytest.approx(sigma)
        assert lines.azimuth_sigma_rad[i] == pytest.approx(math.hypot(sigma / flat, STRAIGHT))
        assert lines.weight[i] == pytest.approx(min(math.acos(ends[0] @ ends[1]), 0.5))


def test_a_kernel_has_its_lines_weight_as_area_and_its_sigma_as_width():
    s = spectrum_at(40.0, sigma_deg=1.0, weight=0.3)
    assert s.sum() * BIN_RAD == pytest.approx(0.3, rel=1e-3)
    assert s.argmax() == 160
    assert s[164] / s[160] == pytest.approx(math.exp(-0.5), rel=1e-6)  # one degree is four bins and one sigma


def test_a_kernel_at_the_seam_wraps_around():
    s = spectrum_at(0.1)
    assert s[0] > 0
    assert s[BINS - 1] > 0
    np.testing.assert_allclose(np.roll(spectrum_at(50.1), -200), s, atol=1e-9)


def test_a_line_with_an_uncertain_azimuth_is_ignored():
    assert spectrum_at(40.0, sigma_deg=5.0).sum() == 0


@pytest.mark.parametrize("yaw_deg", [0.0, 0.3, 17.0, 44.9, 89.9])
@pytest.mark.parametrize("streets", [MANHATTAN, ATLANTA, CAMPUS])
def test_the_overlap_peaks_at_the_yaw_between_the_cameras(streets, yaw_deg):
    vehicle = spectrum_at(np.array(streets))
    drone = spectrum_at(np.array(streets) - yaw_deg)
    assert quarter_difference(math.radians(yaw_between(vehicle, drone) - yaw_deg)) == pytest.approx(
        0.0, abs=math.radians(0.15)
    )
    assert overlap(vehicle, drone).max() == pytest.approx(1.0, abs=0.02)


def test_how_many_lines_run_along_a_street_does_not_matter():
    """The vehicle has the most lines along one street, the drone along another."""
    vehicle = spectrum_at([0.0] * 30 + [34.0] * 5 + [61.0] * 5)
    drone = spectrum_at([0.0 - 10] * 5 + [34.0 - 10] * 30 + [61.0 - 10] * 5)
    assert yaw_between(vehicle, drone) == pytest.approx(10.0, abs=0.2)


def test_cameras_on_two_crossing_streets_match_at_90_deg():
    assert yaw_between(spectrum_at([20.0] * 8), spectrum_at([110.0] * 8)) == pytest.approx(0.0, abs=0.2)


def test_lines_in_all_directions_have_no_best_match():
    rng = np.random.default_rng(3)
    likeness = overlap(spectrum_at(rng.uniform(0, 180, 400)), spectrum_at(rng.uniform(0, 180, 400)))
    assert np.ptp(likeness) < 0.15


def test_without_lines_the_overlap_is_zero():
    none = np.zeros(BINS)
    np.testing.assert_array_equal(overlap(none, spectrum_at(3.0)), np.zeros(QUARTER))
    assert peaks(overlap(none, none), 0.1) == []


def test_a_better_match_is_more_probable_and_none_is_never_excluded():
    one, other = Peak(0.1, 0.9), Peak(0.7, 0.6)
    alone, both = match_probabilities([one]), match_probabilities([one, other])
    assert 0.9 < alone[0] <= 1.0 - LEAST_NONE
    assert both[0] > 5 * both[1]
    assert both.sum() < 1.0 - 0.5 * LEAST_NONE
    assert match_probabilities([]).shape == (0,)
    np.testing.assert_allclose(match_probabilities([other, other]), match_probabilities([other, other])[::-1])


def test_nearby_is_a_sum_over_neighbours_across_the_seam():
    p = np.zeros(QUARTER)
    p[0], p[4], p[-5] = 1.0, 2.0, 4.0
    near = nearby(p)
    assert near[0] == 3.0
    assert near[-1] == 5.0
    assert near[8] == 2.0
    assert near.sum() == pytest.approx(9 * 7)


def test_a_peak_between_bins_and_a_lower_one_too_near_is_dropped():
    k = np.arange(QUARTER)
    curve = np.exp(-0.5 * ((k - 100.4) / 5) ** 2) + 0.5 * np.exp(-0.5 * ((k - 112) / 2) ** 2)
    curve += 0.4 * np.exp(-0.5 * ((k - 300) / 5) ** 2)
    found = peaks(curve, math.radians(4))
    assert [round(p.yaw_rad / BIN_RAD) for p in found] == [100, 300]
    assert found[0].yaw_rad / BIN_RAD == pytest.approx(100.4, abs=0.1)


def test_level_axes_keep_the_heading_and_stand_upright():
    R = level_axes(turned(10.0, -20.0, 0.0).T[:, 2])
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R[:, 2], turned(10.0, -20.0, 0.0).T[:, 2])
    assert R[:, 0] @ np.cross([1.0, 0.0, 0.0], R[:, 2]) == pytest.approx(0.0)  # x stays in the plane of x and up
    assert R[0, 0] > 0.9
    np.testing.assert_allclose(level_axes(np.array([2.0, 0.0, 0.0]))[:, 2], [1, 0, 0])  # nose up: some axes


def test_an_inverted_vertical_is_equivalent():
    image = seen(CameraMount.DRONE, turned(4.0, 7.0, 33.0))
    flipped = dataclasses.replace(image, direction=-image.direction)
    a, b = level_lines(image, STRAIGHT), level_lines(flipped, STRAIGHT)
    assert a is not None
    assert b is not None
    np.testing.assert_array_equal(a.azimuth_rad, b.azimuth_rad)


def test_an_image_without_vertical_has_no_level_lines():
    assert level_lines(nothing(CameraMount.DRONE), STRAIGHT) is None


def test_verticals_and_lines_without_direction_are_ignored():
    lines = level_lines(seen(CameraMount.DRONE, np.eye(3), per_direction=(3, 4), verticals=9), STRAIGHT)
    assert lines is not None
    assert len(lines.weight) == 7


@pytest.mark.parametrize(("angle_deg", "nearest_deg"), [(0, 0), (46, -44), (-46, 44), (90, 0), (200, 20), (45, -45)])
def test_quarter_difference(angle_deg, nearest_deg):
    assert math.degrees(quarter_difference(math.radians(angle_deg))) == pytest.approx(nearest_deg, abs=1e-9)
