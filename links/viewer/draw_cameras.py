"""Draws the cameras' messages: images, lines with their vanishing directions, tracked features.

Lines and features are drawn on the image with their stamp. When that image is not logged, lines and directions are
drawn on the sphere alone. Rays are projected with the fisheye's lens model, because Rerun's Pinhole does not fit it.

Source: ours, for P IV, V.B, V.C and V.E.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from links.viewer import colours
from links.viewer.entities import Entities, Entity, log_entry, plot, stage_of, state_change, state_path, strip_batch
from links.viewer.lenses import arcs, pixels_of, strips
from links.viewer.scene import LoggedImage, ViewerScene, sphere_frame
from stages.geometry.frames import Array64
from stages.geometry.rig import width_height_px
from stages.messages import FollowedFeatures, Image, VanishingDirections

IMAGE_PX = 480  # longer side of a logged image
JPEG_QUALITY = 75
LINE_POINTS = 0.8


def image(message: Image, name: str, scene: ViewerScene) -> Entities:
    """The image, scaled down; a live run logs only some of them."""
    del name  # the entity path is that of the camera, for every link
    if not scene.image_is_due(message.frame_id, message.stamp_ns):
        return
    height, width = message.grey.shape
    scale = min(1.0, IMAGE_PX / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = message.grey if scale == 1.0 else cv2.resize(message.grey, size, interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    scene.images[message.frame_id] = LoggedImage(message.stamp_ns, width, height, scale)
    encoded = rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg", draw_order=-10)
    yield Entity(f"camera/{message.frame_id}/image", encoded)


def vanishing_directions(message: VanishingDirections, name: str, scene: ViewerScene) -> Entities:
    """Lines in the colour of their direction, on the sphere and on the image; without directions the reason."""
    by_direction = direction_colours(message)
    by_line = np.append(by_direction, np.uint32(colours.UNASSIGNED))[message.line_direction]  # -1 selects the last
    found = len(message.direction) > 0
    text = _summary(message)
    yield from state_change(state_path(name), "directions" if found else "no directions", scene)
    if not found and scene.changed(f"log/{name}", message.reason):
        yield log_entry(name, message.reason, "WARN")
    elif found and scene.has_value(f"log/{name}") and scene.changed(f"log/{name}", "found"):
        yield log_entry(name, f"found again: {text}")
    yield scene.status(6, stage_of(name), text)
    assigned = int(np.count_nonzero(message.line_direction >= 0))
    counts = [len(message.line_direction), assigned]
    yield plot(f"plots/other/{name}/lines", counts, ["lines", "lines with a direction"])
    if found:
        sigma_deg = [math.degrees(message.sigma_rad.min()), math.degrees(message.sigma_rad.max())]
        yield plot(f"plots/other/{name}/sigma", sigma_deg, ["smallest sigma of a direction [deg]", "largest"])
    points, arc = arcs(message.line_end)
    yield from _sphere(message, f"sphere/{name}", points, arc, by_line, by_direction)
    yield from _on_image(message, name, points, arc, by_line, by_direction, scene)


def followed_features(message: FollowedFeatures, name: str, scene: ViewerScene) -> Entities:
    """Each feature as a line from its previous to its current pixel: green for inliers, red for others."""
    inliers = int(np.count_nonzero(message.agrees))
    yield plot(f"plots/other/{name}/features", [len(message.agrees), inliers], ["tracked features", "inliers"])
    if inliers:
        median_deg = math.degrees(float(np.median(message.residual_rad[message.agrees])))
        yield plot(f"plots/other/{name}/residual", [median_deg], ["median residual of the inliers [deg]"])
    logged = scene.images.get(message.frame_id)
    if logged is None or logged.stamp_ns != message.stamp_ns:
        return
    segments = np.stack([logged.scaled(message.pixel_from), logged.scaled(message.pixel_to)], axis=1)
    packed = np.where(message.agrees, np.uint32(colours.GOOD), np.uint32(colours.BAD))
    path = f"camera/{message.frame_id}/{name}"
    lines = rr.LineStrips2D(
        segments.astype(np.float32), colors=packed, radii=rr.Radius.ui_points(LINE_POINTS), draw_order=10
    )
    yield Entity(f"{path}/displacements", lines)
    ends = rr.Points2D(segments[:, 1], colors=packed, radii=rr.Radius.ui_points(1.5), draw_order=11)
    yield Entity(f"{path}/ends", ends)


def direction_colours(message: VanishingDirections) -> NDArray[np.uint32]:
    """Packed colour (n,) of each direction: one for the vertical, a hue for each horizontal pair.

    In a pair the direction nearer to the mount's x axis is saturated and the other one pale, so each keeps its colour
    from image to image while the mount rotates little.
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
) -> Entities:
    frame = sphere_frame(message.camera_mount)
    drawn, lengths, owner = strips(points, arc)
    lines = rr.LineStrips3D(strip_batch(drawn, lengths), colors=by_line[owner], radii=rr.Radius.ui_points(1.0))
    yield Entity(f"{path}/lines", lines, frame=frame)
    both_signs = 1.15 * np.stack(
        [-message.direction, message.direction], axis=1
    )  # the sign of a direction is arbitrary
    through = rr.LineStrips3D(both_signs.astype(np.float32), colors=by_direction, radii=rr.Radius.ui_points(2.5))
    yield Entity(f"{path}/directions", through, frame=frame)


