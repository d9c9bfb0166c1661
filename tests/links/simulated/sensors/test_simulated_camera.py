"""The fisheyes: geometry and timing of images, and how light becomes bytes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from camera_scenes import QUIET, START_NS, centroid, cube, moving, pixel_of, redness, scene_cameras, still
from pydantic import ValidationError

from links.camera import Camera as CameraLink
from links.simulated.kernels.camera_paint import _overlap, _stripes
from links.simulated.rig.scenario import load_scenario
from links.simulated.sensors.camera import CameraSettings, CamerasSettings
from links.simulated.sensors.camera_paint import MATERIALS, _material_table, faces_of
from links.simulated.sensors.camera_sensor import ELECTRONS_PER_S, GAMMA, GREY, SensorSettings, auto_exposure, develop
from links.simulated.sensors.camera_view import Shutter
from links.simulated.world.mesh import SURFACES, box, quads
from links.simulated.world.weather import Weather

OVERCAST = Weather(rain_mmph=2.0)  # no sun: light from all sides
STAMP_NS = START_NS + 500_000_000
LENSES = {
    "equidistant": None,
    "kannala_brandt": {
        "model": "kannala_brandt",
        "focal_px": [86.0, 87.0],
        "centre_px": [178.0, 181.0],
        "k": [0.01, -0.002, 0.0, 0.0],
    },
    "ocam": {
        "model": "ocam",
        "polynomial": [-67.9243, 0.0, -1.0967e-05, 2.94550e-05, -5.13589e-08],
        "centre_px": [181.8, 181.9],
        "affine_cde": [1.001407, -0.000818, 0.000221],
        "max_off_axis_deg": 105.0,
    },
}


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("position", [(6, 0, 3), (0, 6, 2), (-4, -5, 2), (5, -4, 0.3), (3, 3, 9), (9, 1, -0.9)])
def test_the_vehicle_sees_an_object_at_the_pixel_of_the_lens_model(lens, position):
    """Level and below the horizon too: (9, 1, -0.9) is 95.7 deg off the axis."""
    camera = scene_cameras([cube(position, 0.1)], lens=LENSES[lens], weather=OVERCAST)["vehicle"]
    seen = centroid(redness(camera.image(STAMP_NS)))
    np.testing.assert_allclose(seen, pixel_of(camera, position, STAMP_NS), atol=0.5)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("yaw_deg", [0.0, 70.0, -135.0])
def test_a_tilted_drone_sees_an_object_at_the_pixel_of_the_lens_model(lens, yaw_deg):
    position = (3.0, -2.5, -1.3)
    drone = moving((0, 0, 6), (6, -4, 7), (yaw_deg, yaw_deg + 20))  # accelerates: it is not level
    camera = scene_cameras([cube(position, 0.1)], drone=drone, lens=LENSES[lens], weather=OVERCAST)["drone"]
    image = redness(camera.image(STAMP_NS))
    np.testing.assert_allclose(centroid(image), pixel_of(camera, position, STAMP_NS), atol=0.5)


@pytest.mark.parametrize(
    "at", [(5, 3, 8), (0.5, -7, 3), *(pytest.param(at, marks=pytest.mark.slow) for at in ((-6, 1, 5), (2, -3, 12)))]
)
def test_the_vehicle_sees_the_drone_at_the_pixel_of_the_lens_model(at):
    settings = {"size_px": 720, "sensor": QUIET | {"exposure_ms": 0.5, "max_gain": 1.0}, "weather": OVERCAST}
    camera, without = (scene_cameras([], drone=drone, **settings)["vehicle"] for drone in (still(at), None))
    difference = np.abs(camera.image(STAMP_NS).astype(float) - without.image(STAMP_NS)).sum(axis=2)
    difference[difference < 9] = 0.0
    np.testing.assert_allclose(centroid(difference), pixel_of(camera, at, STAMP_NS), atol=1.0)


def test_the_drone_sees_the_vehicle_below():
    cameras = scene_cameras([], drone=still((2, 1, 6)))
    image = cameras["drone"].image(STAMP_NS)
    column, row = np.rint(pixel_of(cameras["drone"], (-0.9, 0.5, -0.15), STAMP_NS)).astype(int)  # on its roof
    next_to = np.rint(pixel_of(cameras["drone"], (-0.9, -4.0, -1.8), STAMP_NS)).astype(int)
    assert image[row, column].mean() > image[next_to[1], next_to[0]].mean() + 15


def test_the_vehicles_image_has_forward_at_the_top_and_left_on_the_right():
    for position, expected in (((6, 0, 6), (0, -1)), ((0, 6, 6), (1, 0)), ((-6, 1.2, 6), (0.2, 1))):
        camera = scene_cameras([cube(position)])["vehicle"]
        offset = centroid(redness(camera.image(STAMP_NS))) - (360 - 1) / 2
        np.testing.assert_allclose(offset / np.linalg.norm(offset), expected / np.linalg.norm(expected), atol=0.02)


def test_the_drones_image_has_forward_at_the_top_and_right_on_the_right():
    for position, expected in (((6, 0, 0), (0, -1)), ((0, -6, 0), (1, 0)), ((0.3, 6, 0), (-1, 0))):
        camera = scene_cameras([cube(position)], drone=still((0, 0, 6)))["drone"]
        offset = centroid(redness(camera.image(STAMP_NS))) - (360 - 1) / 2
        np.testing.assert_allclose(offset / np.linalg.norm(offset), expected, atol=0.06)


def test_the_cameras_see_their_own_mounts_and_nothing_outside_the_circle():
    cameras = scene_cameras([], drone=still((0, 0, 60)))
    up, down = (cameras[name].image(STAMP_NS).astype(float) for name in ("vehicle", "drone"))
    assert up[180, 180].mean() < 0.75 * up[180, 120].mean()  # the LiDAR above is dark against the sky
    legs = redness(down) * 0 + (down.mean(axis=2) < 40)
    row, column = np.mgrid[:360, :360]
    inside = np.hypot(row - 179.5, column - 179.5) < 150
    assert 0.02 < legs[inside].mean() < 0.3
    outside = np.hypot(row - 179.5, column - 179.5) > 180
    assert up[outside].max() == down[outside].max() == 0


def test_a_rolling_shutter_sees_each_row_at_its_own_time():
    """A vehicle that turns at 90 deg/s: an object 120 px from the centre moves 188 px/s across; the top row is early."""
    position, readout_ms = (8, 0, 1.2), 60.0
    turn = moving((0, 0, 0), (0, 0, 0), (-45, 45))
    sensor = QUIET | {"exposure_ms": 0.2}
    slow, fast = (
        scene_cameras([cube(position, 0.3)], turn, readout_ms=r, sensor=sensor)["vehicle"] for r in (readout_ms, 0.0)
    )
    seen = {c: centroid(redness(c.image(STAMP_NS))) for c in (slow, fast)}
    at_ns = STAMP_NS
    for _ in range(5):  # the row depends on the time, the time on the row
        expected = pixel_of(slow, position, at_ns)
        at_ns = STAMP_NS + round((expected[1] - 179.5) / 360 * readout_ms * 1e6)
    np.testing.assert_allclose(seen[fast], pixel_of(fast, position, STAMP_NS), atol=0.5)
    np.testing.assert_allclose(seen[slow], expected, atol=0.5)
    shift = np.linalg.norm(seen[slow] - seen[fast])
    assert shift > 2.0
    assert shift == pytest.approx(np.linalg.norm(expected - pixel_of(fast, position, STAMP_NS)), abs=0.3)


def test_rows_are_exposed_about_the_stamp_and_parts_fill_the_exposure():
    moments, per_row = Shutter(STAMP_NS, 4e-3, 1e-4).moments(101, 4)
    assert per_row == 4
    assert moments[50 * 4 : 51 * 4].tolist() == [STAMP_NS + n for n in (-1_500_000, -500_000, 500_000, 1_500_000)]
    assert moments[0] - moments[400] == -10_000_000
    assert Shutter(STAMP_NS, 4e-3, 0.0).moments(101, 1) == (np.array([STAMP_NS]), 0)


def test_a_long_exposure_blurs_moving_objects():
    turn = moving((0, 0, 0), (0, 0, 0), (-45, 45))
    variances = []
    for exposure_ms in (1.0, 30.0):
        sensor = QUIET | {"exposure_ms": exposure_ms, "full_well_e": 10_000 * exposure_ms, "max_gain": 1.0}
        cube_there, empty = (
            scene_cameras(things, turn, sensor=sensor, weather=OVERCAST)["vehicle"]
            for things in ([cube((8, 0, 2.2), 0.3)], [])
        )
        here, there = (c.image(STAMP_NS)[30:90, 150:210].astype(float) ** GAMMA for c in (cube_there, empty))
        across = np.abs(here - there).sum(axis=(0, 2))  # the object is at the top and moves sideways
        column = np.arange(60.0)
        mean = (across * column).sum() / across.sum()
        variances.append((across * (column - mean) ** 2).sum() / across.sum())
    radius_px = 179.5 - pixel_of(cube_there, (8, 0, 2.2), STAMP_NS)[1]
    smear_px = math.radians(90) * 0.030 * radius_px
    assert smear_px > 4
    assert variances[1] - variances[0] == pytest.approx(smear_px**2 / 12, rel=0.15)


def test_an_object_casts_its_shadow_away_from_the_sun():
    weather = Weather(sun_elevation_deg=45.0, sun_azimuth_deg=90.0)  # from +y
    camera = scene_cameras([cube((0, 10, 0.0), 0.5)], drone=still((0, 10, 8)), weather=weather)["drone"]
    image = camera.image(STAMP_NS).astype(float).mean(axis=2)
    shadow, lit = (pixel_of(camera, (0.0, 10.0 + side * 1.8, -1.8), STAMP_NS) for side in (-1, 1))
    (sx, sy), (lx, ly) = np.rint(shadow).astype(int), np.rint(lit).astype(int)
    assert image[sy, sx] < 0.7 * image[ly, lx]


def test_both_sides_of_a_face_can_be_lit():
    """The order of a triangle's corners does not define its outside."""
    corners = [(-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)]
    for face in (corners, corners[::-1]):
        scene = scene_cameras([quads([face], "plaster")])["vehicle"]._view.scene
        origins = np.array([(0.3, 0.2, 5.0), (0.3, 0.2, 0.5)], dtype=np.float32)
        directions = np.array([(0, 0, -1), (0, 0, 1)], dtype=np.float32)
        samples = scene.trace(origins, directions, np.zeros(2, np.int64), np.array([STAMP_NS]))
        np.testing.assert_allclose(samples.ranges, [4.0, 0.5], rtol=1e-6)
        assert samples.lit.tolist() == [True, False]


