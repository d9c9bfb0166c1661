"""Smooth paths through timed waypoints, and the attitude that flying them takes.

Source: natural cubic spline, or SciPy's periodic one for a round; ours for the attitude: thrust along acceleration +
gravity + drag.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy.interpolate import CubicSpline

from links.simulated.kernels.motion import DRAG_PER_S, GRAVITY_MPS2, evaluate_cubics, rotations_z
from stages.geometry import Array64


class Waypoint(BaseModel):
    """Where to be at a time after the start, world frame."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    t_s: float = Field(ge=0)
    xyz_m: tuple[float, float, float]
    yaw_deg: float = 0.0  # not wrapped: 350 to 370 turns by 20


class Path(BaseModel):
    """A natural cubic spline through the waypoints; one waypoint stands still.

    With `period_s` the way is gone round and round: so long after the first waypoint it is back there, at the yaw of the
    first up to the whole turns that bring it nearest to the last one's.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    waypoints: tuple[Waypoint, ...] = Field(min_length=1)
    period_s: float | None = Field(default=None, ge=1)

    @model_validator(mode="after")
    def _times_grow(self) -> Self:
        times = [w.t_s for w in self.waypoints]
        if any(b <= a for a, b in pairwise(times)):
            raise ValueError("waypoints: t_s must grow from one to the next")
        if self.period_s is not None and not times[-1] - times[0] < self.period_s:
            raise ValueError("period_s: the last waypoint must come before the first one comes again")
        if self.period_s is not None and abs(10 * self.period_s - round(10 * self.period_s)) > 1e-6:
            raise ValueError("period_s: give whole tenths of a second")
        return self

    def at(self, time_s: Array64) -> tuple[Array64, Array64, Array64, Array64]:
        """Position (n, 3), velocity (n, 3), acceleration (n, 3) and yaw (n,) [rad] at times (n,)."""
        knot_s = np.array([w.t_s for w in self.waypoints])
        knots = np.array([[*w.xyz_m, np.radians(w.yaw_deg)] for w in self.waypoints])
        if self.period_s is None:
            value, slope, curve = natural_spline(knot_s, knots, time_s)
        else:
            value, slope, curve = periodic_spline(knot_s, knots, self.period_s, time_s)
        return value[:, :3], slope[:, :3], curve[:, :3], value[:, 3]

    def level_poses(self, time_s: Array64) -> tuple[Array64, Array64]:
        """T_world_x of something that stays level: rotations (n, 3, 3) and positions (n, 3)."""
        position, _, _, yaw = self.at(time_s)
        return rotations_z(yaw), position

    def flying_poses(self, time_s: Array64) -> tuple[Array64, Array64]:
        """T_world_drone of a multirotor: its z axis is where the thrust must point, its yaw the path's."""
        position, velocity, acceleration, yaw = self.at(time_s)
        up = acceleration + DRAG_PER_S * velocity + [0.0, 0.0, GRAVITY_MPS2]
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        forward = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)])
        left = np.cross(up, forward)
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        return np.stack([np.cross(left, up), left, up], axis=2), position


def natural_spline(knot_s: Array64, knots: Array64, time_s: Array64) -> tuple[Array64, Array64, Array64]:
    """Value, first and second derivative (n, d) at `time_s` of the natural cubic spline through knots (k, d).

    With h_i = t_{i+1} - t_i and M the second derivatives (M = 0 at both ends):
    h_{i-1} M_{i-1} + 2 (h_{i-1} + h_i) M_i + h_i M_{i+1} = 6 ((y_{i+1} - y_i) / h_i - (y_i - y_{i-1}) / h_{i-1}).
    Before the first and after the last knot the end value holds.
    """
    count = len(knot_s)
    if count == 1:
        still = np.zeros((len(time_s), knots.shape[1]))
        return still + knots[0], still, still.copy()
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
    return evaluate_cubics(knot_s, knots, linear, M, cubic, time_s)


def periodic_spline(
    knot_s: Array64, knots: Array64, period_s: float, time_s: Array64
) -> tuple[Array64, Array64, Array64]:
    """As `natural_spline`, through knots (k, 4) that come again each `period_s`, the yaw grown by whole turns."""
    turned = 2 * np.pi * np.round((knots[-1, 3] - knots[0, 3]) / (2 * np.pi))
    drift = np.array([0.0, 0.0, 0.0, turned / period_s])
    closed_s = np.append(knot_s, knot_s[0] + period_s)
    closed = np.vstack([knots, knots[0] + drift * period_s]) - drift * closed_s[:, None]
    closed[-1] = closed[0]  # to the last bit
    spline = CubicSpline(closed_s, closed, bc_type="periodic")
    return spline(time_s) + drift * time_s[:, None], spline(time_s, 1) + drift, spline(time_s, 2)
