"""The simulated autopilot on a UDP socket, in real time: it sends, replies, and uses external poses by its rules.

The messages about its flight come from `links.simulated.autopilot.autopilot.Autopilot`, each sent at its time. Without
a flight it is on the ground and sends HEARTBEAT, and the IMU when it is requested. It replies to TIMESYNC,
PARAM_REQUEST_READ and requests for its origin and for messages (`flight_stack/streams.py`), accepts an origin if it has
none, and reports its estimator five times a second according to `rules`.

    with AutopilotSocket(ArduPilotRules(), send_to=("127.0.0.1", port)) as drone:
        drone.wait_for(lambda: drone.rules.results[PoseResult.FUSED] > 10)

Source: ours; https://mavlink.io/en/services/timesync.html, /parameter.html; ArduPilot GCS_MAVLINK for the replies.
"""

from __future__ import annotations

import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink.transport.framing import FrameSplitter, header, packed, parse_frame
from links.simulated.autopilot.autopilot import STANDARD_GRAVITY_MPS2, Autopilot
from links.simulated.autopilot.flight_stack.commands import AUTOPILOT_VERSION, SET_MESSAGE_INTERVAL, version_message
from links.simulated.autopilot.flight_stack.streams import HIGHRES_IMU, RAW_IMU, Streams
from links.simulated.autopilot.px4_rules import Px4Rules
from links.simulated.autopilot.rules import Rules
from links.simulated.autopilot.udp_thread import UdpThread

mavlink: Any = ardupilotmega

Address = tuple[str, int]
BOOT_NS = 100_000_000_000  # time since boot at the start, without a flight
REPORT_HZ = 5.0
PX4_TIMESYNC_HZ = 10.0
REQUEST_MESSAGE, GPS_GLOBAL_ORIGIN, UNSUPPORTED = 512, 49, 3
REAL32, INT32 = 9, 6  # MAV_PARAM_TYPE
MAX_RECEIVED = 10_000  # received messages that are kept


