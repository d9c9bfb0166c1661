"""The matrix: every cell is what its name says, and making it is resumed where it stopped."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path as FilePath

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from links.cli.app import app
from links.recording import RecordingReader
from links.simulated import matrix_flights
from links.simulated.clearance import sample_times_s, visible
from links.simulated.matrix import MOTIONS, RANGES_M, SCENES, VEHICLES, cells, make_matrix, scenario_of
from links.simulated.matrix_flights import Cell
from links.simulated.mesh import RayScene
from links.simulated.scenario import Scenario
from links.simulated.world import build_world

LIDAR_UP = np.array([0.0, 0.0, 0.35])


def flown(scenario: Scenario) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, LiDAR and drone positions in the world."""
    times = sample_times_s(scenario.duration_s)
    assert scenario.drone is not None
    return times, scenario.vehicle.path.at(times)[0] + LIDAR_UP, scenario.drone.path.at(times)[0]


def seen(scenario: Scenario) -> np.ndarray:
    _, lidar, drone = flown(scenario)
    way = scenario.vehicle.path.at(np.arange(0.0, scenario.duration_s, 0.25))[0][:, :2]
    scene = build_world(scenario.scene, scenario.vehicle.camera_height_m, scenario.seed, way)
    return visible(RayScene(scene.mesh), lidar, drone)


def test_the_matrix_is_the_whole_product_with_the_special_flights_and_no_name_twice() -> None:
    names = [cell.name for cell in cells()]
    assert len(names) == len(set(names)) == 5 * 6 * 3 * 5 + 5 + 4
    assert min(RANGES_M) == 10
    assert max(RANGES_M) == 60
    assert [cell.name for cell in cells("campus-20m-orbit-*")] == [f"campus-20m-orbit-{v}" for v in VEHICLES]
    assert cells("nowhere-*") == []


def test_in_pairs_each_two_values_meet_in_few_cells() -> None:
    few = [cell for cell in cells(pairs=True) if cell.motion in MOTIONS]
    assert len(few) == 30
    axes = {"range_m": RANGES_M, "motion": MOTIONS, "vehicle": VEHICLES, "scene": SCENES}
    for a, b in combinations(axes, 2):
        met = {(getattr(cell, a), getattr(cell, b)) for cell in few}
        assert met == {(x, y) for x in axes[a] for y in axes[b]}, (a, b)


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_motion_stays_about_its_range_in_sight_at_its_own_speed(motion: str) -> None:
    scenario = scenario_of(Cell("manhattan", 20, motion, "parked"), 3)
    times, lidar, drone = flown(scenario)
    range_m = np.linalg.norm(drone - lidar, axis=1)
    speed = np.linalg.norm(np.diff(drone, axis=0), axis=1) / np.diff(times)
    assert 0.6 * 20 < range_m.min() <= 20.5
    assert range_m.max() < 20 * 1.45
    assert seen(scenario).mean() > 0.94
    fastest = {"hover": 0.3, "orbit": 3.0, "cross": 3.0, "fast": 8.0, "overhead": 2.0, "climb": 2.0}[motion]
    assert speed.max() <= fastest * 1.05 + 0.05
    assert speed.max() > 0.3 * fastest


def test_the_drone_goes_with_a_vehicle_that_drives_or_turns() -> None:
    for vehicle in ("driving", "turning"):
        scenario = scenario_of(Cell("manhattan", 20, "hover", vehicle), 2)
        times, lidar, drone = flown(scenario)
        assert np.linalg.norm(drone - lidar, axis=1) == pytest.approx(20.0, abs=0.6)
        moved = np.linalg.norm(lidar[-1] - lidar[0])
        turned = np.ptp(scenario.vehicle.path.at(times)[3])
        assert (moved > 15 and turned < 0.1) if vehicle == "driving" else (moved < 9 and turned > 3.5)


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_a_vehicle_moves_where_it_heads(seed: int) -> None:
    for vehicle in ("driving", "turning"):
        scenario = scenario_of(Cell("open_lot", 20, "hover", vehicle), seed)
        _, velocity, _, yaw = scenario.vehicle.path.at(np.array([3.0, 5.0, 8.0]))
        speed = np.hypot(velocity[:, 0], velocity[:, 1])
        ahead = velocity[:, 0] * np.cos(yaw) + velocity[:, 1] * np.sin(yaw)
        assert ahead == pytest.approx(speed, rel=0.01)
        assert speed.min() > 0.3


