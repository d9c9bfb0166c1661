"""What the vehicle's sensors measured, and what its servo is told."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flow.message import Mat3, Mat6, Message, PerPointF32, PerPointI64, PerPointU8, Points32, Shape, Vec3, message


@message(schema=11)
class LidarFirings(Message):
    """One decoded LiDAR packet, or a few in a row, every laser pulse: also those that saw nothing (range_m = 0).

    Frame: lidar.
    """

    pulse_stamp_ns: PerPointI64  # when each laser fired
    laser: PerPointU8  # 0..15, the packet's channel order
    azimuth_rad: PerPointF32  # 0 along +y_lidar, clockwise seen from +z_lidar, [0, 2 pi)
    range_m: PerPointF32  # 0: no return
    reflectivity: PerPointU8  # 0..255, calibrated by the sensor
    return_kind: PerPointU8  # 0 strongest (or only), 1 last; dual mode has both
    xyz_lidar_m: Points32  # (0, 0, 0) where there was no return
    lost_packets: int  # packets missing just before
    laser_elevation_rad: Annotated[NDArray[np.float64], Shape("lasers")]  # where each laser points, over z_lidar = 0


@message(schema=12)
class Image(Message):
    """One camera frame in grey; stamp_ns is the middle of its middle row's exposure. Lens: the rig's."""

    frame_id: str  # which camera: camera_vehicle, camera_drone
    grey: Annotated[NDArray[np.uint8], Shape("h", "w")]
    readout_s: float = 0.0  # from the first row's exposure to the last's (rolling shutter); 0: all at once

    def rows_after_s(self) -> float:
        """How much later than the row above it a row is exposed."""
        return self.readout_s / max(self.grey.shape[0] - 1, 1)


@message(schema=13)
class ServoState(Message):
    """The turntable's servo as it answered; stamp_ns is mid-exchange."""

    position_rad: float
    velocity_radps: float
    goal_rad: float
    error: int  # the servo's own error bits, 0 is healthy


@message(schema=14)
class ServoOffset(Message):
    """How early the servo's stamps are against the LiDAR's, as what was seen tells; stamp_ns is the newest packet's."""

    offset_s: float | None  # the rig's `servo_time_offset_s` as it should be; None: not known yet
    sigma_s: float | None  # one sigma
    rig_s: float  # what the rig says
    windows: int  # that have told so far
    reason: str  # what the newest window said, or why it said nothing


@message(schema=15)
class ServoGoal(Message):
    """Where the turntable's servo shall go; stamp_ns is that of the servo state it was decided on."""

    position_rad: float
    speed_radps: float  # at most; the servo keeps to what its motor can do


@message(schema=16)
class VehicleMotion(Message):
    """Where the vehicle has driven since it started: T_map_vehicle, smooth and drifting, by its own odometry."""

    xyz_map_m: Vec3
    R_map_vehicle: Mat3
    covariance: Mat6 | None  # rotation [rad] before translation [m]; None: the source does not say


@message(schema=17)
class Tick(Message):
    """The host's clock, live: time goes on though every sensor is silent. stamp_ns is now."""
