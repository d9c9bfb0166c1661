"""Which cues enter the graph, and when.

A cue is used once it is certain that it is of the drone (cue_owner.py), and while it agrees with the graph: a
measurement beyond the 99.9 % ellipsoid of prediction, bias and noise is rejected; after CONTRADICTS_NS in which all
are, the cue has to show again that it is of the drone. Noise that is correlated in time is inflated (consistency.py),
and an error of the latency moves a measurement along its velocity.

While the LiDAR sees the drone, a cue gives its bias and nothing else of weight. In a gap it bounds the drift of the
IMU. A wrong cue could then move the estimate slowly, each step within the ellipsoid. Therefore the state by the IMU
alone is propagated from the newest LiDAR position. The estimate continues with that when a measurement is beyond its
95 % ellipsoid, bias and noise included, when the cue is rejected, or when the next LiDAR position agrees with the IMU
alone. The test is strict because a false alarm costs little. A wrong cue that passes it is off by at most q r, and
moves the estimate by the share s^2 / r^2 of that: q = sqrt(7.81), r^2 = s^2 + c^2, s and c: sigmas [m] of the IMU
alone and of the cue.

Source: ours.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from stages.cues.bias import CHI2_999
from stages.fuse.consistency import InformationInflation
from stages.fuse.cues.cue_owner import CueOwner
from stages.fuse.cues.cue_states import CueStates, Innovation, SlowState
from stages.fuse.graph import InertialGraph
from stages.fuse.settings import FuseErrors
from stages.geometry.trajectory import VehicleTrajectory
from stages.heading.inertial_state import InertialState
from stages.messages import CueFactor, DroneCue

CHI2_95 = {1: 3.84, 2: 5.99, 3: 7.81}  # 95 % quantiles by degrees of freedom
SEEN_NS = 350_000_000  # after a LiDAR position
OLDEST_NS = 1_500_000_000  # before the graph's time: within the shortest lag that the default of 2 s leaves
CONTRADICTS_NS = 500_000_000
SPACING_NS = 180_000_000  # between two measurements of a cue that are used: its noise is correlated


@dataclass
class _Cue:
    inflation: InformationInflation
    owner: CueOwner = field(default_factory=CueOwner)
    rejected_since_ns: int | None = None
    used_ns: int | None = None
    slow: SlowState | None = None  # when the LiDAR saw the drone


class CueFusion:
    """Adds cues to the graph."""

    def __init__(self, errors: FuseErrors, graph: InertialGraph) -> None:
        self._errors, self._graph = errors, graph
        self._states = CueStates(graph)
        self._cues: dict[str, _Cue] = {}
        self.distrusted: dict[str, int] = {}  # how often, by source

    def restart(self) -> None:
        """Another drone, or another map frame: nothing of the cues is known."""
        for source in self._cues:
            self._states.drop(source)
        self._cues.clear()

    def used_since(self, stamp_ns: int) -> list[str]:
        """The cues that were used at or after a time."""
        return [source for source, cue in self._cues.items() if cue.used_ns is not None and cue.used_ns >= stamp_ns]

    def distrust(self, source: str) -> None:
        """The cue has to show again that it is of the drone."""
        self.distrusted[source] = self.distrusted.get(source, 0) + 1
        self._cues.pop(source, None)
        self._states.drop(source)

    def add(self, z: DroneCue, vehicle: VehicleTrajectory, by_imu: InertialState | None) -> CueFactor | None:
        """Add a measurement; `by_imu`: the state by the IMU alone; None: the LiDAR sees the drone at its time.

        None: it is too late, or too soon after the one before.
        """
        cue = self._cues.setdefault(z.source, _Cue(InformationInflation(self._errors.cue_time_s)))
        if self._graph.stamp_ns - z.stamp_ns > OLDEST_NS:
            return None
        if cue.used_ns is not None and z.stamp_ns - cue.used_ns < SPACING_NS:
            return None
        i = self._states.innovation(z, vehicle)
        if i is None:
            return None
        self._update_owner(cue, z, i, vehicle, by_imu is None)
        if cue.owner.denied:
            return self._contradicts(z, i, "does not move as the drone does")
        if not cue.owner.certain:
            return _factor(z, i, "not certain that it is of the drone: neither has moved enough")
        noise_m2 = z.covariance_m2 + self._errors.cue_clock_s**2 * i.speeds_m2
        if i.distance2(noise_m2) > CHI2_999[len(z.value_m)]:
            return self._reject(cue, z, i)
        cue.rejected_since_ns = None
        if by_imu is None:
            cue.slow = SlowState(z.stamp_ns, i.state, i.state_m2)
        elif cue.slow is None:
            return _factor(z, i, "its bias was not known before the LiDAR lost the drone")
        elif self._states.distance2_by_imu(z, vehicle, by_imu, cue.slow, noise_m2) > CHI2_95[len(z.value_m)]:
            return self._contradicts(z, i, "contradicts the IMU")
        if not self._states.add(z, vehicle, cue.inflation.factor(z.stamp_ns) * noise_m2):
            return _factor(z, i, "not added: the smoother restarted")
        cue.used_ns = z.stamp_ns
        return _factor(z, i, f"bias known to {i.bias_sigma_m:.2f} m", used=True)

    def _update_owner(self, cue: _Cue, z: DroneCue, i: Innovation, vehicle: VehicleTrajectory, seen: bool) -> None:
        if not seen:
            cue.owner.pause()
            return
        walk_m2 = 2.0 * z.bias_covariance_m2 / z.bias_time_s
        moving_m2 = self._errors.cue_clock_s**2 * i.speeds_m2
        seen_m2 = self._errors.cue_seen_m**2 * np.eye(len(z.value_m))
        change_m2 = 2.0 * (z.covariance_m2 + moving_m2 + seen_m2)
        cue.owner.add(z.stamp_ns, z.value_m, i.own_m, vehicle.at(z.stamp_ns)[1], (change_m2, walk_m2))

    def _reject(self, cue: _Cue, z: DroneCue, i: Innovation) -> CueFactor:
        if cue.rejected_since_ns is None:
            cue.rejected_since_ns = z.stamp_ns
        if z.stamp_ns - cue.rejected_since_ns < CONTRADICTS_NS:
            return _factor(z, i, "rejected: beyond the 99.9 % ellipsoid")
        return self._contradicts(z, i, "contradicts the estimate")

    def _contradicts(self, z: DroneCue, i: Innovation, reason: str) -> CueFactor:
        self.distrust(z.source)
        return _factor(z, i, reason, contradicts=True)


def _factor(z: DroneCue, i: Innovation, reason: str, used: bool = False, contradicts: bool = False) -> CueFactor:
    return CueFactor(
        stamp_ns=z.stamp_ns,
        source=z.source,
        used=used,
        contradicts=contradicts,
        reason=reason,
        bias_m=i.bias_m,
        bias_sigma_m=i.bias_sigma_m,
        offset_m=float(np.linalg.norm(z.value_m - i.own_m)),
    )
