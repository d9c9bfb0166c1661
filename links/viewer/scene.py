"""What drawing needs to remember between messages, and what it hands to the logging thread.

Source: ours.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from links.viewer import colours
from links.viewer.lenses import Cameras
from stages.geometry.frames import Array64, LidarMount, rotation_z, transform
from stages.messages import CameraMount, Candidates, DepthImage, DroneFix, TrackingState, TrackState

TIMELINE = "sensor_time"
DRONE_FRAME = "drone_position"  # axes as the vehicle's, origin at the latest fix: the close-up looks from there
FAN_RADIUS_M = 12.0
SPHERES_APART = 2.8  # radii, between the unit spheres of vehicle and drone
NEAR_DRONE_M = 1.0
TURNTABLE_EVERY_NS = 20_000_000
FRESH_NS = 150_000_000  # a hypothesis is told ten times a second
STATE_HOLDS_NS = 1_000_000_000
FIRST_OF_ALL = (TrackingState.TRACKING, TrackingState.COASTING, TrackingState.CANDIDATE)
FAN_HALF_OPENING_RAD = np.deg2rad(15.0)  # VLP-16 user manual 63-9243: beams from -15 to +15 deg


class Mark:
    """One thing to log: archetypes at an entity path, in a named frame; `style` is made and logged once, static."""

    __slots__ = ("frame", "parts", "path", "style")

    def __init__(
        self, path: str, *parts: Any, frame: str | None = None, style: Callable[[], Any] | None = None
    ) -> None:
        self.path = path
        self.parts = parts
        self.frame = frame
        self.style = style


class Curve(Mark):
    """Numbers (n,) to plot at an entity path."""

    __slots__ = ("values",)

    def __init__(self, path: str, values: Any, style: Callable[[], Any] | None = None) -> None:
        super().__init__(path, style=style)
        self.values = np.asarray(values, dtype=np.float64).ravel()


class Listed(NamedTuple):
    """A candidate as it was told last."""

    probability: float
    seen_ns: int
    reason: str


class Picture(NamedTuple):
    """A camera's picture as it is shown."""

    stamp_ns: int
    width_px: int  # as it was taken
    height_px: int
    factor: float  # shown smaller by

    def shown(self, pixels: Array64) -> Array64:
        """Where pixels (n, 2) of the picture taken, whole numbers at centres, are in the one shown, corner at 0."""
        return (pixels + 0.5) * self.factor


