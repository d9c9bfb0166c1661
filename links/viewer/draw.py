"""How each message looks in Rerun: one function per message type. A type without one is drawn field by field.

Entity paths are a group, then the output (`vehicle/sweep/swept_points`):

| group                          | what                                                        |
| ------------------------------ | ----------------------------------------------------------- |
| vehicle/, labels/, lidar/      | 3D: in the vehicle frame, its dots with words, in the lidar's |
| frames/                        | the named frames vehicle -> turntable -> lidar, drone_position |
| depth/, score/, range/, marks/ | images, and what is marked on them                          |
| plots/                         | curves, by quantity                                         |
| states/                        | lanes: one word at a time                                   |
| log/, now, about/              | sentences, the present in words, the graph and the settings |

Source: ours. Names and traps of Rerun 0.41: DESIGN, Links.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections.abc import Iterator
from functools import singledispatch
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from flow.message import Message
from links.viewer import colours, images
from links.viewer.ellipsoid import ellipsoid
from links.viewer.scene import DRONE_FRAME, Mark, Scene, drone_transform, turntable_transform
from links.viewer.slices import thin
from stages.geometry import quaternions_xyzw
from stages.messages import (
    DepthImage,
    Detections,
    DroneFix,
    LidarFirings,
    ScoreImage,
    ServoGoal,
    ServoState,
    SweptPoints,
    TrackingState,
    TrackState,
)

RING_PX = 14.0  # around a candidate in the images
Marks = Iterator[Mark]


@singledispatch
def draw(message: Any, name: str, scene: Scene) -> Marks:
    """What to log for a message of output `name` ("track/drone_fix"). This body: any type without its own function."""
    for field in dataclasses.fields(message):
        if field.name != "stamp_ns":
            yield from _draw_field(getattr(message, field.name), f"{name}/{field.name}", scene)


def _draw_field(value: Any, name: str, scene: Scene) -> Marks:
    if isinstance(value, Message) or dataclasses.is_dataclass(value):
        yield from draw.registry[object](value, name, scene)
    elif isinstance(value, enum.Enum):
        yield from _state(f"states/{name}", value.name, scene)
    elif isinstance(value, str | tuple | None):
        if scene.changed(name, str(value)):
            yield _say(name, str(value))
    elif isinstance(value, bytes):
        yield _plot(f"plots/other/{name}", [len(value)], [f"{name} bytes"])
    elif 0 < np.size(value) <= 9:
        names = [name] if np.size(value) == 1 else [f"{name} {i}" for i in range(np.size(value))]
        yield _plot(f"plots/other/{name}", np.ravel(value).astype(np.float64), names)
    elif np.ndim(value) == 2 and np.shape(value)[1] == 3 and name.endswith("_vehicle_m"):
        shown = value[thin(np.asarray(value, dtype=np.float32), scene.max_points)]
        yield Mark(f"vehicle/{name}", rr.Points3D(shown, colors=colours.NEUTRAL), frame="vehicle")
    else:
        finite = np.asarray(value, dtype=np.float64)
        finite = finite[np.isfinite(finite)]
        summary = [finite.size, finite.min(), finite.mean(), finite.max()] if finite.size else [0, 0, 0, 0]
        yield _plot(f"plots/other/{name}", summary, [f"{name} {w}" for w in ("finite", "min", "mean", "max")])


@draw.register
def _(message: LidarFirings, name: str, scene: Scene) -> Marks:
    yield Mark(f"range/{name}", images.range_image(message))
    yield _plot(f"plots/other/{name}/lost_packets", [message.lost_packets], [f"{name} lost packets"])
    yield from _state(_lane(name), "packets lost" if message.lost_packets else "ok", scene)


@draw.register
def _(message: ServoState, name: str, scene: Scene) -> Marks:
    angles_deg = np.rad2deg([message.position_rad, message.goal_rad])
    yield _plot(f"plots/servo/{name}", angles_deg, ["servo", "goal"])
    yield _plot(f"plots/other/{name}/velocity", [math.degrees(message.velocity_radps)], ["servo [deg/s]"])
    yield from _state(_lane(name), f"error 0x{message.error:02X}" if message.error else "ok", scene)
    if scene.mount is not None and scene.mount.turns and scene.turntable_is_due(message.stamp_ns):
        yield Mark("frames/turntable", turntable_transform(scene.mount, message.position_rad))


@draw.register
def _(message: ServoGoal, name: str, scene: Scene) -> Marks:
    yield _plot(f"plots/servo/{name}", [math.degrees(message.position_rad)], ["asked"])
    yield _plot(f"plots/other/{name}/speed", [math.degrees(message.speed_radps)], ["asked [deg/s]"])


@draw.register
def _(message: SweptPoints, name: str, scene: Scene) -> Marks:
    """One slice of the cloud. The slices of `history_s` take turns, so at any time the last of them are all there."""
    xyz_m = message.xyz_vehicle_m[thin(message.xyz_vehicle_m, scene.max_points)]
    turn = message.stamp_ns // scene.slice_ns % scene.slices
    points = rr.Points3D(xyz_m, colors=scene.colours(xyz_m), radii=rr.Radius.ui_points(1.2))
    yield Mark(f"vehicle/{name}/slice_{turn:02d}", points, frame="vehicle")
    yield _plot(f"plots/other/{name}", [message.pulses, len(message.xyz_vehicle_m)], ["pulses", "returns"])


@draw.register
def _(message: DepthImage, name: str, scene: Scene) -> Marks:
    scene.depth = message
    yield Mark(f"depth/{name}", images.depth_image(message))
    yield Mark("marks/axes", images.axes(message))
    counts = [message.points, message.returns]
    yield _plot(f"plots/other/{name}", counts, ["returns in image", "returns of sweep"])
    yield scene.now(1, _stage(name), f"{message.points} of {message.returns} returns fell into the depth image")


@draw.register
def _(message: ScoreImage, name: str, scene: Scene) -> Marks:
    del scene
    yield Mark(f"score/{name}", images.score_image(message))


@draw.register
def _(message: Detections, name: str, scene: Scene) -> Marks:
    for kind, chosen, colour in (
        ("refused", ~message.accepted, colours.REFUSED),
        ("accepted", message.accepted, colours.ACCEPTED),
    ):
        xyz_m = message.xyz_vehicle_m[chosen]
        labels = [f"candidate {k + 1}: {message.reasons[k]}" for k in np.flatnonzero(chosen)]
        points = rr.Points3D(xyz_m, colors=colour, radii=rr.Radius.ui_points(5.0), labels=labels, show_labels=False)
        yield Mark(f"vehicle/{name}/{kind}", points, frame="vehicle")
        if scene.depth is not None:
            pixels, inside = images.project(scene.depth, xyz_m)
            rings = rr.Ellipses2D(
                centers=pixels[inside],
                half_sizes=np.full((int(inside.sum()), 2), RING_PX),
                colors=colour,
                line_radii=rr.Radius.ui_points(1.5),
                labels=[label for label, seen in zip(labels, inside, strict=True) if seen],
                show_labels=kind == "accepted",
                draw_order=30,
            )
            yield Mark(f"marks/{name}/{kind}", rings)
        if kind == "accepted":
            yield _label(name, xyz_m, [label.split(":")[0] for label in labels], colour)
    found = bool(message.accepted.any())
    yield _say(name, message.verdict, "INFO" if found else "WARN")
    yield from _state(_lane(name), "drone" if found else "no drone", scene)
    yield scene.now(2, _stage(name), message.verdict)


@draw.register
def _(message: DroneFix, name: str, scene: Scene) -> Marks:
    xyz_m = message.xyz_vehicle_m
    scene.fixes[name] = message
    if name == next(iter(scene.fixes)):  # with several trackers the close-up follows the first
        yield Mark(f"frames/{DRONE_FRAME}", drone_transform(xyz_m))
    half_sizes_m, rotation = ellipsoid(message.covariance_m2)
    yield Mark(
        f"vehicle/{name}/ellipsoid_95",
        rr.Ellipsoids3D(
            centers=[xyz_m],
            half_sizes=[half_sizes_m],
            quaternions=[rr.Quaternion(xyzw=quaternions_xyzw(rotation[None])[0])],
            colors=colours.DRONE_VEIL,
            fill_mode=rr.components.FillMode.TransparentFillMajorWireframe,
        ),
        frame="vehicle",
    )
    label = f"drone {np.linalg.norm(xyz_m):.1f} m, {message.hits} hits"
    yield _label(name, xyz_m[None], [label], colours.DRONE)
    thin_line = {"colors": colours.DRONE, "radii": rr.Radius.ui_points(1.0)}
    yield Mark(f"vehicle/{name}/trail", rr.LineStrips3D(scene.trail(name, message), **thin_line), frame="vehicle")
    foot = [xyz_m, [xyz_m[0], xyz_m[1], 0.0]]
    yield Mark(
        f"vehicle/{name}/height",
        rr.LineStrips3D([foot], colors=colours.DRONE_VEIL, radii=rr.Radius.ui_points(1.0)),
        frame="vehicle",
    )
    yield _plot(f"plots/position/{name}", xyz_m, ["x forward", "y left", "z up"], colours.AXES)
    sigma_m = np.sqrt(np.diag(message.covariance_m2))
    yield _plot(f"plots/sigma/{name}", sigma_m, ["sigma x", "sigma y", "sigma z"], colours.AXES)
    work = [message.iterations, message.shift_m]
    yield _plot(f"plots/other/{name}", work, ["iterations", "last shift [m]"])
    where, spread = (" / ".join(f"{value:.2f}" for value in vector) for vector in (xyz_m, sigma_m))
    words = f"{where} m forward / left / up, sigma {spread} m, {message.hits} hits"
    yield scene.now(3, f"{_stage(name)}, drone at", words)


@draw.register
def _(message: TrackState, name: str, scene: Scene) -> Marks:
    if scene.changed(f"log/{name}", message.state.name):
        level = "WARN" if message.state is TrackingState.LOST else "INFO"
        yield _say(name, f"{message.state.name}: {message.reason}", level)
    yield from _state(_lane(name), message.state.name, scene)
    yield _plot(f"plots/hits/{name}", [message.hits], ["hits in frame"], np.array([colours.DRONE], dtype=np.uint32))
    yield _plot(f"plots/other/{name}/frame_s", [message.frame_s], ["frame [s]"])
    yield scene.now(4, _stage(name), f"{message.state.name}: {message.reason}")


def _stage(name: str) -> str:
    return name.split("/", 1)[0]


def _lane(name: str) -> str:
    return f"states/{_stage(name)}"


def _plot(path: str, values: Any, names: list[str], line_colours: NDArray[np.uint32] | None = None) -> Mark:
    """Curves; the few that matter have their own colours, and a dot at each sample: a lone fix is no line."""

    def style() -> list[Any]:
        look = {"names": names or None, "colors": line_colours}
        dots = [] if line_colours is None else rr.SeriesPoints(**look).as_component_batches()
        return [*rr.SeriesLines(**look).as_component_batches(), *dots]

    return Mark(path, rr.Scalars(values), style=style)


def _label(name: str, xyz_vehicle_m: NDArray[np.float64], texts: list[str], colour: int) -> Mark:
    """Dots with words, visible from any distance; apart from the rest, so that the close-up can do without."""
    dots = rr.Points3D(xyz_vehicle_m, colors=colour, radii=rr.Radius.ui_points(5.0), labels=texts, show_labels=True)
    return Mark(f"labels/{name}", dots, frame="vehicle")


def _say(name: str, text: str, level: str = "INFO") -> Mark:
    return Mark(f"log/{name}", rr.TextLog(text, level=level))


_LANE = {
    "SEARCHING": colours.NEUTRAL,
    "TRACKING": colours.GOOD,
    "LOST": colours.BAD,
    "drone": colours.GOOD,
    "no drone": colours.NEUTRAL,
    "ok": colours.GOOD,
    "packets lost": colours.BAD,
}


def _state(path: str, word: str, scene: Scene) -> Marks:
    """A lane changes when its word does; the same word again is no new state."""
    if scene.changed(path, word):
        yield Mark(path, rr.StateChange(state=word), style=_lane_style)


def _lane_style() -> rr.StateConfiguration:
    return rr.StateConfiguration(values=list(_LANE), colors=np.array(list(_LANE.values()), dtype=np.uint32))
