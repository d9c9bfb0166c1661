"""The servo of the turntable: goal and speed in, encoder out, with the limits of the motor.

There are three angles: the position of the *encoder*, which the servo controls and the host reads; that of the *shaft*,
which differs by the harmonic error of the encoder; and that of the *turntable*, the output, which follows the shaft
with backlash. The host sees the first one only.

Source: ROBOTIS e-manual, MX-28AR(2.0), https://emanual.robotis.com/docs/en/dxl/mx/mx-28-2/ (55 rpm without load at
12 V, 4096 steps a turn, velocity unit 0.229 rpm, backlash 20 arcmin = 0.33 deg). The acceleration limit is ours: about
0.6 N m left of 2.5 N m stall torque on 5.5e-3 kg m^2, the 0.83 kg sensor on its side plus the rotor through a 193:1
gear. So is the backlash model: friction holds the turntable until the shaft moves it.
"""

from __future__ import annotations

import json
import math
from collections import deque
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flow.link import Record
from flow.stage import StrictModel
from links.dynamixel.servo import TICK_RAD, VELOCITY_UNIT_RADPS
from stages.geometry.frames import Array64, Harmonic

RPM_RADPS = 2 * math.pi / 60
STEP_NS = 1_000_000
POSITION_GAIN_PER_S = 150.0  # the servo approaches its goal exponentially at this rate


class ServoSettings(StrictModel):
    """The servo and how the host reads it. The defaults have encoder steps as the only error and no command latency."""

    speed_limit_rpm: float = Field(default=55.0, gt=0)  # at 12 V
    acceleration_limit_degps2: float = Field(default=6000.0, gt=0)
    travel_deg: tuple[float, float] = (0.0, 180.0)  # position limits of the servo
    start_deg: float = 0.0
    read_rate_hz: float = Field(default=200.0, gt=1, le=500)
    read_jitter_s: float = Field(default=3e-4, ge=0)
    read_latency_s: float = Field(default=6e-4, ge=0, le=0.1)  # shortest time from request to reply
    read_latency_jitter_s: float = Field(default=1.5e-4, ge=0, le=0.1)  # one sigma, added
    command_latency_s: float = Field(default=0.0, ge=0, le=1)  # from the host's decision to its execution
    command_jitter_s: float = Field(default=0.0, ge=0, le=1)  # one sigma, added
    encoder_error_deg: float = Field(default=0.0, ge=0, le=2)  # peak; the seed draws its harmonics
    backlash_deg: float = Field(default=0.0, ge=0, le=5)  # between shaft and turntable, end to end


class Servo:
    """Position control with limited speed and acceleration. Angles are those of the encoder [rad]."""

    def __init__(self, settings: ServoSettings) -> None:
        self._speed_limit = settings.speed_limit_rpm * RPM_RADPS
        self._acceleration = math.radians(settings.acceleration_limit_degps2)
        self._travel = tuple(math.radians(a) for a in settings.travel_deg)
        self.position_rad = self.goal_rad = math.radians(settings.start_deg)
        self.velocity_radps = 0.0
        self._profile_speed = self._speed_limit

    def command(self, goal_rad: float, speed_radps: float) -> None:
        """Set goal and profile speed, limited to the position limits and the speed of the motor."""
        low, high = self._travel
        self.goal_rad = round(min(max(goal_rad, low), high) / TICK_RAD) * TICK_RAD
        self._profile_speed = min(speed_radps, self._speed_limit)

    def step(self, dt_s: float) -> None:
        """v follows min(profile, sqrt(2 a left + (a/k)^2) - a/k): it can always stop, and converges exponentially."""
        left = self.goal_rad - self.position_rad
        soft = self._acceleration / POSITION_GAIN_PER_S
        stoppable = math.sqrt(2 * self._acceleration * abs(left) + soft**2) - soft
        target = math.copysign(min(self._profile_speed, stoppable), left)
        change = self._acceleration * dt_s
        before = self.velocity_radps
        self.velocity_radps += min(max(target - before, -change), change)
        self.position_rad += 0.5 * (before + self.velocity_radps) * dt_s


class GearTrain:
    """From the encoder's position to the output, the angle of the turntable: encoder error, then backlash."""

    def __init__(self, settings: ServoSettings, seed: int) -> None:
        rng = np.random.default_rng([seed, 40])
        peak = math.radians(settings.encoder_error_deg)
        once = rng.uniform(0.5, 0.9) * peak  # once a turn: a magnet off centre; the rest, twice a turn: a tilted one
        self._amplitudes_rad = once, peak - once
        self._phases_rad = rng.uniform(0, 2 * math.pi, 2).tolist()
        self._play_rad = math.radians(settings.backlash_deg) / 2
        self._turntable_rad: float | None = None

    def encoder_error_rad(self, position_rad: float) -> float:
        """Encoder reading minus shaft angle: a_1 sin(p + b_1) + a_2 sin(2 p + b_2)."""
        (a1, a2), (b1, b2) = self._amplitudes_rad, self._phases_rad
        return a1 * math.sin(position_rad + b1) + a2 * math.sin(2 * position_rad + b2)

    def harmonics(self) -> tuple[Harmonic, ...]:
        """The same error as a calibrated rig file states it (`LidarMount.servo_harmonics`, servo_sign 1)."""
        terms = zip((1, 2), self._amplitudes_rad, self._phases_rad, strict=True)
        return tuple(
            Harmonic(order=order, amplitude_deg=round(math.degrees(a), 6), phase_deg=round(math.degrees(b), 6))
            for order, a, b in terms
        )

    def follow(self, position_rad: float) -> float:
        """Angle of the turntable after the encoder has moved to `position_rad`. Call it for every step, in order."""
        shaft = position_rad - self.encoder_error_rad(position_rad)
        before = shaft if self._turntable_rad is None else self._turntable_rad
        self._turntable_rad = min(max(before, shaft - self._play_rad), shaft + self._play_rad)
        return self._turntable_rad


