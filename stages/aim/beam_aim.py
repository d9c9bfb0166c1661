"""Aim beams: sweep without blind spots, stop at what may be a drone, and then keep a beam on it, turn after turn.

    no track, no candidate     sweep the whole travel, there and back
    candidate                  look at it and at what is around it until the detector has decided, then go on
    TRACKING, COASTING         each turn of the rotor one beam on the predicted place, a little beside it in turn;
                               while coasting farther and farther beside it, then sweep
    several drones             a few turns for each in turn; fewer than expected: a piece of the sweep between

The rotor's azimuth says when it passes a direction next. The table is moved between two passes and stands still when
the rotor passes, so that offsets are chosen, not left to a beat between two periods. Of all beams that can be put on
the place the one is taken that needs the least movement and lies near the fan's middle.

Source: ours, for P III.A and III.C.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, model_validator

from flow.stage import Settings, Stage
from stages.aim.beams import Rotor, cheapest, low_discrepancy, nearest, rotor_azimuth_rad, sweep_step_rad
from stages.aim.search_offset import Look, best_offset_m
from stages.aim.sweeping import Sweeping
from stages.aim.targets import Key, Target, Targets
from stages.geometry.frames import LidarMount
from stages.messages import Candidates, LidarFirings, ServoGoal, ServoState, TrackState
from stages.sweep.turntable import GearPlay

TOLD_NS = 12_000_000  # after its pass a look has been told of
SHORTEST_LOOK_NS = 5_000_000
FIRST_GUESS_S = 0.05  # to the rotor's next pass
INNER_RAD = math.radians(8.0)
GLANCE_RAD = math.radians(12.0)  # beside the sweep: its fan is 30 deg wide
FRESH_NS = 350_000_000  # met a moment ago
MOST_TRIED = 24  # looks that missed are remembered; it flies on
HALF_SHARE = 0.3  # of its span: a beam so far from its middle meets it now and then
RPM_RADPS = math.tau / 60.0


@dataclass(slots=True, eq=False)
class _Now:
    sweeping: Sweeping
    play: GearPlay
    rotor: Rotor = field(default_factory=Rotor)
    servo_rad: float | None = None
    elevations_rad: tuple[float, ...] = ()
    targets: Targets = field(default_factory=Targets)
    hold_until_ns: int = 0  # a look is planned until then
    current: Key | None = None
    turns: int = 0  # in a row for the current one
    searching: bool = False  # for more drones, between looks at those there are
    search_until_ns: int = 0
    served: int = 0  # looks at tracks since the last piece of the search

    @property
    def spacing_rad(self) -> float:
        """Between two beams of the fan."""
        w = self.elevations_rad
        return (w[-1] - w[0]) / (len(w) - 1) if len(w) > 1 else math.tau


class BeamAimSettings(Settings):
    """Settings of `BeamAim`."""

    mount: LidarMount
    span_m: float = Field(0.5, gt=0, le=10)
    travel_deg: tuple[float, float] = (0.0, 180.0)
    limit_rpm: float = Field(55.0, gt=0)  # MX-28AR at 12 V
    search_rpm: float = Field(20.0, gt=0)  # about; adjusted to the rotor so that no direction is left out
    lead_s: float = Field(0.03, ge=0)  # from deciding to the servo's obeying
    settle_s: float = Field(0.015, ge=0)  # from arriving to standing still
    candidate_looks: int = Field(25, ge=1)  # then it is left alone for `candidate_rest_s`
    candidate_rest_s: float = Field(1.0, gt=0)
    candidate_probability: float = Field(0.014, ge=0, lt=1)  # less is not worth stopping for
    stop_probability: float = Field(0.3, ge=0, le=1)  # more, met `stop_looks` times, interrupts the sweep
    patience: int = Field(8, ge=1, le=MOST_TRIED)  # looks in a row that missed a sure candidate; fewer, if doubtful
    stop_looks: int = Field(2, ge=1)  # it was seen in so many turns of the rotor before it interrupts the sweep
    glances: int = Field(3, ge=0)  # at a candidate in passing
    turns_each: int = Field(3, ge=1)  # for each of several drones
    max_drones: int = Field(1, ge=1, le=8)  # with fewer tracks the search goes on between looks at them
    search_s: float = Field(0.35, gt=0)  # at a time
    beams: bool = True  # ablation: without, the middle of the fan is put on the drone
    coast_sigma_m: float = Field(3.0, gt=0)  # less known while coasting, the whole travel is swept

    @model_validator(mode="after")
    def _settings_agree(self) -> BeamAimSettings:
        if self.travel_deg[1] <= self.travel_deg[0]:
            raise ValueError("travel_deg must be two growing angles")
        return self


class BeamAim(Stage[BeamAimSettings]):
    """Keeps a beam on the drone; searches when there is none."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"candidates"})

    def __init__(self, settings: BeamAimSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._now = _Now(Sweeping(*self._travel_rad), GearPlay(self.settings.mount))

    @property
    def _travel_rad(self) -> tuple[float, float]:
        return math.radians(self.settings.travel_deg[0]), math.radians(self.settings.travel_deg[1])

    def on_firings(self, firings: LidarFirings) -> None:
        """Keep track of the rotor."""
        self._now.rotor.hear(firings)
        if not self._now.elevations_rad:
            self._now.elevations_rad = tuple(sorted(float(w) for w in firings.laser_elevation_rad))

    def on_candidates(self, candidates: Candidates) -> None:
        """What is worth another look now."""
        self._now.targets.hear_candidates(candidates, self.settings.candidate_probability)

    def on_state(self, state: TrackState) -> None:
        """Where each track is predicted."""
        self._now.targets.hear_state(state)

    def on_servo(self, servo: ServoState) -> ServoGoal | None:
        """A new goal when the last look is over, or at once when something else is to be done."""
        now = self._now
        if not self.settings.mount.turns:
            return None
        if now.servo_rad is not None:
            now.play.move(math.remainder(servo.position_rad - now.servo_rad, math.tau))
        now.servo_rad = servo.position_rad
        target = self._choose(servo)
        if target is None or now.rotor.rate_radps <= 0 or not now.elevations_rad:
            if now.current is not None:
                now.current = None
                now.sweeping.stop()
            return self._sweep(servo)
        planned = now.targets.get(now.current)
        if servo.stamp_ns < now.hold_until_ns and planned is not None and (planned is target or target.glance):
            return None
        return self._look(servo, target)

    # what to look at

    def _choose(self, servo: ServoState) -> Target | None:
        settings = self.settings
        now = self._now
        now.targets.tidy(servo.stamp_ns, settings.candidate_looks, settings.candidate_rest_s)
        tracks = now.targets.tracks(settings.coast_sigma_m)
        if not tracks or len(tracks) >= settings.max_drones:
            now.searching, now.served, now.sweeping.left_off_rad = False, 0, None
        elif self._searches_on(len(tracks), servo):
            return self._candidate(servo.stamp_ns)
        if not tracks:
            return self._candidate(servo.stamp_ns)
        current = now.targets.get(now.current)
        if current in tracks and (len(tracks) == 1 or now.turns < settings.turns_each):
            return current
        after = [t for t in tracks if now.current is not None and t.key > now.current]
        return (after or tracks)[0]

    def _searches_on(self, tracks: int, servo: ServoState) -> bool:
        """Whether each track has had its turns: time for a piece of the sweep, from where the last one ended."""
        settings = self.settings
        now = self._now
        if now.searching and servo.stamp_ns < now.search_until_ns:
            return True
        left_off = now.sweeping.left_off_rad
        if now.searching:
            now.searching, now.served = False, 0
            now.sweeping.left_off_rad = left_off = servo.position_rad
        if now.served >= settings.turns_each * tracks and servo.stamp_ns >= now.hold_until_ns:
            way_rad = 0.0 if left_off is None else abs(left_off - servo.position_rad)
            now.searching = True
            now.search_until_ns = servo.stamp_ns + round(
                (settings.search_s + way_rad / (settings.limit_rpm * RPM_RADPS)) * 1e9
            )
        return now.searching

    def _candidate(self, now_ns: int) -> Target | None:
        """The one to stop at, else the one to glance at in passing; None: sweep on."""
        settings = self.settings
        now = self._now
        maybe = now.targets.candidates(now_ns)
        current = now.targets.get(now.current)
        worth = [t for t in maybe if t.probability >= settings.stop_probability and t.seen_looks >= settings.stop_looks]
        if current in worth and not current.glance:
            doubtful = 0.5 * settings.stop_probability  # so improbable it has none
            if len(current.tried) < settings.patience * (current.probability - doubtful) / (1.0 - doubtful):
                return current
            now.targets.leave(current, now_ns, settings.candidate_rest_s)  # not there, or most likely something else
            worth.remove(current)
            maybe.remove(current)
        if worth:
            best = max(worth, key=lambda t: (t.probability / (1.0 + t.looks), t.key))
            best.glance = False
            return best
        # the sweep goes on by steps: each turn of the rotor a beam is put on something that was met a moment ago
        fresh = [t for t in maybe if t.looks < settings.glances and now_ns - t.heard_ns < FRESH_NS]
        for target in fresh:
            target.glance = True
        return max(fresh, key=lambda t: (t.probability / (1.0 + t.looks), t.key), default=None)

    # one look

    def _look(self, servo: ServoState, target: Target) -> ServoGoal | None:
        settings = self.settings
        now = self._now
        now.turns = now.turns + 1 if now.current == target.key else 0
        now.current = target.key
        now.sweeping.stop()
        centre_rad, inner_rad = servo.position_rad, INNER_RAD
        if target.glance:
            step_rad = self._search_radps() * math.tau / now.rotor.rate_radps
            centre_rad, inner_rad = now.sweeping.glance_from(servo.position_rad, step_rad), math.inf
        else:
            now.sweeping.beside_rad = None
        T, T_tl = settings.mount.T_vehicle_turntable.matrix(), settings.mount.T_turntable_lidar.matrix()
        speed_radps, travel_rad = settings.limit_rpm * RPM_RADPS, self._travel_rad
        elevations_rad = now.elevations_rad if settings.beams else (0.0,)
        offset_m, goal_rad, pass_ns = 0.0, 0.0, servo.stamp_ns + round((settings.lead_s + FIRST_GUESS_S) * 1e9)
        for _ in range(2):  # the place at the pass depends on when that is
            place = T[:3, :3].T @ (target.at(pass_ns) - T[:3, 3])
            range_m = max(float(np.linalg.norm(place - T_tl[:3, 3])), 0.5)
            offset_m = self._offset_m(target, range_m, pass_ns)
            offset_rad = offset_m / range_m
            best = cheapest(settings.mount, travel_rad, elevations_rad, centre_rad, place, offset_rad, inner_rad)
            if best is None and settings.beams:
                best = nearest(settings.mount, travel_rad, place)
            if best is None:
                return self._sweep(servo)
            goal_rad = now.play.goal_rad(servo.position_rad, best.servo_rad)
            goal_rad = min(max(goal_rad, travel_rad[0]), travel_rad[1])
            if target.glance and abs(best.servo_rad - centre_rad) > GLANCE_RAD:
                target.looks = settings.glances  # the fan has passed it
                return self._sweep(servo)
            way_s = abs(goal_rad - servo.position_rad) / speed_radps
            ready_ns = servo.stamp_ns + round((settings.lead_s + settings.settle_s + way_s) * 1e9)
            pass_ns = now.rotor.next_pass_ns(rotor_azimuth_rad(T_tl, place, best.table_rad), ready_ns)
        target.tried.append(Look(target.reach_m(pass_ns), offset_m))
        del target.tried[:-MOST_TRIED]
        target.looks += 1
        now.served += target.sure
        now.hold_until_ns = max(pass_ns + TOLD_NS, servo.stamp_ns + SHORTEST_LOOK_NS)
        return ServoGoal(stamp_ns=servo.stamp_ns, position_rad=goal_rad, speed_radps=speed_radps)

    def _offset_m(self, target: Target, range_m: float, pass_ns: int) -> float:
        """How far beside the place the beam goes, look by look.

        A drone that is met: a little to each side, its edges tell where it is; a candidate, too, or it is met at the
        same edge for ever, and a wire along the beam's way would seem to fly. One that was missed, or was met only
        once: where it most likely is by now.
        """
        settings = self.settings
        if not target.tried and (target.sure or (target.looks and not target.undirected_speed_mps)):
            wide_m = 0.175 * settings.span_m * min(1.0, 20.0 / range_m)
            if target.sure:
                wide_m = (0.06 + 0.35 * min(1.0, 10.0 / range_m)) * settings.span_m + 0.35 * target.sigma_m
            return wide_m * low_discrepancy(target.looks % 16)
        reach_m, headed = target.reach_m(pass_ns), target.undirected_speed_mps > 0.0
        spacing_m = self._now.spacing_rad * range_m
        return best_offset_m(reach_m, headed, target.tried, spacing_m, HALF_SHARE * settings.span_m)

    # search

    def _sweep(self, servo: ServoState) -> ServoGoal | None:
        back_radps = self.settings.limit_rpm * RPM_RADPS if self._now.searching else None
        goal = self._now.sweeping.goal(servo.stamp_ns, servo.position_rad, self._search_radps(), back_radps)
        if goal is None:
            return None
        return ServoGoal(stamp_ns=servo.stamp_ns, position_rad=goal[0], speed_radps=goal[1])

    def _search_radps(self) -> float:
        now = self._now
        limit_radps, wanted_radps = self.settings.limit_rpm * RPM_RADPS, self.settings.search_rpm * RPM_RADPS
        if now.rotor.rate_radps <= 0 or len(now.elevations_rad) < 2:
            return min(wanted_radps, limit_radps)
        turn_s = math.tau / now.rotor.rate_radps
        return min(sweep_step_rad(now.spacing_rad, wanted_radps * turn_s) / turn_s, limit_radps)
