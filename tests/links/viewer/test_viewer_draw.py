"""Entities of each message: paths, frames and numbers, computed by hand."""

from __future__ import annotations

import dataclasses
import enum

import numpy as np
import pytest
import synthetic
from drawing import document, drawn, numbers, scene

from flow.message import Mat3, Message, Points64, message
from links.viewer import colours, draw_sensors
from links.viewer.entities import ellipsoid
from links.viewer.scene import initial_frames, static_entities, turntable_transform
from stages.geometry.frames import quaternions_xyzw, rotation_from_quaternion_xyzw, rotation_from_rpy_deg
from stages.messages import (
    DepthImage,
    Detections,
    DroneFix,
    KernelScores,
    ScoreImage,
    ServoState,
    TrackingState,
    TrackState,
)


def fix(stamp_ns: int = 0, xyz=(3.0, 4.0, 12.0), covariance=None) -> DroneFix:
    return DroneFix(
        stamp_ns=stamp_ns,
        xyz_vehicle_m=np.array(xyz),
        covariance_m2=np.diag([0.01, 0.04, 0.09]) if covariance is None else covariance,
        hits=5,
    )


def track_state(state: TrackingState, hits: int = 0) -> TrackState:
    return TrackState(stamp_ns=0, state=state, reason="why", hits=hits, frame_s=0.12)


def image(depth_m: np.ndarray) -> DepthImage:
    return DepthImage(
        stamp_ns=0,
        start_ns=0,
        depth_m=depth_m,
        focal_px=10.0,
        origin_vehicle_m=np.array([0.0, 0.0, 0.25]),
        points=1,
        returns=2,
        turned_rad=3.1,
    )


def test_the_ellipsoid_holds_95_percent_of_a_known_covariance():
    half_sizes_m, axes = ellipsoid(np.diag([0.01, 0.04, 0.09]))
    # sqrt(7.8147) = 2.7955 standard deviations in three dimensions
    np.testing.assert_allclose(half_sizes_m, [0.27955, 0.5591, 0.83865], atol=1e-4)
    samples = np.random.default_rng(0).multivariate_normal(np.zeros(3), np.diag([0.01, 0.04, 0.09]), 100_000)
    inside = (((samples @ axes) / half_sizes_m) ** 2).sum(axis=1) < 1
    assert inside.mean() == pytest.approx(0.95, abs=0.004)


def test_the_ellipsoid_rotates_with_its_covariance():
    turn = rotation_from_rpy_deg((20.0, -35.0, 70.0))
    covariance = turn @ np.diag([0.01, 0.04, 0.09]) @ turn.T
    half_sizes_m, axes = ellipsoid(covariance)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(axes @ np.diag(half_sizes_m**2 / 7.814727903) @ axes.T, covariance, atol=1e-12)


@pytest.mark.parametrize("rpy_deg", [(0, 0, 0), (180, 0, 0), (0, 180, 0), (0, 0, 180), (12, -50, 170)])
def test_a_quaternion_equals_its_rotation_matrix(rpy_deg):
    rotation = rotation_from_rpy_deg(rpy_deg)
    x, y, z, w = quaternions_xyzw(rotation[None])[0]
    np.testing.assert_allclose(rotation_from_quaternion_xyzw((x, y, z, w)), rotation, atol=1e-12)


def test_a_fix_is_an_ellipsoid_in_the_vehicle_frame_with_trail_and_curves():
    entities = drawn(fix(), "track/drone_fix")
    entity = entities["vehicle/track/drone_fix/drone_1/ellipsoid_95"]
    assert entity.frame == "vehicle"
    np.testing.assert_allclose(numbers(entity.archetypes[0].centers), [[3.0, 4.0, 12.0]])
    np.testing.assert_allclose(
        sorted(numbers(entity.archetypes[0].half_sizes)[0]), [0.27955, 0.5591, 0.83865], atol=1e-4
    )
    np.testing.assert_allclose(entities["plots/position/track/drone_fix/drone_1"].values, [3.0, 4.0, 12.0])
    np.testing.assert_allclose(entities["plots/sigma/track/drone_fix/drone_1"].values, [0.1, 0.2, 0.3])
    assert {
        "vehicle/track/drone_fix/drone_1/trail",
        "labels/track/drone_fix/drone_1",
        "frames/drone_position",
        "status",
    } <= set(entities)
    label = entities["labels/track/drone_fix/drone_1"].archetypes[0].labels.as_arrow_array().to_pylist()
    assert label == ["drone 1: 13.0 m, 5 returns"]


def test_a_trail_is_split_at_a_gap_and_drops_old_fixes():
    where = scene(trail_s=5.0)
    for second in (0.0, 0.5, 4.0, 4.5, 5.2):
        strips = where.trail("track/drone_fix", fix(int(second * 1e9), xyz=(second, 0.0, 10.0)))
    assert [[float(point[0]) for point in strip] for strip in strips] == [[0.5], [4.0, 4.5, pytest.approx(5.2)]]


