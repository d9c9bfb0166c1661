"""VLP-16 packets built by hand from the datasheet's layout, and the real captures where they are present."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import velodyne_decoder

from flow.link import Record

STRONGEST, LAST, DUAL = 0x37, 0x38, 0x39
VLP16, HDL32E, PUCK_HI_RES = 0x22, 0x21, 0x24
SINGLE_PACKET_NS = 1_327_104
ONE_PACKET_MS = 0.1  # a slice that holds one packet of any model
HOUR_NS = 3_600_000_000_000

CHANNEL = np.dtype([("range", "<u2"), ("reflectivity", "u1")])
BLOCK = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("channel", CHANNEL, 32)])
PACKET = np.dtype([("block", BLOCK, 12), ("time_us", "<u4"), ("mode", "u1"), ("product", "u1")])

CAPTURES = Path(__file__).resolve().parents[4] / "shared" / "data" / "lidar"


def packet(ranges=5_000, *, azimuth=0, step=40, reflectivity=0, time_us=0, mode=STRONGEST, product=VLP16) -> bytes:
    """One data packet. `ranges` [2 mm], `reflectivity`: (12, 32) or a number; azimuth, step per block [0.01 deg]."""
    built = np.zeros((), PACKET)
    block = built["block"]
    block["flag"] = 0xEEFF
    block["azimuth"] = (azimuth + step * (np.arange(12) // (2 if mode == DUAL else 1))) % 36_000
    block["channel"]["range"] = ranges
    block["channel"]["reflectivity"] = reflectivity
    built["time_us"], built["mode"], built["product"] = time_us, mode, product
    return built.tobytes()


def record(data: bytes, stamp_ns: int = 0) -> Record:
    return Record("/lidar/packets", stamp_ns, stamp_ns, data)


def exact_records(count: int, start_ns: int = 0, interval_ns: int = SINGLE_PACKET_NS, **fields) -> list[Record]:
    """A healthy stream whose stamps are exact to the ns; the sensor's clock reads host time modulo an hour."""
    stamps = [start_ns + k * interval_ns for k in range(count)]
    return [record(packet(time_us=stamp % HOUR_NS // 1_000, **fields), stamp) for stamp in stamps]


@functools.cache
def captured(name: str) -> tuple[tuple[int, bytes], ...]:
    """(host stamp [ns], UDP payload) of a real capture; skips the test when the file is missing."""
    path = CAPTURES / f"{name}.pcap"
    if not path.exists():
        pytest.skip(f"real capture {name}.pcap is missing (../shared/data/lidar)")
    return tuple((round(1e9 * stamp), bytes(data)) for stamp, data in velodyne_decoder.util.iter_pcap(str(path)))


def captured_records(name: str) -> Iterator[Record]:
    return (record(data, stamp_ns) for stamp_ns, data in captured(name) if len(data) == 1206)
