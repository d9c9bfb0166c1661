"""Simulated cues: what the receivers report is the truth with the errors that the settings state; wrong cues; same bytes."""

from __future__ import annotations

import json
from pathlib import Path as FilePath

import numpy as np
import pytest

from flow.config_error import ConfigError
from links.cues import Cues
from links.mavlink import Autopilot
from links.simulated.cues.cue_errors import ORIGIN, RangingSettings, ReceiverSettings, receiver_error
from links.simulated.rig.run import Simulation
from links.simulated.rig.scenario import load_scenario
from stages.cues.geodesy import Geographic, displacement_enu_m
from stages.geometry.frames import rotation_z
from stages.messages import DroneGlobalPosition, DroneGnss, UwbRange, VehicleGnss

ROOT = FilePath(__file__).parents[4]
SCENARIO = ROOT / "configs/scenarios/live_street.yaml"
YAW_ENU_WORLD_RAD = float(np.radians(90.0 - 57.0))  # `autopilot.heading_of_world_x_deg`
EXACT = {"bias_m": 0.0, "bias_up_m": 0.0, "noise_m": 0.0, "noise_up_m": 0.0}
PERFECT_RANGING = {"noise_m": 0.0, "bias_m": 0.0, "reflected_share": 0.0}


def messages_of(cues: dict, seconds: float = 3.0):
    """(simulation, messages) of a flight, as grd's links decode them."""
    scenario = load_scenario(SCENARIO).changed(cues=cues, duration_s=seconds, vehicle_odometry=None)
    simulation = Simulation(scenario)
    autopilot, link, found = Autopilot(), Cues(), []
    for source in simulation.telemetry_sources:
        for record in source.records(scenario.start_ns + round(1e9 * seconds)):
            if record.topic == "/cues":
                found += link.decode(record)
            elif (message := autopilot.decode(record)) is not None:
                found.append(message)
    assert not link.counters.rejected
    return simulation, found


def world_m(message) -> np.ndarray:
    """Position in the world frame."""
    here = Geographic(message.latitude_rad, message.longitude_rad, message.altitude_m)
    return rotation_z(-YAW_ENU_WORLD_RAD) @ displacement_enu_m(ORIGIN, here)


