"""Least squares over patches: the mount under which surfaces observed more than once are thin.

    minimise  sum_i rho(r_i / sigma_i) + (x - x0)^T P^-1 (x - x0),   r_i = n_j . p_i(x) - d_j

The planes (n_j, d_j) are unknown as well; each is projected out of its patch's residuals and columns, so that the
normal matrix contains the parameters alone and their covariance includes the uncertainty of the planes. The range bias
of each laser is a further unknown.

The covariance is the sandwich N^-1 S N^-1: the errors of the servo readings are correlated
within 0.2 s, and those of a surface over all its patches. S sums the scores over both kinds of clusters.

Source: ours; projection of the planes: variable projection, Golub, Pereyra (1973); two-way clusters: Cameron, Gelbach,
Miller, Robust inference with multiway clustering (2011).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.calibration.columns import Placed, laser_columns, mount_columns, place
from stages.calibration.parameters import PARAMETERS
from stages.calibration.patches import Patches, find_patches
from stages.calibration.scan_passes import Returns, ServoTrace, servo_at
from stages.calibration.servo_mount import ServoMount
from stages.geometry.frames import Array64

BIAS_SIGMA_M = 0.02  # of a laser's range (datasheet: +-3 cm)
MEAN_BIAS_SIGMA_M = 1e-3  # common bias of all lasers: it bends planes by fractions of a mm only
HUBER = 1.345  # in sigmas
CLUSTER_NS = 200_000_000
SURFACE = 5.0, 1.0  # patches within 1 / 5 of a normal and 1 m of distance count as one surface
INFLATION = 1.3  # of sigmas, because no wall is an exact plane; from errors in simulated scenes
COARSE_RAD = tuple(np.radians([1.0, 0.6, 0.4, 0.3]).tolist())  # tolerated angle error per iteration
FINE_RAD = float(np.radians(0.15))
FINE_ROUNDS = 6
SETTLED = 1.5  # largest spread of the last iterations, in sigmas; a larger one is no solution
NAMES = tuple(parameter.name for parameter in PARAMETERS)
EXPECTED = np.array([parameter.expected * parameter.per_unit for parameter in PARAMETERS])


@dataclass(frozen=True)
class System:
    """The linear system of one iteration: columns and residuals without the planes, weighted to one sigma."""

    columns: Array64  # (n, k) of NAMES, then the lasers' biases
    residual: Array64  # (n,)
    patches: Patches
    placed: Placed  # of the n returns on patches
    chosen: NDArray[np.int64]  # (n,) indices of these returns
    weight: Array64  # (n,) [1/m], robust weights

    @property
    def variance_factor(self) -> float:
        """Mean square of the residuals; 1 if they match their sigmas."""
        unknowns = 3 * len(self.patches.first) + self.columns.shape[1]
        return float(self.residual @ self.residual) / max(len(self.residual) - unknowns, 1)


@dataclass(frozen=True)
class Solution:
    """The estimated mount and its covariance."""

    mount: ServoMount
    bias_m: Array64  # (lasers,)
    covariance: Array64  # (p, p) of PARAMETERS, SI units
    system: System


def prior_information(lasers: int) -> Array64:
    """Information (k, k) of all unknowns except the planes: NAMES, then the lasers' biases."""
    prior = np.diag(np.concatenate([EXPECTED, np.full(lasers, BIAS_SIGMA_M)]) ** -2.0)
    prior[len(NAMES) :, len(NAMES) :] += MEAN_BIAS_SIGMA_M**-2.0 / lasers**2
    return prior


def without_planes(columns: Array64, weight: Array64, patches: Patches) -> Array64:
    """Weighted columns (n, k) with the motion of each patch's plane projected out: (I - Q Q^T) W^1/2 J."""
    basis = patches.plane_basis * weight[:, None]
    first, patch = patches.first, patches.patch
    gram = np.add.reduceat(basis[:, :, None] * basis[:, None, :], first, axis=0)
    inverse = np.linalg.inv(gram)
    left = columns * weight[:, None]
    for begin in range(0, left.shape[1], 8):  # in blocks of columns, to limit memory
        strip = left[:, begin : begin + 8]
        moment = np.add.reduceat(basis[:, :, None] * strip[:, None, :], first, axis=0)
        strip -= np.einsum("ij,ijk->ik", basis, (inverse @ moment)[patch])
    return left


