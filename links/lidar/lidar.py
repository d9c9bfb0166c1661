"""A spinning LiDAR as a source: UDP packets live, recorded packets in replay, the same decoder for both.

Live it can also receive a Velodyne's position packets: they are recorded on /lidar/position, and their GPS and PPS
states are counted. With `clock: utc` no data packet is accepted until they report that the sensor's clock is locked to
UTC. A lock that is lost later is counted and reported; the packets are still accepted, and the sensor's clock drifts by
a few ppm.

Source: the manuals in `stages/geometry/lidar_models.py`. The handling of damaged, lost and repeated packets is ours.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from ipaddress import IPv4Address
from typing import Any, ClassVar

from pydantic import Field, model_validator

from flow.counters import Counters
from flow.link import LinkError, PolledRecords, Record, Source, SourceSettings
from links.lidar.decode import FiringRows, compile_kernels
from links.lidar.formats import AnyFormat, packet_format, recognised_model
from links.lidar.lidar_clock import ClockMode, LidarClock
from links.lidar.position import PpsMonitor
from links.lidar.reject_reason import PacketRejectReason
from links.lidar.udp import Channel, UdpCounters, listen_udp
from links.lidar.velodyne import DATA_PORT, POSITION_PORT
from stages.geometry.rig_lidar import RigLidar
from stages.messages import LidarFirings

POSITION_TOPIC = "/lidar/position"
MAX_CONSECUTIVE_REJECTED = 100
BUFFERED_S = 1.2  # packets that wait in the kernel while this process is busy
POSITION_TIMEOUT_S = 3.0  # a sensor sends several per second


class LidarSettings(SourceSettings):
    """Settings of `Lidar`."""

    topic: str = "/lidar/packets"
    unit: RigLidar = RigLidar()  # model, and an Ouster's beams: $rig.lidar
    clock: ClockMode = "free"  # utc: sensor and host are both locked to UTC
    clock_limit_s: float = Field(0.5, gt=0, le=1800)
    bind: IPv4Address = IPv4Address("127.0.0.1")  # this host's address; 0.0.0.0 for a LiDAR that broadcasts
    port: int = Field(DATA_PORT, ge=1, le=65535)  # an Ouster sends to 7502
    sender: IPv4Address | None = None  # the LiDAR's address, 192.168.1.201 from the factory
    position_port: int | None = Field(None, ge=1, le=65535)  # 8308 from the factory; None: not received
    timeout_s: float = Field(2.0, gt=0, le=60)
    slice_ms: float = Field(10.0, gt=0, le=50)  # of a message: longer ones need less CPU time and add latency

    @model_validator(mode="after")
    def _sender_is_known(self) -> LidarSettings:
        if self.sender is None and not self.bind.is_loopback:
            raise ValueError(
                f"sender: set the LiDAR's address (192.168.1.201 from the factory) when binding to {self.bind}, "
                "so that packets from other machines are ignored"
            )
        return self


class Lidar(Source[LidarSettings]):
    """One LiDAR. Set `sender` (the LiDAR's address) to listen beyond loopback."""

    polled: ClassVar[bool] = True

    def __init__(self, settings: LidarSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        settings = self.settings
        clock = LidarClock(settings.clock, round(1e9 * settings.clock_limit_s))
        self.form = packet_format(settings.unit.model, settings.unit.beams)
        self._stream = PacketStream(settings.topic, clock, self.form, round(1e6 * settings.slice_ms))
        self._waits_for_lock: bool = False  # clock: utc, data packets are refused
        self._lock_deadline_s: float = 0.0  # of that
        self._locked_once: bool = False  # clock: utc, since the start of `listen`: data packets are accepted
        self._position_s: float = 0.0  # arrival of the newest position packet, monotonic
        self._pps = PpsMonitor()
        self._udp = UdpCounters()

    def decode(self, record: Record) -> LidarFirings | None:
        """Pulses of a slice, with its last packet; None before that, or when the packet is rejected.

        Raises LinkError for another LiDAR model, or after 100 consecutive rejected packets.
        """
        return self._stream.decode(record)

    @property
    def senders(self) -> dict[str, dict[str, str]]:
        """Model, port, and the sensor's address if `sender` is set."""
        settings = self.settings
        known = {"model": settings.unit.model} | ({} if settings.sender is None else {"sender": str(settings.sender)})
        ports = {settings.topic: settings.port} | (
            {} if settings.position_port is None else {POSITION_TOPIC: settings.position_port}
        )
        return {topic: {**known, "port": str(port)} for topic, port in ports.items()}

    def _buffer_bytes(self) -> int:
        """For BUFFERED_S of packets; the kernel counts some twice their size."""
        return round(2 * self.form.packet_bytes * BUFFERED_S * 1e9 / self.form.packet_ns("dual"))

    @contextmanager
    def listen(self) -> Iterator[PolledRecords]:
        """Receive packets: `with lidar.listen() as records`. LinkError as `listen_udp`, or without UTC lock."""
        settings = self.settings
        compile_kernels()
        if settings.clock == "utc" and settings.position_port is None:
            raise LinkError(
                f"clock: utc needs the sensor's position packets: set position_port: {POSITION_PORT}, or clock: free"
            )
        channels = [Channel(settings.topic, settings.port, self._buffer_bytes())]
        if settings.position_port is not None:
            channels.append(Channel(POSITION_TOPIC, settings.position_port))
        sender = None if settings.sender is None else str(settings.sender)
        self._waits_for_lock, self._lock_deadline_s = settings.clock == "utc", time.monotonic() + settings.timeout_s
        first_pulse_ns, accepts = self.form.first_pulse_ns, self._accepts
        with listen_udp(
            channels, str(settings.bind), sender, settings.timeout_s, self._udp, first_pulse_ns, accepts
        ) as records:
            try:
                yield records
            finally:
                self._locked_once = False

    def _accepts(self, record: Record) -> bool:
        """Whether the packet is used: position packets are monitored; `clock: utc` accepts no data before the lock."""
        if record.topic == POSITION_TOPIC:
            self._pps.add(record.data)
            self._waits_for_lock = self._waits_for_lock and not self._pps.locked
            self._position_s = time.monotonic()
            self._locked_once = self.settings.clock == "utc" and not self._waits_for_lock
        elif self._waits_for_lock and time.monotonic() > self._lock_deadline_s:
            raise LinkError(
                f"clock: utc, but the sensor's clock is not locked to UTC: {self._pps.describe()}. Check its "
                "GPS receiver and PPS wire (the sensor's web page shows both), or set clock: free"
            )
        return record.topic == POSITION_TOPIC or not self._waits_for_lock

    @property
    def status(self) -> str | None:
        """See Link: with `clock: utc`, that the lock to UTC was lost, or that position packets stopped."""
        if not self._locked_once:
            return None
        silent = time.monotonic() - self._position_s > max(self.settings.timeout_s, POSITION_TIMEOUT_S)
        if self._pps.locked and not silent:
            return None
        lost = (
            f"no position packet arrives on UDP {self.settings.position_port}, so the lock of the sensor's clock "
            "to UTC is unknown"
            if silent
            else f"the sensor's clock lost its lock to UTC: {self._pps.describe()}"
        )
        return (
            f"clock: utc, and {lost}. Its packets are still accepted, and their times may drift by a few ppm. Check "
            "the GPS antenna's view of the sky and the PPS wire; if the lock does not return, set clock: free before "
            "the next flight"
        )

    @property
    def counters(self) -> Counters:
        """Totals since the start: packets decoded, lost, rejected by reason, foreign; clock disagreements."""
        stream = self._stream
        totals = {
            "decoded": stream.decoded,
            "lost": stream.lost,
            "clock disagreements": stream.clock.disagreements,
            "from other senders": self._udp.foreign,
            **self._pps.counters,
        }
        return Counters(totals, {reason.value: count for reason, count in stream.rejected.items()})


class PacketStream:
    """Decodes packets in order and counts lost and rejected ones.

    A message holds the consecutive packets of a slice, whole ones and at least one; a gap ends it early.
    """

    def __init__(self, topic: str, clock: LidarClock, form: AnyFormat, slice_ns: int) -> None:
        self.clock = clock
        self.decoded = 0
        self.lost = 0
        self.rejected: Counter[PacketRejectReason] = Counter()
        self._topic = topic
        self._consecutive_rejected = 0
        self._lost_before = 0
        self._form, self._packet_ns = form, form.packet_ns("strongest")
        self._slice_ns, self._rows = slice_ns, FiringRows(form, slice_ns)

    def decode(self, record: Record) -> LidarFirings | None:
        """See `Lidar.decode`."""
        data, form = record.data, self._form
        reason = form.reject_reason(data)
        if reason is not None:
            return self._refuse(reason, data)
        time_or_reason = self.clock.read(form.timestamp_us(data), record.stamp_ns)
        if isinstance(time_or_reason, PacketRejectReason):
            return self._refuse(time_or_reason, data)
        stamp_ns, gap_ns = time_or_reason
        # The previous packet lasted _packet_ns: if this one begins later than its end, packets are missing in between.
        follows = abs(gap_ns - self._packet_ns) <= self._packet_ns // 2 and not self._lost_before
        lost = self._lost_before + max((gap_ns + self._packet_ns // 2) // self._packet_ns - 1, 0)
        self._packet_ns = form.duration_ns(data)
        rows = self._rows if follows or not self._rows.packets else FiringRows(form, self._slice_ns)
        if not rows.add(data, stamp_ns, lost):
            self._lost_before = lost + 1
            return self._refuse(PacketRejectReason.AZIMUTH, data)
        self.lost += lost
        self._lost_before = 0
        self.decoded += 1
        self._consecutive_rejected = 0
        previous, self._rows = self._rows, rows
        if rows.full:
            return rows.take()
        return previous.take() if rows is not previous else None

    def _refuse(self, reason: PacketRejectReason, data: bytes) -> None:
        self.rejected[reason] += 1
        self._consecutive_rejected += 1
        stuck = self._consecutive_rejected % MAX_CONSECUTIVE_REJECTED == 0
        model = self._form.profile.model
        if reason is not PacketRejectReason.POSITION and (self.decoded == 0 or stuck):
            other = self._form.other_model(data)
            if other is None and reason is PacketRejectReason.LENGTH:
                other = recognised_model(data)
            if other is not None:
                raise LinkError(
                    f"{self._topic}: these packets come from a {other}, the rig's LiDAR is a {model}: set rig.lidar, "
                    "use another recording, or check `sender` and `port`."
                )
        if stuck:
            reasons = ", ".join(f"{count} {reason.value}" for reason, count in self.rejected.most_common())
            raise LinkError(
                f"{self._topic}: {MAX_CONSECUTIVE_REJECTED} consecutive packets are invalid (rejected so far: "
                f"{reasons}). Is this {model} data (UDP {self._form.factory_port}, {self._form.packet_bytes} bytes)? "
                "Check `sender`, `port` and the sensor's settings."
            )
