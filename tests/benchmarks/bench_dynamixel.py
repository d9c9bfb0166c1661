"""One exchange with the emulated MX-28AR on a pty: the SDK as it is, and wrapped; and the whole link's rate.

    python -m pytest tests/benchmarks/bench_dynamixel.py -s --benchmark-columns=min,median,max,rounds

The emulator runs in a process of its own and answers at once: on a real line at 1 Mbit/s the bytes add 0.4 ms, the USB
adapter 1 to 2 ms. `-s` prints the link's rate with 50 goals a second between its reads.
"""

from __future__ import annotations

import contextlib
import select
import subprocess
import sys
import time

import numpy as np
import pytest
from dynamixel_sdk import PortHandler, Protocol2PacketHandler

from links.dynamixel import wire
from links.dynamixel.bus import Bus
from links.dynamixel.drive import DriveSettings
from links.dynamixel.servo_process import ALIVE_S, ServoProcess

BAUD = 1_000_000


@pytest.fixture(scope="module")
def port(tmp_path_factory):
    path = tmp_path_factory.mktemp("pty") / "servo"
    command = [sys.executable, "-m", "links.simulated.sensors.dynamixel_emulator", str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as emulator:
        while not path.exists():
            time.sleep(0.05)
        yield str(path)
        emulator.stdin.close()


@pytest.mark.benchmark(group="block read 126..135")
def test_wrapped(benchmark, port):
    bus = Bus.open(port, BAUD, 1, 0.5)
    with contextlib.closing(bus):
        benchmark(bus.read, 126, 10)


@pytest.mark.benchmark(group="block read 126..135")
def test_sdk_alone(benchmark, port):
    line, handler = PortHandler(port), Protocol2PacketHandler()
    line.openPort()
    benchmark(handler.readTxRx, line, 1, 126, 10)
    line.closePort()


def test_rate_of_the_whole_link(port):
    settings = DriveSettings(port, 1, BAUD, (0, 2048), 240, 100, 20, 500, 250, 3, False, True)
    readings, health, goals, begin_s = [], None, 0, time.monotonic()
    with ServoProcess(settings) as process:
        while (now_s := time.monotonic() - begin_s) < 10:
            select.select([process], [], [], ALIVE_S)
            for packet in process.received():
                if isinstance(packet, wire.Reading):
                    readings.append((packet.request_ns, packet.reply_ns))
                elif isinstance(packet, wire.Health):
                    health = packet
            if now_s > 1 + 0.02 * goals:
                goals += 1
                process.send(wire.Goal(1000 + 100 * (goals % 2), 240))
    times = np.array(readings)[50:]
    took_ms, gap_ms = 1e-6 * (times[:, 1] - times[:, 0]), 1e-6 * np.diff(times[:, 0])
    sys.stdout.write(
        f"\nreadings {(len(times) - 1) / (1e-9 * np.ptp(times[:, 0])):.0f} Hz, exchange ms p50 {np.median(took_ms):.2f} "
        f"p99 {np.percentile(took_ms, 99):.2f}, gap ms p99 {np.percentile(gap_ms, 99):.1f} max {gap_ms.max():.1f}\n"
        f"{health}\n"
    )
