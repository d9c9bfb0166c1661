"""What drawing needs to remember between messages, and what it hands to the logging thread.

Source: ours.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from links.viewer import colours
from stages.geometry import LidarMount, rotation_z, transform
from stages.messages import DepthImage, DroneFix

TIMELINE = "sensor_time"
DRONE_FRAME = "drone_position"  # axes as the vehicle's, origin at the latest fix: the close-up looks from there
FAN_RADIUS_M = 12.0
NEAR_DRONE_M = 1.0
TURNTABLE_EVERY_NS = 20_000_000
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


class Scene:
    """Memory of one run, bounded: trails, the last depth image's geometry, the last word of each state."""

    def __init__(self, *, mount: LidarMount | None, history_s: float, slice_s: float, max_points: int, trail_s: float):
        self.mount = mount
        self.max_points = max_points
        self.trail_s = trail_s
        self.slice_ns = int(slice_s * 1e9)
        self.slices = max(1, round(history_s / slice_s))
        self.depth: DepthImage | None = None
        self.fixes: dict[str, DroneFix] = {}
        self._lines: dict[tuple[int, str], str] = {}
        self._turned_ns = -TURNTABLE_EVERY_NS
        self._said: dict[str, str] = {}
        self._trails: dict[str, deque[tuple[int, NDArray[np.float32]]]] = {}

    def changed(self, path: str, word: str) -> bool:
        """Is `word` another than the last one said at `path`?"""
        if self._said.get(path) == word:
            return False
        self._said[path] = word
        return True

    def turntable_is_due(self, stamp_ns: int) -> bool:
        """The turntable is moved 50 times a second at most, however often the servo answers."""
        if 0 <= stamp_ns - self._turned_ns < TURNTABLE_EVERY_NS:
            return False
        self._turned_ns = stamp_ns
        return True

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

    def now(self, rank: int, topic: str, text: str) -> Mark:
        """The page that tells the present in words: one line per topic, always the newest."""
        self._lines[rank, topic] = text
        rows = "\n\n".join(f"**{topic}:** {line}" for (_, topic), line in sorted(self._lines.items()))
        return Mark("now", rr.TextDocument(rows, media_type=rr.MediaType.MARKDOWN))

    def colours(self, xyz_m: NDArray[np.float32]) -> NDArray[np.uint32]:
        """Packed colours (n,) of returns (n, 3): by height, warm within 1 m of a latest fix."""
        packed = colours.by_height(xyz_m[:, 2])
        for fix in self.fixes.values():
            near = np.linalg.norm(xyz_m - fix.xyz_vehicle_m, axis=1) < NEAR_DRONE_M
            packed[near] = colours.DRONE
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


def drone_transform(xyz_vehicle_m: NDArray[np.float64]) -> rr.Transform3D:
    """The close-up's frame: the vehicle's axes, moved to the drone."""
    return _transform(transform(np.eye(3), xyz_vehicle_m), "vehicle", DRONE_FRAME)


def turntable_transform(mount: LidarMount, servo_rad: float) -> rr.Transform3D:
    """T_vehicle_turntable Rz(angle) for a servo position."""
    turn = rotation_z(float(mount.turntable_rad(np.array([servo_rad]))[0]))
    return _transform(mount.T_vehicle_turntable.matrix() @ transform(turn, np.zeros(3)), "vehicle", "turntable")


def _transform(T_parent_child: NDArray[np.float64], parent: str, child: str) -> rr.Transform3D:
    return rr.Transform3D(
        translation=T_parent_child[:3, 3], mat3x3=T_parent_child[:3, :3], parent_frame=parent, child_frame=child
    )
