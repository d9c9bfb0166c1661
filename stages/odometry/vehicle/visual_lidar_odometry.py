"""The vehicle's own motion from its camera, in metres by the LiDAR: T_map_vehicle, smooth and drifting.

    picture   the motion since the key picture, 5-DoF (stages/odometry/visual/image_motion.py); standing keeps the pose
    LiDAR     points, each placed by where the vehicle was at its time, give depths to the key's features
    length    of the motion: from features with a depth, by the LiDAR or by the motion before (scale.py)
    key       when a new picture becomes the key: bundle adjustment over the last few (window.py)

The start frame is the vehicle's at the first picture, or, when it drove off without any length known, at the first
one from which a length was known. Its z axis is up as far as the vehicle stood level.

A vehicle with odometry of its own needs none of this. Wired as `odometry` it lets the stage rest while it is heard and
believed; when it falls silent or tells nonsense the stage begins anew, with the speed that it told last
(motion_choice.py believes the same words, and joins the two).

Source: P V.B (Harris and KLT, 5-DoF, scale from projected LiDAR points, windowed bundle adjustment).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from flow.stage import Settings, Stage
from stages.geometry.extrapolation import GAP_MANEUVER, AcceptedPoses
from stages.geometry.frames import Array64, Pose
from stages.geometry.lens import Lens
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import FollowedFeatures, Image, SweptPoints, VehicleMotion
from stages.odometry.vehicle.image_motion import Pose6, Step, after, believable, carrier_pose
from stages.odometry.vehicle.lidar_depth import Depths, RayDepths
from stages.odometry.vehicle.scale import Length, length_of, parallax_ratio
from stages.odometry.vehicle.source_selection import SILENT_S
from stages.odometry.vehicle.window import KeyPicture, adjusted
from stages.odometry.visual.features import FeatureSettings, Tracks
from stages.odometry.visual.image_motion import Link, LinkSettings, MotionLinks, followed
from stages.odometry.visual.two_view import backwards

TURN_RADPS = 0.3  # one sigma of the turn rate, unseen
STILL_M = 0.003  # one sigma of a place held because no motion is seen
LEAST_LENGTHS = 3  # the first ones come from points placed by a speed not yet known
REMEMBERED = 20_000  # LiDAR points
WAITING_SLICES = 2_000


@dataclass(slots=True)
class _Key:
    """The key picture: its pose, how sure it is, and what is known of its features' depths."""

    tracks: Tracks
    at: Pose6
    lidar: RayDepths
    before: Depths  # what the motion to here has made known


@dataclass(slots=True)
class _Now:
    key: _Key | None = None
    window: list[KeyPicture] = field(default_factory=lambda: list[KeyPicture]())
    poses: deque[tuple[int, Array64, Array64]] = field(  # the last two: stamp, T_map_camera
        default_factory=lambda: deque[tuple[int, Array64, Array64]](maxlen=2)
    )
    waiting: deque[tuple[int, Array64]] = field(  # LiDAR slices not yet placed, camera frame
        default_factory=lambda: deque[tuple[int, Array64]](maxlen=WAITING_SLICES)
    )
    cloud: deque[Array64] = field(default_factory=lambda: deque[Array64]())  # placed, start frame
    lengths: int = 0  # how often a length was found
    told: bool = False  # the start frame is given out
    speed_mps: float = 0.0
    still_ns: int = 0  # when it stood last

    @property
    def metric(self) -> bool:
        """Whether lengths are to be believed."""
        return self.lengths >= LEAST_LENGTHS


class VisualLidarOdometrySettings(Settings):
    """Settings of `VisualLidarOdometry`."""

    lens: Lens
    T_vehicle_camera: Pose
    features: FeatureSettings = FeatureSettings()
    link: LinkSettings = LinkSettings()
    window_keys: int = Field(6, ge=3, le=12)  # pictures in the bundle adjustment
    every_nth_point: int = Field(2, ge=1, le=50)  # of the LiDAR's returns
    reach_deg: float = Field(2.0, gt=0.1, le=10)  # LiDAR points this near a feature tell its depth
    silent_s: float = Field(SILENT_S, gt=0, le=10)  # of the odometry: two of its periods at least


