"""Settings of the autopilot in the loop: sensors, sources of its EKF, wind, and the plan it flies.

Source: defaults of ArduCopter 4.6 where a parameter is named; sizes of sensor errors are ours, after consumer parts.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from flow.stage import StrictModel

Vector = tuple[float, float, float]
SourceSet = Literal["gps", "external", "external_no_velocity", "external_baro_height", "external_position", "none"]


class ImuSettings(StrictModel):
    """IMU of the flight controller, 400 Hz, and the low-pass of what it reports (INS_ACCEL_FILTER, INS_GYRO_FILTER).

    Biases are those left by the calibration, which ArduPilot subtracts before its EKF and before RAW_IMU; for the gyro
    at each boot (AP_InertialSensor_Backend::_rotate_and_correct_gyro). The two gyros of a real flight (Pixhawk, 330 s)
    differ by 0.2 deg/s in the mean, and by 1.6, 3.9 and 2.2 % in the scale of x, y and z. MPU-6000: scale within 3 %.
    Its accelerometers have 0.4 to 1.0 m/s^2 RMS above 2.5 Hz, broadband without lines. Half of the simulated vibration
    is tones, because their aliases are the harder case.
    """

    gyro_bias_degps: float = Field(default=0.15, ge=0)  # one sigma, constant in a run
    gyro_scale: float = Field(default=0.015, ge=0, le=0.1)  # one sigma of each axis, constant in a run
    gyro_white_degps: float = Field(default=0.07, ge=0)  # per 400 Hz sample
    accelerometer_bias_mps2: float = Field(default=0.08, ge=0)  # one sigma, constant in a run
    accelerometer_white_mps2: float = Field(default=0.03, ge=0)  # per 400 Hz sample
    vibration_mps2: float = Field(default=0.3, ge=0, le=30)  # RMS per axis in hover, of the reported accelerometer
    vibration_degps: float = Field(default=0.5, ge=0, le=100)  # the same of the gyro
    tones: float = Field(default=0.5, ge=0, le=1)  # share of the variance by tones, else broadband
    rotor_hz: float | None = Field(default=None, ge=20, le=180)  # in hover; None: drawn by the seed from 65 to 125
    filter_hz: float = Field(default=20.0, ge=5, le=190)


class GpsSettings(StrictModel):
    """GPS receiver: white noise, a bias that wanders, and delay."""

    rate_hz: float = Field(default=5.0, ge=1, le=20)
    delay_s: float = Field(default=0.2, ge=0, le=0.25)
    assumed_delay_s: float = Field(default=0.22, ge=0, le=0.25)  # GPS_DELAY_MS of a u-blox M8
    white_m: float = Field(default=0.15, ge=0)
    bias_m: float = Field(default=0.8, ge=0)  # one sigma per horizontal axis, 1.5 times that vertically
    bias_time_s: float = Field(default=120.0, gt=1)
    velocity_mps: float = Field(default=0.08, ge=0)
    reported_m: float = Field(default=0.8, gt=0)  # horizontal accuracy that it reports
    reported_mps: float = Field(default=0.3, gt=0)


class CompassSettings(StrictModel):
    """Magnetometer; sigmas of each axis."""

    offset_deg: float = Field(default=0.0, ge=-180, le=180)  # of the heading: wrong mounting or declination
    hard_iron_ut: float = Field(default=2.0, ge=0)  # constant in drone axes, left by the calibration
    motor_ut: float = Field(default=2.0, ge=0)  # in drone axes, by the current of hovering; grows with thrust
    slow_ut: float = Field(default=0.5, ge=0)  # slow changes: steel nearby, temperature
    slow_s: float = Field(default=60.0, gt=0)  # their time constant
    white_ut: float = Field(default=0.4, ge=0)


class BaroSettings(StrictModel):
    """Barometric height."""

    white_m: float = Field(default=0.1, ge=0)
    bias_m: float = Field(default=0.4, ge=0)  # one sigma of its slow wandering
    bias_time_s: float = Field(default=100.0, gt=1)


class WindSettings(StrictModel):
    """Mean wind and gusts: a first-order Gauss-Markov process per axis."""

    mean_world_mps: Vector = (0.0, 0.0, 0.0)
    gust_mps: float = Field(default=0.5, ge=0, le=20)  # one sigma per horizontal axis, half of it vertically
    gust_time_s: float = Field(default=1.5, gt=0.05, le=60)


class Airframe(StrictModel):
    """How the airframe follows its attitude controller, as `links.simulated.world.flight.FlightSettings`."""

    attitude_gain_per_s: float = Field(default=8.0, gt=0, le=30)
    rate_limit_degps: float = Field(default=220.0, gt=0, le=2000)
    yaw_rate_limit_degps: float = Field(default=90.0, gt=0, le=1000)
    rate_lag_s: float = Field(default=0.05, ge=0.01, le=1)
    thrust_lag_s: float = Field(default=0.04, ge=0.01, le=1)
    tilt_limit_deg: float = Field(default=30.0, gt=0, le=80)  # ANGLE_MAX


class FollowPath(StrictModel):
    """Fly the path of the scenario's drone, from the beginning."""

    do: Literal["path"] = "path"
    for_s: float = Field(gt=0)


