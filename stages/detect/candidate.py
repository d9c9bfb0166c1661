"""One candidate: a constant-velocity Kalman filter and the evidence that its observations have added.

The filter estimates position and velocity in the map frame, with equal variances on the three axes. The counters kept
here become features (`stages/detect/trained/features.py`), from which the model computes the log-odds of a drone.

Source: ours; DESIGN, "evaluated as data arrives".
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field

import numpy as np

from stages.detect.flight import Motion, fit_motion, lamp_sway_m, moves, wire_sway_m
from stages.detect.motion_log_ratios import DENIED, MotionLogRatios
from stages.detect.trained.existence import observed_nats, survived_nats
from stages.geometry.frames import Array64
from stages.kernels.detect.candidate import ACCELERATION_MPS2, SIGMA_M, neighbour_score, return_count_nats
from stages.kernels.detect.existence import LEAST_FALSE_PER_S
from stages.kernels.detect.first_observations import STATIC_M
from stages.kernels.detect.isolation import SECTORS
from stages.sums import sum_in_order

HISTORY = 40  # observations kept
SAME_PASS_NS = 30_000_000  # observations this close in time belong to one scan pass
FADING = 0.95  # a neighbour's weight is multiplied by this at each later observation,
NEIGHBOUR_RADIUS_M = 2.0  # and does not count once the candidate is this far away: it does not hold the candidate
SINGLE_RETURN_NATS = -1.0  # threshold of `Candidate.return_count_nats` below which `returns_singly` is true
OPEN_NEIGHBOUR_SCORE = 0.5  # a lower `Candidate.neighbour_score` means open air around it
START_SPEED_MPS = 6.0  # one sigma about the vehicle's own velocity


class Alternative(enum.Enum):
    """What a candidate is when it is not a drone."""

    FALSE_RETURN = "a false return"
    STATIC = "a lamp, wire or edge"
    BIRD = "a bird"
    BALLOON = "a balloon"


@dataclass(slots=True, eq=False)
class Observation:
    """The returns of one scan pass on one small object."""

    stamp_ns: int
    xyz_map_m: Array64  # (3,)
    vehicle_map_m: Array64  # (3,) position of the vehicle at stamp_ns
    range_m: float
    returns: int
    too_long: bool  # its returns extend farther than a drone
    round_chords: int  # chords that bulge smoothly
    rough_chords: int  # chords with enough returns to bulge smoothly that do not
    isolation: Array64  # (TALLY,) sector counts, see stages/detect/isolation.py
    large_object_m: float  # distance to the nearest large object; inf: none


@dataclass(slots=True, eq=False)
class Candidate:
    """Position and velocity in the map frame by a Kalman filter with equal axes, and the evidence so far."""

    number: int
    stamp_ns: int
    xyz_m: Array64
    velocity_mps: Array64
    range_m: float
    p: tuple[float, float, float]  # variances: position, position-velocity, velocity
    first_returns: int
    scan_passes: int = 1  # passes of the rotor in which it was observed
    first_ns: int = 0  # of its first observation; of a reacquired one, since it was reacquired
    existence_nats: float = 0.0  # log-odds that one object causes its observations, see trained/existence.py
    false_per_s: float = LEAST_FALSE_PER_S  # rate of false returns at its range, at its last observation
    observations: int = 0
    features: Array64 = field(default_factory=lambda: np.zeros(0))  # at its newest classification
    returns: int = 0
    too_long_passes: int = 0
    return_count_nats: float = 0.0  # log ratio drone over wire of the numbers of returns
    neighbour_score: float = 0.0  # weighted number of recent observations, near its position, with a neighbour
    isolated_score: float = 0.0  # the same without a neighbour
    round_chords: int = 0
    rough_chords: int = 0
    fastest_mps: float = 0.0  # highest speed and acceleration that it significantly reached
    hardest_mps2: float = 0.0
    motion: Motion | None = None  # recent motion in the map frame
    slower_motion: Motion | None = None  # the slower of map and vehicle frame: a drone follows the vehicle, a bird not
    free: Array64 = field(default_factory=lambda: np.zeros(SECTORS))  # observations in which each sector was free
    large_object_passes: int = 0
    large_object_m: float = math.inf
    seen_ns: int = 0
    own_log_odds: float = 0.0  # newest result of the model, as if it were the only candidate
    single_log_odds: float = 0.0  # with cues
    log_odds: float = 0.0  # with cues and with the other candidates, of which one at most is the drone
    cue_nats: float | None = None  # what cues add to it; None: no cue yet
    cue_ns: int = 0  # when that was computed
    proven_cues: set[str] = field(default_factory=set[str])  # sources of the cues that are proven to be of it
    reason: str = ""  # for people
    alternative: Alternative = Alternative.FALSE_RETURN  # the most probable one at its newest classification
    near_rejected: bool = False  # something was rejected near its first position
    revisited: bool = False  # something was rejected at its first position, while the drone reports that it flies
    reacquired_at: int = 0  # scan passes before it was reacquired at another position; 0: never
    reacquired_ns: int = 0
    accepted: bool = False
    announced: bool = False  # published as accepted
    is_promising: bool = False  # probable enough for further observation
    was_promising: bool = False  # it was promising once, so its further fate is published
    calm_s: float = 0.0  # time in which it significantly flew more calmly than any bird
    path_ns: list[int] = field(default_factory=lambda: list[int]())
    path_m: list[Array64] = field(default_factory=lambda: list[Array64]())
    relative_path_m: list[Array64] = field(default_factory=lambda: list[Array64]())  # relative to the vehicle
    # positions in the map frame [m] at which a neighbour was measured, each with its faded weight
    neighbours: list[tuple[Array64, float]] = field(default_factory=lambda: list[tuple[Array64, float]]())
    log_ratios: MotionLogRatios | None = None  # newest comparison of its path with telemetry; None: none yet
    imu_log_ratios: MotionLogRatios | None = None  # the same by its IMU alone; None: no IMU, or telemetry
    flight_log_ratio: float = 0.0  # highest log ratio over a static object or wire reached in open air [nats]

    def predict_as_drone(self, stamp_ns: int, expected_mps: Array64, spread_mps: float) -> tuple[Array64, Array64]:
        """Position and velocity (3,) [m, m/s] at `stamp_ns`, assuming that the candidate is a drone.

        The prior of a drone's velocity is `expected_mps` (3,) with sigma `spread_mps` on each axis. It matters after
        few observations: two of them determine the velocity only to some metres a second.
        """
        share = spread_mps**2 / (spread_mps**2 + self.p[2])
        velocity = expected_mps + share * (self.velocity_mps - expected_mps)
        return self.xyz_m + (stamp_ns - self.stamp_ns) * 1e-9 * velocity, velocity

    def update(self, s: Observation) -> None:
        """Update the filter and the evidence with one more observation."""
        dt = (s.stamp_ns - self.stamp_ns) * 1e-9
        a, b, c = self.p
        q = ACCELERATION_MPS2**2
        a, b, c = a + 2 * dt * b + dt * dt * c + q * dt**4 / 4, b + dt * c + q * dt**3 / 2, c + q * dt * dt
        x = self.xyz_m + dt * self.velocity_mps
        gain_x, gain_v = a / (a + SIGMA_M**2), b / (a + SIGMA_M**2)
        innovation = s.xyz_map_m - x
        self.existence_nats = survived_nats(self.existence_nats, dt) + observed_nats(
            float(innovation @ innovation), a + SIGMA_M**2, s.range_m, s.returns, self.false_per_s
        )
        self.xyz_m = x + gain_x * innovation
        self.velocity_mps = self.velocity_mps + gain_v * innovation
        self.p = (1 - gain_x) * a, (1 - gain_x) * b, c - gain_v * b
        self.scan_passes += s.stamp_ns - self.seen_ns > SAME_PASS_NS
        self.stamp_ns = self.seen_ns = s.stamp_ns
        self.range_m = s.range_m
        self.add_observation(s)

    def add_observation(self, s: Observation) -> None:
        """Add the evidence of one observation, without the filter update."""
        self.observations += 1
        self.returns += s.returns
        self.too_long_passes += s.too_long
        self.return_count_nats += return_count_nats(s.returns, s.range_m)
        self.round_chords += s.round_chords
        self.rough_chords += s.rough_chords
        weight, measured = neighbour_score(s.isolation, self.free)
        self.neighbours = [(position_m, FADING * faded) for position_m, faded in self.neighbours[-HISTORY:]]
        if weight > 0.0:
            self.neighbours.append((s.xyz_map_m, weight))
        self.neighbour_score = sum_in_order(
            [faded for position_m, faded in self.neighbours if math.dist(position_m, s.xyz_map_m) < NEIGHBOUR_RADIUS_M]
        )
        self.isolated_score = FADING * self.isolated_score + (measured and weight == 0.0)
        self.large_object_m = s.large_object_m
        self.large_object_passes += math.isfinite(s.large_object_m)
        self.path_ns.append(s.stamp_ns)
        self.path_m.append(s.xyz_map_m)
        self.relative_path_m.append(s.xyz_map_m - s.vehicle_map_m)
        if len(self.path_ns) > HISTORY:
            del self.path_ns[0], self.path_m[0], self.relative_path_m[0]
        self._update_motion()

    @property
    def returns_singly(self) -> bool:
        """Whether its scan passes gave single returns significantly more often than those of a drone."""
        return self.return_count_nats < SINGLE_RETURN_NATS

    @property
    def apparent_motion_m(self) -> float:
        """Apparent displacement that a static object may have: a lamp on an unseen pole, or a wire."""
        return max(lamp_sway_m(self.range_m), wire_sway_m(self.range_m) if self.returns_singly else 0.0)

    def add_log_ratios(self, log_ratios: MotionLogRatios | None) -> None:
        """Store the newest comparison with telemetry, and its best value reached in open air.

        None: no telemetry at its newest observations; the earlier comparison remains, since it is the same object.
        Evidence of flight in open air remains when the candidate comes near an object, unless telemetry contradicts it.
        """
        if log_ratios is None:
            return
        self.log_ratios = log_ratios
        if log_ratios.over_static < DENIED:
            self.flight_log_ratio = 0.0
        elif self.neighbour_score < OPEN_NEIGHBOUR_SCORE and log_ratios.displacement_m > self.apparent_motion_m:
            self.flight_log_ratio = max(self.flight_log_ratio, log_ratios.over_wire)

    def _update_motion(self) -> None:
        """Fit the recent motion; accumulate the time in which it flew as no bird does, or stayed over a pause."""
        self.motion = self.slower_motion = None
        if len(self.path_ns) < 2:
            return
        motions = fit_motion(self.path_ns, (self.path_m, self.relative_path_m), self.range_m)
        if motions is not None:
            self.motion, relative = motions
            self.slower_motion = relative if relative.top_mps < self.motion.top_mps else self.motion
        since_s = (self.path_ns[-1] - self.path_ns[-2]) * 1e-9
        displacement_m = float(np.linalg.norm(self.path_m[-1] - self.path_m[-2]))
        flown = self.slower_motion
        if flown is not None:
            self.fastest_mps = max(self.fastest_mps, flown.speed_mps - 1.5 * flown.speed_sigma_mps)
            self.hardest_mps2 = max(self.hardest_mps2, flown.acceleration_mps2 - 2.5 * flown.acceleration_sigma_mps2)
        if since_s > 0.4:
            calm = self.scan_passes >= 4 and displacement_m < 1.0 * since_s
        else:
            calm = flown is not None and flown.calm
        self.calm_s += min(since_s, 0.8) * calm

    @property
    def is_static(self) -> bool:
        """Whether its last observations lie within `STATIC_M`, after at least three scan passes."""
        recent_m = np.array(self.path_m[-8:])
        return self.scan_passes >= 3 and float(np.ptp(recent_m, axis=0).max()) < STATIC_M

    def reactivate(self, stamp_ns: int) -> None:
        """Restart the filter at rest at its last position: the static object was observed again."""
        self.xyz_m, self.velocity_mps = np.mean(self.path_m[-8:], axis=0), np.zeros(3)
        self.stamp_ns, self.p = stamp_ns, (0.3**2, 0.0, 0.5**2)

    def moves(self, motion_known: bool) -> bool:
        """Whether it has significantly moved in the map frame; see `stages/detect/flight.py`."""
        return moves(self.path_ns, self.path_m, self.range_m, motion_known)