def true_m(simulation: Simulation, stamp_ns: int, latency_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions of drone and vehicle."""
    at = np.array([max(stamp_ns - round(1e9 * latency_s), simulation.scenario.start_ns)])
    return simulation.truth.T_world_drone(at)[1][0], simulation.truth.T_world_vehicle(at)[1][0]


def test_without_errors_everything_is_the_truth_at_the_time_of_measurement():
    cues = {"drone": EXACT, "vehicle": {**EXACT, "heading_sigma_deg": 0.0}, "ranging": PERFECT_RANGING}
    simulation, found = messages_of(cues)
    by_type = {kind: [m for m in found if isinstance(m, kind)] for kind in (DroneGnss, VehicleGnss, UwbRange)}
    assert [len(by_type[kind]) for kind in by_type] == [pytest.approx(15, abs=1), 15, 30]
    for gnss in by_type[DroneGnss][2:]:
        assert world_m(gnss) == pytest.approx(true_m(simulation, gnss.stamp_ns, 0.2)[0], abs=0.06)
    for gnss in by_type[VehicleGnss]:
        assert world_m(gnss) == pytest.approx(true_m(simulation, gnss.stamp_ns, 0.2)[1], abs=0.02)
    for uwb in by_type[UwbRange][2:]:
        drone_m, vehicle_m = true_m(simulation, uwb.stamp_ns, 0.02)
        assert uwb.range_m == pytest.approx(float(np.linalg.norm(drone_m - vehicle_m)), abs=0.02)


def test_the_heading_is_that_of_the_vehicle_from_east():
    simulation, found = messages_of({"vehicle": {"heading_sigma_deg": 0.0}}, 1.0)
    R = simulation.truth.T_world_vehicle(np.array([simulation.scenario.start_ns]))[0][0]
    first = next(m for m in found if isinstance(m, VehicleGnss))
    expected = np.arctan2(R[1, 0], R[0, 0]) + YAW_ENU_WORLD_RAD
    assert np.cos(first.yaw_enu_rad - expected) == pytest.approx(1.0, abs=1e-6)


def test_the_autopilots_estimate_is_the_position_and_the_height_above_the_road_now():
    cues = {"drone": EXACT, "barometer": {"drift_m": 0.0, "noise_m": 0.0}}
    simulation, found = messages_of(cues)
    positions = [m for m in found if isinstance(m, DroneGlobalPosition)]
    assert len(positions) > 10
    up_m = simulation.scenario.vehicle.camera_height_m
    for position in positions[2:]:
        drone_m, _ = true_m(simulation, position.stamp_ns, 0.0)
        assert world_m(position) == pytest.approx(drone_m, abs=0.06)
        assert position.altitude_above_home_m == pytest.approx(drone_m[2] + up_m, abs=0.05)


def test_a_receivers_error_has_the_sigma_of_its_settings_and_changes_slowly():
    settings, times = ReceiverSettings(noise_m=0.0, noise_up_m=0.0), np.array([0.0, 1.0])
    errors = np.array([receiver_error(settings, 2.0, np.random.default_rng(k)).at(times) for k in range(2000)])
    sigma = errors[:, 0].std(axis=0)
    assert sigma == pytest.approx([settings.bias_m, settings.bias_m, settings.bias_up_m], rel=0.06)
    change = (errors[:, 1] - errors[:, 0]).std(axis=0)
    assert change == pytest.approx(sigma * np.sqrt(2.0 / settings.bias_time_s), rel=0.1)  # 2 (1 - exp(-t / T))


def test_reflections_only_lengthen_a_range():
    cues = {"ranging": {**PERFECT_RANGING, "reflected_share": 0.3}}
    simulation, found = messages_of(cues, 6.0)
    extra_m = []
    for uwb in (m for m in found if isinstance(m, UwbRange)):
        drone_m, vehicle_m = true_m(simulation, uwb.stamp_ns, 0.02)
        extra_m.append(uwb.range_m - float(np.linalg.norm(drone_m - vehicle_m)))
    assert min(extra_m) > -0.03
    assert 0.1 < np.mean(np.array(extra_m) > 0.1) < 0.5


def test_a_wrong_cue_is_off_by_its_offset():
    true, wrong = (
        next(m for m in messages_of({"drone": {**EXACT, "offset_world_m": off}}, 1.0)[1] if isinstance(m, DroneGnss))
        for off in ((0.0, 0.0, 0.0), (30.0, 0.0, 0.0))
    )
    assert world_m(wrong) - world_m(true) == pytest.approx([30.0, 0.0, 0.0], abs=0.03)


def test_the_same_seed_gives_the_same_bytes_and_cues_do_not_change_the_drones_flight():
    def datagrams() -> list[bytes]:
        scenario = load_scenario(SCENARIO).changed(cues={"vehicle": {}, "ranging": {}}, duration_s=2.0)
        simulation = Simulation(scenario)
        end_ns = scenario.start_ns + 2_000_000_000
        return [r.data for source in simulation.telemetry_sources for r in source.records(end_ns)]

    first = datagrams()
    assert first == datagrams()
    assert any("uwb_range" in json.loads(data) for data in first if data[:1] == b"{")


@pytest.mark.parametrize(
    ("sets", "reason"),
    [
        (("cues.drone.of_drone=2",), "of_drone is 2, the scenario has 1"),
        (("cues.barometer.drift_m=1",), "add that"),
        (("autopilot=null", "cues.drone.bias_m=1"), "through its autopilot"),
    ],
)
def test_cues_that_are_impossible_are_refused(sets, reason):
    with pytest.raises(ConfigError, match=reason):
        load_scenario(SCENARIO, sets)


def test_a_ranging_of_a_drone_that_is_not_there_is_refused():
    assert RangingSettings().of_drone == 1
    with pytest.raises(ConfigError, match="of_drone is 3"):
        load_scenario(SCENARIO, ("cues.ranging.of_drone=3",))
