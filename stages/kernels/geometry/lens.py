"""Compiled functions that project rays to pixels and pixels to rays for fisheye lenses.

Source: see `stages/geometry/lens.py`.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

ANGLE_SERIES, OCAM = 0, 1  # kinds of radial function
_TURNS = 60  # of the bracketed Newton iteration; 6 are usual


@compiled
def project(
    rays: Array64, kind: int, a: Array64, affine: Array64, centre: Array64, max_theta: float, max_rho: float
) -> Array64:
    pixels = np.full((len(rays), 2), np.nan)
    for i in range(len(rays)):
        x, y, z = rays[i, 0], rays[i, 1], rays[i, 2]
        across = math.hypot(x, y)
        theta = math.atan2(across, z)
        if not theta <= max_theta + 1e-12 or (across == 0.0 and z <= 0.0):  # also NaN
            continue
        rho = rho_of_theta(theta, kind, a, max_theta, max_rho)
        u, v = (rho * x / across, rho * y / across) if across > 0.0 else (0.0, 0.0)
        pixels[i, 0] = centre[0] + affine[0, 0] * u + affine[0, 1] * v
        pixels[i, 1] = centre[1] + affine[1, 0] * u + affine[1, 1] * v
    return pixels


@compiled
def unproject(
    pixels: Array64, kind: int, a: Array64, inverse: Array64, centre: Array64, max_theta: float, max_rho: float
) -> Array64:
    rays = np.full((len(pixels), 3), np.nan)
    for i in range(len(pixels)):
        du, dv = pixels[i, 0] - centre[0], pixels[i, 1] - centre[1]
        u = inverse[0, 0] * du + inverse[0, 1] * dv
        v = inverse[1, 0] * du + inverse[1, 1] * dv
        rho = math.hypot(u, v)
        if not rho <= max_rho * (1.0 + 1e-12):  # also NaN
            continue
        theta = _theta_of_rho(rho, kind, a, max_theta, max_rho)
        s = math.sin(theta) / rho if rho > 0.0 else 0.0
        rays[i, 0], rays[i, 1], rays[i, 2] = s * u, s * v, math.cos(theta)
    return rays


@compiled
def rho_of_theta(theta: float, kind: int, a: Array64, max_theta: float, max_rho: float) -> float:
    if kind == ANGLE_SERIES:
        return series(theta, a)[0]
    # rho cos(theta) + f(rho) sin(theta) = 0: below the root the ray is nearer to the axis and the value negative
    c, s = math.cos(theta), math.sin(theta)
    low, high = 0.0, max_rho
    rho = max_rho * theta / max_theta
    for _ in range(_TURNS):
        f, slope = polynomial_kernel(rho, a)
        value = rho * c + f * s
        if value > 0.0:
            high = rho
        else:
            low = rho
        rho, done = _newton(rho, value, c + slope * s, low, high)
        if done:
            break
    return rho


@compiled
def _theta_of_rho(rho: float, kind: int, a: Array64, max_theta: float, max_rho: float) -> float:
    if kind == OCAM:
        return math.atan2(rho, -polynomial_kernel(rho, a)[0])
    low, high = 0.0, max_theta
    theta = max_theta * rho / max_rho
    for _ in range(_TURNS):
        value, slope = series(theta, a)
        if value > rho:
            high = theta
        else:
            low = theta
        theta, done = _newton(theta, value - rho, slope, low, high)
        if done:
            break
    return theta


@compiled
def _newton(x: float, value: float, slope: float, low: float, high: float) -> tuple[float, bool]:
    """One Newton step limited to the bracket, and whether it has converged."""
    following = x - value / slope if slope != 0.0 else low - 1.0
    if not low <= following <= high:
        following = 0.5 * (low + high)
    return following, abs(following - x) <= 1e-14 * (1.0 + abs(x))


@compiled
def series(theta: float, a: Array64) -> tuple[float, float]:
    """Value and slope of a_0 t + a_1 t^3 + ... + a_4 t^9."""
    square = theta * theta
    value, slope = 0.0, 0.0
    for i in range(len(a) - 1, -1, -1):
        value = value * square + a[i]
        slope = slope * square + (2 * i + 1) * a[i]
    return value * theta, slope


@compiled
def polynomial_kernel(rho: float, a: Array64) -> tuple[float, float]:
    """Value and slope of a_0 + a_1 rho + ..."""
    value, slope = 0.0, 0.0
    for i in range(len(a) - 1, -1, -1):
        slope = slope * rho + value
        value = value * rho + a[i]
    return value, slope