class Scene:
    """Memory of one run, bounded: trails, candidates, the last depth image's geometry, the last word of each state."""

    def __init__(
        self,
        *,
        mount: LidarMount | None,
        history_s: float,
        slice_s: float,
        max_points: int,
        trail_s: float,
        cameras: Cameras | None = None,
        picture_every_s: float = 0.0,
    ):
        self.mount = mount
        self.cameras = cameras or Cameras()
        self.pictures: dict[str, Picture] = {}  # by frame id, the last one shown
        self._picture_every_ns = int(picture_every_s * 1e9)
        self.max_points = max_points
        self.trail_s = trail_s
        self.slice_ns = int(slice_s * 1e9)
        self.slices = max(1, round(history_s / slice_s))
        self.depth: DepthImage | None = None
        self.fixes: dict[tuple[str, int], DroneFix] = {}  # by output and drone, until it is lost
        self._lines: dict[str, dict[tuple[int, str], str]] = {}
        self._listed: dict[str, dict[int, Listed]] = {}
        self._tracks: dict[str, dict[int, TrackState]] = {}
        self._hypotheses: dict[str, list[TrackState]] = {}
        self._turned_ns = -TURNTABLE_EVERY_NS
        self._said: dict[str, str] = {}
        self._trails: dict[str, deque[tuple[int, NDArray[np.float32]]]] = {}

    def changed(self, path: str, word: str) -> bool:
        """Is `word` another than the last one said at `path`?"""
        if self._said.get(path) == word:
            return False
        self._said[path] = word
        return True

    def has_said(self, path: str) -> bool:
        """Was anything said at `path`?"""
        return path in self._said

    def turntable_is_due(self, stamp_ns: int) -> bool:
        """The turntable is moved 50 times a second at most, however often the servo answers."""
        if 0 <= stamp_ns - self._turned_ns < TURNTABLE_EVERY_NS:
            return False
        self._turned_ns = stamp_ns
        return True

    def picture_is_due(self, frame_id: str, stamp_ns: int) -> bool:
        """Has the last picture of this camera been shown long enough?"""
        last = self.pictures.get(frame_id)
        return last is None or not 0 <= stamp_ns - last.stamp_ns < self._picture_every_ns

    def trail(self, name: str, fix: DroneFix) -> list[NDArray[np.float32]]:
        """Strips (n, 3) through the fixes of the last `trail_s`; a pause of a second starts a new strip."""
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

    def no_longer(self, name: str, candidates: Candidates) -> list[tuple[int, Listed]]:
        """Candidates told last time and not any more: dropped, or pushed out by better ones; as they were."""
        told = zip(candidates.probability.tolist(), candidates.seen_ns.tolist(), candidates.reasons, strict=True)
        now = dict(zip(candidates.candidate_id.tolist(), (Listed(*each) for each in told), strict=True))
        before = self._listed.get(name, {})
        self._listed[name] = now
        return [(number, last) for number, last in before.items() if number not in now]

    def overall(self, name: str, track: TrackState) -> TrackingState:
        """What a tracker with several drones and hypotheses does, in one word: the most that it does for any."""
        tracks = self._tracks.setdefault(name, {})
        tracks[track.track_id] = track
        for number in [n for n, t in tracks.items() if not 0 <= track.stamp_ns - t.stamp_ns < STATE_HOLDS_NS]:
            del tracks[number]
        states = {each.state for each in tracks.values()}
        return next((first for first in FIRST_OF_ALL if first in states), track.state)

    def hypotheses(self, path: str, track: TrackState) -> list[TrackState]:
        """This one and the others without a number that were told just before."""
        fresh = [t for t in self._hypotheses.get(path, []) if 0 <= track.stamp_ns - t.stamp_ns < FRESH_NS]
        self._hypotheses[path] = [*fresh[-15:], track]
        return self._hypotheses[path]

    def none_left(self, path: str, track: TrackState) -> bool:
        """Were there hypotheses without a number, and are they over? True once."""
        last = self._hypotheses.get(path)
        if not last or (track.track_id == 0 and track.state is TrackingState.CANDIDATE):
            return False
        if track.track_id and track.stamp_ns - last[-1].stamp_ns < 2 * FRESH_NS:
            return False
        del self._hypotheses[path]
        return True

    def forget_drone(self, stage: str, track_id: int) -> list[str]:
        """A stage lost a drone: forget its fixes and what is said of it now; the outputs that told where it was."""
        names = [name for name, number in self.fixes if number == track_id and name.split("/", 1)[0] == stage]
        for name in names:
            del self.fixes[name, track_id]
            self._trails.pop(f"{name}/drone_{track_id}", None)
        for rank, topic in list(self._lines.get("now", {})):
            if topic.startswith(f"{stage}, drone {track_id}"):
                self.now(rank, topic, None)
        return names

    def now(self, rank: int, topic: str, text: str | None) -> Mark:
        """The page that tells the present in words: one line per topic, always the newest; None: nothing to tell."""
        return self._page("now", rank, topic, text and f"**{topic}:** {text}")

    def why(self, rank: int, topic: str, rows: list[str]) -> Mark:
        """The page that tells why each candidate is taken for a drone or not."""
        return self._page("candidates", rank, topic, "\n".join([f"**{topic}**\n", *(f"- {row}" for row in rows)]))

    def _page(self, path: str, rank: int, topic: str, text: str | None) -> Mark:
        lines = self._lines.setdefault(path, {})
        lines.pop((rank, topic), None)
        if text is not None:
            lines[rank, topic] = text
        together = "\n\n".join(line for _, line in sorted(lines.items()))
        return Mark(path, rr.TextDocument(together, media_type=rr.MediaType.MARKDOWN))

    def near_a_drone(self, xyz_m: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Which of the points (n, 3) lie within 1 m of a latest fix."""
        near = np.zeros(len(xyz_m), dtype=np.bool_)
        for fix in self.fixes.values():
            near |= np.linalg.norm(xyz_m - fix.xyz_vehicle_m, axis=1) < NEAR_DRONE_M
        return near

    def colours(self, xyz_m: NDArray[np.float32]) -> NDArray[np.uint32]:
        """Packed colours (n,) of returns (n, 3): by height, warm within 1 m of a latest fix."""
        packed = colours.by_height(xyz_m[:, 2])
        packed[self.near_a_drone(xyz_m)] = colours.DRONE
        return packed


def scenery(mount: LidarMount | None) -> Iterator[Mark]:
    """What never changes: the vehicle's axes and, with a mount, the LiDAR's frame and the fan its beams lie in."""
    axes = rr.Arrows3D(vectors=np.diag([5.0, 2.5, 2.5]), colors=colours.AXES, radii=rr.Radius.ui_points(2.0))
    yield Mark("vehicle/axes", axes, frame="vehicle")
    labels = ["vehicle", "forward"]
    name = rr.Points3D([[0, 0, 0], [5, 0, 0]], labels=labels, show_labels=True, colors=colours.NEUTRAL)
    yield Mark("vehicle/name", name, frame="vehicle")
    if mount is None:
        return
    lidar = mount.T_turntable_lidar.matrix()
    yield Mark("frames/lidar", _transform(lidar, "turntable", "lidar"))
    turn = np.linspace(0, 2 * np.pi, 73)
    circle = np.stack([np.sin(turn), np.cos(turn), np.zeros_like(turn)], axis=1)
    c, s = np.cos(FAN_HALF_OPENING_RAD), np.sin(FAN_HALF_OPENING_RAD)
    edges = [FAN_RADIUS_M * (c * circle + [0, 0, s * side]) for side in (-1, 1)]
    fan = rr.LineStrips3D(edges, colors=colours.FAN, radii=rr.Radius.ui_points(1.0))
    yield Mark("lidar/fan", fan, frame="lidar")


def opening(mount: LidarMount | None) -> Iterator[Mark]:
    """Frames that move later, at rest at the start: without them a view has no way from one frame to another."""
    yield Mark(f"frames/{DRONE_FRAME}", drone_transform(np.zeros(3)))
    if mount is not None:
        yield Mark("frames/turntable", turntable_transform(mount, math.radians(mount.servo_zero_deg)))


def spheres() -> Iterator[Mark]:
    """The unit spheres of both carriers' directions, side by side."""
    for camera_mount in CameraMount:
        frame = sphere_frame(camera_mount)
        ball = rr.Ellipsoids3D(
            half_sizes=[[1.0, 1.0, 1.0]],
            colors=0xFFFFFF18,
            line_radii=rr.Radius.ui_points(0.5),
            fill_mode=rr.components.FillMode.MajorWireframe,
        )
        yield Mark(f"sphere/{camera_mount.value}/ball", ball, frame=frame)
        axes = rr.Arrows3D(vectors=0.35 * np.eye(3), colors=colours.AXES, radii=rr.Radius.ui_points(1.5))
        yield Mark(f"sphere/{camera_mount.value}/axes", axes, frame=frame)
    yield _sphere_name(CameraMount.VEHICLE, "vehicle")


def sphere_frame(camera_mount: CameraMount) -> str:
    """The camera_mount's axes, at the middle of its unit sphere."""
    return f"sphere_{camera_mount.value}"


def drone_sphere(R_vehicle_drone: Array64 | None, how: str = "own axes") -> Iterator[Mark]:
    """The drone's sphere beside the vehicle's, turned as the drone is; None: that is not known. `how` it is turned."""
    at = np.array([0.0, -SPHERES_APART, 0.0])
    R = np.eye(3) if R_vehicle_drone is None else R_vehicle_drone
    vehicle, drone = sphere_frame(CameraMount.VEHICLE), sphere_frame(CameraMount.DRONE)
    yield Mark(f"frames/{drone}", _transform(transform(R, at), vehicle, drone))
    yield _sphere_name(CameraMount.DRONE, f"drone, {how}")


def _sphere_name(camera_mount: CameraMount, text: str) -> Mark:
    above = [[0.0, -SPHERES_APART * (camera_mount is CameraMount.DRONE), 1.4]]
    words = rr.Points3D(above, labels=[text], show_labels=True, colors=colours.NEUTRAL, radii=0.0)
    return Mark(f"sphere/{camera_mount.value}/name", words, frame=sphere_frame(CameraMount.VEHICLE))


def drone_transform(xyz_vehicle_m: NDArray[np.float64]) -> rr.Transform3D:
    """The close-up's frame: the vehicle's axes, moved to the drone."""
    return _transform(transform(np.eye(3), xyz_vehicle_m), "vehicle", DRONE_FRAME)


def turntable_transform(mount: LidarMount, servo_rad: float) -> rr.Transform3D:
    """T_vehicle_turntable Rz(angle) for a servo position."""
    turn = rotation_z(mount.turntable_rad(servo_rad))
    return _transform(mount.T_vehicle_turntable.matrix() @ transform(turn, np.zeros(3)), "vehicle", "turntable")


def _transform(T_parent_child: NDArray[np.float64], parent: str, child: str) -> rr.Transform3D:
    return rr.Transform3D(
        translation=T_parent_child[:3, 3], mat3x3=T_parent_child[:3, :3], parent_frame=parent, child_frame=child
    )
