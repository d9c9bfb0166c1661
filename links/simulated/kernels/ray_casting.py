"""Ray casting against meshes and moving bodies: reflected fractions, nearest hits, rays in the frame of a body.

Source: ours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

Array32 = NDArray[np.float32]

GLOSS_EXPONENT = 60  # a glossy lobe a few degrees wide around normal incidence
BEAM_SPREAD = 0.002  # half width of a beam per metre of range, rounded up


@compiled
def ranges_and_fractions(
    directions: Array32,
    hit_m: Array32,
    face: NDArray[np.int32],
    normal: Array32,
    diffuse: Array32,
    gloss: Array32,
) -> tuple[Array32, Array32]:
    ranges = np.full(len(face), np.inf, dtype=np.float32)
    """Range (n,) [m] (inf: no hit) and returned fraction (n,) of hits; see `RayScene.cast`."""
    fractions = np.zeros(len(face), dtype=np.float32)
    for i in range(len(face)):
        if face[i] < 0:
            continue
        n, d = normal[i], directions[i]
        along = abs(n[0] * d[0] + n[1] * d[1] + n[2] * d[2])
        cosine = along / max(np.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2), 1e-20)
        ranges[i] = hit_m[i]
        fractions[i] = diffuse[face[i]] * cosine + gloss[face[i]] * cosine**GLOSS_EXPONENT
    return ranges, fractions


@compiled
def keep_nearer(
    target: NDArray[np.intp] | None, found_m: Array32, fraction: Array32, ranges_m: Array32, fractions: Array32
) -> NDArray[np.intp]:
    """Overwrite farther ranges of the target rays (None: all rays) with these hits; returns the rays written (m,)."""
    written = np.empty(len(found_m), dtype=np.intp)
    count = 0
    for i in range(len(found_m)):
        ray = i if target is None else target[i]
        if found_m[i] < np.inf and found_m[i] <= ranges_m[ray]:
            ranges_m[ray], fractions[ray] = found_m[i], fraction[i]
            written[count] = ray
            count += 1
    return written[:count]


@compiled
def rays_near(target_m: Array64, origins_m: Array32, directions: Array32, reach_m: float) -> NDArray[np.intp]:
    """Rays (n, 3) that pass a target, one (1, 3) or one per ray (n, 3), within reach plus the spread of the beam.

    A ray that starts within reach counts.
    """
    found = np.empty(len(directions), dtype=np.intp)
    count, step = 0, 1 if len(target_m) > 1 else 0
    for i in range(len(directions)):
        x = target_m[step * i, 0] - origins_m[i, 0]
        y = target_m[step * i, 1] - origins_m[i, 1]
        z = target_m[step * i, 2] - origins_m[i, 2]
        ahead = x * directions[i, 0] + y * directions[i, 1] + z * directions[i, 2]
        away_squared = x * x + y * y + z * z
        reach = reach_m + BEAM_SPREAD * abs(ahead)
        if away_squared - ahead * ahead < reach * reach and (ahead > 0 or away_squared < reach * reach):
            found[count] = i
            count += 1
    return found[:count]


@compiled
def into_body(
    R_world_body: Array64,
    t_world_body_m: Array64,
    origins_world_m: Array32,
    directions_world: Array32,
    pick: NDArray[np.intp],
    low_m: Array64,
    high_m: Array64,
) -> tuple[Array32, Array32, NDArray[np.intp]]:
    """Sub-rays of the picked pulses in the frame of the body, R^T (p - t): those that meet its bounding box.

    There is one pose per picked pulse, or one for all. Rays are (n, k, 3). The last result is the flat index of each
    sub-ray in (n, k).
    """
    rays = origins_world_m.shape[1]
    origins = np.empty((len(pick) * rays, 3), dtype=np.float32)
    directions = np.empty((len(pick) * rays, 3), dtype=np.float32)
    number = np.empty(len(pick) * rays, dtype=np.intp)
    o, d = np.empty(3), np.empty(3)
    count, step = 0, 1 if len(t_world_body_m) > 1 else 0
    for i in range(len(pick)):
        R, t = R_world_body[step * i], t_world_body_m[step * i]
        for k in range(rays):
            p, q = origins_world_m[pick[i], k], directions_world[pick[i], k]
            enter, leave = 0.0, np.inf
            for j in range(3):
                o[j] = R[0, j] * (p[0] - t[0]) + R[1, j] * (p[1] - t[1]) + R[2, j] * (p[2] - t[2])
                d[j] = R[0, j] * q[0] + R[1, j] * q[1] + R[2, j] * q[2]
                slope = d[j] if abs(d[j]) > 1e-12 else 1e-12
                a, b = (low_m[j] - o[j]) / slope, (high_m[j] - o[j]) / slope
                enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
            if enter <= leave:
                for j in range(3):
                    origins[count, j], directions[count, j] = o[j], d[j]
                number[count] = pick[i] * rays + k
                count += 1
    return origins[:count], directions[:count], number[:count]
