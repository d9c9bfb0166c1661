"""Compiled evaluation of the detector's model.

Source: see `stages/detect/trained/model.py`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled


class ModelTables(NamedTuple):
    """See `DetectorModel`."""

    where: NDArray[np.int64]
    knots: Array64
    values: Array64
    missing: Array64
    priors: Array64  # (alternatives,)


@compiled
def evaluate(
    model: ModelTables,
    x: Array64,
) -> tuple[float, int, Array64]:
    """(log-odds of a drone, most probable alternative, contributions (n,)) for features x (n,).

    The contribution of a feature is that of its terms, each weighted by the probability of its alternative among them.
    """
    where, knots, values, missing, priors = model
    over, contributions = priors.copy(), np.zeros((priors.size, x.size))
    for row in range(where.shape[0]):
        alternative, feature, last = where[row, 0], where[row, 1], where[row, 2] - 1
        value = x[feature]
        if math.isnan(value):
            nats = missing[row]
        elif value <= knots[row, 0]:
            nats = values[row, 0]
        elif value >= knots[row, last]:
            nats = values[row, last]
        else:
            k = 1
            while value > knots[row, k]:
                k += 1
            share = (value - knots[row, k - 1]) / (knots[row, k] - knots[row, k - 1])
            nats = values[row, k - 1] + share * (values[row, k] - values[row, k - 1])
        over[alternative] += nats
        contributions[alternative, feature] += nats
    alternative = np.argmin(over)
    least = over[alternative]
    weight = np.exp(least - over)
    total = weight.sum()
    for feature in range(x.size):
        weighted = 0.0
        for k in range(over.size):
            weighted += contributions[k, feature] * weight[k] / total
        contributions[0, feature] = weighted
    return least - math.log(total), alternative, contributions[0]  # pyright: ignore[reportReturnType]
