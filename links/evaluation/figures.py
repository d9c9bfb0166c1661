"""Figures of an evaluation as SVG: trajectory, errors over time, states, consistency, reliability.

Source: grd; drawn by matplotlib. Time is from the start of the evaluated span. Long series are thinned to MAX_POINTS by
keeping the worst value of each segment, so that no fault disappears.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from links.evaluation.errors import GRID_NS, rms
from links.evaluation.evaluation import Evaluation
from links.evaluation.pose_metrics import BANDS_M, BRANCH_RAD
from links.evaluation.text_files import Flags
from stages.geometry.frames import Array64

MAX_POINTS = 1000
MAX_LANES = 8  # tracks whose states are drawn
WIDTH_IN = 11.5
TRUTH, OUTPUT, FALSE, BAND, SOFT, NO_OUTPUT = "#1b7f4b", "#2563c9", "#d12f2f", "#9db8e8", "#8a93a3", "#d5d9e0"
STATE_COLORS = {
    "SEARCHING": "#e9b44c",
    "CANDIDATE": "#7fa8d9",
    "TRACKING": "#3aa76d",
    "COASTING": "#b5d99c",
    "LOST": "#d12f2f",
}
BIN_NS = 120_000_000  # returns of the drone are counted per frame of the paper's tracker
NEES_EDGES = np.linspace(0, 16, 33)
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "grd",  # the same file for the same data
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e3e7ee",
    "text.parse_math": False,  # names of states and configurations are data
    "legend.frameon": False,
}
Draw = Callable[[Axes], None]


def run_figures(e: Evaluation) -> list[str]:
    """All figures that an evaluation has data for, as SVG elements."""
    if e.span_ns is None:
        return []
    with rc_context(STYLE):
        return [svg(figure) for figure in (_trajectory(e), _over_time(e), _statistics(e)) if figure is not None]


def svg(figure: Figure) -> str:
    """A figure as an SVG element."""
    stream = io.StringIO()
    figure.savefig(stream, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    return stream.getvalue().partition("<svg")[1] + stream.getvalue().partition("<svg")[2]


def worst_of_each(values: Array64 | pd.Series) -> NDArray[np.int64]:
    """Indices of at most MAX_POINTS values: the largest of each segment."""
    n = len(values)
    if n <= MAX_POINTS:
        return np.arange(n)
    edges = np.linspace(0, n, MAX_POINTS + 1).astype(np.int64)
    ranked = np.nan_to_num(np.asarray(values), nan=-np.inf)
    return np.array([a + int(np.argmax(ranked[a:b])) for a, b in pairwise(edges)])


def _seconds(e: Evaluation, stamps_ns) -> Array64:
    assert e.span_ns is not None
    return (np.asarray(stamps_ns) - e.span_ns[0]) / 1e9


def _points(axes: Axes, x, y, color: str, label: str, marker: str = ".") -> None:
    if len(x):
        axes.plot(x, y, marker, color=color, label=label, markersize=4, alpha=0.8, markeredgewidth=1)


def _outputs_and_false(axes: Axes, x, y, false: Flags, limit_m: float) -> None:
    _points(axes, x[~false], y[~false], OUTPUT, "output")
    _points(axes, x[false], y[false], FALSE, f"false: off by > {limit_m:g} m", "x")


def _finish(axes: Axes, title: str, x_label: str = "", y_label: str = "") -> None:
    axes.set(title=title, xlabel=x_label, ylabel=y_label)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=8, borderaxespad=0.1, handlelength=1.4)


def _compress(axes: Axes, e: Evaluation, *values) -> None:
    """Logarithmic beyond `false_m` where errors are so large that small ones could not be read."""
    if any((np.abs(series) > 5 * e.limits.false_m).any() for series in values):
        axes.set_yscale("symlog", linthresh=e.limits.false_m)
        axes.yaxis.set_major_formatter("{x:g}")


def _trajectory(e: Evaluation) -> Figure:
    """From above and from the side, to scale."""
    truth = np.zeros((0, 3)) if e.run.truth is None else e.run.truth.xyz_m
    outputs = e.output.poses.xyz_m
    rows, false = np.arange(len(outputs)), np.zeros(len(outputs), dtype=np.bool_)
    if e.errors is not None:
        worst = e.errors.iloc[worst_of_each(e.errors.distance)]
        rows, false = worst.index.to_numpy(), worst.false.to_numpy()
    step = max(1, len(rows) // MAX_POINTS)
    truth, outputs, false = truth[:: max(1, len(truth) // MAX_POINTS)], outputs[rows[::step]], false[::step]
    figure = Figure(figsize=(WIDTH_IN, 4.4), layout="constrained")
    above, side = figure.subplots(1, 2)
    for axes, title, across, labels in (
        (above, "from above", lambda p: (p[:, 0], p[:, 1]), ("x forward [m]", "y left [m]")),
        (
            side,
            "from the side",
            lambda p: (np.hypot(p[:, 0], p[:, 1]), p[:, 2]),
            ("distance over ground [m]", "z up [m]"),
        ),
    ):
        if len(truth):
            axes.plot(*across(truth), color=TRUTH, label="truth", linewidth=1.2, zorder=3)
        _outputs_and_false(axes, *across(outputs), false, e.limits.false_m)
        axes.plot(0, 0, "s", color="black", label="vehicle", markersize=5)
        axes.set_aspect("equal", adjustable="datalim")
        _finish(axes, title, *labels)
    return figure


def _over_time(e: Evaluation) -> Figure | None:
    """Panels with one time axis: 3D error, error along each axis, rotation, returns, states."""
    lanes = min(len({track for _, _, track in e.run.states}), MAX_LANES)
    panels: list[tuple[float, Callable[[Axes, Evaluation], None]]] = []
    if e.errors is not None and e.held is not None:
        panels += [(2.1, _draw_error)] if len(e.held) else []
        panels += [(1.5, draw) for draw in (_draw_axis("x", "forward"), _draw_axis("y", "left"), _draw_axis("z", "up"))
                   if len(e.errors)]  # fmt: skip
    panels += [(1.5, _draw_yaw)] if _has_yaw_errors(e) else []
    panels += [(1.9, _draw_rotation)] if e.rotation_errors is not None and len(e.rotation_errors) else []
    panels += [(1.5, _draw_returns)] if e.run.target.returns_ns is not None or e.output.returns is not None else []
    panels += [(0.75 + 0.22 * lanes, _draw_states)] if lanes or e.held is not None else []
    if not panels or e.duration_s is None:
        return None
    heights = [height for height, _ in panels]
    figure = Figure(figsize=(WIDTH_IN, 0.4 + sum(heights)), layout="constrained")
    all_axes = np.atleast_1d(figure.subplots(len(panels), 1, sharex=True, height_ratios=heights))
    for axes, (_, draw) in zip(all_axes, panels, strict=True):
        draw(axes, e)
    all_axes[-1].set(xlim=(0.0, e.duration_s), xlabel="time [s]")
    return figure


def _has_yaw_errors(e: Evaluation) -> bool:
    marks = e.output.has_rotation
    return e.errors is not None and "yaw" in e.errors and marks is not None and bool(marks[e.errors.index].any())


def _draw_error(axes: Axes, e: Evaluation) -> None:
    """3D error of the outputs and of the newest one; times without a current output are shaded."""
    assert e.held is not None
    assert e.errors is not None
    for index, (start_s, length_s) in enumerate(_spans_s(e, ~e.held.current.to_numpy())):
        label = None if index else f"no output for {e.limits.max_age_s:g} s"
        axes.axvspan(start_s, start_s + length_s, color=FALSE, alpha=0.12, linewidth=0, label=label)
    held, errors = (frame.iloc[worst_of_each(frame.distance)] for frame in (e.held, e.errors))
    axes.plot(_seconds(e, held.stamp_ns), held.distance, color=SOFT, linewidth=1, label="last output held")
    axes.axhline(e.limits.false_m, color=FALSE, linewidth=0.8, linestyle="--")
    _outputs_and_false(axes, _seconds(e, errors.stamp_ns), errors.distance, errors.false.to_numpy(), e.limits.false_m)
    _compress(axes, e, errors.distance, held.distance)
    axes.set_ylim(bottom=0)
    _finish(axes, "3D error over time", y_label="error [m]")


def _draw_axis(axis: str, name: str) -> Callable[[Axes, Evaluation], None]:
    """Signed error along an axis of the vehicle."""

    def draw(axes: Axes, e: Evaluation) -> None:
        assert e.errors is not None
        errors = e.errors.iloc[worst_of_each(e.errors.distance)]
        sigma = errors[f"sigma_{axis}"].to_numpy() if "sigma" in errors else None
        _signed(axes, e, errors.stamp_ns, errors[axis].to_numpy(), sigma)
        _finish(axes, f"error along {axis} ({name})", y_label="error [m]")

    return draw


def _draw_yaw(axes: Axes, e: Evaluation) -> None:
    """Yaw error of the outputs whose rotation is known; sigma is that about the drone's z axis."""
    assert e.errors is not None
    assert e.output.has_rotation is not None
    known = e.errors.loc[e.output.has_rotation[e.errors.index]]
    errors = known.iloc[worst_of_each(known.yaw.abs())]
    covariance = e.output.covariance
    sigma = None if covariance is None else np.degrees(np.sqrt(covariance[errors.index, 2, 2]))
    _signed(axes, e, errors.stamp_ns, np.degrees(errors.yaw.to_numpy()), sigma)
    _finish(axes, "yaw error of the output", y_label="error [deg]")


