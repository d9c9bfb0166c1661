"""From any folder: files that come with grd, values that must be set, and runs that found nothing."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from flow.graph import load_graph
from links import __version__
from links.preflight.shipped_values import shipped_values
from links.runs.shipped import CONFIGS, RECORDINGS, SCENARIOS, shipped, shipped_scenario

QUIET = """\
include: field.yaml
links:
  camera_vehicle: null
  camera_drone: null
  viewer: null
  lidar: {config: {port: 42371}}
  odometry: {config: {port: 42372}}
  servo: {config: {port: /dev/no_servo}}
  autopilot: {config: {connection: "udpin:127.0.0.1:42373", state_file: null}}
stages: {ego: null, motion: {inputs: {ego: null}}, vp_vehicle: null, vp_drone: null, drone_odometry: null, align: null,
  fuse: {inputs: {rotation: null, visual_motion: null}}}
"""


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("configs/quickstart.yaml", CONFIGS / "quickstart.yaml"),
        ("quickstart.yaml", CONFIGS / "quickstart.yaml"),
        ("quickstart", CONFIGS / "quickstart.yaml"),
        ("rigs/standard.yaml", CONFIGS / "rigs" / "standard.yaml"),
        ("recordings/street_sweep.mcap", RECORDINGS / "street_sweep.mcap"),
        ("street_sweep", RECORDINGS / "street_sweep.mcap"),
        ("none.yaml", Path("none.yaml")),
        ("../configs/quickstart.yaml", Path("../configs/quickstart.yaml")),
        ("/configs/quickstart.yaml", Path("/configs/quickstart.yaml")),
        ("README.md", Path("README.md")),
        ("configs", Path("configs")),
    ],
)
def test_a_name_is_the_user_s_own_file_or_one_that_comes_with_grd(tmp_path, monkeypatch, name, file):
    monkeypatch.chdir(tmp_path)
    assert shipped(Path(name)) == file


def test_the_name_of_a_scenario_is_not_that_of_a_recording(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("experiment_1", "experiment_1.yaml", "configs/scenarios/experiment_1.yaml"):
        assert shipped_scenario(Path(name)) == SCENARIOS / "experiment_1.yaml"
    assert shipped_scenario(Path("scenarios/experiment_1.yaml")) == SCENARIOS / "experiment_1.yaml"
    assert shipped_scenario(Path("flight/none.yaml")) == Path("flight/none.yaml")


def test_the_user_s_own_file_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "quickstart.yaml").write_text("stages: {}\n")
    assert shipped(Path("quickstart.yaml")) == Path("quickstart.yaml")


def test_a_configuration_in_any_folder_may_include_one_that_comes_with_grd(grd, tmp_path):
    (tmp_path / "mine.yaml").write_text("include: [field.yaml, rigs/mine.yaml]\n")
    (tmp_path / "rigs").mkdir()
    (tmp_path / "rigs" / "mine.yaml").write_text("rig: {drone: {span_m: 0.7}}\n")
    assert "no errors" in grd("check", "mine.yaml")
    assert load_graph(tmp_path / "mine.yaml").values["rig"]["drone"]["span_m"] == 0.7


def test_the_version_is_printed(grd):
    assert grd("--version") == f"grd {__version__}\n"


def test_check_warns_of_every_value_of_the_field_configuration_that_must_be_set(grd):
    text = grd("check", "field.yaml")
    for words in (
        "rig.lidar is that of the example rig",
        "rig.cameras.vehicle.lens is that of the example rig",
        "rig.cameras.drone.T_drone_camera is that of the example rig",
        "lidar.bind is 127.0.0.1",
        "servo.port is /dev/ttyUSB0",
        "autopilot.connection is udpin:127.0.0.1:14550",
        "camera_vehicle.latency_s is 0",
        "camera_drone.source is /dev/video2",
        "rig.odometry is not set",
    ):
        assert f"warning: {words}" in text


def test_values_that_were_set_and_simulated_rigs_give_no_warning(tmp_path):
    assert shipped_values(load_graph(CONFIGS / "sim_live.yaml")) == []
    assert shipped_values(load_graph(CONFIGS / "estimate.yaml")) == []
    (tmp_path / "mine.yaml").write_text(
        "include: field.yaml\nlinks:\n"
        "  lidar: {config: {bind: 192.168.1.5, sender: 192.168.1.201}}\n"
        "  camera_vehicle: {config: {source: /dev/v4l/by-id/cam, latency_s: 0.05}}\n"
    )
    texts = shipped_values(load_graph(tmp_path / "mine.yaml"))
    assert texts
    assert not [text for text in texts if text.startswith(("lidar.", "camera_vehicle."))]
    assert [text for text in texts if text.startswith("rig.odometry")]
    (tmp_path / "rig.yaml").write_text("include: mine.yaml\nrig: {odometry: {}}\n")
    assert not [text for text in shipped_values(load_graph(tmp_path / "rig.yaml")) if text.startswith("rig.odometry")]


def test_a_run_with_nothing_connected_ends_with_one_and_what_to_check(grd, tmp_path):
    (tmp_path / "quiet.yaml").write_text(QUIET)
    text = grd("run", "quiet.yaml", "--for", 1, "--no-warm-up", code=1)
    assert text.startswith("loading quiet.yaml\n")
    assert "no sensor sent anything; the sources without a record:" in text
    for name in ("lidar", "servo", "odometry", "autopilot"):
        assert re.search(rf"^  {name}: .+$", text, re.MULTILINE)
    assert "check: grd preflight quiet.yaml" in text
