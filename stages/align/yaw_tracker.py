"""Track the yaw between the cameras through time: the match of the spectra and the multiple of 90 deg.

    dead reckoning    the last yaw, propagated by the measured turns of the drone and the vehicle
    offset            yaw of the images less the dead reckoned yaw: it drifts slowly (a scalar Kalman filter)
    maps              mean spectra of each camera over the last seconds, in the axes of dead reckoning

The images give yaw modulo 90 deg; the match nearest to the prediction is used. The probability that the true yaw is
a multiple of 90 deg away follows from the variance of the prediction and shifts the branch probabilities. Streets at
other angles cause further matches. The first match comes from the maps, which contain more streets than one image, and
is accepted only when

    nearly all lines of both cameras match and no other match is similar       (streets at right angles), or
    most lines match, along two directions or more, and no other is similar    (streets at other angles)

as one direction alone fits any street. Where the drone's motion gives its heading (motion_branch.py), the match at that
heading is used even if others compete, and a match that motion contradicts is released. A match that fits the maps
better for some time replaces the tracked one, and the jump is reported.

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

MIN_SEPARATION_RAD = math.radians(4.0)  # matches nearer to each other are the same
NEARLY_ALL, MOST = 0.8, 0.75  # of the lines
ONE_COMPETES, MORE_COMPETE = 0.65, 0.72  # a second match with this share of the best likeness makes it ambiguous
CONFIRMED_SHARE = 0.35  # of the lines, for a match that motion confirms
CONTRADICTION_RAD = math.radians(3.0)  # allowed difference of streets and motion, beyond the sigma of the heading
MIN_LIKENESS = 0.2  # of the tracked match, in one image
GATE_RAD = math.radians(2.5)  # of the prediction
REPLACE_AFTER_S = 2.0  # a better match at another yaw replaces the tracked one after this time
MEMORY_S = 20.0
LOST_RAD2 = math.radians(20.0) ** 2  # a prediction with a larger variance is not used
BLUR_RAD2 = math.radians(1.0) ** 2  # a step with a larger variance clears the maps
LATE_S = 0.02  # error of the stamps, which matters during a turn
IMAGE_SIGMA_RAD = math.radians(0.7)  # of the yaw of one image, correlated in time
PERIOD_S = 0.2  # errors of images closer in time are correlated: all of them count as one image


@dataclass(frozen=True)
class Match:
    """The selected yaw, or the reason for its absence."""

    yaw_rad: float | None  # full circle, near the prediction
    reason: str


@dataclass
class YawTracker:
    """Offset of the images' yaw from dead reckoning; `offset_rad` is None until a match is found."""

    offset_rad: float | None = None
    variance_rad2: float = 0.0
    reacquired: bool = False  # the match just selected replaces another one
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

    def is_contradicted(self, motion_heading: Heading | None) -> bool:
        """Whether the drone's motion contradicts the match."""
        return (
            self.offset_rad is not None and motion_heading is not None and not _agrees(motion_heading, self.offset_rad)
        )

    def release(self) -> None:
        """Release the match; the maps stay."""
        self.offset_rad, self._better_since_ns = None, None

    def choose(
        self,
        vehicle: Array64,
        drone: Array64,
        at: DeadReckonedYaw,
        rate_radps: float,
        motion_heading: Heading | None = None,
    ) -> Match:
        """Select a match of the spectra (BINS,) of a pair, at the given turn rate of the drone.

        `motion_heading`: the offset by the drone's motion.
        """
        self.reacquired = False
        self.variance_rad2 += at.variance_rad2
        self._add_to_maps(vehicle, drone, at)
        found = [peak for peak in peaks(overlap(vehicle, drone), MIN_SEPARATION_RAD) if peak.likeness > MIN_LIKENESS]
        if not found:
            return Match(None, "the lines of both cameras have no direction in common")
        if self.offset_rad is None or self.variance_rad2 > LOST_RAD2:
            return self._first(found, at, motion_heading)
        if self._better_match(at.stamp_ns):
            match = self._first(found, at, motion_heading)
            self.reacquired = match.yaw_rad is not None
            return match
        predicted = at.yaw_rad + self.offset_rad
        gate = max(GATE_RAD, 4.0 * math.sqrt(self.variance_rad2)) + rate_radps * LATE_S
        near = [peak for peak in found if abs(quarter_difference(peak.yaw_rad - predicted)) < gate]
        if near:
            return Match(predicted + quarter_difference(near[0].yaw_rad - predicted), "")
        off_deg = math.degrees(quarter_difference(found[0].yaw_rad - predicted))
        return Match(None, f"the lines match {off_deg:+.0f} deg from the yaw predicted by dead reckoning")

    def _add_to_maps(self, vehicle: Array64, drone: Array64, at: DeadReckonedYaw) -> None:
        """Add the spectra to the maps; each image has the same weight."""
        since_s = (at.stamp_ns - self._last_ns) * 1e-9
        keep = math.exp(-since_s / MEMORY_S) if at.variance_rad2 < BLUR_RAD2 else 0.0
        self._last_ns = at.stamp_ns
        for seen, heading_rad, store in ((vehicle, at.vehicle_rad, self._vehicle), (drone, at.drone_rad, self._drone)):
            store *= keep
            store += np.roll(seen, round(heading_rad / BIN_RAD)) / max(float(seen.sum()), 1e-9)

    def _unambiguous_match(self) -> tuple[Peak | None, str]:
        """The match of the maps, an offset modulo 90 deg, if it is unambiguous; else the reason."""
        found = peaks(overlap(self._vehicle, self._drone), MIN_SEPARATION_RAD)
        if not found or found[0].likeness < MOST:
            return None, f"at most {found[0].likeness if found else 0.0:.0%} of the lines fit any yaw"
        best, second = found[0], found[1].likeness if len(found) > 1 else 0.0
        if shared_directions(self._vehicle, self._drone, best.yaw_rad) < 2:
            if best.likeness < NEARLY_ALL:
                return (
                    None,
                    f"only {best.likeness:.0%} of the lines match, along one direction, which fits any street",
                )
            competes = ONE_COMPETES
        else:
            competes = MORE_COMPETE
        if second > competes * best.likeness:
            difference_deg = abs(math.degrees(quarter_difference(best.yaw_rad - found[1].yaw_rad)))
            return (
                None,
                f"two matches, {difference_deg:.0f} deg apart, fit {best.likeness:.0%} and {second:.0%}",
            )
        return best, ""

    def _first(self, found: list[Peak], at: DeadReckonedYaw, motion_heading: Heading | None) -> Match:
        """The match of the maps, if this image confirms it."""
        best, reason = self._unambiguous_match()
        if best is None:
            return Match(None, reason) if motion_heading is None else self._by_motion(found, at, motion_heading, reason)
        if motion_heading is not None and not _agrees(motion_heading, best.yaw_rad):
            return Match(None, "the best match of the lines contradicts the drone's motion")
        near = [peak for peak in found if abs(quarter_difference(peak.yaw_rad - at.yaw_rad - best.yaw_rad)) < GATE_RAD]
        if not near:
            return Match(None, "the lines of this image contradict those of the last seconds")
        start = at.yaw_rad + (self.offset_rad or 0.0)
        return Match(start + quarter_difference(near[0].yaw_rad - start), "")

    def _by_motion(self, found: list[Peak], at: DeadReckonedYaw, motion_heading: Heading, reason: str) -> Match:
        """The only match of the maps and of this image that agrees with the heading by motion."""
        reach_rad = 3.0 * motion_heading.sigma_rad + math.radians(1.0)
        of_maps = [
            peak
            for peak in peaks(overlap(self._vehicle, self._drone), MIN_SEPARATION_RAD)
            if peak.likeness > CONFIRMED_SHARE
            and abs(quarter_difference(peak.yaw_rad - motion_heading.turn_rad)) < reach_rad
        ]
        if len(of_maps) != 1:
            which = "several matches" if of_maps else "no match"
            return Match(None, f"{reason}, and {which} at the heading by the drone's motion")
        offset_rad = motion_heading.turn_rad + quarter_difference(of_maps[0].yaw_rad - motion_heading.turn_rad)
        start = at.yaw_rad + offset_rad
        near = [peak for peak in found if abs(quarter_difference(peak.yaw_rad - start)) < GATE_RAD]
        if not near:
            return Match(None, "the lines of this image contradict those of the last seconds")
        return Match(start + quarter_difference(near[0].yaw_rad - start), "")

    def _better_match(self, stamp_ns: int) -> bool:
        """Whether the maps have had an unambiguous match at another yaw for REPLACE_AFTER_S."""
        best, _ = self._unambiguous_match()
        offset_rad = self.offset_rad or 0.0
        if best is None or abs(quarter_difference(best.yaw_rad - offset_rad)) < 2 * GATE_RAD:
            self._better_since_ns = None
            return False
        if self._better_since_ns is None:
            self._better_since_ns = stamp_ns
        return (stamp_ns - self._better_since_ns) * 1e-9 >= REPLACE_AFTER_S

    def accept(self, yaw_rad: float, sigma_rad: float, at: DeadReckonedYaw) -> Array64:
        """Update by the refined yaw. Returns weights (4,): that the true yaw is the tracked one plus m times 90 deg."""
        off = yaw_rad - at.yaw_rad
        since_s = (at.stamp_ns - self._accepted_ns) * 1e-9
        self._accepted_ns = at.stamp_ns
        noise = (sigma_rad**2 + IMAGE_SIGMA_RAD**2) * max(PERIOD_S / max(since_s, 1e-3), 1.0)
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


def _agrees(motion_heading: Heading, offset_rad: float) -> bool:
    """Whether an offset agrees with the heading by motion, modulo 90 deg."""
    return (
        abs(quarter_difference(offset_rad - motion_heading.turn_rad))
        < 4.0 * motion_heading.sigma_rad + CONTRADICTION_RAD
    )
