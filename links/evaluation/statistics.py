"""Chi-square, confidence intervals and how many independent samples a series is worth.

Source: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 5.4 (NEES); Wilson,
J. Am. Stat. Assoc. 22 (1927) (interval of a share); incomplete gamma as series and continued fraction, Abramowitz and
Stegun 6.5.29 and 6.5.31.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64

Z_95 = 1.959963984540054  # two-sided 95 % of the normal distribution


def chi2_cdf(x: float, dof: float) -> float:
    """P(chi2_dof <= x), the regularised lower incomplete gamma function P(dof / 2, x / 2)."""
    a, x = dof / 2, x / 2
    if x <= 0:
        return 0.0
    front = math.exp(a * math.log(x) - x - math.lgamma(a))
    if x < a + 1:
        term = total = 1 / a
        n = a
        while abs(term) > abs(total) * 1e-15:
            n += 1
            term *= x / n
            total += term
        return min(1.0, front * total)
    b, c = x + 1 - a, 1e300
    d = h = 1 / b
    step, i = 0.0, 0
    while abs(step - 1) > 1e-14:
        i += 1
        an = -i * (i - a)
        b += 2
        d = 1 / (an * d + b)
        c = b + an / c
        step = d * c
        h *= step
    return max(0.0, 1 - front * h)


def chi2_quantile(p: float, dof: float) -> float:
    """x with P(chi2_dof <= x) = p, by bisection."""
    low, high = 0.0, dof + 20 * math.sqrt(2 * dof) + 50
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if chi2_cdf(middle, dof) < p else (low, middle)
        if high - low <= 1e-12 * high:
            break
    return (low + high) / 2


def chi2_density(x: Array64, dof: int) -> Array64:
    """Probability density of chi2_dof."""
    half = dof / 2
    return x ** (half - 1) * np.exp(-x / 2) / (2**half * math.gamma(half))


def mean_nees_bounds(samples: float, dof: int) -> tuple[float, float]:
    """Between what the mean NEES of an honest estimator lies in 95 % of trials: chi2_{n dof}(2.5 %, 97.5 %) / n."""
    n = max(samples, 1.0)
    return chi2_quantile(0.025, n * dof) / n, chi2_quantile(0.975, n * dof) / n


def wilson_interval(successes: float, trials: float) -> tuple[float, float]:
    """95 % confidence interval of a share."""
    share, z2 = successes / trials, Z_95**2
    middle = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = Z_95 / (1 + z2 / trials) * math.sqrt(share * (1 - share) / trials + z2 / (4 * trials**2))
    return max(0.0, middle - half), min(1.0, middle + half)


def poisson_upper(events: int) -> float:
    """The mean that gives so few events or fewer in 5 % of trials only: chi2_{2 events + 2}(95 %) / 2."""
    return chi2_quantile(0.95, 2 * events + 2) / 2


def effective_samples(series: Array64) -> float:
    """How many independent samples have the information of this series: n / (1 + 2 sum of its autocorrelation).

    The sum ends at the first lag with a correlation of 0 or less. Never more than n, never less than 1.
    """
    n = len(series)
    centred = series - series.mean() if n else series
    power = float(centred @ centred)
    if n < 3 or power <= 1e-12 * n * float(np.square(series).mean()):
        return float(min(n, 1))  # a constant series repeats one sample
    total = 0.0
    for lag in range(1, n - 1):
        correlation = float(centred[:-lag] @ centred[lag:]) / power
        if correlation <= 0:
            break
        total += correlation
    return max(1.0, n / (1 + 2 * total))
