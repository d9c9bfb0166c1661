"""The turntable's angle at each laser pulse, and the returns and pulses transformed to the vehicle frame by it.

p_vehicle = T_vehicle_turntable Rz(angle) T_turntable_lidar p_lidar, with the angle interpolated linearly between the
two servo states around each pulse. Nothing is extrapolated: a pulse before the first state, after the last one, or in a
gap longer than allowed has no angle, and its return is omitted and counted.

Source: P III.A; DESIGN, Frames. Per-pulse interpolation is ours: 1 ms at 57 rpm is 12 cm at 20 m.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64, LidarMount
from stages.kernels.lidar.packets import Firings
from stages.kernels.sweep.turntable import Pulses, Returns, place_slice, turns_at
from stages.messages import LidarFirings, ServoState, SweptPoints, SweptPulses

STATES_KEPT = 512  # 5 s at 100 Hz: longer than any packet waits


class GearPlay:
    """Backlash of the gear: the turntable rests until the servo has crossed the play.

    The position within the play before the first motion is not known: the middle is assumed. Angles in the servo's
    sense of rotation.
    """

    def __init__(self, mount: LidarMount) -> None:
        self.half_rad = math.radians(mount.servo_play_deg) / 2
        self.lag_rad = 0.0  # lag of the turntable behind the servo

    def move(self, step_rad: float) -> None:
        """Add a step of the servo."""
        self.lag_rad = min(max(self.lag_rad + step_rad, -self.half_rad), self.half_rad)

    def goal_rad(self, servo_rad: float, wanted_rad: float) -> float:
        """Servo goal, from servo_rad, that brings the table to where wanted_rad would bring it without play."""
        return wanted_rad + math.copysign(self.half_rad, wanted_rad - (servo_rad - self.lag_rad))


class Turntable:
    """Recent servo states as turntable angles over time, and the LiDAR's mount."""

    def __init__(self, mount: LidarMount, max_gap_s: float, min_range_m: float) -> None:
        self._mount = mount
        self._max_gap_ns = round(max_gap_s * 1e9)
        self._min_range_m = min_range_m
        self._offset_ns = round(mount.servo_time_offset_s * 1e9)
        self.T_vehicle_turntable = mount.T_vehicle_turntable.matrix()
        self._T_turntable_lidar = mount.T_turntable_lidar.matrix()
        self._last_servo_rad: float | None = None
        self._play = GearPlay(mount)
        self._states: deque[tuple[int, float]] = deque(maxlen=STATES_KEPT)
        self._arrays: tuple[NDArray[np.int64], Array64] | None = None  # the states; None: changed since

    @property
    def known_until_ns(self) -> int | None:
        """Stamp of the newest servo state; None before the first."""
        return self._states[-1][0] if self._states else None

    def add(self, servo: ServoState) -> None:
        """Add a servo state. One that is not newer than the last is ignored: it is a repeated reply.

        A single-turn encoder jumps by a full turn at its end; steps are unwrapped to the shorter direction.
        """
        stamp_ns = servo.stamp_ns + self._offset_ns
        if self._states and stamp_ns <= self._states[-1][0]:
            return
        servo_rad = servo.position_rad
        if self._last_servo_rad is not None:
            step_rad = math.remainder(servo_rad - self._last_servo_rad, math.tau)
            servo_rad = self._last_servo_rad + step_rad
            self._play.move(step_rad)
        self._last_servo_rad = servo_rad
        angle_rad = self._mount.turntable_rad(servo_rad) - self._mount.servo_sign * self._play.lag_rad
        self._states.append((stamp_ns, angle_rad))
        self._arrays = None

    def forget_before(self, t_ns: int) -> None:
        """Drop states that no later pulse needs: all but the last one at or before t_ns."""
        while len(self._states) > 1 and self._states[1][0] <= t_ns:
            self._states.popleft()
            self._arrays = None

    def _state_arrays(self) -> tuple[NDArray[np.int64], Array64]:
        """Stamps and angles (n,) of the states."""
        if self._arrays is None:
            stamps_ns = np.array([t for t, _ in self._states], dtype=np.int64)
            self._arrays = stamps_ns, np.array([angle for _, angle in self._states], dtype=np.float64)
        return self._arrays

    def turns(self, pulse_ns: NDArray[np.int64]) -> Array64:
        """Angle, cosine and sine (n, 3) at each pulse; NaN where the angle is not known."""
        turn = np.empty((pulse_ns.size, 3))
        if self._mount.turns:
            turns_at(pulse_ns, *self._state_arrays(), self._max_gap_ns, turn)
        else:
            turn[:] = 0.0, 1.0, 0.0
        return turn

    def place(self, firings: LidarFirings, turns: Array64) -> tuple[SweptPoints, SweptPulses]:
        """The slice's returns and pulses in the vehicle frame; `turns`: as returned for its pulses.

        A return without an angle is omitted and counted; pulses are empty unless the angle is known for all of them.
        """
        n = firings.pulse_stamp_ns.size
        returns, pulses = _empty_returns(n), _empty_pulses(n)
        placed, unplaced, count, fired, origin = place_slice(
            _columns(firings),
            firings.laser_elevation_rad,
            turns,
            self._min_range_m,
            self.T_vehicle_turntable,
            self._T_turntable_lidar,
            returns,
            pulses,
        )
        first_ns, last_ns = int(firings.pulse_stamp_ns[0]), int(firings.pulse_stamp_ns[-1])
        points = SweptPoints(
            stamp_ns=first_ns,
            point_stamp_ns=returns.stamp_ns[:placed],
            xyz_vehicle_m=returns.xyz_m[:placed],
            laser=returns.laser[:placed],
            reflectivity=returns.reflectivity[:placed],
            turntable_rad=returns.turntable_rad[:placed],
            pulses=fired,
            origin_vehicle_m=origin,
            unplaced=unplaced,
            reason=self.why_unknown(last_ns if math.isnan(turns[-1, 0]) else first_ns) if unplaced else "",
        )
        swept = SweptPulses(
            stamp_ns=first_ns,
            point_stamp_ns=pulses.stamp_ns[:count],
            direction_vehicle=pulses.direction[:count],
            range_m=pulses.range_m[:count],
            laser=pulses.laser[:count],
            reflectivity=pulses.reflectivity[:count],
            turntable_rad=float(turns[n // 2, 0]),
            origin_vehicle_m=origin,
        )
        return points, swept

    def why_unknown(self, t_ns: int) -> str:
        """The reason why the angle at a time is not known."""
        if not self._states:
            return "no servo state yet: is the servo link wired to this stage, and does the servo answer?"
        first_ns, last_ns = self._states[0][0], self._states[-1][0]
        if t_ns < first_ns:
            return f"no servo state before the pulse; the first came {(first_ns - t_ns) / 1e9:.3f} s after it"
        if t_ns > last_ns:
            return f"no servo state after the pulse; the last came {(t_ns - last_ns) / 1e9:.3f} s before it"
        state_ns, _ = self._state_arrays()
        after = int(np.searchsorted(state_ns, t_ns))
        gap_s = (state_ns[after] - state_ns[after - 1]) / 1e9
        return f"the servo was silent for {gap_s:.3f} s, allowed are {self._max_gap_ns / 1e9:.3f} s"


def _columns(firings: LidarFirings) -> Firings:
    """The arrays of a message as the kernel takes them."""
    return Firings(
        firings.pulse_stamp_ns,
        firings.laser,
        firings.azimuth_rad,
        firings.range_m,
        firings.reflectivity,
        firings.return_kind,
        firings.xyz_lidar_m,
    )


def _empty_returns(n: int) -> Returns:
    return Returns(
        stamp_ns=np.empty(n, np.int64),
        xyz_m=np.empty((n, 3), np.float32),
        laser=np.empty(n, np.uint8),
        reflectivity=np.empty(n, np.uint8),
        turntable_rad=np.empty(n, np.float32),
    )


def _empty_pulses(n: int) -> Pulses:
    return Pulses(
        stamp_ns=np.empty(n, np.int64),
        direction=np.empty((n, 3), np.float32),
        range_m=np.empty(n, np.float32),
        laser=np.empty(n, np.uint8),
        reflectivity=np.empty(n, np.uint8),
    )