def _signed(axes: Axes, e: Evaluation, stamps_ns, error: Array64, sigma: Array64 | None) -> None:
    """Signed errors with the 3 sigma band of their covariance."""
    t, beyond = _seconds(e, stamps_ns), np.zeros(len(error), dtype=np.bool_)
    if sigma is not None:
        axes.fill_between(t, -3 * sigma, 3 * sigma, color=BAND, alpha=0.4, linewidth=0, label="3 sigma")
        beyond = np.abs(error) > 3 * sigma
    _points(axes, t[~beyond], error[~beyond], OUTPUT, "output - truth")
    _points(axes, t[beyond], error[beyond], FALSE, "beyond 3 sigma", "x")
    _compress(axes, e, error)


def _draw_rotation(axes: Axes, e: Evaluation) -> None:
    """Error of the nearest yaw branch, by whether it is the published one and RESOLVED."""
    assert e.rotation_errors is not None
    assert e.run.rotations is not None
    rejected = _seconds(e, e.run.rotations.stamps_ns[~e.run.rotations.accepted])
    _points(axes, rejected, np.zeros(len(rejected)), SOFT, "no rotation", "|")
    errors = e.rotation_errors.iloc[worst_of_each(e.rotation_errors.angle)]
    wrong, resolved = errors.published_angle > BRANCH_RAD, errors.resolved
    for flags, color, label, marker in (
        (~wrong & ~resolved, TRUTH, "branch right", "."),
        (~wrong & resolved, OUTPUT, "branch right, RESOLVED", "."),
        (wrong & ~resolved, "black", "branch wrong", "x"),
        (wrong & resolved, FALSE, "branch wrong, RESOLVED", "x"),
    ):
        _points(axes, _seconds(e, errors.stamp_ns[flags]), np.degrees(errors.angle[flags]), color, label, marker)
    axes.set_ylim(bottom=0)
    _finish(axes, "rotation by both cameras, modulo 90 deg", y_label="error [deg]")


