"""Position and velocity of the drone by LiDAR alone, and the drift of its odometry.

A fix passes a chi-square gate on its innovation with P + R. Eight consecutive rejected fixes that agree with each other
replace the estimate.

Source: DESIGN, Fusion; ours.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stages.fuse.consistency import InformationInflation, Rejected
from stages.fuse.drift import Drift
from stages.fuse.motion_model import Motions, Step
from stages.fuse.settings import FuseErrors
from stages.geometry.frames import Array64
from stages.geometry.se3 import mahalanobis2
from stages.messages import DroneFix

HELD_MPS = 0.1  # noise of the autopilot's velocity in addition to its drift
GATE = 16.27  # chi-square, 3 degrees of freedom, 99.9 %


class MeasurementCovariance(NamedTuple):
    """Error of a fix, map axes."""

    whole_m2: Array64  # (3, 3)
    bias_covariance_m2: Array64 | None  # the part that is the same from fix to fix


class Positions:
    """Filters of the drone that is followed."""

    def __init__(self, errors: FuseErrors, motions: Motions) -> None:
        self._errors, self._motions = errors, motions
        self.lose()

    def lose(self) -> None:
        """Drop the position."""
        self.free, self.left = Drift(self._errors, odometry=False), Drift(self._errors, odometry=True)
        self.fix_ns: int | None = None
        self.fix_covariance_m2 = np.zeros((3, 3))  # map axes, of the newest fix used: the part that averages out,
        self.bias_covariance_m2 = np.zeros((3, 3))  # and the bias
        self.nis = math.nan
        self._rejected = Rejected()
        self._inflation = InformationInflation(self._errors.fix_time_s)

    @property
    def known(self) -> bool:
        """Whether a position is known."""
        return self.free.stamp_ns is not None

    def find(self, fix: DroneFix, z: Array64, noise: MeasurementCovariance) -> None:
        """Start at the first fix, or at the first after a reset."""
        velocity = fix.velocity_vehicle_mps
        if velocity is not None:
            velocity = self._motions.vehicle.to_map(fix.stamp_ns, fix.xyz_vehicle_m, velocity)[1]
        self.free.start(fix.stamp_ns, z, noise.whole_m2, velocity)
        self.fix_ns = fix.stamp_ns
        self._accept(noise)

    def accepts(self, stamp_ns: int, off_m: Array64, expected_m2: Array64, noise: MeasurementCovariance) -> bool | None:
        """True: within the gate. None: rejected. False: rejected, and it agrees with the rejected ones before it."""
        nis = mahalanobis2(off_m, expected_m2 + noise.whole_m2)
        if not nis <= GATE:
            return False if self._rejected.add(stamp_ns, off_m, noise.whole_m2) else None
        self._rejected.clear()
        self.nis = nis
        self._accept(noise)
        return True

    def _accept(self, noise: MeasurementCovariance) -> None:
        variance, share = self._errors.fix_variance, self._errors.fix_bias_share
        if noise.bias_covariance_m2 is None:
            self.fix_covariance_m2 = (1.0 - share) * variance * noise.whole_m2
            self.bias_covariance_m2 = share * variance * noise.whole_m2
        else:
            self.fix_covariance_m2, self.bias_covariance_m2 = (
                variance * (noise.whole_m2 - noise.bias_covariance_m2),
                noise.bias_covariance_m2,
            )

    def worth(self, stamp_ns: int) -> float:
        """Variance inflation factor of the fix just accepted, for errors correlated in time (consistency.py)."""
        return self._inflation.factor(stamp_ns)

    def follow(self, stamp_ns: int, z: Array64, factor: float, R_map_drone: Array64 | None) -> None:
        """Update both filters by an accepted fix: velocity without odometry, and drift of the odometry."""
        covariance_m2, trail = self.fix_covariance_m2, self._motions.motion_model.autopilot
        v0 = None if self.free.stamp_ns is None else trail.velocity_odom_mps(self.free.stamp_ns)
        v1 = trail.velocity_odom_mps(stamp_ns)
        turned_mps = 0.0 if v0 is None or v1 is None else float(np.linalg.norm(v1 - v0))
        self.free.q = self._manoeuvre(stamp_ns)
        self.free.see(stamp_ns, z, covariance_m2 + self.bias_covariance_m2, None, turned_mps)
        self.fix_ns = max(stamp_ns, self.fix_ns or stamp_ns)
        R_odom, last_ns = self._motions.R_odom_drone(stamp_ns), self.left.stamp_ns
        if R_map_drone is None or R_odom is None:
            return
        displacement_m = None if last_ns is None else self._motions.motion_model.displacement_odom_m(last_ns, stamp_ns)
        if displacement_m is None:
            self.left.start(stamp_ns, z, factor * covariance_m2, None)
        else:
            self.left.see(stamp_ns, z, factor * covariance_m2, R_map_drone @ R_odom.T @ displacement_m[0], turned_mps)

    def turn(self, R_new_old: Array64, t_m: Array64, velocity_mps: Array64) -> None:
        """Change to another map frame: p <- R p + t; the velocity R v + velocity_mps is a guess."""
        self.free.turn(R_new_old, t_m)
        self.forget_velocity(self.free.velocity_mps + velocity_mps)

    def forget_velocity(self, guess_mps: Array64 | None = None) -> None:
        """The map frame starts or stops moving: reset the velocity."""
        self.left = Drift(self._errors, odometry=True)
        self.free.forget_velocity(np.zeros(3) if guess_mps is None else guess_mps)

    def start_drift(self, xyz_m: Array64, covariance_m2: Array64) -> None:
        """Start the drift filter of the odometry at the newest fix."""
        assert self.free.stamp_ns is not None
        self.left = Drift(self._errors, odometry=True)
        self.left.start(self.free.stamp_ns, xyz_m, covariance_m2, None)

    def step(self, from_ns: int, to_ns: int, R_map_drone: Array64) -> Step:
        """Motion of the drone between two times."""
        since_ns = self.fix_ns if self.fix_ns is not None else from_ns
        still = self._motions.map_is_fixed(to_ns)
        return self._motions.motion_model.step(from_ns, to_ns, R_map_drone, self.left, self.free, still, since_ns)

    def at(self, stamp_ns: int) -> tuple[Array64, Array64]:
        """Position and covariance by the velocity of the fixes; a reported maneuver adds to the covariance.

        Only the position block of the covariance (6, 6) is valid, map axes.
        """
        assert self.free.stamp_ns is not None
        self.free.q = self._manoeuvre(stamp_ns)
        xyz_m, covariance_m2 = self.free.ahead(stamp_ns)
        covariance = np.zeros((6, 6))
        covariance[3:, 3:] += covariance_m2
        manoeuvre_m = self._motions.motion_model.manoeuvre_m(self.free.stamp_ns, stamp_ns)
        if manoeuvre_m is not None:
            xyz_m = xyz_m + np.array([0.0, 0.0, manoeuvre_m[2]])
            aside_m2 = 0.5 * float(manoeuvre_m[:2] @ manoeuvre_m[:2])  # in an unknown level direction
            covariance[3:, 3:] += np.diag([aside_m2, aside_m2, 0.0])
        return xyz_m, covariance

    def velocity(self, stamp_ns: int, R_map_drone: Array64 | None, yaw_sigma_rad: float) -> tuple[Array64, Array64]:
        """Velocity over ground (3,), map axes, and its covariance; from the autopilot where the rotation is known."""
        age_s = 0.0 if self.fix_ns is None else max((stamp_ns - self.fix_ns) * 1e-9, 0.0)
        v_odom, R_odom = (
            self._motions.motion_model.autopilot.velocity_odom_mps(stamp_ns),
            self._motions.R_odom_drone(stamp_ns),
        )
        if R_map_drone is None or v_odom is None or R_odom is None or self.left.stamp_ns is None:
            return self.free.velocity_mps, self.free.velocity_covariance + self.free.q * age_s * np.eye(3)
        velocity = R_map_drone @ R_odom.T @ v_odom
        across = np.cross([0.0, 0.0, yaw_sigma_rad], velocity)
        spread = self.left.velocity_covariance + (self.left.q * age_s + HELD_MPS**2) * np.eye(3)
        return velocity + self.left.velocity_mps, spread + np.outer(across, across)

    def _manoeuvre(self, stamp_ns: int) -> float:
        """Noise density of the acceleration that no measurement shows [m2/s3]."""
        measured = self._motions.motion_model.autopilot.velocity_odom_mps(stamp_ns) is not None
        return self._errors.manoeuvre_with_odometry if measured else self._errors.manoeuvre
