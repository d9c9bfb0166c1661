"""NED and FRD meet x-forward, y-left, z-up here and nowhere else.

MAVLink's local frame has x north, y east, z down, its body x forward, y right, z down. Ours have y and z turned over:

    local: x north (the autopilot's north), y west, z up        drone: x forward, y left, z up
    v_local = F v_ned,   v_drone = F v_frd,   R_local_drone = F R_ned_frd F,   F = diag(1, -1, -1) = F^-1

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

from stages.geometry import Array64, rotation_from_quaternion_xyzw, rotation_from_rpy_deg

F = np.diag([1.0, -1.0, -1.0])
UPPER = np.triu_indices(6)  # MAVLink's 21 numbers
SWAPPED = [3, 4, 5, 0, 1, 2]  # translation first <-> rotation first
FLIP6 = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])


def turned_over(vector: Array64) -> Array64:
    """(x, -y, -z): NED <-> local, FRD <-> drone, for vectors and turn rates (..., 3)."""
    return vector * np.array([1.0, -1.0, -1.0])


def R_local_drone_from_rpy(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array64:
    """R_local_drone (3, 3) of ATTITUDE's angles: R_ned_frd = Rz(yaw) Ry(pitch) Rx(roll)."""
    R_ned_frd = rotation_from_rpy_deg((math.degrees(roll_rad), math.degrees(pitch_rad), math.degrees(yaw_rad)))
    return F @ R_ned_frd @ F


def rpy_from_R_local_drone(R_local_drone: Array64) -> tuple[float, float, float]:
    """ATTITUDE's roll, pitch, yaw [rad] of R_local_drone (3, 3)."""
    R = F @ R_local_drone @ F
    pitch = math.asin(min(max(-float(R[2, 0]), -1.0), 1.0))
    return math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])


def R_local_drone_from_wxyz(quaternion_wxyz: Sequence[float]) -> Array64:
    """R_local_drone (3, 3) of ODOMETRY's q = (w, x, y, z), the turn from FRD to NED."""
    w, x, y, z = quaternion_wxyz
    return F @ rotation_from_quaternion_xyzw((x, y, z, w)) @ F


def wxyz_from_R_local_drone(R_local_drone: Array64) -> list[float]:
    """ODOMETRY's q = (w, x, y, z), w >= 0, of R_local_drone (3, 3)."""
    R = F @ R_local_drone @ F
    # Each row is q times one of its components: the longest is the best conditioned.
    rows = np.array(
        [
            [1 + R[0, 0] + R[1, 1] + R[2, 2], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], 1 + R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
            [R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], 1 - R[0, 0] + R[1, 1] - R[2, 2], R[1, 2] + R[2, 1]],
            [R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], 1 - R[0, 0] - R[1, 1] + R[2, 2]],
        ]
    )
    lengths = np.linalg.norm(rows, axis=1)
    q = rows[lengths.argmax()] / lengths.max()
    return (q if q[0] >= 0 else -q).tolist()


def pose_covariance_from_upper(upper: Sequence[float], R_local_drone: Array64) -> Array64 | None:
    """Ours (6, 6) of MAVLink's 21 numbers; None where the autopilot gave none ([0] is NaN) or no covariance."""
    return _from_upper(upper, R_local_drone.T)


def velocity_covariance_from_upper(upper: Sequence[float]) -> Array64 | None:
    """Turn rate before velocity, drone axes (6, 6), of MAVLink's 21 numbers in FRD; None as above."""
    return _from_upper(upper, np.eye(3))


def upper_from_pose_covariance(covariance: Array64, R_local_drone: Array64) -> list[float]:
    """MAVLink's 21 numbers of ours (6, 6)."""
    J = np.eye(6)
    J[3:, 3:] = R_local_drone
    return _to_upper(J @ covariance @ J.T)


def upper_from_velocity_covariance(covariance: Array64) -> list[float]:
    """MAVLink's 21 numbers of (6, 6), turn rate first, drone axes."""
    return _to_upper(covariance)


def _from_upper(upper: Sequence[float], R_ours_from: Array64) -> Array64 | None:
    values = np.asarray(upper, dtype=np.float64)
    if values.shape != (21,) or not np.isfinite(values).all():
        return None
    theirs = np.zeros((6, 6))
    theirs[UPPER] = values
    theirs = theirs + np.triu(theirs, 1).T
    if (np.diagonal(theirs) < 0).any():
        return None
    ours = (FLIP6[:, None] * theirs * FLIP6)[np.ix_(SWAPPED, SWAPPED)]
    J = np.eye(6)
    J[3:, 3:] = R_ours_from
    return J @ ours @ J.T


def _to_upper(ours: Array64) -> list[float]:
    theirs = FLIP6[:, None] * ours[np.ix_(SWAPPED, SWAPPED)] * FLIP6
    return theirs[UPPER].tolist()
