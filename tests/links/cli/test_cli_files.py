"""Input and output files of the commands: wrong ones are refused in one line, before the work."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flow.link import LinkError, Record
from links.cli.console import check_output
from links.recording import RecordingReader, RecordingWriter
from links.recording.writer import beside

ROOT = Path(__file__).resolve().parents[3]
STREET = ROOT / "recordings" / "street_sweep.mcap"


def test_a_file_next_to_a_source_has_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert beside(Path("a/flight.mcap"), ".rig.yaml") == Path("a/flight.rig.yaml")
    assert beside(Path(), ".mcap") == tmp_path.with_name(f"{tmp_path.name}.mcap")
    assert beside(Path("/"), ".mcap") == Path("/.mcap")


def test_an_output_that_cannot_be_written_is_refused(tmp_path, monkeypatch):
    (tmp_path / "old").write_text("")
    check_output(tmp_path / "new", "-o", overwrite=False)
    check_output(tmp_path / "old", "-o", overwrite=True)
    for name, overwrite, reason in (
        ("old", False, "exists already: give another name with -o, or --overwrite"),
        (".", True, "is a folder: name a file with -o"),
        ("none/new", False, "there is no folder"),
        ("old/new", False, "there is no folder"),
    ):
        with pytest.raises(LinkError, match=reason):
            check_output(tmp_path / name, "-o", overwrite=overwrite)
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(LinkError, match="cannot be written"):
        check_output(tmp_path / "new", "-o", overwrite=False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["recover", "."], ". is a folder: name a recording in it"),
        (["import", "."], ". has no metadata.yaml, so that it is no ROS 2 bag"),
        (["calibrate", "."], ". is a folder: name a recording in it"),
        (["lens", ".", "vehicle"], ".: Is a directory."),
        (["calibrate", STREET, "-o", "none/c.yaml"], "there is no folder none"),
        (["evaluate", "none", "--report", "old/r.html"], "old"),
        (["evaluate", "none", "--csv", "folder"], "folder is a folder: name a file with --csv"),
        (["evaluate", "none.parquet"], "none.parquet: no such file"),
        (["view", "flight.mcap", "--screenshot", "x.png"], "flight.mcap is a recording: grd replay flight.mcap --view"),
        (["view", "run.rrd", "--screenshot", "none/x.png"], "there is no folder none"),
        (["info", "magic.mcap"], "the header at byte 8 cannot be read: it is cut off"),
        (["import", "a.pcap", "--port", "99999"], "--port"),
        (["simulate", "experiment_1", "-o", "s.mcap", "--seed", "-1"], "--seed"),
        (["import", "empty.csv"], "it has 0 channels; supported are XT16 and XT32"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(grd, tmp_path, arguments, message):
    (tmp_path / "old").write_text("")
    (tmp_path / "folder").mkdir()
    (tmp_path / "magic.mcap").write_bytes(STREET.read_bytes()[:8])
    (tmp_path / "empty.csv").write_text("Channel,Elevation,Azimuth\n")
    before = sorted(tmp_path.iterdir())
    assert message in " ".join(grd(*arguments, code=2).split())
    assert sorted(tmp_path.iterdir()) == before


def test_a_recording_of_which_nothing_is_decoded_is_a_failure(grd, tmp_path):
    with RecordingReader(STREET) as reader:
        rig = reader.rig_yaml
    for name, records in (
        ("empty", []),
        ("rejected", [Record("/lidar/packets", k, k, b"no packet", k) for k in range(1, 9)]),
        ("unwired", [Record("/cues", 1, 1, b"{}", 1)]),
    ):
        with RecordingWriter(tmp_path / f"{name}.mcap", rig_yaml=rig, lossless=True) as writer:
            for record in records:
                writer.write(record)
        text = " ".join(grd("replay", f"{name}.mcap", "--set", "viewer.file=null", code=1).split())
        assert f"{name}.mcap: nothing was replayed: none of its {len(records)} records was decoded" in text
        assert not list((tmp_path / "out").glob("*/summary.json"))
    several = ("replay", "empty.mcap", "unwired.mcap", "--set", "viewer.file=null", "--out", "several")
    assert grd(*several, code=1).count("nothing was replayed") == 2


def test_a_recording_with_invalid_truth_is_replayed_and_evaluated_without_it(grd, tmp_path):
    no_pose = b'{"xyz_m": [NaN, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}'
    with RecordingReader(STREET) as reader, RecordingWriter(tmp_path / "t.mcap", rig_yaml=reader.rig_yaml) as writer:
        for record, _ in zip(reader.records(), range(2000), strict=False):
            data = no_pose if record.topic == "/truth/drone" else record.data
            writer.write(Record(record.topic, record.arrival_ns, record.stamp_ns, data, record.sequence))
    options = ("--set", "viewer.file=null", "--set", "detect.parked=true", "--out", "run")
    text = " ".join(grd("replay", "t.mcap", *options).split())
    assert "records on /truth/drone are invalid: left out" in text
    assert "nan" not in text.lower()
    json.loads((tmp_path / "run" / "summary.json").read_text(), parse_constant=pytest.fail)
