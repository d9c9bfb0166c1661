"""How the answers look: what may be a drone and why, what was taken for one, each drone with its track.

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np
import rerun as rr

from links.viewer import colours, images
from links.viewer.marks import Marks, clear, ellipsoids, label, lane_of, plot, say, stage_of, state
from links.viewer.scene import DRONE_FRAME, Mark, Scene, drone_transform
from stages.geometry.frames import Array64
from stages.messages import Candidates, Detections, DroneFix, TrackingState, TrackState

RING_PX = 14.0  # around a candidate in the images
PROBABILITY_COLOURS = np.array([colours.MAYBE, colours.NEUTRAL], dtype=np.uint32)
ANSWER_COLOURS = np.array([colours.ACCEPTED, colours.REFUSED | 0xFF], dtype=np.uint32)
HITS_COLOURS = np.array([colours.DRONE], dtype=np.uint32)
PREDICTED_COLOURS = {
    TrackingState.CANDIDATE: colours.MAYBE,
    TrackingState.TRACKING: colours.NEUTRAL,
    TrackingState.COASTING: colours.COASTING,
}


def candidates(message: Candidates, name: str, scene: Scene) -> Marks:
    """Dots by probability, a page of what speaks for and against each; what is dropped is said for good."""
    for number, last in scene.no_longer(name, message):
        unseen_s = (message.stamp_ns - last.seen_ns) * 1e-9
        words = f"candidate {number} is out at {_percent(last.probability)}, unseen for {unseen_s:.1f} s"
        yield say(name, f"{words}: {last.reason}", "WARN" if last.probability >= 0.5 else "INFO")
    xyz_m, packed = message.xyz_vehicle_m, colours.by_probability(message.probability)
    heads = [f"{number}: {_percent(p)}" for number, p in zip(message.candidate_id, message.probability, strict=True)]
    full = [f"candidate {head}, {reason}" for head, reason in zip(heads, message.reasons, strict=True)]
    dots = rr.Points3D(xyz_m, colors=packed, radii=rr.Radius.ui_points(5.0), labels=full, show_labels=False)
    yield Mark(f"vehicle/{name}", dots, frame="vehicle")
    apart = ~scene.near_a_drone(xyz_m)  # a tracked drone has its own label
    yield label(name, xyz_m[apart], [head for head, alone in zip(heads, apart, strict=True) if alone], packed[apart])
    best = [*np.sort(100.0 * message.probability)[::-1], 0.0, 0.0]
    yield plot(f"plots/probability/{name}", best[:2], ["most probable candidate", "the next"], PROBABILITY_COLOURS)
    rows = [
        f"{head}, seen {(message.stamp_ns - seen_ns) * 1e-9:.1f} s ago at {_xyz(xyz)} m: {reason}"
        for head, seen_ns, xyz, reason in zip(heads, message.seen_ns, xyz_m, message.reasons, strict=True)
    ]
    yield scene.why(1, f"{stage_of(name)}, now", rows or ["no candidate"])


def detections(message: Detections, name: str, scene: Scene) -> Marks:
    """The answer of a search: what was accepted and what refused, and why: in 3D, in the image and on a page."""
    numbers = np.arange(1, len(message.score) + 1) if message.candidate_id is None else message.candidate_id
    sure = [f"e = {e:.1f}" for e in message.score]
    if message.probability is not None:
        sure = [_percent(p) for p in message.probability]
    for kind, chosen, colour in (
        ("refused", ~message.accepted, colours.REFUSED),
        ("accepted", message.accepted, colours.ACCEPTED),
    ):
        xyz_m = message.xyz_vehicle_m[chosen]
        labels = [f"candidate {numbers[k]}, {sure[k]}: {message.reasons[k]}" for k in np.flatnonzero(chosen)]
        points = rr.Points3D(xyz_m, colors=colour, radii=rr.Radius.ui_points(5.0), labels=labels, show_labels=False)
        yield Mark(f"vehicle/{name}/{kind}", points, frame="vehicle")
        if scene.depth is not None:
            yield _rings(scene, f"marks/{name}/{kind}", xyz_m, labels, colour, said=kind == "accepted")
        if kind == "accepted" and message.candidate_id is None:  # else Candidates tells where it is now
            yield label(name, xyz_m, [text.split(",")[0] for text in labels], colour)
    if message.probability is not None:
        percent = 100.0 * message.probability
        best = [percent[chosen].max(initial=0.0) for chosen in (message.accepted, ~message.accepted)]
        yield plot(f"plots/probability/{name}", best, ["accepted", "best refused"], ANSWER_COLOURS)
    found = bool(message.accepted.any())
    yield say(name, message.summary, "INFO" if found else "WARN")
    yield from state(lane_of(name), "drone" if found else "no drone", scene)
    yield scene.now(2, stage_of(name), message.summary)
    rows = [
        f"{number}: {said}, {'accepted' if accepted else 'refused'} at {_xyz(xyz)} m: {reason}"
        for number, said, accepted, xyz, reason in zip(
            numbers, sure, message.accepted, message.xyz_vehicle_m, message.reasons, strict=True
        )
    ]
    yield scene.why(2, f"{stage_of(name)}, last answer", [message.summary, *rows])


def drone_fix(message: DroneFix, name: str, scene: Scene) -> Marks:
    """One drone: where, how sure, its way so far."""
    xyz_m, one = message.xyz_vehicle_m, _one(name, message.track_id)
    scene.fixes[name, message.track_id] = message
    if message is next(iter(scene.fixes.values())):  # with several drones or trackers the close-up follows the first
        yield Mark(f"frames/{DRONE_FRAME}", drone_transform(xyz_m))
    path = f"vehicle/{one}/ellipsoid_95"
    yield ellipsoids(path, xyz_m[None], message.covariance_m2[None], colours.DRONE_VEIL, filled=True)
    text = f"drone {message.track_id}: {np.linalg.norm(xyz_m):.1f} m, {message.hits} hits"
    yield label(one, xyz_m[None], [text], colours.DRONE)
    thin_line = {"colors": colours.DRONE, "radii": rr.Radius.ui_points(1.0)}
    yield Mark(f"vehicle/{one}/trail", rr.LineStrips3D(scene.trail(one, message), **thin_line), frame="vehicle")
    foot = [xyz_m, [xyz_m[0], xyz_m[1], 0.0]]
    yield Mark(
        f"vehicle/{one}/height",
        rr.LineStrips3D([foot], colors=colours.DRONE_VEIL, radii=rr.Radius.ui_points(1.0)),
        frame="vehicle",
    )
    which = "" if message.track_id == 1 else f"drone {message.track_id}: "
    axes = [f"{which}{axis}" for axis in ("x forward", "y left", "z up")]
    yield plot(f"plots/position/{one}", xyz_m, axes, colours.AXES)
    sigma_m = np.sqrt(np.diag(message.covariance_m2))
    yield plot(f"plots/sigma/{one}", sigma_m, [f"{which}sigma {axis}" for axis in "xyz"], colours.AXES)
    work = [message.iterations, message.shift_m]
    yield plot(f"plots/other/{one}", work, [f"{which}iterations", f"{which}last shift [m]"])
    if message.velocity_vehicle_mps is not None:
        names = [f"{which}{axis} [m/s]" for axis in ("x forward", "y left", "z up")]
        yield plot(f"plots/other/{one}/velocity", message.velocity_vehicle_mps, names)
    words = f"{_xyz(xyz_m, 2)} m forward / left / up, sigma {_xyz(sigma_m, 2)} m, {message.hits} hits"
    yield scene.now(3, f"{stage_of(name)}, drone {message.track_id} at", words)


def track_state(message: TrackState, name: str, scene: Scene) -> Marks:
    """What the tracker does, per drone, and where it expects each: while one coasts, its ellipsoid grows."""
    number = message.track_id
    who = f"drone {number}: " if number else ""
    words = f"{message.state.name}: {message.reason}" if message.reason else message.state.name
    if scene.changed(f"log/{name}/{number}", message.state.name):
        warns = message.state in (TrackingState.COASTING, TrackingState.LOST)
        yield say(name, who + words, "WARN" if warns else "INFO")
    yield from state(lane_of(name), scene.overall(name, message).name, scene)
    one, unnumbered = _one(name, number), f"{name}/candidates"
    if scene.none_left(unnumbered, message):
        yield clear(f"vehicle/{unnumbered}")
        scene.now(4, stage_of(name), None)
    if message.state is TrackingState.LOST:
        yield from _leave(message, name, scene)
    elif message.xyz_vehicle_m is not None:
        yield from _predicted(message, one if number else unnumbered, scene)
    if number:
        yield plot(f"plots/hits/{one}", [message.hits], [f"{who}hits"], HITS_COLOURS)
    yield plot(f"plots/other/{name}/frame_s", [message.frame_s], ["frame [s]"])
    gone = message.state is TrackingState.LOST
    topic = f"{stage_of(name)}, drone {number}" if number and not gone else stage_of(name)
    yield scene.now(4, topic, who + words if gone else words)


def _predicted(message: TrackState, path: str, scene: Scene) -> Marks:
    """Ellipsoids and arrows, as long as one second of flight; of the hypotheses without number all that are fresh."""
    shown = [message] if message.track_id else scene.hypotheses(path, message)
    colour = PREDICTED_COLOURS.get(message.state, colours.NEUTRAL)
    spread = [s for s in shown if s.covariance_m2 is not None]
    centres = np.array([s.xyz_vehicle_m for s in spread]).reshape(-1, 3)
    covariances = np.array([s.covariance_m2 for s in spread]).reshape(-1, 3, 3)
    yield ellipsoids(f"vehicle/{path}/predicted", centres, covariances, colour, filled=False)
    moving = [s for s in shown if s.velocity_vehicle_mps is not None]
    arrows = rr.Arrows3D(
        origins=np.array([s.xyz_vehicle_m for s in moving]).reshape(-1, 3),
        vectors=np.array([s.velocity_vehicle_mps for s in moving]).reshape(-1, 3),
        colors=colour,
        radii=rr.Radius.ui_points(1.5),
    )
    yield Mark(f"vehicle/{path}/velocity", arrows, frame="vehicle")
    if message.track_id:
        yield from state(f"{lane_of(path)}/drone_{message.track_id}", message.state.name, scene)
        if message.covariance_m2 is not None:
            sigma_m = math.sqrt(float(np.linalg.eigvalsh(message.covariance_m2)[-1]))
            names = [f"drone {message.track_id}: predicted, widest"]
            style = np.array([colours.COASTING], dtype=np.uint32)
            yield plot(f"plots/sigma/{path}", [sigma_m], names, style, dots=False)


def _leave(message: TrackState, name: str, scene: Scene) -> Marks:
    """A lost drone leaves its way behind, and nothing that could be taken for a drone."""
    one = _one(name, message.track_id)
    yield clear(f"vehicle/{one}")
    lane = f"{lane_of(name)}/drone_{message.track_id}"
    if scene.has_said(lane):
        yield from state(lane, message.state.name, scene)
    for output in scene.forget_drone(stage_of(name), message.track_id):
        fixed = _one(output, message.track_id)
        for part in (f"vehicle/{fixed}/ellipsoid_95", f"vehicle/{fixed}/height", f"labels/{fixed}"):
            yield clear(part)


def _rings(scene: Scene, path: str, xyz_m: Array64, labels: list[str], colour: int, *, said: bool) -> Mark:
    assert scene.depth is not None
    pixels, inside = images.project(scene.depth, xyz_m)
    rings = rr.Ellipses2D(
        centers=pixels[inside],
        half_sizes=np.full((int(inside.sum()), 2), RING_PX),
        colors=colour,
        line_radii=rr.Radius.ui_points(1.5),
        labels=[text for text, seen in zip(labels, inside, strict=True) if seen],
        show_labels=said,
        draw_order=30,
    )
    return Mark(path, rings)


def _one(name: str, track_id: int) -> str:
    return f"{name}/drone_{track_id}"


def _percent(probability: float) -> str:
    return f"{100.0 * probability:.1f} %"


def _xyz(vector: Array64, decimals: int = 1) -> str:
    return " / ".join(f"{value:.{decimals}f}" for value in vector)
