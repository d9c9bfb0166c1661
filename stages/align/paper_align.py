"""Rotation of the drone relative to the vehicle by the method of the paper, with its correction by motion.

    vehicle's and drone's directions, nearest in time -> smallest-angle matching -> V_G V_D^-1 (paper_match.py)
        -> Kalman filter with a slow angular rate (paper_filter.py)
    fixes, drone motion, vehicle motion -> R_f, once the last seven agree (paper_correction.py)

The first match uses `initial_yaw_deg`. A wrong value selects a wrong branch, and every later match stays on it until
the drone has moved far enough to be corrected. The next images are matched under the corrected rotation
R_G^-1 R_f R_G R_GD0. If that gives the same pairs, the filter continues; if it gives others, the branch was wrong and
the filter restarts with them (`switches` counts it). So the error of a correction, some degrees of a 5-point
direction, never reaches the rotation.

Before any correction only the initial yaw is known, which the paper trusts: each branch has 1/4 and the state is
AMBIGUOUS. After a correction the state is RESOLVED, as in the paper; the other three branches share the measured error
rate of the paper's rule, up to 3.3 % (`wrong_share`). A one-hot probability would be overconfident: seven pairs with a
spacing of 14 images share most of their images and are not independent. An application that needs P > 0.999 must not
use this stage.

A match is accepted at any angle, as in the paper. With a gate the filter would continue at its last rate during
rejections, until the next branch fits.

Without the optional inputs the state stays AMBIGUOUS; without `motion` the vehicle is assumed stationary.

Source: P IV, Eq. 7-10, V.C-V.E; DESIGN, The paper's formulas and What we already measured (3.3 %).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from flow.stage import Settings, Stage
from stages.align.pairing import Pairing, of_mount
from stages.align.paper_correction import CorrectionRule, MotionCorrection
from stages.align.paper_filter import RotationFilter
from stages.align.paper_match import angle_between_rad, match
from stages.geometry.frames import Array64, rotation_z
from stages.messages import (
    BranchState,
    CameraMount,
    DroneFix,
    RelativeRotation,
    VanishingDirections,
    VehicleMotion,
    VisualMotion,
)

OTHER_BRANCH_RAD = math.radians(45.0)


class PaperAlignSettings(Settings):
    """Settings of `PaperAlign`."""

    initial_yaw_deg: float = Field(0.0, ge=-360, le=360)  # initial yaw of the drone in the vehicle frame
    initial_sigma_deg: float = Field(30.0, gt=0)
    max_apart_s: float = Field(0.1, gt=0, le=1)  # between the images of a pair; half the slower camera's period
    observation_deg: float = Field(1.0, gt=0)  # V_G V_D^-1, one axis
    rate_sigma_dps: float = Field(10.0, gt=0)  # the drone's rate against the vehicle, at the start
    rate_noise_dps: float = Field(5.0, gt=0)  # its change within one second
    images_apart: int = Field(14, ge=1)  # j - i
    shortest_m: float = Field(1.0, gt=0)  # |f|
    last: int = Field(7, ge=1)
    cone_deg: float = Field(30.0, gt=0, lt=90)
    wrong_share: float = Field(0.033, ge=0, lt=0.75)  # share of corrections that result in a wrong branch


class PaperAlign(Stage[PaperAlignSettings]):
    """P IV and V.C-V.E: smallest-angle matching, EKF, and correction of the branch by the drone's motion."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"fix", "visual_motion", "motion"})

    def __init__(self, settings: PaperAlignSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._observed: bool = False
        self._corrected: bool = False
        self._switches: int = 0
        settings = self.settings
        self._pairing = Pairing(round(settings.max_apart_s * 1e9))
        rule = CorrectionRule(
            settings.images_apart, settings.shortest_m, settings.last, math.radians(settings.cone_deg)
        )
        self._correction = MotionCorrection(rule)
        self._filter = RotationFilter(
            rotation_z(math.radians(settings.initial_yaw_deg)),
            math.radians(settings.initial_sigma_deg),
            math.radians(settings.rate_sigma_dps),
            math.radians(settings.rate_noise_dps),
        )

    def on_fix(self, fix: DroneFix) -> None:
        """t_GD."""
        self._correction.add_fix(fix)

    def on_visual_motion(self, motion: VisualMotion) -> None:
        """Direction of the drone's motion between two of its images: dt_DD(i, j), or one step of it."""
        self._correction.add_motion(motion)

    def on_motion(self, motion: VehicleMotion) -> None:
        """Pose R_G, t_G of the vehicle in `map`."""
        self._correction.add_vehicle(motion)

    def on_vehicle(self, directions: VanishingDirections) -> Iterator[RelativeRotation]:
        """V_G."""
        for pair in self._pairing.vehicle(of_mount(directions, CameraMount.VEHICLE, "vehicle")):
            yield self._align(*pair)

    def on_drone(self, directions: VanishingDirections) -> Iterator[RelativeRotation]:
        """Directions V_D. Yields one rotation for each drone image, once the nearest vehicle image is known."""
        for pair in self._pairing.drone(of_mount(directions, CameraMount.DRONE, "drone")):
            yield self._align(*pair)

    def finish(self) -> Iterator[RelativeRotation]:
        """Publish the rotations of drone images that still wait for a nearer vehicle image."""
        for pair in self._pairing.rest():
            yield self._align(*pair)

    def _align(self, vehicle: VanishingDirections | None, drone: VanishingDirections) -> RelativeRotation:
        """Message of one drone image and the nearest vehicle image."""
        now_ns, estimate = drone.stamp_ns, self._filter
        estimate.predict(now_ns)
        why = self._missing_reason(vehicle, drone)
        if vehicle is None or why:
            self._correction.add_image(now_ns, estimate.rotation if self._observed else None)
            return self._message(now_ns, None, why)
        reason = self._observe(vehicle.direction, drone.direction, now_ns)
        self._observed = True
        self._correction.add_image(now_ns, estimate.rotation)
        return self._message(now_ns, estimate.rotation, reason)

    def _missing_reason(self, vehicle: VanishingDirections | None, drone: VanishingDirections) -> str:
        """Why the pair cannot be matched; empty if it can."""
        if vehicle is None:
            return f"no image of the vehicle camera within {self.settings.max_apart_s:g} s of the drone image"
        return "; ".join(
            f"{one.camera_mount.value}: {one.reason}" for one in (vehicle, drone) if len(one.direction) < 2
        )

    def _observe(self, vehicle: Array64, drone: Array64, now_ns: int) -> str:
        """Match, correct the branch by motion, update the filter. Returns the reason text of the message."""
        estimate, sigma_rad = self._filter, math.radians(self.settings.observation_deg)
        found = match(vehicle, drone, estimate.rotation)
        turn_rad = self._correction.turn_rad()
        if turn_rad is not None:
            R_G = self._correction.trail.at(now_ns)[0]
            corrected = match(vehicle, drone, R_G.T @ rotation_z(turn_rad) @ R_G @ estimate.rotation)
            self._corrected = True
            if angle_between_rad(found.R_vehicle_drone, corrected.R_vehicle_drone) > OTHER_BRANCH_RAD:
                estimate.restart(corrected.R_vehicle_drone, sigma_rad)
                self._correction.restart()
                self._switches += 1
                return f"branch corrected by motion: {math.degrees(turn_rad):.0f} deg about the vertical"
        estimate.observe(found.R_vehicle_drone, sigma_rad)
        return f"matched within {math.degrees(found.angle_rad):.1f} deg" + (
            ", confirmed by motion" if turn_rad is not None else ""
        )

    def _message(self, stamp_ns: int, R: Array64 | None, reason: str) -> RelativeRotation:
        if R is None:
            return RelativeRotation.none(stamp_ns, reason, self._switches)
        probability = np.full(4, 0.25)
        if self._corrected:
            probability = np.array([1.0 - self.settings.wrong_share] + [self.settings.wrong_share / 3] * 3)
        state = BranchState.RESOLVED if self._corrected else BranchState.AMBIGUOUS
        covariance = self._filter.covariance[:3, :3].copy()
        return RelativeRotation.one(stamp_ns, R.copy(), covariance, probability, state, self._switches, reason)
