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

TOLD_NS = 12_000_000  # after its pass a look has been told of
INNER_DEG = 8.0
GLANCE_DEG = 12.0  # beside the sweep: its fan is 30 deg wide
TRACK_OWN_M = 1.0
MOST_DONE = 256
TARGET_SHARE = 0.5  # of its span: so wide a drone returns beams
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
    missed: int = 0  # of them since it was seen last
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
    done: dict[int, tuple[int, int]] = field(default_factory=lambda: dict[int, tuple[int, int]]())  # see `_leave`
    goal_rad: float | None = None
    hold_until_ns: int = 0  # a look is planned until then
    sweep_up: bool = True
    swept_rad: float | None = None  # how far the sweep has come while glances are taken beside it
    nearest_rad: float = math.inf
    nearer_ns: int = 0
    current: tuple[str, int] | None = None
    turns: int = 0  # in a row for the current one
    searching: bool = False  # for more drones, between looks at those there are
    search_until_ns: int = 0
    served: int = 0  # looks at tracks since the last piece of the search
    left_off_rad: float | None = None  # where that ended


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
    candidate_probability: float = Field(0.006, ge=0, lt=1)  # less is not worth stopping for
    stop_probability: float = Field(0.35, ge=0, le=1)  # more, met `stop_looks` times, interrupts the sweep
    patience: int = Field(8, ge=1)  # looks in a row that did not meet a candidate
    stop_looks: int = Field(2, ge=1)  # it was seen in so many turns of the rotor before it interrupts the sweep
    glances: int = Field(3, ge=0)  # at a candidate in passing
    turns_each: int = Field(3, ge=1)  # for each of several drones
    max_drones: int = Field(1, ge=1, le=8)  # with fewer tracks the search goes on between looks at them
    search_s: float = Field(0.35, gt=0)  # at a time
    beams: bool = True  # ablation: without, the middle of the fan is put on the drone
    coast_sigma_m: float = Field(3.0, gt=0)  # less known while coasting, the whole travel is swept

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
            rest_until_ns, _ = now.done.get(number, (0, 0))
            if candidates.stamp_ns < rest_until_ns:
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
                missed=old.missed if old and int(candidates.seen_ns[i]) <= old.heard_ns else 0,
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
        seen = state.state is TrackingState.TRACKING
        now.targets[key] = _Target(
            key=key,
            stamp_ns=state.stamp_ns,
            xyz_m=state.xyz_vehicle_m,
            velocity_mps=velocity,
            sigma_m=sigma,
            sure=True,
            looks=old.looks if old else 0,
            missed=old.missed if old and state.hits == 0 else 0,
            heard_ns=state.stamp_ns if seen or old is None else old.heard_ns,
        )

    def on_servo(self, servo: ServoState) -> ServoGoal | None:
        """A new goal when the last look is over, or at once when something else is to be done."""
        now = self._now
        if not self.mount.turns:
            return None
        target = self._choose(servo)
        if target is None or now.rotor.rate_radps <= 0 or not now.elevations_rad:
            if now.current is not None:
                now.current, now.goal_rad = None, None
            return self._sweep(servo)
        planned = None if now.current is None else now.targets.get(now.current)
        if servo.stamp_ns < now.hold_until_ns and planned is not None and (planned is target or target.glance):
            return None
        return self._look(servo, target)

    # what to look at

    def _choose(self, servo: ServoState) -> _Target | None:
        now, now_ns = self._now, servo.stamp_ns
        for key, target in tuple(now.targets.items()):
            if target.sure:
                continue
            if target.looks >= self.candidate_looks:
                self._leave(target, now_ns)
            elif now_ns - target.heard_ns > 1.2e9:
                del now.targets[key]
        sure = [t for t in now.targets.values() if t.sure and t.sigma_m < self.coast_sigma_m]
        if not sure or len(sure) >= self.max_drones:
            now.searching, now.served, now.left_off_rad = False, 0, None
        elif self._searches_on(sure, servo):
            return self._candidate(now_ns)
        if sure:
            if now.current in [t.key for t in sure] and (len(sure) == 1 or now.turns < self.turns_each):
                return now.targets[now.current]  # pyright: ignore[reportArgumentType]
            order = sorted(sure, key=lambda t: t.key)
            after = [t for t in order if now.current is not None and t.key > now.current]
            return (after or order)[0]
        return self._candidate(now_ns)

    def _searches_on(self, sure: list[_Target], servo: ServoState) -> bool:
        """Whether each track has had its turns: time for a piece of the sweep, from where the last one ended."""
        now = self._now
        if now.searching and servo.stamp_ns < now.search_until_ns:
            return True
        if now.searching:
            now.searching, now.served, now.left_off_rad = False, 0, servo.position_rad
        if now.served >= self.turns_each * len(sure) and servo.stamp_ns >= now.hold_until_ns:
            way_rad = 0.0 if now.left_off_rad is None else abs(now.left_off_rad - servo.position_rad)
            now.searching = True
            now.search_until_ns = servo.stamp_ns + round((self.search_s + way_rad / (self.limit_rpm * RPM_RADPS)) * 1e9)
        return now.searching

    def _candidate(self, now_ns: int) -> _Target | None:
        """The one to stop at, else the one to glance at in passing; None: sweep on."""
        now = self._now
        tracks = [t.at(now_ns) for t in now.targets.values() if t.sure]
        maybe = [t for t in now.targets.values() if not t.sure and not _among(t.at(now_ns), tracks)]
        current = None if now.current is None else now.targets.get(now.current)
        worth = [t for t in maybe if t.probability >= self.stop_probability and t.seen_looks >= self.stop_looks]
        if current in worth and not current.glance:
            if current.missed < self.patience and current.probability > 0.5 * self.stop_probability:
                return current
            self._leave(current, now_ns)  # it is not there, or most likely something else
            worth.remove(current)
            maybe.remove(current)
        if worth:
            best = max(worth, key=lambda t: (t.probability / (1.0 + t.looks), t.key))
            best.glance = False
            return best
        # the sweep goes on by steps: each turn of the rotor a beam is put on something that was met a moment ago
        fresh = [t for t in maybe if t.looks < self.glances and now_ns - t.heard_ns < 350_000_000]
        for target in fresh:
            target.glance = True
        return max(fresh, key=lambda t: (t.probability / (1.0 + t.looks), t.key), default=None)

    def _leave(self, target: _Target, now_ns: int) -> None:
        """Looked at long enough: leave it alone for a while, each time for longer."""
        now, number = self._now, target.key[1]
        _, times = now.done.get(number, (0, 0))
        now.done[number] = now_ns + round(self.candidate_rest_s * 2 ** min(times, 4) * 1e9), times + 1
        now.targets.pop(target.key, None)
        if len(now.done) > MOST_DONE:
            del now.done[min(now.done)]  # the oldest number

    # one look

    def _look(self, servo: ServoState, target: _Target) -> ServoGoal | None:
        now = self._now
        now.turns = now.turns + 1 if now.current == target.key else 0
        now.current = target.key
        now.goal_rad = None
        if not target.glance:
            now.swept_rad = None
        T = self.mount.T_vehicle_turntable.matrix()
        T_tl = self.mount.T_turntable_lidar.matrix()
        speed = self.limit_rpm * RPM_RADPS
        centre = servo.position_rad
        if target.glance:
            centre = self._swept_rad(servo.position_rad)
        pass_ns = servo.stamp_ns + round((self.lead_s + 0.05) * 1e9)
        best: tuple[float, float, int] | None = None
        for _ in range(2):  # the place at the pass depends on when that is
            place = T[:3, :3].T @ (target.at(pass_ns) - T[:3, 3])
            range_m = max(float(np.linalg.norm(place - T_tl[:3, 3])), 0.5)
            offset_rad = self._offset_m(target, range_m) / range_m
            best = self._best(centre, place, offset_rad, T_tl, math.inf if target.glance else math.radians(INNER_DEG))
            if best is None:
                return self._sweep(servo)
            goal, theta, _ = best
            if target.glance and abs(goal - centre) > math.radians(GLANCE_DEG):
                target.looks = self.glances  # the fan has passed it
                return self._sweep(servo)
            ready_ns = servo.stamp_ns + round(
                (self.lead_s + self.settle_s + abs(goal - servo.position_rad) / speed) * 1e9
            )
            pass_ns = now.rotor.next_pass_ns(rotor_azimuth_rad(T_tl, place, theta), ready_ns)
        assert best is not None
        self._now.targets[target.key].looks += 1
        self._now.targets[target.key].missed += 1
        self._now.served += target.sure
        now.hold_until_ns = max(pass_ns + TOLD_NS, servo.stamp_ns + 5_000_000)
        return ServoGoal(stamp_ns=servo.stamp_ns, position_rad=best[0], speed_radps=speed)

    def _offset_m(self, target: _Target, range_m: float) -> float:
        """How far beside the place the beam goes, look by look.

        A drone that is met: a little to each side, its edges tell where it is. One that was missed: half a drone to one
        side, to the other, farther, until the next beam of the fan has been where this one began.
        """
        tries = target.missed - 1 if target.sure else target.missed
        if target.sure and tries < 1:
            wide = (0.06 + 0.35 * min(1.0, 10.0 / range_m)) * self.span_m + 0.35 * target.sigma_m
            return wide * low_discrepancy(target.looks % 16)
        spacing_m = self._spacing_rad() * range_m
        count = max(math.ceil(spacing_m / (TARGET_SHARE * self.span_m)), 1)
        k = tries % count
        return (k + 1) // 2 * (1 if k % 2 else -1) * spacing_m / count

    def _best(
        self, at_rad: float, place: Array64, offset_rad: float, T_tl: Array64, inner_rad: float
    ) -> tuple[float, float, int] | None:
        """(servo position, table angle, beam) that puts a beam `offset_rad` beside a place, the cheapest one.

        Beams farther out than inner_rad are dear: beyond the last one nothing is seen of a drone that flies on.
        """
        travel = math.radians(self.travel_deg[0]), math.radians(self.travel_deg[1])
        best: tuple[float, float, float, int] | None = None
        elevations = self._now.elevations_rad if self.beams else (0.0,)
        for beam, w in enumerate(elevations):
            for theta in table_angles_rad(T_tl, place, w + offset_rad):
                for servo in servo_positions_rad(self.mount, theta, travel):
                    cost = abs(servo - at_rad) + 0.5 * abs(w) + 3.0 * max(abs(w) - inner_rad, 0.0)
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

    def _swept_rad(self, position_rad: float) -> float:
        """Where the sweep is by the next turn of the rotor; it goes on while something is glanced at beside it."""
        now = self._now
        low, high = math.radians(self.travel_deg[0]), math.radians(self.travel_deg[1])
        step = self._search_radps() * math.tau / now.rotor.rate_radps
        at = position_rad if now.swept_rad is None else now.swept_rad
        if not low <= at + (step if now.sweep_up else -step) <= high:
            now.sweep_up = not now.sweep_up
        now.swept_rad = min(max(at + (step if now.sweep_up else -step), low), high)
        return now.swept_rad

    def _sweep(self, servo: ServoState) -> ServoGoal | None:
        now = self._now
        now.swept_rad = None
        if now.searching and now.left_off_rad is not None:
            if abs(now.left_off_rad - servo.position_rad) > math.radians(1.0):
                if now.goal_rad == now.left_off_rad:
                    return None
                now.goal_rad = now.left_off_rad
                speed_radps = self.limit_rpm * RPM_RADPS
                return ServoGoal(stamp_ns=servo.stamp_ns, position_rad=now.left_off_rad, speed_radps=speed_radps)
            now.left_off_rad, now.goal_rad = None, None
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

    def _spacing_rad(self) -> float:
        """Between two beams of the fan."""
        w = self._now.elevations_rad
        return (w[-1] - w[0]) / (len(w) - 1) if len(w) > 1 else math.tau

    def _search_radps(self) -> float:
        now = self._now
        wanted = self.search_rpm * RPM_RADPS
        if now.rotor.rate_radps <= 0 or len(now.elevations_rad) < 2:
            return min(wanted, self.limit_rpm * RPM_RADPS)
        spacing = self._spacing_rad()
        turn_s = math.tau / now.rotor.rate_radps
        return min(sweep_step_rad(spacing, wanted * turn_s) / turn_s, self.limit_rpm * RPM_RADPS)


def _among(place_m: Array64, tracks_m: list[Array64]) -> bool:
    """Whether it is a track's own place: the detector tells of what is tracked, too."""
    return any(float(np.linalg.norm(place_m - track)) < TRACK_OWN_M for track in tracks_m)
