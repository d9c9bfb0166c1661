"""Preflight checks of the connections to other hosts: they are open, and the other host's clock is known.

A preflight of one host sends nothing that a stage produces, so that messages are counted but not required.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterator

from links.preflight.check_result import CheckResult, fail, ok
from links.preflight.link_checks import LinkChecks
from links.preflight.observations import Observations, ObservedSource
from links.zenoh.peer_clock import CLOCK_OFFSET, CLOCK_UNCERTAINTY, MAX_UNCERTAINTY_NS
from links.zenoh.receiver import Receiver
from links.zenoh.sender import Sender


class ReceiverChecks(LinkChecks):
    """Checks of a connection from another host."""

    link_class = Receiver

    def check_source(self, source: ObservedSource, observations: Observations) -> Iterator[CheckResult]:
        """See LinkChecks."""
        assert isinstance(source.link, Receiver)
        yield connection_check(source, source.link.settings.sender)


class SenderChecks(LinkChecks):
    """Checks of a connection to another host."""

    link_class = Sender

    def check_source(self, source: ObservedSource, observations: Observations) -> Iterator[CheckResult]:
        """See LinkChecks."""
        assert isinstance(source.link, Sender)
        yield connection_check(source, source.link.settings.to)


def connection_check(source: ObservedSource, host: str) -> CheckResult:
    """The result of one connection with `host`."""
    if source.status is not None:
        return fail(source.name, source.status)
    uncertainty_us = source.counters.get(CLOCK_UNCERTAINTY)
    if uncertainty_us is None:
        return fail(source.name, f"{host} has not replied yet: run it there too, and observe for longer (--for)")
    offset_ms = 1e-3 * source.counters.get(CLOCK_OFFSET, 0)
    text = f"{host} replies; its clock differs by {offset_ms:.1f} ms, known to {1e-3 * uncertainty_us:.1f} ms"
    if 1e3 * uncertainty_us > MAX_UNCERTAINTY_NS:
        return fail(source.name, f"{text}; {1e-6 * MAX_UNCERTAINTY_NS:.0f} ms are needed: is the network too slow?")
    return ok(source.name, text)
