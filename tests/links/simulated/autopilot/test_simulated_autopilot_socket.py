"""The simulated autopilot in real time: frames of a flight on a socket, received and stamped like real ones."""

from __future__ import annotations

import threading
import time
from collections import Counter

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import Record
from links.clock import host_time
from links.mavlink import Autopilot as Receiver
from links.mavlink.transport.connection import Endpoint, Udp
from links.mavlink.transport.framing import packed, parse_frame
from links.simulated.autopilot.ardupilot_rules import ArduPilotRules
from links.simulated.autopilot.autopilot import Autopilot, AutopilotSettings
from links.simulated.autopilot.autopilot_socket import AutopilotSocket
from links.simulated.world.flight import Flight
from links.simulated.world.path import Path, Waypoint
from stages.messages import AutopilotEstimator, DroneAttitude, DroneImu, DroneLocalPosition, DroneOdometry

START_NS, SECONDS = 1_748_773_230_000_000_000, 30.0
HOVER = Path(
    waypoints=(Waypoint(t_s=0.0, xyz_m=(0, 0, 10), yaw_deg=0), Waypoint(t_s=40.0, xyz_m=(8, 0, 10), yaw_deg=0))
)


def flying() -> Autopilot:
    settings = AutopilotSettings()
    return Autopilot(settings, Flight(HOVER, settings.flight, SECONDS, 1), START_NS, SECONDS, 1)


def test_a_flight_is_received_live_and_its_clock_is_found():
    link, began_ns = Receiver(connection="udpin:127.0.0.1:0"), time.monotonic_ns()
    scenario_ns = lambda: START_NS + time.monotonic_ns() - began_ns  # noqa: E731
    received: list[tuple[Record, object]] = []
    enough = threading.Event()

    def listen() -> None:
        for record in records:
            received.append((record, link.decode(record)))
            if link.counters["timesync replies"] >= 2:
                enough.set()

    with link.listen() as records:
        listener = threading.Thread(target=listen)
        listener.start()
        assert link.port is not None
        rules, autopilot = ArduPilotRules(), flying()
        with AutopilotSocket(
            rules, send_to=("127.0.0.1", link.port), flight=autopilot, scenario_ns=scenario_ns
        ) as drone:
            assert enough.wait(20)
            offset_ns = host_time.now_ns() - drone.device_ns()
    listener.join(5)
    kinds = Counter(type(message) for _, message in received)
    assert all(kinds[kind] for kind in (DroneAttitude, DroneLocalPosition, DroneOdometry, DroneImu, AutopilotEstimator))
    assert link.counters["lost"] < 0.05 * link.counters["decoded"]  # a saturated host loses a few
    rejected = link.counters.rejected
    assert set(rejected) <= {"not newer than the last one"}  # while the clock offset converges
    assert sum(rejected.values()) < 0.1 * link.counters["decoded"]
    clock = link._decoder.clock
    assert clock.offset_ns is not None
    assert clock.uncertainty_ns is not None
    assert abs(clock.offset_ns - offset_ns) <= clock.uncertainty_ns + 1_000_000
    ages_ms = np.array([r.arrival_ns - m.stamp_ns for r, m in received if isinstance(m, DroneAttitude)]) * 1e-6
    assert (ages_ms >= 0).all()


@pytest.fixture
def line():
    connection = Udp(Endpoint("udpin", "127.0.0.1", 0), None)
    yield connection
    connection.close()


def test_a_silent_radio_sends_and_receives_nothing(line: Udp):
    sender = ardupilotmega.MAVLink(None, srcSystem=1, srcComponent=197)
    beat = packed(ardupilotmega.MAVLink_heartbeat_message(18, 8, 0, 0, 3, 3), sender)
    with AutopilotSocket(ArduPilotRules(), send_to=("127.0.0.1", line.port)) as drone:
        received = line.receive(5.0)
        assert received is not None
        assert parse_frame(received[0]).get_type() in ("HEARTBEAT", "EKF_STATUS_REPORT")
        line.reply_to(received[1])
        line.send(beat)
        assert drone.wait_for(lambda: len(drone.received) == 1)
        drone.silent = True
        while line.receive(0.3) is not None:
            pass  # frames in transit
        line.send(beat)
        assert not drone.wait_for(lambda: len(drone.received) > 1, timeout_s=0.3)
        drone.silent = False
        assert line.receive(5.0) is not None


def test_its_own_frames_and_damaged_ones_are_ignored(line: Udp):
    own = ardupilotmega.MAVLink(None, srcSystem=1, srcComponent=1)
    other = ardupilotmega.MAVLink(None, srcSystem=1, srcComponent=197)
    beat = ardupilotmega.MAVLink_heartbeat_message(18, 8, 0, 0, 3, 3)
    with AutopilotSocket(ArduPilotRules()) as drone:
        line.reply_to(("127.0.0.1", drone.port))
        for data in (b"\xfd\x00noise", packed(beat, own), packed(beat, other)):
            line.send(data)
        assert drone.wait_for(lambda: len(drone.received) == 1)
        assert drone.received[0][1].get_srcComponent() == 197
