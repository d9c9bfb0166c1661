"""Messages of drone detection and tracking by the LiDAR (P III.B, III.C), and of the drone's motion by its IMU."""

from __future__ import annotations

import dataclasses
import enum
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flow.message import Mat3, Message, PerPointBool, PerPointF64, PerPointI64, Points64, Shape, Vec3, message


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class KernelScores:
    """Scores of candidates by the paper's detector, which searches the depth image of one sweep. P III.B.

    The score e = e_inner + e_outer is lower for a better candidate.
    """

    e_inner: PerPointF64
    e_outer: PerPointF64

    @property
    def e(self) -> NDArray[np.float64]:
        """Score (n,) of each candidate."""
        return self.e_inner + self.e_outer


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CandidateEvidence:
    """Evidence for candidates by the detector that observes each of them repeatedly."""

    start_ns: int  # start of the searched interval
    candidate_id: PerPointI64  # constant for the same object
    seen_ns: PerPointI64  # newest return of each
    velocity_vehicle_mps: Points64
    log_odds: PerPointF64  # that it is a drone
    probability: PerPointF64  # the same as a probability


class SearchResult(enum.Enum):
    """Result of one search for the drone."""

    DRONE = "drone"  # at least one accepted candidate
    ALL_REJECTED = "all candidates rejected"
    NO_CANDIDATE = "no candidate"


@message(schema=76)
class Detections(Message):
    """Drone candidates of one search, best first. An empty list, or one without an accepted candidate, is normal.

    stamp_ns: end of the searched interval.
    """

    xyz_vehicle_m: Points64  # (n, 3) [m], at the time of its newest return or at some time in the sweep
    accepted: PerPointBool
    reasons: tuple[str, ...]  # one per candidate: why it was accepted or rejected
    summary: str  # one sentence: "drone at ..." or "no drone: ..."
    evidence: KernelScores | CandidateEvidence  # depends on the detector

    @property
    def result(self) -> SearchResult:
        """What the search found."""
        if self.accepted.any():
            return SearchResult.DRONE
        return SearchResult.ALL_REJECTED if len(self.accepted) else SearchResult.NO_CANDIDATE


@message(schema=77)
class Candidates(Message):
    """Open drone candidates that need more observations, most probable first; published on change."""

    candidate_id: PerPointI64  # as in Detections
    xyz_vehicle_m: Points64  # predicted at stamp_ns
    velocity_vehicle_mps: Points64
    probability: PerPointF64
    seen_ns: PerPointI64
    scan_passes: PerPointI64  # rotor revolutions with a return from it
    reasons: tuple[str, ...]  # one per candidate: the evidence for and against
    accept_probability: float  # the detector accepts a candidate from this probability on
    undirected_speed_mps: PerPointF64 | None = (
        None  # horizontal speed by telemetry whose direction is unknown; not in velocity_vehicle_mps
    )
    detector_instance: int = 0  # changes when the detector restarts: candidate_id then counts from the start


@message(schema=88)
class CandidateLog(Message):
    """Every candidate that was classified in a slice, with the features that it was classified by; for logs."""

    candidate_id: PerPointI64  # as in Detections
    seen_ns: PerPointI64  # its last observation
    xyz_vehicle_m: Points64  # at seen_ns
    probability: PerPointF64
    features: Annotated[NDArray[np.float64], Shape("n", "k")]  # trained/features.py; NaN: not available
    feature_names: tuple[str, ...]
    detector_instance: int = 0


class TrackingState(enum.Enum):
    """State of a track."""

    SEARCHING = 0  # no drone
    CANDIDATE = 1  # a possible drone is being confirmed
    TRACKING = 2
    COASTING = 3  # no returns now; predicted, with growing covariance
    LOST = 4  # the track ended


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MeanShiftResult:
    """How the mean shift that found a position ended. P III.C."""

    iterations: int
    shift_m: float  # length of the last step


@message(schema=78)
class DroneFix(Message):
    """Drone position measured by the LiDAR; stamp_ns is the weighted mean time of the returns used. P III.C."""

    xyz_vehicle_m: Vec3
    covariance_m2: Mat3
    hits: int  # returns used
    mean_shift: MeanShiftResult | None = None  # None: the tracker does not use mean shift
    track_id: int = 1  # number of the track
    velocity_vehicle_mps: Vec3 | None = None  # relative to the vehicle; None: not estimated
    # the part of covariance_m2 that does not average out over fixes (calibration); None: not estimated
    bias_covariance_m2: Mat3 | None = None


@message(schema=34)
class TrackState(Message):
    """State of a track after each frame, the reason for it, and the position predicted for stamp_ns."""

    state: TrackingState
    reason: str
    hits: int  # returns within the radius in the frame just ended
    frame_s: float  # duration of that frame
    track_id: int = 1  # a drone that was lost and reacquired at another position has a new number
    xyz_vehicle_m: Vec3 | None = None  # None: not predicted
    velocity_vehicle_mps: Vec3 | None = None
    covariance_m2: Mat3 | None = None  # of the position


@message(schema=35)
class AutopilotMotion:
    """The autopilot's own estimate, available only while it cannot contain our pose. Frames: see DroneAttitude."""

    xyz_odom_m: Vec3
    R_odom_drone: Mat3
    velocity_odom_mps: Vec3
    odom_segment: int  # changes after each reset of the autopilot's estimator: positions of two segments do not compare


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class GyroBias:
    """Measured bias of the gyroscope about the vertical, up_drone . bias."""

    up_drone: Vec3  # unit vector up, mean over the measurement
    bias_radps: float
    sigma_radps: float


@message(schema=93)
class DroneMotion(Message):
    """Measured motion of the drone over one IMU interval, from start_ns to stamp_ns.

    The intervals of one segment follow each other without a gap. Means are over the interval, in drone axes.
    """

    start_ns: int
    segment: int  # changes after a gap in the IMU's samples and after a restart of the autopilot
    specific_force_drone_mps2: Vec3  # mean; +g along z at rest
    angular_velocity_drone_radps: Vec3  # mean
    specific_force_noise: Vec3  # white-noise density of each axis [m/s^2/sqrt(Hz)], vibration included
    angular_velocity_noise: Vec3  # white-noise density of each axis [rad/s/sqrt(Hz)], vibration included
    up_drone: Vec3 | None  # unit vector up, by the autopilot's roll and pitch (never its yaw); None: not available
    autopilot: AutopilotMotion | None  # at stamp_ns; None: not available, or not independent of our pose
    gyro_bias: GyroBias | None = None  # by the magnetometer, over the seconds before; None: no new measurement
