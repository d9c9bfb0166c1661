"""Marginal likelihood of a path under smooth motion: position, velocity and acceleration are integrated out.

    e(t) = c + v t + a t^2 / 2 + noise,   c, v, a normal about zero

Source: ours; Bishop, Pattern Recognition and Machine Learning (2006), 3.5.1, the evidence function.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

ANYWHERE_M = 100.0  # sigma of c


@compiled
def model_of(t: Array64, sigma: float, speed: float, acceleration: float) -> Array64:
    """The model (4, 3) that `log_p` needs for e (n,) = c + v t + a t^2 / 2 + noise: Cholesky factor L and constants.

    c, v, a are normal about zero with sigmas ANYWHERE_M, speed, acceleration; 0: there is none.
        ln p = -(e.e / sigma^2 - b.A^-1 b) / 2 - ln|A Q| / 2 - n ln sigma
        A = B'B / sigma^2 + Q^-1 = L L', b = B'e / sigma^2, B = (1, t, t^2 / 2)
    but for n ln(2 pi) / 2. The first bracket is chi-square, n degrees of freedom: `misfit`.
    """
    model, power = np.zeros((4, 3)), np.empty(3)
    q = (ANYWHERE_M, speed, acceleration)
    k = 1 + (speed > 0.0) + (acceleration > 0.0)
    for i in range(len(t)):
        power[0], power[1], power[2] = 1.0, t[i], 0.5 * t[i] * t[i]
        for r in range(k):
            for c in range(r + 1):
                model[r, c] += power[r] * power[c] / (sigma * sigma)
    constant = -len(t) * math.log(sigma)
    for r in range(k):
        for c in range(r + 1):
            left = model[r, c] + (1.0 / (q[r] * q[r]) if r == c else 0.0)
            for m in range(c):
                left -= model[r, m] * model[c, m]
            model[r, c] = math.sqrt(left) if r == c else left / model[c, c]
        constant -= math.log(model[r, r] * q[r])
    model[3, 0], model[3, 1], model[3, 2] = constant, 1.0 / (sigma * sigma), k
    return model


@compiled
def misfit(model: Array64, t: Array64, e: Array64) -> float:
    """Squared residual of e (n,) in sigmas: n on average if the model is correct."""
    b0 = b1 = b2 = square = 0.0
    for i in range(len(t)):
        square += e[i] * e[i]
        b0 += e[i]
        b1 += e[i] * t[i]
        b2 += 0.5 * e[i] * t[i] * t[i]
    weight = model[3, 1]
    y = b0 * weight / model[0, 0]
    gained = y * y
    if model[3, 2] > 1.0:
        z = (b1 * weight - model[1, 0] * y) / model[1, 1]
        gained += z * z
        if model[3, 2] > 2.0:
            gained += ((b2 * weight - model[2, 0] * y - model[2, 1] * z) / model[2, 2]) ** 2
    return square * weight - gained


@compiled
def log_p(model: Array64, t: Array64, e: Array64) -> float:
    """ln of the marginal likelihood of e (n,); see `model_of`."""
    return model[3, 0] - 0.5 * misfit(model, t, e)
