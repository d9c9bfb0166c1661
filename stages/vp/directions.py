"""Directions from lines: the vertical, and one or more horizontal pairs at right angles (Manhattan, Atlanta).

A line with great-circle normal n is parallel to direction d when n . d = 0. With the standard deviation sigma of the
line's rotation about its middle ray m, the residual has

    sigma_r^2 = sigma^2 (t . d)^2 + sigma_model^2,   t = n x m

where sigma_model accounts for lines that are not exactly straight and parallel. All directions are refined together:
the rotation of the first frame (its axes x, y, and the vertical) and the yaw of every further frame against it,

    minimise sum w_i (n_i . d_k(i))^2 / sigma_r^2  +  the gravity prior,   w Cauchy, k(i) updated in each iteration.

Source: ours; Manhattan and Atlanta worlds: Coughlan and Yuille 1999, Schindler and Dellaert 2004. DESIGN, Vision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.geometry.lens import Array64
from stages.kernels.vp.directions import assign_kernel, jackknife_kernel, refine_kernel, tangents
from stages.vp.arcs import Arcs

MAX_ITERATIONS = 8


@dataclass(frozen=True)
class Lines:
    """Lines as the search uses them; vectors in the axes of the camera mount."""

    normal: Array64  # (m, 3)
    tangent: Array64  # (m, 3) along the circle at the line's middle
    sigma_rad: Array64  # (m,)
    weight: Array64  # (m,) by extent, at most 1


@dataclass(frozen=True)
class Structure:
    """Estimated directions: `axes[:, 2]` is the vertical, x and y are frame 0; `yaw_rad` rotates the further frames."""

    axes: Array64  # (3, 3) R_mount_frame0
    yaw_rad: Array64  # (k,) of each frame relative to the first, 0 first
    assigned: NDArray[np.int64]  # (m,) direction of each line
    information: Array64  # (3 + k - 1, 3 + k - 1) of the rotation about the axes of frame 0, then the yaws
    scatter: float  # RMS residual of lines in units of its expected sigma
    agreement: float  # total weight of the assigned lines, reduced by their residuals


def lines_of(arcs: Arcs, R_mount_camera: Array64, wide_rad: float) -> Lines:
    """The lines of arcs. A line has full weight from an extent of `wide_rad`."""
    R = R_mount_camera.T
    weight = np.minimum(arcs.extent_rad / wide_rad, 1.0)
    return Lines(arcs.normal @ R, tangents(arcs.normal, arcs.ends) @ R, arcs.sigma_rad, weight)


def residual_sigma(lines: Lines, direction: Array64, sigma_model: float) -> Array64:
    """sigma_r (m,) of n . d for one direction."""
    return np.hypot(lines.sigma_rad * (lines.tangent @ direction), sigma_model)


def assign(lines: Lines, directions: Array64, sigma_model: float) -> tuple[NDArray[np.int64], Array64, Array64]:
    """Direction index of each line (NONE: none); for assigned lines the residual and its sigma."""
    return assign_kernel(lines.normal, lines.tangent, lines.sigma_rad, directions, sigma_model)


def refine(
    lines: Lines,
    axes: Array64,
    yaw_rad: Array64,
    prior: Array64,
    prior_sigma: float,
    sigma_model: float,
    iterations: int = MAX_ITERATIONS,
) -> Structure:
    """Gauss-Newton over the rotation of the frame and the further yaws, with lines reassigned in each iteration."""
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
            iterations,
        )
    )


def jackknife(lines: Lines, structure: Structure, sigma_model: float) -> Array64:
    """Covariance of the unknowns of a structure, in the order of its information, from how parts of the lines agree.

    Block jackknife: the structure is estimated without the lines of each eighth of azimuth about the camera. Lines of
    one object, such as a leaning pole or the streaks of the sun, lie in one part.
    """
    return jackknife_kernel(
        lines.normal,
        lines.tangent,
        lines.sigma_rad,
        lines.weight,
        structure.axes,
        structure.yaw_rad,
        sigma_model,
        structure.information,
    )
