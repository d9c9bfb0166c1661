"""Rotation of the drone relative to the vehicle, from the lines of both cameras.

    pairs of images (pairing.py) -> yaw spectra and their matches (spectra.py) -> the match that continues the last
    ones (dead_reckoning.py, yaw_tracker.py) -> all angles refined together (refine.py), fused with the prediction
    (innovation_gate.py) -> yaw branch by the drone's motion (motion_branch.py) -> message (publisher.py)

Each image of the drone gives a rotation, or the reason why there is none. Its state is RESOLVED when the probability of
one yaw branch reaches `resolve_probability`. The probabilities of the four branches sum to less than 1; the remainder
is the probability that none is right. Only the drone's motion, alone or with a prior, resolves a branch. The state is
no longer RESOLVED when dead reckoning is lost or motion contradicts the branch.

Where streets have many directions, lines alone seldom decide which of them both cameras see. The drone's displacement,
measured by LiDAR and by the autopilot, gives a heading without lines: it selects the match, and rejects a wrong one.

Without the input `motion` the vehicle is assumed stationary if `parked` is set; else the drone's motion is not used.

Source: ours, for P IV Eq. 7-10 and V.E; DESIGN, Vision and Yaw branch.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

from pydantic import Field, model_validator

from flow.stage import Settings, Stage
from stages.align.dead_reckoning import DeadReckoning
from stages.align.innovation_gate import InnovationGate
from stages.align.motion_branch import MotionBranch, Prior
from stages.align.pairing import Pair, Pairing
from stages.align.publisher import Publisher
from stages.align.refine import Tolerances, refine, street_directions
from stages.align.spectra import level_lines, spectrum
from stages.align.yaw_tracker import YawTracker
from stages.heading.hypothesis_bank import BranchSettings
from stages.messages import (
    CameraMount,
    DroneAttitude,
    DroneFix,
    DroneLocalPosition,
    DroneOdometry,
    RelativeRotation,
    VanishingDirections,
    VehicleMotion,
    VisualMotion,
)


@dataclass
class _Parts:
    """Parts of the stage, each with its own state."""

    pairing: Pairing
    dead_reckoning: DeadReckoning
    tracker: YawTracker
    motion: MotionBranch
    innovation_gate: InnovationGate
    publisher: Publisher


class JointAlignSettings(Settings):
    """Settings of `JointAlign`."""

    max_apart_s: float = Field(0.1, gt=0, le=1)  # between the images of a pair; half the slower camera's period
    straight_deg: float = Field(0.25, gt=0, le=5)  # deviation of a line from its street's direction, one sigma
    direction_sigma_deg: float = Field(0.1, gt=0, le=5)  # error of a street's direction that one camera's lines share
    square_sigma_deg: float = Field(0.5, gt=0, le=5)  # deviation of crossings from a right angle, one sigma
    tilt_sigma_deg: float = Field(0.07, ge=0, le=5)  # error of a vertical beyond its sigma, common to
    # all images: 0.05 deg of a mount, and as much by a lens whose centre is 0.15 px off at 720 px
    min_lines: int = Field(5, ge=1)  # of each camera
    parked: bool = False  # the vehicle is stationary: the drone's motion is used without VehicleMotion
    resolve_probability: float = Field(0.999, gt=0.5, lt=1)
    initial_yaw_deg: float | None = Field(None, ge=-360, le=360)  # initial yaw of the drone in the vehicle frame
    compass_deg: float | None = Field(None, ge=-360, le=360)  # initial heading of the vehicle, clockwise from north
    prior_sigma_deg: float = Field(20.0, gt=0, le=90)  # of initial_yaw_deg or compass_deg
    prior_trust: float = Field(0.95, gt=0, lt=1)  # probability that it is valid; alone it never resolves a branch
    branches: BranchSettings = BranchSettings()

    @model_validator(mode="after")
    def _settings_agree(self) -> JointAlignSettings:
        if self.initial_yaw_deg is not None and self.compass_deg is not None:
            raise ValueError("give initial_yaw_deg or compass_deg, not both")
        return self


class JointAlign(Stage[JointAlignSettings]):
    """Joint alignment of the lines of both cameras, with the probabilities of the four yaw branches."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset(
        {"motion", "visual_motion", "attitude", "position", "odometry", "fix"}
    )

    def __init__(self, settings: JointAlignSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        settings = self.settings
        dead_reckoning, tracker = DeadReckoning(settings.parked), YawTracker()
        motion = MotionBranch(settings.branches, self._prior(), dead_reckoning, tracker)
        self._parts = _Parts(
            Pairing(round(1e9 * settings.max_apart_s)),
            dead_reckoning,
            tracker,
            motion,
            InnovationGate(dead_reckoning, tracker),
            Publisher(motion.bank, dead_reckoning, settings.resolve_probability),
        )

    def on_motion(self, motion: VehicleMotion) -> None:
        """Pose of the vehicle."""
        self._parts.dead_reckoning.add_vehicle(motion)

    def on_attitude(self, attitude: DroneAttitude) -> None:
        """Attitude by the autopilot, in frame odom."""
        self._parts.dead_reckoning.add_autopilot(attitude)

    def on_position(self, position: DroneLocalPosition) -> None:
        """Position by the autopilot, in frame odom."""
        self._parts.dead_reckoning.add_autopilot(position)

    def on_odometry(self, odometry: DroneOdometry) -> None:
        """Pose by the autopilot, in frame odom."""
        self._parts.dead_reckoning.add_autopilot(odometry)

    def on_visual_motion(self, motion: VisualMotion) -> None:
        """Visual odometry of the drone: turn and direction."""
        self._parts.dead_reckoning.add_drone_motion(motion)
        self._parts.motion.add_visual_motion(motion)

    def on_fix(self, fix: DroneFix) -> None:
        """LiDAR position: evidence for the branch once the drone has moved."""
        if self._parts.motion.add_fix(fix):
            self._reinitialise("the drone's motion fits no branch: reset")

    def on_vehicle(self, seen: VanishingDirections) -> Iterator[RelativeRotation]:
        """Lines of the vehicle's camera."""
        for pair in self._parts.pairing.vehicle(_of(seen, CameraMount.VEHICLE, "vehicle")):
            yield self._align(pair)

    def on_drone(self, seen: VanishingDirections) -> Iterator[RelativeRotation]:
        """Lines of the drone's camera: one rotation for each image, once the nearest image of the vehicle is known."""
        for pair in self._parts.pairing.drone(_of(seen, CameraMount.DRONE, "drone")):
            yield self._align(pair)

    def finish(self) -> Iterator[RelativeRotation]:
        """Publish the rotations of drone images that still wait for a nearer vehicle image."""
        for pair in self._parts.pairing.rest():
            yield self._align(pair)

    def _align(self, pair: Pair) -> RelativeRotation:
        """The rotation of a pair of images."""
        settings = self.settings
        parts = self._parts
        seen_by_vehicle, seen_by_drone = pair
        drone_ns = seen_by_drone.stamp_ns
        if seen_by_vehicle is None:
            return parts.publisher.none(drone_ns, f"no image of the vehicle camera within {settings.max_apart_s:g} s")
        vehicle_ns = seen_by_vehicle.stamp_ns
        straight_rad = math.radians(settings.straight_deg)
        vehicle, drone = level_lines(seen_by_vehicle, straight_rad), level_lines(seen_by_drone, straight_rad)
        if vehicle is None or drone is None or min(len(vehicle.weight), len(drone.weight)) < settings.min_lines:
            both = ((seen_by_vehicle, vehicle), (seen_by_drone, drone))
            few = (seen for seen, lines in both if lines is None or len(lines.weight) < settings.min_lines)
            return parts.publisher.none(
                drone_ns,
                "; ".join(f"{seen.camera_mount.value}: {seen.reason or 'too few level lines'}" for seen in few),
            )
        a, b = spectrum(vehicle), spectrum(drone)
        dead_reckoned = parts.dead_reckoning.advance(vehicle_ns, drone_ns, vehicle, drone)
        motion_heading = parts.motion.heading(drone_ns)
        if parts.tracker.is_contradicted(motion_heading):
            parts.tracker.release()
            self._reinitialise("the drone's motion contradicts the match: reset")
        match = parts.tracker.choose(a, b, dead_reckoned, parts.dead_reckoning.rate_radps(drone_ns), motion_heading)
        if match.yaw_rad is None:
            return parts.publisher.none(drone_ns, match.reason)
        streets = street_directions(a, b, match.yaw_rad)
        refined = refine(vehicle, drone, streets, match.yaw_rad, self._tolerances())
        if refined.directions == 0 or min(refined.vehicle_lines, refined.drone_lines) < settings.min_lines:
            return parts.publisher.none(drone_ns, "too few lines run along the same streets")
        if parts.tracker.reacquired:
            self._reinitialise("the lines match at another yaw for some time: reset there")
        off_rad = parts.innovation_gate.tilt_innovation_rad(vehicle_ns, refined, dead_reckoned)
        refined = parts.innovation_gate.with_scatter(refined, dead_reckoned)
        weighed = parts.innovation_gate.weigh_yaw(refined, dead_reckoned)
        parts.motion.slip(parts.tracker.accept(refined.yaw_rad, refined.yaw_sigma_rad, dead_reckoned))
        parts.motion.weigh_prior(refined)
        return parts.publisher.rotation(vehicle_ns, drone_ns, weighed, dead_reckoned, off_rad)

    def _reinitialise(self, news: str) -> None:
        self._parts.publisher.add_news(news)
        self._parts.motion.reset()

    def _prior(self) -> Prior:
        settings = self.settings
        initial, compass = (
            None if d is None else math.radians(d) for d in (settings.initial_yaw_deg, settings.compass_deg)
        )
        return Prior(initial, compass, math.radians(settings.prior_sigma_deg), settings.prior_trust)

    def _tolerances(self) -> Tolerances:
        settings = self.settings
        return Tolerances(
            straight_rad=math.radians(settings.straight_deg),
            direction_rad=math.radians(settings.direction_sigma_deg),
            square_rad=math.radians(settings.square_sigma_deg),
            tilt_rad=math.radians(settings.tilt_sigma_deg),
        )


def _of(seen: VanishingDirections, camera_mount: CameraMount, port: str) -> VanishingDirections:
    if seen.camera_mount is not camera_mount:
        raise ValueError(f"input {port!r} got the directions of the {seen.camera_mount.value}: wire the other camera")
    return seen
