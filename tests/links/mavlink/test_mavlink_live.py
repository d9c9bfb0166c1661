"""The link against a simulated autopilot on real sockets: what arrives, what is fused, what stops and how it is told."""

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
from mavlink_bridges import Bridge
from mavlink_poses import good_pose
from pydantic import ValidationError
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import LinkError, Record
from flow.stage import input_ports
from links import host_time
from links.mavlink import Autopilot
from links.mavlink.session import Session
from links.mavlink.signing import AHEAD_TICKS
from links.mavlink.wire import header, packed, parse_frame
from links.simulated.autopilot.ardupilot_rules import ArduPilotRules
from links.simulated.autopilot.autopilot_socket import AutopilotSocket
from links.simulated.autopilot.px4_rules import Px4Rules
from links.simulated.autopilot.rules import PoseResult
from stages.geometry.frames import rotation_z
from stages.messages import AutopilotEstimator, PoseState, RelativePose

mavlink: Any = ardupilotmega
TICK_S = 0.02


class Heard:
    """A listening link, its records and messages, and a clock of poses."""

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

    def fly(self, done: Callable[[], bool], pose: Callable[[int], RelativePose] = good_pose, most: int = 500) -> None:
        """Send poses of now, some 50 a second, until something is true."""
        for _ in range(most):
            if done():
                return
            self.link.on_pose(pose(host_time.now_ns()))
            self._pause.wait(TICK_S)
        pytest.fail(f"not within {most} poses: {self.link.counters}")

    def rest(self, done: Callable[[], bool], most: int = 500) -> None:
        """Wait without poses until something is true."""
        for _ in range(most):
            if done():
                return
            self._pause.wait(TICK_S)
        pytest.fail(f"not within {most * TICK_S:g} s: {self.link.counters}")


def bound_port(udp: socket.socket) -> int:
    udp.bind(("127.0.0.1", 0))
    return udp.getsockname()[1]


@contextmanager
def listening(**config: Any) -> Iterator[Heard]:
    link = Autopilot(**{"connection": "udpin:127.0.0.1:0", **config})
    with link.listen() as records:
        heard = Heard(link, records)
        try:
            yield heard
        finally:
            pass
    heard.thread.join(5)
    assert not heard.thread.is_alive(), "the records did not end when the link was closed"


@contextmanager
def drone_for(heard: Heard, rules: Any, **settings: Any) -> Iterator[AutopilotSocket]:
    assert heard.link.port is not None
    with AutopilotSocket(rules, send_to=("127.0.0.1", heard.link.port), **settings) as drone:
        heard.rest(lambda: len(heard.records) > 0)  # it has spoken: poses have somewhere to go
        yield drone


def test_the_pose_is_an_optional_input():
    assert input_ports(Autopilot) == {"pose": RelativePose}
    assert Autopilot.optional_inputs == {"pose"}


@pytest.mark.parametrize("rules", [ArduPilotRules, Px4Rules])
def test_good_poses_are_fused_and_the_autopilot_says_so(rules: Any):
    with listening() as heard, drone_for(heard, rules()) as drone:
        heard.fly(lambda: drone.rules.results[PoseResult.FUSED] >= 40)
        assert set(drone.rules.results) <= {
            PoseResult.FUSED,
            PoseResult.RESET,
            PoseResult.NOT_A_POSE,
            PoseResult.NOT_STARTED,
            PoseResult.TOO_SOON,
        }
        assert drone.rules.results[PoseResult.RESET] == 1  # the beginning
        assert drone.rules.estimate is not None
        np.testing.assert_allclose(drone.rules.estimate.xyz_m, [101, -2, -10], atol=0.5)
        told = [m for m in heard.messages if isinstance(m, AutopilotEstimator)]
        heard.fly(lambda: any(m.position_good for m in heard.messages if isinstance(m, AutopilotEstimator)))
        assert told[0].constant_position
        sent = [parse_frame(r.data).get_type() for r in heard.link.sent()]
        assert sent.count("ODOMETRY") == heard.link.counters["sent: ODOMETRY"]
    assert heard.link.counters["lost"] == 0


