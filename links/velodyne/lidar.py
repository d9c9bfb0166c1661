"""The VLP-16 as a source: UDP packets live, recorded packets in replay, one decoder for both.

Source: VLP-16 User Manual 63-9243 Rev. E, chapter 9. What to do about bad, lost and repeated packets is ours.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import AbstractContextManager
from functools import cached_property
from ipaddress import IPv4Address

from pydantic import Field, PrivateAttr, model_validator

from flow.link import LinkError, Record, Source
from links.velodyne import vlp16
from links.velodyne.clock import ClockMode, DeviceClock
from links.velodyne.decode import compile_kernels, decode_packet, refusal_of, timestamp_us
from links.velodyne.refusal import Refusal
from links.velodyne.udp import UdpCounters, listen_udp
from stages.messages import LidarFirings

REFUSED_IN_A_ROW = 100


class Lidar(Source):
    """One VLP-16 or Puck LITE. Give `sender` (the lidar's address) to listen beyond loopback."""

    topic: str = "/lidar/packets"
    clock: ClockMode = "free"  # utc: sensor and host are both locked to UTC
    clock_limit_s: float = Field(0.5, gt=0, le=1800)
    bind: IPv4Address = IPv4Address("127.0.0.1")  # this host's address; 0.0.0.0 when the lidar broadcasts
    port: int = Field(vlp16.DATA_PORT, ge=1, le=65535)
    sender: IPv4Address | None = None  # the lidar's address, 192.168.1.201 from the factory
    timeout_s: float = Field(2.0, gt=0, le=60)

    _udp: UdpCounters = PrivateAttr(default_factory=UdpCounters)

    @model_validator(mode="after")
    def _sender_is_known(self) -> Lidar:
        if self.sender is None and not self.bind.is_loopback:
            raise ValueError(
                f"sender: give the lidar's address (192.168.1.201 from the factory) when binding to {self.bind}, "
                "so that packets from other machines are ignored"
            )
        return self

    @cached_property  # a private attribute would cost 1.7 us at every packet
    def _stream(self) -> PacketStream:
        return PacketStream(self.topic, DeviceClock(self.clock, round(1e9 * self.clock_limit_s)))

    def decode(self, record: Record) -> LidarFirings | None:
        """Pulses of one packet; None when it is refused. LinkError for another model, or 100 refused in a row."""
        return self._stream.decode(record)

    def listen(self) -> AbstractContextManager[Iterator[Record]]:
        """Receive packets from the network: `with lidar.listen() as records`. LinkError: see `listen_udp`."""
        compile_kernels()
        sender = None if self.sender is None else str(self.sender)
        return listen_udp(self.topic, str(self.bind), self.port, sender, self.timeout_s, self._udp)

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
            **refused,
        }


class PacketStream:
    """Decodes packets in turn, and counts what was lost between them and what was refused."""

    def __init__(self, topic: str, clock: DeviceClock) -> None:
        self.clock = clock
        self.decoded = 0
        self.lost = 0
        self.refused: Counter[Refusal] = Counter()
        self._topic = topic
        self._refused_in_a_row = 0
        self._lost_before = 0
        self._packet_ns = vlp16.packet_ns(vlp16.STRONGEST)

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
        lost = self._lost_before + max((gap_ns + self._packet_ns // 2) // self._packet_ns - 1, 0)
        self._packet_ns = vlp16.packet_ns(data[vlp16.RETURN_MODE_AT])
        firings = decode_packet(data, stamp_ns, lost)
        if firings is None:
            self._lost_before = lost + 1
            return self._refuse(Refusal.AZIMUTH, data)
        self.lost += lost
        self._lost_before = 0
        self.decoded += 1
        self._refused_in_a_row = 0
        return firings

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
