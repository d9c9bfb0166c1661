"""The figures of the comparison with real captures, and that the simulation is near them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from links.simulated.matrix.sim_vs_real import (
    comparison_table,
    drone_area_m2,
    drone_table,
    measure,
    real_drone,
    recorded,
    simulated_indoor_scene,
)
from links.simulated.world.mesh import box

ROOT = Path(__file__).parents[4]
DRONES = ROOT.parent / "shared/data/drone_lidar"


@pytest.fixture(scope="module")
def indoor():
    return measure(simulated_indoor_scene(4.0))


@pytest.fixture(scope="module")
def einride():
    return measure(recorded(ROOT / "recordings/einride_vlp16.mcap"))


def test_the_figures_agree_with_the_settings_of_the_simulation(indoor) -> None:
    assert indoor.noise_m == pytest.approx(0.008, abs=0.0005)
    assert indoor.isolated_dropouts == pytest.approx(0.005, abs=0.001)
    assert indoor.spacing_mrad == pytest.approx(1e3 * 2 * np.pi * 10 * 55.296e-6, rel=0.02)  # 10 revolutions per second
    assert indoor.pulses_per_turn == pytest.approx(1e8 / 55.296 / 1000 * 16, rel=2e-3)
    assert 0.003 < indoor.laser_bias_m < 0.02  # 1 cm over 16 draws, minus the fit of the planes


def test_the_simulated_sensor_measures_like_the_real_one(indoor, einride) -> None:
    assert indoor.pulses_per_turn == pytest.approx(einride.pulses_per_turn, rel=2e-3)
    assert indoor.noise_m == pytest.approx(einride.noise_m, abs=0.002)
    assert indoor.spacing_mrad == pytest.approx(einride.spacing_mrad, rel=0.05)
    assert indoor.isolated_dropouts == pytest.approx(einride.isolated_dropouts, abs=0.006)


def test_the_effective_area_of_a_large_near_plate_is_its_own() -> None:
    plate = box((-0.5, -0.5, -0.01), (0.5, 0.5, 0.01), "plaster")
    assert drone_area_m2(plate, np.array([0.0, 0.0, -10.0])) == pytest.approx(1.0, rel=0.08)


def test_real_drone_hits_are_between_the_smallest_and_largest_simulated_drone() -> None:
    if not DRONES.exists():
        pytest.skip("the real drone clouds are missing (../shared/data/drone_lidar)")
    real = real_drone(DRONES)
    assert real.frames == 48
    rows = [line.split("|")[2] for line in drone_table(real).splitlines()[3:]]
    smallest, largest = (float(row.split(",")[1]) for row in (rows[0], rows[-1]))
    assert 0.5 * smallest < 1e4 * real.area_m2[1] < largest


def test_the_table_has_every_capture_and_states_when_the_drone_clouds_are_missing(tmp_path: Path) -> None:
    table = comparison_table(ROOT / "recordings", tmp_path)
    assert "| einride (real) | mrpt (real) | room (simulated) |" in table
    assert "are missing" in table
