"""Requests for the autopilot's messages at useful rates: MAV_CMD_SET_MESSAGE_INTERVAL, with its acknowledgements.

One request is under way at a time, because an acknowledgement does not name its message. A request without one is
repeated; a denied rate is halved, an unsupported message replaced by the next alternative. The requests start again
after a boot of the autopilot and after silence. The rates that arrive are measured: one that falls
below what was accepted is requested again, after 1 to 2 s, and the IMU below 10 Hz is a status with what to do.

What the autopilots do with a request:
    ArduPilot: truncates the interval to whole milliseconds; denies a rate above 0.8 SCHED_LOOP_RATE, and a request
        whose third parameter is not 0; sends less on a link without space; another station's REQUEST_DATA_STREAM sets
        the rate again. An unknown message fails.
    PX4: applies a rate to the connection of the request; its onboard mode (MAV_n_MODE) sends HIGHRES_IMU at 50 Hz.
The default rates fill 40 % of a serial line of 115200 baud (RAW_IMU 41 bytes, ATTITUDE and LOCAL_POSITION_NED 40).

Source: https://mavlink.io/en/guide/message_rates.html, https://mavlink.io/en/services/command.html;
https://ardupilot.org/dev/docs/mavlink-requesting-data.html, https://github.com/ArduPilot/ardupilot/pull/34145 (denied
rate), /pull/28019 (third parameter), /issues/28550 (rates that fall back), and GCS_MAVLINK::set_message_interval of
libraries/GCS_MAVLink/GCS_Common.cpp (https://github.com/ArduPilot/ardupilot).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import Field

from flow.stage import StrictModel
from links.mavlink.commands import (
    ACCEPTED,
    ACK_TIMEOUT_NS,
    DENIED,
    IN_PROGRESS,
    TEMPORARILY_REJECTED,
    command_long,
    is_answer,
)
from links.mavlink.profiles import ProfileName

SET_MESSAGE_INTERVAL = 511  # MAV_CMD
RETRY_PERIOD_NS = 10_000_000_000  # between requests for a message that is given up, or that never had its rate
RATE_WINDOW_NS, RATE_MESSAGES = 1_000_000_000, 10  # a rate is measured over both
NEEDED_IMU_HZ = 10.0  # heading and preintegration work from this rate on
LOW_SHARE = 0.7  # of the accepted rate: below, it is requested again
NAMES: dict[str, int] = {
    "GPS_RAW_INT": 24,
    "SCALED_IMU": 26,
    "RAW_IMU": 27,
    "ATTITUDE": 30,
    "LOCAL_POSITION_NED": 32,
    "GLOBAL_POSITION_INT": 33,
    "HIGHRES_IMU": 105,
    "EKF_STATUS_REPORT": 193,
    "ESTIMATOR_STATUS": 230,
}
IMU_MESSAGES: dict[ProfileName, tuple[str, ...]] = {
    "ardupilot": ("RAW_IMU", "SCALED_IMU"),
    "px4": ("HIGHRES_IMU", "SCALED_IMU"),
}
ESTIMATOR_MESSAGES: dict[ProfileName, str] = {"ardupilot": "EKF_STATUS_REPORT", "px4": "ESTIMATOR_STATUS"}


class MessageRates(StrictModel):
    """Rates to request; 0: not requested, the autopilot's own settings apply."""

    imu_hz: float = Field(default=50.0, ge=0, le=400)
    attitude_hz: float = Field(default=25.0, ge=0, le=400)
    position_hz: float = Field(default=25.0, ge=0, le=400)
    estimator_hz: float = Field(default=5.0, ge=0, le=50)
    # GPS_RAW_INT and GLOBAL_POSITION_INT, for cues; with `switch_source` GPS_RAW_INT is requested at 1 Hz all the same
    gnss_hz: float = Field(default=0.0, ge=0, le=50)


@dataclass(slots=True)
class _Stream:
    """One message, with its alternatives, and the state of its request."""

    names: tuple[str, ...]
    rate_hz: float  # to request; halved when it is denied
    name_at: int = 0
    settled: bool = False  # accepted, or given up
    arrived: bool = False  # at its rate, since it was accepted
    answer: str = ""  # of the autopilot, unless it accepted
    denied_hz: float | None = None  # the highest denied rate
    next_ns: int = 0  # no request before

    @property
    def name(self) -> str:
        return self.names[self.name_at]


@dataclass(slots=True)
class _Rate:
    """Messages of one type per window."""

    start_ns: int
    window_ns: int = RATE_WINDOW_NS
    count: int = 0
    hz: float | None = None  # of the newest complete window

    def update(self, now_ns: int) -> None:
        """Close windows that have ended."""
        elapsed_ns = now_ns - self.start_ns
        if elapsed_ns >= self.window_ns:
            self.hz = self.count * 1e9 / elapsed_ns
            self.start_ns, self.count = now_ns, 0


