"""NED and FRD meet x-forward, y-left, z-up here and nowhere else.

MAVLink's local frame has x north, y east, z down, its body x forward, y right, z down. Ours have y and z turned over:

    local: x north (the autopilot's north), y west, z up        drone: x forward, y left, z up
    v_local = F v_ned,   v_drone = F v_frd,   R_odom_drone = F R_ned_frd F,   F = diag(1, -1, -1) = F^-1

MAVLink's pose covariance has the states x, y, z, roll, pitch, yaw, its velocity covariance vx, vy, vz, rollspeed,
pitchspeed, yawspeed, the upper triangle by rows. Ours has rotation first, tangent at the body (p_body = R^T p_local).
Roll, pitch and yaw errors are taken as small turns about the body's x, y, z: exact for a level drone, within 2 % up to
a lean of 10 deg.

Source: https://mavlink.io/en/messages/common.html#MAV_FRAME and #ODOMETRY; DESIGN, Frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from stages.geometry.frames import Array64, rotation_from_quaternion_xyzw, rotation_from_rpy_deg

FLIP = np.array([1.0, -1.0, -1.0])
F_AND_F = np.outer(FLIP, FLIP)  # F M F is M times this, number by number
SWAPPED = [3, 4, 5, 0, 1, 2]  # translation first <-> rotation first
UPPER = np.triu_indices(6)  # MAVLink's 21 numbers
_NUMBER = np.zeros((6, 6), dtype=np.intp)  # which of them stands where
_NUMBER[UPPER] = _NUMBER.T[UPPER] = np.arange(21)
_FROM = _NUMBER[np.ix_(SWAPPED, SWAPPED)]  # and where in ours
_TO = np.arange(36).reshape(6, 6)[np.ix_(SWAPPED, SWAPPED)][UPPER]  # where in ours each of them stands
_SIGNS = np.tile(F_AND_F, (2, 2))  # the same in both orders
_UPPER_SIGNS = _SIGNS[UPPER]
_VARIANCES = np.diagonal(_NUMBER).tolist()
_EYE6 = np.eye(6)


def turned_over(vector: Array64) -> Array64:
    """(x, -y, -z): NED <-> local, FRD <-> drone, for vectors and turn rates (..., 3)."""
    return vector * FLIP


def _both_turned_over(R: Array64) -> Array64:
    """F R F; without minus zeros, as a product of matrices has none."""
    return R * F_AND_F + 0.0


def R_odom_drone_from_rpy(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array64:
    """R_odom_drone (3, 3) of ATTITUDE's angles: R_ned_frd = Rz(yaw) Ry(pitch) Rx(roll)."""
    R_ned_frd = rotation_from_rpy_deg((math.degrees(roll_rad), math.degrees(pitch_rad), math.degrees(yaw_rad)))
    return _both_turned_over(R_ned_frd)


def rpy_from_R_odom_drone(R_odom_drone: Array64) -> tuple[float, float, float]:
    """ATTITUDE's roll, pitch, yaw [rad] of R_odom_drone (3, 3)."""
    (xx, _, _), (yx, _, _), (zx, zy, zz) = _both_turned_over(R_odom_drone).tolist()
    return math.atan2(zy, zz), math.asin(min(max(-zx, -1.0), 1.0)), math.atan2(yx, xx)


def R_odom_drone_from_wxyz(quaternion_wxyz: Sequence[float]) -> Array64:
    """R_odom_drone (3, 3) of ODOMETRY's q = (w, x, y, z), the turn from FRD to NED."""
    w, x, y, z = quaternion_wxyz
    return _both_turned_over(rotation_from_quaternion_xyzw((x, y, z, w)))


def wxyz_from_R_odom_drone(R_odom_drone: Array64) -> list[float]:
    """ODOMETRY's q = (w, x, y, z), w >= 0, of R_odom_drone (3, 3)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = _both_turned_over(R_odom_drone).tolist()
    # Each row is q times one of its components: the longest is the best conditioned.
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
    """Ours (6, 6) of MAVLink's 21 numbers; None where the autopilot gave none ([0] is NaN) or no covariance."""
    ours = _from_upper(upper)
    if ours is None:
        return None
    J = _EYE6.copy()
    J[3:, 3:] = R_odom_drone.T
    return J @ ours @ J.T


def velocity_covariance_from_upper(upper: Sequence[float]) -> Array64 | None:
    """Turn rate before velocity, drone axes (6, 6), of MAVLink's 21 numbers in FRD; None as above."""
    ours = _from_upper(upper)
    return None if ours is None else ours + 0.0  # as in `_both_turned_over`


def upper_from_pose_covariance(covariance: Array64, R_odom_drone: Array64) -> list[float]:
    """MAVLink's 21 numbers of ours (6, 6)."""
    J = _EYE6.copy()
    J[3:, 3:] = R_odom_drone
    return _to_upper(J @ covariance @ J.T)


def upper_from_velocity_covariance(covariance: Array64) -> list[float]:
    """MAVLink's 21 numbers of (6, 6), turn rate first, drone axes."""
    return _to_upper(covariance)


def _from_upper(upper: Sequence[float]) -> Array64 | None:
    """(6, 6) in our order and signs."""
    if len(upper) != 21 or not all(map(math.isfinite, upper)) or any([upper[k] < 0 for k in _VARIANCES]):
        return None
    return (np.array(upper, dtype=np.float64) + 0.0)[_FROM] * _SIGNS


def _to_upper(ours: Array64) -> list[float]:
    return (ours.take(_TO) * _UPPER_SIGNS).tolist()
