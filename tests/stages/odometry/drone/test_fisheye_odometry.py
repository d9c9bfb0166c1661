"""The drone's motion from images of a room: both axes conventions, chaining, hover, gyro, and blank images."""

import math
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError

from flow.message import check_arrays
from flow.stage import input_ports, output_ports
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import DroneImu, FollowedFeatures, Image, VisualMotion
from stages.odometry.drone import FisheyeOdometry
from stages.odometry.drone.fisheye_odometry import gyro_rotation, visual_motion
from stages.odometry.visual.features import Tracks
from stages.odometry.visual.image_motion import Link
from stages.odometry.visual.two_view import TwoView
from tests.stages.seen import LENS, LOOKS_DOWN, LOOKS_UP, PIXEL_RAD, SIZE_PX, STEP_NS, degrees_between, image, of

YAW = np.array([0.0, 0.0, 1.0])


def flown(turn_radps, velocity_mps, count, mount=LOOKS_DOWN, settings=None, imu=False):
    """Odometry of a drone at constant velocity and turn rate: motions and true poses by stamp."""
    odometry = FisheyeOdometry(lens=LENS, T_drone_camera=mount, **(settings or {}))
    truth, motions = {}, []
    for k in range(count):
        s = k * STEP_NS * 1e-9
        stamp_ns = 1_000_000_000 + k * STEP_NS
        truth[stamp_ns] = exp_rotation(s * np.asarray(turn_radps, float)), s * np.asarray(velocity_mps, float)
        if imu:
            for early_ns in range(-STEP_NS, 1, STEP_NS // 6):
                odometry.on_imu(
                    DroneImu(
                        stamp_ns=stamp_ns + early_ns,
                        acceleration_drone_mps2=np.array([0.0, 0.0, 9.81]),
                        angular_velocity_drone_radps=np.asarray(turn_radps, float),
                    )
                )
        motions.append(of(odometry.on_image(image(stamp_ns, *truth[stamp_ns], mount)), VisualMotion))
    return motions, truth


def true_motion(truth, motion):
    (R0, p0), (R1, p1) = truth[motion.from_ns], truth[motion.stamp_ns]
    return R0.T @ R1, R0.T @ (p1 - p0)


def turn_error_deg(truth, motion):
    return math.degrees(np.linalg.norm(log_rotation(motion.R_from_to.T @ true_motion(truth, motion)[0])))


@pytest.mark.parametrize("velocity", [(3, 0, 0), (0, 3, 0), (0, 0, 3), (-2, 1, 0.5)])
@pytest.mark.parametrize("mount", [LOOKS_DOWN, LOOKS_UP])
def test_direction_and_rotation_are_in_drone_axes(velocity, mount):
    motions, truth = flown(0.2 * YAW, velocity, 5, mount)
    assert motions[0] is None
    for motion in motions[1:]:
        check_arrays(motion)
        assert turn_error_deg(truth, motion) < 0.1
        assert degrees_between(motion.direction_from, true_motion(truth, motion)[1]) < 2.0
        assert motion.direction_sigma_rad < math.radians(5)
        assert motion.matches > 60


def test_motions_are_chained_from_key_to_key_and_their_rotations_multiply():
    motions, truth = flown((0.1, -0.1, 0.5), (3, 1, 0), 16)
    outputs = motions[1:]
    keys = list(dict.fromkeys(m.from_ns for m in outputs))
    assert len(keys) > 2
    R = np.eye(3)
    for key, following in pairwise(keys):
        *_, link = (m for m in outputs if m.from_ns == key)
        assert link.stamp_ns == following  # no gap
        R = R @ link.R_from_to
    error = log_rotation(R.T @ truth[keys[0]][0].T @ truth[keys[-1]][0])
    assert math.degrees(np.linalg.norm(error)) < 0.15


def test_a_turn_of_120_deg_per_second_is_tracked():
    motions, truth = flown(math.radians(120) * YAW, (1, 0, 0), 10)
    assert all(m is not None for m in motions[1:])
    assert max(turn_error_deg(truth, m) for m in motions[1:]) < 0.15


def test_hovering_has_no_direction_and_keeps_its_key():
    motions, truth = flown((0, 0, 0), (0, 0, 0), 8)
    assert {m.from_ns for m in motions[1:]} == {1_000_000_000}
    for motion in motions[1:]:
        assert motion.direction_from is None
        assert motion.direction_sigma_rad is None
        assert motion.reason == "no translation observed"
        assert turn_error_deg(truth, motion) < 0.02


def test_a_turn_without_translation_has_no_direction():
    motions, truth = flown(0.6 * YAW, (0, 0, 0), 8)
    assert all(m.direction_from is None for m in motions[1:])
    assert max(turn_error_deg(truth, m) for m in motions[1:]) < 0.1


def test_the_errors_match_the_covariance():
    motions, truth = flown((0.1, 0.2, 0.3), (2, -1, 0.5), 12)
    nees = []
    for m in motions[1:]:
        R, t = true_motion(truth, m)
        phi = log_rotation(m.R_from_to.T @ R)
        nees.append(
            (
                phi @ np.linalg.solve(m.covariance_rad2, phi),
                (math.radians(degrees_between(m.direction_from, t)) / m.direction_sigma_rad) ** 2,
            )
        )
    assert np.mean(nees, axis=0)[0] < 6  # 3 axes
    assert np.mean(nees, axis=0)[1] < 4  # 2 axes


def test_covariance_and_direction_are_turned_from_the_camera_into_the_drone():
    t, C = np.array([0.0, 0.0, 1.0]), LOOKS_DOWN.matrix()[:3, :3]
    covariance = np.diag([1e-6, 4e-6, 9e-6, 1e-5, 1e-5, 0.0])
    seen = TwoView(np.eye(3), t, covariance, np.ones(40, bool), 1e-3, 40, 0.1)
    key, now = (Tracks(s, np.arange(40), np.zeros((40, 3)), np.zeros((40, 2))) for s in (5, 7))
    motion = visual_motion(Link(key, now, key.number, key.ray, now.ray, seen, False), C)
    np.testing.assert_allclose(motion.covariance_rad2, np.diag([4e-6, 1e-6, 9e-6]), atol=1e-18)  # x is the camera's y
    np.testing.assert_allclose(
        motion.direction_from, [0, 0, 1], atol=1e-12
    )  # points move away along the axis: the drone rises
    assert motion.direction_sigma_rad == pytest.approx(math.sqrt(1e-5 + 2.5e-6))
    assert (motion.from_ns, motion.stamp_ns, motion.matches) == (5, 7, 40)


def test_a_gyro_predicts_features_after_a_large_rotation():
    turn = math.radians(400) * YAW
    with_gyro, truth = flown(turn, (0, 0, 0), 3, imu=True)
    assert all(m is not None for m in with_gyro[1:])
    assert max(turn_error_deg(truth, m) for m in with_gyro[1:]) < 0.2


def test_the_gyro_is_integrated_between_images_but_not_over_gaps():
    rate = np.array([0.0, 0.0, 1.0])
    ms = 1_000_000
    even = [(k * 10 * ms, rate) for k in range(11)]
    R = gyro_rotation(even, 5 * ms, 95 * ms)
    np.testing.assert_allclose(log_rotation(R), 0.09 * rate, atol=1e-12)
    assert gyro_rotation([g for g in even if not 30 * ms <= g[0] <= 90 * ms], 5 * ms, 95 * ms) is None
    assert gyro_rotation(even, 5 * ms, 500 * ms) is None
    assert gyro_rotation([(80 * ms, rate)], 5 * ms, 95 * ms) is None


def test_a_blank_image_ends_the_chain_and_the_next_begins_one():
    odometry = FisheyeOdometry(lens=LENS, T_drone_camera=LOOKS_DOWN)
    blank = np.full((SIZE_PX, SIZE_PX), 60, np.uint8)
    stamps = [1_000_000_000 + k * STEP_NS for k in range(6)]
    outputs = []
    for k, stamp_ns in enumerate(stamps):
        seen = image(stamp_ns, np.eye(3), np.array([0.2 * k, 0, 0]), LOOKS_DOWN)
        if k in (2, 3):
            seen = Image(stamp_ns=stamp_ns, frame_id="camera", grey=blank)
        outputs.append(of(odometry.on_image(seen), VisualMotion))
    assert [m is not None for m in outputs] == [False, True, False, False, False, True]
    assert outputs[5].from_ns == stamps[4]


def test_an_image_that_is_not_newer_is_ignored():
    odometry = FisheyeOdometry(lens=LENS, T_drone_camera=LOOKS_DOWN)
    seen = image(1_000_000_000, np.eye(3), np.zeros(3), LOOKS_DOWN)
    assert of(odometry.on_image(seen), VisualMotion) is None
    assert of(odometry.on_image(seen), VisualMotion) is None
    later = image(1_000_000_000 + STEP_NS, np.eye(3), np.array([0.2, 0, 0]), LOOKS_DOWN)
    assert of(odometry.on_image(later), VisualMotion).from_ns == 1_000_000_000


def test_the_tracked_features_are_published_with_their_images():
    odometry = FisheyeOdometry(lens=LENS, T_drone_camera=LOOKS_DOWN)
    shift = np.array([0.2, 0, 0])
    for k in range(3):
        outputs = list(odometry.on_image(image(1_000_000_000 + k * STEP_NS, np.eye(3), k * shift, LOOKS_DOWN)))
        motion, followed = of(outputs, VisualMotion), of(outputs, FollowedFeatures)
        if k == 0:
            assert outputs == []
            continue
        assert (followed.stamp_ns, followed.from_ns) == (motion.stamp_ns, motion.from_ns)
        assert followed.frame_id == "camera"
        assert followed.agrees.sum() == motion.matches
        check_arrays(followed)
        C = LOOKS_DOWN.matrix()[:3, :3]
        ray_from, ray_to = LENS.unproject(followed.pixel_from) @ C.T, LENS.unproject(followed.pixel_to) @ C.T
        plane = np.cross(ray_from, ray_to)  # a motion along x: no rotation, so every plane holds x
        plane /= np.linalg.norm(plane, axis=1, keepdims=True)
        assert np.abs(plane[followed.agrees, 0]).max() < 0.2
        assert np.median(followed.residual_rad[followed.agrees]) < 0.3 * PIXEL_RAD


def test_the_same_images_give_the_same_motions():
    one, other = (flown(0.3 * YAW, (2, 0, 0), 5)[0] for _ in range(2))
    for a, b in zip(one[1:], other[1:], strict=True):
        assert (a.R_from_to == b.R_from_to).all()
        assert (a.direction_from == b.direction_from).all()


def test_its_ports_are_image_and_a_gyro_that_may_be_missing():
    assert set(input_ports(FisheyeOdometry)) == {"image", "imu"}
    assert FisheyeOdometry.optional_inputs == {"imu"}
    assert set(output_ports(FisheyeOdometry)) == {"visual_motion", "followed_features"}


@pytest.mark.parametrize(
    "wrong", [{"least_matches": 3}, {"link": {"key_share": 1.5}}, {"link": {"tries": 0}}, {"features": {"count": 1}}]
)
def test_impossible_settings_are_rejected(wrong):
    with pytest.raises(ValidationError):
        FisheyeOdometry(lens=LENS, T_drone_camera=LOOKS_DOWN, **wrong)
