"""MAVSDK 4.1 and MAVProxy, each in its own virtual environment, receive grd's stream on loopback and decode it correctly.

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
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import Record
from links.clock import host_time
from links.mavlink import Autopilot
from links.mavlink.transport.framing import packed, parse_frame
from links.recording import RecordingReader, RecordingWriter
from stages.geometry.frames import rotation_from_rpy_deg
from stages.messages import PoseState, RelativePose
from tests.links.mavlink.mavlink_poses import good_pose
from tests.links.ports import free_port

mavlink: Any = ardupilotmega
MAVSDK, MAVPROXY = os.environ.get("GRD_MAVSDK_PYTHON"), os.environ.get("GRD_MAVPROXY_PYTHON")
needs_mavsdk = pytest.mark.skipif(not MAVSDK, reason="GRD_MAVSDK_PYTHON is not a Python with mavsdk 4.1")
needs_mavproxy = pytest.mark.skipif(not MAVPROXY, reason="GRD_MAVPROXY_PYTHON is not a Python with MAVProxy")
PEER = Path(__file__).parent / "peers" / "mavsdk_peer.py"
TICK_S, MAX_TICKS = 0.02, 1500


class Peer:
    """A subprocess that prints lines."""

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

    def output(self) -> list[str]:
        while not self._queue.empty():
            self.lines.append(self._queue.get())
        assert self.process.poll() is None, "\n".join(self.lines)
        return self.lines

    def json_lines(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.output() if line.startswith("{")]

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
    """A pose that moves, turns and tilts, so that no two messages are equal."""
    t = (stamp_ns % 10**11) * 1e-9
    R = rotation_from_rpy_deg((5.0 * np.sin(t), 8.0 * np.cos(t), 10.0 * t))
    return good_pose(
        stamp_ns,
        xyz_vehicle_m=np.array([np.sin(t), np.cos(t), 10.0 + 0.1 * t]),
        xyz_map_m=np.array([t, np.cos(t), 10.0 + 0.1 * t]),
        R_vehicle_drone=R,
        R_map_drone=R,
    )


def send_poses(
    link: Autopilot, sent: list[Record], done: Callable[[], bool], pose: Callable[[int], RelativePose] = varied
) -> None:
    """Send current poses at about 50 Hz until `done`."""
    pause = threading.Event()
    for _ in range(MAX_TICKS):
        link.on_pose(pose(host_time.now_ns()))
        sent += link.sent()
        if done():
            return
        pause.wait(TICK_S)
    pytest.fail(f"not within {MAX_TICKS * TICK_S:g} s: {link.counters}")


def sent_by_time(sent: list[Record], kind: str) -> dict[int, Any]:
    messages = [parse_frame(record.data) for record in sent]
    return {m.time_usec: m for m in messages if m.get_type() == kind}


def assert_same(received: dict[str, Any], sent: Any) -> None:
    """Assert that each field is as packed; JSON's null is NaN."""
    for name in sent.get_fieldnames():
        expected = np.array(getattr(sent, name), dtype=np.float64)
        actual = np.array(received[name], dtype=np.float64)
        np.testing.assert_array_equal(actual.astype(np.float32), expected.astype(np.float32), err_msg=name)


@needs_mavsdk
def test_mavsdk_decodes_odometry_and_landing_target_correctly(tmp_path: Path):
    port = free_port()
    link = Autopilot(connection=f"udpout:127.0.0.1:{port}", send=("odometry", "landing_target"))
    wanted = ("ODOMETRY", "LANDING_TARGET", "STATUSTEXT", "HEARTBEAT", "TIMESYNC")
    sent: list[Record] = []
    assert MAVSDK is not None
    with peer(MAVSDK, str(PEER), str(port), *wanted, folder=tmp_path) as sdk, link.listen():

        def received(kind: str) -> list[dict[str, Any]]:
            return [line for line in sdk.json_lines() if line.get("name") == kind]

        send_poses(link, sent, lambda: all(len(received(kind)) >= 60 for kind in wanted[:2]))
        send_poses(
            link,
            sent,
            lambda: any("STOPPED: ambiguous" in line["fields"] for line in received("STATUSTEXT")),
            lambda ns: good_pose(ns, state=PoseState.AMBIGUOUS),
        )
        lines = sdk.json_lines()
        counts = Counter(line["name"] for line in lines if "name" in line)
        for kind in ("ODOMETRY", "LANDING_TARGET"):
            sent_messages = sent_by_time(sent, kind)
            for line in received(kind):
                fields = json.loads(line["fields"])
                assert line["sender"] == [1, 197]
                assert_same(fields, sent_messages[fields["time_usec"]])
    assert lines[0]["version"].lstrip("v").startswith("4.1")
    assert next(line["components"] for line in lines if "components" in line) == [197]
    sys.stdout.write(f"\nMAVSDK {lines[0]['version']}: {dict(counts)}, every field equal\n")


