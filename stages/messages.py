"""Every message of the method, in the order data flows. Frames: see `stages/geometry.py`.

Source: DESIGN, the graph. Sensor messages carry what was measured; nothing here comes from truth.
"""

from __future__ import annotations

import enum
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flow.message import (
    Mat3,
    Message,
    PerPointBool,
    PerPointF32,
    PerPointF64,
    PerPointI64,
    PerPointU8,
    Points32,
    Points64,
    Shape,
    Vec3,
    message,
)

DepthPixels = Annotated[NDArray[np.float32], Shape("h", "w")]
Mat6 = Annotated[NDArray[np.float64], Shape(6, 6)]


@message
class LidarFirings(Message):
    """One decoded LiDAR packet, every laser pulse of it: also those that saw nothing (range_m = 0). Frame: lidar."""

    pulse_stamp_ns: PerPointI64  # when each laser fired
    laser: PerPointU8  # 0..15, the packet's channel order
    azimuth_rad: PerPointF32  # 0 along +y_lidar, clockwise seen from +z_lidar, [0, 2 pi)
    range_m: PerPointF32  # 0: no return
    reflectivity: PerPointU8  # 0..255, calibrated by the sensor
    return_kind: PerPointU8  # 0 strongest (or only), 1 last; dual mode has both
    xyz_lidar_m: Points32  # (0, 0, 0) where there was no return
    lost_packets: int  # packets missing just before this one
    laser_elevation_rad: Annotated[NDArray[np.float64], Shape("lasers")]  # where each laser points, over z_lidar = 0


@message
class Image(Message):
    """One camera frame in grey; stamp_ns is the middle of its middle row's exposure. Lens: the rig's."""

    frame_id: str  # which camera: camera_vehicle, camera_drone
    grey: Annotated[NDArray[np.uint8], Shape("h", "w")]


@message
class ServoState(Message):
    """The turntable's servo as it answered; stamp_ns is mid-exchange."""

    position_rad: float
    velocity_radps: float
    goal_rad: float
    error: int  # the servo's own error bits, 0 is healthy


@message
class ServoOffset(Message):
    """How early the servo's stamps are against the LiDAR's, as what was seen tells; stamp_ns is the newest packet's."""

    offset_s: float | None  # the rig's `servo_time_offset_s` as it should be; None: not known yet
    sigma_s: float | None  # one sigma
    rig_s: float  # what the rig says
    windows: int  # that have told so far
    reason: str  # what the newest window said, or why it said nothing


@message
class ServoGoal(Message):
    """Where the turntable's servo shall go; stamp_ns is that of the servo state it was decided on."""

    position_rad: float
    speed_radps: float  # at most; the servo keeps to what its motor can do


@message
class SweptPoints(Message):
    """Returns in the vehicle frame, each at its own time; stamp_ns is the first pulse's of the slice."""

    point_stamp_ns: PerPointI64
    xyz_vehicle_m: Points32
    laser: PerPointU8
    reflectivity: PerPointU8
    servo_rad: PerPointF32  # turntable angle at the pulse, after sign, zero and time offset
    pulses: int  # laser pulses fired in this slice, with those that returned nothing
    origin_vehicle_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # where the beams start, mid-slice
    unplaced: int = 0  # returns left out because the turntable's angle at their time is not known
    reason: str = ""  # why returns were left out; empty when none were


@message
class SweptPulses(Message):
    """Every laser pulse of a slice in the vehicle frame, also those that saw nothing: what flew free is evidence too.

    One row per pulse, in firing order; of two returns of a pulse the nearer. stamp_ns is the first pulse's. A slice
    whose turntable angle is not known is empty.
    """

    point_stamp_ns: PerPointI64  # when each laser fired
    direction_vehicle: Points32  # unit vectors
    range_m: PerPointF32  # along the direction, from origin_vehicle_m; 0: no return
    laser: PerPointU8
    reflectivity: PerPointU8
    turntable_rad: float  # turntable angle, mid-slice; NaN: not known
    origin_vehicle_m: tuple[float, float, float]  # where the beams start, mid-slice


