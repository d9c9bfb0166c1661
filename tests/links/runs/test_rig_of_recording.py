"""The rig of a recording: which configuration fits it, and what happens where a recording has none."""

from __future__ import annotations

from pathlib import Path

import pytest

from flow.link import LinkError, Record
from links.recording import RecordingReader, RecordingWriter, Session
from links.runs.request import RunRequest, fitting_request
from tests import command

ROOT = Path(__file__).resolve().parents[3]
RECORDINGS, CONFIGS = ROOT / "recordings", ROOT / "configs"
STREET = RECORDINGS / "street_sweep.mcap"
RIG = CONFIGS / "rigs" / "standard.yaml"


@pytest.fixture
def bare(tmp_path, monkeypatch):
    """The first packets of a sweep without a rig."""
    monkeypatch.chdir(tmp_path)
    with RecordingReader(STREET) as reader, RecordingWriter(tmp_path / "bare.mcap", lossless=True) as writer:
        for record, _ in zip(reader.records(), range(300), strict=False):
            writer.write(record)
    return tmp_path / "bare.mcap"


@pytest.mark.parametrize(
    ("name", "config"), [("experiment_3", "vision"), ("street_sweep", "estimate"), ("einride_vlp16", "estimate")]
)
def test_a_recording_is_replayed_with_cameras_if_its_rig_has_them(name, config):
    assert fitting_request(RECORDINGS / f"{name}.mcap").config == CONFIGS / f"{config}.yaml"


def test_the_rig_of_an_overlay_counts(bare, tmp_path):
    assert fitting_request(bare).config.stem == "estimate"
    assert fitting_request(bare, (RIG,)).config.stem == "vision"
    assert fitting_request(tmp_path / "none.mcap").config.stem == "estimate"


def test_a_recording_without_a_rig_needs_one_in_an_overlay(bare):
    request, session = RunRequest(CONFIGS / "estimate.yaml"), Session(bare)
    with pytest.raises(LinkError, match=r"bare\.mcap has no rig: give that of its vehicle with --overlay"):
        request.graph_on(session)
    graph = RunRequest(request.config, (RIG,)).graph_on(session)
    assert graph.values["rig"]["lidar"]["model"] == "VLP-16"


@pytest.mark.parametrize("words", [("replay", "bare.mcap"), ("preflight", "estimate", "--recording", "bare.mcap")])
def test_commands_on_a_recording_without_a_rig_say_so(bare, words):
    assert "bare.mcap has no rig: give that of its vehicle" in command.grd(*words, code=2)
    assert not Path("out").exists()


def test_a_damaged_rig_is_no_rig(tmp_path):
    data = bytearray(STREET.read_bytes())
    data[data.index(b"T_vehicle_turntable")] ^= 1
    file = tmp_path / "damaged.mcap"
    file.write_bytes(data)
    with pytest.raises(LinkError, match=r"has no rig.*attachment or metadata at byte \d+ cannot be read: its CRC"):
        RunRequest(CONFIGS / "estimate.yaml").graph_on(Session(file))


def test_a_configuration_without_a_rig_needs_none(tmp_path):
    (tmp_path / "c.yaml").write_text(
        "stages:\n  motion: {use: stages.odometry.vehicle.VehicleMotionSelector, inputs: {odometry: o.vehicle_motion}}\n"
        "links: {o: {use: links.vehicle_odometry.VehicleOdometry}}\n"
    )
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        writer.write(Record("/vehicle/odometry", 1, 1, b"{}", 0))
    assert "rig" not in RunRequest(tmp_path / "c.yaml").graph_on(Session(tmp_path / "a.mcap")).values


@pytest.mark.parametrize("options", [(), ("--foxglove",)])
def test_an_export_of_lidar_packets_needs_a_rig(bare, options):
    pytest.importorskip("rosbags")
    assert "bare.mcap has no rig" in command.grd("export", bare, *options, code=2)
    assert "/lidar/points" in command.grd("export", bare, *options, "--rig", RIG)
