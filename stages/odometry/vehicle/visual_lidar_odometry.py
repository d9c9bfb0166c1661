"""Visual-LiDAR odometry of the vehicle: T_map_vehicle, smooth and drifting.

    image     the motion since the keyframe, 5-DoF (stages/odometry/visual/image_motion.py); no motion keeps the pose
    LiDAR     points, each placed by the vehicle's pose at its time, give depths to the keyframe's features
    length    of the motion: from features with a depth, by the LiDAR or by earlier motion (scale.py)
    keyframe  when a new image becomes the keyframe: bundle adjustment over the last few (window.py)

The start frame is the vehicle frame at the first image or, if the vehicle starts to move before any length is known, at
the first image with a known length. Its z axis is vertical as far as the vehicle is level.

A vehicle with its own odometry does not need this stage. With that odometry wired as `odometry` the stage is inactive
while it is available and accepted. When it falls silent or gives outliers, the stage restarts with the odometry's last
speed (source_selection.py accepts the same poses and joins the two).

Source: P V.B (Harris and KLT, 5-DoF, scale from projected LiDAR points, windowed bundle adjustment).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flow.stage import Settings, Stage
from stages.geometry.extrapolation import GAP_MANEUVER, AcceptedPoses
from stages.geometry.frames import Array64, Pose
from stages.geometry.lens import Lens
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import FollowedFeatures, Image, SweptPoints, VehicleMotion
from stages.odometry.vehicle.image_motion import Pose6, Step, after, is_plausible, vehicle_pose
from stages.odometry.vehicle.lidar_depth import Depths, RayDepths
from stages.odometry.vehicle.scale import Length, length_of, parallax_ratio
from stages.odometry.vehicle.source_selection import SILENT_S
from stages.odometry.vehicle.window import Keyframe, adjusted
from stages.odometry.visual.features import FeatureSettings, Tracks
from stages.odometry.visual.image_motion import Link, LinkSettings, MotionLinks, followed
from stages.odometry.visual.two_view import backwards

TURN_RADPS = 0.3  # one sigma of the turn rate without an image
STILL_M = 0.003  # one sigma of the position while no motion is observed
LEAST_LENGTHS = 3  # the first ones use points placed without a known speed
REMEMBERED = 20_000  # LiDAR points
WAITING_SLICES = 2_000


@dataclass(slots=True)
class _Key:
    """The keyframe: its pose with covariance, and the depths of its features."""

    tracks: Tracks
    at: Pose6
    lidar: RayDepths
    before: Depths  # from the motion before this keyframe


@dataclass(slots=True)
class _Now:
    key: _Key | None = None
    window: list[Keyframe] = field(default_factory=lambda: list[Keyframe]())
    poses: deque[tuple[int, Array64, Array64]] = field(  # the last two: stamp, T_map_camera
        default_factory=lambda: deque[tuple[int, Array64, Array64]](maxlen=2)
    )
    waiting: deque[tuple[NDArray[np.int64], Array64]] = field(  # LiDAR slices not yet placed: stamps, camera frame
        default_factory=lambda: deque[tuple[NDArray[np.int64], Array64]](maxlen=WAITING_SLICES)
    )
    cloud: deque[Array64] = field(default_factory=lambda: deque[Array64]())  # placed, start frame
    lengths: int = 0  # number of lengths measured
    published: bool = False  # the start frame is fixed by a published pose
    speed_mps: float = 0.0
    still_ns: int = 0  # newest time without motion

    @property
    def metric(self) -> bool:
        """Whether lengths are accepted."""
        return self.lengths >= LEAST_LENGTHS


class VisualLidarOdometrySettings(Settings):
    """Settings of `VisualLidarOdometry`."""

    lens: Lens
    T_vehicle_camera: Pose
    features: FeatureSettings = FeatureSettings()
    link: LinkSettings = LinkSettings()
    window_keys: int = Field(6, ge=3, le=12)  # keyframes in the bundle adjustment
    every_nth_point: int = Field(2, ge=1, le=50)  # of the LiDAR's returns
    reach_deg: float = Field(2.0, gt=0.1, le=10)  # LiDAR points within this angle of a feature give its depth
    silent_s: float = Field(SILENT_S, gt=0, le=10)  # of the odometry: at least two of its periods


class VisualLidarOdometry(Stage[VisualLidarOdometrySettings]):
    """T_map_vehicle at every image, by camera and LiDAR; inactive while the vehicle's odometry is available."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"odometry"})

    def __init__(self, settings: VisualLidarOdometrySettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._now = _Now()
        self._odometry = AcceptedPoses()
        self._inactive: bool = False
        settings = self.settings
        self._links = MotionLinks(settings.lens, settings.features, settings.link)
        self._mount: Array64 = settings.T_vehicle_camera.matrix()

    def on_odometry(self, motion: VehicleMotion) -> None:
        """The vehicle's odometry: an accepted pose makes the stage inactive."""
        newest_ns = self._odometry.newest_ns
        if newest_ns is None or motion.stamp_ns > newest_ns:
            self._inactive |= bool(self._odometry.add(motion))

    def on_points(self, points: SweptPoints) -> None:
        """Queue LiDAR returns until an image gives the vehicle's pose."""
        if self._inactive:
            return
        n = self.settings.every_nth_point
        xyz = points.xyz_vehicle_m[::n].astype(np.float64)
        if len(xyz):
            self._now.waiting.append((points.point_stamp_ns[::n], (xyz - self._mount[:3, 3]) @ self._mount[:3, :3]))

    def on_image(self, image: Image) -> Iterator[VehicleMotion | FollowedFeatures]:
        """The vehicle's pose at this image, and the tracked features.

        Nothing while no length is known, without tracked features, and while the vehicle's odometry is available.
        """
        if self._inactive:
            if image.stamp_ns - (self._odometry.newest_ns or 0) < self.settings.silent_s * 1e9:
                return
            self._restart()
        link = self._links.feed(image.stamp_ns, image.grey)
        if link is not None:
            yield followed(link, image.frame_id)
        motion = self._vehicle_motion(image.stamp_ns, link)
        if motion is not None:
            yield motion

    def _vehicle_motion(self, stamp_ns: int, link: Link | None) -> VehicleMotion | None:
        """The vehicle's pose at the newest image."""
        now = self._now
        tracks = self._links.key
        assert tracks is not None, "the first image becomes the keyframe"
        if link is None:
            if tracks.stamp_ns != stamp_ns or (now.key is not None and now.key.tracks is tracks):
                return None  # no newer than the last one
            at = self._extrapolated(stamp_ns)
            self._place(stamp_ns, at)
            now.key = self._new_key(tracks, at, None)
            now.window.clear()
            return self._motion(stamp_ns, at) if now.published else None
        assert now.key is not None
        step = self._step(now.key, link)
        at = after(now.key.at, step)
        self._place(stamp_ns, at)
        if link.last:
            at = self._next_key(now.key, link, step, at, tracks)
        now.published |= now.metric or step.standing
        return self._motion(stamp_ns, at) if now.published else None

    def _restart(self) -> None:
        """Restart at this image, with the speed of the vehicle's odometry if known."""
        settings = self.settings
        self._inactive = False
        self._links = MotionLinks(settings.lens, settings.features, settings.link)
        speed_mps = self._odometry.speed_mps
        self._now = _Now() if speed_mps is None else _Now(lengths=LEAST_LENGTHS, published=True, speed_mps=speed_mps)

    def _next_key(self, key: _Key, link: Link, step: Step, at: Pose6, tracks: Tracks) -> Pose6:
        """Make the newest image the keyframe; return its pose after bundle adjustment."""
        now = self._now
        known = self._known_after(key, link, step)
        if now.metric and not step.standing:
            done = _keyframe(key.tracks, key.at, key.lidar.depths())
            keys = [*now.window, done, _keyframe(tracks, at, _unknown(tracks))][-self.settings.window_keys :]
            keys = adjusted(keys, link.motion.sigma_rad)
            now.window, at = keys[:-1], Pose6(keys[-1].R, keys[-1].p, at.covariance)
        elif not now.published and not step.standing:  # moving without a known length: restart here
            at = Pose6.start()
            now.cloud.clear()
            now.poses.clear()
            now.poses.append((link.now.stamp_ns, at.R, at.p))
        if now.poses:
            now.poses[-1] = (link.now.stamp_ns, at.R, at.p)
        now.key = self._new_key(tracks, at, known)
        return at

    def _step(self, key: _Key, link: Link) -> Step:
        """The motion since the keyframe, in metres if a length is known."""
        now, back = self._now, backwards(link.motion)
        span_s = (link.now.stamp_ns - max(link.key.stamp_ns, now.still_ns)) * 1e-9
        if back.t_hat_earlier is None or back.direction_sigma_rad is None:
            now.speed_mps, now.still_ns = 0.0, link.now.stamp_ns
            return Step(back.R_earlier_later, np.zeros(3), back.covariance_rad2, STILL_M**2 * np.eye(3), True)
        rows = np.searchsorted(key.tracks.number, link.number)
        known = merged(key.lidar.depths(), key.before)
        t_hat, inlier = link.motion.t_hat_later, link.motion.inlier
        assert t_hat is not None
        rho = parallax_ratio(link.ray_key, link.ray_now, link.motion.R_later_earlier, t_hat, link.motion.sigma_rad)
        found = length_of(rho[0][inlier], rho[1][inlier], known.inverse_m[rows][inlier], known.sigma[rows][inlier])
        m = now.speed_mps * span_s
        expected = Length(m, GAP_MANEUVER.displacement_m(span_s) + 0.1 * m, 0)
        if found is None or (now.metric and not is_plausible(found, expected)):
            found = expected
        else:
            now.speed_mps = found.m / span_s
            now.lengths += 1
            if now.lengths == 1:  # its points were placed as for a vehicle at rest
                key.lidar = RayDepths(key.tracks.ray, math.radians(self.settings.reach_deg))
                now.cloud.clear()
        d = back.t_hat_earlier
        along = np.outer(d, d)
        spread = (found.m * back.direction_sigma_rad) ** 2 * (np.eye(3) - along) + found.sigma_m**2 * along
        return Step(back.R_earlier_later, found.m * d, back.covariance_rad2, spread, False)

    def _extrapolated(self, stamp_ns: int) -> Pose6:
        """The pose without tracked features: extrapolated with the last speed, with a larger covariance."""
        now = self._now
        if not now.poses or now.key is None:
            return Pose6.start()
        gap_s = (stamp_ns - now.poses[-1][0]) * 1e-9
        (t0, _, p0), (t1, R, p1) = now.poses[0], now.poses[-1]
        ahead = (p1 - p0) / max((t1 - t0) * 1e-9, 1e-3) * gap_s if len(now.poses) > 1 else np.zeros(3)
        place = (GAP_MANEUVER.displacement_m(gap_s) + 0.3 * float(np.linalg.norm(ahead))) ** 2
        turn = (TURN_RADPS * gap_s) ** 2
        return Pose6(R, p1 + ahead, now.key.at.covariance + np.diag([turn] * 3 + [place] * 3))

    def _place(self, stamp_ns: int, at: Pose6) -> None:
        """Place the LiDAR slices up to this image by interpolated poses, and add them to the keyframe.

        The position is interpolated for each point, the rotation for the slice.
        """
        now, R, p = self._now, at.R, at.p
        t0, R0, p0 = now.poses[-1] if now.poses else (stamp_ns, R, p)
        now.poses.append((stamp_ns, R, p))
        turn = log_rotation(np.ascontiguousarray(R0.T @ R))
        placed: list[Array64] = []
        while now.waiting and now.waiting[0][0][-1] <= stamp_ns:
            at_ns, xyz = now.waiting.popleft()
            if at_ns[0] >= t0:
                share = (at_ns - t0) / max(stamp_ns - t0, 1)
                R_map_camera = R0 @ exp_rotation(float(share.mean()) * turn)
                placed.append(xyz @ R_map_camera.T + p0 + share[:, None] * (p - p0))
        if not placed:
            return
        cloud = np.vstack(placed)
        now.cloud.append(cloud)
        while sum(len(c) for c in now.cloud) > REMEMBERED and len(now.cloud) > 1:
            now.cloud.popleft()
        if now.key is not None:
            now.key.lidar.add((cloud - now.key.at.p) @ now.key.at.R)

    def _new_key(self, tracks: Tracks, at: Pose6, before: tuple[Tracks, Depths] | None) -> _Key:
        lidar = RayDepths(tracks.ray, math.radians(self.settings.reach_deg))
        if self._now.cloud:
            lidar.add((np.vstack(list(self._now.cloud)) - at.p) @ at.R)
        known = _unknown(tracks)
        if before is not None:
            mine, theirs = tracks.common(before[0])
            known.inverse_m[mine], known.sigma[mine] = before[1].inverse_m[theirs], before[1].sigma[theirs]
        return _Key(tracks, at, lidar, known)

    def _known_after(self, key: _Key, link: Link, step: Step) -> tuple[Tracks, Depths] | None:
        """Inverse depths in the newest image of features with a depth from the motion or from the LiDAR."""
        m = float(np.linalg.norm(step.t))
        t_hat = link.motion.t_hat_later
        if t_hat is None or m < 1e-3:
            return None
        rho, rho_sigma = parallax_ratio(
            link.ray_key, link.ray_now, link.motion.R_later_earlier, t_hat, link.motion.sigma_rad
        )
        relative = np.hypot(rho_sigma / np.maximum(rho, 1e-9), math.sqrt(float(np.trace(step.spread_m2))) / m)
        q = np.where(link.motion.inlier & (rho > 4.0 * rho_sigma), rho / m, np.nan)
        rows = np.searchsorted(key.tracks.number, link.number)
        lidar = key.lidar.depths()
        q_lidar, sigma_lidar = lidar.inverse_m[rows], lidar.sigma[rows]
        by_lidar = np.isfinite(q_lidar) & link.motion.inlier
        q, relative = np.where(by_lidar, q_lidar, q), np.where(by_lidar, sigma_lidar / q_lidar, relative)
        away = np.linalg.norm((link.ray_key / q[:, None] - step.t) @ step.R, axis=1)
        tracks = Tracks(link.now.stamp_ns, link.number, link.ray_now, np.zeros((len(q), 2)))
        return tracks, Depths(1.0 / away, relative / away)

    def _motion(self, stamp_ns: int, at: Pose6) -> VehicleMotion:
        vehicle = vehicle_pose(at, self._mount)
        return VehicleMotion(
            stamp_ns=stamp_ns, xyz_map_m=vehicle.p, R_map_vehicle=vehicle.R, covariance=vehicle.covariance
        )


def merged(first: Depths, second: Depths) -> Depths:
    """The first where finite, otherwise the second."""
    use = np.isfinite(first.inverse_m)
    return Depths(np.where(use, first.inverse_m, second.inverse_m), np.where(use, first.sigma, second.sigma))


def _unknown(tracks: Tracks) -> Depths:
    return Depths(np.full(len(tracks.number), np.nan), np.full(len(tracks.number), np.nan))


def _keyframe(tracks: Tracks, at: Pose6, depths: Depths) -> Keyframe:
    return Keyframe(at.R, at.p, tracks.number, tracks.ray, depths.inverse_m, depths.sigma)
