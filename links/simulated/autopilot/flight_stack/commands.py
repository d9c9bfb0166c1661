"""Frames from the host: poses for the EKF, TIMESYNC, parameters, commands with their ACK, and the global origin.

Source: https://mavlink.io/en/services/command.html, /parameter.html, /timesync.html; ArduPilot GCS_Common.cpp
(handle_command_*, handle_set_gps_global_origin).
"""

from __future__ import annotations

import struct
from typing import Any, Protocol

from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink.transport.framing import header, parse_frame
from links.simulated.autopilot.flight_stack.streams import ACCEPTED, DENIED, FAILED, UNSUPPORTED, Streams

mavlink: Any = ardupilotmega
SET_MESSAGE_INTERVAL, GET_MESSAGE_INTERVAL, REQUEST_MESSAGE = 511, 510, 512
SET_EKF_SOURCE_SET, REBOOT = 42007, 246
GPS_GLOBAL_ORIGIN, AUTOPILOT_VERSION = 49, 148
REAL32, INT32 = 9, 6  # MAV_PARAM_TYPE


class Vehicle(Protocol):
    """What commands act on."""

    own: tuple[int, int]
    px4: bool
    origin: tuple[int, int, int] | None
    parameters: dict[str, float]
    streams: Streams

    def send(self, message: Any) -> None:
        """Queue a message."""

    def take_pose(self, message: Any, device_ns: int) -> None:
        """Take a message that may be an external pose."""

    def use_sources(self, number: int) -> bool:
        """Make a source set (from 1) active; False: there is none."""
        ...

    def set_origin(self, origin: tuple[int, int, int]) -> bool:
        """Take a global origin; False: there is one."""
        ...

    def reboot(self) -> bool:
        """Reboot; False: rejected while armed."""
        ...


def handle_frame(vehicle: Vehicle, frame: bytes, device_ns: int) -> None:
    """Handle one frame that arrives now."""
    try:
        message = parse_frame(frame)
    except ValueError:
        return
    if header(frame)[0] == vehicle.own:
        return
    kind = message.get_type()
    if kind in ("ODOMETRY", "VISION_POSITION_ESTIMATE"):
        vehicle.take_pose(message, device_ns)
    elif kind == "TIMESYNC" and message.tc1 == 0:
        vehicle.send(mavlink.MAVLink_timesync_message(device_ns, message.ts1))
    elif kind == "COMMAND_LONG":
        result = _command(vehicle, message, device_ns)
        vehicle.send(mavlink.MAVLink_command_ack_message(message.command, result))
        if result == ACCEPTED and message.command == REQUEST_MESSAGE:
            if int(message.param1) == AUTOPILOT_VERSION:
                vehicle.send(version_message(vehicle.px4))
            else:
                send_origin(vehicle, device_ns)
        if result == ACCEPTED and message.command == GET_MESSAGE_INTERVAL:
            interval_us = vehicle.streams.interval_us(int(message.param1)) or 0
            vehicle.send(mavlink.MAVLink_message_interval_message(int(message.param1), interval_us))
    elif kind == "SET_GPS_GLOBAL_ORIGIN":
        if vehicle.set_origin((message.latitude, message.longitude, message.altitude)):
            send_origin(vehicle, device_ns)
    elif kind == "PARAM_REQUEST_READ" and message.param_id in vehicle.parameters:
        vehicle.send(_parameter(vehicle, message.param_id))


def send_origin(vehicle: Vehicle, device_ns: int) -> None:
    """GPS_GLOBAL_ORIGIN."""
    if vehicle.origin is not None:
        vehicle.send(mavlink.MAVLink_gps_global_origin_message(*vehicle.origin, device_ns // 1000))


def version_message(px4: bool) -> Any:
    """AUTOPILOT_VERSION of the firmware whose rules are simulated: ArduPilot 4.6.3, PX4 1.15.4, official."""
    version = int.from_bytes(bytes((1, 15, 4, 255) if px4 else (4, 6, 3, 255)))
    return mavlink.MAVLink_autopilot_version_message(0, version, 0, 0, 0, *[[0] * 8] * 3, 0, 0, 0)


def _command(vehicle: Vehicle, message: Any, device_ns: int) -> int:
    if message.command == SET_MESSAGE_INTERVAL:
        return vehicle.streams.set_interval(int(message.param1), message.param2, message.param3)
    if message.command == GET_MESSAGE_INTERVAL:
        return FAILED if vehicle.streams.interval_us(int(message.param1)) is None else ACCEPTED
    if message.command == REQUEST_MESSAGE:
        return ACCEPTED if int(message.param1) in (GPS_GLOBAL_ORIGIN, AUTOPILOT_VERSION) else UNSUPPORTED
    if message.command == SET_EKF_SOURCE_SET and not vehicle.px4:
        return ACCEPTED if vehicle.use_sources(int(message.param1)) else DENIED
    if message.command == REBOOT:
        return ACCEPTED if vehicle.reboot() else DENIED
    return UNSUPPORTED


def _parameter(vehicle: Vehicle, name: str) -> Any:
    value = vehicle.parameters[name]
    count, index = len(vehicle.parameters), list(vehicle.parameters).index(name)
    if vehicle.px4 and value == int(value):
        as_float = struct.unpack("<f", struct.pack("<i", int(value)))[0]
        return mavlink.MAVLink_param_value_message(name.encode(), as_float, INT32, count, index)
    return mavlink.MAVLink_param_value_message(name.encode(), float(value), REAL32, count, index)
