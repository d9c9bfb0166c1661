"""A real flight in a dataflash log, and its attitude and path by all of its GPS and IMU data.

Pixhawk, ArduCopter 3.1.3, 332 s: two IMUs at 50 Hz, attitude and position of the autopilot (DCM and compass; it has no
EKF) at 10 Hz, GPS velocities at 5 Hz. A batch over the whole flight gives the reference: pose, velocity and biases at
each GPS velocity, preintegrated IMU between them. It uses no compass. GPS velocities are late; the latency is the one
with which the batch fits them best.

Source: ../shared/data/mavlink/copter_dataflash_imu50.bin (no licence stated: read there, never copied).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from pymavlink import DFReader
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from links.mavlink.ned_frd import R_odom_drone_from_rpy, flip_yz
from stages.kernels.geometry.so3 import exp_rotation

LOG = Path(__file__).resolve().parents[5] / "shared" / "data" / "mavlink" / "copter_dataflash_imu50.bin"
G = 9.80665
FLYING_S = 14.0, 323.0  # since the first IMU sample: take-off and landing left out
GPS_MPS, GPS_M = 0.15, 5.0  # one sigma, one axis, of GPS velocities and of their integral against drift
SAMPLE_MPS2, SAMPLE_RADPS = 1.0, 0.1  # noise of an IMU sample in flight: its vibration
SEARCHED_S = 0.2, 0.3, 0.4  # latencies of GPS


@dataclass
class PixhawkLog:
    """Arrays by source; times in seconds since the first IMU sample, axes z up (odom: x north, y west)."""

    imu: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]  # time, rate [rad/s], specific force [m/s^2], drone axes
    attitude: tuple[np.ndarray, np.ndarray]  # time, R_odom_drone by DCM and compass
    position: tuple[np.ndarray, np.ndarray, np.ndarray]  # time, position, velocity of the autopilot
    gps: tuple[np.ndarray, np.ndarray]  # time, velocity; not corrected for its latency


@functools.cache
def pixhawk_log() -> PixhawkLog:
    """The log."""
    rows: dict[str, list[dict[str, float]]] = {}
    reader: Any = DFReader.DFReader_binary(str(LOG))
    while (message := reader.recv_msg()) is not None:
        rows.setdefault(message.get_type(), []).append(message.to_dict())

    def columns(kind: str, *names: str) -> np.ndarray:
        return np.array([[row[name] for name in names] for row in rows[kind]], dtype=float)

    first_ms = rows["IMU"][0]["TimeMS"]
    imu = {}
    for kind in ("IMU", "IMU2"):
        at = columns(kind, "TimeMS", "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ")
        imu[kind] = 1e-3 * (at[:, 0] - first_ms), flip_yz(at[:, 1:4]), flip_yz(at[:, 4:7])
    at = columns("ATT", "TimeMS", "Roll", "Pitch", "Yaw")
    R = np.array([R_odom_drone_from_rpy(*np.radians(rpy)) for rpy in at[:, 1:]])
    attitude = 1e-3 * (at[:, 0] - first_ms), R
    own, heights = columns("NTUN", "TimeMS", "PosX", "PosY", "VelX", "VelY"), columns("CTUN", "TimeMS", "Alt", "CRt")
    height_m, climb_cmps = (np.interp(own[:, 0], heights[:, 0], heights[:, k]) for k in (1, 2))
    xyz = np.column_stack([0.01 * own[:, 1], -0.01 * own[:, 2], height_m])
    v = 0.01 * np.column_stack([own[:, 3], -own[:, 4], climb_cmps])
    gps = columns("GPS", "T", "TimeMS", "Spd", "GCrs", "VZ")[4:]  # the first four are repeated
    clock = np.polyfit(gps[:, 1] - gps[0, 1], gps[:, 0], 1)  # of GPS to log: jitter of logging averages out
    course = np.radians(gps[:, 3])
    velocity = flip_yz(np.column_stack([gps[:, 2] * np.cos(course), gps[:, 2] * np.sin(course), gps[:, 4]]))
    gps_s = 1e-3 * (np.polyval(clock, gps[:, 1] - gps[0, 1]) - first_ms)
    return PixhawkLog(imu, attitude, (1e-3 * (own[:, 0] - first_ms), xyz, v), (gps_s, velocity))


@dataclass
class Reference:
    """Attitude at each IMU sample and the path, by one IMU and GPS."""

    time_s: np.ndarray
    R_odom_drone: np.ndarray
    path: Any  # spline of the position by GPS and IMU
    gps_path: Any  # spline of the position by GPS alone
    misfit: float  # of the batch


@functools.cache
def latency_s() -> float:
    """Latency of GPS velocities: the vertex of a parabola through the misfits, mean of both IMUs."""
    found = []
    for kind in ("IMU", "IMU2"):
        a, b, c = (reference(kind, latency).misfit for latency in SEARCHED_S)
        found.append(SEARCHED_S[1] - 0.5 * (SEARCHED_S[1] - SEARCHED_S[0]) * (c - a) / (a - 2 * b + c))
    return float(np.mean(found))


@functools.cache
def reference(kind: str, latency: float | None = None) -> Reference:
    """The batch with one IMU; `latency` None: the one that fits best."""
    log = pixhawk_log()
    stamp, rate, force = log.imu[kind]
    at = log.gps[0] - (latency_s() if latency is None else latency)
    flying = (at > FLYING_S[0]) & (at < FLYING_S[1])
    at, velocity = at[flying], log.gps[1][flying]
    gps_path = CubicSpline(at, velocity).antiderivative()
    values, misfit = _batch(at, velocity, gps_path(at), stamp, rate, force)
    poses = [values.atPose3(X(k)) for k in range(len(at))]
    xyz = np.array([pose.translation() for pose in poses])
    path = CubicHermiteSpline(at, xyz, np.array([values.atVector(V(k)) for k in range(len(at))]))
    inside = np.flatnonzero((stamp > at[0]) & (stamp < at[-1]))
    R = np.empty((len(inside), 3, 3))
    for n, i in enumerate(inside):
        k = int(np.searchsorted(at, stamp[i], side="right")) - 1
        since = stamp[i] - at[k] if n == 0 or stamp[i - 1] < at[k] else stamp[i] - stamp[i - 1]
        start = poses[k].rotation().matrix() if n == 0 or stamp[i - 1] < at[k] else R[n - 1]
        R[n] = start @ exp_rotation(since * (rate[i] - values.atConstantBias(B(k)).gyroscope()))
    return Reference(stamp[inside], R, path, gps_path, misfit)


def _batch(
    at: np.ndarray, velocity: np.ndarray, xyz: np.ndarray, stamp: np.ndarray, rate: np.ndarray, force: np.ndarray
) -> tuple[Any, float]:
    step = float(np.median(np.diff(stamp)))
    params = gtsam.PreintegrationCombinedParams(np.array([0.0, 0.0, -G]))
    params.setAccelerometerCovariance(SAMPLE_MPS2**2 * step * np.eye(3))
    params.setGyroscopeCovariance(SAMPLE_RADPS**2 * step * np.eye(3))
    params.setIntegrationCovariance(1e-8 * np.eye(3))
    params.setBiasAccCovariance(0.005**2 * np.eye(3))
    params.setBiasOmegaCovariance(1e-4**2 * np.eye(3))
    huber = gtsam.noiseModel.mEstimator.Huber.Create(1.345)
    by_gps = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Isotropic.Sigma(3, GPS_MPS))
    near, none = gtsam.noiseModel.Isotropic.Sigma(3, GPS_M), gtsam.imuBias.ConstantBias()
    attitude_s, R_odom_drone = pixhawk_log().attitude
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(
        gtsam.PriorFactorConstantBias(B(0), none, gtsam.noiseModel.Diagonal.Sigmas(np.array([0.3] * 3 + [0.02] * 3)))
    )
    for k, t in enumerate(at):
        first = R_odom_drone[int(np.argmin(np.abs(attitude_s - t)))]
        values.insert(X(k), gtsam.Pose3(gtsam.Rot3(first), xyz[k]))
        values.insert(V(k), velocity[k])
        values.insert(B(k), none)
        graph.add(gtsam.PriorFactorVector(V(k), velocity[k], by_gps))
        graph.add(gtsam.GPSFactor(X(k), xyz[k], near))
        if k == 0:
            continue
        motion: Any = gtsam.PreintegratedCombinedMeasurements(params, none)
        inside = stamp[(stamp > at[k - 1] + 1e-5) & (stamp < t - 1e-5)]
        cuts = np.concatenate([[at[k - 1]], inside, [t]])
        middle, near_by = 0.5 * (cuts[:-1] + cuts[1:]), slice(*np.searchsorted(stamp, [at[k - 1] - 0.1, t + 0.1]))
        f, w = (
            np.column_stack([np.interp(middle, stamp[near_by], part[near_by, axis]) for axis in range(3)])
            for part in (force, rate)
        )
        for n, step_s in enumerate(np.diff(cuts)):
            motion.integrateMeasurement(f[n], w[n], step_s)
        graph.add(gtsam.CombinedImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), B(k), motion))
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values)
    return optimizer.optimize(), optimizer.error()


def yaw_rad(R: np.ndarray) -> np.ndarray:
    """Rotation about the vertical of rotations (n, 3, 3), their tilt removed."""
    return np.arctan2(R[..., 1, 0] - R[..., 0, 1], R[..., 0, 0] + R[..., 1, 1])


def degrees_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Difference of two angles [rad] in degrees, within 180."""
    return np.degrees(np.remainder(a - b + math.pi, 2 * math.pi) - math.pi)
