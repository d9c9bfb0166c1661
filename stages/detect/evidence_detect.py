"""Detector by evidence: classifies candidates as pulses arrive, each with a probability and its reasons.

    pulses -> chords (chords.py): short, free at both ends, above the horizon
           -> observations (observations.py): one scan pass on one object, and its surroundings (isolation.py)
           -> candidates (candidate.py): observations that fit one moving object (flight.py)
           -> log-odds of a drone over a false return, a static object, a bird and a balloon (trained/model.py)
           -> P = o / (1 + sum of the odds o of all candidates): one of them at most is the drone

A scan pass is one passing of the rotor; they are 0.1 s apart. A candidate is accepted at `accept_probability`. One that
by itself is above `follow_up_probability` is promising and published at once (Candidates), so that the aim can observe
it again. Detections are published when a candidate is accepted, at the end of each pass of the turntable, and at least
every `report_s` while there is a drone.

Source: ours, for P III.B; DESIGN, The graph: detect.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, model_validator

from flow.stage import Settings, Stage
from stages.cues.evidence import CueWeights
from stages.detect.candidate import SAME_PASS_NS, START_SPEED_MPS, Alternative, Candidate, Observation
from stages.detect.candidate_cues import CandidateCues
from stages.detect.candidate_messages import (
    Classified,
    candidate_log,
    candidates_message,
    detections_message,
    log_odds_of,
)
from stages.detect.candidate_table import CandidateTable, positions_of
from stages.detect.observations import ObservationFinder, ObservationLimits, Observations, Slice
from stages.detect.reacquire import reacquired_candidate, without_duplicates
from stages.detect.rejected import Criteria, RejectedObservations
from stages.detect.telemetry import DetectorTelemetry
from stages.detect.trained.existence import passed_nats
from stages.detect.trained.features import FREE_SPACE, features_of
from stages.detect.trained.model import ALTERNATIVES, LEAST_NATS, DetectorModel, Prediction, reasons_of
from stages.geometry.frames import Array64
from stages.geometry.rig_lidar import RigLidar
from stages.geometry.trajectory import VehicleTrajectory
from stages.kernels.detect.candidate import SIGMA_M
from stages.kernels.detect.candidate_table import first_within
from stages.kernels.detect.existence import birth_nats
from stages.kernels.detect.first_observations import STATIC_M
from stages.kernels.detect.observations import X, Z
from stages.kernels.sweep.pulses import cone_of
from stages.messages import (
    CandidateLog,
    Candidates,
    CueState,
    Detections,
    DroneCue,
    DroneLocalPosition,
    DroneMotion,
    DroneOdometry,
    SweptPulses,
    VehicleMotion,
)
from stages.sums import sum_in_order
from stages.sweep.sweep import Travel

PRUNE_PERIOD_NS = 84_300_000  # about twelve times a second
MAX_STATIC = 64  # static objects remembered
# An accepted candidate is rejected this far below the threshold, by the LiDAR alone; for the sake of other candidates
# only where they would be accepted in its place.
HYSTERESIS_NATS = 1.65
AT_REST_MPS = np.zeros(3)
STATIC_NS = 60_000_000_000  # how long a static object is remembered


@dataclass(slots=True)
class _Watch:
    """Pulses through the middle of a candidate in one scan pass."""

    returns: int = 0
    pass_throughs: int = 0
    stamp_ns: int = 0


@dataclass(slots=True)
class _State:
    """State of the detector between messages."""

    finder: ObservationFinder
    travel: Travel
    cues: CandidateCues
    trail: VehicleTrajectory = field(default_factory=VehicleTrajectory)
    telemetry: DetectorTelemetry = field(default_factory=DetectorTelemetry)
    table: CandidateTable = field(default_factory=CandidateTable)
    static: deque[Candidate] = field(default_factory=lambda: deque[Candidate](maxlen=MAX_STATIC))
    static_m: Array64 = field(default_factory=lambda: np.empty((0, 3)))  # their positions
    rejected: RejectedObservations = field(default_factory=RejectedObservations)
    classified: dict[int, Classified] = field(default_factory=dict[int, Classified])  # in this slice
    watches: dict[int, _Watch] = field(default_factory=lambda: dict[int, _Watch]())
    pruned_ns: int = 0
    odometry_jumped: bool = False  # the map frame changed: all positions are invalid
    number: int = 0  # of the newest candidate
    detector_instance: int = 0  # stamp of its first pulse
    start_ns: int | None = None  # of the search not yet reported
    end_ns: int | None = None  # of a pass that is over, not yet reported


class EvidenceDetectSettings(Settings):
    """Settings of `EvidenceDetect`."""

    span_m: float = Field(0.5, gt=0, le=10)  # largest dimension of the drone
    unit: RigLidar = RigLidar()  # model of the LiDAR
    lowest_deg: float = Field(4.0, ge=-30, le=80)  # least elevation of candidates above the LiDAR's horizon
    nearest_m: float = Field(1.5, ge=0.3)  # least range of candidates
    furthest_m: float = Field(65.0, gt=1)  # greatest range of candidates
    clear_m: float = Field(2.0, gt=0.2)  # radius that must be free; a lamp is this far from its pole
    accept_probability: float = Field(0.95, ge=0.5, lt=1)  # at which a candidate is accepted as a drone
    follow_up_probability: float = Field(0.014, gt=0, lt=0.5)  # at which a candidate is published for more observations
    report_s: float = Field(1.0, gt=0.05)  # longest time between messages while a drone is accepted; else 3 times it
    settle_s: float = Field(0.15, ge=0)  # delay of a pass's report, so that its last observations are complete
    sweep_deg: float = Field(180.0, gt=3, le=360)  # travel of the turntable that completes a pass
    forget_s: float = Field(4.0, gt=0)  # a promising candidate is removed this long after its last observation
    max_candidates: int = Field(12, ge=1)  # per published message
    parked: bool = False  # the vehicle does not move: motion is known without VehicleMotion
    free_space: bool = True  # ablation: False ignores the measured surroundings
    cues: CueWeights = CueWeights()  # what GNSS, ranging and barometer may add
    model: DetectorModel  # by `grd train-detector`; configs/models/detector.yaml

    @model_validator(mode="before")
    @classmethod
    def _has_a_model(cls, values: Any) -> Any:
        if isinstance(values, dict) and values.get("model") is None:  # pyright: ignore[reportUnknownMemberType]
            raise ValueError("it has no model: include models/detector.yaml")
        return values  # pyright: ignore[reportUnknownVariableType]

    @model_validator(mode="after")
    def _settings_agree(self) -> EvidenceDetectSettings:
        if self.furthest_m <= self.nearest_m:
            raise ValueError("furthest_m must be larger than nearest_m")
        return self


class EvidenceDetect(Stage[EvidenceDetectSettings]):
    """Accepts small objects that are repeatedly observed with free space around them; rejects others with a reason."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset(
        {"motion", "drone_position", "drone_odometry", "drone_motion", "cue"}
    )

    def __init__(self, settings: EvidenceDetectSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        settings = self.settings
        limits = ObservationLimits(
            settings.span_m,
            math.radians(settings.lowest_deg),
            settings.nearest_m,
            settings.furthest_m,
            settings.clear_m,
        )
        finder = ObservationFinder(limits, settings.unit.profile)
        travel = Travel(math.radians(settings.sweep_deg - 3.0), math.radians(0.5))
        self._accept_nats = log_odds_of(settings.accept_probability)
        self._follow_up_nats = log_odds_of(settings.follow_up_probability)
        cues = CandidateCues(settings.cues, settings.furthest_m, self._accept_nats, self._follow_up_nats)
        self._now = _State(finder, travel, cues)
        self._criteria = Criteria(settings.model, self._follow_up_nats, settings.span_m, settings.free_space)

    def on_motion(self, motion: VehicleMotion) -> None:
        """Update the vehicle's trajectory. Without it only vertical motion counts, unless `parked` is set."""
        self._now.odometry_jumped |= self._now.trail.add(motion)

    def on_drone_position(self, position: DroneLocalPosition) -> None:
        """Add the drone's local position. Without telemetry only the path separates birds and lamps from drones."""
        self._now.telemetry.add_position(position)

    def on_drone_odometry(self, odometry: DroneOdometry) -> None:
        """Add the drone's odometry, from an autopilot that sends it."""
        self._now.telemetry.add_odometry(odometry)

    def on_drone_motion(self, motion: DroneMotion) -> None:
        """Add an interval of the drone's IMU, which is evidence where telemetry is not compared."""
        self._now.telemetry.add_motion(motion)

    def on_cue(self, cue: DroneCue) -> CueState:
        """Add a measurement of another sensor, and compare it with the drones that the LiDAR alone would accept."""
        return self._now.cues.add(cue, self._now.trail, self._now.table)

    def on_pulses(self, pulses: SweptPulses) -> Iterator[CandidateLog | Candidates | Detections]:
        """Process one slice: classify the observations that it completes and publish changes."""
        if pulses.range_m.size == 0:
            return
        now = self._now
        now_ns = int(pulses.point_stamp_ns[-1])
        if now.start_ns is None:
            now.start_ns = now.pruned_ns = now.detector_instance = pulses.stamp_ns
        ends = now.trail.at(pulses.stamp_ns), now.trail.at(now_ns)
        part = Slice(pulses, *cone_of(pulses.direction_vehicle), *ends)
        changed = False
        observations = now.finder.feed(part, now.trail, self._motion_known(now_ns))
        self._count_pass_throughs(now, part, now_ns)
        if now_ns - now.pruned_ns > PRUNE_PERIOD_NS:
            now.pruned_ns = now_ns
            changed = self._prune(now, now_ns)
        if observations is not None:
            changed |= self._associate_all(now, observations)
        if now.classified:
            yield candidate_log(now.classified.values(), now.trail, now_ns, now.detector_instance)
            now.classified.clear()
        yield from self._report(now, now_ns, pulses.turntable_rad, changed)

    def _motion_known(self, stamp_ns: int) -> bool:
        """Whether the vehicle's motion is known, so that static objects are static in the map frame."""
        return self.settings.parked or self._now.trail.known_at(stamp_ns)

    def _associate_all(self, now: _State, s: Observations) -> bool:
        """Reject most observations together, and associate the others one by one. True: publish a change."""
        stamps_ns = s.stamps_ns.tolist()
        known, moves = (
            np.array([flag(stamp_ns) for stamp_ns in stamps_ns]) for flag in (self._motion_known, now.telemetry.moves)
        )
        changed, begin = False, 0
        while begin < len(stamps_ns):
            left = begin
            if not now.cues.known:
                left, log_odds, features = now.rejected.add_first(
                    s, begin, known, moves, now.table, now.static_m, self._criteria
                )
                for k in range(begin, left):
                    now.number += 1
                    xyz_m = s.rows[k, X : Z + 1]
                    now.classified[now.number] = Classified(now.number, stamps_ns[k], xyz_m, log_odds[k], features[k])
            if left < len(stamps_ns):
                changed |= self._associate(now, s.one(left))
            begin = left + 1
        return changed

    def _associate(self, now: _State, s: Observation) -> bool:
        """Assign an observation to the candidate that it fits, or start a new one. True: publish a change."""
        reacquired, other = now.table.best_fits(s)
        if reacquired is not None:
            self._update(now, reacquired, s)
        best = other or self._reactivate(now, s)
        if best is not None:
            return self._update(now, best, s) or reacquired is not None
        near_rejected, revisited = now.rejected.near(s, self._motion_known(s.stamp_ns), now.telemetry.moves(s.stamp_ns))
        # under trees observations are frequent at any position, so that a reacquisition would be by chance
        if reacquired is None and not near_rejected and not math.isfinite(s.large_object_m):
            self._reacquire(now, s)
        now.number += 1
        false_per_s = now.rejected.false_returns.per_s(s.range_m, s.stamp_ns)
        new = Candidate(
            number=now.number,
            stamp_ns=s.stamp_ns,
            seen_ns=s.stamp_ns,
            xyz_m=s.xyz_map_m,
            velocity_mps=AT_REST_MPS,
            range_m=s.range_m,
            p=(SIGMA_M**2, 0.0, START_SPEED_MPS**2),
            first_returns=s.returns,
            first_ns=s.stamp_ns,
            false_per_s=false_per_s,
            existence_nats=birth_nats(false_per_s),
            near_rejected=near_rejected,
            revisited=revisited,
        )
        new.add_observation(s)
        changed = self._classify(now, new)
        if new.is_promising:
            new.velocity_mps = now.trail.velocity_mps(s.stamp_ns)  # a drone follows the vehicle
            now.table.put(new)
        else:
            now.rejected.add(s, new.alternative)
        return changed

    def _predict(self, features: Array64) -> Prediction:
        if not self.settings.free_space:
            features[list(FREE_SPACE)] = math.nan
        return self.settings.model.predict(features)

    def _update(self, now: _State, c: Candidate, s: Observation) -> bool:
        """Update a candidate with an observation. True: publish a change."""
        c.false_per_s = now.rejected.false_returns.per_s(s.range_m, s.stamp_ns)
        c.update(s)
        changed = self._classify(now, c)
        now.table.put(c)
        return changed

    def _reacquire(self, now: _State, s: Observation) -> None:
        """Continue a candidate at an observation at which the drone's odometry predicts it after a pause."""
        if not len(now.table) or not self._motion_known(s.stamp_ns) or not now.telemetry.moves(s.stamp_ns):
            return
        if match := now.telemetry.reacquire(now.table, s):
            now.number += 1
            reacquired = reacquired_candidate(match[0], now.number, s, match[1])
            self._classify(now, reacquired)
            if reacquired.is_promising:
                now.table.put(reacquired)

    def _reactivate(self, now: _State, s: Observation) -> Candidate | None:
        """The remembered static object at this position, as a candidate again; None: there is none."""
        index = first_within(now.static_m, s.xyz_map_m, STATIC_M)
        if index < 0:
            return None
        c = now.static[index]
        del now.static[index]
        now.static_m = positions_of(now.static)
        c.reactivate(s.stamp_ns)
        return c

    def _classify(self, now: _State, c: Candidate) -> bool:
        """Classify a candidate again. True: publish a change."""
        motion_known = self._motion_known(c.seen_ns)
        log_ratios = now.telemetry.of(c, motion_known)
        c.add_log_ratios(log_ratios)
        # the odometry was made with the same IMU: it counts once
        c.imu_log_ratios = now.telemetry.by_imu(c, motion_known) if log_ratios is None else None
        c.features = features_of(c, self.settings.span_m, motion_known)
        prediction = self._predict(c.features)
        c.alternative = ALTERNATIVES[prediction.alternative]
        c.single_log_odds = c.own_log_odds = prediction.log_odds
        remark = now.cues.add_to(c, now.trail, now.table)
        others_nats = self._others_nats(now, c)
        c.log_odds = c.single_log_odds - others_nats
        if others_nats >= LEAST_NATS:
            remark += f"; other candidates {-others_nats:+.1f}"
        now.classified[c.number] = Classified(c.number, c.seen_ns, c.path_m[-1], c.log_odds, c.features)
        accept = self._accept_nats
        least = accept - HYSTERESIS_NATS
        kept = c.own_log_odds >= least and c.own_log_odds - others_nats >= min(least, -accept)
        c.accepted = c.log_odds >= accept or (c.accepted and kept)
        before, c.is_promising = c.is_promising, c.single_log_odds >= self._follow_up_nats
        c.was_promising |= c.is_promising
        named = c.is_promising or c.observations > 1  # others are rejected at once
        c.reason = (reasons_of(c.features, prediction) if named else "") + remark
        return c.was_promising or before != c.is_promising

    def _others_nats(self, now: _State, c: Candidate) -> float:
        """What other candidates take from the log-odds: one at most is the drone, P = o / (1 + sum of all odds o)."""
        rivals = now.table.rivals_of(c, self.settings.clear_m)
        return math.log1p(sum_in_order([math.exp(other.single_log_odds) for other in rivals]))

    def _count_pass_throughs(self, now: _State, part: Slice, now_ns: int) -> None:
        """Count the pulses that pass through a candidate's predicted position, scan pass by scan pass."""
        origin_m, disc_m = np.array(part.pulses.origin_vehicle_m), 0.22 * self.settings.span_m
        for c, returns, pass_throughs, outside in now.table.pass_throughs_of(
            part, origin_m, disc_m, (0.5 * self.settings.span_m) ** 2
        ):
            if not outside:
                watch = now.watches.setdefault(c.number, _Watch())
                watch.returns += returns
                watch.pass_throughs += pass_throughs
                watch.stamp_ns = now_ns
                continue
            watch = now.watches.get(c.number)
            if watch is not None and now_ns - watch.stamp_ns > SAME_PASS_NS:
                if watch.returns == 0 and now_ns - c.seen_ns > 2 * SAME_PASS_NS:
                    c.existence_nats += passed_nats(c.range_m, watch.pass_throughs)
                    self._classify(now, c)
                    now.table.put(c)
                del now.watches[c.number]

    def _prune(self, now: _State, now_ns: int) -> bool:
        """Remove candidates without recent observations, rejected ones sooner. True: a published one is removed."""
        if now.odometry_jumped:
            return self._reset(now)
        kept = without_duplicates(c for c in now.table if now_ns - c.seen_ns < self._retention_ns(c))
        for c in now.table:
            if now_ns - c.seen_ns >= self._retention_ns(c):
                if c.scan_passes == 1:
                    now.rejected.false_returns.add(c.range_m, now_ns)
                if not c.is_promising:
                    self._remember_rejected(now, c)
        if self._motion_known(now_ns):
            now.static.extend(c for c in now.table if now_ns - c.seen_ns >= self._retention_ns(c) and c.is_static)
        while now.static and now_ns - now.static[0].seen_ns > STATIC_NS:
            now.static.popleft()
        now.static_m = positions_of(now.static)
        gone = len({c.number for c in now.table if c.is_promising} - {c.number for c in kept}) > 0
        now.table.keep(kept)
        now.watches = {c.number: now.watches[c.number] for c in kept if c.number in now.watches}
        return gone

    def _reset(self, now: _State) -> bool:
        """Remove everything: after a jump of the vehicle's odometry no position in the map frame is valid."""
        gone = any(c.is_promising for c in now.table)
        now.odometry_jumped, now.static_m = False, positions_of(())
        now.rejected.forget_positions()
        now.table.keep(())
        now.static.clear()
        now.watches.clear()
        now.cues.reset()
        return gone

    def _remember_rejected(self, now: _State, c: Candidate) -> None:
        """Remember the position of a rejected static object."""
        if c.alternative is Alternative.STATIC and (c.scan_passes < 3 or c.is_static):
            now.rejected.static_map.add(c.xyz_m[None], c.seen_ns)

    def _retention_ns(self, c: Candidate) -> float:
        """How long a candidate is kept without an observation."""
        if c.is_promising:
            return self.settings.forget_s * 1e9
        return 1.5e9 if c.scan_passes >= 3 else 0.35e9

    def _report(
        self, now: _State, now_ns: int, turntable_rad: float, changed: bool
    ) -> Iterator[Candidates | Detections]:
        settings = self.settings
        if not math.isnan(turntable_rad):
            now.travel.advance(turntable_rad, 0.0)
            if now.travel.whole:
                now.travel.restart(turntable_rad)
                now.end_ns = now.end_ns or now_ns
        accepted = [c for c in now.table if c.accepted]
        new = [c for c in accepted if not c.announced]
        if changed or new:
            listed = [c for c in now.table if c.is_promising or (c.was_promising and now_ns - c.seen_ns < 300_000_000)]
            motion = now.telemetry.expected_motion(now.trail, now_ns)
            limits = settings.max_candidates, settings.accept_probability
            yield candidates_message(listed, now.trail, now_ns, now.detector_instance, *limits, *motion)
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
        rejected = now.rejected.kinds + now.finder.hidden
        yield detections_message(now.table, now.trail, now.start_ns, end_ns, rejected, settings.max_candidates)
        for c in new:
            c.announced = True
        now.start_ns, now.end_ns = end_ns + 1, None
        now.rejected.kinds.clear()
        now.finder.hidden.clear()
