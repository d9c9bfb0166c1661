"""An MX-28AR without its bus: control table, access rules, motion, shutdown, bus watchdog, reboot.

Every call has a time, up to which the motion is simulated in steps of 1 ms with the physics of the simulated servo, so
the same calls give the same replies. Ours, because the manufacturer does not state it: booting takes half a second; a
servo without torque keeps its position; LED, indirect data and PID gains have no effect.

Source: ROBOTIS e-manual, MX-28AR/AT(2.0), see links/dynamixel/mx28.py; motion: links/simulated/sensors/servo.py.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from links.dynamixel import mx28
from links.dynamixel.mx28 import Register
from links.simulated.sensors import protocol2
from links.simulated.sensors.protocol2 import Instruction
from links.simulated.sensors.servo import STEP_NS, GearTrain, Servo, ServoSettings
from stages.geometry.frames import Array64

KEPT_STEPS = 8192  # length of the trace: 8 s
BOOT_NS = 500_000_000
READ_ONLY = {
    mx28.MODEL_NUMBER,
    mx28.FIRMWARE_VERSION,
    mx28.HARDWARE_ERROR_STATUS,
    mx28.REALTIME_TICK,
    mx28.MOVING,
    mx28.PRESENT_LOAD,
    mx28.PRESENT_VELOCITY,
    mx28.PRESENT_POSITION,
    mx28.PRESENT_INPUT_VOLTAGE,
    mx28.PRESENT_TEMPERATURE,
}
FULL_LOAD = 1000  # Present Load, in 0.1 %


class SimulatedMx28:
    """One servo. All times are nanoseconds of one monotonic clock."""

    def __init__(
        self, settings: ServoSettings, seed: int, start_ns: int, firmware: int = 45, motor: Servo | None = None
    ) -> None:
        """`motor`: another one than that of the settings."""
        self._servo = motor or Servo(settings)
        self._gear_train = GearTrain(settings, seed)
        self._table = bytearray(mx28.TABLE_END)
        for register in mx28.REGISTERS:
            self._set(register, register.initial)
        low, high = (round(math.radians(angle) / mx28.TICK_RAD) for angle in settings.travel_deg)
        self._set(mx28.MIN_POSITION_LIMIT, max(low, 0))
        self._set(mx28.MAX_POSITION_LIMIT, min(high, mx28.STEPS_PER_TURN - 1))
        self._set(mx28.FIRMWARE_VERSION, firmware)
        self._set(mx28.RETURN_DELAY_TIME, 0)  # as grd requires; the factory setting is 250
        self._set(mx28.VELOCITY_LIMIT, 240)  # for 55 rpm; the factory setting is 230
        self._set(mx28.BAUD_RATE, mx28.BAUD_CODES[1_000_000])
        self._start_ns, self._steps = start_ns, 0
        self._trace_rad: Array64 = np.full(KEPT_STEPS, self._servo.position_rad)
        self._output_rad: Array64 = np.full(KEPT_STEPS, self._gear_train.follow(self._servo.position_rad))
        self._last_instruction_ns = self._booted_ns = self._powered_ns = start_ns
        self._blocked_since_ns: int | None = None
        self._overload_ns: int | None = None  # time of being blocked until it shuts down
        self.powered = True

    # faults and settings

    def set(self, register: Register, value: int) -> None:
        """Write a register without the access rules, as a configuration before the start."""
        self._set(register, value)

    def get(self, register: Register) -> int:
        """Current value of a register."""
        return register.value(bytes(self._table))

    def block(self, now_ns: int, overload_s: float | None = None) -> None:
        """Block the shaft from now on; after overload_s of trying to move, the servo shuts down."""
        self.advance(now_ns)
        self._blocked_since_ns = now_ns
        self._overload_ns = None if overload_s is None else round(1e9 * overload_s)

    def unblock(self, now_ns: int) -> None:
        """Release the shaft."""
        self.advance(now_ns)
        self._blocked_since_ns = None

    def shut_down(self, now_ns: int, errors: int = mx28.OVERLOAD) -> None:
        """Set hardware errors; torque stays off until a reboot if one of them is in the shutdown mask."""
        self.advance(now_ns)
        self._set(mx28.HARDWARE_ERROR_STATUS, errors)
        if errors & self.get(mx28.SHUTDOWN):
            self._set(mx28.TORQUE_ENABLE, 0)

    def power(self, now_ns: int, on: bool) -> None:
        """Switch the supply; when it is on again, the servo boots with its RAM at factory settings."""
        self.advance(now_ns)
        self.powered = on
        self._boot(now_ns)

    # requests of the host

    def baud(self) -> int:
        """Its baud rate."""
        code = self.get(mx28.BAUD_RATE)
        return next(baud for baud, number in mx28.BAUD_CODES.items() if number == code)

    def reply(self, instruction: Instruction, now_ns: int) -> bytes | None:
        """The reply to an instruction; None when it sends none."""
        self.advance(now_ns)
        own = self.get(mx28.ID)
        if not self.powered or now_ns < self._booted_ns or instruction.servo_id not in (own, protocol2.BROADCAST):
            return None
        self._last_instruction_ns = now_ns
        error, data = self._execute(instruction, now_ns)
        level = self.get(mx28.STATUS_RETURN_LEVEL)
        asked_for = {protocol2.PING: 0, protocol2.READ: 1}.get(instruction.code, mx28.ALL_INSTRUCTIONS)
        if level < asked_for or (instruction.servo_id != own and instruction.code != protocol2.PING):
            return None
        alert = mx28.ALERT if self.get(mx28.HARDWARE_ERROR_STATUS) else 0
        return protocol2.status(own, error | alert, data)

    def advance(self, now_ns: int) -> None:
        """Simulate until the trace covers a time, at most one step beyond it."""
        while self._start_ns + STEP_NS * self._steps < now_ns:
            self._step(self._start_ns + STEP_NS * (self._steps + 1))

    def position_rad(self, stamp_ns: NDArray[np.int64]) -> Array64:
        """The encoder's position before quantisation at times (n,): in the last 8 s and covered by `advance`."""
        return self._at(stamp_ns, self._trace_rad)

    def output_rad(self, stamp_ns: NDArray[np.int64]) -> Array64:
        """The true angle of the turntable at such times."""
        return self._at(stamp_ns, self._output_rad)

    def _at(self, stamp_ns: NDArray[np.int64], trace_rad: Array64) -> Array64:
        since_ns = stamp_ns - self._start_ns
        oldest = max(self._steps - KEPT_STEPS + 1, 0)  # only the steps around the times: this is called often
        first = min(max(int(since_ns.min()) // STEP_NS, oldest), self._steps)
        last = max(min(int(since_ns.max()) // STEP_NS + 1, self._steps), first)
        steps = np.arange(first, last + 1)
        return np.interp(since_ns, steps * STEP_NS, trace_rad[steps % KEPT_STEPS])

    def _step(self, now_ns: int) -> None:
        servo, before_rad = self._servo, self._servo.position_rad
        torque = self.powered and bool(self.get(mx28.TORQUE_ENABLE))
        if torque:
            self._check_watchdog(now_ns)
        else:
            servo.goal_rad = servo.position_rad
        servo.step(1e-9 * STEP_NS)
        if self._blocked_since_ns is not None:
            servo.position_rad, servo.velocity_radps = before_rad, 0.0
            since_ns = max(self._blocked_since_ns, self._booted_ns)
            over = self._overload_ns is not None and now_ns - since_ns > self._overload_ns
            if torque and over and abs(servo.goal_rad - servo.position_rad) > math.radians(2):
                self._set(mx28.HARDWARE_ERROR_STATUS, mx28.OVERLOAD)
                self._set(mx28.TORQUE_ENABLE, 0)
        self._steps += 1
        self._trace_rad[self._steps % KEPT_STEPS] = servo.position_rad
        self._output_rad[self._steps % KEPT_STEPS] = self._gear_train.follow(servo.position_rad)

    def _check_watchdog(self, now_ns: int) -> None:
        """The bus watchdog stops the servo when no instruction comes for too long."""
        limit = self.get(mx28.BUS_WATCHDOG)
        if (
            1 <= limit <= mx28.WATCHDOG_MOST
            and now_ns - self._last_instruction_ns > limit * mx28.WATCHDOG_UNIT_MS * 1_000_000
        ):
            self._set(mx28.BUS_WATCHDOG, mx28.WATCHDOG_TRIPPED)
            self._servo.goal_rad = self._servo.position_rad
            self._set(mx28.GOAL_POSITION, round(self._servo.position_rad / mx28.TICK_RAD))

    def _execute(self, instruction: Instruction, now_ns: int) -> tuple[int, bytes]:
        parameters = instruction.parameters
        if instruction.code == protocol2.PING:
            return 0, bytes(self._table[0:2]) + bytes([self.get(mx28.FIRMWARE_VERSION)])
        if instruction.code == protocol2.REBOOT:
            self._boot(now_ns)
            return 0, b""
        if instruction.code == protocol2.READ and len(parameters) == 4:
            address, length = int.from_bytes(parameters[:2], "little"), int.from_bytes(parameters[2:], "little")
            if address + length > mx28.TABLE_END:
                return mx28.DATA_LENGTH, b""
            self._update_measurements(now_ns)
            return 0, bytes(self._table[address : address + length])
        if instruction.code == protocol2.WRITE and len(parameters) > 2:
            return self._write(int.from_bytes(parameters[:2], "little"), parameters[2:]), b""
        return mx28.INSTRUCTION_ERROR, b""

    def _write(self, address: int, data: bytes) -> int:
        """The error number of a write; a write is done completely or not at all."""
        end = address + len(data)
        if end > mx28.TABLE_END:
            return mx28.DATA_LENGTH
        written = [r for r in mx28.REGISTERS if address < r.address + r.size and r.address < end]
        if any(r.address < address or r.address + r.size > end for r in written):
            return mx28.DATA_LENGTH
        torque = bool(self.get(mx28.TORQUE_ENABLE))
        if any(r in READ_ONLY or (torque and r.address < mx28.EEPROM_END) for r in written):
            return mx28.ACCESS_ERROR
        values = {r: r.value(data, address) for r in written}
        if mx28.GOAL_POSITION in values:
            if self.get(mx28.BUS_WATCHDOG) == mx28.WATCHDOG_TRIPPED:
                return mx28.DATA_RANGE
            low, high = self.get(mx28.MIN_POSITION_LIMIT), self.get(mx28.MAX_POSITION_LIMIT)
            if not low <= values[mx28.GOAL_POSITION] <= high:
                return mx28.DATA_LIMIT
        if values.get(mx28.TORQUE_ENABLE) and self.get(mx28.HARDWARE_ERROR_STATUS) & self.get(mx28.SHUTDOWN):
            return mx28.ACCESS_ERROR
        self._table[address:end] = data
        if values.keys() & {mx28.GOAL_POSITION, mx28.PROFILE_VELOCITY, mx28.TORQUE_ENABLE}:
            self._apply_goal()
        return 0

    def _apply_goal(self) -> None:
        if self.get(mx28.TORQUE_ENABLE):
            units = self.get(mx28.PROFILE_VELOCITY)
            speed_radps = units * mx28.VELOCITY_UNIT_RADPS if units else math.inf
            self._servo.command(self.get(mx28.GOAL_POSITION) * mx28.TICK_RAD, speed_radps)

    def _update_measurements(self, now_ns: int) -> None:
        """Update the registers that hold measurements."""
        servo = self._servo
        wants = self.get(mx28.TORQUE_ENABLE) and self._blocked_since_ns is not None
        left_rad = servo.goal_rad - servo.position_rad
        self._set(mx28.PRESENT_POSITION, round(float(self.position_rad(np.array([now_ns]))[0]) / mx28.TICK_RAD))
        self._set(mx28.PRESENT_VELOCITY, round(servo.velocity_radps / mx28.VELOCITY_UNIT_RADPS))
        self._set(mx28.PRESENT_LOAD, round(math.copysign(FULL_LOAD, left_rad)) if wants and abs(left_rad) > 1e-3 else 0)
        self._set(mx28.REALTIME_TICK, (now_ns - self._powered_ns) // 1_000_000 % 32768)
        self._set(mx28.MOVING, abs(servo.velocity_radps) > 10 * mx28.VELOCITY_UNIT_RADPS)

    def _boot(self, now_ns: int) -> None:
        for register in mx28.REGISTERS:
            if register.address >= mx28.EEPROM_END:
                self._set(register, register.initial)
        self._set(mx28.GOAL_POSITION, round(self._servo.position_rad / mx28.TICK_RAD))
        self._powered_ns, self._booted_ns = now_ns, now_ns + BOOT_NS

    def _set(self, register: Register, value: int) -> None:
        self._table[register.address : register.address + register.size] = register.bytes(int(value))
