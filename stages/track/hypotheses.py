"""What may be drones, each with its position and velocity: begun, predicted, found again and given up.

Between looks each moves as the drone says it flies (`told_motion.py`), or straight on. One becomes a drone when the
detector accepts it (`confirmed`); what it is in a look is said by `look.py`.

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

REPLACE_AFTER_NS = 1_000_000_000  # so long without a hit, another that was accepted takes its place
STALE_NS = 150_000_000  # a sighting so much older than a track's own hits says nothing of it
START_SIGMA_M = 0.2
ACCEPTED_NATS = math.log(0.95 / 0.05)  # at which the detector accepts something, wherever it is
SKY_M3 = 2.0 / 3.0 * math.pi * 35.0**3  # in which it finds drones


@dataclass(slots=True, eq=False)
class Hypothesis:
    """One of them."""

    number: int  # 0 while it is a candidate only
    candidate: int  # the detector's number; 0: it has none any more
    stamp_ns: int
    x: Array64  # (6,) position and velocity, local frame
    P: Array64  # (6, 6)
    last_return_ns: int
    p_0: float  # share of the pulses through its hull that return
    log_odds: float = 0.0
    confirmed: bool = False
    hits: int = 0  # of the newest look
    scan_pass: ScanPass | None = None
    sample: OdometrySample | None = None  # what the drone's word was for stamp_ns when x was made
    pass_sample: OdometrySample | None = None  # and for the look's start
    published_ns: int = 0
    reason: str = ""


class Hypotheses:
    """All of them, and what the drone says of its flight."""

    def __init__(
        self, manoeuvre: float, odometry_manoeuvre: float, start_sigma_mps: float, own_sigma_m: float, max_drones: int
    ) -> None:
        """Densities of the acceleration without and with the drone's word [m^2/s^3]; see `LikelihoodTrack`'s
        settings."""
        self._manoeuvre, self._odometry_manoeuvre = manoeuvre, odometry_manoeuvre
        self._start_sigma_mps, self._own_sigma_m, self._max_drones = start_sigma_mps, own_sigma_m, max_drones
        self._all: list[Hypothesis] = []
        self._models = OdometryMotionModel(0), OdometryMotionModel(1)
        # as asked for last: each candidate asks for the same moment
        self._predicted: dict[Hypothesis, tuple[int, Array64, Array64]] = {}
        self._sample: tuple[int, OdometrySample | None] | None = None  # the same, of the drone's word

    def __iter__(self) -> Iterator[Hypothesis]:
        """Over those there are now: it may change meanwhile."""
        return iter(tuple(self._all))

    def __len__(self) -> int:
        return len(self._all)

    def __contains__(self, one: Hypothesis) -> bool:
        return one in self._all  # by identity: a hypothesis equals itself only

    def add_position(self, position: DroneLocalPosition) -> None:
        """What the drone says of its flight."""
        self._predicted.clear()
        self._sample = None
        self._models[0].telemetry.add_position(position)

    def add_odometry(self, odometry: DroneOdometry) -> None:
        """The same from an autopilot that sends this; taken where it sends both."""
        self._predicted.clear()
        self._sample = None
        self._models[1].telemetry.add_odometry(odometry)

    def sample(self, stamp_ns: int) -> OdometrySample | None:
        """What the drone says of itself at a time, by the better of its messages."""
        if self._sample is None or self._sample[0] != stamp_ns:
            self._sample = stamp_ns, self._models[1].sample(stamp_ns) or self._models[0].sample(stamp_ns)
        return self._sample[1]

    def learn(self, one: Hypothesis) -> None:
        """A hit on a drone tells which way its autopilot's axes point."""
        x, P = self.at(one, one.last_return_ns)
        for told in self._models:
            told.learn(one.number, one.last_return_ns, x[:3], math.sqrt(float(np.trace(P[:3, :3])) / 3) + 0.05)
        self._predicted.clear()

    def at(self, one: Hypothesis, stamp_ns: int) -> tuple[Array64, Array64]:
        """State (6,) and covariance (6, 6) at a time."""
        known = self._predicted.get(one)
        if known is None or known[0] != stamp_ns:
            after = self.sample(stamp_ns)
            told = self._models[0 if after is None else after.source]
            dt_s = (stamp_ns - one.stamp_ns) * 1e-9
            at = told.predicted(one.x, one.P, dt_s, one.sample, after, self._manoeuvre, self._odometry_manoeuvre)
            known = self._predicted[one] = (stamp_ns, *at)
        return known[1], known[2]

    def update(self, one: Hypothesis, stamp_ns: int, x: Array64, P: Array64, sample: OdometrySample | None) -> None:
        """Its state at a time is this."""
        one.stamp_ns, one.x, one.P, one.sample = stamp_ns, x, P, sample
        self._predicted.clear()

    @property
    def confirmed(self) -> list[Hypothesis]:
        """The drones."""
        return [one for one in self._all if one.confirmed]

    def start(self, number: int, xyz: Array64, v: Array64, seen_ns: int, stamp_ns: int) -> Hypothesis:
        """A new one, seen by the detector at `seen_ns`, told for `stamp_ns`."""
        one = self._made(number, xyz, v, seen_ns, stamp_ns)
        self._all.append(one)
        return one

    def _made(self, number: int, xyz: Array64, v: Array64, seen_ns: int, stamp_ns: int) -> Hypothesis:
        P = np.diag([START_SIGMA_M**2] * 3 + [self._start_sigma_mps**2] * 3)
        if stamp_ns > seen_ns:
            xyz = xyz - (stamp_ns - seen_ns) * 1e-9 * v
        return Hypothesis(number=0, candidate=number, stamp_ns=seen_ns, x=np.concatenate([xyz, v]), P=P,
                          last_return_ns=seen_ns, p_0=0.8, sample=self.sample(seen_ns))  # fmt: skip

    def clear_candidate_numbers(self) -> None:
        """The detector's numbers mean other things from now on."""
        for one in self._all:
            one.candidate = 0

    def drop(self, one: Hypothesis) -> None:
        """Give it up."""
        self._all = [other for other in self._all if other is not one]
        self._predicted.clear()

    def uncertain(self, one: Hypothesis, now_ns: int) -> bool:
        """So long without a hit that what is found there may as well be something else."""
        return largest_sigma_m(self.at(one, now_ns)[1]) > self._own_sigma_m

    def required_probability(self, one: Hypothesis, now_ns: int) -> float:
        """How probably a drone a candidate near this one must be to be taken for it: .5 where it is known well.

        As sure as the detector is when it accepts something in the whole sky, less what of the sky lies within three
        sigmas of here: of all that is no drone only what is met there can be mistaken for it.
        """
        share = 36.0 * math.pi * math.sqrt(float(np.linalg.det(self.at(one, now_ns)[1][:3, :3]))) / SKY_M3
        return 1.0 / (1.0 + math.exp(-max(ACCEPTED_NATS + math.log(share), 0.0)))

    def move(self, one: Hypothesis, number: int, xyz: Array64, v: Array64, seen_ns: int, stamp_ns: int) -> None:
        """The detector found it again."""
        new = self._made(number, xyz, v, seen_ns, stamp_ns)
        one.candidate, one.last_return_ns, one.scan_pass, one.log_odds = number, seen_ns, None, max(one.log_odds, 2.0)
        self.update(one, new.stamp_ns, new.x, new.P, new.sample)
        one.reason = "found again by the detector"

    def diverged(self, number: int, xyz: Array64, v: Array64, seen_ns: int, stamp_ns: int) -> Hypothesis | None:
        """The drone of this candidate, brought back to it: it followed something else.

        Not where the detector has not seen it lately: then the track knows better.
        """
        mine = (one for one in self.confirmed if one.candidate == number)
        one = next((one for one in mine if seen_ns > one.last_return_ns - STALE_NS), None)
        if one is not None:
            self.move(one, number, xyz, v, seen_ns, stamp_ns)
            one.reason = "had followed something else, brought back by the detector"
        return one

    def near(self, xyz: Array64, stamp_ns: int, number: int) -> Hypothesis | None:
        """The one that this is: by the detector's number, or by its place."""
        best, least = None, 9.0
        for one in self._all:
            cost = misfit(xyz, *self.at(one, stamp_ns))
            cost = min(cost, 4.0) if one.candidate == number and cost < 100.0 else cost
            if cost < least:
                best, least = one, cost
        return best

    def oldest_unseen(self, seen_ns: int) -> Hypothesis | None:
        """The drone that was not hit for longest, and long, where there is no room for one accepted elsewhere."""
        oldest = min(self.confirmed, key=lambda one: one.last_return_ns, default=None)
        if oldest is None or len(self.confirmed) < self._max_drones:
            return None
        return oldest if seen_ns - oldest.last_return_ns >= REPLACE_AFTER_NS else None
