"""Conversions between MAVLink's NED and FRD frames and grd's frames (x forward, y left, z up).

MAVLink's local frame is x north, y east, z down; its body frame is x forward, y right, z down. grd's axes have y and z
inverted:

    local: x north (the autopilot's north), y west, z up        drone: x forward, y left, z up
    v_odom = F v_ned,   v_drone = F v_frd,   R_odom_drone = F R_ned_frd F,   F = diag(1, -1, -1) = F^-1

MAVLink's pose covariance has the states x, y, z, roll, pitch, yaw, its velocity covariance vx, vy, vz, rollspeed,
pitchspeed, yawspeed; the upper triangle by rows. grd's covariances have the rotation first, in the tangent space at the
body (p_body = R^T p_local). Roll, pitch and yaw errors are treated as small rotations about the body's x, y, z: exact
for a level drone, within 2 % up to a tilt of 10 deg.

Source: https://mavlink.io/en/messages/common.html#MAV_FRAME and #ODOMETRY; DESIGN, Frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from stages.geometry.frames import Array64, rotation_from_quaternion_xyzw, rotation_from_rpy_deg

FLIP = np.array([1.0, -1.0, -1.0])
F_AND_F = np.outer(FLIP, FLIP)  # F M F = M * this, element-wise
SWAPPED = [3, 4, 5, 0, 1, 2]  # translation first <-> rotation first
UPPER = np.triu_indices(6)  # MAVLink's 21 numbers
_NUMBER = np.zeros((6, 6), dtype=np.intp)  # index of each element
_NUMBER[UPPER] = _NUMBER.T[UPPER] = np.arange(21)
_FROM = _NUMBER[np.ix_(SWAPPED, SWAPPED)]  # index of each element in grd's order
_TO = np.arange(36).reshape(6, 6)[np.ix_(SWAPPED, SWAPPED)][UPPER]  # index in grd's order of each of the 21
_SIGNS = np.tile(F_AND_F, (2, 2))  # equal in both orders
_UPPER_SIGNS = _SIGNS[UPPER]
_VARIANCES = np.diagonal(_NUMBER).tolist()
_EYE6 = np.eye(6)


def flip_yz(vector: Array64) -> Array64:
    """(x, -y, -z): NED <-> local, FRD <-> drone, for vectors and angular velocities (..., 3)."""
    return vector * FLIP


def _flip_both(R: Array64) -> Array64:
    """F R F; adding 0.0 removes negative zeros."""
    return R * F_AND_F + 0.0


def R_odom_drone_from_rpy(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array64:
    """R_odom_drone (3, 3) of ATTITUDE's angles: R_ned_frd = Rz(yaw) Ry(pitch) Rx(roll)."""
    R_ned_frd = rotation_from_rpy_deg((math.degrees(roll_rad), math.degrees(pitch_rad), math.degrees(yaw_rad)))
    return _flip_both(R_ned_frd)


def rpy_from_R_odom_drone(R_odom_drone: Array64) -> tuple[float, float, float]:
    """ATTITUDE's roll, pitch, yaw [rad] of R_odom_drone (3, 3)."""
    (xx, _, _), (yx, _, _), (zx, zy, zz) = _flip_both(R_odom_drone).tolist()
    return math.atan2(zy, zz), math.asin(min(max(-zx, -1.0), 1.0)), math.atan2(yx, xx)


def R_odom_drone_from_wxyz(quaternion_wxyz: Sequence[float]) -> Array64:
    """R_odom_drone (3, 3) of ODOMETRY's q = (w, x, y, z), the rotation from FRD to NED."""
    w, x, y, z = quaternion_wxyz
    return _flip_both(rotation_from_quaternion_xyzw((x, y, z, w)))


def wxyz_from_R_odom_drone(R_odom_drone: Array64) -> list[float]:
    """ODOMETRY's q = (w, x, y, z), w >= 0, of R_odom_drone (3, 3)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = _flip_both(R_odom_drone).tolist()
    # Each row is q times one of its components; the longest is the best conditioned.
    rows = (
        (1 + xx + yy + zz, zy - yz, xz - zx, yx - xy),
        (zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx),
        (xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy),
        (yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz),
    )
    lengths = [math.sqrt(w * w + x * x + y * y + z * z) for w, x, y, z in rows]
    length = max(lengths)
    row = rows[lengths.index(length)]
    signed = length if row[0] >= 0 else -length
    return [value / signed for value in row]


def pose_covariance_from_upper(upper: Sequence[float], R_odom_drone: Array64) -> Array64 | None:
    """Covariance (6, 6), rotation first, of MAVLink's 21 numbers; None: unknown ([0] is NaN) or invalid."""
    covariance = _from_upper(upper)
    if covariance is None:
        return None
    J = _EYE6.copy()
    J[3:, 3:] = R_odom_drone.T
    return J @ covariance @ J.T


def velocity_covariance_from_upper(upper: Sequence[float]) -> Array64 | None:
    """Covariance (6, 6) of (angular velocity, velocity), drone axes, of MAVLink's 21 numbers in FRD; None: invalid."""
    covariance = _from_upper(upper)
    return None if covariance is None else covariance + 0.0  # as in `_flip_both`


def upper_from_pose_covariance(covariance: Array64, R_odom_drone: Array64) -> list[float]:
    """MAVLink's 21 numbers of a pose covariance (6, 6), rotation first."""
    J = _EYE6.copy()
    J[3:, 3:] = R_odom_drone
    return _to_upper(J @ covariance @ J.T)


def upper_from_velocity_covariance(covariance: Array64) -> list[float]:
    """MAVLink's 21 numbers of a covariance (6, 6), angular velocity first, drone axes."""
    return _to_upper(covariance)


def _from_upper(upper: Sequence[float]) -> Array64 | None:
    """(6, 6) in grd's order and signs; None: not finite, or a negative variance."""
    if len(upper) != 21 or not all(map(math.isfinite, upper)) or any([upper[k] < 0 for k in _VARIANCES]):
        return None
    return (np.array(upper, dtype=np.float64) + 0.0)[_FROM] * _SIGNS


def _to_upper(covariance: Array64) -> list[float]:
    return (covariance.take(_TO) * _UPPER_SIGNS).tolist()