class MessageIntervals:
    """Requests the messages of one autopilot and measures the rates at which they arrive."""

    def __init__(
        self,
        rates: MessageRates,
        profile: ProfileName,
        target: tuple[int, int],
        own: tuple[int, int],
        least_gps_hz: float = 0.0,
    ) -> None:
        """`least_gps_hz`: of GPS_RAW_INT, whatever `rates` say."""
        self._target, self._own = target, own
        self._wanted = (
            (IMU_MESSAGES[profile], rates.imu_hz),
            (("ATTITUDE",), rates.attitude_hz),
            (("LOCAL_POSITION_NED",), rates.position_hz),
            ((ESTIMATOR_MESSAGES[profile],), rates.estimator_hz),
            (("GPS_RAW_INT",), max(rates.gnss_hz, least_gps_hz)),
            (("GLOBAL_POSITION_INT",), rates.gnss_hz),
        )
        self._counts: Counter[str] = Counter()
        self._rates: dict[str, _Rate] = {}
        self._imu_names = IMU_MESSAGES[profile] if rates.imu_hz else ()
        self._begin()

    def _begin(self) -> None:
        self._streams = [_Stream(names, rate_hz) for names, rate_hz in self._wanted if rate_hz > 0]
        self._pending: tuple[_Stream, int] | None = None  # the request under way, and when it was sent

    def restart(self) -> None:
        """Request everything again: the autopilot was silent, or has rebooted."""
        self._counts["message intervals restarted"] += 1
        self._rates.clear()
        self._begin()

    def due(self, now_ns: int) -> Any | None:
        """The request to send now, if one is due."""
        for rate in self._rates.values():
            rate.update(now_ns)
        if self._pending is not None:
            stream, sent_ns = self._pending
            if now_ns - sent_ns < ACK_TIMEOUT_NS:
                return None
            self._counts["message interval not acknowledged"] += 1
            stream.answer, stream.next_ns, self._pending = "does not answer", now_ns + ACK_TIMEOUT_NS, None
        for stream in self._streams:
            self._renew(stream, now_ns)
        waiting = [stream for stream in self._streams if not stream.settled and now_ns >= stream.next_ns]
        if not waiting:
            return None
        stream = min(waiting, key=lambda stream: stream.next_ns)
        self._pending = stream, now_ns
        self._rates.setdefault(stream.name, _Rate(now_ns))
        return command_long(self._target, SET_MESSAGE_INTERVAL, float(NAMES[stream.name]), 1e6 / stream.rate_hz)

    def on_not_sent(self) -> None:
        """The request of `due` could not be sent."""
        self._pending = None

    def on_message(self, message: Any, now_ns: int) -> None:
        """Take a message of the autopilot."""
        kind = message.get_type()
        if kind in NAMES:
            self._rates.setdefault(kind, _Rate(now_ns)).count += 1
        elif is_answer(message, SET_MESSAGE_INTERVAL, self._own):
            self._on_result(message.result, now_ns)

    def _on_result(self, result: int, now_ns: int) -> None:
        if self._pending is None or result == IN_PROGRESS:
            return
        (stream, _), self._pending = self._pending, None
        stream.next_ns = now_ns
        if result == ACCEPTED:
            stream.settled, stream.arrived, stream.answer = True, False, ""
            stream.next_ns = now_ns + RETRY_PERIOD_NS
            window_ns = max(RATE_WINDOW_NS, round(RATE_MESSAGES * 1e9 / stream.rate_hz))
            self._rates[stream.name] = _Rate(now_ns, window_ns)  # the old rate does not count
        elif result == TEMPORARILY_REJECTED:
            stream.answer, stream.next_ns = "is busy", now_ns + ACK_TIMEOUT_NS
        elif result == DENIED and stream.rate_hz > NEEDED_IMU_HZ:
            self._counts[f"message interval denied: {stream.name} at {stream.rate_hz:.3g} Hz"] += 1
            stream.denied_hz = stream.denied_hz or stream.rate_hz
            stream.rate_hz = max(0.5 * stream.rate_hz, NEEDED_IMU_HZ)
        elif stream.name_at + 1 < len(stream.names):
            stream.name_at += 1
        else:
            self._counts[f"message interval rejected: {stream.name}"] += 1
            stream.settled, stream.answer, stream.next_ns = True, "rejects it", now_ns + RETRY_PERIOD_NS

    def _renew(self, stream: _Stream, now_ns: int) -> None:
        """Request a message again when its rate fell, and some time after it was rejected or did not reach its rate."""
        if not stream.settled:
            return
        hz = self._rates[stream.name].hz
        low = hz is not None and hz < LOW_SHARE * stream.rate_hz
        stream.arrived |= not (low or hz is None or stream.answer)
        if not (low or stream.answer) or (now_ns < stream.next_ns and not stream.arrived):
            return
        if not stream.answer:
            self._counts[f"message interval renewed: {stream.name}"] += 1
        stream.settled, stream.next_ns = False, now_ns

    def imu_rate_hz(self) -> float | None:
        """Rate at which IMU messages arrive; None: not measured yet."""
        rates = [rate.hz for name in self._imu_names if (rate := self._rates.get(name)) and rate.hz is not None]
        return max(rates, default=None)

    @property
    def status(self) -> str | None:
        """The IMU arrives too slowly, with what to do; None: fast enough, not measured yet, or not requested."""
        rate_hz = self.imu_rate_hz()
        if rate_hz is None or rate_hz >= NEEDED_IMU_HZ:
            return None
        stream = self._streams[0]
        if stream.denied_hz is not None:
            advice = f"the autopilot denied {stream.denied_hz:g} Hz: raise SCHED_LOOP_RATE"
        elif stream.answer:
            advice = f"the autopilot {stream.answer}: set its stream rates (ArduPilot SRn_RAW_SENS, PX4 MAV_n_MODE)"
        else:
            advice = (
                "the autopilot accepted more: is the link fast enough (PX4: MAV_n_RATE)? Does another station set it?"
            )
        return f"{stream.name} arrives at {rate_hz:.1f} Hz, at least {NEEDED_IMU_HZ:g} Hz are needed; {advice}"

    @property
    def counters(self) -> Mapping[str, int]:
        """Requests that were denied, rejected, not acknowledged or repeated, and the rate of the IMU."""
        rate_hz = self.imu_rate_hz()
        return dict(self._counts) | ({} if rate_hz is None else {"IMU rate [Hz]": round(rate_hz)})