def test_what_was_sent_is_recorded_byte_for_byte_with_our_own_component():
    with listening() as heard, drone_for(heard, ArduPilotRules()) as drone:
        heard.fly(lambda: len(drone.messages("ODOMETRY")) >= 10)
        records = list(heard.link.sent())
        assert {r.topic for r in records} == {"/autopilot/tx"}
        assert {header(r.data)[0] for r in records} == {(1, 197)}
        numbers = [header(r.data)[1] for r in records]
        first = [(b - a) % 256 for a, b in itertools.pairwise(numbers)]
        assert set(first) == {1}  # none missing, in order
        arrived = {bytes(m.get_msgbuf()) for m in drone.messages("ODOMETRY")}
        assert arrived <= {r.data for r in records}
        assert list(heard.link.sent()) == [] or heard.link.counters["sent: HEARTBEAT"]  # told once


def test_an_unresolved_branch_never_reaches_the_autopilot_and_it_is_told_why():
    with listening() as heard, drone_for(heard, ArduPilotRules()) as drone:
        wrong = rotation_z(np.pi / 2)
        heard.fly(
            lambda: any("AMBIGUOUS" in m.text for m in drone.messages("STATUSTEXT")),
            lambda ns: good_pose(ns, state=PoseState.AMBIGUOUS, R_map_drone=wrong, R_vehicle_drone=wrong),
        )
        assert drone.messages("ODOMETRY") == []
        assert drone.rules.estimate is None
        assert heard.link.counters["pose held back: ambiguous rotation"] > 0


def test_it_stops_loudly_keeps_its_heartbeat_and_resets_when_it_goes_on():
    with listening() as heard, drone_for(heard, ArduPilotRules()) as drone:
        heard.fly(lambda: drone.rules.results[PoseResult.FUSED] >= 5)
        counter = drone.messages("ODOMETRY")[-1].reset_counter
        beats = len(drone.messages("HEARTBEAT"))
        heard.rest(lambda: any(m.severity == 2 for m in drone.messages("STATUSTEXT")))
        heard.rest(lambda: len(drone.messages("HEARTBEAT")) >= beats + 2)
        assert drone.messages("HEARTBEAT")[-1].system_status == mavlink.MAV_STATE_STANDBY
        assert not drone.rules.healthy(drone.device_ns())
        resets = drone.rules.results[PoseResult.RESET]
        heard.fly(lambda: drone.rules.results[PoseResult.RESET] > resets)
        assert drone.messages("ODOMETRY")[-1].reset_counter == (counter + 1) % 256
        beat = drone.messages("HEARTBEAT")[0]
        assert (beat.type, beat.autopilot) == (mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID)


def test_an_autopilot_that_stands_still_gets_no_poses_that_it_would_take_for_new_later():
    with listening() as heard, drone_for(heard, ArduPilotRules()) as drone:
        heard.fly(lambda: drone.rules.results[PoseResult.FUSED] >= 5)
        counter = drone.messages("ODOMETRY")[-1].reset_counter
        drone.silent = True
        heard.fly(lambda: heard.link.counters.get("pose held back: autopilot not heard", 0) >= 1, most=150)
        sent = heard.link.counters["sent: ODOMETRY"]
        heard.fly(lambda: heard.link.counters["pose held back: autopilot not heard"] >= 25)
        assert heard.link.counters["sent: ODOMETRY"] == sent
        drone.silent = False
        heard.fly(lambda: drone.messages("ODOMETRY")[-1].reset_counter == (counter + 1) % 256)


