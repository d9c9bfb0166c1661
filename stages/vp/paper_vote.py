"""Grid votes for the intersections of pairs of lines, in the image or on the sphere; completion of two directions.

Every pair of lines adds

    w = l_i l_j |sin 2 theta|       l: lengths, theta: angle between the lines in the view

to the cell of its intersection. The vanishing point is the mean of the votes in the fullest cell and its eight
neighbours.

image     the pixels of a view, divided into square cells; intersections outside the view do not vote
sphere    directions v = n_i x n_j (n: normal of a great circle), with v and -v equivalent, on the faces of a cube: a
          cell is about 1 deg wide everywhere, and opposite sides of the sphere share cells

Source: P IV (grid vote in the image, two directions and their cross product). The weight is that of Lu et al., WACV
2017, whose grid on the sphere has poles; the cube has none. The sphere and the mean in the cell are ours.
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
