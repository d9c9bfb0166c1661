"""State that drawing keeps between messages, and the coordinate frames of the 3D views.

Source: ours.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from links.mavlink.poses.gate import PoseLimits
from links.mavlink.profiles import YawOutput
from links.viewer import colours
from links.viewer.entities import Entities, Entity, stage_of
from stages.geometry.frames import Array64, LidarMount, rotation_z, transform
from stages.geometry.rig import RigCameras
from stages.messages import CameraMount, Candidates, DepthImage, DroneFix, TrackingState, TrackState

TIMELINE = "sensor_time"
DRONE_FRAME = "drone_position"  # axes of the vehicle, origin at the latest fix; target frame of the close-up view
FAN_RADIUS_M = 12.0
SPHERE_SPACING = 2.8  # distance of the unit spheres of vehicle and drone [radii]
NEAR_DRONE_M = 1.0
MAX_ESTIMATES = 200_000  # of an output: an hour at 50 Hz
TURNTABLE_PERIOD_NS = 20_000_000
HYPOTHESIS_TIMEOUT_NS = 150_000_000  # a tracker reports each hypothesis ten times a second
STATE_TIMEOUT_NS = 1_000_000_000
STATE_PRIORITY = (TrackingState.TRACKING, TrackingState.COASTING, TrackingState.CANDIDATE)


class LastCandidate(NamedTuple):
    """A candidate as it was in the previous message."""

    probability: float
    seen_ns: int
    reason: str


class Gate(NamedTuple):
    """The autopilot link's gate: which poses it sends."""

    limits: PoseLimits
    yaw: YawOutput


class Estimate(NamedTuple):
    """An estimated position of the drone."""

    stamp_ns: int
    xyz_vehicle_m: Array64  # (3,)
    sigma_m: float  # one sigma, 3D


class LoggedImage(NamedTuple):
    """Size of a camera's image and the scale at which it was logged."""

    stamp_ns: int
    width_px: int  # of the original
    height_px: int
    scale: float  # logged width / original width

    def scaled(self, pixels: Array64) -> Array64:
        """Pixels (n, 2) of the original, integers at pixel centres, in the logged image, 0 at its top left corner."""
        return (pixels + 0.5) * self.scale


