"""Pixels of a camera: their rays in the world, and their values after noise, gain and gamma correction.

Source: Kensler, Correlated multi-jittered sampling, Pixar 13-01 (2013); EMVA Standard 1288 release 4.0, section 2.
"""

from __future__ import annotations

import math

import numpy as np

from stages.kernels.compiled import compiled

FEW = 3  # rays on a ring around the centre of a pixel; more than that are spread over the pixel
RING_PX = 0.36  # radius of the ring
STEPS = 4096  # of the analogue-to-digital converter


@compiled
def pixel_rays(pick, jitter, moment, R, t, direction, per_column, per_row):
    """Origins and unit directions (n * rays_each, 3) in the world; see `camera_view.world_rays`."""
    rays_each = jitter.shape[1]
    grid = round(math.sqrt(rays_each))
    origins = np.empty((len(pick) * rays_each, 3), dtype=np.float32)
    directions = np.empty((len(pick) * rays_each, 3), dtype=np.float32)
    d = np.empty(3)
    for i in range(len(pick)):
        p = pick[i]
        for k in range(rays_each):
            if rays_each == FEW:
                turn = 2.0 * math.pi * (k + jitter[i, k, 0]) / FEW
                x, y = RING_PX * math.cos(turn), RING_PX * math.sin(turn)
            else:
                x = (k % grid + (k // grid + jitter[i, k, 0]) / grid) / grid - 0.5
                y = (k // grid + (k % grid + jitter[i, k, 1]) / grid) / grid - 0.5
            square = 0.0
            for j in range(3):
                d[j] = direction[p, j] + x * per_column[p, j] + y * per_row[p, j]
                square += d[j] * d[j]
            scale = 1.0 / math.sqrt(square)
            n = i * rays_each + k
            r = R[moment[n]]
            for j in range(3):
                directions[n, j] = scale * (r[j, 0] * d[0] + r[j, 1] * d[1] + r[j, 2] * d[2])
                origins[n, j] = t[moment[n], j]
    return origins, directions


@compiled
def digitise(radiance, noise, electrons, full_well, read_noise, shot, gain, code):
    """8-bit values: e = L S t; measured e + N(0, e + read^2); value = gain e / full well, quantised, through gamma."""
    height, width, channels = radiance.shape
    out = np.empty(radiance.shape, dtype=np.uint8)
    for i in range(height):
        for j in range(width):
            for k in range(channels):
                e = min(radiance[i, j, k] * electrons, full_well)
                e += noise[i, j, k] * math.sqrt(shot * e + read_noise * read_noise)
                value = int(e * gain / full_well * (STEPS - 1) + 0.5)
                out[i, j, k] = code[min(max(value, 0), STEPS - 1)]
    return out