class VisualLidarOdometry(Stage[VisualLidarOdometrySettings]):
    """T_map_vehicle at every picture, by camera and LiDAR; nothing while the vehicle's own odometry is heard."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"odometry"})

    def __init__(self, settings: VisualLidarOdometrySettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._now = _Now()
        self._odometry = AcceptedPoses()
        self._resting: bool = False
        settings = self.settings
        self._links = MotionLinks(settings.lens, settings.features, settings.link)
        self._mount: Array64 = settings.T_vehicle_camera.matrix()

    def on_odometry(self, motion: VehicleMotion) -> None:
        """The vehicle tells its motion itself: nothing is to be done here."""
        newest_ns = self._odometry.newest_ns
        if newest_ns is None or motion.stamp_ns > newest_ns:
            self._resting |= bool(self._odometry.add(motion))

    def on_points(self, points: SweptPoints) -> None:
        """LiDAR returns wait until a picture has told where the vehicle was."""
        if self._resting:
            return
        n = self.settings.every_nth_point
        xyz = points.xyz_vehicle_m[::n].astype(np.float64)
        if len(xyz):
            stamp_ns = int(points.point_stamp_ns[len(points.point_stamp_ns) // 2])
            self._now.waiting.append((stamp_ns, (xyz - self._mount[:3, 3]) @ self._mount[:3, :3]))

    def on_image(self, image: Image) -> Iterator[VehicleMotion | FollowedFeatures]:
        """Where the vehicle is at this picture, and from which features.

        Nothing as long as no length is known, where nothing is followed, and while its own odometry is heard.
        """
        if self._resting:
            if image.stamp_ns - (self._odometry.newest_ns or 0) < self.settings.silent_s * 1e9:
                return
            self._wake()
        link = self._links.feed(image.stamp_ns, image.grey)
        if link is not None:
            yield followed(link, image.frame_id)
        motion = self._moved(image.stamp_ns, link)
        if motion is not None:
            yield motion

    def _moved(self, stamp_ns: int, link: Link | None) -> VehicleMotion | None:
        """Where the vehicle is at the newest picture."""
        now = self._now
        tracks = self._links.key
        assert tracks is not None, "the first picture fed becomes the key"
        if link is None:
            if tracks.stamp_ns != stamp_ns or (now.key is not None and now.key.tracks is tracks):
                return None  # no newer than the last one
            at = self._unseen(stamp_ns)
            self._place(stamp_ns, at)
            now.key = self._key_picture(tracks, at, None)
            now.window.clear()
            return self._told(stamp_ns, at) if now.told else None
        assert now.key is not None
        step = self._step(now.key, link)
        at = after(now.key.at, step)
        self._place(stamp_ns, at)
        if link.last:
            at = self._next_key(now.key, link, step, at, tracks)
        now.told |= now.metric or step.standing
        return self._told(stamp_ns, at) if now.told else None

    def _wake(self) -> None:
        """Begin anew at this picture; how fast the vehicle drives is known from its odometry."""
        settings = self.settings
        self._resting = False
        self._links = MotionLinks(settings.lens, settings.features, settings.link)
        speed_mps = self._odometry.speed_mps
        self._now = _Now() if speed_mps is None else _Now(lengths=LEAST_LENGTHS, told=True, speed_mps=speed_mps)

    def _next_key(self, key: _Key, link: Link, step: Step, at: Pose6, tracks: Tracks) -> Pose6:
        """The newest picture becomes the key; its pose after bundle adjustment."""
        now = self._now
        known = self._known_after(key, link, step)
        if now.metric and not step.standing:
            done = _seen(key.tracks, key.at, key.lidar.depths())
            keys = [*now.window, done, _seen(tracks, at, _nothing(tracks))][-self.settings.window_keys :]
            keys = adjusted(keys, link.motion.sigma_rad)
            now.window, at = keys[:-1], Pose6(keys[-1].R, keys[-1].p, at.covariance)
        elif not now.told and not step.standing:  # it drove off and nobody knows how far: start here
            at = Pose6.start()
            now.cloud.clear()
            now.poses.clear()
            now.poses.append((link.now.stamp_ns, at.R, at.p))
        if now.poses:
            now.poses[-1] = (link.now.stamp_ns, at.R, at.p)
        now.key = self._key_picture(tracks, at, known)
        return at

    def _step(self, key: _Key, link: Link) -> Step:
        """The motion since the key, in metres where a length is known."""
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
        if found is None or (now.metric and not believable(found, expected)):
            found = expected
        else:
            now.speed_mps = found.m / span_s
            now.lengths += 1
            if now.lengths == 1:  # its points were placed as if the vehicle stood
                key.lidar = RayDepths(key.tracks.ray, math.radians(self.settings.reach_deg))
                now.cloud.clear()
        d = back.t_hat_earlier
        along = np.outer(d, d)
        spread = (found.m * back.direction_sigma_rad) ** 2 * (np.eye(3) - along) + found.sigma_m**2 * along
        return Step(back.R_earlier_later, found.m * d, back.covariance_rad2, spread, False)

    def _unseen(self, stamp_ns: int) -> Pose6:
        """Where it should be when nothing could be followed: on with the last speed, and less sure."""
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
        """Put the LiDAR points of the time up to this picture where they belong, and give them to the key."""
        now, R, p = self._now, at.R, at.p
        t0, R0, p0 = now.poses[-1] if now.poses else (stamp_ns, R, p)
        now.poses.append((stamp_ns, R, p))
        turn = log_rotation(np.ascontiguousarray(R0.T @ R))
        placed: list[Array64] = []
        while now.waiting and now.waiting[0][0] <= stamp_ns:
            at_ns, xyz = now.waiting.popleft()
            if at_ns >= t0:
                share = (at_ns - t0) / max(stamp_ns - t0, 1)
                placed.append(xyz @ (R0 @ exp_rotation(share * turn)).T + p0 + share * (p - p0))
        if not placed:
            return
        cloud = np.vstack(placed)
        now.cloud.append(cloud)
        while sum(len(c) for c in now.cloud) > REMEMBERED and len(now.cloud) > 1:
            now.cloud.popleft()
        if now.key is not None:
            now.key.lidar.add((cloud - now.key.at.p) @ now.key.at.R)

    def _key_picture(self, tracks: Tracks, at: Pose6, before: tuple[Tracks, Depths] | None) -> _Key:
        lidar = RayDepths(tracks.ray, math.radians(self.settings.reach_deg))
        if self._now.cloud:
            lidar.add((np.vstack(list(self._now.cloud)) - at.p) @ at.R)
        known = _nothing(tracks)
        if before is not None:
            mine, theirs = tracks.common(before[0])
            known.inverse_m[mine], known.sigma[mine] = before[1].inverse_m[theirs], before[1].sigma[theirs]
        return _Key(tracks, at, lidar, known)

    def _known_after(self, key: _Key, link: Link, step: Step) -> tuple[Tracks, Depths] | None:
        """Inverse depths in the newest picture of the features whose depth the motion, or the LiDAR before, tells."""
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
        told = np.isfinite(q_lidar) & link.motion.inlier
        q, relative = np.where(told, q_lidar, q), np.where(told, sigma_lidar / q_lidar, relative)
        away = np.linalg.norm((link.ray_key / q[:, None] - step.t) @ step.R, axis=1)
        tracks = Tracks(link.now.stamp_ns, link.number, link.ray_now, np.zeros((len(q), 2)))
        return tracks, Depths(1.0 / away, relative / away)

    def _told(self, stamp_ns: int, at: Pose6) -> VehicleMotion:
        vehicle = carrier_pose(at, self._mount)
        return VehicleMotion(
            stamp_ns=stamp_ns, xyz_map_m=vehicle.p, R_map_vehicle=vehicle.R, covariance=vehicle.covariance
        )


def merged(first: Depths, second: Depths) -> Depths:
    """The first where it knows, else the second."""
    use = np.isfinite(first.inverse_m)
    return Depths(np.where(use, first.inverse_m, second.inverse_m), np.where(use, first.sigma, second.sigma))


def _nothing(tracks: Tracks) -> Depths:
    return Depths(np.full(len(tracks.number), np.nan), np.full(len(tracks.number), np.nan))


def _seen(tracks: Tracks, at: Pose6, depths: Depths) -> KeyPicture:
    return KeyPicture(at.R, at.p, tracks.number, tracks.ray, depths.inverse_m, depths.sigma)
