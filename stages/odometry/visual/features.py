"""Corners followed from picture to picture on a fisheye: spread over a grid, told as rays.

    corners   Harris on the half-size picture, the best of every cell that has none; round ones only, because what
              slides along an edge looks like a motion
    follow    pyramidal Lucas-Kanade from the last picture, started where the expected rotation puts each corner, then
              the template of when the corner was new, warped by rotation and lens (patches.py): no drift
    rays      by the lens (lens.py), so that the edge of a fisheye counts like its middle

A track keeps its number as long as it is followed; a number is never used twice.

Source: P V.B (Harris corners, KLT); ours: the grid, the warped template.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from stages.geometry.frames import Array64
from stages.geometry.lens import Equidistant, KannalaBrandt, OCam
from stages.kernels.visual import patches
from stages.kernels.visual.features import best_per_cell
from stages.kernels.visual.patches import Array32, Grey

Polygon = Annotated[tuple[tuple[float, float], ...], Field(min_length=3)]
MIN_SIDE_PX = 32
HALF = 2  # corners are looked for in the picture at half its size
BORDER_PX = 12
REFILL = 0.15  # of the cells empty: corners are looked for
BLOCK_PX = 7  # at half size: as wide as a template
ROUNDNESS = 0.14  # Harris's k: det > k trace^2, so nothing that slides along an edge
STEPS = 12  # of one Lucas-Kanade level at most
STEP_PX = 0.02  # and until it moves less


class FeatureSettings(BaseModel):
    """How many corners, and how they are followed."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    count: int = Field(default=300, ge=20, le=4000)  # cells of the grid inside the lens's circle, one corner each
    max_off_axis_deg: float = Field(default=100.0, gt=1, le=150)  # beyond, the lens's edge and the own body
    masked_px: tuple[Polygon, ...] = ()  # (column, row) corners of what is the own body: no feature there
    min_contrast: float = Field(default=1e-8, gt=0)  # corner strength, grey in [0, 1]; below it is noise
    window_px: int = Field(default=13, ge=5, le=51)
    levels: int = Field(default=2, ge=0, le=6)
    likeness: float = Field(default=0.75, gt=0, lt=1)  # correlation with its template; less is something else
    worn_likeness: float = Field(default=0.9, gt=0, le=1)  # below, a new template is taken