def test_by_tcp_poses_go_to_whom_was_heard_on_this_connection():
    beat = packed(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3), mavlink.MAVLink(None, 1, 1))
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        listening(connection=f"tcp:127.0.0.1:{server.getsockname()[1]}") as heard,
    ):

        def held() -> int:
            return heard.link.counters.get("pose held back: autopilot not heard", 0)

        def sent() -> int:
            return heard.link.counters.get("sent: ODOMETRY", 0)

        for connection in range(2):  # nobody need have accepted it: the system takes what is sent
            held_before, sent_before = held(), sent()
            heard.fly(lambda before=held_before: held() >= before + 5)
            assert sent() == sent_before
            with server.accept()[0] as peer:
                peer.sendall(beat)
                heard.fly(lambda before=sent_before: sent() > before)
            heard.rest(lambda connection=connection: heard.link.counters["reconnects"] > connection)


def test_half_a_frame_of_the_line_before_holds_up_none_of_the_new_one():
    """A frame that is announced as longer than what comes would wait for the rest, and be stamped then."""
    mav = mavlink.MAVLink(None, 1, 1)
    long = packed(mavlink.MAVLink_statustext_message(6, b"x" * 50), mav)
    beat = packed(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3), mav)
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        listening(connection=f"tcp:127.0.0.1:{server.getsockname()[1]}") as heard,
    ):
        with server.accept()[0] as peer:
            peer.sendall(beat + long[:20])
            heard.rest(lambda: len(heard.records) == 1)
        heard.rest(lambda: heard.link.counters["reconnects"] == 1)
        with server.accept()[0] as peer:
            peer.sendall(beat)
            heard.rest(lambda: len(heard.records) == 2, most=100)
        assert heard.link.counters["stray bytes"] == 20


def test_timesync_is_answered_and_asked_for():
    with listening() as heard, drone_for(heard, Px4Rules()) as drone:
        before_ns = host_time.now_ns()
        heard.rest(lambda: any(m.tc1 != 0 for m in drone.messages("TIMESYNC")))
        answer = next(m for m in drone.messages("TIMESYNC") if m.tc1 != 0)
        assert before_ns - 10**10 < answer.tc1 <= host_time.now_ns()  # our clock
        assert 0 < answer.ts1 <= drone.device_ns()  # its own, given back
        heard.rest(
            lambda: heard.link.counters["timesync replies"] >= 1
        )  # ours, answered; ESTIMATOR_STATUS has its time


def test_no_poses_over_a_bridge_that_hands_them_on_late_and_it_stops_loudly():
    with (
        listening() as heard,
        Bridge(heard.link.port or 0) as bridge,
        AutopilotSocket(ArduPilotRules(), send_to=("127.0.0.1", bridge.port)) as drone,
    ):
        heard.fly(lambda: drone.rules.results[PoseResult.FUSED] >= 5)
        counter = drone.messages("ODOMETRY")[-1].reset_counter
        bridge.delay_s = 0.6
        heard.fly(lambda: heard.link.counters.get("pose held back: line too slow", 0) >= 1)
        sent = heard.link.counters["sent: ODOMETRY"]
        heard.fly(lambda: heard.link.counters["pose held back: line too slow"] >= 25)
        assert heard.link.counters["sent: ODOMETRY"] == sent
        assert heard.link.counters["round trip [ms]"] >= 600
        assert "answers to TIMESYNC take longer than 0.3 s" in (heard.link.status or "")
        told = "grd: STOPPED: line too slow"
        heard.rest(lambda: any((m.severity, m.text) == (2, told) for m in drone.messages("STATUSTEXT")))
        assert heard.link.counters["sent: ODOMETRY"] == sent
        prompt_us = host_time.now_ns() // 1000
        bridge.delay_s = 0.0
        heard.fly(lambda: drone.messages("ODOMETRY")[-1].time_usec > prompt_us)
        assert next(m for m in drone.messages("ODOMETRY") if m.time_usec > prompt_us).reset_counter != counter
        heard.rest(lambda: heard.link.status is None)


