"""A chart as SVG text: axes, lines, points, bands, boxes. No fonts, scripts or files from outside.

Source: ours; matplotlib would be 150 MB for six kinds of plot.
"""

from __future__ import annotations

import math
from html import escape

import numpy as np
from numpy.typing import NDArray

LEFT, RIGHT, TOP, BOTTOM = 56, 12, 26, 38
INK, GRID, TRUTH, GOOD, BAD, BAND, SOFT = "#223", "#dde2ea", "#1b7f4b", "#2563c9", "#d12f2f", "#9db8e8", "#8a93a3"
Series = NDArray[np.float64]


class Chart:
    """One chart with linear axes. Content is clipped to the axes' limits."""

    def __init__(
        self,
        title: str,
        x_label: str,
        y_label: str,
        x: tuple[float, float],
        y: tuple[float, float],
        size: tuple[int, int],
    ) -> None:
        self.x, self.y = _widened(x), _widened(y)
        self.width, self.height = size
        self._title, self._labels = title, (x_label, y_label)
        self._parts: list[str] = []
        self._legend: list[tuple[str, str]] = []
        self._y_ticks = True

    def px(self, values: Series | float) -> Series:
        """x in pixels."""
        share = (np.asarray(values, dtype=np.float64) - self.x[0]) / (self.x[1] - self.x[0])
        return LEFT + share * (self.width - LEFT - RIGHT)

    def py(self, values: Series | float) -> Series:
        """y in pixels."""
        share = (np.asarray(values, dtype=np.float64) - self.y[0]) / (self.y[1] - self.y[0])
        return self.height - BOTTOM - share * (self.height - TOP - BOTTOM)

    def line(self, x: Series, y: Series, color: str, name: str = "", width: float = 1.5, dash: str = "") -> None:
        """A polyline, broken where y is NaN."""
        self._name(color, name)
        for part in _pieces(x, y):
            points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(self.px(x[part]), self.py(y[part]), strict=True))
            dashed = f' stroke-dasharray="{dash}"' if dash else ""
            self._parts.append(
                f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="{width}"{dashed}/>'
            )

    def band(self, x: Series, low: Series, high: Series, color: str, name: str = "") -> None:
        """The area between two lines."""
        self._name(color, name)
        if len(x) < 2:
            return
        xs, ys = np.concatenate([x, x[::-1]]), np.concatenate([high, low[::-1]])
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(self.px(xs), self.py(ys), strict=True))
        self._parts.append(f'<polygon points="{points}" fill="{color}" fill-opacity="0.35"/>')

    def points(self, x: Series, y: Series, color: str, name: str = "", radius: float = 2.2) -> None:
        """Dots."""
        if len(x):
            self._name(color, name)
        for a, b in zip(self.px(x), self.py(y), strict=True):
            self._parts.append(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="{radius}" fill="{color}" fill-opacity="0.75"/>')

    def box(self, x: tuple[float, float], y: tuple[float, float], color: str, opacity: float = 1.0) -> None:
        """A filled rectangle in data units."""
        (x0, x1), (y1, y0) = self.px(np.array(x)), self.py(np.array(y))
        size = f'x="{x0:.1f}" y="{y0:.1f}" width="{max(x1 - x0, 0.7):.1f}" height="{max(y1 - y0, 0.5):.1f}"'
        self._parts.append(f'<rect {size} fill="{color}" fill-opacity="{opacity}"/>')

    def text(self, x: float, y: float, text: str, color: str = INK) -> None:
        """A word at a place in data units."""
        at = f'x="{float(self.px(x)):.1f}" y="{float(self.py(y)):.1f}"'
        self._parts.append(f'<text {at} fill="{color}" dominant-baseline="middle">{escape(text)}</text>')

    def named(self, color: str, name: str) -> None:
        """A legend entry for what `box` drew."""
        self._name(color, name)

    def without_y_ticks(self) -> None:
        """For lanes, where y means nothing."""
        self._y_ticks = False

    def svg(self) -> str:
        """The chart as an SVG element."""
        w, h = self.width, self.height
        frame = f'x="{LEFT}" y="{TOP}" width="{w - LEFT - RIGHT}" height="{h - TOP - BOTTOM}"'
        clip = f"axes-{w}-{h}"  # charts of one size share their axes' rectangle
        out = [
            f'<svg viewBox="0 0 {w} {h}" width="{w}" height="{h}" role="img" aria-label="{escape(self._title)}">',
            f'<clipPath id="{clip}"><rect {frame}/></clipPath><rect {frame} fill="#fff" stroke="{GRID}"/>',
            *self._axes(),
            f'<g clip-path="url(#{clip})">{"".join(self._parts)}</g>',
            f'<text x="{LEFT}" y="16" class="title">{escape(self._title)}</text>',
            *self._legend_parts(),
        ]
        return "".join([*out, "</svg>"])

    def _name(self, color: str, name: str) -> None:
        if name and (color, name) not in self._legend:
            self._legend.append((color, name))

    def _axes(self) -> list[str]:
        w, h = self.width, self.height
        out: list[str] = []
        for value in ticks(*self.x, most=8):
            x = float(self.px(value))
            out.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{h - BOTTOM}" stroke="{GRID}"/>')
            out.append(f'<text x="{x:.1f}" y="{h - BOTTOM + 14}" text-anchor="middle">{value:g}</text>')
        for value in ticks(*self.y, most=5) if self._y_ticks else []:
            y = float(self.py(value))
            out.append(f'<line x1="{LEFT}" x2="{w - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" stroke="{GRID}"/>')
            out.append(f'<text x="{LEFT - 5}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>')
        x_label, y_label = (escape(label) for label in self._labels)
        middle = (TOP + h - BOTTOM) / 2
        out.append(f'<text x="{(LEFT + w - RIGHT) / 2}" y="{h - 6}" text-anchor="middle">{x_label}</text>')
        out.append(
            f'<text x="14" y="{middle}" text-anchor="middle" transform="rotate(-90 14 {middle})">{y_label}</text>'
        )
        return out

    def _legend_parts(self) -> list[str]:
        out: list[str] = []
        x = self.width - RIGHT
        for color, name in reversed(self._legend):
            x -= 7 * len(name) + 20
            out.append(f'<rect x="{x:.0f}" y="8" width="10" height="10" fill="{color}"/>')
            out.append(f'<text x="{x + 14:.0f}" y="17">{escape(name)}</text>')
        return out


def ticks(low: float, high: float, most: int) -> list[float]:
    """Round numbers within [low, high], at most `most` of them."""
    raw = (high - low) / most
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= raw * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [round(i * step, 12) for i in range(first, last + 1)]


def same_scale(
    x: tuple[float, float], y: tuple[float, float], size: tuple[int, int]
) -> tuple[tuple[float, float], ...]:
    """Limits widened so that a metre is as long across as up."""
    across, up = size[0] - LEFT - RIGHT, size[1] - TOP - BOTTOM
    metres_per_px = max((x[1] - x[0]) / across, (y[1] - y[0]) / up, 1e-3)
    half = metres_per_px * across / 2, metres_per_px * up / 2
    middle = (x[0] + x[1]) / 2, (y[0] + y[1]) / 2
    return (middle[0] - half[0], middle[0] + half[0]), (middle[1] - half[1], middle[1] + half[1])


def limits_of(*series: Series, margin: float = 0.05) -> tuple[float, float]:
    """From least to most of all finite values, with a margin."""
    values = np.concatenate([s[np.isfinite(s)] for s in series]) if series else np.zeros(0)
    if not len(values):
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    room = margin * (high - low)
    return low - room, high + room


def _widened(limits: tuple[float, float]) -> tuple[float, float]:
    low, high = limits
    return (low, high) if high - low > 1e-9 else (low - 0.5, low + 0.5)


def _pieces(x: Series, y: Series) -> list[slice]:
    """Runs of finite values."""
    fine = np.isfinite(x) & np.isfinite(y)
    edges = np.nonzero(np.diff(np.concatenate([[False], fine, [False]]).astype(np.int8)))[0]
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
