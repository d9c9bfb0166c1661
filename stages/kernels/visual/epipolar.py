"""Compiled functions of two-view geometry on rays: errors, costs and least squares of rotation and direction.

    x = ray earlier, x' = ray later, y = R x, t = t_hat_later:   p_later = R p_earlier + |t| t_hat
    e = x' . (t x y) / sqrt(|t x y|^2 + |t x x'|^2): deviation of both rays from one plane with t [rad]

Valid for all rays of the sphere: nothing is divided by z.

Source: P V.E; the error is Sampson's on the sphere, as in Pagani and Stricker, Structure from motion using full
spherical panoramic cameras (2011).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.geometry.so3 import exp_rotation

Vector = tuple[float, float, float]

SAMPLE = 5  # rays of a hypothesis
ROUNDS = 12  # of Gauss-Newton at most
CONVERGED_RAD = 1e-6
CAUCHY = 2.385  # sigmas: 95 % efficient on Gaussian noise
BEYOND_SIGMAS = 20.0  # the cost of a point is bounded by that of this error
NEAR_SIGMAS = 8.0  # inlier bound, in sigmas of the least noise


@compiled
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def _row(rays: Array64, i: int) -> Vector:
    return rays[i, 0], rays[i, 1], rays[i, 2]


@compiled
def _turned(R: Array64, v: Vector) -> Vector:
    return (
        R[0, 0] * v[0] + R[0, 1] * v[1] + R[0, 2] * v[2],
        R[1, 0] * v[0] + R[1, 1] * v[1] + R[1, 2] * v[2],
        R[2, 0] * v[0] + R[2, 1] * v[1] + R[2, 2] * v[2],
    )


@compiled
def epipolar(
    earlier: Array64, later: Array64, R: Array64, t: Array64, sigma_rad: float
) -> tuple[Array64, NDArray[np.bool_]]:
    """e (n,) [rad], and whether the point is ahead along both rays (or too distant to decide)."""
    n = len(earlier)
    error = np.empty(n)
    ahead = np.empty(n, dtype=np.bool_)
    axis = (t[0], t[1], t[2])
    for i in range(n):
        x = _row(later, i)
        y = _turned(R, _row(earlier, i))
        ty, tx, p = _cross(axis, y), _cross(axis, x), _cross(y, x)
        error[i] = _dot(x, ty) / max(math.sqrt(_dot(ty, ty) + _dot(tx, tx)), 1e-12)
        # depths along x' and y: -(t x y) . p / |p|^2 and -(t x x') . p / |p|^2
        ahead[i] = _dot(p, p) < (3.0 * sigma_rad) ** 2 or (_dot(ty, p) < 0.0 and _dot(tx, p) < 0.0)
    return error, ahead


@compiled
def cost_of(earlier: Array64, later: Array64, R: Array64, t: Array64, sigma_rad: float) -> tuple[float, int]:
    """Sum of log(1 + e^2 / sigma^2), bounded per point by BEYOND_SIGMAS, and the number within NEAR_SIGMAS.

    The logarithm favours many inliers over few outliers, whatever the noise. Points behind a camera count as outliers.
    """
    error, ahead = epipolar(earlier, later, R, t, sigma_rad)
    most = math.log(1.0 + BEYOND_SIGMAS**2)
    total, agree = 0.0, 0
    for i in range(len(error)):
        sigmas = abs(error[i]) / sigma_rad
        if ahead[i] and sigmas < BEYOND_SIGMAS:
            total += math.log(1.0 + sigmas * sigmas)
            agree += 1 if sigmas < NEAR_SIGMAS else 0
        else:
            total += most
    return total, agree


@compiled
def across(t: Array64) -> Array64:
    """Two unit vectors (3, 2) orthogonal to t and to each other."""
    axis = np.zeros(3)
    axis[np.argmin(np.abs(t))] = 1.0
    first = np.cross(t, axis)
    first = first / math.sqrt(first @ first)
    out = np.empty((3, 2))
    out[:, 0] = first
    out[:, 1] = np.cross(t, first)
    return out


@compiled
def refine(
    earlier: Array64, later: Array64, R_start: Array64, t_start: Array64, sigma_rad: float
) -> tuple[Array64, Array64, Array64]:
    """R, t_hat and their information (5, 5) for unit noise, by Gauss-Newton with Cauchy weights of this noise.

    With c = x' . (t x y), s^2 = |t x y|^2 + |t x x'|^2, e = c / s and R <- exp(w) R:
    dc = w . (y x (x' x t)) + dt . (y x x'),   s ds = w . (y x ((t x y) x t)) + dt . (y x (t x y) + x' x (t x x')).
    """
    rotation: Array64 = R_start
    t = t_start.copy()
    information = np.zeros((5, 5))
    J = np.empty(5)
    for _ in range(ROUNDS):
        B = across(t)
        axis = (t[0], t[1], t[2])
        error, ahead = epipolar(earlier, later, rotation, t, sigma_rad)
        information[:] = 0.0
        g = np.zeros(5)
        for i in range(len(earlier)):
            if not ahead[i] or abs(error[i]) > BEYOND_SIGMAS * sigma_rad:
                continue
            x = _row(later, i)
            y = _turned(rotation, _row(earlier, i))
            ty, tx = _cross(axis, y), _cross(axis, x)
            s = max(math.sqrt(_dot(ty, ty) + _dot(tx, tx)), 1e-12)
            lean = error[i] / s
            turn, bend = _cross(y, _cross(x, axis)), _cross(y, _cross(ty, axis))
            move, bend_y, bend_x = _cross(y, x), _cross(y, ty), _cross(x, tx)
            for k in range(3):
                J[k] = (turn[k] - lean * bend[k]) / s
            J[3], J[4] = 0.0, 0.0
            for k in range(3):
                slope = (move[k] - lean * (bend_y[k] + bend_x[k])) / s
                J[3] += B[k, 0] * slope
                J[4] += B[k, 1] * slope
            weight = 1.0 / (1.0 + (error[i] / (CAUCHY * sigma_rad)) ** 2)
            for a in range(5):
                g[a] += weight * error[i] * J[a]
                for b in range(5):
                    information[a, b] += weight * J[a] * J[b]
        damping = 1e-9 * (np.trace(information) + 1e-12)
        step = np.asarray(np.linalg.solve(information + damping * np.eye(5), -g), dtype=np.float64)
        rotation = exp_rotation(step[:3]) @ rotation
        t = t + B[:, 0] * step[3] + B[:, 1] * step[4]
        t = t / math.sqrt(t @ t)
        if np.abs(step).max() < CONVERGED_RAD:
            break
    return rotation, t, information


@compiled
def shown_noise(earlier: Array64, later: Array64, R: Array64, t: Array64, least_rad: float) -> float:
    """Noise [rad] of one ray, per axis, from the median error; at least `least_rad`."""
    error, ahead = epipolar(earlier, later, R, t, least_rad)
    size = np.sort(np.abs(error[ahead]))
    if len(size) <= SAMPLE:
        return least_rad
    return max(1.4826 * size[len(size) // 2] * math.sqrt(len(size) / (len(size) - SAMPLE)), least_rad)


@compiled
def direction_given(earlier: Array64, later: Array64, R: Array64, limit: float) -> Array64:
    """t_hat (3,) that fits best under a known rotation: least of t^T sum(n n^T) t, n = y x x' / max(|y x x'|, limit).

    Its sign puts most points ahead of both cameras.
    """
    M = np.zeros((3, 3))
    for i in range(len(earlier)):
        p = _cross(_turned(R, _row(earlier, i)), _row(later, i))
        square = max(_dot(p, p), limit * limit)
        for a in range(3):
            for b in range(3):
                M[a, b] += p[a] * p[b] / square
    t = np.ascontiguousarray(np.linalg.eigh(M)[1][:, 0])
    votes = 0.0
    for i in range(len(earlier)):
        y = _turned(R, _row(earlier, i))
        votes -= _dot(_cross((t[0], t[1], t[2]), y), _cross(y, _row(later, i)))
    return t if votes >= 0.0 else -t


@compiled
def rotation_between(earlier: Array64, later: Array64, R_start: Array64, scale_rad: float) -> Array64:
    """R (3, 3) with later ~ R earlier: Gauss-Newton with Cauchy weights of this scale, started at R_start."""
    rotation: Array64 = R_start
    for _ in range(ROUNDS):
        H = np.zeros((3, 3))
        g = np.zeros(3)
        for i in range(len(earlier)):
            x = _row(later, i)
            y = _turned(rotation, _row(earlier, i))
            gap = (x[0] - y[0]) ** 2 + (x[1] - y[1]) ** 2 + (x[2] - y[2]) ** 2
            weight = 1.0 / (1.0 + gap / (2.0 * scale_rad * scale_rad))
            off = _cross(y, x)
            for a in range(3):
                g[a] += weight * off[a]
                H[a, a] += weight
                for b in range(3):
                    H[a, b] -= weight * y[a] * y[b]
        w = np.asarray(np.linalg.solve(H + 1e-9 * np.eye(3), g), dtype=np.float64)
        rotation = exp_rotation(w) @ rotation
        if np.abs(w).max() < CONVERGED_RAD:
            break
    return rotation
