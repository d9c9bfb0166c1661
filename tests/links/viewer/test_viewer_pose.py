"""The fused pose and the autopilot's EKF status in the viewer: states, resets, unknown values."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import rerun.blueprint as rrb
from drawing import document, drawn, numbers, scene, values_of
from rerun.chunk import RrdReader

from flow.link import Run
from links.mavlink.poses.gate import PoseLimits
from links.viewer import Viewer
from links.viewer.draw_pose import errors_against
from links.viewer.layout import Vision, layout
from links.viewer.scene import Gate
from links.viewer.stream import Stream
from stages.geometry.frames import rotation_from_rpy_deg
from stages.messages import (
    AutopilotEstimator,
    HeadingEstimate,
    PoseEstimate,
    PoseState,
    PositionEstimate,
    RelativePose,
    ServoOffset,
)

NAME = "fuse/relative_pose"
R = rotation_from_rpy_deg((0.0, 0.0, 90.0))


def pose(**changes) -> RelativePose:
    covariance = np.diag([1e-4, 4e-4, 9e-4, 0.04, 0.09, 0.16])
    estimate = PoseEstimate(
        xyz_vehicle_m=np.array([1.0, 2.0, 10.0]),
        R_vehicle_drone=R,
        covariance=covariance,
        velocity_vehicle_mps=np.zeros(3),
        xyz_map_m=np.array([1.0, 2.0, 10.0]),
        R_map_drone=R,
        map_covariance=covariance,
        velocity_map_mps=np.zeros(3),
        velocity_covariance=np.eye(3),
    )
    full = RelativePose(
        stamp_ns=2_000_000_000,
        state=PoseState.FULL,
        reason="all there",
        measured_ns=1_900_000_000,
        track_id=1,
        resets=0,
        nis=2.5,
        estimate=estimate,
    )
    return dataclasses.replace(full, **changes)


def position() -> PositionEstimate:
    return PositionEstimate(
        xyz_vehicle_m=np.array([1.0, 2.0, 10.0]),
        covariance_vehicle_m2=np.diag([0.04, 0.09, 0.16]),
        velocity_vehicle_mps=np.zeros(3),
        xyz_map_m=np.array([1.0, 2.0, 10.0]),
        covariance_map_m2=np.diag([0.04, 0.09, 0.16]),
        velocity_map_mps=np.zeros(3),
        velocity_covariance=np.eye(3),
    )


def scalars(entity) -> list[float]:
    return entity.values.tolist()


def test_a_full_pose_has_axes_curves_and_sigmas_in_the_vehicle_s_axes():
    entities = drawn(pose(), NAME)
    np.testing.assert_allclose(scalars(entities[f"plots/position/{NAME}"]), [1.0, 2.0, 10.0])
    # tangent at the body: its x lies along the vehicle's y
    np.testing.assert_allclose(scalars(entities[f"plots/sigma/{NAME}"]), [0.3, 0.2, 0.4], atol=1e-12)
    np.testing.assert_allclose(scalars(entities[f"plots/rotation/{NAME}"]), [0.0, 0.0, 90.0], atol=1e-9)
    np.testing.assert_allclose(scalars(entities[f"plots/other/{NAME}/age"]), [0.1])
    arrows = entities[f"vehicle/{NAME}/axes"].archetypes[0]
    np.testing.assert_allclose(numbers(arrows.vectors).reshape(3, 3)[0], [0.0, 0.8, 0.0], atol=1e-6)
    assert document(entities["status"]).startswith(
        "**fuse:** FULL: 1.00 / 2.00 / 10.00 m, sigma 0.30 / 0.20 / 0.40 m; roll"
    )


def test_without_a_rotation_no_axes_and_no_angles_are_shown():
    where = scene()
    drawn(pose(), NAME, where)
    entities = drawn(pose(state=PoseState.POSITION_ONLY, estimate=position()), NAME, where)
    np.testing.assert_allclose(scalars(entities[f"plots/sigma/{NAME}"]), [0.2, 0.3, 0.4], atol=1e-12)
    assert f"plots/rotation/{NAME}" not in entities
    assert "Clear" in type(entities[f"vehicle/{NAME}/axes"].archetypes[0]).__name__


def test_a_lost_pose_clears_all_and_a_reset_is_logged():
    where = scene()
    drawn(pose(), NAME, where)
    assert "the pose jumped, reset 1: a new branch" in str(
        drawn(pose(resets=1, reason="a new branch"), NAME, where)[f"log/{NAME}"].archetypes[0].text.as_arrow_array()
    )
    lost = pose(state=PoseState.LOST, estimate=None, reason="no drone")
    entities = drawn(lost, NAME, where)
    assert "Clear" in type(entities[f"vehicle/{NAME}"].archetypes[0]).__name__
    assert np.isnan(entities[f"plots/position/{NAME}"].values).all()  # the curve is interrupted
    assert document(entities["status"]) == "**fuse:** LOST: no drone"


def test_the_status_names_what_the_autopilot_does_not_fuse():
    estimator = AutopilotEstimator(
        stamp_ns=0,
        attitude_good=True,
        velocity_good=True,
        position_good=False,
        height_good=True,
        constant_position=True,
        velocity_ratio=0.1,
        horizontal_ratio=1.7,
        height_ratio=0.2,
        compass_ratio=math.nan,
        flags=5,
    )
    entities = drawn(estimator, "autopilot/autopilot_estimator")
    assert document(entities["status"]) == "**autopilot, EKF:** no good position; constant position mode"
    np.testing.assert_allclose(scalars(entities["plots/estimator/autopilot/autopilot_estimator"])[:3], [0.1, 1.7, 0.2])


def test_a_servo_offset_is_shown_with_that_of_the_rig():
    offset = ServoOffset(
        stamp_ns=0, offset_s=0.0012, sigma_s=0.0001, rig_offset_s=0.002, windows=2, reason="one window"
    )
    entities = drawn(offset, "servo_clock/servo_offset")
    assert document(entities["status"]) == "**servo_clock:** 1.20 +- 0.10 ms, rig 2.00 ms; one window"
    nothing = drawn(dataclasses.replace(offset, offset_s=None, sigma_s=None), "servo_clock/servo_offset")
    assert list(nothing) == ["status"]


def names(view) -> list[str]:
    """Names of all views below."""
    if isinstance(view, rrb.View):
        return [str(view.name)]
    return [name for part in view.contents for name in names(part)]


def test_a_graph_that_fuses_without_cameras_shows_the_rotation():
    def shown(vision):
        return set(names(layout(depth_images=False, candidates=True, vision=vision).root_container))

    added = shown(Vision(pose=True)) - shown(Vision())
    assert added == {
        "Rotation in the vehicle frame [deg]: roll red, pitch green, yaw blue",
        "Sigma of the rotation [deg], about x red, y green, z blue",
    }


def test_the_gate_of_the_autopilot_link_has_a_lane_a_log_and_each_value_against_its_limit():
    where = scene(gate=Gate(PoseLimits(position_sigma_m=0.8, rotation_sigma_deg=3.4377), "measured"))
    entities = drawn(pose(rotation_ns=1_000_000_000), NAME, where)
    assert values_of(entities["states/autopilot_gate"].archetypes[0].state) == ["accepted"]
    values = scalars(entities[f"plots/gate/{NAME}"])
    np.testing.assert_allclose(values[:4], [1.0, 0.5, 0.5, 0.5], rtol=1e-3)  # limit, 0.4 m, 1.72 deg, 1 s
    assert math.isnan(values[4])
    entities = drawn(pose(rotation_ns=-3_000_000_000), NAME, where)
    assert values_of(entities["states/autopilot_gate"].archetypes[0].state) == ["yaw not measured"]
    assert "held back: yaw not measured" in document(entities["status"])
    assert scalars(entities[f"plots/gate/{NAME}"])[3] == 2.5
    assert "states/autopilot_gate" not in drawn(pose(), NAME), "no autopilot, no gate"


def test_errors_are_drawn_at_the_times_of_the_estimates_against_the_nearest_drone():
    where = scene()
    for n in range(3):
        drawn(pose(stamp_ns=2_000_000_000 + n * 20_000_000), NAME, where)
    stamps_ns = np.array([2_000_000_000, 2_040_000_000])  # no truth afterwards, and linear in between
    near, far = np.array([[1.0, 2.0, 10.1], [1.0, 2.0, 10.3]]), np.array([[9.0, 2.0, 9.0], [9.0, 2.0, 9.0]])
    drawn(pose(stamp_ns=2_400_000_000), NAME, where)
    found = list(errors_against([(stamps_ns, far), (stamps_ns, near)], where))
    assert [stamp_ns for stamp_ns, _ in found] == [2_000_000_000, 2_020_000_000, 2_040_000_000]
    np.testing.assert_allclose([entity.values[0] for _, entity in found], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(found[0][1].values[1], math.sqrt(0.04 + 0.09 + 0.16))


def test_the_curve_of_an_error_is_interrupted_while_the_position_is_unknown():
    where, later_ns = scene(), 4_000_000_000
    for stamp_ns in (2_000_000_000, later_ns):
        drawn(pose(stamp_ns=stamp_ns), NAME, where)
    stamps_ns = np.array([2_000_000_000, 2_020_000_000, later_ns])
    found = list(errors_against([(stamps_ns, np.zeros((3, 3)))], where))
    assert [stamp_ns for stamp_ns, _ in found] == [2_000_000_000, 2_000_000_001, later_ns]
    assert np.isnan(found[1][1].values).all()


def test_the_truth_and_the_errors_are_in_the_file_of_a_replay(tmp_path):
    viewer = Viewer(lossless=True)
    viewer.open(Run(tmp_path, "test", "", ""))
    viewer.see("fuse.relative_pose", pose(), 0)
    viewer.truths = [(np.array([1_990_000_000, 2_010_000_000]), np.array([[1.0, 2.0, 10.5]] * 2))]
    viewer.close()
    assert viewer.errors == {}
    paths = {chunk.entity_path for chunk in RrdReader(tmp_path / "run.rrd").stream().to_chunks()}
    assert {"/vehicle/true_drone_1", "/plots/position/true_drone_1", f"/plots/error/{NAME}"} <= paths


def test_each_tab_has_its_own_views_and_only_those_that_the_graph_fills():
    def tabs(**options):
        vision = Vision(["camera_drone"], directions=True, rotation=True, pose=True, odometry=True)
        return layout(depth_images=False, candidates=True, vision=vision, **options).root_container.contents

    def views(part) -> list[int]:
        return [id(part)] if isinstance(part, rrb.View) else [view for inner in part.contents for view in views(inner)]

    assert [tab.name for tab in tabs(gate=True)] == [
        "Overview", "Detection", "Tracking", "Rotation", "Fusion", "Autopilot link", "Timing", "Configuration",
    ]  # fmt: skip
    assert "Autopilot link" not in [tab.name for tab in tabs()]
    shown = [view for tab in tabs(gate=True) for view in views(tab)]
    assert len(shown) == len(set(shown)), "a view that is in two tabs is drawn in one of them only"


def test_axes_that_were_cleared_before_they_were_drawn_have_their_frame():
    """A pose is usually POSITION_ONLY first, so its axes are cleared before they exist."""
    logged = []

    class Recording:
        def log(self, path, *parts, static=False):
            logged.append((path, static, [type(part).__name__ for part in parts]))

    stream = Stream.__new__(Stream)
    stream._rerun, stream._styled, stream._curves = Recording(), set(), {}
    where = scene()
    for one in (pose(state=PoseState.POSITION_ONLY, estimate=position()), pose(), pose()):
        for entity in drawn(one, NAME, where).values():
            if entity.path == f"vehicle/{NAME}/axes":
                stream.put(entity)
    path = f"vehicle/{NAME}/axes"
    assert logged[:2] == [(path, False, ["Clear"]), (path, True, ["CoordinateFrame"])]
    assert [static for _, static, _ in logged].count(True) == 1


def test_a_heading_is_its_most_probable_yaw_in_the_vehicle_frame_however_many_hypotheses_there_are():
    heading = HeadingEstimate(
        stamp_ns=0,
        yaw_map_rad=np.radians([100.0, 190.0]),
        sigma_rad=np.radians([4.0, 9.0]),
        probability=np.array([0.9, 0.1]),
        vehicle_yaw_rad=math.radians(30.0),
        near_probability=0.9,
        decided=False,
        reason="accelerate sideways",
    )
    name, shown = "fuse/heading_estimate", scene()
    entities = drawn(heading, name, shown)
    np.testing.assert_allclose(scalars(entities[f"plots/rotation/{name}"]), [70.0])
    np.testing.assert_allclose(scalars(entities[f"plots/rotation_sigma/{name}"]), [4.0])
    np.testing.assert_allclose(scalars(entities[f"plots/branch/{name}"]), [90.0])
    none = np.zeros(0)
    empty = dataclasses.replace(heading, yaw_map_rad=none, sigma_rad=none, probability=none)
    assert not any(path.startswith("plots") for path in drawn(empty, name, shown))
