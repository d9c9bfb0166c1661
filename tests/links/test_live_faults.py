"""The field configuration in flight against the simulated rig, with one fault after the other; prints a table.

    python -m pytest -m slow -s tests/links/test_live_faults.py

Real sockets and a pty, five minutes of flight; the rig is a separate process. It needs two free cores: a loaded machine
increases all times. One camera without stages tests the link. All tests share one flight; the bounds of each fault are
in `fault_bounds.py`.
"""

from __future__ import annotations

import csv
import json
import resource
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega

from links.recording import RecordingReader
from links.runs.truth import TruthLog
from links.simulated.rig.live_images import MjpegServer
from tests.command import unit_file
from tests.links.fault_bounds import BOUNDS, FIRST_POSE_S, FIRST_POSITION_S, KILLED, MAX_RECORDING_LOSS_S, REST_S
from tests.links.ports import free_ports

pytestmark = pytest.mark.slow
pytest.importorskip("embreex", reason="simulating needs embreex: pip install -e '.[simulate]'")

ROOT = Path(__file__).resolve().parents[2]
SETTLE_S, HOLD_S = 25.0, 3.0
TIMEOUT_S = 240.0
WRONG_M, WRONG_DEG = 1.0, 30.0  # an accepted pose with a larger error is wrong
FORGED_HZ = 200
SKIPPED = "skipped"
VIEWER_S = 20.0  # limit for the first data at a viewer
SOURCES = {
    "lidar": "/lidar/packets",
    "servo": "/servo/state",
    "camera": "/camera/vehicle",
    "radio": "/autopilot/rx",
    "recorder": "/clock",
}
NEVER = float("nan")
OVERLAY = """\
links:
  sim: null
  lidar: {{config: {{port: {lidar}, position_port: {position}, sender: 127.0.0.1}}}}
  servo: {{config: {{port: {servo}, start_timeout_s: 30}}}}
  odometry: {{config: {{port: {odometry}, sender: 127.0.0.1}}}}
  autopilot: {{config: {{connection: "udpin:127.0.0.1:{autopilot}", sender: 127.0.0.1}}}}
  camera: {{use: links.camera.Camera, config: {{topic: /camera/vehicle, source: "http://127.0.0.1:{camera}/", fps: 10, timeout_s: 1}}}}
  viewer: {{config: {{serve: true, port: {viewer}}}}}
"""


@dataclass
class Fault:
    """One fault: begin and end (UTC [s]), the failed source, and the results."""

    name: str
    source: str | None  # source whose records stop
    begin_s: float = 0.0
    end_s: float = 0.0
    note: str = ""
    skipped: str = ""  # why it was skipped
    alive: bool = True
    back_s: float = NEVER  # from the fault's end to the first record of the source
    silent_s: float = NEVER  # longest time without an accepted pose; killed: from the kill to the first
    position_s: float = NEVER  # killed: to the first position
    good: int = 0
    wrong: int = 0
    worst_m: float = 0.0
    lost_s: float = 0.0  # longest gap of the recording


@dataclass
class Setup:
    """Ports, folder and rig of the flight."""

    folder: Path
    ports: dict[str, int]
    rig: subprocess.Popen[str]
    faults: list[Fault] = field(default_factory=list)

    def command_rig(self, line: str) -> None:
        self.rig.stdin.write(line + "\n")
        self.rig.stdin.flush()

    def grd(self, name: str, *arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "tests.links.stepped_clock", str(self.folder / "ahead"), "run"]
        command += ["configs/sim_live.yaml", "--overlay", str(self.folder / "faults.yaml"), *arguments]
        command += ["--out", str(self.folder / name)]
        with (self.folder / f"{name}.txt").open("w") as log:
            return subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=subprocess.STDOUT, text=True)

    def wait_for_poses(self, run: str, grd: subprocess.Popen[str], *, accepted: bool = False) -> float:
        """Wait for the first position, or the first accepted pose; returns its stamp."""
        deadline_s = time.monotonic() + TIMEOUT_S
        while time.monotonic() < deadline_s and grd.poll() is None:
            stamps_s = [pose.stamp_s for pose in positions(self.folder / run) if pose.good or not accepted]
            if stamps_s:
                return stamps_s[0]
            time.sleep(0.1)
        return NEVER


