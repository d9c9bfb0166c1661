"""Flat patches: cells of space whose returns, from all scan passes of a sweep, lie on one plane.

A cell is a cube that grows with the range, as the effect of an angle error does. In each cell, a plane is fitted
repeatedly to the returns near the previous plane, so that few outliers (a passing bird, leaves, the edge of a sill) do
not tilt it.

Source: ours; planes as eigenvectors of a cell's scatter: Liu, Zhang, BALM (2021), section III.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64

CELLS_M = ((6.0, 0.5), (18.0, 1.0), (1e9, 2.0))  # largest range, edge of the cube
RANGE_NOISE_M = 0.012  # along the beam: noise of a laser without its bias
ANGLE_NOISE_RAD = 5e-4  # across the beam: encoder steps, time stamps, beam width on a slope
FEWEST = 24  # least number of returns of a patch
MOST = 160  # largest number of returns of a patch: no wall is flat enough for more
WIDE = 0.15  # least width (one sigma of the narrower side) as a share of the cell
MARGIN_M = 0.05  # excluded margin of a cell, where range noise decides whether a return is inside
CLOSE_RAD = 0.003
ROUGHEST = 2.0  # mean square distance from the plane, in that of the median patch
EXPECTED_ROUGH = 1.0  # mean square distance in units of `expected_sigma_m` that is always accepted
STEEPEST = 0.10  # least |cosine| between beams and normal: grazing returns are blurred


@dataclass(frozen=True)
class Patches:
    """Returns on patches, patch by patch. n returns, m patches."""

    index: NDArray[np.int64]  # (n,) into the returns given
    patch: NDArray[np.int64]  # (n,) patch number, ascending
    first: NDArray[np.int64]  # (m,) first return of each patch
    normal: Array64  # (m, 3)
    centre_m: Array64  # (m, 3)
    on_plane_m: Array64  # (n, 3) intersections of beams and planes: the returns without range noise
    plane_basis: Array64  # (n, 3) 1 and the position in the plane [m]: derivative of the residual by the plane
    residual_m: Array64  # (n,) signed distance from the plane
    sigma_m: Array64  # (n,) its expected sigma


def expected_sigma_m(range_m: Array64, cosine: Array64) -> Array64:
    """One sigma (n,) of the distance from a plane, for beams at an angle to its normal."""
    sine2 = np.maximum(1.0 - cosine**2, 0.0)
    return np.sqrt((RANGE_NOISE_M * cosine) ** 2 + (range_m * ANGLE_NOISE_RAD) ** 2 * sine2)


def find_patches(xyz_m: Array64, origin_m: Array64, tolerance_rad: float) -> Patches:
    """Flat patches among points (n, 3) with beam origins (n, 3), tolerating angle errors of `tolerance_rad`.

    Two grids, offset by half a cell: points at the borders of the first are in the middle of the second.
    """
    found = _on_grid(xyz_m, origin_m, tolerance_rad, np.arange(len(xyz_m)), 0.0)
    rest = np.ones(len(xyz_m), dtype=np.bool_)
    rest[found.index] = False
    return _joined(found, _on_grid(xyz_m, origin_m, tolerance_rad, np.nonzero(rest)[0], 0.5))


def _joined(a: Patches, b: Patches) -> Patches:
    def both(x: NDArray[Any], y: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate([x, y])

    return Patches(
        index=both(a.index, b.index),
        patch=both(a.patch, b.patch + len(a.first)),
        first=both(a.first, b.first + len(a.index)),
        normal=both(a.normal, b.normal),
        centre_m=both(a.centre_m, b.centre_m),
        on_plane_m=both(a.on_plane_m, b.on_plane_m),
        plane_basis=both(a.plane_basis, b.plane_basis),
        residual_m=both(a.residual_m, b.residual_m),
        sigma_m=both(a.sigma_m, b.sigma_m),
    )


def _on_grid(
    xyz_m: Array64, origin_m: Array64, tolerance_rad: float, chosen: NDArray[np.int64], shift: float
) -> Patches:
    beam = xyz_m - origin_m
    range_m = np.linalg.norm(beam, axis=1)
    reach_m, edge_m = np.array(CELLS_M).T
    level: NDArray[np.int64] = np.asarray(np.searchsorted(reach_m, range_m), dtype=np.int64)
    edge = edge_m[level]
    corner = np.floor(xyz_m / edge[:, None] + shift) - shift  # of each return's cell, in cells
    cell = np.column_stack([level.astype(np.float64), corner + shift])[chosen].astype(np.int64) + 4096
    key = ((cell[:, 0] * 8192 + cell[:, 1]) * 8192 + cell[:, 2]) * 8192 + cell[:, 3]
    order = np.argsort(key, kind="stable")
    first = np.concatenate([[0], np.nonzero(np.diff(key[order]))[0] + 1])
    keep, first = _thinned(first, len(order))
    index = chosen[order[keep]]
    roughest = ROUGHEST if tolerance_rad < CLOSE_RAD else 1e9
    slack = 2.5 * RANGE_NOISE_M + range_m * tolerance_rad
    for share in (1.0, 0.5, 0.5):  # of the slack: closer to the plane each time
        index, first = _many(index, first)
        patch = _numbers(first, len(index))
        centre, axes, spread = planes(xyz_m[index], first, patch)
        normal = axes[:, :, 0]
        residual = np.einsum("ij,ij->i", xyz_m[index] - centre[patch], normal[patch])
        cosine = np.abs(np.einsum("ij,ij->i", beam[index], normal[patch])) / range_m[index]
        flat = (spread[:, 1] > WIDE * np.minimum.reduceat(edge[index], first)) & (spread[:, 1] > 3 * spread[:, 0])
        good = flat[patch] & (np.abs(residual) < share * slack[index]) & (cosine > STEEPEST)
        index, first = _subset(index, patch, good)
        if len(first) == 0:
            break
    index, first = _many(index, first)
    patch = _numbers(first, len(index))
    centre, axes, _ = planes(xyz_m[index], first, patch)
    on_plane = _on_plane(beam[index], origin_m[index], axes[:, :, 0], centre, patch)
    inside = np.abs(on_plane - (corner[index] + 0.5) * edge[index, None])
    kept = (inside < edge[index, None] / 2 - MARGIN_M).all(axis=1) & _even(
        xyz_m, beam, index, first, axes, centre, roughest
    )[patch]
    index, first = _many(*_subset(index, patch, kept))
    patch = _numbers(first, len(index))
    centre, axes, _ = planes(xyz_m[index], first, patch)
    normal = axes[:, :, 0]
    on_plane = _on_plane(beam[index], origin_m[index], normal, centre, patch)
    cosine = np.abs(np.einsum("ij,ij->i", beam[index], normal[patch])) / range_m[index]
    in_plane = np.einsum("ij,ijk->ik", on_plane - centre[patch], axes[patch][:, :, 1:])
    return Patches(
        index=index,
        patch=patch,
        first=first,
        normal=normal,
        centre_m=centre,
        on_plane_m=on_plane,
        plane_basis=np.column_stack([np.ones(len(index)), in_plane]),
        residual_m=np.einsum("ij,ij->i", xyz_m[index] - centre[patch], normal[patch]),
        sigma_m=expected_sigma_m(range_m[index], cosine),
    )


def _even(
    xyz_m: Array64,
    beam_m: Array64,
    index: NDArray[np.int64],
    first: NDArray[np.int64],
    axes: Array64,
    centre_m: Array64,
    roughest: float,
) -> NDArray[np.bool_]:
    """Whether each patch (m,) is about as smooth as most: excludes window sills, leaves and panes."""
    if len(first) == 0:
        return np.zeros(0, dtype=np.bool_)
    patch = _numbers(first, len(index))
    normal = axes[:, :, 0][patch]
    beam = beam_m[index]
    range_m = np.linalg.norm(beam, axis=1)
    cosine = np.abs(np.einsum("ij,ij->i", beam, normal)) / range_m
    off = np.einsum("ij,ij->i", xyz_m[index] - centre_m[patch], normal) / expected_sigma_m(range_m, cosine)
    rough = np.add.reduceat(off**2, first) / np.diff(np.append(first, len(index)))
    return rough < max(roughest * float(np.median(rough)), EXPECTED_ROUGH)


def _on_plane(
    beam_m: Array64, origin_m: Array64, normal: Array64, centre_m: Array64, patch: NDArray[np.int64]
) -> Array64:
    """Intersections (n, 3) of beams (n, 3) from origins (n, 3) with the planes of their patches."""
    to_plane = np.einsum("ij,ij->i", centre_m[patch] - origin_m, normal[patch])
    along = np.einsum("ij,ij->i", beam_m, normal[patch])
    return origin_m + (to_plane / along)[:, None] * beam_m


def _numbers(first: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Patch number (count,) of each return."""
    return np.repeat(np.arange(len(first)), np.diff(np.append(first, count)))


