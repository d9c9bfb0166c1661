"""Run time per image of drone odometry and visual-lidar odometry: `python -m pytest tests/benchmarks/bench_odometry.py`.

Limit of the design: 15 ms per image of 1080 px on one core. The baseline: corners on the whole image,
Lucas-Kanade forward and backward, OpenCV's essential matrix on what lies within 80 deg of the axis, and poselib's RANSAC on
the same points. Errors against the truth are in `extra_info`: grd from the key image, the baseline from the previous
image, over a shorter translation.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import poselib
import pytest

from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import Image, VisualMotion
from stages.odometry.drone import FisheyeOdometry
from stages.odometry.vehicle import VisualLidarOdometry
from stages.odometry.visual.two_view import Noise, relative_motion
from tests.stages.seen import (
    LENS,
    LOOKS_DOWN,
    LOOKS_UP,
    SIZE_PX,
    degrees_between,
    grey_image,
    lidar_slice,
    of,
    point_rays,
)

pytestmark = pytest.mark.usefixtures("one_thread")

IMAGES = 16
STEP_NS = 66_000_000
WIDEST = math.cos(math.radians(80.0))
TURN_RADPS, VELOCITY_MPS = np.array([0.1, -0.1, 0.6]), np.array([3.0, 1.0, 0.0])


def pose(k):
    s = k * STEP_NS * 1e-9
    return exp_rotation(s * TURN_RADPS), s * VELOCITY_MPS


def flight(size_px, mount):
    """Images of a rotating, flying camera."""
    C = mount.matrix()[:3, :3]
    return [grey_image(pose(k)[0] @ C, pose(k)[1], k, size_px) for k in range(IMAGES)]


@pytest.mark.parametrize("size_px", [720, 1080, 1440])
@pytest.mark.benchmark(group="odometry, per image")
def test_ours(benchmark, size_px):
    images = flight(size_px, LOOKS_DOWN)
    turn, direction, clock = [], [], iter(range(1, 100_000))
    odometry = FisheyeOdometry(lens=LENS.scaled(size_px / SIZE_PX), T_drone_camera=LOOKS_DOWN)

    def one():
        k = next(clock)
        there = (k - 1) % (2 * IMAGES - 2)  # to and fro: every step is one of the flight
        at = min(there, 2 * IMAGES - 2 - there)
        return (
            k,
            at,
            of(odometry.on_image(Image(stamp_ns=k * STEP_NS, frame_id="camera", grey=images[at])), VisualMotion),
        )

    positions = {}
    for _ in range(5):
        k, at, _ = one()
        positions[k] = at

    def timed():
        k, at, motion = one()
        positions[k] = at
        if motion is not None:
            (R0, p0), (R1, p1) = pose(positions[motion.from_ns // STEP_NS]), pose(at)
            turn.append(math.degrees(np.linalg.norm(log_rotation(motion.R_from_to.T @ R0.T @ R1))))
            if motion.direction_from is not None and np.linalg.norm(p1 - p0) > 0.1:
                direction.append(degrees_between(motion.direction_from, R0.T @ (p1 - p0)))

    benchmark.pedantic(timed, rounds=50, iterations=1)
    benchmark.extra_info |= {"turn_deg": float(np.median(turn)), "direction_deg": float(np.median(direction))}


@pytest.mark.parametrize("size_px", [720, 1080])
@pytest.mark.parametrize("solver", ["opencv", "poselib"])
@pytest.mark.benchmark(group="odometry, per image")
def test_baseline(benchmark, size_px, solver):
    """From image to image, points in front of the lens only: their x / z, y / z."""
    images, lens = flight(size_px, LOOKS_DOWN), LENS.scaled(size_px / SIZE_PX)
    C = LOOKS_DOWN.matrix()[:3, :3]
    turn, direction, k = [], [], iter(range(10_000))

    def one():
        at = next(k) % (IMAGES - 1)
        before, now = images[at], images[at + 1]
        corners = cv2.goodFeaturesToTrack(before, 300, 0.01, size_px / 40)
        found, forward, _ = cv2.calcOpticalFlowPyrLK(before, now, corners, None)
        back, backward, _ = cv2.calcOpticalFlowPyrLK(now, before, found, None)
        good = (forward.ravel() * backward.ravel() > 0) & (
            np.linalg.norm((back - corners).reshape(-1, 2), axis=1) < 0.5
        )
        rays = [lens.unproject(p.reshape(-1, 2)[good].astype(np.float64)) for p in (corners, found)]
        wide = (rays[0][:, 2] > WIDEST) & (rays[1][:, 2] > WIDEST)
        flat = [r[wide, :2] / r[wide, 2:] for r in rays]
        if solver == "opencv":
            E, mask = cv2.findEssentialMat(*flat, np.eye(3), cv2.RANSAC, 0.999, 1.0 / lens.focal_px)
            _, R, t, _ = cv2.recoverPose(E, *flat, np.eye(3), mask=mask)
            t = t.ravel()
        else:
            camera = {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [lens.focal_px, 0.0, 0.0]}
            scaled = [lens.focal_px * f for f in flat]
            found_pose, _ = poselib.estimate_relative_pose(*scaled, camera, camera, {"max_epipolar_error": 1.0})
            R, t = found_pose.R, found_pose.t
        (R0, p0), (R1, p1) = pose(at), pose(at + 1)
        turn.append(math.degrees(np.linalg.norm(log_rotation(C @ R @ C.T @ R0.T @ R1))))
        direction.append(degrees_between(C @ (-R.T @ t), R0.T @ (p1 - p0)))

    one()
    benchmark.pedantic(one, rounds=30, iterations=1)
    benchmark.extra_info |= {"turn_deg": float(np.median(turn)), "direction_deg": float(np.median(direction))}


@pytest.mark.parametrize("outliers", [0.0, 0.4])
@pytest.mark.benchmark(group="two views, 250 rays all around")
def test_our_ransac(benchmark, outliers):
    earlier, later, R, t = point_rays(250, (0.02, -0.05, 0.15), (0.6, -0.2, 0.1), 3e-4, outliers)
    found = benchmark(relative_motion, earlier, later, np.eye(3), None, Noise(2e-4, 3e-4), 100)
    benchmark.extra_info |= {
        "turn_deg": math.degrees(np.linalg.norm(log_rotation(found.R_later_earlier @ R.T))),
        "direction_deg": degrees_between(found.t_hat_later, t),
    }


@pytest.mark.parametrize("size_px", [720, 1080])
@pytest.mark.benchmark(group="visual-lidar odometry, per image with LiDAR")
def test_ego(benchmark, size_px):
    images, k = flight(size_px, LOOKS_UP), iter(range(1, 100_000))
    ego = VisualLidarOdometry(lens=LENS.scaled(size_px / SIZE_PX), T_vehicle_camera=LOOKS_UP)

    def position(number):
        there = (number - 1) % (2 * IMAGES - 2)
        return min(there, 2 * IMAGES - 2 - there)

    def ready():
        number = next(k)
        at = position(number)
        slices = [lidar_slice(number * STEP_NS, *pose(at), number, 5000)]
        return (slices, Image(stamp_ns=number * STEP_NS, frame_id="camera", grey=images[at])), {}

    def one(slices, seen):
        for points in slices:
            ego.on_points(points)
        list(ego.on_image(seen))

    for _ in range(8):
        one(*ready()[0])
    benchmark.pedantic(one, setup=ready, rounds=40, iterations=1)
