"""Selection of the source of vehicle motion: the vehicle's odometry if available, otherwise the camera's ego-motion.

    odometry available             its poses are passed on unchanged
    odometry silent                the ego-motion continues from the vehicle's pose; later the odometry again
    odometry rejected              the same, as long as its poses are outliers
    odometry frozen                the same, until it moves again (impossible_stop.py)
    odometry against the LiDAR     the same, until both agree again (lidar_consistency.py)

Each source has its own start frame, and a source that returns may have a new one. At every change the new source is
therefore aligned with the end of the old one:

    T_map_vehicle = T_map_source T_source_vehicle,   T_map_source = T_map_vehicle(t) T_source_vehicle(t)^-1

with t the first stamp of the new source and T_map_vehicle(t) extrapolated (stages/geometry/extrapolation.py). The same
happens when the start frame of a source jumps: its poses are rejected until three of them lie on one smooth path. Frame
map is the start frame of the first source. The output has no jumps; it drifts. When the odometry turns out to be
frozen or wrong, the last credible pose is published once more with status DENIED: the poses after it are withdrawn.
An odometry that was frozen, with no other source since, keeps its start frame like one that was silent, if its pose is
reachable and at least as far away as the hardest braking allows. Nearer, it has missed the path during the freeze.

Source: ours; P V.B for the camera's motion.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter, deque
from enum import Enum
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from flow.counters import Counters
from flow.stage import Settings, Stage
from stages.geometry.extrapolation import AcceptedPoses, constant_turn_rate, is_reachable, speed_mps
from stages.geometry.frames import Array64, transform
from stages.geometry.rig_lidar import RigLidar
from stages.geometry.se3 import adjoint
from stages.geometry.trajectory import VehicleTrajectory
from stages.kernels.geometry.so3 import nearest_rotation
from stages.messages import MotionStatus, SweptPulses, VehicleMotion
from stages.odometry.vehicle.impossible_stop import ImpossibleStop, least_path_m
from stages.odometry.vehicle.lidar_consistency import LidarConsistency
from stages.odometry.vehicle.static_scan import StaticScan

WAITING = 512  # slices, 0.7 s
WITHDRAWN_NS = 300_000_000  # before the estimates that contradict the odometry
SILENT_S = 0.25  # the odometry is unavailable after this time without an accepted pose


class MotionSource(Enum):
    """Source of the vehicle's motion."""

    ODOMETRY = "odometry"
    EGO = "ego"


class VehicleMotionSelectorSettings(Settings):
    """Settings of `VehicleMotionSelector`."""

    silent_s: float = Field(SILENT_S, gt=0, le=10)  # at least two periods of the odometry
    unit: RigLidar = RigLidar()  # beams of the LiDAR that sends `pulses`


