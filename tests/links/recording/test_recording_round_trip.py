"""Round trip: order, times, sequence, attachments; and the mcap package reads the file."""

import errno
import io
import json
import os
import random
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mcap.reader
import mcap.writer
import pytest

import links.recording.reader as reader_module
import links.recording.writer as writer_module
from flow.link import LinkError, Record
from links.recording import TOPICS, CompressedImage, RecordingReader, RecordingWriter, encode_compressed_image, recover

T0 = 1_700_000_000_000_000_000


def lidar(number: int, arrival_ns: int) -> Record:
    return Record("/lidar/packets", arrival_ns, arrival_ns - 1000, bytes([number % 256]) * 1206)


def write(path: Path, records: list[Record], **settings: Any) -> None:
    with RecordingWriter(path, lossless=True, **settings) as writer:
        for record in records:
            writer.write(record)


def read(path: Path) -> list[Record]:
    with RecordingReader(path) as reader:
        records = list(reader.records())
        assert reader.warnings == []
        return records


# ---- order, times, contents


def test_records_are_read_by_arrival_then_sequence_with_both_times(tmp_path: Path):
    written = [
        Record("/servo/state", T0 + 30, T0 + 5, b'{"a":1}'),
        Record("/lidar/packets", T0 + 10, T0 + 9, b"x"),
        Record("/autopilot/rx", T0 + 30, T0 + 7, b"\xfe\x00"),
        Record("/lidar/packets", T0 + 20, T0 + 25, b""),
    ]
    write(tmp_path / "a.mcap", written)

    got = read(tmp_path / "a.mcap")

    assert [(r.topic, r.arrival_ns, r.stamp_ns, r.data, r.sequence) for r in got] == [
        ("/lidar/packets", T0 + 10, T0 + 9, b"x", 1),
        ("/lidar/packets", T0 + 20, T0 + 25, b"", 3),
        ("/servo/state", T0 + 30, T0 + 5, b'{"a":1}', 0),
        ("/autopilot/rx", T0 + 30, T0 + 7, b"\xfe\x00", 2),
    ]


def test_chunks_that_overlap_in_time_are_merged(tmp_path: Path):
    arrivals = list(range(T0, T0 + 5000))  # 6 MB: six chunks, each spanning all times
    random.Random(1).shuffle(arrivals)
    write(tmp_path / "a.mcap", [lidar(i, arrival) for i, arrival in enumerate(arrivals)])

    got = read(tmp_path / "a.mcap")

    assert [r.arrival_ns for r in got] == sorted(arrivals)
    assert [arrivals[r.sequence] for r in got] == sorted(arrivals)


