"""Messages of the flight stack to the host: streams at their intervals, answers and texts, over the radio.

Source: ours; the parts name theirs.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import Record
from links.mavlink.transport.framing import packed
from links.simulated.autopilot.autopilot import AutopilotSettings
from links.simulated.autopilot.flight_stack import streams, telemetry
from links.simulated.autopilot.flight_stack.estimation.estimator import Estimators
from links.simulated.autopilot.flight_stack.quadrotor import STEPS, FlownTick
from links.simulated.autopilot.radio import Radio
from links.simulated.kernels.motion import STEP_S
from stages.geometry.frames import Array64

mavlink: Any = ardupilotmega
STEP_NS = round(STEP_S * 1e9)
STATUS_HZ = 5.0


class Downlink:
    """Call `send_due` once per tick; `records` returns the frames with their arrival."""

    def __init__(self, settings: AutopilotSettings, start_ns: int, seed: int) -> None:
        assert settings.flight_stack is not None
        stack = settings.flight_stack
        rates_hz = {
            streams.HEARTBEAT: 1.0,
            streams.ATTITUDE: settings.attitude_hz,
            streams.LOCAL_POSITION_NED: settings.position_hz,
            streams.ODOMETRY: settings.odometry_hz,
            streams.RAW_IMU: settings.imu_hz,
            streams.HIGHRES_IMU: settings.imu_hz,
            streams.EKF_STATUS_REPORT: STATUS_HZ,
            streams.ESTIMATOR_STATUS: STATUS_HZ,
        }
        self.streams = streams.Streams(stack.kind, rates_hz, stack.denied_intervals)
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._radio = Radio(settings.downlink, start_ns, np.random.default_rng([seed, 31]))
        self._waiting: deque[Any] = deque()
        self._records: deque[tuple[int, Record]] = deque()

    def send(self, message: Any) -> None:
        """Queue a message; it is sent at the next step of the main loop."""
        self._waiting.append(message)

    def restart(self) -> None:
        """After a reboot: the rates of the start, and nothing queued."""
        self.streams.restart()
        self._waiting.clear()

    def records(self, until_ns: int) -> list[Record]:
        """Frames sent before `until_ns` that were not returned yet."""
        found: list[Record] = []
        while self._records and self._records[0][0] < until_ns:
            found.append(self._records.popleft()[1])
        return found

    def send_due(
        self,
        now_ns: int,
        tick: FlownTick,
        field_ut: Array64,
        gps_raw: Callable[[int], Any],
        ekf: Estimators,
        device_ns_of: Callable[[int], int],
        heartbeat: Any,
    ) -> None:
        """Send what is due in a tick, in the middle of each step of the main loop.

        field_ut: magnetic field (3,); `gps_raw`: GPS_RAW_INT at a time of the device.
        """
        reported = ekf.reported
        other = None if reported is ekf.primary else reported.lane.output()[0:10]
        for step in range(STEPS):
            sent_ns = now_ns + step * STEP_NS + STEP_NS // 2
            device_ns = device_ns_of(sent_ns)
            estimate = tick.estimates[step] if other is None else other
            for message in self.streams.due(device_ns):
                if message == streams.HEARTBEAT:
                    self._waiting.append(heartbeat)
                elif message == streams.GPS_RAW_INT:
                    self._waiting.append(gps_raw(device_ns))
                elif (built := _message(message, device_ns, ekf, estimate, tick.samples[step], field_ut)) is not None:
                    self._waiting.append(built)
            while self._waiting:
                frame = packed(self._waiting.popleft(), self._mav)
                arrival_ns = self._radio.arrival_ns(sent_ns, len(frame))
                if arrival_ns is not None:
                    record = Record("/autopilot/rx", arrival_ns=arrival_ns, stamp_ns=arrival_ns, data=frame)
                    self._records.append((sent_ns, record))


def _message(
    message: int, device_ns: int, ekf: Estimators, estimate: Array64, sample: Array64, field_ut: Array64
) -> Any:
    """One message by its id; None: not known now. EKF3 reports no position in constant position mode, EKF2 does."""
    core = ekf.reported
    gyro = sample[0:3] - core.lane.x[10:13]
    known = (core.aiding and core.origin) or ekf.px4
    if message == streams.ATTITUDE:
        return telemetry.attitude(device_ns, estimate, gyro)
    if message == streams.LOCAL_POSITION_NED:
        return telemetry.local_position(device_ns, estimate) if known else None
    if message == streams.ODOMETRY:
        resets = core.lane.reset_count
        return telemetry.odometry(device_ns, estimate, gyro, core.lane.P, resets, ekf.px4) if known else None
    if message == streams.RAW_IMU:
        return telemetry.raw_imu(device_ns, sample, field_ut)
    if message == streams.SCALED_IMU:
        return telemetry.scaled_imu(device_ns, sample, field_ut)
    if message == streams.HIGHRES_IMU:
        return telemetry.highres_imu(device_ns, sample, field_ut)
    return ekf.report(device_ns)
