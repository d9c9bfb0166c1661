"""The pictures of one evaluation: where, how far off, how sure, how many returns, in what state.

Source: ours. Time counts from the start of what is judged. Long series are thinned to MAX_POINTS, but the worst of each
stretch is what is kept: thinning may not hide a fault.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from links.evaluation.catalogue import BANDS_M
from links.evaluation.consistency import BRANCH_RAD
from links.evaluation.errors import AtOutputs
from links.evaluation.judged import Evaluation
from links.evaluation.statistics import chi2_density
from links.evaluation.svg import BAD, BAND, GOOD, INK, SOFT, TRUTH, Chart, Series, limits_of, same_scale

MAX_POINTS = 1500
WIDE, SQUARE, LOW = (960, 220), (474, 400), (960, 130)
HALF = (474, 260)
STATE_COLORS = {
    "SEARCHING": "#e9b44c",
    "CANDIDATE": "#7fa8d9",
    "TRACKING": "#3aa76d",
    "COASTING": "#b5d99c",
    "LOST": "#d12f2f",
}
MAX_LANES = 8  # tracks whose states are drawn
BIN_NS = 120_000_000  # returns of the drone are counted per tracker frame of the paper


def plots(e: Evaluation) -> list[str]:
    """All pictures this evaluation has data for, as SVG."""
    if e.span_ns is None:
        return []
    made = [*_views(e), *_over_time(e), *_axes(e), *_hits(e), *_honesty(e), *_by_range(e), *_lanes(e), *_rotation(e)]
    return [chart.svg() for chart in made]


def worst_of_each(values: Series) -> NDArray[np.int64]:
    """Indices of at most MAX_POINTS values: of each stretch the largest."""
    n = len(values)
    if n <= MAX_POINTS:
        return np.arange(n)
    edges = np.linspace(0, n, MAX_POINTS + 1).astype(np.int64)
    ranked = np.nan_to_num(values, nan=-np.inf)
    return np.array([a + int(np.argmax(ranked[a:b])) for a, b in pairwise(edges)])


def _seconds(e: Evaluation, stamps_ns: NDArray[np.int64]) -> Series:
    assert e.span_ns is not None
    return (stamps_ns - e.span_ns[0]) / 1e9


def _duration(e: Evaluation) -> tuple[float, float]:
    assert e.span_ns is not None
    return 0.0, (e.span_ns[1] - e.span_ns[0]) / 1e9


def _wrong(e: Evaluation, at: AtOutputs) -> NDArray[np.bool_]:
    return at.distance_m > e.limits.wrong_m


def _views(e: Evaluation) -> list[Chart]:
    """From above and from the side, to scale."""
    outputs = e.output.poses.xyz_m
    truth = np.zeros((0, 3)) if e.run.truth is None else e.run.truth.xyz_m
    truth = truth[:: max(1, len(truth) // MAX_POINTS)]
    if e.at is None:
        kept, wrong = outputs[:: max(1, len(outputs) // MAX_POINTS)], np.zeros(0, dtype=np.bool_)
        wrong = np.zeros(len(kept), dtype=np.bool_)
    else:
        rows = worst_of_each(e.at.distance_m)
        kept, wrong = outputs[e.at.index[rows]], _wrong(e, e.at)[rows]
    charts: list[Chart] = []
    for title, names, across, up in (
        ("from above", ("x forward [m]", "y left [m]"), lambda p: p[:, 0], lambda p: p[:, 1]),
        (
            "from the side",
            ("distance over ground [m]", "z up [m]"),
            lambda p: np.hypot(p[:, 0], p[:, 1]),
            lambda p: p[:, 2],
        ),
    ):
        origin = np.zeros(1)
        x = limits_of(across(truth), across(kept), origin)
        y = limits_of(up(truth), up(kept), origin)
        chart = Chart(title, *names, *same_scale(x, y, SQUARE), SQUARE)
        chart.line(across(truth), up(truth), TRUTH, "truth" if len(truth) else "", width=2)
        chart.points(across(kept[~wrong]), up(kept[~wrong]), GOOD, "output")
        chart.points(across(kept[wrong]), up(kept[wrong]), BAD, f"off by > {e.limits.wrong_m:g} m", radius=4)
        chart.points(origin, origin, INK, "vehicle", radius=4)
        charts.append(chart)
    return charts


def _over_time(e: Evaluation) -> list[Chart]:
    """3D error of the last output, at every moment; no output is red ground."""
    if e.over is None or e.at is None or not len(e.over.at_ns):
        return []
    t, held = _seconds(e, e.over.at_ns), e.over.held_m
    top = 1.1 * max(limits_of(held, e.at.distance_m, margin=0)[1], e.limits.wrong_m)
    chart = Chart("3D error over time", "time [s]", "error [m]", _duration(e), (0.0, top), WIDE)
    for start, end in _stretches(~e.over.fresh):
        chart.box((t[start], t[end - 1] + 0.02), (0.0, top), BAD, 0.12)
    chart.named("#f6d5d5", f"no output for {e.limits.max_age_s:g} s")
    limit = np.full(2, e.limits.wrong_m)
    chart.line(np.array(_duration(e)), limit, BAD, width=1, dash="4 4")
    rows = worst_of_each(held)
    chart.line(t[rows], held[rows], SOFT, "last output held", width=1.2)
    rows = worst_of_each(e.at.distance_m)
    wrong = _wrong(e, e.at)[rows]
    at_s, off_m = _seconds(e, e.at.stamps_ns[rows]), e.at.distance_m[rows]
    chart.points(at_s[~wrong], off_m[~wrong], GOOD, "output")
    chart.points(at_s[wrong], off_m[wrong], BAD, f"off by > {e.limits.wrong_m:g} m", radius=3)
    return [chart]


def _axes(e: Evaluation) -> list[Chart]:
    """Signed errors along the vehicle's axes inside what the covariance promises."""
    at = e.at
    if at is None or not len(at.index):
        return []
    rows = worst_of_each(at.distance_m)
    t = _seconds(e, at.stamps_ns[rows])
    charts: list[Chart] = []
    for axis, name in enumerate(("x forward", "y left", "z up")):
        error = at.error_m[rows, axis]
        band = np.zeros(0)
        if at.covariance_m2 is not None:
            band = 3 * np.sqrt(np.maximum(at.covariance_m2[rows, axis, axis], 0))
        chart = Chart(
            f"error along {name}",
            "time [s]",
            "error [m]",
            _duration(e),
            limits_of(error, band, -band, margin=0.1),
            WIDE,
        )
        if len(band):
            chart.band(t, -band, band, BAND, "3 sigma promised")
        chart.points(t, error, GOOD, "output - truth")
        if len(band):
            outside = np.abs(error) > band
            chart.points(t[outside], error[outside], BAD, "beyond 3 sigma")
        charts.append(chart)
    return charts


