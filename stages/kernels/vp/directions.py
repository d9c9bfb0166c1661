"""Compiled functions that assign lines to vanishing directions and refine the directions.

Source: see `stages/vp/directions.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.lens import Array64
from stages.kernels.compiled import compiled
from stages.kernels.geometry.so3 import exp_rotation

NONE, VERTICAL = -1, 0  # of a line's direction; frame f has directions 1 + 2 f and 2 + 2 f
ENOUGH_RAD = 1e-5  # convergence threshold of a step
CAUCHY = 1.5  # sigmas
NORMAL_MEDIAN = 0.6745  # of the absolute value, in sigmas
FEW_LINES = 10  # weight of the prior scatter, in lines
GATE = 4.0  # sigmas; lines further from all directions are unassigned
PARTS = 8  # of azimuth about the camera, for the spread of estimates without one part
LEAST_SHARE = 1e-2  # of the information: a part with all the rest cannot be tested
LEAST_CURVATURE = 0.3  # of the robust cost, as a share of its weights; Gaussian residuals of one sigma: 0.6
WELL = 1.0 + 1e-9  # margin that decides a bound independently of rounding


@compiled
def tangents(normal: Array64, ends: Array64) -> Array64:
    """Tangents n x m (n, 3) of the lines with normals n (n, 3) at their middle rays m."""
    out = np.empty((len(normal), 3))
    for i in range(len(normal)):
        n, first, last = normal[i], ends[i, 0], ends[i, 1]
        x, y, z = first[0] + last[0], first[1] + last[1], first[2] + last[2]
        length = max(math.sqrt(x * x + y * y + z * z), 1e-12)
        x, y, z = x / length, y / length, z / length
        out[i, 0], out[i, 1], out[i, 2] = n[1] * z - n[2] * y, n[2] * x - n[0] * z, n[0] * y - n[1] * x
    return out


@compiled
def all_directions(axes: Array64, yaw_rad: Array64) -> Array64:
    """Directions (1 + 2 k, 3): the vertical, then two per frame, the second 90 deg to the left of the first."""
    out = np.empty((1 + 2 * len(yaw_rad), 3))
    out[VERTICAL] = axes[:, 2]
    for f in range(len(yaw_rad)):
        c, s = math.cos(yaw_rad[f]), math.sin(yaw_rad[f])
        out[1 + 2 * f] = c * axes[:, 0] + s * axes[:, 1]
        out[2 + 2 * f] = c * axes[:, 1] - s * axes[:, 0]
    return out


@compiled
def upright(vertical: Array64) -> Array64:
    """Orthonormal axes (3, 3) whose third is the vertical."""
    a, b, c = vertical[0], vertical[1], vertical[2]
    x, y, z = (c, 0.0, -a) if abs(b) < 0.9 else (0.0, -c, b)
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    x, y, z = x * scale, y * scale, z * scale
    return np.array([[x, b * z - c * y, a], [y, c * x - a * z, b], [z, a * y - b * x, c]])


@compiled
def assign_kernel(
    normal: Array64, tangent: Array64, sigma: Array64, directions: Array64, sigma_model: float
) -> tuple[NDArray[np.int64], Array64, Array64]:
    count = len(normal)
    assigned = np.full(count, NONE)
    residual, spread = np.zeros(count), np.ones(count)
    for i in range(count):
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        least, far = np.inf, WELL * GATE * (sigma[i] + sigma_model)
        for k in range(len(directions)):
            dx, dy, dz = directions[k, 0], directions[k, 1], directions[k, 2]
            r = nx * dx + ny * dy + nz * dz
            if abs(r) > far:
                continue
            s = math.hypot(sigma[i] * (tangent[i, 0] * dx + tangent[i, 1] * dy + tangent[i, 2] * dz), sigma_model)
            if abs(r) < least * s:
                least, residual[i], spread[i] = abs(r) / s, r, s
                assigned[i] = k
        if least > GATE:
            assigned[i] = NONE
    return assigned, residual, spread


@compiled
def refine_kernel(
    normal: Array64,
    tangent: Array64,
    sigma: Array64,
    weight: Array64,
    axes: Array64,
    yaw_rad: Array64,
    prior: Array64,
    prior_sigma: float,
    sigma_model: float,
    rounds: int,
) -> tuple[Array64, Array64, NDArray[np.int64], Array64, float, float]:
    """Refine vertical and yaws by robust least squares; returns the fields of `Structure`."""
    yaw = yaw_rad.copy()
    round_ = 0
    while True:
        directions = all_directions(axes, yaw)
        assigned, r, spread = assign_kernel(normal, tangent, sigma, directions, sigma_model)
        H, g, agreement = _normal_equations(normal, weight, axes, directions, assigned, r, spread)
        up = prior @ axes  # the prior in frame 0's axes: v -> v + omega x v
        H[0, 0] += 1 / prior_sigma**2
        H[1, 1] += 1 / prior_sigma**2
        g[0] += up[1] / prior_sigma**2
        g[1] -= up[0] / prior_sigma**2
        for k in range(len(H)):
            H[k, k] += 1e-9
        if round_ == rounds:
            return axes, yaw, assigned, H, _scatter(assigned, r, spread), agreement
        step: Array64 = -np.linalg.solve(H, g)  # pyright: ignore[reportAssignmentType]
        axes = axes @ exp_rotation(step[:3])
        yaw[1:] += step[3:]
        round_ = rounds if np.abs(step).max() < ENOUGH_RAD else round_ + 1


@compiled
def _normal_equations(
    normal: Array64,
    weight: Array64,
    axes: Array64,
    directions: Array64,
    assigned: NDArray[np.int64],
    residual: Array64,
    sigma: Array64,
) -> tuple[Array64, Array64, float]:
    """Normal equations H, g of the rotation omega of frame 0 about its axes, then each further yaw: d + omega x d."""
    size = 3 + (len(directions) - 1) // 2 - 1
    H, g = np.zeros((size, size)), np.zeros(size)
    J, at = np.zeros(4), np.zeros(4, dtype=np.int64)
    agreement = 0.0
    for i in range(len(normal)):
        k = assigned[i]
        if k == NONE:
            continue
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        dx, dy, dz = directions[k, 0], directions[k, 1], directions[k, 2]
        x, y, z = dy * nz - dz * ny, dz * nx - dx * nz, dx * ny - dy * nx
        for a in range(3):  # n . (omega x d) = omega . (d x n)
            J[a], at[a] = x * axes[0, a] + y * axes[1, a] + z * axes[2, a], a
        frame = (k - 1) // 2 if k != VERTICAL else 0
        terms = 3
        if frame > 0:
            J[3], at[3] = J[2], 2 + frame
            terms = 4
        q = (residual[i] / sigma[i]) ** 2
        w = weight[i] / (sigma[i] ** 2 * (1.0 + q / CAUCHY**2))
        agreement += weight[i] * max(1.0 - q / GATE**2, 0.0)
        for a in range(terms):
            g[at[a]] += w * J[a] * residual[i]
            for b in range(terms):
                H[at[a], at[b]] += w * J[a] * J[b]
    return H, g, agreement


@compiled
def jackknife_kernel(
    normal: Array64,
    tangent: Array64,
    sigma: Array64,
    weight: Array64,
    axes: Array64,
    yaw_rad: Array64,
    sigma_model: float,
    information: Array64,
) -> Array64:
    """Covariance of the unknowns by the block jackknife: PARTS estimates, each without the lines of one azimuth part.

    Each is one Newton step from the whole estimate, with its assignment; of the robust cost, whose curvature is less
    than its weights.
    """
    directions = all_directions(axes, yaw_rad)
    assigned, r, spread = assign_kernel(normal, tangent, sigma, directions, sigma_model)
    part = parts_of(normal, tangent, axes)
    weights, curvature = 1e-9, 0.0
    for i in range(len(normal)):
        if assigned[i] != NONE:
            q = (r[i] / (CAUCHY * spread[i])) ** 2
            weights += weight[i] / (1.0 + q)
            curvature += weight[i] * (1.0 - q) / (1.0 + q) ** 2
    scale = (PARTS - 1.0) / PARTS / max(curvature / weights, LEAST_CURVATURE) ** 2
    out = np.zeros_like(information)
    for k in range(PARTS):
        inside = np.where(part == k, assigned, NONE)
        H, g, _ = _normal_equations(normal, weight, axes, directions, inside, r, spread)
        step = without(information, H, g)
        for a in range(len(out)):
            for b in range(len(out)):
                out[a, b] += scale * step[a] * step[b]
    return out


@compiled
def parts_of(normal: Array64, tangent: Array64, axes: Array64) -> NDArray[np.int64]:
    """The part (m,) of azimuth about axes[:, 2] in which the middle of each line lies."""
    part = np.empty(len(normal), dtype=np.int64)
    for i in range(len(normal)):
        n, t = normal[i], tangent[i]  # middle ray: t x n
        x, y, z = t[1] * n[2] - t[2] * n[1], t[2] * n[0] - t[0] * n[2], t[0] * n[1] - t[1] * n[0]
        along = x * axes[0, 0] + y * axes[1, 0] + z * axes[2, 0]
        left = x * axes[0, 1] + y * axes[1, 1] + z * axes[2, 1]
        part[i] = int((math.atan2(left, along) / (2.0 * math.pi) + 1.0) * PARTS) % PARTS
    return part


@compiled
def without(information: Array64, H: Array64, g: Array64) -> Array64:
    """The step that leaves out a part with normal equations H, g of an estimate with this information."""
    rest = information - H
    for k in range(len(rest)):
        rest[k, k] += LEAST_SHARE * information[k, k]
    return np.linalg.solve(rest, g)  # pyright: ignore[reportReturnType]


@compiled
def _scatter(assigned: NDArray[np.int64], residual: Array64, sigma: Array64) -> float:
    """Sigma of residual / sigma of the lines that have a direction, by their median; shrunk to 1 with few lines."""
    off = np.abs(residual / sigma)[assigned != NONE]
    if len(off) == 0:
        return 1.0
    seen = (np.median(off) / NORMAL_MEDIAN) ** 2
    return math.sqrt((len(off) * seen + FEW_LINES) / (len(off) + FEW_LINES))
