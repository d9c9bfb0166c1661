"""One thing that may be a drone: where it goes, and what was noticed of it at each look.

Position and velocity in the local frame by a Kalman filter whose axes are alike, and tallies. What it is say
`stages/detect/classifier.py` with them.

Source: ours; DESIGN, "evaluated as data arrives".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from stages.detect.flight import Motion, fit_motion, lamp_m, moves, wire_m
from stages.detect.motion_log_ratios import DENIED, Heard
from stages.geometry.frames import Array64
from stages.kernels.detect.candidate import ACCELERATION_MPS2, SIGMA_M, what_stands_beside
from stages.kernels.detect.isolation import SECTORS

HISTORY = 40  # sightings
SAME_LOOK_NS = 30_000_000
FADING = 0.95  # what stood beside it counts less with each look since,
HELD_M = 2.0  # and not at all once it is so far away: that does not hold it
ALONE_PER_M = 0.0165  # share of looks at a drone that find one return alone (nearby: few), over range
WIRE_ALONE = 0.75  # and of those at a wire
FEW_M = 24.0  # over range: so few returns are few even nearby; a sixth of those of a beam across a drone of 0.5 m
SOME_M = 36.0  # over range: up to so many tell nothing, a wire returns them, too
SINGLE = -1.0  # nats, of `Candidate.few`
STANDING_M = 0.6  # what stands is met again within this
OPEN_BESIDE = 0.5  # of `Candidate.beside`: less, and it flies in the open
START_SPEED_MPS = 6.0  # one sigma about the vehicle's own velocity


@dataclass(slots=True, eq=False)
class Sighting:
    """One look's returns on one small thing."""

    stamp_ns: int
    xyz_map_m: Array64  # (3,)
    vehicle_map_m: Array64  # (3,) where the vehicle was then
    range_m: float
    hits: int
    too_long: bool  # its returns extend farther than a drone
    balls: int  # chords that bulge smoothly
    rugged: int  # chords that could have and do not
    around: Array64  # (TALLY,) of stages/detect/isolation.py
    big_m: float  # distance to the nearest big thing, inf: none


