"""Telemetry of the autopilot that is independent of poses of grd; the only stage that reads its estimate.

    DroneLocalPosition, DroneOdometry, DroneAttitude   passed on while `independent`, else dropped
    DroneTilt                                          always: roll and pitch of DroneAttitude, never its yaw

Position, velocity and yaw of an autopilot that fuses poses of grd are those poses: used as odometry, they confirm any
error of grd, and the loop diverges. Roll and pitch come from its accelerometer; their sigma is larger then, because an
acceleration that it derives from a wrong pose tilts them. Its angular rate contains the gyro bias that it estimates;
then the rate of a raw IMU sample replaces it.

Source: ours; issue "A real autopilot flies on it".
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, ClassVar

from pydantic import Field

from flow.stage import Settings, Stage
from stages.messages import DroneAttitude, DroneImu, DroneLocalPosition, DroneOdometry, DroneTilt

RATE_NS = 100_000_000  # largest age of an IMU sample against the attitude


class IndependentTelemetrySettings(Settings):
    """Settings of `IndependentTelemetry`."""

    tilt_sigma_deg: float = Field(1.0, gt=0, le=30)  # of roll and pitch
    tilt_sigma_dependent_deg: float = Field(2.0, gt=0, le=30)  # of an autopilot that may fuse poses of grd


class IndependentTelemetry(Stage[IndependentTelemetrySettings]):
    """Passes the autopilot's estimate on while it is independent, and its roll and pitch always."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"attitude", "position", "odometry", "imu"})

    def __init__(self, settings: IndependentTelemetrySettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._imu: DroneImu | None = None
        self._dropped: int = 0

    @property
    def counters(self) -> dict[str, int]:
        """Estimates that were dropped."""
        return {"not independent": self._dropped} if self._dropped else {}

    def on_imu(self, imu: DroneImu) -> None:
        """Raw IMU sample."""
        self._imu = imu

    def on_attitude(self, attitude: DroneAttitude) -> Iterator[DroneAttitude | DroneTilt]:
        """Attitude; its roll and pitch are always used."""
        rate, sigma_deg = attitude.angular_velocity_drone_radps, self.settings.tilt_sigma_deg
        if not attitude.independent:
            imu, sigma_deg = self._imu, self.settings.tilt_sigma_dependent_deg
            near = imu is not None and abs(imu.stamp_ns - attitude.stamp_ns) <= RATE_NS
            rate = imu.angular_velocity_drone_radps if imu is not None and near else None
        yield DroneTilt(
            stamp_ns=attitude.stamp_ns,
            up_drone=attitude.R_odom_drone[2].copy(),  # the third row is the vertical in drone axes
            sigma_rad=math.radians(sigma_deg),
            angular_velocity_drone_radps=rate,
        )
        if attitude.independent:
            yield attitude
        else:
            self._dropped += 1

    def on_position(self, position: DroneLocalPosition) -> DroneLocalPosition | None:
        """Local position and velocity."""
        self._dropped += not position.independent
        return position if position.independent else None

    def on_odometry(self, odometry: DroneOdometry) -> DroneOdometry | None:
        """Pose and velocities."""
        self._dropped += not odometry.independent
        return odometry if odometry.independent else None
