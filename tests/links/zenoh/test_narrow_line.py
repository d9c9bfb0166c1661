"""A 30 Mbit/s line between two network namespaces, offered nearly three times as much, and cut as a cable is."""

from __future__ import annotations

import importlib.util
import os
import subprocess

import pytest
from certificates import make_all, need_openssl
from hosts_running import HostProcess, can_make_namespaces, write_config, write_hosts

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("zenoh") is None, reason="needs Eclipse Zenoh: pip install -e '.[hosts]'"
)
VEHICLE_ADDRESS, DRONE_ADDRESS = "10.77.0.1", "10.77.0.2"
RATE_MBIT = 30
SIZE_PX, PICTURES_HZ = 720, 20  # 83 Mbit/s
PICTURE_MS = SIZE_PX**2 * 8 / RATE_MBIT / 1e3  # 138 ms on the line


def ip(*command: str) -> None:
    done = subprocess.run(["ip", *command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"ip {' '.join(command)}: {done.stderr}"


@pytest.fixture
def line():
    """Two namespaces and a line between them: (vehicle's, drone's, the drone's end of the line)."""
    if not can_make_namespaces():
        pytest.skip("needs root and `ip netns`: a line of its own")
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


def test_on_a_line_too_narrow_the_newest_picture_comes_and_small_messages_overtake_it(line, tmp_path):
    vehicle_side, drone_side, end = line
    need_openssl()
    make_all(tmp_path, VEHICLE_ADDRESS)
    config = write_config(tmp_path, rate_hz=5.0 * PICTURES_HZ, every=5, size_px=SIZE_PX)
    placement = {"beats": "drone", "echo": "vehicle", "teller": "vehicle"}
    hosts = write_hosts(tmp_path, f"{VEHICLE_ADDRESS}:7447", placement)
    with (
        HostProcess(config, hosts, "vehicle", ahead_s=-3600.0, namespace=vehicle_side) as vehicle,
        HostProcess(config, hosts, "drone", namespace=drone_side) as drone,
    ):
        vehicle.wait_for("picture", 4)
        sent_before = drone.report()["counters"]["to_vehicle"]
        beats_before = len(vehicle.of("beat"))
        pictures = vehicle.wait_for("picture", 20)
        beats = vehicle.of("beat")[beats_before:]
        counters = drone.report()["counters"]["to_vehicle"]

        # A queue without end would be 1.8 s behind by now; what is late here is the line's time for two pictures.
        assert max(p["late_ms"] for p in pictures) < 8 * PICTURE_MS
        assert counters["dropped: beats.picture"] > sent_before.get("dropped: beats.picture", 0) + 10
        numbers = [p["number"] for p in pictures]
        assert numbers == sorted(set(numbers))
        # Beats do not wait for pictures, and hardly one is lost.
        assert sorted(b["true_late_ms"] for b in beats)[len(beats) // 2] < 2 * PICTURE_MS
        assert len(beats) > 0.8 * (beats[-1]["number"] - beats[0]["number"])
        assert max(abs(b["late_ms"] - b["true_late_ms"]) for b in beats) < 25.0

        ip("-n", drone_side, "link", "set", end, "down")
        vehicle.until_status("beats", "has not answered for")
        ip("-n", drone_side, "link", "set", end, "up")
        vehicle.until(lambda said: said["kind"] == "picture" and said["late_ms"] < 8 * PICTURE_MS)
        vehicle.until_status("beats", None)
