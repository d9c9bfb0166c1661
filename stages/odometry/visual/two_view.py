"""Relative motion between two images from matched rays: rotation and direction of translation, or rotation alone.

    p_later = R_later_earlier p_earlier + |t| t_hat_later;   in formulas x = ray earlier, x' = ray later, y = R x

    error      e = x' . (t x y) / sqrt(|t x y|^2 + |t x x'|^2): angular distance of the rays from a plane with t [rad]
    hypotheses from five rays each (poselib.relpose_5pt), ranked by the sum of log(1 + e^2 / sigma^2); a point behind
               either camera is an outlier, where "behind" is a negative depth along its ray
    refinement Gauss-Newton on rotation and direction, Cauchy weights, with the noise estimated from the errors
    rotation   the pure rotation is kept unless a direction explains a dozen more points and its sigma is below
               MAX_DIRECTION_SIGMA_RAD: distant points, such as clouds, show no translation

The RANSAC of poselib and OpenCV divides by z and fails beyond 90 deg off axis.

Source: P V.E (5-point); Nister (2004); the error is Sampson's on the sphere, as in Pagani and Stricker (2011).
Ours: the logarithm, the test for pure rotation, and the error common to all tracks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.geometry.so3 import hat, log_rotation
from stages.kernels.visual.epipolar import (
    BEYOND_SIGMAS,
    CAUCHY,
    SAMPLE,
    across,
    cost_of,
    direction_given,
    epipolar,
    refine,
    rotation_between,
    shown_noise,
)

LEAST = 12  # inliers of a motion
CONFIDENCE = 0.99
NARROWINGS = 2
WORST_SIGMAS = 40.0  # largest accepted noise, in units of the minimum noise
LIMIT_SIGMAS = 3.5  # errors beyond are outliers
MAX_DIRECTION_SIGMA_RAD = math.radians(12.0)  # a direction with a larger sigma is discarded
CLEAR_SIGMAS = 5.0  # parallax of a point that is clearly not noise
PROOF = 12 * math.log(
    1.0 + 5.0**2
)  # minimum gain of a translation: the cost of twelve points with clear parallax under pure rotation

try:
    import poselib  # pyright: ignore[reportMissingTypeStubs]

    _five_point = cast(Any, poselib).relpose_5pt
except ModuleNotFoundError:  # on aarch64 it must be built: docs/how-to/install.md

    def _five_point(*rays: Array64) -> list[Any]:
        raise ModuleNotFoundError("visual odometry needs poselib: docs/how-to/install.md shows how to build it")


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of a ray [rad], one axis, one sigma."""

    least_rad: float  # minimum, independent per track
    shared_rad: float  # common to all tracks: it does not average out
    lens_share: float = 0.0  # common error of the lens, as a share of the rotation
    parallax_share: float = 0.0  # common error of the rotation by parallax, as a share: moving things, warped templates
    direction_rad: float = 0.0  # common error of the direction of translation

    def rotation_variance_rad2(self, angle_rad: float, parallax_rad: float) -> float:
        """Variance per axis of the common error of a rotation by an angle, with a parallax."""
        return self.shared_rad**2 + (self.lens_share * angle_rad) ** 2 + (self.parallax_share * parallax_rad) ** 2

    def direction_variance_rad2(self, angle_rad: float, parallax_rad: float) -> float:
        """Variance per axis of the common error of the direction of translation."""
        common = self.rotation_variance_rad2(angle_rad, 0.0)
        return common / parallax_rad**2 + self.direction_rad**2


@dataclass(frozen=True, slots=True)
class TwoView:
    """The motion between two images. `t_hat_later` is None for a pure rotation."""

    R_later_earlier: Array64
    t_hat_later: Array64 | None
    covariance: Array64  # (6, 6): w in exp(w) R, then t_hat, whose block is of rank 2; zero where there is none
    inlier: NDArray[np.bool_]  # (n,)
    sigma_rad: float  # noise of one ray, one axis, estimated from the errors
    clear: int  # inliers with clear parallax
    parallax_rad: float  # median over these inliers

    @property
    def direction_sigma_rad(self) -> float:
        """Sigma of t_hat_later, one axis, mean of both."""
        return math.sqrt(0.5 * float(np.trace(self.covariance[3:, 3:])))


@dataclass(frozen=True, slots=True)
class Backwards:
    """The same motion in the axes of the earlier image: p_earlier = R_earlier_later p_later + |t| t_hat_earlier."""

    R_earlier_later: Array64
    covariance_rad2: Array64  # (3, 3) of phi in R exp(phi), later axes
    t_hat_earlier: Array64 | None
    direction_sigma_rad: float | None


def backwards(motion: TwoView) -> Backwards:
    """R_earlier_later = R^T, t_hat_earlier = -R^T t_hat_later, with the covariance propagated."""
    R, t, cov = motion.R_later_earlier, motion.t_hat_later, motion.covariance
    if t is None:
        return Backwards(R.T.copy(), cov[:3, :3].copy(), None, None)
    J = np.hstack([hat(t), np.eye(3)])  # R t_hat_earlier <- -(t_hat + dt + t_hat x w)
    sigma = math.sqrt(0.5 * float(np.trace(J @ cov @ J.T)))
    return Backwards(R.T.copy(), cov[:3, :3].copy(), -R.T @ t, sigma)


