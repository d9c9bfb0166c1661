"""Datagrams from one sender, each with a JSON object or text; a JSON object may have `age_s`.

`age_s`: age of the measurement at the time of sending [s]; `latency_s` of the settings when it is missing. It may be
negative by MAX_AHEAD_S, the difference of two clocks, and counts as 0 then. A datagram that is older than one second is
skipped and counted.

Source: ours.
"""

from __future__ import annotations

import json
import socket
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ipaddress import IPv4Address
from typing import Any, ClassVar

from pydantic import Field, model_validator

from flow.link import LinkError, PolledRecords, Record, SourceSettings
from links.clock import datagram_time

DATAGRAM_BYTES = 4096
MAX_AGE_S, MAX_AHEAD_S = 1.0, 0.02
WRONG_AGE = "age_s invalid or too large"  # counter


class UdpSettings(SourceSettings):
    """Settings of a source that receives datagrams."""

    what: ClassVar[str] = "data"  # is received, for errors

    port: int | None = Field(None, ge=1, le=65535)  # UDP, live; None: not received live
    bind: IPv4Address = IPv4Address("127.0.0.1")  # this host's address
    sender: IPv4Address | None = None  # the sender's address; others are ignored
    latency_s: float = Field(0.0, ge=0, le=MAX_AGE_S)  # age when it is sent, of a datagram without `age_s`

    @model_validator(mode="after")
    def _sender_is_known(self) -> UdpSettings:
        if self.sender is None and not self.bind.is_loopback:
            raise ValueError(
                f"sender: set the sender of {self.what} when binding to {self.bind}, so that others are ignored"
            )
        return self


@contextmanager
def listen_udp(
    settings: UdpSettings, counters: Counter[str], topic_of: Callable[[bytes], str] | None = None
) -> Iterator[PolledRecords]:
    """Open the socket and yield the records, which end with the context.

    `topic_of`: the topic of a datagram, if it is not always the settings' one. LinkError without `port`, or when the
    socket cannot be opened.
    """
    what, port, bind = settings.what, settings.port, str(settings.bind)
    if port is None:
        raise LinkError(f"{settings.topic}: set `port` to receive {what}, or remove the link")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        try:
            datagram_time.enable_stamps(udp)
            udp.bind((bind, port))
        except OSError as error:
            raise LinkError(
                f"cannot listen on UDP {bind}:{port} for {what}: {error.strerror}. Check `bind` and `port`; "
                "is another grd listening there?"
            ) from error
        udp.setblocking(False)
        records = Datagrams(udp, settings, counters, topic_of)
        try:
            yield records
        finally:
            records.closed.set()


class Datagrams(PolledRecords):
    """Records of the datagrams of a socket."""

    def __init__(
        self,
        udp: socket.socket,
        settings: UdpSettings,
        counters: Counter[str],
        topic_of: Callable[[bytes], str] | None,
    ) -> None:
        super().__init__()
        self._udp, self._settings, self._counters = udp, settings, counters
        self._sender = None if settings.sender is None else str(settings.sender)
        self._topic_of = topic_of or (lambda _: settings.topic)

    @property
    def files(self) -> tuple[socket.socket]:
        """See PolledRecords."""
        return (self._udp,)

    def pending(self) -> Iterator[Record]:
        """See PolledRecords."""
        try:
            for data, arrival_ns, host in datagram_time.pending(self._udp, DATAGRAM_BYTES):
                if self._sender is not None and host != self._sender:
                    self._counters["from other senders"] += 1
                    continue
                age = age_s(data, self._settings.latency_s)
                if age is None:
                    self._counters[WRONG_AGE] += 1
                    continue
                yield Record(self._topic_of(data), arrival_ns, arrival_ns - round(1e9 * age), data)
        except OSError as error:
            raise LinkError(f"{self._settings.what}: {error.strerror}: is the network interface still up?") from error


def age_s(data: bytes, latency_s: float = 0.0) -> float | None:
    """`age_s` of a datagram, `latency_s` without it; None: invalid, above MAX_AGE_S, or below -MAX_AHEAD_S."""
    try:
        fields: Any = json.loads(data)
        age = float(fields.get("age_s", latency_s))
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError):
        return latency_s if b"age_s" not in data else None  # `decode` rejects invalid JSON
    return max(age, 0.0) if -MAX_AHEAD_S <= age <= MAX_AGE_S else None
