"""Grid vote on the sphere: where most pairs of lines meet; and three directions of two.

Every pair of lines meets in one direction v = n_i x n_j (n: normal of a line's great circle), v and -v alike. It gives

    w = l_i l_j |sin 2 theta|       l: lengths, theta: angle between the lines in the view

to its cell. The grid is a cube's: a cell is 1 deg or so wide everywhere, the two sides of the sphere share cells. The
fullest cell, its eight neighbours counted in, is the vanishing point; it lies at the mean of their votes.

Source: P IV (grid vote, two directions and their cross product). The weight is Lu et al.'s, WACV 2017, whose grid has
poles; a cube's has none. The mean in the cell is ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64


def most_orthogonal(directions: Array64) -> tuple[int, int, float]:
    """Which two of directions (n, 3), n >= 2, stand nearest to a right angle, and the angle between them [rad]."""
    cosine = np.abs(directions @ directions.T)
    cosine[np.tril_indices(len(directions))] = 2.0
    i, j = np.unravel_index(int(np.argmin(cosine)), cosine.shape)
    return int(i), int(j), math.acos(min(float(cosine[i, j]), 1.0))


def completed(first: Array64, second: Array64) -> Array64:
    """Directions (3, 3), one a row: the two given and their cross product, of length 1."""
    third = np.cross(first, second)
    return np.stack([first, second, third / np.linalg.norm(third)])
