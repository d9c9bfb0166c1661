"""How a recording opens: where the drone is on the left, why and how sure on the right, both over what is said.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import rerun as rr
import rerun.blueprint as rrb

from links.viewer.scene import DRONE_FRAME, SPHERES_APART, TIMELINE, sphere_frame
from stages.messages import CameraMount

_BACKGROUND = [12, 15, 22]
_WHOLE_RUN = rrb.TimeAxis(
    view_range=rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())
)


class Vision(NamedTuple):
    """What the graph has of the cameras."""

    pictures: Sequence[str] = ()  # frame ids
    directions: bool = False
    rotation: bool = False  # between the cameras' directions
    pose: bool = False  # fused, with a rotation
    odometry: bool = False


def layout(*, images: bool, evidence: bool, vision: Vision) -> rrb.Blueprint:
    """The blueprint. Views ask for groups of entities, whatever the stages are called: see `links/viewer/draw.py`.

    `images`: the graph has depth images to show; `evidence`: it has candidates with reasons and a probability;
    `vision`: with anything of the cameras, or a fused pose, it has a third column, on the right.
    """
    scene = _space(
        "Vehicle frame: last returns (blue low, white high), LiDAR fan, drone with 95 % ellipsoid",
        ["/vehicle/**", "/labels/**", "/lidar/**", "/frames/**"],
        frame="vehicle",
        eye=rrb.EyeControls3D(
            position=(-38.0, -30.0, 20.0) if evidence else (-22.0, -17.0, 17.0),  # it sees farther
            look_target=(5.0, 0.5, 15.0) if evidence else (5.0, 0.5, 7.0),
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
    candidates = rrb.TextDocumentView(name="Candidates: why, and why not", origin="/candidates")
    lidar_range = rrb.TensorView(
        name="LiDAR range",
        origin="/range",
        contents="/range/**",
        view_fit="fill",
        scalar_mapping=rrb.TensorScalarMapping(colormap="turbo", mag_filter="nearest"),
    )
    words = rrb.Tabs(
        rrb.TextDocumentView(name="Now", origin="/now"),
        rrb.TextLogView(name="Verdicts", origin="/log", contents="/log/**"),
        *([lidar_range] if evidence and not images else [candidates]),
        rrb.TextDocumentView(name="Graph", origin="/about/graph"),
        rrb.TextDocumentView(name="Settings", origin="/about/settings"),
        _curves("All other numbers", "/plots/other/**"),
    )
    pictures = rrb.Horizontal(
        _image("Depth image, up (blue near, red far)", ["/depth/**", "/marks/**"]),
        rrb.Tabs(_image("Score (bright: like a drone)", ["/score/**", "/marks/**"]), lidar_range),
    )
    probability = _curves("Probability of a drone [%]", "/plots/probability/**")
    cameras = _of_cameras(vision)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(scene, rrb.Horizontal(close_up, words, column_shares=[2, 3]), row_shares=[2, 1]),
            rrb.Vertical(
                pictures if images or not evidence else candidates,
                *([probability] if evidence else []),
                _curves("Position of the drone [m]", "/plots/position/**"),
                _curves("Its sigma [m]", "/plots/sigma/**"),
                _curves("Returns on the drone, per look", "/plots/hits/**"),
                _curves("Servo angle and goal [deg]", "/plots/servo/**"),
                rrb.StateTimelineView(name="States", origin="/states", contents="/states/**", time_view=_WHOLE_RUN),
                row_shares=[26, 11, 11, 10, 7, 9, 26] if evidence else [32, 14, 12, 9, 10, 21],
            ),
            *(
                [rrb.Vertical(*(view for _, view in cameras), row_shares=[share for share, _ in cameras])]
                if cameras
                else []
            ),
            column_shares=[11, 10] if not cameras else [11, 8, 11],
        ),
        # Following: a live run moves on, a finished file opens at its end, with every curve complete.
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def _of_cameras(vision: Vision) -> list[tuple[int, rrb.View | rrb.Container]]:
    """The views of the cameras, each with its share of the column's height."""
    rows: list[tuple[int, rrb.View | rrb.Container]] = []
    if vision.pictures:
        views = [_image(frame_id.replace("_", " "), [f"/camera/{frame_id}/**"]) for frame_id in vision.pictures]
        rows.append((30, rrb.Horizontal(*views)))
    if vision.directions:
        eye = rrb.EyeControls3D(
            position=(-2.6, -0.5 * SPHERES_APART, 1.1),
            look_target=(0.0, -0.5 * SPHERES_APART, 0.1),
            eye_up=(0.0, 0.0, 1.0),
        )
        name = "Directions and lines on the unit sphere: vertical blue, each horizontal pair its hue"
        contents = ["/sphere/**", "/frames/**"]
        rows.append((24, _space(name, contents, frame=sphere_frame(CameraMount.VEHICLE), eye=eye, grid_m=None)))
    if vision.rotation:
        rows.append((13, _curves("Branch of the rotation [%]", "/plots/branch/**")))
    if vision.rotation or vision.pose:
        rows.append((11, _curves("The drone in the vehicle's axes [deg]", "/plots/rotation/**")))
        rows.append((10, _curves("Sigma of the rotation [deg]", "/plots/rotation_sigma/**")))
    if vision.odometry:
        matches = _curves("Drone odometry: features that agree", "/plots/matches/**")
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
