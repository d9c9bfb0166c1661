"""A recording process is killed with SIGKILL; the data on disk is read and recovered."""

import os
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest

from links.recording import RecordingReader, recover

CHILD = Path(__file__).with_name("record_until_killed.py")
ROOT = Path(__file__).parents[3]


def record_and_kill(folder: Path, after_s: float) -> tuple[Path, int]:
    """A recording cut off by kill -9 that long after its first record, and the arrival of the last record written."""
    recording, last_arrival = folder / "flight.mcap", folder / "last_arrival"
    last_arrival.write_bytes(bytes(8))
    child = subprocess.Popen(
        [sys.executable, str(CHILD), str(recording), str(last_arrival)], cwd=ROOT, env={**os.environ, "PYTHONPATH": "."}
    )
    try:
        deadline = time.monotonic() + 30
        while last_arrival.read_bytes() == bytes(8) and child.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(after_s)
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait()
    assert child.returncode == -signal.SIGKILL, "the child ended by itself"
    return recording, struct.unpack("<q", last_arrival.read_bytes())[0]


@pytest.mark.parametrize("after_s", [0.6, 0.83, 1.1])
def test_a_killed_recording_loses_at_most_half_a_second(tmp_path: Path, after_s: float):
    recording, last_arrival_ns = record_and_kill(tmp_path, after_s)

    with RecordingReader(recording) as reader:
        records = list(reader.records())
        assert not reader.finished
        assert len(reader.warnings) == 1
        assert f"{len(records)} messages readable" in reader.warnings[0]
        assert "`grd recover" in reader.warnings[0]
        assert reader.rig_yaml == "version: 1\n"
        assert sum(reader.topics.values()) == len(records)
    assert last_arrival_ns - records[-1].arrival_ns <= 500_000_000
    assert [record.sequence for record in records] == list(range(len(records))), "a hole before the end"

    report = recover(recording)
    assert report.records == len(records)
    with RecordingReader(report.path) as copy:
        assert copy.finished
        assert copy.warnings == []
        assert copy.rig_yaml == "version: 1\n"
        assert list(copy.records()) == records
