"""Real images of a drive, KITTI 00 frames 0-99, with GPS/INS poses: rotation 0.1 deg, direction 1.5 deg, median.

The poses of the first frames are no measurements: one rotation to 0.001 deg. Later pitch and roll of the poses jitter:
the differences to the odometry from one image to the next do not add up (autocorrelation -0.25). An error of each pose
that is independent in time, with a variance of j, adds 2 j to their variance and -j to their covariance at lag one.
"""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.geometry.frames import Pose
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import Image, VisualMotion
from stages.odometry.drone import FisheyeOdometry
from tests.stages.seen import degrees_between, of, pinhole

DRIVE = Path(__file__).resolve().parents[5] / "shared" / "data" / "vo_kitti00"
STEP_NS = 100_000_000
pytestmark = pytest.mark.skipif(not DRIVE.exists(), reason="needs ../shared/data/vo_kitti00")


FIRST_MEASURED = 16


def odometry_errors(key_parallax_deg):
    """Of each image: its index, rotation error (3,) [rad] and its covariance, direction error and its sigma [deg]."""
    K, poses = np.loadtxt(DRIVE / "K.txt"), np.loadtxt(DRIVE / "poses.txt").reshape(-1, 3, 4)
    odometry = FisheyeOdometry(
        lens=pinhole(K[0, 0], (K[0, 2], K[1, 2]), 42.9),
        T_drone_camera=Pose(),
        link={"key_parallax_deg": key_parallax_deg},
    )
    out = []
    for i, file in enumerate(sorted((DRIVE / "left").iterdir())):
        grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        motion = of(odometry.on_image(Image(stamp_ns=(i + 1) * STEP_NS, frame_id="camera", grey=grey)), VisualMotion)
        if motion is None:
            assert i == 0
            continue
        a = motion.from_ns // STEP_NS - 1
        error = log_rotation(motion.R_from_to.T @ poses[a, :, :3].T @ poses[i, :, :3])
        direction = degrees_between(motion.direction_from, poses[a, :, :3].T @ (poses[i, :, 3] - poses[a, :, 3]))
        out.append((i, error, motion.covariance_rad2, direction, math.degrees(motion.direction_sigma_rad)))
    return out


def test_a_real_drive_is_tracked_image_by_image():
    errors = odometry_errors(0.01)  # every image is a key: motions from one to the next
    turn_deg = [math.degrees(np.linalg.norm(error)) for _, error, _, _, _ in errors]
    assert len(turn_deg) >= 98
    assert np.median(turn_deg) < 0.1
    assert np.median([direction for *_, direction, _ in errors]) < 1.5
    assert max(turn_deg) < 0.5


def pose_jitter_rad2():
    """Variance (3,) of the error of each pose about each axis, by the errors' covariance at lag one."""
    error = np.array([row[1] for row in odometry_errors(0.01) if row[0] > FIRST_MEASURED])
    return np.maximum(-np.mean(error[1:] * error[:-1], axis=0), 0.0)


@pytest.mark.parametrize("key_parallax_deg", [pytest.param(0.01, marks=pytest.mark.slow), 4.0])
def test_the_stated_covariance_of_a_real_drive_is_consistent(key_parallax_deg):
    errors = [row for row in odometry_errors(key_parallax_deg) if row[0] > FIRST_MEASURED]
    jitter = 2.0 * np.diag(pose_jitter_rad2())
    assert np.degrees(np.sqrt(jitter.max() / 2.0)) < 0.02

    def nees(of_poses):
        return np.mean([error @ np.linalg.solve(cov + of_poses, error) for _, error, cov, _, _ in errors])

    direction_nees = np.mean([(direction / sigma) ** 2 for *_, direction, sigma in errors])
    raw, turn_nees = nees(np.zeros((3, 3))), nees(jitter)
    print(f"NEES: rotation {turn_nees:.1f} ({raw:.1f}) of 3, direction {direction_nees:.1f} of 2")  # noqa: T201
    assert 1.5 < turn_nees < 5.0
    assert 0.3 < direction_nees < 4.0


def nees_over(errors, poses, images):
    """NEES of the rotation over a number of images, the product of the motions from one to the next."""
    rows = [row for row in errors if row[0] > FIRST_MEASURED]
    out = []
    for first in range(len(rows) - images + 1):
        R, cov = np.eye(3), np.zeros((3, 3))
        for i, error, covariance, *_ in rows[first : first + images]:
            step = poses[i - 1, :, :3].T @ poses[i, :, :3] @ exp_rotation(-error)
            R, cov = R @ step, step.T @ cov @ step + covariance
        start, end = poses[rows[first][0] - 1, :, :3], poses[rows[first + images - 1][0], :, :3]
        error = log_rotation(np.ascontiguousarray(R.T @ start.T @ end))
        out.append(error @ np.linalg.solve(cov, error))
    return float(np.mean(out))


def test_the_jitter_of_the_poses_does_not_grow_with_the_number_of_images_while_the_stated_covariance_does():
    errors, poses = odometry_errors(0.01), np.loadtxt(DRIVE / "poses.txt").reshape(-1, 3, 4)
    nees = {images: nees_over(errors, poses, images) for images in (1, 2, 4, 6, 8, 12, 16)}
    print("NEES of 3 by number of images:", {k: round(v, 2) for k, v in nees.items()})  # noqa: T201
    assert all(2.0 < nees[images] < 5.0 for images in (4, 6, 8, 12))
    assert nees[6] < 0.8 * nees[1]
