"""Sizes of the errors that the fusion reckons with, and its limits.

Source: DESIGN, Fusion; sizes are ours: a consumer-grade EKF's drift; fixes as simulated flights show them, whose errors
correlate by 0.40 0.19 0.07 at 0.1 0.2 0.3 s about a mean of their own that holds a quarter of the variance.
"""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class FuseErrors(BaseModel):
    """One sigma each."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    drift_mps: float = Field(default=0.12, gt=0)  # error of the drone's and the vehicle's velocity together, one axis
    drift_time_s: float = Field(default=15.0, gt=0)  # for which it lasts
    drift_scale: float = Field(default=0.02, ge=0)  # of a change of velocity: scale and heading of the odometries
    walk_m_per_sqrt_s: float = Field(default=0.04, gt=0)  # of the odometry's position, beside its drift
    turn_walk_deg_per_sqrt_s: float = Field(default=0.1, gt=0)  # of the autopilot's attitude
    tilt_deg: float = Field(default=1.0, gt=0)  # of the autopilot's vertical in the map frame
    tilt_time_s: float = Field(default=20.0, gt=0)
    manoeuvre: float = Field(default=5.0, gt=0)  # density of the drone's acceleration where no odometry tells [m2/s3]
    manoeuvre_with_odometry: float = Field(default=0.7, gt=0)  # beside the change of velocity that its autopilot tells
    fix_variance: float = Field(default=0.65, gt=0)  # a fix's true variance over the one told; trackers are careful
    fix_time_s: float = Field(default=0.2, ge=0)  # for which the error of a fix lasts
    # share of its variance that never averages out (calibration), where the tracker does not tell it itself
    fix_bias_share: float = Field(default=0.25, ge=0, lt=1)
    rotation_time_s: float = Field(default=1.0, ge=0)  # for which an error of the vanishing points lasts
    rotation_bias_share: float = Field(default=0.2, ge=0, lt=1)


class FuseLimits(BaseModel):
    """When a pose is what."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    coast_after_s: float = Field(default=0.35, gt=0)  # without a LiDAR position
    lost_after_s: float = Field(default=8.0, gt=0)
    lost_sigma_m: float = Field(default=1.5, gt=0)  # along the worst axis
    yaw_sigma_deg: float = Field(default=8.0, gt=0, lt=30)  # a rotation known worse is not given out
    jump_m: float = Field(default=0.5, gt=0)  # of the pose between two outputs: counted as a reset
    jump_deg: float = Field(default=10.0, gt=0)