def linearise(
    returns: Returns, trace: ServoTrace, mount: ServoMount, bias_m: Array64, tolerance_rad: float, max_gap_s: float
) -> System | None:
    """The system at a mount; None where no patch is found."""
    placed = place(returns, servo_at(trace, returns.stamp_ns, mount, max_gap_s), mount, bias_m)
    known = np.nonzero(np.isfinite(placed.xyz_m[:, 0]))[0]
    patches = find_patches(placed.xyz_m[known], placed.origin_m[known], tolerance_rad)
    if len(patches.first) == 0:
        return None
    chosen = known[patches.index]
    placed = placed.taken(chosen)._replace(xyz_m=patches.on_plane_m)
    normal = patches.normal[patches.patch]
    by_name = mount_columns(placed, normal, mount)
    columns = np.column_stack(
        [*(by_name[name] for name in NAMES), laser_columns(placed, normal, returns.laser[chosen], returns.lasers)]
    )
    scaled = np.abs(patches.residual_m) / patches.sigma_m
    scale = max(1.4826 * float(np.median(scaled)), 0.5)
    robust = np.sqrt(np.minimum(1.0, HUBER / np.maximum(scaled / scale, 1e-9)))
    weight = robust / patches.sigma_m
    both = without_planes(np.column_stack([columns, patches.residual_m]), weight, patches)
    columns = np.ascontiguousarray(both[:, :-1])  # a view's products would be ten times slower
    return System(columns, both[:, -1], patches, placed, chosen, weight)


def solve(returns: Returns, trace: ServoTrace, rig: ServoMount, max_gap_s: float) -> Solution | None:
    """The best mount, starting from the rig's; None without flat patches or without convergence.

    Each iteration searches for patches again, at first with a tolerance for the rig's error. The set of patches varies
    between iterations and changes the parameters by part of a sigma: the result is the mean of the last iterations.
    """
    prior, p = prior_information(returns.lasers), len(NAMES)
    mount, x = rig, np.zeros(len(prior))
    tried: list[Array64] = []
    for tolerance_rad in [*COARSE_RAD, *[FINE_RAD] * FINE_ROUNDS]:
        system = linearise(returns, trace, mount, x[p:], tolerance_rad, max_gap_s)
        if system is None:
            return None
        x = x + one_step(system, x, prior)
        mount = rig.moved(dict(zip(NAMES, x[:p].tolist(), strict=True)))
        tried.append(x)
    last = np.array(tried[-FINE_ROUNDS // 2 :])
    x = last.mean(axis=0)
    mount = rig.moved(dict(zip(NAMES, x[:p].tolist(), strict=True)))
    system = linearise(returns, trace, mount, x[p:], FINE_RAD, max_gap_s)
    if system is None:
        return None
    covariance = sandwich(system, returns.stamp_ns[system.chosen], prior)[:p, :p]
    settled = last[:, :p].std(axis=0) < SETTLED * np.sqrt(np.diag(covariance))
    return Solution(mount, x[p:], with_floor(covariance), system) if settled.all() else None


def one_step(system: System, x: Array64, prior: Array64) -> Array64:
    """Gauss-Newton step from x (k,), which is relative to the prior."""
    J, r, v = system.columns, system.residual, system.variance_factor
    return np.asarray(np.linalg.solve(J.T @ J / v + prior, -J.T @ r / v - prior @ x), dtype=np.float64)


def sandwich(system: System, stamp_ns: NDArray[np.int64], prior: Array64) -> Array64:
    """Covariance (k, k), with correlated returns within CLUSTER_NS and within a surface."""
    J, v = system.columns, system.variance_factor
    bread = np.linalg.inv(J.T @ J / v + prior)
    score = J * system.residual[:, None] / v
    by_surface = surfaces(system.patches)[system.patches.patch]
    meat = clustered(score, stamp_ns // CLUSTER_NS) + clustered(score, by_surface) - score.T @ score
    values, axes = np.linalg.eigh(bread @ (meat - J.T @ J / v) @ bread)
    excess = (axes * np.maximum(values, 0.0)) @ axes.T  # at least that of independent returns
    return np.asarray(INFLATION**2 * (bread + excess), dtype=np.float64)


def with_floor(covariance: Array64) -> Array64:
    """The covariance of PARAMETERS plus their systematic sigmas, `Parameter.floor`."""
    floor = np.array([parameter.floor * parameter.per_unit for parameter in PARAMETERS])
    return covariance + np.diag(floor**2)


def surfaces(patches: Patches) -> NDArray[np.int64]:
    """Surface number (m,) of each patch: patches with similar normal and distance form a surface."""
    outward = patches.normal * np.sign(np.einsum("ij,ij->i", patches.normal, patches.centre_m))[:, None]
    distance_m = np.einsum("ij,ij->i", outward, patches.centre_m)
    key = np.round(np.column_stack([SURFACE[0] * outward, distance_m / SURFACE[1]]))
    return np.unique(key, axis=0, return_inverse=True)[1].ravel()


def clustered(score: Array64, cluster: NDArray[np.int64]) -> Array64:
    """Sum over clusters of the outer product of their summed scores."""
    number = np.unique(cluster, return_inverse=True)[1].ravel()
    sums = np.zeros((int(number.max()) + 1, score.shape[1]))
    np.add.at(sums, number, score)
    return sums.T @ sums
