"""Inputs of the fusion in a flight, with errors of known statistics: fixes, rotations, odometries, each with its delay.

Everything is a function of time; every part may be left out, delayed or spoilt. Errors that last are Gauss-Markov.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from stages.fuse import Fuse
from stages.geometry.frames import rotation_z
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import (
    BranchState,
    DroneAttitude,
    DroneFix,
    DroneLocalPosition,
    DroneOdometry,
    PoseEstimate,
    PoseState,
    PositionEstimate,
    RelativePose,
    RelativeRotation,
    ServoState,
    TrackingState,
    TrackState,
    VehicleMotion,
    VisualMotion,
)

S = 1_000_000_000
START_NS = 1_700_000_000 * S
FINE_S = 0.01


def gauss_markov(rng, sigma, time_s, step_s, count, width=3):
    """(count, width), stationary, one row each step."""
    rho = math.exp(-step_s / time_s) if time_s > 0 else 0.0
    white = rng.standard_normal((count, width)) * sigma
    out = np.empty((count, width))
    out[0] = white[0]
    for i in range(1, count):
        out[i] = rho * out[i - 1] + math.sqrt(1 - rho**2) * white[i]
    return out


@dataclass
class Made:
    """Path of the drone, and errors of each source."""

    until_s: float = 12.0
    seed: int = 0
    speed_mps: float = 3.0
    radius_m: float = 12.0  # of its circle; 0: it hovers
    straight: bool = False
    yaw0_deg: float = 130.0
    turn_dps: float = 10.0
    vehicle_mps: float = 0.0
    vehicle_dps: float = 0.0
    local_yaw_deg: float = -77.0  # of the world in the autopilot's frame
    # sources
    vehicle: bool = True
    autopilot: str = "odometry"  # "split": attitude and position; "attitude"; "none"
    rotations: bool = True
    images: bool = False
    tracks: bool = False
    clock_hz: float = 0.0  # servo states
    resolved_after_s: float = 1.0
    # errors
    fix_sigma_m: float = 0.06
    fix_time_s: float = 0.15
    fix_bias_share: float = 0.2
    bias_m: float = 0.0  # of all fixes of a flight, one sigma per axis, in addition
    bias_reported: bool = True  # whether a fix reports it
    reported_variance: float = 1.6  # of a fix, over the true one: trackers are conservative
    rotation_sigma_deg: float = 0.3
    rotation_time_s: float = 1.0
    drift_mps: float = 0.08
    drift_scale: float = 0.01
    # faults
    delays_s: dict[str, float] = field(default_factory=dict)  # beyond the usual, by port
    gaps_s: dict[str, tuple[float, float]] = field(default_factory=dict)  # by port
    outliers: dict[str, float] = field(default_factory=dict)  # share, by port
    quarters: tuple[tuple[float, int], ...] = ()  # from a time on, rotations are off by a multiple of 90 deg
    switches: bool = True  # and report it
    false_north: tuple[float, float] = (math.inf, 0.0)  # the autopilot's frame is turned [deg] from a time on

    def R_world_drone(self, t):
        tilt = exp_rotation(np.array([0.05 * math.sin(0.7 * t), 0.06 * math.cos(0.5 * t), 0.0]))
        return rotation_z(math.radians(self.yaw0_deg + self.turn_dps * t)) @ tilt

    def xyz_world_m(self, t):
        lifted = np.array([self.vehicle_mps * t, 0.0, 0.0])
        if self.straight:
            return lifted + np.array([self.speed_mps * (t - self.until_s / 2), 6.0, 15.0])
        if self.radius_m == 0:
            return lifted + np.array([3.0 + 0.1 * math.sin(t), 4.0, 15.0])
        a = self.speed_mps / self.radius_m * t
        r = self.radius_m
        return lifted + np.array([r * math.cos(a), r * math.sin(a), 15.0 + 0.5 * math.sin(0.4 * t)])

    def velocity_mps(self, t):
        return (self.xyz_world_m(t + 1e-4) - self.xyz_world_m(t - 1e-4)) / 2e-4

    def T_world_vehicle(self, t):
        return rotation_z(math.radians(self.vehicle_dps * t)), np.array([self.vehicle_mps * t, 0.0, 0.0])

    def truth(self, t):
        """R_vehicle_drone, xyz_vehicle."""
        R, x = self.T_world_vehicle(t)
        return R.T @ self.R_world_drone(t), R.T @ (self.xyz_world_m(t) - x)

    def events(self):
        """(arrival [ns], port, message) in order of arrival."""
        rng = np.random.default_rng([self.seed, 77])
        made = [*self._vehicle(), *self._autopilot(rng), *self._fixes(rng), *self._rotations(rng), *self._images(rng)]
        made += [
            (t, "servo", ServoState(stamp_ns=ns(t), position_rad=0.0, velocity_radps=0.0, goal_rad=0.0, error=0))
            for t in (np.arange(0, self.until_s, 1 / self.clock_hz) if self.clock_hz else ())
        ]
        out = []
        for arrival_s, port, message in made:
            gap = self.gaps_s.get(port, (math.inf, math.inf))
            if not gap[0] <= (message.stamp_ns - START_NS) / S < gap[1]:
                out.append((ns(arrival_s + self.delays_s.get(port, 0.0)), len(out), port, message))
        return [(at, port, message) for at, _, port, message in sorted(out, key=lambda e: e[:2])]

    def run(self, stage: Fuse) -> list[RelativePose]:
        poses: list[RelativePose] = []
        for _, port, message in self.events():
            poses += getattr(stage, f"on_{port}")(message)
        return poses

    def _vehicle(self):
        for t in np.arange(0, self.until_s, 0.02) if self.vehicle else ():
            R, x = self.T_world_vehicle(t)
            yield t + 0.005, "motion", VehicleMotion(stamp_ns=ns(t), xyz_map_m=x, R_map_vehicle=R, covariance=None)

    def _autopilot(self, rng):
        if self.autopilot == "none":
            return
        grid = np.arange(0, self.until_s + 0.1, FINE_S)
        drift = gauss_markov(rng, self.drift_mps, 10.0, FINE_S, len(grid))
        drift[:, 2] *= 0.4
        random_walk = 0.02 * math.sqrt(FINE_S) * rng.standard_normal((len(grid), 3)) / FINE_S
        velocity = np.array([self.velocity_mps(t) for t in grid])
        velocity = velocity * [1 + self.drift_scale, 1 + self.drift_scale, 1.0] + drift
        turned = np.cumsum(math.radians(0.05) * math.sqrt(FINE_S) * rng.standard_normal(len(grid)))
        turned += math.radians(1.0) / 60 * grid
        likelihood = gauss_markov(rng, math.radians(0.4), 20.0, FINE_S, len(grid), 2)
        R_yaw = [rotation_z(math.radians(self.local_yaw_deg) + a) for a in turned]
        way = np.cumsum([R @ (v + w) * FINE_S for R, v, w in zip(R_yaw, velocity, random_walk, strict=True)], axis=0)
        for i in range(0, len(grid) - 10, 3):
            t = float(grid[i])
            R_false = rotation_z(math.radians(self.false_north[1])) if t >= self.false_north[0] else np.eye(3)
            R = R_false @ R_yaw[i] @ exp_rotation(np.array([*likelihood[i], 0.0])) @ self.R_world_drone(t)
            rate = log_rotation(self.R_world_drone(t - 5e-4).T @ self.R_world_drone(t + 5e-4)) / 1e-3
            v, x = R_false @ R_yaw[i] @ velocity[i], R_false @ way[i]
            at = t + 0.015
            if self.autopilot == "odometry":
                yield (
                    at,
                    "odometry",
                    DroneOdometry(
                        stamp_ns=ns(t),
                        xyz_odom_m=x,
                        R_odom_drone=R,
                        velocity_drone_mps=R.T @ v,
                        angular_velocity_drone_radps=rate,
                        pose_covariance=None,
                        velocity_covariance=None,
                        reset_counter=0,
                        quality_percent=None,
                    ),
                )
                continue
            yield at, "attitude", DroneAttitude(stamp_ns=ns(t), R_odom_drone=R, angular_velocity_drone_radps=rate)
            if self.autopilot == "split":
                yield at, "position", DroneLocalPosition(stamp_ns=ns(t), xyz_odom_m=x, velocity_odom_mps=v)

    def _fixes(self, rng):
        times = np.arange(0.25, self.until_s, 0.1) + rng.uniform(-0.02, 0.02, len(np.arange(0.25, self.until_s, 0.1)))
        bias_covariance_m2 = math.sqrt(self.fix_bias_share) * self.fix_sigma_m * rng.standard_normal(3)
        bias = np.zeros(3) if self.bias_m == 0 else np.random.default_rng([self.seed, 78]).normal(0, self.bias_m, 3)
        e = gauss_markov(rng, math.sqrt(1 - self.fix_bias_share) * self.fix_sigma_m, self.fix_time_s, 0.1, len(times))
        for i, t in enumerate(times):
            R_world_vehicle, _ = self.T_world_vehicle(t)
            xyz = self.truth(t)[1] + e[i] + bias_covariance_m2 + bias
            if rng.random() < self.outliers.get("fix", 0.0):
                xyz = xyz + rng.normal(0, 4.0, 3)
            yield (
                t + 0.012,
                "fix",
                fix(
                    t,
                    xyz,
                    math.hypot(math.sqrt(self.reported_variance) * self.fix_sigma_m, self.bias_m),
                    bias_covariance_m2=self._lasting_m2(),
                    velocity=R_world_vehicle.T @ (self.velocity_mps(t) - [self.vehicle_mps, 0, 0])
                    + rng.normal(0, 0.3, 3),
                ),
            )
            if self.tracks:
                yield t + 0.012, "track", track(t, TrackingState.TRACKING)

    def _lasting_m2(self):
        if self.bias_m == 0 or not self.bias_reported:
            return None
        own = self.fix_bias_share * self.fix_sigma_m**2
        return (own + self.bias_m**2) * np.eye(3)

    def _rotations(self, rng):
        times = np.arange(0.3, self.until_s, 0.2) if self.rotations else np.array([])
        sigma = math.radians(self.rotation_sigma_deg)
        e = gauss_markov(rng, sigma, self.rotation_time_s, 0.2, max(len(times), 1))
        switches, before = 0, 0
        for i, t in enumerate(times):
            off = next((q for since, q in reversed(self.quarters) if t >= since), 0)
            switches += off != before and self.switches
            before = off
            R = rotation_z(off * math.pi / 2) @ self.truth(t)[0] @ exp_rotation(e[i])
            if rng.random() < self.outliers.get("rotation", 0.0):
                R = R @ exp_rotation(rng.normal(0, 0.4, 3))
            yield t + 0.08, "rotation", rotation(t, R, sigma, t >= self.resolved_after_s, switches)

    def _images(self, rng):
        for t in np.arange(0.1, self.until_s, 1 / 15) if self.images else ():
            a, b = self.R_world_drone(t - 1 / 15), self.R_world_drone(t)
            way = a.T @ (self.xyz_world_m(t) - self.xyz_world_m(t - 1 / 15))
            far = float(np.linalg.norm(way)) > 0.05
            yield (
                t + 0.04,
                "visual_motion",
                VisualMotion(
                    stamp_ns=ns(t),
                    from_ns=ns(t - 1 / 15),
                    R_from_to=a.T @ b @ exp_rotation(rng.normal(0, 4e-4, 3)),
                    covariance_rad2=(4e-4) ** 2 * np.eye(3),
                    direction_from=way / np.linalg.norm(way) if far else None,
                    direction_sigma_rad=0.05 if far else None,
                    matches=80,
                    reason="",
                ),
            )

    def judge(self, poses: list[RelativePose], after_s: float = 0.0) -> PoseErrors:
        """Errors of the poses after a time."""
        out = PoseErrors()
        for pose in poses:
            t = (pose.stamp_ns - START_NS) / S
            if t < after_s:
                continue
            out.states[pose.state] += 1
            if pose.estimate is None:
                continue
            R, xyz = self.truth(t)
            out.at_s.append(t)
            out.sigma_m.append(math.sqrt(float(np.trace(position_covariance_m2(pose.estimate))) / 3))
            add_errors(out, pose, R, xyz)
        return out


@dataclass
class Errors:
    """Errors of each pose with a position; the angle and `nees6` of those with a rotation."""

    error_m: list[float] = field(default_factory=list)
    angle_deg: list[float] = field(default_factory=list)
    nees3: list[float] = field(default_factory=list)
    nees6: list[float] = field(default_factory=list)


def position_covariance_m2(estimate: PositionEstimate | PoseEstimate) -> np.ndarray:
    """(3, 3) of the drone's position: in drone axes where its rotation is known, else in vehicle axes."""
    return estimate.covariance[3:, 3:] if isinstance(estimate, PoseEstimate) else estimate.covariance_vehicle_m2


