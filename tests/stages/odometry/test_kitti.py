"""Real images of a drive, KITTI 00 frames 0-99, with GPS/INS poses: rotation 0.1 deg, direction 1.5 deg, median."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.geometry.frames import Pose
from stages.kernels.geometry.so3 import log_rotation
from stages.messages import Image, VisualMotion
from stages.odometry.drone import FisheyeOdometry
from tests.stages.seen import degrees_between, of, pinhole

DRIVE = Path(__file__).resolve().parents[4] / "shared" / "data" / "vo_kitti00"
STEP_NS = 100_000_000
pytestmark = pytest.mark.skipif(not DRIVE.exists(), reason="needs ../shared/data/vo_kitti00")


def test_a_real_drive_is_tracked_image_by_image():
    K, poses = np.loadtxt(DRIVE / "K.txt"), np.loadtxt(DRIVE / "poses.txt").reshape(-1, 3, 4)
    odometry = FisheyeOdometry(
        lens=pinhole(K[0, 0], (K[0, 2], K[1, 2]), 42.9),
        T_drone_camera=Pose(),
        link={"key_parallax_deg": 0.01},  # every image is a key: motions from one to the next
    )
    turn_deg, direction_deg = [], []
    for i, file in enumerate(sorted((DRIVE / "left").iterdir())):
        grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        motion = of(odometry.on_image(Image(stamp_ns=(i + 1) * STEP_NS, frame_id="camera", grey=grey)), VisualMotion)
        if i == 0:
            assert motion is None
            continue
        a = motion.from_ns // STEP_NS - 1
        R = poses[a, :, :3].T @ poses[i, :, :3]
        turn_deg.append(math.degrees(np.linalg.norm(log_rotation(motion.R_from_to.T @ R))))
        direction_deg.append(
            degrees_between(motion.direction_from, poses[a, :, :3].T @ (poses[i, :, 3] - poses[a, :, 3]))
        )
    assert len(turn_deg) >= 98
    assert np.median(turn_deg) < 0.1
    assert np.median(direction_deg) < 1.5
    assert max(turn_deg) < 0.5
