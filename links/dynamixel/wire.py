"""Packets between the servo process and its parent: fixed size, on a local socket.

Each packet is one datagram of a SOCK_SEQPACKET pair: it arrives complete or not at all. The end of either process
closes the socket.
Times are CLOCK_MONOTONIC, which all processes of a host share.

Source: unix(7), SOCK_SEQPACKET.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

MAX_BYTES = 1024


class Goal(NamedTuple):
    """To the process: a new goal."""

    position_ticks: int
    velocity_units: int  # profile velocity, never 0

    layout = struct.Struct("<BiI")


class Reading(NamedTuple):
    """From the process: one accepted reading of the servo."""

    request_ns: int
    reply_ns: int
    position_ticks: int
    velocity_units: int
    goal_ticks: int
    error: int  # Hardware Error Status

    layout = struct.Struct("<BqqiiiI")


class Health(NamedTuple):
    """From the process, periodically: totals since it started, and the present state."""

    connected: int  # 1: set up and replying
    reads: int
    goals_sent: int
    goals_expired: int  # not reached in time: the servo was stopped
    goals_lost: int  # arrived while no goal could be sent to the servo
    parent_silent: int  # stops in mid-travel because the parent sent no packet
    no_reply: int
    damaged: int
    wrong: int  # late or foreign replies, discarded
    rejected: int  # instructions that the servo rejected with an error
    unplugged: int  # how often the serial port disappeared
    set_ups: int  # at the start, and after each power cycle, reboot, torque loss, watchdog stop or replugged cable
    reboots: int
    torque_losses: int
    watchdog_stops: int
    late_cycles: int
    unsent: int  # readings that the parent did not receive in time
    slow: int  # readings rejected: the exchange took so long that the time of measurement is uncertain
    implausible: int  # readings rejected: the servo cannot have reached the position
    low_latency: int  # 1: the serial driver is in low latency mode
    voltage_mv: int
    temperature_c: int

    layout = struct.Struct("<B22I")


class Fatal(NamedTuple):
    """From the process, its last packet: an error that an operator has to correct."""

    text: bytes

    layout = struct.Struct("<B800s")


class Stop(NamedTuple):
    """To the process: stop the servo."""

    layout = struct.Struct("<B")


class Alive(NamedTuple):
    """To the process: the parent is receiving readings."""

    layout = struct.Struct("<B")


Packet = Goal | Reading | Health | Fatal | Stop | Alive
_KINDS: tuple[type[Packet], ...] = (Goal, Reading, Health, Fatal, Stop, Alive)


def pack(packet: Packet) -> bytes:
    """The bytes of a packet: its kind, then its fields."""
    return packet.layout.pack(_KINDS.index(type(packet)), *packet)


def unpack(data: bytes) -> Packet:
    """A packet from its bytes. Raises ValueError for other bytes."""
    kind = _KINDS[data[0]] if data and data[0] < len(_KINDS) else None
    if kind is None or len(data) != kind.layout.size:
        raise ValueError(f"not a packet of the servo process: {len(data)} bytes")
    return kind(*kind.layout.unpack(data)[1:])


def fatal(text: str) -> Fatal:
    """A Fatal packet with a text, truncated to its size."""
    return Fatal(text.encode()[:800])


def text_of(packet: Fatal) -> str:
    """The text of a Fatal packet."""
    return packet.text.rstrip(b"\0").decode(errors="replace")
