"""Cues by UDP as a source: one JSON object, or NMEA sentences, per datagram (`parsing.py`).

Cues are optional, as is each of them. A recording without them is no error.

Source: recording format in recordings/README.md (/cues).
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from ipaddress import IPv4Address
from typing import Any

from pydantic import Field, model_validator

from flow.counters import Counters
from flow.link import LinkError, Record, Source, SourceSettings
from links.cues.parsing import CueParser
from links.vehicle_odometry.udp import listen_udp
from stages.messages import DroneGnss, UwbRange, VehicleGnss

NMEA_SUFFIX = "/nmea"  # topic of NMEA datagrams: a recording declares one encoding per topic
MAX_REASONS = 20  # of rejections, counted each


class CuesSettings(SourceSettings):
    """Settings of `Cues`."""

    topic: str = "/cues"
    port: int | None = Field(None, ge=1, le=65535)  # UDP, live; None: no live cues
    bind: IPv4Address = IPv4Address("127.0.0.1")  # this host's address
    sender: IPv4Address | None = None  # the sender's address; others are ignored

    @model_validator(mode="after")
    def _sender_is_known(self) -> CuesSettings:
        if self.sender is None and not self.bind.is_loopback:
            raise ValueError(f"sender: set the cues' sender when binding to {self.bind}, so that others are ignored")
        return self


class Cues(Source[CuesSettings]):
    """GNSS of the vehicle and of the drone, ranges. What is invalid is counted with its reason and skipped."""

    def __init__(self, settings: CuesSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._parser = CueParser()
        self._udp: Counter[str] = Counter()
        self._rejected: Counter[str] = Counter()
        self._decoded: int = 0

    @property
    def counters(self) -> Counters:
        """Totals since the start: cues, from other senders; rejected by reason."""
        return Counters({"cues": self._decoded} | dict(self._udp), self._rejected)

    @property
    def replay_topics(self) -> tuple[str, ...]:
        """See Source."""
        return self.settings.topic, self.settings.topic + NMEA_SUFFIX

    @contextmanager
    def listen(self) -> Iterator[Iterator[Record]]:
        """Receive cues: `with cues.listen() as records`. LinkError without `port`, or when it cannot be opened."""
        settings = self.settings
        if settings.port is None:
            raise LinkError(f"{settings.topic}: set `port` to receive cues, or remove the link")
        sender = None if settings.sender is None else str(settings.sender)
        with listen_udp(settings.topic, str(settings.bind), settings.port, sender, self._udp, "cues") as records:
            yield (_on_its_topic(record) for record in records)

    def decode(self, record: Record) -> Iterator[VehicleGnss | DroneGnss | UwbRange]:
        """The valid cues of one datagram."""
        found, rejected = self._parser.parse(record.stamp_ns, record.data)
        for reason in rejected:  # it may quote what was sent: the number of different ones is limited
            known = reason in self._rejected or len(self._rejected) < MAX_REASONS
            self._rejected[reason if known else "other reasons"] += 1
        self._decoded += len(found)
        yield from found


def _on_its_topic(record: Record) -> Record:
    is_nmea = record.data.lstrip().startswith(b"$")
    return dataclasses.replace(record, topic=record.topic + NMEA_SUFFIX) if is_nmea else record
