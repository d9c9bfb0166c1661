"""Do the autopilot's messages agree in their axes with each other, and its path with what the LiDAR saw?

Nothing is asked of a person here: whatever motion there was is compared, and what there was none of is said.

    gravity    RAW_IMU's acceleration at rest       against the attitude's vertical
    turning    the turn rates that are told         against how the attitude changes
    heading    ODOMETRY's rotation                  against ATTITUDE's
    velocity   ODOMETRY's velocity, turned          against how its position changes
    path       LiDAR fixes                          against the autopilot's position, up to place and yaw

Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from flow.message import Message
from links.preflight.axes import Agreement, compare, compare_paths
from links.preflight.heard import AllHeard
from links.preflight.verdict import Verdict, fail, ok, warning
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
NEAR_NS = 60_000_000  # two messages of one moment
STEP_NS = 200_000_000  # over which a change is looked at
LEAST_TILT = 0.15  # rms of a component of the vertical: 9 deg
LEAST_RADPS = 0.1
LEAST_MPS = 0.15
LEAST_PATH_M = 0.25  # rms
REST_MPS2, MOST_TILT_RAD = 1.5, np.radians(15.0)
MOST_TURNED_RAD = np.radians(5.0)
FEWEST = 5

M = TypeVar("M", bound=Message)
N = TypeVar("N", bound=Message)
Rotated = DroneAttitude | DroneOdometry


def motion_checks(heard: AllHeard) -> Iterator[Verdict]:
    """All comparisons; each says where there was too little to tell."""
    attitudes, odometry = heard.all(DroneAttitude), heard.all(DroneOdometry)
    imu, positions = heard.all(DroneImu), heard.all(DroneLocalPosition)
    rotated: Sequence[Rotated] = attitudes or odometry
    yield gravity_check(rotated, imu)
    yield turning_check("attitude's turn rates", rotated, rotated)
    if imu:
        yield turning_check("gyro", rotated, imu)
    if odometry:
        yield heading_check(attitudes, odometry)
        yield velocity_check(odometry)
    path = positions or odometry
    yield path_check(heard.all(DroneFix), heard.all(VehicleMotion), path)


def gravity_check(rotated: Sequence[Rotated], imu: Sequence[DroneImu]) -> Verdict:
    """At rest an accelerometer measures the vertical, upwards: f = R_odom_drone^T (0, 0, g)."""
    name = "axes: accelerometer"
    at_rest = [m for m in imu if abs(float(np.linalg.norm(m.acceleration_drone_mps2)) - G_MPS2) < REST_MPS2]
    told, measured = [], []
    for sample, pose in _pairs(at_rest, rotated):
        told.append(pose.R_odom_drone[2])
        measured.append(sample.acceleration_drone_mps2 / np.linalg.norm(sample.acceleration_drone_mps2))
    if len(told) < FEWEST:
        return warning(name, "no attitude with an acceleration at rest beside it: not checked (ask for RAW_IMU)")
    expected, found = np.array(told), np.array(measured)
    off_rad = float(np.median(np.arccos(np.clip(np.sum(expected * found, axis=1), -1.0, 1.0))))
    agreed = compare(expected, found, LEAST_TILT)
    if agreed.wrong or off_rad > MOST_TILT_RAD:
        return fail(
            name,
            f"it says up is {np.degrees(off_rad):.0f} deg from where the attitude has it"
            f"{_told(agreed)}: check AHRS_ORIENTATION (PX4: SENS_BOARD_ROT) and calibrate the level",
        )
    return ok(name, f"agrees with the attitude to {np.degrees(off_rad):.1f} deg{_along(agreed.seen)}")


def turning_check(what: str, rotated: Sequence[Rotated], rates: Sequence[DroneImu | Rotated]) -> Verdict:
    """Turn rates [rad/s], averaged over a step, against log(R_before^T R_after) / time, drone axes."""
    name = f"axes: {what}"
    steps = _steps(rotated)
    stamps = _stamps(rates)
    changed, told = [], []
    for before, after in steps:
        first, end = np.searchsorted(stamps, [before.stamp_ns, after.stamp_ns + 1])
        between = rates[int(first) : int(end)]
        if between:
            passed_s = 1e-9 * (after.stamp_ns - before.stamp_ns)
            changed.append(_log(before.R_odom_drone.T @ after.R_odom_drone) / passed_s)
            told.append(np.mean([m.angular_velocity_drone_radps for m in between], axis=0))
    if len(changed) < FEWEST:
        return warning(name, "too few to compare: not checked")
    return _judged(name, compare(np.array(changed), np.array(told), LEAST_RADPS), "how the attitude changes", "turned")


def heading_check(attitudes: Sequence[DroneAttitude], odometry: Sequence[DroneOdometry]) -> Verdict:
    """ODOMETRY and ATTITUDE tell one rotation."""
    name = "axes: odometry's rotation"
    off = [
        float(np.linalg.norm(_log(pose.R_odom_drone.T @ attitude.R_odom_drone)))
        for pose, attitude in _pairs(odometry, attitudes)
    ]
    if len(off) < FEWEST:
        return warning(name, "no ATTITUDE beside it: not checked")
    off_deg = float(np.degrees(np.median(off)))
    if off_deg > np.degrees(MOST_TURNED_RAD):
        return fail(name, f"{off_deg:.0f} deg from ATTITUDE's: is its ODOMETRY another source's, passed through?")
    return ok(name, f"agrees with ATTITUDE to {off_deg:.1f} deg")


def velocity_check(odometry: Sequence[DroneOdometry]) -> Verdict:
    """R_odom_drone v_drone against the change of position, local axes."""
    name = "axes: odometry's velocity"
    changed, told = [], []
    for before, after in _steps(odometry):
        if before.reset_counter == after.reset_counter:
            changed.append((after.xyz_odom_m - before.xyz_odom_m) * 1e9 / (after.stamp_ns - before.stamp_ns))
            ends = [m.R_odom_drone @ m.velocity_drone_mps for m in (before, after)]
            told.append(np.mean(ends, axis=0))
    if len(changed) < FEWEST:
        return warning(name, "too few to compare: not checked")
    return _judged(name, compare(np.array(changed), np.array(told), LEAST_MPS), "how its position changes", "moved")


def path_check(
    fixes: Sequence[DroneFix], motions: Sequence[VehicleMotion], positions: Sequence[DroneLocalPosition | DroneOdometry]
) -> Verdict:
    """Where the LiDAR saw the drone, in the vehicle's start frame, against the autopilot's own positions."""
    name = "axes: LiDAR and autopilot"
    seen, told = [], []
    for fix, position in _pairs(fixes, positions):
        at_start = _in_start_frame(fix, motions)
        if at_start is not None:
            seen.append(at_start)
            told.append(position.xyz_odom_m)
    if len(seen) < FEWEST:
        missing = f"the LiDAR saw the drone {len(fixes)} times, {len(seen)} with a position of the autopilot beside it"
        return warning(name, f"{missing}: not checked; carry the drone about where the LiDAR sees it")
    agreed = compare_paths(np.array(seen), np.array(told), LEAST_PATH_M)
    if agreed.wrong and agreed.exchange is None:
        return fail(
            name,
            f"the paths do not fit under any exchange of axes (along {', '.join(agreed.wrong)}): was it this drone, "
            "and did the vehicle stand still, or tell its odometry? Else leave this out with --no-motion",
        )
    return _judged(name, agreed, "the autopilot's path", "carried along a curve")


def _judged(name: str, agreed: Agreement, other: str, done: str) -> Verdict:
    if agreed.wrong:
        return fail(name, f"does not agree with {other} along {', '.join(agreed.wrong)}{_told(agreed)}")
    if not agreed.seen:
        return warning(name, f"not {done} enough to tell: not checked")
    return ok(name, f"agrees with {other}{_along(agreed.seen)}")


def _told(agreed: Agreement) -> str:
    return f"; {agreed.exchange}" if agreed.exchange else ""


def _along(seen: str) -> str:
    missing = [axis for axis in "xyz" if axis not in seen]
    if not seen:
        return ", level all the time"
    return f" along {', '.join(seen)}" + (f"; {', '.join(missing)} not moved enough to tell" if missing else "")


def _in_start_frame(fix: DroneFix, motions: Sequence[VehicleMotion]) -> Array64 | None:
    """p_start = R_map_vehicle p_vehicle + t; without odometry the vehicle is taken to be parked."""
    if not motions:
        return fix.xyz_vehicle_m
    near = next((pose for _, pose in _pairs([fix], motions)), None)
    return None if near is None else near.R_map_vehicle @ fix.xyz_vehicle_m + near.xyz_map_m


def _stamps(messages: Sequence[Message]) -> NDArray[np.int64]:
    return np.array([m.stamp_ns for m in messages], dtype=np.int64)


def _pairs(some: Sequence[M], others: Sequence[N]) -> Iterator[tuple[M, N]]:
    """Each of `some` with the nearest in time of `others`, where one is near."""
    stamps = _stamps(others)
    for message in some:
        if not len(stamps):
            return
        after = int(np.searchsorted(stamps, message.stamp_ns))
        near = min(
            (i for i in (after - 1, after) if 0 <= i < len(stamps)), key=lambda i: abs(stamps[i] - message.stamp_ns)
        )
        if abs(int(stamps[near]) - message.stamp_ns) <= NEAR_NS:
            yield message, others[near]


def _steps(messages: Sequence[M]) -> Iterator[tuple[M, M]]:
    """Messages about STEP_NS apart, one pair after the other."""
    before: M | None = None
    for message in messages:
        if before is None or message.stamp_ns - before.stamp_ns > 2 * STEP_NS:
            before = message
        elif message.stamp_ns - before.stamp_ns >= STEP_NS:
            yield before, message
            before = message


def _log(rotation: Array64) -> Array64:
    """The rotation vector [rad]."""
    return np.asarray(cv2.Rodrigues(rotation)[0], dtype=np.float64).ravel()
