"""Corner tracking in the images of one fisheye camera: corners spread over a grid, returned as rays.

    corners   Harris on the half-size image, the best one of every empty cell; a high det/trace^2 excludes edges, along
              which a feature slides
    tracking  pyramidal Lucas-Kanade from the previous image, started at the prediction of the expected rotation, then
              alignment with the first template, warped by rotation and lens (patches.py), which avoids drift
    rays      by the lens model (lens.py), so that the rim of a fisheye is used like its centre

A track keeps its number while it is tracked; a number is never reused.

Source: P V.B (Harris corners, KLT); ours: the grid, the warped template.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flow.stage import StrictModel
from stages.geometry.frames import Array64
from stages.geometry.lens import Equidistant, KannalaBrandt, OCam, Polygon
from stages.kernels.visual import patches
from stages.kernels.visual.features import best_per_cell
from stages.kernels.visual.patches import Array32, Grey

MIN_SIDE_PX = 32
HALF = 2  # corners are detected in the image at half size
BORDER_PX = 12
REFILL = 0.15  # share of empty cells from which new corners are detected
BLOCK_PX = 7  # at half size, as wide as a template
ROUNDNESS = 0.14  # Harris's k: det > k trace^2 excludes edges
STEPS = 12  # maximum iterations of a Lucas-Kanade level
STEP_PX = 0.02  # convergence threshold
NO_TURN: Array64 = np.zeros(3)  # of a camera at rest, or with a global shutter


class FeatureSettings(StrictModel):
    """Settings of `FeatureTracker`."""

    count: int = Field(default=300, ge=20, le=4000)  # cells of the grid inside the lens's circle, one corner each
    max_off_axis_deg: float = Field(
        default=100.0, gt=1, le=150
    )  # beyond are the lens's rim and the body of the vehicle or drone
    masked_px: tuple[Polygon, ...] = ()  # polygons of (column, row) over the own body, without features
    min_contrast: float = Field(default=1e-8, gt=0)  # minimum corner strength for grey in [0, 1]
    window_px: int = Field(default=13, ge=5, le=51)
    levels: int = Field(default=2, ge=0, le=6)
    likeness: float = Field(default=0.75, gt=0, lt=1)  # minimum correlation with the template
    worn_likeness: float = Field(default=0.9, gt=0, le=1)  # below this correlation the template is replaced


@dataclass(frozen=True, slots=True)
class Tracks:
    """Tracked features in one image, sorted by number."""

    stamp_ns: int
    number: NDArray[np.int64]  # (n,)
    ray: Array64  # (n, 3) unit, camera frame
    pixel: Array64  # (n, 2) column, row

    def common(self, later: Tracks) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Row indices in self and in `later` of their common tracks."""
        _, mine, theirs = np.intersect1d(self.number, later.number, assume_unique=True, return_indices=True)
        return mine, theirs


@dataclass(frozen=True, slots=True)
class _Templates:
    """Image patch and rays of each track at the time of its template."""

    patch: Array32  # (n, side, side)
    ray: Array64  # (n, 3, 3) of its centre and of the pixels to the right and below, start axes

    def rows(self, pick: NDArray[np.intp]) -> _Templates:
        return _Templates(self.patch[pick], self.ray[pick])

    def and_(self, more: _Templates) -> _Templates:
        return _Templates(np.concatenate([self.patch, more.patch]), np.concatenate([self.ray, more.ray]))