def _thinned(first: NDArray[np.int64], count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of at most MOST returns per cell, spread over its scan passes, and the new start of each cell."""
    sizes = np.diff(np.append(first, count))
    step = np.maximum(-(-sizes // MOST), 1)
    within = np.arange(count) - np.repeat(first, sizes)
    # a step that shares no factor with the 16 lasers: every laser remains
    keep = np.nonzero(within % np.repeat(step + (step % 2 == 0), sizes) == 0)[0]
    return _subset(keep, np.repeat(np.arange(len(first)), sizes)[keep], np.ones(len(keep), dtype=np.bool_))


def _subset(
    index: NDArray[np.int64], patch: NDArray[np.int64], good: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    index, patch = index[good], patch[good]
    if len(index) == 0:
        return index, np.zeros(0, dtype=np.int64)
    return index, np.concatenate([[0], np.nonzero(np.diff(patch))[0] + 1])


def _many(index: NDArray[np.int64], first: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Patches with enough returns."""
    patch = _numbers(first, len(index))
    sizes = np.diff(np.append(first, len(index)))
    return _subset(index, patch, (sizes >= FEWEST)[patch] if len(index) else np.zeros(0, dtype=np.bool_))


def planes(xyz_m: Array64, first: NDArray[np.int64], patch: NDArray[np.int64]) -> tuple[Array64, Array64, Array64]:
    """Centre (m, 3), axes (m, 3, 3) from the thinnest to the widest, and spread (m, 3) along them [m]."""
    sizes = np.diff(np.append(first, len(xyz_m))).astype(np.float64)
    if len(first) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3))
    centre = np.add.reduceat(xyz_m, first, axis=0) / sizes[:, None]
    away = xyz_m - centre[patch]
    scatter = np.add.reduceat(away[:, :, None] * away[:, None, :], first, axis=0) / sizes[:, None, None]
    values, axes = np.linalg.eigh(scatter)
    return centre, axes, np.sqrt(np.maximum(values, 0.0))


def thickness_m(xyz_m: Array64, patches: Patches) -> Array64:
    """RMS distance (m,) of the returns (n, 3) of each patch from the plane through them."""
    known = np.where(np.isfinite(xyz_m), xyz_m, patches.on_plane_m)
    return planes(known, patches.first, patches.patch)[2][:, 0]
