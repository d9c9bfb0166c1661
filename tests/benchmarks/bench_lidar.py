"""grd's VLP-16 decoder compared with velodyne-decoder, on the same 1000 real packets in one run. One round decodes them all.

    python -m pytest tests/benchmarks/bench_lidar.py --benchmark-columns=min,median,iqr,rounds

Times are per 1000 packets: 1 ms is 1 us per packet. What each row does:
- grd, whole decode: bytes to `LidarFirings` (fresh arrays, int64 times, every pulse), checks, clock, counters.
- grd, kernel: arrays are there already.
- theirs, stream: bytes to points, their per-packet API; returns only, float32 times, a cloud per turn.
- theirs, packet objects: one packet per call; in the second row the bytes were copied into their objects before.
- theirs, capture: their whole-file API, with reading the pcap (dpkt) in it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import velodyne_decoder

from flow.link import Record
from links.lidar import Lidar, packet_format
from links.lidar.decode import compile_kernels
from stages.kernels.lidar.packets import decode

CAPTURE = Path(__file__).resolve().parents[3] / "shared" / "data" / "lidar" / "vlp16_strongest_einride.pcap"
HOUR_US = 3_600_000_000
CONFIG = velodyne_decoder.Config(min_range=0.0, max_range=200.0)


@pytest.fixture(scope="module")
def records():
    if not CAPTURE.exists():
        pytest.skip("real capture vlp16_strongest_einride.pcap is not here (../shared/data/lidar)")
    compile_kernels()
    packets = velodyne_decoder.util.iter_pcap(str(CAPTURE))
    return [Record("/lidar/packets", round(1e9 * t), round(1e9 * t), bytes(data)) for t, data in packets]


def dual(records):
    """The same packets as if each were the dual return of half as many pulses (half of the returns differ).

    Such packets follow each other in half the time.
    """
    changed = []
    first, first_us = records[0], clock_us(records[0].data)
    for record in records:
        data = bytearray(record.data)
        us = first_us + (clock_us(data) - first_us) % HOUR_US // 2
        data[1200:1204] = (us % HOUR_US).to_bytes(4, "little")
        for at in range(102, 1200, 200):
            data[at : at + 2] = data[at - 100 : at - 98]  # a pair of blocks has one azimuth
        data[1204] = 0x39
        stamp_ns = first.stamp_ns + (record.stamp_ns - first.stamp_ns) // 2
        changed.append(Record(record.topic, stamp_ns, stamp_ns, bytes(data)))
    return changed


def clock_us(data):
    """The sensor's microseconds after the hour."""
    return int.from_bytes(data[1200:1204], "little")


def decode_all(records):
    lidar = Lidar()
    for record in records:
        lidar.decode(record)
    return lidar.counters


def their_stream(records, structs):
    decoder = velodyne_decoder.StreamDecoder(CONFIG)
    for record in records:
        decoder.decode(1e-9 * record.stamp_ns, record.data, structs)
    decoder.finish(structs)


def their_packet(record):
    return velodyne_decoder.PacketVector([velodyne_decoder.VelodynePacket(1e-9 * record.stamp_ns, record.data)])


def test_grd_whole_decode(benchmark, records):
    counters = benchmark(decode_all, records)
    assert counters["lost"] == 0


def test_grd_whole_decode_dual(benchmark, records):
    counters = benchmark(decode_all, dual(records))
    assert counters["lost"] == 0
    assert counters["decoded"] == len(records)


def test_grd_kernel(benchmark, records):
    sizes = (np.int64, np.uint8, np.float32, np.float32, np.uint8, np.uint8)
    form = packet_format("VLP-16")
    arrays = [np.empty(form.max_rows, dtype) for dtype in sizes]
    rows = [*arrays, np.empty((form.max_rows, 3), np.float32)]

    def run():
        for record in records:
            decode(record.data, record.stamp_ns, False, form.layout, form.scales, form.pulses, 0, *rows)

    benchmark(run)


@pytest.mark.parametrize("structs", [False, True], ids=["floats", "structs"])
def test_theirs_stream(benchmark, records, structs):
    benchmark(their_stream, records, structs)


def test_theirs_stream_dual(benchmark, records):
    benchmark(their_stream, dual(records), True)


def test_theirs_packet_objects(benchmark, records):
    decoder = velodyne_decoder.ScanDecoder(CONFIG)
    benchmark(lambda: [decoder.decode(their_packet(record)) for record in records])


def test_theirs_packet_objects_made_before(benchmark, records):
    decoder = velodyne_decoder.ScanDecoder(CONFIG)
    packets = [their_packet(record) for record in records]
    benchmark(lambda: [decoder.decode(packet) for packet in packets])


def test_theirs_capture(benchmark, records):
    benchmark(lambda: list(velodyne_decoder.read_pcap(str(CAPTURE), config=CONFIG)))
