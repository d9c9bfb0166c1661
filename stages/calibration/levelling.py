"""Axis tilt and servo zero, which a sweep does not determine, from the vehicle's stated orientation.

A rotation of everything about the servo's axis does not change the thickness of any surface, nor does a tilt of the
axis in the vehicle. The ground around a level vehicle determines that tilt. It does not determine the zero, since the
axis is vertical and the ground is symmetric about it. The zero needs a wall parallel to the vehicle. The sigma of both
includes the sigma of the stated orientation and the consistency of ground or wall.

Source: ours. Lines and planes with Cauchy's weights: Holland, Welsch (1977).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.calibration.calibrate import Calibration
from stages.calibration.patches import planes
from stages.calibration.result import CURVE, Finding
from stages.geometry.frames import UNCALIBRATED_DEG, Array64, LidarMount, Pose, quaternions_xyzw
from stages.kernels.geometry.so3 import exp_rotation

GROUND_M = 15.0  # radius of the ground on which the vehicle stands
WALL_M = 10.0  # largest distance of a wall used for --parallel
GROUND_RAD = math.radians(10.0)  # largest tilt of the axis
SIDE_RAD = math.radians(3.0)  # largest error of the zero; a larger angle belongs to another wall
UPRIGHT = 0.17  # |z| of a wall's normal
FEWEST_GROUND, FEWEST_WALL = 16, 8  # patches
WIDE_M = 1.0  # least sigma of the ground patches' positions, in each direction
LONG_M = 4.0  # least length of a wall
ROUGH_M = 0.05  # largest distance from the plane or line
AGREE = 0.7  # least share of the patches on it
BENT_RAD = math.radians(0.5)  # largest difference between the halves of the ground or wall
SIDE_BY_SIDE_M = 1.0  # largest difference in distance between patches of one wall
ROUNDS = 20


@dataclass(frozen=True)
class Standing:
    """The vehicle's stated orientation, each with its sigma [rad]; None: not stated."""

    level_rad: float | None = None
    parallel_rad: float | None = None


class _Undetermined(Exception):
    """The scene does not determine it; the text states why."""


def stand(found: Calibration, rig: LidarMount, stated: Standing) -> Calibration:
    """The calibration with axis tilt and zero, where the stated orientation and the scene determine them."""
    xyz_m = np.where(np.isfinite(found.after.xyz_m), found.after.xyz_m, found.patches.on_plane_m)
    centre, axes, _ = planes(xyz_m, found.patches.first, found.patches.patch)
    T = rig.T_vehicle_turntable.matrix()
    R_vehicle_base, findings, mount = T[:3, :3], list(found.findings), found.mount
    normal = axes[:, :, 0]
    if stated.level_rad is not None:
        before = _tilt_deg(R_vehicle_base)
        try:
            up, ground_rad = ground(normal @ R_vehicle_base.T, centre @ R_vehicle_base.T, -T[2, 3])
            sigma_rad, rejected = math.hypot(stated.level_rad, ground_rad), ""
            R_vehicle_base = _upright(up) @ R_vehicle_base
            mount = mount.model_copy(update={"T_vehicle_turntable": _pose(rig.T_vehicle_turntable, R_vehicle_base)})
        except _Undetermined as why:
            sigma_rad, rejected = math.radians(1.0), str(why)
        for i, axis in enumerate("xy"):
            what, after = f"axis's tilt in the vehicle about {axis}", _tilt_deg(R_vehicle_base)[i]
            findings.append(Finding(f"level_{axis}", what, "deg", before[i], after, math.degrees(sigma_rad), rejected))
    if stated.parallel_rad is not None:
        at = next(i for i, finding in enumerate(findings) if finding.name == "zero")
        try:
            where, heading_rad, wall_rad = wall(
                normal @ R_vehicle_base.T, centre @ R_vehicle_base.T + T[:3, 3], stated.parallel_rad
            )
            sigma_deg = math.degrees(math.hypot(stated.parallel_rad, wall_rad))
            if sigma_deg > UNCALIBRATED_DEG:
                raise _Undetermined(f"sigma is {sigma_deg:.2f} deg, no better than a rig as bought")
            zero_deg = mount.servo_zero_deg + rig.servo_sign * math.degrees(heading_rad)
            mount = mount.model_copy(update={"servo_zero_deg": zero_deg, **_pointing(found, sigma_deg)})
            what = f"servo's zero, by the wall {where}"
            findings[at] = replace(findings[at], what=what, after=zero_deg, sigma=sigma_deg, rejected="")
        except _Undetermined as why:
            findings[at] = replace(findings[at], rejected=str(why))
    return replace(found, mount=mount, findings=tuple(findings))


