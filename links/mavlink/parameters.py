"""Read parameters and firmware version of an autopilot over a separate connection, for preflight. Nothing is written.

Source: https://mavlink.io/en/services/parameter.html (PARAM_REQUEST_READ, bytewise and C-cast integers),
https://mavlink.io/en/messages/common.html#AUTOPILOT_VERSION.
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
from links.mavlink.commands import command_long
from links.mavlink.profiles import PROFILES
from links.mavlink.transport.connection import Connection, parse_connection
from links.mavlink.transport.framing import V1, FrameSplitter, dialect, header, packed
from links.mavlink.transport.signing import Signer
from links.mavlink.transport.stream_connection import open_connection

RETRY_S = 0.3  # period of requests for missing parameters
VERSION_WAIT_S = 1.5  # after the parameters; without an answer the version stays unknown
REQUEST_MESSAGE, AUTOPILOT_VERSION = 512, 148
BATCH = 8  # parameters per request burst, limited for slow lines
V1_HEADER_BYTES, V2_HEADER_BYTES = 6, 10
FORMATS = {1: "B", 2: "b", 3: "H", 4: "h", 5: "I", 6: "i", 9: "f"}  # MAV_PARAM_TYPE


@dataclass(slots=True)
class ParameterValues:
    """Parameters received from an autopilot."""

    values: dict[str, float] = field(default_factory=dict[str, float])
    missing: list[str] = field(default_factory=list[str])
    frames: int = 0  # frames of any kind from it; 0: it is not connected
    version: tuple[int, int, int] | None = None  # of its firmware; None: it did not answer


def ask_parameters(link: Autopilot, timeout_s: float = 5.0) -> ParameterValues:
    """Read the parameters of the link's profile over a new connection; `link` must not be listening. LinkError."""
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
            list(dict.fromkeys(required.name for required in link.settings.required_parameters)),
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
) -> ParameterValues:
    """Request each parameter until it arrives or timeout_s has passed, the others are `missing`; and the version.

    integers_bytewise: as PX4 sends them (`profiles.Profile.integers_bytewise`).
    """
    received, splitter = ParameterValues(), FrameSplitter()
    mav = dialect().MAVLink(None, srcSystem=own[0], srcComponent=own[1])
    end_s, retry_s, version_retry_s = time.monotonic() + timeout_s, 0.0, 0.0
    complete_s: float | None = None  # when all parameters had arrived
    while time.monotonic() < end_s:
        missing = [name for name in names if name not in received.values]
        if not missing:
            if received.version is not None:
                break
            end_s = min(end_s, (complete_s := complete_s or time.monotonic()) + VERSION_WAIT_S)
        if time.monotonic() >= retry_s:
            retry_s = time.monotonic() + RETRY_S
            heartbeat = dialect().MAVLink_heartbeat_message(18, 8, 0, 0, 3, 3)
            requests: list[Any] = [
                dialect().MAVLink_param_request_read_message(*target, name.encode("ascii"), -1)
                for name in missing[:BATCH]
            ]
            if received.version is None and time.monotonic() >= version_retry_s:
                version_retry_s = time.monotonic() + RETRY_S
                requests.append(command_long(target, REQUEST_MESSAGE, AUTOPILOT_VERSION))
            for message in [heartbeat, *requests]:
                if signer is not None:
                    signer.sign_for(mav, host_time.now_ns())
                connection.send(packed(message, mav))
        packet = connection.receive(0.05)
        if packet is None:
            continue
        data, source = packet
        for frame, message in splitter.datagram(data) if connection.datagrams else splitter.stream(data):
            if header(frame)[0] != target or (signer is not None and not signer.verify(frame)):
                continue
            received.frames += 1
            connection.reply_to(source)
            if message.get_type() == "PARAM_VALUE" and message.param_id in missing:
                received.values[message.param_id] = _value(frame, message, integers_bytewise)
                retry_s = retry_s if set(missing[:BATCH]) - set(received.values) else 0.0
            elif message.get_type() == "AUTOPILOT_VERSION":
                number = int(message.flight_sw_version)  # major, minor, patch, type: a byte each; 0: not known
                received.version = (number >> 24, number >> 16 & 255, number >> 8 & 255) if number else None
    received.missing = [name for name in names if name not in received.values]
    return received


def _value(frame: bytes, message: Any, bytewise: bool) -> float:
    if not bytewise or message.param_type not in FORMATS:
        return float(message.param_value)
    begin = V1_HEADER_BYTES if frame[0] == V1 else V2_HEADER_BYTES  # param_value is the payload's first field
    return float(struct.unpack_from(f"<{FORMATS[message.param_type]}", frame, begin)[0])