class AutopilotSocket(UdpThread):
    """One autopilot. `received`: (time on its clock [ns], message); `origin`: (lat, lon, alt) in MAVLink's units."""

    def __init__(
        self,
        rules: Rules,
        *,
        send_to: Address | None = None,  # None: the sender of the first message
        bind: Address = ("127.0.0.1", 0),
        flight: Autopilot | None = None,
        scenario_ns: Callable[[], int] = time.monotonic_ns,  # time in the scenario of the flight
        parameters: Mapping[str, float] | None = None,
        origin: tuple[int, int, int] | None = None,
        system_id: int = 1,
        component_id: int = 1,
    ) -> None:
        super().__init__(bind, "simulated autopilot")
        self.rules, self.origin = rules, origin
        self.parameters = dict(parameters or {})
        self.received: deque[tuple[int, Any]] = deque(maxlen=MAX_RECEIVED)
        self.silent = False
        """While set it sends and receives nothing, as in a radio shadow."""
        self._to_send: deque[Any] = deque()
        self._flight, self._scenario_ns = flight, scenario_ns
        self._begin_ns = scenario_ns()
        self._mav = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        self._own = (system_id, component_id)
        self._px4 = isinstance(rules, Px4Rules)
        self._streams = Streams("px4" if self._px4 else "ardupilot", {}, ())
        self._peer = send_to
        self._splitter = FrameSplitter()
        self._changed = threading.Condition()
        self._next_ns = {"report": 0, "timesync": 0, "beat": 0}

    def device_ns(self) -> int:
        """Its current time since boot."""
        if self._flight is not None:
            return self._flight.device_ns(self._scenario_ns())
        return BOOT_NS + self._scenario_ns() - self._begin_ns

    def messages(self, kind: str) -> list[Any]:
        """The received messages of one type."""
        with self._changed:
            return [message for _, message in self.received if message.get_type() == kind]

    def wait_for(self, predicate: Callable[[], bool], timeout_s: float = 10.0) -> bool:
        """Wait until a condition holds; it is checked with each received message."""
        with self._changed:
            return self._changed.wait_for(predicate, timeout_s)

    def send(self, message: Any) -> None:
        """Send a message, from the thread of the socket."""
        self._to_send.append(message)

    def step(self, datagram: tuple[bytes, Address] | None) -> None:
        """Handle a datagram, and send what is due."""
        if datagram is not None and not self.silent:
            self._receive(*datagram)
        self._send_due()

    def _receive(self, data: bytes, source: Address) -> None:
        self._peer = self._peer or source
        for frame, message in self._splitter.datagram(data):
            if header(frame)[0] == self._own:
                continue
            with self._changed:
                now_ns = self.device_ns()
                self.received.append((now_ns, message))
                self.rules.receive(message, now_ns)
                self._changed.notify_all()
            self._handle(message)

    def _handle(self, message: Any) -> None:
        kind = message.get_type()
        if kind == "TIMESYNC" and message.tc1 == 0:
            self._send(mavlink.MAVLink_timesync_message(self.device_ns(), message.ts1))
        elif kind == "PARAM_REQUEST_READ" and message.param_id in self.parameters:
            self._send(self._parameter(message.param_id))
        elif kind == "COMMAND_LONG" and message.command == SET_MESSAGE_INTERVAL:
            result = self._streams.set_interval(round(message.param1), message.param2, message.param3)
            self._send(mavlink.MAVLink_command_ack_message(message.command, result))
        elif kind == "COMMAND_LONG" and (message.command, message.param1) == (REQUEST_MESSAGE, AUTOPILOT_VERSION):
            self._send(mavlink.MAVLink_command_ack_message(message.command, 0))
            self._send(version_message(self._px4))
        elif kind == "COMMAND_LONG":
            is_origin_request = message.command == REQUEST_MESSAGE and message.param1 == GPS_GLOBAL_ORIGIN
            self._send(mavlink.MAVLink_command_ack_message(message.command, 0 if is_origin_request else UNSUPPORTED))
            if is_origin_request:
                self._send_origin()
        elif kind == "SET_GPS_GLOBAL_ORIGIN" and self.origin is None:
            self.origin = message.latitude, message.longitude, message.altitude
            self._send_origin()

    def _send_origin(self) -> None:
        if self.origin is not None:
            self._send(mavlink.MAVLink_gps_global_origin_message(*self.origin, self.device_ns() // 1000))

    def _parameter(self, name: str) -> Any:
        value = self.parameters[name]
        count, index = len(self.parameters), list(self.parameters).index(name)
        if self._px4 and value == int(value):
            as_float = struct.unpack("<f", struct.pack("<i", int(value)))[0]
            return mavlink.MAVLink_param_value_message(name.encode(), as_float, INT32, count, index)
        return mavlink.MAVLink_param_value_message(name.encode(), float(value), REAL32, count, index)

    def _send_due(self) -> None:
        while self._to_send:
            self._send(self._to_send.popleft())
        if self._flight is not None:
            for record in self._flight.records(self._scenario_ns()):
                if record.topic == "/autopilot/rx":
                    self._forward(record.data)
        elif self._due("beat", 1.0):
            beat = (2, 12 if self._px4 else 3, 0, 0, 3, 3)  # quadrotor, autopilot type, standby
            self._send(mavlink.MAVLink_heartbeat_message(*beat))
        if self._flight is None:
            self._send_imu_at_rest()
        if self._due("report", REPORT_HZ):
            with self._changed:
                report = self.rules.report(self.device_ns())
            self._send(report)
        if self._px4 and self._due("timesync", PX4_TIMESYNC_HZ):
            self._send(mavlink.MAVLink_timesync_message(0, self.device_ns()))

    def _send_imu_at_rest(self) -> None:
        message_id, now_ns = HIGHRES_IMU if self._px4 else RAW_IMU, self.device_ns()
        if not (message_id in self._streams.requested and self._streams.passes(message_id, now_ns)):
            return
        if self._px4:
            at_rest = 0.0, 0.0, -STANDARD_GRAVITY_MPS2, *[0.0] * 10, 0b111111
            self._send(mavlink.MAVLink_highres_imu_message(now_ns // 1000, *at_rest))
        else:
            self._send(mavlink.MAVLink_raw_imu_message(now_ns // 1000, 0, 0, -1000, *[0] * 6))

    def _forward(self, frame: bytes) -> None:
        """Send a message of the flight with a sequence number of this socket, but no reply to the simulated host."""
        message = parse_frame(frame)
        is_reply = message.get_type() == "TIMESYNC" and message.tc1 != 0
        if not is_reply and self._streams.passes(message.get_msgId(), self.device_ns()):
            self._send(message)

    def _due(self, what: str, rate_hz: float) -> bool:
        now_ns = self.device_ns()
        if now_ns < self._next_ns[what]:
            return False
        self._next_ns[what] = now_ns + round(1e9 / rate_hz)
        return True

    def _send(self, message: Any) -> None:
        if self._peer is None or self.silent:
            return
        try:
            self._socket.sendto(packed(message, self._mav), self._peer)
        except OSError:  # no receiver, or the buffer is full: lost, as on a radio
            return
