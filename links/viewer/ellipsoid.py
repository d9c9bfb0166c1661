"""A covariance as the ellipsoid a person can look at.

Source: ours; the quaternion is Bar-Itzhack's (2000, "New method for extracting the quaternion from a rotation matrix").
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

CHI2_3D_95 = 7.814727903  # 95 % point of chi-square with 3 degrees of freedom


def ellipsoid(covariance_m2: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Half sizes (3,) [m] and axes (columns of a rotation) of the ellipsoid that holds 95 % of a Gaussian.

    half_i = sqrt(chi2_3(0.95) lambda_i) along eigenvector i of the covariance.
    """
    eigenvalues, axes = np.linalg.eigh(covariance_m2)
    if np.linalg.det(axes) < 0:
        axes = axes * [1.0, 1.0, -1.0]
    return np.sqrt(CHI2_3D_95 * np.maximum(eigenvalues, 0.0)), axes


def quaternion_xyzw(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternion (x, y, z, w) of a rotation matrix: the eigenvector of K to its largest eigenvalue."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    k = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [b + d, e - a - i, f + h, c - g],
            [c + g, f + h, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    return np.linalg.eigh(k / 3.0)[1][:, -1]
