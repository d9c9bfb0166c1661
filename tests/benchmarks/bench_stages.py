"""Time per packet, per sweep and per frame: `python -m pytest tests/benchmarks/bench_stages.py`.

Limits of the design: detection of a full 512 x 512 image 20 ms, a mean shift frame 2 ms, one core.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from stages.depth_image import focal_length_px
from stages.detect.kernel import KernelDetect
from stages.detect.kernel_score import inner_half_px, kernel_terms, score_image
from stages.track.mean_shift import mean_shift
from stages.sweep import Sweep
from stages.track.mean_shift_track import MeanShiftTrack
from tests.stages.made import MS, ON_ITS_SIDE, START_NS, ball_seen, depth_image, detections, street_depth, swept

FOCAL = focal_length_px(512, 120.0)
RNG = np.random.default_rng(0)
IMAGES = {
    "street": street_depth(),
    "dense 8-20 m": RNG.uniform(8.0, 20.0, (512, 512)).astype(np.float32),
    "dense ceiling at 2 m": np.full((512, 512), 2.0, dtype=np.float32),
}


def plain_loop(depth_m):
    """The two boxes pixel by pixel, compiled: what `score_image` is compared with."""
    score = np.full(depth_m.shape, np.nan)
    for row, column in np.argwhere(depth_m > 0):
        half = inner_half_px(float(depth_m[row, column]), FOCAL, 0.5)
        score[row, column] = sum(kernel_terms(depth_m, row, column, half, 10, 0.1))
    return score


def shifted_numpy(depth_m):
    """The same sums with whole shifted images in numpy, as one would write it without a compiler."""
    half = (np.float32(0.5 * FOCAL) / np.maximum(depth_m, 1e-3) * np.float32(0.5)).astype(np.int32)
    half[depth_m == 0] = -1
    reach = max(10, int(half.max()))
    padded = np.pad(depth_m, reach)
    score = np.zeros_like(depth_m)
    height, width = depth_m.shape
    for dv in range(-reach, reach + 1):
        for du in range(-reach, reach + 1):
            there = padded[reach + dv : reach + dv + height, reach + du : reach + du + width]
            difference = np.abs(there - depth_m)
            ring = max(abs(dv), abs(du))
            score += np.where(ring <= half, difference, 0.0)
            if ring <= 10:
                score += np.where((ring > half) & (there > 0), 1.0 / np.maximum(difference, 0.1), 0.0)
    score[depth_m == 0] = np.nan
    return score


@pytest.mark.parametrize("image", IMAGES)
@pytest.mark.benchmark(group="kernel score")
def test_score_image(benchmark, image):
    benchmark(score_image, IMAGES[image], FOCAL, 0.5, 20, 0.1, 1.0)


@pytest.mark.benchmark(group="kernel score")
def test_score_plain_compiled_loop(benchmark):
    benchmark.pedantic(plain_loop, (IMAGES["street"],), rounds=2, warmup_rounds=1)


@pytest.mark.benchmark(group="kernel score")
def test_score_shifted_numpy(benchmark):
    benchmark.pedantic(shifted_numpy, (IMAGES["street"],), rounds=2)


@pytest.mark.parametrize("image", IMAGES)
@pytest.mark.benchmark(group="detect: score, minima, gates")
def test_detect(benchmark, image):
    stage, message = KernelDetect(), depth_image(IMAGES[image])
    benchmark(lambda: list(stage.on_image(message)))


@pytest.mark.parametrize("returns", [5, 100, 5000])
@pytest.mark.benchmark(group="mean shift, 10 iterations")
def test_mean_shift(benchmark, returns):
    points = RNG.normal(0.0, 0.4, (returns, 3))
    benchmark(mean_shift, points, np.array([0.6, 0.0, 0.0]), 10, 0.0)


@pytest.mark.parametrize("near", [5, 5000], ids=["5 hits", "5000 hits"])
@pytest.mark.benchmark(group="track, one frame of 90 slices")
def test_track_frame(benchmark, near):
    slices = []
    hits = np.sort(RNG.integers(0, 119 * MS, near))
    for first, last in pairwise(np.linspace(0, 119 * MS, 91).astype(int)):
        n = int(((hits >= first) & (hits < last)).sum())
        points = np.concatenate([RNG.normal([0, 0, 20], 0.3, (n, 3)), RNG.uniform(5, 50, (max(0, 280 - n), 3))])
        slices.append(swept(points, START_NS + first, RNG.integers(0, 16, len(points))))

    def frame():
        stage = MeanShiftTrack()
        stage.on_detections(detections([0.2, 0, 20]))
        return [m for part in slices for m in stage.on_points(part)] + list(stage.finish())

    assert len(benchmark(frame)) == 2


@pytest.mark.benchmark(group="sweep, 754 packets and 100 servo states")
def test_sweep_one_second(benchmark):
    messages = list(ball_seen(lambda t: (0.0, 0.0, 0.3), 40.0, lambda t: math.radians(68.4) * t, 1.0))
    for message in messages:  # a ball around the lidar gives no return: put all 384 on a dome
        if not hasattr(message, "goal_rad"):
            azimuth = message.azimuth_rad
            dome = np.c_[15 * np.sin(azimuth), 15 * np.cos(azimuth), RNG.uniform(-3, 3, azimuth.size)]
            object.__setattr__(message, "xyz_lidar_m", dome.astype(np.float32))
            object.__setattr__(message, "range_m", np.full(azimuth.size, 15.0, dtype=np.float32))

    def second():
        stage, made = Sweep(mount=ON_ITS_SIDE), 0
        for message in messages:
            for _ in stage.on_servo(message) if hasattr(message, "goal_rad") else stage.on_firings(message):
                made += 1
        return made

    assert benchmark(second) >= 753
