"""The field's stack in flight against the simulated rig, with everything that can fail failing in turn: one table.

    python -m pytest -m slow -s tests/links/test_live_faults.py

Real sockets and a pty, five minutes of flight; the rig is a process of its own. It needs two free cores: on a busy
machine the times are the machine's. Cameras: one, whose pictures nobody looks at; the link is what is tried. One
flight for all tests; what each fault must keep stands in `fault_bounds.py`.
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
from tests.links.fault_bounds import KEPT_S, KILLED, MUST, POSES_AGAIN_S, POSITION_AGAIN_S, REST_S
from tests.links.ports import free_ports
from tests.unit_file import unit_file

pytestmark = pytest.mark.slow
pytest.importorskip("embreex", reason="simulating needs embreex: pip install -e '.[simulate]'")

ROOT = Path(__file__).resolve().parents[2]
SETTLE_S, HOLD_S = 25.0, 3.0
PATIENCE_S = 240.0
WRONG_M, WRONG_DEG = 1.0, 30.0  # a pose given out as good and this far off is wrong
FORGED_HZ = 200
SKIPPED = "not tried"
VIEWER_S = 20.0  # within which a viewer must have seen something
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
    """One fault as it was: when it began and ended (UTC [s]), and who was hit."""

    name: str
    source: str | None  # whose records stop
    begin_s: float = 0.0
    end_s: float = 0.0
    note: str = ""
    skipped: str = ""  # why it could not be tried
    alive: bool = True
    back_s: float = NEVER  # from the fault's end to the first record of the source
    silent_s: float = NEVER  # longest time without a pose given out; killed: from the kill to the first
    position_s: float = NEVER  # killed: to the first position
    good: int = 0
    wrong: int = 0
    worst_m: float = 0.0
    lost_s: float = 0.0  # longest gap of the recording


@dataclass
class Stage:
    """The set: ports, folders, and the rig."""

    folder: Path
    ports: dict[str, int]
    rig: subprocess.Popen[str]
    faults: list[Fault] = field(default_factory=list)

    def tell_rig(self, line: str) -> None:
        self.rig.stdin.write(line + "\n")
        self.rig.stdin.flush()

    def grd(self, name: str, *words: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "tests.links.stepped_clock", str(self.folder / "ahead"), "run"]
        command += ["configs/sim_live.yaml", "--overlay", str(self.folder / "faults.yaml"), *words]
        command += ["--out", str(self.folder / name)]
        with (self.folder / f"{name}.txt").open("w") as log:
            return subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=subprocess.STDOUT, text=True)

    def wait_for_poses(self, run: str, grd: subprocess.Popen[str], *, given: bool = False) -> float:
        """Until the run tells a position, or a pose that is given out; when it was."""
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s and grd.poll() is None:
            stamps_s = [told.stamp_s for told in positions(self.folder / run) if told.good or not given]
            if stamps_s:
                return stamps_s[0]
            time.sleep(0.1)
        return NEVER


@dataclass(frozen=True)
class Told:
    """One pose of the results."""

    stamp_s: float
    good: bool
    pose: tuple[float, ...]  # xyz, quaternion


def positions(folder: Path) -> list[Told]:
    poses, table = folder / "pose_vehicle_drone.tum", folder / "pose_covariance.csv"
    if not poses.exists() or not table.exists():
        return []
    good = {row["stamp_s"]: row["accepted"] == "1" for row in csv.DictReader(table.read_text().splitlines())}
    lines = [line.split() for line in poses.read_text().splitlines() if line[:1].isdigit()]
    whole = [line for line in lines if len(line) == 8 and line[0] in good]
    return [Told(float(line[0]), good[line[0]], tuple(map(float, line[1:]))) for line in whole]


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
    made = Stage(tmp_path, ports, rig)
    yield made
    if rig.poll() is None:
        rig.stdin.close()
        rig.wait(30)


class Camera:
    """Ten pictures a second on the camera's port, in a thread; `off` closes the port."""

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
    """Garbage and well-made lies from another address of this host, to every port; how many."""
    rng = np.random.default_rng(4)
    mav = ardupilotmega.MAVLink(None, srcSystem=1, srcComponent=1)
    count, until_s = 0, time.monotonic() + for_s
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.2", 0))
        while time.monotonic() < until_s:
            lie = mav.odometry_encode(
                int(time.time() * 1e6), 1, 1, 50.0, 50.0, 9.0, [1.0, 0, 0, 0], *[9.0] * 6, [1e-6] * 21, [1e-6] * 21
            )
            pose = {"xyz_m": [9, 9, 9], "quaternion_xyzw": [0, 0, 0, 1], "covariance": [0] * 36, "age_s": 0}
            packet = bytearray((b"\xff\xee" + rng.bytes(98)) * 12 + rng.bytes(4) + b"\x37\x22")
            for name, data in {
                "lidar": bytes(packet),
                "position": rng.bytes(512),
                "odometry": json.dumps(pose).encode(),
                "autopilot": bytes(lie.pack(mav)),
            }.items():
                udp.sendto(data, ("127.0.0.1", ports[name]))
                udp.sendto(rng.bytes(int(rng.integers(0, 1400))), ("127.0.0.1", ports[name]))
                count += 2
            time.sleep(1 / FORGED_HZ)
    return count