def add_errors(errors: Errors, pose: RelativePose, R: np.ndarray, xyz_m: np.ndarray) -> None:
    """Add the error of a pose with a position, and its NEES; its axes are the drone's where the rotation is known."""
    estimate = pose.estimate
    e = estimate.xyz_vehicle_m - xyz_m
    errors.error_m.append(float(np.linalg.norm(e)))
    if isinstance(estimate, PositionEstimate):
        errors.nees3.append(float(e @ np.linalg.solve(estimate.covariance_vehicle_m2, e)))
        return
    P = estimate.covariance
    off = np.concatenate([log_rotation(pose.R_vehicle_drone.T @ R), -pose.R_vehicle_drone.T @ e])
    errors.nees3.append(float(off[3:] @ np.linalg.solve(P[3:, 3:], off[3:])))
    errors.nees6.append(float(off @ np.linalg.solve(P, off)))
    errors.angle_deg.append(math.degrees(float(np.linalg.norm(off[:3]))))


@dataclass
class PoseErrors(Errors):
    """Errors of each pose."""

    states: Counter[PoseState] = field(default_factory=Counter)
    at_s: list[float] = field(default_factory=list)
    sigma_m: list[float] = field(default_factory=list)

    def rmse_m(self) -> float:
        return rms(self.error_m)


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def ns(t) -> int:
    return START_NS + round(float(t) * S)


def fix(t, xyz, sigma=0.06, track_id=1, velocity=None, bias_covariance_m2=None) -> DroneFix:
    return DroneFix(
        stamp_ns=ns(t),
        xyz_vehicle_m=np.asarray(xyz, dtype=float),
        covariance_m2=sigma**2 * np.eye(3),
        hits=4,
        track_id=track_id,
        velocity_vehicle_mps=velocity,
        bias_covariance_m2=bias_covariance_m2,
    )


def track(t, state, track_id=1) -> TrackState:
    return TrackState(stamp_ns=ns(t), state=state, reason="made", hits=4, frame_s=0.1, track_id=track_id)


def rotation(t, R, sigma_rad=0.005, resolved=True, switches=0) -> RelativeRotation:
    return RelativeRotation(
        stamp_ns=ns(t),
        R_vehicle_drone=R,
        covariance_rad2=sigma_rad**2 * np.eye(3),
        branch_probability=np.array([0.9997, 1e-4, 1e-4, 1e-4]) if resolved else np.full(4, 0.24),
        state=BranchState.RESOLVED if resolved else BranchState.AMBIGUOUS,
        switches=switches,
        reason="made",
    )
