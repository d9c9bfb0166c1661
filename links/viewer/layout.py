"""The initial layout of a recording: tabs from the overview to the timing, one for each part of the pipeline.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import rerun as rr
import rerun.blueprint as rrb

from links.viewer.scene import DRONE_FRAME, SPHERE_SPACING, TIMELINE, sphere_frame
from stages.messages import CameraMount

EDGES = "/plots/fields/run"  # `flow.live.report.EdgeStatus` of a live run
_BACKGROUND = [12, 15, 22]
Rows = list[tuple[int, rrb.View | rrb.Container]]  # views below each other, each with its share of the height
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


def layout(
    *, depth_images: bool, candidates: bool, vision: Vision, truth: bool = True, gate: bool = False
) -> rrb.Blueprint:
    """The blueprint: a tab for each question. Views select groups of entities, independent of stage names: `draw.py`.

    `depth_images`: the graph has depth images; `candidates`: it has candidates with reasons and a probability;
    `vision`: camera outputs and a fused pose; `truth`: the recording may have the true pose; `gate`: poses go to an
    autopilot.
    """

    def position() -> Rows:  # a view is in one place: each tab gets its own
        return [(24, _curves("Position [m]: x red, y green, z blue, truth dark", "/plots/position/**"))]

    def error() -> Rows:
        return (
            [(20, _curves("Error against the truth (red) and its sigma (grey) [m]", "/plots/error/**"))]
            if truth
            else []
        )

    gate_limits = "Gate, sent below red: position yellow, rotation violet, its age orange, yaw axis blue"

    def sent() -> Rows:
        return [(15, _curves(gate_limits, "/plots/gate/**"))] if gate else []

    def sigma() -> Rows:
        title = "Sigma of the position [m]: x red, y green, z blue, prediction orange"
        return [(16, _curves(title, "/plots/sigma/**"))]

    images: Rows = [(32, rrb.Horizontal(*_image_views(vision)))] if vision.images else []
    overview = rrb.Horizontal(
        rrb.Vertical(_scene(candidates), rrb.Horizontal(_close_up(), rrb.Tabs(_status(), _log())), row_shares=[2, 1]),
        _rows([*images, *position(), *error(), *sent(), *_states()]),
        name="Overview",
    )
    returns = _curves("Returns on the drone, per scan pass", "/plots/hits/**")
    servo = _curves("Servo [deg]: angle grey, goal blue, requested yellow", "/plots/servo/**")
    tracking = rrb.Horizontal(
        rrb.Vertical(_close_up(), _log(), row_shares=[3, 2]),
        _rows([*position(), *sigma(), (14, returns), (16, servo), *_states()]),
        name="Tracking",
    )
    tabs: list[rrb.Container] = [overview, _detection(depth_images, candidates), tracking]
    if vision.images or vision.directions or vision.rotation or vision.odometry:
        tabs.append(_columns(_camera_views(vision), name="Rotation"))
    if vision.pose:
        tabs.append(_columns([*position(), *error(), *sigma(), *_rotation_views(), *_states()], name="Fusion"))
    if gate:
        ekf = _curves("The autopilot's EKF: test ratios, rejected above 1", "/plots/estimator/**", legend=True)
        left, right = _rows([*sent(), (24, ekf), *_states()]), rrb.Vertical(_log(), _status())
        tabs.append(rrb.Horizontal(left, right, name="Autopilot link"))
    tabs += [_timing(), _configuration()]
    return rrb.Blueprint(
        rrb.Tabs(*tabs),
        # Following: a live run advances, and a finished file opens at its end with complete curves.
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def _timing() -> rrb.Container:
    counts = _curves("Pulses and returns", "/plots/count/**", legend=True)
    title = "Lags, ages, speeds, counts: point at a curve for its name"
    other = _curves(title, ["/plots/other/**", f"{EDGES}/**"])
    numbers = rrb.Vertical(counts, other, row_shares=[1, 3])
    return rrb.Horizontal(numbers, rrb.Vertical(_log(), _status()), column_shares=[2, 1], name="Timing")


def _configuration() -> rrb.Container:
    graph = rrb.TextDocumentView(name="Graph", origin="/about/graph")
    settings = rrb.TextDocumentView(name="Settings", origin="/about/settings")
    return rrb.Horizontal(graph, settings, name="Configuration")


def _states() -> Rows:
    lanes = rrb.StateTimelineView(name="States", origin="/states", contents="/states/**", time_view=_WHOLE_RUN)
    return [(26, lanes)]


def _log() -> rrb.View:
    return rrb.TextLogView(name="Log", origin="/log", contents="/log/**")


def _status() -> rrb.View:
    return rrb.TextDocumentView(name="Status", origin="/status")


def _rows(rows: Rows, name: str | None = None) -> rrb.Container:
    """Views below each other, each with its share of the height."""
    return rrb.Vertical(*(view for _, view in rows), row_shares=[share for share, _ in rows], name=name)


def _columns(rows: Rows, name: str) -> rrb.Container:
    """Views in two columns of about the same number."""
    half = (len(rows) + 1) // 2
    return rrb.Horizontal(*(_rows(column) for column in (rows[:half], rows[half:]) if column), name=name)


def _scene(candidates: bool) -> rrb.View:
    return _space(
        "Vehicle frame: recent returns (blue low, white high), LiDAR fan, drone with 95 % ellipsoid, truth white",
        ["/vehicle/**", "/labels/**", "/lidar/**", "/frames/**"],
        frame="vehicle",
        eye=rrb.EyeControls3D(
            position=(-38.0, -30.0, 20.0) if candidates else (-22.0, -17.0, 17.0),  # this detector reaches farther
            look_target=(5.0, 0.5, 15.0) if candidates else (5.0, 0.5, 7.0),
            eye_up=(0.0, 0.0, 1.0),
        ),
        grid_m=5.0,
    )


def _close_up() -> rrb.View:
    return _space(
        "Close-up: follows the drone",
        ["/vehicle/**", "/frames/**"],
        frame=DRONE_FRAME,
        eye=rrb.EyeControls3D(position=(-2.6, -2.0, 1.4), look_target=(0.0, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0)),
        grid_m=None,
    )


def _detection(depth_images: bool, candidates: bool) -> rrb.Container:
    lidar_range = rrb.TensorView(
        name="LiDAR range",
        origin="/range",
        contents="/range/**",
        view_fit="fill",
        scalar_mapping=rrb.TensorScalarMapping(colormap="turbo", mag_filter="nearest"),
    )
    rows: Rows = []
    if depth_images or not candidates:
        score = _image("Score (bright: similar to a drone)", ["/score/**", "/overlays/**"])
        depth = _image("Depth image, up (blue near, red far)", ["/depth/**", "/overlays/**"])
        rows.append((40, rrb.Horizontal(depth, score)))
    rows.append((36, rrb.TextDocumentView(name="Candidates: reasons", origin="/candidates")))
    if candidates:
        title = "Drone [%]: best violet, second grey, rejected red; accepted from green on"
        rows.append((34, _curves(title, "/plots/probability/**")))
    rows.append((20, lidar_range))
    return rrb.Horizontal(_scene(candidates), _rows(rows), name="Detection")


def _camera_views(vision: Vision) -> Rows:
    """The camera views, each with its share of the column's height."""
    rows: Rows = []
    if vision.images:
        rows.append((30, rrb.Horizontal(*_image_views(vision))))
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
        rows.append(
            (
                13,
                _curves(
                    "Yaw [%]: matches or branches green, orange, violet, blue, none red; "
                    "within 20 deg of the best grey",
                    "/plots/branch/**",
                ),
            )
        )
    if vision.rotation or vision.pose:
        rows += _rotation_views()
    if vision.odometry:
        matches = _curves("Drone odometry: inlier features", "/plots/matches/**")
        sigma = _curves("Sigma of the motion [deg]: rotation grey, direction yellow", "/plots/motion_sigma/**")
        rows.append((11, rrb.Horizontal(matches, sigma)))
    return rows


def _rotation_views() -> Rows:
    return [
        (14, _curves("Rotation in the vehicle frame [deg]: roll red, pitch green, yaw blue", "/plots/rotation/**")),
        (12, _curves("Sigma of the rotation [deg], about x red, y green, z blue", "/plots/rotation_sigma/**")),
    ]


def _image_views(vision: Vision) -> list[rrb.View]:
    return [_image(frame_id.replace("_", " "), [f"/camera/{frame_id}/**"]) for frame_id in vision.images]


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


def _curves(name: str, contents: str | list[str], *, legend: bool = False) -> rrb.TimeSeriesView:
    """Curves over the whole run. A legend covers data, so a view has one only if its name cannot list the colours."""
    return rrb.TimeSeriesView(
        name=name,
        origin="/plots",
        contents=contents,
        axis_x=_WHOLE_RUN,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
    )