@message
class VehicleMotion(Message):
    """Where the vehicle has driven since it started: T_start_vehicle, smooth and drifting, by its own odometry."""

    xyz_start_m: Vec3
    R_start_vehicle: Mat3
    covariance: Mat6 | None  # rotation [rad] before translation [m]; None: the source does not say


@message
class DepthImage(Message):
    """One whole sweep seen from the turntable as a pinhole image looking up; stamp_ns is the sweep's end. P III.A.

    Pixel (row v, column u) looks along (x, y, 1) with x = (u + 0.5 - w/2) / focal_px, y = (v + 0.5 - h/2) / focal_px,
    in axes parallel to the vehicle's. Depth is z over the origin.
    """

    start_ns: int
    depth_m: DepthPixels  # z of the nearest return, 0: none
    focal_px: float  # plane height / pixel size on that plane
    origin_vehicle_m: Vec3  # where the image looks from
    points: int  # returns that fell into the image
    returns: int  # returns of the whole sweep, in the image or not
    turned_rad: float  # servo travel the sweep covered; 0 for a bolted-down LiDAR
    lost_packets: int = 0  # LiDAR packets missing within the sweep


@message
class ScoreImage(Message):
    """The detector's score per pixel of a DepthImage: lower is more like a drone, NaN is no candidate. P III.B."""

    score: DepthPixels


@message
class Detections(Message):
    """Drone candidates of one search, best first. A list that is empty or wholly refused is a normal answer.

    stamp_ns: up to when was searched. The paper's detector judges whole sweeps by e = e_inner + e_outer, lower is
    better; the detector by evidence judges as data arrive and states a probability.
    """

    xyz_vehicle_m: Points64  # at seen_ns
    score: PerPointF64  # e, or ln of the odds that it is a drone
    e_inner: PerPointF64  # paper only, else 0
    e_outer: PerPointF64
    accepted: PerPointBool
    reasons: tuple[str, ...]  # one per candidate: why it was accepted or refused
    verdict: str  # one sentence for people: "drone at ..." or "no drone: ..."
    start_ns: int | None = None  # since when was searched; None: since the depth image's start
    seen_ns: PerPointI64 | None = None  # when each was seen last; None: at some time in the sweep
    velocity_vehicle_mps: Points64 | None = None
    probability: PerPointF64 | None = (
        None  # that it is a drone, as the detector judges; None: the score says nothing of it
    )
    candidate_id: PerPointI64 | None = None  # the same thing keeps its number


@message
class Candidates(Message):
    """What may be a drone right now and is worth another look, most probable first; told when it changes."""

    candidate_id: PerPointI64  # the same as in Detections
    xyz_vehicle_m: Points64  # predicted at stamp_ns
    velocity_vehicle_mps: Points64
    probability: PerPointF64
    seen_ns: PerPointI64
    looks: PerPointI64  # turns of the rotor in which it was hit
    reasons: tuple[str, ...]  # what speaks for and against, one each


class TrackingState(enum.Enum):
    """What the tracker is doing."""

    SEARCHING = 0  # no drone known
    CANDIDATE = 1  # something that may be one is being looked at
    TRACKING = 2
    COASTING = 3  # not seen now, predicted; the covariance grows
    LOST = 4  # had one, has none


@message
class DroneFix(Message):
    """Where the LiDAR saw the drone; stamp_ns is the weighted mean time of the returns used. P III.C."""

    xyz_vehicle_m: Vec3
    covariance_m2: Mat3
    hits: int  # returns used
    iterations: int
    shift_m: float  # last mean shift step
    track_id: int = 1  # which drone
    velocity_vehicle_mps: Vec3 | None = None  # relative to the vehicle; None: not estimated


@message
class TrackState(Message):
    """A track's state after each frame, with the reason for it in words, and where it is predicted at stamp_ns."""

    state: TrackingState
    reason: str
    hits: int  # returns within the radius in the frame just ended
    frame_s: float  # how long that frame was
    track_id: int = 1  # which drone; one that was lost and found elsewhere has a new number
    xyz_vehicle_m: Vec3 | None = None  # None: not predicted
    velocity_vehicle_mps: Vec3 | None = None
    covariance_m2: Mat3 | None = None  # of the position


