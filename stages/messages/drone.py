"""Messages of drone detection and tracking by the LiDAR (P III.B, III.C), and of the drone's motion by its IMU."""

from __future__ import annotations

import enum

from flow.message import Mat3, Message, PerPointBool, PerPointF64, PerPointI64, Points64, Vec3, message


@message(schema=31)
class Detections(Message):
    """Drone candidates of one search, best first. An empty list, or one without an accepted candidate, is normal.

    stamp_ns: end of the searched interval. The paper's detector scores whole sweeps by e = e_inner + e_outer, lower is
    better. EvidenceDetect scores incrementally and gives a probability.
    """

    xyz_vehicle_m: Points64  # (n, 3) [m] at seen_ns
    score: PerPointF64  # e, or the log-odds that it is a drone
    e_inner: PerPointF64  # paper only, else 0
    e_outer: PerPointF64
    accepted: PerPointBool
    reasons: tuple[str, ...]  # one per candidate: why it was accepted or rejected
    summary: str  # one sentence: "drone at ..." or "no drone: ..."
    start_ns: int | None = None  # start of the searched interval; None: the depth image's start
    seen_ns: PerPointI64 | None = None  # newest return of each; None: at some time in the sweep
    velocity_vehicle_mps: Points64 | None = None
    probability: PerPointF64 | None = None  # that it is a drone; None: the detector gives none
    candidate_id: PerPointI64 | None = None  # constant for the same object


@message(schema=32)
class Candidates(Message):
    """Open drone candidates that need more observations, most probable first; published on change."""

    candidate_id: PerPointI64  # as in Detections
    xyz_vehicle_m: Points64  # predicted at stamp_ns
    velocity_vehicle_mps: Points64
    probability: PerPointF64
    seen_ns: PerPointI64
    scan_passes: PerPointI64  # rotor revolutions with a return from it
    reasons: tuple[str, ...]  # one per candidate: the evidence for and against
    undirected_speed_mps: PerPointF64 | None = (
        None  # horizontal speed by telemetry whose direction is unknown; not in velocity_vehicle_mps
    )
    detector_instance: int = 0  # changes when the detector restarts: candidate_id then counts from the start


class TrackingState(enum.Enum):
    """State of a track."""

    SEARCHING = 0  # no drone
    CANDIDATE = 1  # a possible drone is being confirmed
    TRACKING = 2
    COASTING = 3  # no returns now; predicted, with growing covariance
    LOST = 4  # the track ended


@message(schema=33)
class DroneFix(Message):
    """Drone position measured by the LiDAR; stamp_ns is the weighted mean time of the returns used. P III.C."""

    xyz_vehicle_m: Vec3
    covariance_m2: Mat3
    hits: int  # returns used
    iterations: int
    shift_m: float  # last mean shift step
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
    """The autopilot's own estimate, at hand only while it cannot contain our pose. Frames: see DroneAttitude."""

    xyz_odom_m: Vec3
    R_odom_drone: Mat3
    velocity_odom_mps: Vec3
    odom_segment: int  # changes after each reset of the autopilot's estimator: positions of two segments do not compare


@message(schema=75)
class DroneMotion(Message):
    """Measured motion of the drone over one IMU interval, from start_ns to stamp_ns.

    The intervals of one segment follow each other without a gap. Means are over the interval, in drone axes.
    """

    start_ns: int
    segment: int  # changes after a gap in the IMU's samples and after a restart of the autopilot
    specific_force_drone_mps2: Vec3  # mean; +g along z at rest
    angular_velocity_drone_radps: Vec3  # mean
    specific_force_noise: float  # white-noise density [m/s^2/sqrt(Hz)] per axis, vibration included
    angular_velocity_noise: float  # white-noise density [rad/s/sqrt(Hz)] per axis, vibration included
    up_drone: Vec3 | None  # unit vector up, by the autopilot's roll and pitch (never its yaw); None: not at hand
    autopilot: AutopilotMotion | None  # at stamp_ns; None: not at hand, or not independent of our pose
