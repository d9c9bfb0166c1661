"""Aiming of beams: sweeps without gaps, observes candidates until they are classified, and keeps a beam on each track.

    no track, no candidate     sweep the whole travel, back and forth; of a cue first its sector (search_sector.py)
    candidate                  point beams at it and around it until the detector has classified it, then continue
    TRACKING                   each rotor turn points one beam at the predicted position, with small alternating offsets
    COASTING                   the offsets grow with the uncertainty; above `coast_sigma_m` sweep
    several drones             a few observations of each, the longest unobserved first; fewer tracks than expected: a
                               segment of the sweep between them

Each drone has a chain of stages. That of the first has the ports `state` and `candidates`, the others `state_2`,
`candidates_2` and so on. The tracks of two chains that follow one object count as one.

The rotor's azimuth determines when it passes a direction next. The table moves between two passes and stands still
during a pass, so that the offsets are chosen and do not depend on the beat of two periods. Of all beams that can be
pointed at the position, the one of least movement near the fan's middle is used.

Source: ours, for P III.A and III.C.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, model_validator

from flow.stage import Settings, Stage
from stages.aim.beams import (
    Rotor,
    best_pointing,
    low_discrepancy,
    nearest_pointing,
    rotor_azimuth_rad,
    sweep_step_rad,
)
from stages.aim.search_offset import MissedObservation, best_offset_m
from stages.aim.search_sector import SearchSector
from stages.aim.sweep_trajectory import SweepTrajectory
from stages.aim.targets import Key, Target, Targets
from stages.geometry.frames import LidarMount
from stages.geometry.rig_lidar import RigLidar
from stages.messages import Candidates, CueState, LidarFirings, ServoGoal, ServoState, TrackState
from stages.sweep.turntable import GearPlay

RESULT_NS = 20_000_000  # from a pass to the output about it: PASS_OVER_NS of the tracker, a slice, a servo period
SLICE_NS = 12_000_000  # longest slice that RESULT_NS includes: 10 ms in whole packets; longer ones delay the output
MIN_OBSERVATION_NS = 5_000_000
INITIAL_PASS_S = 0.05  # first estimate of the time to the rotor's next pass
INNER_RAD = math.radians(8.0)  # beams with a larger elevation are used only when others need much more movement
SWEEP_DEVIATION_RAD = math.radians(12.0)  # of an observation during the sweep; the fan is 30 deg wide
FRESH_NS = 350_000_000  # a candidate with a return this recent may be observed during the sweep
MAX_MISSED = 24  # missed observations that are remembered; older ones are obsolete, the drone moves
HALF_DETECTION = 0.3  # of the span: a beam so far from its middle has half the detection probability
RPM_RADPS = math.tau / 60.0
MAX_DRONES = 8


@dataclass(slots=True, eq=False)
class _State:
    sweep: SweepTrajectory
    play: GearPlay
    rotor: Rotor
    sector: SearchSector
    servo_rad: float | None = None
    elevations_rad: tuple[float, ...] = ()
    slice_ns: int = 0  # length of the last slice
    targets: Targets = field(default_factory=Targets)
    hold_until_ns: int = 0  # end of the planned observation
    current: Key | None = None  # target of the planned observation
    consecutive: int = 0  # further observations of the current target after its first
    searching: bool = False  # for more drones, between observations of tracks
    search_until_ns: int = 0
    track_observations: int = 0  # since the last search segment

    @property
    def spacing_rad(self) -> float:
        """Angle between two beams of the fan."""
        w = self.elevations_rad
        return (w[-1] - w[0]) / (len(w) - 1) if len(w) > 1 else math.tau


class BeamAimSettings(Settings):
    """Settings of `BeamAim`."""

    mount: LidarMount  # poses of turntable and LiDAR, and the servo's zero, sign and errors
    unit: RigLidar = RigLidar()  # azimuth offsets of the lasers
    span_m: float = Field(0.5, gt=0, le=10)  # largest dimension of the drone
    travel_deg: tuple[float, float] = (0.0, 180.0)  # servo positions that may be commanded
    limit_rpm: float = Field(55.0, gt=0)  # maximum servo speed; MX-28AR at 12 V
    search_rpm: float = Field(20.0, gt=0)  # of the sweep, adjusted so that the beams cover all directions
    latency_s: float = Field(0.03, ge=0)  # from a goal to the start of the servo's movement
    settle_s: float = Field(0.015, ge=0)  # from arrival at the goal to standstill
    max_observations: int = Field(25, ge=1)  # of a candidate; then it is excluded for `cooldown_s`
    cooldown_s: float = Field(1.0, gt=0)  # doubles with each repetition, up to 16-fold
    min_probability: float = Field(0.014, ge=0, lt=1)  # candidates with a lower one are ignored
    stop_probability: float = Field(0.3, ge=0, le=1)  # with it and `stop_scan_passes` a candidate interrupts the sweep
    stop_scan_passes: int = Field(2, ge=1)  # scan passes with returns, needed to interrupt the sweep
    max_missed: int = Field(8, ge=1, le=MAX_MISSED)  # consecutive misses of a candidate of probability 1; else fewer
    sweep_observations: int = Field(3, ge=0)  # of a candidate, without an interruption of the sweep
    observations_per_track: int = Field(3, ge=1)  # consecutive ones of each track, if there are several
    # expected drones, at least one a chain; with fewer tracks the search continues between observations of tracks
    max_drones: int = Field(1, ge=1, le=MAX_DRONES)
    search_s: float = Field(0.35, gt=0)  # duration of a search segment between observations of tracks
    beams: bool = True  # point a beam at the drone; False (ablation): the middle of the fan
    coast_sigma_m: float = Field(3.0, gt=0)  # a track with a larger position sigma is searched with the full sweep

    @model_validator(mode="after")
    def _settings_agree(self) -> BeamAimSettings:
        if self.travel_deg[1] <= self.travel_deg[0]:
            raise ValueError("travel_deg must be two increasing angles")
        return self


class BeamAim(Stage[BeamAimSettings]):
    """Keeps a beam on each tracked drone, and searches while there are fewer than expected."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"candidates", "cue"}).union(
        f"{port}_{chain}" for port in ("state", "candidates") for chain in range(2, MAX_DRONES + 1)
    )

    def __init__(self, settings: BeamAimSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        rotor = Rotor(self.settings.unit.azimuth_offset_rad, self.settings.unit.azimuth_delay_ns)
        mount, travel_rad = self.settings.mount, self._travel_rad
        self._state = _State(SweepTrajectory(*travel_rad), GearPlay(mount), rotor, SearchSector(mount, travel_rad))

    @property
    def _travel_rad(self) -> tuple[float, float]:
        return math.radians(self.settings.travel_deg[0]), math.radians(self.settings.travel_deg[1])

    def on_firings(self, firings: LidarFirings) -> None:
        """Update the rotor's azimuth and rate, and the length of a slice."""
        self._state.rotor.update(firings)
        if firings.pulse_stamp_ns.size:
            self._state.slice_ns = int(firings.pulse_stamp_ns[-1] - firings.pulse_stamp_ns[0])
        if not self._state.elevations_rad:
            self._state.elevations_rad = tuple(sorted(float(w) for w in firings.laser_elevation_rad))

    def on_candidates(self, candidates: Candidates) -> None:
        """Update the candidates that need further observations."""
        self._state.targets.update_candidates(candidates, self.settings.min_probability)

    def on_state(self, state: TrackState) -> None:
        """Update a track's predicted position."""
        self._state.targets.update_track(state)

    def on_cue(self, cue: CueState) -> None:
        """Update the sector to search, by a cue that gives a position and is trusted."""
        if cue.xyz_vehicle_m is not None and cue.covariance_m2 is not None:
            self._state.sector.update(cue.source, cue.stamp_ns, cue.xyz_vehicle_m, cue.covariance_m2)
        elif not cue.trusted:
            self._state.sector.withdraw(cue.source)

    def on_servo(self, servo: ServoState) -> ServoGoal | None:
        """A new goal at the end of the planned observation, or at once when the target changes; else None."""
        state = self._state
        if not self.settings.mount.turns:
            return None
        if state.servo_rad is not None:
            state.play.move(math.remainder(servo.position_rad - state.servo_rad, math.tau))
        state.servo_rad = servo.position_rad
        target = self._choose(servo)
        if target is None or state.rotor.rate_radps <= 0 or not state.elevations_rad:
            if state.current is not None:
                state.current = None
                state.sweep.stop()
            return self._sweep(servo)
        planned = state.targets.get(state.current)
        if servo.stamp_ns < state.hold_until_ns and planned is not None and (planned is target or target.keeps_sweep):
            return None
        return self._observe(servo, target)

    # choice of the target

    def _choose(self, servo: ServoState) -> Target | None:
        """The target of the next observation, or None to sweep."""
        settings = self.settings
        state = self._state
        state.targets.expire(servo.stamp_ns, settings.max_observations, settings.cooldown_s)
        tracks = state.targets.tracks(settings.coast_sigma_m)
        if not tracks or len(tracks) >= max(settings.max_drones, len(state.targets.chains)):
            state.searching, state.track_observations, state.sweep.resume_rad = False, 0, None
        elif self._search_is_due(len(tracks), servo):
            return self._choose_candidate(servo.stamp_ns)
        if not tracks:
            return self._choose_candidate(servo.stamp_ns)
        current = state.targets.get(state.current)
        if current in tracks and (len(tracks) == 1 or state.consecutive < settings.observations_per_track):
            return current
        return min(tracks, key=lambda t: (t.observed_ns, t.key))

    def _search_is_due(self, track_count: int, servo: ServoState) -> bool:
        """Whether each track had `observations_per_track` observations, so that a segment of the sweep follows."""
        settings = self.settings
        state = self._state
        if state.searching and servo.stamp_ns < state.search_until_ns:
            return True
        resume_rad = state.sweep.resume_rad
        if state.searching:
            state.searching, state.track_observations = False, 0
            state.sweep.resume_rad = resume_rad = servo.position_rad
        due = state.track_observations >= settings.observations_per_track * track_count
        if due and servo.stamp_ns >= state.hold_until_ns:
            distance_rad = 0.0 if resume_rad is None else abs(resume_rad - servo.position_rad)
            state.searching = True
            state.search_until_ns = servo.stamp_ns + round(
                (settings.search_s + distance_rad / (settings.limit_rpm * RPM_RADPS)) * 1e9
            )
        return state.searching

    def _choose_candidate(self, stamp_ns: int) -> Target | None:
        """The candidate that interrupts the sweep, else one to observe during the sweep, else None."""
        settings = self.settings
        state = self._state
        candidates = state.targets.candidates(stamp_ns)
        current = state.targets.get(state.current)
        stopping = [
            t
            for t in candidates
            if t.probability >= settings.stop_probability and t.scan_passes >= settings.stop_scan_passes
        ]
        if current in stopping and not current.keeps_sweep:
            least = 0.5 * settings.stop_probability  # the probability at which no miss is allowed
            if len(current.missed) < settings.max_missed * (current.probability - least) / (1.0 - least):
                return current
            state.targets.exclude(current, stamp_ns, settings.cooldown_s)  # it has gone, or is most likely no drone
            stopping.remove(current)
            candidates.remove(current)
        if stopping:
            best = max(stopping, key=lambda t: (t.probability / (1.0 + t.observations), t.key))
            best.keeps_sweep = False
            return best
        # During the sweep each rotor turn points a beam at a candidate with a recent return.
        fresh = [
            t for t in candidates if t.observations < settings.sweep_observations and stamp_ns - t.seen_ns < FRESH_NS
        ]
        for target in fresh:
            target.keeps_sweep = True
        return max(fresh, key=lambda t: (t.probability / (1.0 + t.observations), t.key), default=None)

    # one observation

    def _observe(self, servo: ServoState, target: Target) -> ServoGoal | None:
        """The servo goal that points a beam at the target when the rotor passes it next."""
        settings = self.settings
        state = self._state
        state.consecutive = state.consecutive + 1 if state.current == target.key else 0
        state.current = target.key
        state.sweep.stop()
        start_rad, inner_rad = servo.position_rad, INNER_RAD
        if target.keeps_sweep:
            step_rad = self._search_radps() * math.tau / state.rotor.rate_radps
            start_rad, inner_rad = state.sweep.advance(servo.position_rad, step_rad), math.inf
        else:
            state.sweep.nominal_rad = None
        T, T_tl = settings.mount.T_vehicle_turntable.matrix(), settings.mount.T_turntable_lidar.matrix()
        speed_radps, travel_rad = settings.limit_rpm * RPM_RADPS, self._travel_rad
        elevations_rad = state.elevations_rad if settings.beams else (0.0,)
        offset_m, goal_rad, pass_ns = 0.0, 0.0, servo.stamp_ns + round((settings.latency_s + INITIAL_PASS_S) * 1e9)
        for _ in range(2):  # the position at the pass depends on the time of the pass
            p_turntable_m = T[:3, :3].T @ (target.at(pass_ns) - T[:3, 3])
            range_m = max(float(np.linalg.norm(p_turntable_m - T_tl[:3, 3])), 0.5)
            offset_m = self._offset_m(target, range_m, pass_ns)
            offset_rad = offset_m / range_m
            best = best_pointing(
                settings.mount, travel_rad, elevations_rad, start_rad, p_turntable_m, offset_rad, inner_rad
            )
            if best is None and settings.beams:
                best = nearest_pointing(settings.mount, travel_rad, p_turntable_m)
            if best is None:
                return self._sweep(servo)
            goal_rad = state.play.goal_rad(servo.position_rad, best.servo_rad)
            goal_rad = min(max(goal_rad, travel_rad[0]), travel_rad[1])
            if target.keeps_sweep and abs(best.servo_rad - start_rad) > SWEEP_DEVIATION_RAD:
                target.observations = settings.sweep_observations  # the fan has passed it
                return self._sweep(servo)
            move_s = abs(goal_rad - servo.position_rad) / speed_radps
            ready_ns = servo.stamp_ns + round((settings.latency_s + settings.settle_s + move_s) * 1e9)
            pass_ns = state.rotor.next_pass_ns(rotor_azimuth_rad(T_tl, p_turntable_m, best.table_rad), ready_ns)
        target.missed.append(MissedObservation(target.spread_m(pass_ns), offset_m))  # until it has a return
        del target.missed[:-MAX_MISSED]
        target.observations, target.observed_ns = target.observations + 1, servo.stamp_ns
        state.track_observations += target.is_track
        result_ns = RESULT_NS + max(state.slice_ns - SLICE_NS, 0)
        state.hold_until_ns = max(pass_ns + result_ns, servo.stamp_ns + MIN_OBSERVATION_NS)
        return ServoGoal(stamp_ns=servo.stamp_ns, position_rad=goal_rad, speed_radps=speed_radps)

    def _offset_m(self, target: Target, range_m: float, pass_ns: int) -> float:
        """Offset [m] of the beam from the predicted position.

        A target whose last observation had returns gets small offsets to either side: returns from its edges determine
        its position. Without offsets the beam would always hit a candidate at the same edge, and a wire along the
        beam's movement would appear to move. A target that was missed, or has returns of only one scan pass, gets the
        offset with the highest detection probability.
        """
        settings = self.settings
        if not target.missed and (target.is_track or (target.observations and not target.undirected_speed_mps)):
            amplitude_m = 0.175 * settings.span_m * min(1.0, 20.0 / range_m)
            if target.is_track:
                amplitude_m = (0.06 + 0.35 * min(1.0, 10.0 / range_m)) * settings.span_m + 0.35 * target.sigma_m
            return amplitude_m * low_discrepancy(target.observations % 16)
        spread_m, heading_unknown = target.spread_m(pass_ns), target.undirected_speed_mps > 0.0
        spacing_m = self._state.spacing_rad * range_m
        return best_offset_m(spread_m, heading_unknown, target.missed, spacing_m, HALF_DETECTION * settings.span_m)

    # sweep

    def _sweep(self, servo: ServoState) -> ServoGoal | None:
        state, limit_radps = self._state, self.settings.limit_rpm * RPM_RADPS
        if state.searching:  # the sector is that of a drone that has a track
            state.sweep.limit(*self._travel_rad)
        else:
            state.sweep.limit(*state.sector.limits(servo.stamp_ns, state.sweep.passes))
        is_sector = (state.sweep.low_rad, state.sweep.high_rad) != self._travel_rad
        resume_radps = limit_radps if state.searching else None
        approach_radps = limit_radps if is_sector else None
        goal = state.sweep.goal(servo.stamp_ns, servo.position_rad, self._search_radps(), resume_radps, approach_radps)
        if goal is None:
            return None
        return ServoGoal(stamp_ns=servo.stamp_ns, position_rad=goal[0], speed_radps=goal[1])

    def _search_radps(self) -> float:
        """Servo speed of the sweep, at which the beams cover all directions."""
        state = self._state
        limit_radps, wanted_radps = self.settings.limit_rpm * RPM_RADPS, self.settings.search_rpm * RPM_RADPS
        if state.rotor.rate_radps <= 0 or len(state.elevations_rad) < 2:
            return min(wanted_radps, limit_radps)
        turn_s = math.tau / state.rotor.rate_radps
        return min(sweep_step_rad(state.spacing_rad, wanted_radps * turn_s) / turn_s, limit_radps)


def _add_ports(chain: int) -> None:
    """Add the ports of a further drone's chain."""

    def on_state(self: BeamAim, state: TrackState) -> None:
        self._state.targets.update_track(state, chain)  # pyright: ignore[reportPrivateUsage]

    def on_candidates(self: BeamAim, candidates: Candidates) -> None:
        self._state.targets.update_candidates(candidates, self.settings.min_probability, chain)  # pyright: ignore[reportPrivateUsage]

    for port, message, handler in (("state", TrackState, on_state), ("candidates", Candidates, on_candidates)):
        handler.__annotations__ = {port: message, "return": None}  # the port's declaration, without `self`
        setattr(BeamAim, f"on_{port}_{chain}", handler)


for _chain in range(2, MAX_DRONES + 1):
    _add_ports(_chain)
