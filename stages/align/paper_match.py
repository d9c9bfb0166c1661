"""Relative rotation from the vanishing directions of two cameras, matched by the smallest angles.

    V_G = R_GD V_D,   R_GD = V_G V_D^-1, made a rotation                       columns of V: matched directions

A direction is an axis: v and -v are the same. Of all pairs (v_G, v_D) the one with the smallest angle between v_G and
R_previous v_D is matched first, then the best of the rest; the third column is the cross product of the other two.

Source: P IV, Eq. 7-10; DESIGN, The paper's formulas.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.geometry.so3 import log_rotation, nearest_rotation


@dataclass(frozen=True, slots=True)
class Match:
    """Rotation between two sets of directions."""

    R_vehicle_drone: Array64  # (3, 3)
    angle_rad: float  # the larger one of the two pairs, under the previous rotation


def match(vehicle: Array64, drone: Array64, R_previous: Array64) -> Match:
    """R_vehicle_drone of unit directions, a row each: (n, 3) and (m, 3), n, m >= 2, no two of a set parallel."""
    cosine = vehicle @ R_previous @ drone.T
    likeness = np.abs(cosine)
    i, j = np.unravel_index(int(np.argmax(likeness)), likeness.shape)
    rest = likeness.copy()
    rest[i, :] = rest[:, j] = -1.0
    k, m = np.unravel_index(int(np.argmax(rest)), rest.shape)
    V_G = columns(vehicle[i], vehicle[k])
    V_D = columns(math.copysign(1.0, cosine[i, j]) * drone[j], math.copysign(1.0, cosine[k, m]) * drone[m])
    R = nearest_rotation(V_G @ np.linalg.inv(V_D))
    return Match(R, math.acos(min(float(likeness[k, m]), 1.0)))


def columns(first: Array64, second: Array64) -> Array64:
    """V (3, 3): two unit directions and their cross product of length 1, as columns."""
    third = np.cross(first, second)
    return np.column_stack([first, second, third / np.linalg.norm(third)])


def angle_between_rad(R_a: Array64, R_b: Array64) -> float:
    """The angle of R_a^T R_b, 0 to pi."""
    return float(np.linalg.norm(log_rotation(R_a.T @ R_b)))
