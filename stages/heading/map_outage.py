"""The drone while the vehicle's motion is not known: its newest state before, propagated by its IMU.

Frame `map` may be another one when the vehicle's motion is known again, because an odometry may restart in a gap. If it
is the same one, LiDAR positions are near the propagated one: a prior, as after a restart of grd (`same_frame.py`).

Source: ours.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from stages.geometry.frames import Array64
from stages.heading.heading_memory import SAME_NS
from stages.heading.imu_buffer import ImuBuffer
from stages.heading.inertial_state import POSITION, VELOCITY, InertialState
from stages.heading.odometry_heading import OdomYaw
from stages.messages import DroneMotion, HeadingPrior

KEPT = 32  # states, one per LiDAR position: those of the last poses of the vehicle may be wrong already


class KnownState(NamedTuple):
    """State of the drone with a known heading, at a LiDAR position."""

    stamp_ns: int
    state: InertialState  # one row
    yaw_bias_rad2: float  # variance of the yaw that the state's covariance does not contain
    axes: OdomYaw | None  # of the autopilot


class MapOutage:
    """Recent states, and the one that is propagated over an outage."""

    def __init__(self) -> None:
        self._states: deque[KnownState] = deque(maxlen=KEPT)
        self._kept: KnownState | None = None
        self._imu = ImuBuffer()

    def add_state(self, known: KnownState) -> None:
        """Add a state: a heading is known, so that the one before the outage is not needed any more."""
        self._states.append(known)
        self._kept = None

    def begin(self, known_until_ns: int) -> None:
        """The vehicle's motion is not known after a time; without a state since an earlier outage its state is kept."""
        self._kept = next((kept for kept in reversed(self._states) if kept.stamp_ns <= known_until_ns), self._kept)
        self._states.clear()

    def forget(self) -> None:
        """Drop all states: they may be wrong, or lie in another frame."""
        self._states.clear()
        self._kept = None

    def add_motion(self, motion: DroneMotion) -> None:
        """An interval of the drone's IMU, always: no frame is needed to measure it."""
        self._imu.add(motion)

    def prior(self, stamp_ns: int) -> HeadingPrior | None:
        """The propagated state; None: there is none, or it is too old."""
        if self._kept is None or not 0 <= stamp_ns - self._kept.stamp_ns < SAME_NS:
            return None
        kept_ns, state, yaw_bias_rad2, axes = self._kept
        state = self._imu.propagate(state, np.ones(1), kept_ns, stamp_ns)
        covariance = state.covariance[0]
        sigma_rad = math.sqrt(float(state.yaw_variance_rad2[0]) + yaw_bias_rad2)
        return HeadingPrior(
            stamp_ns=stamp_ns,
            yaw_map_rad=float(state.yaw_rad[0]),
            yaw_map_odom_rad=math.nan if axes is None else axes.yaw_rad,
            sigma_rad=sigma_rad if axes is None else max(sigma_rad, axes.sigma_rad),
            xyz_map_m=state.xyz_m[0].copy(),
            position_sigma_m=_level_sigma(covariance[POSITION, POSITION]),
            velocity_map_mps=state.velocity_mps[0].copy(),
            velocity_sigma_mps=_level_sigma(covariance[VELOCITY, VELOCITY]),
        )


def _level_sigma(covariance: Array64) -> float:
    """The larger one of the two horizontal axes; covariance (3, 3)."""
    return math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
