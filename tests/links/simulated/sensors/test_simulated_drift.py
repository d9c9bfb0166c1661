"""Drift as configured: each error alone, by hand; sizes over many seeds; the vehicle's odometry."""

from __future__ import annotations

import json

import numpy as np
import pytest

from links.simulated.kernels.motion import rotations_z
from links.simulated.sensors.drift import STEP_S, DriftingEstimate, DriftSettings
from links.simulated.sensors.vehicle_odometry import VehicleOdometry, VehicleOdometrySettings
from links.simulated.world.motion import gauss_markov, interpolate, random_walk, rotations_from_vectors
from links.simulated.world.path import Path, Waypoint
from links.simulated.world.suspension import SuspendedPath, SuspensionSettings
from stages.geometry.frames import (
    quaternions_xyzw,
    rotation_from_quaternion_xyzw,
    rotation_from_rpy_deg,
    rotations_from_xyzw,
)

NO_DRIFT = DriftSettings(
    scale=0,
    yaw_rate_deg_per_min=0,
    yaw_random_walk_deg_per_sqrt_s=0,
    position_random_walk_m_per_sqrt_s=0,
    velocity_mps=0,
    height_m=0,
    tilt_deg=0,
)
TIMES = np.arange(0.0, 60.0 + STEP_S / 2, STEP_S)
STRAIGHT = np.column_stack([2.0 + 3.0 * TIMES, np.full_like(TIMES, 1.0), 5.0 + 0.1 * TIMES])
START_NS = 1_748_773_230_000_000_000


def _estimate(position: np.ndarray = STRAIGHT, yaw: float = 0.0, seed: int = 1, **errors: float) -> DriftingEstimate:
    return DriftingEstimate(position, yaw, NO_DRIFT.model_copy(update=errors), np.random.default_rng(seed))


def test_without_errors_it_is_the_truth_in_the_local_frame() -> None:
    estimate = _estimate(yaw=np.radians(90.0))
    np.testing.assert_allclose(estimate.position_m(np.array([0.0, 10.0])), [[0, 0, 0], [0, 30, 1]], atol=1e-9)
    np.testing.assert_allclose(
        estimate.velocity_mps(np.array([10.0]), np.array([[3.0, 0, 0.1]])), [[0, 3, 0.1]], atol=1e-9
    )
    R = rotation_from_rpy_deg((5.0, 10.0, 20.0))[None]
    np.testing.assert_allclose(
        estimate.rotations(np.array([1.0]), R)[0], rotation_from_rpy_deg((5.0, 10.0, 110.0)), atol=1e-9
    )


def test_scale_lengthens_and_a_yaw_rate_bends_the_path() -> None:
    end = np.array([60.0])
    np.testing.assert_allclose(_estimate(scale=0.02).position_m(end), [[180 * 1.02, 0, 6]], atol=1e-6)
    bent = _estimate(yaw_rate_deg_per_min=6.0)
    turn = np.radians(6.0)
    arc = 180 / turn * np.array([np.sin(turn), 1 - np.cos(turn)])
    np.testing.assert_allclose(bent.position_m(end)[0, :2], arc, atol=0.01)
    np.testing.assert_allclose(bent.rotations(end, np.eye(3)[None])[0], rotations_z(np.array([turn]))[0], atol=1e-6)


@pytest.mark.parametrize(
    ("errors", "block", "row"),
    [
        ({"position_random_walk_m_per_sqrt_s": 0.05}, 3, 0),
        ({"velocity_mps": 0.1, "velocity_time_s": 10.0}, 3, 1),
        ({"height_m": 0.3, "height_time_s": 40.0}, 3, 2),
        ({"tilt_deg": 0.5}, 0, 0),
        ({"yaw_random_walk_deg_per_sqrt_s": 0.1}, 0, 2),
    ],
)
def test_errors_have_the_size_of_the_covariance(errors: dict[str, float], block: int, row: int) -> None:
    still, end, squares, variance = np.tile([1.0, 2.0, 3.0], (len(TIMES), 1)), np.array([60.0]), [], 0.0
    for seed in range(300):
        estimate = _estimate(still, seed=seed, **errors)
        R = estimate.rotations(end, np.eye(3)[None])[0]
        rotation = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        error = np.concatenate([rotation, estimate.position_m(end)[0]])
        squares.append(error[block + row] ** 2)
        variance = estimate.covariances(end, np.eye(3)[None])[0, block + row, block + row]
    assert np.mean(squares) / variance == pytest.approx(1.0, abs=0.3)  # 300 draws: 8 % one sigma


