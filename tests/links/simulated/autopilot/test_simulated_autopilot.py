"""The autopilot's frames against the ground truth they were made from, read like real ones."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path as FilePath
from typing import Any, TypeVar

import numpy as np
import pytest
from pydantic import ValidationError
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import Record
from links.mavlink import Autopilot as Receiver
from links.simulated.autopilot.autopilot import Autopilot, AutopilotSettings
from links.simulated.kernels.motion import GRAVITY_MPS2
from links.simulated.rig.run import Simulation
from links.simulated.rig.scenario import Scenario, load_scenario
from links.simulated.sensors.drift import DriftSettings
from links.simulated.world.flight import Flight
from links.simulated.world.path import Path, Waypoint
from stages.geometry.frames import rotation_z
from stages.messages import AutopilotStatus, DroneAttitude, DroneImu, DroneLocalPosition, DroneOdometry
from tests.links.simulated.sensors.test_simulated_drift import NO_DRIFT

M = TypeVar("M")
S, MS = 1_000_000_000, 1_000_000
START = 1_748_773_230 * S
SECONDS = 20.0
ORBIT = Path(
    waypoints=tuple(
        Waypoint(t_s=t, xyz_m=(10 * np.cos(0.4 * t), 10 * np.sin(0.4 * t), 15), yaw_deg=np.degrees(0.4 * t) + 90)
        for t in np.arange(0.0, 23.0)
    )
)
STREET = FilePath(__file__).parents[4] / "configs/scenarios/street_sweep.yaml"


class Flown:
    """Records of one flight, and the messages decoded from them."""

    def __init__(self, settings: AutopilotSettings, seed: int = 1, seconds: float = SECONDS) -> None:
        self.flight = Flight(ORBIT, settings.flight, seconds, seed)
        self.autopilot = Autopilot(settings, self.flight, START, seconds, seed)
        self.records = self.autopilot.records(START + round(1.1 * seconds * S))
        self.receiver = Receiver()
        self.received = [
            (r, m)
            for r in sorted(self.records, key=lambda r: r.arrival_ns)
            if r.topic == "/autopilot/rx" and (m := self.receiver.decode(r)) is not None
        ]

    def messages(self, kind: type[M], after_s: float = 0.0) -> list[M]:
        return [m for _, m in self.received if isinstance(m, kind) and m.stamp_ns > START + after_s * S]

    def seconds(self, messages: list[Any]) -> np.ndarray:
        return np.array([(m.stamp_ns - START) / S for m in messages])


@pytest.fixture(scope="module")
def exact() -> Flown:
    """No drift and no noise: frames and clocks only."""
    quiet = {"rate_noise_degps": 0, "gyro_noise_degps": 0, "gyro_bias_degps": 0}
    still = {"accelerometer_noise_mps2": 0, "accelerometer_bias_mps2": 0}
    return Flown(AutopilotSettings.model_validate({"drift": NO_DRIFT, **quiet, **still}))


@pytest.fixture(scope="module")
def drifting() -> Flown:
    return Flown(AutopilotSettings())


def test_rates_kinds_and_sender_are_as_configured(drifting: Flown) -> None:
    mav = ardupilotmega.MAVLink(None)
    frames = [mav.decode(bytearray(r.data)) for r in drifting.records if r.topic == "/autopilot/rx"]
    counts = Counter(f.get_type() for f in frames)
    expected = {
        "HEARTBEAT": 1,
        "ATTITUDE": 50,
        "LOCAL_POSITION_NED": 30,
        "ODOMETRY": 30,
        "RAW_IMU": 100,
        "TIMESYNC": 1.1,
    }
    assert set(counts) == set(expected)
    for kind, rate in expected.items():
        assert counts[kind] == pytest.approx(rate * SECONDS, abs=2)
    assert {(f.get_srcSystem(), f.get_srcComponent()) for f in frames} == {(1, 1)}
    assert {r.data[0] for r in drifting.records} == {0xFD}
    assert [f.get_seq() for f in frames] == [i % 256 for i in range(len(frames))]


def test_records_are_stamped_with_their_arrival(drifting: Flown) -> None:
    received = [r for r in drifting.records if r.topic == "/autopilot/rx"]
    assert all(r.stamp_ns == r.arrival_ns for r in received)
    arrivals = [r.arrival_ns for r in received]
    assert arrivals == sorted(arrivals)


def test_without_errors_the_local_frame_is_the_world_rotated_by_the_heading(exact: Flown) -> None:
    """World x has a heading of 57 deg: clockwise from north, so its yaw is -57 deg in a frame with z up."""
    R_local_world = rotation_z(np.radians(-57.0))
    odometry = exact.messages(DroneOdometry, after_s=2.0)
    time_s = exact.seconds(odometry)
    R, p = exact.flight.flying_poses(time_s)
    v = exact.flight.at(time_s)[1]
    p0 = exact.flight.flying_poses(np.zeros(1))[1][0]
    rate = exact.flight.imu(time_s)[0]
    for i, m in enumerate(odometry):
        np.testing.assert_allclose(m.xyz_odom_m, R_local_world @ (p[i] - p0), atol=0.02)  # 4 m/s, few ms
        np.testing.assert_allclose(m.R_odom_drone, R_local_world @ R[i], atol=0.01)
        np.testing.assert_allclose(m.R_odom_drone @ m.velocity_drone_mps, R_local_world @ v[i], atol=0.03)
        np.testing.assert_allclose(m.angular_velocity_drone_radps, rate[i], atol=0.05)


def test_attitude_position_and_odometry_agree(exact: Flown) -> None:
    odometry = exact.messages(DroneOdometry, after_s=2.0)
    time_s = exact.seconds(odometry)
    position, attitude = exact.messages(DroneLocalPosition), exact.messages(DroneAttitude)
    xyz = np.array([m.xyz_odom_m for m in position])
    for axis in range(3):
        there = np.interp(time_s, exact.seconds(position), xyz[:, axis])
        np.testing.assert_allclose([m.xyz_odom_m[axis] for m in odometry], there, atol=0.02)
    columns = np.array([m.R_odom_drone[:, 2] for m in attitude])
    there = np.interp(time_s, exact.seconds(attitude), columns[:, 0])
    np.testing.assert_allclose([m.R_odom_drone[0, 2] for m in odometry], there, atol=0.01)


def test_the_imu_measures_thrust_and_turn_rate_truncated_to_mg_and_mrad(exact: Flown) -> None:
    imu = exact.messages(DroneImu, after_s=2.0)
    rate, force = exact.flight.imu(exact.seconds(imu))
    force_measured = np.array([m.acceleration_drone_mps2 for m in imu])
    turn_rate = np.array([m.angular_velocity_drone_radps for m in imu])
    assert np.sqrt(np.mean((force_measured - force) ** 2, axis=0)).max() < 0.05
    assert np.sqrt(np.mean((turn_rate - rate) ** 2, axis=0)).max() < 0.02
    assert force_measured[:, 2].mean() == pytest.approx(
        np.hypot(GRAVITY_MPS2, 0.16 * 10), rel=0.02
    )  # g and w^2 r of the orbit
    counts = turn_rate * 1e3 - 0.5 * np.sign(turn_rate)  # half a count is added
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)


def test_imu_noise_and_bias_are_as_configured() -> None:
    noisy = Flown(AutopilotSettings(gyro_noise_degps=2.0, gyro_bias_degps=1.0, accelerometer_noise_mps2=0.5))
    imu = noisy.messages(DroneImu, after_s=2.0)
    rate, force = noisy.flight.imu(noisy.seconds(imu))
    turn_rate = np.degrees(np.array([m.angular_velocity_drone_radps for m in imu]) - rate)
    force_measured = np.array([m.acceleration_drone_mps2 for m in imu]) - force
    np.testing.assert_allclose(turn_rate.std(axis=0), 2.0, rtol=0.1)
    np.testing.assert_allclose(force_measured.std(axis=0), 0.5, rtol=0.1)
    assert 0.02 < np.abs(turn_rate.mean(axis=0)).max() < 4.0


def test_the_drift_agrees_with_the_covariance(drifting: Flown) -> None:
    """Over seeds, at the end of the flight: the mean of error^T P^-1 error is its dimension."""
    nees = []
    for seed in range(16):
        settings = AutopilotSettings(
            drift=DriftSettings(scale=0, yaw_rate_deg_per_min=0), imu_hz=0, attitude_hz=0, position_hz=0
        )
        flown = drifting if seed == 0 else Flown(settings, seed)
        m = flown.messages(DroneOdometry)[-1]
        p = flown.flight.flying_poses(flown.seconds([m]))[1]
        p0 = flown.flight.flying_poses(np.zeros(1))[1][0]
        error_drone = m.R_odom_drone.T @ (m.xyz_odom_m - rotation_z(np.radians(-57.0)) @ (p[0] - p0))
        assert m.pose_covariance is not None
        nees.append(error_drone @ np.linalg.solve(m.pose_covariance[3:, 3:], error_drone))
    assert 1.5 < np.mean(nees) < 5.0


def test_the_attitude_has_the_configured_tilt_error() -> None:
    squares = []
    for seed in range(25):
        tilted = Flown(
            AutopilotSettings(drift=NO_DRIFT.model_copy(update={"tilt_deg": 1.0}), imu_hz=0, odometry_hz=0), seed, 4.0
        )
        m = tilted.messages(DroneAttitude)[-1]
        up = tilted.flight.flying_poses(tilted.seconds([m]))[0][0] @ (m.R_odom_drone.T @ [0.0, 0.0, 1.0])
        squares.append(np.degrees(np.arccos(up[2])) ** 2)
    assert np.sqrt(np.mean(squares)) == pytest.approx(np.sqrt(2.0), rel=0.35)  # roll and pitch, 1 deg each


@pytest.mark.parametrize("ppm", [-60.0, 0.0, 60.0])
def test_the_clock_offset_is_recovered_within_the_latency(ppm: float) -> None:
    flown = Flown(AutopilotSettings(clock_ppm=ppm, imu_hz=0))
    for m in flown.messages(AutopilotStatus, after_s=4.0):
        true_ns = m.stamp_ns - flown.autopilot.device_ns(m.stamp_ns)
        assert m.clock_offset_ns is not None
        assert m.clock_uncertainty_ns is not None
        assert (
            abs(m.clock_offset_ns - true_ns) <= m.clock_uncertainty_ns + 2_000
        )  # 2 us: clock drift during the transmission
        assert m.clock_uncertainty_ns < 12 * MS  # half of two times 6 ms and the least jitter


def test_without_timesync_stamps_are_late_by_the_minimum_latency() -> None:
    flown = Flown(AutopilotSettings(timesync_hz=0, imu_hz=0))
    m = flown.messages(AutopilotStatus)[-1]
    assert m.clock_uncertainty_ns is None
    assert m.clock_offset_ns is not None
    late_ns = m.clock_offset_ns - (m.stamp_ns - flown.autopilot.device_ns(m.stamp_ns))
    assert 6 * MS < late_ns < 9 * MS


def test_stamps_increase_within_a_kind_and_are_before_the_arrival(drifting: Flown) -> None:
    for kind in (DroneAttitude, DroneLocalPosition, DroneOdometry, DroneImu):
        stamps = [m.stamp_ns for m in drifting.messages(kind)]
        assert (np.diff(stamps) > 0).all()
    assert all(m.stamp_ns <= r.arrival_ns for r, m in drifting.received)


def test_losses_and_outages_show_as_gaps_in_the_sequence() -> None:
    radio: Any = {"loss_fraction": 0.05, "loss_burst_frames": 2.0, "outages_s": ((5.0, 5.3),)}
    lossy = Flown(AutopilotSettings(downlink=radio))
    sent = len([r for r in Flown(AutopilotSettings()).records if r.topic == "/autopilot/rx"])
    received = len([r for r in lossy.records if r.topic == "/autopilot/rx"])
    lost = lossy.messages(AutopilotStatus)[-1].lost_frames
    assert lost == pytest.approx(sent - received, abs=220)  # frames after the last received heartbeat are not counted
    assert lossy.receiver.counters["lost"] == pytest.approx(sent - received, abs=20)
    assert (sent - received) / sent == pytest.approx(0.05 + 0.3 / 20, abs=0.03)


def test_the_same_seed_gives_the_same_bytes_in_any_batches() -> None:
    def run(step_ns: int, seed: int = 1) -> list[Record]:
        settings = AutopilotSettings.model_validate({"downlink": {"loss_fraction": 0.02}})
        part, records = Autopilot(settings, Flight(ORBIT, settings.flight, 3.0, seed), START, 3.0, seed), []
        for until in range(START, START + 4 * S, step_ns):
            records += part.records(until)
        return sorted(records, key=lambda r: (r.arrival_ns, r.topic))

    whole = run(3_900_000_000)
    assert len(whole) > 500
    assert run(42_467_328) == whole
    assert run(3_900_000_000, seed=2) != whole


def test_a_scenario_with_autopilot_records_its_flight_and_not_the_path() -> None:
    scenario = load_scenario(STREET).changed(duration_s=0.4)
    plain = {r.topic for r in Simulation(scenario).records()}
    records = list(Simulation(scenario.changed(autopilot={}, vehicle_odometry={})).records())
    assert {r.topic for r in records} - plain == {"/autopilot/rx", "/autopilot/tx", "/vehicle/odometry"}
    arrivals = [r.arrival_ns for r in records]
    assert arrivals == sorted(arrivals)
    flown = [r.data for r in records if r.topic == "/truth/drone"]
    assert flown != [r.data for r in Simulation(scenario).records() if r.topic == "/truth/drone"]


def test_a_suspended_vehicle_tilts_in_the_ground_truth() -> None:
    drive = {"waypoints": [{"t_s": 0, "xyz_m": (0, 0, 0)}, {"t_s": 1, "xyz_m": (8, 0, 0)}]}
    scenario = load_scenario(STREET).changed(duration_s=0.2, vehicle={"path": drive, "suspension": {}})
    poses = [json.loads(r.data) for r in Simulation(scenario).records() if r.topic == "/truth/vehicle"]
    assert np.abs([pose["quaternion_xyzw"][:2] for pose in poses]).max() > 1e-4


def test_impossible_settings_are_rejected() -> None:
    with pytest.raises(ValidationError, match="attitude_hz"):
        AutopilotSettings(attitude_hz=1000)
    without_drone = dict(load_scenario(STREET)) | {"drone": None, "script": (), "autopilot": {}}
    with pytest.raises(ValidationError, match="the scenario has no drone for it"):
        Scenario.model_validate(without_drone)
