"""The rotation of a fisheye in real surroundings, rendered from panoramas, with its stated covariance."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.geometry.frames import Pose, rotation_from_rpy_deg
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import CameraMount, DroneImu, Image, VisualMotion
from stages.odometry.drone import FisheyeOdometry
from tests.stages.panoramas import FOLDER, Conditions, fisheye, jpeg, render
from tests.stages.seen import of

pytestmark = pytest.mark.skipif(not FOLDER.exists(), reason="needs ../shared/data/panoramas")
STEP_NS = 100_000_000


@pytest.mark.parametrize("name", ["112351", "112379"])
def test_the_rotation_of_a_turning_camera_is_as_uncertain_as_stated_and_has_no_translation(name):
    """The renders have an exact lens, so that no error is common to all tracks."""
    rng = np.random.default_rng(int(name))
    exact = {"lens_share": 0.0, "shared_noise_px": 0.0}
    odometry = FisheyeOdometry(lens=fisheye(), T_drone_camera=Pose(rpy_deg=(180.0, 0.0, -90.0)), link=exact)
    R, turn, rotations, nees = np.eye(3), np.zeros(3), [], []
    for i in range(10):
        turn = 0.8 * turn + rng.normal(0.0, math.radians(0.8), 3)
        R = R @ exp_rotation(turn)
        rotations.append(R)
        grey = jpeg(render(name, CameraMount.DRONE, R).grey + rng.normal(0.0, 2.5, (720, 720)), 80)
        image = Image(stamp_ns=(i + 1) * STEP_NS, frame_id="camera_drone", grey=grey)
        motion = of(odometry.on_image(image), VisualMotion)
        if motion is None:
            assert i == 0
            continue
        error = log_rotation(motion.R_from_to.T @ rotations[motion.from_ns // STEP_NS - 1].T @ R)
        assert math.degrees(np.linalg.norm(error)) < 0.03
        assert motion.direction_from is None
        nees.append(error @ np.linalg.solve(motion.covariance_rad2, error))
    print(f"NEES of 3: {np.mean(nees):.1f}")  # noqa: T201
    assert 1.0 < np.mean(nees) < 5.0


def rolled(name, R, rate_radps, readout_s):
    """An image of 480 px whose rows are exposed one after the other while the drone rotates, in 10 bands."""
    grey = np.zeros((480, 480), dtype=np.uint8)
    for band in np.array_split(np.arange(480), 10):
        after_s = (band.mean() - 239.5) / 479.0 * readout_s
        turned = R @ exp_rotation(rate_radps * after_s)
        grey[band] = render(name, CameraMount.DRONE, turned, conditions=Conditions(lens=fisheye(480))).grey[band]
    return grey


def test_the_gyro_corrects_a_rolling_shutter():
    """The rate changes from -0.6 to 0.6 rad/s; readout 25 ms: uncorrected, the errors of both images add up."""
    start, rates = rotation_from_rpy_deg((3.0, -2.0, 20.0)), [np.array([0.3, -0.2, -0.6]), np.array([-0.3, 0.2, 0.6])]
    poses, readout_s, error_deg = [start, start @ exp_rotation(np.array([0.01, -0.01, 0.02]))], 0.025, {}
    images = [rolled("112351", R, rate, readout_s) for R, rate in zip(poses, rates, strict=True)]
    for with_gyro in (False, True):
        odometry = FisheyeOdometry(lens=fisheye(480), T_drone_camera=Pose(rpy_deg=(180.0, 0.0, -90.0)))
        for k, (grey, rate) in enumerate(zip(images, rates, strict=True)):
            stamp_ns = (k + 1) * STEP_NS
            if with_gyro:
                gravity = np.array([0.0, 0.0, 9.81])
                odometry.on_imu(
                    DroneImu(stamp_ns=stamp_ns, acceleration_drone_mps2=gravity, angular_velocity_drone_radps=rate)
                )
            image = Image(stamp_ns=stamp_ns, frame_id="camera_drone", grey=grey, readout_s=readout_s)
            motion = of(odometry.on_image(image), VisualMotion)
        error = log_rotation(motion.R_from_to.T @ poses[0].T @ poses[1])
        error_deg[with_gyro] = math.degrees(np.linalg.norm(error))
    print(f"rotation error without, with gyro [deg]: {error_deg[False]:.3f}, {error_deg[True]:.3f}")  # noqa: T201
    assert error_deg[True] < 0.1
    assert error_deg[True] < 0.3 * error_deg[False]
