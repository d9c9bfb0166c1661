"""Edges as chains of sub-pixel points along the ridges of the image gradient.

    blur, gradient -> noise by grey level -> seeds on a grid -> follow the gradient ridge in both directions

The brighter side of a chain is always on its left. The gradient threshold is estimated in each image for each grey
level, so that shot noise and JPEG artefacts stay below it.

Source: ours, after Akinlar and Topal, EDLines, 2011 (anchors, then smart routing). DESIGN, Vision.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.kernels.vp.edges import Grey, follow, thresholds


@dataclass(frozen=True)
class Chains:
    """Concatenated points (column, row) of all chains, and the start index of each chain."""

    points_px: NDArray[np.float32]  # (n, 2)
    start: NDArray[np.int64]  # (k + 1,) the last one is n


class EdgeFinder:
    """Finds chains in images of one size; reuses its buffers from image to image."""

    def __init__(self, usable: NDArray[np.uint8], min_contrast: float, min_points: int) -> None:
        """`usable` (h, w) is 1 where edges are detected; `min_contrast` is in grey levels."""
        shape = usable.shape
        self._usable, self._min_contrast, self._min_points = usable.copy(), min_contrast, min_points
        self._usable[:2], self._usable[-2:], self._usable[:, :2], self._usable[:, -2:] = 0, 0, 0, 0
        self._smooth, self._unvisited = np.empty(shape, dtype=np.uint8), np.empty(shape, dtype=np.uint8)
        self._dx, self._dy = np.empty(shape, dtype=np.int16), np.empty(shape, dtype=np.int16)
        self._points = np.empty((usable.size // 4, 2), dtype=np.float32)
        self._start = np.zeros(usable.size // 4 // min_points + 2, dtype=np.int64)
        self._backward = np.empty((4 * sum(shape), 2), dtype=np.float32)

    def find(self, grey: Grey) -> Chains:
        """Chains of at least `min_points` points. They are views of buffers, valid until the next call."""
        cv2.GaussianBlur(grey, (5, 5), 0.8, dst=self._smooth)
        cv2.spatialGradient(self._smooth, self._dx, self._dy, ksize=3)
        threshold = thresholds(self._smooth, self._dx, self._dy, self._usable, self._min_contrast)
        np.copyto(self._unvisited, self._usable)
        count, chains = follow(
            self._smooth,
            self._dx,
            self._dy,
            self._unvisited,
            threshold,
            self._min_points,
            self._points,
            self._start,
            self._backward,
        )
        return Chains(self._points[:count], self._start[: chains + 1])