@dataclass(frozen=True)
class ResultPose:
    """One pose of the results."""

    stamp_s: float
    good: bool
    rotation: bool
    pose: tuple[float, ...]  # xyz, quaternion


def positions(folder: Path) -> list[ResultPose]:
    poses, table = folder / "pose_vehicle_drone.tum", folder / "pose_covariance.csv"
    if not poses.exists() or not table.exists():
        return []
    good = {
        row["stamp_s"]: (row["accepted"] == "1", row["rotation"] == "1")
        for row in csv.DictReader(table.read_text().splitlines())
    }
    lines = [line.split() for line in poses.read_text().splitlines() if line[:1].isdigit()]
    whole = [line for line in lines if len(line) == 8 and line[0] in good]
    return [ResultPose(float(line[0]), *good[line[0]], tuple(map(float, line[1:]))) for line in whole]


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    tmp_path = tmp_path_factory.mktemp("faults")
    names = ("lidar", "position", "odometry", "autopilot", "viewer", "camera")
    ports = dict(zip(names, free_ports(len(names)), strict=True))
    servo = tmp_path / "servo"
    (tmp_path / "faults.yaml").write_text(OVERLAY.format(servo=servo, **ports))
    settings = {
        "scenario": "configs/scenarios/live_street.yaml",
        "duration_s": 900.0,
        "servo": str(servo),
        "folder": str(tmp_path),
        **{f"{name}_port": ports[name] for name in ("lidar", "position", "odometry", "autopilot")},
    }
    command = [sys.executable, "-m", "tests.links.faulty_rig", json.dumps(settings)]
    with (tmp_path / "rig.txt").open("w") as log:
        rig = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True)
    assert rig.stdout.readline() == "ready\n", (tmp_path / "rig.txt").read_text()
    made = Setup(tmp_path, ports, rig)
    yield made
    if rig.poll() is None:
        rig.stdin.close()
        rig.wait(30)


class Camera:
    """Ten images per second on the camera's port, from a thread; `off` closes the port."""

    def __init__(self, port: int) -> None:
        self._port, self._stop, self.off = port, threading.Event(), False
        self._jpeg = cv2.imencode(".jpg", np.random.default_rng(1).integers(0, 255, (720, 720), np.uint8))[1].tobytes()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            with MjpegServer(self._port) as server:
                while not self.off and not self._stop.wait(0.1):
                    server.show(self._jpeg)
            while self.off and not self._stop.wait(0.05):
                pass


def forge(ports: dict[str, int], for_s: float) -> int:
    """Send garbage and valid but false data from another address of this host to every port; returns the count."""
    rng = np.random.default_rng(4)
    mav = ardupilotmega.MAVLink(None, srcSystem=1, srcComponent=1)
    count, until_s = 0, time.monotonic() + for_s
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.2", 0))
        while time.monotonic() < until_s:
            false = mav.odometry_encode(
                int(time.time() * 1e6), 1, 1, 50.0, 50.0, 9.0, [1.0, 0, 0, 0], *[9.0] * 6, [1e-6] * 21, [1e-6] * 21
            )
            pose = {"xyz_m": [9, 9, 9], "quaternion_xyzw": [0, 0, 0, 1], "covariance": [0] * 36, "age_s": 0}
            packet = bytearray((b"\xff\xee" + rng.bytes(98)) * 12 + rng.bytes(4) + b"\x37\x22")
            for name, data in {
                "lidar": bytes(packet),
                "position": rng.bytes(512),
                "odometry": json.dumps(pose).encode(),
                "autopilot": bytes(false.pack(mav)),
            }.items():
                udp.sendto(data, ("127.0.0.1", ports[name]))
                udp.sendto(rng.bytes(int(rng.integers(0, 1400))), ("127.0.0.1", ports[name]))
                count += 2
            time.sleep(1 / FORGED_HZ)
    return count


