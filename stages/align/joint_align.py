"""How the drone is turned in the vehicle's axes, from the lines of both cameras together.

    pairs of pictures (pairing.py) -> yaw spectra and their matches (spectra.py) -> the match that continues the last
    ones (reckoning.py, lock.py) -> all angles refined together (refine.py) -> which quarter turn (yaw_branches), by
    displacements told by LiDAR and by odometry

A rotation is given for each picture of the drone's, or the reason why there is none. It is RESOLVED when one branch has
`resolve_probability`; what the four lack to 1 is that none of them is right. Nothing but motion, or motion and a prior,
gets there; what was RESOLVED is so no longer when the thread of turns is lost, or when motion says otherwise.

Where streets run at many angles the lines alone seldom say which of them both cameras see. The drone's way, told by the
LiDAR and by its autopilot, is a heading without a street (HeadingBank): it says which, and denies a match made askew.
A picture that contradicts what was known of tilt or yaw is given out, but as uncertain as it is far off.

Without `motion` the vehicle is taken to stand if `parked` says so; else nothing is concluded from the drone's motion.

Source: ours, for P IV Eq. 7-10 and V.E; DESIGN, Vision and Yaw branch.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, PrivateAttr

from flow.stage import Stage
from stages.align.lock import YawLock
from stages.align.pairing import Pair, Pairing
from stages.align.reckoning import Reckoned, Reckoning
from stages.align.refine import Refined, Tolerances, refine, street_directions
from stages.align.spectra import level_lines, quarter_difference, spectrum
from stages.geometry import Array64
from stages.messages import (
    BranchState,
    Carrier,
    DroneAttitude,
    DroneFix,
    DroneLocalPosition,
    DroneMotion,
    DroneOdometry,
    RelativeRotation,
    VanishingDirections,
    VehicleMotion,
)
from stages.yaw_branches.bank import NONE, BranchBank, BranchSettings
from stages.yaw_branches.heading_bank import Heading, HeadingBank
from stages.yaw_branches.windows import Windows

SILENCE_SHARE = 1e-4  # chance that the autopilot's heading jumped while it was not heard
NONSENSE = 0.99  # that none of the branches is right, from which all is begun anew
SUSPICION = 0.95  # of that, then
JUMP_RAD = math.radians(30.0)  # of what is given out
SURPRISE_RAD = math.radians(0.3)  # beyond the tilts' own errors
SURE_RAD2 = math.radians(1.0) ** 2  # of the turns felt between two pictures: worse ones contradict nobody
BEARING_RAD = math.radians(2.0)  # error of an odometry's heading within a window


@dataclass
class _Now:
    """What the stage remembers."""

    pairing: Pairing
    bank: BranchBank
    windows: Windows
    reckoning: Reckoning
    headings: HeadingBank  # of the offset, whatever the streets say
    heading_windows: Windows
    lock: YawLock = field(default_factory=YawLock)
    branch: int = 0  # given out, counted from the yaw followed
    given_rad: float | None = None  # yaw given out less the dead reckoned one
    switches: int = 0
    news: str = ""  # to be told with the next rotation
    expected: bool = False  # the prior has been weighed
    surprised: bool = False  # the pictures before contradicted the turns felt


class JointAlign(Stage):
    """Both cameras' lines laid on each other; four branches with probabilities."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset(
        {"motion", "drone_motion", "attitude", "position", "odometry", "fix"}
    )

    max_apart_s: float = Field(0.1, gt=0, le=1)  # between the pictures of a pair; half the slower camera's period
    straight_deg: float = Field(0.25, gt=0, le=5)  # how straight and parallel streets are, one sigma of a line
    direction_sigma_deg: float = Field(0.1, gt=0, le=5)  # error of a street's direction that one camera's lines share
    square_sigma_deg: float = Field(0.5, gt=0, le=5)  # how square crossings are
    tilt_sigma_deg: float = Field(0.05, ge=0, le=5)  # error of a vertical beyond what its picture says
    min_lines: int = Field(5, ge=1)  # of each camera
    parked: bool = False  # the vehicle stands: where the drone moves is known without VehicleMotion
    resolve_probability: float = Field(0.999, gt=0.5, lt=1)
    initial_yaw_deg: float | None = Field(None, ge=-360, le=360)  # the drone's heading in the vehicle's axes at first
    compass_deg: float | None = Field(None, ge=-360, le=360)  # the vehicle's at its start, clockwise from the north
    prior_sigma_deg: float = Field(20.0, gt=0, le=90)  # of either
    prior_trust: float = Field(0.95, gt=0, lt=1)  # that it is right at all: alone it never resolves
    branches: BranchSettings = BranchSettings()

    _now: _Now = PrivateAttr()

    def model_post_init(self, context: Any, /) -> None:
        if self.initial_yaw_deg is not None and self.compass_deg is not None:
            raise ValueError("give initial_yaw_deg or compass_deg, not both")
        self._now = _Now(
            Pairing(round(1e9 * self.max_apart_s)),
            BranchBank(self.branches),
            Windows(self.branches.baseline_m),
            Reckoning(self.parked),
            HeadingBank(self.branches),
            Windows(self.branches.baseline_m, HeadingBank.HYPOTHESES),
        )

    def on_motion(self, motion: VehicleMotion) -> None:
        """Where the vehicle is and how it is turned."""
        self._now.reckoning.add_vehicle(motion)

    def on_attitude(self, attitude: DroneAttitude) -> None:
        """How the drone turns; its yaw's zero is not ours."""
        self._now.reckoning.add_autopilot(attitude)

    def on_position(self, position: DroneLocalPosition) -> None:
        """How the drone moves, in the same frame as its attitude."""
        self._now.reckoning.add_autopilot(position)

    def on_odometry(self, odometry: DroneOdometry) -> None:
        """Both at once."""
        self._now.reckoning.add_autopilot(odometry)

    def on_drone_motion(self, motion: DroneMotion) -> None:
        """Turn and direction from the drone's pictures."""
        self._now.reckoning.add_drone_motion(motion)
        self._now.windows.add_step(motion)

    def on_fix(self, fix: DroneFix) -> None:
        """Where the LiDAR saw the drone: evidence for the branch once it has moved."""
        now, offset_rad = self._now, self._now.lock.offset_rad
        if not now.reckoning.vehicle_known:
            return
        at = now.reckoning.vehicle.at(fix.stamp_ns)
        now.windows.add_fix(fix, *at, now.reckoning.autopilot)
        now.heading_windows.add_fix(fix, *at, now.reckoning.autopilot)
        self._hear_heading(fix.stamp_ns)
        if offset_rad is None:
            return
        bearing_rad = math.hypot(math.sqrt(now.lock.variance_rad2), BEARING_RAD)
        R_start_own = now.reckoning.R_start_own(offset_rad)
        if R_start_own is not None and now.reckoning.autopilot.place(fix.stamp_ns) is not None:
            moved = now.windows.close_metric(R_start_own, bearing_rad)
        else:
            stamps_ns = now.windows.steps_since_start()
            moved = now.windows.close_bearing(now.reckoning.R_start_drone(offset_rad, stamps_ns), bearing_rad)
        if moved is not None:
            now.bank.see(moved)
            if now.bank.probability[NONE] > NONSENSE:
                now.lock.forget()
                self._begin_anew("the drone's motion fits no branch, all is begun anew")

    def _hear_heading(self, stamp_ns: int) -> None:
        """The way that the autopilot tells, laid on the LiDAR's: its heading, without a street."""
        now = self._now
        R_start_own = now.reckoning.R_start_own(0.0)
        if R_start_own is None or now.reckoning.autopilot.place(stamp_ns) is None:
            return
        moved = now.heading_windows.close_metric(R_start_own, 0.0)
        if moved is not None:
            now.headings.see(moved)

    def on_vehicle(self, seen: VanishingDirections) -> Iterator[RelativeRotation]:
        """The vehicle's lines."""
        for pair in self._now.pairing.vehicle(_of(seen, Carrier.VEHICLE, "vehicle")):
            yield self._align(pair)

    def on_drone(self, seen: VanishingDirections) -> Iterator[RelativeRotation]:
        """The drone's lines: one answer each, once the vehicle's nearest picture is known."""
        for pair in self._now.pairing.drone(_of(seen, Carrier.DRONE, "drone")):
            yield self._align(pair)

    def finish(self) -> Iterator[RelativeRotation]:
        """Pictures that still waited for a nearer one."""
        for pair in self._now.pairing.rest():
            yield self._align(pair)

    def _align(self, pair: Pair) -> RelativeRotation:
        """One answer for a pair of pictures."""
        seen_by_vehicle, seen_by_drone = pair
        drone_ns = seen_by_drone.stamp_ns
        if seen_by_vehicle is None:
            return self._no_rotation(drone_ns, f"no picture of the vehicle's within {self.max_apart_s:g} s")
        vehicle_ns = seen_by_vehicle.stamp_ns
        straight_rad = math.radians(self.straight_deg)
        vehicle, drone = level_lines(seen_by_vehicle, straight_rad), level_lines(seen_by_drone, straight_rad)
        if vehicle is None or drone is None or min(len(vehicle.weight), len(drone.weight)) < self.min_lines:
            both = ((seen_by_vehicle, vehicle), (seen_by_drone, drone))
            few = (seen for seen, lines in both if lines is None or len(lines.weight) < self.min_lines)
            return self._no_rotation(
                drone_ns, "; ".join(f"{seen.carrier.value}: {seen.reason or 'too few level lines'}" for seen in few)
            )
        a, b = spectrum(vehicle), spectrum(drone)
        now = self._now
        reckoned = now.reckoning.advance(vehicle_ns, drone_ns, vehicle, drone)
        silences = now.reckoning.new_silences()
        now.bank.pass_time(drone_ns)
        now.bank.mix(1.0 - (1.0 - SILENCE_SHARE) ** silences)
        told = self._told_heading(drone_ns, silences)
        if now.lock.denied(told):
            now.lock.let_go()
            self._begin_anew("the drone's motion denies the streets matched, all is begun anew")
        match = now.lock.choose(a, b, reckoned, now.reckoning.rate_radps(drone_ns), told)
        if match.yaw_rad is None:
            return self._no_rotation(drone_ns, match.reason)
        streets = street_directions(a, b, match.yaw_rad)
        refined = refine(vehicle, drone, streets, match.yaw_rad, self._tolerances())
        if refined.directions == 0 or min(refined.vehicle_lines, refined.drone_lines) < self.min_lines:
            return self._no_rotation(drone_ns, "too few lines run along the same streets")
        if now.lock.relocked:
            self._begin_anew("the lines match elsewhere for long now, all is begun anew there")
        off_yaw = self._surprising_yaw(refined, reckoned)
        now.bank.slip(now.lock.accept(refined.yaw_rad, refined.yaw_sigma_rad, reckoned))
        off = self._surprising_tilt(vehicle_ns, refined, reckoned) + off_yaw * refined.R_drone_level[:, 2]
        self._expect(refined, drone_ns)
        return self._rotation(vehicle_ns, drone_ns, refined, reckoned.yaw_rad, off)

    def _surprising_yaw(self, refined: Refined, reckoned: Reckoned) -> float:
        """By how much [rad] this picture's yaw is off what was known before; 0 if that is near."""
        lock = self._now.lock
        if lock.offset_rad is None or lock.relocked or not lock.variance_rad2 < SURE_RAD2:
            return 0.0
        off_rad = quarter_difference(refined.yaw_rad - reckoned.yaw_rad - lock.offset_rad)
        near_rad = 3.0 * math.hypot(refined.yaw_sigma_rad, math.sqrt(lock.variance_rad2)) + SURPRISE_RAD
        return off_rad if abs(off_rad) > near_rad else 0.0

    def _surprising_tilt(self, vehicle_ns: int, refined: Refined, reckoned: Reckoned) -> Array64:
        """Tilt (3,) [rad], the drone's axes, by which the pictures contradict the turns felt since the last ones.

        Zero where they agree. Leaves and cars have verticals of their own: one picture's word against the turns is not
        taken over, two pictures' is.
        """
        now = self._now
        off = now.reckoning.tilt_off(vehicle_ns, refined, reckoned.yaw_rad)
        tilts = float(np.trace(refined.covariance[:4, :4])) / 2 + reckoned.variance_rad2
        surprised = float(np.linalg.norm(off)) > 3.0 * math.sqrt(tilts) + SURPRISE_RAD
        if not surprised or now.surprised or not reckoned.variance_rad2 < SURE_RAD2:
            now.reckoning.correct(vehicle_ns, refined, reckoned.yaw_rad)
        now.surprised = surprised
        return off if surprised and reckoned.variance_rad2 < SURE_RAD2 else np.zeros(3)

    def _told_heading(self, stamp_ns: int, silences: int) -> Heading | None:
        """The offset as the drone's motion tells it; forgotten when the autopilot may have turned its north unheard."""
        headings = self._now.headings
        headings.pass_time(stamp_ns)
        if silences:
            headings.reset()
            self._now.heading_windows.restart()
        return headings.heading

    def _expect(self, refined: Refined, drone_ns: int) -> None:
        """Weigh the word of people or of a compass, once."""
        now = self._now
        if now.expected:
            return
        R_start_own = now.reckoning.R_start_own(now.lock.offset_rad or 0.0)
        off_rad = None
        if self.initial_yaw_deg is not None:
            R = refined.R_vehicle_drone(0)
            off_rad = math.atan2(R[1, 0], R[0, 0]) - math.radians(self.initial_yaw_deg)
        elif self.compass_deg is not None and R_start_own is not None:
            off_rad = math.atan2(R_start_own[1, 0], R_start_own[0, 0]) - math.radians(self.compass_deg)
        if off_rad is not None:
            now.bank.expect_yaw(off_rad, math.radians(self.prior_sigma_deg), self.prior_trust)
            now.expected = True

    def _rotation(
        self, vehicle_ns: int, drone_ns: int, refined: Refined, reckoned_rad: float, off: Array64
    ) -> RelativeRotation:
        """The message for the most probable branch; `off`: by how much it contradicts what is known, its error then."""
        now = self._now
        before, now.branch = now.branch, now.bank.best(now.branch)
        given_rad = refined.yaw_rad + now.branch * math.pi / 2 - reckoned_rad
        if now.given_rad is not None:
            jump_rad = math.remainder(given_rad - now.given_rad, 2 * math.pi)
            if abs(jump_rad) > JUMP_RAD:
                now.switches += 1
                why = "motion says" if before != now.branch else "the streets say"
                now.news = f"JUMP: {why} {math.degrees(jump_rad):+.0f} deg; {now.news}".rstrip("; ")
        now.given_rad = given_rad
        probability = np.roll(now.bank.probability[:4], -now.branch)
        resolved = now.bank.resolved(now.branch, self.resolve_probability)
        left, right, stamp_ns, variance_rad2 = now.reckoning.at_one_moment(vehicle_ns, drone_ns)
        covariance = right.T @ (refined.covariance_rad2(now.branch) + np.outer(off, off)) @ right
        told = f"{refined.directions} directions, {refined.vehicle_lines} and {refined.drone_lines} lines"
        known = f"{now.bank.windows} windows of motion, none right: {now.bank.probability[NONE]:.1g}"
        news, now.news = now.news, ""
        return RelativeRotation(
            stamp_ns=stamp_ns,
            R_vehicle_drone=left @ refined.R_vehicle_drone(now.branch) @ right,
            covariance_rad2=covariance + variance_rad2 * np.eye(3),
            branch_probability=probability,
            state=BranchState.RESOLVED if resolved else BranchState.AMBIGUOUS,
            switches=now.switches,
            reason="; ".join(part for part in (news, told, known) if part),
        )

    def _no_rotation(self, stamp_ns: int, reason: str) -> RelativeRotation:
        now = self._now
        return RelativeRotation(
            stamp_ns=stamp_ns,
            R_vehicle_drone=None,
            covariance_rad2=None,
            branch_probability=np.roll(now.bank.probability[:4], -now.branch),
            state=BranchState.NONE,
            switches=now.switches,
            reason=reason,
        )

    def _begin_anew(self, news: str) -> None:
        now = self._now
        now.news = news
        now.bank.reset(SUSPICION)
        now.windows.restart()
        now.expected = now.expected and self.compass_deg is None  # a compass has not changed its mind

    def _tolerances(self) -> Tolerances:
        return Tolerances(
            straight_rad=math.radians(self.straight_deg),
            direction_rad=math.radians(self.direction_sigma_deg),
            square_rad=math.radians(self.square_sigma_deg),
            tilt_rad=math.radians(self.tilt_sigma_deg),
        )


def _of(seen: VanishingDirections, carrier: Carrier, port: str) -> VanishingDirections:
    if seen.carrier is not carrier:
        raise ValueError(f"input {port!r} got the directions of the {seen.carrier.value}: wire the other camera")
    return seen
