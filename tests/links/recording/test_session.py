"""A live recording in several parts is read as one by every command; parts that are not read are reported."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from flow.link import LinkError
from flow.live.input_order import END_TOPIC
from links.calibration.gather import gather
from links.recording import RecordingReader, Session
from tests import command
from tests.links.recording.split import split

ROOT = Path(__file__).resolve().parents[3]
STREET = ROOT / "recordings" / "street_sweep.mcap"
CUTS_S = (1.5, 3.0)


def grd(*words: object, code: int = 0) -> str:
    return " ".join(command.grd(*words, code=code).split())


@pytest.fixture
def first(tmp_path):
    folder = tmp_path / "flown"
    folder.mkdir()
    return split(STREET, folder, CUTS_S)


def part_path(first: Path, part: int) -> Path:
    return first.with_stem(f"{first.stem}-{part}")


def keys(records):
    return [(r.topic, r.arrival_ns, r.stamp_ns, r.data) for r in records if r.topic != END_TOPIC]


def test_overlapping_parts_are_read_in_the_order_of_one_file(first):
    session = Session(first)
    assert [path.name for path in session.parts] == ["flight.mcap", "flight-2.mcap", "flight-3.mcap"]
    with (
        RecordingReader(first) as part,
        RecordingReader(part_path(first, 2)) as after,
        RecordingReader(STREET) as whole,
    ):
        assert after.start_ns < part.end_ns
        assert (session.start_ns, session.end_ns) == (whole.start_ns, whole.end_ns)
        assert session.rig_yaml == whole.rig_yaml
        assert keys(session.records()) == keys(whole.records())
    assert session.warnings == []


def test_the_progress_increases_once_from_zero_to_all(first):
    progress_steps: list[tuple[int, int]] = []
    for _ in Session(first).records(progress=lambda done, of: progress_steps.append((done, of))):
        pass
    done = [step for step, _ in progress_steps]
    size = sum(path.stat().st_size for path in first.parent.iterdir())
    assert {of for _, of in progress_steps} == {size}
    assert done == sorted(done)
    assert done[0] < size / 3
    assert done[-1] == size


def test_a_part_is_opened_when_its_time_is_reached(first):
    records = Session(first).records()
    next(records)
    part_path(first, 3).unlink()
    with pytest.raises(LinkError, match=r"flight-3\.mcap: no such file"):
        list(records)


def test_a_replay_reads_and_reports_all_parts_and_has_the_hash_of_one_file(first, tmp_path):
    text = grd("replay", first, "--config", "replay", "--out", tmp_path / "split")
    grd("replay", STREET, "--config", "replay", "--out", tmp_path / "whole")
    split_run, whole = (json.loads((tmp_path / name / "summary.json").read_text()) for name in ("split", "whole"))
    assert f"{whole['records'] + 1} records in 3 parts, 5.3 s recorded" in text  # and the run's end
    assert split_run["parts"] == 3
    assert "parts" not in whole
    assert split_run["output_hash"] == whole["output_hash"]
    assert split_run["truth_errors"] == whole["truth_errors"]
    assert split_run["warnings"] == whole["warnings"]


def test_a_later_part_is_replayed_alone_and_this_is_reported(first, tmp_path):
    text = grd("replay", part_path(first, 2), "--config", "replay", "--out", tmp_path / "two")
    assert "flight-2.mcap is part 2 of its run, and read alone" in text
    assert "where the first is named, flight.mcap" in text
    assert "1.5 s recorded" in text
    assert "parts" not in json.loads((tmp_path / "two" / "summary.json").read_text())


def test_a_missing_part_is_reported_and_the_others_are_read(first):
    part_path(first, 2).unlink()
    session = Session(first)
    assert [path.name for path in session.parts] == ["flight.mcap", "flight-3.mcap"]
    (warning,) = session.warnings
    assert "part 2 of this run is missing, there are 2 others: what it held is left out" in warning
    with pytest.raises(LinkError, match="part 2 of this run is missing"):
        Session(first, whole=True)


def test_a_missing_last_part_is_reported_because_the_run_does_not_end(first):
    part_path(first, 3).unlink()
    (warning,) = Session(first).warnings
    assert "flight-2.mcap: the last part here, and the run did not end in it" in warning


def test_a_part_of_another_run_and_an_unreadable_part_are_reported(first):
    for path in (part_path(first, 2), part_path(first, 3)):
        path.rename(path.with_stem(f"mine{path.stem[-1]}"))
    split(STREET, first.parent, (1.0,), run="another", name="other")
    part_path(first, 2).hardlink_to(first.with_stem("other-2"))
    part_path(first, 4).touch()
    session = Session(first)
    assert [path.name for path in session.parts] == ["flight.mcap", "mine2.mcap", "mine3.mcap"]
    foreign, empty = session.warnings
    assert foreign.endswith("flight-2.mcap is of another run than flight.mcap: left out")
    assert "left out: " in empty
    assert "flight-4.mcap is empty" in empty


def test_unreadable_data_of_a_later_part_is_reported(first):
    damaged = part_path(first, 2)
    data = bytearray(damaged.read_bytes())
    data[len(data) // 2] ^= 0xFF
    damaged.write_bytes(data)
    session = Session(first)
    count = sum(1 for _ in session.records())
    assert 0 < count < sum(1 for _ in Session(STREET).records())
    assert [text for text in session.warnings if "flight-2.mcap: chunk at bytes" in text]


@pytest.mark.parametrize("part_s", [(0.0, math.inf), (1.0, 4.0)])
def test_a_calibration_reads_all_parts_like_one_file(first, part_s):
    split_run, whole = gather(first, None, part_s), gather(STREET, None, part_s)
    assert (split_run.parts, whole.parts) == (3, 1)
    assert split_run.warnings == []
    for field in ("stamp_ns", "laser", "xyz_lidar_m"):
        assert np.array_equal(getattr(split_run.returns, field), getattr(whole.returns, field))
    assert (split_run.seconds, split_run.mount) == (whole.seconds, whole.mount)
    assert split_run.seconds > 2.9


def test_calibrate_reports_the_number_of_parts_and_missing_ones(first, tmp_path):
    part_path(first, 3).unlink()
    text = grd("calibrate", first, "-o", tmp_path / "rig.yaml")
    assert "of the 2 parts of flight.mcap" in text
    assert "warning: " in text
    assert "flight-2.mcap: the last part here" in text


def test_preflight_checks_all_parts(first):
    config = ROOT / "configs" / "estimate.yaml"
    text = grd("preflight", config, "--recording", first, "--no-motion", code=1)  # it has no autopilot
    assert "3 parts of the recording, checked together" in text
    whole = grd("preflight", config, "--recording", STREET, "--no-motion", code=1)
    (losses,) = (line for line in whole.split("ok ") if line.startswith("lidar losses"))
    assert losses in text
