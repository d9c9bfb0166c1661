"""Rotation of the drone relative to the vehicle, from the lines of both cameras.

    pairs of images (pairing.py) -> yaw spectra and their matches, each with a probability (spectra.py)
      -> yaw and streets refined together, for each match (refine.py) -> message

Each image of the drone gives the rotations that the lines of one pair allow, or the reason why there is none. No match
is chosen here, and no branch of 90 deg: the heading (stages/heading) weighs all of them by the drone's motion. Where an
image has several answers with different verticals, each is matched; the gyro and gravity of the heading select one.

Between the two images of a pair the vehicle turns as its odometry says; without it, as fast as a vehicle may.

Source: ours, for P IV Eq. 7-10; DESIGN, Vision.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from flow.stage import Settings, Stage
from stages.align.pairing import Pair, Pairing, of_mount
from stages.align.refine import Refined, Tolerances, refine, street_directions
from stages.align.spectra import LevelLines, match_probabilities, overlap, peaks, spectrum, weighted_lines
from stages.geometry.frames import Array64
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import BranchState, CameraMount, RelativeRotation, VanishingDirections, VehicleMotion

MIN_SEPARATION_RAD = math.radians(4.0)  # matches nearer to each other are the same
LEAST_PROBABILITY = 0.05  # a less probable match is not published: it counts as none
VEHICLE_RAD_PER_S = math.radians(20.0)  # turn rate of a vehicle without VehicleMotion, one sigma
VEHICLE_DRIFT_RAD2_PER_S = math.radians(0.1) ** 2  # of VehicleMotion


class JointAlignSettings(Settings):
    """Settings of `JointAlign`."""

    max_apart_s: float = Field(0.1, gt=0, le=1)  # between the images of a pair; half the slower camera's period
    straight_deg: float = Field(0.25, gt=0, le=5)  # deviation of a line from its street's direction, one sigma
    direction_sigma_deg: float = Field(0.1, gt=0, le=5)  # error of a street's direction that one camera's lines share
    square_sigma_deg: float = Field(0.5, gt=0, le=5)  # deviation of crossings from a right angle, one sigma
    tilt_sigma_deg: float = Field(0.2, ge=0, le=5)  # error of a vertical beyond its sigma, common to all
    # images: 0.07 deg by mount and lens in simulation; 0.2 to 0.3 deg in renders of real panoramas, walls out of plumb
    min_lines: int = Field(5, ge=1)  # of each camera


class JointAlign(Stage[JointAlignSettings]):
    """Joint alignment of the lines of both cameras."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"motion"})

    def __init__(self, settings: JointAlignSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        settings = self.settings
        self._pairing = Pairing(round(1e9 * settings.max_apart_s))
        self._vehicle = VehicleTrajectory()
        self._tolerances = Tolerances(
            straight_rad=math.radians(settings.straight_deg),
            direction_rad=math.radians(settings.direction_sigma_deg),
            square_rad=math.radians(settings.square_sigma_deg),
            tilt_rad=math.radians(settings.tilt_sigma_deg),
        )

    def on_motion(self, motion: VehicleMotion) -> None:
        """Pose of the vehicle."""
        self._vehicle.add(motion)

    def on_vehicle(self, seen: VanishingDirections) -> Iterator[RelativeRotation]:
        """Lines of the vehicle's camera."""
        yield from map(self._align, self._pairing.vehicle(of_mount(seen, CameraMount.VEHICLE, "vehicle")))

    def on_drone(self, seen: VanishingDirections) -> Iterator[RelativeRotation]:
        """Lines of the drone's camera: one message for each image, once the nearest image of the vehicle is known."""
        yield from map(self._align, self._pairing.drone(of_mount(seen, CameraMount.DRONE, "drone")))

    def finish(self) -> Iterator[RelativeRotation]:
        """Publish the rotations of drone images that still wait for a nearer vehicle image."""
        yield from map(self._align, self._pairing.rest())

    def _align(self, pair: Pair) -> RelativeRotation:
        """The rotations of a pair of images."""
        settings = self.settings
        seen_by_vehicle, seen_by_drone = pair
        drone_ns = seen_by_drone.stamp_ns
        if seen_by_vehicle is None:
            return RelativeRotation.none(drone_ns, f"no image of the vehicle camera within {settings.max_apart_s:g} s")
        straight_rad = self._tolerances.straight_rad
        vehicle, drone = (
            [(lines, p) for lines, p in weighted_lines(seen, straight_rad) if len(lines.weight) >= settings.min_lines]
            for seen in (seen_by_vehicle, seen_by_drone)
        )
        if not vehicle or not drone:
            both = ((seen_by_vehicle, vehicle), (seen_by_drone, drone))
            few = (seen for seen, answers in both if not answers)
            reason = "; ".join(f"{seen.camera_mount.value}: {seen.reason or 'too few level lines'}" for seen in few)
            return RelativeRotation.none(drone_ns, reason)
        found = [
            match
            for of_vehicle, p_vehicle in vehicle
            for of_drone, p_drone in drone
            for match in self._matches(of_vehicle, of_drone, p_vehicle * p_drone)
        ]
        if not found:
            return RelativeRotation.none(drone_ns, "too few lines of both cameras run along the same streets")
        return self._message(seen_by_vehicle.stamp_ns, drone_ns, sorted(found, key=lambda match: -match[1]))

    def _matches(self, vehicle: LevelLines, drone: LevelLines, answers: float) -> list[tuple[Refined, float]]:
        """The refined matches of two answers, whose joint probability is `answers`, with their probabilities."""
        a, b = spectrum(vehicle), spectrum(drone)
        tops = peaks(overlap(a, b), MIN_SEPARATION_RAD)
        found: list[tuple[Refined, float]] = []
        for top, probability in zip(tops, (answers * match_probabilities(tops)).tolist(), strict=True):
            if probability < LEAST_PROBABILITY:
                continue
            one = refine(vehicle, drone, street_directions(a, b, top.yaw_rad), top.yaw_rad, self._tolerances)
            if (
                one is not None
                and one.directions
                and min(one.vehicle_lines, one.drone_lines) >= self.settings.min_lines
            ):
                found.append((one, probability))
        return found

    def _message(self, vehicle_ns: int, drone_ns: int, found: list[tuple[Refined, float]]) -> RelativeRotation:
        turn, variance_rad2 = self._vehicle_turn(vehicle_ns, drone_ns)
        best, probability = found[0]
        lines = f"{best.directions} directions, {best.vehicle_lines} and {best.drone_lines} lines"
        others = "" if len(found) == 1 else f", {len(found)} matches"
        return RelativeRotation(
            stamp_ns=drone_ns,
            rotations=np.array([turn @ one.R_vehicle_drone(0) for one, _ in found]),
            covariances_rad2=np.array([one.covariance_rad2(0) + variance_rad2 * np.eye(3) for one, _ in found]),
            probabilities=np.array([p for _, p in found]),
            branch_probability=np.full(4, probability / 4),
            state=BranchState.OPEN,
            switches=0,
            reason=f"{lines}: {probability:.0%}{others}",
        )

    def _vehicle_turn(self, from_ns: int, to_ns: int) -> tuple[Array64, float]:
        """Rotation (3, 3) of the vehicle's axes at one time into those at another, and the variance of each axis."""
        dt = abs(to_ns - from_ns) * 1e-9
        if self._vehicle.known_at(to_ns):
            return self._vehicle.at(to_ns)[0].T @ self._vehicle.at(from_ns)[0], VEHICLE_DRIFT_RAD2_PER_S * dt
        return np.eye(3), (VEHICLE_RAD_PER_S * dt) ** 2
