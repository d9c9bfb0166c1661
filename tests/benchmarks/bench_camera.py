"""Camera frames and lenses. The ratio of a frame's time and its period is the simulator's slowdown against real time.

    python -m pytest tests/benchmarks/bench_camera.py --benchmark-columns=min,median,iqr,rounds

Pin it to one core (`taskset -c 0`). Two cameras at 10 Hz make 20 frames a simulated second. Compared with grd's lens: cv2.fisheye,
which is another model's twin only below 90 deg, on the same 100 000 rays up to 80 deg.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from flow.link import Record
from links.camera import Camera as CameraLink
from links.recording import CompressedImage, encode_compressed_image
from links.simulated.rig.run import Simulation
from links.simulated.rig.scenario import Scenario, load_scenario
from links.simulated.sensors.camera import Camera
from links.simulated.sensors.camera_sensor import encode_jpeg
from stages.geometry.lens import Equidistant, KannalaBrandt, OCam

SCENARIO = Path(__file__).resolve().parents[2] / "configs" / "scenarios" / "street_sweep.yaml"
KANNALA_BRANDT = KannalaBrandt(focal_px=(170.0, 171.0), centre_px=(360.5, 359.0), k=(0.02, -0.01, 0.002, -0.0003))
LENSES = [
    Equidistant(focal_px=175.0, centre_px=(359.5, 359.5)),
    KANNALA_BRANDT,
    OCam(polynomial=(-135.8, 0.0, -5.48e-06, 7.36e-06, -6.4e-09), centre_px=(364.0, 364.0), max_off_axis_deg=100.0),
]


def scenario(kind: str, size_px: int) -> Scenario:
    cameras = {"vehicle": {"size_px": size_px}, "drone": {"size_px": size_px}}
    return load_scenario(SCENARIO).changed(scene={"kind": kind}, cameras=cameras)


def cameras(kind: str, size_px: int) -> tuple[Camera, Camera]:
    vehicle, drone = Simulation(scenario(kind, size_px))._cameras
    return vehicle, drone


@pytest.mark.parametrize("kind", ["street", "manhattan", "park_edge"])
@pytest.mark.parametrize("platform", ["vehicle", "drone"])
@pytest.mark.parametrize("size_px", [720, 1440])
def test_one_frame(benchmark, kind, platform, size_px):
    camera = dict(zip(("vehicle", "drone"), cameras(kind, size_px), strict=True))[platform]
    stamp_ns = load_scenario(SCENARIO).start_ns + 10**9
    benchmark.pedantic(camera.image, args=(stamp_ns,), rounds=4, warmup_rounds=1)


def test_half_a_second_of_lidar_and_two_cameras_at_10_hz(benchmark):
    def run():
        return sum(1 for _ in Simulation(scenario("street", 720).changed(duration_s=0.5)).records())

    benchmark.pedantic(run, rounds=2, warmup_rounds=1)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
@pytest.mark.parametrize("direction", ["project", "unproject"])
def test_100_000_rays(benchmark, lens, direction):
    rays = _rays(80.0)
    argument = rays if direction == "project" else lens.project(rays)
    benchmark(getattr(lens, direction), argument)


@pytest.mark.parametrize("direction", ["project", "unproject"])
def test_100_000_rays_by_cv2_fisheye_below_80_deg(benchmark, direction):
    K = np.array([[170.0, 0, 360.5], [0, 171.0, 359.0], [0, 0, 1]])
    D = np.array(KANNALA_BRANDT.k)
    rays = _rays(80.0)
    pixels = KANNALA_BRANDT.project(rays)[:, None]
    if direction == "project":
        benchmark(cv2.fisheye.projectPoints, rays[:, None], np.zeros(3), np.zeros(3), K, D)
    else:
        benchmark(cv2.fisheye.undistortPoints, pixels, K, D)


@pytest.mark.parametrize("size_px", [720, 1440])
def test_decode_a_frame_in_grey(benchmark, size_px):
    image = cameras("street", size_px)[0].image(load_scenario(SCENARIO).start_ns + 10**9)
    frame = CompressedImage(0, "camera_vehicle", encode_jpeg(image, 90))
    record = Record("/camera/vehicle", 0, 0, encode_compressed_image(frame))
    benchmark(CameraLink(topic="/camera/vehicle").decode, record)


def _rays(limit_deg: float) -> np.ndarray:
    rng = np.random.default_rng(1)
    theta, phi = np.radians(rng.uniform(0.0, limit_deg, 100_000)), rng.uniform(0.0, 2 * np.pi, 100_000)
    return np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
