"""Compiled functions that vote for vanishing directions, on a cube or in a view's image.

Source: see `stages/vp/paper_vote.py`.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled


@compiled
def cell_of(v: Array64, cells: int) -> tuple[int, int, int]:
    """Face, row and column of direction v (3,) on a cube of cells x cells faces, evenly spaced by angle."""
    face = 0
    if abs(v[1]) > abs(v[face]):
        face = 1
    if abs(v[2]) > abs(v[face]):
        face = 2
    a, b = v[(face + 1) % 3] / v[face], v[(face + 2) % 3] / v[face]
    row = int((math.atan(a) / (0.5 * math.pi) + 0.5) * cells)
    column = int((math.atan(b) / (0.5 * math.pi) + 0.5) * cells)
    return face, min(row, cells - 1), min(column, cells - 1)


@compiled
def vote(
    normals: Array64, lengths: Array64, angles_rad: Array64, cells: int, taken: Array64, apart_rad: float
) -> tuple[Array64, Array64]:
    """Votes (3, cells, cells) and their vector sums (3, cells, cells, 3) of lines with normals (n, 3).

    `angles_rad` (n,) is each line's angle in its view. Votes nearer than `apart_rad` to a direction of `taken` (k, 3)
    do not count. Vectors are turned to the face's positive side.
    """
    votes = np.zeros((3, cells, cells))
    sums = np.zeros((3, cells, cells, 3))
    v = np.empty(3)
    near = math.cos(apart_rad)
    for i in range(len(normals)):
        for j in range(i + 1, len(normals)):
            weight = lengths[i] * lengths[j] * abs(math.sin(2.0 * (angles_rad[i] - angles_rad[j])))
            v[0] = normals[i, 1] * normals[j, 2] - normals[i, 2] * normals[j, 1]
            v[1] = normals[i, 2] * normals[j, 0] - normals[i, 0] * normals[j, 2]
            v[2] = normals[i, 0] * normals[j, 1] - normals[i, 1] * normals[j, 0]
            norm = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
            if norm < 1e-9 or weight <= 0.0:
                continue
            free = True
            for t in taken:
                free &= abs(v[0] * t[0] + v[1] * t[1] + v[2] * t[2]) <= near * norm
            if not free:
                continue
            face, row, column = cell_of(v, cells)
            turn = weight / norm if v[face] > 0 else -weight / norm
            votes[face, row, column] += weight
            for k in range(3):
                sums[face, row, column, k] += turn * v[k]
    return votes, sums


@compiled
def fullest(votes: Array64, sums: Array64) -> tuple[Array64, float]:
    """The unit direction (3,) with the most votes, and their share of all; share 0 without votes."""
    best, total = 0.0, votes.sum()
    direction = np.zeros(3)
    cells = votes.shape[1]
    for face in range(3):
        for row in range(cells):
            for column in range(cells):
                top, bottom = max(row - 1, 0), min(row + 2, cells)
                left, right = max(column - 1, 0), min(column + 2, cells)
                near = votes[face, top:bottom, left:right].sum()
                if near > best:
                    best = near
                    for k in range(3):
                        direction[k] = sums[face, top:bottom, left:right, k].sum()
    if best <= 0.0:
        return direction, 0.0
    return direction / np.sqrt((direction * direction).sum()), best / total


@compiled
def vote_in_image(segments: Array64, side_px: int, cells: int) -> tuple[Array64, Array64]:
    """Votes (cells, cells) of segments (n, 4) u1, v1, u2, v2 for their intersections inside a square image.

    Returns also the weighted sums of the intersections (cells, cells, 2) u, v. The image ends half a pixel beyond
    the centres of its first and last pixels; rows are v.
    """
    votes = np.zeros((cells, cells))
    sums = np.zeros((cells, cells, 2))
    n = len(segments)
    a, b, c, length = np.empty(n), np.empty(n), np.empty(n), np.empty(n)  # a u + b v = c
    for i in range(n):
        du, dv = segments[i, 2] - segments[i, 0], segments[i, 3] - segments[i, 1]
        length[i] = math.sqrt(du * du + dv * dv)
        a[i], b[i] = dv / length[i], -du / length[i]
        c[i] = a[i] * segments[i, 0] + b[i] * segments[i, 1]
    for i in range(n):
        for j in range(i + 1, n):
            sine = a[i] * b[j] - b[i] * a[j]
            cosine = a[i] * a[j] + b[i] * b[j]
            weight = length[i] * length[j] * abs(2.0 * sine * cosine)
            if weight <= 0.0:
                continue
            u, v = (c[i] * b[j] - b[i] * c[j]) / sine, (a[i] * c[j] - c[i] * a[j]) / sine
            row, column = math.floor((v + 0.5) * cells / side_px), math.floor((u + 0.5) * cells / side_px)
            if not (0 <= row < cells and 0 <= column < cells):
                continue
            votes[row, column] += weight
            sums[row, column, 0] += weight * u
            sums[row, column, 1] += weight * v
    return votes, sums


@compiled
def fullest_in_image(votes: Array64, sums: Array64) -> tuple[float, float, float]:
    """Mean (u, v) [px] of the votes in the fullest cell with its neighbours, and their share of all; share 0: none."""
    best, u, v, cells = 0.0, 0.0, 0.0, len(votes)
    for row in range(cells):
        for column in range(cells):
            rows, columns = slice(max(row - 1, 0), row + 2), slice(max(column - 1, 0), column + 2)
            near = votes[rows, columns].sum()
            if near > best:
                best = near
                u, v = sums[rows, columns, 0].sum() / near, sums[rows, columns, 1].sum() / near
    return u, v, best / votes.sum() if best > 0.0 else 0.0