class Hold(StrictModel):
    """Hold the present target."""

    do: Literal["hold"] = "hold"
    for_s: float = Field(gt=0)


class GoTo(StrictModel):
    """Fly to a position in the world frame, as given by the source in use (GPS: by the surveyed map), and hold it."""

    do: Literal["go_to"] = "go_to"
    xyz_m: Vector
    yaw_deg: float | None = None  # None: keep it
    speed_mps: float = Field(default=1.0, gt=0, le=10)
    for_s: float = Field(gt=0)


class Square(StrictModel):
    """Fly squares from the present target, along the axes of the world, with a stop at each corner."""

    do: Literal["square"] = "square"
    side_m: float = Field(default=4.0, gt=0)
    speed_mps: float = Field(default=1.0, gt=0, le=10)
    for_s: float = Field(gt=0)


class Follow(StrictModel):
    """Keep the present offset from the vehicle while it drives; its position is that of its own odometry."""

    do: Literal["follow"] = "follow"
    for_s: float = Field(gt=0)


class TakeOff(StrictModel):
    """Arm, when the checks pass, and climb at 1 m/s to a height over the ground; time runs on while not armed."""

    do: Literal["take_off"] = "take_off"
    height_m: float = Field(default=8.0, gt=0.5)
    for_s: float = Field(gt=0)


class UseSources(StrictModel):
    """The pilot selects a source set by the remote control, at once."""

    do: Literal["use_sources"] = "use_sources"
    set: int = Field(ge=1, le=3)
    for_s: float = Field(default=0.0, ge=0, le=0)


PlanStep = Annotated[FollowPath | Hold | GoTo | Square | Follow | TakeOff | UseSources, Field(discriminator="do")]


class FlightStackSettings(StrictModel):
    """The autopilot in the loop. Without it the drone follows its path whatever it is sent."""

    kind: Literal["ardupilot", "px4"] = "ardupilot"
    source_sets: tuple[SourceSet, ...] = Field(default=("gps", "external"), min_length=1, max_length=3)
    source_options: int = Field(default=0, ge=0, le=15)  # EK3_SRC_OPTIONS; 1, ArduPilot's default: fuse all velocities
    viso_delay_ms: int = Field(default=10, ge=0, le=250)
    plan: tuple[PlanStep, ...] = Field(default=(FollowPath(for_s=3600.0),), min_length=1)
    on_ground: bool = False  # start on the ground, disarmed, below the start of the path
    lanes: int = Field(default=1, ge=1, le=2)  # EKF cores, each with its own IMU
    independent_telemetry: bool = False  # a test instrument: telemetry of a second EKF that uses the first set only
    gps_until_s: float | None = Field(default=None, ge=0)  # GPS has no fix from then on; None: it always has one
    imu: ImuSettings = ImuSettings()
    gps: GpsSettings = GpsSettings()
    compass: CompassSettings = CompassSettings()
    baro: BaroSettings = BaroSettings()
    wind: WindSettings = WindSettings()
    airframe: Airframe = Airframe()
    reboot_s: tuple[float, ...] = ()  # the autopilot reboots in flight, with its motors running on, as a watchdog reset
    estimate_resets_m: tuple[tuple[float, Vector], ...] = ()  # (time, jump): the EKF's position jumps
    end_after_loss_s: float | None = Field(default=5.0, ge=0)  # the simulation ends so long after a loss; None: never
    check_visual_odometry: bool = True  # bit of ARMING_CHECK: without it, it arms without external poses
    denied_intervals: tuple[int, ...] = ()  # message ids whose SET_MESSAGE_INTERVAL is denied

    @model_validator(mode="after")
    def _sets_exist(self) -> FlightStackSettings:
        wrong = [step.set for step in self.plan if isinstance(step, UseSources) and step.set > len(self.source_sets)]
        if wrong:
            raise ValueError(f"plan: use_sources {wrong[0]}, but there are {len(self.source_sets)} source_sets")
        return self
