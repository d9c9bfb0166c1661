"""The label of each candidate in the log of a simulated run."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from flow.link import Record
from links.runs.results import CANDIDATES_FILE
from links.runs.truth import TruthLog, label_candidates

STILL = {"xyz_m": [0.0, 0.0, 0.0], "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0]}


def truth(drones: dict[str, float], until_s: float = 2.0) -> TruthLog:
    """A vehicle that stands still for 2 s, and drones at x [m] by topic until a time."""
    log = TruthLog()
    for k in range(21):
        t_ns = 100_000_000 * k
        records = [Record("/truth/vehicle", t_ns, t_ns, json.dumps(STILL).encode())]
        for topic, x_m in drones.items():
            if k <= 10 * until_s:
                pose = STILL | {"xyz_m": [x_m, 0.0, 10.0]}
                records.append(Record(topic, t_ns, t_ns, json.dumps(pose).encode()))
        log.add_all(records)
    return log


def candidates(folder: Path, *lines: str) -> Path:
    file = folder / CANDIDATES_FILE
    head = "stamp_s,candidate,detector_instance,probability,x_m,y_m,z_m,range_m"
    file.write_text("\r\n".join([head, *lines, ""]), newline="")
    return file


def labels(file: Path) -> list[str]:
    with file.open(newline="") as stream:
        return [row["is_drone"] for row in csv.DictReader(stream)]


NEAR, FAR = "{},1,7,0.5,5.3,0.0,10.0,11.2", "{},2,7,0.5,7.0,0.0,10.0,12.2"


def test_a_candidate_within_1_m_of_any_drone_is_a_drone(tmp_path: Path):
    file = candidates(tmp_path, NEAR.format("0.55"), FAR.format("0.55"))
    assert label_candidates(tmp_path, truth({"/truth/drone": 5.0})) == ""
    assert labels(file) == ["1", "0"]
    file = candidates(tmp_path, NEAR.format("0.55"), FAR.format("0.55"))
    assert label_candidates(tmp_path, truth({"/truth/drone": 50.0, "/truth/drone_2": 7.5})) == ""
    assert labels(file) == ["0", "1"]


def test_at_times_without_truth_the_label_is_empty(tmp_path: Path):
    file = candidates(tmp_path, NEAR.format("0.55"), NEAR.format("1.5"))
    assert label_candidates(tmp_path, truth({"/truth/drone": 5.0}, until_s=1.0)) == ""
    assert labels(file) == ["1", ""]


def test_without_a_drone_in_truth_no_candidate_is_one_and_without_truth_there_is_no_label(tmp_path: Path):
    file = candidates(tmp_path, NEAR.format("0.55"), FAR.format("0.55"))
    before = file.read_bytes()
    assert label_candidates(tmp_path, TruthLog()) == ""
    assert file.read_bytes() == before
    assert label_candidates(tmp_path, truth({})) == ""
    assert labels(file) == ["0", "0"]


def test_a_line_that_is_cut_off_leaves_the_log_as_it_is_and_is_reported(tmp_path: Path):
    file = candidates(tmp_path, NEAR.format("0.55"), "0.6,2,7,0.5,7.0")
    before = file.read_bytes()
    assert "line 3 is cut off" in label_candidates(tmp_path, truth({"/truth/drone": 5.0}))
    assert file.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == [CANDIDATES_FILE]


def test_where_the_truth_of_the_drone_is_invalid_there_is_no_label(tmp_path: Path):
    file = candidates(tmp_path, NEAR.format("0.55"))
    before = file.read_bytes()
    log = truth({})
    log.add_all([Record("/truth/drone", 1, 1, b"not JSON")])
    assert label_candidates(tmp_path, log) == ""
    assert file.read_bytes() == before
    log.write(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [CANDIDATES_FILE]
