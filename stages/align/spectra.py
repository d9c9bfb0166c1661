"""Yaw spectra: how much line there is along each horizontal direction, and how two cameras' spectra lie on each other.

A line of the image lies on a great circle with normal n (level axes, z up). If the line is horizontal in the world,
its direction is where the circle meets the horizon:

    h = z x n / |z x n|,   azimuth = atan2(h_y, h_x) mod 180 deg,   sigma_azimuth = sigma |t . h| / |z x n|

with sigma the line's turn about its middle ray m and t = n x m: a roof's edge overhead tells its direction well and
one far away at the horizon hardly. The spectrum S(a) is the sum
of a von Mises kernel for each line, its area the line's length. Two cameras of the same street see spectra that are
turned by the yaw between them: it is where they overlap best. Streets cross at right angles more often than not and
one camera may see the one street, the other the other: yaw is told modulo 90 deg here.

Source: ours, for P IV; DESIGN, Vision: nearest matching of one frame per camera failed in 20 of 40. Plain correlation
lays the strongest street of the one camera on the strongest of the other, whichever they are: on streets at many
angles it was wrong in 13 of 20 tuning pairs where the overlap was wrong in none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.align.spectra import BIN_RAD, BINS, add_kernels
from stages.messages import VanishingDirections

QUARTER = BINS // 2
BROAD_RAD = math.radians(4.0)  # a line whose azimuth is worse says nothing of yaw
LONG_RAD = 0.5  # longer lines count no more
NEAR_BINS = 4  # directions this near to each other are the same
DIRECTION_SHARE = 0.04  # of all lines: a direction from which on it counts fully


@dataclass(frozen=True)
class LevelLines:
    """A camera's lines that may be horizontal, in level axes: z is up, x the camera_mount's forward."""

    R_carrier_level: Array64  # (3, 3)
    tilt_sigma_rad: float  # of up, each of two axes
    normal: Array64  # (m, 3)
    sigma_rad: Array64  # (m,) of n . h
    azimuth_rad: Array64  # (m,) in [0, pi)
    azimuth_sigma_rad: Array64  # (m,)
    weight: Array64  # (m,) length [rad], no more than LONG_RAD


def level_axes(up: Array64) -> Array64:
    """R_carrier_level (3, 3): z is `up` (3,), x the camera_mount's x made level (its y where x is upright)."""
    z = up / np.linalg.norm(up)
    forward = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = forward - (forward @ z) * z
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def level_lines(seen: VanishingDirections, sharpest_rad: float) -> LevelLines | None:
    """The horizontal lines of a image; `sharpest_rad` is how straight streets are. None: it has no vertical."""
    upright = np.flatnonzero(seen.is_vertical)
    if upright.size == 0:
        return None
    up = seen.direction[upright[0]]
    R = level_axes(up if up[2] >= 0 else -up)  # a camera_mount does not fly upside down
    chosen = np.flatnonzero(seen.line_direction >= 0)
    chosen = chosen[~seen.is_vertical[seen.line_direction[chosen]]]
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
        tilt_sigma_rad=float(seen.sigma_rad[upright[0]]),
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
    """Likeness (QUARTER,) of two spectra (BINS,) at yaw = k BIN_RAD modulo 90 deg, from 0 to 1.

    The mean of two shares: of the vehicle's lines that run where the drone has any direction, and the other way round,

        L(yaw) = (sum_a p_v(a) q_d(a - yaw) + sum_a q_v(a) p_d(a - yaw)) / 2

    p is the spectrum folded to 90 deg with sum 1, q is 1 where p has a direction and 0 elsewhere. Which directions
    there are is the same for both cameras; how many lines each has along them is not. Zeros when a spectrum is empty.
    """
    if vehicle.sum() <= 0 or drone.sum() <= 0:
        return np.zeros(QUARTER)
    p_v, p_d = folded(vehicle), folded(drone)
    product = np.fft.rfft(p_v) * np.conj(np.fft.rfft(_has_direction(p_d)))
    product += np.fft.rfft(_has_direction(p_v)) * np.conj(np.fft.rfft(p_d))
    return 0.5 * np.fft.irfft(product, QUARTER)


def folded(spectrum_: Array64) -> Array64:
    """Modulo 90 deg (QUARTER,), sum 1; the spectrum is not empty."""
    p = spectrum_[:QUARTER] + spectrum_[QUARTER:]
    return p / p.sum()


def nearby(p: Array64) -> Array64:
    """How much of p (QUARTER,) lies within NEAR_BINS of each bin."""
    ends = np.concatenate([p[-NEAR_BINS:], p, p[:NEAR_BINS]])
    total = np.concatenate([[0.0], np.cumsum(ends)])
    return total[2 * NEAR_BINS + 1 :] - total[: -2 * NEAR_BINS - 1]


def _has_direction(p: Array64) -> Array64:
    return np.clip(nearby(p) / DIRECTION_SHARE - 0.3, 0.0, 1.0)


def shared_directions(vehicle: Array64, drone: Array64, yaw_rad: float) -> int:
    """Directions modulo 90 deg along which both cameras have a good share of their lines."""
    if vehicle.sum() <= 0 or drone.sum() <= 0:
        return 0
    both = np.minimum(nearby(folded(vehicle)), np.roll(nearby(folded(drone)), round(yaw_rad / BIN_RAD)))
    return sum(1 for peak in peaks(both, 4 * NEAR_BINS * BIN_RAD) if peak.likeness > 2 * DIRECTION_SHARE)


@dataclass(frozen=True)
class Peak:
    """One yaw at which the spectra match, modulo 90 deg."""

    yaw_rad: float  # in [0, pi / 2)
    likeness: float


def peaks(correlation: Array64, apart_rad: float) -> list[Peak]:
    """Maxima, best first, each at least `apart_rad` from any better one; the place between bins is a parabola's."""
    left, right = np.roll(correlation, 1), np.roll(correlation, -1)
    tops = np.flatnonzero((correlation > left) & (correlation >= right) & (correlation > 0))
    found: list[Peak] = []
    for k in tops[np.argsort(-correlation[tops], kind="stable")].tolist():
        bend = left[k] - 2 * correlation[k] + right[k]
        place = (k + 0.5 * (left[k] - right[k]) / bend) * BIN_RAD
        if all(abs(quarter_difference(place - other.yaw_rad)) >= apart_rad for other in found):
            found.append(Peak(float(place % (math.pi / 2)), float(correlation[k])))
    return found


def quarter_difference(angle_rad: float) -> float:
    """The angle modulo 90 deg, nearest to zero: in [-45, 45) deg."""
    return (angle_rad + math.pi / 4) % (math.pi / 2) - math.pi / 4
