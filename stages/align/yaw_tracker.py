"""Track the yaw between the cameras through time: the match of the spectra and the multiple of 90 deg.

    dead reckoning    yaw told by turning the last one on with the drone's and the vehicle's own turns
    offset            what the images add to it: slow, one number with a variance (a scalar Kalman filter)
    maps              each camera's spectra of the last seconds, laid where dead reckoning has its axes

The images tell yaw modulo 90 deg; the match nearest to the prediction is taken. How far the true one may be whole
quarter turns from it follows from the prediction's variance and goes to the branches. Streets at other angles make
further matches. The first one is taken from the maps, which know more streets than one image, and only when

    nearly all lines of both cameras match and no other match comes near     (streets at right angles), or
    most lines match, along two directions or more, and no other comes near  (streets at other angles)

as one direction alone fits any street. Where the drone's motion gives its heading (motion_branch.py), the match there
is used though others compete, and a match that motion contradicts is released. Another match that fits the maps better
for some time replaces it, and the jump is reported.

Source: ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from stages.align.dead_reckoning import DeadReckonedYaw
from stages.align.spectra import Peak, overlap, peaks, quarter_difference, shared_directions
from stages.geometry.frames import Array64
from stages.heading.heading_bank import Heading
from stages.kernels.align.spectra import BIN_RAD, BINS

APART_RAD = math.radians(4.0)  # matches nearer to each other are one
NEARLY_ALL, MOST = 0.8, 0.75  # of the lines
ONE_COMPETES, MORE_COMPETE = 0.65, 0.72  # a second match with this share of the best's likeness could be it
SOME = 0.35  # of the lines, where motion says that it is this match
DENIED_RAD = math.radians(3.0)  # beyond the heading's own errors: how far streets and motion may be apart
LEAST = 0.2  # likeness of the match that is followed, in one image
GATE_RAD = math.radians(2.5)  # of the prediction
STRIKE_S = 2.0  # a better match elsewhere is believed after this time
MEMORY_S = 20.0
LOST_RAD2 = math.radians(20.0) ** 2  # a prediction this bad follows nothing
BLUR_RAD2 = math.radians(1.0) ** 2  # a step this bad ends the memory
LATE_S = 0.02  # stamps may be off by this, which matters in a turn
PICTURE_RAD = math.radians(0.7)  # one image's yaw, with errors that stay for a while
PERIOD_S = 0.2  # images that come sooner after one another err alike: together they tell no more than one


@dataclass(frozen=True)
class Match:
    """The selected yaw, or why there is none."""

    yaw_rad: float | None  # of the whole circle, near the prediction
    reason: str


@dataclass
class YawTracker:
    """Offset of the images' yaw from dead reckoning; `offset_rad` is None until a match is found."""

    offset_rad: float | None = None
    variance_rad2: float = 0.0
    reacquired: bool = False  # the match just chosen replaces another one
    _vehicle: Array64 = field(default_factory=lambda: np.zeros(BINS))  # maps
    _drone: Array64 = field(default_factory=lambda: np.zeros(BINS))
    _better_since_ns: int | None = None
    _last_ns: int = 0
    _accepted_ns: int = 0

    def forget(self) -> None:
        """Reset the tracker and its maps."""
        self.offset_rad = None
        self._vehicle, self._drone = np.zeros(BINS), np.zeros(BINS)
        self._better_since_ns = None

    def denied(self, told: Heading | None) -> bool:
        """Whether the drone's motion contradicts the match."""
        return self.offset_rad is not None and told is not None and not _agrees(told, self.offset_rad)

    def release(self) -> None:
        """Release the match; the maps stay."""
        self.offset_rad, self._better_since_ns = None, None

    def choose(
        self, vehicle: Array64, drone: Array64, at: DeadReckonedYaw, rate_radps: float, told: Heading | None = None
    ) -> Match:
        """Which match of this pair's spectra (BINS,) it is, while the drone turns at some rate.

        `told`: the offset as the drone's motion tells it.
        """
        self.reacquired = False
        self.variance_rad2 += at.variance_rad2
        self._remember(vehicle, drone, at)
        found = [peak for peak in peaks(overlap(vehicle, drone), APART_RAD) if peak.likeness > LEAST]
        if not found:
            return Match(None, "the two cameras' lines have no direction in common")
        if self.offset_rad is None or self.variance_rad2 > LOST_RAD2:
            return self._first(found, at, told)
        if self._better_match(at.stamp_ns):
            match = self._first(found, at, told)
            self.reacquired = match.yaw_rad is not None
            return match
        predicted = at.yaw_rad + self.offset_rad
        gate = max(GATE_RAD, 4.0 * math.sqrt(self.variance_rad2)) + rate_radps * LATE_S
        near = [peak for peak in found if abs(quarter_difference(peak.yaw_rad - predicted)) < gate]
        if near:
            return Match(predicted + quarter_difference(near[0].yaw_rad - predicted), "")
        off_deg = math.degrees(quarter_difference(found[0].yaw_rad - predicted))
        return Match(None, f"the lines match {off_deg:+.0f} deg from where the cameras' own turns say")

    def _remember(self, vehicle: Array64, drone: Array64, at: DeadReckonedYaw) -> None:
        """Lay the spectra on the maps; each image counts alike."""
        since_s = (at.stamp_ns - self._last_ns) * 1e-9
        keep = math.exp(-since_s / MEMORY_S) if at.variance_rad2 < BLUR_RAD2 else 0.0
        self._last_ns = at.stamp_ns
        for seen, heading_rad, store in ((vehicle, at.vehicle_rad, self._vehicle), (drone, at.drone_rad, self._drone)):
            store *= keep
            store += np.roll(seen, round(heading_rad / BIN_RAD)) / max(float(seen.sum()), 1e-9)

    def _clear(self) -> tuple[Peak | None, str]:
        """The match of the maps, an offset modulo 90 deg, if it is beyond doubt; else why it is not."""
        found = peaks(overlap(self._vehicle, self._drone), APART_RAD)
        if not found or found[0].likeness < MOST:
            return None, f"at most {found[0].likeness if found else 0.0:.0%} of the lines fit any yaw"
        best, second = found[0], found[1].likeness if len(found) > 1 else 0.0
        if shared_directions(self._vehicle, self._drone, best.yaw_rad) < 2:
            if best.likeness < NEARLY_ALL:
                return (
                    None,
                    f"only {best.likeness:.0%} of the lines match, along one direction: it could be any street's",
                )
            competes = ONE_COMPETES
        else:
            competes = MORE_COMPETE
        if second > competes * best.likeness:
            apart_deg = abs(math.degrees(quarter_difference(best.yaw_rad - found[1].yaw_rad)))
            return None, f"two matches {apart_deg:.0f} deg apart fit {best.likeness:.0%} and {second:.0%} of the lines"
        return best, ""

    def _first(self, found: list[Peak], at: DeadReckonedYaw, told: Heading | None) -> Match:
        """The match of the maps, if this image has it too."""
        best, reason = self._clear()
        if best is None:
            return Match(None, reason) if told is None else self._by_motion(found, at, told, reason)
        if told is not None and not _agrees(told, best.yaw_rad):
            return Match(None, "the lines match best elsewhere than the drone's motion says")
        near = [peak for peak in found if abs(quarter_difference(peak.yaw_rad - at.yaw_rad - best.yaw_rad)) < GATE_RAD]
        if not near:
            return Match(None, "this picture's lines match elsewhere than those of the last seconds")
        start = at.yaw_rad + (self.offset_rad or 0.0)
        return Match(start + quarter_difference(near[0].yaw_rad - start), "")

    def _by_motion(self, found: list[Peak], at: DeadReckonedYaw, told: Heading, reason: str) -> Match:
        """The only match of the maps and of this image where the drone's motion says it is."""
        reach_rad = 3.0 * told.sigma_rad + math.radians(1.0)
        of_maps = [
            peak
            for peak in peaks(overlap(self._vehicle, self._drone), APART_RAD)
            if peak.likeness > SOME and abs(quarter_difference(peak.yaw_rad - told.turn_rad)) < reach_rad
        ]
        if len(of_maps) != 1:
            which = "several matches" if of_maps else "no match"
            return Match(None, f"{reason}, and {which} where the drone's motion says")
        offset_rad = told.turn_rad + quarter_difference(of_maps[0].yaw_rad - told.turn_rad)
        start = at.yaw_rad + offset_rad
        near = [peak for peak in found if abs(quarter_difference(peak.yaw_rad - start)) < GATE_RAD]
        if not near:
            return Match(None, "this picture's lines match elsewhere than those of the last seconds")
        return Match(start + quarter_difference(near[0].yaw_rad - start), "")

    def _better_match(self, stamp_ns: int) -> bool:
        """Whether the maps have had a clear match elsewhere for long."""
        best, _ = self._clear()
        offset_rad = self.offset_rad or 0.0
        if best is None or abs(quarter_difference(best.yaw_rad - offset_rad)) < 2 * GATE_RAD:
            self._better_since_ns = None
            return False
        if self._better_since_ns is None:
            self._better_since_ns = stamp_ns
        return (stamp_ns - self._better_since_ns) * 1e-9 >= STRIKE_S

    def accept(self, yaw_rad: float, sigma_rad: float, at: DeadReckonedYaw) -> Array64:
        """Take the refined yaw. Weights (4,): that the true yaw is m quarter turns to the left of the one followed."""
        off = yaw_rad - at.yaw_rad
        since_s = (at.stamp_ns - self._accepted_ns) * 1e-9
        self._accepted_ns = at.stamp_ns
        noise = (sigma_rad**2 + PICTURE_RAD**2) * max(PERIOD_S / max(since_s, 1e-3), 1.0)
        if self.offset_rad is None or self.reacquired or self.variance_rad2 > 4 * LOST_RAD2:
            weights = np.array([1.0, 0.0, 0.0, 0.0]) if self.offset_rad is None else np.full(4, 0.25)
            self.offset_rad, self.variance_rad2 = off, noise
            self._better_since_ns = None
            return weights
        innovation, S = off - self.offset_rad, self.variance_rad2 + noise
        turns = np.array([0, 1, 2, -1, -2])
        chance = np.exp(-0.5 * ((innovation + turns * math.pi / 2) ** 2 - innovation**2) / S)
        weights = np.array([chance[0], chance[1], chance[2] + chance[4], chance[3]])
        gain = self.variance_rad2 / S
        self.offset_rad += gain * innovation
        self.variance_rad2 *= 1 - gain
        return weights / weights.sum()


def _agrees(told: Heading, offset_rad: float) -> bool:
    """Whether an offset is, up to quarter turns, where the drone's motion says."""
    return abs(quarter_difference(offset_rad - told.turn_rad)) < 4.0 * told.sigma_rad + DENIED_RAD
