"""Preflight checks of the LiDAR: packets, losses, foreign senders, return mode, clock, GPS and PPS.

Source: VLP-16 User Manual 63-9243 Rev. E, chapter 9 (rates, return modes); the limits are ours.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator

from flow.graph import Graph
from flow.link import Record, Source
from links.lidar.formats import AnyFormat
from links.lidar.lidar import POSITION_TOPIC, Lidar
from links.lidar.position import PpsMonitor
from links.lidar.reject_reason import HOUR_US
from links.preflight.check_result import CheckResult, fail, ok, warning
from links.preflight.link_checks import LinkChecks, declares
from links.preflight.observations import Observation, Observations, ObservedSource

FAIL_LOSS, WARN_LOSS = 0.02, 0.001  # share of packets
RATE_TOLERANCE = 0.2  # losses are checked separately; this finds a second LiDAR, or a host that stalls
MAX_DRIFT_PPM = 500.0
MIN_DRIFT_TIME_S = 2.0  # over less time, the jitter of tens of microseconds hides the drift

DISK_SHARE = 0.43  # of the packets' bytes, after zstd: 0.91 MB/s arrive, 1.4 GB/h are stored
DEFAULT_GB_PER_HOUR = 1.4  # of a LiDAR that sent nothing
MAX_DEVICE_TIMES = 100_000


class LidarObservation(Observation):
    """Return modes, GPS/PPS status, and the sensor's clock against the host's."""

    def __init__(self, topic: str, form: AnyFormat) -> None:
        super().__init__(topic)
        self._form = form
        self.return_modes: Counter[str] = Counter()
        self.pps = PpsMonitor()
        self.device_ns: list[tuple[int, int]] = []
        """(host stamp, sensor's time of the hour), both in ns, of each packet of the first minute."""

    @property
    def recorded_gb_per_hour(self) -> float:
        """See Observation."""
        received = self.records.data_gb_per_hour
        return DEFAULT_GB_PER_HOUR if received is None else DISK_SHARE * received

    def add(self, record: Record) -> None:
        """See Observation."""
        super().add(record)
        if record.topic == POSITION_TOPIC:
            self.pps.add(record.data)
        elif record.topic == self.topic and self._form.is_data(record.data):
            self.return_modes[self._form.return_mode(record.data)] += 1
            if len(self.device_ns) < MAX_DEVICE_TIMES and self._form.reject_reason(record.data) is None:
                self.device_ns.append((record.stamp_ns, 1_000 * self._form.timestamp_us(record.data)))


class LidarChecks(LinkChecks):
    """Checks of a LiDAR."""

    link_class = Lidar

    def observation(self, source: Source) -> LidarObservation:
        """See LinkChecks."""
        assert isinstance(source, Lidar)
        return LidarObservation(source.topic, source.form)

    def check_configuration(self, graph: Graph) -> Iterator[CheckResult]:
        """A LiDAR is required."""
        if not declares(graph, Lidar):
            yield fail("lidar", "not in this configuration: nothing sees the drone; add links.lidar.Lidar")

    def check_source(self, source: ObservedSource, observations: Observations) -> Iterator[CheckResult]:
        """See LinkChecks."""
        return lidar_checks(source)


def lidar_checks(source: ObservedSource) -> Iterator[CheckResult]:
    """All checks of one LiDAR."""
    link, observation = source.link, source.observation
    assert isinstance(link, Lidar)
    assert isinstance(observation, LidarObservation)
    name, decoded = source.name, source.counters.get("decoded", 0)
    if not observation.records.count:
        yield fail(f"{name} packets", _sentence(source.no_data_reason))
        return
    if not decoded:
        why = source.status or _rejected(source) or "none was valid"
        yield fail(f"{name} packets", f"{observation.records.count} packets arrived, and {_sentence(why)}")
        return
    yield _rate(source, link, observation)
    yield _losses(source, decoded)
    foreign = source.counters.get("from other senders", 0)
    if foreign:
        yield warning(
            f"{name} sender", f"{foreign} packets from other senders were ignored: is a second LiDAR on this network?"
        )
    yield _mode(name, link, observation)
    yield _clock(name, link, source, observation)
    if link.settings.position_port is not None or observation.topics[POSITION_TOPIC].count:
        yield _position(link, name, observation)


def _sentence(text: str) -> str:
    return text if text.endswith((".", "?")) else f"{text}: is the LiDAR powered, and is this host on its subnet?"


def _rejected(source: ObservedSource) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in source.counters.rejected.items() if count)


