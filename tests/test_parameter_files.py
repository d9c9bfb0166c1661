"""deploy/parameters: each file passes grd's own preflight for the setting that it names."""

from __future__ import annotations

from pathlib import Path

import pytest

from links.mavlink.profiles import ProfileName, YawOutput, findings, required_parameters

FOLDER = Path(__file__).resolve().parents[1] / "deploy" / "parameters"
FILES: dict[str, tuple[ProfileName, YawOutput]] = {
    "ardupilot_gps.param": ("ardupilot", "none"),
    "ardupilot_gps_yaw.param": ("ardupilot", "measured"),
    "ardupilot_no_gps.param": ("ardupilot", "measured"),
    "px4_gps.params": ("px4", "none"),
    "px4_no_gps.params": ("px4", "measured"),
}


def values_of(file: Path) -> dict[str, float]:
    """ArduPilot: NAME,VALUE; QGroundControl: vehicle, component, name, value, type."""
    lines = [line for line in file.read_text().splitlines() if line and not line.startswith("#")]
    if file.suffix == ".param":
        return {name: float(value) for name, value in (line.split(",") for line in lines)}
    return {fields[2]: float(fields[3]) for fields in (line.split("\t") for line in lines) if len(fields) == 5}


@pytest.mark.parametrize("name", FILES)
def test_a_parameter_file_has_all_that_preflight_requires(name: str):
    profile, yaw = FILES[name]
    assert findings(required_parameters(profile, yaw), values_of(FOLDER / name)) == []
    assert f"yaw: {yaw}" in " ".join((FOLDER / name).read_text().split())


def test_each_file_is_tested():
    assert {file.name for file in FOLDER.iterdir()} == FILES.keys()


def test_the_file_of_one_source_does_not_pass_for_the_other():
    values = values_of(FOLDER / "ardupilot_gps.param")
    assert any("EK3_SRC2_YAW" in found for found in findings(required_parameters("ardupilot", "measured"), values))
