"""The link against a simulated autopilot on real sockets: received, fused and rejected poses, and their reports."""

from __future__ import annotations

import errno
import itertools
import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import LinkError, Record
from flow.stage import input_ports
from links.clock import host_time
from links.mavlink import Autopilot
from links.mavlink.autopilot_session import AutopilotSession
from links.mavlink.transport.framing import header, packed, parse_frame
from links.mavlink.transport.signing import AHEAD_TICKS
from links.simulated.autopilot.ardupilot_rules import ArduPilotRules
from links.simulated.autopilot.autopilot_socket import AutopilotSocket
from links.simulated.autopilot.px4_rules import Px4Rules
from links.simulated.autopilot.rules import PoseResult
from stages.geometry.frames import rotation_z
from stages.messages import AutopilotEstimator, DroneImu, PoseState, RelativePose
from tests.links.mavlink.mavlink_poses import good_pose
from tests.links.mavlink.transport.mavlink_bridges import Bridge

mavlink: Any = ardupilotmega
TICK_S = 0.02


class Listener:
    """A listening link, its records and messages; sends poses."""

    def __init__(self, link: Autopilot, records: Iterator[Record]) -> None:
        self.link = link
        self.records: list[Record] = []
        self.messages: list[Any] = []
        self._source = records
        self._pause = threading.Event()
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        for record in self._source:
            self.records.append(record)
            self.messages.append(self.link.decode(record))

    def send_poses(
        self, done: Callable[[], bool], pose: Callable[[int], RelativePose] = good_pose, max_poses: int = 500
    ) -> None:
        """Send current poses at about 50 Hz until `done`."""
        for _ in range(max_poses):
            if done():
                return
            self.link.on_pose(pose(host_time.now_ns()))
            self._pause.wait(TICK_S)
        pytest.fail(f"not within {max_poses} poses: {self.link.counters}")

    def wait(self, done: Callable[[], bool], max_poses: int = 500) -> None:
        """Wait without poses until `done`."""
        for _ in range(max_poses):
            if done():
                return
            self._pause.wait(TICK_S)
        pytest.fail(f"not within {max_poses * TICK_S:g} s: {self.link.counters}")


def bound_port(udp: socket.socket) -> int:
    udp.bind(("127.0.0.1", 0))
    return udp.getsockname()[1]


@contextmanager
def listening(**config: Any) -> Iterator[Listener]:
    link = Autopilot(**{"connection": "udpin:127.0.0.1:0", "yaw": "measured", **config})
    with link.listen() as records:
        listener = Listener(link, records)
        try:
            yield listener
        finally:
            pass
    listener.thread.join(5)
    assert not listener.thread.is_alive(), "the records did not end when the link was closed"


@contextmanager
def drone_for(listener: Listener, rules: Any, **settings: Any) -> Iterator[AutopilotSocket]:
    assert listener.link.port is not None
    with AutopilotSocket(rules, send_to=("127.0.0.1", listener.link.port), **settings) as drone:
        listener.wait(lambda: len(listener.records) > 0)  # its first frame: poses have a destination
        yield drone


def test_the_pose_is_an_optional_input():
    assert input_ports(Autopilot) == {"pose": RelativePose}
    assert Autopilot.optional_inputs == {"pose"}


@pytest.mark.parametrize("rules", [ArduPilotRules, Px4Rules])
def test_good_poses_are_fused_and_the_autopilot_reports_it(rules: Any):
    with listening() as listener, drone_for(listener, rules()) as drone:
        listener.send_poses(lambda: drone.rules.results[PoseResult.FUSED] >= 40)
        assert set(drone.rules.results) <= {
            PoseResult.FUSED,
            PoseResult.RESET,
            PoseResult.NOT_A_POSE,
            PoseResult.NOT_STARTED,
            PoseResult.TOO_SOON,
        }
        assert drone.rules.results[PoseResult.RESET] == 1  # the initial one
        assert drone.rules.estimate is not None
        np.testing.assert_allclose(drone.rules.estimate.xyz_m, [101, -2, -10], atol=0.5)
        statuses = [m for m in listener.messages if isinstance(m, AutopilotEstimator)]
        listener.send_poses(
            lambda: any(m.position_good for m in listener.messages if isinstance(m, AutopilotEstimator))
        )
        assert statuses[0].constant_position
        sent = [parse_frame(r.data).get_type() for r in listener.link.sent()]
        assert sent.count("ODOMETRY") == listener.link.counters["sent: ODOMETRY"]
    assert listener.link.counters["lost"] == 0


