"""The matrix: the scenario of every cell fits its name."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path as FilePath

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from flow.link import LinkError
from links.cli.app import app
from links.recording import RecordingReader
from links.simulated.matrix import flights
from links.simulated.matrix.flights import Cell, drone_path, two_paths
from links.simulated.matrix.matrix import (
    MOTIONS,
    RANGES_M,
    SCENES,
    SERVO,
    VEHICLES,
    Conditions,
    cells,
    scenario_of,
)
from links.simulated.rig.run import Simulation
from links.simulated.rig.scenario import Scenario
from links.simulated.sensors.camera import CamerasSettings
from links.simulated.sensors.servo import GearTrain
from links.simulated.world.clearance import sample_times_s, visible
from links.simulated.world.mesh import RayScene, box, merge
from links.simulated.world.procedural import build_world
from links.simulated.world.procedural.settings import Kind
from stages.geometry.frames import Pose
from stages.kernels.geometry.so3 import log_rotation

LIDAR_UP = np.array([0.0, 0.0, 0.35])


def flown(scenario: Scenario) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, and positions of LiDAR and drones, world frame."""
    times = sample_times_s(scenario.duration_s)
    assert scenario.drone is not None
    return times, scenario.vehicle.path.at(times)[0] + LIDAR_UP, scenario.drone.path.at(times)[0]


def visible_now(scenario: Scenario) -> np.ndarray:
    _, lidar, drone = flown(scenario)
    path = scenario.vehicle.path.at(np.arange(0.0, scenario.duration_s, 0.25))[0][:, :2]
    scene = build_world(scenario.scene, scenario.vehicle.camera_height_m, scenario.seed, path)
    return visible(RayScene(scene.mesh), lidar, drone)


def test_the_matrix_is_the_full_product_plus_special_cells_with_unique_names() -> None:
    names = [cell.name for cell in cells()]
    special = 5 * 3 + 4 + 5 + 5 + 2 * 5  # empty, occlusion at 20 m, two, search, 50 m
    assert len(names) == len(set(names)) == 5 * 6 * 3 * 5 + 5 + 4 + special
    assert min(RANGES_M) == 10
    assert max(RANGES_M) == 60
    assert [cell.name for cell in cells(["campus-20m-orbit-*"])] == [f"campus-20m-orbit-{v}" for v in VEHICLES]
    assert cells(["nowhere-*"]) == []


def test_pairs_has_any_two_values_together_in_few_cells() -> None:
    assert len(cells(pairs=True)) == 39
    few = [cell for cell in cells(pairs=True) if cell.motion in MOTIONS]
    assert len(few) == 30
    axes = {"range_m": RANGES_M, "motion": MOTIONS, "vehicle": VEHICLES, "scene": SCENES}
    for a, b in combinations(axes, 2):
        met = {(getattr(cell, a), getattr(cell, b)) for cell in few}
        assert met == {(x, y) for x in axes[a] for y in axes[b]}, (a, b)


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_motion_stays_near_its_range_visible_and_at_its_speed(motion: str) -> None:
    scenario = scenario_of(Cell("manhattan", 20, motion, "parked"), 3)
    times, lidar, drone = flown(scenario)
    range_m = np.linalg.norm(drone - lidar, axis=1)
    speed = np.linalg.norm(np.diff(drone, axis=0), axis=1) / np.diff(times)
    assert 0.6 * 20 < range_m.min() <= 20.5
    assert range_m.max() < 20 * 1.45
    assert visible_now(scenario).mean() > 0.94
    fastest = {"hover": 0.3, "orbit": 3.0, "cross": 3.0, "fast": 8.0, "overhead": 2.0, "climb": 2.0}[motion]
    assert speed.max() <= fastest * 1.05 + 0.05
    assert speed.max() > 0.3 * fastest


def test_the_drone_follows_a_vehicle_that_drives_or_turns() -> None:
    for vehicle in ("driving", "turning"):
        scenario = scenario_of(Cell("manhattan", 20, "hover", vehicle), 2)
        times, lidar, drone = flown(scenario)
        assert np.linalg.norm(drone - lidar, axis=1) == pytest.approx(20.0, abs=0.6)
        moved = np.linalg.norm(lidar[-1] - lidar[0])
        yaw_change = np.ptp(scenario.vehicle.path.at(times)[3])
        assert (moved > 15 and yaw_change < 0.1) if vehicle == "driving" else (moved < 9 and yaw_change > 3.5)


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
    hidden = np.nonzero(~visible_now(scenario))[0]
    assert (hidden[-1] - hidden[0]) * 0.05 == pytest.approx(3.0, abs=0.5)
    assert hidden[0] * 0.05 > 5
    assert hidden[-1] * 0.05 < scenario.duration_s - 2


