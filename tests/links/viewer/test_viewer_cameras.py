"""Images with their lines: positions, colours, and the text without directions."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
import synthetic_vision
from drawing import document, drawn, numbers, scene, values_of
from pydantic import ValidationError
from rerun.chunk import RrdReader
from synthetic_vision import camera_image, directions, one_line

from flow.link import Run
from links.viewer import Viewer, colours
from links.viewer.draw import draw
from links.viewer.draw_cameras import direction_colours
from links.viewer.entities import strip_batch
from links.viewer.lenses import arcs, strips
from stages.geometry.rig import RigCameras
from stages.messages import CameraMount, FollowedFeatures

VP, LINES = "vp_vehicle/vanishing_directions", "camera/camera_vehicle/vp_vehicle/vanishing_directions/lines"


def camera_scene(**changes):
    return scene(cameras=synthetic_vision.CAMERAS, **changes)


def test_an_arc_lies_on_its_great_circle_from_end_to_end_in_equal_steps():
    a, b = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.6, 0.8])
    points, arc = arcs(np.array([[a, b]]), step_rad=np.deg2rad(20.0))
    np.testing.assert_array_equal(arc, np.zeros(6, int))  # 90 deg: 2 + floor(4.5) points
    np.testing.assert_allclose(points[[0, -1]], [a, b], atol=1e-12)
    np.testing.assert_allclose(points @ np.cross(a, b), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.sum(points[1:] * points[:-1], axis=1), np.cos(np.deg2rad(18.0)), atol=1e-12)


def test_arcs_of_any_length_keep_their_order_and_a_point_is_an_arc():
    z = np.array([0.0, 0.0, 1.0])
    points, arc = arcs(np.array([[z, z], [z, [1.0, 0.0, 0.0]]]), step_rad=np.deg2rad(50.0))
    np.testing.assert_array_equal(arc, [0, 0, 1, 1, 1])
    h = np.sqrt(0.5)
    np.testing.assert_allclose(points, [z, z, z, [h, 0.0, h], [1.0, 0.0, 0.0]], atol=1e-12)
    nothing, none = arcs(np.zeros((0, 2, 3)))
    assert nothing.shape == (0, 3)
    assert len(none) == 0


def test_a_strip_is_split_at_points_outside_the_field_of_view():
    nan = np.nan
    points = np.array([[0.0, 0], [1, 0], [nan, nan], [3, 0], [4, 0], [5, 5], [nan, nan], [7, 7], [8, 8]])
    drawn, lengths, owner = strips(points, np.array([0, 0, 0, 0, 0, 1, 1, 2, 2]))
    parts = [[[0, 0], [1, 0]], [[3, 0], [4, 0]], [[7, 7], [8, 8]]]
    assert drawn.tolist() == [point for part in parts for point in part]
    assert strip_batch(drawn, lengths).to_pylist() == parts
    np.testing.assert_array_equal(owner, [0, 0, 2])
    for gone in (np.full((3, 2), nan), np.zeros((0, 2))):
        drawn, lengths, owner = strips(gone, np.zeros(len(gone), int))
        assert (len(lengths), len(owner), strip_batch(drawn, lengths).to_pylist()) == (0, 0, [])


def test_an_image_is_a_small_jpeg_of_its_camera():
    entities = drawn(camera_image(), "camera_vehicle/image", camera_scene())
    assert set(entities) == {"camera/camera_vehicle/image"}
    shown = entities["camera/camera_vehicle/image"].archetypes[0]
    assert values_of(shown.media_type) == ["image/jpeg"]
    data = np.frombuffer(bytes(shown.blob.as_arrow_array().to_pylist()[0]), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    assert image.shape == (480, 480)
    assert data.size < 30_000
    np.testing.assert_allclose(image[240].astype(float), np.linspace(30, 220, 480), atol=4.0)


def test_an_image_is_never_enlarged_and_keeps_its_shape():
    where = camera_scene()
    drawn(dataclasses.replace(camera_image(), grey=np.zeros((300, 960), np.uint8)), "x/image", where)
    np.testing.assert_allclose(
        where.images["camera_vehicle"].scaled(np.array([[-0.5, -0.5], [959.5, 299.5]])), [[0, 0], [480, 150]]
    )
    small = camera_image(1, size_px=64)
    drawn(small, "x/image", where)
    assert where.images["camera_vehicle"].scale == 1.0


def test_a_live_run_logs_some_of_the_images_and_a_lossless_one_all():
    for every_s, count in ((0.0, 10), (0.2, 5)):
        where = camera_scene(image_period_s=every_s)
        shown = [drawn(camera_image(k * 100_000_000), "camera_vehicle/image", where) for k in range(10)]
        assert sum(map(bool, shown)) == count
        assert drawn(camera_image(0, "camera_drone"), "camera_drone/image", where)  # each camera by itself
        assert drawn(camera_image(0), "camera_vehicle/image", where)  # the time jumped back


def test_a_line_is_drawn_at_the_projection_of_its_rays():
    where = camera_scene()
    drawn(camera_image(), "camera_vehicle/image", where)
    low, high = np.deg2rad(95.0), np.deg2rad(30.0)  # off the axis, which is up
    ends = np.array([[np.sin(low), 0, np.cos(low)], [np.sin(high), 0, np.cos(high)]])  # towards the vehicle's front
    entities = drawn(one_line(ends), VP, where)
    (strip,) = numbers(entities[LINES].archetypes[0].strips)
    # Rz(90 deg): x_camera = y_vehicle, y_camera = -x_vehicle. r = f theta; 480 of 720 px, pixel centres at + 0.5
    away = (2 / 3) * synthetic_vision.FOCAL_PX * np.array([low, high])
    np.testing.assert_allclose(strip[[0, -1]], np.stack([[240.0, 240.0], 240.0 - away], axis=1), atol=1e-3)
    np.testing.assert_allclose(strip[:, 0], 240.0, atol=1e-3)  # a line through the axis stays straight
    points = numbers(entities[LINES.replace("lines", "points")].archetypes[0].positions)
    np.testing.assert_allclose(
        points, [[240.0, 240.0]], atol=1e-3
    )  # the zenith; the nadir is outside the field of view


def test_the_drones_camera_points_down():
    where = camera_scene()
    drawn(camera_image(0, "camera_drone"), "camera_drone/image", where)
    ends = np.array([[0.0, 0.0, -1.0], [np.sin(0.5), 0.0, -np.cos(0.5)]])
    entities = drawn(one_line(ends, camera_mount=CameraMount.DRONE), "vp_drone/vanishing_directions", where)
    (strip,) = numbers(entities["camera/camera_drone/vp_drone/vanishing_directions/lines"].archetypes[0].strips)
    R = synthetic_vision.CAMERAS.of(CameraMount.DRONE).pose().matrix()[:3, :3]
    ahead = R.T @ [1.0, 0.0, 0.0]
    expected = 240.0 + (2 / 3) * synthetic_vision.FOCAL_PX * 0.5 * ahead[:2]
    np.testing.assert_allclose(strip[0], [240.0, 240.0], atol=1e-3)
    np.testing.assert_allclose(strip[-1], expected, atol=1e-3)
    entities = {"sphere": entities["sphere/vp_drone/vanishing_directions/directions"]}
    assert entities["sphere"].frame == "sphere_drone"


def test_each_line_has_the_colour_of_its_direction():
    full, pale = colours.PAIRS[0]
    second = colours.PAIRS[1]
    expected = [colours.VERTICAL, full, pale, second[1], second[0]]  # in each pair the one nearer to x is saturated
    np.testing.assert_array_equal(direction_colours(directions()), expected)
    where = camera_scene()
    drawn(camera_image(), "camera_vehicle/image", where)
    message = directions()
    entities = drawn(message, VP, where)
    on_sphere = numbers(entities[f"sphere/{VP}/lines"].archetypes[0].colors)
    np.testing.assert_array_equal(on_sphere, np.repeat([*expected, colours.UNASSIGNED], 5))
    through = entities[f"sphere/{VP}/directions"]
    assert through.frame == "sphere_vehicle"
    np.testing.assert_array_equal(numbers(through.archetypes[0].colors), expected)
    np.testing.assert_allclose(numbers(through.archetypes[0].strips)[1], [[-1.15, 0, 0], [1.15, 0, 0]], atol=1e-6)
    assert len({int(c) for c in numbers(entities[LINES].archetypes[0].colors)}) == 6


def test_a_pair_keeps_its_colours_when_its_directions_change_order():
    message = directions(count=3)
    turned = dataclasses.replace(message, direction=-message.direction[[0, 2, 1]])
    np.testing.assert_array_equal(direction_colours(turned), direction_colours(message)[[0, 2, 1]])
    many = dataclasses.replace(directions(count=2), frame=np.array([-1, 7]))
    assert direction_colours(many)[1] == colours.PAIRS[7 % len(colours.PAIRS)][0]


def test_an_image_without_directions_shows_the_reason_and_logs_it_once():
    where = camera_scene()
    logged = []
    for k, count in enumerate((3, 0, 0, 3)):
        drawn(camera_image(k), "camera_vehicle/image", where)
        entities = drawn(directions(k, count=count), VP, where)
        on_it = values_of(entities[LINES.replace("lines", "reason")].archetypes[0].labels) or []
        assert on_it == ([] if count else ["no structure: 5 lines, a pair needs 4"])
        logged += [values_of(entities[f"log/{VP}"].archetypes[0].text)[0]] if f"log/{VP}" in entities else []
        states = values_of(entities["states/vp_vehicle"].archetypes[0].state) if "states/vp_vehicle" in entities else []
        assert states == [["directions"], ["no directions"], [], ["directions"]][k]
    assert logged[0] == "no structure: 5 lines, a pair needs 4"
    assert logged[1:] == ["found again: vertical +-0.10 deg, pair 1 +-0.20 deg, pair 1 +-0.30 deg; 15 of 20 lines"]
    np.testing.assert_allclose(entities[f"plots/other/{VP}/lines"].values, [20, 15])
    np.testing.assert_allclose(entities[f"plots/other/{VP}/sigma"].values, [0.1, 0.3])
    assert "**vp_vehicle:** vertical" in document(entities["status"])


def test_an_image_without_lines_is_drawn():
    where = camera_scene()
    drawn(camera_image(), "camera_vehicle/image", where)
    empty = directions(count=0)
    none = {name: getattr(empty, name)[:0] for name in ("line_end", "line_normal", "line_sigma_rad", "line_direction")}
    entities = drawn(dataclasses.replace(empty, **none), VP, where)
    assert len(entities[LINES].archetypes[0].strips.as_arrow_array()) == 0


def test_lines_are_drawn_on_the_image_of_their_stamp_only():
    where = camera_scene(image_period_s=0.2)
    drawn(camera_image(0), "camera_vehicle/image", where)
    assert LINES in drawn(directions(0), VP, where)
    drawn(camera_image(100_000_000), "camera_vehicle/image", where)  # not logged
    entities = drawn(directions(100_000_000), VP, where)
    assert LINES not in entities
    assert f"sphere/{VP}/lines" in entities


def test_an_image_without_a_lens_names_the_setting_and_the_rest_is_drawn():
    where = scene()
    drawn(camera_image(), "camera_vehicle/image", where)
    paths = []

    def draw_all() -> None:
        for entity in draw(directions(), VP, where):
            paths.append(entity.path)

    with pytest.raises(LookupError, match=r"no lens for the image of camera_vehicle.*cameras: \$rig\.cameras"):
        draw_all()
    assert f"sphere/{VP}/lines" in paths


def test_a_lens_of_another_image_size_is_rejected():
    where = camera_scene()
    drawn(camera_image(size_px=480), "camera_vehicle/image", where)
    with pytest.raises(ValueError, match="480 px wide, its lens in `cameras` is for 720"):
        drawn(directions(), VP, where)


def test_the_cameras_of_the_rig_are_valid_and_a_wrong_one_is_named():
    assert synthetic_vision.CAMERAS.frame_ids() == ["camera_vehicle", "camera_drone"]
    assert RigCameras().frame_ids() == []
    swapped = {"vehicle": synthetic_vision.RIG_CAMERAS["drone"]}
    with pytest.raises(ValidationError, match="T_vehicle_camera"):
        RigCameras.model_validate(swapped)
    with pytest.raises(ValidationError, match="left"):
        RigCameras.model_validate({"left": synthetic_vision.RIG_CAMERAS["drone"]})


def record(folder, viewer, mermaid=synthetic_vision.MERMAID, seconds=0.35):
    viewer.open(Run(out_dir=folder, name="test", mermaid=mermaid, settings_yaml=""))
    for output, content in synthetic_vision.run(seconds):
        viewer.see(output, content, 0)
    viewer.close()
    chunks = list(RrdReader(folder / "run.rrd").stream().to_chunks())
    return {chunk.entity_path for chunk in chunks}


def test_a_run_without_lenses_counts_each_image_without_lines(tmp_path):
    viewer = Viewer(lossless=True)
    paths = record(tmp_path, viewer)
    assert {text.split(":")[0] for text in viewer.errors} == {
        "vp_vehicle.vanishing_directions could not be drawn",
        "vp_drone.vanishing_directions could not be drawn",
    }
    assert set(viewer.errors.values()) == {4}
    assert "/camera/camera_drone/image" in paths
    assert f"/{LINES}" not in paths


def test_a_run_with_lenses_has_all_camera_entities(tmp_path):
    viewer = Viewer(lossless=True, cameras=synthetic_vision.CAMERAS)
    paths = record(tmp_path, viewer)
    assert viewer.errors == {}
    assert {
        f"/{LINES}",
        "/sphere/drone/surface",
        "/frames/sphere_drone",
        "/plots/branch/align/relative_rotation",
    } <= paths


def test_a_graph_without_cameras_has_no_sphere(tmp_path):
    viewer = Viewer(lossless=True)
    viewer.open(Run(out_dir=tmp_path, name="test", mermaid="flowchart LR\n", settings_yaml=""))
    viewer.see("track.track_state", next(c for o, c in synthetic_vision.run(0.1) if o == "track.track_state"), 0)
    viewer.close()
    paths = {chunk.entity_path for chunk in RrdReader(tmp_path / "run.rrd").stream().to_chunks()}
    assert not {path for path in paths if "sphere" in path}


def followed(stamp_ns: int = 0) -> FollowedFeatures:
    """Two inliers of the motion and one outlier."""
    return FollowedFeatures(
        stamp_ns=stamp_ns,
        frame_id="camera_vehicle",
        from_ns=stamp_ns - 200_000_000,
        pixel_from=np.array([[100.0, 200.0], [300.0, 300.0], [500.0, 100.0]]),
        pixel_to=np.array([[110.0, 200.0], [310.0, 300.0], [500.0, 190.0]]),
        residual_rad=np.deg2rad([0.1, 0.3, 9.0]),
        agrees=np.array([True, True, False]),
    )


def test_features_are_displacements_on_their_image_green_for_inliers():
    where, name = camera_scene(), "ego/followed_features"
    drawn(camera_image(), "camera_vehicle/image", where)
    entities = drawn(followed(), name, where)
    displacements = entities[f"camera/camera_vehicle/{name}/displacements"].archetypes[0]
    shown = 480 / 720 * (np.array([[[100.0, 200.0], [110.0, 200.0]]]) + 0.5)
    np.testing.assert_allclose(numbers(displacements.strips).reshape(3, 2, 2)[:1], shown, atol=1e-4)
    np.testing.assert_array_equal(numbers(displacements.colors), [colours.GOOD, colours.GOOD, colours.BAD])
    ends = entities[f"camera/camera_vehicle/{name}/ends"].archetypes[0]
    np.testing.assert_allclose(numbers(ends.positions)[2], 480 / 720 * np.array([500.5, 190.5]), atol=1e-4)
    np.testing.assert_allclose(entities[f"plots/other/{name}/features"].values, [3, 2])
    np.testing.assert_allclose(entities[f"plots/other/{name}/residual"].values, [0.2])


def test_features_of_an_image_not_logged_are_curves_only():
    entities = drawn(followed(stamp_ns=5), "ego/followed_features", camera_scene())
    assert set(entities) == {"plots/other/ego/followed_features/features", "plots/other/ego/followed_features/residual"}
    none = dataclasses.replace(followed(), agrees=np.zeros(3, bool))
    assert set(drawn(none, "ego/followed_features", camera_scene())) == {"plots/other/ego/followed_features/features"}
