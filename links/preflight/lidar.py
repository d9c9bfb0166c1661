"""Is the LiDAR as it must be: packets, losses, foreign senders, return mode, its clock, GPS and PPS.

Source: VLP-16 User Manual 63-9243 Rev. E, chapter 9 (rates, return modes); the limits are ours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from links.preflight.heard import Heard
from links.preflight.seen import LidarSeen
from links.preflight.verdict import Verdict, fail, ok, warning
from links.velodyne import Lidar, vlp16
from links.velodyne.lidar import POSITION_TOPIC

MODES = {vlp16.STRONGEST: "strongest", vlp16.LAST: "last", vlp16.DUAL: "dual"}
WORST_LOSS, SOME_LOSS = 0.02, 0.001  # share of packets
RATE_SLACK = 0.2  # losses are judged by themselves; this finds a second lidar, and a host that stalls
MOST_DRIFT_PPM = 500.0
DRIFT_OVER_S = 2.0  # a shorter time tells no drift: the fastest packets differ by tens of microseconds


def lidar_checks(heard: Heard) -> Iterator[Verdict]:
    """All checks of one LiDAR."""
    link, seen = heard.link, heard.seen
    assert isinstance(link, Lidar)
    assert isinstance(seen, LidarSeen)
    name, decoded = heard.name, heard.counters.get("decoded", 0)
    if not seen.arrivals.count:
        yield fail(f"{name} packets", _sentence(heard.silence))
        return
    if not decoded:
        why = heard.status or _refused(heard) or "none was usable"
        yield fail(f"{name} packets", f"{seen.arrivals.count} packets came, and {_sentence(why)}")
        return
    yield _rate(heard, seen, link.settings.timeout_s)
    yield _losses(heard, decoded)
    foreign = heard.counters.get("from other senders", 0)
    if foreign:
        yield warning(
            f"{name} sender", f"{foreign} packets from other senders were ignored: is a second lidar on this network?"
        )
    yield _mode(name, seen)
    yield _clock(name, link, heard, seen)
    if link.settings.position_port is not None or seen.topics[POSITION_TOPIC].count:
        yield _position(link, name, seen)


def _sentence(text: str) -> str:
    return text if text.endswith((".", "?")) else f"{text}: is the lidar powered, and is this host on its subnet?"


def _refused(heard: Heard) -> str:
    prefix = "refused: "
    return ", ".join(
        f"{n} {what.removeprefix(prefix)}" for what, n in heard.counters.items() if what.startswith(prefix) and n
    )


def _rate(heard: Heard, seen: LidarSeen, timeout_s: float) -> Verdict:
    """A packet each 1.327 ms, or 0.664 ms with dual return."""
    name = f"{heard.name} rate"
    mode = seen.return_modes.most_common(1)[0][0] if seen.return_modes else vlp16.STRONGEST
    wanted_hz, rate_hz = 1e9 / vlp16.packet_ns(mode), seen.arrivals.rate_hz
    silent_s = seen.arrivals.longest_silence_s(heard.end_ns)
    text = f"{rate_hz:.0f} packets a second, {wanted_hz:.0f} are sent"
    if heard.live and silent_s > timeout_s:
        return fail(name, f"{text}; then none came for {silent_s:.1f} s: check its cable and power")
    if not rate_hz >= (1 - RATE_SLACK) * wanted_hz:
        return fail(name, f"{text}: is the network too slow, or this host too busy?")
    if rate_hz > (1 + RATE_SLACK) * wanted_hz:
        return fail(name, f"{text}: do two lidars send to this port? Set `sender`")
    return ok(name, text)


def _losses(heard: Heard, decoded: int) -> Verdict:
    name, lost = f"{heard.name} losses", heard.counters.get("lost", 0)
    share = lost / (lost + decoded)
    refused = _refused(heard)
    text = f"{lost} of {lost + decoded} packets lost" + (f"; refused: {refused}" if refused else "")
    if share > WORST_LOSS:
        return fail(name, f"{text}: is the network shared, or this host too busy (net.core.rmem_max)?")
    return warning(name, text) if share > SOME_LOSS or refused else ok(name, text)


def _mode(name: str, seen: LidarSeen) -> Verdict:
    name = f"{name} return mode"
    modes = [MODES.get(mode, f"0x{mode:02X}") for mode in seen.return_modes]
    if len(modes) != 1:
        return fail(name, f"it changes ({', '.join(modes)}): does somebody else set it, or do two lidars send?")
    if modes[0] not in MODES.values():
        return fail(name, f"{modes[0]} is none that is known: is this a VLP-16?")
    if modes[0] == "last":
        return warning(name, "last return: a drone before a wall is told by its edges alone; set strongest or dual")
    return ok(name, modes[0])


def _clock(name: str, link: Lidar, heard: Heard, seen: LidarSeen) -> Verdict:
    name = f"{name} clock"
    disagreed = heard.counters.get("clock disagreements", 0)
    if disagreed:
        advice = (
            "is it locked to GPS, and the host's clock right?" if link.settings.clock == "utc" else "was it restarted?"
        )
        return fail(name, f"its clock and the host's disagreed {disagreed} times: {advice}")
    drift_ppm = clock_drift_ppm(seen.device_ns)
    if math.isnan(drift_ppm):
        return ok(name, f"{link.settings.clock}, no disagreement; too short to tell a drift")
    text = f"{link.settings.clock}, it goes {abs(drift_ppm):.0f} millionths {'slow' if drift_ppm > 0 else 'fast'}"
    if abs(drift_ppm) > MOST_DRIFT_PPM:
        return warning(name, f"{text} by the fastest packets: is the host's clock being set, or the network busy?")
    return ok(name, text)


def clock_drift_ppm(pairs: list[tuple[int, int]]) -> float:
    """How fast host - device grows [1e-6], by the fastest packet of the first third and of the last; NaN: too short."""
    if len(pairs) < 3 or pairs[-1][0] - pairs[0][0] < 1e9 * DRIFT_OVER_S:
        return math.nan
    hour_ns = 1_000 * vlp16.HOUR_US
    begin = pairs[0][0] - pairs[0][1]
    third_ns = (pairs[-1][0] - pairs[0][0]) / 3
    late = [(host, (host - device - begin + hour_ns // 2) % hour_ns - hour_ns // 2) for host, device in pairs]
    first = min((offset, host) for host, offset in late if host <= pairs[0][0] + third_ns)
    last = min((offset, host) for host, offset in late if host >= pairs[-1][0] - third_ns)
    return 1e6 * (last[0] - first[0]) / (last[1] - first[1])


def _position(link: Lidar, name: str, seen: LidarSeen) -> Verdict:
    """GPS and PPS as the position packets told last; where the clock is free they are for information."""
    name, needed = f"{name} PPS", link.settings.clock == "utc"
    if seen.pps.locked:
        return ok(name, seen.pps.in_words())
    if not seen.topics[POSITION_TOPIC].count:
        text = f"no position packet on UDP {link.settings.position_port}: check `position_port`, or set it to null"
        return fail(name, text) if needed else warning(name, text)
    text = seen.pps.in_words()
    return (
        fail(name, f"{text}: check GPS and PPS wire, or set clock: free") if needed else ok(name, f"{text}; not used")
    )
