"""Vanishing directions from great circles on the native fisheye: no rectified views, nothing lost beyond 90 deg.

    picture -> chains of edge points (edges.py) -> great-circle arcs (arcs.py) -> lines (clustering.py)
            -> the vertical, by gravity or found; horizontal pairs, one or more (search.py) -> directions with sigma

Gravity is the autopilot's attitude on the drone, and the camera_mount's own z within `vertical_sigma_deg` without
it: right
for a vehicle. Where the camera's rows are exposed one after another (`readout_ms` of its link), each point is told in
the axes of the middle row, by the camera_mount's turning: `attitude` on the drone, `motion` on the vehicle. A picture
without enough straight lines gives no directions and the reason.

Source: ours, for P IV and V.C; DESIGN, The graph: vp.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, model_validator

from flow.stage import Settings, Stage
from stages.geometry.frames import Pose
from stages.geometry.lens import Array64, Lens
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import CameraMount, DroneAttitude, Image, VanishingDirections, VehicleMotion
from stages.vp.arcs import fit_arcs
from stages.vp.clustering import cluster
from stages.vp.directions import lines_of
from stages.vp.edges import EdgeFinder
from stages.vp.eye import Eye, Polygon, make_eye
from stages.vp.gravity import GravityTrail
from stages.vp.search import Found, Limits, Prior, find_structure

MIN_POINTS = 6  # of a chain
MOST_LINES = 400
WIDE_RAD = 0.35  # a line seen over so much counts fully
LEAST_SCATTER = 0.3  # of lines against `line_sigma_deg`: no world is straighter than so much of it
SEARCH_DEG = {CameraMount.VEHICLE: 0.0, CameraMount.DRONE: 35.0}


class GreatCircleVpSettings(Settings):
    """Settings of `GreatCircleVp`."""

    camera_mount: CameraMount
    T_mount_camera: Pose
    lens: Lens
    masked_px: tuple[Polygon, ...] = ()  # where the camera_mount itself is seen: polygons of (column, row)
    max_off_axis_deg: float | None = Field(None, gt=0, le=150)  # look no farther out; None: as far as the lens does
    min_contrast: float = Field(8.0, gt=0, le=100)  # grey levels, of an edge
    tolerance_px: float = Field(1.0, gt=0, le=10)  # how far a straight line may be from its great circle
    min_extent_px: float = Field(14.0, ge=5)  # shorter arcs are not used
    line_sigma_deg: float = Field(0.25, gt=0, le=5)  # how straight and parallel the world is, one sigma of a line
    vertical_sigma_deg: float = Field(3.0, gt=0, le=60)  # how upright the camera_mount stands, without attitude
    attitude_sigma_deg: float = Field(1.0, gt=0, le=30)  # of the attitude's roll and pitch
    attitude_age_s: float = Field(0.2, gt=0)  # an older one is not used
    search_deg: float | None = Field(None, ge=0, le=90)  # without attitude the vertical is within this cone about z;
    # 0: it is z, within `vertical_sigma_deg`. None: 0 for a vehicle, 35 for a drone, which tilts as it flies
    max_frames: int = Field(3, ge=1, le=6)  # horizontal pairs; 1: Manhattan
    min_lines: int = Field(4, ge=2)  # of a horizontal pair
    min_score: float = Field(7.0, gt=0)  # standard deviations over lines in random directions
    least_sigma_deg: float = Field(0.1, gt=0, le=5)  # no direction is known better

    @model_validator(mode="after")
    def _settings_agree(self) -> GreatCircleVpSettings:
        if any(len(polygon) < 3 for polygon in self.masked_px):
            raise ValueError("masked_px: a polygon has at least three corners (column, row)")
        return self


class GreatCircleVp(Stage[GreatCircleVpSettings]):
    """The directions in which a street runs, as one fisheye sees them, and how well they are known."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"attitude", "motion"})

    def __init__(self, settings: GreatCircleVpSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._eye: Eye | None = None
        self._edges: EdgeFinder | None = None
        self._gravity = GravityTrail()
        self._vehicle = VehicleTrajectory()

    def on_attitude(self, attitude: DroneAttitude) -> None:
        """Roll, pitch and turning of the drone; its yaw is not used."""
        if self.settings.camera_mount is not CameraMount.DRONE:
            raise ValueError("attitude is the drone's: wire it to the stage whose camera_mount is the drone")
        self._gravity.add(attitude)

    def on_motion(self, motion: VehicleMotion) -> None:
        """How the vehicle turns; nothing else of it is used."""
        if self.settings.camera_mount is not CameraMount.VEHICLE:
            raise ValueError("motion is the vehicle's: wire it to the stage whose camera_mount is the vehicle")
        self._vehicle.add(motion)

    def on_image(self, image: Image) -> VanishingDirections:
        """One picture's directions and lines."""
        settings = self.settings
        if image.frame_id != f"camera_{settings.camera_mount.value}":
            raise ValueError(
                f"image comes from {image.frame_id}, this stage's camera_mount is the {settings.camera_mount.value}"
            )
        if self._eye is None or self._edges is None or self._eye.usable.shape != image.grey.shape:
            self._eye = make_eye(settings.lens, image.grey.shape, settings.max_off_axis_deg, settings.masked_px)
            self._edges = EdgeFinder(self._eye.usable, settings.min_contrast, MIN_POINTS)
        eye = self._eye
        chains = self._edges.find(image.grey)
        R = settings.T_mount_camera.matrix()[:3, :3]
        turn = image.rows_after_s() * (self._rate_radps(image.stamp_ns) @ R)
        arcs = cluster(fit_arcs(chains, eye, settings.tolerance_px, settings.min_extent_px, turn), eye, MOST_LINES)
        lines = lines_of(arcs, R, WIDE_RAD)
        found = find_structure(lines, self._prior(image.stamp_ns), self._limits())
        return self._message(image.stamp_ns, found, lines.normal, arcs.ends @ R.T, arcs.sigma_rad)

    def _rate_radps(self, stamp_ns: int) -> Array64:
        """How the camera_mount turns (3,), its own axes; zero where nothing tells."""
        if self.settings.camera_mount is CameraMount.DRONE:
            rate = self._gravity.rate_radps(stamp_ns, self.settings.attitude_age_s)
            return np.zeros(3) if rate is None else rate
        return self._vehicle.rate_radps(stamp_ns) if self._vehicle.known_at(stamp_ns) else np.zeros(3)

    def _prior(self, stamp_ns: int) -> Prior:
        settings = self.settings
        up = self._gravity.at(stamp_ns, settings.attitude_age_s)
        if up is not None:
            return Prior(up, math.radians(settings.attitude_sigma_deg), 0.0)
        search_deg = SEARCH_DEG[settings.camera_mount] if settings.search_deg is None else settings.search_deg
        sigma_deg = max(settings.vertical_sigma_deg, search_deg)
        return Prior(np.array([0.0, 0.0, 1.0]), math.radians(sigma_deg), math.radians(search_deg))

    def _limits(self) -> Limits:
        settings = self.settings
        return Limits(
            math.radians(settings.line_sigma_deg),
            math.radians(settings.least_sigma_deg),
            LEAST_SCATTER,
            settings.max_frames,
            settings.min_lines,
            settings.min_score,
        )

    def _message(
        self, stamp_ns: int, found: Found, normal: Array64, ends: Array64, sigma_rad: Array64
    ) -> VanishingDirections:
        return VanishingDirections(
            stamp_ns=stamp_ns,
            camera_mount=self.settings.camera_mount,
            direction=found.direction,
            sigma_rad=found.sigma_rad,
            is_vertical=found.frame < 0,
            frame=found.frame,
            line_normal=normal,
            line_end=ends,
            line_sigma_rad=sigma_rad,
            line_direction=found.line_direction,
            reason=found.reason,
        )
