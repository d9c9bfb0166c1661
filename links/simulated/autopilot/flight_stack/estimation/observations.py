"""Observations that wait for the horizon of the filter, external poses, and the filter's test ratios.

Source: ArduPilot EKF_Buffer.h (EKF_obs_buffer_t::recall).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from stages.geometry.frames import Array64

M = TypeVar("M")
OLD_NS = 100_000_000  # recall: an observation older than this before the horizon is dropped
MAX_WAITING = 64


@dataclass(frozen=True, slots=True)
class External:
    """An external pose in frame odom's axes (z up)."""

    time_ns: int
    xyz_m: Array64
    yaw_rad: float
    velocity_mps: Array64 | None
    position_sigma_m: float
    yaw_sigma_rad: float
    reset: bool  # its reset counter has changed


@dataclass(slots=True)
class InnovationRatios:
    """What EKF_STATUS_REPORT contains, and more; ratios are innovation test ratios, 1 at the gate."""

    velocity: float = 0.0
    position: float = 0.0
    height: float = 0.0
    yaw: float = 0.0


class ObservationBuffer(Generic[M]):
    """Observations with their times; `recall` takes the newest that the horizon has reached."""

    def __init__(self) -> None:
        self._waiting: list[tuple[int, M]] = []

    def push(self, time_ns: int, observation: M) -> None:
        """Add one; they may arrive out of order."""
        self._waiting.append((time_ns, observation))
        self._waiting.sort(key=lambda item: item[0])
        del self._waiting[:-MAX_WAITING]

    def recall(self, horizon_ns: int) -> M | None:
        """The newest at or before the horizon and not too old; it and all before it are removed."""
        newest: M | None = None
        while self._waiting and self._waiting[0][0] <= horizon_ns:
            time_ns, observation = self._waiting.pop(0)
            newest = observation if horizon_ns - time_ns < OLD_NS else None
        return newest

    def clear(self) -> None:
        """Forget all."""
        self._waiting.clear()
