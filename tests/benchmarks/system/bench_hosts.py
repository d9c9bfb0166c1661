"""Hosts: codec time compared with pickle, added latency of a hop over loopback TLS, and throughput.

pytest tests/benchmarks/system/bench_hosts.py -s
"""

from __future__ import annotations

import pickle
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from flow.remote.codec import decode, encode
from stages.messages import DroneFix, Image, SweptPulses

sys.path.append(str(Path(__file__).parents[2] / "links" / "zenoh"))
from socket import SOCK_STREAM

from certificates import make_all, need_openssl
from host_processes import HostProcess, write_config, write_hosts

from tests.links.ports import free_port

PULSES = 384
MESSAGES = {
    "image 1440 px": Image(stamp_ns=1, frame_id="camera_drone", grey=np.zeros((1440, 1440), np.uint8)),
    "a packet's pulses": SweptPulses(
        stamp_ns=1,
        point_stamp_ns=np.zeros(PULSES, np.int64),
        direction_vehicle=np.zeros((PULSES, 3), np.float32),
        range_m=np.zeros(PULSES, np.float32),
        laser=np.zeros(PULSES, np.uint8),
        reflectivity=np.zeros(PULSES, np.uint8),
        turntable_rad=0.0,
        origin_vehicle_m=(0.0, 0.0, 0.0),
    ),
    "fix": DroneFix(stamp_ns=1, xyz_vehicle_m=np.zeros(3), covariance_m2=np.eye(3), hits=1, track_id=1),
}
CLASSES = {cls.__name__: cls for cls in (Image, SweptPulses, DroneFix)}


@pytest.mark.parametrize("name", MESSAGES)
@pytest.mark.benchmark(group="encode")
def test_encode(benchmark, name):
    benchmark(encode, MESSAGES[name])


@pytest.mark.parametrize("name", MESSAGES)
@pytest.mark.benchmark(group="encode")
def test_pickle_dumps(benchmark, name):
    benchmark(pickle.dumps, MESSAGES[name], pickle.HIGHEST_PROTOCOL)


@pytest.mark.parametrize("name", MESSAGES)
@pytest.mark.benchmark(group="decode")
def test_decode(benchmark, name):
    benchmark(decode, encode(MESSAGES[name]), CLASSES)


@pytest.mark.parametrize("name", MESSAGES)
@pytest.mark.benchmark(group="decode")
def test_pickle_loads(benchmark, name):
    benchmark(pickle.loads, pickle.dumps(MESSAGES[name], pickle.HIGHEST_PROTOCOL))


def latency(lines: list[dict], field: str) -> str:
    late_ms = sorted(line[field] for line in lines)
    return f"p50 {late_ms[len(late_ms) // 2]:.2f}, p99 {late_ms[int(len(late_ms) * 0.99)]:.2f} ms of {len(late_ms)}"


def placement(host: str) -> dict[str, str]:
    return {"beats": "drone", "echo": host, "sink": host}


@pytest.mark.parametrize("size_px", [64, 720, 1440])
def test_latency_of_a_hop(tmp_path, capsys, size_px):
    """Small messages at 100 Hz and images at 10 Hz from source to sink, in one process and over a hop."""
    need_openssl()
    make_all(tmp_path)
    config = write_config(tmp_path, size_px=size_px)
    hosts = write_hosts(tmp_path, f"127.0.0.1:{free_port(SOCK_STREAM)}", placement("vehicle"))
    with HostProcess(config, Path("-"), "all") as one:
        one.wait_for("image", 5)
        one.lines.clear()
        one.wait_for("image", 100, 60.0)
    with HostProcess(config, hosts, "vehicle") as vehicle, HostProcess(config, hosts, "drone"):
        vehicle.wait_for("image", 5)
        vehicle.lines.clear()
        vehicle.wait_for("image", 100, 60.0)
        uncertainty_us = vehicle.report()["counters"]["beats"]["clock uncertainty [us]"]
    with capsys.disabled():
        sys.stdout.write(f"\n{size_px} px, clock uncertainty {uncertainty_us} us\n")
        for kind, field in (("beat", "true_late_ms"), ("image", "late_ms")):
            sys.stdout.write(f"  {kind}: one process {latency(one.of(kind), field)};")
            sys.stdout.write(f" over a hop {latency(vehicle.of(kind), field)}\n")


def test_throughput(tmp_path, capsys):
    """Images of 1440 px at the maximum rate of two cores."""
    need_openssl()
    make_all(tmp_path)
    config = write_config(tmp_path, rate_hz=200.0, every=1, size_px=1440)
    hosts = write_hosts(tmp_path, f"127.0.0.1:{free_port(SOCK_STREAM)}", placement("vehicle"))
    with HostProcess(config, hosts, "vehicle") as vehicle, HostProcess(config, hosts, "drone") as drone:
        vehicle.wait_for("image", 5)
        vehicle.lines.clear()
        before, begin_s = drone.report()["counters"]["to_vehicle"]["sent bytes"], time.monotonic()
        vehicle.wait_for("image", 200, 60.0)
        sent, took_s = drone.report()["counters"]["to_vehicle"]["sent bytes"] - before, time.monotonic() - begin_s
    with capsys.disabled():
        late = latency(vehicle.of("image"), "late_ms")
        sys.stdout.write(f"\n{sent / took_s / 1e6:.0f} MB/s, {200 / took_s:.0f} images/s, {late}\n")
