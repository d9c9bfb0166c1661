"""Where to put a beam on what was met once and flies on, at a speed that is known, nobody knows whither.

    x_k(t) = v t cos(phi_k)          across the beams of the fan, phi_k all headings alike

After a turn of the rotor it is most likely near one end of that: beams at v t to one side, then to the other, meet it
more often than one where it was. Beams of the fan stand apart alike, so all of them are counted. What earlier looks
did not meet counts less. Source: ours, after search theory (Koopman, Search and Screening, 1946).
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry import Array64

HEADINGS = np.cos(np.linspace(0.0, math.pi, 36, endpoint=False) + math.pi / 72)
OFFSETS = 24  # between two beams
MET = 0.8  # of a drone that the beam crosses


def best_offset_m(reach_m: float, tried_m: list[tuple[float, float]], spacing_m: float, half_m: float) -> float:
    """How far beside the place a beam most likely meets it, within half the beams' spacing to each side.

    `reach_m`: how far it has flown by then; `tried_m`: of each look that missed, how far it had flown, and the offset;
    `half_m`: a beam so far from its middle meets it about every other time.
    """
    weight = np.ones(HEADINGS.size)
    for flown_m, offset_m in tried_m:
        weight *= 1.0 - MET * _meets(offset_m - flown_m * HEADINGS, spacing_m, half_m)
    offset = (np.arange(OFFSETS) - OFFSETS // 2 + 1) * (spacing_m / OFFSETS)
    offset = offset[np.argsort(np.abs(offset), kind="stable")]  # of those alike the smallest
    gain = _meets(offset[:, np.newaxis] - reach_m * HEADINGS, spacing_m, half_m) @ weight
    return float(offset[np.argmax(gain > gain.max() - 1e-9)])


def _meets(beside_m: Array64, spacing_m: float, half_m: float) -> Array64:
    """How likely the nearest beam meets a drone so far beside one of them."""
    nearest_m = beside_m - spacing_m * np.round(beside_m / spacing_m)
    return np.exp(-math.log(2.0) * (nearest_m / half_m) ** 2)