def test_sent_frames_are_recorded_unchanged_with_our_component_id():
    with listening() as listener, drone_for(listener, ArduPilotRules()) as drone:
        listener.send_poses(lambda: len(drone.messages("ODOMETRY")) >= 10)
        records = list(listener.link.sent())
        assert {r.topic for r in records} == {"/autopilot/tx"}
        assert {header(r.data)[0] for r in records} == {(1, 197)}
        numbers = [header(r.data)[1] for r in records]
        first = [(b - a) % 256 for a, b in itertools.pairwise(numbers)]
        assert set(first) == {1}  # none missing, in order
        arrived = {bytes(m.get_msgbuf()) for m in drone.messages("ODOMETRY")}
        assert arrived <= {r.data for r in records}
        assert list(listener.link.sent()) == [] or listener.link.counters["sent: HEARTBEAT"]  # returned once


def test_an_unresolved_branch_is_never_sent_and_the_reason_is_reported():
    with listening() as listener, drone_for(listener, ArduPilotRules()) as drone:
        wrong = rotation_z(np.pi / 2)
        listener.send_poses(
            lambda: any("AMBIGUOUS" in m.text for m in drone.messages("STATUSTEXT")),
            lambda ns: good_pose(ns, state=PoseState.AMBIGUOUS, R_map_drone=wrong, R_vehicle_drone=wrong),
        )
        assert drone.messages("ODOMETRY") == []
        assert drone.rules.estimate is None
        assert listener.link.counters["pose rejected: ambiguous rotation"] > 0


def test_stopping_is_reported_heartbeats_continue_and_resuming_resets():
    with listening() as listener, drone_for(listener, ArduPilotRules()) as drone:
        listener.send_poses(lambda: any(m.text == "grd: sending poses" for m in drone.messages("STATUSTEXT")))
        counter = drone.messages("ODOMETRY")[-1].reset_counter
        heartbeats = len(drone.messages("HEARTBEAT"))
        listener.wait(lambda: any(m.severity == 2 for m in drone.messages("STATUSTEXT")))
        listener.wait(lambda: len(drone.messages("HEARTBEAT")) >= heartbeats + 2)
        assert drone.messages("HEARTBEAT")[-1].system_status == mavlink.MAV_STATE_STANDBY
        assert not drone.rules.healthy(drone.device_ns())
        resets = drone.rules.results[PoseResult.RESET]
        listener.send_poses(lambda: drone.rules.results[PoseResult.RESET] > resets)
        assert drone.messages("ODOMETRY")[-1].reset_counter == (counter + 1) % 256
        heartbeat = drone.messages("HEARTBEAT")[0]
        assert (heartbeat.type, heartbeat.autopilot) == (
            mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
            mavlink.MAV_AUTOPILOT_INVALID,
        )


def test_a_blocked_autopilot_gets_no_poses():
    with listening() as listener, drone_for(listener, ArduPilotRules()) as drone:
        listener.send_poses(lambda: drone.rules.results[PoseResult.FUSED] >= 5)
        counter = drone.messages("ODOMETRY")[-1].reset_counter
        drone.silent = True
        listener.send_poses(
            lambda: listener.link.counters.get("pose rejected: autopilot silent", 0) >= 1, max_poses=150
        )
        sent = listener.link.counters["sent: ODOMETRY"]
        listener.send_poses(lambda: listener.link.counters["pose rejected: autopilot silent"] >= 25)
        assert listener.link.counters["sent: ODOMETRY"] == sent
        drone.silent = False
        listener.send_poses(lambda: drone.messages("ODOMETRY")[-1].reset_counter == (counter + 1) % 256)


