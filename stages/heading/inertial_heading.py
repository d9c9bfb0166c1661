"""Heading of the drone's body, from the first LiDAR position until it is decided.

The bank of hypotheses is propagated by the IMU from measurement to measurement, in the order of their times. A
measurement a little older than the bank is moved to the bank's time by the drone's own motion since.

The heading is decided when for DECIDED_FOR_NS, at every LiDAR position, the yaws within 20 deg of the best one (10 deg
while the bank follows matches of cameras, which may be of another street) together have P > 0.999, and the object is
the drone (ownership.py): both probabilities may exceed their thresholds for a moment.

Source: ours; issue: heading once.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.heading import bank_measurements as measure
from stages.heading.imu_buffer import ImuBuffer
from stages.heading.inertial_bank import NEAR_RAD, WITH_CAMERAS_RAD, InertialBank, YawMixture, start
from stages.heading.inertial_state import POSITION, ImuIntervals, InertialState
from stages.heading.odometry_heading import YawEvidence
from stages.heading.rotation_matches import RotationMatches, add_matches
from stages.kernels.geometry.so3 import log_rotation
from stages.messages import GyroBias, VisualMotion

DECIDED, DECIDED_FOR_NS = 0.999, 800_000_000
CONFIRMED = 0.99  # probability from which the matches of both cameras are taken as right
DISAGREE = 8  # consecutive images that contradict all tied hypotheses: their matches were wrong
LATE_NS = 500_000_000  # an older measurement is not used
DIRECTION_NS = 400_000_000  # between directions of flight by images that count as independent
LONGEST_TURN_NS = 300_000_000
FREE_SIGMA_MPS = 1.0  # of the tracker's velocity


class InertialHeading:
    """The bank of yaw hypotheses with its time, before the heading is decided."""

    def __init__(self, imu: ImuBuffer) -> None:
        self._imu = imu
        self.bank: InertialBank | None = None
        self.stamp_ns = 0
        self.evidence: YawEvidence | None = None
        self._certain_ns: int | None = None  # since when both probabilities have exceeded their thresholds
        self.decided = False  # whether the heading is known
        self.near_probability = 0.0  # of a yaw within reach of the best one, at the newest LiDAR position
        self._direction_ns = 0
        self._disagreed = 0  # consecutive images

    def start(
        self,
        stamp_ns: int,
        xyz_m: Array64,
        covariance_m2: Array64,
        velocity_mps: Array64 | None,
        up_drone: Array64,
        memory: tuple[float, float, float] | None = None,
    ) -> None:
        """Start at a LiDAR position; see `inertial_bank.start`."""
        velocity = None if velocity_mps is None else (velocity_mps, FREE_SIGMA_MPS)
        self.bank = start(xyz_m, covariance_m2, velocity, up_drone, memory)
        self.stamp_ns, self.evidence, self._certain_ns, self.decided = stamp_ns, None, None, False
        self._disagreed = 0

    def resume(self, stamp_ns: int, state: InertialState) -> None:
        """Continue from one decided hypothesis (one row)."""
        self.bank = InertialBank(state, np.zeros(1))
        self.stamp_ns, self.evidence, self.decided = stamp_ns, None, True
        self._certain_ns = stamp_ns - DECIDED_FOR_NS

    def restart_yaw(self) -> None:
        """Reset the yaw to uniform; position and velocity stay."""
        if self.bank is not None:
            one = self.bank.mean()
            covariance = one.covariance[0, POSITION, POSITION]
            self.start(self.stamp_ns, one.xyz_m[0], covariance, one.velocity_mps[0], one.R[0, 2])

    def stop(self) -> None:
        """Drop all hypotheses."""
        self.bank, self.decided = None, False

    def advance(self, stamp_ns: int) -> None:
        """Propagate the bank to a later time."""
        if self.bank is not None and stamp_ns > self.stamp_ns:
            self.bank.state = self._imu.propagate(self.bank.state, self.bank.weight, self.stamp_ns, stamp_ns)
            self.stamp_ns = stamp_ns

    def add_position(self, xyz_m: Array64, covariance_m2: Array64) -> float | None:
        """Add a LiDAR position of the bank's time. Returns the log density of the position; None: no bank."""
        if self.bank is None:
            return None
        measure.add_position(self.bank, xyz_m, covariance_m2)
        log_evidence = self.bank.log_evidence
        self.bank.tidy()
        self.near_probability = self.yaws().best(self._reach_rad)[1]
        return log_evidence

    def decide(self, is_own: bool) -> None:
        """After a LiDAR position: whether the heading is decided; `is_own`: the object is the drone."""
        if not (is_own and self.near_probability > DECIDED):
            self._certain_ns = None
        elif self._certain_ns is None:
            self._certain_ns = self.stamp_ns
        self.decided = self._certain_ns is not None and self.stamp_ns - self._certain_ns >= DECIDED_FOR_NS

    def add_vertical(self, up_drone: Array64, sigma_rad: float) -> None:
        """Add the autopilot's vertical at the bank's time."""
        if self.bank is not None:
            measure.add_vertical(self.bank, up_drone, sigma_rad)

    def add_vertical_gyro_bias(self, measured: GyroBias) -> None:
        """Add a measurement of the gyroscope's bias about the vertical."""
        if self.bank is not None:
            measure.add_vertical_gyro_bias(self.bank, measured)

    def add_rotation(self, stamp_ns: int, matches: RotationMatches, share: float) -> float | None:
        """Add rotations by cameras, of which `share` is new evidence. Returns P that one is right; None: too old."""
        if self.bank is None or self._late_s(stamp_ns) is None:
            return None
        right = add_matches(self.bank, matches.turned(*self.turn(stamp_ns, self.stamp_ns)), share)
        self._disagreed = 0 if right > 0.5 else self._disagreed + 1
        if self._disagreed >= DISAGREE or self.bank.weight[self.bank.tied].sum() < 1.0 - DECIDED:
            self.bank.drop_tied()
            self._disagreed = 0
        return right

    @property
    def _reach_rad(self) -> float:
        """How near to the best yaw counts as right: less while cameras may match another street."""
        return WITH_CAMERAS_RAD if self.bank is not None and bool(self.bank.tied.any()) else NEAR_RAD

    @property
    def cameras_confirmed(self) -> bool:
        """Whether the drone's motion confirms the matches of both cameras."""
        return self.bank is not None and float(self.bank.weight[self.bank.tied].sum()) > CONFIRMED

    @property
    def cameras_open(self) -> bool:
        """Whether the matches of both cameras may be right or wrong."""
        return self.bank is not None and bool(self.bank.tied.any()) and not self.cameras_confirmed

    def add_visual_motion(self, motion: VisualMotion) -> None:
        """Add a step of the drone's visual odometry that ended at the bank's time or shortly before."""
        if self.bank is None or self._late_s(motion.stamp_ns) is None:
            return
        interval_ns = motion.stamp_ns - motion.from_ns
        if not 0 < interval_ns <= LONGEST_TURN_NS:
            return
        turn = bias_free_turn(self._imu, motion)
        if turn is not None:
            measure.add_turn(self.bank, *turn)
        if motion.direction_from is None or motion.direction_sigma_rad is None:
            return
        if motion.stamp_ns - self._direction_ns < DIRECTION_NS:
            return
        self._direction_ns = motion.stamp_ns
        since, _ = self.turn(motion.from_ns, self.stamp_ns)
        late_s = (self.stamp_ns - motion.from_ns) * 1e-9
        measure.add_direction(self.bank, since.T @ motion.direction_from, motion.direction_sigma_rad, late_s)

    def turn(self, from_ns: int, to_ns: int) -> tuple[Array64, float]:
        """The drone's rotation between two times by the gyroscope (3, 3), and the variance of each axis."""
        return turn_between(self._imu, from_ns, to_ns, self.bank_bias())

    def bank_bias(self) -> Array64:
        """(6,) mean biases."""
        return np.zeros(6) if self.bank is None else self.bank.weight @ self.bank.state.bias

    def yaws(self) -> YawMixture:
        """The yaw with the evidence of the autopilot's odometry, which is not in the bank: its error is constant."""
        assert self.bank is not None
        return self.bank.yaws if self.evidence is None else self.evidence.applied(self.bank.yaws)

    def decision(self) -> InertialState:
        """One hypothesis: the moments of those near the best one.

        The odometry's yaw is evidence for the decision alone: the error of its compass must not reach the estimate.
        """
        assert self.bank is not None
        bank, yaws = self.bank, self.yaws()
        off = bank.state.yaw_rad - yaws.yaw_rad[yaws.best(self._reach_rad)[0]]
        near = np.flatnonzero(np.abs(np.remainder(off + math.pi, 2 * math.pi) - math.pi) <= 1.5 * NEAR_RAD)
        return InertialBank(bank.state.rows(near), bank.log_weight[near]).mean()

    def _late_s(self, stamp_ns: int) -> float | None:
        """How much older than the bank a time is [s]; None: too old."""
        late_ns = self.stamp_ns - stamp_ns
        return None if late_ns > LATE_NS else max(late_ns, 0) * 1e-9