@contextmanager
def mavproxy(folder: Path, port: int, *more: str) -> Iterator[Peer]:
    assert MAVPROXY is not None
    program = str(Path(MAVPROXY).parent / "mavproxy.py")
    options = ("--master", f"udpin:127.0.0.1:{port}", "--logfile", str(folder / "flight.tlog"), "--non-interactive")
    modules = ("--state-basedir", str(folder), "--default-modules", "signing,link")
    with peer(MAVPROXY, "-u", program, *options, *modules, *more, folder=folder) as proxy:
        pause = threading.Event()
        for _ in range(MAX_TICKS):
            if any("Waiting for heartbeat" in line for line in proxy.output()):
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
def test_mavproxy_detects_grd_shows_its_texts_and_logs_every_odometry_unchanged(tmp_path: Path):
    port = free_port()
    link = Autopilot(connection=f"udpout:127.0.0.1:{port}", send=("odometry", "landing_target"))
    sent: list[Record] = []
    with mavproxy(tmp_path, port) as proxy, link.listen():

        def shows(text: str) -> bool:
            return any(text in line for line in proxy.output())

        send_poses(link, sent, lambda: shows("grd: sending poses") and len(sent_by_time(sent, "ODOMETRY")) >= 100)
        send_poses(link, sent, lambda: shows("STOPPED: no position"), lambda ns: good_pose(ns, state=PoseState.LOST))
        assert shows("Detected vehicle 1:197")
        shown = [line for line in proxy.output() if "grd:" in line or "Detected" in line]
    counts = Counter()
    for kind in ("ODOMETRY", "LANDING_TARGET"):
        sent_messages, logged = sent_by_time(sent, kind), logdump(tmp_path / "flight.tlog", kind)
        counts[kind] = len(logged)
        assert len(logged) >= 0.95 * len(sent_messages)  # the last ones may not be on the disk
        for fields in logged:
            assert_same(fields, sent_messages[fields["time_usec"]])
    sys.stdout.write(f"\nMAVProxy: {dict(counts)} of {len(sent_messages)} sent, every field equal; it shows {shown}\n")


@needs_mavproxy
def test_mavproxy_accepts_the_right_signature_and_rejects_another(tmp_path: Path):
    """MAVProxy's `signing key` hashes a phrase with SHA-256; its pymavlink verifies each frame."""
    key = tmp_path / "key"
    key.write_bytes(hashlib.sha256(b"overthestreet").digest())
    key.chmod(0o600)
    for phrase, accepted in (("overthestreet", True), ("otherstreet", False)):
        folder = tmp_path / phrase
        folder.mkdir()
        port = free_port()
        link = Autopilot(connection=f"udpout:127.0.0.1:{port}", signing_key=key)
        sent: list[Record] = []
        with mavproxy(folder, port, "--cmd", f"set allow_unsigned False; signing key {phrase}") as proxy, link.listen():
            send_poses(link, sent, lambda sent=sent: len(sent_by_time(sent, "ODOMETRY")) >= 150)
            assert any("Detected vehicle 1:197" in line for line in proxy.output()) == accepted


@pytest.fixture
def session(tmp_path: Path) -> list[Record]:
    """Frames of a link in both directions, written to a recording and read back."""
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
    sent_messages, logged = sent_by_time(session, "ODOMETRY"), logdump(tlog, "ODOMETRY")
    assert len(logged) == len(sent_messages) == 40
    for fields in logged:
        assert_same(fields, sent_messages[fields["time_usec"]])


@needs_mavsdk
def test_a_recorded_session_sent_again_is_read_by_mavsdk(session: list[Record], tmp_path: Path):
    port, pause = free_port(), threading.Event()
    sent_messages = sent_by_time(session, "ODOMETRY")
    decoded: dict[int, dict[str, Any]] = {}
    assert MAVSDK is not None
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with udp, peer(MAVSDK, str(PEER), str(port), "ODOMETRY", folder=tmp_path) as sdk:
        for _ in range(MAX_TICKS // 50):
            for record in session:
                if record.topic == "/autopilot/tx":
                    udp.sendto(record.data, ("127.0.0.1", port))
                    pause.wait(0.005)
            lines = [json.loads(line["fields"]) for line in sdk.json_lines() if line.get("name") == "ODOMETRY"]
            decoded = {fields["time_usec"]: fields for fields in lines}
            if len(decoded) == len(sent_messages):
                break
    assert decoded.keys() == sent_messages.keys()
    for time_usec, fields in decoded.items():
        assert_same(fields, sent_messages[time_usec])
