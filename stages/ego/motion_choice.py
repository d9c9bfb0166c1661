"""Which word on the vehicle's motion is believed: its own odometry while that is heard, else the camera's (ego).

    odometry heard      it is passed on as it comes
    odometry silent     the camera's motion goes on from where the vehicle was, and at the return the odometry again

Each source has a start frame of its own, and one that went away may come back with another. So at every change the new
source is laid on the old one's end:

    T_start_vehicle = T_start_source T_source_vehicle,   T_start_source = T_start_vehicle(t) T_source_vehicle(t)^-1

with t the new source's first stamp, to where the last motion is carried on. The start frame stays that of the first
source heard. Consumers take T_start_vehicle for smooth: they never see a jump, but drift.

Source: ours; P V.B for the camera's motion.
"""

from __future__ import annotations

from collections import deque
from enum import Enum
from typing import ClassVar

import numpy as np
from pydantic import Field, PrivateAttr

from flow.stage import Stage
from stages.ego.step import adjoint
from stages.geometry import Array64, transform
from stages.messages import VehicleMotion
from stages.rotation import exp_rotation, log_rotation, nearest_rotation

SILENT_S = 0.25  # so long no odometry: it is gone
ACCELERATION_MPS2 = 3.0  # one sigma, while nobody tells
TURN_RADPS2 = 0.5  # one sigma of how the turn rate changes
LEAST_SPAN_NS = 100_000_000  # of the last motion, over which its speed is taken
MOST_SPAN_NS = 1_000_000_000
CARRIED_S = 1.0  # so long the last motion is carried on, no longer


class Teller(Enum):
    """Who tells the vehicle's motion."""

    ODOMETRY = "odometry"
    EGO = "ego"


class VehicleMotionChoice(Stage):
    """T_start_vehicle without a jump, whoever tells it. Both inputs are optional, each may go and come back."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"odometry", "ego"})

    silent_s: float = Field(SILENT_S, gt=0, le=10)  # two periods of the odometry at least

    _teller: Teller | None = PrivateAttr(default=None)
    _odometry_ns: int | None = PrivateAttr(default=None)
    _told: deque[VehicleMotion] = PrivateAttr(default_factory=lambda: deque[VehicleMotion](maxlen=64))
    _T_start_source: Array64 = PrivateAttr(default_factory=lambda: np.eye(4))
    _joint: tuple[VehicleMotion, Array64 | None] | None = PrivateAttr(default=None)  # the source's word at the change

    def on_odometry(self, motion: VehicleMotion) -> VehicleMotion | None:
        """The vehicle's own odometry, passed on at once."""
        if self._odometry_ns is None or motion.stamp_ns > self._odometry_ns:
            self._odometry_ns = motion.stamp_ns
        return self._tell(Teller.ODOMETRY, motion)

    def on_ego(self, motion: VehicleMotion) -> VehicleMotion | None:
        """The camera's motion; None while the odometry is heard."""
        if self._odometry_ns is not None and motion.stamp_ns - self._odometry_ns < self.silent_s * 1e9:
            return None
        return self._tell(Teller.EGO, motion)

    def _tell(self, teller: Teller, motion: VehicleMotion) -> VehicleMotion | None:
        """None for what is not newer than what was told."""
        if self._told and motion.stamp_ns <= self._told[-1].stamp_ns:
            return None
        if teller is not self._teller:
            self._change_to(motion)
            self._teller = teller
        T = self._T_start_source @ transform(motion.R_start_vehicle, motion.xyz_start_m)
        told = VehicleMotion(
            stamp_ns=motion.stamp_ns,
            xyz_start_m=T[:3, 3].copy(),
            R_start_vehicle=nearest_rotation(np.ascontiguousarray(T[:3, :3])),
            covariance=self._covariance(motion),
        )
        self._told.append(told)
        return told

    def _change_to(self, motion: VehicleMotion) -> None:
        """Lay the new source on the end of the old one."""
        if not self._told:
            return
        at = carried_on(list(self._told), motion.stamp_ns)
        there = transform(motion.R_start_vehicle, motion.xyz_start_m)
        self._T_start_source = transform(at.R_start_vehicle, at.xyz_start_m) @ np.linalg.inv(there)
        self._joint = motion, at.covariance
        self._told.clear()  # its speed is told by the new source alone

    def _covariance(self, motion: VehicleMotion) -> Array64 | None:
        """What was uncertain at the change, and what the source says it has become worse by since."""
        if self._joint is None or motion.covariance is None:
            return motion.covariance if self._joint is None else None
        first, P = self._joint
        if P is None or first.covariance is None:
            return None
        T_now_first = np.linalg.inv(transform(motion.R_start_vehicle, motion.xyz_start_m)) @ transform(
            first.R_start_vehicle, first.xyz_start_m
        )
        A = adjoint(np.ascontiguousarray(T_now_first[:3, :3]), T_now_first[:3, 3])
        worse, axes = np.linalg.eigh(motion.covariance - A @ first.covariance @ A.T)
        return A @ P @ A.T + (axes * np.maximum(worse, 0.0)) @ axes.T


def carried_on(told: list[VehicleMotion], stamp_ns: int) -> VehicleMotion:
    """Where the vehicle is some time after the last word (`told`, oldest first): on with its last motion, less sure.

    Its speed is that over the last tenth of a second or more; after CARRIED_S it is taken to stand where it is then,
    and what it is unsure by grows on.
    """
    last = told[-1]
    unheard_s = (stamp_ns - last.stamp_ns) * 1e-9
    spans_ns = ((last.stamp_ns - m.stamp_ns, m) for m in reversed(told))
    span_ns, before = next(((span, m) for span, m in spans_ns if span >= LEAST_SPAN_NS), (0, last))
    share = min(unheard_s, CARRIED_S) / (span_ns * 1e-9) if 0 < span_ns <= MOST_SPAN_NS else 0.0
    R = last.R_start_vehicle
    turn = log_rotation(np.ascontiguousarray(before.R_start_vehicle.T @ R))
    way_m = exp_rotation(-0.5 * turn) @ before.R_start_vehicle.T @ (last.xyz_start_m - before.xyz_start_m)  # own axes
    place_m, turn_rad = 0.5 * ACCELERATION_MPS2 * unheard_s**2, 0.5 * TURN_RADPS2 * unheard_s**2
    unsure = np.diag([turn_rad**2] * 3 + [place_m**2] * 3)
    return VehicleMotion(
        stamp_ns=stamp_ns,
        xyz_start_m=last.xyz_start_m + R @ exp_rotation(0.5 * share * turn) @ (share * way_m),
        R_start_vehicle=R @ exp_rotation(share * turn),
        covariance=None if last.covariance is None else last.covariance + unsure,
    )