def test_the_velocity_is_the_derivative_of_the_position() -> None:
    estimate = _estimate(
        velocity_mps=0.2,
        scale=0.03,
        yaw_rate_deg_per_min=3.0,
        height_m=0.5,
        position_random_walk_m_per_sqrt_s=0.1,
        yaw_random_walk_deg_per_sqrt_s=0.2,
    )
    v = estimate.velocity_mps(TIMES, np.tile([3.0, 0, 0.1], (len(TIMES), 1)))
    slope = np.gradient(estimate.position_m(TIMES), STEP_S, axis=0)
    np.testing.assert_allclose(v[5:-5], slope[5:-5], atol=0.03)


def test_it_never_jumps() -> None:
    p = DriftingEstimate(STRAIGHT, 0.0, DriftSettings(), np.random.default_rng(1)).position_m(TIMES)
    assert np.abs(np.diff(p - STRAIGHT, axis=0)).max() < 0.006  # 0.6 m/s within 10 ms


def test_covariances_rotate_with_the_body() -> None:
    R = rotation_from_rpy_deg((20.0, 30.0, 40.0))[None]
    estimate = _estimate(velocity_mps=0.1, height_m=2.0)
    at = np.array([30.0])
    level, leaning = (estimate.covariances(at, rotation)[0] for rotation in (np.eye(3)[None], R))
    np.testing.assert_allclose(R[0] @ leaning[3:, 3:] @ R[0].T, level[3:, 3:], atol=1e-12)


def test_series_by_hand() -> None:
    np.testing.assert_allclose(
        interpolate(np.array([0.0, 1.0, 4.0]), 0.5, np.array([-1, 0.25, 0.75, 9])), [0, 0.5, 2.5, 4]
    )
    np.testing.assert_allclose(random_walk(np.array([5.0, 1.0, 1.0]), 2.0, 0.25), [0, 1, 2])
    x = gauss_markov(np.random.default_rng(1).standard_normal((200_000, 1)), np.array([3.0]), 0.5, 0.01)[:, 0]
    assert x.std() == pytest.approx(3.0, rel=0.05)
    assert np.corrcoef(x[:-50], x[50:])[0, 1] == pytest.approx(np.exp(-1), abs=0.05)


def test_quaternions_agree_with_stages_geometry() -> None:
    R = np.stack([rotation_from_rpy_deg(rpy) for rpy in [(0.0, 0, 0), (10.0, -20, 30), (180.0, 0, 0), (0.0, 0, 180)]])
    q = quaternions_xyzw(R)
    np.testing.assert_allclose(rotations_from_xyzw(q), R, atol=1e-12)
    for one, rotation in zip(q, R, strict=True):
        np.testing.assert_allclose(rotation_from_quaternion_xyzw(tuple(one)), rotation, atol=1e-12)
    np.testing.assert_allclose(
        rotations_from_vectors(np.radians([[0, 0, 90.0], [0, 0, 0]]))[0],
        rotations_z(np.array([np.pi / 2]))[0],
        atol=1e-12,
    )


DRIVE = Path(waypoints=tuple(Waypoint(t_s=t, xyz_m=(0, 8 * t, 0), yaw_deg=90) for t in (0, 10, 20)))


