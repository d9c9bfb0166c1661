"""Distances of the points of one rotor revolution from the surfaces that an earlier revolution measured.

Each revolution is a grid (firings, 16 lasers by elevation) of points in frame map. A point is compared with the plane
through the cell of the earlier grid that the beam from the earlier origin to the point passes; the plane's normal is
that of the cell's neighbours: two along the rotor's motion, two of the adjacent lasers.

Source: ours; point-to-plane distance: Y. Chen, G. Medioni, "Object modelling by registration of multiple range images",
Image and Vision Computing 10(3), 1992.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

LASERS = 16
ALONG = 3  # firings between a cell and its neighbours
COPLANAR_M, ADJACENT_M = 0.05, 0.08  # of a cell and its neighbours along the rotor's motion, and of adjacent lasers
GRAZING = 0.2  # smallest cosine between beam and normal
NEAR_M, NEAR_SHARE = 0.6, 0.05  # distance between a point and its cell: and per metre of range
LARGEST_M = 0.8  # distance from the plane
LOWEST_DEG, SPACING_DEG = -15.0, 2.0  # VLP-16: elevation of the lasers


@compiled
def _normal(xyz_m: Array64, range_m: Array64, beam: Array64, f: int, n: int, out: Array64) -> bool:
    """Unit normal of the surface at a cell; False: no plane there."""
    if f < ALONG or f >= len(range_m) - ALONG or n < 1 or n > LASERS - 2:
        return False
    a, b, c, d, e = f - ALONG, f + ALONG, n - 1, n + 1, xyz_m[f, n]
    if not (range_m[f, n] > 0 and range_m[a, n] > 0 and range_m[b, n] > 0 and range_m[f, c] > 0 and range_m[f, d] > 0):
        return False
    u, v = xyz_m[b, n] - xyz_m[a, n], xyz_m[f, d] - xyz_m[f, c]
    out[0], out[1], out[2] = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
    length = math.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)
    if length < 1e-6:
        return False
    along = across = cosine = 0.0
    for i in range(3):
        out[i] /= length
        along += out[i] * (e[i] - 0.5 * (xyz_m[a, n, i] + xyz_m[b, n, i]))
        across += out[i] * (e[i] - 0.5 * (xyz_m[f, c, i] + xyz_m[f, d, i]))
        cosine += out[i] * beam[i]
    return abs(along) < COPLANAR_M and abs(across) < ADJACENT_M and abs(cosine) > GRAZING


@compiled
def scan_residuals(
    xyz_m: Array64,
    range_m: Array64,
    origin_m: Array64,
    axis: Array64,
    middle: Array64,
    step_rad: float,
    new_xyz_m: Array64,
    new_range_m: Array64,
    every: int,
    least_range_m: float,
) -> Array64:
    """Rows (k, 6): distance from the plane [m], the plane's normal (3), firing of the point, firing of the cell.

    Earlier revolution: points (f, 16, 3), ranges (f, 16), 0 without a return, and per firing the origin, the spin axis
    and the direction of the middle of the fan, which turns by `step_rad` about the axis per firing. Of the new one
    every `every`th firing is used, and only points beyond `least_range_m`, which are not on the vehicle.
    """
    rows = np.empty((len(new_range_m) // every * LASERS + LASERS, 6))
    count, firings, normal = 0, len(range_m), np.empty(3)
    for new in range(0, len(new_range_m), every):
        for laser in range(1, LASERS - 1):
            if new_range_m[new, laser] < least_range_m:
                continue
            point, f, n = new_xyz_m[new, laser], min(new, firings - 1), -1
            beam = point
            for _ in range(2):
                beam = point - origin_m[f]
                beam /= math.sqrt(beam[0] ** 2 + beam[1] ** 2 + beam[2] ** 2)
                x = y = z = 0.0
                a, m = axis[f], middle[f]
                for i in range(3):
                    j, k = (i + 1) % 3, (i + 2) % 3
                    x += beam[i] * m[i]
                    y += beam[i] * (a[j] * m[k] - a[k] * m[j])
                    z += beam[i] * a[i]
                f = min(max(f + round(math.atan2(y, x) / step_rad), 0), firings - 1)
                n = round((math.degrees(math.asin(min(max(z, -1.0), 1.0))) - LOWEST_DEG) / SPACING_DEG)
            if not _normal(xyz_m, range_m, beam, f, n, normal):
                continue
            off = point - xyz_m[f, n]
            distance = off[0] * normal[0] + off[1] * normal[1] + off[2] * normal[2]
            near_m = NEAR_M + NEAR_SHARE * new_range_m[new, laser]
            if abs(distance) > LARGEST_M or off[0] ** 2 + off[1] ** 2 + off[2] ** 2 > near_m**2:
                continue
            rows[count, 0] = distance
            rows[count, 1:4] = normal
            rows[count, 4] = new
            rows[count, 5] = f
            count += 1
    return rows[:count]
