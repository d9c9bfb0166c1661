"""How the cameras' messages look: the picture, its lines and the directions these run in, the features followed.

They stand on their own picture only: where that one was left out, lines and directions are on the sphere alone.

Source: ours, for P IV, V.B, V.C and V.E. A fisheye is no pinhole: rays are drawn where its lens puts them.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from links.viewer import colours
from links.viewer.lenses import arcs, pixels_of, strips
from links.viewer.marks import Marks, lane_of, plot, say, stage_of, state, strip_batch
from links.viewer.scene import Mark, Picture, Scene, sphere_frame
from stages.geometry.frames import Array64
from stages.messages import FollowedFeatures, Image, VanishingDirections

PICTURE_PX = 480  # longer side of a picture in the viewer
JPEG_QUALITY = 75
LINE_POINTS = 0.8


def image(message: Image, name: str, scene: Scene) -> Marks:
    """The picture, small; in a live run not every one."""
    del name  # a picture is its camera's, whatever link brings it
    if not scene.picture_is_due(message.frame_id, message.stamp_ns):
        return
    height, width = message.grey.shape
    factor = min(1.0, PICTURE_PX / max(height, width))
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    small = message.grey if factor == 1.0 else cv2.resize(message.grey, size, interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    scene.pictures[message.frame_id] = Picture(message.stamp_ns, width, height, factor)
    picture = rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg", draw_order=-10)
    yield Mark(f"camera/{message.frame_id}/picture", picture)


def vanishing_directions(message: VanishingDirections, name: str, scene: Scene) -> Marks:
    """Lines by the colour of their direction, on the sphere and on the picture; without directions the reason."""
    by_direction = direction_colours(message)
    by_line = np.append(by_direction, np.uint32(colours.UNASSIGNED))[message.line_direction]  # -1 is the last
    found = len(message.direction) > 0
    words = _words(message)
    yield from state(lane_of(name), "directions" if found else "no directions", scene)
    if not found and scene.changed(f"log/{name}", message.reason):
        yield say(name, message.reason, "WARN")
    elif found and scene.has_said(f"log/{name}") and scene.changed(f"log/{name}", "found"):
        yield say(name, f"again {words}")
    yield scene.now(6, stage_of(name), words)
    assigned = int(np.count_nonzero(message.line_direction >= 0))
    counts = [len(message.line_direction), assigned]
    yield plot(f"plots/other/{name}/lines", counts, ["lines", "lines with a direction"])
    if found:
        sigma_deg = [math.degrees(message.sigma_rad.min()), math.degrees(message.sigma_rad.max())]
        yield plot(f"plots/other/{name}/sigma", sigma_deg, ["best direction's sigma [deg]", "worst"])
    points, arc = arcs(message.line_end)
    yield from _sphere(message, f"sphere/{name}", points, arc, by_line, by_direction)
    yield from _on_picture(message, name, points, arc, by_line, by_direction, scene)


def followed_features(message: FollowedFeatures, name: str, scene: Scene) -> Marks:
    """Each feature as a stroke from where it was to where it is: green where it agrees with the motion found."""
    agree = int(np.count_nonzero(message.agrees))
    yield plot(f"plots/other/{name}/features", [len(message.agrees), agree], ["features followed", "that agree"])
    if agree:
        median_deg = math.degrees(float(np.median(message.residual_rad[message.agrees])))
        yield plot(f"plots/other/{name}/residual", [median_deg], ["residual of those that agree, median [deg]"])
    picture = scene.pictures.get(message.frame_id)
    if picture is None or picture.stamp_ns != message.stamp_ns:
        return
    strokes = np.stack([picture.shown(message.pixel_from), picture.shown(message.pixel_to)], axis=1)
    packed = np.where(message.agrees, np.uint32(colours.GOOD), np.uint32(colours.BAD))
    path = f"camera/{message.frame_id}/{name}"
    lines = rr.LineStrips2D(
        strokes.astype(np.float32), colors=packed, radii=rr.Radius.ui_points(LINE_POINTS), draw_order=10
    )
    yield Mark(f"{path}/strokes", lines)
    ends = rr.Points2D(strokes[:, 1], colors=packed, radii=rr.Radius.ui_points(1.5), draw_order=11)
    yield Mark(f"{path}/ends", ends)


def direction_colours(message: VanishingDirections) -> NDArray[np.uint32]:
    """Packed colour (n,) of each direction: one for the vertical, a hue for each horizontal pair.

    Of a pair the direction nearer to the camera_mount's x axis is the full one, the other the pale one: it keeps its
    colour
    from picture to picture as long as its camera_mount turns little.
    """
    packed = np.full(len(message.direction), colours.VERTICAL, dtype=np.uint32)
    for pair in np.unique(message.frame[~message.is_vertical]):
        members = np.flatnonzero(~message.is_vertical & (message.frame == pair))
        forward = np.abs(message.direction[members, 0])
        hues = colours.PAIRS[int(pair) % len(colours.PAIRS)]
        packed[members] = hues[1]
        packed[members[np.argmax(forward)]] = hues[0]
    return packed


def _sphere(
    message: VanishingDirections,
    path: str,
    points: Array64,
    arc: NDArray[np.int64],
    by_line: NDArray[np.uint32],
    by_direction: NDArray[np.uint32],
) -> Marks:
    frame = sphere_frame(message.camera_mount)
    drawn, lengths, owner = strips(points, arc)
    lines = rr.LineStrips3D(strip_batch(drawn, lengths), colors=by_line[owner], radii=rr.Radius.ui_points(1.0))
    yield Mark(f"{path}/lines", lines, frame=frame)
    both = 1.15 * np.stack([-message.direction, message.direction], axis=1)  # a direction's sign means nothing
    through = rr.LineStrips3D(both.astype(np.float32), colors=by_direction, radii=rr.Radius.ui_points(2.5))
    yield Mark(f"{path}/directions", through, frame=frame)


def _on_picture(
    message: VanishingDirections,
    name: str,
    points: Array64,
    arc: NDArray[np.int64],
    by_line: NDArray[np.uint32],
    by_direction: NDArray[np.uint32],
    scene: Scene,
) -> Marks:
    frame_id = f"camera_{message.camera_mount.value}"
    picture = scene.pictures.get(frame_id)
    if picture is None or picture.stamp_ns != message.stamp_ns:
        return
    path = f"camera/{frame_id}/{name}"
    text = [message.reason] if len(message.direction) == 0 else []
    at = np.tile([[0.5 * picture.width_px, 0.08 * picture.height_px]], (len(text), 1))
    yield Mark(
        f"{path}/reason",
        rr.Points2D(
            picture.shown(at), labels=text, show_labels=True, colors=colours.COASTING, radii=0.0, draw_order=40
        ),
    )
    camera = scene.cameras.of(message.camera_mount)
    if camera is None:
        raise LookupError(
            f"no lens for the picture of {frame_id}, so no lines on it: give the viewer `cameras: $rig.cameras`"
        )
    if camera.size_px is not None and camera.size_px != picture.width_px:
        raise ValueError(
            f"the picture of {frame_id} is {picture.width_px} px wide, its lens in `cameras` is for {camera.size_px}: "
            "is this the rig of this recording?"
        )
    drawn, lengths, owner = strips(picture.shown(pixels_of(camera, points)), arc)
    lines = rr.LineStrips2D(
        strip_batch(drawn, lengths), colors=by_line[owner], radii=rr.Radius.ui_points(LINE_POINTS), draw_order=20
    )
    yield Mark(f"{path}/lines", lines)
    targets = picture.shown(pixels_of(camera, np.concatenate([message.direction, -message.direction])))
    seen = np.isfinite(targets).all(axis=1)
    yield Mark(
        f"{path}/points",
        rr.Points2D(
            targets[seen], colors=np.tile(by_direction, 2)[seen], radii=rr.Radius.ui_points(4.0), draw_order=30
        ),
    )


def _words(message: VanishingDirections) -> str:
    if len(message.direction) == 0:
        return message.reason
    kinds = [
        "vertical" if up else f"pair {pair + 1}" for up, pair in zip(message.is_vertical, message.frame, strict=True)
    ]
    each = [f"{kind} +-{math.degrees(s):.2f} deg" for kind, s in zip(kinds, message.sigma_rad, strict=True)]
    assigned = int(np.count_nonzero(message.line_direction >= 0))
    return f"{', '.join(each)}; {assigned} of {len(message.line_direction)} lines"
