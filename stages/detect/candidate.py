"""One thing that may be a drone: where it goes, and what speaks for and against it.

A drone is weighed against each other thing that returns pulses in the sky, with the evidence that tells the two apart:

    stray       rain, dust, a wrong return     it is not there at the next look
    clutter     lamp, wire, tree, roof edge    something stands beside it, it returns little, it does not move
    bird                                       it is fast, or turns hard
    balloon                                    it is smooth and round

    odds of a drone = 1 / sum_k exp(-o_k),     o_k = ln of the odds, drone over thing k

Every o_k is a prior and a sum of log likelihood ratios, capped where looks repeat the same evidence. The numbers were
chosen by reasoning and checked on simulated worlds that were not used to choose them (README).

Source: ours; DESIGN, "a small cluster with *measured* emptiness around it, evaluated as data arrives".
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict

from stages.detect.surroundings import FARTHER_0, FREE_0, OCCUPIED_0, SECTORS
from stages.geometry import Array64


class Evidence(BaseModel):
    """How much each observation counts [nats], drone over the other thing, and where the caps are."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    stray: float = -5.0  # prior: of what is hit once, one in 150 is there again
    hit: float = 1.0  # each return of the first look, up to 4
    look: float = 2.5  # each further look with a return
    miss: float = 0.25  # each pulse that went through the middle
    far_m: float = 35.0  # beyond, ever less of what returns anything is a drone
    far: float = 0.15  # each metre

    clutter: float = -6.0  # prior: of short things in the sky one in 400 hangs free
    free_sector: float = 0.6  # each of eight sectors that pulses flew through
    beside: float = -3.0  # each look with something in a sector
    alone: float = 0.3  # each look with nothing, up to 2
    most_few: float = 6.0  # looks with a single return: a wire gives little else
    most_many: float = 2.0  # and those with more
    near_big: float = 8.0  # a wall, crown or trunk this close, and it has not moved away
    spread: float = 3.0  # its sightings lie wider about a straight flight than a drone is large
    long: float = 1.5  # each look longer than the drone, up to 4
    moves: float = 5.0  # it moved: what stands does not
    still: float = 0.12  # each look at something that does not, up to most_still: a lamp's pole is found sooner
    most_still: float = 1.5

    bird: float = -0.5
    calm: float = 8.0  # each second in which it would have shown a bird's speed or turn
    steady: float = 3.0  # each second of straight flight after the first
    most_calm: float = 8.0
    flew_so: float = 10.0  # it flew as only birds do, once
    bird_speed_mps: float = 9.0  # no drone of ours flies faster
    bird_acceleration_mps2: float = 6.0

    balloon: float = 5.0  # rare
    ball: float = 2.0  # each chord that bulges smoothly
    rugged: float = 1.2  # each chord with five or more returns that does not


@dataclass(slots=True, eq=False)
class Sighting:
    """One look's returns on one small thing."""

    stamp_ns: int
    xyz_local_m: Array64  # (3,)
    vehicle_local_m: Array64  # (3,) where the vehicle was then
    range_m: float
    hits: int
    length_m: float  # extent of its returns
    balls: int  # chords that bulge smoothly
    rugged: int  # chords that could have and do not
    around: Array64  # (TALLY,) of stages/detect/surroundings.py
    big_m: float  # distance to the nearest big thing, inf: none


class Motion(NamedTuple):
    """How a candidate flew lately."""

    speed_mps: float
    speed_sigma_mps: float  # an axis
    acceleration_mps2: float
    acceleration_sigma_mps2: float  # an axis
    spread_m: float  # of its sightings about the parabola

    @property
    def top_sigma_mps(self) -> float:
        """One sigma of it."""
        return math.hypot(self.speed_sigma_mps, BIRD_TURN_S * self.acceleration_sigma_mps2)

    @property
    def top_mps(self) -> float:
        """How fast it will be: a bird that wheels is slow for a moment only, and turns hard then."""
        return math.hypot(self.speed_mps, BIRD_TURN_S * self.acceleration_mps2)


HISTORY = 40
CALM_MPS = 6.5
SLOW_MPS = 2.0
STEADY_MPS2 = 2.0
# ln of how much likelier a drone flies so than a bird, by the speed it reaches; of birds there are several
FLIGHT_MPS = (0.0, 2.0, 4.0, 6.0, 9.0, 12.0)
FLIGHT_NATS = (1.0, 1.0, 0.0, -2.0, -4.0, -7.0)
BIRD_TURN_S = 1.4  # of speed over acceleration: a turn in 9 s
ALONE_PER_M = 0.0165  # share of looks at a drone that find one return alone, over range
WIRE_ALONE = 0.75  # and of those at a wire


