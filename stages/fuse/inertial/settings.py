"""Assumed errors of the measurements of the inertial fusion.

Source: ours. Errors of fixes as in stages/fuse/settings.py; roll and pitch: an autopilot in wind and manoeuvres; its
compass: ArduPilot, Compass setup and interference, and the magnetic field between steel and reinforced concrete.
"""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class InertialErrors(BaseModel):
    """Errors, one sigma each."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    fix_variance: float = Field(default=0.65, gt=0)  # true variance of a fix over the one that the tracker reports
    fix_time_s: float = Field(default=0.12, ge=0)  # time constant of the error of a fix
    # share of its variance that does not average out (calibration), where the tracker does not report it
    fix_bias_share: float = Field(default=0.25, ge=0, lt=1)
    clock_s: float = Field(default=0.01, ge=0)  # of the stamps of IMU and LiDAR against each other
    tilt_deg: float = Field(default=2.0, gt=0)  # of the autopilot's vertical
    tilt_period_s: float = Field(default=0.5, gt=0)  # between two uses of the autopilot's vertical
    rotation_time_s: float = Field(default=1.0, ge=0)  # time constant of the error of vanishing points
    rotation_bias_share: float = Field(default=0.2, ge=0, lt=1)
    compass_deg: float = Field(default=7.0, gt=0)  # of the autopilot's yaw
    compass_outliers: float = Field(default=0.03, gt=0, lt=1)  # share of autopilots whose yaw is wrong by any angle
    changed_frames: float = Field(default=0.05, gt=0, lt=1)  # share of restarts while the autopilot changes its frame
