"""Compiled functions that compare a path with the drone's odometry and with other motion models.

Source: see `stages/detect/motion_log_ratios.py`.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.geometry.smooth_motion import log_p, misfit, model_of

YAWS = 72  # steps of 5 deg: coarser, a fast straight flight fits none
DRIFT_MPS = 0.3  # horizontal velocity drift of autopilot and vehicle together
DRIFT_UP_MPS = 0.1
BY_ODOMETRY = (DRIFT_MPS, DRIFT_UP_MPS, 0.0, 0.0)  # sigmas of its error: velocity, level and up; acceleration, the same
IMU_MPS2, IMU_UP_MPS2 = 0.35, 0.2  # roll and pitch 2 deg wrong; bias of the accelerometer
BY_IMU = (6.0, 2.0, IMU_MPS2, IMU_UP_MPS2)  # its velocity is not known
HOVERING = (DRIFT_MPS, DRIFT_UP_MPS, IMU_MPS2, IMU_UP_MPS2)  # or nearly zero: half of the drones, assumed
SCATTERED_M = 0.45  # scatter of the sightings of a long object
SLIDING_MPS = 0.5  # or speed at which sightings move along it
FOLLOWED_MPS = 5.0  # the same along a wire, where each pass is aimed as at a flying object
CRUISING, CRUISE_MPS, CRUISE_SIGMA_MPS = 0.8, 10.0, 2.5  # share of birds' time, speed; else anything up to it
BIRD = (6.0, 3.0, 1.5, 1.0)  # sigma of speed [m/s] and acceleration [m/s^2], level; the same, up
BALLOON = (0.7, 0.7, 0.3, 0.4)  # the same, on a string (balloon)
SWAY_M = 1.0  # sigma of its total displacement, at any duration
LOOSE, LOOSE_MPS, LOOSE_MPS2 = 0.1, 2.0, 0.3  # assumed share of balloons that drift with the wind, their sigmas


@compiled
def weigh(
    t_s: Array64,
    x_m: Array64,
    odometry_m: Array64,
    sigma_m: float,
    level_known: bool,
    error: tuple[float, float, float, float] = BY_ODOMETRY,
) -> tuple[float, float, float, float, float]:
    """Values of MotionLogRatios for a path x (n, 3) at times t (n,), compared with the drone's odometry (n, 3).

    error: of the odometry, BY_ODOMETRY or BY_IMU.
    """
    x, d = x_m.copy(), odometry_m.copy()
    for axis in range(3):
        x[:, axis] -= x[:, axis].mean()
        d[:, axis] -= d[:, axis].mean()
    drone, off2 = _as_drone(t_s, x, d, sigma_m, level_known, error)
    if error == BY_IMU:
        drone = _log_sum(drone, _as_drone(t_s, x, d, sigma_m, level_known, HOVERING)[0]) - math.log(2.0)
    as_still = model_of(t_s, sigma_m, DRIFT_MPS, error[2])
    as_long = model_of(t_s, SCATTERED_M, 0.0, 0.0)
    as_sliding = model_of(t_s, sigma_m, SLIDING_MPS, error[2])
    as_followed = model_of(t_s, sigma_m, FOLLOWED_MPS, error[2])
    up = x[:, 2].copy()
    coordinates = 3.0 if level_known else 1.0
    # a static object has the same errors, so that a drone that hovers is neither more nor less probable
    still, long = log_p(model_of(t_s, sigma_m, DRIFT_UP_MPS, error[3]), t_s, up), log_p(as_long, t_s, up)
    sliding = followed = still
    bird = log_p(model_of(t_s, sigma_m, BIRD[2], BIRD[3]), t_s, up)
    sway_mps = SWAY_M / max(t_s.max() - t_s.min(), 1e-3)
    balloon = log_p(model_of(t_s, sigma_m, min(BALLOON[2], sway_mps), BALLOON[3]), t_s, up)
    loose = log_p(model_of(t_s, sigma_m, LOOSE_MPS, LOOSE_MPS2), t_s, up)
    if level_known:
        as_cruising = model_of(t_s, sigma_m, CRUISE_SIGMA_MPS, BIRD[1])
        as_wheeling = model_of(t_s, sigma_m, BIRD[0], BIRD[1])
        as_balloon = model_of(t_s, sigma_m, min(BALLOON[0], sway_mps), BALLOON[1])
        as_loose = model_of(t_s, sigma_m, LOOSE_MPS, LOOSE_MPS2)
        cruising, wheeling = np.empty(YAWS), 0.0
        for k in range(YAWS):
            c, s = math.cos(math.tau * k / YAWS), math.sin(math.tau * k / YAWS)
            cruising[k] = log_p(as_cruising, t_s, x[:, 0] - CRUISE_MPS * c * t_s)
            cruising[k] += log_p(as_cruising, t_s, x[:, 1] - CRUISE_MPS * s * t_s)
        for axis in range(2):
            e = x[:, axis].copy()
            still += log_p(as_still, t_s, e)
            long += log_p(as_long, t_s, e)
            sliding += log_p(as_sliding, t_s, e)
            followed += log_p(as_followed, t_s, e)
            wheeling += log_p(as_wheeling, t_s, e)
            balloon += log_p(as_balloon, t_s, e)
            loose += log_p(as_loose, t_s, e)
        cruise = math.log(CRUISING) + _log_mean(cruising)
        wheeling += math.log(1.0 - CRUISING)
        bird += _log_sum(cruise, wheeling)
    balloon = _log_sum(math.log(1.0 - LOOSE) + balloon, math.log(LOOSE) + loose)
    over_still = drone - _log_mean(np.array([still, long, sliding]))
    off2 /= coordinates * len(t_s)
    return over_still, drone - bird, drone - balloon, min(over_still, drone - followed), off2


@compiled
def _as_drone(
    t_s: Array64,
    x_m: Array64,
    odometry_m: Array64,
    sigma_m: float,
    level_known: bool,
    error: tuple[float, float, float, float],
) -> tuple[float, float]:
    """ln of the likelihood of a path as that of the odometry, and its squared residual at the best yaw."""
    upright, up = model_of(t_s, sigma_m, error[1], error[3]), x_m[:, 2] - odometry_m[:, 2]
    drone, off2 = log_p(upright, t_s, up), misfit(upright, t_s, up)
    if level_known:
        as_drone = model_of(t_s, sigma_m, error[0], error[2])
        turned, level2 = np.empty(YAWS), math.inf
        for k in range(YAWS):
            c, s = math.cos(math.tau * k / YAWS), math.sin(math.tau * k / YAWS)
            ex = x_m[:, 0] - c * odometry_m[:, 0] + s * odometry_m[:, 1]
            ey = x_m[:, 1] - s * odometry_m[:, 0] - c * odometry_m[:, 1]
            turned[k] = log_p(as_drone, t_s, ex) + log_p(as_drone, t_s, ey)
            level2 = min(level2, misfit(as_drone, t_s, ex) + misfit(as_drone, t_s, ey))
        drone += _log_mean(turned)
        off2 += level2
    return drone, off2


@compiled
def _log_sum(a: float, b: float) -> float:
    return max(a, b) + math.log1p(math.exp(-abs(a - b)))


@compiled
def _log_mean(values: Array64) -> float:
    top = values.max()
    return top + math.log(np.exp(values - top).mean())
