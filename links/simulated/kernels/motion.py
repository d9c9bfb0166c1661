"""Motion in small time steps: flight dynamics, spring oscillators, splines, first-order filters.

Source: ours; see links/simulated/world for the equations.
"""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

STEP_S = 1 / 400  # integration step of flight and suspension
GRAVITY_MPS2 = 9.81
DRAG_PER_S = 0.3  # drag acceleration per speed of a small quadrotor
KP_PER_S2, KD_PER_S, KI_PER_S3 = 4.0, 3.0, 0.8  # position controller
VERTICAL_STIFFER = 2.0
MAX_INTEGRAL_MPS2 = 3.0
YAW_GAIN_PER_S = 3.0


@compiled
def rotations_z(angle_rad: Array64) -> Array64:
    """Rz for each angle: (n, 3, 3)."""
    rotations = np.zeros((len(angle_rad), 3, 3))
    for i in range(len(angle_rad)):
        c, s = np.cos(angle_rad[i]), np.sin(angle_rad[i])
        rotations[i, 0, 0], rotations[i, 0, 1] = c, -s
        rotations[i, 1, 0], rotations[i, 1, 1] = s, c
        rotations[i, 2, 2] = 1.0
    return rotations


@compiled
def evaluate_cubics(
    knot_s: Array64, knots: Array64, linear: Array64, M: Array64, cubic: Array64, time_s: Array64
) -> tuple[Array64, Array64, Array64]:
    """y_i + s (linear_i + s (M_i / 2 + s cubic_i)) with s = t - t_i, and its derivatives."""
    shape = (len(time_s), knots.shape[1])
    value, slope, curve = np.empty(shape), np.zeros(shape), np.zeros(shape)
    for n in range(len(time_s)):
        t = min(max(time_s[n], knot_s[0]), knot_s[-1])
        i = min(max(np.searchsorted(knot_s, t, side="right") - 1, 0), len(knot_s) - 2)
        s = t - knot_s[i]
        for d in range(knots.shape[1]):
            value[n, d] = knots[i, d] + s * (linear[i, d] + s * (M[i, d] / 2 + s * cubic[i, d]))
            if t == time_s[n]:
                slope[n, d] = linear[i, d] + s * (M[i, d] + 3 * s * cubic[i, d])
                curve[n, d] = M[i, d] + 6 * s * cubic[i, d]
    return value, slope, curve


@compiled
def first_order_recursion(white: Array64, decay: float) -> Array64:
    """y_0 = x_0, y_k = decay y_{k-1} + sqrt(1 - decay^2) x_k for rows x (n, d): keeps the variance of white noise."""
    gain = np.sqrt(1.0 - decay * decay)
    out = white.copy()
    for k in range(1, len(white)):
        for axis in range(white.shape[1]):
            out[k, axis] = decay * out[k - 1, axis] + gain * white[k, axis]
    return out


@compiled
def oscillate(target: Array64, frequency_radps: float, damping: float) -> Array64:
    """Damped oscillators that follow targets (n, d), one row per STEP_S, starting at rest on the first target.

    angle'' = w^2 (target - angle) - 2 d w angle', w the angular frequency and d the damping ratio.
    """
    out = np.empty_like(target)
    for axis in range(target.shape[1]):
        angle, speed = target[0, axis], 0.0
        for k in range(target.shape[0]):
            out[k, axis] = angle
            acceleration = frequency_radps**2 * (target[k, axis] - angle) - 2 * damping * frequency_radps * speed
            speed += STEP_S * acceleration
            angle += STEP_S * speed
    return out


