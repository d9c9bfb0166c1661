"""Compiled functions that group the consecutive returns of each laser into chords.

Source: see `stages/detect/chords.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

# State of an open chord.
(
    HITS,  # 0: no chord is open
    SUM_X, SUM_Y, SUM_Z,  # of its points [m]
    FIRST_X, FIRST_Y, FIRST_Z,
    LAST_X, LAST_Y, LAST_Z,
    LAST_RANGE,
    LEAST_RANGE, MOST_RANGE,
    REFLECTIVITY,  # sum
    MISSED,  # pulses since the last hit
    HOLES,  # pulses between hits that were no hits
    FREE_BEFORE,  # 1: the pulse before the first went farther or returned nothing
    LONG_REPORTED,  # 1: too long, already reported
    U1, U2, U3, U4,  # sums of powers of u, the displacement across the line of sight since the first hit [m]
    R1, RU1, RU2, R2,  # and with r, the range over the first hit's [m]
    FIRST_RANGE,
    MEMORY,
) = range(28)  # fmt: skip
# Columns of the result.
X, Y, Z, RANGE, LENGTH, DEPTH, COUNT, GAPS, SHADE, FREE, LASER, LONG, BULGE, ROUGH = range(14)
FIRST, LAST = range(2)  # times of an open chord's first and last hit
# Open chords of a laser, each farther than the one before: until a beam is a hole's width past a rain drop at 1 m, it
# moves by 17 deg and crosses farther objects. Memory for rain of 5 mm/h, in which one drop is open on average.
DEPTHS = 4


@compiled
def _write_chord(memory: Array64, free_after: bool, laser: int, long: bool, row: Array64) -> None:
    hits = memory[HITS]
    for axis in range(3):
        row[X + axis] = memory[SUM_X + axis] / hits
    row[RANGE] = memory[LAST_RANGE]
    row[LENGTH] = math.sqrt(
        (memory[LAST_X] - memory[FIRST_X]) ** 2
        + (memory[LAST_Y] - memory[FIRST_Y]) ** 2
        + (memory[LAST_Z] - memory[FIRST_Z]) ** 2
    )
    row[DEPTH] = memory[MOST_RANGE] - memory[LEAST_RANGE]
    row[COUNT] = hits
    row[GAPS] = memory[HOLES]
    row[SHADE] = memory[REFLECTIVITY] / hits
    row[FREE] = memory[FREE_BEFORE] + (1.0 if free_after else 0.0)
    row[LASER] = laser
    row[LONG] = 1.0 if long else 0.0
    row[BULGE], row[ROUGH] = _profile(memory)


@compiled
def _profile(m: Array64) -> tuple[float, float]:
    """(b, s) of the parabola r = a_0 + a_1 u + b u^2 through a chord's hits and their distance from it, RMS [m].

    A ball of radius rho has b = 1 / (2 rho). NaN with fewer than 4 hits.
    """
    n = m[HITS]
    if n < 4.0:
        return math.nan, math.nan
    # normal equations about the means: u' = u - U1/n, v' = u^2 - U2/n
    uu, uv, vv = m[U2] - m[U1] ** 2 / n, m[U3] - m[U1] * m[U2] / n, m[U4] - m[U2] ** 2 / n
    ur, vr, rr = m[RU1] - m[U1] * m[R1] / n, m[RU2] - m[U2] * m[R1] / n, m[R2] - m[R1] ** 2 / n
    determinant = uu * vv - uv * uv
    if determinant <= 1e-9 * uu * vv:
        return math.nan, math.nan
    slope, bulge = (ur * vv - vr * uv) / determinant, (vr * uu - ur * uv) / determinant
    left = rr - slope * ur - bulge * vr
    return bulge, math.sqrt(max(left, 0.0) / (n - 3.0))


@compiled
def _begin(m: Array64, r: float, shade: float) -> None:
    """Start the sums of a chord at its first hit."""
    m[HITS], m[HOLES], m[REFLECTIVITY] = 1.0, 0.0, shade
    m[FIRST_RANGE] = m[LAST_RANGE] = m[LEAST_RANGE] = m[MOST_RANGE] = r
    for k in range(U1, R2 + 1):
        m[k] = 0.0


@compiled
def _add_to_profile(m: Array64, r: float, u2: float) -> None:
    """Add a hit to the sums, u^2 [m^2] across from the first."""
    u, dr = math.sqrt(u2), r - m[FIRST_RANGE]
    m[U1] += u
    m[U2] += u2
    m[U3] += u2 * u
    m[U4] += u2 * u2
    m[R1] += dr
    m[RU1] += dr * u
    m[RU2] += dr * u2
    m[R2] += dr * dr


@compiled
def _end_from(
    depth: int,
    laser: int,
    memory: Array64,
    times: NDArray[np.int64],
    rows: Array64,
    row_ns: NDArray[np.int64],
    count: int,
) -> int:
    """End a laser's chords from this depth on, as something hides how they continue; returns the new count of rows.

    One that at least two pulses had gone past before had ended there.
    """
    while depth < DEPTHS and memory[laser, depth, HITS] > 0.0:
        m = memory[laser, depth]
        _write_chord(m, m[MISSED] >= 2.0, laser, m[LONG_REPORTED] > 0.0, rows[count])
        row_ns[count] = times[laser, depth]
        count += 1
        m[HITS] = 0.0
        depth += 1
    return count


@compiled
def find_chords(
    stamp_ns: NDArray[np.int64],
    direction: NDArray[np.float32],
    range_m: NDArray[np.float32],
    laser: NDArray[np.uint8],
    reflectivity: NDArray[np.uint8],
    origin_m: Array64,
    longest_m: float,
    jump_m: float,
    hole_m: float,
    gap_ns: int,
    memory: Array64,
    times: NDArray[np.int64],
    newest: tuple[NDArray[np.int64], Array64],
    rows: Array64,
    row_ns: NDArray[np.int64],
) -> int:
    """Continue each laser's chords, pulse by pulse; fill rows and times of the completed chords, return their count.

    memory (lasers, DEPTHS, MEMORY), times (lasers, DEPTHS, 2): the open chords. newest: time and range [m] of each
    laser's last pulse; inf: nothing, NaN: not known.
    """
    count = 0
    newest_ns, before_m = newest
    point, before = np.empty(3), np.empty(3)
    for i in range(range_m.size):
        k = laser[i]
        r = float(range_m[i])
        seen = r > 0.0
        if stamp_ns[i] - newest_ns[k] > gap_ns:
            count = _end_from(0, k, memory, times, rows, row_ns, count)
            before_m[k] = math.nan
        newest_ns[k] = stamp_ns[i]
        depth, begins = 0, seen  # begins: whether a chord begins with this return
        while depth < DEPTHS and memory[k, depth, HITS] > 0.0:
            m = memory[k, depth]
            if seen and r - m[LAST_RANGE] < -jump_m:  # something nearer hides its continuation
                break
            if seen and r - m[LAST_RANGE] <= jump_m:
                m[HOLES] += m[MISSED]
                m[MISSED] = 0.0
                for axis in range(3):
                    point[axis] = origin_m[axis] + r * direction[i, axis]
                    m[SUM_X + axis] += point[axis]
                    m[LAST_X + axis] = point[axis]
                across2 = 0.0
                for axis in range(3):
                    across2 += (m[FIRST_RANGE] * direction[i, axis] - (m[FIRST_X + axis] - origin_m[axis])) ** 2
                _add_to_profile(m, r, across2)
                m[HITS] += 1.0
                m[REFLECTIVITY] += reflectivity[i]
                m[LAST_RANGE] = r
                m[LEAST_RANGE] = min(m[LEAST_RANGE], r)
                m[MOST_RANGE] = max(m[MOST_RANGE], r)
                times[k, depth, LAST] = stamp_ns[i]
                if across2 > longest_m * longest_m:  # a wall: reported in parts
                    _write_chord(m, False, k, True, rows[count])
                    row_ns[count] = times[k, depth]
                    count += 1
                    m[LONG_REPORTED] = 1.0
                    for axis in range(3):
                        m[SUM_X + axis] = point[axis]
                        m[FIRST_X + axis] = point[axis]
                    _begin(m, r, reflectivity[i])
                    times[k, depth, FIRST] = stamp_ns[i]
                begins = False
                count = _end_from(depth + 1, k, memory, times, rows, row_ns, count)
                break
            m[MISSED] += 1.0
            # how far the beam has moved away from the last hit, at the chord's range
            away2 = 0.0
            for axis in range(3):
                before[axis] = m[LAST_X + axis] - origin_m[axis]
                away2 += (m[LAST_RANGE] * direction[i, axis] - before[axis]) ** 2
            if m[MISSED] >= 2.0 and away2 > hole_m * hole_m:
                _write_chord(m, True, k, m[LONG_REPORTED] > 0.0, rows[count])
                row_ns[count] = times[k, depth]
                count += 1
                for d in range(depth, DEPTHS - 1):
                    memory[k, d] = memory[k, d + 1]
                    times[k, d] = times[k, d + 1]
                memory[k, DEPTHS - 1, HITS] = 0.0
            else:
                depth += 1
        if begins and depth < DEPTHS:  # nearer than the chords from this depth on
            count = _end_from(depth, k, memory, times, rows, row_ns, count)
            m = memory[k, depth]
            for axis in range(3):
                point[axis] = origin_m[axis] + r * direction[i, axis]
                m[SUM_X + axis] = point[axis]
                m[FIRST_X + axis] = point[axis]
                m[LAST_X + axis] = point[axis]
            _begin(m, r, reflectivity[i])
            m[MISSED], m[LONG_REPORTED] = 0.0, 0.0
            m[FREE_BEFORE] = 1.0 if before_m[k] > r + jump_m else 0.0
            times[k, depth] = stamp_ns[i]
        before_m[k] = r if seen else math.inf
    return count
