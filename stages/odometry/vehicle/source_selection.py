"""Which word on the vehicle's motion is believed: its own odometry while that is heard, else the camera's (ego).

    odometry heard      it is passed on as it comes
    odometry silent     the camera's motion goes on from where the vehicle was, and at the return the odometry again
    nor believed        the same: what it tells is nonsense for as long

Each source has a start frame of its own, and one that went away may come back with another. So at every change the new
source is laid on the old one's end:

    T_map_vehicle = T_map_source T_source_vehicle,   T_map_source = T_map_vehicle(t) T_source_vehicle(t)^-1

with t the new source's first stamp, to where the vehicle went on (vehicle_onward.py). So it is, too, where a source's
own frame jumps: its words are left out until three tell of one smooth way elsewhere. The start frame stays that of the
first source heard. Consumers take T_map_vehicle for smooth: they never see a jump, but drift.

Source: ours; P V.B for the camera's motion.
"""

from __future__ import annotations

from collections import Counter, deque
from enum import Enum
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from flow.stage import Settings, Stage
from stages.geometry.extrapolation import AcceptedPoses, constant_turn_rate
from stages.geometry.frames import Array64, transform
from stages.geometry.se3 import adjoint
from stages.kernels.geometry.so3 import nearest_rotation
from stages.messages import VehicleMotion

SILENT_S = 0.25  # so long no odometry, or none that is believed: it is gone


class Teller(Enum):
    """Who tells the vehicle's motion."""

    ODOMETRY = "odometry"
    EGO = "ego"


class VehicleMotionSelectorSettings(Settings):
    """Settings of `VehicleMotionSelector`."""

    silent_s: float = Field(SILENT_S, gt=0, le=10)  # two periods of the odometry at least


class VehicleMotionSelector(Stage[VehicleMotionSelectorSettings]):
    """T_map_vehicle without a jump, whoever tells it. Both inputs are optional, each may go and come back."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"odometry", "ego"})

    def __init__(self, settings: VehicleMotionSelectorSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._teller: Teller | None = None
        self._words: dict[Teller, AcceptedPoses] = {t: AcceptedPoses() for t in Teller}
        self._told: deque[VehicleMotion] = deque(maxlen=64)
        self._T_start_source: Array64 = np.eye(4)
        self._joint: tuple[VehicleMotion, Array64 | None] | None = None  # the source's word at the change
        self._refused: Counter[str] = Counter()

    @property
    def refused(self) -> Counter[str]:
        """Words left out, by reason."""
        return self._refused

    @property
    def counters(self) -> dict[str, int]:
        """What is refused."""
        return {f"refused: {why}": count for why, count in self._refused.items()}

    def on_odometry(self, motion: VehicleMotion) -> VehicleMotion | None:
        """The vehicle's own odometry, passed on at once."""
        return self._tell(Teller.ODOMETRY, motion)

    def on_ego(self, motion: VehicleMotion) -> VehicleMotion | None:
        """The camera's motion; None while the odometry is heard and believed."""
        odometry_ns = self._words[Teller.ODOMETRY].newest_ns
        if odometry_ns is not None and motion.stamp_ns - odometry_ns < self.settings.silent_s * 1e9:
            return None
        if self._teller is not Teller.EGO:
            self._words[Teller.EGO] = AcceptedPoses()  # it has begun anew
        return self._tell(Teller.EGO, motion)

    def _tell(self, teller: Teller, motion: VehicleMotion) -> VehicleMotion | None:
        """None for what is not newer than what was told, and for what lies elsewhere."""
        words = self._words[teller]
        if words.newest_ns is not None and motion.stamp_ns <= words.newest_ns:
            return None
        believed = words.add(motion)
        if not believed:
            self._refused[f"{teller.value}: not where the words before lead"] += 1
            return None
        if self._told and motion.stamp_ns <= self._told[-1].stamp_ns:
            return None
        if teller is not self._teller or len(believed) > 1:
            self._teller = teller
            self._change_to(believed[0])
        self._told.extend(map(self._in_start, believed))
        return self._told[-1]

    def _in_start(self, motion: VehicleMotion) -> VehicleMotion:
        """A source's word, in the start frame."""
        T = self._T_start_source @ transform(motion.R_map_vehicle, motion.xyz_map_m)
        return VehicleMotion(
            stamp_ns=motion.stamp_ns,
            xyz_map_m=T[:3, 3].copy(),
            R_map_vehicle=nearest_rotation(np.ascontiguousarray(T[:3, :3])),
            covariance=self._covariance(motion),
        )

    def _change_to(self, motion: VehicleMotion) -> None:
        """Lay the new source on the end of the old one."""
        if not self._told:
            return
        at = constant_turn_rate(list(self._told), motion.stamp_ns)
        there = transform(motion.R_map_vehicle, motion.xyz_map_m)
        self._T_start_source = transform(at.R_map_vehicle, at.xyz_map_m) @ np.linalg.inv(there)
        self._joint = motion, at.covariance
        self._told.clear()  # its speed is told by the new source alone

    def _covariance(self, motion: VehicleMotion) -> Array64 | None:
        """What was uncertain at the change, and what the source says it has become worse by since."""
        if self._joint is None or motion.covariance is None:
            return motion.covariance if self._joint is None else None
        first, P = self._joint
        if P is None or first.covariance is None:
            return None
        T_now_first = np.linalg.inv(transform(motion.R_map_vehicle, motion.xyz_map_m)) @ transform(
            first.R_map_vehicle, first.xyz_map_m
        )
        A = adjoint(np.ascontiguousarray(T_now_first[:3, :3]), T_now_first[:3, 3])
        worse, axes = np.linalg.eigh(motion.covariance - A @ first.covariance @ A.T)
        return A @ P @ A.T + (axes * np.maximum(worse, 0.0)) @ axes.T
