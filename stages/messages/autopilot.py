"""What the drone's autopilot tells of itself."""

from __future__ import annotations

from flow.message import Mat3, Mat6, Message, Vec3, message


@message(schema=51)
class DroneAttitude(Message):
    """The autopilot's attitude. Frame local is the autopilot's own: x its north, z up; its yaw is unrelated to ours."""

    R_odom_drone: Mat3
    angular_velocity_drone_radps: Vec3


@message(schema=52)
class DroneLocalPosition(Message):
    """The autopilot's position and velocity in its local frame (see DroneAttitude), origin where it began."""

    xyz_odom_m: Vec3
    velocity_odom_mps: Vec3


@message(schema=53)
class DroneOdometry(Message):
    """The autopilot's whole estimate: T_local_drone and how it changes. Covariances are rotation first, drone axes."""

    xyz_odom_m: Vec3
    R_odom_drone: Mat3
    velocity_drone_mps: Vec3
    angular_velocity_drone_radps: Vec3
    pose_covariance: Mat6 | None  # [rad, m], tangent at the body; None: the autopilot does not say
    velocity_covariance: Mat6 | None  # [rad/s, m/s]
    reset_counter: int  # a change: the estimate jumped
    quality_percent: int | None  # None: unknown; a failed estimate is 0


@message(schema=54)
class DroneImu(Message):
    """One inertial sample, drone axes."""

    acceleration_drone_mps2: Vec3  # specific force: +g along z at rest
    angular_velocity_drone_radps: Vec3


@message(schema=55)
class AutopilotStatus(Message):
    """The autopilot's heartbeat, with what its link and clock do."""

    armed: bool
    custom_mode: int  # the autopilot's own mode number
    failsafe: bool  # it says critical, emergency or termination
    lost_frames: int  # missing in its sequence since the start
    clock_offset_ns: int | None  # host - autopilot's time since boot; None: not known yet
    clock_uncertainty_ns: int | None  # the offset is wrong by at most this; None: no TIMESYNC, delays are unknown
    clock_drift_ppm: float | None = None  # the host's clock gains so much on it; None: not known (yet)
    clock_drift_sigma_ppm: float | None = None


@message(schema=56)
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
