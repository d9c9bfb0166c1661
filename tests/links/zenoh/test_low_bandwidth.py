"""A 30 Mbit/s connection between two network namespaces, with 83 Mbit/s offered, and interrupted."""

from __future__ import annotations

import importlib.util
import os
import subprocess

import pytest
from certificates import make_all, need_openssl
from host_processes import HostProcess, can_make_namespaces, write_config, write_hosts

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("zenoh") is None, reason="needs Eclipse Zenoh: pip install -e '.[hosts]'"
)
VEHICLE_ADDRESS, DRONE_ADDRESS = "10.77.0.1", "10.77.0.2"
RATE_MBIT = 30
SIZE_PX, IMAGES_HZ = 720, 20  # 83 Mbit/s
IMAGE_MS = SIZE_PX**2 * 8 / RATE_MBIT / 1e3  # 138 ms


def ip(*command: str) -> None:
    done = subprocess.run(["ip", *command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"ip {' '.join(command)}: {done.stderr}"


@pytest.fixture
def line():
    """Two connected namespaces: (vehicle's, drone's, network interface of the drone)."""
    if not can_make_namespaces():
        pytest.skip("needs root and `ip netns`")
    tag = str(os.getpid())
    names = (f"grd_v{tag}", f"grd_d{tag}")
    ends = (f"v{tag}", f"d{tag}")
    try:
        for name in names:
            ip("netns", "add", name)
        ip("link", "add", ends[0], "netns", names[0], "type", "veth", "peer", "name", ends[1], "netns", names[1])
        for name, end, address in zip(names, ends, (VEHICLE_ADDRESS, DRONE_ADDRESS), strict=True):
            ip("-n", name, "addr", "add", f"{address}/24", "dev", end)
            ip("-n", name, "link", "set", "lo", "up")
            ip("-n", name, "link", "set", end, "up")
            shape = [
                "tc",
                "qdisc",
                "add",
                "dev",
                end,
                "root",
                "tbf",
                "rate",
                f"{RATE_MBIT}mbit",
                "burst",
                "32k",
                "latency",
                "50ms",
            ]
            done = subprocess.run(["ip", "netns", "exec", name, *shape], capture_output=True, text=True, check=False)
            if done.returncode:
                pytest.skip(f"needs the kernel's tbf queue: {done.stderr.strip()}")
        yield (*names, ends[1])
    finally:
        for name in names:
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)


def test_newest_image_is_sent_and_small_messages_overtake_it(line, tmp_path):
    vehicle_side, drone_side, end = line
    need_openssl()
    make_all(tmp_path, VEHICLE_ADDRESS)
    config = write_config(tmp_path, rate_hz=5.0 * IMAGES_HZ, every=5, size_px=SIZE_PX)
    placement = {"beats": "drone", "echo": "vehicle", "sink": "vehicle"}
    hosts = write_hosts(tmp_path, f"{VEHICLE_ADDRESS}:7447", placement)
    with (
        HostProcess(config, hosts, "vehicle", ahead_s=-3600.0, namespace=vehicle_side) as vehicle,
        HostProcess(config, hosts, "drone", namespace=drone_side) as drone,
    ):
        vehicle.wait_for("image", 4)
        sent_before = drone.report()["counters"]["to_vehicle"]
        beats_before = len(vehicle.of("beat"))
        images = vehicle.wait_for("image", 20)
        beats = vehicle.of("beat")[beats_before:]
        counters = drone.report()["counters"]["to_vehicle"]

        # An unlimited queue would be 1.8 s late by now.
        assert max(p["late_ms"] for p in images) < 8 * IMAGE_MS
        assert counters["dropped: beats.image"] > sent_before.get("dropped: beats.image", 0) + 10
        numbers = [p["number"] for p in images]
        assert numbers == sorted(set(numbers))
        # Beats do not wait for images, and few are lost.
        assert sorted(b["true_late_ms"] for b in beats)[len(beats) // 2] < 2 * IMAGE_MS
        assert len(beats) > 0.8 * (beats[-1]["number"] - beats[0]["number"])
        assert max(abs(b["late_ms"] - b["true_late_ms"]) for b in beats) < 25.0

        ip("-n", drone_side, "link", "set", end, "down")
        vehicle.until_status("beats", "has not replied for")
        ip("-n", drone_side, "link", "set", end, "up")
        vehicle.until(lambda line: line["kind"] == "image" and line["late_ms"] < 8 * IMAGE_MS)
        vehicle.until_status("beats", None)
