"""Dead reckoning of the drone's rotation in `map`, from image to image.

    R_map_drone(t) = R_map_drone(t0) R_drone(t0)_drone(t),  R_vehicle_drone = R_map_vehicle(t)^T R_map_drone(t)

The drone's turn is measured by its autopilot or its images, the vehicle's by VehicleMotion. The propagated yaw is the
angle between the level axes of the two cameras, up to a constant offset that the images determine (yaw_tracker.py).

While VehicleMotion is missing, the images put the vehicle's turn into that offset; the next VehicleMotion contains the
same turn again. So the variance of the largest possible turn is added both when the gap begins and when it ends. If the
map frame may have changed during the gap, the yaw is unknown.

Source: ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.align.refine import Refined
from stages.align.spectra import LevelLines
from stages.geometry.frames import Array64, heading_rad, rotation_z
from stages.geometry.trajectory import FURTHEST_NS, VehicleTrajectory
from stages.kernels.geometry.so3 import log_rotation
from stages.messages import DroneAttitude, DroneLocalPosition, DroneOdometry, VehicleMotion, VisualMotion
from stages.odometry.drone.trajectory import AutopilotTrajectory, VisualTrajectory, rotation_between

VEHICLE_RAD_PER_S = math.radians(20.0)  # turn rate of a vehicle without VehicleMotion
VEHICLE_DRIFT_RAD2_PER_S = math.radians(0.1) ** 2


@dataclass(frozen=True)
class DeadReckonedYaw:
    """Headings of the level axes of a pair of cameras by dead reckoning, in the map frame."""

    stamp_ns: int
    vehicle_rad: float  # heading of the level axes of the vehicle's camera
    drone_rad: float  # heading of the level axes of the drone's camera, less an unknown offset
    variance_rad2: float  # of yaw_rad, added since the previous pair

    @property
    def yaw_rad(self) -> float:
        """Yaw of the drone's level axes in the vehicle's, less the offset."""
        return self.drone_rad - self.vehicle_rad


class DeadReckoning:
    """Rotation of the drone in `map`, propagated by measured turns, without the offset that images add."""

    def __init__(self, parked: bool) -> None:
        """`parked`: the vehicle is known to be stationary, even without VehicleMotion."""
        self._parked = parked
        self.vehicle = VehicleTrajectory()
        self.autopilot = AutopilotTrajectory()
        self.images = VisualTrajectory()
        self._R_map_drone = np.eye(3)
        self._stamp_ns: int | None = None
        self._silences = 0
        self._silent_rad2 = 0.0  # `_vehicle_silent_rad2` at the previous pair; pi^2 after a change of frame
        self.frames = 0  # number of possible changes of the map frame

    def vehicle_known(self, stamp_ns: int) -> bool:
        """Whether the vehicle is parked, or its newest pose is recent enough to extrapolate."""
        return self._parked or self.vehicle.known_at(stamp_ns)

    def add_vehicle(self, motion: VehicleMotion) -> None:
        """Add a pose of the vehicle in `map`."""
        first = not self.vehicle.known
        if self.vehicle.add(motion) or first:
            self.frames += 1
            self._silent_rad2 = math.pi**2

    def add_autopilot(self, telemetry: DroneAttitude | DroneLocalPosition | DroneOdometry) -> None:
        """Add telemetry of the autopilot."""
        self.autopilot.add(telemetry)

    def add_drone_motion(self, motion: VisualMotion) -> None:
        """Add a step of the visual odometry."""
        self.images.add(motion)

    def new_silences(self) -> int:
        """Number of new telemetry gaps since the last call, each long enough to hide a jump of the autopilot's yaw."""
        new = self.autopilot.gaps - self._silences
        self._silences = self.autopilot.gaps
        return new

    def rate_radps(self, stamp_ns: int) -> float:
        """Turn rate of the drone [rad/s]."""
        return self.autopilot.rate_radps(stamp_ns)

    def advance(self, vehicle_ns: int, drone_ns: int, vehicle: LevelLines, drone: LevelLines) -> DeadReckonedYaw:
        """Propagate to the times of a pair of images."""
        R_map_vehicle = self.vehicle.at(vehicle_ns)[0]
        variance, silent_rad2 = 0.0, self._vehicle_silent_rad2(vehicle_ns)
        if self._stamp_ns is None:
            self._R_map_drone = R_map_vehicle @ vehicle.R_carrier_level @ drone.R_carrier_level.T
        else:
            dt = abs(drone_ns - self._stamp_ns) * 1e-9
            turn = rotation_between(self.autopilot, self.images, self._stamp_ns, drone_ns)
            self._R_map_drone = self._R_map_drone @ turn.R_from_to
            variance = turn.variance_rad2 + self._vehicle_variance_rad2(vehicle_ns, dt)
            variance += abs(silent_rad2 - self._silent_rad2)
        self._silent_rad2 = silent_rad2
        self._stamp_ns = drone_ns
        return DeadReckonedYaw(
            drone_ns,
            heading_rad(R_map_vehicle @ vehicle.R_carrier_level),
            heading_rad(self._R_map_drone @ drone.R_carrier_level),
            variance,
        )

    def correct(self, vehicle_ns: int, refined: Refined, dead_reckoned_rad: float) -> None:
        """Replace roll and pitch by those measured in the images; the yaw stays dead reckoned."""
        self._R_map_drone = self._measured_rotation(vehicle_ns, refined, dead_reckoned_rad)

    def tilt_off(self, vehicle_ns: int, refined: Refined, dead_reckoned_rad: float) -> Array64:
        """Difference (3,) [rad] of the tilts measured in the images from the dead reckoned ones, drone axes."""
        R = self._measured_rotation(vehicle_ns, refined, dead_reckoned_rad)
        off, up = log_rotation(np.ascontiguousarray(self._R_map_drone.T @ R)), R[2]
        return off - (off @ up) * up

    def _measured_rotation(self, vehicle_ns: int, refined: Refined, dead_reckoned_rad: float) -> Array64:
        level = refined.R_vehicle_level @ rotation_z(dead_reckoned_rad) @ refined.R_drone_level.T
        return self.vehicle.at(vehicle_ns)[0] @ level

    def R_map_odom(self, offset_rad: float) -> Array64 | None:
        """Rotation (3, 3) of the autopilot's frame `odom` in `map`; None: the autopilot has no attitude now."""
        if self._stamp_ns is None:
            return None
        R_odom_drone = self.autopilot.R_odom_drone(self._stamp_ns)
        return None if R_odom_drone is None else rotation_z(offset_rad) @ self._R_map_drone @ R_odom_drone.T

    def R_map_drone(self, offset_rad: float, stamps_ns: list[int]) -> dict[int, Array64]:
        """Rotation of the drone at each time for which its turn is measured."""
        if self._stamp_ns is None:
            return {}
        R = rotation_z(offset_rad) @ self._R_map_drone
        turns = {ns: rotation_between(self.autopilot, self.images, self._stamp_ns, ns) for ns in stamps_ns}
        return {ns: R @ turn.R_from_to for ns, turn in turns.items() if turn.measured}

    def at_common_time(self, vehicle_ns: int, drone_ns: int) -> tuple[Array64, Array64, int, float]:
        """Rotations L and R, the common time [ns] and the variance [rad^2] that moving to it adds.

        L R_vehicle(vehicle_ns)_drone(drone_ns) R is R_vehicle_drone at the common time.

        The time is the drone image's if the vehicle's turn is known, else the vehicle image's if the drone's turn is.
        """
        dt, one = abs(drone_ns - vehicle_ns) * 1e-9, np.eye(3)
        if self.vehicle.known_at(drone_ns):
            turn = self.vehicle.at(drone_ns)[0].T @ self.vehicle.at(vehicle_ns)[0]
            return turn, one, drone_ns, VEHICLE_DRIFT_RAD2_PER_S * dt
        own = rotation_between(self.autopilot, self.images, drone_ns, vehicle_ns)
        if own.measured and not self._parked:
            return one, own.R_from_to, vehicle_ns, own.variance_rad2
        return one, one, drone_ns, self._vehicle_variance_rad2(drone_ns, dt)

    def _vehicle_variance_rad2(self, stamp_ns: int, seconds: float) -> float:
        """Variance [rad^2] by which the vehicle's yaw drifts in the `seconds` before `stamp_ns`."""
        if self.vehicle.known_at(stamp_ns):
            return VEHICLE_DRIFT_RAD2_PER_S * seconds
        return 0.0 if self._parked else (VEHICLE_RAD_PER_S * seconds) ** 2

    def _vehicle_silent_rad2(self, stamp_ns: int) -> float:
        """Variance [rad^2] of the vehicle's heading, extrapolated beyond the end of its trajectory."""
        newest_ns = self.vehicle.newest_ns
        beyond_ns = 0 if newest_ns is None or self._parked else stamp_ns - newest_ns - FURTHEST_NS
        return (
            0.0
            if beyond_ns <= 0
            else max(self.vehicle.extrapolation_sigma(stamp_ns)[1], VEHICLE_RAD_PER_S * beyond_ns * 1e-9) ** 2
        )
