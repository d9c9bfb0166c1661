"""A quadrotor under its attitude controller, with its IMU, in steps of STEP_S.

The attitude controller sees the *estimated* attitude only; truth moves the airframe. State (17,): position, velocity
(world, z up), quaternion xyzw (world from body), turn rate, thrust [m/s^2], 1 on the ground, 1 crashed, time [s].

    acceleration = R [0, 0, thrust] - DRAG (v - wind) - g
    thrust, turn rate: first-order lags behind their commands
    IMU: R^T (acceleration + g) and turn rate, with bias, white noise and rotor vibration; the gyro with a scale error

Vibration is a sum over the rotors of a tone at the rotation rate (imbalance) and one of half its size at twice the rate
(two blades), with phases of its own on each axis, and of broadband noise (airflow, frame). The rate goes with the root
of the thrust. A stream slower than twice these rates contains their aliases.

Source: ours; the airframe of `links.simulated.kernels.motion.fly` with the estimate in the loop. Biquad: ArduPilot
libraries/Filter/LowPassFilter2p.cpp (Butterworth), with which it filters what RAW_IMU reports.
"""

from __future__ import annotations

import numpy as np

from links.simulated.kernels.motion import DRAG_PER_S, GRAVITY_MPS2, STEP_S, YAW_GAIN_PER_S
from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

POSITION, VELOCITY, QUATERNION, RATE = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13)
THRUST, GROUNDED, CRASHED, TIME, STATE_SIZE = 13, 14, 15, 16, 17
LEG_M = 0.2  # height of the body over the ground when it stands
HARD_LANDING_MPS, TIPPED = 2.5, 0.5  # a faster touch-down, or a tilt of 60 deg (cosine), is a crash


@compiled
def fly_steps(
    state: Array64,
    estimate: Array64,
    command: Array64,
    wind: Array64,
    noise: Array64,
    limits: Array64,
    imu: Array64,
    rotors: Array64,
    filters: Array64,
    coefficients: Array64,
    rows: Array64,
    samples: Array64,
    estimates: Array64,
) -> Array64:
    """Fly one step for each row of `wind`; returns delta angle (3), delta velocity (3), body axes.

    state (17,) and estimate (16,: p, v, q, gyro bias, accelerometer bias in the estimator's frame) are updated. command
    (7,): desired acceleration + g in the estimator's frame, yaw, yaw rate, 1: motors run, ground height. wind (n, 3);
    noise (n, 6) standard normal; limits as of `fly`; imu (19,): gyro bias, accelerometer bias, their white noise per
    sample, vibration amplitude of gyro and accelerometer, scale error of the gyro (3 each, but one white noise each),
    and broadband vibration per sample of gyro and accelerometer.
    rotors (4, 8): phase, rate [Hz], phase offset of the six axes. filters (6, 2) and coefficients (5,): the low-pass of
    the reported samples. rows (n, 17), samples (n, 6), estimates (n, 10) take each step's truth, reported gyro and
    accelerometer, and estimate.
    """
    gain, max_rate, max_yaw_rate, rate_lag, thrust_lag, max_slope = limits
    R, S, force, drag, desired = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    raw, moved = np.empty(6), np.zeros(6)
    for k in range(wind.shape[0]):
        rotation(state[6:10], R)
        for i in range(3):
            drag[i] = -DRAG_PER_S * (state[3 + i] - wind[k, i])
        net_z = R[2, 2] * state[13] + drag[2] - GRAVITY_MPS2
        if state[2] <= command[6] + LEG_M:
            fast = np.sqrt(state[3] ** 2 + state[4] ** 2) > HARD_LANDING_MPS or state[5] < -HARD_LANDING_MPS
            if state[14] == 0.0 and (fast or R[2, 2] < TIPPED):
                state[15] = 1.0
            state[14] = 1.0 if net_z <= 0.0 or state[15] > 0.0 else 0.0
        else:
            state[14] = 0.0
        if state[14] > 0.0:
            state[3:6] = 0.0
            state[10:13] = 0.0
            for i in range(3):
                drag[i] = 0.0
            for i in range(3):
                force[i] = R[2, i] * GRAVITY_MPS2
        else:
            for i in range(3):
                force[i] = R[0, i] * drag[0] + R[1, i] * drag[1] + R[2, i] * drag[2]
            force[2] += state[13]
        rows[k] = state

        for rotor in range(rotors.shape[0]):
            speed = rotors[rotor, 1] * np.sqrt(max(state[13], 0.0) / GRAVITY_MPS2)
            rotors[rotor, 0] = (rotors[rotor, 0] + 2 * np.pi * speed * STEP_S) % (2 * np.pi)
        running = command[5] > 0.0 and state[15] == 0.0
        for i in range(6):
            shake = 0.0
            for rotor in range(rotors.shape[0]):
                angle = rotors[rotor, 0] + rotors[rotor, 2 + i]
                shake += np.sin(angle) + 0.5 * np.sin(2 * angle)
            true = state[10 + i] * (1.0 + imu[14 + i]) if i < 3 else force[i - 3]
            white = imu[6] if i < 3 else imu[7]
            if running:
                white = np.hypot(white, imu[17] if i < 3 else imu[18])
            raw[i] = true + imu[i] + white * noise[k, i] + (imu[8 + i] * shake if running else 0.0)
            moved[i] += raw[i] * STEP_S
            samples[k, i] = low_pass_sample(raw[i], filters[i], coefficients)

        for i in range(3):
            estimates[k, i], estimates[k, 3 + i] = estimate[i], estimate[3 + i]
        estimates[k, 6:10] = estimate[6:10]
        rotation(estimate[6:10], S)
        for i in range(3):
            desired[i] = command[i]
        slope = np.sqrt(desired[0] ** 2 + desired[1] ** 2) / max(desired[2], 0.1)
        if slope > max_slope:
            desired[0] *= max_slope / slope
            desired[1] *= max_slope / slope
        size = np.sqrt(desired[0] ** 2 + desired[1] ** 2 + desired[2] ** 2)
        along = desired[0] * S[0, 2] + desired[1] * S[1, 2] + desired[2] * S[2, 2]
        wanted = min(max(along, 0.1 * GRAVITY_MPS2), 2.0 * GRAVITY_MPS2) if running else 0.0
        body_x = (S[0, 0] * desired[0] + S[1, 0] * desired[1] + S[2, 0] * desired[2]) / size
        body_y = (S[0, 1] * desired[0] + S[1, 1] * desired[1] + S[2, 1] * desired[2]) / size
        yaw_error = command[3] - np.arctan2(S[1, 0], S[0, 0])
        yaw_error = np.arctan2(np.sin(yaw_error), np.cos(yaw_error))
        rate_command = (-gain * body_y, gain * body_x, command[4] + YAW_GAIN_PER_S * yaw_error)
        propagate(estimate, raw, STEP_S)

        for i in range(3):
            limit = max_yaw_rate if i == 2 else max_rate
            unseen = imu[i] - estimate[10 + i]  # the rate controller follows the gyro
            aim = min(max(rate_command[i], -limit), limit) - unseen if running else 0.0
            state[10 + i] += (aim - state[10 + i]) * STEP_S / rate_lag
        state[13] += (wanted - state[13]) * STEP_S / thrust_lag
        state[16] += STEP_S
        if state[14] > 0.0:
            continue
        for i in range(3):
            net = R[i, 2] * rows[k, 13] + drag[i] - (GRAVITY_MPS2 if i == 2 else 0.0)
            state[i] += STEP_S * (state[3 + i] + 0.5 * STEP_S * net)
            state[3 + i] += STEP_S * net
        state[2] = max(state[2], command[6] + LEG_M - 1e-3)
        turn(state[6:10], state[10] * STEP_S, state[11] * STEP_S, state[12] * STEP_S)
    return moved


