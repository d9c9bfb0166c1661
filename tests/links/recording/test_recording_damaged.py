"""Damaged recordings: truncation, flipped bits, wrong lengths. The readable part is read, or a LinkError is raised."""

import io
import re
import struct
import zlib
from pathlib import Path

import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flow.link import LinkError, Record
from links.recording import RecordingReader, recover
from links.recording.format import MAX_CHUNK_BYTES
from links.recording.mcap_file import McapFile

T0 = 1_700_000_000_000_000_000
COUNT = 48
CHANNELS = {"/lidar/packets": {"model": "VLP-16"}}


def whole() -> bytes:
    """A finished recording with six chunks of 8 records each, one of them in each chunk from a camera."""
    stream = io.BytesIO()
    attachments = {"rig.yaml": "version: 1\n", "config.yaml": "a: 1\n"}
    file = McapFile(stream, attachments=attachments, metadata={"place": "Tokyo"}, channels=CHANNELS)
    for i in range(COUNT):
        topic = "/camera/drone" if i % 8 == 7 else ("/lidar/packets", "/servo/state")[i % 2]
        file.add(Record(topic, T0 + i, T0 - i, bytes([i]) * 40, i))
        if i % 8 == 7:
            file.flush()
    file.finish()
    return stream.getvalue()


WHOLE = whole()
SENT = [(T0 + i, i, bytes([i]) * 40) for i in range(COUNT)]
HEADER_END = 8 + 9 + struct.unpack_from("<Q", WHOLE, 9)[0]
DATA_END = WHOLE.rindex(b"\x0f\x04\x00\x00\x00\x00\x00\x00\x00")


def read(path: Path, content: bytes) -> tuple[list[tuple[int, int, bytes]], list[str]]:
    path.write_bytes(content)
    with RecordingReader(path) as reader:
        records = [(r.arrival_ns, r.sequence, r.data) for r in reader.records()]
        return records, reader.warnings


def flipped(content: bytes, offset: int, value: int) -> bytes:
    return content[:offset] + bytes([content[offset] ^ value]) + content[offset + 1 :]


def chunk_offsets(content: bytes, compression: bytes = b"zstd") -> list[int]:
    """Where the chunks of one compression start."""
    name = struct.pack("<I", len(compression)) + compression
    found = [m.start() - 37 for m in re.finditer(re.escape(name), content)]
    return [offset for offset in found if content[offset] == 6]


def test_the_whole_file_is_read_without_warnings(tmp_path: Path):
    assert read(tmp_path / "a.mcap", WHOLE) == (SENT, [])
    assert len(chunk_offsets(WHOLE)) == 6


def test_the_readable_part_of_a_truncated_file_is_its_beginning_and_the_warning_has_the_byte(tmp_path: Path):
    path = tmp_path / "a.mcap"
    lengths = []
    for size in range(0, len(WHOLE), 3):
        if size < HEADER_END:
            with pytest.raises(LinkError, match=re.escape(str(path))):
                read(path, WHOLE[:size])
            continue
        records, warnings = read(path, WHOLE[:size])
        assert set(records) <= set(SENT)
        assert records == sorted(records)
        match = re.search(r"ends at byte (\d+) of (\d+): (\d+) messages readable", warnings[-1])
        assert match, warnings
        assert int(match[1]) <= size == int(match[2])
        assert int(match[3]) == len(records), f"cut at {size}"
        lengths.append(len(records))
    assert lengths == sorted(lengths)
    assert set(lengths) == {n for c in range(0, COUNT, 8) for n in (c, c + 7)} | {COUNT}


