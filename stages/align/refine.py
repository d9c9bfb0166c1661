"""Joint refinement of the yaw between both cameras and the directions of the streets.

    unknown    yaw, azimuth a_k of each direction k, and its value in each camera
    line i     n_i . h(a_vk) = 0 in the vehicle's level axes,  n_i . h(a_dk) = 0 in the drone's       robust weights
    camera     a_vk = a_k,  a_dk = a_k - yaw        up to `direction_rad`: errors that many lines share
    streets    a_j = a_k + 90 deg for two directions nearly at right angles      up to `square_rad`
    tilt       that of the vertical of each image: `vp` found it with the same lines, which give no more of it here

With the unknowns x, the tilts p (2 angles each, covariance P) and the normal equations H of both,

    S = -H_xx^-1 H_xp,   Cov(x) = H_xx^-1 + S P S^T,   Cov(x, p) = S P

Lines along one street share errors of the lens, the image and the street, which do not average out however many lines
there are. So each camera has its own estimate of each direction, and constraints tie only these estimates together.

Source: ours, for P IV Eq. 7-10; tilts as considered parameters: Schmidt (1966); DESIGN, Vision: raw covariance is
overconfident (NEES/3 about 21).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.align.spectra import LevelLines
from stages.geometry.frames import Array64, rotation_z
from stages.kernels.align.spectra import BIN_RAD

TILTS_AND_YAW = 5  # the first columns: tilt x, y of the vehicle, of the drone, yaw
YAW = 4
MOST_DIRECTIONS = 6
APART_RAD = math.radians(4.0)  # directions nearer to each other are the same
WEAKEST = 0.08  # share of the strongest direction, below which a direction is ignored
NEAR_RAD = math.radians(3.0)  # lines this near to a direction belong to it
SQUARE_RAD = math.radians(2.5)  # two directions this near to a right angle are constrained to it, with `square_rad`
CAUCHY = 2.0  # [sigma] residual from which the weight of a line falls
ROUNDS = 4
MAX_RESIDUAL2 = 16.0  # bound of a squared residual
FEW = 20.0  # lines: the variance of a direction with fewer is inflated


@dataclass(frozen=True)
class Tolerances:
    """Deviations of the scene and the images from the model, one sigma [rad]."""

    straight_rad: float  # of a line from its street's direction
    direction_rad: float  # error shared by all lines of a street in one camera
    square_rad: float  # of two crossing streets from a right angle
    tilt_rad: float  # error of a vertical beyond its sigma, shared by all lines of an image


@dataclass(frozen=True)
class Refined:
    """R_vehicle_drone = R_vehicle_level Rz(yaw) R_drone_level^T, with the covariance of its five angles."""

    R_vehicle_level: Array64
    R_drone_level: Array64
    yaw_rad: float
    covariance: Array64  # (5, 5) of the tilts x, y of the vehicle's level axes, of the drone's, and yaw
    directions: int  # seen by both cameras
    vehicle_lines: int  # sum of the robust weights of the lines
    drone_lines: int

    @property
    def yaw_sigma_rad(self) -> float:
        """Sigma of the yaw [rad]."""
        return math.sqrt(self.covariance[4, 4])

    def R_vehicle_drone(self, quarters: int) -> Array64:
        """The rotation (3, 3), turned by `quarters` times 90 deg about the vertical."""
        return self.R_vehicle_level @ rotation_z(self.yaw_rad + quarters * math.pi / 2) @ self.R_drone_level.T

    def covariance_rad2(self, quarters: int) -> Array64:
        """(3, 3) of phi in R exp(phi), the drone's axes: phi = R_drone_level (Rz(-yaw) tilt_v + yaw z - tilt_d)."""
        J = np.zeros((3, TILTS_AND_YAW))
        J[:, :2] = rotation_z(-self.yaw_rad - quarters * math.pi / 2)[:, :2]
        J[0, 2] = J[1, 3] = -1.0
        J[2, 4] = 1.0
        to_phi = self.R_drone_level @ J
        return to_phi @ self.covariance @ to_phi.T


