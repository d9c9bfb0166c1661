"""Series on an even time grid (interpolation, random processes, low-pass) and rotation vectors.

Source: ours.
"""

from __future__ import annotations

import numpy as np

from links.simulated.kernels.motion import first_order_recursion
from stages.geometry.frames import Array64, rotations_from_xyzw


def interpolate(rows: Array64, step_s: float, time_s: Array64) -> Array64:
    """Linear interpolation of rows (k,) or (k, d), one per `step_s`, at times (n,); constant beyond both ends."""
    at = np.clip(time_s / step_s, 0.0, len(rows) - 1.0)
    step = np.minimum(at.astype(np.int64), len(rows) - 2)
    share = (at - step).reshape(-1, *[1] * (rows.ndim - 1))
    return (1 - share) * rows[step] + share * rows[step + 1]


def random_walk(white: Array64, sigma_per_sqrt_s: float, step_s: float) -> Array64:
    """Random walk from zero: after t seconds its sigma is sigma_per_sqrt_s sqrt(t)."""
    total = np.cumsum(white, axis=0)
    return sigma_per_sqrt_s * np.sqrt(step_s) * (total - total[:1])


def gauss_markov(white: Array64, sigma: Array64, time_s: float, step_s: float) -> Array64:
    """First-order Gauss-Markov process, stationary from the start, of white noise (n, d) and sigma (d,).

    x_0 = sigma w_0,  x_k = a x_{k-1} + sigma sqrt(1 - a^2) w_k,  a = exp(-step / time).
    """
    return first_order_recursion(np.ascontiguousarray(white) * sigma, float(np.exp(-step_s / time_s)))


def low_pass(rows: Array64, time_s: float, step_s: float) -> Array64:
    """First-order low-pass of rows (n, d), y_0 = x_0: y_k = a y_{k-1} + (1 - a) x_k, a = exp(-step / time)."""
    decay = float(np.exp(-step_s / time_s))
    white = (1 - decay) / np.sqrt(1 - decay * decay) * rows
    white[0] = rows[0]
    return first_order_recursion(white, decay)


def rotations_from_vectors(vectors_rad: Array64) -> Array64:
    """Rotations (n, 3, 3) of rotation vectors (n, 3) [rad]."""
    half = 0.5 * np.linalg.norm(vectors_rad, axis=1, keepdims=True)
    return rotations_from_xyzw(np.hstack([0.5 * vectors_rad * np.sinc(half / np.pi), np.cos(half)]))