@dataclass(slots=True, eq=False)
class Candidate:
    """Position and velocity in the local frame by a Kalman filter with equal axes, and the evidence so far."""

    number: int
    first_ns: int
    stamp_ns: int
    xyz_m: Array64
    velocity_mps: Array64
    range_m: float
    p: tuple[float, float, float]  # variances: position, position-velocity, velocity
    first_hits: int
    hit_looks: int = 1
    missed: float = 0.0  # expected returns that did not come
    missed_looks: int = 0  # in a row
    hits: int = 0
    long_looks: int = 0
    few: float = 0.0
    beside: float = 0.0  # recent looks in which something stood beside it
    alone: float = 0.0  # and those in which nothing did
    balls: int = 0
    rugged: int = 0
    bird: bool = False  # it flew as only birds do, once is enough
    free: Array64 = field(default_factory=lambda: np.zeros(SECTORS))  # looks in which the sector was free
    occupied: Array64 = field(default_factory=lambda: np.zeros(SECTORS))
    big_looks: int = 0
    big_m: float = math.inf
    seen_ns: int = 0
    accepted: bool = False
    told: int = 0  # what was last told of it: 0 nothing, 1 worth a look, 2 accepted
    calm_s: float = 0.0  # for how long it clearly flew as no bird does
    worth: bool = False  # it was once worth a look: what became of it is told, too
    path_ns: list[int] = field(default_factory=lambda: list[int]())
    steady_s: float = 0.0  # for how long it clearly flew straight on
    beside_m: list[Array64] = field(default_factory=lambda: list[Array64]())  # its path seen from the vehicle's place
    path_m: list[Array64] = field(default_factory=lambda: list[Array64]())

    def predict(self, stamp_ns: int, acceleration_mps2: float) -> tuple[Array64, float]:
        """Position (3,) and its variance [m^2] at a time."""
        dt = (stamp_ns - self.stamp_ns) * 1e-9
        a, b, c = self.p
        q = acceleration_mps2**2
        return self.xyz_m + dt * self.velocity_mps, a + 2 * dt * b + dt * dt * c + q * dt**4 / 4

    def see(self, s: Sighting, sigma_m: float, acceleration_mps2: float) -> None:
        """Take in one more sighting."""
        dt = (s.stamp_ns - self.stamp_ns) * 1e-9
        a, b, c = self.p
        q = acceleration_mps2**2
        a, b, c = a + 2 * dt * b + dt * dt * c + q * dt**4 / 4, b + dt * c + q * dt**3 / 2, c + q * dt * dt
        x = self.xyz_m + dt * self.velocity_mps
        gain_x, gain_v = a / (a + sigma_m**2), b / (a + sigma_m**2)
        innovation = s.xyz_local_m - x
        self.xyz_m = x + gain_x * innovation
        self.velocity_mps = self.velocity_mps + gain_v * innovation
        self.p = (1 - gain_x) * a, (1 - gain_x) * b, c - gain_v * b
        if s.stamp_ns - self.seen_ns > 30_000_000:
            self.hit_looks += 1
        self.stamp_ns = self.seen_ns = s.stamp_ns
        self.range_m = s.range_m
        self._note(s)

    def _note(self, s: Sighting) -> None:
        self.missed_looks = 0
        self.hits += s.hits
        alone = min(ALONE_PER_M * s.range_m, 0.7)
        self.few += math.log(alone / WIRE_ALONE) if s.hits == 1 else math.log((1 - alone) / (1 - WIRE_ALONE))
        self.balls += s.balls
        self.rugged += s.rugged
        self.free += s.around[FREE_0 : FREE_0 + SECTORS] >= 2
        taken = s.around[OCCUPIED_0 : OCCUPIED_0 + SECTORS] >= 1
        self.occupied += taken
        measured = (s.around[FREE_0 : FREE_0 + SECTORS] >= 1).sum() >= SECTORS // 2
        between = s.around[FREE_0 : FREE_0 + SECTORS] >= 1
        farther = s.around[FARTHER_0 : FARTHER_0 + SECTORS] >= 1
        standing = 1.0 if taken.any() else (0.5 if (farther & ~between).any() else (0.15 if farther.any() else 0.0))
        self.beside = 0.95 * self.beside + standing
        self.alone = 0.95 * self.alone + bool(measured and standing == 0.0)
        self.big_m = s.big_m
        self.big_looks += math.isfinite(s.big_m)
        self.path_ns.append(s.stamp_ns)
        self.path_m.append(s.xyz_local_m)
        self.beside_m.append(s.xyz_local_m - s.vehicle_local_m)
        if len(self.path_ns) > HISTORY:
            del self.path_ns[0], self.path_m[0], self.beside_m[0]
        if len(self.path_ns) > 1:
            self._note_calm((self.path_ns[-1] - self.path_ns[-2]) * 1e-9, s.xyz_local_m - self.path_m[-2])

    def _note_calm(self, since_s: float, way_m: Array64) -> None:
        """Count the time in which it flew as no bird does: slowly, and not just before a turn; or it is still there."""
        motion = self.gentler()
        if motion is not None and motion.acceleration_mps2 + motion.acceleration_sigma_mps2 < STEADY_MPS2:
            self.steady_s += min(since_s, 0.2)
        if since_s > 0.4:
            calm = self.hit_looks >= 4 and float(np.linalg.norm(way_m)) < 1.0 * since_s
        else:
            calm = motion is not None and (
                motion.top_mps + motion.top_sigma_mps < CALM_MPS
                or motion.speed_mps + 1.5 * motion.speed_sigma_mps < SLOW_MPS
            )
        if calm:
            self.calm_s += min(since_s, 0.8)

    def miss(self, expected: float) -> None:
        """Pulses went through where it should be; `expected` returns did not come."""
        self.missed += expected
        self.missed_looks += 1

    def gentler(self) -> Motion | None:
        """How it moves in the world, or beside the vehicle if that is slower: a drone comes along with it, a bird no."""
        world, beside = self.motion(), self.motion(beside=True)
        if world is None or beside is None:
            return world
        return world if world.top_mps <= beside.top_mps else beside

    def motion(self, beside: bool = False) -> Motion | None:
        """A parabola through the sightings of the last 1.2 s; None with too few."""
        first = bisect_left(self.path_ns, self.path_ns[-1] - 1_200_000_000)
        t = (np.array(self.path_ns[first:]) - self.path_ns[-1]) * 1e-9
        if len(t) < 3 or t[0] > -0.15:
            return None
        x = np.array((self.beside_m if beside else self.path_m)[first:])
        A = np.column_stack([np.ones(len(t)), t, t * t / 2])
        sigma = self._scatter_m
        information = A.T @ A / sigma**2 + np.diag([0.0, 1 / 8.0**2, 1 / 6.0**2])
        covariance = np.linalg.inv(information)
        fit = covariance @ (A.T @ x) / sigma**2
        at = t.mean()
        return Motion(
            speed_mps=float(np.linalg.norm(fit[1] + at * fit[2])),
            speed_sigma_mps=math.sqrt(covariance[1, 1] + 2 * at * covariance[1, 2] + at**2 * covariance[2, 2]),
            acceleration_mps2=float(np.linalg.norm(fit[2])),
            acceleration_sigma_mps2=math.sqrt(covariance[2, 2]),
            spread_m=float(np.sqrt(np.mean(np.sum((x - A @ fit) ** 2, axis=1)))),
        )

    def judge(self, e: Evidence, free_space: bool, motion_known: bool) -> tuple[float, str]:
        """ln of the odds that it is a drone, and why, in words."""
        clutter, said = self._over_clutter(e, free_space, motion_known)
        over = {
            "a stray return": self._over_stray(e),
            "a lamp, wire or edge": clutter,
            "a bird": self._over_bird(e),
            "a balloon": e.balloon + e.rugged * self.rugged - e.ball * self.balls,
        }
        least = min(over, key=lambda name: over[name])
        shift = over[least]
        odds = shift - math.log(sum(math.exp(shift - value) for value in over.values()))
        words = [f"{self.hit_looks} looks, {self.hits} returns", *said]
        motion = self.motion()
        if motion is not None:
            words.append(f"{motion.speed_mps:.1f} +- {motion.speed_sigma_mps:.1f} m/s")
        if self.bird:
            words.append("flew as a bird does")
        if odds < 4.0:
            words.append(f"if not a drone, {least}")
        return odds, "; ".join(words)

    def _over_stray(self, e: Evidence) -> float:
        odds = e.stray + e.hit * min(self.first_hits, 4) + e.look * (self.hit_looks - 1) - e.miss * self.missed
        return min(odds, 10.0) - e.far * max(self.range_m - e.far_m, 0.0)

    def _over_clutter(self, e: Evidence, free_space: bool, motion_known: bool) -> tuple[float, list[str]]:
        said: list[str] = []
        odds = e.clutter
        if free_space:
            free = int((self.free >= 1).sum())
            odds += e.free_sector * free + max(e.beside * self.beside, -12.0) + min(e.alone * self.alone, 2.0)
            said.append(f"{free} of {SECTORS} sectors around it free")
            if self.beside > 0.5:
                said.append("something beside it")
        few = min(max(self.few, -e.most_few), e.most_many)
        odds += few - e.long * min(self.long_looks, 4)
        if few < -1.0:
            said.append("single returns")
        if self.long_looks:
            said.append("longer than a drone")
        moves = self._moves(motion_known)
        if moves:
            odds += e.moves
        else:
            odds += min(e.still * self.hit_looks, e.most_still)
            said.append("it may stand still")
        if self.big_looks > 0.3 * self.hit_looks and not moves:
            odds -= e.near_big
            said.append("beside something big" + (f" {self.big_m:.1f} m away" if math.isfinite(self.big_m) else ""))
        motion = self.motion()
        if motion is not None and motion.spread_m > 0.35 and len(self.path_ns) > 3:
            odds -= e.spread
            said.append(f"scattered over {motion.spread_m:.1f} m")
        return odds, said

    def _over_bird(self, e: Evidence) -> float:
        flown = min(e.calm * self.calm_s + e.steady * max(self.steady_s - 1.0, 0.0), e.most_calm)
        motion = self.gentler()
        if motion is None:
            return e.bird + flown - (e.flew_so if self.bird else 0.0)
        fast = motion.speed_mps - 1.5 * motion.speed_sigma_mps > e.bird_speed_mps
        hard = motion.acceleration_mps2 - 2.5 * motion.acceleration_sigma_mps2 > e.bird_acceleration_mps2
        self.bird |= fast or hard
        flight = float(np.interp(motion.top_mps, FLIGHT_MPS, FLIGHT_NATS)) / (1.0 + (motion.top_sigma_mps / 4.0) ** 2)
        return e.bird + flight + flown - (e.flew_so if self.bird else 0.0)

    @property
    def _scatter_m(self) -> float:
        """How far sightings of one thing lie about its middle, one sigma: more where beams are farther apart."""
        return 0.10 + 0.0025 * self.range_m

    def _moves(self, motion_known: bool) -> bool:
        """Whether it has clearly moved in the world.

        Steadily while it was looked at without a pause; or farther between two passes than one lamp is long. Something
        long is met elsewhere as the fan passes over it, so a single passing proves nothing. When the vehicle does not
        tell how it moves, what stands may seem to go by: then only going up or down counts.
        """
        t = (np.array(self.path_ns) - self.path_ns[-1]) * 1e-9
        pauses = np.nonzero(np.diff(t) > 0.45)[0]
        first = int(pauses[-1]) + 1 if len(pauses) else 0
        axes = slice(0, 3) if motion_known else slice(2, 3)
        speed, sigma, lasted = self._steady(t[first:], first, axes)
        if len(t) - first >= 6 and lasted > 0.6 and speed > 4.0 * sigma and speed * lasted > 0.25:
            return True
        speed, sigma, lasted = self._steady(t, 0, axes)
        return len(t) >= 5 and lasted > 1.0 and speed > 4.0 * sigma and speed * lasted > 1.5

    def _steady(self, t: Array64, first: int, axes: slice) -> tuple[float, float, float]:
        """Speed of a straight line through the sightings since `first`, its sigma, and how long they lasted."""
        if len(t) < 3:
            return 0.0, math.inf, 0.0
        x = np.array(self.path_m[first:])[:, axes]
        since = t - t.mean()
        spread = float(since @ since)
        velocity = since @ x / spread
        left = x - x.mean(axis=0) - np.outer(since, velocity)
        sigma = max(0.15 + 0.004 * self.range_m, math.sqrt(float((left**2).sum()) / left.size)) / math.sqrt(spread)
        return float(np.linalg.norm(velocity)), sigma, float(np.ptp(t))
