"""Vanishing directions from great circles on the native fisheye: no rectified views, valid beyond 90 deg off axis.

    image -> chains of edge points (edges.py) -> great-circle arcs (arcs.py) -> lines (clustering.py)
            -> vertical, from gravity or search; one or more horizontal pairs (search.py) -> directions with sigma

On the drone, gravity is the autopilot's tilt. Without it, gravity is the mount's z axis within
`vertical_sigma_deg`, which is correct for a vehicle. With a rolling shutter (`readout_ms` of the camera link), each
point is corrected to the exposure of the middle row with the angular rate of the mount: `tilt` on the drone,
`motion` on the vehicle. An image without enough straight lines gives no directions, and a reason; one whose lines fit
several verticals about equally well gives each as an answer with a probability, for `align` and the heading.

The scores of further pairs and the least and weak sigma were chosen on renders of three real panoramas; a fourth was
kept back: tests/benchmarks/accuracy/bench_vp_panoramas.py. A weak pair, of which one in five is false there, serves
`align`, which weighs its lines against those of the other camera.

Source: ours, for P IV and V.C; DESIGN, The graph: vp.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from flow.stage import Settings, Stage
from stages.geometry.frames import Pose
from stages.geometry.lens import Array64, Lens, Polygon
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import CameraMount, DroneTilt, Image, VanishingDirections, VehicleMotion
from stages.vp.arcs import fit_arcs
from stages.vp.clustering import cluster
from stages.vp.directions import lines_of
from stages.vp.edges import EdgeFinder
from stages.vp.gravity import TiltBuffer
from stages.vp.pixel_rays import PixelRays, make_pixel_rays
from stages.vp.search import FoundDirections, SearchLimits, VerticalPrior, find_structure

MIN_POINTS = 6  # of a chain
MAX_LINES = 400
FULL_WEIGHT_RAD = 0.35  # extent from which a line has full weight
MIN_SCATTER = 0.3  # smallest accepted scatter of lines, in units of `line_sigma_deg`
SEARCH_DEG = {CameraMount.VEHICLE: 0.0, CameraMount.DRONE: 35.0}


class GreatCircleVpSettings(Settings):
    """Settings of `GreatCircleVp`."""

    camera_mount: CameraMount
    T_mount_camera: Pose
    lens: Lens
    masked_px: tuple[Polygon, ...] = ()  # polygons of (column, row) over the body of the vehicle or drone
    max_off_axis_deg: float | None = Field(
        None, gt=0, le=150
    )  # rays farther off axis are not used; None: limit of the lens
    min_contrast: float = Field(8.0, gt=0, le=100)  # of an edge [grey levels]
    tolerance_px: float = Field(1.0, gt=0, le=10)  # largest distance of a line's points from its great circle
    min_extent_px: float = Field(14.0, ge=5)  # shorter arcs are not used
    line_sigma_deg: float = Field(0.25, gt=0, le=5)  # one sigma of straightness and parallelism of lines
    vertical_sigma_deg: float = Field(3.0, gt=0, le=60)  # of the mount's z axis against the vertical, without tilt
    tilt_age_s: float = Field(0.2, gt=0)  # maximum age of a tilt
    search_deg: float | None = Field(None, ge=0, le=90)  # without tilt, the vertical is searched in this cone about z;
    # 0: it is z, within `vertical_sigma_deg`. None: 0 for a vehicle, 35 for a drone, which tilts in flight
    max_frames: int = Field(3, ge=1, le=6)  # horizontal pairs; 1: Manhattan
    min_lines: int = Field(4, ge=2)  # of a horizontal pair
    min_score: float = Field(7.0, gt=0)  # in standard deviations above lines of random directions
    min_direction_score: float = Field(2.0, ge=-100)  # of each direction of a further pair, in the same units
    min_elsewhere_score: float = Field(4.0, ge=-100)  # of a further pair without the lines of any 90 deg of azimuth
    confident_direction_score: float = Field(3.0, ge=-100)  # a further pair with less is weak: perhaps of one object
    confident_elsewhere_score: float = Field(6.0, ge=-100)
    weak_sigma_deg: float = Field(15.0, ge=0, le=60)  # of the directions of a weak pair
    least_sigma_deg: float = Field(0.15, gt=0, le=5)  # beyond that of the lines: buildings are not exactly square


class GreatCircleVp(Stage[GreatCircleVpSettings]):
    """Vertical and horizontal directions of a street from one fisheye image, each with its sigma."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"tilt", "motion"})

    def __init__(self, settings: GreatCircleVpSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._pixel_rays: PixelRays | None = None
        self._edges: EdgeFinder | None = None
        self._tilts = TiltBuffer()
        self._vehicle = VehicleTrajectory()

    def on_tilt(self, tilt: DroneTilt) -> None:
        """Vertical and angular rate of the drone."""
        if self.settings.camera_mount is not CameraMount.DRONE:
            raise ValueError("tilt belongs to the drone: connect it to the stage whose camera_mount is drone")
        self._tilts.add(tilt)

    def on_motion(self, motion: VehicleMotion) -> None:
        """Angular rate of the vehicle; nothing else of the message is used."""
        if self.settings.camera_mount is not CameraMount.VEHICLE:
            raise ValueError("motion belongs to the vehicle: connect it to the stage whose camera_mount is vehicle")
        self._vehicle.add(motion)

    def on_image(self, image: Image) -> VanishingDirections:
        """Directions and lines of one image."""
        settings = self.settings
        if image.frame_id != f"camera_{settings.camera_mount.value}":
            raise ValueError(
                f"the image is of {image.frame_id}, but the camera_mount of this stage is {settings.camera_mount.value}"
            )
        if self._pixel_rays is None or self._edges is None or self._pixel_rays.usable.shape != image.grey.shape:
            self._pixel_rays = make_pixel_rays(
                settings.lens, image.grey.shape, settings.max_off_axis_deg, settings.masked_px
            )
            self._edges = EdgeFinder(self._pixel_rays.usable, settings.min_contrast, MIN_POINTS)
        pixel_rays = self._pixel_rays
        chains = self._edges.find(image.grey)
        R = settings.T_mount_camera.matrix()[:3, :3]
        turn = image.rows_after_s() * (self._rate_radps(image.stamp_ns) @ R)
        arcs = cluster(
            fit_arcs(chains, pixel_rays, settings.tolerance_px, settings.min_extent_px, turn), pixel_rays, MAX_LINES
        )
        lines = lines_of(arcs, R, FULL_WEIGHT_RAD)
        found = find_structure(lines, self._prior(image.stamp_ns), self._limits())
        return self._message(image.stamp_ns, found, lines.normal, arcs.ends @ R.T, lines.sigma_rad)

    def _rate_radps(self, stamp_ns: int) -> Array64:
        """Angular rate (3,) of the mount, mount axes; zero when it is unknown."""
        if self.settings.camera_mount is CameraMount.DRONE:
            rate = self._tilts.rate_radps(stamp_ns, self.settings.tilt_age_s)
            return np.zeros(3) if rate is None else rate
        return self._vehicle.rate_radps(stamp_ns) if self._vehicle.known_at(stamp_ns) else np.zeros(3)

    def _prior(self, stamp_ns: int) -> VerticalPrior:
        settings = self.settings
        tilt = self._tilts.up_at(stamp_ns, settings.tilt_age_s)
        if tilt is not None:
            return VerticalPrior(*tilt, 0.0)
        search_deg = SEARCH_DEG[settings.camera_mount] if settings.search_deg is None else settings.search_deg
        sigma_deg = max(settings.vertical_sigma_deg, search_deg)
        return VerticalPrior(np.array([0.0, 0.0, 1.0]), math.radians(sigma_deg), math.radians(search_deg))

    def _limits(self) -> SearchLimits:
        settings = self.settings
        return SearchLimits(
            math.radians(settings.line_sigma_deg),
            math.radians(settings.least_sigma_deg),
            MIN_SCATTER,
            settings.max_frames,
            settings.min_lines,
            settings.min_score,
            settings.min_direction_score,
            settings.min_elsewhere_score,
            settings.confident_direction_score,
            settings.confident_elsewhere_score,
            math.radians(settings.weak_sigma_deg),
        )

    def _message(
        self, stamp_ns: int, found: FoundDirections, normal: Array64, ends: Array64, sigma_rad: Array64
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
            answers=found.answers,
        )
