"""Do two tellings of one motion have the same axes? If not: which axis is told as which.

a and b are the same vectors by two sources, row by row, and should be equal. An axis is judged where there was motion
along it; the slope of a on b is 1 where they agree, -1 where the sign is wrong, near 0 where another axis is told. If
an axis does not agree, the exchange of axes and signs that explains the motion best is named.

Positions may differ by a place and by the direction of north: for those b is moved and turned about the vertical first.

Source: ours; least squares. The 48 exchanges are the symmetries of a cube, mirrored ones included.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache

import numpy as np

from stages.geometry.frames import Array64, rotation_z

AXES = "xyz"
SLOPE = (0.5, 2.0)
MOST_REST = 0.7  # of an axis: rms of what is left over, against its motion


@cache
def _exchanges() -> tuple[Array64, ...]:
    """All 48, unchanged first."""
    found: list[Array64] = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            found.append(matrix)
    return tuple(found)


@dataclass(frozen=True, slots=True)
class Agreement:
    """What came of a comparison."""

    seen: str  # axes along which there was motion, as "xz"
    wrong: str  # those of them that do not agree
    exchange: str | None  # where some are wrong: what would explain it, in words; None: no exchange does


def compare(a: Array64, b: Array64, least: float) -> Agreement:
    """Vectors (n, 3), (n, 3) that should be equal; an axis with less motion in `a` (rms) than `least` is not judged."""
    seen = "".join(axis for k, axis in enumerate(AXES) if len(a) and _rms(a[:, k]) >= least)
    wrong = _wrong(a, b, seen)
    return Agreement(
        seen, wrong, _explained([m for m in _exchanges() if not _wrong(a, b @ m.T, seen)]) if wrong else None
    )


def compare_paths(a: Array64, b: Array64, least_m: float) -> Agreement:
    """Positions (n, 3), (n, 3) of one path in two frames that differ by place and yaw; z is up in both.

    x and y are judged together, and only where the path is no straight line seen from above: a mirrored line is a line.
    """
    if len(a) < 3:
        return Agreement("", "", None)
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    breadth_m = float(np.linalg.svd(a[:, :2], compute_uv=False)[1]) / len(a) ** 0.5
    seen = ("xy" if breadth_m >= least_m else "") + ("z" if _rms(a[:, 2]) >= least_m else "")
    wrong = _wrong(a, _yawed(a, b), seen)
    fits = [m for m in _exchanges() if not _wrong(a, _yawed(a, b @ m.T), seen)] if wrong else []
    return Agreement(seen, wrong, _explained(fits))


def _rms(values: Array64) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _wrong(a: Array64, b: Array64, seen: str) -> str:
    """Axes of `seen` along which a and b do not agree."""
    wrong = ""
    for axis in seen:
        one, other = a[:, AXES.index(axis)], b[:, AXES.index(axis)]
        energy = float(other @ other)
        slope = float(one @ other) / energy if energy > 0 else 0.0
        fits = SLOPE[0] <= slope <= SLOPE[1] and _rms(one - other) <= MOST_REST * _rms(one)
        wrong += "" if fits else axis
    return wrong


def _yawed(a: Array64, b: Array64) -> Array64:
    """b turned about z to lie on a as well as it can: tan(yaw) = sum(b x a) / sum(b . a)."""
    cross = float(b[:, 0] @ a[:, 1] - b[:, 1] @ a[:, 0])
    dot = float(b[:, 0] @ a[:, 0] + b[:, 1] @ a[:, 1])
    return b @ rotation_z(float(np.arctan2(cross, dot))).T


def _explained(fits: list[Array64]) -> str | None:
    """The exchange with the fewest changes, in words."""
    if not fits:
        return None
    best = max(fits, key=lambda m: float(np.trace(m)) + 0.1 * float(np.abs(np.diag(m)).sum()))
    words: list[str] = []
    for k, row in enumerate(best):
        other = int(np.argmax(np.abs(row)))
        if other != k or row[other] < 0:
            words.append(f"{AXES[k]} is told as {'-' if row[other] < 0 else ''}{AXES[other]}")
    return ", ".join(words)
