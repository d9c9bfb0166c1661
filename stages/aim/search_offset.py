"""Offset from the predicted position at which a beam most likely meets a drone that earlier beams missed.

The drone's position across the fan's beams is a discrete distribution. Its main component depends on what is known:

    Gaussian            x = sigma z,  z standard normal
    heading unknown     x = v t cos(phi),  phi uniform: the speed is known, the heading is not
    uniform             a share of the weight is uniform between two beams, in case the prediction is wrong

A beam that missed reduces the weight of the positions it would have met. The next beam goes where the detection
probability is highest. The beams are evenly spaced and all of them count.

Source: ours, after search theory (Koopman, Search and Screening, 1946).
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64

SAMPLES = 36  # of the main component
HEADING_UNKNOWN = np.cos(np.linspace(0.0, math.pi, SAMPLES, endpoint=False) + math.pi / (2 * SAMPLES))
GAUSSIAN = np.array([NormalDist().inv_cdf((k + 0.5) / SAMPLES) for k in range(SAMPLES)])
OFFSETS = 24  # tested offsets between two beams
UNIFORM_WEIGHT = 0.15  # of the uniform component
DETECTION_PROBABILITY = 0.9  # of a drone whose middle the beam crosses


class MissedObservation(NamedTuple):
    """A beam that did not meet the drone."""

    spread_m: float  # of the drone's position at that time, as in `best_offset_m`
    offset_m: float  # of the beam from the predicted position


def best_offset_m(
    spread_m: float, heading_unknown: bool, missed: list[MissedObservation], spacing_m: float, half_m: float
) -> float:
    """Offset [m] of a beam from the predicted position, at most half the beam spacing to either side.

    `spread_m`: one sigma of the position, or with `heading_unknown` the distance flown in an unknown direction.
    `half_m`: distance of a beam from the drone's middle that halves the detection probability.
    """
    unit = HEADING_UNKNOWN if heading_unknown else GAUSSIAN
    offset = (np.arange(OFFSETS) - OFFSETS // 2 + 1) * (spacing_m / OFFSETS)
    offset = offset[np.argsort(np.abs(offset), kind="stable")]  # of equal ones the smallest is taken
    weight = np.repeat(((1.0 - UNIFORM_WEIGHT) / SAMPLES, UNIFORM_WEIGHT / OFFSETS), (SAMPLES, OFFSETS))
    for miss in missed:
        distance_m = miss.offset_m - np.append(miss.spread_m * unit, offset)
        weight *= 1.0 - DETECTION_PROBABILITY * _detection_factor(distance_m, spacing_m, half_m)
    gain = _detection_factor(offset[:, np.newaxis] - np.append(spread_m * unit, offset), spacing_m, half_m) @ weight
    return float(offset[np.argmax(gain > gain.max() * (1.0 - 1e-9))])


def _detection_factor(distance_m: NDArray[Any], spacing_m: float, half_m: float) -> Array64:
    """Detection probability by the nearest beam, relative to a central hit; distances are from one of the beams."""
    nearest_m = distance_m - spacing_m * np.round(distance_m / spacing_m)
    return np.exp(-math.log(2.0) * (nearest_m / half_m) ** 2)
