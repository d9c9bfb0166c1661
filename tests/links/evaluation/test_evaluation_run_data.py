"""Wrong files are rejected with an error that names the line; right ones are read exactly."""

from __future__ import annotations

import json

import numpy as np
import pytest

from flow.link import LinkError
from links.evaluation.association import EvaluationInput
from links.evaluation.run_data import read_run
from links.evaluation.text_files import read_stamp_ns, read_tum
from links.runs.results import tum_line
from tests.links.evaluation.made_runs import START_NS, evaluated, make_run, truth_at

FINE = "10.0 1 2 3 0 0 0 1\n"
EIGHT_HZ = np.arange(0.0, 10.0, 0.125)


def test_what_a_run_writes_is_read_back_to_the_nanosecond(tmp_path):
    stamps = [START_NS + 1, START_NS + 123_456_789]
    file = tmp_path / "a.tum"
    file.write_text("# full pose\n" + "".join(tum_line(s, np.array([1.0, -2.0, 3.5]), (0, 0, 0, 1)) for s in stamps))
    poses = read_tum(file)
    assert poses.stamps_ns.tolist() == stamps
    assert poses.xyz_m.tolist() == [[1.0, -2.0, 3.5]] * 2
    assert poses.quaternion_xyzw is not None
    assert poses.quaternion_xyzw.tolist() == [[0, 0, 0, 1]] * 2


def test_comments_and_empty_lines_are_skipped_but_counted(tmp_path):
    file = tmp_path / "a.tum"
    file.write_text(f"# a comment\n\n{FINE}11 1 2 3\n")
    with pytest.raises(LinkError, match=r"a\.tum:4: 4 columns, a TUM line has 8: stamp_s tx ty tz qx qy qz qw"):
        read_tum(file)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("11 1 2 3 0 0 0 1 9", ":2: 9 columns, a TUM line has 8"),
        ("11,1,2,3,0,0,0,1", ":2: 1 columns, a TUM line has 8"),
        ("10.0 1 2 3 0 0 0 1", ":2: the same stamp as the line before it; stamps must rise"),
        ("9 1 2 3 0 0 0 1", ":2: earlier than the line before it; stamps must rise"),
        ("11 nan 2 3 0 0 0 1", ":2: nan is not finite"),
        ("11 1 inf 3 0 0 0 1", ":2: inf is not finite"),
        ("nan 1 2 3 0 0 0 1", ":2: stamp nan is not a time in seconds"),
        (
            "1748773230000000000 1 2 3 0 0 0 1",
            ":2: stamp 1748773230000000000 is not a time in seconds; is it in nanoseconds?",
        ),
        ("eleven 1 2 3 0 0 0 1", ":2: stamp 'eleven' is not a number"),
        ("11 1 2 three 0 0 0 1", ":2: 'three' is not a number"),
        ("11 1 2 3 0 0 0 0", ":2: the quaternion has length 0, not 1"),
        ("11 1 2 3 0.5 0.5 0.5 0.9", ":2: the quaternion has length 1.249, not 1"),
    ],
)
def test_a_wrong_line_is_named_with_its_fault(tmp_path, line, message):
    file = tmp_path / "a.tum"
    file.write_text(FINE + line + "\n")
    with pytest.raises(LinkError) as error:
        read_tum(file)
    assert message in str(error.value)
    assert str(file) in str(error.value)


def test_empty_and_binary_files_are_rejected(tmp_path):
    (tmp_path / "a.tum").write_text("# nothing\n")
    with pytest.raises(LinkError, match="no pose in it; a TUM line is"):
        read_tum(tmp_path / "a.tum")
    (tmp_path / "b.tum").write_bytes(b"\x89PNG\xff\xfe\x00")
    with pytest.raises(LinkError, match="not a text file"):
        read_tum(tmp_path / "b.tum")
    (tmp_path / "c.mcap").write_bytes(b"")
    with pytest.raises(LinkError, match=r"expected the folder of a run or a TUM file, not a \.mcap file"):
        read_run(tmp_path / "c.mcap")


def test_stamps_with_exponents_are_exact():
    assert read_stamp_ns("1.7487732300000000e+09", "x") == 1_748_773_230_000_000_000
    assert read_stamp_ns("0.000000001", "x") == 1


def test_an_error_about_unequal_time_bases_has_both_spans(tmp_path):
    folder = make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ))
    truth = tmp_path / "truth.tum"
    truth.write_text("".join(f"{t} 1 2 3 0 0 0 1\n" for t in range(12, 20)))
    with pytest.raises(LinkError) as error:
        read_run(folder, truth)
    assert "spans 1748773230.000 .. 1748773239.875 s" in str(error.value)
    assert "spans 12.000 .. 19.000 s: they do not overlap" in str(error.value)


def test_a_folder_that_is_not_a_run_is_rejected(tmp_path):
    with pytest.raises(LinkError, match=r"no summary\.json: is it the --out folder of a run"):
        read_run(tmp_path)
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(LinkError, match=r"neither pose_vehicle_drone\.tum nor fix_vehicle_drone\.tum"):
        read_run(tmp_path)
    (tmp_path / "summary.json").write_text("{")
    with pytest.raises(LinkError, match="not JSON"):
        read_run(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("fix_covariance.csv", "stamp_s,cxx_m2\n", "fix_covariance.csv:1: no column cxy_m2"),
        (
            "fix_covariance.csv",
            "stamp_s,cxx_m2,cxy_m2,cxz_m2,cyy_m2,cyz_m2,czz_m2\n1,1,0,0,1\n",
            ":2: 5 cells, the header has 7",
        ),
        (
            "fix_covariance.csv",
            "stamp_s,cxx_m2,cxy_m2,cxz_m2,cyy_m2,cyz_m2,czz_m2\n1,nan,0,0,1,0,1\n",
            ":2: nan is not finite",
        ),
        ("detections.csv", "start_s,end_s,x_m,y_m,z_m\n0,1,2,x,3\n", "detections.csv:2: 'x' is not a number"),
        ("detections.csv", "", "detections.csv:1: no column start_s"),
    ],
)
def test_damaged_tables_are_named_with_their_line(tmp_path, name, text, message):
    folder = make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ))
    (folder / name).write_text(text)
    with pytest.raises(LinkError) as error:
        read_run(folder)
    assert message in str(error.value)


def test_a_covariance_for_some_fixes_only_is_not_used_for_any(tmp_path):
    folder = make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ))
    rows = (folder / "fix_covariance.csv").read_text().splitlines(keepends=True)
    (folder / "fix_covariance.csv").write_text("".join(rows[:-30]))
    output = read_run(folder).outputs[0]
    assert output.covariance is None
    assert output.why_no_covariance == "30 of 80 lines of fix_vehicle_drone.tum have none in fix_covariance.csv"


def test_a_run_without_the_time_of_the_recording_is_evaluated_over_truth(tmp_path):
    folder = make_run(tmp_path / "a", EIGHT_HZ, truth_at(EIGHT_HZ))
    summary = json.loads((folder / "summary.json").read_text())
    del summary["start_s"], summary["end_s"]
    (folder / "summary.json").write_text(json.dumps(summary))
    e = evaluated(folder)
    assert e.run.start_ns is None
    assert e.remarks[0] == "evaluated over 10.00 s, the span of the truth"
    assert "detections.csv" in e.run.why_missing(EvaluationInput.SEARCHES)
