"""Draws candidates with their reasons, detections, and each drone with its fix, trail and track state.

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np
import rerun as rr

from links.viewer import colours
from links.viewer.draw_sensors import project_to_depth_image
from links.viewer.entities import (
    Entities,
    Entity,
    clear,
    ellipsoids,
    label,
    log_entry,
    plot,
    stage_of,
    state_change,
    state_path,
)
from links.viewer.scene import DRONE_FRAME, ViewerScene, drone_transform
from stages.geometry.frames import Array64
from stages.messages import CandidateEvidence, Candidates, Detections, DroneFix, KernelScores, TrackingState, TrackState

RING_PX = 14.0  # radius of the ring around a candidate in the images
MAX_LABELS = 3  # of the most probable candidates
PROBABILITY_COLOURS = np.array([colours.CANDIDATE, colours.NEUTRAL, colours.GOOD], dtype=np.uint32)
DETECTION_COLOURS = np.array([colours.ACCEPTED, colours.REJECTED | 0xFF], dtype=np.uint32)
HITS_COLOURS = np.array([colours.DRONE], dtype=np.uint32)
PREDICTED_COLOURS = {
    TrackingState.CANDIDATE: colours.CANDIDATE,
    TrackingState.TRACKING: colours.NEUTRAL,
    TrackingState.COASTING: colours.COASTING,
}


def candidates(message: Candidates, name: str, scene: ViewerScene) -> Entities:
    """Points coloured by fate (followed, accepted, else by probability), reasons, an entry for each removed one."""
    for number, last in scene.removed_candidates(name, message):
        unseen_s = (message.stamp_ns - last.seen_ns) * 1e-9
        text = f"candidate {number} removed at {_percent(last.probability)}, no return for {unseen_s:.1f} s"
        yield log_entry(name, f"{text}: {last.reason}", "WARN" if last.probability >= 0.5 else "INFO")
    xyz_m, packed = message.xyz_vehicle_m, colours.by_probability(message.probability)
    heads = [f"{number}: {_percent(p)}" for number, p in zip(message.candidate_id, message.probability, strict=True)]
    full = [f"candidate {head}, {reason}" for head, reason in zip(heads, message.reasons, strict=True)]
    followed, accepted = scene.followed(xyz_m), message.probability >= message.accept_probability
    packed = np.where(accepted, np.uint32(colours.ACCEPTED), packed).astype(np.uint32)
    packed = np.where(followed, np.uint32(colours.DRONE), packed).astype(np.uint32)
    radii = rr.Radius.ui_points(np.where(followed, 9.0, 5.0))
    dots = rr.Points3D(xyz_m, colors=packed, radii=radii, labels=full, show_labels=False)
    yield Entity(f"vehicle/{name}", dots, frame="vehicle")
    labelled = np.argsort(-message.probability, kind="stable")[:MAX_LABELS]
    labelled = np.union1d(labelled, np.flatnonzero(followed))
    labelled = labelled[~scene.near_a_drone(xyz_m[labelled])]  # a tracked drone has its own label
    texts = [f"{heads[i]}, followed" if followed[i] else heads[i] for i in labelled]
    yield label(name, xyz_m[labelled], texts, packed[labelled])
    best = [*np.sort(100.0 * message.probability)[::-1], 0.0, 0.0]
    yield plot(
        f"plots/probability/{name}",
        [*best[:2], 100.0 * message.accept_probability],
        ["most probable candidate", "second", "accepted from here on"],
        PROBABILITY_COLOURS,
    )
    rows = [
        f"{head}, last return {(message.stamp_ns - seen_ns) * 1e-9:.1f} s ago at {_xyz(xyz)} m: {reason}"
        for head, seen_ns, xyz, reason in zip(heads, message.seen_ns, xyz_m, message.reasons, strict=True)
    ]
    yield scene.reasons(1, f"{stage_of(name)}, now", rows or ["no candidate"])


def detections(message: Detections, name: str, scene: ViewerScene) -> Entities:
    """Accepted and rejected candidates of a search, with reasons: in 3D, in the depth image and as text."""
    evidence = message.evidence
    if isinstance(evidence, CandidateEvidence):
        numbers, confidence = evidence.candidate_id, [_percent(p) for p in evidence.probability]
    else:
        numbers, confidence = np.arange(1, len(message.accepted) + 1), [f"e = {e:.1f}" for e in evidence.e]
    for kind, chosen, colour in (
        ("rejected", ~message.accepted, colours.REJECTED),
        ("accepted", message.accepted, colours.ACCEPTED),
    ):
        xyz_m = message.xyz_vehicle_m[chosen]
        labels = [f"candidate {numbers[k]}, {confidence[k]}: {message.reasons[k]}" for k in np.flatnonzero(chosen)]
        points = rr.Points3D(xyz_m, colors=colour, radii=rr.Radius.ui_points(5.0), labels=labels, show_labels=False)
        yield Entity(f"vehicle/{name}/{kind}", points, frame="vehicle")
        heads = [text.split(",")[0] for text in labels]
        if scene.depth is not None:
            yield _rings(scene, f"overlays/{name}/{kind}", xyz_m, heads, colour, show_labels=kind == "accepted")
        if kind == "accepted" and isinstance(evidence, KernelScores):  # else Candidates draws its current position
            yield label(name, xyz_m, heads, colour)
    if isinstance(evidence, CandidateEvidence):
        percent = 100.0 * evidence.probability
        best = [percent[chosen].max(initial=0.0) for chosen in (message.accepted, ~message.accepted)]
        yield plot(f"plots/probability/{name}", best, ["accepted", "best rejected"], DETECTION_COLOURS)
    found = bool(message.accepted.any())
    yield log_entry(name, message.summary, "INFO" if found else "WARN")
    yield from state_change(state_path(name), "drone" if found else "no drone", scene)
    yield scene.status(2, stage_of(name), message.summary)
    rows = [
        f"{number}: {value}, {'accepted' if accepted else 'rejected'} at {_xyz(xyz)} m: {reason}"
        for number, value, accepted, xyz, reason in zip(
            numbers, confidence, message.accepted, message.xyz_vehicle_m, message.reasons, strict=True
        )
    ]
    yield scene.reasons(2, f"{stage_of(name)}, last search", [message.summary, *rows])


def drone_fix(message: DroneFix, name: str, scene: ViewerScene) -> Entities:
    """One drone: position with 95 % ellipsoid, trail, height above the vehicle, curves."""
    xyz_m, path = message.xyz_vehicle_m, _drone_path(name, message.track_id)
    scene.fixes[name, message.track_id] = message
    if message is next(iter(scene.fixes.values())):  # the close-up follows the first drone of the first tracker
        yield Entity(f"frames/{DRONE_FRAME}", drone_transform(xyz_m))
    scene.estimated(name, message.stamp_ns, xyz_m, message.covariance_m2)
    covariance_m2 = message.covariance_m2[None]
    ellipsoid_path = f"vehicle/{path}/ellipsoid_95"
    yield ellipsoids(ellipsoid_path, xyz_m[None], covariance_m2, colours.DRONE_TRANSLUCENT, filled=True)
    text = f"drone {message.track_id}: {np.linalg.norm(xyz_m):.1f} m, {message.hits} returns"
    yield label(path, xyz_m[None], [text], colours.DRONE)
    thin_line = {"colors": colours.DRONE, "radii": rr.Radius.ui_points(1.0)}
    yield Entity(f"vehicle/{path}/trail", rr.LineStrips3D(scene.trail(path, message), **thin_line), frame="vehicle")
    foot = [xyz_m, [xyz_m[0], xyz_m[1], 0.0]]
    yield Entity(
        f"vehicle/{path}/height",
        rr.LineStrips3D([foot], colors=colours.DRONE_TRANSLUCENT, radii=rr.Radius.ui_points(1.0)),
        frame="vehicle",
    )
    which = "" if message.track_id == 1 else f"drone {message.track_id}: "
    axes = [f"{which}{axis}" for axis in ("x forward", "y left", "z up")]
    yield plot(f"plots/position/{path}", xyz_m, axes, colours.AXES)
    sigma_m = np.sqrt(np.diag(message.covariance_m2))
    yield plot(f"plots/sigma/{path}", sigma_m, [f"{which}sigma {axis}" for axis in "xyz"], colours.AXES)
    if message.mean_shift is not None:
        solver = [message.mean_shift.iterations, message.mean_shift.shift_m]
        yield plot(f"plots/other/{path}", solver, [f"{which}iterations", f"{which}last shift [m]"])
    if message.velocity_vehicle_mps is not None:
        names = [f"{which}{axis} [m/s]" for axis in ("x forward", "y left", "z up")]
        yield plot(f"plots/other/{path}/velocity", message.velocity_vehicle_mps, names)
    text = f"{_xyz(xyz_m, 2)} m forward / left / up, sigma {_xyz(sigma_m, 2)} m, {message.hits} returns"
    yield scene.status(3, f"{stage_of(name)}, drone {message.track_id}", text)


def track_state(message: TrackState, name: str, scene: ViewerScene) -> Entities:
    """State of the tracker per drone, with reason, and the predicted position; its ellipsoid grows while coasting."""
    number = message.track_id
    prefix = f"drone {number}: " if number else ""
    text = f"{message.state.name}: {message.reason}" if message.reason else message.state.name
    if scene.changed(f"log/{name}/{number}", message.state.name):
        is_warning = message.state in (TrackingState.COASTING, TrackingState.LOST)
        yield log_entry(name, prefix + text, "WARN" if is_warning else "INFO")
    yield from state_change(state_path(name), scene.tracker_state(name, message).name, scene)
    path, unnumbered = _drone_path(name, number), f"{name}/candidates"
    if scene.hypotheses_ended(unnumbered, message):
        yield clear(f"vehicle/{unnumbered}")
        scene.status(4, stage_of(name), None)
    if message.state is TrackingState.LOST:
        yield from _clear_lost_drone(message, name, scene)
    elif message.xyz_vehicle_m is not None:
        yield from _predicted(message, path if number else unnumbered, scene)
    if number:
        yield plot(f"plots/hits/{path}", [message.hits], [f"{prefix}returns"], HITS_COLOURS)
    yield plot(f"plots/other/{name}/frame_s", [message.frame_s], ["frame [s]"])
    lost = message.state is TrackingState.LOST
    topic = f"{stage_of(name)}, drone {number}" if number and not lost else stage_of(name)
    yield scene.status(4, topic, prefix + text if lost else text)


def _predicted(message: TrackState, path: str, scene: ViewerScene) -> Entities:
    """95 % ellipsoids and arrows of one second of motion: of one drone, or of all recent unnumbered hypotheses."""
    shown = [message] if message.track_id else scene.hypotheses(path, message)
    colour = PREDICTED_COLOURS.get(message.state, colours.NEUTRAL)
    uncertain = [s for s in shown if s.covariance_m2 is not None]
    centres = np.array([s.xyz_vehicle_m for s in uncertain]).reshape(-1, 3)
    covariances = np.array([s.covariance_m2 for s in uncertain]).reshape(-1, 3, 3)
    yield ellipsoids(f"vehicle/{path}/predicted", centres, covariances, colour, filled=False)
    moving = [s for s in shown if s.velocity_vehicle_mps is not None]
    arrows = rr.Arrows3D(
        origins=np.array([s.xyz_vehicle_m for s in moving]).reshape(-1, 3),
        vectors=np.array([s.velocity_vehicle_mps for s in moving]).reshape(-1, 3),
        colors=colour,
        radii=rr.Radius.ui_points(1.5),
    )
    yield Entity(f"vehicle/{path}/velocity", arrows, frame="vehicle")
    if message.track_id:
        yield from state_change(f"{state_path(path)}/drone_{message.track_id}", message.state.name, scene)
        if message.covariance_m2 is not None:
            sigma_m = math.sqrt(float(np.linalg.eigvalsh(message.covariance_m2)[-1]))
            names = [f"drone {message.track_id}: predicted, largest"]
            style = np.array([colours.COASTING], dtype=np.uint32)
            yield plot(f"plots/sigma/{path}", [sigma_m], names, style, dots=False)


def _clear_lost_drone(message: TrackState, name: str, scene: ViewerScene) -> Entities:
    """Clear all entities of a lost drone but its trail."""
    path = _drone_path(name, message.track_id)
    yield clear(f"vehicle/{path}")
    lane = f"{state_path(name)}/drone_{message.track_id}"
    if scene.has_value(lane):
        yield from state_change(lane, message.state.name, scene)
    for output in scene.forget_drone(stage_of(name), message.track_id):
        fix_path = _drone_path(output, message.track_id)
        for cleared in (f"vehicle/{fix_path}/ellipsoid_95", f"vehicle/{fix_path}/height", f"labels/{fix_path}"):
            yield clear(cleared)


def _rings(
    scene: ViewerScene, path: str, xyz_m: Array64, labels: list[str], colour: int, *, show_labels: bool
) -> Entity:
    assert scene.depth is not None
    pixels, inside = project_to_depth_image(scene.depth, xyz_m)
    rings = rr.Ellipses2D(
        centers=pixels[inside],
        half_sizes=np.full((int(inside.sum()), 2), RING_PX),
        colors=colour,
        line_radii=rr.Radius.ui_points(1.5),
        labels=[text for text, visible in zip(labels, inside, strict=True) if visible],
        show_labels=show_labels,
        draw_order=30,
    )
    return Entity(path, rings)


def _drone_path(name: str, track_id: int) -> str:
    return f"{name}/drone_{track_id}"


def _percent(probability: float) -> str:
    return f"{100.0 * probability:.1f} %"


def _xyz(vector: Array64, decimals: int = 1) -> str:
    return " / ".join(f"{value:.{decimals}f}" for value in vector)
