"""The simulated autopilot on a UDP socket, in real time: speaks, answers, and takes or leaves our poses by its rules.

What it says of its flight comes from `links.simulated.autopilot.autopilot.Autopilot`, sent when it is due; without one
it stands on the ground and says HEARTBEAT alone. It answers TIMESYNC, PARAM_REQUEST_READ and the request for its
origin, takes an origin where it has none, and reports its estimator five times a second as `rules` says.

    with AutopilotSocket(ArduPilotRules(), send_to=("127.0.0.1", port)) as drone:
        drone.wait_for(lambda: drone.rules.results[PoseResult.FUSED] > 10)

Source: ours; https://mavlink.io/en/services/timesync.html, /parameter.html; ArduPilot GCS_MAVLINK for who answers what.
"""

from __future__ import annotations

import select
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink.wire import FrameSplitter, header, packed, parse_frame
from links.simulated.autopilot.autopilot import Autopilot
from links.simulated.autopilot.px4_rules import Px4Rules
from links.simulated.autopilot.rules import Rules

mavlink: Any = ardupilotmega

Address = tuple[str, int]
STEP_S = 0.002  # how exactly a frame leaves when it is due
BOOT_NS = 100_000_000_000  # since boot when it begins, without a flight
REPORT_HZ = 5.0
PX4_TIMESYNC_HZ = 10.0
REQUEST_MESSAGE, GPS_GLOBAL_ORIGIN, UNSUPPORTED = 512, 49, 3
REAL32, INT32 = 9, 6  # MAV_PARAM_TYPE
MAX_RECEIVED = 10_000  # messages kept


class AutopilotSocket:
    """One autopilot. `heard` has (its clock [ns], message) of what came; `origin` is (lat, lon, alt) as MAVLink's."""

    def __init__(
        self,
        rules: Rules,
        *,
        send_to: Address | None = None,  # None: whoever speaks first is answered
        bind: Address = ("127.0.0.1", 0),
        flight: Autopilot | None = None,
        scenario_ns: Callable[[], int] = time.monotonic_ns,  # time in the flight's scenario
        parameters: Mapping[str, float] | None = None,
        origin: tuple[int, int, int] | None = None,
        system_id: int = 1,
        component_id: int = 1,
    ) -> None:
        self.rules, self.origin = rules, origin
        self.parameters = dict(parameters or {})
        self.received: deque[tuple[int, Any]] = deque(maxlen=MAX_RECEIVED)
        self.silent = False
        """Says and hears nothing while set: a radio in a shadow."""
        self._to_send: deque[Any] = deque()
        self._flight, self._scenario_ns = flight, scenario_ns
        self._begin_ns = scenario_ns()
        self._mav = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        self._own = (system_id, component_id)
        self._px4 = isinstance(rules, Px4Rules)
        self._peer = send_to
        self._splitter = FrameSplitter()
        self._changed = threading.Condition()
        self._closed = threading.Event()
        self._next_ns = {"report": 0, "timesync": 0, "beat": 0}
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(bind)
        self._socket.setblocking(False)
        self._thread = threading.Thread(target=self._run, name="simulated autopilot", daemon=True)

    def __enter__(self) -> AutopilotSocket:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._closed.set()
        self._thread.join()
        self._socket.close()

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._socket.getsockname()[1]

    def device_ns(self) -> int:
        """Its time since boot, now."""
        if self._flight is not None:
            return self._flight.device_ns(self._scenario_ns())
        return BOOT_NS + self._scenario_ns() - self._begin_ns

    def messages(self, kind: str) -> list[Any]:
        """What was heard of one type."""
        with self._changed:
            return [message for _, message in self.received if message.get_type() == kind]

    def wait_for(self, predicate: Callable[[], bool], timeout_s: float = 10.0) -> bool:
        """Wait until something is true; looked at with each message that comes."""
        with self._changed:
            return self._changed.wait_for(predicate, timeout_s)

    def send(self, message: Any) -> None:
        """Send a message, from its own thread."""
        self._to_send.append(message)

    def _run(self) -> None:
        while not self._closed.is_set():
            ready, _, _ = select.select([self._socket], [], [], STEP_S)
            if ready:
                try:
                    data, source = self._socket.recvfrom(2048)
                except OSError:  # the other side's port is closed just now
                    continue
                if not self.silent:
                    self._receive(data, source)
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
            self._answer(message)

    def _answer(self, message: Any) -> None:
        kind = message.get_type()
        if kind == "TIMESYNC" and message.tc1 == 0:
            self._send(mavlink.MAVLink_timesync_message(self.device_ns(), message.ts1))
        elif kind == "PARAM_REQUEST_READ" and message.param_id in self.parameters:
            self._send(self._parameter(message.param_id))
        elif kind == "COMMAND_LONG":
            asked = message.command == REQUEST_MESSAGE and message.param1 == GPS_GLOBAL_ORIGIN
            self._send(mavlink.MAVLink_command_ack_message(message.command, 0 if asked else UNSUPPORTED))
            if asked:
                self._send_origin()
        elif kind == "SET_GPS_GLOBAL_ORIGIN" and self.origin is None:
            self.origin = message.latitude, message.longitude, message.altitude
            self._send_origin()

    def _send_origin(self) -> None:
        if self.origin is not None:
            self._send(mavlink.MAVLink_gps_global_origin_message(*self.origin, self.device_ns() // 1000))

    def _parameter(self, name: str) -> Any:
        value = self.parameters[name]
        place = name.encode(), len(self.parameters), list(self.parameters).index(name)
        if self._px4 and value == int(value):
            held = struct.unpack("<f", struct.pack("<i", int(value)))[0]
            return mavlink.MAVLink_param_value_message(place[0], held, INT32, *place[1:])
        return mavlink.MAVLink_param_value_message(place[0], float(value), REAL32, *place[1:])

    def _send_due(self) -> None:
        while self._to_send:
            self._send(self._to_send.popleft())
        if self._flight is not None:
            for record in self._flight.records(self._scenario_ns()):
                if record.topic == "/autopilot/rx":
                    self._pass_on(record.data)
        elif self._due("beat", 1.0):
            beat = (2, 12 if self._px4 else 3, 0, 0, 3, 3)  # quadrotor, kind of autopilot, standby
            self._send(mavlink.MAVLink_heartbeat_message(*beat))
        if self._due("report", REPORT_HZ):
            with self._changed:
                report = self.rules.report(self.device_ns())
            self._send(report)
        if self._px4 and self._due("timesync", PX4_TIMESYNC_HZ):
            self._send(mavlink.MAVLink_timesync_message(0, self.device_ns()))

    def _pass_on(self, frame: bytes) -> None:
        """A frame of the flight, numbered with what is sent here; its answers to the simulated host are not ours."""
        message = parse_frame(frame)
        if not (message.get_type() == "TIMESYNC" and message.tc1 != 0):
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
        except OSError:  # nobody is there, or the buffer is full: as on a radio
            return
