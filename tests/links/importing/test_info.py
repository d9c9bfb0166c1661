"""`grd info` of runs and recordings: facts, errors against the truth, and damaged files in one sentence."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flow.link import LinkError, Record
from links.cli.console import check_output
from links.importing.info import file_info
from links.recording import RecordingWriter


def run_folder(tmp_path: Path, summary: str) -> Path:
    (tmp_path / "fix_vehicle_drone.tum").write_text("# position only\n")
    (tmp_path / "config.yaml").write_text("version: 1\n")
    (tmp_path / "summary.json").write_text(summary)
    return tmp_path


def test_info_shows_the_errors_of_the_lidar_positions_and_of_the_fused_poses(tmp_path: Path):
    values = {"fixes": 7, "truth_errors": {"rmse_3d_m": 0.12}, "pose_errors": {"rmse_3d_m": 0.34, "rmse_deg": None}}
    facts = dict(file_info(run_folder(tmp_path, json.dumps(values))).facts)
    assert facts["fixes"] == "7"
    assert facts["LiDAR positions against the truth, rmse_3d_m"] == "0.12"
    assert facts["fused poses against the truth, rmse_3d_m"] == "0.34"
    assert facts["fused poses against the truth, rmse_deg"] == "-"


@pytest.mark.parametrize("text", ["", '{"fixes": 7', "[]", '{"truth_errors": []}', '{"warnings": 3}', "[" * 100_000])
def test_a_damaged_summary_is_refused_with_advice(tmp_path: Path, text: str):
    with pytest.raises(LinkError, match=r"summary.json is damaged \(.*grd replay.*or remove it") as error:
        file_info(run_folder(tmp_path, text))
    assert "\n" not in str(error.value)


def test_rig_and_configuration_are_two_facts(tmp_path: Path):
    with RecordingWriter(tmp_path / "a.mcap", rig_yaml="version: 1\n", lossless=True) as writer:
        writer.write(Record("/servo/state", 1, 1, b"{}"))
    facts = file_info(tmp_path / "a.mcap").facts
    assert ("rig", "yes") in facts
    assert ("configuration", "no") in facts


def test_an_existing_output_file_is_refused_unless_it_may_be_overwritten(tmp_path: Path):
    file = tmp_path / "mapping.yaml"
    check_output(file, "--map", overwrite=False)
    file.touch()
    check_output(file, "--map", overwrite=True)
    with pytest.raises(LinkError, match=r"mapping.yaml exists already: give another name with --map, or --overwrite"):
        check_output(file, "--map", overwrite=False)