def test_an_answer_that_we_did_not_ask_for_is_not_believed_though_it_names_nobody():
    with listening() as heard, drone_for(heard, Px4Rules()) as drone:
        heard.rest(lambda: heard.link.counters["timesync replies"] >= 2)
        drone.send(mavlink.MAVLink_timesync_message(drone.device_ns(), host_time.now_ns() - 1000))
        heard.rest(lambda: heard.link.counters.get("refused: timesync for another", 0) == 1)
        before = heard.link.counters["timesync replies"]
        heard.rest(lambda: heard.link.counters["timesync replies"] > before)
    replayed = Autopilot(own_component_id=191)
    for record in heard.records:
        replayed.decode(record)
    assert replayed.counters["timesync replies"] == heard.link.counters["timesync replies"]


def test_an_origin_is_given_to_who_has_none_and_never_over_another():
    origin = {"latitude_deg": 47.3977, "longitude_deg": 8.5456, "altitude_m": 488.0}
    ours, theirs = (473977000, 85456000, 488000), (1, 2, 3)
    with listening(global_origin=origin) as heard, drone_for(heard, ArduPilotRules()) as drone:
        heard.rest(lambda: drone.origin == ours)
    with listening(global_origin=origin) as heard, drone_for(heard, ArduPilotRules(), origin=theirs) as drone:
        heard.rest(lambda: len(drone.messages("TIMESYNC")) >= 3)  # two seconds later
        assert drone.messages("SET_GPS_GLOBAL_ORIGIN") == []
        assert len(drone.messages("COMMAND_LONG")) == 1
        assert drone.origin == theirs


def test_both_sides_of_a_signed_link_understand_each_other_and_unsigned_words_are_not_heard(tmp_path: Path):
    key = tmp_path / "key"
    key.write_bytes(b"k" * 32)
    key.chmod(0o600)
    with listening(signing_key=str(key)) as heard:
        drone = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        drone.signing.timestamp = (host_time.now_ns() - 1_420_070_400 * 10**9) // 10_000
        beat = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            udp.bind(("127.0.0.1", 0))
            udp.settimeout(5.0)
            udp.sendto(packed(beat, drone), ("127.0.0.1", heard.link.port))
            heard.rest(lambda: heard.link.counters.get("not signed with our key", 0) == 1)
            assert heard.records == []
            drone.signing.secret_key, drone.signing.sign_outgoing = b"k" * 32, True
            udp.sendto(packed(beat, drone), ("127.0.0.1", heard.link.port))
            heard.rest(lambda: len(heard.records) == 1)
            heard.link.on_pose(good_pose(host_time.now_ns()))
            assert drone.decode(bytearray(udp.recv(300))).get_signed()  # pymavlink looks at the signature
    assert (tmp_path / "key.timestamp").exists()


def signing_drone(folder: Path, days_ago: int = 0) -> tuple[Path, mavlink.MAVLink]:
    """Our key's file, and a peer that signs with it, its clock so late."""
    key = folder / "key"
    key.write_bytes(b"k" * 32)
    key.chmod(0o600)
    drone = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    drone.signing.secret_key, drone.signing.sign_outgoing = b"k" * 32, True
    since_2015_ns = host_time.now_ns() - 1_420_070_400 * 10**9
    drone.signing.timestamp = since_2015_ns // 10_000 - days_ago * 86_400 * 100_000
    return key, drone


def test_an_autopilot_without_a_clock_is_told_the_time_before_it_is_heard_and_gets_no_poses_until_then(tmp_path: Path):
    """ArduPilot begins with the time it signed with last, and takes that of a signed frame that is newer."""
    key, drone = signing_drone(tmp_path, days_ago=10)
    beat = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3)
    with listening(signing_key=str(key)) as heard, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        udp.settimeout(3.0)
        udp.sendto(packed(beat, drone), ("127.0.0.1", heard.link.port))
        heard.rest(lambda: heard.link.counters.get("signed with our key, but not new", 0) == 1)
        heard.link.on_pose(good_pose(host_time.now_ns()))
        assert drone.decode(bytearray(udp.recv(300))).get_type() in ("HEARTBEAT", "TIMESYNC", "STATUSTEXT")
        assert heard.records == []
        assert heard.link.counters["pose held back: autopilot not heard"] == 1
        udp.sendto(packed(beat, drone), ("127.0.0.1", heard.link.port))
        heard.rest(lambda: len(heard.records) == 1)
        heard.link.on_pose(good_pose(host_time.now_ns()))
        assert heard.link.counters["sent: ODOMETRY"] == 1


