"""Preflight checks of the servo: replies, position within its limits, error bits, supply.

Source: ROBOTIS e-manual, MX-28AR(2.0): 10.0 to 14.8 V, up to 80 deg C; the other limits are ours.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator

from flow.graph import Graph
from flow.link import Record, Source
from links.dynamixel import mx28
from links.dynamixel.servo import Servo, parse_state
from links.preflight.check_result import CheckResult, fail, ok, warning
from links.preflight.link_checks import LinkChecks, declares
from links.preflight.observations import Observation, Observations, ObservedSource

MIN_HZ, MIN_RATE_SHARE = 50.0, 0.8  # the share is of the configured rate
MAX_GAP_S = 0.1  # at 55 rpm the table turns 33 deg in this time
MAX_BAD_SHARE = 0.01  # of the exchanges
MIN_V, MAX_V = 10.0, 14.8
WARM_C, MAX_C = 60, 75
TOLERANCE_DEG = 1.0  # outside the limits: the servo's play, and rounding
BAD = ("no_reply", "damaged", "wrong", "slow", "implausible")  # `links.dynamixel.wire.Health`


class ServoObservation(Observation):
    """Range of the servo's positions, and its error bits."""

    def __init__(self, topic: str) -> None:
        super().__init__(topic)
        self.min_rad, self.max_rad = float("inf"), float("-inf")
        self.errors: Counter[int] = Counter()

    def add(self, record: Record) -> None:
        """See Observation. Records that hold no state are counted by the link."""
        super().add(record)
        try:
            state = parse_state(record.stamp_ns, record.data)
        except ValueError:
            return
        self.min_rad = min(self.min_rad, state.position_rad)
        self.max_rad = max(self.max_rad, state.position_rad)
        self.errors[state.error] += 1


class ServoChecks(LinkChecks):
    """Checks of the turntable's servo."""

    link_class = Servo

    def observation(self, source: Source) -> ServoObservation:
        """See LinkChecks."""
        return ServoObservation(source.topic)

    def check_configuration(self, graph: Graph) -> Iterator[CheckResult]:
        """A servo is required where the rig's LiDAR turns (`rig.lidar.mount.turns`)."""
        if declares(graph, Servo):
            return
        rig = graph.values.get("rig") or {}
        text = "not in this configuration"
        if ((rig.get("lidar") or {}).get("mount") or {}).get("turns", True):
            yield fail("servo", f"{text}, but the rig's LiDAR turns; add links.dynamixel.Servo")
        else:
            yield ok("servo", text)

    def check_source(self, source: ObservedSource, observations: Observations) -> Iterator[CheckResult]:
        """See LinkChecks."""
        return servo_checks(source)


def servo_checks(source: ObservedSource) -> Iterator[CheckResult]:
    """All checks of one servo."""
    link, observation = source.link, source.observation
    assert isinstance(link, Servo)
    assert isinstance(observation, ServoObservation)
    if not observation.errors:
        rejected = (
            f"{observation.records.count} records without a valid state arrived; " if observation.records.count else ""
        )
        advice = "" if source.status else ": is it powered (12 V) and wired?"
        yield fail(f"{source.name} replies", f"{rejected}{source.no_data_reason}{advice}")
        return
    yield _rate(source, link)
    yield _position(source.name, link, observation)
    yield _errors(source.name, observation)
    if "reads" in source.counters and source.live:
        yield _exchanges(source)
        yield _supply(source)


def _rate(source: ObservedSource, link: Servo) -> CheckResult:
    name, records = f"{source.name} replies", source.observation.records
    silent_s = records.longest_silence_s(source.end_ns)
    text = f"{records.rate_hz:.0f} replies/s, longest gap {1e-6 * records.longest_gap_ns:.0f} ms"
    if source.live and silent_s > 1.0:
        return fail(name, f"no reply for {silent_s:.1f} s: check its supply and plug")
    if not records.rate_hz >= MIN_HZ:
        return fail(
            name, f"{text}; at least {MIN_HZ:.0f}/s are needed: is the baud rate too low, or this host too busy?"
        )
    slow = source.live and records.rate_hz < MIN_RATE_SHARE * link.settings.rate_hz
    if slow or records.longest_gap_ns > 1e9 * MAX_GAP_S:
        return warning(
            name, f"{text}; rate_hz is {link.settings.rate_hz:g}: is this host too busy, or the adapter slow?"
        )
    return ok(name, text)


def _position(name: str, link: Servo, observation: ServoObservation) -> CheckResult:
    name = f"{name} position"
    low, high = link.settings.limits_deg
    least, most = math.degrees(observation.min_rad), math.degrees(observation.max_rad)
    text = f"{least:.1f} deg" if most - least < 0.5 else f"{least:.1f} to {most:.1f} deg"
    if least < low - TOLERANCE_DEG or most > high + TOLERANCE_DEG:
        return fail(
            name,
            f"{text} is outside limits_deg {low:g} to {high:g}: turn the table back by hand with the power off, and "
            "check its cable; or is the horn mounted with an offset, or limits_deg wrong?",
        )
    return ok(name, f"{text}, within {low:g} to {high:g}")


def _errors(name: str, observation: ServoObservation) -> CheckResult:
    bits = 0
    for error in observation.errors:
        bits |= error
    if not bits:
        return ok(f"{name} errors", "no error bits")
    times = sum(count for error, count in observation.errors.items() if error)
    names = mx28.named_errors(bits)
    return fail(
        f"{name} errors", f"{names} in {times} of {observation.errors.total()} replies: check supply, load and cable"
    )


def _exchanges(source: ObservedSource) -> CheckResult:
    name, counters = f"{source.name} exchanges", source.counters
    bad = {kind: counters.get(kind, 0) for kind in BAD if counters.get(kind, 0)}
    summary = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in bad.items()) or "all good"
    if not counters.get("connected", 0):
        return fail(name, f"the servo replies but has no torque ({summary}): has it shut down? Check supply and load")
    if sum(bad.values()) > MAX_BAD_SHARE * max(counters["reads"], 1):
        return warning(name, f"{summary} of {counters['reads']} reads: check the bus wiring and its ground")
    return ok(name, summary)


def _supply(source: ObservedSource) -> CheckResult:
    name = f"{source.name} supply"
    volts, celsius = 1e-3 * source.counters.get("voltage_mv", 0), source.counters.get("temperature_c", 0)
    if not volts:
        return warning(name, "voltage and temperature are not known yet: listen for longer (--for)")
    text = f"{volts:.1f} V, {celsius} deg C"
    if not MIN_V <= volts <= MAX_V or celsius > MAX_C:
        return fail(name, f"{text}; allowed are {MIN_V:g} to {MAX_V:g} V and up to {MAX_C} deg C")
    return warning(name, f"{text}: let it cool down") if celsius > WARM_C else ok(name, text)