def ground(normal: Array64, centre_m: Array64, below_m: float) -> tuple[Array64, float]:
    """Up direction (3,) from the ground and its sigma [rad] from its halves. Raises _Undetermined.

    Patches (m, 3) in the vehicle's axes, about the turntable; the ground is lower than `below_m`.
    """
    lying = (np.abs(normal[:, 2]) > math.cos(GROUND_RAD)) & (centre_m[:, 2] < below_m)
    near = centre_m[lying & (np.hypot(centre_m[:, 0], centre_m[:, 1]) < GROUND_M)]
    if len(near) < FEWEST_GROUND or _narrowest_m(near[:, :2]) < WIDE_M:
        raise _Undetermined(
            f"too little of the ground within {GROUND_M:g} m was observed on all sides ({len(near)} flat patches): "
            "park in the open"
        )
    slope, share = _fitted(near)
    if share < AGREE:
        raise _Undetermined(
            f"of the ground's patches {100 * share:.0f} % lie on one plane: park where there is no kerb and no "
            "change of slope"
        )
    bends = [_fitted(near[side], ROUGH_M)[0] - slope for side in _halves(near[:, :2]) if _is_wide(near[side])]
    if len(bends) < 3:
        raise _Undetermined("the ground was observed on one side of the vehicle only: park in the open")
    bent_rad = float(np.linalg.norm(bends, axis=1).max())
    if bent_rad > BENT_RAD:
        raise _Undetermined(
            f"the ground bends by {math.degrees(bent_rad):.1f} deg about the vehicle: park where it is even"
        )
    up = np.array([-slope[0], -slope[1], 1.0])
    return up / np.linalg.norm(up), bent_rad


def wall(normal: Array64, centre_m: Array64, stated_sigma_rad: float) -> tuple[str, float, float]:
    """Description, heading [rad] and sigma [rad] of the nearest wall next to the vehicle. Raises _Undetermined.

    Patches (m, 3) in the vehicle frame. A wall on the other side that is not much farther has to run the same way.
    """
    aside = (np.abs(normal[:, 2]) < UPRIGHT) & (np.abs(normal[:, 1]) > math.cos(2 * SIDE_RAD))
    aside &= np.abs(centre_m[:, 1]) < WALL_M
    found = [(side, _nearest_wall(centre_m[aside & (side * centre_m[:, 1] > 0)])) for side in (1.0, -1.0)]
    walls = sorted((*one, side) for side, one in found if one is not None)
    if not walls:
        raise _Undetermined(
            f"no wall of {LONG_M:g} m was observed next to the vehicle, within {WALL_M:g} m: park along one"
        )
    distance_m, heading_rad, sigma_rad, side = walls[0]
    where = f"{distance_m:.1f} m to the {'left' if side > 0 else 'right'}"
    if abs(heading_rad) > SIDE_RAD:
        raise _Undetermined(
            f"by the rig's zero the wall {where} is {math.degrees(abs(heading_rad)):.1f} deg off the vehicle's "
            "heading, too much for a zero error: set the zero roughly, or park along a wall"
        )
    if sigma_rad > BENT_RAD:
        raise _Undetermined(
            f"the wall next to the vehicle bends by {math.degrees(sigma_rad):.1f} deg: park along a flat one"
        )
    for other_m, other_rad, other_sigma_rad, _ in walls[1:]:
        off_rad = abs(other_rad - heading_rad)
        if other_m < 2 * distance_m and off_rad > 3 * math.hypot(stated_sigma_rad, sigma_rad, other_sigma_rad):
            raise _Undetermined(
                f"the walls on both sides differ by {math.degrees(off_rad):.1f} deg, and it is not known which "
                "one is meant: park nearer to it"
            )
    return where, heading_rad, sigma_rad


