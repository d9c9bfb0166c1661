"""Assumed errors of the measurements, and limits of the states.

Source: DESIGN, Fusion; values are ours: the drift of a consumer-grade EKF; errors of fixes as in simulated flights,
correlated by 0.40, 0.19, 0.07 at 0.1, 0.2, 0.3 s about a bias with a quarter of the variance.
"""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class FuseErrors(BaseModel):
    """Errors, one sigma each."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    drift_mps: float = Field(default=0.12, gt=0)  # error of the drone's and the vehicle's velocity together, one axis
    drift_time_s: float = Field(default=15.0, gt=0)  # time constant of the drift
    drift_scale: float = Field(default=0.02, ge=0)  # of a change of velocity: scale and heading of the odometries
    walk_m_per_sqrt_s: float = Field(default=0.04, gt=0)  # of the odometry's position, in addition to its drift
    turn_walk_deg_per_sqrt_s: float = Field(default=0.1, gt=0)  # of the autopilot's attitude
    tilt_deg: float = Field(default=1.0, gt=0)  # of the autopilot's vertical in the map frame
    tilt_time_s: float = Field(default=20.0, gt=0)
    manoeuvre: float = Field(default=5.0, gt=0)  # density of the drone's acceleration without odometry [m2/s3]
    manoeuvre_with_odometry: float = Field(default=0.7, gt=0)  # the same with the autopilot's velocity
    fix_variance: float = Field(default=0.65, gt=0)  # true variance of a fix over the one that the tracker reports
    fix_time_s: float = Field(default=0.2, ge=0)  # time constant of the error of a fix
    # share of its variance that does not average out (calibration), where the tracker does not report it
    fix_bias_share: float = Field(default=0.25, ge=0, lt=1)
    rotation_time_s: float = Field(default=1.0, ge=0)  # time constant of the error of vanishing points
    rotation_bias_share: float = Field(default=0.2, ge=0, lt=1)


class FuseLimits(BaseModel):
    """Limits of the states of a pose."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    coast_after_s: float = Field(default=0.35, gt=0)  # without a LiDAR position
    lost_after_s: float = Field(default=8.0, gt=0)
    lost_sigma_m: float = Field(default=1.5, gt=0)  # along the worst axis
    yaw_sigma_deg: float = Field(default=8.0, gt=0, lt=30)  # a less certain rotation is not published
    jump_m: float = Field(default=0.5, gt=0)  # of the pose between two outputs: counted as a reset
    jump_deg: float = Field(default=10.0, gt=0)
