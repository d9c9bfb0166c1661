"""Time per packet, per sweep and per frame: `python -m pytest tests/benchmarks/bench_stages.py`.

Limits of the design: detection of a full 512 x 512 image 20 ms, a mean shift frame 2 ms, and sweep, detect and track of
10 ms of packets 1 ms median, one core.
"""

from __future__ import annotations

import json
from collections import defaultdict
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml

from links.dynamixel import Servo
from links.lidar import Lidar
from links.recording import RecordingReader
from stages.detect import KernelDetect
from stages.detect.paper.kernel_candidates import inner_half_px, score_image
from stages.geometry.frames import LidarMount
from stages.kernels.detect.kernel_score import kernel_terms
from stages.kernels.track.mean_shift import mean_shift
from stages.messages import Candidates, DepthImage, Detections, SweptPoints, SweptPulses
from stages.sweep.depth_image import focal_length_px
from stages.sweep.sweep import Sweep
from stages.track import LikelihoodTrack, MeanShiftTrack
from tests.stages.detect.shipped import detector
from tests.stages.made import MS, START_NS, depth_image, detections, street_depth, swept

RECORDING = Path(__file__).resolve().parents[2] / "recordings" / "street_sweep.mcap"
FROM_NS = 600 * MS  # of the recording: in the middle of its sweep
WARM = 60  # slices
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


# A recorded street: one round is 10 ms of packets, so the median is that of 10 ms, which have 7.5 packets: 1 ms is 133 us
# a packet. Limit of the design: 1 ms median for sweep, detect and track together. A message is a packet, or a slice.

SLICE_NS = 10 * MS


@pytest.fixture(scope="module", params=[0.1, 10.0], ids=["one packet a message", "slices"])
def street(request):
    """Per 10 ms the packets and servo states of the recording as they came; and where the drone was at the start."""
    servo, lidar, slices, drone = Servo(), Lidar(slice_ms=request.param), defaultdict(list), None
    with RecordingReader(RECORDING) as recording:
        rig = yaml.safe_load(recording.rig_yaml)
        start_ns = recording.start_ns + FROM_NS
        for record in recording.records():
            source = {"/lidar/packets": lidar, "/servo/state": servo}.get(record.topic)
            message = source.decode(record) if source else None
            if message is not None and record.arrival_ns >= start_ns:
                slices[(record.arrival_ns - start_ns) // SLICE_NS].append(message)
            if record.topic == "/truth/drone" and record.stamp_ns <= start_ns:
                drone = np.array(json.loads(record.data)["xyz_m"])  # the vehicle stands at the world's origin
    return LidarMount.model_validate(rig["lidar"]["mount"]), list(slices.values()), drone


def fed(stage, port, messages):
    """All that a stage gives out for some messages."""
    return [out for message in messages for out in getattr(stage, port)(message) or ()]


def swept_by(stage, messages):
    out = []
    for message in messages:
        out += stage.on_servo(message) if hasattr(message, "goal_rad") else stage.on_firings(message)
    return out


def of_kind(messages, kind):
    return [message for message in messages if isinstance(message, kind)]


def each_slice(benchmark, run, slices):
    """One round per slice, the stage living on; the first half second warms up compilers and caches."""
    for part in slices[:WARM]:
        run(part)
    rest = iter(slices[WARM:])
    benchmark.pedantic(run, setup=lambda: ((next(rest),), {}), rounds=len(slices) - WARM)
    benchmark.extra_info["us a packet"] = round(benchmark.stats.stats.median / 7.535 * 1e6)


def started(track, drone, stamp_ns):
    """The track with the drone it is to follow."""
    found = detections(drone, stamp_ns=stamp_ns)
    fed(track, "on_detections", [found])
    return track


@pytest.mark.benchmark(group="10 ms of packets: sweep")
def test_sweep(benchmark, street):
    mount, slices, _ = street
    stage = Sweep(mount=mount)
    each_slice(benchmark, lambda part: swept_by(stage, part), slices)


@pytest.mark.benchmark(group="10 ms of packets: detect")
def test_detect_by_evidence(benchmark, street):
    mount, slices, _ = street
    sweep, stage = Sweep(mount=mount), detector()
    pulses = [of_kind(swept_by(sweep, part), SweptPulses) for part in slices]
    each_slice(benchmark, lambda part: fed(stage, "on_pulses", part), pulses)


@pytest.mark.benchmark(group="10 ms of packets: detect")
def test_detect_by_kernel_once_a_sweep(benchmark, street):
    """Nothing to do but at the end of a sweep: see its own benchmark for that."""
    mount, slices, _ = street
    sweep, stage = Sweep(mount=mount), KernelDetect()
    images = [of_kind(swept_by(sweep, part), DepthImage) for part in slices]
    each_slice(benchmark, lambda part: fed(stage, "on_image", part), images)


@pytest.mark.benchmark(group="10 ms of packets: track")
def test_track_by_returns_and_pass_throughs(benchmark, street):
    mount, slices, drone = street
    sweep = Sweep(mount=mount)
    pulses = [of_kind(swept_by(sweep, part), SweptPulses) for part in slices]
    stage = started(LikelihoodTrack(lost_after_s=60.0), drone, pulses[0][0].stamp_ns)
    each_slice(benchmark, lambda part: fed(stage, "on_pulses", part), pulses)
    assert len(stage._hypotheses)


@pytest.mark.benchmark(group="10 ms of packets: track")
def test_track_by_mean_shift(benchmark, street):
    mount, slices, drone = street
    sweep = Sweep(mount=mount)
    points = [of_kind(swept_by(sweep, part), SweptPoints) for part in slices]
    stage = started(MeanShiftTrack(lost_after_s=60.0), drone, points[0][0].stamp_ns)
    each_slice(benchmark, lambda part: fed(stage, "on_points", part), points)


@pytest.mark.benchmark(group="10 ms of packets: all three")
def test_product_stages_together(benchmark, street):
    mount, slices, drone = street
    sweep, detect, track = Sweep(mount=mount), detector(), LikelihoodTrack(lost_after_s=60.0)
    started(track, drone, slices[0][0].stamp_ns)

    def run(part):
        for pulses in of_kind(swept_by(sweep, part), SweptPulses):
            for found in detect.on_pulses(pulses):
                list(track.on_candidates(found) if isinstance(found, Candidates) else track.on_detections(found))
            list(track.on_pulses(pulses))

    each_slice(benchmark, run, slices)


@pytest.mark.benchmark(group="10 ms of packets: all three")
def test_paper_stages_together(benchmark, street):
    mount, slices, drone = street
    sweep, detect, track = Sweep(mount=mount), KernelDetect(), MeanShiftTrack(lost_after_s=60.0)
    started(track, drone, slices[0][0].stamp_ns)

    def run(part):
        swept_messages = swept_by(sweep, part)
        for image in of_kind(swept_messages, DepthImage):
            fed(track, "on_detections", of_kind(fed(detect, "on_image", [image]), Detections))
        fed(track, "on_points", of_kind(swept_messages, SweptPoints))

    each_slice(benchmark, run, slices)
