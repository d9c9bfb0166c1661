"""Encoded packets, read by grd's decoder and byte by byte."""

from __future__ import annotations

import math
import struct
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flow.link import Record
from links.lidar import Lidar
from links.lidar.position import Pps, parse_position
from links.simulated.sensors.lidar_packets import PacketEncoder, encode_position
from stages.geometry.lidar_models import lidar_profile
from stages.geometry.rig_lidar import RigLidar
from stages.messages import LidarFirings

VLP16 = lidar_profile("VLP-16")
START_NS = 1_748_773_230_000_000_000  # 10:20:30 UTC


def _packet(mode: str, first_ns: int, azimuth_deg: float, range_m: np.ndarray, shade: np.ndarray) -> bytes:
    encoder = PacketEncoder(RigLidar(), mode)
    step = 360.0 * 10 * VLP16.sequence_ns * 1e-9
    azimuth = np.radians(azimuth_deg + step * np.arange(encoder.sequences))
    return encoder.encode(first_ns, azimuth, range_m, shade)


def _decode(data: bytes, stamp_ns: int) -> LidarFirings:
    record = Record("/lidar/packets", arrival_ns=stamp_ns + 2_000_000, stamp_ns=stamp_ns, data=data)
    firings = Lidar(slice_ms=0.1).decode(record)
    assert firings is not None
    return firings


@settings(max_examples=50, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    azimuth_deg=st.floats(0, 359.99),
    mode=st.sampled_from(["strongest", "last"]),
    since_us=st.integers(0, 7_200_000_000),
)
def test_the_decoder_reads_what_was_encoded(seed: int, azimuth_deg: float, mode: str, since_us: int) -> None:
    rng = np.random.default_rng(seed)
    ticks = rng.integers(250, 52_500, (1, 24, 16)) * (rng.uniform(size=(1, 24, 16)) < 0.7)
    shade = rng.integers(1, 256, ticks.shape).astype(np.uint8)
    first_ns = START_NS + 1000 * since_us
    firings = _decode(_packet(mode, first_ns, azimuth_deg, 0.002 * ticks, shade), first_ns)

    assert firings.stamp_ns == first_ns
    np.testing.assert_allclose(firings.range_m, (0.002 * ticks).ravel(), atol=1e-5)
    np.testing.assert_array_equal(firings.reflectivity, np.where(ticks > 0, shade, 0).ravel())
    np.testing.assert_array_equal(firings.laser, np.tile(np.arange(16), 24))
    since_ns = VLP16.sequence_ns * np.arange(24)[:, None] + VLP16.firing_ns[1] * np.arange(16)
    np.testing.assert_array_equal(firings.pulse_stamp_ns - first_ns, since_ns.ravel())
    turned = np.mod(firings.azimuth_rad - math.radians(azimuth_deg) - math.tau * 10 * since_ns.ravel() * 1e-9, math.tau)
    assert np.minimum(turned, math.tau - turned).max() < math.radians(0.02)
    assert not firings.return_kind.any()


def test_dual_packets_keep_the_last_return_in_even_blocks_and_the_strongest_in_odd_ones() -> None:
    ranges = np.zeros((2, 12, 16))
    ranges[0], ranges[1] = 5.0, 12.0
    ranges[:, 3, 7] = 8.0  # one echo only: sent twice
    data = _packet("dual", START_NS, 40.0, ranges, np.full(ranges.shape, 9, dtype=np.uint8))
    assert struct.unpack_from("<H", data, 4)[0] == 6000
    assert struct.unpack_from("<H", data, 104)[0] == 2500
    assert data[2:4] == data[102:104]
    firings = _decode(data, START_NS)
    assert len(firings.range_m) == 2 * 192 - 1
    assert set(firings.range_m[firings.return_kind == 0].round(3)) == {5.0, 8.0}
    assert set(firings.range_m[firings.return_kind == 1].round(3)) == {12.0}


def test_the_ends_of_a_packet_are_as_in_the_manual() -> None:
    shape = (1, 24, 16)
    data = _packet("strongest", START_NS + 999, 359.996, np.full(shape, 1.5), np.full(shape, 77, dtype=np.uint8))
    assert len(data) == 1206
    assert data[:4] == b"\xff\xee\x00\x00"  # 359.996 deg rounds to 0
    assert data[4:7] == struct.pack("<HB", 750, 77)
    assert struct.unpack_from("<I", data, 1200)[0] == (20 * 60 + 30) * 1_000_000  # us past 10:00, rounded down
    assert data[1204:] == b"\x37\x22"


def test_a_row_of_the_wrong_length_is_rejected() -> None:
    with pytest.raises(ValueError, match=r"dual packets take ranges \(2, 12, 16\), got \(1, 24, 16\)"):
        PacketEncoder(RigLidar(), "dual").encode(
            0, np.zeros(12), np.zeros((1, 24, 16)), np.zeros((1, 24, 16), dtype=np.uint8)
        )


def test_a_position_packet_has_the_time_and_a_locked_clock():
    at_ns = 1_748_773_230_250_000_000  # 2025-06-01T10:20:30.25Z
    read = parse_position(encode_position(at_ns))
    assert read.gps_utc == datetime(2025, 6, 1, 10, 20, 30, tzinfo=UTC)
    assert read.gps_valid
    assert read.pps is Pps.LOCKED
    assert read.timestamp_us == (20 * 60 + 30) * 1_000_000 + 250_000