def _draw_returns(axes: Axes, e: Evaluation) -> None:
    """Returns used for each output, and how many came from the drone."""
    assert e.span_ns is not None
    if e.run.target.returns_ns is not None:
        edges = np.arange(e.span_ns[0], e.span_ns[1] + BIN_NS, BIN_NS)
        counts, middle_s = np.histogram(e.run.target.returns_ns, edges)[0], _seconds(e, edges[:-1] + BIN_NS // 2)
        axes.plot(middle_s, counts, color=TRUTH, linewidth=1, label="from the drone in 0.12 s (truth)")
    if e.output.returns is not None:
        _points(axes, _seconds(e, e.output.poses.stamps_ns), e.output.returns, OUTPUT, "used for an output")
    axes.set_ylim(bottom=0)
    _finish(axes, "returns of the drone", y_label="returns")


def _draw_states(axes: Axes, e: Evaluation) -> None:
    """State of each track, and whether there is an accurate output."""
    assert e.duration_s is not None
    rows: list[tuple[str, str, str, list[tuple[float, float]]]] = []  # lane, label, color, spans
    if e.held is not None:
        accurate, current = e.held.accurate.to_numpy(), e.held.current.to_numpy()
        named = (
            (accurate, "accurate", TRUTH),
            (current & ~accurate, "false", FALSE),
            (~current, "no output", NO_OUTPUT),
        )
        rows += [("output", label, color, _spans_s(e, flags)) for flags, label, color in named]
    for number in sorted({track for _, _, track in e.run.states})[:MAX_LANES]:
        own = [(at, state) for at, state, track in e.run.states if track == number]
        since = [*_seconds(e, [at for at, _ in own]).tolist(), e.duration_s]
        for (_, state), (start, end) in zip(own, pairwise(since), strict=True):
            rows.append((f"track {number}", state, STATE_COLORS.get(state, SOFT), [(start, end - start)]))
    lanes = list(dict.fromkeys(lane for lane, *_ in rows))
    labelled: set[str] = set()
    for lane, label, color, spans in rows:
        if spans:
            name = None if label in labelled else label
            axes.broken_barh(spans, (lanes.index(lane) + 0.1, 0.8), color=color, linewidth=0, label=name)
            labelled.add(label)
    axes.set_yticks(np.arange(len(lanes)) + 0.5, lanes)
    axes.set_ylim(0, len(lanes))
    axes.grid(visible=False, axis="y")
    _finish(axes, "states")


def _spans_s(e: Evaluation, flags: Flags) -> list[tuple[float, float]]:
    """Begin and length [s] of the times in `held` at which a flag is True."""
    assert e.held is not None
    edges = np.nonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))[0]
    t = _seconds(e, e.held.stamp_ns)
    return [(float(t[a]), float(t[b - 1] + GRID_NS / 1e9 - t[a])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _statistics(e: Evaluation) -> Figure | None:
    """Errors by range, and the NEES of the position: left of chi-square is conservative, right is overconfident."""
    if e.errors is None or e.errors.empty:
        return None
    figure = Figure(figsize=(WIDTH_IN, 3.0), layout="constrained")
    by_range, consistency = figure.subplots(1, 2)
    errors, right = e.errors.iloc[worst_of_each(e.errors.distance)], max(e.errors["range"].max(), 10.0)
    _outputs_and_false(by_range, errors["range"], errors.distance, errors.false.to_numpy(), e.limits.false_m)
    label = "RMSE of the band"
    for low, high in BANDS_M:
        here = e.errors[e.errors["range"].between(low, high, inclusive="left")]
        if len(here):
            by_range.plot([low, min(high, right)], [rms(here.distance)] * 2, color="black", label=label)
            label = None
    _compress(by_range, e, errors.distance)
    by_range.set(xlim=(0, 1.05 * right))
    by_range.set_ylim(bottom=0)
    _finish(by_range, "error by range", "true range [m]", "3D error [m]")
    if "nees" not in e.errors:
        consistency.remove()
        return figure
    nees, last = e.errors.nees.dropna(), NEES_EDGES[-2]
    weights = np.full(len(nees), 1 / max(len(nees), 1) / (NEES_EDGES[1] - NEES_EDGES[0]))
    consistency.hist(
        nees.clip(upper=last), NEES_EDGES.tolist(), weights=weights, color=OUTPUT, alpha=0.6, label="this run"
    )
    x = np.linspace(0.01, 16, 200)
    consistency.plot(x, stats.chi2.pdf(x, 3), color="black", linewidth=1.2, label="consistent: chi2(3)")
    _finish(consistency, "NEES of the position", f"NEES; the last bar holds all beyond {last:g}", "density")
    return figure


def reliability_figure(rows: pd.DataFrame) -> str:
    """Share of drones over the mean probability of each bin, with 95 % intervals (`groups.reliability`), as SVG."""
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 3.6), layout="constrained")
        shares, counts = figure.subplots(1, 2)
        shares.plot([0, 1], [0, 1], color=SOFT, linewidth=1, linestyle="--", label="calibrated")
        for index, (config, own) in enumerate(rows.groupby("config", sort=False)):
            error = np.abs(own[["share_low", "share_high"]].to_numpy() - own[["share"]].to_numpy()).T
            name = str(config) or "runs"
            shares.errorbar(own["mean"], own.share, error, fmt="o-", markersize=4, linewidth=1, capsize=2, label=name)
            counts.plot((own.low + own.high) / 2 + 0.008 * index, own.candidates, "o", markersize=4, label=name)
        counts.set_yscale("log")
        counts.yaxis.set_major_formatter("{x:g}")
        _finish(shares, "reliability", "mean probability", "share of drones")
        _finish(counts, "candidates in each bin", "probability", "candidates")
        return svg(figure)
