"""Where on earth the local frame begins: given to an autopilot that has no such origin, never put over one it has.

An EKF without GPS wants an origin before it fuses a position. It is asked for its own first (GPS_GLOBAL_ORIGIN); only
when it answers that request and still shows none, three times, is ours sent; a second answer to one request is
somebody else's. An autopilot that cannot be asked gets none: nobody knows what it has.

Source: https://mavlink.io/en/messages/common.html#SET_GPS_GLOBAL_ORIGIN; ArduPilot NavEKF3_core::setOrigin (refuses a
second one; older versions did not).
"""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from links.mavlink.framing import dialect

REQUEST_MESSAGE, GPS_GLOBAL_ORIGIN = 512, 49  # MAV_CMD, message id
HAS_NONE = (0, 2, 4)  # MAV_RESULT accepted (and sends nothing), denied, failed: it knows the message
ASK_NS = 1_000_000_000
ASKED_OFTEN = 3


class GlobalOrigin(BaseModel):
    """A place on earth (WGS84, altitude over mean sea level)."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    latitude_deg: float = Field(ge=-90, le=90)
    longitude_deg: float = Field(ge=-180, le=180)
    altitude_m: float = Field(ge=-1000, le=10_000)


class OriginSender:
    """Asks, and gives the origin where there is none. `state` says in words how far it is."""

    def __init__(self, origin: GlobalOrigin | None, target: tuple[int, int]) -> None:
        self.state = "none configured" if origin is None else "asking"
        self._origin, self._target = origin, target
        self._asked_ns: int | None = None
        self._answers = 0
        self._answered = False  # since it was asked last

    @property
    def done(self) -> bool:
        """Whether there is nothing left to do."""
        return self.state != "asking"

    def due(self, now_ns: int) -> list[Any]:
        """What is to be sent now."""
        if self.done or self._origin is None:
            return []
        if self._asked_ns is not None and now_ns - self._asked_ns < ASK_NS:
            return []
        if self._answers >= ASKED_OFTEN:
            self.state = "given"
            return [
                dialect().MAVLink_set_gps_global_origin_message(
                    self._target[0],
                    round(1e7 * self._origin.latitude_deg),
                    round(1e7 * self._origin.longitude_deg),
                    round(1e3 * self._origin.altitude_m),
                    now_ns // 1000,
                )
            ]
        self._asked_ns, self._answered = now_ns, False
        return [
            dialect().MAVLink_command_long_message(
                *self._target, REQUEST_MESSAGE, 0, float(GPS_GLOBAL_ORIGIN), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            )
        ]

    def restart(self) -> None:
        """The autopilot was away: it may have been started again, and have none."""
        if self._origin is not None:
            self.state, self._answers, self._answered, self._asked_ns = "asking", 0, False, None

    def unsent(self) -> None:
        """What was due could not be sent."""
        if self.state == "given":
            self.state = "asking"

    def hear(self, message: Any) -> None:
        """Take note of the autopilot's answers."""
        if self.done:
            return
        kind = message.get_type()
        if kind == "GPS_GLOBAL_ORIGIN":
            self.state = "it has one"
        elif kind == "COMMAND_ACK" and message.command == REQUEST_MESSAGE and self._asked_ns is not None:
            if message.result in HAS_NONE:
                self._answers += not self._answered  # what else comes answers somebody else's request
                self._answered = True
            else:
                self.state = "it cannot be asked"
