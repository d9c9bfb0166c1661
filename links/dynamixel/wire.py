"""What the servo's process and its parent say to each other: small packets of fixed size on a local socket.

Each packet is one datagram of a SOCK_SEQPACKET pair: whole or not at all, and the end of either process ends it.
Times are CLOCK_MONOTONIC, which all processes of a host share.

Source: ours; unix(7), SOCK_SEQPACKET.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

MAX_BYTES = 1024


class Goal(NamedTuple):
    """To the process: go there."""

    position_ticks: int
    velocity_units: int  # profile velocity, never 0

    layout = struct.Struct("<BiI")


class Reading(NamedTuple):
    """From the process: one block read."""

    request_ns: int
    reply_ns: int
    position_ticks: int
    velocity_units: int
    goal_ticks: int
    error: int  # Hardware Error Status

    layout = struct.Struct("<BqqiiiI")


class Health(NamedTuple):
    """From the process, some times a second: totals since it started, and how it is now."""

    connected: int  # 1: set up and answering
    reads: int
    goals_sent: int
    goals_expired: int  # not reached in time: the servo was told to stay where it was
    goals_lost: int  # came while the servo could not be told
    parent_hangs: int  # times the servo was told to stay where it was in mid-travel: the parent said nothing any more
    no_reply: int
    damaged: int
    wrong: int  # late or foreign replies, thrown away
    refused: int  # instructions that the servo refused
    unplugged: int  # times the serial port went away
    set_ups: int  # start, and after each power cycle, reboot, torque off, watchdog stop or return of the cable
    reboots: int
    torque_losses: int
    watchdog_stops: int
    late_cycles: int
    unsent: int  # readings that the parent did not take in time
    slow: int  # readings left out: the exchange took too long to tell when the servo measured
    implausible: int  # readings left out: the servo cannot have come there
    low_latency: int  # 1: the serial driver sends bytes on at once
    voltage_mv: int
    temperature_c: int

    layout = struct.Struct("<B22I")


class Fatal(NamedTuple):
    """From the process, its last words: what a person has to mend."""

    text: bytes

    layout = struct.Struct("<B800s")


class Stop(NamedTuple):
    """To the process: stay where you are."""

    layout = struct.Struct("<B")


class Alive(NamedTuple):
    """To the process: who takes the readings is at work."""

    layout = struct.Struct("<B")


Packet = Goal | Reading | Health | Fatal | Stop | Alive
_KINDS: tuple[type[Packet], ...] = (Goal, Reading, Health, Fatal, Stop, Alive)


def pack(packet: Packet) -> bytes:
    """The bytes of a packet: its kind, then its fields."""
    return packet.layout.pack(_KINDS.index(type(packet)), *packet)


def unpack(data: bytes) -> Packet:
    """A packet from its bytes. ValueError when they are none."""
    kind = _KINDS[data[0]] if data and data[0] < len(_KINDS) else None
    if kind is None or len(data) != kind.layout.size:
        raise ValueError(f"no packet of the servo's process: {len(data)} bytes")
    return kind(*kind.layout.unpack(data)[1:])


def fatal(text: str) -> Fatal:
    """Last words, cut to what fits."""
    return Fatal(text.encode()[:800])


def text_of(packet: Fatal) -> str:
    """The words."""
    return packet.text.rstrip(b"\0").decode(errors="replace")
