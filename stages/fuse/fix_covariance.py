"""Error of a LiDAR position in `map`: white, and a bias that does not average out.

A vehicle tilts on its suspension when it brakes or turns: about x by k a_left, about y by k a_forward, with k =
`vehicle_tilt_deg_per_mps2`; and on an uneven road, by `vehicle_tilt_deg`. Where its odometry does not measure roll and
pitch, these are one sigma of either. The acceleration is the measured one, weighted with that of traffic
(USUAL_MANEUVER) by their variances.

Source: ours; the shares: stages/fuse/settings.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.fuse.settings import FuseErrors
from stages.geometry.extrapolation import USUAL_MANEUVER
from stages.geometry.frames import Array64
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import DroneFix

DRIVES_MPS = 1.0  # from this speed on, the whole tilt by the road is assumed


@dataclass(frozen=True)
class FixCovariance:
    """Covariances (3, 3), map axes [m2]."""

    white: Array64
    bias: Array64

    @property
    def whole(self) -> Array64:
        """Their sum."""
        return self.white + self.bias


def fix_covariance(fix: DroneFix, vehicle: VehicleTrajectory, errors: FuseErrors) -> FixCovariance:
    """Error of a LiDAR position, with that of the vehicle's tilt and of its extrapolated pose."""
    whole = errors.fix_variance * fix.covariance_m2
    bias = errors.fix_bias_share * whole
    if fix.bias_covariance_m2 is not None:
        bias = fix.bias_covariance_m2
        whole = bias + errors.fix_variance * (fix.covariance_m2 - bias)
    R, by_vehicle = vehicle.at(fix.stamp_ns)[0], np.zeros((3, 3))
    if vehicle.known_at(fix.stamp_ns):  # otherwise the vehicle frame serves as the map frame
        by_vehicle = vehicle.extrapolation_covariance_m2(fix.stamp_ns, fix.xyz_vehicle_m)
        if not vehicle.measures_tilt:
            tilted = np.cross(np.diag(_tilt_rad(vehicle, errors))[:2], fix.xyz_vehicle_m)  # (2, 3), one sigma
            by_vehicle = by_vehicle + tilted.T @ tilted
    return FixCovariance(R @ (whole - bias + by_vehicle) @ R.T, R @ bias @ R.T)


def _tilt_rad(vehicle: VehicleTrajectory, errors: FuseErrors) -> tuple[float, float, float]:
    """One sigma of the vehicle's rotation about its axes, which its odometry does not measure."""
    moving = min(vehicle.newest_speed_mps / DRIVES_MPS, 1.0)
    usual2 = (moving * USUAL_MANEUVER.acceleration_mps2) ** 2
    forward2, left2 = usual2, usual2
    if (acceleration := vehicle.newest_acceleration()) is not None:
        measured, variance = (axes[:2] for axes in acceleration)
        share = usual2 / np.maximum(usual2 + variance, np.finfo(float).tiny)
        forward2, left2 = (share * measured) ** 2 + share * variance  # E[a^2 | measured], a ~ N(0, usual2)
    gain, road_deg = errors.vehicle_tilt_deg_per_mps2, moving * errors.vehicle_tilt_deg
    about_x, about_y = (math.radians(math.sqrt(road_deg**2 + gain**2 * a2)) for a2 in (left2, forward2))
    return about_x, about_y, 0.0
