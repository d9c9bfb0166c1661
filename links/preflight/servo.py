"""Is the turntable's servo as it must be: answers, place within its limits, error bits, supply.

Source: ROBOTIS e-manual, MX-28AR(2.0): 10.0 to 14.8 V, up to 80 deg C; the other limits are ours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from links.dynamixel import Servo, mx28
from links.preflight.heard import Heard
from links.preflight.seen import ServoSeen
from links.preflight.verdict import Verdict, fail, ok, warning

LEAST_HZ, FULL_RATE = 50.0, 0.8  # of the configured rate
MOST_SILENCE_S = 0.1  # at 55 rpm the table turns 33 deg meanwhile
SOME_BAD = 0.01  # share of the exchanges
LEAST_V, MOST_V = 10.0, 14.8
HOT_C, TOO_HOT_C = 60, 75
SLACK_DEG = 1.0  # outside the limits: the servo's play and rounding
BAD = ("no_reply", "damaged", "wrong", "slow", "implausible")  # `links.dynamixel.wire.Health`


def servo_checks(heard: Heard) -> Iterator[Verdict]:
    """All checks of one servo."""
    link, seen = heard.link, heard.seen
    assert isinstance(link, Servo)
    assert isinstance(seen, ServoSeen)
    if not seen.errors:
        refused = f"{seen.arrivals.count} records came that hold no state; " if seen.arrivals.count else ""
        advice = "" if heard.status else ": is it powered (12 V) and wired?"
        yield fail(f"{heard.name} answers", f"{refused}{heard.silence}{advice}")
        return
    yield _rate(heard, link)
    yield _place(heard.name, link, seen)
    yield _errors(heard.name, seen)
    if "reads" in heard.counters and heard.live:
        yield _exchanges(heard)
        yield _supply(heard)


def _rate(heard: Heard, link: Servo) -> Verdict:
    name, arrivals = f"{heard.name} answers", heard.seen.arrivals
    silent_s = arrivals.longest_silence_s(heard.end_ns)
    text = f"{arrivals.rate_hz:.0f} a second, longest gap {1e-6 * arrivals.longest_gap_ns:.0f} ms"
    if heard.live and silent_s > 1.0:
        return fail(name, f"it fell silent for {silent_s:.1f} s: check its supply and plug")
    if not arrivals.rate_hz >= LEAST_HZ:
        return fail(name, f"{text}; {LEAST_HZ:.0f} are needed: is the baud rate low, or this host too busy?")
    slow = heard.live and arrivals.rate_hz < FULL_RATE * link.settings.rate_hz
    if slow or arrivals.longest_gap_ns > 1e9 * MOST_SILENCE_S:
        return warning(name, f"{text}; rate_hz is {link.settings.rate_hz:g}: is this host too busy, the adapter slow?")
    return ok(name, text)


def _place(name: str, link: Servo, seen: ServoSeen) -> Verdict:
    name = f"{name} position"
    low, high = link.settings.limits_deg
    least, most = math.degrees(seen.least_rad), math.degrees(seen.most_rad)
    text = f"{least:.1f} deg" if most - least < 0.5 else f"{least:.1f} to {most:.1f} deg"
    if least < low - SLACK_DEG or most > high + SLACK_DEG:
        return fail(
            name,
            f"{text} is outside limits_deg {low:g} to {high:g}: turn the table back by hand with the power off, and "
            "look after its cable; or is the horn mounted turned, or limits_deg wrong?",
        )
    return ok(name, f"{text}, within {low:g} to {high:g}")


def _errors(name: str, seen: ServoSeen) -> Verdict:
    bits = 0
    for error in seen.errors:
        bits |= error
    if not bits:
        return ok(f"{name} errors", "no error bits")
    times = sum(count for error, count in seen.errors.items() if error)
    words = mx28.named_errors(bits)
    return fail(f"{name} errors", f"{words} in {times} of {seen.errors.total()} answers: check supply, load and cable")


def _exchanges(heard: Heard) -> Verdict:
    name, counters = f"{heard.name} exchanges", heard.counters
    bad = {kind: counters.get(kind, 0) for kind in BAD if counters.get(kind, 0)}
    told = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in bad.items()) or "all good"
    if not counters.get("connected", 0):
        return fail(name, f"the servo is read but does not hold ({told}): has it shut down? Check supply and load")
    if sum(bad.values()) > SOME_BAD * max(counters["reads"], 1):
        return warning(name, f"{told} of {counters['reads']} reads: check the bus wiring and its ground")
    return ok(name, told)


def _supply(heard: Heard) -> Verdict:
    name = f"{heard.name} supply"
    volts, celsius = 1e-3 * heard.counters.get("voltage_mv", 0), heard.counters.get("temperature_c", 0)
    if not volts:
        return warning(name, "voltage and temperature were not told yet: listen for longer (--for)")
    text = f"{volts:.1f} V, {celsius} deg C"
    if not LEAST_V <= volts <= MOST_V or celsius > TOO_HOT_C:
        return fail(name, f"{text}; it wants {LEAST_V:g} to {MOST_V:g} V and less than {TOO_HOT_C} deg C")
    return warning(name, f"{text}: let it cool") if celsius > HOT_C else ok(name, text)
