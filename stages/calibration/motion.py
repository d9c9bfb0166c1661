"""Check that the vehicle stood still: motion blurs surfaces as a wrong mount does.

Two tests. Motion by centimetres bends patches: a constant velocity and turn rate are added to the parameters of the
least squares, and are significant if the vehicle moved. Larger motion takes surfaces out of their patches: the upright
objects of the first half of the time are then correlated with those of the second half, in a view from above, at all
shifts; for a vehicle at rest no shift fits better than zero. This needs a servo that sweeps in both directions,
otherwise few surfaces are observed twice with time between.

Source: ours; shifts by correlation: Kuglin, Hines (1975).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.calibration.columns import drift_columns
from stages.calibration.scan_passes import Returns
from stages.calibration.solve import System, one_step, prior_information, sandwich, without_planes
from stages.geometry.frames import Array64

SIGNIFICANT = 5.0  # sigmas
EXPECTED = np.array([5.0, 5.0, 0.5, 0.2, 0.2, 0.5])  # [m/s], [rad/s]: prior sigma
CELL_M = 0.2
CELLS = 512
FARTHEST_M = 50.0
UPRIGHT_M = 0.5  # a column with returns over this range of height contains an upright object
FEWEST_CELLS = 150
SECTORS = 72
BETTER = 1.1  # least gain of a shift over no shift


@dataclass(frozen=True)
class Drift:
    """Apparent motion and rotation of the vehicle over the recording; 0 where not significant."""

    moved_m: float
    turned_rad: float


def drift(system: System, returns: Returns) -> Drift:
    """The constant motion that best explains the patches, at the mount of a system."""
    stamp_ns = returns.stamp_ns[system.chosen]
    since_s = (stamp_ns - stamp_ns.mean()) * 1e-9
    normal = system.patches.normal[system.patches.patch]
    moving = without_planes(drift_columns(system.placed, normal, since_s), system.weight, system.patches)
    wider = replace(system, columns=np.column_stack([system.columns, moving]))
    known = prior_information(returns.lasers)
    k = len(known)
    prior = np.zeros((k + len(EXPECTED), k + len(EXPECTED)))
    prior[:k, :k], prior[k:, k:] = known, np.diag(EXPECTED**-2.0)
    step = one_step(wider, np.zeros(len(prior)), prior)
    explained = replace(wider, residual=wider.residual + wider.columns @ step)
    sigma = np.sqrt(np.diag(sandwich(explained, stamp_ns, prior))[k:])
    rate = np.where(np.abs(step[k:]) > SIGNIFICANT * sigma, step[k:], 0.0) * float(np.ptp(since_s))
    return Drift(float(np.linalg.norm(rate[:3])), float(np.linalg.norm(rate[3:])))


@dataclass(frozen=True)
class Shift:
    """Correlation of two views from above, over shifts."""

    best_m: tuple[float, float]  # shift with the best fit
    gain: float  # correlation relative to no shift; 1: no improvement

    @property
    def moved(self) -> bool:
        """Whether the vehicle moved, or the scene around it."""
        return self.gain > BETTER


def shift(xyz_m: Array64, stamp_ns: NDArray[np.int64]) -> Shift | None:
    """Correlate the two halves of a recording's points (n, 3), NaN where unknown; None: too few common cells."""
    known = np.isfinite(xyz_m[:, 0]) & (np.hypot(xyz_m[:, 0], xyz_m[:, 1]) < FARTHEST_M)
    late = (stamp_ns > (stamp_ns[0] + stamp_ns[-1]) // 2)[known]
    xyz_m = xyz_m[known]
    sector = ((np.arctan2(xyz_m[:, 1], xyz_m[:, 0]) / (2 * np.pi) + 0.5) * SECTORS).astype(np.int64) % SECTORS
    seen = [np.bincount(sector[half], minlength=SECTORS) > 0 for half in (late, ~late)]
    both = (seen[0] & seen[1])[sector]
    first, second = (_upright(xyz_m[both & half]) for half in (~late, late))
    if min(first.sum(), second.sum()) < FEWEST_CELLS:
        return None
    spectrum = np.fft.rfft2(second) * np.conj(np.fft.rfft2(first))
    common = np.fft.fftshift(np.fft.irfft2(spectrum, first.shape))
    middle = CELLS // 2
    none = max(float(common[middle, middle]), 1e-9)
    best = np.unravel_index(int(common.argmax()), common.shape)
    best_m = float((best[0] - middle) * CELL_M), float((best[1] - middle) * CELL_M)
    return Shift(best_m, float(common.max()) / none)


def _upright(xyz_m: Array64) -> Array64:
    """Map (CELLS, CELLS) from above: 1 where an upright object stands, else 0."""
    cell = np.floor(xyz_m[:, :2] / CELL_M).astype(np.int64) + CELLS // 2
    number = cell[:, 0] * CELLS + cell[:, 1]
    low, high = np.full(CELLS**2, np.inf), np.full(CELLS**2, -np.inf)
    np.minimum.at(low, number, xyz_m[:, 2])
    np.maximum.at(high, number, xyz_m[:, 2])
    return (high - low > UPRIGHT_M).astype(np.float64).reshape(CELLS, CELLS)
