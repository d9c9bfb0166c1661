"""Figures of a calibration, before and after, as one SVG: patches, residuals, a wall, the error of the encoder.

Source: grd; drawn by matplotlib, which is not a package of the runtime (extra `evaluate`).
"""

from __future__ import annotations

import io
import math

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stages.calibration.calibrate import Calibration
from stages.calibration.patches import Patches
from stages.calibration.result import CURVE, CURVE_POINTS, curve_rows
from stages.geometry.frames import Array64

SIZE_IN = (13.0, 6.2)
MAX_POINTS = 2500
NEAR_M = 20.0  # farther walls have few returns
WALL_M = 3.0  # of a wall are drawn, to either side
OFF_MM = 150.0  # off a wall are drawn, to either side
BEFORE, AFTER, BAND, SOFT = "#d12f2f", "#2563c9", "#9db8e8", "#8a93a3"


def draw(found: Calibration) -> str:
    """All figures, two by two, as the text of an SVG file."""
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "grd", "font.size": 9, "axes.titlesize": 10}):
        figure = Figure(figsize=SIZE_IN, layout="constrained")
        (thickness, residuals), (wall, encoder) = figure.subplots(2, 2)
        _thickness(thickness, found)
        _residuals(residuals, found)
        _wall(wall, found)
        _encoder(encoder, found)
        for axes in (thickness, residuals, wall, encoder):
            axes.grid(color="#e3e7ee")
            axes.set_axisbelow(True)
            axes.legend(frameon=False, loc="upper right")
        stream = io.StringIO()
        figure.savefig(stream, format="svg", metadata={"Date": None})
        return stream.getvalue()


def _thickness(axes: Axes, found: Calibration) -> None:
    t = found.thickness
    before_m, after_m = t.medians_m
    step = max(1, len(t.range_m) // MAX_POINTS)
    for thickness_m, color, name in ((t.before_m, BEFORE, "before"), (t.after_m, AFTER, "after")):
        axes.plot(t.range_m[::step], 1e3 * thickness_m[::step], ".", color=color, label=name, markersize=3)
    axes.set(
        title=f"patches: {1e3 * before_m:.1f} mm thick before, {1e3 * after_m:.1f} mm after",
        xlabel="distance [m]",
        ylabel="thickness, RMS [mm]",
        xlim=(0.0, float(t.range_m.max())),
        ylim=(0.0, 1e3 * 1.1 * float(np.quantile(t.before_m, 0.98))),
    )


def _residuals(axes: Axes, found: Calibration) -> None:
    off_mm = [1e3 * _off_plane_m(placed.xyz_m, found.patches) for placed in (found.before, found.after)]
    far = float(np.quantile(np.abs(off_mm[0]), 0.98))
    for values, color, name in zip(off_mm, (BEFORE, AFTER), ("before", "after"), strict=True):
        axes.hist(values, bins=80, range=(-far, far), histtype="step", color=color, label=name)
    axes.set(title="distance of returns from their patch", xlabel="[mm]", ylabel="returns", xlim=(-far, far))


def _wall(axes: Axes, found: Calibration) -> None:
    """The wall on which the calibration improves most: along it, and off it, from above."""
    patches = found.patches
    upright = (np.abs(patches.normal[:, 2]) < 0.2) & (found.thickness.range_m < NEAR_M)
    gain = np.where(upright, found.thickness.before_m - found.thickness.after_m, -1.0)
    best = int(gain.argmax())
    normal, centre = patches.normal[best], patches.centre_m[best]
    along = np.cross([0.0, 0.0, 1.0], normal)
    for placed, color, name in ((found.before, BEFORE, "before"), (found.after, AFTER, "after")):
        from_centre = placed.xyz_m - centre
        u, v = from_centre @ along, 1e3 * (from_centre @ normal)
        near = np.nonzero((np.abs(u) < WALL_M) & (np.abs(v) < OFF_MM))[0]
        near = near[:: max(1, len(near) // MAX_POINTS)]
        axes.plot(u[near], v[near], ".", color=color, label=name, markersize=2)
    axes.set(title="one wall from above", xlabel="along [m]", ylabel="off the wall [mm]")
    axes.set(xlim=(-WALL_M, WALL_M), ylim=(-OFF_MM, OFF_MM))


def _encoder(axes: Axes, found: Calibration) -> None:
    """The encoder's error over the sweep, without its mean, with a band of two sigmas."""
    travel = found.travel
    rows = curve_rows(travel)
    by_name = {finding.name: finding for finding in found.findings}
    x = np.degrees(np.linspace(travel.low_rad, travel.high_rad, CURVE_POINTS))
    curves = (rows @ np.array([getattr(by_name[name], when) for name in CURVE]) for when in ("before", "after"))
    before, after = (curve - curve.mean() for curve in curves)
    band = 2 * math.degrees(found.curve_sigma_rad)
    axes.fill_between(x, after - band, after + band, color=BAND, alpha=0.35, linewidth=0, label="2 sigma")
    axes.plot(x, before, color=SOFT, label="rig before")
    axes.plot(x, after, color=AFTER, label="rejected" if by_name[CURVE[0]].rejected else "found")
    axes.set(title="the encoder's error, its mean left out", xlabel="servo [deg]", ylabel="[deg]", xlim=(x[0], x[-1]))


def _off_plane_m(xyz_m: Array64, patches: Patches) -> Array64:
    """Distance of returns (n, 3) from the plane through all of their patch."""
    known = np.where(np.isfinite(xyz_m), xyz_m, patches.on_plane_m)
    sizes = np.diff(np.append(patches.first, len(known)))
    centre = np.add.reduceat(known, patches.first, axis=0) / sizes[:, None]
    return np.einsum("ij,ij->i", known - centre[patches.patch], patches.normal[patches.patch])