def test_a_drone_leaves_the_lidars_range_and_returns() -> None:
    _, lidar, drone = flown(scenario_of(Cell("open_lot", 20, "return", "parked"), 1))
    range_m = np.linalg.norm(drone - lidar, axis=1)
    assert range_m[0] == pytest.approx(20.0, abs=0.1)
    assert range_m.max() > 103
    assert range_m[-1] == pytest.approx(20.0, abs=0.1)


def test_special_cells_are_named_after_their_motion() -> None:
    patterns = ["*-0m-empty-*", "*-20m-two-parked", "*-40m-search-parked", "*-50m-*"]
    names = {cell.name for cell in cells(patterns)}
    assert len(names) == 35
    assert {"campus-0m-empty-driving", "atlanta-20m-two-parked", "open_lot-40m-search-parked"} <= names
    assert {"manhattan-50m-hover-parked", "park_edge-50m-orbit-parked"} <= names
    assert cells(patterns, pairs=True) == []


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_an_empty_sky_has_no_drone_and_the_vehicle_stays_in_the_scene(vehicle: str) -> None:
    scenario = scenario_of(Cell("park_edge", 0, "empty", vehicle), 1)
    assert (scenario.drone, scenario.truth_visible, scenario.duration_s) == (None, False, 30.0)
    driven = scenario.vehicle.path.at(sample_times_s(30.0))[0]
    far_m = np.linalg.norm(driven, axis=1).max()
    assert (far_m > 40) if vehicle == "driving" else (far_m < 9)
    assert far_m < 76


@pytest.mark.parametrize("scene", ["manhattan", "open_lot"])
def test_of_two_drones_one_orbits_and_one_hovers_and_they_keep_their_separation(scene: Kind) -> None:
    scenario = scenario_of(Cell(scene, 20, "two", "parked"), 1)
    times, lidar, orbiting = flown(scenario)
    (other,) = scenario.other_drones
    hovering = other.path.at(times)[0]
    assert np.linalg.norm(orbiting - lidar, axis=1) == pytest.approx(20.0, abs=0.1)
    assert np.linalg.norm(hovering - lidar, axis=1) == pytest.approx(20.0, abs=0.3)
    speeds = [np.linalg.norm(np.diff(p, axis=0), axis=1) / np.diff(times) for p in (orbiting, hovering)]
    assert speeds[0][10:-10] == pytest.approx(3.0, rel=0.02)
    assert speeds[1].max() < 0.3
    azimuths = [np.degrees(np.arctan2(p[:, 1], p[:, 0])) for p in (orbiting, hovering)]
    separation = np.abs((azimuths[0] - azimuths[1] + 180) % 360 - 180)
    assert 38 < separation[0] < 62
    assert separation.min() > 38
    assert visible_now(scenario).mean() > 0.94
    assert visible_now(scenario.changed(drone=other, other_drones=())).mean() > 0.94


def test_two_drones_that_would_meet_are_rejected() -> None:
    """Between walls 8 m away only steep flights have room, and a steep orbit closes within 12 s."""
    walls = [box((x, y, -2), (x + dx, y + dy, 60), "brick") for x, y, dx, dy in ((-9, -9, 1, 18), (8, -9, 1, 18))]
    walls += [box((x, y, -2), (x + dx, y + dy, 60), "brick") for x, y, dx, dy in ((-9, -9, 18, 1), (-9, 8, 18, 1))]
    world, times = RayScene(merge(walls)), sample_times_s(12.0)
    lidar = np.tile(LIDAR_UP, (len(times), 1))
    drone_path(
        Cell("manhattan", 20, "orbit", "parked"), world, np.random.default_rng(1), times, lidar
    )  # possible on its own
    with pytest.raises(LinkError, match="manhattan-20m-two-parked: no free flight of this kind"):
        two_paths(Cell("manhattan", 20, "two", "parked"), world, np.random.default_rng(1), times, lidar)


