"""Motion of the vehicle and the drone, and whether it can be expressed in `map`.

A possible jump of the map frame starts a new one (stages/geometry/trajectory.py). Extrapolation beyond the newest pose:
stages/geometry/extrapolation.py.

Source: ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.fuse.drift import Drift
from stages.fuse.settings import FuseErrors
from stages.geometry.frames import Array64
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import VehicleMotion
from stages.odometry.drone.trajectory import AHEAD_NS, AutopilotTrajectory, VisualTrajectory, rotation_between

VEHICLE_TURN_RAD_PER_S = math.radians(20.0)  # turn rate of a vehicle without VehicleMotion
CLOCK_S = 0.003  # error of the autopilot's stamps against the host clock
BEYOND_MPS2 = 3.0  # acceleration of the drone while its velocity is kept


@dataclass(frozen=True)
class Step:
    """Motion of the drone from one time to another, in drone axes at the first."""

    R: Array64
    t_m: Array64
    covariance: Array64  # (6, 6) rotation before translation, tangent at the later body
    by_odometry: bool  # displacement by the autopilot; else by the kept velocity
    turn_measured: bool


class MotionModel:
    """Propagates a pose through time."""

    def __init__(self, errors: FuseErrors) -> None:
        self._errors = errors
        self.autopilot = AutopilotTrajectory()
        self.images = VisualTrajectory()

    def step(
        self, from_ns: int, to_ns: int, R_map_drone: Array64, left: Drift, free: Drift, still: bool, since_ns: int
    ) -> Step:
        """Motion from one time to another; R_map_drone at the first.

        `left`: filter of the drift that the autopilot's odometry leaves; `free`: filter of the velocity without that
        odometry. `still`: the map frame is known to be fixed; else odometry over ground is not usable. `since_ns`: time
        of the newest fix.
        """
        dt = (to_ns - from_ns) * 1e-9
        e = self._errors
        R, turn_rad2, turn_measured = self._turn(from_ns, to_ns)
        if not still:
            turn_rad2 += (VEHICLE_TURN_RAD_PER_S * dt) ** 2
        own = self.displacement_odom_m(from_ns, to_ns) if still and left.stamp_ns is not None else None
        R_odom = None if own is None else self._R_odom_held(from_ns)
        by_odometry = own is not None and R_odom is not None
        drift = left if by_odometry else free
        ago, then = (from_ns - since_ns) * 1e-9, (to_ns - since_ns) * 1e-9
        growth_covariance_m2 = (
            drift.growth_covariance_m2(then) - drift.growth_covariance_m2(ago)
            if then >= ago
            else drift.growth_covariance_m2(abs(dt))
        )
        spread = growth_covariance_m2 + e.walk_m_per_sqrt_s**2 * abs(dt) * np.eye(3)
        t = dt * (R_map_drone.T @ drift.velocity_mps)
        if own is not None and R_odom is not None:
            displacement_m, beyond_s = own
            t = t + R_odom.T @ displacement_m
            spread = spread + (0.5 * BEYOND_MPS2 * beyond_s**2) ** 2 * np.eye(3)
        R_map_after = R_map_drone @ R
        Q = np.zeros((6, 6))
        Q[:3, :3] = turn_rad2 * np.eye(3)
        Q[3:, 3:] = R_map_after.T @ spread @ R_map_after
        return Step(R, t, Q, by_odometry, turn_measured)

    def R_odom_drone(self, stamp_ns: int) -> Array64 | None:
        """The autopilot's attitude, extrapolated shortly beyond its newest message; None: not known."""
        return self.autopilot.R_odom_drone(stamp_ns)

    def displacement_odom_m(self, from_ns: int, to_ns: int) -> tuple[Array64, float] | None:
        """Displacement (3,) in odom by the autopilot, and the time beyond its newest message [s]; None: unknown.

        A displacement over a jump of its estimate is unknown.
        """
        newest = self.autopilot.position_ns
        if newest is None or max(from_ns, to_ns) > newest + 2 * AHEAD_NS:
            return None
        last = newest + AHEAD_NS
        a, b = self.autopilot.position(min(from_ns, last)), self.autopilot.position(min(to_ns, last))
        if a is None or b is None or a[1] != b[1]:
            return None
        beyond_ns = max(to_ns, from_ns) - newest
        displacement = b[0] - a[0]
        kept_s = (max(to_ns - last, 0) - max(from_ns - last, 0)) * 1e-9
        velocity = self.autopilot.velocity_odom_mps(last) if kept_s else None
        if velocity is not None:
            displacement = displacement + kept_s * velocity
        return displacement, max(beyond_ns, 0) * 1e-9

    def manoeuvre_m(self, from_ns: int, to_ns: int) -> Array64 | None:
        """Displacement (3,) by the autopilot, frame odom, less that at the constant velocity of the first time."""
        displacement, velocity = self.displacement_odom_m(from_ns, to_ns), self.autopilot.velocity_odom_mps(from_ns)
        return (
            None if displacement is None or velocity is None else displacement[0] - (to_ns - from_ns) * 1e-9 * velocity
        )

    def _R_odom_held(self, stamp_ns: int) -> Array64 | None:
        newest = self.autopilot.attitude_ns
        return None if newest is None else self.autopilot.R_odom_drone(min(stamp_ns, newest + AHEAD_NS))

    def _turn(self, from_ns: int, to_ns: int) -> tuple[Array64, float, bool]:
        """Rotation (3, 3) of the drone, its variance [rad2] about each axis, and whether it was measured."""
        dt = abs(to_ns - from_ns) * 1e-9
        newest = self.autopilot.attitude_ns
        if newest is not None:
            last = newest + AHEAD_NS
            a, b = self.autopilot.R_odom_drone(min(from_ns, last)), self.autopilot.R_odom_drone(min(to_ns, last))
            beyond_s = max(max(from_ns, to_ns) - newest, 0) * 1e-9
            if a is not None and b is not None and beyond_s < 2e-9 * AHEAD_NS:
                change = self.autopilot.rate_radps(to_ns) - self.autopilot.rate_radps(from_ns)
                random_walk = math.radians(self._errors.turn_walk_deg_per_sqrt_s) ** 2 * dt
                kept = (0.5 * max(1.0, self.autopilot.rate_radps(to_ns)) * beyond_s**2) ** 2  # the turn rate may change
                return a.T @ b, random_walk + (CLOCK_S * change) ** 2 + kept, True
        turn = rotation_between(self.autopilot, self.images, from_ns, to_ns)
        return turn.R_from_to, turn.variance_rad2, turn.measured

    def newest_ns(self, now_ns: int, positions: bool) -> int | None:
        """Time up to which sources of the last second measured the drone's motion; None: there were none."""
        stamps = [self.autopilot.attitude_ns, self.autopilot.position_ns if positions else None]
        recent = [ns for ns in stamps if ns is not None and now_ns - ns < 1_000_000_000]
        if not recent and self.images.newest_ns is not None and now_ns - self.images.newest_ns < 1_000_000_000:
            recent = [self.images.newest_ns]
        return min(recent) if recent else None


