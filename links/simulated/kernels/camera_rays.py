"""Camera rays: hit points and normals, rays in the frame of a body, shadow rays, edges and image motion.

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.kernels.compiled import compiled

FAR_M = 400.0
CONTRAST = 0.02  # half of the relative difference, linear, below which an edge is not refined
LIFT_M = 0.01  # offset of a shadow ray's origin from the surface


@compiled
def describe_hits(pick, face, u, v, normal, surface, tint, half, side, normals_out, surface_out, tint_out, window_out):
    """Copy attributes of each hit face to samples pick[i]; the position on a quadrilateral is from the barycentrics."""
    for i in range(len(pick)):
        f, k = face[i], pick[i]
        if f < 0:
            continue
        for j in range(3):
            normals_out[k, j] = normal[f, j]
        surface_out[k] = surface[f]
        tint_out[k] = tint[f]
        if half[f] == 0:  # P = v0 + u (v1 - v0) + v (v2 - v0)
            s, t = u[i] + v[i], v[i]
        else:  # P = v0 + u (v2 - v0) + v (v3 - v0)
            s, t = u[i], u[i] + v[i]
        a, b = (side[f, 0], side[f, 1]) if half[f] >= 0 else (0.0, 0.0)
        window_out[k, 0], window_out[k, 1], window_out[k, 2], window_out[k, 3] = s * a, t * b, a, b


@compiled
def rotate_normals(pick, moment, R, normals):
    """Rotate the normals of samples `pick` from the frame of the body to the world frame."""
    for k in pick:
        a, b, c = normals[k, 0], normals[k, 1], normals[k, 2]
        r = R[moment[k]]
        for j in range(3):
            normals[k, j] = r[j, 0] * a + r[j, 1] * b + r[j, 2] * c


@compiled
def hit_points(origins, directions, ranges, points):
    """Write the hit points (n, 3); a ray without a hit ends at FAR_M."""
    for i in range(len(ranges)):
        reach = ranges[i] if ranges[i] < FAR_M else np.float32(FAR_M)
        for j in range(3):
            points[i, j] = origins[i, j] + reach * directions[i, j]


@compiled
def rays_into_body(candidates, origins, directions, moment, active, R, t, low_m, high_m, reach_m, limit_m):
    """Candidate rays at active moments that meet the bounding box before their limit, in the frame of the body."""
    pick = np.empty(len(candidates), dtype=np.int64)
    local_o = np.empty((len(candidates), 3), dtype=np.float32)
    local_d = np.empty((len(candidates), 3), dtype=np.float32)
    o, d = np.empty(3), np.empty(3)
    count = 0
    for i in candidates:
        m = moment[i]
        if not active[m]:
            continue
        a0, a1, a2 = t[m, 0] - origins[i, 0], t[m, 1] - origins[i, 1], t[m, 2] - origins[i, 2]
        ahead = a0 * directions[i, 0] + a1 * directions[i, 1] + a2 * directions[i, 2]
        square = a0 * a0 + a1 * a1 + a2 * a2
        if square - ahead * ahead > reach_m * reach_m or (ahead < 0.0 and square > reach_m * reach_m):
            continue
        r = R[m]
        enter, leave = 0.0, float(limit_m[i])
        for j in range(3):
            o[j] = -(r[0, j] * a0 + r[1, j] * a1 + r[2, j] * a2)
            d[j] = r[0, j] * directions[i, 0] + r[1, j] * directions[i, 1] + r[2, j] * directions[i, 2]
            if abs(d[j]) < 1e-12:
                if o[j] < low_m[j] or o[j] > high_m[j]:
                    leave = -1.0
                continue
            one, two = (low_m[j] - o[j]) / d[j], (high_m[j] - o[j]) / d[j]
            enter, leave = max(enter, min(one, two)), min(leave, max(one, two))
        if enter > leave:
            continue
        pick[count] = i
        for j in range(3):
            local_o[count, j], local_d[count, j] = o[j], d[j]
        count += 1
    return pick[:count], local_o[:count], local_d[:count]


@compiled
def shadow_rays(points, normals, directions, surface, ranges, sun):
    """Samples whose visible side faces the sun, and the origins of their shadow rays."""
    pick = np.empty(len(surface), dtype=np.int64)
    origins = np.empty((len(surface), 3), dtype=np.float32)
    count = 0
    for i in range(len(surface)):
        if surface[i] < 0:
            continue
        n, d = normals[i], directions[i]
        side = -1.0 if n[0] * d[0] + n[1] * d[1] + n[2] * d[2] > 0.0 else 1.0
        towards = n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2]
        if side * towards <= 0.0:
            continue
        lift = side * (LIFT_M + 2e-5 * ranges[i])
        pick[count] = i
        for j in range(3):
            origins[count, j] = points[i, j] + lift * n[j]
        count += 1
    return pick[:count], origins[:count]


@compiled
def edges(rows, columns, index, normals, points, ranges, body, surface, lit, colours, leaf):
    """Pixels (n,) that differ from one of their four neighbours in body, surface, plane or light, and in colour.

    Two neighbouring leaf pixels are no edge: every leaf pixel would be one.
    """
    found = np.zeros(len(rows), dtype=np.bool_)
    for i in range(len(rows)):
        for step in range(2):
            y, x = rows[i] + step, columns[i] + 1 - step
            if y >= index.shape[0] or x >= index.shape[1]:
                continue
            j = index[y, x]
            if j < 0 or (surface[i] == surface[j] and (surface[i] < 0 or surface[i] == leaf)):
                continue
            differs = body[i] != body[j] or surface[i] != surface[j] or lit[i] != lit[j]
            if not differs:
                alike, off = 0.0, 0.0
                for k in range(3):
                    alike += normals[i, k] * normals[j, k]
                    off += normals[i, k] * (points[j, k] - points[i, k])
                differs = abs(alike) < 0.99 or abs(off) > 0.01 + 0.002 * ranges[i]
            visibly = False
            for k in range(3):
                visibly |= abs(colours[i, k] - colours[j, k]) > CONTRAST * (colours[i, k] + colours[j, k])
            if differs and visibly:
                found[i] = True
                found[j] = True
    return found


@compiled
def image_motion(points, moment, R0, t0, R1, t1):
    """Angle (n,) [rad] by which static points move in the camera between two poses per moment."""
    angle = np.empty(len(moment))
    for i in range(len(moment)):
        m = moment[i]
        a = unit_direction(points[i], R0[m], t0[m])
        b = unit_direction(points[i], R1[m], t1[m])
        angle[i] = math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)
    return angle


@compiled
def unit_direction(point, R, t):
    """Unit vector R^T (p - t)."""
    x, y, z = point[0] - t[0], point[1] - t[1], point[2] - t[2]
    scale = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-9)
    x, y, z = x * scale, y * scale, z * scale
    return (
        R[0, 0] * x + R[1, 0] * y + R[2, 0] * z,
        R[0, 1] * x + R[1, 1] * y + R[2, 1] * z,
        R[0, 2] * x + R[1, 2] * y + R[2, 2] * z,
    )
