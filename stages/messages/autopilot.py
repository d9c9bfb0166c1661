"""Messages from the drone's autopilot: attitude, position, odometry, IMU, status and estimator health.

`independent`: the estimate cannot contain poses that grd sent. An autopilot that fuses them returns them as its own
position, velocity and yaw; as odometry they would confirm themselves.
"""

from __future__ import annotations

from flow.message import Mat3, Mat6, Message, Vec3, message


@message(schema=57)
class DroneAttitude(Message):
    """Attitude of the drone in frame odom: x along the autopilot's north, z up. Its yaw is unrelated to frame map."""

    R_odom_drone: Mat3
    angular_velocity_drone_radps: Vec3
    independent: bool = False  # of poses that grd sent


@message(schema=79)
class DroneTilt(Message):
    """The vertical in drone axes, by the autopilot's roll and pitch; nothing of its yaw.

    Roll and pitch come from its accelerometer, also when it fuses poses of grd.
    """

    up_drone: Vec3  # unit vector
    sigma_rad: float
    angular_velocity_drone_radps: Vec3 | None  # None: no rate available that is independent of poses of grd


@message(schema=58)
class DroneLocalPosition(Message):
    """Position and velocity of the drone in frame odom (see DroneAttitude)."""

    xyz_odom_m: Vec3
    velocity_odom_mps: Vec3
    independent: bool = False  # of poses that grd sent


@message(schema=59)
class DroneOdometry(Message):
    """The autopilot's full estimate: T_odom_drone and its velocities. Covariances are rotation first, drone axes."""

    xyz_odom_m: Vec3
    R_odom_drone: Mat3
    velocity_drone_mps: Vec3
    angular_velocity_drone_radps: Vec3
    pose_covariance: Mat6 | None  # [rad, m], tangent at the body; None: not reported
    velocity_covariance: Mat6 | None  # [rad/s, m/s]
    reset_counter: int  # changes when the estimate jumps
    quality_percent: int | None  # None: not reported; 0: the estimate has failed
    independent: bool = False  # of poses that grd sent


@message(schema=92)
class DroneImu(Message):
    """One IMU sample in drone axes."""

    acceleration_drone_mps2: Vec3  # specific force: +g along z at rest
    angular_velocity_drone_radps: Vec3
    magnetic_field_drone_ut: Vec3 | None = None  # [uT]; None: no magnetometer


@message(schema=55)
class AutopilotStatus(Message):
    """The autopilot's heartbeat, with the state of its link and clock."""

    armed: bool
    custom_mode: int  # the autopilot's own mode number
    failsafe: bool  # MAV_STATE is critical, emergency or termination
    lost_frames: int  # gaps in the autopilot's MAVLink sequence since the start
    clock_offset_ns: int | None  # host time - autopilot's time since boot; None: not known yet
    clock_uncertainty_ns: int | None  # bound of the offset error; None: no TIMESYNC, delays are not known
    clock_drift_ppm: float | None = None  # rate of the host's clock relative to it; None: not known (yet)
    clock_drift_sigma_ppm: float | None = None


@message(schema=56)
class AutopilotEstimator(Message):
    """Status of the drone's EKF: EKF_STATUS_REPORT (ArduPilot) or ESTIMATOR_STATUS (ArduPilot and PX4)."""

    attitude_good: bool
    velocity_good: bool
    position_good: bool  # horizontal position relative to its origin, from external pose, flow or GPS
    height_good: bool
    constant_position: bool  # no position source: the EKF assumes a constant position
    velocity_ratio: float  # innovation test ratios (1: at the gate); NaN: not reported
    horizontal_ratio: float
    height_ratio: float
    compass_ratio: float
    flags: int  # flags as received


@message(schema=85)
class EarlierOdomFrame(Message):
    """Frame odom in `map`, R_map_odom = Rz(yaw), as it was known at a pose that was sent before a restart."""

    yaw_map_odom_rad: float
    sigma_rad: float  # of the yaw
    xyz_map_m: Vec3  # origin of odom


@message(schema=119)
class HeadingPrior(Message):
    """Yaw, position and velocity of the drone, propagated since they were last known.

    After a restart of grd in flight by the autopilot, valid if frame odom has not changed since; after an outage of the
    vehicle's motion by the drone's IMU, valid if frame `map` has not changed. LiDAR positions are then near.
    """

    yaw_map_rad: float  # of the body
    yaw_map_odom_rad: float  # of frame odom, R_map_odom = Rz(yaw); NaN: not known
    sigma_rad: float  # of both
    xyz_map_m: Vec3
    position_sigma_m: float  # one horizontal axis
    velocity_map_mps: Vec3
    velocity_sigma_mps: float  # one horizontal axis
