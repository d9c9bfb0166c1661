"""Radiance of camera samples: procedural textures, light, reflections, haze and sky.

Textures are filtered analytically: each stripe (joint, mark, frame) is averaged over the width of the sample on the
surface, so that detail below the resolution fades to its mean and does not shimmer.

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.kernels.compiled import compiled

PLAIN, BRICK, RENDERED, GLASS, ROAD, SLABS, LEAF, PAINT, GRASS, PRINT = range(10)  # textures
FRAME_M = 0.07  # width of a window frame
SKY_PX = 768  # side of the sky map: the zenith is its centre, the inscribed circle is LOWEST_SKY_DEG below the horizon
LOWEST_SKY_DEG = 6.0


@compiled
def shade(
    directions, points, normals, ranges, surface, tint, window, lit, pixel_rad, street,
    kinds, colours, others, noise, sun, sun_rgb, above, below, haze, extinction, sky, mirrored,
):  # fmt: skip
    """Linear RGB (n, 3) of samples; see `links.simulated.sensors.camera_paint.radiance`."""
    out = np.empty((len(surface), 3), dtype=np.float32)
    colour, emitted = np.empty(3), np.empty(3)
    for i in range(len(surface)):
        d = directions[i]
        s = surface[i]
        if s < 0:
            _sky(d[0], d[1], d[2], sky, haze, emitted)
            out[i, 0], out[i, 1], out[i, 2] = emitted[0], emitted[1], emitted[2]
            continue
        n0, n1, n2 = normals[i, 0], normals[i, 1], normals[i, 2]
        facing = -(n0 * d[0] + n1 * d[1] + n2 * d[2])
        if facing < 0.0:
            n0, n1, n2, facing = -n0, -n1, -n2, -facing
        width = ranges[i] * pixel_rad / math.sqrt(max(facing, 0.05))
        kind = kinds[s]
        for j in range(3):
            colour[j] = colours[s, j] + tint[i] * (others[s, j] - colours[s, j])
        gloss = _texture(kind, colour, points[i], n0, n1, n2, width, window[i], street, noise, tint[i])

        towards = n0 * sun[0] + n1 * sun[1] + n2 * sun[2]
        direct = max(towards, 0.0) if lit[i] else 0.0
        if kind == LEAF and lit[i]:
            direct = max(direct, 0.5 * abs(towards))  # leaves transmit light
        up = 0.5 * (1.0 + n2)
        for j in range(3):
            emitted[j] = colour[j] * (direct * sun_rgb[j] + up * above[j] + (1.0 - up) * below[j])
        if gloss > 0.0:
            mirror = gloss * (0.08 + 0.92 * (1.0 - facing) ** 5)  # Schlick, both faces of a pane
            r0, r1, r2 = d[0] + 2 * facing * n0, d[1] + 2 * facing * n1, d[2] + 2 * facing * n2
            _sky(r0, r1, r2, sky, haze, colour)
            if len(mirrored) > 0 and mirrored[i, 0] >= 0.0:
                for j in range(3):
                    colour[j] = mirrored[i, j]
            for j in range(3):
                emitted[j] = (1.0 - mirror) * emitted[j] + mirror * min(colour[j], 4.0)
        clear = math.exp(-extinction * ranges[i])
        for j in range(3):
            out[i, j] = clear * emitted[j] + (1.0 - clear) * haze[j]
    return out


@compiled
def _texture(kind, colour, p, n0, n1, n2, width, window, street, noise, tint):
    """Modulates `colour` in place; returns the gloss of the surface (1: window glass)."""
    x = street[0] * p[0] - street[1] * p[1]
    y = street[1] * p[0] + street[0] * p[1] + street[2]
    z = p[2] - street[3]
    if abs(n2) < 0.7:  # a wall: u along it, v up
        level = math.sqrt(n0 * n0 + n1 * n1)
        u, v = (-n1 * p[0] + n0 * p[1]) / level, z
    else:
        u, v = x, y
    if kind == GLASS:
        return _glass(colour, width, window)
    if kind == BRICK:
        joint = _stripes(v, 0.075, 0.011, width)
        course = math.floor(v / 0.075)
        upright = _stripes(u + 0.125 * (course % 2), 0.25, 0.011, width)
        mortar = joint + upright - joint * upright
        grain = 1.0 + 0.35 * (_noise(u / 2, v / 2, width / 2, noise) - 0.5)
        for j in range(3):
            colour[j] = (1.0 - mortar) * colour[j] * grain + mortar * 0.42
    elif kind == RENDERED:
        stain = 1.0 + 0.30 * (_noise(u / 6, v / 9, width / 6, noise) - 0.5)
        joint = 0.35 * _stripes(v, 3.0, 0.03, width)
        for j in range(3):
            colour[j] *= stain * (1.0 - joint)
    elif kind == ROAD:
        grain = 1.0 + 0.5 * (_noise(x / 1.5, y / 1.5, width / 1.5, noise) - 0.5)
        grain *= 1.0 + 0.35 * (_noise(x / 40, y / 10, width / 10, noise) - 0.5)
        mark = _lane_marks(x, y, z, width, street[4])
        for j in range(3):
            colour[j] = (1.0 - mark) * colour[j] * grain + mark * 0.70
    elif kind == SLABS:
        a, b = _stripes(x, 0.5, 0.012, width), _stripes(y, 0.5, 0.012, width)
        joint = a + b - a * b
        grain = 1.0 + 0.25 * (_noise(x / 3, y / 3, width / 3, noise) - 0.5)
        for j in range(3):
            colour[j] *= grain * (1.0 - 0.5 * joint)
    elif kind == GRASS:
        grain = 1.0 + 0.8 * (_noise(x / 1.2, y / 1.2, width / 1.2, noise) - 0.5)
        for j in range(3):
            colour[j] *= grain
    elif kind == PRINT:
        _print(colour, window, width, noise, tint)
    elif kind == PAINT:
        return 0.3
    return 0.0


@compiled
def _print(colour, window, width, noise, tint):
    """Bars at an angle of the object's own, and rows of blotches that resemble text, on its face."""
    turn = 40.0 * tint
    c, s = math.cos(turn), math.sin(turn)
    a, b = c * window[0] + s * window[1], c * window[1] - s * window[0]
    period = 0.12 + 0.5 * (17.0 * tint - math.floor(17.0 * tint))
    bar = 0.8 * _stripes(a, 4.0 * period, period, width)
    row = _stripes(b, 0.16, 0.07, width)
    text = 0.9 * row * (1.0 if _noise(a / 3.0, math.floor(b / 0.16) / 5.0 + tint, width / 3.0, noise) > 0.5 else 0.0)
    ink = max(bar, text) if tint > 0.3 else bar
    for j in range(3):
        colour[j] *= 1.0 - ink * (0.85 - 0.25 * j * tint)


