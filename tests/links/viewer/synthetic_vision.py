"""Images, lines and rotations of a run with two fisheyes, built by hand, without any stage."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import synthetic

from flow.message import Message
from stages.geometry.frames import rotation_z
from stages.geometry.rig import RigCameras
from stages.messages import BranchState, CameraMount, Image, RelativeRotation, VanishingDirections, VisualMotion

SIZE_PX = 720
FOCAL_PX = 170.0
PERIOD_NS = 100_000_000
CAMERA = {
    "lens": {"model": "equidistant", "focal_px": FOCAL_PX, "centre_px": [359.5, 359.5]},
    "size_px": SIZE_PX,
    "masked_px": [],
    "max_off_axis_deg": 110.0,
}
RIG_CAMERAS = {
    "vehicle": CAMERA
    | {"T_vehicle_camera": {"rpy_deg": [0.0, 0.0, 90.0]}},  # points up, image right is left's opposite
    "drone": CAMERA | {"T_drone_camera": {"rpy_deg": [180.0, 0.0, -90.0]}},
}
CAMERAS = RigCameras.model_validate(RIG_CAMERAS)
DIRECTIONS = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0], [0.6, 0.8, 0], [-0.8, 0.6, 0]])
FRAMES = np.array([-1, 0, 0, 1, 1])
MERMAID = (
    synthetic.EVIDENCE_MERMAID
    + "    camera_vehicle -- image --> vp_vehicle\n    vp_vehicle -- vanishing_directions --> align\n"
    + "    drone_odometry -- visual_motion --> align\n    align -. relative_rotation .-> align_relative_rotation(( ))\n"
)


def camera_image(stamp_ns: int = 0, frame_id: str = "camera_vehicle", size_px: int = SIZE_PX) -> Image:
    grey = np.tile(np.linspace(30, 220, size_px).astype(np.uint8), (size_px, 1))
    return Image(stamp_ns=stamp_ns, frame_id=frame_id, grey=grey)


def ends_along(direction: np.ndarray, seed: int, side: float) -> np.ndarray:
    """Unit rays (2, 3) to two points of one line that runs along `direction`."""
    start = np.random.default_rng(seed).normal((0.0, 0.0, 3.0 * side))
    both = np.stack([start, start + 2.0 * direction])
    return both / np.linalg.norm(both, axis=1, keepdims=True)


def directions(
    stamp_ns: int = 0, camera_mount: CameraMount = CameraMount.VEHICLE, count: int = 5
) -> VanishingDirections:
    """The vertical and two horizontal pairs, or the first of them, with five lines each and five of none."""
    side = 1.0 if camera_mount is CameraMount.VEHICLE else -1.0
    other = np.array([0.5, -0.5, 0.7071])
    along = [*(d for d in DIRECTIONS[:count] for _ in range(5)), *([other] * 5)]
    ends = np.array([ends_along(d, k, side) for k, d in enumerate(along)])
    normal = np.cross(ends[:, 0], ends[:, 1])
    return VanishingDirections(
        stamp_ns=stamp_ns,
        camera_mount=camera_mount,
        direction=DIRECTIONS[:count],
        sigma_rad=np.deg2rad([0.1, 0.2, 0.3, 0.4, 0.5])[:count],
        is_vertical=FRAMES[:count] < 0,
        frame=FRAMES[:count],
        line_normal=normal / np.linalg.norm(normal, axis=1, keepdims=True),
        line_end=ends,
        line_sigma_rad=np.full(len(ends), 0.005),
        line_direction=np.repeat([*range(count), -1], 5),
        reason="" if count else "no structure: 5 lines, a pair needs 4",
    )


def one_line(
    ends: np.ndarray, stamp_ns: int = 0, camera_mount: CameraMount = CameraMount.VEHICLE
) -> VanishingDirections:
    """The vertical, and one line with these ends (2, 3) that runs along it."""
    message = directions(stamp_ns, camera_mount, 1)
    return dataclasses.replace(
        message,
        line_end=ends[None],
        line_normal=message.line_normal[:1],
        line_sigma_rad=message.line_sigma_rad[:1],
        line_direction=np.array([0]),
    )


def rotation(stamp_ns: int = 0, **changes) -> RelativeRotation:
    covariance = np.diag(np.deg2rad([0.1, 0.2, 0.4]) ** 2)
    branches, state = np.array([0.6, 0.2, 0.1, 0.05]), BranchState.AMBIGUOUS
    settled = RelativeRotation.one(
        stamp_ns, rotation_z(np.deg2rad(30.0)), covariance, branches, state, 0, "waits for motion"
    )
    return dataclasses.replace(settled, **changes)


def motion(stamp_ns: int = PERIOD_NS, **changes) -> VisualMotion:
    moved = VisualMotion(
        stamp_ns=stamp_ns,
        from_ns=stamp_ns - PERIOD_NS,
        R_from_to=rotation_z(np.deg2rad(90.0)),
        covariance_rad2=np.diag(np.deg2rad([0.1, 0.3, 0.2]) ** 2),
        direction_from=np.array([1.0, 0.0, 0.0]),
        direction_sigma_rad=np.deg2rad(2.0),
        matches=120,
        reason="",
    )
    return dataclasses.replace(moved, **changes)


def run(duration_s: float) -> Iterator[tuple[str, Message]]:
    """A run with candidates and both cameras at 10 Hz; every fifth image of the drone has no structure."""
    due_ns, k = synthetic.START_NS, 0
    for output, content in synthetic.run_by_evidence(duration_s):
        yield output, content
        if content.stamp_ns < due_ns:
            continue
        yield "camera_vehicle.image", camera_image(due_ns)
        yield "camera_drone.image", camera_image(due_ns, "camera_drone")
        yield "vp_vehicle.vanishing_directions", directions(due_ns)
        blind = k % 5 == 4
        yield "vp_drone.vanishing_directions", directions(due_ns, CameraMount.DRONE, 0 if blind else 3)
        if k:
            still = {"direction_from": None, "direction_sigma_rad": None, "reason": "no motion"}
            yield "drone_odometry.visual_motion", motion(due_ns, **(still if k % 3 == 0 else {}))
        none = RelativeRotation.none(due_ns, "no structure")
        yield "align.relative_rotation", none if blind else rotation(due_ns, switches=k // 6)
        due_ns, k = due_ns + PERIOD_NS, k + 1
