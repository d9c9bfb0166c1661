"""How far off the rotations of both cameras are.

Source: ours. Two errors of each: of the rotation as given, which a wrong branch spoils, and of the nearest of its four
branches, which shows the measurement alone: turned by quarter turns about the world's vertical, which is not the
vehicle's z axis when that tilts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from links.evaluation.associate import Stamps, interpolate
from links.evaluation.errors import euler_rpy, log_rotation, mahalanobis, wrap
from links.evaluation.rotations import Rotations
from links.evaluation.tum import Trajectory
from stages.geometry.frames import Array64, rotation_z, rotations_from_xyzw


@dataclass(frozen=True, slots=True)
class Off:
    """How far rotations are from a true one."""

    angle_rad: Array64  # (n,) whole angle
    euler_rad: Array64  # (n, 3) roll, pitch, yaw


@dataclass(frozen=True, slots=True)
class RotationErrors:
    """Accepted rotations against truth at their own stamps; those that truth covers only."""

    stamps_ns: Stamps  # (n,)
    resolved: NDArray[np.bool_]  # (n,)
    given: Off
    modulo: Off  # of the nearest branch
    nees: Array64  # (n,) of the nearest branch; NaN where the covariance is not positive definite
    unknown: int  # accepted ones at times without truth


def rotation_errors(
    told: Rotations, drone: Trajectory, vehicle: Trajectory | None, max_gap_s: float
) -> RotationErrors | None:
    """Errors of what was accepted. `vehicle`: T_world_vehicle; None: it is taken to stand level.

    None when truth gives no rotation of the drone.
    """
    if drone.quaternion_xyzw is None:
        return None
    at_ns = told.stamps_ns[told.accepted]
    known, R_vehicle_drone = _orientation(drone, at_ns, max_gap_s)
    R_world_vehicle = np.broadcast_to(np.eye(3), (len(at_ns), 3, 3))
    if vehicle is not None:
        known_vehicle, R_world_vehicle = _orientation(vehicle, at_ns, max_gap_s)
        known = known & known_vehicle
    R = told.R_vehicle_drone[told.accepted][known]
    R_true, R_world_vehicle = R_vehicle_drone[known], R_world_vehicle[known]
    turns = np.array([rotation_z(quarter * math.pi / 2) for quarter in range(4)])
    R_branches = np.swapaxes(R_world_vehicle, 1, 2) @ turns[:, None] @ R_world_vehicle @ R_true  # (4, n, 3, 3)
    phi = np.array([log_rotation(np.swapaxes(R, 1, 2) @ R_branch) for R_branch in R_branches]).reshape(4, -1, 3)
    nearest = np.argmin(np.linalg.norm(phi, axis=2), axis=0)
    row = np.arange(len(R))
    return RotationErrors(
        stamps_ns=at_ns[known],
        resolved=told.resolved[told.accepted][known],
        given=_off(phi[0], R, R_true),
        modulo=_off(phi[nearest, row], R, R_branches[nearest, row]),
        nees=mahalanobis(phi[nearest, row], told.covariance_rad2[told.accepted][known]),
        unknown=int(np.count_nonzero(~known)),
    )


def way_m(
    drone: Trajectory, vehicle: Trajectory, span_ns: tuple[int, int], max_gap_s: float, over_ground: bool
) -> float | None:
    """Length [m] of the drone's way in a span, over ground or relative to the vehicle in axes that do not turn with it.

    None when truth has a gap in the span. A recording may begin a little before truth does.
    """
    max_gap_ns = round(max_gap_s * 1e9)
    begin_ns, end_ns = max(span_ns[0], int(drone.stamps_ns[0])), span_ns[1]
    if begin_ns - span_ns[0] > max_gap_ns:
        return None
    inside = (drone.stamps_ns > begin_ns) & (drone.stamps_ns < end_ns)
    at_ns = np.concatenate([[begin_ns], drone.stamps_ns[inside], [end_ns]])
    known, t_vehicle_drone, _ = interpolate(at_ns, drone.stamps_ns, drone.xyz_m, None, max_gap_ns)
    known_vehicle, t_world_vehicle, _ = interpolate(at_ns, vehicle.stamps_ns, vehicle.xyz_m, None, max_gap_ns)
    known_turn, R_world_vehicle = _orientation(vehicle, at_ns, max_gap_s)
    if not (known & known_vehicle & known_turn).all():
        return None
    way = np.einsum("nij,nj->ni", R_world_vehicle, t_vehicle_drone) + (t_world_vehicle if over_ground else 0.0)
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())


def _orientation(path: Trajectory, at_ns: Stamps, max_gap_s: float) -> tuple[NDArray[np.bool_], Array64]:
    """Where it is known (n,), and the rotations (n, 3, 3)."""
    known, _, quaternion = interpolate(at_ns, path.stamps_ns, path.xyz_m, path.quaternion_xyzw, round(max_gap_s * 1e9))
    if quaternion is None:
        return np.zeros(len(at_ns), dtype=np.bool_), np.broadcast_to(np.eye(3), (len(at_ns), 3, 3))
    return known, rotations_from_xyzw(np.where(known[:, None], quaternion, [0.0, 0.0, 0.0, 1.0]))


def _off(phi_rad: Array64, R: Array64, R_true: Array64) -> Off:
    return Off(np.linalg.norm(phi_rad, axis=1), wrap(euler_rpy(R) - euler_rpy(R_true)))
