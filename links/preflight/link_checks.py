"""LinkChecks: the preflight checks of one kind of link. Each driver subclasses it in its own `checks.py`.

`links.preflight.devices` lists the subclasses; the preflight loops over that list and over the sources of the graph.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

from flow.graph import Graph
from flow.link import Link, Source
from links.preflight.check_result import CheckResult, fail, ok, warning
from links.preflight.observations import Observation, Observations, ObservedSource


class LinkChecks:
    """Checks of every link that is a `link_class`. The base class checks a source of an unknown kind."""

    link_class: ClassVar[type[Link]] = Link

    def observation(self, source: Source) -> Observation:
        """An empty accumulator for the records of `source`."""
        return Observation(source.topic)

    def check_configuration(self, graph: Graph) -> Iterator[CheckResult]:
        """Results that follow from the configuration alone, such as a missing or unwired link."""
        yield from ()

    def check_source(self, source: ObservedSource, observations: Observations) -> Iterator[CheckResult]:
        """Results of one observed source."""
        records = source.observation.records
        if not records.count:
            yield fail(source.name, source.no_data_reason)
            return
        rate = "one record" if math.isnan(records.rate_hz) else f"{records.rate_hz:.1f} records a second"
        yield warning(source.name, f"{rate}; {source.status}") if source.status else ok(source.name, rate)

    def check_device(self, graph: Graph, observations: Observations, out_dir: Path) -> Iterator[CheckResult]:
        """Results of questions asked after the observation has ended, when the hardware is free again."""
        yield from ()


def declares(graph: Graph, kind: type[Link]) -> bool:
    """Whether the graph has a link of a class."""
    return any(issubclass(spec.cls, kind) for spec in graph.nodes.values())
