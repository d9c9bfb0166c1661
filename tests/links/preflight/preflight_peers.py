"""Peers of a preflight: a LiDAR packet, a drone moved by hand as requested, and a fake tracker."""

from __future__ import annotations

import math

import cv2
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import Record
from flow.stage import Settings, Stage
from links.mavlink.profiles import best_values, required_parameters
from links.mavlink.transport.framing import packed, parse_frame
from links.simulated.autopilot.autopilot import Autopilot, AutopilotSettings
from links.simulated.sensors.lidar_packets import PacketEncoder
from links.simulated.world.flight import Flight
from links.simulated.world.path import Path, Waypoint
from stages.geometry.rig_lidar import RigLidar
from stages.messages import DroneFix, DroneLocalPosition

SPEED = 8.0  # rad/s, phase of a hand motion: forth and back in 0.4 s
START_NS, SECONDS = 1_748_773_230_000_000_000, 60.0


def packet(first_pulse_ns: int, mode: str = "strongest") -> bytes:
    """A VLP-16 packet in which every pulse returns from 10 m."""
    returns, firings = (2, 12) if mode == "dual" else (1, 24)
    shape = (returns, firings, 16)
    azimuths = np.linspace(0.0, 0.08, firings)
    encoder = PacketEncoder(RigLidar(), mode)
    return encoder.encode(first_pulse_ns, azimuths, np.full(shape, 10.0), np.full(shape, 50, np.uint8))


def good_parameters(profile="ardupilot") -> dict[str, float]:
    """The best allowed value of each parameter of a profile."""
    return best_values(required_parameters(profile, "none"))


def flight() -> Autopilot:
    """A drone that drifts slowly to the east."""
    path = Path(
        waypoints=(Waypoint(t_s=0.0, xyz_m=(0, 0, 10), yaw_deg=0), Waypoint(t_s=70.0, xyz_m=(14, 0, 10), yaw_deg=0))
    )
    settings = AutopilotSettings(timesync_hz=0)
    return Autopilot(settings, Flight(path, settings.flight, SECONDS, 1), START_NS, SECONDS, 1)


class OnTheGround:
    """A flight that reports disarmed. `upside_down`: the z axis of its accelerometer is inverted."""

    def __init__(self, upside_down: bool = False) -> None:
        self._flight, self._upside_down = flight(), upside_down
        self._mav = ardupilotmega.MAVLink(None, srcSystem=1, srcComponent=1)
        self.device_ns = self._flight.device_ns

    def records(self, until_ns: int) -> list[Record]:
        """See Autopilot."""
        return [self._changed(record) for record in self._flight.records(until_ns)]

    def _changed(self, record: Record) -> Record:
        message = parse_frame(record.data)
        if message.get_type() == "HEARTBEAT":
            message.base_mode &= ~128
        elif message.get_type() == "RAW_IMU" and self._upside_down:
            message.zacc = -message.zacc
        else:
            return record
        return Record(record.topic, record.arrival_ns, record.stamp_ns, packed(message, self._mav))


class HandHeld:
    """A drone moved as the preflight requests, at 50 Hz. `rotated`: its board is mounted backwards."""

    def __init__(self, rotated: bool = False) -> None:
        self._mav = ardupilotmega.MAVLink(None, srcSystem=1, srcComponent=1)
        self._sign = -1.0 if rotated else 1.0
        self._motion, self._since_ns, self._next_ns, self._beat_ns = "", 0, 0, 0

    def ask(self, motion) -> None:
        """A motion starts."""
        self._motion, self._since_ns = motion.name, self._next_ns

    def device_ns(self, scenario_ns: int) -> int:
        """Its time since boot."""
        return scenario_ns - START_NS + 100_000_000_000

    def records(self, until_ns: int) -> list[Record]:
        """Its frames until then."""
        records: list[Record] = []
        if not self._next_ns:
            self._next_ns = self._beat_ns = self._since_ns = until_ns
        while self._next_ns < until_ns:
            at_ns, self._next_ns = self._next_ns, self._next_ns + 20_000_000
            messages = [self._attitude(at_ns), self._position(at_ns)]
            if at_ns >= self._beat_ns:
                self._beat_ns += 1_000_000_000
                messages.append(ardupilotmega.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3))
            records += [Record("/autopilot/rx", at_ns, at_ns, packed(message, self._mav)) for message in messages]
        return records

    def _attitude(self, at_ns: int):
        elapsed_s = (at_ns - self._since_ns) * 1e-9
        angle = math.radians(40) * math.sin(min(elapsed_s * SPEED, math.pi))
        rate = math.radians(40) * SPEED * math.cos(elapsed_s * SPEED) * (elapsed_s * SPEED < math.pi)
        roll, pitch = angle * (self._motion == "right side down"), -angle * (self._motion == "nose down")
        yaw = -angle * (self._motion == "turn left")  # FRD: nose up, right side down and clockwise are positive
        rates = [rate * (self._motion == what) for what in ("right side down", "nose down", "turn left")]
        s = self._sign
        return ardupilotmega.MAVLink_attitude_message(
            self.device_ns(at_ns) // 1_000_000, s * roll, s * pitch, yaw, s * rates[0], -s * rates[1], -rates[2]
        )

    def _position(self, at_ns: int):
        turn = 6.0 * (at_ns - self._since_ns) * 1e-9 * (self._motion == "circle")
        x, y, z = 1.5 * math.cos(turn), 1.5 * math.sin(turn), -0.7 * math.sin(0.5 * turn) ** 2 * 2
        return ardupilotmega.MAVLink_local_position_ned_message(self.device_ns(at_ns) // 1_000_000, x, y, z, 0, 0, 0)


class FakeTrackerSettings(Settings):
    """Settings of `FakeTracker`."""

    reflect: float = 1.0  # -1: it and the autopilot do not agree on left and right


class FakeTracker(Stage[FakeTrackerSettings]):
    """Outputs fixes of the moved drone in a vehicle frame that is rotated by 30 deg."""

    def on_position(self, position: DroneLocalPosition) -> DroneFix:
        """A fix where it is."""
        c, s = math.cos(0.5), math.sin(0.5)
        x, y, z = position.xyz_odom_m
        y = y * self.settings.reflect
        return DroneFix(
            stamp_ns=position.stamp_ns,
            xyz_vehicle_m=np.array([c * x - s * y + 3, s * x + c * y, z + 5]),
            covariance_m2=np.eye(3) * 0.01,
            hits=9,
        )


def film(file, seconds: float = 12.0, size: int = 64, fps: int = 15) -> None:
    """A grey film that gets brighter."""
    video = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), fps, (size, size))
    for number in range(int(seconds * fps)):
        video.write(np.full((size, size, 3), number % 200, np.uint8))
    video.release()
