"""A vehicle past its last word: on as it went, for a while, and less sure the longer nobody tells.

    off by   a t^2 / 2 in place,   alpha t^2 / 2 in its turn        t since the last word

Its speed is that of a tenth of a second or more: words that arrive together would make a parked vehicle race.
Three go on past a word, each as far as an error of its own costs:

    VehicleTrajectory (trail.py)     TRAIL_S, straight on; USUAL. Asked at every slice, and the next word, which
    comes soon,
                                takes the error back
    VehicleMotionSelector (ego)   JOINT_S, along its bend; UNTOLD. Another source is laid on there: the error
    stays
    VisualLidarOdometry (ego)            to the next picture, straight on; UNTOLD, and a turn at any usual rate: how
    it turned is
                                what its pictures would have told

A word that is farther off than HARD lets it be is false, or its start frame has jumped, as when an odometry is started
afresh: it is left out, and when three such in a row lie on one smooth way, that is the way, in another start frame.
After seconds of silence HARD lets it be nearly anywhere: a small jump in them is not seen. So after three odd words one
that may be true is not enough: nonsense that goes on would have one such in time.

Source: ours.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import VehicleMotion

TRAIL_S = 0.3
JOINT_S = 1.0
LEAST_SPAN_NS = 100_000_000  # of the last motion, over which its speed is taken
MOST_SPAN_NS = 1_000_000_000
OFF_M, OFF_RAD = 0.25, 0.1  # a word so far off is false, or the start frame has jumped
LATE_S = 0.03  # a busy host stamps a word so much too late: at speed that is a way
FASTEST_MPS, FASTEST_RADPS = 60.0, 2.0  # where no speed is known yet
AGREE = 3
Placed = tuple[Array64, Array64]  # R (3, 3), xyz (3,) [m] in one frame


@dataclass(frozen=True)
class MayChange:
    """How hard a vehicle may speed up, brake or swerve while nobody tells."""

    acceleration_mps2: float
    turn_radps2: float

    def place_m(self, seconds: float) -> float:
        """How far that takes it from where it would be."""
        return 0.5 * self.acceleration_mps2 * seconds**2

    def turn_rad(self, seconds: float) -> float:
        """And how far it turns it."""
        return 0.5 * self.turn_radps2 * seconds**2


USUAL = MayChange(2.0, 0.2)  # one sigma, in traffic, from one word to the next
UNTOLD = MayChange(3.0, 0.5)  # one sigma, over a gap in which anything may begin
HARD = MayChange(6.0, 1.5)  # no vehicle on the road does much more: full braking, a swerve


class JumpWatch:
    """Which words are believed, by whether each is where those before lead."""

    def __init__(self) -> None:
        self._odd: deque[VehicleMotion] = deque(maxlen=AGREE)  # left out since the newest believed

    def hear(self, motion: VehicleMotion, leads: bool) -> tuple[VehicleMotion, ...]:
        """What is believed now: the word; nothing yet; or three at once, and the start frame may be another one."""
        if not leads or len(self._odd) == AGREE:
            self._odd.append(motion)
            if not _go_on(tuple(self._odd)):
                return ()
        believed = (motion,) if leads else tuple(self._odd)
        self._odd.clear()
        return believed


class BelievedWords:
    """The words of one source that are believed, in its own start frame."""

    def __init__(self) -> None:
        self._watch = JumpWatch()
        self._words: deque[VehicleMotion] = deque(maxlen=64)  # of one start frame
        self.speed_mps: float | None = None  # as they told it last; None: they never did

    @property
    def newest_ns(self) -> int | None:
        """Time of the newest."""
        return self._words[-1].stamp_ns if self._words else None

    def hear(self, motion: VehicleMotion) -> tuple[VehicleMotion, ...]:
        """What is believed now, as JumpWatch says; a word that is not newer than the last is to be left out before."""
        believed = (motion,) if not self._words else self._watch.hear(motion, self._leads_to(motion))
        if len(believed) > 1:
            self._words.clear()  # of another start frame
        self._words.extend(believed)
        if believed:
            told_mps = speed_mps(list(self._words))
            self.speed_mps = self.speed_mps if told_mps is None else told_mps
        return believed

    def _leads_to(self, motion: VehicleMotion) -> bool:
        words, last_ns = list(self._words), self._words[-1].stamp_ns
        at = along_its_bend(words, motion.stamp_ns, until_s=math.inf)
        expected, told = ((m.R_map_vehicle, m.xyz_map_m) for m in (at, motion))
        return leads_to(expected, told, (motion.stamp_ns - last_ns) * 1e-9, speed_mps(words))


def leads_to(expected: Placed, told: Placed, seconds: float, speed_mps: float | None) -> bool:
    """Whether the vehicle may be there, so long after the last word, which led it to another place.

    `speed_mps` is the speed it was led on at, None where none is known yet.
    """
    place_m, turn_rad = OFF_M + HARD.place_m(seconds), OFF_RAD + HARD.turn_rad(seconds)
    if speed_mps is None:
        place_m, turn_rad = place_m + FASTEST_MPS * seconds, turn_rad + FASTEST_RADPS * seconds
    else:
        place_m += LATE_S * speed_mps
    (R, xyz_m), (R_told, told_m) = expected, told
    near = float(np.linalg.norm(told_m - xyz_m)) <= place_m
    return near and float(np.linalg.norm(log_rotation(R.T @ R_told))) <= turn_rad


def _go_on(words: tuple[VehicleMotion, ...]) -> bool:
    """Whether three in a row are of one smooth way: the second step goes on as the first."""
    if len(words) < AGREE:
        return False
    a, b, c = words
    first_s, second_s = (b.stamp_ns - a.stamp_ns) * 1e-9, (c.stamp_ns - b.stamp_ns) * 1e-9
    if min(first_s, second_s) <= 0.0:
        return False
    share, longer_s = second_s / first_s, max(first_s, second_s)
    off_m = c.xyz_map_m - b.xyz_map_m - share * (b.xyz_map_m - a.xyz_map_m)
    turns = log_rotation(a.R_map_vehicle.T @ b.R_map_vehicle), log_rotation(b.R_map_vehicle.T @ c.R_map_vehicle)
    near = float(np.linalg.norm(off_m)) <= OFF_M + 2.0 * HARD.place_m(longer_s)
    return near and float(np.linalg.norm(turns[1] - share * turns[0])) <= OFF_RAD + 2.0 * HARD.turn_rad(longer_s)


def along_its_bend(told: list[VehicleMotion], stamp_ns: int, until_s: float = JOINT_S) -> VehicleMotion:
    """Where the vehicle is some time after the last word (`told`, oldest first), less sure as UNTOLD says.

    Its speed and turn, in its own axes, are those over the last tenth of a second or more; after `until_s` it is taken
    to stand where it is then, and what it is unsure by grows on.
    """
    last = told[-1]
    untold_s = (stamp_ns - last.stamp_ns) * 1e-9
    span_ns, before = _speed_span(told)
    share = min(untold_s, until_s) / (span_ns * 1e-9) if span_ns else 0.0
    R = last.R_map_vehicle
    turn = log_rotation(np.ascontiguousarray(before.R_map_vehicle.T @ R))
    way_m = exp_rotation(-0.5 * turn) @ before.R_map_vehicle.T @ (last.xyz_map_m - before.xyz_map_m)  # own axes
    unsure = np.diag([UNTOLD.turn_rad(untold_s) ** 2] * 3 + [UNTOLD.place_m(untold_s) ** 2] * 3)
    return VehicleMotion(
        stamp_ns=stamp_ns,
        xyz_map_m=last.xyz_map_m + R @ exp_rotation(0.5 * share * turn) @ (share * way_m),
        R_map_vehicle=R @ exp_rotation(share * turn),
        covariance=None if last.covariance is None else last.covariance + unsure,
    )


def speed_mps(told: list[VehicleMotion]) -> float | None:
    """The speed that the words tell; None: they tell none."""
    span_ns, before = _speed_span(told)
    return float(np.linalg.norm(told[-1].xyz_map_m - before.xyz_map_m)) / (span_ns * 1e-9) if span_ns else None


def _speed_span(told: list[VehicleMotion]) -> tuple[int, VehicleMotion]:
    """Since which word the speed is taken, and how long before the last that was; 0: no speed is known."""
    last = told[-1]
    spans_ns = ((last.stamp_ns - m.stamp_ns, m) for m in reversed(told))
    span_ns, before = next(((span, m) for span, m in spans_ns if span >= LEAST_SPAN_NS), (0, last))
    return (span_ns, before) if span_ns <= MOST_SPAN_NS else (0, last)
