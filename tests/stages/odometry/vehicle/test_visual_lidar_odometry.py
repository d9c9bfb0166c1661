"""The vehicle's motion in a room with LiDAR: scale, axes, standstill, covariance, and missing inputs."""

import dataclasses
import math

import numpy as np
import pytest
from pydantic import ValidationError

from flow.message import check_arrays
from flow.stage import input_ports, output_ports
from stages.geometry.frames import Pose
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import Image, VehicleMotion
from stages.odometry.vehicle import VisualLidarOdometry
from tests.stages.seen import LENS, LOOKS_UP, SIZE_PX, STEP_NS, image, lidar_slice, of

START_NS = 1_000_000_000


def even(turn_radps, velocity_mps, from_s=0.0):
    """A path at constant velocity and turn rate in its own axes, standing until `from_s`: time -> R, p."""

    def at(time_s):
        s = max(time_s - from_s, 0.0)
        return exp_rotation(s * np.asarray(turn_radps, float)), s * np.asarray(velocity_mps, float)

    return at


def driven(at, count, mount=LOOKS_UP, lidar=True, settings=None, blank=()):
    """Motions published, by image; None where there was none."""
    ego = VisualLidarOdometry(lens=LENS, T_vehicle_camera=mount, **(settings or {}))
    motions = []
    for k in range(count):
        for part in range(6) if lidar else ():
            stamp_ns = START_NS + (k - 1) * STEP_NS + part * STEP_NS // 6
            ego.on_points(lidar_slice(stamp_ns, *at((stamp_ns - START_NS) * 1e-9), seed=10 * k + part))
        stamp_ns = START_NS + k * STEP_NS
        R, p = at(k * STEP_NS * 1e-9)
        seen = image(stamp_ns, R, p + R @ np.array(mount.xyz_m), mount)
        if k in blank:
            seen = Image(stamp_ns=stamp_ns, frame_id="camera", grey=np.full((SIZE_PX, SIZE_PX), 70, np.uint8))
        motions.append(of(ego.on_image(seen), VehicleMotion))
    return motions


def errors(at, motions):
    """Rotation vector [rad] and body offset [m] (n, 6) of each motion against the first, and the distance travelled [m]."""
    out = []
    first = next(m for m in motions if m is not None)
    R, p = at((first.stamp_ns - START_NS) * 1e-9)
    R_start = R @ first.R_map_vehicle.T
    p_start = p - R_start @ first.xyz_map_m
    for m in motions:
        if m is not None:
            R, p = at((m.stamp_ns - START_NS) * 1e-9)
            turn = log_rotation(m.R_map_vehicle.T @ R_start.T @ R)
            out.append([*turn, *(m.R_map_vehicle.T @ (R_start.T @ (p - p_start) - m.xyz_map_m))])
    return np.array(out)


@pytest.mark.parametrize("velocity", [(4, 0, 0), (-3, 0, 0), (2, 2, 0), (1, 0, 1.5)])
def test_scale_and_axes_of_a_drive(velocity):
    at = even((0, 0, 0.2), velocity)
    motions = driven(at, 16)
    assert sum(m is not None for m in motions) >= 8
    last = errors(at, motions)[-1]
    assert np.linalg.norm(last[3:]) < 0.03 * 15 * STEP_NS * 1e-9 * np.linalg.norm(velocity)
    assert math.degrees(np.linalg.norm(last[:3])) < 0.3
    for m in motions:
        if m is not None:
            check_arrays(m)


def test_the_offset_of_the_camera_is_compensated():
    mount = Pose(xyz_m=(0.5, -0.2, 0.3), rpy_deg=(0.0, 10.0, 90.0))
    at = even((0, 0, 0.6), (2, 0, 0))
    last = errors(at, driven(at, 14, mount))[-1]
    assert np.linalg.norm(last[3:]) < 0.06
    assert math.degrees(np.linalg.norm(last[:3])) < 0.3


def test_a_vehicle_at_rest_has_no_motion():
    motions = driven(even((0, 0, 0), (0, 0, 0)), 8)
    assert motions[0] is None
    for m in motions[1:]:
        assert np.abs(m.xyz_map_m).max() == 0.0
        assert np.linalg.norm(log_rotation(m.R_map_vehicle)) < 1e-3
        assert np.sqrt(np.diag(m.covariance)).max() < 0.02


def test_driving_off_after_standstill_keeps_the_map_frame():
    at = even((0, 0, 0), (4, 0, 0), from_s=5 * STEP_NS * 1e-9)
    motions = driven(at, 20)
    assert all(m is not None for m in motions[1:])
    truth = at(motions[-1].stamp_ns * 1e-9 - 1.0)[1]
    assert np.linalg.norm(motions[-1].xyz_map_m - truth) < 0.05 * truth[0]


def test_the_covariance_grows_and_covers_the_errors():
    at = even((0, 0, 0.1), (4, 0, 0))
    motions = [m for m in driven(at, 20) if m is not None]
    spread = [np.trace(m.covariance[3:, 3:]) for m in motions]
    assert spread[-1] > spread[0]
    nees = [e @ np.linalg.solve(m.covariance, e) for e, m in zip(errors(at, motions)[1:], motions[1:], strict=True)]
    assert np.mean(nees) < 10.0  # 6 axes
    np.testing.assert_allclose(motions[-1].covariance, motions[-1].covariance.T, atol=1e-12)


def test_without_lidar_no_motion_is_published_while_driving():
    assert driven(even((0, 0, 0), (4, 0, 0)), 8, lidar=False) == [None] * 8


