"""A covariance as the ellipsoid a person can look at.

Source: ours.
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
