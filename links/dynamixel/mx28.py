"""Datasheet of the DYNAMIXEL MX-28AR: control table, units, errors.

Source: ROBOTIS e-manual, MX-28AR/AT(2.0), https://emanual.robotis.com/docs/en/dxl/mx/mx-28-2/ (control table, limits,
shutdown, bus watchdog); DYNAMIXEL Protocol 2.0, https://emanual.robotis.com/docs/en/dxl/protocol2/ (status packet).
"""

from __future__ import annotations

import math
from typing import NamedTuple


class Register(NamedTuple):
    """One entry of the control table."""

    address: int
    size: int  # bytes, little endian
    name: str
    initial: int = 0  # from the factory (EEPROM), after power-on (RAM)
    signed: bool = False

    def value(self, data: bytes, start: int = 0) -> int:
        """Its value in a block read from address `start` on."""
        at = self.address - start
        return int.from_bytes(data[at : at + self.size], "little", signed=self.signed)

    def bytes(self, value: int) -> bytes:
        """A value as written to the servo."""
        return value.to_bytes(self.size, "little", signed=self.signed)


# EEPROM: non-volatile, writable only while torque is off
MODEL_NUMBER = Register(0, 2, "Model Number", 30)
FIRMWARE_VERSION = Register(6, 1, "Firmware Version")
ID = Register(7, 1, "ID", 1)
BAUD_RATE = Register(8, 1, "Baud Rate", 1)
RETURN_DELAY_TIME = Register(9, 1, "Return Delay Time", 250)
DRIVE_MODE = Register(10, 1, "Drive Mode", 0)
OPERATING_MODE = Register(11, 1, "Operating Mode", 3)
PROTOCOL_VERSION = Register(13, 1, "Protocol Version", 2)
VELOCITY_LIMIT = Register(44, 4, "Velocity Limit", 230)
MAX_POSITION_LIMIT = Register(48, 4, "Max Position Limit", 4095)
MIN_POSITION_LIMIT = Register(52, 4, "Min Position Limit", 0)
SHUTDOWN = Register(63, 1, "Shutdown", 52)
EEPROM_END = 64

# RAM: reset to its initial value at power-on
TORQUE_ENABLE = Register(64, 1, "Torque Enable", 0)
STATUS_RETURN_LEVEL = Register(68, 1, "Status Return Level", 2)
HARDWARE_ERROR_STATUS = Register(70, 1, "Hardware Error Status", 0)
BUS_WATCHDOG = Register(98, 1, "Bus Watchdog", 0)
PROFILE_ACCELERATION = Register(108, 4, "Profile Acceleration", 0)
PROFILE_VELOCITY = Register(112, 4, "Profile Velocity", 0)
GOAL_POSITION = Register(116, 4, "Goal Position", 0, signed=True)
REALTIME_TICK = Register(120, 2, "Realtime Tick", 0)
MOVING = Register(122, 1, "Moving", 0)
PRESENT_LOAD = Register(126, 2, "Present Load", 0, signed=True)
PRESENT_VELOCITY = Register(128, 4, "Present Velocity", 0, signed=True)
PRESENT_POSITION = Register(132, 4, "Present Position", 0, signed=True)
PRESENT_INPUT_VOLTAGE = Register(144, 2, "Present Input Voltage", 120)
PRESENT_TEMPERATURE = Register(146, 1, "Present Temperature", 35)
TABLE_END = 662

REGISTERS = tuple(r for r in globals().values() if isinstance(r, Register))

# values and units
MODEL = 30  # MX-28 with the 2.0 firmware; 29 with the 1.0 firmware
WATCHDOG_FIRMWARE = 38  # first version with the bus watchdog
BAUD_CODES = {9_600: 0, 57_600: 1, 115_200: 2, 1_000_000: 3, 2_000_000: 4, 3_000_000: 5, 4_000_000: 6, 4_500_000: 7}
POSITION_CONTROL = 3  # Operating Mode: one turn, 0..4095
NORMAL_VELOCITY_PROFILE = 0  # Drive Mode: not reversed, profile by velocity (not by time)
ALL_INSTRUCTIONS = 2  # Status Return Level: a reply to every instruction
WATCHDOG_UNIT_MS = 20
WATCHDOG_MOST = 127
WATCHDOG_TRIPPED = 255  # -1: it has stopped the servo; the goal is read-only until 0 is written
STEPS_PER_TURN = 4096
TICK_RAD = math.tau / STEPS_PER_TURN
VELOCITY_UNIT_RPM = 0.229
VELOCITY_UNIT_RADPS = VELOCITY_UNIT_RPM * math.tau / 60
NO_LOAD_RPM = 55.0  # at 12 V
VOLTAGE_UNIT_V = 0.1

# Hardware Error Status (70), and the bits that Shutdown (63) reacts to: torque off until a reboot
HARDWARE_ERRORS = {
    0x01: "input voltage",
    0x04: "overheating",
    0x08: "motor encoder",
    0x10: "electrical shock",
    0x20: "overload",
}
OVERLOAD = 0x20

# Protocol 2.0, error field of a status packet: bit 7: Hardware Error Status is not 0, the rest is a number
ALERT = 0x80
RESULT_FAIL, INSTRUCTION_ERROR, CRC_ERROR, DATA_RANGE, DATA_LENGTH, DATA_LIMIT, ACCESS_ERROR = range(1, 8)
ERRORS = {
    RESULT_FAIL: "the instruction failed",
    INSTRUCTION_ERROR: "unknown instruction",
    CRC_ERROR: "the servo received a damaged packet",
    DATA_RANGE: "the value is out of range, or the bus watchdog has stopped the servo",
    DATA_LENGTH: "too few bytes",
    DATA_LIMIT: "the value is beyond the servo's limit",
    ACCESS_ERROR: "the register is not writable now (torque on?)",
}


def named_errors(bits: int) -> str:
    """Names of hardware error bits, or "none"."""
    return ", ".join(name for bit, name in HARDWARE_ERRORS.items() if bits & bit) or "none"
