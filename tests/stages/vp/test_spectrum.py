"""The yaw spectrum against a plain version of its formula, and its peaks."""

from __future__ import annotations

import math

import numpy as np

from stages.kernels.geometry.so3 import exp_rotation
from stages.kernels.vp.spectrum import APART_RAD, WIDEST_RAD
from stages.vp.directions import Lines
from stages.vp.spectrum import Spectrum, peaks, wrap_90deg, yaw_spectrum

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
