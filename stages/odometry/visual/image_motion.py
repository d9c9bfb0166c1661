"""Motion of one camera between a key image and each later image, for the odometry of drone and vehicle.

The key image is replaced by the newest one when the parallax suffices for a good direction, when too few of its tracks
are left, or when it is too old. So the motions from key to key form a chain without gaps, each over a sufficient
baseline, and a camera at rest keeps its key and does not drift.

Source: ours; P V.B, V.E for what is computed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flow.stage import StrictModel
from stages.geometry.frames import Array64
from stages.geometry.lens import Equidistant, KannalaBrandt, OCam
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.kernels.visual.epipolar import epipolar
from stages.kernels.visual.patches import Grey
from stages.messages import FollowedFeatures
from stages.odometry.visual.features import NO_TURN, FeatureSettings, FeatureTracker, Tracks
from stages.odometry.visual.two_view import LEAST, Noise, TwoView, backwards, relative_motion

RETURN_RAD = math.radians(1.0)  # above this parallax the camera cannot have returned to the key position
LONGEST_STEP_S = 1.0  # between two images; after a longer gap no rotation is predicted


class LinkSettings(StrictModel):
    """Thresholds for a new key image, noise of a track, errors that tracks share, limit of hypotheses.

    `lens_share` is a calibration error of 0.3 px at 300 px from the centre.
    """

    key_parallax_deg: float = Field(default=4.0, gt=0, le=30)  # median over the tracks with parallax
    key_share: float = Field(default=0.4, gt=0, lt=1)  # minimum share of its tracks that are left
    key_age_s: float = Field(default=5.0, gt=0, le=60)
    least_noise_px: float = Field(default=0.05, gt=0, le=2)  # minimum, of one track, at the image centre
    shared_noise_px: float = Field(default=0.01, ge=0, le=2)  # common to all tracks, whatever the motion
    lens_share: float = Field(default=0.001, ge=0, le=0.1)  # error of the lens, as a share of the rotation
    parallax_share: float = Field(default=0.025, ge=0, le=0.5)  # error of the rotation, as a share of the parallax
    direction_sigma_deg: float = Field(default=0.5, ge=0, le=10)  # error of the direction that all tracks share
    tries: int = Field(default=60, ge=1, le=2000)  # maximum five-point hypotheses


@dataclass(frozen=True, slots=True)
class Link:
    """The motion from the key image to a later one, with rays matched by row."""

    key: Tracks
    now: Tracks
    number: NDArray[np.int64]  # (n,) of the tracks common to both
    ray_key: Array64  # (n, 3)
    ray_now: Array64  # (n, 3)
    motion: TwoView
    last: bool  # the later image is the key of the next motion


class MotionLinks:
    """Tracks features through images and estimates the motion of each since the key image."""

    def __init__(
        self, lens: Equidistant | KannalaBrandt | OCam, features: FeatureSettings, settings: LinkSettings
    ) -> None:
        self._tracker = FeatureTracker(lens, features)
        self._settings = settings
        pixel = pixel_rad(lens)
        self._noise = Noise(
            settings.least_noise_px * pixel,
            settings.shared_noise_px * pixel,
            settings.lens_share,
            settings.parallax_share,
            math.radians(settings.direction_sigma_deg),
        )
        self._key: Tracks | None = None
        self._before_ns = 0
        self._R_now_key: Array64 = np.eye(3)
        self._t_hat_key: Array64 | None = None  # direction of the newest motion, axes of the key image
        self._rate_radps = np.zeros(3)  # of the camera, camera axes
        self._parallax_rad = 0.0  # median, of the newest motion
        self._most_clear = 0  # most features with parallax in a motion since the key
        self.reason = "no image yet"

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest image."""
        return self._before_ns

    @property
    def key(self) -> Tracks | None:
        """The key image of the next motion, with all its tracks."""
        return self._key

    def feed(
        self, stamp_ns: int, grey: Grey, R_now_before: Array64 | None = None, turn_rad_per_row: Array64 = NO_TURN
    ) -> Link | None:
        """The motion since the key image; None for the first image or when tracking fails (`reason`).

        `R_now_before`: the gyro's rotation since the previous image; without it the last angular rate is extrapolated.
        `turn_rad_per_row` (3,): rotation between the exposures of two rows of a rolling shutter, camera axes.
        """
        key, s = self._key, self._settings
        step_s = (stamp_ns - self._before_ns) * 1e-9
        if key is not None and step_s <= 0.0:
            self.reason = "the image is not newer than the previous one"
            return None
        expected = exp_rotation(-self._rate_radps * step_s) if R_now_before is None else R_now_before
        if key is None or step_s > LONGEST_STEP_S:
            expected = np.eye(3)
        now = self._tracker.follow(stamp_ns, grey, expected, turn_rad_per_row)
        self._before_ns = stamp_ns
        if key is None:
            return self._restart("first image")
        guess = expected @ self._R_now_key
        rows_key, rows_now = key.common(now)
        ray_key, ray_now = key.ray[rows_key], now.ray[rows_now]
        t_guess = None if self._t_hat_key is None else -guess @ self._t_hat_key
        motion = relative_motion(ray_key, ray_now, guess, t_guess, self._noise, s.tries)
        if motion is None:
            return self._restart(
                f"too few inliers: {len(rows_key)} of {len(key.number)} tracks of the key image are left"
            )
        if motion.t_hat_later is None and self._parallax_rad > RETURN_RAD:
            return self._restart("no tracks with parallax are left of the key image while the camera moves")
        self._parallax_rad = motion.parallax_rad
        R_now_before = motion.R_later_earlier @ self._R_now_key.T
        self._rate_radps = -log_rotation(R_now_before) / step_s
        self._R_now_key, self._t_hat_key = motion.R_later_earlier, backwards(motion).t_hat_earlier
        self._most_clear = max(self._most_clear, motion.clear)
        replace_key = (
            motion.parallax_rad > math.radians(s.key_parallax_deg)
            or (motion.t_hat_later is not None and self._most_clear >= 3 * LEAST and motion.clear < 2 * LEAST)
            or np.count_nonzero(motion.inlier) < max(s.key_share * len(key.number), 2 * LEAST)
            or stamp_ns - key.stamp_ns > s.key_age_s * 1e9
        )
        number = key.number[rows_key]
        link = Link(key, now, number, ray_key, ray_now, motion, bool(replace_key))
        if replace_key:
            self._tracker.drop(number[~motion.inlier])
        complete = self._tracker.complete(motion.R_later_earlier @ guess.T)
        if replace_key:
            if self._t_hat_key is not None:
                self._t_hat_key = (
                    motion.R_later_earlier @ self._t_hat_key
                )  # the same direction in the axes of the new key
            self._key, self._R_now_key, self._parallax_rad, self._most_clear = complete, np.eye(3), 0.0, 0
        self.reason = ""
        return link

    def _restart(self, reason: str) -> None:
        """Start a new chain with the newest image as key."""
        self._key, self._R_now_key = self._tracker.complete(np.eye(3)), np.eye(3)
        self._rate_radps, self._t_hat_key, self._parallax_rad, self._most_clear = np.zeros(3), None, 0.0, 0
        self.reason = reason


def followed(link: Link, frame_id: str) -> FollowedFeatures:
    """The features of a motion with their residuals, for display."""
    motion = link.motion
    if motion.t_hat_later is None:
        parallax = np.linalg.norm(link.ray_now - link.ray_key @ motion.R_later_earlier.T, axis=1)
        residual = parallax / math.sqrt(2.0)
    else:
        error, _ = epipolar(link.ray_key, link.ray_now, motion.R_later_earlier, motion.t_hat_later, motion.sigma_rad)
        residual = np.abs(error)
    return FollowedFeatures(
        stamp_ns=link.now.stamp_ns,
        frame_id=frame_id,
        from_ns=link.key.stamp_ns,
        pixel_from=link.key.pixel[np.searchsorted(link.key.number, link.number)],
        pixel_to=link.now.pixel[np.searchsorted(link.now.number, link.number)],
        residual_rad=residual,
        agrees=motion.inlier,
    )


def pixel_rad(lens: Equidistant | KannalaBrandt | OCam) -> float:
    """Angle between two neighbouring pixels at the centre of the lens."""
    column, row = lens.centre_px
    a, b = lens.unproject(np.array([[column, row], [column + 1.0, row]]))
    return float(np.arccos(np.clip(a @ b, -1.0, 1.0)))
