"""Bundle adjustment over the last keyframes: their poses and the inverse depths of shared features. P V.B.

    feature    inverse depth q along its ray x in its first image a; in image j its ray is
               z = R_j^T (R_a x + q (p_a - p_j)),   residual B(x')^T z / |z| over the noise of a ray
    LiDAR      (q - q_lidar) / sigma_q
    solved     Gauss-Newton, Cauchy weights, depths eliminated (Schur), the two oldest keyframes fixed: they keep
               position and, without LiDAR depths, scale

Poses are T_map_camera; increments R exp(phi), p + R rho.

Source: P V.B (windowed bundle adjustment); Triggs et al., Bundle adjustment (2000), section 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.odometry.window import HELD, solve, triangulated
from stages.odometry.visual.two_view import across

LEAST_FEATURES = 15


@dataclass(frozen=True, slots=True)
class Keyframe:
    """Pose and observations of a keyframe, by ascending track number."""

    R: Array64  # R_map_camera
    p: Array64  # (3,) [m]
    number: NDArray[np.int64]
    ray: Array64  # (n, 3)
    inverse_m: Array64  # (n,) [1/m] by the LiDAR; NaN: not known
    inverse_sigma: Array64

    def moved(self, R: Array64, p: Array64) -> Keyframe:
        """The same keyframe with another pose."""
        return Keyframe(R, p, self.number, self.ray, self.inverse_m, self.inverse_sigma)


def adjusted(keys: list[Keyframe], sigma_rad: float) -> list[Keyframe]:
    """The keyframes with adjusted poses; unchanged if too few features connect them."""
    if len(keys) <= HELD:
        return keys
    obs_key, obs_feature, obs_ray, first, lidar = _observations(keys)
    if len(first) < LEAST_FEATURES:
        return keys
    R, p = np.stack([k.R for k in keys]), np.stack([k.p for k in keys])
    anchor_ray = obs_ray[first]
    anchor = obs_key[first]
    q = triangulated(R, p, obs_key, obs_feature, obs_ray, anchor, anchor_ray)
    frames = np.stack([across(x) for x in obs_ray])
    Rs, ps = solve(R, p, q, obs_key, obs_feature, obs_ray, frames, anchor, anchor_ray, lidar, sigma_rad)
    if not (np.isfinite(Rs).all() and np.isfinite(ps).all()):
        return keys
    return [key.moved(Rs[k], ps[k]) for k, key in enumerate(keys)]


def _observations(
    keys: list[Keyframe],
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array64, NDArray[np.intp], Array64]:
    """Observations of features in at least three keyframes: keyframe, feature, ray; first ones; LiDAR depths."""
    keyframe = np.concatenate([np.full(len(k.number), i, dtype=np.int64) for i, k in enumerate(keys)])
    number = np.concatenate([k.number for k in keys])
    ray = np.concatenate([k.ray for k in keys])
    lidar = np.column_stack(
        [np.concatenate([k.inverse_m for k in keys]), np.concatenate([k.inverse_sigma for k in keys])]
    )
    _, feature, count = np.unique(number, return_inverse=True, return_counts=True)
    often = count >= 3
    index = np.cumsum(often) - 1
    use = often[feature]
    obs_feature = index[feature[use]]
    _, first = np.unique(obs_feature, return_index=True)
    return keyframe[use], obs_feature, np.ascontiguousarray(ray[use]), first, np.ascontiguousarray(lidar[use][first])
