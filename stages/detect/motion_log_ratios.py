"""Log ratios of a candidate's path: motion by the drone's odometry against motion of other objects.

The autopilot's odometry is in its own frame: z up, unknown yaw, slow drift. A candidate that is the drone moves by that
odometry, turned by an unknown yaw psi:

    drone      x_i = c + Rz(psi) d_i + u t_i + noise           u: drift of both odometries, decimetres a second
    static     x_i = c + u t_i + noise                         a lamp; or scattered, or observed farther and farther
                                                               along something long (a wire, at the scan's speed)
    flier      x_i = c + v t_i + a t_i^2 / 2 + noise           v, a of a bird, or of a balloon, on a string or loose

Each model is a Gaussian over the path's n points, with c and psi integrated out. The evidence is the log ratio of two
marginal likelihoods. Speeds and heights alone separate the drone from a bird in a few scan passes, whatever psi is. The
odometry of a hovering drone gives no evidence against a lamp.

The IMU alone gives d_i up to an unknown velocity, over seconds: u is as wide as a drone's speed, and only the
acceleration of the path is compared. It is evidence when the autopilot's estimate may contain our own pose.

Source: ours; DESIGN, The graph: `odometry` ("autopilot odometry when present").
"""

from __future__ import annotations

from bisect import bisect_left
from typing import NamedTuple

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.detect.motion_log_ratios import BY_IMU, BY_ODOMETRY, weigh
from stages.odometry.drone.telemetry import KEPT_NS, DroneTelemetry

MAX_POINTS = 14
SILENT_NS = 2_000_000_000  # without telemetry for longer, a path may have switched to another object
IMU_NS = 4_000_000_000  # longest path compared with the IMU: its accelerometer's error is constant for so long
DENIED = -3.0  # [nats] below it the path contradicts the odometry
MAX_MISFIT = 4.0  # beyond it no model fits, and nothing favours the drone; drones reach 1.3


class MotionLogRatios(NamedTuple):
    """Log ratios of a path's likelihood as the drone's over another object's, with psi unknown."""

    over_static: float
    over_bird: float
    over_balloon: float
    over_wire: float  # over a wire, observed at positions that move along it at any speed
    misfit: float  # mean squared normalised residual from the odometry at the best yaw
    displacement_m: float  # largest odometry displacement since the first point; vertical if only heights are compared

    @property
    def denied(self) -> bool:
        """Whether the path significantly contradicts the drone's odometry."""
        return min(self.over_static, self.over_bird, self.over_balloon) < DENIED


def compare_motion(
    telemetry: DroneTelemetry,
    path_ns: list[int],
    path_m: list[Array64],
    sigma_m: float,
    level_known: bool,
    by_imu: bool = False,
) -> MotionLogRatios | None:
    """Compare a path (n, 3) in a static level frame with the drone's odometry; None: no telemetry to compare.

    Observations without telemetry are left out. Without recent telemetry there is no comparison.

    `level_known` False: the vehicle's motion is unknown, so only heights are compared. sigma_m: of an observation.
    by_imu: the odometry integrates the IMU, and its velocity is unknown.
    """
    span_ns = telemetry.span_ns
    if span_ns is None or len(path_ns) < 2 or path_ns[-1] > span_ns[1] + SILENT_NS:
        return None
    first = bisect_left(path_ns, max(path_ns[-1] - (IMU_NS if by_imu else KEPT_NS // 2), span_ns[0]))
    if len(path_ns) - first < 2:
        return None
    rows = list(range(first, len(path_ns)))
    if len(rows) > MAX_POINTS:
        last = len(rows) - 1
        rows = [rows[round(i * last / (MAX_POINTS - 1))] for i in range(MAX_POINTS)]
    states = {k: telemetry.state(path_ns[k]) for k in rows}
    positions = {k: state[0] for k, state in states.items() if state is not None}
    if len(positions) < 2:
        return None
    rows, odometry_m = list(positions), np.array(list(positions.values()))
    t = (np.array([path_ns[k] for k in rows]) - path_ns[rows[-1]]) * 1e-9
    if by_imu:
        if t[0] == t[-1]:
            return None
        moved_m = odometry_m[-1] - odometry_m[0]  # by its mean velocity, which is not known
        odometry_m -= np.outer((t - t[0]) / (t[-1] - t[0]), moved_m)
    compared_m = odometry_m if level_known else odometry_m[:, 2:]
    displacement_m = float(np.sqrt(((compared_m - compared_m[0]) ** 2).sum(axis=1).max()))
    x_m = np.array([path_m[k] for k in rows])
    error = BY_IMU if by_imu else BY_ODOMETRY
    log_ratios = MotionLogRatios(*weigh(t, x_m, odometry_m, sigma_m, level_known, error), displacement_m)
    if log_ratios.misfit <= MAX_MISFIT:
        return log_ratios
    static, bird, balloon, wire = (min(ratio, 0.0) for ratio in log_ratios[:4])
    return MotionLogRatios(static, bird, balloon, wire, log_ratios.misfit, displacement_m)
