"""Errors of the published poses of a flight with an IMU, and tables of many flights."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

import numpy as np

from stages.fuse import Fuse
from stages.kernels.geometry.so3 import log_rotation
from stages.messages import CueFactor, HeadingEstimate, PoseEstimate, RelativePose
from tests.stages.fuse.fuse_inputs import Fault
from tests.stages.fuse.imu_flights import ImuFlight, seconds

MAP, VEHICLE = "map", "vehicle"  # frames of the errors
CHI2_95 = 7.815  # 3 degrees of freedom
DECIDED_WRONG_DEG = 20.0
HEADER = (
    "variant    flight    | decided after [s]: median, worst | wrong | position 95 % [m] | in 95 % ellipsoid | "
    "yaw RMS, worst [deg] | yaw NEES | in 95 % of rotation | CPU [ms/s]"
)


@dataclass
class Flown:
    """Published poses of one flight against the truth: one row a pose."""

    at_s: list[float] = field(default_factory=list)
    full: list[bool] = field(default_factory=list)
    error_m: list[float] = field(default_factory=list)
    sigma_m: list[float] = field(default_factory=list)
    nees_position: list[float] = field(default_factory=list)
    yaw_deg: list[float] = field(default_factory=list)  # of poses with a rotation
    yaw_sigma_deg: list[float] = field(default_factory=list)
    nees_rotation: list[float] = field(default_factory=list)
    decided_s: float = math.inf  # after the first LiDAR position
    wrong: int = 0  # decided headings more than 20 deg off
    cpu_ms: float = 0.0  # per second of flight
    poses: list[RelativePose] = field(default_factory=list)
    headings: list[HeadingEstimate] = field(default_factory=list)
    cues: list[CueFactor] = field(default_factory=list)


def fly(flight: ImuFlight, stage: Fuse | None = None, fault: Fault = list, frame: str = MAP) -> Flown:
    """Run a flight through the stage, its inputs with a fault; errors are in a frame."""
    stage, out = stage or Fuse(), Flown()
    events = fault(flight.events())
    began = time.thread_time()
    for _, port, message in events:
        for made in getattr(stage, f"on_{port}")(message):
            into = out.headings if isinstance(made, HeadingEstimate) else out.poses
            (out.cues if isinstance(made, CueFactor) else into).append(made)
    out.cpu_ms = 1e3 * (time.thread_time() - began) / flight.until_s
    for heading in out.headings:
        _add_heading(out, flight, heading, frame)
    for pose in out.poses:
        if 0.0 <= seconds(pose.stamp_ns) < flight.until_s and pose.estimate is not None:
            _add_pose(out, flight, pose, frame)
    return out


def _add_heading(out: Flown, flight: ImuFlight, heading: HeadingEstimate, frame: str) -> None:
    t = seconds(heading.stamp_ns)
    if not heading.decided or t >= flight.until_s:
        return
    out.decided_s = min(out.decided_s, t - flight.first_fix_s)
    R, yaw_rad = flight.truth(t)[0], heading.yaw_map_rad[0]
    if frame == VEHICLE:
        R, yaw_rad = flight.vehicle(t)[0].T @ R, yaw_rad - heading.vehicle_yaw_rad
    yaw = math.atan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])
    out.wrong += abs(math.degrees(math.remainder(yaw_rad - yaw, 2 * math.pi))) > DECIDED_WRONG_DEG


def _add_pose(out: Flown, flight: ImuFlight, pose: RelativePose, frame: str) -> None:
    t, estimate = seconds(pose.stamp_ns), pose.estimate
    R, xyz_m, _ = flight.truth(t)
    own_m, full = estimate.xyz_map_m, isinstance(estimate, PoseEstimate)
    if frame == VEHICLE:
        R_map_vehicle, t_map_vehicle = flight.vehicle(t)
        R, xyz_m, own_m = R_map_vehicle.T @ R, R_map_vehicle.T @ (xyz_m - t_map_vehicle), estimate.xyz_vehicle_m
    off = own_m - xyz_m
    if full:
        R_own = estimate.R_vehicle_drone if frame == VEHICLE else estimate.R_map_drone
        P = estimate.covariance if frame == VEHICLE else estimate.map_covariance
        position_m2 = R_own @ P[3:, 3:] @ R_own.T
        turn = log_rotation(R_own.T @ R)
        out.yaw_deg.append(math.degrees(float(R_own[2] @ turn)))
        out.yaw_sigma_deg.append(math.degrees(math.sqrt(float(R_own[2] @ P[:3, :3] @ R_own[2]))))
        out.nees_rotation.append(float(turn @ np.linalg.solve(P[:3, :3], turn)))
    else:
        position_m2 = estimate.covariance_vehicle_m2 if frame == VEHICLE else estimate.covariance_map_m2
    out.at_s.append(t)
    out.full.append(full)
    out.error_m.append(float(np.linalg.norm(off)))
    out.sigma_m.append(math.sqrt(float(np.trace(position_m2)) / 3))
    out.nees_position.append(float(off @ np.linalg.solve(position_m2, off)))


def row(name: str, kind: str, flown: list[Flown]) -> str:
    """One line of the table."""
    decided = np.array([f.decided_s for f in flown])
    yaw, sigma = (np.concatenate([getattr(f, part) for f in flown]) for part in ("yaw_deg", "yaw_sigma_deg"))
    error, nees, rotation = (
        np.concatenate([getattr(f, part) for f in flown]) for part in ("error_m", "nees_position", "nees_rotation")
    )
    turned = (
        f"{rms(yaw):5.2f} {np.abs(yaw).max():5.1f} | {np.mean((yaw / sigma) ** 2):5.2f} | "
        f"{100 * np.mean(rotation < CHI2_95):4.0f} %"
        if len(yaw)
        else "    -     - |     - |    - "
    )
    return (
        f"{name:10s} {kind:9s} | {np.median(decided):5.1f} {decided.max():5.1f} | {sum(f.wrong > 0 for f in flown):2d} "
        f"of {len(flown)} | {np.percentile(error, 95):.2f} | {100 * np.mean(nees < CHI2_95):3.0f} % | {turned} | "
        f"{np.mean([f.cpu_ms for f in flown]):3.0f}"
    )


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
