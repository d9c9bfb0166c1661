"""Blocked paths are rejected: through walls, inside buildings, below the road."""

from __future__ import annotations

from pathlib import Path as FilePath

import numpy as np
import pytest
import yaml

from flow.config_error import ConfigError
from flow.link import LinkError
from links.simulated.rig.run import Simulation
from links.simulated.rig.scenario import load_scenario
from links.simulated.world.clearance import check_path, clearance_m, fits, sample_times_s, under_open_sky, visible
from links.simulated.world.mesh import RayScene, box, merge

STREET = FilePath(__file__).parents[4] / "configs/scenarios/street_sweep.yaml"


@pytest.fixture(scope="module")
def building() -> RayScene:
    """Ground at z = 0 and a closed building, 10 x 10 x 8 m, its corner at (5, -5)."""
    ground = box((-50, -50, -0.1), (50, 50, 0.0), "asphalt")
    return RayScene(merge([ground, box((5.0, -5.0, 0.0), (15.0, 5.0, 8.0), "brick")]))


def test_clearance_is_the_distance_to_the_nearest_surface(building: RayScene) -> None:
    points = np.array([(4.0, 0.0, 4.0), (0.0, 0.0, 1.5), (0.0, 0.0, 9.0), (10.0, 0.0, 8.4)])
    assert clearance_m(building, points, 2.0) == pytest.approx([1.0, 1.5, np.inf, 0.4], abs=1e-4)


def test_the_sky_is_open_outside_a_building_only(building: RayScene) -> None:
    points = np.array([(10.0, 0.0, 4.0), (4.5, 0.0, 4.0), (4.9, 0.0, 0.3), (10.0, 0.0, 9.0)])
    assert under_open_sky(building, points).tolist() == [False, True, True, True]


def test_a_building_blocks_the_line_of_sight(building: RayScene) -> None:
    here = np.array([(0.0, 0.0, 2.0)] * 3)
    there = np.array([(20.0, 0.0, 3.0), (4.0, 0.0, 3.0), (20.0, 0.0, 40.0)])
    assert visible(building, here, there).tolist() == [False, True, True]


def test_a_path_needs_clearance_and_open_sky(building: RayScene) -> None:
    x = np.linspace(0, 20, 81)
    above, through = (np.column_stack([x, 0 * x, 0 * x + z]) for z in (10.0, 4.0))
    assert fits(building, above, 1.0)
    assert not fits(building, above, 2.5)
    assert not fits(building, through, 0.2)


def test_the_error_has_the_path_the_time_and_the_position(building: RayScene) -> None:
    times = sample_times_s(2.0)
    x = 10 * times
    for z, text in (
        (4.0, r"drone\.path: inside a building or under a roof at 0\.50 s, \(5\.0, 0\.0, 4\.0\) m"),
        (8.1, r"drone\.path: 0\.10 m from an obstacle, less than 0\.25 m at 0\.50 s, .* move its waypoints"),
    ):
        inside = np.column_stack([x, 0 * x, 0 * x + z])
        with pytest.raises(LinkError, match=text):
            check_path(building, times, inside, 0.25, "drone.path")


def test_a_scenario_through_a_building_is_rejected_before_anything_is_made() -> None:
    street = load_scenario(STREET)
    with pytest.raises(LinkError, match=r"drone\.path: .*another seed \(it draws the scene\)"):
        Simulation(street.changed(drone={"path": {"waypoints": [{"t_s": 0, "xyz_m": [0.0, 14.0, 3.0]}]}}))
    with pytest.raises(LinkError, match=r"vehicle\.path: "):
        Simulation(street.changed(vehicle={"path": {"waypoints": [{"t_s": 0, "xyz_m": [0.0, 14.0, 0.0]}]}}))


def test_a_vehicle_off_the_road_is_a_scenario_error(tmp_path: FilePath) -> None:
    path = tmp_path / "sunk.yaml"
    vehicle = {"path": {"waypoints": [{"t_s": 0, "xyz_m": [0, 0, 0]}, {"t_s": 2, "xyz_m": [4, 0, -1]}]}}
    path.write_text(yaml.safe_dump(yaml.safe_load(STREET.read_text("utf-8")) | {"vehicle": vehicle}), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"vehicle\.path: -1\.00 m off the road at 2\.00 s; .* keep it 0"):
        load_scenario(path)
