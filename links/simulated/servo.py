"""The turntable's servo: a goal and a speed in, an encoder out, with the motor's limits between.

Source: ROBOTIS e-manual, MX-28AR(2.0), https://emanual.robotis.com/docs/en/dxl/mx/mx-28-2/ (55 rpm without load at
12 V, 4096 steps a turn, velocity unit 0.229 rpm). The acceleration limit is ours: some 0.6 N m left of 2.5 N m stall
torque on 5.5e-3 kg m^2, the 0.83 kg sensor on its side plus the rotor through a 193:1 gear.
"""

from __future__ import annotations

import json
import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from flow.link import Record
from links.simulated.mesh import Array64

TICKS_PER_TURN = 4096
TICK_RAD = 2 * math.pi / TICKS_PER_TURN
RPM_RADPS = 2 * math.pi / 60
VELOCITY_UNIT_RADPS = 0.229 * RPM_RADPS
STEP_NS = 1_000_000
POSITION_GAIN_PER_S = 150.0  # near the goal the servo approaches it exponentially


class ServoSettings(BaseModel):
    """The servo and how often the host reads it."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    speed_limit_rpm: float = Field(default=55.0, gt=0)  # at 12 V
    acceleration_limit_degps2: float = Field(default=6000.0, gt=0)
    travel_deg: tuple[float, float] = (0.0, 180.0)  # the servo's own position limits
    start_deg: float = 0.0
    read_rate_hz: float = Field(default=200.0, gt=1, le=500)
    read_jitter_s: float = Field(default=3e-4, ge=0)


class Servo:
    """Position control with limited speed and acceleration. Angles are the servo's own (its encoder's) [rad]."""

    def __init__(self, settings: ServoSettings) -> None:
        self._speed_limit = settings.speed_limit_rpm * RPM_RADPS
        self._acceleration = math.radians(settings.acceleration_limit_degps2)
        self._travel = tuple(math.radians(a) for a in settings.travel_deg)
        self.position_rad = self.goal_rad = math.radians(settings.start_deg)
        self.velocity_radps = 0.0
        self._profile_speed = self._speed_limit

    def command(self, goal_rad: float, speed_radps: float) -> None:
        """A new goal and profile speed. The servo keeps to its position limits and to what its motor can do."""
        low, high = self._travel
        self.goal_rad = round(min(max(goal_rad, low), high) / TICK_RAD) * TICK_RAD
        self._profile_speed = min(speed_radps, self._speed_limit)

    def step(self, dt_s: float) -> None:
        """v follows min(profile, sqrt(2 a left + (a/k)^2) - a/k): it can always stop, and ends exponentially."""
        left = self.goal_rad - self.position_rad
        soft = self._acceleration / POSITION_GAIN_PER_S
        stoppable = math.sqrt(2 * self._acceleration * abs(left) + soft**2) - soft
        wanted = math.copysign(min(self._profile_speed, stoppable), left)
        change = self._acceleration * dt_s
        before = self.velocity_radps
        self.velocity_radps += min(max(wanted - before, -change), change)
        self.position_rad += 0.5 * (before + self.velocity_radps) * dt_s


class Operator(Protocol):
    """Who commands the servo: a script, or a pipeline in closed loop."""

    def decide(self, time_s: float, position_rad: float) -> tuple[float, float] | None:
        """After each reading: a new (goal [rad], speed [rad/s]), or None to leave it."""
        ...


class ServoBus:
    """The servo on its serial line: moves in 1 ms steps, is read about 200 times a second, obeys the operator."""

    def __init__(
        self, settings: ServoSettings, operator: Operator, start_ns: int, stamp_shift_ns: int, seed: int
    ) -> None:
        self._servo = Servo(settings)
        self._operator = operator
        self._start_ns = start_ns
        self._stamp_shift_ns = stamp_shift_ns  # the host's clock error on servo stamps, normally 0
        self._period_ns = 1e9 / settings.read_rate_hz
        self._jitter_ns = settings.read_jitter_s * 1e9
        self._rng = np.random.default_rng([seed, 3])
        self._trace_rad = [self._servo.position_rad]  # one a millisecond
        self._reads = 0
        self._exchange = self._next_exchange()

    def advance(self, until_ns: int) -> list[Record]:
        """Move on until the trace covers `until_ns`; the readings that ended by then."""
        records: list[Record] = []
        now_ns = self._start_ns + STEP_NS * (len(self._trace_rad) - 1)
        while now_ns < until_ns + STEP_NS:
            self._servo.step(STEP_NS * 1e-9)
            self._trace_rad.append(self._servo.position_rad)
            now_ns += STEP_NS
            if self._exchange[2] <= now_ns:
                records.append(self._read())
                self._exchange = self._next_exchange()
        return records

    def position_rad(self, stamp_ns: NDArray[np.int64]) -> Array64:
        """The encoder's position before quantisation, at growing times (n,) that `advance` has covered."""
        since = stamp_ns - self._start_ns
        first, last = int(since[0]) // STEP_NS, int(since[-1]) // STEP_NS + 2
        return np.interp(since, np.arange(first, last) * STEP_NS, self._trace_rad[first:last])

    def _next_exchange(self) -> tuple[int, int, int]:
        """Request, sampling and reply of the next reading [ns]: the sample is not exactly in the middle."""
        request = self._start_ns + self._reads * self._period_ns + abs(self._rng.normal(0, self._jitter_ns))
        length = 6e5 + abs(self._rng.normal(0, 1.5e5))
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
            self._servo.command(*command)
        stamp = (request + reply) // 2 - self._stamp_shift_ns
        return Record("/servo/state", arrival_ns=reply, stamp_ns=stamp, data=json.dumps(state).encode())