@settings(max_examples=250, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_flipped_bits_raise_only_link_errors(tmp_path: Path, data: st.DataObject):
    content = WHOLE
    for _ in range(data.draw(st.integers(1, 4))):
        content = flipped(content, data.draw(st.integers(0, len(WHOLE) - 1)), data.draw(st.integers(1, 255)))
    if data.draw(st.booleans()):  # unfinished as well: no summary to fall back on
        content = content[:DATA_END]
    try:
        records, warnings = read(tmp_path / "a.mcap", content)
    except LinkError:
        return
    assert set(records) <= set(SENT), "a record that was never written"
    assert records == sorted(records), "out of order"
    assert warnings or records == SENT, "lost in silence"


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(junk=st.binary(max_size=200), keep=st.integers(0, len(WHOLE)))
def test_junk_after_any_beginning_raises_only_link_errors(tmp_path: Path, junk: bytes, keep: int):
    try:
        records, _ = read(tmp_path / "a.mcap", WHOLE[:keep] + junk + WHOLE[keep:])
    except LinkError:
        return
    assert set(records) <= set(SENT)


def test_a_chunk_with_a_wrong_crc_is_skipped_alone_and_its_bytes_are_reported(tmp_path: Path):
    offset = chunk_offsets(WHOLE)[2]
    records, warnings = read(tmp_path / "a.mcap", flipped(WHOLE, offset + 9 + 24, 0xFF))  # the CRC in the chunk's head
    assert [r[1] for r in records] == [i for i in range(COUNT) if not 16 <= i < 23]
    assert len(warnings) == 1
    assert f"chunk at bytes {offset} to " in warnings[0]
    assert "its CRC is wrong" in warnings[0]


def test_a_garbage_length_in_an_unfinished_file_loses_only_data_before_the_next_chunk(tmp_path: Path):
    cut = WHOLE[:DATA_END]
    offsets = chunk_offsets(cut)
    damaged = flipped(cut, offsets[1] + 6, 0x80)  # the length claims petabytes
    records, warnings = read(tmp_path / "a.mcap", damaged)
    assert [r[1] for r in records] == [i for i in range(COUNT) if not 8 <= i < 16]
    assert f"bytes {offsets[1]} to {offsets[2] - 1} cannot be read" in warnings[0]


def test_a_tail_of_zeros_after_a_power_cut_is_the_end(tmp_path: Path):
    offset = chunk_offsets(WHOLE)[3]
    records, warnings = read(tmp_path / "a.mcap", WHOLE[:offset] + bytes(5000))
    assert len(records) == 24
    assert f"ends at byte {offset} of {offset + 5000}: 24 messages readable" in warnings[0]


def test_a_damaged_summary_is_ignored(tmp_path: Path):
    records, warnings = read(tmp_path / "a.mcap", flipped(WHOLE, DATA_END + 40, 0x55))
    assert records == SENT
    assert "the summary at the end is damaged (its CRC is wrong)" in warnings[0]


def test_a_damaged_rig_is_not_used(tmp_path: Path):
    path = tmp_path / "a.mcap"
    path.write_bytes(WHOLE.replace(b"version: 1\n", b"version: 9\n"))
    with RecordingReader(path) as reader:
        assert reader.rig_yaml is None
        assert reader.config_yaml == "a: 1\n"
        assert "attachment or metadata at byte" in reader.warnings[0]


def with_chunk(head_size: int, stored: bytes, compression: bytes = b"zstd") -> bytes:
    """An unfinished recording, and after it a chunk that claims to unpack to `head_size` bytes."""
    body = struct.pack("<QQQII", T0, T0, head_size, 1, len(compression)) + compression
    body += struct.pack("<Q", len(stored)) + stored
    return WHOLE[:DATA_END] + b"\x06" + struct.pack("<Q", len(body)) + body


def zstd_with_claimed_size(size: int) -> bytes:
    """A zstd frame whose header claims `size` bytes (RFC 8878: magic, descriptor, window, 8-byte content size)."""
    return b"\x28\xb5\x2f\xfd" + bytes([0b1100_0000, 0x58]) + struct.pack("<Q", size) + b"\x01\x00\x00"


@pytest.mark.parametrize(
    ("bomb", "text"),
    [
        (with_chunk(2**40, b"x"), "its times or its size are impossible"),
        (with_chunk(1000, zstandard.compress(bytes(300 * 2**20))), "unpacks to 1001 bytes instead of 1000"),
        (with_chunk(MAX_CHUNK_BYTES, zstd_with_claimed_size(2**60)), "unpacks to|zstd:"),
        (with_chunk(1000, b"no zstd at all"), "zstd:"),
        (with_chunk(1000, bytes(1000), b"lzma"), "compressed with b'lzma', and grd writes zstd only"),
        (with_chunk(1000, b"short", b""), "unpacks to 5 bytes instead of 1000"),
    ],
)
def test_a_chunk_with_a_wrong_size_is_skipped(tmp_path: Path, bomb: bytes, text: str):
    records, warnings = read(tmp_path / "a.mcap", bomb)
    assert records == SENT
    assert any(re.search(text, warning) for warning in warnings), warnings


def test_inconsistent_lengths_inside_a_chunk_are_reported(tmp_path: Path):
    messages = b"\x05" + struct.pack("<Q", 2**50) + bytes(30)
    body = struct.pack("<QQQII", T0, T0, len(messages), zlib.crc32(messages), 0) + struct.pack("<Q", len(messages))
    record = b"\x06" + struct.pack("<Q", len(body) + len(messages)) + body + messages
    records, warnings = read(tmp_path / "a.mcap", WHOLE[:DATA_END] + record)
    assert records == SENT
    assert "a record in it has the length 1125899906842624" in warnings[-1]


def test_a_chunk_with_other_times_than_its_messages_is_skipped(tmp_path: Path):
    cut = WHOLE[:DATA_END]
    offset = chunk_offsets(cut)[1]
    records, warnings = read(tmp_path / "a.mcap", flipped(cut, offset + 9, 0x04))  # it starts earlier or later
    assert [r[1] for r in records] == [i for i in range(COUNT) if not 8 <= i < 15]
    assert "its messages are outside the times it claims" in warnings[-1]


def test_recover_writes_a_clean_copy_of_the_readable_data(tmp_path: Path):
    path = tmp_path / "flight.mcap"
    path.write_bytes(flipped(WHOLE[:DATA_END], chunk_offsets(WHOLE)[1] + 9 + 24, 0xFF))
    report = recover(path, tmp_path / "clean.mcap")
    assert report.path == tmp_path / "clean.mcap"
    assert report.records == COUNT - 7
    assert report.topics["/camera/drone"] == 6
    assert len(report.warnings) == 2
    with RecordingReader(report.path) as copy:
        assert copy.warnings == []
        assert copy.finished
        assert (copy.rig_yaml, copy.config_yaml, copy.metadata) == ("version: 1\n", "a: 1\n", {"place": "Tokyo"})
        assert copy.channels == CHANNELS
        assert [r.sequence for r in copy.records()] == [i for i in range(COUNT) if not 8 <= i < 15]


def test_recover_never_overwrites_its_source_or_another_file(tmp_path: Path):
    path, other = tmp_path / "flight.mcap", tmp_path / "other.mcap"
    path.write_bytes(WHOLE)
    other.write_text("precious")
    with pytest.raises(LinkError, match="is the damaged recording itself"):
        recover(path, path, overwrite=True)
    with pytest.raises(LinkError, match="exists already"):
        recover(path, other)
    assert path.read_bytes() == WHOLE
    assert other.read_text() == "precious"


def test_recover_writes_no_copy_when_nothing_can_be_read(tmp_path: Path):
    path = tmp_path / "flight.mcap"
    path.write_bytes(WHOLE[: chunk_offsets(WHOLE)[0] + 20])
    with pytest.raises(
        LinkError, match=r"no record can be read, so that there is nothing to copy; .* ends at byte"
    ) as error:
        recover(path)
    assert "grd recover" not in str(error.value)
    assert list(tmp_path.iterdir()) == [path]


def test_recover_does_not_recommend_itself(tmp_path: Path):
    path = tmp_path / "flight.mcap"
    path.write_bytes(WHOLE[:DATA_END])
    assert any("`grd recover" in text for text in read(path, WHOLE[:DATA_END])[1])
    report = recover(path)
    assert report.warnings
    assert not any("grd recover" in text for text in report.warnings)


def test_a_message_with_a_stamp_that_is_no_time_is_left_out(tmp_path: Path):
    stream = io.BytesIO()
    file = McapFile(stream, attachments={}, metadata={}, channels={})
    for number, stamp_ns in enumerate((5, 2**63, 2**64 - 1, 2**63 - 1)):
        file.add(Record("/servo/state", T0 + number, stamp_ns, b"x", number))
    file.finish()
    records, warnings = read(tmp_path / "a.mcap", stream.getvalue())
    assert [number for _, number, _ in records] == [0, 3]
    assert any("a message on /servo/state has no valid stamp; it is left out" in text for text in warnings)
