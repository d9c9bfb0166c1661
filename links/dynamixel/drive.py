"""Drive: checks and sets up one servo, reads its position, and moves and stops it.

After any fault, `set_up` restores operation. It sets the goal to the present position before it enables torque, so
that nothing moves until a goal is sent. It also arms the servo's bus watchdog, which stops the servo when no request
arrives, for example because this process has died.

Source: registers by the e-manual, see links/dynamixel/mx28.py.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass

from links.dynamixel import mx28
from links.dynamixel.bus import Bus, BusError, BusReply, NoReply
from links.dynamixel.mx28 import Register

POSITION_BLOCK = mx28.PRESENT_LOAD.address  # load, velocity, position: 126..135
POSITION_BYTES = 10
LENGTHS = 4  # lengths of the position block, used in turn, so that a late reply has a wrong length
HEALTH_BLOCK, HEALTH_BYTES = mx28.TORQUE_ENABLE.address, 7  # torque .. hardware error: 64..70
SUPPLY_BLOCK, SUPPLY_BYTES = mx28.PRESENT_INPUT_VOLTAGE.address, 3
ARRIVED_TICKS = 23  # 2 deg: within this distance the goal counts as reached


class SetupError(Exception):
    """The servo must not be driven until an operator changes something, which the text names."""


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """Connection, limits and timing of the servo; passed to its process as JSON."""

    port: str
    servo_id: int
    baud: int
    limit_ticks: tuple[int, int]  # soft limits; the servo's own limits must contain them
    max_velocity_units: int  # profile velocity of the fastest goal; the servo's own limit must not be below
    watchdog_ms: int
    reply_timeout_ms: float
    goal_slack_ms: float  # a goal not reached this long after its expected travel time is abandoned
    rate_hz: float
    start_s: float  # it must reply once within this time
    write_settings: bool  # correct the servo's EEPROM instead of raising SetupError
    reboot: bool  # after a shutdown

    def text(self) -> str:
        """As JSON, for a command line."""
        return json.dumps(asdict(self))

    @classmethod
    def from_text(cls, text: str) -> DriveSettings:
        """Settings from the JSON of `text`."""
        fields = json.loads(text)
        return cls(**{**fields, "limit_ticks": tuple(fields["limit_ticks"])})


@dataclass(frozen=True, slots=True)
class Measurement:
    """Position and velocity from one block read."""

    request_ns: int
    reply_ns: int
    position_ticks: int
    velocity_units: int
    alert: bool


@dataclass(frozen=True, slots=True)
class Condition:
    """State that is read less often."""

    torque: bool
    error: int
    watchdog_tripped: bool


class Drive:
    """One MX-28 on an open bus."""

    def __init__(self, bus: Bus, settings: DriveSettings) -> None:
        self._bus, self._settings = bus, settings
        self._reads = 0
        self._servo_limits = 0, mx28.STEPS_PER_TURN - 1
        self.goal_ticks = 0

    def set_up(self) -> int:
        """Check and configure the servo, and enable torque at the present position.

        Returns the hardware error bits that cause no shutdown, such as the input voltage. Raises SetupError; BusError
        when it does not reply; Shutdown after a hardware error.
        """
        self._check_identity()
        self._enable_replies()
        table = self._bus.read(0, mx28.EEPROM_END).data
        self._check_table(table)
        health = self._bus.read(HEALTH_BLOCK, HEALTH_BYTES)
        error = mx28.HARDWARE_ERROR_STATUS.value(health.data, HEALTH_BLOCK)
        if error & mx28.SHUTDOWN.value(table):
            raise Shutdown(error)
        write = self._bus.write
        write(mx28.BUS_WATCHDOG, 0)
        position_ticks = self.measure().position_ticks
        if not mx28.TORQUE_ENABLE.value(health.data, HEALTH_BLOCK):
            self._check_position(position_ticks)
        low, high = self._servo_limits
        self.goal_ticks = min(max(position_ticks, low), high)
        write(
            mx28.PROFILE_ACCELERATION, 0, 1, self.goal_ticks
        )  # acceleration, velocity, goal: three adjacent registers
        write(mx28.TORQUE_ENABLE, 1)
        write(mx28.BUS_WATCHDOG, min(math.ceil(self._settings.watchdog_ms / mx28.WATCHDOG_UNIT_MS), mx28.WATCHDOG_MOST))
        return error

    def measure(self) -> Measurement:
        """Read the position. Each call requests another length, so that a late reply is not mistaken for this one's."""
        self._reads += 1
        reply: BusReply = self._bus.read(POSITION_BLOCK, POSITION_BYTES + self._reads % LENGTHS)
        return Measurement(
            reply.request_ns,
            reply.reply_ns,
            mx28.PRESENT_POSITION.value(reply.data, POSITION_BLOCK),
            mx28.PRESENT_VELOCITY.value(reply.data, POSITION_BLOCK),
            reply.alert,
        )

    def go(self, position_ticks: int, velocity_units: int) -> None:
        """Write a new goal and speed in one packet."""
        self._bus.write(mx28.PROFILE_VELOCITY, velocity_units, position_ticks)
        self.goal_ticks = position_ticks

    def stop(self) -> None:
        """Stop: set the goal to the present position; torque stays on."""
        low, high = self._servo_limits
        position_ticks = min(max(self.measure().position_ticks, low), high)
        self._bus.write(mx28.GOAL_POSITION, position_ticks)
        self.goal_ticks = position_ticks

    def condition(self) -> Condition:
        """Read torque, hardware error and watchdog."""
        data = self._bus.read(HEALTH_BLOCK, HEALTH_BYTES).data
        watchdog = self._bus.read(mx28.BUS_WATCHDOG.address, mx28.BUS_WATCHDOG.size).data[0]
        return Condition(
            bool(mx28.TORQUE_ENABLE.value(data, HEALTH_BLOCK)),
            mx28.HARDWARE_ERROR_STATUS.value(data, HEALTH_BLOCK),
            watchdog == mx28.WATCHDOG_TRIPPED,
        )

    def supply(self) -> tuple[int, int]:
        """Read input voltage [mV] and temperature [deg C]."""
        data = self._bus.read(SUPPLY_BLOCK, SUPPLY_BYTES).data
        volts = mx28.PRESENT_INPUT_VOLTAGE.value(data, SUPPLY_BLOCK) * mx28.VOLTAGE_UNIT_V
        return round(1e3 * volts), mx28.PRESENT_TEMPERATURE.value(data, SUPPLY_BLOCK)

    def _check_identity(self) -> None:
        model = self._bus.ping()
        if model != mx28.MODEL:
            raise SetupError(
                f"the servo with id {self._settings.servo_id} has model number {model}, an MX-28 with the 2.0 firmware "
                f"has {mx28.MODEL} (29 is one with the 1.0 firmware: update it with DYNAMIXEL Wizard). Is `id` right?"
            )

    def _check_position(self, position_ticks: int) -> None:
        """With torque a servo counts within one turn: just below 0 it is at 360 deg, and would turn back all of it."""
        counted_ticks = position_ticks % mx28.STEPS_PER_TURN
        low, high = self._settings.limit_ticks
        if not low - ARRIVED_TICKS <= counted_ticks <= high + ARRIVED_TICKS:
            at_deg, low_deg, high_deg = (math.degrees(ticks * mx28.TICK_RAD) for ticks in (counted_ticks, low, high))
            raise SetupError(
                f"the servo is at {at_deg:.1f} deg, outside limits_deg {low_deg:.0f} to {high_deg:.0f}, and may turn "
                "the wrong way. Switch it off, turn the table into the limits by hand and check its cable; mount the "
                "horn so that the limits do not contain 0 deg (for example limits_deg: [90, 270])"
            )

    def _enable_replies(self) -> None:
        """Set Status Return Level 2. Below 1 the servo replies to pings only, so the write itself gets no reply."""
        register = mx28.STATUS_RETURN_LEVEL
        try:
            level = register.value(self._bus.read(register.address, register.size).data, register.address)
        except NoReply:
            level = 0
        if level != mx28.ALL_INSTRUCTIONS:
            self._bus.write_unanswered(register, mx28.ALL_INSTRUCTIONS)

    def _check_table(self, table: bytes) -> None:
        """Check the EEPROM; all wrong settings are reported together, or corrected with `write_settings`."""
        firmware = mx28.FIRMWARE_VERSION.value(table)
        if firmware < mx28.WATCHDOG_FIRMWARE:
            raise SetupError(
                f"the servo's firmware is version {firmware}; version {mx28.WATCHDOG_FIRMWARE} is needed for the bus "
                "watchdog. Update it with DYNAMIXEL Wizard"
            )
        wrong = list(wrong_settings(table, self._settings))
        if wrong and not self._settings.write_settings:
            velocity_limited = any(register is mx28.VELOCITY_LIMIT for register, _ in wrong)
            listed = ", ".join(f"{r.name} ({r.address}) is {r.value(table)}, not {wanted}" for r, wanted in wrong)
            raise SetupError(
                f"the servo is not configured for grd: {listed}. Set `write_settings: true` once to correct this, "
                "or use DYNAMIXEL Wizard"
                + ("; or lower `speed_limit_rpm` to the Velocity Limit" if velocity_limited else "")
            )
        if wrong:
            self._bus.write(mx28.TORQUE_ENABLE, 0)  # unlocks the EEPROM
            for register, wanted in wrong:
                self._bus.write(register, wanted)
            table = self._bus.read(0, mx28.EEPROM_END).data
            if list(wrong_settings(table, self._settings)):
                raise SetupError("the servo did not keep its new settings: is its EEPROM defective?")
        self._servo_limits = mx28.MIN_POSITION_LIMIT.value(table), mx28.MAX_POSITION_LIMIT.value(table)


