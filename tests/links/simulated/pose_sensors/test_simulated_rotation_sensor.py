"""The simulated sensor of the rotation: sizes of its errors, its branches, its wrong matches, and the link that reads it."""

from __future__ import annotations

import numpy as np
import pytest

from links.simulated import SimulatedRotations
from links.simulated.pose_sensors.rotation_sensor import RotationSensor, RotationSensorSettings
from links.simulated.world.path import Path, Waypoint
from links.simulated.world.scene import Truth
from stages.geometry.frames import rotation_z
from stages.messages import BranchState, RelativeRotation

START_NS = 1_748_773_230_000_000_000
VEHICLE = Path(waypoints=(Waypoint(t_s=0, xyz_m=(0, 0, 0), yaw_deg=30),))
DRONE = Path(waypoints=(Waypoint(t_s=0, xyz_m=(5, 0, 10), yaw_deg=75), Waypoint(t_s=400, xyz_m=(5, 0, 10), yaw_deg=95)))
TRUTH = Truth(START_NS, VEHICLE, DRONE)


def measured(seed: int = 1, duration_s: float = 400.0, **settings: float) -> list[RelativeRotation]:
    sensor = RotationSensor(RotationSensorSettings.model_validate(settings), TRUTH, seed)
    records = sensor.records(START_NS + round(duration_s * 1e9))
    assert sensor.records(START_NS + round(duration_s * 1e9)) == []
    link = SimulatedRotations()
    return [link.decode(record) for record in records]


def errors_deg(found: list[RelativeRotation]) -> np.ndarray:
    """Angle (n, 4) between each rotation and the four branches of the true one."""
    rows = []
    for rotation in found:
        at = np.array([rotation.stamp_ns])
        true = TRUTH.T_world_vehicle(at)[0][0].T @ TRUTH.T_world_drone(at)[0][0]
        off = [true.T @ rotation_z(-k * np.pi / 2) @ rotation.R_vehicle_drone for k in range(4)]
        rows.append([np.degrees(np.arccos(min(1.0, (np.trace(R) - 1) / 2))) for R in off])
    return np.array(rows)


def test_without_wrong_matches_one_branch_is_right_within_the_stated_sigma() -> None:
    found = measured(wrong_per_s=0.0)
    branch = errors_deg(found).argmin(axis=1)
    assert len(set(branch.tolist())) == 1
    sigma_deg = np.degrees(np.sqrt(found[0].covariance_rad2[0, 0]))
    assert sigma_deg == pytest.approx(np.hypot(0.3, 0.2), abs=1e-6)
    off = [errors_deg(measured(seed, 40.0, wrong_per_s=0.0)).min(axis=1) for seed in range(20)]
    assert np.sqrt(np.mean(np.concatenate(off) ** 2) / 3) == pytest.approx(sigma_deg, rel=0.3)
    assert len({int(errors_deg(measured(s, 2.0, wrong_per_s=0.0))[0].argmin()) for s in range(20)}) == 4


def test_rate_and_detection_are_as_set() -> None:
    found = measured(detection=1.0, rate_hz=4.0, duration_s=10.0)
    assert np.diff([r.stamp_ns for r in found]) == pytest.approx(250_000_000)
    assert len(measured(detection=0.5)) == pytest.approx(1000, rel=0.1)
    assert all(r.state is BranchState.OPEN and r.branch_probability == pytest.approx(0.25) for r in found)


def test_a_wrong_match_lasts_for_the_correlation_time_and_changes_the_branch() -> None:
    found = measured(wrong_per_s=0.05, detection=1.0)
    errors = errors_deg(found)
    wrong = errors.min(axis=1) > 5.0
    assert wrong.mean() == pytest.approx(0.05, abs=0.03)
    begins = np.flatnonzero(np.diff(wrong.astype(int)) == 1)
    ends = np.flatnonzero(np.diff(wrong.astype(int)) == -1)
    assert len(begins) > 5
    assert (ends[: len(begins)] - begins[: len(ends)]).max() <= 2 * 5  # two in a row at most, at 5 Hz for 1 s
    assert len(set(errors[~wrong].argmin(axis=1).tolist())) > 1
