"""A stage with what is done when it raises: a fresh stage starts, until that does not help.

The rules know no clock but the messages' arrival, so that a live run and its repetition go the same way.

Source: ours.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from time import perf_counter_ns
from typing import Any

from flow.message import Message
from flow.metrics import Latency
from flow.node_spec import NodeSpec
from flow.ports import Output, RunError, admit, call

MAX_RESTARTS, WITHIN_NS = 5, 60_000_000_000
"""A stage that raises once more within this time is beyond help: it stops, the others fly on."""


class StageLife:
    """One stage of a run, from object to object. `tell` hears in words of everything that went wrong."""

    def __init__(
        self,
        spec: NodeSpec,
        outputs: dict[type[Message], Output[Any]],
        tell: Callable[[str, RunError], None],
        *,
        strict: bool = False,
        build: Callable[[NodeSpec], Any] = NodeSpec.build,
    ) -> None:
        """`build` gives a fresh stage, or what stands for one that works elsewhere."""
        self.name = spec.name
        self.compute = Latency()
        self.stopped = False
        """It takes nothing any more."""
        self.gave_up = False
        """It stopped because it raised."""
        self.failures = self.restarts = 0
        self.last_ns = 0
        """Arrival of the newest message taken."""
        self._spec, self._outputs, self._tell, self._strict = spec, outputs, tell, strict
        self._build = build
        self._failed_ns: deque[int] = deque(maxlen=MAX_RESTARTS)
        self._counted: Counter[str] = Counter()  # by those that raised
        self._begin()

    @property
    def counters(self) -> dict[str, int]:
        """As the stage counts, those before it included."""
        return dict(self._counted + Counter(self._stage.counters))

    def _begin(self) -> None:
        self._stage = self._build(self._spec)

    def take(self, port: str, message: Message, arrival_ns: int) -> list[tuple[Output[Any], Message]]:
        """What the stage gives for one message, each with the output it belongs to; nothing when it raised."""
        self.last_ns = max(self.last_ns, arrival_ns)
        return self._guarded(f"{self.name}.{port}", getattr(self._stage, f"on_{port}"), message, arrival_ns)

    def finish(self) -> list[tuple[Output[Any], Message]]:
        """What the stage still held; it takes nothing afterwards."""
        given = self._guarded(f"{self.name}.finish", lambda _: self._stage.finish(), None, self.last_ns)
        self.stopped = True
        return given

    def _guarded(
        self, where: str, handler: Callable[[Any], Any], message: Message | None, arrival_ns: int
    ) -> list[tuple[Output[Any], Message]]:
        if self.stopped:
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
            self.stopped = self.gave_up = True
            self._tell(
                f"{MAX_RESTARTS} fresh starts in {WITHIN_NS // 10**9} s did not help: {self.name} stays off", error
            )
        else:
            self._failed_ns.append(arrival_ns)
            self.restarts += 1
            self._counted += Counter(self._stage.counters)
            self._begin()
            self._tell(f"{self.name} starts afresh", error)
