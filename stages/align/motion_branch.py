"""Yaw by the drone's motion: the branch of the vanishing points, and the heading without them.

    displacement of the drone in windows of flight, by LiDAR and by the drone's odometry (stages/heading)
      -> probabilities of the four branches: the tracked yaw (yaw_tracker.py) plus 0, 90, 180 and 270 deg
      -> the heading of the odometry, without vanishing points: it selects the match and rejects a wrong one

The prior by an initial yaw or a compass is applied once, with the first rotation.

Source: ours, for P V.E; DESIGN, Yaw branch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from stages.align.dead_reckoning import DeadReckoning
from stages.align.refine import Refined
from stages.align.yaw_tracker import YawTracker
from stages.geometry.frames import Array64
from stages.heading.heading_bank import Heading, HeadingBank
from stages.heading.hypothesis_bank import NONE, BranchSettings, HypothesisBank
from stages.heading.windows import Windows
from stages.messages import DroneFix, VisualMotion

SILENCE_SHARE = 1e-4  # probability that the autopilot's heading jumped during a telemetry gap
MAX_NONE = 0.99  # probability that no branch is right, above which the match and the branches are reset
NONE_AFTER_RESET = 0.95  # probability that no branch is right, after the reset
BEARING_RAD = math.radians(2.0)  # heading error of an odometry within a window


@dataclass(frozen=True)
class Prior:
    """Prior of the drone's heading by configuration or compass; at most one of them is set."""

    initial_yaw_rad: float | None  # in the vehicle's axes
    compass_rad: float | None  # initial heading of the vehicle, clockwise from north
    sigma_rad: float
    trust: float


class MotionBranch:
    """Updates the branch probabilities and the heading by motion, window by window."""

    def __init__(
        self, settings: BranchSettings, prior: Prior, dead_reckoning: DeadReckoning, tracker: YawTracker
    ) -> None:
        self._prior, self._prior_weighed = prior, False
        self._dead_reckoning, self._tracker = dead_reckoning, tracker
        self.bank = HypothesisBank(settings)
        self._windows = Windows(settings.baseline_m)
        self._headings = HeadingBank(settings)
        self._heading_windows = Windows(settings.baseline_m, HeadingBank.HYPOTHESES)
        self._frames = 0  # number of map frame changes that `dead_reckoning` has counted

    def add_visual_motion(self, motion: VisualMotion) -> None:
        """Add a step of the drone's visual odometry."""
        self._windows.add_step(motion)

    def add_fix(self, fix: DroneFix) -> bool:
        """Add a LiDAR position; True: the motion fits no branch, and the tracked match is dropped."""
        dead_reckoning, tracker = self._dead_reckoning, self._tracker
        self._follow_frame()
        if not dead_reckoning.vehicle_known(fix.stamp_ns):  # its displacement would count as the drone's
            self._windows.restart()
            self._heading_windows.restart()
            return False
        at = dead_reckoning.vehicle.at(fix.stamp_ns)
        self._windows.add_fix(fix, *at, dead_reckoning.autopilot)
        self._heading_windows.add_fix(fix, *at, dead_reckoning.autopilot)
        has_positions = dead_reckoning.autopilot.position(fix.stamp_ns) is not None
        self._weigh_headings(has_positions)
        if tracker.offset_rad is None:
            return False
        bearing_rad = math.hypot(math.sqrt(tracker.variance_rad2), BEARING_RAD)
        R_map_odom = dead_reckoning.R_map_odom(tracker.offset_rad)
        if R_map_odom is not None and has_positions:
            moved = self._windows.close_metric(R_map_odom, bearing_rad)
        else:
            stamps_ns = self._windows.steps_since_start()
            moved = self._windows.close_bearing(dead_reckoning.R_map_drone(tracker.offset_rad, stamps_ns), bearing_rad)
        if moved is None:
            return False
        self.bank.see(moved)
        no_branch = bool(self.bank.probability[NONE] > MAX_NONE)
        if no_branch:
            tracker.forget()
        return no_branch

    def _weigh_headings(self, has_positions: bool) -> None:
        """Update the heading without vanishing points by the displacement of autopilot and LiDAR."""
        R_map_odom = self._dead_reckoning.R_map_odom(0.0)
        if R_map_odom is None or not has_positions:
            return
        moved = self._heading_windows.close_metric(R_map_odom, 0.0)
        if moved is not None:
            self._headings.see(moved)

    def heading(self, stamp_ns: int) -> Heading | None:
        """Advance to the time of an image; returns the offset (yaw_tracker.py) by the drone's motion, None if unknown.

        A telemetry gap that may hide a jump of the autopilot's yaw resets this heading and mixes the branch
        probabilities with their prior.
        """
        self._follow_frame()
        silences = self._dead_reckoning.new_silences()
        self.bank.pass_time(stamp_ns)
        self.bank.mix(1.0 - (1.0 - SILENCE_SHARE) ** silences)
        self._headings.pass_time(stamp_ns)
        if silences:
            self._headings.reset()
            self._heading_windows.restart()
        return self._headings.heading

    def _follow_frame(self) -> None:
        """Drop the evidence of an earlier map frame."""
        if self._frames != self._dead_reckoning.frames:
            self._frames = self._dead_reckoning.frames
            self._windows.restart()
            self._heading_windows.restart()
            self._headings.reset()

    def slip(self, weights: Array64) -> None:
        """Shift the branches: weights (4,) are the probabilities that the tracked yaw has changed by m times 90 deg."""
        self.bank.slip(weights)

    def weigh_prior(self, refined: Refined) -> None:
        """Apply the prior, once."""
        if self._prior_weighed:
            return
        R_map_odom = self._dead_reckoning.R_map_odom(self._tracker.offset_rad or 0.0)
        off_rad = None
        if self._prior.initial_yaw_rad is not None:
            R = refined.R_vehicle_drone(0)
            off_rad = math.atan2(R[1, 0], R[0, 0]) - self._prior.initial_yaw_rad
        elif self._prior.compass_rad is not None and R_map_odom is not None:
            off_rad = math.atan2(R_map_odom[1, 0], R_map_odom[0, 0]) - self._prior.compass_rad
        if off_rad is not None:
            self.bank.expect_yaw(off_rad, self._prior.sigma_rad, self._prior.trust)
            self._prior_weighed = True

    def reset(self) -> None:
        """Reset the branches with probability NONE_AFTER_RESET that none is right."""
        self.bank.reset(NONE_AFTER_RESET)
        self._windows.restart()
        if self._prior.compass_rad is not None:
            self._prior_weighed = False  # the prior of a compass is still valid
