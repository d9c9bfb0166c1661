"""Importing telemetry logs: frame boundaries, kept and counted data, real logs."""

import io
import struct
from pathlib import Path
from typing import IO, cast

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.generator.mavcrc import x25crc

from flow.link import LinkError, Record
from links.importing import ImportReport, import_file
from links.importing import tlog as tlog_module
from links.importing.tlog import BLOCK_BYTES, TlogReport, read_frames, x25
from links.recording import RecordingReader

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data" / "mavlink"
T0_US = 1_700_000_000_000_000


def frames(*, version: int = 2, signed: bool = False, count: int = 6) -> list[bytes]:
    """Attitudes as an autopilot sends them."""
    link = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    link.robust_parsing = True
    if signed:
        link.signing.secret_key = bytes(range(32))
        link.signing.sign_outgoing = True
        link.signing.timestamp = 1000
    out = []
    for i in range(count):
        message = mavlink.MAVLink_attitude_message(1000 * i, 0.1, -0.2, 3.0, 0.0, 0.0, 0.01)
        out.append(bytes(message.pack(link, force_mavlink1=version == 1)))
    return out


def tlog(parts: list[bytes]) -> bytes:
    return b"".join(struct.pack(">Q", T0_US + 100_000 * i) + part for i, part in enumerate(parts))


def run(tmp_path: Path, content: bytes) -> tuple[ImportReport, list[Record]]:
    path = tmp_path / "flight.tlog"
    path.write_bytes(content)
    report = import_file(path, overwrite=True)
    with RecordingReader(report.path) as reader:
        assert reader.rig_yaml is None
        return report, list(reader.records())


def test_the_checksum_is_mavlinks():
    assert x25(b"123456789") == 0x6F91  # CRC-16/MCRF4XX check value
    for size in range(64):
        data = bytes(range(7, 7 + size))
        oracle = x25crc()
        oracle.accumulate(data)
        assert x25(data) == oracle.crc


@pytest.mark.parametrize(("version", "signed"), [(1, False), (2, False), (2, True)])
def test_frames_of_both_versions_and_signed_ones_are_kept_raw(tmp_path: Path, version: int, signed: bool):
    sent = frames(version=version, signed=signed)
    report, records = run(tmp_path, tlog(sent))
    assert [r.data for r in records] == sent
    assert [r.arrival_ns for r in records] == [(T0_US + 100_000 * i) * 1000 for i in range(6)]
    assert {r.topic for r in records} == {"/autopilot/rx"}
    assert (report.topics, report.skipped, report.warnings) == ({"/autopilot/rx": 6}, {}, [])


def test_bad_bytes_are_skipped_counted_and_located(tmp_path: Path):
    sent = frames()
    start = len(tlog(sent[:2]))
    content = tlog([*sent[:2], b"\x01\x02\xfe\x03garbage", *sent[2:]])
    report, records = run(tmp_path, content)
    assert [r.data for r in records] == sent
    assert report.skipped == {"bytes that are no MAVLink frame": 8 + 11}
    assert f"19 bytes are no MAVLink frame (bytes {start} to {start + 18}" in report.warnings[0]


def test_a_frame_with_a_flipped_byte_between_good_ones_is_kept_and_counted(tmp_path: Path):
    sent = frames()
    sent[2] = sent[2][:15] + bytes([sent[2][15] ^ 0x40]) + sent[2][16:]
    report, records = run(tmp_path, tlog(sent))
    assert [r.data for r in records] == sent
    assert "1 frames have a checksum that our MAVLink dialect does not expect: kept" in report.warnings[0]


def test_a_bad_frame_is_rejected_when_the_next_time_is_far_off(tmp_path: Path):
    sent = frames()
    damaged = sent[2][:15] + bytes([sent[2][15] ^ 0x40]) + sent[2][16:]
    content = tlog([*sent[:2], damaged])
    later = b"".join(struct.pack(">Q", T0_US + 10**12 + i) + frame for i, frame in enumerate(sent[3:]))  # 11 days on
    report, records = run(tmp_path, content + later)
    assert [r.data for r in records] == sent[:2] + sent[3:]
    assert report.skipped == {"bytes that are no MAVLink frame": 8 + len(damaged)}


def test_a_message_outside_the_dialect_is_kept(tmp_path: Path):
    sent = frames()
    sent[3] = b"\xfd\x04\x00\x00\x07\x01\x01" + (0xABCDEF).to_bytes(3, "little") + b"abcd" + b"\x12\x34"
    _, records = run(tmp_path, tlog(sent))
    assert [r.data for r in records] == sent


def test_a_clock_that_jumps_keeps_the_frames(tmp_path: Path):
    sent = frames(count=2)
    content = struct.pack(">Q", 5_000_000) + sent[0] + struct.pack(">Q", T0_US) + sent[1]  # no clock at power-up
    _, records = run(tmp_path, content)
    assert [r.data for r in records] == sent


def test_a_cut_log_gives_its_whole_frames_and_names_the_byte(tmp_path: Path):
    sent = frames()
    content = tlog(sent)
    last = len(tlog(sent[:5]))
    report, records = run(tmp_path, content[:-5])
    assert [r.data for r in records] == sent[:5]
    assert f"(bytes {last} to {len(content) - 6}" in report.warnings[0]


@pytest.mark.parametrize("content", [b"\x00" * 50, b"text", bytes(range(256)) * 4])
def test_a_file_without_frames_is_rejected(tmp_path: Path, content: bytes):
    with pytest.raises(LinkError, match=r"no MAVLink frame in [0-9]+ bytes: is it a telemetry log"):
        run(tmp_path, content)
    assert not (tmp_path / "flight.mcap").exists()


