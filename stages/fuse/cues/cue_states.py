"""States of the cues in the graph: bias, and yaw of a position, with a new key each STATE_NS.

Source: ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np

from stages.fuse.cues.cue_factors import (
    change_factor,
    kept_shares,
    measurement_factor,
    predicted_value,
    prior_covariance,
    prior_factor,
)
from stages.fuse.graph import InertialGraph
from stages.geometry.frames import Array64
from stages.geometry.se3 import mahalanobis2
from stages.geometry.trajectory import VehicleTrajectory
from stages.heading.inertial_state import POSITION, InertialState
from stages.messages import CueKind, DroneCue

STATE_NS = 1_000_000_000  # between two keys
FORGOTTEN_NS = 30_000_000_000  # without a measurement
VELOCITY_NS = 100_000_000  # span of the vehicle's velocity


class SlowState(NamedTuple):
    """State of a cue at the last time at which the LiDAR saw the drone."""

    stamp_ns: int
    mean: Array64  # (m,)
    covariance: Array64  # (m, m)


class Innovation(NamedTuple):
    """A measurement against the graph."""

    off_m: Array64  # (n,) measurement minus prediction
    covariance_m2: Array64  # (n, n) of the prediction
    own_m: Array64  # (n,) what the cue would measure of the drone, without its bias
    state: Array64  # (m,) of the cue
    state_m2: Array64  # (m, m)
    speeds_m2: Array64  # (n, n) squared change of the measurement in one second by the drone's and the vehicle's motion

    def distance2(self, noise_m2: Array64) -> float:
        """Squared Mahalanobis distance; noise (n, n)."""
        return mahalanobis2(self.off_m, self.covariance_m2 + noise_m2)

    @property
    def bias_m(self) -> Array64:
        """(n,) estimate of the bias."""
        return self.state[: len(self.off_m)]

    @property
    def bias_sigma_m(self) -> float:
        """Its largest sigma."""
        n = len(self.off_m)
        return math.sqrt(max(float(np.linalg.eigvalsh(self.state_m2[:n, :n])[-1]), 0.0))


@dataclass
class _Newest:
    key: int
    stamp_ns: int  # when it began
    used_ns: int
    kind: CueKind


class CueStates:
    """The newest state of each cue in one graph."""

    def __init__(self, graph: InertialGraph) -> None:
        self._graph, self._starts, self._number = graph, -1, 0
        self._newest: dict[str, _Newest] = {}

    def drop(self, source: str) -> None:
        """Forget the state of a cue; what it measured leaves the graph with the lag."""
        newest = self._newest.pop(source, None)
        if newest is not None:
            self._graph.held.discard(newest.key)

    def innovation(self, cue: DroneCue, vehicle: VehicleTrajectory) -> Innovation | None:
        """A measurement against the graph's prediction; None: it is not within the graph's lag."""
        near = self._graph.nearest_key(cue.stamp_ns)
        if near is None:
            return None
        self._tidy(cue)
        newest = self._newest.get(cue.source)
        position_m2 = self._graph.state.covariance[0, POSITION, POSITION]
        state, state_m2 = np.zeros(len(prior_covariance(cue))), prior_covariance(cue)
        cross = np.zeros((3, len(state)))
        if newest is not None:
            state, state_m2, cross = self._graph.vector_with_position(newest.key)
        t, before = vehicle.at(cue.stamp_ns)[1], vehicle.at(cue.stamp_ns - VELOCITY_NS)[1]
        offset_m = near.xyz_m - t
        made = predicted_value(cue, offset_m, state)
        velocities = np.array([near.velocity_mps, (t - before) / (1e-9 * VELOCITY_NS)]) @ made.by_position.T
        A, B = made.by_position, made.by_state
        covariance = A @ position_m2 @ A.T + B @ state_m2 @ B.T + A @ cross @ B.T + (A @ cross @ B.T).T
        own_m = predicted_value(cue, offset_m, np.zeros(len(state))).value_m
        return Innovation(cue.value_m - made.value_m, covariance, own_m, state, state_m2, velocities.T @ velocities)

    def distance2_by_imu(
        self, cue: DroneCue, vehicle: VehicleTrajectory, by_imu: InertialState, slow: SlowState, noise_m2: Array64
    ) -> float:
        """Squared Mahalanobis distance of a measurement to what the IMU alone predicts.

        `by_imu`: its state at the graph's time, `slow`: that of the cue when the propagation began, noise (n, n).
        """
        near = self._graph.nearest_key(cue.stamp_ns)
        assert near is not None
        off_m = self._graph.state.xyz_m[0] - by_imu.xyz_m[0]
        kept = kept_shares(cue, max(cue.stamp_ns - slow.stamp_ns, 0) * 1e-9)
        prior = prior_covariance(cue)
        slow_m2 = kept[:, None] * slow.covariance * kept + prior - kept[:, None] * prior * kept
        offset_m = near.xyz_m - off_m - vehicle.at(cue.stamp_ns)[1]
        made = predicted_value(cue, offset_m, kept * slow.mean)
        A, B = made.by_position, made.by_state
        S = A @ by_imu.covariance[0, POSITION, POSITION] @ A.T + B @ slow_m2 @ B.T + noise_m2
        return mahalanobis2(cue.value_m - made.value_m, S)

    def add(self, cue: DroneCue, vehicle: VehicleTrajectory, noise_m2: Array64) -> bool:
        """Add a measurement to the graph. Whether it is in the estimate."""
        near = self._graph.nearest_key(cue.stamp_ns)
        if near is None:
            return False
        self._tidy(cue)
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        newest, prior = self._newest.get(cue.source), prior_covariance(cue)
        if newest is None or cue.stamp_ns - newest.stamp_ns >= STATE_NS:
            self._number += 1
            key = gtsam.symbol("c", self._number)
            if newest is None:
                factors.add(prior_factor(key, prior))
                values.insert(key, np.zeros(len(prior)))
            else:
                kept = kept_shares(cue, (cue.stamp_ns - newest.stamp_ns) * 1e-9)
                factors.add(change_factor(newest.key, key, kept, prior))
                values.insert(key, kept * self._graph.vector(newest.key))
                self._graph.held.discard(newest.key)
            newest = self._newest[cue.source] = _Newest(key, cue.stamp_ns, cue.stamp_ns, cue.kind)
            self._graph.held.add(key)
        newest.used_ns = max(cue.stamp_ns, newest.used_ns)
        origin_m = vehicle.at(cue.stamp_ns)[1] - (near.xyz_m - near.key_xyz_m)
        factors.add(measurement_factor(near.key, newest.key, cue, origin_m, noise_m2))
        return self._graph.add_factors(factors, values)

    def _tidy(self, cue: DroneCue) -> None:
        """Forget states of an earlier start of the graph, of another kind of measurement, and old ones."""
        if self._graph.starts != self._starts:
            self._starts = self._graph.starts
            self._newest.clear()
        newest = self._newest.get(cue.source)
        if newest is not None and (newest.kind is not cue.kind or cue.stamp_ns - newest.used_ns > FORGOTTEN_NS):
            self.drop(cue.source)