def _hits(e: Evaluation) -> list[Chart]:
    """Returns used for each output, and how many the drone gave."""
    used, given = e.output.hits, e.run.drone_hits_ns
    if (used is None or not len(used)) and given is None:
        return []
    assert e.span_ns is not None
    counts, middles = np.zeros(0), np.zeros(0)
    if given is not None:
        edges = np.arange(e.span_ns[0], e.span_ns[1] + BIN_NS, BIN_NS)
        counts = np.histogram(given, edges)[0].astype(np.float64)
        middles = _seconds(e, edges[:-1] + BIN_NS // 2)
    top = 1.1 * max(1.0, float(counts.max(initial=0)), 0.0 if used is None else float(used.max(initial=0)))
    chart = Chart("returns of the drone", "time [s]", "returns", _duration(e), (0.0, top), WIDE)
    if given is not None:
        chart.line(middles, counts, TRUTH, "returned by the drone in 0.12 s (truth)")
    if used is not None:
        chart.points(_seconds(e, e.output.poses.stamps_ns), used.astype(np.float64), GOOD, "used for an output")
    return [chart]


def _honesty(e: Evaluation) -> list[Chart]:
    """NEES beside chi-square: to the left is too careful, to the right promises too much."""
    if e.at is None or e.at.nees is None or not len(e.at.nees):
        return []
    nees = e.at.nees[np.isfinite(e.at.nees)]
    edges = np.linspace(0, 16, 33)
    share = np.histogram(np.minimum(nees, 15.99), edges)[0] / max(len(nees), 1) / np.diff(edges)
    x = np.linspace(0.01, 16, 200)
    density = chi2_density(x, 3)
    top = max(float(share.max(initial=0)), float(density.max())) * 1.1
    chart = Chart("NEES of position", "NEES; the last bar holds all beyond 15.5", "density", (0, 16), (0, top), HALF)
    for low, high, height in zip(edges[:-1], edges[1:], share, strict=True):
        chart.box((low, high), (0.0, height), BAD if low >= 15.5 else GOOD, 0.6)
    chart.named(GOOD, "this run")
    chart.line(x, density, INK, "honest: chi2(3)")
    return [chart]


def _by_range(e: Evaluation) -> list[Chart]:
    """Error against true range, and the RMSE of each band."""
    at = e.at
    if at is None or not len(at.index):
        return []
    rows = worst_of_each(at.distance_m)
    x = (0.0, max(limits_of(at.range_m)[1], 10.0))
    chart = Chart("error by range", "true range [m]", "3D error [m]", x, (0, limits_of(at.distance_m)[1] * 1.1), HALF)
    wrong = _wrong(e, at)[rows]
    chart.points(at.range_m[rows][~wrong], at.distance_m[rows][~wrong], GOOD, "output")
    chart.points(at.range_m[rows][wrong], at.distance_m[rows][wrong], BAD)
    for low, high in BANDS_M:
        inside = (at.range_m >= low) & (at.range_m < high)
        if inside.any():
            rmse = float(np.sqrt(np.mean(np.square(at.distance_m[inside]))))
            chart.line(np.array([low, min(high, x[1])]), np.array([rmse, rmse]), INK, "RMSE of the band", width=2)
    return [chart]


def _lanes(e: Evaluation) -> list[Chart]:
    """What the tracker said it was doing, a lane for each track, over whether there was an output and it was right."""
    states, span = e.run.states, _duration(e)
    if not states and e.over is None:
        return []
    chart = Chart("states", "time [s]", "", span, (0.0, 2.0), LOW)
    chart.without_y_ticks()
    tracks = sorted({track for _, _, track in states})[:MAX_LANES]
    height = 0.9 / max(1, len(tracks))
    for lane, number in enumerate(tracks):
        own = [(at, state) for at, state, track in states if track == number]
        since = [*(float(_seconds(e, np.array([at]))[0]) for at, _ in own), span[1]]
        low = 1.95 - (lane + 1) * height
        for (_, state), start, end in zip(own, since[:-1], since[1:], strict=True):
            chart.box((start, end), (low, low + 0.9 * height), STATE_COLORS.get(state, SOFT), 0.85)
            if end - start > 0.06 * span[1] and len(tracks) < 3:
                chart.text(start + 0.005 * span[1], low + 0.45 * height, state)
    if e.over is not None:
        t = _seconds(e, e.over.at_ns)
        right = e.over.fresh & (np.nan_to_num(e.over.held_m, nan=np.inf) <= e.limits.wrong_m)
        for flags, color, name in (
            (right, "#3aa76d", "right"),
            (e.over.fresh & ~right, BAD, "wrong"),
            (~e.over.fresh, "#d5d9e0", "no output"),
        ):
            chart.named(color, name)
            for start, end in _stretches(flags):
                chart.box((t[start], t[end - 1] + 0.02), (0.1, 0.9), color, 0.9)
    return [chart]


def _rotation(e: Evaluation) -> list[Chart]:
    """How far off the nearest branch of the rotation is, coloured by whether it was the branch given."""
    turned, told = e.turned, e.run.rotations
    if turned is None or told is None or not len(turned.stamps_ns):
        return []
    rows = worst_of_each(turned.modulo.angle_rad)
    t, off_deg = _seconds(e, turned.stamps_ns[rows]), np.degrees(turned.modulo.angle_rad[rows])
    top = 1.1 * max(limits_of(off_deg, margin=0)[1], 0.1)
    title = "rotation by both cameras, modulo quarter turns"
    chart = Chart(title, "time [s]", "error [deg]", _duration(e), (0.0, top), WIDE)
    refused = _seconds(e, told.stamps_ns[~told.accepted])
    chart.points(refused, np.zeros(len(refused)), SOFT, "no rotation" if len(refused) else "")
    wrong, resolved = turned.given.angle_rad[rows] > BRANCH_RAD, turned.resolved[rows]
    for flags, color, name, radius in (
        (~wrong & ~resolved, TRUTH, "branch right", 2),
        (~wrong & resolved, GOOD, "branch right, RESOLVED", 2),
        (wrong & ~resolved, INK, "branch wrong", 3),
        (wrong & resolved, BAD, "branch wrong, RESOLVED", 4),
    ):
        if flags.any():
            chart.points(t[flags], off_deg[flags], color, name, radius=radius)
    return [chart]


def _stretches(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Runs of True as [start, end)."""
    edges = np.nonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))[0]
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
