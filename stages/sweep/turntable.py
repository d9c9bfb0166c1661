"""The turntable's angle at each laser pulse, and the returns and pulses transformed to the vehicle frame by it.

p_vehicle = T_vehicle_turntable Rz(angle) T_turntable_lidar p_lidar, with the angle interpolated linearly between the
two servo states around each pulse. Nothing is extrapolated: a pulse before the first state, after the last one, or in a
gap longer than allowed has no angle, and its return is omitted and counted.

Source: P III.A; DESIGN, Frames. Per-pulse interpolation is ours: 1 ms at 57 rpm is 12 cm at 20 m.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64, LidarMount
from stages.kernels.sweep.turntable import place_pulses, place_returns, turns_at
from stages.messages import LidarFirings, ServoState, SweptPulses

STATES_KEPT = 512  # 5 s at 100 Hz: longer than any packet waits


class Placed(NamedTuple):
    """Returns of one packet in the vehicle frame."""

    pulse: NDArray[np.int64]  # (n,) index of the pulse in the packet
    xyz_vehicle_m: NDArray[np.float32]  # (n, 3)
    turntable_rad: NDArray[np.float32]  # (n,)
    unplaced: int


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
        self._rows_vehicle_turntable: list[list[float]] = self.T_vehicle_turntable[:3].tolist()  # used per packet
        self._T_turntable_lidar = mount.T_turntable_lidar.matrix()
        self._lidar_turntable_m: tuple[float, float, float] = tuple(self._T_turntable_lidar[:3, 3].tolist())
        self._last_servo_rad: float | None = None
        self._play = GearPlay(mount)
        self._states: deque[tuple[int, float]] = deque(maxlen=STATES_KEPT)
        self._state_ns = np.empty(0, dtype=np.int64)
        self._state_rad = np.empty(0)

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
        self._freeze()

    def forget_before(self, t_ns: int) -> None:
        """Drop states that no later pulse needs: all but the last one at or before t_ns."""
        dropped = False
        while len(self._states) > 1 and self._states[1][0] <= t_ns:
            self._states.popleft()
            dropped = True
        if dropped:
            self._freeze()

    def _freeze(self) -> None:
        self._state_ns = np.array([t for t, _ in self._states], dtype=np.int64)
        self._state_rad = np.array([angle for _, angle in self._states])

    def lidar_origin_vehicle_m(self, angle_rad: float) -> tuple[float, float, float]:
        """Origin of the beams for a turntable angle; NaN counts as 0."""
        angle_rad = 0.0 if math.isnan(angle_rad) else angle_rad
        x, y, z = self._lidar_turntable_m
        c, s = math.cos(angle_rad), math.sin(angle_rad)
        x, y = c * x - s * y, s * x + c * y
        a, b, c = self._rows_vehicle_turntable
        return (
            a[0] * x + a[1] * y + a[2] * z + a[3],
            b[0] * x + b[1] * y + b[2] * z + b[3],
            c[0] * x + c[1] * y + c[2] * z + c[3],
        )

    def turns(self, pulse_ns: NDArray[np.int64]) -> Array64:
        """Angle, cosine and sine (n, 3) at each pulse; NaN where the angle is not known."""
        turn = np.empty((pulse_ns.size, 3))
        if self._mount.turns:
            turns_at(pulse_ns, self._state_ns, self._state_rad, self._max_gap_ns, turn)
        else:
            turn[:] = 0.0, 1.0, 0.0
        return turn

    def place(self, firings: LidarFirings, turns: Array64) -> Placed:
        """The packet's returns in the vehicle frame; `turns`: as returned for its pulses."""
        n = firings.pulse_stamp_ns.size
        pulse = np.empty(n, dtype=np.int64)
        xyz_vehicle_m = np.empty((n, 3), dtype=np.float32)
        turntable_rad = np.empty(n, dtype=np.float32)
        placed, unplaced = place_returns(
            firings.range_m,
            firings.xyz_lidar_m,
            turns,
            self._min_range_m,
            self.T_vehicle_turntable,
            self._T_turntable_lidar,
            pulse,
            xyz_vehicle_m,
            turntable_rad,
        )
        return Placed(pulse[:placed], xyz_vehicle_m[:placed], turntable_rad[:placed], unplaced)

    def pulses(self, firings: LidarFirings, turns: Array64) -> SweptPulses:
        """All pulses of the packet in the vehicle frame; empty unless the angle is known for all of them."""
        pulse_ns = firings.pulse_stamp_ns
        n = pulse_ns.size
        middle_rad = float(turns[n // 2, 0])
        origin = self.lidar_origin_vehicle_m(middle_rad)
        row = np.empty(n, dtype=np.int64)
        direction_vehicle = np.empty((n, 3), dtype=np.float32)
        distance_m = np.empty(n, dtype=np.float32)
        count = place_pulses(
            firings.return_kind,
            firings.laser,
            firings.azimuth_rad,
            firings.range_m,
            firings.xyz_lidar_m,
            firings.laser_elevation_rad,
            turns,
            self.T_vehicle_turntable,
            self._T_turntable_lidar,
            np.array(origin),
            row,
            direction_vehicle,
            distance_m,
        )
        laser, reflectivity = firings.laser, firings.reflectivity
        if count < n:  # otherwise each pulse has one row, in order, and the packet's arrays are used
            row = row[:count]
            pulse_ns, laser, reflectivity = pulse_ns[row], laser[row], reflectivity[row]
        return SweptPulses(
            stamp_ns=int(firings.pulse_stamp_ns[0]),
            point_stamp_ns=pulse_ns,
            direction_vehicle=direction_vehicle[:count],
            range_m=distance_m[:count],
            laser=laser,
            reflectivity=reflectivity,
            turntable_rad=middle_rad,
            origin_vehicle_m=origin,
        )

    def why_unknown(self, t_ns: int) -> str:
        """The reason why the angle at a time is not known."""
        if not self._states:
            return "no servo state yet: is the servo link wired to this stage, and does the servo answer?"
        first_ns, last_ns = self._states[0][0], self._states[-1][0]
        if t_ns < first_ns:
            return f"no servo state before the pulse; the first came {(first_ns - t_ns) / 1e9:.3f} s after it"
        if t_ns > last_ns:
            return f"no servo state after the pulse; the last came {(t_ns - last_ns) / 1e9:.3f} s before it"
        after = int(np.searchsorted(self._state_ns, t_ns))
        gap_s = (self._state_ns[after] - self._state_ns[after - 1]) / 1e9
        return f"the servo was silent for {gap_s:.3f} s, allowed are {self._max_gap_ns / 1e9:.3f} s"
