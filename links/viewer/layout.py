"""The initial layout of a recording: 3D views left, images, curves and states right, cameras in a third column.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import rerun as rr
import rerun.blueprint as rrb

from links.viewer.scene import DRONE_FRAME, SPHERE_SPACING, TIMELINE, sphere_frame
from stages.messages import CameraMount

_BACKGROUND = [12, 15, 22]
_WHOLE_RUN = rrb.TimeAxis(
    view_range=rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())
)


class Vision(NamedTuple):
    """Camera outputs of the graph that the layout has views for."""

    images: Sequence[str] = ()  # frame ids
    directions: bool = False
    rotation: bool = False  # relative rotation from vanishing directions
    pose: bool = False  # fused pose with a rotation
    odometry: bool = False


def layout(*, depth_images: bool, candidates: bool, vision: Vision) -> rrb.Blueprint:
    """The blueprint. Views select groups of entities, independent of stage names: see `links/viewer/draw.py`.

    `depth_images`: the graph has depth images; `candidates`: it has candidates with reasons and a probability;
    `vision`: with camera outputs or a fused pose there is a third column, on the right.
    """
    scene = _space(
        "Vehicle frame: recent returns (blue low, white high), LiDAR fan, drone with 95 % ellipsoid",
        ["/vehicle/**", "/labels/**", "/lidar/**", "/frames/**"],
        frame="vehicle",
        eye=rrb.EyeControls3D(
            position=(-38.0, -30.0, 20.0) if candidates else (-22.0, -17.0, 17.0),  # this detector reaches farther
            look_target=(5.0, 0.5, 15.0) if candidates else (5.0, 0.5, 7.0),
            eye_up=(0.0, 0.0, 1.0),
        ),
        grid_m=5.0,
    )
    close_up = _space(
        "Close-up: follows the drone",
        ["/vehicle/**", "/frames/**"],
        frame=DRONE_FRAME,
        eye=rrb.EyeControls3D(position=(-2.6, -2.0, 1.4), look_target=(0.0, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0)),
        grid_m=None,
    )
    reasons = rrb.TextDocumentView(name="Candidates: reasons", origin="/candidates")
    lidar_range = rrb.TensorView(
        name="LiDAR range",
        origin="/range",
        contents="/range/**",
        view_fit="fill",
        scalar_mapping=rrb.TensorScalarMapping(colormap="turbo", mag_filter="nearest"),
    )
    texts = rrb.Tabs(
        rrb.TextDocumentView(name="Status", origin="/status"),
        rrb.TextLogView(name="Log", origin="/log", contents="/log/**"),
        *([lidar_range] if candidates and not depth_images else [reasons]),
        rrb.TextDocumentView(name="Graph", origin="/about/graph"),
        rrb.TextDocumentView(name="Settings", origin="/about/settings"),
        _curves("All other numbers", "/plots/other/**"),
    )
    image_views = rrb.Horizontal(
        _image("Depth image, up (blue near, red far)", ["/depth/**", "/overlays/**"]),
        rrb.Tabs(_image("Score (bright: similar to a drone)", ["/score/**", "/overlays/**"]), lidar_range),
    )
    probability = _curves("Probability of a drone [%]", "/plots/probability/**")
    cameras = _camera_views(vision)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(scene, rrb.Horizontal(close_up, texts, column_shares=[2, 3]), row_shares=[2, 1]),
            rrb.Vertical(
                image_views if depth_images or not candidates else reasons,
                *([probability] if candidates else []),
                _curves("Position of the drone [m]", "/plots/position/**"),
                _curves("Sigma of the position [m]", "/plots/sigma/**"),
                _curves("Returns on the drone, per scan pass", "/plots/hits/**"),
                _curves("Servo angle and goal [deg]", "/plots/servo/**"),
                rrb.StateTimelineView(name="States", origin="/states", contents="/states/**", time_view=_WHOLE_RUN),
                row_shares=[26, 11, 11, 10, 7, 9, 26] if candidates else [32, 14, 12, 9, 10, 21],
            ),
            *(
                [rrb.Vertical(*(view for _, view in cameras), row_shares=[share for share, _ in cameras])]
                if cameras
                else []
            ),
            column_shares=[11, 10] if not cameras else [11, 8, 11],
        ),
        # Following: a live run advances, and a finished file opens at its end with complete curves.
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def _camera_views(vision: Vision) -> list[tuple[int, rrb.View | rrb.Container]]:
    """The camera views, each with its share of the column's height."""
    rows: list[tuple[int, rrb.View | rrb.Container]] = []
    if vision.images:
        views = [_image(frame_id.replace("_", " "), [f"/camera/{frame_id}/**"]) for frame_id in vision.images]
        rows.append((30, rrb.Horizontal(*views)))
    if vision.directions:
        eye = rrb.EyeControls3D(
            position=(-2.6, -0.5 * SPHERE_SPACING, 1.1),
            look_target=(0.0, -0.5 * SPHERE_SPACING, 0.1),
            eye_up=(0.0, 0.0, 1.0),
        )
        name = "Directions and lines on the unit sphere: vertical blue, one hue per horizontal pair"
        contents = ["/sphere/**", "/frames/**"]
        rows.append((24, _space(name, contents, frame=sphere_frame(CameraMount.VEHICLE), eye=eye, grid_m=None)))
    if vision.rotation:
        rows.append((13, _curves("Yaw branch probabilities [%]", "/plots/branch/**")))
    if vision.rotation or vision.pose:
        rows.append((11, _curves("Rotation of the drone in the vehicle frame [deg]", "/plots/rotation/**")))
        rows.append((10, _curves("Sigma of the rotation [deg]", "/plots/rotation_sigma/**")))
    if vision.odometry:
        matches = _curves("Drone odometry: inlier features", "/plots/matches/**")
        sigma = _curves("Sigma of the motion [deg]", "/plots/motion_sigma/**")
        rows.append((11, rrb.Horizontal(matches, sigma)))
    return rows


def _space(
    name: str, contents: list[str], *, frame: str, eye: rrb.EyeControls3D, grid_m: float | None
) -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        name=name,
        origin="/",
        contents=contents,
        background=_BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=grid_m is not None, spacing=grid_m or 1.0, color=[255, 255, 255, 14]),
        spatial_information=rrb.SpatialInformation(target_frame=frame, axes=rr.ViewCoordinates.FLU),
        eye_controls=eye,
    )


def _image(name: str, contents: list[str]) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(name=name, origin="/", contents=contents, background=[0, 0, 0])


def _curves(name: str, contents: str) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=name,
        origin="/plots",
        contents=contents,
        axis_x=_WHOLE_RUN,
        plot_legend=rrb.Corner2D.LeftTop,
    )
