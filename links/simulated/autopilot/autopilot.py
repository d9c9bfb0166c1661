"""The drone's autopilot: it flies, estimates its motion, and sends MAVLink 2, with its own clock, over a radio link.

Its estimate is the truth with the errors of `drift`, in a local frame with its origin at the start of the scenario and
any north. Like ArduPilot it sends HEARTBEAT, ATTITUDE, LOCAL_POSITION_NED, ODOMETRY (LOCAL_FRD, BODY_FRD), RAW_IMU (mg,
mrad/s), with a receiver GPS_RAW_INT and GLOBAL_POSITION_INT, and a TIMESYNC request every 10 s, and replies to those of
the host, which are recorded on /autopilot/tx. A message is sampled on the autopilot's clock, sent by its main loop a
little later, and delayed by the radio. The autopilot of drone 2 has the topics /autopilot/rx_2 and /autopilot/tx_2.

Differences to a real flight (copter log of dronekit over a SiK telemetry radio; ours is the link of a companion):
  MAVLink 1; each message at 2.7 Hz, no ODOMETRY, no TIMESYNC; 45 gaps, the longest 18.8 s; a reboot during the log
  delay of ATTITUDE over its minimum 356 / 723 / 1460 ms (p50 / p90 / p99); ours 11 / 18 / 26 ms
  vibration of 9 / 19 / 34 m/s^2 (x / y / z, mean in flight); ours 0.6

Source: https://mavlink.io/en/messages/common.html; ArduPilot 4.5 GCS_MAVLINK (fields, units, TIMESYNC). The sizes of
the errors are ours.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import Record
from flow.stage import StrictModel
from links.mavlink.ned_frd import (
    flip_yz,
    rpy_from_R_odom_drone,
    upper_from_pose_covariance,
    upper_from_velocity_covariance,
    wxyz_from_R_odom_drone,
)
from links.simulated.autopilot.flight_stack.settings import FlightStackSettings
from links.simulated.autopilot.radio import Radio, RadioSettings
from links.simulated.cues.cue_sensors import DroneReceiver
from links.simulated.sensors.drift import STEP_S, DriftingEstimate, DriftSettings
from links.simulated.world.flight import Flight, FlightSettings
from stages.geometry.frames import Array64

mavlink: Any = ardupilotmega  # Any: starred vectors fill its constructors, which a type checker cannot count

STANDARD_GRAVITY_MPS2 = 9.80665
GUIDED = 4  # mode number of ArduCopter
LOOP_S = 1 / 400  # period of the main loop, within which a sample is sent
COMPANION = 191  # MAV_COMP_ID_ONBOARD_COMPUTER: the host
OWN_TIMESYNC_S = 10.0
IMU_DELAY_S = 0.0125  # age of RAW_IMU's values at its stamp: links/mavlink/streams/imu_stamps.py
QUALITY_PERCENT = 100
INT16 = 32767


class AutopilotSettings(StrictModel):
    """Flight, message rates and errors of the autopilot."""

    flight: FlightSettings = FlightSettings()
    drift: DriftSettings = DriftSettings()
    heading_of_world_x_deg: float = Field(default=57.0, ge=-360, le=360)  # clockwise from its north
    attitude_hz: float = Field(default=50.0, ge=0, le=400)  # 0: not sent
    position_hz: float = Field(default=30.0, ge=0, le=400)
    odometry_hz: float = Field(default=30.0, ge=0, le=400)
    imu_hz: float = Field(default=100.0, ge=0, le=400)
    timesync_hz: float = Field(default=1.0, ge=0, le=50)  # requests of the host
    gyro_noise_degps: float = Field(default=0.5, ge=0)  # per RAW_IMU sample, with vibration
    gyro_bias_degps: float = Field(default=0.3, ge=0)  # one sigma, constant in a run
    accelerometer_noise_mps2: float = Field(default=0.6, ge=0)
    accelerometer_bias_mps2: float = Field(default=0.08, ge=0)
    rate_noise_degps: float = Field(default=0.2, ge=0)  # of the estimated turn rate
    boot_s: float = Field(default=312.25, ge=1, le=4_000_000)  # time since boot at the start of the scenario
    clock_ppm: float = Field(default=18.0, ge=-1000, le=1000)  # positive: faster than the host's clock
    downlink: RadioSettings = RadioSettings()
    uplink: RadioSettings = RadioSettings()
    flight_stack: FlightStackSettings | None = None  # the autopilot in the loop; `flight` and `drift` are then not used


class Autopilot:
    """All messages of the autopilot, and the TIMESYNC requests of the host, in the order of sending."""

    def __init__(
        self,
        settings: AutopilotSettings,
        flight: Flight,
        start_ns: int,
        duration_s: float,
        seed: int,
        receiver: DroneReceiver | None = None,
        drone: int = 1,
    ) -> None:
        """`drone`: its number, in the names of its topics."""
        self._settings = settings
        self._received, self._sent = (f"/autopilot/{way}" + (f"_{drone}" if drone > 1 else "") for way in ("rx", "tx"))
        self._start_ns = start_ns
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._host = mavlink.MAVLink(None, srcSystem=1, srcComponent=COMPANION)
        self._downlink = Radio(settings.downlink, start_ns, np.random.default_rng([seed, 31]))
        uplink = Radio(settings.uplink, start_ns, np.random.default_rng([seed, 32]))
        self._rng = np.random.default_rng([seed, 33])
        self._biases = self._rng.standard_normal((2, 3))
        grid_s = np.arange(0.0, duration_s + 2 * STEP_S, STEP_S)
        heading_rad = float(np.radians(settings.heading_of_world_x_deg))
        self._flight = flight
        self._estimate = DriftingEstimate(
            flight.flying_poses(grid_s)[1], -heading_rad, settings.drift, np.random.default_rng([seed, 34])
        )
        streams = (
            (1.0, self._heartbeats),
            (settings.attitude_hz, self._attitudes),
            (settings.position_hz, self._positions),
            (settings.odometry_hz, self._odometries),
            (settings.imu_hz, self._raw_imus),
            (1 / OWN_TIMESYNC_S, self._timesync_requests),
        )
        self._waiting: list[tuple[int, Any]] = []
        if receiver is not None:
            streams += ((receiver.settings.rate_hz, receiver.gps_raw),)
            streams += ((receiver.settings.rate_hz if receiver.barometer else 0.0, receiver.global_positions),)
        for number, (rate_hz, messages) in enumerate(streams):
            self._plan(rate_hz, 0.0007 * number, duration_s, messages)
        self._requests: list[tuple[int, bytes]] = []
        self._plan_timesync(duration_s, uplink)
        self._waiting.sort(key=lambda item: item[0], reverse=True)
        self._requests.reverse()

    def device_ns(self, host_ns: int) -> int:
        """The autopilot's time since boot at a host time."""
        since_ns = host_ns - self._start_ns
        return round(1e9 * self._settings.boot_s) + since_ns + round(1e-6 * self._settings.clock_ppm * since_ns)

    def records(self, until_ns: int) -> list[Record]:
        """Messages sent before `until_ns` that were not returned yet; a received frame is stamped with its arrival."""
        records: list[Record] = []
        while self._requests and self._requests[-1][0] < until_ns:
            at_ns, frame = self._requests.pop()
            records.append(Record(self._sent, arrival_ns=at_ns, stamp_ns=at_ns, data=frame))
        while self._waiting and self._waiting[-1][0] < until_ns:
            sent_ns, message = self._waiting.pop()
            frame = _packed(message, self._mav)
            arrival_ns = self._downlink.arrival_ns(sent_ns, len(frame))
            if arrival_ns is not None:
                records.append(Record(self._received, arrival_ns=arrival_ns, stamp_ns=arrival_ns, data=frame))
        return records

    def _plan(
        self,
        rate_hz: float,
        phase_s: float,
        duration_s: float,
        messages: Callable[[Array64, NDArray[np.int64]], list[Any]],
    ) -> None:
        """Schedule messages: sampled at a constant rate on the autopilot's clock, sent by the main loop."""
        if rate_hz == 0:
            return
        ratio = 1 + 1e-6 * self._settings.clock_ppm
        first_s = (-self._settings.boot_s) % (1 / rate_hz) + phase_s  # sample times are multiples of the period
        time_s = np.arange(first_s / ratio, duration_s, 1 / rate_hz / ratio)
        host_ns = self._start_ns + np.rint(1e9 * time_s).astype(np.int64)
        device_ns = np.array([self.device_ns(ns) for ns in host_ns.tolist()], dtype=np.int64)
        sent_ns = host_ns + np.rint(1e9 * self._rng.uniform(0.1, 1.0, len(time_s)) * LOOP_S).astype(np.int64)
        self._waiting += zip(sent_ns.tolist(), messages(time_s, device_ns), strict=True)

    def _plan_timesync(self, duration_s: float, uplink: Radio) -> None:
        rate_hz = self._settings.timesync_hz
        for at_s in np.arange(0.3 / rate_hz, duration_s, 1 / rate_hz) if rate_hz else ():
            request_ns = self._start_ns + round(1e9 * at_s)
            frame = _packed(mavlink.MAVLink_timesync_message(0, request_ns), self._host)
            self._requests.append((request_ns, frame))
            received_ns = uplink.arrival_ns(request_ns, len(frame))
            if received_ns is not None:
                reply = mavlink.MAVLink_timesync_message(self.device_ns(received_ns), request_ns)
                self._waiting.append((received_ns + round(1e9 * self._rng.uniform(0.05, 1.0) * LOOP_S), reply))

    def _heartbeats(self, time_s: Array64, device_ns: NDArray[np.int64]) -> list[Any]:
        armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED | mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        beat = (mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, armed, GUIDED)
        return [mavlink.MAVLink_heartbeat_message(*beat, mavlink.MAV_STATE_ACTIVE, 3) for _ in time_s]

    def _attitudes(self, time_s: Array64, device_ns: NDArray[np.int64]) -> list[Any]:
        rotations, rates = self._attitude(time_s)
        return [
            mavlink.MAVLink_attitude_message(ns // 1_000_000, *rpy_from_R_odom_drone(R), *flip_yz(rate))
            for ns, R, rate in zip(device_ns.tolist(), rotations, rates, strict=True)
        ]

    def _positions(self, time_s: Array64, device_ns: NDArray[np.int64]) -> list[Any]:
        position, velocity = flip_yz(self._estimate.position_m(time_s)), flip_yz(self._velocity(time_s))
        return [
            mavlink.MAVLink_local_position_ned_message(ns // 1_000_000, *p, *v)
            for ns, p, v in zip(device_ns.tolist(), position, velocity, strict=True)
        ]

    def _odometries(self, time_s: Array64, device_ns: NDArray[np.int64]) -> list[Any]:
        rotations, rates = self._attitude(time_s)
        position, velocity = self._estimate.position_m(time_s), self._velocity(time_s)
        covariances = self._estimate.covariances(time_s, rotations)
        rate_var = np.radians(self._settings.rate_noise_degps) ** 2
        velocity_var = self._settings.drift.velocity_mps**2
        velocity_upper = upper_from_velocity_covariance(np.diag([*[rate_var] * 3, *[velocity_var] * 3]))
        messages: list[Any] = []
        for i, ns in enumerate(device_ns.tolist()):
            R = rotations[i]
            messages.append(
                mavlink.MAVLink_odometry_message(
                    ns // 1_000,
                    mavlink.MAV_FRAME_LOCAL_FRD,
                    mavlink.MAV_FRAME_BODY_FRD,
                    *flip_yz(position[i]),
                    wxyz_from_R_odom_drone(R),
                    *flip_yz(R.T @ velocity[i]),
                    *flip_yz(rates[i]),
                    upper_from_pose_covariance(covariances[i], R),
                    velocity_upper,
                    0,
                    mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT,
                    QUALITY_PERCENT,
                )
            )
        return messages

    def _raw_imus(self, time_s: Array64, device_ns: NDArray[np.int64]) -> list[Any]:
        s = self._settings
        rate, force = self._flight.imu(np.maximum(time_s - IMU_DELAY_S, 0.0))
        gyro_bias, force_bias = (
            np.radians(s.gyro_bias_degps) * self._biases[0],
            s.accelerometer_bias_mps2 * self._biases[1],
        )
        rate = rate + gyro_bias + self._rng.normal(0.0, np.radians(s.gyro_noise_degps), rate.shape)
        force = force + force_bias + self._rng.normal(0.0, s.accelerometer_noise_mps2, force.shape)
        counts = np.hstack([flip_yz(force) / STANDARD_GRAVITY_MPS2, flip_yz(rate)]) * 1e3  # mg, mrad/s
        counts = np.clip(np.trunc(counts), -INT16, INT16).astype(int).tolist()
        return [
            mavlink.MAVLink_raw_imu_message(ns // 1_000, *six, 0, 0, 0)  # no magnetometer
            for ns, six in zip(device_ns.tolist(), counts, strict=True)
        ]

    def _timesync_requests(self, time_s: Array64, device_ns: NDArray[np.int64]) -> list[Any]:
        return [mavlink.MAVLink_timesync_message(0, ns) for ns in device_ns.tolist()]

    def _attitude(self, time_s: Array64) -> tuple[Array64, Array64]:
        """Estimated R_odom_drone (n, 3, 3) and turn rate (n, 3), drone axes."""
        rate = self._flight.imu(time_s)[0]
        noise = self._rng.normal(0.0, np.radians(self._settings.rate_noise_degps), rate.shape)
        return self._estimate.rotations(time_s, self._flight.flying_poses(time_s)[0]), rate + noise

    def _velocity(self, time_s: Array64) -> Array64:
        return self._estimate.velocity_mps(time_s, self._flight.at(time_s)[1])


def _packed(message: Any, sender: Any) -> bytes:
    """The frame of a message, with the next sequence number of the sender."""
    frame = bytes(message.pack(sender))
    sender.seq = (sender.seq + 1) % 256
    return frame
