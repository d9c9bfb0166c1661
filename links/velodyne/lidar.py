"""The VLP-16 as a source: UDP packets live, recorded packets in replay, one decoder for both.

Live it can listen to the sensor's position packets, too: they are recorded under /lidar/position, and what they say of
GPS and PPS is counted. With `clock: utc` nothing is taken before they say that the sensor's clock is locked to UTC; a
lock that is lost later is counted and said, and the sensor's clock drifts on by some millionths.

Source: VLP-16 User Manual 63-9243 Rev. E, chapter 9. What to do about bad, lost and repeated packets is ours.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from ipaddress import IPv4Address
from typing import Any

from pydantic import Field, model_validator

from flow.link import LinkError, Record, Source, SourceSettings
from links.velodyne import vlp16
from links.velodyne.clock import ClockMode, DeviceClock
from links.velodyne.decode import FiringRows, compile_kernels, refusal_of, timestamp_us
from links.velodyne.position import PpsWatch
from links.velodyne.refusal import Refusal
from links.velodyne.udp import Channel, UdpCounters, listen_udp
from stages.messages import LidarFirings

POSITION_TOPIC = "/lidar/position"
REFUSED_IN_A_ROW = 100
POSITION_SILENT_S = 3.0  # a sensor sends some of them each second


class LidarSettings(SourceSettings):
    """Settings of `Lidar`."""

    topic: str = "/lidar/packets"
    clock: ClockMode = "free"  # utc: sensor and host are both locked to UTC
    clock_limit_s: float = Field(0.5, gt=0, le=1800)
    bind: IPv4Address = IPv4Address("127.0.0.1")  # this host's address; 0.0.0.0 when the lidar broadcasts
    port: int = Field(vlp16.DATA_PORT, ge=1, le=65535)
    sender: IPv4Address | None = None  # the lidar's address, 192.168.1.201 from the factory
    position_port: int | None = Field(None, ge=1, le=65535)  # 8308 from the factory; None: do not listen to it
    timeout_s: float = Field(2.0, gt=0, le=60)
    packets: int = Field(1, ge=1, le=16)  # in a message, 1.3 ms each: fewer messages cost less, and come later

    @model_validator(mode="after")
    def _sender_is_known(self) -> LidarSettings:
        if self.sender is None and not self.bind.is_loopback:
            raise ValueError(
                f"sender: give the lidar's address (192.168.1.201 from the factory) when binding to {self.bind}, "
                "so that packets from other machines are ignored"
            )
        return self


class Lidar(Source[LidarSettings]):
    """One VLP-16 or Puck LITE. Give `sender` (the lidar's address) to listen beyond loopback."""

    def __init__(self, settings: LidarSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        settings = self.settings
        clock = DeviceClock(settings.clock, round(1e9 * settings.clock_limit_s))
        self._stream = PacketStream(settings.topic, clock, settings.packets)
        self._locked_once: bool = False  # utc, since it listens: data packets are taken
        self._position_s: float = 0.0  # when the newest position packet came
        self._pps = PpsWatch()
        self._udp = UdpCounters()

    def decode(self, record: Record) -> LidarFirings | None:
        """Pulses of a packet, or of `packets` once the last of them has come; None before, and when it is refused.

        LinkError for another model, or 100 refused in a row.
        """
        return self._stream.decode(record)

    @property
    def senders(self) -> dict[str, dict[str, str]]:
        """Model, port, and the sensor's address where it is given."""
        settings = self.settings
        known = {"model": "VLP-16"} | ({} if settings.sender is None else {"sender": str(settings.sender)})
        ports = {settings.topic: settings.port} | (
            {} if settings.position_port is None else {POSITION_TOPIC: settings.position_port}
        )
        return {topic: {**known, "port": str(port)} for topic, port in ports.items()}

    @contextmanager
    def listen(self) -> Iterator[Iterator[Record]]:
        """Receive packets from the network: `with lidar.listen() as records`. LinkError: see `listen_udp`, or utc's."""
        settings = self.settings
        compile_kernels()
        if settings.clock == "utc" and settings.position_port is None:
            raise LinkError(
                f"clock: utc needs to know that the sensor is locked to UTC: set position_port: {vlp16.POSITION_PORT} "
                "(its position packets), or clock: free"
            )
        channels = [Channel(settings.topic, settings.port)]
        if settings.position_port is not None:
            channels.append(Channel(POSITION_TOPIC, settings.position_port))
        sender = None if settings.sender is None else str(settings.sender)
        with listen_udp(channels, str(settings.bind), sender, settings.timeout_s, self._udp) as records:
            try:
                yield self._watched(records) if settings.position_port is not None else records
            finally:
                self._locked_once = False

    def _watched(self, records: Iterator[Record]) -> Iterator[Record]:
        """The records, with an eye on the sensor's clock; for utc no data packet before it is locked."""
        settings = self.settings
        waits, deadline_s = settings.clock == "utc", time.monotonic() + settings.timeout_s
        for record in records:
            if record.topic == POSITION_TOPIC:
                self._pps.see(record.data)
                waits = waits and not self._pps.locked
                self._position_s = time.monotonic()
                self._locked_once = settings.clock == "utc" and not waits
            elif waits:
                if time.monotonic() > deadline_s:
                    raise LinkError(
                        f"clock: utc, but the sensor's clock is not locked to UTC: {self._pps.in_words()}. Check its "
                        "GPS receiver and PPS wire (the sensor's web page shows both), or set clock: free"
                    )
                continue
            yield record

    @property
    def status(self) -> str | None:
        """See Link: with `clock: utc`, the sensor's clock is not locked to UTC any more, or does not tell."""
        if not self._locked_once:
            return None
        silent = time.monotonic() - self._position_s > max(self.settings.timeout_s, POSITION_SILENT_S)
        if self._pps.locked and not silent:
            return None
        lost = (
            f"no position packet comes any more on UDP {self.settings.position_port}, so whether the sensor's clock is "
            "locked to UTC is not known"
            if silent
            else f"the sensor's clock is locked to UTC no more: {self._pps.in_words()}"
        )
        return (
            f"clock: utc, and {lost}. Its packets are taken on, and their times may drift away by some millionths. "
            "Check its GPS antenna's view of the sky and the PPS wire; if it does not come back, set clock: free "
            "before the next flight"
        )

    @property
    def counters(self) -> dict[str, int]:
        """Totals since the start: packets decoded, lost, refused by reason, clock disagreements, foreign packets."""
        stream = self._stream
        refused = {f"refused: {reason.value}": count for reason, count in stream.refused.items()}
        return {
            "decoded": stream.decoded,
            "lost": stream.lost,
            "clock disagreements": stream.clock.disagreements,
            "from other senders": self._udp.foreign,
            **self._pps.counters,
            **refused,
        }


class PacketStream:
    """Decodes packets in turn, and counts what was lost between them and what was refused.

    A message holds packets that follow one another: a gap ends it early.
    """

    def __init__(self, topic: str, clock: DeviceClock, together: int = 1) -> None:
        """`together`: packets in a message."""
        self.clock = clock
        self.decoded = 0
        self.lost = 0
        self.refused: Counter[Refusal] = Counter()
        self._topic = topic
        self._refused_in_a_row = 0
        self._lost_before = 0
        self._packet_ns = vlp16.packet_ns(vlp16.STRONGEST)
        self._together, self._rows = together, FiringRows(together)

    def decode(self, record: Record) -> LidarFirings | None:
        """See `Lidar.decode`."""
        data = record.data
        refusal = refusal_of(data)
        if refusal is not None:
            return self._refuse(refusal, data)
        tick = self.clock.read(timestamp_us(data), record.stamp_ns)
        if isinstance(tick, Refusal):
            return self._refuse(tick, data)
        stamp_ns, gap_ns = tick
        # The packet before lasted _packet_ns: when this one is later than its end, others are missing between.
        follows = abs(gap_ns - self._packet_ns) <= self._packet_ns // 2 and not self._lost_before
        lost = self._lost_before + max((gap_ns + self._packet_ns // 2) // self._packet_ns - 1, 0)
        self._packet_ns = vlp16.packet_ns(data[vlp16.RETURN_MODE_AT])
        rows = self._rows if follows or not self._rows.packets else FiringRows(self._together)
        if not rows.add(data, stamp_ns, lost):
            self._lost_before = lost + 1
            return self._refuse(Refusal.AZIMUTH, data)
        self.lost += lost
        self._lost_before = 0
        self.decoded += 1
        self._refused_in_a_row = 0
        before, self._rows = self._rows, rows
        if rows.full:
            return rows.take()
        return before.take() if rows is not before else None

    def _refuse(self, refusal: Refusal, data: bytes) -> None:
        self.refused[refusal] += 1
        self._refused_in_a_row += 1
        stuck = self._refused_in_a_row % REFUSED_IN_A_ROW == 0
        if refusal is Refusal.MODEL and (self.decoded == 0 or stuck):
            model = vlp16.other_model(data)
            if model is not None:
                raise LinkError(
                    f"{self._topic}: these packets come from a Velodyne {model}, and grd reads the VLP-16 and Puck "
                    f"LITE (0x{vlp16.PRODUCT_ID:02X}). Use a recording of one of those, or check `sender` and `port`."
                )
        if stuck:
            reasons = ", ".join(f"{count} {reason.value}" for reason, count in self.refused.most_common())
            raise LinkError(
                f"{self._topic}: {REFUSED_IN_A_ROW} packets in a row are no use (refused so far: {reasons}). Is this "
                f"VLP-16 data (UDP {vlp16.DATA_PORT}, {vlp16.PACKET_BYTES} bytes)? Check `sender`, `port` and the "
                "sensor's settings."
            )
