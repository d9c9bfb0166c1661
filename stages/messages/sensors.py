"""Measurements of the vehicle's sensors, vehicle motion, and the goal of the servo."""

from __future__ import annotations

import enum
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flow.message import Mat3, Mat6, Message, PerPointF32, PerPointI64, PerPointU8, Points32, Shape, Vec3, message


@message(schema=11)
class LidarFirings(Message):
    """All laser pulses of one or several consecutive LiDAR packets, including those without a return (range_m = 0).

    Frame: lidar.
    """

    pulse_stamp_ns: PerPointI64  # firing time of each pulse
    laser: PerPointU8  # number in the packet's channel order
    azimuth_rad: PerPointF32  # 0 along +y_lidar, clockwise seen from +z_lidar, [0, 2 pi)
    range_m: PerPointF32  # 0: no return
    reflectivity: PerPointU8  # 0..255, calibrated by the sensor
    return_kind: PerPointU8  # 0 strongest (or only), 1 last; dual mode has both
    xyz_lidar_m: Points32  # (0, 0, 0) where there was no return
    lost_packets: int  # packets missing directly before
    laser_elevation_rad: Annotated[
        NDArray[np.float64], Shape("lasers")
    ]  # elevation of each laser above the plane z_lidar = 0


@message(schema=12)
class Image(Message):
    """One grayscale camera frame; stamp_ns is the middle of its middle row's exposure. Lens: the rig's."""

    frame_id: str  # camera_vehicle or camera_drone
    grey: Annotated[NDArray[np.uint8], Shape("h", "w")]
    readout_s: float = 0.0  # from the first row's exposure to the last's (rolling shutter); 0: all at once

    def rows_after_s(self) -> float:
        """Delay [s] of the exposure of one row after the row above it."""
        return self.readout_s / max(self.grey.shape[0] - 1, 1)


@message(schema=13)
class ServoState(Message):
    """State reported by the turntable's servo; stamp_ns is the middle of request and reply."""

    position_rad: float
    velocity_radps: float
    goal_rad: float
    error: int  # the servo's error bits; 0: no error


@message(schema=14)
class ServoOffset(Message):
    """Estimate of the time offset between servo and LiDAR stamps; stamp_ns is the newest packet's."""

    offset_s: float | None  # estimated `servo_time_offset_s` (positive: servo stamps are early); None: not known yet
    sigma_s: float | None  # one sigma
    rig_offset_s: float  # `servo_time_offset_s` of the rig
    windows: int  # windows that gave an estimate so far
    reason: str  # result of the newest window, or why it has none


@message(schema=15)
class ServoGoal(Message):
    """Goal of the turntable's servo; stamp_ns is that of the servo state it was derived from."""

    position_rad: float
    speed_radps: float  # upper limit; the motor may be slower


class MotionStatus(enum.Enum):
    """Whether a pose of the vehicle may be used."""

    ACCEPTED = 0
    DENIED = 1  # the source contradicts physics or the LiDAR: its poses after this one are withdrawn


@message(schema=18)
class VehicleMotion(Message):
    """T_map_vehicle by odometry: smooth, drifting."""

    xyz_map_m: Vec3
    R_map_vehicle: Mat3
    covariance: Mat6 | None  # rotation [rad] before translation [m]; None: not reported
    status: MotionStatus = MotionStatus.ACCEPTED


@message(schema=17)
class Tick(Message):
    """Periodic clock tick of the host, in live runs, so that time advances without sensor data. stamp_ns is now."""
