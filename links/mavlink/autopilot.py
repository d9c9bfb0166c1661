"""The drone's autopilot as a source: MAVLink frames, one a record, become messages on the host's timeline.

Each frame stands alone, so a damaged one cannot take the next with it. What is damaged, foreign or makes no sense is
counted and left out; nothing here raises over a radio's bytes. RAW_IMU is read in ArduPilot's units (mg, mrad/s),
HIGHRES_IMU (PX4) is SI; an autopilot sends one of them. Frames are not authenticated here: signatures are not checked.

Source: https://mavlink.io/en/messages/common.html; ArduPilot GCS_MAVLINK::send_raw_imu for RAW_IMU's units.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flow.link import Record, Source
from links.mavlink.clock import AutopilotClock
from links.mavlink.frames import (
    R_local_drone_from_rpy,
    R_local_drone_from_wxyz,
    pose_covariance_from_upper,
    turned_over,
    velocity_covariance_from_upper,
)
from stages.messages import AutopilotStatus, DroneAttitude, DroneImu, DroneLocalPosition, DroneOdometry

AutopilotMessage = DroneAttitude | DroneLocalPosition | DroneOdometry | DroneImu | AutopilotStatus

V1, V2 = 0xFE, 0xFD
SIGNED = 0x01  # the one incompatibility flag that is defined
MIN_FRAME_BYTES, MAX_FRAME_BYTES = 8, 280
HALF_MS_NS = 500_000  # time_boot_ms is cut off, not rounded: on average half a millisecond early
STANDARD_GRAVITY_MPS2 = 9.80665
LOCAL_FRAMES = (1, 20)  # MAV_FRAME_LOCAL_NED, MAV_FRAME_LOCAL_FRD
BODY_FRD = 12
ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
CRITICAL = 5  # MAV_STATE_CRITICAL; above: emergency, poweroff, termination
SEQUENCE = 256
LATE = 128  # a sequence number this far ahead is a late frame, not 128 lost ones


class Autopilot(Source):
    """Messages of one autopilot, chosen by system and component id."""

    topic: str = "/autopilot/rx"
    system_id: int = Field(1, ge=1, le=255)
    component_id: int = Field(1, ge=1, le=255)
    clock_drift_limit_ppm: float = Field(100.0, ge=0, le=10_000)
    clock_jump_limit_s: float = Field(5.0, gt=0, le=3600)

    @cached_property  # not a private attribute: decoding asks for it at every frame
    def _stream(self) -> FrameStream:
        clock = AutopilotClock(self.clock_drift_limit_ppm, round(1e9 * self.clock_jump_limit_s))
        return FrameStream((self.system_id, self.component_id), clock)

    def decode(self, record: Record) -> AutopilotMessage | None:
        """The message of one frame; None when it says nothing of use here or is refused (see `counters`)."""
        return self._stream.decode(record)

    @property
    def counters(self) -> dict[str, int]:
        """Totals since the start: messages, lost frames, clock restarts, TIMESYNC replies, refused by reason."""
        stream = self._stream
        refused = {f"refused: {reason}": count for reason, count in stream.refused.items()}
        return {
            "decoded": stream.decoded,
            "of no use here": stream.unused,
            "lost": stream.lost,
            "clock restarts": stream.clock.restarts,
            "timesync replies": stream.clock.round_trips,
            **refused,
        }


class FrameStream:
    """Decodes frames in turn; keeps the clock, the sequence and the counts."""

    def __init__(self, sender: tuple[int, int], clock: AutopilotClock) -> None:
        self.clock = clock
        self.decoded = self.unused = self.lost = 0
        self.refused: Counter[str] = Counter()
        self._sender = sender
        self._sequence: int | None = None
        self._last_ns: dict[str, int] = {}  # stamp of the last message of a kind
        self._late: int | None = None  # a number from the past, seen just before

    def decode(self, record: Record) -> AutopilotMessage | None:
        """See `Autopilot.decode`."""
        try:
            frame = parse_frame(record.data)
        except ValueError:
            return self._refuse("damaged")
        sender, number = header(record.data)
        if sender != self._sender:
            return self._refuse("from another system")
        kind = frame.get_type()
        if kind.startswith("UNKNOWN"):  # without its checksum: believed only where the number fits
            if self._sequence is not None and number == (self._sequence + 1) % SEQUENCE:
                self._sequence = number
            return self._refuse("unknown message")
        if not self._in_sequence(number):
            return self._refuse("repeated or late")
        if kind == "TIMESYNC":
            return self._timesync(frame, record.arrival_ns)
        if kind == "HEARTBEAT":
            self.decoded += 1
            return self._status(frame, record.arrival_ns)
        reader = READERS.get(kind)
        if reader is None:
            self.unused += 1
            return None
        stamp_ns = self._stamp(frame, record.arrival_ns)
        if stamp_ns is None:
            return self._refuse("time disagrees")
        if stamp_ns <= self._last_ns.get(kind, -1):  # a prompter message has shown that those before were late
            return self._refuse("not after the one before")
        try:
            message = reader(frame, stamp_ns)
        except ValueError as error:
            return self._refuse(str(error))
        self._last_ns[kind] = stamp_ns
        self.decoded += 1
        return message

    def _stamp(self, frame: Any, arrival_ns: int) -> int | None:
        """When it was true, on the host's timeline; None while the device's clock disagrees with itself."""
        in_ms = hasattr(frame, "time_boot_ms")
        device_ns = frame.time_boot_ms * 1_000_000 if in_ms else frame.time_usec * 1_000
        stamp_ns = self.clock.read(device_ns, arrival_ns)
        return stamp_ns if stamp_ns is None else min(stamp_ns + HALF_MS_NS * in_ms, arrival_ns)

    def _in_sequence(self, number: int) -> bool:
        if self._sequence is not None:
            ahead = (number - self._sequence) % SEQUENCE
            if ahead == 0 or ahead >= LATE:
                restarted = self._late is not None and number == (self._late + 1) % SEQUENCE
                self._late = number
                if not restarted:
                    return False
            else:
                self.lost += ahead - 1
        self._sequence, self._late = number, None
        return True

    def _timesync(self, frame: Any, arrival_ns: int) -> None:
        if frame.tc1 == 0:
            self.unused += 1  # the autopilot asks; answering is the sender's part
        elif not self.clock.round_trip(frame.ts1, frame.tc1, arrival_ns):
            self._refuse("timesync of another's or too slow")

    def _status(self, frame: Any, arrival_ns: int) -> AutopilotStatus:
        return AutopilotStatus(
            stamp_ns=arrival_ns,  # a heartbeat carries no time
            armed=bool(frame.base_mode & ARMED),
            custom_mode=frame.custom_mode,
            failsafe=frame.system_status >= CRITICAL,
            lost_frames=self.lost,
            clock_offset_ns=self.clock.offset_ns,
            clock_uncertainty_ns=self.clock.uncertainty_ns,
        )

    def _refuse(self, reason: str) -> None:
        self.refused[reason] += 1


@functools.cache
def _parser() -> tuple[Any, type[Exception]]:
    """pymavlink's parser and the error it raises. Used frame by frame, it remembers nothing that matters."""
    from pymavlink.dialects.v20 import ardupilotmega  # here: it takes 0.2 s, and most commands need none of it

    return ardupilotmega.MAVLink(None), ardupilotmega.MAVError


