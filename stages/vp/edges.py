"""Edges as chains of sub-pixel points along the ridges of the image gradient.

    gradient, seeds on a lattice -> noise by grey level -> follow the gradient ridge in both directions

The brighter side of a chain is always on its left. The gradient threshold is estimated in each image for each grey
level, so that shot noise and JPEG artefacts stay below it.

Source: ours, after Akinlar and Topal, EDLines, 2011 (anchors, then smart routing). DESIGN, Vision.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.kernels.vp.edges import LATTICE, REACH, SLOPE, Grey, follow, slopes_and_seeds, thresholds


@dataclass(frozen=True)
class Chains:
    """Concatenated points (column, row) of all chains, and the start index of each chain."""

    points_px: NDArray[np.float32]  # (n, 2)
    start: NDArray[np.int64]  # (k + 1,) the last one is n


class EdgeFinder:
    """Finds chains in images of one size; reuses its buffers from image to image."""

    def __init__(self, usable: NDArray[np.uint8], min_contrast: float, min_points: int) -> None:
        """`usable` (h, w) is 1 where edges are detected; `min_contrast` is in grey levels."""
        height, width = usable.shape
        border = REACH + 1
        self._usable, self._min_contrast, self._min_points = np.zeros_like(usable), min_contrast, min_points
        inside = slice(border, height - border), slice(border, width - border)
        self._usable[inside] = usable[inside]
        self._span = _spans(self._usable)
        self._slopes = np.zeros(usable.shape, dtype=np.int32)
        self._smooth, self._steep = np.empty(width, dtype=np.int16), np.empty(width, dtype=np.int16)
        self._seeds = np.empty(height * (width // LATTICE + 1), dtype=np.int64)
        self._points = np.empty((usable.size // 4, 2), dtype=np.float32)
        self._start = np.zeros(usable.size // 4 // min_points + 2, dtype=np.int64)
        self._backward = np.empty((4 * (height + width), 2), dtype=np.float32)

    def find(self, grey: Grey) -> Chains:
        """Chains of at least `min_points` points. They are views of buffers, valid until the next call."""
        least = (self._min_contrast * SLOPE) ** 2
        seeds, counts = slopes_and_seeds(
            grey, self._usable, self._span, least, self._slopes, self._smooth, self._steep, self._seeds
        )
        count, chains = follow(
            grey,
            self._slopes,
            self._seeds[:seeds],
            thresholds(counts, self._min_contrast),
            self._min_points,
            self._points,
            self._start,
            self._backward,
        )
        return Chains(self._points[:count], self._start[: chains + 1])


def _spans(usable: NDArray[np.uint8]) -> NDArray[np.int64]:
    """First and one past the last column (h, 2) of each row at or next to a usable pixel."""
    near: NDArray[np.bool_] = np.asarray(cv2.dilate(usable, np.ones((3, 3), dtype=np.uint8)), dtype=np.bool_)
    columns = np.column_stack([near.argmax(axis=1), near.shape[1] - near[:, ::-1].argmax(axis=1)]).astype(np.int64)
    columns[near.sum(axis=1) == 0] = 0
    return columns
