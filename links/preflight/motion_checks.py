"""Consistency of the axes of the autopilot's messages with each other, and of its path with the LiDAR's fixes.

These checks use whatever motion there was, and report axes without motion as not checked.

    gravity    RAW_IMU's acceleration at rest       against the attitude's vertical
    turning    angular velocities                   against changes of the attitude
    heading    ODOMETRY's rotation                  against ATTITUDE's
    velocity   ODOMETRY's velocity, rotated         against changes of its position
    path       LiDAR fixes                          against the autopilot's position, up to translation and yaw
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from flow.message import Message
from links.preflight.axes import Agreement, compare, compare_paths
from links.preflight.check_result import CheckResult, fail, ok, warning
from links.preflight.observations import Observations
from stages.geometry.frames import Array64
from stages.messages import (
    DroneAttitude,
    DroneFix,
    DroneImu,
    DroneLocalPosition,
    DroneOdometry,
    VehicleMotion,
)

G_MPS2 = 9.80665
PAIR_NS = 60_000_000  # maximum time difference of two messages that are compared
STEP_NS = 200_000_000  # interval of changes
MIN_TILT = 0.15  # rms of a component of the vertical: 9 deg
MIN_RADPS = 0.1
MIN_MPS = 0.15
MIN_PATH_M = 0.25  # rms
REST_MPS2, MAX_TILT_RAD = 1.5, np.radians(15.0)
MAX_ROTATION_RAD = np.radians(5.0)
MIN_SAMPLES = 5

M = TypeVar("M", bound=Message)
N = TypeVar("N", bound=Message)
Rotated = DroneAttitude | DroneOdometry


def motion_checks(observations: Observations) -> Iterator[CheckResult]:
    """Results of all comparisons; those without enough motion are warnings."""
    attitudes, odometry = observations.all(DroneAttitude), observations.all(DroneOdometry)
    imu, positions = observations.all(DroneImu), observations.all(DroneLocalPosition)
    rotations: Sequence[Rotated] = attitudes or odometry
    yield gravity_check(rotations, imu)
    yield turning_check("attitude's angular velocity", rotations, rotations)
    if imu:
        yield turning_check("gyro", rotations, imu)
    if odometry:
        yield heading_check(attitudes, odometry)
        yield velocity_check(odometry)
    path = positions or odometry
    yield path_check(observations.all(DroneFix), observations.all(VehicleMotion), path)


def gravity_check(rotations: Sequence[Rotated], imu: Sequence[DroneImu]) -> CheckResult:
    """At rest an accelerometer measures the vertical, upwards: f = R_odom_drone^T (0, 0, g)."""
    name = "axes: accelerometer"
    at_rest = [m for m in imu if abs(float(np.linalg.norm(m.acceleration_drone_mps2)) - G_MPS2) < REST_MPS2]
    expected_list, measured_list = [], []
    for sample, pose in _pairs(at_rest, rotations):
        expected_list.append(pose.R_odom_drone[2])
        measured_list.append(sample.acceleration_drone_mps2 / np.linalg.norm(sample.acceleration_drone_mps2))
    if len(expected_list) < MIN_SAMPLES:
        return warning(name, "no attitude with an acceleration at rest: not checked (request RAW_IMU)")
    expected, measured = np.array(expected_list), np.array(measured_list)
    error_rad = float(np.median(np.arccos(np.clip(np.sum(expected * measured, axis=1), -1.0, 1.0))))
    agreement = compare(expected, measured, MIN_TILT)
    if agreement.wrong or error_rad > MAX_TILT_RAD:
        return fail(
            name,
            f"its vertical differs by {np.degrees(error_rad):.0f} deg from the attitude's"
            f"{_permutation(agreement)}: check AHRS_ORIENTATION (PX4: SENS_BOARD_ROT) and calibrate the level",
        )
    return ok(name, f"agrees with the attitude to {np.degrees(error_rad):.1f} deg{_along(agreement.compared)}")


def turning_check(what: str, rotations: Sequence[Rotated], rates: Sequence[DroneImu | Rotated]) -> CheckResult:
    """Angular velocities [rad/s], averaged over a step, against log(R_before^T R_after) / time, drone axes."""
    name = f"axes: {what}"
    steps = _steps(rotations)
    stamps = _stamps(rates)
    changes, measured = [], []
    for before, after in steps:
        first, end = np.searchsorted(stamps, [before.stamp_ns, after.stamp_ns + 1])
        between = rates[int(first) : int(end)]
        if between:
            passed_s = 1e-9 * (after.stamp_ns - before.stamp_ns)
            changes.append(_log(before.R_odom_drone.T @ after.R_odom_drone) / passed_s)
            measured.append(np.mean([m.angular_velocity_drone_radps for m in between], axis=0))
    if len(changes) < MIN_SAMPLES:
        return warning(name, "too few messages to compare: not checked")
    return _agreement_result(
        name, compare(np.array(changes), np.array(measured), MIN_RADPS), "the attitude's changes", "rotation"
    )


def heading_check(attitudes: Sequence[DroneAttitude], odometry: Sequence[DroneOdometry]) -> CheckResult:
    """ODOMETRY's rotation against ATTITUDE's."""
    name = "axes: odometry's rotation"
    errors = [
        float(np.linalg.norm(_log(pose.R_odom_drone.T @ attitude.R_odom_drone)))
        for pose, attitude in _pairs(odometry, attitudes)
    ]
    if len(errors) < MIN_SAMPLES:
        return warning(name, "no ATTITUDE at the same time: not checked")
    error_deg = float(np.degrees(np.median(errors)))
    if error_deg > np.degrees(MAX_ROTATION_RAD):
        return fail(name, f"{error_deg:.0f} deg from ATTITUDE's: does its ODOMETRY come from another source?")
    return ok(name, f"agrees with ATTITUDE to {error_deg:.1f} deg")


def velocity_check(odometry: Sequence[DroneOdometry]) -> CheckResult:
    """R_odom_drone v_drone against the change of position, odom axes."""
    name = "axes: odometry's velocity"
    changes, velocities = [], []
    for before, after in _steps(odometry):
        if before.reset_counter == after.reset_counter:
            changes.append((after.xyz_odom_m - before.xyz_odom_m) * 1e9 / (after.stamp_ns - before.stamp_ns))
            ends = [m.R_odom_drone @ m.velocity_drone_mps for m in (before, after)]
            velocities.append(np.mean(ends, axis=0))
    if len(changes) < MIN_SAMPLES:
        return warning(name, "too few messages to compare: not checked")
    return _agreement_result(
        name, compare(np.array(changes), np.array(velocities), MIN_MPS), "the position's changes", "motion"
    )


def path_check(
    fixes: Sequence[DroneFix], motions: Sequence[VehicleMotion], positions: Sequence[DroneLocalPosition | DroneOdometry]
) -> CheckResult:
    """LiDAR fixes in the map frame against the autopilot's positions."""
    name = "axes: LiDAR and autopilot"
    measured, reported = [], []
    for fix, position in _pairs(fixes, positions):
        in_map = _in_map(fix, motions)
        if in_map is not None:
            measured.append(in_map)
            reported.append(position.xyz_odom_m)
    if len(measured) < MIN_SAMPLES:
        missing = f"{len(fixes)} LiDAR fixes, {len(measured)} with a position of the autopilot at the same time"
        return warning(name, f"{missing}: not checked; move the drone in view of the LiDAR")
    agreement = compare_paths(np.array(measured), np.array(reported), MIN_PATH_M)
    if agreement.wrong and agreement.permutation is None:
        return fail(
            name,
            f"the paths fit no permutation of axes (along {', '.join(agreement.wrong)}): was it this drone, "
            "and was the vehicle parked, or its odometry received? Else skip it with --no-motion",
        )
    return _agreement_result(name, agreement, "the autopilot's path", "curved motion")


