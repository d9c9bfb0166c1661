"""The relative pose: what all is for."""

from __future__ import annotations

import enum

from flow.message import Mat3, Mat6, Message, Vec3, message


class PoseState(enum.Enum):
    """How much of the relative pose is known, and by what."""

    LOST = 0  # no position; nothing may be used
    POSITION_ONLY = 1  # the LiDAR sees the drone, its yaw relative to the vehicle is not known
    AMBIGUOUS = 2  # the rotation is known up to the street's quarter turns
    FULL = 3  # position and rotation
    COASTING = 4  # as FULL, but the LiDAR has not seen the drone for a while, its odometry carries the pose


@message(schema=61)
class RelativePose(Message):
    """T_vehicle_drone and how well it is known, predicted to stamp_ns; and the same in the vehicle's start frame.

    Frame start (W for the autopilot) stands still in the world: T_map_drone = T_map_vehicle T_vehicle_drone.
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
    xyz_map_m: Vec3 | None
    R_map_drone: Mat3 | None
    map_covariance: Mat6 | None  # of T_map_drone, without the drift of the vehicle's odometry
    velocity_map_mps: Vec3 | None  # of the drone over ground, start's axes
    velocity_covariance: Mat3 | None  # of velocity_map_mps [m2/s2]
    resets: int  # how often the pose jumped since the start: a new branch, a new drone, a restart
    nis: float  # normalised innovation squared of the newest accepted LiDAR position, 3 degrees of freedom; NaN: none
