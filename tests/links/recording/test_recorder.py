"""The recorder of a live run: parts, a full disk, and the files that it leaves."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from flow.link import LinkError, Record, Run
from links.recording import Recorder, RecordingReader, Session

ROOT = Path(__file__).parents[3]
CHILD = Path(__file__).with_name("record_on_a_small_disk.py")
SETTINGS = "rig: {version: 1}\nstages: {}\n"


def run_of(folder: Path, live: bool = True) -> Run:
    return Run(folder, "field", "", SETTINGS, live)


def record(number: int, size: int = 4) -> Record:
    return Record("/lidar/packets", 1_000 + number, 500 + number, number.to_bytes(4, "big") + os.urandom(size - 4))


def opened(folder: Path, **settings) -> Recorder:
    recorder = Recorder(**settings)
    recorder.open(run_of(folder))
    return recorder


def test_every_record_is_in_the_recording_with_rig_and_configuration(tmp_path):
    recorder = opened(tmp_path)
    for number in range(100):
        recorder.record(record(number))
    recorder.close()
    with RecordingReader(tmp_path / "flight.mcap") as reader:
        assert reader.finished
        assert [r.arrival_ns for r in reader.records()] == [1_000 + n for n in range(100)]
        assert (reader.rig_yaml, reader.config_yaml) == ("version: 1\n", SETTINGS)
        assert reader.metadata["made_by"] == "grd run"
    assert recorder.counters == {"written": 100, "dropped": 0, "missed": 0, "parts": 1}
    assert recorder.status is None


def test_each_part_can_be_replayed_alone_and_together_they_are_all(tmp_path):
    recorder = opened(tmp_path)
    for part in range(3):
        for number in range(10):
            recorder.record(record(10 * part + number))
        if part < 2:
            recorder._begin_part()  # as its thread does when a part is long or big enough
    recorder.close()
    parts = Session(tmp_path / "flight.mcap").parts
    assert [path.name for path in parts] == ["flight.mcap", "flight-2.mcap", "flight-3.mcap"]
    for number, path in enumerate(parts):
        with RecordingReader(path) as reader:
            assert reader.finished
            assert (reader.rig_yaml, reader.config_yaml) == ("version: 1\n", SETTINGS)
            assert reader.metadata["part"] == str(number + 1)
            assert sum(1 for _ in reader.records()) == 10
    assert [r.arrival_ns for r in Session(parts[0]).records()] == [1_000 + n for n in range(30)]
    assert recorder.counters == {"written": 30, "dropped": 0, "missed": 0, "parts": 3}


def test_a_full_part_is_followed_by_another_without_loss(tmp_path):
    recorder = opened(tmp_path, split_mb=1)
    number = 0
    while recorder.counters["parts"] < 3:
        for _ in range(50):
            recorder.record(record(number, 10_000))
            number += 1
        threading.Event().wait(0.005)
    recorder.close()
    assert [r.arrival_ns for r in Session(tmp_path / "flight.mcap").records()] == [1_000 + n for n in range(number)]


def test_parts_split_by_time_have_the_static_data_each_and_every_record_once(tmp_path):
    senders = {"/lidar/packets": {"model": "VLP-16", "port": "2368", "sender": "192.168.1.201"}}
    recorder = Recorder(split_s=1)
    recorder.open(Run(tmp_path, "field", "", SETTINGS, True, senders))
    for number in range(10_000):
        recorder.record(record(number))
        if recorder._intake.writer.path.name == "flight-3.mcap":
            break
        threading.Event().wait(0.002)
    recorder.record(record(number + 1))
    recorder.close()
    runs: list[str] = []
    counts: list[int] = []
    parts = Session(tmp_path / "flight.mcap").parts
    for path in parts:
        with RecordingReader(path) as reader:
            assert reader.finished
            assert (reader.rig_yaml, reader.config_yaml) == ("version: 1\n", SETTINGS)
            assert reader.channels == senders
            runs.append(reader.metadata["session"])
            assert reader.metadata["part"] == str(len(runs))
            counts.append(sum(1 for _ in reader.records()))
    assert len(set(runs)) == 1
    assert len(runs) == 3
    assert all(counts)
    assert [r.arrival_ns for r in Session(parts[0]).records()] == [1_000 + n for n in range(number + 2)]
    assert recorder.counters == {"written": number + 2, "dropped": 0, "missed": 0, "parts": 3}


def test_parts_of_other_runs_are_ignored_and_missing_ones_are_reported(tmp_path):
    for name in ("flight.mcap", "other.mcap"):
        recorder = opened(tmp_path, file=name)
        for part in range(3):
            recorder.record(record(part))
            if part < 2:
                recorder._begin_part()
        recorder.close()
    (tmp_path / "torn.mcap").write_bytes(b"no recording")
    assert [p.name for p in Session(tmp_path / "other.mcap").parts] == ["other.mcap", "other-2.mcap", "other-3.mcap"]
    with pytest.raises(LinkError, match=r"flight-2.mcap is part 2 of its run: .* from its first part, flight.mcap"):
        Session(tmp_path / "flight-2.mcap", whole=True)
    (tmp_path / "flight-2.mcap").unlink()
    with pytest.raises(LinkError, match=r"part 2 of this run is missing, there are 2 others"):
        Session(tmp_path / "flight.mcap", whole=True)


def test_a_recording_without_a_run_is_its_only_part():
    street = ROOT / "recordings" / "street_sweep.mcap"
    assert Session(street).parts == [street]
    assert Session(street).warnings == []


def test_a_full_disk_is_reported_and_records_are_counted_as_missed(tmp_path):
    recorder = opened(tmp_path, reserve_mb=1e12)
    recorder.record(record(1))
    assert "less than 1e+12 MB are free at" in recorder.status
    assert "make room; nothing is recorded now, the run goes on" in recorder.status
    assert recorder.counters == {"written": 0, "dropped": 0, "missed": 1, "parts": 0}
    recorder.close()
    assert not list(tmp_path.iterdir())


def test_a_disk_that_gets_full_ends_the_recording_properly_and_room_again_begins_a_new_part(tmp_path, monkeypatch):
    monkeypatch.setattr("links.recording.recorder.RETRY_S", 0.0)
    recorder = opened(tmp_path)
    recorder.record(record(1))
    free = [0]
    monkeypatch.setattr(Recorder, "_free_bytes", lambda self: free[0])
    while recorder.status is None:
        threading.Event().wait(0.01)
    recorder.record(record(2))
    free[0] = 10**12
    while recorder.status is not None:
        threading.Event().wait(0.01)
    recorder.record(record(3))
    recorder.close()
    assert [r.arrival_ns for r in Session(tmp_path / "flight.mcap").records()] == [1_001, 1_003]
    assert recorder.counters == {"written": 2, "dropped": 0, "missed": 1, "parts": 2}
    with RecordingReader(tmp_path / "flight.mcap") as reader:
        assert reader.finished


def test_a_disk_that_is_gone_is_reported_and_the_recording_goes_on_when_it_is_back(tmp_path, monkeypatch):
    monkeypatch.setattr("links.recording.recorder.RETRY_S", 0.0)
    recorder = opened(tmp_path)

    def gone(folder):
        raise OSError(errno.ESTALE, "Stale file handle")

    with monkeypatch.context() as away:
        away.setattr("shutil.disk_usage", gone)
        wait_until(lambda: recorder.status is not None)
        assert (
            "Stale file handle: is the disk still there?; nothing is recorded now, the run goes on" in recorder.status
        )
    wait_until(lambda: recorder.status is None)
    recorder.record(record(1))
    recorder.close()
    assert recorder.counters["parts"] == 2


def wait_until(done):
    for _ in range(500):
        if done():
            return
        threading.Event().wait(0.02)
    pytest.fail("nothing happened in ten seconds")


def test_a_live_run_continues_with_a_full_disk_and_reports_it(tmp_path):
    child = subprocess.run(
        [sys.executable, str(CHILD), str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": "."},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert child.returncode == 0, child.stderr
    output = json.loads(child.stdout)
    assert output["after"] == 14.0
    (event,) = [text for text in output["events"] if "nothing is recorded now" in text]
    assert "flight.mcap: File too large after" in event
    assert event.endswith("nothing is recorded now, the run goes on")
    assert output["counters"]["dropped"] + output["counters"]["missed"] > 0
    with RecordingReader(tmp_path / "flight.mcap") as reader:
        assert sum(1 for _ in reader.records()) > 0


def test_a_replay_records_nothing(tmp_path):
    recorder = Recorder()
    recorder.open(run_of(tmp_path, live=False))
    recorder.close()
    assert not list(tmp_path.iterdir())