def test_over_tcp_poses_are_sent_after_a_frame_on_this_connection():
    heartbeat = packed(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3), mavlink.MAVLink(None, 1, 1))
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        listening(connection=f"tcp:127.0.0.1:{server.getsockname()[1]}") as listener,
    ):

        def rejected() -> int:
            return listener.link.counters.get("pose rejected: autopilot silent", 0)

        def sent() -> int:
            return listener.link.counters.get("sent: ODOMETRY", 0)

        for connection in range(2):  # the kernel accepts bytes before the peer has accepted the connection
            rejected_before, sent_before = rejected(), sent()
            listener.send_poses(lambda before=rejected_before: rejected() >= before + 5)
            assert sent() == sent_before
            with server.accept()[0] as peer:
                peer.sendall(heartbeat)
                listener.send_poses(lambda before=sent_before: sent() > before)
            listener.wait(lambda connection=connection: listener.link.counters["reconnects"] > connection)


def test_half_a_frame_of_the_previous_connection_does_not_delay_the_new_one():
    """An incomplete frame would wait for its rest, and be stamped at its arrival."""
    mav = mavlink.MAVLink(None, 1, 1)
    long = packed(mavlink.MAVLink_statustext_message(6, b"x" * 50), mav)
    heartbeat = packed(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3), mav)
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        listening(connection=f"tcp:127.0.0.1:{server.getsockname()[1]}") as listener,
    ):
        with server.accept()[0] as peer:
            peer.sendall(heartbeat + long[:20])
            listener.wait(lambda: len(listener.records) == 1)
        listener.wait(lambda: listener.link.counters["reconnects"] == 1)
        with server.accept()[0] as peer:
            peer.sendall(heartbeat)
            listener.wait(lambda: len(listener.records) == 2, max_poses=100)
        assert listener.link.counters["stray bytes"] == 20


def test_timesync_is_requested_and_replied_to():
    with listening() as listener, drone_for(listener, Px4Rules()) as drone:
        before_ns = host_time.now_ns()
        listener.wait(lambda: any(m.tc1 != 0 for m in drone.messages("TIMESYNC")))
        reply = next(m for m in drone.messages("TIMESYNC") if m.tc1 != 0)
        assert before_ns - 10**10 < reply.tc1 <= host_time.now_ns()  # host time
        assert 0 < reply.ts1 <= drone.device_ns()  # its own time, returned
        listener.wait(
            lambda: listener.link.counters["timesync replies"] >= 1
        )  # replies to ours; ESTIMATOR_STATUS has a time stamp


def test_no_poses_over_a_bridge_that_forwards_them_late_and_stopping_is_reported():
    with (
        listening() as listener,
        Bridge(listener.link.port or 0) as bridge,
        AutopilotSocket(ArduPilotRules(), send_to=("127.0.0.1", bridge.port)) as drone,
    ):
        listener.send_poses(lambda: drone.rules.results[PoseResult.FUSED] >= 5)
        counter = drone.messages("ODOMETRY")[-1].reset_counter
        bridge.delay_s = 0.6
        listener.send_poses(lambda: listener.link.counters.get("pose rejected: link too slow", 0) >= 1)
        sent = listener.link.counters["sent: ODOMETRY"]
        listener.send_poses(lambda: listener.link.counters["pose rejected: link too slow"] >= 25)
        assert listener.link.counters["sent: ODOMETRY"] == sent
        assert listener.link.counters["round trip [ms]"] >= 600
        assert "TIMESYNC replies take longer than 0.3 s" in (listener.link.status or "")
        text = "grd: STOPPED: link too slow"
        listener.wait(lambda: any((m.severity, m.text) == (2, text) for m in drone.messages("STATUSTEXT")))
        assert listener.link.counters["sent: ODOMETRY"] == sent
        prompt_us = host_time.now_ns() // 1000
        bridge.delay_s = 0.0
        listener.send_poses(lambda: drone.messages("ODOMETRY")[-1].time_usec > prompt_us)
        assert next(m for m in drone.messages("ODOMETRY") if m.time_usec > prompt_us).reset_counter != counter
        listener.wait(lambda: listener.link.status is None)


