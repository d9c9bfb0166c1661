"""Chain of poses of a drone whose rotation is known: started at one rotation, propagated by odometry, corrected.

A rotation passes a chi-square gate on its innovation with P + R; the back end then applies the Huber weight, as for
LiDAR positions. Eight consecutive rejected rotations that agree with each other replace the estimate.

Source: DESIGN, Fusion; ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.fuse.consistency import InformationInflation, Rejected, inflation
from stages.fuse.positions import GATE, Positions
from stages.fuse.settings import FuseErrors
from stages.fuse.smoother import BackEnd
from stages.geometry.frames import Array64, heading_rad
from stages.geometry.se3 import composed_covariance, mahalanobis2, position_covariance
from stages.kernels.geometry.so3 import log_rotation

PERIOD_NS = 100_000_000  # between poses of the chain


class Chain:
    """Starts, extends and stops the back end; its pose is valid only while `running`."""

    def __init__(self, back: BackEnd, errors: FuseErrors, positions: Positions) -> None:
        self.back = back
        self._errors, self._positions = errors, positions
        self.lose()

    def lose(self) -> None:
        """Stop: drop the rotation and the rejected measurements."""
        self.running = False
        self.rotation_covariance_rad2 = np.zeros((3, 3))
        self._rejected = Rejected()
        self._inflation = InformationInflation(self._errors.rotation_time_s)

    def start(self, stamp_ns: int, R: Array64, covariance_rad2: Array64) -> None:
        """Start from a rotation at `stamp_ns`, at the newest fix or at the newest pose of a running chain."""
        if self.running:
            at_ns, xyz_m = self.back.stamp_ns, self.back.xyz_map_m
            covariance_m2 = position_covariance(self.back.covariance, self.back.R_map_drone)
        else:
            free = self._positions.free
            assert free.stamp_ns is not None
            at_ns = free.stamp_ns
            xyz_m, covariance_m2 = free.ahead(at_ns)
            self._positions.start_drift(xyz_m, covariance_m2)
        turn = self._positions.step(stamp_ns, at_ns, R)
        R_map_drone = R @ turn.R
        if self.running:
            self._add_yaw_correction(self.back.R_map_drone, R_map_drone)
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = turn.R.T @ covariance_rad2 @ turn.R + turn.covariance[:3, :3]
        covariance[3:, 3:] = R_map_drone.T @ covariance_m2 @ R_map_drone
        self.back.start(at_ns, R_map_drone, xyz_m, covariance)
        self.running = True
        self.rotation_covariance_rad2 = covariance_rad2
        self._inflation = InformationInflation(self._errors.rotation_time_s)

    def extend(self, next_ns: int, R_odom_drone: Array64 | None) -> None:
        """Add a pose; of `R_odom_drone`, the autopilot's attitude there, only the vertical is used."""
        step = self._positions.step(self.back.stamp_ns, next_ns, self.back.R_map_drone)
        R_expected = self.back.R_map_drone @ step.R
        tilt_rad2 = math.radians(self._errors.tilt_deg) ** 2 * inflation(1e-9 * PERIOD_NS, self._errors.tilt_time_s)
        self.back.extend(next_ns, step, None if R_odom_drone is None else R_odom_drone[2], tilt_rad2)
        self._add_yaw_correction(R_expected, self.back.R_map_drone)

    def _add_yaw_correction(self, R_before: Array64, R_after: Array64) -> None:
        """Pass a correction of the newest yaw to the drift filter."""
        self._positions.left.correct_yaw(heading_rad(R_after @ R_before.T))

    def at(self, stamp_ns: int) -> tuple[Array64, Array64, Array64]:
        """R_map_drone, position and covariance (6, 6), propagated from the nearest pose of the chain."""
        key_ns, R, xyz_m = self.back.near(stamp_ns)
        step = self._positions.step(key_ns, stamp_ns, R)
        covariance = composed_covariance(self.back.covariance, step.R, step.t_m, step.covariance)
        return R @ step.R, xyz_m + R @ step.t_m, covariance

    def add_position(self, stamp_ns: int, R_map_drone: Array64, z: Array64, covariance_m2: Array64) -> None:
        """Add a LiDAR position at its own time; R_map_drone is the chain's there."""
        key_ns, R_key, _ = self.back.near(stamp_ns)
        step = self._positions.step(key_ns, stamp_ns, R_key)
        before = self.back.R_map_drone
        self.back.add_position(key_ns, step, z, covariance_m2 + position_covariance(step.covariance, R_map_drone))
        self._add_yaw_correction(before, self.back.R_map_drone)

    def fits(self, stamp_ns: int, R: Array64, covariance_rad2: Array64) -> bool | None:
        """True: within the gate. None: rejected. False: rejected, and it agrees with the rejected ones before it."""
        R_expected, _, covariance = self.at(stamp_ns)
        off = log_rotation(R_expected.T @ R)
        if mahalanobis2(off, covariance[:3, :3] + covariance_rad2) <= GATE:
            self._rejected.clear()
            return True
        return False if self._rejected.add(stamp_ns, off, covariance_rad2) else None

    def add_rotation(self, stamp_ns: int, R: Array64, covariance_rad2: Array64) -> None:
        """Add a rotation at its own time."""
        self.rotation_covariance_rad2 = covariance_rad2
        factor = (1.0 - self._errors.rotation_bias_share) * self._inflation.factor(stamp_ns)
        key_ns, R_key, _ = self.back.near(stamp_ns)
        step = self._positions.step(key_ns, stamp_ns, R_key)
        before = self.back.R_map_drone
        self.back.add_rotation(key_ns, step, R, factor * covariance_rad2 + step.covariance[:3, :3])
        self._add_yaw_correction(before, self.back.R_map_drone)

    @property
    def yaw_sigma_rad(self) -> float:
        """Yaw sigma of the newest pose."""
        return yaw_sigma_rad(self.back.R_map_drone, self.back.covariance)


def yaw_sigma_rad(R: Array64, covariance: Array64) -> float:
    """Sigma of a pose's rotation about the vertical [rad]."""
    return math.sqrt(max(float(R[2] @ covariance[:3, :3] @ R[2]), 0.0))
