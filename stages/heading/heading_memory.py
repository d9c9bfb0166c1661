"""The state of a drone that was lost, so that its heading is one hypothesis when a drone is found.

At the propagated position it is the same drone, and its heading is decided again. Elsewhere it may be another one, and
the remembered heading alone does not decide.

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.geometry.se3 import CHI2_999_3, mahalanobis2
from stages.heading.imu_buffer import ImuBuffer
from stages.heading.inertial_state import POSITION, InertialState

KEPT_NS = 120_000_000_000
SAME_NS = 15_000_000_000  # so long the propagated position identifies the drone
SAME_DRONE, MAYBE_ANOTHER = 0.9995, 0.9  # probability that the remembered heading holds
WIDEST_RAD = math.radians(20.0)


class HeadingMemory:
    """The newest state with a known heading."""

    def __init__(self, imu: ImuBuffer) -> None:
        self._imu = imu
        self._kept: tuple[int, InertialState] | None = None

    def remember(self, stamp_ns: int, state: InertialState) -> None:
        """Keep a state (one row)."""
        self._kept = stamp_ns, state

    def forget(self) -> None:
        """Drop the state."""
        self._kept = None

    def yaw(self, stamp_ns: int, xyz_map_m: Array64, covariance_m2: Array64) -> tuple[float, float, float] | None:
        """Yaw and sigma [rad] propagated by the gyroscope, and the probability that they hold for a drone found here.

        None: nothing is remembered, or its sigma has grown too large.
        """
        if self._kept is None or stamp_ns - self._kept[0] > KEPT_NS:
            return None
        kept_ns, state = self._kept
        state = self._imu.propagate(state, np.ones(1), kept_ns, stamp_ns)
        sigma = math.sqrt(float(state.yaw_variance_rad2[0]))
        if sigma > WIDEST_RAD:
            return None
        S = covariance_m2 + state.covariance[0, POSITION, POSITION]
        same = mahalanobis2(xyz_map_m - state.xyz_m[0], S) <= CHI2_999_3 and stamp_ns - kept_ns < SAME_NS
        return float(state.yaw_rad[0]), sigma, SAME_DRONE if same else MAYBE_ANOTHER