def test_haze_hides_distant_objects():
    far, near = (40.0, 10.0, 2.0), (6.0, -2.0, 0.5)
    clear, hazy = (
        scene_cameras([cube(far, 2.0), cube(near, 0.5)], weather=Weather(visibility_m=v))["vehicle"]
        for v in (None, 120.0)
    )
    redder = []
    for camera in (clear, hazy):
        image = redness(camera.image(STAMP_NS))
        redder.append([image[tuple(np.rint(pixel_of(camera, p, STAMP_NS)).astype(int)[::-1])] for p in (far, near)])
    (far_clear, near_clear), (far_hazy, near_hazy) = redder
    assert far_hazy < 0.4 * far_clear
    assert near_hazy > 0.5 * near_clear


def test_dusk_takes_a_longer_exposure_then_gain():
    s = SensorSettings(max_exposure_ms=10.0, max_gain=16.0)
    full_well_s = GREY * s.full_well_e / ELECTRONS_PER_S
    assert auto_exposure(s, 0.3) == pytest.approx((full_well_s / 0.3, 1.0))
    assert auto_exposure(s, 0.003) == pytest.approx((0.010, full_well_s / 0.003 / 0.010))
    assert auto_exposure(s, 1e-9) == (0.010, 16.0)
    assert auto_exposure(SensorSettings(exposure_ms=2.0), 0.3) == (0.002, 1.0)


