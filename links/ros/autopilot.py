"""The autopilot's topics of a bag as MAVLink frames: those of mavros as they were received, others made of values.

ROS has x forward, y left, z up and a world of east, north, up; grd's frame odom has x north, y west.

Source: mavros_msgs/Mavlink, https://mavlink.io/en/guide/serialization.html; REP-103, REP-105, REP-145 (Imu).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flow.link import Record
from links.mavlink.made_frames import FrameMaker, Gnss
from links.mavlink.ned_frd import flip_yz, rpy_from_R_odom_drone, wxyz_from_R_odom_drone
from links.mavlink.transport.framing import V1
from links.ros.bag import BagMessage
from links.ros.mapping import AUTOPILOT, GNSS, IMU, MAVLINK, TopicUse
from links.ros.streams import stamp_ns
from stages.geometry.frames import rotation_from_quaternion_xyzw

R_odom_enu = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Frame odom has x north and y west: x = north, y = -east."""
_FRAMING_OK = 1


class AutopilotReader:
    """Records of /autopilot/rx. `skipped` counts damaged frames and values."""

    def __init__(self, skipped: Counter[str]) -> None:
        self._maker = FrameMaker(skipped=skipped)
        self._skipped = skipped

    def records(self, message: BagMessage, use: TopicUse) -> Iterator[Record]:
        """The frames of one message."""
        if message.type == MAVLINK:
            if message.value.framing_status != _FRAMING_OK:
                self._skipped[f"damaged frames on {message.topic}"] += 1
                return
            yield Record(AUTOPILOT, message.time_ns, message.time_ns, mavlink_frame(message.value))
        elif message.type == IMU:
            yield from self._imu(message, use)
        elif message.type == GNSS:
            yield from self._gnss(message, use)
        else:
            yield from self._odometry(message, use)

    def _imu(self, message: BagMessage, use: TopicUse) -> Iterator[Record]:
        value, at_ns = message.value, stamp_ns(message, use)
        rates = flip_yz(_vector(value.angular_velocity)).tolist()
        if value.linear_acceleration_covariance[0] != -1:  # REP-145: -1 is not measured
            acceleration = flip_yz(_vector(value.linear_acceleration)).tolist()
            yield from self._maker.imu(message.time_ns, at_ns, acceleration, rates)
        rotation = _rotation(value.orientation) if value.orientation_covariance[0] != -1 else None
        if rotation is not None:
            rpy_rad = rpy_from_R_odom_drone(R_odom_enu @ rotation)
            yield from self._maker.attitude(message.time_ns, at_ns, rpy_rad, rates)

    def _gnss(self, message: BagMessage, use: TopicUse) -> Iterator[Record]:
        value = message.value
        position = (value.latitude, value.longitude, value.altitude)
        known = value.status.status >= 0 and all(map(math.isfinite, position))
        fix = Gnss(3, *position) if known else Gnss(1, 0.0, 0.0, 0.0)
        yield from self._maker.gnss(message.time_ns, stamp_ns(message, use), fix)

    def _odometry(self, message: BagMessage, use: TopicUse) -> Iterator[Record]:
        pose, twist = message.value.pose.pose, message.value.twist.twist
        rotation = _rotation(pose.orientation)
        if rotation is None:
            self._skipped[f"poses without rotation on {message.topic}"] += 1
            return
        yield from self._maker.odometry(
            message.time_ns,
            stamp_ns(message, use),
            flip_yz(R_odom_enu @ _vector(pose.position)).tolist(),
            wxyz_from_R_odom_drone(R_odom_enu @ rotation),
            flip_yz(_vector(twist.linear)).tolist(),
            flip_yz(_vector(twist.angular)).tolist(),
        )


def mavlink_frame(value: Any) -> bytes:
    """The frame in a mavros_msgs/Mavlink, byte for byte."""
    length = int(value.len)
    payload = np.asarray(value.payload64, "<u8").tobytes()[:length].ljust(length, b"\0")
    checksum = int(value.checksum).to_bytes(2, "little")
    source = bytes([value.seq, value.sysid, value.compid])
    if value.magic == V1:
        return bytes([V1, length]) + source + bytes([value.msgid & 0xFF]) + payload + checksum
    head = bytes([value.magic, length, value.incompat_flags, value.compat_flags]) + source
    return head + int(value.msgid).to_bytes(3, "little") + payload + checksum + bytes(value.signature)


def _vector(value: Any) -> NDArray[np.float64]:
    return np.array([value.x, value.y, value.z])


def _rotation(q: Any) -> NDArray[np.float64] | None:
    """R_enu_drone; None: not a rotation."""
    if not abs(math.hypot(q.x, q.y, q.z, q.w) - 1.0) < 1e-3:
        return None
    return rotation_from_quaternion_xyzw((q.x, q.y, q.z, q.w))
