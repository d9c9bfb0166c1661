"""The servo as it should be: checked and set up, read, moved, stopped, and brought back after a fault.

Whatever goes wrong, one path leads back: `set_up`. It makes the servo's goal the place where it stands before torque
comes on, so nothing moves until a goal is sent; and it arms the servo's own bus watchdog, which stops it when nobody
talks to it any more, whatever became of this process.

Source: ours; registers by the e-manual, see links/dynamixel/mx28.py.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass

from links.dynamixel import mx28
from links.dynamixel.bus import Bus, BusError, NoReply, Reply
from links.dynamixel.mx28 import Register

POSITION_BLOCK = mx28.PRESENT_LOAD.address  # load, velocity, position: 126..135
POSITION_BYTES = 10
LENGTHS = 4  # of the position block, in turn: a late reply has the wrong one
HEALTH_BLOCK, HEALTH_BYTES = mx28.TORQUE_ENABLE.address, 7  # torque .. hardware error: 64..70
SUPPLY_BLOCK, SUPPLY_BYTES = mx28.PRESENT_INPUT_VOLTAGE.address, 3
ARRIVED_TICKS = 23  # 2 deg: nearer a stopped servo need not be told


class SetupError(Exception):
    """The servo is not one that may be driven; a person has to change something. The text says what."""


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """How the servo is set up."""

    port: str
    servo_id: int
    baud: int
    limit_ticks: tuple[int, int]  # the soft limits, which the servo's own limits must not be narrower than
    fastest_units: int  # profile velocity of the fastest goal, which the servo's own limit must not be below
    watchdog_ms: int
    reply_timeout_ms: float
    goal_slack_ms: float  # a goal that is not reached so long after it could have been is given up
    rate_hz: float
    start_s: float  # it has to answer once within this
    write_settings: bool  # correct the servo's EEPROM rather than refuse
    reboot: bool  # after a shutdown

    def text(self) -> str:
        """As a command line takes it."""
        return json.dumps(asdict(self))

    @classmethod
    def from_text(cls, text: str) -> DriveSettings:
        """The settings that `text` wrote."""
        fields = json.loads(text)
        return cls(**{**fields, "limit_ticks": tuple(fields["limit_ticks"])})


@dataclass(frozen=True, slots=True)
class Measured:
    """One block read."""

    request_ns: int
    reply_ns: int
    position_ticks: int
    velocity_units: int
    alert: bool


@dataclass(frozen=True, slots=True)
class Condition:
    """What is not read each time."""

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
        """Check the servo, set it up, hold it where it is, torque on. SetupError; BusError when it did not answer.

        Returns hardware errors that it does not shut down for, as of its supply's voltage.
        """
        self._check_identity()
        self._answer_everything()
        table = self._bus.read(0, mx28.EEPROM_END).data
        self._check_table(table)
        health = self._bus.read(HEALTH_BLOCK, HEALTH_BYTES)
        error = mx28.HARDWARE_ERROR_STATUS.value(health.data, HEALTH_BLOCK)
        if error & mx28.SHUTDOWN.value(table):
            raise Shutdown(error)
        write = self._bus.write
        write(mx28.BUS_WATCHDOG, 0)
        position_ticks = self.measure().position_ticks
        low, high = self._servo_limits
        self.goal_ticks = min(max(position_ticks, low), high)
        write(mx28.PROFILE_ACCELERATION, 0, 1, self.goal_ticks)  # acceleration, velocity, goal: three neighbours
        write(mx28.TORQUE_ENABLE, 1)
        write(mx28.BUS_WATCHDOG, min(math.ceil(self._settings.watchdog_ms / mx28.WATCHDOG_UNIT_MS), mx28.WATCHDOG_MOST))
        return error

    def measure(self) -> Measured:
        """Where the servo is. Each call asks for another length: a late reply cannot be taken for this one's."""
        self._reads += 1
        reply: Reply = self._bus.read(POSITION_BLOCK, POSITION_BYTES + self._reads % LENGTHS)
        return Measured(
            reply.request_ns,
            reply.reply_ns,
            mx28.PRESENT_POSITION.value(reply.data, POSITION_BLOCK),
            mx28.PRESENT_VELOCITY.value(reply.data, POSITION_BLOCK),
            reply.alert,
        )

    def go(self, position_ticks: int, velocity_units: int) -> None:
        """A new goal and speed, in one write."""
        self._bus.write(mx28.PROFILE_VELOCITY, velocity_units, position_ticks)
        self.goal_ticks = position_ticks

    def stop(self) -> None:
        """Stay where it is: the goal becomes the present position; torque stays on and holds."""
        low, high = self._servo_limits
        position_ticks = min(max(self.measure().position_ticks, low), high)
        self._bus.write(mx28.GOAL_POSITION, position_ticks)
        self.goal_ticks = position_ticks

    def condition(self) -> Condition:
        """Torque, hardware error and watchdog."""
        data = self._bus.read(HEALTH_BLOCK, HEALTH_BYTES).data
        watchdog = self._bus.read(mx28.BUS_WATCHDOG.address, mx28.BUS_WATCHDOG.size).data[0]
        return Condition(
            bool(mx28.TORQUE_ENABLE.value(data, HEALTH_BLOCK)),
            mx28.HARDWARE_ERROR_STATUS.value(data, HEALTH_BLOCK),
            watchdog == mx28.WATCHDOG_TRIPPED,
        )

    def supply(self) -> tuple[int, int]:
        """Input voltage [mV] and temperature [deg C]."""
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

    def _answer_everything(self) -> None:
        """Status Return Level 2. Below 1 the servo answers pings alone, so the change itself goes unanswered."""
        register = mx28.STATUS_RETURN_LEVEL
        try:
            level = register.value(self._bus.read(register.address, register.size).data, register.address)
        except NoReply:
            level = 0
        if level != mx28.ALL_INSTRUCTIONS:
            self._bus.write_unanswered(register, mx28.ALL_INSTRUCTIONS)

    def _check_table(self, table: bytes) -> None:
        """The EEPROM, all faults at once; with `write_settings` those are corrected that may be."""
        firmware = mx28.FIRMWARE_VERSION.value(table)
        if firmware < mx28.WATCHDOG_FIRMWARE:
            raise SetupError(
                f"the servo's firmware is version {firmware}; from {mx28.WATCHDOG_FIRMWARE} on it stops by itself when "
                "its host falls silent. Update it with DYNAMIXEL Wizard"
            )
        wrong = list(wrong_settings(table, self._settings))
        if wrong and not self._settings.write_settings:
            slow = any(register is mx28.VELOCITY_LIMIT for register, _ in wrong)
            listed = ", ".join(f"{r.name} ({r.address}) is {r.value(table)}, not {wanted}" for r, wanted in wrong)
            raise SetupError(
                f"the servo is not set up for grd: {listed}. Set `write_settings: true` once to have grd change this, "
                "or use DYNAMIXEL Wizard"
                + ("; a lower `speed_limit_rpm` needs no other Velocity Limit" if slow else "")
            )
        if wrong:
            self._bus.write(mx28.TORQUE_ENABLE, 0)  # the EEPROM is locked otherwise
            for register, wanted in wrong:
                self._bus.write(register, wanted)
            table = self._bus.read(0, mx28.EEPROM_END).data
            if list(wrong_settings(table, self._settings)):
                raise SetupError("the servo did not keep its new settings: is its EEPROM worn out?")
        self._servo_limits = mx28.MIN_POSITION_LIMIT.value(table), mx28.MAX_POSITION_LIMIT.value(table)


class Shutdown(BusError):
    """The servo has a hardware error and has let go; only a reboot brings it back."""

    kind = "shutdown"

    def __init__(self, error: int) -> None:
        super().__init__(f"the servo has shut down: {mx28.named_errors(error)}")
        self.error = error


def wrong_settings(table: bytes, settings: DriveSettings) -> Iterator[tuple[Register, int]]:
    """(register, wanted value) of what is not as it must be in an EEPROM read from address 0 on."""
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
    if mx28.VELOCITY_LIMIT.value(table) < settings.fastest_units:
        yield mx28.VELOCITY_LIMIT, settings.fastest_units