def test_noise_is_shot_and_read_noise_in_electrons():
    """sigma^2 = e + read^2, seen through the gain; undone here by inverting gamma."""
    s = SensorSettings(full_well_e=10_000, read_noise_e=30.0)
    for radiance in (0.1, 0.4):
        image = develop(np.full((200, 200, 3), radiance, np.float32), s, 1e-3, 1.0, np.random.default_rng(1))
        electrons = (image / 255.0) ** GAMMA * 10_000
        expected = radiance * ELECTRONS_PER_S * 1e-3
        assert electrons.mean() == pytest.approx(expected, rel=0.01)
        assert electrons.std() == pytest.approx(math.sqrt(expected + 30.0**2), rel=0.08)


def test_stripes_are_averaged_over_the_sample():
    assert _stripes(0.1, 1.0, 0.25, 1e-6) == pytest.approx(1.0, abs=1e-6)
    assert _stripes(0.5, 1.0, 0.25, 1e-6) == pytest.approx(0.0, abs=1e-6)
    assert _stripes(0.25, 1.0, 0.25, 0.1) == pytest.approx(0.5)  # half of the sample on the stripe's edge
    assert _stripes(-3.3, 1.0, 0.25, 4.0) == pytest.approx(0.25)  # whole periods: the mean
    assert _overlap(0.0, -0.5, 0.1, 0.4) == pytest.approx(0.75)