def test_a_drone_to_search_for_hovers_high_at_40_m_while_the_servo_sweeps() -> None:
    scenario = scenario_of(Cell("campus", 40, "search", "parked"), 2)
    _, lidar, drone = flown(scenario)
    offset = drone - lidar
    assert np.linalg.norm(offset, axis=1) == pytest.approx(40.0, abs=0.3)
    assert np.degrees(np.arctan2(offset[:, 2], np.hypot(offset[:, 0], offset[:, 1]))).min() > 44
    assert [segment.do for segment in scenario.script] == ["sweep"]


def test_a_calibrated_rig_file_has_encoder_error_and_backlash_and_the_world_is_unchanged() -> None:
    cell = Cell("open_lot", 20, "hover", "parked")
    plain, known = scenario_of(cell, 3), scenario_of(cell, 3, Conditions(calibrated=True))
    assert known.mount == plain.mount == plain.rig.mount
    assert (known.mount.servo_harmonics, known.mount.servo_play_deg) == ((), 0.0)
    assert known.rig.mount.servo_play_deg == SERVO.backlash_deg
    tight = SERVO.model_copy(update={"backlash_deg": 0.0})
    yaw_change = GearTrain(tight, 3)
    encoder = np.linspace(0.0, np.pi, 50)
    truly = np.array([yaw_change.follow(p) for p in encoder])
    assert known.rig.mount.turntable_rad(encoder) == pytest.approx(truly, abs=1e-7)
    assert np.abs(plain.rig.mount.turntable_rad(encoder) - truly).max() > np.radians(0.1)
    sensed = [[(r.topic, r.data) for r in Simulation(s.changed(duration_s=0.2)).records()] for s in (plain, known)]
    assert sensed[0] == sensed[1]
    assert Scenario.model_validate(yaml.safe_load(known.as_yaml())).as_yaml() == known.as_yaml()


def test_odometry_and_rain_are_added_to_a_cell_and_change_nothing_else() -> None:
    cell = Cell("open_lot", 20, "hover", "driving")
    both = scenario_of(cell, 3, Conditions(odometry=True, rain=True))
    assert both.vehicle_odometry is not None
    assert both.weather.rain_mmph == 5.0
    assert both.changed(vehicle_odometry=None, weather={}) == scenario_of(cell, 3)


def test_cameras_are_added_to_a_cell_and_change_nothing_else() -> None:
    cell = Cell("open_lot", 20, "hover", "driving")
    visible_now = scenario_of(cell, 3, Conditions(cameras_hz=4.0))
    assert visible_now.cameras.vehicle is not None
    assert visible_now.cameras.drone is not None
    assert (visible_now.cameras.vehicle.rate_hz, visible_now.cameras.drone.rate_hz) == (4.0, 4.0)
    large = scenario_of(cell, 3, Conditions(cameras_hz=4.0, cameras_px=1080, readout_ms=20.0)).cameras
    assert large.vehicle is not None
    assert large.drone is not None
    assert (large.vehicle.size_px, large.drone.size_px) == (1080, 1080)
    assert (large.vehicle.readout_ms, large.drone.readout_ms) == (20.0, 20.0)
    assert visible_now.changed(cameras={}) == scenario_of(cell, 3)
    nobody = scenario_of(Cell("open_lot", 0, "empty", "parked"), 3, Conditions(cameras_hz=4.0))
    assert nobody.cameras.vehicle is not None
    assert nobody.cameras.drone is None