@pytest.mark.parametrize(("rules", "profile"), [(ArduPilotRules, "ardupilot"), (Px4Rules, "px4")])
def test_the_imu_arrives_at_the_requested_rate_and_its_stamps_are_its_samples(rules: type, profile: str):
    with (
        listening(profile=profile, message_rates={"imu_hz": 40.0}) as listener,
        drone_for(listener, rules()) as drone,
    ):
        assert drone.port
        listener.wait(lambda: listener.link.counters.get("IMU rate [Hz]", 0) >= 30)
        assert listener.link.status is None
        imu = [(r, m) for r, m in zip(listener.records, listener.messages, strict=False) if isinstance(m, DroneImu)]
    np.testing.assert_allclose(imu[-1][1].acceleration_drone_mps2, [0, 0, 9.80665], atol=0.005)  # half a count
    delay_ms = 12.5 if profile == "ardupilot" else 2.0
    assert imu[-1][0].arrival_ns - imu[-1][1].stamp_ns >= 1e6 * delay_ms


def test_an_unrequested_timesync_reply_is_ignored_although_it_has_no_target():
    with listening() as listener, drone_for(listener, Px4Rules()) as drone:
        listener.wait(lambda: listener.link.counters["timesync replies"] >= 2)
        drone.send(mavlink.MAVLink_timesync_message(drone.device_ns(), host_time.now_ns() - 1000))
        listener.wait(lambda: listener.link.counters.get("rejected: TIMESYNC for another component", 0) == 1)
        before = listener.link.counters["timesync replies"]
        listener.wait(lambda: listener.link.counters["timesync replies"] > before)
    replayed = Autopilot(own_component_id=191)
    for record in listener.records:
        replayed.decode(record)
    assert replayed.counters["timesync replies"] == listener.link.counters["timesync replies"]


def test_an_origin_is_sent_to_an_autopilot_without_one_and_never_over_another():
    origin = {"latitude_deg": 47.3977, "longitude_deg": 8.5456, "altitude_m": 488.0}
    own, existing = (473977000, 85456000, 488000), (1, 2, 3)
    with listening(global_origin=origin) as listener, drone_for(listener, ArduPilotRules()) as drone:
        listener.wait(lambda: drone.origin == own)
    with listening(global_origin=origin) as listener, drone_for(listener, ArduPilotRules(), origin=existing) as drone:
        listener.wait(lambda: len(drone.messages("TIMESYNC")) >= 3)  # two seconds later
        assert drone.messages("SET_GPS_GLOBAL_ORIGIN") == []
        assert [m.command for m in drone.messages("COMMAND_LONG")].count(512) == 1
        assert drone.origin == existing


def test_both_sides_of_a_signed_link_accept_each_other_and_unsigned_frames_are_ignored(tmp_path: Path):
    key = tmp_path / "key"
    key.write_bytes(b"k" * 32)
    key.chmod(0o600)
    with listening(signing_key=str(key)) as listener:
        drone = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        drone.signing.timestamp = (host_time.now_ns() - 1_420_070_400 * 10**9) // 10_000
        heartbeat = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            udp.bind(("127.0.0.1", 0))
            udp.settimeout(5.0)
            udp.sendto(packed(heartbeat, drone), ("127.0.0.1", listener.link.port))
            listener.wait(lambda: listener.link.counters.get("not signed with our key", 0) == 1)
            assert listener.records == []
            drone.signing.secret_key, drone.signing.sign_outgoing = b"k" * 32, True
            udp.sendto(packed(heartbeat, drone), ("127.0.0.1", listener.link.port))
            listener.wait(lambda: len(listener.records) == 1)
            listener.link.on_pose(good_pose(host_time.now_ns()))
            assert drone.decode(bytearray(udp.recv(300))).get_signed()  # pymavlink verifies the signature
    assert (tmp_path / "key.timestamp").exists()


def signing_drone(folder: Path, days_ago: int = 0) -> tuple[Path, mavlink.MAVLink]:
    """A key file, and a peer that signs with it and whose clock is late."""
    key = folder / "key"
    key.write_bytes(b"k" * 32)
    key.chmod(0o600)
    drone = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    drone.signing.secret_key, drone.signing.sign_outgoing = b"k" * 32, True
    since_2015_ns = host_time.now_ns() - 1_420_070_400 * 10**9
    drone.signing.timestamp = since_2015_ns // 10_000 - days_ago * 86_400 * 100_000
    return key, drone


