"""Vanishing directions: run time on fisheyes of three sizes, and grd compared with lu-vp-detect on York Urban.

    python -m pytest tests/benchmarks/bench_vp.py --benchmark-columns=min,median,iqr,rounds -s

lu-vp-detect needs OpenCV 4: create a separate environment and name its Python:

    python -m venv luvp && luvp/bin/pip install lu-vp-detect==1.0.4 --no-deps
    luvp/bin/pip install numpy scipy "opencv-python-headless==4.10.0.84"
    GRD_LU_VP_PYTHON=luvp/bin/python python -m pytest tests/benchmarks/bench_vp.py -s

Both process the same 51 images with the same camera on one thread, without gravity, and estimate three orthogonal
directions. Errors are against the published directions, good to about 1 deg, and those of grd also against the frame
that fits the labelled lines best (tests/stages/york_urban.py).
Recall counts true directions with a found one within so many degrees.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import time

import cv2
import numpy as np
import pytest

from stages.geometry.frames import Pose
from stages.geometry.lens import Equidistant, OCam
from stages.messages import CameraMount, Image
from stages.vp import GreatCircleVp, PaperVp
from tests.stages.york_urban import labelled, york_camera, york_folders, york_image, york_truth

LU_PYTHON = os.environ.get("GRD_LU_VP_PYTHON", "")
pytestmark = pytest.mark.usefixtures("one_thread")

R_MOUNT_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # a camera that points forward
LU = """
import json, sys, time
import cv2
from lu_vp_detect import VPDetection

cv2.setNumThreads(1)
focal, cx, cy, *paths = json.load(sys.stdin)
detector = VPDetection(30, (cx, cy), focal, seed=1)
out = []
for path in paths:
    image = cv2.imread(path)
    seconds = []
    for attempt in range(3):
        start = time.thread_time()
        found = detector.find_vps(image).tolist()
        seconds.append(time.thread_time() - start)
    out.append((min(seconds), found))
print(json.dumps(out))
"""


def courtyard(size_px):
    """A fisheye image of chequered walls with noise: more edges than a street has."""
    middle = (size_px - 1) / 2
    lens = Equidistant(focal_px=(size_px / 2 - 2) / math.radians(117.5), centre_px=(middle, middle))
    column, row = np.meshgrid(np.arange(size_px, dtype=np.float64), np.arange(size_px, dtype=np.float64))
    rays = lens.unproject(np.column_stack([column.ravel(), row.ravel()]))
    with np.errstate(divide="ignore", invalid="ignore"):
        away = np.min(np.abs(np.array([6.0, 9.0, 4.0]) / rays), axis=1)
    cells = np.floor(np.nan_to_num(rays * away[:, None]) / [1.9, 2.3, 1.3] + 0.5).sum(axis=1)
    grey = np.where(np.isnan(away), 0.0, np.where(cells % 2 == 0, 90.0, 150.0)).reshape(size_px, size_px)
    grey = cv2.GaussianBlur(grey, (3, 3), 0.6) + np.random.default_rng(0).normal(0, 2, grey.shape)
    return lens, np.clip(np.round(grey), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("size_px", [720, 1080, 1440])
def test_grd_whole_image(benchmark, size_px):
    lens, grey = courtyard(size_px)
    vp = GreatCircleVp(camera_mount=CameraMount.VEHICLE, T_mount_camera=Pose(rpy_deg=(0.0, 0.0, 90.0)), lens=lens)
    message = Image(stamp_ns=0, frame_id="camera_vehicle", grey=grey)
    assert len(vp.on_image(message).direction) == 3
    benchmark(vp.on_image, message)


@pytest.mark.parametrize("size_px", [720, 1080, 1440])
def test_paper_whole_image(benchmark, size_px):
    """The same images through three views of 428 px; LSD takes most of the time."""
    lens, grey = courtyard(size_px)
    looks_up = Pose(rpy_deg=(0.0, 0.0, 90.0))
    vp = PaperVp(camera_mount=CameraMount.VEHICLE, T_mount_camera=looks_up, lens=lens, size_px=size_px)
    message = Image(stamp_ns=0, frame_id="camera_vehicle", grey=grey)
    assert len(vp.on_image(message).line_normal) > 100
    benchmark(vp.on_image, message)


def forward_stage(lens):
    """grd's stage for a camera that faces forward, without gravity, one Manhattan frame."""
    return GreatCircleVp(
        camera_mount=CameraMount.DRONE,
        T_mount_camera=Pose(quaternion_xyzw=(-0.5, 0.5, -0.5, 0.5)),
        lens=lens,
        search_deg=45.0,
        vertical_sigma_deg=20.0,
        max_frames=1,
    )


