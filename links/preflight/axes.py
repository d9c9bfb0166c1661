"""Comparison of two measurements of one motion: which axes agree, and which permutation of axes explains a difference.

a and b hold the same vectors from two sources, row by row, and should be equal. An axis is compared only if there was
motion along it. The slope of a on b is 1 where they agree, -1 for a wrong sign, and near 0 for a wrong axis. If an axis
disagrees, the axis permutation with signs that explains the motion best is reported.

Positions may differ by a translation and a yaw angle: b is aligned to a in both first.

Source: ours; least squares. The 48 signed permutations are the symmetries of a cube, including reflections.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache

import numpy as np

from stages.geometry.frames import Array64, rotation_z

AXES = "xyz"
SLOPE = (0.5, 2.0)  # of an axis that agrees
MAX_RESIDUAL = 0.7  # of an axis: rms of the residual relative to the rms of its motion


@cache
def _permutations() -> tuple[Array64, ...]:
    """All 48 signed permutation matrices, the identity first."""
    matrices: list[Array64] = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            matrices.append(matrix)
    return tuple(matrices)


@dataclass(frozen=True, slots=True)
class Agreement:
    """Result of a comparison."""

    compared: str  # axes with motion along them, such as "xz"
    wrong: str  # those of them that disagree
    permutation: str | None  # if some are wrong: the permutation that explains it, as text; None: no permutation does


def compare(a: Array64, b: Array64, min_rms: float) -> Agreement:
    """Compare vectors (n, 3), (n, 3). Axes with less motion in `a` than `min_rms` are not compared."""
    compared = "".join(axis for k, axis in enumerate(AXES) if len(a) and _rms(a[:, k]) >= min_rms)
    wrong = _wrong(a, b, compared)
    return Agreement(
        compared,
        wrong,
        _description([m for m in _permutations() if not _wrong(a, b @ m.T, compared)]) if wrong else None,
    )


def compare_paths(a: Array64, b: Array64, min_rms_m: float) -> Agreement:
    """Compare positions (n, 3), (n, 3) of one path in two frames that differ by translation and yaw; z is up in both.

    x and y are compared together, and only if the horizontal path is not a straight line: a reflected line is a line.
    """
    if len(a) < 3:
        return Agreement("", "", None)
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    breadth_m = float(np.linalg.svd(a[:, :2], compute_uv=False)[1]) / len(a) ** 0.5
    compared = ("xy" if breadth_m >= min_rms_m else "") + ("z" if _rms(a[:, 2]) >= min_rms_m else "")
    wrong = _wrong(a, _yawed(a, b), compared)
    fits = [m for m in _permutations() if not _wrong(a, _yawed(a, b @ m.T), compared)] if wrong else []
    return Agreement(compared, wrong, _description(fits))


def _rms(values: Array64) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _wrong(a: Array64, b: Array64, compared: str) -> str:
    """Axes of `compared` along which a and b disagree."""
    wrong = ""
    for axis in compared:
        one, other = a[:, AXES.index(axis)], b[:, AXES.index(axis)]
        energy = float(other @ other)
        slope = float(one @ other) / energy if energy > 0 else 0.0
        fits = SLOPE[0] <= slope <= SLOPE[1] and _rms(one - other) <= MAX_RESIDUAL * _rms(one)
        wrong += "" if fits else axis
    return wrong


def _yawed(a: Array64, b: Array64) -> Array64:
    """b rotated about z to fit a by least squares: tan(yaw) = sum(b x a) / sum(b . a)."""
    cross = float(b[:, 0] @ a[:, 1] - b[:, 1] @ a[:, 0])
    dot = float(b[:, 0] @ a[:, 0] + b[:, 1] @ a[:, 1])
    return b @ rotation_z(float(np.arctan2(cross, dot))).T


def _description(fits: list[Array64]) -> str | None:
    """The permutation with the fewest changes, as text."""
    if not fits:
        return None
    best = max(fits, key=lambda m: float(np.trace(m)) + 0.1 * float(np.abs(np.diag(m)).sum()))
    changes: list[str] = []
    for k, row in enumerate(best):
        other = int(np.argmax(np.abs(row)))
        if other != k or row[other] < 0:
            changes.append(f"{AXES[k]} is measured as {'-' if row[other] < 0 else ''}{AXES[other]}")
    return ", ".join(changes)
