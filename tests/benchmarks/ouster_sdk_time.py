"""Prints microseconds of CPU per packet of ouster-sdk: minimum and median. Runs in an environment of its own.

    python ouster_sdk_time.py CAPTURE.pcap METADATA.json

Packets to scan (FrameBatcher) and to points in double precision (XYZLut), as often as scans are complete; reading the
capture is not in it.
"""

import statistics
import sys
import time

from ouster.sdk import open_packet_source
from ouster.sdk.core import ChanField, FrameBatcher, LidarFrame, LidarPacket, XYZLut

capture, metadata = sys.argv[1:]
source = open_packet_source(capture, meta=[metadata])
info = source.sensor_info[0]
packets = [packet for _, packet in source if isinstance(packet, LidarPacket)]
to_points = XYZLut(info, False)
times_us = []
for _ in range(100):
    start_ns = time.thread_time_ns()
    batcher, frame = FrameBatcher(info), LidarFrame(info)
    for packet in packets:
        batcher.batch(packet, frame)
    clouds = [to_points(frame.field(f)) for f in (ChanField.RANGE, ChanField.RANGE2) if f in frame.fields]
    times_us.append((time.thread_time_ns() - start_ns) / 1e3 / len(packets))
sys.stdout.write(f"{min(times_us)} {statistics.median(times_us)}\n")
