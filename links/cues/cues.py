"""Cues by UDP as a source: one JSON object, or NMEA sentences, per datagram (`parsing.py`).

Cues are optional, as is each of them. A recording without them is no error.

Source: recording format in recordings/README.md (/cues).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Any, ClassVar

from flow.counters import Counters
from flow.link import PolledRecords, Record, Source
from links.cues.parsing import CueParser
from links.udp import UdpSettings, listen_udp
from stages.messages import DroneGnss, UwbRange, VehicleGnss

NMEA_SUFFIX = "/nmea"  # topic of NMEA datagrams: a recording declares one encoding per topic
MAX_REASONS = 20  # of rejections, counted each


class CuesSettings(UdpSettings):
    """Settings of `Cues`."""

    what: ClassVar[str] = "cues"

    topic: str = "/cues"


class Cues(Source[CuesSettings]):
    """GNSS of the vehicle and of the drone, ranges. What is invalid is counted with its reason and skipped."""

    polled: ClassVar[bool] = True

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

    def listen(self) -> AbstractContextManager[PolledRecords]:
        """Receive cues: `with cues.listen() as records`. LinkError without `port`, or when it cannot be opened."""
        return listen_udp(self.settings, self._udp, self._topic_of)

    def _topic_of(self, data: bytes) -> str:
        is_nmea = data.lstrip().startswith(b"$")
        return self.settings.topic + NMEA_SUFFIX if is_nmea else self.settings.topic

    def decode(self, record: Record) -> Iterator[VehicleGnss | DroneGnss | UwbRange]:
        """The valid cues of one datagram."""
        found, rejected = self._parser.parse(record.stamp_ns, record.data)
        for reason in rejected:  # it may quote what was sent: the number of different ones is limited
            known = reason in self._rejected or len(self._rejected) < MAX_REASONS
            self._rejected[reason if known else "other reasons"] += 1
        self._decoded += len(found)
        yield from found
