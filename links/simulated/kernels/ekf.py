"""A 15-state error-state Kalman filter: position, velocity, attitude, gyro bias, accelerometer bias.

Nominal state (16,): p, v, quaternion xyzw (R_odom_body), gyro bias, accelerometer bias. Errors (15,): dp, dv, dtheta in
R exp(dtheta), dbg, dba. Frame odom has z up.

    p' = v,  v' = R (a - ba) - g,  R' = R [w - bg]x

Source: Sola, "Quaternion kinematics for the error-state Kalman filter" (2017), section 5, local perturbation.
"""

from __future__ import annotations

import numpy as np

from links.simulated.kernels.airframe import propagate, rotation, turn
from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

STATES = 15


@compiled
def predict(x: Array64, P: Array64, moved: Array64, dt_s: float, noise: Array64) -> None:
    """Predict x (16,) and P (15, 15) by delta angle and delta velocity `moved` (6,) over dt_s.

    noise (4,): one sigma of gyro [rad/s] and accelerometer [m/s^2] over the interval, and of the biases' change per
    second, as EK3_GYRO_P_NSE, EK3_ACC_P_NSE, EK3_GBIAS_P_NSE and EK3_ABIAS_P_NSE.
    """
    R = np.empty((3, 3))
    rotation(x[6:10], R)
    rate, force = moved[0:3] / dt_s - x[10:13], moved[3:6] / dt_s - x[13:16]
    F = np.eye(STATES)
    cross_a = np.array([[0.0, -force[2], force[1]], [force[2], 0.0, -force[0]], [-force[1], force[0], 0.0]])
    cross_w = np.array([[0.0, -rate[2], rate[1]], [rate[2], 0.0, -rate[0]], [-rate[1], rate[0], 0.0]])
    turned = R @ cross_a
    for i in range(3):
        F[i, 3 + i] = dt_s
        F[6 + i, 9 + i] = -dt_s
        for j in range(3):
            F[3 + i, 6 + j] = -dt_s * turned[i, j]
            F[i, 6 + j] = -0.5 * dt_s * dt_s * turned[i, j]
            F[3 + i, 12 + j] = -dt_s * R[i, j]
            F[i, 12 + j] = -0.5 * dt_s * dt_s * R[i, j]
            F[6 + i, 6 + j] -= dt_s * cross_w[i, j]
    P[:] = F @ P @ F.T
    for i in range(3):
        P[3 + i, 3 + i] += (noise[1] * dt_s) ** 2
        P[6 + i, 6 + i] += (noise[0] * dt_s) ** 2
        P[9 + i, 9 + i] += (noise[2] * dt_s) ** 2
        P[12 + i, 12 + i] += (noise[3] * dt_s) ** 2
    propagate(x, moved / dt_s, dt_s)


@compiled
def fuse(x: Array64, P: Array64, H: Array64, innovation: float, variance: float) -> None:
    """Kalman update with one scalar: H (15,), innovation = measured - predicted, variance of the measurement."""
    PH = P @ H
    S = variance
    for i in range(STATES):
        S += H[i] * PH[i]
    gain = PH / S
    for i in range(STATES):
        for j in range(STATES):
            P[i, j] -= gain[i] * PH[j]
    for i in range(STATES):
        for j in range(i):
            P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])
        P[i, i] = max(P[i, i], 1e-12)
    correction = gain * innovation
    x[0:6] += correction[0:6]
    x[10:16] += correction[9:15]
    turn(x[6:10], correction[6], correction[7], correction[8])


@compiled
def yaw_and_jacobian(x: Array64, H: Array64) -> float:
    """Yaw = atan2(R10, R00) of x, and its derivative by the errors into H (15,)."""
    R = np.empty((3, 3))
    rotation(x[6:10], R)
    flat = R[0, 0] ** 2 + R[1, 0] ** 2
    H[:] = 0.0
    H[7] = -(R[0, 0] * R[1, 2] - R[1, 0] * R[0, 2]) / flat
    H[8] = (R[0, 0] * R[1, 1] - R[1, 0] * R[0, 1]) / flat
    return float(np.arctan2(R[1, 0], R[0, 0]))


@compiled
def reset_yaw(x: Array64, P: Array64, yaw_rad: float, variance: float) -> float:
    """Turn x about the vertical to a yaw, forget the attitude's correlations; returns the change of yaw [rad]."""
    H = np.empty(STATES)
    change = yaw_rad - yaw_and_jacobian(x, H)
    change = float(np.arctan2(np.sin(change), np.cos(change)))
    half = 0.5 * change
    s, c = np.sin(half), np.cos(half)
    qx, qy, qz, qw = x[6], x[7], x[8], x[9]
    x[6], x[7], x[8], x[9] = c * qx - s * qy, c * qy + s * qx, c * qz + s * qw, c * qw - s * qz
    tilt = 0.5 * (P[6, 6] + P[7, 7])
    P[6:9, :] = 0.0
    P[:, 6:9] = 0.0
    P[6, 6] = P[7, 7] = tilt
    P[8, 8] = variance
    return change


@compiled
def reset_states(x: Array64, P: Array64, first: int, values: Array64, variance: float) -> None:
    """Set position or velocity states from `first` on to values, and forget their correlations."""
    for i in range(len(values)):
        x[first + i] = values[i]
        P[first + i, :] = 0.0
        P[:, first + i] = 0.0
        P[first + i, first + i] = variance


@compiled
def propagated(x: Array64, moved: Array64, dt_s: float) -> Array64:
    """x (16,) propagated through the delta angles and velocities (n, 6) of intervals dt_s: from the horizon to now."""
    out = x.copy()
    for k in range(moved.shape[0]):
        propagate(out, moved[k] / dt_s, dt_s)
    return out
