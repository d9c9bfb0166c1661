"""The relative pose of the drone, the output of the estimator."""

from __future__ import annotations

import dataclasses
import enum

from flow.message import Mat3, Mat6, Message, Vec3, message


class PoseState(enum.Enum):
    """How much of the relative pose is known, and from which measurements."""

    LOST = 0  # no position; nothing may be used
    POSITION_ONLY = 1  # the LiDAR measures the drone, its yaw relative to the vehicle is not known
    AMBIGUOUS = 2  # the rotation is known up to a multiple of 90 deg
    FULL = 3  # position and rotation
    COASTING = 4  # as FULL, but without a recent LiDAR position: the odometry of the drone propagates the pose


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PositionEstimate:
    """The drone without a rotation: its position and velocity in the frames `vehicle` and `map`."""

    xyz_vehicle_m: Vec3
    covariance_vehicle_m2: Mat3  # vehicle axes
    velocity_vehicle_mps: Vec3  # of the drone relative to the vehicle, vehicle axes
    xyz_map_m: Vec3
    covariance_map_m2: Mat3  # map axes, without the drift of the vehicle's odometry
    velocity_map_mps: Vec3  # of the drone over ground, map axes
    velocity_covariance: Mat3  # of velocity_map_mps [m2/s2]


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PoseEstimate:
    """T_vehicle_drone and T_map_drone = T_map_vehicle T_vehicle_drone, with the drone's velocity.

    Covariances are rotation [rad] before translation [m], tangent at the drone body: T exp(xi).
    """

    xyz_vehicle_m: Vec3
    R_vehicle_drone: Mat3
    covariance: Mat6  # of T_vehicle_drone
    velocity_vehicle_mps: Vec3  # of the drone relative to the vehicle, vehicle axes
    xyz_map_m: Vec3
    R_map_drone: Mat3
    map_covariance: Mat6  # of T_map_drone, without the drift of the vehicle's odometry
    velocity_map_mps: Vec3  # of the drone over ground, map axes
    velocity_covariance: Mat3  # of velocity_map_mps [m2/s2]


@message(schema=120)
class RelativePose(Message):
    """State and estimate of the drone relative to the vehicle and in `map`, predicted to stamp_ns.

    `map` does not move: it is the frame of the vehicle at its start, or where its odometry has begun again.
    """

    state: PoseState
    reason: str  # why this state, for people
    measured_ns: int | None  # time of the newest LiDAR position in the estimate; None: never
    track_id: int  # which drone; 0: none yet
    resets: int  # how often the pose jumped since the start: a new branch, a new drone, a restart
    nis: float  # normalised innovation squared of the newest accepted LiDAR position, 3 degrees of freedom; NaN: none
    estimate: PositionEstimate | PoseEstimate | None  # a pose when FULL or COASTING; None when LOST
    rotation_ns: int | None = None  # newest measurement of the rotation by cameras or raw IMU; None: none
    # yaw of the autopilot's frame in `map` as it reports it now, R_map_odom = Rz(yaw): learnt while its telemetry was
    # independent of our poses, kept since. None: not known, or the drone may be another one
    odom_yaw_rad: float | None = None
    odom_yaw_sigma_rad: float | None = None  # when it was learnt
    map_number: int = 0  # how often `map` has begun: one with another number may be another frame

    @property
    def xyz_vehicle_m(self) -> Vec3 | None:
        """Position of the drone in the vehicle frame; None: not known."""
        return None if self.estimate is None else self.estimate.xyz_vehicle_m

    @property
    def R_vehicle_drone(self) -> Mat3 | None:
        """Rotation of the drone in the vehicle frame; None: not known."""
        return self.estimate.R_vehicle_drone if isinstance(self.estimate, PoseEstimate) else None

    @property
    def xyz_map_m(self) -> Vec3 | None:
        """Position of the drone in `map`; None: not known."""
        return None if self.estimate is None else self.estimate.xyz_map_m

    @property
    def R_map_drone(self) -> Mat3 | None:
        """Rotation of the drone in `map`; None: not known."""
        return self.estimate.R_map_drone if isinstance(self.estimate, PoseEstimate) else None
