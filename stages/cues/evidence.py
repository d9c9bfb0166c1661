"""Cues as evidence about a candidate of the detector, with a cap, and the state of each cue.

    nats = ln[ (1 - e) N(z; h(x) + b, S) / p_0 + e ],   at most the cue's cap;  at least ln e

z: measurement, h(x): the same of the candidate's position x at that time, b and S: bias and covariance of the cue and
of the candidate, p_0: density of z for an object anywhere within the search range R, 3 / (2 pi R^3) for a position and
1 / R for each scalar, e: probability that a cue is of another object. Of the newest three measurements of a cue the
median counts: a single reflection changes nothing. A cue that contradicts the candidate removes what the others add.

A wrong cue can be exactly where a lamp is: its position shows nothing. Only what a cue of `proven` adds may have a
candidate accepted: one that has agreed with the drone before (`bias.py`), or that moves as the candidate does. With d0
the change of the residual to a static object where the candidate is, d1 that to the candidate, S0 and S1 their
covariances:  d0' S0^-1 d0 > chi2(99.9 %),  d1' S1^-1 d1 < chi2(99 %),  and the sigma of S1 below half of d0.
Even then the caps hold: with the largest sum a candidate must reach 72 % by the LiDAR alone.

A cue that contradicts the drone found by the LiDAR alone is not used and is reported (`bias.py`).

Source: ours. `max_sum` follows from the 72 %; 0.3 was chosen so that a wrong cue delays the first fix by few seconds
(`docs/how-to/cues.md`, Measure); NEWEST, OLDEST_NS and the recovery are chosen, not measured. The mixture after Box,
Tiao, "A Bayesian approach to some outlier problems", Biometrika 55 (1968).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from statistics import median_low
from typing import NamedTuple

import numpy as np
from pydantic import Field

from flow.stage import StrictModel
from stages.cues.bias import CHI2_999, CueBias
from stages.geometry.frames import Array64
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import CueKind, CueState, DroneCue
from stages.sums import sum_in_order

NEWEST = 3  # measurements of a cue that count
OLDEST_NS = 1_500_000_000
CONTRADICTS_NATS = -1.0  # below: the cue contradicts the candidate
CHI2_99 = {1: 6.63, 2: 9.21, 3: 11.34}  # 99 % quantiles by degrees of freedom
MOVED_NS = 1_500_000_000  # longest span over which motions are compared
AFTER_PATH_NS = 100_000_000  # from the newest observation: it has moved little since


class CueWeights(StrictModel):
    """What cues may add to the log-odds of a candidate [nats]."""

    outlier_probability: float = Field(default=0.3, gt=0, lt=0.5)  # that a cue is of another object
    max_gnss: float = Field(default=2.0, ge=0, le=6)
    max_uwb: float = Field(default=2.0, ge=0, le=6)
    max_altitude: float = Field(default=1.0, ge=0, le=6)  # objects are not uniform over height
    max_sum: float = Field(default=2.0, ge=0, le=6)
    recovery_nats_per_s: float = Field(default=1.0, gt=0)  # how fast a candidate recovers from a contradiction

    def cap(self, source: str) -> float:
        """Cap of one cue."""
        return {"gnss": self.max_gnss, "uwb": self.max_uwb, "altitude": self.max_altitude}.get(source, 0.0)


class ObjectState(NamedTuple):
    """Position and velocity of an object in frame map, with equal variances on the three axes."""

    stamp_ns: int
    xyz_m: Array64
    velocity_mps: Array64
    p: tuple[float, float, float]  # variances: position, position-velocity, velocity


class CueNats(NamedTuple):
    """What all cues add to the log-odds that an object is the drone."""

    total: float
    of_proven: float  # without what the other cues than the proven ones add
    remark: str  # for people; empty: no cue


NO_CUE = CueNats(0.0, 0.0, "")


class ObjectPath(NamedTuple):
    """Where an object was observed, in frame map; at least once."""

    stamps_ns: Sequence[int]
    xyz_m: Sequence[Array64]
    sigma_m: float  # of each, an axis

    def at(self, stamp_ns: int) -> Array64:
        """Position (3,) at a time, between two observations or at the nearest."""
        xyz_m = np.array(self.xyz_m)
        since = np.array(self.stamps_ns, dtype=np.int64) - self.stamps_ns[0]
        return np.array([np.interp(stamp_ns - self.stamps_ns[0], since, xyz_m[:, k]) for k in range(3)])


@dataclass(slots=True, eq=False)
class _Cue:
    bias: CueBias
    newest: deque[DroneCue] = field(default_factory=lambda: deque[DroneCue](maxlen=NEWEST))
    before: deque[DroneCue] = field(default_factory=lambda: deque[DroneCue](maxlen=64))  # of MOVED_NS


class CueEvidence:
    """The newest measurements of all cues, and their biases."""

    def __init__(self, weights: CueWeights, search_m: float) -> None:
        """`search_m`: greatest range of candidates."""
        self._weights, self._search_m = weights, search_m
        self._cues: dict[str, _Cue] = {}

    @property
    def known(self) -> bool:
        """Whether there was any cue."""
        return bool(self._cues)

    def add(self, cue: DroneCue, trail: VehicleTrajectory, drones: list[ObjectState]) -> CueState:
        """Add a measurement; `drones` are those that the LiDAR alone would accept, seen at most 0.5 s ago."""
        known = self._cues.get(cue.source)
        if known is None or len(known.bias.mean_m) != len(cue.value_m):  # the first, or of another kind
            trusted = known is None or known.bias.trusted
            known = self._cues[cue.source] = _Cue(CueBias(slow_covariance_m2(cue), trusted))
        known.newest.append(cue)
        known.before.append(cue)
        while cue.stamp_ns - known.before[0].stamp_ns > MOVED_NS:
            known.before.popleft()
        bias = known.bias
        bias.predict(cue.stamp_ns, slow_covariance_m2(cue), cue.bias_time_s)
        offset_m = math.nan
        if drones:
            compared = [residual_of(cue, trail, drone) for drone in drones]
            residual_m, noise_m2 = min(compared, key=lambda pair: bias.distance2(*pair))
            offset_m = float(np.linalg.norm(residual_m))
            bias.compare(cue.stamp_ns, residual_m, noise_m2)
        return _state_of(cue, bias, offset_m, trail)

    def reset(self) -> None:
        """Frame map has changed: biases begin at their priors, measurements are removed, trust remains."""
        for cue in self._cues.values():
            if cue.newest:
                cue.bias = CueBias(slow_covariance_m2(cue.newest[-1]), cue.bias.trusted)
                cue.newest.clear()
                cue.before.clear()

    def proven(self, path: ObjectPath, trail: VehicleTrajectory) -> set[str]:
        """The cues that may have this object accepted: confirmed by the LiDAR before, or moving as it does."""
        return {
            source
            for source, cue in self._cues.items()
            if cue.bias.trusted and (cue.bias.confirmed or moves_as(path, cue.before, trail))
        }

    def nats(self, c: ObjectState, trail: VehicleTrajectory, now_ns: int, proven: Collection[str] = ()) -> CueNats:
        """What all cues add to the log-odds that an object is the drone; `proven`: of the cues with these sources."""
        by_source: dict[str, float] = {}
        for source, cue in self._cues.items():
            recent = [z for z in cue.newest if now_ns - z.stamp_ns < OLDEST_NS]
            if recent and cue.bias.trusted:
                by_source[source] = median_low([self._nats(z, cue.bias, trail, c) for z in recent])
        if not by_source:
            return NO_CUE
        of_proven = {source: nats if source in proven else min(nats, 0.0) for source, nats in by_source.items()}
        remark = ", ".join(f"{source} {nats:+.1f}" for source, nats in by_source.items())
        return CueNats(self._sum(by_source), self._sum(of_proven), remark)

    def _sum(self, by_source: dict[str, float]) -> float:
        total, lowest = min(sum_in_order(by_source.values()), self._weights.max_sum), min(by_source.values())
        return min(total, lowest) if lowest < CONTRADICTS_NATS else total

    def _nats(self, cue: DroneCue, bias: CueBias, trail: VehicleTrajectory, c: ObjectState) -> float:
        residual_m, noise_m2 = residual_of(cue, trail, c)
        n, S = len(residual_m), bias.covariance_m2 + noise_m2
        log_density = -0.5 * (bias.distance2(residual_m, noise_m2) + math.log(np.linalg.det(math.tau * S)))
        log_uniform = -math.log(2.0 / 3.0 * math.pi) if cue.kind is CueKind.POSITION else 0.0
        e = self._weights.outlier_probability
        ratio = math.exp(min(log_density - log_uniform + n * math.log(self._search_m), 50.0))
        return min(math.log((1.0 - e) * ratio + e), self._weights.cap(cue.source))


def moves_as(path: ObjectPath, cues: Sequence[DroneCue], trail: VehicleTrajectory) -> bool:
    """Whether a cue moves as the object does, and as no static one; by two measurements while it was observed."""
    known = [cue for cue in cues if path.stamps_ns[0] <= cue.stamp_ns <= path.stamps_ns[-1] + AFTER_PATH_NS]
    if len(known) < 2:
        return False
    now, here_m = known[-1], path.at(known[-1].stamp_ns)
    at_end = _residual_m(now, trail, here_m)
    for before in known[:-1]:
        if before.kind is not now.kind:
            continue
        d0 = at_end - _residual_m(before, trail, here_m)
        d1 = at_end - _residual_m(before, trail, path.at(before.stamp_ns))
        span_s = (now.stamp_ns - before.stamp_ns) * 1e-9
        S0 = now.covariance_m2 + before.covariance_m2 + now.bias_covariance_m2 * (2.0 * span_s / now.bias_time_s)
        S1 = S0 + 2.0 * path.sigma_m**2 * np.eye(len(d0))
        if (
            _distance2(d0, S0) > CHI2_999[len(d0)]
            and _distance2(d1, S1) < CHI2_99[len(d0)]
            and math.sqrt(float(np.linalg.eigvalsh(S1)[-1])) < 0.5 * float(np.linalg.norm(d0))
        ):
            return True
    return False


def _residual_m(cue: DroneCue, trail: VehicleTrajectory, xyz_m: Array64) -> Array64:
    return residual_of(cue, trail, ObjectState(cue.stamp_ns, xyz_m, np.zeros(3), (0.0, 0.0, 0.0)))[0]


def _distance2(d: Array64, S: Array64) -> float:
    return float(d @ np.linalg.solve(S, d))


def residual_of(cue: DroneCue, trail: VehicleTrajectory, c: ObjectState) -> tuple[Array64, Array64]:
    """Measurement minus that of an object at its time (n,), and the covariance (n, n) of both without the bias."""
    dt = (cue.stamp_ns - c.stamp_ns) * 1e-9
    offset_m = c.xyz_m + dt * c.velocity_mps - trail.at(cue.stamp_ns)[1]
    value_m, H = measure(cue.kind, offset_m, cue.reference_map_m)
    variance = max(c.p[0] + 2.0 * dt * c.p[1] + dt * dt * c.p[2], 0.0)
    return cue.value_m - value_m, cue.covariance_m2 + variance * (H @ H.T)


def slow_covariance_m2(cue: DroneCue) -> Array64:
    """(n, n) covariance of everything that changes slowly: the bias, and the yaw of a POSITION."""
    if cue.yaw_sigma_rad == 0.0:
        return cue.bias_covariance_m2
    across_m = cue.yaw_sigma_rad * np.array([-cue.value_m[1], cue.value_m[0], 0.0])  # of one sigma of the yaw
    return cue.bias_covariance_m2 + np.outer(across_m, across_m)


def measure(kind: CueKind, offset_m: Array64, reference_m: Array64) -> tuple[Array64, Array64]:
    """Measurement (n,) of a position (3,) relative to the vehicle, and its Jacobian (n, 3)."""
    if kind is CueKind.POSITION:
        return offset_m, np.eye(3)
    if kind is CueKind.HEIGHT:
        return offset_m[2:], np.array([[0.0, 0.0, 1.0]])
    if kind is CueKind.RANGE:
        from_m = offset_m - reference_m
        range_m = max(float(np.linalg.norm(from_m)), 1e-6)
        return np.array([range_m]), (from_m / range_m)[None]
    level_m = max(math.hypot(offset_m[0], offset_m[1]), 1e-6)
    H = np.array([[offset_m[0] / level_m, offset_m[1] / level_m, 0.0], [0.0, 0.0, 1.0]])
    return np.array([level_m, offset_m[2]]), H


def _state_of(cue: DroneCue, bias: CueBias, offset_m: float, trail: VehicleTrajectory) -> CueState:
    """The state of a cue after a measurement; a position only of a trusted one."""
    sigma_m = math.sqrt(float(np.linalg.eigvalsh(bias.covariance_m2)[-1]))
    apart = "" if math.isnan(offset_m) else f", {offset_m:.1f} m from the drone that the LiDAR sees"
    if bias.trusted:
        reason = f"bias known to {sigma_m:.1f} m{apart}"
    else:
        reason = f"contradicts the LiDAR{apart}: it is not used (of another drone, or the sensor has failed)"
    xyz_vehicle_m = covariance_m2 = None
    if cue.kind is CueKind.POSITION and bias.trusted:
        R = trail.at(cue.stamp_ns)[0]
        xyz_vehicle_m = R.T @ (cue.value_m - bias.mean_m)
        covariance_m2 = R.T @ (bias.covariance_m2 + cue.covariance_m2) @ R
    return CueState(
        stamp_ns=cue.stamp_ns,
        source=cue.source,
        trusted=bias.trusted,
        reason=reason,
        bias_m=bias.mean_m,
        bias_sigma_m=sigma_m,
        offset_m=offset_m,
        xyz_vehicle_m=xyz_vehicle_m,
        covariance_m2=covariance_m2,
    )