def test_a_window_has_its_sides_and_an_odd_triangle_has_none():
    faces = faces_of(quads([[(0, 0, 0), (2, 0, 0), (2, 0, 1.5), (0, 0, 1.5)]], "glass"))
    assert faces.half.tolist() == [0, 1]
    np.testing.assert_allclose(faces.side_m, [[2, 1.5], [2, 1.5]])
    np.testing.assert_allclose(np.abs(faces.normal), [[0, 1, 0], [0, 1, 0]])
    assert (faces_of(box((0, 0, 0), (1, 1, 1), "brick")).half.reshape(-1, 2) == [0, 1]).all()


def _drive():
    settings = {"size_px": 120, "readout_ms": 8.0, "sensor": {}}
    return scene_cameras([cube((6, 0, 3))], moving((0, 0, 0), (6, 0, 0)), moving((0, 0, 6), (5, 1, 6)), **settings)


def test_frames_come_once_in_order_and_after_their_stamp():
    whole, parts = _drive()["vehicle"], _drive()["vehicle"]
    records = whole.records(START_NS + 10**9)
    again = [r for until in range(0, 10**9 + 1, 43_000_000) for r in parts.records(START_NS + until)]
    again += parts.records(START_NS + 10**9)
    assert again == records
    assert len(records) in (9, 10)
    assert {r.topic for r in records} == {"/camera/vehicle"}
    stamps = np.array([r.stamp_ns for r in records])
    assert abs(np.diff(stamps) - 1e8).max() < 4e5
    latency_ms = np.array([r.arrival_ns - r.stamp_ns for r in records]) / 1e6
    assert latency_ms.min() > 30 + 4
    assert latency_ms.max() < 80 + 4 + 7.5
    assert latency_ms.std() > 1


def test_the_same_seed_gives_the_same_bytes():
    for name in ("vehicle", "drone"):
        one, two = (_drive()[name].records(START_NS + 3 * 10**8) for _ in range(2))
        assert one == two
    other = scene_cameras([], size_px=120, sensor={}, seed=2)["vehicle"].records(START_NS + 3 * 10**8)
    assert other[0].data != one[0].data


def test_a_recorded_frame_decodes_to_the_image_that_was_made():
    camera = _drive()["drone"]
    record = camera.records(START_NS + 3 * 10**8)[0]
    message = CameraLink(topic="/camera/drone").decode(record)
    assert message is not None
    assert (message.stamp_ns, message.frame_id, message.grey.shape) == (record.stamp_ns, "camera_drone", (120, 120))
    made = camera.image(record.stamp_ns, 0) @ [0.299, 0.587, 0.114]
    assert np.abs(message.grey - made).mean() < 6  # noise, smoothed by the compression


def test_the_rig_file_has_each_camera_with_pose_and_lens(tmp_path):
    base = "version: 1\nname: x\nstart_utc: 2025-06-01T10:20:30Z\nduration_s: 1\n"
    file = tmp_path / "s.yaml"
    file.write_text(base)
    assert "cameras" not in load_scenario(file).rig_yaml()
    flight = "drone: {path: {waypoints: [{t_s: 0, xyz_m: [0, 0, 9]}]}}\n"
    file.write_text(base + flight + "cameras: {vehicle: {}, drone: {size_px: 1000}}\n")
    rig = load_scenario(file).rig_yaml()
    for text in ("T_vehicle_camera", "T_drone_camera", "model: equidistant", "size_px: 1000"):
        assert text in rig
    file.write_text(base + "cameras: {drone: {}}\n")
    assert "T_drone_camera" not in load_scenario(file).rig_yaml()


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"rate_hz": 15, "readout_ms": 60.0}, "exposure and readout take 75 ms, the period is 66.6667 ms"),
        ({"latency_ms": [80, 30]}, "shortest and the longest"),
        ({"size_px": 5000}, "less than or equal to 1440"),
        ({"fov_deg": 235}, "Extra inputs"),
        ({"lens": {"model": "fisheye"}}, "equidistant"),
    ],
)
def test_an_impossible_camera_is_rejected(settings, text):
    with pytest.raises(ValidationError, match=text):
        CamerasSettings.model_validate({"vehicle": settings})


def test_a_default_camera_sees_235_deg_in_its_image():
    for size in (360, 720, 1440):
        lens = CameraSettings(size_px=size).true_lens
        assert lens.max_off_axis_deg == 117.5
        assert size / 2 - 3 < lens.circle_px < size / 2


def test_a_surface_without_a_material_is_as_grey_as_its_reflectivity():
    assert set(MATERIALS) <= set(SURFACES)
    kinds, colours, others = _material_table({"moss": (0.25, 0.1)})
    assert (kinds.tolist(), colours.tolist(), others.tolist()) == ([0], [[0.25] * 3], [[0.25] * 3])