def test_an_old_signed_frame_sent_again_does_not_draw_the_poses_away(tmp_path: Path):
    key, drone = signing_drone(tmp_path)
    frame = packed(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3), drone)
    with (
        listening(signing_key=str(key)) as heard,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        udp.settimeout(3.0)
        udp.sendto(frame, ("127.0.0.1", heard.link.port))
        heard.rest(lambda: len(heard.records) == 1)
        other.sendto(frame, ("127.0.0.1", heard.link.port))
        heard.rest(lambda: heard.link.counters.get("signed with our key, but not new", 0) == 1)
        heard.link.on_pose(good_pose(host_time.now_ns()))
        while parse_frame(udp.recv(300)).get_type() != "ODOMETRY":
            pass


def test_a_disk_that_takes_its_time_with_the_signatures_time_holds_no_pose_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    key = tmp_path / "key"
    key.write_bytes(b"k" * 32)
    key.chmod(0o600)
    writing, release, released = threading.Event(), threading.Event(), list[bool]()

    def slow(descriptor: int) -> None:
        writing.set()
        released.append(release.wait(5))

    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp,
        listening(connection=f"udpout:127.0.0.1:{bound_port(udp)}", signing_key=str(key)) as heard,
    ):
        session = heard.link._session
        assert session is not None
        assert session._signer is not None
        monkeypatch.setattr("links.mavlink.signing.os.fsync", slow)
        session._signer._reserved = session._signer._used + AHEAD_TICKS // 4  # it is time to write, not to wait for it
        heard.rest(writing.is_set)
        heard.link.on_pose(good_pose(host_time.now_ns()))
        session._signer._reserved = 0  # it hangs for so long that all is used up
        heard.link.on_pose(good_pose(host_time.now_ns()))
        assert heard.link.counters["sent: ODOMETRY"] == 2
        release.set()
    assert all(released)


def test_each_time_that_a_link_opens_the_signing_time_is_written_ahead_before_it_signs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(Session, "_keep", lambda session: None)  # the thread comes too late
    key, _ = signing_drone(tmp_path)
    link = Autopilot(connection="udpin:127.0.0.1:0", signing_key=key)
    for _ in range(2):
        with link.listen():
            assert link._signer is not None
            assert int((tmp_path / "key.timestamp").read_text()) > link._signer._used + AHEAD_TICKS // 2


def test_a_disk_that_takes_no_signing_time_ends_no_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    key, drone = signing_drone(tmp_path)
    beat = packed(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3), drone)

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp, listening(signing_key=str(key)) as heard:
        session = heard.link._session
        assert session is not None
        signer = session._signer
        assert signer is not None
        monkeypatch.setattr("links.mavlink.signing.os.fsync", full)
        signer._reserved = 0
        heard.rest(lambda: heard.link.counters.get("signing time not written", 0) == 1)
        assert "signing time cannot be written" in (heard.link.status or "")
        udp.sendto(beat, ("127.0.0.1", heard.link.port))
        heard.rest(lambda: len(heard.records) == 1)
        heard.link.on_pose(good_pose(host_time.now_ns()))
        assert heard.link.counters["sent: ODOMETRY"] == 1
    with heard.link.listen():  # opened again in the same run: its times never go back
        assert heard.link._session is not None
        assert heard.link._session._signer is signer