WAIT_NS = 350_000_000  # longest wait for late odometry
SOON_NS, VEHICLE_SOON_NS = 60_000_000, 200_000_000  # without waiting, both are extrapolated so far


class Motions:
    """Trajectories of the vehicle and of the drone."""

    def __init__(self, errors: FuseErrors, parked: bool) -> None:
        """`parked`: the vehicle is stationary, even without VehicleMotion."""
        self._parked = parked
        self.vehicle = VehicleTrajectory(joined=False)
        self.motion_model = MotionModel(errors)

    def add_vehicle_motion(self, motion: VehicleMotion) -> bool:
        """Add a vehicle pose; True: the map frame may be another one from now on."""
        return self.vehicle.add(motion)

    def vehicle_covariance_m2(self, stamp_ns: int, xyz_vehicle_m: Array64) -> tuple[Array64, float, Array64]:
        """Uncertainty of the vehicle's motion since its newest message, vehicle axes.

        The covariance (3, 3) that it adds to a position (3,) relative to the vehicle, the variance of the vehicle's
        yaw, and the derivative (3,) of the position by that yaw.
        """
        lever = np.array([-xyz_vehicle_m[1], xyz_vehicle_m[0], 0.0])
        shift_m, yaw_rad = self.vehicle.extrapolation_sigma(stamp_ns) if self.map_is_fixed(stamp_ns) else (0.0, 0.0)
        return shift_m**2 * np.eye(3) + yaw_rad**2 * np.outer(lever, lever), yaw_rad**2, lever

    def map_is_fixed(self, stamp_ns: int) -> bool:
        """Whether the vehicle's motion is known, so that the map frame does not move."""
        return self._parked or self.vehicle.known_at(stamp_ns)

    def R_odom_drone(self, stamp_ns: int) -> Array64 | None:
        """The autopilot's attitude; None: not known, or the map frame moves."""
        return self.motion_model.R_odom_drone(stamp_ns) if self.map_is_fixed(stamp_ns) else None

    def newest_ns(self, stamp_ns: int, now_ns: int) -> int | None:
        """Time up to which the drone's motion is measured; None: no recent data."""
        return self.motion_model.newest_ns(now_ns, positions=self.map_is_fixed(stamp_ns))

    def must_wait(self, stamp_ns: int, now_ns: int) -> bool:
        """Whether odometry of that time, of the drone or the vehicle, is still expected."""
        if now_ns - stamp_ns >= WAIT_NS:
            return False
        drone_ns = self.newest_ns(stamp_ns, now_ns)
        vehicle_ns = self.vehicle.newest_ns if self.map_is_fixed(stamp_ns) else None
        late = drone_ns is not None and drone_ns + SOON_NS < stamp_ns
        return late or (vehicle_ns is not None and vehicle_ns + VEHICLE_SOON_NS < stamp_ns)
