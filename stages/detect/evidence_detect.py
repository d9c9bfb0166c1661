"""Detect by evidence: candidates are judged as pulses arrive, each with a probability and the reasons in words.

    pulses -> chords (chords.py): short, free at both ends, above the horizon
           -> sightings (sightings.py): one look on one thing, and what was measured around it (surroundings.py)
           -> candidates (candidate.py): sightings that fit one moving thing (flight.py)
           -> odds that it is a drone, and not a lamp, a bird, a balloon, rain (verdict.py)

A look is one passing of the rotor, 0.1 s apart. A candidate is accepted at `accept_probability`; one above
`look_again_probability` is told at once (Candidates), so that the aim can look again. Detections go out when a
candidate is accepted, at the end of each pass of the turntable, and at least every `report_s` while there is a drone.

Source: ours, for P III.B; DESIGN, The graph: detect.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, model_validator

from flow.stage import Settings, Stage
from stages.detect.candidate import SAME_LOOK_NS, STANDING_M, START_SPEED_MPS, Candidate, Sighting
from stages.detect.candidate_messages import candidates_message, detections_message, odds_of
from stages.detect.candidate_table import Bank, places_of
from stages.detect.classifier import STANDING, Evidence, judge
from stages.detect.isolation import BigThings
from stages.detect.observations import Limits, SightingFinder, Slice
from stages.detect.reacquire import joined, without_twins
from stages.detect.telemetry import DroneWord
from stages.geometry.frames import Array64
from stages.geometry.trajectory import VehicleTrajectory
from stages.kernels.detect.candidate import SIGMA_M
from stages.kernels.detect.candidate_table import first_within
from stages.kernels.sweep.pulses import looking_along
from stages.messages import (
    Candidates,
    Detections,
    DroneLocalPosition,
    DroneOdometry,
    SweptPulses,
    VehicleMotion,
)
from stages.sweep.pulses import middle_ns
from stages.sweep.sweep import Travel

TIDIED_NS = 84_300_000  # about ten times a second
AMONG_M = 1.5
AMONG_NS = 20_000_000_000
SAME_PLACE_M = 0.5
MOST_STANDING = 64
KEPT_NATS = 1.65  # so much less than it takes to accept it, and it is accepted no more
STILL_MPS = np.zeros(3)
STANDING_NS = 60_000_000_000  # for so long it is known that something stands there


@dataclass(slots=True)
class _Watch:
    """Pulses through the middle of a candidate in one look."""

    hits: int = 0
    passes: int = 0
    stamp_ns: int = 0


@dataclass(slots=True)
class _Now:
    """What the detector remembers."""

    finder: SightingFinder
    travel: Travel
    trail: VehicleTrajectory = field(default_factory=VehicleTrajectory)
    word: DroneWord = field(default_factory=DroneWord)
    bank: Bank = field(default_factory=Bank)
    standing: deque[Candidate] = field(default_factory=lambda: deque[Candidate](maxlen=MOST_STANDING))
    standing_m: Array64 = field(default_factory=lambda: np.empty((0, 3)))  # where they are
    refused_places: BigThings = field(default_factory=BigThings)
    watches: dict[int, _Watch] = field(default_factory=lambda: dict[int, _Watch]())
    refused: Counter[str] = field(default_factory=Counter[str])
    tidied_ns: int = 0
    elsewhere: bool = False  # all that is remembered, by the vehicle's odometry
    number: int = 0  # of the newest candidate
    detector_instance: int = 0  # its first pulse's stamp
    start_ns: int | None = None  # of the search not yet reported
    end_ns: int | None = None  # of a pass that is over, not yet reported


class EvidenceDetectSettings(Settings):
    """Settings of `EvidenceDetect`."""

    span_m: float = Field(0.5, gt=0, le=10)  # the drone's largest extent
    lowest_deg: float = Field(4.0, ge=-30, le=80)  # candidates are this far above the LiDAR's horizon
    nearest_m: float = Field(1.5, ge=0.3)
    furthest_m: float = Field(65.0, gt=1)
    clear_m: float = Field(2.0, gt=0.2)  # a lamp hangs this far from its pole; so near nothing may stand
    accept_probability: float = Field(0.95, gt=0.5, lt=1)
    look_again_probability: float = Field(0.014, gt=0, lt=0.5)
    report_s: float = Field(1.0, gt=0.05)
    settle_s: float = Field(0.15, ge=0)  # what was seen just before the end of a pass is judged with it
    sweep_deg: float = Field(180.0, gt=3, le=360)
    forget_s: float = Field(4.0, gt=0)
    max_candidates: int = Field(12, ge=1)  # given out
    parked: bool = False  # the vehicle stands: what moves is known without VehicleMotion
    free_space: bool = True  # False: what was measured around a candidate counts for nothing, to see what it is worth
    evidence: Evidence = Evidence()

    @model_validator(mode="after")
    def _settings_agree(self) -> EvidenceDetectSettings:
        if self.furthest_m <= self.nearest_m:
            raise ValueError("furthest_m must be larger than nearest_m")
        return self


class EvidenceDetect(Stage[EvidenceDetectSettings]):
    """Small, alone, seen to be free all around, again and again: a drone. What is refused is refused with a reason."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"motion", "drone_position", "drone_odometry"})

    def __init__(self, settings: EvidenceDetectSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        settings = self.settings
        limits = Limits(
            settings.span_m,
            math.radians(settings.lowest_deg),
            settings.nearest_m,
            settings.furthest_m,
            settings.clear_m,
        )
        self._now = _Now(SightingFinder(limits), Travel(math.radians(settings.sweep_deg - 3.0), math.radians(0.5)))

    def on_motion(self, motion: VehicleMotion) -> None:
        """Where the vehicle is. Without it nothing is taken to move but what rises or sinks, unless `parked` is set."""
        self._now.elsewhere |= self._now.trail.add(motion)

    def on_drone_position(self, position: DroneLocalPosition) -> None:
        """What the drone says of its flight; without it birds and lamps are told by how they fly alone."""
        self._now.word.add_position(position)

    def on_drone_odometry(self, odometry: DroneOdometry) -> None:
        """The same from an autopilot that sends this."""
        self._now.word.add_odometry(odometry)

    def on_pulses(self, pulses: SweptPulses) -> Iterator[Candidates | Detections]:
        """One slice: judge the sightings that are complete with it, tell what changed."""
        if pulses.range_m.size == 0:
            return
        now = self._now
        now_ns = int(pulses.point_stamp_ns[-1])
        if now.start_ns is None:
            now.start_ns = now.tidied_ns = now.detector_instance = pulses.stamp_ns
        part = Slice(pulses, *now.trail.at(middle_ns(pulses)), looking_along(pulses.direction_vehicle))
        changed = False
        sightings = now.finder.feed(part, self._motion_known(now_ns))
        self._look_for_misses(now, part, now_ns)
        if now_ns - now.tidied_ns > TIDIED_NS:
            now.tidied_ns = now_ns
            changed = self._tidy(now, now_ns)
        for sighting in sightings:
            changed |= self._take(now, sighting)
        yield from self._report(now, now_ns, pulses.turntable_rad, changed)

    def _motion_known(self, stamp_ns: int) -> bool:
        """Whether it is told how the vehicle moves: what stands still in the world is known then."""
        return self.settings.parked or self._now.trail.known_at(stamp_ns)

    def _take(self, now: _Now, s: Sighting) -> bool:
        """Give a sighting to the candidate it fits, or make one of it. True when that is news."""
        both = now.bank.fitting(s, joined=True)
        if both is not None:
            self._see(now, both, s)
        best = now.bank.fitting(s) or self._wake(now, s)
        if best is not None:
            return self._see(now, best, s) or both is not None
        since_ns = s.stamp_ns - (AMONG_NS if self._motion_known(s.stamp_ns) else AMONG_NS // 20)
        refused_m = now.refused_places.nearest_m(s.xyz_map_m, 0.0, AMONG_M, since_ns)
        among = math.isfinite(refused_m)
        if both is None and not among and not math.isfinite(s.big_m):  # in a tree something lies everywhere
            self._join(now, s)
        now.number += 1
        new = Candidate(
            number=now.number,
            stamp_ns=s.stamp_ns,
            seen_ns=s.stamp_ns,
            xyz_m=s.xyz_map_m,
            velocity_mps=STILL_MPS,
            range_m=s.range_m,
            p=(SIGMA_M**2, 0.0, START_SPEED_MPS**2),
            first_hits=s.hits,
        )
        new.among, new.again = among, refused_m < SAME_PLACE_M and now.word.moves(s.stamp_ns)
        new.note(s)
        news = self._weigh(now, new)
        if new.told:
            new.velocity_mps = now.trail.velocity_mps(s.stamp_ns)  # a drone comes along with the vehicle
            now.bank.put(new)
        else:
            now.refused[why_refused(new.why)] += 1
            self._remember(now, new)
        return news

    def _see(self, now: _Now, c: Candidate, s: Sighting) -> bool:
        """One more sighting of a candidate. True when that is news."""
        c.see(s)
        news = self._weigh(now, c)
        now.bank.put(c)
        return news

    def _join(self, now: _Now, s: Sighting) -> None:
        """What was met elsewhere and may have flown here, as the drone says, goes on here, too."""
        if not self._motion_known(s.stamp_ns) or not now.word.moves(s.stamp_ns):
            return
        if met := now.word.met_again(now.bank, s):
            now.number += 1
            both = joined(met[0], now.number, s, met[1])
            self._weigh(now, both)
            if both.told:
                now.bank.put(both)

    def _wake(self, now: _Now, s: Sighting) -> Candidate | None:
        """Something that was looked at before and stood there: it goes on where it was, and is not looked at anew."""
        place = first_within(now.standing_m, s.xyz_map_m, STANDING_M)
        if place < 0:
            return None
        c = now.standing[place]
        del now.standing[place]
        now.standing_m = places_of(now.standing)
        c.wake(s.stamp_ns)
        return c

    def _weigh(self, now: _Now, c: Candidate) -> bool:
        """Judge it anew. True when that is news."""
        settings = self.settings
        motion_known = self._motion_known(c.seen_ns)
        c.hear(now.word.of(c, motion_known))
        c.odds, c.why = judge(c, settings.evidence, settings.free_space, motion_known)
        accept = odds_of(settings.accept_probability)
        c.accepted = c.odds >= accept or (c.accepted and c.odds >= accept - KEPT_NATS)
        was, c.told = c.told, c.odds >= odds_of(settings.look_again_probability)
        c.worth |= c.told
        return c.worth or was != c.told

    def _look_for_misses(self, now: _Now, part: Slice, now_ns: int) -> None:
        """Count the pulses that went through where a candidate should be, look by look."""
        origin_m, disc_m = np.array(part.pulses.origin_vehicle_m), 0.22 * self.settings.span_m
        for c, hits, passes, elsewhere in now.bank.looked_at(
            part, origin_m, now_ns, disc_m, (0.5 * self.settings.span_m) ** 2
        ):
            if not elsewhere:
                watch = now.watches.setdefault(c.number, _Watch())
                watch.hits += hits
                watch.passes += passes
                watch.stamp_ns = now_ns
                continue
            watch = now.watches.get(c.number)
            if watch is not None and now_ns - watch.stamp_ns > SAME_LOOK_NS:
                if watch.hits == 0 and now_ns - c.seen_ns > 2 * SAME_LOOK_NS:
                    c.missed += watch.passes * min(1.0, (35.0 / c.range_m) ** 2)
                    self._weigh(now, c)
                    now.bank.put(c)
                del now.watches[c.number]

    def _tidy(self, now: _Now, now_ns: int) -> bool:
        """Put away what was not seen for long, sooner what was refused. True when one that was told goes."""
        if now.elsewhere:
            return self._forget(now)
        kept = without_twins(c for c in now.bank if now_ns - c.seen_ns < self._kept_ns(c))
        for c in now.bank:
            if now_ns - c.seen_ns >= self._kept_ns(c) and not c.told:
                self._remember(now, c)
        if self._motion_known(now_ns):
            now.standing.extend(c for c in now.bank if now_ns - c.seen_ns >= self._kept_ns(c) and c.stands)
        while now.standing and now_ns - now.standing[0].seen_ns > STANDING_NS:
            now.standing.popleft()
        now.standing_m = places_of(now.standing)
        gone = len({c.number for c in now.bank if c.told} - {c.number for c in kept}) > 0
        now.bank.keep(kept)
        now.watches = {c.number: now.watches[c.number] for c in kept if c.number in now.watches}
        return gone

    def _forget(self, now: _Now) -> bool:
        """Put away all: nobody knows where it lies in the frame that the vehicle's odometry has come back with."""
        gone = any(c.told for c in now.bank)
        now.elsewhere, now.standing_m, now.refused_places = False, places_of(()), BigThings()
        now.bank.keep(())
        now.standing.clear()
        now.watches.clear()
        return gone

    def _remember(self, now: _Now, c: Candidate) -> None:
        """Where something that stands was refused."""
        if c.suspect == STANDING and (c.hit_looks < 3 or c.stands):
            now.refused_places.add(c.xyz_m[None], c.seen_ns)

    def _kept_ns(self, c: Candidate) -> float:
        """How long a candidate is followed without a sighting."""
        if c.told:
            return self.settings.forget_s * 1e9
        return 1.5e9 if c.hit_looks >= 3 else 0.35e9

    def _report(self, now: _Now, now_ns: int, turntable_rad: float, changed: bool) -> Iterator[Candidates | Detections]:
        settings = self.settings
        if not math.isnan(turntable_rad):
            now.travel.advance(turntable_rad, 0.0)
            if now.travel.whole:
                now.travel.restart(turntable_rad)
                now.end_ns = now.end_ns or now_ns
        accepted = [c for c in now.bank if c.accepted]
        new = [c for c in accepted if not c.announced]
        if changed or new:
            told = [c for c in now.bank if c.told or (c.worth and now_ns - c.seen_ns < 300_000_000)]
            flight = now.word.usual_flight(now.trail, now_ns)
            yield candidates_message(told, now.trail, now_ns, now.detector_instance, settings.max_candidates, *flight)
        assert now.start_ns is not None
        since_s = (now_ns - now.start_ns) * 1e-9
        here = any(c.seen_ns >= now.start_ns for c in accepted)
        if now.end_ns is not None and not new:
            if now_ns - now.end_ns < settings.settle_s * 1e9 and not (here and since_s > settings.report_s):
                return
            end_ns = now.end_ns if now_ns - now.end_ns >= settings.settle_s * 1e9 else now_ns
        elif new or (here and since_s > settings.report_s) or since_s > 3.0 * settings.report_s:
            end_ns = now_ns
        else:
            return
        refused = now.refused + now.finder.hidden
        yield detections_message(now.bank, now.trail, now.start_ns, end_ns, refused, settings.max_candidates)
        for c in new:
            c.announced = True
        now.start_ns, now.end_ns = end_ns + 1, None
        now.refused.clear()
        now.finder.hidden.clear()


def why_refused(why: str) -> str:
    """What it most likely is, and what speaks for that: the reasons of a judgement without their numbers."""
    parts = why.split("; ")
    told = [
        part.partition(" m away")[0].rstrip("0123456789. ")
        for part in parts
        if part.startswith(("something", "beside", "longer"))
    ]
    return ", ".join([parts[-1].removeprefix("if not a drone, "), *told])