def test_a_perturbed_rig_differs_from_its_file_and_its_drone_is_one_of_several() -> None:
    cell, conditions = (
        Cell("open_lot", 20, "hover", "driving"),
        Conditions(calibrated=True, cameras_hz=4.0, perturbed=True),
    )
    ideal = scenario_of(cell, 3, Conditions(calibrated=True, cameras_hz=4.0))
    perturbed = [scenario_of(cell, seed, conditions) for seed in range(1, 30)]
    third = perturbed[2]
    assert third.rig == ideal.rig
    assert Scenario.model_validate(yaml.safe_load(third.as_yaml())).as_yaml() == third.as_yaml()
    zero_deg = [s.mount.servo_zero_deg for s in perturbed]
    tilt_deg = [np.degrees(np.arccos(s.mount.T_vehicle_turntable.matrix()[2, 2])) for s in perturbed]
    assert 0.07 < np.std(zero_deg) < 0.13
    assert 0.05 < np.sqrt(np.mean(np.square(tilt_deg))) < 0.09  # of two axes
    assert 0.012 < np.std([s.lidar.range_offset_m for s in perturbed]) < 0.022
    drones = [s.drone for s in perturbed if s.drone is not None]
    assert {(d.model.shape, d.span_m) for d in drones} == {("x4", 0.5), ("folding", 0.35), ("hexa", 0.8)}
    assert len({d.model.surface for d in drones}) == 4
    rig, was = (yaml.safe_load(s.rig_yaml()) for s in (third, ideal))
    assert rig["lidar"] == was["lidar"]
    assert third.drone is not None
    assert rig["drone"] == {"span_m": third.drone.span_m}
    for platform, one in (("vehicle", third.cameras.vehicle), ("drone", third.cameras.drone)):
        assert one is not None
        stated, true = (
            Pose(**rig["cameras"][platform][f"T_{platform}_camera"]).matrix()[:3, :3],
            rig_mount(platform, third),
        )
        rotation_deg = np.degrees(np.linalg.norm(log_rotation(stated @ true.T)))
        assert 0.005 < rotation_deg < 0.3
        lens = rig["cameras"][platform]["lens"]
        assert 0 < abs(lens["focal_px"] / one.true_lens.focal_px - 1) < 0.003  # pyright: ignore
        assert 0 < np.abs(np.subtract(lens["centre_px"], one.true_lens.centre_px)).max() < 1.0
    other = scenario_of(Cell("campus", 20, "hover", "driving"), 3, conditions)
    assert other.mount.servo_zero_deg != third.mount.servo_zero_deg


def rig_mount(platform, scenario: Scenario) -> np.ndarray:
    """True rotation of the camera (3, 3): that of the rig file without perturbations."""
    one = {c: getattr(scenario.cameras, c).model_copy(update={"miscalibration": None}) for c in ("vehicle", "drone")}
    rig = yaml.safe_load(scenario.changed(cameras=CamerasSettings(**one)).rig_yaml())
    return Pose(**rig["cameras"][platform][f"T_{platform}_camera"]).matrix()[:3, :3]


def test_a_seed_determines_the_scenario() -> None:
    cell = Cell("park_edge", 30, "cross", "driving")
    assert scenario_of(cell, 1) == scenario_of(cell, 1)
    assert scenario_of(cell, 1).drone != scenario_of(cell, 2).drone


def test_a_scenario_is_unchanged_by_its_yaml() -> None:
    scenario = scenario_of(Cell("atlanta", 10, "orbit", "turning"), 4)
    assert Scenario.model_validate(yaml.safe_load(scenario.as_yaml())).as_yaml() == scenario.as_yaml()


def test_the_command_lists_cells_and_rejects_a_pattern_without_a_match(tmp_path: FilePath) -> None:
    listed = CliRunner().invoke(app, ["matrix", str(tmp_path), "--only", "*-10m-climb-parked", "--list"])
    assert listed.exit_code == 0
    assert listed.stdout.split() == [f"{scene}-10m-climb-parked" for scene in SCENES]
    wrong = CliRunner().invoke(app, ["matrix", str(tmp_path), "--only", "moon-*"])
    assert wrong.exit_code == 2
    assert "no cell matches 'moon-*'" in wrong.output
    several = ["--only", "campus-0m-empty-parked", "--only", "campus-*-two-*", "--list"]
    listed = CliRunner().invoke(app, ["matrix", str(tmp_path), *several])
    assert listed.stdout.split() == ["campus-0m-empty-parked", "campus-20m-two-parked"]


def test_the_commands_conditions_reach_the_recording(tmp_path: FilePath, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flights, "USUAL_DURATION_S", 0.2)
    conditions = ["--only", "open_lot-20m-two-parked", "--calibrated", "--odometry", "--rain"]
    made = CliRunner().invoke(app, ["matrix", str(tmp_path), *conditions])
    assert made.exit_code == 0, made.output
    with RecordingReader(tmp_path / "open_lot-20m-two-parked-s1.mcap") as reader:
        scenario, rig = yaml.safe_load(reader.config_yaml), yaml.safe_load(reader.rig_yaml)
        topics = set(reader.topics)
    assert [term["order"] for term in rig["lidar"]["mount"]["servo_harmonics"]] == [1, 2]
    assert scenario["weather"]["rain_mmph"] == 5.0
    assert {"/vehicle/odometry", "/truth/drone_2", "/truth/hits_2", "/truth/visible", "/truth/visible_2"} <= topics
