"""Online estimate of the time offset between servo and LiDAR, from surfaces observed in both sweep directions.

If the servo's stamps are early by dt, a surface passed at the rate w is placed w dt away from its position, and on the
other side when it is passed in the opposite direction. From a window of some seconds in which the servo passes the same
angles in both directions, the estimated dt is the one under which surfaces observed twice coincide: the least squares
of `grd calibrate` (stages/calibration), with the mount's other parameters held near the rig's. A Kalman filter with a
slow random walk combines the windows. A window takes a fifth of a second of one core; once the offset is known to 1 ms,
only every `every_window`-th is evaluated.

The offset is published, not applied: the crew enters it in the rig (`servo_time_offset_s`). A window gives no estimate
if the vehicle moved or the servo did not turn in both directions. Gear play looks like a delay at one speed: the rig's
`servo_play_deg` is taken as known to `play_sigma_deg`. Errors of the rig's parameters are common to all windows: that
part of sigma is kept separately and does not decrease. Windows with short, fast moves have a further systematic error
of 0.1 to 0.5 ms in simulated flights, hence `floor_s`.

Source: ours; the model is `stages/calibration/servo_mount.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from flow.stage import Settings, Stage
from stages.calibration.parameters import PARAMETERS
from stages.calibration.scan_passes import Returns, ServoTrace
from stages.calibration.servo_mount import servo_mount
from stages.calibration.solve import (
    COARSE_RAD,
    FINE_RAD,
    INFLATION,
    NAMES,
    System,
    linearise,
    one_step,
    prior_information,
    sandwich,
)
from stages.geometry.frames import Array64, LidarMount
from stages.geometry.rig_lidar import RigLidar
from stages.messages import LidarFirings, MotionStatus, ServoOffset, ServoState, VehicleMotion

TIME = NAMES.index("time")
STEP_RAD = math.tau / 4096  # of the MX-28's encoder
MOVING_RADPS = 0.1  # slower, the direction of a state is not known
BIN_RAD = math.radians(0.5)
START_SIGMA_S = 0.02
KNOWN_S = 1e-3  # below this sigma fewer iterations and fewer windows are used
MAX_POSITIONS = 4096
TRACE_NS = 500_000_000  # of servo states before a window
AXIS_SIGMA_M = 3e-3
FEWEST_PATCHES = 20
OUTLIER = 5.0  # sigmas of a window from the estimate so far
WALK_S = 5e-6  # random walk of the offset, one sigma after 1 s


class ServoClockSettings(Settings):
    """Settings of `ServoClock`."""

    mount: LidarMount
    unit: RigLidar = RigLidar()  # model of the LiDAR
    window_s: float = Field(3.0, ge=1, le=20)
    every_packet: int = Field(12, ge=1, le=100)  # every n-th LiDAR message is used
    every_window: int = Field(10, ge=1, le=1000)  # every n-th window is evaluated, once the offset is known to KNOWN_S
    both_ways_deg: float = Field(5.0, gt=0)  # least angle passed in both directions
    play_sigma_deg: float = Field(0.05, gt=0)  # sigma of the rig's gear play
    angle_sigma_deg: float = Field(0.05, gt=0)  # sigma of the LiDAR's tilt and of the encoder error
    floor_s: float = Field(3e-4, gt=0)  # lower bound of the published sigma
    moved_m: float = Field(0.03, gt=0)  # a vehicle that moves further within a window is not parked
    max_servo_gap_s: float = Field(0.1, gt=0)


class ServoClock(Stage[ServoClockSettings]):
    """The servo's time offset with its sigma, window by window. Wire `motion` where the vehicle has odometry."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"motion"})

    def __init__(self, settings: ServoClockSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._firings: list[LidarFirings] = []
        self._states: list[ServoState] = []
        self._positions: list[Array64] = []
        self._packets: int = 0
        self._offset_s: float = 0.0  # beyond the rig's
        self._variance_s2: float = START_SIGMA_S**2
        self._shared_s: float = 0.0  # sigma of the error common to all windows
        self._windows: int = 0
        self._known_ns: int | None = None
        self._resting_until_ns: int = 0
        settings = self.settings
        angle_rad = math.radians(settings.angle_sigma_deg)
        sigmas = {"axis_x": AXIS_SIGMA_M, "axis_y": AXIS_SIGMA_M, "time": START_SIGMA_S}
        sigmas["play"] = math.radians(settings.play_sigma_deg)
        self._prior, self._rig = prior_information(settings.unit.profile.lasers), servo_mount(settings.mount)
        for i, parameter in enumerate(PARAMETERS):
            self._prior[i, i] = sigmas.get(parameter.name, angle_rad) ** -2.0

    def on_motion(self, motion: VehicleMotion) -> None:
        """Buffer the vehicle's position."""
        if motion.stamp_ns < self._resting_until_ns or motion.status is MotionStatus.DENIED:
            self._positions.clear()
        self._positions.append(motion.xyz_map_m)
        del self._positions[:-MAX_POSITIONS]

    def on_servo(self, servo: ServoState) -> None:
        """Buffer the servo state."""
        if servo.stamp_ns < self._resting_until_ns - TRACE_NS:
            return
        if not self._states or servo.stamp_ns > self._states[-1].stamp_ns:
            self._states.append(servo)
        if self._states[-1].stamp_ns - self._states[0].stamp_ns > 3.0 * self.settings.window_s * 1e9 + 2 * TRACE_NS:
            self._states, self._firings, self._positions = [], [], self._positions[-1:]  # no data of the LiDAR: reset

    def on_firings(self, firings: LidarFirings) -> Iterator[ServoOffset]:
        """Buffer the packet; at the end of a window, publish the estimate."""
        settings = self.settings
        if not settings.mount.turns or firings.pulse_stamp_ns.size == 0 or firings.stamp_ns < self._resting_until_ns:
            return
        self._packets += 1
        if self._packets % settings.every_packet == 0:
            self._firings.append(firings)
        if self._firings and firings.stamp_ns - self._firings[0].stamp_ns > settings.window_s * 1e9:
            reason = self._take_window()
            if self._known_ns == self._firings[-1].stamp_ns and self._variance_s2 < KNOWN_S**2:
                self._resting_until_ns = firings.stamp_ns + round((settings.every_window - 1) * settings.window_s * 1e9)
            self._firings, self._positions = [], self._positions[-1:]
            self._states = [s for s in self._states if s.stamp_ns > firings.stamp_ns - TRACE_NS]
            yield self._estimate(firings.stamp_ns, reason)

    def _estimate(self, stamp_ns: int, reason: str) -> ServoOffset:
        settings = self.settings
        known = self._windows > 0
        sigma_s = math.sqrt(self._variance_s2 + self._shared_s**2 + settings.floor_s**2)
        return ServoOffset(
            stamp_ns=stamp_ns,
            offset_s=settings.mount.servo_time_offset_s + self._offset_s if known else None,
            sigma_s=sigma_s if known else None,
            rig_offset_s=settings.mount.servo_time_offset_s,
            windows=self._windows,
            reason=reason,
        )

    def _take_window(self) -> str:
        """Evaluate the window; return its result, or why it has none."""
        if len(self._positions) > 1 and np.ptp(np.stack(self._positions), axis=0).max() > self.settings.moved_m:
            return "the vehicle moved"
        states = self._states
        if len(states) < 10:
            return "too few servo states"
        stamp_ns = np.array([s.stamp_ns for s in states])
        position_rad = np.array([s.position_rad for s in states])
        both_rad = both_ways_rad(stamp_ns, position_rad)
        if both_rad < math.radians(self.settings.both_ways_deg):
            return f"the servo passed {math.degrees(both_rad):.1f} deg in both directions, less than both_ways_deg"
        found = self._solve(ServoTrace.of(stamp_ns, position_rad, STEP_RAD))
        if found is None:
            return "too few flat surfaces were observed"
        return self._add(*found)

    def _solve(self, trace: ServoTrace) -> tuple[float, float, float] | None:
        """Offset beyond the rig's, its own sigma, and the sigma common to all windows [s]; None: too few patches."""
        hit = [(f, f.range_m > 0) for f in self._firings]
        returns = Returns(
            np.concatenate([f.pulse_stamp_ns[h] for f, h in hit]),
            np.concatenate([f.laser[h] for f, h in hit]),
            np.concatenate([f.xyz_lidar_m[h] for f, h in hit]).astype(np.float64),
            self.settings.unit.profile.lasers,
        )
        close = self._variance_s2 < KNOWN_S**2
        x, mount = np.zeros(len(self._prior)), self._rig
        if close:  # start from the estimate so far
            x[TIME], mount = self._offset_s, mount.moved({"time": self._offset_s})
        variance_s2, common_s2 = math.inf, 0.0
        for tolerance_rad in (*(COARSE_RAD[2:] if close else COARSE_RAD), FINE_RAD, FINE_RAD):
            system = linearise(returns, trace, mount, x[len(NAMES) :], tolerance_rad, self.settings.max_servo_gap_s)
            if system is None or len(system.patches.first) < FEWEST_PATCHES:
                return None
            step = one_step(system, x, self._prior)
            x, mount = x + step, mount.moved(dict(zip(NAMES, step.tolist(), strict=False)))
            if tolerance_rad == FINE_RAD:
                covariance = sandwich(system, returns.stamp_ns[system.chosen], self._prior)
                common_s2 = shared_s2(system, self._prior)
                variance_s2 = float(covariance[TIME, TIME]) - INFLATION**2 * common_s2
        return float(x[TIME]), math.sqrt(variance_s2), math.sqrt(common_s2)

    def _add(self, found_s: float, own_s: float, shared_s: float) -> str:
        """x <- x + K (z - x), K = P / (P + R), after P <- P + q dt; P and R without the error common to all windows."""
        now_ns = self._firings[-1].stamp_ns
        if self._known_ns is not None:
            self._variance_s2 += WALK_S**2 * (now_ns - self._known_ns) * 1e-9
        self._known_ns = now_ns
        window_s, sigma_s = self.settings.mount.servo_time_offset_s + found_s, math.hypot(own_s, shared_s)
        result = f"{1e3 * window_s:.2f} ms, sigma {1e3 * sigma_s:.2f} ms"
        total_s2 = self._variance_s2 + own_s**2
        if self._windows and (found_s - self._offset_s) ** 2 > OUTLIER**2 * (
            total_s2 + shared_s**2 + self.settings.floor_s**2
        ):
            self._variance_s2 += (
                found_s - self._offset_s
            ) ** 2 / OUTLIER**2  # accepted if the next windows agree with it
            return f"this window disagrees: {result}"
        gain = self._variance_s2 / total_s2
        self._offset_s += gain * (found_s - self._offset_s)
        self._shared_s += gain * (shared_s - self._shared_s)
        self._variance_s2 *= 1.0 - gain
        self._windows += 1
        return f"this window alone: {result}"


def shared_s2(system: System, prior: Array64) -> float:
    """The part of the offset's variance from errors of the rig's other parameters, common to all windows.

    Off by e ~ P^-1 they move the offset by (B P e)_t: variance (B P B)_tt with B = (J^T J / v + P)^-1; the prior
    of the time itself is excluded.
    """
    J, v = system.columns, system.variance_factor
    others = prior.copy()
    others[TIME, TIME] = 0.0
    row = np.linalg.inv(J.T @ J / v + prior)[TIME]
    return float(row @ others @ row)


def both_ways_rad(stamp_ns: np.ndarray, position_rad: Array64) -> float:
    """Angle [rad] that the servo passed in both directions, from its states (n,)."""
    position_rad = np.unwrap(position_rad)
    rate = np.gradient(position_rad, stamp_ns * 1e-9)
    number = np.floor(position_rad / BIN_RAD).astype(np.int64)
    up, down = number[rate > MOVING_RADPS], number[rate < -MOVING_RADPS]
    return BIN_RAD * len(np.intersect1d(up, down))