def _rate(source: ObservedSource, link: Lidar, observation: LidarObservation) -> CheckResult:
    """Packet rate: one per duration of a packet's pulses."""
    name = f"{source.name} rate"
    mode = observation.return_modes.most_common(1)[0][0] if observation.return_modes else "strongest"
    expected_hz, rate_hz = 1e9 / link.form.packet_ns(mode), observation.records.rate_hz
    silent_s = observation.records.longest_silence_s(source.end_ns)
    text = f"{rate_hz:.0f} packets/s, expected {expected_hz:.0f}"
    if source.live and silent_s > link.settings.timeout_s:
        return fail(name, f"{text}; then none for {silent_s:.1f} s: check its cable and power")
    if not rate_hz >= (1 - RATE_TOLERANCE) * expected_hz:
        return fail(name, f"{text}: is the network too slow, or this host too busy?")
    if rate_hz > (1 + RATE_TOLERANCE) * expected_hz:
        return fail(name, f"{text}: do two LiDARs send to this port? Set `sender`")
    return ok(name, text)


def _losses(source: ObservedSource, decoded: int) -> CheckResult:
    name, lost = f"{source.name} losses", source.counters.get("lost", 0)
    share = lost / (lost + decoded)
    rejected = _rejected(source)
    text = f"{lost} of {lost + decoded} packets lost" + (f"; rejected: {rejected}" if rejected else "")
    if share > FAIL_LOSS:
        return fail(name, f"{text}: is the network shared, or this host too busy (net.core.rmem_max)?")
    return warning(name, text) if share > WARN_LOSS or rejected else ok(name, text)


def _mode(name: str, link: Lidar, observation: LidarObservation) -> CheckResult:
    name = f"{name} return mode"
    modes, profile = list(observation.return_modes), link.form.profile
    if len(modes) != 1:
        return fail(name, f"it changes ({', '.join(modes)}): does another program set it, or do two LiDARs send?")
    if modes[0] not in (*profile.return_modes, "dual"):
        return fail(name, f"{modes[0]} is not a known mode: is this a {profile.model}?")
    if modes[0] == "last":
        return warning(
            name, "last return: of a drone in front of a wall only the edges are measured; set strongest or dual"
        )
    return ok(name, modes[0])


def _clock(name: str, link: Lidar, source: ObservedSource, observation: LidarObservation) -> CheckResult:
    name = f"{name} clock"
    disagreed = source.counters.get("clock disagreements", 0)
    if disagreed:
        advice = (
            "is it locked to GPS, and is the host's clock correct?"
            if link.settings.clock == "utc"
            else "was it restarted?"
        )
        return fail(name, f"sensor clock and host clock disagreed {disagreed} times: {advice}")
    drift_ppm = clock_drift_ppm(observation.device_ns)
    if math.isnan(drift_ppm):
        return ok(name, f"{link.settings.clock}, no disagreement; too short to measure the drift")
    text = f"{link.settings.clock}, {abs(drift_ppm):.0f} ppm {'slow' if drift_ppm > 0 else 'fast'}"
    if abs(drift_ppm) > MAX_DRIFT_PPM:
        return warning(name, f"{text} by the fastest packets: is the host's clock being adjusted, or the network busy?")
    return ok(name, text)


def clock_drift_ppm(pairs: list[tuple[int, int]]) -> float:
    """Rate of host - device [ppm], by the fastest packet of the first third and of the last third; NaN: too short."""
    if len(pairs) < 3 or pairs[-1][0] - pairs[0][0] < 1e9 * MIN_DRIFT_TIME_S:
        return math.nan
    hour_ns = 1_000 * HOUR_US
    first_offset = pairs[0][0] - pairs[0][1]
    third_ns = (pairs[-1][0] - pairs[0][0]) / 3
    offsets = [(host, (host - device - first_offset + hour_ns // 2) % hour_ns - hour_ns // 2) for host, device in pairs]
    first = min((offset, host) for host, offset in offsets if host <= pairs[0][0] + third_ns)
    last = min((offset, host) for host, offset in offsets if host >= pairs[-1][0] - third_ns)
    return 1e6 * (last[0] - first[0]) / (last[1] - first[1])


def _position(link: Lidar, name: str, observation: LidarObservation) -> CheckResult:
    """GPS and PPS of the newest position packet; with `clock: free` for information only."""
    name, needed = f"{name} PPS", link.settings.clock == "utc"
    if observation.pps.locked:
        return ok(name, observation.pps.describe())
    if not observation.topics[POSITION_TOPIC].count:
        text = f"no position packet on UDP {link.settings.position_port}: check `position_port`, or set it to null"
        return fail(name, text) if needed else warning(name, text)
    text = observation.pps.describe()
    return (
        fail(name, f"{text}: check GPS and PPS wire, or set clock: free") if needed else ok(name, f"{text}; not used")
    )
