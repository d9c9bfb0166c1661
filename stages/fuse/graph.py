"""Fixed-lag smoother of a drone whose heading is decided: pose, velocity and IMU biases at each LiDAR position.

    X_k, V_k, B_k     keys at LiDAR positions, and each KEY_NS in a gap without them
    k -- k+1          CombinedImuFactor, its noise as estimated from the IMU's stream
    X_k               GPSFactorArm: a LiDAR position; AttitudeFactorPose3: roll and pitch;
                      PoseRotationPrior3D: a rotation by vanishing points, referred to the key by the gyroscope
    B_k               a prior of the gyroscope's bias, by the turn between two images, about the vertical by the
                      magnetometer
    first key         the joint covariance (15, 15) of the bank: JacobianFactor in a LinearContainerFactor
    X_k, C_m          cues, each with a state of its own (cues/cue_factors.py); only where there are cues

Each input is checked first; an error of GTSAM starts a new smoother at the last valid state with its joint covariance.
An interval without IMU does the same, after a propagation at constant velocity.

Source: Kaess et al., iSAM2 (IJRR 2012); Forster et al. (T-RO 2017); GTSAM 4.3 nonlinear/IncrementalFixedLagSmoother.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from stages.geometry.frames import Array64
from stages.geometry.se3 import is_covariance
from stages.heading.imu_buffer import ImuBuffer
from stages.heading.inertial_state import (
    ACCEL_WALK,
    GRAVITY_MPS2,
    GYRO_WALK,
    POSITION,
    ImuIntervals,
    InertialState,
)
from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import GyroBias

RAISED = (RuntimeError, IndexError, ValueError)  # C++ exceptions through GTSAM's wrapper
HUBER = 1.345  # [sigma]: 95 % efficient on Gaussian noise
KEY_NS = 200_000_000  # longest time between two keys
LAG_MARGIN_S = 0.3  # keys this close to the end of the lag get no factors
NEWEST_NS = 2_000_000  # a measurement this close to the newest key is of its time
FARTHEST_M = 1e5
UP = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
ANY_BIAS = 1e3  # [m/s^2], [rad/s] no information


class NearestKey(NamedTuple):
    """The key nearest to a time, and the drone at that time."""

    key: int
    key_xyz_m: Array64  # position (3,) of the key, map
    xyz_m: Array64  # position (3,) at the time
    velocity_mps: Array64


class _KeyState(NamedTuple):
    number: int
    stamp_ns: int
    xyz_m: Array64
    velocity_mps: Array64


class InertialGraph:
    """The smoother; `state` (one row) is the posterior of its newest key, at `stamp_ns`."""

    def __init__(self, imu: ImuBuffer, lag_s: float) -> None:
        self._imu, self._lag_s = imu, lag_s
        self._number, self._first_ns = 0, 0
        self._smoother: Any = None
        self._pending: list[Callable[[int], Any]] = []  # factors of the newest key, by its number
        self._recent: deque[_KeyState] = deque()  # keys within the lag, with their first estimates
        self.held: set[int] = set()  # other keys that stay in the lag
        self.recoveries, self.starts = 0, 0
        self.running = False
        self.stamp_ns = 0
        self.state = _empty()

    def start(self, stamp_ns: int, state: InertialState) -> None:
        """Start from a state (one row) with its joint covariance; does not run if that is not valid."""
        try:
            self._start(stamp_ns, state)
        except (*RAISED, np.linalg.LinAlgError):
            self.recoveries += 1
            self.stop()

    def _start(self, stamp_ns: int, state: InertialState) -> None:
        params: Any = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(0.01)
        params.relinearizeSkip = 1
        params.findUnusedFactorSlots = True  # else its list of factors grows without bound
        self._smoother = gtsam.IncrementalFixedLagSmoother(self._lag_s, params)
        self._number, self._first_ns = self._number + 1, stamp_ns
        self.starts += 1
        self._pending.clear()
        self._recent.clear()
        self.held.clear()
        self.stamp_ns, self.state, self.running = stamp_ns, state, True
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._insert(values, state)
        whiten = np.linalg.inv(np.linalg.cholesky(_to_gtsam(state)))
        columns = [np.asfortranarray(whiten[:, a:b]) for a, b in ((0, 6), (6, 9), (9, 15))]
        n = self._number
        prior = gtsam.JacobianFactor(
            X(n), columns[0], V(n), columns[1], B(n), columns[2], np.zeros(15), gtsam.noiseModel.Unit.Create(15)
        )
        graph.add(gtsam.LinearContainerFactor(prior, values))
        self._smoother.update(graph, values, self._times())
        self._remember()

    def stop(self) -> None:
        """Drop the smoother."""
        self.running, self._smoother = False, None
        self._pending.clear()

    def advance(self, stamp_ns: int, max_step_ns: int = KEY_NS) -> None:
        """Add keys so that the newest one is less than `max_step_ns` before a time."""
        while self.running and self.stamp_ns + max_step_ns <= stamp_ns:
            self._extend(self.stamp_ns + max_step_ns, self.at(self.stamp_ns + max_step_ns))

    def add_position(self, stamp_ns: int, xyz_m: Array64, covariance_m2: Array64, predicted: InertialState) -> bool:
        """Add a LiDAR position, not before the newest key, at a key of its own. False: not usable.

        `predicted`: the state at its time.
        """
        if not (self.running and np.isfinite(xyz_m).all() and is_covariance(covariance_m2)):
            return False
        noise, zero = _robust(covariance_m2), np.zeros(3)
        if stamp_ns - self.stamp_ns <= NEWEST_NS:
            self._pending.append(lambda n: gtsam.GPSFactorArm(X(n), xyz_m, zero, noise))
            return self._flush()
        return self._extend(stamp_ns, predicted, lambda n: gtsam.GPSFactorArm(X(n), xyz_m, zero, noise))

    def add_vertical(self, up_drone: Array64, sigma_rad: float) -> None:
        """Add the autopilot's vertical (3,) in drone axes at the newest key."""
        noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma_rad)
        up = gtsam.Unit3(up_drone)
        self._pending.append(lambda n: gtsam.AttitudeFactorPose3(X(n), UP, noise, up))

    def add_rotation(self, R_map_drone: Array64, covariance_rad2: Array64) -> bool:
        """Add a rotation at the newest key; covariance in drone axes. False: not usable."""
        if not (np.isfinite(R_map_drone).all() and is_covariance(covariance_rad2)):
            return False
        noise, R = _robust(covariance_rad2), gtsam.Rot3(R_map_drone)
        self._pending.append(lambda n: gtsam.PoseRotationPrior3D(X(n), R, noise))
        return True

    def add_gyro_bias(self, bias_radps: Array64, covariance: Array64) -> None:
        """Add a measurement of the gyroscope's bias (3,)."""
        whole = ANY_BIAS**2 * np.eye(6)
        whole[3:, 3:] = covariance
        prior, noise = gtsam.imuBias.ConstantBias(np.zeros(3), bias_radps), _robust(whole)
        self._pending.append(lambda n: gtsam.PriorFactorConstantBias(B(n), prior, noise))

    def add_vertical_gyro_bias(self, measured: GyroBias) -> None:
        """Add a measurement of the gyroscope's bias about the vertical."""
        up = measured.up_drone
        covariance = ANY_BIAS**2 * np.eye(3) + (measured.sigma_radps**2 - ANY_BIAS**2) * np.outer(up, up)
        self.add_gyro_bias(measured.bias_radps * up, covariance)

    def nearest_key(self, stamp_ns: int) -> NearestKey | None:
        """The key nearest to a time, and the drone at that time; None: before the oldest key that can be used."""
        recent = self._recent
        if not (self.running and recent and stamp_ns >= recent[0].stamp_ns):
            return None
        newest = recent[-1]
        if stamp_ns >= newest.stamp_ns:
            ahead = self.at(stamp_ns)
            return NearestKey(X(newest.number), self.state.xyz_m[0], ahead.xyz_m[0], ahead.velocity_mps[0])
        i = next(k for k in range(len(recent) - 1, -1, -1) if recent[k].stamp_ns <= stamp_ns)
        a, b = recent[i], recent[i + 1]
        share = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
        key = a if share < 0.5 else b
        dt_s, sign = abs(stamp_ns - key.stamp_ns) * 1e-9, 1.0 if key is a else -1.0
        velocity_mps = (1.0 - share) * a.velocity_mps + share * b.velocity_mps
        xyz_m = key.xyz_m + sign * 0.5 * dt_s * (velocity_mps + key.velocity_mps)
        return NearestKey(X(key.number), key.xyz_m, xyz_m, velocity_mps)

    def vector(self, key: int) -> Array64:
        """Estimate of another variable by its key."""
        return self._smoother.calculateEstimateVector(key)

    def vector_with_position(self, key: int) -> tuple[Array64, Array64, Array64]:
        """Estimate (m,) of another variable, its covariance (m, m), and that (3, m) with the newest position, map."""
        joint = self._smoother.getISAM2().jointMarginalCovariance([X(self._number), key])
        cross = self.state.R[0] @ joint.at(X(self._number), key)[3:]
        return self.vector(key), joint.at(key, key), cross

    def add_factors(self, factors: Any, values: Any) -> bool:
        """Add factors of keys from `nearest_key`, and of others that are `held`, with new values of those."""
        return self.running and self._guarded(factors, values, self._times(), self.state)

    def at(self, stamp_ns: int) -> InertialState:
        """The state (one row) propagated to a time."""
        return self._imu.propagate(self.state, np.ones(1), self.stamp_ns, stamp_ns)

    def _extend(self, stamp_ns: int, predicted: InertialState, factor: Callable[[int], Any] | None = None) -> bool:
        """Add a key at a later time, where `predicted` is the state, with a factor of its own; then update."""
        pieces = self._imu.between(self.stamp_ns, stamp_ns)
        if len(pieces) != 1 or not isinstance(pieces[0], ImuIntervals):
            self.start(stamp_ns, predicted)
            if not self.running:
                return False
            if factor is not None:
                self._pending.append(factor)
            return self._flush()
        before, n = self._number, self._number + 1
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        motion = self._preintegrated(pieces[0])
        graph.add(gtsam.CombinedImuFactor(X(before), V(before), X(n), V(n), B(before), B(n), motion))
        for add in self._pending:
            graph.add(add(before))
        self._pending.clear()
        if factor is not None:
            graph.add(factor(n))
        self._number, self.stamp_ns = n, stamp_ns
        self._insert(values, predicted)
        return self._guarded(graph, values, self._times(), predicted)

    def _flush(self) -> bool:
        """Update with the pending factors, without a new key."""
        graph = gtsam.NonlinearFactorGraph()
        for add in self._pending:
            graph.add(add(self._number))
        self._pending.clear()
        return self._guarded(graph, gtsam.Values(), {}, self.state)

    def _preintegrated(self, imu: ImuIntervals) -> Any:
        params: Any = gtsam.PreintegrationCombinedParams(GRAVITY_MPS2)
        share, three = imu.step_s / imu.seconds, np.eye(3)
        params.setAccelerometerCovariance(np.diag(share @ imu.force_noise**2))
        params.setGyroscopeCovariance(np.diag(share @ imu.rate_noise**2))
        params.setIntegrationCovariance(1e-8 * three)
        params.setBiasAccCovariance(ACCEL_WALK**2 * three)
        params.setBiasOmegaCovariance(GYRO_WALK**2 * three)
        motion: Any = gtsam.PreintegratedCombinedMeasurements(params, _bias(self.state))
        accelerometer, gyro = self.state.bias[0, :3], self.state.bias[0, 3:]
        for force, rate, step_s in zip(imu.force_mps2, imu.rate_radps, imu.step_s, strict=True):
            if step_s > 1e-6:  # GTSAM: axes at the interval's start; the mean force has those of its middle
                turned = exp_rotation(0.5 * step_s * (rate - gyro)) @ (force - accelerometer) + accelerometer
                motion.integrateMeasurement(turned, rate, float(step_s))
        return motion

    def _insert(self, values: Any, state: InertialState) -> None:
        n = self._number
        values.insert(X(n), gtsam.Pose3(gtsam.Rot3(state.R[0]), state.xyz_m[0]))
        values.insert(V(n), state.velocity_mps[0])
        values.insert(B(n), _bias(state))

    def _times(self) -> dict[int, float]:
        at_s, n = (self.stamp_ns - self._first_ns) * 1e-9, self._number
        return {X(n): at_s, V(n): at_s, B(n): at_s, **dict.fromkeys(self.held, at_s)}

    def _remember(self) -> None:
        """Keep the newest key's position and velocity, and those of the keys that are safely within the lag."""
        state, recent = self.state, self._recent
        if recent and recent[-1].number == self._number:
            recent.pop()
        recent.append(_KeyState(self._number, self.stamp_ns, state.xyz_m[0], state.velocity_mps[0]))
        while recent[0].stamp_ns < self.stamp_ns - round(1e9 * (self._lag_s - LAG_MARGIN_S)):
            recent.popleft()

    def _guarded(self, graph: Any, values: Any, times: dict[int, float], fallback: InertialState) -> bool:
        """Update and read the newest key; on failure restart at the fallback."""
        newest = None
        try:
            self._smoother.update(graph, values, times)
            newest = self._newest()
        except RAISED:
            pass
        if newest is None:
            self.recoveries += 1
            self.start(self.stamp_ns, fallback)
            return False
        self.state = newest
        self._remember()
        return True

    def _newest(self) -> InertialState | None:
        """The newest key with its joint covariance; None: not valid."""
        n, smoother = self._number, self._smoother
        pose, bias = smoother.calculateEstimatePose3(X(n)), smoother.calculateEstimateConstantBias(B(n))
        velocity = smoother.calculateEstimateVector(V(n))
        joint = smoother.getISAM2().jointMarginalCovariance([X(n), V(n), B(n)]).fullMatrix()
        R, xyz_m = pose.rotation().matrix(), pose.translation().copy()  # GTSAM gives the position read-only
        if not (np.abs(xyz_m).max() < FARTHEST_M and is_covariance(joint)):  # NaN compares false
            return None
        to_map = _position_axes(R)
        P = to_map @ joint @ to_map.T
        return InertialState(R[None], xyz_m[None], velocity[None], bias.vector()[None], 0.5 * (P + P.T)[None])


def _robust(covariance: Array64) -> Any:
    huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER)
    return gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(covariance))


def _position_axes(R: Array64) -> Array64:
    """(15, 15): GTSAM has the position's error in drone axes, InertialState in map axes."""
    axes = np.eye(15)
    axes[POSITION, POSITION] = R
    return axes


def _to_gtsam(state: InertialState) -> Array64:
    axes = _position_axes(state.R[0])
    return axes.T @ state.covariance[0] @ axes


def _bias(state: InertialState) -> Any:
    return gtsam.imuBias.ConstantBias(state.bias[0, :3], state.bias[0, 3:])


def _empty() -> InertialState:
    return InertialState(np.eye(3)[None], np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 6)), np.eye(15)[None])
