"""Reads parameters of an autopilot over its own connection, for preflight. Nothing is ever set.

Source: https://mavlink.io/en/services/parameter.html (PARAM_REQUEST_READ, bytewise and C-cast integers).
"""

from __future__ import annotations

import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from flow.link import LinkError
from links.clock import host_time
from links.mavlink.autopilot import Autopilot
from links.mavlink.framing import V1, FrameSplitter, dialect, header, packed
from links.mavlink.profiles import PROFILES
from links.mavlink.signing import Signer
from links.mavlink.transport.connection import Connection, parse_connection
from links.mavlink.transport.stream_connection import open_connection

AGAIN_S = 0.3  # until a parameter that has not answered is asked again
AT_ONCE = 8  # parameters asked at a time: a slow line holds no more
V1_HEADER_BYTES, V2_HEADER_BYTES = 6, 10
FORMATS = {1: "B", 2: "b", 3: "H", 4: "h", 5: "I", 6: "i", 9: "f"}  # MAV_PARAM_TYPE


@dataclass(slots=True)
class Answers:
    """What an autopilot told."""

    values: dict[str, float] = field(default_factory=dict[str, float])
    missing: list[str] = field(default_factory=list[str])
    heard: int = 0  # frames from it at all: 0, and it is not there


def ask_parameters(link: Autopilot, timeout_s: float = 5.0) -> Answers:
    """Ask for what the profile wants, over a connection of its own: `link` must not be listening. LinkError."""
    if link.settings.connection is None:
        raise LinkError("no connection to the autopilot: set `connection`, as in udpin:127.0.0.1:14550")
    profile = PROFILES[link.settings.profile]
    signer = None if link.settings.signing_key is None else Signer(link.settings.signing_key, host_time.now_ns())
    if signer is not None and signer.status is not None:
        raise LinkError(signer.status)
    connection = open_connection(parse_connection(link.settings.connection), link.settings.sender)
    try:
        return read_parameters(
            connection,
            [wanted.name for wanted in profile.wanted],
            (link.settings.system_id, link.settings.component_id),
            link.settings.own_id,
            integers_bytewise=profile.integers_bytewise,
            timeout_s=timeout_s,
            signer=signer,
        )
    finally:
        connection.close()
        if signer is not None:
            signer.close()


def read_parameters(
    connection: Connection,
    names: Sequence[str],
    target: tuple[int, int],
    own: tuple[int, int],
    *,
    integers_bytewise: bool = False,
    timeout_s: float = 5.0,
    signer: Signer | None = None,
) -> Answers:
    """Ask for each name until it answers or timeout_s is over; what did not answer is `missing`.

    integers_bytewise: as PX4 sends them (`profiles.Profile.integers_bytewise`).
    """
    answers, splitter = Answers(), FrameSplitter()
    mav = dialect().MAVLink(None, srcSystem=own[0], srcComponent=own[1])
    end_s, again_s = time.monotonic() + timeout_s, 0.0
    while (waiting := [name for name in names if name not in answers.values]) and time.monotonic() < end_s:
        if time.monotonic() >= again_s:
            again_s = time.monotonic() + AGAIN_S
            beat = dialect().MAVLink_heartbeat_message(18, 8, 0, 0, 3, 3)
            asks = [
                dialect().MAVLink_param_request_read_message(*target, name.encode("ascii"), -1)
                for name in waiting[:AT_ONCE]
            ]
            for message in [beat, *asks]:
                if signer is not None:
                    signer.sign_for(mav, host_time.now_ns())
                connection.send(packed(message, mav))
        received = connection.receive(0.05)
        if received is None:
            continue
        data, source = received
        for frame, message in splitter.datagram(data) if connection.datagrams else splitter.stream(data):
            if header(frame)[0] != target or (signer is not None and not signer.verify(frame)):
                continue
            answers.heard += 1
            connection.answer_to(source)
            if message.get_type() == "PARAM_VALUE" and message.param_id in waiting:
                answers.values[message.param_id] = _value(frame, message, integers_bytewise)
                again_s = again_s if set(waiting[:AT_ONCE]) - set(answers.values) else 0.0
    answers.missing = [name for name in names if name not in answers.values]
    return answers


def _value(frame: bytes, message: Any, bytewise: bool) -> float:
    if not bytewise or message.param_type not in FORMATS:
        return float(message.param_value)
    begin = V1_HEADER_BYTES if frame[0] == V1 else V2_HEADER_BYTES  # param_value is the payload's first field
    return float(struct.unpack_from(f"<{FORMATS[message.param_type]}", frame, begin)[0])