def york_stage():
    """grd's stage for the camera of York Urban, a pinhole."""
    focal, column, row = york_camera()
    return forward_stage(OCam(polynomial=(-focal, 0.0, 0.0, 0.0, 0.0), centre_px=(column, row), max_off_axis_deg=60.0))


def grd_on_york(folders):
    """CPU time [s], the best of three, and directions (n, 3) in the camera frame of each image."""
    vp = york_stage()
    results = []
    for image in [york_image(folder) for folder in folders]:
        seconds = []
        for _ in range(3):
            start = time.thread_time()
            found = vp.on_image(image)
            seconds.append(time.thread_time() - start)
        results.append((min(seconds), found.direction @ R_MOUNT_CAMERA))
    return results


def lu_on_york(folders):
    focal, column, row = york_camera()
    asked = json.dumps([focal, column, row, *(str(folder / f"{folder.name}.jpg") for folder in folders)])
    result = subprocess.run([LU_PYTHON, "-c", LU], input=asked, capture_output=True, text=True, check=True)
    return [(seconds, np.array(found)) for seconds, found in json.loads(result.stdout)]


def errors_deg(found, truth):
    """(3,) of each true direction to the nearest found one; 90 without any."""
    if len(found) == 0:
        return np.full(len(truth), 90.0)
    return np.degrees(np.arccos(np.clip(np.abs(truth @ found.T), 0.0, 1.0))).min(axis=1)


def line_of(name, errors, seconds):
    recall = " ".join(f"{np.mean(errors < limit):.3f}" for limit in (1, 2, 5))
    whole = " ".join(f"{np.mean(errors.max(axis=1) < limit):.2f}" for limit in (2, 5))
    return (
        f"{name:24s} median {np.median(errors):.2f} deg, RMS below 5 deg {np.sqrt(np.mean(errors[errors < 5] ** 2)):.2f}, "
        f"recall 1/2/5 deg {recall}, whole images 2/5 deg {whole}, {1e3 * np.median(seconds):.1f} ms CPU a image"
    )


def test_grd_and_lu_vp_detect_on_york_urban():
    folders = york_folders()
    if not folders:
        pytest.skip("York Urban is not here (../shared/data/vp_york_urban)")
    results = grd_on_york(folders)
    seconds = [a[0] for a in results]
    by_lines = np.array([errors_deg(a[1], labelled(f).direction) for a, f in zip(results, folders, strict=True)])
    print(f"\n{line_of('grd, by labelled lines', by_lines, seconds)}")  # noqa: T201
    truth = [york_truth(folder) for folder in folders]
    errors = np.array([errors_deg(a[1], t) for a, t in zip(results, truth, strict=True)])
    print(line_of("grd", errors, seconds))  # noqa: T201
    if not LU_PYTHON:
        pytest.skip("GRD_LU_VP_PYTHON does not name the Python of an environment with lu-vp-detect and OpenCV 4")
    results = lu_on_york(folders)
    errors = np.array([errors_deg(a[1], t) for a, t in zip(results, truth, strict=True)])
    print(line_of("lu-vp-detect", errors, [a[0] for a in results]))  # noqa: T201
