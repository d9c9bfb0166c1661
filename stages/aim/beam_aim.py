"""Aim beams: sweep without blind spots, stop at what may be a drone, and then keep a beam on it, turn after turn.

    no track, no candidate     sweep the whole travel, there and back
    candidate                  look at it and at what is around it until the detector has decided, then go on
    TRACKING, COASTING         each turn of the rotor one beam on the predicted place, a little beside it in turn;
                               while coasting farther and farther beside it, then sweep
    several drones             a few turns for each in turn

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
from pydantic import Field, PrivateAttr

from flow.stage import Stage
from stages.aim.beams import (
    low_discrepancy,
    rotor_azimuth_rad,
    servo_positions_rad,
    sweep_step_rad,
    table_angles_rad,
)
from stages.geometry import Array64, LidarMount
from stages.messages import Candidates, LidarFirings, ServoGoal, ServoState, TrackingState, TrackState

RPM_RADPS = math.tau / 60.0


@dataclass(slots=True, eq=False)
class _Target:
    """A place to look at, moving."""

    key: tuple[str, int]
    stamp_ns: int
    xyz_m: Array64
    velocity_mps: Array64
    sigma_m: float
    sure: bool  # a track, not a candidate
    probability: float = 1.0
    glance: bool = False  # looked at in passing, the sweep goes on
    seen_looks: int = 0  # turns in which the detector saw it
    looks: int = 0  # planned for it
    heard_ns: int = 0

    def at(self, stamp_ns: int) -> Array64:
        return self.xyz_m + self.velocity_mps * ((stamp_ns - self.stamp_ns) * 1e-9)


@dataclass(slots=True, eq=False)
class _Rotor:
    """Where the rotor is and how fast it turns."""

    stamp_ns: int = 0
    azimuth_rad: float = 0.0
    rate_radps: float = 0.0

    def next_pass_ns(self, azimuth_rad: float, after_ns: int) -> int:
        """When it looks along an azimuth first after a time."""
        at = (self.azimuth_rad + self.rate_radps * (after_ns - self.stamp_ns) * 1e-9) % math.tau
        return after_ns + round(((azimuth_rad - at) % math.tau) / self.rate_radps * 1e9)


@dataclass(slots=True, eq=False)
class _Now:
    rotor: _Rotor = field(default_factory=_Rotor)
    elevations_rad: tuple[float, ...] = ()
    targets: dict[tuple[str, int], _Target] = field(default_factory=lambda: dict[tuple[str, int], _Target]())
    places: list[tuple[int, Array64]] = field(default_factory=lambda: list[tuple[int, Array64]]())  # and where
    done: dict[int, int] = field(default_factory=lambda: dict[int, int]())  # candidates looked at long enough: when
    goal_rad: float | None = None
    hold_until_ns: int = 0  # a look is planned until then
    sweep_up: bool = True
    nearest_rad: float = math.inf
    nearer_ns: int = 0
    current: tuple[str, int] | None = None
    turns: int = 0  # in a row for the current one


class BeamAim(Stage):
    """Keeps a beam on the drone; searches when there is none."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"candidates"})

    mount: LidarMount
    span_m: float = Field(0.5, gt=0, le=10)
    travel_deg: tuple[float, float] = (0.0, 180.0)
    limit_rpm: float = Field(55.0, gt=0)  # MX-28AR at 12 V
    search_rpm: float = Field(20.0, gt=0)  # about; adjusted to the rotor so that no direction is left out
    lead_s: float = Field(0.03, ge=0)  # from deciding to the servo's obeying
    settle_s: float = Field(0.015, ge=0)  # from arriving to standing still
    candidate_looks: int = Field(25, ge=1)  # then it is left alone for `candidate_rest_s`
    candidate_rest_s: float = Field(1.0, gt=0)
    candidate_probability: float = Field(0.015, ge=0, lt=1)  # less is not worth stopping for
    stop_probability: float = Field(0.25, ge=0, le=1)  # more, met three times, interrupts the sweep
    stop_looks: int = Field(3, ge=1)  # it was seen in so many turns of the rotor before it interrupts the sweep
    glances: int = Field(3, ge=0)  # at a candidate in passing
    glance_probability: float = Field(0.03, ge=0, le=1)
    turns_each: int = Field(3, ge=1)  # for each of several drones
    beams: bool = True  # ablation: without, the middle of the fan is put on the drone
    coast_search_s: float = Field(3.0, gt=0)  # coasting longer, the whole travel is swept

    _now: _Now = PrivateAttr(default_factory=lambda: _Now())

    def model_post_init(self, context: Any, /) -> None:
        if self.travel_deg[1] <= self.travel_deg[0]:
            raise ValueError("travel_deg must be two growing angles")

    def on_firings(self, firings: LidarFirings) -> None:
        """Keep track of the rotor."""
        rotor, n = self._now.rotor, firings.pulse_stamp_ns.size
        if n < 2:
            return
        stamp_ns, azimuth = int(firings.pulse_stamp_ns[-1]), float(firings.azimuth_rad[-1])
        dt = (stamp_ns - int(firings.pulse_stamp_ns[0])) * 1e-9
        rate = ((azimuth - float(firings.azimuth_rad[0])) % math.tau) / dt if dt > 0 else 0.0
        if rate > 0:
            rotor.rate_radps = rate if rotor.rate_radps == 0 else rotor.rate_radps + 0.05 * (rate - rotor.rate_radps)
        rotor.stamp_ns, rotor.azimuth_rad = stamp_ns, azimuth
        if not self._now.elevations_rad:
            self._now.elevations_rad = tuple(sorted(float(w) for w in firings.laser_elevation_rad))

    def on_candidates(self, candidates: Candidates) -> None:
        """What is worth another look now."""
        now = self._now
        for key in [key for key in now.targets if key[0] == "candidate"]:
            if key[1] not in candidates.candidate_id:
                del now.targets[key]
        for i, number in enumerate(candidates.candidate_id.tolist()):
            if candidates.probability[i] < self.candidate_probability:
                now.targets.pop(("candidate", number), None)
                continue
            if candidates.stamp_ns - now.done.get(number, -(10**18)) < self.candidate_rest_s * 1e9:
                continue
            now.done.pop(number, None)
            xyz = candidates.xyz_vehicle_m[i]
            if any(np.linalg.norm(xyz - place) < 1.0 for _, place in now.places):
                continue
            old = now.targets.get(("candidate", number))
            age_s = (candidates.stamp_ns - int(candidates.seen_ns[i])) * 1e-9
            now.targets[("candidate", number)] = _Target(
                key=("candidate", number),
                stamp_ns=candidates.stamp_ns,
                xyz_m=candidates.xyz_vehicle_m[i],
                velocity_mps=candidates.velocity_vehicle_mps[i],
                sigma_m=0.2 + 2.0 * age_s,
                sure=False,
                probability=float(candidates.probability[i]),
                seen_looks=int(candidates.looks[i]),
                glance=old.glance if old else False,
                looks=old.looks if old else 0,
                heard_ns=int(candidates.seen_ns[i]),
            )

    def on_state(self, state: TrackState) -> None:
        """Where each track is predicted."""
        now, key = self._now, ("track", state.track_id)
        if state.state is TrackingState.LOST or state.state is TrackingState.SEARCHING:
            now.targets.pop(key, None)
        if state.state not in (TrackingState.TRACKING, TrackingState.COASTING) or state.xyz_vehicle_m is None:
            return
        old = now.targets.get(key)
        sigma = 0.3 if state.covariance_m2 is None else math.sqrt(float(np.linalg.eigvalsh(state.covariance_m2)[-1]))
        velocity = np.zeros(3) if state.velocity_vehicle_mps is None else state.velocity_vehicle_mps
        now.targets[key] = _Target(
            key=key,
            stamp_ns=state.stamp_ns,
            xyz_m=state.xyz_vehicle_m,
            velocity_mps=velocity,
            sigma_m=sigma,
            sure=True,
            looks=old.looks if old else 0,
            heard_ns=state.stamp_ns if state.state is TrackingState.TRACKING or old is None else old.heard_ns,
        )

    def on_servo(self, servo: ServoState) -> ServoGoal | None:
        """A new goal when the last look is over, or at once when something else is to be done."""
        now = self._now
        if not self.mount.turns:
            return None
        target = self._choose(servo.stamp_ns)
        if target is None or now.rotor.rate_radps <= 0 or not now.elevations_rad:
            if now.current is not None:
                now.current, now.goal_rad = None, None
            return self._sweep(servo)
        planned = None if now.current is None else now.targets.get(now.current)
        if servo.stamp_ns < now.hold_until_ns and planned is not None and (planned is target or target.glance):
            return None
        return self._look(servo, target)

    # what to look at

    def _choose(self, now_ns: int) -> _Target | None:
        now = self._now
        for key, target in tuple(now.targets.items()):
            if target.sure:
                continue
            if target.looks >= self.candidate_looks:
                self._leave(target, now_ns)
            elif now_ns - target.heard_ns > 1.2e9:
                del now.targets[key]
        now.places = [place for place in now.places if now_ns - place[0] < 4e9]
        sure = [t for t in now.targets.values() if t.sure and now_ns - t.heard_ns < self.coast_search_s * 1e9]
        if sure:
            if now.current in [t.key for t in sure] and (len(sure) == 1 or now.turns < self.turns_each):
                return now.targets[now.current]  # pyright: ignore[reportArgumentType]
            order = sorted(sure, key=lambda t: t.key)
            after = [t for t in order if now.current is not None and t.key > now.current]
            return (after or order)[0]
        return self._candidate(now_ns)

    def _candidate(self, now_ns: int) -> _Target | None:
        """The one to stop at, else the one to glance at in passing; None: sweep on."""
        now = self._now
        maybe = [t for t in now.targets.values() if not t.sure]
        current = None if now.current is None else now.targets.get(now.current)
        worth = [t for t in maybe if t.probability >= self.stop_probability and t.seen_looks >= self.stop_looks]
        if current in worth and not current.glance:
            if current.looks < 4 or (current.seen_looks > 0.4 * current.looks and current.probability > 0.12):
                return current
            self._leave(current, now_ns)  # it is seldom there, or most likely something else
            worth.remove(current)
        if worth:
            best = max(worth, key=lambda t: (t.probability / (1.0 + t.looks), t.key))
            best.glance = False
            return best
        # the sweep goes on by steps: each turn of the rotor a beam is put on something that was met a moment ago
        fresh = [
            t
            for t in maybe
            if t.looks < self.glances and now_ns - t.heard_ns < 350_000_000 and t.probability >= self.glance_probability
        ]
        for target in fresh:
            target.glance = True
        return max(fresh, key=lambda t: (t.probability / (1.0 + t.looks), t.key), default=None)

    def _leave(self, target: _Target, now_ns: int) -> None:
        """Looked at long enough: leave it, and what stands there, alone for a while."""
        self._now.done[target.key[1]] = now_ns
        self._now.targets.pop(target.key, None)
        self._now.places.append((now_ns, target.at(now_ns)))

    # one look

    def _look(self, servo: ServoState, target: _Target) -> ServoGoal | None:
        now = self._now
        now.turns = now.turns + 1 if now.current == target.key else 0
        now.current = target.key
        now.goal_rad = None
        T = self.mount.T_vehicle_turntable.matrix()
        T_tl = self.mount.T_turntable_lidar.matrix()
        speed = self.limit_rpm * RPM_RADPS
        centre = servo.position_rad
        if target.glance:  # go on sweeping while looking
            step = self._search_radps() * math.tau / now.rotor.rate_radps
            travel = math.radians(self.travel_deg[0]), math.radians(self.travel_deg[1])
            centre = min(max(centre + (step if now.sweep_up else -step), travel[0]), travel[1])
        pass_ns = servo.stamp_ns + round((self.lead_s + 0.05) * 1e9)
        best: tuple[float, float, int] | None = None
        for _ in range(2):  # the place at the pass depends on when that is
            place = T[:3, :3].T @ (target.at(pass_ns) - T[:3, 3])
            range_m = max(float(np.linalg.norm(place - T_tl[:3, 3])), 0.5)
            offset_rad = self._offset_m(target, range_m, servo.stamp_ns) / range_m
            best = self._best(centre, place, offset_rad, T_tl)
            if best is None:
                return self._sweep(servo)
            goal, theta, _ = best
            if target.glance and abs(goal - centre) > math.radians(12.0):
                target.looks = self.glances  # the fan has passed it
                return self._sweep(servo)
            ready_ns = servo.stamp_ns + round(
                (self.lead_s + self.settle_s + abs(goal - servo.position_rad) / speed) * 1e9
            )
            pass_ns = now.rotor.next_pass_ns(rotor_azimuth_rad(T_tl, place, theta), ready_ns)
        assert best is not None
        self._now.targets[target.key].looks += 1
        now.hold_until_ns = max(pass_ns + 4_000_000, servo.stamp_ns + 5_000_000)
        return ServoGoal(stamp_ns=servo.stamp_ns, position_rad=best[0], speed_radps=speed)

    def _offset_m(self, target: _Target, range_m: float, now_ns: int) -> float:
        """How far beside the place the beam goes, look by look."""
        k = target.looks
        if target.sure:
            wide = (0.06 + 0.35 * min(1.0, 10.0 / range_m)) * self.span_m + 0.35 * target.sigma_m
            silent_s = (now_ns - target.heard_ns) * 1e-9
            if silent_s > 0.3:
                wide = max(wide, math.radians(1.0) * range_m)
            return wide * low_discrepancy(k % 16)
        if k % 5 == 4:  # what is around it
            return math.radians(1.2) * range_m * low_discrepancy(k // 5 % 8)
        return (0.04 * self.span_m + 0.2 * target.sigma_m) * low_discrepancy(k % 8)

    def _best(self, at_rad: float, place: Array64, offset_rad: float, T_tl: Array64) -> tuple[float, float, int] | None:
        """(servo position, table angle, beam) that puts a beam `offset_rad` beside a place, the cheapest one."""
        travel = math.radians(self.travel_deg[0]), math.radians(self.travel_deg[1])
        best: tuple[float, float, float, int] | None = None
        elevations = self._now.elevations_rad if self.beams else (0.0,)
        for beam, w in enumerate(elevations):
            for theta in table_angles_rad(T_tl, place, w + offset_rad):
                for servo in servo_positions_rad(self.mount, theta, travel):
                    cost = abs(servo - at_rad) + 0.5 * abs(w)
                    if best is None or cost < best[0]:
                        best = (cost, servo, theta, beam)
        if best is None and self.beams:  # nearly on the axis, or just beyond the travel: as near as it gets
            for theta in table_angles_rad(T_tl, place, 0.0):
                for turn in (-math.tau, 0.0, math.tau):
                    servo = self.mount.servo_rad(theta) + turn
                    kept = min(max(servo, travel[0]), travel[1])
                    cost = abs(kept - servo)
                    if best is None or cost < best[0]:
                        best = (cost, kept, theta, -1)
        return None if best is None else (best[1], best[2], best[3])

    # search

    def _sweep(self, servo: ServoState) -> ServoGoal | None:
        now = self._now
        low, high = math.radians(self.travel_deg[0]), math.radians(self.travel_deg[1])
        left = math.inf if now.goal_rad is None else abs(now.goal_rad - servo.position_rad)
        if left < now.nearest_rad:
            now.nearest_rad, now.nearer_ns = left, servo.stamp_ns
        arrived = left < math.radians(0.6) or servo.stamp_ns - now.nearer_ns > 300_000_000
        if now.goal_rad is not None and not arrived:
            return None
        if now.goal_rad is not None:
            now.sweep_up = not now.sweep_up
        if low + math.radians(2) > servo.position_rad:
            now.sweep_up = True
        elif high - math.radians(2) < servo.position_rad:
            now.sweep_up = False
        now.goal_rad = high if now.sweep_up else low
        now.nearest_rad, now.nearer_ns = math.inf, servo.stamp_ns
        return ServoGoal(stamp_ns=servo.stamp_ns, position_rad=now.goal_rad, speed_radps=self._search_radps())

    def _search_radps(self) -> float:
        now = self._now
        wanted = self.search_rpm * RPM_RADPS
        if now.rotor.rate_radps <= 0 or len(now.elevations_rad) < 2:
            return min(wanted, self.limit_rpm * RPM_RADPS)
        spacing = (now.elevations_rad[-1] - now.elevations_rad[0]) / (len(now.elevations_rad) - 1)
        turn_s = math.tau / now.rotor.rate_radps
        return min(sweep_step_rad(spacing, wanted * turn_s) / turn_s, self.limit_rpm * RPM_RADPS)