def test_after_a_blank_image_it_continues_with_a_larger_covariance():
    at = even((0, 0, 0), (4, 0, 0))
    motions = driven(at, 20, blank=(14,))
    assert all(m is not None for m in motions[13:])
    assert np.trace(motions[15].covariance[3:, 3:]) > 2 * np.trace(motions[13].covariance[3:, 3:])
    assert np.linalg.norm(errors(at, motions)[-1][3:]) < 0.5


def test_an_image_that_is_not_newer_is_ignored():
    ego = VisualLidarOdometry(lens=LENS, T_vehicle_camera=LOOKS_UP)
    seen = image(START_NS, np.eye(3), np.zeros(3), LOOKS_UP)
    assert of(ego.on_image(seen), VehicleMotion) is None
    assert of(ego.on_image(seen), VehicleMotion) is None
    later = image(START_NS + STEP_NS, np.eye(3), np.zeros(3), LOOKS_UP)
    assert of(ego.on_image(later), VehicleMotion) is not None


def odometry(at, stamp_ns):
    """A pose of the vehicle's odometry."""
    R, p = at((stamp_ns - START_NS) * 1e-9)
    return VehicleMotion(stamp_ns=stamp_ns, xyz_map_m=p + np.array([5.0, 0.0, 0.0]), R_map_vehicle=R, covariance=None)


def test_it_is_inactive_with_odometry_and_continues_at_once_with_its_speed():
    at, ego, motions = even((0, 0, 0.2), (3, 0, 0)), VisualLidarOdometry(lens=LENS, T_vehicle_camera=LOOKS_UP), []
    silent_from = START_NS + 6 * STEP_NS
    for k in range(24):
        for part in range(6):
            stamp_ns = START_NS + (k - 1) * STEP_NS + part * STEP_NS // 6
            if stamp_ns < silent_from:
                ego.on_odometry(odometry(at, stamp_ns))
            ego.on_points(lidar_slice(stamp_ns, *at((stamp_ns - START_NS) * 1e-9), seed=10 * k + part))
        seen = image(START_NS + k * STEP_NS, *at(k * STEP_NS * 1e-9), LOOKS_UP)
        motions.append(of(ego.on_image(seen), VehicleMotion))
    first = next(k for k, m in enumerate(motions) if m is not None)
    assert first == math.ceil((silent_from - START_NS) / STEP_NS - 1 / 6 + ego.settings.silent_s * 1e9 / STEP_NS)
    assert motions[first].xyz_map_m.tolist() == [0.0, 0.0, 0.0]
    assert all(m is not None for m in motions[first:])
    off_m = np.linalg.norm(errors(at, motions)[:, 3:], axis=1)
    assert off_m.max() < 0.03 * 3 * (23 - first) * STEP_NS * 1e-9
    ego.on_odometry(odometry(at, START_NS + 24 * STEP_NS))
    assert list(ego.on_image(image(START_NS + 24 * STEP_NS, *at(24 * STEP_NS * 1e-9), LOOKS_UP))) == []


def test_it_works_while_the_odometry_is_invalid():
    at, ego, motions = even((0, 0, 0.2), (3, 0, 0)), VisualLidarOdometry(lens=LENS, T_vehicle_camera=LOOKS_UP), []
    mad_from, rng = START_NS + 6 * STEP_NS, np.random.default_rng(0)
    for k in range(20):
        for part in range(6):
            stamp_ns = START_NS + (k - 1) * STEP_NS + part * STEP_NS // 6
            reported = odometry(at, stamp_ns)
            if stamp_ns >= mad_from:
                reported = dataclasses.replace(reported, xyz_map_m=rng.uniform(-90, 90, 3))
            ego.on_odometry(reported)
            ego.on_points(lidar_slice(stamp_ns, *at((stamp_ns - START_NS) * 1e-9), seed=10 * k + part))
        seen = image(START_NS + k * STEP_NS, *at(k * STEP_NS * 1e-9), LOOKS_UP)
        motions.append(of(ego.on_image(seen), VehicleMotion))
    first = next(k for k, m in enumerate(motions) if m is not None)
    assert first == math.ceil((mad_from - START_NS) / STEP_NS - 1 / 6 + ego.settings.silent_s * 1e9 / STEP_NS)
    assert all(m is not None for m in motions[first:])
    assert np.linalg.norm(errors(at, motions)[:, 3:], axis=1).max() < 0.03 * 3 * (19 - first) * STEP_NS * 1e-9
    for part in range(3):  # sane again: three that agree
        ego.on_odometry(odometry(at, START_NS + 19 * STEP_NS + (part + 1) * STEP_NS // 6))
    assert list(ego.on_image(image(START_NS + 20 * STEP_NS, *at(20 * STEP_NS * 1e-9), LOOKS_UP))) == []


def test_its_ports_are_image_points_and_odometry_and_its_output_is_vehicle_motion():
    assert set(input_ports(VisualLidarOdometry)) == {"image", "points", "odometry"}
    assert set(output_ports(VisualLidarOdometry)) == {"vehicle_motion", "followed_features"}


@pytest.mark.parametrize("wrong", [{"window_keys": 2}, {"every_nth_point": 0}, {"reach_deg": 0.0}, {"scale": 1.0}])
def test_impossible_settings_are_rejected(wrong):
    with pytest.raises(ValidationError):
        VisualLidarOdometry(lens=LENS, T_vehicle_camera=LOOKS_UP, **wrong)
