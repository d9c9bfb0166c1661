"""MAVSDK 4.1 and MAVProxy, each in its own virtual environment, receive our stream on loopback and read what we meant.

    python3 -m venv mavsdk && mavsdk/bin/pip install mavsdk==4.1.0
    python3 -m venv mavproxy && mavproxy/bin/pip install MAVProxy==1.8.75
    GRD_MAVSDK_PYTHON=mavsdk/bin/python GRD_MAVPROXY_PYTHON=mavproxy/bin/python python -m pytest \
        tests/links/mavlink/test_mavlink_real_peers.py -s
"""

from __future__ import annotations

import hashlib
import json
import os
import queue
import socket
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mavlink_poses import good_pose
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import Record
from links import host_time
from links.mavlink import Autopilot
from links.mavlink.wire import packed, parse_frame
from links.recording import RecordingReader, RecordingWriter
from stages.geometry.frames import rotation_from_rpy_deg
from stages.messages import PoseState, RelativePose
from tests.links.ports import free_port

mavlink: Any = ardupilotmega
MAVSDK, MAVPROXY = os.environ.get("GRD_MAVSDK_PYTHON"), os.environ.get("GRD_MAVPROXY_PYTHON")
needs_mavsdk = pytest.mark.skipif(not MAVSDK, reason="GRD_MAVSDK_PYTHON names no Python that has mavsdk 4.1")
needs_mavproxy = pytest.mark.skipif(not MAVPROXY, reason="GRD_MAVPROXY_PYTHON names no Python that has MAVProxy")
PEER = Path(__file__).parent / "peers" / "mavsdk_peer.py"
TICK_S, MOST_TICKS = 0.02, 1500


