"""A stage that is replaced by a fresh one when it raises, until that does not help.

The rules depend on the arrival of messages, on no clock, so that a live run and its repetition do the same.

Source: ours.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from time import perf_counter_ns
from typing import Any

from flow.config.node_spec import NodeSpec
from flow.counters import Counters
from flow.message import Message
from flow.metrics import Latency
from flow.ports import Output, RunError, admit, call

MAX_RESTARTS, WITHIN_NS = 5, 60_000_000_000
"""A stage that raises after so many restarts within this time is switched off; all other stages run on."""


class SupervisedStage:
    """One stage of a run, through all its restarts."""

    def __init__(
        self,
        spec: NodeSpec,
        outputs: dict[type[Message], Output[Any]],
        report: Callable[[str, RunError], None],
        *,
        strict: bool = False,
        build: Callable[[NodeSpec], Any] = NodeSpec.build,
    ) -> None:
        """`report` is called with each exception and a text on what is done about it. `build` makes a fresh stage."""
        self.name = spec.name
        self.compute = Latency()
        self.switched_off = False
        """It raised too often and takes no more messages."""
        self.failures = self.restarts = 0
        self.last_ns = 0
        """Arrival of the newest message taken."""
        self._spec, self._outputs, self._report, self._strict = spec, outputs, report, strict
        self._build = build
        self._finished = False
        self._failed_ns: deque[int] = deque(maxlen=MAX_RESTARTS)
        self._replaced_counters = Counters()
        self._stage = build(spec)
        self._handlers: dict[str, tuple[str, Callable[[Any], Any]]] = {}  # of the stage, with its name, by port

    @property
    def counters(self) -> Counters:
        """The stage's counters, summed over all its restarts."""
        return self._replaced_counters + Counters.of(self._stage.counters)

    def take(self, port: str, message: Message, arrival_ns: int) -> list[tuple[Output[Any], Message]]:
        """What the stage gives for one message, each with its output; nothing when it raises."""
        self.last_ns = max(self.last_ns, arrival_ns)
        handler = self._handlers.get(port)
        if handler is None:
            handler = self._handlers[port] = f"{self.name}.{port}", getattr(self._stage, f"on_{port}")
        return self._guarded(*handler, message, arrival_ns)

    def finish(self) -> list[tuple[Output[Any], Message]]:
        """What the stage gives at the end of the run; it takes nothing afterwards."""
        given = self._guarded(f"{self.name}.finish", lambda _: self._stage.finish(), None, self.last_ns)
        self._finished = True
        return given

    def _guarded(
        self, where: str, handler: Callable[[Any], Any], message: Message | None, arrival_ns: int
    ) -> list[tuple[Output[Any], Message]]:
        if self.switched_off or self._finished:
            return []
        begin = perf_counter_ns()
        try:
            given = call(where, handler, message, arrival_ns)
            self.compute.add(perf_counter_ns() - begin)
            return [(admit(where, self._outputs, item, self._strict), item) for item in given]
        except RunError as error:
            self._failed(error, arrival_ns)
            return []

    def _failed(self, error: RunError, arrival_ns: int) -> None:
        self.failures += 1
        if len(self._failed_ns) == MAX_RESTARTS and arrival_ns - self._failed_ns[0] <= WITHIN_NS:
            self.switched_off = True
            within_s = WITHIN_NS // 10**9
            self._report(f"{MAX_RESTARTS} restarts in {within_s} s did not help: {self.name} stays off", error)
        else:
            self._failed_ns.append(arrival_ns)
            self.restarts += 1
            self._replaced_counters += Counters.of(self._stage.counters)
            self._stage = self._build(self._spec)
            self._handlers.clear()
            self._report(f"{self.name} restarts", error)
