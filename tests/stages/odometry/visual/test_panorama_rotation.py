"""The rotation of a fisheye in real surroundings, rendered from panoramas, with its stated covariance."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stages.geometry.frames import Pose
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import CameraMount, Image, VisualMotion
from stages.odometry.drone import FisheyeOdometry
from tests.stages.panoramas import FOLDER, fisheye, jpeg, render
from tests.stages.seen import of

pytestmark = pytest.mark.skipif(not FOLDER.exists(), reason="needs ../shared/data/panoramas")
STEP_NS = 100_000_000


@pytest.mark.parametrize("name", ["112351", "112379"])
def test_the_rotation_of_a_turning_camera_is_not_overconfident_and_has_no_translation(name):
    rng = np.random.default_rng(int(name))
    odometry = FisheyeOdometry(
        lens=fisheye(), T_drone_camera=Pose(rpy_deg=(180.0, 0.0, -90.0)), link={"lens_share": 0.0}
    )
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
    assert np.mean(nees) < 3.0
