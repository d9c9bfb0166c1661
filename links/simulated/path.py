"""Smooth paths through timed waypoints, and the attitude that flying them takes.

Source: natural cubic spline; ours for the attitude: thrust along acceleration + gravity + drag.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from links.simulated.mesh import Array64
from stages.compiled import compiled

GRAVITY_MPS2 = 9.81
DRAG_PER_S = 0.3  # drag acceleration per speed of a small quadrotor


class Waypoint(BaseModel):
    """Where to be at a time after the start, world frame."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    t_s: float = Field(ge=0)
    xyz_m: tuple[float, float, float]
    yaw_deg: float = 0.0  # not wrapped: 350 to 370 turns by 20


class Path(BaseModel):
    """A natural cubic spline through the waypoints; one waypoint stands still."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    waypoints: tuple[Waypoint, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _times_grow(self) -> Self:
        times = [w.t_s for w in self.waypoints]
        if any(b <= a for a, b in pairwise(times)):
            raise ValueError("waypoints: t_s must grow from one to the next")
        return self

    def at(self, time_s: Array64) -> tuple[Array64, Array64, Array64, Array64]:
        """Position (n, 3), velocity (n, 3), acceleration (n, 3) and yaw (n,) [rad] at times (n,)."""
        knots = np.array([[*w.xyz_m, np.radians(w.yaw_deg)] for w in self.waypoints])
        value, slope, curve = natural_spline(np.array([w.t_s for w in self.waypoints]), knots, time_s)
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


@compiled
def rotations_z(angle_rad: Array64) -> Array64:
    """Rz for each angle: (n, 3, 3)."""
    rotations = np.zeros((len(angle_rad), 3, 3))
    for i in range(len(angle_rad)):
        c, s = np.cos(angle_rad[i]), np.sin(angle_rad[i])
        rotations[i, 0, 0], rotations[i, 0, 1] = c, -s
        rotations[i, 1, 0], rotations[i, 1, 1] = s, c
        rotations[i, 2, 2] = 1.0
    return rotations


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
    return _along(knot_s, knots, linear, M, cubic, time_s)


@compiled
def _along(
    knot_s: Array64, knots: Array64, linear: Array64, M: Array64, cubic: Array64, time_s: Array64
) -> tuple[Array64, Array64, Array64]:
    """y_i + s (linear_i + s (M_i / 2 + s cubic_i)) with s = t - t_i, and its derivatives."""
    shape = (len(time_s), knots.shape[1])
    value, slope, curve = np.empty(shape), np.zeros(shape), np.zeros(shape)
    for n in range(len(time_s)):
        t = min(max(time_s[n], knot_s[0]), knot_s[-1])
        i = min(max(np.searchsorted(knot_s, t, side="right") - 1, 0), len(knot_s) - 2)
        s = t - knot_s[i]
        for d in range(knots.shape[1]):
            value[n, d] = knots[i, d] + s * (linear[i, d] + s * (M[i, d] / 2 + s * cubic[i, d]))
            if t == time_s[n]:
                slope[n, d] = linear[i, d] + s * (M[i, d] + 3 * s * cubic[i, d])
                curve[n, d] = M[i, d] + 6 * s * cubic[i, d]
    return value, slope, curve