def frozen_viewer(port: int, folder: Path) -> subprocess.Popen[bytes] | str:
    """A viewer that connects, sees for a second and then stands still; else why there is none."""
    rerun = shutil.which("rerun", path=str(Path(sys.executable).parent))
    if rerun is None:
        return "no viewer is installed beside this Python (rerun)"
    seen = folder / "seen.rrd"
    command = [rerun, f"rerun+http://127.0.0.1:{port}/proxy", "--save", str(seen)]
    viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline_s = time.monotonic() + VIEWER_S
    while time.monotonic() < deadline_s and viewer.poll() is None and not (seen.exists() and seen.stat().st_size):
        time.sleep(0.1)
    if viewer.poll() is not None or not (seen.exists() and seen.stat().st_size):
        viewer.kill()
        return f"the viewer does not start here, or saw nothing within {VIEWER_S:g} s (exit code {viewer.wait()})"
    time.sleep(1.0)
    viewer.send_signal(signal.SIGSTOP)
    return viewer


def fly(stage: Stage, grd: subprocess.Popen[str], camera: Camera) -> None:
    """One fault after the other."""
    tell, ports = stage.tell_rig, stage.ports
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

    during("LiDAR cut 3 s", "lidar", lambda: tell("lidar off"), lambda: tell("lidar on"))
    during("servo stalls 3 s", "servo", lambda: tell("servo stall"), lambda: tell("servo free"))
    during("servo: 20 answers 50 ms late", "servo", lambda: tell("servo late 0.05 20"), nothing)
    during("servo: garbage before 300 answers", "servo", lambda: tell("servo garbage 300"), nothing)
    during("servo unplugged 3 s", "servo", lambda: tell("servo unplug"), lambda: tell("servo plug_in"))
    during("servo: power fails 3 s", "servo", lambda: tell("servo power_off"), lambda: tell("servo power_on"))
    during("camera gone 3 s", "camera", lambda: camera_is(True), lambda: camera_is(False))
    during(
        "autopilot boots again, 3 s silent", "radio", lambda: tell("autopilot off"), lambda: tell("autopilot reboot")
    )
    during("forged packets, 3 s", None, lambda: f"{forge(ports, 3.0)} datagrams", nothing, 0.0)
    during("wall clock +1 h, then back", None, lambda: clock(3600.0), lambda: clock(0.0))
    during("viewer stands still 5 s", None, freeze, thaw, 5.0)
    during("disk full 5 s", "recorder", disk_full, lambda: limit(resource.RLIM_INFINITY), 5.0)


def judge(stage: Stage, faults: list[Fault], folder: Path) -> None:
    """What the results and the recording say of each fault."""
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


def errors_of(poses: list[Told], folder: Path) -> np.ndarray:
    """(n, 2): off by so much [m], turned too far about z [deg]."""
    truth = _truth.get(folder)
    if truth is None:
        truth = _truth[folder] = TruthLog()
        with RecordingReader(folder / "truth.mcap") as reader:
            truth.add_all(reader.records())
    stamps_ns, xyz_m = truth.drone_in_vehicle()  # the vehicle stands still with its axes along the world's
    quaternions = np.array([truth.drones[1].pose[stamp][1] for stamp in stamps_ns.tolist()])
    yaw_rad = np.unwrap(2 * np.arctan2(quaternions[:, 2], quaternions[:, 3]), period=2 * np.pi)
    rows = []
    for told in poses:
        there = [np.interp(told.stamp_s, stamps_ns * 1e-9, xyz_m[:, axis]) for axis in range(3)]
        true_rad = np.interp(told.stamp_s, stamps_ns * 1e-9, yaw_rad)
        turned = 2 * np.arctan2(told.pose[5], told.pose[6]) - true_rad
        turned_deg = abs(np.degrees((turned + np.pi) % (2 * np.pi) - np.pi))
        rows.append((float(np.linalg.norm(np.array(told.pose[:3]) - there)), float(turned_deg)))
    return np.array(rows).reshape(-1, 2)


def restart_s() -> float:
    """How long systemd waits before it starts grd again (deploy/grd.service)."""
    return float(unit_file()["Service"]["RestartSec"])