def _nearest_wall(centre_m: Array64) -> tuple[float, float, float] | None:
    """(distance [m], heading [rad], sigma [rad]) of the nearest wall on one side; None: no wall."""
    away = np.abs(centre_m[:, 1])
    for distance_m in np.sort(away):
        one = centre_m[(away >= distance_m) & (away < distance_m + SIDE_BY_SIDE_M)]
        if len(one) < FEWEST_WALL or np.ptp(one[:, 0]) < LONG_M:
            continue
        line = np.column_stack([one[:, 0], np.zeros(len(one)), one[:, 1]])
        slope, share = _fitted(line)
        if share < AGREE:
            continue
        middle = float(np.median(one[:, 0]))
        halves = [_fitted(line[half])[0][0] for half in (one[:, 0] <= middle, one[:, 0] > middle)]
        return float(np.median(np.abs(one[:, 1]))), math.atan(slope[0]), abs(halves[0] - halves[1]) / 2
    return None


def _fitted(points_m: Array64, scale_m: float = ROUGH_M / 2) -> tuple[Array64, float]:
    """Slopes (2,) of z over x and y from points (n, 3), and the share of points on that plane."""
    rows = np.column_stack([points_m[:, :2] - points_m[:, :2].mean(axis=0), np.ones(len(points_m))])
    weight = np.ones(len(points_m))
    found = np.zeros(3)
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(rows * root[:, None], points_m[:, 2] * root, rcond=1e-9)[0]
        weight = 1 / (1 + ((points_m[:, 2] - rows @ found) / scale_m) ** 2)
    share = float((np.abs(points_m[:, 2] - rows @ found) < ROUGH_M).mean())
    return np.asarray(found[:2], dtype=np.float64), share


def _halves(xy_m: Array64) -> list[NDArray[np.bool_]]:
    """Front, rear, left and right of the vehicle, as masks (n,)."""
    x, y = xy_m.T
    return [x > 0, x <= 0, y > 0, y <= 0]


def _is_wide(points_m: Array64) -> bool:
    return len(points_m) >= FEWEST_GROUND // 2 and _narrowest_m(points_m[:, :2]) > WIDE_M / 2


def _narrowest_m(xy_m: Array64) -> float:
    """Sigma of points (n, 2) in the direction of least spread."""
    return math.sqrt(max(float(np.linalg.eigvalsh(np.cov(xy_m.T))[0]), 0.0)) if len(xy_m) > 2 else 0.0


def _upright(up: Array64) -> Array64:
    """The shortest rotation (3, 3) that takes a direction to z."""
    about = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(about))
    return exp_rotation(about * (math.atan2(sine, float(up[2])) / sine)) if sine > 1e-12 else np.eye(3)


def _tilt_deg(R: Array64) -> tuple[float, float]:
    """Roll and pitch [deg] of a rotation (3, 3)."""
    return math.degrees(math.atan2(R[2, 1], R[2, 2])), math.degrees(-math.asin(max(-1.0, min(1.0, R[2, 0]))))


def _pose(before: Pose, R: Array64) -> Pose:
    qx, qy, qz, qw = quaternions_xyzw(R[None])[0].tolist()
    return Pose(xyz_m=before.xyz_m, quaternion_xyzw=(qx, qy, qz, qw))


def _pointing(found: Calibration, zero_sigma_deg: float) -> dict[str, float]:
    """Sigma of the servo's angle with such a zero; empty where its other parameters are not accepted."""
    if not {f.name for f in found.findings if not f.rejected}.issuperset({*CURVE, "play"}):
        return {}
    return {"pointing_sigma_deg": math.hypot(zero_sigma_deg, math.degrees(found.curve_sigma_rad))}
