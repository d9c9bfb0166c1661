"""Which message goes out when: message intervals, and MAV_CMD_SET_MESSAGE_INTERVAL as ArduPilot and PX4 treat it.

ArduPilot keeps intervals in whole milliseconds (the request is truncated), denies what is faster than 80 % of its loop
period, and lowers the rates of a slow port. Its scheduler sends at multiples of its loop.

Source: ArduPilot GCS_Common.cpp (set_message_interval, cap_message_interval), https://mavlink.io/en/messages/
common.html#MAV_CMD_SET_MESSAGE_INTERVAL, https://github.com/ArduPilot/ardupilot/pull/28019 (third parameter); PX4
mavlink_main.cpp (configure_stream).
"""

from __future__ import annotations

from links.simulated.kernels.motion import STEP_S

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED = 0, 1, 2, 3, 4  # MAV_RESULT
HEARTBEAT, SYS_STATUS, ATTITUDE, LOCAL_POSITION_NED, ODOMETRY = 0, 1, 30, 32, 331
RAW_IMU, SCALED_IMU, HIGHRES_IMU, EKF_STATUS_REPORT, ESTIMATOR_STATUS, GPS_RAW_INT = 27, 26, 105, 193, 230, 24
NS = 1_000_000_000
EARLY = 0.9  # a message of a plan passes after this share of its interval: plan and interval beat otherwise

OF_BOTH = HEARTBEAT, ATTITUDE, LOCAL_POSITION_NED, ODOMETRY, GPS_RAW_INT
KNOWN = {
    "ardupilot": (*OF_BOTH, RAW_IMU, SCALED_IMU, EKF_STATUS_REPORT),
    "px4": (*OF_BOTH, HIGHRES_IMU, ESTIMATOR_STATUS),
}


class Streams:
    """Intervals [ns] of the messages, and which are due."""

    def __init__(self, kind: str, rates_hz: dict[int, float], denied: tuple[int, ...]) -> None:
        """`rates_hz`: at the start, as SRn_* or the mavlink mode give them; 0: not sent."""
        self._kind, self._denied = kind, denied
        self._default = {message: rates_hz.get(message, 0.0) for message in KNOWN[kind]}
        self._interval_ns = {m: round(NS / hz) if hz else 0 for m, hz in self._default.items()}
        self._next_ns: dict[int, int] = {}
        self.requested: set[int] = set()
        """Messages whose interval a station has set."""
        self._passed_ns: dict[int, int] = {}

    def passes(self, message: int, device_ns: int) -> bool:
        """Whether a message that a plan sends at other times is sent now; True without a request."""
        interval_ns = self._interval_ns.get(message, 0)
        if message not in self.requested:
            return True
        if not interval_ns or device_ns - self._passed_ns.get(message, -interval_ns) < EARLY * interval_ns:
            return False
        self._passed_ns[message] = device_ns
        return True

    def due(self, device_ns: int) -> list[int]:
        """Messages to send at this step of the main loop, by id."""
        found: list[int] = []
        for message, interval_ns in self._interval_ns.items():
            if not interval_ns:
                continue
            at_ns = self._next_ns.get(message)
            if at_ns is None:
                at_ns = device_ns - device_ns % interval_ns + interval_ns
                self._next_ns[message] = at_ns
            if device_ns >= at_ns:
                late = device_ns - at_ns >= interval_ns
                self._next_ns[message] = device_ns + interval_ns if late else at_ns + interval_ns
                found.append(message)
        return found

    def set_interval(self, message: int, interval_us: float, third: float = 0.0) -> int:
        """MAV_CMD_SET_MESSAGE_INTERVAL with its three parameters; returns the MAV_RESULT of its ACK."""
        if third and self._kind == "ardupilot":
            return DENIED
        if message not in self._interval_ns:
            return FAILED if self._kind == "ardupilot" else DENIED
        if message in self._denied:
            return DENIED
        if interval_us == 0:
            hz = self._default[message]
            interval_ns = round(NS / hz) if hz else 0
        elif interval_us < 0:
            interval_ns = 0
        else:
            interval_ns = int(interval_us) * 1000
            if self._kind == "ardupilot":
                interval_ns = max(int(interval_us) // 1000, 1) * 1_000_000
                if interval_ns * 0.8 < STEP_S * NS:
                    return DENIED
        self._interval_ns[message] = interval_ns
        self._next_ns.pop(message, None)
        (self.requested.discard if interval_us == 0 else self.requested.add)(message)
        return ACCEPTED

    def interval_us(self, message: int) -> int | None:
        """For MESSAGE_INTERVAL: -1: not sent; None: unknown message."""
        interval_ns = self._interval_ns.get(message)
        if interval_ns is None:
            return None
        return interval_ns // 1000 if interval_ns else -1

    def restart(self) -> None:
        """After a reboot: the rates of the start again."""
        self._interval_ns = {m: round(NS / hz) if hz else 0 for m, hz in self._default.items()}
        self._next_ns.clear()
        self.requested.clear()
