"""Errors of the poses that were sent to the autopilot, and whether the covariances in the messages hold.

Errors of a sent pose are those of ODOMETRY against T_map_vehicle T_vehicle_drone at its time: the first by the
vehicle's odometry, whose drift the autopilot's frame shares, the second true. Without odometry both are true. They are
compared in the frame that grd states for what it sends. For statistics only.

Source: ours; 95 % quantiles of chi-squared with 3 and 1 degrees of freedom.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flow.link import Record
from links.mavlink.ned_frd import R_odom_drone_from_wxyz, flip_yz
from links.mavlink.poses.sent_frame import SentFrame
from links.mavlink.transport.framing import parse_frame
from links.simulated.sensors.vehicle_odometry import VehicleOdometry
from links.simulated.world.scene import Truth
from stages.geometry.frames import Array64

WRONG_M, WRONG_DEG = 1.0, 10.0  # a sent pose with a larger error is wrong
NO_YAW_RAD2 = 9.0  # a larger yaw variance: the message holds no yaw
CHI2_95_POSITION, CHI2_95_YAW = 7.815, 3.841
YAW_VARIANCE = 20  # index in MAVLink's pose_covariance, whose rows are x, y, z, roll, pitch, yaw


@dataclass(frozen=True, slots=True)
class SentErrors:
    """Errors of n poses, m of them with yaw."""

    position_m: Array64  # (n,), in map
    yaw_deg: Array64  # (m,), absolute
    wrong: NDArray[np.bool_]  # (n,)
    inside: NDArray[np.bool_]  # (n,) the position is inside the 95 % ellipsoid of the message
    yaw_inside: NDArray[np.bool_]  # (m,)


@dataclass(frozen=True, slots=True)
class _SentPose:
    stamp_ns: int
    sent_ns: int
    xyz_m: Array64  # z up
    yaw_rad: float  # NaN: without yaw
    frame: SentFrame  # of xyz_m and yaw_rad
    covariance_m2: Array64  # (3, 3), axes of xyz_m
    yaw_variance: float


class SentPoses:
    """Call `add` for each frame to the autopilot."""

    def __init__(self, truth: Truth, odometry: VehicleOdometry | None) -> None:
        self._truth, self._odometry = truth, odometry
        self._poses: list[_SentPose] = []

    def __len__(self) -> int:
        return len(self._poses)

    def add(self, record: Record, frame: SentFrame | None) -> None:
        """A frame to the autopilot. `frame`: that of a pose."""
        message: Any = parse_frame(record.data)
        if message.get_type() != "ODOMETRY":
            return
        assert frame is not None
        upper = np.array(message.pose_covariance)
        has_yaw = all(map(math.isfinite, message.q)) and not upper[YAW_VARIANCE] > NO_YAW_RAD2
        R = R_odom_drone_from_wxyz(message.q) if has_yaw else np.full((3, 3), np.nan)
        covariance = np.zeros((6, 6))
        covariance[np.triu_indices(6)] = upper
        flip = np.array([1.0, -1.0, -1.0])
        position = (covariance + np.triu(covariance, 1).T)[:3, :3] * np.outer(flip, flip)
        self._poses.append(
            _SentPose(
                stamp_ns=int(message.time_usec) * 1000,
                sent_ns=record.arrival_ns,
                xyz_m=flip_yz(np.array([message.x, message.y, message.z])),
                yaw_rad=math.atan2(R[1, 0], R[0, 0]),
                frame=frame,
                covariance_m2=position,
                yaw_variance=float(upper[YAW_VARIANCE]),
            )
        )

    def longest_gap_s(self, until_ns: int) -> float | None:
        """The longest time without a pose, from the first one on; None: none was sent."""
        sent = [pose.sent_ns for pose in self._poses]
        return round(float(np.diff([*sent, max(until_ns, sent[-1])]).max()) * 1e-9, 2) if sent else None

    def errors(self, latest_ns: int) -> SentErrors:
        """Errors of the poses until latest_ns; after that the truth is not known."""
        poses = [pose for pose in self._poses if pose.stamp_ns <= latest_ns]
        if not poses:
            return SentErrors(np.empty(0), np.empty(0), *[np.empty(0, dtype=bool)] * 3)
        stamps = np.array([pose.stamp_ns for pose in poses], dtype=np.int64)
        R_vehicle, t_vehicle = self._truth.T_world_vehicle(stamps)
        R_drone, t_drone = self._truth.T_world_drone(stamps)
        relative_m = np.einsum("nji,nj->ni", R_vehicle, t_drone - t_vehicle)
        R_map, t_map = self._map_vehicle(stamps)
        expected_m = t_map + np.einsum("nij,nj->ni", R_map, relative_m)
        R_expected = R_map @ np.swapaxes(R_vehicle, 1, 2) @ R_drone
        axes_yaw = np.array([pose.frame.yaw_rad for pose in poses])
        yaw = np.arctan2(R_expected[:, 1, 0], R_expected[:, 0, 0]) - axes_yaw
        sent_yaw = np.array([pose.yaw_rad for pose in poses])
        without = np.isnan(sent_yaw)
        expected_m = np.array([pose.frame.position(xyz_m) for pose, xyz_m in zip(poses, expected_m, strict=True)])
        error_m = np.array([pose.xyz_m for pose in poses]) - expected_m
        covariances = np.array([pose.covariance_m2 for pose in poses])
        distance2 = np.einsum("ni,ni->n", error_m, np.linalg.solve(covariances, error_m[:, :, None])[:, :, 0])
        error_deg = np.degrees(sent_yaw[~without] - yaw[~without])
        yaw_deg = np.abs((error_deg + 180) % 360 - 180)
        sigma_deg = np.degrees(np.sqrt([pose.yaw_variance for pose in poses]))[~without]
        position_m = np.linalg.norm(error_m, axis=1)
        wrong = position_m > WRONG_M
        wrong[~without] |= yaw_deg > WRONG_DEG
        return SentErrors(
            position_m, yaw_deg, wrong, distance2 <= CHI2_95_POSITION, (yaw_deg / sigma_deg) ** 2 <= CHI2_95_YAW
        )

    def _map_vehicle(self, stamps: NDArray[np.int64]) -> tuple[Array64, Array64]:
        """T_map_vehicle at times (n,) by the vehicle's odometry; without it, the true one."""
        if self._odometry is not None:
            return self._odometry.T_map_vehicle(stamps)
        R0, t0 = (part[0] for part in self._truth.T_world_vehicle(np.array([self._truth.start_ns])))
        R, t = self._truth.T_world_vehicle(stamps)
        return R0.T @ R, (t - t0) @ R0