def frozen_viewer(port: int, folder: Path) -> subprocess.Popen[bytes] | str:
    """A viewer that connects and is stopped after a second; otherwise why there is none."""
    rerun = shutil.which("rerun", path=str(Path(sys.executable).parent))
    if rerun is None:
        return "no viewer (rerun) is installed with this Python"
    received = folder / "received.rrd"
    command = [rerun, f"rerun+http://127.0.0.1:{port}/proxy", "--save", str(received)]
    viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline_s = time.monotonic() + VIEWER_S
    while (
        time.monotonic() < deadline_s and viewer.poll() is None and not (received.exists() and received.stat().st_size)
    ):
        time.sleep(0.1)
    if viewer.poll() is not None or not (received.exists() and received.stat().st_size):
        viewer.kill()
        return f"the viewer does not start here, or received nothing within {VIEWER_S:g} s (exit code {viewer.wait()})"
    time.sleep(1.0)
    viewer.send_signal(signal.SIGSTOP)
    return viewer


def fly(stage: Setup, grd: subprocess.Popen[str], camera: Camera) -> None:
    """Apply one fault after the other."""
    command, ports = stage.command_rig, stage.ports
    viewers: list[subprocess.Popen[bytes]] = []

    def during(name: str, source: str | None, begin, end, hold_s: float = HOLD_S) -> None:
        fault = Fault(name, source, begin_s=time.time())
        fault.note = str(begin() or "")
        if fault.note.startswith(SKIPPED):
            fault.skipped = fault.note
            stage.faults.append(fault)
            return
        time.sleep(hold_s)
        end()
        fault.end_s = time.time()
        time.sleep(REST_S)
        fault.alive = grd.poll() is None
        stage.faults.append(fault)

    def nothing() -> None:
        pass

    def limit(size: int) -> None:
        resource.prlimit(grd.pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

    def disk_full() -> None:
        limit((stage.folder / "flight" / "flight.mcap").stat().st_size)

    def camera_is(off: bool) -> None:
        camera.off = off

    def freeze() -> str:
        viewer = frozen_viewer(ports["viewer"], stage.folder)
        if isinstance(viewer, str):
            return f"{SKIPPED}: {viewer}"
        viewers.append(viewer)
        return "a viewer stopped by SIGSTOP"

    def thaw() -> None:
        for viewer in viewers:
            viewer.kill()
            viewer.wait()

    def clock(ahead_s: float) -> None:
        (stage.folder / "ahead").write_text(str(ahead_s))

    during("LiDAR disconnected 3 s", "lidar", lambda: command("lidar off"), lambda: command("lidar on"))
    during("servo stalls 3 s", "servo", lambda: command("servo stall"), lambda: command("servo free"))
    during("servo: 20 replies 50 ms late", "servo", lambda: command("servo late 0.05 20"), nothing)
    during("servo: garbage before 300 replies", "servo", lambda: command("servo garbage 300"), nothing)
    during("servo unplugged 3 s", "servo", lambda: command("servo unplug"), lambda: command("servo plug_in"))
    during("servo without power 3 s", "servo", lambda: command("servo power_off"), lambda: command("servo power_on"))
    during("camera disconnected 3 s", "camera", lambda: camera_is(True), lambda: camera_is(False))
    during(
        "autopilot reboots, 3 s silent", "radio", lambda: command("autopilot off"), lambda: command("autopilot reboot")
    )
    during("forged packets, 3 s", None, lambda: f"{forge(ports, 3.0)} datagrams", nothing, 0.0)
    during("wall clock +1 h, then back", None, lambda: clock(3600.0), lambda: clock(0.0))
    during("viewer stopped 5 s", None, freeze, thaw, 5.0)
    during("disk full 5 s", "recorder", disk_full, lambda: limit(resource.RLIM_INFINITY), 5.0)


def evaluate(stage: Setup, faults: list[Fault], folder: Path) -> None:
    """Fill in the results of each fault from the results and the recording."""
    poses = positions(folder)
    arrivals: dict[str, np.ndarray] = {}
    for topic in (*SOURCES.values(), "/clock"):
        found = []
        for part in sorted(folder.glob("flight*.mcap")):
            with RecordingReader(part) as reader:
                found += [r.arrival_ns * 1e-9 for r in reader.records([topic])]
        arrivals[topic] = np.array(sorted(found))
    for fault in faults:
        after = fault.end_s
        if fault.source is not None:
            fault.back_s = first_after(arrivals[SOURCES[fault.source]], after)
        until = fault.end_s + REST_S
        mine = [p for p in poses if p.good and fault.begin_s <= p.stamp_s <= until]
        fault.good, errors = len(mine), errors_of(mine, stage.folder)
        fault.silent_s = float(np.diff([fault.begin_s, *(p.stamp_s for p in mine), until]).max())
        fault.wrong = int(np.count_nonzero((errors[:, 0] > WRONG_M) | (errors[:, 1] > WRONG_DEG)))
        fault.worst_m = float(errors[:, 0].max(initial=0.0))
        ticks = arrivals["/clock"]
        ticks = ticks[(ticks >= fault.begin_s - 1) & (ticks <= until)]
        fault.lost_s = float(np.diff(ticks).max(initial=0.0)) if len(ticks) > 1 else NEVER


def first_after(times_s: np.ndarray, after_s: float) -> float:
    later = times_s[times_s >= after_s]
    return float(later[0] - after_s) if len(later) else NEVER


_truth: dict[Path, TruthLog] = {}


def errors_of(poses: list[ResultPose], folder: Path) -> np.ndarray:
    """(n, 2): position error [m], yaw error [deg], 0 without a rotation."""
    truth = _truth.get(folder)
    if truth is None:
        truth = _truth[folder] = TruthLog()
        with RecordingReader(folder / "truth.mcap") as reader:
            truth.add_all(reader.records())
    stamps_ns, xyz_m = truth.drone_in_vehicle()  # the vehicle is parked with its axes along those of the world
    quaternions = np.array([truth.drones[1].pose[stamp][1] for stamp in stamps_ns.tolist()])
    yaw_rad = np.unwrap(2 * np.arctan2(quaternions[:, 2], quaternions[:, 3]), period=2 * np.pi)
    rows = []
    for pose in poses:
        true_m = [np.interp(pose.stamp_s, stamps_ns * 1e-9, xyz_m[:, axis]) for axis in range(3)]
        true_rad = np.interp(pose.stamp_s, stamps_ns * 1e-9, yaw_rad)
        error_rad = 2 * np.arctan2(pose.pose[5], pose.pose[6]) - true_rad
        error_deg = abs(np.degrees((error_rad + np.pi) % (2 * np.pi) - np.pi))
        rows.append((float(np.linalg.norm(np.array(pose.pose[:3]) - true_m)), float(error_deg) * pose.rotation))
    return np.array(rows).reshape(-1, 2)


def restart_s() -> float:
    """Pause of systemd before a restart (deploy/grd.service)."""
    return float(unit_file()["Service"]["RestartSec"])


def kill_and_restart(stage: Setup, grd: subprocess.Popen[str]) -> tuple[Fault, subprocess.Popen[str]]:
    """SIGKILL in flight, and a restart after the unit's pause as by the unit: no check, no warm-up."""
    fault = Fault(KILLED, "lidar", begin_s=time.time())
    grd.kill()
    grd.wait()
    fault.end_s = time.time()
    time.sleep(restart_s())
    restarted = stage.grd("restarted", "--no-warm-up")
    fault.position_s = stage.wait_for_poses("restarted", restarted) - fault.end_s
    fault.silent_s = stage.wait_for_poses("restarted", restarted, accepted=True) - fault.end_s
    time.sleep(3.0)
    fault.alive = restarted.poll() is None
    fault.note = f"first position after {fault.position_s:.1f} s, {restart_s():g} s of them as RestartSec"
    return fault, restarted


def table(stage: Setup, faults: list[Fault], start_s: float) -> str:
    rig = json.loads((stage.folder / "rig.json").read_text())
    lines = [
        f"rig: {rig['packets']} packets sent, {rig['packets_skipped']} skipped (0 on a fast machine)",
        f"from the command to the first position, with warm-up: {start_s:.1f} s",
        f"{'fault':36}{'running':>8}{'back [s]':>10}{'silent [s]':>11}{'good':>6}{'wrong':>6}{'worst [m]':>10}{'rec. gap [s]':>13}",
    ]
    lines += [
        f"{f.name:36}{'yes' if f.alive else 'NO':>8}{f.back_s:10.2f}{f.silent_s:11.2f}{f.good:6}{f.wrong:6}{f.worst_m:10.2f}"
        f"{f.lost_s:13.2f}  {f.note}"
        for f in faults
    ]
    return "\n".join(lines)


@dataclass(frozen=True)
class Flight:
    """Results of the flight."""

    faults: dict[str, Fault]  # by name, including the kill
    killed: Fault
    output: str  # of grd until it was killed


@pytest.fixture(scope="module")
def flight(stage):
    """One flight with all faults; prints its table."""
    begin_s = time.time()
    with Camera(stage.ports["camera"]) as camera:
        grd = stage.grd("flight")
        start_s = stage.wait_for_poses("flight", grd) - begin_s
        time.sleep(SETTLE_S)
        assert grd.poll() is None, (stage.folder / "flight.txt").read_text()
        fly(stage, grd, camera)
        killed, restarted = kill_and_restart(stage, grd)
        restarted.send_signal(signal.SIGINT)
        assert restarted.wait(TIMEOUT_S) == 0, (stage.folder / "restarted.txt").read_text()
    stage.rig.stdin.close()
    assert stage.rig.wait(60) == 0, (stage.folder / "rig.txt").read_text()
    evaluate(stage, stage.faults, stage.folder / "flight")
    last_s = max(last_arrival_s(part) for part in (stage.folder / "flight").glob("flight*.mcap"))
    killed.lost_s = killed.begin_s - last_s
    good = [p for p in positions(stage.folder / "restarted") if p.good]
    errors = errors_of(good, stage.folder)
    killed.good, killed.wrong = len(good), int(np.count_nonzero((errors > (WRONG_M, WRONG_DEG)).any(axis=1)))
    killed.worst_m = float(errors[:, 0].max(initial=0.0))
    everything = [*stage.faults, killed]
    sys.stdout.write("\n" + table(stage, everything, start_s) + "\n")
    return Flight({fault.name: fault for fault in everything}, killed, (stage.folder / "flight.txt").read_text())


@pytest.mark.parametrize("name", BOUNDS)
def test_fault_ends_in_time_and_poses_are_accepted(flight, name):
    fault, bounds = flight.faults[name], BOUNDS[name]
    if fault.skipped:
        pytest.skip(fault.skipped)
    assert fault.alive
    assert fault.wrong == 0
    assert fault.good >= bounds.poses
    assert bounds.back_s is None or fault.back_s <= bounds.back_s
    assert fault.silent_s <= bounds.silent_s


def test_every_fault_has_bounds(flight):
    assert set(flight.faults) == {*BOUNDS, KILLED}


def test_killed_grd_restarts_in_time_with_little_loss(flight):
    killed = flight.killed
    assert killed.alive
    assert killed.wrong == 0
    assert killed.good > 0
    assert killed.position_s <= FIRST_POSITION_S
    assert killed.silent_s <= FIRST_POSE_S
    assert killed.lost_s <= MAX_RECORDING_LOSS_S


def test_stopped_recording_is_reported(flight):
    assert "nothing is recorded now" in flight.output.replace("\n", " ")


def last_arrival_s(file: Path) -> float:
    with RecordingReader(file) as reader:
        return max((r.arrival_ns * 1e-9 for r in reader.records(["/clock"])), default=0.0)