class ServoCommander(Protocol):
    """Commands the servo from its readings: the script. A pipeline in closed loop uses `ServoBus.command`."""

    def decide(self, time_s: float, position_rad: float) -> tuple[float, float] | None:
        """After each reading: a new goal [rad] and speed [rad/s], or None for no change."""
        ...


class ServoBus:
    """The servo on its serial bus: it moves in 1 ms steps, is read about 200 times a second, and executes commands."""

    def __init__(
        self, settings: ServoSettings, operator: ServoCommander, start_ns: int, stamp_shift_ns: int, seed: int
    ) -> None:
        self._servo = Servo(settings)
        self._operator = operator
        self._start_ns = start_ns
        self._stamp_shift_ns = stamp_shift_ns  # error of the host's clock on servo stamps, normally 0
        self._period_ns = 1e9 / settings.read_rate_hz
        self._jitter_ns = settings.read_jitter_s * 1e9
        self._latency_ns = settings.read_latency_s * 1e9, settings.read_latency_jitter_s * 1e9
        self._command_ns = settings.command_latency_s * 1e9, settings.command_jitter_s * 1e9
        self._rng = np.random.default_rng([seed, 3])
        self._command_rng = np.random.default_rng([seed, 41])
        self._commands: deque[tuple[int, float, float]] = deque()  # (execution time, goal, speed), in order
        self._gear_train = GearTrain(settings, seed)
        self._trace_rad = [self._servo.position_rad]  # one per millisecond
        self._output_rad = [self._gear_train.follow(self._servo.position_rad)]
        self._reads = 0
        self._exchange = self._next_exchange()

    def advance(self, until_ns: int) -> list[Record]:
        """Simulate until the trace covers `until_ns`; returns the readings that ended by then."""
        records: list[Record] = []
        now_ns = self._start_ns + STEP_NS * (len(self._trace_rad) - 1)
        while now_ns < until_ns + STEP_NS:
            while self._commands and self._commands[0][0] <= now_ns:
                self._servo.command(*self._commands.popleft()[1:])
            self._servo.step(STEP_NS * 1e-9)
            self._trace_rad.append(self._servo.position_rad)
            self._output_rad.append(self._gear_train.follow(self._servo.position_rad))
            now_ns += STEP_NS
            if self._exchange[2] <= now_ns:
                records.append(self._read())
                self._exchange = self._next_exchange()
        return records

    def command(self, sent_ns: int, goal_rad: float, speed_radps: float) -> None:
        """A goal and speed that the host sends at `sent_ns`; executed after the command latency, in order.

        It does not change what `advance` has covered already.
        """
        latency_ns, jitter_ns = self._command_ns
        due_ns = sent_ns + round(latency_ns + abs(self._command_rng.normal(0, jitter_ns)))
        if self._commands:
            due_ns = max(due_ns, self._commands[-1][0])
        self._commands.append((due_ns, goal_rad, speed_radps))

    def position_rad(self, stamp_ns: NDArray[np.int64]) -> Array64:
        """The encoder's position before quantisation, at increasing times (n,) that `advance` has covered."""
        return self._at(stamp_ns, self._trace_rad)

    def output_rad(self, stamp_ns: NDArray[np.int64]) -> Array64:
        """True angle of the turntable: the reading of an ideal encoder on it, at such times."""
        return self._at(stamp_ns, self._output_rad)

    def _at(self, stamp_ns: NDArray[np.int64], trace_rad: list[float]) -> Array64:
        since = stamp_ns - self._start_ns
        first, last = int(since[0]) // STEP_NS, int(since[-1]) // STEP_NS + 2
        return np.interp(since, np.arange(first, last) * STEP_NS, trace_rad[first:last])

    def _next_exchange(self) -> tuple[int, int, int]:
        """Request, sampling and reply of the next reading [ns]; the sample is not exactly in the middle."""
        request = self._start_ns + self._reads * self._period_ns + abs(self._rng.normal(0, self._jitter_ns))
        length = self._latency_ns[0] + abs(self._rng.normal(0, self._latency_ns[1]))
        self._reads += 1
        return int(request), int(request + self._rng.uniform(0.4, 0.6) * length), int(request + length)

    def _read(self) -> Record:
        request, sampled, reply = self._exchange
        ticks = round(float(self.position_rad(np.array([sampled]))[0]) / TICK_RAD)
        velocity = round(self._servo.velocity_radps / VELOCITY_UNIT_RADPS) * VELOCITY_UNIT_RADPS
        state = {
            "position_rad": round(ticks * TICK_RAD, 9),
            "velocity_radps": round(velocity, 9),
            "goal_rad": round(self._servo.goal_rad, 9),
            "error": 0,
        }
        command = self._operator.decide((reply - self._start_ns) * 1e-9, ticks * TICK_RAD)
        if command is not None:
            self.command(reply, *command)
        stamp = (request + reply) // 2 - self._stamp_shift_ns
        return Record("/servo/state", arrival_ns=reply, stamp_ns=stamp, data=json.dumps(state).encode())
