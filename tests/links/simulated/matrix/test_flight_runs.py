"""Flights of several scenarios and seeds: outcomes are kept, and summed up in a table."""

from __future__ import annotations

from pathlib import Path

import pytest

from flow.config_error import ConfigError
from flow.link import LinkError
from links.simulated.matrix.flight_runs import FlightResult, fly_all
from links.simulated.matrix.flight_table import markdown_table, write_csv
from links.simulated.rig.run import simulate
from links.simulated.rig.scenario import load_scenario

ROOT = Path(__file__).parents[4]
CONFIG = ROOT / "configs/sim_flight_fixes.yaml"
HOVER = ROOT / "configs/scenarios/flight/matrix/hover.yaml"
MATRIX = sorted(HOVER.parent.glob("*.yaml"))
SHORT = ("duration_s=0.5",)


def silent(done: float, whole: float) -> None:
    """Ignored progress."""


def fly(folder: Path, *sets: str, seeds: range = range(1, 2)) -> list[FlightResult]:
    return fly_all([HOVER], (*SHORT, *sets), CONFIG, seeds, folder, 1, silent)


def test_an_outcome_is_kept_until_a_setting_changes(tmp_path: Path) -> None:
    first = fly(tmp_path, seeds=range(1, 3))
    assert [(r.scenario, r.seed, r.kept) for r in first] == [("hover", 1, False), ("hover", 2, False)]
    again = fly(tmp_path, seeds=range(1, 4))
    assert [r.kept for r in again] == [True, True, False]
    assert again[0].outcome == first[0].outcome
    assert not fly(tmp_path, "autopilot.imu_hz=25")[0].kept
    (tmp_path / "hover-s1.json").write_text("{", encoding="utf-8")
    assert not fly(tmp_path)[0].kept


def test_a_flight_that_its_scene_does_not_allow_does_not_stop_the_others(tmp_path: Path) -> None:
    results = fly(tmp_path, "autopilot.flight_stack.on_ground=true")
    assert results[0].outcome is None
    assert "something stands where it takes off" in str(results[0])
    assert "0 of 0 (1 not possible)" in markdown_table(results)


def test_a_wrong_setting_is_an_error_before_the_first_flight(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--set autopilot\.imu_khz=1.*unknown setting 'imu_khz'"):
        fly(tmp_path, "autopilot.imu_khz=1")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("scenario", "config", "error"),
    [
        (
            "hover_fixes",
            "estimate",
            "has a fix_sensor in place of a LiDAR, which the configuration does not read: use configs/sim_flight_fixes",
        ),
        ("hover_fixes", "sim_flight", "has a fix_sensor in place of a LiDAR"),
        ("hover_fixes", "sim_flight_cameras_fixes", r"lacks what the configuration needs: .* no \$rig\.cameras"),
        ("hover", "sim_flight_fixes", "has no fix_sensor, which the configuration reads: use .* or set fix_sensor={}"),
        ("matrix/hover", "sim_flight_rotations_fixes", r"has no rotation_sensor, .* or set rotation_sensor={} of"),
        ("matrix/hover_rotations", "sim_flight_fixes", "has a rotation_sensor in place of cameras, which"),
        (
            "hover",
            "sim",
            r"flies on poses of grd \(flight_stack\), and the configuration sends none: wire 'autopilot: ",
        ),
        ("../experiment_1", "sim_flight", "no autopilot in the loop, set autopilot.flight_stack"),
    ],
)
def test_a_configuration_that_cannot_fly_a_scenario_is_an_error_before_the_first_flight(
    scenario: str, config: str, error: str, tmp_path: Path
) -> None:
    file, configuration = ROOT / f"configs/scenarios/flight/{scenario}.yaml", ROOT / f"configs/{config}.yaml"
    with pytest.raises(LinkError, match=error):
        fly_all([file], SHORT, configuration, range(1, 2), tmp_path / "out", 1, silent)
    assert not list(tmp_path.iterdir())
    if config != "sim_flight":  # the command for one flight reports it as well
        with pytest.raises(LinkError, match=error):
            simulate(file, tmp_path / "x.mcap", closed_loop=configuration)
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "setting", ["vehicle_odometry.frozen_s=[5, 1]", "lidar_gaps_s=[[2, 2]]", "closed_loop.killed_s=[5, 1]"]
)
def test_a_time_span_that_ends_before_it_begins_is_an_error(setting: str) -> None:
    with pytest.raises(ConfigError, match=r"a time span is \[from, to\], with from before to, got \["):
        load_scenario(HOVER, [setting])


@pytest.mark.parametrize("scenario", MATRIX, ids=lambda file: file.stem)
def test_each_scenario_of_the_matrix_is_valid_and_has_the_name_of_its_file(scenario: Path) -> None:
    loaded = load_scenario(scenario)
    assert loaded.name == scenario.stem
    assert loaded.autopilot is not None
    assert loaded.autopilot.flight_stack is not None


def outcome(**values: object) -> dict[str, object]:
    none = dict.fromkeys(("sent_95_m", "hover_scatter_m", "sent_yaw_rms_deg", "inside_share", "yaw_inside_share"))
    usual = {"crashed": False, "lost_s": None, "sent_poses": 100, "wrong_poses": 0, "heading_s": 4.0, "text": "text"}
    return none | {"longest_gap_s": 0.5} | usual | values


def test_a_row_counts_losses_once_and_takes_medians_and_worst_values(tmp_path: Path) -> None:
    flights = [
        outcome(sent_95_m=0.1, inside_share=1.0, heading_s=3.0),
        outcome(sent_95_m=0.3, inside_share=0.5, sent_poses=300, wrong_poses=7, heading_s=None, lost_s=30.0),
        outcome(sent_95_m=0.2, crashed=True, lost_s=25.0, heading_s=5.0),
    ]
    results = [FlightResult("gap", seed, flight) for seed, flight in enumerate(flights)]
    row = markdown_table(results).splitlines()[-1]
    assert row == ("| gap | 1 of 3 | 1, 1 | 7 of 500 | 0.20, 0.30 | - | - | 62, - | 5.0, never | 0.5, 0.5 |")
    write_csv(tmp_path / "flights.csv", results)
    lines = (tmp_path / "flights.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 4
    assert lines[0].startswith("scenario,seed,sent_95_m,")