@compiled
def rotation(q: Array64, R: Array64) -> None:
    """Rotation matrix of a quaternion xyzw, into R (3, 3)."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@compiled
def turn(q: Array64, x_rad: float, y_rad: float, z_rad: float) -> None:
    """q <- q exp(rotation vector), body axes, normalised."""
    angle = np.sqrt(x_rad * x_rad + y_rad * y_rad + z_rad * z_rad)
    factor = 0.5 - angle * angle / 48.0 if angle < 1e-4 else np.sin(0.5 * angle) / angle
    a, b, c, d = factor * x_rad, factor * y_rad, factor * z_rad, np.cos(0.5 * angle)
    x, y, z, w = q[0], q[1], q[2], q[3]
    q[0], q[1] = w * a + x * d + y * c - z * b, w * b - x * c + y * d + z * a
    q[2], q[3] = w * c + x * b - y * a + z * d, w * d - x * a - y * b - z * c
    q /= np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)


@compiled
def propagate(estimate: Array64, raw: Array64, dt_s: float) -> None:
    """Strapdown of an estimate (16,: p, v, q, gyro bias, accelerometer bias) with one IMU sample (6,)."""
    R = np.empty((3, 3))
    half = estimate[6:10].copy()
    rate = raw[0:3] - estimate[10:13]
    turn(half, 0.5 * dt_s * rate[0], 0.5 * dt_s * rate[1], 0.5 * dt_s * rate[2])
    rotation(half, R)
    for i in range(3):
        net = -GRAVITY_MPS2 if i == 2 else 0.0
        for j in range(3):
            net += R[i, j] * (raw[3 + j] - estimate[13 + j])
        estimate[i] += dt_s * (estimate[3 + i] + 0.5 * dt_s * net)
        estimate[3 + i] += dt_s * net
    turn(estimate[6:10], dt_s * rate[0], dt_s * rate[1], dt_s * rate[2])


@compiled
def low_pass_sample(value: float, memory: Array64, coefficients: Array64) -> float:
    """One sample of a biquad in direct form II; coefficients b0, b1, b2, a1, a2; memory (2,)."""
    b0, b1, b2, a1, a2 = coefficients
    inner = value - a1 * memory[0] - a2 * memory[1]
    out = b0 * inner + b1 * memory[0] + b2 * memory[1]
    memory[1], memory[0] = memory[0], inner
    return out
