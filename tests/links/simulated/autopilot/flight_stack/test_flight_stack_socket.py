"""The autopilot in the loop over real UDP, in real time."""

from __future__ import annotations

import socket
import time

import numpy as np

from links.mavlink.transport.framing import dialect, packed, parse_frame
from links.simulated.autopilot.autopilot import AutopilotSettings
from links.simulated.autopilot.flight_stack.flight_socket import FlightSocket
from links.simulated.autopilot.flight_stack.stack import FlightStack
from tests.links.simulated.autopilot.flight_stack.sent_truth import GROUND_M, HOVER, PARKED, START_NS


def test_it_flies_sends_and_answers_in_real_time() -> None:
    settings = AutopilotSettings.model_validate({"flight_stack": {"plan": [{"do": "hold", "for_s": 60}]}})
    stack = FlightStack(settings, HOVER, PARKED, GROUND_M, START_NS, 60.0, 1)
    stack.advance(START_NS + 100_000_000)  # compiles
    begin_ns = time.monotonic_ns()
    host = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    host.bind(("127.0.0.1", 0))
    host.settimeout(2.0)
    mav = dialect().MAVLink(None, srcSystem=1, srcComponent=197)
    frames = []
    with host, FlightSocket(stack, host.getsockname(), lambda: START_NS + time.monotonic_ns() - begin_ns) as flight:
        while time.monotonic_ns() - begin_ns < 3_000_000_000:
            data, source = host.recvfrom(2048)
            frames.append(parse_frame(data))
            if len(frames) == 50:
                host.sendto(packed(dialect().MAVLink_timesync_message(0, 99), mav), source)
        flight.advance(START_NS + 3_000_000_000)
        assert flight.received == 1
    kinds = {message.get_type() for message in frames}
    assert {"HEARTBEAT", "ATTITUDE", "LOCAL_POSITION_NED", "ODOMETRY", "RAW_IMU", "EKF_STATUS_REPORT"} <= kinds
    assert [m.ts1 for m in frames if m.get_type() == "TIMESYNC"] == [99]
    assert stack.motion.until_s >= 3.0
    assert np.linalg.norm(stack.quadrotor.state[0:3] - [7, 0, 10]) < 3.0
