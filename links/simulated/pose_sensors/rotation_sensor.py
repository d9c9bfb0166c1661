"""A sensor of the rotation between vehicle and drone instead of cameras and vanishing points: for fast flights.

    R = R_true Rz(k 90 deg) exp(e),   e = constant + first-order Gauss-Markov error, drone axes

k, the branch of the 90 deg ambiguity, is unknown to the graph; it is drawn at the start and again after each wrong
match. During a wrong match, which begins at random and lasts as long as the errors are correlated, the yaw is off by
any angle. The stated sigma is that of e.

Records on /simulated/rotations, JSON; `links.simulated.SimulatedRotations` reads them. What they cannot show: how the
images' content affects rate and errors.

Source: ours; the numbers are those of JointAlign in configs/scenarios/flight/matrix/hover_cameras.yaml (120 images).
"""

from __future__ import annotations

import json
import math

import numpy as np
from pydantic import Field

from flow.link import Record
from flow.stage import StrictModel
from links.simulated.pose_sensors.pose_source import ROTATION_TOPIC
from links.simulated.world.motion import rotations_from_vectors
from links.simulated.world.scene import Truth
from stages.geometry.frames import Array64, rotation_z

NS = 1_000_000_000
HALF_PI = 0.5 * math.pi


class RotationSensorSettings(StrictModel):
    """Rate, delay and errors of the rotations."""

    rate_hz: float = Field(default=5.0, ge=0.1, le=50)
    latency_s: float = Field(default=0.13, ge=0, le=0.5)
    detection: float = Field(default=0.5, gt=0, le=1)  # probability of each rotation
    constant_deg: float = Field(default=0.3, ge=0, le=10)  # one sigma per axis
    varying_deg: float = Field(default=0.2, ge=0, le=10)
    correlation_s: float = Field(default=1.0, gt=0)
    wrong_per_s: float = Field(default=0.02, ge=0, le=1)  # rate at which wrong matches begin


class RotationSensor:
    """Rotations in order of time."""

    def __init__(self, settings: RotationSensorSettings, truth: Truth, seed: int) -> None:
        self._settings, self._truth = settings, truth
        self._rng = np.random.default_rng([seed, 61])
        self._constant = self._rng.standard_normal(3)
        self._varying = self._rng.standard_normal(3)
        self._branch = int(self._rng.integers(4))
        self._wrong_rad, self._wrong_until_s = 0.0, 0.0
        self._count = 0

    def records(self, until_ns: int) -> list[Record]:
        """Records of measurements before `until_ns` that were not returned yet."""
        s = self._settings
        found: list[Record] = []
        while (stamp_ns := self._truth.start_ns + round(self._count / s.rate_hz * NS)) < until_ns:
            R = self._measure(stamp_ns, self._count / s.rate_hz)
            self._count += 1
            if R is not None:
                sigma_rad = math.radians(math.hypot(s.constant_deg, s.varying_deg))
                content = {"R": np.round(R, 9).tolist(), "sigma_rad": round(sigma_rad, 9)}
                arrival_ns = stamp_ns + round(s.latency_s * NS)
                found.append(Record(ROTATION_TOPIC, arrival_ns, stamp_ns, json.dumps(content).encode()))
        return found

    def _measure(self, stamp_ns: int, time_s: float) -> Array64 | None:
        """R_vehicle_drone in some branch; None: not detected."""
        s, rng = self._settings, self._rng
        keep = math.exp(-1 / s.rate_hz / s.correlation_s)
        self._varying = keep * self._varying + math.sqrt(1 - keep * keep) * rng.standard_normal(3)
        if time_s >= self._wrong_until_s and rng.random() < s.wrong_per_s / s.rate_hz:
            self._wrong_until_s, self._wrong_rad = time_s + s.correlation_s, rng.uniform(0.0, 2 * math.pi)
            self._branch = int(rng.integers(4))
        if rng.random() >= s.detection:
            return None
        at = np.array([stamp_ns])
        R_vehicle, R_drone = self._truth.T_world_vehicle(at)[0][0], self._truth.T_world_drone(at)[0][0]
        error = np.radians(s.constant_deg * self._constant + s.varying_deg * self._varying)
        wrong_rad = self._wrong_rad if time_s < self._wrong_until_s else 0.0
        turn = rotation_z(self._branch * HALF_PI + wrong_rad)
        return turn @ R_vehicle.T @ R_drone @ rotations_from_vectors(error[None])[0]
