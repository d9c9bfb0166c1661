"""Settings and errors of the simulated cues.

    GNSS        p + slow bias (first-order Gauss-Markov) + white noise, measured `latency_s` before its stamp
    ranging     distance + constant bias + white noise; without line of sight a longer way (exponential)
    barometer   height + drift (Gauss-Markov) + white noise

The biases of two receivers are independent. Real receivers close together share a part of theirs (ionosphere, orbits):
`bias_m` is the rest, so that the difference of two positions is as far off as one receiver of a logged Pixhawk flight
was: 2.9 m horizontally (median of a Rayleigh distribution with 2.46 m an axis), nearly constant over 188 s. Walk and
noise of another log: 0.09 m/sqrt(s) an axis, which at 1.75 m is a correlation time of 2 (1.75 / 0.09)^2 = 756 s, and
0.02 m (tests/benchmarks/accuracy/bench_gnss_drift.py).

Source: ours; non-line-of-sight
ranging: Marano et al., IEEE JSAC 28 (2010), positive errors of up to several metres.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from flow.stage import StrictModel
from links.simulated.world.motion import gauss_markov, interpolate
from stages.cues.geodesy import Geographic, moved
from stages.geometry.frames import Array64, rotation_z

STEP_S = 0.05
Vector3 = tuple[float, float, float]
ORIGIN = Geographic(float(np.radians(35.6581)), float(np.radians(139.7017)), 40.0)  # of the simulated world


class ReceiverSettings(StrictModel):
    """A GNSS receiver, one sigma an axis."""

    rate_hz: float = Field(default=5.0, ge=0.2, le=50)
    latency_s: float = Field(default=0.2, ge=0, le=2)
    bias_m: float = Field(default=1.75, ge=0, le=100)
    bias_up_m: float = Field(default=2.6, ge=0, le=100)
    bias_time_s: float = Field(default=756.0, gt=1)
    noise_m: float = Field(default=0.02, ge=0, le=100)
    noise_up_m: float = Field(default=0.03, ge=0, le=100)
    offset_world_m: Vector3 = (0.0, 0.0, 0.0)  # a wrong cue
    of_drone: int = Field(default=1, ge=1, le=10)  # another one's: a wrong cue
    heading_sigma_deg: float | None = Field(default=None, ge=0, le=45)  # constant error of a heading; None: no heading


class RangingSettings(StrictModel):
    """A pair of ranging radios."""

    rate_hz: float = Field(default=10.0, ge=0.2, le=100)
    latency_s: float = Field(default=0.02, ge=0, le=2)
    noise_m: float = Field(default=0.1, ge=0, le=100)
    bias_m: float = Field(default=0.1, ge=0, le=100)
    reflected_share: float = Field(default=0.05, ge=0, le=1)
    reflected_m: float = Field(default=2.0, ge=0, le=100)  # mean additional way
    offset_m: float = 0.0  # a wrong cue
    of_drone: int = Field(default=1, ge=1, le=10)


class BarometerSettings(StrictModel):
    """The drone's altitude by its autopilot's estimator, above home: the road at the vehicle's start."""

    drift_m: float = Field(default=1.0, ge=0, le=100)
    drift_time_s: float = Field(default=120.0, gt=1)
    noise_m: float = Field(default=0.1, ge=0, le=100)
    offset_m: float = 0.0  # a wrong cue


class CueSettings(StrictModel):
    """The cues of a scenario; None: not present. The drone's receiver and barometer need an autopilot."""

    drone: ReceiverSettings | None = None  # GPS_RAW_INT
    barometer: BarometerSettings | None = None  # GLOBAL_POSITION_INT, at the receiver's rate
    vehicle: ReceiverSettings | None = None
    ranging: RangingSettings | None = None


class SlowError:
    """A Gauss-Markov error (d,), stationary from the start, with white noise."""

    def __init__(
        self, sigma: Array64, time_s: float, noise: Array64, duration_s: float, rng: np.random.Generator
    ) -> None:
        white = rng.standard_normal((round(duration_s / STEP_S) + 2, len(sigma)))
        self._bias, self._noise, self._rng = gauss_markov(white, sigma, time_s, STEP_S), noise, rng

    def at(self, time_s: Array64) -> Array64:
        """Errors (n, d) at times (n,)."""
        noise = self._rng.standard_normal((len(time_s), len(self._noise))) * self._noise
        return interpolate(self._bias, STEP_S, time_s) + noise


def receiver_error(s: ReceiverSettings, duration_s: float, rng: np.random.Generator) -> SlowError:
    """Error (3,) of a receiver, world axes."""
    sigma, noise = np.array([s.bias_m, s.bias_m, s.bias_up_m]), np.array([s.noise_m, s.noise_m, s.noise_up_m])
    return SlowError(sigma, s.bias_time_s, noise, duration_s, rng)


def geographic(xyz_world_m: Array64, yaw_enu_world_rad: float) -> list[Geographic]:
    """Geographic positions of points (n, 3), world frame, whose x axis has this yaw from east."""
    return [moved(ORIGIN, rotation_z(yaw_enu_world_rad) @ xyz_m) for xyz_m in xyz_world_m]
