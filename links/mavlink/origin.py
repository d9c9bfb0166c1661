"""Global origin of the local frame: sent to an autopilot that has none, and never to one that has one.

An EKF without GPS needs an origin before it fuses a position. The autopilot is asked for its origin first
(GPS_GLOBAL_ORIGIN). Ours is sent only after three requests that it acknowledged without reporting an origin; a second
acknowledgement of one request, or one that names another requester, is not ours. An autopilot that does not support the
request gets no origin, because its state is unknown. An EKF that is not ready ignores an origin: it is sent again after
each further request without an origin, until GPS_GLOBAL_ORIGIN confirms it. All of this starts again after a silence or
a reboot.

Source: https://mavlink.io/en/messages/common.html#SET_GPS_GLOBAL_ORIGIN; ArduPilot NavEKF3_core::setOrigin (rejects a
second origin; older versions did not).
"""

from __future__ import annotations

import enum
from typing import Any

from pydantic import Field

from flow.stage import StrictModel
from links.mavlink.commands import ACCEPTED, DENIED, FAILED, command_long, is_answer
from links.mavlink.transport.framing import dialect

REQUEST_MESSAGE, GPS_GLOBAL_ORIGIN = 512, 49  # MAV_CMD, message id
HAS_NONE = (ACCEPTED, DENIED, FAILED)  # accepted (and sends nothing), denied, failed: it supports the message
REQUEST_PERIOD_NS = 1_000_000_000  # period of requests
REQUESTS = 3
UNCONFIRMED = 10  # times that an origin is sent before it is reported


class GlobalOrigin(StrictModel):
    """A WGS84 position; altitude above mean sea level."""

    latitude_deg: float = Field(ge=-90, le=90)
    longitude_deg: float = Field(ge=-180, le=180)
    altitude_m: float = Field(ge=-1000, le=10_000)


class OriginState(enum.Enum):
    """Progress of an OriginSender."""

    NOT_CONFIGURED = "no origin configured"
    REQUESTING = "requesting the autopilot's origin"
    SENT = "origin sent, not confirmed"
    CONFIRMED = "the autopilot has confirmed the origin"
    PRESENT = "the autopilot has an origin"
    UNSUPPORTED = "the autopilot does not report its origin"


class OriginSender:
    """Requests the autopilot's origin, and sends ours if it has none."""

    def __init__(self, origin: GlobalOrigin | None, target: tuple[int, int], own: tuple[int, int]) -> None:
        self.state = OriginState.NOT_CONFIGURED if origin is None else OriginState.REQUESTING
        self._origin, self._target, self._own = origin, target, own
        self._requested_ns: int | None = None
        self._unconfirmed = 0  # times that it was sent since the (re)start
        self._replies = 0
        self._replied = False  # to the newest request
        self.sent_times = 0
        """How often it was sent."""

    @property
    def done(self) -> bool:
        """Whether nothing remains to be sent."""
        return self.state not in (OriginState.REQUESTING, OriginState.SENT)

    @property
    def status(self) -> str | None:
        """Error text when the autopilot does not confirm the origin."""
        if self.state is OriginState.SENT and self._unconfirmed >= UNCONFIRMED:
            return "the autopilot does not confirm the origin (SET_GPS_GLOBAL_ORIGIN): read its own messages"
        return None

    def due(self, now_ns: int) -> list[Any]:
        """Messages to send now."""
        if self.done or self._origin is None:
            return []
        if self._requested_ns is not None and now_ns - self._requested_ns < REQUEST_PERIOD_NS:
            return []
        if self._replies >= (REQUESTS if self.state is OriginState.REQUESTING else 1):
            self.state, self._replies, self._requested_ns = OriginState.SENT, 0, now_ns
            self.sent_times += 1
            self._unconfirmed += 1
            return [
                dialect().MAVLink_set_gps_global_origin_message(
                    self._target[0],
                    round(1e7 * self._origin.latitude_deg),
                    round(1e7 * self._origin.longitude_deg),
                    round(1e3 * self._origin.altitude_m),
                    now_ns // 1000,
                )
            ]
        self._requested_ns, self._replied = now_ns, False
        return [command_long(self._target, REQUEST_MESSAGE, float(GPS_GLOBAL_ORIGIN))]

    def restart(self) -> None:
        """Start again: the autopilot was silent, and may have rebooted without an origin."""
        if self._origin is not None:
            self.state, self._replies, self._replied, self._requested_ns = OriginState.REQUESTING, 0, False, None
            self._unconfirmed = 0

    def on_not_sent(self) -> None:
        """The messages of `due` could not be sent."""
        if self.state is OriginState.SENT:
            self._replies, self._requested_ns = REQUESTS, None
            self.sent_times -= 1
            self._unconfirmed -= 1

    def on_message(self, message: Any) -> None:
        """Take a message of the autopilot."""
        if self.done:
            return
        kind = message.get_type()
        if kind == "GPS_GLOBAL_ORIGIN":
            self.state = OriginState.CONFIRMED if self.state is OriginState.SENT else OriginState.PRESENT
        elif is_answer(message, REQUEST_MESSAGE, self._own) and self._requested_ns is not None:
            if message.result in HAS_NONE:
                self._replies += not self._replied  # further ones reply to another requester
                self._replied = True
            else:
                self.state = OriginState.UNSUPPORTED
