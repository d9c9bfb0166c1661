"""Compiled functions that propose, score and refine the vertical vanishing direction.

Source: see `stages/vp/verticals.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.lens import Array64
from stages.kernels.compiled import compiled, compiled_at_once
from stages.kernels.vp.directions import CAUCHY, GATE, WELL, upright

ROUNDS = 5


@compiled_at_once("(float64[:, ::1], float64)")
def meetings(normal: Array64, least_sine: float) -> Array64:
    """Unit cross products (k, 3) of all pairs of normals (n, 3) whose angle has a sine of at least least_sine."""
    out = np.empty((len(normal) * (len(normal) - 1) // 2, 3))
    count = 0
    for i in range(len(normal)):
        for j in range(i + 1, len(normal)):
            a, b = normal[i], normal[j]
            x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
            length = math.sqrt(x * x + y * y + z * z)
            if length > least_sine:
                out[count, 0], out[count, 1], out[count, 2] = x / length, y / length, z / length
                count += 1
    return out[:count].copy()


@compiled_at_once("(float64[:, ::1], int64[::1], int64, float64)")
def picked(directions: Array64, order: NDArray[np.int64], most: int, cos_apart: float) -> Array64:
    """The first `most` of directions (n, 3), in the given order, that are separated by more than cos_apart."""
    out = np.empty((most, 3))
    count = 0
    for k in order:
        d = directions[k]
        near = False
        for i in range(count):
            near |= abs(d[0] * out[i, 0] + d[1] * out[i, 1] + d[2] * out[i, 2]) > cos_apart
        if not near and count < most:
            out[count] = d
            count += 1
    return out[:count].copy()


@compiled_at_once("(float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[::1], float64[::1], float64)")
def votes_kernel(
    proposal: Array64, normal: Array64, tangent: Array64, sigma: Array64, weight: Array64, sigma_model: float
) -> Array64:
    out = np.zeros(len(proposal))
    nx, ny, nz = normal[:, 0].copy(), normal[:, 1].copy(), normal[:, 2].copy()
    far, beyond = np.empty(len(normal)), np.empty(len(normal))
    near = np.empty(len(normal) + 1, dtype=np.int64)
    for i in range(len(normal)):
        far[i] = min(WELL * 3.0 * math.hypot(sigma[i], sigma_model), 0.2)
    for p in range(len(proposal)):
        x, y, z = proposal[p, 0], proposal[p, 1], proposal[p, 2]
        for i in range(len(normal)):  # without a branch, so that several are done at once
            beyond[i] = abs(nx[i] * x + ny[i] * y + nz[i] * z) - far[i]
        count = 0
        for i in range(len(normal)):
            near[count] = i
            count += 1 if beyond[i] < 0.0 else 0
        total = 0.0
        for k in range(count):
            i = near[k]
            r = nx[i] * x + ny[i] * y + nz[i] * z
            s = sigma[i] * (tangent[i, 0] * x + tangent[i, 1] * y + tangent[i, 2] * z)
            q = r * r / (s * s + sigma_model * sigma_model)
            if q < 9.0:
                total += weight[i] * (1.0 - q / 9.0) ** 2
        out[p] = total
    return out


@compiled
def refine_vertical_kernel(
    normal: Array64,
    tangent: Array64,
    sigma: Array64,
    weight: Array64,
    vertical: Array64,
    prior: Array64,
    prior_sigma: float,
    sigma_model: float,
    gate: float,
) -> Array64:
    v = vertical
    for _ in range(ROUNDS):
        e = upright(v)
        H, g = _vertical_step(normal, tangent, sigma, weight, e, sigma_model, gate)
        p = prior @ e
        a, b, c = H[0, 0] + 1 / prior_sigma**2, H[0, 1], H[1, 1] + 1 / prior_sigma**2
        x, y = g[0] - p[0] / prior_sigma**2, g[1] - p[1] / prior_sigma**2
        det = a * c - b * b
        v = v - e[:, 0] * ((c * x - b * y) / det) - e[:, 1] * ((a * y - b * x) / det)
        v = v / math.sqrt(np.sum(v * v))
        gate = 0.5 * gate
    return v


@compiled
def _vertical_step(
    normal: Array64, tangent: Array64, sigma: Array64, weight: Array64, e: Array64, sigma_model: float, least: float
) -> tuple[Array64, Array64]:
    """Normal equations of the vertical e[:, 2] rotated towards e[:, 0] and e[:, 1]; the gate is at least `least`."""
    H, g = np.zeros((2, 2)), np.zeros(2)
    for i in range(len(normal)):
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        r = nx * e[0, 2] + ny * e[1, 2] + nz * e[2, 2]
        if abs(r) > WELL * max(GATE * (sigma[i] + sigma_model), least):
            continue
        s = math.hypot(
            sigma[i] * (tangent[i, 0] * e[0, 2] + tangent[i, 1] * e[1, 2] + tangent[i, 2] * e[2, 2]), sigma_model
        )
        s = max(s, least / GATE)
        if abs(r) < GATE * s:
            w = weight[i] / (s * s * (1.0 + (r / (CAUCHY * s)) ** 2))
            a = nx * e[0, 0] + ny * e[1, 0] + nz * e[2, 0]
            b = nx * e[0, 1] + ny * e[1, 1] + nz * e[2, 1]
            H[0, 0] += w * a * a
            H[0, 1] += w * a * b
            H[1, 0] += w * a * b
            H[1, 1] += w * b * b
            g[0] += w * a * r
            g[1] += w * b * r
    return H, g