@dataclass(slots=True, eq=False)
class Candidate:
    """Position and velocity in the local frame by a Kalman filter with equal axes, and the evidence so far."""

    number: int
    stamp_ns: int
    xyz_m: Array64
    velocity_mps: Array64
    range_m: float
    p: tuple[float, float, float]  # variances: position, position-velocity, velocity
    first_hits: int
    hit_looks: int = 1
    missed: float = 0.0  # expected returns that did not come
    hits: int = 0
    long_looks: int = 0
    few: float = 0.0
    beside: float = 0.0  # recent looks, about where it is now, in which something stood beside it
    alone: float = 0.0  # and those in which nothing did
    balls: int = 0
    rugged: int = 0
    fastest_mps: float = 0.0  # speed and acceleration it clearly reached once
    hardest_mps2: float = 0.0
    motion: Motion | None = None  # lately, in the world
    gentler: Motion | None = None  # the same, or beside the vehicle if that is slower: a drone comes along, a bird not
    free: Array64 = field(default_factory=lambda: np.zeros(SECTORS))  # looks in which the sector was free
    big_looks: int = 0
    big_m: float = math.inf
    seen_ns: int = 0
    odds: float = 0.0  # as last judged
    why: str = ""
    suspect: str = ""  # what it is if it is no drone
    among: bool = False  # where it appeared, something had been refused
    again: bool = False  # in the very place, and the drone says that it flies
    joined_at: int = 0  # looks before it was met again elsewhere, as the drone says that it flew; 0: never
    joined_ns: int = 0  # when
    accepted: bool = False
    announced: bool = False  # as accepted
    told: bool = False  # it is worth another look
    calm_s: float = 0.0  # for how long it clearly flew as no bird does
    worth: bool = False  # it was once worth a look: what became of it is told, too
    path_ns: list[int] = field(default_factory=lambda: list[int]())
    steady_s: float = 0.0  # for how long it clearly flew straight on
    beside_m: list[Array64] = field(default_factory=lambda: list[Array64]())  # its path seen from the vehicle's place
    path_m: list[Array64] = field(default_factory=lambda: list[Array64]())
    held: list[tuple[Array64, float]] = field(default_factory=lambda: list[tuple[Array64, float]]())
    # where it was, local frame [m], when something stood beside it, and how surely that counts by now
    heard: Heard | None = None  # its path against what the drone tells of its own; None: the drone is silent
    flown: float = 0.0  # the most that ever said against a still thing or a wire [nats], while nothing stood beside it

    def as_drone(self, stamp_ns: int, usual_mps: Array64, spread_mps: float) -> tuple[Array64, Array64]:
        """Position and velocity (3,) at a time if it is a drone, which usually flies so, one sigma on each axis.

        After two sightings its velocity is known to some metres a second; a drone's is better known beforehand.
        """
        share = spread_mps**2 / (spread_mps**2 + self.p[2])
        velocity = usual_mps + share * (self.velocity_mps - usual_mps)
        return self.xyz_m + (stamp_ns - self.stamp_ns) * 1e-9 * velocity, velocity

    def see(self, s: Sighting) -> None:
        """Take in one more sighting."""
        dt = (s.stamp_ns - self.stamp_ns) * 1e-9
        a, b, c = self.p
        q = ACCELERATION_MPS2**2
        a, b, c = a + 2 * dt * b + dt * dt * c + q * dt**4 / 4, b + dt * c + q * dt**3 / 2, c + q * dt * dt
        x = self.xyz_m + dt * self.velocity_mps
        gain_x, gain_v = a / (a + SIGMA_M**2), b / (a + SIGMA_M**2)
        innovation = s.xyz_map_m - x
        self.xyz_m = x + gain_x * innovation
        self.velocity_mps = self.velocity_mps + gain_v * innovation
        self.p = (1 - gain_x) * a, (1 - gain_x) * b, c - gain_v * b
        self.hit_looks += s.stamp_ns - self.seen_ns > SAME_LOOK_NS
        self.stamp_ns = self.seen_ns = s.stamp_ns
        self.range_m = s.range_m
        self.note(s)

    def note(self, s: Sighting) -> None:
        """Count what this look says of it."""
        self.hits += s.hits
        self.long_looks += s.too_long
        alone = min(max(ALONE_PER_M * s.range_m, 0.1), 0.7)
        few = s.hits <= max(1.0, FEW_M / s.range_m)
        if few or s.hits > SOME_M / s.range_m:
            self.few += math.log(alone / WIRE_ALONE) if few else math.log((1 - alone) / (1 - WIRE_ALONE))
        self.balls += s.balls
        self.rugged += s.rugged
        standing, measured = what_stands_beside(s.around, self.free)
        self.held = [(place_m, FADING * sure) for place_m, sure in self.held[-HISTORY:]]
        if standing > 0.0:
            self.held.append((s.xyz_map_m, standing))
        self.beside = sum([sure for place_m, sure in self.held if math.dist(place_m, s.xyz_map_m) < HELD_M])
        self.alone = FADING * self.alone + (measured and standing == 0.0)
        self.big_m = s.big_m
        self.big_looks += math.isfinite(s.big_m)
        self.path_ns.append(s.stamp_ns)
        self.path_m.append(s.xyz_map_m)
        self.beside_m.append(s.xyz_map_m - s.vehicle_map_m)
        if len(self.path_ns) > HISTORY:
            del self.path_ns[0], self.path_m[0], self.beside_m[0]
        self._note_flight()

    @property
    def single(self) -> bool:
        """Whether its looks returned one pulse each more often than a drone's would."""
        return self.few < SINGLE

    @property
    def swings_m(self) -> float:
        """How far it may seem to swing though it stands: a lamp whose pole is not seen, or a wire."""
        return max(lamp_m(self.range_m), wire_m(self.range_m) if self.single else 0.0)

    def hear(self, heard: Heard | None) -> None:
        """What its path says by now; what flew in the open is not what stands where it comes to, unless denied."""
        self.heard = heard
        if heard is None:
            return
        if heard.over_still < DENIED:
            self.flown = 0.0
        elif self.beside < OPEN_BESIDE and heard.way_m > self.swings_m:
            self.flown = max(self.flown, heard.over_wire)

    def _note_flight(self) -> None:
        """How it flies by now; and the time in which it flew as no bird does, or was still there after a pause."""
        self.motion = self.gentler = None
        motions = fit_motion(self.path_ns, (self.path_m, self.beside_m), self.range_m)
        if motions is not None:
            self.motion, beside = motions
            self.gentler = beside if beside.top_mps < self.motion.top_mps else self.motion
        if len(self.path_ns) < 2:
            return
        since_s = (self.path_ns[-1] - self.path_ns[-2]) * 1e-9
        way_m = float(np.linalg.norm(self.path_m[-1] - self.path_m[-2]))
        flown = self.gentler
        if flown is not None:
            self.steady_s += min(since_s, 0.2) * flown.steady
            self.fastest_mps = max(self.fastest_mps, flown.speed_mps - 1.5 * flown.speed_sigma_mps)
            self.hardest_mps2 = max(self.hardest_mps2, flown.acceleration_mps2 - 2.5 * flown.acceleration_sigma_mps2)
        if since_s > 0.4:
            calm = self.hit_looks >= 4 and way_m < 1.0 * since_s
        else:
            calm = flown is not None and flown.calm
        self.calm_s += min(since_s, 0.8) * calm

    @property
    def stands(self) -> bool:
        """Whether its last sightings lie in one place, as far as they tell: it was looked at, and did not go."""
        place = np.array(self.path_m[-8:])
        return self.hit_looks >= 3 and float(np.ptp(place, axis=0).max()) < STANDING_M

    def wake(self, stamp_ns: int) -> None:
        """It is met again where it stood."""
        self.xyz_m, self.velocity_mps = np.mean(self.path_m[-8:], axis=0), np.zeros(3)
        self.stamp_ns, self.p = stamp_ns, (0.3**2, 0.0, 0.5**2)

    def moves(self, motion_known: bool) -> bool:
        """Whether it has clearly moved in the world; see `stages/detect/flight.py`."""
        return moves(self.path_ns, self.path_m, self.range_m, motion_known)
