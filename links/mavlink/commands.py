"""MAVLink's command protocol: COMMAND_LONG, and whether a COMMAND_ACK answers a command of ours.

Source: https://mavlink.io/en/services/command.html.
"""

from __future__ import annotations

from typing import Any

from links.mavlink.transport.framing import dialect

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS = range(6)  # MAV_RESULT
ACK_TIMEOUT_NS = 1_000_000_000  # a command without acknowledgement is repeated after this time


def command_long(target: tuple[int, int], command: int, *parameters: float) -> Any:
    """COMMAND_LONG with up to 7 parameters; the others are 0."""
    values = [*parameters, *[0.0] * (7 - len(parameters))]
    return dialect().MAVLink_command_long_message(*target, command, 0, *values)


def is_answer(message: Any, command: int, own: tuple[int, int]) -> bool:
    """Whether a message is the COMMAND_ACK of this command to us; older autopilots do not name the requester."""
    if message.get_type() != "COMMAND_ACK" or message.command != command:
        return False
    named = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
    return all(name in (0, ours) for name, ours in zip(named, own, strict=True))
