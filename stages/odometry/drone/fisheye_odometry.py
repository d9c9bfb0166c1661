"""Visual odometry of the drone's fisheye: rotation, and direction of translation without its length.

Each image gives one VisualMotion relative to the keyframe. Chaining: a keyframe serves several images, so motions with
the same `from_ns` share it; the last of them ends at the next keyframe, and the next motion's `from_ns` is its
`stamp_ns`. Rotations multiply along the keyframes, R_a_c = R_a_b R_b_c; translations add once each has its length:
t_a_c = t_a_b + R_a_b t_b_c. Between two images of one keyframe R_i_j = R_k_i^T R_k_j. Errors of motions of the same
keyframe are correlated, those of different keyframes hardly. A `from_ns` that is no earlier motion's `stamp_ns` begins
a new chain.

The camera is mounted off the drone's centre: the direction of translation is the camera's.

With a rolling shutter (`readout_ms` of the camera link) and the gyro, rays are those of the middle row's exposure.

Source: P V.E (5-point); ours: rolling shutter, bearing vectors, keyframes, detection of no translation, covariance.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from flow.stage import Settings, Stage
from stages.geometry.frames import Array64, Pose
from stages.geometry.lens import Lens
from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import DroneImu, FollowedFeatures, Image, VisualMotion
from stages.odometry.visual.features import FeatureSettings
from stages.odometry.visual.image_motion import Link, LinkSettings, MotionLinks, followed
from stages.odometry.visual.two_view import backwards

IMU_KEPT = 2000
LONGEST_IMU_GAP_NS = 60_000_000


class FisheyeOdometrySettings(Settings):
    """Settings of `FisheyeOdometry`."""

    lens: Lens
    T_drone_camera: Pose
    features: FeatureSettings = FeatureSettings()
    link: LinkSettings = LinkSettings()
    least_matches: int = Field(30, ge=12, le=1000)  # with fewer inliers no motion is published


class FisheyeOdometry(Stage[FisheyeOdometrySettings]):
    """Rotation and direction of translation of the drone's camera since its keyframe, at every image."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"imu"})

    def __init__(self, settings: FisheyeOdometrySettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._gyro: deque[tuple[int, Array64]] = deque(maxlen=IMU_KEPT)
        settings = self.settings
        self._links = MotionLinks(settings.lens, settings.features, settings.link)
        self._R_drone_camera: Array64 = settings.T_drone_camera.matrix()[:3, :3]

    def on_imu(self, imu: DroneImu) -> None:
        """The drone's gyro: predicts the features' positions in the next image, and corrects a rolling shutter."""
        if not self._gyro or imu.stamp_ns > self._gyro[-1][0]:
            self._gyro.append((imu.stamp_ns, imu.angular_velocity_drone_radps))

    def on_image(self, image: Image) -> Iterator[VisualMotion | FollowedFeatures]:
        """The motion since the keyframe and its features; nothing at the first image or without features to track."""
        gyro, before_ns = self._gyro, self._links.newest_ns
        while len(gyro) > 1 and gyro[1][0] <= before_ns:
            gyro.popleft()
        R = gyro_rotation(list(gyro), before_ns, image.stamp_ns) if gyro else None
        C = self._R_drone_camera
        turn = image.rows_after_s() * (C.T @ rate_at_radps(gyro, image.stamp_ns))
        link = self._links.feed(image.stamp_ns, image.grey, None if R is None else C.T @ R.T @ C, turn)
        if link is None:
            return
        yield followed(link, image.frame_id)
        if np.count_nonzero(link.motion.inlier) >= self.settings.least_matches:
            yield visual_motion(link, C)


def visual_motion(link: Link, R_drone_camera: Array64) -> VisualMotion:
    """The camera's motion in the drone's axes: R_from_to = C R C^T, direction = C d, covariance C P C^T."""
    C, back = R_drone_camera, backwards(link.motion)
    t = back.t_hat_earlier
    return VisualMotion(
        stamp_ns=link.now.stamp_ns,
        from_ns=link.key.stamp_ns,
        R_from_to=C @ back.R_earlier_later @ C.T,
        covariance_rad2=C @ back.covariance_rad2 @ C.T,
        direction_from=None if t is None else C @ t,
        direction_sigma_rad=back.direction_sigma_rad,
        matches=int(np.count_nonzero(link.motion.inlier)),
        reason="no translation observed" if t is None else "",
    )


def rate_at_radps(gyro: Iterable[tuple[int, Array64]], stamp_ns: int) -> Array64:
    """Angular rate (3,) of the nearest gyro sample; zero when none is within `LONGEST_IMU_GAP_NS`."""
    near_ns, rate = min(gyro, key=lambda sample: abs(sample[0] - stamp_ns), default=(stamp_ns, np.zeros(3)))
    return rate if abs(near_ns - stamp_ns) <= LONGEST_IMU_GAP_NS else np.zeros(3)


def gyro_rotation(gyro: list[tuple[int, Array64]], before_ns: int, now_ns: int) -> Array64 | None:
    """R_before_now (3, 3) of the drone by its gyro, constant rates between samples; None across a gap."""
    rotation = np.eye(3)
    at_ns = before_ns
    for (stamp_ns, rate), following in zip(gyro, [*gyro[1:], None], strict=True):
        until_ns = min(now_ns, stamp_ns + LONGEST_IMU_GAP_NS if following is None else following[0])
        if until_ns <= at_ns:
            continue
        if stamp_ns - at_ns > LONGEST_IMU_GAP_NS or until_ns - stamp_ns > LONGEST_IMU_GAP_NS:
            return None
        rotation = rotation @ exp_rotation(rate * ((until_ns - at_ns) * 1e-9))
        at_ns = until_ns
    return rotation if at_ns == now_ns else None
