"""Assumed errors of the measurements, and limits of the states.

Source: ours. Errors of fixes as in 30 simulated flights at 10 to 30 m (bench_measured_errors.py):
about their mean they have 0.70 of the reported variance and are correlated by 0.68, 0.59, 0.43, 0.26, 0.10 at 0.1,
0.2, 0.3, 0.5, 1.0 s; their mean has 0.73 of the variance of the reported bias. The inflated white error that stands
for them loses what differences of positions say, so its time constant is the one with which 95 % of the fused
positions of these flights are in their 95 % ellipsoid. Roll and pitch: an autopilot in wind and manoeuvres; its
compass: ArduPilot, Compass setup and interference, and the magnetic field between steel and reinforced concrete.
"""

from __future__ import annotations

from pydantic import Field

from flow.stage import StrictModel


class FuseErrors(StrictModel):
    """Errors, one sigma each."""

    fix_variance: float = Field(default=0.7, gt=0)  # true variance of a fix over the one that the tracker reports
    fix_time_s: float = Field(default=0.2, ge=0)  # time constant of the error of a fix
    # share of its variance that does not average out (calibration), where the tracker does not report it
    fix_bias_share: float = Field(default=0.25, ge=0, lt=1)
    # roll and pitch of a vehicle whose odometry does not measure them: by a paved road (assumed), and by acceleration
    # (the body of a car: 3 to 6 deg per g)
    vehicle_tilt_deg: float = Field(default=0.2, ge=0, le=10)
    vehicle_tilt_deg_per_mps2: float = Field(default=0.5, ge=0, le=10)
    clock_s: float = Field(default=0.01, ge=0)  # of the stamps of IMU and LiDAR against each other
    tilt_deg: float = Field(default=2.0, gt=0)  # of the autopilot's vertical
    tilt_period_s: float = Field(default=0.5, gt=0)  # between two uses of the autopilot's vertical
    rotation_time_s: float = Field(default=1.0, ge=0)  # time constant of the error of vanishing points
    rotation_bias_share: float = Field(default=0.2, ge=0, lt=1)
    compass_deg: float = Field(default=7.0, gt=0)  # of the autopilot's yaw
    compass_outliers: float = Field(default=0.03, gt=0, lt=1)  # share of autopilots whose yaw is wrong by any angle
    cue_time_s: float = Field(default=1.0, ge=0)  # time constant of the noise of cues
    cue_clock_s: float = Field(default=0.05, ge=0)  # of the latency of cues
    cue_seen_m: float = Field(default=0.1, ge=0)  # of the drone's position by LiDAR and IMU at a cue, each axis
    changed_frames: float = Field(default=0.05, gt=0, lt=1)  # share of restarts and outages with another frame after


class FuseLimits(StrictModel):
    """Limits of the states of a pose."""

    coast_after_s: float = Field(default=0.35, gt=0)  # without a LiDAR position
    lost_after_s: float = Field(default=8.0, gt=0)
    lost_sigma_m: float = Field(default=1.5, gt=0)  # along the worst axis
    yaw_sigma_deg: float = Field(default=5.0, gt=0, lt=30)  # a less certain rotation is not published
    jump_m: float = Field(default=0.5, gt=0)  # of the pose between two outputs: counted as a reset
    jump_deg: float = Field(default=10.0, gt=0)
