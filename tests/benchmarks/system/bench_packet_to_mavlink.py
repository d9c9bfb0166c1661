"""How much later than the LiDAR packet that let it out a pose leaves for the autopilot.

    python -m pytest tests/benchmarks/system/bench_packet_to_mavlink.py -s
    GRD_FLIGHT=out/live/flight.mcap python -m pytest tests/benchmarks/system/bench_packet_to_mavlink.py -s

The first flies a simulated drone in closed loop through the whole graph, on one thread: it times each record, from when
it is fed until it is taken in, or until the datagram of the pose that it lets out is read at a peer's socket: a LiDAR
packet's pose leaves with the next 20 ms of poses, so both count, and it is the computing alone. With GRD_FLIGHT, the
recording of a live run (`grd run`), threads and their queues are in it: a pose is predicted to the newest stamp received,
so it could go out when the first record of that time or later had arrived; its ODOMETRY frame did so at the time recorded.
"""

from __future__ import annotations

import os
import socket
import sys
import time
from bisect import bisect_left
from pathlib import Path

import numpy as np
import pytest

from flow.link import Tap
from flow.replay import Replay
from links.clock import host_time
from links.mavlink import Autopilot
from links.mavlink.transport.framing import parse_frame
from links.recording import RecordingReader
from links.runs.request import RunRequest
from links.simulated.matrix.flights import Cell
from links.simulated.matrix.matrix import Conditions, scenario_of
from links.simulated.rig.run import Simulation
from stages.messages import RelativePose

sys.path.append(str(Path(__file__).parents[2] / "links" / "mavlink"))
from tests.links.mavlink.mavlink_poses import good_pose

CONFIG = Path(__file__).resolve().parents[3] / "configs" / "estimate.yaml"
ODOMETRY = 331
FLIGHT = os.environ.get("GRD_FLIGHT")


class ToAutopilot(Tap):
    """Hands each fused pose to a live autopilot link, as good and of now, and waits for its datagram at the peer."""

    def __init__(self) -> None:
        super().__init__()
        self._out: list[int] = []

    def wire(self, link: Autopilot, peer: socket.socket) -> None:
        self._link, self._peer = link, peer

    def see(self, output, message, arrival_ns) -> None:
        if isinstance(message, RelativePose):
            self._link.on_pose(good_pose(host_time.now_ns()))
            while int.from_bytes(self._peer.recv(400)[7:10], "little") != ODOMETRY:
                pass
            self._out.append(time.perf_counter_ns())

    def took(self) -> int | None:
        """When the newest pose since the call before was read; None: none went out."""
        newest, self._out = (self._out[-1] if self._out else None), []
        return newest


def report(name: str, took_ms: list[float]) -> None:
    p50, p99 = np.percentile(took_ms, [50, 99])
    print(f"\n{name}: p50 {p50:.2f}, p99 {p99:.2f}, max {max(took_ms):.1f} ms, {len(took_ms)} times")  # noqa: T201


def test_a_packet_to_its_poses_datagram_by_computing() -> None:
    scenario = scenario_of(Cell("manhattan", 10, "orbit", "driving"), 1, Conditions(odometry=True, autopilot=True))
    graph = RunRequest(CONFIG, sets=("viewer.file=null",)).graph(scenario.rig_yaml(), scenario.name)
    tap = ToAutopilot()
    runner, packet_ms, pose_ms = Replay(graph, (tap,)), [], []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(5.0)
        link = Autopilot(connection=f"udpout:127.0.0.1:{peer.getsockname()[1]}", yaw="measured")
        with link.listen():
            tap.wire(link, peer)
            for record in Simulation(scenario).records():
                begin = time.perf_counter_ns()
                runner.feed(record)
                out = tap.took()
                if out is not None:
                    pose_ms.append(1e-6 * (out - begin))
                elif record.topic == "/lidar/packets":
                    packet_ms.append(1e-6 * (time.perf_counter_ns() - begin))
    report("LiDAR packet taken in, one thread", packet_ms[len(packet_ms) // 10 :])  # the first are compiled meanwhile
    report("record that releases a pose -> datagram, one thread", pose_ms[len(pose_ms) // 10 :])


@pytest.mark.skipif(FLIGHT is None, reason="GRD_FLIGHT names no recording of a live run")
def test_a_packet_to_its_poses_datagram_in_a_live_run() -> None:
    with RecordingReader(Path(FLIGHT or "")) as reader:
        packets, sent = [], []
        for record in reader.records(["/lidar/packets", "/servo/state", "/autopilot/rx", "/autopilot/tx"]):
            if record.topic != "/autopilot/tx":
                packets.append((record.stamp_ns, record.arrival_ns))
            elif (frame := parse_frame(record.data)).get_type() == "ODOMETRY":
                sent.append((1000 * frame.time_usec, record.arrival_ns))
    packets.sort()
    stamps = [stamp for stamp, _ in packets]
    firsts = [bisect_left(stamps, stamp) for stamp, _ in sent]
    after = [1e-6 * (out - packets[i][1]) for (_, out), i in zip(sent, firsts, strict=True) if i < len(packets)]
    assert after, f"{FLIGHT} holds no ODOMETRY that was sent"
    report("first record of the pose's time -> datagram, live", after)
    report("stamp of the pose -> datagram, live", [1e-6 * (out - stamp) for stamp, out in sent])