def test_the_vehicles_odometry_starts_at_zero_and_drifts_with_distance() -> None:
    exact = VehicleOdometry(VehicleOdometrySettings.model_validate({"drift": dict(NO_DRIFT)}), DRIVE, START_NS, 20.0, 1)
    records = exact.records(START_NS + 21_000_000_000)
    assert len(records) == 1000
    first, last = (json.loads(records[i].data) for i in (0, -1))
    np.testing.assert_allclose(first["xyz_m"] + first["quaternion_xyzw"], [0, 0, 0, 0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(last["xyz_m"], [8 * 19.98, 0, 0], atol=1e-3)
    real = VehicleOdometry(VehicleOdometrySettings(), DRIVE, START_NS, 20.0, 1).records(START_NS + 21_000_000_000)
    pose = json.loads(real[-1].data)
    error = np.array(pose["xyz_m"]) - last["xyz_m"]
    covariance = np.array(pose["covariance"]).reshape(6, 6)
    assert error[0] == pytest.approx(0.005 * 160, abs=0.2)  # the scale
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    assert error @ np.linalg.solve(covariance[3:, 3:], error) < 16.0


def test_the_vehicles_odometry_is_late_in_order_and_the_same_in_any_batches() -> None:
    def run(step_ns: int) -> list:
        part, records = VehicleOdometry(VehicleOdometrySettings(jitter_s=0.02), DRIVE, START_NS, 2.0, 3), []
        for until in range(START_NS, START_NS + 2_100_000_000, step_ns):
            batch = part.records(until)
            assert all(r.stamp_ns < until for r in batch)
            records += batch
        return records

    whole = run(2_050_000_000)
    assert run(17_000_000) == whole
    arrivals = [r.arrival_ns for r in whole]
    assert arrivals == sorted(arrivals)
    assert min(r.arrival_ns - r.stamp_ns for r in whole) >= 4_000_000


def test_a_frozen_odometry_repeats_its_pose_with_new_stamps_and_then_has_moved_on() -> None:
    drive = Path(waypoints=(Waypoint(t_s=0, xyz_m=(0, 0, 0)), Waypoint(t_s=10, xyz_m=(50, 0, 0))))
    settings = VehicleOdometrySettings(frozen_s=(4.0, 6.0))
    odometry = VehicleOdometry(settings, drive, START_NS, 10.0, seed=1)
    records = odometry.records(START_NS + 10_000_000_000)
    since_s = np.array([(r.stamp_ns - START_NS) * 1e-9 for r in records])
    assert np.diff(since_s).max() < 0.03
    xyz = np.array([json.loads(r.data)["xyz_m"] for r in records])
    frozen = (since_s >= 4.0) & (since_s < 6.0)
    assert np.ptp(xyz[frozen], axis=0) == pytest.approx(np.zeros(3))
    true_m = odometry.T_map_vehicle(np.array([r.stamp_ns for r in records]))[1]
    np.testing.assert_allclose(xyz[~frozen], true_m[~frozen], atol=1e-5)
    assert np.linalg.norm(xyz[frozen] - true_m[frozen], axis=1).max() > 5.0
    at_m = drive.at(np.array([9.0]))[0][0]
    np.testing.assert_allclose(
        at_m + odometry.drift_m(9.0), odometry.T_map_vehicle(np.array([START_NS + 9 * 10**9]))[1][0]
    )


def test_wheels_report_a_level_vehicle_and_its_true_place() -> None:
    path = SuspendedPath(DRIVE, SuspensionSettings(), 20.0, 1)
    both = [
        VehicleOdometry(VehicleOdometrySettings(measures_tilt=tilt), path, START_NS, 10.0, 1) for tilt in (True, False)
    ]
    poses = [[json.loads(r.data) for r in odometry.records(START_NS + 11_000_000_000)] for odometry in both]
    tilts, level = (np.array([pose["quaternion_xyzw"][:2] for pose in sent]) for sent in poses)
    assert np.degrees(2 * np.abs(tilts).max()) > 0.3
    assert np.abs(level).max() < 1e-9
    assert [pose["xyz_m"] for pose in poses[0]] == [pose["xyz_m"] for pose in poses[1]]
    for true in zip(*(odometry.T_map_vehicle(np.array([START_NS + 5_000_000_000])) for odometry in both), strict=True):
        np.testing.assert_array_equal(*true)
