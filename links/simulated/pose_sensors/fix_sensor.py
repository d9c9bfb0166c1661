"""A sensor of the drone's position instead of LiDAR, servo, detection and track: fast flights in closed loop.

Its fixes have the rate, delay and errors that LikelihoodTrack's fixes have in simulation (10 Hz, 11 ms; a 0.5 m drone,
11 m away: 0.03 m per axis; varying errors with a correlation of 0.7 from fix to fix and 0.7 of the variance that the
track reports): errors grow with the range.

    fix = true position + constant bias + first-order Gauss-Markov error

Records on /simulated/fixes, JSON; `links.simulated.SimulatedFixes` reads them. What they cannot show: false
detections, a lost track, and how telemetry affects detection and track.

Source: ours; the numbers are those of grd's track in configs/scenarios/flight/hover.yaml.
"""

from __future__ import annotations

import json
import math

import numpy as np
from pydantic import Field

from flow.link import Record
from flow.stage import StrictModel
from links.simulated.pose_sensors.pose_source import FIX_TOPIC
from links.simulated.world.path import TimeSpan
from links.simulated.world.scene import Truth

NS = 1_000_000_000
TICKS_PER_FIX = 5  # the host's clock ticks at 50 Hz


class FixSensorSettings(StrictModel):
    """Rate, delay and errors of the fixes."""

    first_s: float = Field(default=2.0, ge=0)  # the search finds the drone
    rate_hz: float = Field(default=10.0, ge=1, le=50)
    latency_s: float = Field(default=0.011, ge=0, le=0.5)
    sigma_per_m: float = Field(default=0.0025, ge=0)  # of the varying error, per axis and metre of range
    bias_per_m: float = Field(default=0.002, ge=0)  # one sigma of the constant error
    correlation_s: float = Field(default=0.3, gt=0)
    variance_share: float = Field(default=0.7, gt=0, le=4)  # true variance of the varying error over the reported one
    velocity_mps: float = Field(default=0.1, ge=0)  # one sigma of the reported velocity
    detection: float = Field(default=0.97, gt=0, le=1)  # probability of each fix
    of_other_s: TimeSpan | None = None  # the fixes are those of the first other drone


class FixSensor:
    """Fixes in order of time, with the clock ticks between them."""

    def __init__(
        self, settings: FixSensorSettings, truth: Truth, gaps_s: tuple[tuple[float, float], ...], seed: int
    ) -> None:
        self._settings, self._truth, self._gaps_s = settings, truth, gaps_s
        self._rng = np.random.default_rng([seed, 60])
        self._bias = self._rng.standard_normal(3)
        self._error = self._rng.standard_normal(3)
        self._count = 0

    def records(self, until_ns: int) -> list[Record]:
        """Records of measurements before `until_ns` that were not returned yet."""
        s = self._settings
        period_s = 1 / s.rate_hz / TICKS_PER_FIX
        found: list[Record] = []
        while self._truth.start_ns + round(self._count * period_s * NS) < until_ns:
            stamp_ns = self._truth.start_ns + round(self._count * period_s * NS)
            time_s = self._count * period_s
            content: dict[str, object] = {"tick": True}
            if self._count % TICKS_PER_FIX == 0 and time_s >= s.first_s:
                content = self._fix(stamp_ns, time_s)
            arrival_ns = stamp_ns + round(s.latency_s * NS)
            found.append(Record(FIX_TOPIC, arrival_ns, stamp_ns, json.dumps(content).encode()))
            self._count += 1
        return found

    def _fix(self, stamp_ns: int, time_s: float) -> dict[str, object]:
        s, rng = self._settings, self._rng
        keep = math.exp(-1 / s.rate_hz / s.correlation_s)
        self._error = keep * self._error + math.sqrt(1 - keep * keep) * rng.standard_normal(3)
        velocity_error = s.velocity_mps * rng.standard_normal(3)
        seen = rng.random() < s.detection
        if not seen or any(begin <= time_s < end for begin, end in self._gaps_s):
            return {"coasting": True}
        stamps = np.array([stamp_ns - NS // 50, stamp_ns])
        R, t = self._truth.T_world_vehicle(stamps)
        number = 2 if s.of_other_s is not None and s.of_other_s[0] <= time_s < s.of_other_s[1] else 1
        relative = np.einsum("nji,nj->ni", R, self._truth.T_world_drone(stamps, number)[1] - t)
        range_m = float(np.linalg.norm(relative[1]))
        xyz = relative[1] + range_m * (s.bias_per_m * self._bias + s.sigma_per_m * self._error)
        velocity = (relative[1] - relative[0]) * 50 + velocity_error
        return {
            "xyz_m": np.round(xyz, 5).tolist(),
            "velocity_mps": np.round(velocity, 4).tolist(),
            "sigma_m": round(range_m * s.sigma_per_m / math.sqrt(s.variance_share), 6),
            "bias_sigma_m": round(range_m * s.bias_per_m, 6),
        }