def relative_motion(
    earlier: Array64, later: Array64, R_guess: Array64, t_guess: Array64 | None, noise: Noise, tries: int
) -> TwoView | None:
    """The motion from rays (n, 3) and (n, 3); None with fewer than LEAST inliers.

    The guess (R_later_earlier, t_hat_later) is an additional hypothesis; `tries` limits the five-point hypotheses.
    Deterministic: the same rays give the same result.
    """
    if len(earlier) < LEAST:
        return None
    least = noise.least_rad
    turn = _pure_rotation(earlier, later, R_guess, noise)
    R_turn = turn.R_later_earlier if turn else R_guess
    guesses = [(R_guess, t_guess), (R_turn, t_guess)] if t_guess is not None else []
    guesses.append((R_turn, direction_given(earlier, later, R_turn, 5.0 * least)))
    rotation, t = _best_hypothesis(earlier, later, guesses, least, tries)
    sigma = shown_noise(earlier, later, rotation, t, least)
    information = np.eye(5)
    for _ in range(NARROWINGS):
        rotation, t, information = refine(earlier, later, rotation, t, sigma)
        sigma = shown_noise(earlier, later, rotation, t, least)
    error, ahead = epipolar(earlier, later, rotation, t, sigma)
    inlier = ahead & (np.abs(error) < LIMIT_SIGMAS * sigma)
    agreed = sigma < WORST_SIGMAS * least and np.count_nonzero(inlier) >= LEAST
    if not agreed or not np.linalg.cond(information) < 1e12:
        return turn
    separation = np.linalg.norm(later - earlier @ rotation.T, axis=1)
    clearly = inlier & (separation > CLEAR_SIGMAS * sigma)
    parallax = float(np.median(separation[clearly])) if clearly.any() else 1e-9
    B = np.zeros((6, 5))
    B[:3, :3], B[3:, 3:] = np.eye(3), across(t)
    covariance = B @ np.linalg.inv(information) @ B.T * sigma**2
    angle = float(np.linalg.norm(log_rotation(rotation)))
    covariance[:3, :3] += noise.rotation_variance_rad2(angle, parallax) * np.eye(3)
    covariance[3:, 3:] += noise.direction_variance_rad2(angle, parallax) * (np.eye(3) - np.outer(t, t))
    moved = TwoView(rotation, t, covariance, inlier, sigma, int(np.count_nonzero(clearly)), parallax)
    if turn is None:
        return moved
    insufficient = gain_over(turn, moved, earlier, later) < PROOF or moved.clear < LEAST
    return turn if insufficient or moved.direction_sigma_rad > MAX_DIRECTION_SIGMA_RAD else moved


def gain_over(turn: TwoView, moved: TwoView, earlier: Array64, later: Array64) -> float:
    """Gain of a translation over pure rotation: the difference of their sums of log(1 + e^2 / sigma^2).

    For the rotation e is the mean of both axes, so that points without parallax cost both the same, up to 0.1 each.
    """
    assert moved.t_hat_later is not None
    sigma = moved.sigma_rad
    separation = np.linalg.norm(later - earlier @ turn.R_later_earlier.T, axis=1) / math.sqrt(2.0) / sigma
    standing = float(np.log1p(np.minimum(separation, BEYOND_SIGMAS) ** 2).sum())
    moving, _ = cost_of(earlier, later, moved.R_later_earlier, moved.t_hat_later, sigma)
    return standing - moving - 0.1 * len(earlier)


def _pure_rotation(earlier: Array64, later: Array64, R_guess: Array64, noise: Noise) -> TwoView | None:
    """Pure rotation; None with too few inliers."""
    rotation = R_guess
    sigma = 20.0 * noise.least_rad
    separation = np.zeros(0)
    for _ in range(3):  # each time with the noise estimated before
        rotation = rotation_between(earlier, later, rotation, CAUCHY * sigma)
        separation = np.linalg.norm(later - earlier @ rotation.T, axis=1) / math.sqrt(2.0)
        sigma = max(noise.least_rad, float(np.median(separation)) / 1.1774)  # the median of a Rayleigh's length
    inlier = separation < LIMIT_SIGMAS * sigma
    if sigma > WORST_SIGMAS * noise.least_rad or np.count_nonzero(inlier) < LEAST:
        return None
    y = earlier[inlier] @ rotation.T
    H = (len(y) * np.eye(3) - y.T @ y) / 2.0  # both rays are noisy
    covariance = np.zeros((6, 6))
    angle = float(np.linalg.norm(log_rotation(rotation)))
    covariance[:3, :3] = np.linalg.inv(H) * sigma**2
    covariance[:3, :3] += noise.rotation_variance_rad2(angle, 0.0) * np.eye(3)
    return TwoView(rotation, None, covariance, inlier, sigma, 0, 0.0)


def _best_hypothesis(
    earlier: Array64, later: Array64, guesses: list[tuple[Array64, Array64]], sigma_rad: float, tries: int
) -> tuple[Array64, Array64]:
    """R and t_hat of the lowest `cost_of`."""
    rng = np.random.default_rng(0)  # deterministic
    n = len(earlier)
    (least, agree), rotation, t = min(
        ((cost_of(earlier, later, rotation, t, sigma_rad), rotation, t) for rotation, t in guesses),
        key=lambda found: found[0][0],
    )
    for tried in range(tries):
        share = min(agree / n, 0.999)
        if agree >= LEAST and tried * math.log(1.0 - share**SAMPLE) < math.log(1.0 - CONFIDENCE):
            break
        pick = rng.choice(n, SAMPLE, replace=False)
        for pose in _five_point(earlier[pick], later[pick]):
            R_try, t_try = np.ascontiguousarray(pose.R), np.asarray(pose.t)
            length = float(np.linalg.norm(t_try))
            if length > 1e-9:
                cost, count = cost_of(earlier, later, R_try, t_try / length, sigma_rad)
                if cost < least:
                    least, agree, rotation, t = cost, count, R_try, t_try / length
    return rotation, t
