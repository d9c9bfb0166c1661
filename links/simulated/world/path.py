"""Smooth paths through timed waypoints, and the attitude of a multirotor that follows one.

Source: natural cubic spline, or SciPy's periodic one for a closed path. The attitude is ours: thrust points along
acceleration + gravity + drag.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from itertools import pairwise
from typing import Annotated, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator
from scipy.interpolate import CubicSpline

from flow.stage import StrictModel
from links.simulated.kernels.motion import DRAG_PER_S, GRAVITY_MPS2, evaluate_cubics, rotations_z
from stages.geometry.frames import Array64

Spline = Callable[[Array64], tuple[Array64, Array64, Array64]]
"""Value, first and second derivative (n, d) at times (n,)."""


def _from_before_to(span_s: tuple[float, float]) -> tuple[float, float]:
    if not span_s[0] < span_s[1]:
        raise ValueError("a time span is [from, to], with from before to")
    return span_s


TimeSpan = Annotated[tuple[float, float], AfterValidator(_from_before_to)]
"""(from, to) [s], times after the start."""


class Waypoint(StrictModel):
    """A position at a time after the start, world frame."""

    t_s: float = Field(ge=0)
    xyz_m: tuple[float, float, float]
    yaw_deg: float = 0.0  # not wrapped: 350 to 370 is a rotation by 20


class Path(StrictModel):
    """A natural cubic spline through the waypoints. A path with one waypoint is static.

    With `period_s` the path is closed: it returns to the first waypoint `period_s` after it, at the yaw of the first
    waypoint plus the whole turns that bring it nearest to the yaw of the last one.
    """

    waypoints: tuple[Waypoint, ...] = Field(min_length=1)
    period_s: float | None = Field(default=None, ge=1)

    @model_validator(mode="after")
    def _times_increase(self) -> Self:
        times = [w.t_s for w in self.waypoints]
        if any(b <= a for a, b in pairwise(times)):
            raise ValueError("waypoints: t_s must increase from one to the next")
        if self.period_s is not None and not times[-1] - times[0] < self.period_s:
            raise ValueError("period_s: it must be longer than the time from the first to the last waypoint")
        if self.period_s is not None and abs(10 * self.period_s - round(10 * self.period_s)) > 1e-6:
            raise ValueError("period_s: it must be a multiple of 0.1 s")
        return self

    @cached_property
    def _spline(self) -> Spline:
        knot_s = np.array([w.t_s for w in self.waypoints])
        knots = np.array([[*w.xyz_m, np.radians(w.yaw_deg)] for w in self.waypoints])
        if self.period_s is None:
            return natural_spline(knot_s, knots)
        return periodic_spline(knot_s, knots, self.period_s)

    def at(self, time_s: Array64) -> tuple[Array64, Array64, Array64, Array64]:
        """Position (n, 3), velocity (n, 3), acceleration (n, 3) and yaw (n,) [rad] at times (n,)."""
        value, slope, curve = self._spline(time_s)
        return value[:, :3], slope[:, :3], curve[:, :3], value[:, 3]

    def level_poses(self, time_s: Array64) -> tuple[Array64, Array64]:
        """T_world_x of a body that stays level: rotations (n, 3, 3) and positions (n, 3)."""
        position, _, _, yaw = self.at(time_s)
        return rotations_z(yaw), position

    def flying_poses(self, time_s: Array64) -> tuple[Array64, Array64]:
        """T_world_drone of a multirotor: its z axis is the required thrust direction, its yaw that of the path."""
        position, velocity, acceleration, yaw = self.at(time_s)
        up = acceleration + DRAG_PER_S * velocity + [0.0, 0.0, GRAVITY_MPS2]
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        forward = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)])
        left = np.cross(up, forward)
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        return np.stack([np.cross(left, up), left, up], axis=2), position


def natural_spline(knot_s: Array64, knots: Array64) -> Spline:
    """The natural cubic spline through knots (k, d) at times (k,).

    With h_i = t_{i+1} - t_i and M the second derivatives (M = 0 at both ends):
    h_{i-1} M_{i-1} + 2 (h_{i-1} + h_i) M_i + h_i M_{i+1} = 6 ((y_{i+1} - y_i) / h_i - (y_i - y_{i-1}) / h_{i-1}).
    Before the first and after the last knot the value is constant.
    """
    count = len(knot_s)
    if count == 1:
        return partial(_constant, knots[0])
    h = np.diff(knot_s)[:, None]
    chord = np.diff(knots, axis=0) / h
    A = np.eye(count)
    b = np.zeros_like(knots)
    inner = np.arange(1, count - 1)
    A[inner, inner - 1], A[inner, inner + 1] = h[:-1, 0], h[1:, 0]
    A[inner, inner] = 2 * (h[:-1, 0] + h[1:, 0])
    b[inner] = 6 * (chord[1:] - chord[:-1])
    M = np.asarray(np.linalg.solve(A, b), dtype=np.float64)
    linear = chord - h * (2 * M[:-1] + M[1:]) / 6
    cubic = (M[1:] - M[:-1]) / (6 * h)
    return partial(evaluate_cubics, knot_s, knots, linear, M, cubic)


def _constant(value: Array64, time_s: Array64) -> tuple[Array64, Array64, Array64]:
    constant = np.zeros((len(time_s), len(value)))
    return constant + value, constant, constant.copy()


def periodic_spline(knot_s: Array64, knots: Array64, period_s: float) -> Spline:
    """As `natural_spline`, through knots (k, 4) that repeat every `period_s`; the yaw may gain whole turns."""
    turns = 2 * np.pi * np.round((knots[-1, 3] - knots[0, 3]) / (2 * np.pi))
    drift = np.array([0.0, 0.0, 0.0, turns / period_s])
    closed_s = np.append(knot_s, knot_s[0] + period_s)
    closed = np.vstack([knots, knots[0] + drift * period_s]) - drift * closed_s[:, None]
    closed[-1] = closed[0]  # exactly, without rounding
    spline = CubicSpline(closed_s, closed, bc_type="periodic")
    return partial(_with_drift, spline, drift)


def _with_drift(spline: CubicSpline, drift: Array64, time_s: Array64) -> tuple[Array64, Array64, Array64]:
    return spline(time_s) + drift * time_s[:, None], spline(time_s, 1) + drift, spline(time_s, 2)
