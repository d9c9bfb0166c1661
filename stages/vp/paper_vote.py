"""Grid vote on the sphere for the intersections of pairs of lines, and completion of two directions to three.

Every pair of lines intersects in one direction v = n_i x n_j (n: normal of a great circle), with v and -v equivalent.
It adds

    w = l_i l_j |sin 2 theta|       l: lengths, theta: angle between the lines in the view

to its cell. The grid is that of a cube: a cell is about 1 deg wide everywhere, and opposite sides of the sphere share
cells. The vanishing point is the mean of the votes in the fullest cell and its eight neighbours.

Source: P IV (grid vote, two directions and their cross product). The weight is that of Lu et al., WACV 2017, whose
grid has poles; the cube grid has none. The mean in the cell is ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64


def most_orthogonal(directions: Array64) -> tuple[int, int, float]:
    """Indices of the two of directions (n, 3), n >= 2, nearest to a right angle, and the angle between them [rad]."""
    cosine = np.abs(directions @ directions.T)
    cosine[np.tril_indices(len(directions))] = 2.0
    i, j = np.unravel_index(int(np.argmin(cosine)), cosine.shape)
    return int(i), int(j), math.acos(min(float(cosine[i, j]), 1.0))


def complete(first: Array64, second: Array64) -> Array64:
    """Directions (3, 3), one per row: the two given and their normalised cross product."""
    third = np.cross(first, second)
    return np.stack([first, second, third / np.linalg.norm(third)])