class Carrier(enum.Enum):
    """What a camera is mounted on, and in whose axes its directions are told."""

    VEHICLE = "vehicle"
    DRONE = "drone"


@message
class VanishingDirections(Message):
    """Directions in which a picture's straight lines run, and the lines; stamp_ns is the picture's. P IV, V.C.

    Axes are the carrier's (x forward, y left, z up), not the lens's. A direction's sign means nothing.
    No directions is a normal answer: `reason` says why.
    """

    carrier: Carrier
    direction: Points64  # (n, 3) unit; the vertical first where there is one
    sigma_rad: PerPointF64  # (n,) of each direction, one axis, 1 sigma
    is_vertical: PerPointBool  # (n,)
    frame: PerPointI64  # (n,) which horizontal pair it belongs to, 0 the strongest; -1: the vertical
    line_normal: Annotated[NDArray[np.float64], Shape("m", 3)]  # unit normals of the lines' great circles
    line_end: Annotated[NDArray[np.float64], Shape("m", 2, 3)]  # unit rays of each line's two ends
    line_sigma_rad: Annotated[
        NDArray[np.float64], Shape("m")
    ]  # (m,) how far the normal may be turned about the ray to the line's middle
    line_direction: Annotated[NDArray[np.int64], Shape("m")]  # index of its direction; -1: none
    reason: str


class BranchState(enum.Enum):
    """How well it is known which of the street's four directions is which."""

    NONE = 0  # no rotation now
    AMBIGUOUS = 1  # up to a quarter turn, or half of one
    RESOLVED = 2


@message
class RelativeRotation(Message):
    """How the drone is turned in the vehicle's axes, up to the street's symmetry; stamp_ns is the pictures'. P IV.

    Branch k is turned further by k * 90 deg about the world's vertical: Rz(k 90 deg) R_vehicle_drone where the vehicle
    stands level. Branch 0 is the most probable and given here. What the probabilities leave to 1: none is right.
    """

    R_vehicle_drone: Mat3 | None  # None: no rotation now, `reason` says why
    covariance_rad2: Mat3 | None  # of phi in R exp(phi), the drone's axes
    branch_probability: Annotated[NDArray[np.float64], Shape(4)]  # of branch k
    state: BranchState
    switches: int  # how often the branch given out has changed since the start: a change is a jump
    reason: str


@message
class DroneMotion(Message):
    """How the drone's camera moved from one picture to a later one, told in the drone's axes. P V.E.

    p_from = R_from_to p_to + |t| direction: the length is not known from one camera. stamp_ns is the later picture's.
    """

    from_ns: int
    R_from_to: Mat3
    covariance_rad2: Mat3  # of phi in R exp(phi), axes of the later picture's drone
    direction_from: Vec3 | None  # unit; None: no motion seen beyond the rotation
    direction_sigma_rad: float | None
    matches: int  # features that agree
    reason: str


@message
class FollowedFeatures(Message):
    """Features of a camera followed from an earlier picture to this one; stamp_ns is this picture's. P V.B, V.E."""

    frame_id: str  # which camera
    from_ns: int  # the earlier picture's stamp
    pixel_from: Annotated[NDArray[np.float64], Shape("n", 2)]  # column, row in the earlier picture
    pixel_to: Annotated[NDArray[np.float64], Shape("n", 2)]
    residual_rad: PerPointF64  # by how much each misses the camera's motion that was found
    agrees: PerPointBool  # with that motion


@message
class DroneAttitude(Message):
    """The autopilot's attitude. Frame local is the autopilot's own: x its north, z up; its yaw is unrelated to ours."""

    R_local_drone: Mat3
    angular_velocity_drone_radps: Vec3


@message
class DroneLocalPosition(Message):
    """The autopilot's position and velocity in its local frame (see DroneAttitude), origin where it began."""

    xyz_local_m: Vec3
    velocity_local_mps: Vec3