def header(data: bytes) -> tuple[tuple[int, int], int]:
    """(system id, component id) and sequence number of a frame."""
    at = 3 if data[0] == V1 else 5
    return (data[at], data[at + 1]), data[at - 1]


def parse_frame(data: bytes) -> Any:
    """pymavlink's message of exactly one frame, "UNKNOWN_..." beyond its dialect. ValueError: damaged, or no frame."""
    if not MIN_FRAME_BYTES <= len(data) <= MAX_FRAME_BYTES or data[0] not in (V1, V2):
        raise ValueError("no MAVLink frame")
    if data[0] == V2 and data[2] & ~SIGNED:
        raise ValueError("unknown incompatibility flags")
    parser, parser_error = _parser()
    try:
        return parser.decode(bytearray(data))
    except parser_error as error:
        raise ValueError(str(error)) from None


def _vector(frame: Any, *names: str, unit: float = 1.0) -> NDArray[np.float64]:
    """Fields as a vector in our axes. ValueError when one is NaN or infinite."""
    return turned_over(unit * np.array(_numbers(frame, *names)))


def _numbers(frame: Any, *names: str) -> list[float]:
    values = [float(getattr(frame, name)) for name in names]
    if not all(map(math.isfinite, values)):
        raise ValueError("not finite")
    return values