def turn_between(imu: ImuBuffer, from_ns: int, to_ns: int, bias: Array64) -> tuple[Array64, float]:
    """Rotation (3, 3) from the drone's axes at one time to those at another, and the variance of each axis [rad2]."""
    if from_ns == to_ns:
        return np.eye(3), 0.0
    if from_ns > to_ns:
        R, variance = turn_between(imu, to_ns, from_ns, bias)
        return R.T, variance
    state = InertialState(np.eye(3)[None], np.zeros((1, 3)), np.zeros((1, 3)), bias[None], np.zeros((1, 15, 15)))
    moved = imu.propagate(state, np.ones(1), from_ns, to_ns)
    return moved.R[0], float(np.trace(moved.covariance[0, :3, :3])) / 3.0


def bias_free_turn(imu: ImuBuffer, motion: VisualMotion) -> tuple[Array64, Array64, Array64] | None:
    """Mean rates by the gyroscope and by images over a step, and the covariance of the difference."""
    pieces = imu.between(motion.from_ns, motion.stamp_ns)
    if len(pieces) != 1 or not isinstance(pieces[0], ImuIntervals):
        return None
    seconds = (motion.stamp_ns - motion.from_ns) * 1e-9
    dR, variance = turn_between(imu, motion.from_ns, motion.stamp_ns, np.zeros(6))
    covariance = (motion.covariance_rad2 + variance * np.eye(3)) / seconds**2
    return log_rotation(dR) / seconds, log_rotation(motion.R_from_to) / seconds, covariance
