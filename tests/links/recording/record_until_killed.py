"""Records at the rate of a lidar and a servo until it is killed; keeps the last arrival in a mapped file for the test.

python record_until_killed.py RECORDING LAST_ARRIVAL
"""

import mmap
import struct
import sys
import time

from flow.link import Record
from links.recording import RecordingWriter

LIDAR_HZ, SERVO_EVERY = 754, 4


def main(recording: str, last_arrival: str) -> None:
    payload = bytes(range(256)) * 4 + bytes(182)
    with (
        open(last_arrival, "r+b") as file,
        mmap.mmap(file.fileno(), 8) as judge,
        RecordingWriter(recording, rig_yaml="version: 1\n") as writer,
    ):
        start = time.monotonic()
        for number in range(60 * LIDAR_HZ):
            time.sleep(max(0.0, start + number / LIDAR_HZ - time.monotonic()))
            now_ns = time.time_ns()
            writer.write(Record("/lidar/packets", now_ns, now_ns - 1_600_000, payload))
            if number % SERVO_EVERY == 0:
                text = b'{"position_rad":%f,"velocity_radps":0.1,"goal_rad":1.5,"error":0}' % (number / 1000)
                writer.write(Record("/servo/state", now_ns + 1, now_ns - 500_000, text))
            judge[:] = struct.pack("<q", now_ns)


if __name__ == "__main__":
    main(*sys.argv[1:])