def test_an_autopilot_without_a_clock_gets_the_time_first_and_no_poses_until_it_signs_correctly(tmp_path: Path):
    """ArduPilot starts with its last time stamp and adopts that of a newer signed frame."""
    key, drone = signing_drone(tmp_path, days_ago=10)
    heartbeat = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3)
    with listening(signing_key=str(key)) as listener, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        udp.settimeout(3.0)
        udp.sendto(packed(heartbeat, drone), ("127.0.0.1", listener.link.port))
        listener.wait(lambda: listener.link.counters.get("signed with our key, but not new", 0) == 1)
        listener.link.on_pose(good_pose(host_time.now_ns()))
        assert drone.decode(bytearray(udp.recv(300))).get_type() in ("HEARTBEAT", "TIMESYNC", "STATUSTEXT")
        assert listener.records == []
        assert listener.link.counters["pose rejected: autopilot silent"] == 1
        udp.sendto(packed(heartbeat, drone), ("127.0.0.1", listener.link.port))
        listener.wait(lambda: len(listener.records) == 1)
        listener.link.on_pose(good_pose(host_time.now_ns()))
        assert listener.link.counters["sent: ODOMETRY"] == 1


def test_a_replayed_signed_frame_does_not_redirect_the_poses(tmp_path: Path):
    key, drone = signing_drone(tmp_path)
    frame = packed(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3), drone)
    with (
        listening(signing_key=str(key)) as listener,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        udp.settimeout(3.0)
        udp.sendto(frame, ("127.0.0.1", listener.link.port))
        listener.wait(lambda: len(listener.records) == 1)
        other.sendto(frame, ("127.0.0.1", listener.link.port))
        listener.wait(lambda: listener.link.counters.get("signed with our key, but not new", 0) == 1)
        listener.link.on_pose(good_pose(host_time.now_ns()))
        while parse_frame(udp.recv(300)).get_type() != "ODOMETRY":
            pass


def test_a_slow_disk_for_the_signing_time_delays_no_pose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    key = tmp_path / "key"
    key.write_bytes(b"k" * 32)
    key.chmod(0o600)
    writing, release, released = threading.Event(), threading.Event(), list[bool]()

    def slow(descriptor: int) -> None:
        writing.set()
        released.append(release.wait(5))

    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp,
        listening(connection=f"udpout:127.0.0.1:{bound_port(udp)}", signing_key=str(key)) as listener,
    ):
        session = listener.link._session
        assert session is not None
        assert session._signer is not None
        monkeypatch.setattr("links.mavlink.transport.signing.os.fsync", slow)
        session._signer._reserved = session._signer._used + AHEAD_TICKS // 4  # a write is due, but not urgent
        listener.wait(writing.is_set)
        listener.link.on_pose(good_pose(host_time.now_ns()))
        session._signer._reserved = 0  # it is blocked until all reserved times are used
        listener.link.on_pose(good_pose(host_time.now_ns()))
        assert listener.link.counters["sent: ODOMETRY"] == 2
        release.set()
    assert all(released)


def test_each_opening_of_a_link_writes_the_signing_time_before_signing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(AutopilotSession, "_run", lambda session: None)  # without the thread
    key, _ = signing_drone(tmp_path)
    link = Autopilot(connection="udpin:127.0.0.1:0", signing_key=key)
    for _ in range(2):
        with link.listen():
            assert link._signer is not None
            assert int((tmp_path / "key.timestamp").read_text()) > link._signer._used + AHEAD_TICKS // 2


def test_a_full_disk_for_the_signing_time_stops_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    key, drone = signing_drone(tmp_path)
    heartbeat = packed(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3), drone)

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp, listening(signing_key=str(key)) as listener:
        session = listener.link._session
        assert session is not None
        signer = session._signer
        assert signer is not None
        monkeypatch.setattr("links.mavlink.transport.signing.os.fsync", full)
        signer._reserved = 0
        listener.wait(lambda: listener.link.counters.get("signing time not written", 0) == 1)
        assert "signing time cannot be written" in (listener.link.status or "")
        udp.sendto(heartbeat, ("127.0.0.1", listener.link.port))
        listener.wait(lambda: len(listener.records) == 1)
        listener.link.on_pose(good_pose(host_time.now_ns()))
        assert listener.link.counters["sent: ODOMETRY"] == 1
    with listener.link.listen():  # reopened in the same run: times never decrease
        assert listener.link._session is not None
        assert listener.link._session._signer is signer