def test_strangers_on_the_port_are_decoded_by_no_one_and_get_no_poses():
    with listening(sender="127.0.0.9") as heard:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            frame = packed(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3), mavlink.MAVLink(None, 1, 1))
            stranger.sendto(frame, ("127.0.0.1", heard.link.port))
            heard.rest(lambda: heard.link.counters["from other senders"] == 1)
        heard.link.on_pose(good_pose(host_time.now_ns()))
        assert heard.link.counters["not sent: ODOMETRY"] == 1
    assert heard.records == []


def test_another_system_on_the_same_address_is_recorded_and_does_not_get_the_poses():
    station = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with listening() as heard, drone_for(heard, ArduPilotRules()) as drone, station:
        station.settimeout(0.1)
        frame = packed(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), mavlink.MAVLink(None, 255, 190))
        station.sendto(frame, ("127.0.0.1", heard.link.port))
        heard.rest(lambda: any(r.data == frame for r in heard.records))
        heard.fly(lambda: len(drone.messages("ODOMETRY")) >= 5)
        with pytest.raises(TimeoutError):
            station.recv(300)
    assert heard.link.counters["refused: from another system"] == 1


def test_our_own_frames_that_come_back_are_not_heard():
    with listening() as heard:
        ours = mavlink.MAVLink(None, srcSystem=1, srcComponent=197)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as radio:
            beat = mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 3, 3)
            radio.sendto(packed(beat, ours), ("127.0.0.1", heard.link.port))
            heard.rest(lambda: heard.link.counters.get("our own, come back", 0) == 1)
    assert heard.records == []


def test_a_silent_autopilot_is_status_in_words(monkeypatch: pytest.MonkeyPatch):
    with listening() as heard:
        assert heard.link.status is None
        real = host_time.now_ns()
        session = heard.link._session  # the clock of the session, set ahead
        assert session is not None
        monkeypatch.setattr(session, "_now_ns", lambda: real + 10**10)
        assert "no word from the autopilot (system 1, component 1)" in (heard.link.status or "")
    assert heard.link.status is None


@given(datagrams=st.lists(st.binary(min_size=1, max_size=400), min_size=1, max_size=20))
@settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
def test_no_datagram_stops_the_link(datagrams: list[bytes]):
    with listening() as heard, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as anyone:
        for data in datagrams:
            anyone.sendto(data, ("127.0.0.1", heard.link.port))
        beat = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3)
        anyone.sendto(packed(beat, mavlink.MAVLink(None, 1, 1)), ("127.0.0.1", heard.link.port))
        heard.rest(lambda: any(m is not None for m in heard.messages))
    counted = heard.link.counters["stray bytes"] + sum(len(r.data) for r in heard.records)
    assert counted == sum(map(len, datagrams)) + 21


def test_poses_before_and_after_the_link_is_open_are_counted_and_go_nowhere():
    link = Autopilot(connection="udpin:127.0.0.1:0")
    link.on_pose(good_pose())
    assert link.counters["poses while not connected"] == 1
    assert list(link.sent()) == []
    with link.listen():
        pass
    link.on_pose(good_pose())
    assert link.counters["poses while not connected"] == 2


def test_without_a_connection_it_cannot_listen_and_says_what_to_set():
    with pytest.raises(LinkError, match="set `connection`"), Autopilot().listen():
        pass


@pytest.mark.parametrize(
    ("config", "says"),
    [
        ({"connection": "udp:14550"}, "udpin:127.0.0.1:14550"),
        ({"connection": "udpin:0.0.0.0:14550"}, "sender"),
        ({"send": ["odometry", "vision_position_estimate"]}, "fused twice"),
        ({"send": ["odometry", "odometry"]}, "once"),
        ({"profile": "px4", "send": ["vision_position_estimate"]}, "north-oriented"),
        ({"profile": "px4", "send": ["landing_target"]}, "local NED"),
        ({"own_component_id": 1}, "cannot be the autopilot itself"),
    ],
)
def test_settings_that_would_fly_wrong_are_refused_with_the_reason(config: Any, says: str):
    with pytest.raises(ValidationError, match=says):
        Autopilot(**config)