@dataclass(frozen=True, slots=True)
class Tracks:
    """What is followed in one picture, by growing number."""

    stamp_ns: int
    number: NDArray[np.int64]  # (n,)
    ray: Array64  # (n, 3) unit, camera frame
    pixel: Array64  # (n, 2) column, row

    def common(self, later: Tracks) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows in self and in `later` of the tracks both have."""
        _, mine, theirs = np.intersect1d(self.number, later.number, assume_unique=True, return_indices=True)
        return mine, theirs


@dataclass(frozen=True, slots=True)
class _Templates:
    """What each track looked like when its template was taken."""

    patch: Array32  # (n, side, side)
    ray: Array64  # (n, 3, 3) of its middle, and one STEP_PX to the right and below it, in the start's axes

    def rows(self, pick: NDArray[np.intp]) -> _Templates:
        return _Templates(self.patch[pick], self.ray[pick])

    def and_(self, more: _Templates) -> _Templates:
        return _Templates(np.concatenate([self.patch, more.patch]), np.concatenate([self.ray, more.ray]))


class FeatureTracker:
    """Follows corners through the pictures of one camera. Frame start: the camera's axes in the first picture."""

    def __init__(self, lens: Equidistant | KannalaBrandt | OCam, settings: FeatureSettings) -> None:
        self._lens, self._settings = lens, settings
        self._before: Grey | None = None
        self._usable: Grey = np.zeros((0, 0), np.uint8)  # half size, 0: no corner wanted here
        self._next = 0
        self._R_map_now: Array64 = np.eye(3)
        self._restart()

    def _restart(self) -> None:
        self._before = None
        self._tracks = Tracks(0, np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 2)))
        self._worn = np.zeros(0, np.bool_)  # whose template needs to be taken anew
        side = patches.SIDE_PX
        self._templates = _Templates(np.zeros((0, side, side), np.float32), np.zeros((0, 3, 3)))

    def follow(self, stamp_ns: int, grey: Grey, R_now_before: Array64) -> Tracks:
        """Find the tracks again in the next picture. `R_now_before` is the rotation expected."""
        if self._before is None or grey.shape != self._before.shape:
            if min(grey.shape) < MIN_SIDE_PX:
                size = f"{grey.shape[1]} x {grey.shape[0]}"
                raise ValueError(f"a picture of {size} pixels is too small to follow anything in")
            self._restart()
            self._usable = usable_pixels(self._lens, self._settings, grey.shape)
        self._R_map_now = self._R_map_now @ R_now_before.T
        kept, pixel = self._found_again(grey, R_now_before)
        ray = self._lens.unproject(pixel)
        seen = np.isfinite(ray[:, 0])
        self._templates = self._templates.rows(kept[seen])
        self._tracks = Tracks(stamp_ns, self._tracks.number[kept[seen]], ray[seen], pixel[seen])
        self._before = grey
        return self._tracks

    def complete(self, R_correction: Array64) -> Tracks:
        """Corners where cells are empty, and all tracks of the newest picture.

        `R_correction` (3, 3), on the left of the expected rotation, makes it the one found.
        """
        assert self._before is not None, "follow a picture first"
        self._R_map_now = self._R_map_now @ R_correction.T
        t, s = self._tracks, self._settings
        worn = np.nonzero(self._worn)[0]
        if s.count - len(t.number) > REFILL * s.count or len(t.number) == 0:
            pixel = self._corners(self._before, t.pixel)
            ray = self._lens.unproject(pixel)
            fresh = self._taken(pixel)
            number = np.arange(self._next, self._next + len(pixel))
            self._next += len(pixel)
            self._templates = self._templates.and_(fresh)
            t = Tracks(
                t.stamp_ns,
                np.concatenate([t.number, number]),
                np.vstack([t.ray, ray]),
                np.vstack([t.pixel, pixel]),
            )
            self._tracks = t
        if len(worn):
            again = self._taken(t.pixel[worn])
            self._templates.patch[worn], self._templates.ray[worn] = again.patch, again.ray
        self._worn = np.zeros(len(t.number), np.bool_)
        return t

    def forget(self, number: NDArray[np.int64]) -> None:
        """Let go of tracks of the newest picture: they follow nothing that stands still."""
        t = self._tracks
        keep = np.nonzero(~np.isin(t.number, number))[0]
        self._tracks = Tracks(t.stamp_ns, t.number[keep], t.ray[keep], t.pixel[keep])
        self._templates, self._worn = self._templates.rows(keep), self._worn[keep]

    def _taken(self, pixel: Array64) -> _Templates:
        assert self._before is not None
        ray = np.stack([self._lens.unproject(pixel + step) for step in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))], axis=1)
        return _Templates(patches.take(self._before, pixel), ray @ self._R_map_now.T)

    def _found_again(self, grey: Grey, R_now_before: Array64) -> tuple[NDArray[np.intp], Array64]:
        t, s = self._tracks, self._settings
        self._worn = np.zeros(0, np.bool_)
        guess = self._lens.project(t.ray @ R_now_before.T)
        warped = self._lens.project((self._templates.ray @ self._R_map_now).reshape(-1, 3)).reshape(-1, 3, 2)
        rows = np.nonzero(np.isfinite(guess[:, 0]) & np.isfinite(warped).all(axis=(1, 2)))[0]
        if self._before is None or len(rows) == 0:
            return np.zeros(0, np.intp), np.zeros((0, 2))
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            self._before,
            grey,
            t.pixel[rows].astype(np.float32),
            guess[rows].astype(np.float32),
            winSize=(s.window_px, s.window_px),
            maxLevel=s.levels,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, STEPS, STEP_PX),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        near = np.asarray(found, dtype=np.float64).reshape(-1, 2)
        warp = np.stack([warped[rows, 1] - warped[rows, 0], warped[rows, 2] - warped[rows, 0]], axis=2)
        pixel, likeness = patches.find(grey, self._templates.patch[rows], warp, near)
        height, width = self._usable.shape
        column, row = ((pixel + 0.5) / HALF - 0.5).T
        good = (np.asarray(status).ravel() > 0) & (likeness > s.likeness)
        good &= (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
        good[good] = self._usable[np.rint(row[good]).astype(int), np.rint(column[good]).astype(int)] > 0
        self._worn = likeness[good] < s.worn_likeness
        return rows[good], pixel[good]

    def _corners(self, grey: Grey, taken: Array64) -> Array64:
        s = self._settings
        half = cv2.resize(grey, (grey.shape[1] // HALF, grey.shape[0] // HALF), interpolation=cv2.INTER_AREA)
        strength = np.asarray(cv2.cornerHarris(half, BLOCK_PX, 3, ROUNDNESS), dtype=np.float32)
        cell = max(math.sqrt(np.count_nonzero(self._usable) / s.count), 4.0)
        place = best_per_cell(strength, self._usable, (taken + 0.5) / HALF - 0.5, cell, s.min_contrast)
        return HALF * place  # a whole pixel: a template needs no pixels between


def usable_pixels(lens: Equidistant | KannalaBrandt | OCam, settings: FeatureSettings, shape: tuple[int, int]) -> Grey:
    """255 where a corner may be, at half the picture's size (height, width): inside the lens, not on the own body."""
    height, width = shape[0] // HALF, shape[1] // HALF
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    places = (np.column_stack([column.ravel(), row.ravel()]) + 0.5) * HALF - 0.5
    ray = lens.unproject(places.astype(np.float64))
    away = np.arctan2(np.hypot(ray[:, 0], ray[:, 1]), ray[:, 2])
    limit = math.radians(min(settings.max_off_axis_deg, lens.max_off_axis_deg - 1.0))
    usable = (np.where(np.isnan(away), False, away <= limit).reshape(height, width) * 255).astype(np.uint8)
    for polygon in settings.masked_px:
        at = np.rint((np.array(polygon) + 0.5) / HALF - 0.5).astype(np.int32)
        cv2.fillPoly(usable, [at], 0)
    edge = BORDER_PX // HALF
    usable[:edge], usable[-edge:], usable[:, :edge], usable[:, -edge:] = 0, 0, 0, 0
    return usable
