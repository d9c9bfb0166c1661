"""The live runner: the same graph and stages as in a replay, on threads.

- One thread for each source listens, decodes and publishes. Each stage, sink and tap has an inbox (`flow.config.edge`:
  its queues) and a thread.
- Stages that do little for each of many messages share a thread (`thread: NAME`), and sources that need not block share
  it too (`flow.live.shared_thread`). Python runs one thread at a time, and switching threads for each packet would cost
  as much as the work.
- Stages that do much for each of few messages may run in a worker process (`process: NAME`,
  `flow.remote.stage_process`).

Failures are reported as events, and everything else runs on. A stage that raises is replaced by a fresh one
(`flow.live.supervised_stage`). A link that fails is reopened, with growing pauses. A slow tap misses messages.

With a recorder among the taps, the order in which each stage took its inputs is recorded (`flow.live.input_order`).
`flow.live.rerun` repeats the run from that: same messages, same hash.

Source: ours.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Sequence

from flow.counters import Counters
from flow.events import Events
from flow.graph import Graph
from flow.link import Link, Record, Tap
from flow.live.input_order import END_TOPIC
from flow.live.report import LiveReport
from flow.live.threads import Shared
from flow.live.wiring import Wiring
from flow.metrics import Latency
from flow.replay import NodeReport
from flow.taps import Digest

SWITCH_S = 5e-4  # Python's thread switch interval; a packet passes many threads, and the default is 5 ms
HOUSEKEEPING_S = 0.1  # interval at which new input order goes to the recorders
STATUS_S = 1.0  # interval at which the edges' status goes to the taps
CLOSE_S, DRAIN_S, JOIN_S = 0.8, 0.5, 0.1  # of `stop`: sources close; stages and sinks take their queues; threads end
TAPS_S = 0.2  # of `stop`: taps take their queues


class Live:
    """A graph's nodes on threads: `start` it, then `stop` it; `report` at any time.

    `taps` must be open, and stay open. `now_ns` is the clock of the records' arrivals.
    """

    def __init__(
        self,
        graph: Graph,
        taps: Sequence[Tap] = (),
        *,
        digest: Digest | None = None,
        now_ns: Callable[[], int] = time.time_ns,
        strict: bool = False,
    ) -> None:
        self.events = Events(now_ns)
        recorders = [tap for tap in taps if type(tap).record is not Tap.record]
        self._shared = Shared(now_ns, self.events, recorders, digest, strict)
        self._wiring = Wiring(graph, taps, self._shared)
        self.events.publish = self._wiring.publish_event
        self._names = list(graph.nodes)
        self._statuses: dict[str, str | None] = {}
        self._ended = threading.Event()
        self._housekeeper = threading.Thread(target=self._housekeeping, name="housekeeping", daemon=True)
        self._switch_s = sys.getswitchinterval()

    @property
    def nodes(self) -> dict[str, Link]:
        """Links by name; stages belong to their threads."""
        return self._wiring.links

    @property
    def processes(self) -> list[int]:
        """Process ids of the worker processes that run stages."""
        return self._wiring.processes.pids

    def start(self) -> None:
        """Start all threads, sources last, so that every message has a consumer."""
        sys.setswitchinterval(SWITCH_S)
        threads = self._wiring
        threads.processes.wait()
        runs = (*threads.taps, *threads.sinks, *threads.stage_threads, *threads.source_threads)
        for thread in (*runs, self._housekeeper):
            thread.start()

    def stop(self) -> LiveReport:
        """End the run in less than 2 s: links close, stages and sinks take their queues, stages finish. The report."""
        threads = self._wiring
        self._shared.stopping.set()
        for thread in threads.shared_threads:
            thread.wake()
        listening = threads.source_threads
        closers = [
            threading.Thread(target=thread.source.close, name=f"close {thread.source.node}", daemon=True)
            for thread in listening
        ]
        for closer in closers:
            closer.start()
        deadline_s = time.monotonic() + CLOSE_S
        self._join([*closers, *listening], CLOSE_S)
        for source in threads.sources:
            source.ended.wait(max(0.0, deadline_s - time.monotonic()))
        deadline_s = time.monotonic() + DRAIN_S
        for worker in (*threads.stages, *threads.sinks):
            worker.inbox.close()
            if not worker.ended.wait(max(0.0, deadline_s - time.monotonic())):
                worker.inbox.clear()
        self._join([*threads.stage_threads, *threads.sinks], JOIN_S)
        self._ended.set()
        self._join([self._housekeeper], JOIN_S)
        self._record_orders()
        self._record_end()
        for tap in threads.taps:
            tap.end()
        self._join(threads.taps, TAPS_S)
        threads.processes.end()
        sys.setswitchinterval(self._switch_s)
        return self.report()

    def _join(self, threads: Sequence[threading.Thread], within_s: float) -> None:
        """Wait for all these threads, at most `within_s`; those that do not end are reported and abandoned."""
        deadline_s = time.monotonic() + within_s
        for thread in threads:
            thread.join(max(0.0, deadline_s - time.monotonic()))
        for thread in threads:
            if thread.is_alive():
                self.events.report("run", f"the thread '{thread.name}' did not end in time")

    def _housekeeping(self) -> None:
        """Until the end: record input orders, publish the edges' status, report each change of a link's status."""
        status_s = time.monotonic()
        while not self._ended.wait(HOUSEKEEPING_S):
            self._record_orders()
            if time.monotonic() < status_s:
                continue
            status_s += STATUS_S
            for edge in self._wiring.edges.values():
                edge.publish_status(self._shared.now_ns())
            silent = {source.node: source.silence() for source in self._wiring.sources}
            for name, link in self._wiring.links.items():
                status = link.status or silent.get(name)
                if status != self._statuses.get(name):
                    self._statuses[name] = status
                    self.events.report(name, status or "works again", resolved=not status)

    def _record_orders(self) -> None:
        for order in self._wiring.orders:
            record = order.take(self._shared.now_ns())
            if record is not None:
                self._shared.record(record)

    def _record_end(self) -> None:
        digest, now_ns = self._shared.digest, self._shared.now_ns()
        data = json.dumps({"output_hash": None if digest is None else digest.hexdigest()}).encode()
        self._shared.record(Record(END_TOPIC, now_ns, now_ns, data))

    def report(self) -> LiveReport:
        """The run so far."""
        threads = self._wiring
        stages = {run.stage.name: run.stage for run in threads.stages}
        compute: dict[str, Latency] = {sink.node: sink.compute for sink in threads.sinks}
        compute |= {source.node: source.compute for source in threads.sources}
        compute |= {name: stage.compute for name, stage in stages.items()}
        failures = {name: stage.failures for name, stage in stages.items()}
        failures |= {sink.node: sink.failures for sink in threads.sinks}
        counters = {name: Counters.of(node.counters) for name, node in (threads.links | stages).items()}
        edges = {name: edge.report() for name, edge in threads.edges.items()}
        return LiveReport(
            records=sum(source.report.records for source in threads.sources),
            first_ns=min((source.first_ns for source in threads.sources if source.first_ns), default=0),
            last_ns=max((source.last_ns for source in threads.sources), default=0),
            steps=sum(edge.taken for edge in edges.values()),
            messages={o.name: o.count for outputs in threads.outputs.values() for o in outputs.values()},
            nodes={name: NodeReport(c.count, c) for name in self._names for c in [compute.get(name, Latency())]},
            edges=edges,
            links={source.node: source.report for source in threads.sources},
            counters={name: counts for name, counts in counters.items() if counts},
            restarts={name: stage.restarts for name, stage in stages.items() if stage.restarts},
            failures={name: count for name, count in failures.items() if count},
            switched_off=[name for name, stage in stages.items() if stage.switched_off],
            tap_drops={tap.node: sum(tap.inbox.dropped) for tap in threads.taps},
            statuses={name: status for name, status in self._statuses.copy().items() if status},
            events=self.events.all,
        )
