"""How far beside the place a beam most likely meets a drone, after looks that did not.

Where it is across the fan's beams is one of a few dozen places, each with a weight:

    known well       x = sigma z,  z Gaussian
    met once         x = v t cos(phi), phi all headings alike: how fast it flies is known, whither is not
    nobody knows     a share of the weight lies anywhere between two beams: what is believed may be wrong

A look takes weight from the places it would have met; the next one goes where most is left. The beams of the fan stand
apart alike, so all of them count. Source: ours, after search theory (Koopman, Search and Screening, 1946).
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64

PLACES = 36
HEADINGS = np.cos(np.linspace(0.0, math.pi, PLACES, endpoint=False) + math.pi / (2 * PLACES))
GAUSSIAN = np.array([NormalDist().inv_cdf((k + 0.5) / PLACES) for k in range(PLACES)])
OFFSETS = 24  # between two beams
ANYWHERE = 0.15  # share of the weight
MET = 0.9  # of a drone that the beam crosses


class Look(NamedTuple):
    """A look that did not meet it: how far it may have been beside the place then, and the beam [m]."""

    reach_m: float
    offset_m: float


def best_offset_m(reach_m: float, headed: bool, tried: list[Look], spacing_m: float, half_m: float) -> float:
    """How far beside the place to put a beam, within half the beams' spacing to each side.

    `reach_m`: one sigma of its place, or, `headed`, how far it has flown any way by then; `half_m`: a beam so far from
    its middle meets it about every other time.
    """
    unit = HEADINGS if headed else GAUSSIAN
    offset = (np.arange(OFFSETS) - OFFSETS // 2 + 1) * (spacing_m / OFFSETS)
    offset = offset[np.argsort(np.abs(offset), kind="stable")]  # of those alike the smallest
    weight = np.repeat(((1.0 - ANYWHERE) / PLACES, ANYWHERE / OFFSETS), (PLACES, OFFSETS))
    for look in tried:
        weight *= 1.0 - MET * _meets(look.offset_m - np.append(look.reach_m * unit, offset), spacing_m, half_m)
    gain = _meets(offset[:, np.newaxis] - np.append(reach_m * unit, offset), spacing_m, half_m) @ weight
    return float(offset[np.argmax(gain > gain.max() * (1.0 - 1e-9))])


def _meets(beside_m: NDArray[Any], spacing_m: float, half_m: float) -> Array64:
    """How likely the nearest beam meets a drone so far beside one of them."""
    nearest_m = beside_m - spacing_m * np.round(beside_m / spacing_m)
    return np.exp(-math.log(2.0) * (nearest_m / half_m) ** 2)