def read_attitude(frame: Any, stamp_ns: int) -> DroneAttitude:
    """ATTITUDE."""
    return DroneAttitude(
        stamp_ns=stamp_ns,
        R_local_drone=R_local_drone_from_rpy(*_numbers(frame, "roll", "pitch", "yaw")),
        angular_velocity_drone_radps=_vector(frame, "rollspeed", "pitchspeed", "yawspeed"),
    )


def read_local_position(frame: Any, stamp_ns: int) -> DroneLocalPosition:
    """LOCAL_POSITION_NED."""
    return DroneLocalPosition(
        stamp_ns=stamp_ns,
        xyz_local_m=_vector(frame, "x", "y", "z"),
        velocity_local_mps=_vector(frame, "vx", "vy", "vz"),
    )


def read_odometry(frame: Any, stamp_ns: int) -> DroneOdometry:
    """ODOMETRY of a local frame with the velocity in the body's; others are refused, not guessed."""
    if frame.frame_id not in LOCAL_FRAMES or frame.child_frame_id != BODY_FRD:
        raise ValueError("odometry in other frames")
    length = math.hypot(*frame.q)
    if not abs(length - 1.0) < 0.01:  # NaN compares false
        raise ValueError("no rotation")
    R_local_drone = R_local_drone_from_wxyz(frame.q)
    return DroneOdometry(
        stamp_ns=stamp_ns,
        xyz_local_m=_vector(frame, "x", "y", "z"),
        R_local_drone=R_local_drone,
        velocity_drone_mps=_vector(frame, "vx", "vy", "vz"),
        angular_velocity_drone_radps=_vector(frame, "rollspeed", "pitchspeed", "yawspeed"),
        pose_covariance=pose_covariance_from_upper(frame.pose_covariance, R_local_drone),
        velocity_covariance=velocity_covariance_from_upper(frame.velocity_covariance),
        reset_counter=frame.reset_counter,
        quality_percent=None if frame.quality == 0 else max(frame.quality, 0),
    )


def read_raw_imu(frame: Any, stamp_ns: int) -> DroneImu:
    """RAW_IMU as ArduPilot fills it: mg and mrad/s."""
    return DroneImu(
        stamp_ns=stamp_ns,
        acceleration_drone_mps2=_vector(frame, "xacc", "yacc", "zacc", unit=1e-3 * STANDARD_GRAVITY_MPS2),
        angular_velocity_drone_radps=_vector(frame, "xgyro", "ygyro", "zgyro", unit=1e-3),
    )


def read_highres_imu(frame: Any, stamp_ns: int) -> DroneImu:
    """HIGHRES_IMU: m/s^2 and rad/s."""
    return DroneImu(
        stamp_ns=stamp_ns,
        acceleration_drone_mps2=_vector(frame, "xacc", "yacc", "zacc"),
        angular_velocity_drone_radps=_vector(frame, "xgyro", "ygyro", "zgyro"),
    )


READERS: dict[str, Callable[[Any, int], AutopilotMessage]] = {
    "ATTITUDE": read_attitude,
    "LOCAL_POSITION_NED": read_local_position,
    "ODOMETRY": read_odometry,
    "RAW_IMU": read_raw_imu,
    "HIGHRES_IMU": read_highres_imu,
}
