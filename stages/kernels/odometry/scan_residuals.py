"""Distances of the points of one rotor revolution from the surfaces that an earlier revolution measured.

Each revolution is a grid (columns, lasers by elevation) of points in frame map; the points of a column have the same
azimuth. A point is compared with the plane through the cell of the earlier grid that the beam from the earlier origin
to the point passes; the plane's normal is that of the cell's neighbours: two along the rotor's motion, two of the
adjacent lasers.

Source: ours; point-to-plane distance: Y. Chen, G. Medioni, "Object modelling by registration of multiple range images",
Image and Vision Computing 10(3), 1992.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.odometry.revolution import Revolution

ALONG = 3  # columns between a cell and its neighbours
COPLANAR_M, ADJACENT_M = 0.05, 0.08  # of a cell and its neighbours along the rotor's motion, and of adjacent lasers
GRAZING = 0.2  # smallest cosine between beam and normal
NEAR_M, NEAR_SHARE = 0.6, 0.05  # distance between a point and its cell: and per metre of range
LARGEST_M = 0.8  # distance from the plane


@compiled
def _normal(xyz_m: Array64, range_m: Array64, beam: Array64, f: int, n: int, out: Array64) -> bool:
    """Unit normal of the surface at a cell; False: no plane there."""
    if f < ALONG or f >= len(range_m) - ALONG or n < 1 or n > range_m.shape[1] - 2:
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
    before: Revolution, now: Revolution, between_rad: Array64, every: int, least_range_m: float
) -> Array64:
    """Rows (r, 6): distance from the plane [m], the plane's normal (3), time from cell to point [s], column.

    `between_rad` (k - 1,) are the elevations in the middle between adjacent lasers. Of the new revolution every
    `every`th column is used, and only points beyond `least_range_m`, which are not on the vehicle.
    """
    columns, lasers = now.range_m.shape
    rows = np.empty((columns // every * lasers + lasers, 6))
    count, last, normal = 0, len(before.range_m) - 1, np.empty(3)
    for column in range(0, columns, every):
        for laser in range(1, lasers - 1):
            if now.range_m[column, laser] < least_range_m:
                continue
            point, f, n = now.xyz_m[column, laser], min(column, last), -1
            beam = point
            for _ in range(2):
                beam = point - before.origin_m[f]
                beam /= math.sqrt(beam[0] ** 2 + beam[1] ** 2 + beam[2] ** 2)
                x = y = z = 0.0
                a, m = before.axis[f], before.radial[f]
                for i in range(3):
                    j, k = (i + 1) % 3, (i + 2) % 3
                    x += beam[i] * m[i]
                    y += beam[i] * (m[j] * a[k] - m[k] * a[j])  # the rotor turns clockwise about its axis
                    z += beam[i] * a[i]
                f = min(max(f + round(math.atan2(y, x) / before.step_rad), 0), last)
                n = int(np.searchsorted(between_rad, math.asin(min(max(z, -1.0), 1.0))))
            if not _normal(before.xyz_m, before.range_m, beam, f, n, normal):
                continue
            off = point - before.xyz_m[f, n]
            distance = off[0] * normal[0] + off[1] * normal[1] + off[2] * normal[2]
            near_m = NEAR_M + NEAR_SHARE * now.range_m[column, laser]
            if abs(distance) > LARGEST_M or off[0] ** 2 + off[1] ** 2 + off[2] ** 2 > near_m**2:
                continue
            rows[count, 0] = distance
            rows[count, 1:4] = normal
            rows[count, 4] = (now.stamp_ns[column, laser] - before.stamp_ns[f, n]) * 1e-9
            rows[count, 5] = column
            count += 1
    return rows[:count]
