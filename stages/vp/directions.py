"""Directions from lines: the vertical, and one or more horizontal pairs at right angles (Manhattan, Atlanta).

A line with great-circle normal n runs in direction d when n . d = 0; with the line's turn about its middle ray m known
to sigma, the residual has

    sigma_r^2 = sigma^2 (t . d)^2 + sigma_model^2,   t = n x m

where sigma_model is how straight and parallel the world is. All directions are refined together: the rotation of the
first frame (its axes x, y, and the vertical) and the yaw of every further frame against it,

    minimise sum w_i (n_i . d_k(i))^2 / sigma_r^2  +  the gravity prior,   w Cauchy, assignment k(i) anew each round.

Source: ours; Manhattan and Atlanta worlds: Coughlan and Yuille 1999, Schindler and Dellaert 2004. DESIGN, Vision.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.compiled import compiled
from stages.lens import Array64
from stages.rotation import exp_rotation
from stages.vp.arcs import Arcs

NONE, VERTICAL = -1, 0  # of a line's direction; frame f has directions 1 + 2 f and 2 + 2 f
ROUNDS = 8
ENOUGH_RAD = 1e-5  # a smaller step is the last
CAUCHY = 1.5  # sigmas
NORMAL_MEDIAN = 0.6745  # of the absolute value, in sigmas
FEW_LINES = 10  # what was expected counts as much as so many lines
GATE = 4.0  # sigmas; a line farther from all directions has none
WELL = 1.0 + 1e-9  # beyond a bound by so much: beyond it, however it was rounded


@dataclass(frozen=True)
class Lines:
    """What the search needs to know of lines; vectors in the carrier's axes."""

    normal: Array64  # (m, 3)
    tangent: Array64  # (m, 3) along the circle at the line's middle
    sigma_rad: Array64  # (m,)
    weight: Array64  # (m,) by how wide it is seen, at most 1


@dataclass(frozen=True)
class Structure:
    """Directions found. `axes[:, 2]` is the vertical, the frame 0 its x and y; further frames are turned by `yaw`."""

    axes: Array64  # (3, 3) R_carrier_frame0
    yaw_rad: Array64  # (k,) of the frames against the first, 0 first
    assigned: NDArray[np.int64]  # (m,) direction of each line
    information: Array64  # (3 + k - 1, 3 + k - 1) of the turn about the axes of frame 0, then the yaws
    scatter: float  # how far lines are off their directions, against what was expected
    agreement: float  # weight of the lines that fit, less the farther off they are


def lines_of(arcs: Arcs, R_carrier_camera: Array64, wide_rad: float) -> Lines:
    """The search's view of the arcs. A line counts fully from `wide_rad` on."""
    R = R_carrier_camera.T
    weight = np.minimum(arcs.extent_rad / wide_rad, 1.0)
    return Lines(arcs.normal @ R, _tangents(arcs.normal, arcs.ends) @ R, arcs.sigma_rad, weight)


@compiled
def _tangents(normal: Array64, ends: Array64) -> Array64:
    """n x m (n, 3) of the middle rays m."""
    out = np.empty((len(normal), 3))
    for i in range(len(normal)):
        n, first, last = normal[i], ends[i, 0], ends[i, 1]
        x, y, z = first[0] + last[0], first[1] + last[1], first[2] + last[2]
        length = max(math.sqrt(x * x + y * y + z * z), 1e-12)
        x, y, z = x / length, y / length, z / length
        out[i, 0], out[i, 1], out[i, 2] = n[1] * z - n[2] * y, n[2] * x - n[0] * z, n[0] * y - n[1] * x
    return out


def residual_sigma(lines: Lines, direction: Array64, sigma_model: float) -> Array64:
    """sigma_r (m,) of n . d for one direction."""
    return np.hypot(lines.sigma_rad * (lines.tangent @ direction), sigma_model)


@compiled
def all_directions(axes: Array64, yaw_rad: Array64) -> Array64:
    """(1 + 2 k, 3): the vertical, then both of each frame, the second a quarter turn to the left of the first."""
    out = np.empty((1 + 2 * len(yaw_rad), 3))
    out[VERTICAL] = axes[:, 2]
    for f in range(len(yaw_rad)):
        c, s = math.cos(yaw_rad[f]), math.sin(yaw_rad[f])
        out[1 + 2 * f] = c * axes[:, 0] + s * axes[:, 1]
        out[2 + 2 * f] = c * axes[:, 1] - s * axes[:, 0]
    return out


@compiled
def upright(vertical: Array64) -> Array64:
    """Some axes (3, 3) whose third is the vertical."""
    a, b, c = vertical[0], vertical[1], vertical[2]
    x, y, z = (c, 0.0, -a) if abs(b) < 0.9 else (0.0, -c, b)
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    x, y, z = x * scale, y * scale, z * scale
    return np.array([[x, b * z - c * y, a], [y, c * x - a * z, b], [z, a * y - b * x, c]])


def assign(lines: Lines, directions: Array64, sigma_model: float) -> tuple[NDArray[np.int64], Array64, Array64]:
    """Which direction each line runs in (NONE: none); its residual and the residual's sigma, of those that have one."""
    return _assign(lines.normal, lines.tangent, lines.sigma_rad, directions, sigma_model)


@compiled
def _assign(
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


def refine(
    lines: Lines,
    axes: Array64,
    yaw_rad: Array64,
    prior: Array64,
    prior_sigma: float,
    sigma_model: float,
    rounds: int = ROUNDS,
) -> Structure:
    """Gauss-Newton over the frame's turn and the further yaws, lines assigned anew each round."""
    return Structure(
        *_refine(
            lines.normal,
            lines.tangent,
            lines.sigma_rad,
            lines.weight,
            np.ascontiguousarray(axes),
            yaw_rad,
            np.ascontiguousarray(prior),
            prior_sigma,
            sigma_model,
            rounds,
        )
    )


@compiled
def _refine(
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
    """The fields of Structure."""
    yaw = yaw_rad.copy()
    round_ = 0
    while True:
        directions = all_directions(axes, yaw)
        assigned, r, spread = _assign(normal, tangent, sigma, directions, sigma_model)
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
    """H, g of the turn omega of frame 0 about its own axes, then of each further yaw: d -> d + omega x d."""
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
def _scatter(assigned: NDArray[np.int64], residual: Array64, sigma: Array64) -> float:
    """Sigma of residual / sigma of the lines that have a direction, by their median; near 1 when they are few."""
    off = np.abs(residual / sigma)[assigned != NONE]
    if len(off) == 0:
        return 1.0
    seen = (np.median(off) / NORMAL_MEDIAN) ** 2
    return math.sqrt((len(off) * seen + FEW_LINES) / (len(off) + FEW_LINES))
