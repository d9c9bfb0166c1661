"""`grd lens`: a file of a calibration program becomes part of a rig, or is rejected with its line."""

from __future__ import annotations

import itertools

import pytest
import yaml

from flow.graph import load_graph
from tests import command
from tests.stages.geometry.test_lens import KANNALA_BRANDT, OCAM
from tests.stages.geometry.test_lens_files import KALIBR, OCAMCALIB
from tests.test_architecture import ROOT


@pytest.fixture
def grd(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "camchain.yaml").write_text(KALIBR)
    (tmp_path / "calib_results.txt").write_text(OCAMCALIB)
    return command.grd


def test_both_lenses_are_in_the_rig_of_a_configuration_with_their_numbers(grd, tmp_path):
    grd("lens", "camchain.yaml", "vehicle", "--max-off-axis-deg", "120", "-o", "vehicle.yaml")
    text = grd("lens", "calib_results.txt", "drone", "--max-off-axis-deg", "120")
    assert "1440 x 1440 px" in text
    assert "calib_results.drone.rig.yaml" in text
    config = tmp_path / "mine.yaml"
    config.write_text(f"include: [{ROOT}/configs/field.yaml, vehicle.yaml, calib_results.drone.rig.yaml]\n")
    (tmp_path / "camchain.yaml").unlink()  # the rig needs it no more
    assert "no errors" in grd("check", config)
    graph = load_graph(config)
    assert graph.nodes["vp_vehicle"].build().settings.lens == KANNALA_BRANDT
    assert graph.nodes["vp_drone"].build().settings.lens == OCAM
    assert graph.nodes["camera_drone"].build().settings.size_px == 1440
    cameras = yaml.safe_load(graph.settings_yaml())["rig"]["cameras"]  # what a recording brings
    assert cameras["vehicle"]["lens"]["k"] == list(KANNALA_BRANDT.k)
    assert "focal_px" not in cameras["drone"]["lens"]  # of the equidistant lens that stood there
    assert cameras["drone"]["T_drone_camera"]["rpy_deg"] == [180.0, 0.0, -90.0]


def test_a_size_that_is_not_square_is_that_of_the_camera(grd, tmp_path):
    (tmp_path / "wide.yaml").write_text(KALIBR.replace("[720, 720]", "[1280, 800]"))
    assert "1280 x 800 px" in grd("lens", "wide.yaml", "vehicle")
    config = tmp_path / "mine.yaml"
    config.write_text(f"include: [{ROOT}/configs/field.yaml, wide.vehicle.rig.yaml]\n")
    assert "no errors" in grd("check", config)
    assert load_graph(config).nodes["camera_vehicle"].build().settings.size_px == (1280, 800)


def test_a_wrong_file_is_named_with_its_line_and_nothing_is_written(grd, tmp_path):
    before = sorted(tmp_path.iterdir())
    assert grd("lens", "camchain.yaml", "drone", "--camera", "cam1", code=2).startswith("camchain.yaml:8: cam1: ")
    assert grd("lens", "camchain.yaml", "drone", "--camera", "cam7", code=2).startswith("camchain.yaml: no camera")
    (tmp_path / "camchain.yaml").write_text(KALIBR.replace("intrinsics: [", "intrinsics: [-"))
    assert "focal_px.0: Input should be greater than 0" in grd("lens", "camchain.yaml", "drone", code=2)
    assert grd("lens", "none.yaml", "drone", code=2).startswith("none.yaml: No such file")
    assert "at most" in grd("lens", "calib_results.txt", "drone", "--max-off-axis-deg", "150", code=2)
    (tmp_path / "calib_results.txt").rename("lens.mat")
    assert "neither Kalibr's .yaml" in grd("lens", "lens.mat", "drone", code=2)
    assert grd("lens", "camchain.yaml", "bird", code=2)
    assert sorted(tmp_path.iterdir()) == sorted([*(f for f in before if f.suffix != ".txt"), tmp_path / "lens.mat"])


def test_a_bomb_of_aliases_is_refused(grd, tmp_path):
    names = "abcdefgh"
    bomb = "a: &a [0,0,0,0,0,0,0,0,0]\n" + "".join(
        f"{name}: &{name} [{', '.join([f'*{below}'] * 9)}]\n" for below, name in itertools.pairwise(names)
    )
    (tmp_path / "bomb.yaml").write_text(
        bomb + KALIBR.replace("distortion_coeffs", "T_cam_imu: *h\n  distortion_coeffs")
    )
    assert "too large" in grd("lens", "bomb.yaml", "drone", code=2)
    (tmp_path / "tag.yaml").write_text("cam0: !!bool 7\n")
    assert "cannot be read" in grd("lens", "tag.yaml", "drone", code=2)


def test_an_existing_file_is_overwritten_on_request_only_and_the_calibration_never(grd, tmp_path):
    grd("lens", "camchain.yaml", "drone")
    assert "--overwrite" in grd("lens", "camchain.yaml", "drone", code=2)
    grd("lens", "camchain.yaml", "drone", "--overwrite")
    assert "give another name" in grd("lens", "camchain.yaml", "drone", "-o", "camchain.yaml", "--overwrite", code=2)
    assert (tmp_path / "camchain.yaml").read_text() == KALIBR
