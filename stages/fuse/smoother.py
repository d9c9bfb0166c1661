"""Fixed-lag smoother: a chain of poses X_k = T_map_drone, ten a second, over the last three seconds.

    X_k -- X_k+1     BetweenFactorPose3: the drone's own motion (motion_model.py)
    X_k              GPSFactorArm: a LiDAR position, PoseRotationPrior3D: a rotation, each referred to its own time by
                     the drone's motion since X_k, so that late data correct the pose of their time
    X_k              AttitudeFactorPose3: the autopilot's vertical

Each input is checked first: a factor on a key that has left the window, or one NaN, would invalidate the smoother for
good. Errors of GTSAM (RuntimeError, IndexError, ValueError) start a new smoother at the last valid pose.

Source: Kaess et al., iSAM2 (IJRR 2012); GTSAM 4.3 nonlinear/IncrementalFixedLagSmoother; DESIGN, Fusion.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from stages.fuse.motion_model import Step
from stages.geometry.frames import Array64
from stages.geometry.se3 import composed_covariance, is_covariance

HUBER = 1.345  # [sigma] residual from which its weight falls: 95 % efficient on Gaussian noise


class BackEnd(Protocol):
    """T_map_drone at `stamp_ns`; covariance (6, 6): rotation before translation, tangent at the body."""

    stamp_ns: int
    R_map_drone: Array64
    xyz_map_m: Array64
    covariance: Array64
    recoveries: int  # how often it had to be reset after an error of its library

    def start(self, stamp_ns: int, R_map_drone: Array64, xyz_map_m: Array64, covariance: Array64) -> None:
        """Start from one pose; earlier measurements are dropped."""
        ...

    def extend(self, stamp_ns: int, step: Step, up_drone: Array64 | None, tilt_rad2: float) -> None:
        """Add a later pose; `up_drone` is the vertical (3,) in drone axes there, `tilt_rad2` its variance."""
        ...

    def near(self, stamp_ns: int) -> tuple[int, Array64, Array64]:
        """Time and pose that a measurement at `stamp_ns` is referred to."""
        ...

    def add_position(self, key_ns: int, step: Step, xyz_m: Array64, covariance_m2: Array64) -> bool:
        """Position at the end of a step from `key_ns`, z = T(key) step. False: not usable."""
        ...

    def add_rotation(self, key_ns: int, step: Step, R: Array64, covariance_rad2: Array64) -> bool:
        """R_map_drone at the end of a step from `key_ns`; covariance in drone axes there. False: not usable."""
        ...


RAISED = (RuntimeError, IndexError, ValueError)  # C++ exceptions through GTSAM's wrapper
FLOOR = np.diag([1e-5**2] * 3 + [1e-4**2] * 3)  # smallest covariance of a step
FARTHEST_M = 1e5  # distance from the start
SLACK_S = 1e-3  # GTSAM keeps a pose for this time beyond the lag: its times are floats
UP = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))


def _robust(covariance: Array64) -> Any:
    huber = gtsam.noiseModel.mEstimator.Huber.Create(HUBER)
    return gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(covariance))


class Smoother:
    """`BackEnd` by the incremental fixed-lag smoother of GTSAM."""

    def __init__(self, lag_s: float) -> None:
        self._lag_s, self._lag_ns = lag_s, round(1e9 * lag_s)
        self._keys: deque[tuple[int, int]] = deque()  # (time, number) of the chain's poses in the window
        self._number = 0
        self._first_ns, self._first_m = 0, np.zeros(3)
        self._smoother: Any = None
        self.stamp_ns, self.recoveries = 0, 0
        self.R_map_drone, self.xyz_map_m, self.covariance = np.eye(3), np.zeros(3), np.eye(6)

    def start(self, stamp_ns: int, R_map_drone: Array64, xyz_map_m: Array64, covariance: Array64) -> None:
        """Start a new smoother with one pose."""
        params: Any = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(0.01)
        params.relinearizeSkip = 1
        params.findUnusedFactorSlots = True  # else its list of factors grows without bound
        self._smoother = gtsam.IncrementalFixedLagSmoother(self._lag_s + SLACK_S, params)
        self._number, self._first_ns, self._first_m = self._number + 1, stamp_ns, xyz_map_m
        self._keys.clear()
        self._keys.append((stamp_ns, self._number))
        self.stamp_ns, self.covariance = stamp_ns, covariance
        self.R_map_drone, self.xyz_map_m = R_map_drone, xyz_map_m
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose = gtsam.Pose3(gtsam.Rot3(R_map_drone), xyz_map_m)
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        graph.add(gtsam.PriorFactorPose3(X(self._number), pose, noise))
        values.insert(X(self._number), pose)
        self._smoother.update(graph, values, {X(self._number): 0.0})

    def extend(self, stamp_ns: int, step: Step, up_drone: Array64 | None, tilt_rad2: float) -> None:
        """Add a pose."""
        R, t_m = self.R_map_drone @ step.R, self.xyz_map_m + self.R_map_drone @ step.t_m
        P = composed_covariance(self.covariance, step.R, step.t_m, step.covariance + FLOOR)
        before, self._number = self._number, self._number + 1
        motion = gtsam.Pose3(gtsam.Rot3(step.R), step.t_m)
        noise = gtsam.noiseModel.Gaussian.Covariance(step.covariance + FLOOR)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.add(gtsam.BetweenFactorPose3(X(before), X(self._number), motion, noise))
        if up_drone is not None:
            sigma = gtsam.noiseModel.Isotropic.Variance(2, tilt_rad2)
            graph.add(gtsam.AttitudeFactorPose3(X(self._number), UP, sigma, gtsam.Unit3(up_drone)))
        values.insert(X(self._number), gtsam.Pose3(gtsam.Rot3(R), t_m))
        self._keys.append((stamp_ns, self._number))
        while self._keys[0][0] <= stamp_ns - self._lag_ns:
            self._keys.popleft()
        self.stamp_ns = stamp_ns
        at_s = (stamp_ns - self._first_ns) * 1e-9
        self._guarded(lambda: self._smoother.update(graph, values, {X(self._number): at_s}), R, t_m, P)

    def near(self, stamp_ns: int) -> tuple[int, Array64, Array64]:
        """Newest pose of the chain not after a time; the oldest one for older times.

        Where it cannot be read, the chain restarts at its newest pose.
        """
        key_ns, number = self._keys[0]
        for at_ns, candidate in reversed(self._keys):
            if at_ns <= stamp_ns:
                key_ns, number = at_ns, candidate
                break
        if key_ns != self.stamp_ns:
            try:
                pose = self._smoother.calculateEstimatePose3(X(number))
                return key_ns, pose.rotation().matrix(), pose.translation()
            except RAISED:
                self._reinitialise(self.R_map_drone, self.xyz_map_m, self.covariance)
        return self.stamp_ns, self.R_map_drone, self.xyz_map_m

    def add_position(self, key_ns: int, step: Step, xyz_m: Array64, covariance_m2: Array64) -> bool:
        """GPSFactorArm: X t_step = xyz."""
        return self._add(
            key_ns, (xyz_m, step.t_m), covariance_m2, lambda key, noise: gtsam.GPSFactorArm(key, xyz_m, step.t_m, noise)
        )

    def add_rotation(self, key_ns: int, step: Step, R: Array64, covariance_rad2: Array64) -> bool:
        """PoseRotationPrior3D: X R_step = R."""
        R_key, covariance = R @ step.R.T, step.R @ covariance_rad2 @ step.R.T
        return self._add(
            key_ns,
            (R_key,),
            covariance,
            lambda key, noise: gtsam.PoseRotationPrior3D(key, gtsam.Rot3(R_key), noise),
        )

    def _add(
        self, key_ns: int, numbers: tuple[Array64, ...], covariance: Array64, factor: Callable[[int, Any], Any]
    ) -> bool:
        """Check a factor and add it. False: invalid numbers, or its pose has left the window."""
        number = next((number for at_ns, number in self._keys if at_ns == key_ns), None)
        if number is None or not all(np.isfinite(v).all() for v in numbers) or not is_covariance(covariance):
            return False
        graph = gtsam.NonlinearFactorGraph()
        graph.add(factor(X(number), _robust(covariance)))
        now = self.R_map_drone, self.xyz_map_m, self.covariance
        return self._guarded(lambda: self._smoother.update(graph, gtsam.Values(), {}), *now)

    def _guarded(self, update: Callable[[], Any], R: Array64, xyz_m: Array64, covariance: Array64) -> bool:
        """Update and read the newest pose; on failure restart at the given pose."""
        newest = None
        try:
            update()
            newest = self._newest()
        except RAISED:
            pass
        if newest is None:
            self._reinitialise(R, xyz_m, covariance)
            return False
        self.R_map_drone, self.xyz_map_m, self.covariance = newest
        return True

    def _reinitialise(self, R: Array64, xyz_m: Array64, covariance: Array64) -> None:
        self.recoveries += 1
        self.start(self.stamp_ns, R, xyz_m, covariance)

    def _newest(self) -> tuple[Array64, Array64, Array64] | None:
        """The newest pose with its covariance; None: not valid."""
        pose = self._smoother.calculateEstimatePose3(X(self._number))
        covariance = self._smoother.marginalCovariance(X(self._number))
        near = bool(np.abs(pose.translation() - self._first_m).max() < FARTHEST_M)  # NaN compares false
        if not (near and is_covariance(covariance)):
            return None
        return pose.rotation().matrix(), pose.translation(), covariance
