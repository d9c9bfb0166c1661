"""Summary of a run: configurations without drone search, rejected messages, warnings of clocks."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flow.link import Record
from links.recording import RecordingWriter
from tests import command

ROOT = Path(__file__).resolve().parents[3]
CONFIG = """\
replay: drive.mcap
stages:
  motion: {use: stages.odometry.vehicle.VehicleMotionSelector, inputs: {odometry: odometry.vehicle_motion}}
links:
  odometry: {use: links.vehicle_odometry.VehicleOdometry}
"""


@pytest.fixture
def drive(tmp_path, monkeypatch):
    """Odometry of a drive at 5 m/s at 50 Hz: two messages are no pose, one is off by 40 m."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drive.yaml").write_text(CONFIG)
    with RecordingWriter(tmp_path / "drive.mcap") as writer:
        for k in range(50):
            pose = {
                "xyz_m": [0.1 * k, 40.0 if k == 30 else 0.0, 0.0],
                "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0],
                "covariance": None,
            }
            data = b"no pose" if k in (10, 20) else json.dumps(pose).encode()
            stamp_ns = 10**9 + 20_000_000 * k
            writer.write(Record("/vehicle/odometry", stamp_ns, stamp_ns, data, k))
    return tmp_path


@pytest.mark.parametrize("words", [("run", "drive.yaml"), ("replay", "drive.mcap", "--config", "drive.yaml")])
def test_a_configuration_without_drone_search_lists_the_outputs_of_its_stages(drive, words):
    lines = command.grd(*words).splitlines()
    assert lines[0].endswith("no stage searches for a drone")
    assert lines[1] == "ran: motion (VehicleMotionSelector: 47 vehicle_motion)"
    assert not any("drone accepted" in line or "no drone:" in line or line.startswith("positions") for line in lines)
    assert any(line.startswith("summary") for line in lines)


def test_a_configuration_with_drone_search_does_not_list_them(drive):
    options = ("--overlay", ROOT / "configs/rigs/standard.yaml", "--set", "viewer.file=null")
    text = command.grd("replay", "drive.mcap", "--config", ROOT / "configs/estimate.yaml", *options)
    assert "no drone: no sweep was completed" in " ".join(text.split())
    assert "no stage searches for a drone" not in text


def test_rejected_messages_of_links_and_stages_are_reported_with_reasons(drive):
    text = " ".join(command.grd("run", "drive.yaml").split())
    assert "rejected: odometry: 2 no valid pose; motion: 1 odometry: " in text


def test_a_run_without_rejected_messages_has_no_such_line(drive):
    with RecordingWriter(drive / "still.mcap") as writer:
        pose = {"xyz_m": [0.0] * 3, "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0], "covariance": None}
        for k in range(3):
            writer.write(Record("/vehicle/odometry", 10**9 * (k + 1), 10**9 * (k + 1), json.dumps(pose).encode(), k))
    assert "left out" not in command.grd("replay", "still.mcap", "--config", "drive.yaml")


LIDAR = """\
stages:
  motion: {use: stages.odometry.vehicle.VehicleMotionSelector, inputs: {odometry: odometry.vehicle_motion}}
links:
  odometry: {use: links.vehicle_odometry.VehicleOdometry}
  front: {use: links.lidar.Lidar, config: {clock: CLOCK}}
"""


@pytest.mark.parametrize(
    ("flown", "replayed", "warned"),
    [
        ("free", "utc", True),
        ("utc", "free", True),
        ("free", "free", False),
        ("utc", "utc", False),
        (None, "utc", False),
    ],
)
def test_a_lidar_replayed_with_another_clock_than_recorded_gives_a_warning(drive, flown, replayed, warned):
    config = None if flown is None else LIDAR.replace("CLOCK", flown)
    with RecordingWriter(drive / "flight.mcap", config_yaml=config) as writer:
        pose = {"xyz_m": [0.0] * 3, "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0], "covariance": None}
        writer.write(Record("/vehicle/odometry", 10**9, 10**9, json.dumps(pose).encode(), 0))
    (drive / "again.yaml").write_text(LIDAR.replace("CLOCK", replayed))
    text = " ".join(command.grd("replay", "flight.mcap", "--config", "again.yaml", "--out", "again").split())
    warning_text = f"front: recorded with `clock: {flown}`, replayed with `clock: {replayed}`"
    assert (warning_text in text) is warned
    summary = json.loads((drive / "again" / "summary.json").read_text())
    assert any(warning_text in warning for warning in summary["warnings"]) is warned


@pytest.mark.parametrize("clock", ["free", "utc"])
def test_a_recording_without_a_clock_setting_was_made_with_the_free_clock(drive, clock):
    with RecordingWriter(drive / "flight.mcap", config_yaml=LIDAR.replace(", config: {clock: CLOCK}", "")) as writer:
        pose = {"xyz_m": [0.0] * 3, "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0], "covariance": None}
        writer.write(Record("/vehicle/odometry", 10**9, 10**9, json.dumps(pose).encode(), 0))
    (drive / "again.yaml").write_text(LIDAR.replace("CLOCK", clock))
    text = command.grd("replay", "flight.mcap", "--config", "again.yaml")
    assert ("recorded with `clock: free`" in " ".join(text.split())) is (clock == "utc")


@pytest.mark.parametrize("config", ["links: [", "links: 3", "links: {front: {use: links.lidar.Lidar, config: 3}}"])
def test_a_recording_with_an_invalid_configuration_is_replayed_without_clock_warning(drive, config):
    with RecordingWriter(drive / "flight.mcap", config_yaml=config) as writer:
        pose = {"xyz_m": [0.0] * 3, "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0], "covariance": None}
        writer.write(Record("/vehicle/odometry", 10**9, 10**9, json.dumps(pose).encode(), 0))
    (drive / "again.yaml").write_text(LIDAR.replace("CLOCK", "free"))
    assert "recorded with `clock" not in command.grd("replay", "flight.mcap", "--config", "again.yaml")
