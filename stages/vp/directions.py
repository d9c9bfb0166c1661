"""Directions from lines: the vertical, and one or more horizontal pairs at right angles (Manhattan, Atlanta).

A line with great-circle normal n runs in direction d when n . d = 0; with the line's turn about its middle ray m known
to sigma, the residual has

    sigma_r^2 = sigma^2 (t . d)^2 + sigma_model^2,   t = n x m

where sigma_model is how straight and parallel the world is. All directions are refined together: the rotation of the
first frame (its axes x, y, and the vertical) and the yaw of every further frame against it,

    minimise sum w_i (n_i . d_k(i))^2 / sigma_r^2  +  the gravity prior,   w Cauchy, assignment k(i) anew each round.

Source: ours; Manhattan and Atlanta worlds: Coughlan and Yuille 1999, Schindler and Dellaert 2004. DESIGN, Vision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.geometry.lens import Array64
from stages.kernels.vp.directions import assign_kernel, refine_kernel, tangents
from stages.vp.arcs import Arcs

ROUNDS = 8


@dataclass(frozen=True)
class Lines:
    """What the search needs to know of lines; vectors in the camera_mount's axes."""

    normal: Array64  # (m, 3)
    tangent: Array64  # (m, 3) along the circle at the line's middle
    sigma_rad: Array64  # (m,)
    weight: Array64  # (m,) by how wide it is seen, at most 1


@dataclass(frozen=True)
class Structure:
    """Directions found. `axes[:, 2]` is the vertical, the frame 0 its x and y; further frames are turned by `yaw`."""

    axes: Array64  # (3, 3) R_carrier_frame0
    yaw_rad: Array64  # (k,) of the frames against the first, 0 first
    assigned: NDArray[np.int64]  # (m,) direction of each line
    information: Array64  # (3 + k - 1, 3 + k - 1) of the turn about the axes of frame 0, then the yaws
    scatter: float  # how far lines are off their directions, against what was expected
    agreement: float  # weight of the lines that fit, less the farther off they are


def lines_of(arcs: Arcs, R_carrier_camera: Array64, wide_rad: float) -> Lines:
    """The search's view of the arcs. A line counts fully from `wide_rad` on."""
    R = R_carrier_camera.T
    weight = np.minimum(arcs.extent_rad / wide_rad, 1.0)
    return Lines(arcs.normal @ R, tangents(arcs.normal, arcs.ends) @ R, arcs.sigma_rad, weight)


def residual_sigma(lines: Lines, direction: Array64, sigma_model: float) -> Array64:
    """sigma_r (m,) of n . d for one direction."""
    return np.hypot(lines.sigma_rad * (lines.tangent @ direction), sigma_model)


def assign(lines: Lines, directions: Array64, sigma_model: float) -> tuple[NDArray[np.int64], Array64, Array64]:
    """Which direction each line runs in (NONE: none); its residual and the residual's sigma, of those that have one."""
    return assign_kernel(lines.normal, lines.tangent, lines.sigma_rad, directions, sigma_model)


def refine(
    lines: Lines,
    axes: Array64,
    yaw_rad: Array64,
    prior: Array64,
    prior_sigma: float,
    sigma_model: float,
    rounds: int = ROUNDS,
) -> Structure:
    """Gauss-Newton over the frame's turn and the further yaws, lines assigned anew each round."""
    return Structure(
        *refine_kernel(
            lines.normal,
            lines.tangent,
            lines.sigma_rad,
            lines.weight,
            np.ascontiguousarray(axes),
            yaw_rad,
            np.ascontiguousarray(prior),
            prior_sigma,
            sigma_model,
            rounds,
        )
    )