class ViewerScene:
    """State of one run, bounded: trails, candidates, last depth image, last value of each state lane."""

    def __init__(
        self,
        *,
        mount: LidarMount | None,
        history_s: float,
        slice_s: float,
        max_points: int,
        trail_s: float,
        cameras: RigCameras | None = None,
        image_period_s: float = 0.0,
        gate: Gate | None = None,
    ):
        """`gate`: of the autopilot link; None: nothing is sent to an autopilot."""
        self.mount = mount
        self.cameras = cameras or RigCameras()
        self.images: dict[str, LoggedImage] = {}  # by frame id, the last one logged
        self._image_period_ns = int(image_period_s * 1e9)
        self.gate = gate
        self.estimates: dict[str, deque[Estimate]] = {}  # by output, for the errors against the truth
        self.max_points = max_points
        self.trail_s = trail_s
        self.slice_ns = int(slice_s * 1e9)
        self.slices = max(1, round(history_s / slice_s))
        self.depth: DepthImage | None = None
        self.fixes: dict[tuple[str, int], DroneFix] = {}  # by output and drone, until it is lost
        self._lines: dict[str, dict[tuple[int, str], str]] = {}
        self._candidates: dict[str, dict[int, LastCandidate]] = {}
        self._tracks: dict[str, dict[int, TrackState]] = {}
        self._hypotheses: dict[str, list[TrackState]] = {}
        self._turntable_ns = -TURNTABLE_PERIOD_NS
        self._last_values: dict[str, str] = {}
        self._trails: dict[str, deque[tuple[int, NDArray[np.float32]]]] = {}

    def changed(self, path: str, value: str) -> bool:
        """Whether `value` differs from the last value stored under `path`; stores it."""
        if self._last_values.get(path) == value:
            return False
        self._last_values[path] = value
        return True

    def estimated(self, name: str, stamp_ns: int, xyz_vehicle_m: Array64, covariance_m2: Array64) -> None:
        """Store an estimated position of the drone of an output."""
        estimates = self.estimates.setdefault(name, deque(maxlen=MAX_ESTIMATES))
        estimates.append(Estimate(stamp_ns, xyz_vehicle_m, math.sqrt(float(covariance_m2.trace()))))

    def followed(self, xyz_m: Array64) -> NDArray[np.bool_]:
        """Mask (n,) of the points (n, 3) within 1 m of a drone or of a hypothesis that the tracker follows."""
        near = self.near_a_drone(xyz_m)
        for hypotheses in self._hypotheses.values():
            for track in hypotheses:
                if track.xyz_vehicle_m is not None:
                    near |= np.linalg.norm(xyz_m - track.xyz_vehicle_m, axis=1) < NEAR_DRONE_M
        return near

    def has_value(self, path: str) -> bool:
        """Whether a value is stored under `path`."""
        return path in self._last_values

    def turntable_is_due(self, stamp_ns: int) -> bool:
        """Whether to log the turntable's frame: at most 50 times a second, at any rate of servo replies."""
        if 0 <= stamp_ns - self._turntable_ns < TURNTABLE_PERIOD_NS:
            return False
        self._turntable_ns = stamp_ns
        return True

    def image_is_due(self, frame_id: str, stamp_ns: int) -> bool:
        """Whether the image period of this camera has passed since its last logged image."""
        last = self.images.get(frame_id)
        return last is None or not 0 <= stamp_ns - last.stamp_ns < self._image_period_ns

    def trail(self, name: str, fix: DroneFix) -> list[NDArray[np.float32]]:
        """Strips (n, 3) through the fixes of the last `trail_s`; a gap of more than one second starts a new strip."""
        trail = self._trails.setdefault(name, deque())
        trail.append((fix.stamp_ns, fix.xyz_vehicle_m.astype(np.float32)))
        while trail[-1][0] - trail[0][0] > self.trail_s * 1e9:
            trail.popleft()
        strips: list[list[NDArray[np.float32]]] = [[]]
        previous_ns = trail[0][0]
        for stamp_ns, xyz in trail:
            if not 0 <= stamp_ns - previous_ns <= 1_000_000_000:
                strips.append([])
            strips[-1].append(xyz)
            previous_ns = stamp_ns
        return [np.array(strip) for strip in strips]

    def removed_candidates(self, name: str, candidates: Candidates) -> list[tuple[int, LastCandidate]]:
        """Candidates of the previous message that are missing in this one, with their last values."""
        rows = zip(candidates.probability.tolist(), candidates.seen_ns.tolist(), candidates.reasons, strict=True)
        now = dict(zip(candidates.candidate_id.tolist(), (LastCandidate(*row) for row in rows), strict=True))
        before = self._candidates.get(name, {})
        self._candidates[name] = now
        return [(number, last) for number, last in before.items() if number not in now]

    def tracker_state(self, name: str, track: TrackState) -> TrackingState:
        """One state for a tracker with several drones and hypotheses: the first of `STATE_PRIORITY` that one is in."""
        tracks = self._tracks.setdefault(name, {})
        tracks[track.track_id] = track
        for number in [n for n, t in tracks.items() if not 0 <= track.stamp_ns - t.stamp_ns < STATE_TIMEOUT_NS]:
            del tracks[number]
        states = {each.state for each in tracks.values()}
        return next((first for first in STATE_PRIORITY if first in states), track.state)

    def hypotheses(self, path: str, track: TrackState) -> list[TrackState]:
        """This hypothesis and the other unnumbered ones of the last `HYPOTHESIS_TIMEOUT_NS`."""
        fresh = [t for t in self._hypotheses.get(path, []) if 0 <= track.stamp_ns - t.stamp_ns < HYPOTHESIS_TIMEOUT_NS]
        self._hypotheses[path] = [*fresh[-15:], track]
        return self._hypotheses[path]

    def hypotheses_ended(self, path: str, track: TrackState) -> bool:
        """Whether the tracker stopped reporting unnumbered hypotheses; true once per end."""
        last = self._hypotheses.get(path)
        if not last or (track.track_id == 0 and track.state is TrackingState.CANDIDATE):
            return False
        if track.track_id and track.stamp_ns - last[-1].stamp_ns < 2 * HYPOTHESIS_TIMEOUT_NS:
            return False
        del self._hypotheses[path]
        return True

    def forget_drone(self, stage: str, track_id: int) -> list[str]:
        """Remove the fixes, trails and status lines of a drone that `stage` lost. Returns their outputs."""
        names = [name for name, number in self.fixes if number == track_id and stage_of(name) == stage]
        for name in names:
            del self.fixes[name, track_id]
            self._trails.pop(f"{name}/drone_{track_id}", None)
        for rank, topic in list(self._lines.get("status", {})):
            if topic.startswith(f"{stage}, drone {track_id}"):
                self.status(rank, topic, None)
        return names

    def status(self, rank: int, topic: str, text: str | None) -> Entity:
        """The status document with a new line for `topic`, lines in order of rank; None removes the line."""
        return self._document("status", rank, topic, text and f"**{topic}:** {text}")

    def reasons(self, rank: int, topic: str, rows: list[str]) -> Entity:
        """The document with the reasons for which candidates are accepted or rejected, with new rows for `topic`."""
        return self._document("candidates", rank, topic, "\n".join([f"**{topic}**\n", *(f"- {row}" for row in rows)]))

    def _document(self, path: str, rank: int, topic: str, text: str | None) -> Entity:
        lines = self._lines.setdefault(path, {})
        lines.pop((rank, topic), None)
        if text is not None:
            lines[rank, topic] = text
        joined = "\n\n".join(line for _, line in sorted(lines.items()))
        return Entity(path, rr.TextDocument(joined, media_type=rr.MediaType.MARKDOWN))

    def near_a_drone(self, xyz_m: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Mask (n,) of the points (n, 3) within 1 m of the latest fix of a drone."""
        near = np.zeros(len(xyz_m), dtype=np.bool_)
        for fix in self.fixes.values():
            near |= np.linalg.norm(xyz_m - fix.xyz_vehicle_m, axis=1) < NEAR_DRONE_M
        return near

    def colours(self, xyz_m: NDArray[np.float32]) -> NDArray[np.uint32]:
        """Packed colours (n,) of returns (n, 3): by height; the drone's colour within 1 m of a latest fix."""
        packed = colours.by_height(xyz_m[:, 2])
        packed[self.near_a_drone(xyz_m)] = colours.DRONE
        return packed


def static_entities(mount: LidarMount | None) -> Entities:
    """Static entities: the vehicle's axes and, with a mount, the LiDAR's frame."""
    axes = rr.Arrows3D(vectors=np.diag([5.0, 2.5, 2.5]), colors=colours.AXES, radii=rr.Radius.ui_points(2.0))
    yield Entity("vehicle/axes", axes, frame="vehicle")
    labels = ["vehicle", "forward"]
    name = rr.Points3D([[0, 0, 0], [5, 0, 0]], labels=labels, show_labels=True, colors=colours.NEUTRAL)
    yield Entity("vehicle/name", name, frame="vehicle")
    if mount is None:
        return
    lidar = mount.T_turntable_lidar.matrix()
    yield Entity("frames/lidar", _transform(lidar, "turntable", "lidar"))


def beam_fan(lowest_rad: float, highest_rad: float) -> Entity:
    """Circles at the elevations of the lowest and the highest beam."""
    turn = np.linspace(0, 2 * np.pi, 73)
    circle = np.stack([np.sin(turn), np.cos(turn), np.zeros_like(turn)], axis=1)
    edges = [FAN_RADIUS_M * (math.cos(w) * circle + [0, 0, math.sin(w)]) for w in (lowest_rad, highest_rad)]
    fan = rr.LineStrips3D(edges, colors=colours.FAN, radii=rr.Radius.ui_points(1.0))
    return Entity("lidar/fan", fan, frame="lidar")


def initial_frames(mount: LidarMount | None) -> Entities:
    """Initial poses of the moving frames. Without them a view cannot transform between frames until one moves."""
    yield Entity(f"frames/{DRONE_FRAME}", drone_transform(np.zeros(3)))
    if mount is not None:
        yield Entity("frames/turntable", turntable_transform(mount, math.radians(mount.servo_zero_deg)))


def spheres() -> Entities:
    """The unit spheres of the directions of both camera mounts, side by side."""
    for camera_mount in CameraMount:
        frame = sphere_frame(camera_mount)
        sphere = rr.Ellipsoids3D(
            half_sizes=[[1.0, 1.0, 1.0]],
            colors=0xFFFFFF18,
            line_radii=rr.Radius.ui_points(0.5),
            fill_mode=rr.components.FillMode.MajorWireframe,
        )
        yield Entity(f"sphere/{camera_mount.value}/surface", sphere, frame=frame)
        axes = rr.Arrows3D(vectors=0.35 * np.eye(3), colors=colours.AXES, radii=rr.Radius.ui_points(1.5))
        yield Entity(f"sphere/{camera_mount.value}/axes", axes, frame=frame)
    yield _sphere_name(CameraMount.VEHICLE, "vehicle")


def sphere_frame(camera_mount: CameraMount) -> str:
    """Name of the frame at the centre of a camera mount's unit sphere."""
    return f"sphere_{camera_mount.value}"


def drone_sphere(R_vehicle_drone: Array64 | None, description: str = "own axes") -> Entities:
    """The drone's sphere next to the vehicle's, rotated by R_vehicle_drone; None: not rotated, because R is unknown."""
    t = np.array([0.0, -SPHERE_SPACING, 0.0])
    R = np.eye(3) if R_vehicle_drone is None else R_vehicle_drone
    vehicle, drone = sphere_frame(CameraMount.VEHICLE), sphere_frame(CameraMount.DRONE)
    yield Entity(f"frames/{drone}", _transform(transform(R, t), vehicle, drone))
    yield _sphere_name(CameraMount.DRONE, f"drone, {description}")


def _sphere_name(camera_mount: CameraMount, text: str) -> Entity:
    above = [[0.0, -SPHERE_SPACING * (camera_mount is CameraMount.DRONE), 1.4]]
    name = rr.Points3D(above, labels=[text], show_labels=True, colors=colours.NEUTRAL, radii=0.0)
    return Entity(f"sphere/{camera_mount.value}/name", name, frame=sphere_frame(CameraMount.VEHICLE))


def drone_transform(xyz_vehicle_m: NDArray[np.float64]) -> rr.Transform3D:
    """Frame of the close-up view: the vehicle's axes at the position of the drone."""
    return _transform(transform(np.eye(3), xyz_vehicle_m), "vehicle", DRONE_FRAME)


def turntable_transform(mount: LidarMount, servo_rad: float) -> rr.Transform3D:
    """T_vehicle_turntable Rz(angle) for a servo position [rad]."""
    turn = rotation_z(mount.turntable_rad(servo_rad))
    return _transform(mount.T_vehicle_turntable.matrix() @ transform(turn, np.zeros(3)), "vehicle", "turntable")


def _transform(T_parent_child: NDArray[np.float64], parent: str, child: str) -> rr.Transform3D:
    return rr.Transform3D(
        translation=T_parent_child[:3, 3], mat3x3=T_parent_child[:3, :3], parent_frame=parent, child_frame=child
    )
