"""A LiDAR of any model that sends packets to a UDP port at its pace, in a process: ours may be busy, a sensor is not."""

from __future__ import annotations

import math
import socket
import subprocess
import sys
import time

import numpy as np

from links.simulated.sensors.lidar_packets import PacketEncoder
from stages.geometry.rig_lidar import RigLidar

SPIN_RADPS = 20.0 * math.pi  # 600 rpm


class SendingLidar:
    """Sends packets of this unit until its context ends."""

    def __init__(self, port: int, unit: RigLidar | None = None) -> None:
        self._command = [sys.executable, "-m", __name__, str(port), (unit or RigLidar()).model_dump_json()]

    def __enter__(self) -> SendingLidar:
        self._process = subprocess.Popen(self._command, stdout=subprocess.PIPE)
        assert self._process.stdout is not None
        self._process.stdout.readline()
        return self

    def __exit__(self, *exception: object) -> None:
        self._process.kill()
        self._process.communicate()


def send(port: int, unit: RigLidar) -> None:
    """Every pulse returns from 10 m."""
    encoder = PacketEncoder(unit, "strongest" if unit.beams is None else unit.beams.return_mode)
    shape = (encoder.returns, encoder.sequences, encoder.profile.lasers)
    range_m, reflectivity = np.full(shape, 10.0), np.full(shape, 50, np.uint8)
    after_s = 1e-9 * encoder.sequence_offsets_ns(1)
    sent, began_ns = 0, time.monotonic_ns()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        while True:
            while (sent + 1) * encoder.packet_ns < time.monotonic_ns() - began_ns:
                first_ns = sent * encoder.packet_ns
                azimuth_rad = np.mod(SPIN_RADPS * (1e-9 * first_ns + after_s), 2.0 * math.pi)
                udp.sendto(encoder.encode(first_ns, azimuth_rad, range_m, reflectivity), ("127.0.0.1", port))
                sent += 1
                if sent == 1:
                    print("sends", flush=True)  # noqa: T201, for the process that waits
            time.sleep(0.002)


if __name__ == "__main__":
    send(int(sys.argv[1]), RigLidar.model_validate_json(sys.argv[2]))
