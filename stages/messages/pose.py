"""The relative pose of drone and vehicle: the result of the whole graph."""

from __future__ import annotations

import enum

from flow.message import Mat3, Mat6, Message, Vec3, message


class PoseState(enum.Enum):
    """Which parts of the relative pose are known."""

    LOST = 0  # no position; no field may be used
    POSITION_ONLY = 1  # position by LiDAR; yaw relative to the vehicle not known
    AMBIGUOUS = 2  # the rotation is known up to the 90 deg yaw ambiguity
    FULL = 3  # position and rotation
    COASTING = 4  # as FULL, but propagated by the drone's odometry: no LiDAR return for a while


@message(schema=61)
class RelativePose(Message):
    """T_vehicle_drone with covariance, predicted to stamp_ns, and T_map_drone = T_map_vehicle T_vehicle_drone.

    Frame map is fixed to the ground and is the local frame sent to the autopilot.
    Covariances are rotation [rad] before translation [m], tangent at the drone body: T exp(xi).
    """

    state: PoseState
    reason: str  # why this state
    measured_ns: int | None  # time of the newest LiDAR position in it; None: never
    track_id: int  # number of the track; 0: none yet
    xyz_vehicle_m: Vec3 | None  # None: LOST
    R_vehicle_drone: Mat3 | None  # None unless FULL or COASTING: an unresolved yaw branch is not published
    covariance: Mat6 | None  # of T_vehicle_drone; an unknown rotation has infinite variances and zero correlations
    velocity_vehicle_mps: Vec3 | None  # of the drone relative to the vehicle, vehicle axes; None: not known
    xyz_map_m: Vec3 | None
    R_map_drone: Mat3 | None
    map_covariance: Mat6 | None  # of T_map_drone, without the drift of the vehicle's odometry
    velocity_map_mps: Vec3 | None  # of the drone over ground, map axes
    velocity_covariance: Mat3 | None  # of velocity_map_mps [m2/s2]
    resets: int  # jumps of the pose since the start: a new yaw branch, a new drone, a reset
    nis: float  # normalised innovation squared of the newest accepted LiDAR position, 3 degrees of freedom; NaN: none
