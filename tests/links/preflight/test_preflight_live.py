"""A complete preflight over real sockets and a pty, against simulated peers: GO and NO-GO."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Self, TypeVar

import pytest
from typer.testing import CliRunner

from flow.graph import Graph, load_graph
from links.cli.app import app
from links.lidar.decode import compile_kernels
from links.preflight.check_result import Level, is_go
from links.preflight.collect import ObservationTap
from links.preflight.preflight import observe, preflight_live
from links.simulated.autopilot.ardupilot_rules import ArduPilotRules
from links.simulated.autopilot.autopilot_socket import AutopilotSocket
from links.simulated.sensors.dynamixel_emulator import DynamixelEmulator
from links.simulated.sensors.servo import ServoSettings
from stages.geometry.rig_lidar import RigLidar
from tests.links.ports import free_port
from tests.links.preflight.preflight_peers import (
    START_NS,
    HandHeld,
    OnTheGround,
    film,
    good_parameters,
)
from tests.links.preflight.sending_lidar import SendingLidar

ROOT = Path(__file__).resolve().parents[3]
LISTEN_S = 2.2
MOST_REPEATED, LONGEST_STOP_S = 4, 0.3
T = TypeVar("T")
CONFIG = """\
include: {included}
links:
  lidar: {{config: {{port: {lidar}, timeout_s: 1.0}}}}
  servo: {{config: {{port: {servo}, start_timeout_s: 1.0, reply_timeout_s: 0.1, watchdog_s: 1.0}}}}
  autopilot: {{config: {{connection: "udpin:127.0.0.1:{autopilot}"}}, inputs: {{pose: fuse.relative_pose}}}}
  camera_vehicle: {{use: links.camera.Camera, config: {{topic: /camera/vehicle, source: {film}, size_px: 64}}}}
  recorder: {{use: links.recording.Recorder}}
  viewer: null
"""
HAND = """\
stages:
  tracker: {{use: tests.links.preflight.preflight_peers.FakeTracker, config: {{reflect: {reflect}}},
         inputs: {{position: autopilot.drone_local_position}}}}
links:
  autopilot: {{use: links.mavlink.Autopilot, config: {{connection: "udpin:127.0.0.1:{autopilot}"}}}}
"""


class Bench:
    """Peers on this host, and the configuration that finds them."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.config = folder, folder / "bench.yaml"
        self.ports = {"lidar": free_port(), "autopilot": free_port()}
        film(folder / "film.avi")

    def write(self, servo: Path, rig: str = "standard") -> Graph:
        included = f"[{ROOT}/configs/estimate.yaml, {ROOT}/configs/rigs/{rig}.yaml]"
        text = CONFIG.format(included=included, servo=servo, film=self.folder / "film.avi", **self.ports)
        return self.read(text)

    def read(self, text: str) -> Graph:
        """The configuration's graph; what takes long at the first time is done then, before the peers begin."""
        self.config.write_text(text)
        compile_kernels()
        return load_graph(self.config)

    def drone(self, **given) -> AutopilotSocket:
        given = {"flight": OnTheGround(), "parameters": good_parameters()} | given
        began_ns = time.monotonic_ns()
        scenario_ns = lambda: START_NS + time.monotonic_ns() - began_ns  # noqa: E731
        send_to = ("127.0.0.1", self.ports["autopilot"])
        return AutopilotSocket(ArduPilotRules(), send_to=send_to, scenario_ns=scenario_ns, **given)


@pytest.fixture
def bench(tmp_path):
    return Bench(tmp_path)


@pytest.fixture
def emulator():
    with DynamixelEmulator(ServoSettings(travel_deg=(0.0, 360.0), start_deg=90.0)) as servo:
        yield servo


def wait(seconds: float) -> None:
    threading.Event().wait(seconds)


def results_of(graph: Graph, ask=None, listen_s=LISTEN_S):
    return undisturbed(lambda: {v.name: v for v in preflight_live(graph, listen_s, wait, ask, step_s=0.6)})