def _agreement_result(name: str, agreement: Agreement, other: str, motion: str) -> CheckResult:
    if agreement.wrong:
        return fail(name, f"disagrees with {other} along {', '.join(agreement.wrong)}{_permutation(agreement)}")
    if not agreement.compared:
        return warning(name, f"not enough {motion}: not checked")
    return ok(name, f"agrees with {other}{_along(agreement.compared)}")


def _permutation(agreement: Agreement) -> str:
    return f"; {agreement.permutation}" if agreement.permutation else ""


def _along(compared: str) -> str:
    missing = [axis for axis in "xyz" if axis not in compared]
    if not compared:
        return ", always level"
    return f" along {', '.join(compared)}" + (f"; {', '.join(missing)} without enough motion" if missing else "")


def _in_map(fix: DroneFix, motions: Sequence[VehicleMotion]) -> Array64 | None:
    """p_map = R_map_vehicle p_vehicle + t; without odometry the vehicle is assumed parked."""
    if not motions:
        return fix.xyz_vehicle_m
    near = next((pose for _, pose in _pairs([fix], motions)), None)
    return None if near is None else near.R_map_vehicle @ fix.xyz_vehicle_m + near.xyz_map_m


def _stamps(messages: Sequence[Message]) -> NDArray[np.int64]:
    return np.array([m.stamp_ns for m in messages], dtype=np.int64)


def _pairs(some: Sequence[M], others: Sequence[N]) -> Iterator[tuple[M, N]]:
    """Each message of `some` with the nearest in time of `others`, if it is within PAIR_NS."""
    stamps = _stamps(others)
    for message in some:
        if not len(stamps):
            return
        after = int(np.searchsorted(stamps, message.stamp_ns))
        near = min(
            (i for i in (after - 1, after) if 0 <= i < len(stamps)), key=lambda i: abs(stamps[i] - message.stamp_ns)
        )
        if abs(int(stamps[near]) - message.stamp_ns) <= PAIR_NS:
            yield message, others[near]


def _steps(messages: Sequence[M]) -> Iterator[tuple[M, M]]:
    """Consecutive pairs of messages about STEP_NS apart."""
    before: M | None = None
    for message in messages:
        if before is None or message.stamp_ns - before.stamp_ns > 2 * STEP_NS:
            before = message
        elif message.stamp_ns - before.stamp_ns >= STEP_NS:
            yield before, message
            before = message


def _log(rotation: Array64) -> Array64:
    """Rotation vector [rad]."""
    return np.asarray(cv2.Rodrigues(rotation)[0], dtype=np.float64).ravel()