def street_directions(vehicle: Array64, drone: Array64, yaw_rad: float) -> Array64:
    """Azimuths (k,) in the vehicle's level axes of the strongest directions of both spectra (BINS,) combined."""
    together = vehicle + np.roll(drone, round(yaw_rad / BIN_RAD))
    left, right = np.roll(together, 1), np.roll(together, -1)
    tops = np.flatnonzero((together > left) & (together >= right) & (together > WEAKEST * together.max()))
    found: list[float] = []
    for k in tops[np.argsort(-together[tops], kind="stable")].tolist():
        if all(abs(half_turn_difference(k * BIN_RAD - other)) >= APART_RAD for other in found):
            found.append(k * BIN_RAD)
        if len(found) == MOST_DIRECTIONS:
            break
    return np.array(found)


def half_turn_difference(angle_rad: float) -> float:
    """The angle modulo 180 deg, nearest to zero."""
    return (angle_rad + math.pi / 2) % math.pi - math.pi / 2


@dataclass
class _Camera:
    """Lines of one camera by direction, and its level axes."""

    R: Array64  # R_carrier_level
    normal: Array64  # (m, 3) camera_mount axes
    sigma: Array64  # (m,)
    k: NDArray[np.int64]  # (m,) index of the direction
    azimuth: Array64  # (K,) estimate of this camera, in its own level axes
    tilt_sigma_rad: float
    inflation: Array64  # (K,) sigma factor of each direction: few lines, or large residuals
    effective_lines: float = 0.0

    def rows(self, at: int, tilt_at: int, unknowns: int) -> tuple[Array64, Array64]:
        """J (m, unknowns) and r (m,) of the lines, in sigmas and weighted."""
        n = self.normal @ self.R
        a = self.azimuth[self.k]
        c, s = np.cos(a), np.sin(a)
        r = n[:, 0] * c + n[:, 1] * s
        J = np.zeros((len(r), unknowns))
        J[:, tilt_at] = n[:, 2] * s  # -(n x h) . x
        J[:, tilt_at + 1] = -n[:, 2] * c  # -(n x h) . y
        J[np.arange(len(r)), at + self.k] = n[:, 1] * c - n[:, 0] * s
        scaled = r / self.sigma
        weight = 1.0 / (1.0 + (scaled / CAUCHY) ** 2)
        self.effective_lines = float(weight.sum())
        lines = np.maximum(np.bincount(self.k, minlength=len(self.azimuth)), 1)
        mean_residual2 = np.bincount(self.k, np.minimum(scaled**2, MAX_RESIDUAL2), minlength=len(self.azimuth)) / lines
        self.inflation = np.maximum(mean_residual2, 1.0) * np.sqrt(1.0 + FEW / lines)
        root = np.sqrt(weight) / self.sigma
        return J * root[:, None], r * root


def _camera(lines: LevelLines, directions: Array64, yaw_rad: float, allowed: Tolerances) -> _Camera:
    """Lines near one of the directions (K,) of the vehicle; `yaw_rad` turns the directions into this camera's axes."""
    azimuth = directions - yaw_rad
    off = lines.azimuth_rad[:, None] - azimuth
    off = np.abs((off + math.pi / 2) % math.pi - math.pi / 2)
    k = np.argmin(off, axis=1)
    nearest = off[np.arange(len(k)), k]
    own = nearest < np.maximum(NEAR_RAD, 2.0 * lines.azimuth_sigma_rad)
    normal = lines.normal[own]
    flat = np.hypot(normal[:, 0], normal[:, 1])
    return _Camera(
        R=lines.R_carrier_level,
        normal=normal @ lines.R_carrier_level.T,
        sigma=np.hypot(lines.sigma_rad[own], allowed.straight_rad * flat),
        k=k[own],
        azimuth=azimuth,
        tilt_sigma_rad=math.hypot(lines.tilt_sigma_rad, allowed.tilt_rad),
        inflation=np.ones(len(directions)),
    )