class StopWatch(threading.Thread):
    """Measures for how long the host did not run this process, at most."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._done, self.longest_s = threading.Event(), 0.0

    def run(self) -> None:
        last = time.monotonic()
        while not self._done.wait(0.02):
            now = time.monotonic()
            self.longest_s, last = max(self.longest_s, now - last), now

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_) -> None:
        self._done.set()
        self.join()


def undisturbed(measure: Callable[[], T]) -> T:
    """A measurement in real time; it is repeated when a busy host stopped this process, and the peers in it."""
    for _ in range(MOST_REPEATED):
        with StopWatch() as watch:
            result = measure()
        if watch.longest_s < LONGEST_STOP_S:
            break
    return result


def test_a_ready_rig_is_go_with_exit_code_0(bench, emulator):
    bench.write(emulator.path)
    with SendingLidar(bench.ports["lidar"]), bench.drone():
        command = ["preflight", str(bench.config), "--for", str(LISTEN_S), "--no-motion"]
        result = undisturbed(lambda: CliRunner().invoke(app, command))
    assert result.exit_code == 0, result.output
    assert "GO: " in result.output
    names = ("lidar rate", "lidar losses", "servo replies", "camera_vehicle size", "autopilot parameters", "disk")
    for name in names:
        assert f" {name}: " in result.output, result.output


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rig", "packets_per_s"),
    [
        ("puck_hi_res", 754),
        ("vlp_32c", 1507),
        ("hdl_32e", 1808),
        ("xt16", 2500),
        ("xt32", 2500),
        ("os0_32_example", 640),
        ("os1_32_example", 640),
    ],
)
def test_a_lidar_of_each_model_passes_over_udp(bench, emulator, rig, packets_per_s):
    """Needs an idle core: a process that sends at the sensor's pace must not be late."""
    graph = bench.write(emulator.path, rig)
    unit = RigLidar.model_validate(graph.nodes["detect"].config["unit"])
    with SendingLidar(bench.ports["lidar"], unit), bench.drone():
        found = results_of(graph)
    lidar = {name: verdict for name, verdict in found.items() if name.startswith("lidar")}
    assert is_go(lidar.values()), lidar
    assert {"lidar rate", "lidar losses", "lidar return mode"} <= lidar.keys()
    measured = int(lidar["lidar rate"].sentence.split()[0])
    assert measured == pytest.approx(packets_per_s, rel=0.03)


def test_a_silent_rig_fails_for_each_device(bench, emulator):
    graph = bench.write(emulator.path)
    (bench.folder / "film.avi").unlink()
    emulator.silence()
    found = results_of(graph)
    assert not is_go(found.values())
    assert "no packet on UDP" in found["lidar packets"].sentence
    assert "the servo with id 1 does not reply" in found["servo replies"].sentence
    assert "no frame from " in found["autopilot heartbeat"].sentence
    assert "there is no file" in found["camera_vehicle frames"].sentence
    assert {n for n, v in found.items() if v.level is Level.OK} == {"disk"}
    assert not {"autopilot parameters", "axes: accelerometer"} & set(found)


def test_a_full_disk_a_wrong_parameter_and_an_inverted_axis_fail(bench, emulator, monkeypatch):
    graph = bench.write(emulator.path)
    monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=1e6))
    parameters = good_parameters() | {"EK3_SRC2_YAW": 6.0}
    with SendingLidar(bench.ports["lidar"]), bench.drone(flight=OnTheGround(upside_down=True), parameters=parameters):
        found = results_of(graph)
    assert {n for n, v in found.items() if v.level is Level.FAIL} == {
        "disk",
        "autopilot parameters",
        "axes: accelerometer",
    }
    assert "EK3_SRC2_YAW is 6, but must be 1 or 2 or 3" in found["autopilot parameters"].sentence
    assert "z is measured as -z" in found["axes: accelerometer"].sentence


@pytest.mark.parametrize(("sends_after", "waited_s"), [(0, 2.0), (10, 2.5), (1000, 4.0)])
def test_the_observation_begins_when_every_source_has_sent(sends_after, waited_s):
    waits = []

    class Starting(ObservationTap):
        @property
        def every_source_has_sent(self) -> bool:
            return len(waits) >= sends_after

    observe(Starting(), waits.append, 2.0)
    assert sum(waits) == pytest.approx(waited_s, abs=0.06)


@pytest.mark.parametrize(
    ("rotated", "reflect", "wrong"),
    [
        (False, 1, set()),
        (True, -1, {"by hand: nose down", "by hand: right side down", "axes: LiDAR and autopilot"}),
    ],
)
def test_hand_motions_show_the_signs_of_the_axes(tmp_path, rotated, reflect, wrong):
    with ExitStack() as stack:
        bench = Bench(tmp_path)
        graph = bench.read(HAND.format(reflect=reflect, **bench.ports))
        held = HandHeld(rotated)
        stack.enter_context(bench.drone(flight=held))
        found = results_of(graph, held.ask, listen_s=1.2)
    motions = {n: v for n, v in found.items() if n.startswith(("by hand", "axes"))}
    assert {n for n, v in motions.items() if v.level is Level.FAIL} == wrong, motions
    assert motions["axes: attitude's angular velocity"].level is Level.OK, motions
    assert found["lidar"].level is Level.FAIL
