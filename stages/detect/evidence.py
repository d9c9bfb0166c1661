"""Detect by evidence: candidates are judged as pulses arrive, each with a probability and the reasons in words.

    pulses -> chords (stages/detect/chords.py): short, free at both ends, above the horizon
           -> sightings: the chords of one look on one thing, and what was measured around it (surroundings.py)
           -> candidates (candidate.py): sightings that fit one moving thing, and the odds that it is a drone

A look is one passing of the rotor, 0.1 s apart. A candidate is accepted at `accept_probability`; one above
`look_again_probability` is told at once (Candidates), so that the aim can look again. Detections go out when a
candidate is accepted, at the end of each pass of the turntable, and at least every `report_s`.

Source: ours, for P III.B; DESIGN, The graph: detect.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydantic import Field, PrivateAttr

from flow.stage import Stage
from stages.detect import chords as chord
from stages.detect.candidate import Candidate, Evidence, Sighting
from stages.detect.chords import ChordFinder
from stages.detect.surroundings import INNER_HITS, INNER_PASSES, TALLY, BigThings, look_around
from stages.geometry import Array64
from stages.messages import Candidates, Detections, SweptPulses, VehicleMotion
from stages.sweep import Travel
from stages.trail import VehicleTrail

BEAM_SPACING_RAD = math.radians(2.0)  # between two lasers of a VLP-16
SAME_LOOK_NS = 30_000_000
SLICES = 7  # 34 deg of the rotor
DELAY = 3  # slices after which what stands around a sighting has been seen


class _Slice(NamedTuple):
    pulses: SweptPulses
    R: Array64  # T_local_vehicle at its time
    t: Array64
    axis: Array64  # mean direction, unit


class EvidenceDetect(Stage):
    """Small, alone, seen to be free all around, again and again: a drone. What is refused is refused with a reason."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"motion"})

    span_m: float = Field(0.5, gt=0, le=10)  # the drone's largest extent
    lowest_deg: float = Field(4.0, ge=-30, le=80)  # candidates are this far above the LiDAR's horizon
    nearest_m: float = Field(1.5, ge=0.3)
    clear_m: float = Field(2.0, gt=0.2)  # a lamp hangs this far from its pole; so near nothing may stand
    furthest_m: float = Field(65.0, gt=1)
    accept_probability: float = Field(0.99, gt=0.5, lt=1)
    look_again_probability: float = Field(0.015, gt=0, lt=0.5)
    report_s: float = Field(1.0, gt=0.05)
    settle_s: float = Field(0.15, ge=0)  # what was seen just before the end of a pass is judged with it
    sweep_deg: float = Field(180.0, gt=0, le=360)
    free_space: bool = True  # ablation: without, emptiness around a candidate counts for nothing
    evidence: Evidence = Evidence()
    forget_s: float = Field(4.0, gt=0)
    max_candidates: int = Field(12, ge=1)  # given out

    _trail: VehicleTrail = PrivateAttr(default_factory=VehicleTrail)
    _finder: ChordFinder = PrivateAttr()
    _big: BigThings = PrivateAttr(default_factory=BigThings)
    _slices: deque[_Slice] = PrivateAttr(default_factory=lambda: deque[_Slice](maxlen=SLICES))
    _pending: list[tuple[int, Array64, int]] = PrivateAttr(default_factory=lambda: list[tuple[int, Array64, int]]())
    _bank: list[Candidate] = PrivateAttr(default_factory=lambda: list[Candidate]())
    _watched: dict[int, list[float]] = PrivateAttr(default_factory=lambda: dict[int, list[float]]())
    _count: int = PrivateAttr(default=0)
    _number: int = PrivateAttr(default=0)
    _told_accepted: set[int] = PrivateAttr(default_factory=lambda: set[int]())
    _refused: Counter[str] = PrivateAttr(default_factory=Counter[str])
    _travel: Travel = PrivateAttr()
    _start_ns: int | None = PrivateAttr(default=None)
    _end_ns: int | None = PrivateAttr(default=None)  # of a pass that is over, not yet reported

    def model_post_init(self, context: Any, /) -> None:
        self._finder = ChordFinder(1.6 * self.span_m, 0.7 * self.span_m, 0.6 * self.span_m)
        self._travel = Travel(math.radians(self.sweep_deg - 3.0), math.radians(0.5))

    def on_motion(self, motion: VehicleMotion) -> None:
        """Where the vehicle is; without it, it is taken to be parked."""
        self._trail.add(motion)

    def on_pulses(self, pulses: SweptPulses) -> Iterator[Candidates | Detections]:
        """One slice: find chords, judge the sightings that are complete, tell what changed."""
        if pulses.range_m.size == 0:
            return
        now_ns = int(pulses.point_stamp_ns[-1])
        if self._start_ns is None:
            self._start_ns = pulses.stamp_ns
        R, t = self._trail.at(pulses.stamp_ns)
        axis = pulses.direction_vehicle.mean(axis=0).astype(np.float64)
        self._slices.append(_Slice(pulses, R, t, axis / max(float(np.linalg.norm(axis)), 1e-9)))
        self._count += 1
        self._find(pulses, R, t)
        self._look_for_misses(now_ns)
        changed = False
        if self._count % 64 == 0:  # about ten times a second
            changed = self._forget(now_ns)
        if self._pending and self._pending[0][0] <= self._count - DELAY:
            changed |= self._judge_pending(now_ns)
        yield from self._report(now_ns, pulses.turntable_rad, changed)

    # what was seen

    def _find(self, pulses: SweptPulses, R: Array64, t: Array64) -> None:
        found = self._finder.feed(pulses)
        rows = found.rows
        if not len(rows):
            return
        long = rows[:, chord.LONG] > 0
        if long.any():
            self._big.add(rows[long, :3] @ R.T + t, pulses.stamp_ns)
        up = (rows[:, chord.Z] - pulses.origin_vehicle_m[2]) > math.sin(math.radians(self.lowest_deg)) * rows[
            :, chord.RANGE
        ]
        near = (rows[:, chord.RANGE] >= self.nearest_m) & (rows[:, chord.RANGE] <= self.furthest_m)
        short = ~long & up & near & (rows[:, chord.LENGTH] <= 1.6 * self.span_m)
        free = rows[:, chord.FREE] == 2.0
        self._refused["hidden at an end by something nearer, or the end of something"] += int((short & ~free).sum())
        for i in np.nonzero(short & free)[0]:
            self._pending.append((self._count, rows[i], int(found.first_ns[i] + found.last_ns[i]) // 2))

    def _judge_pending(self, now_ns: int) -> bool:
        ready = [item for item in self._pending if item[0] <= self._count - DELAY]
        self._pending = self._pending[len(ready) :]
        changed = False
        while ready:
            _, first, _ = ready[0]
            same = [item for item in ready if np.linalg.norm(item[1][:3] - first[:3]) <= 1.2 * self.span_m]
            ready = [item for item in ready if all(item is not other for other in same)]
            changed |= self._take(self._sighting(same), now_ns)
        return changed

    def _sighting(self, same: list[tuple[int, Array64, int]]) -> Sighting:
        rows = np.array([row for _, row, _ in same])
        hits = rows[:, chord.COUNT]
        stamp_ns = same[0][2]
        middle = hits @ rows[:, :3] / hits.sum()
        nearest = min(self._slices, key=lambda s: abs(s.pulses.stamp_ns - stamp_ns))
        range_m = float(rows[:, chord.RANGE].mean())
        tally = np.zeros(TALLY, dtype=np.int64)
        close_m = max(2.4 * self.span_m, 1.15 * BEAM_SPACING_RAD * range_m)  # two beams wide at least
        outer_m = max(self.clear_m, 1.5 * BEAM_SPACING_RAD * range_m)
        for part in self._slices:
            look_around(
                part.pulses.direction_vehicle,
                part.pulses.range_m,
                np.array(part.pulses.origin_vehicle_m),
                middle,
                0.3 * self.span_m,
                1.1 * self.span_m,
                close_m,
                outer_m,
                0.5,
                tally,
            )
        local = nearest.R @ middle + nearest.t
        since_ns = stamp_ns - (3_000_000_000 if self._trail.known else 1_000_000_000)
        extent = float(np.linalg.norm(np.ptp(rows[:, :3], axis=0)))
        whole = rows[:, chord.COUNT] >= 5
        round_ = (rows[:, chord.BULGE] > 1.2) & (rows[:, chord.BULGE] < 9) & (rows[:, chord.ROUGH] < 0.02)
        round_ &= whole & (rows[:, chord.GAPS] <= 1) & (rows[:, chord.DEPTH] > 0.2 * rows[:, chord.LENGTH])
        return Sighting(
            stamp_ns=stamp_ns,
            xyz_local_m=local,
            vehicle_local_m=nearest.t,
            range_m=range_m,
            hits=int(hits.sum()),
            length_m=max(extent, float(rows[:, chord.LENGTH].max())),
            balls=int(round_.sum()),
            rugged=int((whole & ~round_).sum()),
            around=tally.astype(np.float64),
            big_m=self._big.nearest_m(local, 1.1 * self.span_m, self.clear_m, since_ns),
        )

    def _take(self, s: Sighting, now_ns: int) -> bool:
        """Give a sighting to the candidate it fits, or make one of it. True when that is news."""
        best, least = None, 9.0
        for c in self._bank:
            if s.stamp_ns < c.stamp_ns:
                continue
            place, variance = c.predict(s.stamp_ns, 4.0)
            away = float(np.linalg.norm(s.xyz_local_m - place))
            cost = away * away / (variance + 0.15**2)
            if cost < least and away < 2.5:
                best, least = c, cost
        if best is None:
            self._number += 1
            new = Candidate(
                number=self._number,
                first_ns=s.stamp_ns,
                stamp_ns=s.stamp_ns,
                xyz_m=s.xyz_local_m,
                velocity_mps=self._trail.velocity_mps(s.stamp_ns),  # a drone comes along with the vehicle
                range_m=s.range_m,
                p=(0.15**2, 0.0, 6.0**2),
                first_hits=s.hits,
                seen_ns=s.stamp_ns,
            )
            new._note(s)
            new.long_looks += s.length_m > 1.3 * self.span_m
            odds, why = new.judge(self.evidence, self.free_space, self._trail.known)
            if odds < math.log(self.look_again_probability):
                self._refused[_main_reason(why)] += 1
                return False
            self._bank.append(new)
            best = new
        else:
            best.see(s, 0.15, 4.0)
            best.long_looks += s.length_m > 1.3 * self.span_m
        odds, _ = best.judge(self.evidence, self.free_space, self._trail.known)
        return self._news(best, odds)

    def _news(self, c: Candidate, odds: float) -> bool:
        accept = math.log(self.accept_probability / (1 - self.accept_probability))
        again = math.log(self.look_again_probability / (1 - self.look_again_probability))
        if odds >= accept:
            c.accepted = True
        elif odds < accept - 3.0:
            c.accepted = False
        told = 2 if c.accepted else (1 if odds >= again else 0)
        changed = told != c.told or told == 1 or c.worth
        c.told = told
        c.worth |= told > 0
        return changed

    # what was not seen

    def _look_for_misses(self, now_ns: int) -> None:
        part = self._slices[-1]
        origin = np.array(part.pulses.origin_vehicle_m)
        for c in self._bank:
            if not c.told or now_ns - c.seen_ns > 1_500_000_000:
                continue
            place, variance = c.predict(now_ns, 4.0)
            if variance > (0.5 * self.span_m) ** 2:
                continue
            line = part.R.T @ (place - part.t) - origin
            range_m = float(np.linalg.norm(line))
            watch = self._watched.get(c.number)
            if range_m > 0.5 and line @ part.axis > range_m * 0.93:
                tally = np.zeros(TALLY, dtype=np.int64)
                look_around(
                    part.pulses.direction_vehicle, part.pulses.range_m, origin, line + origin, 0.22 * self.span_m,
                    1e9, 1e9, 0.23 * self.span_m, 1.0, tally,
                )  # fmt: skip
                if tally[INNER_HITS] + tally[INNER_PASSES]:
                    if watch is None:
                        watch = self._watched[c.number] = [0.0, 0.0, 0.0]
                    watch[0] += tally[INNER_HITS]
                    watch[1] += tally[INNER_PASSES]
                    watch[2] = now_ns
            elif watch is not None and now_ns - watch[2] > SAME_LOOK_NS:
                if watch[0] == 0 and now_ns - c.seen_ns > 2 * SAME_LOOK_NS:
                    c.miss(watch[1] * min(1.0, (35.0 / c.range_m) ** 2))
                del self._watched[c.number]

    # what is told

    def _report(self, now_ns: int, turntable_rad: float, changed: bool) -> Iterator[Candidates | Detections]:
        if not math.isnan(turntable_rad):
            self._travel.advance(turntable_rad, 0.0)
            if self._travel.whole:
                self._travel.restart(turntable_rad)
                self._end_ns = self._end_ns or now_ns
        accept_new = [c for c in self._bank if c.accepted and c.number not in self._told_accepted]
        if changed or accept_new:
            yield self._candidates(now_ns)
        assert self._start_ns is not None
        if accept_new:
            self._told_accepted.update(c.number for c in accept_new)
            yield self._detections(now_ns)
        elif self._end_ns is not None and now_ns - self._end_ns >= self.settle_s * 1e9:
            yield self._detections(self._end_ns)
        elif (
            now_ns - self._start_ns > self.report_s * 1e9
            and any(c.accepted and c.seen_ns >= self._start_ns for c in self._bank)
        ) or (now_ns - self._start_ns > 3.0 * self.report_s * 1e9 and self._end_ns is None):
            yield self._detections(now_ns)

    def _forget(self, now_ns: int) -> bool:
        """Drop what was not seen for long; what nobody would look at again sooner. True when one that was told goes."""
        long_ns, soon_ns = self.forget_s * 1e9, 0.35e9
        kept = [c for c in self._bank if now_ns - c.seen_ns < (long_ns if c.told else soon_ns)]
        gone = sum(c.told > 0 for c in self._bank) > sum(c.told > 0 for c in kept)
        self._bank = kept
        return gone

    def _candidates(self, now_ns: int) -> Candidates:
        listed = [
            (c.judge(self.evidence, self.free_space, self._trail.known), c)
            for c in self._bank
            if c.told or (c.worth and now_ns - c.seen_ns < 300_000_000)
        ]
        listed.sort(key=lambda item: -item[0][0])
        listed = listed[: self.max_candidates]
        seen = [self._trail.to_vehicle(now_ns, c.predict(now_ns, 0.0)[0], c.velocity_mps) for _, c in listed]
        return Candidates(
            stamp_ns=now_ns,
            candidate_id=np.array([c.number for _, c in listed], dtype=np.int64),
            xyz_vehicle_m=np.array([xyz for xyz, _ in seen]).reshape(-1, 3),
            velocity_vehicle_mps=np.array([v for _, v in seen]).reshape(-1, 3),
            probability=np.array([_probability(odds) for (odds, _), _ in listed], dtype=np.float64),
            seen_ns=np.array([c.seen_ns for _, c in listed], dtype=np.int64),
            looks=np.array([c.hit_looks for _, c in listed], dtype=np.int64),
            reasons=tuple(why for (_, why), _ in listed),
        )

    def _detections(self, end_ns: int) -> Detections:
        assert self._start_ns is not None
        start_ns, self._start_ns, self._end_ns = self._start_ns, end_ns + 1, None
        judged = [
            (*c.judge(self.evidence, self.free_space, self._trail.known), c)
            for c in self._bank
            if c.seen_ns >= start_ns
        ]
        judged.sort(key=lambda item: (not item[2].accepted, -item[0]))
        judged = judged[: self.max_candidates]
        seen = [self._trail.to_vehicle(c.seen_ns, c.xyz_m, c.velocity_mps) for _, _, c in judged]
        xyz = np.array([place for place, _ in seen])
        odds = np.array([o for o, _, _ in judged], dtype=np.float64)
        accepted = np.array([c.accepted for _, _, c in judged], dtype=np.bool_)
        probability = np.array([_probability(o) for o in odds], dtype=np.float64)
        if accepted.any():
            x, y, z = xyz[0]
            verdict = f"drone at ({x:.2f}, {y:.2f}, {z:.2f}) m, {100 * probability[0]:.1f} %: {judged[0][1]}"
            if accepted.sum() > 1:
                verdict += f"; {int(accepted.sum()) - 1} more"
        else:
            refused = ", ".join(f"{n} for '{why}'" for why, n in self._refused.most_common(3) if n)
            best = f"; the best candidate, {100 * probability[0]:.1f} %: {judged[0][1]}" if judged else ""
            verdict = (
                f"no drone: {sum(self._refused.values())} short returns refused at once ({refused or 'none'}){best}"
            )
        self._refused.clear()
        n = len(judged)
        return Detections(
            stamp_ns=end_ns,
            xyz_vehicle_m=xyz.reshape(-1, 3),
            score=odds,
            e_inner=np.zeros(n),
            e_outer=np.zeros(n),
            accepted=accepted,
            reasons=tuple(why for _, why, _ in judged),
            verdict=verdict,
            start_ns=start_ns,
            seen_ns=np.array([c.seen_ns for _, _, c in judged], dtype=np.int64),
            velocity_vehicle_mps=np.array([v for _, v in seen]).reshape(-1, 3),
            probability=probability,
            candidate_id=np.array([c.number for _, _, c in judged], dtype=np.int64),
        )


def _probability(odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-min(max(odds, -500.0), 500.0)))


def _main_reason(why: str) -> str:
    """The reason that counts most, without its numbers."""
    parts = why.split("; ")
    for word in ("stands", "beside", "longer"):
        for part in parts:
            if word in part:
                return part.split(" in ")[0].split(" away")[0] if word != "stands" else "something stands beside it"
    return "too little of it seen"