class Peer:
    """A program that prints lines."""

    def __init__(self, *command: str, folder: Path) -> None:
        self.process = subprocess.Popen(
            command,
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.lines: list[str] = []
        self._queue: queue.SimpleQueue[str] = queue.SimpleQueue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._queue.put(line.rstrip("\n"))

    def look(self) -> list[str]:
        while not self._queue.empty():
            self.lines.append(self._queue.get())
        assert self.process.poll() is None, "\n".join(self.lines)
        return self.lines

    def said(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.look() if line.startswith("{")]

    def end(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.terminate()
        self.process.wait(20)


@contextmanager
def peer(*command: str, folder: Path) -> Iterator[Peer]:
    program = Peer(*command, folder=folder)
    try:
        yield program
    finally:
        program.end()


def varied(stamp_ns: int) -> RelativePose:
    """A pose that moves, turns and leans, so that no two messages are alike."""
    t = (stamp_ns % 10**11) * 1e-9
    R = rotation_from_rpy_deg((5.0 * np.sin(t), 8.0 * np.cos(t), 10.0 * t))
    return good_pose(
        stamp_ns,
        xyz_vehicle_m=np.array([np.sin(t), np.cos(t), 10.0 + 0.1 * t]),
        xyz_map_m=np.array([t, np.cos(t), 10.0 + 0.1 * t]),
        R_vehicle_drone=R,
        R_map_drone=R,
    )


def fly(
    link: Autopilot, sent: list[Record], done: Callable[[], bool], pose: Callable[[int], RelativePose] = varied
) -> None:
    """Poses of now, some 50 a second, until something is true."""
    pause = threading.Event()
    for _ in range(MOST_TICKS):
        link.on_pose(pose(host_time.now_ns()))
        sent += link.sent()
        if done():
            return
        pause.wait(TICK_S)
    pytest.fail(f"not within {MOST_TICKS * TICK_S:g} s: {link.counters}")


def sent_by_time(sent: list[Record], kind: str) -> dict[int, Any]:
    messages = [parse_frame(record.data) for record in sent]
    return {m.time_usec: m for m in messages if m.get_type() == kind}


def assert_same(theirs: dict[str, Any], ours: Any) -> None:
    """Each field as we packed it; JSON's null is NaN."""
    for name in ours.get_fieldnames():
        mine = np.array(getattr(ours, name), dtype=np.float64)
        yours = np.array(theirs[name], dtype=np.float64)
        np.testing.assert_array_equal(yours.astype(np.float32), mine.astype(np.float32), err_msg=name)


@needs_mavsdk
def test_mavsdk_decodes_odometry_and_landing_target_as_they_were_meant(tmp_path: Path):
    port = free_port()
    link = Autopilot(connection=f"udpout:127.0.0.1:{port}", send=("odometry", "landing_target"))
    wanted = ("ODOMETRY", "LANDING_TARGET", "STATUSTEXT", "HEARTBEAT", "TIMESYNC")
    sent: list[Record] = []
    assert MAVSDK is not None
    with peer(MAVSDK, str(PEER), str(port), *wanted, folder=tmp_path) as sdk, link.listen():

        def heard(kind: str) -> list[dict[str, Any]]:
            return [line for line in sdk.said() if line.get("name") == kind]

        fly(link, sent, lambda: all(len(heard(kind)) >= 60 for kind in wanted[:2]))
        fly(
            link,
            sent,
            lambda: any("STOPPED: ambiguous" in line["fields"] for line in heard("STATUSTEXT")),
            lambda ns: good_pose(ns, state=PoseState.AMBIGUOUS),
        )
        said = sdk.said()
        counts = Counter(line["name"] for line in said if "name" in line)
        for kind in ("ODOMETRY", "LANDING_TARGET"):
            ours = sent_by_time(sent, kind)
            for line in heard(kind):
                fields = json.loads(line["fields"])
                assert line["sender"] == [1, 197]
                assert_same(fields, ours[fields["time_usec"]])
    assert said[0]["version"].lstrip("v").startswith("4.1")
    assert next(line["components"] for line in said if "components" in line) == [197]
    sys.stdout.write(f"\nMAVSDK {said[0]['version']}: {dict(counts)}, every field equal to ours\n")


@contextmanager
def mavproxy(folder: Path, port: int, *more: str) -> Iterator[Peer]:
    assert MAVPROXY is not None
    program = str(Path(MAVPROXY).parent / "mavproxy.py")
    options = ("--master", f"udpin:127.0.0.1:{port}", "--logfile", str(folder / "flight.tlog"), "--non-interactive")
    modules = ("--state-basedir", str(folder), "--default-modules", "signing,link")
    with peer(MAVPROXY, "-u", program, *options, *modules, *more, folder=folder) as proxy:
        pause = threading.Event()
        for _ in range(MOST_TICKS):
            if any("Waiting for heartbeat" in line for line in proxy.look()):
                break
            pause.wait(TICK_S)
        yield proxy


def logdump(tlog: Path, kind: str) -> list[dict[str, Any]]:
    """Messages of a telemetry log as pymavlink's mavlogdump of MAVProxy's environment reads them."""
    assert MAVPROXY is not None
    tool = str(Path(MAVPROXY).parent / "mavlogdump.py")
    command = [MAVPROXY, tool, "--types", kind, "--format", "json", str(tlog)]
    text = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout
    return [json.loads(line)["data"] for line in text.splitlines() if line.startswith("{")]


@needs_mavproxy
def test_mavproxy_meets_us_shows_our_texts_and_logs_every_odometry_as_it_was_sent(tmp_path: Path):
    port = free_port()
    link = Autopilot(connection=f"udpout:127.0.0.1:{port}", send=("odometry", "landing_target"))
    sent: list[Record] = []
    with mavproxy(tmp_path, port) as proxy, link.listen():

        def shows(text: str) -> bool:
            return any(text in line for line in proxy.look())

        fly(link, sent, lambda: shows("grd: sending poses") and len(sent_by_time(sent, "ODOMETRY")) >= 100)
        fly(link, sent, lambda: shows("STOPPED: no position"), lambda ns: good_pose(ns, state=PoseState.LOST))
        assert shows("Detected vehicle 1:197")
        shown = [line for line in proxy.look() if "grd:" in line or "Detected" in line]
    counts = Counter()
    for kind in ("ODOMETRY", "LANDING_TARGET"):
        ours, logged = sent_by_time(sent, kind), logdump(tmp_path / "flight.tlog", kind)
        counts[kind] = len(logged)
        assert len(logged) >= 0.95 * len(ours)  # those of the last moment may not be on the disk
        for fields in logged:
            assert_same(fields, ours[fields["time_usec"]])
    sys.stdout.write(f"\nMAVProxy: {dict(counts)} of {len(ours)} sent, every field equal to ours; it shows {shown}\n")


@needs_mavproxy
def test_mavproxy_takes_our_signature_and_refuses_another(tmp_path: Path):
    """MAVProxy's `signing key` hashes a phrase with SHA-256; pymavlink in it looks at each frame."""
    key = tmp_path / "key"
    key.write_bytes(hashlib.sha256(b"overthestreet").digest())
    key.chmod(0o600)
    for phrase, taken in (("overthestreet", True), ("elsewhere", False)):
        folder = tmp_path / phrase
        folder.mkdir()
        port = free_port()
        link = Autopilot(connection=f"udpout:127.0.0.1:{port}", signing_key=key)
        sent: list[Record] = []
        with mavproxy(folder, port, "--cmd", f"set allow_unsigned False; signing key {phrase}") as proxy, link.listen():
            fly(link, sent, lambda sent=sent: len(sent_by_time(sent, "ODOMETRY")) >= 150)
            assert any("Detected vehicle 1:197" in line for line in proxy.look()) == taken


@pytest.fixture
def session(tmp_path: Path) -> list[Record]:
    """What went over a link in both directions, written to a recording and read back."""
    link = Autopilot(connection="udpin:127.0.0.1:0")
    drone, pause = mavlink.MAVLink(None, srcSystem=1, srcComponent=1), threading.Event()
    records: list[Record] = []
    with link.listen() as received, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        for i in range(40):
            attitude = mavlink.MAVLink_attitude_message(1000 + 20 * i, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0)
            udp.sendto(packed(attitude, drone), ("127.0.0.1", link.port))
            records.append(next(received))
            link.on_pose(varied(host_time.now_ns()))
            records += link.sent()
            pause.wait(0.005)
    with RecordingWriter(tmp_path / "session.mcap", lossless=True) as recording:
        for record in records:
            recording.write(record)
    with RecordingReader(tmp_path / "session.mcap") as reader:
        return [record for record in reader.records() if record.topic.startswith("/autopilot/")]


@needs_mavproxy
def test_a_recorded_session_is_a_telemetry_log_that_mavproxys_tools_read(session: list[Record], tmp_path: Path):
    tlog = tmp_path / "session.tlog"
    tlog.write_bytes(b"".join((r.arrival_ns // 1000).to_bytes(8, "big") + r.data for r in session))
    assert len(logdump(tlog, "ATTITUDE")) == 40
    ours, logged = sent_by_time(session, "ODOMETRY"), logdump(tlog, "ODOMETRY")
    assert len(logged) == len(ours) == 40
    for fields in logged:
        assert_same(fields, ours[fields["time_usec"]])


@needs_mavsdk
def test_a_recorded_session_sent_again_is_read_by_mavsdk(session: list[Record], tmp_path: Path):
    port, pause = free_port(), threading.Event()
    ours = sent_by_time(session, "ODOMETRY")
    heard: dict[int, dict[str, Any]] = {}
    assert MAVSDK is not None
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with udp, peer(MAVSDK, str(PEER), str(port), "ODOMETRY", folder=tmp_path) as sdk:
        for _ in range(MOST_TICKS // 50):
            for record in session:
                if record.topic == "/autopilot/tx":
                    udp.sendto(record.data, ("127.0.0.1", port))
                    pause.wait(0.005)
            lines = [json.loads(line["fields"]) for line in sdk.said() if line.get("name") == "ODOMETRY"]
            heard = {fields["time_usec"]: fields for fields in lines}
            if len(heard) == len(ours):
                break
    assert heard.keys() == ours.keys()
    for time_usec, fields in heard.items():
        assert_same(fields, ours[time_usec])
