"""Recording: records per second through the writer (lossless) and the reader, compared with the mcap package.

Run by name: python -m pytest tests/benchmarks/bench_recording.py
"""

from pathlib import Path

import mcap.reader
import mcap.writer
import numpy as np
import pytest

from flow.link import Record
from links.recording import RecordingReader, RecordingWriter

COUNT = 20_000  # 26 s of lidar
_rng = np.random.default_rng(1)
PAYLOADS = [_rng.integers(0, 40, 1206, dtype=np.uint8).tobytes() for _ in range(100)]
RECORDS = [Record("/lidar/packets", 1_326_000 * i, 1_326_000 * i, PAYLOADS[i % 100], i) for i in range(COUNT)]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bench") / "lidar.mcap"
    _write(path)
    return path


def _write(path: Path) -> None:
    with RecordingWriter(path, lossless=True, overwrite=True) as writer:
        for record in RECORDS:
            writer.write(record)


def test_write_with_grd(benchmark, tmp_path: Path):
    benchmark.pedantic(_write, args=(tmp_path / "grd.mcap",), rounds=5, warmup_rounds=1)


def test_write_with_the_mcap_package(benchmark, tmp_path: Path):
    def write() -> None:
        with (tmp_path / "mcap.mcap").open("wb") as stream:
            writer = mcap.writer.Writer(stream)
            writer.start()
            channel = writer.register_channel("/lidar/packets", "velodyne-data", 0)
            for r in RECORDS:
                writer.add_message(channel, r.arrival_ns, r.data, r.stamp_ns, r.sequence)
            writer.finish()

    benchmark.pedantic(write, rounds=5, warmup_rounds=1)


def test_read_with_grd(benchmark, recording: Path):
    def read() -> int:
        with RecordingReader(recording) as reader:
            return sum(1 for _ in reader.records())

    assert benchmark.pedantic(read, rounds=5, warmup_rounds=1) == COUNT


def test_read_with_the_mcap_package(benchmark, recording: Path):
    def read() -> int:
        with recording.open("rb") as stream:
            return sum(1 for _ in mcap.reader.make_reader(stream, validate_crcs=True).iter_messages())

    assert benchmark.pedantic(read, rounds=5, warmup_rounds=1) == COUNT


def test_one_call_of_write_while_recording_live(benchmark, tmp_path: Path):
    with RecordingWriter(tmp_path / "live.mcap", queue_bytes=2**40) as writer:
        benchmark.pedantic(writer.write, args=(RECORDS[0],), rounds=2000, iterations=10)