def test_equal_arrivals_in_several_chunks_come_in_the_order_of_sequence(tmp_path: Path):
    write(tmp_path / "a.mcap", [lidar(i, T0 + i // 2000) for i in range(4000)])
    assert [r.sequence for r in read(tmp_path / "a.mcap")] == list(range(4000))


def test_too_much_overlap_is_an_error_instead_of_memory_growth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(reader_module, "MAX_OVERLAP_BYTES", 3 * 2**20)
    write(tmp_path / "a.mcap", [lidar(i, T0) for i in range(5000)])
    with RecordingReader(tmp_path / "a.mcap") as reader, pytest.raises(LinkError, match=r"at byte [0-9]+ more than"):
        list(reader.records())


def test_a_long_recording_needs_no_more_memory_than_a_short_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(reader_module, "MAX_OVERLAP_BYTES", 3 * 2**20)
    write(tmp_path / "a.mcap", [lidar(i, T0 + i) for i in range(10_000)])  # 12 MB, in order
    assert len(read(tmp_path / "a.mcap")) == 10_000


def test_topics_can_be_selected_and_progress_reaches_the_end(tmp_path: Path):
    servo = Record("/servo/state", T0 + 1, T0, b"{}")
    write(tmp_path / "a.mcap", [*(lidar(i, T0 + i) for i in range(3000)), servo])
    seen: list[tuple[int, int]] = []
    with RecordingReader(tmp_path / "a.mcap") as reader:
        assert reader.topics == {"/lidar/packets": 3000, "/servo/state": 1}
        assert (reader.start_ns, reader.end_ns) == (T0, T0 + 2999)
        records = list(reader.records({"/servo/state"}, progress=lambda done, total: seen.append((done, total))))
    assert [r.topic for r in records] == ["/servo/state"]
    assert seen == sorted(seen)
    assert seen[-1][0] == seen[-1][1] > 0


def test_an_empty_recording_is_valid(tmp_path: Path):
    write(tmp_path / "a.mcap", [])
    with RecordingReader(tmp_path / "a.mcap") as reader:
        assert list(reader.records()) == []
        assert (reader.topics, reader.start_ns, reader.end_ns, reader.finished) == ({}, 0, 0, True)


# ---- attachments and metadata


def test_rig_config_metadata_and_channels_are_read_back(tmp_path: Path):
    channels = {"/lidar/packets": {"model": "VLP-16", "port": "2368", "sender": "192.168.1.201"}}
    texts = {"rig_yaml": "version: 1 # ü\n", "config_yaml": "stages: {}\n"}
    write(tmp_path / "a.mcap", [lidar(0, T0)], **texts, metadata={"place": "Tokyo"}, channels=channels)
    with RecordingReader(tmp_path / "a.mcap") as reader:
        assert (reader.rig_yaml, reader.config_yaml) == ("version: 1 # ü\n", "stages: {}\n")
        assert reader.metadata == {"place": "Tokyo"}
        assert reader.channels == channels


def test_without_attachments_they_are_none(tmp_path: Path):
    write(tmp_path / "a.mcap", [lidar(0, T0)])
    with RecordingReader(tmp_path / "a.mcap") as reader:
        assert (reader.rig_yaml, reader.config_yaml, reader.metadata) == (None, None, {})


def test_the_mcap_package_reads_it(tmp_path: Path):
    image = encode_compressed_image(CompressedImage(T0, "camera_drone", b"\xff\xd8\xff"))
    data = {topic: b'{"error":0}' if TOPICS[topic].encoding == "json" else image for topic in TOPICS}
    written = [Record(topic, T0 + i, T0 - i, data[topic]) for i, topic in enumerate(TOPICS)]
    write(tmp_path / "a.mcap", written, rig_yaml="version: 1\n", metadata={"a": "b"})

    with (tmp_path / "a.mcap").open("rb") as stream:
        oracle = mcap.reader.make_reader(stream, validate_crcs=True)
        assert oracle.get_header().profile == "grd"
        got = list(oracle.iter_messages())
        summary = oracle.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert [(a.name, a.data) for a in oracle.iter_attachments()] == [("rig.yaml", b"version: 1\n")]
        assert {m.name: m.metadata for m in oracle.iter_metadata()} == {
            "grd": {"format_version": "1.1"},
            "recording": {"a": "b"},
        }
    assert [(c.topic, m.log_time, m.publish_time, m.sequence, m.data) for _, c, m in got] == [
        (r.topic, r.arrival_ns, r.stamp_ns, i, r.data) for i, r in enumerate(written)
    ]
    for schema, channel, _ in got:
        topic = TOPICS[channel.topic]
        assert channel.message_encoding == topic.encoding
        assert (schema.name if schema else "") == topic.schema_name
        if schema and topic.encoding == "json":
            assert schema.encoding == "jsonschema"
            fields, required = (set(json.loads(schema.data)[key]) for key in ("properties", "required"))
            assert required == fields or topic.name in ("/cues", "/simulated/fixes")
    assert summary.statistics.message_count == len(TOPICS)
    assert summary.statistics.channel_count == len(TOPICS)


def test_camera_chunks_are_stored_uncompressed_and_all_others_compressed(tmp_path: Path):
    write(tmp_path / "a.mcap", [Record("/camera/drone", T0, T0, b"jpeg"), lidar(0, T0), Record("/mine", T0, T0, b"?")])
    with (tmp_path / "a.mcap").open("rb") as stream:
        summary = mcap.reader.make_reader(stream).get_summary()
        assert summary is not None
    topics = {channel.id: channel.topic for channel in summary.channels.values()}
    stored = {c.compression: {topics[i] for i in c.message_index_offsets} for c in summary.chunk_indexes}
    assert stored == {"": {"/camera/drone"}, "zstd": {"/lidar/packets", "/mine"}}


def test_a_lossless_recording_has_the_same_bytes_each_time(tmp_path: Path):
    for name in ("a.mcap", "b.mcap"):
        write(tmp_path / name, [lidar(i, T0 + i) for i in range(2000)], rig_yaml="version: 1\n")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


# ---- writing that fails


def test_an_existing_file_is_kept_unless_overwriting_is_allowed(tmp_path: Path):
    path = tmp_path / "a.mcap"
    path.write_text("precious")
    with pytest.raises(LinkError, match="exists already: give another name with -o, or --overwrite"):
        RecordingWriter(path)
    assert path.read_text() == "precious"
    write(path, [lidar(0, T0)], overwrite=True)
    assert len(read(path)) == 1


@pytest.mark.parametrize(
    ("name", "text"), [("no/such/folder/a.mcap", "there is no folder .*: create it first"), (".", "is a folder")]
)
def test_a_path_that_cannot_be_written_is_explained(tmp_path: Path, name: str, text: str):
    with pytest.raises(LinkError, match=text):
        RecordingWriter(tmp_path / name, overwrite=True)


def test_a_full_disk_at_the_start_is_explained():
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    with pytest.raises(LinkError, match="/dev/full: No space left on device after 0 records: check the disk"):
        RecordingWriter("/dev/full", overwrite=True)


@pytest.mark.parametrize("record", [Record("/x", -1, 0, b""), Record("/x", 0, 2**63, b""), Record("/x", 0, -5, b"")])
def test_times_outside_the_range_of_the_format_are_rejected(tmp_path: Path, record: Record):
    with RecordingWriter(tmp_path / "a.mcap") as writer, pytest.raises(LinkError, match="times must be nanoseconds"):
        writer.write(record)


def test_writing_after_close_is_an_error_and_closing_twice_is_not(tmp_path: Path):
    writer = RecordingWriter(tmp_path / "a.mcap")
    writer.close()
    writer.close()
    with pytest.raises(LinkError, match="closed already"):
        writer.write(lidar(0, T0))


class Disk(io.FileIO):
    """A file that does `before` each write."""

    def __init__(self, path: Path, before: Callable[[], None]) -> None:
        super().__init__(path, "wb")
        self._before = before

    def write(self, data: Any) -> int:
        self._before()
        return super().write(data)


def use_disk(monkeypatch: pytest.MonkeyPatch, path: Path, before: Callable[[], None]) -> None:
    monkeypatch.setattr(writer_module, "create", lambda *_, **__: io.BufferedWriter(Disk(path, before), 4096))


def test_a_blocked_disk_does_not_block_writing_and_dropped_records_are_reported(tmp_path, monkeypatch):
    path, works = tmp_path / "a.mcap", threading.Event()
    works.set()
    use_disk(monkeypatch, path, works.wait)
    writer = RecordingWriter(path, queue_bytes=100_000)
    works.clear()
    for i in range(1000):  # returns at once although nothing reaches the disk
        writer.write(lidar(i, T0 + i))
    assert writer.dropped > 0
    works.set()
    writer.close()

    assert writer.written + writer.dropped == 1000
    with RecordingReader(path) as reader:
        got = list(reader.records())
        assert reader.warnings == [
            f"{path}: {writer.dropped} records were dropped while recording: the disk was too slow"
        ]
    assert len(got) == writer.written
    assert [r.sequence for r in got] == [r.arrival_ns - T0 for r in got], (
        "a dropped record leaves a gap in the sequence"
    )


def test_lossless_waits_for_the_disk(tmp_path, monkeypatch):
    path, works = tmp_path / "a.mcap", threading.Event()
    works.set()
    use_disk(monkeypatch, path, works.wait)
    writer = RecordingWriter(path, queue_bytes=20_000, lossless=True)
    works.clear()
    threading.Timer(0.05, works.set).start()
    for i in range(3000):
        writer.write(lidar(i, T0 + i))
    writer.close()
    assert writer.dropped == 0
    assert [r.sequence for r in read(path)] == list(range(3000))


def failing_disk(monkeypatch: pytest.MonkeyPatch, path: Path) -> None:
    writes = iter(range(10_000))

    def fill() -> None:
        if next(writes) >= 3:
            raise OSError(errno.ENOSPC, "No space left on device")

    use_disk(monkeypatch, path, fill)


def test_a_recording_that_failed_to_start_does_not_prevent_a_retry(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"

    def fail() -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as full:
        use_disk(full, path, fail)
        with pytest.raises(LinkError, match="No space left"):
            RecordingWriter(path)
    assert not path.exists()
    RecordingWriter(path).close()


def test_a_full_disk_is_reported_at_close_and_the_written_part_is_readable(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    failing_disk(monkeypatch, path)
    writer = RecordingWriter(path, queue_bytes=2**30)
    for i in range(5000):
        writer.write(lidar(i, T0 + i))
    with pytest.raises(LinkError, match=r"No space left on device after .* free space; `grd recover"):
        writer.close()
    assert writer.status
    assert writer.written + writer.dropped == 5000
    report = recover(path)
    assert report.records < 5000
    assert "messages readable" in report.warnings[0]


def test_lossless_reports_a_full_disk_while_writing(tmp_path, monkeypatch):
    failing_disk(monkeypatch, tmp_path / "a.mcap")
    writer = RecordingWriter(tmp_path / "a.mcap", lossless=True, queue_bytes=100_000)

    def fill() -> None:
        for i in range(20_000):
            writer.write(lidar(i, T0 + i))

    with pytest.raises(LinkError, match="No space left on device"):
        fill()
    with pytest.raises(LinkError, match="No space left on device"):
        writer.close()


# ---- files that are no recording


def mcap_of(path: Path, profile: str, version: str | None) -> Path:
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start(profile)
        if version is not None:
            writer.add_metadata("grd", {"format_version": version})
        writer.finish()
    return path


def test_another_profile_is_named(tmp_path: Path):
    with pytest.raises(LinkError, match="of profile 'ros2', not of grd's 'grd'"):
        RecordingReader(mcap_of(tmp_path / "a.mcap", "ros2", None))


def test_a_newer_major_version_is_rejected_and_a_newer_minor_is_read(tmp_path: Path):
    with pytest.raises(LinkError, match=r"format 2\.0 is newer than this grd, which reads up to 1\.x: update grd"):
        RecordingReader(mcap_of(tmp_path / "a.mcap", "grd", "2.0"))
    with RecordingReader(mcap_of(tmp_path / "b.mcap", "grd", "1.7")) as reader:
        assert reader.warnings == []


def test_a_version_that_is_missing_is_a_warning(tmp_path: Path):
    with RecordingReader(mcap_of(tmp_path / "a.mcap", "grd", None)) as reader:
        assert "version cannot be read" in reader.warnings[0]


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("a.mcap", b"", "is empty: the recording never started"),
        ("a.mcap", b"\x89MCAP", "ends after 5 bytes"),
        ("notes.txt", b"hello world, this is text", "is no recording: it starts with b'hello wo'"),
        ("a.pcap", b"\xd4\xc3\xb2\xa1" + bytes(40), "is a pcap capture: make a recording of it first with `grd import"),
        ("a.pcapng", b"\x0a\x0d\x0d\x0a" + bytes(40), "is a pcapng capture"),
        ("a.bag", b"#ROSBAG V2.0\n" + bytes(40), "is a ROS bag: make a recording of it first with `grd import"),
        ("a.db3", b"SQLite format 3\0" + bytes(40), "is a ROS bag: make"),
        ("a.ulg", b"ULog\x01\x12\x35" + bytes(40), "is a PX4 log: make"),
        ("a.bin", b"\xa3\x95\x80\x80" + bytes(40), "is an ArduPilot log: make"),
        ("a.tlog", b"\x00\x05\x1a\x15\xd7\xf7\x1a\x23\xfe", "is a MAVLink telemetry log: make a recording"),
        ("a.mcap", b"\x89MCAP0\r\n" + bytes(100), "the header at byte 8 cannot be read"),
    ],
)
def test_a_file_that_is_no_recording_is_named(tmp_path: Path, name: str, content: bytes, text: str):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(LinkError, match=text):
        RecordingReader(tmp_path / name)


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path):
    with pytest.raises(LinkError, match="no such file: check the name"):
        RecordingReader(tmp_path / "flight.mcap")
    with pytest.raises(LinkError, match="is a folder: name a recording in it"):
        RecordingReader(tmp_path)


def test_a_pipe_is_rejected_without_waiting(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(LinkError, match="is no regular file"):
        RecordingReader(tmp_path / "pipe")


def test_the_topics_of_a_second_drone_are_declared_as_those_of_the_first(tmp_path: Path):
    records = [Record(name, T0, T0, b"{}") for name in ("/truth/drone_2", "/truth/hits_3", "/truth/drone_", "/mine_2")]
    write(tmp_path / "a.mcap", records)
    with (tmp_path / "a.mcap").open("rb") as stream:
        found = [(schema and schema.name, channel.message_encoding) for schema, channel, _ in _messages(stream)]
    raw = (None, "application/octet-stream")
    assert found == [("grd.Pose", "json"), ("grd.Hits", "json"), raw, raw]


def _messages(stream):
    return list(mcap.reader.make_reader(stream).iter_messages(log_time_order=False))