def refine(
    vehicle: LevelLines,
    drone: LevelLines,
    directions: Array64,
    yaw_rad: float,
    allowed: Tolerances,
) -> Refined | None:
    """Gauss-Newton refinement, started at `yaw_rad` and `directions` (K,) of the spectra.

    None: the cameras have neither a direction in common nor two at right angles: the lines do not determine the yaw.
    """
    K = len(directions)
    unknowns = TILTS_AND_YAW + 3 * K
    street, own = TILTS_AND_YAW, (TILTS_AND_YAW + K, TILTS_AND_YAW + 2 * K)
    cameras = (
        _camera(vehicle, directions, 0.0, allowed),
        _camera(drone, directions, yaw_rad, allowed),
    )
    a, yaw = directions.copy(), yaw_rad
    squares = _right_angles(directions)
    own_k = [set(camera.k.tolist()) for camera in cameras]
    shared = own_k[0] & own_k[1]
    if not shared and not any({i, j} & own_k[0] and {i, j} & own_k[1] for i, j in squares):
        return None
    ties = _ties(K, squares, allowed)
    information = np.eye(unknowns)
    weight = np.ones(len(ties))  # of the ties: reduced where the cameras disagree on a street
    solved = slice(YAW, unknowns)
    for _ in range(ROUNDS):
        r_ties = _tie_residuals(a, yaw, squares, cameras, allowed)
        inflation = np.concatenate([camera.inflation for camera in cameras])
        weight[: 2 * K] = 1.0 / (inflation**2 + (r_ties[: 2 * K] / CAUCHY) ** 2)
        information[:] = (ties.T * weight) @ ties
        slope = (ties.T * weight) @ r_ties
        for c, camera in enumerate(cameras):
            J, r = camera.rows(own[c], 2 * c, unknowns)
            information += J.T @ J
            slope += J.T @ r
        step = np.zeros(unknowns)
        step[solved] = -np.linalg.solve(information[solved, solved], slope[solved])
        for c, camera in enumerate(cameras):
            camera.azimuth = camera.azimuth + step[own[c] : own[c] + K]
        yaw += float(step[YAW])
        a = a + step[street : street + K]
    covariance = _covariance(information, [camera.tilt_sigma_rad for camera in cameras])
    return Refined(
        R_vehicle_level=cameras[0].R,
        R_drone_level=cameras[1].R,
        yaw_rad=yaw,
        covariance=covariance,
        directions=len(shared),
        vehicle_lines=round(cameras[0].effective_lines),
        drone_lines=round(cameras[1].effective_lines),
    )


def _covariance(information: Array64, tilt_sigma_rad: list[float]) -> Array64:
    """Covariance (5, 5) of the tilts and the yaw, from the information of all columns without that of the tilts."""
    P = np.diag(np.repeat(tilt_sigma_rad, 2)) ** 2
    solution = np.linalg.solve(information[YAW:, YAW:], np.eye(len(information) - YAW, 1))[:, 0]
    S = -solution @ information[YAW:, :YAW]
    covariance = np.zeros((TILTS_AND_YAW, TILTS_AND_YAW))
    covariance[:YAW, :YAW] = P
    covariance[YAW, :YAW] = covariance[:YAW, YAW] = P @ S
    covariance[YAW, YAW] = solution[0] + S @ P @ S
    return covariance


def _right_angles(directions: Array64) -> list[tuple[int, int]]:
    """Pairs of directions (K,) that are nearly at right angles."""
    return [
        (i, j)
        for i in range(len(directions))
        for j in range(i)
        if abs(abs(half_turn_difference(directions[i] - directions[j])) - math.pi / 2) < SQUARE_RAD
    ]


def _ties(K: int, squares: list[tuple[int, int]], allowed: Tolerances) -> Array64:
    """J (2 K + squares, unknowns) of the constraints, in sigmas: directions of each camera, right angles."""
    street, own = TILTS_AND_YAW, (TILTS_AND_YAW + K, TILTS_AND_YAW + 2 * K)
    ties = np.zeros((2 * K + len(squares), TILTS_AND_YAW + 3 * K))
    seen = np.arange(K)
    for c in range(2):
        ties[c * K + seen, own[c] + seen] = 1 / allowed.direction_rad
        ties[c * K + seen, street + seen] = -1 / allowed.direction_rad
    ties[K + seen, YAW] = 1 / allowed.direction_rad
    for row, (i, j) in enumerate(squares, 2 * K):
        ties[row, [street + i, street + j]] = 1 / allowed.square_rad, -1 / allowed.square_rad
    return ties


def _tie_residuals(
    a: Array64, yaw: float, squares: list[tuple[int, int]], cameras: tuple[_Camera, _Camera], allowed: Tolerances
) -> Array64:
    """r of the constraints, in sigmas, in the order of `_ties`."""
    return np.concatenate(
        [
            (cameras[0].azimuth - a) / allowed.direction_rad,
            (cameras[1].azimuth - a + yaw) / allowed.direction_rad,
            [from_square(a[i] - a[j]) / allowed.square_rad for i, j in squares],
        ]
    )


def from_square(angle_rad: float) -> float:
    """Deviation from a right angle of the angle between two azimuths, modulo 180 deg; positive: more than +90 deg."""
    return half_turn_difference(angle_rad - math.pi / 2)
