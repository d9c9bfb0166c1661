"""Hypotheses of the tracker, each with position and velocity: started, predicted, reacquired and removed.

Between scan passes each is predicted by the drone's odometry (`odometry_motion_model.py`), or at constant velocity. A
hypothesis becomes a drone when the detector accepts its candidate (`confirmed`). `scan_pass.py` evaluates its returns.

Source: ours, for P III.C; DESIGN, The graph: track.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.track.scan_pass import largest_sigma_m, misfit
from stages.messages import DroneLocalPosition, DroneOdometry
from stages.track.odometry_motion_model import OdometryMotionModel, OdometrySample
from stages.track.scan_pass import ScanPass

REPLACE_AFTER_NS = 1_000_000_000  # without a return for this long, another accepted drone replaces it
STALE_NS = 150_000_000  # an observation this much older than the track's returns is ignored
START_SIGMA_M = 0.2
DETECTION_VOLUME_M3 = 2.0 / 3.0 * math.pi * 35.0**3  # half-sphere of the detection range


@dataclass(slots=True, eq=False)
class Hypothesis:
    """State of one hypothesis; a drone once it is `confirmed`."""

    number: int  # 0 while it is a candidate only
    candidate: int  # the detector's candidate number; 0: no longer valid
    stamp_ns: int
    x: Array64  # (6,) position [m] and velocity [m/s], map frame
    P: Array64  # (6, 6)
    last_return_ns: int
    p_0: float  # probability that a pulse through its hull returns
    log_odds: float = 0.0
    confirmed: bool = False
    hits: int = 0  # returns of the newest scan pass
    scan_pass: ScanPass | None = None
    sample: OdometrySample | None = None  # odometry at stamp_ns when x was computed
    pass_sample: OdometrySample | None = None  # odometry at the start of the scan pass
    published_ns: int = 0
    reason: str = "started at a candidate of the detector"


class Hypotheses:
    """All hypotheses, and the odometry by which they are predicted."""

    def __init__(
        self, manoeuvre: float, odometry_manoeuvre: float, start_sigma_mps: float, own_sigma_m: float, max_drones: int
    ) -> None:
        """Acceleration densities without and with odometry [m^2/s^3], and settings of `LikelihoodTrack`."""
        self._manoeuvre, self._odometry_manoeuvre = manoeuvre, odometry_manoeuvre
        self._start_sigma_mps, self._own_sigma_m, self._max_drones = start_sigma_mps, own_sigma_m, max_drones
        self._all: list[Hypothesis] = []
        self._models = OdometryMotionModel(0), OdometryMotionModel(1)
        # cache: all candidates need the same time
        self._predicted: dict[Hypothesis, tuple[int, Array64, Array64]] = {}
        self._sample: tuple[int, OdometrySample | None] | None = None  # cached odometry sample, likewise

    def __iter__(self) -> Iterator[Hypothesis]:
        """Iterate over a copy: hypotheses may be added or removed meanwhile."""
        return iter(tuple(self._all))

    def __len__(self) -> int:
        return len(self._all)

    def __contains__(self, one: Hypothesis) -> bool:
        return one in self._all  # by identity: a hypothesis equals itself only

    def add_position(self, position: DroneLocalPosition) -> None:
        """Add the drone's telemetry."""
        self._predicted.clear()
        self._sample = None
        self._models[0].telemetry.add_position(position)

    def add_odometry(self, odometry: DroneOdometry) -> None:
        """Add the drone's odometry; preferred when both are sent."""
        self._predicted.clear()
        self._sample = None
        self._models[1].telemetry.add_odometry(odometry)

    def sample(self, stamp_ns: int) -> OdometrySample | None:
        """Odometry of the drone at a time, from the better of its messages; None: unknown."""
        if self._sample is None or self._sample[0] != stamp_ns:
            self._sample = stamp_ns, self._models[1].sample(stamp_ns) or self._models[0].sample(stamp_ns)
        return self._sample[1]

    def learn(self, one: Hypothesis) -> None:
        """Update the yaw of frame odom by a return of a confirmed drone."""
        x, P = self.at(one, one.last_return_ns)
        for model in self._models:
            model.learn(one.number, one.last_return_ns, x[:3], math.sqrt(float(np.trace(P[:3, :3])) / 3) + 0.05)
        self._predicted.clear()

    def at(self, one: Hypothesis, stamp_ns: int) -> tuple[Array64, Array64]:
        """Predicted state (6,) and covariance (6, 6) at a time, map frame."""
        cached = self._predicted.get(one)
        if cached is None or cached[0] != stamp_ns:
            after = self.sample(stamp_ns)
            model = self._models[0 if after is None else after.source]
            dt_s = (stamp_ns - one.stamp_ns) * 1e-9
            at = model.predicted(one.x, one.P, dt_s, one.sample, after, self._manoeuvre, self._odometry_manoeuvre)
            cached = self._predicted[one] = (stamp_ns, *at)
        return cached[1], cached[2]

    def update(self, one: Hypothesis, stamp_ns: int, x: Array64, P: Array64, sample: OdometrySample | None) -> None:
        """Set the state of a hypothesis at a time."""
        one.stamp_ns, one.x, one.P, one.sample = stamp_ns, x, P, sample
        self._predicted.clear()

    @property
    def confirmed(self) -> list[Hypothesis]:
        """The hypotheses that are drones."""
        return [one for one in self._all if one.confirmed]

    def start(self, number: int, xyz: Array64, v: Array64, seen_ns: int, stamp_ns: int) -> Hypothesis:
        """Start a hypothesis at a candidate, observed at `seen_ns` and predicted to `stamp_ns`."""
        one = self._new(number, xyz, v, seen_ns, stamp_ns)
        self._all.append(one)
        return one

    def _new(self, number: int, xyz: Array64, v: Array64, seen_ns: int, stamp_ns: int) -> Hypothesis:
        P = np.diag([START_SIGMA_M**2] * 3 + [self._start_sigma_mps**2] * 3)
        if stamp_ns > seen_ns:
            xyz = xyz - (stamp_ns - seen_ns) * 1e-9 * v
        return Hypothesis(number=0, candidate=number, stamp_ns=seen_ns, x=np.concatenate([xyz, v]), P=P,
                          last_return_ns=seen_ns, p_0=0.8, sample=self.sample(seen_ns))  # fmt: skip

    def clear_candidate_numbers(self) -> None:
        """The detector was restarted: its candidate numbers are no longer valid."""
        for one in self._all:
            one.candidate = 0

    def drop(self, one: Hypothesis) -> None:
        """Remove a hypothesis."""
        self._all = [other for other in self._all if other is not one]
        self._predicted.clear()

    def uncertain(self, one: Hypothesis, now_ns: int) -> bool:
        """Whether its position is so uncertain that a candidate there may be another object."""
        return largest_sigma_m(self.at(one, now_ns)[1]) > self._own_sigma_m

    def required_probability(self, one: Hypothesis, now_ns: int, accept_probability: float) -> float:
        """Probability a candidate near this hypothesis needs to be assigned to it; 0.5 if its covariance is small.

        The detector's threshold, `accept_probability`, is for the whole sky. Only clutter within three sigmas of here
        can be mistaken for this drone, so the log-odds are reduced by the logarithm of that share of the sky's volume.
        """
        share = 36.0 * math.pi * math.sqrt(float(np.linalg.det(self.at(one, now_ns)[1][:3, :3]))) / DETECTION_VOLUME_M3
        accept_log_odds = math.log(accept_probability / (1.0 - accept_probability))
        return 1.0 / (1.0 + math.exp(-max(accept_log_odds + math.log(share), 0.0)))

    def move(self, one: Hypothesis, number: int, xyz: Array64, v: Array64, seen_ns: int, stamp_ns: int) -> None:
        """Reset a hypothesis to a candidate of the detector."""
        new = self._new(number, xyz, v, seen_ns, stamp_ns)
        one.candidate, one.last_return_ns, one.scan_pass, one.log_odds = number, seen_ns, None, max(one.log_odds, 2.0)
        self.update(one, new.stamp_ns, new.x, new.P, new.sample)
        one.reason = "reacquired by the detector"

    def diverged(self, number: int, xyz: Array64, v: Array64, seen_ns: int, stamp_ns: int) -> Hypothesis | None:
        """The drone of this candidate, reset to it, when its track has diverged; None: no such drone.

        An observation older than the track's newest return is ignored.
        """
        own = (one for one in self.confirmed if one.candidate == number)
        one = next((one for one in own if seen_ns > one.last_return_ns - STALE_NS), None)
        if one is not None:
            self.move(one, number, xyz, v, seen_ns, stamp_ns)
            one.reason = "track diverged, reset by the detector"
        return one

    def near(self, xyz: Array64, stamp_ns: int, number: int) -> Hypothesis | None:
        """The hypothesis that a candidate belongs to, by its number or its position; None: none."""
        best, least = None, 9.0
        for one in self._all:
            cost = misfit(xyz, *self.at(one, stamp_ns))
            cost = min(cost, 4.0) if one.candidate == number and cost < 100.0 else cost
            if cost < least:
                best, least = one, cost
        return best

    def oldest_unseen(self, seen_ns: int) -> Hypothesis | None:
        """The drone without a return for longest, if it must be replaced by a newly accepted one; else None."""
        oldest = min(self.confirmed, key=lambda one: one.last_return_ns, default=None)
        if oldest is None or len(self.confirmed) < self._max_drones:
            return None
        return oldest if seen_ns - oldest.last_return_ns >= REPLACE_AFTER_NS else None
