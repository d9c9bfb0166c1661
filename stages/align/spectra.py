"""Yaw spectra: length of lines along each horizontal direction, and the overlap of the spectra of two cameras.

A line of the image lies on a great circle with normal n (level axes, z up). If the line is horizontal in the world,
its direction is where the circle meets the horizon:

    h = z x n / |z x n|,   azimuth = atan2(h_y, h_x) mod 180 deg,   sigma_azimuth = sigma |t . h| / |z x n|

with sigma the angular error of the line about its middle ray m and t = n x m: a roof edge overhead determines the
direction of its street well, an edge far away at the horizon hardly. The spectrum S(a) is the sum of one von Mises
kernel per line, with the length of the line as its area. The spectra of two cameras in the same street differ by the
yaw between them: it is where they overlap best. Most streets cross at right angles, and the cameras may see different
ones of them: here the yaw is determined modulo 90 deg.

Plain correlation would match the strongest street of one camera with the strongest of the other, even where these are
different streets; the overlap does not. Where streets have several angles it has several maxima: each is a match, with
a probability.

Source: ours, for P IV; DESIGN, Vision.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64, level_axes
from stages.kernels.align.spectra import BIN_RAD, BINS, add_kernels
from stages.messages import VanishingDirections

QUARTER = BINS // 2
BROAD_RAD = math.radians(4.0)  # lines with a larger azimuth sigma are not used
LONG_RAD = 0.5  # bound of the weight of a line
NEAR_BINS = 4  # directions this near to each other are the same
DIRECTION_SHARE = 0.04  # share of all lines from which a direction has full weight
LIKENESS_WEIGHT, NONE_LIKENESS = 6.3, 0.31  # see match_probabilities
LEAST_NONE = 0.02  # probability that no match is right, at least


@dataclass(frozen=True)
class LevelLines:
    """Lines of a camera that may be horizontal, in level axes: z is up, x is forward of the camera mount."""

    R_carrier_level: Array64  # (3, 3)
    tilt_sigma_rad: float  # of the vertical, each of two axes
    normal: Array64  # (m, 3)
    sigma_rad: Array64  # (m,) of n . h
    azimuth_rad: Array64  # (m,) in [0, pi)
    azimuth_sigma_rad: Array64  # (m,)
    weight: Array64  # (m,) length [rad], no more than LONG_RAD


def level_lines(seen: VanishingDirections, sharpest_rad: float) -> LevelLines | None:
    """Horizontal lines of an image; `sharpest_rad`: least azimuth sigma of a line. None: the image has no vertical."""
    upright = np.flatnonzero(seen.is_vertical)
    if upright.size == 0:
        return None
    chosen = np.flatnonzero(seen.line_direction >= 0)
    chosen = chosen[~seen.is_vertical[seen.line_direction[chosen]]]
    return _level(seen, seen.direction[upright[0]], float(seen.sigma_rad[upright[0]]), chosen, sharpest_rad)


def weighted_lines(seen: VanishingDirections, sharpest_rad: float) -> list[tuple[LevelLines, float]]:
    """Horizontal lines of each answer of an image, with its probability, as `level_lines`."""
    if seen.answers is None:
        lines = level_lines(seen, sharpest_rad)
        return [] if lines is None else [(lines, 1.0)]
    answers = seen.answers
    return [
        (
            _level(
                seen,
                answers.up[k],
                float(answers.sigma_rad[k]),
                np.flatnonzero(answers.line_direction[k] > 0),
                sharpest_rad,
            ),
            probability,
        )
        for k, probability in enumerate(answers.probability.tolist())
    ]


def _level(
    seen: VanishingDirections, up: Array64, tilt_sigma_rad: float, chosen: NDArray[np.int64], sharpest_rad: float
) -> LevelLines:
    """The chosen lines (m,) in the level axes of a vertical."""
    R = level_axes(up if up[2] >= 0 else -up)  # the camera mount is never upside down
    normal = seen.line_normal[chosen] @ R
    flat = np.maximum(np.hypot(normal[:, 0], normal[:, 1]), 1e-6)
    ends = seen.line_end[chosen]
    middle = ends.sum(axis=1) @ R
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-9)
    h = np.column_stack([-normal[:, 1], normal[:, 0]]) / flat[:, None]
    along = np.cross(normal, middle)
    sigma = seen.line_sigma_rad[chosen] * np.abs(along[:, 0] * h[:, 0] + along[:, 1] * h[:, 1])
    length = np.arccos(np.clip(np.einsum("ni,ni->n", ends[:, 0], ends[:, 1]), -1.0, 1.0))
    return LevelLines(
        R_carrier_level=R,
        tilt_sigma_rad=tilt_sigma_rad,
        normal=normal,
        sigma_rad=sigma,
        azimuth_rad=np.arctan2(h[:, 1], h[:, 0]) % math.pi,
        azimuth_sigma_rad=np.hypot(sigma / flat, sharpest_rad),
        weight=np.minimum(length, LONG_RAD),
    )


def spectrum(lines: LevelLines) -> Array64:
    """S (BINS,) over [0, 180) deg, bin k at k BIN_RAD; lines broader than BROAD_RAD are left out."""
    sharp = lines.azimuth_sigma_rad < BROAD_RAD
    out = np.zeros(BINS)
    add_kernels(lines.azimuth_rad[sharp], lines.azimuth_sigma_rad[sharp], lines.weight[sharp], out)
    return out


def overlap(vehicle: Array64, drone: Array64) -> Array64:
    """Overlap (QUARTER,) of two spectra (BINS,) at yaw = k BIN_RAD modulo 90 deg, from 0 to 1.

    The mean of two shares: of the vehicle's lines that run where the drone has any direction, and the other way round,

        L(yaw) = (sum_a p_v(a) q_d(a - yaw) + sum_a q_v(a) p_d(a - yaw)) / 2

    p is the spectrum folded to 90 deg with sum 1, q is 1 where p has a direction and 0 otherwise. Both cameras see the
    same directions, but not the same number of lines along them. Zeros when a spectrum is empty.
    """
    if vehicle.sum() <= 0 or drone.sum() <= 0:
        return np.zeros(QUARTER)
    p_v, p_d = folded(vehicle), folded(drone)
    product = np.fft.rfft(p_v) * np.conj(np.fft.rfft(_has_direction(p_d)))
    product += np.fft.rfft(_has_direction(p_v)) * np.conj(np.fft.rfft(p_d))
    return 0.5 * np.fft.irfft(product, QUARTER)


def folded(spectrum_: Array64) -> Array64:
    """Spectrum modulo 90 deg (QUARTER,), with sum 1; the spectrum must not be empty."""
    p = spectrum_[:QUARTER] + spectrum_[QUARTER:]
    return p / p.sum()


def nearby(p: Array64) -> Array64:
    """Sum (QUARTER,) of p within NEAR_BINS of each bin."""
    ends = np.concatenate([p[-NEAR_BINS:], p, p[:NEAR_BINS]])
    total = np.concatenate([[0.0], np.cumsum(ends)])
    return total[2 * NEAR_BINS + 1 :] - total[: -2 * NEAR_BINS - 1]


def _has_direction(p: Array64) -> Array64:
    return np.clip(nearby(p) / DIRECTION_SHARE - 0.3, 0.0, 1.0)


@dataclass(frozen=True)
class Peak:
    """One yaw at which the spectra match, modulo 90 deg."""

    yaw_rad: float  # in [0, pi / 2)
    likeness: float  # the overlap there


def peaks(correlation: Array64, separation_rad: float) -> list[Peak]:
    """Maxima, best first, at least `separation_rad` from any better one; interpolated between bins by a parabola."""
    left, right = np.roll(correlation, 1), np.roll(correlation, -1)
    tops = np.flatnonzero((correlation > left) & (correlation >= right) & (correlation > 0))
    found: list[Peak] = []
    for k in tops[np.argsort(-correlation[tops], kind="stable")].tolist():
        bend = left[k] - 2 * correlation[k] + right[k]
        position = (k + 0.5 * (left[k] - right[k]) / bend) * BIN_RAD
        if all(abs(quarter_difference(position - other.yaw_rad)) >= separation_rad for other in found):
            found.append(Peak(float(position % (math.pi / 2)), float(correlation[k])))
    return found


def match_probabilities(found: list[Peak]) -> Array64:
    """Probability (n,) that each match is the right one; 1 - sum: that none is.

    A softmax of the likenesses and of NONE_LIKENESS. Both constants maximise the likelihood of the true matches of 410
    pairs of images of ten simulated flights in five kinds of scenes (bench_measured_errors.py).
    """
    score = LIKENESS_WEIGHT * np.array([*(peak.likeness for peak in found), NONE_LIKENESS])
    share = np.exp(score - score.max())
    return (1.0 - LEAST_NONE) * share[:-1] / share.sum()


def quarter_difference(angle_rad: float) -> float:
    """The angle modulo 90 deg, nearest to zero: in [-45, 45) deg."""
    return (angle_rad + math.pi / 4) % (math.pi / 2) - math.pi / 4