class VehicleMotionSelector(Stage[VehicleMotionSelectorSettings]):
    """T_map_vehicle without jumps from whichever source is available. All inputs are optional."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"odometry", "ego", "pulses"})

    def __init__(self, settings: VehicleMotionSelectorSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._source: MotionSource | None = None
        self._accepted: dict[MotionSource, AcceptedPoses] = {source: AcceptedPoses() for source in MotionSource}
        self._published: deque[VehicleMotion] = deque(maxlen=64)  # since the newest change of source
        self._T_map_source: Array64 = np.eye(4)
        self._at_change: tuple[VehicleMotion, Array64 | None] | None = None  # the source's pose, and P in frame map
        self._rejected: Counter[str] = Counter()
        self._stop = ImpossibleStop()
        self._was_frozen = False  # the reason for which the odometry was denied last
        self._reported = VehicleTrajectory()  # by the odometry, also while it is denied
        self._waiting: deque[SweptPulses] = deque(maxlen=WAITING)  # slices that are newer than the odometry
        self._scan, self._consistency = StaticScan(self.settings.unit), LidarConsistency()

    @property
    def rejected(self) -> Counter[str]:
        """Number of rejected poses by reason."""
        return self._rejected

    @property
    def counters(self) -> Counters:
        """Rejected poses by reason, for the run's summary."""
        return Counters(rejected=self._rejected)

    def on_odometry(self, motion: VehicleMotion) -> VehicleMotion | None:
        """The vehicle's odometry, passed on immediately; None for a rejected pose. DENIED: it is frozen."""
        self._reported.add(motion)
        if self._stop.is_frozen_at(motion.xyz_map_m):
            self._rejected["odometry: frozen"] += 1
            return None
        if self._consistency.contradicted:
            self._rejected["odometry: contradicts the LiDAR"] += 1
            return None
        return self._select(MotionSource.ODOMETRY, motion)

    def on_pulses(self, pulses: SweptPulses) -> VehicleMotion | None:
        """The LiDAR, against which the odometry is checked. DENIED: the odometry contradicts it."""
        if not self._reported.known or pulses.range_m.size == 0:
            return None
        self._waiting.append(pulses)
        newest_ns = self._reported.newest_ns
        while newest_ns is not None and self._waiting and self._waiting[0].point_stamp_ns[-1] <= newest_ns:
            oldest = self._waiting.popleft()
            ends_ns = oldest.stamp_ns, int(oldest.point_stamp_ns[-1])
            error = self._scan.add(oldest, self._reported.at(ends_ns[0]), self._reported.at(ends_ns[1]))
            if error is not None and self._consistency.add(error):
                return self._deny(error.stamp_ns - WITHDRAWN_NS, frozen=False)
        return None

    def _last_credible_ns(self, accepted: tuple[VehicleMotion, ...]) -> int | None:
        """Stamp of the last credible pose of the odometry if it has just frozen."""
        if len(accepted) > 1:
            self._stop.restart()
        stamps_ns = [self._stop.add(motion.stamp_ns, motion.xyz_map_m) for motion in accepted]
        return next((stamp_ns for stamp_ns in stamps_ns if stamp_ns is not None), None)

    def _deny(self, credible_ns: int, frozen: bool) -> VehicleMotion | None:
        """Withdraw the published poses of the odometry after its last credible one; None: all are older."""
        self._rejected["odometry: denied"] += 1
        self._accepted[MotionSource.ODOMETRY] = AcceptedPoses()
        self._was_frozen = frozen
        if self._source is not MotionSource.ODOMETRY:
            return None
        self._source = None
        while len(self._published) > 1 and self._published[-1].stamp_ns > credible_ns:
            self._published.pop()
        return dataclasses.replace(self._published[-1], status=MotionStatus.DENIED) if self._published else None

    def on_ego(self, motion: VehicleMotion) -> VehicleMotion | None:
        """The camera's ego-motion; None while the odometry is available."""
        odometry_ns = self._accepted[MotionSource.ODOMETRY].newest_ns
        if odometry_ns is not None and motion.stamp_ns - odometry_ns < self.settings.silent_s * 1e9:
            return None
        if self._source is not MotionSource.EGO:
            self._accepted[MotionSource.EGO] = AcceptedPoses()  # the ego-motion has a new start frame
        return self._select(MotionSource.EGO, motion)

    def _select(self, source: MotionSource, motion: VehicleMotion) -> VehicleMotion | None:
        """The pose in frame map; None if it is rejected or not newer than the newest published one."""
        accepted_poses = self._accepted[source]
        if accepted_poses.newest_ns is not None and motion.stamp_ns <= accepted_poses.newest_ns:
            return None
        accepted = accepted_poses.add(motion)
        if not accepted:
            self._rejected[f"{source.value}: not reachable from the poses before"] += 1
            return None
        credible_ns = self._last_credible_ns(accepted) if source is MotionSource.ODOMETRY else None
        if credible_ns is not None:
            return self._deny(credible_ns, frozen=True)
        if self._published and motion.stamp_ns <= self._published[-1].stamp_ns:
            return None
        if source is not self._source or len(accepted) > 1:
            if not (self._source is None and source is MotionSource.ODOMETRY and self._continues(accepted[0])):
                self._change_to(accepted[0])
            self._source = source
        self._published.extend(map(self._in_map, accepted))
        return self._published[-1]

    def _continues(self, motion: VehicleMotion) -> bool:
        """Whether the odometry, which was frozen, continues its published poses in the same start frame."""
        published = list(self._published)
        v_mps = speed_mps(published) if self._was_frozen and published else None
        if v_mps is None:
            return False
        here, there = self._in_map(motion), constant_turn_rate(published, motion.stamp_ns, until_s=math.inf)
        gap_s = (motion.stamp_ns - published[-1].stamp_ns) * 1e-9
        if math.dist(here.xyz_map_m, published[-1].xyz_map_m) < least_path_m(v_mps, gap_s):
            return False
        expected, measured = ((m.R_map_vehicle, m.xyz_map_m) for m in (there, here))
        return is_reachable(expected, measured, gap_s, v_mps)

    def _in_map(self, motion: VehicleMotion) -> VehicleMotion:
        """A pose of the source, in frame map."""
        T = self._T_map_source @ transform(motion.R_map_vehicle, motion.xyz_map_m)
        return VehicleMotion(
            stamp_ns=motion.stamp_ns,
            xyz_map_m=T[:3, 3].copy(),
            R_map_vehicle=nearest_rotation(np.ascontiguousarray(T[:3, :3])),
            covariance=self._covariance(motion),
        )

    def _change_to(self, motion: VehicleMotion) -> None:
        """Align the new source with the extrapolated end of the old one."""
        if not self._published:
            return
        at = constant_turn_rate(list(self._published), motion.stamp_ns)
        T_source_vehicle = transform(motion.R_map_vehicle, motion.xyz_map_m)
        self._T_map_source = transform(at.R_map_vehicle, at.xyz_map_m) @ np.linalg.inv(T_source_vehicle)
        self._at_change = motion, at.covariance
        self._published.clear()  # the speed is taken from the new source alone

    def _covariance(self, motion: VehicleMotion) -> Array64 | None:
        """Covariance at the change plus the growth that the source reports since; None where either is not known."""
        if self._at_change is None or motion.covariance is None:
            return motion.covariance if self._at_change is None else None
        first, P = self._at_change
        if P is None or first.covariance is None:
            return None
        T_now_first = np.linalg.inv(transform(motion.R_map_vehicle, motion.xyz_map_m)) @ transform(
            first.R_map_vehicle, first.xyz_map_m
        )
        A = adjoint(np.ascontiguousarray(T_now_first[:3, :3]), T_now_first[:3, 3])
        growth, axes = np.linalg.eigh(motion.covariance - A @ first.covariance @ A.T)
        return A @ P @ A.T + (axes * np.maximum(growth, 0.0)) @ axes.T