def kill_and_restart(stage: Stage, grd: subprocess.Popen[str]) -> tuple[Fault, subprocess.Popen[str]]:
    """SIGKILL in flight; and after the unit's pause what the unit starts then: no check, no warm-up."""
    fault = Fault(KILLED, "lidar", begin_s=time.time())
    grd.kill()
    grd.wait()
    fault.end_s = time.time()
    time.sleep(restart_s())
    again = stage.grd("again", "--no-warm-up")
    fault.position_s = stage.wait_for_poses("again", again) - fault.end_s
    fault.silent_s = stage.wait_for_poses("again", again, given=True) - fault.end_s
    time.sleep(3.0)
    fault.alive = again.poll() is None
    fault.note = f"first position after {fault.position_s:.1f} s, {restart_s():g} s of them as RestartSec"
    return fault, again


def table(stage: Stage, faults: list[Fault], start_s: float) -> str:
    rig = json.loads((stage.folder / "rig.json").read_text())
    lines = [
        f"rig: {rig['packets']} packets sent, {rig['packets_skipped']} not: 0 on a machine that is fast enough",
        f"from the command to the first position, with warm-up: {start_s:.1f} s",
        f"{'fault':36}{'flew on':>8}{'back [s]':>10}{'silent [s]':>11}{'good':>6}{'wrong':>6}{'worst [m]':>10}{'rec. gap [s]':>13}",
    ]
    lines += [
        f"{f.name:36}{'yes' if f.alive else 'NO':>8}{f.back_s:10.2f}{f.silent_s:11.2f}{f.good:6}{f.wrong:6}{f.worst_m:10.2f}"
        f"{f.lost_s:13.2f}  {f.note}"
        for f in faults
    ]
    return "\n".join(lines)


@dataclass(frozen=True)
class Flight:
    """The flight when it is over."""

    faults: dict[str, Fault]  # by name, the kill among them
    killed: Fault
    said: str  # by grd, before it was killed


@pytest.fixture(scope="module")
def flight(stage):
    """One flight with every fault in turn, and the table of it."""
    begin_s = time.time()
    with Camera(stage.ports["camera"]) as camera:
        grd = stage.grd("flight")
        start_s = stage.wait_for_poses("flight", grd) - begin_s
        time.sleep(SETTLE_S)
        assert grd.poll() is None, (stage.folder / "flight.txt").read_text()
        fly(stage, grd, camera)
        killed, again = kill_and_restart(stage, grd)
        again.send_signal(signal.SIGINT)
        assert again.wait(PATIENCE_S) == 0, (stage.folder / "again.txt").read_text()
    stage.rig.stdin.close()
    assert stage.rig.wait(60) == 0, (stage.folder / "rig.txt").read_text()
    judge(stage, stage.faults, stage.folder / "flight")
    last_s = max(last_arrival_s(part) for part in (stage.folder / "flight").glob("flight*.mcap"))
    killed.lost_s = killed.begin_s - last_s
    good = [p for p in positions(stage.folder / "again") if p.good]
    errors = errors_of(good, stage.folder)
    killed.good, killed.wrong = len(good), int(np.count_nonzero((errors > (WRONG_M, WRONG_DEG)).any(axis=1)))
    killed.worst_m = float(errors[:, 0].max(initial=0.0))
    everything = [*stage.faults, killed]
    sys.stdout.write("\n" + table(stage, everything, start_s) + "\n")
    return Flight({fault.name: fault for fault in everything}, killed, (stage.folder / "flight.txt").read_text())


@pytest.mark.parametrize("name", MUST)
def test_a_fault_is_over_in_time_and_poses_go_out(flight, name):
    fault, must = flight.faults[name], MUST[name]
    if fault.skipped:
        pytest.skip(fault.skipped)
    assert fault.alive
    assert fault.wrong == 0
    assert fault.good >= must.poses
    assert must.back_s is None or fault.back_s <= must.back_s
    assert fault.silent_s <= must.silent_s


def test_every_fault_that_was_tried_has_its_bounds(flight):
    assert set(flight.faults) == {*MUST, KILLED}


def test_grd_that_is_killed_comes_again_in_time_and_little_is_lost(flight):
    killed = flight.killed
    assert killed.alive
    assert killed.wrong == 0
    assert killed.good > 0
    assert killed.position_s <= POSITION_AGAIN_S
    assert killed.silent_s <= POSES_AGAIN_S
    assert killed.lost_s <= KEPT_S


def test_that_nothing_is_recorded_was_said(flight):
    assert "nothing is recorded now" in flight.said.replace("\n", " ")


def last_arrival_s(file: Path) -> float:
    with RecordingReader(file) as reader:
        return max((r.arrival_ns * 1e-9 for r in reader.records(["/clock"])), default=0.0)
