"""Before and after as one SVG: how thick walls are, how far returns lie from them, one wall from above, the encoder.

Source: ours; charts of `links/evaluation/svg.py`.
"""

from __future__ import annotations

import math

import numpy as np

from links.evaluation.svg import BAD, BAND, GOOD, SOFT, Chart, Series
from stages.calibration.calibrate import Calibration
from stages.calibration.patches import Patches
from stages.calibration.result import CURVE, CURVE_POINTS, curve_rows
from stages.geometry.frames import Array64

WIDTH, HEIGHT, GAP = 620, 280, 12
MOST_POINTS = 2500
NEAR_M = 20.0  # walls farther away are thinly seen
WALL_M = 3.0  # of a wall are drawn, to either side
STYLE = "text{font:11px sans-serif;fill:#223}.title{font-weight:bold}"


def pictures(found: Calibration) -> str:
    """All pictures, two by two, as the text of an SVG file."""
    charts = [_thickness(found), _residuals(found), _wall(found), _encoder(found)]
    parts = [
        f'<g transform="translate({(WIDTH + GAP) * (i % 2)},{(HEIGHT + GAP) * (i // 2)})">{chart.svg()}</g>'
        for i, chart in enumerate(charts)
    ]
    wide, high = 2 * WIDTH + GAP, 2 * HEIGHT + GAP
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{wide}" height="{high}" viewBox="0 0 {wide} {high}">'
    ground = f'<rect width="{wide}" height="{high}" fill="#f6f7f9"/>'
    return "\n".join([head, f"<style>{STYLE}</style>{ground}", *parts, "</svg>", ""])


def _thickness(found: Calibration) -> Chart:
    t = found.thickness
    top = 1e3 * 1.1 * float(np.quantile(t.before_m, 0.98))
    before_m, after_m = t.medians_m
    title = f"patches: {1e3 * before_m:.1f} mm thick before, {1e3 * after_m:.1f} mm after"
    right = float(t.range_m.max())
    chart = Chart(title, "distance [m]", "thickness, RMS [mm]", (0.0, right), (0.0, top), (WIDTH, HEIGHT))
    step = max(1, len(t.range_m) // MOST_POINTS)
    chart.points(t.range_m[::step], 1e3 * t.before_m[::step], BAD, "before", radius=1.5)
    chart.points(t.range_m[::step], 1e3 * t.after_m[::step], GOOD, "after", radius=1.5)
    return chart


def _residuals(found: Calibration) -> Chart:
    off = [1e3 * _off_plane_m(placed.xyz_m, found.patches) for placed in (found.before, found.after)]
    far = float(np.quantile(np.abs(off[0]), 0.98))
    edges = np.linspace(-far, far, 81)
    middle = (edges[1:] + edges[:-1]) / 2
    counts = [np.histogram(values, edges)[0].astype(np.float64) for values in off]
    limits = (0.0, 1.05 * max(float(c.max()) for c in counts))
    chart = Chart("distance of returns from their patch", "[mm]", "returns", (-far, far), limits, (WIDTH, HEIGHT))
    for count, color, name in zip(counts, (BAD, GOOD), ("before", "after"), strict=True):
        chart.line(middle, count, color, name)
    return chart


def _wall(found: Calibration) -> Chart:
    """The wall on which the calibration shows most: along it, and how far from it, both as seen from above."""
    patches = found.patches
    upright = (np.abs(patches.normal[:, 2]) < 0.2) & (found.thickness.range_m < NEAR_M)
    gain = np.where(upright, found.thickness.before_m - found.thickness.after_m, -1.0)
    best = int(gain.argmax())
    normal, centre = patches.normal[best], patches.centre_m[best]
    along = np.cross([0.0, 0.0, 1.0], normal)
    chart_limits = (-WALL_M, WALL_M), (-150.0, 150.0)
    chart = Chart("one wall from above", "along [m]", "off the wall [mm]", *chart_limits, (WIDTH, HEIGHT))
    for placed, color, name in ((found.before, BAD, "before"), (found.after, GOOD, "after")):
        away = placed.xyz_m - centre
        u, v = away @ along, 1e3 * (away @ normal)
        near = np.nonzero((np.abs(u) < WALL_M) & (np.abs(v) < chart_limits[1][1]))[0]
        near = near[:: max(1, len(near) // MOST_POINTS)]
        chart.points(u[near], v[near], color, name, radius=1.2)
    return chart


def _encoder(found: Calibration) -> Chart:
    """The encoder's error over the sweep, without its mean, with a band of two sigmas."""
    travel = found.travel
    rows = curve_rows(travel)
    by_name = {finding.name: finding for finding in found.findings}
    x = np.degrees(np.linspace(travel.low_rad, travel.high_rad, CURVE_POINTS))
    before, after = (
        _bent(rows @ np.array([getattr(by_name[name], when) for name in CURVE])) for when in ("before", "after")
    )
    band = 2 * math.degrees(found.curve_sigma_rad)
    low, high = (float(f([f(before), f(after)])) for f in (np.min, np.max))
    limits = low - 1.3 * band - 0.01, high + 1.3 * band + 0.01
    chart = Chart("the encoder's error, its mean left out", "servo [deg]", "[deg]", (x[0], x[-1]), limits,
                  (WIDTH, HEIGHT))  # fmt: skip
    chart.band(x, after - band, after + band, BAND, "2 sigma")
    chart.line(x, before, SOFT, "rig before")
    chart.line(x, after, GOOD, "found" if not by_name[CURVE[0]].refused else "refused")
    return chart


def _bent(curve: Series) -> Series:
    return curve - curve.mean()


def _off_plane_m(xyz_m: Array64, patches: Patches) -> Array64:
    """Distance of returns (n, 3) from the plane through all of their patch."""
    known = np.where(np.isfinite(xyz_m), xyz_m, patches.on_plane_m)
    sizes = np.diff(np.append(patches.first, len(known)))
    centre = np.add.reduceat(known, patches.first, axis=0) / sizes[:, None]
    return np.einsum("ij,ij->i", known - centre[patches.patch], patches.normal[patches.patch])