@compiled
def _glass(colour, width, window):
    """A frame around the pane and a mullion in its middle. window: position (2) on the pane and its sides (2) [m]."""
    w, h = window[2], window[3]
    if w <= 0.0:
        return 1.0
    frame = 0.0
    for along, side in ((window[0], w), (window[1], h)):
        inside = _overlap(along, FRAME_M, side - FRAME_M, width)
        frame = max(frame, 1.0 - inside)
    frame = max(frame, _overlap(window[0], 0.5 * w - 0.03, 0.5 * w + 0.03, width))
    for j in range(3):
        colour[j] = (1.0 - frame) * colour[j] + frame * 0.62
    return 1.0 - frame


@compiled
def _lane_marks(x, y, z, width, half):
    """Fraction of paint: centre dashes, edge lines, a zebra crossing every 60 m. Street frame."""
    if half <= 0.0 or abs(y) > half or abs(z) > 0.05:
        return 0.0
    dash = _overlap(y, -0.06, 0.06, width) * _stripes(x, 9.0, 3.0, width)
    edge = _overlap(abs(y), half - 0.30, half - 0.18, width)
    along = x - 60.0 * math.floor(x / 60.0 + 0.5) - 18.0
    zebra = _overlap(along, -1.5, 1.5, width) * _stripes(y + 0.25, 1.0, 0.5, width)
    return max(max(dash, edge), zebra)


@compiled
def _overlap(x, low, high, width):
    """Fraction of [x - width / 2, x + width / 2] that lies in [low, high]."""
    return max(0.0, min(x + 0.5 * width, high) - max(x - 0.5 * width, low)) / width


@compiled
def _stripes(x, period, stripe, width):
    """Mean over `width` of stripes of width `stripe` that start at multiples of `period`."""
    a, b = x - 0.5 * width, x + 0.5 * width
    ka, kb = math.floor(a / period), math.floor(b / period)
    whole = (kb - ka) * stripe
    return (whole + min(b - kb * period, stripe) - min(a - ka * period, stripe)) / width


@compiled
def _noise(x, y, width, tile):
    """The noise tile (period 1) at (x, y), faded to its mean 0.5 when the sample is wider than the grain."""
    size = len(tile)
    fade = max(0.0, 1.0 - 6.0 * width)
    if fade == 0.0:
        return 0.5
    u, v = x * size, y * size
    fu, fv = math.floor(u), math.floor(v)
    a, b = u - fu, v - fv
    i, j = int(fu) % size, int(fv) % size
    i1, j1 = (i + 1) % size, (j + 1) % size
    top = tile[j, i] * (1 - a) + tile[j, i1] * a
    low = tile[j1, i] * (1 - a) + tile[j1, i1] * a
    return 0.5 + fade * (top * (1 - b) + low * b - 0.5)


@compiled
def _sky(x, y, z, sky, haze, rgb):
    """Sky radiance along a unit direction, bilinear in the sky map; below the map, the haze of the distant ground."""
    lowest = 0.5 * math.pi + math.radians(LOWEST_SKY_DEG)
    off = math.acos(min(max(z, -1.0), 1.0))
    if off >= lowest:
        for j in range(3):
            rgb[j] = 0.5 * haze[j]
        return
    across = math.sqrt(x * x + y * y)
    r = off / lowest
    c, s = (x / across, y / across) if across > 0.0 else (0.0, 0.0)
    u = min(max((r * c + 1.0) * 0.5 * SKY_PX - 0.5, 0.0), SKY_PX - 1.001)
    v = min(max((r * s + 1.0) * 0.5 * SKY_PX - 0.5, 0.0), SKY_PX - 1.001)
    i, j = int(u), int(v)
    a, b = u - i, v - j
    for k in range(3):
        top = sky[j, i, k] * (1 - a) + sky[j, i + 1, k] * a
        low = sky[j + 1, i, k] * (1 - a) + sky[j + 1, i + 1, k] * a
        rgb[k] = top * (1 - b) + low * b