def test_other_senders_on_the_port_are_ignored_and_get_no_poses():
    with listening(sender="127.0.0.9") as listener:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            frame = packed(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3), mavlink.MAVLink(None, 1, 1))
            other.sendto(frame, ("127.0.0.1", listener.link.port))
            listener.wait(lambda: listener.link.counters["from other senders"] == 1)
        listener.link.on_pose(good_pose(host_time.now_ns()))
        assert listener.link.counters["not sent: ODOMETRY"] == 1
    assert listener.records == []


def test_another_system_on_the_same_address_is_recorded_and_gets_no_poses():
    station = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with listening() as listener, drone_for(listener, ArduPilotRules()) as drone, station:
        station.settimeout(0.1)
        frame = packed(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), mavlink.MAVLink(None, 255, 190))
        station.sendto(frame, ("127.0.0.1", listener.link.port))
        listener.wait(lambda: any(r.data == frame for r in listener.records))
        listener.send_poses(lambda: len(drone.messages("ODOMETRY")) >= 5)
        with pytest.raises(TimeoutError):
            station.recv(300)
    assert listener.link.counters["rejected: from another system"] == 1


def test_echoes_of_our_own_frames_are_ignored():
    with listening() as listener:
        own = mavlink.MAVLink(None, srcSystem=1, srcComponent=197)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radio:
            heartbeat = mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 3, 3)
            radio.sendto(packed(heartbeat, own), ("127.0.0.1", listener.link.port))
            listener.wait(lambda: listener.link.counters.get("echo of our own", 0) == 1)
    assert listener.records == []


def test_a_silent_autopilot_is_reported_by_the_status(monkeypatch: pytest.MonkeyPatch):
    with listening() as listener:
        assert listener.link.status is None
        real = host_time.now_ns()
        session = listener.link._session  # the clock of the session, set ahead
        assert session is not None
        monkeypatch.setattr(session, "_now_ns", lambda: real + 10**10)
        assert "no frame from the autopilot (system 1, component 1)" in (listener.link.status or "")
    assert listener.link.status is None


@given(datagrams=st.lists(st.binary(min_size=1, max_size=400), min_size=1, max_size=20))
@settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
def test_no_datagram_stops_the_link(datagrams: list[bytes]):
    with listening() as listener, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as anyone:
        for data in datagrams:
            anyone.sendto(data, ("127.0.0.1", listener.link.port))
        heartbeat = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3)
        anyone.sendto(packed(heartbeat, mavlink.MAVLink(None, 1, 1)), ("127.0.0.1", listener.link.port))
        listener.wait(lambda: any(m is not None for m in listener.messages))
    counted = listener.link.counters["stray bytes"] + sum(len(r.data) for r in listener.records)
    assert counted == sum(map(len, datagrams)) + 21


def test_poses_while_the_link_is_closed_are_counted_and_not_sent():
    link = Autopilot(connection="udpin:127.0.0.1:0")
    link.on_pose(good_pose())
    assert link.counters["poses while not connected"] == 1
    assert list(link.sent()) == []
    with link.listen():
        pass
    link.on_pose(good_pose())
    assert link.counters["poses while not connected"] == 2


def test_without_a_connection_listening_is_an_error_that_names_the_setting():
    with pytest.raises(LinkError, match="set `connection`"), Autopilot().listen():
        pass


@pytest.mark.parametrize(
    ("config", "expected_text"),
    [
        ({"connection": "udp:14550"}, "udpin:127.0.0.1:14550"),
        ({"connection": "udpin:0.0.0.0:14550"}, "sender"),
        ({"send": ["odometry", "vision_position_estimate"]}, "fused twice"),
        ({"send": ["odometry", "odometry"]}, "at most once"),
        ({"profile": "px4", "send": ["vision_position_estimate"]}, "cannot be a position without yaw"),
        ({"profile": "px4", "send": ["landing_target"]}, "local NED"),
        ({"own_component_id": 1}, "must differ from the autopilot's component_id"),
    ],
)
def test_dangerous_settings_are_rejected_with_the_reason(config: Any, expected_text: str):
    with pytest.raises(ValidationError, match=expected_text):
        Autopilot(**config)