@compiled
def fly(
    position: Array64,
    velocity: Array64,
    acceleration: Array64,
    yaw: Array64,
    wind: Array64,
    mean_wind: Array64,
    attitude: Array64,
    limits: Array64,
) -> Array64:
    """States (n, 16), one per STEP_S: p, v (world), q (x, y, z, w), turn rate and specific force (drone axes).

    The reference path is position, velocity, acceleration (n, 3), yaw and its rate (n, 2). The controller knows the
    mean of the wind (n, 3). The flight starts on the path with the attitude for still air (quaternion `attitude`).
    """
    gain, max_rate, max_yaw_rate, rate_lag, thrust_lag, max_slope = limits
    states = np.empty((position.shape[0], 16))
    p, v, q = position[0].copy(), velocity[0].copy(), attitude.copy()
    rate, integral = np.zeros(3), -DRAG_PER_S * mean_wind
    desired, force, R = np.empty(3), np.empty(3), np.empty((3, 3))
    thrust = np.sqrt(np.sum((acceleration[0] + DRAG_PER_S * v + np.array([0.0, 0.0, GRAVITY_MPS2])) ** 2))
    for k in range(position.shape[0]):
        x, y, z, w = q
        R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        drag = -DRAG_PER_S * (v - wind[k])
        for i in range(3):
            force[i] = R[0, i] * drag[0] + R[1, i] * drag[1] + R[2, i] * drag[2]
        force[2] += thrust
        states[k, 0:3], states[k, 3:6], states[k, 6:10], states[k, 10:13], states[k, 13:16] = p, v, q, rate, force

        for i in range(3):
            stiff = VERTICAL_STIFFER if i == 2 else 1.0
            error = position[k, i] - p[i]
            integral[i] = min(max(integral[i] + KI_PER_S3 * error * STEP_S, -MAX_INTEGRAL_MPS2), MAX_INTEGRAL_MPS2)
            feedback = stiff * (KP_PER_S2 * error + KD_PER_S * (velocity[k, i] - v[i])) + integral[i]
            desired[i] = acceleration[k, i] + DRAG_PER_S * velocity[k, i] + feedback
        desired[2] = max(desired[2] + GRAVITY_MPS2, 0.3 * GRAVITY_MPS2)
        slope = np.sqrt(desired[0] ** 2 + desired[1] ** 2) / desired[2]
        if slope > max_slope:
            desired[0] *= max_slope / slope
            desired[1] *= max_slope / slope
        size = np.sqrt(desired[0] ** 2 + desired[1] ** 2 + desired[2] ** 2)
        along = desired[0] * R[0, 2] + desired[1] * R[1, 2] + desired[2] * R[2, 2]
        thrust += (max(along, 0.1 * GRAVITY_MPS2) - thrust) * STEP_S / thrust_lag

        # the rotation vector, in body axes, from body z to the desired direction: z x desired = (-body_y, body_x, 0)
        body_x = (R[0, 0] * desired[0] + R[1, 0] * desired[1] + R[2, 0] * desired[2]) / size
        body_y = (R[0, 1] * desired[0] + R[1, 1] * desired[1] + R[2, 1] * desired[2]) / size
        yaw_error = yaw[k, 0] - np.arctan2(R[1, 0], R[0, 0])
        yaw_error = np.arctan2(np.sin(yaw_error), np.cos(yaw_error))
        rate_command = (-gain * body_y, gain * body_x, yaw[k, 1] + YAW_GAIN_PER_S * yaw_error)
        for i in range(3):
            limit = max_yaw_rate if i == 2 else max_rate
            rate[i] += (min(max(rate_command[i], -limit), limit) - rate[i]) * STEP_S / rate_lag

        for i in range(3):
            net = R[i, 2] * thrust + drag[i] - (GRAVITY_MPS2 if i == 2 else 0.0)
            p[i] += STEP_S * (v[i] + 0.5 * STEP_S * net)
            v[i] += STEP_S * net
        a, b, c = 0.5 * STEP_S * rate[0], 0.5 * STEP_S * rate[1], 0.5 * STEP_S * rate[2]
        q[0], q[1], q[2], q[3] = (
            x + a * w + c * y - b * z,
            y + b * w + a * z - c * x,
            z + c * w + b * x - a * y,
            w - a * x - b * y - c * z,
        )
        q /= np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    return states
