"""A preflight of the committed recordings."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from links.cli.app import app

ROOT = Path(__file__).resolve().parents[3]


def grd(*arguments, code):
    result = CliRunner().invoke(app, ["preflight", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return result.output


def test_a_flight_with_every_sensor_is_go():
    text = grd(
        ROOT / "configs" / "vision.yaml",
        "--recording",
        ROOT / "recordings" / "experiment_1.mcap",
        "--no-motion",
        code=0,
    )
    assert "ok    lidar losses: 0 of 22606 packets lost" in text
    assert "ok    camera_drone size: 480 x 480, as in the rig" in text
    assert "ok    autopilot rates: ATTITUDE 50 Hz, ODOMETRY 30 Hz" in text
    assert "warn  autopilot parameters: not in a recording: not checked" in text
    assert "GO: " in text


def test_what_a_rig_without_cameras_leaves_out_is_a_warning():
    recording = ROOT / "recordings" / "street_sweep.mcap"
    text = grd(ROOT / "configs" / "vision.yaml", "--recording", recording, "--no-motion", code=1)
    assert "warning: the configuration has no $rig.cameras: vp_vehicle, vp_drone, ego, drone_odometry, align" in text


def test_a_recording_without_autopilot_is_no_go_where_the_configuration_declares_one():
    recording = ROOT / "recordings" / "street_sweep.mcap"
    text = grd(ROOT / "configs" / "estimate.yaml", "--recording", recording, "--no-motion", code=1)
    assert "the recording holds nothing on /autopilot/rx" in text
    assert "NO-GO: 1 of " in text
    assert "(autopilot heartbeat)" in text


@pytest.mark.parametrize(
    "arguments", [["nowhere.yaml"], [ROOT / "configs" / "replay.yaml", "--recording", "nowhere.mcap"]]
)
def test_missing_files_are_wrong_use(arguments):
    assert "nowhere" in grd(*arguments, code=2)


def test_a_configuration_without_sources_is_wrong_use(tmp_path):
    config = tmp_path / "none.yaml"
    config.write_text("stages: {ticker: {use: tests.flow.live_toys.Ticker, inputs: {tick: clock.tick}}}\nlinks: {}\n")
    grd(config, code=2)