class Shutdown(BusError):
    """The servo has a hardware error and has switched its torque off; only a reboot restores it."""

    kind = "shutdown"

    def __init__(self, error: int) -> None:
        super().__init__(f"the servo has shut down: {mx28.named_errors(error)}")
        self.error = error


def wrong_settings(table: bytes, settings: DriveSettings) -> Iterator[tuple[Register, int]]:
    """(register, required value) of each wrong setting in an EEPROM that was read from address 0 on."""
    wanted = {
        mx28.RETURN_DELAY_TIME: 0,
        mx28.DRIVE_MODE: mx28.NORMAL_VELOCITY_PROFILE,
        mx28.OPERATING_MODE: mx28.POSITION_CONTROL,
    }
    yield from ((register, value) for register, value in wanted.items() if register.value(table) != value)
    low_ticks, high_ticks = settings.limit_ticks
    if mx28.MIN_POSITION_LIMIT.value(table) > low_ticks:
        yield mx28.MIN_POSITION_LIMIT, low_ticks
    if mx28.MAX_POSITION_LIMIT.value(table) < high_ticks:
        yield mx28.MAX_POSITION_LIMIT, high_ticks
    if mx28.VELOCITY_LIMIT.value(table) < settings.max_velocity_units:
        yield mx28.VELOCITY_LIMIT, settings.max_velocity_units
