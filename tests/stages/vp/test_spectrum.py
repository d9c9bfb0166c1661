"""The yaw spectrum against a plain version of its formula, its peaks, and the support of a peak by parts of the lines."""

from __future__ import annotations

import math

import numpy as np

from stages.kernels.geometry.so3 import exp_rotation
from stages.kernels.vp.spectrum import APART_RAD, WIDEST_RAD
from stages.vp.directions import Lines
from stages.vp.spectrum import Spectrum, pair_support, peaks, wrap_90deg, yaw_spectrum

SIGMA = math.radians(0.25)


def any_lines(count, seed=0):
    rng = np.random.default_rng(seed)
    normal, middle = (rng.normal(size=(count, 3)) for _ in range(2))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    middle -= (middle * normal).sum(axis=1, keepdims=True) * normal
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    return Lines(normal, np.cross(normal, middle), rng.uniform(0.001, 0.05, count), rng.uniform(0.2, 1.0, count))


def test_the_spectrum_is_the_sum_of_a_kernel_for_each_free_line():
    lines, axes = any_lines(200), exp_rotation(np.array([0.1, -0.2, 0.7]))
    free = np.arange(200) % 3 > 0
    spectrum = yaw_spectrum(lines, axes, free, SIGMA, 90)
    total = np.zeros(90)
    for i in np.flatnonzero(free):
        along = np.cross(lines.normal[i], axes[:, 2])
        level = float(np.linalg.norm(along))
        x, y = along @ axes[:, 0], along @ axes[:, 1]
        sigma = math.hypot(lines.sigma_rad[i] * (lines.tangent[i] @ along) / level, 2 * SIGMA) / level
        if sigma < WIDEST_RAD:
            away = np.asarray(wrap_90deg(spectrum.yaw_rad - math.atan2(y, x)))
            total += lines.weight[i] * level * np.exp(-0.5 * (away / sigma) ** 2)
    np.testing.assert_allclose(spectrum.lines, total, atol=0.02)  # a kernel ends at three sigmas
    assert np.argmax(spectrum.score) == np.argmax(total)


def test_peaks_are_the_highest_separated_bins_also_across_90_deg():
    yaw_rad = (np.arange(180) + 0.5) * (math.pi / 360)
    score = np.zeros(180)
    score[[0, 5, 60, 65, 90, 179]] = 9.0, 8.0, 5.0, 6.0, 6.0, 8.5
    np.testing.assert_allclose(peaks(Spectrum(yaw_rad, score, score), 3), yaw_rad[[0, 65, 90]])
    every = peaks(Spectrum(yaw_rad, score, score), 50)
    off = np.abs(np.asarray(wrap_90deg(np.subtract.outer(np.array(every), np.array(every)))))
    assert 3 < len(every) < 50
    assert off[~np.eye(len(every), dtype=bool)].min() > APART_RAD


def horizontal_lines(yaws_rad, azimuths_rad):
    """Horizontal lines overhead-and-aside: one along each yaw, its middle at each azimuth, 40 deg above the horizon."""
    yaw, azimuth = np.asarray(yaws_rad), np.asarray(azimuths_rad)
    d = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))])
    m = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.full(len(yaw), math.tan(math.radians(40.0)))])
    normal = np.cross(d, m)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    m -= (m * d).sum(axis=1, keepdims=True) * d  # middle and direction at right angles: the nearest point of the line
    m /= np.linalg.norm(m, axis=1, keepdims=True)
    return Lines(normal, np.cross(normal, m), np.full(len(yaw), 0.002), np.ones(len(yaw)))


def support_of(lines, yaw_rad=0.3):
    return pair_support(lines, np.eye(3), np.ones(len(lines.normal), dtype=np.bool_), SIGMA, yaw_rad)


def test_a_pair_all_around_stands_out_in_each_direction_and_without_any_sector():
    k = np.arange(24)
    direction_score, elsewhere_score = support_of(horizontal_lines(0.3 + (k % 2) * math.pi / 2, k * math.tau / 24))
    assert direction_score > 8
    assert elsewhere_score > 8


def test_the_lines_of_one_object_do_not_stand_out_without_their_sector():
    one = horizontal_lines(np.full(24, 0.3), np.full(24, 0.3 + math.pi / 2))
    assert support_of(one)[1] <= 0


def test_shadows_have_one_direction_only():
    k = np.arange(24)
    direction_score, elsewhere_score = support_of(horizontal_lines(np.full(24, 0.3), k * math.tau / 24))
    assert direction_score <= 0
    assert elsewhere_score > 8


def test_support_is_the_same_whatever_the_yaw_of_the_axes():
    k = np.arange(30)
    yaw, azimuth = 0.3 + (k % 2) * math.pi / 2, k * 1.7
    a = support_of(horizontal_lines(yaw, azimuth))
    quarter = support_of(horizontal_lines(yaw + math.pi / 2, azimuth + math.pi / 2), 0.3 + math.pi / 2)
    np.testing.assert_allclose(a, quarter, atol=1e-6)
