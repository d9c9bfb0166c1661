"""The rig as a whole: all rigs that grd has are valid, and a typo in any section is an error."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from flow.config.tree import load_tree
from flow.config.yaml_text import yaml_values
from links.recording import Session
from links.runs.request import RunRequest
from stages.geometry.rig import Rig
from tests import command

ROOT = Path(__file__).resolve().parents[3]
STANDARD = ROOT / "configs/rigs/standard.yaml"


@pytest.mark.parametrize("file", sorted((ROOT / "configs/rigs").glob("*.yaml")), ids=lambda file: file.stem)
def test_a_rig_file_is_valid(file):
    Rig.model_validate(load_tree(file).values["rig"])


@pytest.mark.parametrize("file", sorted((ROOT / "recordings").glob("*.mcap")), ids=lambda file: file.stem)
def test_the_rig_of_a_recording_is_valid(file):
    Rig.model_validate(yaml_values(Session(file).rig_yaml or ""))


@pytest.mark.parametrize(
    ("section", "change"),
    [
        ("", {"foo": 3}),
        ("", {"version": 2}),
        ("drone", {"span": 0.8}),
        ("drone", {"span_m": -1}),
        ("lidar", {"modell": "XT16"}),
        ("cameras", {"front": {}}),
        ("cameras.drone", {"max_off_axis": 60}),
        ("cameras.drone", {"masked": []}),
        ("cameras.drone", {"masked_px": [[[1, 2], [3, 4]]]}),
        ("cameras.vehicle", {"T_drone_camera": {}}),
    ],
)
def test_a_wrong_name_or_value_is_an_error(section, change):
    rig = yaml_values(STANDARD.read_bytes())["rig"]
    part = rig
    for name in section.split(".") if section else ():
        part = part[name]
    part |= change
    with pytest.raises(ValidationError) as caught:
        Rig.model_validate(rig)
    assert len(caught.value.errors()) == 1


def test_the_commands_check_the_rig_of_a_configuration_and_that_of_a_recording(tmp_path):
    config = str(ROOT / "configs/vision.yaml")
    text = command.grd("check", config, "--set", "rig.cameras.drone.max_off_axis=60", code=1)
    assert text.splitlines()[-1] == (
        "--set rig.cameras.drone.max_off_axis=60: rig.cameras.drone.max_off_axis: unknown setting 'max_off_axis'. "
        "Did you mean 'max_off_axis_deg'?"
    )
    with pytest.raises(Exception, match=r"^x\.mcap \(rig\.yaml\):2: rig\.drone\.span: unknown setting 'span'\.[^\n]*$"):
        RunRequest(ROOT / "configs/estimate.yaml").graph("lidar: {}\ndrone: {span: 1}", "x.mcap (rig.yaml)")


def test_vision_on_a_rig_without_cameras_is_estimate():
    rig = "lidar: {mount: {}}\ndrone: {span_m: 0.5}"
    vision, estimate = (RunRequest(ROOT / f"configs/{name}.yaml").graph(rig, "rig") for name in ("vision", "estimate"))
    assert vision.nodes.keys() == estimate.nodes.keys()
    assert set(vision.edges) == set(estimate.edges)
    assert {needed for needed in vision.left_out.values()} == {"$rig.cameras"}