def test_the_close_up_follows_the_first_of_two_trackers():
    where = scene()
    assert "frames/drone_position" in drawn(fix(), "track/drone_fix", where)
    assert "frames/drone_position" not in drawn(fix(), "other/drone_fix", where)
    assert "frames/drone_position" in drawn(fix(), "track/drone_fix", where)


def test_candidates_have_rings_at_their_pixels_in_the_depth_image():
    where = scene()
    drawn(image(np.zeros((40, 60), np.float32)), "sweep/depth_image", where)
    candidates = Detections(
        stamp_ns=0,
        xyz_vehicle_m=np.array([[2.0, -1.0, 10.25], [1.0, 1.0, 5.25], [0.0, 0.0, -3.0]]),
        evidence=KernelScores(e_inner=np.zeros(3), e_outer=np.array([1.0, 2.0, 3.0])),
        accepted=np.array([True, False, False]),
        reasons=("lowest", "touches a wall", "below"),
        summary="drone at 10.4 m",
    )
    entities = drawn(candidates, "detect/detections", where)
    # u = 10 * 2/10 + 60/2 = 32, v = 10 * -1/10 + 40/2 = 19; the one below the lidar is not in the image
    np.testing.assert_allclose(
        numbers(entities["overlays/detect/detections/accepted"].archetypes[0].centers), [[32.0, 19.0]]
    )
    np.testing.assert_allclose(
        numbers(entities["overlays/detect/detections/rejected"].archetypes[0].centers), [[32.0, 22.0]]
    )
    rejected = entities["vehicle/detect/detections/rejected"].archetypes[0]
    assert rejected.labels.as_arrow_array().to_pylist() == [
        "candidate 2, e = 2.0: touches a wall",
        "candidate 3, e = 3.0: below",
    ]
    assert numbers(rejected.positions).shape == (2, 3)
    assert entities["labels/detect/detections"].archetypes[0].labels.as_arrow_array().to_pylist() == ["candidate 1"]
    assert "- 2: e = 2.0, rejected at 1.0 / 1.0 / 5.2 m: touches a wall" in document(entities["candidates"])
    assert entities["log/detect/detections"].archetypes[0].text.as_arrow_array().to_pylist() == ["drone at 10.4 m"]


def test_a_search_without_candidates_is_drawn_as_no_drone():
    nothing = Detections(
        stamp_ns=0,
        xyz_vehicle_m=np.zeros((0, 3)),
        evidence=KernelScores(e_inner=np.zeros(0), e_outer=np.zeros(0)),
        accepted=np.zeros(0, dtype=bool),
        reasons=(),
        summary="no drone: no candidate",
    )
    entities = drawn(nothing, "detect/detections")
    assert entities["states/detect"].archetypes[0].state.as_arrow_array().to_pylist() == ["no drone"]
    assert len(entities["labels/detect/detections"].archetypes[0].positions) == 0  # an earlier label is removed


def test_a_state_lane_changes_only_with_the_state():
    where = scene()
    seen = [
        "states/track" in drawn(track_state(state), "track/track_state", where)
        for state in (TrackingState.SEARCHING, TrackingState.SEARCHING, TrackingState.TRACKING, TrackingState.LOST)
    ]
    assert seen == [True, False, True, True]


def test_the_servo_rotates_the_turntable_according_to_the_mount():
    state = ServoState(stamp_ns=0, position_rad=np.pi / 2, velocity_radps=0.5, goal_rad=1.0, error=4)
    entities = drawn(state, "servo/servo_state")
    np.testing.assert_allclose(entities["plots/servo/servo/servo_state"].values, [90.0, 57.29578])
    assert entities["states/servo"].archetypes[0].state.as_arrow_array().to_pylist() == ["error 0x04"]
    columns = numbers(entities["frames/turntable"].archetypes[0].mat3x3).reshape(3, 3)
    np.testing.assert_allclose(columns.T, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-7)  # Rerun stores columns
    backwards = synthetic.MOUNT.model_copy(update={"servo_sign": -1})
    columns = numbers(turntable_transform(backwards, np.pi / 2).mat3x3).reshape(3, 3)
    np.testing.assert_allclose(columns.T, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-7)


def test_without_a_mount_no_turntable_frame_is_drawn():
    assert {entity.path for entity in static_entities(None)} == {"vehicle/axes", "vehicle/name"}
    assert [entity.path for entity in initial_frames(None)] == ["frames/drone_position"]
    state = ServoState(stamp_ns=0, position_rad=1.0, velocity_radps=0.0, goal_rad=1.0, error=0)
    assert "frames/turntable" not in drawn(state, "servo/servo_state", scene(mount=None))


