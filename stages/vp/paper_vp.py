"""Vanishing points by the method of the paper: three rectified views, lines, a grid vote, the best two.

    fisheye -> three views of 428 x 428 px (paper_views.py) -> lines by LSD -> a vanishing point each (paper_vote.py)
            -> the two nearest to a right angle -> the third by cross product

The two directions are not made orthogonal: the alignment does that. Two at less than `min_angle_deg` give no result.
There is one Manhattan frame, as in the paper. In a town with streets at other angles it may follow any of them, or mix
two.

`vote: image` counts intersections inside a view, so each view has to contain a vanishing point: one view on the axis of
the lens contains the vertical, two at its side, 90 deg apart, a horizontal direction each (`configs/paper.yaml`). With
`vote: sphere` each view takes a vanishing point at least `apart_deg` from those of the previous views, because
independent views often all choose the vertical.

`is_vertical` marks the direction within `vertical_deg` of the up axis of the camera mount; the paper does not need
it. The paper gives no sigma either, so `sigma_deg` is a setting.

Source: P IV, V.C. `docs/explanation/paper.md` lists what differs from the paper, and what it does not give.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from flow.stage import Settings, Stage
from stages.geometry.frames import Array64, Pose
from stages.geometry.lens import Lens
from stages.kernels.vp.paper_vote import fullest, fullest_in_image, vote, vote_in_image
from stages.messages import CameraMount, Image, VanishingDirections
from stages.vp.paper_views import RectifiedView, ViewDirection, great_circles, segment_length_px
from stages.vp.paper_vote import complete, most_orthogonal

MIN_VISIBLE = 0.5  # share of each view inside the field of view of the lens
ON_DIRECTION_DEG = 2.0  # a line within this angle of a direction belongs to it


@dataclass(frozen=True, slots=True)
class _Lines:
    """The lines of one view."""

    ends: Array64  # (n, 2, 3) unit rays, axes of the camera mount
    normal: Array64  # (n, 3)
    sigma_rad: Array64  # (n,)
    point: Array64 | None  # (3,) the view's vanishing point


class PaperVpSettings(Settings):
    """Settings of `PaperVp`."""

    camera_mount: CameraMount
    T_mount_camera: Pose
    lens: Lens
    size_px: int = Field(ge=64, le=4096)  # side of the square image of the lens
    views: tuple[ViewDirection, ...] = Field(
        (
            ViewDirection(azimuth_deg=-90, off_axis_deg=70),
            ViewDirection(azimuth_deg=30, off_axis_deg=70),
            ViewDirection(azimuth_deg=150, off_axis_deg=70),
        ),
        min_length=2,
        max_length=6,
    )
    view_px: int = Field(428, ge=64, le=1024)
    fov_deg: float = Field(90.0, gt=20, le=120)
    min_length_px: float = Field(20.0, ge=5)
    max_lines: int = Field(200, ge=2, le=1000)  # the longest of each view
    vote: Literal["sphere", "image"] = "sphere"
    sphere_cells: int = Field(90, ge=10, le=360)  # of the grid per 90 deg, by `sphere`
    image_cells: int = Field(90, ge=10, le=360)  # of the grid per side of a view, by `image`
    min_lines: int = Field(10, ge=2)  # within 2 deg of a view's vanishing point; with fewer the view has none
    apart_deg: float = Field(20.0, ge=0, lt=45)  # between the points of the views by `sphere`; 0: independent views
    min_angle_deg: float = Field(80.0, gt=5, lt=90)  # between the two selected vanishing points
    vertical_deg: float = Field(30.0, gt=0, le=45)
    sigma_deg: float = Field(1.0, gt=0)

    def rectified_views(self) -> list[RectifiedView]:
        """The views, each with its remap table."""
        R = self.T_mount_camera.matrix()[:3, :3]
        return [RectifiedView(view, self.lens, R, self.view_px, self.fov_deg) for view in self.views]

    @model_validator(mode="after")
    def _lens_sees_views(self) -> PaperVpSettings:
        for k, view in enumerate(self.rectified_views()):
            if view.visible_share < MIN_VISIBLE:
                raise ValueError(
                    f"views.{k}: only {view.visible_share:.0%} of it is in the lens; decrease off_axis_deg or fov_deg "
                    f"(the lens ends at {self.lens.max_off_axis_deg:g} deg)"
                )
        return self


class PaperVp(Stage[PaperVpSettings]):
    """P IV: one vanishing point from each of three views; the best two and their cross product."""

    def __init__(self, settings: PaperVpSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._views = self.settings.rectified_views()

    def on_image(self, image: Image) -> VanishingDirections:
        """Directions of an image; none, with a reason, when the views have too few lines."""
        settings = self.settings
        if image.grey.shape != (settings.size_px, settings.size_px):
            height, width = image.grey.shape
            raise ValueError(
                f"the image is {width} x {height} px, but size_px is {settings.size_px}: set the lens of this camera"
            )
        lines: list[_Lines] = []
        points: list[Array64] = []
        for view in self._views:
            lines.append(self._view_lines(view, image, points))
            if (point := lines[-1].point) is not None:
                points.append(point)
        if len(points) < 2:
            reason = f"{len(points)} of {len(lines)} views have a vanishing point"
            return self._message(image.stamp_ns, lines, None, reason)
        i, j, angle_rad = most_orthogonal(np.stack(points))
        if math.degrees(angle_rad) < settings.min_angle_deg:
            reason = f"no two vanishing points are at a right angle: {math.degrees(angle_rad):.0f} deg at most"
            return self._message(image.stamp_ns, lines, None, reason)
        reason = f"{len(points)} vanishing points, two at {math.degrees(angle_rad):.1f} deg"
        return self._message(image.stamp_ns, lines, complete(points[i], points[j]), reason)

    def _view_lines(self, view: RectifiedView, image: Image, taken: list[Array64]) -> _Lines:
        settings = self.settings
        segments = view.segments(view.rectify(image.grey), settings.min_length_px, settings.max_lines)
        ends = view.ends(segments)
        normal = great_circles(ends)
        point = None
        if len(segments) >= settings.min_lines:
            found, share = self._fullest(view, segments, normal, taken)
            through = np.count_nonzero(np.abs(normal @ found) <= math.sin(math.radians(ON_DIRECTION_DEG)))
            point = found if share > 0 and through >= settings.min_lines else None
        return _Lines(ends, normal, view.normal_sigma_rad(segments), point)

    def _fullest(
        self, view: RectifiedView, segments: Array64, normal: Array64, taken: list[Array64]
    ) -> tuple[Array64, float]:
        """Direction (3,) with the most votes of a view's lines, and its share of all votes; share 0: none."""
        settings = self.settings
        if settings.vote == "image":
            u, v, share = fullest_in_image(*vote_in_image(segments, settings.view_px, settings.image_cells))
            return view.directions(np.array([[u, v]]))[0], share
        angles = np.arctan2(segments[:, 3] - segments[:, 1], segments[:, 2] - segments[:, 0])
        lengths, others = segment_length_px(segments), np.array(taken).reshape(-1, 3)
        return fullest(*vote(normal, lengths, angles, settings.sphere_cells, others, math.radians(settings.apart_deg)))

    def _message(
        self, stamp_ns: int, lines: list[_Lines], directions: Array64 | None, reason: str
    ) -> VanishingDirections:
        found, vertical = self._vertical_first(np.empty((0, 3)) if directions is None else directions)
        normal = np.concatenate([view_lines.normal for view_lines in lines])
        return VanishingDirections(
            stamp_ns=stamp_ns,
            camera_mount=self.settings.camera_mount,
            direction=found,
            sigma_rad=np.full(len(found), math.radians(self.settings.sigma_deg)),
            is_vertical=vertical,
            frame=np.where(vertical, -1, 0).astype(np.int64),
            line_normal=normal,
            line_end=np.concatenate([view_lines.ends for view_lines in lines]),
            line_sigma_rad=np.concatenate([view_lines.sigma_rad for view_lines in lines]),
            line_direction=assign_lines(normal, found, math.radians(ON_DIRECTION_DEG)),
            reason=reason,
        )

    def _vertical_first(self, directions: Array64) -> tuple[Array64, np.ndarray[Any, np.dtype[np.bool_]]]:
        """Directions with the one nearest to up first, and the mask of the vertical one."""
        order = np.argsort(-np.abs(directions[:, 2]), kind="stable")
        found = directions[order]
        vertical = np.abs(found[:, 2]) > math.cos(math.radians(self.settings.vertical_deg))
        vertical[1:] = False
        return found, vertical


def assign_lines(normal: Array64, directions: Array64, within_rad: float) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Index (m,) of the direction (n, 3) of each normal (m, 3): least |n . v| <= sin(within_rad); -1: none."""
    if not len(directions):
        return np.full(len(normal), -1, dtype=np.int64)
    residual = np.abs(normal @ directions.T)
    nearest = np.argmin(residual, axis=1)
    return np.where(residual.min(axis=1) <= math.sin(within_rad), nearest, -1).astype(np.int64)
