"""The autopilot link: from a pose to its bytes on a socket, and from received bytes to a message, compared with pymavlink.

    python -m pytest tests/benchmarks/bench_mavlink.py --benchmark-columns=min,median,max,iqr -s

`test_a_pose_to_the_peers_socket` also prints the 99th percentile of pose -> datagram read at the other end.
"""

from __future__ import annotations

import dataclasses
import socket
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega

from links.clock import host_time
from links.mavlink import Autopilot
from links.mavlink.poses.gate import PoseLimits, reject_reason
from links.mavlink.poses.pose_messages import odometry
from links.mavlink.poses.sent_frame import SentFrame
from links.mavlink.transport.framing import FrameSplitter, packed

sys.path.append(str(Path(__file__).parents[1] / "links" / "mavlink"))
from tests.links.mavlink.mavlink_poses import HOST0, good_pose

mavlink: Any = ardupilotmega
LIMITS = PoseLimits()


def test_the_gate(benchmark: Any):
    assert benchmark(reject_reason, good_pose(), HOST0, LIMITS) is None


def test_a_pose_to_a_frame(benchmark: Any):
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=197)
    benchmark(lambda: packed(odometry(good_pose(), SentFrame(0.0, np.zeros(3)), 0, LIMITS), mav))


def test_pymavlink_packing_the_same_message(benchmark: Any):
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=197)
    message = odometry(good_pose(), SentFrame(0.0, np.zeros(3)), 0, LIMITS)
    benchmark(lambda: packed(message, mav))


def test_a_received_frame_to_a_message(benchmark: Any):
    frame = packed(mavlink.MAVLink_attitude_message(1, 0, 0, 0, 0, 0, 0), mavlink.MAVLink(None, 1, 1))
    splitter = FrameSplitter()
    assert len(benchmark(splitter.datagram, frame)) == 1


def test_pymavlink_parsing_the_same_frame(benchmark: Any):
    frame = packed(mavlink.MAVLink_attitude_message(1, 0, 0, 0, 0, 0, 0), mavlink.MAVLink(None, 1, 1))
    mav = mavlink.MAVLink(None)
    mav.robust_parsing = True
    assert len(benchmark(mav.parse_buffer, frame)) == 1


@pytest.mark.parametrize("signed", [False, True], ids=["plain", "signed"])
def test_a_pose_to_the_peers_socket(benchmark: Any, tmp_path: Path, signed: bool):
    key = tmp_path / "key"
    key.write_bytes(bytes(32))
    key.chmod(0o600)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(5.0)
        connection = f"udpout:127.0.0.1:{peer.getsockname()[1]}"
        link = Autopilot(connection=connection, yaw="measured", signing_key=key if signed else None)
        took_ms: list[float] = []
        with link.listen():
            pose = good_pose()

            def send() -> None:
                begin = time.perf_counter_ns()
                now_ns = host_time.now_ns()
                link.on_pose(dataclasses.replace(pose, stamp_ns=now_ns, rotation_ns=now_ns))
                while int.from_bytes(peer.recv(400)[7:10], "little") != 331:  # ODOMETRY; heartbeats pass by
                    pass
                took_ms.append(1e-6 * (time.perf_counter_ns() - begin))

            benchmark.pedantic(send, rounds=2000, iterations=1, warmup_rounds=20)
    p50, p99 = np.percentile(took_ms, [50, 99])
    sys.stdout.write(
        f"\npose -> datagram at the peer, {'signed' if signed else 'plain'}: p50 {p50:.3f} ms, p99 {p99:.3f} ms\n"
    )
