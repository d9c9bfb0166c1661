"""Compiled functions that compute the posterior of the drone's position from returns and pass-throughs.

Source: see `stages/track/hull.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

FALSE_RETURN = 0.005  # eps: probability of a false return
# columns of a collected pulse: offsets [m], kind, range minus the predicted one [m] (inf: no return), time, laser
A, B, KIND, DEPTH, DELAY_S, LASER = range(6)
# kinds of pulses; OCCLUDED: no information, the space behind is hidden
PASS_THROUGH, RETURN, OCCLUDED = 0.0, 1.0, 2.0
GAP_RETURN = 3.0  # a return through a gap between nearer objects: the object's extent behind them is unknown
CELLS = 25


@compiled
def basis(ux: float, uy: float, uz: float) -> tuple[float, float, float, float, float]:
    """(a_x, a_y, b_x, b_y, b_z): a horizontal (a_z = 0), b = u x a, both orthogonal to the line of sight u."""
    level = math.hypot(ux, uy)
    if level < 1e-6:
        ax, ay = 1.0, 0.0
    else:
        ax, ay = -uy / level, ux / level
    return ax, ay, -uz * ay, uz * ax, ux * ay - uy * ax


@compiled
def collect(
    stamp_ns: NDArray[np.int64],
    direction: NDArray[np.float32],
    range_m: NDArray[np.float32],
    laser: NDArray[np.uint8],
    origin_m: Array64,
    centre_m: Array64,
    velocity_mps: Array64,
    centre_ns: int,
    gate_m: float,
    depth_m: float,
    line: Array64,
    axes: Array64,
    found: Array64,
) -> int:
    """Fill found (n, COLUMNS) with the pulses that pass within gate_m of the moving centre; returns their number.

    Each is measured from the centre's position at the pulse's time (de-skew), along the `axes` (2, 3) across `line`,
    the unit line of sight of the scan pass. A return more than depth_m before the centre is OCCLUDED.
    """
    ax, ay, az, bx, by, bz = axes[0, 0], axes[0, 1], axes[0, 2], axes[1, 0], axes[1, 1], axes[1, 2]
    x, y, z = centre_m[0] - origin_m[0], centre_m[1] - origin_m[1], centre_m[2] - origin_m[2]
    n = 0
    least = math.cos(min(1.2 * gate_m / math.sqrt(x * x + y * y + z * z) + 0.01, 1.5))
    for i in range(range_m.size):
        dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
        along = dx * line[0] + dy * line[1] + dz * line[2]
        if along < least:
            continue
        dt = (stamp_ns[i] - centre_ns) * 1e-9
        cx, cy, cz = x + dt * velocity_mps[0], y + dt * velocity_mps[1], z + dt * velocity_mps[2]
        R = cx * line[0] + cy * line[1] + cz * line[2]
        a = R / along * (dx * ax + dy * ay + dz * az) - (cx * ax + cy * ay + cz * az)
        b = R / along * (dx * bx + dy * by + dz * bz) - (cx * bx + cy * by + cz * bz)
        if a * a + b * b > gate_m * gate_m:
            continue
        r = range_m[i]
        away = r * along - R
        found[n, A], found[n, B], found[n, DELAY_S], found[n, LASER] = a, b, dt, laser[i]
        found[n, DEPTH] = away if r > 0.0 else math.inf
        if r == 0.0 or away > depth_m:
            found[n, KIND] = PASS_THROUGH
        elif away < -depth_m:
            found[n, KIND] = OCCLUDED
        else:
            found[n, KIND] = RETURN
        n += 1
        if n == found.shape[0]:
            break
    return n


@compiled
def posterior(
    pulses: Array64,
    prior: Array64,
    middle_a: float,
    middle_b: float,
    half_m: float,
    p_0: float,
    s_m: float,
    use_pass_throughs: bool,
    mean: Array64,
    covariance: Array64,
) -> tuple[float, float]:
    """Fill mean (2,) and covariance (2, 2) of the centre's offset [m], [m^2] from a scan pass's pulses (n, COLUMNS).

    prior (2, 2) is about (0, 0). The grid is square, half_m each way about the middle. Returns (ln of the likelihood
    ratio drone over nothing, expected number of returns under the posterior).
    """
    determinant = prior[0, 0] * prior[1, 1] - prior[0, 1] ** 2
    i00, i01, i11 = prior[1, 1] / determinant, -prior[0, 1] / determinant, prior[0, 0] / determinant
    step = 2.0 * half_m / (CELLS - 1)
    value = np.empty((CELLS, CELLS))
    best = -math.inf
    inverse = 0.5 / (s_m * s_m)
    nothing = 0.0
    for k in range(pulses.shape[0]):
        if pulses[k, KIND] == RETURN:
            nothing += math.log(FALSE_RETURN)
    for i in range(CELLS):
        a = middle_a - half_m + i * step
        for j in range(CELLS):
            b = middle_b - half_m + j * step
            v = -0.5 * (a * a * i00 + 2.0 * a * b * i01 + b * b * i11)
            for k in range(pulses.shape[0]):
                if pulses[k, KIND] == OCCLUDED:
                    continue
                p = p_0 * math.exp(-((pulses[k, A] - a) ** 2 + (pulses[k, B] - b) ** 2) * inverse)
                if pulses[k, KIND] == RETURN:
                    v += math.log(p + FALSE_RETURN)
                elif use_pass_throughs:
                    v += math.log(1.0 - p)
            value[i, j] = v
            best = max(best, v)
    total = sa = sb = 0.0
    for i in range(CELLS):
        for j in range(CELLS):
            w = math.exp(value[i, j] - best)
            value[i, j] = w
            total += w
            sa += w * (middle_a - half_m + i * step)
            sb += w * (middle_b - half_m + j * step)
    ma, mb = sa / total, sb / total
    caa = cab = cbb = 0.0
    for i in range(CELLS):
        a = middle_a - half_m + i * step - ma
        for j in range(CELLS):
            b = middle_b - half_m + j * step - mb
            caa += value[i, j] * a * a
            cab += value[i, j] * a * b
            cbb += value[i, j] * b * b
    mean[0], mean[1] = ma, mb
    floor = step * step / 6.0  # variance of the grid spacing
    covariance[0, 0], covariance[0, 1] = caa / total + floor, cab / total
    covariance[1, 0], covariance[1, 1] = cab / total, cbb / total + floor
    normal = 2.0 * math.pi * math.sqrt(determinant)
    evidence = best + math.log(total * step * step / normal) - nothing
    expected = 0.0
    for k in range(pulses.shape[0]):
        if pulses[k, KIND] != OCCLUDED:
            expected += p_0 * math.exp(-((pulses[k, A] - ma) ** 2 + (pulses[k, B] - mb) ** 2) * inverse)
    return evidence, expected
