"""`grd calibrate` from the command line: a new rig for a replay, figures, and rejections with reasons."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

from flow.graph import load_graph
from links.calibration.gather import checked_rig, lidar_of
from links.cli.files import read_rig
from links.recording import RecordingReader, RecordingWriter
from stages.geometry.rig_lidar import RigLidar
from tests import command

ROOT = Path(__file__).resolve().parents[3]
STREET = ROOT / "recordings" / "street_sweep.mcap"


def grd(*words: object, code: int = 0) -> str:
    return " ".join(command.grd(*words, code=code).split())


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrated")
    recording = folder / "street.mcap"
    shutil.copy(STREET, recording)
    text = grd("calibrate", recording)
    return folder, text


def test_a_street_is_reported_by_parameter_with_reasons_for_rejection(calibrated):
    _, text = calibrated
    assert "servo's zero stays as it is" in text
    assert "mm thick before" in text
    assert "--overlay" in text


def test_a_stated_orientation_determines_the_zero_and_figures_need_matplotlib(calibrated, tmp_path, monkeypatch):
    _, without = calibrated
    assert "--parallel" in without
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    text = grd("calibrate", STREET, "-o", tmp_path / "rig.yaml", "--parallel", "0.15", "--level", "0.2")
    assert "servo's zero stays as it is" not in text
    assert "the zero found in it" in text
    assert "axis's tilt in the vehicle about x stays as it is" in text  # a road between two kerbs
    written = (tmp_path / "rig.yaml").read_text()
    assert "# servo's zero, by the wall" in written
    mount = yaml.safe_load(written)["rig"]["lidar"]["mount"]
    assert 0.15 <= mount["pointing_sigma_deg"] < 0.2
    assert abs(mount["servo_zero_deg"]) < 0.1  # this simulated zero is right
    assert "figures none: matplotlib is not installed: pip install -e '.[evaluate]'" in text
    assert not (tmp_path / "rig.svg").exists()


def test_the_new_rig_can_be_laid_over_a_configuration(calibrated):
    folder, _ = calibrated
    rig = folder / "street.rig.yaml"
    graph = load_graph(ROOT / "configs" / "replay.yaml", overlays=[rig])
    mount = graph.nodes["sweep"].build().settings.mount
    written = yaml.safe_load(rig.read_text())["rig"]["lidar"]["mount"]
    assert mount.servo_time_offset_s == written["servo_time_offset_s"]
    assert abs(mount.servo_time_offset_s) < 2e-4  # this simulated servo has no error: none is invented
    assert list(mount.T_turntable_lidar.quaternion_xyzw) == written["T_turntable_lidar"]["quaternion_xyzw"]
    assert checked_rig(read_rig(rig), "rig")[1].mount == mount


def test_the_figures_are_one_svg_with_four_charts(calibrated):
    folder, _ = calibrated
    tree = ElementTree.parse(folder / "street.rig.svg")
    charts = [e for e in tree.iter() if (e.get("id") or "").startswith("axes_")]
    texts = [e.text or "" for e in tree.iter() if e.tag.endswith("}text")]
    assert len(charts) == 4
    assert any("thick before" in text for text in texts)
    assert {"one wall from above", "distance of returns from their patch"} <= set(texts)


def test_an_existing_rig_is_overwritten_on_request_only(calibrated):
    folder, _ = calibrated
    before = (folder / "street.rig.yaml").read_bytes()
    assert "--overwrite" in grd("calibrate", folder / "street.mcap", code=2)
    assert (folder / "street.rig.yaml").read_bytes() == before


@pytest.mark.parametrize("name", ["einride_vlp16", "mrpt_vlp16_gps"])
def test_a_real_capture_without_servo_is_rejected_with_a_reason(name, tmp_path):
    text = grd("calibrate", ROOT / "recordings" / f"{name}.mcap", "-o", tmp_path / "rig.yaml", code=2)
    assert "no servo states" in text
    assert not (tmp_path / "rig.yaml").exists()


def test_a_part_with_too_little_travel_is_a_finding_and_writes_nothing(tmp_path):
    text = grd("calibrate", STREET, "-o", tmp_path / "rig.yaml", "--to", "0.4", code=1)
    assert "turned by" in text
    assert list(tmp_path.iterdir()) == []


def test_a_vehicle_that_moved_by_its_odometry_is_rejected(tmp_path):
    drove = tmp_path / "drove.mcap"
    with RecordingReader(STREET) as reader, RecordingWriter(drove, rig_yaml=reader.rig_yaml or "") as writer:
        topics = ["/lidar/packets", "/servo/state"]
        for k, record in enumerate(r for r in reader.records(topics) if r.arrival_ns < reader.start_ns + 3e8):
            writer.write(replace(record, sequence=2 * k))
            pose = {"xyz_m": [1e-3 * k, 0.0, 0.0], "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0], "covariance": None}
            data = json.dumps(pose).encode()
            writer.write(replace(record, topic="/vehicle/odometry", data=data, sequence=2 * k + 1))
    text = grd("calibrate", drove, code=1)
    assert "by its odometry it drove 0." in text
    assert list(tmp_path.iterdir()) == [drove]


@pytest.mark.slow
def test_a_small_odometry_drift_while_parked_is_decided_by_the_surfaces(tmp_path):
    drifts = tmp_path / "drifts.mcap"
    with RecordingReader(STREET) as reader, RecordingWriter(drifts, rig_yaml=reader.rig_yaml or "") as writer:
        begin_ns = reader.start_ns
        for k, record in enumerate(reader.records(["/lidar/packets", "/servo/state"])):
            writer.write(replace(record, sequence=2 * k))
            pose = {
                "xyz_m": [0.05 + 0.01e-9 * (record.arrival_ns - begin_ns), 0.0, 0.0] if k else [0.0, 0.0, 0.0],
                "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0],
                "covariance": None,
            }
            writer.write(replace(record, topic="/vehicle/odometry", data=json.dumps(pose).encode(), sequence=2 * k + 1))
    assert "flat patches" in grd("calibrate", drifts)


def test_the_lidars_clock_is_the_recorded_runs():
    run = "links: {front: {use: links.lidar.Lidar, config: {clock: utc, port: 2400}}, cam: {use: links.camera.Camera}}"
    assert lidar_of(run, RigLidar()).settings.clock == "utc"
    for other in (None, "seed: 3", "links: null", "links: {front: {use: links.lidar.Lidar}}", "- 1"):
        assert lidar_of(other, RigLidar()).settings.clock == "free"


def test_a_rig_is_written_to_a_yaml_file_only(tmp_path):
    assert ".yaml" in grd("calibrate", STREET, "-o", tmp_path / "rig.svg", code=2)


def test_a_part_that_ends_before_it_begins_is_wrong_use(tmp_path):
    assert "--to" in grd("calibrate", STREET, "-o", tmp_path / "r.yaml", "--from", "2", "--to", "1", code=2)