class FeatureTracker:
    """Tracks corners through the images of one camera. Frame `start`: the camera axes in the first image."""

    def __init__(self, lens: Equidistant | KannalaBrandt | OCam, settings: FeatureSettings) -> None:
        self._lens, self._settings = lens, settings
        self._before: Grey | None = None
        self._usable: Grey = np.zeros((0, 0), np.uint8)  # half size, 0: no corner here
        self._next = 0
        self._turn_rad_per_row: Array64 = NO_TURN
        self._R_map_now: Array64 = np.eye(3)
        self._restart()

    def _restart(self) -> None:
        self._before = None
        self._tracks = Tracks(0, np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 2)))
        self._stale = np.zeros(0, np.bool_)  # tracks whose template must be replaced
        side = patches.SIDE_PX
        self._templates = _Templates(np.zeros((0, side, side), np.float32), np.zeros((0, 3, 3)))

    def follow(self, stamp_ns: int, grey: Grey, R_now_before: Array64, turn_rad_per_row: Array64 = NO_TURN) -> Tracks:
        """Tracks that are found in the next image. `R_now_before` is the expected rotation.

        `turn_rad_per_row` (3,): rotation of the camera between the exposures of two rows, camera axes. Rays are those
        of the camera axes at the exposure of the middle row.
        """
        self._turn_rad_per_row = turn_rad_per_row
        if self._before is None or grey.shape != self._before.shape:
            if min(grey.shape) < MIN_SIDE_PX:
                size = f"{grey.shape[1]} x {grey.shape[0]}"
                raise ValueError(f"an image of {size} pixels is too small for feature tracking")
            self._restart()
            self._usable = usable_pixels(self._lens, self._settings, grey.shape)
        self._R_map_now = self._R_map_now @ R_now_before.T
        kept, pixel = self._track(grey, R_now_before)
        ray = self._rays(pixel, grey)
        seen = np.isfinite(ray[:, 0])
        self._templates = self._templates.rows(kept[seen])
        self._tracks = Tracks(stamp_ns, self._tracks.number[kept[seen]], ray[seen], pixel[seen])
        self._before = grey
        return self._tracks

    def complete(self, R_correction: Array64) -> Tracks:
        """Add corners in empty cells; returns all tracks of the newest image.

        `R_correction` (3, 3) times the expected rotation is the estimated rotation.
        """
        assert self._before is not None, "call follow first"
        self._R_map_now = self._R_map_now @ R_correction.T
        t, s = self._tracks, self._settings
        worn = np.nonzero(self._stale)[0]
        if s.count - len(t.number) > REFILL * s.count or len(t.number) == 0:
            pixel = self._corners(self._before, t.pixel)
            ray = self._rays(pixel, self._before)
            fresh = self._templates_at(pixel)
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
            again = self._templates_at(t.pixel[worn])
            self._templates.patch[worn], self._templates.ray[worn] = again.patch, again.ray
        self._stale = np.zeros(len(t.number), np.bool_)
        return t

    def _rays(self, pixel: Array64, grey: Grey) -> Array64:
        """Rays (n, 3) of pixels (n, 2) at the exposure of the middle row; NaN outside the lens."""
        ray = self._lens.unproject(pixel)
        if not self._turn_rad_per_row.any():
            return ray
        return at_middle_row(ray, pixel[:, 1] - 0.5 * (grey.shape[0] - 1), self._turn_rad_per_row)

    def drop(self, number: NDArray[np.int64]) -> None:
        """Drop tracks of the newest image, because they are on moving objects."""
        t = self._tracks
        keep = np.nonzero(~np.isin(t.number, number))[0]
        self._tracks = Tracks(t.stamp_ns, t.number[keep], t.ray[keep], t.pixel[keep])
        self._templates, self._stale = self._templates.rows(keep), self._stale[keep]

    def _templates_at(self, pixel: Array64) -> _Templates:
        assert self._before is not None
        ray = np.stack([self._lens.unproject(pixel + step) for step in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))], axis=1)
        return _Templates(patches.take(self._before, pixel), ray @ self._R_map_now.T)

    def _track(self, grey: Grey, R_now_before: Array64) -> tuple[NDArray[np.intp], Array64]:
        t, s = self._tracks, self._settings
        self._stale = np.zeros(0, np.bool_)
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
        self._stale = likeness[good] < s.worn_likeness
        return rows[good], pixel[good]

    def _corners(self, grey: Grey, taken: Array64) -> Array64:
        s = self._settings
        half = cv2.resize(grey, (grey.shape[1] // HALF, grey.shape[0] // HALF), interpolation=cv2.INTER_AREA)
        strength = np.asarray(cv2.cornerHarris(half, BLOCK_PX, 3, ROUNDNESS), dtype=np.float32)
        cell = max(math.sqrt(np.count_nonzero(self._usable) / s.count), 4.0)
        pixel = best_per_cell(strength, self._usable, (taken + 0.5) / HALF - 0.5, cell, s.min_contrast)
        return HALF * pixel  # whole pixels: templates need no interpolation


def at_middle_row(ray: Array64, rows_after: Array64, turn_rad_per_row: Array64) -> Array64:
    """Rays (n, 3) of rows exposed `rows_after` (n,) the middle one, in the camera axes of the middle row.

    `turn_rad_per_row` (3,) is the camera's rotation from one row to the next, camera axes; it must not be zero.
    """
    rate = float(np.linalg.norm(turn_rad_per_row))
    axis, angle = turn_rad_per_row / rate, (rate * rows_after)[:, None]
    along = (ray @ axis)[:, None] * axis
    return along + np.cos(angle) * (ray - along) + np.sin(angle) * np.cross(axis, ray)  # Rodrigues


def usable_pixels(lens: Equidistant | KannalaBrandt | OCam, settings: FeatureSettings, shape: tuple[int, int]) -> Grey:
    """Mask (height, width) at half image size, 255 where corners are allowed: inside the lens, not on the own body."""
    height, width = shape[0] // HALF, shape[1] // HALF
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    pixels = (np.column_stack([column.ravel(), row.ravel()]) + 0.5) * HALF - 0.5
    ray = lens.unproject(pixels.astype(np.float64))
    away = np.arctan2(np.hypot(ray[:, 0], ray[:, 1]), ray[:, 2])
    limit = math.radians(min(settings.max_off_axis_deg, lens.max_off_axis_deg - 1.0))
    usable = (np.where(np.isnan(away), False, away <= limit).reshape(height, width) * 255).astype(np.uint8)
    for polygon in settings.masked_px:
        at = np.rint((np.array(polygon) + 0.5) / HALF - 0.5).astype(np.int32)
        cv2.fillPoly(usable, [at], 0)
    edge = BORDER_PX // HALF
    usable[:edge], usable[-edge:], usable[:, :edge], usable[:, -edge:] = 0, 0, 0, 0
    return usable
