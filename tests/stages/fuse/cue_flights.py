"""Cues of a made flight: GNSS differences, ranges and heights with slow biases, and wrong ones.

Each function returns a fault of `fly`: it adds messages to the inputs of the flight.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stages.cues.evidence import measure
from stages.geometry.frames import rotation_z
from stages.messages import CueKind, DroneCue
from tests.stages.fuse.fuse_inputs import Event, Fault
from tests.stages.fuse.imu_flights import ImuFlight, gauss_markov, ns

Position = Callable[[float], np.ndarray]  # of the object that the cue measures, map
ANCHOR_M = np.array([0.3, -0.2, 0.4])
STEP_S = 0.05


@dataclass(frozen=True)
class GnssErrors:
    """True errors of the difference of two receivers. Walk and noise: bench_gnss_drift.py, times sqrt(2)."""

    bias_m: float = 1.8  # an axis, horizontal; up 1.5 times that
    walk: float = 0.127  # [m/sqrt(s)]
    noise_m: float = 0.03
    latency_s: float = 0.0  # true minus assumed
    yaw_deg: float = 3.0  # one sigma, of the north
    jumps_m: float = 0.0  # one sigma of reflections that begin and end, each 5 s on average


def gnss(
    flight: ImuFlight, errors: GnssErrors | None = None, of: Position | None = None, offset_m=(0.0, 0.0, 0.0)
) -> Fault:
    """Positions 5 times a second; `of`: another object, `offset_m`: another error."""
    e = errors or GnssErrors()
    rng = np.random.default_rng([flight.seed, 31])
    count = round((flight.until_s + 2) / STEP_S)
    walk = np.cumsum(e.walk * math.sqrt(STEP_S) * rng.standard_normal((count, 3)), axis=0)
    bias = np.array([1.0, 1.0, 1.5]) * e.bias_m * rng.standard_normal(3) + walk
    jumps = np.cumsum(rng.random(count) < STEP_S / 5.0)
    bias = (
        bias + (e.jumps_m * rng.standard_normal((jumps[-1] + 1, 3)) * (rng.random(jumps[-1] + 1) < 0.5)[:, None])[jumps]
    )
    turn = rotation_z(math.radians(e.yaw_deg) * rng.standard_normal())

    def value(t: float) -> np.ndarray:
        offset = (of or flight_position(flight))(t - e.latency_s) - flight.vehicle(t)[1]
        return turn @ offset + bias[round(t / STEP_S)] + e.noise_m * rng.standard_normal(3) + offset_m

    noise_m2 = np.diag([2 * 0.1**2, 2 * 0.1**2, 2 * 0.15**2])
    bias_m2 = np.diag([2 * 2.5**2, 2 * 2.5**2, 2 * 4.0**2])
    times = np.arange(1.0, flight.until_s, 0.2)
    return _cues(times, 0.25, "gnss", CueKind.POSITION, value, noise_m2, bias_m2, 400.0, math.radians(3.0))


def uwb(flight: ImuFlight, of: Position | None = None, offset_m: float = 0.0, reflected: float = 0.05) -> Fault:
    """Ranges 10 times a second from an anchor on the vehicle, a share of them reflected."""
    rng = np.random.default_rng([flight.seed, 32])
    bias = 0.1 * rng.standard_normal() + offset_m

    def value(t: float) -> np.ndarray:
        R, x = flight.vehicle(t)
        range_m, _ = measure(CueKind.RANGE, (of or flight_position(flight))(t) - x, R @ ANCHOR_M)
        longer = rng.exponential(2.0) if rng.random() < reflected else 0.0
        return range_m + bias + 0.1 * rng.standard_normal() + longer

    def reference(t: float) -> np.ndarray:
        return flight.vehicle(t)[0] @ ANCHOR_M

    times = np.arange(1.03, flight.until_s, 0.1)
    one = np.eye(1)
    return _cues(times, 0.05, "uwb", CueKind.RANGE, value, 0.1**2 * one, 0.3**2 * one, 120.0, 0.0, reference)


def altitude(flight: ImuFlight, offset_m: float = 0.0) -> Fault:
    """Heights 5 times a second."""
    rng = np.random.default_rng([flight.seed, 33])
    drift = gauss_markov(rng, 1.0, 120.0, STEP_S, round((flight.until_s + 2) / STEP_S), 1)

    def value(t: float) -> np.ndarray:
        up_m = flight.truth(t)[1][2:] - flight.vehicle(t)[1][2:]
        return up_m + drift[round(t / STEP_S)] + 0.1 * rng.standard_normal() + offset_m

    one = np.eye(1)
    return _cues(
        np.arange(1.07, flight.until_s, 0.2), 0.05, "altitude", CueKind.HEIGHT, value, 0.3**2 * one, 1.5**2 * one, 120.0, 0.0
    )  # fmt: skip


def together(*faults: Fault) -> Fault:
    """All of them."""

    def fault(events: list[Event]) -> list[Event]:
        for one in faults:
            events = list(one(events))
        return events

    return fault


def flight_position(flight: ImuFlight) -> Position:
    """Of the drone itself."""
    return lambda t: flight.truth(t)[1]


def another_drone(flight: ImuFlight, seed: int = 500) -> Position:
    """Of a drone that flies another path 10 m away."""
    other = ImuFlight(kind="manoeuvre", seed=flight.seed + seed, until_s=flight.until_s, range_m=flight.range_m)
    return lambda t: other.truth(t)[1] + [10.0, 0.0, 0.0]


def hovering(flight: ImuFlight) -> Position:
    """Of a drone that hovers where the flight began."""
    start = flight.truth(0.0)[1]
    return lambda t: start


def formation_until(flight: ImuFlight, until_s: float, leaves_mps: float = 1.0) -> Position:
    """Of a drone 5 m from this one, which leaves it with a constant velocity from a time on."""

    def position(t: float) -> np.ndarray:
        return flight.truth(t)[1] + [5.0, max(t - until_s, 0.0) * leaves_mps, 0.0]

    return position


def _cues(times, delay_s, source, kind, value, noise_m2, bias_m2, bias_time_s, yaw_sigma_rad, reference=None) -> Fault:
    def fault(events: list[Event]) -> list[Event]:
        made: list[Event] = []
        for t in times:
            cue = DroneCue(
                stamp_ns=ns(t),
                source=source,
                kind=kind,
                value_m=np.asarray(value(t), dtype=np.float64),
                covariance_m2=noise_m2,
                bias_covariance_m2=bias_m2,
                bias_time_s=bias_time_s,
                yaw_sigma_rad=yaw_sigma_rad,
                reference_map_m=np.zeros(3) if reference is None else reference(t),
            )
            made.append((ns(t + delay_s), "cue", cue))
        return sorted([*events, *made], key=lambda e: e[0])

    return fault
