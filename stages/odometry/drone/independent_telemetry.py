"""Telemetry of the autopilot that is independent of poses of grd; the only stage that reads its estimate.

    DroneLocalPosition, DroneOdometry, DroneAttitude,
    DroneGlobalPosition                                passed on while `independent`, else dropped
    DroneTilt                                          always: roll and pitch of DroneAttitude, never its yaw
    HeadingPrior                                       for PRIOR_S after the newest pose before a restart

Position, velocity and yaw of an autopilot that fuses poses of grd are those poses: used as odometry, they confirm any
error of grd, and the loop diverges. Roll and pitch come from its accelerometer; their sigma is larger then, because an
acceleration that it derives from a wrong pose tilts them. Its angular rate contains the gyro bias that it estimates;
then the rate of a raw IMU sample replaces it.

After a restart of grd, or of stage `fuse`, in flight the yaw that was known before is propagated by the autopilot,
which then has its gyros and the compass or the poses sent before. The prior is a memory of grd's own pose, not a
measurement. It is wrong if frame odom has changed meanwhile, by another source set or a reset; a reboot ends it,
because the estimate is independent then. Its position drifts with the velocity's error, SPEED_SHARE of the speed, and
as an IMU does (DRIFT_MPS2).

Source: ours; DRIFT_MPS2 by a LiDAR gap of 5 s in simulation, bridged by the IMU alone: 1.4 m of error. SPEED_SHARE by
six simulated flights at 5 m/s whose source set has no velocity: 2 s after the end of grd the horizontal position is 0.5
to 1.2 m off (RMS 0.9; stated, both axes, 1.2), the velocity 0.3 to 0.7 m/s. Hovering, the position is 0.1 to 0.4 m off.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, ClassVar

from pydantic import Field

from flow.stage import Settings, Stage
from stages.geometry.frames import heading_rad, rotation_z
from stages.messages import (
    DroneAttitude,
    DroneGlobalPosition,
    DroneImu,
    DroneLocalPosition,
    DroneOdometry,
    DroneTilt,
    EarlierOdomFrame,
    HeadingPrior,
)

RATE_NS = 100_000_000  # largest age of an IMU sample against the attitude
PRIOR_S = 30.0  # since the newest pose of the earlier run
POSITION_NS = 200_000_000  # largest age of the autopilot's position against the attitude; it is extrapolated
DRIFT_RAD2_PER_S = math.radians(0.3) ** 2  # random walk of the autopilot's yaw
START_M = 0.5  # error of the autopilot's position when the earlier run ended (assumed)
SPEED_SHARE, DRIFT_MPS2 = 0.06, 0.11  # error of its velocity then, over its speed; growth of that error


class IndependentTelemetrySettings(Settings):
    """Settings of `IndependentTelemetry`."""

    tilt_sigma_deg: float = Field(1.0, gt=0, le=30)  # of roll and pitch
    tilt_sigma_dependent_deg: float = Field(2.0, gt=0, le=30)  # of an autopilot that may fuse poses of grd


class IndependentTelemetry(Stage[IndependentTelemetrySettings]):
    """Passes the autopilot's estimate on while it is independent, and its roll and pitch always."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset(
        {"attitude", "position", "odometry", "imu", "earlier", "global_position"}
    )

    def __init__(self, settings: IndependentTelemetrySettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._imu: DroneImu | None = None
        self._position: DroneLocalPosition | None = None
        self._earlier: EarlierOdomFrame | None = None
        self._dropped: int = 0

    @property
    def counters(self) -> dict[str, int]:
        """Estimates that were dropped."""
        return {"not independent": self._dropped} if self._dropped else {}

    def on_imu(self, imu: DroneImu) -> None:
        """Raw IMU sample."""
        self._imu = imu

    def on_earlier(self, earlier: EarlierOdomFrame) -> None:
        """State of an earlier run of grd."""
        self._earlier = earlier

    def on_attitude(self, attitude: DroneAttitude) -> Iterator[DroneAttitude | DroneTilt | HeadingPrior]:
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
            self._earlier = None  # it has booted
        else:
            self._dropped += 1
            prior = self._prior(attitude)
            if prior is not None:
                yield prior

    def _prior(self, attitude: DroneAttitude) -> HeadingPrior | None:
        """Yaw and position in `map` by the frame of the earlier run; None: no earlier run, or too long ago."""
        earlier, position = self._earlier, self._position
        if earlier is None or position is None:
            return None
        since_ns, age_s = attitude.stamp_ns - position.stamp_ns, (attitude.stamp_ns - earlier.stamp_ns) * 1e-9
        if not 0 < age_s < PRIOR_S or abs(since_ns) > POSITION_NS:
            return None
        xyz_odom_m = position.xyz_odom_m + 1e-9 * since_ns * position.velocity_odom_mps
        R_map_odom = rotation_z(earlier.yaw_map_odom_rad)
        start_mps = SPEED_SHARE * math.hypot(*position.velocity_odom_mps[:2])
        return HeadingPrior(
            stamp_ns=attitude.stamp_ns,
            yaw_map_rad=earlier.yaw_map_odom_rad + heading_rad(attitude.R_odom_drone),
            yaw_map_odom_rad=earlier.yaw_map_odom_rad,
            sigma_rad=math.sqrt(earlier.sigma_rad**2 + age_s * DRIFT_RAD2_PER_S),
            xyz_map_m=R_map_odom @ xyz_odom_m + earlier.xyz_map_m,
            position_sigma_m=math.hypot(START_M, start_mps * age_s, 0.5 * DRIFT_MPS2 * age_s**2),
            velocity_map_mps=R_map_odom @ position.velocity_odom_mps,
            velocity_sigma_mps=math.hypot(start_mps, DRIFT_MPS2 * age_s),
        )

    def on_position(self, position: DroneLocalPosition) -> DroneLocalPosition | None:
        """Local position and velocity."""
        self._position = position
        self._dropped += not position.independent
        return position if position.independent else None

    def on_odometry(self, odometry: DroneOdometry) -> DroneOdometry | None:
        """Pose and velocities."""
        self._dropped += not odometry.independent
        return odometry if odometry.independent else None

    def on_global_position(self, position: DroneGlobalPosition) -> DroneGlobalPosition | None:
        """Geographic position."""
        self._dropped += not position.independent
        return position if position.independent else None