def test_a_log_larger_than_the_memory_is_read_block_by_block(tmp_path: Path):
    """A sparse file of 300 MB with a frame in front and one at its end, in a process with little more memory."""
    first, last = frames(count=2)
    path = tmp_path / "long.tlog"
    with path.open("wb") as stream:
        stream.write(tlog([first]) * 40_000)  # 1.5 MB: frames on both sides of a block's end
        stream.seek(300_000_000)
    report = TlogReport()

    class Counted:
        """Counts the bytes of each read."""

        def __init__(self, stream: IO[bytes]) -> None:
            self.stream, self.sizes = stream, list[int]()

        def read(self, size: int = -1) -> bytes:
            self.sizes.append(size)
            if len(self.sizes) == 4:  # the rest is zeros: skip it, a byte at a time takes minutes
                self.stream.seek(0, 2)
            return self.stream.read(size)

    with path.open("rb") as stream:
        counted = Counted(stream)
        found = [frame for _, frame in read_frames(cast(IO[bytes], counted), path, report)]
    assert found == [first] * 40_000
    assert last not in found
    assert set(counted.sizes) == {BLOCK_BYTES}


@pytest.mark.parametrize("block", [1, 7, 64, 4096])
def test_the_size_of_a_block_changes_nothing(tmp_path: Path, block: int, monkeypatch: pytest.MonkeyPatch):
    sent = frames(count=30)
    content = tlog([*sent[:9], b"\x01\x02\xfe\x03garbage", *sent[9:]])
    whole, records = run(tmp_path, content)
    monkeypatch.setattr("links.importing.tlog.BLOCK_BYTES", block)
    report, again = run(tmp_path, content)
    assert [r.data for r in again] == [r.data for r in records] == sent
    assert (report.skipped, report.warnings) == (whole.skipped, whole.warnings)


def test_a_file_that_is_neither_capture_nor_log_is_rejected_and_a_recording_is_recognised(tmp_path: Path):
    (tmp_path / "a.bin").write_bytes(b"something else")
    with pytest.raises(LinkError, match="none of the files that can be imported: a pcap capture"):
        import_file(tmp_path / "a.bin")
    report, _ = run(tmp_path, tlog(frames()))
    with pytest.raises(LinkError, match="is a recording already"):
        import_file(report.path, tmp_path / "b.mcap")
    with pytest.raises(LinkError, match="no such file"):
        import_file(tmp_path / "none.tlog")


def test_a_log_is_recognised_by_its_bytes(tmp_path: Path):
    (tmp_path / "flight.log").write_bytes(tlog(frames()))
    assert import_file(tmp_path / "flight.log").topics == {"/autopilot/rx": 6}


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.integers(0, 200), st.integers(0, 255)), max_size=8), st.integers(0, 260))
def test_every_lost_byte_is_counted(tmp_path: Path, flips: list[tuple[int, int]], size: int):
    content = bytearray(tlog(frames()))
    for offset, value in flips:
        content[offset] = value
    try:
        report, records = run(tmp_path, bytes(content[:size]))
    except LinkError:
        return
    kept = sum(8 + len(record.data) for record in records)
    assert kept + report.skipped.get("bytes that are no MAVLink frame", 0) == len(content[:size])


@pytest.mark.parametrize("name", ["copter_flight_part1", "plane_bench_disarmed"])
def test_real_logs_give_the_frames_that_pymavlink_reads(tmp_path: Path, name: str):
    if not SHARED.exists():
        pytest.skip("needs ../shared/data/mavlink")
    path = SHARED / f"{name}.tlog"
    report = import_file(path, tmp_path / "a.mcap")
    oracle = mavutil.mavlink_connection(str(path), robust_parsing=True)
    expected, bad = [], 0
    while (message := oracle.recv_msg()) is not None:
        expected.append(bytes(message.get_msgbuf()))
        bad += message.get_type() == "BAD_DATA"
    with RecordingReader(report.path) as reader:
        got = sorted(reader.records(), key=lambda r: r.sequence)
    assert [r.data for r in got] == expected
    assert report.skipped == {}
    assert bool(bad) == bool(report.warnings)
    if bad:
        assert f" {bad} frames have a checksum" in report.warnings[0]


@pytest.mark.parametrize("gap", [b"", b"\x00" * 70_000, bytes(range(256)) * 300, b"\xfd\xfe" * 500])
def test_between_frames_the_bytes_without_a_marker_are_skipped_at_once_and_all_counted(tmp_path: Path, gap: bytes):
    content = tlog(frames()) + gap + tlog(frames()) + gap
    report = TlogReport()
    with io.BytesIO(content) as stream:
        found = [frame for _, frame in read_frames(stream, tmp_path, report)]
    assert found == frames() * 2
    assert report.bad_bytes == 2 * len(gap)
    assert report.done_bytes == len(content)


def test_a_huge_file_of_zeros_is_not_tried_byte_by_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    tried: list[int] = []
    monkeypatch.setattr(tlog_module, "_frame_end", lambda data, offset: tried.append(offset))
    report = TlogReport()
    with io.BytesIO(bytes(30 * BLOCK_BYTES)) as stream:
        assert list(read_frames(stream, tmp_path, report)) == []
    assert report.bad_bytes == 30 * BLOCK_BYTES
    assert len(tried) < 100
