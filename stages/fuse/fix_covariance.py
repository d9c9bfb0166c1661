"""Error of a LiDAR position in `map`: white, and a bias that does not average out.

A vehicle tilts on its suspension when it brakes or turns: about x by k a_left, about y by k a_forward, with k =
`vehicle_tilt_deg_per_mps2`; and on an uneven road, by `vehicle_tilt_deg`. Where its odometry does not measure roll and
pitch, these are one sigma of either.

Source: ours; the shares: stages/fuse/settings.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.fuse.settings import FuseErrors
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
    if vehicle.is_level:
        tilted = np.cross(np.diag(_tilt_rad(vehicle, fix.stamp_ns, errors))[:2], fix.xyz_vehicle_m)  # (2, 3), one sigma
        whole = whole + tilted.T @ tilted
    R, ahead = vehicle.at(fix.stamp_ns)[0], np.zeros((3, 3))
    if vehicle.known_at(fix.stamp_ns):  # otherwise the vehicle frame serves as the map frame
        ahead = vehicle.extrapolation_covariance_m2(fix.stamp_ns, fix.xyz_vehicle_m)
    return FixCovariance(R @ (whole - bias + ahead) @ R.T, R @ bias @ R.T)


def _tilt_rad(vehicle: VehicleTrajectory, stamp_ns: int, errors: FuseErrors) -> tuple[float, float, float]:
    """One sigma of the vehicle's rotation about its axes, which its odometry does not measure."""
    velocity, (forward, left, _) = vehicle.recent_motion(stamp_ns)
    road_deg = errors.vehicle_tilt_deg * min(math.hypot(*velocity) / DRIVES_MPS, 1.0)
    about_x, about_y = (math.hypot(road_deg, errors.vehicle_tilt_deg_per_mps2 * a) for a in (left, forward))
    return math.radians(about_x), math.radians(about_y), 0.0
