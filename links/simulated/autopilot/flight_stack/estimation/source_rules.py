"""What ArduPilot's EKF3 and PX4's EKF2 fuse, gate, time out and reset: tables of their parameters and constants.

Source: https://github.com/ArduPilot/ardupilot (4.6), libraries/AP_NavEKF/AP_NavEKF_Source.cpp, AP_NavEKF3/AP_NavEKF3.h
and .cpp (gates, noises, times), AP_NavEKF3_Control.cpp (setAidingMode), ArduCopter/ekf_check.cpp, AP_VisualOdom;
https://github.com/PX4/PX4-Autopilot, src/modules/ekf2/EKF/common.h and params_*.yaml.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

from links.simulated.autopilot.flight_stack.settings import SourceSet

FUSE_ALL_VELOCITIES = 1  # bit of EK3_SRC_OPTIONS


class AidingSource(enum.Enum):
    """A source of one quantity. Values of ArduPilot's EK3_SRCn_POSXY, VELXY, POSZ, VELZ, YAW."""

    NONE = 0
    BARO = 1  # POSZ; COMPASS for YAW
    GPS = 3
    EXTERNAL = 6


@dataclass(frozen=True, slots=True)
class Sources:
    """One source set, EK3_SRCn_*."""

    position: AidingSource
    velocity: AidingSource
    height: AidingSource
    climb: AidingSource
    yaw: AidingSource  # BARO means the compass here: both have the same number


SOURCE_SETS: dict[SourceSet, Sources] = {
    "gps": Sources(AidingSource.GPS, AidingSource.GPS, AidingSource.BARO, AidingSource.GPS, AidingSource.BARO),
    "external": Sources(*[AidingSource.EXTERNAL] * 5),
    "external_no_velocity": Sources(
        AidingSource.EXTERNAL, AidingSource.NONE, AidingSource.EXTERNAL, AidingSource.NONE, AidingSource.EXTERNAL
    ),
    "external_baro_height": Sources(
        AidingSource.EXTERNAL, AidingSource.EXTERNAL, AidingSource.BARO, AidingSource.EXTERNAL, AidingSource.EXTERNAL
    ),
    "external_position": Sources(
        AidingSource.EXTERNAL, AidingSource.NONE, AidingSource.BARO, AidingSource.NONE, AidingSource.BARO
    ),
    "none": Sources(AidingSource.NONE, AidingSource.NONE, AidingSource.BARO, AidingSource.NONE, AidingSource.BARO),
}


@dataclass(frozen=True, slots=True)
class FilterRules:
    """Constants of one autopilot's filter. Times in seconds, noises one sigma."""

    gyro_noise_radps: float  # EK3_GYRO_P_NSE, EKF2_GYR_NOISE
    accelerometer_noise_mps2: float  # EK3_ACC_P_NSE, EKF2_ACC_NOISE
    gyro_bias_noise: float  # EK3_GBIAS_P_NSE, EKF2_GYR_B_NOISE [rad/s per s]
    accelerometer_bias_noise: float  # EK3_ABIAS_P_NSE, EKF2_ACC_B_NOISE [m/s^3]
    baro_noise_m: float  # EK3_ALT_M_NSE, EKF2_BARO_NOISE
    compass_noise_rad: float  # of a heading by the compass; EKF2_HEAD_NOISE
    external_velocity_noise_mps: float  # VISO_VEL_M_NSE, EKF2_EVV_NOISE
    position_gate: float  # EK3_POS_I_GATE / 100, EKF2_EVP_GATE
    velocity_gate: float
    height_gate: float
    yaw_gate: float
    position_retry_s: float  # posRetryTimeNoVel_ms; reset_timeout_max
    position_retry_with_velocity_s: float  # posRetryTimeUseVel_ms
    velocity_retry_s: float
    height_retry_s: float  # hgtRetryTimeMode12_ms
    stop_aiding_s: float  # tiltDriftTimeMax_ms
    external_height_lost_s: float  # extNavDataIsFresh
    horizon_s: float  # delay of the fusion horizon


EKF3 = FilterRules(
    gyro_noise_radps=0.015,
    accelerometer_noise_mps2=0.35,
    gyro_bias_noise=1.0e-3,
    accelerometer_bias_noise=0.02,
    baro_noise_m=2.0,
    compass_noise_rad=0.1,  # of the three-axis fusion in flight: EK3_MAG_M_NSE 0.05 gauss in a field of 0.5 gauss
    external_velocity_noise_mps=0.1,
    position_gate=5.0,
    velocity_gate=5.0,
    height_gate=5.0,
    yaw_gate=3.0,
    position_retry_s=7.0,
    position_retry_with_velocity_s=10.0,
    velocity_retry_s=10.0,
    height_retry_s=5.0,
    stop_aiding_s=15.0,
    external_height_lost_s=0.5,
    horizon_s=0.24,
)

EKF2 = FilterRules(
    gyro_noise_radps=0.015,
    accelerometer_noise_mps2=0.35,
    gyro_bias_noise=1.0e-3,
    accelerometer_bias_noise=3.0e-3,
    baro_noise_m=3.5,
    compass_noise_rad=0.3,
    external_velocity_noise_mps=0.1,
    position_gate=5.0,
    velocity_gate=3.0,
    height_gate=5.0,
    yaw_gate=2.6,
    position_retry_s=1.0,
    position_retry_with_velocity_s=1.0,
    velocity_retry_s=1.0,
    height_retry_s=5.0,
    stop_aiding_s=5.0,
    external_height_lost_s=0.4,
    horizon_s=0.2,
)

FS_EKF_THRESH = 0.8  # ArduCopter: limit of the roots of innovation test ratios
EKF_CHECK_HZ, EKF_CHECK_ITERATIONS = 10.0, 10  # ekf_check: one second of bad variances
PX4_NO_AID_S = 5.0  # EKF2_NOAID_TOUT: then the position is invalid, and the failsafe descends
PX4_EV_START_S, PX4_EV_STOP_S = 0.2, 0.4  # EV_MAX_INTERVAL and twice it
PX4_EV_RESETS = 5  # _nb_ev_pos_reset_available


def fuses_velocity(kind: AidingSource, active: Sources, sets: tuple[Sources, ...], options: int) -> bool:
    """AP_NavEKF_Source::useVelXYSource: the active set's velocity, or any set's with FUSE_ALL_VELOCITIES."""
    if active.velocity is kind:
        return True
    return bool(options & FUSE_ALL_VELOCITIES) and any(one.velocity is kind for one in sets)


def fuses_climb(kind: AidingSource, active: Sources, sets: tuple[Sources, ...], options: int) -> bool:
    """AP_NavEKF_Source::useVelZSource."""
    if active.climb is kind:
        return True
    return bool(options & FUSE_ALL_VELOCITIES) and any(one.climb is kind for one in sets)