@message
class DroneOdometry(Message):
    """The autopilot's whole estimate: T_local_drone and how it changes. Covariances are rotation first, drone axes."""

    xyz_local_m: Vec3
    R_local_drone: Mat3
    velocity_drone_mps: Vec3
    angular_velocity_drone_radps: Vec3
    pose_covariance: Mat6 | None  # [rad, m], tangent at the body; None: the autopilot does not say
    velocity_covariance: Mat6 | None  # [rad/s, m/s]
    reset_counter: int  # a change: the estimate jumped
    quality_percent: int | None  # None: unknown; a failed estimate is 0


@message
class DroneImu(Message):
    """One inertial sample, drone axes."""

    acceleration_drone_mps2: Vec3  # specific force: +g along z at rest
    angular_velocity_drone_radps: Vec3


@message
class AutopilotStatus(Message):
    """The autopilot's heartbeat, with what its link and clock do."""

    armed: bool
    custom_mode: int  # the autopilot's own mode number
    failsafe: bool  # it says critical, emergency or termination
    lost_frames: int  # missing in its sequence since the start
    clock_offset_ns: int | None  # host - autopilot's time since boot; None: not known yet
    clock_uncertainty_ns: int | None  # the offset is wrong by at most this; None: no TIMESYNC, delays are unknown


@message
class AutopilotEstimator(Message):
    """What the drone's EKF says it fuses right now: EKF_STATUS_REPORT (ArduPilot) or ESTIMATOR_STATUS (both)."""

    attitude_good: bool
    velocity_good: bool
    position_good: bool  # horizontal position relative to its origin, from external pose, flow or GPS
    height_good: bool
    constant_position: bool  # it has no position source and pretends to stand still
    velocity_ratio: float  # innovation test ratios (1: at the gate); NaN: not said
    horizontal_ratio: float
    height_ratio: float
    compass_ratio: float
    flags: int  # as sent


@message
class Tick(Message):
    """The host's clock, live: time goes on though every sensor is silent. stamp_ns is now."""


class PoseState(enum.Enum):
    """How much of the relative pose is known, and by what."""

    LOST = 0  # no position; nothing may be used
    POSITION_ONLY = 1  # the LiDAR sees the drone, its yaw relative to the vehicle is not known
    AMBIGUOUS = 2  # the rotation is known up to the street's quarter turns
    FULL = 3  # position and rotation
    COASTING = 4  # was FULL; the LiDAR has not seen the drone for a while, its odometry carries the pose


@message
class RelativePose(Message):
    """T_vehicle_drone and how well it is known, predicted to stamp_ns; and the same in the vehicle's start frame.

    Frame start (W for the autopilot) stands still in the world: T_start_drone = T_start_vehicle T_vehicle_drone.
    Covariances are rotation [rad] before translation [m], tangent at the drone body: T exp(xi).
    """

    state: PoseState
    reason: str  # in words, why this state
    measured_ns: int | None  # time of the newest LiDAR position in it; None: never
    track_id: int  # which drone; 0: none yet
    xyz_vehicle_m: Vec3 | None  # None: LOST
    R_vehicle_drone: Mat3 | None  # None unless FULL or COASTING: an unresolved branch is not given out as a rotation
    covariance: (
        Mat6 | None
    )  # of T_vehicle_drone; rotation rows are infinite variance (diagonal inf, else 0) where not known
    velocity_vehicle_mps: Vec3 | None  # of the drone relative to the vehicle, in the vehicle's axes; None: not known
    xyz_start_m: Vec3 | None
    R_start_drone: Mat3 | None
    start_covariance: Mat6 | None  # of T_start_drone, without the drift of the vehicle's odometry
    velocity_start_mps: Vec3 | None  # of the drone over ground, start's axes
    velocity_covariance: Mat3 | None  # of velocity_start_mps [m2/s2]
    resets: int  # how often the pose jumped since the start: a new branch, a new drone, a restart
    nis: float  # normalised innovation squared of the newest accepted LiDAR position, 3 degrees of freedom; NaN: none
