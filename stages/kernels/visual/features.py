"""Compiled functions that pick the strongest corner of each cell of an image.

Source: see `stages/odometry/visual/features.py`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.visual.patches import Grey


@compiled
def best_per_cell(strength: NDArray[np.float32], usable: Grey, taken: Array64, cell_px: float, least: float) -> Array64:
    """Strongest usable pixel (column, row) of every square cell that holds none of `taken` (n, 2), (m, 2).

    Not nearer than half a cell to one taken or to a stronger one already chosen.
    """
    height, width = strength.shape
    rows, columns = int(height / cell_px) + 1, int(width / cell_px) + 1
    value = np.zeros((rows, columns))
    place = np.zeros((rows, columns, 2))
    for v in range(1, height - 1):
        i = int(v / cell_px)
        for u in range(1, width - 1):
            s = strength[v, u]
            if s >= least and usable[v, u] > 0:
                j = int(u / cell_px)
                if s > value[i, j]:
                    value[i, j], place[i, j, 0], place[i, j, 1] = s, u, v
    near = 0.25 * cell_px * cell_px
    for n in range(len(taken)):
        i, j = int(taken[n, 1] / cell_px), int(taken[n, 0] / cell_px)
        for a in range(max(i - 1, 0), min(i + 2, rows)):
            for b in range(max(j - 1, 0), min(j + 2, columns)):
                away = (place[a, b, 0] - taken[n, 0]) ** 2 + (place[a, b, 1] - taken[n, 1]) ** 2
                if (a == i and b == j) or away < near:
                    value[a, b] = 0.0
    found = np.empty((rows * columns, 2))
    count = 0
    for i in range(rows):
        for j in range(columns):
            best = value[i, j] > 0.0
            for a in range(max(i - 1, 0), min(i + 2, rows)):
                for b in range(max(j - 1, 0), min(j + 2, columns)):
                    away = (place[a, b, 0] - place[i, j, 0]) ** 2 + (place[a, b, 1] - place[i, j, 1]) ** 2
                    if value[a, b] > value[i, j] and away < near:
                        best = False
            if best:
                found[count] = place[i, j]
                count += 1
    return found[:count]