def test_slices_of_the_cloud_reuse_their_paths_and_the_drone_has_its_colour():
    where = scene(history_s=0.3)
    drawn(fix(xyz=(6.0, 0.0, 12.0)), "track/drone_fix", where)
    _, swept = synthetic.packet(0.0)
    paths = [
        next(iter(drawn(dataclasses.replace(swept, stamp_ns=k * 100_000_000), "sweep/swept_points", where)))
        for k in range(4)
    ]
    assert paths == [f"vehicle/sweep/swept_points/slice_{k:02d}" for k in (0, 1, 2, 0)]
    packed = where.colours(np.array([[6.5, 0.0, 12.0], [6.5, 5.0, 12.0]], np.float32))
    assert packed[0] == colours.DRONE
    assert packed[1] == colours.by_height(np.array([12.0], np.float32))[0]


def test_the_range_image_has_the_highest_beam_on_top():
    firings, _ = synthetic.packet(0.05)  # half a revolution later, the beams point down
    pixels = draw_sensors.range_counts(firings)
    assert pixels.shape == (16, 900)
    pulse = int(np.flatnonzero(firings.range_m > 0)[0])
    row = round((15.0 - np.rad2deg(synthetic.ELEVATION_RAD[firings.laser[pulse]])) / 2)
    column = int(firings.azimuth_rad[pulse] / (2 * np.pi) * 900)
    assert pixels[row, column] * 0.002 == pytest.approx(float(firings.range_m[pulse]), abs=0.06)


def test_the_fan_has_the_elevations_of_the_lidar_that_sends():
    firings, _ = synthetic.packet(0.0)
    wide = dataclasses.replace(firings, laser_elevation_rad=np.deg2rad([-30.0, 10.0]), laser=firings.laser % 2)
    where = scene(mount=synthetic.MOUNT)
    fan = drawn(wide, "lidar/lidar_firings", where)["lidar/fan"].archetypes[0]
    strips = np.array(fan.strips.as_arrow_array().to_pylist())
    elevations_deg = np.degrees(np.arctan2(strips[..., 2], np.linalg.norm(strips[..., :2], axis=-1)))
    np.testing.assert_allclose(elevations_deg, np.repeat([[-30.0], [10.0]], strips.shape[1], axis=1), atol=1e-4)
    assert "lidar/fan" not in drawn(wide, "lidar/lidar_firings", where), "only when it changes"


def test_empty_depth_stays_empty_and_a_lone_pixel_grows_to_three():
    depth = np.zeros((20, 30), np.float32)
    depth[5, 7] = 12.0
    depth[5, 9] = 3.0
    counts = draw_sensors.depth_counts(image(depth))
    assert counts.dtype == np.uint16
    assert (counts > 0).sum() == 15  # two squares of 3 x 3 that share a column
    assert counts[5, 7] == 6000
    assert counts[4, 8] == 1500  # between both: the nearer


def test_the_best_score_is_the_brightest_and_no_candidate_is_black():
    score = np.full((10, 10), np.nan, np.float32)
    score[2, 2], score[7, 7] = 12.0, 900.0
    counts = draw_sensors.score_counts(ScoreImage(stamp_ns=0, score=score))
    assert counts[2, 2] == 65535
    assert 0 < counts[7, 7] < 65535 / 4
    assert counts[0, 9] == 0
    nothing = draw_sensors.score_counts(ScoreImage(stamp_ns=0, score=np.full((4, 4), np.nan, np.float32)))
    assert not nothing.any()


class Mode(enum.Enum):
    CALM = 0


@message
class Unknown(Message):
    """A type the viewer has no function for."""

    level_v: float
    count: int
    healthy: bool
    mode: Mode
    text: str
    points_vehicle_m: Points64
    covariance_m2: Mat3
    samples: np.ndarray


def test_a_message_of_unknown_type_is_visible_field_by_field():
    content = Unknown(
        stamp_ns=0,
        level_v=12.5,
        count=3,
        healthy=True,
        mode=Mode.CALM,
        text="hello",
        points_vehicle_m=np.arange(30.0).reshape(10, 3),
        covariance_m2=np.eye(3),
        samples=np.arange(100.0),
    )
    entities = drawn(content, "power/unknown")
    assert entities["plots/fields/power/unknown/level_v"].values == [12.5]
    assert entities["plots/fields/power/unknown/count"].values == [3]
    assert entities["plots/fields/power/unknown/healthy"].values == [1]
    assert entities["states/power/unknown/mode"].archetypes[0].state.as_arrow_array().to_pylist() == ["CALM"]
    assert entities["log/power/unknown/text"].archetypes[0].text.as_arrow_array().to_pylist() == ["hello"]
    assert entities["vehicle/power/unknown/points_vehicle_m"].frame == "vehicle"
    assert len(entities["plots/fields/power/unknown/covariance_m2"].values) == 9
    np.testing.assert_allclose(entities["plots/fields/power/unknown/samples"].values, [100, 0.0, 49.5, 99.0])
