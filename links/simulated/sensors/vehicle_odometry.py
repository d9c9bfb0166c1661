"""The vehicle's own odometry, if it has one: T_map_vehicle with covariance, with drift, on /vehicle/odometry.

The pose is that of wheels and a gyro, in the frame of the vehicle at the start of the scenario. It is smooth, and its
error grows with the distance driven (see `drift`). Without `measures_tilt` the vehicle is reported level; the truth of
`T_map_vehicle` has its tilt.

Source: ours; recording format in recordings/README.md (/vehicle/odometry).
"""

from __future__ import annotations

import json

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flow.link import Record
from flow.stage import StrictModel
from links.simulated.kernels.motion import rotations_z
from links.simulated.sensors.drift import STEP_S, DriftingEstimate, DriftSettings
from links.simulated.world.path import Path, TimeSpan
from links.simulated.world.suspension import SuspendedPath
from stages.geometry.frames import Array64, quaternions_xyzw

NS = 1_000_000_000


class WheelDriftSettings(DriftSettings):
    """Drift of wheels and a gyro: less than that of the drone's position by its IMU."""

    scale: float = Field(default=0.005, ge=-0.5, le=0.5)
    yaw_rate_deg_per_min: float = Field(default=0.5, ge=-600, le=600)
    yaw_random_walk_deg_per_sqrt_s: float = Field(default=0.03, ge=0, le=10)
    position_random_walk_m_per_sqrt_s: float = Field(default=0.005, ge=0, le=10)
    velocity_mps: float = Field(default=0.0, ge=0, le=10)
    height_m: float = Field(default=0.05, ge=0, le=20)
    tilt_deg: float = Field(default=0.2, ge=0, le=20)


class VehicleOdometrySettings(StrictModel):
    """Rate, delay and drift of the vehicle's odometry."""

    rate_hz: float = Field(default=50.0, ge=1, le=400)
    latency_s: float = Field(default=0.004, ge=0, le=1)
    jitter_s: float = Field(default=0.001, ge=0, le=1)  # mean of an exponential distribution
    drift: WheelDriftSettings = WheelDriftSettings()
    measures_tilt: bool = True  # false: wheels alone
    frozen_s: TimeSpan | None = None  # new stamps with the pose of the first time


class VehicleOdometry:
    """Poses in order of measurement. Stamps are on the host's clock, without error."""

    def __init__(
        self, settings: VehicleOdometrySettings, path: Path | SuspendedPath, start_ns: int, duration_s: float, seed: int
    ) -> None:
        rng = np.random.default_rng([seed, 35])
        rotations, positions = path.level_poses(np.arange(0.0, duration_s + 2 * STEP_S, STEP_S))
        start_yaw_rad = float(np.arctan2(rotations[0, 1, 0], rotations[0, 0, 0]))
        estimate = DriftingEstimate(positions, -start_yaw_rad, settings.drift, rng)
        time_s = np.arange(0.0, duration_s, 1 / settings.rate_hz)
        self._stamp_ns = start_ns + np.rint(time_s * NS).astype(np.int64)
        delay_s = settings.latency_s + rng.exponential(1.0, len(time_s)) * settings.jitter_s
        self._arrival_ns = np.maximum.accumulate(self._stamp_ns + np.rint(delay_s * NS).astype(np.int64))
        self._path, self._estimate, self._start_ns = path, estimate, start_ns
        self._start = rotations[0], positions[0]
        if settings.frozen_s is not None:
            begin_s, end_s = settings.frozen_s
            time_s = np.where((time_s >= begin_s) & (time_s < end_s), begin_s, time_s)
        rotations, self._positions = self._poses(time_s)
        if not settings.measures_tilt:
            rotations = rotations_z(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))
        self._quaternions = quaternions_xyzw(rotations)
        self._covariances = estimate.covariances(time_s, rotations)
        self._sent = 0

    def records(self, until_ns: int) -> list[Record]:
        """Poses measured before `until_ns` that were not returned yet."""
        first, self._sent = self._sent, int(np.searchsorted(self._stamp_ns, until_ns))
        return [self._record(row) for row in range(first, self._sent)]

    def T_map_vehicle(self, stamp_ns: NDArray[np.int64]) -> tuple[Array64, Array64]:
        """Poses with the drift, but not frozen, at times (n,): rotations (n, 3, 3), positions (n, 3) [m]."""
        return self._poses(((stamp_ns - self._start_ns) * 1e-9).astype(np.float64))

    def drift_m(self, time_s: float) -> Array64:
        """Error of the position at a time, world axes, when the map's origin and axes are known (3,) [m]."""
        at = np.array([time_s])
        R, t = self._start
        return R @ self._poses(at)[1][0] + t - self._path.level_poses(at)[1][0]

    def _poses(self, time_s: Array64) -> tuple[Array64, Array64]:
        return self._estimate.rotations(time_s, self._path.level_poses(time_s)[0]), self._estimate.position_m(time_s)

    def _record(self, row: int) -> Record:
        pose = {
            "xyz_m": np.round(self._positions[row], 6).tolist(),
            "quaternion_xyzw": np.round(self._quaternions[row], 9).tolist(),
            "covariance": [float(f"{v:.6g}") for v in self._covariances[row].ravel()],
        }
        stamp_ns, arrival_ns = int(self._stamp_ns[row]), int(self._arrival_ns[row])
        return Record("/vehicle/odometry", arrival_ns=arrival_ns, stamp_ns=stamp_ns, data=json.dumps(pose).encode())