def test_an_occlusion_hides_the_drone_once_for_three_seconds() -> None:
    scenario = scenario_of(Cell("manhattan", 35, "occlusion", "parked"), 1)
    hidden = np.nonzero(~seen(scenario))[0]
    assert (hidden[-1] - hidden[0]) * 0.05 == pytest.approx(3.0, abs=0.5)
    assert hidden[0] * 0.05 > 5
    assert hidden[-1] * 0.05 < scenario.duration_s - 2


def test_a_drone_leaves_the_lidars_reach_and_returns() -> None:
    _, lidar, drone = flown(scenario_of(Cell("open_lot", 20, "return", "parked"), 1))
    range_m = np.linalg.norm(drone - lidar, axis=1)
    assert range_m[0] == pytest.approx(20.0, abs=0.1)
    assert range_m.max() > 103
    assert range_m[-1] == pytest.approx(20.0, abs=0.1)


def test_a_seed_makes_one_scenario_and_another_seed_another() -> None:
    cell = Cell("park_edge", 30, "cross", "driving")
    assert scenario_of(cell, 1) == scenario_of(cell, 1)
    assert scenario_of(cell, 1).drone != scenario_of(cell, 2).drone


def test_a_scenario_survives_its_own_yaml() -> None:
    scenario = scenario_of(Cell("atlanta", 10, "orbit", "turning"), 4)
    assert Scenario.model_validate(yaml.safe_load(scenario.as_yaml())) == scenario


def test_what_is_there_and_whole_is_kept_and_all_else_made_again(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matrix_flights, "USUAL_DURATION_S", 0.2)
    wanted, told = cells("open_lot-10m-hover-*"), []
    first = make_matrix(tmp_path, wanted, range(1, 2), None, lambda done, whole: told.append((done, whole)))
    assert (first.made, first.kept, first.impossible) == (3, 0, ())
    assert told[-1] == pytest.approx((0.6, 0.6))
    file = tmp_path / "open_lot-10m-hover-parked-s1.mcap"
    with RecordingReader(file) as reader:
        assert reader.metadata["scenario"] == "open_lot-10m-hover-parked"
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    again = make_matrix(tmp_path, wanted, range(1, 2), None, lambda done, whole: None)
    assert (again.made, again.kept) == (1, 2)
    assert file.read_bytes() == whole


def test_a_scene_without_a_place_is_told_and_the_rest_is_made(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(matrix_flights.DURATION_S, "occlusion", 0.3)
    report = make_matrix(
        tmp_path, [Cell("open_lot", 35, "occlusion", "parked")], range(1, 2), None, lambda done, whole: None
    )
    assert report.made == 0
    assert report.impossible[0].startswith("seed 1: open_lot-35m-occlusion-parked: no free flight of this kind")


def test_the_command_names_cells_and_refuses_a_pattern_that_fits_none(tmp_path: FilePath) -> None:
    listed = CliRunner().invoke(app, ["matrix", str(tmp_path), "--only", "*-10m-climb-parked", "--list"])
    assert listed.exit_code == 0
    assert listed.stdout.split() == [f"{scene}-10m-climb-parked" for scene in SCENES]
    wrong = CliRunner().invoke(app, ["matrix", str(tmp_path), "--only", "moon-*"])
    assert wrong.exit_code == 2
    assert "no cell is called like 'moon-*'" in wrong.output