def _on_image(
    message: VanishingDirections,
    name: str,
    points: Array64,
    arc: NDArray[np.int64],
    by_line: NDArray[np.uint32],
    by_direction: NDArray[np.uint32],
    scene: ViewerScene,
) -> Entities:
    frame_id = f"camera_{message.camera_mount.value}"
    logged = scene.images.get(frame_id)
    if logged is None or logged.stamp_ns != message.stamp_ns:
        return
    path = f"camera/{frame_id}/{name}"
    text = [message.reason] if len(message.direction) == 0 else []
    position = np.tile([[0.5 * logged.width_px, 0.08 * logged.height_px]], (len(text), 1))
    yield Entity(
        f"{path}/reason",
        rr.Points2D(
            logged.scaled(position), labels=text, show_labels=True, colors=colours.COASTING, radii=0.0, draw_order=40
        ),
    )
    camera = scene.cameras.of(message.camera_mount)
    if camera is None:
        raise LookupError(
            f"no lens for the image of {frame_id}, so no lines on it: set `cameras: $rig.cameras` of the viewer"
        )
    if camera.size_px is not None and (width_px := width_height_px(camera.size_px)[0]) != logged.width_px:
        raise ValueError(
            f"the image of {frame_id} is {logged.width_px} px wide, its lens in `cameras` is for {width_px}: "
            "is this the rig of this recording?"
        )
    drawn, lengths, owner = strips(logged.scaled(pixels_of(camera, points)), arc)
    lines = rr.LineStrips2D(
        strip_batch(drawn, lengths), colors=by_line[owner], radii=rr.Radius.ui_points(LINE_POINTS), draw_order=20
    )
    yield Entity(f"{path}/lines", lines)
    targets = logged.scaled(pixels_of(camera, np.concatenate([message.direction, -message.direction])))
    visible = np.isfinite(targets).all(axis=1)
    yield Entity(
        f"{path}/points",
        rr.Points2D(
            targets[visible], colors=np.tile(by_direction, 2)[visible], radii=rr.Radius.ui_points(4.0), draw_order=30
        ),
    )


def _summary(message: VanishingDirections) -> str:
    if len(message.direction) == 0:
        return message.reason
    kinds = [
        "vertical" if up else f"pair {pair + 1}" for up, pair in zip(message.is_vertical, message.frame, strict=True)
    ]
    each = [f"{kind} +-{math.degrees(s):.2f} deg" for kind, s in zip(kinds, message.sigma_rad, strict=True)]
    assigned = int(np.count_nonzero(message.line_direction >= 0))
    return f"{', '.join(each)}; {assigned} of {len(message.line_direction)} lines"
